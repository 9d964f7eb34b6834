"""Lifts: states z of a bracket as images π(w) of states w whose bracket is constant.

The fibres of π are orbits of linear symplectic groups that leave H∘π as it is. Gauss collocation
commutes with these and keeps what is quadratic, so that its steps of H∘π go down to Poisson steps
of z (R. I. McLachlan, K. Modin & O. Verdier, "Collective symplectic integrators", Nonlinearity 27,
2014).

- so(3): Hopf's π: R⁴ -> R³, |w|² = 4|z|.
- se(3): π: T*ℍ -> R⁶, Π = −½ Im(q̄ p), Γ = q̄ k q, where Γ is not 0.
- velocities in a magnetic field: v = m⁻¹ (p − A(x)).
- aff(1): a = q², b = q p / 2, where a > 0.
- a Casimir coordinate: y = q p.
- a constant bracket is its own lift, and a log-canonical one that of y = log z.
"""

from functools import cache
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.brackets import Bracket, Constant, LieAlgebra, Log, Magnetic
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.terms import Terms
from gfnn_jax.phase_space import split

# Coordinates of a block, and half those of its lift.
_SIZES = {"so3": (3, 2), "se3": (6, 4), "aff": (2, 1), "centre": (1, 1)}
# π of a block: z_k = Σ value w_a w_b of the entries (k, a, b, value), w = (q, p) of the block.
_PRODUCTS: dict[str, list[tuple[int, int, int, float]]] = {
    "so3": [
        *((0, 0, 1, 0.5), (0, 2, 3, 0.5), (1, 0, 3, 0.5), (1, 1, 2, -0.5)),
        *((2, 0, 0, 0.25), (2, 2, 2, 0.25), (2, 1, 1, -0.25), (2, 3, 3, -0.25)),
    ],
    "se3": [
        *((0, 0, 5, -0.5), (0, 1, 4, 0.5), (0, 2, 7, 0.5), (0, 3, 6, -0.5)),
        *((1, 0, 6, -0.5), (1, 2, 4, 0.5), (1, 3, 5, 0.5), (1, 1, 7, -0.5)),
        *((2, 0, 7, -0.5), (2, 3, 4, 0.5), (2, 1, 6, 0.5), (2, 2, 5, -0.5)),
        *((3, 0, 2, -2.0), (3, 1, 3, 2.0), (4, 0, 1, 2.0), (4, 2, 3, 2.0)),
        *((5, 0, 0, 1.0), (5, 3, 3, 1.0), (5, 1, 1, -1.0), (5, 2, 2, -1.0)),
    ],
    "aff": [(0, 0, 0, 1.0), (1, 0, 1, 0.5)],
    "centre": [(0, 0, 1, 1.0)],
}


def lift_of(bracket: Bracket) -> Any:
    """The lift of a bracket. Raises FitError for a Lie algebra without one."""
    if isinstance(bracket, Constant):
        return Itself(bracket.form)
    if isinstance(bracket, Log):
        return Logarithms(bracket.form)
    if isinstance(bracket, Magnetic):
        return _shear(bracket)
    if isinstance(bracket, LieAlgebra) and bracket.blocks:
        return Quadratic(bracket.blocks, bracket.basis, np.linalg.inv(bracket.basis))
    raise FitError(f"there is no lift of {bracket.name}: its steps are `flows.lie`'s")


class Lift:
    """π from states w, whose bracket is the constant ``form``, None for J, to states z."""

    form: Any
    # (casimir, a, b) of Σ value w_a w_b / 2, and values, of the fibres' momenta: what a lift's flow
    # conserves by itself. (): z's Casimirs stand for them; None: not known.
    quadratic_invariants: Any = None

    def argument(self, w):
        """State at which H is evaluated: that of w."""
        return self.down(w)

    def up(self, z):
        """A state w of z: any of its fibre, for all make the same steps."""
        raise NotImplementedError

    def down(self, w):
        """π(w), the state z of w."""
        raise NotImplementedError


