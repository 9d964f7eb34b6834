"""The search for a law of physics behind pairs, told nothing: H of few atoms.

The gradient of H is known at the midpoints of the pairs to second order in dt: −J(z₁ − z₀)/h. Atoms
are matched to it (`models.textbook.matching`) within a second; a law so found is put through its
flow, and what that misses of z₁ corrects the gradients: ∇H ← ∇H_law − J(z₁ − Φ_law(z₀))/h (deferred
correction). Of a law that is the right one, coefficients and constants converge to roundoff, by a
factor of about (ωh)² a time; others stall. That is how the right one is told from the others, and
the corrected gradients of the law that came closest are what the next round of matching is given.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.diagnosis.symmetries import SymmetryOfPairs
from gfnn_jax.errors import InputError
from gfnn_jax.families.terms import Terms, given_terms, joined, polynomial_terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.flows.collocation import Steps, of_lanes
from gfnn_jax.models.textbook.arguments import arguments_of
from gfnn_jax.models.textbook.atoms import (
    Atom,
    Dictionary,
    atom_text,
    blocks_of,
    complexity_of,
    constants_of,
    dictionary_of,
    powers_of,
    tops_of,
    with_constants,
)
from gfnn_jax.models.textbook.invariance import Invariance
from gfnn_jax.models.textbook.matching import Match, Matching, orthonormal
from gfnn_jax.phase_space import apply_j

_STEPS = Steps(6, 1)
_ROUNDED = 1e-8  # of a constant, that may be rounded away where the law stays as exact
_MATCHED = 1e-14  # of gradients: a match at roundoff
_AS_WELL = 1e3  # times what a match leaves over: below it a simpler one is looked at


@dataclasses.dataclass(frozen=True)
class TextbookOptions:
    """Tuned on the laws of benchmarks/textbook.py.

    rows: pairs that are looked at; quiet: the part of them that move least, which is used: their
    midpoints say more. degrees: of products of coordinates, by degrees of freedom from 1. atoms: of
    a law, beside the coordinates and products of two. rounds: of matching. finalists: matches that
    go through their flow; plainer: of them, that are tried in plainer shapes too. corrections: of
    gradients, at most; contracted: by which each must lower what is left over. roundoff: of the
    coordinates' sizes; a polynomial that leaves no more is exact. digits, digits_a_number: so is
    another law that leaves no more than 10 to the minus so many, and so many more for every
    coefficient and constant of its atoms, because sums of atoms that are not those of the law come
    nearer to it by about one digit each. lost: part of the
    pairs whose flow may fail. most_dim: degrees of freedom, beyond which the dictionary is too
    large. rows_per_term: that all products of coordinates need together. certain: twice the
    logarithm of the odds that what an atom explains is no chance.
    """

    rows: int = 260
    quiet: float = 0.6
    degrees: tuple[int, ...] = (6, 4, 4)
    atoms: int = 5
    rounds: int = 4
    finalists: int = 6
    plainer: int = 2
    corrections: int = 30
    contracted: float = 0.6
    roundoff: float = 1e-13
    digits: float = 6.0
    digits_a_number: float = 1.25
    lost: float = 0.1
    most_dim: int = 4
    rows_per_term: float = 1.6
    certain: float = 10.0


OPTIONS = TextbookOptions()


class Law(NamedTuple):
    """A family of terms of H, their coefficients, and the RMS of Φ(z₀) − z₁ ÷ scale."""

    family: Terms
    coefficients: np.ndarray
    left: float


class _State(NamedTuple):
    """A match, its law, and the gradients that are as accurate as that law."""

    match: Match
    law: Law
    target: np.ndarray


class Textbook:
    """The search for the law of these rows of a problem's pairs, which have no args.

    angles, cyclic: indices of z. symmetries: of the pairs; only what has them by itself is tried.
    null: the coordinates and products of two that the states do not tell from those before.
    Raises ValueError for more degrees of freedom than ``OPTIONS.most_dim``.
    """

    def __init__(
        self,
        problem: Problem,
        rows: np.ndarray,
        *,
        angles: Sequence[int] = (),
        cyclic: Sequence[int] = (),
        on_progress: Callable[[str], Any] = lambda message: None,
        symmetries: Sequence[SymmetryOfPairs] = (),
    ):
        dim = problem.z0.shape[1] // 2
        if dim > OPTIONS.most_dim:
            raise ValueError(f"expected at most {OPTIONS.most_dim} degrees of freedom, got {dim}")
        self._problem, self._on_progress, self._dim = problem, on_progress, dim
        rows = np.asarray(rows[: OPTIONS.rows])
        moved = np.linalg.norm((problem.z1 - problem.z0)[rows] / problem.scale, axis=1)
        self._rows = np.sort(rows[np.argsort(moved)[: int(np.ceil(OPTIONS.quiet * len(rows)))]])
        z0, z1 = problem.z0[self._rows], problem.z1[self._rows]
        dt = of_lanes(problem.dt, self._rows)
        self._h = dt[:, None] if np.ndim(dt) else dt
        self._z1, self._middle = z1, 0.5 * (z0 + z1)
        self._weight = 1.0 / np.roll(problem.scale, dim)
        self._arguments = arguments_of(self._middle, tuple(angles), tuple(cyclic))
        every = polynomial_terms(dim, 2, cyclic=(*angles, *cyclic))
        kept, null = null_terms(every, self._middle)
        self._base, self.null = every.take(kept), tuple(every.term_names[j] for j in null)
        given = self._middle, self._arguments, tuple(angles), tuple(cyclic)
        self._invariance = Invariance(symmetries, *given)
        self._tried = 0  # atoms of the dictionary before
        if self._invariance:
            self._base = self._base.take(self._invariance.terms(self._base))
        columns = self._base.term_gradients(self._middle) * self._weight[:, None]
        self._spanned = orthonormal(columns.reshape(-1, columns.shape[-1]))
        self._target = -apply_j(z1 - z0) / self._h
        self._closest: _State | None = None  # of the laws that were not exact
        self._partial: list[_State] = []

    @property
    def symmetric(self) -> bool:
        """Return whether symmetries have left atoms out."""
        return bool(self._invariance)

    def law(self, *, products: bool = False, centres: bool = False) -> Law | None:
        """The plainest law whose flow takes z₀ to z₁, of a dictionary with products of shapes, with
        distances from other centres than the origin, or with neither; None where none is found."""
        if centres and not any(argument.axes for argument in self._arguments):
            return None
        blocks = [] if products or centres else blocks_of(self._arguments, self._degree)
        tops = tops_of(self._arguments) if products else []
        with np.errstate(all="ignore"):
            dictionary = self._dictionary(products, centres)
            tried, self._tried = self._tried, len(dictionary.atoms)
            if len(dictionary.atoms) == tried:  # products and centres have brought nothing
                return None
            found = self._found(dictionary, self._allowed(blocks), self._allowed(tops))
            return None if found is None else self._simplified(found).law

    @property
    def partial(self) -> list[Law]:
        """The three laws that came closest where none is exact, each of other terms."""
        kinds: dict[tuple, _State] = {}
        for state in sorted(self._partial, key=lambda s: s.law.left):
            kind = tuple(sorted(tuple(f.form for f in a) for a in state.match.atoms))
            kinds.setdefault(kind, state)
        return [state.law for state in list(kinds.values())[:3]]

    @property
    def _degree(self) -> int:
        degrees = OPTIONS.degrees
        return degrees[self._dim - 1] if self._dim <= len(degrees) else 3

    def _dictionary(self, products: bool = False, centres: bool = False) -> Dictionary:
        return dictionary_of(
            self._arguments,
            self._weight,
            self._spanned,
            degree=self._degree,
            products=products,
            centres=centres,
            allowed=self._invariance.of_atom if self._invariance else None,
        )

    def _allowed(self, blocks: list[tuple[Atom, ...]]) -> list[tuple[Atom, ...]]:
        """The atoms of these that have the symmetries."""
        if not self._invariance:
            return blocks
        kept = (tuple(filter(self._invariance.of_atom, block)) for block in blocks)
        return list(dict.fromkeys(block for block in kept if block))

    def _matching(self, target: np.ndarray) -> Matching:
        flat = (target * self._weight).ravel()
        return Matching(self._spanned, flat, self._weight, self._arguments)

    def _found(
        self,
        dictionary: Dictionary,
        blocks: list[tuple[Atom, ...]],
        starts: list[tuple[Atom, ...]],
    ) -> _State | None:
        """The simplest law of these atoms that is exact. blocks: of atoms that laws have together,
        tried as a whole; starts: others, beside which the search looks for more."""
        if self._closest is not None and self._explains_nothing(self._closest, dictionary):
            return None  # what is left over is noise
        self._on_progress(f"H: trying {len(dictionary.atoms)} functions of laws of physics")
        rows = self._middle.size
        most = rows / OPTIONS.rows_per_term - self._base.num_parameters
        blocks = [b for b in blocks if len(b) < most]
        target, last = self._target, np.inf
        for _ in range(OPTIONS.rounds):
            matching = self._matching(target)
            tried = self._finalists(matching, dictionary, starts)
            whole = sorted((matching.refined(b) for b in blocks), key=lambda m: m.left)
            tried += [m for m in whole if m.left < 10 * tried[0].left][:2]
            states = [s for m in tried for s in [self._converged(m, target)] if s is not None]
            exact = [s for s in map(self._without_spare, states) if self._is_exact(s)]
            if exact:
                return min(exact, key=lambda s: complexity_of(s.match.atoms))
            if not states:
                return None
            self._partial += states
            best = min(states, key=lambda s: s.law.left)
            if not best.law.left < OPTIONS.contracted * last:
                break
            target, last, self._closest = best.target, best.law.left, best
        return None

    def _without_spare(self, state: _State) -> _State:
        """The law without the atoms that it does not need, where it leaves roundoff: beside spare
        atoms no law is told from an approximation, because no residual is below roundoff."""
        if state.law.left > OPTIONS.roundoff or self._is_exact(state):
            return state
        return self._fewer(state, 3 * OPTIONS.roundoff)

    def _is_exact(self, state: _State) -> bool:
        """Return whether the law is as exact as no approximation of so many numbers would be."""
        width = 2 * self._dim
        others = [a for a in state.match.atoms if powers_of(a, self._arguments, width) is None]
        if not others:
            return state.law.left <= OPTIONS.roundoff
        numbers = len(state.match.atoms) + sum(len(constants_of(a)) for a in others)
        digits = OPTIONS.digits + OPTIONS.digits_a_number * numbers
        return state.law.left <= 10.0**-digits

    def _explains_nothing(self, state: _State, dictionary: Dictionary) -> bool:
        """Return whether no atom explains more of what is left over than it would of noise."""
        gain = self._matching(state.target).gains(state.match, dictionary).max(initial=0.0)
        chance = 2 * np.log(len(dictionary.atoms)) + OPTIONS.certain
        return bool(-self._middle.size * np.log1p(-min(gain, 1 - 1e-12)) < chance)

    def _finalists(
        self, matching: Matching, dictionary: Dictionary, starts: list[tuple[Atom, ...]]
    ) -> list[Match]:
        """The best matches, and plainer ones that leave hardly more."""
        tried = matching.best(dictionary, OPTIONS.atoms, starts)[: OPTIONS.finalists]
        plainer = [matching.plainer(m, dictionary) for m in tried[: OPTIONS.plainer]]
        return list({m.atoms: m for m in [*plainer, *tried]}.values())

    def _converged(self, match: Match, target: np.ndarray) -> _State | None:
        """The match with coefficients and constants as far as corrections lead; None where its
        flow fails."""
        best = None
        for _ in range(OPTIONS.corrections):
            law, corrected = self._corrected(match, target)
            if law is None:
                return best
            if best is not None and not law.left < OPTIONS.contracted * best.law.left:
                return best if best.law.left <= law.left else _State(match, law, corrected)
            best, target = _State(match, law, corrected), corrected
            match = self._matching(target).refined(match.atoms)
        return best

    def _corrected(self, match: Match, target: np.ndarray) -> tuple[Law | None, np.ndarray]:
        """The law of these atoms with the coefficients that the gradients ask for, and the
        gradients as its flow corrects them."""
        try:
            family = self._family(match.atoms)
        except InputError:  # a constant that has run away
            return None, target
        columns = family.term_gradients(self._middle) * self._weight[:, None]
        columns = columns.reshape(-1, columns.shape[-1])
        size = np.linalg.norm(columns, axis=0)
        if not np.isfinite(size).all():
            return None, target
        size = np.where(size > 0, size, 1.0)
        flat = (target * self._weight).ravel()
        c = np.linalg.lstsq(columns / size, flat, rcond=1e-13)[0] / size
        images = self._problem.images(family, c, self._rows, _STEPS).states
        off = (images - self._z1) / self._problem.scale
        known = np.isfinite(off).all(axis=1)
        if np.mean(~known) > OPTIONS.lost:
            return None, target
        corrected = family.gradient(c, self._middle) - apply_j(self._z1 - images) / self._h
        corrected = np.where(known[:, None], corrected, target)
        return Law(family, c, float(np.sqrt(np.mean(off[known] ** 2)))), corrected

    def _family(self, atoms: Sequence[Atom]) -> Terms:
        """Terms of the coordinates, products of two, and these atoms."""
        width = 2 * self._dim
        rows, texts = [], []
        for atom in atoms:
            row = powers_of(atom, self._arguments, width)
            if row is None:
                texts.append(atom_text(atom, self._arguments))
            else:
                rows.append(row)
        family = self._base
        if rows:
            names = polynomial_terms(self._dim, 1).variables
            family = joined(family, Terms(self._dim, names, tuple(dict.fromkeys(rows))))
        return joined(family, given_terms(self._dim, texts)) if texts else family

    # Simpler ways to say the same

    def _simplified(self, state: _State) -> _State:
        """The simplest law that is as exact: other atoms that match the corrected gradients, fewer
        of them, constants of fewer digits."""
        dictionary = self._dictionary()
        matching = self._matching(state.target)
        bound = 3 * max(state.law.left, OPTIONS.roundoff)
        simpler = [
            m
            for m in matching.best(dictionary, min(3, len(state.match.atoms)))
            if m.left <= _AS_WELL * max(state.match.left, _MATCHED)
        ]
        for match in sorted(simpler, key=lambda m: complexity_of(m.atoms)):
            if complexity_of(match.atoms) >= complexity_of(state.match.atoms):
                break
            found = self._converged(match, state.target)
            if found is not None and found.law.left <= bound:
                state = found
                break
        state = self._fewer(state, bound)
        return self._rounded(state, bound)

    def _fewer(self, state: _State, bound: float) -> _State:
        """Drop the atoms, and their factors, that are not needed."""
        matching = self._matching(state.target)
        for atoms in _shorter(state.match.atoms):
            if complexity_of(atoms) >= complexity_of(state.match.atoms):
                continue
            if matching.residual_of(atoms) > _AS_WELL * max(state.match.left, _MATCHED):
                continue
            found = self._converged(matching.refined(atoms), state.target)
            if found is not None and found.law.left <= bound:
                return self._fewer(found, bound)
        return state

    def _rounded(self, state: _State, bound: float) -> _State:
        """Round each constant to as few digits as leave the law as exact."""
        for i, atom in enumerate(state.match.atoms):
            for k, constant in enumerate(constants_of(atom)):
                for rounded in _of_few_digits(constant):
                    atoms = list(state.match.atoms)
                    inner = constants_of(atoms[i])
                    inner[k] = rounded
                    atoms[i] = with_constants(atom, inner)
                    match = Match(tuple(atoms), state.match.left)
                    law, corrected = self._corrected(match, state.target)
                    if law is not None and law.left <= max(bound / 3, 2 * state.law.left):
                        state = _State(match, law, corrected)
                        break
        return state


def _of_few_digits(constant: float) -> Iterator[float]:
    """Numbers near the constant, those of fewest digits first."""
    if abs(constant) < _ROUNDED:
        yield 0.0
    for digits in range(1, 13):
        rounded = float(f"{constant:.{digits}g}")
        if abs(rounded - constant) <= _ROUNDED * abs(constant):
            yield rounded


def _shorter(atoms: tuple[Atom, ...]) -> Iterator[tuple[Atom, ...]]:
    """The atoms without one of them, or without one factor."""
    for i, atom in enumerate(atoms):
        rest = atoms[:i] + atoms[i + 1 :]
        yield rest
        if len(atom) > 1:
            for k in range(len(atom)):
                yield (*rest, atom[:k] + atom[k + 1 :])
