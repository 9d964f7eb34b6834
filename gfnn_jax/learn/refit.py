"""The chosen map of a fit, fitted anew to more pairs than fit into memory."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Iterable, Iterator

import jax
import numpy as np

from gfnn_jax.coordinates import CARTESIAN, nearest_image, to_inner, whole_turns
from gfnn_jax.errors import FitWarning
from gfnn_jax.fitting import least_squares
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.assemble import stepped
from gfnn_jax.learn.candidates import Candidate, Tolerance, one_step_error, with_error
from gfnn_jax.learn.conclude import not_met
from gfnn_jax.learn.fit import Fit
from gfnn_jax.learn.sweeps import residual_weight
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs

_BLOCK = 20_000  # pairs at a time
# A pair is an outlier that is missed by so many deviations, which are no smaller than roundoff. A
# million pairs with one at this limit have no worse a fit for it.
_OUTLYING, _ROUNDOFF = 100.0, 1e-14
_NO_WORSE = 1.1  # a refit whose error is larger by this factor than that of its sample is not kept


def refit(fitted: Fit, chunks: Iterable[Pairs], held: Pairs) -> Fit:
    """The chosen map of a fit, of a linear family, with its coefficients from all of these pairs.

    fitted: of a sample of them. chunks: all of the pairs, which need never be in memory together.
    held: pairs that choose the ridge and judge the result; they are left out of the fit, as are
    outliers, which the sample's map misses by far. Charts, domain and noise remain those that the
    sample gave, and so does the map where all pairs give a worse one. Warns (FitWarning) of both,
    and where the tolerance is missed.
    """
    started = time.perf_counter()
    tolerance = fitted.asked
    messages = [m for m in fitted.messages if m != not_met(fitted.chosen, tolerance, fitted.ended)]

    def warn(message: str) -> None:
        messages.append(message)
        warnings.warn(message, FitWarning, stacklevel=3)

    old = fitted.chosen
    worker = _Refit(old, tolerance)
    held = held.take(np.flatnonzero(worker.close(held)))
    chosen, num_pairs, before = None, fitted.num_pairs, old.validation_rms
    if len(held):
        reduced = worker.reduce(chunks, held)
        before = worker.error(old.map, held).rms
        if worker.outliers:
            warn(
                f"{worker.outliers} of {worker.count + worker.outliers} pairs are far from what "
                "the others tell: outliers, they are left out"
            )
        if reduced[0].rows:
            chosen, num_pairs = worker.solved(*reduced, held), worker.count
    if chosen is None or not chosen.validation_rms <= _NO_WORSE * before:
        found = "no map" if chosen is None else f"a worse map ({chosen.validation_rms:.2e})"
        warn(f"all pairs give {found} than the sample ({before:.2e}), whose map is kept")
        chosen, num_pairs = old, fitted.num_pairs
    if chosen.validation_bound > fitted.tolerance:
        warn(not_met(chosen, tolerance, fitted.ended))
    candidates = tuple(chosen if c.chosen else c for c in fitted.candidates)
    seconds = fitted.seconds + time.perf_counter() - started
    return dataclasses.replace(
        fitted, map=chosen.map, candidates=candidates, num_pairs=num_pairs, seconds=seconds,
        messages=tuple(messages),
    )  # fmt: skip


class _Refit:
    """The rows of a candidate's map from any number of pairs; counts pairs and outliers."""

    def __init__(self, candidate: Candidate, tolerance: Tolerance):
        self.candidate, self.tolerance, self.map = candidate, tolerance, candidate.map
        pieces = jax.tree.map(np.asarray, self.map).pieces
        self.index = next(i for i, p in enumerate(pieces) if isinstance(p, Generated))
        self.before, self.generated = pieces[: self.index], pieces[self.index]
        self.after = pieces[self.index + 1 :]
        self.spread = np.asarray(self.map.scale)
        self.most = _OUTLYING * np.maximum(candidate.deviations, _ROUNDOFF * self.spread)
        self.count = self.outliers = 0

    def close(self, pairs: Pairs) -> np.ndarray:
        """Which pairs (N,) the old map does not miss by far."""
        return self._close(np.asarray(pairs.z1), self._images(self.map, pairs.z0))

    def _close(self, z1, images) -> np.ndarray:
        return np.all(np.abs(self._difference(images - z1)) <= self.most, axis=1)

    def error(self, map_: SymplecticMap, pairs: Pairs):
        """The one-step error of a map on pairs."""
        images = self._images(map_, pairs.z0)
        return one_step_error(
            self._difference(images - np.asarray(pairs.z1)), self.spread, self.tolerance
        )

    def reduce(
        self, chunks: Iterable[Pairs], held: Pairs
    ) -> tuple[least_squares.Reduced, least_squares.Reduced]:
        """The factors of all pairs but outliers and those held out, and of those held out."""
        family, chart, dt = self.generated.family, self.generated.chart, float(self.map.dt)
        weight = residual_weight(chart, self.generated.scale, dt)
        judges = _keys(held.z0)

        def rows(y0, y1):
            return chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, dt)

        def kept() -> Iterator[tuple]:
            for chunk in chunks:
                for first in range(0, len(chunk), _BLOCK):
                    part = chunk.take(slice(first, first + _BLOCK))
                    z0, z1 = np.asarray(part.z0), np.asarray(part.z1)
                    images = self._images(self.map, z0)
                    close = self._close(z1, images)
                    self.count += int(close.sum())
                    self.outliers += int((~close).sum())
                    taken = close & ~np.isin(_keys(z0), judges)
                    yield rows(*self._as_generated(z0[taken], z1[taken], images[taken]))

        train = least_squares.reduce(family, kept(), weight)
        z0, z1 = np.asarray(held.z0), np.asarray(held.z1)
        judged = rows(*self._as_generated(z0, z1, self._images(self.map, z0)))
        return train, least_squares.reduce(family, [judged], weight)

    def solved(self, train, held_factor, held: Pairs) -> Candidate:
        """The candidate with these coefficients, judged by the pairs held out."""
        solved = least_squares.solve(train, held_factor, self.candidate.num_parameters)
        params = jax.device_put(self.generated.family.unflatten(solved.coefficients))
        pieces = list(self.map.pieces)
        pieces[self.index] = dataclasses.replace(pieces[self.index], params=params)
        map_ = dataclasses.replace(self.map, pieces=tuple(pieces))
        candidate = with_error(self.candidate, self.error(map_, held))
        return dataclasses.replace(candidate, map=map_, train_rms=solved.train_rms)

    def _images(self, map_: SymplecticMap, z) -> np.ndarray:
        steps = stepped(map_, np.asarray(z), timed=False)
        return np.where(steps.failed[:, None], np.nan, steps.images)

    def _difference(self, difference) -> np.ndarray:
        plain = self.map.coordinates.forward is CARTESIAN.forward
        return nearest_image(difference, self.map.coordinates.angles if plain else ())

    def _as_generated(self, z0, z1, images) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (N, 2d) as the generated piece sees them: inner coordinates, the angles of z1
        lifted to the nearest image of the map's own prediction, the base map factored out."""
        coordinates, angles = self.map.coordinates, list(self.map.coordinates.angles)
        y0, y1, predicted = (to_inner(coordinates, z) for z in (z0, z1, images))
        y1[:, angles] -= whole_turns(y1[:, angles] - predicted[:, angles])
        turns = whole_turns(y0[:, angles] - np.asarray(self.map.angle_centre))
        y0[:, angles] -= turns
        y1[:, angles] -= turns
        for piece in self.before:
            y0 = piece.image(y0)
        for piece in reversed(self.after):
            y1 = piece.inverse().image(y1)
        return y0, y1


def _keys(z) -> np.ndarray:
    """The rows of z (N, 2d) as N things that can be compared."""
    z = np.ascontiguousarray(z)
    return z.view([("", z.dtype)] * z.shape[1]).ravel()
