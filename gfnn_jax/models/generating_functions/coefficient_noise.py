"""Noise of the coefficients of S: their covariance, and the degrees of freedom that it takes.

The rows of S are r = φ(w)ᵀc − g (its gradient at the evaluation points, less the targets). The
noise of a state moves the rows of both pairs that it stands in, through w and through g. What of
the residual is noise, a larger size tells: it leaves that too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.dataset.noise import of_pairs
from gfnn_jax.dataset.rows import of_rows
from gfnn_jax.dataset.runs import looked_at
from gfnn_jax.fitting import least_squares, shared_noise, uncertainty
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.maps.affine import Affine
from gfnn_jax.maps.damping import Damping
from gfnn_jax.models.generating_functions.size import Generates, Size

# Pairs of a block that goes to one of two halves: long beside the noise that neighbours share.
_HALVES_BLOCK = 50
# Rows per term of a larger size, by which noise is told from misfit.
SAMPLE_ROWS = 6
_NOISE_PAIRS = 4_096  # that tell the noise of each coordinate


class Factors(NamedTuple):
    """Factors of the training rows, of those held out, and of the training rows without the
    outermost twentieth and of that twentieth alone."""

    train: Triangle
    held: Triangle
    inner: Triangle
    outer: Triangle

    @classmethod
    def of(cls, inner: Triangle, outer: Triangle, held: Triangle) -> Factors:
        """The rows of the outermost twentieth are appended to the others by their own triangle."""
        return cls(inner.append(outer.factor, outer.rows), held, inner, outer)


class CoefficientNoise(Generates):
    """Base of the sweeps of a linear family, which know how their rows are made.

    _train: evaluation points, target gradients and args of the training rows. _weight: (2d,) that
    of each coordinate's rows. _factors: by group, those that are there.
    """

    _train: tuple[np.ndarray, ...]
    _weight: np.ndarray
    _factors: dict[Any, Factors]

    def factors(self, group: Any, budget: Budget, on_progress) -> Factors:
        """Factors of a group's largest family, which answer for all of its sizes."""
        raise NotImplementedError

    def _larger(self, size: Size) -> Size | None:
        """A larger size, which tells noise from misfit."""
        raise NotImplementedError

    def posterior(self, size: Size) -> Callable[[], np.ndarray]:
        """Function that makes the covariance root of the size's coefficients."""
        return partial(self.root, size)

    def root(self, size: Size) -> np.ndarray:
        """(m, m): rootᵀ root is the covariance of the size's coefficients.

        What of the residual is noise, a larger size tells: it leaves that too.
        """
        train = self.factors(size.group, Budget(), lambda message: None).train
        family, solved = size.family, self.solve(size, Budget(), lambda message: None)[0]
        larger = self._larger(size)
        most = family if larger is None else larger.family
        data, goes_on = self._sample(-(-SAMPLE_ROWS * most.num_parameters // self._width))
        w, target, *args = data
        params = family.unflatten(solved.coefficients)
        slopes = self._slopes(family, w, *args)
        residual = slopes @ solved.coefficients - target * self._weight
        states = None
        if goes_on.any() and self.moved_by_states:
            states = (residual, *self.by_states(family, params, w, *args), goes_on)
        scores = shared_noise.scores(slopes, *states) if states else None
        noise = self._noise(size, larger, data, states) if larger is not None else None
        return uncertainty.root(
            train,
            family.num_parameters,
            slopes.reshape(-1, family.num_parameters),
            residual.ravel(),
            noise=noise,
            ridge=solved.ridge,
            scores=scores,
        )

    def error_by_noise(self, size: Size) -> float:
        """Error of the size's ∇S by noise, in the measure of train_rms: half of the
        difference between the fits to either half of the training pairs, blocks in time."""
        half = self.data.training // _HALVES_BLOCK % 2
        train, held = self.factors(size.group, Budget(), lambda message: None)[:2]
        count = size.family.num_parameters
        one, other = (
            least_squares.solve(
                least_squares.reduce(
                    self.in_rows(size.family),
                    [tuple(a[half == i] for a in self._train)],
                    self._weight,
                ),
                held,
                count,
            ).coefficients
            for i in (0, 1)
        )
        return train.image_norm(one - other) / (2 * np.sqrt(train.rows))

    def state_deviations(self, size: Size) -> np.ndarray:
        """(2d,) standard deviation of each coordinate's noise, ÷ its scale, from what this size
        leaves of a sample of the training pairs."""
        (w, target, *args), goes_on = self._sample(_NOISE_PAIRS)
        solved, params = self.solve(size, Budget(), lambda message: None)
        slopes = self._slopes(size.family, w, *args)
        residual = slopes @ solved.coefficients - target * self._weight
        first, second = self.by_states(size.family, params, w, *args)
        step = np.linalg.solve(second, np.concatenate([residual[..., None], -first], axis=-1))
        return of_pairs(step[..., 0], step[..., 1:], np.flatnonzero(goes_on))

    def degrees_of_freedom(self, near: Size, most: Size, counts: Sequence[int]) -> list[float]:
        """Degrees of freedom that noise takes of a fit of so many of the leading terms of a size:
        as many, where no state stands in two pairs. near: whose residuals tell the noise; it may
        be the larger one, whose terms begin with those of the other."""
        (w, target, *args), goes_on = self._sample(-(-SAMPLE_ROWS * max(counts) // self._width))
        if not goes_on.any() or not self.moved_by_states:
            return [float(count) for count in counts]
        solved, params = self.solve(near, Budget(), lambda message: None)
        larger = max(near, most, key=lambda size: size.family.num_parameters)
        slopes = self._slopes(larger.family, w, *args)
        residual = slopes[..., : len(solved.coefficients)] @ solved.coefficients
        residual = residual - target * self._weight
        states = residual, *self.by_states(near.family, params, w, *args), goes_on
        scores = shared_noise.scores(slopes, *states)
        return [
            shared_noise.degrees_of_freedom(slopes[..., :count], residual, scores[:, :count])
            for count in counts
        ]

    @property
    def alike(self) -> float:
        """The weight of misfit beside noise, where a size is chosen by its expected error."""
        return uncertainty.ALIKE

    def _noise(self, size: Size, larger: Size, data, states) -> float:
        """The part of the residual's mean square that is noise, by what a larger size explains of
        it: of all rows where that one was estimated from all of them, else of these. states:
        residual, its derivatives and which pairs go on, as `shared_noise.scores` takes them, or
        None."""

        def left(of: Size) -> tuple[float, float, int]:
            """Mean square, the degrees of freedom that noise takes, and the rows."""
            count = of.family.num_parameters
            reduced = (
                self._factors[of.group].train
                if larger.group in self._factors
                else least_squares.reduce(self.in_rows(of.family), [data], self._weight)
            )
            degrees = float(count)
            if states is not None:
                slopes = self._slopes(of.family, data[0], *data[2:])
                scores = shared_noise.scores(slopes, *states)
                degrees = shared_noise.degrees_of_freedom(slopes, states[0], scores)
            square = reduced.residual_norm(count) ** 2 / max(reduced.rows, 1)
            return square, degrees, reduced.rows

        return part_of_noise(size, larger, left(size), left(larger))

    def _slopes(self, family, w, *args) -> np.ndarray:
        return self.in_rows(family).term_gradients(w, *args) * self._weight[:, None]

    def in_rows(self, family: Any) -> Any:
        """The family whose terms make the rows of this sweep."""
        return of_rows(family, weighted=self.data.weight is not None)

    def by_states(self, family, params, w, *args) -> tuple[np.ndarray, np.ndarray]:
        """The residual's derivatives in z₀ and z₁ (n, 2d, 2d), those ÷ their scale."""
        of_row = 1.0
        if self.data.weight is not None:
            *args, of_row = (*args[:-1], args[-1][..., None])
        hessian = family.gradient_and_hessian(params, w, *args)[1]
        if self.data.own_dt is not None:
            hessian = args[0][..., None] * hessian
        of_point, of_target = self.of_states
        by = of_row * self._weight[:, None] * (hessian @ of_point - of_target)
        return by[..., : len(of_point)], by[..., len(of_point) :]

    @cached_property
    def of_states(self) -> tuple[np.ndarray, np.ndarray]:
        """(2d, 4d) each: what the numbers of z₀ and z₁, ÷ their scale, add to w and to the target.
        An affine base map is counted, the flow of a law is not."""
        data, chart = self.data, self.chart
        dt = 1.0 if data.own_dt is not None else data.dt
        eye = np.eye(2 * data.dim)
        first, second, none = eye, eye, np.zeros_like(eye)
        for piece in data.before:
            first = getattr(piece, "matrix", eye) @ first
        for piece in data.after:
            second = getattr(piece, "matrix", eye) @ second
        ends = ((first.T, none), (none, np.linalg.inv(second).T))
        of_point = [chart.evaluation_point(*of).T * data.scale for of in ends]
        of_target = [chart.target_gradient(*of, dt).T * data.scale for of in ends]
        return np.concatenate(of_point, axis=1), np.concatenate(of_target, axis=1)

    @property
    def moved_by_states(self) -> bool:
        """Return whether ``of_states`` is all that states' noise does: not behind the flow of a
        law."""
        return all(isinstance(p, (Affine, Damping)) for p in (*self.data.before, *self.data.after))

    @property
    def _width(self) -> int:
        return self._train[0].shape[1]

    def _sample(self, pairs: int) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """Rows of about so many training pairs, and which of them go on with the next."""
        places, goes_on = looked_at(self.data.pairs, self.data.training, pairs)
        return tuple(a[places] for a in self._train), goes_on


def part_of_noise(
    size: Size, larger: Size, left: tuple[float, float, int], rest: tuple[float, float, int]
) -> float:
    """The part of what a size leaves over that is noise, by what a larger one explains of it: the
    mean square that either leaves, the degrees of freedom that noise takes, and the rows."""
    (of_all, taken, _), (of_rest, more, rows) = left, rest
    noise = of_rest / max(1.0 - more / rows, 1.0 / rows)
    if not noise > 0:
        return 1.0 if not of_all > 0 else 0.0
    further = larger.family.num_parameters - size.family.num_parameters
    each = noise * max(more - taken, 0.0) / further  # of noise, in what a further term explains
    explained = rows * max(of_all - of_rest, 0.0)
    return noise / (noise + uncertainty.misfit(explained, further, each) / rows)
