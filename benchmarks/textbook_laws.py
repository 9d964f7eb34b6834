"""Laws of the textbooks, as data: H, the states that are drawn, the step, what a fit is told.

A law is a sum of terms with coefficients, which is what a fit is to find. Pairs are integrated by
SciPy's DOP853 at 1e-13, which no part of the package uses. Of constants that no symmetry of the
system makes round (1, ½) the values are odd, so that none is met by chance.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.families.terms import given_terms
from gfnn_jax.phase_space import TIME, apply_j

_PRECISE = 1e-13
_TOGETHER = 50  # pairs that share the steps of one integration
_DRAWS = 40  # of so many orbits as are wanted, among which enough are bound
_SUBSTEPS = 8  # of a step of a noisy orbit
# What a law consists of, by which the results are counted.
POLYNOMIAL, CONSTANTS, MASSES, LATTICE, DRIVEN, MODES = (
    "polynomial",
    "constants or roots",
    "mass matrix",
    "lattice or bodies",
    "driven",
    "modes",
)


@dataclasses.dataclass(frozen=True)
class Law:
    """H = Σ coefficient · term, the terms texts in q1…qd, p1…pd (and t of a drive).

    low, high: (2d,) the box that states are drawn from. within: text -> (least, most), what is
    drawn again where it is not. dt: the step. kind: what it consists of. angles: indices of z that
    a fit is told are angles. period: of a drive. size: terms of the shortest way to write it, where
    that is not H (a mass matrix, a sum over sites).
    """

    terms: Mapping[str, float]
    low: tuple[float, ...]
    high: tuple[float, ...]
    dt: float
    kind: str
    within: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    angles: tuple[int, ...] = ()
    period: float | None = None
    size: int | None = None

    @property
    def dim(self) -> int:
        return len(self.low) // 2

    @property
    def parameters(self) -> tuple[str, ...]:
        return () if self.period is None else (TIME,)

    def states(self, count: int, rng: np.random.Generator, wider: float = 1.0) -> np.ndarray:
        """(count, 2d) of the box, or of one ``wider`` by this factor, and within what H allows."""
        low, high = np.array(self.low), np.array(self.high)
        middle, half = 0.5 * (low + high), 0.5 * wider * (high - low)
        limits = given_terms(self.dim, list(self.within)) if self.within else None
        found = np.zeros((0, 2 * self.dim))
        while len(found) < count:
            z = rng.uniform(middle - half, middle + half, (2 * count, 2 * self.dim))
            if limits is not None:
                for j, (least, most) in enumerate(self.within.values()):
                    one = limits.take((j,))
                    value = one.value(np.ones(1), z)
                    z = z[(value >= least / wider) & (value <= most * wider)]
            found = np.concatenate([found, z])
        return found[:count]

    def gradient(self, z, t=None) -> np.ndarray:
        """∇H (n, 2d) at states z (n, 2d), of a drive at the times t (n,)."""
        family = _family(self.dim, tuple(self.terms), self.parameters)
        args = None if t is None else np.reshape(t, (-1, 1))
        return family.gradient(np.array(list(self.terms.values())), z, args)

    def images(self, z, t0=None) -> np.ndarray:
        """The states (n, 2d) after dt."""
        found = []
        for first in range(0, len(z), _TOGETHER):
            part = z[first : first + _TOGETHER]
            begun = None if t0 is None else t0[first : first + _TOGETHER]

            def field(t, y, shape=part.shape, begun=begun):
                now = None if begun is None else begun + t
                return apply_j(self.gradient(y.reshape(shape), now)).ravel()

            solved = solve_ivp(
                field, (0, self.dt), part.ravel(), "DOP853", rtol=_PRECISE, atol=_PRECISE
            )
            found.append(solved.y[:, -1].reshape(part.shape))
        return np.concatenate(found)

    def followed(self, z, num_steps: int) -> np.ndarray:
        """The states (n, 2d) after so many steps of a law without a drive, one by one."""
        span = (0.0, num_steps * self.dt)
        solved = [
            solve_ivp(
                lambda t, y: apply_j(self.gradient(y[None]))[0],
                span,
                y0,
                "DOP853",
                rtol=_PRECISE,
                atol=_PRECISE,
            )
            for y0 in z
        ]
        return np.stack([s.y[:, -1] for s in solved])

    def sequences(self, count: int, states: int, noise: float, seed: int) -> gfnn.Pairs:
        """The pairs of so many orbits of so many measured states, with normal noise of this part of
        each coordinate's spread. Orbits stay within what H allows and a box twice as wide."""
        rng = np.random.default_rng(seed)
        middle = 0.5 * (np.array(self.low) + np.array(self.high))
        half = 0.5 * (np.array(self.high) - np.array(self.low))
        bounded = [i for i in range(2 * self.dim) if i not in self.angles]
        limits = given_terms(self.dim, list(self.within)) if self.within else None
        orbits, times = np.zeros((0, states, 2 * self.dim)), np.zeros(0)
        for _ in range(_DRAWS):
            z = self.states(count, rng)
            t0 = np.zeros(count) if self.period is None else rng.uniform(0, self.period, count)
            drawn = np.empty((count, states, 2 * self.dim))
            drawn[:, 0] = z
            with np.errstate(all="ignore"):
                for k in range(1, states):
                    t = None if self.period is None else t0 + (k - 1) * self.dt
                    drawn[:, k] = self._stepped(drawn[:, k - 1], t)
            inside = (np.abs(drawn - middle) <= 2 * half)[..., bounded].all(axis=(1, 2))
            if limits is not None:
                for j, (least, most) in enumerate(self.within.values()):
                    value = limits.take((j,)).value(np.ones(1), drawn)
                    inside &= ((value >= least) & (value <= most)).all(axis=1)
            orbits, times = np.concatenate([orbits, drawn[inside]]), np.append(times, t0[inside])
            if len(orbits) >= count:
                break
        else:
            raise ValueError(f"expected a box of more bound orbits, found {len(orbits)}")
        orbits, times = orbits[:count], times[:count]
        spread = orbits.reshape(-1, 2 * self.dim).std(axis=0)
        orbits = orbits + noise * spread * rng.normal(size=orbits.shape)
        run = np.repeat(np.arange(count), states - 1)
        drive = {}
        if self.period is not None:
            drive = {
                "t0": (times[:, None] + self.dt * np.arange(states - 1)).ravel(),
                "period": self.period,
            }
        return gfnn.Pairs(
            orbits[:, :-1].reshape(-1, 2 * self.dim),
            orbits[:, 1:].reshape(-1, 2 * self.dim),
            self.dt,
            run=run,
            place=np.tile(np.arange(states - 1), count),
            **drive,
        )

    def _stepped(self, z, t=None) -> np.ndarray:
        """The states (n, 2d) after dt by the classical Runge–Kutta method, to far below 1e-3."""
        h = self.dt / _SUBSTEPS

        def field(z, after):
            return apply_j(self.gradient(z, None if t is None else t + after))

        for k in range(_SUBSTEPS):
            k1 = field(z, k * h)
            k2 = field(z + 0.5 * h * k1, (k + 0.5) * h)
            k3 = field(z + 0.5 * h * k2, (k + 0.5) * h)
            k4 = field(z + h * k3, (k + 1) * h)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return z

    def pairs(self, count: int, seed: int) -> gfnn.Pairs:
        """Pairs drawn with this seed."""
        rng = np.random.default_rng(seed)
        z = self.states(count, rng)
        if self.period is None:
            return gfnn.Pairs(z, self.images(z), self.dt)
        t0 = rng.uniform(0, self.period, count)
        return gfnn.Pairs(z, self.images(z, t0), self.dt, t0=t0, period=self.period)


