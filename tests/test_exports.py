"""Maps for other programs: the C file and the StableHLO of a map do what its own step does."""

import ctypes
import dataclasses
import functools
import json
import re
import shutil
import subprocess
import zipfile

import jax
import numpy as np
import pytest
from analytic import generated, map_of, mechanics, oscillator
from jax import export as jax_export
from scipy.linalg import expm

import gfnn_jax as gfnn
from gfnn_jax import cli, scenes
from gfnn_jax.coordinates import CARTESIAN, Coordinates, polar, to_inner
from gfnn_jax.exports.symbols import Tape
from gfnn_jax.families import friction
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.expressions import parse
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.jets import jets
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.charts import CHARTS, MIDPOINT, TYPE1, TYPE2, TYPE3
from gfnn_jax.generating.generated import Generated
from gfnn_jax.generating.predictor import fit_predictors
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.laws import map_of_law
from gfnn_jax.maps.parameters import sampled
from gfnn_jax.maps.piece import Affine, Damping, FunctionsOfArgs
from gfnn_jax.phase_space import symplectic_form
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK

DT, SIZE = 0.3, 0.6
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
FLAGS = ("-O1", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


def states(dim, count=300):
    return np.random.default_rng(dim).uniform(-1, 1, (count, 2 * dim))


def map_in(chart, dim, degree, *, angles=(), predicted=True, around=()):
    """S with falling random coefficients in a chart: near the identity, or in type 1 near q·Q."""
    z = states(dim)
    own = [a for a in angles if a < dim]
    z[:, list(angles)] *= np.pi
    family = Products(box_inputs(z, angles=tuple(own)), degree)
    rng = np.random.default_rng(5)
    count = family.num_parameters
    coefficients = 0.2 * rng.normal(size=count) / np.arange(1, count + 1)
    if chart is TYPE1:
        terms = family.term_gradients(z).reshape(-1, count)
        wanted = 5 * np.concatenate([z[:, dim:], z[:, :dim]], axis=1).ravel()
        coefficients = 0.2 * coefficients + np.linalg.lstsq(terms, wanted)[0]
    unit = np.full(2 * dim, SIZE)
    piece = Generated(family, family.unflatten(coefficients), chart, DT, unit)
    map_ = map_of(piece, z, coordinates=Coordinates("own", tuple(angles)), scale=unit)
    if predicted:
        Z, info = map_.step(z)
        good = np.asarray(info.status) <= LEFT_DOMAIN
        found = fit_predictors(
            chart,
            z[good],
            np.asarray(Z)[good],
            DT,
            functools.partial(box_inputs, angles=tuple(own)),
        )
        piece = dataclasses.replace(piece, predictor=found[-1].predictor)
    return dataclasses.replace(map_, pieces=(*around, piece, *around)), z


def turning(dim):
    """Half a base map: a symplectic matrix, a centre and a shift."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=(2 * dim, 2 * dim))
    matrix = expm(0.3 * symplectic_form(dim) @ (a + a.T))
    return Affine(matrix, 0.1 * rng.normal(size=2 * dim), 0.05 * rng.normal(size=2 * dim))


def law(stages=4, substeps=2):
    texts = ["p1**2", "p2**2", "q1**2", "q2**2*p1", "cos(q1)", "exp(-q2)"]
    texts += ["1/sqrt(q1**2 + q2**2 + 1)", "(q1 + 2*q2)**1.5*0.1 + sin(2*q1)"]
    z, unit = 0.3 + 0.2 * states(2), np.full(4, SIZE)
    piece = Flow(given_terms(2, texts), np.linspace(0.2, 0.6, 8), DT, unit, stages, substeps)
    return map_of(piece, z, scale=unit), z


def featured():
    """S of 1/r and r² of a state in the plane, as a scene declares them."""
    scene = scenes.make("pcr3bp")
    z = 0.1 * states(2) + np.array([0.5, 0.0, 0.0, 1.2])
    family = Products(box_inputs(z, features=scene.features), 2)
    params = family.unflatten(0.02 * np.random.default_rng(1).normal(size=family.num_parameters))
    piece = Generated(family, params, MIDPOINT, DT, np.full(4, 0.1))
    return map_of(piece, z, scale=np.full(4, 0.1)), z


def in_polar():
    z = states(2) * 0.1 + np.array([1.0, 0.0, 0.0, 1.0])
    y = to_inner(coordinates := polar(cyclic=True), z)
    family = Products(box_inputs(y, cyclic=(1,)), 2)
    params = family.unflatten(0.005 * np.random.default_rng(1).normal(size=family.num_parameters))
    piece = Generated(family, params, TYPE2, DT, np.full(4, 0.1))
    return map_of(piece, y, coordinates=coordinates, scale=np.full(4, 0.1)), z


def two_rods():
    """A double pendulum by its Lagrangian, whose bobs attract each other, and its states."""
    none = (0, 0)
    rows = [
        ((2, 0), none, none, 0.0, 1.0),
        ((0, 2), none, none, 0.0, 0.5),
        ((1, 1), none, (1, -1), 0.0, 1.0),
        (none, none, (1, 0), 0.0, 2.0),
        (none, (0, 2), none, 0.0, -0.5),
        (none, none, none, 0.0, 0.7, "1/sqrt(4 + (q1 - q2)**2)"),
    ]
    law = mechanics(rows)
    z = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 4))
    return map_of_law(law, z, 0.05, tolerance=1e-13), z


def of_positions(part, both, angles=()):
    """S(q, Q) of a map of positions: free motion, and a potential."""
    rng, dim = np.random.default_rng(4), 1
    q, move = rng.uniform(-1, 1, (2, 300, dim))
    w = np.concatenate([q, q + move], axis=1)
    inner = Products(box_inputs(np.concatenate([q + part * move, move], axis=1), angles=angles), 4)
    family = OfDisplacement(inner, part, both)
    terms = family.term_gradients(w)
    kick = 0.3 * np.sin(w)
    wanted = np.concatenate([-move, move], axis=1) + kick
    coefficients = np.linalg.lstsq(terms.reshape(w.size, -1), wanted.ravel())[0]
    params = family.unflatten(coefficients)
    gradient = family.gradient(params, w)
    z = np.concatenate([q, -DT * gradient[:, :dim]], axis=1)
    piece = Generated(family, params, TYPE1, DT, np.full(2 * dim, SIZE))
    image = np.concatenate([w[:, dim:], DT * gradient[:, dim:]], axis=1)
    found = fit_predictors(TYPE1, z, image, DT, functools.partial(box_inputs, angles=tuple(angles)))
    piece = dataclasses.replace(piece, predictor=found[-1].predictor)
    return map_of(piece, z, scale=np.full(2 * dim, SIZE)), z


DAMPING = Damping(np.asarray(0.9), np.full(1, 0.05))
MAPS = {
    "type 2, angles": lambda: map_in(TYPE2, 1, 4, angles=(0, 1)),
    "type 3, base map, damping": lambda: map_in(TYPE3, 1, 4, around=(turning(1), DAMPING)),
    "positions both ways": lambda: of_positions(0.0, True, (0,)),
    "damping": lambda: map_in(TYPE2, 1, 4, around=(DAMPING,)),
    "positions": lambda: of_positions(0.5, False),
    "type 1": lambda: map_in(TYPE1, 1, 4, predicted=False),
    "midpoint": lambda: map_in(MIDPOINT, 2, 3),
    **{
        f"{name}, d = 2": lambda chart=chart: map_in(chart, 2, 4, predicted=chart is not TYPE1)
        for name, chart in CHARTS.items()
    },
    "type 2": lambda: map_in(TYPE2, 1, 3),
    "midpoint, d = 3": lambda: map_in(MIDPOINT, 3, 3),
    "an angle": lambda: map_in(MIDPOINT, 2, 3, angles=(0,)),
    "base map": lambda: map_in(TYPE3, 2, 3, around=(turning(2),)),
    "features": featured,
    "polar": in_polar,
}


def compiled(path, *flags):
    library = path.with_suffix(".so")
    command = ["cc", *FLAGS, *flags, "-shared", "-fPIC", str(path), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def by_c(function, z):
    """Images (N, 2d) and statuses (N,), one state after another, in place."""
    images = np.array(z)
    found = [function(by_c_pointer(row), by_c_pointer(row)) for row in images]
    return images, np.array(found)


def by_c_pointer(row):
    return row.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def by_c_with(function, z, args):
    """Images (N, 2d) and statuses (N,) of states with their args (N, k)."""
    images, rows = np.array(z), [by_c_pointer(a) for a in np.ascontiguousarray(args)]
    found = [
        function(by_c_pointer(row), a, by_c_pointer(row))
        for row, a in zip(images, rows, strict=True)
    ]
    return images, np.array(found)


def scattered(map_, z):
    """States of the data, at its border, beside it and far away, turned, and not finite."""
    middle = z.mean(axis=0)
    found = np.concatenate([z[:60], *(middle + s * (z[:40] - middle) for s in (1.2, 2, 20))])
    turned = found[:40].copy()
    if map_.coordinates.forward is CARTESIAN.forward:
        turned[:, list(map_.coordinates.angles)] += 2 * np.pi * 12_345
    wrong = np.tile(middle, (2, 1))
    wrong[0, 0], wrong[1, -1] = np.nan, np.inf
    return np.concatenate([found, turned, wrong])


@functools.cache
def made(kind):
    map_, z = law() if kind == "law" else MAPS[kind]()
    return map_, scattered(map_, z)


@functools.cache
def by_itself(kind, name):
    """Images and statuses by the map's own step or inverse."""
    map_, z = made(kind)
    images, info = getattr(map_, name)(z)
    return np.asarray(images), np.asarray(info.status)


@needs_cc
@pytest.mark.parametrize(
    "kind", [k if k == "type 2, angles" else pytest.param(k, marks=pytest.mark.slow) for k in MAPS]
)
def test_c_is_the_maps_own_step(kind, tmp_path):
    map_, z = made(kind)
    library = compiled(gfnn.export(map_, "c", tmp_path / "own.c"))
    for name, function in (("step", library.own_step), ("inverse", library.own_inverse)):
        images, status = by_c(function, z)
        expected, own_status = by_itself(kind, name)
        np.testing.assert_array_equal(status, own_status)
        assert {OK, LEFT_DOMAIN, NON_FINITE} <= {*status.tolist()} or "angles" in kind
        inside = status == OK
        assert inside.sum() > 30
        np.testing.assert_allclose(images[inside], expected[inside], rtol=1e-13, atol=1e-13)
        # Far outside, folds are near and powers large.
        outside = status == LEFT_DOMAIN
        np.testing.assert_allclose(images[outside], expected[outside], rtol=1e-11, atol=1e-11)


def with_length(kind):
    """A map whose S or H depends on a length l, its states and their lengths (N, 1)."""
    z, lengths = 0.5 * states(1), np.random.default_rng(2).uniform(0.5, 2, (300, 1))
    unit, names = np.ones(2), ("l",)
    if kind == "Lagrangian":
        rows = [((2,), (0,), (0,), 0.0, 0.5), ((0,), (0,), (1,), 0.0, 1.0)]
        losses = [((1,), friction.LINEAR, 0.0, 0.1)]
        law = mechanics(rows, losses, powers=((0,), (-1,), (1,)))
        return map_of_law(law, z, DT, parameters=names, args=lengths), z, lengths
    if kind == "law":
        family = given_terms(1, ["p1**2/l**2", "l*cos(q1)", "T3(q1)*l"], names)
        piece = Flow(family, np.array([0.5, -1.0, 0.1]), DT, unit, 4, 2)
    else:
        family = Products(box_inputs(z, args=lengths), 4)
        rng = np.random.default_rng(5)
        params = family.unflatten(0.03 * rng.normal(size=family.num_parameters))
        piece = Generated(family, params, MIDPOINT if kind == "midpoint" else TYPE2, DT, unit)
    map_ = dataclasses.replace(map_of(piece, z), parameters=sampled(names, lengths))
    if kind == "type 2":
        image = np.asarray(map_.step(z, lengths)[0])
        found = fit_predictors(TYPE2, z, image, DT, args=lengths)
        piece = dataclasses.replace(piece, predictor=found[-1].predictor)
        turned = Affine(expm(0.2 * symplectic_form(1)), np.zeros(2), np.zeros(2))
        map_ = dataclasses.replace(map_, pieces=(turned, piece, turned))
    if kind == "damped":
        functions = FunctionsOfArgs.within(lengths, 3)
        of_length = np.array([[0.8], [0.05], [0.01], [-0.02]])
        damping = Damping(of_length, 0.1 * of_length, functions)
        map_ = dataclasses.replace(map_, pieces=(piece, damping))
    return map_, z, lengths


@pytest.mark.slow
@needs_cc
@pytest.mark.parametrize("kind", ["midpoint", "type 2", "damped"])
def test_c_of_a_map_with_parameters(kind, tmp_path):
    map_, z, args = with_length(kind)
    z = np.concatenate([z, z[:20], z[:2]])
    args = np.concatenate([args, np.full((20, 1), 2.1), args[:2]])
    args[-1], z[-2] = np.nan, np.nan
    path = gfnn.export(map_, "c", tmp_path / "own.c")
    assert f"args = (l), in the data l from {args[:300].min():.6g} to" in path.read_text()
    library = compiled(path)
    for function, own in ((library.own_step, map_.step), (library.own_inverse, map_.inverse)):
        images, status = by_c_with(function, z, args)
        expected, info = own(z, args)
        np.testing.assert_array_equal(status, info.status)
        assert {OK, LEFT_DOMAIN, NON_FINITE} <= {*status.tolist()}
        inside = status == OK
        assert inside.sum() > 200
        np.testing.assert_allclose(images[inside], expected[inside], rtol=1e-14, atol=1e-14)


def driven(kind):
    """A map under a drive of period 2, its states and times (N, 1)."""
    z, times = 0.5 * states(1), np.random.default_rng(2).uniform(-9, 9, (300, 1))
    unit, terms = np.ones(2), ["p1**2", "q1**2", "q1*cos(pi*t)", "q1**2*p1*sin(2*pi*t)"]
    family, params = given_terms(1, terms, ("t",)), np.array([0.5, 0.4, 0.3, 0.2])
    if kind == "law":
        piece = Flow(family, params, DT, unit, 4, 2)
    else:
        piece = Generated(family, params, TYPE2, DT, unit)
    most = sampled(("t",), np.linspace(0, 1.2, 9)[:, None], DT, 2.0)  # not all of the period
    return dataclasses.replace(map_of(piece, z), parameters=most), z, times


@pytest.mark.slow
@needs_cc
def test_c_of_a_driven_map(tmp_path):
    map_, z, times = driven("type 2")
    path = gfnn.export(map_, "c", tmp_path / "own.c")
    assert "t: the time of the drive at z, of the step and of its inverse" in path.read_text()
    library = compiled(path)
    for function, own in ((library.own_step, map_.step), (library.own_inverse, map_.inverse)):
        images, status = by_c_with(function, z, times)
        expected, info = own(z, t0=times[:, 0])
        np.testing.assert_array_equal(status, info.status)
        assert {OK, LEFT_DOMAIN} == {*status.tolist()}
        np.testing.assert_allclose(images, expected, rtol=1e-14, atol=1e-14)


def pushed(hold, delay=0.0, uniform=0.0):
    """A double pendulum with friction of every kind and an input on both angles, and its states.

    hold: the rule between samples."""
    none = (0, 0)
    rows = [
        ((2, 0), none, none, 0.0, 1.0),
        ((0, 2), none, none, 0.0, 0.5),
        ((1, 1), none, (1, -1), 0.0, 1.0),
        (none, none, (1, 0), 0.0, 2.0),
        (none, (0, 2), none, 0.0, -0.5),
    ]
    losses = [
        ((1, 0), friction.LINEAR, 0.0, 0.1),
        ((1, -1), friction.QUADRATIC, 0.0, 0.2),
        ((0, 1), friction.DRY, 0.3, 0.05),
        ((1, -1), friction.PLACED, 0.1, 0.3),
    ]
    law = mechanics(rows, losses, uniform, [[1.0], [0.5]])
    z = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 4))
    signals = Signals(("F",), hold, delay)
    return map_of_law(law, z, 0.05, tolerance=1e-12, signals=signals), z


