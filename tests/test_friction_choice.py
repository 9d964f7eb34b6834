"""Which friction a record shows: by held-out arcs, its own errors, or where no choice stands."""

from types import SimpleNamespace

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.families.friction import DRY, ISOTROPIC, LINEAR, QUADRATIC
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice, Table, chosen
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.models.lagrangians.search import frictions_tried, likeliest, without_drives
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.solve.latent_arcs import SOFT_L1

CANDIDATES = tuple(
    (direction, kind, 0.0) for direction in ((1, 0), (0, 1)) for kind in (LINEAR, QUADRATIC, DRY)
)


def table(seed, size=0.8, alike=0.0, correlation=1.0):
    """Residuals of arcs that show friction of the first candidate alone, at some twenty standard
    errors, and eight coefficients of a law, each of which a few arcs determine. alike: of the first
    candidate and another direction of its kind, the correlation."""
    rng = np.random.default_rng(seed)
    law = rng.normal(size=(30, 20, 1, 8)) * np.exp(2 * rng.normal(size=(30, 1, 1, 8)))
    friction = rng.normal(size=(30, 20, 1, 6)) + 0.3 * law[..., :6]
    friction[..., 3] = alike * friction[..., 0] + np.sqrt(1 - alike**2) * friction[..., 3]
    residuals = size * friction[..., :1] + rng.normal(size=(30, 20, 1, 1))
    return Table(CANDIDATES, np.concatenate([law, friction, residuals], axis=-1), correlation)


@pytest.mark.parametrize(
    ("names", "factors", "joint"),
    [
        (("x1_m", "x2_m"), (1, 1), (-1, 1)),
        (("x1_mm", "x2_m"), (1e3, 1), (-1, 1000)),
        (("x1_m", "x2_cm"), (1, 1e2), (-100, 1)),
        (("a", "b"), (1, 1), (-1, 1)),
        (("a", "b"), (1e3, 1), None),  # in units that nobody told
        (("angle", "x_m"), (1, 1), None),
        (("x1_m", "level_V"), (1, 1), None),
    ],
)
def test_speeds_have_differences_in_one_unit(names, factors, joint):
    t = 0.05 * np.arange(400)
    x = np.stack([np.cos(2 * t), np.sin(2 * t) + 0.5 * np.cos(5 * t)], axis=1) * factors
    x = x * (1 + 1e-3 * np.random.default_rng(0).normal(size=x.shape))
    recording = gfnn.Recording({"t": t, **dict(zip(names, x.T, strict=True))}, positions=names)
    tried = {row[0] for row in frictions_tried(samples_of(recording).problem)}
    joints = {c for c in tried if len(set(map(np.sign, c)) - {0}) > 1}
    assert joints == ({joint} if joint else set())


def test_a_coefficient_of_one_third_alone_leaves_the_choice_to_the_others():
    made = table(0)
    made.rows[:20, ..., 1] = 0.0
    found = chosen(Table(CANDIDATES, made.rows, 1.0))
    assert found.rows == (CANDIDATES[0],)
    assert np.isfinite(list(found.odds.values())).all()


def test_friction_that_is_not_there_is_not_taken_by_the_errors_of_other_coefficients():
    """By odds on held-out arcs alone seven of these twenty had another friction as well. That some
    have none is the limit which the module names."""
    found = [chosen(table(seed)).rows for seed in range(20)]
    assert not any(set(rows) - {CANDIDATES[0]} for rows in found)
    assert sum(rows == CANDIDATES[:1] for rows in found) >= 17


@pytest.mark.parametrize(("seed", "alike", "size"), [(2, 0.8, 1.5), (3, 0.95, 0.8), (1, 0.95, 1.5)])
def test_a_direction_alike_does_not_stand_for_the_one_that_is_there(seed, alike, size):
    """Where held-out arcs alone, asked first, leave the other direction."""
    assert chosen(table(seed, size, alike)).rows == CANDIDATES[:1]


def test_isotropic_drag_comes_before_quadratic_friction_that_explains_no_more():
    """Though that was chosen before, as close to another fit."""
    quadratic = tuple((c, QUADRATIC, 0.0) for c in ((1, 0), (0, 1)))
    rng = np.random.default_rng(0)
    two = rng.normal(size=(30, 20, 1, 2))
    drag = two.sum(axis=-1, keepdims=True) + 0.01 * rng.normal(size=(30, 20, 1, 1))
    law, noise = rng.normal(size=(30, 20, 1, 4)), rng.normal(size=(30, 20, 1, 1))
    rows = np.concatenate([law, two, drag, two.sum(axis=-1, keepdims=True) + noise], axis=-1)
    made = Table((*quadratic, ((1, 1), ISOTROPIC, 2.0)), rows, 1.0)
    before = FrictionChoice(quadratic, {}, {}, gains=False)
    assert chosen(made, before=before).kinds == (ISOTROPIC,)


def test_kinds_that_are_asked_for_are_taken_and_odds_are_those_against_sets_that_are_seen():
    assert chosen(table(0), choose=False).kinds == (LINEAR, QUADRATIC, DRY)
    made = table(6)  # in which all three at once ask for ρ < 0
    assert chosen(made, choose=False).kinds == (LINEAR, QUADRATIC)
    found = chosen(made)
    assert found.odds[()] > 1e6
    assert all(made.leanest(kinds).is_seen for kinds in found.odds)
    given = chosen(made, rows=CANDIDATES[1:2])
    assert given.rows == CANDIDATES[1:2]
    assert given.odds[(LINEAR,)] < 1e-6


