"""Jobs of ``gfnn fit``: states or recordings in, a model folder with its report out."""

import shlex
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.budget import READING, within
from gfnn_jax.data.files import iterate_pairs, read_trajectories, summary
from gfnn_jax.data.recording import parameters_of, read
from gfnn_jax.data.recording_summary import refuse_mistakes
from gfnn_jax.data.sample import read_sample
from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.evaluate.report import PAGE, About
from gfnn_jax.families.told import anything_told
from gfnn_jax.fitting import row_blocks
from gfnn_jax.jobs.output import (
    BEST,
    Output,
    Ran,
    failures_of_arithmetic,
    publish,
    refusals,
    scene_named,
    search,
    units_of,
    write,
)
from gfnn_jax.jobs.progress import Progress
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.learn.refit import help_refit, not_refitted, refit, why_not, work_of_refit
from gfnn_jax.learn.request import FEWEST
from gfnn_jax.maps.sharded import local_devices
from gfnn_jax.phase_space import POISSON, Pairs
from gfnn_jax.processes import Group, Share
from gfnn_jax.storage.outputs import atomic_folder

# A larger file, or several files, are never in memory as a whole: candidates are chosen on a sample
# of the pairs, and the chosen one is fitted to all of them chunk by chunk.
_LARGE_BYTES, _FIT_CHUNK = 2**29, 50_000
LAW_FIGURE = "law.png"
_TO_ALL = "the fit of the chosen candidate to all pairs"


def fit(
    data: Path | Sequence[Path],
    output: Output,
    *,
    dt: float | None = None,
    scene_name: str | None = None,
    group: Group | None = None,
    command: str | None = None,
    **options: Any,
) -> Ran | None:
    """Learn the map of trajectory files, and write it with its report into the model folder.

    command: that was typed, where a page is to be written too. scene_name: the scene whose
    coordinates and features are used. group: the processes that do this job, each with its own
    rows or files; all but the first return None. options: `FitOptions`; devices are those of each
    process, and a job may be resumed on others. Returns None where the
    output holds the result of this same job.
    """
    progress = output.progress
    with refusals():
        asked = FitOptions(**options)
    try:
        own = () if asked.devices is None else local_devices(asked.devices)
    except ValueError as error:
        raise InputError(f"--devices: {error}") from error
    scene = scene_named(scene_name) if scene_name is not None else None
    data = [data] if isinstance(data, Path) else list(data)
    processes, group = group, group or Group()
    pairs = _Pairs(data, dt, group.share)
    structured = asked.structure is not None or (scene is not None and scene.structure is not None)
    fewest = FEWEST if structured else None
    size = sum(path.stat().st_size for path in data if path.is_file())
    large = processes is not None or len(data) > 1 or size > _LARGE_BYTES
    started = time.perf_counter()
    if large:
        trajectories = read_sample(data, dt=dt, group=processes)
    else:
        trajectories = read_trajectories(data[0], dt=dt, fewest=fewest)
    reading = time.perf_counter() - started
    if not group.first:
        progress.status("waiting for the map of a sample")
        task = group.broadcast()
        progress.status("fitting the chosen model to the pairs of this process")
        with failures_of_arithmetic(), row_blocks.on_devices(own):
            help_refit(task, pairs, group, scene=scene)
        return None
    for text in summary(trajectories):
        progress.line(text)
    one_dt = None if np.ndim(trajectories.dt) else trajectories.dt
    job = {"command": "fit", "data": trajectories.digest, "dt": one_dt, "scene": scene_name}
    job |= asked.deciding
    if output.holds(job):
        group.broadcast({})
        return None
    with output.unfinished(job) as kept_in:
        try:
            kept = kept_in, job
            fitted = search(
                trajectories.pairs(), scene, asked, progress=progress, spent=reading, kept=kept
            )
            why, again = why_not(fitted.map), None
            if fitted.chosen.learns == "hamiltonian" and anything_told(asked.terms):
                why = "a refit keeps nothing that is told of coefficients"
            if large and not why:
                assert trajectories.sampled is not None
                seconds = work_of_refit(fitted, trajectories.sampled, reading)
                why = f"no time, it would take about {seconds:.2g} s"
                last = fitted.budget.last(_TO_ALL, READING, seconds, decides=True)
                progress.status("fitting the chosen model to all pairs")
                given: dict[str, Any] = {"test": fitted.test_pairs, "scene": scene, "group": group}
                to_all = partial(refit, fitted, pairs, fitted.validation_pairs, **given)
                with failures_of_arithmetic(), row_blocks.on_devices(own):
                    again = within(last, to_all)
            if again is None:
                group.broadcast({})
                again = not_refitted(fitted, why) if large else fitted
            fitted = again
            progress.status("the report: the posterior, and the derivative of a step")
            fitted = fitted.settled()
            named = ("source", "digest", "precision", "units")
            about = {name: getattr(trajectories, name) for name in named}
            params = {n: _range(v) for n, v in (trajectories.args or {}).items()}
            about |= {"dt": _range(trajectories.dt), "params": params}
            result = fitted.report(data=about)
        except KeyboardInterrupt as stop:
            if note := publish(kept_in / BEST, output.out):
                stop.add_note(note)
            raise
        with atomic_folder(output.out) as folder:
            write(folder, folder, fitted, result, job)
            if command is not None:
                from gfnn_jax.evaluate.page import write_page  # matplotlib, when first drawn

                write_page(fitted, folder / PAGE, about=About(command))
    return Ran(fitted, output.out, result)


