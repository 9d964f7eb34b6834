"""The command line: ``gfnn scenes | run | fit | predict | compare``.

Exit status 0 on success, 2 on bad usage or bad input, 1 on a failure during the work, 130 on
Ctrl-C and 143 on SIGTERM, each but the first with one line that says why. Nothing heavy is
imported before the usage has been found good.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.storage.outputs import ensure_new

# Equal to those of `selection`, which would bring JAX; a test compares them.
CHARTS = ("auto", "type1", "type2", "type3", "midpoint")
SCALARS = ("auto", "polynomial", "features", "sines", "mlp")
_SECONDS_BETWEEN_LINES = 2.0


class _Terminated(KeyboardInterrupt):
    """SIGTERM, as clean a stop as Ctrl-C."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (without the program's name) and return the exit status."""
    try:
        arguments = _parser().parse_args(argv)
        with _sigterm(), _warnings_in_one_line():
            arguments.command(arguments)
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
        hint = "; --resume goes on with what is unfinished"
        return _fail(143 if terminated else 130, ("terminated" if terminated else "stopped") + hint)


def _fail(status: int, why: object) -> int:
    print(f"gfnn: {why}", file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="gfnn", description="Learn exactly symplectic maps, predict with them.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("scenes", help="list the scenes")
    command.set_defaults(command=_scenes)

    command = commands.add_parser(
        "run", help="a scene from reference data to figures",
        description="Reference data of a scene, fit, rollouts, metrics, figures, report.json.",
    )  # fmt: skip
    command.set_defaults(command=_run)
    command.add_argument("scene", metavar="SCENE", help="a name that `gfnn scenes` lists")
    command.add_argument("--out", type=Path, metavar="DIR", help="folder (default runs/SCENE)")
    command.add_argument("--quick", action="store_true", help="fewer pairs and rollouts")
    command.add_argument("--dt", type=_positive, metavar="H", help="another time step")
    _add_fit_options(command, "the scene's own, close to the best there is")

    command = commands.add_parser(
        "fit", help="learn the map of your own trajectories",
        description="Learn the map of a .npz, .npy or .csv file; q first.",
    )  # fmt: skip
    command.set_defaults(command=_fit)
    command.add_argument("data", type=Path, metavar="DATA")
    command.add_argument("--out", type=Path, metavar="MODEL", required=True, help="folder to write")
    command.add_argument("--dt", type=_positive, metavar="H", help="time step, if DATA has none")
    command.add_argument(
        "--scene", metavar="NAME",
        help="lends its coordinates and features; the features assume the scene's units",
    )  # fmt: skip
    command.add_argument(
        "--angles", type=_indices, default=(), metavar="0,2", help="indices in z with period 2π"
    )
    _add_fit_options(command, "1e-6")

    command = commands.add_parser(
        "predict", help="predict with a learned map",
        description="Predict from initial states (.npy, .npz with z0, or a trajectory file).",
    )  # fmt: skip
    command.set_defaults(command=_predict)
    command.add_argument("model", type=Path, metavar="MODEL", help="folder that `gfnn fit` wrote")
    command.add_argument("--initial", type=Path, metavar="FILE", required=True)
    command.add_argument("--num-steps", type=_count, metavar="N", required=True)
    command.add_argument("--save-every", type=_count, metavar="K", default=1)
    command.add_argument("--out", type=Path, metavar="FILE", required=True, help=".npz to write")
    command.add_argument(
        "--outside", choices=("continue", "stop"), default="continue",
        help="what to do where a trajectory leaves the data's domain (default %(default)s)",
    )  # fmt: skip
    _add_output_options(command)

    command = commands.add_parser(
        "compare", help="the same data through other methods",
        description="A scene learned by GFNN and by the methods that the paper compares with.",
    )  # fmt: skip
    command.set_defaults(command=_compare)
    command.add_argument("scene", metavar="SCENE", help="a name that `gfnn scenes` lists")
    command.add_argument(
        "--methods", type=_names, default=(), metavar="A,B", help="default: all that apply"
    )
    command.add_argument("--out", type=Path, metavar="DIR", help="default runs/compare-SCENE")
    command.add_argument("--quick", action="store_true", help="fewer pairs, a cap of 2 s")
    command.add_argument("--seed", type=_seed, default=0, metavar="N")
    command.add_argument(
        "--cap", type=_positive, metavar="SECONDS",
        help="most training time of a method (default 60)",
    )  # fmt: skip
    _add_output_options(command)
    return parser


def _add_fit_options(command: argparse.ArgumentParser, tolerance: str) -> None:
    command.add_argument(
        "--tolerance", type=_positive, metavar="E",
        help=f"bound on the one-step error, RMS per component (default {tolerance})",
    )  # fmt: skip
    command.add_argument("--chart", choices=CHARTS, default="auto", help="default %(default)s")
    command.add_argument(
        "--scalar", choices=SCALARS, default="auto",
        help="family of the generating function (default %(default)s)",
    )  # fmt: skip
    command.add_argument("--seed", type=_seed, default=0, metavar="N")
    _add_output_options(command)


def _add_output_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--overwrite", action="store_true", help="replace an existing output")
    command.add_argument("--resume", action="store_true", help="go on with an unfinished one")


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected a finite number > 0, got {text}")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected an integer > 0, got {text}")
    if value >= 2**53:
        raise argparse.ArgumentTypeError(f"expected an integer below 2**53, got {text}")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"expected an integer from 0 to 2**32 - 1, got {text}")
    return value


