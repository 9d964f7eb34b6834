"""Constants that decide: each halved and doubled, and what that changes on small fits.

A constant whose neighbours do as well everywhere is not tuned; one whose neighbours lose somewhere
stands where it has to. Of a ratio near one its distance from one is halved and doubled. Error is
the RMS of one step on fresh states ÷ spread, cost the operations of a step of the chosen map; both
relative to those of the constants as they are.

    python benchmarks/constants.py
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import harness
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.compiling import enable_compile_cache

DT, FRESH = 0.3, 500


class System(NamedTuple):
    """H = ½|p|² + V(q): the force −∇V, and the box (2d,) of the states around 0."""

    force: Callable[[np.ndarray], np.ndarray]
    box: tuple[float, ...]


def henon_heiles(q):
    x, y = q.T
    return -np.stack([x + 2 * x * y, y + x**2 - y**2], axis=1)


PENDULUM = System(lambda q: -np.sin(q), (1.5, 1.0))
HENON_HEILES = System(henon_heiles, (0.3,) * 4)


def moved(system: System, z: np.ndarray, dt: float = DT) -> np.ndarray:
    """Images after dt, by Yoshida's fourth-order composition of leapfrog steps."""
    dim, substeps = z.shape[1] // 2, 60
    third = 2 ** (1 / 3)
    parts = np.array([1.0, -third, 1.0]) / (2 - third) * dt / substeps
    q, p = z[:, :dim], z[:, dim:]
    for part in np.tile(parts, substeps):
        q = q + part / 2 * p
        p = p + part * system.force(q)
        q = q + part / 2 * p
    return np.concatenate([q, p], axis=1)


