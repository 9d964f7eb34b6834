"""The summary of a recording: what its samples tell before anything is fitted; on one screen."""

import dataclasses
import html
import io
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from gfnn_jax.data.faults import PROPOSED, WRONG, Fault
from gfnn_jax.data.proposals import findings, mistakes
from gfnn_jax.data.recording import Recording
from gfnn_jax.data.roles import ROLES
from gfnn_jax.data.traits import Traits, of_rows, traits
from gfnn_jax.errors import InputError, as_typed, said
from gfnn_jax.signals import energy
from gfnn_jax.signals.steps import dominant_frequencies, gaps
from gfnn_jax.storage.outputs import finite

_SEEN = ("events", "accelerations")  # what a sensor shows, more exactly than its role
_OF_FITS = ("structure", "states", "mass")
_NOTEBOOK = '<pre style="line-height:normal;white-space:pre">{code}</pre>'


class _Shown:
    """Sizes of the screen, and what is worth a line."""

    width: int = 110  # characters
    most: int = 12  # columns (twice as many), faults or runs
    unknown_loss: float = 0.02  # standard error per period, above which no absence is reported
    related: float = 0.8  # of a column's variance that a derivative explains
    window: int = 12  # samples that tell a polynomial of degree 5 about as well as all of them


@dataclasses.dataclass(frozen=True)
class Column:
    """One column, in the file's unit.

    role: positions, velocities, accelerations, momenta, inputs, events, parameters, sensors or
    ignored. sigma: of the noise, ``white`` whether neighbouring samples have independent noise;
    None where it is not told. resolution: the smallest step between values. derivative_of: the
    column whose derivative it is, times ``factor``, ``lag`` seconds late. frequencies: in Hz, the
    strongest first.
    """

    name: str
    role: str
    unit: str
    low: float
    high: float
    resolution: float | None
    sigma: float | None
    white: bool
    angle: bool
    derivative_of: str | None
    factor: float | None
    lag: float | None
    frequencies: tuple[float, ...]
    missing: int
    outliers: int
    stuck: int


