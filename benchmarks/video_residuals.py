"""What a filmed double pendulum's residuals are made of: what each cause explains of them.

    python benchmarks/video_residuals.py DIR          video_double_pendulum.csv in the folder DIR

Arcs of the record are fitted with the textbook's law, the states of each free. Close to that fit
residuals are linear in whatever else may act: a force Q moves the states by δx' = Φ δx + (0, M⁻¹Q),
an error of the camera moves what is seen. Each cause is a group of such columns, without what the
states and the law's own coefficients can do; two thirds of the arcs tell its size and the third is
judged. Figures are mean squares in units of the noise of a sample (local cubics). A torque of each
arc's own, the last row, is no law: it says how large what is left is, as if it were a force.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

# Sets float64, so it comes before all of JAX.
from harness import RESULTS, TABLES, between_markers, markdown, provenance, read, write

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import measure, stretches
from gfnn_jax.maps.estimates import Law, law_of
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians.fit import LawOnArcs
from gfnn_jax.signals.local_polynomials import smooth
from gfnn_jax.solve.latent_arcs import SOFT_L1, Readings

NAME = "video_double_pendulum"
TERMS = (
    "omega1**2",
    "omega1*omega2*cos(theta1 - theta2)",
    "omega2**2",
    "cos(theta1)",
    "cos(theta2)",
    "R: abs(omega1)",
    "R: abs(omega2 - omega1)",
    "R: abs(omega2)**3",
)
LENGTHS, ARCS = (0.15, 0.25), 240  # s of an arc, arcs
HARMONICS = ((1, 0), (0, 1), (1, -1), (1, 1), (2, 0), (0, 2), (2, -1), (1, -2))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--out", type=Path, metavar="DIR", default=RESULTS)
    arguments = parser.parse_args()
    recording = gfnn.read(arguments.folder / f"{NAME}.csv")
    fit: Any = gfnn.fit(recording, terms=TERMS, on_progress=lambda line: None)
    print(fit.formula, fit.friction.formula, sep="\n")
    found = {f"{seconds:g}": causes(law_of(fit.map), recording, seconds) for seconds in LENGTHS}
    out = arguments.out / "video-residuals.json"
    write(
        out,
        {
            "piece": "residuals",
            "formula": fit.formula,
            "friction": fit.friction.formula,
            "arcs": found,
        },
    )
    rows = [
        [cause, *(f"{found[s]['left'][cause]:.2f}" for s in found)]
        for cause in next(iter(found.values()))["left"]
    ]
    table = markdown(("added to the law", *(f"arcs of {s} s" for s in found)), rows)
    print(table)
    print({s: one["torque"] for s, one in found.items()})
    if arguments.out == RESULTS:
        made = provenance(read({"residuals": out}))
        between_markers(TABLES, "video-residuals", f"{table}\n\n{made}")


def causes(law: Law, recording: Any, seconds: float) -> dict[str, Any]:
    """Mean squares of the held-out residuals by cause, and the torques of arcs of that length."""
    found = stretches(recording)
    scales: Any = measure(found)
    size = round(seconds / scales.dt)
    places = [(s, k) for s in found for k in range(0, len(s.t) - size, size)]
    places = places[:: max(1, len(places) // ARCS)]
    t = np.array([s.t[k : k + size] for s, k in places])
    y = np.array([s.y[k : k + size] for s, k in places])
    start = np.array(
        [
            np.concatenate(smooth(s.t, s.q, scales.half, np.arange(k, k + size))[0][:2], axis=1)
            for s, k in places
        ]
    )
    run = np.array([recording.runs.index(s.run) for s, _ in places])
    h, plain = np.diff(t, axis=1), Observation.plain(recording.positions)
    u = np.zeros((*h.shape, 1, 6, 0))
    sigma, every = scales.sigma, np.arange(len(law.p))
    own = LawOnArcs(law.form, plain, (), h, u, law.p, every[1:])  # the first is the gauge
    scale = np.tile(sigma, 2) * np.repeat([1, scales.omega], 2)
    best = Readings(own, y, sigma).fit(law.p[1:], start, scale)
    x, p = best.x, np.append(law.p[0], best.p)
    steps = LawOnArcs(law.form, plain, (), h, u, p, every).defects(p, x)
    lagrangian, (q, v) = law.form.lagrangian(p), np.split(x, 2, axis=-1)
    inverse = np.linalg.inv(lagrangian.masses(q))
    left = (y - q) / sigma
    weight = np.sqrt(SOFT_L1.weights(left / np.median(np.abs(left)) * 0.6745))

    def moved(by_step: np.ndarray, at_start: np.ndarray) -> np.ndarray:
        """Columns (A, L, 2, n) of states: at the start (A, 4, n), by each step (A, L − 1, 4, n)."""
        here, shown = at_start, [at_start[:, :2]]
        for k in range(size - 1):
            here = steps.by_state[:, k] @ here + by_step[:, k]
            shown.append(here[:, :2])
        return np.stack(shown, axis=1) / sigma[:, None]

    def forces(*Q: np.ndarray) -> np.ndarray:
        """Columns of generalised forces (A, L, 2)."""
        kick = np.stack([(inverse @ one[..., None])[..., 0] for one in Q], axis=-1)
        kick = 0.5 * (kick[:, 1:] + kick[:, :-1]) * h[..., None, None]
        lever = np.concatenate([0.5 * h[..., None, None] * kick, kick], axis=2)
        return moved(lever, np.zeros((len(x), 4, kick.shape[-1])))

    def seen(channel: int, *shift: np.ndarray) -> np.ndarray:
        """Columns of errors (A, L) of one angle as seen."""
        columns = np.zeros((*q.shape, len(shift)))
        columns[:, :, channel] = np.stack(shift, axis=-1)
        return columns / sigma[:, None]

    waves = [f(i * q[..., 0] + j * q[..., 1]) for i, j in HARMONICS for f in (np.sin, np.cos)]
    one, turn = np.ones(q.shape[:2]), q[..., 0] - q[..., 1]
    v1, v2 = v[..., 0], v[..., 1]
    joint = v2 - v1
    axes = np.eye(2)

    def along(f: np.ndarray, axis: int) -> np.ndarray:
        return f[..., None] * axes[axis]

    def rate(f: np.ndarray) -> np.ndarray:
        return np.gradient(f, scales.dt, axis=1, edge_order=2)

    gravity = [abs(c) for c in p[3:5]]  # g × (mass × arm) of either angle
    pull = [
        rate(np.sum([g * f(q[..., i]) * v[..., i] for i, g in enumerate(gravity)], axis=0))
        for f in (np.cos, np.sin)
    ]
    yields = [rate(rate(f)) for f in pull]
    pivot = [
        np.stack([g * turned(q[..., i]) * f for i, g in enumerate(gravity)], axis=-1)
        for turned, push, soft in zip((np.cos, np.sin), pull, yields, strict=True)
        for f in (push, rate(push), soft)
    ]
    signs = [np.tanh(2 * f) for f in (v1, joint)]
    base = np.concatenate(
        [
            moved(steps.by_coefficients, np.zeros((len(x), 4, len(every)))),
            seen(0, one),
            seen(1, one),
        ],
        axis=-1,
    )
    per_run = np.concatenate([base * (run == k)[:, None, None, None] for k in range(1, 4)], axis=-1)
    second = (v1 * v1, v1 * v2, v2 * v2)
    along_1, along_2 = (  # of ω₁ ω₂ sin(θ₁ − θ₂): ∂/∂θ − d/dt ∂/∂ω
        sign * v1 * v2 * np.cos(turn) - rate(w * np.sin(turn)) for sign, w in ((1, v2), (-1, v1))
    )
    groups = {
        "nothing": base[..., :0],
        "camera: pivot's marker off its axis, depth (θ₁ by sin θ₁, cos θ₁)": seen(0, *waves[:2]),
        "camera: joint's marker off its axis, depth (θ₂ by sin, cos of θ₁ − θ₂ and θ₂)": seen(
            1, *waves[2:6]
        ),
        "camera: either angle by 16 harmonics": np.concatenate(
            [seen(0, *waves), seen(1, *waves)], axis=-1
        ),
        "a centre of mass off its link's line (ω₁ ω₂ sin(θ₁ − θ₂))": forces(
            np.stack([along_1, along_2], axis=-1)
        ),
        "a pivot that yields (mass, damper, spring; both directions)": forces(*pivot),
        "any force of the angles, 16 harmonics": forces(
            *(along(f, i) for f in waves for i in (0, 1))
        ),
        "any force of second order in the speeds, 17 functions of the angles": forces(
            *(along(f * w, i) for f in (one, *waves) for w in second for i in (0, 1))
        ),
        "friction: cubes and squares of the speeds": forces(
            *(along(f, i) for w in (v1, v2, joint) for f in (w**3, w * abs(w)) for i in (0, 1))
        ),
        "friction: bearings that differ by the angle": forces(
            *(along(f * signs[0], 0) for f in (one, *waves)),
            *(f[..., None] * signs[1][..., None] * [1.0, -1.0] for f in (one, *waves)),
        ),
        "a law for each run": per_run,
    }
    states = moved(np.zeros((len(x), size - 1, 4, 4)), np.broadcast_to(np.eye(4), (len(x), 4, 4)))

    def rows(columns: np.ndarray, own: np.ndarray = states) -> np.ndarray:
        """Weighted rows (A, 2 L, n + 1) of columns and residuals without what is an arc's own."""
        whole = np.concatenate([columns, left[..., None]], axis=-1) * weight[..., None]
        whole = whole.reshape(len(x), 2 * size, -1)
        Q = np.linalg.qr((own * weight[..., None]).reshape(len(x), 2 * size, -1))[0]
        return whole - Q @ (Q.swapaxes(1, 2) @ whole)

    figures = {}
    for name, columns in groups.items():
        figures[name] = held_out(rows(np.concatenate([base, columns], axis=-1)), free=4)
    both = [n for n in groups if figures[n] < 0.985 * figures["nothing"]]
    figures["all of these that help"] = held_out(
        rows(np.concatenate([base, *(groups[n] for n in both)], axis=-1)), free=4
    )
    torques = forces(*(along(one, i) for i in (0, 1)))
    figures["a torque of each arc's own on either link"] = held_out(
        rows(base, np.concatenate([states, torques], axis=-1)), free=6
    )
    pulled = rows(torques)
    size_of = np.linalg.pinv(pulled[..., :-1]) @ pulled[..., -1:]
    spread = 1.4826 * np.median(np.abs(size_of[..., 0]), axis=0)
    error = np.median(np.linalg.norm(np.linalg.pinv(pulled[..., :-1]), axis=-1), axis=0)
    z = size_of[..., 0] / spread
    z = np.clip(z, -4, 4)
    alike = np.mean(z[1:] * z[:-1], axis=0) / np.mean(z * z, axis=0)
    return {
        "law": p.tolist(),
        "left": figures,
        "sigma": sigma.tolist(),
        "helped": both,
        "torque": {
            "spread": spread.tolist(),
            "error": error.tolist(),
            "share of gravity": (spread / gravity).tolist(),
            "correlation of neighbours": alike.tolist(),
        },
    }


def held_out(rows: np.ndarray, free: int) -> float:
    """Mean square of the residuals, the last of ``rows`` (A, R, n + 1), of each third of the arcs
    with what the other two tell; per number that is left after the ``free`` ones of each arc."""
    third, total = np.arange(len(rows)) // 4 % 3, 0.0
    for k in range(3):
        known = rows[third != k].reshape(-1, rows.shape[-1])
        size = np.maximum(np.linalg.norm(known[:, :-1], axis=0), 1e-12)
        found = np.linalg.lstsq(known[:, :-1] / size, known[:, -1], rcond=1e-6)[0] / size
        total += float(np.sum((rows[third == k] @ np.append(-found, 1.0)) ** 2))
    return total / (len(rows) * (rows.shape[1] - free))


if __name__ == "__main__":
    main()
