"""Law in the words of its recording: names of columns, units of the file, warnings."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording, args_of, parameters_of
from gfnn_jax.dataset.stretches import nodes_of
from gfnn_jax.errors import FitError
from gfnn_jax.exports.symbolic import Formula
from gfnn_jax.families.lagrangian import Powers
from gfnn_jax.families.text import Term
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.first_order import rival
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.in_use import CalibratedLaw, GaugedLaw
from gfnn_jax.models.lagrangians.input_rules import InputModel
from gfnn_jax.models.lagrangians.learned_law import (
    ONLY_TOGETHER,
    LearnedLaw,
    NextMotion,
    hamiltonian_of,
)
from gfnn_jax.models.lagrangians.next_motion import Motion
from gfnn_jax.models.lagrangians.residuals import Trace, Whiteness, whiteness
from gfnn_jax.models.lagrangians.rivals import widened
from gfnn_jax.models.lagrangians.structure import Structure, is_constant
from gfnn_jax.models.lagrangians.text import (
    Names,
    friction_of,
    of_systems,
    terms_of,
    word_of,
)
from gfnn_jax.models.lagrangians.velocities import Velocity
from gfnn_jax.models.lagrangians.weak_form import trend


class Options:
    """Limits at which a law is not to be relied on (`benchmarks/as_a_user.py`).

    clear: standard errors of a gain, below which its input has no visible effect. many: functions
    of parameters in a term, of which laws of physics have fewer. followed: % of a channel's
    variation, of which a law that explains it follows more. beyond: times the noise, above which
    correlated residuals are motion that the law lacks, unless it follows ``nearly`` all, in %:
    there they may be a series that a library ends. missed: of the spread, what correlated residuals
    have beside the noise, above which they are such motion too. complete: %, above which what is
    left is no energy that is gained. alike: correlation of two coefficients that the record cannot
    tell apart. energies: range of the energy, as a share of the largest kinetic one, below which a
    motion of one coordinate shows M and V together only; series: potentials, from which on a
    constant mass is hardly plainer than one that depends on position. hides: noise of an angle, in
    radians, above which other laws follow the record as well. lost: of the spread, by which half of
    the forecasts of held-out parts err, however short, of a law that fits its own record alone; of
    half of it is noise that hides other laws. left, left_rubbing: of the squares of what a law
    leaves of the equations of motion, that a force, or friction, leaves which changes in time.
    """

    clear: float = 3.0
    many: int = 3
    followed: float = 90.0
    beyond: float = 1.5
    missed: float = 0.02
    energies: float = 0.1
    series: int = 4
    nearly: float = 99.99
    complete: float = 99.999
    alike: float = 0.99
    left: float = 0.05
    left_rubbing: float = 0.2
    hides: float = 0.2
    lost: float = 0.2


Gains = dict[str, dict[str, tuple[float, float]]]


class Findings(NamedTuple):
    """Findings of a fit beside the law: its map, traces of its arcs, motions to record next,
    columns of velocities against the law, how the inputs act, warnings that come before those of
    the law, what the search did, and seconds of the processor."""

    map: SymplecticMap
    traces: tuple[Trace, ...]
    motions: Sequence[Motion]
    velocities: Mapping[str, Velocity]
    inputs: InputModel
    messages: Sequence[str]
    steps: tuple[str, ...]
    seconds: float


def in_words(recording: Recording, best: CalibratedLaw, findings: Findings) -> LearnedLaw:
    """The law, its sensors and what its fit showed, by names of columns and in the file's units."""
    names, traces, inputs = Names.of(recording), findings.traces, findings.inputs
    fit, law = best.fit, best.law
    sensors = findings.map.sensors
    assert sensors is not None  # of every map of a recording
    channels = sensors.observation_model.channels
    factors = np.array([recording.factors[name] for name in channels])
    lagrangian, friction = _expressions(best, names)
    gains, found = _gains(best, recording), whiteness(traces, channels, recording.inputs)
    zeros, parameters = _zeros_and_sensors(fit, recording)
    flaws = _flaws(best, found)
    shown = dict(zip(channels, sensors.observation_model.formulas, strict=True))
    return LearnedLaw(
        map=findings.map,
        lagrangian=lagrangian,
        friction=friction,
        gains=gains,
        delay=(inputs.delay, inputs.error) if recording.inputs else None,
        input_rules=dict(inputs.others),
        which_friction=best.choice.in_words(best.scale, law.dim, names),
        hamiltonian=(None if law.terms.leaders else hamiltonian_of(law, lagrangian, names)),
        zeros=zeros,
        noise=dict(zip(channels, map(float, sensors.sigma / factors), strict=True)),
        residual=dict(zip(channels, map(float, fit.rms() / factors), strict=True)),
        gauge=best.gauge,
        units={n: recording.unit(n) for n in (*recording.columns, *recording.coordinates)},
        velocities={n: one.in_file(recording, n) for n, one in findings.velocities.items()},
        whiteness=found,
        traces=traces,
        next_motions=named_motions(findings.motions, recording),
        observe={n: str(f) for n, f in shown.items() if n != f},
        sensors=parameters,
        alike=_alike(fit, lagrangian, friction),
        horizon=tuple(best.calibration.horizons),
        energy={} if law.terms.leaders else _energy(traces, friction, recording.inputs),
        messages=(
            *findings.messages,
            *(f"{flaw}: {remedy}" for flaw, remedy in flaws.items()),
            *about_parameters(recording, law.powers, fit.structure.most_functions),
            *(() if law.terms.driven or np.any(law.friction.loaded) else _not_seen(gains)),
            *_leading(law.terms.leaders, recording.coordinates),
        ),
        steps=findings.steps,
        num_samples=len(recording),
        seconds=findings.seconds,
        ended="every length of arcs was fitted",
        flaws=tuple(flaws),
        symbols=(names.coordinates, names.speeds),
        rival=rival(fit, names.coordinates) or _hidden(fit, names.coordinates, tuple(channels)),
    )


