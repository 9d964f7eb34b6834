"""Spectra of series: their dominant frequencies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import signal

from gfnn_jax.signals.steps import median_step

_LONGEST = 1 << 16  # samples of a segment


def spectrum(times: Sequence[np.ndarray], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(frequencies (F,) in Hz, power density (F,) in units²/Hz) by Welch's method with Hann
    windows; the mean over runs, weighted by their length.

    Values between samples and in gaps are interpolated on a straight line.
    """
    step = median_step(times)
    length = min(max(len(t) for t in times), _LONGEST)
    total, weight, frequencies = 0.0, 0, np.fft.rfftfreq(length, step)
    ends = np.cumsum([len(t) for t in times])[:-1]
    for t, x in zip(times, np.split(values, ends), strict=True):
        known = np.isfinite(x)
        if known.sum() < 8:
            continue
        even = np.arange(t[0], t[-1] + 0.5 * step, step)
        series = np.interp(even, t[known], x[known])
        size = min(length, len(series))
        _, power = signal.welch(series, 1 / step, nperseg=size, nfft=length, detrend="linear")
        total, weight = total + power * len(series), weight + len(series)
    return frequencies, np.asarray(total) / max(weight, 1) * np.ones_like(frequencies)


def dominant_frequencies(
    times: Sequence[np.ndarray], values: np.ndarray, most: int = 3
) -> list[float]:
    """Frequencies in Hz of the highest peaks, the highest first, those above a hundredth of it."""
    frequencies, power = spectrum(times, values)
    if len(frequencies) < 4 or not np.any(power > 0):
        return []
    peaks, _ = signal.find_peaks(np.concatenate([[0], power[1:], [0]]))
    peaks = peaks[peaks < len(power)]
    if len(peaks) == 0:
        return []
    order = peaks[np.argsort(power[peaks])[::-1]]
    order = order[power[order] > 1e-2 * power[order[0]]][:most]
    return [_refined(frequencies, power, int(k)) for k in order]


def _refined(frequencies: np.ndarray, power: np.ndarray, k: int) -> float:
    """The top of the parabola through the logarithms of the power at k and its neighbours."""
    if not 0 < k < len(power) - 1 or np.any(power[k - 1 : k + 2] <= 0):
        return float(frequencies[k])
    below, at, above = np.log(power[k - 1 : k + 2])
    bend = below - 2 * at + above
    shift = 0.5 * (below - above) / bend if bend < 0 else 0.0
    return float(frequencies[k] + shift * (frequencies[1] - frequencies[0]))
