"""Terms of other shapes that may follow a record as well as those of its law.

Beside springs r^3.5 imitates r^4 along an orbit whose distance changes little, so that a law with a
power of the distance is fitted again with the next halves of whole numbers. Powers of a length may
be a series of another shape: the weak form tells the constant inside it, and fits beside that
correct it. Laws with as many coefficients have odds by the sums of their squares
(`fitting.evidence`).
"""

import contextlib
import dataclasses
import shlex
from collections import Counter
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from gfnn_jax.data.roles import symbols
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import (
    Expression,
    factors_of,
    leaves,
    number,
    to_text,
    with_leaves,
)
from gfnn_jax.families.friction import DRY, LINEAR, PLACED, QUADRATIC, STRIBECK
from gfnn_jax.families.lagrangian import INPUTS, has_inputs, shape_of, tree_of
from gfnn_jax.fitting.evidence import criterion, improved
from gfnn_jax.maps.observation import observed
from gfnn_jax.models.lagrangians.exchange import may_be_chosen
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit, places
from gfnn_jax.models.lagrangians.libraries import (
    GAINS,
    SHAPES,
    central,
    is_centred,
    losses,
    potentials,
    shaped,
    springs,
    textbook,
    torques,
    without_forces,
)
from gfnn_jax.models.lagrangians.structure import Key, Loss, Row, Structure, is_constant
from gfnn_jax.models.lagrangians.weak_form import weak_share, weak_start

Place = tuple[float, float]  # the constant inside a shape, and its centre
Lengths = tuple[tuple[int, ...], ...]  # each a coordinate, 1, or that less another one, −1


class Options:
    """Limits of what is tried (`benchmarks/any_record.py`, `vocabulary.py`).

    most: powers of the distance to either side. series: potentials, from which on they may be the
    series of a shape. constants: inside a shape, times the range of the motion, where it begins;
    centres: of a shape, quantiles of the motion, where these begin; finer: between half and twice
    the best of them; first, close: steps of the constant, relative, and of the centre, in its
    inverse, by which these are found together; beyond: factor of the constant, to either side, at
    most; near: of what the best shape leaves of the equations
    of motion, above which another is not fitted; apart: relative, over which it is differentiated;
    imitated: share of what it changes that no coefficient does, below which it is not known;
    corrections: of it; furthest: relative, of each; settled: standard errors, within which it is
    found. noise: times it, that is no more;
    fades: of a speed's rms, between which Stribeck's friction does; ends: quantiles of the motion,
    between which centres of friction are; speeds: tried between these, and centres;
    as_fast: relative, within which it is found. clearly: of Schwarz's
    criterion, that a sensor gains where a law leaves more; explains: of what that law leaves, the
    share that the one beside the sensor may leave, where it is no noise, and of what the plain law
    leaves by itself, in squares close to it. much: of a coefficient, that a spring which is not
    seen would have to move; told: times it, up to which that is told.
    """

    most: int = 4
    series: int = 3
    constants: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
    centres: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)
    finer: int = 9
    first: float = 0.3
    close: float = 1e-3
    beyond: float = 4.0
    near: float = 8.0
    apart: float = 1e-4
    imitated: float = 1e-4
    corrections: int = 6
    furthest: float = 0.3
    settled: float = 0.1
    ends: tuple[float, float] = (0.05, 0.95)
    as_fast: float = 0.01
    speeds: int = 19
    noise: float = 2.0
    fades: tuple[float, ...] = (0.01, 0.025, 0.06, 0.15, 0.37, 0.9)
    clearly: float = 10.0
    explains: float = 0.5
    much: float = 0.5
    told: float = 10.0


SENSORS = (  # of a position q with the velocity v
    ("is not in proportion to what moves", "{q} + bend*{q}**3"),
    (
        "is read later where it is larger, as line by line",
        "{q} + late*{q}*{v} + late**2*({q}*{v}**2 + 0.5*{q}**2*{q}_ddot)",
    ),
    ("is smoothed, as by a low-pass", "{q} + smooth*{q}_ddot"),
    ("is late", "{q} - late*{v} + 0.5*late**2*{q}_ddot"),
    ("is late, as by a low-pass", "{q} - late*{v} + late**2*{q}_ddot"),
)


