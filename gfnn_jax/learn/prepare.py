"""Pairs made ready for a fit: inner coordinates, angles lifted, a base map factored out."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift, lift_sites, to_inner
from gfnn_jax.errors import FitError
from gfnn_jax.flows.collocation import of_lanes
from gfnn_jax.flows.flow import Flow
from gfnn_jax.learn.structures import Sites, Structure
from gfnn_jax.maps.affine import Affine
from gfnn_jax.maps.damping import Damping
from gfnn_jax.maps.domain import Domain, Ranges, covering
from gfnn_jax.phase_space import Pairs, sizes

Factored = Affine | Damping | Flow  # pieces that can be factored out of pairs


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Pairs in the coordinates where S is learned. NumPy.

    y0, y1: (N, 2d) inner coordinates, angles lifted, the base map factored out. scale: (2d,) sizes
    of the inner coordinates. angle_centre: (a,) of each angle's interval. whole: the angles that
    cover their circle. before, after: pieces that were factored out, in the order in which they
    are applied around what is learned: R^½ on both sides for an affine base map R, the flow of a
    law, D_b behind a map that loses area. dt: of all pairs, or in the middle of those that differ,
    which are ``own_dt`` (N,). args: (N, k) values of the ``parameters``, or None. period: of a
    drive, whose time is their last.
    structure: of many degrees of freedom, whose sizes and domain are then those of its parts.
    """

    y0: np.ndarray
    y1: np.ndarray
    scale: np.ndarray
    domain: Domain | Ranges
    angle_centre: np.ndarray
    whole: tuple[int, ...]
    coordinates: Coordinates
    dt: float
    before: tuple[Factored, ...] = ()
    after: tuple[Factored, ...] = ()
    own_dt: np.ndarray | None = None
    args: np.ndarray | None = None
    parameters: tuple[str, ...] = ()
    structure: Structure | None = None
    period: float | None = None

    @property
    def each_dt(self) -> Any:
        """A number, or (N,) where the pairs differ."""
        return self.dt if self.own_dt is None else self.own_dt

    @property
    def varied(self) -> bool:
        """Whether pairs differ in their dt or in parameters."""
        return self.own_dt is not None or self.args is not None

    @property
    def of_terms(self) -> bool:
        """Whether S, where it is learned, is a sum of terms: with parameters, or over sites."""
        sites = isinstance(self.structure, Sites) and self.own_dt is None
        return sites or self.args is not None

    @property
    def of_one_dt(self) -> bool:
        """Whether S can be a series in the state, and in parameters where there are some: not of
        several dt, nor in the time of a drive."""
        return self.own_dt is None and self.period is None

    def given(self, rows) -> tuple[Any, Any]:
        """(dt, args) of these rows."""
        return of_lanes(self.each_dt, rows), of_lanes(self.args, rows)

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.y0.shape[1] // 2

    def take(self, rows: np.ndarray) -> Prepared:
        """Of these rows alone; sizes and domain are theirs."""
        own_dt, args = (of_lanes(values, rows) for values in (self.own_dt, self.args))
        return _sized(
            dataclasses.replace(self, y0=self.y0[rows], y1=self.y1[rows], own_dt=own_dt, args=args)
        )

    def without(self, before: Factored | None, after: Factored | None) -> Prepared:
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


def prepare(pairs: Pairs, coordinates: Coordinates, structure: Structure | None = None) -> Prepared:
    """The pairs in the inner coordinates. Raises FitError where states have none."""
    before, after = (to_inner(coordinates, z) for z in (pairs.z0, pairs.z1))
    known = np.isfinite(before + after).all(axis=1)
    if not known.all():
        raise FitError(
            f"expected states that have {coordinates.name} coordinates, got "
            f"{int((~known).sum())} pairs without, the first is row {int(np.argmin(known))}"
        )
    lifted = lift if structure is None or not structure.angles else lift_sites
    y0, y1, centres, covered = lifted(before, after, coordinates)
    whole = tuple(i for i, c in zip(coordinates.angles, covered, strict=True) if c)
    empty = covering(y0[:0], ignore=tuple(range(y0.shape[1])))
    own_dt = np.asarray(pairs.dt, np.float64) if np.ndim(pairs.dt) else None
    given: dict[str, np.ndarray] = pairs.args or {}
    names = tuple(given)
    args = np.stack([given[name] for name in names], axis=-1) if names else None
    dt = float(pairs.dt if own_dt is None else np.median(own_dt))
    return _sized(
        Prepared(
            y0, y1, np.ones(y0.shape[1]), empty, centres, whole, coordinates, dt, own_dt=own_dt,
            args=args, parameters=names, period=pairs.period, structure=structure,
        )
    )  # fmt: skip


def _sized(prepared: Prepared) -> Prepared:
    structure = prepared.structure
    if structure is not None:
        return dataclasses.replace(
            prepared, scale=structure.sizes(prepared.y0), domain=structure.domain(prepared.y0)
        )
    ignore = (*prepared.coordinates.cyclic, *prepared.whole)
    return dataclasses.replace(
        prepared, scale=sizes(prepared.y0), domain=covering(prepared.y0, ignore=ignore)
    )
