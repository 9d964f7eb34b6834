"""Choice between H and a map: whether H is learned beside the map, and when it is preferred."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.fitting.linear_starts import backwards, tangent, turns
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.problem import OPTIONS, LawProblem
from gfnn_jax.models.hamiltonians.search import learn_hamiltonian
from gfnn_jax.scenes.scene import Scene

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
