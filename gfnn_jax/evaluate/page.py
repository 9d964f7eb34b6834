"""Report of a fit as one HTML page, which needs no network and prints on A4.

Formulas are MathML, figures are SVG inside the page: browsers show both without a script.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.evaluate import figures
from gfnn_jax.evaluate import figures_of_recordings as of_recordings
from gfnn_jax.evaluate.figures import Figure
from gfnn_jax.evaluate.figures_style import as_svg
from gfnn_jax.evaluate.forecasts import Forecasts, forecasts_of
from gfnn_jax.evaluate.physics import Physics, physics
from gfnn_jax.evaluate.report import PAGE, REPORT, About, device, to_json
from gfnn_jax.evaluate.simulation import simulation
from gfnn_jax.exports.symbolic import as_mathml, defines
from gfnn_jax.families.text import in_letters, measured
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.learn.fitted import Choice, Fit, candidate_cells
from gfnn_jax.maps.saved import versions
from gfnn_jax.models.lagrangians.friction_choice import odds_text
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
from gfnn_jax.storage.outputs import atomic_write

_MEANING = {
    "identified": "The data determine this law: no other one that was tried explains them as well.",
    "one of several": "The law explains the data, and the data leave open which of several it is.",
    "partly": "The law explains a part of the motion. Forecasts hold within the bands that were "
    "calibrated on held-out data; the coefficients are not those of a complete law.",
    "not fitted": "The data were not fitted as they are.",
    "no law": "No law that was tried follows the motion.",
    "not mechanical": "The motion is not that of a mechanical system.",
    "map": "No law of physics was found or requested. The step is exactly symplectic all the same.",
}


class Section(NamedTuple):
    """One part of the page: title, paragraphs, formulas (MathML), a table with its heads, figures
    (SVG) with captions, and the script of a simulation."""

    title: str
    lines: Sequence[str] = ()
    formulas: Sequence[tuple[str, str]] = ()
    heads: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    figures: Sequence[tuple[str, str]] = ()
    script: str | None = None

    @property
    def empty(self) -> bool:
        return not any(self._replace(title="", heads=()))


def page(fit: Fit, *, about: About = About(), forecasts: Forecasts | None = None) -> str:  # noqa: B008
    """The page of a fit, as text. forecasts: of its held-out part."""
    found, forecasts = fit.found, forecasts or _of_held_out(fit)
    if isinstance(found, LearnedLaw):
        sections = list(_of_law(fit, found, forecasts, about.notes))
    elif isinstance(found, Choice):
        sections = list(_of_choice(fit, found))
        if fit.held_out is not None:
            sections.insert(1, _forecasts(fit, [], [], forecasts))
    else:
        raise ValueError("expected a fit, or the folder of one: this one holds a map alone")
    sections.append(_made(getattr(found, "seconds", float("nan")), about.command))
    return _rendered(_source(fit), fit.verdict or "not stored", sections)


def _rendered(title: str, verdict: str, sections: Sequence[Section]) -> str:
    kind, _, reason = verdict.partition(": ")
    template = files("gfnn_jax.evaluate").joinpath("page.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        title=title,
        verdict=kind,
        reason=reason,
        meaning=_MEANING.get(kind, ""),
        sections=[section for section in sections if not section.empty],
    )


def figure(fit: Fit) -> Figure | None:
    """Figure of a law against its recording, or of the candidates of a map."""
    if isinstance(fit.found, LearnedLaw):
        return of_recordings.law_figure(fit.found, fit.seen)
    return figures.candidates_figure(fit)


def summary(fit: Fit) -> str:
    """The verdict, the law and its physical quantities, as a notebook shows them."""
    verdict, found = f"<p><b>{escape(fit.verdict or repr(fit))}</b></p>", fit.found
    if isinstance(found, LearnedLaw):
        formulas = (("L", found.lagrangian), ("R", found.friction))
        lines = [f"{defines(name)} {formula.mathml()}<br>" for name, formula in formulas]
        lines += [f"{escape(str(one))}<br>" for one in physics(found).quantities]
        return verdict + "".join(lines)
    return verdict + f"<pre>{escape(fit.formula or repr(fit))}</pre>"


def write_page(fit: Fit, path: str | os.PathLike[str], **options: Any) -> None:
    """Write the page, whole or not at all. options: of `page`."""
    atomic_write(path, page(fit, **options))


def _of_held_out(fit: Fit) -> Forecasts | None:
    """Forecasts of the held-out part; None without one, or where it is too short."""
    with contextlib.suppress(InputError):
        return None if fit.held_out is None else forecasts_of(fit, fit.held_out)


def write_reports(
    fit: Fit,
    folder: Path,
    about: About,
    *,
    result: dict[str, Any] | None = None,
    forecasts: Forecasts | None = None,
) -> None:
    """Write the report as page and as JSON into a folder, which is made where there is none.
    result: the report that a job has made. forecasts: of the held-out part."""
    forecasts, result = forecasts or _of_held_out(fit), result or fit.report()
    if forecasts is not None:
        result = {**result, "forecasts": {"begin": fit.learned_to, **forecasts.report}}
    atomic_write(folder / REPORT, to_json(result))
    write_page(fit, folder / PAGE, about=about, forecasts=forecasts)


def write_refusal(recording: Recording, error: Exception, folder: Path, about: About) -> None:
    """Write the page of a recording that gave no law into a folder: why, what it holds, what to do;
    and as JSON the verdict, ``error``, and the report of the law that was refused, where there is
    one."""
    cause = error if isinstance(error, FitError) else error.__cause__
    of_fit = cause if isinstance(cause, FitError) else None
    verdict = of_fit.verdict if of_fit and of_fit.verdict else "not fitted"
    refused = of_fit.fit.report() if of_fit and of_fit.fit is not None else {"data": {}}
    result = {**refused, "verdict": verdict, "error": str(error)}
    result["data"] = {**refused["data"], "source": recording.source}
    summary = recording.summary()
    drawn = _svg(of_recordings.recording_figure(recording, summary), "The recording.")
    lines = [*about.notes, *recording.notes, *map(str, summary.faults)]
    sections = [
        Section("Why", lines=[str(error)]),
        Section("The data", lines=lines, figures=[drawn]),
        Section("To do next", lines=[summary.command]),
        _made(float("nan"), about.command),
    ]
    atomic_write(folder / PAGE, _rendered(_title(recording), verdict, sections))
    atomic_write(folder / REPORT, to_json(result))


def _source(fit: Fit) -> str:
    if fit.data is not None:
        return _title(fit.data)
    scene = getattr(fit.found, "scene", None)
    return scene.name if scene is not None else "pairs of states"


def _title(recording: Recording) -> str:
    return ", ".join(Path(one).name for one in recording.source.split(", "))


# Of a recording.


def _of_law(
    fit: Fit, law: LearnedLaw, forecasts: Forecasts | None, notes: Sequence[str]
) -> Iterator[Section]:
    formulas = [("Lagrangian", f"{defines('L')} {law.lagrangian.mathml()}")]
    friction = f"{defines('R')} {law.friction.mathml()}"
    formulas.append(("Rayleigh's dissipation function", friction))
    formulas += [("Equation of motion", equation.mathml()) for equation in law.equations]
    yield Section("Law", lines=[law.units_line, f"Scale of L: {law.gauge}."], formulas=formulas)
    yield _physics(law, physics(law))
    yield _forecasts(fit, _coming(fit, law), law.horizon_lines, forecasts)
    data = fit.data
    if data is not None:  # the longest run after what was learned from, or its last third
        own = data.slice(run=max(data.runs, key=lambda name: np.ptp(data.times(name))))
        begin = of_recordings.begin_of(own, fit.learned_to)
        yield Section("Simulation", script=simulation(law, own, begin))
    if law.traces and data is not None:
        caption = "Measured minus law along the arcs of the fit: against time, the channel, and its"
        drawn = _svg(of_recordings.residuals_figure(law, data), f"{caption} rate of change.")
        lines = [f"{name}: residuals {one.text}." for name, one in law.whiteness.items()]
        yield Section("Residuals", lines=lines, figures=[drawn])
    yield Section("Not identified", lines=list(_not_identified(law)))
    heads = ("alternative", "odds of this law against it", "")
    yield Section("Rivals", heads=heads, rows=list(_rivals(law)))
    rows = [(motion.start_text, motion.tells) for motion in law.next_motions]
    heads = ("release from rest at", "what it tells")
    yield Section("What to record next", heads=heads, rows=rows)
    yield Section("The data", lines=[*notes, *_faults(fit, law)])


def _physics(law: LearnedLaw, known: Physics) -> Section:
    drawn = []
    if known.swings is not None and known.swings.vary:
        assert law.map.sensors is not None
        name = law.map.sensors.positions[0]
        unit = "rad" if name in law.map.sensors.angles else law.units.get(name, "")
        label = f"{name} [{unit}]" if unit else name
        caption = "Free swings about rest, by the law: two standard errors are shaded."
        drawn = [_svg(of_recordings.swings_figure(known.swings, label), caption)]
    rows = [(one.name, one.shown, one.unit, one.about) for one in known.quantities]
    heads = ("quantity", "value", "unit", "")
    return Section("Physical quantities", heads=heads, rows=rows, figures=drawn)


def _coming(fit: Fit, law: LearnedLaw) -> list[tuple[str, str]]:
    """Figure of the forecast from the end of what was learned from."""
    if fit.data is None:
        return []
    caption = "Forecast from one state at the dashed line on, and what was measured. Two standard"
    drawn = of_recordings.coming_figure(law, fit.data, fit.learned_to)
    return [_svg(drawn, f"{caption} deviations are shaded.")]


def _forecasts(
    fit: Fit, drawn: Sequence[tuple[str, str]], lines: Sequence[str], found: Forecasts | None
) -> Section:
    """Forecasts of the held-out part, behind other figures, with their errors before other
    lines."""
    if found is None or fit.held_out is None:
        return Section("Forecasts", lines=lines, figures=drawn)
    begun = "from a measured state" if fit.map.sensors is None else "from the 20 samples before"
    caption = f"Three forecasts of what no fit has seen, each {begun}."
    units = {name: fit.held_out.unit(name) for name in found.median}
    share = f"{100 * found.within:.0f} % of what was measured lies within two standard deviations"
    heads = ("median error", *(f"after {s:.3g} s" for s in found.ahead))
    rows = []
    for name, errors in found.median.items():
        rows.append((name, *(f"{e:.3g} {units[name]}".rstrip() for e in errors)))
    lines = [f"{share} (95 % expected).", *lines]
    drawn = [*drawn, _svg(of_recordings.forecasts_figure(found, fit.held_out), caption)]
    return Section("Forecasts", lines=lines, heads=heads, rows=rows, figures=drawn)


def _not_identified(law: LearnedLaw) -> Iterator[str]:
    yield from (f"The record does not distinguish: {in_letters(pair)}." for pair in law.alike)
    for term, limit in law.which_friction.limits.items():
        unseen = f"No friction of the form {in_letters(term)} is seen"
        yield f"{unseen}: its coefficient in R is below {limit:.2g} (2 σ)."
    if law.delay is not None and not np.isfinite(law.delay[1]):
        yield "The delay of the inputs is not determined."


def _rivals(law: LearnedLaw) -> Iterator[tuple[str, str, str]]:
    for name, odds in sorted(law.which_friction.odds.items(), key=lambda pair: pair[1])[:8]:
        note = "as likely" if odds < EVIDENCE.decided else ""
        yield f"friction {name.replace('+', ' + ')}", odds_text(odds), note
    for one in law.rivals:
        yield in_letters(one.formula), odds_text(one.odds), "as likely" * one.leaves_open
    for rule, cost in law.input_rules.items():
        yield f"inputs between samples: {rule}", "", f"held-out cost {cost:.4g} × that of this law"


def _faults(fit: Fit, law: LearnedLaw) -> Iterator[str]:
    yield f"{law.num_samples:,} samples."
    for name, sigma in law.noise.items():
        unit = law.units.get(name, "")
        shown = f"{name}: noise σ = {sigma:.3g} {unit}".rstrip()
        yield f"{shown}, RMS residual {law.residual[name]:.3g} {unit}".rstrip() + "."
    if fit.data is not None:
        yield from fit.data.notes
        yield from map(str, fit.data.summary().faults)
        if fit.data.ignored:
            yield f"Columns that were not used: {', '.join(fit.data.ignored)}."
    yield from law.messages


# Of pairs.


def _of_choice(fit: Fit, found: Choice) -> Iterator[Section]:
    law = found.law
    if law is not None and law.formula:
        with_formula = "Lagrangian" not in law.formula
        shown = as_mathml(law.formula) if with_formula else f"<mtext>{escape(law.formula)}</mtext>"
        formulas = [("Hamiltonian", f"{defines('H')} <math><mrow>{shown}</mrow></math>")]
        rows = [(in_letters(t.term), measured(t.coefficient, t.std)) for t in law.terms]
        heads, lines = ("term", "coefficient"), [*fit.bracket_lines, *law.notes]
        yield Section("Law", formulas=formulas, lines=lines, heads=heads, rows=rows)
    lines = [f"{found.line}.", f"Time step {float(np.asarray(fit.map.dt)):g}."]
    lines += [f"The search ended: {found.ended}.", *filter(None, [found.stated_by])]
    lines += [str(found.positions)] if found.positions is not None else []
    lines += map(str, found.partial_laws if not found.met else ())
    yield Section("The map", lines=lines)
    heads, rows = candidate_cells(found)
    yield Section("Candidates", heads=heads, rows=rows)
    null = law.null_terms if law is not None else ()
    lines = [f"The pairs do not distinguish {', '.join(null)}."] if null else []
    yield Section("Not identified", lines=lines)
    rows = [(r.formula, odds_text(r.odds)) for r in law.rivals] if law is not None else []
    yield Section("Rivals", heads=("alternative", "odds of this law against it"), rows=rows)
    symmetries = (f"Symmetry of the pairs: {s}." for s in found.symmetries)
    lines = [f"{found.num_pairs:,} pairs.", *symmetries]
    yield Section("The data", lines=[*lines, *found.messages])


def _made(seconds: float, command: str) -> Section:
    fitted = f", {seconds:.1f} s of fitting" if np.isfinite(seconds) else ""
    packages = ", ".join(f"{n} {v}" for n, v in versions().items() if v)
    made = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {device()}{fitted}."
    typed = [f"Command: {command}"] if command else []
    return Section("How this was made", lines=[*typed, made, packages + "."])


def _svg(figure: Figure, caption: str) -> tuple[str, str]:
    return as_svg(figure, caption), caption
