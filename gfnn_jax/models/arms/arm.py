"""``gfnn.Arm``: from a log of an arm to its law, inertias and friction of given kinematics.

Positions are smoothed by splines whose stiffness their own noise tells (`signals.splines`), which
give velocities and accelerations; no filter is chosen. Forces are taken as they were measured.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.rigid_bodies import EARTH, PER_LINK, of_pseudo_inertia, pseudo_inertias
from gfnn_jax.models.arms.identify import (
    KINDS,
    Columns,
    Identified,
    Motion,
    Options,
    Prior,
    base_parameters,
    identified,
)
from gfnn_jax.models.arms.kinematics import Kinematics, from_axes, from_dh, from_urdf
from gfnn_jax.models.arms.learned_arm import LearnedArm, map_of_arm
from gfnn_jax.signals.splines import FEWEST, splines

_EDGE = FEWEST  # samples at the ends of a run, where a spline's accelerations are poor
_STILL = 6.0  # range of a joint's positions, in their noise, below which it does not move


@dataclasses.dataclass(frozen=True)
class Arm:
    """Model of a log of an arm: bodies on joints of known kinematics, for `gfnn.fit`.

        fit = gfnn.fit(log, model=gfnn.Arm("robot.urdf"))
        print(fit.law)
        tau = fit.map.inverse_dynamics(q, v, a).forces

    urdf: a file, whose moving joints are the recording's positions, by name or in this order, and
    whose inertias are what is nearest where the log does not tell. Or axes: ((direction), (point))
    of each joint in the frame of the base, where all positions are 0; or dh: modified
    Denavit–Hartenberg rows (a, alpha, d, theta). sliding: indices of joints of these that slide.
    gravity: in the frame of the base, m/s². friction: of each joint, "linear", "quadratic" and
    "dry", joined by +. gains: force of each joint for a unit of its input, in the order of joints
    or by name, where inputs are currents or voltages; 1 where they are forces.

    Lengths are in m, positions in rad, or m of joints that slide; forces in N m or N. The
    recording's inputs are those of the joints, in their order. Raises InputError for kinematics
    that are none, or that are not one of urdf, axes and dh.
    """

    urdf: Any = None
    axes: Sequence[tuple[Sequence[float], Sequence[float]]] | None = None
    dh: Sequence[Sequence[float]] | None = None
    sliding: Sequence[int] = ()
    gravity: Sequence[float] = EARTH
    friction: str = "linear+dry"
    gains: Sequence[float] | Mapping[str, float] | None = None

    def __post_init__(self):
        given = [name for name in ("urdf", "axes", "dh") if getattr(self, name) is not None]
        if len(given) != 1:
            raise InputError(f"expected one of urdf, axes and dh, got {', '.join(given) or 'none'}")
        unknown = set(self.kinds) - set(KINDS)
        if unknown:
            raise InputError(f"expected friction of {', '.join(KINDS)}, got {', '.join(unknown)}")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of friction."""
        return tuple(k for k in self.friction.split("+") if k and k != "none")

    @property
    def kinematics(self) -> Kinematics:
        """The joints, as they are named here."""
        if self.urdf is not None:
            return from_urdf(self.urdf, self.gravity)
        if self.axes is not None:
            return from_axes(self.axes, self.sliding, self.gravity)
        assert self.dh is not None
        return from_dh(self.dh, self.sliding, self.gravity)

    def fit_recording(self, recording: Recording, report: Callable[[str], Any]) -> LearnedArm:
        """The law of a recording. Raises InputError where its columns are not the arm's, FitError
        where forces do not go with the motion."""
        kinematics = self.kinematics.in_order(recording.positions, recording.source)
        names = kinematics.bodies.names
        if len(recording.inputs) != len(names):
            raise InputError(
                f"expected an input of each joint ({', '.join(names)}), got "
                f"{', '.join(recording.inputs) or 'none'}: gfnn.read(FILE, inputs=[…])"
            )
        gains = self._gains(names)
        report("smoothing the positions of the joints")
        motion, states = motion_of(recording, gains)
        notes = []
        columns = Columns(kinematics.bodies, self.kinds, np.zeros(len(names)))
        saturated, beyond = _limited(motion, kinematics.limits)
        for title, shares in (
            ("samples at the largest force were left out", saturated.mean(axis=0)),
            ("forces go beyond the effort limits of the URDF, which were not used", beyond),
        ):
            if shares.any():
                at = [f"{n} {m:.1%}" for n, m in zip(names, shares, strict=True) if m]
                notes.append(f"{title}: {', '.join(at)}")
        motion = motion.without(saturated)
        if (told := int(np.isfinite(motion.force).sum())) <= columns.count:
            raise InputError(
                f"{recording.source}: expected more forces than the arm's {columns.count} "
                f"parameters, found {told} inside runs, of joints that move, below their limits: "
                "a longer log, or other inputs=[…]"
            )
        factor = _size_of_forces(kinematics, motion, columns)
        if not kinematics.known:  # links as heavy as the forces need
            kinematics = kinematics._replace(prior=kinematics.prior * abs(factor))
        prior, start = prior_of(kinematics, motion, columns)
        rms = np.sqrt(np.mean(motion.v**2, axis=0))
        moving = rms * min(Options.widths)
        found = identified(columns, motion.without(np.abs(motion.v) < moving), prior, start, report)
        _check_forces(found, motion, recording.inputs, gains, factor if kinematics.known else 1.0)
        base, swing = base_parameters(found, motion)
        dt = float(np.median(np.concatenate([np.diff(recording.times(r)) for r in recording.runs])))
        map_ = map_of_arm(found, states, dt, recording.inputs, gains)
        spread = np.std(np.nan_to_num(motion.force), axis=0) + 1e-300
        shares = np.where(motion.heard, 1 - (found.residual / spread) ** 2, 0.0)
        left, explained = (dict(zip(names, x, strict=True)) for x in (found.residual, shares))
        count = len(recording)
        return LearnedArm(map_, base, found, left, explained, tuple(notes), swing, count)

    def _gains(self, names: Sequence[str]) -> np.ndarray:
        """Force of each joint for a unit of its input, (k,)."""
        if self.gains is None:
            return np.ones(len(names))
        given = self.gains
        values = [given.get(n) for n in names] if isinstance(given, Mapping) else list(given)
        if len(values) != len(names) or not all(isinstance(g, (int, float)) and g for g in values):
            raise InputError(f"expected gains of the joints {', '.join(names)}, got {given}")
        return np.array(values, float)