def with_likeliest_power(fit: LawFit) -> LawFit:
    """The fit with the likeliest powers of the distance: with a whole one where that is as good."""
    for own in _powers(fit):
        powers = _as_likely(fit, own)
        if len(powers) < 2:
            continue
        whole = {a: other for a, other in powers.items() if a.is_integer()} or powers
        best = min(whole, key=lambda a: whole[a].fitted.cost)
        if whole[best] is not fit:
            fit.problem.on_progress(f"  r**{best:g} in place of r**{own:g}: it is as likely")
            fit = whole[best].again()
    return fit


def fades(direction: Sequence[int], problem: ArcProblem) -> list[float]:
    """Speeds, to two digits, over which Stribeck's friction may fade, from the least on."""
    speed = float(problem.scales.speed @ np.abs(direction))
    return [float(f"{speed * one:.2g}") for one in Options.fades]


def _numbers(row: Loss, problem: ArcProblem) -> np.ndarray:
    """Numbers among which that of a friction is looked for: speeds over which Stribeck's may fade,
    or centres of that by the place."""
    if row[1] == PLACED:
        q = problem.states[:, : problem.dim] @ np.array(row[0], float)
        low, high = np.quantile(q, Options.ends).tolist()
        return np.linspace(low, high, Options.speeds)
    slow, *_, fast = fades(row[0], problem)
    return np.geomspace(slow, fast, Options.speeds)


def as_it_fades(row: Loss, fit: LawFit) -> Loss:
    """Stribeck's friction, or that by the place, as a fit has it. Of one that has dry friction
    alone, with the speed over which it would be seen best beside linear friction, which a slow
    fading would imitate: with another one it may not be seen at all. By the place, with the centre
    by which it would."""
    along = {one[1]: one for one in fit.structure.friction if one[0] == row[0]}
    if row[1] in along or (row[1] == STRIBECK and DRY not in along):
        return along.get(row[1], row)
    numbers = fades(row[0], fit.problem)
    if row[1] == PLACED:
        numbers = [0.0, *(float(f"{one:.2g}") for one in _numbers(row, fit.problem)[::3])]
    tried = [("loss", (*row[:2], number)) for number in numbers]
    beside = fit.structure.plus([] if LINEAR in along else [("loss", (row[0], LINEAR, 0.0))])
    larger = beside.plus(tried)
    one = fit.problem.linearised(larger, fit).added(*places(larger, beside, tried))
    return tried[int(np.argmax(one.value * one.size))][1]


def with_fading(fit: LawFit) -> LawFit:
    """The fit with the speeds over which its Stribeck friction fades, to three digits, and the
    centres of that by the place, that leave least: by the linearised problem, then by fits."""
    begun = fit
    for row in fit.structure.friction:
        if row[1] == PLACED and fit.follows:
            fit = _centred(fit, row)
        if row[1] != STRIBECK or not fit.follows:
            continue
        for _ in range(Options.corrections):
            found, other = _turned(fit, row, float(f"{_best(fit, row):.3g}"))
            if not found.follows or not found.fitted.cost < fit.fitted.cost:
                break
            change, fit, row = abs(np.log(other[2] / row[2])), found, other
            if change < Options.as_fast:
                break
    return fit if fit is begun else fit.again()


def _centred(fit: LawFit, row: Loss) -> LawFit:
    """The fit with the centre of a friction by the place that leaves least, to a tenth of its
    standard error; 0 where it may be that."""
    begun, number, error = fit, _best(fit, row), np.nan
    apart = Options.apart * np.ptp(_numbers(row, fit.problem))
    for _ in range(Options.corrections):
        found, other = _turned(fit, row, number)
        if found.follows and found.fitted.cost < fit.fitted.cost:
            fit, row = found, other
        elif fit is not begun:
            break
        size = fit.values["loss", row] / (2 * apart)
        ends = {("loss", (*row[:2], row[2] + k * apart)): k * size for k in (1, -1)}
        change, error = fit.along(ends, fit.structure.plus(list(ends)), least=Options.imitated)
        if not abs(change) > Options.settled * error:
            break
        number = row[2] + change
    if not error > 0:
        return begun
    least, (zero, _) = fit.criterion() + np.log(fit.independent), _turned(fit, row, 0.0)
    if zero.follows and zero.criterion(fit.independent) < least:
        return zero
    digits = int(np.ceil(-np.log10(Options.settled * error)))
    return _turned(fit, row, round(row[2], digits))[0]


