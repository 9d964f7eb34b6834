"""The roles of a recording's columns, by their names."""

import keyword
import re
import unicodedata
from collections.abc import Iterable

import numpy as np

ROLES = ("positions", "velocities", "momenta", "inputs", "parameters", "sensors")
# Words that name a time, first in a name or alone in it; times by the calendar with their unit.
TIMES = (
    *("t", "time", "times", "timestamp", "timestamps", "datetime", "epoch", "elapsed", "clock"),
    *("sec", "seconds", "millis", "micros", "date", "zeit", "zeitstempel", "uhrzeit", "datum"),
    *("temps", "heure", "tiempo", "fecha", "tempo", "tijd", "tid", "jd", "jdtdb", "jdut", "mjd"),
    *("year", "years", "jahr", "annee", "ano"),
)
OF_CALENDAR = {"jd": "d", "jdtdb": "d", "jdut": "d", "mjd": "d"}
OF_CALENDAR |= dict.fromkeys(("year", "years", "jahr", "annee", "ano"), "year")
RUNS = ("run", "trial", "sequence", "seq", "episode", "experiment", "trajectory", "lauf", "essai")

_GREEK = {letter: unicodedata.name(letter).split()[3].lower() for letter in "αβγθφψωτ"}
_GREEK |= {"ϕ": "phi", "ϑ": "theta"}
_ANGLES = (
    *("theta", "phi", "psi", "alpha", "beta", "gamma"),
    *("angle", "winkel", "yaw", "pitch", "roll"),
)
_INPUTS = ("u", "tau", "torque", "force", "thrust", "input", "voltage", "current", "motor", "drive")
_WORDS = {
    "positions": (*_ANGLES, "q", "x", "y", "z", "r", "position", "pos", "displacement"),
    "velocities": ("v", "omega", "velocity", "vel", "speed", "qdot", "qd", "gyro", "dq"),
    "momenta": ("p", "momentum"),
    "inputs": (*_INPUTS, "command"),
}
_ROLE_OF = {word: role for role, words in _WORDS.items() for word in words}
# A word, perhaps an index (a number or the letter of an axis) after it.
_INDEXED = re.compile(r"([a-z]+?)_?(\d+|[xyz])?")
# A unit at the end of a name: theta_deg, omega_rad_s, x1_mm, v_mm_s, force_N, u_V.
_UNIT = re.compile(
    r"_((?i:deg|rad|turns?|revs?)|[µumcdk]?m|px|[mk]?N|Nm|[mk]?V|m?A)((?:_|_?per_?|/)(s|sec))?$",
    re.ASCII,
)
# A name with its unit in brackets.
_BRACKETS = re.compile(r"^\s*([^\[(]*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))?\s*$")
# A name over its unit, as ISO 80000 has it: Zeit/ms, x / mm, v/(m/s).
_OVER = re.compile(
    r"^\s*(?P<name>[^/\[(]+?)\s*/\s*(?P<open>\()?"
    r"(?P<unit>(?:[nµum]?s|[nµumck]?m|m?rad|k?g|[mk]?N|[µumk]?V|[µum]?A|min|h|deg|°|Nm|px)"
    r"(?:/(?:ms|s|min))?)(?(open)\))\s*$"
)
# A derivative of another column: theta_dot, thetadot, dtheta, dtheta_dt, dtheta/dt, d_theta, θ̇.
_DERIVATIVES = (
    re.compile(r"(?P<of>.+?)_?(dot|prime|')(?P<index>_?\d*)"),
    re.compile(r"d_?(?P<of>.+?)(?P<index>)[_/]?dt"),
    re.compile(r"d_?(?P<of>[a-z].*?)(?P<index>)"),
)


def plain(name: str) -> str:
    """The name in lower case, Greek letters spelled out, a dot above as ``_dot``, no blanks."""
    text = unicodedata.normalize("NFD", name.strip().lower())
    text = re.sub("(.)\u0307(\\d*)", r"\1_dot\2", text)  # a combining dot above
    text = "".join(_GREEK.get(letter, letter) for letter in text)
    text = "".join(letter for letter in text if not unicodedata.combining(letter))
    return re.sub(r"[\s.-]+", "_", text.translate(str.maketrans("₀₁₂₃₄₅₆₇₈₉", "0123456789")))


def symbols(names: Iterable[str]) -> tuple[str, ...]:
    """Names as they can stand in a formula: θ₁ as theta1, Angle 1 as Angle_1."""
    found: list[str] = []
    for name in names:
        code = name
        if not (name.isidentifier() and name == unicodedata.normalize("NFKC", name)):
            code = re.sub(r"\W", "_", plain(name) if not name.isascii() else name)
            code = code if code[:1].isalpha() else f"q_{code}"
        code = f"{code}_" if keyword.iskeyword(code) else code
        found.append(f"{code}_{len(found) + 1}" if code in found else code)
    return tuple(found)


def is_time(name: str) -> bool:
    """Return whether this is the name of a column of times: Time, time_ms, Zeit t, Date Time."""
    bare = re.sub(r"_?(s|ms|us|µs|ns)$", "", plain(name))
    words = re.split(r"[_,]+", plain(name))
    told = len(words[0]) > 1 and words[0] in TIMES and not set(words[1:]) & {"constant", "step"}
    return bare in TIMES or plain(name) in TIMES or told or plain(name) == "julian_date"


