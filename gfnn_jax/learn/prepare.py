"""Pairs made ready for a fit: inner coordinates, angles lifted, a base map factored out."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift, to_inner
from gfnn_jax.errors import FitError
from gfnn_jax.flows.flow import Flow
from gfnn_jax.maps.affine import Affine
from gfnn_jax.maps.domain import Domain, covering
from gfnn_jax.phase_space import Pairs, sizes


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Pairs in the coordinates where S is learned. NumPy.

    y0, y1: (N, 2d) inner coordinates, angles lifted, the base map factored out. scale: (2d,) sizes
    of the inner coordinates. angle_centre: (a,) of each angle's interval. whole: the angles that
    cover their circle. before, after: pieces that were factored out, in the order in which they
    are applied around what is learned: R^½ on both sides for an affine base map R, the flow of a
    law.
    """

    y0: np.ndarray
    y1: np.ndarray
    scale: np.ndarray
    domain: Domain
    angle_centre: np.ndarray
    whole: tuple[int, ...]
    coordinates: Coordinates
    dt: float
    before: tuple[Affine | Flow, ...] = ()
    after: tuple[Affine | Flow, ...] = ()

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.y0.shape[1] // 2

    def take(self, rows: np.ndarray) -> Prepared:
        """Of these rows alone; sizes and domain are theirs."""
        return _sized(dataclasses.replace(self, y0=self.y0[rows], y1=self.y1[rows]))

    def without(self, before: Affine | Flow | None, after: Affine | Flow | None) -> Prepared:
        """These pieces factored out: before(z) -> after⁻¹(Z). The domain stays that of the
        states."""
        found = self
        if before is not None:
            found = dataclasses.replace(
                found, y0=before.image(found.y0), before=(*found.before, before)
            )
        if after is not None:
            found = dataclasses.replace(
                found, y1=after.inverse().image(found.y1), after=(after, *found.after)
            )
        return found

    def whole_image(self, y: np.ndarray) -> np.ndarray:
        """The images of what is learned, y (N, 2d), as those of the map."""
        for piece in self.after:
            y = piece.image(y)
        return y


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
