"""``gfnn.fit`` of a recording: from positions to the law behind them, with friction and inputs.

samples → nodes → search (`models.lagrangians.search`) → velocities → bands → map → traces → the law
in the recording's words (`models.lagrangians.in_words`)
"""

import contextlib
import dataclasses
import re
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial, wraps
from typing import Any

import numpy as np

from gfnn_jax.data.recording import Recording, channels_of, parameters_of
from gfnn_jax.data.roles import by_name, is_wave, symbols, wave_names
from gfnn_jax.data.traits import without_wrong_values
from gfnn_jax.dataset.stretches import (
    MOST_STEPS,
    Moving,
    Stretch,
    arcs_of,
    by_rates,
    measure,
    nodes_of,
    stretches,
    without_rests,
)
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.friction import LINEAR
from gfnn_jax.families.lagrangian import INPUTS, Lagrangian
from gfnn_jax.families.text import measured
from gfnn_jax.fitting.evidence import Rival
from gfnn_jax.flows.dormand_prince import WEIGHTS
from gfnn_jax.maps.inputs import HOLDS, Signals
from gfnn_jax.maps.laws import map_of_law, smoothed
from gfnn_jax.maps.observation import Observation, observed
from gfnn_jax.maps.sensors import OtherLaw
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.lagrangians import libraries, one_filter
from gfnn_jax.models.lagrangians.dependence import search_of_systems
from gfnn_jax.models.lagrangians.drives import hidden_frequency, with_frequency
from gfnn_jax.models.lagrangians.exchange import leaves_open, other_terms, rivals
from gfnn_jax.models.lagrangians.fine_steps import with_fine_steps
from gfnn_jax.models.lagrangians.first_order import plain_field
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit, SearchOptions
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.given_terms import given_terms
from gfnn_jax.models.lagrangians.hidden import (
    NOT_HIDDEN,
    may_hide,
    no_hidden_law,
    search_hidden,
    with_hidden,
    with_number,
)
from gfnn_jax.models.lagrangians.in_use import CalibratedLaw, GaugedLaw, RecordingData, best_in_use
from gfnn_jax.models.lagrangians.in_words import (
    HIDES,
    Findings,
    formula_of,
    in_words,
    line_of,
    named_motions,
)
from gfnn_jax.models.lagrangians.input_rules import RULES, choose_again
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
from gfnn_jax.models.lagrangians.libraries import (
    FEW,
    FRICTIONS,
    central,
    last_of_series,
    names_of,
    of_atoms,
)
from gfnn_jax.models.lagrangians.nature import NO_COLUMN, Nature, nature
from gfnn_jax.models.lagrangians.next_motion import next_motions, parting
from gfnn_jax.models.lagrangians.residuals import Trace
from gfnn_jax.models.lagrangians.rivals import (
    constant_of,
    constants,
    of_a_sensor,
    other_powers,
    unseen,
)
from gfnn_jax.models.lagrangians.search import (
    SearchResult,
    TermSearch,
    fit_given,
    search,
    search_on,
)
from gfnn_jax.models.lagrangians.starts import no_law
from gfnn_jax.models.lagrangians.text import Names, speed_names
from gfnn_jax.models.lagrangians.velocities import (
    Velocity,
    read_from_the_start,
    velocities,
    with_channels,
)
from gfnn_jax.solve.noise import Loss


def traces_of(recording: Recording, fit: LawFit, law: Lagrangian) -> tuple[Trace, ...]:
    """The arcs of a fit, channels in the file's units. An input supplies the mean of its force over
    a step times the way, and what terms that have it rise by at its mean; friction takes the mean
    of its power at the ends."""
    arcs, found, d = fit.arcs, [], fit.form.dim
    nodes, channels = fit.problem.nodes, fit.problem.observation.channels
    factors = np.array([recording.factors[name] for name in channels])
    left = fit.fitted.residuals * fit.sigma * arcs.noise
    acting = np.tensordot(fit.problem.inputs(arcs), WEIGHTS, axes=(3, 0)).mean(
        axis=2
    )  # (A, L − 1, m)
    for k, (i, a, b) in enumerate(arcs.home):
        n, stretch = b - a, nodes[i].stretch
        t, y, x = arcs.t[k, :n], arcs.y[k, :n] + nodes[i].zero, fit.fitted.x[k, :n]
        q, v = x[:, :d] + fit.zeros, x[:, d:]
        own = law.at(stretch.args)
        read = stretch.u[nodes[i].at[a:b]]
        rate = own.power(q, v, read)[0][:, : law.friction.count + (law.uniform != 0)]
        lost = 0.5 * np.diff(t)[:, None] * (rate[1:] + rate[:-1])
        u = acting[k, : n - 1]
        supplied = u * (np.diff(q, axis=0) @ law.gains)
        if law.terms.driven:
            before, after = (law.terms.potentials(x, 0, u).value for x in (q[:-1], q[1:]))
            raised = own.coefficients * (after - before)
            supplied += raised @ law.terms.first_inputs(law.num_inputs)
        read_as = y / factors, (y - left[k, :n]) / factors, fit.fitted.residuals[k, :n], read
        energies = own.energy(q, v), _summed(lost), _summed(supplied)
        found.append(Trace(stretch.run, t, *read_as, *energies))
    return tuple(found)


