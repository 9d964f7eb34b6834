"""What a scene is: dynamics + coordinates + sampling law + dt, as data and small pure functions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping

from gfnn_jax.coordinates import CARTESIAN, Coordinates


@dataclasses.dataclass(frozen=True)
class DrawnFrom:
    """States drawn directly: ``draw(key, num)`` -> (num, 2d) float64."""

    draw: Callable


@dataclasses.dataclass(frozen=True)
class AroundOrbit:
    """States of one orbit, perturbed by a centred Gaussian (paper, "Experimental Details").

    start: the orbit's first state (2d,). num_steps: how many time steps of it are used.
    sigma: standard deviation of the perturbation of every coordinate.
    """

    start: tuple[float, ...]
    num_steps: int
    sigma: float


@dataclasses.dataclass(frozen=True)
class Scene:
    """A system as a user meets it; one of ``flow``, ``step``, ``hamiltonian`` is its reference.

    They are taken in that order: an exact flow before an exact map before a numerical integration
    (a Hamiltonian may be given beside an exact flow; it is then an invariant, not the reference).

    name, purpose: as `gfnn scenes` prints them, one line.
    dim:           degrees of freedom d.
    dt:            time step of the pairs; 1 for a map without time.
    sampling:      the law of the training states.
    test_states:   the law of the states that rollouts start from; the training law where None.
    flow:          ``flow(z, t)`` -> (2d,): the exact solution.
    step:          ``step(z)`` -> (2d,): the exact map.
    hamiltonian:   ``hamiltonian(z, t)`` -> scalar; autonomous ones ignore t (write ``t=0.0``).
    invariants:    name -> ``f(z)`` -> scalar, conserved exactly by the reference.
    coordinates:   the inner coordinates a fit uses (angles, cyclic coordinates, canonical change).
    features:      ``features(y)`` -> (k,): what S is a function of, in the inner coordinates,
                   where it is not y itself: invariants of a symmetry, inverse distances.
    reversor:      signs (2d,) of a linear reversor ρ in the inner coordinates (ρᵀJρ = −J and
                   φ∘ρ∘φ = ρ, φ the map), where there is one; it halves a midpoint basis.
    regular:       True where the orbits are regular, so that error growth has an exponent.
    """

    name: str
    purpose: str
    dim: int
    dt: float
    sampling: DrawnFrom | AroundOrbit
    test_states: DrawnFrom | AroundOrbit | None = None
    flow: Callable | None = None
    step: Callable | None = None
    hamiltonian: Callable | None = None
    invariants: Mapping[str, Callable] = dataclasses.field(default_factory=dict)
    coordinates: Coordinates = CARTESIAN
    features: Callable | None = None
    reversor: tuple[int, ...] | None = None
    regular: bool = True

    def __post_init__(self):
        if not (math.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"dt must be finite and > 0, not {self.dt}")
