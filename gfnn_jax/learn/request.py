"""Request of a fit: the pairs, checked before any work, those of them that the budget pays for, and
their diagnosis.

Refusals are one line each: what was expected and what came. What every fit does with each pair, the
looks at copies, outliers and local Jacobians and the first models, has to fit into the budget
before anything is begun; otherwise whole runs are left aside. That is decided by operations: the
clock of a busy machine changes no sample.
"""

import dataclasses
from collections.abc import Iterator

import jax
import numpy as np

from gfnn_jax.budget import RATES, ROWS, Budget
from gfnn_jax.coordinates import CARTESIAN, TWO_PI, Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import Identified, sampled
from gfnn_jax.dataset.structures import Structure, fields_of, structure_of
from gfnn_jax.dataset.varied import as_varied, check_varied
from gfnn_jax.diagnosis.damping import Diagnosis, diagnosed, lossy, undiagnosed
from gfnn_jax.diagnosis.local_jacobians import check_number
from gfnn_jax.diagnosis.residuals import misfit
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.sums import site_terms
from gfnn_jax.families.terms import given_terms
from gfnn_jax.families.told import Constrained, anything_told, untold
from gfnn_jax.generating.charts import CHARTS
from gfnn_jax.learn.options import FitOptions, Watch
from gfnn_jax.models.hamiltonians.fitted_law import PartialLaw
from gfnn_jax.models.hamiltonians.libraries import told_terms
from gfnn_jax.models.maps_of_laws.law_maps import factored_out, flow_of
from gfnn_jax.phase_space import Pairs, sizes, split
from gfnn_jax.scenes.draws import sample_states
from gfnn_jax.scenes.scene import AroundOrbit, Scene


class Options:
    """Limits of the first looks at pairs, and what they cost (study: budgets)."""

    # by such a factor the states of one scene hardly differ; those in other units do
    other_size: float = 3.0
    compared: int = 100
    coarse: float = 0.01  # of what a step moves
    fewest_jumps: int = 3  # by 2π, that make an angle
    still: float = 1e-15  # of the spread: no move
    # Operations that a pair takes of the looks and of the search for H, in units of (2d)²: a
    # million pairs of two degrees of freedom take 22 s (benchmarks/budgets.py).
    of_pair: int = 12_500
    # A sample takes so many, a second, and has so many pairs at least.
    of_sample: float = 1e10
    fewest: int = 2_000


FEWEST = 8  # pairs of a structure: 4 train, 4 are held out


def check_request(
    pairs: Pairs, scene: Scene | None, options: FitOptions, structure: str | None
) -> None:
    """Raises FitError where the pairs cannot give what is asked for.

    structure: of the options, or the scene's.
    """
    angles = options.angles
    if scene is not None and not isinstance(scene, Scene):
        raise FitError(f"expected a scene, as gfnn.scenes.make('two-body'), got {scene!r}")
    own_dt = bool(np.ndim(pairs.dt))
    if pairs.dt is None or isinstance(pairs.dt, str):
        raise FitError(f"expected a number as time step, got {pairs.dt!r}")
    for name, z in (("z0", pairs.z0), ("z1", pairs.z1)):
        if np.dtype(z.dtype).kind not in "fiu":
            raise FitError(f"expected {name} of real numbers, got {z.dtype}")
    if scene is not None and scene.dim != pairs.dim:
        raise FitError(f"scene {scene.name} has dim {scene.dim}, the pairs have {pairs.dim}")
    if scene is not None and angles:
        raise FitError("angles come with the scene: give a scene or angles, not both")
    bad = [a for a in angles if not 0 <= a < 2 * pairs.dim]
    if bad or len(set(angles)) < len(angles):
        most, got = 2 * pairs.dim - 1, tuple(angles)
        raise FitError(f"expected different angles among 0..{most}, got {got}")
    if own_dt or pairs.args or pairs.period is not None:
        check_varied(pairs)
    if pairs.period is not None and options.chart == "type1":
        raise FitError("expected another chart than type1 for a driven map")
    if not own_dt and not 0 < float(pairs.dt) < np.inf:
        mended = (float(pairs.dt) < 0) * ": where z1 come before z0 in time, exchange them"
        raise FitError(f"expected a time step that is finite and above 0, got {pairs.dt}{mended}")
    known = () if options.base is None else (options.base,)
    try:
        if anything_told(options.terms):
            _check_told(structure, options, pairs)
        if structure is not None:
            _check_structured(structure, scene, options, pairs)
        own = () if structure else untold(options.terms)
        given_terms(pairs.dim, own, tuple(pairs.args or ()))
        given_terms(pairs.dim, known)
    except (InputError, jax.errors.ConcretizationTypeError) as error:
        raise FitError(str(error)) from error
    if options.family == "features" and (scene is None or scene.features is None):
        raise FitError("family 'features' needs a scene that declares features")
    for name, z in (("z0", pairs.z0), ("z1", pairs.z1)):
        finite = np.isfinite(np.asarray(z)).all(axis=1)
        if not finite.all():
            bad = f"{int((~finite).sum())} rows of {name} with NaN or infinity"
            first = int(np.argmin(finite))
            raise FitError(f"expected finite states, got {bad}, the first is row {first}")
    if structure is None:
        check_number(pairs)
    elif len(pairs) < FEWEST:
        raise FitError(f"expected at least {FEWEST} pairs, got {len(pairs)}")


