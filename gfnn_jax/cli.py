"""The command line: ``gfnn scenes | run | look | fit | predict | export | compare``.

Each exit status but 0 comes with one line that gives the reason (`cli_parser`). JAX is imported
only after the usage has been checked.
"""

import argparse
import atexit
import contextlib
import dataclasses
import difflib
import gc
import json
import os
import shlex
import signal
import sys
import warnings
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gfnn_jax import cli_summary, processes
from gfnn_jax.cli_parser import OF_COLUMNS, column_options, fit_options, names_roles, parser
from gfnn_jax.compiling import enable_compile_cache
from gfnn_jax.data.files import are_recordings
from gfnn_jax.data.roles import ROLES
from gfnn_jax.errors import InputError, WorkError, read_in_a_shell
from gfnn_jax.jobs import progress
from gfnn_jax.storage.outputs import ensure_new, signals_handled, unfinished_note

_TO_BEGIN = "try `gfnn double_pendulum`, or your own `gfnn FILE`; `gfnn --help` says more"


def process() -> int:
    """Run the command line of this process, and return its exit status.

    20,000 new objects, not 700, start a search for reference cycles, and the exit none: imports and
    traces make millions of objects that live on, and searches among them take half a second of the
    five of ``gfnn run two-body --quick``.
    """
    gc.set_threshold(20_000, 20)
    atexit.register(gc.freeze)
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (without the program's name) and return the exit status."""
    with read_in_a_shell():
        return _status_of(sys.argv[1:] if argv is None else argv)


def _status_of(argv: Sequence[str]) -> int:
    arguments = argparse.Namespace()
    try:
        if not argv:
            raise InputError(f"expected a command, got none: {_TO_BEGIN}")
        arguments = parser().parse_args(["run", *argv] if _is_data(argv[0]) else argv)
        arguments.typed = shlex.join(["gfnn", *argv])
        with signals_handled((signal.SIGTERM,), _terminated), warnings_in_one_line():
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
        # The job's notes name what it has kept; before its work, an earlier job may have kept some.
        before = unfinished_note(arguments.out) if getattr(arguments, "out", None) else None
        kept = getattr(stop, "__notes__", [before or "nothing was kept"])
        status, how = (143, "terminated") if isinstance(stop, Terminated) else (130, "stopped")
        return _fail(status, "; ".join([how, *kept]))


def _is_data(first: str) -> bool:
    """Return whether this is a file, or looks like the name of one, or a record: they stand for
    ``gfnn run`` with them."""
    from gfnn_jax.records import RECORDS

    looks_so = bool(Path(first).suffix) or os.sep in first
    named = first in RECORDS or Path(first).is_file() or looks_so
    return first not in _COMMANDS and not first.startswith("-") and named


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


def _unknown(name: str, known: Sequence[str]) -> InputError:
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"Did you mean {near[0]}? " if near else ""
    listed = "`gfnn records` and `gfnn scenes` list what comes with the package"
    return InputError(f"{name}: no such file, record or scene. {hint}{listed}")


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


@contextlib.contextmanager
def _output(arguments: argparse.Namespace, devices: int | str | None = None) -> Iterator[Any]:
    """Set JAX up, and open the output of a job with its progress on standard error."""
    set_up_jax(devices)
    from gfnn_jax.jobs.output import Output

    resume = getattr(arguments, "resume", False)
    with progress.on_stderr() as shown:
        yield Output(arguments.out, arguments.overwrite, resume, shown)


@contextlib.contextmanager
def _processes(arguments: argparse.Namespace) -> Iterator[Callable[[], processes.Share | None]]:
    """Watch the other processes of a distributed job; what is yielded joins them."""
    if not arguments.distributed:
        yield lambda: None
        return
    with processes.watched(f"gfnn: {processes.LOST}"):
        yield processes.join


def _run(arguments: argparse.Namespace) -> None:
    from gfnn_jax.records import RECORDS
    from gfnn_jax.scenes import SCENES

    data = Path(arguments.scene)
    out = arguments.out = arguments.out or Path("runs") / data.stem
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    if arguments.scene in RECORDS or data.is_file():
        return _run_file(arguments)
    if arguments.scene not in SCENES:
        raise _unknown(arguments.scene, [*RECORDS, *SCENES])
    _refuse_given(arguments, _OF_FILES, "only for files and records, not for a scene")
    with _output(arguments) as output:
        from gfnn_jax.jobs.run import run

        quick, options = arguments.quick, fit_options(arguments)
        ran = run(arguments.scene, output, quick=quick, dt=arguments.dt, **options)
    cli_summary.print_summary(ran, out)
    _show(arguments)
    _hold_to(arguments.strict, out / "model")


def _run_file(arguments: argparse.Namespace) -> None:
    """The law and the forecasts of a record of the package or of a file; the map of states q, p."""
    data, columns = _record_named(Path(arguments.scene))
    given = column_options(arguments)
    if not are_recordings(data, with_roles=names_roles(given)):
        options: dict[str, Any] = fit_options(arguments) | {"angles": _as_indices(given)}
        with _output(arguments) as output:
            from gfnn_jax.jobs.fit import fit

            fitted = fit([data], output, dt=arguments.dt, command=arguments.typed, **options)
        cli_summary.print_summary(fitted, arguments.out)
        return _show(arguments)
    others = tuple(name for name in (*_OF_MAPS, "learn", "quick") if name != "scene")
    _refuse_given(arguments, others, "not for the law of a recording")
    columns |= given | ({"dt": arguments.dt} if arguments.dt is not None else {})
    options = fit_options(arguments)
    options |= {"mass": dict(arguments.mass or ()), "despite": arguments.despite}
    with _output(arguments) as output:
        from gfnn_jax.jobs.run_record import run_record

        try:
            ran = run_record(data, output, columns=columns, command=arguments.typed, **options)
        finally:
            _show(arguments)
    cli_summary.print_record(ran, arguments.out)


def _show(arguments: argparse.Namespace) -> None:
    page = arguments.out / "report.html"
    if arguments.open and page.is_file():
        webbrowser.open(page.resolve().as_uri())


def _record_named(path: Path) -> tuple[Path, dict[str, Any]]:
    """(file, columns) of a record of the package; of any other path itself."""
    from gfnn_jax.records import RECORDS
    from gfnn_jax.records import path as path_of

    record = None if path.exists() else RECORDS.get(str(path))
    if record is None:
        return path, {}
    return path_of(str(path)), {"positions": record.positions, "angles": record.angles}


def _look(arguments: argparse.Namespace) -> None:
    from gfnn_jax.records import RECORDS

    if arguments.figure is not None:
        ensure_new(arguments.figure, arguments.overwrite)
    named = [_record_named(path) for path in arguments.data]
    paths = [path for path, _ in named]
    for path in paths:
        if not path.suffix and not path.exists():
            raise _unknown(str(path), [*RECORDS])
        _check_exists(path)
    figure = arguments.figure
    if figure is None and not arguments.json:
        figure = Path("runs") / f"look-{paths[0].stem}.png"
    options = column_options(arguments)
    given = {"dt": arguments.dt, "mass": dict(arguments.mass or ())}
    options |= {name: value for name, value in given.items() if value}
    if len(named) == 1:
        options = named[0][1] | options
    from gfnn_jax.jobs.look import look

    summary = look(paths, options, figure)
    if arguments.json:
        print(json.dumps(summary.as_json(), indent=2, ensure_ascii=False))
    else:
        cli_summary.print_table(summary)
        print(f"{summary.next}: {summary.command}\nfigure: {figure}")
    wrong = sum(fault.wrong for fault in summary.faults)
    if arguments.strict and wrong:
        raise WorkError(f"{paths[0]}: mistakes found: {wrong} (--strict)")


def _fit(arguments: argparse.Namespace) -> None:
    options = fit_options(arguments)
    if {"tolerance", "absolute_tolerance"} <= set(options):
        raise InputError("expected --tolerance or --absolute-tolerance, not both")
    if not arguments.resume:
        ensure_new(arguments.out, arguments.overwrite, folder=True)
    for path in arguments.data:
        _check_exists(path)
    columns = column_options(arguments)
    if arguments.states:
        columns["positions"], options["structure"] = arguments.states, "poisson"
    of_states = options.get("structure") == "poisson"
    if of_states or are_recordings(arguments.data, with_roles=names_roles(columns)):
        return _fit_recording(arguments, columns, options)
    if options.get("learn") == "lagrangian":
        raise InputError(
            f"--learn lagrangian: {arguments.data[0]} is read as states q, p. If its columns are "
            "measured positions, name them: --positions A,B"
        )
    options["angles"] = _as_indices(columns)
    with _processes(arguments) as join:
        with _output(arguments, options.get("devices")) as output:
            share = join()
            group = None if share is None else processes.Group(share)
            from gfnn_jax.jobs.fit import fit

            given = {"dt": arguments.dt, "scene_name": arguments.scene, "group": group}
            ran = fit(arguments.data, output, **given, **options)
        if group is not None:
            processes.wait_for_all()
            if not group.first:
                sent = f"{group.sent / 1e6:.3g} MB sent"
                print(f"process {group.share.index} of {group.share.count}: {sent}")
                return
    _print_fitted(arguments, ran)


def _print_fitted(arguments: argparse.Namespace, ran: Any) -> None:
    cli_summary.print_summary(ran, arguments.out)
    _print_next(arguments, " --num-steps 1000 --out prediction.npz")
    _hold_to(arguments.strict, arguments.out)


def _print_next(arguments: argparse.Namespace, options: str) -> None:
    print(f"next: gfnn predict {arguments.out} --initial {arguments.data[0]}{options}")


def _fit_recording(
    arguments: argparse.Namespace, columns: dict[str, Any], options: dict[str, Any]
) -> None:
    """Learn the law of a recording, the map of its positions, or the bracket of states."""
    is_law = options.get("learn") != "map" and options.get("structure") != "poisson"
    if arguments.dt is not None:
        columns["dt"] = arguments.dt
    if is_law:
        _refuse_given(arguments, _OF_MAPS, "not for the law of a recording")
        options["mass"] = dict(arguments.mass or ())
    with _output(arguments) as output:
        from gfnn_jax.jobs.fit import fit_recording

        kept = {"despite": arguments.despite, "keep": arguments.keep}
        given = {"columns": columns, **kept}
        ran: Any = fit_recording(arguments.data, output, **given, **options)
    if not is_law:
        return _print_fitted(arguments, ran)
    gains = ran.fit.gains
    cli_summary.print_law(ran.fit)
    print(f"written to {arguments.out}")
    if "stop" in columns:  # what no fit has seen is in the file
        compared = f" --to {columns['stop']:g} --compare {arguments.data[0]}"
        return _print_next(arguments, f"{compared} --out forecast.csv")
    inputs = " --inputs FILE" if gains else ""
    _print_next(arguments, f" --num-steps 1000{inputs} --out forecast.csv")
    if inputs:
        print(f"      FILE holds {', '.join(gains)} at the times of the forecast")


def _as_indices(columns: dict[str, Any]) -> tuple[int, ...]:
    """``--angles`` of canonical states. Raises InputError for names of columns."""
    angles = columns.get("angles", ())
    if not all(isinstance(i, int) for i in angles) or len(set(angles)) < len(angles):
        got = ", ".join(map(str, angles))
        raise InputError(f"--angles: expected different whole numbers, indices in z, got {got}")
    return tuple(angles)


def _hold_to(strict: bool, model: Path) -> None:
    from gfnn_jax.maps.saved import record

    if strict and not record(model)["fit"]["tolerance_met"]:
        raise WorkError(f"{model}: was written, but misses the tolerance (--strict)")


# Options of `gfnn run` for files; of `gfnn fit` that no law of a recording has; of `gfnn predict`
# for steps of a map, and for the forecast of a recording.
_OF_FILES = ("despite", *ROLES, *OF_COLUMNS, "std", "observe", "event", "guess", "mass")
_OF_MAPS = (
    *("tolerance", "absolute_tolerance", "strict", "family", "chart", "ensemble", "scene"),
    *("devices", "max_seconds", "max_operations", "resume", "distributed"),
)
_OF_STEPS = ("dt", "samples", "horizon", "outside", "devices", "distributed", "resume")
_OF_FORECAST = ("stop", "estimate_from", "inputs", "compare")


def _refuse_given(arguments: argparse.Namespace, names: tuple[str, ...], why: str) -> None:
    values = {name: getattr(arguments, name, None) for name in names}
    given = [f"--{n.replace('_', '-')}" for n, v in values.items() if v not in (None, False, ())]
    if given:
        raise InputError(f"{', '.join(given)}: {why}")


def _taken(kind: Any, arguments: argparse.Namespace) -> Any:
    """A request whose fields are the options of their names."""
    names = {field.name for field in dataclasses.fields(kind)}
    return kind(**{name: value for name, value in vars(arguments).items() if name in names})


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
    with _processes(arguments) as join, _output(arguments, arguments.devices) as output:
        share = join()
        from gfnn_jax.jobs.predict import Steps, predict

        asked = _taken(Steps, arguments)
        predicted = predict(arguments.model, arguments.initial, output, asked, share)
    if share is not None and share.index:
        lanes = f"{len(predicted.status)} trajectories, {predicted.seconds:.1f} s"
        print(f"process {share.index} of {share.count}: {lanes}")
        return
    cli_summary.print_predicted(predicted, asked, arguments.out)


def _is_law(model: Path) -> bool:
    """Return whether the model is the law of a recording, and no map of its positions."""
    set_up_jax()
    from gfnn_jax.maps.saved import record

    return "lagrangian" in record(model)


def _forecast(arguments: argparse.Namespace) -> None:
    set_up_jax()
    from gfnn_jax.jobs.forecast import Ahead, forecast_recording
    from gfnn_jax.jobs.output import Output

    output = Output(arguments.out, arguments.overwrite)
    asked = _taken(Ahead, arguments)
    found = forecast_recording(arguments.model, arguments.initial, output, asked)
    cli_summary.print_forecasts(found, arguments.out)


def _export(arguments: argparse.Namespace) -> None:
    _check_exists(arguments.model)
    if arguments.out is not None:
        ensure_new(arguments.out, arguments.overwrite)
    set_up_jax()
    from gfnn_jax.exports.export import default_out, export
    from gfnn_jax.learn.saved import load

    model, to = arguments.model, arguments.to
    out = arguments.out or default_out(model, to)
    own: Any = load(model) if to == "latex" else model
    out = export(own, to, out, overwrite=arguments.overwrite)
    print(f"{out}: {arguments.model} as {arguments.to}, {out.stat().st_size / 1e3:.0f} kB")


def _compare(arguments: argparse.Namespace) -> None:
    out = arguments.out = arguments.out or Path("runs") / f"compare-{arguments.scene}"
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    with _output(arguments) as output:
        from gfnn_jax.jobs.compare import compare

        names = ("methods", "quick", "seed", "cap")
        options = {name: getattr(arguments, name) for name in names}
        compared = compare(arguments.scene, output, **options)
    if compared is None:
        print(f"{out}: already holds the result of this job")
        return
    cli_summary.print_table(cli_summary.comparison_table(compared))
    print(f"written to {out}")


_ALL = (_scenes, _records, _run, _look, _fit, _predict, _export, _compare)
_COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {f.__name__[1:]: f for f in _ALL}


class Terminated(KeyboardInterrupt):
    """Stop by SIGTERM, as clean as one by Ctrl-C."""


def _terminated(*_: Any) -> NoReturn:
    raise Terminated


def set_up_jax(devices: int | str | None = None) -> None:
    """Switch on float64, and keep compiled programs in the user's cache folder.

    devices: number of devices that a CPU shall have, or "all" its cores; by default it has one.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    is_set = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if devices is not None and not is_set:
        with contextlib.suppress(RuntimeError):  # in a session that has its devices already
            most = _cores() if isinstance(devices, str) else min(devices, _cores())
            jax.config.update("jax_num_cpu_devices", most)
    enable_compile_cache()


def _cores() -> int:
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return here or 1


@contextlib.contextmanager
def warnings_in_one_line() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)

        def show(message, category, filename, lineno, file=None, line=None):
            print(f"gfnn: warning: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield
