"""The command line: ``gfnn scenes | run | look | fit | predict | export | compare``.

Each exit status but 0 comes with one line that gives the reason (`cli_parser`). JAX is imported
only after the usage has been checked.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gfnn_jax import processes
from gfnn_jax.cli_columns import column_options, masses, names_roles
from gfnn_jax.cli_parser import fit_options, parser
from gfnn_jax.cli_process import (
    Terminated,
    collect_garbage_seldom,
    set_up_jax,
    stopped_by_sigterm,
    warnings_in_one_line,
)
from gfnn_jax.cli_summary import print_status, print_summary, print_table
from gfnn_jax.data.files import are_recordings
from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.jobs import progress
from gfnn_jax.storage.outputs import ensure_new
from gfnn_jax.storage.partial import unfinished_note

_TO_BEGIN = (
    "try `gfnn run two-body --quick`, or with your own pairs `gfnn fit DATA.npz --out MODEL`; "
    "`gfnn --help` says more"
)


def process() -> int:
    """Run the command line of this process, and return its exit status."""
    collect_garbage_seldom()
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (without the program's name) and return the exit status."""
    arguments, argv = argparse.Namespace(), sys.argv[1:] if argv is None else argv
    try:
        if not argv:
            raise InputError(f"expected a command, got none: {_TO_BEGIN}")
        arguments = parser().parse_args(argv)
        with stopped_by_sigterm(), warnings_in_one_line():
            _COMMANDS[arguments.command](arguments)
        return 0
    except InputError as error:
        return _fail(2, error)
    except (WorkError, MemoryError) as error:
        return _fail(1, str(error) or "out of memory")
    except BrokenPipeError:  # the reader of our output went away: `gfnn scenes | head -1`
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, lasts until exit
        return 1
    except KeyboardInterrupt as stop:
        terminated = isinstance(stop, Terminated)
        # The job's notes name what it has kept; before its work, an earlier job may have kept some.
        before = unfinished_note(arguments.out) if getattr(arguments, "out", None) else None
        kept = getattr(stop, "__notes__", [before or "nothing was kept"])
        return _fail(
            143 if terminated else 130,
            "; ".join(["terminated" if terminated else "stopped", *kept]),
        )


def _fail(status: int, why: object) -> int:
    print(f"gfnn: {why}", file=sys.stderr)
    processes.abandon(status)
    return status


def _check_exists(path: Path) -> None:
    try:
        if path.exists():
            return
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    raise InputError(f"{path}: no such file or folder")


# The commands. The heavy imports are here, after the checks that need none of them.


def _records(arguments: argparse.Namespace) -> None:
    from gfnn_jax.records import RECORDS, path

    for name, record in RECORDS.items():
        print(
            f"{name:16} {record.what}; positions {', '.join(record.positions)}\n"
            f"{'':16} {path(name)}"
        )
    print("gfnn run NAME learns the law of two thirds of a record and forecasts the last third")


def _scenes(arguments: argparse.Namespace) -> None:
    from gfnn_jax.scenes import SCENES

    for name, make in SCENES.items():
        scene = make()
        print(f"{name:22} dim {scene.dim:<3} dt {scene.dt:<9g} {scene.purpose}")


def _run(arguments: argparse.Namespace) -> None:
    from gfnn_jax.records import RECORDS

    data = Path(arguments.scene)
    out = arguments.out = arguments.out or Path("runs") / data.stem
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    if arguments.scene in RECORDS or data.is_file():
        return _run_record(arguments)
    set_up_jax()
    from gfnn_jax.jobs.run import run

    with progress.on_stderr() as shown:
        ran = run(
            arguments.scene,
            out=out,
            quick=arguments.quick,
            dt=arguments.dt,
            overwrite=arguments.overwrite,
            resume=arguments.resume,
            progress=shown,
            **fit_options(arguments),
        )
    print_summary(ran, out)
    _hold_to(arguments.strict, out / "model")


