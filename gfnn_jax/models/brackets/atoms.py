"""H that is no polynomial, of a known bracket: quadratic terms and a few shapes of one coordinate,
1/(1.5 + Γ3) or exp(−2 z1), their constants fitted through the flow too.

What the quadratic H leaves of the images, brought to the middle of the step, is linear in what H
lacks: the shape whose mean velocity B∇f along the paths explains most of it comes next. NumPy.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from gfnn_jax.brackets import Bracket
from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms, joined
from gfnn_jax.fitting.significance import beside
from gfnn_jax.models.brackets.fields import FieldFit, fit_field, path_of
from gfnn_jax.models.brackets.poisson_field import PoissonField, hamiltonian_of
from gfnn_jax.models.textbook.atoms import Argument, Factor, constants_of, with_constants
from gfnn_jax.models.textbook.dictionary import singles
from gfnn_jax.models.textbook.shapes import text_of, values
from gfnn_jax.phase_space import sizes


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the search for shapes (benchmarks/brackets.py)."""

    rows: int = 300  # pairs by which the next shape is chosen
    atoms: int = 2  # at most
    exact: float = 1e-11  # of the spread: a residual that is roundoff
    continued: int = 16  # shapes of each round that go through the flow, at most
    near: float = 0.3  # of the best one's part of what is left, that they explain


OPTIONS = Options()


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
    for _ in range(OPTIONS.atoms):
        if best.relative <= OPTIONS.exact:
            break
        found = [best]
        for atom in _next(best, pairs):
            start = ShapedField.of(bracket, base, (*best.field.atoms, atom))
            with contextlib.suppress(FitError):
                found.append(fit_field(start, *pairs, np.append(best.c, 0.0)))
                shape = text(found[-1].field.atoms[-1], base.names)
                on_progress(f"H with {shape}: {found[-1].relative:.1e}")
            if found[-1].relative <= OPTIONS.exact:
                break
        least = min(found, key=lambda one: one.relative)
        if least is best or least.relative > 0.5 * best.relative:
            break
        best = least
    # The constants in six digits, which they may be in truth.
    rounded = best.field.with_constants(np.array([float(f"{t:.6g}") for t in best.field.constants]))
    left = path_of(rounded, best.c, *pairs, sizes(np.concatenate([z0, z1]))).relative
    field = rounded if left <= max(best.relative, OPTIONS.exact) else best.field
    return field.library, best.c


def text(atom: Factor, names: tuple[str, ...]) -> str:
    """The atom as formulas write it."""
    return text_of(atom.kind, names[atom.place], "", atom.theta)


def _next(best: FieldFit, pairs: Pairs) -> list[Factor]:
    """The atoms that explain most of what is left, of different shapes."""
    z0, z1, dt = pairs
    some = slice(None, None, max(1, len(z0) // OPTIONS.rows))
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
        if score < OPTIONS.near * found[0][0] or len(chosen) == OPTIONS.continued:
            break
        chosen.setdefault(atom.form, atom)
    return list(chosen.values())