def _summed(steps: np.ndarray) -> np.ndarray:
    """Sums (n, ...) of steps (n − 1, ...) since the first."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


class Options:
    """Limits at which a law is refused, and at which one of shorter arcs is taken
    (`benchmarks/as_a_user.py`, `measured.py`).

    missed: of a channel's variation: no law that leaves as much follows the recording. followed: %
    of it, of which a law that is one follows more, unless the rest is noise.
    above_noise: times: such a rest is no noise. ahead: periods, from which errors of forecasts are
    the law's. imitated: share of what a sensor's parameter changes that no coefficient of the law
    does, below which it is not identifiable. still: range of a position over its size, at which it
    does not move: roundoff. periods_of_events: lengths of arcs where only events are read, two in a
    period. early: of a sample, that inputs may act before they were measured: rounding.
    """

    missed: float = 0.8
    followed: float = 70.0
    above_noise: float = 3.0
    explained: float = 0.5
    ahead: float = 0.5
    imitated: float = 1e-4
    still: float = 1e-14
    periods_of_events: tuple[float, ...] = (32.0, 1e4)
    early: float = 0.01


DRIVEN = (
    "a drive that no column shows acts at {} rad/s: its waves stand among the inputs, with the "
    "phase of the times in the file. Record the drive, and name it: --inputs"
)

FILTERED = (
    "all columns look as if they had gone through one filter, as of a logger, that turns waves of "
    "{:.4g} rad/s by {} rad and others as the cube of their frequency: the law is of what moves "
    "before it, and forecasts go through it again"
)

EARLY = (
    "their times are late, as of a filter or of a second clock: shift the column. Or they answer "
    "the motion, as a controller does, and do not drive it: name what drives it (--inputs)"
)
SERIES = (
    "terms up to {} may be a series of another shape, and hold within the "
    "motion recorded alone. Give a shape that you expect, as exp(-x), 1/x or cos(x): --terms"
)

ATOMS = (
    "{} and the power beside it are two of a few that were tried: others may follow the record as "
    "well, from another zero of the distance. Give those that you expect: --terms"
)


def _or_by_velocities(find: Callable[..., LearnedLaw]) -> Callable[..., LearnedLaw]:
    """``find``, once more with measured velocities read from the start where that helps."""

    @wraps(find)
    def found(recording: Recording, **options: Any) -> LearnedLaw:
        law, missed = None, None
        try:
            law = find(recording, **options)
        except FitError as error:
            missed = error
        sure = law is not None and not law.flaws and HIDES not in law.rival
        with contextlib.suppress(FitError):
            wider = None if sure or options["hidden"] else read_from_the_start(recording)
            better = None if wider is None else find(wider, **options)
            law = law if better is None or better.flaws else better
        if law is None:
            assert missed is not None
            raise missed
        return law

    return found


def _or_with_hidden(find: Callable[..., LearnedLaw]) -> Callable[..., LearnedLaw]:
    """``find``, where the number of hidden coordinates is None; one column that leaves what a
    coordinate may explain that no column shows tells the number."""

    @wraps(find)
    def found(recording: Recording, **options: Any) -> LearnedLaw:
        if options.get("hidden") is not None:
            return find(recording, **options)
        plain, missed, none = None, FitError(""), {**options, "hidden": 0}
        try:
            plain = find(recording, **none)
        except FitError as error:
            missed = error
        left = missed.verdict if plain is None else plain.nature
        if NO_COLUMN in left and may_hide(recording) and not options.get("terms"):
            alone = partial(find, recording, **options, partly=False)
            law = with_number(alone, recording, plain or missed.fit)
            if law is not None:
                return law
            if plain is None:
                missed = FitError(str(missed), f"{missed.verdict}. {NOT_HIDDEN}", missed.fit)
            else:
                plain = dataclasses.replace(plain, nature=f"{plain.nature}. {NOT_HIDDEN}")
        if plain is None:
            raise missed
        return plain

    return found


@_or_with_hidden
@_or_by_velocities
@np.errstate(all="ignore")  # laws that run away are part of the search
def fit_recording(
    recording: Recording,
    *,
    friction: str = "auto",
    input_hold: str = "auto",
    mass: Mapping[str, float] | None = None,
    terms: Sequence[Any] = (),
    loss: Loss | None = None,
    hidden: int | None = None,
    partly: bool = True,
    on_progress: Callable[[str], Any] = lambda message: None,
) -> LearnedLaw:
    """The law of a recording, from its positions and inputs.

    friction: "auto", "none", or kinds of `libraries.FRICTIONS`, as "linear+dry". input_hold:
    "auto", or the inputs between samples: "hold", "linear" or "band". mass: the known mass (or
    moment of inertia) of one position, which fixes the scale of L. terms: those of L, V and R, as
    text in the names of columns (`models.lagrangians.given_terms`), which are then all that is
    fitted. loss: of residuals in units of their noise; None: the soft L1 of `solve.noise`. hidden:
    coordinates beside the one position that no column shows (`models.lagrangians.hidden`); None:
    as many as the record tells. partly: such a law may leave more than noise.
    Raises InputError for bad options or a recording without positions, FitError where no law is
    found; its ``fit`` is then the `LearnedLaw` that misses most of the motion, where there is one.
    """
    started = time.process_time()
    options = dataclasses.replace(_options(friction), partly=partly)
    _check(recording, input_hold, mass)
    _check_moves(recording)
    steps: list[str] = []

    def note(line: str) -> None:
        steps.append(line)
        on_progress(line)

    notes, (recording, left_out) = recording.notes, without_wrong_values(recording)
    for line in (*notes, *left_out):
        note(line)
    recording = with_hidden(recording, hidden) if hidden else recording

    def searched(recording: Recording, *rules: str) -> tuple[RecordingData, SearchResult]:
        data = samples_of(recording, loss, options=options, on_progress=note)
        data = dataclasses.replace(data, mass=mass or {})
        try:
            return _found(data, terms, rules)
        except FitError as error:
            raise _with_nature(error, data) from None

    rules = _rules(recording, input_hold)
    data, found, of_drive = _with_hidden_drive(recording, searched, rules)
    data, found, of_filter = _before_filter(
        data, found, lambda recording: searched(recording, *rules)
    )
    recording, messages = data.recording, (*left_out, *of_drive, *of_filter)
    missed = no_law(data.problem.scales) if _misses(found.fit) else None
    explained = False
    try:
        best, findings = _findings(recording, data, found, messages, steps)
        findings = findings._replace(seconds=time.process_time() - started)
        law = in_words(recording, best, findings)
        if not terms and not hidden:
            messages = (*law.messages, *_with_constants(best.fit))
            coloured = [one for one in law.whiteness.values() if law.flaws and not one.white]
            over = [one.smoothed_over(data.problem.scales.period) for one in coloured]
            sensor, explained = of_a_sensor(best.fit, any(over) and all(over))
            rival = law.rival or sensor
            if not rival:
                rival = "; ".join(filter(None, (unseen(best.fit), _other_shapes(best.fit))))
            law = dataclasses.replace(law, rival=rival, nature=sensor, messages=messages)
            law = law if law.flaws else _with_rivals(law, recording, data, best.fit)
    except (FitError, np.linalg.LinAlgError):
        if missed is not None:
            raise _with_nature(missed, data) from None
        raise
    lost = _loses_a_channel(law)
    if _is_no_law(law) or (hidden and (lost or _gains_energy(best.fit))):
        missed = missed or no_law(data.problem.scales)
    if missed is None and (law.flaws or lost) and not hidden and (lost or not explained):
        what = _nature(data)
        if law.nature:  # a sensor, beside which the law may leave much too
            law = dataclasses.replace(law, nature=f"{law.nature}; {what.reason}")
        elif what.mostly if lost else what.partly:
            law = dataclasses.replace(law, nature=what.reason)
        else:
            missed = no_law(data.problem.scales)
    if missed is not None:
        missed.fit = law
        raise _with_nature(missed, data)
    return _with_early_inputs(law, data.problem.scales.dt)


def _with_early_inputs(law: LearnedLaw, dt: float) -> LearnedLaw:
    """The law, with a flaw where its inputs act before they were measured."""
    delay, error = law.delay or (0.0, 0.0)
    if not -delay > max(error, Options.early * dt):
        return law
    flaw = f"inputs act {measured(-delay, error)} s before they were measured"
    messages = (*law.messages, f"{flaw}: {EARLY}")
    return dataclasses.replace(law, flaws=(flaw, *law.flaws), messages=messages)


def _other_shapes(fit: LawFit) -> str:
    """A line on terms of other shapes that follow a record as the law does, "" where none do."""
    last, of_atom = last_of_series(fit.structure.terms), of_atoms(fit.structure.terms)
    if last is not None:
        return SERIES.format(fit.problem.word(("term", last)))
    if of_atom is not None:
        return ATOMS.format(fit.problem.word(("term", of_atom)))
    return other_powers(fit, symbols(fit.problem.observation.coordinates))


def _with_rivals(
    law: LearnedLaw, recording: Recording, data: RecordingData, fit: LawFit
) -> LearnedLaw:
    """The law with those that are one exchange of terms away and follow a record as well, and the
    motion that tells them apart as the first to record next."""
    every, d = TermSearch.of(fit.problem).every_beside(fit), fit.problem.dim
    if 1 < d <= FEW and not fit.problem.angles:  # about as round an orbit any of them turns
        every = every.plus([("term", central(d, a)[0]) for a in (-1.0, 1.0, 3.0, 4.0)])
    found = [] if fit.problem.parameters else rivals(fit, every)
    if not found:
        return law
    laws = [GaugedLaw.of(data, one.fit) for one in found]
    logs = np.array([0.0, *(-one.above / 2 for one in found)])
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    listed = tuple(
        Rival(
            formula_of(recording, other),
            float(np.exp(one.above / 2)),
            other_terms(fit, other.fit),
            leaves_open(fit, one),
        )
        for other, one in zip(laws, found, strict=True)
    )
    others = tuple(map(OtherLaw, (one.law for one in laws), shares[1:].tolist()))
    map_: Any = law.map
    map_ = dataclasses.replace(map_, sensors=dataclasses.replace(map_.sensors, rivals=others))
    motions = named_motions(parting(fit, [one.fit for one in found]), recording)
    motions = (*motions, *law.next_motions)
    return dataclasses.replace(law, map=map_, rivals=listed, next_motions=motions)


def _is_no_law(law: LearnedLaw) -> bool:
    """Return whether a law leaves nearly all of every channel."""
    least = 100 * (1 - Options.missed)
    return all(one.fit_percent < least for one in law.whiteness.values())


def _loses_a_channel(law: LearnedLaw) -> bool:
    """Return whether a law leaves much of a channel that is no noise."""
    return any(
        one.fit_percent < Options.followed
        and not one.white
        and law.residual[name] > Options.above_noise * law.noise[name]
        for name, one in law.whiteness.items()
    )


def _gains_energy(fit: LawFit) -> bool:
    """Return whether some motion gains energy by the linear friction of a law for certain: each of
    hidden modes may have a negative coefficient, but not all of them together."""
    keys = fit.structure.keys()
    own = [k for k, (kind, row) in enumerate(keys) if kind == "loss" and row[1] == LINEAR]
    along = np.array([keys[k][1][0] for k in own], float).reshape(len(own), fit.form.dim)
    values = np.array([fit.values[keys[k]] for k in own])
    power = np.linalg.eigh(along.T @ (values[:, None] * along))
    share = (along @ power.eigenvectors[:, 0]) ** 2
    error = np.sqrt(share @ fit.linearised.covariance[np.ix_(own, own)] @ share)
    rounding = 1e-9 * abs(power.eigenvalues).max()  # of friction that some motion does not feel
    return bool(power.eigenvalues[0] < -fit.problem.options.evidence.significant * error - rounding)


def _nature(data: RecordingData) -> Nature:
    recording, problem = data.recording, data.problem
    names = problem.observation.channels
    runs = [channels_of(recording, names, run)[0] for run in recording.runs]
    field = plain_field(problem, symbols(recording.coordinates))
    what = nature(data.segments, problem.scales, problem.angles, runs, field)
    unused = [name for name in recording.ignored if name in recording.factors]
    option = f"(--inputs {','.join(unused)})" if unused else "(--inputs)"
    return what._replace(reason=what.reason.replace("(--inputs)", option))


def _with_nature(error: FitError, data: RecordingData) -> FitError:
    """The error where no law was found, with what the record is."""
    sensor = data.problem.observation.hidden
    if sensor is not None:  # whose states tell nothing of the record then
        return no_hidden_law(len(sensor.names) - 1, error.fit)
    if not error.verdict:
        return error
    what = _nature(data)
    return FitError(f"{error}. The record: {what.reason}", what.verdict, error.fit)


def _findings(
    recording: Recording,
    data: RecordingData,
    found: SearchResult,
    left_out: Sequence[str],
    steps: list[str],
) -> tuple[CalibratedLaw, Findings]:
    """The law that was found, made ready for forecasts, and what its fit shows."""
    note, options = data.problem.on_progress, data.problem.options
    note(f"law (its bands follow): {line_of(recording, GaugedLaw.of(data, found.fit))}")
    (model, choice, *_), ready = _forecasting_best(found, data)
    fit = with_fine_steps(model.fit)
    measured = velocities(recording, fit)
    for name, one in measured.items():
        note(f"velocity {name}: {one.in_file(recording, name).text}")
    data, fit = _with_velocities(measured, data, fit)
    _check_identifiable(fit)
    note("bands: forecasting from windows of the record")
    best = best_in_use(data, fit, choice, ready)
    note("finding the motion to record next")
    messages = (
        *left_out,
        *data.messages,
        *_without_role(recording),
        *filter(None, [found.ended]),
        *_held(best.fit),
        *_at_bound(options, best.choice, best.law.dim),
    )
    findings = Findings(
        _map(data, best),
        traces_of(recording, best.fit.along_periods, best.law),
        next_motions(best.fit, [i for i, name in enumerate(recording.inputs) if not is_wave(name)]),
        measured,
        model,
        messages,
        tuple(steps),
        0.0,
    )
    return best, findings


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


def _with_constants(fit: LawFit) -> list[str]:
    """A message where a search has found numbers inside of shapes."""
    shapes = [row for row in fit.structure.terms if constants(row)]
    if not shapes:
        return []
    constant, _, error = constant_of(fit)
    return [
        f"the number {measured(constant, abs(constant) * error)} inside "
        f"{fit.problem.word(('term', shapes[-1]))} is fitted too"
    ]


def _without_role(recording: Recording) -> list[str]:
    """A message of columns that are inputs by their names, and that no role was given."""
    numbers = [name for name in recording.ignored if name in recording.factors]
    return [
        f"column {name} is not used: if it drives the motion, name it: --inputs"
        for name in by_name(numbers)["inputs"]
    ]


def _at_bound(options: SearchOptions, choice: FrictionChoice, dim: int) -> list[str]:
    """A message where kinds of friction were asked for that the record does not show."""
    if options.choose_friction:
        return []
    taken = set(names_of(choice.kinds))
    taken |= {"uniform"} if dim == 1 and "linear" in taken else set()  # which is the same there
    absent = [kind for kind in options.frictions if kind not in taken]
    if not absent:
        return []
    return [
        f"{' and '.join(absent)} friction was requested, and the record shows none: its "
        "coefficient is 0, the least that friction can have. fit.which_friction tells the largest "
        "that the record allows"
    ]


def _check(recording: Recording, input_hold: str, mass: Mapping[str, float] | None) -> None:
    if not recording.coordinates:
        raise InputError(f"{recording.source}: no positions. Name them: --positions")
    if input_hold not in ("auto", *HOLDS):
        raise InputError(f"expected input_hold auto, {', '.join(HOLDS)}, got {input_hold!r}")
    for name, value in (mass or {}).items():
        if name not in recording.coordinates:
            raise InputError(f"mass: no position {name} among {', '.join(recording.coordinates)}")
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"mass: expected {name} above 0, got {value}")
    if len(mass or {}) > 1:
        raise InputError("mass: one known mass fixes the scale of L; got several")


def _check_moves(recording: Recording) -> None:
    """Raises InputError where no position moves."""
    columns = [name for name in recording.positions if name in recording.columns]
    for name in columns:
        values = np.concatenate([recording.values(name, run) for run in recording.runs])
        seen = values[np.isfinite(values)]
        if len(seen) and np.ptp(seen) > Options.still * np.abs(seen).max():
            return
    if columns:
        raise InputError(
            f"{recording.source}: expected positions that move, got the same value of "
            f"{', '.join(columns)} in every sample"
        )


def _rules(recording: Recording, input_hold: str) -> tuple[str, ...]:
    """Rules between samples of the inputs that are tried."""
    if not recording.inputs:
        return ("hold",)
    return HOLDS if input_hold == "auto" else (input_hold,)


def _observation(recording: Recording) -> tuple[Observation, tuple[int, ...]]:
    """Observation of the coordinates by the columns, and the angles among them.

    Raises InputError where a sensor's parameter is one that every law has.
    """
    names = recording.coordinates
    angles = tuple(i for i, name in enumerate(names) if name in recording.angles)
    own = {name: getattr(recording, name) for name in ("offsets", "scales", "columns")}
    speeds = speed_names(names, recording.velocities)
    observation = observed(recording.observe, names, speeds, recording.guess, **own)
    unseen = [names[i] for i in observation.hidden_places()] if recording.observe else []
    if unseen and observation.hidden is None:
        raise InputError(
            f"{', '.join(unseen)}: no column shows it. Leave it out of the coordinates, or write "
            "it into a formula of a column (--observe)"
        )
    alike, told = observation.alike()
    if alike:
        one = re.compile(rf"\b{alike[0]}\b")
        texts = {n: one.sub("1", f) for n, f in recording.observe.items() if isinstance(f, str)}
        typed = " ".join(f"--observe {shlex.quote(f'{n} = {f}')}" for n, f in texts.items())
        raise InputError(
            f"observe: not identifiable one by one: {', '.join(alike)}"
            + f", but {', '.join(told)} are" * bool(told)
            + f". Write a number for {alike[0]}: {typed}"
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


def samples_of(
    recording: Recording,
    loss: Loss | None = None,
    *,
    options: SearchOptions | None = None,
    on_progress: Callable[[str], object] = lambda line: None,
    differ: bool = True,
) -> RecordingData:
    """The samples of the positions, without rests, each σ as given where it is, and the problem of
    their law; all as of one system unless these ``differ`` in the recording's parameters."""
    observation, angles = _observation(recording)
    observation = observation if loss is None else dataclasses.replace(observation, loss=loss)
    parameters = parameters_of(recording) if differ else ()
    if observation.unseen:
        names = observation.channels
        own = [(recording.times(r), channels_of(recording, names, r)[0]) for r in recording.runs]
        observation = observation.balanced(own, angles)
    found = _segments(recording, observation, angles, parameters)
    offset = [i for i in observation.shifts() if i not in angles]
    if offset and not recording.guess:  # an offset starts at the middle of its coordinate
        middle = np.nanmean(np.concatenate([s.q for s in found]), axis=0)
        observation = observation.shifted(
            np.where(np.isin(range(observation.dim), offset), middle, 0.0)
        )
        found = _segments(recording, observation, angles, parameters)
    given = np.array([recording.std[name] or np.nan for name in observation.channels])
    if observation.rated:
        found = by_rates(found, observation.rated, given)
    scales, messages = measure(found), ()
    if observation.is_plain:
        moving = without_rests(found, scales)
        messages = _left_out(moving)
        for line in messages:
            on_progress(line)
        if messages:
            found, scales = moving.stretches, measure(moving.stretches)
    scales = dataclasses.replace(scales, sigma=np.where(given > 0, given, scales.sigma))
    if not np.all(scales.sigma > 0):
        name = observation.channels[int(np.argmin(scales.sigma))]
        raise InputError(
            f"{name}: the noise of its times is not known: give it in seconds, --std {name}=1e-4"
        )
    options = options or SearchOptions()
    if observation.crossed:
        options = dataclasses.replace(options, periods=Options.periods_of_events)
    nodes = nodes_of(found, scales)
    if not nodes:
        raise FitError(
            f"{recording.source}: no part of the recording is long enough beside the time in which "
            f"its motion changes, about {scales.period:.3g} s",
            verdict="no law: the motion hardly changes in the recording",
        )
    about: dict[str, Any] = {"parameters": parameters, "options": options}
    about |= {"forces": (*recording.inputs, *INPUTS[len(recording.inputs) :])}
    about["units"] = tuple(recording.units.get(name, "") for name in observation.coordinates)
    problem = ArcProblem(nodes, scales, observation, angles, on_progress=on_progress, **about)
    return RecordingData(recording, problem, found, messages=messages)


