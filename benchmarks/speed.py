"""Speed of the first answer, of motion, of predicted steps and of training; growth with the size.

    python benchmarks/speed.py                    pieces that have no result yet, then the tables
    python benchmarks/speed.py --only step --overwrite
    python benchmarks/speed.py --quick            small sizes, into runs/speed, no tables

A piece's result is one JSON file, speed-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md is made from these files alone. Times of steps are the best of several and
without compilation; those of whole processes the median of a few; ratios are of times taken in one
run.
"""

from __future__ import annotations

from collections.abc import Sequence

# Sets float64, so it comes before all of JAX.
from harness import TABLES, Numbers, between_markers, markdown, number, provenance, results
from harness import main as run_pieces

# isort: split
from speeds.growth import scaling
from speeds.motion import OLD, ROWS, motion
from speeds.start import START, start, startup
from speeds.step import STEPS, step
from speeds.training import training

TARGETS = {
    "evaluations": 3.5,
    "defect": 1e-12,
    "against_newton": 4.0,
    "training_rate": 0.6,
    "torch": {"original": 4.0, "careful": 2.0},
}


PIECES = {
    "start": start,
    "motion": motion,
    "step": step,
    "training": training,
    "startup": startup,
    "scaling": scaling,
}


# Tables


def met(value, limit, *, least: bool = False) -> str:
    """A figure beside its target."""
    if value is None or limit is None:
        return number(value)
    good, sign = (value >= limit, "≥") if least else (value <= limit, "≤")
    shown = number(value) if good or number(value) != number(limit) else f"{value:.3g}"
    return f"{shown} ({sign} {number(limit)}: {'met' if good else '**not met**'})"


def step_table(measured: Numbers) -> str:
    heads = [
        "scene",
        "map",
        "one-step RMS",
        "∇S evaluations per step",
        "defect",
        "µs per step, 1,000 lanes",
        "µs per step, one lane",
        "times as fast as Newton with fresh Jacobians",
        "times as fast as with all lanes waiting for the last",
    ]
    rows = []
    for name, m in measured.items():
        _, _, batch, single = STEPS[name]
        cells = [
            name,
            f"{m['chart']} {m['label']}",
            number(m["one_step_rms"]),
            met(m["evaluations"], TARGETS["evaluations"]),
            met(m["defect"], TARGETS["defect"]),
            met(m["microseconds_batch"], batch),
            met(m["microseconds_single"], single),
            met(m["against_newton"], TARGETS["against_newton"], least=True),
            number(m["against_waiting"]),
        ]
        rows.append(cells)
    return markdown(heads, rows)


def start_table(m: Numbers) -> str:
    """The first answer, beside the release before and the targets."""
    rows = []
    for key, (title, before, most) in START.items():
        value, cpu = m[key], m.get(f"{key}_cpu")
        if key in ("run_warm", "run_cold"):  # in times of importing the libraries
            value, cpu = value / m["libraries"], m[f"{key}_cpu"] / m["libraries_cpu"]
        rows.append([title, before, met(value, most), number(cpu)])
    seconds = ", ".join(
        f"{name} {number(m[key])} ({number(m[f'{key}_cpu'])})"
        for name, key in (
            ("libraries", "libraries"),
            ("the command warm", "run_warm"),
            ("cold", "run_cold"),
        )
    )
    return (
        markdown(["", "release before", "now", "the same in processor time"], rows)
        + f"\n\nSeconds, and processor seconds of all threads: {seconds}."
    )


def motion_table(m: Numbers) -> str:
    """Motion of laws, beside the commit before it was compiled and what was asked."""
    rows = []
    for key, (title, (unit, factor), most) in ROWS.items():
        before, now = m.get("before", {}).get(key), m["now"].get(key)
        if now is not None:
            gain = "–" if before is None else f"{number(before / now)} ×"
            before = "–" if before is None else number(factor * before)
            rows.append([f"{title}, {unit}", before, met(factor * now, most), gain])
    return markdown(["processor time", f"before (`{OLD}`)", "now", "as fast"], rows)


def beside_torch(m: Numbers) -> str:
    """The training step against PyTorch's, in words."""
    if m["torch"] is None:
        return "PyTorch was not there to compare with."
    ratios = {name: m["torch"][name] / m["microseconds"] for name in TARGETS["torch"]}
    shown = [
        f"{number(m['torch'][name])} µs, {met(r, TARGETS['torch'][name], least=True)} times as long"
        for name, r in ratios.items()
    ]
    return (
        f"PyTorch {m['torch']['version']} on as many threads ({m['torch']['threads']}): a loop in "
        f"the style of the paper's original (DataLoader, double backward, Adam) {shown[0]}; a "
        f"careful one (indexed batches, fused Adam) {shown[1]}."
    )


def several_models(m: Numbers) -> str:
    """Ensembles in words; a result of an older script has none."""
    rates = m.get("models_per_second")
    if not rates:
        return ""
    shown = ", ".join(f"{n}: {number(rate)}" for n, rate in rates.items())
    return f" Several models at once by vmap, steps of one model a second: {shown}."


def tables() -> None:
    found = results(PIECES, "speed")
    parts = []
    if "start" in found:
        parts.append("### The first answer\n\n" + start_table(found["start"]["measured"]))
    if "motion" in found:
        parts.append("### Motion of laws\n\n" + motion_table(found["motion"]["measured"]))
    if "step" in found:
        parts.append("### A predicted step\n\n" + step_table(found["step"]["measured"]))
    if "training" in found:
        m = found["training"]["measured"]
        parts.append(
            "### A training step of the paper's network (batch 200, float32)\n\n"
            f"{number(m['microseconds'])} µs, {number(m['gflops'])} GFLOP/s; plain products of its "
            f"sizes {number(m['gflops_of_products'])} GFLOP/s; ratio "
            f"{met(m['training_rate'], TARGETS['training_rate'], least=True)}. "
            + beside_torch(m)
            + several_models(m)
        )
    if "startup" in found:
        m = found["startup"]["measured"]
        rows = [[f"`{name}`", number(value)] for name, value in m.items()]
        parts.append("### The start\n\n" + markdown(["a fresh process", "seconds"], rows))
    if "scaling" in found:
        rows = [
            [
                name,
                ", ".join(number(int(size)) for size in m["size"]),
                ", ".join(map(number, m["measured"])),
                number(m["slope_of_largest"]),
            ]
            for name, m in found["scaling"]["measured"].items()
        ]
        heads = ["", "sizes", "measured", "slope of the largest three"]
        parts.append("### Growth with the size\n\n" + markdown(heads, rows))
    if found:
        parts.append(provenance(found))
        between_markers(TABLES, "speed", "\n\n".join(parts))


def main(argv: Sequence[str] | None = None) -> None:
    run_pieces(__doc__ or "", PIECES, "speed", tables, argv)


if __name__ == "__main__":
    main()
