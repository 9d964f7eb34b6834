"""The map of a law: the flow of a Lagrangian with friction and inputs, over the time of a sample.

States are z = (q, p) with p = ∂L/∂v; `maps.laws.states_of` and `velocities_of` change to
velocities and back. Where only uniform friction acts, or none, the map is conformally symplectic.
"""

import dataclasses
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift
from gfnn_jax.families.friction import LINEAR
from gfnn_jax.families.lagrangian import Lagrangian, coordinates_in
from gfnn_jax.flows.bodies import BodiesLaw, OfBodies
from gfnn_jax.flows.collocation import Steps, images, of_lanes
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.legendre import Legendre, family_of, law_of
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.parameters import sampled
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import sizes, split


class Options:
    """Options of the steps of a law's map (benchmarks/speed.py)."""

    stages: tuple[int, ...] = (3, 4, 6, 8)  # that are tried
    substeps: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    # h × the fastest rate of a substep: of what fixed-point iterations solve, and Newton's method.
    contracting: float = 1.0
    stiffest: float = 30.0
    test_states: int = 64  # whose step tells the error of these
    nearly: float = 0.95  # of them, whose steps are to be within the tolerance


def map_of_law(
    law: Lagrangian,
    z,
    dt: float,
    *,
    angles: Sequence[int] = (),
    signals: Signals | None = None,
    inputs: Any = None,
    parameters: tuple[str, ...] = (),
    args: Any = None,
    root: Any = None,
    tolerance: float = 1e-9,
) -> SymplecticMap:
    """The map over dt of a law that was learned from states z (N, 2d), NumPy.

    angles: indices of q that have period 2π. signals: the inputs, where the law has gains of any;
    inputs: (N, k) at these states, by which the steps are chosen too. parameters: names of those
    that the law depends on; args: (N, k) their values at these states. root: (m, m), rootᵀ root the
    covariance of the law's coefficients (θ, ρ, G row by row, and γ where there is uniform
    friction). tolerance: of the step's own error, ÷ sizes of the coordinates.

    Raises ValueError where ``signals`` are not as many as the law has inputs.
    """
    count = 0 if signals is None else len(signals.names)
    if count != law.num_inputs:
        raise ValueError(f"expected signals of {law.num_inputs} inputs, got {count}")
    family, params = family_of(law, 0 if signals is None else signals.degree)
    coordinates = Coordinates("cartesian", angles=tuple(angles))
    z, _, centre, covered = lift(np.asarray(z, float), np.asarray(z, float), coordinates)
    whole = tuple(a for a, all_of_it in zip(angles, covered, strict=True) if all_of_it)
    scale, some = sizes(z), slice(None, None, -(-len(z) // Options.test_states))
    own = args[some] if parameters else None
    u = None
    if signals is not None:
        u = np.zeros((len(z), count)) if inputs is None else np.asarray(inputs, float)
        u = u[some]
        own = signals.constant(own, u, z[some].shape, np.float64)
    one = law.at(args[some]) if parameters else law
    flow = Flow(family, params, dt, scale)
    steps = _steps(flow, z[some], own, tolerance, stiffness(one, split(z[some])[0], u))
    flow = dataclasses.replace(flow, **dataclasses.asdict(steps))
    posterior = None if root is None else Posterior(0, np.asarray(root))
    more: dict[str, Any] = {"posterior": posterior, "signals": signals}
    more["parameters"] = sampled(parameters, args) if parameters else None
    domain = covering(z, ignore=whole)
    return SymplecticMap((flow,), coordinates, domain, scale, centre, float(dt), **more)


def smoothed(law: Lagrangian, width: float) -> Lagrangian:
    """The law whose dry friction, where it has no width, is smoothed over these speeds: a flow has
    no events."""
    friction = law.friction
    widths = np.where(friction.jumps, width, friction.widths)
    return dataclasses.replace(law, friction=dataclasses.replace(friction, widths=widths))


def conformal(law: Lagrangian, covariance: np.ndarray) -> tuple[Lagrangian, np.ndarray]:
    """The same law with its friction as uniform friction, where one degree of freedom has constant
    mass m and R = ½ρv² alone: γ = ρ/m; and the covariance (n, n) of (θ, γ), from that of (θ, ρ).
    Its map keeps a multiple of the symplectic form. Any other law as it is."""
    rows = law.terms.rows()
    plain = all(sum(row[0]) == 2 and not any(coordinates_in(row)) for row in rows if any(row[0]))
    alone = [row[1] for row in law.friction.rows()] == [LINEAR] and law.uniform == 0
    if law.powers is not None:  # γ is one number for all systems
        of_rate = [p for p, row in zip(law.powers, rows, strict=False) if any(row[0])]
        alone = alone and not any(map(any, (*of_rate, law.powers[law.terms.count])))
    if law.dim > 1 or law.num_inputs or not plain or not alone:
        return law, covariance
    mass = 2 * sum(c for c, row in zip(law.coefficients, rows, strict=True) if any(row[0]))
    by = np.append(np.ones(law.terms.count), 1 / mass)
    even = dataclasses.replace(
        law,
        friction=law.friction.take([]),
        losses=law.losses[:0],
        uniform=float(law.losses[0]) / mass,
        powers=None if law.powers is None else law.powers[: law.terms.count],
    )
    return even, by[:, None] * covariance * by


def stiffness(law: Lagrangian | BodiesLaw, q: np.ndarray, u: np.ndarray | None = None) -> float:
    """The fastest rate at which dry friction brings bodies to rest at positions q (n, d) under
    inputs u (n, k), 1/time; 0 without dry friction."""
    if not np.any(law.friction.dry):
        return 0.0
    rates = np.linalg.solve(law.masses(q), law.losses_by_v(q, 0 * q, u))
    return float(np.abs(np.linalg.eigvals(rates)).max())


def is_of_law(map_: SymplecticMap) -> bool:
    """True for the flow of a Lagrangian."""
    piece = map_.pieces[0]
    flow = len(map_.pieces) == 1 and isinstance(piece, Flow)
    return flow and isinstance(without_forces(piece.family), Legendre)


def law_of_map(map_: SymplecticMap) -> Lagrangian:
    """The law whose flow the map is. Raises ValueError for any other map."""
    if not is_of_law(map_):
        raise ValueError("expected the map of a Lagrangian")
    piece = map_.pieces[0]
    return law_of(piece.family, np.asarray(piece.params))


def dynamics_of(map_: SymplecticMap) -> Lagrangian | BodiesLaw:
    """The law of a map with its masses and forces, of bodies on joints too. Raises ValueError for
    any other map."""
    law = bodies_of_map(map_)
    return law_of_map(map_) if law is None else law


def bodies_of_map(map_: SymplecticMap) -> BodiesLaw | None:
    """The law of bodies on joints, as of an arm, whose flow the map is; None of any other map."""
    piece = map_.pieces[0]
    family = getattr(piece, "family", None)
    if not isinstance(family, Forced) or not isinstance(family.family, OfBodies):
        return None
    own, losses, gains = family.parts(np.asarray(piece.params))
    return family.family.law(own, family.friction, losses, gains)


def states_of(map_: SymplecticMap, q, v, args=None):
    """z = (q, p) (..., 2d) of positions and velocities (..., d); args (..., k): parameters of the
    system, of a map that has such."""
    law = dynamics_of(map_).at(args)
    return np.concatenate([q, law.momentum(np.asarray(q), np.asarray(v))], axis=-1)


def velocities_of(map_: SymplecticMap, z, args=None):
    """v (..., d) of states z = (q, p) (..., 2d), as `states_of`."""
    law = dynamics_of(map_).at(args)
    if isinstance(law, BodiesLaw):
        return law.velocity(*split(np.asarray(z)))
    return Legendre(law.terms).velocity(law.coefficients, np.asarray(z))


class InverseDynamics(NamedTuple):
    """Generalised forces (..., d) of a motion, in the unit of L by those of the coordinates; the
    inputs (..., k) that come closest to them, in their own units; and the forces (..., d) that are
    left, 0 where every coordinate is driven."""

    forces: np.ndarray
    inputs: np.ndarray
    left: np.ndarray


def inverse_dynamics(map_: SymplecticMap, q, v, a, args=None) -> InverseDynamics:
    """The forces beside friction that make a motion, M a − (∂L/∂q − …) + ∂R/∂v, as
    `SymplecticMap.inverse_dynamics`."""
    q, v, a = (np.asarray(values, float) for values in (q, v, a))
    if not q.shape == v.shape == a.shape or q.shape[-1:] != (map_.dim,):
        raise ValueError(
            f"expected q, v and a of one shape (..., {map_.dim}), got {q.shape}, {v.shape}, "
            f"{a.shape}"
        )
    law = _law_at(map_, args)
    if isinstance(law, Lagrangian) and (law.terms.driven or np.any(law.friction.loaded)):
        raise ValueError(
            "terms of this law have inputs: a motion tells no inputs by its gains alone"
        )
    masses, forces = law.balance(q, v)
    needed = np.einsum("...ij,...j->...i", masses, a) - forces
    gains = np.broadcast_to(law.gains, (*q.shape[:-1], *law.gains.shape[-2:]))
    inputs = np.einsum("...ki,...i->...k", np.linalg.pinv(gains), needed)
    return InverseDynamics(needed, inputs, needed - np.einsum("...ik,...k->...i", gains, inputs))


def mass_matrix(map_: SymplecticMap, q, args=None) -> np.ndarray:
    """M(q) (..., d, d) of positions (..., d), as `SymplecticMap.mass_matrix`."""
    return _law_at(map_, args).masses(np.asarray(q, float))


def _law_at(map_: SymplecticMap, args) -> Lagrangian | BodiesLaw:
    """The law of a map for a system. Raises ValueError of another map, and without parameters that
    it depends on."""
    law = dynamics_of(map_)
    if law.powers is not None and args is None:
        raise ValueError("expected the parameters of the system (args=): the law depends on them")
    return law.at(None if args is None else np.asarray(args, float))


def _steps(flow: Flow, z, args, tolerance: float, rate: float) -> Steps:
    """The cheapest steps of a flow whose own error is within the tolerance at nearly all of these
    states; and whether Newton's method is to solve them: where dry friction of this ``rate``
    (`stiffness`) is stiff, whose force turns over within ε, and no more than Newton's method bears
    in a substep.

    Substeps of the most stages are halved until nearly all states stay where they are; those that
    do are halved no further, and are what steps of fewer stages are compared with."""
    dt, most = float(flow.dt), Options.stages[-1]
    turned = dt * rate
    fewest, stiff = turned / Options.stiffest, bool(turned > Options.contracting)

    def after(steps: Steps, lanes: Any = slice(None)) -> np.ndarray:
        given = of_lanes(args, lanes)
        return images(flow.family, flow.params, z[lanes], dt, steps, args=given).states

    def off(states: np.ndarray, others: np.ndarray) -> np.ndarray:
        return ~(np.abs((states - others) / flow.scale).max(axis=1) <= tolerance)

    least, allowed = Options.substeps[-1], (1 - Options.nearly) * len(z)
    enough = [n for n in Options.substeps if n >= min(fewest, least)]
    reference, moving = after(Steps(most, enough[0])), np.arange(len(z))
    for substeps in enough:
        before = reference[moving]
        reference[moving] = after(Steps(most, 2 * substeps), moving)
        moving = moving[off(before, reference[moving])]
        if len(moving) <= allowed:
            break
    else:
        return Steps(most, least, stiff)
    every = product(Options.stages, (n for n in enough if n >= substeps))
    for _, stages, substeps in sorted((s**2 * n, s, n) for s, n in every):
        tried = Steps(stages, substeps, stiff)
        if np.sum(off(after(tried), reference)) <= allowed:
            return tried
    return Steps(most, least, stiff)
