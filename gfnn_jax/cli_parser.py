"""Arguments of the command line: the commands, their options, and the text of ``--help``.

JAX is not loaded.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from gfnn_jax.cli_columns import add_column_options, finite
from gfnn_jax.errors import InputError
from gfnn_jax.learn.options import COUNT, DEVICES, OPTIONS, POSITIVE, SEED, FitOptions, Kind

EXPORTS = ("c", "stablehlo")  # those of `exports.export`, whose import would load JAX
EXIT_STATUS = """\
exit status:
  0    success
  1    a failure during the work (a full disk); with --strict also a missed tolerance
  2    bad usage or bad input, before any long work
  130  stopped by Ctrl-C
  143  stopped by SIGTERM"""
DISTRIBUTED_STATUS = "  134  with --distributed: another process of the job was lost"
WORDS = """\
the table of candidates:
  chart      where the generating function S is evaluated: type2 at (q, P), type3 at (Q, p),
             midpoint at ((q + Q)/2, (p + P)/2), type1 at (q, Q); capitals are one step later
             flow: the flow of H, which has no chart
  error ÷ spread
             one-step error of held-out pairs, RMS over coordinates of error divided by that
             coordinate's spread (standard deviation); after ~ an estimate, not measured by steps
  95 % bound upper bound of the error, relative as --tolerance is, or absolute as
             --absolute-tolerance; the tolerance is met where the bound is no larger
  outside    relative error at the outermost twentieth of the states, by a fit without them
  kflop/step thousand operations per step, counted; µs/step its measured time in a batch
  fit s      seconds of the fit; → marks the candidate that is chosen"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None) -> NoReturn:
        from gfnn_jax import __version__

        print(f"gfnn {__version__}")
        parser.exit()


def _with_status(options: dict[str, Any]) -> dict[str, Any]:
    """Extend the options of a command that has --distributed."""
    return {**options, "epilog": f"{options['epilog']}\n{DISTRIBUTED_STATUS}"}


