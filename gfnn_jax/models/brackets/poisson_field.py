"""ż = B(z) ∇H(z) as a family of fields that is linear in the coefficients of H, and H of a field
whose bracket is known. NumPy."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog

from gfnn_jax.brackets import Bracket
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.damped import Dilations
from gfnn_jax.phase_space import TIME


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of H from a field (benchmarks/brackets.py)."""

    # singular value ÷ the largest, columns in units of the terms' sizes: of a Casimir
    casimir: float = 1e-9
    zero: float = 1e-7  # ÷ the largest, in these units: a coefficient that is none


OPTIONS = Options()


@dataclasses.dataclass(frozen=True)
class PoissonField:
    """f = Σ_j c_j B ∇φ_j − Σ_k c_k E_k z, φ the terms of H, E_k those of uniform friction.

    States may have parameters, which stay, and the time, which goes on, behind the n coordinates.
    """

    bracket: Bracket
    library: Terms
    friction: Dilations | None = None

    @property
    def num(self) -> int:
        """Number of coefficients."""
        return self.library.num_parameters + len(self._matrices)

    @cached_property
    def _matrices(self) -> np.ndarray:
        n = self.bracket.size
        return np.zeros((0, n, n)) if self.friction is None else self.friction.matrices

    def take(self, rows: list[int]) -> PoissonField:
        """The field of these coefficients alone."""
        count = self.library.num_parameters
        library = self.library.take([row for row in rows if row < count])
        kept = [row - count for row in rows if row >= count]
        friction = self.friction.take(kept) if self.friction is not None and kept else None
        return PoissonField(self.bracket, library, friction)

    def with_bracket(self, bracket: Any) -> PoissonField:
        """The same H, and friction, of another bracket of the same kind."""
        friction = self.friction and self.friction.about(bracket)
        return PoissonField(bracket, self.library, friction)

    def of_h(self, c) -> np.ndarray:
        """Select the coefficients of H."""
        return c[: self.library.num_parameters]

    def damping(self, c) -> np.ndarray:
        """E (n, n)."""
        return np.tensordot(c[self.library.num_parameters :], self._matrices, 1)

    def rate(self, c, z):
        """f (N, n)."""
        n = self.bracket.size
        own, gradient = z[:, :n], self.library.gradient(self.of_h(c), z)[:, :n]
        found = np.zeros_like(z)
        found[:, :n] = np.einsum("nij,nj->ni", self.bracket.matrix(own), gradient)
        if self.friction is not None:
            found[:, :n] -= own @ self.damping(c).T
        if self.library.names[n:] and self.library.names[-1] == TIME:
            found[:, -1] = 1.0
        return found

    def jacobian(self, c, z):
        """∂f/∂z (N, n, n); that of B by complex steps, which are exact of polynomials."""
        n = self.bracket.size
        gradient, hessian = self.library.gradient_and_hessian(self.of_h(c), z)
        own, gradient = z[:, :n], gradient[:, :n]
        found = np.zeros((*z.shape, z.shape[1]))
        inner = found[:, :n, :n]
        inner += self.bracket.matrix(own) @ hessian[:, :n, :n] - self.damping(c)
        for k, h in enumerate(np.maximum(np.abs(own).max(axis=0), 1e-300) * 1e-20):
            moved = own.astype(complex)
            moved[:, k] += 1j * h
            inner[:, :, k] += np.einsum("nij,nj->ni", self.bracket.matrix(moved).imag / h, gradient)
        return found

    def columns(self, z):
        """B ∇φ_j and −E_k z (N, n, J)."""
        n, found = self.bracket.size, np.zeros((*z.shape, self.num))
        own, gradients = z[:, :n], self.library.term_gradients(z)[:, :n]
        found[:, :n, : gradients.shape[2]] = self.bracket.matrix(own) @ gradients
        found[:, :n, gradients.shape[2] :] = -np.einsum("kij,nj->nik", self._matrices, own)
        return found


class OfField(NamedTuple):
    """H of a field. c: (J,) coefficients, sparse modulo Casimirs. misfit: of B∇H against the field,
    RMS ÷ its RMS. free: number of combinations of terms that are Casimirs."""

    c: np.ndarray
    misfit: float
    free: int


def hamiltonian_of(
    field: PoissonField, z: np.ndarray, f: np.ndarray, noise: float = 0.0
) -> OfField:
    """H with B∇H = f, or with friction B∇H − Ez = f, at states z (N, ≥ n), by linear least squares;
    of all that differ by Casimirs the one with the smallest sum of its coefficients' sizes, in
    units of the terms. f: (N, ≥ n), of which the first n count.

    noise: of f, relative: what of singular values is none.
    """
    f = f[:, : field.bracket.size]
    units, scale = term_sizes(field.library, z), np.sqrt(np.mean(f**2, axis=0)) + 1e-300
    units = np.append(units, np.ones(field.num - len(units)))
    columns = field.columns(z)[:, : f.shape[1]] / units / scale[:, None]
    matrix, right = columns.reshape(-1, field.num), (f / scale).ravel()
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    known = s > max(OPTIONS.casimir, noise) * s[0]
    c = vt[known].T @ ((u.T @ right)[known] / s[known])
    kernel = np.linalg.svd(vt[known], full_matrices=True)[2][known.sum() :]
    least = sparse(c, kernel)
    kept = np.abs(least) > max(OPTIONS.zero, noise) * np.abs(least).max(initial=0.0)
    solved = np.zeros(len(c))
    solved[kept] = np.linalg.lstsq(matrix[:, kept], right, rcond=1e-13)[0]
    misfit = float(np.sqrt(np.mean((matrix @ solved - right) ** 2) / np.mean(right**2)))
    return OfField(solved / units, misfit, len(kernel))


def term_sizes(library: Terms, z: np.ndarray) -> np.ndarray:
    """(J,) the RMS of each term's variation over the states."""
    values = library.term_values(z)
    size = np.sqrt(np.mean(values**2, axis=0))
    return np.where(size > 0, size, 1.0)


def sparse(c: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """c + t · kernel (m, J) of the smallest Σ|c_j|, whose vertex has at least m zeros."""
    if not len(kernel):
        return c
    count, own = len(c), len(kernel)
    # c + kernelᵀ t = a − b with a, b ≥ 0: least Σ(a + b)
    equal = np.hstack([kernel.T, -np.eye(count), np.eye(count)])
    cost = np.concatenate([np.zeros(own), np.ones(2 * count)])
    bounds = [(None, None)] * own + [(0, None)] * (2 * count)
    found = linprog(cost, A_eq=equal, b_eq=-c, bounds=bounds, method="highs-ds")
    return c if found.x is None else c + found.x[:own] @ kernel
