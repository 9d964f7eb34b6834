"""Learn H: the Hamiltonian whose flow over dt maps z₀ to z₁, as a formula of few terms.

H = Σ c_j φ_j(z), and c minimises the mean of ‖Φ_h(z₀; c) − z₁‖² over the pairs, Φ_h the flow of
ż = J ∇H over h = dt by Gauss collocation (`fitting.gauss_newton`, from linear starts).

Libraries of terms are tried by rising size, each from the one before, until one meets the
tolerance; where there are angles, one library grows mode by mode. Terms that are nothing but noise
go while the held-out error does not rise. Which is preferred, H or a map, `preferred` says.
"""

import dataclasses
import time
from functools import partial

import numpy as np

from gfnn_jax.budget import UNBOUNDED
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.split import outermost
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.told import Constrained
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.fitting.linear_starts import backwards, tangent, turns
from gfnn_jax.fitting.significance import ABOVE_NOISE, at_thresholds, terms_above_noise
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.rates import MOST_SUBSTEPS
from gfnn_jax.models.hamiltonians.covariance import covariance_root, noise_left
from gfnn_jax.models.hamiltonians.dictionary import (
    law_of_noisy_pairs,
    law_of_physics,
    law_of_sequences,
)
from gfnn_jax.models.hamiltonians.fitted_law import Dropped, FittedLaw
from gfnn_jax.models.hamiltonians.friction import is_smooth, mechanical, without_turns
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian, learned_from
from gfnn_jax.models.hamiltonians.libraries import (
    breaks_bounds,
    check_finite,
    held_at_bounds,
    own_terms,
    root_of_all,
    unbound,
    within_bounds,
)
from gfnn_jax.models.hamiltonians.library_search import is_exact, of_libraries, small_libraries
from gfnn_jax.models.hamiltonians.problem import OPTIONS, LawProblem
from gfnn_jax.models.hamiltonians.sequences import arcs_of, fitted_to_sequences
from gfnn_jax.models.hamiltonians.symmetries import imposed
from gfnn_jax.scenes.scene import Scene


def learn_hamiltonian(problem: LawProblem) -> LearnedHamiltonian:
    """The Hamiltonian of these pairs: the smallest library that meets the tolerance, else the best.

    Raises FitError where no library can be tried, OutOfTime where the budget ends before the first.
    """
    started, data, options = time.perf_counter(), problem.data, problem.options
    if data.before or data.after:
        raise FitError("expected pairs without a base map: it is no part of a flow")
    own = own_terms(problem)
    if own is not None and data.structure is None:
        check_finite(own, data, data.training)
    most = options.mode_operations if problem.of_modes else options.max_operations
    if not problem.terms and problem.scene is None:
        of_sequences = problem.beginning(data, most)
        whole = law_of_sequences(of_sequences)
        if whole is not None:
            of_sequences.flows.allowance = UNBOUNDED
            found = learned_from(of_sequences, whole, started)
            for note in found.notes:
                problem.on_progress(note)
            return found
    everywhere, arcs = data, arcs_of(data)
    if arcs is not None:
        everywhere, length = arcs
        problem.on_progress(f"H: fitting arcs of {length} steps, for single steps are too noisy")
    problem = problem.beginning(everywhere, most)
    free = (*everywhere.coordinates.cyclic, *everywhere.whole)
    if data.structure is None:
        outer = outermost(everywhere.y0[everywhere.training], free)
    else:  # a state of many sites is in the middle and far out at once
        outer = np.zeros(len(everywhere.training), bool)
    inner = problem.on(everywhere.trained_on(everywhere.training[~outer]))
    best = _best_law(inner)
    everyone = np.arange(len(inner.data)) if is_smooth(best.family) else best.rows
    if inner.flows.substeps_for(best.family, best.fit.coefficients, everyone) >= MOST_SUBSTEPS:
        raise FitError(
            f"the H found is too fast: one dt needs {MOST_SUBSTEPS} substeps or more. Use a "
            "smaller dt; if the pairs are of a map without a flow, use --learn map"
        )
    best, outside = _simplified(inner, everywhere, everywhere.training[outer], best)
    ended, of_arcs = problem.work.ended, None
    problem.flows.allowance = UNBOUNDED
    before, best = best, within_bounds(problem, best)
    outside = outside if best is before else None
    if arcs is not None:
        of_arcs = partial(covariance_root, best, problem.flows, everywhere, best.fit.steps)
        problem = problem.beginning(data)
        best = best._replace(error=problem.error_of(best.family, best.fit))
    problem.flows.allowance = UNBOUNDED
    told_nothing = not problem.terms and problem.scene is None and arcs is None
    shorter = None
    if told_nothing and _leaves_noise(problem, best):
        shorter = law_of_noisy_pairs(problem, best)
    if shorter is not None:
        best, outside = shorter, None
    elif best.noisy or arcs is not None:
        of_steps, best = best, _along_sequences(problem, best)
        best = of_steps if breaks_bounds(problem, best) else best
    clean = isinstance(best.family, Terms) and best.error.relative <= OPTIONS.roundoff
    if clean and data.args is None:  # symmetries to roundoff hold to the last bit
        c, deviations = best.fit.coefficients, best.fit.standard_errors
        z, angles = data.y0[data.validation], data.coordinates.angles
        c = imposed(best.family, c, deviations, z, angles)
        best = best._replace(fit=best.fit._replace(coefficients=c))
    told = best.family
    if isinstance(told, Constrained):
        root = of_arcs or partial(covariance_root, best, problem.flows, data, best.fit.steps)
        best, of_arcs = unbound(best), lambda: root_of_all(told, root())
    learned = learned_from(problem, best, started, of_arcs)
    return dataclasses.replace(
        learned,
        candidate=dataclasses.replace(learned.candidate, outside=outside),
        messages=(*learned.messages, *held_at_bounds(problem, best)),
        constrained=told if isinstance(told, Constrained) else None,
        ended=ended or problem.work.ended,
    )


