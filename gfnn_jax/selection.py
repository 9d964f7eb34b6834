"""``gfnn.fit``: the cheapest exactly symplectic map that is as accurate as asked for.

data → inner coordinates → charts that cover the data → candidates from small to large → the choice.
A candidate is chart × family × size. Its error is measured, not estimated: the one-step state error
on held-out pairs, in the user's coordinates. Its cost is counted (floating-point operations per
predicted step), so that one seed always chooses the same map; the measured time stands beside it.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.base_map import fit_half_map
from gfnn_jax.charts import CHARTS, MIDPOINT, TYPE1, AnyChart
from gfnn_jax.coordinates import CARTESIAN, TWO_PI, Coordinates, lift
from gfnn_jax.domain import Domain, covering
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.levenberg_marquardt import LMState, levenberg_marquardt
from gfnn_jax.local_maps import SAFE, ChartJudgement, data_defect, judge_chart, local_jacobians
from gfnn_jax.maps import Affine, Generated, SymplecticMap
from gfnn_jax.phase_space import Pairs, require_x64
from gfnn_jax.scalars.inputs import box_inputs, variable_signs
from gfnn_jax.scalars.mlp import Mlp, amplitude_of
from gfnn_jax.scalars.products import Products
from gfnn_jax.scalars.sines import Sines
from gfnn_jax.scenes.scene import Scene

SCALARS = ("auto", "polynomial", "features", "sines", "mlp")
CHART_NAMES = ("auto", *CHARTS)

_VALIDATION_FRACTION, _MOST_VALIDATION = 0.15, 2_000
# Degrees whose numbers of terms grow by about a half from one to the next; a stage is fitted by one
# factorisation of the rows of its largest degree.
_STAGES = ((2, 3, 4, 5, 6), (7, 8, 9, 10), (12, 14, 16), (18, 20))
_SINES = (100, 200, 400, 800, 1_600)
_MOST_TERMS = 1_500
# Rows × terms² of one factorisation: about ten seconds on two cores.
_MOST_WORK = 1.2e11
# Where the best chart's determinant falls below this, the map is far from the identity.
_FAR = 0.7
_ROUNDOFF = 1e-12  # of the data's spread: below it a stall is arithmetic, not noise
# A rung that gains less than this has stalled; so many in a row (a symmetric map gains nothing from
# the odd degrees), and larger families only fit noise.
_WORTHWHILE, _STALLED = 0.8, 3
# So often another ladder may be better before this one is left.
_BEATEN = 3
_NORMAL_95 = 1.645
_NOMINAL_NEWTON = 3
# The network of the second-order fit: three small layers beat one wide, gelu beats tanh.
_MLP_HIDDEN, _MLP_ACTIVATION, _MLP_PAIRS = (16, 16, 16), "gelu", 4_000
_CHECKPOINT_SECONDS = 10.0
_TIMED_LANES, _TIMED_FRONT = 1_000, 3


class FitError(ValueError):
    """The data or the request cannot give a map: one line, what was expected and what came."""


class FitWarning(UserWarning):
    """The fit went on, but its user should know."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One rung of the ladder: what it is, how accurate, how fast.

    validation_rms: per-component RMS of the one-step state error on held-out pairs, in the user's
    coordinates; validation_bound: its upper 95 % bound. work: floating-point operations per
    predicted step. fit_seconds: of its least-squares solve or training, compilation apart.
    """

    label: str
    scalar: str
    chart: str
    num_parameters: int
    validation_rms: float
    validation_bound: float
    work: float
    microseconds_per_step: float | None
    fit_seconds: float
    compile_seconds: float
    train_rms: float
    newton_iterations_max: int
    condition: float | None
    rank: int | None
    map: SymplecticMap
    chosen: bool = False


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted map and how it was chosen.

    map: the chosen map. candidates: every candidate met on the way, by rising cost. tolerance: what
    was asked for, and ``met`` whether the chosen map's upper 95 % bound is within it. judgements:
    chart -> its determinant over the data. data_defect: how far the pairs' local Jacobians are from
    symplectic (median). based: whether a base map was factored out. noise: standard deviation per
    coordinate that the residuals suggest where larger models stopped helping, else None. messages:
    the warnings. seconds: of it all.
    """

    map: SymplecticMap
    candidates: tuple[Candidate, ...]
    tolerance: float
    num_pairs: int
    judgements: dict[str, ChartJudgement]
    data_defect: float
    based: bool
    seconds: float
    symplecticity_defect: float
    model_determinant_min: float
    noise: float | None
    messages: tuple[str, ...]

    @property
    def chosen(self) -> Candidate:
        return next(c for c in self.candidates if c.chosen)

    @property
    def met(self) -> bool:
        """Whether the chosen candidate's validation error is within the tolerance, at 95 %."""
        return self.chosen.validation_bound <= self.tolerance

    @property
    def table(self):
        """The candidates as a ``rich`` table; ``print`` shows it as text."""
        return candidates_table(self)


