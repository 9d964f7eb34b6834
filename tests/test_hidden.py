"""Laws of one column that shows several coordinates."""

from __future__ import annotations

import dataclasses
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Some
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.budget import Allowance, Counted
from gfnn_jax.errors import FitError, InputError, OutOfTime
from gfnn_jax.families.friction import LINEAR
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.models.lagrangians import hidden, recordings
from gfnn_jax.models.lagrangians.fit import ArcProblem
from gfnn_jax.models.lagrangians.hidden import with_hidden, with_number
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.models.lagrangians.starts import misfit
from gfnn_jax.signals.oscillations import Oscillations, oscillations

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from any_record import three_carts

STEP = 0.025


def followed(rates, start, seconds):
    """Positions of a motion, with noise of 1e-3 of their spread, and without."""
    t = STEP * np.arange(round(seconds / STEP))
    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-12}
    q = solve_ivp(rates, (0, t[-1]), start, **options).y[: len(start) // 2]
    return t, q + 1e-3 * q.std() * np.random.default_rng(0).normal(size=q.shape), q


def pendulums(g, c, m, _, s):
    """Rates of L = ½v² + c v w cos(q − p) + ½m w² + g cos q + g c cos p."""
    q, p, v, w = s
    turn, k = c * np.sin(q - p), c * np.cos(q - p)
    forces = [-turn * w * w - g * np.sin(q) - 0.01 * v, turn * v * v - g * c * np.sin(p)]
    return [v, w, *np.linalg.solve([[1, k], [k, m]], forces)]


def test_oscillations_are_the_parts_of_a_sum():
    t = np.sort(np.random.default_rng(0).uniform(0, 30, 600))
    slow, fast = np.cos(1.7 * t + 0.3), 0.4 * np.sin(4.1 * t)
    (found, *_) = oscillations(t, slow + fast, 2)
    np.testing.assert_allclose(found.omega, [1.7, 4.1], rtol=1e-3)
    parts, rates = Oscillations(np.array([1.7, 4.1])).parts(t, slow + fast)
    np.testing.assert_allclose(parts, np.stack([slow, fast], 1), atol=1e-6)
    np.testing.assert_allclose(rates[:, 1], 4.1 * 0.4 * np.cos(4.1 * t), atol=1e-5)
    t = 0.05 * np.arange(400)
    assert oscillations(t, np.exp(-0.1 * t) * np.cos(2 * t), 3) == []


@pytest.mark.parametrize(
    ("options", "hidden", "message"),
    [
        ({"positions": ["x", "y"]}, 1, "one position"),
        ({"positions": ["x"], "angles": ["x"]}, 2, "of an angle one hidden coordinate"),
    ],
)
def test_hidden_coordinates_that_cannot_be_are_refused(options, hidden, message):
    t = STEP * np.arange(400)
    recording = gfnn.Recording({"t": t, "x": np.cos(2 * t), "y": np.sin(t)}, **options)
    with pytest.raises(InputError, match=message):
        gfnn.fit(recording, model=gfnn.Lagrangian(hidden=hidden))


def test_a_tone_of_stronger_oscillations_stands_behind_a_weaker_oscillation():
    """2·3.5 − 4.4 = 2.6 is as large as powers of degree 4 make it; frequencies follow sizes."""
    t = 0.02 * np.arange(1_800)
    strong = np.exp(-0.02 * t) * np.cos(3.5 * t - 2.0 * np.exp(-0.04 * t))
    y = strong + 0.5 * np.cos(4.4 * t) + 0.12 * np.cos(2.6 * t + 1) + 0.06 * np.cos(1.9 * t)
    y += 1e-3 * np.random.default_rng(0).normal(size=len(t))
    first, second, *_, between, above, below = oscillations(t, y, 3)
    np.testing.assert_allclose(first.omega, [1.9, 3.5, 4.4], atol=0.05)
    np.testing.assert_allclose(second.omega, [2.6, 3.5, 4.4], atol=0.05)
    np.testing.assert_allclose(between.omega, [3.5, np.sqrt(3.5 * 4.4), 4.4], atol=0.05)
    np.testing.assert_allclose(above.omega, [3.5, 4.4, 1.5 * 4.4], atol=0.05)  # that none shows
    np.testing.assert_allclose(below.omega, [3.5 / 1.5, 3.5, 4.4], atol=0.05)


@dataclasses.dataclass
class Law:
    """What a number of hidden coordinates is chosen by."""

    residual: dict[str, float]
    white: bool
    count: int
    flaws: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    num_samples: int = 1_000

    @property
    def noise(self):
        return {"x": 0.09}

    @property
    def symbols(self):
        return (("x",) * (1 + self.count), ())

    @property
    def whiteness(self):
        return {"x": Some(white=self.white)}

    @property
    def lagrangian(self):
        return Some(terms=range(10 * (1 + self.count)))

    friction = Some(terms=())
    sensors, observe, traces = (), ("x",), (0,)


@pytest.mark.parametrize(
    ("laws", "number", "tried"),
    [
        ({1: (0.1, True), 2: (0.05, True)}, 1, [1]),  # white: no more is tried
        ({1: (0.2, False), 2: (0.1, True)}, 2, [1, 2]),
        ({1: (0.1, False), 2: (0.0999, True)}, 1, [1, 2]),  # no more than chance
        ({1: (0.095, False), 2: (0.05, True)}, 1, [1]),  # as large as the noise: no more is tried
        ({1: (5.0, False), 2: (6.0, False)}, None, [1, 2]),  # neither is as good as none
        ({1: (0.2, False), 2: (0.12, False)}, None, [1, 2]),  # better than none, and no noise
    ],
)
def test_the_number_of_hidden_coordinates_is_the_likeliest(laws, number, tried):
    recording: Any = Some(angles=())
    asked = []

    def find(hidden):
        asked.append(hidden)
        if hidden not in laws:
            raise FitError("none")
        size, white = laws[hidden]
        return Law({"x": size}, white, hidden)

    law: Any = with_number(find, recording, Law({"x": 4.0}, False, 0))
    assert asked == tried
    assert (law and law.count) == number
    assert number is None or f"{number} hidden" in law.messages[0]


@pytest.mark.slow
def test_the_work_of_a_search_is_counted_and_ends_with_what_was_found(monkeypatch):
    t = 0.1 * np.arange(120)
    x = np.cos(2 * t) + 0.4 * np.exp(-0.02 * t) * np.cos(5.1 * t)
    x += 1e-3 * np.random.default_rng(0).normal(size=len(t))
    recording = with_hidden(gfnn.Recording({"t": t, "x": x}, positions=["x"], angles=[]), 1)
    problem, caps = samples_of(recording).problem, []

    def searched(most):
        caps.append(Counted(most))
        monkeypatch.setattr(hidden, "Counted", lambda most: caps[-1])
        return hidden.search_hidden(problem)

    whole = searched(np.inf)
    assert not whole.ended
    most = 0.9 * caps[0].spent
    part = searched(most)
    assert most < caps[1].spent < 1.2 * most  # an evaluation more, with which it ends
    assert "terms that the record does not show may be left" in part.ended
    assert len(part.fit.p) >= len(whole.fit.p)
    assert part.fit.problem.allowance is problem.allowance  # bands are not bounded
    with pytest.raises(FitError, match=r"follows the column after 1e\+00 operations: ask for"):
        searched(1.0)


def test_any_two_modes_may_rub_on_each_other(monkeypatch):
    """The friction of three carts is any matrix in their modes: of five of its six numbers a law
    left 1.4 times the noise, and was none."""
    t = STEP * np.arange(1_200)
    x = np.cos(1.3 * t) + np.cos(2.9 * t) + np.cos(4.1 * t)
    recording = with_hidden(gfnn.Recording({"t": t, "x": x}, positions=["x"], angles=[]), 2)
    problem = samples_of(recording).problem
    monkeypatch.setattr(ArcProblem, "fit", lambda problem, structure, *others, **known: structure)
    (found, *_) = oscillations(t, x, 3)
    tried: Any = hidden._of_modes(hidden._from(problem, found), (4,))
    matrices = [np.outer(c, c).ravel() for c, *_ in tried.friction]
    assert np.linalg.matrix_rank(matrices) == 6


def test_starts_that_leave_noise_alone_are_followed_first(monkeypatch):
    """Those of other sets follow, the best first; then the best sets are tried with all powers."""
    t = STEP * np.arange(1_200)
    x = np.cos(1.3 * t) + np.cos(2.9 * t) + np.cos(4.1 * t)
    recording = with_hidden(gfnn.Recording({"t": t, "x": x}, positions=["x"], angles=[]), 2)
    problem, left = samples_of(recording).problem, [3.0, np.inf, 1.05, 20.0, 1.5, 4.0]
    monkeypatch.setattr(hidden, "oscillations", lambda *_: range(6))
    monkeypatch.setattr(hidden, "_from", lambda _, one: one)
    monkeypatch.setattr(hidden, "misfit", lambda fit: left[fit[0]])
    tried = []

    def along_two(one, degrees):
        tried.append((one, degrees))
        if one == 1:
            raise OutOfTime
        return one, degrees

    monkeypatch.setattr(hidden, "_along_two", along_two)
    starts = hidden._starts(problem, Counted(np.inf))
    assert next(starts) == (2, (4,))
    assert len(tried) == 3
    assert [*starts] == [(k, (4,)) for k in (4, 0, 5)] + [(k, (3, 4)) for k in (2, 4, 0)]
    assert len(tried) == 9


def one_of_three_carts(draw):
    """The problem of the first of three carts, in a draw of the benchmark's."""
    rng = np.random.default_rng([*b"two: three carts", draw])
    (rates, start), t = three_carts(rng), 0.02 * np.arange(1_800)
    x = solve_ivp(rates, (0, t[-1]), start, t_eval=t, rtol=1e-10, atol=1e-12).y[0]
    x += 1e-3 * x.std() * rng.normal(size=len(t))
    recording = with_hidden(gfnn.Recording({"t": t, "x": x}, positions=["x"], angles=[]), 2)
    return samples_of(recording).problem


@pytest.mark.slow
def test_modes_whose_frequencies_depend_on_the_swings_are_found():
    """Three carts on cubic springs, one mode much smaller than the others: by linear modes its
    frequency became that of another, and no law followed."""
    assert misfit(hidden.search_hidden(one_of_three_carts(304)).fit) < 1.1


@pytest.mark.slow
def test_modes_that_have_not_converged_along_short_arcs_are_seen_along_longer_ones():
    """They left three times the noise along short arcs, and all other sets were tried first: nine
    times the work."""
    cap = Counted(np.inf)
    problem = dataclasses.replace(one_of_three_carts(503), allowance=Allowance(cap=cap))
    assert misfit(next(hidden._starts(problem, cap))) < 1.1
    assert cap.spent < 5e7


@pytest.mark.slow
def test_what_has_no_second_oscillation_has_no_hidden_coordinate():
    t = STEP * np.arange(400)
    recording = gfnn.Recording({"t": t, "x": np.cos(2 * t)}, positions=["x"], angles=[])
    with pytest.raises(FitError, match="hidden=0"):
        gfnn.fit(recording, model=gfnn.Lagrangian(hidden=1))


@pytest.mark.slow
def test_a_pendulum_on_a_pendulum_is_told_by_the_first(tmp_path):
    g, c = 9.8, 0.4
    t, q, true = followed(partial(pendulums, g, c, 0.35), [0.8, -0.5, 0.0, 0.0], 40)
    seen = t < 30
    recording = gfnn.Recording({"t": t[seen], "theta": q[0, seen]})
    fit = gfnn.fit(recording)  # one column, told nothing
    assert fit.verdict == "identified"
    assert "theta shows 2 coordinates: 1 hidden" in " ".join(fit.messages)
    values = {term.term: term.coefficient for term in fit.law.lagrangian.terms}
    for name, value in (("cos(theta_seen)", g), ("cos(theta_hidden)", g * c)):
        assert values[name] == pytest.approx(value, rel=0.02)
    assert "theta_hidden is a pendulum on theta_seen" in fit.law.gauge
    started = fit.law.map.sensors.observation.hidden.states(t[seen], q[0, seen])[0]
    assert np.mean(np.abs(started[:, 1] - true[1, seen])) < 0.3 * true[1].std()
    fit.save(tmp_path / "law")
    ahead = gfnn.load(tmp_path / "law").map.forecast(recording, t[~seen])
    off = ahead.values["theta"][0] - true[0, ~seen]
    assert np.sqrt(np.mean(off**2)) < 1e-3 * true[0].std()
    assert np.mean(np.abs(off) < 2 * ahead.std["theta"][0]) > 0.9


@pytest.mark.slow
def test_a_cart_tells_another_on_a_cubic_spring():
    def rates(_, s):
        x, y, v, w = s
        pull = 5 * (y - x) + 3 * (y - x) ** 3
        return [v, w, -6 * x + pull - 0.02 * v, (-4 * y - pull - 0.03 * w) / 1.5]

    t, x, true = followed(rates, [1.0, -0.4, 0.0, 0.0], 40)
    seen = t < 30
    recording = gfnn.Recording({"t": t[seen], "x": 0.3 + x[0, seen]}, positions=["x"], angles=[])
    fit = gfnn.fit(recording, model=gfnn.Lagrangian(hidden=1))
    assert fit.verdict.startswith("one of several: x_1, x_2 are the modes")
    assert fit.law.sensors["x_rest"][0] == pytest.approx(0.3, abs=1e-3)
    off = fit.map.forecast(recording, t[~seen]).values["x"][0] - 0.3 - true[0, ~seen]
    assert np.sqrt(np.mean(off**2)) < 2e-3 * true[0].std()


@pytest.mark.parametrize(("own", "gains"), [((), False), ((-1e-3,), False), ((-1e-2,), True)])
def test_friction_that_feeds_some_motion_is_no_law(own, gains):
    """Of relative speeds of three modes, which all of them together do not feel, and of one."""
    rows = [((1, -1, 0), LINEAR, 0.0), ((0, 1, -1), LINEAR, 0.0), ((1, 0, 0), LINEAR, 0.0)]
    keys = [("loss", row) for row in rows[: 2 + len(own)]]
    fit = Some(
        structure=Some(keys=lambda: keys),
        values=dict(zip(keys, (0.77, 0.2, *own), strict=True)),
        form=Some(dim=3),
        linearised=Some(covariance=1e-6 * np.eye(len(keys))),
        problem=Some(options=Some(evidence=EVIDENCE)),
    )
    assert recordings._gains_energy(fit) == gains
