"""Arguments of the command line: the commands, their options, and the text of ``--help``; options
about a recording's columns and rows.

JAX is not loaded.
"""

import argparse
import contextlib
import dataclasses
import difflib
import math
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from gfnn_jax.data.recording import SECONDS
from gfnn_jax.data.roles import ROLES
from gfnn_jax.errors import InputError
from gfnn_jax.exports import SUFFIXES
from gfnn_jax.learn.options import (
    COUNT,
    DEVICES,
    OPTIONS,
    POSITIVE,
    SEED,
    FitOptions,
    Kind,
    Lagrangian,
)

WORKFLOW = """\
all in one:
  gfnn FILE --open              look, learn from two thirds, forecast the rest, write the report
                                (a recording, or states q, p; `gfnn pendulum` is an example)
step by step:
  gfnn look FILE                what a recording holds; prints the command to type next
  gfnn fit FILE --out model     learn its law, or the map of states q, p
  gfnn predict model --initial FILE --num-steps 1000 --out prediction.csv
  gfnn export model --to c      for programs without Python"""
EXIT_STATUS = """\
exit status:
  0    success
  1    a failure during the work (a full disk), no law of a recording; with --strict also a missed
       tolerance
  2    bad usage or bad input, before any long work
  130  stopped by Ctrl-C
  143  stopped by SIGTERM"""
# Keywords of `gfnn_jax.read` beside roles, with one value each.
OF_COLUMNS = (
    *("angles", "degrees", "columns", "time", "time_unit", "offset", "scale", "coordinates"),
    *("start", "stop", "every"),
)
LAGRANGIAN_OPTIONS = {field.name for field in dataclasses.fields(Lagrangian)}
DISTRIBUTED_STATUS = "  134  with --distributed: another process of the job was lost"
EXAMPLES = {
    "run": """\
gfnn pendulum --open            a measured record; a file of yours stands in its place
gfnn run two-body --quick       a simulated system""",
    "look": """\
gfnn look pendulum
gfnn look swing.csv --degrees angle""",
    "fit": """\
gfnn fit swing.csv --out model                      a recording: t, theta, …
gfnn fit pairs.npz --tolerance 1e-8 --out model     states q, p: z0, z1 and dt""",
    "predict": """\
gfnn predict model --initial swing.csv --num-steps 1000 --out forecast.csv
gfnn predict model --initial start.npy --num-steps 1000 --out prediction.npz""",
    "export": """\
gfnn export model --to c        writes model.c""",
    "compare": """\
gfnn compare two-body --quick --methods hnn,gfnn""",
}
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
        raise InputError(f"{message}{self._nearest(message)} (see {self.prog} --help)")

    def _nearest(self, message: str) -> str:
        """Return the command or option that is nearest to the unknown one of a message."""
        unknown = re.match(r"(?:unrecognized arguments: |.*invalid choice: ')([\w-]+)", message)
        commands = next((a.choices for a in self._actions if isinstance(a.choices, dict)), {})
        known = {*commands, *(o for one in commands.values() for o in one._option_string_actions)}
        near = difflib.get_close_matches(unknown[1], known, n=1) if unknown else []
        return f". Did you mean {near[0]}?" if near else ""


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None) -> NoReturn:
        from gfnn_jax import __version__

        print(f"gfnn {__version__}")
        parser.exit()


@dataclasses.dataclass(frozen=True)
class _Command:
    """Adds the options of one command."""

    parser: argparse.ArgumentParser | Any

    def add(self, name: str, about: str, metavar: str | None = None, **given: Any) -> None:
        """Add an argument, or an option, with its help."""
        self.parser.add_argument(name, help=about, metavar=metavar, **given)

    def flag(self, name: str, about: str) -> None:
        """Add an option that is given or not."""
        self.parser.add_argument(name, help=about, action="store_true")

    def add_output(self) -> None:
        self.flag("--overwrite", "replace an existing output")
        self.flag("--resume", "continue an unfinished output")

    def add_fit(self, **defaults: str) -> None:
        """Add the options of `FitOptions` that the command has, in groups by the data that they are
        for. defaults: words for some."""
        both = _Command(self.parser.add_argument_group("what is learned"))
        of_law = _Command(self.parser.add_argument_group("the law of a recording"))
        of_map = _Command(self.parser.add_argument_group("the map of states q, p"))
        for field in dataclasses.fields(FitOptions):
            name, about = field.name, OPTIONS[field.name]
            if self.parser.prog not in about.commands:
                continue
            for_law = name in LAGRANGIAN_OPTIONS
            group = both if name in ("learn", "terms", "seed") else of_law if for_law else of_map
            default = defaults.get(name, "" if field.default in (None, ()) else str(field.default))
            shown = about.help.replace("%", "%%")
            shown += f" (default {default})" if default and "default" not in shown else ""
            given: dict[str, Any] = {"dest": name, "default": argparse.SUPPRESS}
            given |= {"choices": about.kind.choices} if about.kind.choices else {}
            given |= {"type": _reader(about.kind)} if about.metavar else {}
            group.add(f"--{name.replace('_', '-')}", shown, about.metavar, **given)
        of_map.flag("--strict", "exit status 1 where the tolerance is not met")
        self.add_output()


