"""Arms: a UR10E from its public log, against the method that the log's makers published.

    python benchmarks/arms.py DIR              DIR: a copy of shamilmamedov/dynamic_calibration
    python benchmarks/arms.py DIR --quick      every tenth sample, into runs/, no table

Both learn from the record of 50 s and 15 harmonics, with the same gains of the drives (N m/A,
published), and are tested on the ten records of January 17, 2020 in which the arm stands still, and
on the one of that day in which it moves from point to point: the rms of each joint's residual,
measured currents × gains less the torques of the law. *SDP* is the makers' way: velocities, their
differences and the currents by Butterworth filters of order 5 at 0.15, 0.15 and 0.2 of Nyquist's
frequency, sgn v as Coulomb friction, one weight for all joints, pseudo-inertias positive definite,
by the same convex solver at a weight of the barrier of 1e-3, without their bounds of the masses.
Ends at rest are cut from both.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

# Sets float64, so it comes before all of JAX.
from harness import (
    RESULTS,
    TABLES,
    Numbers,
    between_markers,
    markdown,
    number,
    provenance,
    read,
    write,
)
from scipy.signal import butter, filtfilt

# isort: split
import gfnn_jax as gfnn
from gfnn_jax.families.rigid_bodies import pseudo_inertias
from gfnn_jax.models.arms.arm import prior_of
from gfnn_jax.models.arms.identify import Columns, Motion, Prior, minimum
from gfnn_jax.signals.splines import splines

GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)  # N m/A, as the makers took them from the maker
TRAIN = "dataset_ur10e/identification_data/ur-20_02_19_15harm50sec.csv"
TESTS, MOVING = "dataset_ur10e/validation_data", "ur-20_01_17-ptp_10_points"
URDF = "URe/urdf/ur10e.urdf"
JOINTS = range(6)
STILL, EDGE = 1e-3, 5  # rad/s below which the arm rests; samples at the ends of a test


class Log:
    """A record: t (n,), q, v and currents (n, 6); ``cut`` to the part that moves."""

    def __init__(self, path: Path, cut: bool = False, every: int = 1):
        rows = np.loadtxt(path, delimiter=",")
        if cut:
            moves = np.flatnonzero(np.abs(rows[:, 7:13]).max(axis=1) > STILL)
            rows = rows[moves[0] : moves[-1] + 1]
        rows = rows[::every]
        self.t, self.q, self.v, self.i = rows[:, 0] - rows[0, 0], *np.split(rows[:, 1:19], 3, 1)

    def filtered(self) -> tuple[np.ndarray, ...]:
        """q, v, a and currents (n, 6) by the makers' filters."""
        filters: Any = [butter(5, cut) for cut in (0.15, 0.2)]
        (b, c), (b_of_i, c_of_i) = filters
        v, a = filtfilt(b, c, self.v, axis=0), np.zeros_like(self.v)
        a[1:-1] = (v[2:] - v[:-2]) / (self.t[2:] - self.t[:-2])[:, None]
        return self.q, v, filtfilt(b, c, a, axis=0), filtfilt(b_of_i, c_of_i, self.i, axis=0)

    def smooth(self) -> tuple[np.ndarray, ...]:
        """q, v, a (n, 6) by splines."""
        curve = splines([(self.t, self.q)]).smooth(self.t, self.q, self.t)
        return curve.q, curve.v, curve.a

    def recording(self) -> gfnn.Recording:
        named = {f"{n}{j + 1}": x[:, j] for n, x in (("q", self.q), ("i", self.i)) for j in JOINTS}
        names = [[f"{n}{j + 1}" for j in JOINTS] for n in "qi"]
        return gfnn.Recording(
            {"t": self.t, **named}, positions=names[0], inputs=names[1], angles=()
        )


def by_sdp(log: Log, arm: gfnn.Arm) -> Any:
    """Torques (n, 6) of a log by the makers' way, learned from this one."""
    q, v, a, i = log.filtered()
    kinematics = arm.kinematics
    columns = Columns(kinematics.bodies, ("linear", "dry"), np.zeros(6))
    motion = Motion(q, v, a, i * GAINS, (len(q),))
    usual, start = prior_of(kinematics, motion, columns)
    prior = Prior(usual.inertias, usual.sizes, 1e-3)
    x, _ = minimum(columns.triangle(motion, np.ones(6)), columns, prior, start)

    def torques(log: Log) -> np.ndarray:
        q, v, a, i = log.filtered()
        motion = Motion(q, v, a, i, (len(q),))
        return np.concatenate([rows @ x for rows, _ in columns.blocks(motion)])

    return torques


def rms(log: Log, torques: np.ndarray) -> list[float]:
    left = (log.i * GAINS - torques)[EDGE:-EDGE]
    return np.sqrt(np.mean(left**2, axis=0)).tolist()


def measured(folder: Path, quick: bool) -> Numbers:
    """Measure both ways."""
    train = Log(folder / TRAIN, cut=True, every=10 if quick else 1)
    tests = {p.stem: Log(p) for p in sorted((folder / TESTS).glob("ur-20_01_17-p*.csv"))}
    begun, arm = time.process_time(), gfnn.Arm(folder / URDF, gains=GAINS)
    fit: Any = gfnn.fit(train.recording(), model=arm)
    taken, theirs = time.process_time() - begun, by_sdp(train, arm)
    ways = {
        "SDP": theirs,
        "ours": lambda log: fit.map.inverse_dynamics(*log.smooth()).forces,
    }
    found: Numbers = {"seconds": taken, "determined": int(fit.law.base.determined.sum())}
    found["base"] = len(fit.law.base.names)
    inertias = pseudo_inertias(fit.law.found.x[:60])
    found["least"] = float(np.linalg.eigvalsh(inertias).min())
    for name, way in ways.items():
        each = {stem: rms(log, way(log)) for stem, log in tests.items()}
        still = [each[stem] for stem in each if stem != MOVING]
        found[name] = {
            "train": rms(train, way(train)),
            "still": np.sqrt(np.mean(np.square(still), axis=0)).tolist(),
            "moving": each[MOVING],
            "each": each,
        }
    return found


def tables() -> None:
    found = read({"ur10e": RESULTS / "arms-ur10e.json"})
    if not found:
        return
    own = found["ur10e"]["measured"]
    rows = [
        [way, words, *(number(value) for value in own[way][key])]
        for key, words in (
            ("train", "training record"),
            ("still", "ten records at rest"),
            ("moving", "point to point"),
        )
        for way in ("SDP", "ours")
    ]
    heads = ["", "residual, rms (N m)", *(f"joint {j + 1}" for j in JOINTS)]
    said = (
        f"{own['determined']} of {own['base']} base parameters determined, all links possible, "
        f"{number(own['seconds'])} s of a processor."
    )
    text = f"{markdown(heads, rows)}\n\n{said}\n\n{provenance(found)}"
    between_markers(TABLES, "arms", text)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="every tenth sample, no table")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    arguments = parser.parse_args()
    out = arguments.out or (Path("runs") / "arms" if arguments.quick else RESULTS)
    begun = time.perf_counter()
    result = measured(arguments.folder, arguments.quick)
    seconds = time.perf_counter() - begun
    piece = {"piece": "ur10e", "quick": arguments.quick, "measured": result, "seconds": seconds}
    write(out / "arms-ur10e.json", piece)
    if out == RESULTS:
        tables()


if __name__ == "__main__":
    main()
