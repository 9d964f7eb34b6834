"""How a solve, or a lane of a rollout, ended. Status is data: a bad lane raises nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

OK, LEFT_DOMAIN, STOPPED_AT_EDGE, NOT_CONVERGED, NON_FINITE = range(5)
STATUS_NAMES = (
    "ok",
    "left the domain",
    "stopped at the domain's edge",
    "not converged",
    "non-finite",
)


class Info(NamedTuple):
    """How a solve ended, per lane: status, Newton updates made, and the residual relative to
    the size of the terms that it is made of; each (B,)."""

    status: Any
    iterations: Any
    residual: Any
