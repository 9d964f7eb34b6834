"""Motion with Coulomb's friction against stiff integrations of friction that is nearly as sharp,
and against exact solutions."""

import numpy as np
import scipy.integrate

from gfnn_jax.families.lagrangian import DRY, LINEAR, Friction, Lagrangian, Terms
from gfnn_jax.flows.coulomb import Coulomb

# Two unit masses between three springs.
TERMS = [
    ((2, 0), (0, 0), (0, 0), 0.0), ((0, 2), (0, 0), (0, 0), 0.0), ((0, 0), (2, 0), (0, 0), 0.0),
    ((0, 0), (0, 2), (0, 0), 0.0), ((0, 0), (1, 1), (0, 0), 0.0),
]  # fmt: skip
SPRINGS = np.array([0.5, 0.5, -1.0, -1.0, 1.0])


def blocks(friction, losses, gains=((), ())):
    return Lagrangian(
        Terms.of(TERMS, 2), SPRINGS, Friction.of(friction, 2), np.array(losses), 0.0,
        np.array(gains, float),
    )  # fmt: skip


def followed(law, x, h, u):
    """States (n, 4) of one lane after steps h with inputs u (n, inputs), and its modes."""
    motion, x, found, passed = Coulomb.of(law), np.array([x]), [], []
    modes = motion.begin(x, u[:1])
    for now in u:
        x, modes = motion.advance(x, modes, np.array([h]), now[None])
        found.append(x[0])
        passed.append(modes[0])
    return np.array(found), np.array(passed)


def test_bodies_that_stick_together_and_to_the_ground():
    """Friction of one mass on the ground and of both on each other, with linear friction beside."""
    width, h, count = 3e-5, 0.1, 70
    rows = [((1, 0), DRY, width), ((-1, 1), DRY, width), ((0, 1), LINEAR, 0.0)]
    law = blocks(rows, [0.3, 0.15, 0.2])
    start = [0.5, 0.2, 0.1, 0.9]
    found, modes = followed(law, start, h, np.zeros((count, 0)))
    expected = scipy.integrate.solve_ivp(
        lambda _, x: np.concatenate([x[2:], law.acceleration(x[:2], x[2:])]), (0, h * count),
        start, "Radau", h * np.arange(1, count + 1), rtol=1e-6, atol=1e-8,
    ).y.T  # fmt: skip
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=3e-4)  # it creeps
    ways = {tuple(map(int, m != 0)) for m in modes}
    assert ways == {(1, 1), (0, 1), (1, 0), (0, 0)}  # sliding, either one stuck, both
    assert np.abs(found[-1, 2:]).max() < 1e-15


def test_an_input_moves_a_body_once_it_is_strong_enough():
    """A mass that sticks on a slope: ẍ₁ = u − ρ sign(ẋ₁), its spring cut."""
    law = Lagrangian(
        Terms.of([((2,), (0,), (0,), 0.0)], 1), np.array([0.5]),
        Friction.of([((1,), DRY, 0.1)], 1), np.array([0.5]), 0.0, np.ones((1, 1)),
    )  # fmt: skip
    u = np.array([0.4, -0.5, 0.9, 0.9, 0.0, -0.2, 0.0, -0.7])[:, None]
    found, modes = followed(law, [0.0, 0.0], 1.0, u)
    # Held until u = 0.9; 0.5 slows it down for 0.6 of a unit of time, 0.7 for 3/7 of one.
    v = [0.0, 0.0, 0.4, 0.8, 0.3, 0.0, 0.0, -0.2]
    q = [0.0, 0.0, 0.2, 0.8, 1.35, 1.35 + 0.09 / 1.4, 1.35 + 0.09 / 1.4, 1.25 + 0.09 / 1.4]
    np.testing.assert_allclose(found, np.stack([q, v], axis=1), atol=1e-9)
    assert modes[:, 0].tolist() == [0, 0, 1, 1, 1, 0, 0, -1]


def test_more_directions_than_coordinates():
    """At rest within what three frictions of two coordinates hold together."""
    rows = [((1, 0), DRY, 0.1), ((0, 1), DRY, 0.1), ((-1, 1), DRY, 0.1)]
    law = blocks(rows, [0.1, 0.1, 0.1])
    found, modes = followed(law, [0.05, 0.03, 0, 0], 0.5, np.zeros((9, 0)))
    np.testing.assert_allclose(found, np.tile([0.05, 0.03, 0, 0], (9, 1)), atol=1e-15)
    assert not modes.any()


def test_steps_do_not_matter():
    """A turn is found to the order of the steps, wherever in one it falls."""
    law = blocks([((1, 0), DRY, 0.1), ((0, 1), DRY, 0.1)], [0.05, 0.03])
    start = [0.6, 0.2, 0.0, 0.3]
    (coarse, _), (fine, _) = (
        followed(law, start, 7.0 / count, np.zeros((count, 0))) for count in (70, 210)
    )
    np.testing.assert_allclose(coarse[-1], fine[-1], atol=2e-6)