def _left_out(moving: Moving) -> tuple[str, ...]:
    """A line on what does not move, and one on what moves for less than a period."""
    lines = []
    if moving.resting:
        lines.append(
            f"{moving.resting:.3g} s at rest, or creeping to it, left out: what friction holds "
            "shows no dynamics"
        )
    if moving.short:
        lines.append(
            f"{moving.short:.3g} s in parts shorter than a period left out: they tell little more "
            "than their own state"
        )
    return tuple(lines)


def _segments(
    recording: Recording,
    observation: Observation,
    angles: tuple[int, ...],
    parameters: tuple[str, ...],
) -> list[Stretch]:
    """The segments of a recording, as the parameters of ``observation`` show its coordinates."""
    if observation.is_plain:
        return stretches(recording, parameters=parameters)
    between = observation.between

    def coordinates(y: np.ndarray, t: np.ndarray) -> np.ndarray:
        return observation.coordinates_of(y, angles, t)

    return stretches(recording, observation.channels, coordinates, parameters, between)


def _found(
    data: RecordingData, terms: Sequence[Any], rules: tuple[str, ...]
) -> tuple[RecordingData, SearchResult]:
    """The law that a search finds, or that of the terms which are given, by the best of the rules
    between samples of the inputs; of one system where nothing depends on the parameters."""
    problem = dataclasses.replace(data.problem, rules=rules, inputs=None)
    find: Callable[[ArcProblem], SearchResult | None] = search
    if problem.observation.hidden is not None:
        find = search_hidden
    elif terms:
        given = given_terms(terms, *Names.of(data.recording))
        find = partial(fit_given, given, _scale(data, bool(given.told)))
    elif problem.parameters:
        find = search_of_systems
    found = find(problem)
    if found is None:
        own: dict[str, Any] = {"options": problem.options, "on_progress": problem.on_progress}
        alike = samples_of(data.recording, problem.observation.loss, differ=False, **own)
        return _found(dataclasses.replace(alike, mass=data.mass), terms, rules)
    again = choose_again(found.model, rules, problem.length(1.0))
    if again.hold != found.model.hold:
        problem.on_progress(
            f"inputs {RULES[again.hold]}: held-out arcs choose it with the law found"
        )
        other = search_on(again) if find is search else find(problem.by_rule(again.hold))
        if other is not None and (other.follows or not found.follows):
            found = other
    if again.hold == found.model.hold:
        found = found._replace(model=found.model._replace(others=again.others))
    if not found.follows:
        raise no_law(problem.scales)
    return data, found


