"""Checks of a log of an arm: limits of forces, and forces that do not go with the motion.

Where a joint's forces follow from parameters of its own, and not from those of a possible arm, a
force has another unit, sign or joint. Which one, is what mends it: a free gain of one joint, which
the coupling of the joints determines, or two inputs in each other's place.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from gfnn_jax.errors import FitError
from gfnn_jax.families.rigid_bodies import PER_LINK
from gfnn_jax.models.arms.identify import OPTIONS, Columns, Identified, Motion
from gfnn_jax.models.arms.kinematics import Kinematics


def limited(motion: Motion, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mask (n, k) of forces at a joint's limit, and mask (k,) of limits that are not those of the
    forces, which go beyond them. limits: (k,), inf where not known; a largest force that many
    samples share, and no other one, is a limit too."""
    size, beyond = np.abs(motion.force), np.zeros(len(limits), bool)
    at = size >= OPTIONS.saturated * limits
    for i, own in enumerate(size.T):
        beyond[i] = at[:, i].any() and np.median(own[at[:, i]]) > limits[i] / OPTIONS.saturated
        top = own >= (1 - 1e-9) * own.max()
        _, counts = np.unique(own[~top & (own > 0)], return_counts=True)
        if top.sum() > max(OPTIONS.plateau * len(own), 10 * counts.max(initial=1)):
            at[:, i] |= top
    return at & ~beyond, beyond


