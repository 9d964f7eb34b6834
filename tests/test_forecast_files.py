"""Files that a forecast goes on from: their units beside those of the law's, and inputs ahead."""

import contextlib
import io

import numpy as np
import pytest
from analytic import states_in_motion
from scipy.linalg import expm

from gfnn_jax.cli import main
from gfnn_jax.errors import InputError
from gfnn_jax.jobs.output import read_in_units, refuse_other_units

DT, SEEN, AHEAD = 0.05, 240, 60


@pytest.fixture(scope="module")
def motion():
    """t in s, x in mm, u in V of ẍ = −9 x − 0.4 ẋ + 600 u, u held."""
    rng, n = np.random.default_rng(0), SEEN + AHEAD
    u, x = np.round(np.repeat(rng.normal(size=n // 10), 10), 2), np.zeros((n + 1, 2))
    step = expm(np.array([[0, 1, 0], [-9, -0.4, 600], [0, 0, 0]]) * DT)
    x[0] = 50, 0
    for k, one in enumerate(u):
        x[k + 1] = (step @ np.append(x[k], one))[:2]
    return DT * np.arange(n), x[:-1, 0] + 0.02 * rng.normal(size=n), u


@pytest.fixture(scope="module")
def folder(motion, tmp_path_factory):
    """Files of the motion, and the model of the first, in ms, mm and V."""
    t, x, u = motion
    folder = tmp_path_factory.mktemp("files")

    def write(name, header, *columns, rows=slice(None)):
        lines = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
        (folder / name).write_text("\n".join([header, *lines[rows]]) + "\n", encoding="utf-8")

    past, ahead = slice(SEEN), slice(SEEN, None)
    write("ms.csv", "t [ms],x [mm],u [V]", 1e3 * t, x, u, rows=past)
    write("s.csv", "t [s],x [mm],u [V]", t, x, u, rows=past)
    write("bare.csv", "t,x,u", 1e3 * t, x, u, rows=past)
    write("metres.csv", "t [ms],x [m],u [V]", 1e3 * t, 1e-3 * x, u, rows=past)
    write("u_ms.csv", "t [ms],u [V]", 1e3 * t, u, rows=ahead)
    write("u_s.csv", "t [s],u [V]", t, u, rows=ahead)
    write("u_mV.csv", "t [s],u [mV]", t, 1e3 * u, rows=ahead)
    write("u_short.csv", "t [s],u [V]", t, u, rows=slice(SEEN, SEEN + 30))
    write("u_later.csv", "t [s],u [V]", t, u, rows=slice(SEEN + 20, None))
    write("u_before.csv", "t [s],u [V]", t, u, rows=slice(40))
    fit = ["fit", str(folder / "ms.csv"), "--out", str(folder / "model"), "--input-hold", "hold"]
    fit += ["--friction", "linear"]
    with contextlib.redirect_stderr(io.StringIO()):
        assert main(fit) == 0
    return folder


def typed(line):
    """The exit status of a command; no name in it has a blank."""
    return main(line.split())


def predicted(folder, initial, inputs, capsys, steps=AHEAD):
    """(exit status, rows of the forecast or None, what stood on standard error)."""
    out = folder / "f.csv"
    out.unlink(missing_ok=True)
    to = f"--inputs {folder / inputs} --num-steps {steps} --out {out}"
    status = typed(f"predict {folder / 'model'} --initial {folder / initial} {to}")
    rows = np.genfromtxt(out, delimiter=",", names=True) if out.exists() else None
    return status, rows, capsys.readouterr().err


@pytest.mark.parametrize(
    ("initial", "inputs", "unit"),
    [
        ("ms.csv", "u_ms.csv", 1e3),
        ("ms.csv", "u_s.csv", 1e3),
        ("bare.csv", "u_s.csv", 1e3),
        ("s.csv", "u_ms.csv", 1.0),
    ],
)
def test_times_are_in_the_unit_of_each_files_header(motion, folder, initial, inputs, unit, capsys):
    """A file that names none is in the unit of the law's recording; times are written in that of
    the recording that is gone on from."""
    t, x, _ = motion
    status, rows, _ = predicted(folder, initial, inputs, capsys, AHEAD - 1)
    assert status == 0
    np.testing.assert_allclose(rows["t"], unit * t[SEEN:-1], rtol=1e-9)
    assert np.abs(rows["x"] - x[SEEN:-1]).max() < 0.5


@pytest.mark.parametrize(
    ("initial", "inputs", "told"),
    [
        ("metres.csv", "u_s.csv", "x in mm"),
        ("ms.csv", "u_short.csv", "from 13.45 to 14.95 s"),
        ("ms.csv", "u_before.csv", "from 11.95 to 14.95 s"),
    ],
)
def test_other_units_and_inputs_that_end_early_are_refused(folder, initial, inputs, told, capsys):
    status, rows, errors = predicted(folder, initial, inputs, capsys)
    assert status == 2
    assert rows is None
    assert told in errors


@pytest.mark.parametrize("plan", ["coarse", "with a gap"])
def test_inputs_ahead_may_be_coarse_or_lack_values(motion, folder, plan, capsys):
    """They are held here for ten samples each; a value that is missing is that before it."""
    t, x, u = motion
    columns = zip(t[SEEN:], u[SEEN:], strict=True)
    lines = [f"{a:.9g},{b:.9g}" for a, b in columns]
    if plan == "coarse":
        lines = [*lines[::10], lines[-1]]
    else:
        lines[14] = lines[14].split(",")[0] + ","
    (folder / "plan.csv").write_text("\n".join(["t [s],u [V]", *lines]) + "\n", encoding="utf-8")
    status, rows, _ = predicted(folder, "ms.csv", "plan.csv", capsys, AHEAD - 1)
    assert status == 0
    assert np.abs(rows["x"] - x[SEEN:-1]).max() < 0.5


def test_a_comparison_may_be_in_another_unit_of_time(folder, capsys):
    out = folder / "c.csv"
    to = f"--to 10 --compare {folder / 'ms.csv'} --out {out}"
    assert typed(f"predict {folder / 'model'} --initial {folder / 's.csv'} {to}") == 0
    told = capsys.readouterr().out
    assert "up to t = 11.95 s" in told
    rms = float(told.split("x: RMS error ")[1].split(" mm")[0])
    assert rms < 0.1


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """Files of a damped swing in degrees and in radians, and models of the first part of each."""
    rng, folder = np.random.default_rng(1), tmp_path_factory.mktemp("swings")
    t = DT * np.arange(SEEN)
    swing, _ = states_in_motion(lambda q, v: -9 * np.sin(q) - 0.1 * v, [0.8, 0], t)
    theta = swing + 1e-4 * rng.normal(size=SEEN)
    for unit, factor in (("deg", 180 / np.pi), ("rad", 1.0)):
        about = {"delimiter": ",", "header": f"t [s],theta [{unit}]", "comments": ""}
        np.savetxt(folder / f"{unit}.csv", np.stack([t, factor * theta], axis=1), **about)
    return folder


def fitted(folder, unit):
    """The model of the first 9 s of the swing in this unit, fitted when first asked for."""
    model = folder / f"model-{unit}"
    if not model.exists():
        to = f"--to 9 --friction linear --out {model}"
        with contextlib.redirect_stderr(io.StringIO()):
            assert typed(f"fit {folder}/{unit}.csv {to}") == 0
    return model


@pytest.mark.slow
@pytest.mark.parametrize("model", ["deg", "rad"])
@pytest.mark.parametrize(("initial", "compare"), [("deg", "rad"), ("rad", "deg")])
def test_degrees_and_radians_go_together(swings, model, initial, compare, capsys):
    """What is compared is in the unit of the file that is compared with."""
    to = f"--to 9 --compare {swings}/{compare}.csv --out {swings}/f.csv --overwrite"
    assert typed(f"predict {fitted(swings, model)} --initial {swings}/{initial}.csv {to}") == 0
    told = capsys.readouterr().out
    rms, unit = told.split("theta: RMS error ")[1].split(",")[0].split(" ")
    assert unit == compare
    assert float(rms) < 5e-3 * (180 / np.pi if compare == "deg" else 1)


@pytest.mark.parametrize(
    ("header", "roles", "known"),
    [
        ("theta [mrad]", {"positions": "theta"}, {"theta": "deg"}),
        ("x [m],v [mm/s]", {"positions": "x", "velocities": "v"}, {"x": "m", "v": "m/s"}),
    ],
)
def test_a_column_in_another_unit_is_refused(header, roles, known, tmp_path):
    rows = np.arange(12.0 * (2 + header.count(","))).reshape(12, -1) / 10
    path = tmp_path / "other.csv"
    np.savetxt(path, rows, "%.3f", ",", header=f"t [s],{header}", comments="")
    name, unit = header.split(",")[-1].strip("]").split(" [")
    with pytest.raises(InputError, match=f"expected {name} in {known[name]}, .* got {unit}"):
        refuse_other_units(read_in_units(path, {}, roles), {"units": known})


def test_a_header_that_is_silent_is_read_in_the_units_of_the_model(tmp_path):
    (tmp_path / "bare.csv").write_text("t,theta\n0,0\n100,90\n200,180\n", encoding="utf-8")
    (tmp_path / "rad.csv").write_text("t [s],theta [rad]\n0,0\n0.1,1\n0.2,2\n", encoding="utf-8")
    job = {"degrees": ["theta"], "time_unit": "ms", "units": {"theta": "deg"}}
    bare, rad = (
        read_in_units(tmp_path / name, job, {"positions": ("theta",)})
        for name in ("bare.csv", "rad.csv")
    )
    np.testing.assert_allclose(bare.array("positions", "0")[:, 0], [0, np.pi / 2, np.pi])
    np.testing.assert_allclose(rad.array("positions", "0")[:, 0], [0, 1, 2])
    np.testing.assert_allclose(bare.times("0"), rad.times("0"))