def _check_told(structure: str | None, options: FitOptions, pairs: Pairs) -> None:
    """Raises FitError and InputError for what cannot be told of coefficients."""
    depends = bool(pairs.args) or pairs.period is not None
    network = options.family == "mlp"
    refused = {f"structure {structure}": structure is not None, "a network": network}
    refused["args or a drive"] = depends
    for what, given in refused.items():
        if given:
            raise FitError(
                "terms: values, bounds and ties of coefficients are of H of plain pairs, got "
                f"{what}: give the terms without them"
            )
    terms = given_terms(pairs.dim, untold(options.terms))
    Constrained.of(terms, told_terms(pairs.dim, options.terms))


def _check_structured(
    structure: str, scene: Scene | None, options: FitOptions, pairs: Pairs
) -> None:
    """Raises FitError for what does not go with a structure."""
    learn, terms, chart = options.learn, options.terms, options.chart
    coordinates = scene.coordinates if scene is not None else CARTESIAN
    bodies, angles = structure.startswith("bodies"), options.angles or coordinates.angles
    own = not coordinates.plain or coordinates.cyclic
    refused = {
        "it has its own terms: expected no family or base": (options.family, options.base)
        != ("auto", None),
        "expected another chart than type1": chart == "type1",
        "only H is learned, expected no --learn map or chart": bodies
        and (learn == "map" or chart != "auto"),
        "expected no angles": bodies and angles,
        "expected plain q and p, no coordinates of a scene, parameters or drive": own
        or pairs.args
        or pairs.period is not None,
        "with angles only S is learned (--learn map), expected no terms, which are of H": angles
        and (learn == "hamiltonian" or terms),
        "--learn map expects pairs of one dt, got several": learn == "map" and np.ndim(pairs.dt),
        "expected no terms, it has powers of distances": terms and bodies,
        "expected terms as text in q1, p1 of a site and q2, p2, … of the next ones": not all(
            isinstance(term, str) for term in terms
        ),
    }
    for why, given in refused.items():
        if given:
            raise FitError(f"structure {structure}: {why}")
    for term in terms:
        site_terms(pairs.dim, "ring", 0, 0, (str(term),), max(1, fields_of(structure)))


