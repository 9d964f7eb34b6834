"""Gauss–Newton over arcs whose states are latent.

An arc is a stretch of one run: states x_0 … x_{L−1} at its nodes, of which only

    y_n = g(x_n; p) + noise,        x_{n+1} = F_n(x_n; p)

is known. All nodes are kept as unknowns, so that every step F_n is evaluated at once, and an arc
need not be followed from its first state (multiple shooting; Bock, 1981). An iteration linearises

    δx_{n+1} = Φ_n δx_n + Γ_n δp + c_n,      c_n = F_n(x_n) − x_{n+1}   (the defect)

which makes δx_n a function of δx_0 and δp alone. The arc's own δx_0 is eliminated by its own QR;
what remains of all arcs are rows for δp. Where it converges the defects are zero, and each arc is
an orbit of the law. Residuals enter in units of the noise through Huber's soft-L1 loss, ρ(r) =
2k²(√(1 + (r/k)²) − 1).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

ROBUST = 2.5  # k, in standard deviations
_DEFECT = 0.1  # a defect of this many standard deviations costs as much as a residual of one
_CLOSED = 0.1  # standard deviations, rms: arcs whose defects are smaller are orbits of the law
_SHRINK, _GROW = 0.2, 5.0  # of the damping


class Steps(NamedTuple):
    """Steps of a model from states (A, L, m): those after each step (A, L − 1, m), and derivatives
    in the states before (…, m, m) and in the n coefficients (…, m, n)."""

    states: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


class Observed(NamedTuple):
    """g at the states (A, L, k), and its derivatives (A, L, k, m) and (A, L, k, n)."""

    values: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


@runtime_checkable
class Model(Protocol):
    """States that move and are seen: what `fit_arcs` asks of a law, or of any other map."""

    def steps(self, p: np.ndarray, x: np.ndarray) -> Steps: ...

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed: ...


@dataclasses.dataclass(frozen=True)
class Fitted:
    """The fit of all arcs: coefficients p (n,), states x (A, L, m), residuals (A, L, k) in units
    of the noise (NaN where nothing was seen), the triangle of δp (RᵀR is the information matrix of
    p), those of δx_0 (A, m, m) of each arc with p fixed, ∂x_{L−1}/∂x_0 (A, m, m), and whether it
    converged."""

    p: np.ndarray
    x: np.ndarray
    residuals: np.ndarray
    triangle: np.ndarray
    arcs: np.ndarray
    transports: np.ndarray
    cost: float
    iterations: int
    converged: bool

    def covariance(self) -> np.ndarray:
        """(RᵀR)⁻¹, for white residuals of unit variance."""
        inverse = np.linalg.pinv(self.triangle)
        return inverse @ inverse.T

    def last_covariance(self) -> np.ndarray:
        """Covariance of the last state of each arc (A, m, m), with p as it is."""
        root = self.transports @ np.linalg.pinv(self.arcs)
        return root @ root.swapaxes(1, 2)


def fit_arcs(
    model: Model,
    p: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    sigma: np.ndarray,
    state_scale: np.ndarray,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
) -> Fitted:
    """Fit p (n,) and the states x (A, L, m), from what they start at, to y (A, L, k).

    Entries of y that are NaN were not seen. ``sigma`` (k,) or (A, L, k) is the noise of y,
    ``state_scale`` (m,) the defect that counts as one standard deviation. While defects matter, an
    iteration has to close them; then it has to lower the cost. Ends where it lowers it by less than
    ``tolerance`` of itself. The cost is infinite where the defects could not be closed.
    """
    seen = np.isfinite(y)
    known = np.where(seen, y, 0.0)

    def evaluate(p: np.ndarray, x: np.ndarray) -> _Iterate:
        with np.errstate(all="ignore"):
            steps, observed = model.steps(p, x), model.observe(p, x)
            residuals = np.where(seen, (known - observed.values) / sigma, 0.0)
            defects = steps.states - x[:, 1:]
            cost, gap = float(np.sum(loss(residuals))), float(np.linalg.norm(defects / state_scale))
        if not np.isfinite(cost + gap):
            cost = gap = np.inf
        return _Iterate(p, x, steps, observed, seen, residuals, defects, cost, gap)

    here = best = evaluate(p, x)
    damping, converged, iteration = 1e-4, False, 0
    closed = _CLOSED * np.sqrt(x.size)
    while iteration < max_iterations:
        iteration += 1
        if not np.isfinite(here.cost):
            break
        rows = _reduced(here, sigma)
        there, share = here, 1.0
        while share > 1e-3:
            dp, dx = _solve(rows, damping)
            there = evaluate(here.p + share * dp, here.x + share * dx)
            if here.gap > closed:  # arcs that are not yet orbits of the law
                better = there.gap < (1 - 0.5 * share) * here.gap
            else:
                better = there.merit < here.merit * (1 + 1e-9)
            if better:
                break
            damping, share = max(damping, 1e-6) * _GROW, 0.5 * share
        if share <= 1e-3:
            converged = here.gap <= closed  # no step lowers the cost
            break
        damping = max(damping * _SHRINK, 1e-12) if share == 1.0 else damping
        gained = here.merit - there.merit
        settled = max(here.gap, there.gap) <= closed and gained <= tolerance * here.cost
        here = there
        if here.gap <= closed and (best.gap > closed or here.merit < best.merit):
            best = here
        if settled:
            converged = True
            break
    best = best if best.gap <= closed else here
    rows, m = _reduced(best, sigma), x.shape[-1]
    found = np.where(seen, best.residuals, np.nan)
    cost = best.cost if best.gap <= closed else np.inf
    own = rows.arcs[:, :, :m], rows.sensitivities[:, -1, :, :m]
    return Fitted(best.p, best.x, found, rows.triangle[:-1, :-1], *own, cost, iteration, converged)


def sensitivities(
    model: Model, p: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """The triangle (n + 1, n + 1) of the coefficients and the residuals, the states of each arc
    eliminated, at p and x: what a test of coefficients needs."""
    return _reduced(_evaluated(model, p, x, y, sigma), sigma).triangle


def rows_of_arcs(
    model: Model, p: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """Rows (A, L, k, n + 1) of the coefficients and the residuals, weighted as robust loss has it,
    after each arc's own δx_0 was projected out: residuals − rows · δp are those of any other
    coefficients near p, each arc with the state that suits them best."""
    at = _evaluated(model, p, x, y, sigma)
    J, m = _weighted(at, sigma, _sensitivities(at)), x.shape[-1]
    flat = J.reshape(len(x), -1, J.shape[-1])
    Q = np.linalg.qr(flat[..., :m])[0]
    return (flat[..., m:] - Q @ (Q.swapaxes(1, 2) @ flat[..., m:])).reshape(*J.shape[:-1], -1)


def loss(residuals: np.ndarray) -> np.ndarray:
    """ρ(r) = 2k²(√(1 + (r/k)²) − 1), which is r² where r is small."""
    return 2 * ROBUST**2 * (np.sqrt(1 + (residuals / ROBUST) ** 2) - 1)


class _Iterate(NamedTuple):
    """Iterate: residuals in units of σ, defects, the cost of the residuals, and
    the norm of the defects in units of ``state_scale``."""

    p: np.ndarray
    x: np.ndarray
    steps: Steps
    observed: Observed
    seen: np.ndarray
    residuals: np.ndarray
    defects: np.ndarray
    cost: float
    gap: float

    @property
    def merit(self) -> float:
        return self.cost + (self.gap / _DEFECT) ** 2


class _Rows(NamedTuple):
    """Rows of one iteration: each arc's triangle for its own δx_0 (A, m, m + n + 1), the triangle
    for δp (n + 1, n + 1), and the sensitivities of the states (A, L, m, m + n + 1)."""

    arcs: np.ndarray
    triangle: np.ndarray
    sensitivities: np.ndarray


def _evaluated(
    model: Model, p: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: np.ndarray
) -> _Iterate:
    """Where an iteration that began at p and x would stand."""
    seen = np.isfinite(y)
    steps, observed = model.steps(p, x), model.observe(p, x)
    residuals = np.where(seen, (np.where(seen, y, 0.0) - observed.values) / sigma, 0.0)
    defects = steps.states - x[:, 1:]
    return _Iterate(p, x, steps, observed, seen, residuals, defects, 0.0, 0.0)


def _sensitivities(at: _Iterate) -> np.ndarray:
    """δx_n (A, L, m, m + n + 1) by δx_0, by δp, and by the defects before it."""
    steps = at.steps
    num_arcs, length, m = at.x.shape
    n = steps.by_coefficients.shape[-1]
    S = np.zeros((num_arcs, length, m, m + n + 1))
    S[:, 0, range(m), range(m)] = 1.0
    for i in range(length - 1):
        S[:, i + 1] = steps.by_state[:, i] @ S[:, i]
        S[:, i + 1, :, m : m + n] += steps.by_coefficients[:, i]
        S[:, i + 1, :, -1] += at.defects[:, i]
    return S


def _weighted(at: _Iterate, sigma: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Rows (A, L, k, m + n + 1) of the residuals by δx_0 and δp, and of the residuals themselves,
    in units of σ and weighted; 0 where nothing was seen."""
    observed, residuals, m = at.observed, at.residuals, at.x.shape[-1]
    J = observed.by_state @ S
    J[..., m:-1] += observed.by_coefficients
    J /= sigma[..., None]
    J[..., -1] = residuals - J[..., -1]
    weight = (1 + (residuals / ROBUST) ** 2) ** -0.25  # the square root of ρ'(r)/2r
    return J * np.where(at.seen, weight, 0.0)[..., None]