def parser() -> argparse.ArgumentParser:
    """Make the parser; what it parses has the command's name as ``command``."""
    plain: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    found = _Parser(
        prog="gfnn",
        description="Find the law of motion in data, predict with exactly symplectic maps.",
        epilog=f"{WORKFLOW}\n\n{EXIT_STATUS}\n{DISTRIBUTED_STATUS}",
        **plain,
    )
    found.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = found.add_subparsers(required=True, metavar="COMMAND")

    commands.add_parser("scenes", help="list the scenes").set_defaults(command="scenes")
    about = "list the measured records of the package"
    commands.add_parser("records", help=about).set_defaults(command="records")
    for add, about, description, epilog in (
        (
            _run,
            "a scene from reference data to figures, or a measured record to forecasts",
            "Reference data of a scene, fit, rollouts, metrics, figures, report.json. Of a "
            "measured record, or of your own recording: the law of its first two thirds, and "
            "forecasts of its last third.",
            f"{WORDS}\n\n{EXIT_STATUS}",
        ),
        (
            _look,
            "what a recording holds, before anything is learned",
            "Runs, rates, gaps, noise, friction and mistakes of a recording, found in the file "
            "itself: text of any dialect, .gz, .zip, .npz, .npy, .mat, .xlsx, .xls, .ods.",
            EXIT_STATUS,
        ),
        (
            _fit,
            "learn from your own recording, or from states q, p",
            "Learn from a recording (positions over time: a law with friction and inputs) or from "
            "states q, p (a symplectic map, or H). The columns decide which of them a file is.",
            f"{WORDS}\n\n{EXIT_STATUS}\n{DISTRIBUTED_STATUS}",
        ),
        (
            _predict,
            "predict with a learned map",
            "Predict from initial states (.npy, .npz with z0, a trajectory file), or forecast from "
            "the end of a recording.",
            f"{EXIT_STATUS}\n{DISTRIBUTED_STATUS}",
        ),
        (
            _export,
            "write a learned map for other programs",
            "One file: step, inverse and status of a learned map, in C or as StableHLO.",
            EXIT_STATUS,
        ),
        (
            _compare,
            "the same data through other methods",
            "A scene learned by GFNN and by the methods that the paper compares with.",
            EXIT_STATUS,
        ),
    ):
        name = add.__name__.removeprefix("_")
        shown = f"{textwrap.fill(description, 79)}\n\n{EXAMPLES[name]}"
        made = commands.add_parser(name, help=about, description=shown, epilog=epilog, **plain)
        made.set_defaults(command=name)
        add(_Command(made))
    return found


def _run(command: _Command) -> None:
    names = "a name that `gfnn scenes` or `gfnn records` lists, or the file of a recording"
    command.add("scene", names, "FILE|NAME")
    command.add("--out", "folder (default runs/NAME)", "DIR", type=Path)
    command.flag("--open", "open the report in a browser")
    command.flag("--quick", "of a scene: fewer pairs and rollouts")
    about = "another time step; of a file without times: the one between rows"
    command.add("--dt", about, "H", type=_positive)
    command.add_fit(tolerance="of a scene its own, close to the best attainable; else 1e-6")
    add_column_options(command.parser)
    _add_despite(command)


def _look(command: _Command) -> None:
    files = "one file or several, or a name that `gfnn records` lists"
    command.add("data", files, "FILE", type=Path, nargs="+")
    add_column_options(command.parser)
    command.add("--dt", "seconds between rows", "H", type=_positive)
    command.flag("--json", "print plain data, and draw nothing")
    command.add("--figure", "default runs/look-NAME.png, written anew", "FILE", type=Path)
    command.flag("--overwrite", "replace an existing --figure")
    command.flag("--strict", "exit status 1 where something is wrong")


def _fit(command: _Command) -> None:
    command.add("data", "one file or several, of one kind", "DATA", type=Path, nargs="+")
    command.add("--out", "folder to write", "MODEL", type=Path, required=True)
    command.add("--dt", "time step, if DATA has none", "H", type=_positive)
    scene = "scene whose coordinates and features are used; features assume the scene's units"
    command.add("--scene", scene, "NAME")
    command.add_fit()
    add_column_options(command.parser)
    _add_despite(command)
    command.flag(
        "--keep",
        "of a recording: write the law into MODEL although it misses most of the motion; the exit "
        "status is 1 all the same",
    )
    command.flag(
        "--distributed",
        "this is one of several processes, by srun, say: each reads its own rows of DATA, or its "
        "own files",
    )