class _Pairs:
    """Pairs of a process, read from the files at each iteration."""

    def __init__(self, paths: Sequence[Path], dt: float | None, share: Share):
        self.paths, self.dt, self.share = paths, dt, share

    def __iter__(self) -> Iterator[Pairs]:
        return iterate_pairs(self.paths, _FIT_CHUNK, dt=self.dt, share=self.share)


def _range(values) -> list[float]:
    return [float(np.min(values)), float(np.max(values))]


def fit_recording(
    data: Sequence[Path],
    output: Output,
    *,
    columns: dict[str, Any],
    despite: Sequence[str] = (),
    keep: bool = False,
    **options: Any,
) -> Ran:
    """Learn the law of recordings (files), with ``learn="map"`` the map of their positions, or with
    ``structure="poisson"`` the law and the bracket of states, and write it with its report into the
    model folder.

    columns: keywords of `gfnn_jax.read`, states as its positions. despite: kinds of mistakes that
    the files may show.
    keep: whether a law that misses most of the motion is written before the error is raised.
    options: `FitOptions`. Raises InputError where `gfnn look` finds a mistake, and for arrays of
    states whose columns have no names; WorkError where no law follows the recording, or the
    arithmetic fails.
    """
    progress, of_states = output.progress, options.get("structure") == POISSON
    named = not of_states or columns.get("positions") or columns.get("columns")
    for path in () if named else data:
        if Path(path).suffix in (".npy", ".npz"):
            raise InputError(
                f"{path}: expected columns with names, --states A,B. Of arrays, in Python: "
                'gfnn.fit(gfnn.Pairs(z0, z1, dt, structure="poisson"))'
            )
    with refusals():
        asked = FitOptions(**options)
    recording = read(list(data), **columns)
    if not of_states:
        refuse_mistakes(recording, despite)
    # By this record another recording is read as this one was.
    job = {"command": "fit", "data": recording.source, **asked.deciding, **units_of(recording)}
    job["reading"] = {n: columns[n] for n in ("columns", "dt", "time") if n in columns}
    is_law, names = asked.learn != "map" and not of_states, list(recording.positions)
    refused: Exception | None = None
    progress.line(f"learning from {recording.source}")
    shown = progress if asked.learn == "map" else Progress(progress.line, progress.line)
    try:
        fitted = search(recording, None, asked, progress=shown)
    except (InputError, WorkError) as error:
        if of_states:
            typed = ["gfnn", "fit", *data, "--positions", ",".join(names), "--out", output.out]
            for name in ("time", "dt"):
                typed += [f"--{name}", columns[name]] if name in columns else []
            message = str(error).replace("gfnn.fit(recording)", shlex.join(map(str, typed)))
            raise type(error)(message) from error.__cause__
        kept = getattr(error.__cause__, "fit", None) if keep else None
        if kept is None:
            raise
        fitted, refused = kept, error
    if is_law:
        result = fitted.report(source=recording.source, seed=asked.seed)
    else:
        progress.status("the report: the derivative of a step")
        fitted, own = fitted.settled(), {"states" if of_states else "positions": names}
        result = fitted.report(data={"source": recording.source, **own})
        job |= {**own, "angles": list(recording.angles)}
        job |= {"parameters": parameters_of(recording)} if of_states else {}
    with atomic_folder(output.out) as folder:
        write(folder, folder, fitted, result, job)
        if is_law:
            from gfnn_jax.evaluate.figures_of_recordings import law_figure
            from gfnn_jax.evaluate.figures_style import save  # matplotlib, when first drawn

            law: Any = fitted.found
            save(law_figure(law, recording), folder / LAW_FIGURE, dpi=110)
    if refused is not None:
        raise WorkError(f"{refused}; this law is kept in {output.out}")
    return Ran(fitted, output.out, result)
