"""The command line: exit statuses, one line per refusal, nothing harmed, reports."""

import json
import shlex

import jax
import numpy as np
import pytest
from analytic import kepler
from command_line import DT, files, fitted_oscillator, gfnn, oscillator, oscillators_map, pairs_file

from gfnn_jax import cli, cli_summary, scenes
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.errors import FitError
from gfnn_jax.jobs import output
from gfnn_jax.maps import saved as models


def kepler_orbits(num, times, seed=0):
    """(num, len(times), 4) on exact orbits of the two-body scene's law."""
    rng = np.random.default_rng(seed)
    a, e = rng.uniform(0.8, 1.2, num), rng.uniform(0, 0.05, num)
    phase, turn = rng.uniform(0, 2 * np.pi, (2, num))
    return np.stack([kepler(a, e, phase + a**-1.5 * t, turn) for t in times], axis=1)


def recording_file(path):
    lines = ["t,theta", *(f"{t:.2f},{np.cos(t):.6f}" for t in np.arange(0, 9, 0.1))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return oscillators_map(tmp_path_factory.mktemp("models") / "m")


@pytest.fixture(scope="module")
def fitted():
    return fitted_oscillator()


# Usage


def test_scenes(capsys):
    assert gfnn("scenes") == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["two-body", "dim", "2", "dt", "0.1"] in [line[:5] for line in lines]
    assert [line[0] for line in lines] == list(scenes.names())


# What is typed, and what the refusal names.
BAD_USAGE = [
    ("", "gfnn double_pendulum"),
    ("run", "FILE|NAME"),
    ("run two-bdy", "Did you mean two-body?"),
    ("lok pendulum", "Did you mean look?"),
    ("look pendulum --degres theta", "Did you mean --degrees?"),
    ("nowhere.csv", "nowhere.csv: no such file"),
    ("run two-body --dt 0", "--dt"),
    ("run standard-map-regular --dt 0.5", "standard-map-regular"),
    ("run standard-map-regular --learn hamiltonian", "map"),
    ("run two-body --seed -1", "--seed"),
    ("run two-body --out {file}", "{file}"),
    ("run two-body --out {folder}", "--overwrite"),
    ("run two-body --out {folder} --overwrite", "{folder}"),
    ("fit {data}", "--out"),
    ("fit {file} --out {new}", "{file}"),
    ("fit {data} --out {folder}", "{folder}"),
    ("fit {data} --out {new} --dt 0.2", "--dt"),
    ("fit {nodt} --out {new}", "--dt"),
    ("fit {nan} --out {new}", "z1[3, 0]"),
    ("fit {few} --out {new}", "{few}"),
    ("fit {sixteen} --out {new}", "got 7"),
    ("fit {odd} --out {new}", "{odd}"),
    ("fit {data} --out {new} --scene two-body", "dim 2"),
    ("fit {data} --out {new} --angles 5", "(5,)"),
    ("fit {data} --out {new} --terms p1**", "p1"),
    ("fit {data} --out {new} --max-seconds 0", "--max-seconds"),
    ("fit {data} --out {new} --tolerance 1 --absolute-tolerance 1", "--absolute-tolerance"),
    ("fit {data} --out {new} --devices 10000", "--devices: expected 1 to 1 devices"),
    ("fit {swing} --out {new} --tolerance 1e-3 --strict", "--tolerance, --strict"),
    ("predict {model}", "--initial, --out"),
    ("predict {model} {to} --initial {tmp}/none.npy", "none.npy"),
    ("predict {model} {to} --initial {wide}", "{wide}"),
    ("predict {model} {to} --num-steps 0", "--num-steps"),
    (f"predict {{model}} {{to}} --num-steps 1{20 * '0'}", "--num-steps"),
    ("predict {model} {to} --save-every 99", "--save-every"),
    ("predict {model} {to} --devices 10000", "--devices: expected 1 to 1 devices"),
    ("predict {model} {to} --out {data}", "{data}"),
    ("predict {model} {to} --inputs {data} --estimate-from 3", "--estimate-from, --inputs"),
]


@pytest.mark.parametrize(("typed", "named"), BAD_USAGE)
def test_refusals(typed, named, tmp_path, model, capsys, monkeypatch):
    """Exit status 2, one line that names what is wrong, nothing written."""
    monkeypatch.chdir(tmp_path)
    z = oscillator(200, [0, DT])
    broken = z.copy()
    broken[3, 1, 0] = np.nan
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    (tmp_path / "file.txt").write_text("mine")
    (tmp_path / "empty.npz").touch()
    np.save(tmp_path / "wide.npy", np.zeros((3, 4)))
    np.savez(tmp_path / "nodt.npz", z0=z[:, 0], z1=z[:, 1])
    np.save(tmp_path / "z0.npy", np.zeros((3, 2)))
    places = {
        "to": f"--initial {tmp_path / 'z0.npy'} --num-steps 10 --out {tmp_path / 'new.npz'}",
        "tmp": tmp_path,
        "new": tmp_path / "new",
        "folder": tmp_path / "folder",
        "model": model,
        "file": tmp_path / "file.txt",
        "empty": tmp_path / "empty.npz",
        "wide": tmp_path / "wide.npy",
        "nodt": tmp_path / "nodt.npz",
        "data": pairs_file(tmp_path / "data.npz"),
        "nan": pairs_file(tmp_path / "nan.npz", broken),
        "few": pairs_file(tmp_path / "few.npz", z[:2]),
        "sixteen": pairs_file(tmp_path / "sixteen.npz", z[:7]),
        "odd": pairs_file(tmp_path / "odd.npz", np.ones((9, 2, 3))),
        "swing": recording_file(tmp_path / "swing.csv"),
    }
    before = files(tmp_path)
    assert gfnn(*shlex.split(typed.format(**places))) == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if not line.startswith("[")]
    assert len(lines) == 1
    assert lines[0].startswith("gfnn: ")
    assert named.format(**places) in lines[0]
    assert files(tmp_path) == before


