"""Fits shared out among the devices of a process: the same bits on any number of them."""

import threading
import time

import jax
import numpy as np
import pytest
from analytic import rotated
from other_python import run_python

import gfnn_jax as gfnn
from gfnn_jax.budget import Allowance, Counted
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines
from gfnn_jax.fitting import gauss_newton, least_squares, row_blocks
from gfnn_jax.flows.collocation import Steps

FITS = """
import sys
import warnings
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import gfnn_jax as gfnn
from gfnn_jax.fitting import row_blocks
from gfnn_jax.learn.refit import refit
from test_fit_on_devices import kicked, quartic

warnings.simplefilter("ignore")
assert len(jax.devices()) == 3
pairs = {"map": kicked(3_000), "law": quartic(3_000), "networks": kicked(120)}
options = {
    "map": dict(learn="map", chart="midpoint", tolerance=1e-8),
    "law": dict(learn="hamiltonian", terms=("p1**2", "q1**4", "q1**2", "p1**4"), tolerance=1e-12),
    "networks": dict(family="mlp", chart="midpoint", ensemble=3, max_iterations=6,
                     max_seconds=None),
}
for name, own in ((kind, pairs[kind]) for kind in sys.argv[1:]):
    found = {n: gfnn.fit(own, devices=n, **options[name]) for n in (None, 1, 3)}
    bits = {n: [np.asarray(a).tobytes() for a in jax.tree.leaves(f.map)] for n, f in found.items()}
    assert bits[3] == bits[1], f"{name}: bits depend on the devices"
    assert len({f.chosen.label for f in found.values()}) == 1
    z = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 2))
    plain, shared = (np.asarray(found[n].map.step(z)[0]) for n in (None, 1))
    # Networks take steps downhill, which rounding turns elsewhere.
    limit = 1e-6 if name == "networks" else 1e-12
    np.testing.assert_allclose(shared, plain, rtol=0, atol=limit, err_msg=name)
    if name == "networks":
        assert found[1].chosen.train_rms < 0.1, "nothing was trained"
        continue
    again = []
    for devices in ((), jax.devices()[:1], jax.devices()):
        with row_blocks.on_devices(devices):
            again.append(refit(found[1], [own], own.take(slice(100))).map)
    moved = [np.asarray(m.step(z)[0]) for m in again]
    assert moved[1].tobytes() == moved[2].tobytes(), f"{name}: a refit's bits depend on the devices"
    np.testing.assert_allclose(moved[0], moved[1], rtol=0, atol=1e-12)
"""

DT = 0.4


def kicked(number):
    """Pairs of a kick and a turn."""
    z = np.random.default_rng(0).uniform(-1, 1, (number, 2))
    return gfnn.Pairs(z, rotated(z - [0.0, 0.1] * np.sin(z[:, :1]), DT), DT)


def quartic(number):
    """Pairs of H = p²/2 + q⁴/4, by collocation of high order."""
    from gfnn_jax.families.terms import Terms
    from gfnn_jax.flows.collocation import images

    z = np.random.default_rng(0).uniform(-1, 1, (number, 2))
    family = Terms(1, ("p1", "q1"), ((2, 0), (0, 4)))
    return gfnn.Pairs(z, images(family, np.array([0.5, 0.25]), z, DT, Steps(12, 8)).states, DT)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["map", "law", "networks"])
def test_the_same_bits_on_any_number_of_devices(kind):
    run_python(FITS, kind, devices=3)


@pytest.fixture
def sharing():
    """A context of so many devices: the one of this process again and again."""
    return lambda count: row_blocks.on_devices([Named(i) for i in range(count)])


class Named:
    platform = "cpu"

    def __init__(self, name):
        self.name = name


@pytest.mark.parametrize("count", range(6))
def test_neighbours_are_merged_first_whoever_is_done_first(count, sharing):
    def slow(part, device):
        time.sleep(0.002 * (part % 3))
        return str(part)

    found = []
    for devices in (1, 2, 5):
        with sharing(devices):
            found.append(row_blocks.tree(slow, iter(range(count)), lambda a, b, _: f"({a}{b})"))
    expected = (None, "0", "(01)", "((01)2)", "((01)(23))", "(((01)(23))4)")[count]
    assert found == [expected] * 3


def test_parts_are_read_as_they_are_needed_and_an_error_ends_all(sharing):
    read, busy = [], threading.Semaphore(0)

    def parts():
        for i in range(100):
            read.append(i)
            yield i

    def failing(part, device):
        busy.acquire(timeout=0.05)
        if part == 3:
            raise OutOfTime
        return part

    with sharing(2), pytest.raises(OutOfTime):
        row_blocks.tree(failing, parts(), lambda a, b, _: a + b)
    assert len(read) <= 3 + 1 + 2 * 2 + 1
    assert row_blocks.devices() == ()


def test_each_has_its_device_for_itself(sharing):
    taken, lock = set(), threading.Lock()

    def alone(part, device):
        with lock:
            assert device.name not in taken
            taken.add(device.name)
        time.sleep(0.001)
        taken.remove(device.name)
        return row_blocks.devices(), part

    with sharing(3):
        found = row_blocks.each(alone, range(20))
    assert found == [((), i) for i in range(20)]  # in order, and nothing is shared out again


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3])
def test_operations_are_spent_as_by_one(count, sharing):
    """The budget ends a fit at the same step, whoever is faster."""
    pairs = quartic(5_000)
    from gfnn_jax.families.terms import Terms

    family = Terms(1, ("p1", "q1"), tuple((i, j) for i in range(5) for j in range(1, 5)))
    c, spent = np.full(family.num_parameters, 1e-3), []
    for devices in (0, 1, count):
        budget = Counted(np.inf)
        problem = gauss_newton.Problem(
            pairs.z0,
            pairs.z1,
            DT,
            np.ones(2),
            allowance=Allowance(cap=budget),
            options=gauss_newton.GaussNewtonOptions(block_bytes=2**20, part_bytes=2**20),
        )
        with sharing(devices):
            found = problem.linearised(family, c, Steps(4, 1), np.arange(5_000))
            size = problem.residuals(family, c, Steps(4, 1), np.arange(5_000))
        spent.append((budget.spent, found.rows, size.tobytes()))
        assert found.rows == 10_000
        np.testing.assert_allclose(found.norm, np.linalg.norm(size), rtol=1e-12)
    assert spent[0] == spent[1] == spent[2]


def test_a_flow_that_fails_has_no_cost(sharing):
    pairs = quartic(3_000)
    from gfnn_jax.families.terms import Terms

    family = Terms(1, ("p1", "q1"), ((2, 0), (0, 4)))
    z0 = np.array(pairs.z0)
    z0[1_700] = 1e200
    problem = gauss_newton.Problem(
        z0, pairs.z1, DT, np.ones(2), options=gauss_newton.GaussNewtonOptions(part_bytes=2**18)
    )
    with sharing(2):
        assert problem.linearised(family, np.ones(2), Steps(4, 1), np.arange(3_000)).norm == np.inf


def rows(number=900):
    w = np.random.default_rng(0).uniform(-1, 1, (number, 2))
    return w, np.cos(w)


def same_factor(one, other):
    """Assert factors of the same rows: up to the signs of rows, and up to more where columns are
    dependent."""
    squares = [np.triu(factor).T @ np.triu(factor) for factor in (one, other)]
    np.testing.assert_allclose(*squares, rtol=0, atol=1e-13 * np.abs(squares[1]).max())


@pytest.mark.parametrize("of", [lambda i: Products(i, 6), lambda i: Sines(i, 40)])
def test_an_accelerator_makes_the_same_factor(of, monkeypatch):
    """Its program, on a CPU's device."""
    w, target = rows()
    family, weight = of(box_inputs(w)), np.array([0.5, 2.0])
    assert least_squares.accelerator_takes(family)
    plain = least_squares.reduce(family, [(w, target)], weight)
    device = jax.devices()[0]
    for own, named in (
        (least_squares._factor_on_device, "_factor_on_device"),
        (least_squares._merged_on_device, "_merged_on_device"),
    ):
        called = []
        monkeypatch.setattr(
            least_squares, named, lambda *a, own=own, called=called: (called.append(1), own(*a))[1]
        )
    one, other = (
        least_squares.factor_on_device(family, part, weight, 500, device)
        for part in ((w[:500], target[:500]), (w[500:], target[500:]))
    )
    same_factor(least_squares.merged_on_device(one, other, device), plain.factor)


def test_rows_go_to_an_accelerator_where_there_is_one(monkeypatch):
    """What is asked of it, by parts that are filled up to one shape."""
    w, target = rows(30_000)
    family, weight, shapes = Products(box_inputs(w), 4), np.ones(2), set()
    plain = least_squares.reduce(family, [(w, target)], weight)
    run = least_squares._factor_on_device

    def seen(family, rows, weights):
        shapes.add(rows[0].shape)
        return run(family, rows, weights)

    monkeypatch.setattr(least_squares, "_factor_on_device", seen)
    monkeypatch.setattr(Named, "platform", "gpu")
    put = jax.device_put
    monkeypatch.setattr(jax, "device_put", lambda tree, device: put(tree))
    with row_blocks.on_devices([Named(0), Named(1)]):
        found = least_squares.reduce(
            family, [(w[:9_999], target[:9_999]), (w[9_999:], target[9_999:])], weight
        )
    assert found.rows == plain.rows
    assert len(shapes) == 1
    same_factor(found.factor, plain.factor)
