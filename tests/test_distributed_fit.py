"""Fits of several processes: each reads its own rows, and one factor goes up a tree."""

import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from analytic import moved, rotated
from other_python import ended, started

import gfnn_jax as gfnn
from gfnn_jax import processes
from gfnn_jax.data.files import iterate_pairs
from gfnn_jax.data.sample import read_sample
from gfnn_jax.errors import InputError
from gfnn_jax.jobs import fit as fit_job
from gfnn_jax.jobs.output import Output
from gfnn_jax.learn.refit import help_refit, refit
from gfnn_jax.maps import saved
from gfnn_jax.processes import Group, Share

DT, PAIRS = 0.5, 1_200
COUNTS = (1, 2, 4)


class Store:
    """The runtime's store of keys and values, of threads that stand for processes."""

    def __init__(self):
        self.values, self.changed = {}, threading.Condition()

    def key_value_set_bytes(self, key, value):
        with self.changed:
            self.values[key] = value
            self.changed.notify_all()

    def blocking_key_value_get_bytes(self, key, milliseconds):
        with self.changed:
            assert self.changed.wait_for(lambda: key in self.values, 60)
            return self.values[key]

    def key_value_delete(self, key):
        del self.values[key]


@pytest.fixture
def in_threads(monkeypatch):
    """Results of ``work(group)`` in each of ``count`` processes, simulated by threads."""

    def run(count, work):
        store = Store()
        monkeypatch.setattr(processes, "_store", lambda: store)
        with ThreadPoolExecutor(count) as pool:
            return [*pool.map(lambda i: work(Group(Share(i, count))), range(count))]

    return run


@pytest.mark.parametrize("count", range(1, 8))
def test_a_tree_merges_neighbours(count, in_threads):
    def work(group):
        told = group.broadcast({"a": np.array([7.0])} if group.first else None)
        own = {"own": np.array([group.share.index])}
        found = group.folded(own, lambda a, b: {"own": np.append(a["own"], b["own"])})
        return told["a"].item(), found["own"].tolist(), group.sent

    found = in_threads(count, work)
    assert [told for told, *_ in found] == [7.0] * count
    assert found[0][1] == [*range(count)]
    assert all(sent > 0 for *_, sent in found[1:])  # one message each, up the tree


def image(z):
    """A kick and a turn: the flow of an oscillator of frequency 1 after a kick, no flow of few
    terms itself."""
    return rotated(z - [0.0, 0.1] * z[:, :1] ** 2, DT)


def flow(z):
    """Flow of H = p²/2 + q⁴/4."""
    return moved(lambda _, z: [z[1], -(z[0] ** 3)], z, DT)


def noisy(function, sigma=5e-4):
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (PAIRS, 2))
    noise = sigma * rng.standard_normal((2, *z.shape))
    return gfnn.Pairs(z + noise[0], function(z) + noise[1], DT)


@pytest.fixture(scope="module")
def fits():
    """(pairs, held out, the fit of a sample) of a map and of a law."""
    found = {}
    for name, function, options in (
        ("map", image, {"chart": "midpoint"}),
        ("hamiltonian", flow, {"terms": ("p1**2", "q1**4", "q1**2")}),
    ):
        pairs = noisy(function)
        few = pairs.take(slice(100, 300))
        found[name] = (
            pairs,
            pairs.take(slice(100)),
            gfnn.fit(few, learn=name, tolerance=2e-3, **options),
        )
    return found


def refitted(group, pairs, held, fit):
    own = [pairs.take(group.share.of(PAIRS, 1))]
    if group.first:
        return refit(fit, own, held, group=group)
    return help_refit(group.broadcast(), own, group)


@pytest.mark.slow
@pytest.mark.parametrize("learns", ["map", "hamiltonian"])
def test_the_same_fit_of_any_number_of_processes(learns, fits, in_threads):
    _, held, fit = fits[learns]
    assert fit.chosen.learns == learns
    found = [in_threads(count, lambda group: refitted(group, *fits[learns])) for count in COUNTS]
    one = found[0][0]
    for others in found:
        again, *helped = others
        assert again.num_pairs == PAIRS
        assert sum(helped) <= PAIRS * (len(others) - 1) / len(others) + 1
        moved = [np.asarray(f.map.step(held.z0)[0]) for f in (again, one)]
        np.testing.assert_allclose(moved[0], moved[1], rtol=0, atol=1e-12)
    if learns == "hamiltonian":
        z = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 2))
        moved = [np.asarray(f.map.step(z)[0]) for f in (fit, one)]
        errors = [np.sqrt(np.mean((states - flow(z)) ** 2)) for states in moved]
        assert errors[1] < 0.7 * errors[0]  # six times the pairs: √6 at best
        coefficients = np.asarray(one.map.pieces[0].params)
        np.testing.assert_array_equal([t.coefficient for t in one.hamiltonian.terms], coefficients)
        assert one.formula != fit.formula


