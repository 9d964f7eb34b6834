"""A fit made ready for forecasts: the law in columns, its sensors, bands by held-out thirds.

Where residuals show that zeros of channels wander there are two such fits. The one with zeros that
wander is taken where its forecasts of held-out data do not err more than chance makes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.data.channels import parameters_of
from gfnn_jax.data.recording import Recording
from gfnn_jax.dataset.stretches import Nodes, Scales, Stretch
from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.maps.estimates import law_in_use
from gfnn_jax.maps.laws import conformal
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.models.lagrangians.calibration import Calibration, Thirds, calibrated
from gfnn_jax.models.lagrangians.fit import FOLDS, LawFit, Workbench
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.learned_law import in_columns, scaled
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.models.lagrangians.wandering import wander_of
from gfnn_jax.models.lagrangians.zeros_of_runs import wander_of_runs
from gfnn_jax.solve.latent_arcs import SOFT_L1
from gfnn_jax.solve.linear import covariance_root


class InUse(NamedTuple):
    """A fit on its workbench, how its friction was chosen, its law and covariance in the columns'
    units, the law that moves with a root of its covariance, the factor of L and what fixes it, and
    its calibration."""

    bench: Workbench
    fit: LawFit
    choice: FrictionChoice
    law: Lagrangian
    covariance: np.ndarray
    moving: Lagrangian
    root: np.ndarray
    scale: float
    gauge: str
    calibration: Calibration


@dataclasses.dataclass(frozen=True, eq=False)
class Record:
    """The data that all fits of a recording share: its nodes, stretches and scales, σ of channels
    as given (NaN where not), the known mass, and how inputs act between samples."""

    recording: Recording
    nodes: Sequence[Nodes]
    found: Sequence[Stretch]
    scales: Scales
    given: np.ndarray
    mass: Mapping[str, float]
    hold: str
    delay: float

    @property
    def args(self) -> np.ndarray:
        """Parameters (n, k) of the system of each of the nodes' states."""
        return np.concatenate([np.tile(n.stretch.args, (len(n.t), 1)) for n in self.nodes])

    def in_use(self, bench: Workbench, fit: LawFit, choice: FrictionChoice) -> InUse:
        """The fit made ready for forecasts."""
        law, covariance = in_columns(fit)
        names, scale = self.recording.coordinates, 1.0
        gauge = (
            f"the mean inertia M11 (of {names[0]}) over the data is 1, the unit of L, R, gains and "
            f"energies; --mass {names[0]}=VALUE (mass=) gives them theirs"
        )
        for name, value in self.mass.items():
            q = np.concatenate([n.x[:, : fit.form.dim] for n in self.nodes])
            i, of_systems = names.index(name), law.at(self.args)
            scale = value / float(np.mean(of_systems.masses(q)[:, i, i]))
            law, covariance = scaled(law, covariance, scale)
            gauge = f"the mean inertia of {name} over the data is {value:g}, as given"
        gauge += _of_uncoupled(fit.structure, names, scale) + self._of_systems(law)
        moving, of_moving = conformal(law, covariance)
        root, sensors = covariance_root(of_moving), self.sensors(bench, fit)
        spread = np.nanstd(np.concatenate([s.y for s in self.found]), axis=0)
        thirds = self.thirds(bench, fit, sensors)
        used = law_in_use(moving, root, sensors)
        calibration = calibrated(used, thirds, self.found, self.scales, spread)
        return InUse(bench, fit, choice, law, covariance, moving, root, scale, gauge, calibration)

    def _of_systems(self, law: Lagrangian) -> str:
        """Clause on what fixes the scale of L in each run, where these are of different systems."""
        if law.powers is None:
            return ""
        names = ", ".join(parameters_of(self.recording))
        inertia = [
            row for row, term in zip(law.powers, law.terms.rows(), strict=False) if term[0][0] == 2
        ]
        if law.num_inputs:
            return f"; gains of inputs are the same for all values of {names}"
        if any(map(any, inertia)):
            return (
                f"; a run determines only ratios of coefficients: of the laws with the same ratios "
                f"for every {names} this has the fewest terms"
            )
        return f"; for every {names}, since a run determines only ratios of coefficients"

    def sensors(self, bench: Workbench, fit: LawFit) -> Sensors:
        """The sensors, as yet without a misfit."""
        scales, recording, observation = self.scales, self.recording, bench.observation
        noise = np.where(self.given > 0, self.given, np.minimum(scales.sigma, fit.rms()))
        wander = wander_of_runs(self.nodes, noise)
        if bench.wander is not None:  # sizes of wanders are in units of the white part
            noise, wander = fit.sigma, bench.wander
        plain = observation.is_plain and observation.loss == SOFT_L1
        x = np.concatenate([n.x for n in self.nodes])
        x[:, : observation.dim] += fit.zeros
        own = Sensors(
            recording.coordinates,
            recording.inputs,
            recording.angles,
            noise,
            scales.omega,
            scales.period,
            self.hold,
            self.delay,
            np.array([scales.period]),
            np.zeros((1, len(noise))),
            None if plain else dataclasses.replace(observation, values=fit.sensors),
            wander,
            float(np.min(bench.state_scale(noise)[: observation.dim]) / scales.period),
            x[:, : observation.dim].mean(axis=0),
        )
        reach = np.sqrt(np.mean(own.distances(x) ** 2, axis=0))
        return dataclasses.replace(own, reach=np.maximum(reach, 1e-300))

    def thirds(self, bench: Workbench, fit: LawFit, sensors: Sensors) -> Thirds:
        """The laws of the record without each third, of which less data tell less."""
        fewer, laws, begins = np.sqrt(FOLDS / (FOLDS - 1)), [], []
        for other, run, t in bench.without_thirds(self.nodes, fit):
            law, covariance = in_columns(other)
            own = sensors
            if sensors.observation is not None:
                shown = dataclasses.replace(sensors.observation, values=other.sensors)
                own = dataclasses.replace(sensors, observation=shown)
            laws.append(law_in_use(law, fewer * covariance_root(covariance), own))
            begins.append(
                next(
                    (i, t)
                    for i, s in enumerate(self.found)
                    if s.run == run and s.t[0] <= t <= s.t[-1]
                )
            )
        return Thirds(tuple(laws), tuple(begins))


