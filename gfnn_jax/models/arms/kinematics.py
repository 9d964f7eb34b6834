"""Kinematics of an arm: from a URDF (the home of yourdfpy), from axes in space, from modified DH.

What a CAD model says of the links' inertias comes with a URDF. Without it a link is a ball as wide
as links are long, of one density that the log tells: where the data do not determine a parameter,
what is nearest to these is taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.rigid_bodies import BASE, EARTH, Bodies, inertial, moved

MOVING = ("revolute", "continuous", "prismatic")
DENSITY = 1_000.0  # kg/m³, of links without a CAD model, before the log tells it
LONE = 0.3  # m, of a link without another one


class Kinematics(NamedTuple):
    """Bodies on joints; π (k, 10) of the links by a CAD model or a guess; whether it is a model's;
    the largest force (k,) that each joint can give, inf where it is not known."""

    bodies: Bodies
    prior: np.ndarray
    known: bool
    limits: np.ndarray

    def in_order(self, names: Sequence[str], source: str) -> Kinematics:
        """The same with its joints named as the columns ``names``: those of the same names, else in
        the same order. Raises InputError where they are not as many, or in another order."""
        own = self.bodies.names
        if len(own) != len(names):
            raise InputError(
                f"the arm has {len(own)} joints ({', '.join(own)}), and {source} has positions "
                f"{', '.join(names)}: name those of its joints, from the base outwards, "
                "gfnn.read(FILE, positions=[…]). A joint of a URDF that is not in the log and does "
                'not move is type="fixed" there'
            )
        if own != tuple(names) and set(own) & set(names):
            raise InputError(
                f"the arm's joints are {', '.join(own)}, and {source} has positions "
                f"{', '.join(names)}: gfnn.read(FILE, positions=[{', '.join(map(repr, own))}]), or "
                "columns that have none of these names, in the order of the joints"
            )
        return self._replace(bodies=dataclasses.replace(self.bodies, names=tuple(names)))


def from_axes(
    axes: Sequence[tuple[Sequence[float], Sequence[float]]],
    sliding: Sequence[int] = (),
    gravity: Sequence[float] = EARTH,
) -> Kinematics:
    """A chain by its joints' axes where all positions are 0: (direction (3,), a point on it (3,))
    each, in the frame of the base. sliding: indices of joints that slide along their axis."""
    directions = np.array([d for d, _ in axes], float).reshape(-1, 3)
    points = np.array([p for _, p in axes], float).reshape(-1, 3)
    sizes = np.linalg.norm(directions, axis=1)
    if not len(directions) or not np.all(sizes > 0):
        raise InputError("expected axes ((direction), (point)) of three numbers each, none of 0")
    count = len(directions)
    origins = np.diff(points, axis=0, prepend=np.zeros((1, 3)))
    frames = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    return _chain(frames, origins, directions / sizes[:, None], sliding, gravity)


def from_dh(
    rows: Sequence[Sequence[float]],
    sliding: Sequence[int] = (),
    gravity: Sequence[float] = EARTH,
) -> Kinematics:
    """A chain by modified Denavit–Hartenberg rows (a, α, d, θ) in m and rad (J. J. Craig,
    "Introduction to Robotics", section 3.4): from frame i − 1 by a along x and α about it, then d
    along z and θ about it, to which the joint's position is added."""
    table = np.array(rows, float)
    if table.ndim != 2 or table.shape[1] != 4 or not np.isfinite(table).all():
        raise InputError("expected modified DH rows (a, alpha, d, theta) of four finite numbers")
    turns, origins = [], []
    for a, α, d, θ in table:
        ca, sa, ct, st = np.cos(α), np.sin(α), np.cos(θ), np.sin(θ)
        turns.append([[ct, -st, 0], [st * ca, ct * ca, -sa], [st * sa, ct * sa, ca]])
        origins.append([a, -sa * d, ca * d])
    along = np.tile([0.0, 0.0, 1.0], (len(table), 1))
    return _chain(np.array(turns), np.array(origins), along, sliding, gravity)


