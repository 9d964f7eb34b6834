"""`gfnn look`: every mistake is named with what mends it, nothing is said of a clean recording."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from recordings.generated import MISTAKES, sheet

import gfnn_jax as gfnn
from gfnn_jax.cli import main
from gfnn_jax.data.recording_summary import refuse_mistakes, summarise
from gfnn_jax.data.traits import without_wrong_values
from gfnn_jax.errors import InputError


def found(path, **options):
    """(kind, line) of what is said of a file."""
    try:
        recording = gfnn.read(path, **options)
    except InputError as error:
        return [("refused", str(error))]
    return [(fault.kind, str(fault)) for fault in recording.summary().faults]


# These are named, and mended by the command.
MENDED = {"wrong order": 6, "interleaved": 7, "wrong dt": 8, "degrees": 6, "wrong sign": 6}
# The longest to read; quick tests look at the others.
HEAVY = {"interleaved", "wrong order", "degrees", "degrees alone", "drifting clock"}
HEAVY |= {"times run back", "two systems", "interpolated jump"}


def named(names):
    return [pytest.param(name, marks=pytest.mark.slow if name in HEAVY else ()) for name in names]


@pytest.mark.parametrize("name", named(name for name in MISTAKES if name not in MENDED))
def test_each_mistake_is_named(tmp_path, name):
    kinds, make = MISTAKES[name]
    wrong, has_runs = make(11)
    said = found(wrong.written(tmp_path / "r.csv", with_runs=has_runs))
    assert any(kind in kinds or any(k in line for k in kinds) for kind, line in said), said


@pytest.mark.parametrize(
    "seed", [900, *(pytest.param(n, marks=pytest.mark.slow) for n in range(901, 912))]
)
def test_nothing_is_said_of_a_clean_recording(tmp_path, seed):
    assert found(sheet(seed).written(tmp_path / "r.csv")) == []


@pytest.mark.parametrize("name", named(MENDED))
def test_the_command_to_type_mends_it(tmp_path, name):
    kinds, make = MISTAKES[name]
    wrong, has_runs = make(MENDED[name])
    path = wrong.written(tmp_path / "r.csv", with_runs=has_runs)
    summary = gfnn.read(path).summary()
    assert any(fault.wrong for fault in summary.faults)
    assert any(f.kind in kinds or any(k in str(f) for k in kinds) for f in summary.faults)
    typed = summary.command.split(f"{path}", 1)[1].rpartition(" --out")[0]
    options = {}
    for option in typed.split(" --")[1:]:
        key, value = option.split(" ")
        options[key.replace("-", "_")] = value if key == "time-unit" else tuple(value.split(","))
    assert not [fault for fault in gfnn.read(path, **options).summary().faults if fault.wrong]


def clean(t):
    return 0.8 * np.exp(-0.05 * t) * np.cos(4 * t)


def a_swing(path, **changes):
    t = np.arange(0, 8, 0.01)
    rng = np.random.default_rng(3)
    theta = clean(t) + 1e-3 * rng.standard_normal(len(t))
    columns = {"t": t, "theta": theta, **{n: f(t, theta) for n, f in changes.items()}}
    lines = [",".join(columns)]
    lines += [",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_summary_says_what_the_record_is(tmp_path):
    summary = gfnn.read(a_swing(tmp_path / "r.csv")).summary()
    (column,) = summary.columns
    assert column.sigma == pytest.approx(1e-3, rel=0.2)
    assert column.frequencies[0] == pytest.approx(4 / (2 * np.pi), rel=0.02)
    assert summary.period == pytest.approx(np.pi / 2, rel=0.05)
    assert summary.loss.per_period == pytest.approx(0.1 * np.pi / 2, rel=0.05)
    text = str(summary)
    assert "800 samples" in text
    assert "friction takes 16" in text
    assert max(map(len, text.splitlines())) <= 110
    html = summary._repr_html_()
    assert html.startswith("<pre")
    assert "theta" in html


def test_columns_keep_the_unit_of_the_file(tmp_path):
    path = a_swing(tmp_path / "r.csv", alpha=lambda t, x: np.degrees(x))
    options = {"positions": "alpha", "degrees": "alpha"}
    degrees = summarise(gfnn.read(path, **options), options).columns[0]
    radians = gfnn.read(path, positions="theta").summary().columns[0]
    assert degrees.sigma == pytest.approx(np.degrees(radians.sigma), rel=1e-6)
    assert degrees.high == pytest.approx(np.degrees(radians.high), rel=1e-6)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"theta2": lambda t, x: 0 * t + 3}, "constant"),
        ({"theta2": lambda t, x: x}, "repeated"),
        ({"omega": lambda t, x: np.gradient(x, t)}, "difference"),
        ({"omega": lambda t, x: np.cos(17 * t)}, "no derivative"),
        ({"omega": lambda t, x: 0.9 * np.gradient(clean(t - 0.03), t)}, "filtered"),
        ({"omega": lambda t, x: 2.5 * np.gradient(clean(t), t)}, "factor"),
        ({"q2": lambda t, x: np.angle(np.exp(1j * (2 * t + x)))}, "wrapped"),
        ({"theta2": lambda t, x: np.degrees(np.angle(np.exp(1j * (2 * t + x))))}, "degrees"),
        ({"theta2": lambda t, x: np.angle(np.exp(1j * 1.1 * np.pi * t / 0.01))}, "coarse"),
        ({"x": lambda t, x: x + np.where(np.abs(t - 5) < 1e-3, 0.5, 0)}, "outliers"),
    ],
)
def test_columns_that_are_odd_are_named(tmp_path, change, kind):
    path = a_swing(tmp_path / "r.csv", **change)
    assert kind in [k for k, _ in found(path)]


# The command line


def test_look_as_json(tmp_path, capsys):
    path = a_swing(tmp_path / "r.csv", omega=lambda t, x: -3.2 * np.sin(4 * t) * np.exp(-0.05 * t))
    assert main(["look", str(path), "--json", "--std", "theta=0.002", "--mass", "theta=2"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["runs"] == ["0"]
    assert said["dt_median"] == pytest.approx(0.01)
    assert said["gaps"] == []
    theta, omega = said["columns"]["theta"], said["columns"]["omega"]
    assert (theta["role"], theta["angle"], theta["sigma"]) == ("positions", True, 0.002)
    assert (omega["role"], omega["derivative_of"]) == ("velocities", "theta")
    assert said["loss_per_period"] == pytest.approx(0.157, rel=0.1)
    assert said["command"] == f"gfnn fit {path} --std theta=0.002 --mass theta=2 --out model"


def test_look_names_what_sensors_show(tmp_path, capsys):
    t = 0.05 * np.arange(200)
    gate = np.where(t < 3, 0.3 + t * 10, np.nan)
    columns = np.stack([t, np.cos(2 * t), -4 * np.cos(2 * t), np.sin(3 * t), gate], axis=1)
    path = tmp_path / "r.csv"
    np.savetxt(path, columns, "%.6g", ",", header="t,x,a,u,gate", comments="")
    given = ["--positions", "x", "--inputs", "u", "--observe", "a=x_ddot", "--event", "gate=x"]
    assert main(["look", str(path), "--json", *given, "--std", "gate=1e-3"]) == 0
    said = json.loads(capsys.readouterr().out)
    roles = {name: column["role"] for name, column in said["columns"].items()}
    assert roles == {"x": "positions", "u": "inputs", "a": "accelerations", "gate": "events"}
    assert "--event 'gate = x'" in said["command"]
    recording = gfnn.read(path, positions="x", events={"gate": "x"})
    assert recording.observe == {"gate": "crossing(x)"}
    with pytest.raises(InputError, match="not in both"):
        gfnn.read(path, observe={"gate": "crossing(x)"}, events={"gate": "x"})


def test_strict_look_fails_where_something_is_wrong(tmp_path, capsys):
    path = a_swing(tmp_path / "r.csv", omega=lambda t, x: np.cos(17 * t))
    assert main(["look", str(path), "--json"]) == 0
    assert main(["look", str(path), "--json", "--strict"]) == 1
    assert main(["look", str(tmp_path / "none.csv")]) == 2
    assert main(["look", str(path), "--positions", "phi"]) == 2
    assert "no column phi" in capsys.readouterr().err


def test_fit_refuses_what_look_calls_wrong(tmp_path, capsys):
    path = a_swing(tmp_path / "r.csv", omega=lambda t, x: np.cos(17 * t))
    model = str(tmp_path / "model")
    for learn in ("auto", "map"):
        assert main(["fit", str(path), "--out", model, "--learn", learn]) == 2
        line = capsys.readouterr().err.splitlines()[-1]  # a busy machine says that it starts
        assert "omega is not the derivative of theta" in line
        assert "--positions theta" in line
        assert "--despite 'no derivative'" in line
    assert not (tmp_path / "model").exists()
    with pytest.raises(InputError, match=r"despite=: expected some of constant, .* got 'sgin'"):
        refuse_mistakes(gfnn.read(path), ["sgin"])
    assert "wrong (no derivative): omega" in str(gfnn.read(path).summary())
    refuse_mistakes(gfnn.read(path), ["no derivative"])
    refuse_mistakes(gfnn.read(path, positions="theta"))


def test_look_at_states(tmp_path, capsys):
    t = 0.1 * np.arange(100)
    swings = np.stack([np.stack([a * np.cos(t), -a * np.sin(t)], axis=1) for a in (1.0, 2.0)])
    np.savez(tmp_path / "s.npz", trajectories=swings, dt=0.1)
    assert main(["look", str(tmp_path / "s.npz"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["runs"] == ["0", "1"]
    assert said["columns"]["p1"]["role"] == "momenta"
    np.savez(tmp_path / "p.npz", z0=swings[0, :-1], z1=swings[0, 1:], dt=0.1)
    assert main(["look", str(tmp_path / "p.npz"), "--json"]) == 2


@pytest.mark.slow
def test_a_million_rows_in_ten_seconds_and_a_gigabyte(tmp_path):
    t = 1e-3 * np.arange(1_000_000)
    rng = np.random.default_rng(0)
    columns = [t, *(np.sin(w * t) + 1e-3 * rng.standard_normal(len(t)) for w in (5, 6, 7, 8))]
    header = "t,x1,x2,x3,x4"
    np.savetxt(tmp_path / "r.csv", np.stack(columns, 1), "%.7g", ",", header=header, comments="")
    code = f"from gfnn_jax.cli import main; raise SystemExit(main(['look', '{tmp_path}/r.csv']))"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        check=False,
        env={"PYTHONPATH": str(Path(__file__).parent.parent)},
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0
    assert after.ru_utime - before.ru_utime < 10
    assert after.ru_maxrss < 1 << 20  # kB


def two_carts(wrong=True):
    """Three runs of two carts, σ = 0.2 mm; wrong: with spikes, a stuck sensor and a burst."""
    rng, runs = np.random.default_rng(4), []
    for run in range(3):
        t = 0.01 * np.arange(1000)
        one, other = (a * np.exp(-0.05 * t) * np.cos(w * t + run) for a, w in ((0.1, 6), (0.06, 9)))
        left, right = np.round(
            [one + other, one - other] + 2e-4 * rng.standard_normal((2, 1000)), 5
        )
        runs.append({"t": t, "left": left, "right": right})
    if wrong:
        runs[0]["left"][[40, 300, 312, 700, 850]] += 0.05
        runs[1]["right"][403:440] = runs[1]["right"][403]
        runs[2]["left"][500:515] += 0.14 * (-1.0) ** np.arange(15)
    return gfnn.Recording(runs, positions=("left", "right"))


def test_wrong_values_are_told_with_run_and_time_and_left_out_of_the_figures():
    found, clean = two_carts().summary(), two_carts(wrong=False).summary()
    assert clean.faults == ()
    stuck, outliers = found.faults
    assert (stuck.kind, outliers.kind) == ("stuck", "outliers")
    assert all(word in stuck.message for word in ("right", "36 samples", "4.04 s of run 1"))
    assert all(word in outliers.message for word in ("left", "20 outliers", "0.4 s of run 0"))
    assert [(c.outliers, c.stuck) for c in found.columns] == [(20, 0), (0, 36)]
    assert found.period == pytest.approx(clean.period, rel=0.02)
    assert found.loss.per_period == pytest.approx(clean.loss.per_period, rel=0.05)
    assert found.gaps == ()


def test_a_limit_is_told_from_a_body_that_is_held_or_comes_to_rest():
    t = 0.02 * np.arange(400)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((2, len(t)))
    held = np.where(t < 0.5, 1.0, np.cos(3 * (t - 0.5)))  # let go from the same place
    free = {"swing": np.cos(3 * t) + noise, "held": [held] * 2, "rest": [np.exp(-3 * t)] * 2}
    limited = np.clip(free["swing"], -0.7, 0.9)
    at_limit = (limited == -0.7) | (limited == 0.9)
    for name, runs, gone in [(n, x, np.zeros((2, 400), bool)) for n, x in free.items()] + [
        ("limited", limited, at_limit)
    ]:
        runs = [{"t": t, "x": np.round(x, 5)} for x in runs]
        kept, lines = without_wrong_values(gfnn.Recording(runs, positions="x"))
        missing = [np.isnan(kept.values("x", run)) for run in kept.runs]
        np.testing.assert_array_equal(missing, gone, err_msg=name)
        assert lines == () or "x saturates at -0.7 and 0.9: " in lines[0]


def test_wrong_values_are_missing_where_they_are_left_out():
    wrong, clean = two_carts(), two_carts(wrong=False)
    kept, lines = without_wrong_values(wrong)
    assert [line.endswith(": left out") for line in lines] == [True] * 2
    for run, name in ((run, name) for run in wrong.runs for name in ("left", "right")):
        expected = wrong.values(name, run).copy()
        expected[expected != clean.values(name, run)] = np.nan
        np.testing.assert_array_equal(kept.values(name, run), expected)
        assert np.isfinite(wrong.values(name, run)).all()  # which stays as it is
    same, none = without_wrong_values(clean)
    assert none == ()
    np.testing.assert_array_equal(same.values("left", "0"), clean.values("left", "0"))


@pytest.mark.parametrize("angles", [("a",), ()])
@pytest.mark.parametrize(("row", "value"), [(None, 0.0), (200, 0.7), (200, 999.0), (300, 3.6)])
def test_a_wrong_value_of_a_wrapped_angle_does_not_take_its_wraps_along(angles, row, value):
    """Of the measured double pendulum, its first angle wrapped within the record."""
    whole = gfnn.read(gfnn.records.path("double_pendulum"), angles=["theta1", "theta2"])
    a = np.mod(whole.unwrapped("theta1", "0") + 2.0 + np.pi, 2 * np.pi) - np.pi
    assert np.sum(np.abs(np.diff(a)) > 3) >= 4
    if row is not None:
        a[row] += value
    recording = gfnn.Recording({"t": whole.times("0"), "a": a}, positions=["a"], angles=angles)
    kept, lines = without_wrong_values(recording)
    missing = np.flatnonzero(np.isnan(kept.values("a", "0")))
    assert missing.tolist() == ([] if row is None else [row]), lines


@pytest.mark.slow
def test_empty_cells_are_gaps_and_do_not_hide_friction():
    recording, runs = two_carts(wrong=False), []
    rng = np.random.default_rng(0)
    for run in recording.runs:
        kept = np.ones(1000, bool)
        kept[rng.choice(np.arange(5, 990, 5), 15, replace=False)] = False
        kept[600:612] = False
        table = {
            "t": recording.times(run),
            **{n: recording.values(n, run) for n in ("left", "right")},
        }
        runs.append((table, kept))
    positions = ("left", "right")
    empty = [
        {n: x if n == "t" else np.where(k, x, np.nan) for n, x in of.items()} for of, k in runs
    ]
    without = [{n: x[k] for n, x in of.items()} for of, k in runs]
    found, expected = (gfnn.Recording(r, positions=positions).summary() for r in (empty, without))
    assert found.gaps == expected.gaps
    assert len(found.gaps) >= 40
    assert found.loss.per_period == expected.loss.per_period
    assert found.columns[0].sigma == expected.columns[0].sigma
