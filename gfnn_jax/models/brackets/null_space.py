"""The bracket of a field: antisymmetric B with L_f B = 0, linear in the coefficients of B.

    (L_f B)_ij = f·∇B_ij − Σ_k (∂_k f_i B_kj + B_ik ∂_k f_j)

is zero where the flow of f is Poisson. It is evaluated at states, each
coordinate in units of its size: constant B, then B affine in z, then log-canonical ones,
b_ij z_i z_j. NumPy.
"""

import dataclasses
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar


class Options:
    """Options of the null space (benchmarks/brackets.py)."""

    rows_per_column: float = 3.0  # of numbers that L_f B is taken at
    # singular value in units of f': of a null vector of a field without noise
    null: float = 1e-10
    # standard errors of L_f B by the field's own covariance, that a null vector may have
    errors: float = 3.0
    draws: int = 12  # of the field's coefficients, that tell this error
    shrinking: float = 0.05  # of f', what L_f B − λB of noisy sequences may leave at all


CONSTANT, LINEAR, LOG = "constant", "linear", "log"


@dataclasses.dataclass(frozen=True)
class Tensors:
    """Basis of bivectors of one kind in n coordinates: E_ab m(z), E_ab = e_a e_bᵀ − e_b e_aᵀ.

    m is 1; or 1, z_1, …, z_n; or z_a z_b.
    """

    kind: str
    width: int

    @property
    def places(self) -> list[tuple[int, int]]:
        """(a, b) of all E_ab."""
        return list(combinations(range(self.width), 2))

    @property
    def num(self) -> int:
        return len(self.places) * (1 + self.width * (self.kind == LINEAR))

    def monomials(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """m (N, P, K) and ∇m (N, P, K, n) of each place at z (N, n)."""
        a, b = np.transpose(self.places)
        count, eye = (len(z), len(a)), np.eye(self.width)
        if self.kind == LOG:
            slopes = z[:, a, None] * eye[b] + z[:, b, None] * eye[a]
            return (z[:, a] * z[:, b])[..., None], slopes[:, :, None]
        one = np.ones((*count, 1))
        if self.kind == CONSTANT:
            return one, np.zeros((*count, 1, self.width))
        values = np.concatenate([one, np.broadcast_to(z[:, None], (*count, self.width))], axis=2)
        slopes = np.concatenate([np.zeros((1, self.width)), eye])
        return values, np.broadcast_to(slopes, (*count, *slopes.shape))

    def values(self, z: np.ndarray) -> np.ndarray:
        """All of the basis, its entries above the diagonal, at z (N, n): (N P, J)."""
        own = np.einsum("npk,pq->npqk", self.monomials(z)[0], np.eye(len(self.places)))
        return own.reshape(-1, self.num)

    def lie(self, z: np.ndarray, f: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """L_f of all of the basis, its entries above the diagonal (N, P, J), from f (N, n) and
        f' (N, n, n)."""
        values, slopes = self.monomials(z)
        along = np.einsum("npkm,nm->npk", slopes, f)
        out = np.zeros((len(z), len(self.places), len(self.places), values.shape[2]))
        upper = tuple(np.transpose(self.places))
        for p, (a, b) in enumerate(self.places):
            turned = np.zeros((len(z), self.width, self.width))
            turned[:, :, b] += slope[:, :, a]
            turned[:, :, a] -= slope[:, :, b]
            turned = turned - np.swapaxes(turned, 1, 2)
            out[:, :, p] = -turned[:, upper[0], upper[1], None] * values[:, p, None]
            out[:, p, p] += along[:, p]
        return out.reshape(len(z), len(self.places), self.num)


class NullSpace(NamedTuple):
    """Bivectors with L_f B = 0 of one kind, in the units of the coordinates.

    tensors: the basis. vectors: (m, J) coefficients in it. values: all singular values, rising, ÷
    the size of f' over the states: 1 where nothing cancels. rate: λ of L_f B = λB.
    """

    tensors: Tensors
    vectors: np.ndarray
    values: np.ndarray
    rate: float = 0.0

    @property
    def nearest(self) -> float:
        """The smallest singular value."""
        return float(self.values[0])


def null_spaces(
    z: np.ndarray,
    f: np.ndarray,
    slope: np.ndarray,
    draws: list[tuple[np.ndarray, np.ndarray]],
    rate: float = 0.0,
) -> Iterator[NullSpace]:
    """The null spaces of L_f − λ over constant, affine and logarithmic B in turn.

    z: (N, n) states. f, slope: the field and its derivative there. draws: the same of fields
    drawn from the field's covariance, less the field. rate: λ.
    """
    scale = np.sqrt(np.mean(z**2, axis=0))
    y, (f, slope) = z / scale, _in_units(f, slope, scale)
    draws = [_in_units(*one, scale) for one in draws]
    kinds = (CONSTANT, LINEAR, LOG) if (z > 0).all() else (CONSTANT, LINEAR)
    for kind in kinds:
        tensors = Tensors(kind, z.shape[1])
        needed = Options.rows_per_column * tensors.num / len(tensors.places)
        stride = max(1, int(len(z) // max(needed, 30)))
        own = slice(None, None, stride)
        lie = tensors.lie(y[own], f[own], slope[own]).reshape(-1, tensors.num)
        lie = lie - rate * tensors.values(y[own])
        size = np.sqrt(len(lie) / len(tensors.places) * np.mean(np.sum(slope[own] ** 2, (1, 2))))
        _, values, vt = np.linalg.svd(lie, full_matrices=False)
        values, vt = values[::-1] / size, vt[::-1]
        errors = [
            tensors.lie(y[own], *(a[own] for a in one)).reshape(-1, tensors.num) for one in draws
        ]
        limit = np.array(
            [np.sqrt(np.mean([np.sum((e @ v) ** 2) for e in errors])) / size for v in vt[:8]]
        )
        allowed = np.maximum(Options.errors * limit, Options.null)
        count = int(np.cumprod(values[: len(allowed)] <= allowed).sum())
        vectors = vt[:count] * _back(tensors, scale)
        yield NullSpace(tensors, vectors, values, rate)


def shrinking(z: np.ndarray, f: np.ndarray, slope: np.ndarray, clean: bool) -> list[float]:
    """All λ ≠ 0 of L_f B = λB, by which uniform friction shrinks a constant or affine bracket,
    those of a higher rank first: the null space as an eigenvalue problem.

    z: (N, n) states. f, slope: the field and its derivative there. clean: it holds to roundoff;
    else λ is that of least ‖L_f B − λB‖ near an eigenvalue, and what is left may be noise.
    """
    scale = np.sqrt(np.mean(z**2, axis=0))
    y, (f, slope) = z / scale, _in_units(f, slope, scale)
    size, n = np.sqrt(np.mean(np.sum(slope**2, axis=(1, 2)))), z.shape[1]
    limit = Options.null if clean else Options.shrinking
    known: list[tuple[int, float, float]] = []
    for kind in (CONSTANT, LINEAR):
        tensors = Tensors(kind, n)
        lie, every = tensors.lie(y, f, slope).reshape(-1, tensors.num), tensors.values(y)
        eigen = np.linalg.eig(np.linalg.lstsq(every, lie, rcond=None)[0])
        for rate, vector in zip(eigen[0], np.real(eigen[1].T), strict=True):
            found = float(np.real(rate))
            if not clean:

                def gram(rate: float, lie=lie, every=every) -> np.ndarray:
                    shifted = lie - rate * every
                    return shifted.T @ shifted

                near = (found, found + limit * size)
                least: Any = minimize_scalar(lambda rate: np.linalg.eigvalsh(gram(rate))[0], near)
                found = float(least.x)
                vector = np.linalg.eigh(gram(found))[1][:, 0]
            bracket = every @ vector
            left = float(np.linalg.norm(lie @ vector - found * bracket) / np.linalg.norm(bracket))
            seen = any(abs(found - other) <= limit * size for *_, other in known)
            if left <= limit * size and not seen and abs(found) > Options.null * size:
                form = np.zeros((n, n))
                form[tuple(np.transpose(tensors.places))] = bracket[: len(tensors.places)]
                least = max(1e-6, limit) * np.abs(form).max()
                rank = int(np.linalg.matrix_rank(form - form.T, tol=least))
                known.append((-rank, 0.0 if clean else left, found))
    return [rate for *_, rate in sorted(known)]


def _in_units(f, slope, scale):
    return f / scale, slope * scale / scale[:, None]


def _back(tensors: Tensors, scale: np.ndarray) -> np.ndarray:
    """Factors (J,) from coefficients in scaled coordinates to those in the user's."""
    a, b = np.transpose(tensors.places)
    pair = (scale[a] * scale[b])[:, None]
    if tensors.kind == LINEAR:
        return (pair / np.concatenate([[1.0], scale])).ravel()
    return np.ones(len(a)) if tensors.kind == LOG else pair.ravel()
