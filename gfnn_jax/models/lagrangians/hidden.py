"""Laws of one reading that shows several coordinates: the others are hidden.

Any choice of hidden coordinates follows one reading x alike, so that they have a *gauge*. Of a
length they are the modes of small swings, x = x_1 + x_2 + x_rest, each with its own frequency and
friction: the linear part is then unique. How their masses compare, only powers of degree 3 and 4
tell. Of an angle they are those of a chain of pendulums, cos x and cos x_hidden.

A fit starts from the oscillations that follow the reading window by window: of a length these are
the modes; of an angle they leave the coupling of the pendulums and the size of the hidden swings
open, of which several are tried along short arcs.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import combinations, combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import Allowance, Counted, within
from gfnn_jax.data.recording import Recording
from gfnn_jax.data.roles import symbols
from gfnn_jax.dataset.stretches import arcs_of
from gfnn_jax.errors import FitError, InputError, OutOfTime
from gfnn_jax.families.friction import LINEAR
from gfnn_jax.fitting.evidence import criterion
from gfnn_jax.maps.observation import Hidden
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.input_rules import InputModel
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
from gfnn_jax.models.lagrangians.search import SearchResult, TermSearch, to_longer_arcs
from gfnn_jax.models.lagrangians.starts import OPTIONS as STARTS
from gfnn_jax.models.lagrangians.starts import misfit
from gfnn_jax.models.lagrangians.structure import Key, Row, Structure
from gfnn_jax.signals.oscillations import Oscillations, oscillations


@dataclasses.dataclass(frozen=True)
class HiddenOptions:
    """Starts of laws with hidden coordinates (`benchmarks/any_record.py`, hidden).

    periods: lengths of arcs, in periods of the slowest oscillation. degrees: of the powers of
    modes, first of forces that are odd, as of most springs, then of all where these leave more than
    noise. couplings: squares of c in ½v² + c v w + ½w², of two pendulums, and sizes: of the hidden
    swings, times those that are seen, that are tried. finished: starts that are followed on, and
    sets of oscillations that are tried with all powers.
    damped: of the critical friction, at the start. most: numbers of steps and of their derivatives
    that a search may take, about as many as any whose law was right; each: that one start of modes
    may.
    """

    periods: tuple[float, ...] = (0.75, 1.5, 3.0, 6.0, 12.0)
    degrees: tuple[tuple[int, ...], ...] = ((4,), (3, 4))
    couplings: tuple[float, ...] = (0.1, 0.3, 0.6, 0.85)
    sizes: tuple[float, ...] = (0.5, 1.0, 2.0)
    finished: int = 3
    damped: float = 0.003
    most: float = 5e8
    each: float = 5e7


OPTIONS = HiddenOptions()
NOT_HIDDEN = "No law with one or two hidden coordinates follows to the noise"


def may_hide(recording: Recording) -> bool:
    """Return whether a recording is of one position, as it is, and of nothing else."""
    others = recording.observe or recording.inputs or recording.parameters
    return len(recording.positions) == 1 and not others


def with_number(
    find: Callable[..., LearnedLaw], recording: Recording, plain: LearnedLaw | None
) -> LearnedLaw | None:
    """The likeliest of the laws that ``find(hidden=)`` has for one and for two hidden coordinates
    of a recording, beside the ``plain`` one of none, with a message on their number. One more is
    tried where the residuals are more than noise and not white. None where no law with a hidden
    coordinate leaves noise alone."""
    laws = {} if plain is None else {0: plain}
    for count in range(1, 2 if recording.angles else 3):
        with contextlib.suppress(FitError, np.linalg.LinAlgError):
            laws[count] = find(hidden=count)
            if _leaves_noise(laws[count]):
                break
    if not {*laws} - {0}:
        return None
    (name,) = laws[max(laws)].observe
    scores = {n: _criterion(law, name) for n, law in laws.items()}
    best = min(scores, key=lambda n: scores[n])
    law = laws[best]
    if best == 0 or law.flaws or not _leaves_noise(laws[max(laws)]):
        return None
    others = [f"{n}: {more - scores[best]:+.0f}" for n, more in scores.items() if n != best]
    line = (
        f"{name} shows {1 + best} coordinates: {best} hidden, by Schwarz's criterion"
        + f" (with {', '.join(others)})" * bool(others)
    )
    return dataclasses.replace(law, messages=(*law.messages, line))


def _leaves_noise(law: LearnedLaw) -> bool:
    """Return whether the residuals of a law are white, or hardly larger than the noise."""
    return all(
        one.white or law.residual[name] < STARTS.white * law.noise[name]
        for name, one in law.whiteness.items()
    )


def _criterion(law: LearnedLaw, name: str) -> float:
    """Schwarz's criterion of a law, by what it leaves of a column; a state begins each arc."""
    fitted = [*law.lagrangian.terms, *law.friction.terms, *law.sensors]
    states = 2 * len(law.symbols[0]) * len(law.traces)
    return criterion(law.residual[name] ** 2, law.num_samples, len(fitted) + states)


