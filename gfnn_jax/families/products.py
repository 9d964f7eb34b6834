"""S linear in its parameters: products of Chebyshev polynomials and Fourier harmonics.

    S(C, w) = Σ C_ab u_a(x_A) v_b(x_B)

x are the scaled variables of ``Inputs``, cut into two halves A and B; u and v are the products of
one-dimensional functions over a half, up to a total degree, and C holds a coefficient for each
allowed term (total degree of the product, parity) and zero elsewhere. Values, gradients and second
derivatives come from recurrences and from matrix products with C, which a batch turns into two
dense products of about (√terms)² each: many times faster than differentiating a thousand features.

Because S is linear in C, the derivative rules below are complete: ``jax.grad``, ``jvp`` and
``hessian`` of ``S`` use the recurrences, also with respect to C.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.families.inputs import Inputs

# A GPU would multiply float32 in TF32: 7e-4 of relative error in ∇S.
_dot = partial(jnp.matmul, precision="highest")


def chebyshev(x, degree: int):
    """T_0..T_degree of each x (n,), their first and second derivatives: each (degree + 1, n).

    By doubling, T_{k+j} = 2 T_k T_j − T_{k−j} for j = 1..k, differentiated twice: a handful of
    vector operations whatever the degree.
    """
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    t, d, dd = jnp.stack([one, x]), jnp.stack([zero, one]), jnp.stack([zero, zero])
    while (k := t.shape[0] - 1) < degree:
        j = slice(1, min(k, degree - k) + 1)
        mirror = slice(k - 1, None if k - j.stop < 0 else k - j.stop, -1)
        more_dd = 2 * (dd[k:] * t[j] + 2 * d[k:] * d[j] + t[k:] * dd[j]) - dd[mirror]
        more_d = 2 * (d[k:] * t[j] + t[k:] * d[j]) - d[mirror]
        more_t = 2 * t[k:] * t[j] - t[mirror]
        t, d, dd = (jnp.concatenate(f) for f in ((t, more_t), (d, more_d), (dd, more_dd)))
    return t[: degree + 1], d[: degree + 1], dd[: degree + 1]


def fourier(x, degree: int):
    """1, cos x, .., cos Dx, sin x, .., sin Dx of each x (n,), two derivatives: each (2D + 1, n).

    By doubling, e^{i(k+j)x} = e^{ikx} e^{ijx}.
    """
    c, s = jnp.stack([jnp.ones_like(x), jnp.cos(x)]), jnp.stack([jnp.zeros_like(x), jnp.sin(x)])
    while (k := c.shape[0] - 1) < degree:
        j = slice(1, min(k, degree - k) + 1)
        more_c, more_s = c[k:] * c[j] - s[k:] * s[j], s[k:] * c[j] + c[k:] * s[j]
        c, s = jnp.concatenate([c, more_c]), jnp.concatenate([s, more_s])
    c, s = c[: degree + 1], s[: degree + 1]
    n = jnp.arange(degree + 1, dtype=x.dtype)[:, None]
    return (
        jnp.concatenate([c, s[1:]]),
        jnp.concatenate([-n * s, (n * c)[1:]]),
        jnp.concatenate([-n * n * c, -(n * n * s)[1:]]),
    )


@dataclasses.dataclass(frozen=True)
class _Half:
    """The products of one-dimensional functions over one half of the variables."""

    is_angle: tuple[bool, ...]
    signs: tuple[int, ...]  # of each variable under the reversor
    degree: int
    only_even: bool  # whether the other half has only even products to go with

    @cached_property
    def indices(self) -> np.ndarray:
        """Which function of each variable makes each product: (terms, variables)."""
        terms = [()]
        for angle in self.is_angle:
            count = 2 * self.degree + 1 if angle else self.degree + 1
            terms = [
                (*t, k) for t in terms for k in range(count)
                if self._harmonic(k) + self._order(t) <= self.degree
            ]  # fmt: skip
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

    def _parity(self, term) -> int:
        """Sign under the reversor: that of sines and odd degrees of the variables that flip."""
        odd = [
            k > self.degree if angle else k % 2
            for k, angle in zip(term, self.is_angle, strict=True)
        ]
        return math.prod(sign if flips else 1 for sign, flips in zip(self.signs, odd, strict=True))

    @cached_property
    def parities(self) -> np.ndarray:
        """Sign of each product under the reversor (terms,)."""
        return np.array([self._parity(t) for t in self.indices.tolist()], dtype=int)

    def tables(self, x):
        """Products u (terms,), their gradients (k, terms) and Hessians (k, k, terms)."""
        angle = np.array(self.is_angle, dtype=bool)
        plain, circle = np.flatnonzero(~angle), np.flatnonzero(angle)
        polynomials = chebyshev(x[plain], self.degree) if plain.size else None
        harmonics = fourier(x[circle], self.degree) if circle.size else None
        picked = []
        for j, k in enumerate(self.indices.T):
            functions, among = (harmonics, circle) if angle[j] else (polynomials, plain)
            column = int(np.flatnonzero(among == j)[0])
            picked.append([f[k, column] for f in functions])  # pyright: ignore[reportOptionalIterable]
        n, terms = len(picked), len(self.indices)
        unit = jnp.ones(terms, x.dtype)

        def product(orders):
            factors = [picked[j][k] for j, k in enumerate(orders)]
            out = factors[0] if factors else unit
            for f in factors[1:]:
                out = out * f
            return out

        def raised(*which):
            orders = [0] * n
            for j in which:
                orders[j] += 1
            return product(orders)

        value = product([0] * n)
        gradient = [raised(j) for j in range(n)]
        upper = {(i, j): raised(i, j) for i in range(n) for j in range(i, n)}
        hessian = [[upper[min(i, j), max(i, j)] for j in range(n)] for i in range(n)]
        shape = (n, terms)
        if n == 0:  # a single variable leaves the other half empty
            return value, jnp.zeros(shape, x.dtype), jnp.zeros((n, *shape), x.dtype)
        return value, jnp.stack(gradient), jnp.stack([jnp.stack(row) for row in hessian])


@dataclasses.dataclass(frozen=True)
class Basis:
    """Which products exist: all that is static about a family, made once for each kind."""

    is_angle: tuple[bool, ...]
    degree: int
    signs: tuple[int, ...] | None

    @property
    def cut(self) -> int:
        """The first variable of the second half."""
        return (len(self.is_angle) + 1) // 2

    @cached_property
    def halves(self) -> tuple[_Half, _Half]:
        cut, signs = self.cut, self.signs or (1,) * len(self.is_angle)
        even = [
            self.signs is not None and min(part, default=1) > 0
            for part in (signs[:cut], signs[cut:])
        ]
        return (
            _Half(self.is_angle[:cut], signs[:cut], self.degree, only_even=even[1]),
            _Half(self.is_angle[cut:], signs[cut:], self.degree, only_even=even[0]),
        )

    @cached_property
    def corner(self) -> tuple[int, int]:
        """Below so many rows and to the right of so many columns at once C is zero: a high degree
        of one half leaves a low one for the other. For several matrices that is worth using."""
        a, b = self.halves
        low = self.degree // 2
        return int(np.sum(a.orders <= low)), int(np.sum(b.orders < self.degree - low))

    @cached_property
    def terms(self) -> np.ndarray:
        """Rows (a, b) of the coefficients that exist, by rising degree: (num_parameters, 2)."""
        a, b = self.halves
        order = a.orders[:, None] + b.orders[None, :]
        exists = (order <= self.degree) & (order > 0)  # a constant generates nothing
        if self.signs is not None:
            exists &= a.parities[:, None] * b.parities[None, :] > 0
        rows = np.argwhere(exists)
        return rows[np.argsort(order[exists], kind="stable")]

    def design(self, x) -> np.ndarray:
        """The products at N variables x (N, k), the constant first: (N, 1 + terms), by NumPy."""
        columns = []
        for angle, values in zip(self.is_angle, np.asarray(x).T, strict=True):
            phases = values[:, None] * np.arange(self.degree + 1)
            columns.append(
                np.hstack([np.cos(phases), np.sin(phases[:, 1:])])
                if angle
                else np.polynomial.chebyshev.chebvander(values, self.degree)
            )
        a, b = self.halves
        (row, column), ones = self.terms.T, np.ones((len(x), 1))
        u = math.prod((f[:, k] for f, k in zip(columns, a.indices.T, strict=False)), start=ones)
        v = math.prod(
            (f[:, k] for f, k in zip(columns[self.cut :], b.indices.T, strict=True)), start=ones
        )
        return np.hstack(
            [
                ones,
                np.broadcast_to(u, (len(x), len(a.indices)))[:, row]
                * np.broadcast_to(v, (len(x), len(b.indices)))[:, column],
            ]
        )

    def placed(self, coefficients) -> np.ndarray:
        """Coefficients (1 + terms, k) of the columns of ``design`` as k matrices (k, m, n)."""
        a, b = self.halves
        c = np.zeros((coefficients.shape[1], len(a.indices), len(b.indices)))
        c[:, 0, 0] = coefficients[0]
        c[:, self.terms[:, 0], self.terms[:, 1]] = coefficients[1:].T
        return c


_basis = cache(Basis)


@partial(jax.tree_util.register_dataclass, data_fields=("inputs",), meta_fields=("degree", "signs"))
@dataclasses.dataclass(frozen=True)
class Products:
    """Chebyshev × Fourier products of total degree at most ``degree`` in the inputs' variables.

    signs: of the variables under a reversor; then only even terms exist (midpoint chart).
    """

    inputs: Inputs
    degree: int
    signs: tuple[int, ...] | None = None

    @property
    def name(self) -> str:
        return "fourier-chebyshev" if self.inputs.angles else "polynomial"

    @property
    def label(self) -> str:
        """As candidates tables show it: what, and how large."""
        return f"{self.name} {self.degree}"

    @property
    def basis(self) -> Basis:
        is_angle = tuple(j in self.inputs.angles for j in range(self.inputs.num_variables))
        return _basis(is_angle, self.degree, self.signs)

    @property
    def num_parameters(self) -> int:
        return len(self.basis.terms)

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S and of its Jacobian: the products with C, the tables."""
        (m, i), (n, j) = (h.indices.shape for h in self.basis.halves)
        tables = sum(t * k * (k - 1) + 10 * self.degree * k for t, k in ((m, i), (n, j)))
        gradient = 4 * m * n + 2 * (m * i + n * j) + tables
        mixed = 2 * i * m * n + 2 * i * j * n
        return gradient, gradient + mixed + 2 * (m * i * i + n * j * j)

    def unflatten(self, coefficients):
        """Coefficients (num_parameters,) -> the matrix C, the parameters of ``S``."""
        a, b = self.basis.halves
        row, col = self.basis.terms.T
        c = jnp.zeros((len(a.indices), len(b.indices)), coefficients.dtype)
        return c.at[row, col].set(coefficients)

    def __call__(self, params, w):
        """S(params, w): params the matrix C, w (2d,) -> scalar."""
        return _polynomial(self.basis, params, self.inputs(w))

    def gradient_features(self, w):
        """∇ of every term at w: (2d, num_parameters), the rows of the least-squares problem."""
        x, slope = self.inputs(w), jax.jacfwd(self.inputs)(w)
        u, du, _, v, dv, _ = _tables(self.basis, x)
        row, col = self.basis.terms.T
        by_variable = jnp.concatenate([du[:, row] * v[None, col], u[None, row] * dv[:, col]])
        return slope.T @ by_variable


