"""The chosen map of a fit, fitted anew to more pairs than fit into memory, of many processes.

Each process folds its own rows into one triangle (local QR); triangles are merged in pairs
up a tree, a TSQR (Demmel, Grigori, Hoemmen & Langou, SIAM J. Sci. Comput. 34, 2012), one tree for
S and one for each Gauss–Newton problem of H. The first process solves, and decides alone. The rows
of S are those of its least-squares problem, of H those of a Gauss–Newton problem at its
coefficients. Pairs that the map of the sample misses by far, and those held out, give none.
"""

import dataclasses
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.budget import FLOW, RATES, ROWS
from gfnn_jax.candidates.assemble import Candidate, stepped, with_error
from gfnn_jax.coordinates import nearest_image, to_inner, whole_turns
from gfnn_jax.dataset.measured_error import Tolerance, one_step_error
from gfnn_jax.dataset.rows import of_rows, residual_weight
from gfnn_jax.errors import FitWarning
from gfnn_jax.families.family import at_time
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.fitting import gauss_newton, least_squares
from gfnn_jax.fitting.gauss_newton import FlowFit, descended
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.choose import FEWEST_RUNS_TESTED
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.maps.piece import serves_any_dt
from gfnn_jax.maps.saved import packed, unpacked
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.hamiltonians.fitted_law import Term, formula
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.phase_space import Pairs
from gfnn_jax.processes import Group
from gfnn_jax.scenes import Scene


class Options:
    """Limits of a refit to all pairs (study: scaling)."""

    # A pair is an outlier that is missed by so many deviations, which are no smaller than
    # roundoff. A million pairs with one at this limit have no worse a fit for it.
    outlying: float = 100.0
    roundoff: float = 1e-14
    passes_of_law: int = 3  # through all pairs: Gauss–Newton steps from coefficients of a sample
    # a refit whose error is larger by this factor than that of its sample is not kept
    no_worse: float = 1.1
    block: int = 20_000  # pairs at a time
    # of dt: two that are one, and what printed times may differ by
    same: float = 1e-9
    printed: float = 1e-5


_OF_TASK = "task "  # before the names of a task, in what processes are told


def why_not(map_: SymplecticMap) -> str:
    """Return why `refit` cannot be done of this map, as a message says it; "" where it can: S or H
    is linear in its coefficients. A network is not."""
    index = fitted_piece(map_.pieces)
    if index is None:
        return "there was no time for a better model (a larger --max-seconds gives it)"
    if hasattr(map_.pieces[index].family, "term_gradients"):
        return ""
    return "a refit needs a family that is linear in its coefficients (polynomial, features, sines)"


def not_refitted(fitted: Fit, why: str) -> Fit:
    """The fit of a sample as it is, with a warning (FitWarning) that says so, and why."""
    done = f"{fitted.chosen.label} is fitted to a sample of {fitted.num_pairs} pairs"
    message = f"{done}, not to all of them: {why}"
    warnings.warn(message, FitWarning, stacklevel=2)
    return fitted.replaced(messages=(*fitted.messages, message))


def work_of_refit(fitted: Fit, num_pairs: int, reading: float) -> float:
    """Seconds that `refit` takes, about: S goes through all pairs once, a law a few times.

    reading: seconds that reading the pairs once takes.
    """
    chosen, width = fitted.chosen, 2 * fitted.map.dim
    if chosen.learns == "map":
        return reading + 2.0 * num_pairs * width * (chosen.num_parameters + 1) ** 2 / RATES[ROWS]
    of_flow = num_pairs * width * chosen.operations / RATES[FLOW]
    return Options.passes_of_law * (reading + of_flow)


