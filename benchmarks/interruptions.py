"""Fits that are interrupted at random moments: what is kept, and how soon they obey.

    python benchmarks/interruptions.py            twenty SIGKILLs, twenty SIGINTs, ten SIGTERMs
    python benchmarks/interruptions.py --quick    one of each signal

Each piece is a family. `gfnn fit` runs as a process of its own; a signal comes at a random moment.
Then the folder ``OUT`` is looked at: it must be absent or a model that loads and predicts. The same
command with --resume goes on, until the next signal, and in the end must give the very map of a fit
that was never interrupted.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, results

import gfnn_jax as gfnn

SIGNALS = {"SIGKILL": 20, "SIGINT": 20, "SIGTERM": 10}
OPTIONS = {
    "polynomial": ("--family", "polynomial", "--tolerance", "1e-14"),
    "sines": ("--family", "sines", "--tolerance", "1e-14"),
    # A training that the budget ends is another one each time.
    "mlp": ("--family", "mlp", "--tolerance", "2e-4", "--max-seconds", "600"),
}
MAX_SECONDS = 60


def interrupted(family: str, quick: bool) -> Numbers:
    """Send every signal at random moments of fits of this family."""
    signals = list(SIGNALS) if quick else [n for n, count in SIGNALS.items() for _ in range(count)]
    # The three families share the signals between them.
    signals = signals if quick else signals[list(OPTIONS).index(family) :: len(OPTIONS)]
    # A shell's background jobs ignore SIGINT, and so would the processes that they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    rng = np.random.default_rng(0)
    rng.shuffle(signals)
    with tempfile.TemporaryDirectory() as folder:
        data, states = data_of(Path(folder))
        command = [
            sys.executable,
            "-m",
            "gfnn_jax",
            "fit",
            str(data),
            "--max-seconds",
            str(MAX_SECONDS),
            "--resume",
            *OPTIONS[family],
            "--out",
        ]
        started = time.perf_counter()
        subprocess.run([*command, f"{folder}/whole"], check=True, capture_output=True)
        seconds = time.perf_counter() - started
        whole = prediction(Path(folder) / "whole", states)
        found, number_of_fit = [], 0
        while len(found) < len(signals):
            out = Path(folder) / f"fit-{number_of_fit}"
            number_of_fit += 1
            while len(found) < len(signals):
                one = stopped([*command, str(out)], signals[len(found)], rng.uniform(0, seconds))
                if one is None:  # the fit was done before
                    break
                published = (out / "model.json").exists()
                usable = not published or np.isfinite(prediction(out, states)).all()
                kept = (out.parent / f"{out.name}.partial").exists()
                found.append({**one, "published": published, "usable": bool(usable), "kept": kept})
            subprocess.run([*command, str(out)], check=True, capture_output=True)
            same = np.array_equal(prediction(out, states), whole)
            for one in found:
                one.setdefault("same_map_in_the_end", bool(same))
    return {"seconds_uninterrupted": seconds, "interruptions": found}


def data_of(folder: Path) -> tuple[Path, np.ndarray]:
    """A file of pairs of Hénon–Heiles, and states to predict from."""
    pairs = gfnn.sample_pairs(gfnn.scenes.make("henon-heiles-regular"), 1_000, jax.random.key(0))
    path = folder / "pairs.npz"
    np.savez(path, z0=pairs.z0, z1=pairs.z1, dt=pairs.dt)
    return path, np.asarray(pairs.z0)[:100]


def prediction(model: Path, states: np.ndarray) -> np.ndarray:
    """Step the states by the saved map."""
    return np.asarray(gfnn.load(model).map.step(states)[0])


def stopped(command: Sequence[str], name: str, delay: float) -> Numbers | None:
    """Start the command and send it the signal after so many seconds; None where it was done."""
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(delay)
        return None
    process.send_signal(getattr(signal, name))
    sent = time.perf_counter()
    _, told = process.communicate()
    return {
        "signal": name,
        "after_seconds": delay,
        "obeyed_in_seconds": time.perf_counter() - sent,
        "exit_status": process.returncode,
        "told": told.strip().splitlines()[-3:],
    }


PIECES = {family: partial(interrupted, family) for family in OPTIONS}


def tables() -> None:
    """The table of RESULTS.md."""
    rows = []
    for family, result in results(PIECES, "interruptions").items():
        every = result["measured"]["interruptions"]
        for name in SIGNALS:
            of = [one for one in every if one["signal"] == name]
            if not of:
                continue
            obeyed = [one["obeyed_in_seconds"] for one in of]
            rows.append(
                [
                    family,
                    name,
                    str(len(of)),
                    number(float(np.median(obeyed))),
                    number(max(obeyed)),
                    str(sum(one["published"] for one in of)),
                    str(sum(not one["usable"] for one in of)),
                    str(sum(not one["same_map_in_the_end"] for one in of)),
                ]
            )
    heads = (
        "family",
        "signal",
        "times",
        "obeyed in (median, s)",
        "at most, s",
        "best map published",
        "damaged",
        "another map in the end",
    )
    between_markers(TABLES, "interruptions", markdown(heads, rows))


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "interruptions", tables, None)
