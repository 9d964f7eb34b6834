"""Arms: inertias, friction and possible bodies from a log of known kinematics."""

import ast
import importlib.util
import re
from typing import Any

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.families.rigid_bodies import EARTH, Bodies, inertial, pseudo_inertias
from gfnn_jax.models.arms.kinematics import from_axes, from_dh

AXES = [((0, 0, 1), (0, 0, 0.1)), ((0, 1, 0), (0, 0, 0.4)), ((0, 1, 0), (0.5, 0, 0.4))]
LINKS = np.array(
    [
        inertial(4.0, (0.0, 0.01, 0.15), np.diag([0.05, 0.05, 0.02])),
        inertial(3.0, (0.22, 0.02, 0.0), np.diag([0.01, 0.09, 0.09])),
        inertial(1.5, (0.18, 0.0, 0.03), np.diag([0.004, 0.03, 0.03])),
    ]
)
ROTORS, VISCOUS, DRY = np.array([0.8, 0.5, 0.2]), np.array([3.0, 2, 1]), np.array([2.0, 1.5, 0.6])


def motion(rng, moving, seconds=10.0, dt=0.01):
    """q, v, a (n, 3) of sums of harmonics of joints that move."""
    t = np.arange(0, seconds, dt)
    w = 2 * np.pi * np.arange(1, 9) / 10
    size = rng.normal(size=(2, len(w), 3)) / w[:, None] * moving
    s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    return (
        t,
        s @ size[0] + c @ size[1],
        (c * w) @ size[0] - (s * w) @ size[1],
        (-(s * w**2) @ size[0] - (c * w**2) @ size[1]),
    )


def forces(bodies, q, v, a):
    rigid = bodies.forces(LINKS.ravel(), q, v, a)
    return rigid + ROTORS * a + VISCOUS * v + DRY * v / np.hypot(v, 0.02)


def log(rng, moving=(1, 1, 1), noise=(1e-4, 0.3), **options):
    t, q, v, a = motion(rng, np.array(moving))
    τ = forces(from_axes(AXES).bodies, q, v, a) + noise[1] * rng.normal(size=q.shape)
    q = q + noise[0] * rng.normal(size=q.shape)
    columns = {f"{n}{i + 1}": x[:, i] for n, x in (("q", q), ("tau", τ)) for i in range(3)}
    names = {"positions": ["q1", "q2", "q3"], "inputs": ["tau1", "tau2", "tau3"], "angles": ()}
    return gfnn.Recording({"t": t, **columns}, **{**names, **options})


@pytest.fixture(scope="module")
def arm():
    return gfnn.fit(log(np.random.default_rng(0)), model=gfnn.Arm(axes=AXES))


def test_forces_are_those_of_the_textbook_for_two_links():
    """Spong, Hutchinson & Vidyasagar, "Robot Modeling and Control", section 7.4: a planar arm."""
    m, long, centre, inertia = (3.0, 2.0), 0.7, (0.3, 0.2), (0.08, 0.05)
    chain = from_axes([((0, -1, 0), (0, 0, 0)), ((0, -1, 0), (long, 0, 0))]).bodies
    rows = [inertial(m[i], (centre[i], 0, 0), inertia[i] * np.eye(3)) for i in range(2)]
    q, v, a = np.random.default_rng(0).normal(size=(3, 5, 2))
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    M22 = np.full(5, m[1] * centre[1] ** 2 + inertia[1])
    M12 = M22 + m[1] * long * centre[1] * c2
    M11 = m[0] * centre[0] ** 2 + inertia[0] + m[1] * long**2 + 2 * M12 - M22
    h = m[1] * long * centre[1] * s2
    reach = m[1] * centre[1] * 9.81 * np.cos(q.sum(1))
    held = (m[0] * centre[0] + m[1] * long) * 9.81 * np.cos(q[:, 0]) + reach
    first = M11 * a[:, 0] + M12 * a[:, 1] - h * (2 * v[:, 0] * v[:, 1] + v[:, 1] ** 2) + held
    second = M12 * a[:, 0] + M22 * a[:, 1] + h * v[:, 0] ** 2 + reach
    found = chain.forces(np.concatenate(rows), q, v, a)
    np.testing.assert_allclose(found, np.stack([first, second], axis=1), atol=1e-12)


