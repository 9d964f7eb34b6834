"""Rollouts of laws on numbers, compiled: the steps of `flows.flow`, lane by lane.

The field of a law, ∇H or with its forces, is written down as a list of sums and products, by
running its family, and of a bracket its lift, in NumPy on arrays of `Node`s; a compiled loop reads
the list at all stages of a step at once. So no law is compiled, and no family or lift needs code of
its own.

States stay on a lift from the first step to the last, with what rounding loses of them. The momenta
of its fibres, quadratic in w, are what Casimirs are made of, and are kept to twice the digits. Each
stage begins with the polynomial through the same stage of the steps before: that halves the
iterations, and changes nothing that they converge to. The polynomial through all stages of one step
is better where steps are long and stages many, and worse than nothing where their errors differ:
two steps of 64 tell which of both takes fewer iterations. This module imports numba.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from gfnn_jax.families.family import at_time, form_of
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.flows.collective import Casimirs
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.kernel import cached, function
from gfnn_jax.flows.lifts import Itself
from gfnn_jax.flows.uniform import CaldirolaKanai, Uniform

STAGES = 8  # a constant of the compiled loops, as many as processors do at once
_MOST = 100  # iterations
_TRIED = 64  # steps, of the first two of which each way to begin their stages is tried
_KNOWN = 6  # steps before, by which stages begin: more amplify what jumps, by 2 to this power
_FLOOR, _SETTLED = 1.1e-17, 1.8e-12  # as in `flows.flow`: 0.05 eps, eps^¾
_SPLIT = 134217729.0  # 2²⁷ + 1 halves a number's digits (T. J. Dekker, Numer. Math. 18, 1971)
_PARALLEL = 1.0 + 1e-9  # as in `flows.collective`
_TWO_PI, _BEYOND = 2 * math.pi, 2.4492935982947064e-16  # 2π and what this number lacks of it
_MOST_OPERATIONS = 10_000  # of a gradient: JAX's products of matrices are faster beyond

# v_i = v_a + c v_b; c v_a v_b; c v_a; v_a^c; functions of v_a; INPUT stands first.
INPUT, CONSTANT, SUM, PRODUCT, SCALED, POWER, INVERSE, EXP, LOG, SIN, COS, ROOT, ABS = range(13)
TAN, SINH, COSH, TANH, ARCTAN = range(13, 18)
_FUNCTIONS = {
    "exp": EXP,
    "log": LOG,
    "sin": SIN,
    "cos": COS,
    "sqrt": ROOT,
    "fabs": ABS,
    "tan": TAN,
    "sinh": SINH,
    "cosh": COSH,
    "tanh": TANH,
    "arctan": ARCTAN,
}


class Program(NamedTuple):
    """Operations (N, 3) (kind, a, b) and their constants (N,); the places (W,) of the values.
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
    """Operations so far, each once."""

    def __init__(self, width: int):
        self.rows: list[tuple[int, int, int, float]] = [(INPUT, 0, 0, 0.0)] * width
        self.known: dict[tuple, int] = {}

    def put(self, kind: int, a: int, b: int, c: float) -> Node:
        row = kind, a, b, c
        if row not in self.known:
            self.known[row] = len(self.rows)
            self.rows.append(row)
        return Node(self, self.known[row])

    def operands(self, place: int) -> list[int]:
        """Places of what an operation takes."""
        kind, a, b, _ = self.rows[place]
        return [a, b] if kind in (SUM, PRODUCT) else [] if kind in (INPUT, CONSTANT) else [a]


def program(field: Callable[[np.ndarray, Any], Any], width: int, given: int) -> Program:
    """The program of a field (1, width) of states (1, width) and args (1, given), None where none
    are given.

    Raises TypeError or AttributeError for a field of which the tape has no operation.
    """
    tape = _Tape(inputs := width + given)
    nodes = np.array([[Node(tape, i) for i in range(inputs)]], dtype=object)
    values = np.ravel(field(nodes[:, :width], nodes[:, width:] if given else None))
    ends = [nodes[0, 0]._other(value).place for value in values]
    used, ahead = set(range(inputs)), list(ends)
    while ahead:
        place = ahead.pop()
        if place not in used:
            used.add(place)
            ahead += tape.operands(place)
    moving = set(range(width))
    for place in sorted(used):
        if any(of in moving for of in tape.operands(place)):
            moving.add(place)
    still = sorted(used - moving - set(range(inputs)))  # once in a step
    order = [*range(inputs), *still, *sorted(moving - set(range(width)))]
    at = {place: k for k, place in enumerate(order)}
    rows = [tape.rows[place] for place in order]
    code = [(kind, at.get(a, 0), at.get(b, 0)) for kind, a, b, _ in rows]
    found = np.array(code), np.array([row[3] for row in rows])
    return Program(*found, np.array([at[end] for end in ends]), inputs, inputs + len(still))


