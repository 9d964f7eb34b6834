"""What ``gfnn compare`` does: the same data through every method, judged by the same measures.

The data are the paper's ("Experimental Details"): pairs D₂, and sequences of five states D₅, a
fourth as many (on two bodies as many). A finished method is kept in ``OUT.partial`` until all are
done, so that an interrupted comparison goes on with the next one.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.evaluate import figures
from gfnn_jax.evaluate import metrics
from gfnn_jax.maps import saved as models
from gfnn_jax.jobs import pipeline
from gfnn_jax.evaluate import report
from gfnn_jax.baselines import METHODS, Budget, Learned, Sequences
from gfnn_jax.baselines.paper_gfnn import paper_gfnn
from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.solve.newton import NON_FINITE, NOT_CONVERGED, OK
from gfnn_jax.storage.outputs import atomic_folder, atomic_write, ensure_new, failures_as_work_errors
from gfnn_jax.phase_space import Pairs, sizes, symplecticity_defect
from gfnn_jax.jobs.pipeline import NUM_STEPS, NUM_TRAJECTORIES, REPORT, Measured, Rollouts, Say
from gfnn_jax.maps.symplectic_map.rollout import rollout
from gfnn_jax.scenes import Scene
from gfnn_jax.learn.fit import FitWarning
from gfnn_jax.learn.fit import fit as select
from gfnn_jax.scenes.trajectories import (
    reference_trajectories,
    sample_pairs,
    sample_sequences,
    sample_test_states,
)

PAPER_GFNN, OURS = "gfnn-paper", "gfnn"
TITLES = {name: method.title for name, method in METHODS.items()} | {
    PAPER_GFNN: "GFNN (paper)",
    OURS: "GFNN (ours)",
}
CAP, QUICK_CAP = 60.0, 2.0
RUNAWAY = 100.0  # a prediction so many times larger than any reference is lost
BINS = 50  # of the histograms that KL divergences compare

ELEMENTS = {"axis": metrics.semi_major_axis, "eccentricity": metrics.eccentricity}

_NUM_FRESH, _NUM_DEFECTS = 2_000, 200
_QUICK_PAIRS, _QUICK_TRAJECTORIES = 10_000, 10
_EXACT_TRAJECTORIES = 1_000  # where the reference costs nothing; the paper's number for two bodies


class Compared(NamedTuple):
    """Where a comparison was written, and its report."""

    out: Path
    report: dict[str, Any]


def compare(
    name: str,
    *,
    methods: Sequence[str] = (),
    out: Path,
    quick: bool = False,
    seed: int = 0,
    cap: float | None = None,
    overwrite: bool = False,
    resume: bool = False,
    say: Say = lambda message: None,
) -> Compared | None:
    """Learn a scene by these methods (all that apply where none is named), into the folder out.

    cap: most seconds of training for each, compilation apart; 60 unless given, 2 where quick.
    quick: fewer pairs and test states. resume: keeps the methods that are done; None where ``out``
    has them all.
    """
    scene = pipeline.scene_named(name, None)
    cap = (QUICK_CAP if quick else CAP) if cap is None else cap
    chosen = _chosen(methods, scene)
    job = {
        "command": "compare", "scene": name, "seed": seed, "quick": quick, "cap": cap,
        "version": models.versions()["gfnn_jax"],
    }  # fmt: skip
    if resume and _already_done(out, job, chosen):
        return None
    ensure_new(out, overwrite, folder=True)
    finished = _Finished(out.with_name(out.name + ".partial"), job)
    finished.prepare(overwrite=overwrite, resume=resume)

    data = _Data(scene, seed, quick)
    for method in chosen:
        if method in finished:
            continue
        say(f"{TITLES[method]}: data")
        try:
            part, rollouts = _learn_and_roll(method, data, cap, say)
        except ValueError as error:  # no finite start, no fit: the others need not suffer
            raise WorkError(
                f"{TITLES[method]}: {error} (--methods leaves it out, --resume keeps the others)"
            ) from error
        finished.add(method, part, rollouts)
    say("reference, measures and figures")
    reported, measured = {}, {}
    for method in chosen:
        part, rollouts = finished.read(method)
        rollouts = without_runaways(rollouts, data.reference)
        measured[TITLES[method]] = m = pipeline.measure(rollouts, scene, data.reference)
        reported[method] = {
            "title": TITLES[method], **part, "rollout": m.report, "curve": _curve(m.error),
            "kl": _divergences(scene, m.predicted, data.reference),
            "elements": _elements(scene, m.predicted, data.reference),
        }  # fmt: skip
    result = {
        "scene": name, "dt": scene.dt, "seed": seed, "dtype": "float64",
        "device": report.device(), "versions": models.versions(), "quick": quick, "cap": cap,
        "data": {
            "source": "reference data of the scene",
            "num_pairs": data.num_pairs,
            "digest": pipeline.pairs_digest(data.fresh),
        },
        "kl_bins": BINS,
        "job": job,
        "methods": reported,
    }  # fmt: skip
    with atomic_folder(out) as folder:
        for file, figure in draw(scene, measured, data.reference).items():
            figures.save(figure, folder / f"{file}.png")
        (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")
    finished.discard()
    return Compared(out, json.loads(report.to_json(result)))


def _chosen(methods: Sequence[str], scene: Scene) -> tuple[str, ...]:
    """The methods to compare. Raises InputError for one that is not known."""
    unknown = [m for m in methods if m not in TITLES]
    if unknown:
        raise InputError(f"unknown method '{unknown[0]}'; methods: {', '.join(TITLES)}")
    coupled = not separable(scene)
    applying = [m for m in TITLES if m not in METHODS or coupled or not METHODS[m].only_coupled]
    return tuple(m for m in TITLES if m in methods) if methods else tuple(applying)


def separable(scene: Scene) -> bool:
    """Whether H = T(p) + V(q): its mixed second derivatives vanish. A map has no H to tell."""
    hamiltonian = scene.hamiltonian
    if hamiltonian is None:
        return True
    z = sample_test_states(scene, 5, jax.random.key(0))
    mixed = jax.vmap(jax.hessian(hamiltonian))(z)[:, : scene.dim, scene.dim :]
    return bool(jnp.max(jnp.abs(mixed)) == 0)


@dataclasses.dataclass(frozen=True, eq=False)
class _Data:
    """What all methods learn from and are judged by, each drawn when first asked for."""

    scene: Scene
    seed: int
    quick: bool

    @property
    def num_pairs(self) -> int:
        """Of D₂: a hundred thousand, of the standard map a million."""
        if self.quick:
            return _QUICK_PAIRS
        return 100_000 if self.scene.step is None else 1_000_000

    def _key(self, use: int):
        return jax.random.fold_in(jax.random.key(self.seed), use)

    @functools.cache  # noqa: B019, lives as long as a comparison
    def sequences(self, length: int) -> Sequences:
        """D₂ or D₅."""
        few = length > 2 and self.scene.name != "two-body"
        num = self.num_pairs // 4 if few else self.num_pairs
        z = np.asarray(sample_sequences(self.scene, num, length, self._key(length)))
        z = z[np.isfinite(z).all(axis=(1, 2))]  # a state that collides has no image
        angles = pipeline.angles_of_z(self.scene)
        return Sequences(z, self.scene.dt, angles, separable(self.scene))

    @functools.cached_property
    def fresh(self) -> Pairs:
        """Pairs that no method learns from."""
        pairs = sample_pairs(self.scene, _NUM_FRESH, self._key(0))
        return pairs.take(np.flatnonzero(np.isfinite(np.asarray(pairs.z1)).all(axis=1)))

    @functools.cached_property
    def z0(self):
        """The states that rollouts start from."""
        many = NUM_TRAJECTORIES if self.scene.flow is None else _EXACT_TRAJECTORIES
        num = _QUICK_TRAJECTORIES if self.quick else many
        return sample_test_states(self.scene, num, self._key(1))

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Reference trajectories from z0."""
        return np.asarray(reference_trajectories(self.scene, self.z0, NUM_STEPS))


