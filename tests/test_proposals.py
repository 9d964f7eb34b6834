"""`gfnn look` proposes what a table holds, on systems drawn at random, and nothing else."""

import tracemalloc

import numpy as np
import pytest
from analytic import motion
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.data.columns import Undecided, explained
from gfnn_jax.data.recording_summary import refuse_mistakes
from gfnn_jax.errors import InputError

T = 0.03 * np.arange(300)


def moved(rate, start, t=T):
    """Positions of ẍ = rate(x, v) from (x, v)."""
    return motion(rate, start, t, method="DOP853", atol=1e-10)[0]


def pendulum(rng, amplitude, t=T):
    k, c = rng.uniform(10, 30), rng.uniform(0.02, 0.2)
    return moved(lambda x, v: -k * np.sin(x) - c * v, (amplitude, 0.0), t)


def spring(rng, amplitude, t=T):
    k, b, c = rng.uniform(10, 25), rng.uniform(0, 0.3), rng.uniform(0.02, 0.3)
    return moved(lambda x, v: -k * x - b * x**3 - c * v, (amplitude, 0.0), t)


def noisy(rng, x, size=1e-3):
    return x + size * np.std(x) * rng.standard_normal(np.shape(x))


def summary(columns, **options):
    return gfnn.Recording({"t": T, **columns}, **options).summary()


def seeds(count):
    """Draws of so many systems, of which all but the first are slow."""
    return [0, *(pytest.param(n, marks=pytest.mark.slow) for n in range(1, count))]


def kinds(found):
    return [fault.kind for fault in found.faults if fault.kind != "reading"]


@pytest.mark.parametrize("seed", seeds(6))
def test_an_angle_by_its_accelerations(seed):
    rng = np.random.default_rng(seed)
    x = noisy(rng, pendulum(rng, rng.uniform(2.0, 2.8)))
    assert summary({"position": x}).options == {"angles": ("position",)}
    assert summary({"position": np.degrees(x)}).options == {"degrees": ("position",)}
    assert summary({"theta": x}).options == {}
    assert kinds(summary({"theta": x})) == []


@pytest.mark.parametrize("seed", seeds(6))
def test_a_length_by_its_accelerations(seed):
    rng = np.random.default_rng(seed)
    x = noisy(rng, spring(rng, rng.uniform(3.0, 5.0)))
    assert summary({"theta": x}).options.get("angles") == ()
    assert kinds(summary({"x": x})) == []


@pytest.mark.parametrize("seed", seeds(4))
def test_small_motions_propose_nothing(seed):
    rng = np.random.default_rng(seed)
    for x in (pendulum(rng, 0.4), spring(rng, 0.4)):
        assert kinds(summary({"x": noisy(rng, x)})) == []
        assert kinds(summary({"theta": noisy(rng, x)})) == []


@pytest.mark.parametrize("seed", seeds(4))
def test_points_on_a_circle_are_an_angle_and_the_command_has_it(seed):
    rng = np.random.default_rng(seed)
    x0, y0, length = rng.uniform(-3, 3), rng.uniform(-3, 3), rng.uniform(0.3, 3)
    theta = pendulum(rng, rng.uniform(0.4, 2.5))
    x, y = x0 + length * np.sin(theta), y0 - length * np.cos(theta)
    table = {"x": noisy(rng, x), "y": noisy(rng, y)}
    found = summary(table)
    assert kinds(found) == ["circle"]
    assert found.options["guess"] == pytest.approx({"x0": x0, "y0": y0, "l": length}, abs=2e-2)
    read = {n: v for n, v in found.options.items() if n != "mass"}
    again = gfnn.Recording({"t": T, **table}, **read)
    assert again.coordinates == again.angles == ("theta",)
    assert kinds(again.summary()) == []
    with pytest.raises(InputError, match=r"coordinates=\[.theta.\] observe="):
        refuse_mistakes(gfnn.Recording({"t": T, **table}))
    refuse_mistakes(gfnn.Recording({"t": T, **table}), ["circle"])


def test_two_rods_are_two_angles():
    rng = np.random.default_rng(3)
    one, two = pendulum(rng, 1.2), pendulum(rng, 0.8)
    x1, y1 = 0.7 * np.sin(one), -0.7 * np.cos(one)
    table = {"x1": x1, "y1": y1, "x2": x1 + 0.4 * np.sin(two), "y2": y1 - 0.4 * np.cos(two)}
    found = summary({name: noisy(rng, x) for name, x in table.items()})
    assert found.options["coordinates"] == ("theta1", "theta2")
    assert found.options["guess"] == pytest.approx(
        {"x0": 0, "y0": 0, "l1": 0.7, "l2": 0.4}, abs=1e-2
    )


@pytest.mark.parametrize("seed", seeds(3))
def test_an_orbit_is_no_pendulum(seed):
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.6, 2.0) * T + rng.uniform(0, 6)
    assert "circle" not in kinds(summary({"x": np.cos(phase), "y": np.sin(phase)}))
    free = {"x": spring(rng, 1.0), "y": spring(rng, 0.5)}
    assert "circle" not in kinds(summary({n: noisy(rng, x) for n, x in free.items()}))


