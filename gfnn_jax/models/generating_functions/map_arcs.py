"""S along arcs of measured states: the states that they most likely had, and rows of S there.

∇S(w) = g holds at the true states. Both w and g of a pair are linear in its two states and carry
their noise, and a fit at the measured w is biased, however many pairs there are. With

    F(z, Z) = ∇S(w) − g,        w, g of the chart,        F = 0 where S maps z onto Z,

as the defect of an arc (`solve.latent_arcs`), the states of an S that is near are those nearest to
the measured ones, in units of the noise, that it maps onto each other; and the rows of all other S
there, without the moves of the states, are explicit and linear in their coefficients. Their fit
minimises the squared distance of the arcs from the map's graph to first order (orthogonal distance
regression: Britt & Luecke, Technometrics 15 (1973) 233; Boggs, Byrd & Schnabel, SIAM J. Sci. Stat.
Comput. 8 (1987) 1052). Residuals have variance one where noise is all that is left, in any chart.
States are the user's, whose noise is independent: coordinates that mix them share it.

Two monitors across a known linear stretch read y = (q, Q) = T z, T = [[1, 0], [A, B]]. Their noise
is that of the momenta too, divided by B and the same in both of a turn's readings, so that neither
least squares nor states of independent noise suit it. In y it is independent: an arc of turns is

    y_{n+1} = T Φ_S(M T⁻¹ y_n),        M the known stretch, Φ_S the one that is learned,

whose y_n are latent too (`latent_readings`); the noise of each monitor is that of its residuals.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gfnn_jax.dataset.rows import residual_weight
from gfnn_jax.dataset.runs import Arcs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting.triangle import Triangle, folded
from gfnn_jax.generating.arcs import GeneratedOnArcs
from gfnn_jax.generating.generated import Generated
from gfnn_jax.generating.predictor import affordable, fit_predictors
from gfnn_jax.solve.latent_arcs import Known, Readings
from gfnn_jax.solve.noise import Biweight

LONGEST = 10  # steps of an arc: what S cannot represent adds up along a longer one
# Of normal residuals it takes one part in forty, so that rows keep their variance of one.
BIWEIGHT = Biweight(15.0)
_SETTLED = 1e-3  # of the squared distance: what the states still gain moves no coefficient
_BLOCK_BYTES = 4 * 2**20  # of the rows of a block of arcs: they stay in the cache


@dataclasses.dataclass(frozen=True, eq=False)
class NearestArcs:
    """Arcs and the states x (A, L, 2d) that ``model`` with coefficients p finds nearest to them.
    sigma: noise of the measured states, (2d,) or of each value (A, L, 2d)."""

    model: GeneratedOnArcs
    p: np.ndarray
    arcs: Arcs
    x: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, model: GeneratedOnArcs, p, arcs: Arcs, sigma) -> NearestArcs:
        """Raises numpy.linalg.LinAlgError where the chart is singular at some pair, or no states
        near the measured ones are an orbit."""
        x = arcs.states.copy()
        for n in range(1, x.shape[1]):  # one that is missing starts from the one before
            x[:, n] = np.where(np.isfinite(x[:, n]), x[:, n], x[:, n - 1])
        usual = sigma if sigma.ndim == 1 else np.sqrt(np.mean(sigma**2, axis=(0, 1)))
        readings = Readings(Known(model, p), arcs.states, sigma, BIWEIGHT)
        found = readings.fit(p[:0], x, usual, tolerance=_SETTLED)
        if not np.isfinite(found.cost):
            raise np.linalg.LinAlgError("expected states near the measured ones")
        return cls(model, p, arcs, found.x, sigma)

    def rows(self, along: Any) -> Iterator[tuple[np.ndarray, int]]:
        """Rows [A b] (R, n + 1) of the coefficients of a family, block by block, and for how many
        numbers they stand."""
        arcs, length, width = self.x.shape
        bytes_of_arc = 16 * length * width * (along.num_parameters + width + 1)
        size = max(1, _BLOCK_BYTES // bytes_of_arc)
        for first in range(0, arcs, size):
            some = slice(first, first + size)
            model = dataclasses.replace(self.model, moves=self.arcs.moves[some], along=along)
            y, sigma = self.arcs.states[some], _of_arcs(self.sigma, some)
            rows = Readings(model, y, sigma, BIWEIGHT).eliminated_rows(self.p, self.x[some])
            yield rows, int(np.isfinite(y).sum()) - len(y) * width

    def triangle(self, along: Any, on_block: Callable[[], Any] = lambda: None) -> Triangle:
        """Triangle of the rows of a family; on_block: called before each block of rows."""
        found = Triangle.empty(along.num_parameters)
        factor, count = found.factor, 0
        for rows, numbers in self.rows(along):
            on_block()
            folded(factor, np.asfortranarray(rows))
            count += numbers
        return Triangle(factor, count)

    def take(self, arcs: np.ndarray) -> NearestArcs:
        """Keep these arcs alone."""
        model = dataclasses.replace(self.model, moves=self.model.moves[arcs])
        chosen = Arcs(self.arcs.states[arcs], self.arcs.moves[arcs])
        return NearestArcs(model, self.p, chosen, self.x[arcs], _of_arcs(self.sigma, arcs))


def _of_arcs(sigma: np.ndarray, arcs) -> np.ndarray:
    """The noise of these arcs."""
    return sigma if sigma.ndim == 1 else sigma[arcs]


class Options:
    """Options of the fit to readings of two monitors (benchmarks/storage_ring.py)."""

    fewest: int = 4  # turns of an arc: of fewer, noise of the two monitors is not told apart
    most_nodes: int = 20000  # of all arcs: a minute and a quarter of a gigabyte at a hundred terms
    most_operations: float = 20000000000.0  # of one size: about a minute
    passes: float = 32.0  # over the rows: some ten iterations, with all derivatives
    solved: float = 1e-10  # a step in NumPy whose residual is larger has not been solved
    largest: int = 10  # degree of S
    worse: int = 2  # sizes in a row that are no better end the search


@dataclasses.dataclass(frozen=True)
class Linear:
    """y -> matrix y (2d, 2d), a change of coordinates that need not be symplectic. NumPy."""

    matrix: np.ndarray

    def image(self, y):
        return y @ self.matrix.T

    def inverse(self) -> Linear:
        return Linear(np.linalg.inv(self.matrix))


@dataclasses.dataclass(frozen=True, eq=False)
class LatentReadings:
    """The piece that S of a stretch generates, a root (k, m) of the covariance of its coefficients
    (rootᵀ root), the noise σ (2d,) of the readings of both monitors, the number of equations along
    the arcs, and whether the iteration converged."""

    piece: Generated
    root: np.ndarray
    sigma: np.ndarray
    num_equations: int
    converged: bool

    @property
    def criterion(self) -> float:
        """Akaike's, as that of `LatentFit`."""
        size = self.num_equations * float(np.mean(np.log(self.sigma**2)))
        return size + self.piece.family.num_parameters


