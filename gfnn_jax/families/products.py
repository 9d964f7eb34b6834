"""Products of Chebyshev polynomials and Fourier harmonics, linear in the parameters.

    S(C, w) = Σ C_ab u_a(x_A) v_b(x_B)

x are the scaled variables of ``Inputs``, cut into two halves A and B. u and v are the products of
one-dimensional functions over a half, up to a total degree. C holds a coefficient for each allowed
term (total degree of the product, parity) and zero elsewhere. Values, gradients and second
derivatives come from recurrences and from two dense matrix products of about (√terms)² each for a
batch: many times faster than differentiating a thousand terms.
"""

import dataclasses
import math
from functools import cache, cached_property, reduce
from operator import mul
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.families.family import CalledAsValue
from gfnn_jax.families.inputs import Inputs


def chebyshev(x, degree: int):
    """Chebyshev polynomials T_0..T_degree (..., degree + 1) of x (...).

    They are computed by doubling, T_{k+j} = 2 T_k T_j − T_{k−j}.
    """
    xp = namespace(x)
    t = xp.stack([xp.ones_like(x), x], axis=-1)
    while (k := t.shape[-1] - 1) < degree:
        j = slice(1, min(k, degree - k) + 1)
        mirror = slice(k - 1, None if k - j.stop < 0 else k - j.stop, -1)
        t = xp.concatenate([t, 2 * t[..., k : k + 1] * t[..., j] - t[..., mirror]], axis=-1)
    return t[..., : degree + 1]


def fourier(x, degree: int):
    """Harmonics 1, cos x, .., cos Dx, sin x, .., sin Dx (..., 2D + 1) of x (...), D the degree.

    They are computed by doubling, e^{i(k+j)x} = e^{ikx} e^{ijx}.
    """
    xp = namespace(x)
    c = xp.stack([xp.ones_like(x), xp.cos(x)], axis=-1)
    s = xp.stack([xp.zeros_like(x), xp.sin(x)], axis=-1)
    while (k := c.shape[-1] - 1) < degree:
        top, j = slice(k, k + 1), slice(1, min(k, degree - k) + 1)
        more_c = c[..., top] * c[..., j] - s[..., top] * s[..., j]
        more_s = s[..., top] * c[..., j] + c[..., top] * s[..., j]
        c, s = xp.concatenate([c, more_c], axis=-1), xp.concatenate([s, more_s], axis=-1)
    return xp.concatenate([c[..., : degree + 1], s[..., 1 : degree + 1]], axis=-1)


@cache
def _differentiation(angle: bool, degree: int) -> np.ndarray:
    """Matrix D with f' = f D, f the row of `chebyshev` or `fourier` functions. It is exact."""
    if not angle:
        d = np.zeros((degree + 1, degree + 1))
        for k in range(1, degree + 1):
            derivative = np.polynomial.chebyshev.chebder(np.eye(degree + 1)[k])
            d[: len(derivative), k] = derivative
        return d
    d, k = np.zeros((2 * degree + 1, 2 * degree + 1)), np.arange(1, degree + 1)
    d[degree + k, k], d[k, degree + k] = -k, k
    return d


# JAX multiplies matrices so small, of so few rows, entry by entry: to call the matrix library takes
# longer (one lane of the standard map: 4.8 µs a step instead of 2.6; benchmarks/speed.py).
_FEW_ROWS, _FEW_ENTRIES = 8, 128


def _product(f, picks):
    """Matrix product f (..., K) @ picks (K, n)."""
    rows = math.prod(f.shape[:-1])  # no number where a batch of any size is exported
    few = isinstance(rows, int) and rows <= _FEW_ROWS and picks.size <= _FEW_ENTRIES
    if namespace(f) is np or not few:
        return matmul(f, picks)
    return sum(f[..., k : k + 1] * as_row(picks[k], f) for k in range(len(picks)))


@cache
def number_of_terms(is_angle: tuple[bool, ...], degree: int, signs=None, still: int = 0) -> int:
    """Number of terms of a `Basis` with these arguments, counted without making it."""
    counts = np.zeros((2, degree + 1), dtype=object)  # by parity and total degree
    counts[0, 0] = 1
    for angle, sign in zip(is_angle, signs or (1,) * len(is_angle), strict=True):
        after = np.zeros_like(counts)
        for k in range(degree + 1):
            # A cosine is even and a sine odd; a polynomial is as its degree.
            odd = [False, True][: 1 + (k > 0)] if angle else [k % 2 == 1]
            for flips in odd:
                moved = counts[::-1] if flips and sign < 0 else counts
                after[:, k:] += moved[:, : degree + 1 - k]
        counts = after
    # Products without a coordinate generate nothing.
    return int(counts[0].sum()) - math.comb(degree + still, still)


