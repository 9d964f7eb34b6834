"""Findings in the residuals of a map: noise or structure, friction, something that differs between
sequences.

Noise differs from one pair to the next however close they are; what a map cannot represent is a
function of the state, so that neighbours have nearly the same of it. (The part of a variogram that
does not vanish with the distance is the nugget: G. Matheron, Econ. Geol. 58 (1963) 1246.)

What a symplectic map leaves over of another one is, to first order, J∇K of some K at the images.
Friction, −ρ_i p_i, is no such field: beside a K of as many terms as the pairs tell apart, ρ is a
coefficient like others, with a standard error.
"""

import math

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.arrays import products
from gfnn_jax.candidates.assemble import stepped
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import of_halves, of_pairs
from gfnn_jax.dataset.runs import next_of
from gfnn_jax.errors import FitError
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.fitting.significance import CERTAIN
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, apply_j, sizes, split


class Options:
    """Options of the tests of residuals (benchmarks/as_a_user.py, benchmarks/friction_kinds.py)."""

    apart: float = 1e-4  # of the coordinates' sizes: the step of the central differences
    probes: int = 4  # random directions of each half of the coordinates
    # Neighbours that are looked at; the part of them that is closest, and its least number.
    nearest: int = 6
    closest: float = 0.25
    fewest: int = 20
    # Mean square of differences between close neighbours, ÷ that of two unrelated ones: of noise
    # 0.9 and more, of a dry friction that was not learned 0.006, of two bodies by degree 6 0.14.
    noise: float = 0.6
    # The same of products of two coordinates, above which neighbours are too far apart to tell:
    # 2,000 pairs of four degrees of freedom have 0.2, of eight 0.45.
    smooth: float = 0.3
    degrees: tuple[int, ...] = (8, 6, 5, 4, 3, 2)  # of K
    rows_per_term: int = 10
    most_terms: int = 400
    # A change of volume is reported where it is certain, in the inner half of the states by so
    # many standard errors and in the outer too, and where both are the same within this factor.
    # It is larger than the square of the residuals, to which order J∇K is what they are, and than
    # roundoff.
    of_halves: float = 3.0
    alike_of_halves: float = 2.0
    roundoff: float = 1e-13
    # What an affine fit within sequences may leave of a residual that agrees within them;
    # neighbours among which the nearest one of another sequence is sought.
    explained: float = 0.25
    sequence_neighbours: int = 50
    nearby: int = 16  # neighbours that tell the size of what is left over at a state
    # Times as much as a neighbour as far in the same sequence leaves over, one of another
    # sequence does where something differs between them.
    across: float = 3.0
    # A cubic law is fitted where there are so many pairs for each of its terms.
    pairs_per_term: int = 10
    pairs_of_misfit: int = 50  # pairs that a library is fitted to; as many judge it
    quiet: float = 0.75  # of the sample, that moves least


def state_noise(map_: SymplecticMap, pairs: Pairs, taken: float) -> np.ndarray:
    """Standard deviation (2d,) of each coordinate's noise, from the residuals of these pairs.

    pairs: with their runs and places, in the order of these. taken: the part of the residuals'
    degrees of freedom that the map's coefficients took.
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    width, size = z0.shape[1], sizes(z0)
    residual = nearest_image(z1 - _images(map_, pairs, z0), map_.angles_of_z)
    jacobian = np.empty((len(z0), width, width))
    for j, apart in enumerate(Options.apart * size):
        jacobian[:, :, j] = _change(map_, pairs, apart * (np.arange(width) == j)) / apart
    known = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    shared = np.flatnonzero(next_of(pairs, np.flatnonzero(known)))
    return of_pairs(residual[known], jacobian[known], shared) / np.sqrt(1.0 - taken)


def noise_of_sites(map_: SymplecticMap, pairs: Pairs) -> np.ndarray:
    """The same (2d,) where all positions have one noise, and all momenta one, as of equal sites.

    The sums of squares of M's rows are means of (M v)² over random signs v: the steps that they
    take do not depend on d (Hutchinson, Commun. Stat. Simul. 18 (1989) 1059).
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    dim, size, rng = pairs.dim, sizes(z0), np.random.default_rng(0)
    residual = nearest_image(z1 - _images(map_, pairs, z0), map_.angles_of_z)
    halves = np.arange(2 * dim) // dim
    grown = np.zeros((2, len(z0), 2 * dim))
    for half in (0, 1):
        apart = Options.apart * float(size[halves == half].min())
        for _ in range(Options.probes):
            signs = rng.choice([-1.0, 1.0], z0.shape) * (halves == half)
            grown[half] += (_change(map_, pairs, apart * signs) / apart) ** 2 / Options.probes
    known = np.isfinite(residual).all(axis=1) & np.isfinite(grown).all(axis=(0, 2))
    return of_halves(residual[known], grown[:, known])


