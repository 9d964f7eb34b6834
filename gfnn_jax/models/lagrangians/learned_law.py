"""Law that was learned from a recording: the law in words and numbers, and its map."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.roles import symbols as code_names
from gfnn_jax.exports import symbolic
from gfnn_jax.exports.symbolic import Equation, Formula, equations_of_motion
from gfnn_jax.families.lagrangian import Lagrangian, Terms, row_about
from gfnn_jax.families.text import Term, measured
from gfnn_jax.fitting.evidence import EVIDENCE, Rival
from gfnn_jax.maps.laws import law_of_map
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.lagrangians.calibration import Horizon
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.friction_choice import WhichFriction
from gfnn_jax.models.lagrangians.input_rules import RULES
from gfnn_jax.models.lagrangians.residuals import Trace, Whiteness
from gfnn_jax.models.lagrangians.text import Names, of_systems, terms_of
from gfnn_jax.models.lagrangians.velocities import Velocity

ONLY_TOGETHER = "only together"  # end of a line about coefficients that are identified as a sum
_SHOWN = 3  # pairs of nearly collinear coefficients that are listed


def _time(seconds: float) -> str:
    """A horizon in words."""
    return f"for {seconds:.3g} s" if np.isfinite(seconds) else "for more than eight periods"


def _of(value: float, unit: str) -> str:
    """A number with its unit, where that is known."""
    return f"{value:.3g} {unit}".rstrip()


class NextMotion(NamedTuple):
    """A motion to record: where to let go, at rest, the interval of its readings, s, and by how
    much that makes the standard errors of terms smaller, the most improved first. units: of the
    coordinates, "" where not known. apart: standard deviations of its readings together between the
    law and its nearest rival. drive: an input that is switched meanwhile, its two values, the first
    one first, and the period, s."""

    start: dict[str, float]
    interval: float
    gains: dict[str, float]
    units: dict[str, str]
    apart: float = 0.0
    drive: tuple[str, float, float, float] | None = None

    @property
    def start_text(self) -> str:
        """The start, and the input that drives it, as text."""
        at = ", ".join(f"{name} = {_of(q, self.units[name])}" for name, q in self.start.items())
        at += f", read every {self.interval:.3g} s"
        if self.drive is None:
            return at
        name, first, second, period = self.drive
        return (
            f"{at}, and drive {name} at {first:.3g} for {period / 4:.3g} s, then in turn at "
            f"{second:.3g} and {first:.3g} for {period / 2:.3g} s each"
        )

    @property
    def tells(self) -> str:
        """Line about what its readings tell."""
        if self.apart:
            return (
                f"its readings together put {self.apart:.2g} standard deviations between the law "
                "and its nearest rival"
            )
        best = ", ".join(f"of {t} {min(g, 1000):.3g}×" for t, g in [*self.gains.items()][:4])
        return f"standard errors shrink: {best}"

    def __str__(self) -> str:
        return f"release from rest at {self.start_text}: {self.tells}"


@dataclasses.dataclass(frozen=True, eq=False)
class LearnedLaw:
    """A law that was learned from a recording.

    map: its flow, which estimates and forecasts. lagrangian: L, and friction: Rayleigh's R, by the
    names of columns, with standard errors. which_friction: its kinds, with what odds, and limits of
    those that were not seen. gains: input -> force on each position, with its standard error.
    delay: how much later than measured inputs act, in seconds, with its standard error (NaN where
    the record does not tell it); None without inputs. input_rules: other rules between samples of
    the inputs -> their cost of held-out arcs over that of the one taken. hamiltonian: H in words,
    its terms as of L; None where some coordinates drive others, which do not act back on them.
    zeros: angle -> (where it is zero, standard error), already inside the formula. observe: column
    -> what its sensor shows, where that is not the coordinate; sensors: the parameters in it,
    fitted, with standard errors. noise: column -> σ of its samples; residual: of the fit's arcs,
    both in the file's unit. units: column or coordinate ->
    unit, "" where not known. velocities: columns of these against the law of the positions, and
    whether they were used. whiteness: of the residuals, column by column; traces: the arcs that
    were fitted. gauge: what fixes the scale of L. alike: coefficients that the record cannot tell
    apart. next_motions: those that would tell the most, the best first. horizon: for how long a
    forecast can be trusted. energy: stored, lost, supplied per second, means over the record.
    messages: warnings. steps: what the search did, line by line.
    symbols: of coordinates and of their speeds in formulas.
    num_samples, seconds (of the processor). ended: why the search ended. flaws: reasons why the law
    is not all of the motion; nature: what the record is then (`nature`). rival: a law of first
    order that follows the record as well, "" where there is none.
    """

    map: SymplecticMap
    lagrangian: Formula
    friction: Formula
    which_friction: WhichFriction
    gains: dict[str, dict[str, tuple[float, float]]]
    delay: tuple[float, float] | None
    input_rules: dict[str, float]
    hamiltonian: Hamiltonian | None
    zeros: dict[str, tuple[float, float]]
    observe: dict[str, str]
    sensors: dict[str, tuple[float, float]]
    noise: dict[str, float]
    residual: dict[str, float]
    units: dict[str, str]
    velocities: dict[str, Velocity]
    whiteness: dict[str, Whiteness]
    traces: tuple[Trace, ...]
    gauge: str
    alike: tuple[str, ...]
    next_motions: tuple[NextMotion, ...]
    horizon: tuple[Horizon, ...]
    energy: dict[str, Any]
    messages: tuple[str, ...]
    steps: tuple[str, ...]
    num_samples: int
    seconds: float
    ended: str
    flaws: tuple[str, ...] = ()
    symbols: tuple[tuple[str, ...], ...] = ((), ())
    nature: str = ""
    rival: str = ""
    rivals: tuple[Rival, ...] = ()

    @property
    def equations(self) -> tuple[Equation, ...]:
        """Equations of motion, one for each coordinate, with standard errors."""
        sensors = self.map.sensors
        assert sensors is not None
        codes = code_names(self.gains)
        forces = [
            [Term(code, *self.gains[name][q]) for name, code in zip(self.gains, codes, strict=True)]
            for q in sensors.positions
        ]
        terms = law_of_map(self.map).terms
        acts = terms.acting(np.ones((terms.count, terms.dim))).T
        lagrangians = [
            Formula(tuple(t for t, one in zip(self.lagrangian.terms, row, strict=True) if one))
            for row in acts
        ]
        return equations_of_motion(lagrangians, self.friction, forces, *self.symbols)

    @property
    def leaders(self) -> tuple[int, ...]:
        """Coordinates, by their places, that drive the others and are not moved by them."""
        return law_of_map(self.map).terms.leaders

    @property
    def verdict(self) -> str:
        """Verdict of the recording: identified, one of several, or partly, with the reason."""
        if self.flaws:
            return f"partly: {'; '.join((*self.flaws, *filter(None, [self.nature])))}"
        if self.rival:
            return f"one of several: {self.rival}"
        if rivals := [one.terms for one in self.rivals if one.leaves_open]:
            told = ", or one ".join(rivals[:2])
            return f"one of several: a law {told} fits the record as well"
        together = [names for names in self.alike if names.endswith(ONLY_TOGETHER)]
        if together:
            return f"one of several: {'; '.join(together)}"
        open_ = [
            t.term for t in self.lagrangian.terms if abs(t.coefficient) < EVIDENCE.chance * t.std
        ]
        if open_:
            return f"one of several: none of {', '.join(open_)} is significant beside the others"
        return "identified"

    def _repr_latex_(self) -> str:
        return f"$L = {self.lagrangian.latex()}$, $R = {self.friction.latex()}$"

    @property
    def line(self) -> str:
        """L and R."""
        return f"L = {self.lagrangian}; R = {self.friction}"

    @property
    def formula(self) -> str:
        """L as Python writes it."""
        return self.lagrangian.formula

    @property
    def table(self) -> str:
        """The law and how far its forecasts hold, a line each, and under them the details."""
        details = [f"  {line}" for line in self.detail_lines]
        return "\n".join([*self.result_lines, *self.horizon_lines, "details:", *details])

    @property
    def result_lines(self) -> list[str]:
        """L, Rayleigh's R, and the units of their variables, a line each."""
        return [f"L = {self.lagrangian}", f"R = {self.friction}", self.units_line]

    @property
    def detail_lines(self) -> list[str]:
        """Details: choices beside the law, and how well it is known, a line each."""
        lines = [f"friction: {self.which_friction}", f"scale of L: {self.gauge}"]
        sensors = self.map.sensors
        if sensors is not None and np.any(law_of_map(self.map).friction.dry):
            lines.append(
                "dry friction: bodies slide or stick in fits, forecasts and rollouts; under jit, "
                f"grad and vmap the map smooths it over speeds of {sensors.creep:.2g}"
            )
        lines += [f"nearly collinear: {pair}" for pair in self.alike[:_SHOWN]]
        lines += [
            f"{name}: zero at {measured(zero, std)} {self.units[name]}".rstrip()
            for name, (zero, std) in self.zeros.items()
        ]
        lines += [f"{column} shows {formula}" for column, formula in self.observe.items()]
        lines += [f"{name} = {measured(value, std)}" for name, (value, std) in self.sensors.items()]
        lines += [f"velocity {name}: {one.text}" for name, one in self.velocities.items()]
        for name, forces in self.gains.items():
            per_coordinate = ", ".join(f"{q} {g:.6g} ± {s:.2g}" for q, (g, s) in forces.items())
            unit = self.units[name]
            lines.append(f"gain of {name}, force per {unit or 'unit'} of it: {per_coordinate}")
        lines += [self._inputs_line] if self.delay is not None else []
        if energy := self.energy:
            lines.append(
                f"energy per second, in the unit of L: stored {energy['stored']:.3g} = supplied "
                f"{sum(energy['supplied'].values()):.3g} - lost {sum(energy['lost'].values()):.3g}"
                f" + unexplained {energy['closure']:.1g}"
            )
        wander = sensors.wander if sensors is not None else None
        if sensors is not None and sensors.level:
            lines.append(
                f"friction is stronger or weaker by {sensors.level:.2g} of itself from time to "
                "time: forecasts take its level from the samples before them"
            )
        for name, sigma in self.noise.items():
            zero = (
                ""
                if wander is None
                else (
                    f" on a zero that wanders by {_of(wander.size * sigma, self.units[name])} over "
                    f"{wander.time:.3g} s"
                    if np.isfinite(wander.time)
                    else " on a zero that differs from run to run by "
                    f"{_of(wander.size * sigma, self.units[name])}"
                )
            )
            lines.append(
                f"{name}: noise σ {_of(sigma, self.units[name])}{zero}, RMS residual "
                f"{_of(self.residual[name], self.units[name])}; residuals "
                f"{self.whiteness[name].text}"
            )
        lines += [f"to record next: {motion}" for motion in self.next_motions[:1]]
        return lines

    @property
    def horizon_lines(self) -> list[str]:
        """Times for which forecasts hold, as held-out forecasts showed, a line each; of fractions
        that none of them passed the smallest."""
        told = [(fraction, seconds) for fraction, seconds, _ in self.horizon if seconds > 0]
        never = [fraction for fraction, seconds in told if np.isinf(seconds)]
        lines = [
            f"95 % of forecasts err by less than {100 * fraction:.0f} % of the spread "
            f"{_time(seconds)}"
            for fraction, seconds in told
            if np.isfinite(seconds) or fraction == min(never)
        ]
        return lines or ["no forecast errs by less than the noise does"] * bool(self.horizon)

    @property
    def units_line(self) -> str:
        """Units of the variables in L and R."""
        assert self.map.sensors is not None
        units = self.units | dict.fromkeys(self.map.sensors.angles, "rad")
        named = [f"{name} in {units[name]}" for name in self.map.sensors.positions if units[name]]
        return f"in L and R: {', '.join([*named, 'times in s'])}"

    @property
    def _inputs_line(self) -> str:
        """Describe how inputs act."""
        assert self.map.sensors is not None
        assert self.delay is not None
        delay, error = self.delay
        if not np.isfinite(error):
            when = "; the record does not determine their delay"
        elif delay == 0:
            when = f", no delay seen (standard error {error:.2g} s)"
        else:
            when = f", acting {measured(delay, error)} s later"
        others = [f"{RULES[rule]} {cost:.4g}" for rule, cost in self.input_rules.items()]
        chosen = f"; cost of held-out arcs, this rule 1: {', '.join(others)}" if others else ""
        return f"inputs: {RULES[self.map.sensors.hold]}{when}{chosen}"

    def __str__(self) -> str:
        return self.line

    def __repr__(self) -> str:
        return f"LearnedLaw({self.line})"