@dataclasses.dataclass(frozen=True)
class _Half:
    """Products of one-dimensional functions over one half of the variables."""

    is_angle: tuple[bool, ...]
    signs: tuple[int, ...]  # of each variable under the reversor
    degree: int
    only_even: bool  # True where the other half has even products only
    still: int = 0  # number of variables, the last ones, without derivatives

    @property
    def moving(self) -> int:
        """Number of variables that have derivatives, the first ones."""
        return len(self.is_angle) - self.still

    @cached_property
    def indices(self) -> np.ndarray:
        """Index of each variable's function in each product: (terms, variables)."""
        terms = [()]
        for angle in self.is_angle:
            count = 2 * self.degree + 1 if angle else self.degree + 1
            terms = [
                (*t, k)
                for t in terms
                for k in range(count)
                if self._harmonic(k) + self._order(t) <= self.degree
            ]
        terms = [t for t in terms if not self.only_even or self._parity(t) > 0]
        terms.sort(key=self._order)
        return np.array(terms, dtype=np.int32).reshape(len(terms), len(self.is_angle))

    def _harmonic(self, k: int) -> int:
        """Degree of the k-th one-dimensional function: the sines follow the cosines."""
        return k if k <= self.degree else k - self.degree

    def _order(self, term) -> int:
        return sum(self._harmonic(k) for k in term)

    @cached_property
    def orders(self) -> np.ndarray:
        """Total degree of each product (terms,)."""
        return np.array([self._order(t) for t in self.indices.tolist()], dtype=int)

    @cached_property
    def depends(self) -> np.ndarray:
        """Flag (terms,), True where the product depends on a variable that has derivatives."""
        return np.asarray((self.indices[:, : self.moving] > 0).any(axis=1))

    def _parity(self, term) -> int:
        """Sign under the reversor: sines and odd degrees of the variables that flip change it."""
        odd = [
            k > self.degree if angle else k % 2
            for k, angle in zip(term, self.is_angle, strict=True)
        ]
        return math.prod(sign if flips else 1 for sign, flips in zip(self.signs, odd, strict=True))

    @cached_property
    def parities(self) -> np.ndarray:
        """Sign of each product under the reversor (terms,)."""
        return np.array([self._parity(t) for t in self.indices.tolist()], dtype=int)

    @cache  # noqa: B019, there are as many halves as kinds of bases
    def picks(self, variable: int, order: int) -> np.ndarray:
        """Matrix (K, (1 + order) terms) from a variable's functions to its factors in all products.

        After the factors stand their derivatives up to ``order``. It multiplies the functions
        (..., K) from the right.
        """
        derivative = _differentiation(self.is_angle[variable], self.degree)
        powers = [np.linalg.matrix_power(derivative, r) for r in range(order + 1)]
        return np.concatenate([d[:, self.indices[:, variable]] for d in powers], axis=1)

    def tables(self, functions: list, order: int, like) -> list:
        """Products u (..., terms), gradients (..., n, terms), and Hessians (..., n, n, terms).

        The gradients need ``order`` ≥ 1, the Hessians ``order`` 2. functions: those (..., K) of
        each variable; the first n have derivatives.
        """
        xp, n, terms = namespace(like), self.moving, len(self.indices)
        factors: list[Any] = []  # of each variable: its factor of every product, and derivatives
        for j, f in enumerate(functions):
            most = order if j < n else 0
            side_by_side: Any = _product(f, xp.asarray(self.picks(j, most), dtype=f.dtype))
            factors.append(
                [side_by_side[..., r * terms : (r + 1) * terms] for r in range(most + 1)]
            )

        def product(*raised) -> Any:
            """Multiply the factors, each differentiated once per occurrence in ``raised``."""
            return reduce(mul, (f[raised.count(j)] for j, f in enumerate(factors)))

        if n == 0:  # no variable of this half has derivatives
            one = product() if factors else xp.ones_like(like[..., :1])
            tables = [one, one[..., None, :][..., :0, :], one[..., None, None, :][..., :0, :0, :]]
            return tables[: order + 1]
        tables = [product()]
        if order > 0:
            tables.append(xp.stack([product(j) for j in range(n)], axis=-2))
        if order > 1:
            upper = {(i, j): product(i, j) for i in range(n) for j in range(i, n)}
            rows = [
                xp.stack([upper[min(i, j), max(i, j)] for j in range(n)], axis=-2) for i in range(n)
            ]
            tables.append(xp.stack(rows, axis=-3))
        return tables