def _turned(fit: LawFit, row: Loss, number: float) -> tuple[LawFit, Loss]:
    """The fit with another number in one friction, and that friction."""
    other = (*row[:2], number)
    turned = tuple(other if one == row else one for one in fit.structure.friction)
    known = {("loss", other) if k == ("loss", row) else k: c for k, c in fit.values.items()}
    structure = dataclasses.replace(fit.structure, friction=turned)
    return fit.again(structure, known, rescale=False), other


def _best(fit: LawFit, row: Loss) -> float:
    """The number in a friction of a fit for which the linearised problem leaves least."""
    numbers = _numbers(row, fit.problem)
    tried = [("loss", (*row[:2], float(number))) for number in numbers]
    larger, others = fit.structure.plus(tried), fit.structure.without({("loss", row)})
    near = fit.problem.linearised(larger, fit)
    whole = dataclasses.replace(near, triangle=near.triangle.rebased(-near.p))
    left = whole.added(*places(larger, others, tried)).left ** 2
    best = int(np.clip(np.argmin(left), 1, len(left) - 2))
    low, least, high = left[best - 1 : best + 2]
    bend = low - 2 * least + high
    shift = np.clip((low - high) / (2 * bend) if bend > 0 else np.sign(low - high), -1, 1)
    if row[1] == PLACED:
        return float(numbers[best] + shift * (numbers[1] - numbers[0]))
    return float(numbers[best] * (numbers[1] / numbers[0]) ** shift)


def with_viscous_as_it_fades(fit: LawFit) -> LawFit:
    """The fit with linear friction in place of quadratic beside Stribeck's, or the other way round,
    where it is likelier with the speed over which that fades then: at the speed that suits one of
    them the other is not."""
    viscous = {LINEAR: QUADRATIC, QUADRATIC: LINEAR}
    for row in fit.structure.friction:
        along = [one[1] for one in fit.structure.friction if one[0] == row[0]]
        if row[1] not in viscous or viscous[row[1]] in along or STRIBECK not in along:
            continue
        known = {**fit.values, ("loss", (row[0], viscous[row[1]], 0.0)): 0.0}
        turned = tuple(
            (row[0], viscous[row[1]], 0.0) if one == row else one for one in fit.structure.friction
        )
        structure = dataclasses.replace(fit.structure, friction=turned)
        other = with_fading(fit.again(structure, known, rescale=False))
        if other.follows and other.criterion(fit.independent) < fit.criterion():
            fit = other
    return fit


def with_a_shape(fit: LawFit) -> LawFit:
    """The fit of lengths with a shape (`libraries.SHAPES`) of one of them, or of the distance of
    two, in place of its powers, or beside springs in place of the powers that inputs are multiplied
    by, where that is likelier than these, by odds that decide, and than any other shape with as few
    coefficients."""
    structure, d = fit.structure, fit.structure.dim
    own = [row for row in structure.terms if not any(row[0])]
    driven = Counter(shape_of(row) for row in own if has_inputs(row))
    kept = tuple(row for row in structure.terms if any(row[0]) and is_constant(row))
    if driven:
        times, many = driven.most_common(1)[0]
        tried = _Shapes(fit, (*kept, *torques(1, [0]), *springs(1, [0])), (), times)
    else:
        series = own if d == 1 else [row for row in own if sum(row[1]) > 2]
        if d == 1:  # of one energy, masses that depend on the place imitate a potential
            series = [*series, *(row for row in structure.terms if row not in (*kept, *own))]
        shifted, many = fit.problem.observation.shifts(), len(series)
        plain = () if d == 1 else without_forces(potentials(d, range(d), 1, 2), shifted)
        tried = _Shapes(fit, kept, plain, "1")
    alone = many >= (2 if driven else Options.series) and not (driven and d > 1)
    if not alone or fit.problem.angles or not fit.follows:
        return fit
    lengths = [((1,),)] if d == 1 else _lengths_of(series)
    names = GAINS if driven else [name for name in SHAPES if d == 1 or not is_centred(name)]
    begun = {one: tried.nearest(*one) for one in product(names, lengths)}
    (_, length), _ = min(begun.items(), key=lambda one: one[1][1])
    close = [
        (name, *tried.closer(name, length, near))
        for (name, along), (near, _) in begun.items()
        if along == length
    ]
    count, most = fit.independent, Options.near * min(left for *_, left in close)
    found = [(fit.criterion(), len(fit.p), "", fit)]
    for name, place, left in close:
        other = tried.fitted(name, length, place) if left <= most else None
        if other is not None:
            inside = any(map(constants, other.structure.terms))  # a coefficient too
            cost = other.criterion(count) + np.log(count) * inside
            found.append((cost, len(other.p) + inside, name, other))
    least = min(cost for cost, *_ in found) + fit.problem.options.evidence.deciding
    near = [one[1:] for one in found if one[0] < least]
    fewest = [one for one in near if one[0] == min(size for size, *_ in near)]
    if any(one is fit for *_, one in near) or len(fewest) > 1:
        return fit
    (_, name, best), *_ = fewest  # others as likely have a term more
    fit.problem.on_progress(f"  {name} in place of {many} powers")
    return best.again()


