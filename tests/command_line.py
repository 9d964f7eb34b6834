"""Commands in this process, and what they are given: files, a saved map, a fit."""

import numpy as np

from gfnn_jax import cli
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn import fit as learn_fit
from gfnn_jax.maps import saved as models
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs

DT = 0.1


def oscillator(num, times, seed=0):
    """(num, len(times), 2): q'' = −q, exactly."""
    q, p = np.random.default_rng(seed).uniform(-1, 1, (2, num, 1))
    t = np.asarray(times)
    return np.stack([q * np.cos(t) + p * np.sin(t), p * np.cos(t) - q * np.sin(t)], axis=-1)


def pairs_file(path, z=None, **more):
    z = oscillator(200, [0, DT]) if z is None else z
    np.savez(path, **({"z0": z[:, 0], "z1": z[:, 1], "dt": DT} | more))
    return path


def oscillators_map(folder):
    """A saved map of one degree of freedom that no fit was needed for: S near ½(q² + p²)."""
    z = np.random.default_rng(0).uniform(-1, 1, (100, 2))
    family = Products(box_inputs(z), 2)
    params = family.unflatten(np.linspace(0.1, 0.3, family.num_parameters))
    generated = Generated(family, params, MIDPOINT, DT, np.ones(2))
    map_ = SymplecticMap((generated,), CARTESIAN, covering(z), np.ones(2), np.zeros(0), DT)
    models.save(map_, folder)
    np.save(folder.parent / "z0.npy", np.array([[0.1, 0.2], [0.3, -0.4], [30.0, 0.0]]))
    return folder


def fitted_oscillator():
    """A fit, for tests of what is done with one."""
    z = oscillator(200, [0, DT])
    return learn_fit.fit(Pairs(z[:, 0], z[:, 1], DT), chart="type2", tolerance=1e-2)


def gfnn(*arguments):
    return cli.main([str(a) for a in arguments])


def predict(model, out, *more, num_steps=50):
    initial = ("--initial", model.parent / "z0.npy")
    return gfnn("predict", model, *initial, "--num-steps", num_steps, "--out", out, *more)


def files(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
