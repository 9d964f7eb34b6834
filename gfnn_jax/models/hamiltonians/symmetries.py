"""Symmetries of a law: what leaves H as it is, and what is conserved by that (Noether).

Of a family that is linear in its coefficients a symmetry is a restriction Σ_j B_j c_j = 0 at every
state: the Poisson bracket {φ_j, I} of each term with the generator I of a continuous symmetry, or
∇φ_j − Rᵀ∇φ_j(R z) of a discrete one, z → R z. Coefficients that are known with their errors are
restricted where these allow it; a law then has the symmetry to roundoff, and conserves I.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.diagnosis.symmetries import generators, reflections
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.phase_space import symplectic_form


@dataclasses.dataclass(frozen=True)
class SymmetryOptions:
    """Chosen on the laws of benchmarks/textbook.py and textbook_noise.py.

    holds: of the restriction's parts, that a symmetry leaves over. states: at which it is tried.
    digits: of a coefficient, by which a symmetry may always move it. known: of a number's size, or
    of the largest variance, an error below it is none. null: of the largest restriction, below it a
    combination of terms has the symmetry.
    """

    holds: float = 1e-10
    states: int = 200
    digits: float = 1e-14
    known: float = 1e-12
    null: float = 1e-8


OPTIONS = SymmetryOptions()


Symmetry = tuple[str, np.ndarray]  # as it is told; (n, terms) the restriction B, B c = 0


class LawNumbers(NamedTuple):
    """Numbers p (n,) of a law, coefficients first, their covariance, from so many rows, and the
    symmetries that the law has by them."""

    numbers: np.ndarray
    covariance: np.ndarray
    rows: int
    symmetries: tuple[str, ...] = ()


def symmetries_of(family: Terms, c: np.ndarray, z: np.ndarray, angles: Sequence[int] = ()):
    """Texts of the symmetries that H = Σ c_j φ_j has to roundoff at states z (N, 2d)."""
    return tuple(text for text, _ in _held(family, c, z, angles))


def _held(family: Terms, c: np.ndarray, z: np.ndarray, angles: Sequence[int]) -> list[Symmetry]:
    return [
        (text, rows)
        for text, rows in _candidates(family, z[: OPTIONS.states], tuple(angles))
        if np.abs(rows @ c).max() <= OPTIONS.holds * (np.abs(rows) @ np.abs(c)).max()
    ]


def imposed(
    family: Terms, c: np.ndarray, deviations: np.ndarray, z: np.ndarray, angles: Sequence[int]
) -> np.ndarray:
    """The coefficients c (m,) with the symmetries that H nearly has, to roundoff, moved the least;
    c itself where one would move by more than its standard error allows."""
    held = _held(family, c, z, angles)
    if not held:
        return c
    size = np.where(c != 0, np.abs(c), 1.0)
    rows = np.concatenate([_independent(found, c) for _, found in held]) * size
    moved = c - size * (np.linalg.pinv(rows, rcond=OPTIONS.null) @ (rows @ (c / size)))
    most = np.maximum(EVIDENCE.significant * deviations, OPTIONS.digits * np.abs(c))
    return moved if np.all(np.abs(moved - c) <= most) else c


def restricted(
    family: Terms, known: LawNumbers, z: np.ndarray, angles: Sequence[int]
) -> LawNumbers:
    """The numbers with every symmetry that shortens the description.

    A restriction of r coefficients raises half the misfit by ½χ² and saves ½ r ln(rows). It is the
    linear problem of the least change of p in units of its covariance.
    """
    terms, texts, (p, covariance, rows, _) = family.num_parameters, [], known
    for text, found in _candidates(family, z[: OPTIONS.states], tuple(angles)):
        a = np.zeros((terms, len(p)))
        a[:, :terms] = _independent(found, p[:terms])
        deviation = np.sqrt(np.einsum("ij,jk,ik->i", a, covariance, a).clip(0.0))
        parts = np.linalg.norm(a * p, axis=1)
        same = deviation <= OPTIONS.known * parts  # these terms have it, or those before imply it
        if np.any(np.abs(a @ p)[same] > OPTIONS.holds * parts[same]) or (~same).sum() == terms:
            continue
        if same.all():
            texts.append(text)
            continue
        a = a[~same]
        of_rows = a @ covariance @ a.T
        values, vectors = np.linalg.eigh(of_rows)
        free = values > OPTIONS.known * values.max()
        inverse = (vectors[:, free] / values[free]) @ vectors[:, free].T
        off = a @ p
        if off @ inverse @ off > free.sum() * np.log(rows):
            continue
        gain = covariance @ a.T @ inverse
        p, covariance = p - gain @ off, covariance - gain @ a @ covariance
        texts.append(text)
    return LawNumbers(p, covariance, rows, tuple(texts))


def _independent(rows: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(terms, terms) independent rows of a restriction of coefficients of about these sizes, those
    that are none 0."""
    size = np.where(c != 0, np.abs(c), 1.0)
    triangle = np.linalg.qr(rows * size, mode="r")
    _, singular, across = np.linalg.svd(triangle)
    parts = np.abs(rows * size).max(initial=0.0) * np.sqrt(len(rows))
    kept = np.zeros(len(c))
    kept[: len(singular)] = singular > OPTIONS.null * parts
    return kept[:, None] * across / size


def _candidates(family: Terms, z: np.ndarray, angles: tuple[int, ...]) -> Iterator[Symmetry]:
    """Symmetries that are looked for, at states z where every term is finite."""
    with np.errstate(all="ignore"):
        gradients = family.term_gradients(z)
        for text, generator in generators(family.dim, angles):
            # {φ, I} = ∇φᵀ J ∇I, of a quadratic or linear I with ∇I = A z + b.
            moved = (z @ generator[:, :-1].T + generator[:, -1]) @ symplectic_form(family.dim).T
            yield text, np.einsum("nij,ni->nj", gradients, moved)
        for text, matrix in reflections(family.dim, angles):
            there = np.einsum("ki,nkj->nij", matrix, family.term_gradients(z @ matrix.T))
            rows = (gradients - there).reshape(-1, gradients.shape[-1])
            if np.isfinite(rows).all():
                yield text, rows