def values(family: Products, matrices, x):
    """Σ C_ab u_a v_b of each matrix in (k, m, n) at the scaled variables x: (k,)."""
    u, _, _, v, _, _ = _tables(family.basis, x)
    row, column = family.basis.corner
    low = _dot(_dot(matrices[:, :row], v), u[:row])
    return low + _dot(_dot(matrices[:, row:, :column], v[:column]), u[row:])


def operations_of_values(family: Products, count: int) -> int:
    """Floating-point operations of ``values`` for so many matrices."""
    (m, i), (n, j) = (h.indices.shape for h in family.basis.halves)
    row, column = family.basis.corner
    tables = m * (i - 1) + n * max(j - 1, 0) + 4 * family.degree * (i + j)
    return 2 * count * (row * n + (m - row) * column + m) + tables


def _tables(basis, x):
    """u, ∇u, ∇²u of the first half and v, ∇v, ∇²v of the second at the variables x (k,)."""
    a, b = basis.halves
    return (*a.tables(x[: basis.cut]), *b.tables(x[basis.cut :]))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _polynomial(basis, matrix, x):
    u, _, _, v, _, _ = _tables(basis, x)
    return _dot(u, _dot(matrix, v))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _gradient(basis, matrix, x):
    u, du, _, v, dv, _ = _tables(basis, x)
    return jnp.concatenate([_dot(du, _dot(matrix, v)), _dot(dv, _dot(u, matrix))])


def _hessian(basis, matrix, x):
    u, du, ddu, v, dv, ddv = _tables(basis, x)
    aa, bb = _dot(ddu, _dot(matrix, v)), _dot(ddv, _dot(u, matrix))
    ab = _dot(_dot(du, matrix), dv.T)
    return jnp.block([[aa, ab], [ab.T, bb]])


def _is_zero(tangent) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _linear_rule(value, derivative):
    """d f(C, x) = f(dC, x) + f'(C, x) dx for f linear in C; a symbolic zero costs nothing."""

    def rule(basis, primals, tangents):
        (matrix, x), (matrix_dot, x_dot) = primals, tangents
        out = value(basis, matrix, x)
        out_dot = jnp.zeros_like(out)
        if not _is_zero(matrix_dot):
            out_dot = out_dot + value(basis, matrix_dot, x)
        if not _is_zero(x_dot):
            out_dot = out_dot + _dot(derivative(basis, matrix, x), x_dot)
        return out, out_dot

    return rule


_polynomial.defjvp(_linear_rule(_polynomial, _gradient), symbolic_zeros=True)
_gradient.defjvp(_linear_rule(_gradient, _hessian), symbolic_zeros=True)