# Fit and predict


REPORT_KEYS = {
    "": "scene dt seed dtype device versions data model fit map hamiltonian rollout candidates",
    "data": "num_pairs",
    "model": "learns family chart num_parameters label",
    "fit": "seconds total_seconds compile_seconds train_rms validation_rms validation_relative "
    "tolerance tolerance_met ended operations max_operations",
    "map": "symplecticity_defect chart_determinant_min newton_iterations_max",
    "rollout": "num_trajectories num_excluded num_steps seconds microseconds_per_step "
    "status_counts error error_median growth_exponent energy_drift",
}
CANDIDATE_KEYS = (
    "learns family chart num_parameters validation_rms validation_relative microseconds_per_step "
    "fit_seconds chosen"
)


def read_report(folder):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    report = json.loads((folder / "report.json").read_text(), parse_constant=refuse)
    for part, keys in REPORT_KEYS.items():
        found = report[part] if part else report
        assert (part == "rollout" and found is None) or {*keys.split()} <= set(found)
    assert all(set(candidate) >= {*CANDIDATE_KEYS.split()} for candidate in report["candidates"])
    assert [c["chosen"] for c in report["candidates"]].count(True) == 1
    law = report["hamiltonian"]
    keys = {"formula", "terms", "friction", "dropped", "search_cut_short"}
    assert law is None or keys <= set(law)
    assert report["fit"]["ended"]
    return report


