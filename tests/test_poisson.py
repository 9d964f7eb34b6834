"""`gfnn.fit` of states with a bracket of their own: pairs, recordings, files, folders."""

import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
from analytic import states_in_motion
from test_brackets_found import cross, heavy, populations, runs_of, top
from test_exports import by_c, by_c_with, compiled, needs_cc

import gfnn_jax as gfnn
from gfnn_jax import cli, cli_parser
from gfnn_jax.data.text_files import to_text
from gfnn_jax.errors import FitError, InputError


def pairs_of(data, **more):
    known = {"run": data.run, "place": data.place, "structure": "poisson"}
    return gfnn.Pairs(data.z0, data.z1, data.dt, **known, **more)


@pytest.fixture(scope="module")
def heavy_top():
    starts = np.random.default_rng(0).normal(size=(20, 6))
    return gfnn.fit(pairs_of(runs_of(heavy, starts, 0.2, 20))), starts


def test_a_heavy_top(heavy_top):
    fit, starts = heavy_top
    assert fit.verdict == "identified"
    assert fit.bracket.blocks == ("se3",)
    assert fit.formula == "0.1*z4 + 0.2*z5 + 0.9*z6 + 0.25*z1**2 + 0.3*z2**2 + 0.5*z3**2"
    assert [c.formula for c in fit.casimirs] == ["z1*z4 + z2*z5 + z3*z6", "z4**2 + z5**2 + z6**2"]
    states = np.asarray(fit.map.rollout(starts[:4], 500)[0])
    for casimir in fit.casimirs:
        values = casimir(states)
        assert np.abs(values / values[:, :1] - 1).max() < 5e-15
    assert fit.report()["bracket"]["name"] == "se(3)"
    assert fit.symplecticity_defect < 1e-12


def test_a_saved_law_is_the_same(heavy_top, tmp_path):
    fit, starts = heavy_top
    fit.save(tmp_path / "top")
    again = gfnn.load(tmp_path / "top")
    assert (again.formula, str(again.bracket)) == (fit.formula, str(fit.bracket))
    assert again.verdict == fit.verdict
    one, other = (np.asarray(f.map.step(starts)[0]) for f in (fit, again))
    assert np.array_equal(one, other)
    told = r"bracket of its own, se\(3\), of which to=.js. .*to=.c-taylor.*to=.latex"
    with pytest.raises(InputError, match=told):
        gfnn.export(fit, "js", tmp_path / "top.js")
    assert gfnn.export(fit, "latex", tmp_path / "top.tex").read_text().startswith("H = ")


@pytest.mark.slow
def test_a_given_bracket():
    data = runs_of(populations, np.random.default_rng(0).uniform(0.5, 1.5, (20, 4)), 0.2, 20)
    form = [[0, 1, 0, -0.9], [-1, 0, 0.7, 0], [0, -0.7, 0, 1.3], [0.9, 0, -1.3, 0]]
    known = gfnn.Bracket.log(form)
    fit = gfnn.fit(pairs_of(data), model=gfnn.Hamiltonian(bracket=known))
    assert fit.met
    assert fit.bracket.name == "log-canonical"
    beside = np.array(fit.map.step(data.z0[:50])[0])
    assert np.abs(beside - data.z1[:50]).max() < 1e-12
    z0 = np.where(np.arange(len(data.z0))[:, None] % 97 == 3, -data.z0, data.z0)
    pairs = gfnn.Pairs(z0, data.z1, 0.2, run=data.run, structure="poisson")
    with pytest.raises(FitError, match=r"not above 0 in 5 of 400 pairs, rows \[3, 100, ") as raised:
        gfnn.fit(pairs, bracket=known)
    call = str(raised.value).partition("Without them: ")[2]
    told = SimpleNamespace(fit=lambda pairs, bracket: len(pairs.z0))
    assert eval(call, {"gfnn": told, "pairs": pairs, "bracket": known}) == 395
    with pytest.raises(FitError, match="has 3 coordinates, the states have 4"):
        gfnn.fit(pairs_of(data), bracket=gfnn.Bracket.so3())


def gyroscope(path, count):
    """Runs of a gyroscope, written to a file as a phone does."""
    starts = np.random.default_rng(0).normal(size=(count, 3))
    data = runs_of(top, starts, 0.05, 300, noise=1e-3)
    names = tuple(f"Gyroscope {axis} (rad/s)" for axis in "xyz")
    columns = dict(zip(names, data.z0.T, strict=True))
    path.write_text(to_text({"run": data.run, "t": 0.05 * data.place, **columns}))
    return data