@dataclasses.dataclass(frozen=True)
class RecordingSummary:
    """Contents of a recording. Prints as one screen, in a notebook too.

    runs: name -> (number of samples, begin, end in s). steps: (shortest, median, longest without
    gaps) in s. gaps: (run, begin, end in s). period: of the motion, in s. coarsest: step in s that
    would tell the motion as well. loss: of energy per period. faults: the wrong ones first.
    options: keywords of `gfnn_jax.read` (or of a fit) that were given, that mend what is wrong and
    that are proposed. command: to type next, with these.
    """

    source: str
    runs: Mapping[str, tuple[int, float, float]]
    steps: tuple[float, float, float]
    gaps: tuple[tuple[str, float, float], ...]
    columns: tuple[Column, ...]
    period: float | None
    coarsest: float | None
    loss: energy.Loss | None
    driven: bool
    faults: tuple[Fault, ...]
    options: Mapping[str, Any]
    command: str
    clock: str = "s"

    @property
    def dt_median(self) -> float:
        """The median time between samples, in s."""
        return self.steps[1]

    def as_json(self) -> dict[str, Any]:
        """The figures as plain data: runs, dt_median, gaps, columns, loss_per_period, command, and
        what else the screen shows."""
        loss = self.loss
        plain = {
            "source": self.source,
            "runs": list(self.runs),
            "samples": {run: count for run, (count, _, _) in self.runs.items()},
            "dt_median": self.dt_median,
            "dt_range": [self.steps[0], self.steps[2]],
            "gaps": [{"run": run, "begin": a, "end": b} for run, a, b in self.gaps],
            "columns": {
                column.name: {key: of for key, of in vars(column).items() if key != "name"}
                for column in self.columns
            },
            "period": self.period,
            "dt_resolved": self.coarsest,
            "loss_per_period": None if loss is None else loss.per_period,
            "loss_std": None if loss is None else loss.error,
            "friction": None if loss is None or not loss.significant else (loss.kind or "seen"),
            "faults": [
                {"kind": f.kind, "message": f.message, "remedy": f.remedy, "wrong": f.wrong}
                for f in self.faults
            ],
            "options": dict(self.options),
            "command": self.command,
        }
        return finite(plain)

    @property
    def read_as(self) -> str:
        """Python that reads the data with the options that were given and are proposed."""
        known = {n: value for n, value in self.options.items() if n not in _OF_FITS}
        if "states" in self.options:
            known["positions"] = self.options["states"]
        words = [f"{name}={_as_code(value)}" for name, value in known.items()]
        files = self.source.split(", ")
        if self.source == "the table":
            return f"gfnn.Recording({', '.join(['table', *words])})"
        return f"gfnn.read({', '.join([repr(files[0] if len(files) == 1 else files), *words])})"

    @property
    def call(self) -> str:
        """Python that fits the data as `command` does."""
        of_fit = {n: self.options[n] for n in ("structure", "mass") if n in self.options}
        words = [f"{name}={_as_code(value)}" for name, value in of_fit.items()]
        return f"gfnn.fit({', '.join([self.read_as, *words])})"

    def __rich__(self) -> Group:
        told = filter(None, (_samples(self), _times(self), _moving(self)))
        found = [_fault(fault) for fault in self.faults[: _Shown.most]]
        more = len(self.faults) - _Shown.most
        found += [Text(f"and {more} more")] if more > 0 else []
        return Group(*(Text(said(line)) for line in told), _columns(self), *found)

    def _printed(self) -> Console:
        # A notebook would take it for its own display.
        console = Console(file=io.StringIO(), width=_Shown.width, record=True, force_jupyter=False)
        console.print(self)
        return console

    @property
    def next(self) -> str:
        """Words before the command, which is refused where no option mends what is wrong."""
        wrong = [fault.options for fault in self.faults if fault.wrong]
        return "when that is mended" if wrong and not any(wrong) else "next"

    def __str__(self) -> str:
        return f"{self._printed().export_text().rstrip()}\n{self.next}: {self.call}"

    def _repr_html_(self) -> str:
        screen = self._printed().export_html(inline_styles=True, code_format=_NOTEBOOK)
        return f"{screen}<pre>{self.next}: {html.escape(self.call)}</pre>"


