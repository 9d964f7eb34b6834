"""Print what a command has found: tables, errors, the law, where the map may be trusted."""

import math
import sys
from collections.abc import Callable
from functools import partial
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
        error = f"one-step error {fit['validation_relative']:.1e} of the spread"
        return f"best partial law: H of {len(law['terms'])} terms, {error} (report.json)"
    return f"{'' if chosen else 'found, and costlier per step than the map: '}H = {law['formula']}"


def print_summary(ran: Any, out: Path) -> None:
    if ran is None:
        print(f"{out}: already holds the result of this job")
        return
    from gfnn_jax.learn.fitted import candidates_table

    print(f"verdict: {ran.fit.verdict}")
    print_table(candidates_table(ran.fit))
    report = ran.report
    fit, defect = report["fit"], report["map"]["symplecticity_defect"]
    print(ran.fit.line)
    print(f"symplecticity defect {'not computed (no time)' if defect is None else f'{defect:.1e}'}")
    if report["hamiltonian"] is not None:
        print(law_line(report))
        for note in report["hamiltonian"]["notes"]:
            print(note)
        for loss in report["hamiltonian"]["friction"]:
            print(f"friction {loss['term']}: {loss['coefficient']:.6g} ± {loss['std']:.1g}")
    if report["bracket"] is not None:
        for line in (*ran.fit.bracket_lines, *ran.fit.messages):
            print(line)
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
        errors = ", ".join(f"{_number(e)} at step {n}" for n, e in rollout["error"].items())
        print(f"mean position error {errors}")
        if rollout["growth_exponent"] is not None:
            print(f"growth of the error: as steps to the power {rollout['growth_exponent']:.2f}")
        counts = rollout["status_counts"].items()
        print("rollouts: " + ", ".join(f"{n} {name}" for name, n in counts if n))
    print(_holds(ran.fit))
    print(f"written to {out}")


def _number(value: float | None, form: str = ".1e") -> str:
    """A number of a report; a dash where it has none, as after a rollout that does not end."""
    return "–" if value is None else format(value, form)


def _holds(fit: Any) -> str:
    """Describe where the map may be trusted, in one sentence."""
    parts = ["valid where the data are: gfnn predict names the trajectories that leave them"]
    outside = fit.chosen.outside
    if outside is not None and math.isfinite(outside):
        parts.append(f"a fit without the outermost 5 % of the states errs there by {outside:.1e}")
    if fit.chosen.learns == "hamiltonian":
        parts.append("other time steps: gfnn predict --dt")
    return "; ".join(parts)


def print_table(table: Any) -> None:
    from rich.console import Console

    wide = Console() if sys.stdout.isatty() else Console(width=132)
    wide.print(table)


def print_record(ran: Any, out: Path) -> None:
    """Print a law, its physical quantities, and its forecasts of the last third of the
    recording."""
    fit = ran.learned.fit
    ahead = partial(_print_ahead, ran.forecasts, fit.held_out)
    if fit.bracket is None:
        print_law(fit, ahead)
    else:
        print_summary(ran.learned, out / "model")
        ahead()
    print(f"written to {out}; the report is {out / 'report.html'}")


def _print_ahead(found: Any, held_out: Any) -> None:
    """Print how forecasts compare with the part of a recording that no fit has seen."""
    if found is None:
        return
    ahead = ", ".join(f"{seconds:.3g}" for seconds in found.ahead)
    for name, errors in found.median.items():
        sizes = ", ".join(f"{error:.3g}" for error in errors)
        unit = f" {held_out.unit(name)}".rstrip()
        median = f"median error of {name} {sizes}{unit} after {ahead} s"
        print(f"forecasts of the last third, which no fit has seen: {median}")
    print(f"{100 * found.within:.0f} % of it lies within two standard deviations (95 % expected)")


def print_law(fit: Any, ahead: Callable[[], None] | None = None) -> None:
    """Print the verdict, a law, its physical quantities and how far forecasts hold; what ``ahead``
    prints; and the details."""
    from gfnn_jax.evaluate.physics import physics

    print(f"verdict: {fit.verdict}")
    law = fit.found
    quantities = [str(q) for q in physics(law).quantities if not q.name.startswith("energy")]
    for line in (*law.result_lines, *quantities, *law.horizon_lines):
        print(line)
    if ahead is not None:
        ahead()
    print("details:")
    for line in law.detail_lines:
        print(f"  {line}")


def print_forecasts(found: Any, out: Path) -> None:
    """Print how far forecasts reach, and how they compare with what was measured."""
    runs = "1 run" if len(found.of_runs) == 1 else f"{len(found.of_runs)} runs"
    last = max(one.times[-1] for one in found.of_runs.values())
    print(f"{out}: forecasts of {runs}, up to t = {last:g} {found.time_unit}")
    for line in (line for one in found.of_runs.values() for line in one.outside):
        print(f"note: {line}")
    compared = found.compared
    if compared is None:
        return
    for name, (rms, median, within) in compared.columns.items():
        unit = f" {compared.units[name]}".rstrip()
        print(
            f"{name}: RMS error {rms:.4g}{unit}, median of its size {median:.4g}{unit}; "
            f"{within:.0%} of {compared.num_samples} samples within two standard deviations "
            "(95 % expected)"
        )


def print_predicted(predicted: Any, asked: Any, out: Path) -> None:
    """Print the number of trajectories by status, and where their bands are wide."""
    num_lanes, back = len(predicted.status), " backwards" if asked.num_steps < 0 else ""
    steps = f"{abs(asked.num_steps)} steps{back}, {predicted.seconds:.1f} s"
    print(f"{out}: {num_lanes} trajectories of {steps}")
    _print_status(predicted.status, predicted.left_at)
    if predicted.horizon is not None:
        passed = predicted.horizon[predicted.horizon >= 0]
        first = f", the first at step {passed.min()}" if passed.size else ""
        where = f"{passed.size} of {num_lanes} trajectories{first}"
        print(f"the band of the position (2 σ) exceeds {asked.horizon:g} in {where}")


def _print_status(status, left_at) -> None:
    """Print the number of lanes by status, and the steps at which lanes left the domain."""
    from gfnn_jax.evaluate.report import status_counts

    counts = status_counts(status).items()
    print(", ".join(f"{n} {name}{_MEANS.get(name, '')}" for name, n in counts if n))
    left = [lane for lane in range(len(left_at)) if left_at[lane] >= 0]
    shown = ", ".join(f"{lane} at step {left_at[lane]}" for lane in left[:10])
    if left:
        more = f", and {len(left) - 10} more" if len(left) > 10 else ""
        print(f"left the data's domain: trajectory {shown}{more}")


def comparison_table(compared: dict[str, Any]):
    """Make a rich table of a comparison's report, a row per method."""
    from rich.table import Table  # loaded when first used

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
            _number(fit["validation_rms"]),
            _number(rolled["error"]["100"]),
            _number(rolled["error"]["1000"]),
            _number(rolled["growth_exponent"], ".2f"),
            _number(m["map"]["symplecticity_defect"]),
            *([", ".join(_number(v, ".2g") for v in m["kl"].values())] if chaotic else []),
        )
    return shown
