"""Laws for other programs: each format does what the flow of the law does."""

import dataclasses
import json
import shutil
import subprocess

import jax
import numpy as np
import pytest
from analytic import mechanics
from test_exports import (
    by_c,
    by_c_pointer,
    by_c_with,
    compiled,
    driven,
    law,
    needs_cc,
    pushed,
    with_length,
)
from test_exports import two_rods as attracting

import gfnn_jax as gfnn
from gfnn_jax import cli
from gfnn_jax.exports import SUFFIXES
from gfnn_jax.families import friction
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.laws import law_of_map, map_of_law, velocities_of
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.solve.status import LEFT_DOMAIN, NOT_CONVERGED

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="no node to run JavaScript")


def two_rods(losses, gain=False):
    """A double pendulum with friction, pushed on its first angle where there is a ``gain``; its
    dry friction sticks. And its states."""
    none = (0, 0)
    rows = [
        ((2, 0), none, none, 0.0, 1.0),
        ((0, 2), none, none, 0.0, 0.5),
        ((1, 1), none, (1, -1), 0.0, 1.0),
        (none, none, (1, 0), 0.0, 9.0),
        (none, none, (0, 1), 0.0, 4.0),
    ]
    own = mechanics(rows, losses, gains=[[1.0], [0.0]] if gain else None)
    z = np.random.default_rng(0).uniform(-1, 1, (400, 4)) * [1, 1, 2, 2]
    signals = Signals(("F",)) if gain else None
    map_ = map_of_law(own, z, 0.02, tolerance=1e-9, signals=signals)
    none = np.zeros((1, 2))
    sensors = Sensors(
        ("a", "b"), (), (), np.full(2, 1e-3), 10.0, 0.6, "hold", 0.0, np.ones(1), none, creep=1e-4
    )
    return dataclasses.replace(map_, sensors=sensors), z


def viscous():
    linear = friction.LINEAR
    rows = [((1, 0), linear, 0.0, 0.1), ((-1, 1), linear, 0.0, 0.05)]
    drag = ((1, 1), friction.ISOTROPIC, 2.0, 0.03)
    return two_rods([*rows, ((0, 1), friction.POWER, 3.0, 0.02), drag])


def sticking():
    """Dry friction of each joint and of the second rod, and a quadratic one: held bodies, some
    twice."""
    rows = [
        ((1, 0), friction.DRY, 1e-4, 0.6),
        ((0, 1), friction.DRY, 1e-4, 0.4),
        ((-1, 1), friction.DRY, 1e-4, 0.4),
        ((0, 1), friction.QUADRATIC, 0.0, 0.1),
        ((1, 0), friction.STRIBECK, 0.2, 0.25),
        ((1, 0), friction.ONE_SIDED, 0.0, 0.3),
    ]
    return two_rods(rows, gain=True)


def exactly(map_):
    """The map by steps so short that its flow is exact."""
    finer = dataclasses.replace(map_.pieces[0], stages=8, substeps=8)
    return dataclasses.replace(map_, pieces=(finer,))


SMOOTH = {  # the map, states, and args of each
    "polynomial and formulas": lambda: (*law(), None),
    "double pendulum with friction": lambda: (*viscous(), None),
    "parameters, Lagrangian": lambda: with_length("Lagrangian"),
    "parameters": lambda: with_length("law"),
    "driven": lambda: driven("law"),
    "inputs that change": lambda: with_inputs(),
}


def with_inputs():
    """Inputs that are linear in time during a step, and friction that is uniform."""
    map_, z = pushed("linear", 0.013, uniform=0.2)
    return map_, z, np.random.default_rng(1).normal(size=(len(z), 2))


@jax.jit
def stepped(piece, z, args):
    return piece.step(z, args)[0]


def expected(map_, z, args):
    """Images of the exact flow, by the piece itself: args as C has them."""
    return np.asarray(stepped(exactly(map_).pieces[0], z, args))


def by_javascript(path, calls):
    """What the law's ``step`` answers to each call (z, h, u)."""
    file = path.with_suffix(".json")
    file.write_text(json.dumps(calls))
    script = (
        f"const law = require({str(path)!r});"
        f"const calls = JSON.parse(require('fs').readFileSync({str(file)!r}));"
        "console.log(JSON.stringify(calls.map((call) => law.step(...call))));"
    )
    done = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    return np.array(json.loads(done.stdout), float)


@needs_cc
def with_one(kind: str) -> list:
    """The smooth laws, of which one is tried each time and the others are slow."""
    return [pytest.param(k, marks=() if k == kind else pytest.mark.slow) for k in SMOOTH]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*SMOOTH, "bobs that attract"])
