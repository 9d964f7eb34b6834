"""Which friction a record shows: by held-out arcs, its own errors, or where no choice stands."""

from types import SimpleNamespace

import numpy as np

from gfnn_jax.dataset.stretches import Arcs
from gfnn_jax.families.lagrangian import DRY, LINEAR, QUADRATIC
from gfnn_jax.models.lagrangians.friction_choice import Table, chosen
from gfnn_jax.models.lagrangians.search import _likeliest, _without_drives
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.models.lagrangians.text import WhichFriction
from gfnn_jax.solve.latent_arcs import SOFT_L1

CANDIDATES = tuple(
    (direction, kind, 0.0) for direction in ((1, 0), (0, 1)) for kind in (LINEAR, QUADRATIC, DRY)
)


def table(seed):
    """Residuals of arcs that show friction of the first candidate alone, at some fifteen standard
    errors, and eight coefficients of a law, each of which a few arcs determine."""
    rng = np.random.default_rng(seed)
    law = rng.normal(size=(30, 20, 1, 8)) * np.exp(2 * rng.normal(size=(30, 1, 1, 8)))
    friction = rng.normal(size=(30, 20, 1, 6)) + 0.3 * law[..., :6]
    residuals = 0.8 * friction[..., :1] + rng.normal(size=(30, 20, 1, 1))
    return Table(CANDIDATES, np.concatenate([law, friction, residuals], axis=-1), 1.0)


def test_friction_that_is_not_there_is_not_taken_by_the_errors_of_other_coefficients():
    """By odds on held-out arcs alone seven of these twenty had another friction as well."""
    found = [chosen(table(seed)).rows for seed in range(20)]
    assert not any(set(rows) - {CANDIDATES[0]} for rows in found)
    assert sum(rows == CANDIDATES[:1] for rows in found) >= 17


def test_coefficients_of_friction_in_standard_errors():
    """Against least squares in all coefficients at once."""
    made, subset = table(0), [0, 4]
    flat = made.rows.reshape(-1, made.rows.shape[-1])
    columns = flat[:, [*range(8), *(8 + k for k in subset)]]
    solved, rest, _, _ = np.linalg.lstsq(columns, flat[:, -1], rcond=None)
    variance = rest[0] / (len(flat) - flat.shape[-1])
    errors = np.sqrt(variance * np.diag(np.linalg.inv(columns.T @ columns)))
    expected = np.maximum(solved / errors, 0)[8:]
    assert expected.min() > 0  # else the bound ρ ≥ 0 would act
    np.testing.assert_allclose(made.significance(subset), expected, rtol=1e-8)


def test_friction_kept_against_odds_is_said_to_be_that_of_fewest_kinds():
    kept = WhichFriction(("linear",), {"none": 1e7, "linear+dry": 1 / 3.9}, {})
    assert str(kept) == (
        "linear, on held-out arcs odds of 1 : 3.9 against linear+dry; "
        "of sets within odds of 20 : 1 whose coefficients are all seen that of fewest kinds is kept"
    )
    assert "kept" not in str(WhichFriction(("linear",), {"none": 1e7, "linear+dry": 30.0}, {}))


def test_friction_that_falls_below_zero_by_longer_arcs_is_dropped():
    """One at a time, the surest first, and the fit made anew: then the other is above zero."""
    rows = tuple(((1,), kind, 0.0) for kind in (LINEAR, QUADRATIC, DRY))
    of = {rows: [0.2, -0.1, -0.2], rows[:2]: [0.2, 0.1]}

    def fit(structure, *_):
        p = np.array(of[structure.friction])
        return SimpleNamespace(
            structure=structure, p=p, values=dict(zip(structure.keys(), p, strict=True)),
            covariance=lambda: np.diag(np.full(len(p), 1e-4)), arcs=Arcs(*5 * [None]), sigma=None,
            fitted=SimpleNamespace(cost=1.0, x=None),
        )  # fmt: skip

    plain = SimpleNamespace(coordinates=("x",), speeds=("v",))
    bench = SimpleNamespace(fit=fit, systems=None, observation=plain)
    told = []
    left = _without_drives(
        bench, fit(Structure(1, (((2,), (0,), (0,), 0.0),), rows, (), 0, ())), told.append
    )
    assert left.structure.friction == rows[:2]
    assert told == ["  dropped R: abs(v): -20.0 standard errors"]


def test_of_choices_of_friction_that_do_not_stand_the_likeliest_is_taken():
    """By residuals and how many coefficients they took, in the noise of the last; friction that
    drives, or an arc that no orbit follows, is not taken."""
    rng, x = np.random.default_rng(0), np.zeros((1, 200, 2))
    noise = rng.normal(size=(1, 200, 1))

    def fit(size, losses, sigma=1.0, cost=1.0):
        friction = tuple(((1,), kind, 0.0) for kind in range(len(losses)))
        values = {("loss", row): loss for row, loss in zip(friction, losses, strict=True)}
        return SimpleNamespace(
            values=values, structure=SimpleNamespace(friction=friction), p=np.array(losses),
            correlation=2.0, arcs=SimpleNamespace(y=x[..., :1]),
            fitted=SimpleNamespace(
                residuals=size * noise / sigma, cost=cost, sigma=np.array([sigma])
            ),
        )  # fmt: skip

    bench = SimpleNamespace(observation=SimpleNamespace(loss=SOFT_L1))
    drives, lost, two = fit(0.5, [0.3, -0.1]), fit(0.4, [0.1], cost=np.inf), fit(1.0, [0.2, 0.1])
    one, last = fit(1.001, [0.2], sigma=3.0), fit(1.2, [0.3])
    tried = [(each, None) for each in (drives, lost, two, one, last)]
    assert _likeliest(bench, tried)[0] is one
    assert _likeliest(bench, [(two, None), (last, None)])[0] is two
    assert _likeliest(bench, [(drives, None), (lost, None)])[0] is lost  # none can be: the last