@dataclasses.dataclass(frozen=True)
class _Shapes:
    """Shapes of lengths in place of powers in the law of a fit, with one number inside.

    kept: terms of the law beside them. plain: powers of degree 1 and 2 that may stand beside them
    too, but for that which makes a spring of the length. times: a function of inputs by which the
    shape is multiplied.
    """

    fit: LawFit
    kept: tuple[Row, ...]
    plain: tuple[Row, ...]
    times: str

    def structure(self, name: str, along: Lengths, place: Place) -> Structure:
        """The terms with this shape of each length ``along``, as `libraries.shaped` has it; of
        powers of q + A the constant is 2/(q + A) where the motion is closest to the zero of it."""
        if "q+A" in name:
            q = self.fit.problem.states[:, : self.fit.problem.dim] @ np.array(along).T
            place = (float(2 / place[0] - (q.min() if place[0] > 0 else q.max())), place[1])
        ends = {tuple(map(bool, one)) for one in along}
        beside = [r for r in self.plain if sum(r[1]) < 2 or tuple(map(bool, r[1])) not in ends]
        shapes = (row for one in along for row in shaped(name, place, one, self.times))
        terms = (*self.kept, *beside, *shapes)
        return dataclasses.replace(self.fit.structure, terms=tuple(dict.fromkeys(terms)))

    def left(self, name: str, along: Lengths, place: Place) -> float:
        """Share of the squares of the equations of motion that it leaves; infinite where it
        overflows."""
        with contextlib.suppress(np.linalg.LinAlgError):
            structure = self.structure(name, along, place)
            share = weak_share(structure, self.fit.problem, structure.dim == 1)
            return share if np.isfinite(share) else np.inf
        return np.inf

    def nearest(self, name: str, along: Lengths) -> tuple[Place, float]:
        """The place of a few that leaves least, and what it leaves."""
        q = self.fit.problem.states[:, : self.fit.problem.dim] @ np.array(along).T
        sizes, centres = np.array(Options.constants) / np.max(np.ptp(q, axis=0)), [0.0]
        if is_centred(name):
            centres = np.quantile(q, Options.centres).tolist()
        else:
            sizes = np.concatenate([sizes, -sizes])
        tried = {place: self.left(name, along, place) for place in product(sizes, centres)}
        return min(tried.items(), key=lambda one: one[1])

    def closer(self, name: str, along: Lengths, near: Place) -> tuple[Place, float]:
        """The place near this one that leaves least, and what it leaves."""
        constant, centre = near
        if "A" not in name:
            return near, self.left(name, along, near)
        if is_centred(name):

            def moved(by: np.ndarray) -> Place:
                return float(constant * np.exp(by[0])), float(centre + by[1] / constant)

            begin = Options.first * np.eye(3, 2, -1)
            far = np.log(Options.beyond)  # where it is a power, or a peak
            found = minimize(
                lambda by: self.left(name, along, moved(by)) if abs(by[0]) < far else np.inf,
                begin[0],
                method="Nelder-Mead",
                options={"initial_simplex": begin, "xatol": Options.close, "fatol": np.inf},
            )
            return moved(found.x), float(found.fun)
        finer = constant * np.geomspace(0.5, 2.0, Options.finer)  # a shape may be singular beyond
        at = int(np.argmin([self.left(name, along, (a, 0.0)) for a in finer]))
        ends = sorted(finer[[max(at - 1, 0), min(at + 1, len(finer) - 1)]])
        least_at: Any = minimize_scalar(
            lambda a: self.left(name, along, (a, 0.0)), bounds=ends, method="bounded"
        )
        return (float(least_at.x), 0.0), float(least_at.fun)

    def fitted(self, name: str, along: Lengths, place: Place) -> LawFit | None:
        """The fit with the likeliest constant from this one on, without the plain terms that are
        not likely; None where no orbit follows. The centre is the zero of the coordinate."""
        structure = self.structure(name, along, place)
        try:
            structure, known = weak_start(structure, self.fit.problem, False)
        except (FitError, np.linalg.LinAlgError):
            return None
        arcs = self.fit.followed
        if is_centred(name):
            about = self.structure(name, along, (place[0], 0.0))
            own = (known[key] for key in structure.keys())  # noqa: SIM118
            known = {**dict(zip(about.keys(), own, strict=True)), ("zero", 0): place[1]}
            structure = about.plus([("zero", 0)])
            arcs = dataclasses.replace(arcs, x=arcs.x - np.array([place[1], 0.0]))
        fit = with_constant(self.fit.again(structure, known, arcs, rescale=False), False)
        if not (fit.follows and fit.is_definite):
            return None
        free = [("term", row) for row in self.plain]
        pulls = {key for key in free if sum(key[1][1]) == 1}  # pull and are pulled: a pair

        def least_seen(fit: LawFit) -> list[frozenset[Key]]:
            z = fit.significance
            own = sorted((key for key in free if key in z), key=lambda key: z[key])
            pair = frozenset(pulls & set(own))
            return [frozenset({key}) for key in own] + [pair] * (len(pair) > 1)

        def without(fit: LawFit, keys: frozenset[Key]) -> LawFit | None:
            smaller = fit.structure.without(set(keys))
            less = with_constant(fit.again(smaller, rescale=False), False)
            likelier = less.criterion(fit.independent) < fit.criterion()
            return less if less.follows and likelier else None

        return improved(fit, least_seen, without)


