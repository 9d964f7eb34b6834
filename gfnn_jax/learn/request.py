"""Request of a fit, checked before any work."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.structures import Structure, structure_of
from gfnn_jax.dataset.varied import as_varied
from gfnn_jax.learn.check import (
    check_moves,
    check_request,
    coarse_tolerance,
    unlike_the_scene,
    unnamed_angles,
)
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.models.hamiltonians.fitted_law import PartialLaw
from gfnn_jax.phase_space import Pairs
from gfnn_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class Request:
    """Pairs in float64 and what is to be learned of them.

    options: of the fit, with ``learn`` as the pairs allow it. tolerance, structure: those of the
    options, and the scene's. on_progress, on_candidate: those of `gfnn.fit`. messages: warnings
    about the pairs and the request. partial_laws: those that were found so far.
    """

    pairs: Pairs
    scene: Scene | None
    coordinates: Coordinates
    options: FitOptions
    tolerance: Tolerance
    structure: Structure | None
    budget: Budget
    checkpoints: Any
    factors: Any
    on_progress: Callable[[str], Any]
    on_candidate: Callable[[Candidate], Any]
    messages: list[str]
    partial_laws: list[PartialLaw] = dataclasses.field(default_factory=list)

    def partly(self, law: PartialLaw) -> None:
        """Keep a law that explains a part."""
        self.on_progress(f"H: {law}")
        self.partial_laws.append(law)

    @property
    def reversor(self):
        """Reversor of the scene, or None."""
        return self.scene.reversor if self.scene is not None else None

    @property
    def seeks_law(self) -> bool:
        """Return whether H is looked for."""
        asked = self.options
        free = (asked.family, asked.chart, asked.base, asked.model) == ("auto", "auto", None, None)
        angles = self.structure is not None and bool(self.structure.angles)
        return (free or self.of_network) and asked.learn != "map" and not angles

    @property
    def of_network(self) -> bool:
        """Return whether H is to be a network."""
        return (self.options.learn, self.options.family) == ("hamiltonian", "mlp")


def lent(scene: Scene | None, options: FitOptions) -> str | None:
    """Structure that the scene lends where none is asked for: that of bodies is one of H alone."""
    if options.structure is not None or not isinstance(scene, Scene):
        return options.structure
    of_bodies = str(scene.structure).startswith("bodies")
    of_map = options.learn == "map" or options.chart != "auto"
    own = (options.family, options.base) != ("auto", None)
    return None if own or (of_bodies and of_map) else scene.structure


def checked(pairs: Pairs, scene: Scene | None, options: FitOptions, **others: Any) -> Request:
    """Make the request, with what is constant in the pairs as a constant.

    others: the remaining fields of `Request`. Raises FitError, in one line, where the pairs cannot
    give what is asked for.
    """
    structure = lent(scene, options)
    check_request(pairs, scene, options, structure)
    coordinates = (
        scene.coordinates if scene else Coordinates("cartesian", angles=tuple(options.angles))
    )
    found = structure_of(structure, pairs.dim, coordinates)
    z0, z1 = (np.asarray(z, np.float64) for z in (pairs.z0, pairs.z1))
    pairs = dataclasses.replace(pairs, z0=z0, z1=z1)
    pairs, learn, messages = as_varied(
        pairs,
        learn=options.learn,
        family=options.family,
        chart=options.chart,
        base=options.base,
        structure=structure,
    )
    check_moves(pairs)
    if scene is not None and scene.features is not None and options.family in ("auto", "features"):
        messages += unlike_the_scene(pairs, scene)
    bound = Tolerance.of(options)
    messages += [*coarse_tolerance(pairs, bound), *unnamed_angles(pairs, coordinates)]
    options = dataclasses.replace(options, learn=learn)
    return Request(pairs, scene, coordinates, options, bound, found, messages=messages, **others)
