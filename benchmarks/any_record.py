"""Any sensor, any sampling: recordings that are uneven, incomplete or of short runs, and sensors
that show no position; systems are drawn at random, and the laws that come out are judged.

    python benchmarks/any_record.py            ten draws of each (an hour of a processor)
    python benchmarks/any_record.py --quick    two draws of each, into runs/

Times are those of a Poisson process, 30 % of the cells are missing, or 200 runs have six to ten
samples each; beside them the same number of even, complete readings. Positions have noise of 1e-3
of their spread, and friction is linear or none. A law is *right* whose friction is of the kinds of
the truth and whose forecasts of a period, from true states, err by less than 1 % of the spread in
the median.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of
from random_recordings import SYSTEMS, friction, integrated, law_of

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError

DRAWS, QUICK = 10, 2
NOISE, RIGHT = 1e-3, 0.01  # of the spread
COUNT, RUNS = 1_500, 200
MISSING = 0.3
DUFFING = "spring"
MECHANICAL = ("pendulum", "double pendulum", DUFFING, "carts")
_STARTS, _AHEAD = 11, 10


def _poisson(seconds: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: np.sort(rng.uniform(0, seconds, COUNT))


def _even(seconds: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: (1 + np.arange(COUNT)) * seconds / COUNT


SAMPLINGS = {
    "even, 30 s": _even(30.0),
    "even, 60 s": _even(60.0),
    "Poisson, 30 s": _poisson(30.0),
    "Poisson, 60 s": _poisson(60.0),
    "30 % of cells missing": _even(60.0),
}
SHORT = "200 runs of 6 to 10 samples"


def case(name: str, sampling: str, draw: int) -> Numbers:
    """One recording, its fit and how right it is."""
    rng = np.random.default_rng([MECHANICAL.index(name), draw])
    system, d = SYSTEMS[name](rng), 0
    d = len(system.start)
    omega, size = rng.uniform(2.0, 8.0), rng.uniform(0.01, 0.05)
    kind = str(rng.choice(["none", "linear"]))

    def truth(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        rubbed = np.linalg.solve(system.masses(q), friction(kind, size, v / omega))
        return omega**2 * (system.force(q, v / omega) + rubbed)

    if sampling == SHORT:
        step = 2 * np.pi / omega / rng.uniform(8, 20)
        runs = []
        for _ in range(RUNS):
            start = system.start * rng.uniform(0.3, 1.0) * rng.choice([-1, 1], d)
            phase = rng.uniform(0, 2 * np.pi / omega)
            t = np.concatenate([[0.0], phase + step * np.arange(rng.integers(6, 11))])
            runs.append((t[1:] - phase, integrated(truth, start, 0 * start, t)[1:]))
    else:
        t = SAMPLINGS[sampling](rng)
        states = integrated(truth, system.start, 0 * system.start, np.append(0.0, t))[1:]
        runs = [(t, states)]
    every = np.concatenate([states for _, states in runs])
    spread = every[:, :d].std(axis=0)
    names = [f"x{i}" for i in range(1, d + 1)]
    tables = []
    for t, states in runs:
        seen = states[:, :d] + NOISE * spread * rng.normal(size=(len(t), d))
        if "missing" in sampling:
            seen = np.where(rng.uniform(size=seen.shape) < MISSING, np.nan, seen)
        tables.append({"t": t, **dict(zip(names, seen.T, strict=True))})
    angles = [names[i] for i in system.angles]
    recording = gfnn.Recording(tables, positions=names, angles=angles)
    found: Numbers = {"draw": draw, "friction": kind}
    fit, said = _fitted(recording)
    if fit is None:
        return found | said
    ahead = 2 * np.pi / omega * np.arange(_AHEAD + 1) / _AHEAD
    law, errors = law_of(fit, 1e-3 * omega), []
    for k in np.linspace(0, len(every) - 1, _STARTS).astype(int):
        start = every[k, :d], every[k, d:]
        try:
            miss = integrated(law, *start, ahead) - integrated(truth, *start, ahead)
            errors.append(np.sqrt(np.mean((miss[1:, :d] / spread) ** 2)))
        except (ArithmeticError, np.linalg.LinAlgError):
            errors.append(np.inf)
    error, kinds = float(np.median(errors)), {*fit.which_friction.kinds}
    rubs = bool(kinds) == (kind != "none") and not kinds & {"dry", "quadratic"}
    return (
        found
        | said
        | {
            "error": error if np.isfinite(error) else None,
            "right": bool(error < RIGHT and rubs),
            "rubs": fit.friction.formula,
        }
    )


def _fitted(recording: gfnn.Recording, **options: Any) -> tuple[Any, Numbers]:
    """A fit, None where it is refused, and what it says of itself."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
            done = once(lambda: gfnn.fit(recording, **options))
    except FitError as error:
        return None, {"verdict": error.verdict, "refused": str(error), "right": False}
    fit: Any = done.out
    return fit, {
        "verdict": fit.verdict,
        "formula": fit.formula,
        "processor_seconds": done.processor_seconds,
    }


def sampled(sampling: str, quick: bool) -> Numbers:
    """All systems with one sampling."""
    cases = []
    for name in MECHANICAL:
        if sampling == SHORT and name == "double pendulum":
            continue
        for draw in range(QUICK if quick else DRAWS):
            c = case(name, sampling, draw) | {"system": name}
            cases.append(c)
            what = c.get("refused") or f"{c['error']:.2g} {c['formula']}; {c['rubs']}"
            right = "right" if c["right"] else "WRONG"
            print(f"  {name} {draw} ({c['friction']}): {right} {what[:150]}", flush=True)
    return {"cases": cases}


def _sampling(name: str) -> Callable[[bool], Numbers]:
    return lambda quick: sampled(name, quick)


def _slug(name: str) -> str:
    return name.lower().replace(" %", "-percent").replace(",", "").replace(" ", "-")


PIECES = {_slug(name): _sampling(name) for name in (*SAMPLINGS, SHORT)}


def tables() -> None:
    """The tables of RESULTS.md."""
    found = results_of(PIECES, "any_record")
    rows = []
    for name in (*SAMPLINGS, SHORT):
        if _slug(name) not in found:
            continue
        cases = found[_slug(name)]["measured"]["cases"]
        for system in dict.fromkeys(c["system"] for c in cases):
            own = [c for c in cases if c["system"] == system]
            laws = [c for c in own if "formula" in c]
            right = [c["error"] for c in laws if c["right"]]
            rows.append(
                [
                    name,
                    system,
                    f"{len(right)} of {len(own)}",
                    str(len(own) - len(laws)),
                    number(np.median(right)) if right else "–",
                    number(np.mean([c["processor_seconds"] for c in laws])) if laws else "–",
                ]
            )
    heads = (
        "sampling",
        "system",
        "right",
        "refused",
        "median error of the right, a period ahead",
        "CPU s",
    )
    between_markers(TABLES, "any-record", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "any_record", tables, None)
