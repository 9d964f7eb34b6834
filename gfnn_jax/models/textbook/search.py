"""The search for a law of physics behind pairs, told nothing: H of few atoms.

The gradient of H is known at the midpoints of the pairs to second order in dt: −J(z₁ − z₀)/h. Atoms
are matched to it (`models.textbook.matching`) within a second; a law so found is put through its
flow, and what that misses of z₁ corrects the gradients: ∇H ← ∇H_law − J(z₁ − Φ_law(z₀))/h (deferred
correction). Of a law that is the right one, coefficients and constants converge to roundoff, by a
factor of about (ωh)² a time; others stall. That is how the right one is told from the others, and
the corrected gradients of the law that came closest are what the next round of matching is given.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.evidence import improved
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import beside
from gfnn_jax.flows.collocation import Steps, of_lanes
from gfnn_jax.models.textbook.atoms import Atom, complexity_of, constants_of, with_constants
from gfnn_jax.models.textbook.dictionary import Dictionary, Setting
from gfnn_jax.models.textbook.matching import Match, Matching
from gfnn_jax.phase_space import apply_j

_STEPS = Steps(6, 1)


class Options:
    """Tuned on the laws of benchmarks/textbook.py.

    rows: pairs that are looked at; quiet: the part of them that move least, which is used: their
    midpoints say more. atoms: of
    a law, beside the coordinates and products of two. rounds: of matching. finalists: matches that
    go through their flow; plainer: of them, that are tried in plainer shapes too. corrections: of
    gradients, at most; contracted: by which each must lower what is left over. roundoff: of the
    coordinates' sizes; a polynomial that leaves no more is exact. digits, digits_a_number: so is
    another law that leaves no more than 10 to the minus so many, and so many more for every
    coefficient and constant of its atoms, because sums of atoms that are not those of the law come
    nearer to it by about one digit each. lost: part of the
    pairs whose flow may fail. most_dim: degrees of freedom, beyond which the dictionary is too
    large. rows_per_term: that all products of coordinates need together. certain: twice the
    logarithm of the odds that what an atom explains is no chance. rounded: of a constant, that may
    be rounded away where the law stays as exact; shown: digits that it may then have, those of
    round numbers, and as many as keep roundoff. matched: of gradients, a match at roundoff;
    as_well: times what a match leaves over, below it a simpler one is looked at.
    """

    rows: int = 260
    quiet: float = 0.6
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
    rounded: float = 1e-8
    shown: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 13)
    matched: float = 1e-14
    as_well: float = 1e3


class Law(NamedTuple):
    """A family of terms of H, and forces where there are such, their coefficients, and the RMS of
    Φ(z₀) − z₁ ÷ scale."""

    family: Any
    coefficients: np.ndarray
    left: float


class _State(NamedTuple):
    """A match, its law, and the gradients that are as accurate as that law."""

    match: Match
    law: Law
    target: np.ndarray


class Textbook:
    """The search for the law of these rows of a problem's pairs, which have no args.

    angles, cyclic: indices of z. forces: of `Setting`. Raises ValueError for more degrees of
    freedom than ``Options.most_dim``.
    """

    def __init__(
        self,
        problem: Problem,
        rows: np.ndarray,
        *,
        angles: Sequence[int] = (),
        cyclic: Sequence[int] = (),
        forces: Callable[[Terms], Any] = lambda h: h,
        on_progress: Callable[[str], Any] = lambda message: None,
    ):
        dim = problem.z0.shape[1] // 2
        if dim > Options.most_dim:
            raise ValueError(f"expected at most {Options.most_dim} degrees of freedom, got {dim}")
        self._problem, self._on_progress = problem, on_progress
        rows = np.asarray(rows[: Options.rows])
        moved = np.linalg.norm((problem.z1 - problem.z0)[rows] / problem.scale, axis=1)
        self._rows = np.sort(rows[np.argsort(moved)[: int(np.ceil(Options.quiet * len(rows)))]])
        z0, self._z1 = problem.z0[self._rows], problem.z1[self._rows]
        dt = of_lanes(problem.dt, self._rows)
        self._h = dt[:, None] if np.ndim(dt) else dt
        self._middle, weight = 0.5 * (z0 + self._z1), 1.0 / np.roll(problem.scale, dim)
        self._setting = Setting(self._middle, weight, angles, cyclic, forces=forces)
        self.null = self._setting.null
        self._tried = 0  # atoms of the dictionary before
        self._target = -apply_j(self._z1 - z0) / self._h
        self._closest: _State | None = None  # of the laws that were not exact
        self._partial: list[_State] = []

    def law(self, *, products: bool = False, centres: bool = False) -> Law | None:
        """The plainest law whose flow takes z₀ to z₁, of a dictionary with products of shapes, with
        distances from other centres than the origin, or with neither; None where none is found."""
        setting = self._setting
        if centres and not any(argument.axes for argument in setting.arguments):
            return None
        blocks = [] if products or centres else setting.blocks()
        tops = [*setting.tops(), *setting.curved()] if products else []
        with np.errstate(all="ignore"):
            dictionary = setting.dictionary(products=products, centres=centres)
            tried, self._tried = self._tried, len(dictionary.atoms)
            if len(dictionary.atoms) == tried:  # products and centres have brought nothing
                return None
            found = self._found(dictionary, blocks, tops)
            return None if found is None else self._simplified(found).law

    @property
    def partial(self) -> list[Law]:
        """The three laws that came closest where none is exact, each of other terms."""
        kinds: dict[tuple, _State] = {}
        for state in sorted(self._partial, key=lambda s: s.law.left):
            kind = tuple(sorted(tuple(f.form for f in a) for a in state.match.atoms))
            kinds.setdefault(kind, state)
        return [state.law for state in list(kinds.values())[:3]]

    def asks_for(self, field: Callable[[np.ndarray], np.ndarray]) -> bool:
        """Return whether this field (N, 2d) of states explains more of what the closest law leaves
        over than it would of noise."""
        closest = min(self._partial, key=lambda s: s.law.left, default=None)
        if closest is None:
            return False
        column = beside(self._setting.spanned, self._setting.flat(field(self._middle)))
        own = Dictionary([], column[:, None] / np.linalg.norm(column))
        return self._certain(self._matching(closest.target).gains(closest.match, own), 1)

    def _matching(self, target: np.ndarray) -> Matching:
        return Matching(self._setting, (target * self._setting.weight).ravel())

    def _found(
        self,
        dictionary: Dictionary,
        blocks: list[tuple[Atom, ...]],
        starts: list[tuple[Atom, ...]],
    ) -> _State | None:
        """The simplest law of these atoms that is exact. blocks: of atoms that laws have together,
        tried as a whole; starts: others, beside which the search looks for more."""
        if self._closest is not None:
            gains = self._matching(self._closest.target).gains(self._closest.match, dictionary)
            if not self._certain(gains, len(dictionary.atoms)):
                return None  # what is left over is noise
        self._on_progress(f"H: trying {len(dictionary.atoms)} functions of laws of physics")
        most = self._middle.size / Options.rows_per_term - len(self._setting.base)
        blocks = [b for b in blocks if len(b) < most]
        target, last = self._target, np.inf
        for _ in range(Options.rounds):
            matching = self._matching(target)
            # The best matches, and plainer ones that leave hardly more.
            best = matching.best(dictionary, Options.atoms, starts)[: Options.finalists]
            plainer = [matching.plainer(m, dictionary) for m in best[: Options.plainer]]
            tried = list({m.atoms: m for m in [*plainer, *best]}.values())
            whole = sorted((matching.refined(b) for b in blocks), key=lambda m: m.left)
            tried += [m for m in whole if m.left < 10 * tried[0].left][:2]
            states = [s for m in tried for s in [self._converged(m, target)] if s is not None]
            exact = [s for s in map(self._without_spare, states) if self._is_exact(s)]
            if exact:
                return min(exact, key=lambda s: s.match.complexity)
            if not states:
                return None
            self._partial += states
            closest = min(states, key=lambda s: s.law.left)
            if not closest.law.left < Options.contracted * last:
                break
            target, last, self._closest = closest.target, closest.law.left, closest
        return None

    def _without_spare(self, state: _State) -> _State:
        """The law without the atoms that it does not need, where it leaves roundoff: beside spare
        atoms no law is told from an approximation, because no residual is below roundoff."""
        if state.law.left > Options.roundoff or self._is_exact(state):
            return state
        return self._simpler(state, 3 * Options.roundoff)

    def _is_exact(self, state: _State) -> bool:
        """Return whether the law is as exact as no approximation of so many numbers would be."""
        atoms = state.match.atoms
        if None not in map(self._setting.powers, atoms):
            return state.law.left <= Options.roundoff
        numbers = len(atoms) + sum(len(constants_of(a)) for a in atoms)
        digits = Options.digits + Options.digits_a_number * numbers
        return state.law.left <= 10.0**-digits

    def _certain(self, gains: np.ndarray, tried: int) -> bool:
        """Return whether the largest gain of so many atoms tried is no chance."""
        gain = min(gains.max(initial=0.0), 1 - 1e-12)
        chance = 2 * np.log(tried) + Options.certain
        return bool(-self._middle.size * np.log1p(-gain) >= chance)

    def _converged(self, match: Match, target: np.ndarray) -> _State | None:
        """The match with coefficients and constants as far as corrections lead; None where its
        flow fails."""
        best = None
        for _ in range(Options.corrections):
            found = self._corrected(match, target)
            if found is None:
                return best
            if best is not None and not found.law.left < Options.contracted * best.law.left:
                return best if best.law.left <= found.law.left else found
            best, target = found, found.target
            match = self._matching(target).refined(match.atoms)
        return best

    def _corrected(self, match: Match, target: np.ndarray) -> _State | None:
        """The law of these atoms with the coefficients that the gradients ask for, and the
        gradients as its flow corrects them; None where a constant has run away, or the flow fails.
        """
        try:
            family = self._setting.law(match.atoms)
        except InputError:
            return None
        columns = self._setting.columns(family)
        size = np.linalg.norm(columns, axis=0)
        if not np.isfinite(size).all():
            return None
        size = np.where(size > 0, size, 1.0)
        flat = (target * self._setting.weight).ravel()
        c = np.linalg.lstsq(columns / size, flat, rcond=1e-13)[0] / size
        images = self._problem.images(family, c, self._rows, _STEPS).states
        off = (images - self._z1) / self._problem.scale
        known = np.isfinite(off).all(axis=1)
        if np.mean(~known) > Options.lost:
            return None
        corrected = family.gradient(c, self._middle) - apply_j(self._z1 - images) / self._h
        corrected = np.where(known[:, None], corrected, target)
        return _State(match, Law(family, c, float(np.sqrt(np.mean(off[known] ** 2)))), corrected)

    # Simpler ways to say the same

    def _simplified(self, state: _State) -> _State:
        """The simplest law that is as exact: other atoms that match the corrected gradients, fewer
        of them, constants of fewer digits."""
        bound, most = 3 * max(state.law.left, Options.roundoff), min(3, len(state.match.atoms))
        others = self._matching(state.target).best(self._setting.dictionary(), most)
        return self._rounded(self._simpler(state, bound, others), bound)

    def _simpler(self, state: _State, bound: float, others: Sequence[Match] = ()) -> _State:
        """The law with other atoms that are simpler, and without the atoms, and their factors, that
        are not needed."""

        def simpler(state: _State) -> Iterator[Match]:
            yield from sorted(others, key=lambda match: match.complexity)
            for atoms in _shorter(state.match.atoms):
                if complexity_of(atoms) < state.match.complexity:
                    # spare atoms put the others' constants off
                    yield self._matching(state.target).refined(atoms)

        def changed(state: _State, match: Match) -> _State | None:
            as_well = match.left <= Options.as_well * max(state.match.left, Options.matched)
            simpler = match.complexity < state.match.complexity
            found = self._converged(match, state.target) if as_well and simpler else None
            return found if found is not None and found.law.left <= bound else None

        return improved(state, simpler, changed)

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
                    found = self._corrected(match, state.target)
                    if found and found.law.left <= max(bound / 3, 2 * state.law.left):
                        state = found
                        break
        return state


def _of_few_digits(constant: float) -> Iterator[float]:
    """Numbers near the constant, those of fewest digits first."""
    if abs(constant) < Options.rounded:
        yield 0.0
    for digits in Options.shown:
        rounded = float(f"{constant:.{digits}g}")
        if abs(rounded - constant) <= Options.rounded * abs(constant):
            yield rounded


def _shorter(atoms: tuple[Atom, ...]) -> Iterator[tuple[Atom, ...]]:
    """The atoms without one of them, or without one factor."""
    for i, atom in enumerate(atoms):
        rest = atoms[:i] + atoms[i + 1 :]
        yield rest
        if len(atom) > 1:
            for k in range(len(atom)):
                yield (*rest, atom[:k] + atom[k + 1 :])