def _run_record(arguments: argparse.Namespace) -> None:
    """The law and the forecasts of a record of the package, or of a file."""
    others = tuple(name for name in (*_OF_MAPS, "learn", "dt") if name != "scene")
    _refuse_given(arguments, others, "not for the law of a recording")
    set_up_jax()
    from gfnn_jax.jobs.run_record import run_record
    from gfnn_jax.records import RECORDS, path

    data, columns = Path(arguments.scene), {}
    if arguments.scene in RECORDS:
        record, data = RECORDS[arguments.scene], path(arguments.scene)
        columns = {"positions": record.positions, "angles": record.angles}
    with progress.on_stderr() as shown:
        ran = run_record(data, out=arguments.out, columns=columns, progress=shown)
    print(ran.learned.fit.table)
    ahead = ", ".join(f"{seconds:.3g}" for seconds in ran.forecasts.ahead)
    for name, errors in ran.forecasts.median.items():
        sizes = ", ".join(f"{error:.3g}" for error in errors)
        unit = f" {ran.held_out.unit(name)}".rstrip()
        print(
            f"the last third, which no fit has seen: {name} errs by {sizes}{unit} after {ahead} "
            "s (medians)"
        )
    print(f"{ran.forecasts.within:.0%} of it lies within two standard deviations (95 % expected)")
    print(f"written to {arguments.out}")


def _look(arguments: argparse.Namespace) -> None:
    if arguments.figure is not None:
        ensure_new(arguments.figure, arguments.overwrite)
    for path in arguments.data:
        _check_exists(path)
    figure = arguments.figure
    if figure is None and not arguments.json:
        figure = Path("runs") / f"look-{arguments.data[0].stem}.png"
    options = column_options(arguments)
    given = {"dt": arguments.dt, "mass": masses(arguments)}
    options |= {name: value for name, value in given.items() if value}
    from gfnn_jax.jobs.look import look

    summary = look(arguments.data, options, figure)
    if arguments.json:
        print(json.dumps(summary.as_json(), indent=2, ensure_ascii=False))
    else:
        print_table(summary)
        print(f"figure: {figure}")
    wrong = sum(fault.wrong for fault in summary.faults)
    if arguments.strict and wrong:
        raise WorkError(f"{arguments.data[0]}: mistakes found: {wrong} (--strict)")


def _fit(arguments: argparse.Namespace) -> None:
    options = fit_options(arguments)
    if {"tolerance", "absolute_tolerance"} <= set(options):
        raise InputError("expected --tolerance or --absolute-tolerance, not both")
    if not arguments.resume:
        ensure_new(arguments.out, arguments.overwrite, folder=True)
    for path in arguments.data:
        _check_exists(path)
    columns = column_options(arguments)
    with_roles = names_roles(columns)
    if are_recordings(arguments.data, with_roles=with_roles):
        if arguments.dt is not None:
            columns["dt"] = arguments.dt
        if options.get("learn") == "map":
            return _fit_positions(arguments, columns, options)
        return _fit_law(arguments, columns, options)
    if options.get("learn") == "lagrangian":
        raise InputError(
            f"--learn lagrangian: {arguments.data[0]} is read as states q, p. If these columns are "
            "measured positions, name them: --positions A,B"
        )
    options["angles"] = _as_indices(columns)
    with contextlib.ExitStack() as stack:
        group = None
        if arguments.distributed:
            stack.enter_context(processes.watched(f"gfnn: {processes.LOST}"))
        set_up_jax(options.get("devices"))
        if arguments.distributed:
            group = processes.Group(processes.join())
        _fit_and_report(arguments, options, group)


def _fit_law(
    arguments: argparse.Namespace, columns: dict[str, Any], options: dict[str, Any]
) -> None:
    """The law of a recording."""
    _refuse_given(arguments, _OF_MAPS, "not for the law of a recording")
    set_up_jax()
    from gfnn_jax.jobs.fit_recording import fit_recording

    with progress.on_stderr() as shown:
        learned = fit_recording(
            arguments.data,
            out=arguments.out,
            columns=columns,
            mass=masses(arguments),
            despite=arguments.despite,
            progress=shown,
            **options,
        )
    print(learned.fit.table)
    print(f"written to {arguments.out}")
    inputs_ahead = " --inputs FILE" if learned.fit.gains else ""
    ahead = f" --num-steps 1000{inputs_ahead}"
    if "stop" in columns:  # what no fit has seen is in the file
        ahead, inputs_ahead = f" --to {columns['stop']:g} --compare {arguments.data[0]}", ""
    print(
        f"next: gfnn predict {arguments.out} --initial {arguments.data[0]}{ahead} --out "
        "forecast.csv"
    )
    if inputs_ahead:
        print(f"      FILE holds {', '.join(learned.fit.gains)} at the times of the forecast")


