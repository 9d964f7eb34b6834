"""ż = B(z) ∇H(z) as a family of fields that is linear in the coefficients of H, and H of a field
whose bracket is known. NumPy.

H may be no polynomial, but quadratic terms and a few shapes of one coordinate, 1/(1.5 + Γ3) or
exp(−2 z1), their constants fitted through the flow too. What the quadratic H leaves of the images,
brought to the middle of the step, is linear in what H lacks: the shape whose mean velocity B∇f
along the paths explains most of it comes next.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog

from gfnn_jax.brackets import Bracket
from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms, joined
from gfnn_jax.fitting.significance import beside
from gfnn_jax.flows.damped import Dilations
from gfnn_jax.models.brackets.fields import FieldFit, fit_field, path_of
from gfnn_jax.models.textbook.atoms import Argument, Factor, constants_of, with_constants
from gfnn_jax.models.textbook.dictionary import singles
from gfnn_jax.models.textbook.shapes import text_of, values
from gfnn_jax.phase_space import TIME, sizes


class Options:
    """Options of H from a field (benchmarks/brackets.py)."""

    # singular value ÷ the largest, columns in units of the terms' sizes: of a Casimir
    casimir: float = 1e-9
    zero: float = 1e-7  # ÷ the largest, in these units: a coefficient that is none
    # Of the search for shapes:
    rows: int = 300  # pairs by which the next shape is chosen
    atoms: int = 2  # at most
    exact: float = 1e-11  # of the spread: a residual that is roundoff
    continued: int = 16  # shapes of each round that go through the flow, at most
    near: float = 0.3  # of the best one's part of what is left, that they explain


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
    known = s > max(Options.casimir, noise) * s[0]
    c = vt[known].T @ ((u.T @ right)[known] / s[known])
    kernel = np.linalg.svd(vt[known], full_matrices=True)[2][known.sum() :]
    least = sparse(c, kernel)
    kept = np.abs(least) > max(Options.zero, noise) * np.abs(least).max(initial=0.0)
    solved = np.zeros(len(c))
    solved[kept] = np.linalg.lstsq(matrix[:, kept], right, rcond=1e-13)[0]
    misfit = float(np.sqrt(np.mean((matrix @ solved - right) ** 2) / np.mean(right**2)))
    return OfField(solved / units, misfit, len(kernel))


def term_sizes(library: Terms, z: np.ndarray) -> np.ndarray:
    """(J,) the RMS of each term's variation over the states."""
    size = np.sqrt(np.mean(library.term_values(z) ** 2, axis=0))
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


Pairs = tuple[np.ndarray, np.ndarray, Any]  # z0, z1 (N, n), dt a number or (N,)


@dataclasses.dataclass(frozen=True)
class ShapedField(PoissonField):
    """B∇H, H of a base and of atoms behind it, whose constants are fitted too (`fields.Shaped`)."""

    atoms: tuple[Factor, ...] = ()

    @classmethod
    def of(cls, bracket: Bracket, base: Terms, atoms: tuple[Factor, ...]) -> ShapedField:
        """Make the field of a base and these atoms."""
        texts = tuple(text(atom, base.names) for atom in atoms)
        own = tuple(map(tuple, np.eye(len(texts), dtype=int).tolist()))
        library = joined(base, Terms(0, texts, own, (), base.names)) if atoms else base
        return cls(bracket, library, atoms=atoms)

    @property
    def base(self) -> Terms:
        """The terms that are no atoms."""
        return self.library.take(range(self.num - len(self.atoms)))

    @property
    def constants(self) -> np.ndarray:
        """(I,) of the atoms that have one."""
        return np.array(constants_of(self.atoms))

    def by_constants(self, c: np.ndarray, z: np.ndarray) -> np.ndarray:
        """∂f/∂θ (N, n, I), by complex steps."""
        matrix, found, step = self.bracket.matrix(z), [], 1e-30
        for weight, atom in zip(c[-len(self.atoms) :], self.atoms, strict=True):
            if atom.theta is not None:
                x, theta = z[:, atom.place] + 0j, atom.theta + 1j * step
                slope = values(atom.kind, x, theta)[1].imag / step
                found.append(weight * matrix[:, :, atom.place] * slope[:, None])
        return np.stack(found, axis=-1)

    def with_constants(self, theta: np.ndarray) -> ShapedField:
        """The same shapes with other constants (I,)."""
        atoms = with_constants(self.atoms, theta.tolist())
        return ShapedField.of(self.bracket, self.base, atoms)


