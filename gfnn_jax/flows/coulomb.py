"""Motion with Coulomb's dry friction: bodies slide, or stick. States, and their derivatives.

Dry friction of a law may have a width ε of speeds, |s| as √(s² + ε²); a body that it holds creeps
then. Where it has none,

    M a = f(q, v) − Σ c λ,      λ = ρ sign(s) where s slides,      |λ| ≤ ρ, c·a = 0 where it sticks

with s = c·v for each direction c (J. J. Moreau, in "Nonsmooth Mechanics and Applications" (1988)
1). As long as no direction changes from one to the other the motion is smooth, followed by
Runge–Kutta steps. A step in which a sliding speed turns, or a λ that holds passes ρ, ends there: at
the root of a cubic through the speeds and their slopes at the step's ends, or of a line through λ.
Where a speed turns at the time τ the acceleration jumps from a₋ to a₊, and so do derivatives D of
the state, for τ depends on it too (M. A. Aizerman & F. R. Gantmacher, Q. J. Mech. Appl. Math. 11
(1958) 225):

    D → D + (0, a₋ − a₊) dτ,      dτ = −c·D_v / c·a₋

A direction that sticks has lost the error of its speed.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.flows.dissipation import coulomb_rows
from gfnn_jax.flows.motion import NODES, Form, Rates, Step
from gfnn_jax.solve.linear import among

_EVENTS = 64  # of a lane in one substep, after which it has no solution
_APART_FROM = 1e-6  # of a direction, left of others that it depends on
_HALVINGS = 40  # of a step, to the root of its cubic
_OTHERS = np.array([np.delete(NODES, j) for j in range(6)])  # nodes beside each node (6, 5)
_APART = NODES[:, None] - _OTHERS


def step(
    form: Form,
    p: np.ndarray,
    x: np.ndarray,
    h: np.ndarray,
    u: np.ndarray,
    order: int = 2,
    modes: np.ndarray | None = None,
) -> tuple[Step, np.ndarray]:
    """`Form.step` of laws with dry friction of any kind, and the modes (N, F) in which it ends:
    which directions without a width slide forward, 1, or backward, −1, and which stick, 0.
    ``modes``: those in which it begins, by default those of the states."""
    if not coulomb_rows(form.friction).any():
        return form.step(p, x, h, u, order), np.zeros((len(x), 0))
    motion, d = _Motion(form, p, order), form.dim
    modes = motion.begin(x, u[:, 0, 0]) if modes is None else modes
    D = form.unmoved(len(x), order)
    with np.errstate(all="ignore"):  # of lanes without a solution, which become NaN
        for k in range(u.shape[1]):
            x, D, modes = motion.substep(x, D, modes, h / u.shape[1], u[:, k])
    return Step(x, D[..., : 2 * d], D[..., 2 * d :]), modes


def modes_of(form: Form, p: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The modes (N, F) in which states x (N, 2d) start, with inputs u (N, inputs)."""
    if not coulomb_rows(form.friction).any():
        return np.zeros((len(x), 0))
    return _Motion(form, p, 0).begin(x, u)


