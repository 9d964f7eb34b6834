"""Figures of a comparison: all methods with the reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.evaluate import figures, metrics
from gfnn_jax.jobs.chaos import BINS, histogram_range, marginal_samples, section_points
from gfnn_jax.jobs.measure import Measured, plane_of
from gfnn_jax.scenes import Scene


def draw(scene: Scene, measured: dict[str, Measured], reference) -> dict[str, Any]:
    """Draw the scene's figures, by file name. measured: by the methods' titles."""
    steps = next(iter(measured.values())).steps
    drawn: dict[str, Any] = {}
    if scene.regular:
        errors = {n: (steps, m.error) for n, m in measured.items()}
        drawn["error"] = figures.error_growth(errors).figure
    energies = {
        n: (steps, m.energy_error) for n, m in measured.items() if m.energy_error is not None
    }
    if energies:
        drawn["energy"] = figures.energy_error(energies).figure
    predicted = {n: m.predicted for n, m in measured.items()}
    if scene.name == "two-body":
        both = metrics.ELEMENTS.values()
        elements = {
            n: (steps, *(metrics.absolute_error(f(z), f(reference)) for f in both))
            for n, z in predicted.items()
        }
        drawn["elements"] = figures.element_errors(elements)[0].figure
    if scene.regular:
        drawn["coordinates"] = _coordinates(scene, predicted, reference)
    if scene.dim == 1:
        shown = {"reference": reference, **predicted}
        if scene.regular:  # one orbit
            shown = {n: z[:1] for n, z in shown.items()}
        points = {n: (z[..., 0], z[..., 1]) for n, z in shown.items()}
        drawn["portraits"] = figures.sections(points, *plane_of(scene))[0].figure
    elif not scene.regular:
        shown = {"reference": reference, **predicted}
        sections = {n: section_points(z) for n, z in shown.items()}
        points = {n: (z[:, 1], z[:, 3]) for n, z in sections.items()}
        drawn["sections"] = figures.sections(points)[0].figure
    if not scene.regular:
        drawn["marginals"] = _marginals(scene, predicted, reference)
    return drawn


def _coordinates(scene: Scene, predicted, reference):
    """Draw both coordinates of one orbit against time, at its end (paper, Figs. 2 and 6)."""
    lane = int(np.argmax(np.isfinite(reference).all(axis=(1, 2))))
    times = scene.dt * np.arange(reference.shape[1])
    window = (times[-31], times[-1]) if scene.dim == 1 else (0.9 * times[-1], times[-1])
    labels, modulo = plane_of(scene) if scene.dim == 1 else (("$q_1$", "$q_2$"), False)

    def shown(z, i):
        return z[lane, :, i] % TWO_PI if modulo else z[lane, :, i]

    return figures.coordinates_in_two_panels(
        times,
        [shown(reference, i) for i in (0, 1)],
        {n: [shown(z, i) for i in (0, 1)] for n, z in predicted.items()},
        labels,
        window,
    )


def _marginals(scene: Scene, predicted, reference):
    """Draw the histograms that the KL divergences compare, a panel for each coordinate."""
    theirs = marginal_samples(scene, reference)
    ours = {n: marginal_samples(scene, z) for n, z in predicted.items()}
    panels = {
        label: (
            samples,
            {n: s[label][0] for n, s in ours.items()},
            histogram_range(samples, natural),
        )
        for label, (samples, natural) in theirs.items()
    }
    return figures.marginal_panels(panels, BINS)
