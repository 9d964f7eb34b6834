"""``gfnn.fit``: the cheapest exactly symplectic map that is as accurate as asked for.

check → prepare → diagnose → search → assemble. A candidate is chart × family × size. Its cost is
counted (floating-point operations per predicted step), so that one seed always chooses the same
map; the measured time stands beside it.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import CARTESIAN, Coordinates, nearest_image
from gfnn_jax.errors import FitError, FitWarning
from gfnn_jax.families.terms import given_terms
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.assemble import assemble, composed, stepped, with_predictor
from gfnn_jax.learn.candidates import Candidate, Judges, Tolerance, refined_images
from gfnn_jax.learn.check import (
    check_number,
    check_request,
    coarse_tolerance,
    not_radians,
    unlike_the_scene,
)
from gfnn_jax.learn.choose_law import DEARER, law_of, preferred
from gfnn_jax.learn.clock import Clock
from gfnn_jax.learn.diagnose import (
    ChartJudgement,
    differs_between_sequences,
    outliers,
    sequences_of,
    volume_change,
)
from gfnn_jax.learn.diagnosed import diagnosed
from gfnn_jax.learn.draw import NUM_PAIRS, drawn
from gfnn_jax.learn.flows import LearnedHamiltonian, flow_of
from gfnn_jax.learn.flows import assembled as flow_assembled
from gfnn_jax.learn.held_out import first_occurrences, split_rows
from gfnn_jax.learn.law_maps import (
    better_than,
    factored_out,
    law_explains_most,
    more_pairs_would_help,
    search_around,
    search_of_law,
)
from gfnn_jax.learn.map_of_parameters import assembled as map_assembled
from gfnn_jax.learn.map_of_parameters import map_of
from gfnn_jax.learn.noise import state_noise
from gfnn_jax.learn.prepare import Prepared, prepare
from gfnn_jax.learn.search import AS_FAR, MET, Entry, Found, search
from gfnn_jax.learn.sweeps import NetworkSweep, sweeps_for
from gfnn_jax.learn.varied import as_varied, given_by, undiagnosed
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, require_x64, sizes
from gfnn_jax.scenes.scene import Scene

MAX_SECONDS = 120.0

_MOST_OUTLIERS = 0.05  # of the pairs may be left out
_CERTAIN = 5.0  # standard errors that make a change of volume certain
_JUDGED = 200  # states at which the chosen map's defect and determinant are taken
_ROUNDOFF = 1e-12  # of the data's spread: below it a stall is arithmetic, not noise
_RESIDUAL_PAIRS = 2_000  # whose residuals are looked at
_NOISE_PAIRS = 1_024  # from which the noise of the states is measured


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted map and how it was chosen.

    map: the chosen map. candidates: every candidate met on the way, by rising operations.
    asked: the tolerance, and ``met`` whether the chosen map's upper 95 % bound is within
    it. num_pairs: that trained and judged. judgements: chart -> its determinant over the data.
    data_defect: how far the pairs' local Jacobians are from symplectic (median). base_map: whether
    one was factored out. noise: (2d,) standard deviation of each coordinate's noise that the
    residuals suggest where larger models stopped helping, else None. messages: the warnings.
    ended: why the search ended. seconds: of it all; compile_seconds: of compiling, in them.
    test_states: (n, 2d) held-out states, test_args their parameters. model_determinant_min: the
    chosen chart's determinant there, where it is closest to 0; NaN for a flow, which has no chart.
    hamiltonian: H, where one was found, whether its flow was chosen or not. pairs: that were taken.
    scene: as given.
    """

    map: SymplecticMap
    candidates: tuple[Candidate, ...]
    asked: Tolerance
    num_pairs: int
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
        if self.hamiltonian is None or self.formula is None:
            raise FitError("expected a fit with a Hamiltonian that meets its tolerance, got none")
        assert self.pairs is not None
        if self.map.parameters is not None:
            raise FitError("expected a fit without parameters: a generated map has none")
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

    @property
    def relative_tolerance(self) -> float:
        """The tolerance as a part of the spread, whichever way it was asked for."""
        if self.asked.relative:
            return self.asked.bound
        assert self.pairs is not None
        return self.asked.bound / float(np.max(sizes(self.pairs.z0)))

    @property
    def formula(self) -> str | None:
        """H as text, where one was found that meets the tolerance or was chosen."""
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
        """Whether the chosen candidate's validation error is within the tolerance, at 95 %."""
        return self._met_by(self.chosen)

    def _met_by(self, candidate: Candidate) -> bool:
        return candidate.validation_bound <= self.tolerance

    @cached_property
    def symplecticity_defect(self) -> float:
        """The largest defect of the chosen map's unrolled step at the test states. Compiled when it
        is first asked for."""
        return float(np.max(np.asarray(self.map.defect(self.test_states, self.test_args))))

    @property
    def table(self) -> str:
        """Every candidate by rising operations, the chosen one marked: text for ``print``."""
        from rich.console import Console  # loaded when first used

        text = io.StringIO()
        # Neither colours nor a notebook's own display: a string.
        plain = Console(width=132, file=text, force_terminal=False, force_jupyter=False)
        plain.print(candidates_table(self))
        return text.getvalue()


