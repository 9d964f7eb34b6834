"""H that is no polynomial, of a known bracket: quadratic terms and a few shapes of one coordinate,
1/(1.5 + Γ3) or exp(−2 z1), their constants fitted through the flow too.

What the quadratic H leaves of the images, brought to the middle of the step, is linear in what H
lacks: the shape whose mean velocity B∇f along the paths explains most of it comes next. NumPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.brackets import Bracket
from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms, joined
from gfnn_jax.models.brackets.fields import Flowed, flow, half_step, mean_columns, substeps_of
from gfnn_jax.models.brackets.poisson_field import PoissonField, hamiltonian_of
from gfnn_jax.models.textbook.shapes import (
    Kind,
    constants_for,
    has_constant,
    kinds_for,
    text_of,
    values,
)
from gfnn_jax.phase_space import sizes


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the search for shapes (benchmarks/brackets.py)."""

    rows: int = 300  # pairs by which the next shape is chosen
    atoms: int = 2  # at most
    iterations: int = 15  # of Gauss–Newton on coefficients and constants
    exact: float = 1e-11  # of the spread: a residual that is roundoff
    shares: tuple[float, ...] = (1.0, 0.4, 0.15, 0.05)  # of a step, that are tried
    gain: float = 0.97  # of the residual: an iteration that gains less is the last
    continued: int = 16  # shapes of each round that go through the flow, at most
    near: float = 0.3  # of the best one's part of what is left, that they explain


OPTIONS = Options()


Pairs = tuple[np.ndarray, np.ndarray, Any]  # z0, z1 (N, n), dt a number or (N,)


class Atom(NamedTuple):
    """f(z_i; θ). index: i. theta: None of a shape without a constant."""

    index: int
    kind: Kind
    theta: float | None


class Fitted(NamedTuple):
    """H of a base and atoms: all its coefficients, and the RMS that its flow leaves ÷ spread."""

    base: Terms
    atoms: tuple[Atom, ...]
    c: np.ndarray
    left: float

    @property
    def library(self) -> Terms:
        """All terms, those of the base first."""
        return _with(self.base, self.atoms)


def with_shapes(
    bracket: Bracket, base: Terms, pairs: Pairs, on_progress: Callable[[str], Any]
) -> Fitted:
    """The best H of the base and up to two shapes for pairs (N, n), as far as each lowers what is
    left. Raises FitError where not even the base has a flow."""
    z0, z1, dt = pairs
    middle, rate = 0.5 * (z0 + z1), (z1 - z0) / np.reshape(dt, (-1, 1))
    best = _refined(bracket, base, (), hamiltonian_of(bracket, base, middle, rate).c, pairs)
    if best is None:
        raise FitError("no quadratic H has a flow near these pairs")
    for _ in range(OPTIONS.atoms):
        if best.left <= OPTIONS.exact:
            break
        found = [best]
        for atom in _next(bracket, best, pairs):
            start = np.append(best.c, 0.0)
            tried = _refined(bracket, base, (*best.atoms, atom), start, pairs)
            if tried is not None:
                found.append(tried)
                on_progress(f"H with {text(tried.atoms[-1], base.names)}: {tried.left:.1e}")
            if found[-1].left <= OPTIONS.exact:
                break
        least = min(found, key=lambda one: one.left)
        if least is best or least.left > 0.5 * best.left:
            break
        best = least
    short = tuple(a if a.theta is None else a._replace(theta=_short(a.theta)) for a in best.atoms)
    rounded = _at(bracket, base, short, best.c, pairs).fitted
    return rounded if rounded.left <= max(best.left, OPTIONS.exact) else best


def _short(theta: float) -> float:
    """The constant in six digits, which it may be in truth."""
    return float(f"{theta:.6g}")


def text(atom: Atom, names: tuple[str, ...]) -> str:
    """The atom as formulas write it."""
    return text_of(atom.kind, names[atom.index], "", atom.theta)


def _with(base: Terms, atoms: tuple[Atom, ...]) -> Terms:
    if not atoms:
        return base
    texts = tuple(text(atom, base.names) for atom in atoms)
    own = tuple(map(tuple, np.eye(len(texts), dtype=int).tolist()))
    return joined(base, Terms(0, texts, own, (), base.names))


class _ShapeField(NamedTuple):
    """The velocities B∂f/∂z_i of a constant's change, as `mean_columns` wants a field."""

    bracket: Bracket
    atoms: tuple[Atom, ...]
    by_constant: bool

    def columns(self, z: np.ndarray) -> np.ndarray:
        """(N, n, atoms): of f, or of ∂f/∂θ by complex steps."""
        matrix, out = self.bracket.matrix(z), []
        for index, kind, theta in self.atoms:
            x, step = z[:, index], 1e-30
            if self.by_constant:
                slope = values(kind, x + 0j, (theta or 0.0) + 1j * step)[1].imag / step
            else:
                slope = values(kind, x, theta)[1]
            out.append(matrix[:, :, index] * slope[:, None])
        return np.stack(out, axis=-1)


