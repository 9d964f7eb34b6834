"""A law that is a planar chain of links, as MJCF (MuJoCo) and URDF.

With absolute angles θ_i from where links hang, a chain has

    T = ½ Σ_i a_i θ̇_i² + Σ_{i<j} b_ij cos(θ_i − θ_j) θ̇_i θ̇_j,      V = −Σ_i g β_i cos θ_i
    a_i = I_i + m_i c_i² + l_i² Σ_{k>i} m_k,    β_i = m_i c_i + l_i Σ_{k>i} m_k,    b_ij = l_i β_j

with mass m, length l, centre c and inertia I about it of each link. L determines a, b and β, up to
its scale; so the lengths of all links but the last are known. Of each link's m, c and I one number
is free: it is given the mass of a uniform rod, unless that leaves another link no inertia. All
choices move alike.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from itertools import permutations
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.exports import arms
from gfnn_jax.families.lagrangian import DRY, LINEAR, Lagrangian
from gfnn_jax.maps.laws import bodies_of_map, is_of_law, law_of_map
from gfnn_jax.maps.symplectic_map import SymplecticMap

GRAVITY = 9.81  # m/s², by which lengths are in metres where times are in seconds


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the links of a law.

    states: random ones at which the law is compared with a chain. most: difference of masses and
    forces of a chain, relative to those of the law, beyond which it is none. still: part of the
    masses × (rates of the data)², below which gravity is none. longest: a step of MuJoCo, seconds.
    """

    states: int = 200
    most: float = 0.05
    still: float = 1e-9
    longest: float = 1e-3


OPTIONS = Options()


@dataclasses.dataclass(frozen=True)
class Links:
    """The links of a chain, from its base, and what acts on its joints.

    masses, lengths, centres, inertias: (d,). zeros: (d,) the coordinate of each joint where the
    links hang in line. joints: (d, d), the measured coordinates of those of the joints. damping,
    dry: rows (direction (d,) in the joints' velocities, coefficient). inputs: name -> (d,) torques
    of the joints for a unit. gravity: 0 where there is none. off: by how much the law differs from
    this chain. notes: what a file cannot hold, and what was chosen.
    """

    masses: np.ndarray
    lengths: np.ndarray
    centres: np.ndarray
    inertias: np.ndarray
    zeros: np.ndarray
    joints: np.ndarray
    damping: list[tuple[np.ndarray, float]]
    dry: list[tuple[np.ndarray, float]]
    inputs: dict[str, np.ndarray]
    gravity: float
    off: float
    notes: list[str]
    names: tuple[str, ...]
    dt: float


def links_of(map_: SymplecticMap) -> Links:
    """The links of the law of a map. Raises InputError where it is no planar chain, or no link of
    positive inertia explains it."""
    if not is_of_law(map_):
        raise InputError("expected a law of a recording: only a Lagrangian has links; use --to c")
    law, dim = law_of_map(map_), map_.dim
    if law.powers is not None:
        raise InputError(
            "this law is one of systems that differ in parameters, and MJCF and URDF hold one: use "
            "--to fmu"
        )
    if law.terms.leaders:
        raise InputError(
            "in this law some coordinates move others that do not act back on them, which no chain "
            "of links does: use --to fmu"
        )
    rng = np.random.default_rng(0)
    q, none = rng.uniform(-np.pi, np.pi, (OPTIONS.states, dim)), np.zeros((OPTIONS.states, dim))
    at_rest = law.derivatives(q, none)
    found = [_Chain.of(at_rest.by_vv, at_rest.by_q, q, turn) for turn in _conventions(dim)]
    best = min(found, key=lambda chain: chain.off)
    gyroscopic = np.abs(law.momentum(q, none)).max()
    if best.off > OPTIONS.most or gyroscopic > 1e-9:
        raise InputError(
            f"this law is no planar chain of links, from which it differs by {best.off:.0%}: use "
            "--to fmu or --to c"
        )
    return _with_forces(map_, law, best)


def _conventions(dim: int) -> Iterator[np.ndarray]:
    """Matrices of the absolute angles of links in the measured coordinates: relative angles, and
    absolute ones in any order."""
    yield np.tril(np.ones((dim, dim)))
    if dim > 1:
        for order in permutations(range(dim)) if dim <= 4 else [range(dim)]:
            yield np.eye(dim)[list(order)]


