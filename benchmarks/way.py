"""The way of pairs through gfnn.fit: the files in which the objects that carry a fit are made.

A fit is handed on from file to file in a few objects (`CARRIERS`): the request, the data set, what
the data tell, the sweeps and their solutions, the law, what was found, the choice, the stated
error, the conclusion. Who reads where each is made has read the fit; every other function that runs
is asked for numbers by one of these. A file is on the way where a call of a function returned the
first object of a kind, in the order of these calls. docs/architecture.md lists them.

    python benchmarks/way.py [--case pairs]
"""

from __future__ import annotations

import argparse
import sys
import warnings

import climbs
import jax

CARRIERS = (
    "Request",
    "Dataset",
    "Diagnosis",
    "LinearSweep",
    "LeastSquaresFit",
    "Found",
    "LearnedHamiltonian",
    "Searched",
    "Chosen",
    "Stated",
    "Conclusion",
    "Fit",
)


class Way:
    """A profile function that notes which call returned the first object of each kind."""

    def __init__(self) -> None:
        self.made: dict[str, str] = {}
        self.ran: set[str] = set()

    def __call__(self, frame, event, arg) -> None:
        file = frame.f_code.co_filename
        if event not in ("call", "return") or not file.startswith(str(climbs.ROOT)):
            return
        name = file.removeprefix(f"{climbs.ROOT}/")
        if frame.f_code.co_qualname != "<module>":
            self.ran.add(name)
        kind = type(arg)
        carries = kind.__name__ in CARRIERS and kind.__module__.startswith("gfnn_jax.")
        if event == "return" and carries and frame.f_code.co_name != "__init__":
            self.made.setdefault(kind.__name__, f"{name}:{frame.f_code.co_name}")


def way_of(case: str) -> Way:
    """The way of one fit."""
    way = Way()
    sys.setprofile(way)
    try:
        climbs.CASES[case]()
    finally:
        sys.setprofile(None)
    return way


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=climbs.CASES, default="pairs")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    way = way_of(args.case)
    files = {place.split(":")[0] for place in way.made.values()}
    print(f"{args.case}: {len(files)} files on the way, {len(way.ran)} of which a function ran")
    for kind, place in way.made.items():
        print(f"  {place} -> {kind}")


if __name__ == "__main__":
    main()
