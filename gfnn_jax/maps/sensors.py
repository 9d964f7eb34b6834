"""Sensors that the data of a map came from."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.maps.observation import Observation
from gfnn_jax.solve.noise import Wander

TUBE = 0.95  # of trajectories lie in the tube that scores are multiples of


class Options:
    """Scores of forecasts whose tubes hold whole trajectories (`benchmarks/certificates.py`).

    least: a score, of errors that are roundoff. beyond: times the largest score seen: a further one
    is no larger. phases: starts of forecasts within their length that tell something of their own.
    usual: standard deviation of the logarithms of scores, of most laws, which counts as ``known``
    scores do: a record of few times a length has few scores, which hardly tell their own.
    """

    least: float = 1e-9
    beyond: float = 1.5
    phases: float = 3.0
    usual: float = 0.3
    known: float = 4.0


class OtherLaw(NamedTuple):
    """A law that the same data allow, with its probability ``share`` beside the one that was taken
    and the others."""

    law: Lagrangian
    share: float


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Columns that were measured, and their noise.

    positions, inputs, angles: names of coordinates and columns. sigma: (k,) noise of the channels
    that are seen. omega: the fastest frequency, 1/s. window: seconds before a time from which a
    state is estimated best. hold, delay: inputs between samples, and the time by which they act
    later, in seconds. leads, misfit: (n,) times ahead, and (n, k) the standard deviation there of
    forecasts of data that the law was not learned from, as far as neither the noise nor the errors
    of state and coefficients explain it. observation: how channels show a state, and the loss of
    their noise; None where they are the positions, and it is the usual one. wander: how zeros of
    channels move, each in units of its σ; None where they stay. creep: the speed of what moves by a
    σ in a period: of dry friction that is smoothed over no more, forecasts slide or stick.
    middle, reach: (d,) and (2d,) the mean of the coordinates over the data, and the rms of their
    distances from it and of the speeds. relative: whether the misfit is in proportion to how large
    the motion is, in these units. of_law: whether it is instead a factor on the deviations that the
    errors of state and coefficients explain, below 1 where they explain too much. scores: (B, n)
    the largest errors of held-out forecasts from their start to each lead, as multiples of the tube
    that their law gives; None where unknown. observed: seconds of data that they are from. level:
    relative standard deviation of the strength of friction between times of the data; where it is
    not 0 each state is estimated with its own. phase: of the filter (`signals.filters`, s³) that
    all columns went through; 0 where none is known. rivals: laws whose forecasts the bands hold
    too, by their shares.
    """

    positions: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    sigma: Any
    omega: float
    window: float
    hold: str
    delay: float
    leads: Any
    misfit: Any
    observation: Observation | None = None
    wander: Wander | None = None
    creep: float = 0.0
    middle: Any = None
    reach: Any = None
    relative: bool = False
    scores: Any = None
    observed: float = 0.0
    level: float = 0.0
    rivals: tuple[OtherLaw, ...] = ()
    of_law: bool = False
    phase: float = 0.0

    def with_level(self, level: float) -> Sensors:
        """The same with a level of friction, and windows of a quarter of the longest held-out
        forecast, two periods: a level takes longer to tell than a state."""
        window = max(self.window, 0.25 * float(np.max(self.leads)))
        return dataclasses.replace(self, level=level, window=window)

    @cached_property
    def observation_model(self) -> Observation:
        """Observation of a state by the channels."""
        return self.observation or Observation.plain(self.positions)

    @property
    def turning(self) -> tuple[int, ...]:
        """Indices of the coordinates that are angles."""
        return tuple(i for i, name in enumerate(self.positions) if name in self.angles)

    def coordinates_of(self, y: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The coordinates (n, d) that channels y (n, k) of samples in a row, at times t (n,), show,
        angles lifted."""
        if self.observation is None:
            return y
        q = self.observation_model.coordinates_of(y, self.turning, t)
        known = np.isfinite(q).all(axis=1)
        for i in self.turning:
            if self.positions[i] not in self.observation_model.channels:
                q[known, i] = np.unwrap(q[known, i])
        return q

    def distances(self, x: np.ndarray) -> np.ndarray:
        """Distances (..., 2d) of states (q, v) from rest in the middle; of angles by chords."""
        q, v = np.split(np.asarray(x), 2, axis=-1)
        off, turning = q - self.middle, list(self.turning)
        off[..., turning] = 2 * np.sin(off[..., turning] / 2)
        return np.concatenate([off, v], axis=-1)

    def size_of(self, x: np.ndarray) -> np.ndarray:
        """Size (...) of the motion from states x (..., 2d), 1 on the mean of the data (rms), and
        1 where the misfit does not depend on it."""
        if not self.relative:
            return np.ones(x.shape[:-1])
        return np.sqrt(np.mean((self.distances(x) / self.reach) ** 2, axis=-1))

    def misfit_at(self, ahead: np.ndarray) -> np.ndarray:
        """The law's own error (..., k) at times ``ahead`` (...); beyond the last lead it grows on
        with the power of time by which it grew from half of that lead on, none to the first: errors
        of a driven, damped motion grow no more."""
        columns = [np.interp(ahead, self.leads, column) for column in self.misfit.T]
        beyond = np.maximum(1.0, ahead / self.leads[-1])
        return np.stack(columns, axis=-1) * beyond[..., None] ** self._growth

    @cached_property
    def _growth(self) -> np.ndarray:
        """The powers (k,) of time by which the misfit grows."""
        t, m = self.leads, np.maximum(self.misfit, 1e-300)
        recent = t >= t[-1] / 2
        if np.sum(recent) < 2:
            return np.zeros(m.shape[1])
        return np.clip(np.polyfit(np.log(t[recent]), np.log(m[recent]), 1)[0], 0.0, 1.0)

    @cached_property
    def held_out(self) -> int:
        """The number of leads that two held-out forecasts or more went to."""
        scores = np.zeros((0, 0)) if self.scores is None else self.scores
        return int(np.sum(np.sum(np.isfinite(scores), axis=0) > 1))

    def widening(self, ahead: float, coverage: float) -> float:
        """Factor by which a tube over a time ahead has to be wider than the law by itself says, so
        that it holds the whole of a further trajectory with the probability ``coverage``.

        A prediction interval of the scores' logarithms, by Student's t, their variance with that of
        most laws (Gelman et al., Bayesian Data Analysis, §2.6): of held-out forecasts that
        overlap, each stretch as long as their lead counts as ``phases``. Those of the farthest
        lead where none went so far, 1 where none was held out. It is not far beyond the largest
        score: those of bodies at rest are near 0, and their logarithms not normal.
        """
        if not self.held_out:
            return 1.0
        lead = min(int(np.searchsorted(self.leads, ahead)), self.held_out - 1)
        scores = self.scores[np.isfinite(self.scores[:, lead]), lead]
        logs = np.log(np.maximum(scores, Options.least))
        count = np.clip(Options.phases * self.observed / self.leads[lead], 2, len(logs))
        free = count - 1 + Options.known
        variance = (count * logs.var() + Options.known * Options.usual**2) / free
        reach = stdtrit(free, coverage) * np.sqrt(variance * (1 + 1 / count))
        far = min(logs.mean() + reach, logs.max() + np.log(Options.beyond))
        return float(np.exp(far))
