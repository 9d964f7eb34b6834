"""Inputs along the arcs of a recording, at the stages of the steps between nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Arcs, Nodes
from gfnn_jax.flows.schedules import interpolate, stage_times


class ArcInputs:
    """u (A, L − 1, substeps, 6, k) of arcs, interpolated once for all nodes; of arcs without
    inputs an array without columns. ``delay``: seconds by which an input acts later."""

    def __init__(self, nodes: Sequence[Nodes], substeps: int, hold: str, delay: float = 0.0):
        self.substeps, self._of_nodes = substeps, []
        for node in nodes:
            at = stage_times(node.t, substeps) - delay
            starts = np.broadcast_to(at[..., :1], at.shape)
            s = node.stretch
            self._of_nodes.append(interpolate(s.t, s.u, at, hold, starts))

    def __call__(self, arcs: Arcs) -> np.ndarray:
        steps = arcs.t.shape[1] - 1
        found = []
        for i, a, _ in arcs.home:
            index = np.minimum(np.arange(a, a + steps), len(self._of_nodes[i]) - 1)
            found.append(self._of_nodes[i][index])
        return np.stack(found)