def fit(
    pairs: Pairs,
    scene: Scene | None = None,
    *,
    tolerance: float = 1e-6,
    absolute_tolerance: float | None = None,
    learn: str = "auto",
    terms: Sequence[str | Callable] = (),
    base: str | Callable | None = None,
    family: str = "auto",
    chart: str = "auto",
    angles: tuple[int, ...] = (),
    seed: int = 0,
    max_seconds: float | None = MAX_SECONDS,
    max_iterations: int = 250,
    checkpoints: Any = None,
    factors: Any = None,
    on_progress: Callable[[str], Any] = lambda message: None,
    on_candidate: Callable[[Candidate], Any] = lambda candidate: None,
    on_better: Callable[[SymplecticMap, Candidate], Any] | None = None,
) -> Fit:
    """Learn the map of these pairs: the cheapest candidate within the tolerance, else the best.

    pairs:     states and images, (N, 2d) each, NumPy or JAX; those of a sequence in their order.
               Pairs of different dt, or with parameters (args), are learned as H.
    scene:     lends its coordinates, features and reversor; None: plain coordinates.
    tolerance: bound on the RMS over coordinates of the one-step error ÷ that coordinate's spread,
               at its upper 95 % bound; a pure number.
    absolute_tolerance: in its stead, on the RMS per component in the user's units.
    learn:     "map": S, whose step is an implicit equation; "hamiltonian": H, whose flow is the
               map; "auto": both, and H is taken where it meets the tolerance at no more than four
               times the cost of a step, because it holds outside the data and at any time step.
    terms:     of H that the user knows: text such as "1/sqrt(q1**2 + q2**2)", or functions of z.
    base:      a Hamiltonian that the user knows a part of the map by, as such text or a function:
               its flow is factored out, and S learns what it leaves over.
    family:    "auto", "polynomial" (Fourier in angles), "features" (the scene's), "sines", "mlp".
    chart:     "auto" or one of type1, type2, type3, midpoint.
    angles:    without a scene, the indices of z that have period 2π.
    max_seconds: for all of it; the search ends with the best map so far while there is time to
               compile its step. None: no budget.
    max_iterations: of the training of "mlp".
    checkpoints, factors: a ``TrainingCheckpoints`` and a ``KeptFactors``, which an interrupted fit
               has saved to and the same fit goes on from.
    on_progress, on_candidate: called with what is being done, and with every candidate.
    on_better: called with a map and its candidate whenever steps have shown one that is more
               accurate than those before, so that it can be kept should the fit be interrupted.

    Raises FitError, in one line, where the data are too few or not finite or a chart that was asked
    for is singular over them (naming the chart to use instead). Warns (FitWarning) where nothing
    meets the tolerance, where a chart is close to singular, where pairs contradict their neighbours
    (a few are left out), and where the pairs do not look symplectic.
    """
    clock = Clock(max_seconds, pairs.dim if isinstance(pairs, Pairs) else None)
    require_x64("a fit")
    bound = Tolerance(tolerance)
    if absolute_tolerance is not None:
        bound = Tolerance(absolute_tolerance, relative=False)
    check_request(
        pairs, scene, tolerance=bound.bound, chart=chart, learn=learn, family=family, angles=angles,
        terms=terms, base=base, seed=seed,
    )  # fmt: skip
    pairs = dataclasses.replace(
        pairs, z0=np.asarray(pairs.z0, np.float64), z1=np.asarray(pairs.z1, np.float64)
    )
    pairs, learn, new = as_varied(pairs, learn=learn, family=family, chart=chart, base=base)
    messages: list[str] = []

    def warn(new: list[str]) -> None:
        messages.extend(new)
        for message in new:
            warnings.warn(message, FitWarning, stacklevel=3)

    warn(new)
    if scene is not None and scene.features is not None and family in ("auto", "features"):
        warn(unlike_the_scene(pairs, scene))
    warn(coarse_tolerance(pairs, bound))
    coordinates = scene.coordinates if scene else Coordinates("cartesian", angles=tuple(angles))
    on_progress("looking at the map's local Jacobians")
    pairs, prepared, new = _prepared(pairs, coordinates)
    warn(new)
    plain = prepared
    if base is not None:
        known = given_terms(prepared.dim, (base,))
        flow = flow_of(known, np.ones(known.num_parameters), prepared)
        _, prepared = factored_out([flow], prepared, seed)
    if prepared.varied:
        seen = undiagnosed(prepared)
    else:
        seen = diagnosed(prepared, chart, scene.reversor if scene else None, seed)
    warn(seen.messages)
    prepared, charts = seen.prepared, seen.charts
    judges = Judges(pairs, *split_rows(pairs, seed), bound)
    better = _Better(prepared, judges, on_better) if on_better is not None else None
    wanted = learn if (family, chart, base) == ("auto", "auto", None) else "map"
    law = law_of(plain, judges, scene, wanted, terms, clock, on_progress)
    of_map = None
    lawless = law is None or law.candidate.validation_bound > bound.bound
    if prepared.args is not None and learn != "hamiltonian" and lawless:
        of_map = map_of(prepared, judges, scene, chart, law, clock, on_progress)
    if law is not None:
        if better is not None:
            better.offer(law.candidate, lambda: composed(law.flow, plain, judges))
        on_candidate(law.candidate)
    if learn == "hamiltonian" or prepared.varied:
        sweeps: list[Any] = []
    elif family == "mlp":
        sweeps = [
            NetworkSweep(prepared, charts.charts[0], judges, max_iterations, seed, checkpoints)
        ]
    else:
        sweeps = list(sweeps_for(family, charts.charts, prepared, scene, judges, factors))
    met_by_law = law is not None and law.candidate.validation_bound <= bound.bound
    dearest = law.candidate.operations if law is not None and met_by_law else np.inf
    found = search(sweeps, bound.bound, clock, on_progress, on_candidate, better, dearest)
    dearest /= DEARER  # of maps that would be chosen
    if law is not None and met_by_law and more_pairs_would_help(sweeps, found, bound, dearest):
        on_progress("drawing pairs from the flow of H")
        of_law = search_of_law(
            law, pairs, judges, scene, coordinates, dearest, clock, on_progress, on_candidate, seed
        )
        if of_law is not None:
            judges, prepared, charts, found = of_law
    elif law is not None and not met_by_law and law_explains_most(law, found, bound, clock):
        on_progress(f"learning what the flow of {law.candidate.label} leaves over")
        around = search_around(
            law, plain, judges, scene, clock, on_progress, on_candidate, better, seed
        )
        if around is not None and better_than(around.found, found, law):
            judges, prepared, charts, found = around
    if not found.ranking and law is None and of_map is None:
        raise FitError(_nothing_found(found, pairs, clock))
    if of_map is not None:
        candidate, seconds = map_assembled(of_map, prepared, judges)
        choice = candidate, None, seconds
    else:
        choice = _chosen(found, law, prepared, plain, judges, clock, on_progress)
    chosen, entry, compile_seconds = choice
    noise = None
    ended = _ended(chosen, bound) if not sweeps else found.ended
    if ended.startswith(MET) and chosen.validation_bound > bound.bound:
        ended = "the steps of a map that was to meet it do not converge from some of the states"
    unmet = chosen.validation_bound > bound.bound
    if law is not None and of_map is None and (entry is None or met_by_law or (unmet and law.fast)):
        warn(list(law.messages))
    looked_at = entry or (found.ranking[0] if found.ranking else None)
    diagnosis: list[str] = []
    if chosen.validation_bound > bound.bound and chosen.validation_relative > _ROUNDOFF:
        stalled = any(  # the chosen sweep, or another that has come as far
            (e.candidate.chart, e.candidate.family) in found.stalled
            and e.candidate.validation_relative <= AS_FAR * chosen.validation_relative
            for e in found.entries
        )
        if looked_at is None:
            stalled = law is not None and law.stalled
        left_over = _what_is_left(chosen, looked_at, prepared, judges, stalled)
        noise, diagnosis = left_over.noise, left_over.messages
        if left_over.reason and stalled:
            ended = f"larger models are no more accurate: {left_over.reason}"
        elif left_over.reason:
            ended = f"{ended}; {left_over.reason}"
    if chosen.validation_bound > bound.bound:
        warn([*not_radians(pairs, coordinates), not_met(chosen, bound, ended), *diagnosis])
    others = [e.candidate for e in found.entries if entry is None or e.size is not entry.size]
    if law is not None and (entry is not None or of_map is not None):
        others.append(law.candidate)
    candidates = [*others, dataclasses.replace(chosen, chosen=True)]
    test = judges.pairs.take(judges.held_out[:_JUDGED])
    return Fit(
        map=chosen.map,
        candidates=tuple(sorted(candidates, key=lambda c: (c.operations, c.validation_relative))),
        asked=bound,
        num_pairs=len(pairs),
        judgements=charts.judgements,
        data_defect=seen.data_defect,
        base_map=entry is not None and bool(prepared.before or prepared.after),
        hamiltonian=law,
        noise=noise,
        messages=tuple(messages),
        ended=ended,
        seconds=clock.seconds,
        compile_seconds=compile_seconds,
        test_states=np.asarray(test.z0),
        test_args=test.args,
        model_determinant_min=smallest_determinant(chosen.map, prepared, judges),
        pairs=pairs,
        scene=scene,
    )