def files(folder):
    rng = np.random.default_rng(0)
    states = rng.normal(size=(40, 7, 2))
    lengths = rng.integers(1, 8, 40)
    np.savez(folder / "sequences.npz", trajectories=states, lengths=lengths, dt=DT)
    np.savez_compressed(folder / "packed.npz", trajectories=states, dt=DT)
    np.save(folder / "one.npy", states.reshape(-1, 2).astype(np.float32))
    np.savez(
        folder / "pairs.npz",
        z0=states[:, 0],
        z1=states[:, 1],
        dt=np.linspace(1, 2, 40),
        params=np.arange(40.0),
    )
    return ("sequences.npz", "packed.npz", "one.npy", "pairs.npz")


def test_rows_of_a_file_are_shared_out(tmp_path):
    for name in files(tmp_path):
        dt = DT if name == "one.npy" else None
        whole = next(iterate_pairs(tmp_path / name, 10**6, dt=dt))
        for count in (2, 3, 50):
            shares = [Share(i, count) for i in range(count)]
            parts = [p for s in shares for p in iterate_pairs(tmp_path / name, 9, dt=dt, share=s)]
            for wanted in ("z0", "z1"):
                got = np.concatenate([getattr(part, wanted) for part in parts])
                np.testing.assert_array_equal(got, getattr(whole, wanted))
            if name == "pairs.npz":
                np.testing.assert_array_equal(np.concatenate([p.dt for p in parts]), whole.dt)
                args = np.concatenate([p.args["a1"] for p in parts])
                np.testing.assert_array_equal(args, whole.args["a1"])


@pytest.mark.parametrize("num_pairs", [50, 10_000])
def test_the_same_sample_of_any_number_of_processes(num_pairs, tmp_path, in_threads):
    states = np.random.default_rng(0).normal(size=(3, 200, 2, 2))
    names = [tmp_path / f"{i}.npz" for i in range(3)]
    for name, rows in zip(names, states, strict=True):
        np.savez(name, z0=rows[:, 0], z1=rows[:, 1], dt=DT)
    for paths in (names, names[0]):
        found = [
            in_threads(count, lambda g, p=paths: read_sample(p, num_pairs=num_pairs, group=g))[0]
            for count in (1, 2, 3, 5)
        ]
        for other in found[1:]:
            np.testing.assert_array_equal(other.states, found[0].states)
            assert other.digest == found[0].digest
        assert found[0].num_pairs == min(num_pairs, 600 if paths is names else 200)
    states[0, 7, 1, 1] += 1e-9
    np.savez(names[0], z0=states[0, :, 0], z1=states[0, :, 1], dt=DT)
    assert read_sample(names[0], num_pairs=50, group=Group()).digest != found[0].digest


def test_a_sample_of_any_number_of_processes_keeps_runs_and_places(tmp_path, in_threads):
    """Each row says of which sequence of the file it is, and where along it."""
    states, path = np.random.default_rng(0).normal(size=(4, 300, 2)), tmp_path / "runs.npz"
    np.savez(path, trajectories=states, dt=DT)
    for count in (1, 2, 3):
        sample = in_threads(count, lambda g: read_sample(path, num_pairs=400, group=g))[0]
        run, place, rows = sample.run, sample.place, sample.states.reshape(-1, 2, 2)
        assert 350 <= len(rows) <= 400
        np.testing.assert_array_equal(rows[:, 0], states[run, place])
        np.testing.assert_array_equal(rows[:, 1], states[run, place + 1])
        assert len(np.unique(run)) > 1
        assert np.sum((np.diff(run) == 0) & (np.diff(place) == 1)) > 0.9 * len(rows)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_process_may_have_no_pair(order, tmp_path, in_threads):
    """Sequences of one state."""
    states = np.random.default_rng(0).normal(size=(40, 2, 2))
    np.savez(tmp_path / "0.npz", z0=states[:, 0], z1=states[:, 1], dt=DT)
    np.savez(tmp_path / "1.npz", trajectories=states[:5, :1], dt=DT)
    paths = [tmp_path / f"{i}.npz" for i in order]
    found = in_threads(2, lambda group: read_sample(paths, group=group))
    alone = read_sample(paths, group=Group())
    np.testing.assert_array_equal(found[0].states, alone.states)
    assert (found[0].dt, found[0].digest) == (DT, alone.digest)
    with pytest.raises(InputError, match="no pair"):
        in_threads(2, lambda group: read_sample([tmp_path / "1.npz"] * 2, group=group))


def test_files_that_differ_or_cannot_be_shared(tmp_path):
    np.savez(tmp_path / "a.npz", z0=np.ones((9, 2)), z1=np.ones((9, 2)), dt=1.0)
    np.savez(tmp_path / "b.npz", z0=np.ones((9, 4)), z1=np.ones((9, 4)), dt=1.0)
    with pytest.raises(InputError, match="coordinates"):
        read_sample([tmp_path / "a.npz", tmp_path / "b.npz"])
    (tmp_path / "a.csv").write_text("t,q1,p1\n0,1,2\n1,2,3\n")
    with pytest.raises(InputError, match="files"):
        next(iterate_pairs(tmp_path / "a.csv", 10, share=Share(0, 2)))