def motion_of(recording: Recording, gains: np.ndarray) -> tuple[Motion, np.ndarray]:
    """The motion of a recording's joints by splines, without the ends of runs, and its states
    (n, 2k) = (q, v). A joint that does not move has no forces: friction holds it by any.
    gains: (k,) force for a unit of input. Raises InputError where none moves."""
    runs = []
    for run in recording.runs:
        q = np.stack([recording.unwrapped(n, run) for n in recording.positions], axis=1)
        u = np.stack([recording.values(n, run) for n in recording.inputs], axis=1)
        runs.append((recording.times(run), q, u))
    if not any(len(t) > 2 * _EDGE for t, _, _ in runs):
        raise InputError(f"{recording.source}: expected more than {2 * _EDGE} samples of a run")
    curves = splines([(t, q) for t, q, _ in runs])
    parts, lengths = [], []
    for t, q, u in runs:
        if len(t) <= 2 * _EDGE:
            continue
        inside = slice(_EDGE, -_EDGE)
        smooth = curves.smooth(t, q, t)
        parts.append([x[inside] for x in (smooth.q, smooth.v, smooth.a, u * gains)])
        lengths.append(len(t) - 2 * _EDGE)
    q, v, a, force = (np.concatenate(x) for x in zip(*parts, strict=True))
    still = np.ptp(q, axis=0) < _STILL * curves.sigma
    if still.all():
        raise InputError(
            f"{recording.source}: no joint moves beyond the noise of its positions, so forces tell "
            "no inertia: log a motion of all joints"
        )
    q, v, a = np.where(still, q.mean(axis=0), q), np.where(still, 0.0, v), np.where(still, 0.0, a)
    motion = Motion(q, v, a, np.where(still, np.nan, force), tuple(lengths))
    return motion, np.concatenate([motion.q, motion.v], axis=1)