def test_a_taylor_series_in_c_is_the_flow(kind, tmp_path):
    map_, z, args = SMOOTH[kind]() if kind in SMOOTH else (*attracting(), None)
    library = compiled(gfnn.export(map_, "c", tmp_path / "own.c"))
    for function, own in (
        (library.own_step, map_),
        (library.own_inverse, map_.reversed() if args is None else None),
    ):
        if own is not None:
            images, status = by_c(function, z) if args is None else by_c_with(function, z, args)
            assert set(status.tolist()) <= {0, LEFT_DOMAIN}
            # A third power of a speed has a kink where it turns, which collocation smooths.
            atol = 1e-9 if kind == "inputs that change" else 3e-15
            np.testing.assert_allclose(images, expected(own, z, args), rtol=1e-14, atol=atol)


@pytest.mark.slow
@needs_node
@pytest.mark.parametrize("kind", with_one("inputs that change"))
def test_javascript_is_the_flow(kind, tmp_path):
    map_, z, args = SMOOTH[kind]()
    path = gfnn.export(map_, "js", tmp_path / "own.js")
    dt = float(map_.dt)
    given = [[]] * len(z) if args is None else args.tolist()
    calls = [[state, dt, u] for state, u in zip(z.tolist(), given, strict=True)]
    atol = 1e-9 if kind == "inputs that change" else 3e-15
    found = by_javascript(path, calls)
    np.testing.assert_allclose(found, expected(map_, z, args), rtol=1e-14, atol=atol)
    if kind == "double pendulum with friction":  # any time, and other coefficients
        family, params = map_.pieces[0].family, 1.1 * np.asarray(map_.pieces[0].params)
        other = dataclasses.replace(exactly(map_).pieces[0], params=params, dt=-0.013)
        calls = [[state, -0.013, [], params.tolist()] for state in z[:50].tolist()]
        wanted = stepped(other, z[:50], None)
        np.testing.assert_allclose(by_javascript(path, calls), wanted, rtol=1e-14, atol=1e-14)
        assert family.num_parameters == len(params)


@needs_node
def test_a_body_without_a_force_and_one_that_falls_in_javascript(tmp_path):
    none = (0, 0)
    rows = [((2, 0), none, none, 0.0, 0.5), ((0, 2), none, none, 0.0, 0.5)]
    own = mechanics([*rows, (none, (0, 1), none, 0.0, -9.8)])
    z = np.random.default_rng(0).uniform(-1, 1, (20, 4))
    path = gfnn.export(map_of_law(own, z, 0.02, tolerance=1e-9), "js", tmp_path / "own.js")
    q, p = z[:, :2], z[:, 2:]
    fall = 0.1 * np.array([0.0, -9.8])
    wanted = np.concatenate([q + 0.1 * p + 0.05 * fall, p + fall], axis=1)
    found = by_javascript(path, [[state, 0.1] for state in z.tolist()])
    np.testing.assert_allclose(found, wanted, atol=1e-14)


@pytest.mark.slow
@needs_cc
def test_bodies_stick_in_c_as_in_a_rollout(tmp_path):
    map_, z = sticking()
    u = 2 * np.sin(0.06 * np.arange(300))[:, None]
    states = np.asarray(map_.rollout(z[:3], 300, inputs=u)[0])
    speeds = np.asarray(map_.pieces[0].family.family.velocity(map_.pieces[0].params[:5], states))
    rests = np.any(np.abs(speeds @ [[1, 0, -1], [0, 1, 1]]) < 1e-10, axis=-1)
    assert 0.02 < np.mean(rests) < 0.9  # bodies stick, and slide
    library = compiled(gfnn.export(map_, "c-taylor", tmp_path / "own.c"))
    begun = np.ascontiguousarray(states[:, :-1].reshape(-1, 4))
    images, status = by_c_with(library.own_step, begun, np.tile(u, (3, 1)))
    assert set(status.tolist()) <= {0, LEFT_DOMAIN}
    # As forecasts are: their steps err by 1e-9.
    np.testing.assert_allclose(images, states[:, 1:].reshape(-1, 4), atol=2e-8)
    state = begun[0].copy()
    assert library.own_inverse(by_c_pointer(state), by_c_pointer(u), by_c_pointer(state)) == (
        NOT_CONVERGED
    )


def one_step(to, path, map_):
    """Function of states (B, 2d) and args (B, k), or None, that this format's file is."""
    if to == "jax":
        text = path.read_text()
        assert "gfnn_jax" not in text.partition('"""\n\nimport')[2]
        own = {}
        exec(compile(text, str(path), "exec"), own)
        step = jax.jit(jax.vmap(own["step"]))
        return lambda z, u: step(z, np.zeros((len(z), 0)) if u is None else u)
    if to == "casadi":
        casadi = pytest.importorskip("casadi", reason="CasADi is an extra")
        own = casadi.Function.load(str(path))

        def by_casadi(z, u):
            more = [{}] * len(z) if u is None else [{"u": row} for row in u]
            return np.array(
                [own(z=a, **b)["Z"].full().ravel() for a, b in zip(z, more, strict=True)]
            )

        return by_casadi
    fmpy = pytest.importorskip("fmpy", reason="fmpy is an extra")
    from fmpy.fmi3 import FMU3Slave
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(path)) == []
    about, folder = fmpy.read_model_description(str(path)), fmpy.extract(str(path))
    own = FMU3Slave(
        guid=about.guid, unzipDirectory=folder, modelIdentifier="own", instanceName="one"
    )
    own.instantiate()
    own.enterInitializationMode(startTime=0.0)
    own.exitInitializationMode()
    numbers = {v.name: v.valueReference for v in about.modelVariables}
    dim, dt = map_.dim, float(map_.dt)
    names = [f"{letter}{i + 1}" for letter in "qp" for i in range(dim)]
    if map_.sensors is not None:
        names[:dim] = map_.sensors.positions
    z_at = [numbers[own] for own in names]
    u_at = [numbers[name] for name in ("l", "F") if name in numbers]

    def by_fmu(z, u):
        found = []
        for n, row in enumerate(z):
            own.setFloat64(z_at, row.tolist())
            if u_at:
                own.setFloat64(u_at, u[n, : len(u_at)].tolist())
            own.doStep(0.0 if u is None or u_at else float(u[n, 0]), dt)
            found.append(own.getFloat64(z_at))
        return np.array(found)

    return by_fmu


# An FMU holds the Taylor series in C, which is tested above with every kind.
@pytest.mark.slow
@needs_cc
@pytest.mark.parametrize(
    ("to", "kind"),
    [
        (to, kind)
        for to in ("jax", "casadi", "fmu")
        for kind in (list(SMOOTH)[2:] if to == "fmu" else SMOOTH)
    ],
)
def test_steps_of_other_tools_are_the_maps(to, kind, tmp_path):
    map_, z, args = SMOOTH[kind]()
    if to == "fmu" and kind == "inputs that change":
        args = args * [1.0, 0.0]  # held
    z, args = z[:40], None if args is None else args[:40]
    if to == "casadi":
        pytest.importorskip("casadi", reason="CasADi is an extra")
    path = gfnn.export(map_, to, tmp_path / f"own{SUFFIXES[to]}")
    wanted = expected(map_, z, args) if to == "fmu" else stepped(map_.pieces[0], z, args)
    atol = 1e-9 if (to, kind) == ("fmu", "inputs that change") else 1e-13
    np.testing.assert_allclose(one_step(to, path, map_)(z, args), wanted, rtol=1e-13, atol=atol)


ROTOR = 0.004


def chain(relative=False):
    """A double pendulum of two links, its motor and friction at the joints, and the rotor of the
    second; the angles of the first are zero where it is turned by 0.1."""
    m, c, inertia, long, g = (1.2, 0.7), (0.2, 0.3), (0.03, 0.01), 0.5, 9.81
    a = inertia[0] + m[0] * c[0] ** 2 + m[1] * long**2
    b, e = m[1] * long * c[1], inertia[1] + m[1] * c[1] ** 2
    weights, none, turned = ((m[0] * c[0] + m[1] * long) * g, m[1] * c[1] * g), (0, 0), -0.1
    if relative:
        rows = [
            ((2, 0), none, none, 0.0, (a + e) / 2),
            ((2, 0), none, (0, 1), 0.0, b),
            ((0, 2), none, none, 0.0, (e + ROTOR) / 2),
            ((1, 1), none, none, 0.0, e),
            ((1, 1), none, (0, 1), 0.0, b),
            (none, none, (1, 0), turned, weights[0]),
            (none, none, (1, 1), turned, weights[1]),
        ]
    else:
        rows = [
            ((2, 0), none, none, 0.0, (a + ROTOR) / 2),
            ((0, 2), none, none, 0.0, (e + ROTOR) / 2),
            ((1, 1), none, none, 0.0, -ROTOR),
            ((1, 1), none, (1, -1), turned, b),
            (none, none, (1, 0), turned, weights[0]),
            (none, none, (0, 1), 0.0, weights[1]),
        ]
    second = (0, 1) if relative else (-1, 1)
    losses = [((1, 0), friction.LINEAR, 0.0, 0.02), (second, friction.LINEAR, 0.0, 0.01)]
    own = mechanics(rows, losses, gains=[[0.0], [1.0]] if relative else [[-1.0], [1.0]])
    z = np.random.default_rng(0).uniform(-1, 1, (300, 4)) * [1, 1, 0.3, 0.1]
    return map_of_law(own, z, 0.01, tolerance=1e-12, signals=Signals(("F",))), z