def _fit_positions(
    arguments: argparse.Namespace, columns: dict[str, Any], options: dict[str, Any]
) -> None:
    """Learn the map of a recording of positions."""
    set_up_jax()
    from gfnn_jax.jobs.fit_positions import fit_positions

    with progress.on_stderr() as shown:
        ran = fit_positions(
            arguments.data,
            out=arguments.out,
            columns=columns,
            despite=arguments.despite,
            progress=shown,
            **options,
        )
    print_summary(ran, arguments.out)
    print(
        f"next: gfnn predict {arguments.out} --initial {arguments.data[0]} --num-steps 1000 "
        "--out prediction.npz"
    )
    _hold_to(arguments.strict, arguments.out)


def _fit_and_report(
    arguments: argparse.Namespace, options: dict[str, Any], group: processes.Group | None
) -> None:
    from gfnn_jax.jobs.fit import fit

    with progress.on_stderr() as shown:
        ran = fit(
            arguments.data,
            out=arguments.out,
            dt=arguments.dt,
            scene_name=arguments.scene,
            overwrite=arguments.overwrite,
            resume=arguments.resume,
            group=group,
            progress=shown,
            **options,
        )
    if group is not None:
        processes.wait_for_all()
        if not group.first:
            sent = f"{group.sent / 1e6:.3g} MB sent"
            print(f"process {group.share.index} of {group.share.count}: {sent}")
            return
    print_summary(ran, arguments.out)
    print(
        f"next: gfnn predict {arguments.out} --initial {arguments.data[0]} --num-steps 1000 "
        "--out prediction.npz"
    )
    _hold_to(arguments.strict, arguments.out)


def _as_indices(columns: dict[str, Any]) -> tuple[int, ...]:
    """``--angles`` of canonical states. Raises InputError for names of columns."""
    angles = columns.get("angles", ())
    if not all(isinstance(i, int) for i in angles) or len(set(angles)) < len(angles):
        got = ", ".join(map(str, angles))
        raise InputError(f"--angles: expected different whole numbers, indices in z, got {got}")
    return tuple(angles)


def _hold_to(strict: bool, model: Path) -> None:
    """Raise WorkError where ``strict`` is set and the model misses the tolerance."""
    from gfnn_jax.maps.saved import record

    if strict and not record(model)["fit"]["tolerance_met"]:
        raise WorkError(f"{model}: was written, but misses the tolerance (--strict)")


# Options of `gfnn fit` that the law of a recording has not; options of `gfnn predict` for steps of
# a map, and for the forecast of a recording.
_OF_MAPS = (
    "tolerance",
    "absolute_tolerance",
    "strict",
    "family",
    "chart",
    "ensemble",
    "scene",
    "devices",
    "max_seconds",
    "max_operations",
    "resume",
    "distributed",
)
_OF_STEPS = ("dt", "samples", "horizon", "outside", "devices", "distributed", "resume")
_OF_FORECAST = ("stop", "estimate_from", "inputs", "compare")


def _refuse_given(arguments: argparse.Namespace, names: tuple[str, ...], why: str) -> None:
    """Raise InputError where one of these options was given."""
    values = {name: getattr(arguments, name, None) for name in names}
    given = [
        f"--{n.replace('_', '-')}" for n, value in values.items() if value not in (None, False)
    ]
    if given:
        raise InputError(f"{', '.join(given)}: {why}")


def _predict(arguments: argparse.Namespace) -> None:
    if not arguments.resume:
        ensure_new(arguments.out, arguments.overwrite)
    for path in (arguments.model, arguments.initial, arguments.inputs, arguments.compare):
        if path is not None:
            _check_exists(path)
    if are_recordings(arguments.initial) and (
        arguments.compare is not None or _is_law(arguments.model)
    ):  # a map of positions has no bands in its file of states: with --compare it forecasts too
        _refuse_given(arguments, _OF_STEPS, "not for the forecast of a recording")
        return _forecast(arguments)
    _refuse_given(arguments, _OF_FORECAST, "only for the forecast of a recording by its law")
    if arguments.num_steps is None:
        raise InputError("expected --num-steps: how many steps to predict")
    with contextlib.ExitStack() as stack:
        share = None
        if arguments.distributed:
            stack.enter_context(processes.watched(f"gfnn: {processes.LOST}"))
        set_up_jax(arguments.devices)
        if arguments.distributed:
            share = processes.join()
        _predict_and_report(arguments, share)


