"""Bodies on joints, as an arm was learned, as MJCF (MuJoCo) and URDF.

Masses, centres and inertias are those of the law, all possible; joints, friction, rotors and
gravity too. What a format cannot hold is told in its comment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from gfnn_jax.families.lagrangian import DRY, LINEAR
from gfnn_jax.families.rigid_bodies import BASE, PER_LINK
from gfnn_jax.flows.bodies import BodiesLaw
from gfnn_jax.maps.symplectic_map import SymplecticMap

_STEP = 1e-3  # s, the longest of MuJoCo


class _Link(NamedTuple):
    """A link: its mass, centre (3,) and inertia (3, 3) about it; rotation and origin of its joint's
    frame, the axis (3,), viscous and Coulomb friction, and the inertia of the rotor."""

    name: str
    parent: int
    slides: bool
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    rotation: Any
    origin: np.ndarray
    axis: np.ndarray
    damping: float
    dry: float
    rotor: float


def _links(law: BodiesLaw) -> Iterator[_Link]:
    from scipy.spatial.transform import Rotation  # loaded when first used

    bodies, friction = law.bodies, law.friction
    for i, name in enumerate(bodies.names):
        m, *rest = np.asarray(law.parameters)[PER_LINK * i : PER_LINK * (i + 1)]
        centre, about = np.array(rest[:3]) / m, np.zeros((3, 3))
        about[np.triu_indices(3)] = rest[3:]
        about = about + np.triu(about, 1).T
        about = about - m * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        own = np.asarray(law.losses) * (friction.directions[:, i] != 0)
        damping, dry = (float(np.sum(own[friction.kinds == kind])) for kind in (LINEAR, DRY))
        yield _Link(
            name,
            bodies.parents[i],
            bodies.sliding[i],
            float(m),
            centre,
            about,
            Rotation.from_matrix(np.asarray(bodies.rotations[i])),
            np.asarray(bodies.origins[i]),
            np.asarray(bodies.axes[i]),
            damping,
            dry,
            float(law.rotors[i]),
        )


def _text(values: Any) -> str:
    return " ".join(f"{float(value) + 0.0:.17g}" for value in np.atleast_1d(values))


def _comment(law: BodiesLaw, about: Mapping[str, Any], more: Sequence[str]) -> str:
    lines = [f"{key}: {value}" for key, value in about.items()]
    offsets = ", ".join(f"{n} {c:.6g}" for n, c in zip(law.bodies.names, law.offsets, strict=True))
    lines += [f"constant forces that the joints hold against, left out: {offsets}", *more]
    if set(law.friction.kinds.tolist()) - {LINEAR, DRY}:
        lines.append("quadratic friction is left out")
    listed = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{escape(listed)}\n-->"


def stiff_friction(step: float) -> str:
    """Write MJCF's defaults by which dry friction holds within two steps (s). MuJoCo's own let a
    body creep that friction holds: the robot arm of `benchmarks/machines.py` is 5 mrad off after
    0.5 s by those, and 1 mrad by these."""
    own = f'solreffriction="{_text(2 * step)} 1" solimpfriction="0.999 0.999 0.001"'
    return f"<default><joint {own}/><tendon {own}/></default>"


def mjcf(map_: SymplecticMap, law: BodiesLaw, name: str, about: Mapping[str, Any]) -> str:
    """Write an arm as MJCF: rotors are ``armature``, Coulomb friction ``frictionloss``, and each
    input is a motor whose gear is its gain."""
    links, motors = list(_links(law)), []

    def body(i: int) -> str:
        link, kind = links[i], "slide" if links[i].slides else "hinge"
        x, y, z, w = link.rotation.as_quat()
        full = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        inside = "".join(body(j) for j in range(len(links)) if links[j].parent == i)
        return (
            f'<body pos="{_text(link.origin)}" quat="{_text([w, x, y, z])}">\n'
            f'<joint name={quoteattr(link.name)} type="{kind}" axis="{_text(link.axis)}" '
            f'damping="{_text(link.damping)}" frictionloss="{_text(link.dry)}" '
            f'armature="{_text(link.rotor)}"/>\n'
            f'<inertial pos="{_text(link.centre)}" mass="{_text(link.mass)}" '
            f'fullinertia="{_text(full)}"/>\n{inside}</body>\n'
        )

    names = map_.signals.names if map_.signals is not None else ()
    for own, gains in zip(names, np.asarray(law.gains).T, strict=True):
        for i in np.flatnonzero(gains):
            motors.append(
                f"<motor name={quoteattr(own)} joint={quoteattr(links[i].name)} "
                f'gear="{_text(gains[i])}"/>'
            )
    step = min(float(map_.dt), _STEP)
    parts = [
        f"<mujoco model={quoteattr(name)}>",
        _comment(law, about, []),
        '<compiler angle="radian" boundmass="0" boundinertia="0"/>',
        stiff_friction(step),
        f'<option timestep="{step:g}" gravity="{_text(law.bodies.gravity)}" '
        'integrator="implicitfast"/>',
        "<worldbody>",
        *(body(i) for i, link in enumerate(links) if link.parent == BASE),
        "</worldbody>",
        f"<actuator>{''.join(motors)}</actuator>",
        "</mujoco>\n",
    ]
    return "\n".join(parts)


def urdf(law: BodiesLaw, name: str, about: Mapping[str, Any]) -> str:
    """Write an arm as URDF, which holds no rotors: its comment has them."""
    links = list(_links(law))
    rotors = ", ".join(f"{link.name} {link.rotor:.6g}" for link in links)
    parts = ['<?xml version="1.0"?>', f"<robot name={quoteattr(name)}>"]
    parts += [
        _comment(law, about, [f"inertias of rotors, left out: {rotors}"]),
        '<link name="base"/>',
    ]
    for i, link in enumerate(links):
        entries = zip(
            ("xx", "xy", "xz", "yy", "yz", "zz"), link.inertia[np.triu_indices(3)], strict=True
        )
        inertia = " ".join(f'i{at}="{_text(value)}"' for at, value in entries)
        parent = "base" if link.parent == BASE else f"link{link.parent + 1}"
        limit = (
            '<limit lower="-1e3" upper="1e3" effort="1e9" velocity="1e3"/>' if link.slides else ""
        )
        parts.append(f"""\
<joint name={quoteattr(link.name)} type="{"prismatic" if link.slides else "continuous"}">
  <parent link="{parent}"/>
  <child link="link{i + 1}"/>
  <origin xyz="{_text(link.origin)}" rpy="{_text(link.rotation.as_euler("xyz"))}"/>
  <axis xyz="{_text(link.axis)}"/>{limit}
  <dynamics damping="{_text(link.damping)}" friction="{_text(link.dry)}"/>
</joint>
<link name="link{i + 1}">
  <inertial>
    <origin xyz="{_text(link.centre)}"/>
    <mass value="{_text(link.mass)}"/>
    <inertia {inertia}/>
  </inertial>
</link>""")
    return "\n".join([*parts, "</robot>\n"])