def _lengths_of(rows: Sequence[Row]) -> list[Lengths]:
    """The lengths that powers may be a series in: the coordinate of a term, or the difference of
    its two; and of more bodies than two the distances of neighbours together."""
    found: dict[tuple[int, ...], None] = {}
    for row in rows:
        along = [0] * len(row[1])
        for axis, sign in zip(np.flatnonzero(row[1]), (1, -1), strict=False):
            along[axis] = sign
        found[tuple(along)] = None
    between = tuple(one for one in found if -1 in one)
    return [*((one,) for one in found), *([between] if len(between) > 1 else [])]


def with_constant(fit: LawFit, rescale: bool = True) -> LawFit:
    """The fit with the number inside its shapes corrected, as long as that is more than a tenth of
    its standard error."""
    for _ in range(Options.corrections):
        change, error = constant_of(fit)[1:]
        if not fit.follows or not abs(change) > Options.settled * error:
            break
        by = 1 + float(np.clip(change, -Options.furthest, Options.furthest))
        turned = {row: _scaled(row, by) for row in fit.structure.terms}
        structure = dataclasses.replace(fit.structure, terms=tuple(turned.values()))
        known = {("term", turned[k[1]]) if k[0] == "term" else k: c for k, c in fit.values.items()}
        fit = fit.again(structure, known, rescale=rescale)
    return fit


def constant_of(fit: LawFit) -> tuple[float, float, float]:
    """The number inside the last shape of a law, 0 where there is none, its relative change that
    fits best, and the standard error of that; NaN where the coefficients imitate it."""
    number, changes = _by_constant(fit)
    if not changes or not fit.follows:
        return number, 0.0, np.nan
    larger = fit.structure.plus(list(changes))
    return number, *fit.along(changes, larger, least=Options.imitated)


def widened(fit: LawFit) -> dict[Key, float]:
    """The factor, of each coefficient, by which its standard error is larger since the number
    inside shapes is not known either; none where there is no such number."""
    _, changes = _by_constant(fit)
    if not changes or not fit.follows:
        return {}
    whole = fit.beside(changes, fit.structure.plus(list(changes)))
    alone = whole.among(range(len(whole.p) - 1))
    return dict(zip(fit.structure.keys(), (whole.errors[:-1] / alone.errors).tolist(), strict=True))


