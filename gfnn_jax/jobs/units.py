"""Units of a recording that a saved model goes on from, beside those that it was learned in."""

from __future__ import annotations

from typing import Any

from gfnn_jax.data.recording import Recording, read
from gfnn_jax.errors import InputError

_ANGLES = ("deg", "°", "rad")  # begins of the units that `read` turns into radians


def read_in_units(path: Any, job: dict[str, Any], roles: dict[str, Any]) -> Recording:
    """Read a recording in the units of its header and, where that is silent about times or about
    degrees, in those of the recording that the model was learned from.

    roles: keywords of `gfnn_jax.read`; a unit among them goes before the model's.
    """
    recording = read(path, **roles)
    known = (*recording.positions, *recording.velocities)
    silent = [n for n in job.get("degrees", ()) if n in known and n not in recording.units]
    told: dict[str, Any] = {"degrees": silent} if silent else {}
    if not recording.time_unit_given and job.get("time_unit", "s") != "s":
        told["time_unit"] = job["time_unit"]
    return read(path, **{**told, **roles}) if told else recording


def refuse_other_units(recording: Recording, job: dict[str, Any]) -> None:
    """Raises InputError where a column has another unit than in the recording that the model was
    learned from; degrees and radians are one, as both are read in radians."""
    for name, known in job.get("units", {}).items():
        own = recording.unit(name) if name in recording.columns else ""
        if own and known and own != known and not _are_angles(own, known):
            raise InputError(
                f"{recording.source}: expected {name} in {known}, in which the model was learned, "
                f"got {own}"
            )


def _are_angles(*units: str) -> bool:
    """Return whether these are units of angles, or of their rates over the same time."""
    angles = all(unit.strip().lower().startswith(_ANGLES) for unit in units)
    return angles and len({unit.partition("/")[2] for unit in units}) == 1
