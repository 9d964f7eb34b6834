"""Laws that are one exchange away from a fit: up to two of its terms for up to two others.

The triangle of the arcs' residuals in all terms of a library (`fitting.linearised`) has the least
sum of squares of every set of them without another fit. Of the sets that are one exchange away
(Miller, Subset Selection in Regression, 1990) the likeliest by Schwarz's criterion are fitted to
arcs. A law with fewer terms is likely too where what leaves is not significant: the largest of many
terms that are not there stands three standard errors from zero. The plainest of those that are
likely takes the place of the fit; those that are as likely as the law in the end are its *rivals*.
A rival is lean: it holds no smaller rival as a special case, nor the law itself with terms beside
which its coefficients are as well known. It is another law: where a law with fewer terms, that the
sums of either hold, is likelier than both, as (v₁ + v₂)² + (v₁ − v₂)² is 2 v₁² + 2 v₂², they are
the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from itertools import combinations
from operator import le
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.friction import STRIBECK, kind_of
from gfnn_jax.families.text import in_letters
from gfnn_jax.fitting.evidence import Comparison, criterion
from gfnn_jax.fitting.significance import of_two
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.friction_choice import is_coupled, kinds_of
from gfnn_jax.models.lagrangians.libraries import FEW, feeds, together
from gfnn_jax.models.lagrangians.structure import Loss, Structure, is_constant
from gfnn_jax.models.lagrangians.weak_form import promising, protected


class Options:
    """Limits of an exchange (`benchmarks/certificates.py`).

    most: terms that leave, and that come. imitated: share of what a term does that the others do
    not, below which it does not come; same: below which they hold it as a special case. vague: of
    a coefficient, vaguer: times its standard error, by which that has to grow by further terms
    which make a rival of the law. screened: sets of each exchange that are looked at, and of all
    that are fitted: fitted. slack: of the criterion, by which arcs may differ from the triangle;
    far: the same where terms only leave, for laws along which masses and springs are nearly
    collinear are far apart. rounds: exchanges in a row. coloured: neighbours among which a residual
    counts as one, above which the residuals are motion that the law lacks: an exchange then leaves
    at most the share ``explained`` of the cost, or correlations over the share ``whiter`` of these
    other neighbours. listed: rivals, at most.
    """

    most: int = 2
    imitated: float = 1e-3
    same: float = 3e-5
    vague: float = 0.05
    vaguer: float = 3.0
    screened: int = 20
    fitted: int = 6
    slack: float = 3.0
    far: float = 200.0
    rounds: int = 4
    coloured: float = 2.0
    explained: float = 0.5
    whiter: float = 0.25
    listed: int = 5


_BEGUN = Options.screened * Options.fitted  # sets whose friction is looked at


class Exchanged(NamedTuple):
    """A fit with other terms, and by how much its criterion is above that of the fit before."""

    fit: LawFit
    above: float


def with_exchanges(fit: LawFit, every: Structure) -> LawFit:
    """The fit with terms (of ``every``) in place of as many or more of its own: the plainest of the
    fits against which the likeliest has no odds that decide, where held-out arcs do not lose."""
    deciding = fit.problem.options.evidence.deciding
    for _ in range(Options.rounds):
        near = [_leaner(one, fit) for one in _near(fit, every)]
        near = [one for one in near if len(one.fit.p) <= len(fit.p) and _explains(one, fit)]
        found = [Exchanged(fit, 0.0), *near]
        least = min(one.above for one in found)
        likely = [one for one in found if one.above < least + deciding]
        likely.sort(key=lambda one: (_plainness(one.fit), one.fit is not fit, one.above))
        before, fit = fit, next((one.fit for one in likely if _holds(one.fit, fit)), fit)
        if fit is before:
            break
        fit.problem.on_progress(f"  {other_terms(before, fit)}")
        fit = fit.again()
    return fit


def _explains(one: Exchanged, fit: LawFit) -> bool:
    """Return whether another fit explains much of the residuals of one, where these are correlated:
    of their squares, or of their correlation, as chance does not. One of as many terms that is
    plainer and likelier needs no more than that."""
    other = one.fit
    as_many = len(other.p) == len(fit.p)
    return (
        fit.correlation < Options.coloured
        or (as_many and one.above < 0 and _plainness(other) < _plainness(fit))
        or other.fitted.cost < Options.explained * fit.fitted.cost
        or other.correlation - 1 < Options.whiter * (fit.correlation - 1)
    )


def other_terms(fit: LawFit, other: LawFit) -> str:
    """The terms of another fit beside those of one: "with x⁴ in place of x⁶"."""
    come, gone = (
        ", ".join(in_letters(fit.problem.word(key)) for key in a.values if key not in b.values)
        for a, b in ((other, fit), (fit, other))
    )
    if not come:
        return f"without {gone}"
    return f"with {come} in place of {gone}" if gone else f"with {come} too"


def _leaner(one: Exchanged, fit: LawFit) -> Exchanged:
    """A likelier law of more terms than a fit has, without those that are not significant."""
    z, least = one.fit.significance, fit.problem.options.evidence.significant
    weak = {k for k in z if k[0] in ("term", "loss") and z[k] < least}
    weak -= protected(one.fit.structure)
    if len(one.fit.p) <= len(fit.p) or one.above > 0 or not weak:
        return one
    other = one.fit.again(one.fit.structure.without(weak), rescale=False)
    return _compared(other, fit) or one


def _compared(other: LawFit, fit: LawFit) -> Exchanged | None:
    """A fit beside another one; None where it is no law: M is not positive, or friction drives."""
    if not (may_be_chosen(other) and other.is_definite):
        return None
    above = other.criterion(fit.independent) - fit.criterion()
    return Exchanged(other, above - _for_fewer(fit, len(other.p)))


def _for_fewer(fit: LawFit, count: int) -> float:
    """The criterion's share for a law of ``count`` terms where these are fewer than those of a fit:
    one that is not significant may go, however few residuals there are."""
    evidence = fit.problem.options.evidence
    least = evidence.significant**2 - evidence.deciding - np.log(fit.independent)
    return max(0.0, float(least)) if count < len(fit.p) else 0.0


def _holds(other: LawFit, fit: LawFit) -> bool:
    """Return whether held-out arcs do not lose by another fit in place of one."""
    if other is fit:
        return True
    theirs = fit.cross_validate(other.structure, other.values)
    return not Comparison.of(theirs, fit.costs).is_higher()


def rivals(fit: LawFit, every: Structure) -> list[Exchanged]:
    """Lean laws of ``every`` against which a fit has no odds that decide, the likeliest first."""
    decide = fit.problem.options.evidence.deciding
    found = [one for one in _near(fit, every) if one.above < decide]
    return sorted(found, key=lambda one: one.above)[: Options.listed]


def leaves_open(fit: LawFit, rival: Exchanged) -> bool:
    """Return whether a rival leaves open which law it is: it is likelier than the law, or its
    friction is as plain and terms that it has more are as far from zero as chance does not make
    them. Less plain is friction of more kinds, of a rare kind, or of several speeds, which odds
    that decide are needed for (`friction_choice`). Stribeck's is a part of dry friction, whose
    coefficient is another one beside it: it leaves the law open where it is more than chance."""
    more = len(rival.fit.p) - len(fit.p)
    new = {row[1] for row in rival.fit.structure.friction if row not in fit.structure.friction}
    if new == {STRIBECK} and more == 1:
        evidence = fit.problem.options.evidence
        return bool(np.log(fit.independent) - rival.above > evidence.chance**2)
    unlikely = rival.above + more * _for_fewer(fit, len(fit.p) - more)
    kinds, others = (_oddness(one.structure.friction) for one in (fit, rival.fit))
    plain = all(map(le, others, kinds)) and unlikely < fit.problem.options.evidence.deciding
    return bool(plain or rival.above < 0)


def _oddness(friction: Sequence[Loss]) -> tuple[int, ...]:
    """The number of kinds of friction, of rare ones, and of those of several speeds."""
    rare = sum(kind_of(row[1]).rare for row in friction)
    return len(kinds_of(friction)), rare, sum(map(is_coupled, friction))


def may_be_chosen(fit: LawFit) -> bool:
    """Return whether the friction does not drive, and has no two kinds of which one stands for the
    other."""
    losses = {key[1]: value for key, value in fit.values.items() if key[0] == "loss"}
    kinds = {row[1] for row in losses}
    drives = min(losses.values(), default=0.0) < 0 or feeds(losses)
    return fit.follows and not drives and together(kinds)


def _plainness(fit: LawFit) -> tuple[int, ...]:
    """The number of terms, of masses that depend on position, of rare frictions; and the degree."""
    terms, friction = fit.structure.terms, fit.structure.friction
    return (
        len(fit.p),
        sum(any(row[0]) and not is_constant(row) for row in terms),
        sum(kind_of(row[1]).rare for row in friction),
        sum(sum(row[1]) for row in terms),
    )


def _near(fit: LawFit, every: Structure) -> list[Exchanged]:
    """Fits that are one exchange away, and about as likely as the likeliest by the triangle; a few
    of fewer terms that are not."""
    if not fit.follows:
        return []
    screen, deciding = _Screen.of(fit, every), fit.problem.options.evidence.deciding
    if not np.isfinite(screen.columns).all():
        return []  # a term of the library overflows along the arcs
    sets = screen.sets()
    likely = min([0.0, *(above for _, above in sets)]) + deciding
    fewer = [one for one, above in sets if one < screen.own and above < likely + Options.far]
    about = [
        one
        for one, above in sets
        if one not in fewer
        and above < likely + Options.slack
        and (above < -deciding or not screen.adds_little(one | screen.own))
    ]
    found: list[Exchanged] = []
    smaller: list[frozenset[int]] = []
    for some in (fewer, about):
        tried = 0
        for places in some:
            if any(one <= places for one in smaller) or screen.is_the_same(places):
                continue
            tried, other = tried + 1, screen.fitted(places)
            if other is not None:
                found.append(other)
                smaller += [places] if other.above < deciding else []
            if tried == Options.fitted:
                break
    return found


@dataclasses.dataclass(frozen=True, eq=False)
class _Screen:
    """The linearised problem of all terms: columns (m, n) of unit size, and the target (m,) that
    they explain. own: places of what the fit has; leave: of these, what may; come: what it lacks;
    count: residuals that are independent."""

    fit: LawFit
    larger: Structure
    columns: np.ndarray
    size: np.ndarray
    target: np.ndarray
    own: frozenset[int]
    leave: list[int]
    come: np.ndarray
    count: float

    @classmethod
    def of(cls, fit: LawFit, every: Structure) -> _Screen:
        every = promising(fit, dataclasses.replace(every, leaders=fit.structure.leaders))
        kinds = ("term", "loss") if fit.problem.options.choose_friction else ("term",)
        named = (k for k in every.keys() if k[0] in kinds and k not in fit.values)  # noqa: SIM118
        larger = fit.structure.plus([k for k in named if fit.structure.may_have(k)])
        near, keys, fixed = fit.problem.linearised(larger, fit), larger.keys(), protected(larger)
        size = np.linalg.norm(near.columns, axis=0)
        columns = near.columns / np.where(size > 0, size, 1.0)
        within = set(fit.structure.keys())
        own = [i for i, key in enumerate(keys) if key in within]
        return cls(
            fit,
            larger,
            columns,
            np.where(size > 0, size, 1.0),
            near.columns @ near.p + near.residual,
            frozenset(own),
            [i for i in own if keys[i][0] in kinds and keys[i] not in fixed],
            np.array([i for i in range(len(keys)) if i not in own and size[i] > 0], int),
            fit.independent,
        )

    def sets(self) -> list[tuple[frozenset[int], float]]:
        """Sets of places, and by how much their criterion is above that of the fit; the likeliest
        first. None has friction that drives."""
        rough: dict[frozenset[int], float] = {}
        for leaving in range(self.most + 1):
            for gone in combinations(self.leave, leaving):
                rough |= self._exchanges(self.own - set(gone))
        begun = sorted(rough, key=lambda one: rough[one])[:_BEGUN]
        begun += [one for one in rough if one < self.own]
        known = self._criterion(self.own, self._solved(self.own)[1])
        found = {
            places: left - known - _for_fewer(self.fit, len(places))
            for places, left in map(self._rubbing, begun)
        }
        found.pop(self.own, None)
        return sorted(found.items(), key=lambda one: one[1])

    @property
    def most(self) -> int:
        """Terms that leave, and that come; of many coordinates one, for pairs would be too many."""
        return Options.most if self.larger.dim <= FEW else 1

    @cached_property
    def _products(self) -> np.ndarray:
        """Products of the columns of what the fit lacks."""
        return self.columns[:, self.come].T @ self.columns[:, self.come]

    def _exchanges(self, kept: frozenset[int]) -> dict[frozenset[int], float]:
        """The likeliest sets of what is kept and up to two more, with their criterion."""
        basis = np.linalg.qr(self.columns[:, sorted(kept)])[0]
        shared = basis.T @ self.columns[:, self.come]
        rest = self.target - basis @ (basis.T @ self.target)
        new = self.columns[:, self.come] - basis @ shared
        size = np.linalg.norm(new, axis=0)
        some = np.flatnonzero(size > Options.imitated)
        shared, size, left = shared[:, some], size[some], float(rest @ rest)
        along = new[:, some].T @ rest / size
        gains = {(): 0.0} | {(k,): along[k] ** 2 for k in sorted(_largest(along**2, _BEGUN))}
        if self.most > 1:
            gains |= self._of_pairs(some, along, shared, size)
        come = self.come[some].tolist()
        found = {kept.union(come[k] for k in new): left - gain for new, gain in gains.items()}
        return {places: self._criterion(places, cost) for places, cost in found.items()}

    def _of_pairs(
        self, some: np.ndarray, along: np.ndarray, shared: np.ndarray, size: np.ndarray
    ) -> dict[tuple[int, int], float]:
        """The pairs that explain most, and the sum of squares that each explains."""
        apart = self._products[np.ix_(some, some)] - shared.T @ shared
        two = of_two(along, apart / np.outer(size, size), Options.imitated**2)
        rows = _largest(two.max(axis=1, initial=0.0), 2 * Options.screened)
        i, j = np.divmod(_largest(two[rows].ravel(), 2 * Options.screened), max(len(some), 1))
        pairs = {(min(one), max(one)) for one in zip(rows[i], j, strict=True) if np.ptp(one)}
        return {
            pair: float(two[pair]) for pair in sorted(pairs, key=lambda pair: (-two[pair], pair))
        }

    def _solved(self, places: frozenset[int]) -> tuple[np.ndarray, float]:
        """Coefficients of these places, in their order, and the sum of squares that they leave."""
        columns = self.columns[:, sorted(places)]
        found = np.linalg.lstsq(columns, self.target, rcond=None)[0]
        return found, float(np.sum((self.target - columns @ found) ** 2))

    def _criterion(self, places: frozenset[int], left: float) -> float:
        return criterion(left, self.count, len(places))

    def _rubbing(self, places: frozenset[int]) -> tuple[frozenset[int], float]:
        """The places without friction that would drive, the strongest first, and their
        criterion."""
        keys = self.larger.keys()
        while True:
            coefficients, left = self._solved(places)
            found = dict(zip(sorted(places), coefficients.tolist(), strict=True))
            driving = {i: c for i, c in found.items() if keys[i][0] == "loss" and c < 0}
            if not driving:
                return places, self._criterion(places, left)
            places = places - {min(driving, key=lambda i: driving[i])}

    def holds_law(self, places: frozenset[int]) -> bool:
        """Return whether these terms hold what the fit has as a special case."""
        gone = self.columns[:, sorted(self.own - places)]
        basis = np.linalg.qr(self.columns[:, sorted(places)])[0]
        return bool(np.all(np.linalg.norm(gone - basis @ (basis.T @ gone), axis=0) < Options.same))

    def is_the_same(self, places: frozenset[int]) -> bool:
        """Return whether these terms add little to the law; or a law of fewer terms, which is a sum
        of these as of those of the fit, is likelier than either."""
        if self.adds_little(places):
            return True
        own, other = (np.linalg.qr(self.columns[:, sorted(some)])[0] for some in (self.own, places))
        turn, cosines, _ = np.linalg.svd(own.T @ other)
        both = own @ turn[:, : np.count_nonzero(cosines > 1 - Options.same**2)]
        if both.shape[1] >= min(len(self.own), len(places)):
            return False
        left = float(np.sum((self.target - both @ (both.T @ self.target)) ** 2))
        shared = criterion(left, self.count, both.shape[1])
        some = (self.own, places)
        return all(shared < self._criterion(one, self._solved(one)[1]) for one in some)

    def adds_little(self, places: frozenset[int]) -> bool:
        """Return whether these terms hold the law, and leave the coefficients that both have about
        as well known; as they do where they are the law in other words."""
        if not self.holds_law(places):
            return False
        if len(places) == len(self.own):
            return True
        before, after = self._errors(self.own), self._errors(places)
        values = dict(zip(sorted(self.own), self._solved(self.own)[0], strict=True))
        return not any(
            after[i] > Options.vague * abs(values[i]) and after[i] > Options.vaguer * before[i]
            for i in self.leave
            if i in after
        )

    def _errors(self, places: frozenset[int]) -> dict[int, float]:
        """Standard errors of the coefficients of these places."""
        inverse = np.linalg.pinv(self.columns[:, sorted(places)])
        errors = np.sqrt(self.fit.correlation) * np.linalg.norm(inverse, axis=1)
        return dict(zip(sorted(places), errors.tolist(), strict=True))

    def fitted(self, places: frozenset[int]) -> Exchanged | None:
        """The fit of these terms to arcs; None where it is no law."""
        keys, ordered = self.larger.keys(), sorted(places)
        gone = {keys[i] for i in self.own - places}
        structure = self.fit.structure.without(gone).plus([keys[i] for i in places - self.own])
        values = self._solved(places)[0] / self.size[ordered]
        known = {keys[i]: float(value) for i, value in zip(ordered, values, strict=True)}
        other = self.fit.again(structure, known, rescale=False)
        return _compared(other, self.fit)


def _largest(values: np.ndarray, count: int) -> np.ndarray:
    """Places of the largest values (n,), at most so many."""
    every = np.arange(len(values))
    return every if len(every) <= count else np.argpartition(-values, count)[:count]
