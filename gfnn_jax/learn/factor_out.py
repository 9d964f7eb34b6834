"""The flow of a law, factored out of the pairs where that leaves the simplest map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.flows.flow import Flow
from gfnn_jax.learn.flows import around
from gfnn_jax.learn.prepare import Prepared
from gfnn_jax.learn.sweeps import trial_residual

TRIAL_PAIRS = 1_000  # by which it is found out where a flow is to be factored out


def factored_out(flows: Sequence[Flow], plain: Prepared, seed: int) -> tuple[Flow, Prepared]:
    """The pairs without one of these flows: before, after, or half on either side of what is
    learned, whichever leaves the map that a small S comes closest to."""

    def left_over(prepared: Prepared) -> float:
        rows = np.random.default_rng(seed).permutation(len(prepared.y0))[:TRIAL_PAIRS]
        return trial_residual(prepared.take(rows))

    tried = [(flow, plain.without(*pieces)) for flow in flows for pieces in around(flow)]
    errors = [left_over(prepared) for _, prepared in tried]
    return tried[0] if errors[0] <= 2 * min(errors) else tried[int(np.argmin(errors))]