def test_forces_of_a_tree_with_a_slide_are_those_of_pinocchio():
    pin = pytest.importorskip("pinocchio")
    rng, model, parents, rows = np.random.default_rng(0), pin.Model(), (-1, 0, 1, 1, 3), []
    frames = [(pin.exp3(rng.normal(size=3)), rng.normal(size=3)) for _ in parents]
    axes = [x / np.linalg.norm(x) for x in rng.normal(size=(5, 3))]
    for i, parent in enumerate(parents):
        kind = pin.JointModelPrismaticUnaligned if i == 2 else pin.JointModelRevoluteUnaligned
        joint = model.addJoint(parent + 1, kind(*axes[i]), pin.SE3(*frames[i]), str(i))
        body = pin.Inertia.Random()
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
        rows.append(inertial(body.mass, body.lever, body.inertia))
    turns, origins = (np.array([f[i] for f in frames]) for i in range(2))
    slides, names = tuple(i == 2 for i in range(5)), tuple("abcde")
    tree = Bodies(names, parents, slides, turns, origins, np.array(axes), np.array(EARTH))
    π, data = np.concatenate(rows), model.createData()
    q, v, a = rng.normal(size=(3, 4, 5))
    wanted = [pin.rnea(model, data, *x) for x in zip(q, v, a, strict=True)]
    np.testing.assert_allclose(tree.forces(π, q, v, a), wanted, atol=1e-11)
    heights = [pin.computePotentialEnergy(model, data, x) for x in q]
    np.testing.assert_allclose(tree.potential(π, q), heights, atol=1e-11)
    masses = [np.triu(m) + np.triu(m, 1).T for m in (pin.crba(model, data, x) for x in q)]
    np.testing.assert_allclose(tree.masses(π, q), masses, atol=1e-11)


def test_modified_dh_is_the_chain_of_axes():
    """Two axes along y, one half a metre along x from the other, below a vertical one."""
    quarter = np.pi / 2
    rows = [(0, 0, 0.4, 0), (0, -quarter, 0, 0), (0.5, 0, 0, 0)]
    one, other = from_dh(rows).bodies, from_axes(AXES).bodies
    q, v, a = np.random.default_rng(0).normal(size=(3, 4, 3))
    point = lambda chain, turn: chain.regressor(q, v, a)[..., -10:] @ turn  # noqa: E731
    mass = np.eye(10)[0]  # at the last joint, whatever its frame
    np.testing.assert_allclose(point(one, mass), point(other, mass), atol=1e-12)


def test_parameters_are_found_and_bodies_possible(arm):
    found, base = arm.law.found, arm.law.base
    assert arm.verdict == "identified", arm.verdict
    true = np.concatenate([LINKS.ravel(), ROTORS, np.zeros(3), VISCOUS, DRY])
    off = (base.values - base.turn @ true) / base.errors
    assert np.abs(off).max() < 5
    assert np.sqrt(np.mean(off**2)) < 2
    assert np.linalg.eigvalsh(pseudo_inertias(found.x[:30])).min() > 0
    for name, c, s in zip(arm.law.names, VISCOUS, DRY, strict=True):
        np.testing.assert_allclose(arm.law.frictions[name]["linear"][0], c, rtol=0.05)
        np.testing.assert_allclose(arm.law.frictions[name]["dry"][0], s, rtol=0.05)


def test_torques_of_a_new_motion(arm):
    _, q, v, a = motion(np.random.default_rng(7), np.ones(3))
    bodies = from_axes(AXES).bodies
    off = arm.map.inverse_dynamics(q, v, a).forces - forces(bodies, q, v, a)
    assert np.sqrt(np.mean(off**2)) < 0.05  # an eighth of the noise of a sample
    masses = bodies.masses(LINKS.ravel(), q) + np.diag(ROTORS)
    np.testing.assert_allclose(arm.map.mass_matrix(q), masses, rtol=0.02, atol=0.02)


