"""``gfnn.fit``: the cheapest exactly symplectic map that is as accurate as asked for.

check → prepare → diagnose → search → choose and conclude. A candidate is chart × family × size. Its
cost is counted (floating-point operations per predicted step), so that one seed always chooses the
same map; the measured time stands beside it.
"""

from __future__ import annotations

import dataclasses
import io
import time
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np

from gfnn_jax.budget import COMPILE, MAX_SECONDS, ROWS, Budget
from gfnn_jax.candidates.assemble import block_of, stepped
from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.data.recording import Recording
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import identified
from gfnn_jax.diagnosis.clean import clean
from gfnn_jax.diagnosis.damping import LearnedDamping
from gfnn_jax.diagnosis.local_jacobians import ChartJudgement, looked_for_errors
from gfnn_jax.diagnosis.symmetries import SymmetryOfPairs, symmetries_of_pairs
from gfnn_jax.errors import FitError, FitWarning, InputError, OutOfTime
from gfnn_jax.fitting import row_blocks
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.all_rows import with_test_rows
from gfnn_jax.learn.check import wrapped
from gfnn_jax.learn.choose import Chosen, choose
from gfnn_jax.learn.conclude import conclude
from gfnn_jax.learn.diagnose import diagnose_request
from gfnn_jax.learn.gross_errors import without_gross_errors
from gfnn_jax.learn.noisy_sweeps import without_bias
from gfnn_jax.learn.options import FitOptions, with_options
from gfnn_jax.learn.paid_for import paid_for
from gfnn_jax.learn.positions import OfPositions, learn_positions
from gfnn_jax.learn.posterior import with_posterior, work_of_posterior
from gfnn_jax.learn.propose import structures_to_try
from gfnn_jax.learn.request import checked
from gfnn_jax.learn.searches import Searched, searched
from gfnn_jax.learn.stated import stated
from gfnn_jax.maps.domain import Ranges
from gfnn_jax.maps.sharded import local_devices
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.hamiltonians.formula import PartialLaw
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.lagrangians.recordings import fit_recording
from gfnn_jax.models.maps_of_laws.draw import NUM_PAIRS, drawn
from gfnn_jax.phase_space import Pairs, require_x64, sizes
from gfnn_jax.scenes.scene import Scene

