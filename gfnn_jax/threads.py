"""Threads of the linear algebra that NumPy and SciPy call."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache


def one_thread() -> AbstractContextManager:
    """Context in which BLAS and LAPACK use one thread.

    Factorisations by many small panels gain little from threads. Where other processes use the same
    cores, threads wait for each other: 34 s instead of 2 s for 500 terms, measured.
    """
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller():
    import scipy.linalg  # noqa: F401, its library must be loaded to be found
    from threadpoolctl import ThreadpoolController  # loaded when first used

    return ThreadpoolController()
