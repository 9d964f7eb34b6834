"""Report ``report.json`` of a fit: data, model, accuracy, speed, versions.

All keys are always present. A value that does not apply, or is not finite, is null. That of a law
that was learned from a recording has the law's own keys beside them.
"""

import json
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.learn.fitted import Fit
from gfnn_jax.maps.saved import versions
from gfnn_jax.solve.status import STATUS_NAMES
from gfnn_jax.storage.outputs import finite as finite

REPORT, PAGE = "report.json", "report.html"
STEPS_REPORTED = (1, 10, 100, 1000)
_LABELS = ("learns", "family", "label", "chart", "num_parameters")
_ERRORS = ("validation_rms", "validation_relative", "validation_bound", "outside")
_OF_LAW = ("terms", "friction", "constants", "symmetries", "rivals", "notes", "dropped")
_OF_FRICTION = ("kinds", "odds", "limits")
_OF_PAIRS = ("validation_rms", "validation_relative", "tolerance", "tolerance_met")
_OF_MAP = ("symplecticity_defect", "chart_determinant_min", "newton_iterations_max")
_COSTS = ("operations", "microseconds_per_step", "fit_seconds", "rank", "condition", "chosen")


class About(NamedTuple):
    """Facts that a fit does not hold: the command that made it, and what was done to its data."""

    command: str = ""
    notes: tuple[str, ...] = ()


def device() -> str:
    """Name of the device that JAX computes on by default."""
    first = jax.devices()[0]
    return f"{first.platform}: {first.device_kind}"


def _of(result: Any, *names: str) -> dict[str, Any]:
    """Attributes of a result, by name."""
    return {name: getattr(result, name) for name in names}


def _made(fit: Fit, scene: str | None, seed: int | None) -> dict[str, Any]:
    dt, dtype = float(np.asarray(fit.map.dt)), str(fit.map.scale.dtype)
    made = {"verdict": fit.verdict, "scene": scene, "dt": dt, "seed": seed, "dtype": dtype}
    return {**made, "device": device(), "versions": versions()}