def refit(
    fitted: Fit,
    chunks: Iterable[Pairs],
    held: Pairs,
    *,
    test: Pairs | None = None,
    scene: Scene | None = None,
    group: Group | None = None,
) -> Fit:
    """The chosen map of a fit, of a linear family, with its coefficients from all of these pairs.

    fitted: of a sample of them. chunks: all of the pairs, which need never be in memory together;
    of a law they are gone through once for each Gauss–Newton step. held: pairs that choose the
    ridge, and between the new map and the sample's. test: pairs that state the error; None: those
    held state it too. Both are left out of the fit, as are outliers, which the sample's map misses
    by far, and what the steps of a law do not resolve. Charts, domain and noise remain those that
    the sample gave, and so does the map where all pairs give a worse one. Warns (FitWarning) of
    both, and where the tolerance is missed.

    group: the processes that have the pairs. This one is the first, with chunks of its own; the
    others call `help_refit`. scene: as `maps.saved.save` takes it.
    """
    started = time.perf_counter()
    group = group or Group()
    tolerance = fitted.asked
    missed = tolerance.missed_by(fitted.chosen, fitted.ended)
    messages = [m for m in fitted.messages if m != missed]

    def warn(message: str) -> None:
        messages.append(message)
        warnings.warn(message, FitWarning, stacklevel=3)

    old, law, map_ = fitted.chosen, fitted.hamiltonian, fitted.map
    most = Options.outlying * np.maximum(old.deviations, Options.roundoff * np.asarray(map_.scale))
    apart = [held] if test is None else [held, test]
    worker = RowsOfRefit(map_, {"most": most, "held": _states_of(apart)})
    apart = [pairs.take(np.flatnonzero(worker.close(pairs))) for pairs in apart]
    held, test = apart[0], apart[-1]
    chosen, better = None, None
    num_pairs, before, after = fitted.num_pairs, old.validation_rms, np.inf
    if len(held) and len(test):
        before = worker.error(map_, held, tolerance).rms
        worker.task["held"] = _states_of(apart)
        worker.task |= worker.resolving(held)
        bare = dataclasses.replace(map_, posterior=None)
        group.broadcast(packed(bare, scene) | {_OF_TASK + n: v for n, v in worker.task.items()})
        found = worker.solved(chunks, held, group)
        apart, above = f"not dt = {float(map_.dt):g} apart", f"above {Options.outlying:g}"
        served, close = found.count + found.outliers, "as of close passages"
        for number, among, why in (
            (found.outliers, served, f"outliers, with residuals {above} standard deviations"),
            (found.other_dt, served + found.other_dt, apart),
            (found.unresolved, found.count, f"not resolved by the steps of the law, {close}"),
        ):
            if number:
                warn(f"{number} of {among} pairs are {why}: they are left out")
        if found.map is not None:
            after = worker.error(found.map, held, tolerance).rms
            # Test pairs of few runs did not state the sample's error either, which then stands.
            few = test.run is not None and len(np.unique(test.run)) < FEWEST_RUNS_TESTED
            candidate = old if few else with_error(old, worker.error(found.map, test, tolerance))
            chosen = dataclasses.replace(candidate, train_rms=found.train_rms)
            better = found.map
            num_pairs = found.count
    else:
        group.broadcast({})
    if chosen is None or not after <= Options.no_worse * before:
        found_map = "no map" if chosen is None else f"a worse map (RMS error {after:.2e})"
        warn(
            f"the fit to all pairs gives {found_map}: that of the sample (RMS error {before:.2e} "
            "in the data's units) is kept"
        )
        chosen, num_pairs = old, fitted.num_pairs
    elif law is not None and found.law is not None and old.learns == "hamiltonian":
        law = _with_coefficients(law, found.law, chosen)
    if not tolerance.met_by(chosen):
        warn(tolerance.missed_by(chosen, fitted.ended))
    return fitted.replaced(
        map=map_ if chosen is old else better,
        candidates=tuple(chosen if c.chosen else c for c in fitted.candidates),
        num_pairs=num_pairs,
        seconds=fitted.seconds + time.perf_counter() - started,
        hamiltonian=law,
        messages=tuple(messages),
    )


def _states_of(parts: Sequence[Pairs]) -> np.ndarray:
    return np.concatenate([np.asarray(pairs.z0) for pairs in parts])