def _images(map_: SymplecticMap, pairs: Pairs, z) -> np.ndarray:
    return stepped(map_, z, pairs.dt, pairs.args, timed=False).images


def _change(map_: SymplecticMap, pairs: Pairs, offset) -> np.ndarray:
    """(N, 2d), what the step changes by when the states of the pairs change by the offset, to
    second order."""
    z0 = np.asarray(pairs.z0)
    ahead, behind = (_images(map_, pairs, z0 + sign * offset) for sign in (1, -1))
    return nearest_image(ahead - behind, map_.angles_of_z) / 2


def is_noise(z, residual, run, place) -> bool | None:
    """Return whether the residuals differ between close neighbours as much as between any two; None
    where the pairs lie too far apart for a smooth function to tell.

    z, residual: (N, 2d) in units of the coordinates' sizes. run, place: (N,) of each row: rows that
    follow each other share a state, and its noise, and are no neighbours.
    """
    one, other = _close_neighbours(np.asarray(z), np.asarray(run), np.asarray(place))
    if len(one) < Options.fewest:
        return None
    if _difference_of_neighbours(residual, one, other) < Options.noise:
        return False
    # Products of coordinates are as smooth as what may be missing is at best.
    smooth = np.asarray(z) * np.roll(z, 1, axis=1)
    return True if _difference_of_neighbours(smooth, one, other) < Options.smooth else None


def _difference_of_neighbours(values, one, other) -> float:
    values = np.asarray(values)
    each = np.sum(values[one] ** 2 + values[other] ** 2)
    return float(np.sum((values[one] - values[other]) ** 2) / each) if each > 0 else 0.0


def _close_neighbours(z, run, place) -> tuple[np.ndarray, np.ndarray]:
    """Rows and the nearest neighbour of each, the quarter of them that is closest."""
    rows = np.arange(len(z))
    distance, near = cKDTree(z).query(z, k=min(Options.nearest + 1, len(z)))
    distance, near = distance[:, 1:], near[:, 1:]
    follows = (run[near] == run[:, None]) & (np.abs(place[near] - place[:, None]) <= 1)
    distance = np.where(follows, np.inf, distance)
    first = np.argmin(distance, axis=1)
    distance, near = distance[rows, first], near[rows, first]
    closest = np.argsort(distance)[: max(Options.fewest, int(Options.closest * len(z)))]
    closest = closest[np.isfinite(distance[closest])]
    return rows[closest], near[closest]


def hidden_friction(images, residual, angles: tuple[int, ...] = ()) -> tuple[float, float] | None:
    """(change of phase-space volume in a step, its standard error) by friction in the residuals
    (n, 2d) of a symplectic map at its images (n, 2d); None where it is not certain, or the pairs
    are too few."""
    images, residual = np.asarray(images), np.asarray(residual)
    whole, square = _by_friction(images, residual, angles), np.mean((residual / sizes(images)) ** 2)
    if whole is None or not abs(whole[0]) > max(CERTAIN * whole[1], square, Options.roundoff):
        return None
    distance = np.linalg.norm((images - images.mean(axis=0)) / sizes(images), axis=1)
    inside = distance <= np.median(distance)
    for half in (inside, ~inside):
        part = _by_friction(images[half], residual[half], angles)
        if part is None or not abs(part[0]) > Options.of_halves * part[1]:
            return None
        if not 1 / Options.alike_of_halves < part[0] / whole[0] < Options.alike_of_halves:
            return None
    return whole


