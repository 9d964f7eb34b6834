"""Rollouts of laws by compiled steps, against the same steps by JAX."""

import jax
import mpmath
import numpy as np
import pytest
from analytic import mechanics

from gfnn_jax.families.friction import LINEAR, QUADRATIC, Friction
from gfnn_jax.families.lagrangian import Lagrangian, Terms
from gfnn_jax.flows.compiled_steps import CONSTANT, INVERSE, JOINED, SIN, Stepper, program
from gfnn_jax.flows.sines import sines
from gfnn_jax.flows.translated import compiled
from gfnn_jax.maps import lanes
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.laws import map_of_law

ARMS = [
    ((2, 0), (0, 0), (0, 0), 0.0),
    ((1, 1), (0, 0), (1, -1), 0.0),
    ((0, 2), (0, 0), (0, 0), 0.0),
    ((0, 0), (0, 0), (1, 0), 0.0),
    ((0, 0), (0, 0), (0, 1), 0.0),
]
KINDS = {"alone": ([], 0.0), "friction": ([((1, 0), LINEAR, 0.0), ((-1, 1), QUADRATIC, 0.0)], 0.0)}
KINDS["uniform"] = ([], 0.2)


def arms(kind, driven=False):
    """The map of a double pendulum, and states, some of which turn over."""
    rows, uniform = KINDS[kind]
    friction, theta = Friction.of(rows, 2), np.array([0.5, 0.4, 0.25, 20.0, 8.0])
    gains = np.ones((2, int(driven)))
    law = Lagrangian(Terms.of(ARMS, 2), theta, friction, np.full(len(rows), 0.3), uniform, gains)
    q, v = np.split(np.random.default_rng(0).normal(size=(200, 4)), 2, axis=1)
    z = np.concatenate([q, law.momentum(q, 3 * v)], axis=1)
    signals = Signals(("u",), "linear") if driven else None
    return map_of_law(law, z, 0.02, angles=(0, 1), signals=signals), z[:12]


@pytest.mark.parametrize(
    ("kind", "driven"),
    [
        pytest.param("friction", True, marks=pytest.mark.slow),
        ("alone", False),
        pytest.param("uniform", False, marks=pytest.mark.slow),
    ],
)
def test_steps_are_those_of_jax(kind, driven):
    map_, z = arms(kind, driven)
    inputs = np.sin(np.arange(100) / 30)[:, None] if driven else None
    states, info = map_.rollout(z, 99, save_every=3, inputs=inputs)
    args = map_._schedule(None, z, None, inputs, 99)
    expected, other = lanes.roll_out(map_, z, args, lanes.Saving(33, 3))
    assert Stepper.of(map_.pieces[0], 2 * driven) is not None
    np.testing.assert_allclose(states, expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(info.left_at, other.left_at)
    np.testing.assert_array_equal(info.status, other.status)


def test_a_lane_does_not_depend_on_those_beside_it():
    """To the last bit, of more lanes than are followed at once, of which one fails."""
    map_, _ = arms("alone")
    z = np.random.default_rng(1).normal(size=(45, 4))
    z[7, 2:] = 1e200
    states, _ = map_.rollout(z, 300)
    assert np.flatnonzero(np.isnan(states[:, -1, 0])).tolist() == [7]
    for lane in (0, 8, 44):
        np.testing.assert_array_equal(states[lane], map_.rollout(z[lane], 10_000)[0][:301])


@compiled("a test", 1)
def both(x, sine, cosine):
    sines(x, sine, cosine, len(x))


@pytest.mark.parametrize("size", [1e-9, 1.0, 50.0, 9e5, 1e9])
def test_sines_are_right_to_their_last_digit(size):
    x = size * np.random.default_rng(0).uniform(-1, 1, 500)
    x = np.concatenate([x, np.rint(x / np.pi * 2) * np.pi / 2])
    found = np.empty_like(x), np.empty_like(x)
    both(x, *found)
    with mpmath.workprec(200):
        for values, of in zip(found, (mpmath.sin, mpmath.cos), strict=True):
            off = [float(of(a) - b) for a, b in zip(x.tolist(), values.tolist(), strict=True)]
            assert np.max(abs(np.array(off)) / np.spacing(abs(values))) < 0.8
    both(x := np.full(8, np.inf), *(found := (np.empty(8), np.empty(8))))
    assert np.isnan(found).all()


@pytest.mark.slow
def test_energy_stays_and_many_turns_cost_no_digit():
    """A pendulum that turns over, 1e5 steps: the orbit of the step is closed to roundoff."""
    law = mechanics([((2,), (0,), (0,), 0.0, 0.5), ((0,), (0,), (1,), 0.0, 1.0)])
    z = np.random.default_rng(0).normal(size=(50, 2)) + np.array([0.0, 2.0])
    map_ = map_of_law(law, z, 0.1, angles=(0,), tolerance=1e-15)
    states, _ = map_.rollout(np.array([0.0, 2.5]), 100_000, save_every=100)
    assert states[-1, 0] > 1e4
    energy = 0.5 * states[:, 1] ** 2 - np.cos(np.asarray(states[:, 0]))
    assert np.max(abs(np.asarray(energy) / energy[0] - 1)) < 1e-11  # cos of 2e4 loses 4 digits
    steps = jax.jit(lambda z: map_.rollout(z, 10)[0])(np.array([0.0, 2.5]))
    assert steps.shape == (11, 2)


def test_a_program_is_its_field():
    """Sums that are joined, of one place twice too, against the field itself."""
    matrices = np.random.default_rng(0).normal(size=(3, 4, 4))

    def field(z, args):
        y = z @ matrices[0] @ matrices[1] + 0.5 * z
        x = np.stack(
            [y[:, 0] * y[:, 1] + 1.0, z[:, 0] - z[:, 0] * 0.5, args[:, 0], y[:, 3]], axis=1
        )
        return np.concatenate([(x * z) @ matrices[2], np.sin(x[:, :1]) / z[:, :1]], axis=1)

    found = program(field, 4, 1)
    z = np.random.default_rng(1).normal(size=(1, 5))
    values = [*z[0]]
    for (kind, a, b, d), c in list(zip(found.code, found.constants, strict=True))[5:]:
        known = {CONSTANT: lambda c=c: c, SIN: lambda a=a: np.sin(values[a])}
        known |= {INVERSE: lambda a=a: 1 / values[a]}
        known |= {JOINED: lambda a=a, b=b, c=c, d=d: values[a] + c * values[b] * values[d]}
        values.append(known[int(kind)]())
    expected = field(z[:, :4], z[:, 4:])[0]
    np.testing.assert_allclose(np.array(values)[found.values], expected, rtol=1e-13)


@pytest.mark.parametrize("branches", [lambda q: q == 0, lambda q: q != 0, bool, lambda q: q > 0])
def test_a_field_that_branches_by_the_state_is_left_to_jax(branches):
    with pytest.raises(TypeError):
        program(lambda z, _: [z[0, 1] if branches(z[0, 0]) else -z[0, 1], -z[0, 0]], 2, 0)