@dataclasses.dataclass(frozen=True)
class _Prepared:
    """Pairs in the coordinates where S is learned: inner, lifted, base map factored out."""

    y0: np.ndarray
    y1: np.ndarray
    half: Affine | None
    scale: np.ndarray
    coordinates: Coordinates
    domain: Domain
    cut: np.ndarray
    linear: np.ndarray
    offset: np.ndarray
    dt: float


def fit(
    pairs: Pairs,
    scene: Scene | None = None,
    *,
    tolerance: float = 1e-6,
    chart: str = "auto",
    scalar: str = "auto",
    angles: tuple[int, ...] = (),
    seed: int = 0,
    max_iterations: int = 250,
    checkpoints: Any = None,
    on_progress: Callable[[str], Any] = lambda message: None,
) -> Fit:
    """Learn the map of these pairs: the cheapest candidate within ``tolerance``, else the best.

    pairs:     states and images, (N, 2d) each, NumPy or JAX.
    scene:     lends its coordinates, features and reversor; None: plain coordinates.
    tolerance: bound on the one-step state error's RMS per component, in the user's units.
    chart:     "auto" or one of type1, type2, type3, midpoint.
    scalar:    "auto", "polynomial" (Fourier in angles), "features" (the scene's), "sines", "mlp".
    angles:    without a scene, the indices of z that have period 2π.
    max_iterations: of the training of "mlp".
    checkpoints: a ``TrainingCheckpoints``, which a training saves to and goes on from.

    Raises FitError, in one line, where the data are too few or not finite or a chart that was asked
    for is singular over them (naming the chart to use instead). Warns (FitWarning) where nothing
    meets the tolerance, where a chart is close to singular, and where the pairs do not look
    symplectic.
    """
    started = time.perf_counter()
    require_x64("a fit")
    _check_request(pairs, scene, tolerance, chart, scalar, angles)
    coordinates = scene.coordinates if scene else Coordinates("cartesian", angles=tuple(angles))
    messages: list[str] = []

    def warn(message: str) -> None:
        messages.append(message)
        warnings.warn(message, FitWarning, stacklevel=3)

    training, held_out = _split(pairs, seed)
    on_progress("looking at the map's local Jacobians")
    prepared = _prepare(pairs, coordinates)
    jacobians = local_jacobians(prepared.y0, prepared.y1, prepared.scale, seed=seed)
    defect = data_defect(jacobians, prepared.scale)
    if defect > 0.3:
        warn(
            f"the pairs do not look symplectic: ‖MᵀJM − J‖ is about {defect:.2g} (0 for a "
            "symplectic map): are q and p in order, p momenta and not velocities, and no friction?"
        )
    judgements = {name: judge_chart(c, jacobians, prepared.scale) for name, c in CHARTS.items()}
    charts, half, judgements = _choose_charts(
        chart, prepared, scene.reversor if scene else None, jacobians, judgements, warn
    )
    if half is not None:
        prepared = _factor_out(prepared, half)
        on_progress("no chart covers the data by itself: an affine base map is factored out")

    rows = _Rows(pairs, training, held_out)
    if scalar == "mlp":
        ladders: list[Any] = [
            _Network(prepared, charts[0], rows, tolerance, max_iterations, seed, checkpoints)
        ]
    else:
        ladders = [
            _Ladder(prepared, c, rows, *k) for c, k in _kinds(scalar, charts, prepared, scene)
        ]
    candidates, stalled = _walk(ladders, tolerance, on_progress)
    if not candidates:
        raise FitError(
            f"expected more pairs: {len(pairs)} are too few for the smallest model of this kind"
        )
    chosen = _choose(candidates, tolerance)
    if chosen.validation_bound > tolerance:
        warn(
            f"no candidate meets the tolerance {tolerance:g}: the most accurate has a one-step "
            f"error of {chosen.validation_rms:.2e} (95 % bound {chosen.validation_bound:.2e})"
        )
    noise = None
    spread = float(np.max(np.std(np.asarray(pairs.z0), axis=0)))
    if (chosen.chart, chosen.scalar) in stalled and chosen.validation_rms > _ROUNDOFF * spread:
        # Noise of both states enters the difference: σ √2 for a map near the identity.
        noise = chosen.validation_rms / np.sqrt(2.0)
        warn(
            f"larger models are no more accurate: the pairs seem to carry noise of about "
            f"{noise:.1e} on every coordinate, or a structure these functions cannot represent"
        )
    on_progress("timing the candidates")
    test = np.asarray(pairs.z0)[held_out]
    chosen_label = (chosen.chart, chosen.scalar, chosen.label)
    candidates = _timed(candidates, chosen, test)
    chosen = next(c for c in candidates if (c.chart, c.scalar, c.label) == chosen_label)
    ordered = sorted(candidates, key=lambda c: (c.work, c.validation_rms))
    ordered = tuple(dataclasses.replace(c, chosen=c is chosen) for c in ordered)
    test = test[:200]
    return Fit(
        map=chosen.map,
        candidates=ordered,
        tolerance=tolerance,
        num_pairs=len(pairs),
        judgements=judgements,
        data_defect=defect,
        based=half is not None,
        seconds=time.perf_counter() - started,
        symplecticity_defect=float(jnp.max(chosen.map.defect(test))),
        model_determinant_min=_smallest(chosen.map.determinant(test)),
        noise=noise,
        messages=tuple(messages),
    )


