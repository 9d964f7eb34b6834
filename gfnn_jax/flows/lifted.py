"""Rollouts of laws with a bracket on numbers, compiled: the steps of `flows.flow`, lane by lane.

H∘π of a lift is written down as a list of sums and products, by running its family and its lift in
NumPy on arrays of `Node`s; a compiled loop reads the list at all stages of a step at once, forwards
and back for the gradient. So no law is compiled, and no family or lift needs code of its own.

States stay on the lift from the first step to the last, with what rounding loses of them. The
momenta of the fibres, quadratic in w, are what Casimirs are made of, and are kept to twice the
digits. The stages begin with the polynomial through those of the step before: that halves the
iterations, and changes nothing that they converge to. This module imports numba.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from gfnn_jax.flows.collective import Collective
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.kernel import _cached, _function
from gfnn_jax.phase_space import symplectic_form

STAGES = 8  # a constant of the compiled loops, as many as processors do at once
_MOST = 100  # iterations
_FLOOR, _SETTLED = 1.1e-17, 1.8e-12  # as in `flows.flow`: 0.05 eps, eps^¾
_SPLIT = 134217729.0  # 2²⁷ + 1 halves a number's digits (T. J. Dekker, Numer. Math. 18, 1971)
_PARALLEL = 1.0 + 1e-9  # as in `flows.collective`

# v_i = v_a + c v_b; c v_a v_b; c v_a; v_a^c; functions of v_a; INPUT stands first.
INPUT, CONSTANT, SUM, PRODUCT, SCALED, POWER, INVERSE, EXP, LOG, SIN, COS, ROOT = range(12)
_FUNCTIONS = {"exp": EXP, "log": LOG, "sin": SIN, "cos": COS, "sqrt": ROOT}


class Program(NamedTuple):
    """Operations (N, 3) (kind, a, b) and their constants (N,), inputs first, the value last."""

    code: np.ndarray
    constants: np.ndarray


class Node:
    """A number that is not known yet, at its place on a tape."""

    __array_ufunc__ = None  # arrays of nodes are arrays of objects: NumPy's numbers give way

    def __init__(self, tape: _Tape, place: int):
        self.tape, self.place = tape, place

    def __add__(self, other: Any) -> Any:
        if not isinstance(other, Node):
            return self if other == 0 else self + self.tape.put(CONSTANT, 0, 0, float(other))
        if other.place == self.place:
            return self * 2.0
        kind, a, _, c = self.tape.rows[other.place]
        if kind == SCALED:
            return self.tape.put(SUM, self.place, a, c)
        return self.tape.put(SUM, self.place, other.place, 1.0)

    def __mul__(self, other: Any) -> Any:
        rows = self.tape.rows
        if not isinstance(other, Node):
            if other == 0 or other == 1:
                return self if other else 0.0
            kind, a, b, c = rows[self.place]
            if kind in (SCALED, PRODUCT):
                return self.tape.put(kind, a, b, c * float(other))
            return self.tape.put(SCALED, self.place, 0, float(other))
        factor, places = 1.0, [self.place, other.place]
        for k, place in enumerate(places):
            if rows[place][0] == SCALED:
                factor, places[k] = factor * rows[place][3], rows[place][1]
        return self.tape.put(PRODUCT, min(places), max(places), factor)

    def __pow__(self, exponent: float) -> Any:
        if exponent == 2:
            return self * self
        kind = INVERSE if exponent == -1 else POWER
        return self.tape.put(kind, self.place, 0, float(exponent))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Any:
        return self * -1.0

    def __sub__(self, other: Any) -> Any:
        return self + other * -1.0

    def __rsub__(self, other: Any) -> Any:
        return self * -1.0 + other

    def __truediv__(self, other: Any) -> Any:
        return self * (other**-1)

    def __rtruediv__(self, other: Any) -> Any:
        return self**-1 * other

    def __getattr__(self, name: str) -> Callable[[], Node]:
        if name not in _FUNCTIONS:
            raise AttributeError(name)
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


def program(function: Callable[[np.ndarray], Any], width: int) -> Program:
    """The program of a function of states (1, width) whose value has one element.

    Raises TypeError or AttributeError for a function of which the tape has no operation.
    """
    tape = _Tape(width)
    nodes = np.array([[Node(tape, i) for i in range(width)]], dtype=object)
    value = np.asarray(function(nodes), dtype=object).ravel()[0]
    used, ahead = set(range(width)), [value.place]
    while ahead:
        place = ahead.pop()
        if place not in used:
            used.add(place)
            kind, a, b, _ = tape.rows[place]
            ahead += [a, b] if kind in (SUM, PRODUCT) else [a] if kind != CONSTANT else []
    at = {place: k for k, place in enumerate(sorted(used))}
    rows = [tape.rows[place] for place in sorted(used)]
    code = [(kind, at.get(a, 0), at.get(b, 0)) for kind, a, b, _ in rows]
    return Program(np.array(code), np.array([row[3] for row in rows]))


@_function
def _two_sum(a, b):
    total = a + b
    rest = total - a
    return total, (a - (total - rest)) + (b - rest)


@_function
def _high(a):
    split = _SPLIT * a
    return split - (split - a)


@_function
def _two_product(a, b):
    total, high, other = a * b, _high(a), _high(b)
    low, below = a - high, b - other
    return total, ((high * other - total) + high * below + low * other) + low * below


@_function
def _gradient(code, constants, v, d, g, width):
    """Run a program at the states in v, one a column, and back: ∂(value)/∂(inputs) in g."""
    count = len(code)
    for i in range(width, count):
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
        else:
            for s in range(STAGES):
                x = v[a, s]
                if kind == INVERSE:
                    v[i, s] = 1.0 / x
                    d[i, s] = -v[i, s] * v[i, s]
                elif kind == EXP:
                    v[i, s] = math.exp(x)
                    d[i, s] = v[i, s]
                elif kind == LOG:
                    v[i, s], d[i, s] = math.log(x), 1.0 / x
                elif kind == SIN:
                    v[i, s], d[i, s] = math.sin(x), math.cos(x)
                elif kind == COS:
                    v[i, s], d[i, s] = math.cos(x), -math.sin(x)
                elif kind == POWER:
                    v[i, s], d[i, s] = x**c, c * x ** (c - 1.0)
                else:
                    v[i, s] = math.sqrt(x)
                    d[i, s] = 0.5 / v[i, s]
    for i in range(count):
        for s in range(STAGES):
            g[i, s] = 0.0
    for s in range(STAGES):
        g[count - 1, s] = 1.0
    for i in range(count - 1, width - 1, -1):
        kind, a, b, c = code[i, 0], code[i, 1], code[i, 2], constants[i]
        if kind == PRODUCT:
            for s in range(STAGES):
                x = c * g[i, s]
                g[a, s] += x * v[b, s]
                g[b, s] += x * v[a, s]
        elif kind == SUM:
            for s in range(STAGES):
                g[a, s] += g[i, s]
                g[b, s] += c * g[i, s]
        elif kind == SCALED:
            for s in range(STAGES):
                g[a, s] += c * g[i, s]
        elif kind != CONSTANT:
            for s in range(STAGES):
                g[a, s] += d[i, s] * g[i, s]


@_function
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


@_function
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
        for s in range(STAGES):
            slopes[p + i, s] -= share * slopes[q + i, s]


class Law(NamedTuple):
    """Tables of a law and its lift, for `roll`: the program of H∘π; places (F, 2) of the bracket's
    entries, and these; rows of the stages' couplings and of the predictor, by columns of stages,
    and h b; the invariants; the lift's ``fibres`` (S, 3); and the sizes (W,) of w."""

    code: np.ndarray
    constants: np.ndarray
    form: np.ndarray
    by_form: np.ndarray
    rule: np.ndarray
    entries: np.ndarray
    values: np.ndarray
    fibres: np.ndarray
    unit: np.ndarray


