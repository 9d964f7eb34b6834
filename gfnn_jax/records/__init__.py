"""Measured records that come with the package, with their sources.

    recording = gfnn.read(gfnn.records.path("double_pendulum"), angles=["theta1", "theta2"])

arm2 is of K. Kaheman, U. Fasel, J. J. Bramburger, B. Strom, J. N. Kutz and S. L. Brunton, *The
experimental multi-arm pendulum on a cart*, arXiv 2205.06231 (MIT licence), free swings cut into
runs, every tenth of its samples. The others are of M. Schmidt and H. Lipson, *Distilling free-form
natural laws from experimental data*, Science 324 (2009) 81, supplementary data; their velocities
were estimated by the authors.
"""

from pathlib import Path
from typing import NamedTuple

from gfnn_jax.errors import InputError


class Record(NamedTuple):
    """A record: what it is of; its positions, with units; which of them are angles."""

    what: str
    positions: tuple[str, ...]
    angles: tuple[str, ...]


RECORDS = {
    "pendulum": Record("a pendulum with light friction, gaps", ("theta",), ("theta",)),
    "air_track": Record("a cart between two springs on an air track", ("x",), ()),
    "two_carts": Record("two carts between three springs", ("x1", "x2"), ()),
    "double_pendulum": Record(
        "a double pendulum, chaotic, with gaps of up to 0.19 s; angles from hanging down",
        ("theta1", "theta2"),
        ("theta1", "theta2"),
    ),
    "arm2": Record(
        "an arm of two links on bearings, free swings in runs; angles from the upright",
        ("theta1", "theta2"),
        ("theta1", "theta2"),
    ),
}


def path(name: str) -> Path:
    """The record's CSV file. Raises InputError for a name that is none."""
    if name not in RECORDS:
        raise InputError(f"expected a record among {', '.join(RECORDS)}; got '{name}'")
    return Path(__file__).parent / f"{name}.csv"
