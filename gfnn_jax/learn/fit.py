"""``gfnn.fit``: the cheapest exactly symplectic map that is as accurate as asked for.

data → inner coordinates → charts that cover the data → candidates from small to large → the choice.
A candidate is chart × family × size. Its error is measured, not estimated: the one-step state error
on held-out pairs, in the user's coordinates. Its cost is counted (floating-point operations per
predicted step), so that one seed always chooses the same map; the measured time stands beside it.
"""

from __future__ import annotations

import dataclasses
import io
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.learn.candidates import Candidate, Ladder, Network, Rows, kinds, refitted, timed
from gfnn_jax.generating.charts import CHARTS
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.learn.local_maps import (
    ChartJudgement,
    data_defect,
    judge_chart,
    local_jacobians,
    look_symplectic,
    odd_pairs,
    volume_change,
)
from gfnn_jax.maps.symplectic_map import Generated, SymplecticMap
from gfnn_jax.phase_space import Pairs, require_x64, split
from gfnn_jax.learn.prepare import FitError, FitWarning, choose_charts, factor_out, prepare
from gfnn_jax.scenes.scene import AroundOrbit, Scene

SCALARS = ("auto", "polynomial", "features", "sines", "mlp")
CHART_NAMES = ("auto", *CHARTS)

_VALIDATION_FRACTION, _FEWEST_VALIDATION, _MOST_VALIDATION = 0.1, 4, 2_000
_MOST_ODD = 0.05  # of the pairs may be left out as wrong
_CERTAIN = 5.0  # standard errors that make a change of volume certain
_JUDGED = 200  # states at which the chosen map's defect and determinant are taken
_OTHER_SIZE = 3.0  # by such a factor the states of one scene hardly differ; those in other units do
_ROUNDOFF = 1e-12  # of the data's spread: below it a stall is arithmetic, not noise
# A rung that gains less than this has stalled; so many in a row (a symmetric map gains nothing from
# the odd degrees), and larger families only fit noise.
_WORTHWHILE, _STALLED = 0.8, 3
# So often another ladder may be better before this one is left.
_BEATEN = 3
_NO_WORSE = 1.1  # a refit whose error is larger by this factor than that of its sample is not kept


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted map and how it was chosen.

    map: the chosen map. candidates: every candidate met on the way, by rising cost. tolerance: what
    was asked for, and ``met`` whether the chosen map's upper 95 % bound is within it. judgements:
    chart -> its determinant over the data. data_defect: how far the pairs' local Jacobians are from
    symplectic (median). based: whether a base map was factored out. noise: (2d,) standard deviation
    of each coordinate's noise that the residuals suggest where larger models stopped helping, else
    None. messages: the warnings. seconds: of it all.
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
    noise: np.ndarray | None
    messages: tuple[str, ...]

    @property
    def chosen(self) -> Candidate:
        return next(c for c in self.candidates if c.chosen)

    @property
    def met(self) -> bool:
        """Whether the chosen candidate's validation error is within the tolerance, at 95 %."""
        return self.chosen.validation_bound <= self.tolerance

    @property
    def table(self) -> str:
        """Every candidate by rising cost, the chosen one marked: text for ``print``."""
        from rich.console import Console  # loaded when first used

        text = io.StringIO()
        # Neither colours nor a notebook's own display: a string.
        plain = Console(width=120, file=text, force_terminal=False, force_jupyter=False)
        plain.print(candidates_table(self))
        return text.getvalue()


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

    pairs:     states and images, (N, 2d) each, NumPy or JAX; those of a sequence in their order.
    scene:     lends its coordinates, features and reversor; None: plain coordinates.
    tolerance: bound on the one-step state error's RMS per component, in the user's units.
    chart:     "auto" or one of type1, type2, type3, midpoint.
    scalar:    "auto", "polynomial" (Fourier in angles), "features" (the scene's), "sines", "mlp".
    angles:    without a scene, the indices of z that have period 2π.
    max_iterations: of the training of "mlp".
    checkpoints: a ``TrainingCheckpoints``, which a training saves to and goes on from.

    Raises FitError, in one line, where the data are too few or not finite or a chart that was asked
    for is singular over them (naming the chart to use instead). Warns (FitWarning) where nothing
    meets the tolerance, where a chart is close to singular, where pairs contradict their neighbours
    (a few are left out), and where the pairs do not look symplectic.
    """
    started = time.perf_counter()
    require_x64("a fit")
    _check_request(pairs, scene, tolerance, chart, scalar, angles)
    coordinates = scene.coordinates if scene else Coordinates("cartesian", angles=tuple(angles))
    messages: list[str] = []

    def warn(message: str) -> None:
        messages.append(message)
        warnings.warn(message, FitWarning, stacklevel=3)

    if scene is not None and scene.features is not None and scalar in ("auto", "features"):
        _compare_sizes(pairs, scene, warn)
    on_progress("looking at the map's local Jacobians")
    prepared = prepare(pairs, coordinates)
    first = _distinct(pairs, warn)
    if len(first) < len(pairs):
        pairs = pairs.take(first)
        prepared = prepare(pairs, coordinates)
    odd = odd_pairs(prepared.y0, prepared.y1, prepared.scale)
    if len(odd):
        few = len(odd) <= _MOST_ODD * len(pairs)
        rows = ", ".join(map(str, first[odd[:5]])) + (", …" if len(odd) > 5 else "")
        warn(
            f"{len(odd)} of {len(pairs)} pairs contradict the pairs around them (rows {rows}): "
            + ("taken for wrong, they are left out" if few else "too many to be left out")
        )
        if few:
            pairs = pairs.take(np.setdiff1d(np.arange(len(pairs)), odd))
            prepared = prepare(pairs, coordinates)
    training, held_out = _split(pairs, seed)
    jacobians, error = local_jacobians(prepared.y0, prepared.y1, prepared.scale, seed=seed)
    defect = data_defect(jacobians, prepared.scale)
    if not look_symplectic(jacobians, error, prepared.scale):
        warn(
            f"the pairs do not look symplectic: ‖MᵀJM − J‖ is about {defect:.2g}, known to within "
            f"{error:.1g} (0 for a symplectic map): are q and p in order, p momenta and not "
            "velocities, and no friction?"
        )
    judgements = {name: judge_chart(c, jacobians, prepared.scale) for name, c in CHARTS.items()}
    charts, half, judgements = choose_charts(
        chart, prepared, scene.reversor if scene else None, jacobians, judgements, warn
    )
    if half is not None:
        prepared = factor_out(prepared, half)
        on_progress("the map is far from the identity: an affine base map is factored out")

    rows = Rows(pairs, training, held_out)
    if scalar == "mlp":
        ladders: list[Any] = [
            Network(prepared, charts[0], rows, tolerance, max_iterations, seed, checkpoints)
        ]
    else:
        ladders = [Ladder(prepared, c, rows, *k) for c, k in kinds(scalar, charts, prepared, scene)]
    candidates, stalled = _walk(ladders, tolerance, on_progress)
    if not candidates:
        raise FitError(
            f"expected more pairs: {len(pairs)} are too few for the smallest model of this kind"
        )
    chosen = _choose(candidates, tolerance)
    if chosen.validation_bound > tolerance:
        warn(_not_met(chosen, tolerance))
    noise = None
    if (chosen.chart, chosen.scalar) in stalled and chosen.relative_rms > _ROUNDOFF:
        # Noise of both states enters the difference: σ √2 for a map near the identity. The fit
        # averages it over the rows that each coefficient has.
        noise = chosen.deviations / np.sqrt(2.0)
        implied = np.sqrt(2.0 * chosen.num_parameters / (training.size * 2 * pairs.dim))
        warn(
            "larger models are no more accurate: the pairs seem to carry noise of about "
            f"{', '.join(f'{sigma:.1e}' for sigma in noise)} on the coordinates in their order "
            f"(the map's own error is then about {implied:.1g} of it), or a structure that these "
            "functions cannot represent"
        )
    if noise is not None:
        y0, y1 = (y[training[:_MOST_VALIDATION]] for y in (prepared.y0, prepared.y1))
        change, error = volume_change(y0, y1 - _generated(chosen.map, y0))
        if abs(change) > _CERTAIN * error:
            warn(
                f"what is left over is no noise: phase-space volumes change by {change:.2g} "
                f"(± {error:.1g}) of themselves in a step, as by friction: no symplectic map does"
            )
    on_progress("timing the candidates")
    test = np.asarray(pairs.z0)[held_out]
    chosen_label = (chosen.chart, chosen.scalar, chosen.label)
    candidates = timed(candidates, chosen, test)
    chosen = next(c for c in candidates if (c.chart, c.scalar, c.label) == chosen_label)
    ordered = sorted(candidates, key=lambda c: (c.work, c.validation_rms))
    ordered = tuple(dataclasses.replace(c, chosen=c is chosen) for c in ordered)
    test = test[:_JUDGED]
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


def _not_met(chosen: Candidate, tolerance: float) -> str:
    found = (
        f"has a one-step error of {chosen.validation_rms:.2e} "
        f"(95 % bound {chosen.validation_bound:.2e})"
        if np.isfinite(chosen.validation_rms)
        else "leaves held-out states without an image (its step does not converge there)"
    )
    return f"no candidate meets the tolerance {tolerance:g}: the most accurate {found}"


def refit(fitted: Fit, chunks: Iterable[Pairs], held: Pairs) -> Fit:
    """The chosen map of a fit, fitted anew to more pairs than fit into memory.

    fitted: of a sample of them, by a linear family. chunks: all of the pairs. held: pairs that
    choose the ridge and judge the result; they are left out of the fit, as is what the sample's map
    misses by far. Charts, domain and noise remain those that the sample gave, and so does the map
    where all pairs give a worse one. Warns (FitWarning) of both, and where the tolerance is missed.
    """
    started = time.perf_counter()
    messages = [m for m in fitted.messages if m != _not_met(fitted.chosen, fitted.tolerance)]

    def warn(message: str) -> None:
        messages.append(message)
        warnings.warn(message, FitWarning, stacklevel=3)

    chosen, num_pairs, wrong, before = refitted(fitted.chosen, chunks, held)
    if wrong:
        warn(
            f"{wrong} of {num_pairs + wrong} pairs are far from what the others tell: taken for "
            "wrong, they are left out"
        )
    if chosen is None or not chosen.validation_rms <= _NO_WORSE * before:
        found = "no map" if chosen is None else f"a worse map ({chosen.validation_rms:.2e})"
        warn(f"all pairs give {found} than the sample ({before:.2e}), whose map is kept")
        chosen, num_pairs = fitted.chosen, fitted.num_pairs
    if chosen.validation_bound > fitted.tolerance:
        warn(_not_met(chosen, fitted.tolerance))
    candidates = tuple(chosen if c.chosen else c for c in fitted.candidates)
    test = np.asarray(held.z0)[:_JUDGED]
    return dataclasses.replace(
        fitted,
        map=chosen.map,
        candidates=candidates,
        num_pairs=num_pairs,
        symplecticity_defect=float(jnp.max(chosen.map.defect(test))),
        model_determinant_min=_smallest(chosen.map.determinant(test)),
        seconds=fitted.seconds + time.perf_counter() - started,
        messages=tuple(messages),
    )


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
    if bad or len(set(angles)) < len(angles):
        raise FitError(
            f"expected different angles among 0..{2 * pairs.dim - 1}, got {tuple(angles)}"
        )
    if not 0 < float(pairs.dt) < np.inf:
        raise FitError(f"expected a time step that is finite and above 0, got {pairs.dt}")
    if scalar == "features" and (scene is None or scene.features is None):
        raise FitError("scalar 'features' needs a scene that declares features")
    for name, z in (("z0", pairs.z0), ("z1", pairs.z1)):
        finite = np.isfinite(np.asarray(z)).all(axis=1)
        if not finite.all():
            raise FitError(
                f"expected finite states, got {int((~finite).sum())} rows of {name} with NaN or "
                f"infinity, the first is row {int(np.argmin(finite))}"
            )
    _check_number(pairs)


def _check_number(pairs: Pairs) -> None:
    if len(pairs) < 8 * pairs.dim:
        raise FitError(
            f"expected at least {8 * pairs.dim} different pairs for d = {pairs.dim}, "
            f"got {len(pairs)}"
        )


def _compare_sizes(pairs: Pairs, scene: Scene, warn) -> None:
    """Warn where the pairs are of another size than the scene's states: 1/r₁ and the like know
    where the scene's bodies are, in its units."""
    sampling = scene.sampling
    if isinstance(sampling, AroundOrbit):
        states = np.asarray(sampling.start)[None, :]
    else:
        states = np.asarray(sampling.draw(jax.random.key(0), 100))
    for name, ours, theirs in zip(
        ("positions", "momenta"), split(np.asarray(pairs.z0)), split(states), strict=True
    ):
        size, usual = (float(np.median(np.linalg.norm(x, axis=1))) for x in (ours, theirs))
        if usual > 0 and not 1 / _OTHER_SIZE < size / usual < _OTHER_SIZE:
            warn(
                f"the {name} are {size / usual:.2g} times the size of those in the scene "
                f"{scene.name}, whose features assume its own units: are the data in these?"
            )


def _distinct(pairs: Pairs, warn) -> np.ndarray:
    """The rows where a pair stands for the first time: held-out copies of training pairs would
    judge nothing."""
    rows = np.concatenate([np.asarray(pairs.z0), np.asarray(pairs.z1)], axis=1)
    first = np.sort(np.unique(rows, axis=0, return_index=True)[1])
    copies = len(pairs) - len(first)
    if copies:
        warn(f"{copies} of {len(pairs)} pairs are copies of others: each is counted once")
        _check_number(pairs.take(first))
    return first


def _split(pairs: Pairs, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows for training and rows held out, shuffled by the seed.

    Where the image of one pair is the state of the next, both are of one sequence. They share the
    noise of that state and lie on one orbit, so that a random half would judge the other too
    kindly: whole sequences are held out then. A sequence longer than all that is to be held out is
    cut into blocks in time first.
    """
    rng, count = np.random.default_rng(seed), len(pairs)
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    wanted = max(_FEWEST_VALIDATION, int(_VALIDATION_FRACTION * count))
    goes_on = np.all(z1[:-1] == z0[1:], axis=1)  # from each row to the next
    if not goes_on.any():
        order, wanted = rng.permutation(count), min(wanted, _MOST_VALIDATION)
        return order[wanted:], order[:wanted]
    block = _blocks(goes_on, wanted)
    sizes = np.bincount(block)
    order = rng.permutation(len(sizes))
    # Blocks in random order until there are rows enough: the last one may bring more.
    chosen = order[np.cumsum(sizes[order]) - sizes[order] < wanted]
    held = np.isin(block, chosen)
    # Beside a block that was cut out, a training pair would share its outermost state.
    border = goes_on & (held[1:] != held[:-1])
    apart = ~held
    apart[:-1] &= ~border
    apart[1:] &= ~border
    held_out = rng.permutation(np.flatnonzero(held))[:_MOST_VALIDATION]
    return rng.permutation(np.flatnonzero(apart)), held_out


def _blocks(goes_on: np.ndarray, wanted: int) -> np.ndarray:
    """The number of the block that each row is in: a sequence, or, of one longer than ``wanted``,
    a quarter of ``wanted`` consecutive rows."""
    starts = np.concatenate([[True], ~goes_on])
    sequence = np.cumsum(starts) - 1
    place = np.arange(len(starts)) - np.flatnonzero(starts)[sequence]
    length = np.bincount(sequence)[sequence]
    cut = (length > wanted) & (place % max(_FEWEST_VALIDATION, wanted // 4) == 0)
    return np.cumsum(starts | cut) - 1


def _walk(ladders, tolerance: float, on_progress) -> tuple[list[Candidate], set[tuple[str, str]]]:
    """Climb all ladders together by rising work, until the next rung costs more than one that is
    accurate enough. A ladder is left that no longer gains, or that another keeps beating. Only the
    tolerance is in the user's units: which ladders are left does not depend on them."""
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
        stalled[i] = stalled[i] + 1 if candidate.relative_rms > _WORTHWHILE * best[i] else 0
        if stalled[i] == _STALLED:
            left.add(i)
        best[i] = min(best[i], candidate.relative_rms)
        beaten[i] += any(_beats(rival, candidate) for rival in candidates)
        if beaten[i] == _BEATEN:
            left.add(i)
    ends = {(c.chart, c.scalar) for c in candidates}
    stalled_ladders = set()
    for chart, scalar in ends:
        errors = [c.relative_rms for c in candidates if (c.chart, c.scalar) == (chart, scalar)]
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
        rival.work <= 1.1 * candidate.work and margin * rival.relative_rms < candidate.relative_rms
    )


def _choose(candidates: list[Candidate], tolerance: float) -> Candidate:
    meeting = [c for c in candidates if c.validation_bound <= tolerance]
    if meeting:
        return min(meeting, key=lambda c: c.work)
    return min(candidates, key=lambda c: (c.relative_rms, c.train_rms))


def _generated(map_: SymplecticMap, y0) -> np.ndarray:
    """Images of prepared states (N, 2d) under what was fitted, without base map and coordinates."""
    piece = next(piece for piece in map_.pieces if isinstance(piece, Generated))
    return np.asarray(jax.jit(jax.vmap(lambda y: piece(y)[0]))(jnp.asarray(y0)))


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