@pytree()
class Itself(Lift):
    """z = w: the bracket is the constant ``form`` (n, n)."""

    form: Any

    quadratic_invariants = ()

    def up(self, z):
        """The state w of z."""
        return z

    def down(self, w):
        """The state z of w."""
        return w

    def moved(self, w, change):
        """Change of z as w changes."""
        return change

    def pulled(self, w, g):
        """(∂π/∂w)ᵀ g of covectors g."""
        return g

    def sizes(self, scale):
        """Sizes of w."""
        return scale

    def pulled_twice(self, w, g, hessian):
        """Hessian of H∘π in w from gradient and Hessian of H."""
        return hessian


@pytree()
class Logarithms(Itself):
    """w = y = log z of positive z, whose bracket is the constant ``form`` (n, n). Maps have y as
    their inner coordinates, so that steps begin and end with y."""

    def argument(self, w):
        """z = exp(y)."""
        return namespace(w).exp(w)

    def pulled(self, w, g):
        """∂/∂y of covectors ∂/∂z."""
        return self.argument(w) * g

    def pulled_twice(self, w, g, hessian):
        """Hessian of H∘exp."""
        z = self.argument(w)
        unit = as_row(np.eye(z.shape[-1]), z[..., None])
        return z[..., :, None] * z[..., None, :] * hessian + (z * g)[..., None] * unit


@pytree("blocks")
class Quadratic(Lift):
    """Lift of a sum of algebras, quadratic in w = (q, p): L z are the images of the blocks.

    basis, inverse: L and L⁻¹ (n, n).
    """

    blocks: tuple[str, ...]
    basis: Any
    inverse: Any

    form = None

    def up(self, z):
        """A state w (..., N) of z (..., n): any of its fibre, for all make the same steps."""
        y, at, halves = matmul(z, self.basis.T), 0, []
        for block in self.blocks:
            halves.append(_UP[block](y[..., at : at + _SIZES[block][0]]))
            at += _SIZES[block][0]
        q, p = zip(*halves, strict=True)
        return namespace(z).concatenate([*q, *p], axis=-1)

    def down(self, w):
        """The state z (..., n) of w (..., N)."""
        return self.product(w, w)

    def moved(self, w, change):
        """Change of z (..., n) as w changes, to its own rounding."""
        return self.product(2.0 * w + change, change)

    def product(self, u, w):
        """The symmetric bilinear form (..., n) whose value at (w, w) is π(w)."""
        (_, a, b), into, _ = _table(self.blocks)
        return matmul(matmul(u[..., a] * w[..., b], _like(into, w)), self.inverse.T)

    def pulled(self, w, g):
        """(∂π/∂w)ᵀ g (..., N) of covectors g (..., n)."""
        (k, _, b), _, back = _table(self.blocks)
        return matmul(matmul(g, self.inverse)[..., k] * w[..., b], _like(back, w))

    def pulled_twice(self, w, g, hessian):
        """Hessian of H∘π (..., N, N): π'ᵀ H'' π' + Σ g_k π_k''."""
        xp = namespace(w)
        units = as_row(xp.eye(w.shape[-1], dtype=w.dtype), w[..., None])
        slopes = 2.0 * self.product(units, w[..., None, :])
        curved = self.pulled(units, g[..., None, :])
        return matmul(slopes, matmul(hessian, xp.swapaxes(slopes, -1, -2))) + curved

    def sizes(self, scale):
        """Sizes (N,) of w where z is of sizes ``scale`` (n,)."""
        xp, w = namespace(scale), self.up(scale)
        q, p = split(w)
        halves = [xp.broadcast_to(xp.sqrt(xp.mean(half * half)), q.shape) for half in (q, p)]
        return xp.concatenate(halves)

    @property
    def quadratic_invariants(self) -> tuple:
        """|w|² of each spin, |q|² and ⟨k q, p⟩ of each se(3), q p of each Casimir coordinate."""
        half, at, found = sum(_SIZES[block][1] for block in self.blocks), 0, []
        for block in self.blocks:
            q = range(at, at + _SIZES[block][1])
            p = [half + i for i in q]
            at += len(q)
            if block == "so3":
                found.append([(i, i, 1.0) for i in (*q, *p)])
            elif block == "se3":
                found.append([(i, i, 1.0) for i in q])
                turned = zip((3, 2, 1, 0), (-1.0, -1.0, 1.0, 1.0), strict=True)
                found.append([(q[j], p[i], v) for i, (j, v) in enumerate(turned)])
            elif block == "centre":
                found.append([(q[0], p[0], 1.0)])
        both = [[*rows, *((b, a, v) for a, b, v in rows if a != b)] for rows in found]
        entries = [(k, a, b) for k, rows in enumerate(both) for a, b, _ in rows]
        return entries, [v for rows in both for *_, v in rows]

    @property
    def fibres(self) -> list[tuple[int, int, bool]]:
        """Places of q and p whose fibre has no end: of se(3), where p − s q is the same state
        (True), and of Casimir coordinates, where s q and p / s are."""
        ends = np.cumsum([0, *(_SIZES[block][1] for block in self.blocks)]).tolist()
        starts = zip(self.blocks, ends, strict=False)
        some = ((block, at) for block, at in starts if block in ("se3", "centre"))
        return [(at, ends[-1] + at, block == "se3") for block, at in some]


