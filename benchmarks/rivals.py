"""Six recordings of `vocabulary.py` by other methods that find or fit a law.

    python benchmarks/rivals.py            pip install '.[peers]'
    python benchmarks/rivals.py --quick    one recording, into runs/

The recordings are the first draws there: positions with noise of 1e-3 of their spread. Ours is
given them and which columns are angles. PySINDy is given a library that has the terms of the truth
among others, and is run as in `peers.py`: on accelerations and in weak form, at six thresholds, the
best by a quarter of the record that it does not see. MuJoCo's ``sysid`` is told the model, all but
its constants, and starts them from half to twice the truth; it fits arcs of a period. Where MuJoCo
has no such force it is left out. The error is that of `vocabulary.py`: the median over eleven true
states of the RMS error of one period ahead, of the spread of the positions.
"""

from __future__ import annotations

import functools
import importlib
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import TABLES, Numbers, between_markers, main, markdown, number, provenance
from harness import results as results_of

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
import peers
import vocabulary
from vocabulary import NOISE, PERIODS, SAMPLES, SYSTEMS, Rates, System, integrated, rates, text_of

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import stretches

ROOM = 2.0  # factor by which a constant that MuJoCo starts from may be off
STARTS, AHEAD = 11, 10  # true states that errors are seen from, and times in a period

Features = Mapping[str, Callable[[Any, Any], Any]]
ANGLE: Features = {
    "sin x": lambda q, v: jnp.sin(q[0]),
    "cos x": lambda q, v: jnp.cos(q[0]),
    "sin 2x": lambda q, v: jnp.sin(2 * q[0]),
    "v": lambda q, v: v[0],
    "v|v|": lambda q, v: v[0] * jnp.abs(v[0]),
    "v³": lambda q, v: v[0] ** 3,
}
POSITION: Features = {
    **{f"x{'⁰¹²³'[n]}": lambda q, v, n=n: q[0] ** n for n in range(4)},
    **{f"v{'⁰¹²³'[n]}": lambda q, v, n=n: v[0] ** n for n in range(1, 4)},
    "x v": lambda q, v: q[0] * v[0],
}
LINEAR: Features = {
    "1": lambda q, v: jnp.ones_like(q[0]),
    **{f"x{i + 1}": lambda q, v, i=i: q[i] for i in range(2)},
    **{f"v{i + 1}": lambda q, v, i=i: v[i] for i in range(2)},
}
SINES: Features = {f"sin x{i + 1}": lambda q, v, i=i: jnp.sin(q[i]) for i in range(2)}
SQUARES: Features = {
    "x1²": lambda q, v: q[0] ** 2,
    "x1 x2": lambda q, v: q[0] * q[1],
    "x2²": lambda q, v: q[1] ** 2,
}
RADIAL: Features = {
    f"x{i + 1}/r": lambda q, v, i=i: q[i] / jnp.sqrt(q[0] ** 2 + q[1] ** 2) for i in range(2)
}

_HEAD = (
    '<mujoco><option timestep="0.01" integrator="RK4" gravity="0 0 -1"><flag contact="disable"/>'
    "</option><worldbody>{bodies}</worldbody>{rest}<sensor>{sensors}</sensor></mujoco>"
)
_BOB = '<inertial pos="0 0 {low}" mass="{mass}" diaginertia="{own} {own} {own}"/>'


def _body(joints: str, low: float = 0.0, mass: float = 1.0, own: float = 1e-9) -> str:
    return f"<body>{_BOB.format(low=low, mass=mass, own=own)}{joints}</body>"


def _hinge(name: str) -> str:
    return f'<joint name="{name}" type="hinge" axis="0 -1 0"/>'


def _slide(name: str, axis: str) -> str:
    return f'<joint name="{name}" type="slide" axis="{axis}"/>'


class Model(NamedTuple):
    """A model of MuJoCo but for its constants: bodies and the rest in XML, and of each constant how
    it is set in a spec, and its true value in a system."""

    bodies: str
    constants: Mapping[str, tuple[Callable[[Any, float], None], Callable[[System], float]]]
    rest: str = ""

    def xml(self, dim: int) -> str:
        sensors = "".join(f'<jointpos name="p{k}" joint="x{k}"/>' for k in range(1, dim + 1))
        return _HEAD.format(bodies=self.bodies, rest=self.rest, sensors=sensors)


def _of_joint(name: str, field: str, power: int) -> Callable[[Any, float], None]:
    def put(spec: Any, value: float) -> None:
        getattr(spec.joint(name), field)[power] = value

    return put


def _of_tendon(field: str) -> Callable[[Any, float], None]:
    def put(spec: Any, value: float) -> None:
        tendon = spec.tendon("between")
        if field == "springlength":
            tendon.springlength = [value, value]
        else:
            tendon.stiffness[0] = value

    return put


def _gravity(spec: Any, value: float) -> None:
    spec.option.gravity = [0, 0, -value]


_TENDON = (
    '<tendon><fixed name="between"><joint joint="x1" coef="1"/><joint joint="x2" coef="-1"/>'
    "</fixed></tendon>"
)
_SPRING = '<tendon><spatial name="between"><site site="top"/><site site="bob"/></spatial></tendon>'
CUBIC = Model(
    _body(_hinge("x1"), low=-1.0),
    {
        "gravity": (_gravity, lambda s: s.lagrangian["cos(x1)"]),
        "drag": (_of_joint("x1", "damping", 2), lambda s: 4 * s.friction["abs(v1)**4"]),
    },
)
WELLS = Model(
    _body(_slide("x1", "1 0 0"), own=1.0),
    {
        "linear stiffness": (_of_joint("x1", "stiffness", 0), lambda s: -2 * s.lagrangian["x1**2"]),
        "cubic stiffness": (_of_joint("x1", "stiffness", 2), lambda s: -4 * s.lagrangian["x1**4"]),
        "damping": (_of_joint("x1", "damping", 0), lambda s: 2 * s.friction["v1**2"]),
    },
)
ANGLES = Model(
    _body(_hinge("x1"), low=-1.0) + _body(_hinge("x2"), own=1.0),
    {
        "gravity": (_gravity, lambda s: s.lagrangian["cos(x1)"]),
        "stiffness": (_of_tendon("stiffness"), lambda s: s.lagrangian["x1*x2"]),
        "damping 1": (_of_joint("x1", "damping", 0), lambda s: 2 * s.friction["v1**2"]),
        "damping 2": (_of_joint("x2", "damping", 0), lambda s: 2 * s.friction["v2**2"]),
    },
    _TENDON,
)
SPRING = Model(
    '<site name="top"/>'
    + _body(_slide("x1", "1 0 0") + _slide("x2", "0 0 1") + '<site name="bob" pos="0 0 0"/>'),
    {
        "gravity": (_gravity, lambda s: -s.lagrangian["x2"]),
        "stiffness": (_of_tendon("stiffness"), lambda s: -2 * s.lagrangian["x1**2"]),
        "length": (
            _of_tendon("springlength"),
            lambda s: -s.lagrangian["sqrt(x1**2+x2**2)"] / (2 * s.lagrangian["x1**2"]),
        ),
    },
    _SPRING,
)
# name -> PySINDy's library, and MuJoCo's model where it has one
CASES: Mapping[str, tuple[Features, Model | None]] = {
    "cubic-drag": (ANGLE, CUBIC),
    "two-wells": (POSITION, WELLS),
    "hoop": (ANGLE, None),
    "springs-between-angles": ({**LINEAR, **SINES}, ANGLES),
    "elastic-pendulum": ({**LINEAR, **RADIAL}, SPRING),
    "uniform-field": ({**LINEAR, **SQUARES}, None),
}


class Recorded(NamedTuple):
    """The first draw of a system, as `vocabulary.case` records it."""

    system: System
    truth: Rates
    t: np.ndarray
    states: np.ndarray
    recording: gfnn.Recording

    @classmethod
    def of(cls, name: str) -> Recorded:
        rng = np.random.default_rng([list(SYSTEMS).index(name), 0])
        system = SYSTEMS[name](rng)
        d = len(system.start[0])
        samples, periods = np.exp([rng.uniform(*np.log(ends)) for ends in (SAMPLES, PERIODS)])
        t = system.period / samples * np.arange(int(samples * periods))
        truth = rates(d, text_of(system.lagrangian), text_of(system.friction))
        q0, v0 = map(np.array, system.start)
        states = integrated(truth, q0, v0, t)
        q = states[:, :d]
        seen = q + NOISE * q.std(axis=0) * rng.normal(size=q.shape)
        names = [f"x{i + 1}" for i in range(d)]
        table = {"t": t, **dict(zip(names, seen.T, strict=True))}
        angles = [names[i] for i in system.angles]
        recording = gfnn.Recording(table, positions=names, angles=angles)
        return cls(system, truth, t, states, recording)

    def error(self, law: Rates) -> float:
        d, ahead = self.states.shape[1] // 2, self.system.period * np.arange(AHEAD + 1) / AHEAD
        spread, errors = self.states[:, :d].std(axis=0), []
        for k in np.linspace(0, len(self.t) - 1, STARTS).astype(int):
            start = self.states[k, :d], self.states[k, d:]
            try:
                miss = integrated(law, *start, ahead) - integrated(self.truth, *start, ahead)
                errors.append(np.sqrt(np.mean((miss[1:, :d] / spread) ** 2)))
            except ArithmeticError:
                errors.append(np.inf)
        return float(np.median(errors))


