"""Motion of a law between samples, with its derivatives in the state and in the coefficients.

A law with free coefficients is followed by steps of Dormand and Prince, with as many substeps as
the fastest motion asks, from one event of dry friction to the next; `flows.kernel` is what computes
them."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gfnn_jax.families.friction import UNIFORM, Friction
from gfnn_jax.families.lagrangian import Lagrangian, Powers, Terms, functions_of

if TYPE_CHECKING:
    from gfnn_jax.flows.tables import Tables


class Step(NamedTuple):
    """States after a step (N, 2d), and their derivatives in the states before (N, 2d, 2d) and in
    the coefficients (N, 2d, n); the modes (N, F) in which it ends, of frictions without a width: 1
    where they slide forward, -1 backward, 0 where they stick; and a status (N,), 0 of lanes that
    were followed. Of steps one after another, `Form.follow`, each but the status is (N, M, ...)."""

    states: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray
    modes: np.ndarray
    status: np.ndarray


class Rates(NamedTuple):
    """Accelerations (N, d), and their derivatives in the states (N, d, 2d) and in the coefficients
    (N, d, n)."""

    values: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


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

    @cached_property
    def _tables(self) -> Tables:
        from gfnn_jax.flows.tables import Tables  # loads LLVM: not before a law is followed

        return Tables.of(self.terms, self.basis, self.friction, self.num_inputs)

    def with_phases(self, phases: np.ndarray) -> Form:
        """The form with other phases, (P,) or (N, P), of which its tables do not depend."""
        terms = dataclasses.replace(self.terms, phases=phases)
        other = dataclasses.replace(self, terms=terms)
        other.__dict__["_tables"] = self._tables
        return other

    def step(
        self,
        p: np.ndarray,
        x: np.ndarray,
        h: np.ndarray,
        u: np.ndarray,
        order: int = 2,
        modes: np.ndarray | None = None,
    ) -> Step:
        """One step h (N,) of states x (N, 2d) with its derivatives in the states (``order`` 1) and
        in the coefficients (2); u (N, substeps, 6, inputs) are the inputs at the nodes of each
        substep. modes: (N, F) in which it begins, by default those of the states. A lane that has
        no solution, or more events than can be followed, is NaN."""
        found = self.follow(p, x, h[:, None], u[:, None], order, modes)
        states, by_state, by_coefficients = (part[:, 0] for part in found[:3])
        return Step(states, by_state, by_coefficients, found.modes[:, 0], found.status)

    def rates(self, p: np.ndarray, x: np.ndarray, u: np.ndarray, h: float, order: int = 2) -> Rates:
        """Accelerations at states x (N, 2d) under inputs u (N, inputs), with their derivatives, by
        differences over two steps h from there that err by h²/3 of their second derivative."""
        d, count = self.dim, len(x)
        p = np.tile(p, (2, 1)) if p.ndim > 1 else p
        steps = h * np.repeat([1.0, 2.0], count)
        inputs = np.tile(u[:, None, None], (2, 1, 6, 1))
        found = self.step(p, np.tile(x, (2, 1)), steps, inputs, order)
        parts = (part.reshape(2, count, *part.shape[1:])[:, :, d:] for part in found[:3])
        one = np.broadcast_to(np.eye(2 * d)[d:], (count, d, 2 * d))
        values, by_state, by_coefficients = (
            (4 * near - far - 3 * here) / (2 * h)
            for (near, far), here in zip(parts, (x[:, d:], one, 0.0), strict=True)
        )
        return Rates(values, by_state, by_coefficients)

    def follow(
        self,
        p: np.ndarray,
        x: np.ndarray,
        h: np.ndarray,
        u: np.ndarray,
        order: int = 2,
        modes: np.ndarray | None = None,
    ) -> Step:
        """`step`, M of them one after another, h (N, M) and u (N, M, substeps, 6, inputs): the
        states after each, with its derivatives in the state before it and in the coefficients.

        Raises ValueError where the arrays are not of as many lanes: compiled code checks no index.
        """
        from gfnn_jax.flows import kernel

        width, frictions = 2 * self.dim, self.friction.count
        columns = (0, width, width + self.count)[order]
        own, turns = self.basis.shape[1], np.atleast_2d(self.terms.phases)
        with np.errstate(all="ignore"):  # of lanes without a law, which become NaN
            theta = self.fixed + p[..., :own] @ self.basis.T
            turns = np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
        whole = np.concatenate([theta, p[..., own:]], axis=-1)
        laws = _owned(np.atleast_2d(whole)), _owned(turns)
        begun = np.full((len(x), frictions), np.nan) if modes is None else modes
        lanes = (x.shape, begun.shape, u.shape[:2], u.shape[4:])
        asked = ((len(h), width), (len(h), frictions), h.shape, (self.num_inputs,))
        if lanes != asked or not all(len(rows) in (1, len(h)) for rows in laws):
            raise ValueError(f"expected states, modes, steps and inputs {asked}, got {lanes}")
        given = _owned(x), _owned(begun), _owned(h), _owned(u)
        states, by = np.empty((*h.shape, width)), np.empty((*h.shape, width, columns))
        after, status = np.empty((*h.shape, frictions)), np.empty(len(x), np.int64)
        task = kernel.Task(*given, states, by, after, status)
        tables = self._tables
        kernel.follow(tables.whole, tables.room(columns), laws, task, order)
        by = task.by
        return Step(task.states, by[..., :width], by[..., width:], task.after, task.status)


def _owned(values: np.ndarray) -> np.ndarray:
    """Contiguous numbers that may be written, as compiled code takes them."""
    if values.dtype == np.float64 and values.flags.carray:  # as most are: NumPy takes ten times
        return values
    return np.require(values, np.float64, ["C", "W"])
