"""A fit made ready for forecasts: the law in columns, its sensors, bands by held-out thirds.

Where residuals show that zeros of channels wander there are two such fits. The one with zeros that
wander is taken where its forecasts of held-out data do not err more than chance makes.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.dataset.stretches import Stretch
from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.maps.estimates import law_in_use
from gfnn_jax.maps.laws import conformal
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.models.lagrangians.calibration import (
    Calibration,
    Thirds,
    calibrated,
    level_of_friction,
)
from gfnn_jax.models.lagrangians.fit import FOLDS, ArcProblem, LawFit
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.learned_law import in_columns, scaled
from gfnn_jax.models.lagrangians.structure import is_constant
from gfnn_jax.models.lagrangians.zeros import wander_of, wander_of_runs
from gfnn_jax.solve.latent_arcs import SOFT_L1
from gfnn_jax.solve.linear import covariance_root


@dataclasses.dataclass(frozen=True, eq=False)
class RecordingData:
    """Samples of a recording as a fit sees them: the problem of its law, segments without gaps, the
    known mass, and what was left out. phase: of the filter (s³) that its columns stand before."""

    recording: Recording
    problem: ArcProblem
    segments: Sequence[Stretch]
    mass: Mapping[str, float] = dataclasses.field(default_factory=dict)
    messages: tuple[str, ...] = ()
    phase: float = 0.0

    @property
    def given(self) -> np.ndarray:
        """σ (k,) of the channels as given, NaN where none is."""
        channels = self.problem.observation.channels
        return np.array([self.recording.std[name] or np.nan for name in channels])


class GaugedLaw(NamedTuple):
    """A fit, its law and covariance in the columns' units, the factor of L and what fixes it."""

    fit: LawFit
    law: Lagrangian
    covariance: np.ndarray
    scale: float
    gauge: str

    @classmethod
    def of(cls, data: RecordingData, fit: LawFit) -> GaugedLaw:
        """Give a fit the units of its columns."""
        return cls(fit, *_in_gauge(data, fit))


class CalibratedLaw(NamedTuple):
    """A fit, how its friction was chosen, its law and covariance in the columns' units, the law
    that moves with a root of its covariance, the factor of L and what fixes it, and its
    calibration."""

    fit: LawFit
    choice: FrictionChoice
    law: Lagrangian
    covariance: np.ndarray
    moving: Lagrangian
    root: np.ndarray
    scale: float
    gauge: str
    calibration: Calibration

    @classmethod
    def of(
        cls, data: RecordingData, fit: LawFit, choice: FrictionChoice, level: float = 0.0
    ) -> CalibratedLaw:
        """Make a fit ready for forecasts. level: standard deviation of that of its friction."""
        law, covariance, scale, gauge = _in_gauge(data, fit)
        moving, of_moving = conformal(law, covariance)
        root, sensors = covariance_root(of_moving), _sensors(data, fit, level)
        spread = np.nanstd(np.concatenate([s.y for s in data.segments]), axis=0)
        thirds, scales = _thirds(data, fit, sensors), fit.problem.scales
        used = law_in_use(moving, root, sensors)
        calibration = calibrated(used, thirds, data.segments, scales, spread)
        return cls(fit, choice, law, covariance, moving, root, scale, gauge, calibration)


def best_in_use(
    data: RecordingData,
    fit: LawFit,
    choice: FrictionChoice,
    known: Sequence[CalibratedLaw] = (),
) -> CalibratedLaw:
    """The fit as it is, or fitted anew with zeros of channels that wander: where its residuals show
    these (the likelihood's evidence) and forecasts of held-out data do not err more with them than
    chance makes. The strength of friction may wander too: where forecasts err less by more than
    chance makes, each has its own level of it. known: fits that are ready already."""
    ready = (one for one in known if one.fit is fit)
    steady = next(ready, None) or CalibratedLaw.of(data, fit, choice)
    wander = None if fit.problem.observation.crossed else wander_of(fit)
    if wander is None:
        return steady
    fit = fit.again(problem=dataclasses.replace(fit.problem, wander=wander))
    try:
        wandering = CalibratedLaw.of(data, fit, choice)
    except np.linalg.LinAlgError:  # zeros that wander by so much that they follow everything
        return steady
    apart = wandering.calibration.against(steady.calibration)
    fit.problem.on_progress(
        f"zeros that wander by {wander.size:.2g} σ over {wander.time:.3g} s: held-out forecasts "
        f"err by {apart.cost:.3g} times as much"
    )
    best = steady if apart.is_higher(1.0) else wandering
    thirds = _thirds(data, best.fit, best.calibration.law.sensors)
    level = level_of_friction(thirds, data.segments, fit.problem.scales)
    if not level:
        return best
    levelled = CalibratedLaw.of(data, best.fit, choice, level)
    apart = levelled.calibration.against(best.calibration)
    fit.problem.on_progress(
        f"friction whose strength varies by {level:.2%}: held-out forecasts err by "
        f"{apart.cost:.3g} times as much (standard error {apart.error:.2g})"
    )
    return levelled if apart.apart < -apart.error else best


