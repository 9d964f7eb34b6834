"""Motion of laws by NumPy, many lanes at once: what the compiled kernel is compared with.

`Form` is a law with free coefficients whose substeps are those of Dormand and Prince, and `step`
one with events of dry friction. Both follow `flows.kernel` formula by formula, in another order of
sums."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.lagrangian import (
    DRY,
    LINEAR,
    QUADRATIC,
    UNIFORM,
    Friction,
    Lagrangian,
    Powers,
    Terms,
)
from gfnn_jax.flows import motion
from gfnn_jax.flows.dormand_prince import NODES, STAGES, WEIGHTS

_ALIKE = 1e-9  # of the largest entry, added for unknowns that depend on each other


def among(some, matrix, rhs):
    """x (B, n, m) with matrix (B, n, n) x = rhs (B, n, m) among ``some`` (B, n) of the unknowns, 0
    of the others; the least x where they depend on each other (Tikhonov's, iterated once). some:
    mask; the diagonal of the matrix is not 0 there."""
    if some.sum(axis=1).max(initial=0) <= 1:
        own = np.where(some, np.diagonal(matrix, axis1=1, axis2=2), 1.0)
        return np.where(some[..., None], rhs, 0.0) / own[..., None]
    both = some[:, :, None] & some[:, None, :]
    size = np.abs(matrix).max(axis=(1, 2), initial=0.0)[:, None]
    own = np.where(some, _ALIKE * size, 1.0)[:, :, None] * np.eye(some.shape[1])
    matrix = np.where(both, matrix, 0.0)
    rhs = np.where(some[..., None], rhs, 0.0)
    found = np.linalg.solve(matrix + own, rhs)
    return found + np.linalg.solve(matrix + own, rhs - matrix @ found)


def inverses(matrices: np.ndarray) -> np.ndarray:
    """The inverses (n, n, N) of regular matrices."""
    return np.linalg.inv(matrices.transpose(2, 0, 1)).transpose(1, 2, 0)


@dataclasses.dataclass(frozen=True, eq=False)
class Dissipation:
    """Rows of ``friction`` that are not uniform: their directions (F, d), the outer products of
    these (d², F), which rows (indices) are linear, quadratic, or dry and smoothed, the widths (n,
    1) of those, and which are dry without a width. even: of all rows, which are uniform."""

    friction: Friction
    directions: np.ndarray
    outer: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray
    smoothed: np.ndarray
    widths: np.ndarray
    coulomb: np.ndarray
    even: np.ndarray

    @classmethod
    def of(cls, friction: Friction) -> Dissipation:
        even = friction.kinds == UNIFORM
        own = friction.take(~even)
        c, coulomb = own.directions.astype(float), coulomb_rows(own)
        outer = (c[:, :, None] * c[:, None]).reshape(len(c), c.shape[1] ** 2).T
        smoothed = np.flatnonzero((own.kinds == DRY) & ~coulomb)
        linear, quadratic = (np.flatnonzero(own.kinds == kind) for kind in (LINEAR, QUADRATIC))
        widths = own.widths[smoothed][:, None]
        return cls(
            friction, c, outer, linear, quadratic, smoothed, widths, np.flatnonzero(coulomb), even
        )

    def derivatives(self, v: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
        """dr/ds and d²r/ds² (F, N) of the terms r of R, at velocities v (d, N); with ``order`` 0
        the second ones are not all computed. As `Friction.tables`, row by row."""
        s = self.directions @ v
        first, second = np.sign(s), np.zeros_like(s)
        first[self.linear] = s[self.linear]
        first[self.quadratic] *= s[self.quadratic] ** 2
        if len(self.smoothed):
            root = np.hypot(s[self.smoothed], self.widths)
            first[self.smoothed] = s[self.smoothed] / root
            second[self.smoothed] = (self.widths / root) ** 2 / root  # ε²/root³ underflows
        if order:
            second[self.linear] = 1.0
            second[self.quadratic] = 2 * np.abs(s[self.quadratic])
        return first, second


def coulomb_rows(friction: Friction) -> np.ndarray:
    """The dry friction (F,) that has no width: its force jumps where its speed turns."""
    return (friction.kinds == DRY) & (friction.widths == 0)


class Parts(NamedTuple):
    """M (d, d, N) and w (d, N), their derivatives in q (…, d, N) and second ones (…, d, d, N);
    the force −∂V/∂q (d, N) and its derivatives (d, d, N); the potentials f_j (P, N) of the terms
    and their slopes (P, d, N). What was not asked for may be empty."""

    masses: np.ndarray
    drift: np.ndarray
    masses_by: np.ndarray
    drift_by: np.ndarray
    force: np.ndarray
    masses_by_two: np.ndarray
    drift_by_two: np.ndarray
    force_by: np.ndarray
    potentials: np.ndarray
    slopes: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Quadratic:
    """Terms, but for their phases, as they make M, w and −V.

    terms: which these are. weights: S (R, P), R = d² + d + 1. of_slopes: (R d, P), −S_rj m_ji.
    of_curvatures: (R d², P), −S_rj m_ji m_jk. modes: m (P, d). plain: whether the terms are cosines
    alone. products, linear, constant: A, b and c of `Terms.quadratic`, as (P d, d), (P, d, 1) and
    (P, 1).
    """

    terms: Terms
    weights: np.ndarray
    of_slopes: np.ndarray
    of_curvatures: np.ndarray
    modes: np.ndarray
    plain: bool
    products: np.ndarray
    linear: np.ndarray
    constant: np.ndarray

    @classmethod
    def of(cls, terms: Terms) -> Quadratic:
        A, b, c = terms.quadratic()
        count, d = b.shape
        weights = np.concatenate([A.reshape(count, d * d), b, c[:, None]], axis=1).T
        modes = terms.modes.astype(float)
        slopes = -weights[:, None] * modes.T
        curvatures = slopes[:, :, None] * modes.T
        return cls(
            terms,
            np.ascontiguousarray(weights),
            slopes.reshape(-1, count),
            curvatures.reshape(-1, count),
            modes,
            not np.any(terms.powers) and not terms.shapes,
            A.reshape(count * d, d),
            b[..., None],
            c[:, None],
        )

    def is_of(self, terms: Terms) -> bool:
        """Return whether these are the terms, of any phases."""
        own = self.terms
        same = own.speeds is terms.speeds and own.modes is terms.modes
        return same and own.powers is terms.powers and own.shapes is terms.shapes

    def parts(self, terms: Terms, theta: np.ndarray, q: np.ndarray, order: int) -> Parts:
        """The parts of L at q (d, N), with coefficients θ (P, 1) or (P, N); with ``order`` 1 or 2
        second derivatives too, with 2 the slopes of each term. terms: these with any phases, (P,)
        or (N, P)."""
        (count, d), num = self.modes.shape, q.shape[1]
        curved = slopes = nothing = np.zeros(0)
        if self.plain:
            phase = self.modes @ q
            phase += terms.phases.T if terms.phases.ndim > 1 else terms.phases[:, None]
            f, sin = np.cos(phase), np.sin(phase)
            weighted = theta * f
            sums, steep = self.weights @ weighted, self.of_slopes @ (theta * sin)
            if order:
                curved = self.of_curvatures @ weighted
            if order > 1:
                slopes = -sin[:, None] * self.modes[..., None]
        else:
            found = terms.potentials(q.T, order=2 if order else 1)
            f, slopes = found.value.T, found.slope.transpose(1, 2, 0)
            sums = self.weights @ (theta * f)
            steep = self.weights @ (theta[:, None] * slopes).reshape(count, d * num)
            if order:
                curvature = theta[:, None, None] * found.curvature.transpose(1, 2, 3, 0)
                curved = self.weights @ curvature.reshape(count, d * d * num)
        steep = steep.reshape(len(sums), d, num)
        M, w = slice(d * d), slice(d * d, d * d + d)
        by_two = (nothing, nothing, nothing)
        if order:
            curved = curved.reshape(len(sums), d, d, num)
            by_two = (curved[M].reshape(d, d, d, d, num), curved[w], curved[-1])
        return Parts(
            sums[M].reshape(d, d, num),
            sums[w],
            steep[M].reshape(d, d, d, num),
            steep[w],
            steep[-1],
            *by_two,
            f,
            slopes,
        )

    def residuals(self, parts: Parts, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """d/dt ∂ℓ_j/∂v − ∂ℓ_j/∂q (P, d, N) of each term ℓ_j along motion with velocities v and
        accelerations a (d, N)."""
        (count, d), num = self.modes.shape, v.shape[1]
        moved = (self.products @ v).reshape(count, d, num)
        kinetic = np.einsum("pin,in->pn", 0.5 * moved + self.linear, v) + self.constant
        moved += self.linear
        rows = (self.products @ a).reshape(count, d, num)
        rows *= parts.potentials[:, None]
        along = np.einsum("pin,in->pn", parts.slopes, v)
        rows += moved * along[:, None]
        rows -= kinetic[:, None] * parts.slopes
        return rows

    def momenta(self, parts: Parts, v: np.ndarray) -> np.ndarray:
        """∂ℓ_j/∂v (P, d, N) of each term."""
        moved = (self.products @ v).reshape(*self.modes.shape, v.shape[1]) + self.linear
        return moved * parts.potentials[:, None]


class Step(NamedTuple):
    """States after a step (N, 2d), and their derivatives in the states before (N, 2d, 2d) and in
    the coefficients (N, 2d, n)."""

    states: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


class Rates(NamedTuple):
    """Accelerations a (N, d), their derivatives in q, v and, where asked for, in the coefficients
    (N, d, 2d + n), and the forces λ (N, F) of dry friction that slides or sticks."""

    a: np.ndarray
    by: np.ndarray
    held: np.ndarray


def oracle(form: motion.Form) -> Form:
    """The same law, followed by NumPy."""
    names = [field.name for field in dataclasses.fields(motion.Form)]
    return Form(**{name: getattr(form, name) for name in names})


@dataclasses.dataclass(frozen=True, eq=False)
class Form:
    """A law whose coefficients are free: terms with θ = ``fixed`` + ``basis`` c (the gauge),
    friction, and gains of the inputs. Its coefficients are (c, ρ, G row by row); that of a row of
    friction of the kind UNIFORM is γ, of the force −γ ∂L/∂v. They are p (count,), or (N, count) of
    N states that follow laws of their own; phases of the terms are then (P,) or (N, P). powers: of
    parameters that systems differ in, by which (θ, ρ, G) are multiplied.
    quadratic, dissipation: made of the terms and the friction, and of those of the form that this
    one was made from where they are the same."""

    terms: Terms
    fixed: np.ndarray
    basis: np.ndarray
    friction: Friction
    num_inputs: int = 0
    powers: Powers | None = None
    quadratic: Quadratic = None
    dissipation: Dissipation = None

    def __post_init__(self):
        if self.quadratic is None or not self.quadratic.is_of(self.terms):
            object.__setattr__(self, "quadratic", Quadratic.of(self.terms))
        if self.dissipation is None or self.dissipation.friction is not self.friction:
            object.__setattr__(self, "dissipation", Dissipation.of(self.friction))

    @property
    def dim(self) -> int:
        return self.terms.dim

    @property
    def count(self) -> int:
        return self.basis.shape[1] + self.friction.count + self.dim * self.num_inputs

    @property
    def identity(self) -> np.ndarray:
        """Derivatives (2d, 2d + count) of a state in itself and in the coefficients."""
        return np.eye(2 * self.dim, 2 * self.dim + self.count)

    def take(self, lanes: np.ndarray) -> Form:
        """The form of some lanes, where each has its own phases."""
        phases = self.terms.phases
        if phases.ndim == 1:
            return self
        return dataclasses.replace(
            self, terms=dataclasses.replace(self.terms, phases=phases[lanes])
        )

    def split(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """c, ρ and G (..., d, inputs) of p (..., count)."""
        ends = np.cumsum([self.basis.shape[1], self.friction.count])
        c, losses, gains = np.split(p, ends, axis=-1)
        return c, losses, gains.reshape(*p.shape[:-1], self.dim, self.num_inputs)

    def lagrangian(self, p: np.ndarray) -> Lagrangian:
        c, losses, gains = self.split(p)
        theta, even = self.fixed + c @ self.basis.T, self.friction.kinds == UNIFORM
        friction, uniform = self.friction.take(~even), losses[..., even].sum(axis=-1)
        powers = self.powers
        if powers is not None:  # γ has none
            first, last = self.terms.count, self.terms.count + len(even)
            of_friction = zip(powers[first:last], even, strict=True)
            of_friction = tuple(row for row, is_rate in of_friction if not is_rate)
            powers = (*powers[:first], *of_friction, *powers[last:])
        return Lagrangian(self.terms, theta, friction, losses[..., ~even], uniform, gains, powers)

    def accelerate(
        self,
        law: Lagrangian,
        q: np.ndarray,
        v: np.ndarray,
        u: np.ndarray,
        order: int = 2,
        modes: np.ndarray | None = None,
    ) -> Rates:
        """The rates, with derivatives in the states (``order`` 1) and in the coefficients (2).
        modes: (N, F) of the dry friction without a width, 1 or −1 where it slides, 0 where it
        sticks."""
        a, by, held = self._rates(law, q.T, v.T, u.T, order, modes)
        return Rates(a.T, by.transpose(2, 0, 1), held)

    def _rates(
        self,
        law: Lagrangian,
        q: np.ndarray,
        v: np.ndarray,
        u: np.ndarray,
        order: int,
        modes: np.ndarray | None,
    ) -> Rates:
        """`accelerate` of q, v (d, N) and u (inputs, N): a (d, N), by (d, 2d + n, N), held (N, F).

        With the momentum p = M v + w the equation of motion is M a + (∂p/∂q) v − ∂L/∂q = force.
        """
        d, num = self.dim, q.shape[1]
        L = self.quadratic.parts(self.terms, _of_lanes(law.coefficients), q, order)
        losses, gamma = _of_lanes(law.losses), np.asarray(law.uniform)
        directions, dry = self.dissipation.directions, self.dissipation.coulomb
        pull, stiffness = self.dissipation.derivatives(v, order)
        if modes is not None:
            pull[dry] = modes.T
        turning = np.einsum("ikjn,kn->ijn", L.masses_by, v) + L.drift_by  # ∂p/∂q
        force = 0.5 * np.einsum("ijn,in->jn", turning + L.drift_by, v) + L.force
        force -= np.einsum("ijn,jn->in", turning, v)
        force -= directions.T @ (losses * pull)
        if self.num_inputs:
            gains = law.gains
            force += gains @ u if gains.ndim == 2 else np.einsum("nik,kn->in", gains, u)
        uniform, momentum = self.dissipation.even.any(), np.zeros(0)
        if uniform:
            momentum = np.einsum("ikn,kn->in", L.masses, v) + L.drift
            force -= gamma * momentum
        inverse = inverses(L.masses)
        a = np.einsum("ikn,kn->in", inverse, force)
        held, c = (losses * pull)[dry].T, directions[dry]
        stuck = np.zeros((num, 0), bool) if modes is None else modes == 0
        holds = np.flatnonzero(stuck.any(axis=1))
        if len(holds):
            moved = inverse[:, :, holds].transpose(2, 0, 1) @ c.T  # (n, d, F)
            holding = among(stuck[holds], c @ moved, np.broadcast_to(c, (len(holds), *c.shape)))
            forces = (holding @ a[:, holds].T[:, :, None])[..., 0]
            a[:, holds] -= (moved @ forces[..., None])[..., 0].T
            held[holds] += forces
        if not order:
            return Rates(a, np.zeros((d, 0, num)), held)
        width = 2 * d + (self.count if order > 1 else 0)
        by = np.empty((d, width, num))
        twisted = np.einsum("ikjln,kn->ijln", L.masses_by_two, v) + L.drift_by_two
        by_q, by_v = by[:, :d], by[:, d : 2 * d]
        np.einsum("ikln,kn->iln", L.masses_by, a, out=by_q)
        by_q += np.einsum("ijln,jn->iln", twisted, v)
        by_q -= 0.5 * np.einsum("miln,mn->iln", twisted + L.drift_by_two, v)
        by_q -= L.force_by
        np.einsum("iljn,jn->iln", L.masses_by, v, out=by_v)
        by_v += turning
        by_v -= turning.swapaxes(0, 1)
        by_v += (self.dissipation.outer @ (losses * stiffness)).reshape(d, d, num)
        if uniform:
            by_q += gamma * turning
            by_v += gamma * L.masses
        if order > 1:
            self._by_coefficients(by[:, 2 * d :], L, v, a, u, pull, gamma, momentum)
        by = np.einsum("ikn,kwn->iwn", -inverse, by)
        if len(holds):
            some = by[..., holds].transpose(2, 0, 1)
            by[..., holds] -= (moved @ (holding @ some)).transpose(1, 2, 0)
        return Rates(a, by, held)

    def _by_coefficients(
        self,
        by: np.ndarray,
        L: Parts,
        v: np.ndarray,
        a: np.ndarray,
        u: np.ndarray,
        pull: np.ndarray,
        gamma: np.ndarray,
        momentum: np.ndarray,
    ) -> None:
        """The residuals (d, n, N) of each coefficient alone, into ``by``."""
        d, own, num = self.dim, self.basis.shape[1], v.shape[1]
        rows = self.quadratic.residuals(L, v, a)
        even = self.dissipation.even
        if even.any():
            rows += gamma * self.quadratic.momenta(L, v)
        columns = self.basis.T @ rows.reshape(len(rows), d * num)
        by[:, :own] = columns.reshape(own, d, num).swapaxes(0, 1)
        losses = by[:, own : own + len(even)]
        losses[:, ~even] = self.dissipation.directions.T[..., None] * pull
        if even.any():
            losses[:, even] = momentum[:, None]
        if self.num_inputs:
            gains = by[:, own + len(even) :].reshape(d, d, self.num_inputs, num)
            gains[...] = -np.eye(d)[..., None, None] * u

    def step(
        self, p: np.ndarray, x: np.ndarray, h: np.ndarray, u: np.ndarray, order: int = 2
    ) -> Step:
        """One step h (N,) of states x (N, 2d) with its derivatives in the states (``order`` 1) and
        in the coefficients (2); u (N, substeps, 6, inputs) are the inputs at the nodes of each
        substep."""
        law, d, substeps = self.lagrangian(p), self.dim, u.shape[1]
        D = self.unmoved(len(x), order)
        for k in range(substeps):
            x, D, _ = self.substep(law, x, D, h / substeps, u[:, k], order)
        return Step(x, D[..., : 2 * d], D[..., 2 * d :])

    def unmoved(self, num: int, order: int) -> np.ndarray:
        """Derivatives of ``num`` states in themselves and in the coefficients, as far as ``order``
        asks for them."""
        width = (0, 2 * self.dim, 2 * self.dim + self.count)[order]
        return np.tile(self.identity[:, :width], (num, 1, 1))

    def substep(
        self,
        law: Lagrangian,
        x: np.ndarray,
        D: np.ndarray,
        h: np.ndarray,
        u: np.ndarray,
        order: int = 2,
        modes: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, Rates]:
        """States x (N, 2d) and their derivatives D (N, 2d, n) a time h (N,) later, with inputs u
        (N, 6, inputs) at its nodes, and the rates at its begin; ``order`` and ``modes`` as of
        `accelerate`."""
        d, rates, slopes = self.dim, [], []
        x, D, u = (
            np.array(of, order="C") for of in (x.T, D.transpose(1, 2, 0), u.transpose(1, 2, 0))
        )
        part, every = np.empty_like(D), []
        for i in range(6):
            xi, Di = x.copy(), D.copy() if order else D
            for j in np.flatnonzero(STAGES[i]):
                step = STAGES[i, j] * h
                xi += step * rates[j]
                if order:
                    Di += np.multiply(step, slopes[j], out=part)
            now = self._rates(law, xi[:d], xi[d:], u[i], order, modes)
            every.append(now)
            rates.append(np.concatenate([xi[d:], now.a]))
            if order:
                slope = np.empty_like(D)
                slope[:d] = Di[d:]
                np.einsum("ikn,kwn->iwn", now.by[:, : 2 * d], Di, out=slope[d:])
                slope[d:, 2 * d :] += now.by[:, 2 * d :]
                slopes.append(slope)
        for i in np.flatnonzero(WEIGHTS):
            step = WEIGHTS[i] * h
            x += step * rates[i]
            if order:
                D += np.multiply(step, slopes[i], out=part)
        a, by, held = every[0]
        return x.T, D.transpose(2, 0, 1), Rates(a.T, by.transpose(2, 0, 1), held)


def _of_lanes(values: np.ndarray) -> np.ndarray:
    """Coefficients (n,), or (N, n) of each lane, with the lanes last: (n, 1) or (n, N)."""
    return values[:, None] if values.ndim == 1 else values.T


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
