"""Angles lifted and compared: wrapped images made continuous; states in other coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.coordinates import (
    CARTESIAN,
    Coordinates,
    lift,
    nearest_image,
    polar,
    to_inner,
    to_user,
    whole_turns,
)
from gfnn_jax.data.files import read_trajectories


def test_images_are_lifted_across_parts_that_lie_far_apart():
    """A shear turns the angle by p, several times around: no nearest image would do."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, 9_000)
    p = np.concatenate([rng.uniform(low, low + 4, 3_000) for low in (0, 5, 10)])
    wrapped = np.mod(angle + p, 2 * np.pi)
    y0, y1, _, whole = lift(
        np.stack([angle, p], axis=1),
        np.stack([wrapped, p], axis=1),
        Coordinates("pendulum", angles=(0,)),
    )
    turns = (y1 - y0)[:, 0] - p
    np.testing.assert_allclose(turns, turns[0], atol=1e-12)
    assert whole.all()


def test_angles_in_a_file_may_be_wrapped_or_not(tmp_path):
    """A free rotor over many turns: the same pairs for a fit, however its angle was written."""
    p, t = np.linspace(1, 5, 20)[:, None], np.arange(50)
    angle = 0.3 + p * t
    prepared = []
    for name, written in (("unwrapped", angle), ("wrapped", np.angle(np.exp(1j * angle)))):
        columns = [np.repeat(np.arange(20), 50), np.tile(t, 20), written.ravel(), np.repeat(p, 50)]
        path = tmp_path / f"{name}.csv"
        header = "sequence,t,q1 [rad],p1"
        np.savetxt(path, np.column_stack(columns), "%.17g", ",", header=header, comments="")
        pairs = read_trajectories(path).pairs()
        prepared.append(lift(pairs.z0, pairs.z1, Coordinates("rotor", angles=(0,)))[:2])
    np.testing.assert_allclose(prepared[0], prepared[1], rtol=0, atol=1e-12)


def test_differences_of_angles_are_those_of_the_nearest_image():
    difference = np.array([[0.1, 7.0, -4.0, 9.0], [2 * np.pi, -7.0, 3.0, np.inf]])
    before = difference.copy()
    found = nearest_image(difference, (0, 2))
    np.testing.assert_array_equal(difference, before)
    np.testing.assert_allclose(found[:, 0], [0.1, 0.0], atol=1e-15)
    np.testing.assert_allclose(found[:, 2], [2 * np.pi - 4.0, 3.0], atol=1e-15)
    np.testing.assert_array_equal(found[:, [1, 3]], before[:, [1, 3]])
    np.testing.assert_array_equal(nearest_image(difference, ()), before)
    assert np.isnan(nearest_image(difference, (3,))[1, 3])
    assert nearest_image(np.zeros((2, 5, 4)), (1,)).shape == (2, 5, 4)


def test_whole_turns_of_numpy_and_jax():
    angle = np.array([3.0, 3.3, -10.0])
    np.testing.assert_allclose(whole_turns(angle) / (2 * np.pi), [0, 1, -2])
    np.testing.assert_array_equal(jax.jit(whole_turns)(jnp.asarray(angle)), whole_turns(angle))


@pytest.mark.parametrize("shape", [(4,), (3, 4), (70, 4), (5, 7, 4), (0, 4)])
def test_states_change_coordinates_whatever_their_batch(shape):
    z = np.random.default_rng(1).uniform(0.5, 1.5, shape)
    y = to_inner(polar(cyclic=True), z)
    assert isinstance(y, np.ndarray)
    assert y.shape == shape
    np.testing.assert_allclose(y[..., 0], np.hypot(z[..., 0], z[..., 1]), rtol=1e-15)
    np.testing.assert_allclose(y[..., 1], np.arctan2(z[..., 1], z[..., 0]), rtol=1e-15)
    np.testing.assert_allclose(to_user(polar(cyclic=True), y), z, rtol=1e-14)


def test_a_state_without_inner_coordinates_is_nan_and_leaves_the_others_alone():
    z = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 1.0]])
    y = to_inner(polar(cyclic=True), z)
    assert np.isnan(y[0]).any()
    np.testing.assert_allclose(y[1], [1.0, 0.0, 0.0, 1.0])


def test_batches_of_several_sizes_share_a_program_and_the_identity_has_none(compilations):
    rng = np.random.default_rng(2)
    to_inner(polar(cyclic=False), rng.uniform(1, 2, (100, 4)))
    with compilations() as found:
        to_inner(polar(cyclic=True), rng.uniform(1, 2, (128, 4)))
        z = rng.uniform(1, 2, (1_000, 4))
        np.testing.assert_array_equal(to_inner(CARTESIAN, z), z)
        np.testing.assert_array_equal(to_user(Coordinates("torus", angles=(0, 1)), z), z)
    assert found.count == 0