class _Better:
    """Hands on the map of every entry that is more accurate than those before. Nothing is compiled:
    the map is judged by the steps that the search made."""

    def __init__(self, prepared: Prepared, judges: Judges, on_better: Callable):
        self.prepared, self._judges, self._on_better = prepared, judges, on_better
        self._best = np.inf

    def __call__(self, entry: Entry) -> None:
        self.offer(entry.candidate, lambda: self._map_of(entry))

    def offer(self, candidate: Candidate, make: Callable[[], SymplecticMap]) -> None:
        """Hand on the map that ``make`` makes, if its candidate is better than those before."""
        if candidate.validation_bound < self._best:
            self._best = candidate.validation_bound
            self._on_better(make(), candidate)

    def _map_of(self, entry: Entry) -> SymplecticMap:
        _, params = entry.sweep.solve(entry.size, Clock(), lambda message: None)
        family = entry.size.family
        generated = Generated(
            family, params, entry.sweep.chart, self.prepared.dt, self.prepared.scale
        )
        features = getattr(getattr(family, "inputs", None), "features", None)
        generated = with_predictor(generated, self.prepared, self._judges.training, features)
        return composed(generated, self.prepared, self._judges)


def _prepared(pairs: Pairs, coordinates: Coordinates) -> tuple[Pairs, Prepared, list[str]]:
    """The pairs that are taken, in the inner coordinates, and warnings about those that are not."""
    messages, first = [], first_occurrences(pairs)
    copies = len(pairs) - len(first)
    if copies:
        messages.append(f"{copies} of {len(pairs)} pairs are copies of others: each counts once")
        pairs = pairs.take(first)
        check_number(pairs)
    prepared = prepare(pairs, coordinates)
    found = outliers(prepared.y0, prepared.y1, prepared.scale, given_by(prepared))
    if len(found):
        few = len(found) <= _MOST_OUTLIERS * len(pairs)
        rows = ", ".join(map(str, first[found[:5]])) + (", …" if len(found) > 5 else "")
        messages.append(
            f"{len(found)} of {len(pairs)} pairs contradict the pairs around them (rows {rows}): "
            + ("outliers, they are left out" if few else "too many to be left out")
        )
        if few:
            kept = np.setdiff1d(np.arange(len(pairs)), found)
            pairs, prepared = pairs.take(kept), prepared.take(kept)
    return pairs, prepared, messages