@dataclasses.dataclass(frozen=True)
class Basis:
    """Set of the products that exist: the static part of a family, made once for each kind.

    signs: of the variables under a reversor; only even products exist then. still: number of
    variables, the last ones, that have no derivatives; products of them alone do not exist.
    """

    is_angle: tuple[bool, ...]
    degree: int
    signs: tuple[int, ...] | None
    still: int = 0

    @property
    def cut(self) -> int:
        """Index of the first variable of the second half."""
        return (len(self.is_angle) + 1) // 2

    @cached_property
    def halves(self) -> tuple[_Half, _Half]:
        cut, signs = self.cut, self.signs or (1,) * len(self.is_angle)
        even = [
            self.signs is not None and min(part, default=1) > 0
            for part in (signs[:cut], signs[cut:])
        ]
        in_second = min(self.still, len(self.is_angle) - cut)
        return (
            _Half(self.is_angle[:cut], signs[:cut], self.degree, even[1], self.still - in_second),
            _Half(self.is_angle[cut:], signs[cut:], self.degree, even[0], in_second),
        )

    @cached_property
    def corner(self) -> tuple[int, int]:
        """Numbers (m, n) such that C[m:, n:] is zero.

        A high degree of one half leaves a low one for the other. Products with several matrices C
        are faster without this corner.
        """
        a, b = self.halves
        low = self.degree // 2
        return int(np.sum(a.orders <= low)), int(np.sum(b.orders < self.degree - low))

    @cached_property
    def terms(self) -> np.ndarray:
        """Rows (a, b) of the coefficients that exist, by rising degree: (num_parameters, 2)."""
        return self._sorted_terms[0]

    @cached_property
    def term_orders(self) -> np.ndarray:
        """Total degree of each term (num_parameters,), rising."""
        return self._sorted_terms[1]

    @cached_property
    def _sorted_terms(self) -> tuple[np.ndarray, np.ndarray]:
        a, b = self.halves
        order = a.orders[:, None] + b.orders[None, :]
        # A constant generates nothing, nor does what no coordinate changes.
        exists = (order <= self.degree) & (a.depends[:, None] | b.depends[None, :])
        if self.signs is not None:
            exists &= a.parities[:, None] * b.parities[None, :] > 0
        rising = np.argsort(order[exists], kind="stable")
        return np.argwhere(exists)[rising], order[exists][rising]

    def tables(self, x, order: int) -> tuple[list, list]:
        """Tables of both halves at the variables x (..., k), with derivatives up to ``order``."""
        angle, functions = np.array(self.is_angle, dtype=bool), [None] * len(self.is_angle)
        for of, family in ((np.flatnonzero(~angle), chebyshev), (np.flatnonzero(angle), fourier)):
            if of.size:
                chosen = x if of.size == angle.size else x[..., of]
                together = family(chosen, self.degree)
                for place, j in enumerate(of):
                    functions[j] = together[..., place, :]
        a, b = self.halves
        return (
            a.tables(functions[: self.cut], order, x),
            b.tables(functions[self.cut :], order, x),
        )

    def placed(self, coefficients) -> np.ndarray:
        """Place coefficients (..., terms) into matrices C (..., m, n), NumPy."""
        a, b = self.halves
        c = np.zeros((*coefficients.shape[:-1], len(a.indices), len(b.indices)), coefficients.dtype)
        c[..., self.terms[:, 0], self.terms[:, 1]] = coefficients
        return c


basis_of = cache(Basis)


