"""The systems that come with the package: dynamics and sampling laws, each scene one function."""

import dataclasses
import math
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gfnn_jax.coordinates import Coordinates, polar, whole_turns
from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import (
    AroundOrbit,
    DrawnFrom,
    NormalSites,
    Scene,
    Section,
    UniformInEllipse,
)

MU = 0.012150585  # mass of the Moon ÷ that of the Earth and the Moon
ESCAPE_ENERGY = 1 / 6  # of Hénon and Heiles
GRAVITY = 9.81  # m/s²
_uniform = partial(jax.random.uniform, dtype=jnp.float64)

# Two bodies: relative motion on a Kepler ellipse (paper, section 4.1)


def kepler_energy(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 − 1/‖q‖."""
    q, p = split(z)
    return p @ p / 2 - 1 / jnp.sqrt(q @ q)


def angular_momentum(z: State) -> Scalar:
    """q₁p₂ − q₂p₁."""
    q, p = split(z)
    return q[0] * p[1] - q[1] * p[0]


def kepler_flow(z: State, t) -> State:
    """The exact solution at any time t, of either sign, of a bound orbit (energy < 0), else NaN.

    With x the eccentric anomaly gained since t = 0, Kepler's equation reads

        n t = x − (1 − r/a) sin x + (q·p/√a) (1 − cos x),    n = a^(−3/2),

    which stays regular on a circle. Whole revolutions are removed first; x is found by Laguerre's
    iteration (Conway, Celest. Mech. 39, 1986), and the state follows by Gauss' f and g, written so
    that nothing cancels. Accurate to roundoff times n t / (1 − e).
    """
    q, p = split(z)
    r = jnp.sqrt(q @ q)
    a = 1 / (2 / r - p @ p)
    root_a = jnp.sqrt(a)
    radial = q @ p
    e_cos, e_sin = 1 - r / a, radial / root_a

    mean = t / (a * root_a)
    mean = mean - whole_turns(mean)

    def laguerre(_, x):
        sin, cos = jnp.sin(x), jnp.cos(x)
        value = x - e_cos * sin + e_sin * (1 - cos) - mean
        slope = 1 - e_cos * cos + e_sin * sin
        curvature = e_cos * sin + e_sin * cos
        return x - 5 * value / (slope + 2 * jnp.sqrt(jnp.abs(4 * slope**2 - 5 * value * curvature)))

    x = jax.lax.fori_loop(0, 8, laguerre, mean)
    sin, versine = jnp.sin(x), 2 * jnp.sin(x / 2) ** 2  # versine = 1 − cos x
    r_end = r + a * e_cos * versine + root_a * radial * sin
    f, g = 1 - a / r * versine, root_a * r * sin + a * radial * versine
    f_dot, g_dot = -root_a * sin / (r * r_end), 1 - a / r_end * versine
    return jnp.concatenate([f * q + g * p, f_dot * q + g_dot * p])


def _ellipses(key, num):
    """Paper, Experimental Details: uniform in a and e; uniform mean anomaly and orientation."""
    ranges = jnp.array([(0.8, 1.2), (0.0, 0.05), (0.0, 2 * jnp.pi), (0.0, 2 * jnp.pi)])

    def uniform(key, range_):
        return _uniform(key, (num,), minval=range_[0], maxval=range_[1])

    # One program for the four of them, which takes most of the time to compile.
    a, e, mean_anomaly, turn = jax.vmap(uniform)(jax.random.split(key, 4), ranges)
    zero = jnp.zeros_like(a)
    periapsis = jnp.stack([a * (1 - e), zero, zero, jnp.sqrt((1 + e) / (a * (1 - e)))], axis=-1)
    x, y, p_x, p_y = jax.vmap(kepler_flow)(periapsis, mean_anomaly * a**1.5).T
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    turned = [cos * x - sin * y, sin * x + cos * y, cos * p_x - sin * p_y, sin * p_x + cos * p_y]
    return jnp.stack(turned, axis=-1)


def two_body(dt: float = 0.1) -> Scene:
    """H = ‖p‖²/2 − 1/‖q‖, counterclockwise near-circular orbits: a in (0.8, 1.2), e in (0, 0.05).

    a and e are uniform, and so are the mean anomaly and the direction of the periapsis. The
    reference is Kepler's exact solution. Learned in polar coordinates, where the angle is cyclic.
    """
    return Scene(
        name="two-body",
        purpose="Kepler ellipses, integrable: orbital elements over long times",
        dim=2,
        dt=dt,
        sampling=DrawnFrom(_ellipses),
        flow=kepler_flow,
        hamiltonian=kepler_energy,
        invariants={"energy": kepler_energy, "angular momentum": angular_momentum},
        coordinates=polar(cyclic=True),
        reversor=(1, -1, -1, 1),
        tolerance=1.4e-10,
    )


# The planar circular restricted three-body problem (paper, section 4.3)


def _inverse_distances(q):
    """1/r₁ and 1/r₂: to the larger body at (−μ, 0) and to the smaller at (1 − μ, 0)."""
    y2 = q[1] ** 2
    return 1 / jnp.sqrt((q[0] + MU) ** 2 + y2), 1 / jnp.sqrt((q[0] + MU - 1) ** 2 + y2)


def jacobi_energy(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 + p₁q₂ − p₂q₁ − (1 − μ)/r₁ − μ/r₂; the Jacobi constant is −2H, up to μ(1 − μ)."""
    q, p = split(z)
    inverse_r1, inverse_r2 = _inverse_distances(q)
    return p @ p / 2 + p[0] * q[1] - p[1] * q[0] - (1 - MU) * inverse_r1 - MU * inverse_r2


def pcr3bp_features(z: State):
    """(q₁, q₂, p₁, p₂, 1/r₁, 1/r₂): H is a polynomial of degree 2 in these."""
    return jnp.concatenate([z, jnp.stack(_inverse_distances(z[:2]))])


def pcr3bp(dt: float = 0.1) -> Scene:
    """Near-integrable orbits around the larger body, states within σ = 0.05 of one orbit, which
    starts on a circle of radius ½."""
    circular_speed = math.sqrt((1 - MU) / 0.5)
    return Scene(
        name="pcr3bp",
        purpose="a satellite of the larger of two bodies, rotating frame: not separable",
        dim=2,
        dt=dt,
        sampling=AroundOrbit((0.5 - MU, 0.0, 0.0, circular_speed - MU), 10_000, sigma=0.05),
        hamiltonian=jacobi_energy,
        invariants={"Jacobi energy": jacobi_energy},
        features=pcr3bp_features,
        reversor=(1, -1, -1, 1),
        num_pairs=10_000,
        tolerance=7e-7,
    )


# Bodies in space that attract each other: a star of mass 1 and three light companions


@dataclasses.dataclass(frozen=True)
class Gravity:
    """``energy(z)``: Σ_i |p_i|²/(2 m_i) − Σ_{i<j} m_i m_j/|q_i − q_j|."""

    masses: tuple[float, ...]

    def __call__(self, z: State, t=0.0) -> Scalar:
        q, p = (x.reshape(len(self.masses), -1) for x in split(z))
        masses = np.array(self.masses)
        kinetic = jnp.sum(jnp.sum(p**2, axis=1) / (2 * masses))
        a, b = np.array(list(combinations(range(len(masses)), 2))).T
        return kinetic - jnp.sum(masses[a] * masses[b] / jnp.linalg.norm(q[a] - q[b], axis=1))


@dataclasses.dataclass(frozen=True)
class Companions:
    """Law ``draw(key, num)`` of near-circular orbits of any phase about the star, slightly tilted.

    The frame is that of the centre of mass. radii: of the companions' orbits. spread: largest
    deviation of a radius, relative to it. faster: standard deviation of a speed, relative to that
    on a circle. tilt: standard deviation of a direction out of the plane, in radians.
    """

    masses: tuple[float, ...]
    radii: tuple[float, ...]
    spread: float
    faster: float
    tilt: float = 0.1

    def __call__(self, key, num):
        keys, shape = jax.random.split(key, 4), (num, len(self.radii))
        spread = 1 + self.spread * _uniform(keys[0], shape, minval=-1, maxval=1)
        r = jnp.asarray(self.radii)[None] * spread
        phase = _uniform(keys[1], shape, minval=0, maxval=2 * jnp.pi)
        tilt = self.tilt * jax.random.normal(keys[2], shape, jnp.float64)
        speed = (1 + self.faster * jax.random.normal(keys[3], shape, jnp.float64)) / jnp.sqrt(r)
        cos, sin, none = jnp.cos(phase), jnp.sin(phase), jnp.zeros(shape)
        q = r[..., None] * jnp.stack([cos, sin, none], axis=-1)
        along = jnp.stack([-sin * jnp.cos(tilt), cos * jnp.cos(tilt), jnp.sin(tilt)], axis=-1)
        p = jnp.asarray(self.masses[1:])[None, :, None] * along * speed[..., None]
        star = jnp.zeros((num, 1, 3))
        q = jnp.concatenate([star, q], axis=1)
        p = jnp.concatenate([star - jnp.sum(p, axis=1, keepdims=True), p], axis=1)
        return jnp.concatenate([q.reshape(num, -1), p.reshape(num, -1)], axis=1)


@dataclasses.dataclass(frozen=True)
class Component:
    """``value(z)``: one component of the momentum Σ p_i, or of the angular momentum Σ q_i × p_i."""

    bodies: int
    angular: bool

    def __call__(self, z: State) -> Scalar:
        q, p = (x.reshape(self.bodies, 3) for x in split(z))
        return jnp.sum(jnp.cross(q, p) if self.angular else p, axis=0)[2]


def n_body(dt: float = 0.05) -> Scene:
    """Four bodies of unequal masses in space, q body by body; the innermost orbit takes 2π. The
    states of pairs are spread wider than those of rollouts, so that such orbits stay among them."""
    masses, radii = (1.0, 0.01, 0.02, 0.005), (1.0, 1.9, 3.2)
    energy, bodies = Gravity(masses), len(masses)
    return Scene(
        name="n-body",
        purpose="a star and three companions in space: structure bodies:4",
        dim=3 * bodies,
        dt=dt,
        sampling=DrawnFrom(Companions(masses, radii, spread=0.25, faster=0.15)),
        test_states=DrawnFrom(Companions(masses, radii, spread=0.05, faster=0.02)),
        hamiltonian=energy,
        invariants={
            "energy": energy,
            "momentum": Component(bodies, angular=False),
            "angular momentum": Component(bodies, angular=True),
        },
        structure=f"bodies:{bodies}",
        num_pairs=1_000,
        tolerance=1e-12,
    )


# Hénon and Heiles: a star in a galaxy (paper, section 4.2)


def henon_heiles_energy(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 + ‖q‖²/2 + q₁²q₂ − q₂³/3 (Hénon & Heiles, Astron. J. 69, 1964)."""
    q, p = split(z)
    return p @ p / 2 + q @ q / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def printed_energy(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 + ‖q‖²/2 + q₁²q₂ + q₂³/3, as the paper prints it: separable in q₁ ± q₂, integrable."""
    q, p = split(z)
    return p @ p / 2 + q @ q / 2 + q[0] ** 2 * q[1] + q[1] ** 3 / 3


def printed_part(z: State) -> Scalar:
    """The printed form's energy in u = q₁ + q₂: p_u² + u²/4 + u³/6 with p_u = ½(p₁ + p₂)."""
    q, p = split(z)
    u, p_u = q[0] + q[1], (p[0] + p[1]) / 2
    return p_u**2 + u**2 / 4 + u**3 / 6


def henon_heiles(energy: float = 1 / 12, dt: float = 0.5, *, printed: bool = False) -> Scene:
    """States within σ = 0.01 (each coordinate) of one orbit of this energy, 0 < energy ≤ 1/6.

    The orbit starts on the section q₁ = 0 at p₂ = 0, p₁ > 0. Below E = 0.1 it does so at q₂ = ½√E,
    in the middle of the widest island, so that the perturbed states are regular too (E = 1/12:
    Lyapunov exponents over t = 2,000 at most 0.0035, falling as 1/t). From there on it starts at
    q₂ = −½√E, in the chaotic sea (E = 1/6 and just below: 0.12). 1/6 is the energy of escape, which
    perturbed states may exceed: chaotic rollouts start on an orbit itself, of energy at most
    1/6 − 0.001, inside the closed well.

    ``printed`` takes the paper's + q₂³/3: integrable, with the energy in q₁ + q₂ as its second
    invariant. Its orbits are bound up to E = 1/12 whichever way they share that energy.

    Raises ValueError where the energy is outside its range.
    """
    highest = 1 / 12 if printed else ESCAPE_ENERGY
    if not 0 < energy <= highest:
        raise ValueError(f"energy must be > 0 and at most {highest:.6g}, got {energy}")
    kind = "printed" if printed else "regular" if energy < 0.1 else "chaotic"
    chaotic = kind == "chaotic"

    def orbit(energy, sigma):
        q2, cubic = (-0.5 if chaotic else 0.5) * math.sqrt(energy), 1 / 3 if printed else -1 / 3
        p1 = math.sqrt(2 * energy - q2**2 - 2 * cubic * q2**3)
        return AroundOrbit((0.0, q2, p1, 0.0), num_steps=10_000, sigma=sigma)

    return Scene(
        name=f"henon-heiles-{kind}",
        purpose={
            "regular": "quasiperiodic, not integrable: errors over long times",
            "chaotic": "chaotic sea: Poincaré sections and statistics",
            "printed": "the paper's misprinted + sign: integrable, two exact invariants",
        }[kind],
        dim=2,
        dt=dt,
        sampling=orbit(energy, 0.01),
        test_states=orbit(min(energy, ESCAPE_ENERGY - 1e-3), 0.0) if chaotic else None,
        hamiltonian=printed_energy if printed else henon_heiles_energy,
        invariants=(
            {"energy": printed_energy, "energy in q1+q2": printed_part}
            if printed
            else {"energy": henon_heiles_energy}
        ),
        reversor=(1, 1, -1, -1),
        regular=not chaotic,
        num_pairs=8_000 if chaotic else 4_000,
        tolerance=3e-10 if chaotic else 5e-12,
    )


FIXED_POINT = (0.2755, 0.0)  # of the map below, to four digits


def _on_section(z: State) -> Float[Array, "whole"]:  # noqa: F821
    """(0, y, p_x, p_y) of z = (y, p_y), p_x > 0 such that E = 0.1; NaN where that is too little."""
    y, p_y = z
    p_x = jnp.sqrt(2 * 0.1 - p_y**2 - y**2 + 2 / 3 * y**3)
    return jnp.stack([jnp.zeros_like(y), y, p_x, p_y])


def henon_heiles_section() -> Scene:
    """(y, p_y) on x = 0, ẋ > 0 at E = 0.1, mapped to the next such crossing, about 6.1 later.

    Around the fixed point, a periodic orbit, lies the large island: closed curves from y = −0.1 to
    0.54, about twice as wide in y as in p_y. States are uniform in an ellipse of such a shape, from
    y = 0.085 to 0.445, those that rollouts start from in one a fifth smaller.
    """
    centre, axes = (0.265, 0.0), (0.18, 0.1)
    return Scene(
        name="henon-heiles-section",
        purpose="Poincaré return map of Hénon–Heiles, the large island of regular orbits",
        dim=1,
        dt=1.0,
        sampling=DrawnFrom(UniformInEllipse(centre, axes)),
        test_states=DrawnFrom(UniformInEllipse(centre, (0.8 * axes[0], 0.8 * axes[1]))),
        section=Section(henon_heiles_energy, index=0, lift=_on_section),
        reversor=(1, -1),
        num_pairs=1_000,
        tolerance=1.5e-9,
    )


# Pendulums: one that is driven, and some of different lengths


@dataclasses.dataclass(frozen=True)
class DrivenPendulum:
    """``hamiltonian(z, t)``: p²/2 − cos q (1 + a cos νt), a the amplitude and ν the frequency."""

    amplitude: float
    frequency: float

    def __call__(self, z: State, t=0.0) -> Scalar:
        q, p = z
        return p**2 / 2 - jnp.cos(q) * (1 + self.amplitude * jnp.cos(self.frequency * t))


def driven_pendulum(periods: int = 1, amplitude: float = 0.15, frequency: float = 1.0) -> Scene:
    """H = p²/2 − cos q (1 + a cos νt), its stroboscopic map over ``periods`` periods 2π/ν.

    States are uniform in the disc of radius 0.8 around the hanging pendulum, those that rollouts
    start from in the disc of radius 0.6. With a = 0.15 and ν = 1 the origin lies in Mathieu's
    second tongue, a weak saddle (multipliers 0.987 and 1.013 per period) between two centres at
    p = ±0.128; orbits turn by up to 0.31 per period at the disc's rim, so that many periods twist.
    """
    period = 2 * math.pi / frequency
    return Scene(
        name="driven-pendulum",
        purpose="stroboscopic map of a driven pendulum: one or more whole periods per step",
        dim=1,
        dt=periods * period,
        period=period,
        sampling=DrawnFrom(UniformInEllipse((0.0, 0.0), (0.8, 0.8))),
        test_states=DrawnFrom(UniformInEllipse((0.0, 0.0), (0.6, 0.6))),
        hamiltonian=DrivenPendulum(amplitude, frequency),
        reversor=(1, -1),
        num_pairs=3_000,
        tolerance=2.5e-10,
    )


def driven_pendulum_phase(
    steps: int = 16, amplitude: float = 0.15, frequency: float = 1.0
) -> Scene:
    """The pendulum of `driven_pendulum`, ``steps`` steps a period, from any time of the drive.

    H(z, t) is learned, whose flow steps from any time on over any dt.
    """
    stroboscopic = driven_pendulum(1, amplitude, frequency)
    return dataclasses.replace(
        stroboscopic,
        name="driven-pendulum-phase",
        purpose="driven pendulum at any phase of the drive: a law that depends on the time",
        dt=stroboscopic.dt / steps,
        any_phase=True,
        coordinates=Coordinates("cartesian", angles=(0,)),
        reversor=None,  # that of the stroboscopic map turns the drive's time too
        num_pairs=4_000,
        tolerance=1e-11,
    )


def pendulum_energy(z: State, t=0.0, args=(1.0,)) -> Scalar:
    """p²/(2 l²) − g l cos q of a unit mass: q the angle, p the angular momentum, l in metres."""
    q, p = z
    length = args[0]
    return p**2 / (2 * length**2) - GRAVITY * length * jnp.cos(q)


@dataclasses.dataclass(frozen=True)
class Swinging:
    """Law ``draw(key, num)`` of (q, p, l): l uniform between two lengths, states that librate.

    most: the largest amplitude of the angle, in radians.
    """

    shortest: float
    longest: float
    most: float

    def __call__(self, key, num):
        of_length, of_state = jax.random.split(key)
        length = _uniform(of_length, (num,), minval=self.shortest, maxval=self.longest)
        area, turn = _uniform(of_state, (2, num))
        half = jnp.sin(self.most / 2) * jnp.sqrt(area)
        # Small oscillations have frequency √(g/l): p is as large as l² √(g/l) times the angle.
        q = 2 * jnp.arcsin(half * jnp.cos(2 * jnp.pi * turn))
        p = 2 * length**1.5 * jnp.sqrt(GRAVITY) * half * jnp.sin(2 * jnp.pi * turn)
        return jnp.stack([q, p, length], axis=-1)


def pendulum_length(shortest: float = 0.5, longest: float = 2.0, dt: float = 0.05) -> Scene:
    """H = p²/(2 l²) − g l cos q, g = 9.81 m/s², lengths uniform in (0.5, 2) m.

    The pendulums swing by up to 2.6 radians; a step is 0.05 s, a 28th to a 56th of their periods.
    """
    return Scene(
        name="pendulum-length",
        purpose="pendulums of different lengths: one law with a parameter",
        dim=1,
        dt=dt,
        sampling=DrawnFrom(Swinging(shortest, longest, 2.6)),
        test_states=DrawnFrom(Swinging(shortest, longest, 2.2)),
        hamiltonian=pendulum_energy,
        parameters=("l",),
        coordinates=Coordinates("cartesian", angles=(0,)),
        num_pairs=4_000,
        tolerance=1e-11,
    )


# Standard maps without a flow, alone (paper, section 4.4) and coupled in a ring


@dataclasses.dataclass(frozen=True)
class Kick:
    """``step(z)``: p_i += k sin q_i + b (sin(q_{i+1} − q_i) + sin(q_{i−1} − q_i)), then q += p
    (paper, eq. (standardMap), for one q and b = 0).

    In type 2 it is S = Σ_i P_i²/2 + k cos q_i − b cos(q_{i+1} − q_i), dt = 1.
    """

    k: float
    b: float = 0.0

    def __call__(self, z: State) -> State:
        q, p = split(z)
        p = p + self.k * jnp.sin(q)
        if self.b:
            bond = self.b * jnp.sin(jnp.roll(q, -1) - q)
            p = p + bond - jnp.roll(bond, 1)
        return jnp.concatenate([q + p, p])


def standard_map(k: float = 0.6) -> Scene:
    """Chirikov's map of z = (θ, p), both of period 2π for the map; states within σ = 0.5 of one
    orbit, then reduced.

    Below K = 0.971635, where the chaos becomes connected in p (Greene 1979), the orbit starts at
    (0.3, π), in the two islands around θ = 0 and θ = π, p = π, between which it jumps at every step
    (K = 0.6: Lyapunov exponent over 10⁵ steps 1e-4, falling as 1/n). Above, it starts at
    (0.1, 0.1), beside the saddle and in the chaotic sea (K = 1.2: 0.19); there rollouts start on
    the orbit itself.

    Drawn states have θ and p in [0, 2π). Their images are not reduced, so that both are continuous.
    """
    regular = k < 0.971635
    orbit = AroundOrbit((0.3, math.pi) if regular else (0.1, 0.1), num_steps=10_000, sigma=0.5)
    seen = "two islands that the orbit jumps between" if regular else "the chaotic sea and islands"
    return Scene(
        name=f"standard-map-{'regular' if regular else 'chaotic'}",
        purpose=f"a map with no equation of motion: {seen}",
        dim=1,
        dt=1.0,
        sampling=orbit,
        test_states=None if regular else dataclasses.replace(orbit, sigma=0.0),
        step=Kick(k),
        coordinates=Coordinates("angles", angles=(0, 1)),
        regular=regular,
        num_pairs=1_000,
        tolerance=6e-13,
    )


@dataclasses.dataclass(frozen=True)
class Torus:
    """``draw(key, num)``: all of the torus [−π, π)^(2·dim)."""

    dim: int

    def __call__(self, key, num):
        return math.pi * _uniform(key, (num, 2 * self.dim), minval=-1.0, maxval=1.0)


def froeschle(dim: int = 64, k: float = 0.5, b: float = 0.1) -> Scene:
    """``dim`` standard maps coupled in a ring (Froeschlé, Astron. Astrophys. 16 (1972)). q and p of
    every site are uniform angles. Chaotic."""
    return Scene(
        name="froeschle",
        purpose="a ring of coupled standard maps, a map without a flow: structure ring",
        dim=dim,
        dt=1.0,
        sampling=DrawnFrom(Torus(dim)),
        step=Kick(k, b),
        coordinates=Coordinates("angles", angles=tuple(range(2 * dim))),
        structure="ring",
        regular=False,
        num_pairs=100,
        tolerance=1e-12,
    )


# Rings of springs


@dataclasses.dataclass(frozen=True)
class Springs:
    """``energy(z)``: Σ_i p_i²/2 + r_i²/2 + α r_i³/3 + β r_i⁴/4, r_i = q_{i+1} − q_i on a ring."""

    alpha: float
    beta: float

    def __call__(self, z: State, t=0.0) -> Scalar:
        q, p = split(z)
        r = jnp.roll(q, -1) - q
        bonds = r**2 / 2 + self.alpha * r**3 / 3 + self.beta * r**4 / 4
        return jnp.sum(p**2 / 2 + bonds)


def total_momentum(z: State) -> Scalar:
    """Σ p_i."""
    return jnp.sum(split(z)[1])


def fput(dim: int = 32, alpha: float = 0.0, beta: float = 1.0, dt: float = 0.1) -> Scene:
    """The β ring of ``dim`` sites (Fermi, Pasta, Ulam & Tsingou 1955); with ``alpha`` the α + β
    ring.

    q and p have standard deviations 0.2 and 0.28 at every site, which is about equipartition. The
    orbits are weakly chaotic.
    """
    energy = Springs(alpha, beta)
    return Scene(
        name="fput",
        purpose="a ring of sites, learned as a sum over them: structure ring",
        dim=dim,
        dt=dt,
        sampling=DrawnFrom(NormalSites(dim, 0.2, 0.28)),
        hamiltonian=energy,
        invariants={"energy": energy, "momentum": total_momentum},
        structure="ring",
        num_pairs=40,
        tolerance=1e-12,
    )


def toda_energy(z: State, t=0.0) -> Scalar:
    """Σ_i p_i²/2 + exp(q_i − q_{i+1}) on a ring."""
    q, p = split(z)
    return jnp.sum(p**2 / 2 + jnp.exp(q - jnp.roll(q, -1)))


def toda_third(z: State) -> Scalar:
    """Hénon's third invariant: Σ_i p_i³/3 + (p_i + p_{i+1}) exp(q_i − q_{i+1})."""
    q, p = split(z)
    return jnp.sum(p**3 / 3 + (p + jnp.roll(p, -1)) * jnp.exp(q - jnp.roll(q, -1)))


def toda(dim: int = 32, dt: float = 0.05) -> Scene:
    """Toda's ring of ``dim`` sites, exponential springs, as many invariants as sites (Toda 1967,
    Hénon 1974): q and p of standard deviation 0.3 at every site."""
    return Scene(
        name="toda",
        purpose="an integrable ring of sites with exponential springs: structure ring",
        dim=dim,
        dt=dt,
        sampling=DrawnFrom(NormalSites(dim, 0.3, 0.3)),
        hamiltonian=toda_energy,
        invariants={"energy": toda_energy, "third": toda_third},
        structure="ring",
        num_pairs=200,
        tolerance=1e-12,
    )
