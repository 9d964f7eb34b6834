"""Bodies on joints (`exports.links`) as MJCF (MuJoCo) and URDF.

What a format cannot hold is told in its comment.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from gfnn_jax.exports.links import Robot, robot_of
from gfnn_jax.families.rigid_bodies import BASE
from gfnn_jax.maps.symplectic_map import SymplecticMap

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
        own = "".join(
            f'<joint joint={quoteattr(link.name)} coef="{_text(c)}"/>'
            for link, c in zip(links, row, strict=True)
            if c
        )
        tendons.append(f'  <fixed name="along{len(tendons) + 1}"{attributes}>{own}</fixed>')
        return f"along{len(tendons)}"

    for key, rows in (("damping", robot.damping), ("frictionloss", robot.dry)):
        for row, size in rows:
            if _of_joint(row) is None:
                along(row, f' {key}="{_text(size)}"')
    motors = [
        f'  <motor name={quoteattr(own)} tendon="{along(row)}"/>'
        for own, row in robot.inputs.items()
    ]
    step, integrator = min(robot.dt, _STEP), "implicitfast" if robot.dry else "RK4"
    # Friction that holds within two steps: MuJoCo's own lets a body creep that friction holds. The
    # arm of benchmarks/machines.py is 5 mrad off after 0.5 s by that, and 1 mrad by this.
    stiff = f'solreffriction="{_text(2 * step)} 1" solimpfriction="0.999 0.999 0.001"'
    parts = [
        f"<mujoco model={quoteattr(name)}>",
        _comment(robot, about),
        '<compiler angle="radian" inertiafromgeom="false" boundmass="0" boundinertia="0"/>',
        f"<default><joint {stiff}/><tendon {stiff}/></default>",
        f'<option timestep="{_text(step)}" gravity="{_text(robot.gravity)}" '
        f'integrator="{integrator}"/>',
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
        entries = zip(
            ("xx", "xy", "xz", "yy", "yz", "zz"), link.inertia[np.triu_indices(3)], strict=True
        )
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