def _best_law(problem: LawProblem) -> FittedLaw:
    """The law of the smallest libraries, of physics, of a mechanical system or of the libraries,
    the first within the tolerance, else the best."""
    with_masses, best, early = None, None, dict[int, FittedLaw]()
    if not problem.terms and problem.scene is None:
        if problem.simple:
            early = small_libraries(problem)
            last = next(reversed(early.values()), None)
            best = last if last is not None and is_exact(problem, last) else None
        if best is None:
            best = law_of_physics(problem)
        if best is None:
            best = with_masses = mechanical(problem)
    if best is None or not problem.met_by(best):
        try:
            best = of_libraries(problem, early)
        except (OutOfTime, FitError):
            if best is None:
                raise
        if with_masses is not None and with_masses.error.relative <= best.error.relative:
            best = with_masses._replace(noisy=True, thresholds=best.thresholds)
    return best


def _simplified(
    problem: LawProblem, whole: Dataset, far: np.ndarray, best: FittedLaw
) -> tuple[FittedLaw, float | None]:
    """The law without the terms that are noise or not asked for, fitted to all training pairs, as
    far as the budget goes; and its error at the outermost states, of a fit without them.

    The problem's data are without the outermost states ``far``, the ``whole`` with them.
    """
    outside, what, law, work = None, "", (best.family, best.fit.coefficients), problem.work
    data, everywhere, there = (
        without_turns(rows, *law) for rows in (problem.data, whole, whole.validated_on(far))
    )
    problem = problem.on(data)
    try:
        if best.noisy:
            what = "dropping the terms of H that are noise"
            work.capped(np.inf)  # what is pruned is soon fitted
            with work.again(what, (best.larger or best).family, len(data.training)):
                best = without_noise(problem, best)
        what = "removing terms of H that are not significant"
        with work.again(what, best.family, len(best.fit.used)):
            best = sparse(problem, best)
        if len(there.validation) and len(far):
            outside = problem.on(there).error_of(best.family, best.fit).relative
        misses = not problem.met_by(best) and np.isfinite(problem.dearest)
        few = len(best.fit.used) < len(everywhere.training)
        if best.error.relative > problem.options.roundoff and few and not misses:
            what = "the fit of H to all pairs"
            with work.again(what, best.family, len(everywhere.training)):
                best = problem.refitted(best, everywhere.training)
    except OutOfTime:  # what was found stands
        work.budget.leave_out(what, work.ended)
    return best, outside


def _leaves_noise(problem: LawProblem, law: FittedLaw) -> bool:
    """Return whether what the law leaves over is noise for the most part: a polynomial that is near
    the law may leave some misfit too."""
    if problem.met_by(law) or law.error.relative <= problem.options.roundoff:
        return False
    data, fit = problem.data, law.fit
    steps = fit.steps.stages, fit.steps.substeps
    flow = Flow(law.family, fit.coefficients, data.dt, data.scale, *steps)
    return law.noisy or (noise_left(flow, data) or 0.0) > 0.5