def prior_of(kinematics: Kinematics, motion: Motion, columns: Columns) -> tuple[Prior, np.ndarray]:
    """Prior of the parameters, and parameters that are possible to start from."""
    bodies, pi = kinematics.bodies, kinematics.prior.ravel()
    inertias = pseudo_inertias(pi)
    for J in inertias:  # point masses and rods of a CAD model have a little width
        least = 1e-3 * np.trace(J[:3, :3]) + 1e-6 * J[3, 3]
        J[:3, :3] += np.eye(3) * max(0.0, least - np.linalg.eigvalsh(J)[0])
    pi = np.concatenate([of_pseudo_inertia(J) for J in inertias])
    some = motion.q[:: max(1, len(motion.q) // 50)]
    felt = np.mean(np.diagonal(bodies.masses(pi, some), axis1=1, axis2=2), axis=0)
    force = np.where(motion.heard, np.std(np.nan_to_num(motion.force), axis=0), 1.0) + 1e-300
    speed = np.where(motion.heard, np.sqrt(np.mean(motion.v**2, axis=0)), 1.0) + 1e-300
    lost = [force / speed ** {"linear": 1, "quadratic": 2, "dry": 0}[k] for k in columns.kinds]
    sizes = Options.reflected * np.concatenate([felt, *lost])
    start = np.concatenate([pi, sizes[: bodies.dim], np.zeros(bodies.dim), sizes[bodies.dim :]])
    return Prior(inertias, sizes), start


# Checks of a log. Where a joint's forces follow from parameters of its own, and not from those of a
# possible arm, a force has another unit, sign or joint. Which one, is what mends it: a free gain of
# one joint, which the coupling of the joints determines, or two inputs in each other's place.


def _limited(motion: Motion, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mask (n, k) of forces at a joint's limit, and mask (k,) of limits that are not those of the
    forces, which go beyond them. limits: (k,), inf where not known; a largest force that many
    samples share, and no other one, is a limit too."""
    size, beyond = np.abs(motion.force), np.zeros(len(limits), bool)
    at = size >= Options.saturated * limits
    for i, own in enumerate(size.T):
        beyond[i] = at[:, i].any() and np.median(own[at[:, i]]) > limits[i] / Options.saturated
        top = own >= (1 - 1e-9) * own.max()
        _, counts = np.unique(own[~top & (own > 0)], return_counts=True)
        if top.sum() > max(Options.plateau * len(own), 10 * counts.max(initial=1)):
            at[:, i] |= top
    return at & ~beyond, beyond


def _check_forces(
    found: Identified, motion: Motion, inputs: Sequence[str], gains: np.ndarray, factor: float
) -> None:
    """Raise FitError where the law leaves most of a joint's forces unexplained, which parameters of
    that joint alone explain, with what mends it; where forces are far from ``factor`` = 1 times
    those that the inertias of a CAD model need; or those of one joint from what the others need."""
    columns, given = found.columns, np.flatnonzero(motion.heard).tolist()
    names, k = np.array(columns.bodies.names), columns.bodies.dim
    known = np.flatnonzero(np.isfinite(motion.force[:, given]).all(axis=1))
    known = known[:: 1 + len(known) // Options.block]
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
        x = np.linalg.lstsq(A, b, rcond=Options.dependent)[0]
        left = np.linalg.norm((A @ x - b).reshape(len(own), -1), axis=1) / np.sqrt(len(known))
        return x, left / np.where(at[:: len(tables[0])], abs(x[-1]) + 1e-300, 1.0)

    order = list(range(k))
    alone = np.array([solved([i], order)[1][0] for i in given])
    left = (found.residual / scale)[given]
    noise = np.nanstd(np.diff(motion.force[:, given], 2, axis=0), axis=0) / np.sqrt(6)
    explained = np.maximum(Options.explained, 1 - alone**2 - Options.apart)
    poor = (1 - left**2 < explained) & (left > 3 * noise / scale[given])
    far = not 1 / Options.units < factor < Options.units
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
            f"{_given(-gains)}"
        )
    if far and np.max(together) < Options.mended:
        unit = _unit(factor)
        raise FitError(
            f"the forces are {sized}: another unit or sign. {_given(gains / unit)}"
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
    worse = [float(np.max(rest / (alone + Options.mended))) for _, rest in tried]
    best = int(np.argmin([*worse, np.inf]))
    mends = min(worse, default=np.inf) < 0.5 * np.max(together / (alone + Options.mended))
    odd = mends and trials[best][1] is not None and abs(np.log(abs(tried[best][0][-1])))
    if not (far or poor.any() or odd > np.log(Options.units)):
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
            said += _given(gains * turned * (-1 if takes(x[:-1], rest, turned) else 1))
    else:
        said += (
            ". Are positions in degrees (gfnn.read(FILE, degrees=[…])), inputs in the order of the "
            "joints and in N m (gains=[…]), or joints held by friction?"
        )
    raise FitError(said)


def _unit(factor: float) -> float | None:
    """The power of ten, of either sign, that a factor is near."""
    near = float(np.sign(factor) * 10.0 ** np.round(np.log10(abs(factor))))
    return near if abs(factor / near - 1) < Options.apart else None


def _given(gains: np.ndarray) -> str:
    return f"gfnn.Arm(…, gains=[{', '.join(f'{g:.3g}' for g in gains)}])"


def _size_of_forces(kinematics: Kinematics, motion: Motion, columns: Columns) -> float:
    """Factor between the forces and those that the prior's inertias need."""
    rows = np.concatenate([rows for rows, _ in columns.blocks(motion)])
    known, rigid = np.isfinite(motion.force), PER_LINK * columns.bodies.dim
    expected = (rows[..., :rigid] @ kinematics.prior.ravel())[known]
    others = np.column_stack([expected, rows[known][:, rigid + columns.bodies.dim :]])
    return float(np.linalg.lstsq(others, motion.force[known], rcond=None)[0][0])