@pytest.mark.slow
@pytest.mark.parametrize("to", ["mjcf", "urdf"])
@pytest.mark.parametrize("relative", [False, True])
def test_mujoco_moves_a_chain_of_links_as_its_law_does(relative, to, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is an extra")
    map_, z = chain(relative)
    path = gfnn.export(map_, to, tmp_path / f"own{SUFFIXES[to]}")
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep, model.opt.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_RK4
    if to == "urdf":  # its comment tells what it cannot hold
        assert f"rotors, left out: joint2 {ROTOR:g}" in path.read_text()
        model.dof_armature[1] = ROTOR
    data, push = mujoco.MjData(model), 0.1 if to == "mjcf" else 0.0
    turn = np.array([[1.0, 0.0], [0.0 if relative else 1.0, 1.0]])  # of joints into columns
    data.qpos[:] = np.linalg.solve(turn, z[0, :2])
    data.qvel[:] = np.linalg.solve(turn, velocities_of(map_, z[:1])[0])
    if model.nu:
        data.ctrl[:] = push
    for _ in range(1_000):
        mujoco.mj_step(model, data)
    states, _ = map_.rollout(z[0], 100, inputs=np.full((101, 1), push))
    np.testing.assert_allclose(turn @ data.qpos, states[-1, :2], atol=1e-8)
    np.testing.assert_allclose(model.body_pos[-1], [0, 0, -0.5], atol=1e-12)  # the length is told


@pytest.mark.slow
def test_friction_holds_a_link_in_mujoco_as_in_the_law(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is an extra")
    rows = [((2,), (0,), (0,), 0.0, 0.5), ((0,), (0,), (1,), 0.0, 9.0)]
    own = mechanics(rows, [((1,), friction.DRY, 1e-4, 6.0)])
    z = np.array([[0.4, 2.0]])
    map_ = map_of_law(own, np.random.default_rng(0).uniform(-2, 2, (300, 2)), 0.01, tolerance=1e-9)
    none, one = np.zeros((1, 1)), np.ones(1)
    sensors = Sensors(("a",), (), (), 1e-3 * one, 10.0, 0.6, "hold", 0.0, one, none, creep=1e-4)
    map_ = dataclasses.replace(map_, sensors=sensors)
    path = gfnn.export(map_, "mjcf", tmp_path / "own.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = z[0, :1], z[0, 1:]
    for _ in range(1_000):
        mujoco.mj_step(model, data)
    states, _ = map_.rollout(z[0], 100)
    assert abs(states[-1, 1]) < 1e-12  # it is held, off its rest
    np.testing.assert_allclose(data.qpos, states[-1, :1], atol=1e-3)  # its own friction: 0.005


def test_forces_of_a_motion_make_it():
    map_, z = chain(relative=True)
    law = law_of_map(map_)
    q, v = z[:50, :2], z[:50, 2:]
    a = law.acceleration(q, v, np.full((50, 1), 0.3))
    found = map_.inverse_dynamics(q, v, a)
    np.testing.assert_allclose(found.inputs, 0.3, atol=1e-12)
    np.testing.assert_allclose(found.left, 0, atol=1e-12)
    unforced = map_.inverse_dynamics(q, v, law.acceleration(q, v) + np.eye(2)[0])
    np.testing.assert_allclose(unforced.forces, map_.mass_matrix(q)[..., 0], atol=1e-12)
    np.testing.assert_allclose(unforced.left, unforced.forces * [1.0, 0.0], atol=1e-12)
    with pytest.raises(ValueError, match="of one shape"):
        map_.inverse_dynamics(q, v, a[:3])


def test_formats_of_laws_are_refused_for_what_has_none(tmp_path):
    from test_exports import MAPS

    map_, _ = MAPS["type 2"]()
    for to in ("c-taylor", "js", "jax", "fmu"):
        with pytest.raises(gfnn.InputError, match=r"no law.*to='c'"):
            gfnn.export(map_, to, tmp_path / f"own{SUFFIXES[to]}")
    assert cli.main(["export", str(tmp_path), "--to", "js"]) == 2