def _scale(data: RecordingData, told: bool) -> float:
    """The scale of L by the mass that is given. Raises InputError where coefficients are told and
    another mass than that of the first position."""
    first = data.problem.observation.coordinates[0]
    if told and {*data.mass} - {first}:
        raise InputError(f"terms: told coefficients need the mass of {first}, if any (--mass)")
    return float(data.mass.get(first, 1.0))


def _held(fit: LawFit) -> list[str]:
    """Messages about coefficients that are held at a bound, or as of equal masses."""
    held = fit.structure.held
    return [f"{fit.problem.word(('term', one.row))} {one.why}" for one in held if one.why]


def _with_hidden_drive(
    recording: Recording,
    searched: Callable[..., tuple[RecordingData, SearchResult]],
    rules: tuple[str, ...],
) -> tuple[RecordingData, SearchResult, tuple[str, ...]]:
    """The law that a search finds; where it leaves more than noise, that with a drive which nobody
    recorded, if there are no inputs, the record shows one, and noise alone is left then; and a
    message on it.

    Raises FitError where no law is found."""
    data = found = None
    missed = FitError("")
    try:
        data, found = searched(recording, *rules)
        problem, loud = data.problem, found.fit.loudest
    except FitError as error:
        missed, problem, loud = error, samples_of(recording).problem, np.inf
    seen = not recording.inputs and problem.observation.hidden is None
    searches, tried = loud > Options.above_noise and seen, list[float]()
    for stiff in (False, True) if searches else ():
        if (omega := hidden_frequency(problem, stiff, tried)) is None:
            continue
        driven = recording.driven_by(wave_names(omega))
        if found is not None and _louder_with(found.fit, driven, stiff):
            continue
        problem.on_progress(f"a drive that was not recorded: {omega:.5g} rad/s")
        tried.append(omega)
        with contextlib.suppress(FitError):
            _, law = searched(driven, "band")
            if law.fit.loudest < Options.explained * loud:
                _, omega, error = with_frequency(law.fit, omega)
                driven, law = searched(recording.driven_by(wave_names(omega)), "band")
                if law.fit.loudest < min(Options.above_noise, Options.explained * loud):
                    return driven, law, (DRIVEN.format(measured(omega, error)),)
    if data is None or found is None:
        raise missed
    return data, found, ()