def latent_readings(
    piece: Generated,
    ends: tuple[list[Any], list[Any]],
    turns: list[np.ndarray],
) -> LatentReadings | None:
    """The S that the readings ``turns``, (n, 2d) of each stretch of turns without a gap, ask for by
    Akaike's criterion; None where they are too few, or every larger S leaves less: what is left is
    no noise then.

    piece: of least squares, which starts the fit and lends chart and family. ends: what stands
    before and behind it in y_n -> y_{n+1}: `Linear`, or affine pieces.
    """
    arcs = _arcs(turns)
    if arcs is None:
        return None
    best, worse = None, 0
    for family in _families(piece.family):
        if best and Options.passes * arcs.size * family.num_parameters**2 > Options.most_operations:
            break
        found = _fitted(piece, family, ends, arcs)
        if found.converged and (best is None or found.criterion < best.criterion):
            best, worse = found, 0
        else:
            worse += 1
        if worse == Options.worse:
            break
    if worse < Options.worse:  # larger sizes leave less and less: that is no noise
        return None
    return best and dataclasses.replace(best, piece=_with_predictor(best.piece, ends, arcs))


def _families(family: Any) -> Iterator[Any]:
    """Families by rising degree; none where S has no degree."""
    if isinstance(family, Products):
        yield from (dataclasses.replace(family, degree=n) for n in range(2, Options.largest + 1))


