"""Job of ``gfnn compare``: the same data through all methods, with the same measures.

A finished method is kept in ``OUT.partial`` until all are done, so that an interrupted comparison
resumes with the next one.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines import METHODS, Budget, Sequences
from gfnn_jax.baselines.learned import paper_gfnn
from gfnn_jax.errors import FitWarning, InputError, WorkError
from gfnn_jax.evaluate import figures, metrics, report
from gfnn_jax.evaluate.metrics import one_step_rms
from gfnn_jax.jobs.figures import BINS, divergences, figures_of_comparison
from gfnn_jax.jobs.measure import (
    NUM_STEPS,
    NUM_TRAJECTORIES,
    Rollouts,
    finite_pairs,
    map_rollouts,
    measure,
    step_rollouts,
    without_runaways,
)
from gfnn_jax.jobs.output import Output, pairs_digest, scene_named, search
from gfnn_jax.jobs.progress import Progress
from gfnn_jax.jobs.run import QUICK, WHOLE
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.maps.saved import versions
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes, symplecticity_defect
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_sequences, sample_test_states
from gfnn_jax.scenes.trajectories import reference_trajectories
from gfnn_jax.solve.status import NOT_CONVERGED
from gfnn_jax.storage import outputs

PAPER_GFNN, OURS = "gfnn-paper", "gfnn"
TITLES = {name: method.title for name, method in METHODS.items()} | {
    PAPER_GFNN: "GFNN (paper)",
    OURS: "GFNN (ours)",
}
_NUM_DEFECTS = 200
_MODEL = ("learns", "family", "label", "chart", "num_parameters")
_NO_MAP = {"chart_determinant_min": None, "newton_iterations_max": None}


def learn_and_roll(
    method: str, data: SharedData, cap: float, progress: Progress
) -> tuple[dict[str, Any], Rollouts]:
    """Learn and roll out a method: the report's model, data, fit and map, and the rollouts.

    cap: most operations of training, counted.
    """
    headed = Progress(
        lambda line: progress.status(f"{TITLES[method]}: {line}"),
        lambda line: progress.line(f"{TITLES[method]}: {line}"),
    )
    if method == OURS:
        return _ours(data, headed)
    budget = Budget(data.key(list(TITLES).index(method) + 100), cap, headed.status)
    chosen, z = METHODS.get(method), data.fresh.z0
    length = 2 if chosen is None else chosen.length
    sequences = data.sequences(length)
    if chosen is None:  # the paper's own
        learned = paper_gfnn(sequences, budget)
        family, map_ = learned.family, learned.map
        model = "map", "mlp", family.label, "type2", family.num_parameters
        images, about, roll = map_.step(z)[0], _map_part(map_, data), partial(map_rollouts, map_)
    else:
        learned = chosen.learn(sequences, budget)
        budget.on_progress("rollouts")
        model = "map", method, learned.label, None, learned.num_parameters
        jacobians = jax.jit(jax.vmap(jax.jacfwd(learned.step)))(z[:_NUM_DEFECTS])
        defect = float(symplecticity_defect(np.asarray(jacobians), sizes(z)).max())
        about = {**_NO_MAP, "symplecticity_defect": defect}
        images, roll = jax.jit(jax.vmap(learned.step))(z), partial(step_rollouts, learned.step)
    training = learned.training
    part = {
        "model": dict(zip(_MODEL, model, strict=True)),
        "data": {"num_pairs": sequences.num_pairs, "sequence_length": length},
        "fit": {  # its errors are those of the method's own loss
            "seconds": training.seconds,
            "compile_seconds": training.compile_seconds,
            "train_rms": training.train_rms,
            "loss_rms": training.validation_rms,
            "cap": budget.cap,
            "operations": training.operations * training.epochs,
            "capped": "cap" in training.stopped_because,
            "stopped_because": training.stopped_because,
            "validation_rms": _rms(data, images),
        },
        "map": about,
    }
    return part, roll(data.z0, NUM_STEPS)


def _ours(data: SharedData, progress: Progress) -> tuple[dict[str, Any], Rollouts]:
    """Fit the first few of the same pairs by `gfnn.fit`."""
    scene = data.scene
    num_pairs, tolerance = (QUICK if data.quick else WHOLE).of(scene)
    z = data.sequences(2).z[:num_pairs]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # kept in fit.messages
        asked = FitOptions(tolerance=tolerance, learn="map", seed=data.seed)
        fit = search(Pairs(z[:, 0], z[:, 1], scene.dt), scene, asked, progress=progress)
    told = fit.replaced(defect_known=False).report()  # the defect is that of all methods' states
    error = _rms(data, fit.map.step(data.fresh.z0)[0])
    part = {
        "model": told["model"],
        "data": {"num_pairs": fit.num_pairs, "sequence_length": 2},
        "fit": {**told["fit"], "validation_rms": error, "cap": None, "capped": False},
        "map": _map_part(fit.map, data) | {"chart_determinant_min": fit.model_determinant_min},
    }
    return part, map_rollouts(fit.map, data.z0, NUM_STEPS)


def _map_part(map_: SymplecticMap, data: SharedData) -> dict[str, Any]:
    """Report's part on a map. Steps that were not solved have no defect, and are counted."""
    z = data.fresh.z0[:_NUM_DEFECTS]
    info = map_.step(z)[1]
    solved = np.asarray(info.status) < NOT_CONVERGED
    defects = np.asarray(map_.defect(z, iterations=info.iterations))[solved]
    return {
        "symplecticity_defect": float(defects.max()) if len(defects) else None,
        "unsolved": float(np.mean(~solved)),
        "chart_determinant_min": float(np.min(np.abs(np.asarray(map_.determinant(z))))),
        "newton_iterations_max": int(np.max(np.asarray(info.iterations))),
    }


