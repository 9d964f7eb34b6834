"""Status of a solve or of a lane of a rollout. Status is data: a failed lane raises nothing."""

from typing import Any, NamedTuple

OK, LEFT_DOMAIN, STOPPED_AT_EDGE, NOT_CONVERGED, NON_FINITE = range(5)
STATUS_NAMES = (
    *("ok", "left the domain", "stopped at the domain's edge"),
    *("not converged", "non-finite"),
)


class Info(NamedTuple):
    """Result of a solve, per lane (B,): status, number of updates, relative residual.

    The residual is relative to the size of its terms.
    """

    status: Any
    iterations: Any
    residual: Any
