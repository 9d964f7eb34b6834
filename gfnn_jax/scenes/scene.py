"""Scenes: dynamics + coordinates + sampling law + dt, as data and small pure functions."""

import dataclasses
import math
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.phase_space import State


@dataclasses.dataclass(frozen=True)
class DrawnFrom:
    """Law of states drawn directly: ``draw(key, num)`` -> (num, 2d) float64, run by ``jax.jit``.

    For a scene with k parameters ``draw`` returns (num, 2d + k), the parameters' values last.
    """

    draw: Callable


@dataclasses.dataclass(frozen=True)
class UniformInEllipse:
    """``draw(key, num)``: (q, p) of one degree of freedom, uniform inside an ellipse."""

    centre: tuple[float, float]
    semi_axes: tuple[float, float]

    def __call__(self, key, num):
        area, turn = jax.random.uniform(key, (2, num), jnp.float64)
        radius, angle = jnp.sqrt(area), 2 * jnp.pi * turn
        unit = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle)], axis=-1)
        return jnp.array([self.centre]) + jnp.array([self.semi_axes]) * unit


@dataclasses.dataclass(frozen=True)
class NormalSites:
    """``draw(key, num)``: independent normal q and p (num, 2·dim) around 0."""

    dim: int
    sigma_q: float
    sigma_p: float

    def __call__(self, key, num):
        unit = jax.random.normal(key, (2, num, self.dim), jnp.float64)
        return jnp.concatenate([self.sigma_q * unit[0], self.sigma_p * unit[1]], axis=-1)


@dataclasses.dataclass(frozen=True)
class AroundOrbit:
    """Law of states of one orbit, perturbed by a centred Gaussian (paper, "Experimental Details").

    start: the orbit's first state (2d,). num_steps: number of its time steps that are used.
    sigma: standard deviation of the perturbation of every coordinate.
    """

    start: tuple[float, ...]
    num_steps: int
    sigma: float


@dataclasses.dataclass(frozen=True)
class Section:
    """Surface of section x_index = 0 of an autonomous system, crossed upwards, at one energy.

    The state z of the return map holds the other coordinates, in their order. On the section dq∧dp
    of the whole system is dq∧dp of these, so that the map is symplectic (Poincaré).

    hamiltonian: ``hamiltonian(x, t)`` -> scalar, of the whole system's state x (2d + 2,).
    index:       index of the position in x that is zero on the section.
    lift:        ``lift(z)`` -> (2d + 2,): the state on the section, at the energy.
    """

    hamiltonian: Callable
    index: int
    lift: Callable

    def coordinates(self, x: Float[Array, "whole"]) -> State:  # noqa: F821
        """Coordinates z (2d,) of a state x (2d + 2,) on the section."""
        return jnp.delete(x, np.array([self.index, self.index + x.shape[0] // 2]))


@dataclasses.dataclass(frozen=True)
class Scene:
    """System with coordinates, sampling law, time step and a reference.

    The reference is the first of ``flow``, ``step``, ``section`` and ``hamiltonian`` that is given:
    an exact flow before an exact map before a numerical integration. A Hamiltonian beside an exact
    flow is an invariant, not the reference. Programs compiled for one scene serve another with the
    same functions. Functions with parameters of their own are therefore best frozen dataclasses
    with ``__call__``, which compare by value.

    name, purpose: one line, which `gfnn scenes` prints.
    dim:           degrees of freedom d.
    dt:            time step of the pairs; 1 for a map without time.
    sampling:      the law of the training states.
    test_states:   the law of the states that rollouts start from; the training law where None.
    flow:          ``flow(z, t)`` -> (2d,): the exact solution.
    step:          ``step(z)`` -> (2d,): the exact map.
    section:       the reference is the return map to it, and the scene a map without time.
    hamiltonian:   ``hamiltonian(z, t)`` -> scalar; autonomous ones ignore t (write ``t=0.0``).
    parameters:    names (k,) of the parameters that differ between systems. ``sampling`` draws
                   their values (k,) beside the states; ``hamiltonian(z, t, args)`` takes them.
    period:        period of a hamiltonian that depends on t. Unless ``any_phase``, ``dt`` is a
                   whole number of periods, so that every step is the same map.
    any_phase:     True where pairs and trajectories begin at any time of the period, drawn
                   uniformly.
    invariants:    name -> ``f(z)`` -> scalar, conserved exactly by the reference.
    coordinates:   the inner coordinates a fit uses (angles, cyclic coordinates, canonical change).
    features:      ``features(y)`` -> (k,): variables of S, functions of the inner coordinates,
                   where they are not y itself: invariants of a symmetry, inverse distances.
    reversor:      signs (2d,) of a linear reversor ρ in the inner coordinates (ρᵀJρ = −J and
                   φ∘ρ∘φ = ρ, φ the map), where there is one; it halves a midpoint basis.
    structure:     structure of many degrees of freedom that a fit uses by default, in the form that
                   `gfnn.fit` takes.
    regular:       True where the orbits are regular, so that error growth has an exponent.
    num_pairs:     number of pairs that `gfnn run` draws.
    tolerance:     relative one-step error that `gfnn run` asks for: RMS over coordinates of the
                   error divided by the coordinate's spread.
    """

    name: str
    purpose: str
    dim: int
    dt: float
    sampling: DrawnFrom | AroundOrbit
    test_states: DrawnFrom | AroundOrbit | None = None
    flow: Callable | None = None
    step: Callable | None = None
    section: Section | None = None
    hamiltonian: Callable | None = None
    parameters: tuple[str, ...] = ()
    period: float | None = None
    any_phase: bool = False
    invariants: Mapping[str, Callable] = dataclasses.field(default_factory=dict)
    coordinates: Coordinates = CARTESIAN
    features: Callable | None = None
    reversor: tuple[int, ...] | None = None
    structure: str | None = None
    regular: bool = True
    num_pairs: int = 4_000
    tolerance: float = 1e-8

    def __post_init__(self):
        for name in ("dt", "tolerance"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be finite and > 0, got {value}")
        if self.parameters and self.hamiltonian is None:
            raise ValueError(f"{self.name}: parameters need a hamiltonian that takes them")
        if self.any_phase and (self.period is None or self.hamiltonian is None):
            raise ValueError(f"{self.name}: any_phase needs a hamiltonian and its period")
        if self.period is not None and not self.any_phase:
            periods = self.dt / self.period
            if round(periods) < 1 or abs(periods - round(periods)) > 1e-9 * periods:
                raise ValueError(f"dt must be whole periods of {self.period}, got {self.dt}")

    @property
    def timeless(self) -> bool:
        """True for a map without time: an exact map or the return map to a section."""
        return self.step is not None or self.section is not None
