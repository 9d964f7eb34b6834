"""``gfnn.fit`` of states with another bracket than that of (q, p): the law ż = B(z)∇H(z), the
bracket given or found, and its map."""

import dataclasses
import time
import warnings
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.brackets import Bracket, Constant, LieAlgebra, Log, Magnetic, added
from gfnn_jax.candidates.assemble import Candidate, block_of, stepped
from gfnn_jax.coordinates import CARTESIAN, LOG
from gfnn_jax.data.recording import Recording, args_of, parameters_of
from gfnn_jax.data.roles import is_rate_of_turning, symbols
from gfnn_jax.dataset.measured_error import Tolerance, one_step_error
from gfnn_jax.dataset.runs import identified
from gfnn_jax.dataset.split import enough_to_state, split_rows
from gfnn_jax.dataset.varied import check_varied, without_constants
from gfnn_jax.errors import FitError, FitWarning, InputError
from gfnn_jax.families.expressions import parse_named, to_named_text
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.told import anything_told
from gfnn_jax.flows.lie import chart_of, law_flow
from gfnn_jax.learn.fitted import STATES_MEASURED, Choice, Fit
from gfnn_jax.learn.options import FitOptions, Watch
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.parameters import sampled
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.brackets.algebra import analysed
from gfnn_jax.models.brackets.beside import Beside
from gfnn_jax.models.brackets.find import sized
from gfnn_jax.models.brackets.lie_maps import fit_lie_map
from gfnn_jax.models.brackets.search import Data, PoissonLaw, law_of
from gfnn_jax.models.hamiltonians.fitted_law import Term, formula
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.phase_space import POISSON, Pairs, sizes
from gfnn_jax.search.search import MET

EVEN = 1e-3  # of a sampling interval: what printed times may be off by
FEW = 0.1  # of the pairs: those that may be wrong readings of positive states
_NO_MORE = "no larger library was more accurate: noise, or the library lacks a part of H (--terms)"
NOISE = 1.15  # times the noise, that the errors of a law may be which misses nothing else


