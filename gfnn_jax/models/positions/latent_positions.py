"""S(q, Q) from noisy readings of positions: true positions are unknowns beside its coefficients.

Least squares in the discrete Euler–Lagrange equations takes readings for positions, and the noise
of readings in its own columns biases it. Here arcs of readings are compared, in units of their
noise σ, with orbits of S, whose positions are latent (`solve.latent_arcs`); σ is that of the
residuals. Least squares only starts it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import FLOW, Budget
from gfnn_jax.errors import OutOfTime
from gfnn_jax.generating.arcs import PositionArcs, nodes_of
from gfnn_jax.models.positions.discrete_lagrangian import Solved, Triples, residuals, solve
from gfnn_jax.solve.latent_arcs import SOFT_L1, Readings


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the fit to latent positions (benchmarks/positions.py)."""

    longest: int = 24  # nodes of an arc: its own two positions cost a twelfth of what it tells
    most_nodes: int = 20000  # of all arcs: a minute and a quarter of a gigabyte at a hundred terms
    # of all Jacobians (2d, 2d) along the arcs, a quarter of a gigabyte
    most_numbers: float = 30000000.0
    settled: float = 1.05  # a noise scale that changed by less needs no further fit
    scales: int = 4  # fits, at most, that find it
    gross: float = 5.0  # standard deviations: of what is not noise
    certain: float = 2.0  # standard errors, by which least squares has to be better to be kept
    worse: int = 2  # sizes in a row that are no better end the search
    passes: float = 32.0  # over the rows: some four iterations, twice, with all derivatives
    most_operations: float = 20000000000.0  # of one size: about a minute


OPTIONS = Options()

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
    longest = min(int(sizes.max()) - 1, OPTIONS.longest)
    used = [np.sum(sizes // (nodes + 1)) * (nodes - 1) for nodes in range(2, longest + 1)]
    span = 3 + int(np.argmax(used))
    cut = [
        s[first : first + span] for s in stretches for first in range(0, len(s) - span + 1, span)
    ]
    most = max(span, min(OPTIONS.most_nodes, int(OPTIONS.most_numbers / (2 * triples.dim) ** 2)))
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
    for _ in range(OPTIONS.scales):
        scale = np.tile(sigma, 2)
        found = Readings(model, y, scale).fit(p, x, scale)
        p, x = found.p, found.x
        change = _size(found.residuals, dim) * left
        sigma = sigma * change
        if np.all(np.abs(np.log(change)) < np.log(OPTIONS.settled)):
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
    gross = np.abs(r) > OPTIONS.gross * np.nanmedian(np.abs(r), axis=(0, 1)) / 0.6745
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
        work = OPTIONS.passes * arcs.size * (family.num_parameters + 2 * training.dim) ** 2
        if best is not None and work > OPTIONS.most_operations:
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
        if worse == OPTIONS.worse:
            break
    if best is None:
        return None
    latent, plain = (
        held_out_cost(best.family, coefficients, held_out, best.fit.sigma, held_out_arcs)
        for coefficients in (best.fit.coefficients, best.solved.coefficients)
    )
    gain = latent - plain
    plain_is_better = gain.mean() > OPTIONS.certain * gain.std() / np.sqrt(len(gain))
    return best if np.isfinite(latent).all() and not plain_is_better else None
