"""Motion of a law between samples, with its derivatives in the state and in the coefficients.

The equation of motion is linear in the coefficients p of a law, r(q, v, a; p) = 0, so that with the
acceleration known all its derivatives are explicit:

    ∂a/∂x = −M⁻¹ ∂r/∂x,      ∂a/∂p_k = −M⁻¹ r_k,      r_k the residual of term k alone

One step between two samples is a Runge–Kutta step of Dormand and Prince (order 5), with as many
substeps as the fastest motion asks; all steps of a recording are taken at once, as one batch.
Where dry friction has no width its force jumps: `flows.coulomb` steps from one jump to the next.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.lagrangian import (
    UNIFORM,
    Friction,
    Lagrangian,
    Powers,
    Terms,
    functions_of,
)
from gfnn_jax.flows.dissipation import Dissipation
from gfnn_jax.flows.quadratic import Parts, Quadratic
from gfnn_jax.solve.linear import among, inverses

# Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19: the solution of order 5.
NODES = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1])
_A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
    ]
)
WEIGHTS = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])


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


@dataclasses.dataclass(frozen=True, eq=False)
class Form:
    """A law whose coefficients are free: terms with θ = ``fixed`` + ``basis`` c (the gauge),
    friction, and gains of the inputs. Its coefficients are (c, ρ, G row by row); that of a row of
    friction of the kind UNIFORM is γ, of the force −γ ∂L/∂v. They are p (count,), or (N, count) of
    N states that follow laws of their own; phases of the terms are then (P,) or (N, P). powers: of
    parameters that systems differ in, by which (θ, ρ, G) are multiplied (`in_systems`).
    quadratic, dissipation: made of the terms and the friction, and of those of the form that this
    one was made from where they are the same."""

    terms: Terms
    fixed: np.ndarray
    basis: np.ndarray
    friction: Friction
    num_inputs: int = 0
    powers: Powers | None = None
    quadratic: Quadratic = None  # pyright: ignore[reportAssignmentType]
    dissipation: Dissipation = None  # pyright: ignore[reportAssignmentType]

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

    def in_systems(self, p: np.ndarray, args: np.ndarray) -> tuple[Form, np.ndarray, np.ndarray]:
        """The form whose coefficients are (θ, ρ, G) of one system, their values (A, n) in systems
        of parameters args (A, k), and the derivatives (A, n, count) of these in p (count,)."""
        count, own = self.terms.count, self.basis.shape[1]
        turn = np.zeros((count + self.count - own, self.count))
        turn[:count, :own] = self.basis
        turn[count:, own:] = np.eye(self.count - own)
        whole = turn @ p
        whole[:count] += self.fixed
        weights = functions_of(self.powers or ((),) * len(whole), args)
        form = dataclasses.replace(self, fixed=0 * self.fixed, basis=np.eye(count), powers=None)
        return form, weights * whole, weights[..., None] * turn

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
            for j in np.flatnonzero(_A[i]):
                step = _A[i, j] * h
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