@functools.lru_cache(4)
def _family(dim: int, terms: tuple[str, ...], parameters: tuple[str, ...]):
    return given_terms(dim, terms, parameters)


def _kinetic(dim: int) -> dict[str, float]:
    return {f"p{i + 1}**2": 0.5 for i in range(dim)}


def _box(*sizes: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(-s for s in sizes), sizes


def _ring(dim: int, text: str, coefficient: float) -> dict[str, float]:
    """The term of every pair of neighbours of a ring, {i} and {j}."""
    return {text.format(i=i + 1, j=(i + 1) % dim + 1): coefficient for i in range(dim)}


_R = "sqrt(q1**2 + q2**2)"
_RING = {_R: (0.6, 2.0)}
_UP = (1.0, 0.8)


def _bodies(masses: tuple[float, ...]) -> Law:
    """Bodies in space under gravity, q body by body."""
    axes, terms, within = 3, {}, {}
    for i, m in enumerate(masses):
        square = " + ".join(f"p{axes * i + k + 1}**2" for k in range(axes))
        terms[square] = 0.5 / m
        for j in range(i):
            apart = " + ".join(
                f"(q{axes * i + k + 1} - q{axes * j + k + 1})**2" for k in range(axes)
            )
            terms[f"1/sqrt({apart})"] = -m * masses[j]
            within[f"sqrt({apart})"] = (0.6, 9.0)
    sizes = (1.5,) * axes * len(masses) + (0.6,) * axes * len(masses)
    return Law(terms, *_box(*sizes), 0.05, LATTICE, within, size=10)


LAWS: dict[str, Law] = {
    "kepler": Law({**_kinetic(2), f"1/{_R}": -1.0}, *_box(2, 2, 1, 1), 0.1, CONSTANTS, _RING),
    "kepler-radial": Law(
        {**_kinetic(1), "1/q1**2": 0.32, "1/q1": -1.0}, (0.6, -0.5), (2.5, 0.5), 0.1, CONSTANTS
    ),
    "morse": Law(
        {"p1**2": 0.5, "exp(-1.3*q1)": -1.6, "exp(-2.6*q1)": 0.8},
        (-0.5, -0.8),
        (1.8, 0.8),
        0.1,
        CONSTANTS,
    ),
    "springs-of-either-sign": Law(
        {**_kinetic(2), "cosh(1.2*(q1 - q2))": 0.7}, *_box(1, 1, 1, 1), 0.2, CONSTANTS
    ),
    "schwarzschild-radial": Law(
        {"p1**2": 0.5, "p1**2/q1": -1.0, "1/q1**2": 8.0, "1/(q1 - 2)": -1.0},
        (6.0, -0.3),
        (20.0, 0.3),
        1.0,
        CONSTANTS,
    ),
    "yukawa": Law(
        {**_kinetic(2), f"exp(-0.7*{_R})/{_R}": -1.5}, *_box(2, 2, 1, 1), 0.1, CONSTANTS, _RING
    ),
    "relativistic": Law({"sqrt(1 + p1**2)": 1.0, "q1**2": 0.5}, *_box(2, 2), 0.1, CONSTANTS),
    "exponential-springs": Law(
        {
            "p1**2": 0.5,
            "p2**2": 0.35,
            "exp(-1.1*(q2 - q1))": 0.9,
            "q1": -1.3,
            "q2": 1.3,
            "q1**2": 0.4,
        },
        *_box(1, 1, 1, 1),
        0.1,
        CONSTANTS,
    ),
    "field-and-quartic-well": Law(
        {
            "p1**2": 0.5,
            "p2**2": 0.5,
            "q2*p1": 0.6,
            "q1*p2": -0.6,
            "q1**2": 0.3,
            "q2**2": 0.3,
            "q1**4": 0.25,
            "q1**2*q2**2": 0.5,
            "q2**4": 0.25,
        },
        *_box(1, 1, 1, 1),
        0.1,
        POLYNOMIAL,
    ),
    "three-duffings": Law(
        {
            **_kinetic(3),
            "q1**2": 0.65,
            "q2**2": 0.8,
            "q3**2": 0.65,
            "q1*q2": -0.3,
            "q2*q3": -0.3,
            "q1**4": 0.25,
            "q2**4": 0.25,
            "q3**4": 0.25,
        },
        *_box(1, 1, 1, 1, 1, 1),
        0.1,
        POLYNOMIAL,
    ),
    "schwarzschild": Law(
        {"p1**2": 0.5, "1/q1": -1.0, "1/q1**2": 8.0, "1/q1**3": -16.0},
        (5.0, -0.15),
        (20.0, 0.15),
        2.0,
        CONSTANTS,
    ),
    "two-vortices": Law(
        {"log((q1 - q2)**2 + (p1 - p2)**2)": -0.5},
        *_box(1, 1, 1, 1),
        0.1,
        CONSTANTS,
        {"(q1 - q2)**2 + (p1 - p2)**2": (0.3, 8.0)},
    ),
    "cart": Law(
        {
            "(0.3*p1**2 - 0.6*cos(q2)*p1*p2 + p2**2)/(1 - 0.3*cos(q2)**2)": 0.5,
            "cos(q2)": -1.0,
            "q1**2": 0.2,
        },
        (-1.0, -2.5, -1.0, -1.0),
        (1.0, 2.5, 1.0, 1.0),
        0.1,
        MASSES,
        angles=(1,),
        size=5,
    ),
    "anisotropic-oscillator": Law(
        {**_kinetic(2), "q1**2": 0.5, "q2**2": 1.1}, *_box(1, 1, 1, 1), 0.1, POLYNOMIAL
    ),
    "pendulum": Law({"p1**2": 0.5, "cos(q1)": -1.0}, *_box(2.8, 1.5), 0.1, MODES, angles=(0,)),
    "duffing": Law({"p1**2": 0.5, "q1**2": -0.5, "q1**4": 0.25}, *_box(1.6, 1), 0.1, POLYNOMIAL),
    "henon-heiles": Law(
        {**_kinetic(2), "q1**2": 0.5, "q2**2": 0.5, "q1**2*q2": 1.0, "q2**3": -1 / 3},
        *_box(0.5, 0.5, 0.4, 0.4),
        0.1,
        POLYNOMIAL,
    ),
    "lennard-jones": Law(
        {**_kinetic(2), "1/(q1 - q2)**12": 4.0, "1/(q1 - q2)**6": -4.0},
        (0.5, -0.5, -0.8, -0.8),
        (1.8, 0.3, 0.8, 0.8),
        0.02,
        CONSTANTS,
        {"q1 - q2": (0.98, 2.2)},
    ),
    "toda-3": Law(
        {**_kinetic(3), **_ring(3, "exp(q{i} - q{j})", 1.0)}, *_box(1, 1, 1, 1, 1, 1), 0.1, LATTICE
    ),
    "magnetic-field": Law(
        {
            "p1**2": 0.5,
            "p2**2": 0.5,
            "q2*p1": 0.35,
            "q1*p2": -0.35,
            "q1**2": 0.06125,
            "q2**2": 0.06125,
        },
        *_box(1, 1, 1, 1),
        0.1,
        POLYNOMIAL,
    ),
    "penning-trap": Law(
        {**_kinetic(3), "q2*p1": 0.8, "q1*p2": -0.8, "q1**2": 0.12, "q2**2": 0.12, "q3**2": 0.2},
        *_box(1, 1, 1, 1, 1, 1),
        0.1,
        POLYNOMIAL,
    ),
    "paul-trap": Law(
        {**_kinetic(2), "q1**2": 0.1, "q2**2": -0.1, "q1**2*cos(2*t)": 0.6, "q2**2*cos(2*t)": -0.6},
        *_box(1, 1, 1, 1),
        0.1,
        DRIVEN,
        period=np.pi,
    ),
    "three-vortices": Law(
        {
            "log((q1 - q2)**2 + (p1 - p2)**2)": -0.5,
            "log((q1 - q3)**2 + (p1 - p3)**2)": -0.5,
            "log((q2 - q3)**2 + (p2 - p3)**2)": -0.5,
        },
        *_box(1, 1, 1, 1, 1, 1),
        0.1,
        CONSTANTS,
        {f"(q{i} - q{j})**2 + (p{i} - p{j})**2": (0.3, 8.0) for i, j in ((1, 2), (1, 3), (2, 3))},
    ),
    "double-pendulum": Law(
        {
            "(p1**2 - 2*cos(q1 - q2)*p1*p2 + 2*p2**2)/(2 - cos(q1 - q2)**2)": 0.5,
            "cos(q1)": -2.0,
            "cos(q2)": -1.0,
        },
        *_box(2.5, 2.5, 1, 1),
        0.1,
        MASSES,
        angles=(0, 1),
        size=5,
    ),
    "elastic-pendulum-polar": Law(
        {**_kinetic(1), "p2**2/q1**2": 0.5, "q1**2": 4.0, "q1": -8.0, "q1*cos(q2)": -1.0},
        (0.7, -1.2, -0.5, -0.7),
        (1.6, 1.2, 0.5, 0.7),
        0.1,
        MASSES,
        angles=(1,),
    ),
    "elastic-pendulum": Law(
        {**_kinetic(2), "q1**2": 4.0, "q2**2": 4.0, _R: -8.0, "q2": 1.0},
        *_box(1.6, 1.6, 0.7, 0.7),
        0.1,
        CONSTANTS,
        {_R: (0.6, 1.7)},
    ),
    "spherical-pendulum": Law(
        {**_kinetic(1), "p2**2/sin(q1)**2": 0.5, "cos(q1)": -1.0},
        (0.5, -3.0, -1.0, -1.0),
        (2.6, 3.0, 1.0, 1.0),
        0.1,
        MASSES,
        angles=(0, 1),
    ),
    "restricted-three-bodies": Law(
        {
            **_kinetic(2),
            "q2*p1": 1.0,
            "q1*p2": -1.0,
            "1/sqrt((q1 + 0.2)**2 + q2**2)": -0.8,
            "1/sqrt((q1 - 0.8)**2 + q2**2)": -0.2,
        },
        *_box(1.6, 1.6, 1, 1),
        0.05,
        CONSTANTS,
        {"sqrt((q1 + 0.2)**2 + q2**2)": (0.5, 3.0), "sqrt((q1 - 0.8)**2 + q2**2)": (0.4, 3.0)},
    ),
    "josephson-dimer": Law(
        {"p1**2": 1.2, "sqrt(1 - p1**2)*cos(q1)": -1.0},
        *_box(3.0, 0.8),
        0.1,
        CONSTANTS,
        angles=(0,),
    ),
    "lotka-volterra": Law(
        {"exp(q1)": 0.7, "q1": -1.1, "exp(p1)": 0.9, "p1": -1.3}, *_box(1, 1), 0.1, CONSTANTS
    ),
    "heavy-top": Law(  # Euler angles: precession, nutation, spin
        {"p2**2": 0.5, "(p1 - p3*cos(q2))**2/sin(q2)**2": 0.5, "p3**2": 0.8, "cos(q2)": 1.5},
        (-3.0, 0.5, -3.0, -1.0, -1.0, -1.0),
        (3.0, 2.6, 3.0, 1.0, 1.0, 1.0),
        0.05,
        MASSES,
        angles=(0, 1, 2),
        size=7,
    ),
    "toda-32": Law(
        {**_kinetic(32), **_ring(32, "exp(q{i} - q{j})", 1.0)},
        *_box(*[0.6] * 64),
        0.1,
        LATTICE,
        size=2,
    ),
    "four-bodies": _bodies((1.0, 0.7, 0.5, 0.3)),
    "frenkel-kontorova": Law(
        {
            **_kinetic(8),
            **_ring(8, "(q{i} - q{j})**2", 0.5),
            **{f"cos(q{i + 1})": -0.8 for i in range(8)},
        },
        *_box(*[1.5] * 8, *[0.8] * 8),
        0.1,
        LATTICE,
        size=3,
    ),
    "soft-coulomb": Law(
        {**_kinetic(2), "1/sqrt(0.53 + q1**2 + q2**2)": -1.0}, *_box(1.5, 1.5, 1, 1), 0.1, CONSTANTS
    ),
    "kepler-quadrupole": Law(
        {**_kinetic(2), f"1/{_R}": -1.0, f"1/{_R}**3": -0.05, f"q2**2/{_R}**5": 0.15},
        *_box(2, 2, 1, 1),
        0.1,
        CONSTANTS,
        _RING,
    ),
}

# Laws that no library holds: a formula for one of these is false.
OUTSIDE: dict[str, Law] = {
    "bessel-like": Law(
        {**_kinetic(1), "sin(q1**2)*exp(-0.3*q1)": 0.7, "q1**2": 0.5}, *_box(1.8, 1), 0.1, "outside"
    ),
    "arctangent": Law(
        {**_kinetic(1), "q1*arctan(2.3*q1)": 0.8, "log(1 + exp(1.7*q1))": 0.4},
        *_box(2, 1),
        0.1,
        "outside",
    ),
    "nested": Law(
        {"sqrt(1 + p1**2 + 0.3*exp(sin(q1)))": 1.0, "tanh(q1*p1)": 0.2},
        *_box(1.5, 1),
        0.1,
        "outside",
    ),
    "two-ranges": Law(
        {**_kinetic(2), f"1/({_R} + 0.3*{_R}**2.3)": -1.0, f"exp(-q1**2*{_R})": 0.2},
        *_box(2, 2, 1, 1),
        0.1,
        "outside",
        _RING,
    ),
    "saturating": Law(
        {"log(1 + exp(p1**2))": 0.5, "log(1 + q1**4)": 0.5, "sin(q1 + exp(0.4*p1))": 0.1},
        *_box(1.5, 1.5),
        0.1,
        "outside",
    ),
}
