"""Is model B better than model A? One rule of evidence for terms, frictions, inputs and offsets.

- *Parts of the data that neither fit has seen* say it where they can: the cost of B over that of A,
  and the standard error of their difference, which is that of the paired differences of the parts.
- A coefficient in units of its *standard error*, and *Schwarz's criterion* n log S + k log n of the
  sum of squares S and k coefficients (Ann. Statist. 6 (1978) 461), say it where they cannot: they
  choose what is compared, and decide where one part alone determines a coefficient.
- Two models whose scale of residuals is found from them have *odds* of (S_A / S_B)^(n/2), n the
  number of independent residuals.

A search among terms makes one change after another, terms that come or go, as long as one of them
makes a better model (`improved`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gfnn_jax.errors import OutOfTime

Model = TypeVar("Model")


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Evidence that a change of a model needs (`benchmarks/random_recordings.py`, `measured.py`).

    In standard errors: significant: below it a coefficient may go; nothing: below it the
    coefficient goes without a look at held-out parts; scored: above it one that is omitted is
    tried. gain: share of the held-out cost by which a change has to lower it; with two standard
    errors of the paired differences in its place a term that is not there spoils the law of a
    spring (random_recordings, draw 0), for small shares are what a wrong law gains. chance:
    standard errors of a difference of held-out costs that chance makes. decided: odds below which
    two models are as good; needed: odds below which a direction of friction is left out. log_odds:
    the largest logarithm of odds that is stated. logarithm: of the ratio of likelihoods, that a
    model of correlated residuals has to gain. rise: of the held-out error of pairs, that fewer
    terms may cost; roundoff: of the spread, an error that is no more.
    """

    significant: float = 4.0
    nothing: float = 1.0
    scored: float = 5.0
    gain: float = 0.05
    chance: float = 2.0
    decided: float = 20.0
    needed: float = 3.0
    log_odds: float = 20.0
    logarithm: float = 10.0
    rise: float = 1.1
    roundoff: float = 1e-14

    @property
    def deciding(self) -> float:
        """The difference of Schwarz's criteria of two models with odds that decide."""
        return 2 * float(np.log(self.decided))

    def is_no_worse(self, error: float, before: float) -> bool:
        """Return whether a held-out error ÷ spread is that of a model which is as good as the one
        before."""
        return error <= max(self.rise * before, self.roundoff)

    def odds(self, cost: float, other: float, count: float) -> float:
        """Odds of a model of this held-out sum of squares over another, by ``count`` independent
        residuals."""
        log = 0.5 * count * np.log(max(other, 1e-300) / max(cost, 1e-300))
        return float(np.exp(np.clip(log, -self.log_odds, self.log_odds)))


EVIDENCE = Evidence()


class Rival(NamedTuple):
    """Another law that the data allow, the odds of the one that was taken against it, its terms
    beside those of that one, "" where they are not told: "with x⁴ in place of x⁶", and whether it
    leaves open which law it is: it is likelier, or as plain."""

    formula: str
    odds: float
    terms: str = ""
    leaves_open: bool = True


class Comparison(NamedTuple):
    """Costs of a model on parts that it has not seen, beside those of another: the sums, their
    difference, which parts that cost the same have none of, and its standard error."""

    cost: float
    other: float
    apart: float
    error: float

    @classmethod
    def of(cls, costs: np.ndarray, others: np.ndarray) -> Comparison:
        """Compare costs (n,) of the same parts; infinite where a fit failed."""
        with np.errstate(invalid="ignore"):
            apart = np.where(costs == others, 0.0, costs - others)
            error = np.sqrt(len(apart)) * np.std(apart, ddof=min(1, len(apart) - 1))
        return cls(float(np.sum(costs)), float(np.sum(others)), float(np.sum(apart)), float(error))

    def is_lower(self, share: float = 0.0) -> bool:
        """Return whether the model costs less than the other, by this share of it at least."""
        return self.cost < self.other * (1 - share)

    def is_higher(self, errors: float = EVIDENCE.chance) -> bool:
        """Return whether the model costs more than the other, by more than these standard errors,
        of which infinite costs have none."""
        return not self.apart <= errors * self.error


def improved(
    model: Model,
    changes: Callable[[Model], Iterable[Any]],
    changed: Callable[[Model, Any], Model | None],
    most: float = np.inf,
) -> Model:
    """The model that one change after another leads to.

    changes: names those of a model that may make it better, the most promising first. changed: the
    model after one of them, None where it is no better: that change is not tried again. most: that
    are tried. A change that raises OutOfTime is the last: the model before it stands.
    """
    refused, tried = set(), 0
    while True:
        for change in changes(model):
            if change in refused:
                continue
            if tried == most:
                return model
            try:
                tried, other = tried + 1, changed(model, change)
            except OutOfTime:
                return model
            if other is not None:
                model = other
                break
            refused.add(change)
        else:
            return model


def criterion(cost: float, count: float, coefficients: int) -> float:
    """Schwarz's criterion of a model with so many coefficients, by its sum of squares and the
    number of independent residuals: the least is the likeliest."""
    return float(count * np.log(max(cost, 1e-300)) + coefficients * np.log(count))


def correlation_time(residuals: np.ndarray) -> float:
    """1 + 2 Σ ρ_k of residuals (A, L, d) along arcs, until ρ_k falls below 0.05; at least 1: among
    so many neighbours a residual counts as one."""
    r = np.where(np.isfinite(residuals), residuals, 0.0)
    finite = np.isfinite(residuals).astype(float)
    power = np.sum(r * r) / max(np.sum(finite), 1.0)
    total = 1.0
    for k in range(1, r.shape[1]):
        pairs = np.sum(finite[:, k:] * finite[:, :-k])
        rho = np.sum(r[:, k:] * r[:, :-k]) / max(pairs, 1.0) / max(power, 1e-300)
        if rho < 0.05:
            break
        total += 2 * rho
    return total
