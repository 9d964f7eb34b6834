"""A mistake in a recording, as its user is told."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

WRONG = (
    "constant",
    "repeated",
    "order",
    "time unit",
    "no derivative",
    "degrees",
    "sign",
    "factor",
    "wrapped",
    "interpolated jump",
    "clipped",
    "drifting clock",
    "different systems",
)
NOTES = (
    "constant",
    "coarse",
    "missing column",
    "missing",
    "outliers",
    "stuck",
    "difference",
    "filtered",
    "reading",
)


@dataclasses.dataclass(frozen=True)
class Fault:
    """kind: one of WRONG, or of NOTES. message: what was found. remedy: what mends it, "" for
    nothing to do. options: those of `gfnn_jax.read` that do, if any. wrong: whether a fit must not
    begin."""

    kind: str
    message: str
    remedy: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    wrong: bool = True

    def __post_init__(self):
        assert self.kind in (WRONG if self.wrong else NOTES), self.kind

    def __str__(self) -> str:
        return f"{self.message}. {self.remedy}" if self.remedy else self.message
