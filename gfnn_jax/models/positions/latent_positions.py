"""S(q, Q) from noisy readings of positions: true positions are unknowns beside its coefficients.

Least squares in the discrete Euler–Lagrange equations takes readings for positions, and the noise
of readings in its own columns biases it. Here arcs of readings are compared, in units of their
noise σ, with orbits of S, whose positions are latent (`solve.latent_arcs`); σ is that of the
residuals. Least squares only starts it. `map_of` makes the map of an S.
"""

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.budget import FLOW, Budget
from gfnn_jax.coordinates import Coordinates, circle_centre, whole_turns
from gfnn_jax.dataset.structures import Sites
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting.evidence import Comparison
from gfnn_jax.generating.arcs import PositionArcs, nodes_of
from gfnn_jax.generating.charts import TYPE1
from gfnn_jax.generating.generated import Generated
from gfnn_jax.generating.predictor import affordable, fit_predictors
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.positions.discrete_lagrangian import Solved, Triples, residuals, solve
from gfnn_jax.phase_space import Pairs, sizes
from gfnn_jax.solve.latent_arcs import SOFT_L1, Readings


class Options:
    """Options of the fit to latent positions (benchmarks/positions.py)."""

    longest: int = 24  # nodes of an arc: its own two positions cost a twelfth of what it tells
    most_nodes: int = 20000  # of all arcs: a minute and a quarter of a gigabyte at a hundred terms
    # of all Jacobians (2d, 2d) along the arcs, a quarter of a gigabyte
    most_numbers: float = 30000000.0
    settled: float = 1.05  # a noise scale that changed by less needs no further fit
    scales: int = 4  # fits, at most, that find it
    gross: float = 5.0  # standard deviations: of what is not noise
    worse: int = 2  # sizes in a row that are no better end the search
    passes: float = 32.0  # over the rows: some four iterations, twice, with all derivatives
    most_operations: float = 20000000000.0  # of one size: about a minute


_OF_EQUATION = np.sqrt(3)  # noise of an equation, in that of a reading, about


@dataclasses.dataclass(frozen=True, eq=False)
class LatentFit:
    """Coefficients (m,) of S, a root (k, m) of their covariance (rootᵀ root), the noise σ (d,) of
    the readings, the number of equations ∂₂S + ∂₁S = 0 along the arcs, one for each coordinate, and
    whether the iteration converged."""

    coefficients: np.ndarray
    root: np.ndarray
    sigma: np.ndarray
    num_equations: int
    converged: bool

    @property
    def criterion(self) -> float:
        """Akaike's, −2 log likelihood + 2 × the number of coefficients, up to a constant: σ² is the
        sum of squares ÷ what unknowns leave of the readings, which has one of the two in it."""
        return self.num_equations * float(np.mean(np.log(self.sigma**2))) + len(self.root)