def _of_uncoupled(structure: Structure, names: Sequence[str], scale: float) -> str:
    """Clause on coordinates that nothing couples with the first one: each part of L has a scale of
    its own."""
    parts = structure.uncoupled[1:]
    if not parts:
        return ""
    firsts = ", ".join(names[part[0]] for part in parts)
    return (
        f"; nothing couples {names[0]} with {firsts}: whatever their masses are, the motion is the "
        f"same, and the mean inertia of {firsts} is set to {scale:g} too"
    )


def best_in_use(
    record: Record,
    bench: Workbench,
    fit: LawFit,
    choice: FrictionChoice,
    on_progress: Callable[[str], object],
) -> InUse:
    """The fit as it is, or fitted anew with zeros of channels that wander: where its residuals show
    these (the likelihood's evidence) and forecasts of held-out data do not err more with them than
    chance makes."""
    steady = record.in_use(bench, fit, choice)
    wander = wander_of(bench, fit)
    if wander is None:
        return steady
    bench = dataclasses.replace(bench, wander=wander)
    arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
    fit = bench.fit(fit.structure, fit.values, arcs, fit.sigma)
    wandering = record.in_use(bench, fit, choice)
    share = wandering.calibration.against(steady.calibration)
    on_progress(
        f"zeros that wander by {wander.size:.2g} σ over {wander.time:.3g} s: held-out forecasts "
        f"err by {share:.3g} times as much"
    )
    return steady if wandering.calibration.errs_more(steady.calibration) else wandering