def _along_sequences(problem: LawProblem, best: FittedLaw) -> FittedLaw:
    """The law fitted to whole sequences, where it misses the tolerance, is smooth (|v|v and sign v
    are not where sequences turn), and held-out steps bear it out."""
    if not is_smooth(best.family) or problem.met_by(best):
        return best
    what, work, rows = "the fit of H to whole sequences", problem.work, problem.data.training
    problem.on_progress("H: fitting whole sequences")
    with work.optional(what), work.again(what, best.family, len(rows)):
        if best.error.relative <= problem.options.roundoff:
            return best
        found, before = fitted_to_sequences(problem, best), best.error.relative
        better = found is not None and EVIDENCE.is_no_worse(found.error.relative, before)
        return found if found is not None and better else best
    return best


def without_noise(problem: LawProblem, smallest: FittedLaw) -> FittedLaw:
    """The terms that the training pairs tell from noise: of the smallest library whose error is
    that of the noise, and those of the largest that they tell beside them. An error that is noise
    for the most part hides terms which 10,000 pairs tell."""
    rows = problem.data.training
    found, few = _significant(problem, smallest), None
    if found is not None:
        found = problem.refitted(found, rows)
    before = smallest.error.relative
    if found is None or not EVIDENCE.is_no_worse(found.error.relative, before):
        found = problem.refitted(smallest, rows)
    if smallest.larger is not None:
        few = _significant(problem, smallest.larger)
    more = 0 if few is None else few.family.num_parameters - found.family.num_parameters
    if few is None or more <= 0:
        return found
    few = problem.refitted(few, rows)
    # Twice the logarithm of the likelihood's ratio.
    gained = 2 * few.fit.triangle.rows * np.log(found.fit.rms / few.fit.rms)
    if gained > ABOVE_NOISE**2 * more and few.error.relative <= found.error.relative:
        return few._replace(noisy=True, thresholds=found.thresholds)
    return found


def _significant(problem: LawProblem, full: FittedLaw) -> FittedLaw | None:
    """The terms that the training pairs tell from noise, which one Gauss–Newton problem of all
    terms says, so that only a few are fitted to many pairs; None where it tells none."""
    c, rows = full.fit.coefficients, problem.data.training
    resolved = np.setdiff1d(rows, np.setdiff1d(full.rows, full.fit.used))
    found = problem.flows.linearised(full.family, c, full.fit.steps, resolved)
    if not np.isfinite(found.norm):
        return None
    kept, start = terms_above_noise(found, c, ABOVE_NOISE)
    if not len(kept):
        return None
    family = full.family.take(tuple(kept.tolist()))
    return full._replace(family=family, fit=full.fit._replace(coefficients=start))


def sparse(problem: LawProblem, full: FittedLaw) -> FittedLaw:
    """Drop the terms that the pairs do not ask for, as far as the held-out error allows."""
    options, before, fit = problem.options, full.error.relative, full.fit
    thresholds = options.thresholds if full.thresholds is None else full.thresholds
    count = len(fit.coefficients)
    for kept in at_thresholds(fit.triangle, fit.coefficients, thresholds, fit.rms):
        problem.on_progress(f"H: {len(kept)} of {count} terms")
        start, family = fit.coefficients[kept], full.family.take(kept)
        few = problem.fitted(family, start, fit.used, rounds=False, steps=fit.steps)
        after = few.error.relative
        if EVIDENCE.is_no_worse(after, before):
            dropped = Dropped(count - len(kept), before, after)
            change = f"error {after:.2e}, before {before:.2e}"
            problem.on_progress(f"H without {dropped.terms} terms: {change}")
            return full._replace(family=few.family, fit=few.fit, error=few.error, dropped=dropped)
    return full


# Beside a map only a law of few terms is looked for, of all powers to 4 in two degrees of freedom
# or to 3 in three: a larger one is no shorter to say than S. Its
# budget is counted, so that a busy machine chooses no other candidate: 20 and 30 seconds of a quiet
# core, which makes 5e8 of these operations a second, of modes 7e8 (two bodies, PCR3BP, pendulums).
_BESIDE = dataclasses.replace(
    OPTIONS, most_terms=90, most_modes=150, max_operations=1e10, mode_operations=2e10
)
# A law holds outside the data and at any time step: so much dearer a step it may be.
MAX_COST_RATIO = 4.0