@dataclasses.dataclass(frozen=True)
class _Chain:
    """A chain as fitted: a (d,), b (d, d) above the diagonal, gβ (d,), zeros of the absolute
    angles, and how far it is from the law. turn: of the measured coordinates into these angles."""

    a: np.ndarray
    b: np.ndarray
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
        strong = weight > OPTIONS.still * np.abs(masses).max()
        weight, zeros = np.where(strong, weight, 0.0), np.where(strong, zeros, 0.0)
        a, b = masses[:, range(dim), range(dim)].mean(axis=0), np.zeros((dim, dim))
        model = np.zeros_like(masses)
        model[:, range(dim), range(dim)] = a
        for i in range(dim):
            for j in range(i + 1, dim):
                wave = np.cos(theta[:, i] - theta[:, j] - zeros[i] + zeros[j])
                b[i, j] = wave @ masses[:, i, j] / (wave @ wave)
                model[:, i, j] = model[:, j, i] = b[i, j] * wave
        size = np.linalg.norm(masses)
        off = np.linalg.norm(model - masses) / size
        if np.linalg.norm(forces) > OPTIONS.still * size:
            off = max(off, np.linalg.norm(shown - forces) / np.linalg.norm(forces))
        return _Chain(a, b, weight, zeros, turn, float(off))


def _lengths(chain: _Chain) -> tuple[np.ndarray, np.ndarray, float, list[str]]:
    """Lengths of all links but the last, β, gravity, and notes."""
    dim = len(chain.a)
    if np.all(chain.weight > 0):
        beta = chain.weight / GRAVITY
        lengths = [
            chain.b[i, i + 1 :] @ beta[i + 1 :] / (beta[i + 1 :] @ beta[i + 1 :])
            for i in range(dim - 1)
        ]
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
    raise InputError(
        f"link {j + 1} would have a negative inertia: the law as fitted is no chain that can exist"
    )


def _with_forces(map_: SymplecticMap, law: Lagrangian, chain: _Chain) -> Links:
    """The links, and friction and inputs in the coordinates of the joints."""
    lengths, beta, gravity, notes = _lengths(chain)
    masses, centres, inertias = _masses(chain, lengths, beta)
    dim = map_.dim
    joints = np.linalg.inv(chain.turn) @ np.tril(np.ones((dim, dim)))  # q = joints φ + …
    zeros = np.diff(chain.zeros, prepend=0.0)
    zeros = np.where(np.abs(zeros) > 1e-12, zeros, 0.0)
    sensors, damping, dry = map_.sensors, [], []
    for row, kind, size in zip(
        law.friction.directions, law.friction.kinds, np.asarray(law.losses), strict=True
    ):
        if kind in (LINEAR, DRY):
            (damping if kind == LINEAR else dry).append((row @ joints, float(size)))
        else:
            notes.append("friction that is not linear or dry is left out: these formats have none")
    if law.uniform and dim == 1:
        damping.append((np.ones(1), float(law.uniform) * float(chain.a[0])))
    elif law.uniform:
        notes.append("friction in proportion to the momenta is left out: these formats have none")
    named = map_.signals.names if map_.signals is not None else ()
    gains = joints.T @ np.asarray(law.gains).reshape(dim, len(named))
    names = sensors.positions if sensors is not None else tuple(f"q{i + 1}" for i in range(dim))
    notes.append("L is known up to a factor where no mass is: masses, inertias and torques have it")
    notes.append("each link has the mass of a uniform rod, or less: L does not determine it")
    if not np.array_equal(joints, np.eye(dim)):
        rows = [" + ".join(f"joint{j + 1}" for j in range(dim) if row[j]) for row in joints.round()]
        told = (f"{n} = {row}" for n, row in zip(names, rows, strict=True))
        notes.append(f"the columns of the data: {', '.join(told)}")
    return Links(
        masses,
        lengths,
        centres,
        inertias,
        zeros,
        joints,
        damping,
        dry,
        dict(zip(named, gains.T, strict=True)),
        gravity,
        chain.off,
        notes,
        names,
        float(map_.dt),
    )


def _text(value: float) -> str:
    return f"{float(value) + 0.0:.17g}"  # no -0


def _comment(links: Links, about: Mapping[str, Any]) -> str:
    lines = [f"{key}: {value}" for key, value in about.items()]
    lines += [f"the law differs from this chain by {links.off:.1e} of itself", *links.notes]
    listed = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{escape(listed)}\n-->"


def _of_joint(row: np.ndarray) -> int | None:
    """The joint whose velocity alone a row has, by ±1; None of others."""
    at = np.flatnonzero(np.abs(row) > 1e-12)
    return int(at[0]) if len(at) == 1 and abs(abs(row[at[0]]) - 1) < 1e-12 else None


def _own(rows: list[tuple[np.ndarray, float]], joint: int) -> float:
    return sum(size for row, size in rows if _of_joint(row) == joint)


