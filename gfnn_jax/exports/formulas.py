"""Families that run on symbols: features, which are functions of JAX, are read as formulas."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.inputs import Inputs
from gfnn_jax.families.jets import jets
from gfnn_jax.families.products import Products
from gfnn_jax.families.traced import traced
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.systems import OfSystems
from gfnn_jax.flows.uniform import CaldirolaKanai, Uniform

_NARROWEST = 1e-150  # width of dry friction that no speed is below, and whose square is a number


class Formulas(Inputs):
    """Inputs whose features are formulas, for symbols, which JAX cannot take."""

    def feature_tables(self, w, order: int) -> tuple:
        """Features (1, k) and derivatives up to ``order`` at w (1, 2d), an array of symbols."""
        width = w.shape[-1]
        assert self.features is not None
        found = jets(traced(self.features, width // 2), w, order)
        tables: list[np.ndarray] = [
            np.zeros((1, len(found), *[width] * n), dtype=object) for n in range(order + 1)
        ]
        for k, jet in enumerate(found):
            tables[0][:, k] = jet.value
            for i, slope in jet.slope.items():
                tables[1][:, k, i] = slope
            for (i, j), curvature in jet.curvature.items():
                tables[2][:, k, i, j] = tables[2][:, k, j, i] = curvature
        return tuple(tables)


class _Phase(float):
    """Number whose cosine NumPy finds in an object array, as it finds that of a symbol."""

    def __radd__(self, other):
        total = other + float(self)
        return _Phase(total) if isinstance(total, float) else total

    def cos(self) -> float:
        return math.cos(self)

    def sin(self) -> float:
        return math.sin(self)


def on_symbols(family: Any) -> Any:
    """Make the family run on symbols. Raises InputError for a feature that is no formula."""
    if isinstance(family, Legendre):
        phases = np.array([_Phase(phase) for phase in family.terms.phases], dtype=object)
        return Legendre(dataclasses.replace(family.terms, phases=phases))
    if isinstance(family, Forced):  # of no width, friction would ask whether a symbol is 0
        widths = np.maximum(family.friction.widths, _NARROWEST)
        friction = dataclasses.replace(family.friction, widths=widths)
        family = dataclasses.replace(family, friction=friction)
    if isinstance(family, (OfDisplacement, Forced, OfSystems, Uniform, CaldirolaKanai)):
        return dataclasses.replace(family, family=on_symbols(family.family))
    if not isinstance(family, Products) or family.inputs.features is None:
        return family
    inputs = family.inputs
    assert inputs.features is not None
    traced(inputs.features, inputs.width // 2)
    fields = {f.name: getattr(inputs, f.name) for f in dataclasses.fields(inputs)}
    return dataclasses.replace(family, inputs=Formulas(**fields))
