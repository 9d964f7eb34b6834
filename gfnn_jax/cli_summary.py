"""Print what a command has found: tables, errors, the law, where the map may be trusted."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

_FEW_TERMS = 15  # of a law with noise that is shown as H
_MEANS = {
    "left the domain": " (extrapolated from there)",
    "not converged": " (NaN from there)",
    "non-finite": " (NaN from there)",
}


def law_line(report: dict[str, Any]) -> str:
    """Line about the law. One that misses the tolerance is no H, unless it has few terms and noise
    explains the miss."""
    fit, law = report["fit"], report["hamiltonian"]
    chosen = report["model"]["learns"] == "hamiltonian"
    noisy = report["data"]["noise"] is not None and len(law["terms"]) <= _FEW_TERMS
    if chosen and not fit["tolerance_met"] and not noisy:
        return (
            f"best partial law: H of {len(law['terms'])} terms, one-step error "
            f"{fit['validation_relative']:.1e} of the spread (report.json)"
        )
    return f"{'' if chosen else 'found, and costlier per step than the map: '}H = {law['formula']}"


def error_line(fit: dict[str, Any]) -> str:
    """Line about the one-step error, its bound, and the tolerance that this bound is held to."""
    unit = "of the spread" if fit["tolerance_is_relative"] else "in the data's units"
    return (
        f"one-step error {fit['validation_rms']:.2e} in the data's units, "
        f"{fit['validation_relative']:.2e} of the spread; 95 % bound "
        f"{fit['validation_bound']:.2e}, tolerance {fit['tolerance']:g} {unit}: "
        f"{'met' if fit['tolerance_met'] else 'not met'}"
    )


def print_summary(ran: Any, out: Path) -> None:
    if ran is None:
        print(f"{out}: already holds the result of this job")
        return
    from gfnn_jax.learn.fitted import candidates_table

    print_table(candidates_table(ran.fit))
    report = ran.report
    fit, defect = report["fit"], report["map"]["symplecticity_defect"]
    print(f"{report['model']['chart']} {report['model']['label']}: {error_line(fit)}")
    print(f"symplecticity defect {'not computed (no time)' if defect is None else f'{defect:.1e}'}")
    if report["hamiltonian"] is not None:
        print(law_line(report))
        for note in report["hamiltonian"]["notes"]:
            print(note)
        for loss in report["hamiltonian"]["friction"]:
            print(f"friction {loss['term']}: {loss['coefficient']:.6g} ± {loss['std']:.1g}")
    if ran.fit.damping is not None:
        print(ran.fit.damping.line(float(ran.fit.map.dt)))
    in_formula = report["hamiltonian"] is not None and report["hamiltonian"]["symmetries"]
    if ran.fit.symmetries and not in_formula:
        print(f"symmetries of the pairs: {'; '.join(map(str, ran.fit.symmetries))}")
    if not fit["tolerance_met"]:
        for law in ran.fit.partial_laws:
            print(law)
    print(f"the search ended: {fit['ended']}")
    rollout = report["rollout"]
    if rollout is not None:
        errors = ", ".join(f"{e:.1e} at step {n}" for n, e in rollout["error"].items())
        print(f"mean position error {errors}")
        if rollout["growth_exponent"] is not None:
            print(f"growth of the error: as steps to the power {rollout['growth_exponent']:.2f}")
        counts = rollout["status_counts"].items()
        print("rollouts: " + ", ".join(f"{n} {name}" for name, n in counts if n))
    print(_holds(ran.fit))
    print(f"written to {out}")


def _holds(fit: Any) -> str:
    """Describe where the map may be trusted, in one sentence."""
    parts = ["valid where the data are: gfnn predict names the trajectories that leave them"]
    outside = fit.chosen.outside
    if outside is not None and math.isfinite(outside):
        parts.append(
            f"a fit without the outermost 5 % of the states errs there by {outside:.1e} of the "
            "spread"
        )
    if fit.chosen.learns == "hamiltonian":
        parts.append("other time steps: gfnn predict --dt")
    return "; ".join(parts)


def print_table(table: Any) -> None:
    from rich.console import Console

    wide = Console() if sys.stdout.isatty() else Console(width=132)
    wide.print(table)


def print_status(status, left_at) -> None:
    """Print the number of lanes by status, and the steps at which lanes left the domain."""
    from gfnn_jax.evaluate.report import status_counts

    counts = status_counts(status).items()
    print(", ".join(f"{n} {name}{_MEANS.get(name, '')}" for name, n in counts if n))
    left = [lane for lane in range(len(left_at)) if left_at[lane] >= 0]
    shown = ", ".join(f"{lane} at step {left_at[lane]}" for lane in left[:10])
    if left:
        more = f", and {len(left) - 10} more" if len(left) > 10 else ""
        print(f"left the data's domain: trajectory {shown}{more}")