def arcs_of(triples: Triples) -> np.ndarray:
    """Readings (A, L + 1, d) as arcs of one length, that which leaves fewest equations out; of very
    many, or of many degrees of freedom, every so many."""
    stretches = triples.stretches()
    sizes = np.array([len(s) for s in stretches])
    longest = min(int(sizes.max()) - 1, Options.longest)
    used = [np.sum(sizes // (nodes + 1)) * (nodes - 1) for nodes in range(2, longest + 1)]
    span = 3 + int(np.argmax(used))
    cut = [
        s[first : first + span] for s in stretches for first in range(0, len(s) - span + 1, span)
    ]
    most = max(span, min(Options.most_nodes, int(Options.most_numbers / (2 * triples.dim) ** 2)))
    return np.array(cut[:: -(-len(cut) * span // most)])


def starting_noise(family: Any, coefficients: np.ndarray, triples: Triples) -> np.ndarray:
    """σ (d,) as large as what S leaves of the equations suggests."""
    left = residuals(family, family.unflatten(coefficients), triples)
    return np.maximum(np.median(np.abs(left), axis=0) / 0.6745 / _OF_EQUATION, np.finfo(float).tiny)


def fit_latent(
    family: Any, solved: Solved, triples: Triples, sigma: np.ndarray, arcs: np.ndarray
) -> LatentFit:
    """S of this family by Gauss–Newton over arcs (A, L + 1, d) with latent positions.

    solved: least squares, which starts it and says which S there are. sigma: (d,) the first guess
    of the noise, which becomes that of the residuals.
    """
    dim, determined = triples.dim, solved.determined.shape[1]
    model = PositionArcs(family, triples.dt, family.unflatten(solved.free), solved.determined)
    p = solved.determined.T @ (solved.coefficients - solved.free)
    x, y = nodes_of(arcs)
    equations = len(arcs) * (arcs.shape[1] - 2) * dim
    # Residuals of readings are smaller than the noise by what the unknowns take of them.
    left = np.sqrt(arcs.size / max(equations - determined, 1))
    for _ in range(Options.scales):
        scale = np.tile(sigma, 2)
        found = Readings(model, y, scale).fit(p, x, scale)
        p, x = found.p, found.x
        change = _size(found.residuals, dim) * left
        sigma = sigma * change
        if np.all(np.abs(np.log(change)) < np.log(Options.settled)):
            break
    root = np.linalg.pinv(found.triangle).T @ solved.determined.T * np.exp(np.mean(np.log(change)))
    coefficients = solved.free + solved.determined @ p
    return LatentFit(coefficients, root, sigma, equations, found.converged)


def held_out_cost(
    family: Any, coefficients: np.ndarray, triples: Triples, sigma: np.ndarray, arcs: np.ndarray
) -> np.ndarray:
    """Cost (A,) of arcs that the fit has not seen, whose positions are fitted to S as it is."""
    params, none = family.unflatten(coefficients), np.zeros((len(coefficients), 0))
    model = PositionArcs(family, triples.dt, params, none)
    x, y = nodes_of(arcs)
    scale = np.tile(sigma, 2)
    found = Readings(model, y, scale).fit(np.zeros(0), x, scale)
    if not np.isfinite(found.cost):
        return np.full(len(arcs), np.inf)
    return np.nansum(SOFT_L1.of(found.residuals), axis=(1, 2))


def _size(residuals: np.ndarray, dim: int) -> np.ndarray:
    """(d,) root mean square of residuals (A, L, 2d) of each coordinate, gross ones left out."""
    r = residuals.reshape(-1, 2, dim)
    gross = np.abs(r) > Options.gross * np.nanmedian(np.abs(r), axis=(0, 1)) / 0.6745
    return np.sqrt(np.nanmean(np.where(gross, np.nan, r) ** 2, axis=(0, 1)))


class Latent(NamedTuple):
    """A family with its S of latent positions, and the least squares that it began with."""

    family: Any
    fit: LatentFit
    solved: Solved


def without_noise(
    families: Iterable[Any],
    training: Triples,
    held_out: Triples,
    budget: Budget,
    on_progress: Callable[[str], Any],
) -> Latent | None:
    """The S that readings with noise tell; None where latent positions explain arcs that were held
    out no better than least squares, or time ends before the first size."""
    arcs, held_out_arcs = arcs_of(training), arcs_of(held_out)
    best: Latent | None = None
    sigma, worse = None, 0
    for family in families:
        work = Options.passes * arcs.size * (family.num_parameters + 2 * training.dim) ** 2
        if best is not None and work > Options.most_operations:
            break
        try:
            with budget.unit(f"latent positions, S of {family.label}", FLOW, work):
                on_progress(f"latent positions, S of {family.label}, {family.num_parameters} terms")
                solved = solve(family, training)
                if sigma is None:
                    sigma = starting_noise(family, solved.coefficients, training)
                fit = fit_latent(family, solved, training, sigma, arcs)
        except OutOfTime:
            break
        if not fit.converged or (best and fit.criterion >= best.fit.criterion):
            worse += 1
        else:
            best, sigma, worse = Latent(family, fit, solved), fit.sigma, 0
        if worse == Options.worse:
            break
    if best is None:
        return None
    latent, plain = (
        held_out_cost(best.family, coefficients, held_out, best.fit.sigma, held_out_arcs)
        for coefficients in (best.fit.coefficients, best.solved.coefficients)
    )
    worse = Comparison.of(latent, plain).is_higher()
    return best if np.isfinite(latent).all() and not worse else None


_SOLVED = 1e-10  # a step in NumPy whose residual is larger has not been solved
_TURNS = 1e-8  # radians, to which momenta must turn with the moves to be angles


def states_of(
    family: OfDisplacement, params: Any, triples: Triples
) -> tuple[np.ndarray, np.ndarray]:
    """z = (q, p) at q₋ and at q, (N, 2d) each: p = −h ∂S/∂q on the way from q₋, h ∂S/∂Q on that to
    q."""
    w = triples.ends[: len(triples)]
    into, out = np.split(triples.dt * np.asarray(family.gradient(params, w)), 2, axis=1)
    before = np.concatenate([triples.before, -into], axis=1)
    return before, np.concatenate([triples.middle, out], axis=1)


def images_of(piece: Generated, triples: Triples) -> np.ndarray:
    """q₊ as the step from q predicts it (N, d), NaN where it does not converge. NumPy."""
    z = states_of(piece.family, piece.params, triples)[1]
    images, error = piece.refined_step(z, triples.ends[len(triples) :])
    solved = (error < _SOLVED) & np.isfinite(images).all(axis=1)
    return np.where(solved[:, None], images, np.nan)[:, : triples.dim]


def map_of(
    piece: Generated, root: np.ndarray, sensors: Sensors, triples: Triples, sites: Sites | None
) -> tuple[SymplecticMap, Pairs]:
    """The map of this S, and its states at q₋ and at q, as pairs.

    root: (k, m), rootᵀ root the covariance of its coefficients.
    """
    dim, angles = triples.dim, list(triples.angles)
    turning, factor = _turning(piece, triples)
    if turning:
        params = jax.tree.map(lambda leaf: leaf * factor, piece.params)
        piece = dataclasses.replace(piece, params=params)
    before, middle = states_of(piece.family, piece.params, triples)
    centres, whole = _reduced(before, middle, angles, angles)
    if turning:
        momenta = [dim + i for i in angles]
        own, covered = _reduced(before, middle, momenta, [*momenta, *angles])
        centres, whole, angles = [*centres, *own], [*whole, *covered], [*angles, *momenta]
    domain = covering(before, ignore=tuple(whole)) if sites is None else sites.domain(before)
    if sites is not None and turning:
        domain = dataclasses.replace(sites, angles="qp").domain(before)
    if not matrix_free(piece.family):
        inputs = partial(box_inputs, angles=triples.angles)
        fitted = fit_predictors(TYPE1, before, middle, triples.dt, inputs)
        piece = dataclasses.replace(piece, predictor=affordable(fitted, piece.family).predictor)
    where = Coordinates("positions", tuple(angles)), domain, sizes(before), np.array(centres)
    map_ = SymplecticMap((piece,), *where, triples.dt)
    map_ = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)), map_)
    map_ = dataclasses.replace(map_, posterior=Posterior(0, factor * root), sensors=sensors)
    return map_, Pairs(before, middle, triples.dt)


def _reduced(before, middle, of: list[int], moved: list[int]) -> tuple[list[float], list[int]]:
    """The angles ``of`` of the states before reduced, in place, by whole turns that are taken from
    the angles ``moved`` of the images too: their centres, and which cover their circle."""
    centres, whole = [], []
    for k, i in enumerate(of):
        centre, covered = circle_centre(before[:, i])
        turns = whole_turns(before[:, i] - centre)
        before[:, i] -= turns
        for j in moved[k :: len(of)]:
            middle[:, j] -= turns
        centres.append(centre)
        whole += [i] if covered else []
    return centres, whole


def _turning(piece: Generated, triples: Triples) -> tuple[bool, float]:
    """Return whether a move that is longer by a turn only adds a turn to both momenta, and the
    factor of S by which it is a turn to the last digit. A map of angles that were measured modulo
    their period has momenta of this period too; its mixed term is a mean of differences."""
    if not triples.wrapped:
        return False, 1.0
    w, dim, turn = triples.ends[: len(triples)], triples.dim, 2 * np.pi
    gradient, added = np.asarray(piece.family.gradient(piece.params, w)), []
    for i in triples.angles:
        further = w.copy()
        further[:, dim + i] += turn
        slope = np.asarray(piece.family.gradient(piece.params, further))
        moved = triples.dt * (slope - gradient)
        added.append(-moved[:, i])
        moved[:, i] += turn
        moved[:, dim + i] -= turn
        if not np.abs(moved).max() < _TURNS:
            return False, 1.0
    return True, turn / float(np.mean(added))
