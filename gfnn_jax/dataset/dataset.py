"""The one data set that a fit sees: the pairs as measured, the same rows in the coordinates where
a model is learned, and which of them train, choose and state the error.

It is made once and frozen. Taking rows, factoring a known map out and training on fewer rows give
another, whose rows keep their run, their place and the row that the user knows them by.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift, lift_sites, to_inner, to_user
from gfnn_jax.dataset.split import Split, split_rows
from gfnn_jax.dataset.structures import Structure
from gfnn_jax.errors import FitError
from gfnn_jax.flows.collocation import of_lanes
from gfnn_jax.flows.flow import Flow
from gfnn_jax.maps.domain import Domain, Ranges, covering
from gfnn_jax.maps.piece import Affine, Damping
from gfnn_jax.phase_space import Pairs, sizes

Factored = Affine | Damping | Flow  # pieces that can be factored out of pairs


@dataclasses.dataclass(frozen=True)
class Dataset:
    """N pairs of states, all that is known of them, and the part that each has in a fit. NumPy.

    pairs: as measured, in the user's coordinates, with run, place, dt, args and std. row: (N,) the
    user's row of each. y0, y1: (N, 2d) the same in the inner coordinates, where a model is learned:
    angles lifted, what is known factored out. split: rows of each part.
    scale: (2d,) sizes of the inner coordinates. domain: where states were. coordinates: the change
    between the two views. angle_centre: (a,) of each angle's interval. whole: angles that cover
    their circle. before, after: pieces that were factored out, in the order in which they are
    applied around what is learned: R^½ on both sides for an affine base map R, the flow of a law,
    D_b behind a map that loses area. structure: of many degrees of freedom, whose sizes and domain
    are then those of its parts.
    """

    pairs: Pairs
    row: np.ndarray
    y0: np.ndarray
    y1: np.ndarray
    split: Split
    scale: np.ndarray
    domain: Domain | Ranges
    coordinates: Coordinates
    angle_centre: np.ndarray
    whole: tuple[int, ...]
    before: tuple[Factored, ...] = ()
    after: tuple[Factored, ...] = ()
    structure: Structure | None = None

    @classmethod
    def of(
        cls,
        pairs: Pairs,
        coordinates: Coordinates,
        structure: Structure | None = None,
        row: np.ndarray | None = None,
    ) -> Dataset:
        """The pairs in both coordinates, all of them for training.

        row: (N,) the user's row of each; None: their order. Raises FitError where states have no
        inner coordinates.
        """
        before, after = (to_inner(coordinates, z) for z in (pairs.z0, pairs.z1))
        known = np.isfinite(before + after).all(axis=1)
        if not known.all():
            raise FitError(
                f"{int((~known).sum())} pairs have no {coordinates.name} coordinates of the scene, "
                f"the first is number {int(np.argmin(known))}, from 0. Leave them out, or fit "
                "without --scene"
            )
        lifted = lift if structure is None or not structure.angles else lift_sites
        y0, y1, centres, covered = lifted(before, after, coordinates)
        whole = tuple(i for i, c in zip(coordinates.angles, covered, strict=True) if c)
        nowhere = covering(y0[:0], ignore=tuple(range(y0.shape[1])))
        every, size = np.arange(len(pairs)), np.ones(y0.shape[1])
        row, split = every if row is None else row, Split(every, every[:0], every[:0], every)
        inner = coordinates, centres, whole
        found = cls(pairs, row, y0, y1, split, size, nowhere, *inner, structure=structure)
        return found._measured()

    def __len__(self) -> int:
        return len(self.y0)

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.y0.shape[1] // 2

    @property
    def training(self) -> np.ndarray:
        """Rows that determine coefficients, shuffled."""
        return self.split.training

    @property
    def validation(self) -> np.ndarray:
        """Rows that choose between models, shuffled."""
        return self.split.validation

    @property
    def test(self) -> np.ndarray:
        """Rows that state the error, once everything is chosen; none where the pairs are few."""
        return self.split.test

    @property
    def run(self) -> np.ndarray:
        """(N,) the run of each row."""
        return np.asarray(self.pairs.run)

    @property
    def noise(self) -> np.ndarray | None:
        """Standard deviation of the noise on the user's coordinates, (2d,) or of each value
        (N, 2d); None where it is to be estimated."""
        return self.pairs.std

    @property
    def noise_of_channels(self) -> np.ndarray | None:
        """(2d,): of noise of each value the root of the mean square."""
        if self.noise is None or self.noise.ndim == 1:
            return self.noise
        return np.sqrt(np.mean(self.noise**2, axis=0))

    @cached_property
    def weight(self) -> np.ndarray | None:
        """(N, 2d): the usual noise of a coordinate, its RMS over the rows, ÷ that of each value,
        where it was given of each value and differs; else None. A row of a least-squares problem is
        multiplied by it. Behind a change of coordinates, or what was factored out, which mix them,
        all values of a pair have one weight.
        """
        if self.noise is None or self.noise.ndim == 1 or not np.ptp(self.noise, axis=0).any():
            return None
        relative = self.noise / self.noise_of_channels
        if self.before or self.after or not self.coordinates.plain:
            relative = np.sqrt(np.mean(relative**2, axis=1, keepdims=True))
        return np.broadcast_to(1.0 / relative, self.y0.shape)

    @cached_property
    def spread(self) -> np.ndarray:
        """(2d,) sizes of the user's coordinates."""
        return sizes(self.pairs.z0)

    @cached_property
    def own_dt(self) -> np.ndarray | None:
        """(N,) the dt of each row, where they differ."""
        return np.asarray(self.pairs.dt, np.float64) if np.ndim(self.pairs.dt) else None

    @cached_property
    def dt(self) -> float:
        """The dt of all rows, or in the middle of those that differ."""
        return float(self.pairs.dt if self.own_dt is None else np.median(self.own_dt))

    @property
    def each_dt(self) -> Any:
        """A number, or (N,) where the rows differ."""
        return self.dt if self.own_dt is None else self.own_dt

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the args, the time of a drive last."""
        return tuple(self.pairs.args or ())

    @cached_property
    def args(self) -> np.ndarray | None:
        """(N, k) values of the ``parameters``; None where there are none."""
        given = self.pairs.args
        return np.stack([given[name] for name in given], axis=-1) if given else None

    @property
    def period(self) -> float | None:
        """Period of a drive."""
        return self.pairs.period

    @property
    def varied(self) -> bool:
        """Return whether rows differ in their dt or in parameters."""
        return self.own_dt is not None or self.args is not None

    @property
    def user_angles(self) -> tuple[int, ...]:
        """The angles among the user's coordinates."""
        return self.coordinates.user_angles

    def given(self, rows) -> tuple[Any, Any]:
        """(dt, args) of these rows."""
        return of_lanes(self.each_dt, rows), of_lanes(self.args, rows)

    def divided(self, seed: int) -> Dataset:
        """Draw rows for training, validation and test by the seed (`dataset.split`)."""
        return dataclasses.replace(self, split=split_rows(self.pairs, seed))

    def trained_on(self, rows: np.ndarray) -> Dataset:
        """Take these rows for training; validation and test as they are."""
        return dataclasses.replace(self, split=self.split._replace(training=rows))

    def validated_on(self, rows: np.ndarray) -> Dataset:
        """Take these rows for validation; training and test as they are."""
        return dataclasses.replace(self, split=self.split._replace(validation=rows))

    def validating(self, others: Pairs) -> Dataset:
        """Other pairs for training, as of a law's flow, and this one's validation rows to choose
        by; none state an error.

        Raises FitError where states of the others have no inner coordinates.
        """
        held, count = self.pairs.take(self.validation), len(others)
        both = (others.z0, held.z0), (others.z1, held.z1)
        z0, z1 = map(np.concatenate, both)
        rows = np.arange(len(z0))
        split = Split(rows[:count], rows[count:], rows[:0], rows)
        both = Dataset.of(Pairs(z0, z1, self.dt), self.coordinates, self.structure)
        return dataclasses.replace(both, split=split)

    def take(self, rows: np.ndarray) -> Dataset:
        """Take these rows alone, each in its part; sizes and domain are theirs."""
        each = {name: getattr(self, name)[rows] for name in ("row", "y0", "y1")}
        pairs, split = self.pairs.take(rows), self.split.take(rows)
        return dataclasses.replace(self, pairs=pairs, split=split, **each)._measured()

    def lifted_anew(self, rows: np.ndarray) -> Dataset:
        """Take these rows alone, their angles lifted among themselves, nothing factored out and all
        of them for training."""
        return Dataset.of(self.pairs.take(rows), self.coordinates, self.structure, self.row[rows])

    def without(self, before: Factored | None, after: Factored | None) -> Dataset:
        """Factor these pieces out: before(z) -> after⁻¹(Z). The domain stays that of the
        states."""
        found = self
        if before is not None:
            y0 = before.image(found.y0, found.args)
            found = dataclasses.replace(found, y0=y0, before=(*found.before, before))
        if after is not None:
            y1 = after.inverse().image(found.y1, found.args)
            found = dataclasses.replace(found, y1=y1, after=(after, *found.after))
        return found

    def whole_image(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The images of what is learned, y (n, 2d) of these rows, as those of the map."""
        for piece in self.after:
            y = piece.image(y, of_lanes(self.args, rows))
        return y

    def users_image(self, y: np.ndarray, known: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The same in the user's coordinates, NaN where an image is not ``known`` (n,)."""
        images = self.whole_image(np.where(known[:, None], y, np.nan), rows)
        return to_user(self.coordinates, images)

    def _measured(self) -> Dataset:
        """Measure sizes and domain of these rows."""
        structure = self.structure
        if structure is not None:
            scale, domain = structure.sizes(self.y0), structure.domain(self.y0)
        else:
            ignore = (*self.coordinates.cyclic, *self.whole)
            scale, domain = sizes(self.y0), covering(self.y0, ignore=ignore)
        return dataclasses.replace(self, scale=scale, domain=domain)
