"""Models of arcs, one protocol: the defects between neighbouring states, and what is measured.

    y_n = g(x_n; p) + noise,        D(x_n, x_{n+1}; p) = 0

`solve.latent_arcs` fits p and the states x to y.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np


class Defects(NamedTuple):
    """The linearised defects of states (A, L, m): c_n (A, L − 1, m), Φ_n (…, m, m) and, in the n
    coefficients, Γ_n (…, m, n)."""

    closing: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


class Observed(NamedTuple):
    """g at the states (A, L, k), and its derivatives (A, L, k, m) and (A, L, k, n)."""

    values: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


@runtime_checkable
class Model(Protocol):
    """States that move and are measured: what `Readings.fit` asks of a law, or of any other map."""

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects: ...

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed: ...

    def take(self, arcs: np.ndarray) -> Model:
        """The same model of some of the arcs (indices)."""
        ...


def observed_whole(x: np.ndarray, coefficients: int) -> Observed:
    """The states themselves, g(x; p) = x."""
    own = np.broadcast_to(np.eye(x.shape[-1]), (*x.shape, x.shape[-1]))
    return Observed(x, own, np.broadcast_to(0.0, (*x.shape, coefficients)))


@dataclasses.dataclass(frozen=True)
class Known:
    """A model whose coefficients p (n,) are known: only states are latent."""

    model: Model
    p: np.ndarray

    def take(self, arcs: np.ndarray) -> Known:
        return Known(self.model.take(arcs), self.p)


def evaluated(model: Model | Known, p: np.ndarray, x: np.ndarray) -> tuple[Defects, Observed]:
    """The linearised defects of states x (A, L, m), and what is measured of them."""
    if not isinstance(model, Known):
        return model.defects(p, x), model.observe(p, x)
    defects, observed = evaluated(model.model, model.p, x)
    return (
        defects._replace(by_coefficients=defects.by_coefficients[..., :0]),
        observed._replace(by_coefficients=observed.by_coefficients[..., :0]),
    )
