"""Brackets: what makes a motion out of H where the states are no canonical (q, p).

    ż = B(z) ∇H(z),      {f, g} = ∇fᵀ B ∇g,      B antisymmetric, with Jacobi's identity

A map Φ with derivative M is Poisson where M B(z) Mᵀ = B(Φ(z)). Casimirs C have B ∇C = 0: every H
conserves them. A bracket is data, and is saved without code.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.errors import FitError
from gfnn_jax.phase_space import symplectic_form

# Relative to the largest entry: below it a constant is roundoff, and Jacobi's identity holds.
_ROUNDOFF = 1e-10
_BLOCKS = {"so3": 3, "se3": 6, "aff": 2, "centre": 1}
_NAMES = {"so3": "so(3)", "se3": "se(3)", "aff": "aff(1)", "centre": "R"}
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class Bracket:
    """Poisson bracket of n coordinates, one of four kinds, made by the functions below.

        gfnn.Bracket.so3(2)                      # two spins
        gfnn.Bracket.se3()                       # a heavy top: (Π, Γ)
        gfnn.Bracket.constant([[0, 1], [-1, 0]])
        gfnn.Bracket.log([[0, -1], [1, 0]])      # {z1, z2} = −z1 z2: predator and prey

    ``names`` are those of the coordinates, z1 … zn where there are none; ``note`` is said behind
    the name, as of one of several that were found.
    """

    names: tuple[str, ...] = ()
    note: str = ""
    _kind = "a Lie algebra"

    @staticmethod
    def constant(matrix, names: Sequence[str] = ()) -> Constant:
        """{z_i, z_j} = B_ij, an antisymmetric matrix (n, n), which may be singular.

        Raises FitError for a matrix that is not antisymmetric.
        """
        return Constant(_antisymmetric(matrix), tuple(names))

    @staticmethod
    def log(matrix, names: Sequence[str] = ()) -> Log:
        """{z_i, z_j} = B_ij z_i z_j for z > 0: constant in log z. Raises FitError as ``constant``
        does."""
        return Log(_antisymmetric(matrix), tuple(names))

    @staticmethod
    def so3(count: int = 1, basis=None, names: Sequence[str] = ()) -> LieAlgebra:
        """{z1, z2} = z3 and cyclically, for each of ``count`` spins (or bodies by their angular
        momentum), one after another. basis: that of ``lie``."""
        return Bracket.lie(("so3",) * count, basis, names)

    @staticmethod
    def se3(basis=None, names: Sequence[str] = ()) -> LieAlgebra:
        """States (Π, Γ) of a heavy top: {Π1, Π2} = Π3, {Π1, Γ2} = Γ3 and cyclically, {Γ, Γ} = 0.
        basis: that of ``lie``."""
        return Bracket.lie(("se3",), basis, names)

    @staticmethod
    def lie(blocks: Sequence[str], basis=None, names: Sequence[str] = ()) -> LieAlgebra:
        """Sum of algebras "so3", "se3", "aff" ({a, b} = a, a > 0: scalings of a line, of which
        Toda's chain is made) and "centre" (one coordinate that has bracket 0 with all).

        basis: L (n, n), where L z and not z has the standard constants, block after block.
        Raises FitError for another block, and where L is not invertible.
        """
        unknown = [block for block in blocks if block not in _BLOCKS]
        if unknown or not blocks:
            raise FitError(f"expected blocks among {', '.join(_BLOCKS)}, got {list(blocks)}")
        size = sum(_BLOCKS[block] for block in blocks)
        basis = np.eye(size) if basis is None else np.asarray(basis, float)
        if basis.shape != (size, size) or not np.linalg.cond(basis) < 1 / _ROUNDOFF:
            raise FitError(f"expected an invertible basis ({size}, {size}), got {basis.shape}")
        inverse = np.linalg.inv(basis)
        standard = standard_constants(blocks)
        constants = np.einsum("ia,jb,abc,ck->ijk", inverse, inverse, standard, basis)
        return LieAlgebra(_clean(constants), basis, tuple(blocks), tuple(names))

    @staticmethod
    def from_constants(constants, names: Sequence[str] = ()) -> LieAlgebra:
        """{z_i, z_j} = Σ_k c_ijk z_k of any Lie algebra, c (n, n, n).

        Raises FitError where c is not antisymmetric in i and j, or Jacobi's identity fails.
        """
        constants = np.asarray(constants, float)
        if constants.ndim != 3 or len(set(constants.shape)) != 1:
            raise FitError(f"expected constants c of shape (n, n, n), got {constants.shape}")
        size = np.abs(constants).max(initial=0.0)
        if np.abs(constants + constants.swapaxes(0, 1)).max(initial=0.0) > _ROUNDOFF * size:
            raise FitError("expected constants with c_ijk = −c_jik")
        failure = jacobi_failure(constants)
        if failure > _ROUNDOFF * size**2:
            raise FitError(
                f"Jacobi's identity fails by {failure / size**2:.1e} of the constants' size: "
                "these constants are not those of a Lie algebra"
            )
        return LieAlgebra(constants, None, (), tuple(names))

    @staticmethod
    def magnetic(field, powers=None, mass=None, names: Sequence[str] = ()) -> Magnetic:
        """States (x, v) of a charged body: {x_i, v_j} = 1/m_ij, {v_i, v_j} = F_ij(x).

        field: coefficients (m, d, d) of F by monomials in x, the first index; powers: their
        exponents (m, d), a constant field alone where there are none. mass: (d, d), symmetric; the
        canonical momentum is p = m v + A(x). F is then that of m v. Raises FitError where F is not
        antisymmetric, or no curl (a magnetic field with sources).
        """
        field = np.asarray(field, float)
        field = field[None] if field.ndim == 2 else field
        d = field.shape[-1]
        powers = np.zeros((1, d), int) if powers is None else np.asarray(powers, int)
        if field.shape != (len(powers), d, d) or powers.shape[1] != d:
            shapes = f"{field.shape} and {powers.shape}"
            raise FitError(f"expected a field (m, d, d) and its exponents (m, d), got {shapes}")
        for coefficients in field:
            _antisymmetric(coefficients)
        mass = np.eye(d) if mass is None else np.asarray(mass, float)
        bracket = Magnetic(field, mass, tuple(map(tuple, powers.tolist())), tuple(names))
        probes = np.random.default_rng(0).normal(size=(8, d))
        slope = np.asarray(bracket.curl_slopes(probes))  # ∂_k F_ij
        closed = slope + np.moveaxis(slope, -1, -3) + np.moveaxis(slope, -3, -1)
        if np.abs(closed).max() > _ROUNDOFF * max(np.abs(slope).max(), 1e-300):
            raise FitError("the field F(x) is not a curl: ∂_k F_ij + ∂_i F_jk + ∂_j F_ki is not 0")
        return bracket

    @property
    def size(self) -> int:
        """Number n of coordinates."""
        raise NotImplementedError

    @property
    def name(self) -> str:
        """Kind of bracket in a word or two."""
        return self._kind

    def matrix(self, z):
        """B(z) (..., n, n) at states z (..., n), NumPy, JAX or lists."""
        raise NotImplementedError

    def apply(self, z, g):
        """B(z) g (..., n) for covectors g (..., n)."""
        return matmul(self.matrix(z), g[..., None])[..., 0]

    def outside(self, z):
        """Flag (...) of states at which the steps of this bracket are not defined."""
        return namespace(z).any(z != z, axis=-1)

    def require_inside(self, z) -> None:
        """Raise FitError that names the rows of z (N, n), from 0, at which no step is defined."""
        rows = np.flatnonzero(self.outside(np.asarray(z, float)))
        if rows.size:
            some = ", ".join(map(str, rows[:5])) + (", …" if rows.size > 5 else "")
            raise FitError(f"{self.undefined} in {rows.size} of {len(z)} states, rows {some}")

    undefined = "a value is missing"

    @cached_property
    def casimirs(self) -> tuple[Casimir, ...]:
        """Independent Casimirs, linear ones first: of constant and log brackets all, of Lie
        algebras those of degree 1 and 2."""
        raise NotImplementedError

    def named(self, names: Sequence[str]) -> Any:
        """The same bracket of coordinates with these names."""
        return dataclasses.replace(self, names=tuple(names))  # pyright: ignore[reportArgumentType]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return self.names or tuple(f"z{i + 1}" for i in range(self.size))

    def relations(self) -> list[str]:
        """{a, b} = … of each two coordinates whose bracket is not 0, as text."""
        n, labels = self.size, self.labels
        texts = ((i, j, self._entry(i, j)) for i in range(n) for j in range(i + 1, n))
        return [f"{{{labels[i]},{labels[j]}}} = {text}" for i, j, text in texts if text]

    def _entry(self, i: int, j: int) -> str:
        raise NotImplementedError

    def __str__(self) -> str:
        text = f"{'; '.join(self.relations()) or 'all brackets 0'}: {self.name}"
        return f"{text}, {self.note}" if self.note else text


@pytree("names", "note", repr=False)
class Constant(Bracket):
    """{z_i, z_j} = B_ij."""

    form: Any
    names: tuple[str, ...] = ()
    note: str = ""

    _kind = "constant"

    @property
    def size(self) -> int:
        return self.form.shape[-1]

    def matrix(self, z):
        """B (..., n, n), the same at every state z."""
        z = _as_states(z)
        return namespace(z).broadcast_to(self.form, (*z.shape[:-1], *self.form.shape))

    @cached_property
    def casimirs(self) -> tuple[Casimir, ...]:
        return tuple(Casimir(None, row, False, self.labels) for row in null_space(self.form))

    def _entry(self, i: int, j: int) -> str:
        return added([(self.form[i, j], "")])


@pytree("names", "note", repr=False)
class Log(Bracket):
    """{z_i, z_j} = B_ij z_i z_j, z > 0."""

    form: Any
    names: tuple[str, ...] = ()
    note: str = ""

    _kind = "log-canonical"
    undefined = "a coordinate is not above 0"

    @property
    def size(self) -> int:
        return self.form.shape[-1]

    def matrix(self, z):
        """B_ij z_i z_j (..., n, n)."""
        z = _as_states(z)
        return as_row(self.form, z[..., None]) * (z[..., :, None] * z[..., None, :])

    def outside(self, z):
        """Flag (...) of states with a coordinate that is not above 0."""
        return ~namespace(z).all(z > 0, axis=-1)

    @cached_property
    def casimirs(self) -> tuple[Casimir, ...]:
        """Σ k_i log z_i of each k with B k = 0."""
        return tuple(Casimir(None, row, True, self.labels) for row in null_space(self.form))

    def _entry(self, i: int, j: int) -> str:
        return added([(self.form[i, j], f"{self.labels[i]} {self.labels[j]}")])


@pytree("blocks", "names", "note", repr=False)
class LieAlgebra(Bracket):
    """{z_i, z_j} = Σ_k c_ijk z_k. blocks: the algebra's parts where L z, L the ``basis``, has their
    standard constants; () for an algebra that is none of them."""

    constants: Any
    basis: Any
    blocks: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    note: str = ""

    undefined = "Γ = 0 in se(3), a ≤ 0 in aff(1), or a value is missing,"

    @property
    def size(self) -> int:
        return self.constants.shape[-1]

    @property
    def name(self) -> str:
        """Name of the algebra, such as so(3)² + R."""
        if not self.blocks:
            return self._kind
        counts = {block: self.blocks.count(block) for block in dict.fromkeys(self.blocks)}
        powers = {b: str(n).translate(_SUPERSCRIPTS) if n > 1 else "" for b, n in counts.items()}
        return " + ".join(_NAMES[block] + powers[block] for block in counts)

    def matrix(self, z):
        """Σ_k c_ijk z_k (..., n, n)."""
        z, n = _as_states(z), self.size
        return matmul(z, self.constants.reshape(n * n, n).T).reshape(*z.shape[:-1], n, n)

    def outside(self, z):
        """Flag (...) of states with Γ = 0 in a part se(3), or a ≤ 0 in a part aff(1)."""
        xp, bad = namespace(z), super().outside(z)
        for block, place in zip(self.blocks, places(self.blocks), strict=True):
            y = matmul(z, self.basis.T)[..., place]
            if block == "se3":
                bad = bad | (xp.max(xp.abs(y[..., 3:]), axis=-1) == 0)
            elif block == "aff":
                bad = bad | (y[..., 0] <= 0)
        return bad

    @property
    def opposite(self) -> LieAlgebra:
        """The bracket −B."""
        if not self.blocks:
            return dataclasses.replace(self, constants=-self.constants)
        basis = -self.basis
        for block, place in zip(self.blocks, places(self.blocks), strict=True):
            if block == "aff":  # of {a, b} = a it is b that changes its sign
                basis[place.start] *= -1.0
        return Bracket.lie(self.blocks, basis, self.names)

    @cached_property
    def casimirs(self) -> tuple[Casimir, ...]:
        n, c = self.size, np.asarray(self.constants)
        linear = null_space(c.transpose(0, 2, 1).reshape(n * n, n))
        # Σ c_ijm z_m Q_jl z_l = 0 for every i and z: linear in the coefficients of z_a z_b, a ≤ b.
        upper = np.triu_indices(n)
        forms = np.zeros((len(upper[0]), n, n))
        forms[np.arange(len(forms)), *upper] = 1.0
        forms = forms + forms.swapaxes(1, 2)
        fields = np.einsum("ijm,ajl->aiml", c, forms)
        fields = (fields + fields.swapaxes(2, 3)).reshape(len(forms), -1)
        pairs = [(row, other) for k, row in enumerate(linear) for other in linear[k:]]
        squares = [(np.outer(a, b) + np.triu(np.outer(b, a), 1))[upper] for a, b in pairs]
        rows = null_space(fields.T, without=squares)
        found = [Casimir(np.tensordot(r, forms, 1), np.zeros(n), False, self.labels) for r in rows]
        of_degree_1 = (Casimir(None, row, False, self.labels) for row in linear)
        return (*of_degree_1, *found)

    def _entry(self, i: int, j: int) -> str:
        return added(list(zip(self.constants[i, j], self.labels, strict=True)))


@pytree("powers", "names", "note", repr=False)
class Magnetic(Bracket):
    """{x_i, v_j} = (m⁻¹)_ij, {v_i, v_j} = (m⁻¹ F(x) m⁻¹)_ij, F = Σ_n field_n Π x^powers_n:
    canonical in (x, p), p = m v + A(x)."""

    field: Any
    mass: Any
    powers: tuple[tuple[int, ...], ...]
    names: tuple[str, ...] = ()
    note: str = ""

    _kind = "canonical by p = m v + A(x)"

    @cached_property
    def casimirs(self) -> tuple[Casimir, ...]:
        """Empty: B is invertible."""
        return ()

    @property
    def size(self) -> int:
        return 2 * self.field.shape[-1]

    def curl(self, x):
        """F (..., d, d) at positions x (..., d): {m v, m v}."""
        parts = zip(self.field, self.powers, strict=True)
        return sum(as_row(c, x[..., None]) * _monomial(x, p)[..., None, None] for c, p in parts)

    def curl_slopes(self, x):
        """∂_k F_ij (..., d, d, d), the last index k."""
        xp = namespace(x)
        return sum(
            as_row(c[..., None], x[..., None, None])
            * xp.stack([_monomial_slope(x, p, k) for k in range(len(p))], -1)[..., None, None, :]
            for c, p in zip(self.field, self.powers, strict=True)
        )

    def potential(self, x):
        """A (..., d) with F_ij = ∂_i A_j − ∂_j A_i and x·A = 0: ∫₀¹ s F(s x)ᵀ x ds."""
        parts = zip(self.field, self.powers, strict=True)
        return sum(matmul(x, c) * (_monomial(x, p) / (sum(p) + 2))[..., None] for c, p in parts)

    def matrix(self, z):
        """B (..., 2d, 2d)."""
        z = _as_states(z)
        xp, d = namespace(z), self.size // 2
        inverse = xp.linalg.inv(self.mass)
        curl = matmul(inverse, matmul(self.curl(z[..., :d]), inverse))
        cross = xp.broadcast_to(inverse, curl.shape)
        top = xp.concatenate([xp.zeros_like(curl), cross], axis=-1)
        return xp.concatenate([top, xp.concatenate([-cross, curl], axis=-1)], axis=-2)

    def _entry(self, i: int, j: int) -> str:
        d, inverse = self.size // 2, np.linalg.inv(self.mass)
        if i < d <= j:
            return added([(inverse[i, j - d], "")])
        if j < d:
            return ""
        values = (inverse @ c @ inverse for c in self.field)
        return added(
            [
                (c[i - d, j - d], _product(self.labels[:d], p))
                for c, p in zip(values, self.powers, strict=True)
            ]
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Casimir:
    """½ zᵀ Q z + k·z, or Σ k_i log z_i: what every H of a bracket conserves.

    quadratic: Q (n, n) or None. linear: k (n,). logs: whether it is of log z.
    """

    quadratic: Any
    linear: Any
    logs: bool
    labels: tuple[str, ...]

    def __call__(self, z):
        """Value (...) at states z (..., n), NumPy, JAX or lists."""
        z = _as_states(z)
        y = namespace(z).log(z) if self.logs else z
        value = matmul(y, self.linear)
        if self.quadratic is not None:
            value = value + 0.5 * namespace(z).sum(matmul(y, self.quadratic) * y, axis=-1)
        return value

    def gradient(self, z):
        """Gradient (..., n)."""
        z = _as_states(z)
        if self.logs:
            return as_row(self.linear, z) / z
        slope = matmul(z, self.quadratic) if self.quadratic is not None else 0.0
        return slope + as_row(self.linear, z)

    @property
    def formula(self) -> str:
        """The Casimir as text."""
        names = [f"log({name})" for name in self.labels] if self.logs else list(self.labels)
        terms = list(zip(self.linear, names, strict=True))
        if self.quadratic is not None:
            for i, a in enumerate(names):
                terms.append((0.5 * self.quadratic[i, i], f"{a}**2"))
                pairs = zip(self.quadratic[i, i + 1 :], names[i + 1 :], strict=True)
                terms += [(value, f"{a}*{b}") for value, b in pairs]
        return added(terms, "*")

    def __str__(self) -> str:
        return self.formula


def _as_states(z):
    """States as they are where they are an array, traced or not; else as a NumPy array."""
    return z if hasattr(z, "shape") else np.asarray(z, float)


def standard_constants(blocks: Sequence[str]) -> np.ndarray:
    """Constants c (n, n, n) of a sum of algebras, block after block."""
    spin = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        spin[i, j, k], spin[j, i, k] = 1.0, -1.0
    found = np.zeros((sum(_BLOCKS[b] for b in blocks),) * 3)
    for block, place in zip(blocks, places(blocks), strict=True):
        own = np.zeros((_BLOCKS[block],) * 3)
        if block in ("so3", "se3"):
            own[:3, :3, :3] = spin
        if block == "se3":
            own[:3, 3:, 3:] = spin
            own[3:, :3, 3:] = spin
        if block == "aff":
            own[0, 1, 0], own[1, 0, 0] = 1.0, -1.0
        found[place, place, place] = own
    return found


def places(blocks: Sequence[str]) -> list[slice]:
    """Find the places of the coordinates of each block."""
    ends = np.cumsum([0, *(_BLOCKS[block] for block in blocks)])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def canonical(dim: int) -> Constant:
    """The bracket of (q, p): B = J."""
    return Constant(symplectic_form(dim))


def jacobi_failure(constants) -> float:
    """Largest entry of Σ_m (c_ijm c_mkl + c_jkm c_mil + c_kim c_mjl)."""
    product = np.einsum("ijm,mkl->ijkl", constants, constants)
    cycles = product + product.transpose(2, 0, 1, 3) + product.transpose(1, 2, 0, 3)
    return float(np.abs(cycles).max(initial=0.0))


def poisson_defect(jacobian, before, after, scale=None, multiplier: Any = 1.0):
    """Largest entry of M B(z) Mᵀ − μ B(Z) (...), relative to that of B(Z).

    jacobian: M (..., n, n). before, after: B at z and at Z. scale: (n,) sizes of the coordinates,
    which are made unit-sized first. multiplier: μ, a number or (...). NumPy or JAX.
    """
    xp = namespace(jacobian)
    moved = matmul(jacobian, matmul(before, xp.swapaxes(jacobian, -1, -2)))
    mu = multiplier[..., None, None] if np.ndim(multiplier) else multiplier
    unit = 1.0 if scale is None else as_row(scale[:, None] * scale[None, :], jacobian)
    largest = xp.max(xp.abs(after / unit), axis=(-2, -1))
    return xp.max(xp.abs((moved - mu * after) / unit), axis=(-2, -1)) / largest


def null_space(matrix, *, without: Sequence[Any] = (), tolerance: float = _ROUNDOFF) -> np.ndarray:
    """Basis (k, n) of {x: A x = 0}, A (m, n), in reduced row-echelon form: few entries, largest 1.

    without: vectors (n,) that are taken out of it. tolerance: relative to the largest singular
    value.
    """
    matrix = np.atleast_2d(np.asarray(matrix, float))
    _, s, rows = np.linalg.svd(matrix, full_matrices=True)
    rank = int((s > tolerance * max(s.max(initial=0.0), 1e-300)).sum())
    kernel = rows[rank:]
    if len(without) and len(kernel):
        q, _ = np.linalg.qr(np.array(without, float).T)
        kernel = kernel - (kernel @ q) @ q.T
        _, s, rows = np.linalg.svd(kernel, full_matrices=False)
        kernel = rows[s > 1e-6]
    return _echelon(kernel)


def _echelon(rows: np.ndarray) -> np.ndarray:
    """Reduced row-echelon form of independent rows, the pivot of each as large as there is."""
    rows = rows.copy()
    for i in range(len(rows)):
        rest = np.abs(rows[i:])
        row, column = np.unravel_index(rest.argmax(), rest.shape)
        rows[[i, i + row]] = rows[[i + row, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    rows = rows[np.lexsort(-np.abs(rows).T[::-1].round(9))] if len(rows) else rows
    return _clean(rows)


def _clean(values: np.ndarray) -> np.ndarray:
    """Entries that are roundoff made 0, and those that are whole numbers but for it whole."""
    small = _ROUNDOFF * 1e-3 * np.abs(values).max(initial=0.0)
    near = np.round(values)
    return np.where(np.abs(values - near) <= small, near + 0.0, values)


def _antisymmetric(matrix) -> np.ndarray:
    """The matrix (n, n), n ≥ 2, as an array. Raises FitError where it is not antisymmetric."""
    matrix = np.asarray(matrix, float)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or len(matrix) < 2:
        raise FitError(f"expected a matrix (n, n) with n ≥ 2, got shape {matrix.shape}")
    if not np.abs(matrix + matrix.T).max() <= _ROUNDOFF * np.abs(matrix).max():
        raise FitError("expected an antisymmetric matrix: B_ij = −B_ji")
    return 0.5 * (matrix - matrix.T)


def _monomial(x, powers: tuple[int, ...]):
    """Π x_k^a_k (...)."""
    value = namespace(x).ones_like(x[..., 0])
    for k, a in enumerate(powers):
        for _ in range(a):
            value = value * x[..., k]
    return value


def _monomial_slope(x, powers: tuple[int, ...], k: int):
    """∂/∂x_k of a monomial (...)."""
    return powers[k] * _monomial(x, tuple(a - (n == k) for n, a in enumerate(powers)))


def _product(names: Sequence[str], powers: tuple[int, ...]) -> str:
    """Π names^powers as text."""
    parts = zip(names, powers, strict=True)
    return " ".join(name if a == 1 else f"{name}^{a}" for name, a in parts if a)


def added(terms: Sequence[tuple[Any, str]], sign: str = " ") -> str:
    """Σ coefficient · name as text, without terms that are 0; "" for none."""
    text = ""
    for coefficient, name in terms:
        if coefficient == 0:
            continue
        size = abs(float(coefficient))
        number = "" if size == 1 and name else f"{size:.6g}"
        term = sign.join(part for part in (number, name) if part)
        joint = ("-" if coefficient < 0 else "") if not text else ""
        text += (" - " if coefficient < 0 else " + ") * bool(text) + joint + term
    return text
