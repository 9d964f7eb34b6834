"""Recordings: every way in gives the same numbers back, every mistake in a file has its line."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

import gfnn_jax as gfnn
from gfnn_jax.data.files import are_recordings
from gfnn_jax.data.recording import parameters_of
from gfnn_jax.data.roles import symbols
from gfnn_jax.errors import InputError
from gfnn_jax.models.lagrangians.in_words import about_parameters

T = np.array([0.0, 0.1, 0.25, 0.3, 1.0])
THETA = np.array([0.5, 0.25, -0.125, 1e-3, 2.0])
OMEGA = np.array([-1.0, 0.0, 3.5, 1.0, 0.5])


def write(path, text):
    path.write_text(text)
    return path


def rows(*columns, separator=",", decimal="."):
    lines = [
        separator.join(f"{x:.17g}".replace(".", decimal) for x in r)
        for r in zip(*columns, strict=True)
    ]
    return "\n".join(lines) + "\n"


def check(recording):
    assert recording.runs == ("0",)
    assert (recording.positions, recording.velocities) == (("theta",), ("omega",))
    assert recording.angles == ("theta",)
    assert (len(recording), recording.dim) == (5, 1)
    np.testing.assert_allclose(recording.times("0"), T, rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(recording.values("theta", "0"), THETA, rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(recording.values("omega", 0), OMEGA, rtol=1e-14, atol=1e-16)


# Beside those of tests/test_dialects.py.
TEXTS = {
    "tabs, decimal commas": "Time\ttheta\tomega\n"
    + rows(T, THETA, OMEGA, separator="\t", decimal=","),
    "comments": "# a pendulum, \n# of 2009\nt,theta,omega\n" + rows(T, THETA, OMEGA) + "# end\n",
    "a header of savetxt": "# t theta omega\n" + rows(T, THETA, OMEGA, separator=" "),
    "units under a stroke": "t/s,theta / rad,omega/(rad/s)\n" + rows(T, THETA, OMEGA),
    "milliseconds": "t [ms],theta,omega\n" + rows(1e3 * T, THETA, OMEGA),
    "a unit row of ms": "t;theta;omega\n[ms];[rad];[rad/s]\n"
    + rows(1e3 * T, THETA, OMEGA, separator=";"),
    "degrees": "t,theta [deg],omega [deg/s]\n" + rows(T, np.degrees(THETA), np.degrees(OMEGA)),
    "words": "t,theta,omega,note\n" + rows(T, THETA, OMEGA).replace("\n", ",as seen\n"),
    "a separator at the end": "t;theta;omega;\n"
    + rows(T, THETA, OMEGA, separator=";").replace("\n", ";\n"),
    "decimal commas in quotes": '"t","theta","omega"\n'
    + '"'
    + rows(T, THETA, OMEGA, separator='","', decimal=",")[:-1].replace("\n", '"\n"')
    + '"\n',
    "a title": "mass A\nt\ttheta\tomega\n" + rows(T, THETA, OMEGA, separator="\t"),
    "a title as wide": "mass A\t\t\t\nt\ttheta\tomega\t\n" + rows(T, THETA, OMEGA, separator="\t"),
    "names with a run": "Time (s) Run #1,theta (rad) Run #1,omega (rad/s) Run #1\n"
    + rows(T, THETA, OMEGA),
    "the latest run": "Latest: Time (s),Latest: theta (rad),Latest: omega\n"
    + rows(T, THETA, OMEGA),
    "milliseconds by name": "millis,theta,omega\n" + rows(1e3 * T, THETA, OMEGA),
    "another order": "omega,t,theta\n" + rows(OMEGA, T, THETA),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_files_of_every_dialect(tmp_path, name):
    check(gfnn.read(write(tmp_path / "r.csv", TEXTS[name])))


def test_times_of_day(tmp_path):
    text = "time,x\n2024-05-01 23:59:59.5,1\n2024-05-02 00:00:00.25,2\n2024-05-02 00:00:01,3\n"
    recording = gfnn.read(write(tmp_path / "r.csv", text))
    np.testing.assert_allclose(recording.times("0"), [0, 0.75, 1.5], atol=1e-12)
    bad = write(tmp_path / "bad.csv", text + "2024-05-02 00:00:99,4\n")
    with pytest.raises(InputError, match="00:00:99"):
        gfnn.read(bad)


def test_tables_in_memory_and_arrays(tmp_path):
    columns = {"t": T, "theta": THETA, "omega": OMEGA}
    check(gfnn.Recording(columns))
    check(gfnn.Recording(pd.DataFrame(columns)))
    np.savez(tmp_path / "r.npz", **columns)
    check(gfnn.read(tmp_path / "r.npz"))
    np.save(tmp_path / "r.npy", np.column_stack([T, THETA, OMEGA]))
    check(gfnn.read(tmp_path / "r.npy", columns=["t", "theta", "omega"]))
    check(
        gfnn.read(write(tmp_path / "n.csv", rows(T, THETA, OMEGA)), columns=["t", "theta", "omega"])
    )
    check(gfnn.Recording({"theta": np.degrees(THETA), "omega": OMEGA, "t": T}, degrees="theta"))
    check(gfnn.Recording({**columns, "t": T * 1e3}, time_unit="ms"))


def test_runs_of_unequal_length_keep_their_names_and_order(tmp_path):
    text = "Trial,t,x,v\nb,0,1,2\nb,1,3,4\na,0,5,6\nb,2,7,8\n"
    recording = gfnn.read(write(tmp_path / "r.csv", text))
    assert recording.runs == ("b", "a")
    np.testing.assert_array_equal(recording.values("x", "b"), [1, 3, 7])
    np.testing.assert_array_equal(recording.array("velocities", "a"), [[6]])
    assert recording.array("inputs", "a").shape == (1, 0)


def test_times_that_fall_begin_a_run():
    recording = gfnn.Recording({"t": [0, 1, 2, 0, 1], "x": [1.0, 2, 3, 4, 5]})
    assert recording.runs == ("0", "1")
    np.testing.assert_array_equal(recording.values("x", "1"), [4, 5])
    assert recording.notes == ("the times run back once, at row 4, and a run begins there",)
    t = np.concatenate([np.arange(0, 9, 0.1), np.arange(0.3, 8, 0.1), np.arange(0, 3, 0.1)])
    assert gfnn.Recording({"t": t, "x": t}).notes[0].startswith("the times run back 2 times, first")


@pytest.mark.parametrize(
    "moved", [[0, 1, 2, 4, 3, 5, 6, 7, 8], [0, 1, 2, 7, 3, 4, 5, 6, 8], [0, 1, 3, 4, 5, 6, 7, 2, 8]]
)
def test_a_row_out_of_place_is_no_run_and_has_its_line(tmp_path, moved):
    text = "t,x\n" + "".join(f"{t},{t}\n" for t in moved)
    row = int(np.flatnonzero(np.diff(moved) < 0)[0]) + 1
    with pytest.raises(InputError, match=f"line {row + 2}: t = {moved[row]} runs back .* sort"):
        gfnn.read(write(tmp_path / "r.csv", text))


def test_rows_of_two_clocks_that_meet_are_one(tmp_path):
    """Where a column has two values of one time nothing says which: the row has its line."""
    lines = ["t,x,y", "0.0,1,", "0.1,2,", "0.1,,5", "0.2,,6", "0.3,3,"]
    path = tmp_path / "two.csv"
    path.write_text("\n".join(lines))
    recording = gfnn.read(path, positions=["x", "y"])
    assert_array_equal(recording.times("0"), [0, 0.1, 0.2, 0.3])
    assert_array_equal(recording.values("x", "0"), [1, 2, np.nan, 3])
    assert_array_equal(recording.values("y", "0"), [np.nan, 5, 6, np.nan])
    path.write_text("\n".join([*lines, "0.3,4,"]))
    with pytest.raises(InputError, match="line 7"):
        gfnn.read(path, positions=["x", "y"])


def test_several_files_are_runs_and_a_column_may_be_missing(tmp_path):
    one = write(tmp_path / "one.csv", "t,x,v\n0,1,2\n1,3,4\n")
    two = write(tmp_path / "two.csv", "t,x\n0,1\n1,\n")
    recording = gfnn.read([one, two])
    assert recording.runs == ("one", "two")
    np.testing.assert_array_equal(recording.values("v", "two"), [np.nan, np.nan])
    np.testing.assert_array_equal(recording.values("x", "two"), [1, np.nan])


def test_a_run_is_the_one_of_that_very_name_where_another_is_the_same_number():
    recording = gfnn.Recording(
        {"run": ["1.0", "1", "b"], "t": [0.0, 1.0, 2.0], "x": [1.0, 2.0, 3.0]}, positions=["x"]
    )
    assert [recording.times(run).tolist() for run in ("1.0", "1", "b", 1)] == [[0], [1], [2], [1]]
    with pytest.raises(InputError, match="no run c, found"):
        recording.times("c")


def test_slice_takes_both_ends_and_runs_as_numbers_or_text():
    recording = gfnn.Recording({"t": [0, 1, 2, 0, 1], "x": np.arange(5.0), "run": [1, 1, 1, 7, 7]})
    part = recording.slice(1, 2)
    assert part.runs == ("1", "7")
    np.testing.assert_array_equal(part.values("x", 1), [1, 2])
    for name in (7, "7", 7.0, "7.0"):
        assert recording.slice(run=name).runs == ("7",)
    with pytest.raises(InputError, match="no sample from 5"):
        recording.slice(5, 6)
    with pytest.raises(InputError, match="no run 3, found 1, 7"):
        recording.slice(run=3)


def test_roles_that_are_given_leave_the_other_columns_out():
    table = {"t": T, "a": THETA, "b": OMEGA, "x": T}
    recording = gfnn.Recording(table, positions="a", velocities=["b"], std={"a": 0.1})
    assert recording.columns == ("a", "b")
    assert recording.ignored == ("x",)
    assert recording.std == {"a": 0.1, "b": None}
    assert recording.angles == ()


def test_an_input_that_is_given_leaves_the_motion_to_names_and_data():
    columns = {"t": T, "x": THETA, "theta": OMEGA, "drive": T**2, "force": T}
    found = gfnn.Recording(columns, inputs="drive")
    assert (found.positions, found.inputs) == (("x", "theta"), ("drive",))
    columns = {"t": T, "gyro": OMEGA, "x": THETA, "force": T}
    rate = gfnn.Recording(columns, inputs="force", observe={"gyro": "omega + b"})
    assert (rate.positions, rate.sensors, rate.inputs) == ((), ("gyro",), ("force",))


def test_data_tell_roles_that_names_do_not():
    t = 0.01 * np.arange(600)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((4, len(t)))
    motion = np.stack([np.sin(3 * t), 3 * np.cos(3 * t), np.cos(5 * t), -5 * np.sin(5 * t)])
    motion += noise
    table = {"t": t, "b": motion[1], "a": motion[0], "d": motion[2], "e": motion[3]}
    recording = gfnn.Recording(table)
    assert (recording.positions, recording.velocities) == (("a", "d"), ("b", "e"))
    assert "derivatives" in recording.notes[0]
    with pytest.raises(InputError, match="d may be motion or what drives it"):
        gfnn.Recording({name: table[name] for name in "tabd"})


def test_columns_that_differ_from_run_to_run_are_parameters():
    table = {"run": [0, 0, 1, 1], "t": [0, 1, 0, 1], "x": [0.0, 1, 2, 3], "mass": [1.0, 1, 2, 2]}
    recording = gfnn.Recording({**table, "day": [7, 7, 7, 7]})
    assert recording.parameters == ("mass",)
    assert recording.ignored == ("day",)
    assert parameters_of(recording) == ("mass",)
    (told,) = about_parameters(recording, None)
    assert told.startswith("mass is 1 to 2, and no coefficient of the law depends on it")
    assert about_parameters(recording, ((0,), (-1,))) == []
    (told,) = about_parameters(recording, ((0,), (-1,)), 2)
    assert told.startswith("a term has 2 functions of mass, and the runs are of 2 values")
    assert about_parameters(recording.slice(run="0"), None) == []


def test_a_parameter_is_one_number_of_each_run():
    table = {"run": [0, 0, 1, 1], "t": [0, 1, 0, 1], "x": [0.0, 1, 2, 3], "m": [1.0, 1, 2, 3]}
    recording = gfnn.Recording(table, positions=["x"], parameters=["m"])
    with pytest.raises(InputError, match="parameter m is not one number in run 1"):
        parameters_of(recording)


def test_an_angle_is_lifted_and_a_lift_is_trusted():
    lift = np.linspace(0, 20, 60)
    wrapped = np.angle(np.exp(1j * lift))
    for values in (wrapped, np.mod(lift, 2 * np.pi)):
        found = gfnn.Recording({"t": lift, "theta": values}).unwrapped("theta", 0)
        np.testing.assert_allclose(found - found[0], lift, atol=1e-12)
    steps = np.array([0.0, 5.0, 0.5, 9.0])  # more than half a turn at a time: as it is given
    trusted = gfnn.Recording({"t": np.arange(4), "theta": steps}).unwrapped("theta", 0)
    np.testing.assert_array_equal(trusted, steps)
    wrapped[5] = np.nan
    found = gfnn.Recording({"t": lift, "theta": wrapped}).unwrapped("theta", 0)
    np.testing.assert_allclose(np.delete(found, 5), np.delete(lift, 5), atol=1e-12)
    assert np.isnan(found[5])


def test_noise_and_units_follow_the_columns():
    table = {"t": T, "theta": np.degrees(THETA), "omega": OMEGA}
    recording = gfnn.Recording(table, degrees="theta", std={"theta": 0.5})
    assert recording.std["theta"] == pytest.approx(np.radians(0.5))
    assert recording.factors == {"theta": np.pi / 180, "omega": 1.0}


def test_units_stand_in_names_too(tmp_path):
    text = "time_ms,angle_deg\n" + rows(1e3 * T, np.degrees(THETA))
    recording = gfnn.read(write(tmp_path / "r.csv", text))
    assert (recording.positions, recording.angles) == (("angle_deg",), ("angle_deg",))
    np.testing.assert_allclose(recording.values("angle_deg", 0), THETA, rtol=1e-12)
    assert recording.unit("angle_deg") == "deg"


@pytest.mark.parametrize(
    ("names", "units"),
    [
        ("x1_mm,x2_mm,v1_mm_s,v2_mm_s,force_N", "mm,mm,mm/s,mm/s,N"),
        ("theta_rad,theta_dot_rad_per_s,u_V", "rad,rad/s,V"),
        ("theta,omega,tau", "rad,rad/s,"),  # an angle's name, no unit of the torque
        ("x,v", ","),
    ],
)
def test_every_column_has_its_unit(names, units):
    names, t = names.split(","), 0.01 * np.arange(300)
    half = len(names) // 2
    positions = [np.sin(3 * t), np.cos(2 * t)][:half]
    velocities = [3 * np.cos(3 * t), -2 * np.sin(2 * t)][:half]
    columns = [*positions, *velocities, np.sign(np.sin(5 * t))]
    recording = gfnn.Recording({"t": t} | dict(zip(names, columns, strict=False)))
    assert recording.positions == tuple(names[:half])
    assert recording.velocities == tuple(names[half : 2 * half])
    assert recording.inputs == tuple(names[2 * half :])
    assert [recording.unit(name) for name in names] == units.split(",")


def test_a_shaft_in_turns_is_an_angle_and_what_moves_it_an_input(tmp_path):
    t = np.linspace(0, 9, 300)
    turns = 0.3 * np.sin(2 * t)
    text = "t,Motor Voltage [V],shaft_turns,thrust_N\n" + rows(
        t, np.round(np.sin(t)), turns, np.cos(t)
    )
    recording = gfnn.read(write(tmp_path / "shaft.csv", text))
    assert recording.angles == ("shaft_turns",)
    assert set(recording.inputs) == {"Motor Voltage", "thrust_N"}
    np.testing.assert_allclose(recording.values("shaft_turns", 0), 2 * np.pi * turns, rtol=1e-12)


def test_names_as_they_can_stand_in_a_formula():
    names = ("θ₁", "Angle 1", "lambda", "x", "2nd", "a b", "a_b")
    assert symbols(names) == ("theta1", "Angle_1", "lambda_", "x", "q_2nd", "a_b", "a_b_7")


REFUSED = {
    "t,x\n0,1\n0,2\n": "line 3: t = 0",
    "run,t,x\n0,0,1\n# gap\n0,2,2\n0,1,2\n": "line 5: t = 1",
    "t,x,v\n0,1,2\n1,2,3,4\n2,3,4\n": "line 3: 3 columns expected",
    "t,x,x\n0,1,2\n1,2,3\n": " x ",
    "t,x\n,1\n1,2\n": "line 2: t",
    "t,x\n0,inf\n1,2\n": "line 2, x",
    "t,x\n0,00,1,5\n0,10,1,6\n": "decimal commas",
    "t,x,v1,v2\n0,1,2,3\n1,2,3,4\n": "v1, v2 .* x",
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_file_that_cannot_be_used_has_its_line(tmp_path, text):
    path = write(tmp_path / "bad.csv", text)
    with pytest.raises(InputError, match=REFUSED[text]) as found:
        gfnn.read(path)
    assert str(path) in str(found.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"positions": "y"}, "no column y"),
        ({"positions": "x", "velocities": "x"}, "x twice"),
        ({"std": {"x": -1.0}}, "0 or above"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        gfnn.Recording({"t": T, "x": THETA, "v": OMEGA}, **options)


def test_states_q_p_are_no_recording(tmp_path):
    states = write(tmp_path / "s.csv", "# a comment\nt,q1,p1 [kg m/s]\n0,1,2\n")
    swing = write(tmp_path / "r.csv", "t,q1,q1_dot\n0,1,2\n")
    np.savez(tmp_path / "pairs.npz", z0=np.ones((2, 2)), z1=np.ones((2, 2)), dt=0.1)
    np.savez(tmp_path / "r.npz", t=T, x=THETA)
    np.save(tmp_path / "s.npy", np.ones((3, 2)))
    assert not are_recordings(states)
    assert not are_recordings([tmp_path / "pairs.npz", tmp_path / "s.npy"])
    assert are_recordings([swing, tmp_path / "r.npz"])
    assert are_recordings(states, with_roles=True)
    with pytest.raises(InputError, match="files of one kind"):
        are_recordings([states, swing])


def test_rows_by_time_and_every_so_many(tmp_path):
    path = write(tmp_path / "r.csv", "t,x\n" + rows(np.arange(10), np.arange(10)))
    recording = gfnn.read(path, start=2, stop=8, every=2)
    np.testing.assert_array_equal(recording.values("x", 0), [2, 4, 6, 8])


def test_a_sensor_that_another_name_explains_names_no_velocity():
    t = np.arange(0, 5, 0.1)
    table = {"t": t, "theta": np.cos(t), "gyro": 0.1 - np.sin(t)}
    given = gfnn.Recording(table, observe={"gyro": "omega + b"}, guess={"b": 0})
    assert (given.velocities, given.sensors) == ((), ("gyro",))
    own = gfnn.Recording(table, observe={"gyro": "gyro + b"}, guess={"b": 0})
    assert (own.velocities, own.sensors) == (("gyro",), ())
    other = gfnn.Recording(table, observe={"gyro": "omegas + b"}, guess={"b": 0})
    assert other.coordinates == ("thetas",)
    assert any("theta: not used" in note for note in other.notes)