def with_shapes(
    bracket: Bracket, base: Terms, pairs: Pairs, on_progress: Callable[[str], Any]
) -> tuple[Terms, np.ndarray]:
    """The best H of the base and up to two shapes for pairs (N, n), as far as each lowers what is
    left: its terms and their coefficients. Raises FitError where not even the base has a flow."""
    z0, z1, dt = pairs
    middle, rate = 0.5 * (z0 + z1), (z1 - z0) / np.reshape(dt, (-1, 1))
    field = ShapedField.of(bracket, base, ())
    best = fit_field(field, *pairs, hamiltonian_of(field, middle, rate).c)
    for _ in range(Options.atoms):
        if best.relative <= Options.exact:
            break
        found = [best]
        for atom in _next(best, pairs):
            start = ShapedField.of(bracket, base, (*best.field.atoms, atom))
            with contextlib.suppress(FitError):
                found.append(fit_field(start, *pairs, np.append(best.c, 0.0)))
                shape = text(found[-1].field.atoms[-1], base.names)
                on_progress(f"H with {shape}: {found[-1].relative:.1e}")
            if found[-1].relative <= Options.exact:
                break
        least = min(found, key=lambda one: one.relative)
        if least is best or least.relative > 0.5 * best.relative:
            break
        best = least
    # The constants in six digits, which they may be in truth.
    rounded = best.field.with_constants(np.array([float(f"{t:.6g}") for t in best.field.constants]))
    left = path_of(rounded, best.c, *pairs, sizes(np.concatenate([z0, z1]))).relative
    field = rounded if left <= max(best.relative, Options.exact) else best.field
    return field.library, best.c


def text(atom: Factor, names: tuple[str, ...]) -> str:
    """The atom as formulas write it."""
    return text_of(atom.kind, names[atom.place], "", atom.theta)


def _next(best: FieldFit, pairs: Pairs) -> list[Factor]:
    """The atoms that explain most of what is left, of different shapes."""
    z0, z1, dt = pairs
    some = slice(None, None, max(1, len(z0) // Options.rows))
    z0, z1 = z0[some], z1[some]
    dt = dt[some] if np.ndim(dt) else dt
    field, h, spread = best.field, np.reshape(dt, (-1, 1)), sizes(z0)
    path = path_of(field, best.c, z0, z1, dt, spread)
    middle = 0.5 * (z0 + z1 - path.residual)
    target = (path.target / spread).ravel()
    columns = (h[..., None] * field.columns(middle) / spread[:, None]).reshape(len(target), -1)
    basis = np.linalg.svd(columns, full_matrices=False)[0]
    target, found = beside(basis, target), list[tuple[float, Factor]]()
    along = h[..., None] * field.bracket.matrix(middle) / spread[:, None]
    with np.errstate(all="ignore"):
        for place, x in enumerate(np.concatenate([middle, z0, z1]).T):
            atoms, _, slopes = singles(place, Argument("", x, x, index=place), 1)
            whole = (along[..., place] * slopes[:, : len(z0), None]).reshape(len(atoms), -1).T
            own = beside(basis, whole)
            size = np.linalg.norm(own, axis=0)
            score = np.where(
                size > 1e-6 * np.linalg.norm(whole, axis=0), np.abs(target @ own) / size, np.nan
            )
            found += zip(score.tolist(), atoms, strict=True)
    found = sorted((one for one in found if np.isfinite(one[0])), key=lambda one: -one[0])
    chosen: dict[Any, Factor] = {}
    for score, atom in found:
        if score < Options.near * found[0][0] or len(chosen) == Options.continued:
            break
        chosen.setdefault(atom.form, atom)
    return list(chosen.values())
