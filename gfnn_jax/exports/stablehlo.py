"""Export of a map as StableHLO, by ``jax.export``: step and inverse of a batch.

The file is a zip archive and needs nothing of this package. ``jax.export.deserialize`` reads
``step.jax`` and ``inverse.jax``: functions of states (B, 2d), for any B, and of the parameters'
values (B, k) where the map has some, which return images (B, 2d) and statuses (B,). ``about.json``
describes the map.
"""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import jax
import numpy as np
from jax import export

from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import require_x64

PLATFORMS = ("cpu", "cuda")


def stablehlo(map_: SymplecticMap, about: dict[str, Any]) -> bytes:
    """Make the zip archive. about: JSON-able, the description of the map."""
    dtype = np.dtype(map_.scale.dtype)
    if dtype == np.float64:
        require_x64("a float64 map")
    (batch,) = export.symbolic_shape("b")
    shapes = [(batch, 2 * map_.dim)]
    if map_.parameters is not None:
        shapes.append((batch, len(map_.parameters.names)))
    given = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, function in (("step", map_.step), ("inverse", map_.inverse)):

            def applied(z, *args, function=function):
                image, info = function(z, *args)
                return image, info.status

            exported = export.export(jax.jit(applied), platforms=PLATFORMS)(*given)
            archive.writestr(f"{name}.jax", bytes(exported.serialize()))
        archive.writestr("about.json", json.dumps(about, indent=1))
    return packed.getvalue()
