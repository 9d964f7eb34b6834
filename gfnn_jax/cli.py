"""The command line: ``gfnn scenes | run | look | fit | predict | export | compare``.

Each exit status but 0 comes with one line that gives the reason (`cli_parser`). JAX is imported
only after the usage has been checked.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gfnn_jax import processes
from gfnn_jax.cli_columns import column_options, masses, names_roles
from gfnn_jax.cli_parser import fit_options, parser
from gfnn_jax.compiling import enable_compile_cache
from gfnn_jax.data.kinds import are_recordings
from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.jobs import progress
from gfnn_jax.storage.outputs import ensure_new
from gfnn_jax.storage.partial import unfinished_note

_FEW_TERMS = 15  # of a law with noise that is shown as H
_MEANS = {
    "left the domain": " (extrapolated from there)", "not converged": " (NaN from there)",
    "non-finite": " (NaN from there)",
}  # fmt: skip


class _Terminated(KeyboardInterrupt):
    """Stop by SIGTERM, as clean as one by Ctrl-C."""


_TO_BEGIN = (
    "try `gfnn run two-body --quick`, or with your own pairs `gfnn fit DATA.npz --out MODEL`; "
    "`gfnn --help` says more"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (without the program's name) and return the exit status."""
    arguments, argv = argparse.Namespace(), sys.argv[1:] if argv is None else argv
    try:
        if not argv:
            raise InputError(f"expected a command, got none: {_TO_BEGIN}")
        arguments = parser().parse_args(argv)
        with _sigterm(), _warnings_in_one_line():
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
        terminated = isinstance(stop, _Terminated)
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
        options = f"--positions {','.join(record.positions)}"
        options += f" --angles {','.join(record.angles)}" if record.angles else ""
        print(f"{name:16} {record.what}\n{'':16} gfnn fit {path(name)} {options} --out {name}")


def _scenes(arguments: argparse.Namespace) -> None:
    from gfnn_jax.scenes import SCENES

    for name, make in SCENES.items():
        scene = make()
        print(f"{name:22} dim {scene.dim:<3} dt {scene.dt:<9g} {scene.purpose}")


def _run(arguments: argparse.Namespace) -> None:
    out = arguments.out = arguments.out or Path("runs") / arguments.scene
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    _set_up_jax()
    from gfnn_jax.jobs.run import run

    with progress.on_stderr() as shown:
        ran = run(
            arguments.scene, out=out, quick=arguments.quick, dt=arguments.dt,
            overwrite=arguments.overwrite, resume=arguments.resume, progress=shown,
            **fit_options(arguments),
        )  # fmt: skip
    _summarise(ran, out)
    _hold_to(arguments.strict, out / "model")


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
        _print_table(summary)
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
        _set_up_jax(options.get("devices"))
        if arguments.distributed:
            group = processes.Group(processes.join())
        _fit_and_report(arguments, options, group)


def _fit_law(
    arguments: argparse.Namespace, columns: dict[str, Any], options: dict[str, Any]
) -> None:
    """The law of a recording."""
    _refuse_given(arguments, _OF_MAPS, "not for the law of a recording")
    _set_up_jax()
    from gfnn_jax.jobs.fit_recording import fit_recording

    with progress.on_stderr() as shown:
        learned = fit_recording(
            arguments.data, out=arguments.out, columns=columns, mass=masses(arguments),
            despite=arguments.despite, progress=shown, **options,
        )  # fmt: skip
    print(learned.fit.table)
    print(f"written to {arguments.out}")
    told = " --inputs FILE" if learned.fit.gains else ""
    print(f"next: gfnn predict {arguments.out} --initial {arguments.data[0]} --num-steps 1000"
          f"{told} --out forecast.csv")  # fmt: skip
    if told:
        print(f"      FILE holds {', '.join(learned.fit.gains)} at the times of the forecast")


def _fit_positions(
    arguments: argparse.Namespace, columns: dict[str, Any], options: dict[str, Any]
) -> None:
    """Learn the map of a recording of positions."""
    _set_up_jax()
    from gfnn_jax.jobs.fit_positions import fit_positions

    with progress.on_stderr() as shown:
        ran = fit_positions(
            arguments.data, out=arguments.out, columns=columns, despite=arguments.despite,
            progress=shown, **options,
        )  # fmt: skip
    _summarise(ran, arguments.out)
    print(f"next: gfnn predict {arguments.out} --initial {arguments.data[0]} --num-steps 1000 "
          "--out prediction.npz")  # fmt: skip
    _hold_to(arguments.strict, arguments.out)


