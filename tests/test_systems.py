"""One law of runs that differ in a parameter: its functions, flow, search and forecasts."""

import dataclasses
from itertools import combinations

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import measure, nodes_of, stretches
from gfnn_jax.errors import InputError
from gfnn_jax.families.friction import DRY, LINEAR, Friction
from gfnn_jax.families.lagrangian import Lagrangian, Terms, functions_of
from gfnn_jax.flows.legendre import family_of, law_of
from gfnn_jax.flows.systems import OfSystems
from gfnn_jax.maps.laws import map_of_law
from gfnn_jax.models.lagrangians.dependence import GroupEstimate, dependence, functions_tried
from gfnn_jax.models.lagrangians.fit import Systems, even_thirds
from gfnn_jax.models.lagrangians.structure import Structure

G = 9.81
LENGTHS = (0.5, 0.8, 1.0, 1.4, 2.0)
NONE = (0, 0)
LAW = Lagrangian(
    Terms.of(
        [
            ((2, 0), NONE, NONE, 0.0),
            ((0, 2), NONE, NONE, 0.0),
            ((1, 1), NONE, (1, -1), 0.0),
            (NONE, NONE, (1, 0), 0.0),
            (NONE, (0, 2), NONE, 0.0),
        ],
        2,
    ),
    np.array([0.5, 0.4, 0.2, 2.0, -0.5]),
    Friction.of([((1, 0), LINEAR, 0.0), ((1, -1), DRY, 0.3)], 2),
    np.array([0.2, 0.1]),
    0.05,
    np.array([[1.0], [0.5]]),
    ((0, 0), (1, 0), (0, -1), (-1, 2), (0, 0), (1, 0), (0, 0), (0, 0), (0, 1)),
)
ARGS = np.random.default_rng(0).uniform(0.5, 2.0, (40, 2))


def recorded(
    rate, starts, parameters, name, positions, angles=(), inputs=None, end=12.0, dt=0.03, noise=1e-3
):
    """Positions of a run of each parameter, by SciPy from its own equations of motion."""
    rng, t, tables = np.random.default_rng(0), np.arange(0, end, dt), []
    for number, (start, value) in enumerate(zip(starts, parameters, strict=True)):
        found = solve_ivp(
            rate, (0, t[-1]), start, t_eval=t, args=(value,), rtol=1e-10, atol=1e-10, max_step=0.1
        )
        q = found.y[: len(positions)] + noise * rng.normal(size=(len(positions), len(t)))
        columns = dict(zip(positions, q, strict=True)) | {name: np.full(len(t), value)}
        columns |= {} if inputs is None else {"u": inputs(t)}
        tables.append({"run": np.full(len(t), str(number)), "t": t, **columns})
    return gfnn.Recording(
        tables,
        positions=positions,
        angles=angles,
        parameters=[name],
        inputs=None if inputs is None else ["u"],
    )


def swing(_, x, length):
    return [x[1], -G / length * np.sin(x[0]) - 0.1 * x[1]]


def swings(lengths=LENGTHS, **options):
    starts = [(1.2 - 0.1 * k, 0.0) for k in range(len(lengths))]
    return recorded(swing, starts, lengths, "l", ("theta",), ("theta",), **options)


def carts(masses, on):
    """Two carts between three springs, a mass added to one of them."""

    def rate(_, x, mass):
        inertia = np.array([0.5, 0.8])
        inertia[on] += mass
        force = [-20 * x[0] - 15 * (x[0] - x[1]), -15 * (x[1] - x[0]) - 10 * x[1]]
        return [*x[2:], *(force / inertia)]

    starts = [(0.3, -0.1 + 0.1 * k, 0.0, 0.2) for k in range(len(masses))]
    return recorded(rate, starts, masses, "m", ("x1", "x2"), end=8.0, dt=0.02)


def within(terms, expected):
    """Names are as expected, and coefficients within three standard errors."""
    assert [t.term for t in terms] == list(expected)
    for (name, c, std), value in zip(terms, expected.values(), strict=True):
        assert abs(c - value) <= 3 * std + 1e-12, name