def line_of(recording: Recording, found: GaugedLaw) -> str:
    """L and R of a law, before its bands are known."""
    lagrangian, friction = _expressions(found, Names.of(recording))
    return f"L = {lagrangian}; R = {friction}"


def formula_of(recording: Recording, found: GaugedLaw) -> str:
    """L and R of a law, as Python writes them."""
    lagrangian, friction = _expressions(found, Names.of(recording))
    return f"L = {lagrangian.formula}; R = {friction.formula}"


def _standard_errors(
    best: CalibratedLaw | GaugedLaw,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Standard errors of the terms of L, of R, of the gains (d, m), and of the last coefficient,
    the rate γ of uniform friction where there is one; NaN of terms that are not determined."""
    std = np.sqrt(np.maximum(np.diag(best.covariance), 0.0))
    law, open_, wider = best.law, best.fit.undetermined, widened(best.fit)
    of_terms, of_losses, rest = np.split(std, np.cumsum([law.terms.count, law.friction.count]))
    rows = [("term", row) for row in best.fit.structure.terms]
    of_terms *= [wider.get(row, 1.0) for row in rows]
    of_terms[[row in open_ for row in rows]] = np.nan
    return of_terms, of_losses, rest[: law.gains.size].reshape(law.gains.shape), float(std[-1])


def _expressions(best: CalibratedLaw | GaugedLaw, names: Names) -> tuple[Formula, Formula]:
    """L and Rayleigh's R; uniform friction enters R as γ T."""
    law = best.law
    of_terms, of_losses, _, of_rate = _standard_errors(best)
    lagrangian = terms_of(law.terms, law.coefficients, of_terms, names)
    friction = friction_of(law.friction, law.losses, of_losses, names)
    if law.powers is not None:
        lagrangian = of_systems(lagrangian, law.powers[: law.terms.count], names.parameters)
        of_friction = law.powers[law.terms.count :][: law.friction.count]
        friction = of_systems(friction, of_friction, names.parameters)
    if law.uniform == 0:
        return lagrangian, friction
    kinetic = tuple(
        term for term, row in zip(lagrangian.terms, law.terms.rows(), strict=True) if any(row[0])
    )
    uniform = Term(f"({Formula(kinetic).formula})", float(law.uniform), of_rate)
    return lagrangian, Formula((*friction.terms, uniform))


def _gains(best: CalibratedLaw, recording: Recording) -> Gains:
    """Input -> its force on each position, with the standard error."""
    gains, std = best.law.gains, _standard_errors(best)[2]
    return {
        u: {q: (float(gains[i, j]), float(std[i, j])) for i, q in enumerate(recording.coordinates)}
        for j, u in enumerate(recording.inputs)
    }


def _zeros_and_sensors(
    fit: LawFit, recording: Recording
) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]]:
    """Zeros of angles and parameters of sensors by name, with their standard errors."""
    first = fit.form.count
    std = fit.linearised.errors[first:]
    fitted = list(zip(map(float, fit.p[first:]), map(float, std), strict=True))
    where = fit.structure.zeros
    zeros = {recording.coordinates[i]: one for i, one in zip(where, fitted, strict=False)}
    keys = fit.structure.keys()[first + len(where) :]
    return zeros, {name: one for (_, name), one in zip(keys, fitted[len(where) :], strict=True)}