@pytest.mark.slow
def test_a_file_of_a_gyroscope_gets_its_law_forecasts_and_report(tmp_path, capsys):
    gyroscope(tmp_path / "gyro.csv", 6)
    assert cli.main(["run", str(tmp_path / "gyro.csv"), "--out", str(tmp_path / "r")]) == 0
    shown = capsys.readouterr().out
    assert "verdict: identified" in shown
    assert f"written to {tmp_path}/r/model" in shown
    errors = re.findall(r"error of Gyroscope . ([\d.e-]+), ([\d.e-]+), ([\d.e-]+) rad/s", shown)
    assert np.array(errors, float).shape == (3, 3)
    assert np.array(errors, float).max() < 5e-3
    page = (tmp_path / "r" / "report.html").read_text()
    assert "Three forecasts of what no fit has seen, each from a measured state." in page
    assert "Casimirs: " in page


@pytest.mark.parametrize("count", [1, 2])
def test_few_runs_with_noise_are_told_to_be_too_few(count):
    starts = np.random.default_rng(0).normal(size=(count, 3))
    data = runs_of(top, starts, 0.05, 300, noise=1e-3)
    with pytest.raises(FitError, match="more runs that start at other values") as raised:
        gfnn.fit(pairs_of(data))
    named = "1 run does" if count == 1 else "2 runs do"
    assert raised.value.verdict == f"no law: {named} not determine it"


@pytest.mark.slow
def test_exact_runs_that_are_too_few_to_bound_the_error_say_how_many_more_are_needed():
    starts = np.random.default_rng(0).normal(size=(6, 3))
    with pytest.warns(gfnn.FitWarning, match="too few to bound it") as told:
        fit = gfnn.fit(pairs_of(runs_of(top, starts[:2], 0.2, 20)))
    assert fit.chosen.validation_relative < 1e-12
    assert str(told[-1].message).endswith("add 4 or more such runs")
    assert fit.verdict.endswith(
        "for 2 runs of 20 pairs are too few to bound it: add 4 or more such runs"
    )
    long = gfnn.fit(pairs_of(runs_of(top, starts[:2], 0.2, 80)))  # C and H differ alike
    assert long.verdict.startswith("one of several: H + a Casimir has one value along all runs")
    assert gfnn.fit(pairs_of(runs_of(top, starts, 0.2, 20))).met


