"""Mechanics that no other study has: is the law found that made each recording?

    python benchmarks/vocabulary.py                    every kind, three draws of each
    python benchmarks/vocabulary.py --only foucault    one kind
    python benchmarks/vocabulary.py --quick            one draw of each kind, into runs/

A kind is a Lagrangian L and Rayleigh's R as text, with numbers, a start and a sampling that are
drawn; SciPy integrates the equations that SymPy makes of them, and positions are seen with noise of
1e-3 of their spread, 20 to 60 samples a period, 8 to 20 periods. Nothing but the recording and
which coordinates are angles is given; a drive that no column shows is a sinusoid. A law is *right*
whose forecasts of a period, from true states along the recording, err by less than 2 % of the
spread in the median; its terms are *exact*
where they are those of the truth, and z is the largest distance of one of their coefficients from
the truth in its standard errors. A wrong law is *silent* whose verdict is `identified` and that
comes without a message.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError

DRAWS, NOISE, RIGHT = 3, 1e-3, 0.02
SAMPLES, PERIODS = (20.0, 60.0), (8.0, 20.0)
_STARTS, _AHEAD = 11, 10
_TOLERANCES = {"rtol": 1e-10, "atol": 1e-12, "method": "DOP853"}
_WIDTH = 1e-3  # of speeds, over which dry friction turns

Terms = Mapping[str, float]
Rates = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


class System(NamedTuple):
    """L and R, term -> coefficient, in x1, … and v1, …; where the motion begins (q, v); which
    coordinates are angles; the period of its motion; forces in t that no column shows, or in u1,
    an input that is recorded where there is ``dwell``, the samples for which it keeps a value; and
    coordinates that drive others."""

    lagrangian: Terms
    start: tuple[tuple[float, ...], tuple[float, ...]]
    angles: tuple[int, ...] = ()
    friction: Terms = MappingProxyType({})
    period: float = 2 * np.pi
    push: tuple[str, ...] = ()
    dwell: int = 0
    leaders: tuple[int, ...] = ()


def _plane(rng: np.random.Generator) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """A start in the plane, some way off, with a speed across."""
    turn = rng.uniform(0, 2 * np.pi)
    out, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    return tuple(rng.uniform(0.7, 1.2) * out), tuple(rng.uniform(0.3, 0.8) * across)


FREE = {"v1**2": 0.5, "v2**2": 0.5}


def foucault(rng: np.random.Generator) -> System:
    return System(
        {**FREE, "x1**2": -0.5, "x2**2": -0.5, "v2*x1": 2 * rng.uniform(0.03, 0.2)}, _plane(rng)
    )


def uniform_field(rng: np.random.Generator) -> System:
    trap = rng.uniform(0.02, 0.1)
    return System({**FREE, "v2*x1": rng.uniform(0.7, 1.3), "x1**2": -trap}, _plane(rng))


def gradient_field(rng: np.random.Generator) -> System:
    return System({**FREE, "v2*x1": 1.0, "v2*x1**2": rng.uniform(0.1, 0.25)}, _plane(rng))


def dipole_field(rng: np.random.Generator) -> System:
    (x, y), (vx, vy) = _plane(rng)
    size = rng.uniform(2, 4)
    term = {"v2*x1/sqrt(x1**2+x2**2)**3": -size, "v1*x2/sqrt(x1**2+x2**2)**3": size}
    start = (1.2 * x, 1.2 * y), (0.5 * vx, 0.5 * vy)
    return System({**FREE, **term}, start, period=2 * np.pi / size)


def penning(rng: np.random.Generator) -> System:
    axial = rng.uniform(0.4, 0.8) ** 2
    terms = {**FREE, "v3**2": 0.5, "v2*x1": rng.uniform(1.6, 2.2), "x3**2": -axial / 2}
    q, v = _plane(rng)
    return System(
        {**terms, "x1**2": axial / 4, "x2**2": axial / 4},
        ((*q, rng.uniform(0.5, 1)), (*v, 0.0)),
    )


def coriolis_pair(rng: np.random.Generator) -> System:
    stiff = rng.uniform(1.2, 1.8)
    return System(
        {**FREE, "x1**2": -0.5, "x2**2": -0.5 * stiff, "v2*x1": rng.uniform(0.1, 0.4)},
        _plane(rng),
        friction={"v1**2": rng.uniform(0.003, 0.015), "v2**2": rng.uniform(0.003, 0.015)},
    )


def rotating_saddle(rng: np.random.Generator) -> System:
    saddle, turn = rng.uniform(0.2, 0.6), 1.0
    return System(
        {
            **FREE,
            "v2*x1": 2 * turn,
            "x1**2": (turn**2 - saddle) / 2,
            "x2**2": (turn**2 + saddle) / 2,
        },
        ((0.3, 0.1), (rng.uniform(0.0, 0.1), rng.uniform(-0.2, -0.05))),
        period=4 * np.pi,
    )


def two_wells(rng: np.random.Generator) -> System:
    return System(
        {"v1**2": 0.5, "x1**2": 0.5, "x1**4": -0.25},
        ((rng.uniform(1.6, 2.0),), (0.0,)),
        friction={"v1**2": rng.uniform(0.01, 0.04)},
    )


def hoop(rng: np.random.Generator) -> System:
    spin = rng.uniform(1.6, 3)
    return System(
        {"v1**2": 0.5, "cos(x1)": 1.0, "cos(2*x1)": -spin / 4},
        ((rng.uniform(1.8, 2.6),), (0.0,)),
        (0,),
        {"v1**2": rng.uniform(0.01, 0.04)},
    )


def ball_and_beam(rng: np.random.Generator) -> System:
    terms = {"v1**2": 0.5, "v2**2": rng.uniform(0.5, 1.5), "v2**2*x1**2": 0.5 / 1.4}
    return System(
        {**terms, "x1*sin(x2)": -1 / 1.4, "x2**2": -rng.uniform(2, 4), "x1**2": -0.3},
        ((rng.uniform(0.5, 1), rng.uniform(0.3, 0.6)), (0.0, 0.0)),
        (1,),
    )


def rocking_disc(rng: np.random.Generator) -> System:
    arm = rng.uniform(0.15, 0.35)
    return System(
        {"v1**2": 0.5, "v1**2*cos(x1)": -arm, "cos(x1)": arm},
        ((rng.uniform(1.2, 2.2),), (0.0,)),
        (0,),
        {"v1**2": rng.uniform(0.005, 0.02)},
        period=2 * np.pi / np.sqrt(arm),
    )


def wire(rng: np.random.Generator) -> System:
    bend = rng.uniform(0.4, 0.8)
    return System(
        {"v1**2": 0.5, "v1**2*x1**2": 2 * bend**2, "x1**2": -bend},
        ((rng.uniform(0.8, 1.4),), (0.0,)),
        friction={"v1**2": rng.uniform(0.005, 0.02)},
    )


def central(rng: np.random.Generator) -> System:
    a = float(rng.choice([-1, 1, 3]))
    return System({**FREE, f"sqrt(x1**2+x2**2)**({a:g})": -1 / a}, _plane(rng))


def springs_between_angles(rng: np.random.Generator) -> System:
    between = rng.uniform(0.3, 1)
    q = rng.uniform(0.8, 1.8), rng.uniform(-1.5, -0.5)
    return System(
        {**FREE, "cos(x1)": 1.0, "x1**2": -between, "x1*x2": 2 * between, "x2**2": -between},
        (q, (0.0, 0.0)),
        (0, 1),
        {"v1**2": rng.uniform(0.005, 0.02), "v2**2": rng.uniform(0.005, 0.02)},
    )


def polar(rng: np.random.Generator) -> System:
    """A body in a plane by its distance and direction: held by a spring, by a weight on a string
    through a hole, or by gravity; or on a rod that turns with it."""
    spring, rod = {"x1": 6.0, "x1**2": -3.0}, {"v2**2": 0.3, "x1**2": -3.0}
    hold = (spring, {"x1": -4.0}, {"1/x1": 1.0}, rod)[rng.integers(4)]
    size = float(rng.uniform(0.8, 1.2))
    held = {term: size * value for term, value in hold.items()}
    body = {"v1**2": 0.5, "v2**2*x1**2": 0.5}
    return System({**body, **held}, ((1.0, 0.0), (0.1, rng.uniform(0.9, 1.3))), angles=(1,))


def elastic_pendulum(rng: np.random.Generator) -> System:
    stiff = rng.uniform(4, 8)
    return System(
        {
            **FREE,
            "x1**2": -stiff / 2,
            "x2**2": -stiff / 2,
            "sqrt(x1**2+x2**2)": stiff,
            "x2": -1.0,
        },
        ((rng.uniform(0.5, 1), rng.uniform(-1, -0.7)), (0.0, 0.0)),
    )


def relativistic(rng: np.random.Generator) -> System:
    return System(
        {"sqrt(1-v1**2)": -1.0, "x1**2": -0.5},
        ((rng.uniform(0.9, 1.5),), (0.0,)),
    )


def drive_not_recorded(rng: np.random.Generator) -> System:
    omega, phase = rng.uniform(0.5, 2.0), rng.uniform(0, 2 * np.pi)
    return System(
        {"v1**2": 0.5, "cos(x1)": 1.0},
        ((rng.uniform(0.5, 1.5),), (0.0,)),
        (0,),
        {"v1**2": rng.uniform(0.01, 0.04)},
        push=(f"{rng.uniform(0.1, 0.4)}*cos({omega}*t + {phase})",),
    )


def drive_of_two_phases(rng: np.random.Generator) -> System:
    omega, spring = rng.uniform(0.6, 2.5), rng.uniform(0.2, 0.5)
    phases, sizes = rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.1, 0.3, 2)
    terms = {**FREE, "x1**2": -0.5 - spring, "x1*x2": 2 * spring, "x2**2": -0.5 - spring}
    return System(
        terms,
        ((rng.uniform(0.5, 1.5), 0.0), (0.0, 0.0)),
        friction={"v1**2": 0.02, "v2**2": 0.03},
        push=tuple(f"{a}*cos({omega}*t + {c})" for a, c in zip(sizes, phases, strict=True)),
    )


def cubic_drag(rng: np.random.Generator) -> System:
    return System(
        {"v1**2": 0.5, "cos(x1)": 1.0},
        ((rng.uniform(1.5, 2.5),), (0.0,)),
        (0,),
        {"abs(v1)**4": rng.uniform(0.01, 0.05)},
    )


def one_sided_friction(rng: np.random.Generator) -> System:
    sides = rng.uniform(0.002, 0.02, 2).tolist()
    return System(
        {"v1**2": 0.5, "x1**2": -0.5},
        ((rng.uniform(1, 2),), (0.0,)),
        friction=dict(zip(("(abs(v1) + v1)**2", "(abs(v1) - v1)**2"), sides, strict=True)),
    )


def motor_cart(rng: np.random.Generator) -> System:
    damping, gain = rng.uniform(3, 8), rng.uniform(5, 12)
    return System(
        {
            **FREE,
            "v1*v2*cos(x2)": rng.uniform(1.5, 4),
            "cos(x2)": rng.uniform(15, 40),
        },
        ((0.0, rng.uniform(0.3, 1)), (0.0, 0.0)),
        (1,),
        {"v1**2": damping / 2, "v2**2": rng.uniform(0.01, 0.2)},
        period=1.2,
        push=(f"{gain}*u1", "0"),
        dwell=25,
        leaders=(0,),
    )


def magnet_on_a_spring(rng: np.random.Generator) -> System:
    """A force i² ÷ (a + y)² beside a spring, by a current that is recorded."""
    gap, pull = rng.uniform(3, 4.5), rng.uniform(0.3, 0.8)
    return System(
        {"v1**2": 0.5, "x1**2": -0.5, f"u1**2/({gap} + x1)": pull * gap},
        ((rng.uniform(-0.3, 0.3),), (0.0,)),
        friction={"v1**2": rng.uniform(0.02, 0.1)},
        dwell=20,
    )


def parametric_drive(rng: np.random.Generator) -> System:
    """A pendulum whose pivot is shaken, which no column shows."""
    omega, phase = rng.uniform(1.3, 2.6), rng.uniform(0, 2 * np.pi)
    return System(
        {"v1**2": 0.5, "cos(x1)": 1.0, f"cos(x1)*cos({omega}*t + {phase})": rng.uniform(0.1, 0.4)},
        ((rng.uniform(0.5, 1.5),), (0.0,)),
        (0,),
        {"v1**2": rng.uniform(0.01, 0.04)},
    )


def motor_arm(rng: np.random.Generator) -> System:
    cart = motor_cart(rng)
    terms = {**cart.lagrangian, "v1**2*cos(2*x2)": -0.25}
    return cart._replace(lagrangian=terms)


def stribeck_friction(rng: np.random.Generator) -> System:
    """Dry friction that falls with speed, by a force that is recorded."""
    rest, share, width = rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.7), rng.uniform(0.1, 0.3)
    fallen = f"(abs(v1) + {width}*exp(-abs(v1)/{width}))"
    friction = {"v1**2": rng.uniform(0.01, 0.03), "abs(v1)": rest, fallen: -share * rest}
    return System(
        {"v1**2": 0.5, "x1**2": -0.5},
        ((rng.uniform(0.8, 1.2),), (0.0,)),
        friction=friction,
        push=("u1",),
        dwell=20,
    )


def jointed_arm(rng: np.random.Generator) -> System:
    """Two links, the angle of the second from the first, whose joints rub less as they move, the
    first turned by a torque that is recorded."""
    first, second, both = rng.uniform(0.7, 1.0), rng.uniform(0.15, 0.3), rng.uniform(0.3, 0.6)
    weight, width = rng.uniform(3, 6), rng.uniform(0.2, 0.5)
    friction = {}
    for v in ("v1", "v2"):
        rest = rng.uniform(0.1, 0.4)
        fallen = f"(abs({v}) + {width}*exp(-abs({v})/{width}))"
        friction |= {f"abs({v})": rest, fallen: -0.4 * rest}
    return System(
        {
            "v1**2": first,
            "v1*v2": 2 * second,
            "v2**2": second,
            "v1**2*cos(x2)": both,
            "v1*v2*cos(x2)": both,
            "cos(x1)": 2 * weight,
            "cos(x1 + x2)": weight,
        },
        ((rng.uniform(-1.2, 1.2), rng.uniform(-1.2, 1.2)), (0.0, 0.0)),
        (0, 1),
        friction,
        period=1.5,
        push=("4*u1", "0"),
        dwell=20,
    )


def load_friction(rng: np.random.Generator) -> System:
    """Dry friction in proportion to the force that drives, as of a wedge."""
    friction = {"v1**2": rng.uniform(0.01, 0.03), "abs(u1)*abs(v1)": rng.uniform(0.15, 0.4)}
    return System(
        {"v1**2": 0.5, "x1**2": -0.5},
        ((rng.uniform(0.8, 1.2),), (0.0,)),
        friction=friction,
        push=("u1",),
        dwell=20,
    )


def spherical_pendulum(rng: np.random.Generator) -> System:
    weight = rng.uniform(0.8, 1.2)
    return System(
        {"v1**2": 0.5, "v2**2": 0.25, "v2**2*cos(2*x1)": -0.25, "cos(x1)": weight},
        ((rng.uniform(0.6, 1.3), 0.0), (rng.uniform(-0.1, 0.1), rng.uniform(0.5, 1.0))),
        (0, 1),
    )


def body_in_a_bowl(rng: np.random.Generator) -> System:
    a, b = rng.uniform(0.3, 0.6), rng.uniform(0.8, 1.2)
    terms = {**FREE, "v1**2*x1**2": a * a / 2, "v1*v2*x1*x2": a * b, "v2**2*x2**2": b * b / 2}
    return System(
        {**terms, "x1**2": -a, "x2**2": -b},
        ((rng.uniform(0.5, 1), rng.uniform(0.5, 1)), (rng.uniform(-0.3, 0.3), 0.0)),
        friction={"v1**2": 0.005, "v2**2": 0.005},
    )


def orbit_that_turns(rng: np.random.Generator) -> System:
    r = "sqrt(x1**2+x2**2)"
    return System(
        {**FREE, f"{r}**(-1)": 1.0, f"{r}**(-2)": -rng.uniform(0.02, 0.05)},
        ((1.0, 0.0), (0.0, rng.uniform(0.75, 0.9))),
        period=4.0,
    )


def elastic_on_video(rng: np.random.Generator) -> System:
    """As seen by a camera, whose origin is not the pivot."""
    (a, b), stiff = rng.uniform(-2, 2, 2), rng.uniform(4, 8)
    x, y = f"(x1-{a})", f"(x2-{b})"
    return System(
        {
            **FREE,
            f"{x}**2": -stiff / 2,
            f"{y}**2": -stiff / 2,
            f"sqrt({x}**2+{y}**2)": stiff,
            "x2": -1.0,
        },
        ((a + rng.uniform(0.5, 1), b + rng.uniform(-1, -0.7)), (0.0, 0.0)),
        friction={"v1**2": 0.005, "v2**2": 0.005},
    )


def orbit_off_the_origin(rng: np.random.Generator) -> System:
    a, b = rng.uniform(-2, 2, 2)
    return System(
        {**FREE, f"sqrt((x1-{a})**2+(x2-{b})**2)**(-1)": 1.0},
        ((a + 1.0, b), (0.0, rng.uniform(0.75, 1.1))),
        period=4.0,
    )


def two_bodies(rng: np.random.Generator) -> System:
    """On springs of their own, with the force of Toda, of Morse or 1/r² between them."""
    a, depth = rng.uniform(0.6, 1.4), rng.uniform(0.4, 1)
    k1, k2 = rng.uniform(0.3, 1, 2).tolist()
    apart = f"exp({a}*(x1-x2))"
    between = (
        {apart: -depth, "x1": a * depth, "x2": -a * depth},
        {apart: 2 * depth, f"{apart}**2": -depth},
        {"1/(2-x1+x2)": -depth, "x1": depth / 4, "x2": -depth / 4},
    )[rng.integers(3)]
    body = {"v1**2": 0.5, "v2**2": rng.uniform(0.35, 0.75), "x1**2": -k1 / 2, "x2**2": -k2 / 2}
    side = 1 if rng.integers(2) else -1
    start = -side * rng.uniform(0.4, 1), side * rng.uniform(0.4, 1)
    return System({**body, **between}, (start, (0.0, 0.0)))


def three_bodies(rng: np.random.Generator) -> System:
    """In a row on springs at its ends, with the force of Toda, or of two magnets, between them."""
    a, depth = rng.uniform(0.6, 1.3), rng.uniform(0.4, 1)
    k1, k3, m2, m3 = rng.uniform((0.2, 0.2, 0.4, 0.4), (0.5, 0.5, 0.7, 0.7)).tolist()
    chain = {"v1**2": 0.5, "v2**2": m2, "v3**2": m3, "x1**2": -k1, "x3**2": -k3}
    if rng.integers(2):
        chain |= {f"exp({a}*(x1-x2))": -depth, f"exp({a}*(x2-x3))": -depth}
        pull = a * depth
    else:
        chain |= {"1/(3-x1+x2)**3": -9 * depth, "1/(3-x2+x3)**3": -9 * depth}
        pull = depth / 3
    chain |= {"x1": pull, "x3": -pull}
    start = rng.uniform((-1, -0.2, 0.4), (-0.4, 0.2, 1)).tolist()
    return System(chain, (tuple(start), (0.0, float(rng.uniform(-0.3, 0.3)), 0.0)))


def well(rng: np.random.Generator) -> System:
    """About a centre off the origin: of light, of a ring of current, or of a spring across the way,
    which is longer or shorter at rest than the way is far."""
    centre, wide, deep = rng.uniform(-2, 2), rng.uniform(0.6, 1.2), rng.uniform(0.7, 1.5)
    square = f"(x1-({centre}))**2"
    shape = (
        {f"exp(-{square}/{2 * wide**2})": deep * wide**2},
        {f"1/sqrt(1+{square}/{3 * wide**2})**3": deep * wide**2},
        {square: -deep / 2, f"sqrt({wide**2}+{square})": rng.uniform(0.3, 1.3) * deep * wide},
    )[rng.integers(3)]
    start = centre + rng.uniform(1, 1.5) * wide
    friction = {"v1**2": rng.uniform(0.002, 0.01)}
    return System({"v1**2": 0.5, **shape}, ((start,), (0.0,)), friction=friction)


SYSTEMS: dict[str, Callable[[np.random.Generator], System]] = {
    f.__name__.replace("_", "-"): f
    for f in (
        *(foucault, uniform_field, gradient_field, dipole_field),
        *(penning, coriolis_pair, rotating_saddle),
        *(two_wells, hoop, ball_and_beam, rocking_disc, wire, central),
        *(springs_between_angles, elastic_pendulum, relativistic),
        *(drive_not_recorded, drive_of_two_phases, cubic_drag, one_sided_friction),
        *(motor_cart, motor_arm, magnet_on_a_spring, parametric_drive),
        *(spherical_pendulum, body_in_a_bowl, orbit_that_turns, stribeck_friction),
        *(elastic_on_video, orbit_off_the_origin),
        *(load_friction, jointed_arm, polar, two_bodies, well, three_bodies),
    )
}


# The truth, and the judgement.


def rates(
    dim: int,
    L: str,
    R: str = "0",
    push: Sequence[str] = (),
    signal: Callable[[float], float] | None = None,
    leaders: Sequence[int] = (),
) -> Rates:
    """q̈ at (t, q, v) of the text of L, R and forces in t and the signal u1, by SymPy; dry friction
    turns over a small speed. Terms with coordinates that are led act on these alone."""
    q, v = (sp.symbols([f"{s}{i + 1}" for i in range(dim)], real=True) for s in "xv")
    t, u = sp.Symbol("t", real=True), sp.Function("u1")
    names = {str(s): s for s in (*q, *v)} | {"abs": sp.Abs, "t": t, "u1": u(t)}
    law, loss = (sp.parse_expr(text, local_dict=names) for text in (L, R))
    led = {s for i in range(dim) if leaders and i not in leaders for s in (q[i], v[i])}
    alone = sp.Add(*(term for term in sp.Add.make_args(law) if not led & term.free_symbols))
    left, masses = [], []
    for i, (x, s) in enumerate(zip(q, v, strict=True)):
        own = alone if i in leaders else law
        moved = sum(sp.diff(own, s, y) * w for y, w in zip(q, v, strict=True))
        left.append(sp.diff(own, x) - moved - sp.diff(loss, s))
        masses.append([sp.diff(own, s, w) for w in v])
    for i, text in enumerate(push):
        left[i] += sp.parse_expr(text, local_dict={"t": t, "u1": u(t)})
    known = {"sign": lambda s: np.tanh(s / _WIDTH), "u1": signal}
    of_mass, of_force = (
        sp.lambdify((t, *q, *v), f, [known, "numpy"]) for f in (sp.Matrix(masses), left)
    )
    return lambda time, x, w: np.linalg.solve(
        np.array(of_mass(time, *x, *w), float), np.array(of_force(time, *x, *w), float)
    )


def text_of(terms: Terms) -> str:
    return " + ".join(f"({c!r})*({term})" for term, c in terms.items()) or "0"


def integrated(law: Rates, q: np.ndarray, v: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (n, 2d) at times t from positions and velocities at the first."""
    d = len(q)
    done = solve_ivp(
        lambda time, z: np.concatenate([z[d:], law(time, z[:d], z[d:])]),
        (t[0], t[-1]),
        [*q, *v],
        t_eval=t,
        **_TOLERANCES,
    )
    if not done.success:
        raise ArithmeticError(done.message)
    return done.y.T