def _next(bracket: Bracket, best: Fitted, pairs) -> list[Atom]:
    """The atoms that explain most of what is left, of different shapes."""
    z0, z1, dt = pairs
    stride = max(1, len(z0) // OPTIONS.rows)
    z0, z1 = z0[::stride], z1[::stride]
    dt = dt[::stride] if np.ndim(dt) else dt
    field, h, spread = PoissonField(bracket, best.library), np.reshape(dt, (-1, 1)), sizes(z0)
    moved = flow(field, best.c, z0, dt, substeps_of(field, best.c, z0, dt))
    middle = 0.5 * (z0 + moved.images)
    left = np.linalg.solve(half_step(field, best.c, middle, h), (z1 - moved.images)[..., None])
    target = (left[..., 0] / spread).ravel()
    columns = (h[..., None] * field.columns(middle) / spread[:, None]).reshape(len(target), -1)
    basis = np.linalg.svd(columns, full_matrices=False)[0]
    target = target - basis @ (basis.T @ target)
    matrix, found = bracket.matrix(middle), []
    with np.errstate(all="ignore"):
        for index in range(z0.shape[1]):
            x = middle[:, index]
            for kind in kinds_for(np.concatenate([z0[:, index], z1[:, index]])):
                constants = constants_for(kind, x) if has_constant(kind) else [None]
                for theta in constants:
                    slope = values(kind, x, theta)[1]
                    one = (h * matrix[:, :, index] * slope[:, None] / spread).ravel()
                    own = one - basis @ (basis.T @ one)
                    size = np.linalg.norm(own)
                    if size > 1e-6 * np.linalg.norm(one):
                        score = float(abs(own @ target) / size)
                        theta = None if theta is None else float(theta)
                        found.append((score, Atom(index, kind, theta)))
    found = [one for one in found if np.isfinite(one[0])]
    chosen: list[Atom] = []
    for score, atom in sorted(found, key=lambda one: -one[0]):
        if score < OPTIONS.near * max(one[0] for one in found):
            break
        if all((atom.index, atom.kind) != (a.index, a.kind) for a in chosen):
            chosen.append(atom)
        if len(chosen) == OPTIONS.continued:
            break
    return chosen


class _At(NamedTuple):
    """State of the refinement, with the paths of its flow and the residual (N, n)."""

    fitted: Fitted
    field: PoissonField
    moved: Flowed
    residual: np.ndarray


def _at(bracket: Bracket, base: Terms, atoms: tuple[Atom, ...], c, pairs: Pairs) -> _At:
    z0, z1, dt = pairs
    field = PoissonField(bracket, _with(base, atoms))
    with np.errstate(all="ignore"):
        moved = flow(field, c, z0, dt, substeps_of(field, c, z0, dt))
        residual = z1 - moved.images
        left = float(np.sqrt(np.mean((residual / sizes(z0)) ** 2)))
    left = left if np.isfinite(left) else np.inf
    return _At(Fitted(base, atoms, c, left), field, moved, residual)


def _refined(bracket, base: Terms, atoms, c, pairs: Pairs) -> Fitted | None:
    """Coefficients and constants by Gauss–Newton through the flow, quasi-Newton as in `fields`,
    each step as long as it gains; None where there is no flow."""
    here = _at(bracket, base, tuple(atoms), c, pairs)
    for _ in range(OPTIONS.iterations):
        if here.fitted.left <= OPTIONS.exact / 10 or here.fitted.left == np.inf:
            break
        step, before = _step(bracket, here, pairs), here.fitted.left
        for share in OPTIONS.shares:
            there = _at(bracket, base, *_stepped(here.fitted, share * step), pairs)
            if there.fitted.left < before:
                here = there
                break
        if here.fitted.left > OPTIONS.gain * before:
            break
    return None if here.fitted.left == np.inf else here.fitted


def _step(bracket: Bracket, here: _At, pairs: Pairs) -> np.ndarray:
    """The step of coefficients and of constants of atoms that have a weight."""
    (base, atoms, c, _), (z0, _, dt) = here.fitted, pairs
    spread, h = sizes(z0), np.reshape(dt, (-1, 1))
    half = half_step(here.field, c, 0.5 * (z0 + here.moved.images), h)
    target = np.linalg.solve(half, here.residual[..., None])[..., 0]
    pinned = here.moved.nodes + here.moved.times[:, None, None] * here.residual
    columns = [mean_columns(here.field, pinned, here.moved.weights, h)]
    weights = c[base.num_parameters :]
    inner = [k for k, atom in enumerate(atoms) if atom.theta is not None]
    if inner:
        shapes = _ShapeField(bracket, tuple(atoms[k] for k in inner), True)
        columns.append(mean_columns(shapes, pinned, here.moved.weights, h) * weights[inner])
    matrix = (np.concatenate(columns, axis=2) / spread[:, None]).reshape(z0.size, -1)
    units = np.linalg.norm(matrix, axis=0)
    units = np.where(units > 0, units, 1.0)
    return np.linalg.lstsq(matrix / units, (target / spread).ravel(), rcond=1e-12)[0] / units


def _stepped(at: Fitted, step: np.ndarray) -> tuple[tuple[Atom, ...], np.ndarray]:
    """Atoms and coefficients after a step of both."""
    c, ahead = at.c + step[: len(at.c)], iter(step[len(at.c) :])
    atoms = [a if a.theta is None else a._replace(theta=a.theta + next(ahead)) for a in at.atoms]
    return tuple(atoms), c
