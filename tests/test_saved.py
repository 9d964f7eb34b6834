"""Saved maps: the same bits after loading, for every family, chart, base map and kind of angle."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.errors import InputError
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines
from gfnn_jax.generating.charts import CHARTS, MIDPOINT, TYPE2, AnyChart
from gfnn_jax.generating.generated import Generated
from gfnn_jax.generating.predictor import PolynomialModel, Predictor
from gfnn_jax.maps import saved as models
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.piece import Affine
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import DrawnFrom, Scene, pcr3bp, two_body
from gfnn_jax.storage.checkpoints import load_model, save_model

RNG = np.random.default_rng(0)
STATES = 1.0 + 0.1 * RNG.standard_normal((40, 4))
POLAR = two_body().coordinates


def inner(coordinates):
    return np.asarray(jax.vmap(coordinates.forward)(jnp.asarray(STATES)))


def a_map(
    family, params, chart: AnyChart = MIDPOINT, coordinates=CARTESIAN, half=None, predictor=None
) -> SymplecticMap:
    y = inner(coordinates)
    generated = Generated(family, params, chart, 0.1, np.ones(4), predictor)
    return SymplecticMap(
        (generated,) if half is None else (half, generated, half),
        coordinates,
        covering(y, ignore=coordinates.cyclic),
        STATES.std(axis=0),
        np.zeros(len(coordinates.angles)),
        0.1,
    )


def polynomial(coordinates=CARTESIAN, features=None, degree=2, angles=()):
    inputs = box_inputs(
        inner(coordinates), angles=angles, cyclic=coordinates.cyclic, features=features
    )
    family = Products(inputs, degree)
    return family, family.unflatten(0.01 * RNG.standard_normal(family.num_parameters))


def predictor():
    family = Products(box_inputs(STATES), 2)
    coefficients = 1e-4 * RNG.standard_normal((2, 4, family.num_parameters))
    sides = (PolynomialModel(family, family.basis.placed(c)) for c in coefficients)
    return Predictor(*sides)


def network(dtype):
    family = Mlp(box_inputs(STATES, angles=(0,)), hidden=(5, 4), amplitude=0.01)
    return family, family.init(jax.random.key(0), dtype)


def turned(angle=0.4):
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.kron(np.array([[c, s], [-s, c]]), np.eye(2))
    return a_map(*polynomial(), half=Affine(matrix, np.ones(4), np.full(4, 0.01)))


MAPS = {
    **{n: lambda chart=chart: a_map(*polynomial(), chart=chart) for n, chart in CHARTS.items()},
    "sines": lambda: a_map(Sines(box_inputs(STATES), 20), RNG.standard_normal(20), chart=TYPE2),
    "mlp": lambda: a_map(*network(jnp.float64)),
    "mlp float32": lambda: a_map(*network(jnp.float32)),
    "angles": lambda: a_map(*polynomial(angles=(0,)), coordinates=Coordinates("plain", (0, 2))),
    "polar": lambda: a_map(*polynomial(POLAR), coordinates=POLAR),
    "features": lambda: a_map(*polynomial(features=pcr3bp().features)),
    "base map": turned,
    "predictor": lambda: a_map(*polynomial(), predictor=predictor()),
}


@pytest.mark.parametrize("name", MAPS)
def test_loads_the_same_bits(name, tmp_path):
    saved = MAPS[name]()
    saved.save(tmp_path / "m", record={"note": "θ"})
    loaded = models.load(tmp_path / "m")
    assert jax.tree.structure(loaded) == jax.tree.structure(saved)
    for a, b in zip(jax.tree.leaves(saved), jax.tree.leaves(loaded), strict=True):
        assert jnp.result_type(a) == jnp.result_type(b)
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert models.record(tmp_path / "m") == {"note": "θ"}


def test_a_scene_of_ones_own(tmp_path):
    """Save and load a map with features of one's own scene, given both times."""

    def features(z):
        return z**2

    saved = a_map(*polynomial(features=features))
    mine = Scene("mine", "a test", 2, 0.1, DrawnFrom(lambda key, num: STATES), features=features)
    with pytest.raises(InputError, match="features"):
        models.save(saved, tmp_path / "m")
    assert not (tmp_path / "m").exists()
    models.save(saved, tmp_path / "m", scene=mine)
    with pytest.raises(InputError, match="'mine'"):
        models.load(tmp_path / "m")
    with pytest.raises(InputError, match=r"'mine'.*'two-body'"):
        models.load(tmp_path / "m", scene=two_body())
    with pytest.raises(InputError, match="features"):
        models.load(tmp_path / "m", scene=dataclasses.replace(mine, features=None))
    assert jax.tree.structure(models.load(tmp_path / "m", mine)) == jax.tree.structure(saved)


def test_a_function_of_ones_own_is_refused(tmp_path):
    def scalar(params, w):
        return params * (w @ w)

    with pytest.raises(InputError, match="function"):
        models.save(a_map(scalar, jnp.asarray(0.1)), tmp_path / "m")
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["map"].update(type="Popen"), "holds a Popen, which is not known"),
        (lambda d: d["map"]["pieces"]["0"].update(surprise=1), "does not describe a map"),
    ],
)
def test_a_foreign_description(change, message, tmp_path):
    models.save(a_map(*polynomial()), tmp_path / "m")
    arrays, description = load_model(tmp_path / "m")
    change(description)
    save_model(tmp_path / "m", arrays, description)
    with pytest.raises(InputError, match=message):
        models.load(tmp_path / "m")


def test_every_type_that_is_known_is_where_it_is_said_to_be():
    from gfnn_jax.learn import saved  # noqa: F401, which knows more

    own = {path for path in models._NAMES if path.partition(".")[0] not in sys.modules}
    assert len(own) > 80
    for path in own:
        assert models._path(models._type(models._NAMES[path])) == path
