"""One step of a QR in parts: rows are folded into a triangular factor, in place, by LAPACK.

SciPy's own wrapper of ``dtpqrt`` keeps Python's interpreter lock while it works, so that threads
would wait for each other; the same routine through SciPy's C interface (``cython_lapack``) does
not, and gives the same bits.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

_PANEL = 32  # columns per panel of LAPACK's QR: a third faster than 64


def folded(factor: np.ndarray, rows: np.ndarray, *, triangular: bool = False) -> np.ndarray:
    """R of the stacked [factor; rows], (n, n) and (m, n), float64 in Fortran's order; both are
    overwritten. Costs 2 m n² operations; a third of that where the rows are ``triangular`` too.

    Raises ValueError for arrays of another shape, kind or order.
    """
    m, n = rows.shape
    # LAPACK is told addresses: what it would read or write beside them must never get there.
    for name, array, shape in (("factor", factor, (n, n)), ("rows", rows, (m, n))):
        if array.shape != shape or array.dtype != np.float64 or not array.flags.f_contiguous:
            raise ValueError(
                f"expected the {name} as float64 of shape {shape} in Fortran's order, got "
                f"{array.dtype} of shape {array.shape}"
                + ("" if array.flags.f_contiguous else ", not contiguous")
            )
    panel = min(_PANEL, n)
    numbers = np.array([m, n, n if triangular else 0, panel, n, max(m, 1), panel, 0], np.intc)
    rows_, columns, zeros, panel_, of_factor, of_rows, of_table, status = (
        numbers.ctypes.data + i * numbers.itemsize for i in range(len(numbers))
    )
    table, work = np.empty((panel, n), order="F"), np.empty(panel * n)
    _tpqrt()(
        rows_, columns, zeros, panel_, factor.ctypes.data, of_factor, rows.ctypes.data, of_rows,
        table.ctypes.data, of_table, work.ctypes.data, status,
    )  # fmt: skip
    if numbers[-1]:
        raise ValueError(f"expected arguments that LAPACK's dtpqrt takes, got info = {numbers[-1]}")
    return factor


@cache
def _tpqrt():
    """LAPACK's dtpqrt(m, n, l, nb, a, lda, b, ldb, t, ldt, work, info), by addresses."""
    from scipy.linalg import cython_lapack  # pyright: ignore[reportAttributeAccessIssue]

    capsule = cython_lapack.__pyx_capi__["dtpqrt"]
    name, pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    address = pointer(capsule, name(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 12)(address)