def _by_constant(fit: LawFit) -> tuple[float, dict[Key, float]]:
    """The number inside the last shape of a law, 0 where there is none, and what a relative change
    of it adds: terms, with coefficients."""
    d, changes, last = fit.structure.dim, dict[Key, float](), 0.0
    for row in fit.structure.terms:
        if own := constants(row):
            last = own[0]
            more, less = (
                tree_of(shape_of(_scaled(row, 1 + by)), d) for by in (Options.apart, -Options.apart)
            )
            slope = to_text((more - less) * (0.5 / Options.apart), d, INPUTS)
            changes["term", (*row[:4], slope, *row[5:])] = fit.values["term", row]
    return last, changes


def constants(row: Row) -> list[Any]:
    """The numbers inside the shape of a row that are not whole."""
    return [leaf.value for leaf in leaves(tree_of(shape_of(row), len(row[0]))) if _is_free(leaf)]


def _is_free(leaf: Expression) -> bool:
    """Return whether a leaf of a shape is a number that is not whole."""
    return leaf.value is not None and not leaf.value.is_integer()


def _scaled(row: Row, by: float) -> Row:
    """A row with the numbers in its shape that are not whole times a factor."""
    d = len(row[0])
    if not shape_of(row):
        return row

    def turned(leaf: Expression) -> Expression:
        return number(float(f"{leaf.operands[0] * by:.8g}")) if _is_free(leaf) else leaf

    tree = with_leaves(tree_of(shape_of(row), d), turned)
    return (*row[:4], to_text(tree, d, INPUTS), *row[5:])


def other_powers(fit: LawFit, coordinates: Sequence[str]) -> str:
    """A line on the powers of the distance that follow a record as those of its law do; "" where
    there are none."""
    from_there = (
        f"({name} - {at:.4g})" if at > 0 else f"({name} + {-at:.4g})" if at < 0 else name
        for name, at in zip(coordinates, fit.zeros, strict=True)
    )
    squares, lines = " + ".join(f"{name}**2" for name in from_there), []
    for own in _powers(fit):
        others = [a for a, other in _as_likely(fit, own).items() if other is not fit]
        if others:
            ends = sorted({min(others), max(others)})
            named = " to ".join(f"r**{a:g}" for a in ends)
            lines.append(f"r**{own:g} may be {named}")
    if not lines:
        return ""
    return (
        f"of the distance r = sqrt({squares}) {', '.join(lines)}. A start farther out, or closer "
        "in, would decide"
    )


def unseen(fit: LawFit) -> str:
    """A line where what a record does not show would move a coefficient by what is significant if
    it were as large as two standard errors allow, "" elsewhere: linear friction, for what grows
    from near rest in one second tells a stiffness by itself as little as friction; and beside
    friction a spring about any place, for what creeps back to it follows laws of a whole family,
    and drag is one of them."""
    structure, d = fit.structure, fit.problem.dim
    if fit.problem.parameters or not fit.follows:
        return ""
    if not structure.friction:
        rubs = [[("loss", row)] for row in losses(d, (LINEAR,), 0.0)[:d]]
        return _moving("no friction is seen, but", rubs, fit, 0.0)
    held = [any(row[1][i] > 1 or shape_of(row) for row in structure.terms) for i in range(d)]
    free = [i for i in fit.problem.lengths if not held[i]]
    pulls = [[("term", row) for row in potentials(d, [i], 2, 1)] for i in free]
    return _moving("no spring is seen, but", pulls, fit, Options.much)


def _moving(what: str, each: Sequence[list[Key]], fit: LawFit, least: float) -> str:
    """A line on what those of ``each`` that is not seen, the first of it as large as the record
    allows, would move by more than its error, and this share of itself, at ``least``."""
    own, significant, lines = fit.values, fit.problem.options.evidence.significant, []
    errors = dict(zip(fit.structure.keys(), fit.linearised.errors.tolist(), strict=True))
    for new in each:
        larger = fit.structure.plus(new)
        near, keys = fit.problem.linearised(larger, fit), larger.keys()
        at, rubs = keys.index(new[0]), new[0][0] == "loss"
        size, error = (float(part[at]) for part in (near.p + near.step(), near.errors))
        most = size + 2 * error if rubs else abs(size) + 2 * error
        with np.errstate(all="ignore"):  # of what is not determined at all
            moved = most * near.covariance[at] / near.covariance[at, at]
        null = near.null_space()
        moved[np.any(null[null[:, at] != 0] != 0, axis=0)] = np.inf
        far = {
            key: abs(float(change) / own[key])
            for key, change in zip(keys, moved, strict=True)
            if key in errors and key[0] in ("term", "loss") and most > 0
            if abs(change) > max(significant * errors[key], least * abs(own[key]))
        }
        if far:
            word, other = (fit.problem.word(k) for k in (max(far, key=far.__getitem__), new[0]))
            by, most = max(far.values()), Options.told
            share = f"{by:.2g} of itself" if by < most else f"more than {most:g} times itself"
            lines.append(f"{other} as large as the record allows moves {word} by {share}")
    return f"{what} {'; '.join(lines)}" if lines else ""