@pytest.mark.parametrize("seed", seeds(4))
def test_a_hand_that_lets_go_and_one_that_catches(seed):
    rng = np.random.default_rng(seed)
    free = pendulum(rng, rng.uniform(0.6, 1.2))
    t = 0.03 * np.arange(420)
    led = free[0] * 0.5 * (1 - np.cos(np.pi * np.arange(60) / 60))
    x = np.concatenate([np.zeros(60), led, free])
    x = x + 1e-3 * rng.standard_normal(len(x))
    found = gfnn.Recording({"t": t, "theta": x}).summary()
    assert found.options["start"] == pytest.approx(t[120], abs=0.1)
    end = np.concatenate([free[:250], np.zeros(170)]) + 1e-3 * rng.standard_normal(420)
    found = gfnn.Recording({"t": t, "theta": end}).summary()
    assert "start" not in found.options
    assert 0 <= t[250] - found.options["stop"] < 1.5
    for kept in (x[120:], end[: int(found.options["stop"] / 0.03)]):
        again = gfnn.Recording({"t": t[: len(kept)], "theta": kept}).summary()
        assert kinds(again) == []


def test_a_release_from_rest_in_fine_steps_is_no_hand():
    t = 1e-3 * np.arange(4000)
    x = pendulum(np.random.default_rng(0), 1.0, t) + 1e-3 * np.random.default_rng(1).normal(
        size=4000
    )
    assert kinds(gfnn.Recording({"t": t, "theta": x}).summary()) == []


def test_dry_friction_that_stops_a_motion_is_no_hand():
    t = 0.03 * np.arange(500)
    x = moved(lambda x, v: -9 * x - 0.5 * np.tanh(v / 1e-3), (1.5, 0.0), t)
    x = np.where(t > 13, x[-1], x) + 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    assert not {"let go", "caught"} & set(kinds(gfnn.Recording({"t": t, "x": x}).summary()))


@pytest.mark.parametrize(("step", "digits"), [(1 / 30, 2), (2.5e-3, 3), (0.1, 3)])
def test_rounded_times_propose_the_even_step(step, digits):
    t = np.round(step * np.arange(300), digits)
    found = gfnn.Recording({"t": t, "x": np.cos(0.3 * np.arange(300))}).summary()
    if digits == 3 and step == 0.1:
        assert "dt" not in found.options
    else:
        assert found.options["dt"] == pytest.approx(step, rel=1e-3)