_OF_DERIVATIVE = 3.0  # times a step's: the time that compiling its derivative takes
_JUDGED = 200  # states at which the chosen map's defect and determinant are taken


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted map and how it was chosen.

    map: the chosen map. candidates: every candidate met on the way, by rising operations.
    asked: the tolerance, and ``met`` whether the chosen map's upper 95 % bound is within
    it. num_pairs: that trained and judged. judgements: chart -> its determinant over the data.
    data_defect: how far the pairs' local Jacobians are from symplectic (median). base_map: whether
    one was factored out. noise: (2d,) standard deviation of each coordinate's noise that the
    residuals suggest where larger models stopped helping, else None. messages: the warnings,
    and the friction that the map has. ended: why the search ended. seconds: of it all;
    compile_seconds: of compiling, in them.
    test_states: (n, 2d) held-out states, test_args their parameters. model_determinant_min: the
    chosen chart's determinant there, where it is closest to 0; NaN for a flow, which has no chart.
    hamiltonian: H, where one was found, whether its flow was chosen or not. pairs: that were taken.
    scene: as given. damping: of a map that loses area, by how much of it in a step. positions: of a
    map that was learned from positions alone, what its S is like; num_pairs are then triples.
    symmetries: that the pairs show, whatever was learned.
    partial_laws: where no H meets the tolerance, the laws of physics that come closest.
    stated_by: the pairs by which the chosen candidate's error was measured, and whether the map was
    fitted to them afterwards.
    validation_pairs, test_pairs: that chose, and that stated the error; None where the pairs were
    too few for these. operations: of the search, as counted; as ``max_operations`` they give this
    map again, whatever the clock. budget: what is left of it. tells_defect: whether there is
    time in it to compile the derivative of a step.
    """

    map: SymplecticMap
    candidates: tuple[Candidate, ...]
    asked: Tolerance
    num_pairs: int
    validation_pairs: Pairs
    judgements: dict[str, ChartJudgement]
    data_defect: float
    base_map: bool
    noise: np.ndarray | None
    messages: tuple[str, ...]
    ended: str
    seconds: float
    compile_seconds: float
    test_states: np.ndarray
    model_determinant_min: float
    test_args: dict[str, np.ndarray] | None = None
    hamiltonian: LearnedHamiltonian | None = None
    pairs: Pairs | None = None
    scene: Scene | None = None
    damping: LearnedDamping | None = None
    positions: OfPositions | None = None
    symmetries: tuple[SymmetryOfPairs, ...] = ()
    partial_laws: tuple[PartialLaw, ...] = ()
    stated_by: str = ""
    test_pairs: Pairs | None = None
    operations: int = 0
    budget: Budget = dataclasses.field(default_factory=Budget, repr=False)
    tells_defect: bool = True

    def __repr__(self) -> str:
        """One line: the chosen map, its error and the tolerance."""
        best = self.chosen
        error = best.validation_relative if self.asked.relative else best.validation_rms
        return (
            f"Fit({best.chart} {best.label}, {best.num_parameters:,} parameters: one-step error "
            f"{error:.2e} (≤ {best.validation_bound:.2e} at 95 %), tolerance {self.tolerance:g} "
            f"{'met' if self.met else 'not met'}, {self.num_pairs:,} pairs, {self.seconds:.1f} s)"
        )

    def accelerate(
        self, *, dt: float | None = None, region=None, tolerance: float | None = None,
        num_pairs: int = NUM_PAIRS, seed: int = 0, max_seconds: float | None = MAX_SECONDS,
        on_progress: Callable[[str], Any] = lambda message: None,
    ) -> Fit:  # fmt: skip
        """A generated map of the Hamiltonian that was learned, fitted to pairs drawn from its flow.

        dt: the time of its step; None: that of the data. region: (2, 2d), lowest and highest
        values of the states to be predicted; None: where the data were and where the flow takes
        them. tolerance: relative to the spread of the drawn states; None: as was asked for.

        Raises FitError where no Hamiltonian was learned that meets the tolerance or was chosen, or
        its flow fails in the region, InputError for a region that is none.
        """
        if self.hamiltonian is not None and self.hamiltonian.formula is None:
            raise FitError("accelerate: expected an H of terms to draw pairs from, got a network")
        if self.hamiltonian is None or self.formula is None:
            raise FitError("accelerate: expected an H within the tolerance, this fit has none")
        assert self.pairs is not None
        if self.hamiltonian.friction:
            raise FitError("accelerate: expected no friction, for a map generated by S keeps areas")
        if self.map.parameters is not None:
            raise FitError("accelerate: expected no parameters, for a map generated by S has none")
        if isinstance(self.map.domain, Ranges):
            raise FitError("accelerate: expected no structure, for a map generated by S has none")
        flow, coordinates = self.hamiltonian.flow, self.map.coordinates
        dt = float(np.asarray(self.map.dt)) if dt is None else dt
        if not (isinstance(dt, (int, float)) and 0 < dt < np.inf):
            raise FitError(f"expected a time step that is finite and above 0, got {dt!r}")
        pairs = drawn(
            flow, coordinates, self.pairs.z0, dt, region=region, num_pairs=num_pairs, seed=seed
        )
        return fit(
            pairs, self.scene, learn="map", seed=seed, max_seconds=max_seconds,
            angles=() if self.scene is not None else coordinates.angles, on_progress=on_progress,
            tolerance=self.relative_tolerance if tolerance is None else tolerance,
        )  # fmt: skip

    def settled(self) -> Fit:
        """Compute what a report and a saved model hold beside the map, as far as the budget goes:
        the posterior, which is left out of the map where it does not fit, and the defect of a step.
        Warns (FitWarning) of what is left out."""
        told, map_, tells = len(self.budget.left_out), self.map, True
        if map_.posterior is not None and not map_.posterior.known:
            work = work_of_posterior(self.chosen.num_parameters)
            try:
                with self.budget.last("the posterior, and with it bands", ROWS, work):
                    _ = map_.posterior.root
            except OutOfTime:
                map_ = dataclasses.replace(map_, posterior=None)
        try:
            seconds = _OF_DERIVATIVE * self.budget.compiling
            with self.budget.last("the symplecticity defect of a step", COMPILE, seconds):
                defect = self.symplecticity_defect
        except OutOfTime:
            tells, defect = False, float("nan")
        messages = self.budget.left_out[told:]
        for message in messages:
            warnings.warn(message, FitWarning, stacklevel=2)
        candidates = tuple(
            dataclasses.replace(c, map=map_) if c.chosen else c for c in self.candidates
        )
        found = dataclasses.replace(
            self, map=map_, candidates=candidates, messages=(*self.messages, *messages),
            tells_defect=tells, seconds=self.budget.seconds,
        )  # fmt: skip
        if tells:
            found.__dict__["symplecticity_defect"] = defect
        return found

    def sample(self, key, num: int):
        """``num`` maps drawn from the posterior of the chosen map's coefficients, as one pytree,
        each exactly symplectic: `maps.samples.Samples`. key: of ``jax.random``.

        Raises ValueError where the map has no posterior: a single network, a map of pairs that were
        drawn from a law.
        """
        return self.map.sample(key, num)

    @property
    def max_operations(self) -> int:
        """A bound on operations that gives this map again: the one that was asked for, or those
        that were done."""
        asked = self.budget.max_operations
        return self.operations if asked is None else asked

    @property
    def relative_tolerance(self) -> float:
        """The tolerance as a part of the spread, whichever way it was asked for."""
        if self.asked.relative:
            return self.asked.bound
        assert self.pairs is not None
        return self.asked.bound / float(np.max(sizes(self.pairs.z0)))

    @property
    def formula(self) -> str | None:
        """H as text that ``terms`` and sympy read, where one was found that meets the tolerance or
        was chosen; ``print(fit.hamiltonian)`` shows it as people read it."""
        law = self.hamiltonian
        if law is None or not (self.chosen.learns == "hamiltonian" or self._met_by(law.candidate)):
            return None
        return law.formula

    @property
    def tolerance(self) -> float:
        """The number that was asked for, relative or absolute."""
        return self.asked.bound

    @property
    def chosen(self) -> Candidate:
        return next(c for c in self.candidates if c.chosen)

    @property
    def met(self) -> bool:
        """Return whether the chosen candidate's validation error is within the tolerance, at 95
        %."""
        return self._met_by(self.chosen)

    def _met_by(self, candidate: Candidate) -> bool:
        return candidate.validation_bound <= self.tolerance

    @cached_property
    def symplecticity_defect(self) -> float:
        """The largest defect ‖AᵀJA − μJ‖ of the chosen map's unrolled step at the test states, by
        its multiplier μ; NaN where it has none. Compiled when it is first asked for."""
        z, args = self.test_states, self.test_args
        steps = stepped(self.map, z, args=args, timed=False)  # by the program that is compiled
        defects = self.map.defect(z, args, iterations=steps.iterations)
        return float(np.max(np.asarray(defects)))

    @property
    def table(self) -> str:
        """Every candidate by rising operations, the chosen one marked: text for ``print``."""
        from rich.console import Console  # loaded when first used

        text = io.StringIO()
        # Neither colours nor a notebook's own display: a string.
        plain = Console(width=132, file=text, force_terminal=False, force_jupyter=False)
        plain.print(candidates_table(self))
        return text.getvalue()


@with_options
def fit(
    pairs: Pairs | Recording,
    scene: Scene | None = None,
    *,
    options: FitOptions | None = None,
    clock: Callable[[], float] = time.perf_counter,
    spent: float = 0.0,
    checkpoints: Any = None,
    factors: Any = None,
    on_progress: Callable[[str], Any] = lambda message: None,
    on_candidate: Callable[[Candidate], Any] = lambda candidate: None,
    on_better: Callable[[SymplecticMap, Candidate], Any] | None = None,
    **changes: Any,
) -> Any:
    """Learn the map of these pairs: the cheapest candidate within the tolerance, else the best.

    Of a `Recording` learn its law, a Lagrangian with friction and inputs, from its positions: a
    `models.lagrangians.learned_law.LearnedLaw`; of the options ``learn`` ("auto" or "lagrangian"),
    ``friction``, ``input_hold``, ``mass`` and ``on_progress`` apply
    (`models.lagrangians.recordings`). With learn="map" learn the map of its positions instead, a
    `Fit`: see `fit_positions`. Of pairs a `Fit`.

    pairs:     states and images, (N, 2d) each, NumPy or JAX; those of a sequence in their order.
               Of different dt, S is a function of dt too, in the midpoint chart. With parameters
               (args) H is learned, or an S of state and parameters, which family="polynomial" or
               learn="map" ask for.
    scene:     lends its coordinates, features and reversor; None: plain coordinates.
    options:   a `FitOptions`, which the keywords below change; None: its defaults.
    clock:     gives the seconds that max_seconds is held against. spent: seconds of them that are
               gone already, as on reading files.
    checkpoints, factors: a ``TrainingCheckpoints`` and a ``KeptFactors``, which an interrupted fit
               has saved to and the same fit goes on from.
    on_progress, on_candidate: called with what is being done, and with every candidate.
    on_better: called with a map and its candidate whenever steps have shown one that is more
               accurate than those before, so that it can be kept should the fit be interrupted.

    Raises FitError, in one line, where the data are too few or not finite or a chart that was asked
    for is singular over them (naming the chart to use instead). Warns (FitWarning) where nothing
    meets the tolerance, where a chart is close to singular, where pairs contradict their neighbours
    (a few are left out), and where the pairs do not look symplectic; of a recording where its law
    did not converge, misses a drive, or has an input of no effect.
    """
    options = dataclasses.replace(options or FitOptions(), **changes)
    if isinstance(pairs, Recording):
        _check_of_recording(scene, options)
        if options.learn == "map":
            return fit_positions(pairs, options, clock, on_progress, on_candidate)
        law = fit_recording(
            pairs, friction=options.friction, input_hold=options.input_hold, mass=options.mass,
            terms=tuple(options.terms), loss=options.loss, on_progress=on_progress,
        )  # fmt: skip
        for message in law.messages:
            warnings.warn(message, FitWarning, stacklevel=2)
        return law
    if options.loss is not None:
        raise FitError("loss: only for the law of a recording, got pairs")
    budget = options.budget(clock, pairs.dim if isinstance(pairs, Pairs) else None, spent)
    require_x64("a fit")
    messages: list[str] = []

    def warn(new: Sequence[str]) -> None:
        messages.extend(new)
        for message in new:
            warnings.warn(message, FitWarning, stacklevel=3)

    request = checked(
        pairs, scene, options, budget=budget, checkpoints=checkpoints, factors=factors,
        say=on_progress, tell=on_candidate,
    )  # fmt: skip
    warn(request.messages)
    taken = paid_for(identified(request.pairs), budget, options.seed)
    request = dataclasses.replace(request, pairs=taken.pairs)
    on_progress(f"estimating local Jacobians from {len(taken.pairs):,} pairs")
    with row_blocks.on_devices(_devices(options.devices)):
        data, about_pairs = clean(
            taken, request.coordinates, request.structure,
            jumps=bool(wrapped(request.pairs, request.coordinates)),
        )  # fmt: skip
        warn(about_pairs)
        looked_at = len(looked_for_errors(len(request.pairs)))
        if looked_at < len(request.pairs):
            count = len(request.pairs)
            budget.leave_out(
                f"the search for outliers in {count - looked_at:,} of {count:,} pairs",
                "those that the final map misses by far are found at the end",
            )
        data = data.divided(options.seed)
        for asked, same in structures_to_try(request, data):
            request, data = asked, same
            seen = diagnose_request(request, data)
            warn(seen.messages)
            if seen.damping is not None:
                on_progress(str(seen.damping))
            found = searched(request, data, seen, on_better)
            if found.met_by_law:
                break
        seen, found, about_pairs = without_gross_errors(request, seen, found)
        warn(about_pairs)
        found = without_bias(found, request)
        data = found.data
        chosen = with_posterior(choose(found, request), found)
        on_progress("computing the error to state, by pairs that chose nothing")
        error = stated(chosen, found, budget)
        chosen, stated_by = with_test_rows(chosen, error, found, budget)
        conclusion = conclude(chosen, found, request)
        warn([*conclusion.messages, *filter(None, [error.few])])
    damping = seen.damping if chosen.candidate.learns == "map" else None
    if damping is not None:  # a fact, not a warning
        messages.append(damping.told(data.dt))
    judged = min(_JUDGED, block_of(2 * data.dim))
    some = chosen.data.pairs.take(chosen.data.validation[:judged])
    return Fit(
        map=chosen.candidate.map,
        candidates=_all_candidates(chosen, found),
        asked=request.tolerance,
        num_pairs=len(data),
        validation_pairs=data.pairs.take(data.validation),
        judgements=found.charts.judgements,
        data_defect=seen.data_defect,
        base_map=bool(chosen.data.before or chosen.data.after),
        hamiltonian=found.law,
        noise=conclusion.noise,
        messages=tuple(messages),
        ended=conclusion.ended,
        seconds=budget.seconds,
        compile_seconds=chosen.compile_seconds,
        test_states=np.asarray(some.z0),
        test_args=some.args,
        model_determinant_min=_smallest_determinant(chosen),
        pairs=data.pairs,
        scene=scene,
        damping=damping,
        symmetries=symmetries_of_pairs(found.data),
        partial_laws=() if found.met_by_law else tuple(request.partial_laws),
        stated_by=stated_by,
        test_pairs=data.pairs.take(data.test) if len(data.test) else None,
        operations=budget.operations,
        budget=budget,
    )


def _check_of_recording(scene: Scene | None, options: FitOptions) -> None:
    """Raises InputError for options of pairs alone."""
    if options.learn not in ("auto", "lagrangian", "map"):
        raise InputError(
            f"learn={options.learn!r}: a recording has no momenta; expected auto, lagrangian or map"
        )
    if scene is not None or options.base is not None:
        given = "base" if scene is None else "scene"
        raise InputError(f"{given}: only for pairs of states q, p, got a recording")
    if options.learn == "map" and options.loss is not None:
        raise InputError("loss: only for the law of a recording, got learn='map'")
    if options.learn != "map" and options.structure is not None:
        raise InputError("structure: not for the law of a recording (learn='map' has it)")


def fit_positions(
    recording: Recording, options: FitOptions, clock: Callable[[], float],
    on_progress: Callable[[str], Any], on_candidate: Callable[[Candidate], Any],
) -> Fit:  # fmt: skip
    """Learn the map behind positions alone, at even times or by turns: S(q, Q) of chart type 1.

    recording: its positions, of one run or many; an angle's values that range over more than one
    turn are a lift and trusted, others known modulo 2π. options: of which the tolerance, a
    structure of sites, the seed and the budget apply. The rest as of `fit`; errors are those of the
    next position.

    The map acts on z = (q, p), p = −h ∂S/∂q: ``map.from_positions`` and
    ``map.rollout(positions=(q, Q), …)`` start it. Positions of one place tell p but for a factor
    and a gauge, which `models.positions.discrete_lagrangian` fixes: frequencies, positions and
    stability do not depend on them, the size of p, energies and areas do.
    Raises FitError where the recording has no positions at even times, or too few.
    """
    require_x64("a fit")
    asked = Tolerance.of(options)
    budget = options.budget(clock, len(recording.positions) or None)
    found = learn_positions(
        recording, tolerance=asked, structure=options.structure, seed=options.seed,
        budget=budget,
        say=on_progress, tell=on_candidate,
    )  # fmt: skip
    for message in found.messages:
        warnings.warn(message, FitWarning, stacklevel=3)
    test = found.states.take(found.test[: min(_JUDGED, block_of(2 * found.map.dim))])
    determinant = np.asarray(found.map.determinant(test.z0))
    return Fit(
        map=found.map, candidates=found.candidates, asked=asked,
        num_pairs=found.positions.num_triples, judgements={}, data_defect=float("nan"),
        base_map=False, noise=None, messages=tuple(found.messages), ended=found.ended,
        seconds=budget.seconds, compile_seconds=found.compile_seconds,
        test_states=np.asarray(test.z0),
        model_determinant_min=float(determinant[np.argmin(np.abs(determinant))]),
        pairs=found.states, positions=found.positions, stated_by=found.stated_by,
        validation_pairs=found.states.take(found.validation),
        operations=budget.operations, budget=budget,
    )  # fmt: skip


def _devices(devices: int | str | None) -> tuple[Any, ...]:
    """JAX's devices of this process that were asked for; none where nobody asked."""
    try:
        return () if devices is None else local_devices(devices)
    except ValueError as error:
        raise FitError(str(error)) from error


