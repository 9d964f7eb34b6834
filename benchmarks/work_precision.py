"""Work against precision: which map to take, and what is faster where H is known.

    python benchmarks/work_precision.py                  scenes without a result, then the tables
    python benchmarks/work_precision.py --only two-body --overwrite
    python benchmarks/work_precision.py --quick          small sizes, into runs/work-precision

A scene's result is one JSON file, work-precision-*.json in benchmarks/results; the figures and the
section of benchmarks/RESULTS.md are made from these files and from those of `gfnn compare`. All
times are per trajectory and unit of the scene's time, the best of several, compilation apart.
heyoka is in the extra ``benchmarks``; without it its row says so.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    RESULTS,
    SEED,
    TABLES,
    Numbers,
    angles_of,
    between_markers,
    drawn,
    in_float32,
    markdown,
    number,
    one_step_rms,
    provenance,
    results,
    timed,
)
from harness import main as run_pieces

# isort: split
import jax
import numpy as np
from integrators import runners
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

import gfnn_jax as gfnn
from gfnn_jax.evaluate import figures, metrics
from gfnn_jax.evaluate.figures_style import GREY
from gfnn_jax.jobs.compare import separable
from gfnn_jax.scenes import Scene
from gfnn_jax.solve.status import LEFT_DOMAIN

# scene: pairs to learn from, the steps after which the error is taken, and states. In a batch all
# states wait for the one that comes closest to a body: of a thousand that takes half an hour.
SCENES = {
    "two-body": (4_000, 100, 1_000),
    "henon-heiles-regular": (4_000, 100, 1_000),
    "henon-heiles-chaotic": (8_000, 10, 1_000),
    "pcr3bp": (10_000, 100, 100),
    "standard-map-regular": (1_000, 100, 1_000),
    "standard-map-chaotic": (1_000, 10, 1_000),
}
QUICK = ("standard-map-regular", "henon-heiles-regular")
# Scenes whose law is learned too: few pairs, and the terms of H that are told, in the scene's own
# coordinates. A flow for each error asked for, and a map made from the law for each.
LAWS = {"two-body": (200, ("1/q1", "p2**2/q1**2", "p1**2")), "henon-heiles-regular": (100, ())}
LAW_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
SINGLE_STEPS, STRIDE, MOST_SIZES = 1_000, 10, 5
FLOAT32_FLOOR = 1e-7  # of the data's spread: a larger map is no more accurate in float32
CHARTS = ("midpoint", "type2")
UNREACHABLE = 1e-300  # a tolerance for which a fit sweeps all sizes
# A size is fitted by asking for its own error, a little more because that may be an estimate.
_MARGIN = 1.1
MLP_ITERATIONS = 100
DRAWN = 10.0  # a larger error is that of a prediction far outside the scene
ASKED = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
OURS, KNOWN, OTHERS = "ours", "H known", "baseline"


# Measuring


class Bench:
    """Test of all methods of a scene: states, their reference, the horizon."""

    def __init__(self, scene: Scene, num_steps: int, lanes: int, quick: bool):
        self.scene, self.num_steps = scene, num_steps
        self.single_steps = 100 if quick else SINGLE_STEPS
        key = jax.random.key(SEED)
        self.z0 = gfnn.sample_test_states(scene, 50 if quick else lanes, key)
        reached = gfnn.reference_trajectories(scene, self.z0, num_steps, save_every=num_steps)
        self.reference = np.asarray(reached[:, -1])
        self.stays = np.isfinite(self.reference).all(axis=1)

    def judged(self, states, lost=None) -> Numbers:
        """Median and mean position error at the horizon; a lane that is lost counts as infinitely
        far in the median, and leaves no mean."""
        states = np.array(states, dtype=float)
        if lost is not None:
            states[lost] = np.nan
        error = np.asarray(metrics.position_error(states, self.reference, angles_of(self.scene)))[
            self.stays
        ]
        num_lost = int(np.sum(~np.isfinite(error)))
        return {
            "error_median": float(np.median(np.where(np.isfinite(error), error, np.inf))),
            "error_mean": float(np.mean(error)) if num_lost == 0 else None,
            "num_lost": num_lost,
            "num_trajectories": len(error),
        }

    def together(self, batch: Callable, num_steps: int) -> tuple[Any, Numbers]:
        """Time a call that takes all states ``num_steps`` steps; return result and times."""
        out, seconds, compiling = timed(batch)
        per_unit = 1e6 * seconds / (len(self.z0) * num_steps * self.scene.dt)
        return out, {"microseconds_batch": per_unit, "compile_seconds_batch": compiling}

    def alone(self, single: Callable) -> Numbers:
        """Time of a call that takes one state ``single_steps``; None where it gets lost."""
        out, seconds, compiling = timed(single)
        per_unit = 1e6 * seconds / (self.single_steps * self.scene.dt)
        there = bool(np.isfinite(np.asarray(out)).all())
        return {
            "microseconds_single": per_unit if there else None,
            "compile_seconds_single": compiling,
        }


def map_point(bench: Bench, map_, *, alone: bool) -> Numbers:
    """A learned map at the horizon, which short calls reach in a row: the fastest of many short
    ones suffers least from other work on the machine."""
    lanes, stride = map_.start(bench.z0), min(STRIDE, bench.num_steps)
    _, times = bench.together(lambda: map_.advance(lanes, 1, save_every=stride)[1], stride)
    if alone:
        one, longer = map_.start(bench.z0[:1]), bench.single_steps
        times |= bench.alone(lambda: map_.advance(one, 1, save_every=longer)[1])
    for _ in range(bench.num_steps // stride):
        lanes, states = map_.advance(lanes, 1, save_every=stride)
    status = np.asarray(lanes.status)
    left = int(np.sum(status[bench.stays] == LEFT_DOMAIN))
    return {
        **bench.judged(states[:, -1], lost=status > LEFT_DOMAIN),
        "num_left_domain": left,
        **times,
    }


def front_of(cost, error) -> list[int]:
    """Indices, by rising cost, of the points that no other beats in both."""
    kept, best = [], np.inf
    for i in np.lexsort((error, cost)).tolist():
        if error[i] < best:
            kept.append(i)
            best = error[i]
    return kept


def thinned(items: list, most: int) -> list:
    """Thin out items evenly to at most ``most``, keeping the first and the last."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[i] for i in np.unique(places)]


