"""report.json of a law that was learned from a recording; the keys are those of `evaluate.report`,
null where they do not apply, with the law's own beside them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.evaluate.report import device
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.maps.saved import versions


def assemble(fit: Fit, *, source: str | None = None, seed: int = 0) -> dict[str, Any]:
    """The report of a fit of the recording ``source``."""
    map_, sensors = fit.map, fit.map.sensors
    assert sensors is not None
    assert fit.lagrangian is not None
    assert fit.friction is not None
    num_parameters = sum(t.std > 0 for t in (*fit.lagrangian.terms, *fit.friction.terms))
    return {
        "verdict": fit.verdict,
        "scene": None,
        "dt": float(np.asarray(map_.dt)),
        "seed": seed,
        "dtype": str(map_.scale.dtype),
        "device": device(),
        "versions": versions(),
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
            "validation_rms": None,
            "validation_relative": None,
            "tolerance": None,
            "tolerance_met": None,
            "ended": fit.ended,
            "messages": list(fit.messages),
            "steps": list(fit.steps),
            "alike": list(fit.alike),
            "next_motions": [motion._asdict() for motion in fit.next_motions],
        },
        "hamiltonian": _law(fit.hamiltonian),
        "lagrangian": {**_law(fit.lagrangian), "text": str(fit.lagrangian)},
        "friction": {
            **_law(fit.friction),
            "text": str(fit.friction),
            "kinds": list(fit.which_friction.kinds),
            "odds": dict(fit.which_friction.odds),
            "limits": dict(fit.which_friction.limits),
        },
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
        "parameters": {}
        if map_.parameters is None
        else {
            name: {"low": low, "high": high}
            for name, low, high in zip(
                map_.parameters.names,
                np.asarray(map_.parameters.low).tolist(),
                np.asarray(map_.parameters.high).tolist(),
                strict=True,
            )
        },
        "zeros": {name: {"zero": z, "std": s} for name, (z, s) in fit.zeros.items()},
        "observe": fit.observe,
        "sensors": {name: {"value": c, "std": s} for name, (c, s) in fit.sensors.items()},
        "noise": {n: {"sigma": s, "residual": fit.residual[n]} for n, s in fit.noise.items()},
        "units": fit.units,
        "wander": None if sensors.wander is None else dataclasses.asdict(sensors.wander),
        "velocities": {name: one._asdict() for name, one in fit.velocities.items()},
        "whiteness": {
            name: {
                "white": of.white,
                "lags": of.lags.tolist(),
                "autocorrelation": of.autocorrelation.tolist(),
                "bound": of.bound,
                "inputs": {u: one._asdict() for u, one in of.inputs.items()},
                "fit_percent": of.fit_percent,
            }
            for name, of in fit.whiteness.items()
        },
        "gauge": fit.gauge,
        "energy": fit.energy,
        "horizon": [h._asdict() for h in fit.horizon],
        "map": {
            "multiplier": map_.multiplier(),
            "symplecticity_defect": None,
            "chart_determinant_min": None,
            "newton_iterations_max": None,
        },
        "rollout": None,
        "candidates": [],
    }


def _law(expression: Any) -> dict[str, Any]:
    return {
        "formula": expression.formula,
        "terms": [term._asdict() for term in expression.terms],
    }
