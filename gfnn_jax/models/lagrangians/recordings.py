"""``gfnn.fit`` of a recording: from positions to the law behind them, with friction and inputs.

samples → nodes → search (`models.lagrangians.search`) → velocities → bands → map → traces → the law
in the recording's words (`models.lagrangians.in_words`)
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from gfnn_jax.data.channels import parameters_of
from gfnn_jax.data.recording import Recording
from gfnn_jax.data.roles import by_name, symbols
from gfnn_jax.data.wrong_values import without_wrong_values
from gfnn_jax.dataset.stretches import (
    Moving,
    Nodes,
    Scales,
    Stretch,
    measure,
    nodes_of,
    stretches,
    without_rests,
)
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.maps.inputs import HOLDS, Signals
from gfnn_jax.maps.laws import map_of_law, smoothed
from gfnn_jax.maps.observation import Observation, observed
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fine_steps import with_fine_steps
from gfnn_jax.models.lagrangians.fit import LawFit, Workbench
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.given_law import fit_given
from gfnn_jax.models.lagrangians.given_terms import Given, given_terms
from gfnn_jax.models.lagrangians.in_use import InUse, Record, best_in_use
from gfnn_jax.models.lagrangians.in_words import in_words
from gfnn_jax.models.lagrangians.input_rules import RULES, Acting, choose_again
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
from gfnn_jax.models.lagrangians.libraries import FRICTIONS, KINDS
from gfnn_jax.models.lagrangians.next_motion import next_motions
from gfnn_jax.models.lagrangians.of_systems import search_of_systems
from gfnn_jax.models.lagrangians.search import (
    Found,
    SearchOptions,
    search,
    search_on,
)
from gfnn_jax.models.lagrangians.starts import no_law
from gfnn_jax.models.lagrangians.text import speed_names
from gfnn_jax.models.lagrangians.traces import traces_of
from gfnn_jax.models.lagrangians.velocities import Velocity, velocities, with_channels
from gfnn_jax.solve.noise import Loss

_MISSED = 0.8  # of a channel's variation: no law that leaves as much over follows the recording
_ABOVE_NOISE = 3.0  # times: such a rest is no noise
_CLEARLY = 0.8  # times the errors of forecasts, which chance does not make
_IMITATED = 1e-4  # of what a sensor's parameter changes, that no coefficient of the law does

OnProgress = Callable[[str], object]


def fit_recording(
    recording: Recording,
    *,
    friction: str = "auto",
    input_hold: str = "auto",
    mass: Mapping[str, float] | None = None,
    terms: Sequence[Any] = (),
    loss: Loss | None = None,
    on_progress: Callable[[str], Any] = lambda message: None,
) -> LearnedLaw:
    """The law of a recording, from its positions and inputs.

    friction: "auto", "none", "linear", "quadratic", "dry", or several of them, as
    "linear+dry". input_hold: "auto", or the inputs between samples: "hold", "linear" or
    "band". mass: the known mass (or moment of inertia) of one position, which fixes the scale of L.
    terms: those of L, V and R, as text in the names of columns (`models.lagrangians.given_terms`),
    which are then all that is fitted. loss: of residuals in units of their noise; None: the soft L1
    of `solve.noise`.
    Raises InputError for bad options or a recording without positions, FitError where no law is
    found.
    """
    started = time.process_time()
    options = _options(friction)
    _check(recording, input_hold, mass)
    steps: list[str] = []

    def note(line: str) -> None:
        steps.append(line)
        on_progress(line)

    recording, left_out = without_wrong_values(recording)
    for line in left_out:
        note(line)
    holds = _holds(recording, input_hold)
    parameters = parameters_of(recording)
    samples, gauge, found = _found(recording, loss, parameters, terms, holds, note, options)
    acting, choice, nodes, _ = _forecasting_best(found, samples, note)
    bench = dataclasses.replace(acting.bench, gauge=gauge)
    bench, fit = with_fine_steps(bench, acting.fit, note)
    measured = velocities(recording, fit, nodes)
    for name, one in measured.items():
        note(f"velocity {name}: {one.in_file(recording, name).text}")
    samples, nodes, bench, fit = _with_velocities(measured, samples, nodes, bench, fit)
    _check_identifiable(fit, samples.observation)
    note("bands: forecasting from windows of the record")
    record = samples.record(nodes, mass or {}, acting)
    best = best_in_use(record, bench, fit, choice, note)
    map_ = _map(record, best, samples.angles)
    traces = traces_of(
        recording, samples.observation.channels, best.fit, best.law, nodes, bench.inputs
    )
    note("finding the motion to record next")
    messages = (
        *left_out,
        *samples.messages,
        *_without_role(recording),
        *_at_bound(options, best.choice, best.law.dim),
    )
    motions = next_motions(best.bench, best.fit, samples.angles)
    seconds = time.process_time() - started
    return in_words(
        recording,
        best,
        map_,
        traces,
        motions,
        measured,
        acting,
        messages,
        tuple(steps),
        seconds,
    )


def _options(friction: str) -> SearchOptions:
    if friction == "auto":
        return SearchOptions()
    kinds = () if friction == "none" else tuple(friction.split("+"))
    if not set(kinds) <= set(FRICTIONS):
        raise InputError(
            f"expected friction auto, none or some of {', '.join(FRICTIONS)} joined by +, got "
            f"{friction!r}"
        )
    return SearchOptions(frictions=kinds, choose_friction=False)


def _without_role(recording: Recording) -> list[str]:
    """A message of columns that are inputs by their names, and that no role was given."""
    numbers = [name for name in recording.ignored if name in recording.factors]
    return [
        f"column {name} is not used: if it drives the motion, name it: --inputs (inputs=)"
        for name in by_name(numbers)["inputs"]
    ]


def _at_bound(options: SearchOptions, choice: FrictionChoice, dim: int) -> list[str]:
    """A message where kinds of friction were asked for that the record does not show."""
    if options.choose_friction:
        return []
    taken = {FRICTIONS[KINDS.index(kind)] for kind in choice.kinds}
    taken |= {"uniform"} if dim == 1 and "linear" in taken else set()  # which is the same there
    absent = [kind for kind in options.frictions if kind not in taken]
    if not absent:
        return []
    return [
        f"{' and '.join(absent)} friction was asked for, and the record shows none: its "
        "coefficient is 0, the least that friction can have. fit.which_friction tells the largest "
        "that the record allows"
    ]


def _check(recording: Recording, input_hold: str, mass: Mapping[str, float] | None) -> None:
    if not recording.coordinates:
        raise InputError(f"{recording.source}: no positions. Name them: --positions (positions=)")
    if input_hold not in ("auto", *HOLDS):
        raise InputError(f"expected input_hold auto, {', '.join(HOLDS)}, got {input_hold!r}")
    for name, value in (mass or {}).items():
        if name not in recording.coordinates:
            raise InputError(f"mass: no position {name} among {', '.join(recording.coordinates)}")
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"mass: expected {name} above 0, got {value}")
    if len(mass or {}) > 1:
        raise InputError("mass: one known mass fixes the scale of L; got several")


def _holds(recording: Recording, input_hold: str) -> tuple[str, ...]:
    """Rules between samples of the inputs that are tried."""
    if not recording.inputs:
        return ("hold",)
    return HOLDS if input_hold == "auto" else (input_hold,)


@dataclasses.dataclass(frozen=True, eq=False)
class _Samples:
    """Samples of a recording as a fit sees them: how its columns show the coordinates, which of
    these are angles, stretches without gaps, their scales, the parameters in which the systems of
    the runs differ, and what was left out."""

    recording: Recording
    observation: Observation
    angles: tuple[int, ...]
    stretches: list[Stretch]
    scales: Scales
    parameters: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()

    @property
    def given(self) -> np.ndarray:
        """σ (k,) of the channels as given, NaN where none is."""
        return np.array([self.recording.std[name] or np.nan for name in self.observation.channels])

    def record(self, nodes: Sequence[Nodes], mass: Mapping[str, float], acting: Acting) -> Record:
        """The data that the last fits share."""
        return Record(
            self.recording,
            nodes,
            self.stretches,
            self.scales,
            self.given,
            mass,
            acting.hold,
            acting.delay,
        )


def _found(
    recording: Recording,
    loss: Loss | None,
    parameters: tuple[str, ...],
    terms: Sequence[Any],
    holds: Sequence[str],
    on_progress: OnProgress,
    options: SearchOptions,
) -> tuple[_Samples, np.ndarray, Found]:
    """The samples, the positions (n, d) of the gauge, and the law of these parameters; where
    nothing depends on them, all as of one system."""
    samples = _samples(recording, loss, on_progress, parameters)
    nodes = nodes_of(samples.stretches, samples.scales)
    gauge = np.concatenate([n.x[:, : samples.observation.dim] for n in nodes])
    asked = _asked(terms, samples)
    found = _searched(samples, nodes, asked, holds, on_progress, options)
    if found is None:
        return _found(recording, loss, (), terms, holds, on_progress, options)
    return samples, gauge, found


def _samples(
    recording: Recording,
    loss: Loss | None,
    on_progress: OnProgress,
    parameters: tuple[str, ...] = (),
) -> _Samples:
    """The samples of the positions, without rests, each σ as given where it is."""
    observation, angles = _observation(recording)
    observation = observation if loss is None else dataclasses.replace(observation, loss=loss)
    found = _stretches(recording, observation, angles, parameters)
    offset = [i for i in observation.shifts() if i not in angles]
    if offset and not recording.guess:  # an offset starts at the middle of its coordinate
        middle = np.mean(np.concatenate([s.q for s in found]), axis=0)
        observation = observation.shifted(
            np.where(np.isin(range(observation.dim), offset), middle, 0.0)
        )
        found = _stretches(recording, observation, angles, parameters)
    samples = _Samples(recording, observation, angles, found, measure(found), parameters)
    if observation.is_plain:
        moving = without_rests(found, samples.scales)
        if lines := _left_out(moving):
            for line in lines:
                on_progress(line)
            samples = dataclasses.replace(
                samples,
                stretches=moving.stretches,
                scales=measure(moving.stretches),
                messages=lines,
            )
    sigma = np.where(samples.given > 0, samples.given, samples.scales.sigma)
    return dataclasses.replace(samples, scales=dataclasses.replace(samples.scales, sigma=sigma))


def _left_out(moving: Moving) -> tuple[str, ...]:
    """A line on what does not move, and one on what moves for less than a period."""
    lines = []
    if moving.resting:
        lines.append(f"{moving.resting:.3g} s at rest left out: a body at rest shows no dynamics")
    if moving.short:
        lines.append(
            f"{moving.short:.3g} s in parts shorter than a period left out: they tell little more "
            "than their own state"
        )
    return tuple(lines)


def _observation(recording: Recording) -> tuple[Observation, tuple[int, ...]]:
    """Observation of the coordinates by the columns, and the angles among them.

    Raises InputError where a sensor's parameter is one that every law has.
    """
    names = recording.coordinates
    angles = tuple(i for i, name in enumerate(names) if name in recording.angles)
    observation = observed(
        recording.observe,
        names,
        speed_names(names, recording.velocities),
        recording.guess,
        offsets=recording.offsets,
        scales=recording.scales,
        columns=recording.columns,
    )
    lengths = [i for i in range(len(names)) if i not in angles]
    open_ = observation.undetermined(lengths)
    if open_:
        shown = ", ".join(names[i] for i in lengths)
        raise InputError(
            f"{', '.join(open_)}: not identifiable, for every scale of {shown} has a law of the "
            "same terms. Take it out of --scale or --observe, or observe a velocity of known scale"
        )
    return observation, angles


def _stretches(
    recording: Recording,
    observation: Observation,
    angles: tuple[int, ...],
    parameters: tuple[str, ...],
) -> list[Stretch]:
    """The stretches of a recording, as the parameters of ``observation`` show its coordinates."""
    if observation.is_plain:
        return stretches(recording, parameters=parameters)
    return stretches(
        recording,
        observation.channels,
        partial(observation.coordinates_of, angles=angles),
        parameters,
    )


def _asked(terms: Sequence[Any], samples: _Samples) -> Given | None:
    """The terms that were given, by the names of formulas."""
    observation = samples.observation
    d = observation.dim
    names = symbols((*observation.coordinates, *observation.speeds, *samples.parameters))
    return given_terms(terms, names[:d], names[d : 2 * d], names[2 * d :]) if terms else None


def _searched(
    samples: _Samples,
    nodes: Sequence[Nodes],
    asked: Given | None,
    holds: Sequence[str],
    on_progress: OnProgress,
    options: SearchOptions,
) -> Found | None:
    """The law that a search finds, or that of the terms which were asked for; None where no
    coefficient depends on the samples' parameters."""
    scales = samples.scales
    inputs = {hold: ArcInputs(nodes, scales.substeps, hold) for hold in holds}
    find: Callable[..., Found | None] = search
    if asked is not None:
        find = partial(fit_given, asked, parameters=samples.parameters)
    elif samples.parameters:
        find = partial(search_of_systems, parameters=samples.parameters)

    def with_rules(inputs: Mapping[str, ArcInputs]) -> Found | None:
        return find(
            nodes,
            scales,
            samples.angles,
            len(samples.recording.inputs),
            inputs,
            samples.observation,
            on_progress,
            options,
        )

    found = with_rules(inputs)
    if found is None:
        return None
    period = max(6, round(scales.per_period))
    acting = choose_again(found.acting, holds, found.nodes, period, scales.dt)
    if acting.hold != found.acting.hold:
        on_progress(f"inputs {RULES[acting.hold]}: held-out arcs choose it with the law found")
        if find is search:
            again = search_on(
                acting,
                found.nodes,
                scales,
                samples.angles,
                len(samples.recording.inputs),
                on_progress,
                options,
            )
        else:
            again = with_rules({acting.hold: inputs[acting.hold]}) or found
        found = again if again.follows or not found.follows else found
    if acting.hold == found.acting.hold:
        found = found._replace(acting=found.acting._replace(others=acting.others))
    if not found.follows or _misses(found.acting.fit, scales.sigma):
        raise no_law(scales)
    return found


