"""What a new user meets in the first hour: figures, messages, pages and names that lead on."""

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.evaluate.figures_of_recordings import recording_figure

T = np.arange(0.0, 12.0, 0.02)


def swing(amplitude: float) -> np.ndarray:
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(T))
    return amplitude * (np.exp(-0.06 * T) * np.cos(3.9 * T) + noise)


def test_an_angle_in_doubt_is_neither_plotted_nor_analysed_as_radians():
    record = gfnn.Recording({"t": T, "angle": swing(70.0)}, positions=["angle"])
    summary = record.summary()
    (column,) = summary.columns
    assert column.unit == "rad or deg?"
    assert column.frequencies[0] == pytest.approx(3.9 / 2 / np.pi, rel=0.02)
    assert summary.loss is not None
    assert summary.loss.per_period == pytest.approx(0.12 * 2 * np.pi / 3.9, rel=0.1)
    labels = [ax.get_ylabel() for ax in recording_figure(record, summary).axes]
    assert not any("[rad" in label and "?" not in label for label in labels)


def test_a_long_gap_makes_no_frequency_and_is_explained():
    keep = (T < 4.0) | (T > 4.9)
    record = gfnn.Recording({"t": T[keep], "theta": swing(1.0)[keep]}, positions=["theta"])
    summary = record.summary()
    (column,) = summary.columns
    assert len(column.frequencies) == 1
    assert column.frequencies[0] == pytest.approx(3.9 / 2 / np.pi, rel=0.02)
    series = recording_figure(record, summary).axes[0]
    assert "gaps shaded" in series.get_title()
    x, _ = series.get_lines()[0].get_data()
    assert np.isnan(x).sum() == 1  # no line across
