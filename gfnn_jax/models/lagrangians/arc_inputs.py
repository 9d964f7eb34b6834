"""Inputs along the arcs of a recording, at the stages of the steps between nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Arcs, Nodes
from gfnn_jax.flows.schedules import at_stages


class ArcInputs:
    """u (A, L − 1, substeps, 6, k) of arcs, interpolated once for all nodes; of arcs without
    inputs an array without columns. ``delay``: seconds by which an input acts later."""

    def __init__(self, nodes: Sequence[Nodes], substeps: int, hold: str, delay: float = 0.0):
        self.hold, self.delay, self.substeps = hold, delay, substeps
        self._nodes = nodes
        self._of_nodes = [
            at_stages(n.stretch.t, n.stretch.u, n.t[:-1], n.t[1:], substeps, hold, delay)
            for n in nodes
        ]

    def delayed(self, delay: float) -> ArcInputs:
        """Make those of another delay."""
        return ArcInputs(self._nodes, self.substeps, self.hold, delay)

    def by_rule(self, hold: str) -> ArcInputs:
        """Make those of another rule between samples."""
        return ArcInputs(self._nodes, self.substeps, hold)

    def of_steps(self, count: int) -> ArcInputs:
        """Make those of so many steps between two nodes."""
        return ArcInputs(self._nodes, count, self.hold, self.delay)

    def within_samples(self, fewest: int) -> int:
        """The least number of steps between two nodes, from ``fewest`` on, of which none goes on
        beyond a sample where inputs jump, as those do that are held."""
        apart = {int(np.median(np.diff(n.at))) for n in self._nodes}
        jump = self.hold == "hold" and self._nodes[0].stretch.u.shape[1] > 0
        count = fewest
        while jump and any(every % count and count % every for every in apart):
            count += 1
        return count

    def __call__(self, arcs: Arcs) -> np.ndarray:
        steps = arcs.t.shape[1] - 1
        found = []
        for i, a, _ in arcs.home:
            index = np.minimum(np.arange(a, a + steps), len(self._of_nodes[i]) - 1)
            found.append(self._of_nodes[i][index])
        return np.stack(found)