def _misses(fit: LawFit, noise: np.ndarray) -> bool:
    """Return whether a law leaves nearly all of the variation of every channel over, or of one that
    is no noise (k,)."""
    left = fit.rms()
    missed = left > _MISSED * np.nanstd(fit.arcs.y, axis=(0, 1))
    return bool(np.all(missed) or np.any(missed & (left > _ABOVE_NOISE * noise)))


def _forecasting_best(found: Found, samples: _Samples, on_progress: OnProgress) -> Found:
    """The law of the longest arcs, or that of shorter ones which tell its coefficients better where
    it clearly errs less in forecasts of held-out data."""
    if found.shorter is None:
        return found
    longer, shorter = (
        samples.record(f.nodes, {}, f.acting).in_use(f.acting.bench, f.acting.fit, f.choice)
        for f in (found, found.shorter)
    )
    share = shorter.calibration.against(longer.calibration)
    on_progress(f"the law of shorter arcs: held-out forecasts err by {share:.3g} times as much")
    if share >= _CLEARLY:
        return found
    acting = found.shorter.acting._replace(others=found.acting.others)
    return found.shorter._replace(acting=acting)


def _with_velocities(
    measured: Mapping[str, Velocity],
    samples: _Samples,
    nodes: Sequence[Nodes],
    bench: Workbench,
    fit: LawFit,
) -> tuple[_Samples, Sequence[Nodes], Workbench, LawFit]:
    """The same, with measured velocities as further channels where they agree with the law."""
    recording, scales = samples.recording, samples.scales
    used = tuple(name for name, one in measured.items() if one.used)
    if not used:
        return samples, nodes, bench, fit
    sigma = np.array([measured[name].sigma for name in used])
    observation = samples.observation.beside(
        {name: recording.velocities.index(name) for name in used}
    )
    nodes, arcs = with_channels(recording, nodes, fit.arcs, fit.fitted.x, used)
    bench = dataclasses.replace(bench, observation=observation)
    fit = bench.fit(fit.structure, fit.values, arcs, np.concatenate([fit.sigma, sigma]))
    scales = dataclasses.replace(scales, sigma=np.concatenate([scales.sigma, sigma]))
    found = _stretches(recording, observation, samples.angles, samples.parameters)
    found = without_rests(found, scales).stretches if samples.messages else found
    samples = dataclasses.replace(samples, observation=observation, stretches=found, scales=scales)
    return samples, nodes, bench, fit


