"""A recording's summary on one screen, as text, for a terminal and for a notebook."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from gfnn_jax.data.recording_summary import Column, RecordingSummary

_WIDTH = 110
_LARGEST_ERROR = 0.02  # error of a loss per period, above which its absence is not reported
_MOST = 12  # columns, faults or runs that are shown
_NOTEBOOK = '<pre style="line-height:normal;white-space:pre">{code}</pre>'


def screen(summary: RecordingSummary) -> Group:
    """Screen that `gfnn look` prints."""
    lines = [Text(line) for line in (_first(summary), _times(summary), _motion(summary)) if line]
    found = [_fault(fault) for fault in summary.faults[:_MOST]]
    more = len(summary.faults) - _MOST
    found += [Text(f"and {more} more")] if more > 0 else []
    return Group(*lines, _columns(summary), *found, Text(f"next: {summary.command}"))


def as_text(summary: RecordingSummary) -> str:
    """The screen without colours."""
    # A notebook would take it for its own display.
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None, force_jupyter=False)
    console.print(screen(summary), soft_wrap=False)
    return console.file.getvalue().rstrip()  # pyright: ignore[reportAttributeAccessIssue]


def as_html(summary: RecordingSummary) -> str:
    """The screen for a notebook."""
    console = Console(file=io.StringIO(), width=_WIDTH, record=True, force_jupyter=False)
    console.print(screen(summary))
    return console.export_html(inline_styles=True, code_format=_NOTEBOOK)


def _first(summary: RecordingSummary) -> str:
    counts = [count for count, _, _ in summary.runs.values()]
    spans = [end - begin for _, begin, end in summary.runs.values()]
    names = ", ".join(list(summary.runs)[:_MOST]) + (", …" if len(counts) > _MOST else "")
    runs = f"{len(counts)} run{'s' * (len(counts) > 1)}"
    of = f"{sum(counts)} samples in {sum(spans):.4g} s"
    each = f" ({min(counts)} to {max(counts)} samples each: {names})" if len(counts) > 1 else ""
    return f"{summary.source}: {runs}, {of}{each}"


def _times(summary: RecordingSummary) -> str:
    low, usual, high = summary.steps
    even = high - low < 1e-3 * usual
    steps = f"{usual:.6g} s" if even else f"{usual:.6g} s, {low:.4g} to {high:.4g}"
    holes = summary.gaps
    if not holes:
        return f"steps: {steps}; no gaps"
    run, begin, end = max(holes, key=lambda hole: hole[2] - hole[1])
    longest = f"the longest {end - begin:.3g} s at {begin:.5g} s"
    return f"steps: {steps}; {len(holes)} gaps, {longest}" + f" of run {run}" * (
        len(summary.runs) > 1
    )


def _motion(summary: RecordingSummary) -> str:
    if summary.period is None:
        return ""
    per = summary.period / summary.dt_median
    parts = [f"motion: mean period {summary.period:.4g} s, {per:.3g} samples"]
    if summary.coarsest and summary.coarsest > 1.5 * summary.dt_median:
        parts.append(f"steps of {summary.coarsest:.3g} s would suffice")
    return "; ".join([*parts, _loss(summary)])


def _loss(summary: RecordingSummary) -> str:
    loss = summary.loss
    if loss is None:
        return "friction: not estimated, for the samples allow no balance of energy"
    beside = " beside what the inputs supply" if summary.driven else ""
    size = f"{100 * abs(loss.per_period):.2g} ± {100 * loss.error:.1g} % of the energy per period"
    if not loss.significant and loss.error > _LARGEST_ERROR:
        return f"friction{beside} not determined ({size})"
    if not loss.significant:
        return f"no friction found{beside} ({size})"
    if loss.per_period < 0:
        return f"a gain of {size}{beside}: a drive is missing (--inputs)"
    kind = f"; {loss.kind} friction fits best" if loss.kind else ""
    return f"friction takes {size}{beside}{kind}"


def _columns(summary: RecordingSummary) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for head in ("column", "role", "from", "to", "unit", "resolution", "noise σ", "Hz", "remarks"):
        table.add_column(head, justify="right" if head in ("from", "to", "noise σ") else "left")
    for column in summary.columns[: 2 * _MOST]:
        table.add_row(
            column.name,
            column.role,
            f"{column.low:.4g}",
            f"{column.high:.4g}",
            column.unit,
            _short(column.resolution),
            _short(column.sigma),
            " ".join(f"{f:.3g}" for f in column.frequencies),
            _remarks(column),
            style="dim" if column.role == "ignored" else None,
        )
    return table


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _remarks(column: Column) -> str:
    parts = ["angle"] if column.angle else []
    if column.sigma is not None and not column.white:
        parts.append("coloured noise")
    if column.sigma and column.resolution and column.resolution > 0.25 * column.sigma:
        parts.append("quantised")
    if column.derivative_of is not None and column.factor is not None:
        late = f", lag {1e3 * column.lag:.2g} ms" if column.lag is not None else ""
        parts.append(f"{column.factor:.3g} × d{column.derivative_of}/dt{late}")
    if column.missing:
        parts.append(f"{column.missing} missing")
    if column.outliers:
        parts.append(f"{column.outliers} outlier{'s' * (column.outliers > 1)}")
    if column.stuck:
        parts.append(f"{column.stuck} stuck")
    return ", ".join(parts)


def _fault(fault) -> Text:
    text = Text(
        f"wrong ({fault.kind}): " if fault.wrong else "note: ",
        style="bold red" if fault.wrong else "yellow",
    )
    return text.append(str(fault), style="not bold default")
