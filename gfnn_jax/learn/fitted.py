"""A fit as a user has it, whatever the data: the map, the law, the verdict, and how they were
found."""

from __future__ import annotations

import dataclasses
import difflib
import io
import warnings
from functools import cached_property
from typing import Any

import numpy as np

from gfnn_jax.brackets import Bracket, Casimir
from gfnn_jax.budget import COMPILE, ROWS, Budget, within
from gfnn_jax.candidates.assemble import Candidate, stepped
from gfnn_jax.data.recording import Recording
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.diagnosis.damping import LearnedDamping
from gfnn_jax.diagnosis.local_jacobians import ChartDeterminant
from gfnn_jax.diagnosis.symmetries import SymmetryOfPairs
from gfnn_jax.errors import FitError, FitWarning, said
from gfnn_jax.exports.symbolic import Formula
from gfnn_jax.families.sums import Sums
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.learn.choose import work_of_posterior
from gfnn_jax.maps.domain import Ranges
from gfnn_jax.maps.forecasts import Forecast
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.arms.learned_arm import LearnedArm
from gfnn_jax.models.brackets.search import ONE_LEVEL, of_noise, on_one_level
from gfnn_jax.models.hamiltonians.fitted_law import PartialLaw
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
from gfnn_jax.models.maps_of_laws.law_maps import NUM_PAIRS, Drawing, drawn
from gfnn_jax.phase_space import Pairs, sizes
from gfnn_jax.scenes.scene import Scene

STATES_MEASURED = 200  # states at which the chosen map's defect and determinant are taken


class _Options:
    """Options of what is measured of a chosen map and of its law."""

    of_derivative: float = 3.0  # times a step's: the time that compiling its derivative takes
    # Noise in a step, of the spread, under which laws differ by less than it: `benchmarks/laws.py`
    hides: float = 0.2
    states: int = 4_096  # about: at which H is compared
    explains: float = 0.5  # of the squares of steps, under which it is no law