def _reduced(at: _Iterate, sigma: np.ndarray) -> _Rows:
    num_arcs, length, k, m = at.observed.by_state.shape
    n = at.observed.by_coefficients.shape[-1]
    S = _sensitivities(at)
    J = _weighted(at, sigma, S)
    R = np.asarray(np.linalg.qr(J.reshape(num_arcs, length * k, -1), mode="r"))
    rest = R[:, m:, m:].reshape(-1, n + 1)
    rest = np.concatenate([rest, np.zeros((max(0, n + 1 - len(rest)), n + 1))])
    return _Rows(R[:, :m], np.asarray(np.linalg.qr(rest, mode="r")), S)


def _solve(rows: _Rows, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """δp (n,) and δx (A, L, m), with Levenberg and Marquardt's damping of δp."""
    m = rows.arcs.shape[1]
    R = rows.triangle
    n = R.shape[1] - 1
    scale = np.linalg.norm(R[:, :n], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    matrix = np.concatenate([R[:, :n] / scale, np.sqrt(damping) * np.eye(n)])
    target = np.concatenate([R[:, n], np.zeros(n)])
    dp = np.linalg.lstsq(matrix, target, rcond=1e-13)[0] / scale
    right = rows.arcs[:, :, -1] - rows.arcs[:, :, m : m + n] @ dp
    first = np.linalg.solve(rows.arcs[:, :, :m], right[..., None])[..., 0]
    dx = np.einsum("alij,aj->ali", rows.sensitivities[..., :m], first)
    dx += rows.sensitivities[..., m : m + n] @ dp + rows.sensitivities[..., -1]
    return dp, dx