def parser() -> argparse.ArgumentParser:
    """Make the parser; what it parses has the command's name as ``command``."""
    plain: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    found = _Parser(
        prog="gfnn",
        description="Learn exactly symplectic maps, predict with them.",
        epilog=f"{EXIT_STATUS}\n{DISTRIBUTED_STATUS}",
        **plain,
    )
    found.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = found.add_subparsers(required=True, metavar="COMMAND")
    fitting: dict[str, Any] = {"epilog": f"{WORDS}\n\n{EXIT_STATUS}", **plain}
    others: dict[str, Any] = {"epilog": EXIT_STATUS, **plain}

    command = commands.add_parser("scenes", help="list the scenes")
    command.set_defaults(command="scenes")
    command = commands.add_parser("records", help="list the measured records of the package")
    command.set_defaults(command="records")

    command = commands.add_parser(
        "run",
        help="a scene from reference data to figures, or a measured record to forecasts",
        description="Reference data of a scene, fit, rollouts, metrics, figures, report.json. Of a "
        "measured record, or of your own recording: the law of its first two thirds, and forecasts "
        "of its last third.",
        **fitting,
    )
    command.set_defaults(command="run")
    command.add_argument(
        "scene",
        metavar="SCENE",
        help="a name that `gfnn scenes` or `gfnn records` lists, or the file of a recording",
    )
    command.add_argument("--out", type=Path, metavar="DIR", help="folder (default runs/SCENE)")
    command.add_argument("--quick", action="store_true", help="fewer pairs and rollouts")
    command.add_argument("--dt", type=_positive, metavar="H", help="another time step")
    _add_fit_options(command, tolerance="the scene's own, close to the best attainable")

    command = commands.add_parser(
        "look",
        help="what a recording holds, before anything is learned",
        description="Runs, rates, gaps, noise, friction and mistakes of a recording, found in the "
        "file itself: .csv and other text, .npz, .npy.",
        **others,
    )
    command.set_defaults(command="look")
    command.add_argument("data", type=Path, metavar="FILE", nargs="+", help="one file or several")
    add_column_options(command)
    command.add_argument("--dt", type=_positive, metavar="H", help="seconds between rows")
    command.add_argument("--json", action="store_true", help="print plain data, and draw nothing")
    command.add_argument(
        "--figure", type=Path, metavar="FILE", help="default runs/look-NAME.png, written anew"
    )
    command.add_argument("--overwrite", action="store_true", help="replace an existing --figure")
    command.add_argument(
        "--strict", action="store_true", help="exit status 1 where something is wrong"
    )

    command = commands.add_parser(
        "fit",
        help="learn from your own recording, or from states q, p",
        description="Learn from a recording (positions over time: a law with friction and inputs) "
        "or from states q, p (a symplectic map, or H). The columns decide which of them a file is.",
        **_with_status(fitting),
    )
    command.set_defaults(command="fit")
    command.add_argument(
        "data", type=Path, metavar="DATA", nargs="+", help="one file or several, of one kind"
    )
    command.add_argument("--out", type=Path, metavar="MODEL", required=True, help="folder to write")
    command.add_argument("--dt", type=_positive, metavar="H", help="time step, if DATA has none")
    command.add_argument(
        "--scene",
        metavar="NAME",
        help="scene whose coordinates and features are used; features assume the scene's units",
    )
    _add_fit_options(command)
    add_column_options(command)
    command.add_argument(
        "--despite",
        type=_kinds,
        metavar="KIND",
        default=(),
        help="of a recording: fit although gfnn look finds these mistakes, by kind (in brackets "
        "after the word wrong), joined by commas",
    )
    command.add_argument(
        "--distributed",
        action="store_true",
        help="this is one of several processes that srun or another launcher has started: each "
        "reads its own rows of DATA, or its own files",
    )

    command = commands.add_parser(
        "predict",
        help="predict with a learned map",
        description="Predict from initial states (.npy, .npz with z0, a trajectory file), or "
        "forecast from the end of a recording.",
        **_with_status(others),
    )
    command.set_defaults(command="predict")
    command.add_argument("model", type=Path, metavar="MODEL", help="folder that `gfnn fit` wrote")
    command.add_argument(
        "--initial",
        type=Path,
        metavar="FILE",
        required=True,
        help="initial states; or a trajectory file, whose sequences continue from their last "
        "states; or a recording, whose runs continue from the states estimated at their ends (of a "
        "map of positions, from their last two positions)",
    )
    command.add_argument(
        "--to",
        dest="stop",
        type=finite,
        metavar="T",
        help="of a recording: forecast from time T, in the file's unit, as if it ended there",
    )
    command.add_argument(
        "--num-steps", type=_steps, metavar="N", help="steps to predict, backwards where N < 0"
    )
    command.add_argument(
        "--estimate-from",
        type=_count,
        metavar="K",
        help="of a recording: estimate the state at its end from the last K samples",
    )
    command.add_argument(
        "--inputs",
        type=Path,
        metavar="FILE",
        help="of a recording: file of the inputs after its end, at the times of the forecast",
    )
    command.add_argument(
        "--compare",
        type=Path,
        metavar="FILE",
        help="of a recording: file of what was measured after its end; prints the errors",
    )
    command.add_argument(
        "--save-every",
        type=_count,
        metavar="K",
        default=1,
        help="save the state of every K-th step (default %(default)s)",
    )
    command.add_argument(
        "--dt",
        type=_positive,
        metavar="H",
        help="time step, for a model that serves others than that of its data: H, or S of pairs "
        "with several time steps",
    )
    command.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        required=True,
        help="file to write: .npz, or for the forecast of a recording .npz or .csv",
    )
    command.add_argument(
        "--samples",
        type=_count,
        metavar="N",
        help="maps drawn from the model's posterior: adds std and quantiles to FILE",
    )
    command.add_argument(
        "--horizon",
        type=_positive,
        metavar="SIZE",
        help="with --samples: adds the first step at which the band of the position (two standard "
        "deviations of its distance) exceeds SIZE, in the data's unit",
    )
    command.add_argument(
        "--outside",
        choices=("continue", "stop"),
        help="what to do where a trajectory leaves the data's domain (default continue)",
    )
    command.add_argument(
        "--devices",
        type=_devices,
        metavar="all|N",
        help="number of devices that share the trajectories; on a CPU these are its cores",
    )
    command.add_argument(
        "--distributed",
        action="store_true",
        help="this is one of several processes that srun or another launcher has started",
    )
    _add_output_options(command)

    command = commands.add_parser(
        "export",
        help="write a learned map for other programs",
        description="One file: step, inverse and status of a learned map, in C or as StableHLO.",
        **others,
    )
    command.set_defaults(command="export")
    command.add_argument("model", type=Path, metavar="MODEL", help="folder that `gfnn fit` wrote")
    command.add_argument(
        "--to",
        choices=EXPORTS,
        required=True,
        help="c: C99 for one state at a time, of polynomials, Fourier harmonics and formulas; "
        "stablehlo: batches by jax.export, of any map",
    )
    command.add_argument(
        "--out", type=Path, metavar="FILE", help="default: beside MODEL, of its name"
    )
    command.add_argument("--overwrite", action="store_true", help="replace an existing output")

    command = commands.add_parser(
        "compare",
        help="the same data through other methods",
        description="A scene learned by GFNN and by the methods that the paper compares with.",
        **others,
    )
    command.set_defaults(command="compare")
    command.add_argument("scene", metavar="SCENE", help="a name that `gfnn scenes` lists")
    command.add_argument(
        "--methods", type=_names, default=(), metavar="A,B", help="default: all that apply"
    )
    command.add_argument("--out", type=Path, metavar="DIR", help="default runs/compare-SCENE")
    command.add_argument("--quick", action="store_true", help="fewer pairs, a cap of 2 s")
    command.add_argument("--seed", type=_seed, default=0, metavar="N")
    command.add_argument(
        "--cap",
        type=_positive,
        metavar="SECONDS",
        help="most training of a method, counted in operations, 4e10 a second (default 60)",
    )
    _add_output_options(command)
    return found


