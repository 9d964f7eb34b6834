"""``gfnn.fit`` of a recording: from positions to the law behind them, with friction and inputs.

stretches → nodes → search (`models.lagrangians.search`) → the law in the recording's words → map →
bands
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.data.roles import symbols
from gfnn_jax.dataset.rests import without_rests
from gfnn_jax.dataset.stretches import Nodes, Stretch, measure, nodes_of, stretches
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.flows.motion import WEIGHTS
from gfnn_jax.maps.inputs import HOLDS, Signals
from gfnn_jax.maps.laws import map_of_law
from gfnn_jax.maps.observation import Observation, observed
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fit import LawFit, Workbench
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.given_law import fit_given
from gfnn_jax.models.lagrangians.given_terms import Given, given_terms
from gfnn_jax.models.lagrangians.in_use import Record, best_in_use
from gfnn_jax.models.lagrangians.learned_law import (
    LearnedLaw,
    NextMotion,
    hamiltonian_of,
)
from gfnn_jax.models.lagrangians.libraries import FRICTIONS
from gfnn_jax.models.lagrangians.next_motion import Motion, next_motions
from gfnn_jax.models.lagrangians.residuals import Trace, whiteness
from gfnn_jax.models.lagrangians.search import NO_LAW, SearchOptions, describe, search
from gfnn_jax.models.lagrangians.text import (
    Expression,
    Term,
    friction_of,
    speed_names,
    terms_of,
    which_friction_told,
    word_of,
)
from gfnn_jax.models.lagrangians.velocities import Velocity, velocities, with_channels
from gfnn_jax.solve.robust import Loss

_IMITATED = 1e-4  # of what a sensor's parameter changes, that no coefficient of the law does
_SEEN = 3.0  # standard errors of a gain, below which its input is not seen to act
_ALIKE = 0.99  # correlation of two coefficients that the record cannot tell apart


def fit_recording(
    recording: Recording, *, friction: str = "auto", input_hold: str = "auto",
    mass: Mapping[str, float] | None = None, terms: Sequence[Any] = (), loss: Loss | None = None,
    on_progress: Callable[[str], Any] = lambda message: None,
) -> LearnedLaw:  # fmt: skip
    """The law of a recording, from its positions and inputs.

    friction: "auto", "none", "linear", "quadratic", "dry", or several of them, as
    "linear+dry". input_hold: "auto", or the inputs between samples: "hold", "linear" or
    "band". mass: the known mass (or moment of inertia) of one position, which fixes the scale of L.
    terms: those of L, V and R, as text in the names of columns (`models.lagrangians.given_terms`),
    which are then all that is fitted. loss: of residuals in units of their noise; None: the soft L1
    of `solve.robust`.
    Raises InputError for bad options or a recording without positions, FitError where no law is
    found.
    """
    started = time.process_time()
    options = _options(friction)
    _check(recording, input_hold, mass)
    steps: list[str] = []

    def told(line: str) -> None:
        steps.append(line)
        on_progress(line)

    seen, angles = _observation(recording)
    seen = seen if loss is None else dataclasses.replace(seen, loss=loss)
    found = _stretches(recording, seen, angles)
    far = [i for i in seen.shifts() if i not in angles]
    if far and not recording.guess:
        middle = np.mean(np.concatenate([s.q for s in found]), axis=0)
        seen = seen.shifted(np.where(np.isin(range(seen.dim), far), middle, 0.0))
        found = _stretches(recording, seen, angles)
    scales = measure(found)
    rests: list[str] = []
    if seen.is_plain:
        found, resting = without_rests(found, scales)
        if resting:
            scales = measure(found)
            rests = [f"{resting:.3g} s at rest left out: a body that stands still tells no law"]
            told(rests[0])
    given = np.array([recording.std[name] or np.nan for name in seen.channels])
    scales = dataclasses.replace(scales, sigma=np.where(given > 0, given, scales.sigma))
    asked = _asked(terms, seen, options.dry_width * float(np.mean(scales.speed)))
    nodes = nodes_of(found, scales)
    if not recording.inputs:
        holds: tuple[str, ...] = ("hold",)
    else:
        holds = HOLDS if input_hold == "auto" else (input_hold,)
    inputs = {hold: ArcInputs(nodes, scales.substeps, hold) for hold in holds}
    record = (nodes, scales, angles, len(recording.inputs), inputs, seen, told, options)
    gauge_of = np.concatenate([n.x[:, : seen.dim] for n in nodes])
    acting, choice, nodes = search(*record) if asked is None else fit_given(asked, *record)
    fit, inputs_of = acting.fit, acting.bench.inputs
    if not np.all(np.isfinite(fit.p)) or not np.isfinite(fit.fitted.cost):
        raise FitError(NO_LAW)
    finer = scales.substeps_for(fit.sigma)  # local cubics may have seen more noise than there is
    if finer > scales.substeps:
        inputs_of = ArcInputs(nodes, finer, acting.hold, acting.delay)
        bench = Workbench(gauge_of, inputs_of, scales.omega, seen)
        fit = bench.fit(fit.structure, fit.values, fit.arcs, fit.sigma)
        told(f"{finer} steps between nodes: {describe(fit)}")
    speeds = velocities(recording, fit, nodes)
    honest = tuple(name for name, one in speeds.items() if one.used)
    for name, one in speeds.items():
        told(f"velocity {name}: {one.text}")
    if honest:
        own = np.array([speeds[name].sigma for name in honest])
        seen = seen.beside({n: recording.velocities.index(n) for n in honest})
        nodes, arcs = with_channels(recording, nodes, fit.arcs, fit.fitted.x, honest)
        bench = Workbench(gauge_of, inputs_of, scales.omega, seen)
        fit = bench.fit(fit.structure, fit.values, arcs, np.concatenate([fit.sigma, own]))
        scales = dataclasses.replace(scales, sigma=np.concatenate([scales.sigma, own]))
        given = np.array([recording.std[name] or np.nan for name in seen.channels])
        found = _stretches(recording, seen, angles)
        found = without_rests(found, scales)[0] if rests else found
    _check_told(fit, seen)
    told("bands: forecasting from windows of the record")
    bench = Workbench(gauge_of, inputs_of, scales.omega, seen)
    record = Record(recording, nodes, found, scales, given, mass or {}, acting.hold, acting.delay)
    best = best_in_use(record, bench, fit, choice, told)
    fit, law, sensors = best.fit, best.law, best.calibration.law.sensors
    first = fit.form.count + len(fit.structure.zeros)
    x = np.concatenate([n.x for n in nodes])
    d = fit.form.dim
    zeros = np.zeros(d)
    zeros[list(fit.structure.zeros)] = fit.p[fit.form.count : first]
    q, v = x[:, :d] + zeros, x[:, d:]
    z = np.concatenate([q, law.momentum(q, v)], axis=1)
    u = np.concatenate([n.stretch.u[n.at] for n in nodes])
    signals = Signals(recording.inputs, acting.hold, acting.delay) if recording.inputs else None
    map_ = map_of_law(
        best.moving,
        z,
        scales.dt,
        angles=angles,
        signals=signals,
        inputs=u if signals else None,
        root=best.root,
    )
    map_ = _with_sensors(map_, sensors)
    traces = _traces(recording, seen.channels, fit, law, nodes, zeros, inputs_of)
    told("finding the motion to record next")
    motions = next_motions(best.bench, fit, angles)
    learned = _described(
        recording, fit, map_, law, best.covariance, (best.choice, best.scale),
        best.calibration.horizons, best.gauge, tuple(steps),
        traces, motions, time.process_time() - started, speeds,
        (acting.delay, acting.error) if recording.inputs else None,
    )  # fmt: skip
    return dataclasses.replace(learned, messages=(*rests, *learned.messages))


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


def _observation(recording: Recording) -> tuple[Observation, tuple[int, ...]]:
    """Observation of the coordinates by the columns, and the angles among them.

    Raises InputError where a sensor's parameter is one that every law has.
    """
    names = recording.coordinates
    angles = tuple(i for i, name in enumerate(names) if name in recording.angles)
    seen = observed(
        recording.observe, names, speed_names(names, recording.velocities), recording.guess,
        offsets=recording.offsets, scales=recording.scales, columns=recording.columns,
    )  # fmt: skip
    lengths = [i for i in range(len(names)) if i not in angles]
    open_ = seen.undetermined(lengths)
    if open_:
        shown = ", ".join(names[i] for i in lengths)
        raise InputError(
            f"{', '.join(open_)}: not identifiable, for every scale of {shown} has a law of the "
            "same terms. Take it out of --scale or --observe, or observe a velocity of known scale"
        )
    return seen, angles


def _stretches(recording: Recording, seen: Observation, angles: tuple[int, ...]) -> list[Stretch]:
    """The stretches of a recording, as the parameters of ``seen`` show its coordinates."""
    if seen.is_plain:
        return stretches(recording)
    return stretches(recording, seen.channels, partial(seen.coordinates_of, angles=angles))


def _check_told(fit: LawFit, seen: Observation) -> None:
    """Raises FitError where the record does not tell a sensor's parameters from the law."""
    count = len(seen.parameters)
    R = fit.fitted.triangle
    size = np.linalg.norm(R, axis=0)
    for name, k in zip(seen.parameters, range(len(fit.p) - count, len(fit.p)), strict=True):
        others = np.delete(R, k, axis=1)
        left = R[:, k] - others @ np.linalg.lstsq(others, R[:, k], rcond=None)[0]
        if not np.linalg.norm(left) > _IMITATED * size[k]:
            raise FitError(
                f"{name}: not identifiable from this record, for coefficients of the law act as it "
                "does. Write its value into --observe (observe=), or leave it out"
            )


