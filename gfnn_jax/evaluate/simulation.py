"""The simulation in a report: a law as JavaScript beside its data, with a slider for each of its
coefficients."""

import json
import re
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError
from gfnn_jax.exports.javascript import javascript
from gfnn_jax.families.text import in_letters
from gfnn_jax.maps.laws import law_of_map, velocities_of
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw


class Options:
    """Sizes of the simulation."""

    points: int = 500  # of the data, which a browser steps through in some ms
    # A slider reaches so many standard errors, and this share of its coefficient, to either side,
    # whichever is more.
    errors: float = 10.0
    share: float = 0.5


class Slider(NamedTuple):
    """A coefficient of the law: its place among them, its name, and how far it goes."""

    place: int
    label: str
    low: float
    high: float


def simulation(law: LearnedLaw, recording: Recording, begin: float) -> str | None:
    """The script of a page: the law, the run after ``begin`` (s), and the sliders. None where a
    sensor shows something else than a coordinate, where the law is no formula, or where too little
    of the run is before or after."""
    sensors = law.map.sensors
    assert sensors is not None
    if sensors.observation is not None and not sensors.observation.is_plain:
        return None
    try:
        source = javascript(law.map, "law", {})
        before = recording.slice(stop=begin)
        z, _ = law.map.estimate(before)
    except InputError:
        return None
    (run,) = recording.runs
    t = recording.times(run)
    rows = np.arange(len(before.times(run)) - 1, len(t))  # the state is that of the last row before
    rows = rows[:: max(1, len(rows) // Options.points)]
    if len(rows) < 2:
        return None
    names = () if law.map.parameters is None else law.map.parameters.names
    d, args = law.map.dim, [float(recording.values(name, run)[0]) for name in names]
    v = velocities_of(law.map, z, np.array([args]) if args else None)
    known = len(sensors.positions)
    shown = {
        "t": t[rows].tolist(),
        "channels": [_channel(recording, run, i, rows, z[0, i]) for i in range(known)],
        "start": [*z[0, :d], *v[0]],
        "parameters": args,
        "inputs": _inputs(law, recording, run, t[rows], args),
        "coefficients": np.asarray(law.map.pieces[0].params).tolist(),
        "sliders": [slider._asdict() for slider in _sliders(law)],
    }
    text = json.dumps(shown, ensure_ascii=False).replace("</", "<\\/")
    drawn = files("gfnn_jax.evaluate").joinpath("page.js").read_text(encoding="utf-8")
    return f"{source}\nconst shown = {text};\n{drawn}"


def _channel(recording: Recording, run: str, place: int, rows: Any, start: float) -> dict[str, Any]:
    """A column of the data in its file's unit, null where missing; turn: of the lift of an angle,
    beside the simulated one."""
    name = recording.positions[place]
    factor, unit = recording.factors[name], recording.unit(name)
    y = recording.unwrapped(name, run)[rows] / factor
    known = y[np.isfinite(y)]
    turn = 0.0
    if name in recording.angles and len(known):
        turn = 2 * np.pi / factor * np.round((known[0] - start / factor) * factor / (2 * np.pi))
    return {
        "name": re.sub(r"\W", "_", name),
        "label": f"{name} [{unit}]" if unit else name,
        "place": place,
        "factor": factor,
        "turn": float(turn),
        "y": [float(value) if np.isfinite(value) else None for value in y],
    }


def _inputs(
    law: LearnedLaw, recording: Recording, run: str, t: np.ndarray, args: list[float]
) -> list[list[float]]:
    """Parameters and inputs at the times t, those that act there; [] without inputs."""
    sensors = law.map.sensors
    assert sensors is not None
    if not recording.inputs:
        return []
    times = recording.times(run)
    columns = []
    for name in recording.inputs:
        values = recording.values(name, run)
        known = np.isfinite(values)
        columns.append(np.interp(t - sensors.delay, times[known], values[known]))
    return [[*args, *row] for row in np.stack(columns, axis=1).tolist()]


def _sliders(law: LearnedLaw) -> list[Slider]:
    """A slider for each coefficient that was fitted."""
    piece, posterior = law.map.pieces[0], law.map.posterior
    values = np.asarray(piece.params)
    std = np.zeros(len(values))
    if posterior is not None:
        std = np.sqrt(np.sum(np.asarray(posterior.root) ** 2, axis=0))
    own, found = law_of_map(law.map), []
    first, gains = own.terms.count, own.gains.size  # frictions are terms and gains of no drive
    losses = first + own.friction.count
    for place, (value, error) in enumerate(zip(values.tolist(), std.tolist(), strict=True)):
        if error > 0 and value != 0:
            reach = max(Options.errors * error, Options.share * abs(value))
            friction = first <= place < losses or place >= losses + gains
            low = max(value - reach, 0.0) if friction else value - reach
            label = _label(law, piece.family.term_names[place])
            found.append(Slider(place, label, low, value + reach))
    return found


def _label(law: LearnedLaw, term: str) -> str:
    """A term of the map in the names of the recording."""
    if term == "friction":
        return "damping rate"
    named = dict(zip("qv", law.symbols, strict=True))

    def own(found: re.Match) -> str:
        names, place = named[found[1]], int(found[2]) - 1
        return names[place] if place < len(names) else found[0]

    return in_letters(re.sub(r"(?<![A-Za-z_])([qv])(\d+)", own, term))