def kinds_of(scene: Scene, quick: bool) -> Iterator[tuple[str, str]]:
    """(chart, family) of each size sweep."""
    for chart in CHARTS[:1] if quick else CHARTS:
        if scene.features is None or chart == CHARTS[0]:  # one row shows what features are worth
            yield chart, "polynomial"
        if scene.features is not None and not quick:
            yield chart, "features"
    if not quick:
        yield CHARTS[0], "mlp"


def our_maps(bench: Bench, num_pairs: int, quick: bool, omit) -> Iterator[Numbers]:
    """Measure a few sizes of every chart and family along its front, in both precisions."""
    scene = bench.scene
    pairs, _ = drawn(scene, num_pairs, quick=True)
    for chart, family in kinds_of(scene, quick):
        name = f"{chart} {family}"

        def fitted(tolerance, chart=chart, family=family):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", gfnn.FitWarning)
                return gfnn.fit(
                    pairs,
                    scene,
                    learn="map",
                    chart=chart,
                    family=family,
                    seed=SEED,
                    tolerance=tolerance,
                    max_iterations=MLP_ITERATIONS,
                )

        try:
            sweep = fitted(1e-3 if quick else UNREACHABLE)
        except gfnn.FitError as error:
            omit(name, str(error))
            continue
        print(f"  {name}: {len(sweep.candidates)} sizes, {sweep.seconds:.0f} s", flush=True)
        sizes = [c for c in sweep.candidates if np.isfinite(c.validation_relative)]
        if len(sizes) < len(sweep.candidates):
            lost = sorted({c.label for c in sweep.candidates} - {c.label for c in sizes})
            omit(name, f"lanes of the held-out pairs fail: {', '.join(lost)}")
        front = front_of([c.operations for c in sizes], [c.validation_relative for c in sizes])
        shown: set[str] = set()
        at_floor = False
        for size in thinned([sizes[i] for i in front], 1 if quick else MOST_SIZES):
            alone = size.chosen or len(front) == 1
            fit = sweep if alone else fitted(_MARGIN * size.validation_bound)
            candidate = fit.chosen
            if candidate.label in shown:
                continue
            shown.add(candidate.label)
            about = {
                "group": OURS,
                "method": f"{chart} {candidate.label.rsplit(maxsplit=1)[0]}",
                "label": candidate.label,
                "chart": chart,
                "num_parameters": candidate.num_parameters,
                "base_map": fit.base_map,
                "one_step_rms": candidate.validation_rms,
                "fit_seconds": candidate.fit_seconds,
            }
            yield {**about, "dtype": "float64", **map_point(bench, fit.map, alone=True)}
            if not at_floor:
                single = in_float32(fit.map)
                yield {**about, "dtype": "float32", **map_point(bench, single, alone=False)}
            at_floor = candidate.validation_relative < FLOAT32_FLOOR