def _is_law(model: Path) -> bool:
    """Return whether the model is the law of a recording, and no map of its positions."""
    set_up_jax()
    from gfnn_jax.maps.saved import record

    return "lagrangian" in record(model)


def _forecast(arguments: argparse.Namespace) -> None:
    """Forecast from the end of a recording."""
    set_up_jax()
    from gfnn_jax.jobs.forecast import forecast_recording

    found, unit, compared = forecast_recording(
        arguments.model,
        arguments.initial,
        out=arguments.out,
        num_steps=arguments.num_steps,
        save_every=arguments.save_every,
        stop=arguments.stop,
        estimate_from=arguments.estimate_from,
        inputs=arguments.inputs,
        compare=arguments.compare,
        overwrite=arguments.overwrite,
    )
    times = [f.times[-1] for f in found.values()]
    runs = "1 run" if len(found) == 1 else f"{len(found)} runs"
    print(f"{arguments.out}: forecasts of {runs}, up to t = {max(times):g} {unit}")
    for line in (line for one in found.values() for line in one.outside):
        print(f"note: {line}")
    if compared is not None:
        for name, (rms, median, within) in compared.columns.items():
            unit = f" {compared.units[name]}" if compared.units[name] else ""
            print(
                f"{name}: RMS error {rms:.4g}{unit}, median of its size {median:.4g}{unit}; "
                f"{within:.0%} of {compared.num_samples} samples within two standard deviations "
                "(95 % expected)"
            )


def _predict_and_report(arguments: argparse.Namespace, share: processes.Share | None) -> None:
    from gfnn_jax.jobs.predict import predict

    with progress.on_stderr() as shown:
        predicted = predict(
            arguments.model,
            arguments.initial,
            num_steps=arguments.num_steps,
            save_every=arguments.save_every,
            out=arguments.out,
            dt=arguments.dt,
            samples=arguments.samples,
            horizon_size=arguments.horizon,
            stop_outside=arguments.outside == "stop",
            devices=arguments.devices,
            share=share,
            overwrite=arguments.overwrite,
            resume=arguments.resume,
            progress=shown,
        )
    num_lanes = len(predicted.status)
    if share is not None and share.index:
        print(
            f"process {share.index} of {share.count}: {num_lanes} trajectories, "
            f"{predicted.seconds:.1f} s"
        )
        return
    back = " backwards" if arguments.num_steps < 0 else ""
    print(
        f"{arguments.out}: {num_lanes} trajectories of {abs(arguments.num_steps)} steps{back}, "
        f"{predicted.seconds:.1f} s"
    )
    print_status(predicted.status, predicted.left_at)
    if predicted.horizon is not None:
        passed = predicted.horizon[predicted.horizon >= 0]
        first = f", the first at step {passed.min()}" if passed.size else ""
        print(
            f"the band of the position (2 σ) exceeds {arguments.horizon:g} in {passed.size} of "
            f"{num_lanes} trajectories{first}"
        )


def _export(arguments: argparse.Namespace) -> None:
    _check_exists(arguments.model)
    if arguments.out is not None:
        ensure_new(arguments.out, arguments.overwrite)
    set_up_jax()
    from gfnn_jax.exports.export import export

    out = export(arguments.model, arguments.to, arguments.out, overwrite=arguments.overwrite)
    print(f"{out}: {arguments.model} as {arguments.to}, {out.stat().st_size / 1e3:.0f} kB")


def _compare(arguments: argparse.Namespace) -> None:
    out = arguments.out = arguments.out or Path("runs") / f"compare-{arguments.scene}"
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    set_up_jax()
    from gfnn_jax.jobs.compare import compare
    from gfnn_jax.jobs.comparison_table import table

    with progress.on_stderr() as shown:
        compared = compare(
            arguments.scene,
            methods=arguments.methods,
            out=out,
            quick=arguments.quick,
            seed=arguments.seed,
            cap=arguments.cap,
            overwrite=arguments.overwrite,
            resume=arguments.resume,
            progress=shown,
        )
    if compared is None:
        print(f"{out}: already holds the result of this job")
        return
    print_table(table(compared.report))
    print(f"written to {out}")


_COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "scenes": _scenes,
    "records": _records,
    "run": _run,
    "look": _look,
    "fit": _fit,
    "predict": _predict,
    "export": _export,
    "compare": _compare,
}