def _all_candidates(chosen: Chosen, found: Searched) -> tuple[Candidate, ...]:
    """Every candidate by rising operations, the chosen one as its own steps showed it."""
    others = [
        e.candidate for e in found.found.entries
        if chosen.entry is None or e.size is not chosen.entry.size
    ]  # fmt: skip
    if found.law is not None and chosen.candidate.learns == "map":
        others.append(found.law.candidate)
    candidates = [*others, dataclasses.replace(chosen.candidate, chosen=True)]
    return tuple(sorted(candidates, key=lambda c: (c.operations, c.validation_relative)))


def _smallest_determinant(chosen: Chosen) -> float:
    """The chart's determinant over some held-out pairs, where it is closest to 0. NaN where no
    piece has a chart. NumPy."""
    map_, data = chosen.candidate.map, chosen.data
    piece = next((p for p in map_.pieces if isinstance(p, Generated)), None)
    if piece is None:
        return float("nan")
    piece = jax.tree.map(np.asarray, piece)
    rows = data.validation[:_JUDGED]
    dt, args = data.given(rows)
    piece = dataclasses.replace(piece, dt=dt) if data.own_dt is not None else piece
    determinant = piece.determinant(data.y0[rows], data.y1[rows], args)
    return float(determinant[np.argmin(np.abs(determinant))])


