"""Orthogonal matching: the few atoms of a dictionary whose gradients add up to given ones.

Columns are gradients at all states, each component in its unit, as one vector. What the chosen
columns span is projected out of the dictionary; the next atom, or pair of atoms, is the one that
explains most of what is left. A few states of the search go on side by side (a beam), because two
atoms may explain together what neither explains alone. Constants inside atoms are then refined by
Gauss–Newton with the coefficients projected out (variable projection; Golub & Pereyra 1973).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np

from gfnn_jax.fitting.significance import beside, of_two
from gfnn_jax.models.textbook.atoms import (
    Atom,
    complexity_of,
    constants_of,
    gradient_of,
    with_constants,
)
from gfnn_jax.models.textbook.dictionary import Dictionary, Setting
from gfnn_jax.solve.levenberg_marquardt import Factors, Tried, descended


class Options:
    """Tuned on the laws of benchmarks/textbook.py.

    beam: states that go on. paired: atoms, those that explain most, whose pairs are tried.
    branches: atoms, and pairs of them, that each state is continued by, of so many looked_at.
    independent: of a column, that those before it do not span; alike: of its square, that another
    does not. hardly: times what a match leaves over, that a plainer one may leave. refinements:
    Gauss–Newton steps of inner constants. gained: of what is left over, a step that gains less is
    the last. farthest: of the distances, by which a centre moves in a step. floor: of what is left
    over, below it is roundoff. penalty: halvings of what is left over that a unit of complexity
    must bring, of clean pairs.
    """

    beam: int = 4
    paired: int = 160
    branches: int = 4
    looked_at: int = 240
    independent: float = 1e-5
    alike: float = 1e-7
    hardly: float = 4.0
    refinements: int = 8
    gained: float = 1e-3
    farthest: float = 0.2
    floor: float = 1e-13
    penalty: float = 0.5


_DAMPING = Factors(first=1e-2, shrunk_by=0.1, least=5e-4, trials=4)  # of inner constants


@dataclasses.dataclass(frozen=True)
class Match:
    """Atoms beside the base and what they leave over: the RMS, as a part of the target's."""

    atoms: tuple[Atom, ...]
    left: float

    @property
    def complexity(self) -> float:
        """Complexity of the atoms."""
        return complexity_of(self.atoms)


class _Left(NamedTuple):
    """Residual of the target beside base and atoms, an orthonormal basis of them, and the atoms'
    columns, divided by their sizes and without the base, and these sizes; None where a column has
    an entry that is not finite."""

    residual: np.ndarray
    basis: np.ndarray
    own: tuple[np.ndarray, np.ndarray] | None = None