def is_run(name: str) -> bool:
    """Return whether this is the name of a column that tells runs apart."""
    return re.sub(r"_?(id|no|nr|number|index)$", "", plain(name)) in RUNS


def is_angle(name: str) -> bool:
    """Return whether this is the usual name of an angle."""
    return _word(name)[0] in _ANGLES


def is_rate_of_turning(name: str) -> bool:
    """Return whether this is the usual name of a rate of turning about an axis: wx, omega_y,
    Gyroscope z."""
    return re.fullmatch(r"(w|omega|gyro|gyroscope|gyr)_?[xyz]", _bare(name)) is not None


def unit_in(name: str) -> str:
    """The unit that a name ends with: deg of theta_deg, mm/s of v_mm_s, rad of Angle (rad); "" of
    none."""
    if unit := split_unit(name)[1]:
        return unit
    found = _UNIT.search(name.strip())
    return found[1] + ("/s" if found[3] else "") if found else ""


def _bare(name: str) -> str:
    """The plain name without a unit at its end."""
    return plain(_UNIT.sub("", split_unit(name)[0].strip()))


def split_unit(cell: str) -> tuple[str, str]:
    """Name, and its unit where brackets or a stroke before it give one."""
    if over := _OVER.match(cell):
        return over["name"], over["unit"]
    match = _BRACKETS.match(cell)
    if match is None or not match[1]:
        return cell, ""
    return match[1], (match[2] or match[3] or "").strip()


def derivative_of(name: str) -> str | None:
    """The plain name of the column whose derivative this one's name says it is; None if it says
    nothing of the kind."""
    for pattern in _DERIVATIVES:
        found = pattern.fullmatch(_bare(name))
        if found:
            return f"{found['of']}{found['index'].lstrip('_')}"
    return None


def role_of(name: str) -> str | None:
    """The role that a column of this name usually has; None where names do not tell."""
    words = {_ROLE_OF.get(word) for word in _bare(name).split("_")}  # of "Motor Voltage", say
    role = _ROLE_OF.get(_word(name)[0]) or (words.pop() if len(words) == 1 else None)
    if role is None and (of := derivative_of(name)) is not None and role_of(of) == "positions":
        return "velocities"
    return role


def words_in(formula: object) -> list[str]:
    """The names in the formula of a sensor; of one that is no text none."""
    return re.findall(r"[^\W\d]\w*", formula) if isinstance(formula, str) else []


def coordinates_in(formulas: Iterable[object]) -> tuple[str, ...]:
    """The coordinates that formulas of sensors speak of, by the usual names: theta and x, also as
    omega, v, theta_dot or x_ddot; of formulas that are no text none."""
    found = []
    for name in (name for one in formulas for name in words_in(one)):
        of = re.sub(r"(_d*dot)$", "", name)
        speed = re.fullmatch(r"(omega|v)(\w*)", of)
        if speed:
            of = {"omega": "theta", "v": "x"}[speed[1]] + speed[2]
        if of != name or role_of(of) == "positions":
            found.append(of)
    return tuple(dict.fromkeys(found))


def by_name(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The columns of each role, those whose names do not tell left out.

    The i-th velocity (and momentum) belongs to the i-th position: by the name that it is the
    derivative of, else by its index, else by the order of the columns.
    """
    names = list(names)
    columns = {role: [n for n in names if role_of(n) == role] for role in ROLES}
    positions = columns["positions"]
    for role in ("velocities", "momenta"):
        mates = {name: _mate(positions, name) for name in columns[role]}
        if None not in mates.values() and len({*mates.values()}) == len(mates):
            columns[role].sort(key=lambda name: positions.index(str(_mate(positions, name))))
    paired = len(columns["velocities"])
    if 0 < paired < len(positions):  # those that have a velocity come first
        mates = {_mate(positions, v) for v in columns["velocities"]}
        columns["positions"] = sorted(positions, key=lambda n: n not in mates)
    return {role: tuple(of_role) for role, of_role in columns.items()}


def _mate(positions: list[str], name: str) -> str | None:
    """The position whose derivative, or whose index, this name has."""
    of = derivative_of(name)
    for position in positions:
        if of in (plain(position), _bare(position)):
            return position
    index = _word(name)[1]
    same = [p for p in positions if index and index in (_word(p)[1], plain(p))]
    if len(same) == 1:
        return same[0]
    return positions[0] if len(positions) == 1 else None


def _word(name: str) -> tuple[str, str]:
    """(word, index or "") of the name; ("", "") of one that is no single word."""
    found = _INDEXED.fullmatch(_bare(name))
    return (found[1], found[2] or "") if found else ("", "")


_WAVE = re.compile(r"(cos|sin)\((\d[\d.]*(?:e[-+]?\d+)?)\*t\)")
_OF = {"cos": np.cos, "sin": np.sin}


def wave_names(omega: float) -> tuple[str, str]:
    """The names of the two waves of an angular frequency, in rad/s."""
    return f"cos({omega:.10g}*t)", f"sin({omega:.10g}*t)"


def wave(name: str, t: np.ndarray) -> np.ndarray | None:
    """The wave (n,) of this name at times t (n,) in seconds; None for the name of a column.

    >>> wave("cos(2*t)", np.zeros(2))
    array([1., 1.])
    """
    found = _WAVE.fullmatch(name)
    return None if found is None else _OF[found[1]](float(found[2]) * t)


def is_wave(name: str) -> bool:
    """Return whether a name is one of a wave."""
    return _WAVE.fullmatch(name) is not None