# The request and the data.


def _check_request(pairs, scene, tolerance, chart, scalar, angles) -> None:
    if chart not in CHART_NAMES:
        raise FitError(f"expected a chart among {', '.join(CHART_NAMES)}; got '{chart}'")
    if scalar not in SCALARS:
        raise FitError(f"expected a scalar among {', '.join(SCALARS)}; got '{scalar}'")
    if not tolerance > 0:
        raise FitError(f"expected a tolerance > 0, got {tolerance}")
    if pairs.z0.shape != pairs.z1.shape or pairs.z0.ndim != 2 or pairs.z0.shape[1] % 2:
        raise FitError(
            f"expected z0 and z1 of one shape (N, 2d), got {pairs.z0.shape} and {pairs.z1.shape}"
        )
    if scene is not None and scene.dim != pairs.dim:
        raise FitError(f"scene {scene.name} has dim {scene.dim}, the pairs have {pairs.dim}")
    if scene is not None and angles:
        raise FitError("angles come with the scene: give a scene or angles, not both")
    bad = [a for a in angles if not 0 <= a < 2 * pairs.dim]
    if bad:
        raise FitError(f"expected angles among 0..{2 * pairs.dim - 1}, got {bad[0]}")
    if scalar == "features" and (scene is None or scene.features is None):
        raise FitError("scalar 'features' needs a scene that declares features")
    for name, z in (("z0", pairs.z0), ("z1", pairs.z1)):
        finite = np.isfinite(np.asarray(z)).all(axis=1)
        if not finite.all():
            raise FitError(
                f"expected finite states, got {int((~finite).sum())} rows of {name} with NaN or "
                f"infinity, the first is row {int(np.argmin(finite))}"
            )
    if len(pairs) < 8 * pairs.dim:
        raise FitError(
            f"expected at least {8 * pairs.dim} pairs for d = {pairs.dim}, got {len(pairs)}"
        )