def _fit_and_report(
    arguments: argparse.Namespace, options: dict[str, Any], group: processes.Group | None
) -> None:
    from gfnn_jax.jobs.fit import fit

    with progress.on_stderr() as shown:
        ran = fit(
            arguments.data, out=arguments.out, dt=arguments.dt, scene_name=arguments.scene,
            overwrite=arguments.overwrite, resume=arguments.resume, group=group, progress=shown,
            **options,
        )  # fmt: skip
    if group is not None:
        processes.wait_for_all()
        if not group.first:
            sent = f"{group.sent / 1e6:.3g} MB sent"
            print(f"process {group.share.index} of {group.share.count}: {sent}")
            return
    _summarise(ran, arguments.out)
    print(f"next: gfnn predict {arguments.out} --initial {arguments.data[0]} --num-steps 1000 "
          "--out prediction.npz")  # fmt: skip
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
    "tolerance", "absolute_tolerance", "strict", "family", "chart", "ensemble", "scene", "devices",
    "max_seconds", "max_operations", "resume", "distributed",
)  # fmt: skip
_OF_STEPS = ("dt", "samples", "horizon", "outside", "devices", "distributed", "resume")
_OF_FORECAST = ("estimate_from", "inputs", "compare")


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
        _set_up_jax(arguments.devices)
        if arguments.distributed:
            share = processes.join()
        _predict_and_report(arguments, share)


def _is_law(model: Path) -> bool:
    """Return whether the model is the law of a recording, and no map of its positions."""
    _set_up_jax()
    from gfnn_jax.maps.saved import record

    return "lagrangian" in record(model)


def _forecast(arguments: argparse.Namespace) -> None:
    """Forecast from the end of a recording."""
    _set_up_jax()
    from gfnn_jax.jobs.forecast import forecast_recording

    found, judged = forecast_recording(
        arguments.model, arguments.initial, out=arguments.out, num_steps=arguments.num_steps,
        save_every=arguments.save_every, estimate_from=arguments.estimate_from,
        inputs=arguments.inputs, compare=arguments.compare, overwrite=arguments.overwrite,
    )  # fmt: skip
    times = [f.times[-1] for f in found.values()]
    runs = "1 run" if len(found) == 1 else f"{len(found)} runs"
    print(f"{arguments.out}: forecasts of {runs}, up to t = {max(times):g} in the unit of the file")
    for line in (line for one in found.values() for line in one.outside):
        print(f"note: {line}")
    if judged is not None:
        for name, (rms, median, within) in judged.columns.items():
            print(f"{name}: RMS error {rms:.4g}, median of its size {median:.4g}, in its unit; "
                  f"{within:.0%} of {judged.num_samples} samples within two standard deviations "
                  "(95 % expected)")  # fmt: skip


def _predict_and_report(arguments: argparse.Namespace, share: processes.Share | None) -> None:
    from gfnn_jax.jobs.predict import predict

    with progress.on_stderr() as shown:
        predicted = predict(
            arguments.model, arguments.initial, num_steps=arguments.num_steps,
            save_every=arguments.save_every, out=arguments.out, dt=arguments.dt,
            samples=arguments.samples, horizon_size=arguments.horizon,
            stop_outside=arguments.outside == "stop", devices=arguments.devices, share=share,
            overwrite=arguments.overwrite, resume=arguments.resume, progress=shown,
        )  # fmt: skip
    num_lanes = len(predicted.status)
    if share is not None and share.index:
        print(f"process {share.index} of {share.count}: {num_lanes} trajectories, "
              f"{predicted.seconds:.1f} s")  # fmt: skip
        return
    back = " backwards" if arguments.num_steps < 0 else ""
    print(f"{arguments.out}: {num_lanes} trajectories of {abs(arguments.num_steps)} steps{back}, "
          f"{predicted.seconds:.1f} s")  # fmt: skip
    _print_status(predicted.status, predicted.left_at)
    if predicted.horizon is not None:
        passed = predicted.horizon[predicted.horizon >= 0]
        first = f", the first at step {passed.min()}" if passed.size else ""
        print(f"the band of the position (2 σ) exceeds {arguments.horizon:g} in {passed.size} of "
              f"{num_lanes} trajectories{first}")  # fmt: skip


def _export(arguments: argparse.Namespace) -> None:
    _check_exists(arguments.model)
    if arguments.out is not None:
        ensure_new(arguments.out, arguments.overwrite)
    _set_up_jax()
    from gfnn_jax.exports.export import export

    out = export(arguments.model, arguments.to, arguments.out, overwrite=arguments.overwrite)
    print(f"{out}: {arguments.model} as {arguments.to}, {out.stat().st_size / 1e3:.0f} kB")


def _compare(arguments: argparse.Namespace) -> None:
    out = arguments.out = arguments.out or Path("runs") / f"compare-{arguments.scene}"
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    _set_up_jax()
    from gfnn_jax.jobs.compare import compare
    from gfnn_jax.jobs.comparison_table import table

    with progress.on_stderr() as shown:
        compared = compare(
            arguments.scene, methods=arguments.methods, out=out, quick=arguments.quick,
            seed=arguments.seed, cap=arguments.cap, overwrite=arguments.overwrite,
            resume=arguments.resume, progress=shown,
        )  # fmt: skip
    if compared is None:
        print(f"{out}: already holds the result of this job")
        return
    _print_table(table(compared.report))
    print(f"written to {out}")


_COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "scenes": _scenes, "records": _records, "run": _run, "look": _look, "fit": _fit,
    "predict": _predict, "export": _export, "compare": _compare,
}  # fmt: skip