def our_laws(bench: Bench, quick: bool) -> Iterator[Numbers]:
    """The flow of a law that was learned from few pairs, at rising precision, and maps that are
    made from the law."""
    scene, (num_pairs, terms) = bench.scene, LAWS[bench.scene.name]
    pairs, fresh = drawn(scene, num_pairs, quick=True)
    shown: set[str] = set()
    for tolerance in LAW_TOLERANCES[-1:] if quick else LAW_TOLERANCES:
        law = gfnn.fit(
            pairs, scene, learn="hamiltonian", terms=terms, seed=SEED, tolerance=0.1 * tolerance
        )
        assert law.hamiltonian is not None
        flow = law.hamiltonian.flow
        print(f"  law: {flow.stages} stages in {flow.substeps} substeps", flush=True)
        found = [
            ("flow of a law", law, f"{num_pairs} pairs, stages: {flow.stages * flow.substeps}")
        ]
        if tolerance == LAW_TOLERANCES[-1]:
            found += [
                ("map of a law", fast, f"{fast.chosen.label}")
                for fast in (law.accelerate(tolerance=t) for t in LAW_TOLERANCES)
            ]
        for method, fit, label in found:
            if f"{method} {label}" in shown:
                continue
            shown.add(f"{method} {label}")
            yield {
                "group": OURS,
                "method": method,
                "label": label,
                "chart": fit.chosen.chart,
                "num_parameters": fit.chosen.num_parameters,
                "base_map": fit.base_map,
                "one_step_rms": one_step_rms(fit.map, fresh, angles_of(scene)),
                "fit_seconds": fit.seconds - fit.compile_seconds,
                "dtype": "float64",
                "pairs": num_pairs,
                **map_point(bench, fit.map, alone=True),
            }


def integrated(bench: Bench, quick: bool, omit) -> Iterator[Numbers]:
    """Integrators that are told H, at rising precision."""
    scene, z0, one = bench.scene, bench.z0, bench.z0[:1]
    horizon, longer = bench.num_steps * scene.dt, bench.single_steps * scene.dt
    for name, runner in runners(scene, separable(scene)):
        if isinstance(runner, str):
            omit(name, runner)
            continue
        if quick and name not in ("diffrax Dopri8", "heyoka", "Kahan–Li 8"):
            continue
        print(f"  {name}")
        chosen = thinned(list(runner.precisions.items()), 2 if quick else len(runner.precisions))
        for label, precision in chosen:
            many = functools.partial(runner.run, z0, horizon, precision)
            reached, times = bench.together(many, bench.num_steps)
            judged = bench.judged(reached)
            if not np.isfinite(judged["error_median"]):
                omit(f"{name}, {label}", f"{judged['num_lost']} trajectories fail")
                continue
            yield {
                "group": KNOWN,
                "method": name,
                "label": label,
                "dtype": "float64",
                "arrangement": runner.arrangement,
                **judged,
                **times,
                **bench.alone(functools.partial(runner.run, one, longer, precision)),
            }


def scene_piece(name: str) -> Callable[[bool], Numbers]:
    def measure(quick: bool) -> Numbers:
        num_pairs, num_steps, lanes = SCENES[name]
        omitted: list[dict[str, str]] = []

        def omit(method: str, reason: str) -> None:
            omitted.append({"method": method, "reason": reason})

        scene = gfnn.scenes.make(name)
        bench = Bench(scene, num_steps, lanes, quick)
        points = [
            *our_maps(bench, 1_000 if quick else num_pairs, quick, omit),
            *integrated(bench, quick, omit),
        ]
        try:
            extra = {"heyoka": importlib.metadata.version("heyoka")}
        except importlib.metadata.PackageNotFoundError:
            extra = {}
        return {
            "dt": scene.dt,
            "horizon_steps": num_steps,
            "horizon": num_steps * scene.dt,
            "lanes": len(bench.z0),
            "pairs": num_pairs,
            "points": points,
            "omitted": omitted,
            "versions": extra,
        }

    return measure


