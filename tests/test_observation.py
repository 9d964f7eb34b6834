"""What sensors show: offsets, scales and cameras whose parameters are fitted with the law, and σ of
single values."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from analytic import states_in_motion

import gfnn_jax as gfnn
from gfnn_jax.cli import main
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.maps.observation import Observation, observed

CAMERA = {"px": "x0 + R*sin(theta + tilt)", "py": "y0 - R*cos(theta + tilt)"}
GUESS = {"x0": 300.0, "y0": 250.0, "R": 180.0, "tilt": 0.0}


def motion(force, start, end=20.0, dt=0.04):
    """q̈ = force(q, v), by SciPy: t, q, v, and a generator of noise."""
    t, rng = np.arange(0, end, dt), np.random.default_rng(3)
    return t, *states_in_motion(force, start, t), lambda size: size * rng.normal(size=len(t))


def swing(**options):
    return motion(lambda q, v: -4 * np.sin(q) - 0.05 * v, [1.4, 0.0], **options)


def right(pair, value, widest):
    """Whether (value, standard error) is within four standard errors, each at most so wide."""
    return abs(pair[0] - value) < 4 * pair[1] < widest


def angle(name="theta", **options):
    return observed(coordinates=["theta"], speeds=["omega"], **{"guess": {}, **options})


def test_channels_have_the_derivatives_of_finite_differences():
    g = angle(
        observe={**CAMERA, "omega": lambda theta, omega, k=0.9, b=0.1: k * omega + b * theta**2},
        guess=GUESS,
        columns=["px", "py", "omega"],
    )
    rng, e = np.random.default_rng(0), 1e-6
    x, c = rng.normal(size=(5, 2)), g.values + rng.normal(size=len(g.values))
    seen = g(x, c)
    np.testing.assert_allclose(seen.values[:, 0], c[0] + c[1] * np.sin(x[:, 0] + c[2]))
    by_x = [g(x + e * d, c).values - g(x - e * d, c).values for d in np.eye(2)]
    by_c = [g(x, c + e * d).values - g(x, c - e * d).values for d in np.eye(len(c))]
    np.testing.assert_allclose(seen.by_state, np.stack(by_x, -1) / (2 * e), atol=1e-6)
    np.testing.assert_allclose(seen.by_coefficients, np.stack(by_c, -1) / (2 * e), atol=1e-6)


def test_parameters_start_where_a_channel_shows_its_coordinate():
    g = angle(observe={"theta": "zero + k*theta + a*sin(theta)"}, columns=["theta"])
    assert g.parameters == ("zero", "k", "a")
    np.testing.assert_allclose(g.values, [0, 1, 0], atol=1e-9)
    assert g.shifts() == (0,)
    assert g.undetermined([]) == ()
    assert "k" in g.undetermined([0])  # were it a length
    beside = angle(observe={"theta": "k*theta", "omega": "omega"}, columns=["theta", "omega"])
    assert beside.undetermined([0]) == ()


def test_a_camera_tells_the_angle():
    g = angle(observe=CAMERA, guess={**GUESS, "tilt": 0.3}, columns=["px", "py"])
    theta = np.linspace(-3, 3, 50)
    y = g(np.stack([theta, 0 * theta], axis=1)).values
    np.testing.assert_allclose(g.coordinates_of(y, [0])[:, 0], theta, atol=1e-9)


@pytest.mark.slow
def test_a_potentiometer_and_its_scale():
    t, theta, _, noise = swing()
    table = {"t": t, "theta": 1.3 * theta + 0.1 + noise(1e-3)}
    fit = gfnn.fit(
        gfnn.Recording(table, angles="theta", scale="theta", offset="theta"), friction="linear"
    )
    assert fit.observe == {"theta": "scale_theta*theta + offset_theta"}
    assert right(fit.sensors["scale_theta"], 1.3, 0.01)
    assert right(fit.sensors["offset_theta"], 0.1, 0.01)
    potential = fit.lagrangian.terms[1]
    assert right(potential[1:], 4.0, 0.02)
    assert "scale_theta = 1.2" in fit.table or "scale_theta = 1.3" in fit.table


@pytest.mark.slow
def test_a_gyroscope_beside_an_angle():
    t, theta, omega, noise = swing()
    table = {"t": t, "theta": theta + noise(1e-3), "omega": 0.9 * omega + 0.05 + noise(2e-3)}
    alone = gfnn.fit(gfnn.Recording(table), friction="linear")
    both = gfnn.fit(gfnn.Recording(table, scale="omega", offset="omega"), friction="linear")
    assert right(both.sensors["scale_omega"], 0.9, 0.005)
    assert right(both.sensors["offset_omega"], 0.05, 0.005)
    assert both.noise["omega"] == pytest.approx(2e-3, rel=0.2)
    assert both.friction.terms[0].std < alone.friction.terms[0].std


@pytest.mark.slow
def test_a_camera_is_learned_saved_and_forecast(tmp_path):
    t, theta, _, noise = swing(end=14.0)
    px, py = 320 + 200 * np.sin(theta + 0.07), 240 - 200 * np.cos(theta + 0.07)
    table = {"t": t, "px": px + noise(0.3), "py": py + noise(0.3)}
    recording = gfnn.Recording(table, coordinates="theta", observe=CAMERA, guess=GUESS)
    assert (recording.positions, recording.sensors) == ((), ("px", "py"))
    assert (recording.coordinates, recording.angles) == (("theta",), ("theta",))
    fit = gfnn.fit(recording.slice(stop=10.0), friction="linear")
    for name, value in {"x0": 320, "y0": 240, "R": 200, "tilt": 0.07}.items():
        assert right(fit.sensors[name], value, 1.0), name
    fit.map.save(tmp_path / "model")
    past, times = recording.slice(6.0, 10.0), t[251:]
    found = gfnn.load(tmp_path / "model").map.forecast(past, times)
    assert set(found.values) == {"px", "py", "theta"}
    assert np.sqrt(np.mean((found.values["px"][0] - px[251:]) ** 2)) < 0.6
    assert np.abs(found.values["theta"][0] - theta[251:]).max() < 0.01
    inside = np.abs(found.values["py"][0] - table["py"][251:]) < 2 * found.std["py"][0]
    assert inside.mean() > 0.85
    z, covariance = fit.map.estimate(past)
    assert abs(z[0, 0] - theta[250]) < 5 * np.sqrt(covariance[0, 0, 0])


def test_a_function_is_the_text_that_it_computes():
    def px(theta, x0=300.0, R=180.0, tilt=0.0):
        return x0 + R * jnp.sin(theta + tilt)

    text = angle(observe=CAMERA, guess=GUESS, columns=["px", "py"])
    own = angle(observe={"px": px, "py": CAMERA["py"]}, guess={"y0": 250.0}, columns=["px", "py"])
    x = np.random.default_rng(0).normal(size=(6, 2))
    np.testing.assert_allclose(own(x).values, text(x).values, rtol=1e-12)


@pytest.mark.slow
def test_the_zero_of_a_length_is_where_no_force_is():
    t, x, _, noise = motion(lambda q, v: -4 * q - 2 * q**3 - 0.05 * v, [1.2, 0.0])
    recording = gfnn.Recording({"t": t, "x": x + 3 + noise(1e-3)}, offset="x")
    fit = gfnn.fit(recording, friction="linear")
    assert right(fit.sensors["offset_x"], 3.0, 0.01)
    assert [term.term for term in fit.lagrangian.terms] == ["v**2", "x**2", "x**4"]
    assert right(fit.lagrangian.terms[2][1:], -0.5, 0.01)


def test_what_a_law_has_anyway_is_refused():
    t = 0.04 * np.arange(100)
    table = {"t": t, "x": np.cos(2 * t), "v": -2 * np.sin(2 * t)}
    with pytest.raises(InputError, match="every scale of x has a law of the same terms"):
        gfnn.fit(gfnn.Recording(table, scale="x"))
    with pytest.raises(InputError, match="scale_x, scale_v"):
        gfnn.fit(gfnn.Recording(table, scale=["x", "v"]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observe": {"z": "theta"}}, "no column z"),
        ({"observe": {"theta": "theta + f(b)"}}, "a call of 'f'"),
        ({"observe": {"u": "g*theta"}}, r"g: expected a first guess, guess={'g'"),
    ],
)
def test_observations_that_cannot_be_are_refused(options, message):
    t = 0.04 * np.arange(100)
    table = {"t": t, "theta": np.cos(2 * t), "u": np.sin(t)}
    with pytest.raises((InputError, FitError), match=message):
        gfnn.fit(gfnn.Recording(table, **options))


def test_identity_is_plain():
    assert Observation.plain(["a", "b"]).is_plain
    assert angle(observe={}, columns=["theta"]).is_plain
    x = np.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(Observation.plain(["a", "b"])(x).values, x[:, :2])


# σ of single values


def noisy():
    """A swing of which every third sample is fifty times as noisy as the others."""
    t, theta, _, noise = swing(end=14.0)
    sigma = np.where(np.arange(len(t)) % 3 == 0, 0.05, 1e-3)
    return t, theta + sigma * noise(1.0), sigma


@pytest.mark.slow
def test_sigma_of_each_value_weights_the_fit():
    t, theta, sigma = noisy()
    table = {"t": t, "theta": theta}
    known = gfnn.Recording(table, std={"theta": sigma})
    np.testing.assert_array_equal(known.sigma("theta", 0), sigma)
    assert known.std["theta"] == 1e-3
    weighted = gfnn.fit(known, friction="linear").lagrangian.terms[1]
    plain = gfnn.fit(gfnn.Recording(table), friction="linear").lagrangian.terms[1]
    assert right(weighted[1:], 4.0, 0.02)
    assert weighted.std < 0.7 * plain.std


def test_sigma_stands_in_a_column_of_the_file(tmp_path):
    t, theta, sigma = noisy()
    path = tmp_path / "r.csv"
    for name in ("theta_std", "error"):
        rows = np.stack([t, np.degrees(theta), np.degrees(sigma)], 1)
        np.savetxt(path, rows, "%.9g", ",", header=f"t,theta [deg],{name}", comments="")
        std = None if name == "theta_std" else {"theta": "error"}
        recording = gfnn.read(path, std=std)
        assert recording.columns == ("theta",)
        assert recording.ignored == ()
        np.testing.assert_allclose(recording.sigma("theta", 0), sigma, rtol=1e-7)
        np.testing.assert_allclose(recording.slice(1.0, 2.0).sigma("theta", 0), sigma[25:51])
    assert main(["look", str(path), "--std", "theta=error", "--json"]) == 0


# The command line, with the units of the file


@pytest.mark.slow
def test_a_file_in_degrees_and_milliseconds_is_forecast_in_them(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t, theta, _, noise = swing()
    rows = np.stack([1e3 * t, np.degrees(theta + noise(1e-3)) + 5], 1)
    for name, count in (("past.csv", 350), ("all.csv", 500)):
        np.savetxt(name, rows[:count], "%.9g", ",", header="t,phi", comments="")
    read = ["--degrees", "phi", "--time-unit", "ms", "--offset", "phi", "--friction", "linear"]
    assert main(["fit", "past.csv", "--out", "model", *read]) == 0
    report = json.loads((tmp_path / "model" / "report.json").read_text())
    assert report["observe"] == {"phi": "phi + offset_phi"}
    assert report["sensors"]["offset_phi"]["value"] == pytest.approx(np.radians(5), abs=0.002)
    assert report["noise"]["phi"]["sigma"] == pytest.approx(np.degrees(1e-3), rel=0.2)
    again = ["predict", "model", "--initial", "past.csv", "--out", "f.csv", "--compare", "all.csv"]
    assert main(again) == 0
    found = np.genfromtxt("f.csv", delimiter=",", names=True)
    np.testing.assert_allclose(found["t"], 1e3 * t[350:])
    assert np.abs(found["phi"] - np.degrees(theta[350:]) - 5).max() < 0.3
    assert "phi: RMS error 0.06" in capsys.readouterr().out
