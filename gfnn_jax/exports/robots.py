"""Bodies on joints, of a law, as MJCF (MuJoCo) and URDF: an arm that was learned as one, or a
planar chain of links.

With absolute angles θ_i from where links hang, a chain has

    T = ½ Σ_i a_i θ̇_i² + Σ_{i<j} b_ij cos(θ_i − θ_j) θ̇_i θ̇_j + ½ Σ_{i>1} ρ_i (θ̇_i − θ̇_{i−1})²
    V = −Σ_i g β_i cos θ_i
    a_i = I_i + m_i c_i² + l_i² Σ_{k>i} m_k,    β_i = m_i c_i + l_i Σ_{k>i} m_k,    b_ij = l_i β_j

with mass m, length l, centre c and inertia I about it of each link, and inertia ρ of the rotor of
its joint, that of the first being part of its link. L determines a, b, β and ρ, up to
its scale; so the lengths of all links but the last are known. Of each link's m, c and I one number
is free: it is given the mass of a uniform rod, unless that leaves another link no inertia. All
choices move alike. What a format cannot hold is told in its comment.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.friction import DRY, LINEAR
from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.families.rigid_bodies import BASE, pseudo_inertias
from gfnn_jax.flows.bodies import BodiesLaw
from gfnn_jax.maps.laws import bodies_of_map, is_of_law, law_of_map
from gfnn_jax.maps.symplectic_map import SymplecticMap

GRAVITY = 9.81  # m/s², by which lengths are in metres where times are in seconds


class Options:
    """Options of the links of a law."""

    states: int = 200  # random ones, at which the law is compared with a chain
    most: float = 0.05  # relative difference of masses and forces, beyond which it is no chain
    still: float = 1e-9  # of the masses × (rates of the data)², below which gravity is none


class Link(NamedTuple):
    """A link: its joint's name, the number of the link that it is on, whether it slides; its mass,
    centre (3,) and inertia (3, 3) about that; rotation and origin of the joint's frame, its axis
    (3,), the inertia of its rotor, and how long it is drawn."""

    name: str
    parent: int
    slides: bool
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    rotation: Any
    origin: np.ndarray
    axis: np.ndarray
    rotor: float = 0.0
    length: float = 0.0


@dataclasses.dataclass(frozen=True)
class Robot:
    """Links on joints, and what acts on them.

    damping, dry: rows (direction (n,) in the joints' velocities, coefficient). inputs: name -> (n,)
    forces of the joints for a unit. gravity: (3,). notes: what a file cannot hold, and what was
    chosen. dt: of the map.
    """

    links: list[Link]
    damping: list[tuple[np.ndarray, float]]
    dry: list[tuple[np.ndarray, float]]
    inputs: dict[str, np.ndarray]
    gravity: np.ndarray
    notes: list[str]
    dt: float


def robot_of(map_: SymplecticMap) -> Robot:
    """The links of the law of a map. Raises InputError where it is neither an arm nor a planar
    chain, or no link of positive inertia explains it."""
    arm = bodies_of_map(map_)
    if arm is not None:
        return _of_arm(map_, arm)
    if not is_of_law(map_):
        raise InputError("expected a law of a recording: only a Lagrangian has links; use --to c")
    law, dim = law_of_map(map_), map_.dim
    if law.powers is not None:
        raise InputError("MJCF and URDF hold no law of systems that differ in parameters: --to fmu")
    if law.terms.leaders or law.terms.driven:
        raise InputError(
            "in this law some coordinates move others that do not act back on them, or terms have "
            "inputs, which no chain of links does: use --to fmu"
        )
    rng = np.random.default_rng(0)
    q, none = rng.uniform(-np.pi, np.pi, (Options.states, dim)), np.zeros((Options.states, dim))
    at_rest = law.derivatives(q, none)
    found = [_Chain.of(at_rest.by_vv, at_rest.by_q, q, turn) for turn in _conventions(dim)]
    best = min(found, key=lambda chain: chain.off)
    gyroscopic = np.abs(law.momentum(q, none)).max()
    if best.off > Options.most or gyroscopic > 1e-9:
        raise InputError(
            f"no planar chain of links: the law differs by {best.off:.0%}: use --to fmu or c"
        )
    return _of_chain(map_, law, best)


def _conventions(dim: int) -> Iterator[np.ndarray]:
    """Matrices of the absolute angles of links in the measured coordinates: relative angles, and
    absolute ones in any order."""
    yield np.tril(np.ones((dim, dim)))
    if dim > 1:
        for order in permutations(range(dim)) if dim <= 4 else [range(dim)]:
            yield np.eye(dim)[list(order)]


@dataclasses.dataclass(frozen=True)
class _Chain:
    """A chain as fitted: a (d,), b (d, d) above the diagonal, ρ (d,), gβ (d,), zeros of the
    absolute angles, and how far it is from the law. turn: of the measured coordinates into these
    angles."""

    a: np.ndarray
    b: np.ndarray
    rotors: np.ndarray
    weight: np.ndarray
    zeros: np.ndarray
    turn: np.ndarray
    off: float

    @staticmethod
    def of(masses: np.ndarray, forces: np.ndarray, q: np.ndarray, turn: np.ndarray) -> _Chain:
        """The nearest chain to masses (n, d, d) and forces −∂V/∂q (n, d) at positions q (n, d)."""
        back, dim = np.linalg.inv(turn), q.shape[1]
        theta, forces = q @ turn.T, forces @ back
        masses = np.einsum("ia,nij,jb->nab", back, masses, back)
        weight, zeros = np.zeros(dim), np.zeros(dim)
        shown = np.zeros_like(forces)
        for i in range(dim):
            waves = np.stack([np.sin(theta[:, i]), np.cos(theta[:, i])], axis=1)
            s, c = np.linalg.lstsq(waves, -forces[:, i])[0]
            weight[i], zeros[i] = np.hypot(s, c), np.arctan2(-c, s)
            shown[:, i] = -waves @ [s, c]
        strong = weight > Options.still * np.abs(masses).max()
        weight, zeros = np.where(strong, weight, 0.0), np.where(strong, zeros, 0.0)
        a, b = masses[:, range(dim), range(dim)].mean(axis=0), np.zeros((dim, dim))
        model, rotors, size = np.zeros_like(masses), np.zeros(dim), np.linalg.norm(masses)
        model[:, range(dim), range(dim)] = a
        for i, j in zip(*np.triu_indices(dim, 1), strict=True):
            wave = np.cos(theta[:, i] - theta[:, j] - zeros[i] + zeros[j])
            rows = np.stack([wave, -np.ones_like(wave)], axis=1)
            b[i, j], rotor = np.linalg.lstsq(rows, masses[:, i, j])[0]
            if j == i + 1 and rotor > Options.still * size:
                rotors[j] = rotor
            else:
                b[i, j] = wave @ masses[:, i, j] / (wave @ wave)
            model[:, i, j] = model[:, j, i] = b[i, j] * wave - rotors[j] * (j == i + 1)
        a = a - rotors - np.append(rotors[1:], 0.0)
        off = np.linalg.norm(model - masses) / size
        if np.linalg.norm(forces) > Options.still * size:
            off = max(off, np.linalg.norm(shown - forces) / np.linalg.norm(forces))
        return _Chain(a, b, rotors, weight, zeros, turn, float(off))


def _lengths(chain: _Chain) -> tuple[np.ndarray, np.ndarray, float, list[str]]:
    """Lengths of all links but the last, β, gravity, and notes."""
    dim = len(chain.a)
    if np.all(chain.weight > 0):
        beta = chain.weight / GRAVITY
        behind = [beta[i + 1 :] for i in range(dim - 1)]
        lengths = [chain.b[i, i + 1 :] @ own / (own @ own) for i, own in enumerate(behind)]
        return np.array([*lengths, 0.0]), beta, GRAVITY, []
    if np.any(chain.weight > 0):
        raise InputError("gravity acts on some links only: no chain of links; use --to fmu")
    notes = ["no gravity: lengths are not determined, and 1 is taken for all links"]
    lengths = np.append(np.ones(dim - 1), 0.0)
    last = [chain.b[j - 1, j] for j in range(1, dim)]
    return lengths, np.array([0.0, *last]), 0.0, notes


def _masses(chain: _Chain, lengths: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, ...]:
    """Masses, centres and inertias (d,) of the links: of uniform rods, else as light as they can
    be. Raises InputError where no choice is physically possible."""
    dim = len(lengths)
    for rod in (4 / 3, 1.05):
        masses, centres, inertias = (np.zeros(dim) for _ in range(3))
        for j in reversed(range(dim)):
            below = masses[j + 1 :].sum()
            moment, left = beta[j] - lengths[j] * below, chain.a[j] - lengths[j] ** 2 * below
            if left <= 0:
                break
            least = 1e-6 * left / (lengths.max() or 1.0) ** 2  # of a link without a moment
            masses[j] = max(rod * moment**2 / left, least)
            centres[j] = moment / masses[j]
            inertias[j] = left - moment * centres[j]
        else:
            return masses, centres, inertias
    raise InputError(f"link {j + 1} would have a negative inertia: no such chain can exist")


def _of_rows(
    friction: Any, losses: Any, turn: np.ndarray
) -> tuple[list[tuple[np.ndarray, float]], list[tuple[np.ndarray, float]], list[str]]:
    """Rows of damping and of dry friction, directions times ``turn``, and a note on others."""
    rows: dict[int, list[tuple[np.ndarray, float]]] = {LINEAR: [], DRY: []}
    notes: list[str] = []
    entries = zip(friction.directions, friction.kinds.tolist(), np.asarray(losses), strict=True)
    for row, kind, size in entries:
        if kind in rows:
            rows[kind].append((row @ turn, float(size)))
        else:
            notes = ["friction that is not linear or dry is left out: these formats have none"]
    return rows[LINEAR], rows[DRY], notes


def _of_chain(map_: SymplecticMap, law: Lagrangian, chain: _Chain) -> Robot:
    """The links, and friction and inputs in the coordinates of the joints, which turn about y."""
    from scipy.spatial.transform import Rotation  # loaded when first used

    lengths, beta, gravity, notes = _lengths(chain)
    masses, centres, inertias = _masses(chain, lengths, beta)
    dim = map_.dim
    joints = np.linalg.inv(chain.turn) @ np.tril(np.ones((dim, dim)))  # q = joints φ + …
    zeros = np.diff(chain.zeros, prepend=0.0)
    zeros = np.where(np.abs(zeros) > 1e-12, zeros, 0.0)
    damping, dry, left_out = _of_rows(law.friction, law.losses, joints)
    notes = [f"the law differs from this chain by {chain.off:.1e} of itself", *notes, *left_out]
    if law.uniform and dim == 1:
        damping.append((np.ones(1), float(law.uniform) * float(chain.a[0])))
    elif law.uniform:
        notes.append("friction in proportion to the momenta is left out: these formats have none")
    named = map_.signals.names if map_.signals is not None else ()
    gains = joints.T @ np.asarray(law.gains).reshape(dim, len(named))
    if map_.signals is not None and map_.signals.delay:
        notes.append(f"inputs act {map_.signals.delay:.3g} s later than their samples say")
    sensors = map_.sensors
    names = sensors.positions if sensors is not None else tuple(f"q{i + 1}" for i in range(dim))
    notes.append("masses, inertias and torques are in the unit of L: kg where the fit had mass=…")
    notes.append("each link has the mass of a uniform rod, or less: L does not determine it")
    if not np.array_equal(joints, np.eye(dim)):
        rows = [" + ".join(f"joint{j + 1}" for j in range(dim) if row[j]) for row in joints.round()]
        told = (f"{n} = {row}" for n, row in zip(names, rows, strict=True))
        notes.append(f"the columns of the data: {', '.join(told)}")
    down = np.array([0.0, 0.0, -1.0])
    links = []
    for j in range(dim):
        body = masses[j], centres[j] * down, inertias[j] * np.diag([1.0, 1.0, 1e-3])
        frame = Rotation.from_euler("y", -zeros[j]), (lengths[j - 1] if j else 0.0) * down
        axis, drawn = np.array([0.0, 1.0, 0.0]), lengths[j] or 2 * centres[j] or 1.0
        links.append(
            Link(f"joint{j + 1}", j - 1, False, *body, *frame, axis, chain.rotors[j], drawn)
        )
    inputs = dict(zip(named, gains.T, strict=True))
    return Robot(links, damping, dry, inputs, gravity * down, notes, float(map_.dt))


def _of_arm(map_: SymplecticMap, law: BodiesLaw) -> Robot:
    """The links of an arm: masses, centres and inertias as learned, all possible."""
    from scipy.spatial.transform import Rotation

    bodies, links = law.bodies, []
    inertias = pseudo_inertias(np.asarray(law.parameters))
    for i, (name, J) in enumerate(zip(bodies.names, inertias, strict=True)):
        m, centre = J[3, 3], J[:3, 3] / J[3, 3]
        second = J[:3, :3] - m * np.outer(centre, centre)
        about = np.trace(second) * np.eye(3) - second
        place, body = (bodies.parents[i], bodies.sliding[i]), (float(m), centre, about)
        turned = Rotation.from_matrix(np.asarray(bodies.rotations[i]))
        frame = turned, np.asarray(bodies.origins[i]), np.asarray(bodies.axes[i])
        links.append(Link(name, *place, *body, *frame, float(law.rotors[i])))
    damping, dry, left_out = _of_rows(law.friction, law.losses, np.eye(len(links)))
    offsets = ", ".join(f"{n} {c:.6g}" for n, c in zip(bodies.names, law.offsets, strict=True))
    notes = [f"constant forces that the joints hold against, left out: {offsets}", *left_out]
    named = map_.signals.names if map_.signals is not None else ()
    inputs = dict(zip(named, np.asarray(law.gains).T, strict=True))
    gravity = np.asarray(bodies.gravity, float)
    return Robot(links, damping, dry, inputs, gravity, notes, float(map_.dt))


_STEP = 1e-3  # s, the longest of MuJoCo


def _text(values: Any) -> str:
    return " ".join(f"{float(value) + 0.0:.17g}" for value in np.atleast_1d(values))  # no -0


def _comment(robot: Robot, about: Mapping[str, Any], more: Sequence[str] = ()) -> str:
    lines = [*(f"{key}: {value}" for key, value in about.items()), *robot.notes, *more]
    listed = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{escape(listed)}\n-->"


def _of_joint(row: np.ndarray) -> int | None:
    """The joint whose velocity alone a row has, by ±1; None of others."""
    at = np.flatnonzero(np.abs(row) > 1e-12)
    return int(at[0]) if len(at) == 1 and abs(abs(row[at[0]]) - 1) < 1e-12 else None


def _own(rows: list[tuple[np.ndarray, float]], joint: int) -> str:
    return _text(sum(size for row, size in rows if _of_joint(row) == joint))


def mjcf(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write the bodies of a map as MJCF, which MuJoCo reads.

    ``qpos`` are the coordinates of the joints, as the data have them where these are relative.
    Viscous friction is damping; dry friction ``frictionloss``, by MuJoCo's soft constraints; that
    between links that share no joint acts along tendons; rotors are ``armature``, inputs motors.
    Raises InputError where the law is no chain.
    """
    robot = robot_of(map_)
    links, tendons, motors = robot.links, [], []

    def body(i: int) -> str:
        link = links[i]
        x, y, z, w = link.rotation.as_quat()
        full = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        inside = "".join(body(j) for j in range(len(links)) if links[j].parent == i)
        drawn = (
            f'<geom type="capsule" size="{_text(0.02 * abs(link.length))}" contype="0" '
            f'conaffinity="0" fromto="0 0 0 0 0 {_text(-link.length)}"/>\n'
        )
        return (
            f'<body name="link{i + 1}" pos="{_text(link.origin)}" quat="{_text([w, x, y, z])}">\n'
            f'<joint name={quoteattr(link.name)} type="{"slide" if link.slides else "hinge"}" '
            f'axis="{_text(link.axis)}" damping="{_own(robot.damping, i)}" '
            f'frictionloss="{_own(robot.dry, i)}" armature="{_text(link.rotor)}"/>\n'
            f'<inertial pos="{_text(link.centre)}" mass="{_text(link.mass)}" '
            f'fullinertia="{_text(full)}"/>\n{drawn if link.length else ""}{inside}</body>\n'
        )

    def along(row: np.ndarray, attributes: str = "") -> str:
        parts = [(quoteattr(link.name), c) for link, c in zip(links, row, strict=True) if c]
        own = "".join(f'<joint joint={name} coef="{_text(c)}"/>' for name, c in parts)
        tendons.append(f'  <fixed name="along{len(tendons) + 1}"{attributes}>{own}</fixed>')
        return f"along{len(tendons)}"

    for key, rows in (("damping", robot.damping), ("frictionloss", robot.dry)):
        for row, size in rows:
            if _of_joint(row) is None:
                along(row, f' {key}="{_text(size)}"')
    rows = robot.inputs.items()
    motors = [f'  <motor name={quoteattr(own)} tendon="{along(row)}"/>' for own, row in rows]
    step = min(robot.dt, _STEP)
    # Friction that holds within two steps: MuJoCo's own lets a body creep that friction holds. The
    # arm of benchmarks/machines.py is 5 mrad off after 0.5 s by that, and 1 mrad by this. Of its
    # implicit steps, of first order, the free pendulum there is 9 mrad off, by these 0.03.
    stiff = f'solreffriction="{_text(2 * step)} 1" solimpfriction="0.999 0.999 0.001"'
    parts = [
        f"<mujoco model={quoteattr(name)}>",
        _comment(robot, about),
        '<compiler angle="radian" inertiafromgeom="false" boundmass="0" boundinertia="0"/>',
        f"<default><joint {stiff}/><tendon {stiff}/></default>",
        f'<option timestep="{_text(step)}" gravity="{_text(robot.gravity)}" integrator="RK4"/>',
        "<worldbody>",
        *(body(i) for i, link in enumerate(links) if link.parent == BASE),
        "</worldbody>",
        *(["<tendon>", *tendons, "</tendon>"] if tendons else []),
        *(["<actuator>", *motors, "</actuator>"] if motors else []),
        "</mujoco>\n",
    ]
    return "\n".join(parts)


def urdf(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write the bodies of a map as URDF.

    Friction of joints is in ``dynamics``; what URDF cannot hold, friction between others, inputs
    and rotors, is told in its comment. Raises InputError where the law is no chain.
    """
    robot = robot_of(map_)
    told = [
        f"friction along {row.tolist()} of the joints' velocities is left out: URDF has none"
        for row, _ in (*robot.damping, *robot.dry)
        if _of_joint(row) is None
    ]
    told += [
        f"forces of the joints for a unit of {own}: {row.tolist()}"
        for own, row in robot.inputs.items()
    ]
    rotors = ", ".join(f"{link.name} {link.rotor:.6g}" for link in robot.links if link.rotor)
    told += [f"inertias of rotors, left out: {rotors}"] if rotors else []
    parts = ['<?xml version="1.0"?>', f"<robot name={quoteattr(name)}>"]
    parts += [_comment(robot, about, told), '<link name="base"/>']
    for i, link in enumerate(robot.links):
        upper = link.inertia[np.triu_indices(3)]
        entries = zip(("xx", "xy", "xz", "yy", "yz", "zz"), upper, strict=True)
        inertia = " ".join(f'i{at}="{_text(value)}"' for at, value in entries)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of one of many ways to name a rotation
            angles = link.rotation.as_euler("xyz")
        limit = '<limit lower="-1e3" upper="1e3" effort="1e9" velocity="1e3"/>' * link.slides
        parts.append(f"""\
<joint name={quoteattr(link.name)} type="{"prismatic" if link.slides else "continuous"}">
  <parent link="{"base" if link.parent == BASE else f"link{link.parent + 1}"}"/>
  <child link="link{i + 1}"/>
  <origin xyz="{_text(link.origin)}" rpy="{_text(angles)}"/>
  <axis xyz="{_text(link.axis)}"/>{limit}
  <dynamics damping="{_own(robot.damping, i)}" friction="{_own(robot.dry, i)}"/>
</joint>
<link name="link{i + 1}">
  <inertial>
    <origin xyz="{_text(link.centre)}"/>
    <mass value="{_text(link.mass)}"/>
    <inertia {inertia}/>
  </inertial>
</link>""")
    return "\n".join([*parts, "</robot>\n"])
