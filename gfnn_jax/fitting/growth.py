"""Growth of an H mode by mode: Gauss–Newton through the flow, over a library that grows where it
gains.

Each round solves for the modes that are there and looks at the candidates around those that
matter. Of a candidate's derivative, what the present modes explain is taken away first; then its
correlation with the residual is its weight in standard errors, were it fitted. The weightiest come
in, those that have lost their weight go.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.modes import Mode, Modes
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.linear_starts import midpoint_start
from gfnn_jax.fitting.significance import null_terms, significant
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps


@dataclasses.dataclass(frozen=True)
class GrowthOptions:
    """Tuned on the double pendulum at dt 0.05 and 0.2.

    boxes: (order, degree) of the first library, the largest that has at most ``box`` modes and for
    which there are rows enough.
    significant: standard errors that a mode must have to come in or to stay.
    weighty: of the heaviest candidate's, below which one waits for the next round.
    pairs: that the rounds look at, and rows that each of its modes needs.
    null: of a column's size, below which the other modes explain a candidate.
    block: candidates whose columns are made at once. shortlist: of them, from which at_once modes
    at most are taken in a round.
    rounds: at most. idle: that may pass without a gain of a tenth.
    """

    boxes: tuple[tuple[int, int], ...] = ((2, 2), (1, 2), (1, 1))
    box: int = 250
    significant: float = 4.0
    weighty: float = 0.2
    pairs: int = 600
    rows_per_mode: float = 4.0
    null: float = 1e-6
    block: int = 400
    shortlist: int = 200
    at_once: int = 16
    rounds: int = 60
    idle: int = 4
    box_pairs: int = 2_000  # that the first box is told by
    # of the residual: a gain, and what fewer modes may cost
    gained: float = 0.9
    worse: float = 1.2
    # of the residual, below which a step is taken before candidates are looked at
    settled: float = 0.1
    # of the residual: what a flow's own steps may err by, and what is left of it when they are
    # chosen again
    resolved: float = 1e-4
    again: float = 0.03
    fewest: float = 0.5  # of the pairs, whose flow must be computed


OPTIONS = GrowthOptions()


class Grown(NamedTuple):
    """The library of one round and its coefficients. rms: per component, as in FlowFit. ended: in
    the last round, why growth ends with it."""

    family: Terms
    coefficients: np.ndarray
    rms: float
    ended: str = ""


def grow(
    problem: Problem, basis: Modes, rows: np.ndarray, goal: float, most: int
) -> Iterator[Grown]:
    """The modes that these rows ask for, round by round, each better than the one before, until the
    residual is within ``goal`` or none gains.

    most: modes at most. Nothing is found where the rows are too few for the smallest library.
    """
    enough = rows[: OPTIONS.box_pairs]
    z0, z1 = problem.z0[enough], problem.z1[enough]
    modes = _box(basis, z0, len(rows))
    if not modes:
        return
    start = basis.terms(modes)
    c = midpoint_start(start, z0, z1, problem.given(enough)[0], problem.scale)
    present = dict(zip(modes, c.tolist(), strict=True))
    best, before, idle, ended = Grown(start, c, np.inf), present, 0, ""
    pace: list[tuple[int, float]] = []
    steps, resolved = None, 1.0
    for _ in range(OPTIONS.rounds):
        if idle == OPTIONS.idle:
            ended = "no further mode gains"
            break
        count = int(OPTIONS.rows_per_mode * len(present) / (2 * basis.dim))
        some = rows[: max(OPTIONS.pairs, count)]
        if steps is None or best.rms < OPTIONS.again * resolved:
            resolved = min(best.rms, 1.0)
            family, c = basis.terms(list(present)), np.array(list(present.values()))
            (steps,) = problem.fine_steps(family, c, some, (OPTIONS.resolved * resolved,))
        looked = _Linearised(problem, basis, present, steps, some)
        if not looked.rms <= OPTIONS.worse * best.rms:
            present = {
                m: 0.5 * (before.get(m, 0.0) + present.get(m, 0.0)) for m in before | present
            }
            idle += 1
            continue
        idle = 0 if looked.rms < OPTIONS.gained * best.rms else idle + 1
        if looked.rms < best.rms:
            best = Grown(*looked.without_new(), looked.rms)
            pace.append((len(best.coefficients), best.rms))
            yield best
        if looked.rms <= goal:
            ended = "the training pairs meet the tolerance"
            break
        before = present
        solved, rest, span = looked.solved(OPTIONS.significant)
        room = most - len(solved)
        gain = np.linalg.norm(rest) / np.linalg.norm(looked.residual)
        # What a long step leaves over is curvature, which asks for any mode.
        tried = basis.around(solved) if gain > OPTIONS.settled else []
        found = looked.candidates(tried, rest, span, room)
        if not found and gain > OPTIONS.gained:
            ended = (
                "the pairs have no room for more modes" if room <= 0 else "no further mode gains"
            )
            break
        if _out_of_reach(pace[-4:], goal, most):
            ended = f"more than {most} modes are needed"
            break
        present = solved | dict.fromkeys(found, 0.0)
    yield best._replace(ended=ended or f"{OPTIONS.rounds} rounds are over")


def _out_of_reach(pace: list[tuple[int, float]], goal: float, most: int) -> bool:
    """Return whether the modes that are left, each gaining as much as those of the last four rounds
    did, would miss the goal."""
    if len(pace) < 4:
        return False
    (count, rms), added = pace[-1], pace[-1][0] - pace[0][0]
    gained = np.log(pace[0][1] / rms)
    return added > 0 and gained / added * (most - count) < np.log(rms / goal)


def _box(basis: Modes, z, pairs: int) -> list[Mode]:
    """The first library, without the modes that others explain."""
    most = min(pairs * 2 * basis.dim / OPTIONS.rows_per_mode, OPTIONS.box)
    boxes = (basis.box(*size) for size in OPTIONS.boxes)
    modes = next((modes for modes in boxes if len(modes) <= most), [])
    kept, _ = null_terms(basis.terms(modes), z[: max(200, len(modes))]) if modes else ([], [])
    return [modes[j] for j in kept]


class _Linearised:
    """The linearised problem of the present modes at their coefficients, on the pairs whose flow
    can be computed."""

    def __init__(
        self, problem: Problem, basis: Modes, present: dict[Mode, float], steps: Steps, rows
    ):
        self._problem, self._basis, self.modes = problem, basis, list(present)
        self.family = basis.terms(self.modes)
        self.coefficients = np.array(list(present.values()))
        self._steps = steps
        self._rows, self._good = rows, np.ones(len(rows), bool)
        found = self._images(self.family)
        residual = (found.states - problem.z1[rows]) / problem.scale
        good = np.isfinite(residual).all(axis=1) & np.isfinite(found.by_coefficient).all((1, 2))
        self._good = good
        self.residual = residual[good].ravel()
        self.matrix = self._columns(found.by_coefficient)
        enough = good.mean() >= OPTIONS.fewest
        self.rms = float(np.sqrt(np.mean(self.residual**2))) if enough else np.inf

    def _images(self, along: Terms):
        p = self._problem
        p.allowance.check()
        return p.images(
            self.family, self.coefficients, self._rows, self._steps, along=along, derivatives=True
        )

    def _columns(self, by_coefficient):
        slope = by_coefficient[self._good] / self._problem.scale[:, None]
        return slope.reshape(-1, slope.shape[-1])

    def without_new(self) -> tuple[Terms, np.ndarray]:
        """The library and its coefficients without the modes that have not been fitted yet."""
        new = self.coefficients == 0
        kept = np.flatnonzero(~new | new.all())
        return self.family.take(kept.tolist()), self.coefficients[kept]

    def solved(self, threshold: float) -> tuple[dict[Mode, float], np.ndarray, np.ndarray]:
        """The modes that weigh at least so many standard errors with their next coefficients, the
        residual (n,) that the linearised problem then leaves, and an orthonormal basis (n, modes)
        of what these modes explain."""
        rows = np.concatenate([self.matrix, self.residual[:, None]], axis=1)
        kept, c = significant(Triangle.of(rows), self.coefficients, threshold)
        rest = self.residual + self.matrix[:, kept] @ c - self.matrix @ self.coefficients
        span = np.linalg.qr(self.matrix[:, kept])[0]
        return {self.modes[j]: float(v) for j, v in zip(kept, c, strict=True)}, rest, span

    def candidates(self, tried: list[Mode], rest, span, room: int) -> list[Mode]:
        """Select among the modes that are tried those that the residual asks for: the heaviest,
        then the one that is heaviest beside it, and so on. rest, span: as `solved` gives them."""
        degrees = np.sqrt(max(len(rest) - span.shape[1], 0))
        columns, heaviest = np.zeros((len(rest), 0)), np.zeros(0, dtype=int)
        for first in range(0, len(tried), OPTIONS.block):
            part = np.arange(first, min(first + OPTIONS.block, len(tried)))
            found = self._beside(span, [tried[j] for j in part], OPTIONS.null)
            columns, heaviest = np.hstack([columns, found]), np.concatenate([heaviest, part])
            order = np.argsort(-np.abs(rest @ columns), kind="stable")[: OPTIONS.shortlist]
            columns, heaviest = columns[:, order], heaviest[order]
        chosen, least = [], 0.0
        size = np.linalg.norm(columns, axis=0)
        while len(chosen) < min(room, OPTIONS.at_once, columns.shape[1]):
            left = np.linalg.norm(columns, axis=0)
            new = left > OPTIONS.null * size
            weights = np.abs(rest @ columns) / np.where(new, left, np.inf)
            weights *= degrees / np.linalg.norm(rest)
            j = int(np.argmax(weights))
            least = least or max(OPTIONS.significant, OPTIONS.weighty * weights[j])
            if not weights[j] >= least:
                break
            chosen.append(tried[heaviest[j]])
            unit = columns[:, j] / left[j]
            columns = columns - np.outer(unit, unit @ columns)
            rest = rest - unit * (unit @ rest)
        return chosen

    def _beside(self, span, modes: list[Mode], null: float) -> np.ndarray:
        """The derivatives in the coefficients of these modes without what ``span`` explains, each
        column of length 1, or 0 where nothing is left."""
        columns = self._columns(self._images(self._basis.terms(modes)).by_coefficient)
        size = np.linalg.norm(columns, axis=0)
        for _ in range(2):  # the second time makes them orthogonal to roundoff
            columns = columns - span @ (span.T @ columns)
        left = np.linalg.norm(columns, axis=0)
        good = np.isfinite(left) & (left > null * size)
        return np.where(good, columns / np.where(good, left, 1.0), 0.0)