def mjcf(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write the chain of links of a law as MJCF, which MuJoCo reads.

    ``qpos`` are the angles of the joints, as the data have them where these are relative. Viscous
    friction is damping; dry friction ``frictionloss``, by MuJoCo's soft constraints; that between
    links that share no joint acts along tendons; inputs are motors. Raises InputError where the law
    is no chain. An arm that was learned as one is written whole (`exports.arms`).
    """
    arm = bodies_of_map(map_)
    if arm is not None:
        return arms.mjcf(map_, arm, name, about)
    links = links_of(map_)
    dim, step = map_.dim, min(links.dt, OPTIONS.longest)
    body, tendons, motors = "", [], []
    for j in reversed(range(dim)):
        above = links.lengths[j - 1] if j else 0.0
        inertia = links.inertias[j]
        long = links.lengths[j] or 2 * links.centres[j] or 1.0
        inside = f"""\
<body name="link{j + 1}" pos="0 0 {_text(-above)}">
  <joint name="joint{j + 1}" type="hinge" axis="0 1 0" ref="{_text(links.zeros[j])}"
    damping="{_text(_own(links.damping, j))}" frictionloss="{_text(_own(links.dry, j))}"/>
  <inertial pos="0 0 {_text(-links.centres[j])}" mass="{_text(links.masses[j])}"
    diaginertia="{_text(inertia)} {_text(inertia)} {_text(1e-3 * inertia)}"/>
  <geom type="capsule" size="{_text(0.02 * abs(long))}" fromto="0 0 0 0 0 {_text(-long)}"
    contype="0" conaffinity="0"/>
{body}</body>"""
        body = "\n".join(f"  {line}" for line in inside.splitlines()) + "\n"

    def along(row: np.ndarray, **attributes: float) -> str:
        own = "".join(
            f'<joint joint="joint{j + 1}" coef="{_text(c)}"/>' for j, c in enumerate(row) if c
        )
        listed = "".join(f' {key}="{_text(value)}"' for key, value in attributes.items())
        tendons.append(f'  <fixed name="along{len(tendons) + 1}"{listed}>{own}</fixed>')
        return f"along{len(tendons)}"

    for key, rows in (("damping", links.damping), ("frictionloss", links.dry)):
        for row, size in rows:
            if _of_joint(row) is None:
                along(row, **{key: size})
    for own, row in links.inputs.items():
        motors.append(f'  <motor name={quoteattr(own)} tendon="{along(row)}"/>')
    parts = [
        f"<mujoco model={quoteattr(name)}>",
        _comment(links, about),
        '<compiler angle="radian" inertiafromgeom="false" boundmass="0" boundinertia="0"/>',
        arms.stiff_friction(step),
        f'<option timestep="{_text(step)}" gravity="0 0 {_text(-links.gravity)}" '
        f'integrator="{"implicitfast" if links.dry else "RK4"}"/>',
        f"<worldbody>\n{body}</worldbody>",
        *(["<tendon>", *tendons, "</tendon>"] if tendons else []),
        *(["<actuator>", *motors, "</actuator>"] if motors else []),
        "</mujoco>\n",
    ]
    return "\n".join(parts)


def urdf(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write the chain of links of a law as URDF: its joints turn about y, links hang along −z.

    Friction of joints is in ``dynamics``; what URDF cannot hold, friction between others and
    inputs, is told in its comment. Raises InputError where the law is no chain. An arm that was
    learned as one is written whole (`exports.arms`).
    """
    arm = bodies_of_map(map_)
    if arm is not None:
        return arms.urdf(arm, name, about)
    links = links_of(map_)
    told = [
        f"friction along {row.tolist()} of the joints' velocities is left out: URDF has none"
        for row, _ in (*links.damping, *links.dry)
        if _of_joint(row) is None
    ]
    told += [
        f"torques of the joints for a unit of {own}: {row.tolist()}"
        for own, row in links.inputs.items()
    ]
    links = dataclasses.replace(links, notes=[*links.notes, *told])
    parts = ['<?xml version="1.0"?>', f"<robot name={quoteattr(name)}>", _comment(links, about)]
    parts.append('<link name="base"/>')
    for j in range(map_.dim):
        above = links.lengths[j - 1] if j else 0.0
        inertia = _text(links.inertias[j])
        parts.append(f"""\
<joint name="joint{j + 1}" type="continuous">
  <parent link="{f"link{j}" if j else "base"}"/>
  <child link="link{j + 1}"/>
  <origin xyz="0 0 {_text(-above)}" rpy="0 {_text(-links.zeros[j])} 0"/>
  <axis xyz="0 1 0"/>
  <dynamics damping="{_text(_own(links.damping, j))}" friction="{_text(_own(links.dry, j))}"/>
</joint>
<link name="link{j + 1}">
  <inertial>
    <origin xyz="0 0 {_text(-links.centres[j])}"/>
    <mass value="{_text(links.masses[j])}"/>
    <inertia ixx="{inertia}" iyy="{inertia}" izz="{_text(1e-3 * links.inertias[j])}"
      ixy="0" ixz="0" iyz="0"/>
  </inertial>
</link>""")
    return "\n".join([*parts, "</robot>\n"])
