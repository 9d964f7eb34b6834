"""States from positions: what a map that was learned from positions alone makes of two of them."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.generating.charts import TYPE1


def starts_from_positions(map_: Any) -> bool:
    """Return whether a map was learned from positions alone: its S is one of q and Q."""
    piece = map_.pieces[0]
    ours = isinstance(getattr(piece, "family", None), OfDisplacement)
    return ours and len(map_.pieces) == 1 and piece.chart == TYPE1


def state_at(map_: Any, q, other):
    """State at q, as `SymplecticMap.from_positions` gives it."""
    if not starts_from_positions(map_):
        raise ValueError(
            "expected a map that was learned from positions alone, whose S is one of (q, Q)"
        )
    dtype = np.dtype(map_.scale.dtype)
    q, other = np.asarray(q, dtype), np.asarray(other, dtype)
    if q.shape != other.shape or q.ndim not in (1, 2) or q.shape[-1] != map_.dim:
        raise ValueError(
            f"expected two positions of shape ({map_.dim},) or (B, {map_.dim}), got {q.shape} and "
            f"{other.shape}"
        )
    own = jax.tree.map(np.asarray, map_.pieces[0])
    w = np.concatenate([q, own.family.lifted(q, other)], axis=-1)
    p = -own.dt * own.family.gradient(own.params, w)[..., : map_.dim]
    return jax.device_put(np.concatenate([q, p], axis=-1))
