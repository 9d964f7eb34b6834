"""Count where a fit of pairs climbs back up: functions that a room above calls in a room below it.

Rooms stand in the order of their imports (docs/architecture.md). Data that flow one way are handed
down and returned; a function of a later room that an earlier one calls, a callback, is a climb. A
climb counts once for each pair (caller, callee), however often it is made. What a user hands in,
such as ``on_progress``, is of no room. Files are those of which a function ran, none that was only
imported.

    python benchmarks/climbs.py [--case pairs] [--show]
"""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections import Counter
from pathlib import Path

import jax
import numpy as np

import gfnn_jax as gfnn

ROOT = Path(gfnn.__file__).parent
TABLE = ROOT.parent / "docs/architecture.md"


def rooms() -> list[str]:
    """The rooms, as paths, in the order of the table of docs/architecture.md."""
    table = TABLE.read_text("utf-8").split("|---|---|")[1].split("\n\n")[0]
    first = " ".join(line.split("|")[1] for line in table.strip().splitlines())
    return re.findall(r"`([\w/]+?)/?`", first)


class Climbs:
    """A profile function that counts calls from an earlier room into a later one."""

    def __init__(self) -> None:
        self.found: Counter[tuple[str, str]] = Counter()
        self.files: Counter[str] = Counter()
        self._rooms = rooms()
        self._places: dict[str, tuple[str, int] | None] = {}

    def _place(self, file: str) -> tuple[str, int] | None:
        """(path in the package, index of its room), None outside the package."""
        if file not in self._places:
            path, place = Path(file), None
            if path.is_relative_to(ROOT):
                name = path.relative_to(ROOT).with_suffix("").as_posix()
                held = [
                    i for i, r in enumerate(self._rooms) if name == r or name.startswith(r + "/")
                ]
                place = (name, held[-1]) if held else None
            self._places[file] = place
        return self._places[file]

    def __call__(self, frame, event, arg) -> None:
        if event != "call" or (here := self._place(frame.f_code.co_filename)) is None:
            return
        if frame.f_code.co_qualname != "<module>":
            self.files[here[0]] += 1
        caller, above = frame.f_back, None
        while caller is not None and above is None:
            above = self._place(caller.f_code.co_filename)
            if above is not None and above[1] < here[1]:
                one, other = caller.f_code.co_qualname, frame.f_code.co_qualname
                self.found[f"{above[0]}:{one}", f"{here[0]}:{other}"] += 1
            caller = caller.f_back


def pendulum(count: int, noise: float = 0.0, run: int = 1) -> gfnn.Pairs:
    """Pairs of a pendulum, dt = 0.3, in sequences of ``run`` steps."""
    rng, dt, substeps = np.random.default_rng(0), 0.3, 100
    z = rng.uniform(-1, 1, (count // run, 2))
    states = [z]
    for _ in range(run):
        q, p = states[-1].T
        for _ in range(substeps):
            p = p - dt / substeps / 2 * np.sin(q)
            q = q + dt / substeps * p
            p = p - dt / substeps / 2 * np.sin(q)
        states.append(np.stack([q, p], axis=1))
    z = np.stack(states, axis=1)
    z = z + noise * rng.standard_normal(z.shape)
    one, other = z[:, :-1].reshape(-1, 2), z[:, 1:].reshape(-1, 2)
    return gfnn.Pairs(one, other, dt, run=np.repeat(np.arange(count // run), run))


def fit(pairs: gfnn.Pairs, **options) -> None:
    gfnn.fit(pairs, on_progress=lambda text: None, on_candidate=lambda found: None, **options)


CASES = {
    "pairs": lambda: fit(pendulum(300), tolerance=1e-8),
    "map": lambda: fit(pendulum(300), tolerance=1e-8, learn="map"),
    "sequences": lambda: fit(pendulum(300, 1e-3, 30)),
}


def climbs_of(case: str) -> Climbs:
    """The climbs of one fit."""
    counted = Climbs()
    sys.setprofile(counted)
    try:
        CASES[case]()
    finally:
        sys.setprofile(None)
    return counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=CASES, nargs="*", default=list(CASES))
    parser.add_argument("--show", action="store_true", help="name every climb")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for case in args.case:
        counted = climbs_of(case)
        print(f"{case}: {len(counted.found)} climbs, {len(counted.files)} files")
        if args.show:
            for (caller, callee), count in sorted(counted.found.items()):
                print(f"  {caller} -> {callee} ({count})")


if __name__ == "__main__":
    main()