def _add_fit_options(command: argparse.ArgumentParser, **defaults: str) -> None:
    """Add the options of `FitOptions` that the command has. defaults: words for some of them."""
    for field in dataclasses.fields(FitOptions):
        name, about = field.name, OPTIONS[field.name]
        if command.prog not in about.commands:
            continue
        default = defaults.get(name, "" if field.default in (None, ()) else str(field.default))
        shown = about.help.replace("%", "%%")
        shown += f" (default {default})" if default and "default" not in shown else ""
        given: dict[str, Any] = {"dest": name, "default": argparse.SUPPRESS}
        given |= {"choices": about.kind.choices} if about.kind.choices else {}
        given |= {"type": _reader(about.kind), "metavar": about.metavar} if about.metavar else {}
        command.add_argument(f"--{name.replace('_', '-')}", help=shown, **given)
    command.add_argument(
        "--scalar",
        dest="family",
        choices=OPTIONS["family"].kind.choices,
        default=argparse.SUPPRESS,
        help=argparse.SUPPRESS,  # the old name of --family
    )
    command.add_argument(
        "--strict", action="store_true", help="exit status 1 where the tolerance is not met"
    )
    _add_output_options(command)


def fit_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of `FitOptions` that were given, by name."""
    named = [name for name, about in OPTIONS.items() if about.commands]
    return {name: getattr(arguments, name) for name in named if hasattr(arguments, name)}


def _add_output_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--overwrite", action="store_true", help="replace an existing output")
    command.add_argument("--resume", action="store_true", help="continue an unfinished output")


def _reader(kind: Kind) -> Callable[[str], Any]:
    """Make the reader of an option of this kind."""

    def read(text: str) -> Any:
        with contextlib.suppress(ValueError):
            if kind.holds(value := kind.read(text)):
                return value
        raise argparse.ArgumentTypeError(f"expected {kind.typed or kind.words}, got {text}")

    return read


def _kinds(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


_STEPS = Kind(
    f"{COUNT.words}, or its negative",
    lambda value: COUNT.holds(abs(value)),
    int,
)
_positive, _count, _seed, _devices, _steps = (
    _reader(kind) for kind in (POSITIVE, COUNT, SEED, DEVICES, _STEPS)
)


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))