@dataclasses.dataclass(frozen=True)
class OfPositions:
    """Traits of an S of positions alone.

    symmetric: whether S(q, Q) = S(Q, q). rank: how many combinations of its terms the data tell;
    the others, the factor of S among them, are those of free motion. condition: of those told.
    noise: σ (d,) of the readings, where they have noise and S was fitted with latent positions.
    """

    symmetric: bool
    num_parameters: int
    rank: int
    condition: float
    num_triples: int
    noise: tuple[float, ...] | None = None

    def __str__(self) -> str:
        """Line about what was learned."""
        left = self.num_parameters - self.rank
        kind = "symmetric, as S of a reversible map is" if self.symmetric else "of no symmetry"
        listed = "" if self.noise is None else ", ".join(f"{s:.3g}" for s in self.noise)
        return (
            f"S(q, Q) of {self.num_triples:,} triples of successive positions, {kind}. Positions "
            "do not determine its scale: momenta, energies and areas have a unit of their own"
            + (f". {left} undetermined combinations of terms are 0" if left else "")
            + (f". The noise of the readings is {listed}" if listed else "")
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """A choice of a map among candidates.

    candidates: every candidate met on the way, by rising operations. asked: the tolerance, and
    ``met`` whether the chosen map's upper 95 % bound is within it. num_pairs: that trained and
    validated. determinants: chart -> its determinant over the data. data_defect: how far the pairs'
    local Jacobians are from symplectic (median). base_map: whether one was factored out. noise:
    (2d,) standard deviation of each coordinate's noise that the residuals suggest where larger
    models stopped helping, else None. messages: the warnings, and the friction that the map has.
    ended: why the search ended. seconds: of it all; compile_seconds: of compiling, in them.
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
    map again, whatever the clock. budget: what is left of it. defect_known: whether there is
    time in it to compile the derivative of a step. white: whether H leaves no more than white
    noise, so that the pairs do not contradict it. seed: of what was drawn. several: why other laws
    may have made the pairs too, else "".
    """

    candidates: tuple[Candidate, ...]
    asked: Tolerance
    num_pairs: int
    validation_pairs: Pairs | None
    messages: tuple[str, ...]
    ended: str
    seconds: float
    compile_seconds: float
    test_states: np.ndarray
    determinants: dict[str, ChartDeterminant] = dataclasses.field(default_factory=dict)
    data_defect: float = float("nan")
    base_map: bool = False
    noise: np.ndarray | None = None
    model_determinant_min: float = float("nan")
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
    budget: Budget | None = None
    defect_known: bool = True
    white: bool = False
    seed: int = 0
    several: str = ""

    @classmethod
    def of(cls, budget: Budget, tested: Pairs, **known: Any) -> Choice:
        """Make the one that this budget paid for, with the pairs that its map is measured at."""
        known |= {"test_states": np.asarray(tested.z0), "test_args": tested.args}
        spent = {"seconds": budget.seconds, "operations": budget.operations}
        return cls(**known, **spent, budget=budget)

    @property
    def law(self) -> LearnedHamiltonian | None:
        """H, where one was found that meets the tolerance or was chosen."""
        law = self.hamiltonian
        known = law is not None and (
            self.chosen.learns == "hamiltonian" or self.asked.met_by(law.candidate)
        )
        return law if known else None

    @property
    def friction(self) -> Formula | None:
        """Rayleigh's R of the law, where it has friction."""
        return Formula(self.law.friction) if self.law is not None and self.law.friction else None

    @property
    def verdict(self) -> str:
        """Verdict of the pairs, as of `Fit.verdict`."""
        law, error = self.law, self.asked.text_of(self.chosen)
        missed = f"{error} misses the tolerance, for {self.ended}"
        if law is None:
            return "map" if self.met else f"map: {missed}"
        if not (self.met or self.white):
            if (share := max(0.0, self._explained)) < _Options.explains:
                return f"no law: the best explains {share:.0%} of the squares of steps: {missed}"
            return f"partly: {missed}"
        # Sums over sites have terms that vanish or add up to nothing, whatever the data.
        if law.null_terms and not isinstance(law.flow.family, Sums):
            return f"one of several: the pairs do not distinguish {', '.join(law.null_terms)}"
        if self.several:
            return f"one of several: {self.several}"
        relative = self.chosen.validation_relative
        if relative > _Options.hides:
            noise = f"noise of {relative:.0%} of the spread in a step"
            return f"one of several: {noise} hides what another law would leave"
        rivals = [rival.formula for rival in law.rivals if rival.odds < EVIDENCE.decided]
        if rivals:
            return f"one of several: {'; '.join(rivals)} is as likely"
        return f"one of several: {ONE_LEVEL}" if self._on_one_level(law) else "identified"

    @property
    def _explained(self) -> float:
        """The share of the squares of z1 − z0, in units of their spread, that is no error; 1 where
        there are no pairs."""
        if self.pairs is None:
            return 1.0
        size = np.std(self.pairs.z0, axis=0)
        moved = np.mean((self.pairs.z1 - self.pairs.z0) ** 2, axis=0)
        roots = (self.chosen.deviations**2, moved)
        left, whole = (float(np.sum(x[size > 0] / size[size > 0] ** 2)) for x in roots)
        return 1 - left / whole

    def _on_one_level(self, law: LearnedHamiltonian) -> bool:
        """Return whether all states of noisy sequences are of one H."""
        noise, pairs = law.noise, self.pairs
        if noise is None or noise.ndim != 1 or pairs is None or pairs.args is not None:
            return False
        if law.friction or self.base_map or isinstance(law.flow.family, Sums):
            return False
        z, flow = pairs.z0[:: 1 + len(pairs) // _Options.states], law.flow
        h = flow.family.value(flow.params, z, None)
        slopes, bends = flow.family.gradient_and_hessian(flow.params, z, None)
        by_noise = of_noise(slopes, bends, np.broadcast_to(noise, z.shape))
        return on_one_level(h, by_noise, slopes, np.std(z, axis=0))

    @property
    def line(self) -> str:
        """The chosen map, its error and the tolerance."""
        best = self.chosen
        unit = "of the spread" if self.asked.relative else "in the data's units"
        return (
            f"{best.chart} {best.label}, {best.num_parameters:,} parameters: one-step error "
            f"{best.validation_rms:.2e} in the data's units, {best.validation_relative:.2e} of the "
            f"spread; 95 % bound {best.validation_bound:.2e}, tolerance {self.tolerance:g} {unit}: "
            f"{'met' if self.met else 'not met'}; {self.num_pairs:,} pairs, {self.seconds:.1f} s"
        )

    @property
    def max_operations(self) -> int:
        """A bound on operations that gives this map again: the one that was asked for, or those
        that were done."""
        asked = None if self.budget is None else self.budget.max_operations
        return self.operations if asked is None else asked

    @property
    def formula(self) -> str | None:
        """H as text that ``terms`` and sympy read, where one was found that meets the tolerance or
        was chosen; ``print(fit.law)`` shows it as people read it."""
        return None if self.law is None else self.law.formula

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
        return self.asked.met_by(self.chosen)

    @property
    def table(self) -> str:
        """Every candidate by rising operations, the chosen one marked: text for ``print``."""
        from rich.console import Console  # loaded when first used

        text = io.StringIO()
        # Neither colours nor a notebook's own display: a string.
        plain = Console(width=132, file=text, force_terminal=False, force_jupyter=False)
        plain.print(candidates_table(self))
        return text.getvalue()


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Result of `gfnn.fit` and `gfnn.load`.

    map: the map that was chosen, which rolls out, estimates and forecasts. found: how it was found:
    a `Choice` among candidates, for pairs and for maps of positions; a
    `models.lagrangians.learned_law.LearnedLaw`, for recordings; a
    `models.arms.learned_arm.LearnedArm`, for logs of an arm; None of a folder that holds a map
    alone. Its attributes are those of the fit too: `candidates`, `met` and `chosen` of the first,
    `gains`, `zeros`, `noise` and `horizon` of the second. stored: what a folder holds beside these:
    ``verdict`` and ``record``, the report with the job that wrote it. data: the recording, which
    is not stored; learned_to: the time (s) up to which a law was learned from it, None for all.
    """

    map: SymplecticMap
    found: Choice | LearnedLaw | LearnedArm | None = None
    stored: dict[str, Any] = dataclasses.field(default_factory=dict)
    data: Recording | None = None
    learned_to: float | None = None

    @property
    def held_out(self) -> Recording | None:
        """The part of the recording that the law was not learned from."""
        if self.data is None or self.learned_to is None:
            return None
        return self.data.slice(start=np.nextafter(self.learned_to, np.inf))

    @property
    def seen(self) -> Recording:
        """The recording that the law was learned from. Raises ValueError where a folder gave the
        fit, which holds no data, and for a fit of pairs."""
        if self.data is None:
            call = "fit.forecast(times, after=gfnn.read(FILE))"
            why = "expected a fit that has its recording, and a folder holds none"
            raise ValueError(f"{why}: give it, as in {call}")
        return self.data if self.learned_to is None else self.data.slice(stop=self.learned_to)

    @property
    def law(self) -> LearnedHamiltonian | LearnedLaw | LearnedArm | None:
        """The law: H where it meets the tolerance or was chosen, or L with its friction. None of a
        generated map without a law, and where none is stored."""
        return self.found.law if isinstance(self.found, Choice) else self.found

    @property
    def verdict(self) -> str | None:
        """Verdict of the data, ``KIND`` or ``KIND: reason``. KIND is identified, one of several,
        partly, no law, of one that explains less than half of the steps, or map, of a generated map
        without a law; no law and not mechanical are those of a `FitError` too. None where a folder
        holds none."""
        verdict = self.stored.get("verdict", None if self.found is None else self.found.verdict)
        return None if verdict is None else said(verdict)

    @property
    def messages(self) -> tuple[str, ...]:
        """The warnings, and the friction that the map has."""
        return () if self.found is None else tuple(map(said, self.found.messages))

    @property
    def table(self) -> str:
        """Every candidate, the chosen one marked; or the law, its errors and its horizon."""
        return "" if self.found is None else said(self.found.table)

    @property
    def formula(self) -> str | None:
        """The law, H or L, as text that ``terms`` and sympy read."""
        return None if self.found is None else self.found.formula

    @property
    def hamiltonian(self) -> Any:
        """H with its terms, where one was found, whether its flow was chosen or not."""
        return None if self.found is None else self.found.hamiltonian

    @property
    def bracket(self) -> Bracket | None:
        """The bracket of a law ż = B(z)∇H(z) of states that are no (q, p); None of canonical
        data."""
        return self.map.bracket

    @property
    def casimirs(self) -> tuple[Casimir, ...]:
        """Casimirs, which every H with the bracket conserves: each has a ``formula`` and is a
        function of z; () of canonical data."""
        return () if self.bracket is None else self.bracket.casimirs

    @property
    def bracket_lines(self) -> list[str]:
        """The bracket and its Casimirs, a line each; [] of canonical data."""
        casimirs = "; ".join(casimir.formula for casimir in self.casimirs) or "none"
        told = [f"bracket: {self.bracket}", f"Casimirs: {casimirs}"]
        return [] if self.bracket is None else told

    @property
    def lagrangian(self) -> Formula | None:
        """L with its terms, of a recording."""
        return getattr(self.found, "lagrangian", None)

    @property
    def friction(self) -> Formula | None:
        """Rayleigh's R with its terms; None of a system without."""
        return None if self.found is None else self.found.friction

    def __repr__(self) -> str:
        """One line: the chosen map, its error and the tolerance; or the law."""
        return f"Fit({self.map if self.found is None else self.found.line})"

    def __getattr__(self, name: str) -> Any:
        """Attributes of what was found; for one version also those of the map, which `gfnn.load`
        gave before."""
        own = self.__dict__
        if not name.startswith("__") and "map" in own:
            if hasattr(own.get("found"), name):
                found = getattr(own["found"], name)
                return said(found) if isinstance(found, str) else found
            if hasattr(own["map"], name):
                warnings.warn(
                    f"fit.{name} is fit.map.{name}: a fit is no map, and will not stand for it in "
                    "the next version",
                    DeprecationWarning,
                    stacklevel=2,
                )
                return getattr(own["map"], name)
        known = [n for n in {*dir(type(self)), *dir(own.get("found"))} if not n.startswith("_")]
        near = difflib.get_close_matches(name, known, n=1)
        hint = f", did you mean {near[0]}?" if near else ""
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}{hint}")

    def __getstate__(self) -> dict[str, Any]:
        """Pickles hold what folders hold: neither the data nor what only the search needed."""
        from gfnn_jax.learn import saved  # stands after this module: a shorthand for its function

        return saved.state_of(self)

    def replaced(self, **changes: Any) -> Fit:
        """The fit with another map (``map``), and other values of what was found."""
        map_ = changes.pop("map", self.map)
        assert self.found is not None
        return dataclasses.replace(self, map=map_, found=dataclasses.replace(self.found, **changes))

    def save(self, folder, *, scene: Scene | None = None, overwrite: bool = False) -> None:
        """Save the fit as a folder, which `gfnn.load` reads: map, law, verdict and report.

        scene: the scene that the map was learned in, where it is not one of the package's own.
        Raises InputError where ``folder`` exists (unless ``overwrite``) or the map holds a function
        that cannot be found again by a name, WorkError where writing fails.
        """
        from gfnn_jax.learn import saved  # stands after this module: a shorthand for its function

        scene = scene or getattr(self.found, "scene", None)
        saved.save(self, folder, scene=scene, overwrite=overwrite)

    def report(self, path: Any = None, **about: Any) -> dict[str, Any]:
        """Make the report, which ``report.json`` holds, with numbers that are not finite as None.

        path: of an HTML page to write beside it, whole in one file, as ``report.html``. about:
        further entries, as of ``assemble`` and ``assemble_law`` in `evaluate.report`. Of a fit that
        was loaded it is the report that was saved. Raises ValueError where the folder holds none.

            fit.report("report.html")
        """
        from gfnn_jax.evaluate import page, report  # stand after this module: a shorthand

        own = getattr(self.found, "report", None)
        if path is not None and own is not None:
            raise ValueError("an arm has no page: print(fit.law), or fit.report() without a path")
        if path is not None:
            page.write_page(self, path)
        if "record" in self.stored:
            return {name: part for name, part in self.stored["record"].items() if name != "job"}
        if self.found is None:
            raise ValueError("expected a fit, or the folder of one: this one holds a map alone")
        if own is not None:
            return report.finite(own())
        assemble = report.assemble if isinstance(self.found, Choice) else report.assemble_law
        return report.finite(assemble(self, **about))

    def forecast(
        self,
        times: Any,
        *,
        after: Recording | None = None,
        inputs: Any = None,
        coverage: float | None = None,
        simultaneous: bool = False,
    ) -> Forecast:
        """Forecast at ``times`` (n,), in s on the clock of the recording, with standard deviations,
        in the units of its file: `maps.forecasts.Forecast`.

        after: the recording from whose end it starts; None: the one that was learned from.
        inputs: a recording of the inputs ahead. coverage, simultaneous: of a band, ``lower`` to
        ``upper``, as in `SymplecticMap.forecast`. Raises ValueError where the fit has no data and
        no ``after``, InputError as `SymplecticMap.forecast` does.

            ahead = fit.forecast(np.arange(10.1, 12.0, 0.1))
            ahead.values["theta"], ahead.std["theta"]  # (runs, times)
        """
        start = self.seen if after is None else after
        return self.map.forecast(start, times, inputs, coverage=coverage, simultaneous=simultaneous)

    def predict(self, z0: Any, num_steps: int, **options: Any) -> np.ndarray:
        """States (B, num_steps + 1, 2d), or (num_steps + 1, 2d), that follow z0 (B, 2d) or (2d,):
        those of `SymplecticMap.rollout`, whose ``options`` it takes. Warns (FitWarning) where
        orbits leave the states that the map was fitted to."""
        states, info = self.map.rollout(z0, num_steps, **options)
        left = np.atleast_1d(info.left_at)
        if (out := left[left >= 0]).size:
            line = (
                f"{len(out)} of {len(left)} orbits leave the states that the map was fitted to, "
                f"the first after {np.min(out)} steps: what follows is extrapolated"
            )
            found = self.found
            if isinstance(found, Choice) and found.law and found.chosen.learns != "hamiltonian":
                line += (
                    ". The law's own flow holds farther: gfnn.fit(pairs, model=gfnn.Hamiltonian())"
                )
            warnings.warn(line, FitWarning, stacklevel=2)
        return np.asarray(states)

    def plot(self) -> Any:
        """Figure (matplotlib) of the law against its recording, or of the candidates of a map."""
        from gfnn_jax.evaluate import page  # stands after this module: a shorthand

        return page.figure(self)

    def _repr_html_(self) -> str:
        from gfnn_jax.evaluate import page  # stands after this module: a shorthand

        return page.summary(self)

    def _repr_latex_(self) -> str | None:
        """The law as a notebook shows it."""
        return None if self.law is None else self.law._repr_latex_()

    def accelerate(
        self,
        *,
        dt: float | None = None,
        region=None,
        num_pairs: int = NUM_PAIRS,
        seed: int = 0,
        **options: Any,
    ) -> Fit:
        """A generated map of the Hamiltonian that was learned, fitted to pairs drawn from its flow.

        dt: the time of its step; None: that of the data. region: (2, 2d), lowest and highest
        values of the states to be predicted; None: where the data were and where the flow takes
        them. options: of `gfnn.fit`; the tolerance, where none is given as was asked for, is
        relative to the spread of the drawn states.

        Raises FitError where no Hamiltonian was learned that meets the tolerance or was chosen,
        its flow fails in the region, or a folder gave the fit, without its pairs; InputError for a
        region that is none.
        """
        from gfnn_jax.learn.fit import fit  # stands after this module: a shorthand

        law, pairs = self.hamiltonian, getattr(self.found, "pairs", None)
        refused = {
            "an H of terms to draw pairs from, got a network": law is not None
            and law.formula is None,
            "an H within the tolerance, this fit has none": law is None or self.formula is None,
            "no friction, for a map generated by S keeps areas": self.friction is not None,
            "no parameters, for a map generated by S has none": self.map.parameters is not None,
            "no structure, for a map generated by S has none": isinstance(self.map.domain, Ranges),
            "the pairs, which no folder and no recording holds": pairs is None,
        }
        for what in (what for what, given in refused.items() if given):
            raise FitError(f"accelerate: expected {what}")
        assert law is not None
        assert pairs is not None
        dt = float(np.asarray(self.map.dt)) if dt is None else dt
        if not (isinstance(dt, (int, float)) and 0 < dt < np.inf):
            raise FitError(f"expected a time step that is finite and above 0, got {dt!r}")
        scene, coordinates, bound = self.scene, self.map.coordinates, self.asked.bound
        relative = bound if self.asked.relative else bound / float(np.max(sizes(pairs.z0)))
        pairs = drawn(law.flow, coordinates, pairs.z0, dt, Drawing(num_pairs, seed, region))
        angles = () if scene is not None else coordinates.angles
        asked = {"learn": "map", "seed": seed, "angles": angles, "tolerance": relative}
        return fit(pairs, scene, **{**asked, **options})

    def settled(self) -> Fit:
        """Compute what a report and a saved model hold beside the map, as far as the budget goes:
        the posterior, which is left out of the map where it does not fit, and the defect of a step.
        Warns (FitWarning) of what is left out."""
        known, map_ = len(self.budget.left_out), self.map
        posterior = map_.posterior
        if posterior is not None and not posterior.known:
            work = work_of_posterior(self.chosen.num_parameters)
            last = self.budget.last("the posterior, and with it bands", ROWS, work)
            if within(last, lambda: posterior.root) is None:
                map_ = dataclasses.replace(map_, posterior=None)
        seconds = _Options.of_derivative * self.budget.compiling
        last = self.budget.last("the symplecticity defect of a step", COMPILE, seconds)
        defect = within(last, lambda: self.symplecticity_defect)
        messages = self.budget.left_out[known:]
        for message in messages:
            warnings.warn(message, FitWarning, stacklevel=2)
        told, known = (*self.messages, *messages), defect is not None
        seconds = self.budget.seconds
        found = self.replaced(map=map_, messages=told, defect_known=known, seconds=seconds)
        if defect is not None:
            found.__dict__["symplecticity_defect"] = defect
        return found

    def sample(self, key, num: int):
        """``num`` maps drawn from the posterior of the chosen map's coefficients, as one pytree,
        each exactly symplectic: `maps.samples.Samples`. key: of ``jax.random``.

        Raises ValueError where the map has no posterior: a single network, a map of pairs that were
        drawn from a law.
        """
        return self.map.sample(key, num)

    @cached_property
    def symplecticity_defect(self) -> float:
        """The largest defect ‖AᵀJA − μJ‖ of the chosen map's unrolled step at the test states, by
        its multiplier μ; NaN where it has none. Compiled when it is first asked for."""
        z, args = self.test_states, self.test_args
        steps = stepped(self.map, z, args=args, timed=False)  # by the program that is compiled
        defects = self.map.defect(z, args, iterations=steps.iterations)
        return float(np.max(np.asarray(defects)))


def candidate_cells(found: Choice | Fit) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads and rows of a table of the candidates, by rising operations; the chosen one is marked.

    An error with ~ before it is an estimate: the gradient's residual, which was told as a first
    estimate, times the ratio that measured steps of the same sweep have shown, if any were. The
    others were measured by steps. Outside: the error at the outermost twentieth of the states, of a
    fit without them.
    """
    bound = "95 % bound" if found.asked.relative else "95 % bound (absolute)"
    numbers = ("parameters", "error ÷ spread", bound, "outside", "kflop/step", "µs/step", "fit s")
    rows = [
        (
            "→" if c.chosen else "",
            c.chart,
            c.label,
            f"{c.num_parameters:,}",
            f"{'' if c.validated else '~'}{c.validation_relative:.2e}",
            f"{'' if c.validated else '~'}{c.validation_bound:.2e}",
            "–" if c.outside is None else f"{c.outside:.1e}",
            f"{c.operations / 1e3:.1f}",
            "–" if c.microseconds_per_step is None else f"{c.microseconds_per_step:.2f}",
            f"{c.fit_seconds:.2f}",
        )
        for c in found.candidates
    ]
    return ("", "chart", "family", *numbers), rows


def candidates_table(found: Choice | Fit):
    """The candidates of a fit as a ``rich`` table, as of `candidate_cells`."""
    from rich.table import Table  # loaded when first used

    table = Table(title=f"candidates for tolerance {found.tolerance:g} ({found.num_pairs} pairs)")
    heads, rows = candidate_cells(found)
    for place, head in enumerate(heads):
        table.add_column(head, justify="left" if place < 3 else "right")
    for row in rows:
        table.add_row(*row)
    return table
