"""``gfnn.fit``: the cheapest exactly symplectic map that is as accurate as asked for.

check → prepare → diagnose → search → choose and conclude. A candidate is chart × family × size. Its
cost is counted (floating-point operations per predicted step), so that one seed always chooses the
same map; the measured time stands beside it.
"""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gfnn_jax.candidates.assemble import Candidate, block_of
from gfnn_jax.data.files import are_recordings, read_trajectories
from gfnn_jax.data.proposed import Proposed, as_proposed
from gfnn_jax.data.recording import ReadOptions, Recording
from gfnn_jax.dataset.runs import identified
from gfnn_jax.diagnosis.damping import NOT_SYMPLECTIC
from gfnn_jax.diagnosis.outliers import clean, looked_for_errors
from gfnn_jax.diagnosis.symmetries import symmetries_of_pairs
from gfnn_jax.errors import FitError, FitWarning, InputError, said, unexpected
from gfnn_jax.fitting import row_blocks
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.choose import Chosen, choose, stated, with_posterior, with_test_rows
from gfnn_jax.learn.conclude import conclude
from gfnn_jax.learn.fitted import STATES_MEASURED, Choice, Fit
from gfnn_jax.learn.gross_errors import without_gross_errors
from gfnn_jax.learn.noisy_sweeps import without_bias
from gfnn_jax.learn.options import OPTIONS, FitOptions, Watch, with_options
from gfnn_jax.learn.poisson import learn_poisson, other_bracket
from gfnn_jax.learn.positions import learn_positions
from gfnn_jax.learn.request import checked, diagnose_request, paid_for, structures_to_try, wrapped
from gfnn_jax.learn.searches import Searched, searched
from gfnn_jax.maps.sharded import local_devices
from gfnn_jax.models.lagrangians.recordings import fit_recording
from gfnn_jax.phase_space import POISSON, Pairs, require_x64
from gfnn_jax.threads import one_thread


