"""Rollouts of laws on numbers, compiled: the steps of `flows.flow`, lane by lane.

The field of a law, ∇H or with its forces, is written down as a list of sums and products, by
running its family, and of a bracket its lift, in NumPy on arrays of `Node`s; a compiled loop reads
the list at all stages of a step at once, of as many lanes as a processor's nearest memory holds. So
no law is compiled, and no family or lift needs code of its own. What becomes of a lane does not
depend on those beside it.

States stay on a lift from the first step to the last, with what rounding loses of them. The momenta
of its fibres, quadratic in w, are what Casimirs are made of, and are kept to twice the digits.
Stages begin with the polynomial nearest to all stages of the two steps before: that halves the
iterations, and changes nothing that they converge to."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from numpy.polynomial.chebyshev import chebvander

from gfnn_jax.families.family import at_time, form_of
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.flows.collective import Casimirs
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.lifts import Itself
from gfnn_jax.flows.sines import sines, two_sum
from gfnn_jax.flows.translated import compiled, function
from gfnn_jax.flows.uniform import CaldirolaKanai, Uniform

STAGES = 8  # at the most; a multiple of the numbers that processors do at once, too
_MOST = 100  # iterations
_BEFORE = 2  # steps, by whose stages those of a step begin
_FLOOR, _SETTLED = 1.1e-17, 1.8e-12  # as in `flows.flow`: 0.05 eps, eps^¾
_SPLIT = 134217729.0  # 2²⁷ + 1 halves a number's digits (T. J. Dekker, Numer. Math. 18, 1971)
_PARALLEL = 1.0 + 1e-9  # as in `flows.collective`
_TWO_PI, _BEYOND = 2 * math.pi, 2.4492935982947064e-16  # 2π and what this number lacks of it
_MOST_OPERATIONS = 10_000  # of a gradient: JAX's products of matrices are faster beyond

# Of a tape: v_i = v_a + c v_b; c v_a v_b; c v_a. Of a program: v_i = v_a + c v_b v_d; of both:
# v_a^c; functions of v_a.
INPUT, CONSTANT, SUM, PRODUCT, SCALED, JOINED, POWER, INVERSE, EXP, LOG, SIN, COS = range(12)
ROOT, ABS, TAN, SINH, COSH, TANH, ARCTAN = range(12, 19)
_NAMES = ("exp", "log", "sin", "cos", "sqrt", "fabs", "tan", "sinh", "cosh", "tanh", "arctan")
_FUNCTIONS = dict(zip(_NAMES, range(EXP, ARCTAN + 1), strict=True))


class Program(NamedTuple):
    """Operations (N, 4) (kind, a, b, d) and their constants (N,); the places (W,) of the values.
    First come ``inputs`` of them, the state and the args, then, up to ``moving``, those that the
    state does not enter."""

    code: np.ndarray
    constants: np.ndarray
    values: np.ndarray
    inputs: int
    moving: int


class Node:
    """A number that is not known yet, at its place on a tape."""

    __array_ufunc__ = None  # arrays of nodes are arrays of objects: NumPy's numbers give way

    def __init__(self, tape: _Tape, place: int):
        self.tape, self.place = tape, place

    def _row(self) -> tuple[int, int, int, float]:
        return self.tape.rows[self.place]

    def _other(self, other: Any) -> Node:
        return other if isinstance(other, Node) else self.tape.put(CONSTANT, 0, 0, float(other))

    def __add__(self, other: Any) -> Node:
        other = self._other(other)
        (kind, *_, c), (of_other, a, _, by) = self._row(), other._row()
        if of_other == CONSTANT:
            if kind == CONSTANT or by == 0:
                return self._other(c + by) if by else self
        elif kind == CONSTANT and c == 0:
            return other
        if other.place == self.place:
            return self * 2.0
        if of_other == SCALED:
            return self.tape.put(SUM, self.place, a, by)
        return self.tape.put(SUM, self.place, other.place, 1.0)

    def __mul__(self, other: Any) -> Node:
        one, two = self, self._other(other)
        if one._row()[0] == CONSTANT:
            one, two = two, one
        (kind, a, b, c), (of_other, inner, _, by) = one._row(), two._row()
        if of_other == CONSTANT:
            if kind == CONSTANT or by == 0:
                return self._other(c * by if by else 0.0)
            if by == 1:
                return one
            if kind in (SCALED, PRODUCT):
                return self.tape.put(kind, a, b, c * by)
            return self.tape.put(SCALED, one.place, 0, by)
        factor, places = 1.0, [one.place, two.place]
        for k, (own, at, share) in enumerate(((kind, a, c), (of_other, inner, by))):
            if own == SCALED:
                factor, places[k] = factor * share, at
        return self.tape.put(PRODUCT, min(places), max(places), factor)

    def __pow__(self, exponent: float) -> Node:
        kind, *_, c = self._row()
        if kind == CONSTANT:
            return self._other(c**exponent)
        if exponent == 2:
            return self * self
        kind = INVERSE if exponent == -1 else POWER
        return self.tape.put(kind, self.place, 0, float(exponent))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Node:
        return self * -1.0

    def __sub__(self, other: Any) -> Node:
        return self + other * -1.0

    def __rsub__(self, other: Any) -> Node:
        return self * -1.0 + other

    def __truediv__(self, other: Any) -> Node:
        return self * (self._other(other) ** -1)

    def __rtruediv__(self, other: Any) -> Node:
        return self**-1 * other

    def __abs__(self) -> Node:
        return self.fabs()

    def __bool__(self) -> bool:
        raise TypeError("a number that is not known yet decides nothing")

    def __eq__(self, other: object) -> bool:
        return bool(self)

    def __getattr__(self, name: str) -> Callable[[], Node]:
        if name not in _FUNCTIONS:
            raise AttributeError(name)
        kind, *_, c = self._row()
        if kind == CONSTANT:
            return lambda: self._other(getattr(np, name)(c))
        return lambda: self.tape.put(_FUNCTIONS[name], self.place, 0, 0.0)


class _Tape:
    """Operations so far, each once. forms: sums that are kept, the factors of what they add."""

    def __init__(self, width: int):
        self.rows: list[tuple[int, int, int, float]] = [(INPUT, 0, 0, 0.0)] * width
        self.known: dict[tuple, int] = {}
        self.forms: dict[int, dict[int, Any]] = {}

    def put(self, kind: int, a: int, b: int, c: float) -> Node:
        row = kind, a, b, c
        if row not in self.known:
            self.known[row] = len(self.rows)
            self.rows.append(row)
        return Node(self, self.known[row])

    def operands(self, place: int) -> Collection[int]:
        """Places of what an operation takes."""
        kind, a, b, _ = self.rows[place]
        if place in self.forms:
            return self.forms[place]
        return [a, b] if kind in (SUM, PRODUCT) else [] if kind in (INPUT, CONSTANT) else [a]

    def needed(self, ends: list[int]) -> list[int]:
        """Places that these are made of, and these, in order."""
        used, ahead = set(), list(ends)
        while ahead:
            place = ahead.pop()
            if place not in used:
                used.add(place)
                ahead += self.operands(place)
        return sorted(used)

    def join(self, ends: list[int]) -> None:
        """Make forms of sums. One that stands in one other alone is put into it; those of the same
        places that stand in forms alone are put into these where fewer factors are left then, as of
        matrices one after another."""
        used, forms = self.needed(ends), self.forms
        uses = Counter([*ends, *(of for place in used for of in self.operands(place))])
        linear = [place for place in used if self.rows[place][0] in (SUM, SCALED)]
        fixed = {*ends, *(of for p in {*used} - {*linear} for of in self.operands(p))}
        for place in linear:
            kind, a, b, c = self.rows[place]
            share, terms = np.longdouble(c), {}  # matrices that are symmetric stay so
            for of, by in ((a, 1), (b, share)) if kind == SUM else ((a, share),):
                terms[of] = terms.get(of, 0) + by
            once = {of for of in terms if of in forms and uses[of] == 1 and of not in fixed}
            forms[place] = _without(once, terms, forms)
            for of in once:
                del forms[of]
        joined = True
        while joined:
            alike = defaultdict(set)
            for place in forms.keys() - fixed:
                alike[frozenset(forms[place])].add(place)
            joined = any(self._merged(group) for group in alike.values())

    def _merged(self, group: set[int]) -> bool:
        """Put the forms of a group into others, if that leaves fewer factors."""
        forms = self.forms
        others = [p for p in forms if not group.isdisjoint(forms[p])]
        new = {p: _without(group, forms[p], forms) for p in others}
        if sum(map(len, new.values())) >= sum(len(forms[p]) for p in (*others, *group)):
            return False
        forms.update(new)
        for place in group:
            del forms[place]
        return True


def _without(group: Collection[int], terms: dict[int, Any], forms: dict) -> dict[int, Any]:
    """A form, with those of a group put in."""
    found: dict[int, Any] = defaultdict(float)
    for of, by in terms.items():
        for place, share in (forms[of] if of in group else {of: 1.0}).items():
            found[place] += by * share
    return dict(found)


def program(field: Callable[[np.ndarray, Any], Any], width: int, given: int) -> Program:
    """The program of a field (1, width) of states (1, width) and args (1, given), None where none
    are given.

    Raises TypeError or AttributeError for a field of which the tape has no operation.
    """
    tape = _Tape(inputs := width + given)
    nodes = np.array([[Node(tape, i) for i in range(inputs)]], dtype=object)
    values = np.ravel(field(nodes[:, :width], nodes[:, width:] if given else None))
    ends = [nodes[0, 0]._other(value).place for value in values]
    tape.join(ends)
    used = [place for place in tape.needed(ends) if place >= inputs]
    uses = Counter([*ends, *(of for place in used for of in tape.operands(place))])
    summed = {of for form in tape.forms.values() for of in form if uses[of] == 1}
    inside = {of for of in summed if tape.rows[of][0] == PRODUCT}  # done with the sum
    moving = set(range(width))
    for place in used:
        if not moving.isdisjoint(tape.operands(place)):
            moving.add(place)
    zero, one, at = inputs, inputs + 1, {place: place for place in range(inputs)}
    rows = [(INPUT, 0, 0, 0, 0.0)] * inputs
    rows += [(CONSTANT, 0, 0, 0, 0.0), (CONSTANT, 0, 0, 0, 1.0)]

    def write(place: int) -> None:
        kind, a, b, c = tape.rows[place]
        both = [tape.known.get((of, a, 0, 0.0), -1) for of in (SIN, COS)]
        if kind in (SIN, COS) and {*both} <= {*used}:
            for share, of in enumerate(both, 1):
                at[of] = len(rows)
                rows.append((tape.rows[of][0], at[a], share, 0, 0.0))
        elif place in tape.forms:
            form = tape.forms[place]
            first = next((of for of, by in form.items() if by == 1 and of not in inside), None)
            at[place] = zero if first is None else at[first]
            for of, by in form.items():
                _, a, b, c = tape.rows[of]
                factors = (at[a], at[b], by * c) if of in inside else (at[of], one, by)
                if of != first:
                    rows.append((JOINED, at[place], *factors))
                    at[place] = len(rows) - 1
        elif place not in inside:
            row = (
                (JOINED, zero, at[a], at[b], c)
                if kind == PRODUCT
                else (kind, at.get(a, 0), 0, 0, c)
            )
            rows.append(row)
            at[place] = len(rows) - 1

    for place in (place for place in used if place not in moving):  # once in a step
        if place not in at:
            write(place)
    still = len(rows)
    for place in (place for place in used if place in moving):
        if place not in at:  # as a cosine that was written beside its sine
            write(place)
    code, constants = np.array([row[:4] for row in rows]), np.array([float(row[4]) for row in rows])
    return Program(code, constants, np.array([at[end] for end in ends]), inputs, still)


@function
def _high(a):
    split = _SPLIT * a
    return split - (split - a)


@function
def _two_product(a, b):
    total, high, other = a * b, _high(a), _high(b)
    low, below = a - high, b - other
    return total, ((high * other - total) + high * below + low * other) + low * below


@function
def _of(kind, x, c):
    if kind == EXP:
        return math.exp(x)
    if kind == LOG:
        return math.log(x)
    if kind == POWER:
        return x**c
    if kind == ROOT:
        return math.sqrt(x)
    if kind == ABS:
        return abs(x)
    if kind == TAN:
        return math.tan(x)
    if kind == SINH:
        return math.sinh(x)
    if kind == COSH:
        return math.cosh(x)
    if kind == TANH:
        return math.tanh(x)
    return math.atan(x)


@function
def _run(law, v, places, shape):
    """Run the operations of these places at the states in v, one a column, those of a lane side by
    side. shape: of how many lanes, columns of each, and stages: functions are done of these."""
    (begin, end), (count, length, stages), code = places, shape, law.code
    columns = (count * length + (STAGES - 1)) // STAGES * STAGES
    for i in range(begin, end):
        kind, a, c = code[i, 0], code[i, 1], law.constants[i]
        if kind == JOINED:
            b, d = code[i, 2], code[i, 3]
            for s in range(0, columns, 4):
                one = v[a, s] + c * v[b, s] * v[d, s]
                two = v[a, s + 1] + c * v[b, s + 1] * v[d, s + 1]
                three = v[a, s + 2] + c * v[b, s + 2] * v[d, s + 2]
                four = v[a, s + 3] + c * v[b, s + 3] * v[d, s + 3]
                v[i, s], v[i, s + 1], v[i, s + 2], v[i, s + 3] = one, two, three, four
        elif kind == CONSTANT:
            for s in range(columns):
                v[i, s] = c
        elif kind == INVERSE:
            for s in range(columns):
                v[i, s] = 1.0 / v[a, s]
        elif kind == SIN:
            sines(v[a], v[i], v[i + 1 if code[i, 2] > 0 else len(code)], columns)
        elif kind == COS:
            if code[i, 2] == 0:
                sines(v[a], v[len(code)], v[i], columns)
        else:
            for g in range(count):
                for s in range(g * length, g * length + stages):
                    v[i, s] = _of(kind, v[a, s], c)


@function
def _weighted(out, first, begin, matrix, x):
    """Put begin_i + Σ_t x_it matrix_t into the rows i of out, from the column ``first`` on, four at
    once."""
    for i in range(len(x)):
        for s in range(0, matrix.shape[1], 4):
            one, two, three, four = 0.0, 0.0, 0.0, 0.0
            for t in range(len(matrix)):
                one += x[i, t] * matrix[t, s]
                two += x[i, t] * matrix[t, s + 1]
                three += x[i, t] * matrix[t, s + 2]
                four += x[i, t] * matrix[t, s + 3]
            at = first + s
            out[i, at], out[i, at + 1] = begin[i] + one, begin[i] + two
            out[i, at + 2], out[i, at + 3] = begin[i] + three, begin[i] + four


@function
def _kept(w, moved, entries, values, slopes, system):
    """Move w (2, W), whose second row is what rounding has lost, without the invariants' change:
    `flows.collective.Casimirs.kept`. system: a row for each of their corrections, its matrix beside
    the change as a sum of two numbers."""
    width, count = w.shape[1], len(system)
    system[:], slopes[:] = 0.0, 0.0
    for e in range(len(entries)):
        k, a, b = entries[e, 0], entries[e, 1], entries[e, 2]
        by, rest = _two_product(values[e], moved[a])
        slope = values[e]
        if b >= 0:
            half, below = two_sum(w[0, b], 0.5 * moved[b])
            at = by
            by, more = _two_product(at, half)
            rest = more + (at * (below + w[1, b]) + rest * half)
            slope *= w[0, b] + moved[b]
        system[k, count], error = two_sum(system[k, count], by)
        system[k, count + 1] += error + rest
        slopes[k, a] += slope
    for k in range(count):
        system[k, count] += system[k, count + 1]
        for m in range(count):
            for i in range(width):
                system[k, m] += slopes[k, i] * slopes[m, i]
        system[k, k] *= _PARALLEL
    for k in range(count):
        for m in range(k + 1, count):
            factor = system[m, k] / system[k, k]
            for j in range(k, count + 1):
                system[m, j] -= factor * system[k, j]
    for k in range(count - 1, -1, -1):
        for m in range(k + 1, count):
            system[k, count] -= system[k, m] * system[m, count]
        system[k, count] /= system[k, k]
        if not abs(system[k, count]) < np.inf:
            system[k, count] = 0.0
    for i in range(width):
        lost = w[1, i]
        for k in range(count):
            lost -= system[k, count] * slopes[k, i]
        begun, rest = two_sum(w[0, i], moved[i])
        w[0, i], w[1, i] = two_sum(begun, lost + rest)


@function
def _sheared(w, slopes, q, p):
    """Put p − s q in place of p, both of four numbers from these places on, by a whole number s: p
    grows along the fibre of se(3) as long as it goes, and its digits would be lost."""
    along, size = 0.0, 0.0
    for i in range(4):
        along += w[0, q + i] * w[0, p + i]
        size += w[0, q + i] * w[0, q + i]
    share = np.rint(along / size)
    if share == 0.0 or not abs(share) < np.inf:
        return
    for i in range(4):
        by, rest = _two_product(-share, w[0, q + i])
        total, error = two_sum(w[0, p + i], by)
        rest += error - share * w[1, q + i] + w[1, p + i]
        w[0, p + i], w[1, p + i] = two_sum(total, rest)
        for s in range(slopes.shape[1]):
            slopes[p + i, s] -= share * slopes[q + i, s]


class Law(NamedTuple):
    """Tables of a law and its lift, for `roll`: the program of the field; rows of the stages'
    couplings by columns of stages, and their weights h b; those of the stages of the steps before
    in where stages begin; the invariants; the lift's ``fibres`` (S, 3); the sizes (W,) of w, what
    uniform friction makes of it in a substep, less 1; places (A,) of angles and their centres."""

    code: np.ndarray
    constants: np.ndarray
    ends: np.ndarray
    rule: np.ndarray
    weights: np.ndarray
    before: np.ndarray
    entries: np.ndarray
    values: np.ndarray
    fibres: np.ndarray
    unit: np.ndarray
    decay: np.ndarray
    angles: np.ndarray
    centre: np.ndarray


@function
def _balanced(w, slopes, q, p):
    """Make q and p of a Casimir coordinate q p of a size, by exact powers of two: they grow and
    shrink exponentially."""
    while abs(w[0, q]) > 4.0 * abs(w[0, p]) > 0.0 or abs(w[0, p]) > 4.0 * abs(w[0, q]) > 0.0:
        by = 0.5 if abs(w[0, q]) > abs(w[0, p]) else 2.0
        for k in range(2):
            w[k, q] *= by
            w[k, p] /= by
        for s in range(slopes.shape[1]):
            slopes[q, s] *= by
            slopes[p, s] /= by


@function
def _turned(w, place, centre):
    """Take whole turns from an angle, 2π to twice the digits: how many."""
    turns = np.rint((w[0, place] - centre) / _TWO_PI)
    if turns == 0.0 or not abs(turns) < np.inf:
        return 0.0
    by, rest = _two_product(-turns, _TWO_PI)
    total, error = two_sum(w[0, place], by)
    w[0, place], w[1, place] = two_sum(total, error + rest - turns * _BEYOND + w[1, place])
    return turns


@function
def _begun(law, task, room, inputs, at):
    """Begin a substep of a lane: its args, and its stages by those of the steps before. at: the
    lane, its place in the room, the step and its substep."""
    (lane, g, n, part_of), length, width = at, law.rule.shape[1], len(law.unit)
    row, column = min(lane, task.given.shape[0] - 1), min(n, task.given.shape[1] - 1)
    for i in range(width, inputs):
        for s in range(length):
            room.v[i, g * length + s] = task.given[row, column, part_of, i - width, s]
    for i in range(width):
        room.unit[g, i] = STAGES / (abs(task.w[lane, 0, i]) + law.unit[i])
    room.change[g], now = np.inf, room.now[g]
    if np.isnan(task.slopes[lane, 0, len(law.before) - 1]):
        now[:] = 0.0
    else:
        _weighted(now, 0, room.nought, law.before, task.slopes[lane])


@function
def _closer(law, room, g, stages):
    """Put what the stages in v move a lane by into ``now``; whether it has to be done again."""
    first, change, whole, last = g * law.rule.shape[1], 0.0, 0.0, room.change[g]
    for i in range(len(law.unit)):
        off, total = 0.0, 0.0
        for s in range(stages):
            value = law.weights[s] * room.v[law.ends[i], first + s]
            total += value
            off = max(off, abs(value - room.now[g, i, s]))
            room.now[g, i, s] = value
        whole += total
        change = max(change, off * room.unit[g, i])
    finite = abs(whole) < np.inf
    room.change[g] = change if finite else np.inf
    return finite and not (change <= _FLOOR or (change <= _SETTLED and change > 0.5 * last))


@function
def _solved(law, task, room, shape, at):
    """Iterate the stages of lanes, from the lane ``at`` on, each until it has settled. The
    operations from the place after it on are done."""
    (first, moving), (count, length, stages), iterations, left = at, shape, 0, 1
    while left > 0 and iterations < _MOST:
        iterations, left = iterations + 1, 0
        for g in range(count):
            if room.open[g] > 0:
                _weighted(room.v, g * length, task.w[first + g, 0], law.rule, room.now[g])
        _run(law, room.v, (moving, len(law.code)), shape)
        for g in range(count):
            if room.open[g] > 0:
                task.most[first + g] = max(task.most[first + g], iterations)
                room.open[g] = _closer(law, room, g, stages)
                left += room.open[g]


@function
def _moved(law, w, slopes, now, room):
    """End a substep of a lane."""
    length = law.rule.shape[1]
    for i in range(len(law.unit)):
        room.moved[i] = 0.0
        for s in range(length):
            room.moved[i] += now[i, s]
            slopes[i, length + s] = (1.0 + law.decay[i]) * slopes[i, s]
            slopes[i, s] = (1.0 + law.decay[i]) * now[i, s]
        room.moved[i] += law.decay[i] * (w[0, i] + room.moved[i])
    _kept(w, room.moved, law.entries, law.values, room.along, room.system)


@function
def _ended(law, task, w, lane, n):
    """End a step of a lane."""
    slopes = task.slopes[lane]
    for e in range(len(law.fibres)):
        if law.fibres[e, 2]:
            _sheared(w, slopes, law.fibres[e, 0], law.fibres[e, 1])
        else:
            _balanced(w, slopes, law.fibres[e, 0], law.fibres[e, 1])
    for e in range(len(law.angles)):
        task.turns[lane, n, e] = _turned(w, law.angles[e], law.centre[e])
    for i in range(len(law.unit)):
        task.out[lane, n, 0, i], task.out[lane, n, 1, i] = w[0, i], w[1, i]
    task.fine[lane] += 1


@compiled("rollouts of laws", 1)
def roll(law, task, room, sizes):
    """Follow the lanes of a `Task`, as many at once as there is `Room` for. sizes: substeps,
    inputs, moving and stages."""
    (substeps, inputs, moving, stages), (lanes, steps), first = sizes, task.out.shape[:2], 0
    length = law.rule.shape[1]
    while first < lanes:
        count, n = min(len(room.going), lanes - first), 0
        left, shape = count, (count, length, stages)
        for g in range(count):
            room.going[g] = 1
        for i in range(len(law.unit)):  # columns of no lane are like those of the first
            for s in range(count * length, room.v.shape[1]):
                room.v[i, s] = task.w[first, 0, i]
        while left > 0 and n < steps:
            for part_of in range(substeps):
                for g in range(count):
                    room.open[g] = room.going[g]
                    if room.going[g] > 0:
                        _begun(law, task, room, inputs, (first + g, g, n, part_of))
                _run(law, room.v, (inputs, moving), shape)
                _solved(law, task, room, shape, (first, moving))
                for g in range(count):
                    if room.going[g] > 0 and room.change[g] <= _SETTLED:
                        _moved(law, task.w[first + g], task.slopes[first + g], room.now[g], room)
                    elif room.going[g] > 0:
                        room.going[g], stays = 0, room.now[g]
                        stays[:] = 0.0  # numbers that the lane's columns are run on further
                        _weighted(room.v, g * length, task.w[first + g, 0], law.rule, stays)
                        left -= 1
            for g in range(count):
                if room.going[g] > 0:
                    _ended(law, task, task.w[first + g], first + g, n)
            n += 1
        first += count


class Task(NamedTuple):
    """N lanes: their states w (N, 2, W), whose second row is what rounding has lost, the stages
    (N, W, 2 C) of the two steps before, the last one first, NaN of none, and the args (N or 1, M or
    1, substeps, k, C) of M steps; and what becomes of them: the states out (N, M, 2,
    W), NaN from where a step fails, the turns (N, M, A) that angles made in each step, how many
    steps did not fail (N,), and the most iterations of one (N,)."""

    w: np.ndarray
    slopes: np.ndarray
    given: np.ndarray
    out: np.ndarray
    turns: np.ndarray
    fine: np.ndarray
    most: np.ndarray


class Room(NamedTuple):
    """Room for G lanes of C columns each: the values v of all operations, and of a cosine that none
    asks for, a column for each stage; what each stage moves w by, ``now`` (G, W, C); in which unit
    (G, W) its change (G,) is told; which lanes are going, and which stages are open (G,); what a
    step moves a lane by, the slopes of its invariants and their system; and a state of zeros."""

    v: np.ndarray
    now: np.ndarray
    unit: np.ndarray
    change: np.ndarray
    going: np.ndarray
    open: np.ndarray
    moved: np.ndarray
    along: np.ndarray
    system: np.ndarray
    nought: np.ndarray

    @classmethod
    def of(cls, law: Law, lanes: int) -> Room:
        """Room for so many lanes of a law, or for fewer that are followed at once."""
        (rows, _), length = law.code.shape, len(law.weights)
        width, count = len(law.unit), 1 + max(law.entries[:, 0], default=-1)
        most = 2048 // (rows * length)  # half of the memory nearest to most processors
        lanes = min(lanes, max(most, STAGES // length))
        columns = -(-lanes * length // STAGES) * STAGES
        numbers = (rows + 1, columns), (lanes, width, length), (lanes, width), lanes
        flags = (np.zeros(lanes, np.int64) for _ in range(2))
        rest = width, (count, width), (count, count + 2), width
        return cls(*map(np.zeros, numbers), *flags, *map(np.zeros, rest))


@dataclasses.dataclass(frozen=True, eq=False)
class Stepper:
    """A flow in the form that `roll` reads. sizes: of its program, inputs and moving."""

    flow: Any
    lift: Any
    law: Law
    sizes: tuple[int, int]

    MOST = _MOST  # iterations of a step

    @classmethod
    def of(cls, flow: Any, args: int = 0, angles: Any = (), centre: Any = ()) -> Stepper | None:
        """Tables of a flow with so many args, of angles at these places that are kept within half a
        turn of their centres; None of one with more stages or more operations, by Newton's method,
        of functions that no `Node` has, and inside ``jit``, ``grad`` or ``vmap``."""
        if not isinstance(flow, Flow) or flow.stages > STAGES or flow.newton:
            return None
        if any(isinstance(x, Tracer) for x in jax.tree.leaves(flow)) or np.ndim(flow.dt):
            return None
        flow = jax.tree.map(np.asarray, flow)
        family, h = flow.family, float(flow.dt) / flow.substeps
        lift = getattr(family, "lift", Itself(None))
        operations = getattr(family, "operations", None)
        if operations is None or operations[0] > _MOST_OPERATIONS or matrix_free(family):
            return None
        if lift.quadratic_invariants is None or flow.scale.dtype != np.float64:
            return None
        unit = lift.sizes(flow.scale)
        width = len(unit)
        decay = np.zeros(width)
        if isinstance(family, Uniform):
            decay[width // 2 :] = np.expm1(-flow.params[-1] * h)
            family, args = CaldirolaKanai(family.family), args + 1
        form = form_of(family, width)

        def field(w, given):
            return family.gradient(flow.params, w, given) @ form.T

        try:
            found = program(field, width, args)
        except (TypeError, AttributeError):
            return None
        casimirs = getattr(family, "casimirs", Casimirs((), ()))
        entries, values = lift.quadratic_invariants or (casimirs.entries, casimirs.values)
        entries = np.array(entries, np.int64).reshape(-1, 3)
        fibres = np.array(getattr(lift, "fibres", ()), np.int64).reshape(-1, 3)
        law = (*found[:3], *_rule(flow.stages, h), entries, np.asarray(values, float), fibres)
        law = (*law, np.asarray(unit, float), decay)
        law = (*law, np.array(angles, np.int64), np.array(centre, float))
        owned = tuple(np.require(a, requirements=["C", "W", "O"]) for a in law)
        return cls(flow, lift, Law(*owned), (found.inputs, found.moving))

    def begun(self, z: np.ndarray, lost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (N, 2, W) and stages of lanes at z + lost (N, n), from which they go on."""
        w = self.lift.up(np.asarray(z, np.longdouble) + lost)
        rounded = w.astype(float)
        w = np.stack([rounded, (w - rounded).astype(float)], axis=1)
        return w, np.full((len(w), w.shape[2], len(self.law.before)), np.nan)

    def steps(self, lanes: tuple[np.ndarray, np.ndarray], count: int, args: Any) -> Task:
        """Follow lanes by ``count`` steps. args: (N or 1, M or 1, k) as each begins, or None."""
        num, angles = len(lanes[0]), len(self.law.angles)
        states = np.full((num, count, *lanes[0].shape[1:]), np.nan)
        turns, ends = np.zeros((num, count, angles)), (np.zeros(num, np.int64) for _ in range(2))
        task = Task(*lanes, self._given(args), states, turns, *ends)
        sizes = self.flow.substeps, *self.sizes, self.flow.stages
        roll(self.law, task, Room.of(self.law, num), sizes)
        return task

    def _given(self, args: Any) -> np.ndarray:
        """Args of all stages, as `Task` has them."""
        flow, family, shape = self.flow, self.flow.family, (1, 1)
        if args is not None:
            shape, args = args.shape[:2], args.reshape(-1, args.shape[-1])
        given, columns = self.sizes[0] - len(self.law.unit), len(self.law.weights)
        found = np.zeros((*shape, flow.substeps, given, columns))
        h, rows = float(flow.dt) / flow.substeps, np.zeros((math.prod(shape), 1))
        for part in range(flow.substeps if found.size else 0):
            now, of = at_time(family, args, part * h) if args is not None else None, family
            if isinstance(family, Uniform):
                of, now = family.begun(now, rows)
            for s, node in enumerate(gauss(flow.stages).nodes):
                found[:, :, part, :, s] = at_time(of, now, node * h).reshape(*shape, -1)
        return found

    def down(self, w: np.ndarray) -> np.ndarray:
        """States (..., n) of the lift's (..., 2, W), to their last digit."""
        if isinstance(self.lift, Itself):
            return w[..., 0, :]  # of a number and what rounding has lost of it, the nearest
        return self.lift.down(w.astype(np.longdouble).sum(axis=-2)).astype(float)


def _rule(stages: int, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Couplings, weights, and weights of the steps before, as `Law` has them, in fours; stages that
    Gauss's rule lacks have none."""
    columns = -(-stages // 4) * 4
    rule, weights = gauss(stages), np.zeros(columns)
    coupling, before = np.zeros((columns, columns)), np.zeros((_BEFORE, columns, columns))
    coupling[:stages, :stages], weights[:stages] = rule.coupling.T, h * rule.weights
    degree = min(2 * stages - 1, stages + 3)  # higher ones amplify rounding
    times = rule.nodes, rule.nodes - 1
    known, sought = (chebvander(t, degree) for t in (np.concatenate(times), rule.nodes + 1))
    shares = (sought @ np.linalg.pinv(known)).T.reshape(_BEFORE, stages, stages)
    before[:, :stages, :stages] = shares / rule.weights[:, None] * rule.weights
    return coupling, weights, before.reshape(-1, columns)
