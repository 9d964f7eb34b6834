"""Vector fields that are linear in their coefficients, and their fit through their own flow.

    z₁ = Φ_h(z₀; c),      ż = f(z) = Σ_j c_j v_j(z)

A change δc moves an image by ∫ M(h, t) Σ δc_j v_j(Z(t)) dt, with M the flow's derivative. With M
taken from the middle of the step, M(h, h/2)⁻¹(z₁ − Φ) is linear in δc and free of M: an iteration
is one least-squares problem whose columns are means of v_j along the paths. It contracts by about
(h‖f'‖)²/12. In NumPy.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy.linalg import qr

from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.phase_space import sizes


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the fit of a field (benchmarks/brackets.py)."""

    stages: int = 8  # of Gauss collocation: order 16
    rate: float = 1.0  # largest h‖f'‖ of a substep
    most_substeps: int = 32
    solved: float = 3e-16  # of the sizes: a change of the stages that is roundoff
    most_stage_iterations: int = 60
    most_iterations: int = 40
    # of the spread: residuals that are roundoff, and a gain of an iteration that is none
    roundoff: float = 1e-15
    gain: float = 0.9
    # singular value ÷ the largest, columns of unit length, below which pairs without noise do not
    # determine a combination of terms
    undetermined: float = 1e-10


OPTIONS = Options()


@runtime_checkable
class Columns(Protocol):
    """Vector fields v_j."""

    def columns(self, z: np.ndarray) -> np.ndarray:
        """v_j (N, n, J)."""
        ...


@runtime_checkable
class Field(Columns, Protocol):
    """Family of vector fields, linear in its coefficients c (J,). All in NumPy, z (N, n)."""

    @property
    def num(self) -> int:
        """J."""
        ...

    def rate(self, c: np.ndarray, z: np.ndarray) -> np.ndarray:
        """f (N, n)."""
        ...

    def jacobian(self, c: np.ndarray, z: np.ndarray) -> np.ndarray:
        """∂f/∂z (N, n, n)."""
        ...


@dataclasses.dataclass(frozen=True)
class Partials:
    """Library of the partial derivatives of terms: the field of a constant bracket is a sum of
    these. places: those (coordinate × terms + term) that are independent."""

    terms: Terms
    places: tuple[int, ...]

    @classmethod
    def of(cls, terms: Terms, z: np.ndarray) -> Partials:
        """The partial derivatives that are independent at states z (N, n)."""
        every = terms.term_gradients(z).reshape(len(z), -1)
        sizes = np.linalg.norm(every, axis=0)
        columns = np.flatnonzero(sizes > 0)
        found: Any = qr(every[:, columns] / sizes[columns], mode="economic", pivoting=True)
        _, r, order = found
        rank = int(np.sum(np.abs(np.diag(r)) > OPTIONS.undetermined * abs(r[0, 0])))
        return cls(terms, tuple(sorted(columns[order[:rank]].tolist())))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return self.terms.names

    @property
    def num_parameters(self) -> int:
        """Number of functions."""
        return len(self.places)

    def term_values(self, z: np.ndarray) -> np.ndarray:
        """Values (N, K)."""
        return self.terms.term_gradients(z).reshape(len(z), -1)[:, list(self.places)]

    def term_gradients(self, z: np.ndarray) -> np.ndarray:
        """Gradients (N, n, K), by complex steps."""
        out = np.empty((*z.shape, len(self.places)))
        for k in range(z.shape[1]):
            moved = z.astype(complex)
            moved[:, k] += 1e-30j
            gradients = _complex_gradients(self.terms, moved).reshape(len(z), -1)
            out[:, k] = np.imag(gradients[:, list(self.places)]) / 1e-30
        return out


def _complex_gradients(terms: Terms, z: np.ndarray) -> np.ndarray:
    """Gradients (N, n, K) of terms at complex states."""
    out = np.zeros((*z.shape, terms.num_parameters), complex)
    for j in range(terms.num_parameters):
        out[..., j] = terms.take([j]).gradient(np.ones(1), z)
    return out