def _fitted(
    piece: Generated, family: Any, ends: tuple[list[Any], list[Any]], arcs: np.ndarray
) -> LatentReadings:
    """S of this family by Gauss–Newton over arcs (A, L, 2d)."""
    num, length, width = arcs.shape
    moves, dt = np.full((num, length - 1), True), float(np.asarray(piece.dt))
    model = GeneratedOnArcs(family, piece.chart, dt, moves, ends, family, joint=True)
    p, left = _start(piece, family, ends, arcs)
    equations = num * (length - 1) * width
    found = Readings(model, arcs, left).fit(p, arcs.copy(), left, least=np.zeros(width))
    root = np.linalg.pinv(found.triangle).T
    sound = found.converged and np.isfinite(found.cost)
    own = dataclasses.replace(
        piece, family=family, params=family.unflatten(found.p), predictor=None
    )
    return LatentReadings(own, root, found.sigma, equations, bool(sound))


def _start(piece: Generated, family: Any, ends, arcs) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of the readings as they are: coefficients, and about what noise (2d,) leaves so
    much of the images."""
    (y0, y1), (z0, z1) = _ends_of_steps(ends, arcs)
    chart, dt = piece.chart, float(np.asarray(piece.dt))
    w, target = chart.evaluation_point(z0, z1), chart.target_gradient(z0, z1, dt)
    weight = residual_weight(chart, np.asarray(piece.scale), dt)
    terms = family.term_gradients(w) * weight[:, None]
    aim = (target * weight).ravel()
    p = np.linalg.lstsq(terms.reshape(aim.size, -1), aim, rcond=None)[0]
    # A turn as a whole is about linear: what that leaves has the noise of a reading at its end,
    # and of all readings at its start.
    linear = np.linalg.lstsq(y0, y1, rcond=None)[0].T
    gradient = family.gradient(family.unflatten(p), w)
    images = chart.image(z0, w, gradient, dt)
    for one in ends[1]:
        images = one.image(images)
    left = np.median(np.abs(images - y1), axis=0) / 0.6745
    return p, left / np.sqrt(1 + np.sum(linear**2, axis=1))


def _with_predictor(piece: Generated, ends, arcs) -> Generated:
    """The piece with a predictor of its own images of the states that were read."""
    z0, z1 = _ends_of_steps(ends, arcs)[1]
    images, error = piece.refined_step(z0, piece.chart.evaluation_point(z0, z1))
    solved = (error < Options.solved) & np.isfinite(images).all(axis=1)
    fitted = fit_predictors(piece.chart, z0[solved], images[solved], piece.dt)
    return dataclasses.replace(piece, predictor=affordable(fitted, piece.family).predictor)


def _ends_of_steps(ends, arcs) -> tuple[tuple[np.ndarray, np.ndarray], tuple[Any, Any]]:
    """Readings (n, 2d) at either end of every step, and the states there between the ends."""
    y0, y1 = (a.reshape(-1, arcs.shape[-1]) for a in (arcs[:, :-1], arcs[:, 1:]))
    z0, z1 = y0, y1
    for one in ends[0]:
        z0 = one.image(z0)
    for one in reversed(ends[1]):
        z1 = one.inverse().image(z1)
    return (y0, y1), (z0, z1)


def _arcs(turns: list[np.ndarray]) -> np.ndarray | None:
    """Arcs (A, L, 2d) of one length; of very many every so many."""
    longest = max((len(y) for y in turns), default=0)
    length = min(longest, LONGEST + 1)
    if length < Options.fewest:
        return None
    cut = [y[i : i + length] for y in turns for i in range(0, len(y) - length + 1, length)]
    return np.array(cut[:: -(-len(cut) * length // Options.most_nodes)])
