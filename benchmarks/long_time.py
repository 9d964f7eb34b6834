"""A million steps: an orbit, a top and a storage ring in one figure, for docs/results.md.

    python benchmarks/long_time.py    what has no result yet is measured (ten minutes), then drawn

The panels are results of `kepler.py`, `bracket_maps.py` and `storage_ring.py` (which needs PyAT).
"""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
from harness import FIGURES, PAGE, RESULTS, Numbers, between_markers, number, read

from gfnn_jax.evaluate.figures_style import COLOURS, HEIGHT, WIDTH, save, style

LEARNED, NETWORK, INTEGRATOR = "learned map", "learned vector field", "integrator, H known"
WITH_BRACKET, WITHOUT = "law with its bracket", "field through Runge–Kutta 4"
STUDIES = {"kepler": "million-steps", "bracket_maps": "beside", "ring": "long"}
SCRIPTS = {"ring": "storage_ring"}  # whose name is not the prefix of its results


def measured() -> dict[str, Numbers]:
    """What each study measured; those without a curve are left out."""
    found = read({study: RESULTS / f"{study}-{piece}.json" for study, piece in STUDIES.items()})
    own = {study: result["measured"] for study, result in found.items()}
    return {study: one for study, one in own.items() if study != "ring" or "curve" in one}


def orbit(ax, found: Numbers) -> str:
    """Draw the errors of the orbit, and describe them."""
    for name, colour in zip((LEARNED, NETWORK, INTEGRATOR), COLOURS, strict=False):
        curve = found["methods"][name]["curve"]
        error = np.mean(curve["error"], axis=0)
        ax.loglog(curve["steps"], error, color=colour, label=name)
    ax.set(title="two bodies", xlabel="step", ylabel="error of the position")
    own, network, integrator = (found["methods"][n] for n in (LEARNED, NETWORK, INTEGRATOR))
    return (
        f"Two bodies, {own['num_steps']:,} steps of 0.1, about 16,000 revolutions: mean error of "
        f"{found['num_orbits']} orbits that no fit has seen. Learned map: {own['pairs']:,} pairs, "
        f"{own['num_parameters']:,} parameters, {number(own['error_end'])} at the end, the "
        f"semi-major axis within {number(own['axis_end'])}, "
        f"{number(own['microseconds_per_step'])} µs a step. Learned vector field (VFNN): "
        f"{network['pairs']:,} pairs, {network['num_parameters']:,} parameters, "
        f"{network['num_steps']:,} steps. Integrator that is given H: order 4, ten substeps to a "
        f"step, {number(integrator['error_end'])} at the end."
    )


def top(ax, found: Numbers) -> str:
    """Draw the changes of the top's Casimir, and describe them."""
    for name, colour in ((WITH_BRACKET, COLOURS[0]), (WITHOUT, COLOURS[1])):
        change = np.maximum(found[name]["casimirs"], np.finfo(float).eps)
        ax.loglog(found[name]["steps"], change, color=colour, label=name)
    ax.set(title="free top", xlabel="step", ylabel="change of |M|, relative")
    own, other = found[WITH_BRACKET], found[WITHOUT]
    return (
        f"A free top from 400 pairs, {own['steps'][-1]:,} steps: |M|, the length of its angular "
        f"momentum and a Casimir, changes by {number(own['casimir'])} with the bracket and by "
        f"{number(other['casimir'])} by a quadratic field fitted to the same pairs."
    )


def ring(ax, found: Numbers) -> str:
    """Draw the change of a particle's action in the ring, and describe it."""
    turns, change = found["curve"]["turns"], found["curve"]["change"]
    ax.loglog(turns, change, color=COLOURS[0], label=LEARNED)
    ax.set(title="storage ring", xlabel="turn", ylabel="change of the mean action, relative")
    ax.set_ylim(1e-5, 1e-1)
    return (
        f"{found['particles']} particles in a real lattice with errors, {found['turns']:,} turns: "
        f"the action, averaged over {turns[0]:,} turns, changes by "
        f"{number(found['change_at_the_end'])} and does not grow (exponent "
        f"{number(found['drift_exponent'])})."
    )


def draw() -> None:
    """Draw the figure, and its caption, of what has been measured."""
    from matplotlib.figure import Figure

    found = measured()
    if not found:
        return
    with style():
        figure = Figure(figsize=(0.85 * WIDTH * len(found), HEIGHT), layout="constrained")
        axes = np.ravel(figure.subplots(1, len(found)))
        panels = {"kepler": orbit, "bracket_maps": top, "ring": ring}
        said = [
            panels[study](ax, one) for ax, (study, one) in zip(axes, found.items(), strict=True)
        ]
        for ax in axes:
            ax.legend(fontsize="small")
        save(figure, FIGURES / "long_time.png")
    caption = f"*{' '.join(said)} Drawn by `benchmarks/long_time.py`.*"
    between_markers(PAGE, "long-time", textwrap.fill(caption, 100, break_long_words=False))


if __name__ == "__main__":
    for study, piece in STUDIES.items():
        if not (RESULTS / f"{study}-{piece}.json").exists():
            script = Path(__file__).with_name(f"{SCRIPTS.get(study, study)}.py")
            subprocess.run([sys.executable, str(script), "--only", piece], check=True)
    draw()
