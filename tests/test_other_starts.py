"""Laws of recordings that the textbook's library does not start: coordinates that nothing couples,
bodies in potentials of lengths, zeros of angles that are far off."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
from analytic import motion
from numpy.testing import assert_allclose

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError
from gfnn_jax.families.friction import LINEAR, QUADRATIC
from gfnn_jax.maps.estimates import _with_zeros
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.friction_choice import table_of
from gfnn_jax.models.lagrangians.libraries import losses, potentials
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.models.lagrangians.search import TermSearch, with_equal_masses
from gfnn_jax.models.lagrangians.starts import best_start
from gfnn_jax.models.lagrangians.structure import SINE, Structure
from gfnn_jax.models.lagrangians.weak_form import weak_start
from gfnn_jax.solve.latent_arcs import Fitted


def recorded(acceleration, start, names, end=40.0, samples=2_000, noise=1e-4, **roles):
    """Positions of q̈ = acceleration(q, v) from ``start`` (2d,), by SciPy, with noise."""
    d, t = len(start) // 2, np.linspace(0, end, samples)
    q = motion(acceleration, start, t).T + noise * np.random.default_rng(0).normal(
        size=(samples, d)
    )
    columns = dict(zip(names, q.T, strict=True))
    return gfnn.Recording({"t": t, **columns}, positions=names, **roles)


@pytest.mark.slow
def test_four_bodies_on_hardening_springs_start_from_springs_of_neighbours():
    """Beyond three coordinates the library of bodies is that of neighbours, to a degree."""

    def acceleration(q, v):
        apart = np.diff([0.0, *q, 0.0])
        return np.diff(apart + 0.5 * apart**3)

    start = [0.9, -0.3, 0.5, -0.8, 0.0, 0.0, 0.0, 0.0]
    fit = gfnn.fit(recorded(acceleration, start, ["x1", "x2", "x3", "x4"], noise=1e-3))
    assert fit.verdict != "identified" or "x1**4" in coefficients(fit.lagrangian)


def coefficients(expression):
    return {term.term: term.coefficient for term in expression.terms}


@pytest.mark.parametrize("unit", [1e-7, 1e7])
def test_the_unit_of_columns_does_not_matter(unit):
    """To a start, to coefficients where others go, and to held-out costs of friction: of a spring
    with powers up to 6."""
    t, noise = np.linspace(0, 20, 400), 1e-3 * np.random.default_rng(0).normal(size=400)
    x = motion(lambda q, v: -q - 0.4 * q**3 - 0.02 * v, [1.0, 0.0], t)[0] + noise
    terms = (((2,), (0,), (0,), 0.0), *potentials(1, [0], 1, 2, 3, 4, 5, 6))
    friction = tuple(losses(1, (LINEAR, QUADRATIC), 0.0))
    found = []
    for scale in (1.0, unit):
        problem = samples_of(gfnn.Recording({"t": t, "x": scale * x}, positions=["x"])).problem
        structure, known = weak_start(Structure(1, terms, friction[:1]), problem, prune=False)
        fit = problem.fit(structure, known, problem.arcs(1.0), problem.scales.sigma)
        fewer = fit.structure.without({("term", row) for row in terms if sum(row[1]) % 2})
        less = fit.values_within(fewer)
        powers = {("term", row): scale ** (sum(row[1]) - 2) for row in terms}
        found.append([value * powers.get(key, 1.0) for key, value in less.items()])
        table = table_of(fit, friction)
        found[-1].append(table.judged([1]).cost / table.judged([]).cost)
    assert_allclose(found[1], found[0], rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("converges", [True, False])
def test_a_term_stays_without_which_the_fit_does_not_converge(converges, monkeypatch):
    """A law whose last fit has not converged is none; one with a weak term is."""
    t, noise = np.linspace(0, 20, 400), 1e-3 * np.random.default_rng(0).normal(size=400)
    x = motion(lambda q, v: -q - 0.02 * v, [1.0, 0.0], t)[0] + noise
    problem = samples_of(gfnn.Recording({"t": t, "x": x}, positions=["x"])).problem
    terms = (((2,), (0,), (0,), 0.0), *potentials(1, [0], 2, 3))
    structure = Structure(1, terms, tuple(losses(1, (LINEAR,), 0.0)))
    known = {("term", terms[1]): -0.5}
    fit = problem.fit(structure, known, problem.arcs(4.0), problem.scales.sigma)
    again = LawFit.again

    def fewer(of, *args, **kw):
        less = again(of, *args, **kw)
        return dataclasses.replace(
            less, fitted=dataclasses.replace(less.fitted, converged=converges)
        )

    monkeypatch.setattr(LawFit, "again", fewer)
    pruned = TermSearch(None, None).prune(fit)
    assert len(pruned.structure.terms) == (2 if converges else 3)


def two_bodies(seed, coupled=0.0):
    """Two runs of two bodies between springs, with friction, whose places are read in whole units
    from zeros anywhere that wander a little; and twice the matrix of T. coupled: mass between the
    bodies, with springs beside which no other masses are both above zero without it."""
    rng = np.random.default_rng(seed)
    second, ends, between = rng.uniform(1.5, 3.5), rng.uniform(20, 60, 2), rng.uniform(50, 100)
    mass = np.diag([1.0, second]) + coupled * (1 - np.eye(2))
    spring = np.diag(ends + between) - between * (1 - np.eye(2))
    if coupled:  # V₁₂/T₁₂ lies between V₁₁/T₁₁ and V₂₂/T₂₂
        spring = np.array([[30.0, 20.0], [20.0, 20.0 * second]])
    solved, rub, t = (
        np.linalg.solve(mass, spring),
        10 ** rng.uniform(-2.2, -1.6),
        np.arange(98) / 30,
    )
    zero, runs = rng.uniform(-250, 250, 2), []
    for _ in range(2):
        start = [*rng.uniform(-110, 110, 2), 0, 0]
        q = motion(lambda q, v: -solved @ q - rub * v, start, t).T
        noise = rng.normal(size=(98, 2)) * [0.45, 0.35]
        wander, kept = 0.33 * rng.normal(size=(98, 2)), np.exp(-1 / 30 / 0.18)
        for k in range(1, 98):
            wander[k] = kept * wander[k - 1] + np.sqrt(1 - kept**2) * wander[k]
        x = np.round(zero + q + noise + wander)
        runs.append({"t": t, "x1": x[:, 0], "x2": x[:, 1]})
    return gfnn.Recording(runs, positions=["x1", "x2"]), mass


def masses_of(fit):
    """Speeds of a constant mass -> its coefficient."""
    return {k[1][0]: c for k, c in fit.values.items() if k[0] == "term" and any(k[1][0])}


@pytest.mark.slow
def test_masses_that_springs_make_up_for_couple_no_bodies():
    """Linear motion has many masses, each with springs to suit: the bodies' own are found. Those
    that only masses between them explain stay."""
    for seed in range(6):
        recording, mass = two_bodies(seed)
        masses = masses_of(best_start(samples_of(recording).problem))
        assert (1, 1) not in masses
        assert masses[0, 2] == pytest.approx(mass[1, 1] / 2, rel=0.1)
    recording, _ = two_bodies(0, coupled=0.8)
    assert (1, 1) in masses_of(best_start(samples_of(recording).problem))


@pytest.mark.slow
def test_a_trap_whose_axes_are_not_coupled_has_its_law():
    trap = recorded(lambda q, v: -np.array([1.0, 2.3]) * q - 0.01 * v, [1, 0.7, 0, 0], ["x", "y"])
    fit = gfnn.fit(trap)
    found = coefficients(fit.lagrangian)
    assert found == pytest.approx(
        {"x_dot**2": 0.5, "y_dot**2": 0.5, "x**2": -0.5, "y**2": -1.15}, rel=1e-4
    )
    assert [term.coefficient for term in fit.friction.terms] == [pytest.approx(0.01, rel=3e-3)]
    assert "nothing couples x with y" in fit.gauge
    (kind,) = fit.which_friction.kinds
    assert kind == "uniform"


@pytest.mark.slow
def test_a_spring_that_goes_leaves_its_force_to_no_other_coordinate():
    """The mass and the spring of y are told only together: the fit without the spring is no fit."""
    trap = recorded(
        lambda q, v: -np.array([1.0, 1.45]) * q - 0.017 * v,
        [0.8, 0.5, 0, 0],
        ["x", "y"],
        end=175.0,
        samples=290,
        noise=4e-5,
    )
    found = coefficients(gfnn.fit(trap).lagrangian)
    assert found == pytest.approx(
        {"x_dot**2": 0.5, "y_dot**2": 0.5, "x**2": -0.5, "y**2": -0.725}, rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize(("eccentricity", "part"), [(0.002, 0.43), (0.2, 0.9), (0.6, 0.7)])
def test_a_part_of_an_orbit_tells_the_force_by_the_distance(eccentricity, part):
    """Less than a turn, without noise; of a nearly circular one r varies by 0.2 % only."""
    period = 2 * np.pi * (1 - eccentricity) ** -1.5
    orbit = recorded(
        lambda q, v: -q / np.hypot(*q) ** 3,
        [0.6, 0.8, -0.8 * np.sqrt(1 + eccentricity), 0.6 * np.sqrt(1 + eccentricity)],
        ["x", "y"],
        end=part * period,
        samples=120,
        noise=0.0,
    )
    found = coefficients(gfnn.fit(orbit).lagrangian)
    assert found == pytest.approx(
        {"x_dot**2": 0.5, "y_dot**2": 0.5, "1/sqrt(x**2 + y**2)": 1.0}, rel=1e-6
    )


@pytest.mark.parametrize(("quartic", "amplitude"), [(0.055, 1.8), (0.03, 2.2)])
def test_torsion_that_hardens_has_a_fourth_power(quartic, amplitude):
    """V = ½ θ² + 0.055 θ⁴ was 2.0 cos θ + 1.4 θ² − 0.04 cos 2θ, identified."""

    def acceleration(q, v):
        return -q - 4 * quartic * q**3 - 0.03 * v

    options = {"end": 60.0, "samples": 1_000, "noise": 2e-3, "angles": ["theta"]}
    fit = gfnn.fit(recorded(acceleration, [amplitude, 0.0], ["theta"], **options))
    named = "theta**4" in coefficients(fit.lagrangian) or "θ⁴ in place of cos(θ)" in fit.verdict
    assert named, fit.verdict


@pytest.mark.slow
@pytest.mark.parametrize("periodic", [False, True])
def test_torsion_of_a_radian_is_no_series_of_cosines(periodic):
    def acceleration(q, v):
        return -(np.sin(q) + np.sin(2 * q) / 2 if periodic else 20 * q) - 0.1 * v

    swing = recorded(
        acceleration, [1.0, 0.0], ["a"], end=10.0, samples=300, noise=3e-3, angles=["a"]
    )
    terms = coefficients(gfnn.fit(swing).lagrangian)
    assert ("a**2" in terms) is not periodic
    if not periodic:
        assert terms == pytest.approx({"a_dot**2": 0.5, "a**2": -10.0}, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [True, False])
def test_five_bodies_with_springs_between_neighbours(turns):
    """Pendulums, or bodies on quartic springs, of which two at a time are in a term."""

    def acceleration(q, v):
        between = np.diff(np.sin(np.diff(q)) if turns else np.diff(q), prepend=0, append=0)
        return (-4 * np.sin(q) if turns else -q - 0.3 * q**3) + 0.8 * between - 0.05 * v

    names, start = list("abcde"), [0.1, 1.0, -0.5, 0.4, 0.8, 0, 0, 0, 0, 0]
    fit = gfnn.fit(recorded(acceleration, start, names, 24.0, 600, angles=names if turns else ()))
    found = coefficients(fit.lagrangian)
    assert len(found) == 14 + 5 * (not turns)
    assert found["cos(a - b)" if turns else "a*b"] == pytest.approx(0.8, rel=0.01)
    assert found["cos(e)" if turns else "e**4"] == pytest.approx(4.0 if turns else -0.075, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("start", [[0.2, 0.1, 0.1, 0.3], [0.2, 0.25, 0, 0]], ids=["turns", "rest"])
def test_henon_and_heiles_potential_from_positions(start):
    """From rest the motion is nearly along a line, of which a law with couplings alone makes
    nothing."""

    def acceleration(q, v):
        x, y = q
        return np.array([-x - 2 * x * y, -y - x * x + y * y]) - 0.01 * v

    fit = gfnn.fit(recorded(acceleration, start, ["x", "y"]))
    found = coefficients(fit.lagrangian)
    exact = {"x**2": -0.5, "y**2": -0.5, "x**2*y": -1.0, "y**3": 1 / 3}
    assert {name: found[name] for name in exact} == pytest.approx(exact, rel=2e-3)
    assert len(found) == 6


@pytest.mark.slow
def test_a_quartic_spring_of_five_periods_is_seen():
    """Its own misfit is correlated over a third of a period; what it leaves over is not."""
    spring = recorded(lambda q, v: -q - 0.87 * q**3 - 0.01 * v, [0.65, 0], ["x"], 34.0, 431, 4e-6)
    found = coefficients(gfnn.fit(spring).lagrangian)
    assert found["x**4"] == pytest.approx(-0.2175, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("zero", [1.3, -2.0])
def test_an_encoder_that_was_switched_on_anywhere(zero):
    """Of a pendulum: 2 cos(theta − zero), whichever of cos and sin has the smaller phase."""
    swings = recorded(
        lambda q, v: -2 * np.sin(q - zero) - 0.02 * v, [zero + 1, 0], ["theta"], angles=["theta"]
    )
    _, potential = gfnn.fit(swings).lagrangian.terms
    law = sp.sympify(f"{float(potential.coefficient)!r} * ({potential.term})")
    at = np.linspace(-3, 3, 7)
    np.testing.assert_allclose(
        sp.lambdify(sp.Symbol("theta"), law)(at), 2 * np.cos(at - zero), atol=1e-4
    )


@pytest.mark.slow
def test_two_encoders_that_were_switched_on_anywhere():
    """Zeros of 1 and −0.7 rad: from 0 no fit finds them."""

    def acceleration(q, v):
        a, b = q - np.array([1.0, -0.7])
        c, s = 0.4 * np.cos(a - b), 0.4 * np.sin(a - b)
        force = [-s * v[1] ** 2 - 20 * np.sin(a), s * v[0] ** 2 - 8 * np.sin(b)]
        return np.linalg.solve([[1.0, c], [c, 0.5]], force - 0.02 * v)

    pair = recorded(
        acceleration,
        [2.2, -1.3, 0, 0],
        ["theta1", "theta2"],
        12.0,
        1_200,
        1e-3,
        angles=["theta1", "theta2"],
    )
    terms = gfnn.fit(pair).lagrangian.terms
    sizes = sorted(abs(term.coefficient) for term in terms)
    assert sizes == pytest.approx([0.25, 0.4, 0.5, 8.0, 20.0], rel=2e-3)


@pytest.mark.slow
def test_a_recording_of_too_few_samples_is_refused_by_their_number():
    spring = recorded(lambda q, v: -q - q**3 - 0.02 * v, [0.9, 0], ["x"], 68 * 1.9, 68)
    with pytest.raises(FitError, match=r"sample more often: it has about 2.\d samples in a period"):
        gfnn.fit(spring)


NONE = (0, 0)
MASSES = (((2, 0), NONE, NONE, 0.0), ((0, 2), NONE, NONE, 0.0))
SPRINGS = ((NONE, (2, 0), NONE, 0.0), (NONE, (0, 2), NONE, 0.0))
COUPLING = (NONE, (2, 1), NONE, 0.0)
FRICTION = tuple(((int(i == 0), int(i == 1)), 0, 0.0) for i in range(2))


def test_a_part_that_nothing_couples_has_its_mean_inertia_given():
    q = np.random.default_rng(0).normal(size=(50, 2))
    apart = Structure(2, (*MASSES, *SPRINGS), FRICTION)
    assert apart.uncoupled == ((0,), (1,))
    assert apart.given == (0, 1)
    assert ("term", MASSES[1]) not in apart.keys()  # noqa: SIM118
    together = apart.plus([("term", COUPLING)])
    assert together.uncoupled == ((0, 1),)
    assert ("term", MASSES[1]) in together.keys()  # noqa: SIM118
    rubbing = apart.plus([("loss", ((-1, 1), 0, 0.0))])
    assert rubbing.uncoupled == ((0, 1),)
    # Without its coupling a law moves as it did, its second part by another scale.
    known = {
        ("term", MASSES[1]): 1.7,
        ("term", SPRINGS[0]): -0.4,
        ("term", SPRINGS[1]): -2.1,
        ("loss", FRICTION[0]): 0.03,
        ("loss", FRICTION[1]): 0.05,
    }
    v, u = q[::-1] * 0.3, np.zeros((50, 0))
    accelerations = []
    for structure in (together, apart):
        form = structure.form(q)
        p = structure.start(structure.in_gauge(known, q))
        law = form.lagrangian(p)
        assert np.mean(law.masses(q)[:, 0, 0]) == pytest.approx(1.0)
        accelerations.append(law.acceleration(q, v, u))
        last = np.mean(law.masses(q)[:, 1, 1])
    np.testing.assert_allclose(*accelerations, rtol=1e-12)
    assert last == pytest.approx(1.0)


def test_a_state_whose_derivatives_overflow_is_not_known():
    empty = np.zeros(0)
    triangles = np.array([[[2.0, 0.0], [0.0, 4.0]], [[np.inf, 0.0], [0.0, 1.0]]])
    fitted = Fitted(
        **dict.fromkeys([field.name for field in dataclasses.fields(Fitted)], empty)
        | {"arcs": triangles, "transports": np.tile(np.eye(2), (2, 1, 1))}
        | {"cost": 0.0, "iterations": 0, "converged": True}
    )
    known, unknown = fitted.last_covariance()
    np.testing.assert_allclose(known, np.diag([0.25, 0.0625]))
    np.testing.assert_array_equal(unknown, 1e100 * np.eye(2))


def test_a_state_whose_derivatives_overflow_is_not_known_with_zeros_that_wander_either():
    rows = np.tile([[2.0, 0.0, 0.3], [0.0, 4.0, -0.1]], (2, 1, 1))
    rows[1, 0, 0] = np.inf
    fitted = Fitted(
        **dict.fromkeys([field.name for field in dataclasses.fields(Fitted)], np.zeros(0))
        | {"rows": rows, "transports": np.tile(np.eye(2), (2, 1, 1)), "x": np.ones((2, 1, 2))}
        | {"cost": 0.0, "iterations": 0, "converged": True}
    )
    states, covariance = _with_zeros(fitted, np.full((2, 2, 1), 0.1), 0.5, np.ones(1))
    assert np.isfinite(states).all()
    np.testing.assert_allclose(covariance[0, :2, :2], np.diag([0.25, 0.0625]))
    np.testing.assert_array_equal(covariance[1], 1e100 * np.eye(3))


def test_the_zero_of_an_angle_takes_the_place_of_its_sine():
    """−9.8 cos q + 1.3 sin q in another gauge is one cosine about its zero: forces agree."""
    none, one = (0,), (1,)
    mass, cosine, sine = ((2,), none, none, 0.0), (none, none, one, 0.0), (none, none, one, SINE)
    third = (none, none, (3,), SINE)
    structure = Structure(1, (mass, cosine, sine, third))
    known = {("term", cosine): -9.8, ("term", sine): 1.3, ("term", third): 0.0}
    other, told = structure.with_sines_as_zeros(known, (0,))
    assert other.terms == (mass, cosine, third)
    assert not other.may_have(("term", sine))
    q, zero = np.linspace(-3, 3, 9), told["zero", 0]
    assert_allclose(told["term", cosine] * np.cos(q - zero), -9.8 * np.cos(q) + 1.3 * np.sin(q))
    assert structure.may_have(("term", sine))  # without a zero nothing else tells it


@pytest.mark.slow
def test_an_angle_about_a_center_has_no_mass_of_its_own():
    """L = ½(r² θ̇² + ṙ²) + 9.8 r cos θ − 15 (r − 1)², whichever coordinate comes first."""

    def acceleration(q, v):
        (angle, r), (turn, out) = q, v
        sideways = (-2 * turn * out - 9.8 * np.sin(angle)) / r
        return [sideways, r * turn**2 + 9.8 * np.cos(angle) - 30 * (r - 1)]

    start, names = [0.8, 1.4, 0.0, 0.0], ("theta", "r")
    found = recorded(acceleration, start, names, end=15.0, angles=["theta"])
    fit = gfnn.fit(found)
    assert fit.verdict == "identified"
    own = coefficients(fit.lagrangian)
    assert_allclose(own["theta_dot**2*r**2"], 0.5)
    assert_allclose(own["r_dot**2"], 0.5, rtol=1e-3)
    assert "theta_dot**2" not in own


@pytest.mark.slow
def test_equal_masses_are_not_held_where_they_leave_the_motion(monkeypatch):
    """Clean carts whose free masses come out nearly singular: draw 20 of `random_recordings`."""
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "benchmarks")
    from random_recordings import SYSTEMS, record

    rng = np.random.default_rng([list(SYSTEMS).index("carts"), 20])
    draw = record(SYSTEMS["carts"], rng)
    assert draw.right(draw.error(gfnn.fit(draw.recording)))


@pytest.mark.slow
def test_pendulums_that_nothing_couples_are_tried_where_one_is_only_led():
    """Few samples of two pendulums: in the weak form one, ever so light, is led by the other."""

    def acceleration(q, v):
        return -np.array([0.32, 0.118]) * np.sin(q)

    names, t = ["q1", "q2"], 0.616 * np.arange(174)
    q = motion(acceleration, [1.738, 1.864, 0, 0], t)
    q += 1.3e-4 * np.random.default_rng(0).normal(size=q.shape)
    record = gfnn.Recording({"t": t, "q1": q[0], "q2": q[1]}, positions=names, angles=names)
    assert len(best_start(samples_of(record).problem).structure.uncoupled) == 2


@pytest.mark.slow
def test_an_arm_whose_joints_rub_starts_from_angles_between_links():
    """Friction that falls with speed makes up for much of a wrong M: the angle of the second link
    is from the first one."""

    def acceleration(q, v):
        c, s = 0.337 * np.cos(q[1]), 0.337 * np.sin(q[1])
        mass = np.array([[1.862 + 2 * c, 0.438 + c], [0.438 + c, 0.438]])
        spin = s * np.array([-v[1] * (2 * v[0] + v[1]), v[0] ** 2])
        weight = np.array([10.181 * np.sin(q[0]), 0]) + 4.228 * np.sin(q.sum())
        rubs = np.array([0.3, 0.2]) * np.tanh(v / 1e-3) * (1 + 0.7 * np.exp(-np.abs(v) / 0.3))
        return np.linalg.solve(mass, -spin - weight - rubs)

    names, t = ["q1", "q2"], np.linspace(0, 6, 600)
    q = motion(acceleration, [0.95, -0.6, 0, 0], t, method="LSODA", rtol=1e-8)
    q += 1e-3 * np.random.default_rng(5).normal(size=(2, 600))
    record = gfnn.Recording({"t": t, "q1": q[0], "q2": q[1]}, positions=names, angles=names)
    terms = best_start(samples_of(record).problem).structure.terms
    assert {row[2] for row in terms if any(row[0]) and any(row[2])} == {(0, 1)}
    assert {row[2] for row in terms if not any(row[0])} == {(1, 0), (1, 1)}


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_two_carts_have_their_law_in_any_units(unit):
    """The start has a product of velocities too, and linear motion leaves its coefficient and the
    second mass open together."""

    def acceleration(q, v):
        between = 5 * (q[1] - q[0])
        forces = np.array([between - 8 * q[0] - 0.05 * v[0], -between - 6 * q[1] - 0.1 * v[1]])
        return forces / [1, 1.7]

    t = np.arange(0, 40, 0.04)
    q = motion(acceleration, [0.1, -0.05, 0, 0], t, rtol=1e-10)
    q += 5e-5 * np.random.default_rng(3).normal(size=q.shape)
    record = gfnn.Recording({"t": t, "x1": unit * q[0], "x2": q[1]}, positions=["x1", "x2"])
    found = with_equal_masses(best_start(samples_of(record).problem))
    terms = {k[1][:2]: v for k, v in found.values.items() if k[0] == "term"}
    law = {((0, 2), (0, 0)): 0.85 * unit**2, ((0, 0), (2, 0)): -6.5, ((0, 0), (1, 1)): 5 * unit}
    assert terms == pytest.approx(law | {((0, 0), (0, 2)): -5.5 * unit**2}, rel=0.01)