class Matching:
    """The search for atoms that, beside the base of a setting, have this gradient.

    target: (rows,), weighted. penalty: halvings of what is left over that a unit of complexity must
    bring.
    """

    def __init__(self, setting: Setting, target: np.ndarray, penalty: float = Options.penalty):
        self.setting, self.arguments, self.base = setting, setting.arguments, setting.spanned
        self.target, self._penalty = target, penalty
        self.size = float(np.linalg.norm(target))
        self._beside_base = target - self.base @ (self.base.T @ target)
        self._last: tuple[Sequence[Atom], _Left] | None = None

    def residual_of(self, atoms: Sequence[Atom]) -> float:
        """The part of the target that base and atoms do not explain."""
        return float(np.linalg.norm(self._residual(atoms).residual)) / self.size

    def best(
        self, dictionary: Dictionary, most: int, starts: Sequence[tuple[Atom, ...]] = ()
    ) -> list[Match]:
        """The matches of each number of atoms up to ``most`` that the search went on with, the
        cheapest to say for what they leave over first. starts: atoms that it begins with too,
        beside none."""
        beam = [self.refined(atoms) for atoms in ((), *starts)]
        found = {frozenset(match.atoms): match for match in beam}
        for _ in range(most):
            grown: dict[frozenset[Atom], Match] = {}
            for match in beam:
                if len(match.atoms) < most:
                    for more in self._continued(match, dictionary, most):
                        refined = self.refined(match.atoms + more)
                        grown.setdefault(frozenset(refined.atoms), refined)
            if not grown:
                break
            beam = sorted(grown.values(), key=self.cost)[: Options.beam]
            found.update({frozenset(m.atoms): m for m in beam})
        return sorted(found.values(), key=self.cost)

    def cost(self, match: Match) -> float:
        """The logarithm of what is left over, and the penalty on the complexity of the atoms."""
        left = np.log2(max(match.left, Options.floor))
        return float(left + self._penalty * match.complexity)

    def plainer(self, match: Match, dictionary: Dictionary) -> Match:
        """The match with each atom, in turn, in a plainer shape of the same argument, where that
        leaves hardly more: what is left over is not yet that of the pairs."""
        for i in range(len(match.atoms)):
            own = complexity_of(match.atoms[i : i + 1])
            tried = self._exchanged(match, i, dictionary, lambda a, s=own: complexity_of((a,)) < s)
            if tried:
                best = min(tried, key=self.cost)
                match = best if best.left < Options.hardly * match.left else match
        return match

    def exchanged(self, match: Match, dictionary: Dictionary) -> list[Match]:
        """The match with each of its atoms, in turn, in other shapes of the same argument that are
        no longer to say: what is next to a law that is as likely."""
        found = []
        for i in range(len(match.atoms)):
            most = complexity_of(match.atoms[i : i + 1])
            own = tuple(f.kind for f in match.atoms[i])

            def allowed(atom: Atom, own=own, most=most) -> bool:
                return tuple(f.kind for f in atom) != own and complexity_of((atom,)) <= most

            found += self._exchanged(match, i, dictionary, allowed)
        return found

    def _exchanged(
        self, match: Match, i: int, dictionary: Dictionary, allowed: Callable[[Atom], bool]
    ) -> list[Match]:
        """The match with another shape of the i-th atom's argument: the few that explain most."""
        others, near = match.atoms[:i] + match.atoms[i + 1 :], dictionary.atoms
        places = [f.place for f in match.atoms[i]]
        own = [j for j, a in enumerate(near) if [f.place for f in a] == places and allowed(a)]
        residual, basis, *_ = self._residual(others)
        if not own or not np.isfinite(residual).all():
            return []
        part, _ = self._parts(residual, basis, dictionary.columns[:, own])
        first = _apart((near[own[k]],) for k in np.argsort(-(part**2)))
        return [self.refined((*others, *atom)) for atom in first]

    def refined(self, atoms: tuple[Atom, ...]) -> Match:
        """The match with the inner constants that leave least."""
        inner = [(i, k) for i, atom in enumerate(atoms) for k in range(len(constants_of(atom)))]
        left = self.residual_of(atoms)
        if not inner:
            return Match(atoms, left)
        start = _AtConstants(self, tuple(inner), Match(atoms, left))
        return descended(start, _DAMPING, Options.refinements).problem.match

    def slopes(self, match: Match, inner: Sequence[tuple[int, int]]):
        """(residual, its slopes (rows, n) in these constants with base and coefficients
        projected out)."""
        left = self._residual(match.atoms)
        coefficients = self._coefficients(left, len(match.atoms))
        columns = [coefficients[i] * self._column(match.atoms[i], along=k) for i, k in inner]
        slopes = np.stack(columns, axis=1)
        return left.residual, slopes - left.basis @ (left.basis.T @ slopes)

    def _column(self, atom: Atom, along: int | None = None) -> np.ndarray:
        """(rows,): the weighted gradient of an atom, or its derivative in one of its constants."""
        return self.setting.flat(gradient_of(atom, self.arguments, along))

    def _residual(self, atoms: Sequence[Atom]) -> _Left:
        """Residual beside the base and these atoms. The last is kept: the next step starts from the
        one just tried."""
        if self._last is None or self._last[0] != atoms:
            self._last = atoms, self._projected(atoms)
        return self._last[1]

    def _projected(self, atoms: Sequence[Atom]) -> _Left:
        if not atoms:
            return _Left(self._beside_base, self.base)
        with np.errstate(all="ignore"):
            columns = np.stack([self._column(atom) for atom in atoms], axis=1)
        if not np.isfinite(columns).all():
            return _Left(np.full_like(self.target, np.inf), self.base)
        size = np.linalg.norm(columns, axis=0)
        size = np.where(size > 0, size, 1.0)
        part = beside(self.base, columns / size)
        q, r = np.linalg.qr(part)
        basis = np.hstack([self.base, q[:, np.abs(np.diag(r)) > 1e-12]])
        return _Left(beside(basis, self._beside_base), basis, (part, size))

    def _coefficients(self, left: _Left, count: int) -> np.ndarray:
        """Coefficients (count,) of the atoms; 0 where a column has an entry that is not finite."""
        if left.own is None:
            return np.zeros(count)
        part, size = left.own
        return np.linalg.lstsq(part, self._beside_base, rcond=1e-13)[0] / size

    def _continued(self, match: Match, dictionary: Dictionary, most: int) -> list[tuple[Atom, ...]]:
        """The atoms, and pairs of atoms, that explain most of what a match leaves over."""
        residual, basis, *_ = self._residual(match.atoms)
        if not np.isfinite(residual).all():
            return []
        own, columns = basis[:, self.base.shape[1] :], dictionary.columns
        part, size = self._parts(residual, own, columns)
        independent, gain = size > Options.independent, part**2
        atoms = dictionary.atoms
        found = _apart((atoms[i],) for i in np.argsort(-gain))
        if len(match.atoms) + 2 > most:
            return found
        top = np.argsort(-gain)[: Options.paired]
        top = top[independent[top]]
        unit = (columns[:, top] - own @ (own.T @ columns[:, top])) / size[top]
        both = of_two(part[top], unit.T @ unit, Options.alike)
        order = np.argsort(-np.triu(both, 1), axis=None)
        pairs = (tuple(atoms[top[i]] for i in divmod(int(k), len(top))) for k in order)
        return found + _apart(pairs)

    def gains(self, match: Match, dictionary: Dictionary) -> np.ndarray:
        """(atoms,): the part of the square of what a match leaves over that each atom explains."""
        residual, basis, *_ = self._residual(match.atoms)
        part, _ = self._parts(residual, basis[:, self.base.shape[1] :], dictionary.columns)
        return part**2 / max(float(residual @ residual), 1e-300)

    @staticmethod
    def _parts(residual, own: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual's components along the columns without what ``own`` spans of them, 0
        where little of a column is left, and the lengths that are left. Columns are without the
        base already."""
        size = np.sqrt(np.maximum(1 - np.sum((own.T @ columns) ** 2, axis=0), 0.0))
        large = size > Options.independent
        return np.where(large, residual @ columns / np.where(large, size, 1.0), 0.0), size

    def moved(self, atoms: tuple[Atom, ...], step: np.ndarray) -> tuple[Atom, ...]:
        """The atoms with their constants a step on. No θ more than doubles, or changes its sign; a
        centre moves by no more than a part of the distances from it."""
        changes, found = iter(step.tolist()), []
        for atom in atoms:
            moved = []
            for factor in atom:
                if factor.theta is not None:
                    moved.append(
                        factor.theta
                        + np.clip(next(changes), -0.7 * abs(factor.theta), abs(factor.theta))
                    )
                far = Options.farthest * np.abs(self.arguments[factor.place].value).max()
                moved += [c + np.clip(next(changes), -far, far) for c in factor.centre]
            found.append(with_constants(atom, map(float, moved)))
        return tuple(found)


@dataclasses.dataclass(frozen=True)
class _AtConstants:
    """A match whose inner constants descend; ``inner``: (atom, factor) of each. Its cost is what
    is left over."""

    matching: Matching
    inner: tuple[tuple[int, int], ...]
    match: Match

    @cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Residual, the scaled slopes and their sizes; None where a slope is no number."""
        residual, slopes = self.matching.slopes(self.match, self.inner)
        size = np.linalg.norm(slopes, axis=0)
        sound = np.isfinite(slopes).all() and np.isfinite(residual).all() and (size > 0).all()
        return (residual, slopes / size, size) if sound else None

    def tried(self, damping: float, failures: int) -> Tried:
        """The match with the constants of a step."""
        if self._linear is None:
            return Tried(None, np.nan, damping, hopeless=True)
        residual, slopes, size = self._linear
        rows = np.vstack([slopes, damping * np.eye(len(size))])
        step = np.linalg.lstsq(rows, np.append(residual, np.zeros(len(size))), rcond=1e-12)[0]
        atoms = self.matching.moved(self.match.atoms, step / size)
        there = Match(atoms, self.matching.residual_of(atoms))
        return Tried(there, self.match.left - there.left, damping)

    def moved(self, there: Match, damping: float) -> tuple[_AtConstants, bool]:
        """The match of a step; settled where it gained little."""
        settled = 1 - there.left / self.match.left < Options.gained
        return dataclasses.replace(self, match=there), settled


def _apart(found: Iterable[tuple[Atom, ...]]) -> list[tuple[Atom, ...]]:
    """The first of each kind of atoms, whatever their constants: few of them."""
    kinds: dict[tuple, tuple[Atom, ...]] = {}
    for atoms in islice(found, Options.looked_at):
        kinds.setdefault(tuple(tuple(f.form for f in atom) for atom in atoms), atoms)
        if len(kinds) == Options.branches:
            break
    return list(kinds.values())