def learn_poisson(data: Pairs | Recording, options: FitOptions, watch: Watch) -> Fit:
    """Learn the law and the map of states that are no (q, p): of pairs, or of a recording whose
    positions they are; the bracket is found, or given by ``options``. With learn="map" S of a map
    without a law is fitted instead, in the chart of a given bracket.

    The pairs are split as others are: the degree of the field is chosen, and the error is stated,
    by pairs that were not fitted to. H may depend on parameters and on the time of a drive. Raises
    FitError where values are missing, states are none of the bracket's, or there is no law (with a
    verdict).
    """
    bracket, tolerance = options.bracket, Tolerance.of(options)
    budget = options.budget(watch, None)
    options.refuse_others(("hamiltonian", "map"), "states with a bracket of their own")
    pairs = pairs_of_states(data) if isinstance(data, Recording) else data
    check_varied(pairs)
    n = _checked(pairs, bracket)
    names = pairs.names or (bracket.labels if bracket else tuple(f"z{i + 1}" for i in range(n)))
    given = pairs  # whose rows messages name
    pairs, left_out = without_constants(identified(pairs).pairs)
    split, every = split_rows(pairs, options.seed), _data_of(pairs)
    dt: Any = np.asarray(pairs.dt) if np.ndim(pairs.dt) else float(pairs.dt)
    train, held = every.take(np.sort(split.training)), every.take(split.validation)
    bracket, started = bracket and bracket.named(names), time.perf_counter()
    if options.learn == "map":
        learned = _generated(train, bracket)
    else:
        terms, report = _given(options.terms, (*names, *every.beside.names)), watch.on_progress
        try:
            law = law_of(train, held, names, bracket=bracket, terms=terms, on_progress=report)
        except FitError as error:
            more = _next(data, given, error.verdict)
            raise FitError(f"{error}{more}", error.verdict) from error
        learned = _of_law(law, every, float(np.median(dt)))
        left_out = [*left_out, *_without_own_step(law.bracket, given)]
    seconds, map_, law = time.perf_counter() - started, learned.map_, learned.law
    watch.on_progress(f"compiling the step of {learned.label}")
    test = split.test if len(split.test) else split.validation
    tested = pairs.take(test)
    own_dt = tested.dt if np.ndim(dt) else None
    steps = stepped(map_, np.asarray(tested.z0), own_dt, tested.args)
    off = np.where(steps.failed[:, None], np.nan, steps.images) - np.asarray(tested.z1)
    error = one_step_error(off, every.spread[:n], tolerance, split.stretch[test])
    # both states of a pair have the noise that its sequence tells
    sigma, white = None, False
    if law is not None and law.sigma is not None:
        each = law.noise_of(np.asarray(tested.z1))
        sigma = np.sqrt(np.mean(each**2, axis=0))
        white = bool(np.sqrt(np.mean((off / each) ** 2)) <= NOISE * np.sqrt(2))
    candidate = Candidate.of(
        error,
        label=learned.label,
        family=learned.family.name,
        chart=learned.bracket.name,
        num_parameters=learned.family.num_parameters,
        operations=float(learned.family.operations[0]),
        train_rms=learned.relative,
        validated=True,
        fit_seconds=seconds,
        chosen=True,
        learns="map" if learned.law is None else "hamiltonian",
        newton_iterations_max=int(steps.iterations.max()),
        microseconds_per_step=steps.microseconds_per_step,
    )
    watch.on_candidate(candidate)
    met, messages = tolerance.met_by(candidate), [*left_out, *learned.notes]
    ended = MET if met else _NO_MORE
    if white and not met and sigma is not None:
        noise = ", ".join(f"{s:.2g}" for s in sigma)
        messages.append(f"the law leaves no more than the noise of the states, {noise}")
    elif not met:
        if tolerance.size_of(candidate) <= tolerance.bound:  # it is small enough, its bound is not
            ended = _too_few(pairs)
        messages.append(tolerance.missed_by(candidate, ended))
        warnings.warn(messages[-1], FitWarning, stacklevel=4)
    tested = tested.take(slice(min(STATES_MEASURED, block_of(n))))
    choice = Choice.of(
        budget,
        tested,
        candidates=(candidate,),
        asked=tolerance,
        num_pairs=len(pairs) - len(test),
        hamiltonian=learned.law and _learned(learned.law, map_, candidate, messages),
        noise=sigma,
        messages=tuple(messages),
        ended=ended,
        compile_seconds=steps.compile_seconds,
        pairs=pairs,
        stated_by=f"{len(test):,} pairs that were not fitted to",
        validation_pairs=pairs.take(split.validation),
        test_pairs=pairs.take(split.test) if len(split.test) else None,
        white=white,
        seed=options.seed,
        several=learned.law.several if learned.law else "",
    )
    return Fit(map_, choice)


def _next(data: Pairs | Recording, pairs: Pairs, verdict: str) -> str:
    """Say what to type after states had no bracket: without those that logarithms have not; as
    positions, or as (q, p) where the number of columns is even; with a bracket that is known."""
    if not verdict.startswith("no law: no "):
        return ""
    below = (np.minimum(pairs.z0, pairs.z1) <= 0).any(axis=1)
    if 0 < below.mean() <= FEW:
        call = "gfnn.fit(pairs.take((pairs.z0 > 0).all(axis=1) & (pairs.z1 > 0).all(axis=1)))"
        if isinstance(data, Recording):
            call = "the same command, once these cells are empty"
        return (
            f". Logarithms were not tried, for in {_rows(below)} a coordinate is not above 0. "
            f"Without them: {call}"
        )
    if isinstance(data, Recording):
        if not all(map(is_rate_of_turning, data.positions)):
            return ". If these are positions: gfnn.fit(recording)"
        times = np.concatenate([data.times(run) for run in data.runs])
        first, last = np.quantile(times, [0.25, 0.75])
        return (
            ". A body has a law with a bracket while no hand, motor or dry friction turns it. Take "
            f"that part of the runs, such as --from {first:.6g} --to {last:.6g}"
        )
    n = pairs.z0.shape[1]
    if n % 2:
        spins = n // 3
        known = f"so3({spins if spins > 1 else ''})"
        if n % 3:
            known = f"lie({('so3',) * spins + ('centre',) * (n % 3)})"
        return (
            ". H of a bracket that you know, for example: "
            f"gfnn.fit(pairs, model=gfnn.Hamiltonian(bracket=gfnn.Bracket.{known}))"
        )
    call = "gfnn.fit(gfnn.Pairs(pairs.z0, pairs.z1, pairs.dt, run=pairs.run))"
    return f". As positions and momenta, with friction of any kind: {call}"