def _learn_and_roll(method: str, data: _Data, cap: float, say: Say):
    """The report's model, data, fit and map of a method, and its rollouts."""
    key = jax.random.fold_in(jax.random.key(data.seed), list(TITLES).index(method) + 100)
    budget = Budget(key, cap, lambda line: say(f"{TITLES[method]}: {line}"))
    if method == OURS:
        return _ours(data, say)
    if method == PAPER_GFNN:
        return _papers(data, budget)
    chosen = METHODS[method]
    sequences = data.sequences(chosen.length)
    learned = chosen.learn(sequences, budget)
    say(f"{TITLES[method]}: rollouts")
    step = learned.step
    defects = jax.jit(jax.vmap(jax.jacfwd(step)))(jnp.asarray(data.fresh.z0[:_NUM_DEFECTS]))
    scale = jnp.asarray(sizes(data.fresh.z0))
    part = {
        "model": {
            "scalar": method, "label": learned.label, "chart": None,
            "num_parameters": learned.num_parameters,
        },
        "data": {"num_pairs": sequences.num_pairs, "sequence_length": chosen.length},
        "fit": {
            **_training(learned.training, cap),
            "validation_rms": _one_step_rms(lambda z: rollout(step, z, 1)[:, 1], data),
        },
        "map": {
            "symplecticity_defect": float(jnp.max(symplecticity_defect(defects, scale))),
            "chart_determinant_min": None, "newton_iterations_max": None,
        },
    }  # fmt: skip
    return part, _rolled_out(learned, data.z0)


