"""Lie algebras by their structure constants: their name, and coordinates in which these are
standard.

    {z_i, z_j} = Σ_k c_ijk z_k

Constants (n, n, n), antisymmetric in the first two indices. so(3)^k is what has a negative definite
Killing form and ideals of dimension three; se(3) has three rotations that turn an abelian radical;
aff(1)^k, {a_i, b_i} = a_i, has what commutes and what the rest multiplies. NumPy.
"""

from typing import NamedTuple

import numpy as np

from gfnn_jax.brackets import standard_constants
from gfnn_jax.models.brackets.poisson_field import sparse


class Options:
    """Options of the analysis of an algebra."""

    # singular or eigenvalue ÷ the largest, below which it is zero: of constants of pairs without
    # noise; of noisy ones their own error is taken
    zero: float = 1e-7
    mixtures: int = 20  # of what commutes with the algebra, of which the best is taken
    seed: int = 0


_EPSILON = standard_constants(("so3",))


class Algebra(NamedTuple):
    """An algebra: its name, its blocks as `Bracket.lie` has them, and L (n, n) with which y = Lz
    has standard constants; () and None of one that has no standard here."""

    name: str
    blocks: tuple[str, ...] = ()
    lifted: np.ndarray | None = None


def changed(c: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Constants of y = Lz."""
    inverse = np.linalg.inv(matrix)
    return np.einsum("ai,bj,ijk,kc->abc", matrix, matrix, c, inverse, optimize=True)


def killing(c: np.ndarray) -> np.ndarray:
    """Killing form (n, n)."""
    return np.einsum("iab,jba->ij", c, c)


def analysed(c: np.ndarray, zero: float = Options.zero) -> Algebra:
    """Name an algebra and bring it to standard constants. zero: relative, below which eigenvalues
    of the Killing form are none."""
    form = killing(c)
    values, vectors = np.linalg.eigh(form)
    largest = np.abs(values).max(initial=0.0)
    plus, minus = (int(np.sum(s * values > zero * largest)) for s in (1, -1))
    n = len(c)
    if largest <= zero * max(np.abs(c).max() ** 2, 1e-300):
        return Algebra(f"{'nilpotent' if _ends(c, np.eye(n), zero) else 'solvable'}, n = {n}")
    if minus == n and n % 3 == 0:
        lifted = _rotations(c, form)
        if lifted is not None:  # once more, from where the algebra is nearly standard
            nearly = changed(c, lifted)
            again = _rotations(nearly, killing(nearly))
            lifted = lifted if again is None else again @ lifted
            return Algebra(_power("so(3)", n // 3), ("so3",) * (n // 3), lifted)
    if n == 3 and plus == 2 and minus == 1:
        return Algebra("so(2,1)")
    if n == 6 and minus == 3 and plus == 0:
        lifted = _euclidean(c, values, vectors)
        if lifted is not None:
            return Algebra("se(3)", ("se3",), lifted)
    scaled = _scalings(c, zero)
    if scaled is not None:
        return scaled
    if _ends(c, None, zero):
        return Algebra(f"solvable, n = {n}")
    kind = "semisimple" if plus + minus == n else "with a radical"
    return Algebra(f"{kind}, Killing signature ({plus}, {minus}), n = {n}")


def _power(name: str, count: int) -> str:
    return name if count == 1 else f"{name}^{count}"


def _derived(c: np.ndarray, first: np.ndarray, second: np.ndarray, zero: float) -> np.ndarray:
    """Orthonormal basis (m, n) of the span of brackets of two subspaces (a, n) and (b, n)."""
    spans = np.einsum("ai,bj,ijk->abk", first, second, c).reshape(-1, len(c))
    _, s, vt = np.linalg.svd(spans, full_matrices=False)
    return vt[s > np.sqrt(zero) * max(np.abs(c).max(), 1e-300)]


def _ends(c: np.ndarray, whole: np.ndarray | None, zero: float) -> bool:
    """Return whether brackets of the whole algebra, or None: of what is left, with what is left of
    it end at 0: it is nilpotent, or solvable."""
    space = np.eye(len(c))
    for _ in range(len(c)):
        space = _derived(c, space if whole is None else whole, space, zero)
    return not len(space)


def _rotations(c: np.ndarray, form: np.ndarray) -> np.ndarray | None:
    """L (n, n) of so(3)^k, each factor's rows as near as can be to some of the coordinates; None
    where the algebra's ideals are larger."""
    # orthonormal basis of −½ K, in which a factor's constants are ±ε
    basis = np.linalg.inv(np.linalg.cholesky(-0.5 * form))
    own, n = changed(c, basis), len(c)
    ad = own.transpose(0, 2, 1)  # (ad_i)_kj = c_ijk
    eye = np.eye(n)
    commute = np.concatenate([np.kron(a, eye) - np.kron(eye, a.T) for a in ad])
    vt = np.linalg.svd(commute, full_matrices=True)[2]
    count = n // 3
    kernel = vt[-count:].reshape(count, n, n)
    # a symmetric combination, whose eigenspaces the factors are: that of the widest gaps
    rng = np.random.default_rng(Options.seed)
    mixed = np.tensordot(rng.normal(size=(Options.mixtures, count)), kernel, 1)
    values, vectors = np.linalg.eigh(mixed + mixed.swapaxes(1, 2))
    apart = np.diff(values[:, 1::3], axis=1).min(axis=1, initial=np.inf) / np.ptp(values, axis=1)
    vectors = vectors[np.argmax(apart)]
    rows = []
    for k in range(count):
        part = vectors[:, 3 * k : 3 * k + 3].T
        rows.append(_aligned(_signed(own, part) @ basis))
    # factors by the coordinates that they have most of
    rows.sort(key=lambda row: float(np.abs(row).sum(axis=0) @ np.arange(n) / np.abs(row).sum()))
    lifted = np.concatenate(rows)
    off = np.abs(changed(c, lifted) - standard_constants(("so3",) * count)).max()
    return lifted if off < 0.05 else None


def _signed(c: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Orthonormal rows of a factor, with {y_1, y_2} = +y_3."""
    sign = np.einsum("i,j,ijk,k->", part[0], part[1], c, part[2])
    return part * np.sign(sign)


def _aligned(rows: np.ndarray) -> np.ndarray:
    """The rows (3, n) turned by a rotation, so that they are nearest to three of the coordinates,
    in their order, or to their opposites where a reflection would be needed."""
    own = np.sort(np.argsort(-np.linalg.norm(rows, axis=0))[:3])
    sign = np.sign(np.linalg.det(rows[:, own]))
    u, _, vt = np.linalg.svd(sign * rows[:, own].T)
    turned = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (u @ turned @ vt) @ rows


def _scalings(c: np.ndarray, zero: float) -> Algebra | None:
    """aff(1)^k + R^m: what an element h of general position multiplies, a_i with {a_i, h} = λ_i a_i
    to real and different λ_i, and as many b_i of those that commute with h; None of any other."""
    h = np.random.default_rng(Options.seed).normal(size=len(c))
    turned = np.einsum("ijk,j->ki", c, h)  # of an element, by its coordinates: {·, h}
    values, vectors = np.linalg.eig(turned)
    limit = np.sqrt(zero) * np.abs(values).max(initial=0.0)
    if np.abs(np.imag(values)).max() > limit:
        return None
    scaled = np.real(vectors).T[np.abs(values) > limit]
    still = np.linalg.svd(turned)[2][len(scaled) :]
    scaled = scaled / np.abs(scaled).max(axis=1, keepdims=True)
    rates = np.einsum("ai,bj,ijk,ak->ab", scaled, still, c, scaled, optimize=True)
    rates = rates / np.sum(scaled**2, axis=1)[:, None]  # {a_i, still_j} = rates_ij a_i
    if not len(scaled) or np.linalg.matrix_rank(rates, tol=limit) < len(scaled):
        return None
    kernel = np.linalg.svd(rates)[2][len(scaled) :]  # of what commutes with all
    centre = kernel @ still
    partners = [sparse(row @ still, centre) for row in np.linalg.pinv(rates).T]
    pairs = [row for both in zip(scaled, partners, strict=True) for row in both]
    lifted = np.array([*pairs, *centre])
    blocks = ("aff",) * len(scaled) + ("centre",) * len(centre)
    if np.abs(changed(c, lifted) - standard_constants(blocks)).max() > 0.05:
        return None
    name = _power("aff(1)", len(scaled))
    return Algebra(name + (" + " + _power("R", len(centre)) if len(centre) else ""), blocks, lifted)


def _euclidean(c: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> np.ndarray | None:
    """L (6, 6) of se(3); None where the radical is not abelian, or is not turned as a vector."""
    order = np.argsort(values)
    radical, levi = vectors[:, order[3:]].T, vectors[:, order[:3]].T
    own = changed(c, np.concatenate([levi, radical]))
    # a complement that is a subalgebra: M'_i = M_i + N_ij Γ_j, linear in N as Γ is abelian
    rows, right = [], []
    for i in range(3):
        for j in range(i):
            for m in range(3):
                row = np.zeros((3, 3))
                row[j] += own[i, 3:, 3 + m]
                row[i] -= own[j, 3:, 3 + m]
                for k in range(3):
                    row[k, m] -= own[i, j, k]
                rows.append(row.ravel())
                right.append(-own[i, j, 3 + m])
    tilt = np.linalg.lstsq(np.array(rows), np.array(right), rcond=1e-9)[0].reshape(3, 3)
    levi = levi + tilt @ radical
    own = changed(c, np.concatenate([levi, radical]))
    basis = np.linalg.inv(np.linalg.cholesky(-0.5 * killing(own[:3, :3, :3])))
    levi = _signed(own[:3, :3, :3], basis) @ levi
    levi = _aligned(levi)
    own = changed(c, np.concatenate([levi, radical]))
    # Γ' = TΓ with {M_i, Γ'_j} = ε_ijk Γ'_k
    eye = np.eye(3)
    conditions = np.concatenate(
        [np.kron(eye, own[i, 3:, 3:].T) - np.kron(_EPSILON[i], eye) for i in range(3)]
    )
    turn = np.linalg.svd(conditions)[2][-1].reshape(3, 3)
    gamma = turn @ radical
    gamma *= np.sqrt(3) / np.linalg.norm(gamma)
    gamma *= np.sign(gamma[0, np.abs(gamma[0]).argmax()])
    lifted = np.concatenate([levi, gamma])
    return (
        lifted if np.abs(changed(c, lifted) - standard_constants(("se3",))).max() < 0.05 else None
    )
