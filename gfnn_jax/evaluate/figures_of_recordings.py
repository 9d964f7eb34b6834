"""The figure of a recording: time series with gaps marked, phase portraits, spectra."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.data.recording_summary import RecordingSummary
from gfnn_jax.signals.spectra import spectrum

_MOST_POINTS = 4_000  # of a curve
_MOST_ROWS = 6  # positions and inputs


def recording_figure(recording: Recording, summary: RecordingSummary, path: Path) -> Path:
    """Write the figure, a row for each position and input, in the file's own names and units."""
    names = (*recording.positions, *recording.inputs)[:_MOST_ROWS] or recording.columns[:_MOST_ROWS]
    figure, axes = plt.subplots(
        len(names), 3, figsize=(13, 2.6 * len(names)), squeeze=False, layout="constrained"
    )
    longest = max(recording.runs, key=lambda run: len(recording.times(run)))
    for row, name in zip(axes, names, strict=True):
        _series(row[0], recording, summary, name, longest)
        if name in recording.positions:
            _portrait(row[1], recording, name)
        else:
            row[1].axis("off")
        _spectrum(row[2], recording, name)
    axes[-1, 0].set_xlabel("t [s]")
    axes[-1, 2].set_xlabel("frequency [Hz]")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _label(recording: Recording, name: str) -> str:
    unit = recording.unit(name)
    return f"{name} [{unit}]" if unit else name


def _thinned(values: np.ndarray) -> np.ndarray:
    return values[:: max(len(values) // _MOST_POINTS, 1)]


def _in_file(recording: Recording, name: str, run: str) -> np.ndarray:
    return recording.unwrapped(name, run) / recording.factors[name]


def _series(axes, recording: Recording, summary: RecordingSummary, name: str, longest: str) -> None:
    """The column against time in the longest run, others behind it; gaps shaded."""
    for run in (*[r for r in recording.runs[:8] if r != longest], longest):
        t, x = recording.times(run), _in_file(recording, name, run)
        strong = run == longest
        style = {"lw": 0.9, "alpha": 1.0} if strong else {"lw": 0.5, "alpha": 0.3}
        axes.plot(_thinned(t), _thinned(x), ".-", ms=2 if strong else 0, color="C0", **style)
    for run, begin, end in summary.gaps:
        if run == longest:
            axes.axvspan(begin, end, color="C3", alpha=0.25, lw=0)
    axes.set_ylabel(_label(recording, name))
    axes.set_title(f"run {longest}" if len(recording.runs) > 1 else "", fontsize=9)


def _portrait(axes, recording: Recording, name: str) -> None:
    """Velocity, measured or by differences, against position."""
    place = recording.positions.index(name)
    measured = place < len(recording.velocities)
    for run in recording.runs[:8]:
        x = _in_file(recording, name, run)
        if measured:
            v = _in_file(recording, recording.velocities[place], run)
        elif len(x) > 2:
            v = np.gradient(x, recording.times(run))
        else:
            continue
        axes.plot(_thinned(x), _thinned(v), lw=0.5)
    axes.set_xlabel(name)
    axes.set_ylabel(recording.velocities[place] if measured else f"d{name}/dt")


def _spectrum(axes, recording: Recording, name: str) -> None:
    times = [recording.times(run) for run in recording.runs]
    values = np.concatenate([_in_file(recording, name, run) for run in recording.runs])
    frequencies, power = spectrum(times, values)
    shown = power > 0
    axes.loglog(frequencies[shown][1:], power[shown][1:], lw=0.7)
    axes.set_ylabel("power density")