@function
def _two_sum(a, b):
    total = a + b
    rest = total - a
    return total, (a - (total - rest)) + (b - rest)


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
def _run(code, constants, v, places, stages):
    """Run the operations of these places at the states in v, one a column. Sums and products of all
    columns are done at once, functions one by one: of the ``stages`` that there are."""
    begin, end = places
    for i in range(begin, end):
        kind, a, b, c = code[i, 0], code[i, 1], code[i, 2], constants[i]
        if kind == PRODUCT:
            for s in range(STAGES):
                v[i, s] = c * v[a, s] * v[b, s]
        elif kind == SUM:
            for s in range(STAGES):
                v[i, s] = v[a, s] + c * v[b, s]
        elif kind == SCALED:
            for s in range(STAGES):
                v[i, s] = c * v[a, s]
        elif kind == CONSTANT:
            for s in range(STAGES):
                v[i, s] = c
        elif kind == INVERSE:
            for s in range(STAGES):
                v[i, s] = 1.0 / v[a, s]
        else:
            for s in range(stages):
                x = v[a, s]
                if kind == SIN:
                    v[i, s] = math.sin(x)
                elif kind == COS:
                    v[i, s] = math.cos(x)
                elif kind == EXP:
                    v[i, s] = math.exp(x)
                elif kind == LOG:
                    v[i, s] = math.log(x)
                elif kind == POWER:
                    v[i, s] = x**c
                elif kind == ROOT:
                    v[i, s] = math.sqrt(x)
                elif kind == ABS:
                    v[i, s] = abs(x)
                elif kind == TAN:
                    v[i, s] = math.tan(x)
                elif kind == SINH:
                    v[i, s] = math.sinh(x)
                elif kind == COSH:
                    v[i, s] = math.cosh(x)
                elif kind == TANH:
                    v[i, s] = math.tanh(x)
                else:
                    v[i, s] = math.atan(x)


@function
def _kept(w, moved, entries, values, slopes, system):
    """Move w (2, W), whose second row is what rounding has lost, without the invariants' change:
    `flows.collective.Casimirs.kept`. system: a row for each of their corrections, its matrix beside
    the change as a sum of two numbers."""
    width, count = w.shape[1], len(system)
    for k in range(count):
        system[k, count], system[k, count + 1] = 0.0, 0.0
        for i in range(width):
            slopes[k, i] = 0.0
    for e in range(len(entries)):
        k, a, b = entries[e, 0], entries[e, 1], entries[e, 2]
        by, rest = _two_product(values[e], moved[a])
        slope = values[e]
        if b >= 0:
            half, below = _two_sum(w[0, b], 0.5 * moved[b])
            at = by
            by, more = _two_product(at, half)
            rest = more + (at * (below + w[1, b]) + rest * half)
            slope *= w[0, b] + moved[b]
        system[k, count], error = _two_sum(system[k, count], by)
        system[k, count + 1] += error + rest
        slopes[k, a] += slope
    for k in range(count):
        system[k, count] += system[k, count + 1]
        for m in range(count):
            system[k, m] = 0.0
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
        begun, rest = _two_sum(w[0, i], moved[i])
        w[0, i], w[1, i] = _two_sum(begun, lost + rest)


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
        total, error = _two_sum(w[0, p + i], by)
        rest += error - share * w[1, q + i] + w[1, p + i]
        w[0, p + i], w[1, p + i] = _two_sum(total, rest)
        for before in slopes:
            for s in range(STAGES):
                before[p + i, s] -= share * before[q + i, s]


class Law(NamedTuple):
    """Tables of a law and its lift, for `roll`: the program of the field; places (F, 2) of the
    bracket's entries, and these; rows of the stages' couplings by columns of stages, and h b; the
    weights (K, K) of 1, …, K steps before in where a stage begins, and those of all stages of one
    step before; the invariants; the lift's
    ``fibres`` (S, 3); the sizes (W,) of w, what uniform friction makes of it in a substep, less 1;
    places (A,) of angles and their centres."""

    code: np.ndarray
    constants: np.ndarray
    ends: np.ndarray
    form: np.ndarray
    by_form: np.ndarray
    rule: np.ndarray
    ahead: np.ndarray
    within: np.ndarray
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
        for before in slopes:
            for s in range(STAGES):
                before[q, s] *= by
                before[p, s] /= by


