"""Cases of a new user: their own pairs, the messages of the fit, and whether these are true.

    python benchmarks/as_a_user.py                          cases that have no result yet, table
    python benchmarks/as_a_user.py --only friction,degrees  these cases again
    python benchmarks/as_a_user.py --quick                  few short cases, into runs/as-a-user
    python benchmarks/as_a_user.py --tables                 only the table again

Each case makes pairs as a user would have them, calls the public ``gfnn.fit`` or the command
``gfnn fit``, and measures the true one-step error on fresh states: the RMS over coordinates of
error divided by spread. What was said is then compared with what is true. The result is
benchmarks/results/as-a-user.json, and a section of benchmarks/RESULTS.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import (
    HERE,
    RESULTS,
    SEED,
    TABLES,
    Numbers,
    between_markers,
    markdown,
    number,
    provenance,
    read,
    write,
)

# isort: split
import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.phase_space import sizes

# Factors by which claims may differ from the truth: errors of exact data, and the map's own error
# under noise; and parts by which they may: measured noise, and changes of volume.
_AGREES, _OWN_WITHIN = 2.0, 3.0
_NOISE_WITHIN, _VOLUME_WITHIN = 0.3, 0.1
# Said where the number of pairs is the limit.
_MORE_PAIRS = "more pairs would help"

Field = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Case:
    """Case: the data and the request of a user, and the facts about them.

    pairs: to learn from. fresh: exact pairs of the same law, to judge by. tolerance, max_seconds,
    angles: as in `gfnn.fit`. meets: whether the tolerance can be met, None where it may be.
    words, never: patterns that must occur in what is said, and that would be wrong there. quiet:
    whether there is nothing to warn of. sigma: standard deviation of the noise on all states.
    volume_change: relative, in a step. csv: text of a file that is fitted by the command line in
    the pairs' stead.
    """

    pairs: gfnn.Pairs
    fresh: gfnn.Pairs
    tolerance: float = 1e-6
    max_seconds: float = 60.0
    angles: tuple[int, ...] = ()
    meets: bool | None = True
    words: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    quiet: bool = False
    sigma: float = 0.0
    volume_change: float = 0.0
    csv: str = ""


class Learned(NamedTuple):
    """Result of a case, by Python or the command line. noise: (2d,) as `fit.noise`, or None."""

    map: gfnn.SymplecticMap
    seconds: float
    messages: list[str]
    ended: str
    model: str
    claimed: float
    bound: float
    met: bool
    noise: list[float] | None


# Exact data


def flow(field: Field, z: np.ndarray, duration: float) -> np.ndarray:
    """States (N, 2d) a time later, all at once. field: (2d, N) -> its time derivative (2d, N)."""
    shape = z.T.shape
    largest = np.maximum(np.abs(z).max(axis=0), 1e-10)  # SciPy divides by it
    floor = np.broadcast_to(1e-15 * largest[:, None], shape).ravel()
    done = solve_ivp(
        lambda _, flat: field(flat.reshape(shape)).ravel(), (0.0, duration), z.T.ravel(),
        method="DOP853", rtol=1e-13, atol=floor, t_eval=[duration],
    )  # fmt: skip
    return done.y[:, -1].reshape(shape).T


def independent(field: Field, z: np.ndarray, dt: float) -> gfnn.Pairs:
    """Make independent pairs of states z (N, 2d) and their images."""
    return gfnn.Pairs(z, flow(field, z, dt), dt)


def sequences(field: Field, z: np.ndarray, dt: float, num_steps: int) -> np.ndarray:
    """Trajectories (N, 1 + num_steps, 2d) of states (N, 2d)."""
    states = [z]
    for _ in range(num_steps):
        states.append(flow(field, states[-1], dt))
    return np.stack(states, axis=1)


def in_sequence(states: np.ndarray, dt: float) -> gfnn.Pairs:
    """Pairs of consecutive states of trajectories (M, L, 2d), one trajectory after the other."""
    width = states.shape[2]
    return gfnn.Pairs(states[:, :-1].reshape(-1, width), states[:, 1:].reshape(-1, width), dt)


def changed(pairs: gfnn.Pairs, change: Callable[[np.ndarray], np.ndarray]) -> gfnn.Pairs:
    """The pairs with both states changed by the same function: other units or columns."""
    return gfnn.Pairs(change(pairs.z0), change(pairs.z1), pairs.dt)


def box(half: Sequence[float]) -> Callable[[int, int], np.ndarray]:
    """(number, seed) -> states (number, 2d), uniform in a box around 0 of half widths (2d,)."""
    sides = np.asarray(half)

    def draw(num: int, seed: int) -> np.ndarray:
        return np.random.default_rng([SEED, seed]).uniform(-sides, sides, (num, len(sides)))

    return draw


# Systems: dz/dt for z of shape (2d, N)


def pendulum(z, stiffness: Any = 1.0, friction: float = 0.0):
    """stiffness: g / length, a number or one per state. friction: of the momentum, per time."""
    q, p = z
    return np.stack([p, -stiffness * np.sin(q) - friction * p])


def henon_heiles(z):
    x, y, px, py = z
    return np.stack([px, py, -x - 2 * x * y, -y - x**2 + y**2])


EARTH, RADIUS, J2 = 3.986004418e14, 6.378137e6, 1.08262668e-3  # m³/s², m, 1


def satellite(z):
    """Metres and metres per second, the momentum of unit mass: Kepler's force and J2's."""
    q, p = z[:3], z[3:]
    r2 = np.sum(q**2, axis=0)
    kepler, flattening = EARTH / r2**1.5, 1.5 * J2 * RADIUS**2 / r2
    pole = np.array([[1.0], [1.0], [3.0]])
    return np.concatenate([p, -kepler * q * (1 + flattening * (pole - 5 * q[2] ** 2 / r2))])


def penning_trap(z, quartic: float):
    """A charge in a field B = 1 along the axis and a quadrupole, canonical momenta p = v + A."""
    (x, y, s), p = z[:3], z[3:]
    squeeze, rho2 = 0.1, x**2 + y**2
    v = p - 0.5 * np.stack([-y, x, 0 * s])
    radial = -squeeze / 2 + quartic * (1.5 * rho2 - 6 * s**2)
    axial = squeeze + quartic * (4 * s**2 - 6 * rho2)
    return np.stack([*v, 0.5 * v[1] - radial * x, -0.5 * v[0] - radial * y, -axial * s])


def double_pendulum(z):
    """Masses, lengths and g are 1; the momenta are those that belong to the angles."""
    a, b, pa, pb = z
    c, s = np.cos(a - b), np.sin(a - b)
    den = 1 + s**2
    kinetic = (pa**2 + 2 * pb**2 - 2 * pa * pb * c) / (2 * den)
    turn = pa * pb * s / den - 2 * s * c * kinetic / den
    return np.stack([
        (pa - pb * c) / den, (2 * pb - pa * c) / den, -turn - 2 * np.sin(a), turn - np.sin(b)
    ])  # fmt: skip


def fput(z, beta: float = 0.3):
    """A chain with fixed ends, springs with a cubic force."""
    q, p = np.split(z, 2)
    stretch = np.diff(np.pad(q, ((1, 1), (0, 0))), axis=0)
    force = stretch + beta * stretch**3
    return np.concatenate([p, np.diff(force, axis=0)])


def low_orbits(highest: float, num: int, seed: int) -> np.ndarray:
    """States (num, 6) of satellites from 500 km up to highest, of any node and phase, inclined by
    50° to 56°."""
    rng = np.random.default_rng([SEED, seed])
    axis, e = RADIUS + rng.uniform(5e5, highest, num), rng.uniform(0, 5e-3, num)
    f = rng.uniform(0, 2 * np.pi, num)
    r, speed = axis * (1 - e**2) / (1 + e * np.cos(f)), np.sqrt(EARTH / (axis * (1 - e**2)))
    zero = np.zeros(num)
    turns = np.stack([rng.uniform(0, 360, num), rng.uniform(50, 56, num),
                      rng.uniform(0, 360, num)], axis=1)  # fmt: skip
    turn = Rotation.from_euler("ZXZ", turns, degrees=True)
    q = turn.apply(np.stack([r * np.cos(f), r * np.sin(f), zero], axis=1))
    p = turn.apply(np.stack([-speed * np.sin(f), speed * (e + np.cos(f)), zero], axis=1))
    return np.concatenate([q, p], axis=1)


# The cases


def drawn(
    field: Field, draw: Callable[[int, int], np.ndarray], dt: float, num_pairs: int
) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """Independent pairs to learn from and fresh ones. draw: (number, seed) -> states (N, 2d)."""
    data, fresh = (independent(field, draw(n, i), dt) for i, n in enumerate((num_pairs, 1_000), 1))
    return data, fresh


def swings(num_pairs: int, **options) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """A pendulum that does not turn over."""
    return drawn(partial(pendulum, **options), box([1.0, 1.0]), 0.2, num_pairs)


def single_orbit() -> Case:
    """Recording of one swing: all pairs lie on one curve."""
    start = np.array([[0.9, 0.1]])
    orbit = sequences(pendulum, start, 0.2, 400)
    between = flow(pendulum, start, 0.1)
    fresh = sequences(pendulum, between, 0.2, 200)
    return Case(in_sequence(orbit, 0.2), in_sequence(fresh, 0.2), meets=None, words=("on a curve",))


def micro_units() -> Case:
    """Coordinates of size 1e-7."""
    data, fresh = (changed(pairs, partial(np.multiply, 1e-7)) for pairs in swings(1_000))
    return Case(data, fresh, quiet=True)


def satellites(highest: float, meets: bool | None) -> Case:
    """Satellites of the Earth in metres and seconds, a minute a step."""
    laws = drawn(satellite, partial(low_orbits, highest), 60.0, 5_000)
    return Case(*laws, meets=meets, never=(_MORE_PAIRS,))


def penning(quartic: float, max_seconds: float) -> Case:
    """A Penning trap, of a pure quadrupole or with a quartic part."""
    states = box([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    laws = drawn(partial(penning_trap, quartic=quartic), states, 0.5, 10_000)
    return Case(*laws, max_seconds=max_seconds)


def double_pendula() -> Case:
    """Double pendula whose arms may both turn over."""
    laws = drawn(double_pendulum, box([np.pi, np.pi, 1.0, 1.0]), 0.1, 5_000)
    return Case(*laws, angles=(0, 1), meets=None, never=(_MORE_PAIRS,))


def chain(dim: int) -> Case:
    """A Fermi–Pasta–Ulam–Tsingou chain of so many particles."""
    laws = drawn(fput, box([0.5] * 2 * dim), 0.2, 5_000)
    return Case(*laws, meets=None, never=(_MORE_PAIRS, "no more accurate"))


def noisy_file() -> Case:
    """A recording of forty swings with errors of 1e-3, as a file."""
    data = noisy(pendulum, [1.0, 1.0], 1e-3)
    states = recorded(pendulum, [1.0, 1.0], 1e-3)
    lines = [
        f"{n},{0.2 * i:.1f},{q:.9f},{p:.9f}"
        for n, orbit in enumerate(states) for i, (q, p) in enumerate(orbit)
    ]  # fmt: skip
    text = "\n".join(["sequence,t,q1,p1", *lines, ""])
    return dataclasses.replace(data, tolerance=1e-4, csv=text)


def hidden_parameter() -> Case:
    """Forty pendulums, each of another length, a sequence of each: the states have no map."""
    stiffness = np.random.default_rng([SEED, 3]).uniform(0.8, 1.2, 40)
    law = partial(pendulum, stiffness=stiffness)
    states, fresh = (sequences(law, box([1.0, 1.0])(40, s), 0.2, 50) for s in (1, 2))
    words = ("differs? between (the )?sequences",)
    return Case(
        in_sequence(states, 0.2), in_sequence(fresh, 0.2), meets=False, words=words,
        never=("noise, or a structure",),
    )  # fmt: skip


def twenty_pairs() -> Case:
    """Too few for the tolerance."""
    return Case(*swings(20), tolerance=1e-8, meets=False, words=(_MORE_PAIRS,))


def friction() -> Case:
    """A pendulum that loses a fiftieth of its momentum per time: friction is learned with it."""
    data, fresh = swings(1_000, friction=0.02)
    return Case(data, fresh, meets=True, never=("carry noise", "noise, or"))


def in_degrees(z: np.ndarray) -> np.ndarray:
    return z * np.array([[np.degrees(1.0), 1.0]])


def degrees() -> Case:
    """An angle in degrees, and not declared as an angle: units, that is all."""
    data, fresh = (changed(pairs, in_degrees) for pairs in swings(1_000))
    return Case(data, fresh, quiet=True)


def degrees_as_angle() -> Case:
    """An angle in degrees that is declared to have period 2π."""
    words = ("are these degrees",)
    return dataclasses.replace(degrees(), angles=(0,), meets=False, words=words, quiet=False)


def wrapped_angle() -> Case:
    """Rotating pendulums whose angle is kept within ±π, and not declared as an angle."""

    def draw(num: int, seed: int) -> np.ndarray:
        return np.array([0.0, 2.8]) + box([np.pi, 0.6])(num, seed)

    def wrap(z: np.ndarray) -> np.ndarray:
        return np.stack([np.remainder(z[:, 0] + np.pi, 2 * np.pi) - np.pi, z[:, 1]], axis=1)

    data, fresh = (changed(pairs, wrap) for pairs in drawn(pendulum, draw, 0.1, 1_000))
    return Case(
        data, fresh, max_seconds=20.0, meets=False, words=("jumps of 2π", "--angles 0"),
        never=("noise",),
    )  # fmt: skip


def interleaved() -> Case:
    """Columns in the order q1, p1, q2, p2."""
    laws = drawn(henon_heiles, box([0.3] * 4), 0.2, 2_000)
    data, fresh = (changed(pairs, lambda z: z[:, [0, 2, 1, 3]]) for pairs in laws)
    return Case(data, fresh, meets=False, words=("are q and p in order",))


def recorded(law: Field, half: Sequence[float], sigma: float) -> np.ndarray:
    """Forty sequences (40, 51, 2d) with noise on every state."""
    states = sequences(law, box(half)(40, 1), 0.2, 50)
    rng = np.random.default_rng([SEED, 4, round(-np.log10(sigma))])
    return states + sigma * rng.normal(size=states.shape)


def noisy(law: Field, half: Sequence[float], sigma: float) -> Case:
    """Forty sequences of fifty steps with noise on every state, from a box."""
    fresh = in_sequence(sequences(law, box(half)(20, 2), 0.2, 50), 0.2)
    return Case(
        in_sequence(recorded(law, half, sigma), 0.2), fresh, tolerance=1e-8, meets=False,
        words=("noise of about",), sigma=sigma,
    )  # fmt: skip


SIGMAS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
CASES: dict[str, Callable[[], Case]] = {
    "single-orbit": single_orbit,
    "micro-units": micro_units,
    "satellite": partial(satellites, 7e5, True),
    "satellite-any-height": partial(satellites, 1e6, None),
    "penning-linear": partial(penning, 0.0, 20.0),
    "penning-quartic": partial(penning, 0.02, 60.0),
    "double-pendulum": double_pendula,
    "fput-4": partial(chain, 4),
    "fput-8": partial(chain, 8),
    "noisy-file": noisy_file,
    "hidden-parameter": hidden_parameter,
    "twenty-pairs": twenty_pairs,
    "friction": friction,
    "degrees": degrees,
    "degrees-as-angle": degrees_as_angle,
    "wrapped-angle": wrapped_angle,
    "interleaved": interleaved,
    **{f"noise-pendulum-{s:.0e}": partial(noisy, pendulum, [1.0] * 2, s) for s in SIGMAS},
    **{f"noise-henon-heiles-{s:.0e}": partial(noisy, henon_heiles, [0.3] * 4, s) for s in SIGMAS},
}
QUICK = ("single-orbit", "micro-units", "hidden-parameter", "twenty-pairs", "friction", "degrees",
         "degrees-as-angle", "noise-pendulum-1e-03")  # fmt: skip


# What is said and what is true


def by_python(case: Case) -> Learned:
    """The case by `gfnn.fit`. seconds: of the whole call."""
    started = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
        fit = gfnn.fit(
            case.pairs, tolerance=case.tolerance, max_seconds=case.max_seconds, angles=case.angles
        )
    seconds, chosen = time.perf_counter() - started, fit.chosen
    return Learned(
        fit.map, seconds, list(fit.messages), fit.ended, f"{chosen.chart} {chosen.label}",
        chosen.validation_relative, chosen.validation_bound, fit.met,
        None if fit.noise is None else fit.noise.tolist(),
    )  # fmt: skip


def by_command(case: Case) -> Learned:
    """The case by ``gfnn fit``. What was said is what stood on standard error."""
    with tempfile.TemporaryDirectory() as folder:
        data, model = Path(folder) / "data.csv", Path(folder) / "model"
        data.write_text(case.csv, encoding="utf-8")
        started = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "gfnn_jax", "fit", data, "--out", model, "--tolerance",
             f"{case.tolerance:g}", "--max-seconds", f"{case.max_seconds:g}"],
            capture_output=True, text=True, check=True,
            env=os.environ | {"PYTHONPATH": str(HERE.parent)},
        )  # fmt: skip
        seconds = time.perf_counter() - started
        report = json.loads((model / "report.json").read_text(encoding="utf-8"))
        map_ = gfnn.load(model)
    fit, chosen = report["fit"], report["model"]
    before, lines = "gfnn: warning: ", done.stderr.splitlines()
    said = [line.removeprefix(before) for line in lines if line.startswith(before)]
    return Learned(
        map_, seconds, said, fit["ended"], f"{chosen['chart']} {chosen['label']}",
        fit["validation_relative"], fit["validation_bound"], fit["tolerance_met"],
        report["data"]["noise"],
    )  # fmt: skip


def true_error(map_: gfnn.SymplecticMap, case: Case) -> float:
    """RMS over coordinates of the one-step error of fresh states ÷ the spread of the data."""
    image = np.asarray(map_.step(case.fresh.z0)[0])
    error = nearest_image(image - np.asarray(case.fresh.z1), case.angles)
    return float(np.sqrt(np.mean((error / sizes(case.pairs.z0)) ** 2)))


def untruths(case: Case, learned: Learned, error: float) -> list[str]:
    """List what the fit said wrongly, or did not say."""
    said = " ".join([*learned.messages, learned.ended])
    found = [f"not said: {pattern}" for pattern in case.words if not re.search(pattern, said)]
    found += [f"said: {pattern}" for pattern in case.never if re.search(pattern, said)]
    if case.quiet and learned.messages:
        found.append("warned without a reason")
    if not learned.met and "no candidate meets" not in said:
        found.append("not said: no candidate meets the tolerance")
    found += wrong_claims(case, learned, error)
    found += wrong_noise(case, learned, error, said)
    return found + wrong_volume(case, said)


def wrong_claims(case: Case, learned: Learned, error: float) -> list[str]:
    """Claims that differ from the true error."""
    found = []
    if case.meets is not None and learned.met != case.meets:
        found.append("met" if learned.met else "not met")
    if not error <= _AGREES * learned.bound:
        found.append(f"the error is {error / learned.bound:.2g} times its bound")
    if not case.sigma and not learned.claimed <= _AGREES * error:
        found.append(f"the claim is {learned.claimed / error:.2g} times the error")
    return found


def wrong_noise(case: Case, learned: Learned, error: float, said: str) -> list[str]:
    """List differences between reported noise and error and the true ones."""
    if not case.sigma:
        return []
    ratios, told = noise_ratio(case, learned), re.search(r"own error is then about (\S+) of", said)
    if ratios is None:
        return ["the noise was not measured"]
    own = error / float(np.sqrt(np.mean((case.sigma / sizes(case.pairs.z0)) ** 2)))
    off = [ratio for ratio in ratios if abs(ratio - 1) > _NOISE_WITHIN]
    found = [f"noise of {ratio:.2g} times what it is" for ratio in off]
    if told is None:  # a law's own error is not told
        return found
    if not 1 / _OWN_WITHIN < float(told[1]) / own < _OWN_WITHIN:
        found.append(f"own error {told[1]} of the noise, it is {own:.2g} of it")
    return found


def wrong_volume(case: Case, said: str) -> list[str]:
    """A change of volume that differs from the true one."""
    told = re.search(r"volumes change by (\S+)", said)
    if told is None:
        return []
    missed = abs(float(told[1]) - case.volume_change)
    if missed <= _VOLUME_WITHIN * abs(case.volume_change):
        return []
    return [f"volumes change by {case.volume_change:.2g}, not by {told[1]}"]


def noise_ratio(case: Case, learned: Learned) -> list[float] | None:
    """Measured noise over the true one, per coordinate."""
    return [n / case.sigma for n in learned.noise] if case.sigma and learned.noise else None


def measure(name: str) -> Numbers:
    """Learn a case, and say what was said and what is true."""
    case = CASES[name]()
    learned = (by_command if case.csv else by_python)(case)
    error = true_error(learned.map, case)
    wrong = untruths(case, learned, error)
    return {
        "seconds": learned.seconds, "in_time": learned.seconds <= case.max_seconds,
        "pairs": len(case.pairs), "dim": case.pairs.dim, "tolerance": case.tolerance,
        "messages": learned.messages, "ended": learned.ended, "model": learned.model,
        "claimed": learned.claimed, "bound": learned.bound, "true_error": error,
        "met": learned.met, "noise_ratio": noise_ratio(case, learned), "wrong": wrong,
        "truthful": not wrong,
    }  # fmt: skip


# Table


def table(measured: Numbers) -> str:
    """Markdown: a line per case."""
    heads = ["case", "pairs", "seconds", "chosen", "claimed", "true error", "met",
             "noise measured ÷ true", "what was said", "truthful"]  # fmt: skip
    rows = []
    for name, m in measured.items():
        said = "; ".join([*(message.split(":")[0] for message in m["messages"]), m["ended"]])
        truthful = "yes" if m["truthful"] else f"**no**: {'; '.join(m['wrong'])}"
        noise = ", ".join(f"{ratio:.2f}" for ratio in m["noise_ratio"] or ()) or "–"
        rows.append([name, number(m["pairs"]), number(m["seconds"]), m["model"],
                     number(m["claimed"]), number(m["true_error"]), "yes" if m["met"] else "no",
                     noise, said, truthful])  # fmt: skip
    return markdown(heads, rows)


def tables(path: Path) -> None:
    found = read({"as-a-user": path})
    if found:
        text = table(found["as-a-user"]["measured"])
        between_markers(TABLES, "as-a-user", f"{text}\n\n{provenance(found)}")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", metavar="A,B", help=", ".join(CASES))
    parser.add_argument("--quick", action="store_true", help="few short cases; no table")
    parser.add_argument("--tables", action="store_true", help="only make the table again")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the result")
    arguments = parser.parse_args(argv)
    chosen = (
        arguments.only.split(",") if arguments.only else list(QUICK if arguments.quick else CASES)
    )
    unknown = [name for name in chosen if name not in CASES]
    if unknown:
        parser.error(f"unknown case '{unknown[0]}'; cases: {', '.join(CASES)}")
    folder = arguments.out or (Path("runs/as-a-user") if arguments.quick else RESULTS)
    path = folder / "as-a-user.json"
    measured = read({"": path}).get("", {"measured": {}})["measured"]
    for name in [] if arguments.tables else chosen:
        if name in measured and not arguments.only:
            continue
        measured[name] = m = measure(name)
        measured = {n: measured[n] for n in CASES if n in measured}
        write(path, {"quick": arguments.quick, "measured": measured})
        verdict = "; ".join(m["wrong"]) or "truthful"
        print(
            f"{name}: {m['seconds']:.1f} s, {m['model']}, claimed {m['claimed']:.1e}, true "
            f"{m['true_error']:.1e}, {verdict}",
            flush=True,
        )
        jax.clear_caches()  # a process may map only so many compiled programs
    if folder == RESULTS:
        tables(path)


if __name__ == "__main__":
    main()
