"""Angles in other units, wrapped angles, and jumps that interpolation has cut."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

import numpy as np
from scipy import signal

from gfnn_jax.data.faults.fault import Fault
from gfnn_jax.data.traits import Traits

TURN = 2 * np.pi
_WIDE = 0.75 * np.pi  # a step which may as well be one the other way round
_SWING = 2 * TURN  # beyond which the unit of an angle that swings is doubted


def jumps(traits: Traits, name: str) -> tuple[float, int] | None:
    """(2π or 360, how often) where a column that was not lifted jumps by a turn, and else moves by
    much less; None where it does not."""
    steps = _steps(traits, name)
    for turn in (TURN, 360.0):
        near = np.abs(steps - turn) < 0.1 * turn
        others = np.sum((steps > 0.3 * turn) & ~near)
        small = len(steps) > 0 and np.quantile(steps, 0.9) < 0.2 * turn
        if near.sum() > 2 * others and small and np.ptp(_all(traits, name)) < 1.1 * turn:
            return turn, int(near.sum())
    return None


def _raw(traits: Traits, name: str) -> list[np.ndarray]:
    """A column as it came, in radians, without what is missing or wrong, run by run."""
    wrong = [stretch.rows for stretch in traits.wrong.get(name, ())]
    recording = traits.recording
    if wrong:
        recording = recording.without({name: np.concatenate(wrong)})
    found = [recording.values(name, run) for run in recording.runs]
    return [x[np.isfinite(x)] for x in found]


def _all(traits: Traits, name: str) -> np.ndarray:
    return np.concatenate(_raw(traits, name))


def _steps(traits: Traits, name: str) -> np.ndarray:
    """The sizes of the steps between neighbours."""
    return np.abs(np.concatenate([np.diff(x) for x in _raw(traits, name)]))


def units(traits: Traits) -> Iterator[Fault]:
    """Angles whose jumps, or whose swings, are too wide for radians."""
    recording = traits.recording
    for name in _angles(traits):
        if recording.factors[name] != 1 or name in recording.explained:
            continue
        option, typed = {"degrees": (name,)}, shlex.quote(name)
        jump, swing = jumps(traits, name), _swing(_raw(traits, name))
        if jump is not None and jump[0] == 360:
            found = f"{name} jumps by 360 ({jump[1]} times)"
            yield Fault("degrees", found, f"Its unit is degrees: --degrees {typed}", option)
        elif swing > _SWING and np.ptp(_all(traits, name)) < 720 and not _settled(traits, name):
            found = f"{name} swings by {swing:.3g}, degrees or {swing / TURN:.0f} turns in radians"
            angles = shlex.quote(",".join(recording.angles))
            remedy = f"If degrees: --degrees {typed}. If radians: --angles {angles}"
            yield Fault("degrees", found, remedy, option)


def _angles(traits: Traits) -> list[str]:
    """Positions that are angles; a coordinate that no column shows directly is none of them."""
    recording = traits.recording
    return [name for name in recording.positions if name in recording.angles]


def _settled(traits: Traits, name: str) -> bool:
    """Return whether a velocity, or the file's unit, has told the unit of this angle already."""
    recording = traits.recording
    place = recording.positions.index(name)
    unit = recording.units.get(name, "")
    return place < len(recording.velocities) or unit.startswith("rad") or recording.angles_given


def _swing(runs: list[np.ndarray]) -> float:
    """The median way between turning points, the ends of runs among them; 0 where nothing turns."""
    ways = []
    for x in runs:
        prominence = 0.05 * np.ptp(x) if len(x) else 0.0
        if prominence > 0:
            turns = [signal.find_peaks(sign * x, prominence=prominence)[0] for sign in (1, -1)]
            found = np.sort(np.concatenate(turns))
            ways.append(np.abs(np.diff(x[[0, *found, -1]] if len(found) else [])))
    every = np.concatenate(ways) if ways else np.empty(0)
    return float(np.median(every)) if len(every) else 0.0


def wraps(traits: Traits) -> Iterator[Fault]:
    """Positions that jump by a turn and were not called angles."""
    for name in traits.recording.positions:
        jump = None if name in traits.recording.angles else jumps(traits, name)
        if jump is not None:
            option = "degrees" if jump[0] == 360 else "angles"
            found = f"{name} jumps by {jump[0]:.3g} ({jump[1]} times)"
            yield Fault(
                "wrapped",
                found,
                f"Name it as an angle: --{option} {shlex.quote(name)}",
                {option: (name,)},
            )


def interpolated_jumps(traits: Traits) -> Iterator[Fault]:
    """Wrapped angles that were interpolated across their jump: a few steps make a whole turn."""
    for name in _angles(traits):
        count = sum(_cuts(x) for x in _raw(traits, name))
        if count:
            jump = "1 jump by a turn takes" if count == 1 else f"{count} jumps by a turn take"
            yield Fault(
                "interpolated jump",
                f"{name} was resampled across its wraps: {jump} several samples",
                "Unwrap the angle before resampling, or resample its sine and cosine",
            )


def _cuts(x: np.ndarray) -> int:
    """Jumps of one turn that are spread over 2 to 6 steps."""
    if len(x) < 16 or np.ptp(x) > 1.02 * TURN:
        return 0
    steps = np.diff(x)
    usual = np.median(np.abs(np.angle(np.exp(1j * steps))))
    small = max(6 * usual, 1e-3 * TURN)
    if small > 0.12 * TURN:  # a coarse motion makes such steps by itself
        return 0
    found = np.zeros(len(steps), bool)
    for count in range(2, 7):
        windows = np.lib.stride_tricks.sliding_window_view(steps, count)
        way = windows.sum(axis=1)
        same = np.all(windows > small, axis=1) | np.all(windows < -small, axis=1)
        whole = np.abs(windows).max(axis=1) < 0.93 * TURN
        turn = np.abs(np.abs(way) - TURN) < count * small
        found[: len(way)] |= same & whole & turn
    return int(found.sum())


def coarse(traits: Traits) -> Iterator[Fault]:
    """Angles whose steps are so wide that their lift is a guess."""
    for name in _angles(traits):
        steps = _steps(traits, name)
        wide = int(np.sum(np.abs(np.angle(np.exp(1j * steps))) > _WIDE))
        is_lift = np.ptp(_all(traits, name)) > 1.02 * TURN
        if wide > max(3, 0.01 * len(steps)) and not is_lift:
            found = f"{name} moves by more than 135° in {wide} steps, in an ambiguous direction"
            yield Fault("coarse", found, "Sample faster, or give the unwrapped angle", wrong=False)
