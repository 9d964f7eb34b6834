"""Linear least squares, min ‖A c − b‖, by the triangle R of the QR factorisation [A b] = Q R.

Q is orthogonal, so that for n terms and any number of rows of [A b]

    R = [ T  t ]        ‖A c − b‖² = ‖T c − t‖² + ρ²        for every c,
        [ 0  ρ ]

and (n + 1)² numbers hold all that the rows say: the solution c = T⁻¹t, the residual sum of squares
ρ², and (TᵀT)⁻¹, the covariance of c for noise of variance one (Golub & Van Loan, Matrix
Computations, ch. 5). The normal equations would square the condition number.

- Rows are *folded* into R block by block; no more than one block is ever in memory.
- Two triangles are *merged* by the QR of one on top of the other (TSQR: Demmel, Grigori, Hoemmen &
  Langou, SIAM J. Sci. Comput. 34, 2012).
- *Leading* columns of R are the triangle of the problem whose terms come first, for every number of
  terms. Other columns can be *pruned*: what is left is no triangle, but its RᵀR is that of the
  rows, and the singular values ask for no more.
- Unknowns that only a few rows have are *eliminated* by the QR of these rows.
"""

from __future__ import annotations

import ctypes
import dataclasses
from collections.abc import Iterable
from functools import cache, cached_property

import numpy as np

_PANEL = 32  # columns per panel of LAPACK's QR: a third faster than 64
_EPS, _TINY = float(np.finfo(np.float64).eps), float(np.finfo(np.float64).tiny)


