"""Rigid bodies on joints in a tree: forces of a motion, linear in the bodies' inertial parameters.

    τ = Y(q, v, a) π,      π = (m, h, I) of each link, 10 numbers

with mass m, first moments h = m c, and the six entries of the inertia I about the origin of the
link's frame, in that frame. Y is made by Newton's and Euler's equations (Luh, Walker & Paul, J.
Dyn. Syst. 102 (1980) 69; Atkeson, An & Hollerbach, Int. J. Robot. Res. 5(3) (1986) 101): velocities
and accelerations go from the base outwards, wrenches back to it. A base that accelerates by −g
stands for gravity. A link's frame is that of its joint, turned or moved by it. Everything is batch
first, and runs in NumPy or JAX.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree

BASE = -1  # parent of the joints at the base
PER_LINK = 10
PARAMETERS: tuple[str, ...] = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
EARTH = (0.0, 0.0, -9.81)  # m/s²
_AXES = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # where I[i][j] stands among its six entries


@pytree("names", "parents", "sliding")
class Bodies:
    """Links on joints; joint i moves link i against link ``parents[i]``, which comes before it, or
    against the base.

    rotations, origins: (k, 3, 3), (k, 3) the frame of each joint in that of its parent's link.
    axes: (k, 3) unit vectors in the joint's frame, about which it turns, or along which it slides
    where ``sliding``. gravity: (3,) acceleration in the frame of the base.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    sliding: tuple[bool, ...]
    rotations: Any
    origins: Any
    axes: Any
    gravity: Any

    @property
    def dim(self) -> int:
        return len(self.names)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of π: "m1", "hx1", …."""
        return tuple(f"{p}{i + 1}" for i in range(self.dim) for p in PARAMETERS)

    def above(self, joint: int) -> list[int]:
        """Links that a joint carries, its own first."""
        found = [joint]
        for i in range(joint + 1, self.dim):
            if self.parents[i] in found:
                found.append(i)
        return found

    def _frames(self, q: Any) -> Iterator[tuple[Any, Any]]:
        """Rotation (..., 3, 3) of each link's frame into its parent's, and its origin (..., 3)
        there."""
        xp = namespace(q)
        for i in range(self.dim):
            turn, origin, axis = self.rotations[i], self.origins[i], self.axes[i]
            turn = xp.broadcast_to(turn, (*q.shape[:-1], 3, 3))
            origin = xp.broadcast_to(origin, (*q.shape[:-1], 3))
            moved, axis = q[..., i, None], xp.broadcast_to(axis, origin.shape)
            if self.sliding[i]:
                yield turn, origin + moved * (turn * axis[..., None, :]).sum(-1)
                continue
            K, moved = _cross(axis), moved[..., None]
            unit = xp.broadcast_to(np.eye(3), K.shape)
            turned = unit + xp.sin(moved) * K + (1 - xp.cos(moved)) * matmul(K, K)  # Rodrigues
            yield matmul(turn, turned), origin

    def regressor(self, q: Any, v: Any, a: Any, gravity: Any = None) -> Any:
        """Y (..., k, 10 k) of motions q, v, a (..., k): forces of the joints for a unit of each
        parameter. gravity: (3,), in place of the bodies' own."""
        xp = namespace(q)
        gravity = self.gravity if gravity is None else gravity
        still = xp.zeros((*q.shape[:-1], 3), q.dtype)
        frames = list(self._frames(q))
        motions: list[Any] = []
        for i, (turn, origin) in enumerate(frames):
            parent = self.parents[i]
            ω, α, lin = (
                (still, still, still - as_row(gravity, still))
                if parent == BASE
                else motions[parent]
            )
            lin = _turned(turn, lin + xp.cross(α, origin) + xp.cross(ω, xp.cross(ω, origin)))
            ω, α, axis = _turned(turn, ω), _turned(turn, α), as_row(self.axes[i], still)
            speed, push = v[..., i, None] * axis, a[..., i, None] * axis
            if self.sliding[i]:
                lin = lin + 2 * xp.cross(ω, speed) + push
            else:
                α, ω = α + xp.cross(ω, speed) + push, ω + speed
            motions.append((ω, α, lin))
        blocks: list[list[Any]] = [[] for _ in frames]  # (link, wrench (..., 6, 10)) that it bears
        rows = [xp.zeros((*q.shape[:-1], PER_LINK * self.dim), q.dtype)] * self.dim
        for i in reversed(range(self.dim)):
            blocks[i].insert(0, (i, _wrench(*motions[i])))
            at = 3 * (not self.sliding[i])
            axis = as_row(self.axes[i][:, None], blocks[i][0][1])
            own = {j: (axis * w[..., at : at + 3, :]).sum(-2) for j, w in blocks[i]}
            none = xp.zeros((*q.shape[:-1], PER_LINK), q.dtype)
            rows[i] = xp.concatenate([own.get(j, none) for j in range(self.dim)], axis=-1)
            if self.parents[i] != BASE:
                turn, origin = frames[i]
                for j, w in blocks[i]:
                    force, moment = matmul(turn, w[..., :3, :]), matmul(turn, w[..., 3:, :])
                    moment = moment + matmul(_cross(origin), force)
                    blocks[self.parents[i]].append((j, xp.concatenate([force, moment], axis=-2)))
        return xp.stack(rows, axis=-2)

    def forces(self, parameters: Any, q: Any, v: Any, a: Any) -> Any:
        """Forces (..., k) of the joints that a motion needs, without friction."""
        rows = self.regressor(q, v, a)
        return (rows * as_row(parameters, rows)).sum(-1)

    def masses(self, parameters: Any, q: Any) -> Any:
        """M(q) (..., k, k)."""
        xp = namespace(q)
        unit = xp.broadcast_to(np.eye(self.dim), (*q.shape, self.dim))
        q = xp.broadcast_to(q[..., None, :], unit.shape)
        rows = self.regressor(q, 0 * q, unit, np.zeros(3))
        found = (rows * as_row(parameters, rows)).sum(-1)
        return 0.5 * (found + xp.swapaxes(found, -1, -2))

    def potential(self, parameters: Any, q: Any) -> Any:
        """V(q) (...) of gravity, 0 at the base's origin."""
        xp, places, total = namespace(q), [], 0.0
        for i, (turn, origin) in enumerate(self._frames(q)):
            if self.parents[i] != BASE:
                before, at = places[self.parents[i]]
                turn, origin = matmul(before, turn), at + (before * origin[..., None, :]).sum(-1)
            places.append((turn, origin))
            m, h = parameters[PER_LINK * i], parameters[PER_LINK * i + 1 : PER_LINK * i + 4]
            moment = m * origin + (turn * as_row(h, turn)).sum(-1)
            total = total - (moment * as_row(self.gravity, moment)).sum(-1)
        return xp.asarray(total)