def law_piece(name: str) -> Callable[[bool], Numbers]:
    def measure(quick: bool) -> Numbers:
        _, num_steps, lanes = SCENES[name]
        bench = Bench(gfnn.scenes.make(name), num_steps, lanes, quick)
        return {"points": list(our_laws(bench, quick))}

    return measure


OF_SCENES = {name: scene_piece(name) for name in SCENES}
OF_LAWS = {f"{name}-laws": law_piece(name) for name in LAWS}
PIECES = {**OF_SCENES, **OF_LAWS}


# Figures and tables


def others(name: str, result: Numbers) -> list[Numbers]:
    """The other methods, at the same step of the same scene, as `gfnn compare` measured them: 100
    trajectories together."""
    path = RESULTS / f"compare-{name}-{SEED}.json"
    if not path.exists():
        return []
    measured = result["measured"]
    step = str(measured["horizon_steps"])
    return [
        {
            "group": OTHERS,
            "method": m["title"],
            "label": m["model"]["label"],
            "error_median": m["rollout"]["error_median"][step],
            "microseconds_batch": m["rollout"]["microseconds_per_step"] / measured["dt"],
            "num_parameters": m["model"]["num_parameters"],
            "num_lost": m["rollout"]["num_lost"],
        }
        for method, m in json.loads(path.read_text(encoding="utf-8"))["methods"].items()
        if method != "gfnn"
    ]


def panel(points: list[Numbers], time_of: str) -> Numbers:
    """Data of a panel of the figure: group -> name -> (cost, error, size)."""
    groups: Numbers = {"ours": {}, "float32": {}, "known": {}, "others": {}}
    for p in points:
        if p["error_median"] is None or p.get(time_of) is None or p["error_median"] > DRAWN:
            continue
        group = {OURS: "ours", KNOWN: "known", OTHERS: "others"}[p["group"]]
        group = "float32" if p.get("dtype") == "float32" else group
        costs, errors, sizes = groups[group].setdefault(p["method"], ([], [], []))
        costs.append(p[time_of])
        errors.append(p["error_median"])
        sizes.append(p["label"].split()[-1])  # the degree, or the network's layers
    return groups


def draw(name: str, result: Numbers) -> None:
    m = result["measured"]
    points = [*m["points"], *others(name, result)]
    panels = {
        f"{m['lanes']:,} trajectories together": panel(points, "microseconds_batch"),
        "one trajectory alone": panel(points, "microseconds_single"),
    }
    label = f"median position error after {m['horizon_steps']} steps"
    figures.save(panels_figure(panels, label), FIGURES / f"work_precision_{name}.png")


def within(
    points: Sequence[Numbers], error: float, time_of: str = "microseconds_batch"
) -> Numbers | None:
    """The fastest of these points whose error is at most this."""
    timed_points = [p for p in points if None not in (p["error_median"], p.get(time_of))]
    meeting = [p for p in timed_points if p["error_median"] <= error]
    return min(meeting, key=lambda p: p[time_of], default=None)


def called(point: Numbers) -> str:
    """A map as the tables name it."""
    precision = ", float32" if point["dtype"] == "float32" else ""
    based = ", base map" if point["base_map"] else ""
    return f"{point['chart']} {point['label']}{precision}{based}"


def advice(name: str, result: Numbers) -> str:
    """Table of the fastest map for each error, and of integrators as accurate."""
    m = result["measured"]
    ours_all, known_all = ([p for p in m["points"] if p["group"] == g] for g in (OURS, KNOWN))
    rows = []
    for error in ASKED:
        ours, known, other = (
            within(points, error) for points in (ours_all, known_all, others(name, result))
        )
        alone = within(known_all, error, "microseconds_single")
        if not (ours or known):
            continue
        row = {"error asked for": f"{error:.0e}"}
        row |= {
            "map to take": called(ours) if ours else "none",
            "parameters": number(ours and ours["num_parameters"]),
            "its error": number(ours and ours["error_median"]),
            "µs together, alone": pair_of(ours, ours),
            "compile, s": number(ours and ours["compile_seconds_batch"]),
        }
        if known_all:
            row |= {
                "fastest that is told H: together, alone": " and ".join(
                    dict.fromkeys(p["method"] for p in (known, alone) if p)
                )
                or "none",
                "its µs": pair_of(known, alone),
                "times faster than the map": pair_of(known, alone, ours) if ours else "–",
            }
        row["fastest other learned method, µs"] = (
            f"{other['method']}, {number(other['microseconds_batch'])}" if other else "none"
        )
        rows.append(row)
    return markdown(list(rows[0]), [list(row.values()) for row in rows])