def test_what_is_seen_by_the_number_of_residuals_and_their_correlation():
    """z² > log n, of n = 600 residuals, or of those that are independent."""
    made, subset = table(5), [0, 4]
    judged = made.judged(subset)
    sizes, z = judged.sizes, judged.significance
    np.testing.assert_allclose(sizes, z / np.sqrt(np.log(600)))
    correlated = table(5, correlation=4.0)
    np.testing.assert_allclose(correlated.judged(subset).significance, z / 2)
    np.testing.assert_allclose(
        correlated.judged(subset).sizes, z / 2 / np.sqrt(np.log(150)), rtol=1e-12
    )
    rounded = Table(CANDIDATES, made.rows, 1.0, rounding=100.0)
    assert rounded.judged(subset).significance.max() < 1


def test_coefficients_of_friction_in_standard_errors():
    """Against least squares in all coefficients at once."""
    made, subset = table(5), [0, 4]
    flat = made.rows.reshape(-1, made.rows.shape[-1])
    columns = flat[:, [*range(8), *(8 + k for k in subset)]]
    solved, rest, _, _ = np.linalg.lstsq(columns, flat[:, -1], rcond=None)
    variance = rest[0] / (len(flat) - flat.shape[-1])
    errors = np.sqrt(variance * np.diag(np.linalg.inv(columns.T @ columns)))
    expected = np.maximum(solved / errors, 0)[8:]
    assert expected.min() > 0  # else the bound ρ ≥ 0 would act
    np.testing.assert_allclose(made.judged(subset).significance, expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("choose", "rest", "left"), [(True, 0.1, 2), (True, 5e-3, 1), (False, 5e-3, 2)]
)
def test_friction_that_falls_below_zero_by_longer_arcs_is_dropped(choose, rest, left):
    """One at a time, the surest first, and the fit made anew: then the other is above zero, or half
    a standard error, which no one asked for."""
    rows = tuple(((1,), kind, 0.0) for kind in (LINEAR, QUADRATIC, DRY))
    of = {rows: [0.2, -0.1, -0.2], rows[:2]: [0.2, rest], rows[:1]: [0.2]}
    options = SimpleNamespace(choose_friction=choose, evidence=EVIDENCE)

    told = []

    def fit(structure):
        values = dict(zip(structure.keys(), of[structure.friction], strict=True))
        return SimpleNamespace(
            structure=structure,
            values=values,
            significance={key: 100 * value for key, value in values.items()},
            follows=True,
            again=fit,
            problem=SimpleNamespace(
                word=lambda key: key[1], on_progress=told.append, options=options
            ),
        )

    found = without_drives(fit(Structure(1, (((2,), (0,), (0,), 0.0),), rows, (), 0, ())))
    assert found.structure.friction == rows[:left]
    assert told[0] == f"  dropped {rows[2]}: -20.0 standard errors"


def test_of_choices_of_friction_that_do_not_stand_the_likeliest_is_taken():
    """By residuals and how many coefficients they took, in the noise of the last; friction that
    drives, or an arc that no orbit follows, is not taken."""
    noise = np.random.default_rng(0).normal(size=(1, 200, 1))

    def fit(size, losses, sigma=1.0, cost=1.0):
        friction = tuple(((1,), kind, 0.0) for kind in range(len(losses)))
        values = {("loss", row): loss for row, loss in zip(friction, losses, strict=True)}
        return SimpleNamespace(
            values=values,
            structure=SimpleNamespace(friction=friction),
            p=np.array(losses),
            independent=100.0,
            follows=bool(np.isfinite(cost)),
            problem=SimpleNamespace(observation=SimpleNamespace(loss=SOFT_L1)),
            fitted=SimpleNamespace(residuals=size * noise / sigma, sigma=np.array([sigma])),
        )

    drives, lost, two = fit(0.5, [0.3, -0.1]), fit(0.4, [0.1], cost=np.inf), fit(1.0, [0.2, 0.1])
    one, last = fit(1.001, [0.2], sigma=3.0), fit(1.2, [0.3])
    tried = [(each, None) for each in (drives, lost, two, one, last)]
    assert likeliest(tried)[0] is one
    assert likeliest([(two, None), (last, None)])[0] is two
    assert likeliest([(drives, None), (lost, None)])[0] is lost  # none can be: the last


@pytest.mark.parametrize(
    ("seed", "damping", "kinds"), [(3, 0.002, ("linear",)), (4, 0.002, ("linear",)), (3, 0.0, ())]
)
def test_friction_that_adds_up_over_a_short_record(seed, damping, kinds):
    """Six periods of a spring whose readings are averages of five. Each third begins with a state
    of its own, and two periods show too little of friction: held-out thirds chose none."""
    t = np.arange(150) * 2 * np.pi / 25
    noise = np.random.default_rng(seed).normal(size=len(t) + 4)
    smoothed = np.convolve(noise, np.ones(5) / np.sqrt(5), "valid")
    x = np.exp(-damping * t) * np.cos(t) + 0.01 * smoothed
    found = gfnn.fit(gfnn.Recording({"t": t, "x": x}, positions=["x"]))
    assert found.which_friction.kinds == kinds