def _asked(terms: Sequence[Any], seen: Observation, width: float) -> Given | None:
    """The terms that were given, by the names of formulas."""
    names = symbols((*seen.coordinates, *seen.speeds))
    return given_terms(terms, names[: seen.dim], names[seen.dim :], width) if terms else None


def _with_sensors(map_: Any, sensors: Sensors) -> Any:
    return dataclasses.replace(map_, sensors=sensors)


def _described(
    recording: Recording, fit: LawFit, map_: Any, law: Any, covariance: np.ndarray,
    chosen: tuple[FrictionChoice, float], horizons: Any, gauge: str, steps: tuple[str, ...],
    traces: tuple[Trace, ...], motions: list[Motion],
    seconds: float, told_of: dict[str, Velocity], delay: tuple[float, float] | None,
) -> LearnedLaw:  # fmt: skip
    """The law in the words of the recording."""
    names = recording.coordinates
    speeds = speed_names(names, recording.velocities)
    in_formulas = symbols((*names, *speeds))
    codes, of_speeds = in_formulas[: len(names)], in_formulas[len(names) :]
    channels = map_.sensors.seen.channels
    factors = np.array([recording.factors[name] for name in channels])
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    count, lost = law.terms.count, law.friction.count
    lagrangian = terms_of(law.terms, law.coefficients, std[:count], codes, of_speeds)
    friction = friction_of(law.friction, law.losses, std[count : count + lost], of_speeds)
    if law.uniform != 0:
        kinetic = [
            t for t, row in zip(lagrangian.terms, law.terms.rows(), strict=True) if any(row[0])
        ]
        energy = f"({Expression(tuple(kinetic)).formula})"
        friction = Expression((*friction.terms, Term(energy, float(law.uniform), float(std[-1]))))
    of_gains = std[count + lost :][: law.gains.size].reshape(law.gains.shape)
    gains = {
        u: {q: (float(law.gains[i, j]), float(of_gains[i, j])) for i, q in enumerate(names)}
        for j, u in enumerate(recording.inputs)
    }
    zero_std = np.sqrt(np.diag(fit.covariance()))[fit.form.count :]
    sensors = {
        name: (float(value), float(error))
        for (_, name), value, error in zip(
            fit.structure.keys()[fit.form.count + len(fit.structure.zeros) :],
            fit.p[fit.form.count + len(fit.structure.zeros) :],
            zero_std[len(fit.structure.zeros) :],
            strict=True,
        )
    }
    formulas = dict(zip(channels, map_.sensors.seen.formulas, strict=True))
    zeros = {
        names[i]: (float(fit.p[fit.form.count + k]), float(zero_std[k]))
        for k, i in enumerate(fit.structure.zeros)
    }
    messages = []
    if not fit.fitted.converged:
        messages.append(
            "the fit of the law did not converge: its coefficients and standard errors are not "
            "reliable. Fit a shorter part of the record (--from, --to) or fewer terms (--terms)"
        )
    if chosen[0].gains:
        messages.append(
            "the record gains energy that no input explains. If the system is driven, name its "
            "drive: --inputs NAME (inputs=)"
        )
    messages += parameters_left_out(recording)
    messages += [
        f"no force of the input {u} is seen: its gain is within {_SEEN:g} standard errors of 0. "
        f"Record a stronger or more varied {u}, or leave it out of --inputs (inputs=)"
        for u, forces in gains.items()
        if all(abs(gain) < _SEEN * error for gain, error in forces.values())
    ]
    return LearnedLaw(
        map=map_, lagrangian=lagrangian, friction=friction, gains=gains, delay=delay,
        which_friction=which_friction_told(*chosen, law.dim, of_speeds),
        hamiltonian=hamiltonian_of(law.terms, lagrangian, codes), zeros=zeros,
        noise=dict(zip(channels, map(float, map_.sensors.sigma / factors), strict=True)),
        residual=dict(zip(channels, map(float, fit.rms() / factors), strict=True)), gauge=gauge,
        velocities={n: one.scaled(1 / recording.factors[n]) for n, one in told_of.items()},
        whiteness=whiteness(traces, channels, recording.inputs), traces=traces,
        next_motions=_in_words(motions, fit, recording, codes, of_speeds),
        observe={n: f for n, f in formulas.items() if n != f}, sensors=sensors,
        alike=_alike(fit, lagrangian, friction), horizon=tuple(horizons),
        energy=_energy(traces, friction, recording.inputs),
        messages=tuple(messages), steps=steps, num_samples=len(recording), seconds=seconds,
        ended="every length of arcs was fitted",
    )  # fmt: skip