def pair_of(together: Numbers | None, alone: Numbers | None, of: Numbers | None = None) -> str:
    """Both times of a method, or the ratios of another method's times to them, as text."""
    if together is None or alone is None:
        return "–"
    times = [together["microseconds_batch"], alone.get("microseconds_single")]
    if of is not None:
        slower = of["microseconds_batch"], of.get("microseconds_single")
        times = [a and b and a / b for a, b in zip(slower, times, strict=True)]
    return ", ".join(map(number, times))


def in_words(name: str, result: Numbers) -> str:
    """Advice on which map to take, and on what is faster, in a few sentences."""
    points = result["measured"]["points"]
    ours, known = ([p for p in points if p["group"] == g] for g in (OURS, KNOWN))
    takes: dict[str, float] = {}
    ratios = []
    for error in ASKED:
        map_, told = within(ours, error), within(known, error)
        if map_:
            takes[called(map_)] = error
        if map_ and told:
            ratios.append(map_["microseconds_batch"] / told["microseconds_batch"])
    said = ["Take " + "; ".join(f"{map_} down to {e:.0e}" for map_, e in takes.items()) + "."]
    if ratios:
        fastest = sorted({p["method"] for e in ASKED if (p := within(known, e))})
        said.append(
            f"Where H is known an integrator is faster: {', '.join(fastest)}, by "
            f"{number(min(ratios))} to {number(max(ratios))} times, together."
        )
    compared = [p for p in others(name, result) if p["error_median"] is not None]
    if compared:
        best = min(compared, key=lambda p: p["error_median"])
        said.append(
            f"The best of the other learned methods, {best['method']}, has an error of "
            f"{number(best['error_median'])} in {number(best['microseconds_batch'])} µs."
        )
    return " ".join(said)


def failures(name: str, result: Numbers) -> str:
    """Line of text on methods left out, failures, and lost lanes."""
    m = result["measured"]
    reasons: dict[str, list[str]] = {}
    for o in m["omitted"]:
        reasons.setdefault(o["reason"], []).append(o["method"])
    for p in [*m["points"], *others(name, result)]:
        title = called(p) if p["group"] == OURS else f"{p['method']}, {p['label']}"
        if p["num_lost"]:
            reasons.setdefault(f"{p['num_lost']} trajectories lost", []).append(title)
        elif p.get("num_left_domain", 0) > 0.05 * m["lanes"]:
            left = f"{p['num_left_domain']} trajectories left the domain of the data"
            reasons.setdefault(left, []).append(title)
    if not others(name, result):
        reasons["not compared on this scene yet"] = ["the other methods"]
    said = [f"{', '.join(titles)}: {reason}" for reason, titles in reasons.items()]
    return "Left out, lost or failed: " + ("; ".join(said) or "nothing") + "."


def law_table(result: Numbers) -> str:
    """Table of the learned laws, the largest error first."""
    rows = [
        [
            p["method"],
            p["label"],
            number(p["num_parameters"]),
            number(p["pairs"]),
            number(p["one_step_rms"]),
            number(p["error_median"]),
            pair_of(p, p),
        ]
        for p in sorted(result["measured"]["points"], key=lambda p: -p["error_median"])
    ]
    heads = (
        "learned",
        "size",
        "parameters",
        "pairs",
        "one-step RMS",
        "error",
        "µs together, alone",
    )
    return markdown(heads, rows)