def csv_file(path, sequences, header):
    """Plain Python: sequences (M, L, 2d), every bit of every number."""
    rows = [
        ",".join(map(repr, (i, DT * n, *z)))
        for i, sequence in enumerate(sequences.tolist())
        for n, z in enumerate(sequence)
    ]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "num_pairs", "tolerance", "num_steps"),
    [("npz", 400, 3e-2, 100), ("csv", 6_000, 1e-5, 1_000)],
)
def test_pairs_from_plain_numpy(suffix, num_pairs, tolerance, num_steps, tmp_path, capsys):
    """Kepler orbits that know nothing of the package: fit, then predict, as good as promised."""
    data, orbits = tmp_path / f"d.{suffix}", kepler_orbits(num_pairs, [0, DT])
    if suffix == "npz":
        pairs_file(data, orbits)
    else:
        csv_file(data, orbits, "sequence,t,q1 [m],q2,p1,p2")
    assert gfnn("fit", data, "--out", tmp_path / "m", "--tolerance", tolerance) == 0
    told = capsys.readouterr()
    assert "midpoint" in told.out
    report = read_report(tmp_path / "m")
    lines = [line for line in told.err.splitlines() if "error" in line]
    assert len(lines) >= len(report["candidates"])
    assert report["rollout"] is None
    assert report["scene"] is None
    assert report["data"]["num_pairs"] == num_pairs
    assert suffix == "npz" or report["data"]["units"] == {"q1": "m"}
    assert report["fit"]["validation_relative"] <= tolerance
    assert report["fit"]["tolerance_met"]
    assert report["map"]["symplecticity_defect"] <= 1e-12

    orbits = kepler_orbits(20, DT * np.arange(num_steps + 1), seed=1)
    np.save(tmp_path / "z0.npy", orbits[:, 0])
    steps = ("--num-steps", num_steps, "--save-every", 5, "--out", tmp_path / "p.npz")
    assert gfnn("predict", tmp_path / "m", "--initial", tmp_path / "z0.npy", *steps) == 0
    with np.load(tmp_path / "p.npz") as predicted:
        assert predicted["dt"] == pytest.approx(DT, rel=1e-13)  # of text: the mean of many steps
        np.testing.assert_array_equal(predicted["steps"], np.arange(0, num_steps + 1, 5))
        np.testing.assert_array_equal(predicted["status"], np.zeros(20))
        trajectories = predicted["trajectories"]
    np.testing.assert_array_equal(trajectories[:, 0], orbits[:, 0])
    error = np.sqrt(np.mean((trajectories - orbits[:, ::5]) ** 2, axis=(0, 2)))
    assert (error <= 3 * tolerance * np.maximum(1, np.arange(0, num_steps + 1, 5))).all()


@pytest.mark.slow
def test_a_model_is_kept_and_known_again(fitted, tmp_path, capsys, monkeypatch):
    """An existing model is refused, replaced on demand, and the very job known again."""
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: fitted)
    fit = ("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m")
    assert gfnn(*fit) == 0
    before = files(tmp_path)
    assert gfnn(*fit) == 2
    capsys.readouterr()
    assert gfnn(*fit, "--resume") == 0
    assert "already holds the result of this job" in capsys.readouterr().out
    assert gfnn(*fit, "--resume", "--seed", 1) == 2
    assert files(tmp_path) == before
    assert gfnn(*fit, "--overwrite", "--seed", 1) == 0
    assert gfnn(*fit, "--resume", "--seed", 1) == 0


def test_data_inside_the_output_are_not_deleted(fitted, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: fitted)
    model = tmp_path / "m"
    assert gfnn("fit", pairs_file(tmp_path / "d.npz"), "--out", model) == 0
    inside = pairs_file(model / "d.npz")
    before = files(tmp_path)
    assert gfnn("fit", inside, "--out", model, "--overwrite") == 2
    assert "holds d.npz, which is no part of a model or a run" in capsys.readouterr().err
    assert files(tmp_path) == before


