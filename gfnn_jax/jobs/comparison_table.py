"""Table of a comparison: a row per method."""

from __future__ import annotations

from typing import Any


def table(compared: dict[str, Any]):
    """Make a rich table of a comparison's report, a row per method."""
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