@figures.style()
def panels_figure(panels: Mapping, ylabel) -> Figure:
    """Draw error against time, log–log, of learned maps and other methods, in panels side by side.

    panels: title -> {"ours", "float32", "known", "others"}, each a mapping of name -> (cost (K,),
    error (K,), size (K,) as text). Ours have a colour and a filled marker each, with the size
    beside it; the same names in float32 are hollow. The thick line joins those of ours that no
    other of ours beats. Methods that know H are grey. Numbered crosses are single results of other
    methods.
    """
    figure = Figure(figsize=(figures.WIDTH * 0.85 * len(panels) + 1.6, figures.HEIGHT * 1.25))
    axes = np.ravel(figure.subplots(1, len(panels), sharey=True))
    # A name looks alike in all panels, also where one of them lacks another.
    named = [n for group in ("ours", "known") for p in panels.values() for n in p[group]]
    place = {name: i for i, name in enumerate(dict.fromkeys(named))}
    grey = GREY
    cross: dict[str, Any] = {"color": figures.REFERENCE, "ms": 4}
    for ax, (title, groups) in zip(axes, panels.items(), strict=True):
        _front(ax, [*groups["ours"].values(), *groups["float32"].values()])
        for name, points in groups["ours"].items():
            look = figures._look_of(place[name]) | figures._ALONE | {"ms": 5.5}
            ax.plot(*points[:2], label=name, **look)
            beside: dict[str, Any] = {
                "fontsize": 6,
                "color": look["color"],
                "path_effects": figures._HALO,
            }
            for cost, error, size in zip(*points, strict=True):
                ax.annotate(size, (cost, error), (5, 3), textcoords="offset points", **beside)
            if name in groups["float32"]:
                ax.plot(*groups["float32"][name][:2], mfc="white", **look)
        if groups["float32"]:
            ax.plot([], [], "o", mfc="white", color=grey, label="hollow: in float32")
        for name, points in groups["known"].items():
            look = figures._look_of(place[name]) | {"color": grey, "linewidth": 0.8, "ms": 3.5}
            ax.plot(*points[:2], label=f"{name} (given H)", **look)
        others = groups["others"].values()
        costs, errors = (np.array([np.ravel(v[i])[0] for v in others]) for i in (0, 1))
        if len(costs):
            ax.plot(costs, errors, "x", **cross)
        ax.set(title=title, xlabel="time per trajectory and unit time (µs)", **figures._LOG_LOG)
        ax.xaxis.set_minor_formatter(NullFormatter())  # they would cover each other
        if len(costs):
            figures._number_points(ax, costs, errors, np.arange(len(costs)))
            for number, name in enumerate(groups["others"], 1):
                ax.plot([], [], "x", label=f"{number}  {name}", **cross)
    axes[0].set_ylabel(ylabel)
    handles = {}
    for ax in axes:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    figure.legend(handles.values(), handles, loc="outside right center", frameon=False)
    return figure


def _front(ax, curves):
    """Draw the staircase through the points that no other beats in both cost and error."""
    cost, error = (np.concatenate([np.ravel(c[i]) for c in curves]) for i in (0, 1))
    look: dict[str, Any] = {"color": figures.COLOURS[5], "lw": 4, "alpha": 0.45, "zorder": 1.5}
    ax.step(*figures.unbeaten(cost, error), where="post", label="best of our maps", **look)


def tables() -> None:
    found, laws = results(OF_SCENES, "work-precision"), results(OF_LAWS, "work-precision")
    if not found:
        return
    parts = []
    for name, result in found.items():
        law = laws.get(f"{name}-laws")
        if law:
            result["measured"]["points"] += law["measured"]["points"]
        draw(name, result)
        m = result["measured"]
        compiling = [p["compile_seconds_batch"] for p in m["points"] if p["group"] == OURS]
        parts.append(
            f"### {name}\n\nErrors after {m['horizon_steps']} steps of {m['dt']:g}, "
            f"{m['pairs']:,} pairs to learn from. Compilation of a map's rollout: "
            f"{number(min(compiling))} to {number(max(compiling))} s.\n\n"
            f"{in_words(name, result)}\n\n"
            f"![Work and precision: {name}](figures/work_precision_{name}.png)\n\n"
            f"{advice(name, result)}\n\n{failures(name, result)}"
            + (f"\n\nLaws, and maps made from them:\n\n{law_table(law)}" if law else "")
        )
    versions = {
        k: v
        for r in found.values()
        for k, v in {**r["versions"], **r["measured"]["versions"]}.items()
    }
    names = ("jaxlib", "diffrax", "scipy", "numpy", "heyoka")
    shown = ", ".join(f"{k} {versions[k]}" for k in names if k in versions)
    parts.append(f"{provenance(found | laws)} Also {shown}.")
    between_markers(TABLES, "work-precision", "\n\n".join(parts))


def main(argv: Sequence[str] | None = None) -> None:
    run_pieces(__doc__ or "", PIECES, "work-precision", tables, argv, QUICK)


if __name__ == "__main__":
    main()