@pytest.mark.parametrize(
    ("law", "start", "off"),
    [
        (
            {"log(prey)": 0.8, "log(predator)": 0.9, "prey": -0.02, "predator": -0.03},
            (31.0, 19.5),
            0.1,
        ),
        pytest.param(  # an epidemic
            {"log(prey)": 0.3, "prey": -0.01, "predator": -0.01},
            *((120.0, 6.0), 0.2),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_one_noisy_orbit_of_two_populations(law, start, off):
    """The noise is in proportion to populations that fall to a hundredth."""
    c = [law.get(name, 0.0) for name in ("log(prey)", "log(predator)", "prey", "predator")]

    def rates(z):
        return z * np.array([c[1] + c[3] * z[1], -c[2] * z[0] - c[0]])

    data = runs_of(rates, np.array([start]), 0.25, 200)
    z = np.concatenate([data.z0, data.z1[-1:]])
    z *= np.exp(0.05 * np.random.default_rng(0).normal(size=z.shape))
    about = {"run": data.run, "place": data.place, "structure": "poisson"}
    fit = gfnn.fit(gfnn.Pairs(z[:-1], z[1:], 0.25, **about, names=("prey", "predator")))
    assert fit.bracket.name == "log-canonical"
    found = {t.term: (t.coefficient, t.std) for t in fit.law.terms}
    assert found.keys() == law.keys()
    for name, (value, std) in found.items():
        assert value == pytest.approx(law[name], rel=off)
        assert abs(value - law[name]) < 3 * std


@pytest.mark.slow
@pytest.mark.parametrize("own", [0.002, 0.01])
def test_prey_that_crowd_are_no_law_with_a_bracket(own):
    """A wound-in orbit fits arc by arc, but H drifts from arc to arc."""

    def rates(z):
        return z * np.array([0.9 - 0.03 * z[1] - own * z[0], 0.02 * z[0] - 0.8])

    data = runs_of(rates, np.array([[31.0, 19.5]]), 0.3, 120)
    z = np.concatenate([data.z0, data.z1[-1:]])
    z *= np.exp(0.03 * np.random.default_rng(0).normal(size=z.shape))
    about = {"run": data.run, "place": data.place, "structure": "poisson"}
    with pytest.raises(FitError, match=r"no H of it leaves noise|fewer orbits"):
        gfnn.fit(gfnn.Pairs(z[:-1], z[1:], 0.3, **about))


def swings(amplitudes, sigma, rate=np.sin):
    """Noisy runs of a swing, one of each amplitude."""
    starts = np.array([[a, 0.0] for a in amplitudes])
    law = lambda z: np.array([z[1], -rate(z[0])])  # noqa: E731
    return pairs_of(runs_of(law, starts, 0.1, 300, noise=sigma))


@pytest.mark.parametrize("sigma", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_a_sinusoid_of_one_amplitude_is_of_several_laws(sigma):
    fit = gfnn.fit(swings([1.0, 1.0, 1.0], sigma, rate=lambda x: 1.69 * x))
    assert [t.term for t in fit.law.terms] == ["z1²", "z2²"]
    assert fit.verdict.startswith("one of several: H has one value along all runs")


@pytest.mark.slow
def test_noisy_swings_are_not_taken_for_harmonic_ones():
    fit = gfnn.fit(swings([0.4, 1.0, 1.5], 0.1))
    assert [t.term for t in fit.law.terms] == ["z1²", "z2²", "z1⁴"]
    assert fit.law.terms[2].coefficient == pytest.approx(-1 / 24, rel=0.2)
    assert fit.verdict.startswith("one of several: its terms of degree 3 or more may be the series")


def test_states_without_a_bracket_are_told_what_to_type(tmp_path, capsys):
    starts = np.random.default_rng(0).normal(size=(20, 2))
    data = runs_of(lambda z: np.array([z[1], (1 - z[0] ** 2) * z[1] - z[0]]), starts, 0.2, 20)
    path, columns = tmp_path / "two words.csv", {"x": data.z0[:, 0], "y": data.z0[:, 1]}
    path.write_text(to_text({"run": data.run, "t": 0.2 * data.place, **columns}))
    fit = ["fit", str(path), "--structure", "poisson", "--states", "x,y", "--out", f"{tmp_path}/m"]
    assert cli.main(fit) == 1
    said = capsys.readouterr().err.partition("If these are positions: gfnn ")[2]
    asked = cli_parser.parser().parse_args(shlex.split(said))
    assert (asked.data, asked.positions) == ([path], ("x", "y"))


@needs_cc
def test_a_law_in_c(heavy_top, tmp_path):
    fit, starts = heavy_top
    library = compiled(gfnn.export(fit, "c-taylor", tmp_path / "top.c"))
    images = by_c(library.top_step, starts)[0]
    assert np.abs(images - np.asarray(fit.map.step(starts)[0])).max() < 1e-14
    back, status = by_c(library.top_inverse, images)
    assert np.abs(back - starts).max() < 1e-14
    assert not status.any()


@pytest.mark.slow
@needs_cc
def test_a_driven_spin(tmp_path):
    """The field along y turns with the period 7.5; runs begin at times of their own."""

    def rates(z):  # the time is one more state
        turned = 0.4 * np.cos(2 * np.pi * z[3] / 7.5)
        by = 0.3 + z[0], turned + 0.5 * z[1], 0.2 + 0.2 * z[2]
        return np.append(cross(z, by), 0 * z[:1] + 1.0, axis=0)

    rng = np.random.default_rng(0)
    starts = np.column_stack([rng.normal(size=(30, 3)), rng.uniform(0, 30, 30)])
    data = runs_of(rates, starts, 0.2, 20)
    known = {"t0": data.z0[:, 3], "period": 7.5, "run": data.run, "place": data.place}
    fit = gfnn.fit(gfnn.Pairs(data.z0[:, :3], data.z1[:, :3], 0.2, structure="poisson", **known))
    assert (fit.verdict, fit.bracket.blocks) == ("identified", ("so3",))
    assert fit.formula == "0.3*z1 + 0.4*z2*cos(2*pi*t/7.5) + 0.2*z3 + 0.25*z1**2 - 0.15*z3**2"
    ends, begun = data.z1[19::20, :3], data.z0[::20]
    found = np.asarray(fit.map.rollout(begun[:, :3], 20, t0=begun[:, 3])[0])[:, -1]
    assert np.abs(found - ends).max() < 1e-12
    assert fit.symplecticity_defect < 1e-13
    library = compiled(gfnn.export(fit, "c-taylor", tmp_path / "spin.c"))
    images, _ = by_c_with(library.spin_step, begun[:, :3], begun[:, 3:] % 7.5)
    own = np.asarray(fit.map.step(begun[:, :3], t0=begun[:, 3])[0])
    assert np.abs(images - own).max() < 1e-14


@pytest.mark.slow
def test_tops_whose_moment_differs_from_run_to_run(tmp_path, capsys):
    rng = np.random.default_rng(0)
    starts = np.column_stack([rng.normal(size=(20, 3)), rng.uniform(0.5, 1.5, 20)])
    data = runs_of(
        lambda z: np.append(cross(z, (0.5 * z[0], 0.7 * z[1], z[2] / z[3])), 0 * z[:1], axis=0),
        starts,
        0.2,
        20,
    )
    columns = dict(zip(("L1", "L2", "L3", "inertia"), data.z0.T, strict=True))
    path = tmp_path / "tops.csv"
    path.write_text(to_text({"run": data.run, "t": 0.2 * data.place, **columns}))
    asked = f"fit {path} --structure poisson --states L1,L2,L3 --parameters inertia --out"
    assert cli.main([*asked.split(), str(tmp_path / "m")]) == 0
    fit = gfnn.load(tmp_path / "m")
    assert fit.verdict == "identified"
    assert fit.formula.endswith("/inertia)")
    command = capsys.readouterr().out.split("next: gfnn ")[1].replace("1000", "10")
    assert cli.main(shlex.split(command.replace("prediction.npz", f"{tmp_path}/p.npz"))) == 0
    with np.load(tmp_path / "p.npz") as file:
        ahead = file["trajectories"][0]
    own = {"inertia": starts[0, 3]}
    again = np.asarray(fit.map.rollout(data.z0[19, :3], 10, params=own)[0])
    assert np.abs(again - ahead).max() < 1e-9  # the file has ten digits
    two = np.where(data.run % 2, 1.0, 2.0)
    with pytest.raises(FitError, match=r"has 2 values.*pairs.args\['m'\] == 1\)"):
        gfnn.fit(gfnn.Pairs(data.z0[:, :3], data.z1[:, :3], 0.2, {"m": two}, structure="poisson"))


@pytest.mark.slow
def test_states_that_are_taken_for_canonical_are_told_their_bracket():
    starts = np.random.default_rng(0).uniform(0.5, 1.5, (30, 2))
    data = runs_of(lambda z: z * np.array([1 - z[1], z[0] - 1]), starts, 0.3, 20)
    told = r"another bracket than that of \(q, p\): {z1,z2} = -z1 z2: log-canonical"
    with pytest.warns(gfnn.FitWarning, match=told):
        gfnn.fit(gfnn.Pairs(data.z0, data.z1, 0.3, run=data.run), max_operations=10**9)


@pytest.mark.slow
@pytest.mark.parametrize(("starts", "told"), [((1.0,), True), ((0.6, 1.3), False)])
def test_noisy_states_of_one_energy_tell_no_more_than_f_of_h(starts, told):
    """Of a pendulum, as (q, p), by one swing or by two of different size."""
    rng, t = np.random.default_rng(5), 0.1 * np.arange(401)
    runs = [states_in_motion(lambda q, v: -np.sin(q), [start, 0.0], t).T for start in starts]
    noisy = [run + 1e-2 * rng.normal(size=run.shape) for run in runs]
    pairs = gfnn.Pairs(
        np.concatenate([z[:-1] for z in noisy]),
        np.concatenate([z[1:] for z in noisy]),
        0.1,
        run=np.repeat(np.arange(len(runs)), 400),
        place=np.tile(np.arange(400), len(runs)),
    )
    verdict = gfnn.fit(pairs, tolerance=0.1, learn="hamiltonian").verdict
    assert verdict.startswith("one of several: H has one value") == told, verdict
