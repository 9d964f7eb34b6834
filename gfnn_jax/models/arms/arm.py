"""``gfnn.Arm``: from a log of an arm to its law, inertias and friction of given kinematics.

Positions are smoothed by splines whose stiffness their own noise tells (`signals.splines`), which
give velocities and accelerations; no filter is chosen. Forces are taken as they were measured.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.rigid_bodies import EARTH, PER_LINK, of_pseudo_inertia, pseudo_inertias
from gfnn_jax.models.arms.identify import (
    KINDS,
    OPTIONS,
    Columns,
    Motion,
    Prior,
    base_parameters,
    best_swing,
    identified,
)
from gfnn_jax.models.arms.kinematics import Kinematics, from_axes, from_dh, from_urdf
from gfnn_jax.models.arms.learned_arm import LearnedArm, map_of_arm
from gfnn_jax.signals.splines import FEWEST, splines

_EDGE = FEWEST  # samples at the ends of a run, where a spline's accelerations are poor
_FED = 0.3  # share of a joint's power that friction may seem to bring
_UNITS = 3.0  # factor between forces and those of a CAD model beyond which units are asked about


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
        limited = np.abs(motion.force) >= OPTIONS.saturated * kinematics.limits
        motion = motion.without(limited)
        notes = []
        if limited.any():
            at = [f"{n} {m:.1%}" for n, m in zip(names, limited.mean(axis=0), strict=True) if m]
            notes.append(f"samples at the largest force were left out: {', '.join(at)}")
        columns = Columns(kinematics.bodies, self.kinds, np.zeros(len(names)))
        kinematics = _with_checked_forces(kinematics, motion, columns)
        prior, start = prior_of(kinematics, motion, columns)
        rms = np.sqrt(np.mean(motion.v**2, axis=0))
        moving = rms * min(OPTIONS.widths)
        found = identified(columns, motion.without(np.abs(motion.v) < moving), prior, start, report)
        base = base_parameters(found)
        swing = best_swing(found, base)
        dt = float(np.median(np.concatenate([np.diff(recording.times(r)) for r in recording.runs])))
        map_ = map_of_arm(found, states, dt, recording.inputs, gains)
        shares = 1 - (found.residual / np.nanstd(motion.force, axis=0)) ** 2
        return LearnedArm(
            map_,
            base,
            found,
            dict(zip(names, found.residual, strict=True)),
            dict(zip(names, shares, strict=True)),
            tuple(notes),
            swing,
            len(recording),
        )

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
    (n, 2k) = (q, v). gains: (k,) force for a unit of input."""
    runs = []
    for run in recording.runs:
        q = np.stack([recording.unwrapped(n, run) for n in recording.positions], axis=1)
        u = np.stack([recording.values(n, run) for n in recording.inputs], axis=1)
        runs.append((recording.times(run), q, u))
    if not any(len(t) > 2 * _EDGE for t, _, _ in runs):
        raise InputError(f"{recording.source}: expected more than {2 * _EDGE} samples of a run")
    curves = splines([(t, q, np.ones(q.shape)) for t, q, _ in runs])
    parts, lengths = [], []
    for t, q, u in runs:
        if len(t) <= 2 * _EDGE:
            continue
        inside = slice(_EDGE, -_EDGE)
        smooth = curves.smooth(t, q, t)
        parts.append([x[inside] for x in (smooth.q, smooth.v, smooth.a, u * gains)])
        lengths.append(len(t) - 2 * _EDGE)
    q, v, a, force = (np.concatenate(x) for x in zip(*parts, strict=True))
    motion = Motion(q, v, a, force, tuple(lengths))
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
    force = np.nanstd(motion.force, axis=0) + 1e-300
    speed = np.sqrt(np.mean(motion.v**2, axis=0)) + 1e-300
    lost = [force / speed ** {"linear": 1, "quadratic": 2, "dry": 0}[k] for k in columns.kinds]
    sizes = OPTIONS.reflected * np.concatenate([felt, *lost])
    start = np.concatenate([pi, sizes[: bodies.dim], np.zeros(bodies.dim), sizes[bodies.dim :]])
    return Prior(inertias, sizes), start


def _with_checked_forces(kinematics: Kinematics, motion: Motion, columns: Columns) -> Kinematics:
    """The kinematics, guessed links as heavy as the forces need. Raises FitError where forces are
    not those of the motion: where friction would feed a joint, or with a CAD model where they are
    of another size."""
    rows = np.concatenate([rows for rows, _ in columns.blocks(motion)])
    known, names = np.isfinite(motion.force), kinematics.bodies.names
    size = np.linalg.norm(rows[known], axis=0)
    size[size == 0] = 1.0
    x = np.linalg.lstsq(rows[known] / size, motion.force[known], rcond=OPTIONS.dependent)[0] / size
    losses = x[columns.count - len(columns.kinds) * len(names) :]
    _, slope, _ = columns.friction.tables(motion.v)
    lost = (slope * losses).reshape(len(slope), -1, len(names)).sum(axis=1)
    power = np.nanmean(lost * motion.v, axis=0)
    fed = power < -_FED * np.nanmean(np.abs(motion.force * motion.v), axis=0)
    if fed.any():
        wrong = ", ".join(name for name, is_fed in zip(names, fed, strict=True) if is_fed)
        raise FitError(
            f"the forces of {wrong} take energy from the motion, beside friction: their sign or "
            "the order of columns is wrong. Give gains=, -1 for another sign, or inputs in the "
            "order of the joints"
        )
    rigid = PER_LINK * len(names)
    expected = (rows[..., :rigid] @ kinematics.prior.ravel())[known]
    others = np.column_stack([expected, rows[known][:, rigid + len(names) :]])
    factor = np.linalg.lstsq(others, motion.force[known], rcond=None)[0][0]
    if not kinematics.known:
        return kinematics._replace(prior=kinematics.prior * abs(factor))
    if not 1 / _UNITS < factor < _UNITS:
        raise FitError(
            f"the forces are {factor:.2g} of those that the inertias of the URDF need: are they "
            "currents, in other units, or of other joints? Give gains=, the force for a unit of "
            "each input"
        )
    return kinematics