def test_functions_are_products_of_powers():
    found = functions_of(((0, 0), (1, 0), (-2, 1)), ARGS)
    expected = np.stack([np.ones(40), ARGS[:, 0], ARGS[:, 1] / ARGS[:, 0] ** 2], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    none = np.zeros((1, 2))
    slope = jax.jacobian(lambda a: functions_of(((0, 0), (2, 0)), a))(none)
    np.testing.assert_array_equal(slope, np.zeros((1, 2, 1, 2)))  # and not NaN
    assert functions_tried(np.array([[0.0], [0.5]])) == [(0,), (1,), (2,)]
    assert functions_tried(np.array([[0.5], [1.0]])) == [(0,), (1,), (-1,), (2,), (-2,)]
    assert (-2, 2) in functions_tried(ARGS)  # l₂²/l₁², of both lengths of a double pendulum


def test_a_law_of_one_system_has_plain_coefficients():
    one = LAW.at(ARGS[0])
    a, b = ARGS[0]
    np.testing.assert_allclose(one.coefficients, [0.5, 0.4 * a, 0.2 / b, 2 * b**2 / a, -0.5])
    np.testing.assert_allclose(one.losses, [0.2 * a, 0.1])
    np.testing.assert_allclose(one.gains, [[1.0], [0.5 * b]])
    rng = np.random.default_rng(1)
    q, v, u = rng.normal(size=(40, 2)), rng.normal(size=(40, 2)), rng.normal(size=(40, 1))
    together = LAW.at(ARGS).acceleration(q, v, u)
    for k in range(40):
        own = LAW.at(ARGS[k]).acceleration(q[k : k + 1], v[k : k + 1], u[k : k + 1])[0]
        np.testing.assert_allclose(together[k], own, rtol=1e-12)


@pytest.mark.slow
def test_the_family_of_systems_is_each_system_s_own():
    """Derivatives are those of JAX and of differences; the law comes back from its family."""
    family, params = family_of(LAW)
    assert isinstance(family.family, OfSystems)
    back = law_of(family, params)
    assert back.powers == LAW.powers
    np.testing.assert_array_equal(back.gains, LAW.gains)
    w, args = np.random.default_rng(2).normal(size=(40, 4)), np.concatenate([ARGS, ARGS[:, :1]], 1)
    gradient, derivative = family.gradient_and_hessian(params, w, args)
    one, own = family_of(LAW.at(ARGS[3]))
    expected, _ = one.gradient_and_hessian(own, w[3:4], args[3:4, 2:])
    np.testing.assert_allclose(gradient[3], expected[0], rtol=1e-12)
    of_jax = jax.vmap(jax.jacobian(family.gradient, argnums=1), in_axes=(None, 0, 0))
    np.testing.assert_allclose(derivative, of_jax(params, w, args), rtol=1e-9, atol=1e-9)
    inner, c = family.family, params[:-1]
    columns = inner.parameter_gradients(c, w, args)
    for k, step in enumerate(1e-6 * np.eye(len(c))):
        ahead, behind = (inner.gradient(c + s, w, args) for s in (step, -step))
        np.testing.assert_allclose(columns[..., k], (ahead - behind) / 2e-6, atol=1e-7)
    with pytest.raises(ValueError, match="parameters of the system"):
        family.gradient(params, w)
    assert inner.multiplier(c, 0.1) is None  # friction and an input
    assert OfSystems(inner.family.family, LAW.powers[:5]).multiplier(c[:5], 0.1) == 1.0


@pytest.mark.slow
def test_coefficients_of_a_run_are_linear_in_those_of_the_law():
    row = ((2,), (0,), (0,), 0.0)
    terms = (row, (*row, (1,)), ((0,), (2,), (0,), 0.0, (-1,)))
    structure = Structure(1, terms, (((1,), LINEAR, 0.0, (2,)),), num_inputs=1)
    args = np.array([[0.5], [1.5]])
    form = structure.form(np.array([[0.3], [0.2]]), args)
    p = np.array([0.2, -3.0, 0.1, 0.7])
    one, values, turn = form.in_systems(p, args)
    first = 0.5 - 0.2 * 1.0  # the mean of M11 over the data is 1
    np.testing.assert_allclose(values[1], [first, 0.2 * 1.5, -3 / 1.5, 0.1 * 1.5**2, 0.7])
    np.testing.assert_allclose(turn[1] @ p + [0.5, 0, 0, 0, 0], values[1], atol=1e-15)
    assert one.powers is None
    x, h, u = np.array([[0.4, -0.2]] * 2), np.full(2, 0.02), np.ones((2, 1, 6, 1))
    step = one.step(values, x, h, u)
    law = form.lagrangian(p)
    for k in range(2):  # as the law of the one system has it
        flow = map_of_law(dataclasses.replace(law.at(args[k]), gains=np.zeros((1, 0))), x, 0.02)
        z = np.concatenate([x[:, :1], law.at(args[k]).momentum(x[:, :1], x[:, 1:])], axis=1)
        still = one.step(values[k], x, h, 0 * u).states[0]
        image = np.asarray(flow.step(z)[0])[0]
        np.testing.assert_allclose(image[0], still[0], rtol=1e-7)
        assert np.isfinite(step.by_coefficients).all()


def seen_of(args, coefficients, errors):
    """What runs of each value would tell of these coefficients (V, n)."""
    return [
        GroupEstimate(np.atleast_1d(a), c, np.diag(1 / errors))
        for a, c in zip(args, coefficients, strict=True)
    ]


@pytest.mark.parametrize("on_first", [True, False])
def test_an_added_mass_is_told_whichever_inertia_is_set(on_first):
    """M₁₁ = 1 in each run: of a mass on the first body all other coefficients are fractions."""
    first = ((2, 0), NONE, NONE, 0.0)
    structure = Structure(2, (first, ((0, 2), NONE, NONE, 0.0), (NONE, (2, 0), NONE, 0.0)))
    m, rng, errors = np.array([0.0, 0.2, 0.5, 0.9]), np.random.default_rng(0), np.full(2, 1e-3)
    on, other = 0.5 + m, np.full(4, 0.8)
    inertia = (on, other) if on_first else (other, on)
    found = np.stack([0.5 * inertia[1] / inertia[0], -6 / inertia[0]], axis=1)
    values = seen_of(m, found + errors * rng.normal(size=found.shape), errors)
    one = dependence(structure, np.array([2.0, 0.0, 0.0]), values)
    depending = {row for row in one.structure.terms if isinstance(row[-1], tuple) and len(row) > 4}
    row = first if on_first else structure.terms[1]
    assert depending == {(*row, (1,))}
    assert one.gain > 1_000


def test_no_function_is_taken_where_nothing_depends():
    structure = Structure(1, (((2,), (0,), (0,), 0.0), ((0,), (0,), (1,), 0.0)))
    rng, errors = np.random.default_rng(0), np.array([1e-3])
    for _ in range(20):
        values = seen_of(LENGTHS, 2 + errors * rng.normal(size=(5, 1)), errors)
        assert dependence(structure, np.array([2.0, 0.0]), values).structure == structure


def test_a_third_of_a_few_systems_has_a_part_of_each():
    recording = swings(LENGTHS[:4], end=4.0)
    found = stretches(recording, parameters=("l",))
    nodes = nodes_of(found, measure(found))
    systems = Systems.of(("l",), nodes)
    assert systems.few
    length = systems.a_third(nodes)
    assert length == len(nodes[0].t) // 3
    from gfnn_jax.dataset.stretches import arcs_of

    arcs = arcs_of(nodes, length)
    third = systems.thirds(arcs)
    for k in range(3):
        assert {
            i for i, own in zip((i for i, _, _ in arcs.home), third, strict=True) if own == k
        } == {0, 1, 2, 3}


def test_thirds_are_as_even_as_the_parts_allow():
    """Against every cut in three. Of a double pendulum, whose record gaps left two short parts
    of, a third that held hardly anything chose another friction."""
    assert even_thirds(np.array([90, 73, 20, 116, 28])).tolist() == [0, 1, 1, 2, 2]
    rng = np.random.default_rng(0)
    for _ in range(50):
        sizes = rng.integers(1, 100, rng.integers(3, 9))
        third, cuts = even_thirds(sizes), combinations(range(1, len(sizes)), 2)
        least = min(np.sum(np.add.reduceat(sizes, [0, *cut]) ** 2) for cut in cuts)
        assert np.sum(np.bincount(third, sizes) ** 2) == least
        assert np.all(np.diff(third) >= 0)
    for count in range(3, 30):  # of parts of one size
        assert even_thirds(np.full(count, 5)).tolist() == [k * 3 // count for k in range(count)]


@pytest.fixture(scope="module")
def of_lengths():
    recording = swings()
    return recording, gfnn.fit(recording)


@pytest.mark.slow
def test_pendulums_of_five_lengths_are_one_law(of_lengths):
    _, fit = of_lengths
    within(fit.lagrangian.terms, {"omega**2": 0.5, "cos(theta)/l": G})
    within(fit.friction.terms, {"omega**2": 0.05})
    assert {str(s) for s in fit.lagrangian.sympy().free_symbols} == {"omega", "theta", "l"}
    assert "for every l" in fit.gauge
    assert fit.messages == ()


@pytest.mark.slow
def test_a_length_that_no_run_had_is_forecast_within_its_band(of_lengths, tmp_path):
    _, fit = of_lengths
    fit.map.save(tmp_path / "law")
    map_ = gfnn.load(tmp_path / "law").map
    for length in (1.2, 2.3):
        new = swings((length,), end=20.0)
        ahead = new.times("0")[new.times("0") > 4.0]
        found = map_.forecast(new.slice(stop=4.0), ahead)
        error = found.values["theta"][0] - new.values("theta", "0")[-len(ahead) :]
        assert 0.9 < np.mean(np.abs(error) <= 2 * found.std["theta"][0]) <= 1.0
        assert np.sqrt(np.mean(error**2)) < 1.3e-3
        assert len(found.outside) == (length > 2)
    assert "l = 2.3 is outside 0.5 to 2" in found.outside[0]


@pytest.mark.slow
def test_a_rollout_takes_the_parameter(of_lengths):
    _, fit = of_lengths
    steps, dt = 200, float(fit.map.dt)
    states, info = fit.map.rollout([[0.5, 0.0]] * 3, steps, params={"l": [0.7, 1.6, 3.0]})
    for k, length in enumerate((0.7, 1.6, 3.0)):
        found = solve_ivp(swing, (0, steps * dt), (0.5, 0), args=(length,), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(states[k, -1], found.y[:, -1], atol=2e-3)
    assert info.status.tolist() == [0, 0, 1]  # longer than any that was seen
    assert fit.map.multiplier() == pytest.approx(np.exp(-0.1 * dt), abs=1e-5)


@pytest.mark.slow
def test_the_formula_can_be_given_again(of_lengths):
    recording, fit = of_lengths
    again = gfnn.fit(recording, terms=[fit.formula, "R: omega**2"])
    (_, gravity), (_, first) = again.lagrangian.terms, fit.lagrangian.terms
    assert gravity.term.startswith("cos(theta")
    assert gravity.term.endswith(")/l")
    assert abs(gravity.coefficient - first.coefficient) < 3 * first.std
    with pytest.raises(InputError, match="whole powers of l"):
        gfnn.fit(recording, terms=["V: cos(theta)/sqrt(l)"])


@pytest.mark.slow
def test_a_column_that_does_not_matter_changes_nothing():
    runs = [swings((1.0,), end=9.0) for _ in range(3)]
    tables = [
        {
            "run": np.full(len(one.times("0")), str(k)),
            "t": one.times("0"),
            "theta": one.values("theta", "0") + 1e-3 * np.random.default_rng(k).normal(size=300),
        }
        for k, one in enumerate(runs)
    ]
    options = {"positions": ["theta"], "angles": ["theta"]}
    without = gfnn.fit(gfnn.Recording(tables, **options))
    with_it = [{**table, "mass": np.full(300, 0.1 * k)} for k, table in enumerate(tables)]
    with pytest.warns(gfnn.FitWarning, match="no coefficient of the law depends on it"):
        found = gfnn.fit(gfnn.Recording(with_it, **options, parameters=["mass"]))
    assert found.map.parameters is None
    np.testing.assert_array_equal(found.map.pieces[0].params, without.map.pieces[0].params)
    assert found.lagrangian == without.lagrangian


@pytest.mark.slow
@pytest.mark.parametrize("on", [0, 1])
def test_a_mass_on_one_of_two_carts(on):
    fit = gfnn.fit(carts((0.0, 0.2, 0.4, 0.8), on))
    scale = 0.5 + 0.35 if on == 0 else 0.5  # the mean inertia of the first cart
    masses = {
        0: {"v1**2": 0.25, "v1**2*m": 0.5, "v2**2": 0.4},
        1: {"v1**2": 0.25, "v2**2": 0.4, "v2**2*m": 0.5},
    }[on]
    springs = {"x1**2": -17.5, "x1*x2": 15.0, "x2**2": -12.5}
    within(fit.lagrangian.terms, {k: v / scale for k, v in (masses | springs).items()})
    assert fit.friction.terms == ()
    new = carts((0.55,), on)
    found = fit.map.forecast(new.slice(stop=3.0), new.times("0")[new.times("0") > 3.0])
    for name in ("x1", "x2"):
        error = found.values[name][0] - new.values(name, "0")[-found.values[name].shape[1] :]
        assert np.mean(np.abs(error) <= 2 * found.std[name][0]) > 0.9


@pytest.mark.slow
def test_a_gain_tells_the_scale_for_every_mass():
    """An oscillator with added masses, driven: the gain of the force is the same for all."""
    rates, phases = np.array([0.7, 1.3, 2.1, 3.3]), np.array([0.1, 2.0, 4.0, 5.0])

    def force(t):
        return np.sum(np.sin(np.multiply.outer(t, rates) + phases), axis=-1)

    def rate(t, x, mass):
        return [x[1], (-3 * x[0] - 0.05 * x[1] + 0.7 * force(t)) / (0.5 + mass)]

    masses = (0.0, 0.1, 0.3, 0.6)
    fit = gfnn.fit(recorded(rate, [(0.3, 0.0)] * 4, masses, "m", ("x",), (), force, 30.0, 0.05))
    within(fit.lagrangian.terms, {"v**2": 0.25 / 0.75, "v**2*m": 0.5 / 0.75, "x**2": -1.5 / 0.75})
    gain, std = fit.gains["u"]["x"]
    assert abs(gain - 0.7 / 0.75) < 3 * std
    assert "gains of inputs are the same" in fit.gauge
    z = [[0.3, 0.0]]
    states, _ = fit.map.rollout(
        z, 100, params={"m": [0.2]}, inputs=force(0.05 * np.arange(101))[:, None]
    )
    found = solve_ivp(rate, (0, 5.0), (0.3, 0), args=(0.2,), rtol=1e-10, atol=1e-12, max_step=0.05)
    np.testing.assert_allclose(states[0, -1, 0], found.y[0, -1], atol=2e-3)


def added(masses, **options):
    """A cart on a spring, with masses on it."""
    starts = [(0.8, 0.0)] * len(masses)
    options = {"end": 20.0, "dt": 0.05, **options}
    return recorded(
        lambda _, x, m: [x[1], (-3 * x[0] - 0.05 * x[1]) / (0.5 + m)],
        starts,
        masses,
        "m",
        ("x",),
        **options,
    )


@pytest.mark.slow
def test_two_values_do_not_tell_two_functions_and_that_is_said():
    with pytest.warns(gfnn.FitWarning, match="2 functions of m, and the runs are of 2 values"):
        fit = gfnn.fit(added((0.05, 0.4)))
    within(
        fit.lagrangian.terms,
        {k: v / 0.725 for k, v in {"v**2": 0.25, "v**2*m": 0.5, "x**2": -1.5}.items()},
    )
    one = gfnn.fit(swings((0.6, 1.7)))  # of one function a second value is a test
    within(one.lagrangian.terms, {"omega**2": 0.5, "cos(theta)/l": G})
    assert one.messages == ()


def swinging(lever):
    """Five pendulums whose frequencies are those of g/lever(l)."""

    def rate(_, x, length):
        return [x[1], -G / lever(length) * np.sin(x[0]) - 0.05 * x[1]]

    starts = [(1.2 - 0.1 * k, 0.0) for k in range(5)]
    return gfnn.fit(recorded(rate, starts, LENGTHS, "l", ("theta",), ("theta",)))


@pytest.mark.slow
def test_a_dependence_that_no_power_is_is_told_to_be_an_interpolation():
    with pytest.warns(gfnn.FitWarning, match="functions of l, and the runs are of 5 values"):
        swinging(lambda length: length + 0.3 * np.sin(3 * length))


@pytest.mark.slow
def test_a_quotient_of_powers_comes_out():
    """g/(l + l³/10): an inertia of 1 + l²/10, and forces by 1/l."""
    c = {
        t.term: t.coefficient
        for t in swinging(lambda length: length + 0.1 * length**3).lagrangian.terms
    }
    assert c["omega**2*l**2"] / c["omega**2"] == pytest.approx(0.1, rel=2e-3)
    assert c["cos(theta)/l"] / c["omega**2"] == pytest.approx(2 * G, rel=2e-3)


@pytest.mark.slow
def test_an_inertia_and_a_lever_that_are_no_powers_come_out():
    """A rod and a bob: an inertia of 0.3 + l², a lever of 0.2 + l, uniform friction; L up to a
    factor l²."""

    def rate(_, x, length):
        torque = -G * (0.2 + length) * np.sin(x[0])
        return [x[1], torque / (0.3 + length**2) - 0.05 * x[1]]

    starts = [(1.2 - 0.1 * k, 0.0) for k in range(5)]
    fit = gfnn.fit(recorded(rate, starts, LENGTHS, "l", ("theta",), ("theta",)))
    c = {t.term: t.coefficient for t in fit.lagrangian.terms}
    assert c["omega**2/l**2"] / c["omega**2"] == pytest.approx(0.3, rel=0.01)
    assert c["cos(theta)/l**2"] / c["cos(theta)/l"] == pytest.approx(0.2, rel=0.02)
    assert c["cos(theta)/l"] / c["omega**2"] == pytest.approx(2 * G, rel=2e-3)
    assert [t.term for t in fit.friction.terms] == ["omega**2", "omega**2/l**2"]
