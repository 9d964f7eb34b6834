"""Symmetries of a law: what leaves H as it is, and what is conserved by that (Noether).

Of a family that is linear in its coefficients a symmetry is a restriction Σ_j B_j c_j = 0 at every
state: the Poisson bracket {φ_j, I} of each term with the generator I of a continuous symmetry, or
∇φ_j − Rᵀ∇φ_j(R z) of a discrete one, z → R z. Coefficients that are known with their errors are
restricted where these allow it; a law then has the symmetry to roundoff, and conserves I.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.diagnosis.symmetries import generators, reflections
from gfnn_jax.families.terms import Terms
from gfnn_jax.models.textbook.invariance import restrictions

_HOLDS = 1e-10  # of the restriction's parts, that a symmetry leaves over
_STATES = 200
_ALLOWED = 4.0  # standard errors by which a symmetry may move a coefficient
_DIGITS = 1e-14  # of a coefficient: it may always move by so much
_KNOWN = 1e-12  # of a number's size, or of the largest variance: an error below it is none
_NULL = 1e-8  # of the largest restriction: below it a combination of terms has the symmetry


class Symmetry(NamedTuple):
    """text: as it is told. rows: (n, terms) the restriction, B c = 0."""

    text: str
    rows: np.ndarray


class Known(NamedTuple):
    """Numbers p (n,) of a law, coefficients first, their covariance, from so many rows, and the
    symmetries that the law has by them."""

    numbers: np.ndarray
    covariance: np.ndarray
    rows: int
    symmetries: tuple[str, ...] = ()


def symmetries_of(family: Terms, c: np.ndarray, z: np.ndarray, angles: Sequence[int] = ()):
    """Texts of the symmetries that H = Σ c_j φ_j has to roundoff at states z (N, 2d)."""
    return tuple(s.text for s in _held(family, c, z, angles))


def _held(family: Terms, c: np.ndarray, z: np.ndarray, angles: Sequence[int]) -> list[Symmetry]:
    return [
        s
        for s in _candidates(family, z[:_STATES], tuple(angles))
        if np.abs(s.rows @ c).max() <= _HOLDS * (np.abs(s.rows) @ np.abs(c)).max()
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
    rows = np.concatenate([_independent(s.rows, c) for s in held]) * size
    moved = c - size * (np.linalg.pinv(rows, rcond=_NULL) @ (rows @ (c / size)))
    most = np.maximum(_ALLOWED * deviations, _DIGITS * np.abs(c))
    return moved if np.all(np.abs(moved - c) <= most) else c


def restricted(family: Terms, known: Known, z: np.ndarray, angles: Sequence[int]) -> Known:
    """The numbers with every symmetry that shortens the description.

    A restriction of r coefficients raises half the misfit by ½χ² and saves ½ r ln(rows). It is the
    linear problem of the least change of p in units of its covariance.
    """
    terms, texts, (p, covariance, rows, _) = family.num_parameters, [], known
    for symmetry in _candidates(family, z[:_STATES], tuple(angles)):
        a = np.zeros((terms, len(p)))
        a[:, :terms] = _independent(symmetry.rows, p[:terms])
        deviation = np.sqrt(np.einsum("ij,jk,ik->i", a, covariance, a).clip(0.0))
        parts = np.linalg.norm(a * p, axis=1)
        same = deviation <= _KNOWN * parts  # these terms have it, or those before imply it
        if np.any(np.abs(a @ p)[same] > _HOLDS * parts[same]) or (~same).sum() == terms:
            continue
        if same.all():
            texts.append(symmetry.text)
            continue
        a = a[~same]
        of_rows = a @ covariance @ a.T
        values, vectors = np.linalg.eigh(of_rows)
        free = values > _KNOWN * values.max()
        inverse = (vectors[:, free] / values[free]) @ vectors[:, free].T
        off = a @ p
        if off @ inverse @ off > free.sum() * np.log(rows):
            continue
        gain = covariance @ a.T @ inverse
        p, covariance = p - gain @ off, covariance - gain @ a @ covariance
        texts.append(symmetry.text)
    return Known(p, covariance, rows, tuple(texts))


def _independent(rows: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(terms, terms) independent rows of a restriction of coefficients of about these sizes, those
    that are none 0."""
    size = np.where(c != 0, np.abs(c), 1.0)
    triangle = np.linalg.qr(rows * size, mode="r")
    _, singular, across = np.linalg.svd(triangle)
    parts = np.abs(rows * size).max(initial=0.0) * np.sqrt(len(rows))
    kept = np.zeros(len(c))
    kept[: len(singular)] = singular > _NULL * parts
    return kept[:, None] * across / size


def _candidates(family: Terms, z: np.ndarray, angles: tuple[int, ...]) -> Iterator[Symmetry]:
    """Symmetries that are looked for, at states z where every term is finite."""
    continuous = list(generators(family.dim, angles))
    discrete = list(reflections(family.dim, angles))
    matrices = [matrix for _, matrix in continuous], [matrix for _, matrix in discrete]
    with np.errstate(all="ignore"):
        rows = restrictions(family, z, *matrices)
        for (text, _), found in zip([*continuous, *discrete], rows, strict=True):
            if np.isfinite(found).all():
                yield Symmetry(text, found)