@dataclasses.dataclass(frozen=True)
class FreeField:
    """f_i(z) = Σ_k c_ik ψ_k(z): every component has every function of the library, c by rows of
    i."""

    library: Terms | Partials

    @property
    def width(self) -> int:
        """Number n of coordinates."""
        return len(self.library.names)

    @property
    def num(self) -> int:
        return self.width * self.library.num_parameters

    def rate(self, c, z):
        return self.library.term_values(z) @ c.reshape(self.width, -1).T

    def jacobian(self, c, z):
        slopes = self.library.term_gradients(z)
        return np.einsum("ik,njk->nij", c.reshape(self.width, -1), slopes, optimize=True)

    def columns(self, z):
        values = self.library.term_values(z)
        return np.einsum("ij,nk->nijk", np.eye(self.width), values).reshape(*z.shape, -1)


class Flowed(NamedTuple):
    """Images (N, n) of a flow, the states at its nodes (m, N, n) and these nodes' weights (m,),
    whose sum is 1, at the times (m,) as parts of the step."""

    images: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    times: np.ndarray


def flow(field: Field, c: np.ndarray, z0: np.ndarray, dt: Any, substeps: int = 1) -> Flowed:
    """The flow of f over dt, a number or (N,), from z0 (N, n): NaN where stages do not converge."""
    rule, h = gauss(OPTIONS.stages), np.reshape(dt, (-1, 1)) / substeps
    z, nodes, scale = z0, [], sizes(z0)
    matrix = rule.matrix
    with np.errstate(all="ignore"):
        for _ in range(substeps):
            slopes = np.repeat(field.rate(c, z)[None], OPTIONS.stages, axis=0)
            change = np.inf
            for _ in range(OPTIONS.most_stage_iterations):
                inside = z + h * np.tensordot(matrix, slopes, 1)
                new = field.rate(c, inside.reshape(-1, z.shape[1])).reshape(inside.shape)
                moved = np.nanmax(np.abs(h * (new - slopes)) / scale, initial=0.0)
                slopes = new
                if (not moved < 0.99 * change and moved < 1e-9) or moved <= OPTIONS.solved:
                    break
                change = moved
            nodes.append(inside)
            z = z + h * np.tensordot(rule.weights, slopes, 1)
    count = np.arange(substeps)[:, None]
    times = (count + rule.nodes).ravel() / substeps
    return Flowed(z, np.concatenate(nodes), np.tile(rule.weights / substeps, substeps), times)


def substeps_of(field: Field, c: np.ndarray, z: np.ndarray, dt: Any) -> int:
    """Substeps in which the stages are solved to roundoff at these states."""
    rates = np.abs(field.jacobian(c, z)).sum(axis=2).max(axis=1) * np.reshape(dt, -1)
    rates = rates[np.isfinite(rates)]
    fastest = float(np.quantile(rates, 0.99)) if len(rates) else 0.0
    return int(np.clip(np.ceil(fastest / OPTIONS.rate), 1, OPTIONS.most_substeps))


class FieldFit(NamedTuple):
    """A field that was fitted to pairs.

    c: (J,). residual: (N, n) what it leaves of the images, relative: its RMS ÷ the spread. root:
    (J, J), rootᵀ root the covariance of c. iterations: that it took.
    """

    c: np.ndarray
    residual: np.ndarray
    relative: float
    root: np.ndarray
    iterations: int