@_function
def _balanced(w, slopes, q, p):
    """Make q and p of a Casimir coordinate q p of a size, by exact powers of two: they grow and
    shrink exponentially."""
    while abs(w[0, q]) > 4.0 * abs(w[0, p]) > 0.0 or abs(w[0, p]) > 4.0 * abs(w[0, q]) > 0.0:
        by = 0.5 if abs(w[0, q]) > abs(w[0, p]) else 2.0
        for k in range(2):
            w[k, q] *= by
            w[k, p] /= by
        for s in range(STAGES):
            slopes[q, s] *= by
            slopes[p, s] /= by


@_cached
def roll(law, w, slopes, out, substeps):
    """Step w (2, W) by as many steps as ``out`` (M, 2, W) has room for: how many succeeded, and the
    most iterations of one. slopes: (W, stages) of the step before."""
    code, constants, form, by_form, rule, entries, values, fibres, unit = law
    width, steps, count, size = w.shape[1], len(out), 0, (len(code), STAGES)
    for e in range(len(entries)):
        count = max(count, entries[e, 0] + 1)
    v, d, g = np.zeros(size), np.zeros(size), np.zeros(size)
    new, moved = np.zeros((width, STAGES)), np.zeros(width)
    along, system, most = np.zeros((count, width)), np.zeros((count, count + 2)), 0
    for n in range(steps):
        for _ in range(substeps):
            for i in range(width):
                for s in range(STAGES):
                    new[i, s] = 0.0
                for t in range(STAGES):
                    for s in range(STAGES):
                        new[i, s] += rule[STAGES + t, s] * slopes[i, t]
                for s in range(STAGES):
                    slopes[i, s] = new[i, s]
            before, change, iterations = np.inf, np.inf, 0
            while iterations < _MOST:
                iterations += 1
                for i in range(width):
                    for s in range(STAGES):
                        v[i, s] = 0.0
                    for t in range(STAGES):
                        for s in range(STAGES):
                            v[i, s] += rule[t, s] * slopes[i, t]
                    for s in range(STAGES):
                        v[i, s] += w[0, i]
                        new[i, s] = 0.0
                _gradient(code, constants, v, d, g, width)
                for e in range(len(form)):
                    i, j, by = form[e, 0], form[e, 1], by_form[e]
                    for s in range(STAGES):
                        new[i, s] += by * g[j, s]
                change, total = 0.0, 0.0
                for i in range(width):
                    part = (abs(w[0, i]) + unit[i]) / STAGES
                    for s in range(STAGES):
                        value = rule[2 * STAGES, s] * new[i, s]
                        total += value
                        change = max(change, abs(value - slopes[i, s]) / part)
                        slopes[i, s] = value
                if not abs(total) < np.inf:
                    return n, most
                # Change of the next iteration; the first one does not show how fast they shrink.
                ahead = change * min(change / before, 1.0) if iterations > 1 else change
                if change <= _SETTLED and (ahead <= _FLOOR or change > 0.5 * before):
                    break
                before = change
            most = max(most, iterations)
            if change > _SETTLED:
                return n, most
            for i in range(width):
                moved[i] = 0.0
                for s in range(STAGES):
                    moved[i] += slopes[i, s]
            _kept(w, moved, entries, values, along, system)
        for e in range(len(fibres)):
            if fibres[e, 2]:
                _sheared(w, slopes, fibres[e, 0], fibres[e, 1])
            else:
                _balanced(w, slopes, fibres[e, 0], fibres[e, 1])
        for i in range(width):
            out[n, 0, i], out[n, 1, i] = w[0, i], w[1, i]
    return steps, most


