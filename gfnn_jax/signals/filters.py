"""A filter that turns the phases of a column and leaves their sizes, as loggers have before they
sample.

It turns the angular frequency ω by phase·ω³. A phase ∝ ω is a delay; the next that a smooth filter
has, a Butterworth's say, is that of ω³.
"""

import numpy as np


class Options:
    """even: of a step, by which steps may differ. reflected: samples beyond either end, at most."""

    even: float = 0.01
    reflected: int = 2_000


def turned(x: np.ndarray, step: float, phase: float) -> np.ndarray:
    """Columns (n, ...) behind a filter of this ``phase`` (s³); before one, with −``phase``.

    ``step`` is the time between samples, in s. Beyond the ends they are continued as reflected
    there, so that values within some 3 |phase| ω² s of an end err.

        t = 0.01 * np.arange(500)
        turned(np.cos(9 * t), 0.01, 1e-4)  # cos(9 t − 0.0729), but for the ends
    """
    width = min(Options.reflected, len(x) - 1)
    pad = [(width, width)] + [(0, 0)] * (x.ndim - 1)
    longer = np.pad(x, pad, mode="reflect", reflect_type="odd")
    omega = 2 * np.pi * np.fft.rfftfreq(len(longer), step)
    waves = np.moveaxis(np.fft.rfft(longer, axis=0), 0, -1) * np.exp(-1j * phase * omega**3)
    return np.fft.irfft(np.moveaxis(waves, -1, 0), len(longer), axis=0)[width : width + len(x)]