def unlike_the_scene(pairs: Pairs, scene: Scene) -> list[str]:
    """Warnings where the pairs are of another size than the scene's states: 1/r₁ and the like know
    where the scene's bodies are, in its units."""
    if isinstance(scene.sampling, AroundOrbit):
        states = np.asarray(scene.sampling.start)[None, :]
    else:
        states = np.asarray(sample_states(scene, Options.compared, jax.random.key(0)))
    messages = []
    for name, ours, theirs in zip(
        ("positions", "momenta"), split(np.asarray(pairs.z0)), split(states), strict=True
    ):
        size, usual = (float(np.median(np.linalg.norm(x, axis=1))) for x in (ours, theirs))
        if usual > 0 and not 1 / Options.other_size < size / usual < Options.other_size:
            messages.append(
                f"the {name} are {size / usual:.2g} times the size of those in {scene.name}, whose "
                "features assume its own units: are the data in these?"
            )
    return messages


def coarse_tolerance(pairs: Pairs, tolerance: Tolerance) -> list[str]:
    """A warning where the tolerance exceeds a hundredth of what a step moves."""
    z0, move = np.asarray(pairs.z0), np.asarray(pairs.z1) - np.asarray(pairs.z0)
    # An angle that turned over moves little, whatever the difference of its numbers: the median.
    moved = np.median(np.abs(move / sizes(z0)) if tolerance.relative else np.abs(move), axis=0)
    size = float(np.sqrt(np.mean(moved**2)))
    if not tolerance.bound > Options.coarse * size > 0:
        return []
    unit = "of the coordinates' spread" if tolerance.relative else "in the data's units"
    option = "tolerance" if tolerance.relative else "absolute_tolerance"
    return [
        f"a step moves the states by {size:.1e} {unit}: maps close to the identity meet the "
        f"tolerance {tolerance.bound:g}. Set --{option.replace('_', '-')} to "
        f"{Options.coarse * size:.0e} or less"
    ]


def not_radians(pairs: Pairs, coordinates: Coordinates) -> list[str]:
    """Warnings where what is declared an angle hardly is one: it runs over more than two turns, and
    moves by more than half a turn in a step. For fits that came out badly."""
    if not coordinates.plain:
        return []
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    range_, move = np.ptp(z0, axis=0), np.abs(z1 - z0).max(axis=0)
    return [
        f"coordinate {a} of z, given as an angle, ranges over {range_[a]:.3g} and moves by up to "
        f"{move[a]:.3g} in a step. Angles are in radians: are these degrees? Convert them, or take "
        f"{a} out of --angles"
        for a in coordinates.angles
        if range_[a] > 2 * TWO_PI and move[a] > np.pi
    ]


def wrapped(pairs: Pairs, coordinates: Coordinates) -> list[int]:
    """Indices in z of what jumps by 2π, as an angle does that is wrapped and was not named: its
    values lie within one turn, some moves are beyond half a turn, and those are moves of the size
    of the others where 2π is taken from them."""
    if not coordinates.plain:
        return []
    z0, move = np.asarray(pairs.z0), np.asarray(pairs.z1) - np.asarray(pairs.z0)
    found = []
    for i in (i for i in range(2 * pairs.dim) if i not in coordinates.angles):
        size = np.abs(move[:, i])
        jumps = size > np.pi
        if not Options.fewest_jumps <= jumps.sum() < len(size) / 2 or np.ptp(z0[:, i]) > TWO_PI:
            continue
        most = min(1.5 * size[~jumps].max(), np.pi / 2)
        if np.abs(size[jumps] - TWO_PI).max() <= most:
            found.append(i)
    return found


def unnamed_angles(pairs: Pairs, coordinates: Coordinates) -> list[str]:
    """A warning that names the coordinates which are `wrapped` angles, and the option."""
    found = wrapped(pairs, coordinates)
    if not found:
        return []
    move = np.abs(np.asarray(pairs.z1) - np.asarray(pairs.z0))
    count, indices = int((move[:, found] > np.pi).any(axis=1).sum()), ",".join(map(str, found))
    named = "coordinate " + indices if len(found) == 1 else f"coordinates {indices}"
    jumps = f"{named} of z: jumps of 2π in {count} of {len(pairs)} pairs"
    return [f"{jumps}, as of an angle that is wrapped; name it: --angles {indices}"]