def fit_field(
    field: Field, z0: np.ndarray, z1: np.ndarray, dt: Any, c: np.ndarray | None = None
) -> FieldFit:
    """Fit c to pairs of states (N, n), dt apart, a number or (N,).

    c: to start from; None: the field along the straight line between the states. The columns are
    taken along the path of the flow, moved so that it ends at z₁. Raises FitError where no field
    of the family has a flow over dt.
    """
    h, spread = np.reshape(dt, (-1, 1)), sizes(np.concatenate([z0, z1]))
    rule = gauss(OPTIONS.stages)
    if c is None:
        straight = z0 + rule.nodes[:, None, None] * (z1 - z0)
        c = _solved(field, straight, rule.weights, h, z1 - z0, spread)[0]
    best, share, iterations = None, 1.0, 0
    step = np.zeros_like(c)
    for iterations in range(1, OPTIONS.most_iterations + 1):
        moved = flow(field, c, z0, dt, substeps_of(field, c, z0, dt))
        residual = z1 - moved.images
        relative = float(np.sqrt(np.mean((residual / spread) ** 2)))
        if not np.isfinite(relative) or (best is not None and relative > 3 * best.relative):
            if (best is None and iterations > 8) or share < 0.01:
                break
            share *= 0.3
            c = (c if best is None else best.c) * (0.5 if best is None else 1.0)
            c = c + share * step
            continue
        gained = best is None or relative < OPTIONS.gain * best.relative
        if best is None or relative < best.relative:
            best = FieldFit(c, residual, relative, np.zeros((0, 0)), iterations)
        if relative <= OPTIONS.roundoff or not gained:
            break
        half = half_step(field, c, 0.5 * (moved.images + z0), h)
        target = np.linalg.solve(half, residual[..., None])[..., 0]
        pinned = moved.nodes + moved.times[:, None, None] * residual
        step = _solved(field, pinned, moved.weights, h, target, spread)[0]
        share = 1.0
        c = c + step
    if best is None:
        raise FitError("no field of the library has a flow over dt: take pairs of a shorter dt")
    moved = flow(field, best.c, z0, dt, substeps_of(field, best.c, z0, dt))
    free = max(1.0, best.residual.size - field.num)
    root = _solved(field, moved.nodes, moved.weights, h, best.residual, spread)[1]
    sigma = np.sqrt(np.sum((best.residual / spread) ** 2) / free)
    return best._replace(root=max(sigma, 1e-16) * root, iterations=iterations)


def half_step(field: Field, c, z, h) -> np.ndarray:
    """M(h, h/2) (N, n, n), from f' at one state of each path (N, n)."""
    a = 0.5 * h[..., None] * field.jacobian(c, z)
    eye = np.eye(z.shape[1])
    return eye + a @ (eye + 0.5 * a @ (eye + a / 3))


def mean_columns(field: Columns, nodes, weights, h) -> np.ndarray:
    """∫ v_j dt (N, n, J), or of a free field ∫ ψ_k dt (N, 1, K)."""
    total = 0.0
    for inside, weight in zip(nodes, weights, strict=True):
        if isinstance(field, FreeField):
            values = field.library.term_values(inside)[:, None]
        else:
            values = field.columns(inside)
        total = total + weight * values
    return h[..., None] * total


def _solved(field: Field, nodes, weights, h, target, spread) -> tuple[np.ndarray, np.ndarray]:
    """c (J,) of least squares, Σ c_j ∫ v_j dt = target (N, n), and the root (J, J) of its
    covariance for residuals of one in units of the spread (n,)."""
    columns = mean_columns(field, nodes, weights, h)
    if isinstance(field, FreeField):
        matrix, right = columns[:, 0], target
        units = np.linalg.norm(matrix, axis=0)
        units = np.where(units > 0, units, 1.0)
        u, s, vt = np.linalg.svd(matrix / units, full_matrices=False)
        kept = s > 1e-13 * s[0]
        inverse = np.where(kept, 1 / np.where(kept, s, 1.0), 0.0)
        solved = (vt.T * inverse) @ (u.T @ right) / units[:, None]
        one = (inverse[:, None] * vt) / units
        return solved.T.ravel(), np.kron(np.diag(spread), one)
    matrix = (columns / spread[:, None]).reshape(-1, field.num)
    right = (target / spread).ravel()
    units = np.linalg.norm(matrix, axis=0)
    units = np.where(units > 0, units, 1.0)
    u, s, vt = np.linalg.svd(matrix / units, full_matrices=False)
    kept = s > 1e-13 * s[0]
    inverse = np.where(kept, 1 / np.where(kept, s, 1.0), 0.0)
    return (vt.T * inverse) @ (u.T @ right) / units, (inverse[:, None] * vt) / units


def undetermined(field: FreeField, z: np.ndarray, floor: float) -> np.ndarray:
    """Combinations (m, K) of the library that vanish at all states z (N, n), to ``floor`` or to
    roundoff: relations that the runs have in common, as one value of an invariant."""
    matrix = field.library.term_values(z)
    units = np.linalg.norm(matrix, axis=0)
    _, s, vt = np.linalg.svd(matrix / units, full_matrices=False)
    return vt[s <= max(OPTIONS.undetermined, floor) * s[0]] / units
