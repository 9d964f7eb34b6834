"""Figures of runs and comparisons: learned methods with the reference; statistics of chaos."""

from typing import Any

import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.dataset.structures import Bodies, structure_of
from gfnn_jax.evaluate import figures, metrics
from gfnn_jax.jobs.measure import Measured, plane_of
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.scenes import Scene

BINS = 50  # bins of the histograms that KL divergences compare
OURS, AFFINE = "GFNN", "affine map of the same pairs"


def figures_of_run(
    fit: Fit, scene: Scene, measured: Measured, reference, band=None, affine=None
) -> dict[str, Any]:
    """Draw a run's figures, by file name. In that of errors, where there are any: band (B, L), and
    affine (B, L), the errors of a linear regression of the same pairs."""
    steps, predicted = measured.steps, measured.predicted
    drawn = _errors(scene, {OURS: measured}, reference)
    errors = {OURS: (steps, measured.error)}
    errors |= {} if affine is None else {AFFINE: (steps, affine)}
    band = None if band is None else (steps, band)
    drawn["error"] = figures.error_growth(errors, band=band).figure
    candidates = figures.candidates_figure(fit)
    drawn |= {} if candidates is None else {"candidates": candidates}
    both = {"reference": reference, OURS: predicted}
    if scene.name.startswith("henon-heiles") and scene.dim == 2:
        drawn["section"] = _sections(both)
    of_many = _figures_of_many(scene, steps, reference, predicted)
    if of_many:
        return drawn | of_many
    if scene.dim == 1:
        points = {n: (z[..., 0], z[..., 1]) for n, z in both.items()}
        drawn["portrait"] = figures.sections(points, *plane_of(scene))[0].figure
    else:
        # At most three that stay finite, from the smallest positions to the largest.
        whole = np.flatnonzero(np.isfinite(reference).all(axis=(1, 2)))
        sizes = np.abs(reference[whole, :, : scene.dim]).max(axis=(1, 2))
        few = np.linspace(0, len(whole) - 1, min(3, len(whole))).astype(int)
        some = whole[np.argsort(sizes)][few].tolist()
        orbits = {n: (z[some, :, 0], z[some, :, 1]) for n, z in both.items()}
        portrait = figures.phase_portrait(orbits, ("$q_1$", "$q_2$"))
        portrait.set_aspect("equal", "datalim")  # an orbit in space
        drawn["portrait"] = portrait.figure
    return drawn


def figures_of_comparison(scene: Scene, measured: dict[str, Measured], reference) -> dict[str, Any]:
    """Draw a comparison's figures, by file name. measured: by the methods' titles; the last one is
    ours, and is drawn first: in the colour that it has in the figures of a run."""
    *others, ours = measured
    measured = {name: measured[name] for name in (ours, *others)}
    drawn = _errors(scene, measured, reference)
    predicted = {n: m.predicted for n, m in measured.items()}
    shown = {"reference": reference, **predicted}
    if scene.regular:
        errors = {n: (m.steps, m.error) for n, m in measured.items()}
        drawn["error"] = figures.error_growth(errors).figure
        drawn["coordinates"] = _coordinates(scene, predicted, reference)
    else:
        drawn["marginals"] = _marginals(scene, predicted, reference)
    if scene.dim == 1:
        some = slice(1) if scene.regular else slice(None)  # one orbit
        points = {n: (z[some, :, 0], z[some, :, 1]) for n, z in shown.items()}
        drawn["portraits"] = figures.sections(points, *plane_of(scene))[0].figure
    elif not scene.regular:
        drawn["sections"] = _sections(shown)
    return drawn


def _errors(scene: Scene, measured: dict[str, Measured], reference) -> dict[str, Any]:
    """Draw the errors of the energy and of the elements of an orbit, as far as there are any."""
    steps = next(iter(measured.values())).steps
    drawn: dict[str, Any] = {}
    energies = {n: m.energy_error for n, m in measured.items() if m.energy_error is not None}
    if energies:
        drawn["energy"] = figures.energy_error({n: (steps, e) for n, e in energies.items()}).figure
    if scene.name == "two-body":
        both = metrics.ELEMENTS.values()
        elements = {
            n: (steps, *(metrics.absolute_error(f(m.predicted), f(reference)) for f in both))
            for n, m in measured.items()
        }
        drawn["elements"] = figures.element_errors(elements)[0].figure
    return drawn