def _rolled_out(learned: Learned, z0) -> Rollouts:
    """As `pipeline.rolled_out`, of a plain step."""
    many = jax.jit(lambda z: rollout(learned.step, z, NUM_STEPS)).lower(z0).compile()
    started = time.perf_counter()
    states = np.asarray(many(z0))
    seconds = time.perf_counter() - started
    status = np.where(np.isfinite(states).all(axis=(1, 2)), OK, NON_FINITE)
    return Rollouts(states, status, seconds)


def without_runaways(rollouts: Rollouts, reference) -> Rollouts:
    """What has left the reference's size by far is lost, as what is not finite: NaN from there on.

    Some learned maps go on for long with numbers of no meaning, which would fill every mean.
    """
    with np.errstate(invalid="ignore"):
        away = ~(np.abs(rollouts.states) < RUNAWAY * np.nanmax(np.abs(reference))).all(axis=-1)
    lost = np.logical_or.accumulate(away, axis=1)
    states = np.where(lost[..., None], np.nan, rollouts.states)
    status = np.where(lost[:, -1] & (rollouts.status == OK), NON_FINITE, rollouts.status)
    return Rollouts(states, status, rollouts.seconds)


def _training(training: Any, cap: float) -> dict[str, Any]:
    """The report's part on an Adam training. Its errors are those of the method's own loss."""
    return {
        "seconds": training.seconds,
        "compile_seconds": training.compile_seconds,
        "train_rms": training.train_rms,
        "loss_rms": training.validation_rms,
        "cap": cap,
        "capped": "cap" in training.stopped_because,
        "stopped_because": training.stopped_because,
    }


def _papers(data: _Data, budget: Budget):
    pairs = data.sequences(2)
    learned = paper_gfnn(pairs, budget)
    part = {
        "model": {
            "scalar": "mlp", "label": learned.family.label, "chart": "type2",
            "num_parameters": learned.family.num_parameters,
        },
        "data": {"num_pairs": pairs.num_pairs, "sequence_length": 2},
        "fit": {
            **_training(learned.training, budget.cap or 0.0),
            "validation_rms": _one_step_rms(lambda z: learned.map.step(z)[0], data),
        },
        "map": _map_part(learned.map, data),
    }  # fmt: skip
    return part, pipeline.rolled_out(learned.map, data.z0)


