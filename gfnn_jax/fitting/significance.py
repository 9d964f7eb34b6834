"""Terms that the pairs tell apart, and tell from noise."""

from collections.abc import Iterator, Sequence
from itertools import takewhile

import numpy as np

from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.fitting.gauss_newton import ROUNDOFF
from gfnn_jax.fitting.triangle import Triangle

# Standard errors. A term that is smaller than the first is noise (a larger one is so by chance once
# in 16,000); what a message states as certain is larger than the second (once in 1.7 million).
ABOVE_NOISE, CERTAIN = EVIDENCE.significant, 5.0
NULL = 1e-10  # of a term's size; one closer to the span of those before it is not known apart


def null_terms(family, z, args=None) -> tuple[list[int], list[int]]:
    """(kept, null): the terms that states z (N, 2d) with these args (N, k) tell apart, and those
    whose gradient is a combination of those before them."""
    gradients = family.term_gradients(z, args)
    columns = gradients.reshape(-1, gradients.shape[-1])
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    kept: list[int] = []
    basis = np.zeros((len(scaled), 0))
    for j in range(scaled.shape[1]):
        rest = beside(basis, scaled[:, j])
        distance = np.linalg.norm(rest)
        if np.isfinite(distance) and distance > NULL and basis.shape[1] < len(scaled):
            kept.append(j)
            basis = np.column_stack([basis, rest / distance])
    return kept, sorted(set(range(scaled.shape[1])) - set(kept))


def beside(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns (n, m), or one (n,), without what an orthonormal basis (n, k) spans of them."""
    for _ in range(2):  # the second time makes them orthogonal to roundoff
        columns = columns - basis @ (basis.T @ columns)
    return columns


def significant(
    triangle: Triangle, coefficients, threshold: float, rms: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(kept, their coefficients) of the linearised problem of [∂r/∂c, r], when the terms below
    ``threshold`` standard errors go, the others solved for again, until none is below.

    rms: of what the terms do not explain; None: of what all of them leave over.
    """
    noise, problem = _noise(triangle, len(coefficients), rms), triangle.rebased(coefficients)
    return _eliminated(problem, np.arange(len(coefficients)), coefficients, threshold * noise)


def at_thresholds(
    triangle: Triangle,
    coefficients: np.ndarray,
    thresholds: Sequence[float],
    rms: float | None = None,
) -> Iterator[list[int]]:
    """Iterate over the sets of terms, neither all nor none, that are left by thresholds in turn, as
    `significant`, each set once."""
    found: list[list[int]] = [[], list(range(len(coefficients)))]
    for threshold in thresholds:
        found.append(significant(triangle, coefficients, threshold, rms)[0].tolist())
        if found[-1] not in found[:-1]:
            yield found[-1]


def terms_above_noise(
    triangle: Triangle, coefficients: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """(kept, their coefficients) of the linearised problem of [∂r/∂c, r]: the terms that lower
    ‖r‖² + n (threshold σ)², n of them, the most, σ the noise that all of them leave over.

    Of terms that are nearly combinations of others, elimination may take the true one first, and
    matching (orthogonal matching pursuit: Pati, Rezaiifar & Krishnaprasad 1993) may add a wrong one
    first: the better of the two is taken.
    """
    problem = triangle.rebased(coefficients)
    limit = threshold * _noise(triangle, len(coefficients), None)
    ahead = matched(problem.factor[:, :-1], problem.factor[:, -1])
    first = sorted(place for place, gain, _ in takewhile(lambda one: one[1] > limit, ahead))
    found = [
        _eliminated(problem, kept, coefficients[kept], limit)
        for kept in (np.arange(len(coefficients)), np.array(first, int))
    ]

    def cost(found: tuple[np.ndarray, np.ndarray]) -> float:
        kept, c = found
        left = problem.factor[:, kept] @ c - problem.factor[:, -1]
        return float(left @ left) + len(kept) * limit**2

    return min(found, key=cost)


def terms_with_constants(
    triangle: Triangle, p: np.ndarray, inside: Sequence[Sequence[int]]
) -> list[int]:
    """The terms that are left when noise goes, as `significant`, each with the constants inside it:
    ``inside`` has their places among the numbers p (n,), the coefficients first, of each term."""
    limit, every = ABOVE_NOISE * _noise(triangle, len(p), None), np.arange(len(inside))
    return _eliminated(triangle.rebased(p), every, p, limit, inside)[0].tolist()


def _noise(triangle: Triangle, count: int, rms: float | None) -> float:
    rows = triangle.rows
    unexplained = triangle.residual_norm(count) / np.sqrt(rows) if rms is None else rms
    return max(unexplained, ROUNDOFF) * np.sqrt(rows / max(rows - count, 1))


def matched(
    columns: np.ndarray, target: np.ndarray
) -> Iterator[tuple[int, np.floating, np.floating]]:
    """Iterate over the columns (n, m) that explain the target (n,) one after another, whichever
    explains the most: its place, how much of what is left it explains, and how much is left."""
    size = np.linalg.norm(columns, axis=0)
    for _ in size:
        rest = np.linalg.norm(columns, axis=0)
        known = rest > NULL * size
        gain = np.where(known, np.abs(target @ columns) / np.where(known, rest, 1.0), 0.0)
        best = int(np.argmax(gain))
        yield best, gain[best], np.linalg.norm(target)
        unit = columns[:, best] / max(rest[best], 1e-300)
        target, columns = target - unit * (unit @ target), columns - np.outer(unit, unit @ columns)
        columns[:, best] = 0.0


def of_two(along: np.ndarray, cosines: np.ndarray, null: float) -> np.ndarray:
    """(m, m) of the square of a target what two columns explain together; 0 where one imitates the
    other but for the share ``null`` of its square. along: (m,) the target's parts along columns of
    unit length."""
    free = 1 - cosines**2
    both = along**2 + along[:, None] ** 2 - 2 * np.outer(along, along) * cosines
    return np.where(free > null, both / np.where(free > null, free, 1.0), 0.0)


def _eliminated(
    problem: Triangle,
    kept: np.ndarray,
    c: np.ndarray,
    limit: float,
    inside: Sequence[Sequence[int]] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(kept, their coefficients) when of these terms those go whose absence leaves less than
    ``limit`` over, the others solved for again, until there are none. inside: further columns that
    each term has and loses."""
    while kept.size:
        beside = [k for j in kept for k in inside[j]] if inside else []
        spectrum = problem.pruned(np.append(kept, beside).astype(int)).spectrum()
        c = spectrum.solution(spectrum.inverse)[: kept.size]
        ratio = np.abs(c) / spectrum.deviations()[: kept.size]
        weak = ratio < limit
        if not weak.any():
            break
        # Half of the weak ones at a time, the weakest first: they lend each other their weight.
        order = np.argsort(ratio)
        gone = order[: max(1, (weak.sum() + 1) // 2)]
        kept, c = np.delete(kept, gone), np.delete(c, gone)
    return kept, c