def with_hidden(recording: Recording, count: int) -> Recording:
    """The recording with so many coordinates beside its one position that no column shows.

    Raises InputError where it has more than one position, or sensors or inputs, FitError where its
    spectrum does not show as many oscillations.
    """
    if not may_hide(recording) or count > 2:
        raise InputError(
            "hidden: expected a recording of one position, without inputs, parameters and formulas "
            "of sensors, and one or two hidden coordinates"
        )
    (name,) = recording.positions
    if name in recording.angles and count > 1:
        raise InputError("hidden: of an angle one hidden coordinate at the most")
    longest = max(recording.runs, key=lambda run: len(recording.times(run)))
    y = recording.unwrapped(name, longest)
    sets = oscillations(recording.times(longest), y, 1 + count)
    if not sets:
        raise no_hidden_law(count)
    sensor = _sensor(recording, name, sets[0], float(np.nanmean(y)))
    names = [n for n in (*recording.velocities, *recording.momenta) if n in recording.columns]
    return recording._with(
        positions=(),
        velocities=(),
        momenta=(),
        ignored=(*recording.ignored, *names),
        sensors=(name,),
        coordinates=sensor.names,
        angles=sensor.names if name in recording.angles else recording.angles,
        observe={name: sensor},
    )


def no_hidden_law(count: int, law: Any = None, after: str = "") -> FitError:
    """Error where no law with so many hidden coordinates follows, but ``law`` in part."""
    return FitError(
        f"no law with {count} of its coordinates hidden follows the column{after}: ask for fewer, "
        f"--hidden {count - 1}, or record another column",
        f"no law: none with {count} hidden coordinates follows the recording",
        law,
    )


def _sensor(recording: Recording, name: str, found: Oscillations, mean: float) -> Hidden:
    """Sensor of the modes of a length, or of an angle, whose hidden one starts as its first."""
    count, code = len(found.omega), symbols((name,))[0]
    rest = f"{code}_rest"
    omega = tuple(map(float, found.omega))
    if name in recording.angles:
        names = (f"{code}_seen", f"{code}_hidden")
        return Hidden(names, (1.0, 0.0), omega, ((1.0, 1.0), (1.0, 0.0)), rest, mean)
    names = tuple(f"{code}_{k + 1}" for k in range(count))
    eye = tuple(map(tuple, np.eye(count).tolist()))
    return Hidden(names, (1.0,) * count, omega, eye, rest, mean)


def search_hidden(problem: ArcProblem) -> SearchResult:
    """The law of a problem whose channel shows several coordinates, from the first set of
    oscillations that leads to one which leaves noise alone, else from the best. Where it has taken
    what it may, what was found by then stands.

    Raises FitError where no start follows the arcs to some times their noise, or to the noise.
    """
    most = STARTS.followed if problem.options.partly else STARTS.noise
    cap, found = Counted(OPTIONS.most), list[LawFit]()
    capped = dataclasses.replace(problem, allowance=Allowance(cap=cap))
    with contextlib.suppress(OutOfTime):
        for start in _starts(capped, cap):
            fit = _along_longer_arcs(start, most)
            problem.on_progress(f"from oscillations: {fit}")
            if misfit(fit) < most:
                found.append(fit)
                if misfit(fit) < STARTS.white:
                    break
    if not found:
        raise no_hidden_law(problem.dim - 1, after=_spent(cap))
    best = min(found, key=misfit)
    fewer = partial(TermSearch(best.structure, None).prune, best)
    fit = within(contextlib.nullcontext(), fewer) or best
    fit = fit if misfit(fit) < most else best  # a mass below zero, say
    sensor = _following(fit)
    observation = dataclasses.replace(fit.problem.observation, formulas=(sensor,))
    freed = {"allowance": problem.allowance, "observation": observation}
    fit = dataclasses.replace(fit, problem=dataclasses.replace(fit.problem, **freed))
    choice = FrictionChoice(fit.structure.friction, {}, {}, False)
    ended = _spent(cap) and (
        f"the search ended{_spent(cap)}: terms that the record does not show may be left in the law"
    )
    return SearchResult(InputModel(fit), choice, ended=ended)