@function
def _turned(w, place, centre):
    """Take whole turns from an angle, 2π to twice the digits: how many."""
    turns = np.rint((w[0, place] - centre) / _TWO_PI)
    if turns == 0.0 or not abs(turns) < np.inf:
        return 0.0
    by, rest = _two_product(-turns, _TWO_PI)
    total, error = _two_sum(w[0, place], by)
    w[0, place], w[1, place] = _two_sum(total, error + rest - turns * _BEYOND + w[1, place])
    return turns


@cached
def roll(law, task, substeps, inputs, moving):
    """Follow the lanes of a `Task`."""
    code, constants, ends, form, by_form, rule, ahead, within, entries, values = law[:10]
    fibres, unit, decay, angles, centre = law[10:]
    lanes, steps, width, count = task.out.shape[0], task.out.shape[1], len(unit), 0
    stages = 0
    while stages < STAGES and rule[STAGES, stages] != 0.0:
        stages += 1
    for e in range(len(entries)):
        count = max(count, entries[e, 0] + 1)
    v, new, moved = np.zeros((len(code), STAGES)), np.zeros((width, STAGES)), np.zeros(width)
    now, took = np.zeros((width, STAGES)), np.zeros(2)
    along, system = np.zeros((count, width)), np.zeros((count, count + 2))
    given = task.given.shape
    for lane in range(lanes):
        w, slopes, most, n = task.w[lane], task.slopes[lane], 0, 0
        goes, known = True, 0
        while known < len(ahead) and not np.isnan(slopes[known, 0, 0]):
            known += 1
        while goes and n < steps:
            for part_of in range(substeps):
                row, column = min(lane, given[0] - 1), min(n, given[1] - 1)
                for i in range(width, inputs):
                    for s in range(STAGES):
                        v[i, s] = task.given[row, column, part_of, i - width, s]
                _run(code, constants, v, (inputs, moving), stages)
                for i in range(width):
                    for s in range(STAGES):
                        now[i, s] = 0.0
                turn = n % _TRIED
                inside = turn if turn < 2 else int(took[1] < took[0])
                for k in range(known - 1, -1, -1):
                    weight = 0.0 if inside else ahead[known - 1, k]
                    for i in range(width):
                        for s in range(STAGES):
                            before = (1.0 + decay[i]) * slopes[k, i, s]
                            now[i, s] += weight * before
                            if k + 1 < len(ahead):
                                slopes[k + 1, i, s] = before
                if inside and known:
                    for i in range(width):
                        for t in range(stages):
                            before = (1.0 + decay[i]) * slopes[0, i, t]
                            for s in range(STAGES):
                                now[i, s] += within[t, s] * before
                last, change, iterations = np.inf, np.inf, 0
                while iterations < _MOST:
                    iterations += 1
                    for i in range(width):
                        for s in range(STAGES):
                            v[i, s] = 0.0
                        for t in range(stages):
                            for s in range(STAGES):
                                v[i, s] += rule[t, s] * now[i, t]
                        for s in range(STAGES):
                            v[i, s] += w[0, i]
                            new[i, s] = 0.0
                    _run(code, constants, v, (moving, len(code)), stages)
                    for e in range(len(form)):
                        i, j, by = form[e, 0], ends[form[e, 1]], by_form[e]
                        for s in range(STAGES):
                            new[i, s] += by * v[j, s]
                    change, total = 0.0, 0.0
                    for i in range(width):
                        part = (abs(w[0, i]) + unit[i]) / STAGES
                        for s in range(stages):
                            value = rule[STAGES, s] * new[i, s]
                            total += value
                            change = max(change, abs(value - now[i, s]) / part)
                            now[i, s] = value
                    if not abs(total) < np.inf:
                        goes = False
                        break
                    if change <= _FLOOR or (change <= _SETTLED and change > 0.5 * last):
                        break
                    last = change
                most = max(most, iterations)
                if turn < 2:
                    took[turn] = iterations
                goes = goes and change <= _SETTLED
                if not goes:
                    break
                for i in range(width):
                    moved[i] = 0.0
                    for s in range(STAGES):
                        slopes[0, i, s] = now[i, s]
                        moved[i] += now[i, s]
                    moved[i] += decay[i] * (w[0, i] + moved[i])
                known = min(known + 1, len(ahead))
                _kept(w, moved, entries, values, along, system)
            if not goes:
                break
            for e in range(len(fibres)):
                if fibres[e, 2]:
                    _sheared(w, slopes, fibres[e, 0], fibres[e, 1])
                else:
                    _balanced(w, slopes, fibres[e, 0], fibres[e, 1])
            for e in range(len(angles)):
                task.turns[lane, n, e] = _turned(w, angles[e], centre[e])
            for i in range(width):
                task.out[lane, n, 0, i], task.out[lane, n, 1, i] = w[0, i], w[1, i]
            n += 1
        task.fine[lane], task.most[lane] = n, most