def test_a_voltage_called_v_is_an_input():
    rng = np.random.default_rng(0)
    v = 2 * np.sin(1.3 * T) + np.sign(np.sin(3.1 * T))
    found = solve_ivp(
        lambda s, z: [z[1], -12 * z[0] - 0.5 * z[1] + 9 * np.interp(s, T, v)],
        (0, T[-1]),
        (0.3, 0),
        t_eval=T,
        rtol=1e-8,
        atol=1e-8,
    )
    x = noisy(rng, found.y[0])
    v[len(v) // 2] = np.nan  # a value that is missing is no reason to leave it out
    assert summary({"x": x, "v": v}).options == {"positions": ("x",), "inputs": ("v",)}


def test_a_velocity_of_the_wrong_sign_is_no_swapped_column():
    x = pendulum(np.random.default_rng(0), 0.3)
    found = summary({"theta": x, "omega": -np.gradient(x, T)})
    assert kinds(found) == ["sign"]


def test_exact_velocities_are_no_differences_and_no_period_is_told_that_is_not_seen():
    phase = 2 * np.pi * 0.6 * np.arange(200) / 200
    t = 18.0 * np.arange(200)
    rate = 2 * np.pi * 0.6 / 3600
    x, y = np.cos(phase), np.sin(phase)
    table = {"t": t, "x": x, "y": y, "vx": -rate * y, "vy": rate * x}
    found = gfnn.Recording(table).summary()
    assert found.faults == ()
    assert found.period is None
    assert found.loss is None
    assert "its period is longer than the runs show" in str(found)


@pytest.mark.parametrize(
    ("names", "moves", "shown"),
    [
        (["v (m/s)"], "x", {"v": "v + b"}),
        (["Fahrt [cm/s]"], "x", {"Fahrt": "v + b"}),
        (["omega"], "theta", {"omega": "omega + b"}),
        (["omega1", "omega2"], "theta1 theta2", {"omega1": "omega1 + b1", "omega2": "omega2 + b2"}),
        (["acc (m/s^2)"], "x", {"acc": "x_ddot + b"}),
        (["ax (m/s²)", "az (m/s²)"], "theta", {"az": "A*omega**2 + G*cos(theta)"}),
    ],
)
def test_what_shows_no_position_is_none(tmp_path, names, moves, shown):
    """Speeds and accelerations, of which those about g are along a rod."""
    columns = np.stack([T, np.cos(T), 9.8 + np.sin(1.7 * T)][: 1 + len(names)], axis=1)
    head = ",".join(["t", *names])
    np.savetxt(tmp_path / "a.csv", columns, "%.6f", ",", header=head, comments="", encoding="utf-8")
    with pytest.raises(Undecided) as error:
        gfnn.read(tmp_path / "a.csv")
    assert error.value.options == {"coordinates": tuple(moves.split()), "observe": shown}


def tumbling(rng, count, noise=0.01):
    """Runs of the rates of a body of random inertia, with noise relative to their spread."""
    root = rng.normal(size=(3, 3))
    inertia = root @ root.T + rng.uniform(1, 3) * np.eye(3)

    def rates(t, w):
        return np.linalg.solve(inertia, np.cross(inertia @ w, w))

    t = 0.02 * np.arange(200)
    runs = [
        solve_ivp(rates, (0, t[-1]), 3 * rng.normal(size=3), t_eval=t, rtol=1e-8).y.T
        for _ in range(count)
    ]
    w = np.concatenate(runs)
    w += noise * w.std(axis=0) * rng.normal(size=w.shape)
    return {"run": np.repeat(np.arange(count), len(t)), "t": np.tile(t, count)}, w.T


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_rates_of_a_body_are_no_positions(seed):
    begin, w = tumbling(np.random.default_rng(seed), 6)
    for names in (("wx", "wy", "wz"), ("x", "y", "z")):
        recording = gfnn.Recording(begin | dict(zip(names, w, strict=True)), positions=names)
        assert kinds(recording.summary()) == ["first order"]
        command = f"--structure poisson --states {','.join(names)}"
        assert command in recording.summary().command
        with pytest.raises(
            InputError, match=r"Learn their bracket: structure=.poisson. positions="
        ):
            refuse_mistakes(recording)


@pytest.mark.parametrize("names", [("wx", "wy", "wz"), ("gyro_x", "gyro_y", "gyro_z")])
def test_names_tell_rates_of_turning(names):
    begin, w = tumbling(np.random.default_rng(0), 1)
    with pytest.raises(InputError, match=r"about three axes.*3 or more runs of different speeds"):
        gfnn.Recording(begin | dict(zip(names, w, strict=True)))


@pytest.mark.parametrize("seed", seeds(3))
@pytest.mark.parametrize("dim", [2, 3])
def test_bodies_on_springs_and_in_orbits_are_positions(seed, dim):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(dim, dim))
    stiffness, damping = root @ root.T + 2 * np.eye(dim), rng.choice([0, 0.3])
    t, runs = 0.05 * np.arange(200), []

    def springs(t, z):
        return np.concatenate([z[dim:], -stiffness @ z[:dim] - damping * z[dim:]])

    def orbits(t, z):
        return np.concatenate([z[dim:], -z[:dim] / np.linalg.norm(z[:dim]) ** 3])

    for rates, turned in ((springs, 0.0), (orbits, 1.0)):
        starts = rng.normal(size=(5, 2 * dim))
        starts[:, 0], starts[:, dim + 1] = 1 + 0.2 * starts[:, 0], turned + 0.2 * starts[:, dim + 1]
        runs = [solve_ivp(rates, (0, t[-1]), z, t_eval=t, rtol=1e-8).y[:dim] for z in starts]
        table = {"run": np.repeat(np.arange(5), len(t)), "t": np.tile(t, 5)}
        table |= dict(zip("xyz", np.concatenate(runs, axis=1), strict=False))
        found = gfnn.Recording(table, positions=list("xyz"[:dim])).summary()
        assert "first order" not in kinds(found)


def test_populations_are_states_of_first_order():
    def rates(s, z):
        return [z[0] * (0.8 - 0.02 * z[1]), z[1] * (0.03 * z[0] - 0.9)]

    t = np.arange(1900.0, 1960)
    found = solve_ivp(rates, (t[0], t[-1]), (31, 19.5), t_eval=t, rtol=1e-9)
    table = {"Year": t, "Prey": found.y[0], "Predator": 10 * found.y[1]}
    with pytest.raises(InputError, match=r"structure=.poisson. positions=\[.Prey., .Predator.\]"):
        gfnn.Recording(table)
    carts = {"t": T, "one": np.cos(T) + np.cos(1.7 * T), "two": np.cos(T) - np.cos(1.7 * T)}
    with pytest.raises(InputError, match="or some of them and inputs="):
        gfnn.Recording(carts)


def test_random_walks_are_no_states():
    """Of one run, each part is judged by the others: six functions fit a short walk by chance."""
    rng = np.random.default_rng(5)
    for length in (40, 80, 160):
        t, walk = np.arange(length) * 0.1, np.cumsum(rng.normal(size=(length, 2)), axis=0)
        assert explained([t], [walk]) < 0.3


def test_states_of_a_long_record_are_told_in_little_memory():
    """A function at a time: side by side, those of a million rows took two gigabytes."""
    t = np.arange(200_000) * 1e-3
    x = np.stack([np.cos(w * t) for w in (1.0, 1.7, 2.9)], axis=1)
    tracemalloc.start()
    assert explained([t], [x]) < 0.9
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 20 * x.nbytes