def _ours(data: _Data, say: Say):
    """The map that `gfnn.fit` chooses, from the first few of the same pairs."""
    scene = data.scene
    num_pairs, tolerance = pipeline.LINEAR[scene.name]
    if data.quick:
        num_pairs = min(num_pairs, pipeline.QUICK_PAIRS)
        tolerance = max(tolerance, pipeline.QUICK_TOLERANCE)
    z = data.sequences(2).z[:num_pairs]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # kept in fit.messages
        fit = select(
            Pairs(z[:, 0], z[:, 1], scene.dt), scene, tolerance=tolerance, seed=data.seed,
            on_progress=lambda line: say(f"{TITLES[OURS]}: {line}"),
        )  # fmt: skip
    chosen = fit.chosen
    part = {
        "model": {
            "scalar": chosen.scalar, "label": chosen.label, "chart": chosen.chart,
            "num_parameters": chosen.num_parameters,
        },
        "data": {"num_pairs": fit.num_pairs, "sequence_length": 2},
        "fit": {
            "seconds": chosen.fit_seconds, "compile_seconds": chosen.compile_seconds,
            "total_seconds": fit.seconds, "train_rms": chosen.train_rms,
            "validation_rms": _one_step_rms(lambda z: fit.map.step(z)[0], data),
            "tolerance": tolerance, "cap": None, "capped": False,
            "messages": list(fit.messages),
        },
        "map": _map_part(fit.map, data) | {"chart_determinant_min": fit.model_determinant_min},
    }  # fmt: skip
    return part, pipeline.rolled_out(fit.map, data.z0)


def _map_part(map_, data: _Data) -> dict[str, Any]:
    """Where a step is not solved there is none whose defect could be told: those are counted."""
    z = jnp.asarray(data.fresh.z0[:_NUM_DEFECTS])
    info = map_.step(z)[1]
    solved = np.asarray(info.status) < NOT_CONVERGED
    defects = np.asarray(map_.defect(z))[solved]
    return {
        "symplecticity_defect": float(defects.max()) if len(defects) else None,
        "unsolved": float(np.mean(~solved)),
        "chart_determinant_min": float(jnp.min(jnp.abs(map_.determinant(z)))),
        "newton_iterations_max": int(jnp.max(info.iterations)),
    }


def _one_step_rms(step, data: _Data) -> float:
    """Per-component RMS of the one-step state error on fresh pairs, angles modulo 2π."""
    error = np.asarray(step(jnp.asarray(data.fresh.z0))) - np.asarray(data.fresh.z1)
    angles = list(pipeline.angles_of_z(data.scene))
    error[:, angles] -= TWO_PI * np.round(error[:, angles] / TWO_PI)
    return float(np.sqrt(np.mean(error**2)))


def _elements(scene: Scene, predicted, reference) -> dict[str, Any] | None:
    """Curves of the errors of semi-major axis and eccentricity, of two bodies."""
    if scene.name != "two-body":
        return None
    return {
        name: _curve(metrics.absolute_error(element(predicted), element(reference)))
        for name, element in ELEMENTS.items()
    }


def _curve(error) -> dict[str, Any]:
    """Statistics of an error (B, L) at about 13 steps a decade."""
    steps = np.unique(np.round(np.geomspace(1, NUM_STEPS, 40)).astype(int))
    statistics = metrics.error_statistics(error)
    return {
        "steps": steps.tolist(),
        **{name: [float(f"{v:.4e}") for v in getattr(statistics, name)[steps]]
           for name in ("mean", "std", "median")},
    }  # fmt: skip


# Statistics of chaotic orbits