def law_line(report: dict[str, Any]) -> str:
    """Line about the law. One that misses the tolerance is no H, unless it has few terms and noise
    explains the miss."""
    fit, law = report["fit"], report["hamiltonian"]
    chosen = report["model"]["learns"] == "hamiltonian"
    noisy = report["data"]["noise"] is not None and len(law["terms"]) <= _FEW_TERMS
    if chosen and not fit["tolerance_met"] and not noisy:
        return (
            f"best partial law: H of {len(law['terms'])} terms, one-step error "
            f"{fit['validation_relative']:.1e} of the spread (report.json)"
        )
    return f"{'' if chosen else 'found, and dearer per step than the map: '}H = {law['formula']}"


def error_line(fit: dict[str, Any]) -> str:
    """Line about the one-step error, its bound, and the tolerance that this bound is held to."""
    unit = "of the spread" if fit["tolerance_is_relative"] else "in the data's units"
    return (
        f"one-step error {fit['validation_rms']:.2e} in the data's units, "
        f"{fit['validation_relative']:.2e} of the spread; 95 % bound "
        f"{fit['validation_bound']:.2e}, tolerance {fit['tolerance']:g} {unit}: "
        f"{'met' if fit['tolerance_met'] else 'not met'}"
    )


def _summarise(ran: Any, out: Path) -> None:
    if ran is None:
        print(f"{out}: already holds the result of this job")
        return
    from gfnn_jax.learn.fitted import candidates_table

    _print_table(candidates_table(ran.fit))
    report = ran.report
    fit, defect = report["fit"], report["map"]["symplecticity_defect"]
    print(f"{report['model']['chart']} {report['model']['label']}: {error_line(fit)}")
    print(f"symplecticity defect {'not computed (no time)' if defect is None else f'{defect:.1e}'}")
    if report["hamiltonian"] is not None:
        print(law_line(report))
        for note in report["hamiltonian"]["notes"]:
            print(note)
        for loss in report["hamiltonian"]["friction"]:
            print(f"friction {loss['term']}: {loss['coefficient']:.6g} ± {loss['std']:.1g}")
    if ran.fit.damping is not None:
        print(ran.fit.damping.told(float(ran.fit.map.dt)))
    told = report["hamiltonian"] is not None and report["hamiltonian"]["symmetries"]
    if ran.fit.symmetries and not told:
        print(f"symmetries of the pairs: {'; '.join(map(str, ran.fit.symmetries))}")
    if not fit["tolerance_met"]:
        for law in ran.fit.partial_laws:
            print(law)
    print(f"the search ended: {fit['ended']}")
    rollout = report["rollout"]
    if rollout is not None:
        errors = ", ".join(f"{e:.1e} at step {n}" for n, e in rollout["error"].items())
        print(f"mean position error {errors}")
        if rollout["growth_exponent"] is not None:
            print(f"growth of the error: as steps to the power {rollout['growth_exponent']:.2f}")
        counts = rollout["status_counts"].items()
        print("rollouts: " + ", ".join(f"{n} {name}" for name, n in counts if n))
    print(_holds(ran.fit))
    print(f"written to {out}")


def _holds(fit: Any) -> str:
    """Describe where the map may be trusted, in one sentence."""
    parts = ["valid where the data are: gfnn predict names the trajectories that leave them"]
    outside = fit.chosen.outside
    if outside is not None and math.isfinite(outside):
        parts.append(
            f"a fit without the outermost 5 % of the states errs there by {outside:.1e} of the "
            "spread"
        )
    if fit.chosen.learns == "hamiltonian":
        parts.append("other time steps: gfnn predict --dt")
    return "; ".join(parts)


def _print_table(table: Any) -> None:
    from rich.console import Console

    wide = Console() if sys.stdout.isatty() else Console(width=132)
    wide.print(table)


def _print_status(status, left_at) -> None:
    """Print the number of lanes by status, and the steps at which lanes left the domain."""
    from gfnn_jax.evaluate.report import status_counts

    counts = status_counts(status).items()
    print(", ".join(f"{n} {name}{_MEANS.get(name, '')}" for name, n in counts if n))
    left = [lane for lane in range(len(left_at)) if left_at[lane] >= 0]
    shown = ", ".join(f"{lane} at step {left_at[lane]}" for lane in left[:10])
    if left:
        more = f", and {len(left) - 10} more" if len(left) > 10 else ""
        print(f"left the data's domain: trajectory {shown}{more}")


# The process: JAX, signals, warnings.


def _set_up_jax(devices: int | str | None = None) -> None:
    """Switch on float64, and keep compiled programs in the user's cache folder.

    devices: number of devices that a CPU shall have, or "all" its cores; by default it has one.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    told = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if devices is not None and not told:
        with contextlib.suppress(RuntimeError):  # in a session that has its devices already
            most = _cores() if isinstance(devices, str) else min(devices, _cores())
            jax.config.update("jax_num_cpu_devices", most)
    enable_compile_cache()


def _cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def _sigterm() -> Iterator[None]:
    """Let SIGTERM stop the work as Ctrl-C does. Nothing is done outside the main thread."""

    def stop(*_):
        raise _Terminated

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)

        def show(message, category, filename, lineno, file=None, line=None):
            print(f"gfnn: warning: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield
