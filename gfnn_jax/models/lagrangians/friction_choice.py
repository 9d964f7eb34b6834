"""Choice of the friction that data show: held-out arcs, or pairs, say, and with what odds.

Close to a fit its residuals are linear in small changes of the coefficients, so that one evaluation
of the arcs serves every set of frictions: of each set all coefficients of the law are found from
some of the arcs by least squares with ρ ≥ 0, and judged by the others, of which the states alone
are found anew: a friction of a wrong kind spoils the masses and forces that are fitted with it. A
third of the record is held out at a time: where motion dies down, friction of a wrong kind that
fits large swings misses the small ones.

Two sets A and B are compared by their held-out sums of squares S. The scale of the residuals is
found from them as well, so that the odds of B, residuals being normal, are

    (S_A / S_B)^(N / 2τ),

where of N residuals those that are correlated, over τ samples, count once. Of the sets against
which the best has odds of less than 20 the one with the fewest kinds is taken: uniform friction,
which has one coefficient and keeps a multiple of the symplectic form, before linear friction, and
that before isotropic drag, quadratic and dry friction. Uniform friction is tried beside linear
friction, and isotropic drag beside quadratic friction, only where both are asked for. Rare kinds,
cubic, one-sided, Stribeck's and that by a load or by the place, come last: one of them beside the
others, or in place of one, where that has odds of 20 against the set without it, by held-out arcs
and by Schwarz's criterion of all.

Odds alone let chance in: a direction that is not there takes up a part of what the other
coefficients miss on the arcs that they are not from. Where there is a choice, a set is therefore
taken only where each of its coefficients, found from all arcs, is seen: it lowers Schwarz's
criterion, which of n independent residuals, n large, asks for z² > log n, z in standard errors.
Chance can still hide friction that is there, where held-out arcs are those that alone determine
another coefficient. So can thirds of a short record, too short for what adds up over all of it: the
search asks its whole arcs (`search`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    PLACED,
    POWER,
    QUADRATIC,
    STRIBECK,
    UNIFORM,
    Friction,
    kind_of,
)
from gfnn_jax.families.text import in_letters
from gfnn_jax.fitting.evidence import EVIDENCE, correlation_time, criterion, improved
from gfnn_jax.fitting.linearised import Linearised
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.models.lagrangians.fit import FOLDS, LawFit
from gfnn_jax.models.lagrangians.libraries import (
    CUBIC,
    KINDS,
    feeds,
    losses,
    names_of,
    together,
)
from gfnn_jax.models.lagrangians.structure import Loss
from gfnn_jax.models.lagrangians.text import Names, friction_of
from gfnn_jax.solve.linear import non_negative


@dataclasses.dataclass(frozen=True)
class FrictionOptions:
    """Limits of the choice (`benchmarks/friction_kinds.py`).

    largest: of a residual, or of its derivatives, on arcs that count. drives: standard errors below
    zero, at which friction would have to drive. rank: of coefficients that a record determines only
    together. imitated: share of what a friction changes that no other coefficient does. limit:
    standard errors of a coefficient above its value, of its upper limit.
    """

    largest: float = 1e100
    drives: float = 5.0
    rank: float = 1e-10
    imitated: float = 1e-3
    limit: float = 2.0


OPTIONS = FrictionOptions()


class FrictionChoice(NamedTuple):
    """The frictions that were taken; the odds that they forecast better than other sets of
    kinds; upper limits of ρ of those not taken; and whether the record gains energy: none was
    taken, and one alone would be below zero."""

    rows: tuple[Loss, ...]
    odds: dict[tuple[int, ...], float]
    limits: dict[Loss, float]
    gains: bool

    @property
    def kinds(self) -> tuple[int, ...]:
        return kinds_of(self.rows)

    def in_words(self, scale: float, dim: int, names: Names) -> WhichFriction:
        """The choice in these names; ``scale`` is that of L."""

        def named(kinds: tuple[int, ...]) -> str:
            return "+".join(names_of(kinds)) or "none"

        plain = {direction for direction, _, _ in losses(dim, KINDS, 0.0)}
        rows = [r for r in self.limits if r[0] in plain and len(r) == 3]
        rows = [r for r in rows if r[1] not in self.kinds and not kind_of(r[1]).rare]
        largest = scale * np.array([self.limits[row] for row in rows])
        terms = friction_of(Friction.of(rows, dim), largest, 0 * largest, names).terms
        powers = {row[2] for row in self.rows if row[1] == POWER} - {CUBIC}
        own = ["power" if k == POWER and powers else kind_of(k).name for k in self.kinds]
        return WhichFriction(
            tuple(own),
            {named(kinds): odds for kinds, odds in self.odds.items()},
            {t.term: t.coefficient for t in terms},
        )


@dataclasses.dataclass(frozen=True)
class WhichFriction:
    """The kinds of friction that a record shows; "power" is one by a speed to another power than
    the third. odds: that they forecast better than other kinds ("none", "quadratic", "linear+dry",
    …). limits: of terms of R of kinds that were not seen, the largest coefficients that the record
    allows (two standard errors)."""

    kinds: tuple[str, ...]
    odds: dict[str, float]
    limits: dict[str, float]

    def __str__(self) -> str:
        text = "+".join(self.kinds) or "none"
        if self.odds:
            rival = min(self.odds, key=lambda name: self.odds[name])
            text += f"; odds of {odds_text(self.odds[rival])} against {rival} on held-out parts"
            if self.odds[rival] < 1:
                text += f", too few (below {EVIDENCE.decided:.0f} : 1) for a further kind"
        below = [f"{in_letters(term)} < {limit:.2g}" for term, limit in self.limits.items()]
        absent = f"; not significant, coefficients in R below 2 σ: {', '.join(below)}"
        return text + absent * bool(below)


def odds_text(odds: float) -> str:
    """12 : 1, 1 : 3; those above a million are not told apart."""
    if odds >= 1e6:
        return "> 10⁶ : 1"
    if odds <= 1e-6:
        return "1 : > 10⁶"
    more = f"{max(odds, 1 / odds):.2g}"
    more = f"{float(more):,.0f}" if "e" in more else more
    return f"{more} : 1" if odds >= 1 else f"1 : {more}"


def kinds_of(rows: Sequence[Loss]) -> tuple[int, ...]:
    """The kinds of friction among these, in their order."""
    return tuple(sorted({row[1] for row in rows}))


def _in_isotropic(kinds: Sequence[int]) -> tuple[int, ...]:
    """Kinds with isotropic in place of quadratic friction, () where there is none."""
    return tuple(sorted({*kinds, ISOTROPIC} - {QUADRATIC})) if QUADRATIC in kinds else ()


def plainness(kinds: Sequence[int]) -> tuple[float, ...]:
    """The rank of kinds among as many others: uniform friction first, and isotropic drag, which has
    one coefficient, before quadratic friction."""
    order = {UNIFORM: -1.0, ISOTROPIC: LINEAR + 0.5, PLACED: LOADED}
    return tuple(sorted(order.get(kind, kind) for kind in kinds))


def is_coupled(row: Loss) -> bool:
    """Return whether a friction is of the sum or the difference of several speeds."""
    return row[1] != ISOTROPIC and sum(map(bool, row[0])) > 1


@dataclasses.dataclass(frozen=True, eq=False)
class _Judged:
    """A set of the candidates of a table (indices), by ρ (thirds, n) of all, each from the arcs
    without a third."""

    table: Table
    subset: tuple[int, ...]
    losses: np.ndarray

    @property
    def rows(self) -> tuple[Loss, ...]:
        return tuple(self.table.candidates[k] for k in self.subset)

    @property
    def kinds(self) -> tuple[int, ...]:
        return kinds_of(self.rows)

    @functools.cached_property
    def cost(self) -> float:
        """Sum of squares of the held-out residuals."""
        held = zip(self.table.held_out, self.losses, strict=True)
        rest = sum(float(np.sum((own[:, -1] - own[:, :-1] @ rho) ** 2)) for own, rho in held)
        return rest + self.table.rows[..., 0].size * self.table.rounding**2

    @functools.cached_property
    def independent(self) -> float:
        """Held-out residuals that are independent."""
        table = self.table
        residuals = np.zeros(table.rows.shape[:3])
        for held, rho in zip(table.folds, self.losses, strict=True):
            residuals[held] = table.reduced[held] @ np.append(-rho, 1.0)
        return np.count_nonzero(residuals) / correlation_time(residuals)

    @functools.cached_property
    def _of_all(self) -> np.ndarray:
        """ρ of all candidates, from all arcs."""
        return self.table.solve(self.table.own[-1], self.subset)

    @property
    def of_all(self) -> dict[Loss, float]:
        """Friction -> ρ, from all arcs."""
        return dict(zip(self.rows, self._of_all[list(self.subset)].tolist(), strict=True))

    @functools.cached_property
    def criterion(self) -> float:
        """Schwarz's, of all arcs."""
        table = self.table
        rest = table.rest(self._of_all) ** 2 + table.count * table.rounding**2
        return criterion(rest, table.independent, len(self.subset))

    @functools.cached_property
    def significance(self) -> np.ndarray:
        """Each ρ from all arcs, in standard errors."""
        table, columns = self.table, list(self.subset)
        own = table.own[-1]
        if len(own) <= len(columns):
            return np.zeros(len(columns))  # nothing sets their errors
        norms = np.maximum(np.linalg.norm(own[:, columns], axis=0), 1e-300)
        inverse = np.linalg.pinv(own[:, columns] / norms, rcond=OPTIONS.rank)
        noise = table.variance(table.rest(self._of_all)) + table.rounding**2
        errors = np.linalg.norm(inverse, axis=1) * np.sqrt(table.correlation * noise)
        return self._of_all[columns] * norms / np.maximum(errors, 1e-300)

    @property
    def sizes(self) -> np.ndarray:
        """The same, divided by the least that counts as seen, √log n."""
        return self.significance / np.sqrt(np.log(self.table.independent))

    @property
    def is_seen(self) -> bool:
        return bool(np.all(self.sizes > 1))


