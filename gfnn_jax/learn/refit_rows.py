"""Rows of a refit: the triangle of a map's coefficients, from any number of pairs.

S: the rows of its least-squares problem. H: those of a Gauss–Newton problem at its coefficients.
Pairs that the map of the sample misses by far, and those held out, give none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.candidates.assemble import stepped
from gfnn_jax.coordinates import CARTESIAN, nearest_image, to_inner, whole_turns
from gfnn_jax.dataset.measured_error import Tolerance, one_step_error
from gfnn_jax.dataset.rows import of_rows, residual_weight
from gfnn_jax.families.family import at_time
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.fitting import gauss_newton, least_squares
from gfnn_jax.fitting.descent import descended
from gfnn_jax.fitting.gauss_newton import FlowFit
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.piece import serves_any_dt
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs
from gfnn_jax.processes import Group

_BLOCK = 20_000  # pairs at a time
# Pairs that are close or not, of the first those that are not resolved, and those of another dt.
_COUNTED = ("count", "outliers", "unresolved", "other_dt")
_SAME, _PRINTED = 1e-9, 1e-5  # of dt: two that are one, and what printed times may differ by


def fitted_piece(pieces: tuple) -> int | None:
    """Index of the piece whose coefficients are fitted: S, else H; None where there is none."""
    for kind in (Generated, Flow):
        for index, piece in enumerate(pieces):
            if isinstance(piece, kind):
                return index
    return None


class _Solved(NamedTuple):
    """The map with its new coefficients, None where there were no rows; of a law its fit too.
    count, outliers, unresolved, other_dt: of pairs that were close, that were not, that were close
    but are not resolved, and that are apart by a time which the map does not serve."""

    map: SymplecticMap | None
    train_rms: float
    law: FlowFit | None
    count: int
    outliers: int
    unresolved: int
    other_dt: int


class _Rows(NamedTuple):
    """Pairs (n, 2d) as the fitted piece sees them, their dt (n,) where it is not the map's, and
    their args (n, k), or None."""

    y0: np.ndarray
    y1: np.ndarray
    dt: np.ndarray | None
    args: np.ndarray | None


class RowsOfRefit:
    """The rows of a map from any number of pairs.

    task: what all processes of the refit must agree on. most (2d,): by which the map may miss a
    pair; held (n, 2d): states that are left out; of a law also its steps (stages, substeps, newton)
    and ``limit``, up to which their own error is resolved.
    """

    def __init__(self, map_: SymplecticMap, task: dict[str, Any]):
        self.map, self.task = map_, task
        pieces = jax.tree.map(np.asarray, map_).pieces
        index = fitted_piece(pieces)
        assert index is not None  # `can_be_refitted`
        self.index = index
        self.before, self.piece, self.after = pieces[:index], pieces[index], pieces[index + 1 :]
        self.spread, self.dt = np.asarray(map_.scale), float(np.asarray(map_.dt))
        self.any_dt = len(pieces) == 1 and serves_any_dt(self.piece)

    def close(self, pairs: Pairs) -> np.ndarray:
        """Mark the pairs (N,) that the old map serves, and does not miss by far."""
        served = self._served(pairs)
        served[served] = self._close(
            np.asarray(pairs.z1)[served], self._images(self.map, pairs.take(np.flatnonzero(served)))
        )
        return served

    def _served(self, pairs: Pairs) -> np.ndarray:
        """Mark the pairs (N,) that are apart by a dt that the map has steps of."""
        off = np.abs(np.broadcast_to(np.asarray(pairs.dt), len(pairs)) - self.dt)
        return np.full(len(pairs), True) if self.any_dt else off <= _PRINTED * self.dt

    def _own_dt(self, pairs: Pairs) -> np.ndarray | None:
        """Time steps (N,) of the pairs, where a map of any dt must be told."""
        dt = np.broadcast_to(np.asarray(pairs.dt, float), len(pairs))
        same = not isinstance(self.piece.family, OfTimeStep) and np.ndim(pairs.dt) == 0
        if not self.any_dt or (same and np.all(np.abs(dt - self.dt) <= _SAME * self.dt)):
            return None
        return np.array(dt)

    def _args(self, pairs: Pairs) -> dict[str, np.ndarray] | None:
        """Args that the map depends on: others did not vary in the sample."""
        if self.map.parameters is None:
            return None
        given: dict[str, Any] = pairs.args or {}
        return {name: np.asarray(given[name], float) for name in self.map.parameters.names}

    def _close(self, z1, images) -> np.ndarray:
        return np.all(np.abs(self._difference(images - z1)) <= self.task["most"], axis=1)

    def error(self, map_: SymplecticMap, pairs: Pairs, tolerance: Tolerance):
        """The one-step error of a map on pairs."""
        images = self._images(map_, pairs)
        return one_step_error(
            self._difference(images - np.asarray(pairs.z1)), self.spread, tolerance
        )

    def resolving(self, held: Pairs) -> dict[str, Any]:
        """Steps of the law that resolve the pairs held out, and the error up to which others count
        as resolved. Nothing of S."""
        if isinstance(self.piece, Generated):
            return {}
        problem, rows = self._problem(self._inner(held)), np.arange(len(held))
        family, c = self.piece.family, self.piece.params
        steps = problem.fine_steps(family, c, rows)[0]
        limit = problem.resolution(family, c, steps, rows)[2]
        return {**dataclasses.asdict(steps), "limit": limit}

    # What a process answers, and how two answers become one.

    def answer(self, chunks: Iterable[Pairs], wanted: dict[str, Any]) -> dict[str, Any]:
        """The triangle of the rows of these pairs but outliers and those held out, and how many
        there are; of a law at the coefficients that are wanted."""
        counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        kept = self._kept(chunks, counts)
        if isinstance(self.piece, Generated):
            found = self._of_map(kept)
        else:
            found = self._of_law(kept, wanted["c"], counts)
        return {"factor": found.factor, "rows": found.rows, **counts}

    def merged(self, one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
        """One answer of two."""
        counts = {n: one[n] + other[n] for n in _COUNTED}
        both = _triangle(one).merge(_triangle(other))
        return {"factor": both.factor, "rows": both.rows, **counts}

    def solved(self, chunks: Iterable[Pairs], held: Pairs, group: Group) -> _Solved:
        """The map of the pairs of all processes."""
        counts: dict[str, Any] = {}

        def asked(c=()) -> dict[str, Any]:
            wanted = group.broadcast({"c": np.asarray(c)})
            found = group.folded(self.answer(chunks, wanted), self.merged)
            counts.update({n: int(found[n]) for n in _COUNTED})
            return found

        law = None
        if isinstance(self.piece, Generated):
            train, validation = _triangle(asked()), self._of_map([self._inner(held)])
            size, rows = self.piece.family.num_parameters, train.rows
            if rows:
                solved = least_squares.solve(train, validation, size)
                coefficients, train_rms = solved.coefficients, solved.train_rms
        else:
            c, found, made = descended(
                lambda c: _triangle(asked(c)), self.piece.params, gauss_newton.OPTIONS.most
            )
            rows = found.rows
            if rows:
                law = gauss_newton.summarised(c, found, None, made, self._steps)
                coefficients, train_rms = law.coefficients, law.rms
        group.broadcast({})
        if not rows:
            return _Solved(None, np.inf, None, **counts)
        params = jax.device_put(self.piece.family.unflatten(coefficients))
        pieces = list(self.map.pieces)
        pieces[self.index] = dataclasses.replace(pieces[self.index], params=params)
        map_ = dataclasses.replace(self.map, pieces=tuple(pieces))
        return _Solved(map_, train_rms, law, **counts)

    def _of_map(self, kept: Iterable[_Rows]) -> Triangle:
        """The triangle of S from pairs as its piece sees them."""
        chart, family = self.piece.chart, self.piece.family
        # The rows of an S of dt are multiplied by each pair's own.
        dt = 1.0 if isinstance(family, OfTimeStep) else self.dt
        weight = residual_weight(chart, self.piece.scale, dt)

        def row_of(y0, y1, own_dt, args) -> tuple[np.ndarray, ...]:
            row = chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, dt)
            if own_dt is not None:
                return *row, own_dt[:, None]
            return row if args is None else (*row, at_time(family, args, 0.5 * dt))

        return least_squares.reduce(of_rows(family), (row_of(*rows) for rows in kept), weight)

    def _of_law(self, kept, c, counts: dict[str, int]) -> Triangle:
        """The Gauss–Newton problem of H at c, from pairs that its steps resolve."""
        family = self.piece.family
        whole = Triangle.empty(family.num_parameters)
        for own in kept:
            problem, rows = self._problem(own), np.arange(len(own.y0))
            known, off, _ = problem.resolution(family, self.piece.params, self._steps, rows)
            resolved = rows[known & (off <= self.task["limit"])]
            counts["unresolved"] += len(rows) - len(resolved)
            whole = whole.merge(problem.linearised(family, c, self._steps, resolved))
        return whole

    @property
    def _steps(self) -> Steps:
        names = (field.name for field in dataclasses.fields(Steps))
        return Steps(**{name: np.asarray(self.task[name]).item() for name in names})

    def _problem(self, rows: _Rows) -> gauss_newton.Problem:
        dt = self.dt if rows.dt is None else rows.dt
        return gauss_newton.Problem(
            rows.y0, rows.y1, dt, np.asarray(self.piece.scale), args=rows.args
        )

    def _kept(self, chunks: Iterable[Pairs], counts: dict[str, int]) -> Iterator[_Rows]:
        """Pairs but outliers and those held out, as the fitted piece sees them."""
        held = _keys(self.task["held"])
        for chunk in chunks:
            for first in range(0, len(chunk), _BLOCK):
                part = chunk.take(slice(first, first + _BLOCK))
                served = self._served(part)
                counts["other_dt"] += int((~served).sum())
                if not served.all():
                    part = part.take(np.flatnonzero(served))
                z0, z1 = np.asarray(part.z0), np.asarray(part.z1)
                images = self._images(self.map, part)
                close = self._close(z1, images)
                counts["count"] += int(close.sum())
                counts["outliers"] += int((~close).sum())
                taken = close & ~np.isin(_keys(z0), held)
                if taken.any():
                    yield self._as_fitted(part.take(np.flatnonzero(taken)), images[taken])

    def _inner(self, pairs: Pairs) -> _Rows:
        return self._as_fitted(pairs, self._images(self.map, pairs))

    def _images(self, map_: SymplecticMap, pairs: Pairs) -> np.ndarray:
        if not len(pairs):
            return np.zeros(pairs.z0.shape)
        z, dt, args = np.asarray(pairs.z0), self._own_dt(pairs), self._args(pairs)
        steps = stepped(map_, z, dt, args, timed=False)
        return np.where(steps.failed[:, None], np.nan, steps.images)

    def _difference(self, difference) -> np.ndarray:
        plain = self.map.coordinates.forward is CARTESIAN.forward
        return nearest_image(difference, self.map.coordinates.angles if plain else ())

    def _as_fitted(self, pairs: Pairs, images) -> _Rows:
        """Pairs as the fitted piece sees them: inner coordinates, the angles of z1 lifted to the
        nearest image of the map's own prediction, the base map factored out."""
        z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
        coordinates, angles = self.map.coordinates, list(self.map.coordinates.angles)
        y0, y1, predicted = (to_inner(coordinates, z) for z in (z0, z1, images))
        y1[:, angles] -= whole_turns(y1[:, angles] - predicted[:, angles])
        turns = whole_turns(y0[:, angles] - np.asarray(self.map.angle_centre))
        y0[:, angles] -= turns
        y1[:, angles] -= turns
        args = self._args(pairs)
        columns = None if args is None else np.stack([*args.values()], axis=-1)
        for piece in self.before:
            y0 = piece.image(y0, columns)
        for piece in reversed(self.after):
            y1 = piece.inverse().image(y1, columns)
        return _Rows(y0, y1, self._own_dt(pairs), columns)


def _triangle(answer: dict[str, Any]) -> Triangle:
    return Triangle(answer["factor"], int(answer["rows"]))


def _keys(z) -> np.ndarray:
    """The rows of z (N, 2d) as N things that can be compared."""
    z = np.ascontiguousarray(z)
    return z.view([("", z.dtype)] * z.shape[1]).ravel()
