"""Pairs made ready for a fit: inner coordinates, angles lifted, a base map factored out."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift, to_inner
from gfnn_jax.errors import FitError
from gfnn_jax.maps.affine import Affine
from gfnn_jax.maps.domain import Domain, covering
from gfnn_jax.phase_space import Pairs, sizes


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Pairs in the coordinates where S is learned. NumPy.

    y0, y1: (N, 2d) inner coordinates, angles lifted, the base map factored out. scale: (2d,) sizes
    of the inner coordinates. angle_centre: (a,) of each angle's interval. whole: the angles that
    cover their circle. half: R^½ of the base map R, or None.
    """

    y0: np.ndarray
    y1: np.ndarray
    scale: np.ndarray
    domain: Domain
    angle_centre: np.ndarray
    whole: tuple[int, ...]
    coordinates: Coordinates
    dt: float
    half: Affine | None = None

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.y0.shape[1] // 2

    def take(self, rows: np.ndarray) -> Prepared:
        """Of these rows alone; sizes and domain are theirs."""
        return _sized(dataclasses.replace(self, y0=self.y0[rows], y1=self.y1[rows]))

    def without(self, half: Affine) -> Prepared:
        """The base map R factored out: R^½ z -> R^−½ Z. The domain stays that of the states."""
        return dataclasses.replace(
            self, y0=half.image(self.y0), y1=half.inverse().image(self.y1), half=half
        )


def prepare(pairs: Pairs, coordinates: Coordinates) -> Prepared:
    """The pairs in the inner coordinates. Raises FitError where states have none."""
    before, after = (to_inner(coordinates, z) for z in (pairs.z0, pairs.z1))
    known = np.isfinite(before + after).all(axis=1)
    if not known.all():
        raise FitError(
            f"expected states that have {coordinates.name} coordinates, got "
            f"{int((~known).sum())} pairs without, the first is row {int(np.argmin(known))}"
        )
    y0, y1, centres, covered = lift(before, after, coordinates)
    whole = tuple(i for i, c in zip(coordinates.angles, covered, strict=True) if c)
    empty = covering(y0[:0], ignore=tuple(range(y0.shape[1])))
    return _sized(
        Prepared(y0, y1, np.ones(y0.shape[1]), empty, centres, whole, coordinates, float(pairs.dt))
    )


def _sized(prepared: Prepared) -> Prepared:
    ignore = (*prepared.coordinates.cyclic, *prepared.whole)
    return dataclasses.replace(
        prepared, scale=sizes(prepared.y0), domain=covering(prepared.y0, ignore=ignore)
    )
