"""Mistakes in a recording that its own data show: columns against each other, times, sensors.

Each check yields faults, one line each: what was found, and what mends it. A fault is *wrong* where
the recording cannot be learned from as it is read; the others are notes.
"""

from __future__ import annotations

from gfnn_jax.data.faults import angles, sensors, times, velocities
from gfnn_jax.data.faults.fault import WRONG, Fault
from gfnn_jax.data.traits import Traits

__all__ = ["WRONG", "Fault", "faults"]

_CHECKS = (
    sensors.constant,
    sensors.repeated,
    velocities.related,
    angles.units,
    angles.wraps,
    angles.interpolated_jumps,
    sensors.clipped,
    times.units,
    times.drifting,
    times.systems,
    sensors.missing,
    sensors.wrong,
    angles.coarse,
    times.reading,
)


def faults(traits: Traits) -> tuple[Fault, ...]:
    """All mistakes that are found, the wrong ones first."""
    found = [fault for check in _CHECKS for fault in check(traits)]
    return tuple(sorted(found, key=lambda fault: not fault.wrong))