@dataclasses.dataclass(frozen=True, eq=False)
class Triangle:
    """R (n + 1, n + 1) of [A b], float64, and the number of ``rows`` for which it stands."""

    factor: np.ndarray
    rows: int

    @classmethod
    def empty(cls, terms: int) -> Triangle:
        """The triangle of no rows of so many terms."""
        return cls(np.zeros((terms + 1, terms + 1), order="F"), 0)

    @classmethod
    def of(cls, rows: np.ndarray) -> Triangle:
        """The triangle of rows of [A b] (N, n + 1), by one QR of all of them."""
        factor = np.asarray(np.linalg.qr(rows, mode="r"))
        missing = np.zeros((rows.shape[1] - len(factor), rows.shape[1]))
        return cls(np.concatenate([factor, missing]) if len(missing) else factor, len(rows))

    @classmethod
    def of_blocks(cls, blocks: Iterable[np.ndarray], terms: int) -> Triangle:
        """The triangle of blocks of rows of [A b] (N, n + 1), one after another, in place: they are
        float64 in Fortran's order, and are overwritten."""
        factor, rows = np.zeros((terms + 1, terms + 1), order="F"), 0
        for block in blocks:
            folded(factor, block)
            rows += len(block)
        return cls(factor, rows)

    @property
    def finite(self) -> bool:
        """True where every row was finite."""
        return bool(np.isfinite(self.factor).all())

    # Rows.

    def stacked(self, rows: np.ndarray) -> Triangle:
        """The triangle of these rows of [A b] (N, n + 1) too, by NumPy's QR of R on top of them."""
        stack = np.concatenate([self.factor[: self.rows], rows])
        return dataclasses.replace(Triangle.of(stack), rows=self.rows + len(rows))

    def merge(self, other: Triangle) -> Triangle:
        """The triangle of the rows of both: ⅔ n³ operations."""
        factors = (np.array(one.factor, order="F") for one in (self, other))
        factor = folded(*factors, triangular=True)
        return Triangle(factor, self.rows + other.rows)

    def spoilt(self) -> Triangle:
        """Add a row that no coefficients explain: ρ is infinite."""
        factor = self.factor.copy()
        factor[-1, -1] = np.inf
        return Triangle(factor, self.rows)

    # Columns.

    def leading(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """(T, t) of the leading terms: (size, size) and (size,)."""
        return self.factor[:size, :size], self.factor[:size, -1]

    def pruned(self, kept: np.ndarray) -> Triangle:
        """The problem of the terms at these places alone."""
        columns = self.factor[:, kept], self.factor[:, -1:].copy()
        return Triangle(np.concatenate(columns, axis=1), self.rows)

    def rebased(self, coefficients: np.ndarray) -> Triangle:
        """The problem for c where this one is that for the step c − coefficients: its b is A times
        the coefficients, less b."""
        a = self.factor[:, :-1]
        target = a @ coefficients - self.factor[:, -1]
        return Triangle(np.concatenate([a, target[:, None]], axis=1), self.rows)

    # What the rows say of b.

    @property
    def norm(self) -> float:
        """‖b‖; infinite where a row was not finite."""
        size = float(np.linalg.norm(self.factor[:, -1]))
        return size if np.isfinite(size) else np.inf

    def residual_norm(self, size: int) -> float:
        """ρ = min ‖A c − b‖ over the leading terms."""
        return float(np.linalg.norm(self.factor[size:, -1]))

    def missed(self, coefficients: np.ndarray) -> np.ndarray:
        """‖A c − b‖ of the leading terms, for c (size,), or for each column of (size, k)."""
        size = len(coefficients)
        t, target = self.leading(size)
        off = t @ coefficients - (target if coefficients.ndim == 1 else target[:, None])
        off = np.linalg.norm(off, axis=None if coefficients.ndim == 1 else 0)
        return np.asarray(np.hypot(off, self.residual_norm(size)))

    def image_norm(self, coefficients: np.ndarray) -> float:
        """‖A c‖ of the leading terms."""
        return float(np.linalg.norm(self.leading(len(coefficients))[0] @ coefficients))

    # What the rows say of c.

    def spectrum(self, size: int | None = None) -> Spectrum:
        """The singular values of the leading terms; None: of all columns, of a pruned problem too.

        Raises numpy.linalg.LinAlgError where an entry of A is not finite.
        """
        cutoff = _EPS * len(self.factor)
        if size is None:
            return Spectrum.of(self.factor[:, :-1], self.factor[:, -1], 0.0, cutoff)
        return Spectrum.of(*self.leading(size), self.residual_norm(size), cutoff)


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """T = U diag(s) Vᵀ D of a triangle, D the lengths of its columns, so that units do not matter.

    Every solution is c = D⁻¹ V f Uᵀt, with f (n,) the *filters* of the singular values: their
    reciprocals, or s / (s² + (λ s₀)²) of the ridge λ, which minimise ‖A c − b‖² + (λ s₀)² ‖D c‖².
    column: D (n,). vt: Vᵀ (n, n). b: t (n,). rest: ρ. cutoff: up to which s is rounding.
    """

    column: np.ndarray
    u: np.ndarray
    s: np.ndarray
    vt: np.ndarray
    b: np.ndarray
    rest: float
    cutoff: float

    @classmethod
    def of(cls, a: np.ndarray, b: np.ndarray, rest: float, cutoff: float) -> Spectrum:
        """T, t and ρ. cutoff: relative to the largest singular value."""
        column = np.linalg.norm(a, axis=0)
        column = np.where(column > 0, column, 1.0)
        u, s, vt = np.linalg.svd(a / column, full_matrices=False)
        return cls(column, u, s, vt, b, rest, float(cutoff * s[0]))

    @cached_property
    def known(self) -> np.ndarray:
        """(n,) directions of c that the rows tell."""
        return self.s > self.cutoff

    @cached_property
    def along(self) -> np.ndarray:
        """Uᵀt (n,)."""
        return self.u.T @ self.b

    @property
    def rank(self) -> int:
        """The number of directions that the rows tell."""
        return int(self.known.sum())

    @property
    def condition(self) -> float:
        """The condition number of the scaled columns."""
        return float(self.s[0] / self.s[-1]) if self.s[-1] > 0 else float("inf")

    @property
    def residual_norm(self) -> float:
        """‖A c − b‖ of the plain solution, to half of the digits of ‖b‖."""
        explained = np.sum(self.along[self.known] ** 2)
        return float(np.sqrt(max(np.sum(self.b**2) - explained, 0.0) + self.rest**2))

    @cached_property
    def inverse(self) -> np.ndarray:
        """(n,) filters of the plain solution: 1 / s, 0 of what the rows do not tell."""
        return np.where(self.known, 1.0 / np.where(self.known, self.s, 1.0), 0.0)

    def ridged(self, ridge: float) -> np.ndarray:
        """(n,) filters of a ridge > 0, relative to the largest singular value."""
        square = self.s**2 + (ridge * self.s[0]) ** 2
        return np.divide(self.s, square, out=np.zeros_like(self.s), where=square > 0)

    def solution(self, filters: np.ndarray) -> np.ndarray:
        """c (n,) of filters (n,); (n, k) of (k, n)."""
        found = self.vt.T @ (filters * self.along).T
        return found / (self.column if found.ndim == 1 else self.column[:, None])

    def deviations(self, filters: np.ndarray | None = None) -> np.ndarray:
        """(n,) standard deviations of the solution where noise in b has deviation one. None: of
        the plain one, in which what the rows do not tell is known as badly as what they just do."""
        if filters is None:
            filters = 1.0 / np.maximum(self.s, max(self.cutoff, _TINY))
        return np.linalg.norm(self.vt.T * filters, axis=1) / self.column

    def root(self, ridge: float = 0.0) -> np.ndarray:
        """W (n, n): W Wᵀ = (AᵀA + (ridge s₀)² D²)⁻¹, the coefficients' covariance for noise of
        deviation one; 0 along directions that the rows do not tell."""
        return self.vt.T / self.column[:, None] * np.sqrt(self._inverse_square(ridge))

    @property
    def told(self) -> np.ndarray:
        """G (n, n): the plain solution is Gᵀ Uᵀt, and Gᵀ G its covariance as of ``root``."""
        return self.inverse[:, None] * self.vt / self.column

    def degrees_of_freedom(self, ridge: float = 0.0) -> float:
        """Effective degrees of freedom of the solution: Σ s² / (s² + (ridge s₀)²)."""
        return float(np.sum(self._inverse_square(ridge) * self.s**2))

    def _inverse_square(self, ridge: float) -> np.ndarray:
        square = np.where(self.known, self.s, 1.0) ** 2 + (ridge * self.s[0]) ** 2
        return np.where(self.known, 1.0 / square, 0.0)


def folded(factor: np.ndarray, rows: np.ndarray, *, triangular: bool = False) -> np.ndarray:
    """R of the stacked [factor; rows], (n, n) and (m, n), by LAPACK's ``dtpqrt`` in place: both are
    overwritten. 2 m n² operations; a third of that where the rows are ``triangular`` too.

    SciPy's own wrapper keeps Python's interpreter lock while it works, so that threads would wait
    for each other; the same routine through SciPy's C interface does not, and gives the same bits.

    Raises ValueError where the arrays are not float64 in Fortran's order, or their shapes do not
    fit: LAPACK is given addresses.
    """
    m, n = rows.shape
    if factor.shape != (n, n) or (triangular and m != n):
        raise ValueError(f"expected a factor of ({n}, {n}): got {factor.shape}, rows {rows.shape}")
    for name, array in (("the factor", factor), ("rows", rows)):
        if array.dtype != np.float64 or not (array.flags.f_contiguous and array.flags.writeable):
            raise ValueError(f"expected {name} as writeable float64 in Fortran's order")
    panel = min(_PANEL, n)
    numbers = np.array([m, n, n if triangular else 0, panel, n, max(m, 1), panel, 0], np.intc)
    rows_, columns, zeros, panel_, of_factor, of_rows, of_table, status = (
        numbers.ctypes.data + i * numbers.itemsize for i in range(len(numbers))
    )
    table, work = np.empty((panel, n), order="F"), np.empty(panel * n)
    a, b, t, w = (array.ctypes.data for array in (factor, rows, table, work))
    _tpqrt()(rows_, columns, zeros, panel_, a, of_factor, b, of_rows, t, of_table, w, status)
    if numbers[-1]:
        raise ValueError(f"LAPACK's dtpqrt refuses its argument {-numbers[-1]}")
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