@dataclasses.dataclass(frozen=True, eq=False)
class _Motion:
    """A law whose dry friction slides or sticks, with coefficients p (count,) or (N, count).

    States are x = (q, v) (N, 2d), their derivatives D (N, 2d, n), inputs u (N, inputs).
    """

    form: Form
    p: np.ndarray
    order: int

    @cached_property
    def directions(self) -> np.ndarray:
        """c (F, d)."""
        rows = coulomb_rows(self.form.friction)
        return self.form.friction.directions[rows].astype(float)

    def losses(self, lanes: np.ndarray) -> np.ndarray:
        """ρ (n, F) of some lanes."""
        friction = self.form.split(self.p)[1][..., coulomb_rows(self.form.friction)]
        return friction[lanes] if friction.ndim > 1 else np.tile(friction, (len(lanes), 1))

    def speeds(self, x: np.ndarray) -> np.ndarray:
        """s = c·v (N, F)."""
        return x[:, self.form.dim :] @ self.directions.T

    def rates(self, lanes, x, modes, u) -> Rates:
        """The rates of some lanes in these modes."""
        form, law = self._of(lanes)
        d = form.dim
        return form.accelerate(law, x[:, :d], x[:, d:], u, 0, modes)

    @cached_property
    def _law(self) -> Lagrangian:
        return self.form.lagrangian(self.p)

    def _of(self, lanes: np.ndarray) -> tuple[Form, Lagrangian]:
        """The form and the law of some lanes."""
        form = self.form.take(lanes)
        if form is self.form and self.p.ndim == 1:
            return form, self._law
        return form, form.lagrangian(self.p[lanes] if self.p.ndim > 1 else self.p)

    def begin(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The modes in which states start."""
        lanes = np.arange(len(x))
        modes = np.sign(self.speeds(x))
        modes[(modes == 0) & (self.losses(lanes) <= 0)] = 1
        return self._released(lanes, x, modes, u)

    def substep(self, x, D, modes, h, u):
        """States, derivatives and modes a time h (N,) later, with inputs u (N, 6, inputs) at its
        nodes; NaN of lanes with more events than can be followed."""
        x, D, modes, done = x.copy(), D.copy(), modes.copy(), np.zeros(len(x))
        turned = np.zeros(
            modes.shape, bool
        )  # directions without friction that have: once in a step
        lanes = np.arange(len(x))
        self._forget(lanes, D, x, modes, u[:, 0])
        for _ in range(_EVENTS):
            if not len(lanes):
                return x, D, modes
            now, left = u[lanes], 1 - done[lanes]
            if done.any():
                now = _within(now, done[lanes], np.ones(len(lanes)))
            before, mode = x[lanes], modes[lanes]
            new, moved, first = self._smooth(
                lanes, before, D[lanes], left * h[lanes], now, mode, self.order
            )
            part = np.ones(len(lanes))
            speeds = self.speeds(before) * mode, self.speeds(new) * mode
            speeds[1][turned[lanes] | self._carried(mode)] = 0
            open_ = np.flatnonzero(np.any((speeds[1] < 0) | (mode == 0), axis=1))
            cut, event = open_, np.zeros(0, int)
            if len(open_):
                last = self.rates(lanes[open_], new[open_], mode[open_], now[open_, -1])
                along = (left * h[lanes])[open_, None] * mode[open_]
                slopes = [along * (a @ self.directions.T) for a in (first.a[open_], last.a)]
                spare = [
                    self.losses(lanes[open_]) - np.abs(k) for k in (first.held[open_], last.held)
                ]
                shares, event = _first(mode[open_], *(s[open_] for s in speeds), *slopes, *spare)
                part[open_] = shares
                cut, event = open_[shares < 1], event[shares < 1]
            if len(cut):
                some, k = lanes[cut], (np.arange(len(cut)), event)
                for order in (0, self.order):  # the root of the cubic, and Newton's step from it
                    inside = _within(now[cut], np.zeros(len(cut)), part[cut])
                    span = part[cut] * left[cut] * h[some]
                    at, by, _ = self._smooth(
                        some, before[cut], D[some], span, inside, mode[cut], order
                    )
                    rates = self.rates(some, at, mode[cut], inside[:, -1])
                    slope = _turning((rates.a @ self.directions.T)[k], mode[cut][k])
                    short = self.speeds(at)[k] / slope / (left[cut] * h[some])
                    part[cut] = np.clip(part[cut] - short, 0, 1)
                new[cut], moved[cut], modes[some] = self._changed(
                    some, at, by, mode[cut], event, inside[:, -1], rates, slope
                )
                turned[some, event] = self.losses(some)[k] <= 0
            x[lanes], D[lanes] = new, moved
            done[lanes] = np.where(part < 1, done[lanes] + part * left, 1.0)
            lanes = lanes[cut][done[lanes[cut]] < 1]
        x[lanes] = np.nan
        return x, D, modes

    def _smooth(self, lanes, x, D, h, u, modes, order):
        form, law = self._of(lanes)
        D = D if order else D[..., :0]
        return form.substep(law, x, D, h, u, order, modes)

    def _changed(self, lanes, x, D, modes, event, u, before, slope):
        """States, derivatives and modes where the direction ``event`` (n,) changes its own, speeds
        that stick 0; before, slope: the rates there, and that of its speed (n,). A direction
        without friction turns and does not stick."""
        k, c, d = (np.arange(len(x)), event), self.directions, self.form.dim
        x, modes = x.copy(), modes.copy()
        stops = np.where(self.losses(lanes)[k] > 0, 0, -modes[k])
        modes[k] = np.where(modes[k] != 0, stops, np.sign(before.held[k]))
        x[:, d:] -= self._impulse(lanes, x, modes, self.speeds(x)[..., None])[..., 0]
        modes = self._released(lanes, x, modes, u)
        after = self.rates(lanes, x, modes, u)
        late = -np.einsum("nd,ndw->nw", c[event], D[:, d:]) / slope[:, None]
        D = D.copy()
        D[:, d:] += (before.a - after.a)[..., None] * late[:, None]
        return x, D, modes

    def _impulse(self, lanes, x, modes, speeds):
        """The change of velocities (n, d, m) that takes away the speeds (n, F, m) of directions
        that stick."""
        form, law = self._of(lanes)
        masses, c = law.masses(x[:, : form.dim]), self.directions
        pushed = np.linalg.solve(masses, np.broadcast_to(c.T, (len(x), *c.T.shape)))
        return pushed @ among(modes == 0, c @ pushed, speeds)

    def _forget(self, lanes, D, x, modes, u) -> None:
        """Take from derivatives the speeds of directions that stick: they end at once."""
        d, some = self.form.dim, np.flatnonzero(np.any(modes == 0, axis=1))
        if len(some):
            off = self.directions @ D[some, d:]
            D[some, d:] -= self._impulse(lanes[some], x[some], modes[some], off)

    def _carried(self, modes) -> np.ndarray:
        """The directions (n, F) that slide by their modes and whose speeds are sums of those that
        stick, as a relative speed where both bodies do: they are 0, and turn nowhere. λ is then ρ
        there, and the others hold the rest."""
        carried = np.zeros(modes.shape, bool)
        some = np.flatnonzero(np.sum(modes == 0, axis=1) > 1)
        if len(some):
            stuck, c = modes[some] == 0, self.directions
            alike = np.broadcast_to(c @ c.T, (len(some), len(c), len(c)))
            left = c - among(stuck, alike, alike).swapaxes(1, 2) @ c
            carried[some] = ~stuck & (np.abs(left).max(axis=2) < _APART_FROM)
        return carried

    def _released(self, lanes, x, modes, u) -> np.ndarray:
        """Modes without the directions that stick by a λ beyond ρ, the farthest beyond it first:
        they slide to where λ held them from."""
        modes = modes.copy()
        some = np.flatnonzero(np.any(modes == 0, axis=1))
        for _ in range(modes.shape[1]):
            if not len(some):
                break
            held = self.rates(lanes[some], x[some], modes[some], u[some]).held
            beyond = np.where(modes[some] == 0, np.abs(held) - self.losses(lanes[some]), 0.0)
            open_ = np.flatnonzero(beyond.max(axis=1, initial=0.0) > 0)
            k = some[open_], np.argmax(beyond, axis=1)[open_]
            modes[k] = np.sign(held[open_, k[1]])
            some = some[open_]
        return modes


def _turning(slope: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """The rate of a speed that turns; infinite of one that is let go, where nothing jumps."""
    return np.where((mode != 0) & (slope != 0), slope, np.inf)


def _within(u: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Inputs u (n, 6, k) at the nodes of the part of a step from ``begin`` to ``end`` (n,), by the
    polynomial through those at the nodes of the whole."""
    at = begin[:, None] + (end - begin)[:, None] * NODES
    return np.prod((at[..., None, None] - _OTHERS) / _APART, axis=-1) @ u


def _first(modes, before, after, slope_before, slope_after, spare_before, spare_after):
    """The part (n,) of a step at which its first direction changes, 1 where none does, and which
    one (n,), of (n, F) at the step's ends: the speeds and their slopes along the modes, and by how
    much λ is below ρ."""
    part = np.ones(modes.shape)
    turns = (modes != 0) & (after < 0)
    part[turns] = _root(before[turns], after[turns], slope_before[turns], slope_after[turns])
    lost = (modes == 0) & (spare_after < 0)
    begun = np.maximum(spare_before[lost], 0)
    part[lost] = begun / (begun - spare_after[lost])
    event = np.argmin(part, axis=1)
    return part[np.arange(len(part)), event], event


def _root(before, after, slope_before, slope_after) -> np.ndarray:
    """The part of a step at which the cubic with these values and slopes at its ends, first above
    and then below zero, crosses it."""
    low, high = np.zeros(len(before)), np.ones(len(before))
    for _ in range(_HALVINGS):
        s = 0.5 * (low + high)
        r = 1 - s
        value = r * r * ((1 + 2 * s) * before + s * slope_before)
        value += s * s * ((1 + 2 * r) * after - r * slope_after)
        low, high = np.where(value > 0, s, low), np.where(value > 0, high, s)
    return high
