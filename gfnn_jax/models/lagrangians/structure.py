"""The structure of a law: which terms, frictions, gains and zeros of angles it has, how it is seen,
and its gauge.

L → c L + const moves nothing, so one coefficient has to be given: the mean of M₁₁ over the data is
1. (To set the coefficient of ½v₁² alone would admit M₁₁ = 1 − 1.3 cos q + 0.3 cos 2q, which is
nearly zero where the data are, and fits any record with nothing.) In a law whose M₁₁ is constant
that is ½ of v₁².
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from gfnn_jax.families.lagrangian import UNIFORM, Friction, Terms
from gfnn_jax.flows.motion import Form

Row = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...], float]
Loss = tuple[tuple[int, ...], int, float]
Key = tuple[Any, ...]


@dataclasses.dataclass(frozen=True)
class Structure:
    """Terms of L (the first is ½v₁²·2, whose coefficient the gauge gives), friction, the
    coordinates whose zero is unknown, the number of inputs, each with a gain for each coordinate,
    and the names of the sensors' parameters with where they start."""

    dim: int
    terms: tuple[Row, ...]
    friction: tuple[Loss, ...] = ()
    zeros: tuple[int, ...] = ()
    num_inputs: int = 0
    sensors: tuple[tuple[str, float], ...] = ()

    def keys(self) -> list[Key]:
        """A name of each free coefficient, in their order."""
        gains = [("gain", i, j) for i in range(self.dim) for j in range(self.num_inputs)]
        return [
            *(("term", row) for row in self.terms[1:]),
            *(("loss", row) for row in self.friction),
            *gains,
            *(("zero", i) for i in self.zeros),
            *(("sensor", name) for name, _ in self.sensors),
        ]

    def start(self, known: Mapping[Key, float]) -> np.ndarray:
        """The coefficients that are known, for sensors those they start from, 0 for the others."""
        known = {**{("sensor", name): value for name, value in self.sensors}, **known}
        return np.array([known.get(key, 0.0) for key in self.keys()])

    def form(self, q: np.ndarray) -> Form:
        """The law with free coefficients, in the gauge of the positions q (n, d)."""
        terms = Terms.of(self.terms, self.dim)
        own = terms.quadratic()[0][:, 0, 0] * terms.potentials(q, order=0).value.mean(axis=0)
        fixed = np.zeros(terms.count)
        fixed[0] = 1 / own[0]
        basis = np.eye(terms.count)[:, 1:]
        basis[0] = -own[1:] / own[0]
        return Form(terms, fixed, basis, Friction.of(self.friction, self.dim), self.num_inputs)

    def without(self, keys: set[Key]) -> Structure:
        return dataclasses.replace(
            self,
            terms=(self.terms[0], *(r for r in self.terms[1:] if ("term", r) not in keys)),
            friction=tuple(r for r in self.friction if ("loss", r) not in keys),
            zeros=tuple(i for i in self.zeros if ("zero", i) not in keys),
        )

    def plus(self, keys: list[Key]) -> Structure:
        """The structure with these terms, frictions and zeros; uniform friction stays last."""
        new = {kind: tuple(k[1] for k in keys if k[0] == kind) for kind in ("term", "loss", "zero")}
        return dataclasses.replace(
            self,
            terms=self.terms + tuple(r for r in new["term"] if r not in self.terms),
            friction=tuple(
                sorted(
                    dict.fromkeys((*self.friction, *new["loss"])), key=lambda row: row[1] == UNIFORM
                )
            ),
            zeros=tuple(sorted({*self.zeros, *new["zero"]})),
        )