def _flaws(best: CalibratedLaw, found: Mapping[str, Whiteness]) -> dict[str, str]:
    """Reasons why the law is not all of the motion, or is not reliable -> their remedy."""
    flaws = {
        f"the law explains only {one.fit_percent:.0f} % of the variation of {name}, and the rest "
        "is not noise": "a force, an input or a change of the sensor is missing. law.png "
        "(fit.traces) shows when"
        for name, one in found.items()
        if one.fit_percent < Options.followed and not one.white
    }
    rms, noise = best.fit.along_periods.rms(), best.fit.problem.scales.sigma
    missed = np.sqrt(np.maximum(rms**2 - noise**2, 0.0)) / best.fit.spread
    scales = best.fit.problem.scales
    for (name, one), size, sigma, share in zip(found.items(), rms, noise, missed, strict=True):
        much = size > Options.beyond * sigma or share > Options.missed
        if one.white or not Options.followed <= one.fit_percent < Options.nearly or not much:
            continue
        over, remedy = one.smoothed_over(scales.period), ""
        if over:
            remedy = (
                f"its readings look smoothed, over {over:.2g} s. Learn from those before they "
                f"were, or from readings further apart (--every {round(over / scales.dt)})"
            )
        flaws[
            f"the residuals of {name} are correlated, {size:.2g} rms where its readings scatter by "
            f"{sigma:.1g}, and {one.fit_percent:.1f} % of its variation is followed"
        ] = remedy or ("a force, an input or a term is missing. law.png (fit.traces) shows when")
    least = np.min(best.calibration.median, axis=0, initial=np.inf)
    beyond = np.isfinite(least) & (least > Options.lost)
    if beyond.any() and np.max(best.fit.sigma / best.fit.spread) < Options.lost / 2:
        flaws["half of the forecasts of held-out parts err by a fifth of the spread"] = (
            "the law fits this record and no other part of it: record a longer motion, or more "
            "samples a period"
        )
    if not best.fit.fitted.converged:
        flaws["the fit of the law did not converge"] = (
            "its coefficients and standard errors are not reliable. Fit a shorter part of the "
            "record (--from, --to) or fewer terms (--terms)"
        )
    worst = min(one.fit_percent for one in found.values())
    if best.choice.gains and worst < Options.complete:
        flaws["the record gains energy that no input explains"] = (
            "a force is missing beside the inputs that are named"
            if best.law.num_inputs
            else "if the system is driven, name its drive: --inputs NAME; if not, it "
            "excites itself, as friction below zero does, which is no term of R"
        )
    return flaws | _trend(best.fit, bool(flaws))