def pseudo_inertias(parameters: np.ndarray) -> np.ndarray:
    """Pseudo-inertias (k, 4, 4) of links [[½ tr(I) 1 − I, h], [hᵀ, m]], which are positive definite
    for bodies of positive density, and for no others (Wensing, Kim & Slotine, RA-L 3 (2018) 60)."""
    return np.einsum("...p,pij->...ij", parameters.reshape(-1, PER_LINK), PSEUDO)


def _pseudo_basis() -> np.ndarray:
    """∂J/∂π (10, 4, 4)."""
    basis = np.zeros((PER_LINK, 4, 4))
    basis[0, 3, 3] = 1.0
    for i in range(3):
        basis[1 + i, i, 3] = basis[1 + i, 3, i] = 1.0
        basis[4 + _AXES[i][i], :3, :3] += 0.5 * np.eye(3)
        for j in range(3):
            basis[4 + _AXES[i][j], i, j] -= 1.0
    return basis


PSEUDO = _pseudo_basis()


def inertial(mass: float, centre: Any, inertia: Any) -> np.ndarray:
    """π (10,) of a body: its mass, centre (3,) and inertia (3, 3) about the centre, in the axes of
    the link's frame."""
    c = np.asarray(centre, float)
    about = np.asarray(inertia, float) + mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.concatenate([[mass], mass * c, about[np.triu_indices(3)]])


def moved(parameters: np.ndarray, rotation: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """π (10,) of a body in a frame in which its own has this rotation (3, 3) and origin (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, origin
    return of_pseudo_inertia(T @ pseudo_inertias(parameters)[0] @ T.T)


def of_pseudo_inertia(J: np.ndarray) -> np.ndarray:
    """π (10,) of a pseudo-inertia (4, 4)."""
    second = J[:3, :3]
    about = np.trace(second) * np.eye(3) - second
    return np.concatenate([[J[3, 3]], J[:3, 3], about[np.triu_indices(3)]])


def _cross(x: Any) -> Any:
    """Matrix (..., 3, 3) of x × ."""
    xp = namespace(x)
    none, (a, b, c) = xp.zeros_like(x[..., 0]), (x[..., i] for i in range(3))
    rows = [[none, -c, b], [c, none, -a], [-b, a, none]]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def _turned(turn: Any, x: Any) -> Any:
    """turnᵀ x, of vectors (..., 3): into the coordinates of the link."""
    return (turn * x[..., :, None]).sum(-2)


def _of_inertia(x: Any) -> Any:
    """Matrix (..., 3, 6) of I ↦ I x, of the six entries of I."""
    xp = namespace(x)
    none = xp.zeros_like(x[..., 0])
    rows = []
    for i in range(3):
        row = [none] * 6
        for j in range(3):
            row[_AXES[i][j]] = x[..., j]
        rows.append(xp.stack(row, axis=-1))
    return xp.stack(rows, axis=-2)


def _wrench(ω: Any, α: Any, lin: Any) -> Any:
    """Force and moment (..., 6, 10) about the origin of a link that a unit of each of its
    parameters needs, turning by ω and α, its origin accelerated by ``lin``, (..., 3) each."""
    xp, Ω = namespace(ω), _cross(ω)
    zero = xp.zeros((*ω.shape[:-1], 3, 6), ω.dtype)
    first = _cross(α) + matmul(Ω, Ω)
    spin = _of_inertia(α) + matmul(Ω, _of_inertia(ω))
    force = xp.concatenate([lin[..., None], first, zero], axis=-1)
    moment = xp.concatenate([0 * lin[..., None], -_cross(lin), spin], axis=-1)
    return xp.concatenate([force, moment], axis=-2)