def _spent(cap: Counted) -> str:
    """The text of what a search has taken, where that was all it might, else ""."""
    return f" after {cap.most:.0e} operations" if cap.spent > cap.most else ""


def _from(problem: ArcProblem, found: Oscillations) -> ArcProblem:
    """The problem whose states start from these oscillations, with arcs of their periods."""
    sensor = dataclasses.replace(_sensor_of(problem), omega=tuple(map(float, found.omega)))
    observation = dataclasses.replace(problem.observation, formulas=(sensor,))
    slow = 2 * np.pi / (min(sensor.omega) * problem.scales.period)
    periods = tuple(slow * n for n in OPTIONS.periods)
    options = dataclasses.replace(problem.options, periods=periods)
    return dataclasses.replace(problem, observation=observation, options=options)


def _following(fit: LawFit) -> Hidden:
    """The sensor whose states start as the orbits of a fit have them, by least squares."""
    sensor, (rest,), rows = _sensor_of(fit.problem), fit.sensors, []
    for n in fit.problem.nodes:
        found = sensor.oscillations.parts(n.t, n.y[:, 0] - rest)
        own = np.split(n.x, 2, axis=1)
        rows += [np.concatenate(pair, axis=1) for pair in zip(found, own, strict=True)]
    known, shown = np.split(np.concatenate(rows), 2, axis=1)
    shapes = np.linalg.lstsq(known, shown)[0]
    return dataclasses.replace(sensor, shapes=tuple(map(tuple, shapes.tolist())))


def _sensor_of(problem: ArcProblem) -> Hidden:
    sensor = problem.observation.hidden
    assert sensor is not None
    return sensor


def _starts(problem: ArcProblem, cap: Counted) -> Iterator[LawFit]:
    """Starts from each set of oscillations: of pendulums along short arcs, of modes along longer
    ones too, for along short ones wrong modes leave less than those that are right and have not
    converged. Of modes those that leave noise alone as soon as they are found, then the best of the
    others; first with odd forces, then, from the best sets, with all."""
    longest = max(problem.nodes, key=lambda n: len(n.t))
    found = oscillations(longest.t, longest.y[:, 0], problem.dim)
    sets = [_from(problem, one) for one in found]
    if problem.angles:
        yield from (fit for one in sets for fit in _best_pendulums(one))
        return
    for degrees in OPTIONS.degrees:
        left, others = np.full(len(sets), np.inf), list[LawFit]()
        for k, one in enumerate(sets):
            fit = within(_at_most(cap, OPTIONS.each), partial(_along_two, one, degrees))
            if fit is None:
                continue
            left[k] = misfit(fit)
            if left[k] < STARTS.white:
                yield fit
            elif left[k] < STARTS.followed:
                others.append(fit)
        yield from sorted(others, key=misfit)[: OPTIONS.finished]
        sets = [sets[k] for k in np.argsort(left)[: OPTIONS.finished]]


@contextlib.contextmanager
def _at_most(cap: Counted, operations: float) -> Iterator[None]:
    """Context in which a search takes no more than so many of its operations."""
    most, cap.most = cap.most, min(cap.most, cap.spent + operations)
    try:
        yield
    finally:
        cap.most = most


def _best_pendulums(problem: ArcProblem) -> Iterator[LawFit]:
    """The best starts of pendulums; again where a fit that does not follow short arcs yet has not
    converged. Longer arcs, which tell more, converge sooner."""
    for fit in sorted(_of_pendulums(problem), key=misfit)[: OPTIONS.finished]:
        yield fit if misfit(fit) < STARTS.followed or fit.fitted.converged else fit.again()


def _along_longer_arcs(fit: LawFit, most: float) -> LawFit:
    """A start along longer and longer arcs, as far as it follows them to ``most`` times the noise,
    or may do so once it converges."""
    nodes, known = fit.problem.nodes, fit.arcs.t.shape[1]
    lengths = map(fit.problem.length, fit.problem.options.periods[1:])
    for length in [n for n in lengths if arcs_of(nodes, n).t.shape[1] > known]:
        if misfit(fit) > (most if fit.fitted.converged else STARTS.followed):
            break
        if (longer := to_longer_arcs(fit, length)) is None:
            break
        fit = longer
    return fit


class _Shape(NamedTuple):
    """A start: coefficients that are known, and coordinates (d, d) of each oscillation."""

    known: dict[Key, float]
    shapes: np.ndarray