def check_forces(
    found: Identified, motion: Motion, inputs: Sequence[str], gains: np.ndarray, factor: float
) -> None:
    """Raise FitError where the law leaves most of a joint's forces unexplained, which parameters of
    that joint alone explain, with what mends it; where forces are far from ``factor`` = 1 times
    those that the inertias of a CAD model need; or those of one joint from what the others need."""
    columns, given = found.columns, np.flatnonzero(motion.heard).tolist()
    names, k = np.array(columns.bodies.names), columns.bodies.dim
    known = np.flatnonzero(np.isfinite(motion.force[:, given]).all(axis=1))
    known = known[:: 1 + len(known) // OPTIONS.block]
    rows = columns.rows(motion.q[known], motion.v[known], motion.a[known])
    force = np.nan_to_num(motion.force[known])
    scale = np.where(motion.heard, np.std(force, axis=0), 1.0) + 1e-300
    size = np.linalg.norm(rows, axis=(0, 1))
    size[size == 0] = 1.0
    tables = [
        np.asarray(np.linalg.qr(np.hstack([rows[:, i] / size, force / scale]), mode="r"))
        for i in given
    ]

    def solved(own: Sequence[int], of: Sequence[int], free: int | None = None) -> tuple[Any, Any]:
        """Parameters of these joints by the inputs ``of``, that of ``free`` with a gain, which is
        last; and the share of each force that is left, of its standard deviation."""
        A = np.concatenate([tables[given.index(i)][:, :-k] / scale[of[i]] for i in own])
        b = np.concatenate([tables[given.index(i)][:, of[i] - k] for i in own])
        at = np.repeat(np.array(own) == free, len(tables[0]))
        if free is not None:
            A, b = np.column_stack([A, np.where(at, -b, 0.0)]), np.where(at, 0.0, b)
        x = np.linalg.lstsq(A, b, rcond=OPTIONS.dependent)[0]
        left = np.linalg.norm((A @ x - b).reshape(len(own), -1), axis=1) / np.sqrt(len(known))
        return x, left / np.where(at[:: len(tables[0])], abs(x[-1]) + 1e-300, 1.0)

    order = list(range(k))
    alone = np.array([solved([i], order)[1][0] for i in given])
    left = (found.residual / scale)[given]
    noise = np.nanstd(np.diff(motion.force[:, given], 2, axis=0), axis=0) / np.sqrt(6)
    explained = np.maximum(OPTIONS.explained, 1 - alone**2 - OPTIONS.apart)
    poor = (1 - left**2 < explained) & (left > 3 * noise / scale[given])
    far = not 1 / OPTIONS.units < factor < OPTIONS.units
    sized = f"{factor:.2g} times those that the inertias of the URDF need"
    _, slope, _ = columns.friction.tables(motion.v[known])
    speeds = motion.v[known][:, given]

    def takes(x: np.ndarray, left: np.ndarray, turned: np.ndarray) -> bool:
        """True where each joint's friction, of either sign, brings it energy, by a force clear of
        what is left, (k,) shares of the forces times ``turned``."""
        lost = slope * (x / size)[columns.count - len(columns.kinds) * k :]
        lost = lost.reshape(len(slope), -1, k).sum(axis=1)[:, given]
        clear = np.sqrt(np.mean(lost**2, axis=0)) > left * (scale * abs(turned))[given]
        return bool(np.all(clear & (np.mean(lost * speeds, axis=0) < 0)))

    x, together = solved(given, order)
    if takes(x, together, np.ones(k)):
        raise FitError(
            "the forces take energy from the motion of every joint. Their sign is wrong: "
            f"{_gains(-gains)}"
        )
    if far and np.max(together) < OPTIONS.mended:
        unit = _unit(factor)
        raise FitError(
            f"the forces are {sized}: another unit or sign. {_gains(gains / unit)}"
            if unit
            else f"the forces are {sized}: currents, or other units? gfnn.Arm(…, gains=[…]), the "
            "force for a unit of each input"
        )
    trials: list[tuple[list[int], int | None]] = [(order, j) for j in given if len(given) > 1]
    for i, j in combinations(given, 2):
        turned = [*order]
        turned[i], turned[j] = j, i
        trials.append((turned, None))
    tried = [solved(given, of, free) for of, free in trials]
    worse = [float(np.max(rest / (alone + OPTIONS.mended))) for _, rest in tried]
    best = int(np.argmin([*worse, np.inf]))
    mends = min(worse, default=np.inf) < 0.5 * np.max(together / (alone + OPTIONS.mended))
    odd = mends and trials[best][1] is not None and abs(np.log(abs(tried[best][0][-1])))
    if not (far or poor.any() or odd > np.log(OPTIONS.units)):
        return
    poor |= not poor.any()
    said = f"the forces of {', '.join(names[given][poor])} do not go with the motion"
    said += f", and are {sized}" if far else ""
    if mends:
        (of, free), (x, rest) = trials[best], tried[best]
        if free is None:
            listed = ", ".join(repr(inputs[i]) for i in of)
            said += f": two inputs are exchanged. gfnn.read(FILE, inputs=[{listed}])"
        else:
            said += f": those of {names[free]} are {1 / x[-1]:.2g} times what the others need. "
            turned = np.where(np.arange(k) == free, _unit(x[-1]) or x[-1], 1.0)
            said += _gains(gains * turned * (-1 if takes(x[:-1], rest, turned) else 1))
    else:
        said += (
            ". Are positions in degrees (gfnn.read(FILE, degrees=[…])), inputs in the order of the "
            "joints and in N m (gains=[…]), or joints held by friction?"
        )
    raise FitError(said)


def _unit(factor: float) -> float | None:
    """The power of ten, of either sign, that a factor is near."""
    near = float(np.sign(factor) * 10.0 ** np.round(np.log10(abs(factor))))
    return near if abs(factor / near - 1) < OPTIONS.apart else None


def _gains(gains: np.ndarray) -> str:
    return f"gfnn.Arm(…, gains=[{', '.join(f'{g:.3g}' for g in gains)}])"


def size_of_forces(kinematics: Kinematics, motion: Motion, columns: Columns) -> float:
    """Factor between the forces and those that the prior's inertias need."""
    rows = np.concatenate([rows for rows, _ in columns.blocks(motion)])
    known, rigid = np.isfinite(motion.force), PER_LINK * columns.bodies.dim
    expected = (rows[..., :rigid] @ kinematics.prior.ravel())[known]
    others = np.column_stack([expected, rows[known][:, rigid + columns.bodies.dim :]])
    return float(np.linalg.lstsq(others, motion.force[known], rcond=None)[0][0])
