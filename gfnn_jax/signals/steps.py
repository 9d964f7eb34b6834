"""Steps between samples: their median, gaps, whether they are even, whether a clock drifts; spectra
of series."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import legendre

Runs = Sequence[np.ndarray]  # an array of each run


class _Options:
    """Gaps, drifts and spectra."""

    gap: float = 1.5  # times the 95th percentile of the steps, above which a step is a gap
    even: float = 0.05  # of a step, that times may be off
    drifting: int = 100  # samples, at least, of a run whose drift is told
    nearby: int = 101  # steps whose median counts those in a gap
    parabola: float = 0.97  # of the squares of times' deviations from even ones: a drift's part
    longest: int = 1 << 16  # samples of a segment of a spectrum
    across: float = 0.25  # periods of the strongest line, over which a gap is a straight line
    kept: float = 2.0  # periods that a part between longer gaps has


def median_step(times: Runs) -> float:
    """The median time between samples, in s; NaN where no run has two."""
    steps = np.concatenate([np.diff(t) for t in times])
    return float(np.median(steps)) if len(steps) else np.nan


def longest_step(steps: np.ndarray) -> float:
    """The longest step that is no gap among these steps (n,)."""
    return float(_Options.gap * np.quantile(steps, 0.95)) if len(steps) else np.inf


def gaps(times: Runs) -> list[tuple[int, float, float]]:
    """(number of the run, begin, end in s) of each gap."""
    longest = longest_step(np.concatenate([np.diff(t) for t in times]))
    found = [(r, t, k) for r, t in enumerate(times) for k in np.flatnonzero(np.diff(t) > longest)]
    return [(run, float(t[k]), float(t[k + 1])) for run, t, k in found]


def even_runs(times: Runs) -> list[int]:
    """Numbers of the runs whose steps are all the median step, but for a twentieth."""
    step = median_step(times)
    most = _Options.even * step
    return [r for r, t in enumerate(times) if np.all(np.abs(np.diff(t) - step) <= most)]


def drift(times: np.ndarray) -> float:
    """The relative change of the step along a run whose clock runs ever faster, or ever slower; 0
    where it does not.

    Times are a parabola in the number of steps then. Gaps count as so many steps; jitter does not
    make a parabola.
    """
    if len(times) < _Options.drifting:
        return 0.0
    from scipy import ndimage  # loaded when first used

    steps = np.diff(times)
    usual = ndimage.median_filter(steps, _Options.nearby, mode="nearest")
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / usual), 1))])
    place = 2 * number / number[-1] - 1
    _, slope, bend = coefficients = legendre.legfit(place, times, 2)
    off = times - legendre.legval(place, coefficients[:2])
    parabola = legendre.legval(place, [0, 0, bend])
    if np.sum(parabola**2) < _Options.parabola * np.sum(off**2):
        return 0.0
    return float(6 * bend / slope)


def spectrum(times: Runs, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(frequencies (F,) in Hz, power density (F,) in units²/Hz) by Welch's method with Hann
    windows; the mean over runs, weighted by their length.

    Values between samples and in short gaps are interpolated on a straight line. Parts of a run
    between gaps that a swing does not bridge count as runs.
    """
    step = median_step(times)
    length = min(max(len(t) for t in times), _Options.longest)
    ends = np.cumsum([len(t) for t in times])[:-1]
    runs = list(zip(times, np.split(values, ends), strict=True))
    frequencies, power = _welch(runs, step, length)
    strongest = frequencies[np.argmax(power)] if len(power) else 0.0
    if not strongest > 0:
        return frequencies, power
    parts = [part for t, x in runs for part in _between_gaps(t, x, _Options.across / strongest)]
    whole = [(t, x) for t, x in parts if np.ptp(t) * strongest >= _Options.kept]
    return _welch(whole, step, length) if len(parts) > len(runs) and whole else (frequencies, power)


def _between_gaps(t: np.ndarray, x: np.ndarray, longest: float) -> list[tuple[np.ndarray, ...]]:
    """The parts of a run between steps longer than this, without missing values."""
    known = np.isfinite(x)
    t, x = t[known], x[known]
    cuts = np.flatnonzero(np.diff(t) > max(longest, longest_step(np.diff(t)))) + 1
    parts = zip(np.split(t, cuts), np.split(x, cuts), strict=True)
    return [part for part in parts if len(part[0]) > 1]


def _welch(runs: list, step: float, length: int) -> tuple[np.ndarray, np.ndarray]:
    """The `spectrum` of runs (times, values), those of fewer than 8 samples left out."""
    total, weight, frequencies = 0.0, 0, np.fft.rfftfreq(length, step)
    for t, x in runs:
        known = np.isfinite(x)
        if known.sum() < 8:
            continue
        series = np.interp(np.arange(t[0], t[-1] + 0.5 * step, step), t[known], x[known])
        power = _periodograms(series, min(length, len(series)), length) * step
        total, weight = total + power * len(series), weight + len(series)
    return frequencies, np.asarray(total) / max(weight, 1) * np.ones_like(frequencies)


def _periodograms(series: np.ndarray, size: int, length: int) -> np.ndarray:
    """Mean of the periodograms of parts of this size that overlap by half, each without its line,
    under a Hann window, filled up with zeros to ``length``: Welch's spectrum for a step of 1.

    Of scipy, `signal.welch` gives the same, and takes half a second to load."""
    parts = sliding_window_view(series, size)[:: size - size // 2].T
    line = np.vander(np.linspace(-1, 1, size), 2)
    parts = parts - line @ np.linalg.lstsq(line, parts, rcond=None)[0]
    window = np.hanning(size + 1)[:-1, None]
    power = np.mean(np.abs(np.fft.rfft(window * parts, length, axis=0)) ** 2, axis=1)
    power[1 : (length + 1) // 2] *= 2  # the negative frequencies
    return power / np.sum(window**2)


def dominant_frequencies(times: Runs, values: np.ndarray, most: int = 3) -> list[float]:
    """Frequencies in Hz of the highest peaks, the highest first, those above a hundredth of it."""
    frequencies, power = spectrum(times, values)
    if len(frequencies) < 4 or not np.any(power > 0):
        return []
    among = np.concatenate([[0], power[1:], [0]])
    peaks = 1 + np.flatnonzero((among[1:-1] > among[:-2]) & (among[1:-1] >= among[2:]))
    if len(peaks) == 0:
        return []
    order = peaks[np.argsort(power[peaks])[::-1]]
    # Beside a stronger line, what a run shows once is a drift.
    order = order[(power[order] > 1e-2 * power[order[0]]) & ((order > 1) | (order == order[0]))]
    return [_refined(frequencies, power, int(k)) for k in order[:most]]


def _refined(frequencies: np.ndarray, power: np.ndarray, k: int) -> float:
    """The top of the parabola through the logarithms of the power at k and its neighbours."""
    if not 0 < k < len(power) - 1 or np.any(power[k - 1 : k + 2] <= 0):
        return float(frequencies[k])
    below, at, above = np.log(power[k - 1 : k + 2])
    bend = below - 2 * at + above
    shift = 0.5 * (below - above) / bend if bend < 0 else 0.0
    return float(frequencies[k] + shift * (frequencies[1] - frequencies[0]))
