"""Motion of laws, compiled: times of steps, forecasts and fits beside those of another commit.

    python benchmarks/propagator.py --against CHECKOUT     both, one after the other: a table
    python benchmarks/propagator.py --out FILE             this checkout alone, as JSON

Each checkout is measured by a process of its own, with the package of that checkout, on one thread.
Steps are of a double pendulum with seven coefficients, derivatives in the state and in all
coefficients: smooth, and with dry friction of both joints, which sticks. Steps of a rollout are of
the map of the latter as a recording's, its friction smoothed over 1e-4 where no events are
followed, for each lane and step. Fits are of the first seconds of measured records, law and bands;
forecasts of ten times by the law of the first. Times are processor seconds, the least of several
calls of what is short; *first step* adds compilation or its cache."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded
import jax
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.families.lagrangian import DRY, LINEAR, Friction, Terms
from gfnn_jax.flows.motion import Form
from gfnn_jax.maps.laws import map_of_law, smoothed
from gfnn_jax.maps.sensors import Sensors

jax.config.update("jax_enable_x64", True)

OUT = Path(__file__).resolve().parent / "results" / "propagator.json"
LANES = (1, 16, 128, 768)
RECORDS = {"pendulum": 60.0, "two_carts": 6.0, "double_pendulum": 3.53}  # seconds of each


def double_pendulum(dry: bool) -> tuple[Form, np.ndarray]:
    """A double pendulum with linear friction, or dry friction, of both joints."""
    rows = [
        ((2, 0), (0, 0), (0, 0), 0.0),
        ((1, 1), (0, 0), (1, -1), 0.0),
        ((0, 2), (0, 0), (0, 0), 0.0),
        ((0, 0), (0, 0), (1, 0), 0.0),
        ((0, 0), (0, 0), (0, 1), 0.0),
    ]
    kind = DRY if dry else LINEAR
    friction = Friction.of([((1, 0), kind, 0.0), ((-1, 1), kind, 0.0)], 2)
    form = Form(Terms.of(rows, 2), np.zeros(5), np.eye(5), friction, 0)
    return form, np.array([0.5, 0.4, 0.25, 20.0, 8.0, 0.3, 0.3])


def learned_map() -> Any:
    """The map of the double pendulum with dry friction, with sensors as of a recording's law."""
    form, p = double_pendulum(True)
    law, d = form.lagrangian(p), 2
    law = smoothed(law, 1e-4)
    q, v = np.split(np.random.default_rng(0).normal(size=(200, 4)), 2, axis=1)
    z = np.concatenate([q, law.momentum(q, v)], axis=1)
    none, lead = np.zeros((1, d)), np.array([1.0])
    sensors = Sensors(
        ("a", "b"), (), (), np.full(d, 1e-5), 8.0, 1.0, "hold", 0.0, lead, none, creep=1e-4
    )
    return dataclasses.replace(map_of_law(law, z, 0.01, tolerance=1e-6), sensors=sensors)


def rolled_out(map_: Any, z: np.ndarray, steps: int) -> np.ndarray:
    """The states of a rollout, on the host."""
    return np.asarray(map_.rollout(z, steps)[0])


def step_of(form: Form) -> Callable[..., Any]:
    """The step of a form; of commits before the kernel that with events was a function."""
    if hasattr(form, "follow"):
        return form.step
    from gfnn_jax.flows import coulomb  # pyright: ignore[reportAttributeAccessIssue]

    return lambda *arguments: coulomb.step(form, *arguments)


def least(call: Callable[[], object], calls: int) -> float:
    """Processor seconds of the fastest call."""
    times = []
    for _ in range(calls):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)


def measured(fits: bool) -> dict[str, float]:
    """The processor seconds of this checkout."""
    found, first = {}, True
    for dry in (False, True):
        form, p = double_pendulum(dry)
        for lanes in LANES:
            rng = np.random.default_rng(0)
            x, h = rng.normal(size=(lanes, 4)), np.full(lanes, 0.02)
            x[::3, 2:] *= 0.02
            task = (p, x, h, np.zeros((lanes, 1, 6, 0)))
            step = step_of(form)
            if first:
                found["first step"], first = least(partial(step, *task), 1), False
            seconds = least(partial(step, *task), 30)
            found[f"step, {'dry' if dry else 'smooth'}, {lanes} lanes"] = seconds
    map_, z = learned_map(), np.array([[0.5, -0.3, 0.0, 0.0]])
    for lanes, steps in ((1, 100), (1, 1000), (100, 100)):
        many = np.repeat(z, lanes, axis=0) + 1e-3 * np.arange(lanes)[:, None]
        ahead = partial(rolled_out, map_, many, steps)
        ahead()
        found[f"rollout step, dry, {lanes} x {steps}"] = least(ahead, 5) / (lanes * steps)
    for name, stop in RECORDS.items() if fits else ():
        of = gfnn.records.RECORDS[name]
        recording = gfnn.read(
            gfnn.records.path(name), positions=list(of.positions), angles=list(of.angles)
        ).slice(stop=stop)
        begin = time.process_time()
        fit = gfnn.fit(recording, max_seconds=None)
        found[f"fit, {name}"] = time.process_time() - begin
        if name == "pendulum":
            ahead = partial(fit.map.forecast, recording, stop + 0.1 * np.arange(1, 11))
            found["forecast, pendulum"] = least(ahead, 5)
    return found


def of_checkout(checkout: Path, fits: bool) -> dict[str, float]:
    """The same of another checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    command = [sys.executable, str(Path(__file__).resolve()), "--out", "-"]
    command += [] if fits else ["--steps"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--against", type=Path, help="a checkout of another commit")
    parser.add_argument("--out", default=str(OUT), help="JSON; - for the screen")
    parser.add_argument("--steps", action="store_true", help="no fits")
    options = parser.parse_args()
    if options.out == "-":
        print(json.dumps(measured(not options.steps)))
        return
    here = Path(__file__).resolve().parent.parent
    checkouts = {"before": options.against, "now": here} if options.against else {"now": here}
    found = {name: of_checkout(of, not options.steps) for name, of in checkouts.items()}
    Path(options.out).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    for name, seconds in found["now"].items():
        before = found.get("before", {}).get(name, np.nan)
        print(f"{name:30}{1e3 * before:11.4f} ms before,{1e3 * seconds:10.4f} ms now")


if __name__ == "__main__":
    main()
