"""What is asked of a fit, checked before any work."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.structures import Structure, structure_of
from gfnn_jax.learn.candidates import Candidate
from gfnn_jax.learn.check import (
    check_moves,
    check_request,
    coarse_tolerance,
    unlike_the_scene,
    unnamed_angles,
)
from gfnn_jax.learn.clock import Budget
from gfnn_jax.learn.varied import as_varied
from gfnn_jax.models.model import Model
from gfnn_jax.phase_space import Pairs
from gfnn_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class Request:
    """The pairs in float64 and what is to be learned from them, as the arguments of `gfnn.fit`.

    say, tell: its on_progress and on_candidate. messages: warnings about the pairs and the request.
    """

    pairs: Pairs
    scene: Scene | None
    coordinates: Coordinates
    tolerance: Tolerance
    learn: str
    terms: Sequence[str | Callable]
    base: str | Callable | None
    structure: Structure | None
    family: Any
    model: Model | None
    chart: str
    ensemble: int
    seed: int
    budget: Budget
    max_iterations: int
    checkpoints: Any
    factors: Any
    say: Callable[[str], Any]
    tell: Callable[[Candidate], Any]
    messages: list[str]

    @property
    def reversor(self):
        """The scene's, or None."""
        return self.scene.reversor if self.scene is not None else None

    @property
    def seeks_law(self) -> bool:
        """Whether H is looked for."""
        free = (self.family, self.chart, self.base, self.model) == ("auto", "auto", None, None)
        angles = self.structure is not None and bool(self.structure.angles)
        return (free or self.of_network) and self.learn != "map" and not angles

    @property
    def of_network(self) -> bool:
        """Whether H is to be a network."""
        return (self.learn, self.family) == ("hamiltonian", "mlp")


def lent(scene: Scene, learn: str, chart: str) -> str | None:
    """The structure that the scene lends: that of bodies is one of H alone."""
    of_bodies = str(scene.structure).startswith("bodies")
    return None if of_bodies and (learn == "map" or chart != "auto") else scene.structure


def checked(
    pairs: Pairs, scene: Scene | None, *, tolerance, absolute_tolerance, learn, terms, base,
    structure, family, model, chart, ensemble, angles, seed, budget: Budget, **others: Any,
) -> Request:  # fmt: skip
    """The request, with what is constant in the pairs as a constant.

    Raises FitError, in one line, where it or the pairs cannot give a map.
    """
    if structure is None and isinstance(scene, Scene) and (family, base) == ("auto", None):
        structure = lent(scene, learn, chart)
    bound = Tolerance(tolerance)
    if absolute_tolerance is not None:
        bound = Tolerance(absolute_tolerance, relative=False)
    check_request(
        pairs, scene, tolerance=bound.bound, chart=chart, learn=learn, family=family, model=model,
        angles=angles,
        terms=terms, base=base, structure=structure, ensemble=ensemble, seed=seed,
        max_seconds=budget.max_seconds, max_operations=budget.max_operations,
    )  # fmt: skip
    coordinates = scene.coordinates if scene else Coordinates("cartesian", angles=tuple(angles))
    found = structure_of(structure, pairs.dim, coordinates)
    z0, z1 = (np.asarray(z, np.float64) for z in (pairs.z0, pairs.z1))
    pairs = dataclasses.replace(pairs, z0=z0, z1=z1)
    pairs, learn, messages = as_varied(
        pairs, learn=learn, family=family, chart=chart, base=base, structure=structure
    )
    check_moves(pairs)
    if scene is not None and scene.features is not None and family in ("auto", "features"):
        messages += unlike_the_scene(pairs, scene)
    messages += [*coarse_tolerance(pairs, bound), *unnamed_angles(pairs, coordinates)]
    return Request(
        pairs, scene, coordinates, bound, learn, terms, base, found, family, model, chart, ensemble,
        seed,
        budget,
        messages=messages, **others,
    )  # fmt: skip
