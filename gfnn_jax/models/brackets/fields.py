"""Vector fields that are linear in their coefficients, and their fit through their own flow.

    z₁ = Φ_h(z₀; c),      ż = f(z) = Σ_j c_j v_j(z)

A change δc moves an image by ∫ M(h, t) Σ δc_j v_j(Z(t)) dt, with M the flow's derivative. With M
taken from the middle of the step, M(h, h/2)⁻¹(z₁ − Φ) is linear in δc and free of M: an iteration
is one least-squares problem whose columns are means of v_j along the paths. It contracts by about
(h‖f'‖)²/12. In NumPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy.linalg import qr

from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.triangle import Spectrum
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.phase_space import sizes


class Options:
    """Options of the fit of a field (benchmarks/brackets.py)."""

    stages: int = 8  # of Gauss collocation: order 16
    rate: float = 1.0  # largest h‖f'‖ of a substep
    most_substeps: int = 32
    solved: float = 3e-16  # of the sizes: a change of the stages that is roundoff
    most_stage_iterations: int = 60
    most_iterations: int = 40
    most_halvings: int = 8  # of the first coefficients, until there is a flow
    shares: tuple[float, ...] = (1.0, 0.4, 0.15, 0.05)  # of a step, that are tried
    # of the spread: residuals that are roundoff, and a gain of an iteration that is none
    roundoff: float = 1e-15
    gain: float = 0.9
    dependent: float = 1e-13  # singular value ÷ the largest: columns that depend on others
    # singular value ÷ the largest, columns of unit length, below which pairs without noise do not
    # determine a combination of terms
    undetermined: float = 1e-10


@runtime_checkable
class Field(Protocol):
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

    def columns(self, z: np.ndarray) -> np.ndarray:
        """v_j (N, n, J)."""
        ...


@runtime_checkable
class Shaped(Field, Protocol):
    """Family with constants θ (I,) inside its v_j."""

    @property
    def constants(self) -> np.ndarray:
        """θ."""
        ...

    def by_constants(self, c: np.ndarray, z: np.ndarray) -> np.ndarray:
        """∂f/∂θ (N, n, I)."""
        ...

    def with_constants(self, theta: np.ndarray) -> Shaped:
        """The family with other θ."""
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
        rank = int(np.sum(np.abs(np.diag(r)) > Options.undetermined * abs(r[0, 0])))
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
        """Gradients (N, n, K)."""
        each = (self.terms.take([j]) for j in range(self.terms.num_parameters))
        bends = np.stack([one.gradient_and_hessian(np.ones(1), z)[1] for one in each], axis=-1)
        return bends.reshape(*z.shape, -1)[..., list(self.places)]


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
    rule, h = gauss(Options.stages), np.reshape(dt, (-1, 1)) / substeps
    z, nodes, scale = z0, [], sizes(z0)
    matrix = rule.matrix
    with np.errstate(all="ignore"):
        for _ in range(substeps):
            slopes = np.repeat(field.rate(c, z)[None], Options.stages, axis=0)
            change = np.inf
            for _ in range(Options.most_stage_iterations):
                inside = z + h * np.tensordot(matrix, slopes, 1)
                new = field.rate(c, inside.reshape(-1, z.shape[1])).reshape(inside.shape)
                moved = np.nanmax(np.abs(h * (new - slopes)) / scale, initial=0.0)
                slopes = new
                if (not moved < 0.99 * change and moved < 1e-9) or moved <= Options.solved:
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
    return int(np.clip(np.ceil(fastest / Options.rate), 1, Options.most_substeps))


class FieldFit(NamedTuple):
    """A field that was fitted to pairs.

    c: (J,). residual: (N, n) what it leaves of the images. relative: its RMS ÷ the spread. root:
    (J, J), rootᵀ root the covariance of c. field: the family, with constants of its own as fitted.
    """

    c: np.ndarray
    residual: np.ndarray
    relative: float
    root: np.ndarray
    field: Any


class Path(NamedTuple):
    """Flow of a field along pairs (N, n), as far as a step of its coefficients needs it.

    residual: (N, n) of the images, and relative, its RMS ÷ the spread. target: what a change of the
    field has to add along the paths. nodes: the states of these (m, N, n), moved so that they end
    at the second states.
    """

    residual: np.ndarray
    relative: float
    target: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray


def path_of(field: Field, c: np.ndarray, z0, z1, dt: Any, spread: np.ndarray) -> Path:
    """Follow the flow of a field from z0 (N, n); relative is inf where it has none."""
    with np.errstate(all="ignore"):
        moved = flow(field, c, z0, dt, substeps_of(field, c, z0, dt))
        residual = z1 - moved.images
        relative = float(np.sqrt(np.mean((residual / spread) ** 2)))
        if not np.isfinite(relative):
            return Path(residual, np.inf, residual, moved.nodes, moved.weights)
        a = 0.5 * np.reshape(dt, (-1, 1, 1)) * field.jacobian(c, 0.5 * (moved.images + z0))
    eye = np.eye(z0.shape[1])
    half = eye + a @ (eye + 0.5 * a @ (eye + a / 3))  # M(h, h/2), from f' at one state
    target = np.linalg.solve(half, residual[..., None])[..., 0]
    nodes = moved.nodes + moved.times[:, None, None] * residual
    return Path(residual, relative, target, nodes, moved.weights)


def fit_field(
    field: Field, z0: np.ndarray, z1: np.ndarray, dt: Any, c: np.ndarray | None = None
) -> FieldFit:
    """Fit c, and the constants of a `Shaped` field, to pairs of states (N, n).

    dt: between these, a number or (N,). c: to start from; None: the field along the straight line
    between the states. The columns are taken along the path of the flow, moved so that it ends at
    z₁. Raises FitError where no field of the family has a flow over dt.
    """
    h, spread = np.reshape(dt, (-1, 1)), sizes(np.concatenate([z0, z1]))
    if c is None:
        rule = gauss(Options.stages)
        straight = z0 + rule.nodes[:, None, None] * (z1 - z0)
        c = _least(_columns(field, straight, rule.weights, h), z1 - z0, spread)[0]
    at = np.array(c)
    here = path_of(field, at, z0, z1, dt, spread)
    for _ in range(Options.most_halvings):
        if here.relative < np.inf:
            break
        at *= 0.5
        here = path_of(field, at, z0, z1, dt, spread)
    if here.relative == np.inf:
        raise FitError("no field of the library has a flow over dt: take pairs of a shorter dt")
    for _ in range(Options.most_iterations):
        if not here.relative > Options.roundoff:
            break
        stepped, gains = _step(field, at, here, h, spread)
        before = here.relative
        for share in Options.shares if gains else Options.shares[:1]:
            there = stepped(share)
            path = path_of(*there, z0, z1, dt, spread)
            if path.relative < before:
                (field, at), here = there, path
                break
        if not here.relative < Options.gain * before:
            break
    free = max(1.0, here.residual.size - field.num)
    root = _least(_columns(field, here.nodes, here.weights, h), here.residual, spread)[1]
    sigma = np.sqrt(np.sum((here.residual / spread) ** 2) / free)
    return FieldFit(at, here.residual, here.relative, max(sigma, 1e-16) * root, field)


def _step(
    field: Any, c: np.ndarray, path: Path, h, spread
) -> tuple[Callable[[float], tuple], bool]:
    """Shares of the next step -> (field, c), and whether it would gain anything to speak of.

    Constants inside a field go along curved valleys of what is left: with them moved, c is solved
    for anew (variable projection, Golub & Pereyra 1973).
    """
    own = _columns(field, path.nodes, path.weights, h)
    shaped = isinstance(field, Shaped) and len(field.constants)
    inner = _mean(lambda z: field.by_constants(c, z), path.nodes, path.weights, h) if shaped else ()
    both = np.concatenate([own, inner], axis=2) if shaped else own
    step, _, left = _least(both, path.target, spread)
    size = [np.sum((one / spread) ** 2) for one in (left, path.target)]

    def stepped(share: float) -> tuple:
        if not shaped:
            return field, c + share * step
        with np.errstate(all="ignore"):
            moved = field.with_constants(field.constants + share * step[len(c) :])
            new = _columns(moved, path.nodes, path.weights, h)
            target = path.target - (new - own) @ c
        return moved, c + (_least(new, target, spread)[0] if np.isfinite(target).all() else np.nan)

    return stepped, bool(size[0] < Options.gain**2 * size[1])


def _mean(columns: Callable[[np.ndarray], np.ndarray], nodes, weights, h) -> np.ndarray:
    """∫ v_j dt (N, n, J) of columns v_j along paths."""
    parts = zip(nodes, weights, strict=True)
    return h[..., None] * sum(weight * columns(inside) for inside, weight in parts)


def _columns(field: Field, nodes, weights, h) -> np.ndarray:
    """∫ v_j dt (N, n, J), or of a free field ∫ ψ_k dt (N, 1, K), the same of each component."""
    if isinstance(field, FreeField):
        return _mean(lambda z: field.library.term_values(z)[:, None], nodes, weights, h)
    return _mean(field.columns, nodes, weights, h)


def _least(columns, target, spread) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """c (J,) of least squares, Σ c_j columns_j = target (N, n), the root (J, J) of its covariance
    for residuals of one in units of the spread (n,), and what is left of the target."""
    free = columns.shape[1] != target.shape[1]  # the same columns for each component
    matrix = columns[:, 0] if free else (columns / spread[:, None]).reshape(target.size, -1)
    right = target if free else (target / spread).ravel()
    spectrum = Spectrum.of(matrix, right, 0.0, Options.dependent)
    one = spectrum.told
    solved = one.T @ spectrum.along
    left = right - matrix @ solved
    if free:
        return solved.T.ravel(), np.kron(np.diag(spread), one), left
    return solved, one, left.reshape(target.shape) * spread


def undetermined(field: FreeField, z: np.ndarray) -> np.ndarray:
    """Combinations (m, K) of the library that vanish at all states z (N, n), to roundoff: relations
    that the runs have in common, as one value of an invariant."""
    values = field.library.term_values(z)
    spectrum = Spectrum.of(values, values[:, 0], 0.0, Options.undetermined)
    return spectrum.vt[~spectrum.known] / spectrum.column