def _chain(turns, origins, axes, sliding, gravity) -> Kinematics:
    count = len(axes)
    names, parents = tuple(f"q{i + 1}" for i in range(count)), tuple(range(BASE, count - 1))
    slides = tuple(i in set(sliding) for i in range(count))
    bodies = Bodies(names, parents, slides, turns, origins, axes, np.array(gravity, float))
    ends = [*origins[1:], np.zeros(3)]
    own = np.linalg.norm(ends, axis=1)
    usual = np.mean(own[own > 0]) if np.any(own > 0) else LONE
    lengths = np.maximum(own, usual)  # those of links that end in a joint, and of the last one
    prior = [_ball(length, 0.5 * end) for length, end in zip(lengths, ends, strict=True)]
    return Kinematics(bodies, np.array(prior), False, np.full(count, np.inf))


def _ball(width: float, centre: np.ndarray) -> np.ndarray:
    """π (10,) of a ball."""
    mass = DENSITY * np.pi / 6 * width**3
    return inertial(mass, centre, 0.1 * mass * width**2 * np.eye(3))


def from_urdf(path: Any, gravity: Sequence[float] = EARTH) -> Kinematics:
    """The joints of a URDF that move, from the base outwards, with the inertias of their links;
    links on fixed joints are parts of those that carry them. Raises InputError where the file
    cannot be read, without yourdfpy, and of joints that follow others (mimic) or move otherwise."""
    robot = _read(Path(path))
    joints = {joint.child: joint for joint in robot.joints}
    links = {link.name: link for link in robot.links}
    strange = [
        joint.name
        for joint in robot.joints
        if joint.mimic is not None or joint.type not in (*MOVING, "fixed")
    ]
    if strange:
        raise InputError(
            f"{path}: {', '.join(strange)} follow other joints (mimic), or have more than one "
            'degree of freedom: make them type="fixed" in the file, or give axes= of the joints in '
            "the log"
        )
    order = [name for name in links if name not in joints]
    for name in order:  # breadth first, in the order of the file; the list grows as it is walked
        order += [joint.child for joint in robot.joints if joint.parent == name]
    rows, carried = [], {}  # link -> (moving link, its frame there)
    for name in order:
        joint = joints.get(name)
        parent, frame = carried[joint.parent] if joint else (BASE, np.eye(4))
        frame = frame @ (np.eye(4) if joint is None or joint.origin is None else joint.origin)
        if joint is not None and joint.type != "fixed":
            axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, float)
            rows.append((joint, parent, frame, axis / np.linalg.norm(axis), np.zeros(10)))
            parent, frame = len(rows) - 1, np.eye(4)
        carried[name] = parent, frame
        if parent != BASE:
            rows[parent][-1][:] += _inertial_of(links[name], frame)
    if not rows:
        raise InputError(f"{path}: expected joints that move, found none")
    moving, parents, frames, axes, prior = zip(*rows, strict=True)
    names = tuple(joint.name for joint in moving)
    slides = tuple(joint.type == "prismatic" for joint in moving)
    turns, origins = (np.array([frame[:3, k] for frame in frames]) for k in (slice(3), 3))
    down = np.array(gravity, float)
    bodies = Bodies(names, parents, slides, turns, origins, np.array(axes), down)
    efforts = [joint.limit.effort if joint.limit else None for joint in moving]
    limits = np.array([effort or np.inf for effort in efforts])
    prior = np.array(prior)
    guessed = ~(prior[:, 0] > 0)
    prior[guessed] = _ball(LONE, np.zeros(3))
    return Kinematics(bodies, prior, not guessed.any(), limits)


def _read(path: Path) -> Any:
    try:
        from yourdfpy import URDF
    except ImportError:
        raise InputError(
            f"{path}: URDFs are read by yourdfpy: pip install 'gfnn_jax[robots]'"
        ) from None
    try:
        return URDF.load(str(path), load_meshes=False, build_scene_graph=False).robot
    except Exception as error:  # of its XML parser, of any kind
        raise InputError(f"{path}: expected a URDF: {error}") from error


def _inertial_of(link: Any, frame: np.ndarray) -> np.ndarray:
    """π (10,) of a link of a URDF in the frame that carries it, 0 where it has none."""
    own = link.inertial
    if own is None or not own.mass:
        return np.zeros(10)
    inertia = np.zeros((3, 3)) if own.inertia is None else own.inertia
    frame = frame @ (np.eye(4) if own.origin is None else own.origin)
    return moved(inertial(own.mass, np.zeros(3), inertia), frame[:3, :3], frame[:3, 3])