def _split(pairs: Pairs, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows for training and rows held out, shuffled by the seed."""
    order = np.random.default_rng(seed).permutation(len(pairs))
    held = min(_MOST_VALIDATION, max(4, int(_VALIDATION_FRACTION * len(pairs))))
    return order[held:], order[:held]


def _prepare(pairs: Pairs, coordinates: Coordinates) -> _Prepared:
    forward = jax.jit(jax.vmap(coordinates.forward))
    y0, y1, centres, covered = lift(
        forward(jnp.asarray(pairs.z0, jnp.float64)),
        forward(jnp.asarray(pairs.z1, jnp.float64)),
        coordinates,
    )
    whole = tuple(i for i, c in zip(coordinates.angles, covered, strict=True) if c)
    spread = y0.std(axis=0)
    scale = np.where(spread > 0, spread, np.maximum(np.abs(y0).max(axis=0), 1e-300))
    linear, offset = _affine_model(y0, y1 - y0, scale, coordinates)
    return _Prepared(
        y0=y0, y1=y1, half=None, scale=scale, coordinates=coordinates,
        domain=covering(y0, ignore=(*coordinates.cyclic, *whole)),
        cut=centres, linear=linear, offset=offset, dt=float(pairs.dt),
    )  # fmt: skip


def _affine_model(y, difference, scale, coordinates: Coordinates):
    """The affine model of Z − z where the implicit solve starts; angles have no part in it."""
    width = y.shape[1]
    free = [i for i in range(width) if i not in coordinates.angles]
    design = np.column_stack([np.ones(len(y)), y[:, free] / scale[free]])
    solution = np.linalg.lstsq(design, difference, rcond=1e-10)[0]
    linear = np.zeros((width, width))
    linear[:, free] = solution[1:].T / scale[free]
    return linear, solution[0]


def _factor_out(prepared: _Prepared, half: Affine) -> _Prepared:
    y0 = np.asarray(jax.vmap(lambda y: half(y)[0])(jnp.asarray(prepared.y0)))
    back = half.inverse()
    y1 = np.asarray(jax.vmap(lambda y: back(y)[0])(jnp.asarray(prepared.y1)))
    linear, offset = _affine_model(y0, y1 - y0, prepared.scale, prepared.coordinates)
    return dataclasses.replace(prepared, y0=y0, y1=y1, half=half, linear=linear, offset=offset)


# Charts.


def _choose_charts(request, prepared: _Prepared, reversor, jacobians, judgements, warn):
    """Charts to try, half of the base map or None, and the judgements that stand for them.

    A base map is factored out where no chart is valid without it; with ``auto`` also where the map
    is far from the identity and the base map brings it nearer: S is smoother then.
    """
    angular = bool(prepared.coordinates.angles)
    near_identity = {n: c for n, c in CHARTS.items() if n != "type1"}
    valid = [n for n in near_identity if judgements[n].valid and judgements[n].sign > 0]
    if request == "type1" and angular:
        raise FitError(
            "chart type1 has no meaning for angles: w = (q, Q) is not periodic; use type2"
        )
    if request != "auto":
        judgement = judgements[request]
        if judgement.valid:
            if judgement.low < SAFE or judgement.sign < 0:
                warn(_about(request, judgement, "is close to singular over the data", valid))
            return [CHARTS[request]], None, judgements
        if valid:
            raise FitError(_about(request, judgement, "is singular over the data", valid))
    half = fit_half_map(
        prepared.y0, prepared.y1, prepared.scale,
        angles=prepared.coordinates.angles, reversor=reversor,
    )  # fmt: skip
    closest = max((judgements[n].low for n in valid), default=0.0)
    if half is not None and closest < _FAR:
        back = np.asarray(half.inverse().matrix)
        inner = back @ jacobians @ back
        based = {n: judge_chart(c, inner, prepared.scale) for n, c in CHARTS.items()}
        tried = ("midpoint", "type2", "type3") if request == "auto" else (request,)
        good = [n for n in tried if based[n].valid and based[n].sign > 0]
        if good and based[good[0]].low > closest:
            return [CHARTS[n] for n in good[:2]], half, based
    if valid:
        # Midpoint and one of types 2 and 3, which mirror each other.
        one_sided = [n for n in ("type2", "type3") if n in valid][:1]
        return [CHARTS[n] for n in ("midpoint", *one_sided) if n in valid], None, judgements
    if request in ("auto", "type1") and judgements["type1"].valid and not angular:
        return [TYPE1], None, judgements
    lows = ", ".join(f"{n} {j.low:.2g}" for n, j in judgements.items())
    raise FitError(
        f"no chart covers these data, with or without a base map (smallest determinants: {lows}): "
        "sample with a smaller dt, or learn a smaller region"
    )


def _about(name, judgement: ChartJudgement, what, valid) -> str:
    instead = [n for n in ("midpoint", "type2", "type3") if n in valid and n != name]
    advice = f"; use --chart {instead[0]}" if instead else ""
    return (
        f"chart {name} {what}: its determinant falls to {judgement.low:.2g} and is negative for "
        f"{100 * judgement.negative:.0f} % of the states{advice}"
    )


# Candidates.


@dataclasses.dataclass(frozen=True)
class _Rows:
    """The pairs, and which of them are for training and which are held out."""

    pairs: Pairs
    training: np.ndarray
    held_out: np.ndarray


@dataclasses.dataclass(frozen=True)
class _Rung:
    """One size of a family; ``stage`` is the largest of those fitted by the same factorisation."""

    family: Any
    stage: Any
    work: float


def _kinds(scalar, charts: Sequence[AnyChart], prepared: _Prepared, scene) -> Iterator[tuple]:
    """(chart, (kind, features, reversor)) of each ladder that applies to what was asked for."""
    features = scene.features if scene is not None else None
    high_dimensional = prepared.y0.shape[1] > 4
    for chart in charts:
        # Only the midpoint S inherits the parity.
        reversor = scene.reversor if scene is not None and chart == MIDPOINT else None
        if scalar in ("auto", "polynomial"):
            yield chart, ("polynomial", None, reversor)
        if scalar in ("auto", "features") and features is not None:
            yield chart, ("features", features, reversor)
        if scalar == "sines" or (scalar == "auto" and high_dimensional):
            yield chart, ("sines", None, None)


class _Ladder:
    """The sizes of one linear family in one chart, fitted on demand."""

    def __init__(self, prepared: _Prepared, chart, rows: _Rows, kind, features, reversor):
        self.prepared, self.chart, self.rows, self.kind = prepared, chart, rows, kind
        self.train, self.weight = _data(prepared, chart, rows.training)
        self.held, _ = _data(prepared, chart, rows.held_out)
        coordinates, dim = prepared.coordinates, prepared.y0.shape[1] // 2
        angles = tuple(a for a in coordinates.angles if a < dim)
        w = self.train[0]
        inputs = box_inputs(
            w, angles=angles, cyclic=coordinates.cyclic, features=features, reversor=reversor
        )
        if kind == "sines":
            stages: list[list[Any]] = [[Sines(inputs, count)] for count in _SINES]
        else:
            signs = variable_signs(inputs, reversor, w) if reversor is not None else None
            stages = [[Products(inputs, degree, signs) for degree in s] for s in _STAGES]
        size = len(rows.training), w.shape[1]
        stages = [[f for f in stage if _affordable(f.num_parameters, *size)] for stage in stages]
        self.rungs = [
            _Rung(f, stage[-1], counted_work(f, _NOMINAL_NEWTON))
            for stage in stages for f in stage
        ]  # fmt: skip
        self._reduced: dict[Any, least_squares.Reduced] = {}

    def fit(self, rung: _Rung, on_progress) -> Candidate:
        """Fit this rung; its stage's factorisation is made once."""
        top = rung.stage
        if top not in self._reduced:
            on_progress(f"{self.chart.name}: {top.num_parameters} terms of {top.label}")
            self._reduced = {top: least_squares.reduce(top, self.train, self.held, self.weight)}
        reduced, family = self._reduced[top], rung.family
        started = time.perf_counter()
        solved = least_squares.solve(reduced, family.num_parameters)
        seconds = reduced.seconds + time.perf_counter() - started
        # Judged through the stage's largest family, zeros added: one compilation for all its rungs.
        padding = top.num_parameters - family.num_parameters
        padded = top.unflatten(jnp.pad(solved.coefficients, (0, padding)))
        rms, bound, iterations = validation_error(
            _compose(self.prepared, self.chart, top, padded, self.rows.pairs),
            self.rows.pairs, self.rows.held_out,
        )  # fmt: skip
        params = family.unflatten(solved.coefficients)
        label = f"features {family.degree}" if self.kind == "features" else family.label
        return Candidate(
            label=label, scalar=self.kind, chart=self.chart.name,
            num_parameters=family.num_parameters, validation_rms=rms, validation_bound=bound,
            work=counted_work(family, iterations.mean()),
            microseconds_per_step=None, fit_seconds=seconds,
            compile_seconds=reduced.compile_seconds, train_rms=solved.train_rms,
            newton_iterations_max=int(iterations.max()), condition=solved.condition,
            rank=solved.rank,
            map=_compose(self.prepared, self.chart, family, params, self.rows.pairs),
        )  # fmt: skip


class _Network:
    """The one rung of a network, trained by Levenberg–Marquardt."""

    def __init__(self, prepared, chart, rows, tolerance, max_iterations, seed, checkpoints):
        self.prepared, self.chart, self.rows = prepared, chart, rows
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.seed, self.checkpoints = seed, checkpoints
        (w, wanted), self.weight = _data(prepared, chart, rows.training[:_MLP_PAIRS])
        coordinates, dim = prepared.coordinates, prepared.y0.shape[1] // 2
        angles = tuple(a for a in coordinates.angles if a < dim)
        inputs = box_inputs(w, angles=angles, cyclic=coordinates.cyclic)
        family = Mlp(inputs, _MLP_HIDDEN, _MLP_ACTIVATION, amplitude_of(w, wanted))
        self.train, self.rungs = (w, wanted), [_Rung(family, family, 0.0)]

    def fit(self, rung: _Rung, on_progress) -> Candidate:
        """Train the network."""
        family, weight = rung.family, jnp.asarray(self.weight)
        held, _ = _data(self.prepared, self.chart, self.rows.held_out)

        # u = w / weight makes the rows of ∇S weight·∇S, free of units.
        def scaled(params, u):
            return family(params, weight * u)

        def scale(data):
            return data[0] / weight[None, :], data[1] * weight[None, :]

        def report(state: LMState) -> None:
            on_progress(
                f"{self.chart.name} {family.label}: iteration {state.iteration}, "
                f"validation {state.validation_rms:.2e} of the data's spread"
            )

        theta = np.zeros(family.num_parameters)
        like = LMState(theta, theta, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0.0)  # its structure counts
        resume = self.checkpoints.latest(like) if self.checkpoints else None
        result = levenberg_marquardt(
            scaled, family.init(jax.random.key(self.seed), jnp.float64), *scale(self.train),
            validation=scale(held), max_iterations=self.max_iterations,
            target_rms=0.5 * self.tolerance / float(np.max(self.prepared.scale)),
            on_progress=report, checkpoint=_every_few_seconds(self.checkpoints),
            resume=resume[1] if resume else None,
        )  # fmt: skip
        map_ = _compose(self.prepared, self.chart, family, result.params, self.rows.pairs)
        rms, bound, iterations = validation_error(map_, self.rows.pairs, self.rows.held_out)
        return Candidate(
            label=family.label, scalar=family.name, chart=self.chart.name,
            num_parameters=family.num_parameters, validation_rms=rms, validation_bound=bound,
            work=counted_work(family, iterations.mean()),
            microseconds_per_step=None, fit_seconds=result.seconds,
            compile_seconds=result.compile_seconds, train_rms=result.train_rms,
            newton_iterations_max=int(iterations.max()), condition=None, rank=None, map=map_,
        )  # fmt: skip


def _every_few_seconds(checkpoints) -> Callable | None:
    """A checkpoint callback that saves when ten seconds have passed since it last did."""
    if checkpoints is None:
        return None
    last = time.monotonic()

    def save(state: LMState) -> None:
        nonlocal last
        if time.monotonic() - last > _CHECKPOINT_SECONDS:
            checkpoints.save(state.iteration, state)
            last = time.monotonic()

    return save


def _walk(ladders, tolerance: float, on_progress) -> tuple[list[Candidate], set[tuple[str, str]]]:
    """Climb all ladders together by rising work, until the next rung costs more than one that is
    accurate enough. A ladder is left that no longer gains, or that another keeps beating."""
    rungs = [(rung.work, i, rung) for i, ladder in enumerate(ladders) for rung in ladder.rungs]
    candidates: list[Candidate] = []
    best = [np.inf] * len(ladders)
    beaten, stalled = [0] * len(ladders), [0] * len(ladders)
    left: set[int] = set()
    cheapest = np.inf
    for work, i, rung in sorted(rungs, key=lambda r: r[:2]):
        if i in left or work >= cheapest:
            continue
        candidate = ladders[i].fit(rung, on_progress)
        candidates.append(candidate)
        on_progress(
            f"{candidate.chart} {candidate.label}: one-step error {candidate.validation_rms:.2e}"
        )
        if candidate.validation_bound <= tolerance:
            cheapest = min(cheapest, work)
            left.add(i)
        stalled[i] = stalled[i] + 1 if candidate.validation_rms > _WORTHWHILE * best[i] else 0
        if stalled[i] == _STALLED:
            left.add(i)
        best[i] = min(best[i], candidate.validation_rms)
        beaten[i] += any(_beats(rival, candidate) for rival in candidates)
        if beaten[i] == _BEATEN:
            left.add(i)
    ends = {(c.chart, c.scalar) for c in candidates}
    stalled_ladders = set()
    for chart, scalar in ends:
        errors = [c.validation_rms for c in candidates if (c.chart, c.scalar) == (chart, scalar)]
        if len(errors) > 2 and min(errors[-2:]) > _WORTHWHILE * min(errors[:-2]):
            stalled_ladders.add((chart, scalar))
    return candidates, stalled_ladders


def _beats(rival: Candidate, candidate: Candidate) -> bool:
    """Whether a rung of another ladder is better for no more work: at all for the same functions in
    another chart, by far for other functions, which may gain faster later."""
    if (rival.chart, rival.scalar) == (candidate.chart, candidate.scalar):
        return False
    margin = 1.0 if rival.scalar == candidate.scalar else 10.0
    return (
        rival.work <= 1.1 * candidate.work
        and margin * rival.validation_rms < candidate.validation_rms
    )


def _data(prepared: _Prepared, chart: AnyChart, rows):
    """(w, wanted) of these rows, and the weight that makes a row of ∇S unit-free."""
    y0, y1 = jnp.asarray(prepared.y0[rows]), jnp.asarray(prepared.y1[rows])
    scale, dim = prepared.scale, len(prepared.scale) // 2
    # ∂S/∂q is a change of p and conversely; in type 1 both are momenta.
    conjugate = np.tile(scale[dim:], 2) if chart.name == "type1" else np.roll(scale, dim)
    return (chart.point(y0, y1), chart.wanted(y0, y1, prepared.dt)), prepared.dt / conjugate


def _affordable(terms: int, num_pairs: int, width: int) -> bool:
    """Whether the data determine so many terms, and factorising them takes seconds."""
    rows = num_pairs * width
    return terms <= min(_MOST_TERMS, rows // 3) and rows * terms**2 <= _MOST_WORK


def _compose(prepared: _Prepared, chart, family, params, pairs: Pairs) -> SymplecticMap:
    generated = Generated(
        family, params, chart, prepared.dt,
        *(jnp.asarray(a) for a in (prepared.scale, prepared.linear, prepared.offset)),
    )  # fmt: skip
    half = prepared.half
    spread = np.std(np.asarray(pairs.z0), axis=0)
    return SymplecticMap(
        pieces=(generated,) if half is None else (half, generated, half),
        coordinates=prepared.coordinates,
        domain=prepared.domain,
        scale=jnp.asarray(np.where(spread > 0, spread, 1.0)),
        cut=jnp.asarray(prepared.cut),
        dt=prepared.dt,
    )


# Error, cost, choice.


def validation_error(map_: SymplecticMap, pairs: Pairs, rows) -> tuple[float, float, np.ndarray]:
    """Per-component RMS of Z_predicted − Z on these pairs, its upper 95 % bound, Newton iterations.

    In the user's coordinates, angles modulo 2π. Infinite where a lane fails. The bound is that of
    the mean square, by the central limit theorem.
    """
    z0, z1 = np.asarray(pairs.z0)[rows], np.asarray(pairs.z1)[rows]
    predicted, info = map_.step(z0)
    error = np.asarray(predicted) - z1
    if map_.coordinates.forward is CARTESIAN.forward:
        angles = list(map_.coordinates.angles)
        error[:, angles] -= TWO_PI * np.round(error[:, angles] / TWO_PI)
    square = np.mean(error**2, axis=1)
    if not np.isfinite(square).all():
        return float("inf"), float("inf"), np.asarray(info.iterations)
    bound = square.mean() + _NORMAL_95 * square.std() / np.sqrt(len(square))
    return float(np.sqrt(square.mean())), float(np.sqrt(bound)), np.asarray(info.iterations)


def counted_work(family, iterations: float) -> float:
    """Floating-point operations per predicted step: those of ∇S and of its Jacobian, counted.

    ``iterations`` Newton updates need one evaluation more than updates, and a Jacobian each.
    """
    gradient, jacobian = family.operations
    return float((1 + iterations) * gradient + iterations * jacobian)


def _timed(candidates: list[Candidate], chosen: Candidate, states) -> list[Candidate]:
    """Candidates with the measured time per trajectory-step, compilation apart.

    Of the chosen one and of a few along the front of those that no cheaper one beats: a compilation
    each is what it costs.
    """
    front, best = [], np.inf
    for candidate in sorted(candidates, key=lambda c: c.work):
        if candidate.validation_rms < best:
            front.append(candidate)
            best = candidate.validation_rms
    few = {id(front[i]) for i in np.linspace(0, len(front) - 1, _TIMED_FRONT).round().astype(int)}
    few.add(id(chosen))
    return [
        dataclasses.replace(c, microseconds_per_step=_microseconds_per_step(c.map, states))
        if id(c) in few
        else c
        for c in candidates
    ]


def _microseconds_per_step(map_: SymplecticMap, states) -> float:
    """Of a batch of 1,000 lanes, the best of five steps."""
    z = np.resize(states, (_TIMED_LANES, states.shape[1]))

    def run() -> float:
        started = time.perf_counter()
        jax.block_until_ready(map_.step(z))
        return time.perf_counter() - started

    run()
    return 1e6 * min(run() for _ in range(5)) / _TIMED_LANES


def _choose(candidates: list[Candidate], tolerance: float) -> Candidate:
    meeting = [c for c in candidates if c.validation_bound <= tolerance]
    if meeting:
        return min(meeting, key=lambda c: c.work)
    return min(candidates, key=lambda c: c.validation_rms)


def _smallest(determinant) -> float:
    determinant = np.asarray(determinant)
    return float(determinant[np.argmin(np.abs(determinant))])


def candidates_table(fit: Fit):
    """The candidates of a fit as a ``rich`` table, by rising cost; the chosen one is marked."""
    from rich.table import Table  # loaded when first used

    def number(value, form):
        return "–" if value is None else format(value, form)

    table = Table(title=f"candidates for tolerance {fit.tolerance:g} ({fit.num_pairs} pairs)")
    table.add_column("")
    table.add_column("chart")
    table.add_column("scalar")
    for head in ("parameters", "one-step error", "95 % bound", "kflop/step", "µs/step", "fit s"):
        table.add_column(head, justify="right")
    for c in fit.candidates:
        table.add_row(
            "→" if c.chosen else "", c.chart, c.label, str(c.num_parameters),
            f"{c.validation_rms:.2e}", f"{c.validation_bound:.2e}", f"{c.work / 1e3:.1f}",
            number(c.microseconds_per_step, ".2f"), f"{c.fit_seconds:.2f}",
        )  # fmt: skip
    return table
