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

from __future__ import annotations

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
        return z[..., :, None] * z[..., None, :] * hessian + _diagonal(z * g)


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
        parts = self._split(matmul(z, self.basis.T), 0)
        return self._halves(_UP[block](part) for block, part in parts)

    def down(self, w):
        """The state z (..., n) of w (..., N)."""
        return self.product(w, w)

    def moved(self, w, change):
        """Change of z (..., n) as w changes, to its own rounding."""
        return self.product(2.0 * w + change, change)

    def product(self, u, w):
        """The symmetric bilinear form (..., n) whose value at (w, w) is π(w)."""
        pairs = zip(self._states(u), self._states(w), strict=True)
        found = [_flat(_PRODUCTS[block](a, b)) for (block, a), (_, b) in pairs]
        return matmul(namespace(u, w).concatenate(found, axis=-1), self.inverse.T)

    def pulled(self, w, g):
        """(∂π/∂w)ᵀ g (..., N) of covectors g (..., n)."""
        pairs = zip(self._states(w), self._split(matmul(g, self.inverse), 0), strict=True)
        return self._halves(_PULLED[block](state, own) for (block, state), (_, own) in pairs)

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

    def _groups(self):
        """(block, how many follow each other)."""
        n = 0
        while n < len(self.blocks):
            count = 1
            while self.blocks[n : n + count + 1] == self.blocks[n : n + 1] * (count + 1):
                count += 1
            yield self.blocks[n], count
            n += count

    def _split(self, y, which: int):
        """(block, (..., count, size)) of coordinates (..., n), or of one half (..., N / 2)."""
        at = 0
        for block, count in self._groups():
            size = _SIZES[block][which]
            yield block, y[..., at : at + count * size].reshape(*y.shape[:-1], count, size)
            at += count * size

    def _states(self, w):
        """(block, ((..., count, half) q, p))."""
        middle = w.shape[-1] // 2
        halves = self._split(w[..., :middle], 1), self._split(w[..., middle:], 1)
        for (block, q), (_, p) in zip(*halves, strict=True):
            yield block, (q, p)

    def _halves(self, states):
        """w (..., N) of the (q, p) of each block."""
        q, p = zip(*states, strict=True)
        return namespace(q[0]).concatenate([_flat(half) for half in (*q, *p)], axis=-1)


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


# Each block has a state (q, p) of an image, the bilinear form, and pulled-back covectors.


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


def _spin(u, w):
    """Bilinear form (..., 3) of states (q, p) of R⁴."""
    (q, p), (r, s) = u, w
    a, b, c, e = (q[..., 0], p[..., 0], r[..., 0], s[..., 0])
    f, g, h, k = (q[..., 1], p[..., 1], r[..., 1], s[..., 1])
    x = a * h + c * f + b * k + e * g
    y = a * k + c * g - b * h - e * f
    z = a * c + b * e - f * h - g * k
    return 0.25 * namespace(q, r).stack([x, y, z], axis=-1)


def _pulled_spin(w, g):
    """Covector (..., 2) of q and of p."""
    (q, p), xp = w, namespace(w[0], g)
    x, y, z = (0.5 * g[..., k] for k in range(3))
    a, f, b, h = (q[..., 0], q[..., 1], p[..., 0], p[..., 1])
    of_q = xp.stack([x * f + y * h + z * a, x * a - y * b - z * f], axis=-1)
    of_p = xp.stack([x * h - y * f + z * b, x * b + y * a - z * h], axis=-1)
    return of_q, of_p


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


def _top(u, w):
    """Bilinear form (..., 6) of states (q, p) of T*ℍ."""
    (q, p), (r, s) = u, w
    momentum = -0.25 * (_imaginary(q, s) + _imaginary(r, p))
    return namespace(q, r).concatenate([momentum, _imaginary(q, _turned(r))], axis=-1)


def _pulled_top(w, g):
    """Covector (..., 4) of q and of p."""
    q, p = w
    momentum, axis = g[..., :3], g[..., 3:]
    of_q = 0.5 * _times(p, momentum) - 2.0 * _turned(_times(q, axis))
    return of_q, -0.5 * _times(q, momentum)


def _times(q, a):
    """Quaternions q a (..., 4) of q (..., 4) and imaginary a (..., 3)."""
    (q0, q1, q2, q3), (a1, a2, a3) = _entries(q), _entries(a)
    return namespace(q, a).stack(
        [
            -q1 * a1 - q2 * a2 - q3 * a3,
            q0 * a1 + q2 * a3 - q3 * a2,
            q0 * a2 + q3 * a1 - q1 * a3,
            q0 * a3 + q1 * a2 - q2 * a1,
        ],
        axis=-1,
    )


def _imaginary(q, r):
    """Im(q̄ r) (..., 3) of quaternions (..., 4)."""
    (q0, q1, q2, q3), (r0, r1, r2, r3) = _entries(q), _entries(r)
    return namespace(q, r).stack(
        [
            q0 * r1 - r0 * q1 - q2 * r3 + q3 * r2,
            q0 * r2 - r0 * q2 - q3 * r1 + q1 * r3,
            q0 * r3 - r0 * q3 - q1 * r2 + q2 * r1,
        ],
        axis=-1,
    )


def _turned(q):
    """Quaternions k q (..., 4)."""
    q0, q1, q2, q3 = _entries(q)
    return namespace(q).stack([-q3, -q2, q1, q0], axis=-1)


def _entries(array):
    return (array[..., k] for k in range(array.shape[-1]))


def _flat(array):
    """(..., count, size) as (..., count · size)."""
    return array.reshape(*array.shape[:-2], -1)


def _diagonal(values):
    """Diagonal matrices (..., n, n)."""
    return values[..., None] * as_row(np.eye(values.shape[-1]), values[..., None])


def _up_scaled(y):
    """(q, p) (..., 1) of (a, b) (..., 2)."""
    q = namespace(y).sqrt(y[..., :1])
    return q, 2.0 * y[..., 1:] / q


def _scaled(u, w):
    """Bilinear form (..., 2) of states (q, p)."""
    (q, p), (r, s) = u, w
    return namespace(q, r).concatenate([q * r, 0.25 * (q * s + p * r)], axis=-1)


def _pulled_scaled(w, g):
    """Covector (..., 1) of q and of p."""
    q, p = w
    return 2.0 * q * g[..., :1] + 0.5 * p * g[..., 1:], 0.5 * q * g[..., 1:]


def _up_still(y):
    """(q, p) = (y, 1) of a Casimir y = q p (..., 1)."""
    return y, namespace(y).ones_like(y)


def _still(u, w):
    """Bilinear form (..., 1) of states (q, p)."""
    return 0.5 * (u[0] * w[1] + w[0] * u[1])


def _pulled_still(w, g):
    """Covector (..., 1) of q and of p."""
    return g * w[1], g * w[0]


_UP = {"so3": _up_spin, "se3": _up_top, "aff": _up_scaled, "centre": _up_still}
_PRODUCTS = {"so3": _spin, "se3": _top, "aff": _scaled, "centre": _still}
_PULLED = {"so3": _pulled_spin, "se3": _pulled_top, "aff": _pulled_scaled, "centre": _pulled_still}