def candidates_table(fit: Fit):
    """The candidates of a fit as a ``rich`` table, by rising operations; the chosen one is marked.

    An error with ~ before it is an estimate: the gradient's residual, which was told as a first
    estimate, times the ratio that measured steps of the same sweep have shown, if any were. The
    others were measured by steps. Outside: the error at the outermost twentieth of the states, of a
    fit without them.
    """
    from rich.table import Table  # loaded when first used

    def number(value, form):
        return "–" if value is None else format(value, form)

    table = Table(title=f"candidates for tolerance {fit.tolerance:g} ({fit.num_pairs} pairs)")
    for head in ("", "chart", "family"):
        table.add_column(head)
    bound = "95 % bound" if fit.asked.relative else "95 % bound (absolute)"
    numbers = ("parameters", "error ÷ spread", bound, "outside", "kflop/step", "µs/step", "fit s")
    for head in numbers:
        table.add_column(head, justify="right")
    for c in fit.candidates:
        sign = "" if c.validated else "~"
        table.add_row(
            "→" if c.chosen else "", c.chart, c.label, str(c.num_parameters),
            f"{sign}{c.validation_relative:.2e}", f"{sign}{c.validation_bound:.2e}",
            number(c.outside, ".1e"), f"{c.operations / 1e3:.1f}",
            number(c.microseconds_per_step, ".2f"), f"{c.fit_seconds:.2f}",
        )  # fmt: skip
    return table