def _by_friction(images, residual, angles) -> tuple[float, float] | None:
    """The sum of −ρ_i and its standard error, which knows that pairs differ in what is left."""
    count, width = residual.shape
    inputs = box_inputs(images, angles=angles)
    most = min(Options.most_terms, count * width // Options.rows_per_term)
    families = (Products(inputs, n) for n in Options.degrees)
    family = next((f for f in families if f.num_parameters <= most), None)
    if family is None:
        return None
    size, (_, p) = sizes(images), split(images)
    slopes = family.term_gradients(images)  # (n, 2d, terms)
    fields = np.moveaxis(apply_j(np.moveaxis(slopes, -1, 1)), 1, -1)
    rates = -p[..., None] * np.eye(width // 2)
    rates = np.concatenate([np.zeros_like(rates), rates], axis=1)
    design = np.concatenate([fields, rates], axis=-1) / size[:, None]
    design = design.reshape(count * width, -1)
    design = design / np.linalg.norm(design, axis=0).clip(np.finfo(float).tiny)
    norms = np.linalg.norm((rates / size[:, None]).reshape(count * width, -1), axis=0)
    inverse = np.linalg.pinv(design, rcond=1e-10)
    target = (residual / size).ravel()
    left = (target - design @ (inverse @ target)).reshape(count, width)
    own = inverse[-(width // 2) :] / np.where(norms > 0, norms, np.inf)[:, None]
    weights = own.sum(axis=0).reshape(count, width)
    rho, scores = float(np.sum(weights.ravel() * target)), np.sum(weights * left, axis=1)
    freedom = max(1.0 - design.shape[1] / design.shape[0], 0.1)
    return -rho, float(np.linalg.norm(scores) / freedom)


def is_smooth(z, residual) -> bool:
    """Return whether a cubic function of the state, a linear one where the pairs are few, explains
    half of the residual. z, residual: (N, 2d)."""
    z, residual = np.asarray(z), np.asarray(residual)
    few = len(z) < Options.pairs_per_term * math.comb(z.shape[1] + 3, 3)
    design = products((z - z.mean(axis=0)) / sizes(z), 1 if few else 3)
    rest = residual - design @ np.linalg.lstsq(design, residual, rcond=None)[0]
    return bool(np.mean(rest**2) <= 0.5 * np.mean(residual**2))


def differs_between_sequences(z, residual, sequence) -> bool:
    """Return whether what a fit left over agrees within a sequence and differs between sequences:
    then something that the states do not hold, a parameter, differs between them.

    z, residual: (N, 2d), in units of the coordinates' sizes; sequence: (N,). Within, every other
    pair of a sequence is predicted by an affine fit to the rest of it; between, a pair by its
    nearest neighbour in other sequences, and by the next one of its own that is no nearer. Noise is
    predicted by none of them, a misfit by as far a neighbour of whichever sequence; where that is
    too far away to tell, as in many dimensions, nothing is. Residuals are looked at in units of
    their size nearby: a step magnifies the noise of the states, in close passages a hundred times,
    and a few of these would stand for all.
    """
    z, residual, count = np.asarray(z), np.asarray(residual), min(len(z), Options.nearby)
    near = cKDTree(z).query(z, k=count)[1].reshape(len(z), count)
    size = np.sqrt(np.mean(residual[near] ** 2, axis=1))
    residual = residual / np.where(size > 0, size, 1.0)
    total, within, rows = 0.0, 0.0, []
    for number in np.unique(sequence):
        own = np.flatnonzero(sequence == number)
        if len(own) < 4 * (1 + z.shape[1]):
            continue
        design = np.column_stack([np.ones(len(own)), z[own]])
        fitted = np.linalg.lstsq(design[::2], residual[own[::2]], rcond=None)[0]
        total += np.sum(residual[own[1::2]] ** 2)
        within += np.sum((residual[own[1::2]] - design[1::2] @ fitted) ** 2)
        rows.append(own)
    if len(rows) < 2 or not within < Options.explained * total:
        return False
    rows = np.concatenate(rows)
    count = min(len(rows), Options.sequence_neighbours)
    _, near = cKDTree(z[rows]).query(z[rows], k=count)
    other = sequence[rows][near] != sequence[rows][:, None]
    first = np.argmax(other, axis=1)  # the nearest of another sequence
    as_far = ~other & (np.arange(count) > first[:, None])
    known = other.any(axis=1) & as_far.any(axis=1)
    residual, near, places = residual[rows], near[known], np.arange(len(rows))[known]
    ends = (near[np.arange(len(near)), k[known]] for k in (first, np.argmax(as_far, axis=1)))
    across, along = (np.sum((residual[places] - residual[other]) ** 2) for other in ends)
    return bool(across > 0.5 * np.sum(residual[places] ** 2) and across > Options.across * along)


def misfit(family, data: Dataset, chart: AnyChart) -> float:
    """Part of the held-out target gradients that a family, linear in its parameters, leaves over:
    the median over pairs, of the forces or of the velocities, whichever is larger; infinite where
    its functions overflow. data: without args."""
    rows = data.training[: 2 * Options.pairs_of_misfit]
    moved = np.abs((data.y1[rows] - data.y0[rows]) / data.scale).max(axis=1)
    rows = rows[moved <= np.quantile(moved, Options.quiet)]  # close passages move most
    y0, y1 = data.y0[rows], data.y1[rows]
    half = len(rows) // 2
    w, target = chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, data.dt)
    try:
        c = fitted_gradients(family, w[:half], target[:half], data.scale)
    except (FitError, np.linalg.LinAlgError):  # functions that overflow at these states
        return np.inf
    off = family.gradient(c, w[half:]) - target[half:]
    by_two = ((np.reshape(x, (len(x), 2, -1))) for x in (off, target[half:]))
    left, whole = (np.median(np.linalg.norm(x, axis=2), axis=0) for x in by_two)
    part = float(np.max(left / np.maximum(whole, np.finfo(float).tiny)))
    return part if np.isfinite(part) else np.inf