def help_refit(
    opening: dict[str, Any], chunks: Iterable[Pairs], group: Group, *, scene: Scene | None = None
) -> int:
    """The part of another process than the first in `refit`: how many pairs it has given.

    opening: what `refit` broadcasts first; empty where there is nothing to be done. chunks: of the
    pairs that are this process's own.
    """
    if not opening:
        return 0
    task = {n.removeprefix(_OF_TASK): v for n, v in opening.items() if n.startswith(_OF_TASK)}
    rest = {n: v for n, v in opening.items() if not n.startswith(_OF_TASK)}
    worker = RowsOfRefit(jax.device_put(unpacked(rest, scene)), task)
    own = worker.answer(chunks, group.broadcast())
    while True:
        group.folded(own, worker.merged)
        wanted = group.broadcast()
        if not wanted:
            return int(own["count"])
        own = worker.answer(chunks, wanted)


def _with_coefficients(
    law: LearnedHamiltonian, fit: FlowFit, candidate: Candidate
) -> LearnedHamiltonian:
    names = [term.term for term in law.terms]
    terms = tuple(map(Term, names, fit.coefficients.tolist(), fit.standard_errors.tolist()))
    flow = dataclasses.replace(law.flow, params=fit.coefficients)
    text = getattr(flow.family, "prefix", "") + formula(terms)
    return dataclasses.replace(law, flow=flow, terms=terms, shown=text, candidate=candidate)


# Pairs that are close or not, of the first those that are not resolved, and those of another dt.
_COUNTED = ("count", "outliers", "unresolved", "other_dt")


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
        assert index is not None  # `why_not`
        self.index = index
        self.before, self.piece, self.after = pieces[:index], pieces[index], pieces[index + 1 :]
        self.spread, self.dt = np.asarray(map_.scale), float(np.asarray(map_.dt))
        self.any_dt = len(pieces) == 1 and serves_any_dt(self.piece)

    def close(self, pairs: Pairs) -> np.ndarray:
        """Mark the pairs (N,) that the old map serves, and does not miss by far."""
        served = self._served(pairs)
        images = self._images(self.map, pairs.take(np.flatnonzero(served)))
        served[served] = self._close(np.asarray(pairs.z1)[served], images)
        return served

    def _served(self, pairs: Pairs) -> np.ndarray:
        """Mark the pairs (N,) that are apart by a dt that the map has steps of."""
        off = np.abs(np.broadcast_to(np.asarray(pairs.dt), len(pairs)) - self.dt)
        return np.full(len(pairs), True) if self.any_dt else off <= Options.printed * self.dt

    def _own_dt(self, pairs: Pairs) -> np.ndarray | None:
        """Time steps (N,) of the pairs, where a map of any dt must be told."""
        dt = np.broadcast_to(np.asarray(pairs.dt, float), len(pairs))
        same = not isinstance(self.piece.family, OfTimeStep) and np.ndim(pairs.dt) == 0
        if not self.any_dt or (same and np.all(np.abs(dt - self.dt) <= Options.same * self.dt)):
            return None
        return np.array(dt)

    def _args(self, pairs: Pairs) -> dict[str, np.ndarray] | None:
        """Args that the map depends on: others did not vary in the sample."""
        if self.map.parameters is None:
            return None
        given: dict[str, Any] = pairs.args or {}
        return {name: np.asarray(given[name], float) for name in self.map.parameters.names}

    def _close(self, z1, images) -> np.ndarray:
        off = nearest_image(images - z1, self.map.angles_of_z)
        return np.all(np.abs(off) <= self.task["most"], axis=1)

    def error(self, map_: SymplecticMap, pairs: Pairs, tolerance: Tolerance):
        """The one-step error of a map on pairs."""
        off = self._images(map_, pairs) - np.asarray(pairs.z1)
        return one_step_error(nearest_image(off, map_.angles_of_z), self.spread, tolerance)

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
            first, most = self.piece.params, gauss_newton.OPTIONS.most
            c, found, made = descended(lambda c: _triangle(asked(c)), first, most)
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
        scale = np.asarray(self.piece.scale)
        return gauss_newton.Problem(rows.y0, rows.y1, dt, scale, args=rows.args)

    def _kept(self, chunks: Iterable[Pairs], counts: dict[str, int]) -> Iterator[_Rows]:
        """Pairs but outliers and those held out, as the fitted piece sees them."""
        held = _keys(self.task["held"])
        for chunk in chunks:
            for first in range(0, len(chunk), Options.block):
                part = chunk.take(slice(first, first + Options.block))
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