def _marginal_samples(scene: Scene, states) -> dict[str, tuple[np.ndarray, tuple[float, float]]]:
    """What the marginals are of: label -> samples, and the range where there is a natural one.

    Of the standard map θ and p modulo 2π; else the section q₁ = 0, q̇₁ > 0, interpolated from the
    saved states alike for every method, in (q₂, p₂).
    """
    if scene.dim == 1:
        both = states.reshape(-1, 2) % TWO_PI
        return {"θ": (both[:, 0], (0.0, TWO_PI)), "p": (both[:, 1], (0.0, TWO_PI))}
    section = section_points(states)
    nowhere = (np.nan, np.nan)
    return {"$q_2$": (section[:, 1], nowhere), "$p_2$": (section[:, 3], nowhere)}


def section_points(states) -> np.ndarray:
    """States (K, 2d) where trajectories (B, L, 2d) cross q₁ = 0 upwards."""
    return np.concatenate([metrics.section_crossings(z, index=0) for z in states])


def _range(samples, natural) -> tuple[float, float]:
    """The natural one, else that of the reference's samples, a twentieth wider on either side."""
    if np.isfinite(natural[0]):
        return natural
    low, high = float(samples.min()), float(samples.max())
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _divergences(scene: Scene, predicted, reference) -> dict[str, float] | None:
    """KL divergences of the marginals from the reference's; None where the orbits are regular."""
    if scene.regular:
        return None
    ours, theirs = (_marginal_samples(scene, states) for states in (predicted, reference))
    return {
        label.strip("$"): metrics.kl_divergence(
            samples, theirs[label][0], BINS, _range(*theirs[label])
        )
        for label, (samples, _) in ours.items()
    }


# Figures


def draw(scene: Scene, measured: dict[str, Measured], reference) -> dict[str, Any]:
    """The scene's figures by file name; measured by the methods' titles."""
    steps = next(iter(measured.values())).steps
    drawn: dict[str, Any] = {}
    if scene.regular:
        errors = {n: (steps, m.error) for n, m in measured.items()}
        drawn["error"] = figures.error_growth(errors).figure
    energies = {
        n: (steps, m.energy_error) for n, m in measured.items() if m.energy_error is not None
    }
    if energies:
        drawn["energy"] = figures.energy_error(energies).figure
    predicted = {n: m.predicted for n, m in measured.items()}
    if scene.name == "two-body":
        elements = {
            n: (steps, *(metrics.absolute_error(f(z), f(reference)) for f in ELEMENTS.values()))
            for n, z in predicted.items()
        }  # fmt: skip
        drawn["elements"] = figures.element_errors(elements)[0].figure
    if scene.regular:
        drawn["coordinates"] = _coordinates(scene, predicted, reference)
    if scene.dim == 1:
        shown = {"reference": reference, **predicted}
        if scene.regular:  # one orbit
            shown = {n: z[:1] for n, z in shown.items()}
        points = {n: (z[..., 0], z[..., 1]) for n, z in shown.items()}
        drawn["portraits"] = figures.sections(points, *pipeline.plane_of(scene))[0].figure
    elif not scene.regular:
        sections = {n: section_points(z) for n, z in {"reference": reference, **predicted}.items()}
        points = {n: (z[:, 1], z[:, 3]) for n, z in sections.items()}
        drawn["sections"] = figures.sections(points)[0].figure
    if not scene.regular:
        drawn["marginals"] = _marginals(scene, predicted, reference)
    return drawn


def _coordinates(scene: Scene, predicted, reference):
    """Both coordinates of one orbit against time, at its end (paper, Figs. 2 and 6)."""
    lane = int(np.argmax(np.isfinite(reference).all(axis=(1, 2))))
    times = scene.dt * np.arange(NUM_STEPS + 1)
    window = (times[-31], times[-1]) if scene.dim == 1 else (0.9 * times[-1], times[-1])
    labels, modulo = pipeline.plane_of(scene) if scene.dim == 1 else (("$q_1$", "$q_2$"), False)

    def shown(z, i):
        return z[lane, :, i] % TWO_PI if modulo else z[lane, :, i]

    return figures.coordinates_in_two_panels(
        times,
        [shown(reference, i) for i in (0, 1)],
        {n: [shown(z, i) for i in (0, 1)] for n, z in predicted.items()},
        labels,
        window,
    )