def of_a_sensor(fit: LawFit, smoothed: bool = False) -> tuple[str, bool]:
    """A line on a sensor of one coordinate beside which a plainer law follows a record, "" where
    there is none, and whether the record is explained: that law leaves noise alone, or readings are
    ``smoothed``, of which it cannot. It is clearly likelier (Schwarz's criterion) than a law that
    leaves more than noise, and not clearly less likely than one that leaves noise. Plain are the
    textbook's terms and springs between angles, with linear friction; plainer is also a law without
    those of its other terms that are no more than chance beside the sensor."""
    problem, seen, d = fit.problem, fit.problem.observation, fit.structure.dim
    terms = textbook(d, problem.angles)
    terms += springs(d, problem.within_a_turn) if d > 1 else []
    friction = losses(d, (LINEAR,), 0.0)[:d]
    plain = dataclasses.replace(fit.structure, terms=tuple(terms), friction=tuple(friction))
    plain = dataclasses.replace(plain, zeros=())
    odd = {key for key in fit.values if key[0] in ("term", "loss")} - set(plain.keys())
    is_noise = fit.loudest < Options.noise or smoothed
    if not seen.is_plain or problem.parameters or (is_noise and not odd):
        return "", smoothed
    known, count, best, enough = {}, fit.independent, "", smoothed
    if not is_noise or len(plain.keys()) <= len(fit.p):  # else it is not as likely
        with contextlib.suppress(FitError):
            known = weak_start(plain, problem, prune=False)[1]
    least = fit.criterion() + Options.clearly * (1 if is_noise else -1)
    alone = d == 1 and not problem.num_inputs  # and may be late unseen

    def begun(other: ArcProblem, structure: Structure, start: dict[Key, float]) -> LawFit:
        own = dataclasses.replace(structure, sensors=other.sensors)
        return other.fit(own, start, fit.followed, fit.sigma, rescale=False)

    for i, name in enumerate(seen.coordinates):
        q, v = symbols((name, seen.speeds[i]))
        zero = " + zero" * (i in fit.structure.zeros)
        as_it_is = _shown(problem, name, q + zero) if zero else problem
        base = begun(as_it_is, plain, known) if known else None
        for what, sensor in SENSORS[:3] if alone else SENSORS:
            text = sensor.format(q=q, v=v) + zero
            other = _shown(problem, name, text)
            fewer = _without_needless(fit, other, odd)
            may = base is not None and _may_be_likelier(base, other, count, least)
            tried = [(plain, known)] if may else []
            tried += [(fewer, fit.values)] if fewer else []
            for structure, start in tried:
                again = begun(other, structure, start)
                unlikely = again.criterion(count)
                most = max(Options.noise, Options.explains * fit.loudest)
                follows = smoothed or again.loudest < most
                if again.is_definite and follows and unlikely < least and _is_a_sensor(again):
                    typed, least = shlex.quote(f"{name} = {text}"), unlikely
                    enough = smoothed or again.loudest < Options.noise
                    best = (
                        f"a plainer law follows the record where {name} {what}: --observe {typed}"
                    )
    return best, enough


def _shown(problem: ArcProblem, name: str, text: str) -> ArcProblem:
    """The problem of a plain recording with one coordinate shown by a formula."""
    seen = problem.observation
    shown = observed({name: text}, seen.coordinates, seen.speeds, {}, columns=seen.channels)
    return dataclasses.replace(problem, observation=dataclasses.replace(shown, loss=seen.loss))