HIDES = "hides what another law would leave"  # of noise


def _hidden(fit: LawFit, coordinates: Sequence[str], channels: Sequence[str]) -> str:
    """Reason why other laws follow the record as well: hidden coordinates that are modes, noise
    that is a large part of a radian, or what is left of other channels, a large part of them."""
    problem = fit.problem
    if problem.observation.hidden is not None:
        return problem.observation.hidden.rivals
    angles = [coordinates[i] for i in problem.angles]
    shares = zip(channels, problem.scales.sigma, fit.rms() / fit.spread, strict=True)
    return "; ".join(
        f"noise of {f'{noise:.2g} rad in' if name in angles else f'{share:.0%} of the spread of'} "
        f"{name} {HIDES}"
        for name, noise, share in shares
        if (noise > Options.hides if name in angles else share > Options.lost / 2)
    )


def _trend(fit: LawFit, flawed: bool) -> dict[str, str]:
    """A law or a plainer one with a coefficient that changes in time, of a ``flawed`` one that of
    friction too, which explains the motion as the terms do that it lacks: with an amplitude that
    dies down these imitate what ages."""
    problem, structure = fit.problem, fit.structure
    parts = {id(n.stretch): n.stretch for n in problem.nodes}  # whose states no law has bent
    zero = np.concatenate([fit.zeros, 0 * fit.zeros])
    nodes = nodes_of([*parts.values()], problem.scales)
    nodes = [dataclasses.replace(n, x=n.x - zero) for n in nodes]
    problem = dataclasses.replace(problem, nodes=nodes)
    constant = [row for row in structure.terms if sum(row[0]) < 2 or is_constant(row)]
    textbook = libraries.textbook(structure.dim, problem.angles)
    for rubs, rows in product((False, True)[: 1 + flawed], map(tuple, (textbook, constant))):
        fewer, own = len(rows) + 1 < len(structure.terms), {*rows} == {*structure.terms}
        if not (fewer or own or flawed) or problem.parameters or max(rows[0][0]) < 2:
            continue  # of masses that all depend on position nothing constant is left
        plain = Structure(structure.dim, rows, structure.friction, (), structure.num_inputs)
        with contextlib.suppress(FitError):
            found = trend(plain, problem, rubs)
            if found is not None and found[2] < (Options.left_rubbing if rubs else Options.left):
                flaw = f"{problem.word(found[0])} may change along the record, by {found[1]:+.1%}"
                flaw += " of it" + ", with fewer terms" * fewer
                why = (
                    "a system that ages, or a clock that drifts, looks so. Fit its parts one by "
                    "one (--from, --to), and compare"
                )
                return {flaw: why}
    return {}


def _not_seen(gains: Gains) -> list[str]:
    """Warnings about inputs without a force."""
    return [
        f"no force of the input {u} is seen: its gain is within {Options.clear:g} standard errors "
        f"of 0. Record a stronger or more varied {u}, or leave it out of --inputs"
        for u, forces in gains.items()
        if all(abs(gain) < Options.clear * error for gain, error in forces.values())
    ]


def _leading(leaders: tuple[int, ...], names: Sequence[str]) -> list[str]:
    """A line on coordinates that drive others, which do not act back on them."""
    if not leaders:
        return []
    first = ", ".join(names[i] for i in leaders)
    others = ", ".join(name for i, name in enumerate(names) if i not in leaders)
    return [
        f"{first} moves {others} and is not moved by it, as where a motor holds a course: terms of "
        f"both stand in the equations of {others} alone, and the law has no energy"
    ]