def _sections(shown: dict[str, Any]):
    """Draw (q₂, p₂) on the section q₁ = 0."""
    sections = {n: section_points(z) for n, z in shown.items()}
    return figures.sections({n: (z[:, 1], z[:, 3]) for n, z in sections.items()})[0].figure


def _whole_lane(states) -> int:
    """The first trajectory (L, 2d) of (B, L, 2d) that stays finite."""
    return int(np.argmax(np.isfinite(states).all(axis=(1, 2))))


def _figures_of_many(scene: Scene, steps, reference, predicted) -> dict[str, Any]:
    """Draw the figures of the scene's structure, of the first trajectory finite in both."""
    structure = structure_of(scene.structure, scene.dim, scene.coordinates)
    if structure is None:
        return {}
    lane = _whole_lane(reference + predicted)
    drawn = scene.dt * np.asarray(steps), reference[lane], predicted[lane]
    if isinstance(structure, Bodies):
        return {"orbits": figures.orbits(*drawn, structure.count)}
    found = {"space-time": figures.space_time(*drawn, structure.angles)}
    if not structure.angles and structure.fields == 1:
        found["modes"] = figures.modes(*drawn, structure.kind)
    return found


def _coordinates(scene: Scene, predicted: dict[str, Any], reference):
    """Draw both coordinates of one orbit against time, at its end (paper, Figs. 2 and 6)."""
    lane = _whole_lane(reference)
    times = scene.dt * np.arange(reference.shape[1])
    window = (times[-31], times[-1]) if scene.dim == 1 else (0.9 * times[-1], times[-1])
    labels, modulo = plane_of(scene) if scene.dim == 1 else (("$q_1$", "$q_2$"), False)

    def shown(z) -> list[np.ndarray]:
        return [z[lane, :, i] % TWO_PI if modulo else z[lane, :, i] for i in (0, 1)]

    of_methods = {n: shown(z) for n, z in predicted.items()}
    return figures.coordinates_in_two_panels(times, shown(reference), of_methods, labels, window)


def _marginals(scene: Scene, predicted: dict[str, Any], reference):
    """Draw the histograms that the KL divergences compare, a panel for each coordinate."""
    ours = {n: marginal_samples(scene, z) for n, z in predicted.items()}
    panels = {}
    for label, (samples, natural) in marginal_samples(scene, reference).items():
        own = {n: s[label][0] for n, s in ours.items()}
        panels[label] = samples, own, histogram_range(samples, natural)
    return figures.marginal_panels(panels, BINS)


def marginal_samples(scene: Scene, states) -> dict[str, tuple[np.ndarray, tuple[float, float]]]:
    """Samples of the marginals: label -> samples, and their natural range or NaN.

    For the standard map they are θ and p modulo 2π. For other scenes they are q₂ and p₂ on the
    section q₁ = 0, q̇₁ > 0, interpolated from the saved states in the same way for all methods.
    """
    if scene.dim == 1:
        both = states.reshape(-1, 2) % TWO_PI
        return {"θ": (both[:, 0], (0.0, TWO_PI)), "p": (both[:, 1], (0.0, TWO_PI))}
    section, nowhere = section_points(states), (np.nan, np.nan)
    return {"$q_2$": (section[:, 1], nowhere), "$p_2$": (section[:, 3], nowhere)}


def section_points(states) -> np.ndarray:
    """States (K, 2d) where trajectories (B, L, 2d) cross q₁ = 0 upwards."""
    return np.concatenate([metrics.section_crossings(z, index=0) for z in states])


def histogram_range(samples, natural) -> tuple[float, float]:
    """Range of a histogram: the natural one, else that of the samples, 5 % wider on each side."""
    if np.isfinite(natural[0]):
        return natural
    low, high = float(samples.min()), float(samples.max())
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def divergences(scene: Scene, predicted, reference) -> dict[str, float] | None:
    """KL divergences of the marginals from those of the reference; None for regular orbits."""
    if scene.regular:
        return None
    ours, theirs = (marginal_samples(scene, states) for states in (predicted, reference))
    found = {}
    for label, (samples, _) in ours.items():
        range_ = histogram_range(*theirs[label])
        found[label.strip("$")] = metrics.kl_divergence(samples, theirs[label][0], BINS, range_)
    return found