def _chosen(
    found: Found, law: LearnedHamiltonian | None, prepared: Prepared, plain: Prepared,
    judges: Judges, clock: Clock, say,
) -> tuple[Candidate, Entry | None, float]:  # fmt: skip
    """The chosen candidate with its map; where it comes from, None for the law; and the seconds
    that compiling took."""
    best = found.ranking[0].candidate if found.ranking else None
    if law is None or not (best is None or preferred(law.candidate, best, judges.tolerance.bound)):
        return _assembled(found, prepared, judges, clock, say)
    say(f"compiling the flow of {law.candidate.label}")
    assembled = flow_assembled(law, plain, judges)
    if best is not None and not assembled.candidate.validation_bound <= max(
        judges.tolerance.bound, 1.1 * law.candidate.validation_bound
    ):  # its own steps do not bear it out
        return _assembled(found, prepared, judges, clock, say)
    return assembled.candidate, None, assembled.compile_seconds


def _ended(chosen: Candidate, tolerance: Tolerance) -> str:
    """Why a search for H alone ended."""
    if chosen.validation_bound <= tolerance.bound:
        return MET
    return "no larger library of terms promised to meet it"


def _assembled(
    found: Found, prepared: Prepared, judges: Judges, clock: Clock, say
) -> tuple[Candidate, Entry, float]:
    """The first of the ranking whose own steps bear out what the search measured, else the best.
    Where the steps of a map that was to meet the tolerance do not, larger ones of its sweep are
    looked at before others."""
    compile_seconds, tried = 0.0, []
    first, bound = found.ranking[0], judges.tolerance.bound
    larger = _larger(first, clock, say) if first.candidate.validation_bound <= bound else ()
    for entry in itertools.chain([first], larger, found.ranking[1:]):
        say(f"compiling the step of {entry.candidate.chart} {entry.candidate.label}")
        sweep, size = entry.sweep, entry.size
        _, params = sweep.solve(size, Clock(), say)
        inputs = getattr(size.family, "inputs", None)
        assembled = assemble(
            entry.candidate, prepared, sweep.chart, size.family, params,
            getattr(inputs, "features", None), judges,
        )  # fmt: skip
        compile_seconds += assembled.compile_seconds
        tried.append((assembled.candidate, entry))
        expected = entry.candidate.validation_bound
        if assembled.candidate.validation_bound <= max(judges.tolerance.bound, 1.1 * expected):
            break
        if clock.left_in_all < assembled.compile_seconds:
            break
    chosen, entry = min(
        tried, key=lambda t: (t[0].validation_bound > judges.tolerance.bound, t[0].validation_bound)
    )
    return chosen, entry, compile_seconds