@with_options
def fit(data: Any, scene: Any = None, *, options: FitOptions | None = None, **changes: Any) -> Fit:
    """Learn the law of a recording, a Lagrangian with friction and inputs; or the map of pairs of
    states, the cheapest candidate within the tolerance, else the best.

        fit = gfnn.fit("swing.csv")                       # a recording: t, theta, …
        fit = gfnn.fit(gfnn.Pairs(z0, z1, dt=0.1), tolerance=1e-8)
        print(fit.verdict, fit.law)

    data:      `Pairs`, states and images, (N, 2d) each, NumPy or JAX; those of a sequence in their
               order. Of different dt, S is a function of dt too, in the midpoint chart. With
               parameters (args) H is learned, or an S of state and parameters, which
               family="polynomial" or learn="map" ask for. Or a `Recording`, of which ``learn``
               ("auto" or "lagrangian"), ``terms``, ``friction``, ``input_hold``, ``mass``, ``loss``
               and ``hidden`` apply (`models.lagrangians.recordings`); with learn="map" the map of
               its positions is learned (`learn.positions`). Or a table (of pandas, polars, xarray,
               or arrays by name) or a file, of either kind: read as `gfnn look` proposes, with a
               warning that says how. Or times (n,), with positions x1 … xd, (n,) or (n, d), behind
               them: ``fit(t, x)``.
    scene:     lends its coordinates, features and reversor; None: plain coordinates.
    options:   a `FitOptions`, which the keywords below change; None: its defaults.
    The other keywords are those of `FitOptions` and `Watch`: ``on_progress`` and ``on_candidate``
    are called with what is being done, and with every candidate.

    Raises FitError, in one line, where the data are too few or not finite, a chart that was asked
    for is singular over them (naming the chart to use instead), or no law follows a recording: then
    it has a ``verdict``, and a ``fit`` where a law misses most of the motion. InputError where
    arrays (t, x) are no numbers or of other shapes, or positions do not move. Warns (FitWarning)
    where nothing meets the tolerance, where a chart is close to singular, where pairs contradict
    their neighbours (a few are left out), and where the pairs do not look symplectic; for a
    recording where its law did not converge, misses a drive, or has an input of no effect.
    """
    require_x64("a fit")
    watch = Watch.taken_from(changes)
    _refuse_others(changes)
    is_array = hasattr(scene, "__array__") or isinstance(scene, (list, tuple))
    scene, positions = (None, scene) if is_array else (scene, None)
    pairs, proposed = as_pairs_or_recording(data, positions)
    if proposed is not None:
        changes = {**proposed.asked, **changes}
        for line in said_of(proposed):
            watch.on_progress(line)
            warnings.warn(line, FitWarning, stacklevel=2)
    options = dataclasses.replace(options or FitOptions(), **changes)
    if POISSON in (options.structure, getattr(pairs, "structure", None)) or options.bracket:
        with one_thread():
            return learn_poisson(pairs, options, watch)
    if isinstance(pairs, Recording):
        if scene is None and hasattr(options.model, "fit_recording"):
            with one_thread():
                arm = options.model.fit_recording(pairs, watch.on_progress)
            return _told(Fit(arm.map, arm, data=pairs))
        if scene is not None or options.model is not None:
            given = "model" if scene is None else "scene"
            raise InputError(f"{given}: only for pairs of states q, p, got a recording")
        of_map = options.learn == "map"
        known = ["map" if of_map else "lagrangian"]
        options.refuse_others(known, "a recording, without momenta", InputError)
        with one_thread():
            if of_map:
                return _told(learn_positions(pairs, options, watch))
            try:
                names = ("friction", "input_hold", "mass", "loss", "hidden")
                asked = {name: getattr(options, name) for name in names}
                asked |= {"terms": tuple(options.terms), "on_progress": watch.on_progress}
                law = fit_recording(pairs, **asked)
            except FitError as error:
                if error.fit is not None:
                    error.fit = Fit(error.fit.map, error.fit, {"verdict": error.verdict}, pairs)
                raise
        return _told(Fit(law.map, law, data=pairs))
    options.refuse_others(("hamiltonian", "map"), "pairs, which are no recording")
    budget = options.budget(watch, pairs.dim)
    messages: list[str] = []

    def warn(new: Sequence[str]) -> None:
        messages.extend(new)
        for message in new:
            warnings.warn(message, FitWarning, stacklevel=3)

    with row_blocks.on_devices(_devices(options.devices)):
        request = checked(pairs, scene, options, budget, watch)
        warn(request.messages)
        taken = paid_for(identified(request.pairs), budget, options.seed)
        request = dataclasses.replace(request, pairs=taken.pairs)
        watch.on_progress(f"estimating local Jacobians from {len(taken.pairs):,} pairs")
        jumps = bool(wrapped(request.pairs, request.coordinates))
        data, about_pairs = clean(taken, request.coordinates, request.structure, jumps=jumps)
        warn(about_pairs)
        count = len(request.pairs)
        if not_looked_at := count - len(looked_for_errors(count)):
            what = f"the search for outliers in {not_looked_at:,} of {count:,} pairs"
            budget.leave_out(what, "those that the final map misses by far are found at the end")
        data = data.divided(options.seed)
        for asked, same in structures_to_try(request, data):
            request, data = asked, same
            diagnosis = diagnose_request(request, data)
            warn(diagnosis.messages)
            if any(NOT_SYMPLECTIC in message for message in diagnosis.messages):
                watch.on_progress("looking for another bracket")
                warn(other_bracket(data.pairs))
            if diagnosis.damping is not None:
                watch.on_progress(str(diagnosis.damping))
            found = searched(request, data, diagnosis)
            if found.met_by_law:
                break
        found, about_pairs = without_gross_errors(request, found)
        warn(about_pairs)
        found = without_bias(found, request)
        data = found.data
        chosen = with_posterior(choose(found, request), found)
        watch.on_progress("computing the error to state, by pairs that chose nothing")
        chosen = with_test_rows(stated(chosen, found, budget, watch.on_progress), found, budget)
        conclusion = conclude(chosen, found, request)
        warn([*conclusion.messages, *filter(None, [chosen.few])])
        symmetries = symmetries_of_pairs(found.data)
    diagnosis = found.diagnosis
    damping = diagnosis.damping if chosen.candidate.learns == "map" else None
    if damping is not None:  # a fact, not a warning
        messages.append(damping.line(data.dt))
    num_states = min(STATES_MEASURED, block_of(2 * data.dim))
    choice = Choice.of(
        budget,
        chosen.data.pairs.take(chosen.data.validation[:num_states]),
        candidates=_all_candidates(chosen, found),
        asked=request.tolerance,
        num_pairs=len(data),
        validation_pairs=data.pairs.take(data.validation),
        determinants=found.charts.determinants,
        data_defect=diagnosis.data_defect,
        base_map=bool(chosen.data.before or chosen.data.after),
        hamiltonian=found.law,
        noise=conclusion.noise,
        messages=tuple(messages),
        ended=conclusion.ended,
        compile_seconds=chosen.compile_seconds,
        model_determinant_min=_smallest_determinant(chosen),
        pairs=data.pairs,
        scene=scene,
        damping=damping,
        symmetries=symmetries,
        partial_laws=() if found.met_by_law else tuple(request.partial_laws),
        stated_by=chosen.stated_by,
        test_pairs=data.pairs.take(data.test) if len(data.test) else None,
        white=conclusion.white,
        seed=options.seed,
    )
    return Fit(chosen.candidate.map, choice)


def _told(fitted: Fit) -> Fit:
    """The fit, with warnings of its messages."""
    for message in fitted.messages:
        warnings.warn(message, FitWarning, stacklevel=4)
    return fitted


