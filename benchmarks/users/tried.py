"""Cases of the second turn: time, words that mislead, mistakes, and what every user has once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

# Sets float64, so it comes before all of JAX.
from harness import SEED

# isort: split
import numpy as np
from users.case import Case, Field, box, changed, flow, in_sequence, independent, sequences
from users.known import drawn, noisy, recorded, swings, wrapped_angle
from users.systems import (
    CART,
    CHAIN_OF_DUFFINGS,
    FOUR_BODIES,
    HENON_HEILES_3,
    KEPLER,
    TOP,
    WELLS,
    dry_pendulum,
    fput,
    henon_heiles,
    of_energy,
    pendulum,
    resisting_air,
    toda,
)

import gfnn_jax as gfnn

# Said of noise, and of rows that are wrong: of clean pairs neither is true.
_NOISE = ("carry noise", "noise, or", "noise of about", "residuals of H are white")
_CLEAN = (*_NOISE, "outliers", "contradict")
_BETWEEN = "differs? between"
# Said of what smooth functions of the states could be, which dry friction is not.
_SMOOTH = ("function of the states", "a smooth")


# Time: each is given less than its search would like


def kepler(max_seconds: float) -> Case:
    """Two bodies in the plane, told nothing."""

    def draw(num: int, seed: int) -> np.ndarray:
        rng = np.random.default_rng([SEED, seed])
        a, e, turn = rng.uniform(0.8, 1.2, num), rng.uniform(0, 0.4, num), rng.uniform(0, 6.28, num)
        far = np.stack([a * (1 + e), 0 * a, 0 * a, np.sqrt((1 - e) / (a * (1 + e)))], axis=1)
        field, c, s = of_energy(KEPLER, 2), np.cos(turn), np.sin(turn)
        q, p = np.split(
            np.concatenate([flow(field, far[i::8], 0.8 * (i + 1)) for i in range(8)]), 2, axis=1
        )
        c, s = c[: len(q)], s[: len(q)]
        q, p = (np.stack([c * x - s * y, s * x + c * y], axis=1) for x, y in (q.T, p.T))
        return np.concatenate([q, p], axis=1)

    pairs, fresh = drawn(of_energy(KEPLER, 2), draw, 0.2, 1_800)
    return Case(pairs, fresh, max_seconds=max_seconds, meets=None, never=(*_CLEAN, _BETWEEN))


def of_box(text: str, dim: int, half: float, dt: float, num: int, **options) -> Case:
    """Clean pairs of an H from a box around 0."""
    pairs, fresh = drawn(of_energy(text, dim), box([half] * 2 * dim), dt, num)
    return Case(pairs, fresh, **{"meets": None, "never": _CLEAN, **options})


def near_bodies(num: int, seed: int, num_steps: int) -> np.ndarray:
    """Trajectories (num, 1 + num_steps, 4) beside three bodies that come no closer than 0.1."""
    rng = np.random.default_rng([SEED, seed])
    r, turn = rng.uniform(0.35, 0.5, 4 * num), rng.uniform(0, 2 * np.pi, 4 * num)
    q = r * np.stack([np.cos(turn), np.sin(turn)])
    speed = rng.uniform(0.9, 1.05, 4 * num) / np.sqrt(r / 0.9)
    z = np.concatenate([q, speed * np.stack([-q[1], q[0]]) / r]).T
    z[:, 0] -= 0.075
    states = sequences(of_energy(FOUR_BODIES, 2), z, 0.1, num_steps)
    corners = np.array([[-0.075, 0.0], [0.791, 0.5], [0.791, -0.5]])
    apart = np.linalg.norm(states[:, :, None, :2] - corners, axis=-1).min(axis=(1, 2))
    return states[apart > 0.1][:num]


def four_bodies(max_seconds: float) -> Case:
    """Chaos, and nothing wrong with it: sequences beside three bodies."""
    pairs, fresh = (in_sequence(near_bodies(n, s, 20), 0.1) for n, s in ((100, 1), (40, 2)))
    never = (*_CLEAN, _BETWEEN)
    return Case(pairs, fresh, max_seconds=max_seconds, meets=None, never=never)


def chain_in_haste() -> Case:
    """A chain of eight, told nothing, in half a minute."""
    pairs, fresh = drawn(fput, box([0.5] * 16), 0.2, 5_000)
    return Case(pairs, fresh, max_seconds=30.0, meets=None, never=_CLEAN)


def toda_32() -> Case:
    """32 particles, told nothing."""
    pairs, fresh = drawn(toda, box([0.3] * 64), 0.1, 1_000)
    return Case(pairs, fresh, meets=None, never=_CLEAN)


def heavy_top() -> Case:
    """Euler angles of a top, told nothing: some map comes of any budget."""

    def draw(num: int, seed: int) -> np.ndarray:
        middle = np.array([0.0, 1.2, 0.0, 1.0, 0.0, 0.8])
        return middle + box([3.0, 0.4, 3.0, 0.3, 0.3, 0.3])(num, seed)

    pairs, fresh = drawn(of_energy(TOP, 3), draw, 0.1, 2_000)
    return Case(pairs, fresh, max_seconds=30.0, meets=None, never=_CLEAN)


def little_time() -> Case:
    """Noise, and a second for all of it: what was not looked at is not told."""
    case = noisy(henon_heiles, [0.3] * 4, 1e-3)
    never = ("noise, or a structure", "larger models are no more accurate: a quantity", _BETWEEN)
    words = ("left out: the test whether the residuals are noise",)
    return dataclasses.replace(
        case, max_seconds=1.0, words=words, never=never, noise_measured=False
    )


# Friction


def loose(num: int, tolerance: float) -> Case:
    """A pendulum that loses 0.0031 of its volume a step, and a tolerance that does not mind."""
    data, fresh = swings(num, friction=0.0155)
    return Case(data, fresh, tolerance=tolerance, words=("friction",), never=_CLEAN)


def rubbing() -> Case:
    """One long record of a pendulum whose bearing rubs."""
    start = np.array([[1.2, 0.0]])
    record = sequences(partial(dry_pendulum, friction=0.01), start, 0.1, 600)
    fresh = sequences(partial(dry_pendulum, friction=0.01), np.array([[1.1, 0.0]]), 0.1, 300)
    pairs = in_sequence(record, 0.1)
    return Case(
        pairs,
        in_sequence(fresh, 0.1),
        meets=None,
        words=("friction", "dry"),
        never=(*_CLEAN, *_SMOOTH),
        max_seconds=30.0,
    )


def rubbing_with_noise() -> Case:
    """The same record behind noise of 1e-4."""
    case = rubbing()
    # A turning point takes 2 c/sin(q) of the volume; there are two in a period of 69 steps.
    states = np.concatenate([case.pairs.z0, case.pairs.z1[-1:]])
    states = states + 1e-4 * np.random.default_rng([SEED, 15]).normal(size=states.shape)
    pairs = gfnn.Pairs(states[:-1], states[1:], 0.1)
    return dataclasses.replace(
        case,
        pairs=pairs,
        words=("friction",),
        never=(*_SMOOTH, _BETWEEN),
        sigma=1e-4,
        noise_measured=False,
        volume_change=-7e-4,
    )


def resisted(law: Field, kind: str) -> Case:
    """Pairs that stand alone of a pendulum whose friction is not linear: it is named."""
    pairs, fresh = drawn(law, box([1.0, 1.0]), 0.1, 1_000)
    return Case(
        pairs,
        fresh,
        meets=None,
        words=("friction", kind),
        never=(*_CLEAN, *_SMOOTH),
        max_seconds=30.0,
    )


# Laws and words


def noise_and_law() -> Case:
    """Where the residuals of H are white, that is said first."""
    case = noisy(henon_heiles, [0.3] * 4, 1e-3)
    return dataclasses.replace(
        case, first="^the residuals of H are white", words=("noise of about",)
    )


def as_file(case: Case) -> Case:
    """The case with its pairs as a file, for the command line."""
    dt, names = float(case.pairs.dt), [f"{x}{i + 1}" for x in "qp" for i in range(case.pairs.dim)]
    lines = [
        f"{n},{t:.1f}," + ",".join(f"{x:.16e}" for x in z)
        for n, pair in enumerate(zip(case.pairs.z0, case.pairs.z1, strict=True))
        for t, z in zip((0.0, dt), pair, strict=True)
    ]
    return dataclasses.replace(case, csv="\n".join([f"sequence,t,{','.join(names)}", *lines, ""]))


def partial_law() -> Case:
    """A wrapped angle as a file: terms that meet nothing are not called H."""
    never = ("H = ", *_CLEAN)
    return dataclasses.replace(as_file(wrapped_angle()), never=never, max_seconds=120.0)


def velocities() -> Case:
    """A pendulum on a cart: angle and positions beside velocities in place of momenta."""

    def velocity(z: np.ndarray) -> np.ndarray:
        x, a, px, pa = z.T
        turn = (pa - px * np.cos(a)) / (2 - np.cos(a) ** 2)
        return np.stack([x, a, px - np.cos(a) * turn, turn], axis=1)

    laws = drawn(of_energy(CART, 2), box([1.0, 1.5, 1.0, 1.0]), 0.2, 2_000)
    data, fresh = (changed(pairs, velocity) for pairs in laws)
    words = ("velocities, learn the law of a recording",)
    return Case(data, fresh, max_seconds=30.0, meets=None, words=words, never=("H = ", *_CLEAN))


def told_angle() -> Case:
    """Rotating pendulums, the angle wrapped and named."""

    def draw(num: int, seed: int) -> np.ndarray:
        return np.array([0.0, 2.8]) + box([np.pi, 0.6])(num, seed)

    def wrap(z: np.ndarray) -> np.ndarray:
        return np.stack([np.remainder(z[:, 0] + np.pi, 2 * np.pi) - np.pi, z[:, 1]], axis=1)

    data, fresh = (changed(pairs, wrap) for pairs in drawn(pendulum, draw, 0.1, 1_000))
    return Case(data, fresh, angles=(0,), words=(r"H = .*cos\(q1\)",), never=_CLEAN)


def few(seed: int) -> Case:
    """Twenty clean pairs: none contradicts the others."""
    z = box([1.0, 1.0])
    pairs, fresh = (independent(pendulum, z(n, 10 * seed + i), 0.2) for i, n in ((3, 20), (4, 500)))
    return Case(pairs, fresh, tolerance=1e-8, meets=None, never=("contradict", "outliers", *_NOISE))


# What every user has once


def uneven() -> Case:
    """Sequences of a pendulum, every step of another length."""
    data, fresh = (uneven_swings(30, n, seed) for n, seed in ((30, 5), (20, 6)))
    return Case(data, fresh, never=_CLEAN)


def uneven_swings(num: int, num_steps: int, seed: int) -> gfnn.Pairs:
    """Steps between 0.1 and 0.4 of so many pendulums."""
    rng, states, steps = np.random.default_rng([SEED, seed]), [box([1.0, 1.0])(num, seed)], []
    for _ in range(num_steps):
        dt = rng.uniform(0.1, 0.4, num)
        scaled = partial(_at_own_rate, pendulum, dt)
        states.append(flow(scaled, states[-1], 1.0))
        steps.append(dt)
    z, dt = np.stack(states, axis=1), np.stack(steps, axis=1)
    return gfnn.Pairs(z[:, :-1].reshape(-1, 2), z[:, 1:].reshape(-1, 2), dt.ravel())


def _at_own_rate(field: Field, dt: np.ndarray, z: np.ndarray) -> np.ndarray:
    return dt * field(z)


def parameter() -> Case:
    """Pendulums of several lengths, which are told."""

    def of(num: int, seed: int) -> gfnn.Pairs:
        k = np.random.default_rng([SEED, seed]).uniform(0.5, 2.0, num)
        pairs = independent(partial(pendulum, stiffness=k), box([1.0, 1.0])(num, seed), 0.2)
        return dataclasses.replace(pairs, args={"k": k})

    return Case(of(1_000, 7), of(500, 8), angles=(0,), never=(*_CLEAN, _BETWEEN))


def hidden_in_pairs() -> Case:
    """The same lengths, not told, in single pairs, which cannot tell them from noise."""
    case = parameter()
    data, fresh = (dataclasses.replace(pairs, args=None) for pairs in (case.pairs, case.fresh))
    return Case(data, fresh, meets=False, words=("the states do not hold",))


def single_noisy_pairs() -> Case:
    """Pairs with noise on both states, none of them in a sequence."""
    exact, fresh = swings(2_000)
    rng = np.random.default_rng([SEED, 9])
    z0, z1 = (z + 1e-3 * rng.normal(size=z.shape) for z in (exact.z0, exact.z1))
    return Case(
        gfnn.Pairs(z0, z1, 0.2),
        fresh,
        tolerance=1e-8,
        meets=False,
        sigma=1e-3,
        words=("noise of about",),
        never=(_BETWEEN,),
    )


def rounded() -> Case:
    """Sequences whose numbers are given to three digits behind the point."""
    states = np.round(sequences(pendulum, box([1.0, 1.0])(40, 1), 0.2, 50), 3)
    fresh = in_sequence(sequences(pendulum, box([1.0, 1.0])(20, 2), 0.2, 50), 0.2)
    return Case(
        in_sequence(states, 0.2),
        fresh,
        tolerance=1e-6,
        meets=False,
        words=("noise of about",),
        sigma=1e-3 / np.sqrt(12),
    )


def single_precision() -> Case:
    """Clean states that were kept as float32: a tolerance of 1e-5 does not mind."""
    data, fresh = (changed(p, lambda z: z.astype(np.float32).astype(float)) for p in swings(1_000))
    return Case(data, fresh, tolerance=1e-5, quiet=True)


def gross() -> Case:
    """Two per cent of the momenta are wrong by half their size."""
    exact, fresh = swings(2_000)
    rng, z1 = np.random.default_rng([SEED, 10]), np.array(exact.z1)
    bad = rng.permutation(2_000)[:40]
    z1[bad, 1] += rng.choice([-0.5, 0.5], 40)
    words = ("of 2000 pairs",)
    return Case(gfnn.Pairs(exact.z0, z1, 0.2), fresh, tolerance=1e-8, words=words, never=_NOISE)


def copies() -> Case:
    """Every pair twice."""
    exact, fresh = swings(500)
    twice = gfnn.Pairs(np.tile(exact.z0, (2, 1)), np.tile(exact.z1, (2, 1)), 0.2)
    return Case(twice, fresh, words=("500 of 1000 pairs are copies",), never=_CLEAN)


def mixed_units() -> Case:
    """Millions of metres beside thousandths of a unit of momentum."""
    size = np.array([1e6, 1e-3])
    data, fresh = (changed(pairs, partial(np.multiply, size)) for pairs in swings(1_000))
    return Case(data, fresh, quiet=True)


def mass_two() -> Case:
    """Velocities of a constant mass are momenta in other units."""
    data, fresh = (changed(p, partial(np.multiply, [1.0, 0.5])) for p in swings(1_000))
    return Case(data, fresh, quiet=True)


def kicked(strength: float) -> Case:
    """A kicked rotor: a map, and no flow."""

    def image(z: np.ndarray) -> np.ndarray:
        p = z[:, 1] + strength * np.sin(z[:, 0])
        return np.stack([z[:, 0] + p, p], axis=1)

    data, fresh = (box([np.pi, 1.0])(n, s) for n, s in ((1_000, 11), (500, 12)))
    pairs, others = (gfnn.Pairs(z, image(z), 1.0) for z in (data, fresh))
    return Case(pairs, others, angles=(0,), never=_CLEAN)


def damped_kicks() -> Case:
    """A kicked rotor that loses a tenth of its momentum."""

    def image(z: np.ndarray) -> np.ndarray:
        p = 0.9 * z[:, 1] + 0.8 * np.sin(z[:, 0])
        return np.stack([z[:, 0] + p, p], axis=1)

    data, fresh = (box([np.pi, 1.0])(n, s) for n, s in ((1_000, 11), (500, 12)))
    pairs, others = (gfnn.Pairs(z, image(z), 1.0) for z in (data, fresh))
    return Case(pairs, others, angles=(0,), never=_CLEAN)


def ring() -> Case:
    """A chain of 16, told that it is one."""
    pairs, fresh = drawn(fput, box([0.5] * 32), 0.2, 100)
    return Case(pairs, fresh, options={"structure": "chain"}, never=_CLEAN, tolerance=1e-8)


def long_step() -> Case:
    """Oscillators that turn by 4 radians in a step: one dt does not tell H."""
    pairs, fresh = drawn(of_energy("(q1**2 + p1**2)/2 + q1**4/10", 1), box([0.5, 0.5]), 4.0, 600)
    return Case(pairs, fresh, meets=None, never=_CLEAN)


def one_record() -> Case:
    """One record of two oscillators with noise: 600 states."""
    start = np.array([[0.3, -0.1, 0.1, 0.2]])
    exact = sequences(henon_heiles, start, 0.2, 600)
    noise = np.random.default_rng([SEED, 13]).normal(size=exact.shape)
    fresh = sequences(henon_heiles, exact[:, 300] * 1.0, 0.2, 100)
    return Case(
        in_sequence(exact + 1e-3 * noise, 0.2),
        in_sequence(fresh, 0.2),
        tolerance=1e-8,
        meets=False,
        sigma=1e-3,
        words=("noise of about",),
        never=(_BETWEEN,),
    )


def noisy_wrapped() -> Case:
    """Swings and turns with noise, the angle wrapped and not named."""
    z = np.array([0.0, 2.8]) + box([np.pi, 0.6])(40, 14)
    states = sequences(pendulum, z, 0.1, 50)
    states += 1e-3 * np.random.default_rng([SEED, 14]).normal(size=states.shape)
    states[..., 0] = np.remainder(states[..., 0] + np.pi, 2 * np.pi) - np.pi
    pairs = in_sequence(states, 0.1)
    return Case(
        pairs,
        pairs,
        max_seconds=20.0,
        meets=False,
        words=("jumps of 2π", "angles"),
        never=("noise", "contradict", "gross"),
    )


def noisy_friction() -> Case:
    """A damped pendulum, forty sequences with noise."""
    law = partial(pendulum, friction=0.1)
    fresh = in_sequence(sequences(law, box([1.0, 1.0])(20, 2), 0.2, 50), 0.2)
    return Case(
        in_sequence(recorded(law, [1.0, 1.0], 1e-3), 0.2),
        fresh,
        tolerance=1e-8,
        meets=False,
        sigma=1e-3,
        words=("friction",),
        never=(_BETWEEN,),
    )


TRIED: dict[str, Callable[[], Case]] = {
    "kepler-20-s": partial(kepler, 20.0),
    "kepler-clean": partial(kepler, 60.0),
    "four-bodies-30-s": partial(four_bodies, 30.0),
    "four-bodies": partial(four_bodies, 60.0),
    "duffings-30-s": partial(of_box, CHAIN_OF_DUFFINGS, 3, 1.0, 0.2, 2_000, max_seconds=30.0),
    "fput-8-30-s": chain_in_haste,
    "cart-30-s": partial(of_box, CART, 2, 1.0, 0.2, 2_000, max_seconds=30.0),
    "toda-32": toda_32,
    "heavy-top": heavy_top,
    "little-time": little_time,
    "henon-heiles-3": partial(of_box, HENON_HEILES_3, 3, 0.3, 0.2, 2_000),
    "friction-loose": partial(loose, 2_000, 1e-2),
    "friction-looser": partial(loose, 300, 3e-2),
    "friction-dry": rubbing,
    "friction-dry-noisy": rubbing_with_noise,
    "friction-dry-pairs": partial(resisted, partial(dry_pendulum, friction=0.01), "dry"),
    "friction-quadratic-pairs": partial(resisted, resisting_air, "quadratic"),
    "friction-noisy": noisy_friction,
    "law-first": noise_and_law,
    "kepler-file": lambda: as_file(kepler(20.0)),
    "partial-law": partial_law,
    "velocities": velocities,
    "quartic-wells": partial(of_box, WELLS, 3, 1.2, 0.1, 2_000, never=("cos", "sin", *_CLEAN)),
    "told-angle": told_angle,
    "noisy-wrapped": noisy_wrapped,
    **{f"twenty-pairs-{seed}": partial(few, seed) for seed in (1, 2)},
    "uneven": uneven,
    "parameter": parameter,
    "hidden-in-pairs": hidden_in_pairs,
    "single-noisy-pairs": single_noisy_pairs,
    "rounded": rounded,
    "single-precision": single_precision,
    "gross-errors": gross,
    "copies": copies,
    "mixed-units": mixed_units,
    "mass-two": mass_two,
    "kicked": partial(kicked, 0.8),
    "damped-kicks": damped_kicks,
    "told-chain": ring,
    "long-step": long_step,
    "one-record": one_record,
}
