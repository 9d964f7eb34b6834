"""Terms that the pairs tell apart, and tell from noise."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from gfnn_jax.fitting.descent import ROUNDOFF
from gfnn_jax.fitting.triangle import Triangle

NULL = 1e-10  # of a term's size; one closer to the span of those before it is not known apart


@runtime_checkable
class Solved(Protocol):
    """Fit at whose coefficients the triangle of its problem is known."""

    @property
    def coefficients(self) -> np.ndarray: ...
    @property
    def rms(self) -> float: ...
    @property
    def triangle(self) -> Triangle: ...


def null_terms(family, z, tolerance: float = NULL, *, args=None) -> tuple[list[int], list[int]]:
    """(kept, null): the terms that states z (N, 2d) with these args (N, k) tell apart, and those
    whose gradient is a combination of those before them."""
    gradients = family.term_gradients(z, args)
    columns = gradients.reshape(-1, gradients.shape[-1])
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    kept: list[int] = []
    basis = np.zeros((len(scaled), 0))
    for j in range(scaled.shape[1]):
        rest = scaled[:, j]
        for _ in range(2):  # the second time makes it orthogonal to roundoff
            rest = rest - basis @ (basis.T @ rest)
        distance = np.linalg.norm(rest)
        if np.isfinite(distance) and distance > tolerance and basis.shape[1] < len(scaled):
            kept.append(j)
            basis = np.column_stack([basis, rest / distance])
    return kept, sorted(set(range(scaled.shape[1])) - set(kept))


def significant_terms(fit: Solved, threshold: float) -> np.ndarray:
    """The terms that are left when those below ``threshold`` standard errors go, the others solved
    for again (in the linearised problem), until none is below."""
    return significant(fit.triangle, fit.coefficients, threshold, fit.rms)[0]


def significant(
    triangle: Triangle, coefficients, threshold: float, rms: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(kept, their coefficients) of the linearised problem of [∂r/∂c, r], as `significant_terms`.

    rms: of what the terms do not explain; None: of what all of them leave over.
    """
    count, rows = len(coefficients), triangle.rows
    kept = np.arange(count)
    unexplained = triangle.residual_norm(count) / np.sqrt(rows) if rms is None else rms
    noise = max(unexplained, ROUNDOFF) * np.sqrt(rows / max(rows - count, 1))
    problem, c = triangle.rebased(coefficients), coefficients
    while kept.size:
        spectrum = problem.pruned(kept).spectrum()
        c = spectrum.solution(spectrum.inverse)
        ratio = np.abs(c) / (noise * spectrum.deviations())
        weak = ratio < threshold
        if not weak.any():
            break
        # Half of the weak ones at a time, the weakest first: they lend each other their weight.
        order = np.argsort(ratio)
        gone = order[: max(1, (weak.sum() + 1) // 2)]
        kept, c = np.delete(kept, gone), np.delete(c, gone)
    return kept, c
