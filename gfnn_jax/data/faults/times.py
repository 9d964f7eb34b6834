"""Times in several units, clocks that drift, and runs that do not belong together."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gfnn_jax.data.different_systems import different_systems
from gfnn_jax.data.faults.fault import Fault
from gfnn_jax.data.traits import Traits
from gfnn_jax.signals.steps import drift

_DRIFT = 5e-3  # relative change of the step over a run


def units(traits: Traits) -> Iterator[Fault]:
    """Runs whose steps are a thousandfold those of the others."""
    for run, t in zip(traits.recording.runs, traits.times, strict=True):
        step = float(np.median(np.diff(t))) if len(t) > 2 else traits.step
        power = np.log10(step / traits.step) / 3
        if abs(power) > 0.9 and abs(power - round(power)) < 0.02:
            found = f"the steps of run {run} are {step:g} s, those of others {traits.step:g} s"
            yield Fault("time unit", found, "Give its times in the unit of the others")


def drifting(traits: Traits) -> Iterator[Fault]:
    drifts = {run: drift(t) for run, t in zip(traits.recording.runs, traits.times, strict=True)}
    run = max(drifts, key=lambda name: abs(drifts[name]))
    if abs(drifts[run]) > _DRIFT:
        yield Fault(
            "drifting clock",
            f"the time step drifts by {100 * drifts[run]:.2g} % along run {run}",
            f"If the samples are even and the clock drifts, give even steps: --dt {traits.step:g}",
        )


def systems(traits: Traits) -> Iterator[Fault]:
    runs = different_systems(traits)
    if runs:
        yield Fault(
            "different systems",
            f"runs {', '.join(runs[:8])} do not follow the law of the others",
            "Check their units and signs, name what differs (--parameters), or fit them apart",
        )


def reading(traits: Traits) -> Iterator[Fault]:
    for note in traits.recording.notes:
        yield Fault("reading", note, "", wrong=False)