def parameters_left_out(recording: Recording) -> list[str]:
    """A warning for each parameter that differs from run to run: a law has none."""
    found = []
    for name in recording.parameters:
        values = np.concatenate([recording.values(name, run) for run in recording.runs])
        least, most = np.nanmin(values), np.nanmax(values)
        if least < most:
            found.append(
                f"{name} is {least:g} to {most:g} and the law is one for all runs. If {name} "
                "moves anything, fit the runs of each value by themselves"
            )
    return found


def _in_words(
    motions: list[Motion], fit: LawFit, recording: Recording, codes: Sequence[str],
    speeds: Sequence[str],
) -> tuple[NextMotion, ...]:  # fmt: skip
    """Motions to record, in the file's units where a column shows the coordinate."""
    named = []
    for motion in motions:
        start = {
            name: float(q / recording.factors.get(name, 1.0))
            for name, q in zip(recording.coordinates, motion.start, strict=True)
        }
        told = {word_of(key, codes, speeds): gain for key, gain in motion.gains.items()}
        named.append(NextMotion(start, told))
    return tuple(named)


def _traces(
    recording: Recording, channels: tuple[str, ...], fit: LawFit, law: Lagrangian,
    nodes: list[Nodes], zeros: np.ndarray, inputs: ArcInputs,
) -> tuple[Trace, ...]:  # fmt: skip
    """The arcs of a fit, channels in the file's units. An input supplies the mean of its force over
    a step times the way; friction takes the mean of its power at the ends."""
    arcs, found, d = fit.arcs, [], fit.form.dim
    factors = np.array([recording.factors[name] for name in channels])
    left = fit.fitted.residuals * fit.sigma * arcs.noise
    acting = np.tensordot(inputs(arcs), WEIGHTS, axes=(3, 0)).mean(axis=2)  # (A, L − 1, m)
    for k, (i, a, b) in enumerate(arcs.home):
        n, stretch = b - a, nodes[i].stretch
        t, y, x = arcs.t[k, :n], arcs.y[k, :n], fit.fitted.x[k, :n]
        q, v = x[:, :d] + zeros, x[:, d:]
        rate = law.power(q, v)[0][:, : law.friction.count + (law.uniform != 0)]
        lost = 0.5 * np.diff(t)[:, None] * (rate[1:] + rate[:-1])
        supplied = acting[k, : n - 1] * (np.diff(q, axis=0) @ law.gains)
        found.append(
            Trace(
                stretch.run, t, y / factors, (y - left[k, :n]) / factors,
                fit.fitted.residuals[k, :n], stretch.u[nodes[i].at[a:b]], law.energy(q, v),
                _summed(lost), _summed(supplied),
            )
        )  # fmt: skip
    return tuple(found)