def _check_identifiable(fit: LawFit, observation: Observation) -> None:
    """Raises FitError where the record does not tell a sensor's parameters from the law."""
    count = len(observation.parameters)
    for name, k in zip(observation.parameters, range(len(fit.p) - count, len(fit.p)), strict=True):
        if not fit.linearised.unimitated(k) > _IMITATED:
            raise FitError(
                f"{name}: not identifiable from this record, for coefficients of the law act as it "
                "does. Write its value into --observe (observe=), or leave it out"
            )


def _map(record: Record, best: InUse, angles: tuple[int, ...]) -> SymplecticMap:
    """The map of the law by the states of the fit, with the sensors that its forecasts show."""
    fit, law, names = best.fit, best.law, record.recording.inputs
    x = np.concatenate([n.x for n in record.nodes])
    d = fit.form.dim
    q, v = x[:, :d] + fit.zeros, x[:, d:]
    parameters = () if law.powers is None else parameters_of(record.recording)
    z = np.concatenate([q, law.at(record.args).momentum(q, v)], axis=1)
    signals = Signals(names, record.hold, record.delay) if names else None
    inputs = np.concatenate([n.stretch.u[n.at] for n in record.nodes]) if names else None
    sensors = best.calibration.law.sensors
    map_ = map_of_law(
        smoothed(best.moving, sensors.creep),
        z,
        record.scales.dt,
        angles=angles,
        signals=signals,
        inputs=inputs,
        parameters=parameters,
        args=record.args,
        root=best.root,
    )
    return dataclasses.replace(map_, sensors=sensors)