def _in_gauge(data: RecordingData, fit: LawFit) -> tuple[Lagrangian, np.ndarray, float, str]:
    """The law and its covariance in the columns' units, the factor of L, and what fixes it."""
    law, covariance = in_columns(fit)
    names, scale = data.recording.coordinates, 1.0
    fixed = f"the mean inertia M11 (of {names[0]}) over the data is 1"
    if not (data.mass or is_constant(fit.structure.terms[0])):  # as r² of an angle
        scale = 0.5 / float(law.coefficients[0])
        law, covariance = scaled(law, covariance, scale)
        fixed = f"the coefficient of {fit.problem.word(('term', fit.structure.terms[0]))} is ½"
    gauge = (
        f"{fixed}, the unit of L, R, gains and energies; for units of their own: "
        f"--mass {shlex.quote(f'{names[0]}=VALUE')}"
    )
    for name, value in data.mass.items():
        q, i = fit.problem.states[:, : fit.form.dim], names.index(name)
        scale = value / float(np.mean(law.at(fit.problem.args).masses(q)[:, i, i]))
        law, covariance = scaled(law, covariance, scale)
        gauge = f"the mean inertia of {name} over the data is {value:g}, as given"
    if (sensor := fit.problem.observation.hidden) is not None:
        gauge += f"; {sensor.gauge}"
    for i in fit.problem.observation.unseen:
        gauge += f"; no sensor shows {names[i]}: it is zero where V is even, or has no slope"
    parts = fit.structure.uncoupled[1:]
    if parts:
        firsts = ", ".join(names[part[0]] for part in parts)
        gauge += (
            f"; nothing couples {names[0]} with {firsts}: whatever their masses are, the motion is "
            f"the same, and the mean inertia of {firsts} is set to {scale:g} too"
        )
    return law, covariance, scale, gauge + _of_systems(law, fit.problem.parameters)


def _of_systems(law: Lagrangian, parameters: Sequence[str]) -> str:
    """Clause on what fixes the scale of L in each run, where these are of different systems."""
    if law.powers is None:
        return ""
    names, rows = ", ".join(parameters), zip(law.powers, law.terms.rows(), strict=False)
    if law.num_inputs:
        return f"; gains of inputs are the same for all values of {names}"
    if any(any(powers) for powers, term in rows if term[0][0] == 2):
        return (
            f"; a run determines only ratios of coefficients: of the laws with the same ratios "
            f"for every {names} this has the fewest terms"
        )
    return f"; for every {names}, since a run determines only ratios of coefficients"


def _sensors(data: RecordingData, fit: LawFit, level: float) -> Sensors:
    """The sensors, as yet without a misfit."""
    problem, recording = fit.problem, data.recording
    scales, observation, inputs = problem.scales, problem.observation, problem.inputs
    noise = np.where(data.given > 0, data.given, np.minimum(scales.sigma, fit.rms()))
    wander = wander_of_runs(problem.nodes, noise)
    if problem.wander is not None:  # sizes of wanders are in units of the white part
        noise, wander = fit.sigma, problem.wander
    plain = observation.is_plain and observation.loss == SOFT_L1
    x = problem.states.copy()
    x[:, : observation.dim] += fit.zeros
    own = Sensors(
        recording.coordinates,
        recording.inputs,
        recording.angles,
        noise,
        scales.omega,
        scales.period,
        inputs.hold,
        inputs.delay,
        np.array([scales.period]),
        np.zeros((1, len(noise))),
        None if plain else dataclasses.replace(observation, values=fit.sensors),
        wander,
        float(np.min(problem.state_scale(noise)[: observation.dim]) / scales.period),
        x[:, : observation.dim].mean(axis=0),
    )
    reach = np.sqrt(np.mean(own.distances(x) ** 2, axis=0))
    return dataclasses.replace(own, reach=np.maximum(reach, 1e-300), level=level)


def _thirds(data: RecordingData, fit: LawFit, sensors: Sensors) -> Thirds:
    """The laws of the record without each third, of which less data tell less."""
    fewer, laws, begins = np.sqrt(FOLDS / (FOLDS - 1)), [], []
    for part, (other, run, t) in enumerate(fit.without_thirds(), start=1):
        fit.problem.on_progress(f"bands: forecasts by the law without a third ({part} of {FOLDS})")
        law, covariance = in_columns(other)
        own = sensors
        if sensors.observation is not None:
            shown = dataclasses.replace(sensors.observation, values=other.sensors)
            own = dataclasses.replace(sensors, observation=shown)
        laws.append(law_in_use(law, fewer * covariance_root(covariance), own))
        inside = (s.run == run and s.t[0] <= t <= s.t[-1] for s in data.segments)
        begins.append((list(inside).index(True), t))
    return Thirds(tuple(laws), tuple(begins))