@dataclasses.dataclass(frozen=True, eq=False)
class Stepper:
    """A flow on a lift in the form that `roll` reads, of one lane after another."""

    lift: Any
    law: Law
    substeps: int

    MOST = _MOST  # iterations of a step

    @classmethod
    def of(cls, flow: Any) -> Stepper | None:
        """Tables of a flow; None of one without a lift, with another number of stages, of functions
        that no `Node` has, and inside ``jit``, ``grad`` or ``vmap``."""
        plain = isinstance(flow, Flow) and isinstance(flow.family, Collective)
        leaves = jax.tree.leaves(flow)
        if not plain or flow.stages != STAGES or any(isinstance(x, Tracer) for x in leaves):
            return None
        flow = jax.tree.map(np.asarray, flow)
        family, lift, h = flow.family, flow.family.lift, flow.dt / flow.substeps
        if np.ndim(h) or flow.newton or lift.quadratic_invariants is None:
            return None
        unit = lift.sizes(flow.scale)
        width = len(unit)
        try:
            found = program(lambda w: family.value(flow.params, w), width)
        except (TypeError, AttributeError):
            return None
        rule, form = gauss(STAGES), family.form
        form = symplectic_form(width // 2) if form is None else form
        places = np.argwhere(form)
        ahead = _extrapolated(rule.nodes) * rule.weights / rule.weights[:, None]
        rows = np.concatenate([rule.coupling.T, ahead, float(h) * rule.weights[None]])
        entries, values = lift.quadratic_invariants or (
            family.casimirs.entries,
            family.casimirs.values,
        )
        entries = np.array(entries, np.int64).reshape(-1, 3)
        fibres = np.array(getattr(lift, "fibres", ()), np.int64).reshape(-1, 3)
        law = (*found, places, form[tuple(places.T)], rows, entries, np.asarray(values, float))
        law = (*law, fibres, np.asarray(unit, float))
        owned = tuple(np.require(a, requirements=["C", "W", "O"]) for a in law)
        return cls(lift, Law(*owned), flow.substeps)

    def begun(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """State (2, W) and stages of a lane at z (n,), from which `roll` goes on."""
        w = self.lift.up(np.asarray(z, np.longdouble))
        rounded = w.astype(float)
        return np.stack([rounded, (w - rounded).astype(float)]), np.zeros((len(w), STAGES))

    def steps(self, lane: tuple[np.ndarray, np.ndarray], count: int) -> tuple[np.ndarray, int, int]:
        """The states (count, 2, W) that follow, NaN from where a step fails; how many did not fail,
        and the most iterations of one."""
        out = np.full((count, *lane[0].shape), np.nan)
        fine, most = roll(self.law, *lane, out, self.substeps)  # pyright: ignore[reportCallIssue]
        return out, fine, most

    def down(self, w: np.ndarray) -> np.ndarray:
        """States (M, n) of the lift's (M, 2, W), to their last digit."""
        return self.lift.down(w.astype(np.longdouble).sum(axis=1)).astype(float)


def _extrapolated(nodes: np.ndarray) -> np.ndarray:
    """(s, s): values at the nodes of the next step of the polynomials that are 1 at one node and 0
    at the others, by rows of these."""
    ahead = 1.0 + nodes
    apart = nodes[:, None] - nodes + np.eye(len(nodes))
    found = np.empty((len(nodes), len(nodes)))
    for j in range(len(nodes)):
        others = np.arange(len(nodes)) != j
        found[j] = np.prod((ahead - nodes[others, None]) / apart[j, others, None], axis=0)
    return found