def ours(name: str) -> Numbers:
    """The fit of `vocabulary.py`."""
    found = vocabulary.case(name, 0)
    law = " ".join(filter(None, [found.get("formula"), found.get("friction")]))
    return {
        "given": "which columns are angles",
        "found": f"{law} ({found.get('verdict', 'refused').split(':')[0]})",
        "error": found.get("error"),
        "processor_seconds": found["processor_seconds"],
    }


def by_pysindy(recorded: Recorded, features: Features, quick: bool) -> Numbers:
    names, functions = list(features), list(features.values())
    system = peers.System(
        lambda c, q, v: q,
        (),
        lambda q, v: tuple(f(q, v) for f in functions),
        lambda q: q,
        recorded.system.period / 100,
        "",
    )
    arcs = peers.arcs_of(list(stretches(recorded.recording)))
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        acceleration, params = peers.pysindy_sparse(system, arcs, quick)
    seconds = time.process_time() - started
    compiled = jax.jit(functools.partial(acceleration, params))
    lines = [
        " ".join(f"{c:+.4g} {name}" for c, name in zip(row, names, strict=True) if c)
        for row in np.asarray(params)
    ]
    return {
        "given": f"{len(names)} terms a coordinate, the true ones among them",
        "found": "; ".join(f"a{i + 1} = {line}" for i, line in enumerate(lines)),
        "error": recorded.error(lambda _, q, v: np.asarray(compiled(q, v))),
        "processor_seconds": seconds,
    }


def by_mujoco(recorded: Recorded, model: Model) -> Numbers:
    mujoco: Any = importlib.import_module("mujoco")
    sysid: Any = importlib.import_module("mujoco.sysid")
    d = recorded.states.shape[1] // 2
    spec = mujoco.MjSpec.from_string(model.xml(d))
    rng = np.random.default_rng(0)
    constants = sysid.ParameterDict()
    for name, (put, of) in model.constants.items():
        true, start = of(recorded.system), float(ROOM ** rng.uniform(-1, 1))
        ends = sorted([true * start / ROOM**3, true * start * ROOM**3])
        constants.add(
            sysid.Parameter(
                name, true * start, *ends, modifier=lambda s, p, put=put: put(s, p.value[0])
            )
        )
    compiled = spec.compile()
    arcs = peers.arcs_of(list(stretches(recorded.recording)))
    none = np.zeros((arcs.t.shape[1], 0))
    sequences = sysid.ModelSequences(
        "one",
        spec,
        [f"arc {k}" for k in range(len(arcs.t))],
        [sysid.create_initial_state(compiled, x[:d], x[d:]) for x in arcs.x0],
        [sysid.TimeSeries(t, none) for t in arcs.t],
        [sysid.TimeSeries.from_names(t, y, compiled) for t, y in zip(arcs.t, arcs.y, strict=True)],
    )
    started = time.process_time()
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    found, _ = sysid.optimize(constants, residual, verbose=False)
    seconds = time.process_time() - started
    for name, (put, _) in model.constants.items():
        put(spec, found[name].value[0])
    fitted = spec.compile()
    data = mujoco.MjData(fitted)

    def law(_: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(fitted, data)
        return data.qacc.copy()

    each = (
        f"{name} {found[name].value[0]:.5g} ({of(recorded.system):.5g})"
        for name, (_, of) in model.constants.items()
    )
    return {
        "given": f"the model but for {len(model.constants)} constants",
        "found": "; ".join(each) + " (in parentheses: true)",
        "error": recorded.error(law),
        "processor_seconds": seconds,
    }


def measured(name: str, quick: bool) -> Numbers:
    """Ours and the others on one recording."""
    features, model = CASES[name]
    with np.errstate(all="ignore"):
        recorded = Recorded.of(name)
        found = {"gfnn_jax": ours(name), "PySINDy": by_pysindy(recorded, features, quick)}
        if model is not None:
            found["mujoco.sysid"] = by_mujoco(recorded, model)
    for method, one in found.items():
        print(f"  {method}: {one}", flush=True)
    return found


PIECES = {name: functools.partial(measured, name) for name in CASES}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "rivals")
    rows = [
        [
            name,
            method,
            one["given"],
            f"`{one['found']}`".replace("|", "\\|"),
            number(one["error"]),
            number(seconds),
        ]
        for name, result in found.items()
        for method, one in result["measured"].items()
        for seconds in [one["processor_seconds"]]
    ]
    if rows:
        heads = ("recording", "method", "given", "found: L and R, or a", "error ÷ spread", "CPU s")
        missing = ", ".join(name for name in PIECES if name not in found)
        note = f"Not measured yet: {missing}. " if missing else ""
        text = f"{markdown(heads, rows)}\n\n{note}{provenance(found)}"
        between_markers(TABLES, "rivals", text)


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "rivals", tables, None, ("cubic-drag",))