@pytest.mark.slow
@needs_cc
@pytest.mark.parametrize(
    ("hold", "delay"), [("linear", 0.013), ("hold", 0.0), ("hold", 0.02), ("band", 0.013)]
)
def test_c_of_a_map_with_inputs(hold, delay, tmp_path):
    """Steps of one state under samples of a force are a rollout, and the inverse undoes each. The
    rollout's own steps are finer: collocation smooths the kink of a quadratic friction."""
    map_, z = pushed(hold, delay, uniform=0.2)
    library, pointer = compiled(gfnn.export(map_, "c", tmp_path / "own.c")), by_c_pointer
    u = np.sin(0.7 * np.arange(31))[:, None]
    fine = dataclasses.replace(map_, pieces=(dataclasses.replace(map_.pieces[0], substeps=16),))
    expected, _ = fine.rollout(z[0], 30, inputs=u)
    many = np.concatenate([np.repeat(u[:1], 99), u[:, 0], np.repeat(u[-1:], 99)])
    state, found = z[0].copy(), [z[0]]
    args = np.zeros(map_.signals.degree + 1)
    for n in range(30):
        if (hold, delay) == ("hold", 0.0):
            assert not hasattr(library, "own_inputs")
            args[:] = u[n]
        else:
            library.own_inputs(pointer(many[99 + n :]), pointer(args))
        assert library.own_step(pointer(state), pointer(args), pointer(state)) <= LEFT_DOMAIN
        found.append(state.copy())
        back = np.empty(4)
        library.own_inverse(pointer(state), pointer(args), pointer(back))
        np.testing.assert_allclose(back, found[-2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
    assert np.abs(np.asarray(expected) - map_.rollout(z[0], 30)[0]).max() > 0.1  # the force acts


@pytest.mark.slow
@needs_cc
def test_c_of_laws_before_and_behind_a_generated_step(tmp_path):
    """Two flows in one file, in polar coordinates."""
    map_, z = in_polar()
    central = given_terms(2, ["p1**2", "p2**2/q1**2", "1/q1"])
    flow = Flow(central, np.array([0.5, 0.5, -1.0]), 0.1, np.full(4, 0.1), 8, 2)
    map_ = dataclasses.replace(map_, pieces=(flow, *map_.pieces, flow.over(0.2)))
    library = compiled(gfnn.export(map_, "c", tmp_path / "own.c"))
    for function, own in ((library.own_step, map_.step), (library.own_inverse, map_.inverse)):
        images, status = by_c(function, z)
        np.testing.assert_array_equal(status, own(z)[1].status)
        np.testing.assert_allclose(images, own(z)[0], rtol=1e-13, atol=1e-13)


@needs_cc
def test_c_gives_up_where_the_map_does(tmp_path):
    """Beyond a fold, P + 3 s q² P² = p has no solution."""
    z = states(1)
    family = given_terms(1, ["q1**3*p1**2"])
    unit = np.ones(2)
    map_ = map_of(Generated(family, np.array([-1.0]), TYPE2, 1.0, unit), z)
    library = compiled(gfnn.export(map_, "c", tmp_path / "own.c"))
    _, status = by_c(library.own_step, z)
    np.testing.assert_array_equal(status, map_.step(z)[1].status)
    assert (status == NOT_CONVERGED).sum() > 10


@pytest.mark.slow
@needs_cc
def test_c_is_optimised_to_the_same(tmp_path):
    map_, z = map_in(MIDPOINT, 1, 4)
    path = gfnn.export(map_, "c", tmp_path / "own.c")
    plain, plain_status = by_c(compiled(path).own_step, z)
    faster = path.rename(tmp_path / "faster.c")
    images, status = by_c(compiled(faster, "-O3").own_step, z)
    np.testing.assert_array_equal(status, plain_status)
    np.testing.assert_array_equal(images, plain)


def test_the_file_tells_where_it_comes_from_and_keeps_nothing(tmp_path):
    map_, _ = map_in(MIDPOINT, 1, 3)
    plain = dataclasses.replace(map_, coordinates=CARTESIAN)
    plain.save(tmp_path / "mine", record={"fit": {"tolerance": 1e-6}, "data": {"source": "*/ x"}})
    text = gfnn.export(tmp_path / "mine", "c").read_text()
    comment, code = text.split("*/", 1)
    told = "dt = 0.3 in|q1 0.6, p1 0.6|0 ok; 1 left|cc -O3 -std=c99|1e-06|SHA-256|gfnn_jax 0|* / x"
    assert all(words in comment for words in told.split("|"))
    assert "malloc" not in code
    assert not re.search(r"^static (?!const)\w+ \w+(\[|;| =)", code, re.M)  # no state that changes


@pytest.mark.parametrize(
    "kind",
    ["type 2, angles", *(pytest.param(k, marks=pytest.mark.slow) for k in ("an angle", "law"))],
)
def test_stablehlo_is_the_maps_own_step(kind, tmp_path):
    map_, many = made(kind)
    with zipfile.ZipFile(gfnn.export(map_, "stablehlo", tmp_path / "own.zip")) as archive:
        assert json.loads(archive.read("about.json"))["dim"] == map_.dim
        loaded = {
            name: jax_export.deserialize(bytearray(archive.read(f"{name}.jax")))
            for name in ("step", "inverse")
        }
    for name, count in (("step", len(many)), ("inverse", 3)):
        images, status = map(np.asarray, loaded[name].call(many[:count]))
        expected, own_status = (of[:count] for of in by_itself(kind, name))
        np.testing.assert_array_equal(status, own_status)
        good = status == OK
        np.testing.assert_allclose(images[good], expected[good], rtol=1e-14, atol=1e-14)


@pytest.mark.slow
def test_stablehlo_takes_any_function(tmp_path):
    map_ = map_of(generated(oscillator, 1.1, MIDPOINT, DT), z := states(1))
    path = gfnn.export(map_, "stablehlo", tmp_path / "own.zip")
    loaded = jax_export.deserialize(bytearray(zipfile.ZipFile(path).read("step.jax")))
    np.testing.assert_allclose(loaded.call(z)[0], map_.step(z)[0], rtol=0, atol=1e-15)


def test_what_has_no_c_is_refused(tmp_path):
    network = map_of(generated(oscillator, 1.1, MIDPOINT, DT), states(1))
    map_, _ = map_in(MIDPOINT, 1, 3)
    single = jax.tree.map(lambda a: np.asarray(a, np.float32), map_)
    bent = map_of(Flow(given_terms(1, ["p1**2", "abs(q1)"]), np.ones(2), DT, np.ones(2), 4), _)
    for bad, why in (
        (network, "one of a function"),
        (single, "not of float64"),
        (bent, "abs is not analytic"),
    ):
        with pytest.raises(gfnn.InputError, match=rf"{why}.*use to=.stablehlo"):
            gfnn.export(bad, "c", tmp_path / "a.c")
    for to, out, why in (
        ("c", "a.txt", "is written as .c"),
        ("c", "a-1.c", "functions are named"),
        ("c", "double.c", "functions are named"),
        ("onnx", "a", "expected one of c, c-taylor"),
        ("c", None, "expected a file"),
    ):
        with pytest.raises(gfnn.InputError, match=why):
            gfnn.export(map_, to, None if out is None else tmp_path / out)
    assert not list(tmp_path.iterdir())


def test_command_line(tmp_path, capsys):
    map_, _ = map_in(MIDPOINT, 1, 3)
    dataclasses.replace(map_, coordinates=CARTESIAN).save(tmp_path / "m")
    export = ["export", str(tmp_path / "m"), "--to", "c"]
    assert [cli.main(one) for one in (export, export, [*export, "--overwrite"])] == [0, 2, 0]
    assert "exists already" in capsys.readouterr().err
    assert "int m_step(" in (tmp_path / "m.c").read_text()


@needs_cc
def test_every_function_of_formulas_has_its_c(tmp_path):
    texts = (
        "sin(q1); cos(3*q1); tan(q1); exp(q1); log(q1); sqrt(q1); sinh(q1); cosh(q1); tanh(q1); "
        "arctan(q1); abs(q1 - 3); q1**-3; q1**0.3; T5(q1); q1 - (p1 - q1); q1/(p1/q1); "
        "-(q1 + p1)*-q1; 2 - q1; q1/p1"
    )
    trees = [parse(text, 1) for text in texts.split("; ")]
    tape = Tape()
    z = tape.inputs("z", 2)
    entries = [
        v
        for jet in jets(trees, z, 2)
        for v in (jet.value, *jet.slope.values(), *jet.curvature.values())
    ]
    path = tmp_path / "f.c"
    text = tape.function("all_of", {"out": [np.ravel(np.asarray(e, object))[0] for e in entries]})
    path.write_text("#include <math.h>\n" + text.removeprefix("static "))
    at, pointer = np.array([[0.7, 0.4]]), ctypes.POINTER(ctypes.c_double)
    out = np.empty(len(entries))
    compiled(path).all_of(at.ctypes.data_as(pointer), out.ctypes.data_as(pointer))
    expected = [
        v
        for jet in jets(trees, at, 2)
        for v in (jet.value, *jet.slope.values(), *jet.curvature.values())
    ]
    np.testing.assert_allclose(out, [np.ravel(e)[0] for e in expected], rtol=1e-14)