def _before_filter(
    data: RecordingData,
    found: SearchResult,
    search_in: Callable[[Recording], tuple[RecordingData, SearchResult]],
) -> tuple[RecordingData, SearchResult, tuple[str, ...]]:
    """The law of what moved before one filter of all columns, where that is clearly likelier, and a
    message on the filter; else the law as it is."""
    recording, problem = data.recording, data.problem
    driven = not all(map(is_wave, recording.inputs)) and problem.observation.is_plain
    if not driven or problem.angles or problem.parameters:
        return data, found, ()

    def before(phase: float, most: int = MOST_STEPS) -> ArcProblem:
        earlier = recording.behind_filter(-phase)
        moving = _segments(earlier, problem.observation, problem.angles, problem.parameters)
        moving = without_rests(moving, problem.scales).stretches if data.messages else moving
        nodes = nodes_of(moving, problem.scales, most)
        return dataclasses.replace(problem, nodes=nodes, inputs=None)

    with contextlib.suppress(FitError, InputError):
        phase, omega = one_filter.phase_of(found.fit, before), problem.scales.omega
        if phase is None:
            return data, found, ()
        problem.on_progress(f"a filter of all columns: {phase * omega**3:.3g} rad at {omega:.4g}/s")
        own, law = search_in(recording.behind_filter(-phase))
        again = one_filter.lowest(law.fit, before, phase)
        if abs(again.phase - phase) > again.error:  # another law has another phase
            phase = again.phase
            own, law = search_in(recording.behind_filter(-phase))
        if one_filter.is_likelier(law.fit, found.fit):
            turn, error = phase * omega**3, again.error * omega**3
            said = FILTERED.format(omega, measured(turn, error))
            return dataclasses.replace(own, phase=phase), law, (said,)
    return data, found, ()