def turned(z, dt):
    """Images by the flow of p²/2 + q²/2, each over its own dt."""
    (q, p), cos, sin = z.T, np.cos(dt), np.sin(dt)
    return np.stack([cos * q + sin * p, cos * p - sin * q], axis=1)


def varied(of, sigma=1e-3):
    """Noisy pairs that differ in their dt, or in a parameter: the strength of a kick."""
    rng = np.random.default_rng(0)
    z, noise = rng.uniform(-1, 1, (PAIRS, 2)), sigma * rng.standard_normal((2, PAIRS, 2))
    if of == "dt":
        dt = rng.uniform(0.8, 1.2, PAIRS) * DT
        return gfnn.Pairs(z + noise[0], turned(z, dt) + noise[1], dt)
    k = rng.uniform(0.5, 1.5, PAIRS)
    moved = turned(z - np.stack([np.zeros(PAIRS), 0.1 * k * z[:, 0] ** 2], axis=1), DT)
    return gfnn.Pairs(z + noise[0], moved + noise[1], DT, k)


@pytest.mark.filterwarnings("ignore::gfnn_jax.errors.FitWarning")
@pytest.mark.parametrize(
    ("of", "options"),
    [
        pytest.param("dt", {"learn": "map", "tolerance": 1e-3}, marks=pytest.mark.slow),
        ("dt", {"learn": "hamiltonian", "terms": ("p1**2", "q1**2"), "tolerance": 5e-3}),
        pytest.param(
            "parameters",
            {"learn": "map", "chart": "type2", "tolerance": 1e-3},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_pairs_that_differ_in_dt_or_parameters_are_all_taken(of, options, in_threads):
    pairs = varied(of)
    held = pairs.take(slice(100))
    fit = gfnn.fit(pairs.take(slice(100, 250)), **options)
    found = [in_threads(count, lambda group: refitted(group, pairs, held, fit)) for count in (1, 3)]
    one, three = found[0][0], found[1][0]
    assert one.num_pairs == PAIRS
    assert not any("is kept" in message for message in one.messages)
    exact = varied(of, sigma=0.0)
    steps = []
    for each in (fit, one, three):
        dt = exact.dt if of == "dt" else None
        steps.append(np.asarray(each.map.step(exact.z0, exact.args, dt=dt)[0]))
    np.testing.assert_allclose(steps[1], steps[2], rtol=0, atol=1e-12)
    errors = [np.sqrt(np.mean((states - exact.z1) ** 2)) for states in steps]
    assert errors[1] < 0.7 * errors[0]  # eight times the pairs: √8 at best


# Real processes, on this machine


def fitting(out, *more, count):
    return started("fit", *more, "--out", out, count=count)


OPTIONS = ("--learn", "map", "--chart", "midpoint", "--tolerance", 3e-3)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder, pairs = tmp_path_factory.mktemp("data"), noisy(image)
    np.savez(folder / "pairs.npz", z0=pairs.z0, z1=pairs.z1, dt=DT)
    return folder


@pytest.fixture(scope="module")
def undisturbed(data):
    """The fit of one process."""
    return fit_job.fit(
        data / "pairs.npz",
        output=Output(data / "one"),
        learn="map",
        chart="midpoint",
        tolerance=3e-3,
        group=Group(),
    ).fit


def moved_alike(one, other):
    z = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 2))
    moved = [np.asarray(map_.step(z)[0]) for map_ in (one, other)]
    np.testing.assert_allclose(moved[0], moved[1], rtol=0, atol=1e-12)


# JAX tells others that the first process is gone at once, and of another after ten seconds.
@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_a_killed_process_ends_the_others(killed, data, undisturbed):
    """While the first one searches and the other waits for its map; what is begun anew is fitted
    as if nothing had been."""
    out = data / f"killed{killed}"
    running = fitting(out, data / "pairs.npz", *OPTIONS, count=2)
    limit = time.monotonic() + 60
    while not out.with_name(f"{out.name}.partial").exists():
        assert time.monotonic() < limit, [p.poll() for p in running]
        time.sleep(0.02)
    running[killed].send_signal(signal.SIGKILL)
    status, _, told = ended(running)[1 - killed]
    assert status != 0
    lines = [line for line in told.splitlines() if not line.startswith("[")]  # but progress
    assert len(lines) == 1, told
    assert lines[0].startswith("gfnn: this process or another one of the job was lost")
    assert not out.exists()
    found = ended(fitting(out, data / "pairs.npz", *OPTIONS, "--resume", count=2))
    assert [status for status, *_ in found] == [0, 0], found
    moved_alike(undisturbed.map, saved.load(out))
    assert saved.record(out)["data"]["num_pairs"] == PAIRS