def _check_exists(path: Path) -> None:
    try:
        if path.exists():
            return
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    raise InputError(f"{path}: no such file or folder")


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _indices(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    found = tuple(int(part) for part in parts if part.strip().isdecimal())
    if len(set(found)) < len(parts):
        raise argparse.ArgumentTypeError(
            f"expected different whole numbers separated by commas, as 0,2; got '{text}'"
        )
    return found


# The commands. The heavy imports are here, after the checks that need none of them.


def _scenes(arguments: argparse.Namespace) -> None:
    from gfnn_jax.scenes import SCENES

    for name, make in SCENES.items():
        scene = make()
        print(f"{name:22} dim {scene.dim}  dt {scene.dt:<7g} {scene.purpose}")


def _run(arguments: argparse.Namespace) -> None:
    out = arguments.out or Path("runs") / arguments.scene
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    _set_up_jax()
    from gfnn_jax import pipeline

    with _progress() as say:
        ran = pipeline.run(
            arguments.scene, out=out, quick=arguments.quick, seed=arguments.seed, dt=arguments.dt,
            tolerance=arguments.tolerance, chart=arguments.chart, scalar=arguments.scalar,
            overwrite=arguments.overwrite, resume=arguments.resume, say=say,
        )  # fmt: skip
    _summarise(ran, out)


def _fit(arguments: argparse.Namespace) -> None:
    if not arguments.resume:
        ensure_new(arguments.out, arguments.overwrite, folder=True)
    _check_exists(arguments.data)
    _set_up_jax()
    from gfnn_jax import pipeline

    with _progress() as say:
        ran = pipeline.fit(
            arguments.data, out=arguments.out, dt=arguments.dt,
            tolerance=1e-6 if arguments.tolerance is None else arguments.tolerance,
            chart=arguments.chart, scalar=arguments.scalar, scene_name=arguments.scene,
            angles=arguments.angles, seed=arguments.seed, overwrite=arguments.overwrite,
            resume=arguments.resume, say=say,
        )  # fmt: skip
    _summarise(ran, arguments.out)


def _predict(arguments: argparse.Namespace) -> None:
    if not arguments.resume:
        ensure_new(arguments.out, arguments.overwrite)
    for path in (arguments.model, arguments.initial):
        _check_exists(path)
    _set_up_jax()
    from gfnn_jax import pipeline

    with _progress() as say:
        predicted = pipeline.predict(
            arguments.model, arguments.initial, num_steps=arguments.num_steps,
            save_every=arguments.save_every, out=arguments.out,
            stop_outside=arguments.outside == "stop", overwrite=arguments.overwrite,
            resume=arguments.resume, say=say,
        )  # fmt: skip
    num_lanes = len(predicted.status)
    print(f"{arguments.out}: {num_lanes} trajectories of {arguments.num_steps} steps, "
          f"{predicted.seconds:.1f} s")  # fmt: skip
    _print_status(predicted.status, predicted.left_at)


def _compare(arguments: argparse.Namespace) -> None:
    out = arguments.out or Path("runs") / f"compare-{arguments.scene}"
    if not arguments.resume:
        ensure_new(out, arguments.overwrite, folder=True)
    _set_up_jax()
    from gfnn_jax import comparison

    with _progress() as say:
        compared = comparison.compare(
            arguments.scene, methods=arguments.methods, out=out, quick=arguments.quick,
            seed=arguments.seed, cap=arguments.cap, overwrite=arguments.overwrite,
            resume=arguments.resume, say=say,
        )  # fmt: skip
    if compared is None:
        print(f"{out}: is there already, from this very job")
        return
    from rich.console import Console

    wide = Console() if sys.stdout.isatty() else Console(width=120)
    wide.print(comparison.table(compared.report))
    print(f"written to {out}")


def _summarise(ran: Any, out: Path) -> None:
    if ran is None:
        print(f"{out}: is there already, from this very job")
        return
    from rich.console import Console

    from gfnn_jax.learn.fit import candidates_table

    wide = Console() if sys.stdout.isatty() else Console(width=120)
    wide.print(candidates_table(ran.fit))
    report = ran.report
    print(
        f"{report['model']['chart']} {report['model']['label']}: one-step error "
        f"{report['fit']['validation_rms']:.2e} (tolerance {report['fit']['tolerance']:g}), "
        f"symplecticity defect {report['map']['symplecticity_defect']:.1e}"
    )
    rollout = report["rollout"]
    if rollout is not None:
        errors = ", ".join(f"{e:.1e} at step {n}" for n, e in rollout["error"].items())
        print(f"mean position error {errors}")
        if rollout["growth_exponent"] is not None:
            print(f"growth exponent {rollout['growth_exponent']:.2f}")
        counts = rollout["status_counts"].items()
        print("rollouts: " + ", ".join(f"{n} {name}" for name, n in counts if n))
    print(f"written to {out}")


def _print_status(status, left_at) -> None:
    """Lanes by status, and where those that left the domain did so."""
    from gfnn_jax.evaluate.report import status_counts

    print(", ".join(f"{n} {name}" for name, n in status_counts(status).items() if n))
    left = [lane for lane in range(len(left_at)) if left_at[lane] >= 0]
    shown = ", ".join(f"{lane} at step {left_at[lane]}" for lane in left[:10])
    if left:
        more = f", and {len(left) - 10} more" if len(left) > 10 else ""
        print(f"left the data's domain: trajectory {shown}{more}")


# The surroundings.


def _set_up_jax() -> None:
    """Float64, and compiled programs kept between runs in the user's cache folder."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(caches) / "gfnn_jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@contextlib.contextmanager
def _progress() -> Iterator[Any]:
    """``say(message)`` on standard error: a status line on a terminal, else a line now and then."""
    started = time.perf_counter()
    if not sys.stderr.isatty():
        last = -math.inf

        def say(message: str) -> None:
            nonlocal last
            now = time.perf_counter() - started
            if now > last + _SECONDS_BETWEEN_LINES:
                print(f"[{now:6.1f} s] {message}", file=sys.stderr)
                last = now

        yield say
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status("starting") as status:
        yield lambda message: status.update(escape(message))


@contextlib.contextmanager
def _sigterm() -> Iterator[None]:
    """SIGTERM stops as Ctrl-C does. Elsewhere than in the main thread nothing can be set."""

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