def _may_be_likelier(base: LawFit, other: ArcProblem, count: float, least: float) -> bool:
    """Return whether the law of a fit may come below a criterion by the sensor of another problem:
    that explains half of what the law leaves, or as much as it takes, close to it. A law that was
    not found tells nothing."""
    if not base.follows:
        return True
    sensors = tuple((name, 0.0) for name, _ in other.sensors)
    own = dataclasses.replace(base.structure, sensors=sensors)
    fitted, new = places(own, base.structure, [k for k in own.keys() if k not in base.values])  # noqa: SIM118
    found = other.linearised(own, base).added(fitted, new)
    share = float(found.left[0] / found.rest) ** 2
    likely = criterion(share * base.fitted.cost, count, len(own.keys())) < least
    return likely or not share > Options.explains


def _is_a_sensor(fit: LawFit) -> bool:
    """Return whether a fit follows, beside a sensor that is seen and may be: late or smoothed, not
    early (and another late) nor sharpened, by a part of the motion of which its series tells, and
    no friction drives in its place."""
    least, fastest = fit.problem.options.evidence.significant, fit.problem.scales.omega
    tells = {"late": (0, np.inf), "smooth": (0, fastest**-2), "bend": (-np.inf, np.inf)}
    sizes = {k: fit.values[k] for k in fit.values if k[0] == "sensor" and k[1] in tells}
    return may_be_chosen(fit) and all(
        tells[k[1]][0] < size < tells[k[1]][1] and fit.significance[k] > least
        for k, size in sizes.items()
    )


def _without_needless(fit: LawFit, other: ArcProblem, odd: set[Key]) -> Structure | None:
    """The structure of a fit without those of its odd terms that are significant, and no more than
    chance beside the sensors of another problem, close to the fit; None where there are none."""
    zeros = tuple(i for i in fit.structure.zeros if i in other.observation.direct)
    sensors = tuple((name, 0.0) for name, _ in other.sensors)
    own = dataclasses.replace(fit.structure, zeros=zeros, sensors=sensors)
    near, evidence = other.linearised(own, fit), fit.problem.options.evidence
    z = dataclasses.replace(near, p=near.p + near.step()).significance
    seen = {key for key in odd if abs(fit.significance.get(key, 0.0)) > evidence.significant}
    beside = zip(own.keys(), z, strict=True)
    needless = {key for key, one in beside if key in seen and one < evidence.chance}
    return own.without(needless) if needless else None


def _powers(fit: LawFit) -> list[float]:
    """The powers of the distance that a law has."""
    d = fit.structure.dim
    distance = tree_of(shape_of(central(d, 1.0)[0]), d)
    found = (factors_of(tree_of(shape_of(row), d)) for row in fit.structure.terms)
    return list(dict.fromkeys(float(one[distance]) for one in found if set(one) == {distance}))


def _as_likely(fit: LawFit, own: float) -> dict[float, LawFit]:
    """A power of the distance that a law has, and neighbours of it -> fits: those against which the
    best of them has no odds that decide."""
    evidence = fit.problem.options.evidence
    if not fit.follows:
        return {}
    springs = any(max(row[1]) == 2 and not any(row[0]) for row in fit.structure.terms)
    found = {own: fit}
    taken = {0.0, *_powers(fit), *([2.0] if springs else [])}  # which the other terms are

    def odds(fit: LawFit) -> float:
        """Odds of the best so far over a fit."""
        least = min(other.fitted.cost for other in found.values())
        return evidence.odds(least, fit.fitted.cost, fit.independent)

    for step in (-0.5, 0.5):
        first = np.ceil(2 * own) / 2 if step < 0 else np.floor(2 * own) / 2
        for a in (first + step * np.arange(1, Options.most + 1)).tolist():
            if a in taken:
                continue
            other = fit.again(_with_power(fit, own, a), rescale=False)
            if not other.follows or odds(other) > evidence.decided:
                break
            found[a] = other
    return {a: other for a, other in found.items() if odds(other) < evidence.decided}


def _with_power(fit: LawFit, own: float, other: float) -> Structure:
    """The structure with another power of the distance."""
    structure = fit.structure
    before, after = (shape_of(central(structure.dim, a)[0]) for a in (own, other))

    def turned(row: Row) -> Row:
        return (*row[:4], after, *row[5:]) if shape_of(row) == before else row

    return dataclasses.replace(structure, terms=tuple(map(turned, structure.terms)))