def test_strict(fitted, tmp_path, capsys, monkeypatch):
    """A missed tolerance: the map is written, and the exit status says so where asked for."""
    missed = fitted.replaced(asked=Tolerance(1e-300))
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: missed)
    fit = ("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m")
    assert gfnn(*fit, "--strict") == 1
    assert "misses the tolerance" in capsys.readouterr().err.splitlines()[-1]
    assert not read_report(tmp_path / "m")["fit"]["tolerance_met"]
    assert gfnn(*fit, "--overwrite") == 0


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (FitError("no law follows it"), 2, "gfnn: no law follows it"),
        (np.linalg.LinAlgError("Singular matrix"), 1, "gfnn: the fit failed: Singular matrix"),
    ],
)
def test_a_recording_without_a_law_is_one_line(error, status, line, tmp_path, capsys, monkeypatch):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(output, "fit", fail)
    data = recording_file(tmp_path / "swing.csv")
    assert gfnn("fit", data, "--out", tmp_path / "m") == status
    assert capsys.readouterr().err.splitlines()[-1] == line


# Runs


def check_run(folder, scene):
    report = read_report(folder)
    assert report["scene"] == scene
    rollout = report["rollout"]
    assert rollout["num_steps"] == 1_000
    assert sum(rollout["status_counts"].values()) == rollout["num_trajectories"]
    assert set(rollout["error"]) == set(rollout["error_median"]) == {"1", "10", "100", "1000"}
    assert report["map"]["symplecticity_defect"] <= 1e-12
    assert models.load(folder / "model").dt == report["dt"]
    assert {"error.png", "portrait.png", "candidates.png"} <= {p.name for p in folder.glob("*.png")}
    return report


@pytest.mark.slow
def test_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = "standard-map-regular"
    assert gfnn("run", scene, "--quick", "--tolerance", 1e-3, "--chart", "type2") == 0
    report = check_run(tmp_path / "runs" / scene, scene)
    assert report["model"]["chart"] == "type2"
    assert report["rollout"]["energy_drift"] is None
    assert report["rollout"]["error"]["1000"] < 1
    assert "mean position error" in capsys.readouterr().out
    before = files(tmp_path)
    assert gfnn("run", scene) == 2
    assert files(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "error"),
    [
        ("two-body", 1e-7),
        ("henon-heiles-regular", 1e-11),
        ("henon-heiles-chaotic", None),
        ("henon-heiles-printed", 1e-11),
        ("pcr3bp", None),
        ("standard-map-regular", 1e-8),
        ("standard-map-chaotic", None),
        ("driven-pendulum", None),
        ("henon-heiles-section", None),
    ],
)
def test_run_of_every_scene(scene, error, tmp_path):
    accuracy = ("--tolerance", 1e-10) if error is not None else ()
    assert gfnn("run", scene, "--quick", *accuracy, "--out", tmp_path / "r") == 0
    report = check_run(tmp_path / "r", scene)
    if error is not None:
        assert report["rollout"]["error"]["1000"] <= error
        exponent = report["rollout"]["growth_exponent"]
        exact = scene != "two-body"  # H itself, or the kick: nothing but roundoff
        assert exponent is None if exact else 0.8 <= exponent <= 1.2


@pytest.mark.slow
def test_run_of_a_network(tmp_path):
    assert gfnn("run", "two-body", "--quick", "--family", "mlp", "--out", tmp_path / "r") == 0
    report = check_run(tmp_path / "r", "two-body")
    assert report["model"]["family"] == "mlp"
    assert report["rollout"]["error"]["1000"] <= 0.15


def test_compiled_programs_are_kept_in_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    of_the_tests = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        cli.set_up_jax()
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "gfnn_jax")
    finally:
        jax.config.update("jax_compilation_cache_dir", of_the_tests)


@pytest.mark.parametrize(
    ("met", "noise", "terms", "is_law"),
    [(True, None, 30, True), (False, [1e-3], 2, True), (False, [1e-3], 30, False)],
)
def test_a_law_that_has_met_nothing_is_not_printed_as_h(met, noise, terms, is_law):
    report = {
        "fit": {"tolerance_met": met, "validation_relative": 0.02},
        "hamiltonian": {"formula": "q1²", "terms": [{}] * terms},
        "model": {"learns": "hamiltonian"},
        "data": {"noise": noise},
    }
    assert ("H = q1²" in cli_summary.law_line(report)) == is_law