def _too_few(pairs: Pairs) -> str:
    """Say how many runs to add to these, of which too few stretches are held out to bound an
    error."""
    lengths = np.unique(np.asarray(pairs.run), return_counts=True)[1]
    length = int(np.median(lengths))
    more = max(1, -((len(pairs) - enough_to_state()) // length))
    named = f"{len(lengths)} run{'s' * (len(lengths) > 1)} of {length} pairs"
    return f"{named} are too few to bound it: add {more} or more such runs"


def pairs_of_states(recording: Recording) -> Pairs:
    """Pairs of the states that a recording's positions are, each with the next of its run and the
    run's parameters; a row with a missing value is none. Raises InputError where there are fewer
    than two columns, or inputs."""
    names, parts, own = recording.positions, [], parameters_of(recording)
    if len(names) < 2:
        raise InputError(f"expected 2 or more columns of states, got {len(names)}: --positions A,B")
    if recording.inputs:
        raise InputError(
            f"a law with a bracket has no inputs, got {', '.join(recording.inputs)}. It may depend "
            "on parameters, one number of each run, and on the time of a periodic drive: "
            'gfnn.Pairs(z0, z1, dt, structure="poisson", t0=times, period=T)'
        )
    for number, run in enumerate(recording.runs):
        z, t = np.asarray(recording.array("positions", run)), recording.times(run)
        known = np.asarray(np.isfinite(z).all(axis=1))
        rows = np.flatnonzero(known[:-1] & known[1:])
        runs = np.full(len(rows), number)
        args = np.tile(args_of(recording, run, own), (len(rows), 1))
        parts.append((z[rows], z[rows + 1], t[rows + 1] - t[rows], runs, rows, args))
    z0, z1, dt, run, place, args = (np.concatenate(part) for part in zip(*parts, strict=True))
    usual = float(np.median(dt))
    even = np.abs(dt - usual).max() <= EVEN * usual
    dt = usual if even else dt
    given = dict(zip(symbols(own), args.T, strict=True)) or None
    return Pairs(z0, z1, dt, given, run=run, place=place, structure=POISSON, names=symbols(names))


def _data_of(pairs: Pairs) -> Data:
    beside = Beside.of(pairs)
    z0, z1, run, place = (np.asarray(a) for a in (pairs.z0, pairs.z1, pairs.run, pairs.place))
    z0, z1 = beside.behind(z0), beside.behind(z1, np.asarray(pairs.dt))
    return Data(z0, z1, pairs.dt, run, place, sizes(z0), beside)


def _checked(pairs: Any, bracket: Bracket | None) -> int:
    """Number n of coordinates of states that are finite. Raises FitError for other values, or
    states where the bracket has no step."""
    states = []
    for name, z in (("z0", pairs.z0), ("z1", pairs.z1)):
        z = np.asarray(z, np.float64)
        bad = np.flatnonzero(~np.isfinite(z).all(axis=1))
        if len(bad):
            raise FitError(f"{name}: {len(bad)} rows are not finite, the first is row {bad[0]}")
        states.append(z)
    if bracket is not None:
        if bracket.size != states[0].shape[1]:
            raise FitError(
                f"the bracket has {bracket.size} coordinates, the states have {states[0].shape[1]}"
            )
        outside = bracket.outside(states[0]) | bracket.outside(states[1])
        if outside.any():
            raise FitError(
                f"{bracket.undefined} in {_rows(outside)}. Without them: "
                "gfnn.fit(pairs.take(~(bracket.outside(pairs.z0) | "
                "bracket.outside(pairs.z1))), bracket=bracket)"
            )
    return states[0].shape[1]


def _rows(wrong: np.ndarray) -> str:
    """Text of pairs (N,), with the first of their rows."""
    rows = np.flatnonzero(wrong)
    named = f"[{', '.join(map(str, rows[:5]))}{', …' * (len(rows) > 5)}]"
    return f"{len(rows)} of {len(wrong)} pairs, rows {named}"


def _without_own_step(bracket: Bracket, pairs: Pairs) -> list[str]:
    """A line about states at which the step of a found algebra is not defined."""
    if not isinstance(bracket, LieAlgebra) or bracket.blocks:
        return []
    own = analysed(np.asarray(bracket.constants))
    if own.lifted is None:
        return []
    known = Bracket.lie(own.blocks, sized(own, np.asarray(pairs.z0)))
    outside = known.outside(pairs.z0) | known.outside(pairs.z1)
    return [
        f"{known.undefined} in {_rows(outside)}, where {known.name} has no step of its own: the "
        "slower one of any Lie algebra was taken"
    ]


def _given(terms, names: tuple[str, ...]) -> Terms | None:
    """Family of the terms of H that were given, as text; None without. Raises InputError for one
    that is no expression in these names."""
    if not terms:
        return None
    if anything_told(terms):
        raise InputError(
            "terms: values, bounds and ties of coefficients are of H of plain pairs, got states "
            "with a bracket: give the terms without them"
        )
    texts = tuple(dict.fromkeys(to_named_text(parse_named(t, names), names) for t in terms))
    return Terms(0, texts, tuple(map(tuple, np.eye(len(texts), dtype=int).tolist())), (), names)


class _Learned(NamedTuple):
    """A map with what its line in the table says; ``law`` where there is one."""

    map_: SymplecticMap
    bracket: Bracket
    label: str
    family: Any
    relative: float
    law: PoissonLaw | None = None
    notes: tuple[str, ...] = ()


def _of_law(law: PoissonLaw, data: Data, dt: float) -> _Learned:
    """The flow of a law over dt, what is beside the states its args."""
    own, n = law.field.library, law.bracket.size
    family = dataclasses.replace(own, parameters=own.names[n:], names=own.names[:n])
    states = np.concatenate([_inner(data.z0[:, :n], law.bracket), data.z0[:, n:]], axis=1)
    piece = law_flow(family, law.fit.c, law.bracket, dt, states, law.field.friction)
    map_ = _map(piece, law.bracket, data, dt, Posterior(0, law.fit.root))
    label = f"H of {family.num_parameters} terms"
    return _Learned(map_, law.bracket, label, family, law.fit.relative, law, law.notes)


def _generated(data: Data, bracket: Bracket | None) -> _Learned:
    """The map without a law that S generates in the chart of a bracket. Raises FitError without a
    bracket, and for pairs of several dt, parameters or a drive."""
    if data.beside.names:
        raise FitError(
            f"a map without a law is one of one system, got {', '.join(data.beside.names)}. A law "
            "may depend on them: gfnn.fit(pairs, model=gfnn.Hamiltonian(bracket=bracket))"
        )
    if bracket is None:
        model = "model=gfnn.GeneratingFunction(bracket=gfnn.Bracket.so3())"
        raise FitError(f"a map without a law needs its bracket, such as {model}")
    if np.ndim(data.dt):
        raise FitError("a map without a law is one of pairs with one dt")
    y0, y1 = (_inner(z, bracket) for z in (data.z0, data.z1))
    found = fit_lie_map(y0, y1, chart_of(bracket), data.dt)
    map_ = _map(found.piece, bracket, data, data.dt)
    label = f"S of degree {found.degree}"
    return _Learned(map_, bracket, label, found.piece.family, found.error)


def _inner(z: np.ndarray, bracket: Bracket) -> np.ndarray:
    """States as pieces have them."""
    return np.log(z) if isinstance(bracket, Log) else z


def _map(piece, bracket: Bracket, data: Data, dt: float, posterior=None) -> SymplecticMap:
    """The map of a piece, its domain and its parameters those of the data."""
    inner = LOG if isinstance(bracket, Log) else CARTESIAN
    z, beside = data.z0[:, : bracket.size], data.beside
    given = sampled(beside.names, beside.values, dt, beside.period) if beside.names else None
    none = np.zeros(0)  # of angles
    more: dict[str, Any] = {"parameters": given, "posterior": posterior, "bracket": bracket}
    return SymplecticMap((piece,), inner, covering(_inner(z, bracket)), sizes(z), none, dt, **more)


def _learned(law, map_, candidate, messages) -> LearnedHamiltonian:
    std = np.sqrt(np.sum(law.fit.root**2, axis=0))
    std = np.where(std > 1e-12 * np.abs(law.fit.c), std, 0.0)
    names = (*law.field.library.term_names, *_resistances(law))
    named = zip(names, law.fit.c, std, strict=True)
    every = [Term(name, float(c), float(s)) for name, c, s in named]
    terms = tuple(every[: law.field.library.num_parameters])
    told: dict[str, Any] = {"messages": tuple(messages), "friction": tuple(every[len(terms) :])}
    told["covariance"] = lambda: law.fit.root
    return LearnedHamiltonian(candidate, map_.pieces[0], terms, formula(terms), np.nan, **told)


def _resistances(law: PoissonLaw) -> list[str]:
    """R of each part of uniform friction, with −∂R/∂z its force; "friction" where it has no R."""
    found, names = [], law.bracket.labels
    for e in () if law.field.friction is None else law.field.friction.matrices:
        e = np.where(np.abs(e) > 1e-12 * np.abs(e).max(), e, 0.0)
        squares = [(0.5 * value, f"{a}**2") for value, a in zip(np.diag(e), names, strict=True)]
        diagonal = np.count_nonzero(e) == np.count_nonzero(np.diag(e))
        found.append(f"({added(squares, '*')})" if diagonal else "friction")
    return found


MOST_COLUMNS = 8  # of states that are looked at
EXACT = 1e-9  # of the spread: a law of these that misses nothing


def other_bracket(pairs: Pairs) -> list[str]:
    """A line about the bracket of pairs: of velocities in place of momenta, of columns in another
    order, of states of another kind. None where no bracket is found, or the pairs have noise,
    parameters or a drive."""
    if pairs.args is not None or pairs.z0.shape[1] > MOST_COLUMNS:
        return []
    pairs = identified(pairs).pairs
    split, every = split_rows(pairs, 0), _data_of(pairs)
    names = tuple(f"z{i + 1}" for i in range(pairs.z0.shape[1]))
    try:
        law = law_of(every.take(np.sort(split.training)), every.take(split.validation), names)
    except FitError:
        return []
    if law.error > EXACT or law.field.friction is not None:
        return []
    what, learn = _told_apart(law.bracket)
    return [f"the columns are {what}: {law.bracket}. Learn them with {learn}"]


def _told_apart(bracket: Bracket) -> tuple[str, str]:
    """Say what columns with a bracket are, that were taken for (q, p), and how to learn them."""
    learn = 'gfnn.fit(dataclasses.replace(pairs, structure="poisson"))'
    if isinstance(bracket, Magnetic):
        return "positions and velocities in a magnetic field", learn
    if not isinstance(bracket, Constant):
        return "states with another bracket than that of (q, p)", learn
    form, d = np.round(np.asarray(bracket.form), 9), bracket.size // 2
    first, second = np.nonzero(form == 1)
    if d and len(first) == d and np.count_nonzero(form) == 2 * d:
        order = [*first.tolist(), *second.tolist()]
        moved = f"pairs.z0[:, {order}], pairs.z1[:, {order}], pairs.dt, run=pairs.run"
        return "(q, p) in another order", f"gfnn.fit(gfnn.Pairs({moved}))"
    if not form[:d, :d].any() and not form[d:, d:].any():
        return "(q, v), velocities in place of momenta, with {q, v} = M⁻¹ and p = M v", learn
    return "(q, p) in another order or scale", learn