def _without_zeros(term: Any) -> Any:
    """A term without the zeros of its angles, which a fit finds near 0."""
    for f in (sp.cos, sp.sin):
        term = term.replace(f, lambda a, f=f: f(a - a.as_coeff_Add()[0]))
    return term


def compared(found: list[Any], truth: Terms) -> tuple[bool, float | None]:
    """Whether the terms of a formula are those of the truth, and the largest distance of one of
    their coefficients in its standard errors, up to the scale of L."""
    one: dict[Any, Any] = {_without_zeros(sp.sympify(t.term)): t for t in found}
    other: dict[Any, float] = {_without_zeros(sp.sympify(t)): c for t, c in truth.items()}
    if set(one) != set(other):
        return False, None
    seen = [(t.coefficient / t.std, other[k] / t.std) for k, t in one.items() if t.std > 0]
    scale = sum(c * o for c, o in seen) / max(sum(o * o for _, o in seen), 1e-300)
    if sum("v1**2" in term for term in truth) == 1:  # M₁₁ is constant, and 1
        scale = 1.0
    apart = [abs(c - scale * o) for c, o in seen]
    return True, float(max(apart, default=0.0))


def case(name: str, draw: int) -> Numbers:
    rng = np.random.default_rng([list(SYSTEMS).index(name), draw])
    system = SYSTEMS[name](rng)
    q0, v0 = map(np.array, system.start)
    d = len(q0)
    samples, periods = np.exp([rng.uniform(*np.log(ends)) for ends in (SAMPLES, PERIODS)])
    t = system.period / samples * np.arange(int(samples * periods))
    dwell = max(system.dwell, 1)
    values = np.repeat(rng.uniform(-1.5, 1.5, len(t) // dwell + 1), dwell) if system.dwell else None

    def signal(time: float) -> float:
        assert values is not None
        return float(values[min(int(time / t[1] + 1e-9), len(values) - 1)])

    text = text_of(system.lagrangian)
    truth = rates(d, text, text_of(system.friction), system.push, signal, system.leaders)
    states = integrated(truth, q0, v0, t)
    q = states[:, :d]
    spread = q.std(axis=0)
    seen = q + NOISE * spread * rng.normal(size=q.shape)
    names = [f"x{i + 1}" for i in range(d)]
    columns = {"t": t, **dict(zip(names, seen.T, strict=True))}
    columns |= {} if values is None else {"u1": values[: len(t)]}
    recording = gfnn.Recording(
        columns,
        positions=names,
        angles=[names[i] for i in system.angles],
        inputs=[] if values is None else ["u1"],
    )
    found: Numbers = {"draw": draw, "samples": float(samples), "count": len(t)}
    refused = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages

        def fitted():
            nonlocal refused
            try:
                return gfnn.fit(recording)
            except (FitError, np.linalg.LinAlgError) as error:
                refused = str(error)

        done = once(fitted)
    found |= {"processor_seconds": done.processor_seconds}
    if refused is not None:
        return found | {"refused": refused}
    fit: Any = done.out
    waves = [
        " + ".join(f"({fit.gains[u][name][0]!r})*{u}" for u in fit.gains) or "0" for name in names
    ]
    leaders = fit.law.leaders
    law = rates(d, fit.lagrangian.formula, fit.friction.formula or "0", waves, signal, leaders)
    ahead, errors = system.period * np.arange(_AHEAD + 1) / _AHEAD, []
    for k in np.linspace(0, len(t) - 1, _STARTS).astype(int):
        start = states[k, :d], states[k, d:]
        try:
            miss = integrated(law, *start, t[k] + ahead) - integrated(truth, *start, t[k] + ahead)
            errors.append(np.sqrt(np.mean((miss[1:, :d] / spread) ** 2)))
        except (ArithmeticError, np.linalg.LinAlgError):
            errors.append(np.inf)
    error = float(np.median(errors))
    exact, z = compared(fit.lagrangian.terms, system.lagrangian)
    return found | {
        "formula": fit.formula,
        "friction": fit.friction.formula,
        "error": error if np.isfinite(error) else None,
        "right": error < RIGHT,
        "exact": exact,
        "z": z,
        "verdict": fit.verdict,
        "messages": list(fit.messages),
        "leaders": list(leaders),
        "silent": fit.verdict == "identified" and not fit.messages and error >= RIGHT,
    }


def measured(name: str, quick: bool) -> Numbers:
    cases = []
    for draw in range(1 if quick else DRAWS):
        with np.errstate(all="ignore"):
            c = case(name, draw)
        cases.append(c)
        said = c.get("refused") or (
            f"{c['error']}, {'right' if c['right'] else 'wrong'}, {c['verdict']}; {c['formula']}"
            f"; R = {c['friction']}; z = {c['z']}"
        )
        print(f"  {draw}: {c['processor_seconds']:.1f} s, {said[:240]}", flush=True)
    return {"cases": cases}


PIECES = {name: functools.partial(measured, name) for name in SYSTEMS}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "vocabulary")
    if not found:
        return
    rows = []
    for name, result in found.items():
        cases = result["measured"]["cases"]
        laws = [c for c in cases if "formula" in c]
        right = [c for c in laws if c["right"]]
        z = [c["z"] for c in laws if c["z"] is not None]
        rows.append(
            [
                name.replace("-", " "),
                f"{len(right)} of {len(cases)}",
                str(sum(c["exact"] for c in laws)),
                number(max(z)) if z else "–",
                str(len(cases) - len(laws)),
                str(sum(c["silent"] for c in laws)),
                number(np.median([c["error"] for c in right])) if right else "–",
                number(np.mean([c["processor_seconds"] for c in cases])),
            ]
        )
    heads = (
        "system",
        "right",
        "terms of L exact",
        "largest z of these",
        "refused",
        "wrong and silent",
        "median error of the right, a period ahead",
        "CPU s",
    )
    between_markers(TABLES, "vocabulary", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "vocabulary", tables, None)