class Task(NamedTuple):
    """N lanes: their states w (N, 2, W), whose second row is what rounding has lost, the stages
    (N, K, W, stages) of the steps before, the last one first, NaN of none, and the args (N or 1, M
    or 1, substeps, k, stages) of M steps; and what becomes of them: the states out (N, M, 2, W),
    NaN from where a step fails, the turns (N, M, A) that angles made in each step, how many steps
    did not fail (N,), and the most iterations of one (N,)."""

    w: np.ndarray
    slopes: np.ndarray
    given: np.ndarray
    out: np.ndarray
    turns: np.ndarray
    fine: np.ndarray
    most: np.ndarray


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
        try:
            found = program(lambda w, given: family.gradient(flow.params, w, given), width, args)
        except (TypeError, AttributeError):
            return None
        form = form_of(family, width)
        places = np.argwhere(form)
        casimirs = getattr(family, "casimirs", Casimirs((), ()))
        entries, values = lift.quadratic_invariants or (casimirs.entries, casimirs.values)
        entries = np.array(entries, np.int64).reshape(-1, 3)
        fibres = np.array(getattr(lift, "fibres", ()), np.int64).reshape(-1, 3)
        rule = _rule(flow.stages, h)
        law = (*found[:3], places, form[tuple(places.T)], rule, _ahead(), _within(flow.stages))
        law = (*law, entries, np.asarray(values, float), fibres, np.asarray(unit, float), decay)
        law = (*law, np.array(angles, np.int64), np.array(centre, float))
        owned = tuple(np.require(a, requirements=["C", "W", "O"]) for a in law)
        return cls(flow, lift, Law(*owned), (found.inputs, found.moving))

    def begun(self, z: np.ndarray, lost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (N, 2, W) and stages of lanes at z + lost (N, n), from which they go on."""
        w = self.lift.up(np.asarray(z, np.longdouble) + lost)
        rounded = w.astype(float)
        w = np.stack([rounded, (w - rounded).astype(float)], axis=1)
        return w, np.full((len(w), _KNOWN, w.shape[2], STAGES), np.nan)

    def steps(self, lanes: tuple[np.ndarray, np.ndarray], count: int, args: Any) -> Task:
        """Follow lanes by ``count`` steps. args: (N or 1, M or 1, k) as each begins, or None."""
        num, angles = len(lanes[0]), len(self.law.angles)
        task = Task(
            *lanes,
            self._given(args),
            np.full((num, count, *lanes[0].shape[1:]), np.nan),
            np.zeros((num, count, angles)),
            np.zeros(num, np.int64),
            np.zeros(num, np.int64),
        )
        roll(self.law, task, self.flow.substeps, *self.sizes)  # pyright: ignore[reportCallIssue]
        return task

    def _given(self, args: Any) -> np.ndarray:
        """Args of all stages, as `Task` has them."""
        flow, family, shape = self.flow, self.flow.family, (1, 1)
        if args is not None:
            shape, args = args.shape[:2], args.reshape(-1, args.shape[-1])
        found = np.zeros((*shape, flow.substeps, self.sizes[0] - len(self.law.unit), STAGES))
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
        return self.lift.down(w.astype(np.longdouble).sum(axis=-2)).astype(float)


def _rule(stages: int, h: float) -> np.ndarray:
    """The rows of Gauss's rule that `Law` has; stages that it lacks have no weight."""
    rule, found = gauss(stages), np.zeros((STAGES + 1, STAGES))
    found[:stages, :stages] = rule.coupling.T
    found[-1, :stages] = h * rule.weights
    return found


def _within(stages: int) -> np.ndarray:
    """(stages, stages): weights of the stages of a step, by rows, in those of the next, of the
    polynomial through them."""
    rule, found = gauss(stages), np.zeros((STAGES, STAGES))
    powers = np.arange(stages)
    ahead = np.linalg.inv((rule.nodes - 0.5)[:, None] ** powers).T
    ahead = ahead @ ((rule.nodes + 0.5) ** powers[:, None])
    found[:stages, :stages] = ahead * rule.weights / rule.weights[:, None]
    return found


def _ahead() -> np.ndarray:
    """(K, K): weights of values at −1, …, −k in that at 0 of the polynomial through them, a row for
    each k."""
    weights = [[(-1) ** j * math.comb(k + 1, j + 1) for j in range(_KNOWN)] for k in range(_KNOWN)]
    return np.array(weights, float)
