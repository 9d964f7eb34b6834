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
from gfnn_jax.models.textbook.arguments import Argument, arguments_of
from gfnn_jax.models.textbook.atoms import Atom
from gfnn_jax.models.textbook.shapes import Kind, parity
from gfnn_jax.phase_space import symplectic_form

CERTAIN = 1e-11  # of what it would change by: a conserved quantity of clean pairs changes by less
_ROUNDED = 1e-10  # of the largest value, or slope: below it there is none


class Invariance:
    """The symmetries that clean pairs show: conserved quantities, to roundoff; where there are
    such, reversal of time and reflection of all coordinates too, which alone shorten little.

    z: (N, 2d) states; arguments: at these. angles, cyclic: indices of z.
    """

    def __init__(
        self,
        symmetries: Sequence[SymmetryOfPairs],
        z: np.ndarray,
        arguments: list[Argument],
        angles: tuple[int, ...],
        cyclic: tuple[int, ...],
    ):
        dim, left = z.shape[1] // 2, {s.text: s.left for s in symmetries}
        self._z = z
        self._generators = [
            matrix for text, matrix in generators(dim, angles) if left.get(text, np.inf) <= CERTAIN
        ]
        self._reflections = [
            matrix
            for text, matrix in reflections(dim, angles)
            if self._generators and text in left and not np.any(matrix - np.diag(np.diag(matrix)))
        ]
        still = np.ones(len(arguments), bool)
        for generator in self._generators:
            moved = self._moved(generator)
            rates = (np.abs(np.einsum("ni,ni->n", x.gradient, moved)).max() for x in arguments)
            sizes = (np.abs(x.gradient * moved).max() for x in arguments)
            still &= [r <= _ROUNDED * s for r, s in zip(rates, sizes, strict=True)]
        self._still = still
        self._signs = [
            [_sign(x.value, y.value) for x, y in zip(arguments, there, strict=True)]
            for r in self._reflections
            for there in [arguments_of(z @ r.T, angles, cyclic)]
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
        rows = np.concatenate(list(self._restrictions(family)))
        size = np.linalg.norm(family.term_gradients(self._z).reshape(-1, rows.shape[-1]), axis=0)
        size = np.where(size > 0, size, 1.0)
        _, singular, across = np.linalg.svd(np.linalg.qr(rows / size, mode="r"))
        free = across[np.append(singular, np.zeros(len(size)))[: len(size)] <= _ROUNDED]
        kept = np.flatnonzero(np.abs(free).max(axis=0, initial=0.0) > _ROUNDED)
        return kept.tolist() or list(range(family.num_parameters))

    def _restrictions(self, family: Terms) -> Iterator[np.ndarray]:
        """(n, terms): what is 0 of a combination of terms that has a symmetry."""
        gradients = family.term_gradients(self._z)
        for generator in self._generators:
            yield np.einsum("nij,ni->nj", gradients, self._moved(generator))
        for matrix in self._reflections:
            there = np.einsum("ki,nkj->nij", matrix, family.term_gradients(self._z @ matrix.T))
            yield (gradients - there).reshape(-1, gradients.shape[-1])

    def _moved(self, generator: np.ndarray) -> np.ndarray:
        """J∇I (N, 2d) of the generator I = ½ zᵀA z + bᵀz."""
        slope = self._z @ generator[:, :-1].T + generator[:, -1]
        return slope @ symplectic_form(len(slope[0]) // 2).T


def _turned(sign: int, kind: Kind) -> int:
    """1 where the shape stays as it is as its argument turns to ``sign`` times it, -1 where it
    turns its sign, else 0."""
    return sign if sign >= 0 else parity(kind)


def _sign(x: np.ndarray, y: np.ndarray) -> int:
    """1 where y is x, -1 where it is −x, else 0."""
    most = _ROUNDED * np.abs(x).max()
    return int(np.abs(y - x).max() <= most) - int(np.abs(y + x).max() <= most)