def chosen(
    table: Table,
    choose: bool = True,
    before: FrictionChoice | None = None,
    rows: Sequence[Loss] | None = None,
) -> FrictionChoice:
    """The choice among sets of the candidates' kinds, each with the directions that it needs; not
    to ``choose`` is to take as many of the kinds as there are. Among equals the kinds chosen
    ``before`` stay. rows: friction that has been taken, where only its odds are asked for. Odds are
    those against sets whose coefficients are all seen."""
    kinds = sorted({row[1] for row in table.candidates})
    usual = [kind for kind in kinds if not (choose and kind_of(kind).rare)]
    every = (chosen for n in range(len(usual) + 1) for chosen in combinations(usual, n))
    every = (chosen for chosen in every if together(chosen) or not choose)
    sets = [judged for judged in map(table.leanest, every) if judged is not None]
    if not choose:
        most = max(len(s.kinds) for s in sets)
        sets = [min((s for s in sets if len(s.kinds) == most), key=lambda s: s.cost)]
    seen = [s for s in sets if s.is_seen] if choose else sets
    best = min(seen, key=lambda s: s.cost)

    def odds(one: _Judged, other: _Judged) -> float:
        """Return the odds of one, by the residuals that the better of both leaves: a wrong set's
        are correlated by what it lacks."""
        count = min(one, other, key=lambda s: s.cost).independent
        return EVIDENCE.odds(one.cost, other.cost, count)

    tied = [s for s in seen if odds(best, s) < EVIDENCE.decided]
    plain = {s.kinds for s in tied if ISOTROPIC in s.kinds}  # of one coefficient for several
    tied = [s for s in tied if _in_isotropic(s.kinds) not in plain]
    known = before.kinds if before else ()
    taken = min(tied, key=lambda s: (len(s.kinds), s.kinds != known, plainness(s.kinds)))
    if choose:
        lowest = taken.criterion - 2 * np.log(EVIDENCE.decided)
        likelier = [s for s in _with_rare(table, taken) if s.criterion < lowest]
        likelier = [s for s in likelier if odds(s, taken) > EVIDENCE.decided]
        likeliest = min(likelier, key=lambda s: s.cost, default=taken)
        tied = [s for s in likelier if odds(likeliest, s) < EVIDENCE.decided]
        taken = min(tied, key=lambda s: (len(s.kinds), s.cost), default=taken)
    if rows is not None and set(rows) <= set(table.candidates):
        taken = table.judged([table.candidates.index(row) for row in rows])
        seen = [s for s in seen if s.kinds != taken.kinds]
    against = {s.kinds: odds(taken, s) for s in seen if s is not taken}
    alone = table.others(taken.rows).values()
    gains = not taken.rows and any(rho < -OPTIONS.drives * error for rho, error in alone)
    return FrictionChoice(taken.rows, against, table.limits(taken.rows), gains)