def _started(problem: ArcProblem, shapes: np.ndarray) -> ArcProblem:
    """The problem with the states that a shape makes of the oscillations."""
    sensor = dataclasses.replace(_sensor_of(problem), shapes=tuple(map(tuple, shapes.tolist())))
    nodes = [
        dataclasses.replace(n, x=np.concatenate(sensor.states(n.t, n.y[:, 0]), axis=1))
        for n in problem.nodes
    ]
    return dataclasses.replace(problem, nodes=nodes)


def _along_two(problem: ArcProblem, degrees: Iterable[int]) -> LawFit:
    """Modes along short arcs, and along longer ones where their orbits follow these."""
    fit = _of_modes(problem, degrees)
    if misfit(fit) > STARTS.followed:
        return fit
    return to_longer_arcs(fit, problem.length(problem.options.periods[1])) or fit


def _of_modes(problem: ArcProblem, degrees: Iterable[int]) -> LawFit:
    """Short arcs fitted by modes of small swings, and powers of these degrees that couple them, all
    at once: by modes alone two of the frequencies become one where they depend on the swings."""
    sensor, d = _sensor_of(problem), problem.dim
    none = (0,) * d
    masses = [(libraries.unit(d, i, i), none, none, 0.0) for i in range(d)]
    springs = [(none, libraries.unit(d, i, i), none, 0.0) for i in range(d)]
    powers = [
        (none, libraries.unit(d, *axes), none, 0.0)
        for degree in degrees
        for axes in combinations_with_replacement(range(d), degree)
    ]
    # by relative speeds of any two: modes have no neighbours
    pairs = [tuple((b - a).tolist()) for a, b in combinations(np.eye(d, dtype=int), 2)]
    friction = tuple(libraries.losses(d, (LINEAR,), 0.0, joints=pairs))
    known: dict[Key, float] = {("term", row): 0.5 for row in masses}
    for spring, loss, w in zip(springs, friction[:d], sensor.omega, strict=True):
        known |= {("term", spring): -0.5 * w**2, ("loss", loss): OPTIONS.damped * w}
    structure = Structure(d, (*masses, *springs, *powers), friction, (), 0, problem.sensors)
    problem = _started(problem, np.eye(d))
    arcs = problem.arcs(problem.options.periods[0])
    return problem.fit(structure, known, arcs, problem.scales.sigma, rescale=False)


def _of_pendulums(problem: ArcProblem) -> list[LawFit]:
    """Short arcs fitted by two pendulums from several couplings and sizes of the hidden swings."""
    terms = libraries.textbook(2, (0, 1))
    friction = tuple(libraries.losses(2, (LINEAR,), 0.0))
    structure = Structure(2, tuple(terms), friction, (), 0, problem.sensors)
    found = []
    for known, shapes in _pendulums(problem, terms):
        known |= {("loss", row): OPTIONS.damped * problem.scales.omega for row in friction[:2]}
        some = _started(problem, shapes)
        arcs = some.arcs(problem.options.periods[0])
        found.append(some.fit(structure, known, arcs, problem.scales.sigma, rescale=False))
    return [fit for fit in found if fit.follows and fit.is_definite]


def _pendulums(problem: ArcProblem, terms: list[Row]) -> Iterator[_Shape]:
    """Pendulums ½v² + c v w + ½w² − ½a x² − ½b y² of the two frequencies, and their modes, with y
    in other units."""
    sensor = _sensor_of(problem)
    squares = np.array(sensor.omega) ** 2
    size = np.concatenate(
        [sensor.oscillations.parts(n.t, n.y[:, 0] - sensor.start)[0] for n in problem.nodes]
    )
    for coupling in OPTIONS.couplings:
        total, product = (1 - coupling) * squares.sum(), (1 - coupling) * squares.prod()
        if total**2 < 4 * product:
            continue
        c, root = np.sqrt(coupling), np.sqrt(total**2 - 4 * product)
        for a in ((total + root) / 2, (total - root) / 2):
            ratio = (a - squares) / (c * squares)
            scale = np.std(size.sum(axis=1)) / np.std(size @ ratio)
            for times in OPTIONS.sizes:
                by = times * scale
                values = {
                    ((0, 2), (0, 0)): 0.5 / by**2,
                    ((1, 1), (1, -1)): c / by,
                    ((0, 0), (1, 0)): a,
                    ((0, 0), (0, 1)): (total - a) / by**2,
                }
                known: dict[Key, float] = {
                    ("term", row): float(values[row[0], row[2]]) for row in terms[1:]
                }
                yield _Shape(known, np.stack([np.ones(2), by * ratio], axis=1))