@dataclasses.dataclass(frozen=True)
class _Options:
    """Options of the preference for H."""

    # Where none meets the tolerance, errors that the noise of held-out pairs does not tell apart.
    as_good: float = 1.01
    turned: float = 0.2  # radians backwards that are worth a word


_OPTIONS = _Options()


def law_of(problem: LawProblem, learn: str) -> LearnedHamiltonian | None:
    """The Hamiltonian of these pairs, or None where "auto" finds none, or the budget ends before
    the first.

    The problem's ``dearest`` is of use where H is not asked for; its options are chosen here.
    Raises FitError where a Hamiltonian is asked for and there is none to learn.
    """
    data, budget = problem.data, problem.budget
    unfit = unfit_for_law(data, problem.scene)
    if unfit is not None:
        if learn == "hamiltonian":
            raise FitError(f"expected data of an autonomous flow to learn H from: {unfit}")
        return None
    # S of a driven system, or of one with parameters or several dt, needs more terms than H: no map
    # to wait for.
    structured = data.structure is not None
    foremost = learn == "hamiltonian" or problem.terms or data.varied or structured
    options = OPTIONS if foremost else _BESIDE
    if learn == "hamiltonian":  # no map stands in for a law that misses the tolerance
        options = dataclasses.replace(options, only_within=False, gained=OPTIONS.gained_alone)
    if structured:  # nothing else is learned of bodies, and of sites S in a few seconds
        options = dataclasses.replace(options, max_operations=np.inf)
    dearest = np.inf if foremost else problem.dearest
    try:
        with np.errstate(all="ignore"):  # starts that run away are part of the search
            return learn_hamiltonian(dataclasses.replace(problem, options=options, dearest=dearest))
    except OutOfTime:
        budget.leave_out("H", "no set of terms was fitted within the budget")
    except (FitError, np.linalg.LinAlgError) as error:
        if learn == "hamiltonian" or problem.terms:
            raise FitError(str(error)) from error
        if isinstance(error, np.linalg.LinAlgError):
            budget.leave_out("H", f"its linear algebra failed: {error}")
    return None


def long_step(data: Dataset, scene: Scene | None) -> list[str]:
    """A warning where no H was found and the states turn backwards around their centre.

    data: without a base map.
    """
    if data.varied or data.coordinates.angles or unfit_for_law(data, scene) is not None:
        return []
    _, _, jacobian = tangent(data.y0, data.y1, data.scale)
    angle = backwards(turns(jacobian, data.scale)[0])
    if angle < _OPTIONS.turned:
        return []
    return [
        f"a step of {data.dt:g} turns the states around their centre by {angle:.2g} radians "
        f"backwards, or by {2 * np.pi - angle:.2g} forwards (aliasing, ωh > π): pairs of one dt "
        "may not determine H. Sample with a smaller dt, or with several"
    ]


def unfit_for_law(data: Dataset, scene: Scene | None) -> str | None:
    """Reason why the pairs are not those of an autonomous flow, where that is known."""
    if scene is not None and scene.timeless:
        return f"the scene {scene.name} is a map without time"
    if scene is not None and scene.period is not None and data.period is None:
        return f"the Hamiltonian of the scene {scene.name} depends on time"
    if any(a >= data.dim for a in data.coordinates.angles):
        return "--angles names a momentum"
    return None


def preferred(law: Candidate, chosen: Candidate, tolerance: Tolerance) -> bool:
    """Return whether the law is taken instead of the map that was chosen: where it alone meets the
    tolerance, or meets it and is not four times dearer, or none meets it and it is as good.

    Behind noise a law of fewer numbers is as good up to what chance makes of the held-out error.
    """
    if law.validation_bound <= tolerance.bound:
        return (
            not chosen.validation_bound <= tolerance.bound
            or law.operations <= MAX_COST_RATIO * chosen.operations
        )
    if chosen.validation_bound <= tolerance.bound or not np.isfinite(law.validation_relative):
        return False
    as_good = _OPTIONS.as_good
    if law.num_parameters <= chosen.num_parameters:
        size = law.validation_relative if tolerance.relative else law.validation_rms
        chance = law.validation_bound / size if size > 0 else 1.0
        as_good = max(as_good, float(np.sqrt(chance)))
    return law.validation_relative <= as_good * chosen.validation_relative