def _add_despite(command: _Command) -> None:
    about = "of a recording: fit although gfnn look finds these mistakes, by kind, joined by commas"
    command.add("--despite", about, "KIND", type=_split, default=())


def _predict(command: _Command) -> None:
    command.add("model", "folder that `gfnn fit` wrote", "MODEL", type=Path)
    about = (
        "initial states; or a trajectory file, whose sequences continue from their last states; or "
        "a recording, whose runs continue from the states estimated at their ends (of a map of "
        "positions, from their last two positions)"
    )
    command.add("--initial", about, "FILE", type=Path, required=True)
    about = "of a recording: forecast from time T, in the file's unit, as if it ended there"
    command.add("--to", about, "T", dest="stop", type=finite)
    command.add("--num-steps", "steps to predict, backwards where N < 0", "N", type=_steps)
    about = "of a recording: estimate the state at its end from the last K samples"
    command.add("--estimate-from", about, "K", type=_count)
    about = "of a recording: file of the inputs after its end, at the times of the forecast"
    command.add("--inputs", about, "FILE", type=Path)
    about = "of a recording: file of what was measured after its end; prints the errors"
    command.add("--compare", about, "FILE", type=Path)
    saved = "save the state of every K-th step (default %(default)s)"
    command.add("--save-every", saved, "K", type=_count, default=1)
    about = "time step, where the model serves others than its data's: H, or S of several steps"
    command.add("--dt", about, "H", type=_positive)
    about = "file to write: .npz, or for the forecast of a recording .npz or .csv"
    command.add("--out", about, "FILE", type=Path, required=True)
    about = "maps drawn from the model's posterior: adds std and quantiles to FILE"
    command.add("--samples", about, "N", type=_count)
    about = (
        "with --samples: adds the first step at which the band of the position (two standard "
        "deviations of its distance) exceeds SIZE, in the data's unit"
    )
    command.add("--horizon", about, "SIZE", type=_positive)
    about = "what to do where a trajectory leaves the data's domain (default continue)"
    command.add("--outside", about, choices=("continue", "stop"))
    about = "number of devices that share the trajectories; on a CPU these are its cores"
    command.add("--devices", about, "all|N", type=_devices)
    command.flag("--distributed", "this is one of several processes, started by srun, say")
    command.add_output()


def _export(command: _Command) -> None:
    command.add("model", "folder that `gfnn fit` wrote", "MODEL", type=Path)
    about = (
        "c: C99 for one state at a time; of a law c-taylor: the same, "
        "js: JavaScript, jax, casadi, fmu: FMI 3.0, mjcf and urdf: a chain of links, latex; "
        "stablehlo: batches by jax.export, of any map"
    )
    command.add("--to", about, choices=SUFFIXES, required=True)
    command.add("--out", "default: beside MODEL, of its name", "FILE", type=Path)
    command.flag("--overwrite", "replace an existing output")


def _compare(command: _Command) -> None:
    command.add("scene", "a name that `gfnn scenes` lists", "SCENE")
    command.add("--methods", "default: all that apply", "A,B", type=_split, default=())
    command.add("--out", "default runs/compare-SCENE", "DIR", type=Path)
    command.flag("--quick", "fewer pairs, a cap of 2 s")
    command.add("--seed", "of the data and the trainings (default 0)", "N", type=_seed, default=0)
    cap = "most training of a method, counted in operations, 4e10 a second (default 60)"
    command.add("--cap", cap, "SECONDS", type=_positive)
    command.add_output()