def _louder_with(fit: LawFit, driven: Recording, stiff: bool) -> bool:
    """Return whether a law leaves much of what it left by itself with the forces of a drive too,
    with the stiffnesses that it may drive, and with linear friction, which is not seen beside
    forces that a law lacks."""
    problem = samples_of(driven).problem.by_rule("band")
    d, count = problem.dim, problem.num_inputs
    rows = libraries.driven(d, problem.angles, count, problem.squares) if stiff else []
    rubs = libraries.losses(d, (LINEAR,), 0.0)[:d]
    new = [("term", row) for row in rows] + [("loss", row) for row in rubs]
    structure = dataclasses.replace(fit.structure, num_inputs=count).plus(new)
    arcs = arcs_of(problem.nodes, fit.arcs.t.shape[1])
    more = problem.fit(structure, fit.values, arcs, fit.sigma)
    return not more.loudest < Options.explained * fit.loudest


def _misses(fit: LawFit) -> bool:
    """Return whether a law leaves nearly all of the variation of every channel, or of one that is
    no noise."""
    left = fit.rms()
    missed = left > Options.missed * fit.spread
    loud = left > Options.above_noise * fit.problem.scales.sigma
    return bool(np.all(missed) or np.any(missed & loud))


def _forecasting_best(
    found: SearchResult, data: RecordingData
) -> tuple[SearchResult, list[CalibratedLaw]]:
    """The law of the longest arcs, or that of shorter ones which tell its coefficients better where
    it errs less, by more than chance makes, in forecasts of held-out data half a period and more
    ahead: before that errors are those of the states that forecasts begin with. And both, ready for
    forecasts."""
    if found.shorter is None:
        return found, []
    longer, shorter = (CalibratedLaw.of(data, f.fit, f.choice) for f in (found, found.shorter))
    ahead = Options.ahead * data.problem.scales.period
    apart = shorter.calibration.against(longer.calibration, ahead)
    data.problem.on_progress(
        f"the law of shorter arcs: held-out forecasts err by {apart.cost:.3g} times as much "
        f"(standard error {apart.error:.2g})"
    )
    if apart.apart < -apart.error:
        model = found.shorter.model._replace(others=found.model.others)
        found = found.shorter._replace(model=model)
    return found, [longer, shorter]


