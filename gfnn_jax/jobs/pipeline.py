"""What ``gfnn run``, ``gfnn fit`` and ``gfnn predict`` do, as functions.

Each checks all it can before any long work, says what it is doing through ``say``, writes its
output whole or not at all, and returns what a summary needs. Needs x64 to be on.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax import scenes
from gfnn_jax.evaluate import figures
from gfnn_jax.evaluate import metrics
from gfnn_jax.maps import saved as models
from gfnn_jax.evaluate import report
from gfnn_jax.learn.candidates import Candidate
from gfnn_jax.storage.checkpoints import TrainingCheckpoints
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.data.files import iterate_pairs, read_initial_states, read_sample, read_trajectories
from gfnn_jax.maps.symplectic_map import Lanes, SymplecticMap
from gfnn_jax.storage.outputs import atomic_folder, ensure_new, failures_as_work_errors
from gfnn_jax.phase_space import Pairs, sizes
from gfnn_jax.data.predictions import PredictionWriter
from gfnn_jax.scenes import Scene
from gfnn_jax.learn.fit import Fit, FitError, refit
from gfnn_jax.learn.fit import fit as select
from gfnn_jax.scenes.trajectories import reference_trajectories, sample_pairs, sample_test_states

Say = Callable[[str], Any]

REPORT, MODEL = "report.json", "model"
NUM_STEPS, NUM_TRAJECTORIES = 1_000, 100

# Of a linear family: pairs, and a tolerance that is close to the best that they allow.
LINEAR: dict[str, tuple[int, float]] = {
    "two-body": (4_000, 1e-10),
    "henon-heiles-regular": (4_000, 1e-12),
    "henon-heiles-chaotic": (8_000, 1e-10),
    "henon-heiles-printed": (4_000, 1e-12),
    "pcr3bp": (10_000, 5e-7),
    "standard-map-regular": (1_000, 1e-12),
    "standard-map-chaotic": (1_000, 1e-12),
    "driven-pendulum": (3_000, 1e-10),
    "henon-heiles-section": (1_000, 1e-10),
}
# Of a network: pairs, tolerance, iterations; and of a quick look.
_NETWORK, _NETWORK_QUICK = (6_000, 1e-6, 250), (3_000, 1e-5, 60)
QUICK_PAIRS, QUICK_TRAJECTORIES, QUICK_TOLERANCE = 4_000, 25, 1e-7

# A larger file is never in memory whole: candidates are chosen on a sample of its pairs, and the
# chosen one is fitted to all of them chunk by chunk.
_LARGE_BYTES, _FIT_CHUNK, _HELD = 2**29, 50_000, 2_000
# A chunk of a prediction: what is held in memory at once, and how much work a kill may lose.
_CHUNK_BYTES, _CHUNK_LANE_STEPS = 32 * 2**20, 400_000
# A first step this many roundings from the reference is roundoff.
_ROUNDINGS = 64


class Ran(NamedTuple):
    """A fit, where it was written, and its report."""

    fit: Fit
    out: Path
    report: dict[str, Any]


class Predicted(NamedTuple):
    """How a prediction ended: status and left_at (B,), the map's dt, seconds of computing."""

    status: np.ndarray
    left_at: np.ndarray
    dt: float
    seconds: float


# gfnn run