@dataclasses.dataclass(frozen=True)
class Hamiltonian:
    """H = ½ (p − a)ᵀ M(q)⁻¹ (p − a) + V(q) of a law: the entries of M, "M12: factor", and of a,
    "a2: factor", and the terms of V, as fitted."""

    terms: tuple[Term, ...]

    @property
    def formula(self) -> str:
        """V as code, and the entries of M and a."""
        entries = ", ".join(f"{t} {c:.6g}" for t, c, _ in self.terms if ": " in t)
        p = "(p - a)" if self._has_field else "p"
        return f"{p}·M⁻¹{p}/2 + {self._potential.formula}, {entries}"

    def sympy(self) -> Any:
        """H in the positions' names and p1, …, pd, as a sympy expression."""
        entries: dict[tuple[int, ...], list[str]] = {}
        for name, coefficient, _ in self.terms:
            place, colon, factor = name.partition(": ")
            if colon:
                axes = tuple(int(digit) - 1 for digit in place[1:])
                entries.setdefault(axes, []).append(f"{coefficient!r}*({factor})")
        dim = 1 + max(j for *_, j in entries)
        return symbolic.hamiltonian(entries, self._potential.formula, dim)

    def latex(self) -> str:
        """H in LaTeX's notation, M and a as matrices of their own."""
        p = "(p - a)" if self._has_field else "p"
        return rf"\tfrac12 {p}^\top M(q)^{{-1}} {p} + {self._potential.latex()}"

    @property
    def _has_field(self) -> bool:
        return any(t.term.startswith("a") and ": " in t.term for t in self.terms)

    @property
    def _potential(self) -> Formula:
        return Formula(tuple(t for t in self.terms if ": " not in t.term))


