"""Data taken as `gfnn look` proposes: what ``gfnn FILE``, `gfnn_jax.discover` and `gfnn_jax.fit` do
with a file or a table that nobody has described."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from gfnn_jax.data.columns import Undecided
from gfnn_jax.data.faults import Fault
from gfnn_jax.data.recording import ReadOptions, Recording, read
from gfnn_jax.data.recording_summary import RecordingSummary, summarise

_ROWS = ("start", "stop", "every")


@dataclasses.dataclass(frozen=True)
class Proposed:
    """A recording as it is proposed to be read.

    reading: keywords of `gfnn_jax.read`, those given and those proposed; asked: keywords of
    `gfnn_jax.fit`. summary: of the recording as it came. new: the proposed options among them, and
    why: a line for each reason.
    """

    recording: Recording
    reading: dict[str, Any]
    asked: dict[str, Any]
    summary: RecordingSummary
    new: dict[str, Any]
    why: tuple[str, ...]


def as_proposed(source: Any, given: Mapping[str, Any]) -> Proposed:
    """Read files or a table with the keywords that are ``given`` and those that are proposed.

    Raises InputError as `gfnn_jax.read`.
    """
    found, summary = summarised(source, given)
    proposed = dict(summary.options)
    states = proposed.pop("states", None)
    if states is not None:
        proposed["positions"] = states
    known = {*ReadOptions.__annotations__, *_ROWS}
    reading = {name: value for name, value in proposed.items() if name in known}
    asked = {name: value for name, value in proposed.items() if name not in known}
    new = {name: value for name, value in proposed.items() if given.get(name) != value}
    why = tuple(f.message for f in summary.faults if new and set(f.options) & {*new, "states"})
    recording = read(source, **reading) if new else found
    return Proposed(recording, reading, asked, summary, new, why)


def summarised(source: Any, options: Mapping[str, Any]) -> tuple[Recording, RecordingSummary]:
    """The recording of files or of a table, and its summary; where nothing tells what its columns
    are, by the roles that are proposed.

    options: keywords of `gfnn_jax.read`, and ``mass``, which only goes into the command to type.
    """
    reading = {name: value for name, value in options.items() if name != "mass"}
    try:
        recording = read(source, **reading)
        return recording, summarise(recording, options)
    except Undecided as error:
        told, message = error.options, str(error)
    of_fit = {name: told[name] for name in ("structure", "states") if name in told}
    roles = {name: value for name, value in told.items() if name not in of_fit}
    recording = read(source, **{**reading, **(roles or {"positions": told.get("states", ())})})
    message = message.removeprefix(f"{recording.source}: ")
    fault = Fault("roles", message, "", of_fit)
    return recording, summarise(recording, {**options, **roles}, [fault])
