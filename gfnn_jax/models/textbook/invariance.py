"""Atoms that have the symmetries of the pairs by themselves: a dictionary of these is far shorter.

An atom is a product of functions of arguments. A continuous symmetry with the generator I leaves it
as it is where the Poisson brackets {x, I} of its arguments x vanish; a reflection, z → R z, where
its arguments keep their value or turn their sign, and the turned ones are in even functions, or in
an even number of odd ones. A law may have a symmetry of which its atoms know nothing by themselves,
as q₁⁴ + 2 q₁² q₂² + q₂⁴ has: it is for a search among all atoms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from gfnn_jax.diagnosis.symmetries import SymmetryOfPairs, generators, reflections
from gfnn_jax.families.terms import Terms
from gfnn_jax.models.textbook.arguments import arguments_of
from gfnn_jax.models.textbook.atoms import Atom
from gfnn_jax.models.textbook.dictionary import Setting
from gfnn_jax.models.textbook.shapes import Kind, parity
from gfnn_jax.phase_space import symplectic_form

# Of what it would change by: a conserved quantity of clean pairs changes by less (textbook.py). Of
# the largest value, or slope: below it there is none.
_CERTAIN, _ROUNDED = 1e-11, 1e-10


class Invariance:
    """The symmetries that clean pairs show: conserved quantities, to roundoff; where there are
    such, reversal of time and reflection of all coordinates too, which alone shorten little."""

    def __init__(self, symmetries: Sequence[SymmetryOfPairs], setting: Setting):
        z, arguments, angles, dim = setting.states, setting.arguments, setting.angles, setting.dim
        left, self._z = {s.text: s.left for s in symmetries}, z
        self._generators = [
            matrix for text, matrix in generators(dim, angles) if left.get(text, np.inf) <= _CERTAIN
        ]
        self._reflections = [
            matrix
            for text, matrix in reflections(dim, angles)
            if self._generators and text in left and not np.any(matrix - np.diag(np.diag(matrix)))
        ]
        still = np.ones(len(arguments), bool)
        for generator in self._generators:
            moved = moved_by(generator, z)
            rates = (np.abs(np.einsum("ni,ni->n", x.gradient, moved)).max() for x in arguments)
            sizes = (np.abs(x.gradient * moved).max() for x in arguments)
            still &= [r <= _ROUNDED * s for r, s in zip(rates, sizes, strict=True)]
        self._still = still
        self._signs = [
            [_sign(x.value, y.value) for x, y in zip(arguments, there, strict=True)]
            for r in self._reflections
            for there in [arguments_of(z @ r.T, angles, setting.cyclic)]
        ]

    def __bool__(self) -> bool:
        """Return whether there is a symmetry that is certain."""
        return bool(self._generators)

    def of_atom(self, atom: Atom) -> bool:
        """Return whether the atom has all of the symmetries, whatever its constants."""
        if not all(self._still[f.place] for f in atom):
            return False
        return all(math.prod(_turned(s[f.place], f.kind) for f in atom) == 1 for s in self._signs)

    def terms(self, family: Terms) -> list[int]:
        """The terms of which a combination has the symmetries; all of them where none has."""
        given = self._generators, self._reflections
        rows = np.concatenate(list(restrictions(family, self._z, *given)))
        size = np.linalg.norm(family.term_gradients(self._z).reshape(-1, rows.shape[-1]), axis=0)
        size = np.where(size > 0, size, 1.0)
        _, singular, across = np.linalg.svd(np.linalg.qr(rows / size, mode="r"))
        free = across[np.append(singular, np.zeros(len(size)))[: len(size)] <= _ROUNDED]
        kept = np.flatnonzero(np.abs(free).max(axis=0, initial=0.0) > _ROUNDED)
        return kept.tolist() or list(range(family.num_parameters))


def restrictions(
    family: Terms,
    z: np.ndarray,
    continuous: Sequence[np.ndarray],
    discrete: Sequence[np.ndarray],
) -> Iterator[np.ndarray]:
    """(n, terms) at states z (N, 2d), what is 0 of a combination of terms that has a symmetry: the
    Poisson bracket {φ, I} = ∇φᵀ J ∇I of each term with the generator I of a continuous symmetry, or
    ∇φ − Rᵀ∇φ(R z) of a discrete one, z → R z."""
    gradients = family.term_gradients(z)
    for generator in continuous:
        yield np.einsum("nij,ni->nj", gradients, moved_by(generator, z))
    for matrix in discrete:
        there = np.einsum("ki,nkj->nij", matrix, family.term_gradients(z @ matrix.T))
        yield (gradients - there).reshape(-1, gradients.shape[-1])


def moved_by(generator: np.ndarray, z: np.ndarray) -> np.ndarray:
    """J∇I (N, 2d) of the generator I = ½ zᵀA z + bᵀz, (2d, 2d + 1) of A and b."""
    slope = z @ generator[:, :-1].T + generator[:, -1]
    return slope @ symplectic_form(len(slope[0]) // 2).T


def _turned(sign: int, kind: Kind) -> int:
    """1 where the shape stays as it is as its argument turns to ``sign`` times it, -1 where it
    turns its sign, else 0."""
    return sign if sign >= 0 else parity(kind)


def _sign(x: np.ndarray, y: np.ndarray) -> int:
    """1 where y is x, -1 where it is −x, else 0."""
    most = _ROUNDED * np.abs(x).max()
    return int(np.abs(y - x).max() <= most) - int(np.abs(y + x).max() <= most)
