"""Threads of the linear algebra that NumPy and SciPy call."""

from contextlib import AbstractContextManager
from functools import cache


def one_thread() -> AbstractContextManager:
    """Context in which BLAS and LAPACK use one thread, for a whole fit, estimate or forecast.

    Their matrices are small, and factorised by many small panels: threads gain little. Where other
    processes use the same cores, threads wait for each other: a fit of 500 terms took 34 s instead
    of 2 s, `gfnn run two-body --quick` twice the seconds of the processor.
    """
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller():
    import scipy.linalg  # noqa: F401, its library must be loaded to be found
    from threadpoolctl import ThreadpoolController  # loaded when first used

    return ThreadpoolController()