@dataclasses.dataclass(frozen=True)
class Request:
    """Pairs in float64 and what is to be learned of them.

    options: of the fit, with ``learn`` as the pairs allow it. tolerance, structure: those of the
    options, and the scene's. messages: warnings
    about the pairs and the request. partial_laws: those that were found so far.
    """

    pairs: Pairs
    scene: Scene | None
    coordinates: Coordinates
    options: FitOptions
    tolerance: Tolerance
    structure: Structure | None
    budget: Budget
    watch: Watch
    messages: list[str]
    partial_laws: list[PartialLaw] = dataclasses.field(default_factory=list)

    def partly(self, law: PartialLaw) -> None:
        """Keep a law that explains a part."""
        self.watch.on_progress(f"H: {law}")
        self.partial_laws.append(law)

    @property
    def reversor(self):
        """Reversor of the scene, or None."""
        return self.scene.reversor if self.scene is not None else None

    @property
    def seeks_law(self) -> bool:
        """Return whether H is looked for."""
        asked = self.options
        free = (asked.family, asked.chart, asked.base, asked.model) == ("auto", "auto", None, None)
        angles = self.structure is not None and bool(self.structure.angles)
        return (free or self.of_network) and asked.learn != "map" and not angles

    @property
    def of_network(self) -> bool:
        """Return whether H is to be a network."""
        return (self.options.learn, self.options.family) == ("hamiltonian", "mlp")


def lent(scene: Scene | None, options: FitOptions) -> str | None:
    """Structure that the scene lends where none is asked for: that of bodies is one of H alone."""
    if options.structure is not None or not isinstance(scene, Scene):
        return options.structure
    of_bodies = str(scene.structure).startswith("bodies")
    of_map = options.learn == "map" or options.chart != "auto"
    own = (options.family, options.base) != ("auto", None)
    return None if own or (of_bodies and of_map) else scene.structure


def checked(
    pairs: Pairs, scene: Scene | None, options: FitOptions, budget: Budget, watch: Watch
) -> Request:
    """Make the request, with what is constant in the pairs as a constant. Raises FitError, in one
    line, where the pairs cannot give what is asked for."""
    structure = lent(scene, options)
    check_request(pairs, scene, options, structure)
    plain = Coordinates("cartesian", angles=tuple(options.angles))
    coordinates = scene.coordinates if scene else plain
    found = structure_of(structure, pairs.dim, coordinates)
    z0, z1 = (np.asarray(z, np.float64) for z in (pairs.z0, pairs.z1))
    pairs = dataclasses.replace(pairs, z0=z0, z1=z1)
    asked = {name: getattr(options, name) for name in ("learn", "family", "chart", "base")}
    pairs, learn, messages = as_varied(pairs, **asked, structure=structure)
    z0, z1 = (np.asarray(z, np.float64) for z in (pairs.z0, pairs.z1))
    if np.ptp(z0, axis=0).any() and np.max(np.abs(z1 - z0) / sizes(z0)) <= Options.still:
        raise FitError(
            "expected states that move, got z1 = z0 in every pair: is H = 0, or are these the same "
            "columns twice?"
        )
    if scene is not None and scene.features is not None and options.family in ("auto", "features"):
        messages += unlike_the_scene(pairs, scene)
    bound = Tolerance.of(options)
    messages += [*coarse_tolerance(pairs, bound), *unnamed_angles(pairs, coordinates)]
    options = dataclasses.replace(options, learn=learn)
    return Request(pairs, scene, coordinates, options, bound, found, budget, watch, messages)


def paid_for(found: Identified, budget: Budget, seed: int) -> Identified:
    """The pairs, or a sample of them, drawn by the seed, where the budget does not pay for all:
    of two degrees of freedom 50,000. That is told with what else was left out."""
    pairs, row = found
    count, of_pair = len(pairs), Options.of_pair * (2 * pairs.dim) ** 2
    most = max(Options.fewest, int(Options.of_sample / of_pair))
    work = count * of_pair
    if count <= most or budget.pays_for(work):
        return found
    rows = sampled(pairs, most, seed)
    enough = f"--max-seconds {work / RATES[ROWS]:.0f}"
    if budget.max_operations is not None:
        enough = f"--max-operations {work:,}"
    whole = f"the budget pays for a sample; {enough} pays for all"
    budget.leave_out(f"{count - len(rows):,} of {count:,} pairs", whole)
    return Identified(pairs.take(rows), row[rows])