@pytree("degree", "signs")
class Products(CalledAsValue):
    """Family of Chebyshev × Fourier products of total degree at most ``degree``.

    The variables are those of the inputs, and include the args where S depends on some.
    signs: of the variables under a reversor; then only even terms exist (midpoint chart).
    """

    inputs: Inputs
    degree: int
    signs: tuple[int, ...] | None = None

    @property
    def name(self) -> str:
        if self.inputs.features is not None:
            return "features"
        return "fourier-chebyshev" if self.inputs.angles else "polynomial"

    @property
    def label(self) -> str:
        """Name and size, as the table of candidates shows them."""
        return f"{self.name} {self.degree}"

    @property
    def basis(self) -> Basis:
        still = self.inputs.num_args
        signs = None if self.signs is None else self.signs + (1,) * still
        return basis_of(self.inputs.is_angle, self.degree, signs, still)

    @property
    def num_parameters(self) -> int:
        return self.terms_of(self.degree)

    def terms_of(self, degree: int) -> int:
        """Number of parameters of the same family of another degree."""
        basis = self.basis
        return number_of_terms(basis.is_angle, degree, basis.signs, basis.still)

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian: products with C, tables."""
        (m, i), (n, j) = (h.indices.shape for h in self.basis.halves)
        tables = sum(t * k * (k - 1) + 10 * self.degree * k for t, k in ((m, i), (n, j)))
        gradient = 4 * m * n + 2 * (m * i + n * j) + tables
        mixed = 2 * i * m * n + 2 * i * j * n
        return gradient, gradient + mixed + 2 * (m * i * i + n * j * j)

    def unflatten(self, coefficients):
        """Make the matrix C (m, n), the parameters of S, of coefficients (num_parameters,)."""
        return self.basis.placed(np.asarray(coefficients))

    def value(self, params, w, args=None):
        """Value S(C, w), shape (...): params the matrix C, w (..., 2d)."""
        (u,), (v,) = self.basis.tables(self.inputs(w, args), 0)
        return namespace(w).sum(matmul(u, params) * v, axis=-1)

    def gradient(self, params, w, args=None):
        """Gradient ∇S(C, w), shape (..., 2d)."""
        x, slope, _ = self.inputs.tables(w, 1, args)
        tables = self.basis.tables(x, 1)
        return self.inputs.pull_back_gradient(_gradient(tables, params)[0], slope)

    def gradient_and_hessian(self, params, w, args=None):
        """Gradient ∇S (..., 2d) and Hessian S'' (..., 2d, 2d)."""
        xp = namespace(w)
        x, slope, curvature = self.inputs.tables(w, 2, args)
        tables = self.basis.tables(x, 2)
        gradient, to_a, to_b = _gradient(tables, params)
        (_, du, ddu), (_, dv, ddv) = tables
        aa = xp.sum(ddu * to_a[..., None, None, :], axis=-1)
        bb = xp.sum(ddv * to_b[..., None, None, :], axis=-1)
        ab = xp.sum(matmul(du, params)[..., :, None, :] * dv[..., None, :, :], axis=-1)
        upper = xp.concatenate([aa, ab], axis=-1)
        lower = xp.concatenate([xp.swapaxes(ab, -1, -2), bb], axis=-1)
        hessian = xp.concatenate([upper, lower], axis=-2)
        return (
            self.inputs.pull_back_gradient(gradient, slope),
            self.inputs.pull_back_hessian(hessian, gradient, slope, curvature),
        )

    def term_gradients(self, w, args=None):
        """Gradients of all terms at w (..., 2d): (..., 2d, num_parameters)."""
        xp = namespace(w)
        x, slope, _ = self.inputs.tables(w, 1, args)
        (u, du), (v, dv) = self.basis.tables(x, 1)
        row, column = self.basis.terms.T
        by_variable = xp.concatenate(
            [du[..., row] * v[..., None, column], u[..., None, row] * dv[..., column]], axis=-2
        )
        return self.inputs.pull_back_terms(by_variable, slope)


def _gradient(tables, params):
    """Gradient of S in the variables (..., k), and the products C v (..., m) and uᵀC (..., n)."""
    (u, du, *_), (v, dv, *_) = tables
    xp = namespace(u)
    to_a, to_b = matmul(v, params.T), matmul(u, params)
    in_a = xp.sum(du * to_a[..., None, :], axis=-1)
    in_b = xp.sum(dv * to_b[..., None, :], axis=-1)
    return xp.concatenate([in_a, in_b], axis=-1), to_a, to_b