def _with_rare(table: Table, taken: _Judged) -> list[_Judged]:
    """The set with a rare kind of friction beside its own, or in place of one, where it is seen;
    Stribeck's with dry and linear friction where these are, which it hides."""
    kinds, rare = set(taken.kinds), {k for _, k, *_ in table.candidates if kind_of(k).rare}
    sets = [kinds - gone | {new} for new in sorted(rare) for gone in [set(), *({k} for k in kinds)]]
    sets += [kinds | {LINEAR, DRY, STRIBECK}] * (STRIBECK in rare)
    found = [table.leanest(tuple(sorted(one))) for one in sets]
    seen = [one for one in found if one is not None and one.is_seen and not feeds(one.of_all)]
    if not any({LINEAR, STRIBECK} <= set(one.kinds) for one in seen):
        return seen
    return [one for one in seen if LINEAR in one.kinds or STRIBECK not in one.kinds]


def table_of(fit: LawFit, candidates: Sequence[Loss]) -> Table:
    """The arcs of a fit, a third of the record held out at a time."""
    structure = fit.structure
    others = tuple(row for row in candidates if row not in structure.friction)
    larger = structure.plus([("loss", row) for row in others])
    p, rows = larger.start(fit.values), fit.problem.rows(larger, fit)
    # Arcs that the larger law cannot follow: their squares would overflow.
    rows[~(np.abs(rows) < OPTIONS.largest).all(axis=(1, 2, 3))] = 0.0
    keys = larger.keys()
    own = [keys.index(("loss", row)) for row in candidates]
    rest = [k for k in range(len(keys)) if k not in own]
    rows = rows[..., [*rest, *own, len(keys)]]
    rows[..., -1] += rows[..., len(rest) : -1] @ p[own]  # as if there were no friction
    thirds = fit.problem.systems.thirds(fit.arcs)
    return Table(tuple(candidates), rows, fit.correlation, thirds=thirds)


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """Rows (A, L, k, n + 1) of arcs, or of pairs, close to a fit: derivatives in the coefficients,
    the candidates' last, and the residuals, which are those without friction; the correlation of
    residuals; their rounding, below which no set is better than another; and the third (A,) that
    each arc lies in, None where they lie in the order of the rows."""

    candidates: tuple[Loss, ...]
    rows: np.ndarray
    correlation: float
    rounding: float = 0.0
    thirds: np.ndarray | None = None

    @functools.cached_property
    def folds(self) -> np.ndarray:
        """The arcs of each third (thirds, A)."""
        place = np.arange(len(self.rows)) * FOLDS // len(self.rows)
        place = place if self.thirds is None else self.thirds
        return place == np.unique(place)[:, None]

    @property
    def width(self) -> int:
        """The number of coefficients that are not friction."""
        return self.rows.shape[-1] - 1 - len(self.candidates)

    @functools.cached_property
    def count(self) -> int:
        """The number of residuals."""
        return int(np.count_nonzero(self.rows[..., -1]))

    @property
    def independent(self) -> float:
        """The number of these that are independent."""
        return max(self.count / self.correlation, np.e)

    @functools.cached_property
    def triangles(self) -> list[np.ndarray]:
        """Triangles of the arcs without each third, and of all."""
        kept = [*~self.folds, np.ones(self.folds.shape[1], bool)]
        flat = [self.rows[keep].reshape(-1, self.rows.shape[-1]) for keep in kept]
        return [np.asarray(np.linalg.qr(part, mode="r")) for part in flat]

    @functools.cached_property
    def own(self) -> list[np.ndarray]:
        """Triangles of the candidates, other coefficients at their best, of the same arcs."""
        return [triangle[self.width :, self.width :] for triangle in self.triangles]

    @functools.cached_property
    def reduced(self) -> np.ndarray:
        """Rows (A, L, k, m + 1) of the m candidates, other coefficients at the best that they have
        on the arcs of the other thirds."""
        f, found = self.width, self.rows[..., self.width :].copy()
        for triangle, held in zip(self.triangles[:-1], self.folds, strict=True):
            size = np.linalg.norm(triangle[:, :f], axis=0)
            size = np.where(size > 0, size, 1.0)  # where the other thirds do not show one
            others = np.linalg.pinv(triangle[:f, :f] / size, rcond=OPTIONS.rank) @ triangle[:f, f:]
            found[held] -= self.rows[held][..., :f] / size @ others
        return found

    @functools.cached_property
    def held_out(self) -> list[np.ndarray]:
        """Triangles of these rows, of each third."""
        rows = [self.reduced[held].reshape(-1, self.reduced.shape[-1]) for held in self.folds]
        return [np.asarray(np.linalg.qr(part, mode="r")) for part in rows]

    def solve(self, own: np.ndarray, subset: Sequence[int]) -> np.ndarray:
        """ρ of all candidates, of these at least 0, of the others 0."""
        losses, columns = np.zeros(len(self.candidates)), list(subset)
        if columns and len(own):  # a single arc leaves nothing to find them from
            scale = np.maximum(np.linalg.norm(own[:, columns], axis=0), 1e-300)
            losses[columns] = non_negative(own[:, columns] / scale, own[:, -1]) / scale
        return losses

    def judged(self, subset: Sequence[int]) -> _Judged:
        """Judge these candidates by the thirds that no coefficient is from."""
        losses = np.array([self.solve(own, subset) for own in self.own[:-1]])
        return _Judged(self, tuple(subset), losses)

    def rest(self, losses: np.ndarray) -> float:
        """Norm of the residuals of all arcs with these ρ."""
        own = self.own[-1]
        return float(np.linalg.norm(own[:, -1] - own[:, :-1] @ losses))

    def leanest(self, kinds: tuple[int, ...]) -> _Judged | None:
        """The set of all these kinds without the directions that are not seen beside others of
        their kind, or that held-out arcs do not miss; None where the record has no friction of one
        of the kinds. Of directions alike one may stand for another, so that the order decides which
        are left. Those that held-out arcs do not miss go first. The other order is taken where all
        that it leaves are seen and of the first order not all, or where Schwarz's criterion gives
        it odds of 20. Friction of single coordinates is taken where that gives no odds of 20
        against it: with masses that are free it may be the same as that of relative speeds."""
        of_kinds = [k for k, row in enumerate(self.candidates) if row[1] in kinds]
        subset = self._not_below_zero(of_kinds)
        if kinds_of([self.candidates[k] for k in subset]) != kinds:
            return None
        judged = functools.cache(self.judged)
        here, other = self._lean(subset, False, judged), self._lean(subset, True, judged)
        if here.is_seen != other.is_seen:
            here = here if here.is_seen else other
        elif here.criterion - other.criterion > 2 * np.log(EVIDENCE.decided):
            here = other
        if not any(is_coupled(row) for row in here.rows):
            return here
        single = [k for k in of_kinds if not is_coupled(self.candidates[k])]
        alone = self._lean(self._not_below_zero(single), False, judged)
        worse = alone.criterion - here.criterion > 2 * np.log(EVIDENCE.decided)
        as_good = alone.kinds == kinds and alone.is_seen >= here.is_seen and not worse
        return alone if as_good else here

    def _not_below_zero(self, subset: Sequence[int]) -> tuple[int, ...]:
        """The candidates among these whose ρ from all arcs is above zero."""
        found = self.solve(self.own[-1], subset)
        return tuple(k for k in subset if found[k] > 0)

    def _lean(
        self, subset: tuple[int, ...], seen_first: bool, judged: Callable[[tuple], _Judged]
    ) -> _Judged:
        """The set without its spare directions: first those that are not seen, or first those that
        held-out arcs do not miss. Each of its kinds keeps one."""
        begun = judged(subset)

        def without_spare(here: _Judged) -> list[tuple[int, ...]]:
            kinds = [self.candidates[k][1] for k in here.subset]
            sizes = dict(zip(here.subset, here.sizes, strict=True))
            fewer = {
                k: tuple(other for other in here.subset if other != k)
                for k, kind in zip(here.subset, kinds, strict=True)
                if kinds.count(kind) > 1
            }
            unseen = sorted((k for k in fewer if sizes[k] <= 1), key=lambda k: sizes[k])
            if fewer and not (unseen and seen_first):
                missed_least = min(fewer, key=lambda k: judged(fewer[k]).cost)
                cost = judged(fewer[missed_least]).cost
                needed = EVIDENCE.odds(here.cost, cost, begun.independent) > EVIDENCE.needed
                unseen = unseen if needed else [missed_least]
            return [fewer[k] for k in unseen[:1]]

        return improved(begun, without_spare, lambda _, subset: judged(subset))

    def others(self, taken: tuple[Loss, ...]) -> dict[Loss, tuple[float, float]]:
        """ρ, of either sign, and its standard error of the candidates that were not taken, each
        alone beside those that were."""
        places = {row: self.width + k for k, row in enumerate(self.candidates)}
        base = [*range(self.width), *(k for row, k in places.items() if row in taken)]
        new = [row for row in places if row not in taken]
        whole = Linearised(np.zeros(self.rows.shape[-1] - 1), Triangle(self.triangles[-1], 0))
        one, found = whole.added(base, [places[row] for row in new]), {}
        for k, row in enumerate(new):
            if one.share[k] >= OPTIONS.imitated:  # else others imitate it: there is no limit
                error = np.sqrt(self.correlation * self.variance(one.left[k])) / one.size[k]
                found[row] = float(one.value[k]), float(error)
        return found

    def limits(self, taken: tuple[Loss, ...]) -> dict[Loss, float]:
        """Upper limits of ρ of the candidates that were not taken."""
        others = self.others(taken).items()
        return {row: max(rho, 0.0) + OPTIONS.limit * error for row, (rho, error) in others}

    def variance(self, rest: float) -> float:
        """Variance of the residuals, by their norm."""
        return float(rest**2 / max(self.count - self.rows.shape[-1], 1))
