"""A law as fitted: its family, the fit to some rows, and what the search for it told."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.dataset.measured_error import OneStepError
from gfnn_jax.fitting.gauss_newton import FlowFit
from gfnn_jax.models.hamiltonians.formula import Proposal, Rival, Term


class Dropped(NamedTuple):
    """Terms that went because the pairs do not ask for them, and what that cost: the held-out error
    ÷ spread with them and without."""

    terms: int
    error_with: float
    error_without: float


class SequenceFit(NamedTuple):
    """Fit of a law to whole sequences. root: (k, k), rootᵀ root is the coefficients' covariance.
    noise: (2d,) standard deviation of each coordinate's noise. arcs: into which the sequences were
    cut. messages: about gross errors. misfit: whether the arcs are certain that the law misses more
    than noise."""

    root: np.ndarray
    noise: np.ndarray
    arcs: int
    messages: tuple[str, ...]
    misfit: bool = False


class FittedLaw(NamedTuple):
    """Law of terms with its fit and its held-out error.

    rows: that the fit was given; it has left out those that the flow does not resolve. null: terms
    that the pairs do not tell from the others.
    undetermined: of the null terms, those that other states would tell from the rest. ended: why a
    library that grew did so no longer. stalled: whether larger libraries were no better. noisy:
    whether their errors were the same, which is that of the pairs; larger: the largest
    of those. thresholds: standard errors below which its terms go, in turn; None: as of the
    options. dropped: terms that went in the end. whole:
    what whole sequences tell, where they were fitted. constants: numbers inside terms that were
    fitted with them. symmetries, proposals, rivals: as of `LearnedHamiltonian`. odds: of the kinds
    of its friction against others, where these competed."""

    family: Any  # of terms of H, or of L, with friction or without
    fit: FlowFit
    rows: np.ndarray
    error: OneStepError
    null: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    ended: str = ""
    stalled: bool = False
    noisy: bool = False
    larger: FittedLaw | None = None
    thresholds: tuple[float, ...] | None = None
    dropped: Dropped | None = None
    whole: SequenceFit | None = None
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
    proposals: tuple[Proposal, ...] = ()
    rivals: tuple[Rival, ...] = ()
    odds: dict[tuple[int, ...], float] | None = None

    @property
    def values(self) -> dict[str, float]:
        """The coefficient of each term by its name."""
        return dict(zip(self.family.term_names, self.fit.coefficients, strict=True))

    def start_of(self, family) -> np.ndarray:
        """Coefficients (terms,) of another family: this law's, 0 of terms that it has not."""
        known = self.values
        return np.array([known.get(name, 0.0) for name in family.term_names])