def _with_velocities(
    measured: Mapping[str, Velocity], data: RecordingData, fit: LawFit
) -> tuple[RecordingData, LawFit]:
    """The same, with measured velocities as further channels where they agree with the law."""
    recording, problem = data.recording, fit.problem
    used = tuple(name for name, one in measured.items() if one.used)
    if not used:
        return data, fit
    sigma = np.array([measured[name].sigma for name in used])
    places = {name: recording.velocities.index(name) for name in used}
    observation = problem.observation.beside(places)
    nodes, arcs = with_channels(recording, problem.nodes, fit.followed, used)
    own = np.concatenate([problem.scales.sigma, sigma])
    scales = dataclasses.replace(problem.scales, sigma=own)
    problem = dataclasses.replace(problem, nodes=nodes, scales=scales, observation=observation)
    fit = problem.fit(fit.structure, fit.values, arcs, np.concatenate([fit.sigma, sigma]))
    found = _segments(recording, observation, problem.angles, problem.parameters)
    found = without_rests(found, scales).stretches if data.messages else found
    return dataclasses.replace(data, problem=problem, segments=found), fit


def _check_identifiable(fit: LawFit) -> None:
    """Raises FitError where the record does not tell a sensor's parameters from the law."""
    names = fit.problem.observation.parameters
    for name, k in zip(names, range(len(fit.p) - len(names), len(fit.p)), strict=True):
        if not fit.linearised.unimitated(k) > Options.imitated:
            raise FitError(
                f"{name}: not identifiable from this record, for coefficients of the law act as it "
                "does. Write its value into --observe, or leave it out"
            )


def _map(data: RecordingData, best: CalibratedLaw) -> SymplecticMap:
    """The map of the law by the states of the fit, with the sensors that its forecasts show."""
    fit, law, names = best.fit, best.law, data.recording.inputs
    problem, d = fit.problem, fit.form.dim
    q, v = problem.states[:, :d] + fit.zeros, problem.states[:, d:]
    inputs, sensors = problem.inputs, best.calibration.law.sensors
    map_ = map_of_law(
        smoothed(best.moving, sensors.creep),
        np.concatenate([q, law.at(problem.args).momentum(q, v)], axis=1),
        problem.scales.dt,
        angles=tuple(i for i in problem.angles if not fit.structure.has_powers(i)),
        signals=Signals(names, inputs.hold, inputs.delay) if names else None,
        inputs=np.concatenate([n.stretch.u[n.at] for n in problem.nodes]) if names else None,
        parameters=() if law.powers is None else problem.parameters,
        args=problem.args,
        root=best.root,
    )
    return dataclasses.replace(map_, sensors=dataclasses.replace(sensors, phase=data.phase))