def _summed(steps: np.ndarray) -> np.ndarray:
    """Sums (n, ...) of steps (n − 1, ...) since the first."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def _alike(fit: LawFit, lagrangian: Expression, friction: Expression) -> tuple[str, ...]:
    """Pairs of coefficients that the record cannot tell apart."""
    covariance = fit.covariance()
    scale = np.sqrt(np.diag(covariance))
    with np.errstate(all="ignore"):
        correlation = covariance / scale / scale[:, None]
    texts = dict(zip(fit.structure.terms, (t.term for t in lagrangian.terms), strict=True))
    texts |= dict(zip(fit.structure.friction, (t.term for t in friction.terms), strict=True))
    names = {key: texts.get(key[1], " ".join(map(str, key))) for key in fit.values}
    listed, together = list(names.values()), [names[key] for key in fit.untold()]
    pairs = zip(*np.nonzero(np.triu(np.abs(correlation) > _ALIKE, 1)), strict=True)
    only = (f"{', '.join(together)}: only together",) if together else ()
    return only + tuple(
        f"{listed[i]} and {listed[j]} (correlation {correlation[i, j]:+.3f})" for i, j in pairs
    )


def _energy(
    traces: Sequence[Trace], friction: Expression, inputs: tuple[str, ...]
) -> dict[str, Any]:
    """Energy per second, means over the arcs: stored, lost by each friction, supplied by each
    input, and what these leave unexplained."""
    total = sum(trace.t[-1] - trace.t[0] for trace in traces)
    stored = float(sum(trace.energy[-1] - trace.energy[0] for trace in traces) / total)
    lost = np.sum([trace.lost[-1] for trace in traces], axis=0) / total
    supplied = np.sum([trace.supplied[-1] for trace in traces], axis=0) / total
    return {
        "stored": stored,
        "lost": dict(zip((t.term for t in friction.terms), map(float, lost), strict=True)),
        "supplied": dict(zip(inputs, map(float, supplied), strict=True)),
        "closure": float(stored - np.sum(supplied) + np.sum(lost)),
    }