def diagnose_request(request: Request, plain: Dataset) -> Diagnosis:
    """The diagnosis of the pairs that a fit takes; a law that the user knows is factored out.

    plain: as taken. Raises FitError where no chart covers the data.
    """
    data, options = plain, request.options
    by_args = plain.args is not None and plain.period is None and plain.own_dt is None
    if by_args and plain.structure is None and options.learn != "hamiltonian":
        return lossy(plain, options.chart, request.reversor, options.seed)
    if plain.varied or plain.structure is not None:
        return undiagnosed(plain)
    if options.base is not None:
        known = given_terms(plain.dim, (options.base,))
        flow = flow_of(known, np.ones(known.num_parameters), plain)
        _, data = factored_out([flow], plain, options.seed)
    # A law of the user's keeps areas, and so does what H of an autonomous system generates.
    may_lose = options.base is None and options.learn != "hamiltonian" and not plain.after
    return diagnosed(data, options.chart, request.reversor, options.seed, may_lose=may_lose)


class Proposals:
    """Rules of when a structure is proposed, or tried first (study: many)."""

    fewest_dim: int = 6  # below it a fit needs no structure
    most_terms: int = 150  # of a library that a sample is fitted by
    # of the forces or of the velocities, that the midpoint's error may leave over
    explained: float = 0.1
    # of them: so little that a law of the structure is looked for before anything else
    tried: float = 0.02


_CHARTS = ("midpoint", "type2")  # of flows, to O(h²), and of kicked maps


def proposed(data: Dataset) -> list[str]:
    """One line that names the structure which explains a sample of the pairs best, to O(h²); none
    where none does. data: without a base map or a structure."""
    best, left = _best(data)
    if not left < Proposals.explained:
        return []
    return [
        f"the structure {best} explains these pairs: a sample of them leaves relative residuals of "
        f"{left:.1g} in forces and velocities, to second order in dt. Fit again with "
        f"--structure {best}"
    ]


def structures_to_try(request: Request, data: Dataset) -> Iterator[tuple[Request, Dataset]]:
    """The request and its data: with the structure that explains nearly all of a sample, where a
    law is looked for and nothing is told of it; then as they are."""
    named = request.options.terms or request.scene is not None or data.structure is not None
    if request.seeks_law and not (named or request.of_network):
        best, left = _best(data)
        if left < Proposals.tried:
            structure = structure_of(best, data.dim, data.coordinates)
            request.watch.on_progress(
                f"the structure {best} leaves relative residuals of {left:.1g} in forces and "
                "velocities: it is tried first"
            )
            same = Dataset.of(data.pairs, data.coordinates, structure, data.row)
            same = dataclasses.replace(same, split=data.split)
            yield dataclasses.replace(request, structure=structure), same
    yield request, data


def _best(data: Dataset) -> tuple[str, float]:
    """The structure that leaves least of a sample's forces and velocities over, and that part."""
    if data.dim < Proposals.fewest_dim or data.varied or data.coordinates.angles:
        return "", np.inf
    counts = [data.dim // k for k in (3, 2, 1) if data.dim % k == 0 and data.dim // k > 1]
    possible = ("ring", "chain", *(f"bodies:{count}" for count in counts))
    left = {text: _misfit(text, data) for text in possible}
    best = min(left, key=lambda text: left[text])
    return best, left[best]


def _misfit(text: str, data: Dataset) -> float:
    """The least part of the held-out target gradients that a library of the structure leaves."""
    structure = structure_of(text, data.dim)
    assert structure is not None
    libraries = list(structure.libraries(data.dim))
    small = [family for family in libraries if family.num_parameters <= Proposals.most_terms]
    charts = [CHARTS[name] for name in _CHARTS]
    return min((misfit(f, data, chart) for f in small for chart in charts), default=np.inf)