def run(
    name: str,
    *,
    out: Path,
    quick: bool = False,
    seed: int = 0,
    dt: float | None = None,
    tolerance: float | None = None,
    chart: str = "auto",
    scalar: str = "auto",
    overwrite: bool = False,
    resume: bool = False,
    say: Say = lambda message: None,
) -> Ran | None:
    """Reference data of a scene, fit, rollouts, metrics, figures and report, into the folder out.

    tolerance: of the one-step error; None: the scene's own, close to the best that can be had.
    quick: fewer pairs and rollouts, a tolerance of 1e-7 at best. resume: None where ``out`` is
    this very job, done.
    """
    scene = scene_named(name, dt)
    if scalar == "features" and scene.features is None:
        raise InputError(f"scalar 'features': the scene {name} declares none")
    iterations = None
    if scalar == "mlp":
        num_pairs, default, iterations = _NETWORK_QUICK if quick else _NETWORK
    else:
        num_pairs, default = LINEAR[name]
        if quick:
            num_pairs, default = min(num_pairs, QUICK_PAIRS), max(default, QUICK_TOLERANCE)
    tolerance = default if tolerance is None else tolerance
    num_trajectories = QUICK_TRAJECTORIES if quick else NUM_TRAJECTORIES
    job = {
        "command": "run", "scene": name, "dt": scene.dt, "seed": seed, "chart": chart,
        "scalar": scalar, "tolerance": tolerance, "num_pairs": num_pairs, "quick": quick,
    }  # fmt: skip
    if _already_done(out / MODEL, job, resume):
        return None

    with _unfinished(out, job, overwrite=overwrite, resume=resume) as checkpoints:
        say(f"reference data: {num_pairs} pairs, {num_trajectories} trajectories")
        key_pairs, key_test = jax.random.split(jax.random.key(seed))
        pairs = sample_pairs(scene, num_pairs, key_pairs)
        finite = np.isfinite(np.asarray(pairs.z1)).all(axis=1)
        pairs = pairs.take(np.flatnonzero(finite))  # a state that collides has no image
        z0 = sample_test_states(scene, num_trajectories, key_test)
        fit = _fit(
            pairs, scene, tolerance=tolerance, chart=chart, scalar=scalar, angles=(), seed=seed,
            iterations=iterations, checkpoints=checkpoints, say=say,
        )  # fmt: skip
        say(f"reference trajectories of {NUM_STEPS} steps")
        reference = np.asarray(reference_trajectories(scene, z0, NUM_STEPS))
        say(f"rollouts of {NUM_STEPS} steps")
        measured = measure(rolled_out(fit.map, z0), scene, reference)
        result = report.assemble(
            fit, scene=name, dt=scene.dt, seed=seed, rollout=measured.report,
            data={"source": "reference data of the scene", "digest": pairs_digest(pairs)},
        )  # fmt: skip
        say("figures")
        with atomic_folder(out) as folder:
            models.save(fit.map, folder / MODEL, record={"job": job, **_record(result)})
            for file, figure in _figures(fit, scene, measured, reference).items():
                figures.save(figure, folder / f"{file}.png")
            (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")
    return Ran(fit, out, result)


class Rollouts(NamedTuple):
    """States (B, L, 2d), status (B,), and how long they took, without compilation."""

    states: np.ndarray
    status: np.ndarray
    seconds: float


class Measured(NamedTuple):
    """Rollouts of the test states (B, L, 2d), their errors (B, L), and the report's part."""

    steps: np.ndarray
    predicted: np.ndarray
    error: np.ndarray
    energy_error: np.ndarray | None
    report: dict[str, Any]


def rolled_out(map_: SymplecticMap, z0) -> Rollouts:
    """``NUM_STEPS`` steps from z0 (B, 2d), twice: the first time compiles."""
    jax.block_until_ready(map_.rollout(z0, NUM_STEPS))
    started = time.perf_counter()
    states, info = jax.block_until_ready(map_.rollout(z0, NUM_STEPS))
    return Rollouts(np.asarray(states), np.asarray(info.status), time.perf_counter() - started)


def measure(rollouts: Rollouts, scene: Scene, reference) -> Measured:
    """Errors against the reference (B, L, 2d), energy and growth: the same for every method."""
    predicted, steps = rollouts.states, np.arange(NUM_STEPS + 1)
    error = metrics.position_error(predicted, reference, angles_of_z(scene))
    energy, drift = None, None
    conserved = scene.hamiltonian if scene.period is None else None
    hamiltonian = scene.invariants.get("energy", conserved)
    if hamiltonian is not None:
        energy = metrics.energy_error(jax.vmap(jax.vmap(hamiltonian))(jnp.asarray(predicted)))
        drift = metrics.energy_drift(steps, energy)
    # Roundoff grows by other laws than the error of a model: no exponent where it is all there is.
    roundoff = _ROUNDINGS * np.finfo(float).eps * float(np.max(sizes(reference[:, 0])))
    of_model = float(np.nanmean(error[:, 1])) > roundoff
    growth = metrics.growth_exponent(steps, error) if scene.regular and of_model else None
    part = report.rollout_part(
        num_trajectories=len(predicted), num_steps=NUM_STEPS, seconds=rollouts.seconds,
        status=rollouts.status, statistics=metrics.error_statistics(error), growth=growth,
        drift=drift,
    )  # fmt: skip
    return Measured(steps, predicted, error, energy, part)


def angles_of_z(scene: Scene) -> tuple[int, ...]:
    """Indices of the user's coordinates that are angles."""
    coordinates = scene.coordinates
    return coordinates.angles if coordinates.forward is CARTESIAN.forward else ()


def plane_of(scene: Scene) -> tuple[tuple[str, str], bool]:
    """How one degree of freedom is drawn: names of its coordinates, whether modulo 2π."""
    return ((r"$\theta$", "$p$"), True) if angles_of_z(scene) else (("$q$", "$p$"), False)


def _figures(fit: Fit, scene: Scene, measured: Measured, reference) -> dict[str, Any]:
    """The scene's figures by file name."""
    steps, predicted = measured.steps, measured.predicted
    drawn = {"error": figures.error_growth({"GFNN": (steps, measured.error)})}
    if measured.energy_error is not None:
        drawn["energy"] = figures.energy_error({"GFNN": (steps, measured.energy_error)})
    shown = [c for c in fit.candidates if np.isfinite(c.validation_rms)]
    if fit.chosen in shown:
        drawn["candidates"] = figures.speed_against_error(
            [c.work / 1e3 for c in shown], [c.validation_rms for c in shown],
            [_labelled(c) for c in shown], shown.index(fit.chosen), fit.tolerance,
        )  # fmt: skip
    if scene.name == "two-body":
        errors = [
            metrics.absolute_error(element(predicted), element(reference))
            for element in (metrics.semi_major_axis, metrics.eccentricity)
        ]
        drawn["elements"] = figures.element_errors({"GFNN": (steps, *errors)})[0]
    if scene.name.startswith("henon-heiles") and scene.dim == 2:
        sections = {
            name: np.concatenate([metrics.section_crossings(z, index=0) for z in trajectories])
            for name, trajectories in (("reference", reference), ("GFNN", predicted))
        }
        drawn["section"] = figures.sections({n: (z[:, 1], z[:, 3]) for n, z in sections.items()})[0]
    if scene.dim == 1:
        both = {"reference": reference, "GFNN": predicted}
        drawn["portrait"] = figures.sections(
            {n: (z[..., 0], z[..., 1]) for n, z in both.items()}, *plane_of(scene)
        )[0]
    else:
        lane = int(np.argmax(np.isfinite(reference).all(axis=(1, 2))))
        drawn["portrait"] = figures.phase_portrait(
            {n: (z[lane, :, 0], z[lane, :, 1]) for n, z in
             (("reference", reference), ("GFNN", predicted))}, ("$q_1$", "$q_2$"),
        )  # fmt: skip
    return {name: ax.figure for name, ax in drawn.items()}


# gfnn fit


def _labelled(candidate: Candidate) -> str:
    """Chart, family and size, with the time of a step where it was measured."""
    microseconds = candidate.microseconds_per_step
    timed = f", {microseconds:.1f} µs" if microseconds is not None else ""
    return f"{candidate.chart} {candidate.label}{timed}"


def fit(
    data: Path,
    *,
    out: Path,
    dt: float | None = None,
    tolerance: float = 1e-6,
    chart: str = "auto",
    scalar: str = "auto",
    scene_name: str | None = None,
    angles: tuple[int, ...] = (),
    seed: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    say: Say = lambda message: None,
) -> Ran | None:
    """Learn the map of a trajectory file, and write it with its report into the model folder out.

    scene_name: lends its coordinates and features. resume: None where ``out`` is this very job,
    done.
    """
    scene = scene_named(scene_name, None) if scene_name is not None else None
    large = data.is_file() and data.stat().st_size > _LARGE_BYTES
    trajectories = (read_sample if large else read_trajectories)(data, dt=dt)
    job = {
        "command": "fit", "data": trajectories.digest, "dt": trajectories.dt, "scene": scene_name,
        "angles": list(angles), "tolerance": tolerance, "chart": chart, "scalar": scalar,
        "seed": seed,
    }  # fmt: skip
    if _already_done(out, job, resume):
        return None
    with _unfinished(out, job, overwrite=overwrite, resume=resume) as checkpoints:
        chosen = _fit(
            trajectories.pairs(), scene, tolerance=tolerance, chart=chart, scalar=scalar,
            angles=angles, seed=seed, iterations=None, checkpoints=checkpoints, say=say,
        )  # fmt: skip
        if large and scalar != "mlp":
            say("all pairs of the file, for the chosen candidate")
            held = trajectories.pairs().take(slice(_HELD))
            with _failures_of_arithmetic():
                chosen = refit(chosen, iterate_pairs(data, _FIT_CHUNK, dt=dt), held)
        result = report.assemble(
            chosen, scene=scene_name, dt=trajectories.dt, seed=seed, rollout=None,
            data={
                "source": trajectories.source,
                "digest": trajectories.digest,
                "precision": trajectories.precision,
                "units": trajectories.units,
            },
        )  # fmt: skip
        with atomic_folder(out) as folder:
            models.save(chosen.map, folder, record={"job": job, **_record(result)})
            (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")
    return Ran(chosen, out, result)


def scene_named(name: str, dt: float | None) -> Scene:
    try:
        return scenes.make(name, dt)
    except ValueError as error:
        raise InputError(str(error)) from error


def _fit(pairs: Pairs, scene, *, angles, iterations, say, **options) -> Fit:
    if iterations is not None:
        options["max_iterations"] = iterations
    try:
        with _failures_of_arithmetic():
            return select(pairs, scene, angles=angles, on_progress=say, **options)
    except FitError as error:
        raise InputError(str(error)) from error


@contextlib.contextmanager
def _failures_of_arithmetic() -> Iterator[None]:
    """A factorisation that does not converge, or JAX out of memory, as a WorkError of one line."""
    try:
        yield
    except (np.linalg.LinAlgError, jax.errors.JaxRuntimeError) as error:
        what = (str(error) or type(error).__name__).splitlines()[0]
        raise WorkError(f"the fit failed: {what}") from error


def _record(result: dict[str, Any]) -> dict[str, Any]:
    """What of a report is kept with the map: where it came from and how good it is."""
    finite = {key: result[key] for key in ("scene", "seed", "device", "data", "fit", "map")}
    return report.finite(finite)


def pairs_digest(pairs: Pairs) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(pairs.z0).data)
    digest.update(np.ascontiguousarray(pairs.z1).data)
    return digest.hexdigest()


def _already_done(model: Path, job: dict[str, Any], resume: bool) -> bool:
    """Whether this is a resumed job that had come to its end."""
    if not (resume and model.is_dir()):
        return False
    try:
        return models.record(model).get("job") == job
    except InputError:
        return False


@contextlib.contextmanager
def _unfinished(
    out: Path, job: dict[str, Any], *, overwrite: bool, resume: bool
) -> Iterator[TrainingCheckpoints]:
    """Checkpoints of a training in ``OUT.partial``, which is removed once ``out`` is there."""
    ensure_new(out, overwrite, folder=True)
    folder = out.with_name(out.name + ".partial")
    if folder.exists() and not resume:
        if not overwrite:
            raise InputError(
                f"{folder}: an unfinished fit (--resume goes on with it, --overwrite discards it)"
            )
        _discard(folder)
    checkpoints = TrainingCheckpoints(folder, job)
    checkpoints.check()
    yield checkpoints
    _discard(folder)


def _discard(folder: Path) -> None:
    """Remove the checkpoints, and nothing that is not ours."""
    with failures_as_work_errors(folder):
        for step in [*folder.glob("step_*"), *folder.glob(".step_*")]:
            shutil.rmtree(step)
        if folder.exists():
            folder.rmdir()


# gfnn predict


def predict(
    model: Path,
    initial: Path,
    *,
    num_steps: int,
    save_every: int = 1,
    out: Path,
    stop_outside: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    say: Say = lambda message: None,
) -> Predicted:
    """Predict from the initial states in a file, in chunks along the steps, into ``out``.

    Memory: one chunk of saved states, 32 MiB at most where a saved state of all lanes is no more
    than that, whatever ``num_steps``. A job that was killed goes on with ``resume`` where its last
    chunk ended, to the very bits that an uninterrupted one gives.
    """
    map_ = models.load(model)
    z0 = read_initial_states(initial, map_.dim)
    identity = {
        "model": models.digest(model),
        "initial": hashlib.sha256(np.ascontiguousarray(z0).data).hexdigest(),
        "outside": "stop" if stop_outside else "continue",
    }
    writer = PredictionWriter(
        out, shape=z0.shape, num_steps=num_steps, save_every=save_every, dt=float(map_.dt),
        identity=identity, overwrite=overwrite, resume=resume,
    )  # fmt: skip
    started = time.perf_counter()
    if writer.finished:
        with np.load(out, allow_pickle=False) as done:
            return Predicted(done["status"], done["left_at"], float(map_.dt), 0.0)
    if writer.carry is None:
        lanes = map_.start(z0, stop_outside=stop_outside)
        writer.append(z0[:, None], lanes._asdict())
    else:
        lanes = Lanes(**{name: jnp.asarray(value) for name, value in writer.carry.items()})
    chunk = _chunk_length(z0.shape[0], z0.shape[1], save_every)
    while writer.saved < writer.total:
        say(f"step {(writer.saved - 1) * save_every} of {num_steps}")
        count = min(chunk, writer.total - writer.saved)
        lanes, states = map_.advance(lanes, count, save_every=save_every, stop_outside=stop_outside)
        writer.append(states, lanes._asdict())
    say(f"writing {out}")
    status, left_at = np.asarray(lanes.status), np.asarray(lanes.left_at)
    writer.finish(status, left_at)
    return Predicted(status, left_at, float(map_.dt), time.perf_counter() - started)


def _chunk_length(num_lanes: int, width: int, save_every: int) -> int:
    """Saved states per chunk: a function of the job alone, so that a resumed one cuts alike."""
    by_memory = _CHUNK_BYTES // (8 * num_lanes * width)
    by_work = _CHUNK_LANE_STEPS // (num_lanes * save_every)
    return max(1, min(by_memory, by_work))