def about_parameters(
    recording: Recording, powers: Powers | None, most_functions: int = 1
) -> list[str]:
    """Warnings about parameters that differ from run to run: which the law, of these powers of
    them, does not depend on; and where a term has so many functions of them that it may be no more
    than an interpolation."""
    found, names = [], parameters_of(recording)
    for k, name in enumerate(names):
        values = [recording.values(name, run)[0] for run in recording.runs]
        if not any(row[k] for row in powers or ()):
            unit = f" {recording.unit(name)}" if recording.unit(name) else ""
            found.append(
                f"{name} is {min(values):g} to {max(values):g}{unit}, and no coefficient of the "
                "law depends on it, as far as this recording shows"
            )
    count = len({tuple(args_of(recording, run, names).tolist()) for run in recording.runs})
    if powers is not None and most_functions >= min(count, Options.many):
        found.append(
            f"a term has {most_functions} functions of {', '.join(names)}, and the runs are of "
            f"{count} values: other functions agree there, and forecasts between and beyond may "
            "err by more than their bands. Record further values"
        )
    return found


def named_motions(motions: Sequence[Motion], recording: Recording) -> tuple[NextMotion, ...]:
    """Motions to record, in the file's units where a column shows the coordinate."""
    named, names = [], Names.of(recording)
    for motion in motions:
        start = {
            name: float(q / recording.factors.get(name, 1.0))
            for name, q in zip(recording.coordinates, motion.start, strict=True)
        }
        units = {name: recording.unit(name) for name in start}
        gains = {word_of(k, names): g for k, g in motion.gains.items()}
        drive = None
        if motion.drive is not None:
            name = recording.inputs[motion.drive.place]
            ends = np.array(motion.drive[1:3]) / recording.factors.get(name, 1.0)
            drive = name, *ends.tolist(), motion.drive.period
        named.append(NextMotion(start, motion.interval, gains, units, motion.apart, drive))
    return tuple(named)


def _alike(fit: LawFit, lagrangian: Formula, friction: Formula) -> tuple[str, ...]:
    """Pairs of coefficients that the record cannot tell apart."""
    texts = dict(zip(fit.structure.terms, (t.term for t in lagrangian.terms), strict=True))
    texts |= dict(zip(fit.structure.friction, (t.term for t in friction.terms), strict=True))
    names = {key: texts.get(key[1], " ".join(map(str, key))) for key in fit.values}
    listed, open_ = list(names.values()), fit.undetermined
    together = [name for key, name in names.items() if key in open_]
    only = (f"{', '.join(together)}: {ONLY_TOGETHER}",) if together else ()
    if _is_of_one_energy(fit):
        only += (f"M and V, of whose motion one energy was recorded: {ONLY_TOGETHER}",)
    return only + tuple(
        f"{listed[i]} and {listed[j]} (correlation {rho:+.3f})"
        for i, j, rho in fit.linearised.collinear(Options.alike)
    )


def _is_of_one_energy(fit: LawFit) -> bool:
    """Return whether the states of a law of one coordinate have one energy, so that any M with some
    V gives the same speed at each position, and a constant mass is no plain choice."""
    masses = [row for row in fit.structure.terms if row[0] == (2,)]
    potentials = [row for row in fit.structure.terms if not any(row[0])]
    plain = all(map(is_constant, masses)) and len(potentials) < Options.series
    if fit.form.dim > 1 or plain:
        return False
    law = fit.form.lagrangian(fit.p[: fit.form.count]).at(fit.problem.args)
    q, v = np.split(fit.problem.states, 2, axis=1)
    energy = np.quantile(law.energy(q, v), (0.05, 0.95))
    moving = 0.5 * law.masses(q)[:, 0, 0] * v[:, 0] ** 2
    return bool(np.ptp(energy) < Options.energies * np.quantile(moving, 0.95))


def _energy(traces: Sequence[Trace], friction: Formula, inputs: tuple[str, ...]) -> dict[str, Any]:
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