def _marginals(scene: Scene, predicted, reference):
    """The histograms that the KL divergences compare, a panel for each coordinate."""
    theirs = _marginal_samples(scene, reference)
    ours = {n: _marginal_samples(scene, z) for n, z in predicted.items()}
    panels = {
        label: (samples, {n: s[label][0] for n, s in ours.items()}, _range(samples, natural))
        for label, (samples, natural) in theirs.items()
    }
    return figures.marginal_panels(panels, BINS)


# The summary


def table(compared: dict[str, Any]):
    """A rich table of a comparison's report: a row per method."""
    from rich.table import Table  # loaded when first used

    def number(value, form=".1e"):
        return "–" if value is None else format(value, form)

    chaotic = any(m["kl"] for m in compared["methods"].values())
    shown = Table(box=None, pad_edge=False)
    heads = ["method", "parameters", "training, s", "µs/step", "one step", "step 100", "step 1000"]
    for head in [*heads, "growth", "defect", *(["KL"] if chaotic else [])]:
        shown.add_column(head, justify="left" if head == "method" else "right")
    for m in compared["methods"].values():
        fit, rolled = m["fit"], m["rollout"]
        shown.add_row(
            m["title"],
            f"{m['model']['num_parameters']:,}",
            f"{fit['seconds']:.1f}" + (" (cap)" if fit["capped"] else ""),
            f"{rolled['microseconds_per_step']:.2g}",
            number(fit["validation_rms"]),
            number(rolled["error"]["100"]),
            number(rolled["error"]["1000"]),
            number(rolled["growth_exponent"], ".2f"),
            number(m["map"]["symplecticity_defect"]),
            *([", ".join(number(v, ".2g") for v in m["kl"].values())] if chaotic else []),
        )
    return shown


# What is finished


def _already_done(out: Path, job: dict[str, Any], chosen: Sequence[str]) -> bool:
    """Whether this is a resumed comparison that had come to its end."""
    try:
        found = json.loads((out / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return found.get("job") == job and set(found.get("methods", ())) == set(chosen)


@dataclasses.dataclass(frozen=True)
class _Finished:
    """Finished methods in ``OUT.partial``: a .json and a .npz each, written whole or not at all."""

    folder: Path
    job: dict[str, Any]

    def prepare(self, *, overwrite: bool, resume: bool) -> None:
        """Start anew, or go on. Raises InputError where neither was asked for, and where the folder
        is not of this job."""
        about = self.folder / "job.json"
        if self.folder.exists() and not about.exists():
            raise InputError(f"{self.folder}: is in the way, and is no unfinished comparison")
        if self.folder.exists() and not resume:
            if not overwrite:
                raise InputError(
                    f"{self.folder}: an unfinished comparison (--resume goes on with it, "
                    "--overwrite discards it)"
                )
            self.discard()
        if about.exists() and json.loads(about.read_text(encoding="utf-8")) != self.job:
            raise InputError(f"{self.folder}: of another comparison (--overwrite discards it)")
        atomic_write(about, json.dumps(self.job))

    def __contains__(self, method: str) -> bool:
        return (self.folder / f"{method}.json").exists()

    def add(self, method: str, part: dict[str, Any], rollouts: Rollouts) -> None:
        """The .json comes last: where it is, the .npz is whole."""
        with failures_as_work_errors(self.folder):
            np.savez(self.folder / f"{method}.npz", **rollouts._asdict())
        atomic_write(self.folder / f"{method}.json", report.to_json(part))

    def read(self, method: str) -> tuple[dict[str, Any], Rollouts]:
        """What `add` was given."""
        part = json.loads((self.folder / f"{method}.json").read_text(encoding="utf-8"))
        with np.load(self.folder / f"{method}.npz", allow_pickle=False) as arrays:
            found = Rollouts(arrays["states"], arrays["status"], float(arrays["seconds"]))
        return part, found

    def discard(self) -> None:
        """Remove it all."""
        with failures_as_work_errors(self.folder):
            shutil.rmtree(self.folder)