def _refuse_others(changes: Mapping[str, Any]) -> None:
    """Raises TypeError where a keyword says what columns are, or is none of `FitOptions`."""
    roles = {*ReadOptions.__annotations__} - {"angles"}
    for name in roles & {*changes}:
        raise TypeError(
            f"fit: unexpected keyword argument '{name}': it belongs to the data. Give it to "
            f"gfnn.read(path, {name}=…) or gfnn.Recording(table, {name}=…), and fit what they give"
        )
    for name in {*changes} - {*OPTIONS}:
        raise TypeError(unexpected("fit", name, [*OPTIONS]))


_OF_TABLES = ("columns", "to_dataframe")  # attributes


def as_pairs_or_recording(
    data: Any, more: Any = None, reading: Mapping[str, Any] | None = None
) -> tuple[Pairs | Recording, Proposed | None]:
    """Data that `fit` takes, as pairs or a recording; and what was proposed of files and tables.

    more: of times ``data`` (n,) the positions x1 … xd, (n,) or (n, d). reading: keywords of
    `gfnn_jax.read`.
    """
    if isinstance(data, (Pairs, Recording)):
        return data, None
    is_file = isinstance(data, (str, Path))
    if is_file and not are_recordings(data, with_roles=bool(reading)):
        return read_trajectories(Path(data)).pairs(), None
    is_table = isinstance(data, Mapping) or any(hasattr(data, n) for n in _OF_TABLES)
    if is_file or reading or is_table:
        proposed = as_proposed(data, reading or {})
        return proposed.recording, proposed
    if more is None and isinstance(data, tuple) and len(data) == 2:
        data, more = data
    if more is None:
        raise FitError(
            "expected gfnn.Pairs(z0, z1, dt), a gfnn.Recording, a table, a file, or arrays (t, x), "
            f"got {type(data).__name__}"
        )
    return _of_arrays(data, more), None


def said_of(proposed: Proposed) -> tuple[str, ...]:
    """Lines on the options that were proposed and taken."""
    if not proposed.new:
        return ()
    return (f"read as proposed: {proposed.summary.read_as}", *map(said, proposed.why))


def _of_arrays(t: Any, x: Any) -> Recording:
    """Recording of times (n,) and positions x1 … xd, (n,) or (n, d). Raises InputError where these
    are no real numbers or of other shapes."""
    try:
        times, positions = np.asarray(t), np.asarray(x)
    except ValueError as error:  # rows of different lengths
        raise InputError(f"expected arrays (t, x) of numbers: {error}") from error
    shapes = f"t {times.shape} and x {positions.shape}"
    if not (times.ndim == 1 and positions.ndim in (1, 2) and len(times) == len(positions)):
        raise InputError(f"expected times t (n,) and positions x (n,) or (n, d), got {shapes}")
    if not positions.size:
        raise InputError(f"expected samples, got none: {shapes}")
    if not {times.dtype.kind, positions.dtype.kind} <= set("fiu"):
        kinds = f"{times.dtype} and {positions.dtype}"
        raise InputError(f"expected t and x of real numbers, got {kinds}")
    if not np.isfinite(times).all():
        row = int(np.argmin(np.isfinite(times)))
        raise InputError(f"expected finite times, got {times[row]} in row {row}")
    columns = positions.reshape(len(positions), -1).T
    named = {f"x{i}": column for i, column in enumerate(columns, start=1)}
    return Recording({"t": times, **named}, positions=list(named))


def _devices(devices: int | str | None) -> tuple[Any, ...]:
    """JAX's devices of this process that were asked for; none where nobody asked."""
    try:
        return () if devices is None else local_devices(devices)
    except ValueError as error:
        raise FitError(str(error)) from error


def _all_candidates(chosen: Chosen, found: Searched) -> tuple[Candidate, ...]:
    """Every candidate by rising operations, the chosen one as its own steps showed it."""
    others = [
        e.candidate
        for e in found.found.entries
        if chosen.entry is None or e.size is not chosen.entry.size
    ]
    if found.law is not None and chosen.candidate.learns == "map":
        others.append(found.law.candidate)
    candidates = [*others, dataclasses.replace(chosen.candidate, chosen=True, map=None)]
    return tuple(sorted(candidates, key=lambda c: (c.operations, c.validation_relative)))


def _smallest_determinant(chosen: Chosen) -> float:
    """The chart's determinant over some held-out pairs, where it is closest to 0. NaN where no
    piece has a chart. NumPy."""
    map_, data = chosen.candidate.map, chosen.data
    piece = next((p for p in map_.pieces if isinstance(p, Generated)), None)
    if piece is None:
        return float("nan")
    piece = jax.tree.map(np.asarray, piece)
    rows = data.validation[:STATES_MEASURED]
    dt, args = data.given(rows)
    piece = dataclasses.replace(piece, dt=dt) if data.own_dt is not None else piece
    determinant = piece.determinant(data.y0[rows], data.y1[rows], args)
    return float(determinant[np.argmin(np.abs(determinant))])