@pytree()
class Shear(Lift):
    """(x, p) -> (x, v), p = m v + A(x).

    terms: family of the monomials of A in x; potentials: its coefficients, those of each A_j (d,
    terms).
    """

    terms: Terms
    potentials: Any
    mass: Any
    inverse: Any

    form = None
    quadratic_invariants = ()

    def up(self, z):
        """(x, p) of (x, v)."""
        d = len(self.mass)
        p = matmul(z[..., d:], self.mass) + self._potential(z)
        return namespace(z).concatenate([z[..., :d], p], axis=-1)

    def sizes(self, scale):
        """Sizes (2d,) of (x, p)."""
        return namespace(scale).abs(self.up(scale))

    def down(self, w):
        """(x, v) of (x, p)."""
        d = len(self.mass)
        v = matmul(w[..., d:] - self._potential(w), self.inverse)
        return namespace(w).concatenate([w[..., :d], v], axis=-1)

    def moved(self, w, change):
        """Change of (x, v) as (x, p) changes."""
        return self.down(w + change) - self.down(w)

    def pulled(self, w, g):
        """(∂π/∂w)ᵀ g."""
        d = len(self.mass)
        u = matmul(g[..., d:], self.inverse)
        x = g[..., :d] - sum(
            slope[..., :d] * u[..., j : j + 1] for j, (slope, _) in enumerate(self._slopes(w))
        )
        return namespace(w).concatenate([x, u], axis=-1)

    def pulled_twice(self, w, g, hessian):
        """Hessian of H∘π in (x, p)."""
        xp, d = namespace(w), len(self.mass)
        found = self._slopes(w)
        slopes = xp.stack([slope for slope, _ in found], axis=-2)  # ∂A_j/∂w, (..., d, 2d)
        still = xp.eye(2 * d, dtype=w.dtype)
        top = xp.broadcast_to(still[:d], slopes.shape)
        bottom = matmul(self.inverse, as_row(still[d:], slopes) - slopes)
        jacobian = xp.concatenate([top, bottom], axis=-2)
        u = matmul(g[..., d:], self.inverse)
        curved = sum(bend * u[..., j, None, None] for j, (_, bend) in enumerate(found))
        return matmul(xp.swapaxes(jacobian, -1, -2), matmul(hessian, jacobian)) - curved

    def _potential(self, w):
        """A (..., d)."""
        values = [self.terms.value(own, w) for own in self.potentials]
        return namespace(w).stack(values, axis=-1)

    def _slopes(self, w):
        """Gradient and Hessian of each A_j."""
        return [self.terms.gradient_and_hessian(own, w) for own in self.potentials]