def summarise(
    recording: Recording, options: Mapping[str, Any] | None = None, proposals: Sequence[Fault] = ()
) -> RecordingSummary:
    """The summary of a recording, in seconds for a million samples.

    options: those that it was read with, for the command to type. proposals: further ones.
    """
    known = traits(recording)
    found = (*proposals, *findings(known))
    of_runs = zip(recording.runs, known.times, strict=True)
    counts = {run: (len(t), float(t[0]), float(t[-1])) for run, t in of_runs}
    times = of_rows(known.times, known.seen)
    holes = gaps(times)
    steps = np.concatenate([np.diff(t) for t in times])
    longest = min((b - a for _, a, b in holes), default=np.inf)
    between = steps[steps < longest] if len(steps) else np.array([np.nan])
    doubts = (f.options["degrees"] for f in found if f.wrong and f.kind == "degrees")
    doubted = frozenset(name for names in doubts for name in names)
    period, loss = _motion(known, doubted)
    typed = _options(found, options or {})
    files = " ".join(shlex.quote(path) for path in recording.source.split(", "))
    windows = [known.noise[name].size for name in recording.positions]
    coarsest = known.step * max(min(windows) // _Shown.window, 1) if windows else None
    lengths = float(between.min()), known.step, float(between.max())
    pauses = tuple((recording.runs[r], a, b) for r, a, b in holes)
    columns = tuple(_column(known, name, doubted) for name in known.columns)
    motion = period, coarsest, loss, bool(recording.inputs)
    advice = found, typed, f"gfnn fit {files}{as_typed(typed)} --out model"
    read = recording.source, counts, lengths, pauses, columns
    return RecordingSummary(*read, *motion, *advice, recording.clock)


def refuse_mistakes(recording: Recording, despite: Sequence[str] = ()) -> None:
    """Raises InputError, a line with what mends it, where the samples show a mistake that makes a
    fit meaningless; kinds of `Fault` in ``despite`` are let pass. Raises InputError for a kind
    that is none."""
    unknown = [kind for kind in despite if kind not in WRONG]
    if unknown:
        raise InputError(f"--despite: expected some of {', '.join(WRONG)}, got {unknown[0]!r}")
    wrong = [f for f in mistakes(traits(recording)) if f.wrong and f.kind not in despite]
    if wrong:
        more = f" gfnn look shows {len(wrong) - 1} more." if len(wrong) > 1 else ""
        kind = shlex.quote(wrong[0].kind)
        raise InputError(f"{recording.source}: {wrong[0]}. To fit anyway: --despite {kind}.{more}")


def _motion(known: Traits, doubted: frozenset[str]) -> tuple[float | None, energy.Loss | None]:
    """(period in s, loss of energy) of the positions; doubted: those that may be in degrees."""
    recording, local = known.recording, known.local
    if local is None or not recording.positions:
        return None, None
    places = [known.moving.index(name) for name in recording.positions]
    of, names = local.slopes, ("values", "slopes", "curvatures")
    fits = dataclasses.replace(of, **{name: getattr(of, name)[places] for name in names})
    if not np.isfinite(fits.slopes).all(axis=0).any() or not np.any(np.nanstd(fits.slopes, axis=1)):
        return None, None
    middle = known.sound[fits.rows[:, fits.rows.shape[1] // 2]]
    inputs = np.array([known.columns[name][middle] for name in recording.inputs])
    period = energy.mean_period(fits, len(recording.runs))
    if period is None:  # longer than the record: no balance over periods
        return None, None
    angles = [name in recording.angles and name not in doubted for name in recording.positions]
    inputs = inputs.reshape(len(recording.inputs), len(middle))
    stretch = min(period, 0.6 * float(np.median([np.ptp(t) for t in known.times])))
    return period, energy.loss(fits, angles, inputs, stretch)


def _column(known: Traits, name: str, doubted: frozenset[str]) -> Column:
    recording, values = known.recording, known.columns[name]
    factor = recording.factors[name]
    role = next((r for r in (*_SEEN, *ROLES) if name in getattr(recording, r)), "ignored")
    noise = known.noise.get(name)
    of, relation = _derivative_of(known, name)
    resolution = known.resolution[name]
    have = np.isfinite(values).any()
    given = recording.std.get(name)
    sigma = given if given is not None else noise.sigma if noise else None
    moves = have and np.nanmin(values) < np.nanmax(values)
    sigma = sigma if moves else None
    turns = name in {*recording.angles} - doubted and np.ptp(known.range(name)) > 2 * np.pi
    shown = np.sin(values) if turns else values  # whose spectrum tells frequencies
    wrong = known.wrong.get(name, ())
    stuck = [sum(len(w.rows) for w in wrong if w.kind == kind) for kind in ("outliers", "stuck")]
    return Column(
        name,
        role,
        "rad or deg?" if name in doubted else recording.unit(name),
        float(np.nanmin(values)) / factor if have else np.nan,
        float(np.nanmax(values)) / factor if have else np.nan,
        None if resolution is None else resolution / factor,
        None if sigma is None else sigma / factor,
        noise is None or noise.white,
        name in recording.angles,
        of,
        None if relation is None else relation.factor,
        None if relation is None else relation.lag,
        tuple(dominant_frequencies(known.times, shown)) if noise and moves else (),
        int(np.sum(~np.isfinite(values))),
        *stuck,
    )


def _derivative_of(known: Traits, name: str):
    """(column, relation) of which this one is the derivative; (None, None) if of none."""
    recording = known.recording
    if name in recording.positions:
        return None, None
    related = [(of, known.relation(of, name)) for of in recording.positions]
    good = [(of, r) for of, r in related if r is not None and r.explained > _Shown.related]
    return max(good, key=lambda pair: pair[1].explained, default=(None, None))


def _options(found: tuple[Fault, ...], given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that were given, those that mend what is wrong, and those that are proposed."""
    typed = dict(given)
    for fault in (f for f in found if f.kind in (*WRONG, *PROPOSED)):
        if {"coordinates", "states"} & set(fault.options):  # in place of what columns show
            typed = {name: value for name, value in typed.items() if name not in ROLES}
        for option, value in fault.options.items():
            before = () if option == "positions" else typed.get(option, ())
            joined = isinstance(value, tuple) and isinstance(before, tuple) and option != "angles"
            typed[option] = tuple(dict.fromkeys([*before, *value])) if joined else value
    return typed


def _as_code(value: Any) -> str:
    return repr(list(value) if isinstance(value, tuple) else value)


# The screen.


def _samples(summary: RecordingSummary) -> str:
    counts = [count for count, _, _ in summary.runs.values()]
    spans = [end - begin for _, begin, end in summary.runs.values()]
    names = ", ".join([*summary.runs][: _Shown.most]) + ", …" * (len(counts) > _Shown.most)
    runs = f"{len(counts)} run{'s' * (len(counts) > 1)}"
    of = f"{sum(counts)} samples in {sum(spans):.4g} {summary.clock}"
    each = f" ({min(counts)} to {max(counts)} samples each: {names})" if len(counts) > 1 else ""
    return f"{summary.source}: {runs}, {of}{each}"


def _times(summary: RecordingSummary) -> str:
    low, usual, high = summary.steps
    even = high - low < 1e-3 * usual
    unit = summary.clock
    steps = f"{usual:.6g} {unit}" if even else f"{usual:.6g} {unit}, {low:.4g} to {high:.4g}"
    holes = summary.gaps
    if not holes:
        return f"steps: {steps}; no gaps"
    run, begin, end = max(holes, key=lambda hole: hole[2] - hole[1])
    longest = f"the longest {end - begin:.3g} {unit} at {begin:.5g} {unit}"
    count = f"{len(holes)} gap{'s' * (len(holes) > 1)}"
    return f"steps: {steps}; {count}, {longest}" + f" of run {run}" * (len(summary.runs) > 1)


def _moving(summary: RecordingSummary) -> str:
    if summary.period is None:
        moves = any(c.role == "positions" for c in summary.columns)
        return "motion: its period is longer than the runs show" if moves else ""
    per = summary.period / summary.dt_median
    unit = summary.clock
    parts = [f"motion: mean period {summary.period:.4g} {unit}, {per:.3g} samples"]
    if summary.coarsest and summary.coarsest > 1.5 * summary.dt_median:
        parts.append(f"steps of {summary.coarsest:.3g} {unit} would suffice")
    return "; ".join([*parts, _loss(summary)])


def _loss(summary: RecordingSummary) -> str:
    loss = summary.loss
    if loss is None:
        return "friction: not estimated, for the samples allow no balance of energy"
    beside = " beside what the inputs supply" if summary.driven else ""
    size = f"{100 * abs(loss.per_period):.2g} ± {100 * loss.error:.1g} % of the energy per period"
    if not loss.significant and loss.error > _Shown.unknown_loss:
        return f"friction{beside} not determined ({size})"
    if not loss.significant:
        return f"no friction found{beside} ({size})"
    if loss.per_period < 0:
        if summary.driven:
            return f"a gain of {size}{beside}: a force acts that no column shows"
        return f"a gain of {size}: name what drives it (--inputs), if a column shows it"
    kind = f"; {loss.kind} friction fits best" if loss.kind else ""
    return f"friction takes {size}{beside}{kind}"


def _columns(summary: RecordingSummary) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for head in ("column", "role", "from", "to", "unit", "resolution", "noise σ", "Hz", "remarks"):
        table.add_column(head, justify="right" if head in ("from", "to", "noise σ") else "left")
    for column in summary.columns[: 2 * _Shown.most]:
        table.add_row(
            column.name,
            column.role,
            f"{column.low:.4g}",
            f"{column.high:.4g}",
            column.unit,
            _digits(column.resolution),
            _digits(column.sigma),
            " ".join(f"{f:.3g}" for f in column.frequencies),
            _remarks(column),
            style="dim" if column.role == "ignored" else None,
        )
    return table


def _digits(value: float | None) -> str:
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


def _fault(fault: Fault) -> Text:
    head, style = (f"wrong ({fault.kind}): ", "bold red") if fault.wrong else ("note: ", "yellow")
    return Text(head, style=style).append(said(str(fault)), style="not bold default")
