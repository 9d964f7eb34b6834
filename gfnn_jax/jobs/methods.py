"""Methods of a comparison: learned from the shared data, rolled out and reported."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines import METHODS, Budget, Sequences
from gfnn_jax.baselines.paper_gfnn import paper_gfnn
from gfnn_jax.errors import FitWarning
from gfnn_jax.evaluate.metrics import one_step_rms
from gfnn_jax.jobs.measure import (
    NUM_STEPS,
    NUM_TRAJECTORIES,
    Rollouts,
    angles_of_z,
    map_rollouts,
    step_rollouts,
)
from gfnn_jax.jobs.output import search
from gfnn_jax.jobs.progress import Progress
from gfnn_jax.jobs.run import QUICK, WHOLE
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes, symplecticity_defect
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_pairs, sample_sequences, sample_test_states
from gfnn_jax.scenes.trajectories import reference_trajectories
from gfnn_jax.solve.status import NOT_CONVERGED

PAPER_GFNN, OURS = "gfnn-paper", "gfnn"
TITLES = {name: method.title for name, method in METHODS.items()} | {
    PAPER_GFNN: "GFNN (paper)",
    OURS: "GFNN (ours)",
}
_NUM_DEFECTS = 200


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
    if method == PAPER_GFNN:
        return _papers(data, budget)
    return _baseline(method, data, budget)


def _baseline(method: str, data: SharedData, budget: Budget) -> tuple[dict[str, Any], Rollouts]:
    chosen = METHODS[method]
    sequences = data.sequences(chosen.length)
    learned = chosen.learn(sequences, budget)
    budget.on_progress("rollouts")
    fresh = data.fresh
    defects = symplecticity_defect(
        np.asarray(_jacobians(learned.step, fresh.z0[:_NUM_DEFECTS])),
        sizes(fresh.z0),
    )
    part = {
        "model": _model("map", method, learned.label, None, learned.num_parameters),
        "data": {"num_pairs": sequences.num_pairs, "sequence_length": chosen.length},
        "fit": {
            **_training(learned.training, budget.cap),
            "validation_rms": _rms(data, _steps(learned.step, fresh.z0)),
        },
        "map": {
            "symplecticity_defect": float(defects.max()),
            "chart_determinant_min": None,
            "newton_iterations_max": None,
        },
    }
    return part, step_rollouts(learned.step, data.z0, data.num_steps)


@partial(jax.jit, static_argnums=0)
def _jacobians(step, z):
    """Jacobians (B, 2d, 2d) of a plain step at z (B, 2d)."""
    return jax.vmap(jax.jacfwd(step))(z)


@partial(jax.jit, static_argnums=0)
def _steps(step, z):
    """Images (B, 2d) of z (B, 2d) under a plain step."""
    return jax.vmap(step)(z)


def _model(
    learns: str, family: str, label: str, chart: str | None, num_parameters: int
) -> dict[str, Any]:
    """Report's part on a model."""
    return {
        "learns": learns,
        "family": family,
        "label": label,
        "chart": chart,
        "num_parameters": num_parameters,
    }


def _training(training: Any, cap: float | None) -> dict[str, Any]:
    """Report's part on an Adam training. Its errors are those of the method's own loss."""
    return {
        "seconds": training.seconds,
        "compile_seconds": training.compile_seconds,
        "train_rms": training.train_rms,
        "loss_rms": training.validation_rms,
        "cap": cap,
        "operations": training.operations * training.epochs,
        "capped": "cap" in training.stopped_because,
        "stopped_because": training.stopped_because,
    }


def _papers(data: SharedData, budget: Budget) -> tuple[dict[str, Any], Rollouts]:
    pairs = data.sequences(2)
    learned = paper_gfnn(pairs, budget)
    family = learned.family
    part = {
        "model": _model("map", "mlp", family.label, "type2", family.num_parameters),
        "data": {"num_pairs": pairs.num_pairs, "sequence_length": 2},
        "fit": {
            **_training(learned.training, budget.cap),
            "validation_rms": _rms(data, learned.map.step(data.fresh.z0)[0]),
        },
        "map": _map_part(learned.map, data),
    }
    return part, map_rollouts(learned.map, data.z0, data.num_steps)


def _ours(data: SharedData, progress: Progress) -> tuple[dict[str, Any], Rollouts]:
    """Fit the first few of the same pairs by `gfnn.fit`."""
    scene = data.scene
    num_pairs, tolerance = (QUICK if data.quick else WHOLE).of(scene)
    z = data.sequences(2).z[:num_pairs]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # kept in fit.messages
        fit = search(
            Pairs(z[:, 0], z[:, 1], scene.dt),
            scene,
            FitOptions(tolerance=tolerance, learn="map", seed=data.seed),
            progress=progress,
        )
    chosen = fit.chosen
    part = {
        "model": _model(
            chosen.learns, chosen.family, chosen.label, chosen.chart, chosen.num_parameters
        ),
        "data": {"num_pairs": fit.num_pairs, "sequence_length": 2},
        "fit": {
            "seconds": chosen.fit_seconds,
            "compile_seconds": fit.compile_seconds,
            "total_seconds": fit.seconds,
            "train_rms": chosen.train_rms,
            "validation_rms": _rms(data, fit.map.step(data.fresh.z0)[0]),
            "tolerance": tolerance,
            "tolerance_met": fit.met,
            "ended": fit.ended,
            "cap": None,
            "capped": False,
            "messages": list(fit.messages),
        },
        "map": _map_part(fit.map, data) | {"chart_determinant_min": fit.model_determinant_min},
    }
    return part, map_rollouts(fit.map, data.z0, data.num_steps)


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
    return one_step_rms(np.asarray(images), data.fresh.z1, angles_of_z(data.scene))


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
    def num_steps(self) -> int:
        return NUM_STEPS

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
        return Sequences(z, self.scene.dt, angles_of_z(self.scene), separable(self.scene))

    @functools.cached_property
    def fresh(self) -> Pairs:
        """Pairs that no method learns from."""
        pairs = sample_pairs(self.scene, _NUM_FRESH, self.key(0))
        z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
        known = np.isfinite(z1).all(axis=1)
        return Pairs(z0[known], z1[known], pairs.dt)

    @functools.cached_property
    def z0(self) -> np.ndarray:
        """Initial states of the rollouts, (B, 2d)."""
        many = NUM_TRAJECTORIES if self.scene.flow is None else _EXACT_TRAJECTORIES
        num = _QUICK_TRAJECTORIES if self.quick else many
        return np.asarray(sample_test_states(self.scene, num, self.key(1)))

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Reference trajectories from z0, (B, 1 + num_steps, 2d)."""
        return np.asarray(reference_trajectories(self.scene, self.z0, self.num_steps))