def assemble(
    fit: Fit, *, data: dict[str, Any] | None = None, rollout: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Assemble the report of a fit, and of rollouts with it (see `rollout_part`) where there are.

    data: facts about the pairs beside their number: source, digest, precision, units.
    """
    chosen = fit.chosen
    return {
        **_made(fit, None if fit.scene is None else fit.scene.name, fit.seed),
        "data": {
            "num_pairs": fit.num_pairs,
            "symplecticity_defect": fit.data_defect,
            "noise": fit.noise,
            "symmetries": fit.symmetries,
            **(data or {}),
        },
        "model": {
            **_of(chosen, *_LABELS),
            "base_map": fit.base_map,
        },
        "fit": {
            "seconds": chosen.fit_seconds,
            "total_seconds": fit.seconds,
            "tolerance_is_relative": fit.asked.relative,
            "tolerance_met": fit.met,
            **_of(chosen, "train_rms", *_ERRORS[:3], "deviations"),
            **_of(fit, "compile_seconds", "stated_by", "tolerance", "ended"),
            **_of(fit, "operations", "max_operations", "messages"),
        },
        "hamiltonian": _hamiltonian(fit),
        "bracket": _bracket(fit),
        "partial_laws": fit.partial_laws,
        "map": {
            "multiplier": fit.map.multiplier(),
            "damping": _damping(fit),
            "positions": fit.positions,
            "symplecticity_defect": fit.symplecticity_defect if fit.defect_known else None,
            "chart_determinant_min": fit.model_determinant_min,
            "chart_determinants_of_data": {n: j.low for n, j in fit.determinants.items()},
            "newton_iterations_max": chosen.newton_iterations_max,
        },
        "rollout": rollout,
        "candidates": [_of(c, *_LABELS, *_ERRORS, *_COSTS) for c in fit.candidates],
    }


def _damping(fit: Fit) -> dict[str, Any] | None:
    """The factor of areas, one or each degree of freedom's, with its standard error, and the drift
    of the momenta; where they depend on args, the coefficients of which functions, and the range of
    the factor. Of a map that keeps areas none."""
    damping = fit.damping
    if damping is None:
        return None
    found = _of(damping, "factor", "std", "shift")
    if damping.functions is None:
        return found
    low, high = damping.extremes
    degrees = damping.functions.degrees
    return {**found, "parameters": damping.names, "degrees": degrees, "low": low, "high": high}


def _hamiltonian(fit: Fit) -> dict[str, Any] | None:
    """Learned H as formula and terms, where its flow meets the tolerance or was chosen."""
    if fit.hamiltonian is None or fit.formula is None:
        return None
    law = fit.hamiltonian
    which = law.which_friction
    return {
        "formula": fit.formula,
        "which_friction": which and {**_of(which, *_OF_FRICTION), "text": str(which)},
        "search_cut_short": law.ended or None,
        **_of(law, *_OF_LAW),
    }


def _bracket(fit: Fit) -> dict[str, Any] | None:
    """The bracket of a law of states that are no (q, p)."""
    if fit.bracket is None:
        return None
    casimirs = [casimir.formula for casimir in fit.casimirs]
    relations = fit.bracket.relations()
    return {"name": fit.bracket.name, "relations": relations, "casimirs": casimirs}


def assemble_law(fit: Fit, *, source: str | None = None, seed: int = 0) -> dict[str, Any]:
    """The report of a fit of the recording ``source``."""
    map_, sensors = fit.map, fit.map.sensors
    assert sensors is not None
    assert fit.lagrangian is not None
    assert fit.friction is not None
    box = map_.parameters
    ends = () if box is None else np.array([box.names, box.low, box.high], object).T.tolist()
    num_parameters = sum(t.std > 0 for t in (*fit.lagrangian.terms, *fit.friction.terms))
    return {
        **_made(fit, None, seed),
        "data": {"num_pairs": None, "num_samples": fit.num_samples, "source": source},
        "model": {
            "learns": "lagrangian",
            "family": "Lagrangian",
            "label": f"L of {len(fit.lagrangian.terms)} terms",
            "chart": None,
            "num_parameters": num_parameters,
        },
        "fit": {
            "seconds": fit.seconds,
            "compile_seconds": 0.0,
            "total_seconds": fit.seconds,
            "train_rms": fit.residual,
            **dict.fromkeys(_OF_PAIRS),
            **_of(fit, "ended", "messages", "steps", "alike", "next_motions"),
        },
        "hamiltonian": None if fit.hamiltonian is None else _law(fit.hamiltonian),
        "lagrangian": _law(fit.lagrangian),
        "friction": {**_law(fit.friction), **_of(fit.which_friction, *_OF_FRICTION)},
        "rivals": fit.rivals,
        "inputs": {
            "hold": sensors.hold,
            "other_rules": fit.input_rules,
            "delay": sensors.delay,
            "delay_std": None if fit.delay is None or np.isnan(fit.delay[1]) else fit.delay[1],
            "gains": {
                name: {q: {"gain": g, "std": s} for q, (g, s) in forces.items()}
                for name, forces in fit.gains.items()
            },
        },
        "parameters": {name: {"low": low, "high": high} for name, low, high in ends},
        "zeros": {name: {"zero": z, "std": s} for name, (z, s) in fit.zeros.items()},
        "observe": fit.observe,
        "sensors": {name: {"value": c, "std": s} for name, (c, s) in fit.sensors.items()},
        "noise": {n: {"sigma": s, "residual": fit.residual[n]} for n, s in fit.noise.items()},
        "friction_level": sensors.level,
        "wander": sensors.wander,
        **_of(fit, "units", "velocities", "whiteness", "gauge", "energy", "horizon"),
        "map": {"multiplier": map_.multiplier(), **dict.fromkeys(_OF_MAP)},
        "rollout": None,
        "candidates": [],
    }


def _law(expression: Any) -> dict[str, Any]:
    return {**_of(expression, "formula", "terms"), "text": str(expression)}


def rollout_part(*, seconds: float, status, statistics, growth, drift) -> dict[str, Any]:
    """Assemble the report's ``rollout``.

    seconds: without compilation. status: (B,) codes. statistics: ErrorStatistics of the position
    error at every step (num_steps + 1,). growth, drift: Estimates, or None where they do not apply.
    """
    num_trajectories, num_steps = len(status), len(statistics.mean) - 1
    reported = [n for n in STEPS_REPORTED if n <= num_steps]
    none = {str(n): None for n in STEPS_REPORTED}
    return {
        "num_trajectories": num_trajectories,
        "num_excluded": statistics.num_excluded,
        "num_lost": statistics.num_lost,
        "num_steps": num_steps,
        "seconds": seconds,
        "microseconds_per_step": 1e6 * seconds / (num_steps * num_trajectories),
        "status_counts": status_counts(status),
        "error": none | {str(n): float(statistics.mean[n]) for n in reported},
        "error_median": none | {str(n): float(statistics.median[n]) for n in reported},
        "growth_exponent": growth.value if growth else None,
        "growth_exponent_interval": list(growth.interval) if growth else None,
        "energy_drift": drift.value if drift else None,
        "energy_drift_interval": list(drift.interval) if drift else None,
    }


def status_counts(status) -> dict[str, int]:
    """Number of lanes that ended with each status, by its name."""
    counts = np.bincount(np.asarray(status), minlength=len(STATUS_NAMES))
    return {name: int(n) for name, n in zip(STATUS_NAMES, counts, strict=True)}


def to_json(report: dict[str, Any]) -> str:
    """Write the report as strict JSON: numbers that are not finite become null."""
    return json.dumps(finite(report), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