def hamiltonian_of(law: Lagrangian, lagrangian: Formula, names: Names) -> Hamiltonian:
    """The entries of M and a, those of L with two factors v and with one, and V = −(the terms of L
    without v)."""
    terms = law.terms
    coefficients = np.array([t.coefficient for t in lagrangian.terms])
    std = np.array([t.std for t in lagrangian.terms])
    still = dataclasses.replace(terms, speeds=np.zeros_like(terms.speeds))
    found = terms_of(still, coefficients, std, names)
    if law.powers is not None:
        found = of_systems(found, law.powers[: terms.count], names.parameters)
    factors, listed = found.terms, []
    for row, (factor, c, error) in zip(terms.rows(), factors, strict=True):
        axes = [i for i, k in enumerate(row[0]) for _ in range(k)]
        if axes:
            double = 2.0 if axes[1:] == axes[:1] else 1.0
            name = f"{'aM'[len(axes) - 1]}{''.join(str(i + 1) for i in axes)}: {factor}"
            listed.append(Term(name, double * c, double * error))
        else:
            listed.append(Term(factor, -c, error))
    return Hamiltonian(tuple(listed))


def in_columns(fit: LawFit) -> tuple[Lagrangian, np.ndarray]:
    """The law in the measured coordinates (zeros of angles inside the phases of its terms, those of
    lengths inside their shapes), and the covariance of (θ, ρ, G row by row), and of γ where there
    is uniform friction."""
    form = fit.form
    law = form.lagrangian(fit.p[: form.count])
    terms = law.terms
    moved = dataclasses.replace(terms, phases=terms.phases - terms.modes @ fit.zeros)
    centre = {}
    for k, i in enumerate(fit.structure.zeros, form.count):
        if i not in fit.problem.angles:  # to a hundredth of its standard error
            error = np.fmin(np.fmax(fit.linearised.errors[k], 1e-13), 1.0)
            centre[i] = round(float(fit.p[k]), 3 - int(np.log10(error)))
    if centre:
        rows = [row_about(row, centre) for row in moved.rows()]
        moved = Terms.of(rows, terms.dim, terms.leaders)
    rest = form.count - form.basis.shape[1]
    turn = np.zeros((terms.count + rest, len(fit.p)))
    turn[: terms.count, : form.basis.shape[1]] = form.basis
    others = np.arange(form.basis.shape[1], form.count)
    if law.friction.count < form.friction.count:  # γ, the last of the friction, goes behind G
        last = form.friction.count - 1
        others = np.append(np.delete(others, last), others[last])
    turn[np.arange(terms.count, terms.count + rest), others] = 1.0
    covariance = turn @ fit.linearised.covariance @ turn.T
    return dataclasses.replace(law, terms=moved), covariance


def scaled(law: Lagrangian, covariance: np.ndarray, factor: float) -> tuple[Lagrangian, np.ndarray]:
    """The law with L, R and G times a factor, which moves nothing: the scale of a known mass."""
    law = dataclasses.replace(
        law,
        coefficients=factor * law.coefficients,
        losses=factor * law.losses,
        gains=factor * law.gains,
    )
    by = np.full(len(covariance), factor)
    by[law.terms.count + law.friction.count + law.gains.size :] = 1.0  # γ is a rate
    return law, by[:, None] * covariance * by
