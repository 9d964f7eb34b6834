"""Report ``report.json`` of a fit: data, model, accuracy, speed, versions.

All keys are always present. A value that does not apply, or is not finite, is null.
"""

from __future__ import annotations

import json
import math
from typing import Any

import jax
import numpy as np

from gfnn_jax.learn.fitted import Fit
from gfnn_jax.maps.saved import versions
from gfnn_jax.solve.status import STATUS_NAMES

STEPS_REPORTED = (1, 10, 100, 1000)


def device() -> str:
    """Name of the device that JAX computes on by default."""
    first = jax.devices()[0]
    return f"{first.platform}: {first.device_kind}"


def assemble(
    fit: Fit,
    *,
    scene: str | None = None,
    seed: int | None = None,
    data: dict[str, Any] | None = None,
    rollout: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Assemble the report of a fit, and of rollouts with it (see `rollout_part`) where there are.

    scene, seed: where these are not the fit's own. data: facts about the pairs beside their
    number: source, digest, precision, units.
    """
    chosen = fit.chosen
    lent = fit.scene.name if fit.scene is not None else None
    return {
        "verdict": fit.verdict,
        "scene": scene or lent,
        "dt": float(np.asarray(fit.map.dt)),
        "seed": fit.seed if seed is None else seed,
        "dtype": str(fit.map.scale.dtype),
        "device": device(),
        "versions": versions(),
        "data": {
            "num_pairs": fit.num_pairs,
            "symplecticity_defect": fit.data_defect,
            "noise": None if fit.noise is None else fit.noise.tolist(),
            "symmetries": [symmetry._asdict() for symmetry in fit.symmetries],
            **(data or {}),
        },
        "model": {
            "learns": chosen.learns,
            "family": chosen.family,
            "label": chosen.label,
            "chart": chosen.chart,
            "num_parameters": chosen.num_parameters,
            "base_map": fit.base_map,
        },
        "fit": {
            "seconds": chosen.fit_seconds,
            "compile_seconds": fit.compile_seconds,
            "total_seconds": fit.seconds,
            "train_rms": chosen.train_rms,
            "validation_rms": chosen.validation_rms,
            "validation_relative": chosen.validation_relative,
            "validation_bound": chosen.validation_bound,
            "deviations": np.asarray(chosen.deviations).tolist(),
            "stated_by": fit.stated_by,
            "tolerance": fit.tolerance,
            "tolerance_is_relative": fit.asked.relative,
            "tolerance_met": fit.met,
            "ended": fit.ended,
            "operations": fit.operations,
            "max_operations": fit.max_operations,
            "messages": list(fit.messages),
        },
        "hamiltonian": _hamiltonian(fit),
        "partial_laws": [law._asdict() for law in fit.partial_laws],
        "map": {
            "multiplier": fit.map.multiplier(),
            "damping": _damping(fit),
            "positions": None if fit.positions is None else vars(fit.positions),
            "symplecticity_defect": fit.symplecticity_defect if fit.defect_known else None,
            "chart_determinant_min": fit.model_determinant_min,
            "chart_determinants_of_data": {n: j.low for n, j in fit.determinants.items()},
            "newton_iterations_max": chosen.newton_iterations_max,
        },
        "rollout": rollout,
        "candidates": [
            {
                "learns": c.learns,
                "family": c.family,
                "label": c.label,
                "chart": c.chart,
                "num_parameters": c.num_parameters,
                "validation_rms": c.validation_rms,
                "validation_relative": c.validation_relative,
                "validation_bound": c.validation_bound,
                "outside": c.outside,
                "operations": c.operations,
                "microseconds_per_step": c.microseconds_per_step,
                "fit_seconds": c.fit_seconds,
                "rank": c.rank,
                "condition": c.condition,
                "chosen": c.chosen,
            }
            for c in fit.candidates
        ],
    }


def _damping(fit: Fit) -> dict[str, Any] | None:
    """The factor of areas, one or each degree of freedom's, with its standard error, and the drift
    of the momenta; where they depend on args, the coefficients of which functions, and the range of
    the factor. Of a map that keeps areas none."""
    damping = fit.damping
    if damping is None:
        return None
    names = ("factor", "std", "shift")
    found: dict[str, Any] = {name: getattr(damping, name).tolist() for name in names}
    if damping.functions is not None:
        low, high = (values.tolist() for values in damping.extremes)
        found |= {
            "parameters": damping.names,
            "degrees": damping.functions.degrees,
            "low": low,
            "high": high,
        }
    return found


def _hamiltonian(fit: Fit) -> dict[str, Any] | None:
    """Learned H as formula and terms, where its flow meets the tolerance or was chosen."""
    if fit.hamiltonian is None or fit.formula is None:
        return None
    law = fit.hamiltonian
    which = law.which_friction
    return {
        "formula": fit.formula,
        "terms": [term._asdict() for term in law.terms],
        "friction": [term._asdict() for term in law.friction],
        "which_friction": None
        if which is None
        else {
            "kinds": list(which.kinds),
            "odds": which.odds,
            "limits": which.limits,
            "text": str(which),
        },
        "constants": [term._asdict() for term in law.constants],
        "symmetries": list(law.symmetries),
        "fractions": [str(p) for p in law.proposals],
        "rivals": [rival._asdict() for rival in law.rivals],
        "notes": list(law.notes),
        "dropped": law.dropped._asdict() if law.dropped is not None else None,
        "search_cut_short": law.ended or None,
    }


def rollout_part(
    *,
    num_trajectories: int,
    num_steps: int,
    seconds: float,
    status,
    statistics,
    growth,
    drift,
) -> dict[str, Any]:
    """Assemble the report's ``rollout``.

    seconds: without compilation. status: (B,) codes. statistics: ErrorStatistics of the position
    error at every step (num_steps + 1,). growth, drift: Estimates, or None where they do not apply.
    """
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


def finite(value: Any) -> Any:
    """Copy a tree of dicts and lists, with None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, (np.generic, np.ndarray, jax.Array)) and np.ndim(value) == 0:
        value = np.asarray(value).item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