class _LeftOver(NamedTuple):
    """What the residuals suggest: the noise (2d,), what is said of them, and the reason why no
    larger model would help where that is known."""

    noise: np.ndarray | None
    messages: list[str]
    reason: str = ""


def _larger(entry: Entry, clock: Clock, say) -> Iterator[Entry]:
    """The larger sizes of an entry's sweep, validated by steps, as long as there is time."""
    sizes = entry.sweep.sizes
    for size in sizes[sizes.index(entry.size) + 1 :]:
        if clock.left <= 0:
            return
        judged = entry.sweep.judge(size, Clock(), say)
        yield Entry(entry.sweep.validate(size, judged, Clock(), say), entry.sweep, size)


def _what_is_left(
    chosen: Candidate, entry: Entry | None, prepared: Prepared, judges: Judges, stalled: bool
) -> _LeftOver:
    """Noise, where larger models no longer helped, friction, or a parameter that differs between
    sequences.

    entry: of the best map, whose residuals are looked at; None: those of the chosen law.
    """
    rows = np.sort(judges.training)[:_RESIDUAL_PAIRS]
    y0, residual, solved = _residuals(chosen, entry, prepared, judges, rows)
    rows, y0, residual = rows[solved], y0[solved], residual[solved]
    sequence = sequences_of(judges.pairs.z0, judges.pairs.z1)[rows]
    scale = judges.spread if entry is None else prepared.scale
    if differs_between_sequences(y0 / scale, residual / scale, sequence):
        message = (
            "what is left over agrees within a sequence and differs between sequences: something "
            "that the states do not hold (a mass, a length, a field) differs between them; learn "
            "those of one value by themselves"
        )
        return _LeftOver(None, [message], "something that the states do not hold differs between "
                         "the sequences")  # fmt: skip
    if not stalled:
        return _LeftOver(None, [])
    change, error = volume_change(y0, residual)
    if abs(change) > _CERTAIN * error:
        message = (
            f"what is left over is no noise: phase-space volumes change by {change:.2g} "
            f"(± {error:.1g}) of themselves in a step, as by friction: no symplectic map does"
        )
        return _LeftOver(None, [message], "volumes of phase space change, as by friction")
    taken = chosen.num_parameters / (judges.training.size * 2 * prepared.dim)
    noise = state_noise(chosen.map, judges.pairs.take(rows[:_NOISE_PAIRS]), taken)
    own = ""
    if chosen.learns == "map" and entry is not None:
        part = entry.sweep.own_error(entry.size) / np.sqrt(np.mean((noise / judges.spread) ** 2))
        own = f" (the map's own error is then about {part:.1g} of it)"
    message = (
        "larger models are no more accurate: the pairs seem to carry noise of about "
        f"{', '.join(f'{sigma:.1e}' for sigma in noise)} on the coordinates in their order{own}, "
        "or a structure that these functions cannot represent"
    )
    return _LeftOver(noise, [message])


