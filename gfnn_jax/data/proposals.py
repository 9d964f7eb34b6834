"""Contents of a table beyond its names: circles, angles and lengths, a hand that lets go.

Each check yields faults that propose options: `gfnn look` puts them into the command to type, and
nothing is done without them.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy import optimize

from gfnn_jax.data.columns import TOLD, constants, explained
from gfnn_jax.data.faults import Fault, faults
from gfnn_jax.data.roles import is_rate_of_turning
from gfnn_jax.data.traits import Accelerations, Traits, accelerations, turning_points


class _Options:
    """Thresholds, chosen on pendulums, springs and orbits drawn at random (tests of proposals)."""

    most: int = 2000  # points that a circle is fitted to
    round: float = 3.0  # times the noise, up to which distances from a centre are equal
    bent: float = 10.0  # times those, that the points lie off a straight line
    even: float = (
        0.25  # relative scatter of the speed round a circle, below which it may be orbited
    )
    wide: float = 3.0  # rad: range from which on an angle is no length
    # Part of what a length, or an angle, leaves of the accelerations that the other kind leaves at
    # most (of small motions both leave as much, to 3 %).
    turns: float = 0.87
    straight: float = 0.6
    follows: float = 0.08  # of the accelerations' spread, that the better kind leaves at most
    still: int = 5  # samples at rest before or behind a motion
    at_rest: float = 5.0  # times the noise, that those scatter
    moved: float = 30.0  # times the noise: of a motion
    most_ways: int = 2  # of a hand, to and fro
    early: float = 0.5  # part of a record within which a hand lets go
    large: float = 0.3  # part of the largest swing
    swings: int = 8  # at least, of a motion that is caught
    uneven: float = 0.02  # relative scatter of steps that rounding makes
    most_states: int = 12


def mistakes(traits: Traits) -> list[Fault]:
    """Faults, points on a circle, which are no free coordinates, and states that are no positions;
    of these nothing else is said, for it would be judged by accelerations."""
    return [*_states(traits)] or [*faults(traits), *_circles(traits)]


def findings(traits: Traits) -> tuple[Fault, ...]:
    """Mistakes and proposals, the wrong ones first; columns with mistakes in them are not judged by
    their accelerations."""
    found = mistakes(traits)
    checks = _CHECKS if any(fault.wrong for fault in found) else (*_CHECKS, _kinds)
    found += [fault for check in checks for fault in check(traits)]
    return tuple(sorted(found, key=lambda fault: not fault.wrong))


# Populations, rates of a body that turns: states that are no positions.


def _states(traits: Traits) -> Iterator[Fault]:
    """Positions whose rates are functions of themselves, with an energy that each run keeps."""
    recording, names = traits.recording, traits.recording.positions
    others = (*recording.velocities, *recording.momenta, *recording.inputs, *recording.sensors)
    if not 2 <= len(names) <= _Options.most_states or others or recording.explained:
        return
    runs = [np.stack(x, axis=1) for x in zip(*map(traits.by_run, names), strict=True)]
    kept, shown = constants(runs), ", ".join(names)
    if not kept and not all(map(is_rate_of_turning, names)):
        return
    if explained(traits.times, runs) <= TOLD:
        return
    populations = all((x > 0).all() for x in runs)
    what = "of populations" if populations else "of the rates of a body that turns"
    keeps = f", and each run keeps {kept} of these" * (kept > 0)
    yield Fault(
        "first order",
        f"the rates of {shown} are functions of {shown} themselves{keeps}, as {what}: these are "
        "not positions",
        "Learn their bracket:",
        {"structure": "poisson", "states": names},
    )


# Points that a rod or a string holds.


def _circle(
    x: np.ndarray, y: np.ndarray, sigma: float, fixed: bool
) -> tuple[np.ndarray, float] | None:
    """Centre (2,) and radius of the circle that points (n,) lie on to their noise, about the origin
    where ``fixed``; None where they do not, where they lie on a line, and where an orbit may have
    led them."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) < 10:
        return None
    points = np.stack([x, y])[:, :: max(len(x) // _Options.most, 1)]
    apart = points - points.mean(axis=1)[:, None]
    line = float(np.linalg.svd(apart, compute_uv=False)[1]) / np.sqrt(points.shape[1])

    def away(centre: np.ndarray) -> np.ndarray:
        return np.hypot(points[0] - centre[0], points[1] - centre[1])

    centre = np.zeros(2)
    if not fixed:  # the radius is the mean distance from any centre
        table = np.stack([*points, np.ones(points.shape[1])])
        first = np.linalg.lstsq(table.T, (points**2).sum(axis=0), rcond=None)[0][:2] / 2
        scale = np.maximum(np.abs(first), 1e-12)
        centre = optimize.least_squares(lambda c: away(c) - away(c).mean(), first, x_scale=scale).x
    radius, rms = float(away(centre).mean()), float(away(centre).std())
    if rms > _Options.round * sigma or line < _Options.bent * max(rms, sigma):
        return None
    ways = np.diff(np.unwrap(np.arctan2(x - centre[0], centre[1] - y)))
    if abs(ways.mean()) > 0 and ways.std() < _Options.even * abs(ways.mean()):
        return None
    return centre, radius


def _circles(traits: Traits) -> Iterator[Fault]:
    """Pairs of positions on a circle about a fixed point or about another such pair."""
    recording = traits.recording
    names = [n for n in recording.positions if n not in (*recording.angles, *recording.explained)]
    if len(names) % 2 or not 2 <= len(names) <= 6 or len(recording.coordinates) != len(names):
        return
    pairs = list(zip(names[::2], names[1::2], strict=True))
    angles = ["theta"] if len(pairs) == 1 else [f"theta{k + 1}" for k in range(len(pairs))]
    before: tuple[str, str] | None = None
    shows, guess, told = {}, {}, []
    for k, (pair, angle) in enumerate(zip(pairs, angles, strict=True)):
        found, mark = None, str(k + 1) if len(pairs) > 1 else ""
        x, y = (traits.columns[n] for n in pair)
        sigma = max(traits.noise[n].sigma or 0.0 for n in (*pair, *(before or ())))
        sigma = max(sigma, max(traits.resolution[n] or 0.0 for n in pair) / 2)
        if before is None:
            found, base = _circle(x, y, sigma, fixed=False), ("x0", "y0")
        else:
            a, b = (traits.columns[n] for n in before)
            found = _circle(x - a, y - b, 2 * sigma, fixed=True)
            base = tuple(shows[n] for n in before)
        if found is None:
            return
        centre, guess[f"l{mark}"] = found
        if before is None:
            guess |= {"x0": float(centre[0]), "y0": float(centre[1])}
        shows[pair[0]] = f"{base[0]} + l{mark}*sin({angle})"
        shows[pair[1]] = f"{base[1]} - l{mark}*cos({angle})"
        about = ", ".join(before) if before else f"({guess['x0']:.4g}, {guess['y0']:.4g})"
        told.append(f"{', '.join(pair)} lie on a circle of {found[1]:.4g} about {about}")
        before = pair
    guess = {name: float(f"{value:.4g}") for name, value in guess.items()}
    options = {"coordinates": tuple(angles), "observe": shows, "guess": guess}
    yield Fault("circle", "; ".join(told), "What moves is an angle:", options)


# Angles, in radians or degrees, and lengths.


def _kinds(traits: Traits) -> Iterator[Fault]:
    """Positions whose accelerations are those of an angle, or of a length, against their names."""
    recording = traits.recording
    if len(recording.positions) > 2 or recording.angles_given or recording.explained:
        return
    known = accelerations(traits, recording.inputs)
    if known is None or known.q.shape[1] < 4 * 8:
        return
    begin = _let_go(traits)
    if begin is not None:
        known = known.taken(known.time > begin)
    now = [n in recording.angles for n in recording.positions]
    least = _Options.follows * known.a.std(axis=1)
    for k, name in enumerate(recording.positions):
        unit = recording.units.get(name, "")
        if recording.factors[name] != 1 or (unit and not unit.startswith("rad")):
            continue
        kinds = {"length": _left(known, now, k, False), "rad": _left(known, now, k, True)}
        mine, wide = ("rad" if now[k] else "length"), float(np.ptp(known.q[k]))
        if not unit and not now[k]:
            kinds["degrees"] = _left(known, now, k, True, np.pi / 180)
        turns = {"rad": 1.0, "degrees": np.pi / 180}
        most = _Options.turns * kinds["length"]
        wides = [kind for kind, turn in turns.items() if wide * turn > _Options.wide]
        good = {kind for kind in wides if kinds.get(kind, np.inf) < most}
        good |= {"length"} if kinds["length"] < _Options.straight * kinds["rad"] else set()
        best = min(good or {mine}, key=lambda kind: kinds[kind])
        if best == mine or kinds[best] > float(least[k]):
            continue
        times = kinds[mine] / max(kinds[best], 1e-300)
        others = [n for n in recording.angles if n != name]
        angles = tuple(n for n in recording.positions if n in (*others, *[name] * (best == "rad")))
        options = {"degrees": (name,)} if best == "degrees" else {"angles": angles}
        what = {"length": "a length, and are not periodic", "rad": "an angle in radians"}
        whose = what.get(best, "an angle in degrees")
        found = f"the accelerations of {name} are those of {whose}: {times:.2g} times closer"
        yield Fault("kind", found, "To say so:", options)


def _left(known: Accelerations, now: list[bool], k: int, angle: bool, factor: float = 1.0) -> float:
    """The accelerations of position k that fits leave, as an angle or as a length."""
    q = known.q.copy()
    q[k] *= factor
    angles = [angle if i == k else of for i, of in enumerate(now)]
    u = np.concatenate([known.u, np.sign(known.v)])  # dry friction
    return float(dataclasses.replace(known, q=q, u=u).held_out(angles)[k])


# The begin and the end of a free motion.


def _undriven(traits: Traits) -> Iterator[tuple[np.ndarray, float]]:
    """The positions (n,) of a single run without inputs, as far as they are complete, and how far
    each goes at rest."""
    recording = traits.recording
    for name in () if len(recording.runs) > 1 or recording.inputs else recording.positions:
        x, sigma = traits.columns[name], traits.noise[name].sigma
        if name in recording.explained or not sigma or not np.isfinite(x).all():
            return
        yield x, max(sigma, traits.resolution[name] or 0.0)


def _let_go(traits: Traits) -> float | None:
    """The time at which a motion that began at rest is free: that of its largest deflection; None
    where it did not begin so."""
    for x, sigma in _undriven(traits):
        off = x - np.median(x[: _Options.still])
        largest = int(np.argmax(np.abs(off)))
        away = np.abs(off[: largest + 1]) > _Options.at_rest * sigma
        rest = int(np.argmax(away)) if away.any() else largest
        wide = off[rest : largest + 1]
        wide = np.sign(wide[np.abs(wide) > _Options.large * np.abs(off[largest])])
        free = x[largest:]
        centre, reach = (free.max() + free.min()) / 2, (free.max() - free.min()) / 2
        good = (
            rest >= _Options.still
            and abs(x[0] - centre) < 0.5 * reach  # no release from a turning point
            and np.abs(off[largest]) > _Options.moved * sigma
            and largest < _Options.early * len(x)
            and np.sum(np.diff(wide) != 0) < _Options.most_ways
        )
        if good:
            return float(traits.times[0][largest])
    return None


def _caught(traits: Traits) -> float | None:
    """The time of the last free swing of a motion that ends at rest at once; None where it does not
    end so."""
    for x, sigma in _undriven(traits):
        off = x - np.median(x[-_Options.still :])
        away = np.flatnonzero(np.abs(off) > _Options.at_rest * sigma)
        if not len(away) or len(x) - away[-1] <= _Options.still:
            continue
        swing = off[: away[-1] + 1]
        size = float(np.ptp(swing))
        wide = turning_points(swing, _Options.large * size)
        if len(wide) < _Options.swings or size < _Options.moved * sigma:
            continue
        half = float(np.median(np.diff(wide)))  # of a period, in samples
        if len(x) - away[-1] > half and away[-1] - wide[-1] < 2 * half:
            return float(traits.times[0][wide[-1]])
    return None


def _hands(traits: Traits) -> Iterator[Fault]:
    """A hand that moves a body before it is let go, and one that stops it."""
    second = traits.recording.second
    begin, end = _let_go(traits), _caught(traits)
    if begin is not None:
        shown = float(f"{begin / second:.6g}")
        found = (
            f"the motion begins at rest and is free from {shown:g} on at the earliest: before it "
            "something moves the body that no column shows"
        )
        yield Fault("let go", found, "To begin there:", {"start": shown})
    if end is not None:
        shown = float(f"{end / second:.6g}")
        found = f"the motion stops at once behind {shown:g}, as if caught"
        yield Fault("caught", found, "To end there:", {"stop": shown})


def _rounded_times(traits: Traits) -> Iterator[Fault]:
    """Times that are an even step, rounded to few digits."""
    steps = []
    for t in traits.times:
        places = (10.0**-k for k in range(13) if np.ptp(t) > 10.0 ** (1 - k))
        off = ((u, np.abs(t / u - np.round(t / u)).max()) for u in places)
        unit = next((u for u, rest in off if rest < 1e-3), None)
        if unit is None or len(t) < 10:
            return
        step, begin = np.polyfit(np.arange(len(t)), t, 1)
        line = t - begin - step * np.arange(len(t))
        if np.ptp(line) > 1.2 * unit or np.ptp(np.diff(t)) < _Options.uneven * step:
            return
        steps.append((float(step), unit / len(t)))
    step, error = min(steps, key=lambda one: one[1])
    short = next((d for d in range(1, 9) if abs(float(f"{step:.{d}g}") - step) < error), 9)
    told = float(f"{step:.{short}g}")
    if traits.recording.clock == "s" and all(abs(s - told) < 2 * e for s, e in steps):
        found = f"the times are rounded: an even step of {told:g} s agrees with all of them"
        yield Fault("rounded times", found, "To take it:", {"dt": told})


_CHECKS = (_hands, _rounded_times)