def fit_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of `FitOptions` that were given, by name."""
    named = [name for name, about in OPTIONS.items() if about.commands]
    return {name: getattr(arguments, name) for name in named if hasattr(arguments, name)}


def _reader(kind: Kind) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        with contextlib.suppress(ValueError):
            if kind.holds(value := kind.read(text)):
                return value
        raise argparse.ArgumentTypeError(f"expected {kind.typed or kind.words}, got {text}")

    return read


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


_STEPS = Kind(f"{COUNT.words}, or its negative", lambda value: COUNT.holds(abs(value)), int)
_KINDS = (POSITIVE, COUNT, SEED, DEVICES, _STEPS)
_positive, _count, _seed, _devices, _steps = map(_reader, _KINDS)


# Options about columns.


def add_column_options(command: argparse.ArgumentParser) -> None:
    """Add the options; `column_options` takes them from what was parsed.

    ``--angles`` are names of columns, or whole numbers, the indices in z of canonical states.
    """
    about = "names separated by commas; without these options the file's names and data decide"
    group = _Command(command.add_argument_group("columns of a recording", about))

    def names(name: str, about: str) -> None:
        group.add(name, about, "A,B", type=_names)

    def pairs(name: str, about: str, read: Callable[[str], Any], metavar: str) -> None:
        group.add(name, about, metavar, type=read, action="extend")

    for role in ROLES:
        names(f"--{role}", f"columns of {role}")
    names("--states", "columns of states that are no positions (with --structure poisson)")
    angles = "positions with period 2π, or none; of canonical states indices in z, as 0,2"
    group.add("--angles", angles, "A,B", type=_names_or_indices)
    names("--degrees", "columns in degrees")
    names("--columns", "columns to read; names of all of them where the file has none")
    group.add("--time", "the column of times, where its name does not say so", "NAME")
    group.add("--time-unit", "of the times (default s)", choices=tuple(SECONDS))
    noise = "noise of a column, known: a number, or the column that holds it for each value"
    pairs("--std", noise, _sigmas, "NAME=σ")
    mass = "known mass, or moment of inertia, of one position, which gives L its unit"
    pairs("--mass", mass, _numbers, "NAME=m")
    names("--offset", "columns whose offset is fitted with the law")
    names("--scale", "columns whose scale is fitted with the law")
    shows = "what a sensor shows, as 'px = x0 + R*sin(theta + tilt)': its parameters are fitted"
    pairs("--observe", shows, _formula, "COLUMN=TEXT")
    events = "times at which an expression is zero, as 'gate=theta' of a photogate"
    pairs("--event", events, _formula, "COLUMN=TEXT")
    pairs("--guess", "start values of the parameters of --observe", _guesses, "NAME=X")
    moving = "names of coordinates that --observe is written in, where no column measures them"
    names("--coordinates", moving)
    group.add("--from", "rows from time T on, in the file's unit", "T", dest="start", type=finite)
    group.add("--to", "rows up to time T, in that unit", "T", dest="stop", type=finite)
    group.add("--every", "every K-th row", "K", type=_count)


def column_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """The options that were given, as keywords of `gfnn_jax.read`; ``mass`` is none of them."""
    given = {name: getattr(arguments, name) for name in (*ROLES, *OF_COLUMNS)}
    for name, option in (*((n, n) for n in ("std", "observe", "guess")), ("events", "event")):
        given[name] = dict(getattr(arguments, option) or ())
    return {name: value for name, value in given.items() if value not in (None, {})}


def names_roles(options: dict[str, Any]) -> bool:
    """Return whether keywords of `column_options` say what columns are, which makes a file a
    recording."""
    return bool({*ROLES, "columns", "coordinates", "observe", "events", "time"} & set(options))


def _names(text: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if not names or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"expected different names joined by commas, got '{text}'")
    return names


def _names_or_indices(text: str) -> tuple[str, ...] | tuple[int, ...]:
    if text == "none":
        return ()
    names = _names(text)
    if len(names) < len(text.split(",")):
        raise argparse.ArgumentTypeError(f"expected different names or indices, got '{text}'")
    return tuple(map(int, names)) if all(name.isdecimal() for name in names) else names


def _pairs(text: str) -> list[str]:
    """The parts NAME=X of NAME=X,NAME=X; names may hold commas."""
    return [part.removeprefix(",") for part in re.findall(r"[^=]*=[^,]*|.+", text)]


def _guesses(text: str, least: float = -math.inf) -> list[tuple[str, float]]:
    """Names and finite numbers, above the least."""
    pairs = []
    for part in _pairs(text):
        name, _, number = part.partition("=")
        if not (name.strip() and least < _float(number) < math.inf):
            above = f" above {least:g}" * math.isfinite(least)
            raise argparse.ArgumentTypeError(f"expected NAME=NUMBER{above}, got '{part}'")
        pairs.append((name.strip(), float(number)))
    return pairs


def _numbers(text: str) -> list[tuple[str, float]]:
    return _guesses(text, 0.0)


def _sigmas(text: str) -> list[tuple[str, float | str]]:
    """Numbers, or names of columns."""
    named = [part.partition("=") for part in _pairs(text)]
    return [
        (name.strip(), column.strip())
        if name.strip() and math.isnan(_float(column)) and column.strip()
        else _numbers(f"{name}{equals}{column}")[0]
        for name, equals, column in named
    ]


def _formula(text: str) -> list[tuple[str, str]]:
    column, _, formula = text.partition("=")
    if not (column.strip() and formula.strip()):
        raise argparse.ArgumentTypeError(f"expected COLUMN=FORMULA, got '{text}'")
    return [(column.strip(), formula.strip())]


def finite(text: str) -> float:
    """The number that an option's text is."""
    if not math.isfinite(_float(text)):
        raise argparse.ArgumentTypeError(f"expected a finite number, got '{text}'")
    return float(text)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