def _residuals(
    chosen: Candidate, entry: Entry | None, prepared: Prepared, judges: Judges, rows
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States and residuals (N, 2d) of these pairs, and which of them were predicted (N,): as
    prepared where S was learned, in the user's coordinates where only a law was."""
    if entry is not None:
        _, params = entry.sweep.solve(entry.size, Clock(), lambda message: None)
        images, solved = refined_images(
            prepared, entry.sweep.chart, entry.size.family, params, rows
        )
        return prepared.y0[rows], prepared.y1[rows] - images, solved
    pairs, coordinates = judges.pairs.take(rows), prepared.coordinates
    angles = coordinates.angles if coordinates.forward is CARTESIAN.forward else ()
    z0 = np.asarray(pairs.z0)
    steps = stepped(chosen.map, z0, pairs.dt, pairs.args, timed=False)
    residual = nearest_image(np.asarray(pairs.z1) - steps.images, angles)
    return z0, residual, ~steps.failed & np.isfinite(residual).all(axis=1)


def not_met(chosen: Candidate, tolerance: Tolerance, ended: str) -> str:
    """The warning that nothing meets the tolerance."""
    error = chosen.validation_relative if tolerance.relative else chosen.validation_rms
    found = (
        f"has a one-step error of {error:.2e}{' of the spread' if tolerance.relative else ''} "
        f"(95 % bound {chosen.validation_bound:.2e})"
        if np.isfinite(error)
        else "leaves held-out states without an image (its step does not converge there)"
    )
    return (
        f"no candidate meets the tolerance {tolerance.bound:g}: the most accurate {found}; "
        f"the search ended because {ended}"
    )


def _nothing_found(found: Found, pairs: Pairs, clock: Clock) -> str:
    if clock.left <= 0:
        return f"expected a budget of more than {clock.max_seconds:g} s: no candidate was finished"
    return f"expected more pairs: {len(pairs)} are too few for the smallest model of this kind"


def smallest_determinant(map_: SymplecticMap, prepared: Prepared, judges: Judges) -> float:
    """The chart's determinant over some held-out pairs, where it is closest to 0. NaN where no
    piece has a chart. NumPy."""
    import jax

    piece = next((p for p in map_.pieces if isinstance(p, Generated)), None)
    if piece is None:
        return float("nan")
    piece = jax.tree.map(np.asarray, piece)
    rows = judges.held_out[:_JUDGED]
    args = prepared.given(rows)[1]
    determinant = piece.determinant(prepared.y0[rows], prepared.y1[rows], args)
    return float(determinant[np.argmin(np.abs(determinant))])


def candidates_table(fit: Fit):
    """The candidates of a fit as a ``rich`` table, by rising operations; the chosen one is marked.

    An error with ~ before it is an estimate from the gradient's residual; the others were measured
    by steps. Outside: the error at the outermost twentieth of the states, of a fit without them.
    """
    from rich.table import Table  # loaded when first used

    def number(value, form):
        return "–" if value is None else format(value, form)

    table = Table(title=f"candidates for tolerance {fit.tolerance:g} ({fit.num_pairs} pairs)")
    for head in ("", "chart", "family"):
        table.add_column(head)
    numbers = ("parameters", "error ÷ spread", "95 % bound", "outside", "kflop/step", "µs/step",
               "fit s")  # fmt: skip
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