def _rms(data: SharedData, images) -> float:
    """RMS per component of the one-step state error on fresh pairs, angles modulo 2π."""
    return one_step_rms(np.asarray(images), data.fresh.z1, data.scene.coordinates.user_angles)


_NUM_FRESH = 2_000
_QUICK_PAIRS, _QUICK_TRAJECTORIES = 10_000, 10
_EXACT_TRAJECTORIES = 1_000  # where the reference costs nothing; the paper's number for two bodies


@functools.partial(jax.jit, static_argnums=0)
def _largest_mixed(hamiltonian, z):
    """Largest entry of ∂²H/∂q∂p in magnitude at z (B, 2d)."""
    dim = z.shape[1] // 2
    return jnp.max(jnp.abs(jax.vmap(jax.hessian(hamiltonian))(z)[:, :dim, dim:]))


def separable(scene: Scene) -> bool:
    """Return whether H = T(p) + V(q), by its mixed second derivatives; True for a map without H."""
    if scene.hamiltonian is None:
        return True
    z = sample_test_states(scene, 5, jax.random.key(0))
    return float(_largest_mixed(scene.hamiltonian, z)) == 0


@jax.jit
def _key(seed, use):
    return jax.random.fold_in(jax.random.key(seed), use)


@dataclasses.dataclass(frozen=True, eq=False)
class SharedData:
    """Data of a comparison, NumPy; each part is drawn when it is first used."""

    scene: Scene
    seed: int
    quick: bool

    @property
    def num_pairs(self) -> int:
        """Number of pairs of D₂: a hundred thousand, for the standard map a million."""
        if self.quick:
            return _QUICK_PAIRS
        return 100_000 if self.scene.step is None else 1_000_000

    def key(self, use: int):
        """Make a key for one use of randomness; the data use 0 to 5."""
        return _key(self.seed, use)

    @functools.cache  # noqa: B019, lives as long as a comparison
    def sequences(self, length: int) -> Sequences:
        """Draw D₂ (length 2) or D₅ (length 5)."""
        few = length > 2 and self.scene.name != "two-body"
        num = self.num_pairs // 4 if few else self.num_pairs
        z = np.asarray(sample_sequences(self.scene, num, length, self.key(length)))
        z = z[np.isfinite(z).all(axis=(1, 2))]  # a state that collides has no image
        angles = self.scene.coordinates.user_angles
        return Sequences(z, self.scene.dt, angles, separable(self.scene))

    @functools.cached_property
    def fresh(self) -> Pairs:
        """Pairs that no method learns from."""
        return finite_pairs(self.scene, _NUM_FRESH, self.key(0))

    @functools.cached_property
    def z0(self) -> np.ndarray:
        """Initial states of the rollouts, (B, 2d)."""
        many = NUM_TRAJECTORIES if self.scene.flow is None else _EXACT_TRAJECTORIES
        num = _QUICK_TRAJECTORIES if self.quick else many
        return np.asarray(sample_test_states(self.scene, num, self.key(1)))

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Reference trajectories from z0, (B, 1 + num_steps, 2d)."""
        return np.asarray(reference_trajectories(self.scene, self.z0, NUM_STEPS))


CAP, QUICK_CAP = 60.0, 2.0  # seconds, at the rate below
RATE = 4e10  # counted operations of a training that a quiet core makes in a second, about


def compare(
    name: str,
    output: Output,
    *,
    methods: Sequence[str] = (),
    quick: bool = False,
    seed: int = 0,
    cap: float | None = None,
) -> dict[str, Any] | None:
    """Learn a scene by these methods (with none named, all that apply), into a folder.

    cap: most training of each, in seconds that stand for RATE counted operations, whatever the
    machine; 60 by default, 2 with quick. quick: fewer pairs and test states. A resumed comparison
    keeps the methods that are done, and returns None where the output has them all. Raises
    InputError for a scene or a method that cannot be compared, WorkError where a method fails.
    """
    progress = output.progress
    scene = scene_named(name)
    if scene.parameters:
        raise InputError(f"the scene {name} has parameters, which the other methods do not take")
    if scene.any_phase:
        raise InputError(f"the scene {name} is driven, and the other methods do not take the time")
    cap = (QUICK_CAP if quick else CAP) if cap is None else cap
    chosen = chosen_methods(methods, scene)
    job = {"command": "compare", "scene": name, "seed": seed, "quick": quick, "cap": cap}
    job["version"] = versions()["gfnn_jax"]
    if output.resume and _already_done(output.out, job, chosen):
        return None
    with outputs.unfinished(
        output.out, job, what="comparison", overwrite=output.overwrite, resume=output.resume
    ) as kept_in:
        data = SharedData(scene, seed, quick)
        for method in chosen:
            if (kept_in / f"{method}.json").exists():
                continue
            progress.status(f"{TITLES[method]}: data")
            try:
                part, rollouts = learn_and_roll(method, data, cap * RATE, progress)
            except ValueError as error:  # the results of the other methods are kept
                raise WorkError(
                    f"{TITLES[method]}: {error} (leave it out with --methods; --resume keeps the "
                    "others)"
                ) from error
            _keep(kept_in, method, part, rollouts)
            seconds, error = part["fit"]["seconds"], part["fit"]["validation_rms"]
            progress.line(f"{TITLES[method]}: one-step error {error:.2e}, {seconds:.1f} s")
        progress.status("reference, measures and figures")
        reported, measured = {}, {}
        for method in chosen:
            part, rollouts = _kept(kept_in, method)
            rollouts = without_runaways(rollouts, data.reference)
            measured[TITLES[method]] = m = measure(rollouts, scene, data.reference)
            reported[method] = {
                "title": TITLES[method],
                **part,
                "rollout": m.report,
                "curve": _curve(m.error),
                "kl": divergences(scene, m.predicted, data.reference),
                "elements": None
                if scene.name != "two-body"
                else {
                    name: _curve(metrics.absolute_error(of(m.predicted), of(data.reference)))
                    for name, of in metrics.ELEMENTS.items()
                },
            }
        result: dict[str, Any] = {"scene": name, "dt": scene.dt, "seed": seed, "dtype": "float64"}
        result |= {"device": report.device(), "versions": versions(), "quick": quick, "cap": cap}
        drawn = {"num_pairs": data.num_pairs, "digest": pairs_digest(data.fresh)}
        result["data"] = {"source": "reference data of the scene", **drawn}
        result |= {"kl_bins": BINS, "job": job, "methods": reported}
        with outputs.atomic_folder(output.out) as folder:
            for file, figure in figures_of_comparison(scene, measured, data.reference).items():
                figures.save(figure, folder / f"{file}.png")
            (folder / report.REPORT).write_text(report.to_json(result), encoding="utf-8")
    return json.loads(report.to_json(result))


def chosen_methods(methods: Sequence[str], scene: Scene) -> tuple[str, ...]:
    """Return the methods to compare. Raises InputError for one that is not known."""
    unknown = [m for m in methods if m not in TITLES]
    if unknown:
        raise InputError(f"unknown method '{unknown[0]}'; methods: {', '.join(TITLES)}")
    if methods:
        return tuple(m for m in TITLES if m in methods)
    coupled = not separable(scene)
    return tuple(m for m in TITLES if m not in METHODS or coupled or not METHODS[m].only_coupled)


def _curve(error) -> dict[str, Any]:
    """Statistics of an error (B, L) at about 13 steps a decade."""
    steps = np.unique(np.round(np.geomspace(1, error.shape[1] - 1, 40)).astype(int))
    statistics = metrics.error_statistics(error)
    names = ("mean", "std", "median")
    found = {n: [float(f"{v:.4e}") for v in getattr(statistics, n)[steps]] for n in names}
    return {"steps": steps.tolist(), **found}


# Finished methods: a .json and a .npz for each, written whole or not at all.


def _already_done(out: Path, job: dict[str, Any], chosen: Sequence[str]) -> bool:
    try:
        found = json.loads((out / report.REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return found.get("job") == job and set(found.get("methods", ())) == set(chosen)


def _keep(folder: Path, method: str, part: dict[str, Any], rollouts: Rollouts) -> None:
    """Keep a finished method. The .json is written last: where it exists, the .npz is whole."""
    with outputs.failures_as_work_errors(folder):
        np.savez(folder / f"{method}.npz", **rollouts._asdict())
    outputs.atomic_write(folder / f"{method}.json", report.to_json(part))


def _kept(folder: Path, method: str) -> tuple[dict[str, Any], Rollouts]:
    part = json.loads((folder / f"{method}.json").read_text(encoding="utf-8"))
    with np.load(folder / f"{method}.npz", allow_pickle=False) as arrays:
        return part, Rollouts(arrays["states"], arrays["status"], float(arrays["seconds"]))
