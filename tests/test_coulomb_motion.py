"""The simulator of dry friction that benchmarks measure by, against exact motion."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import coulomb_motion
from coulomb_motion import Body
from random_recordings import SYSTEMS, record

OPTIONS = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}


def test_a_block_that_sticks_is_let_go_by_the_force_that_it_can_hold():
    """A force 0.5 t on a block with friction 1: at rest until t = 2, then v = (t − 2)²/4."""

    def push(q, v, u):
        return np.array([0.0, 0.5 * q[0]])  # q₀ runs as time does

    both = Body(lambda q: np.eye(2), push, np.array([[0.0, 1.0]]), np.array([1.0]))
    t = np.linspace(0, 5, 51)
    x = both.follow(np.array([0.0, 0.0, 1.0, 0.0]), t, **OPTIONS)
    late = np.maximum(t - 2, 0)
    np.testing.assert_allclose(x[:, 3], late**2 / 4, atol=1e-8)
    np.testing.assert_allclose(x[:, 1], late**3 / 12, atol=1e-8)


@pytest.mark.parametrize("push", [0.5, 1.5])
def test_friction_between_two_blocks_takes_them_along_up_to_its_size(push):
    """Of two blocks of mass 1 the first is pushed, with friction 0.5 between them: together they
    gain push/2 each while that holds, else push − 0.5 and 0.5."""
    force = lambda q, v, u: np.array([push, 0.0])  # noqa: E731
    pair = Body(lambda q: np.eye(2), force, np.array([[-1.0, 1.0]]), np.array([0.5]))
    t = np.linspace(0, 2, 5)
    v = pair.follow(np.zeros(4), t, **OPTIONS)[:, 2:]
    gains = [push / 2, push / 2] if push < 1 else [push - 0.5, 0.5]
    np.testing.assert_allclose(v, t[:, None] * gains, atol=1e-12)


@pytest.mark.parametrize("push", [0.3 * (1 - 5e-10), 0.3, 0.3 * (1 + 5e-10), 0.3001])
def test_a_push_beside_what_friction_holds(push):
    """A block at rest with friction 0.3 gains push − 0.3, or stays."""
    block = Body(lambda q: np.eye(1), lambda q, v, u: u, np.eye(1), np.array([0.3]))
    x = block.follow(np.zeros(2), np.array([0.0, 0.5, 1.0]), np.array([push]), **OPTIONS)
    gained = max(push - 0.3, 0.0) * np.array([0.0, 0.5, 1.0])
    np.testing.assert_allclose(x[:, 1], gained, atol=1e-15)


def test_two_joints_stick_and_are_let_go_by_an_input_that_jumps():
    """Two blocks at rest, on the ground and on one another, friction 1 and 0.5: pushed by 1.8 and 0
    they go together by (1.8 − 1)/2; then by −4 and 0 they slow down, the lower one by more."""
    ground = np.array([[1.0, 0.0], [-1.0, 1.0]])
    both = Body(lambda q: np.eye(2), lambda q, v, u: u, ground, np.array([1.0, 0.5]))
    x = both.follow(np.zeros(4), np.array([0.0, 1.0]), np.array([1.8, 0.0]), **OPTIONS)
    np.testing.assert_allclose(x[-1, 2:], [0.4, 0.4], atol=1e-12)
    x = both.follow(x[-1], np.array([0.0, 0.05]), np.array([-4.0, 0.0]), **OPTIONS)
    np.testing.assert_allclose(x[-1, 2:], [0.4 - 0.05 * 4.5, 0.4 - 0.05 * 0.5], atol=1e-12)


def test_a_solver_that_fails_is_told():
    runaway = Body(lambda q: np.eye(1), lambda q, v, u: v**2, np.zeros((0, 1)), np.zeros(0))
    with pytest.raises(RuntimeError, match="no solution beyond t = 1"):
        runaway.follow(np.array([0.0, 1.0]), np.array([0.0, 2.0]), **OPTIONS)


def test_a_block_that_slips_for_less_than_a_step(monkeypatch):
    """A push of 1 + a² − (t − 1)² on a block with friction 1, which slips from t = 1 − a on, until
    its speed is back at 0 at t = 1 + 2 a: SciPy's first step would pass over all of it."""
    monkeypatch.setattr(coulomb_motion, "_EVENTS", 20)
    a = 0.005

    def push(q, v, u):
        return np.array([0.0, 1 + a**2 - (q[0] - 1) ** 2])

    both = Body(lambda q: np.eye(2), push, np.array([[0.0, 1.0]]), np.array([1.0]))
    w = np.array([1e-6, 2 * a, 3 * a, 0.5])  # time since it was let go
    x = both.follow(np.array([1 - a + w[0], 0.0, 1.0, 0.0]), w - w[0], **OPTIONS)
    w = np.minimum(w, 3 * a)
    np.testing.assert_allclose(x[:, 1], a * w**3 / 3 - w**4 / 12, atol=1e-13)


def test_random_recordings_end_where_dry_friction_holds_them():
    drawn = record(SYSTEMS["Hénon–Heiles"], np.random.default_rng([5, 15]))
    assert drawn.kind == "dry"
    np.testing.assert_allclose(drawn.states[-1, 2:] / drawn.omega, 0.0, atol=1e-12)