def test_mujoco_reads_the_arm(arm, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    rng, rotors = np.random.default_rng(3), np.array(list(arm.law.rotors.values()))
    q, v = rng.normal(size=(2, 3))
    for to, kept in (("mjcf", rotors), ("urdf", 0 * rotors)):
        path = gfnn.export(arm, to, tmp_path / f"arm{'.xml' if to == 'mjcf' else '.urdf'}")
        model = mujoco.MjModel.from_xml_path(str(path))
        data, M = mujoco.MjData(model), np.zeros((3, 3))
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        for j, unit in enumerate(np.eye(3)):
            mujoco.mj_mulM(model, data, M[j], unit)
        np.testing.assert_allclose(M, arm.map.mass_matrix(q) + np.diag(kept - rotors), atol=1e-9)
        rigid = from_axes(AXES).bodies.forces(arm.law.found.x[:30], q, v, 0 * v)
        np.testing.assert_allclose(data.qfrc_bias, rigid, atol=1e-8)


@pytest.mark.slow  # compiles a step of three joints
def test_map_moves_as_its_forces_say(arm, tmp_path):
    q, v = np.array([0.3, -0.2, 0.5]), np.array([0.4, -0.3, 0.2])
    law = arm.map.mass_matrix(q)
    u = np.array([1.0, 60.0, 12.0])
    z = np.concatenate([q, law @ v])
    moved = np.asarray(arm.map.step(z, dt=1e-5, inputs=u)[0])
    a = (np.linalg.solve(arm.map.mass_matrix(moved[:3]), moved[3:]) - v) / 1e-5
    np.testing.assert_allclose(arm.map.inverse_dynamics(q, v, a).inputs, u, rtol=2e-3)
    A, B = arm.map.linearise(z, inputs=u)
    assert A.shape == (6, 6)
    assert B.shape == (6, 3)
    arm.save(tmp_path / "arm")
    again = gfnn.load(tmp_path / "arm")
    assert str(again.law) == str(arm.law)
    np.testing.assert_array_equal(again.map.mass_matrix(q), law)
    assert again.report() == arm.report()


def test_what_a_motion_does_not_tell_is_said():
    fit = gfnn.fit(log(np.random.default_rng(1), moving=(1, 1, 0)), model=gfnn.Arm(axes=AXES))
    assert str(fit.verdict).startswith("partly")
    assert "log swings of q3 too" in str(fit.verdict)
    assert "rotor q3: not determined" in str(fit.law)
    assert "q3: offset not determined, linear not determined" in str(fit.law)
    report = fit.report()
    assert all(report["friction"]["q3"][kind] is None for kind in ("linear", "dry"))
    np.testing.assert_allclose(report["friction"]["q2"]["linear"]["value"], VISCOUS[1], rtol=0.05)
    named = {one["name"]: one["value"] for one in report["base_parameters"]}
    assert named["rotor q3"] is None
    with pytest.raises(gfnn.InputError, match=r"no joint moves .* log a motion of all joints"):
        gfnn.fit(log(np.random.default_rng(1), moving=(0, 0, 0)), model=gfnn.Arm(axes=AXES))


@pytest.mark.parametrize(
    ("inputs", "gains", "said"),
    [
        ((1, 2, 3), (1, -1, 1), r"of q2 .* -1 times .*gains=\[1, 1, 1\]"),
        *(
            pytest.param((1, 2, 3), gains, said, marks=pytest.mark.slow)
            for gains, said in (
                ((-1, -1, -1), r"take energy .*gains=\[1, 1, 1\]"),
                ((1, 1e3, 1), r"q2 are 1e\+03 times .*gains=\[1, 1, 1\]"),
                ((4, 1, 1), r"q1 are 4 times .*gains=\[(1|0\.99\d*), 1, 1\]"),
            )
        ),
        ((1, 3, 2), (1, 1, 1), r"exchanged.*inputs=\['tau1', 'tau2', 'tau3'\]"),
        ((1,), None, r"inputs=\["),
    ],
)
def test_forces_that_do_not_go_with_the_motion_are_refused(inputs, gains, said):
    """What the message names mends it."""
    record = log(np.random.default_rng(0), inputs=[f"tau{i}" for i in inputs])
    with pytest.raises(ValueError if gains is None else gfnn.FitError, match=said):
        gfnn.fit(record, model=gfnn.Arm(axes=AXES, gains=gains))


@pytest.mark.parametrize(
    "wrong",
    [(1.0, -1.0), *(pytest.param(w, marks=pytest.mark.slow) for w in ((-1.0, -1.0), (-1.0, 1.0)))],
)
def test_signs_of_a_slow_log_are_told_by_its_friction(wrong):
    """Where gravity is most of the forces, a possible arm has those of the other sign too."""
    rng, kinematics = np.random.default_rng(0), from_axes(AXES[1:])
    t, q, v, a = motion(rng, (1, 1, 1), seconds=20.0)
    q, (v, a) = q[:, 1:], (0.3 * v[:, 1:], 0.09 * a[:, 1:])
    τ = kinematics.bodies.forces(LINKS[1:].ravel(), q, v, a) + ROTORS[1:] * a
    τ += VISCOUS[1:] * v + DRY[1:] * v / np.hypot(v, 0.02) + 0.1 * rng.normal(size=q.shape)
    q = q + 1e-5 * rng.normal(size=q.shape)
    table = {"t": t / 0.3, "a": q[:, 0], "b": q[:, 1], "x": τ[:, 0], "y": τ[:, 1]}
    record = gfnn.Recording(table, positions=["a", "b"], inputs=["x", "y"], angles=())
    with pytest.raises(gfnn.FitError) as refusal:
        gfnn.fit(record, model=gfnn.Arm(axes=AXES[1:], gains=wrong))
    printed = re.search(r"gains=(\[.*\])", str(refusal.value))
    assert printed is not None
    assert ast.literal_eval(printed[1]) == [1, 1]


def test_largest_forces_are_left_out_and_columns_have_to_be_the_joints():
    record = log(np.random.default_rng(0))
    table = {
        name: record.values(name, record.runs[0]) for name in (*record.positions, *record.inputs)
    }
    largest = np.quantile(np.abs(table["tau2"]), 0.9)
    table |= {"t": record.times(record.runs[0]), "tau2": np.clip(table["tau2"], -largest, largest)}
    roles = {"positions": record.positions, "inputs": record.inputs, "angles": ()}
    with pytest.warns(gfnn.FitWarning, match=r"largest force were left out: q2 9\.1%$"):
        fit: Any = gfnn.fit(gfnn.Recording(table, **roles), model=gfnn.Arm(axes=AXES))
    np.testing.assert_allclose(fit.law.frictions["q2"]["linear"][0], VISCOUS[1], rtol=0.05)
    with pytest.raises(gfnn.InputError, match="positions=\\["):
        gfnn.fit(record, model=gfnn.Arm(axes=AXES[:2]))
    with pytest.raises(gfnn.InputError, match=r"positions=\['q1', 'q2', 'q3'\]"):
        from_axes(AXES).in_order(("q2", "b", "c"), "log.csv")
    with pytest.raises(gfnn.InputError, match="one of urdf, axes and dh"):
        gfnn.Arm()


URDF = """<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="3"/>
    <inertia ixx="0.05" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.01"/></inertial></link>
  <link name="lower"><inertial><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="tool"><inertial><mass value="0.5"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit effort="50" velocity="3" lower="-3" upper="3"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>MIMIC
    <limit effort="20" velocity="3" lower="-3" upper="3"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/>
    <origin xyz="0 0 0.3"/></joint>
</robot>"""


@pytest.mark.skipif(not importlib.util.find_spec("yourdfpy"), reason="without yourdfpy")
def test_urdf(tmp_path):
    from gfnn_jax.models.arms.kinematics import from_urdf

    path = tmp_path / "two.urdf"
    path.write_text(URDF.replace("MIMIC", ""))
    arm = from_urdf(path)
    assert arm.bodies.names == ("shoulder", "elbow")
    assert arm.limits.tolist() == [50.0, 20.0]
    M = arm.bodies.masses(arm.prior.ravel(), np.array([[0.3, 0.0]]))[0]
    lower = 0.01 + 0.001 + 0.5 * 0.3**2
    upper = 0.05 + 3 * 0.2**2 + 0.011 + 1.0 * 0.5**2 + 0.5 * 0.8**2
    np.testing.assert_allclose(np.diag(M), [upper, lower], rtol=1e-12)
    path.write_text(URDF.replace("MIMIC", '<mimic joint="shoulder"/>'))
    with pytest.raises(gfnn.InputError, match="elbow follow other joints"):
        from_urdf(path)
    with pytest.raises(gfnn.InputError, match="expected a URDF"):
        from_urdf(tmp_path / "none.urdf")
