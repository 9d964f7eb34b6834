"""A filter that turns the phases of a column and leaves their sizes, as loggers have before they
sample.

It turns the angular frequency ω by phase·ω³. A phase ∝ ω is a delay; the next that a smooth filter
has, a Butterworth's say, is that of ω³.
"""

import numpy as np


class Options:
    """even: of a step, by which steps may differ. order: of the linear prediction beyond the ends,
    from the most recent samples; rank: of its columns, relative. reflected: samples beyond these,
    at most. most: radians, beyond which frequencies are late alike: a motion has little there, and
    noise would be mixed over long times. tail: times this delay, over which waves are mixed.
    enough: times that, of a record whose ends are predicted and left out.
    """

    even: float = 0.01
    reflected: int = 2_000
    order: int = 32
    recent: int = 2_000
    rank: float = 1e-4
    most: float = 4 * np.pi
    tail: float = 1.5
    enough: float = 15.0


def turned(x: np.ndarray, step: float, phase: float) -> np.ndarray:
    """Columns (n, ...) behind a filter of this ``phase`` (s³); before one, with −``phase``.

    ``step`` is the time between samples, in s. Beyond the ends columns are continued by linear
    prediction, so that values within `mixed` s of an end err.

        t = 0.01 * np.arange(500)
        turned(np.cos(9 * t), 0.01, 1e-4)  # cos(9 t − 0.0729), but for the ends
    """
    ahead = int(np.ceil(mixed(step, phase) / step))
    begin, end = (_continued(one, ahead) for one in (x[::-1], x))
    whole = np.concatenate([begin[::-1], x, end])
    width = min(Options.reflected, len(whole) - 1)
    pad = [(width, width)] + [(0, 0)] * (x.ndim - 1)
    longer = np.pad(whole, pad, mode="reflect", reflect_type="odd")
    omega = 2 * np.pi * np.fft.rfftfreq(len(longer), step)
    below = np.minimum(omega, _corner(phase))
    angle = phase * (below**3 + 3 * below**2 * (omega - below))
    waves = np.moveaxis(np.fft.rfft(longer, axis=0), 0, -1) * np.exp(-1j * angle)
    first = width + ahead
    return np.fft.irfft(np.moveaxis(waves, -1, 0), len(longer), axis=0)[first : first + len(x)]


def _continued(x: np.ndarray, ahead: int) -> np.ndarray:
    """Columns (ahead, ...) behind x (n, ...), by linear prediction from its last samples."""
    recent = x[-Options.recent :].reshape(min(len(x), Options.recent), -1)
    order, mean = min(Options.order, len(recent) // 3), recent.mean(axis=0)
    if not order:
        return np.repeat(x[-1:], ahead, axis=0)
    found = []
    for column in (recent - mean).T:
        past = np.lib.stride_tricks.sliding_window_view(column, order)
        weights = np.linalg.lstsq(past[:-1], column[order:], rcond=Options.rank)[0]
        own = list(column[-order:])
        for _ in range(ahead):
            own.append(float(np.clip(weights @ own[-order:], column.min(), column.max())))
        found.append(own[order:])
    return (np.array(found).T + mean).reshape(ahead, *x.shape[1:])


def mixed(step: float, phase: float) -> float:
    """Seconds over which such a filter mixes columns of this step."""
    latest = 3 * abs(phase) * min(np.pi / step, _corner(phase)) ** 2
    return Options.tail * latest + 2 * step


def needed(step: float, phase: float) -> float:
    """Seconds of samples behind such a filter that tell a state as samples before it do."""
    return Options.enough * mixed(step, phase)


def _corner(phase: float) -> float:
    """The angular frequency above which all are late alike."""
    return (Options.most / abs(phase)) ** (1 / 3) if phase else np.inf