def _shear(bracket: Magnetic) -> Shear:
    """Lift of velocities: A_j = Σ x_i F_ij / (degree + 2), of which x·A = 0."""
    d, rows = bracket.size // 2, {}
    for coefficients, powers in zip(bracket.field, bracket.powers, strict=True):
        for i in range(d):
            row = tuple(a + (k == i) for k, a in enumerate(powers))
            more = np.asarray(coefficients[i]) / (sum(powers) + 2)
            rows[row] = rows.get(row, 0.0) + more
    terms = Terms(d, coordinate_names(d)[:d], tuple(rows))
    potentials = np.array(list(rows.values())).T.copy()
    return Shear(terms, potentials, bracket.mass, np.linalg.inv(bracket.mass))


@cache
def _table(blocks: tuple[str, ...]) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Entries of π of a sum of blocks, those of (a, b) and of (b, a): the places (k, a, b), (E,)
    each, and what sums products of w_a and w_b up to z (E, n), and of g_k and w_b to ∂/∂w (E, N).
    """
    half, at, first, rows = sum(_SIZES[block][1] for block in blocks), 0, 0, []
    for block in blocks:
        n, own = _SIZES[block]
        of = [*range(at, at + own), *range(half + at, half + at + own)]
        for k, a, b, value in _PRODUCTS[block]:
            pairs = {(a, b), (b, a)}
            rows += [(first + k, of[i], of[j], value / len(pairs)) for i, j in sorted(pairs)]
        first, at = first + n, at + own
    *places, values = (np.array(column) for column in zip(*rows, strict=True))
    into = values[:, None] * np.eye(first)[places[0]]
    return tuple(places), into, 2.0 * values[:, None] * np.eye(2 * half)[places[1]]


def _like(table: np.ndarray, w) -> np.ndarray:
    """A table of the precision of states."""
    return table if w.dtype == object else table.astype(w.dtype)


# A state (q, p) of an image of each block.


def _up_spin(y):
    """(q, p) (..., 2) of a spin y (..., 3), the larger of both complex numbers real."""
    xp = namespace(y)
    length = xp.sqrt(xp.sum(y * y, axis=-1))
    large = xp.sqrt(2.0 * (length + xp.abs(y[..., 2])))
    safe = xp.where(large > 0, large, 1.0)
    real, imaginary = (2.0 * y[..., k] / safe for k in range(2))
    north, zero = y[..., 2] >= 0, xp.zeros_like(large)
    q = xp.where(north[..., None], xp.stack([large, real], -1), xp.stack([real, large], -1))
    p = xp.stack([xp.where(north, zero, -imaginary), xp.where(north, imaginary, zero)], -1)
    return q, p


def _up_top(y):
    """(q, p) (..., 4) of (Π, Γ) (..., 6)."""
    xp = namespace(y)
    momentum, axis = y[..., :3], y[..., 3:]
    length = xp.sqrt(xp.sum(axis * axis, axis=-1))
    large = xp.sqrt(0.5 * (length + xp.abs(axis[..., 2])))
    one, other = (0.5 * axis[..., k] / large for k in range(2))
    zero = xp.zeros_like(large)
    north = xp.stack([large, other, -one, zero], axis=-1)
    south = xp.stack([other, large, zero, one], axis=-1)
    q = xp.where((axis[..., 2] >= 0)[..., None], north, south)
    return q, _times(q, momentum) * (-2.0 / length)[..., None]


def _times(q, a):
    """Quaternions q a (..., 4) of q (..., 4) and imaginary a (..., 3)."""
    (q0, q1, q2, q3), (a1, a2, a3) = ([x[..., k] for k in range(x.shape[-1])] for x in (q, a))
    return namespace(q, a).stack(
        [
            -q1 * a1 - q2 * a2 - q3 * a3,
            q0 * a1 + q2 * a3 - q3 * a2,
            q0 * a2 + q3 * a1 - q1 * a3,
            q0 * a3 + q1 * a2 - q2 * a1,
        ],
        axis=-1,
    )


def _up_scaled(y):
    """(q, p) (..., 1) of (a, b) (..., 2)."""
    q = namespace(y).sqrt(y[..., :1])
    return q, 2.0 * y[..., 1:] / q


_UP = {"so3": _up_spin, "se3": _up_top, "aff": _up_scaled}
_UP["centre"] = lambda y: (y, namespace(y).ones_like(y))  # (q, p) of a Casimir y = q p