def pairs_of(
    system: System, count: int, noise: float = 0.0, run: int = 1, seed: int = 0, dt: float = DT
) -> gfnn.Pairs:
    """Pairs in sequences of ``run`` steps, normal noise on every state."""
    rng = np.random.default_rng(seed)
    states = [rng.uniform(-1, 1, (count // run, len(system.box))) * system.box]
    for _ in range(run):
        states.append(moved(system, states[-1], dt))
    z = np.stack(states, axis=1)
    z = z + noise * rng.standard_normal(z.shape)
    width = z.shape[-1]
    one, other = z[:, :-1].reshape(-1, width), z[:, 1:].reshape(-1, width)
    return gfnn.Pairs(one, other, dt, run=np.repeat(np.arange(count // run), run))


class Outcome(NamedTuple):
    """RMS of one step on fresh states ÷ spread, operations of a step, and the candidate."""

    error: float
    cost: float
    label: str


def learned(system: System, pairs: gfnn.Pairs, damping: float = 1.0, **options: Any) -> Outcome:
    """One fit without a clock, judged on states that it has not seen."""
    fit = gfnn.fit(pairs, max_seconds=None, **options)
    fresh = pairs_of(system, FRESH, seed=1, dt=float(pairs.dt))
    z1 = np.array(fresh.z1)
    z1[:, z1.shape[1] // 2 :] *= damping
    left = (np.asarray(fit.map.step(fresh.z0)[0]) - z1) / np.std(z1, axis=0)
    return Outcome(float(np.sqrt(np.mean(left**2))), fit.chosen.operations, fit.chosen.label)


def changed(pairs: gfnn.Pairs, z1: np.ndarray) -> gfnn.Pairs:
    return dataclasses.replace(pairs, z1=z1)


def outliers() -> Outcome:
    pairs = pairs_of(PENDULUM, 300)
    z1 = np.array(pairs.z1)
    z1[::50] += 0.3
    return learned(PENDULUM, changed(pairs, z1), learn="map", tolerance=1e-6)


def damped() -> Outcome:
    pairs = pairs_of(PENDULUM, 300)
    z1 = np.array(pairs.z1)
    z1[:, 1] *= 0.97
    return learned(PENDULUM, changed(pairs, z1), damping=0.97, learn="map", tolerance=1e-6)


def record() -> Outcome:
    """A pendulum's law from 600 noisy positions; the error is that of its frequency squared."""
    rng, z, angle = np.random.default_rng(0), np.array([[1.2, 0.0]]), []
    for _ in range(600):
        angle.append(z[0, 0])
        z = moved(PENDULUM, z, 0.1)
    noisy = np.array(angle) + 2e-3 * rng.standard_normal(600)
    fit: Any = gfnn.fit(
        gfnn.Recording({"t": 0.1 * np.arange(600), "x": noisy}, positions=["x"], angles=["x"])
    )
    law = {term.term: term.coefficient for term in fit.lagrangian.terms}
    found = next((abs(c) for name, c in law.items() if "cos" in name), 0.0)
    return Outcome(abs(found - 1.0), float(len(law)), ", ".join(law))


CASES: dict[str, Callable[[], Outcome]] = {
    "clean": lambda: learned(PENDULUM, pairs_of(PENDULUM, 300), learn="map", tolerance=1e-8),
    "few": lambda: learned(PENDULUM, pairs_of(PENDULUM, 70), learn="map", tolerance=1e-6),
    "noisy": lambda: learned(PENDULUM, pairs_of(PENDULUM, 300, 1e-3), learn="map"),
    "sequences": lambda: learned(PENDULUM, pairs_of(PENDULUM, 300, 1e-3, 30)),
    "outliers": outliers,
    "damped": damped,
    "two": lambda: learned(HENON_HEILES, pairs_of(HENON_HEILES, 400), learn="map", tolerance=1e-6),
    "law": lambda: learned(HENON_HEILES, pairs_of(HENON_HEILES, 300, 1e-5), tolerance=1e-6),
    "long": lambda: learned(PENDULUM, pairs_of(PENDULUM, 300, dt=2.0), learn="map", tolerance=1e-6),
    "record": record,
}

S, H, L = "models.generating_functions", "models.hamiltonians", "models.lagrangians"


class Constant(NamedTuple):
    """module, name: where it stands; a name with a point is one of a class of options. cases: that
    it decides in. unit: what it is measured in."""

    module: str
    name: str
    cases: tuple[str, ...]
    unit: str


CONSTANTS = tuple(
    Constant(*row)
    for row in (
        (
            "fitting.least_squares",
            "ROWS_PER_TERM",
            ("few", "two", "noisy", "damped"),
            "rows ÷ terms of S",
        ),
        ("search.search", "GAINED", ("clean", "noisy"), "error ÷ least before, no gain above"),
        ("search.search", "Options.farthest", ("clean", "two"), "orders ÷ range of orders"),
        ("search.search", "Options.stalled", ("noisy",), "sizes in a row without a gain"),
        ("search.search", "Options.no_worse", ("noisy",), "error ÷ error, as good below"),
        ("search.search", "Options.far", ("clean", "few"), "foretold error ÷ tolerance"),
        (
            "learn.choose",
            "Options.confirmed",
            ("clean", "long"),
            "bound of own steps ÷ of the search",
        ),
        ("learn.noisy_sweeps", "_NO_WORSE", ("noisy",), "squared error ÷ least, as good below"),
        ("dataset.split", "Options.fraction", ("few", "noisy"), "part of the pairs that validates"),
        ("diagnosis.local_jacobians", "_FAR", ("long",), "determinant of ∂w/∂z"),
        (
            "diagnosis.local_jacobians",
            "NEIGHBOURS_PER_TERM",
            ("damped", "outliers"),
            "neighbours ÷ unknowns",
        ),
        ("diagnosis.outliers", "Options.most_outliers", ("outliers",), "part of the pairs"),
        ("learn.gross_errors", "Options.beyond", ("outliers",), "residual ÷ neighbours'"),
        ("fitting.significance", "CERTAIN", ("damped",), "standard errors"),
        ("fitting.significance", "ABOVE_NOISE", ("law", "sequences"), "standard errors"),
        (f"{H}.search", "MAX_COST_RATIO", ("law",), "operations ÷ the map's"),
        ("fitting.evidence", "EVIDENCE.rise", ("law",), "held-out error ÷ before"),
        (f"{H}.sequences", "OPTIONS.rise", ("sequences",), "held-out error ÷ before"),
        (f"{H}.problem", "OPTIONS.flat", ("sequences",), "error ÷ error"),
        ("solve.latent_arcs", "OUTLYING", ("sequences",), "standard deviations"),
        ("solve.latent_arcs", "OPTIONS.defect", ("record",), "standard deviations"),
        ("solve.latent_arcs", "SOFT_L1.k", ("record",), "standard deviations"),
        ("fitting.evidence", "EVIDENCE.significant", ("record",), "standard errors"),
        ("fitting.evidence", "EVIDENCE.scored", ("record",), "standard errors"),
        ("fitting.evidence", "EVIDENCE.gain", ("record",), "part of the held-out cost"),
    )
)


def value_of(module: str, name: str) -> Any:
    owner, _, field = name.partition(".")
    held = getattr(importlib.import_module(f"gfnn_jax.{module}"), owner)
    return getattr(held, field) if field else held


@contextlib.contextmanager
def set_to(module: str, name: str, value: Any) -> Iterator[None]:
    """The constant with another value, wherever it was imported to."""
    owner, _, field = name.partition(".")
    held = getattr(importlib.import_module(f"gfnn_jax.{module}"), owner)
    undo: list[Callable[[], None]] = []
    if isinstance(held, type):  # a class of options
        before = getattr(held, field)
        setattr(held, field, value)
        undo.append(lambda: setattr(held, field, before))
    elif field:
        alike = {id(o): o for m in _modules() for o in vars(m).values() if type(o) is type(held)}
        for options in alike.values():
            old = getattr(options, field)
            object.__setattr__(options, field, value)
            undo.append(lambda o=options, old=old: object.__setattr__(o, field, old))
    else:
        for other in _modules():
            if other.__name__ == f"gfnn_jax.{module}" or (
                not owner.startswith("_") and getattr(other, owner, None) is held
            ):
                setattr(other, owner, value)
                undo.append(lambda m=other: setattr(m, owner, held))
    try:
        yield
    finally:
        for back in undo:
            back()


def _modules():
    return [m for name, m in list(sys.modules.items()) if name.startswith("gfnn_jax.")]


def tried(case: str) -> Outcome:
    """The outcome of a case; infinite where there is none."""
    try:
        return CASES[case]()
    except (gfnn.FitError, ValueError, ArithmeticError) as error:
        return Outcome(np.inf, np.inf, type(error).__name__)


def beside(value: float, factor: float) -> float:
    """A value so many times as large; of a ratio near one its distance from one is."""
    near = 0.5 < value < 1.5
    return 1 + (value - 1) * factor if near else type(value)(value * factor)


def halved_and_doubled(quick: bool) -> harness.Numbers:
    """(constant, factor) -> what becomes of error and cost."""
    known: dict[str, Outcome] = {}
    found: dict[str, Any] = {}
    for module, name, cases, _ in CONSTANTS[:: 6 if quick else 1]:
        value = value_of(module, name)
        row: dict[str, Any] = {"value": value}
        for factor in (0.5, 2.0):
            other = beside(value, factor)
            for case in cases:
                if case not in known:
                    known[case] = tried(case)
                with set_to(module, name, other):
                    there = tried(case)
                here = known[case]
                row[f"{case} × {factor:g}"] = {
                    "error": there.error / here.error,
                    "cost": there.cost / here.cost,
                    "label": there.label if there.label != here.label else "",
                }
        found[f"{module}.{name}"] = row
        print(f"{module}.{name} = {value:g}: {shown(row)}", flush=True)
    return {"cases": {c: o._asdict() for c, o in known.items()}, "constants": found}


def shown(row: dict[str, Any]) -> str:
    """What changed, in words; a file holds None for a number that is not finite."""
    moves = []
    for case, found in row.items():
        if not isinstance(found, dict):
            continue
        if found["error"] is None or not np.isfinite(found["error"]):
            moves.append(f"{case} fails")
        elif not all(0.99 < found[what] < 1.01 for what in ("error", "cost")):
            moves.append(f"{case} error {found['error']:.2g}, cost {found['cost']:.2g}")
    return "; ".join(moves) or "nothing changes"


PIECES: harness.Pieces = {"halved-and-doubled": halved_and_doubled}


def tables() -> None:
    found = harness.results(PIECES, "constants")
    text = []
    if "halved-and-doubled" in found:
        rows = found["halved-and-doubled"]["measured"]["constants"]
        units = {f"{c.module}.{c.name}": c.unit for c in CONSTANTS}
        heads = ("constant", "value", "unit", "halved and doubled")
        cells = [
            [f"`{name}`", f"{row['value']:g}", units[name], shown(row)]
            for name, row in rows.items()
        ]
        text.append(harness.markdown(heads, cells))
    if text:
        text.append(harness.provenance(found))
        harness.between_markers(harness.TABLES, "constants", "\n\n".join(text))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    enable_compile_cache(tempfile.mkdtemp())
    harness.main(__doc__ or "", PIECES, "constants", tables, None)
