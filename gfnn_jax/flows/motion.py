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
    DRY,
    UNIFORM,
    Friction,
    Lagrangian,
    Powers,
    Terms,
    functions_of,
)
from gfnn_jax.solve.linear import among

# Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19: the solution of order 5.
NODES = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1])
_A = np.array([
    [0, 0, 0, 0, 0, 0],
    [1 / 5, 0, 0, 0, 0, 0],
    [3 / 40, 9 / 40, 0, 0, 0, 0],
    [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
    [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
    [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
])  # fmt: skip
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
    parameters that systems differ in, by which (θ, ρ, G) are multiplied (`in_systems`)."""

    terms: Terms
    fixed: np.ndarray
    basis: np.ndarray
    friction: Friction
    num_inputs: int = 0
    powers: Powers | None = None

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
        self, law: Lagrangian, q: np.ndarray, v: np.ndarray, u: np.ndarray, order: int = 2,
        modes: np.ndarray | None = None,
    ) -> Rates:  # fmt: skip
        """The rates, with derivatives in the states (``order`` 1) and in the coefficients (2).
        modes: (N, F) of the dry friction without a width, 1 or −1 where it slides, 0 where it
        sticks."""
        f, df, ddf = self.terms.potentials(q, order=2 if order else 1)
        g, dg = self.terms.motion(v)
        A, _, _ = self.terms.quadratic()
        theta, d = law.coefficients, self.dim
        gamma = np.asarray(law.uniform)[..., None]
        A = A.reshape(-1, d * d)
        even = self.friction.kinds == UNIFORM
        _, pull, stiffness = law.friction.tables(v)
        directions = law.friction.directions
        dry = coulomb_rows(law.friction)
        if modes is not None:
            pull[:, dry] = modes
        along = np.einsum("npi,ni->np", df, v)
        forced, turned = theta * g, np.einsum("np,npi->ni", theta * along, dg)
        force = np.einsum("np,npi->ni", forced, df) - turned - (law.losses * pull) @ directions
        if self.num_inputs:
            force = force + (law.gains @ u[..., None])[..., 0]
        if even.any():
            momentum = np.einsum("np,npi->ni", theta * f, dg)
            force = force - gamma * momentum
        masses = ((theta * f) @ A).reshape(-1, d, d)
        inverse = np.linalg.inv(masses) if d > 1 else 1 / masses
        a = np.einsum("nij,nj->ni", inverse, force)
        held, c = law.losses[..., dry] * pull[:, dry], directions[dry].astype(float)
        stuck = np.zeros((len(a), 0)) if modes is None else modes == 0
        holds = np.flatnonzero(stuck.any(axis=1))
        if len(holds):
            moved = inverse[holds] @ c.T  # (n, d, F)
            holding = among(stuck[holds], c @ moved, np.broadcast_to(c, (len(holds), *c.shape)))
            forces = (holding @ a[holds, :, None])[..., 0]
            a[holds] -= (moved @ forces[..., None])[..., 0]
            held[holds] += forces
        if not order:
            return Rates(a, np.zeros((*a.shape, 0)), held)
        push = (a @ A.reshape(-1, d).T).reshape(df.shape)
        weighted = theta[..., None] * df
        by_q = push.swapaxes(1, 2) @ weighted
        by_q += dg.swapaxes(1, 2) @ (theta[..., None] * np.einsum("npij,nj->npi", ddf, v))
        by_q -= np.einsum("np,npij->nij", forced, ddf)
        turned = dg.swapaxes(1, 2) @ weighted
        outer = (directions[:, :, None] * directions[:, None, :]).reshape(-1, d * d)
        by_v = ((theta * along) @ A + (law.losses * stiffness) @ outer).reshape(-1, d, d)
        by_v = by_v + turned - turned.swapaxes(1, 2)
        if even.any():
            by_q += gamma[..., None] * turned
            by_v = by_v + gamma[..., None] * masses
        columns = [by_q, by_v]
        if order > 1:
            rows, part = push * f[..., None], dg * along[..., None]
            rows += part
            rows -= np.multiply(g[..., None], df, out=part)
            if even.any():
                rows += gamma[..., None] * np.multiply(f[..., None], dg, out=part)
            columns.append(rows.swapaxes(1, 2) @ self.basis)
            by_losses = np.empty((len(v), d, len(even)))
            by_losses[..., ~even] = (pull[..., None] * directions).swapaxes(1, 2)
            if even.any():
                by_losses[..., even] = momentum[..., None]
            columns.append(by_losses)
        if order > 1 and self.num_inputs:
            pushed = -u[:, None, None, :] * np.eye(d)[:, :, None]
            columns.append(pushed.reshape(len(v), d, -1))
        by = -inverse @ np.concatenate(columns, axis=-1)
        if len(holds):
            by[holds] -= moved @ (holding @ by[holds])
        return Rates(a, by, held)

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
        self, law: Lagrangian, x: np.ndarray, D: np.ndarray, h: np.ndarray, u: np.ndarray,
        order: int = 2, modes: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, Rates]:  # fmt: skip
        """States x (N, 2d) and their derivatives D (N, 2d, n) a time h (N,) later, with inputs u
        (N, 6, inputs) at its nodes, and the rates at its begin; ``order`` and ``modes`` as of
        `accelerate`."""
        d, every, rates, slopes = self.dim, [], [], []
        h, wide, part = h[:, None], h[:, None, None], np.empty_like(D)
        for i in range(6):
            xi, Di = x, D.copy()
            for j in np.flatnonzero(_A[i]):
                xi = xi + _A[i, j] * h * rates[j]
                Di += np.multiply(_A[i, j] * wide, slopes[j], out=part)
            now = self.accelerate(law, xi[:, :d], xi[:, d:], u[:, i], order, modes)
            every.append(now)
            slope = np.empty_like(D)
            if order:
                slope[:, :d] = Di[:, d:]
                slope[:, d:] = now.by[..., : 2 * d] @ Di
                slope[:, d:, 2 * d :] += now.by[..., 2 * d :]
            rates.append(np.concatenate([xi[:, d:], now.a], axis=1))
            slopes.append(slope)
        D = D.copy()
        for i in np.flatnonzero(WEIGHTS):
            x = x + WEIGHTS[i] * h * rates[i]
            D += np.multiply(WEIGHTS[i] * wide, slopes[i], out=part)
        return x, D, every[0]


def coulomb_rows(friction: Friction) -> np.ndarray:
    """The dry friction (F,) that has no width: its force jumps where its speed turns."""
    return (friction.kinds == DRY) & (friction.widths == 0)
