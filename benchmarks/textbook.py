"""A textbook of laws, told nothing but pairs: which formulas come out, how exact, in what time.

    python benchmarks/textbook.py                   every law that has no result yet
    python benchmarks/textbook.py --only kepler     one of them
    python benchmarks/textbook.py --quick           four of them, into runs/

Each law of `textbook_laws` is learned from 1,000 clean pairs, told nothing but which coordinates
are angles and the period of a drive. A law is found where ∇H agrees with the true one to 1e-8 at
states of a box that is a fifth wider than that of the pairs, with no more terms than the truth has.
Of the laws outside of every library, a formula that is chosen is counted as false.

`textbook_noise.py` learns each from 40 sequences of 50 states with normal noise of 1e-3 of the
spread. Its structure is exact where its own terms, with other coefficients and constants, are the
true H: those numbers are fitted to the true gradients, where they must leave no more than 1e-8, and
are what the law's own are held against, in units of their standard errors.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from functools import partial

import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    main,
    markdown,
    number,
    provenance,
    results,
)
from scipy.optimize import least_squares
from textbook_laws import LAWS, OUTSIDE, Law

import gfnn_jax as gfnn
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.models.textbook import shapes as texts

PAIRS, FRESH, WIDER = 1_000, 200, 1.2
FEW = 200  # pairs of the law that is also followed over STEPS steps
STEPS, FOLLOWED = 1_000, 20
TOLERANCE, BUDGET = 1e-8, 60.0
EXACT = 1e-8
SEQUENCES, STATES, NOISE = 40, 50, 1e-3


def fitted(law: Law, pairs: gfnn.Pairs, tolerance: float) -> tuple[gfnn.Fit, Numbers]:
    """The fit of these pairs of a law, and what is measured of any: the formula, the error of a
    step from fresh states, the processor's seconds."""
    busy = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(
            pairs,
            tolerance=tolerance,
            angles=law.angles,
            seed=SEED,
            max_seconds=BUDGET,
            clock=time.process_time,
        )
    busy = time.process_time() - busy
    fresh = law.pairs(FRESH, SEED + 1)
    t0 = {} if law.period is None else {"t0": fresh.t0}
    error = np.asarray(fit.map.step(fresh.z0, **t0)[0]) - fresh.z1
    found = fit.hamiltonian
    return fit, {
        "kind": law.kind,
        "dim": law.dim,
        "pairs": len(pairs),
        "label": fit.chosen.label,
        "chosen": fit.chosen.learns,
        "formula": None if found is None else found.formula,
        "gradient_error": None if found is None else gradient_error(found.flow, law),
        "terms": None if found is None else len(found.terms),
        "true_terms": law.size or len(law.terms),
        "one_step_rms": float(np.sqrt(np.mean(error**2))),
        "processor_seconds": busy,
        "compile_seconds": fit.compile_seconds,
        "ended": fit.ended,
        "messages": list(fit.messages),
    }


def learned(law: Law, count: int = PAIRS) -> tuple[gfnn.Fit, Numbers]:
    """The fit of pairs of this law, and its verdict."""
    fit, measured = fitted(law, law.pairs(count, SEED), TOLERANCE)
    off, terms = measured["gradient_error"], measured["terms"]
    found = off is not None and off <= EXACT and (terms or 0) <= measured["true_terms"]
    return fit, {**measured, "found": found, "tolerance_met": bool(fit.met)}


def gradient_error(flow: Flow, law: Law) -> float | None:
    """The RMS of ∇H − ∇H_true ÷ that of ∇H_true, at states of a wider box."""
    rng = np.random.default_rng(SEED + 2)
    z = law.states(FRESH, rng, WIDER)
    t = None if law.period is None else rng.uniform(0, law.period, FRESH)
    true = law.gradient(z, t)
    try:
        found = flow.family.gradient(
            np.asarray(flow.params), z, *([] if t is None else [t[:, None]])
        )
    except (ValueError, IndexError):  # with friction, or of something else than states
        return None
    return float(
        np.sqrt(np.mean((np.asarray(found)[..., : 2 * law.dim] - true) ** 2))
        / np.sqrt(np.mean(true**2))
    )


def measured(name: str, quick: bool) -> Numbers:
    """One law."""
    return learned({**LAWS, **OUTSIDE}[name])[1]


def kepler_few(quick: bool) -> Numbers:
    """Kepler's law from 200 pairs, and its orbits over 1,000 steps."""
    law = LAWS["kepler"]
    fit, found = learned(law, FEW)
    # Bound orbits that keep away from the centre, nearly circular ones.
    rng = np.random.default_rng(SEED + 3)
    radius, turn, speed = (rng.uniform(*r, FOLLOWED) for r in ((0.9, 1.4), (0, 6.28), (0.9, 1.1)))
    speed = speed / np.sqrt(radius)
    cos, sin = np.cos(turn), np.sin(turn)
    z0 = np.stack([radius * cos, radius * sin, -speed * sin, speed * cos], axis=1)
    reference = law.followed(z0, STEPS)
    states = np.asarray(fit.map.rollout(z0, STEPS, save_every=STEPS)[0])[:, -1]
    error = np.linalg.norm((states - reference)[:, :2], axis=1)
    return {
        **found,
        "steps": STEPS,
        "error_median": float(np.median(error)),
        "error_worst": float(error.max()),
    }


# Of noisy sequences


def noisy(name: str, quick: bool) -> Numbers:
    """One law of noisy sequences."""
    law = LAWS[name]
    fit, measured = fitted(law, law.sequences(SEQUENCES, STATES, NOISE, SEED), NOISE)
    found = fit.hamiltonian
    true = None if found is None else true_numbers(found, law)
    fewest = measured["true_terms"]
    exact = bool(found and true and true[1] <= EXACT and len(found.terms) <= fewest)
    off = None
    if found is not None and true is not None and exact:
        numbers = [*found.terms, *found.constants]
        off = [(t.coefficient - x) / t.std for t, x in zip(numbers, true[0], strict=True)]
    return {**measured, "found": exact, "standard_errors": off}


def true_numbers(found, law: Law) -> tuple[np.ndarray, float] | None:
    """The coefficients and constants with which the terms that were found come nearest to the true
    ∇H, and the part of it that they leave over. None of what is no expression in q and p, nor the
    Legendre transform of one in q and v."""
    family = found.flow.family
    rng = np.random.default_rng(SEED + 2)
    z = law.states(FRESH, rng)
    t = None if law.period is None else rng.uniform(0, law.period, FRESH)
    true = law.gradient(z, t)
    if isinstance(family, Legendre):
        size = np.linalg.norm(true)
        near = least_squares(
            lambda c: (np.asarray(family.gradient(c, z)) - true).ravel() / size,
            np.array([term.coefficient for term in found.terms]),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        return near.x, float(np.linalg.norm(near.fun))
    if not isinstance(family, Terms):
        return None
    start = np.array([c.coefficient for c in found.constants])

    def solved(constants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        variables = list(family.variables)
        for own, value in zip(found.constants, constants, strict=True):
            k = family.variables.index(own.term)
            written = texts.number(abs(own.coefficient))
            variables[k] = variables[k].replace(written, texts.number(abs(value)))
        moved = dataclasses.replace(family, variables=tuple(variables))
        args = None if t is None else t[:, None]
        columns = moved.term_gradients(z, args)[:, : 2 * law.dim].reshape(true.size, -1)
        size = np.linalg.norm(columns, axis=0)
        c = np.linalg.lstsq(columns / size, true.ravel(), rcond=1e-14)[0] / size
        return c, (columns @ c - true.ravel()) / np.linalg.norm(true)

    constants = start
    if len(start):
        constants = (
            least_squares(
                lambda x: solved(x * start)[1],
                np.ones(len(start)),
                xtol=1e-15,
                ftol=1e-15,
                gtol=1e-15,
            ).x
            * start
        )
    c, left = solved(constants)
    return np.concatenate([c, constants]), float(np.linalg.norm(left))


def noisy_tables() -> None:
    """The results of noisy sequences between their markers."""
    found = results(NOISY, "textbook-noise")
    if not found:
        return
    rows = []
    for name, r in found.items():
        m = r["measured"]
        off = m["standard_errors"]
        rows.append(
            [
                name,
                m["kind"],
                str(m["dim"]),
                "exact" if m["found"] else "another" if m["chosen"] == "hamiltonian" else "a map",
                number(m["gradient_error"]),
                str(m["terms"] or "–"),
                str(m["true_terms"]),
                "–" if off is None else number(float(np.max(np.abs(off)))),
                number(m["one_step_rms"]),
                number(m["processor_seconds"]),
            ]
        )
    heads = (
        "law",
        "kind",
        "d",
        "structure",
        "∇H off by",
        "terms",
        "true terms",
        "worst number ÷ its standard error",
        "one-step RMS",
        "CPU s",
    )
    of_laws = [r["measured"] for r in found.values()]
    off = np.concatenate([np.abs(m["standard_errors"]) for m in of_laws if m["standard_errors"]])
    counted = (
        f"The structure of {sum(m['found'] for m in of_laws)} of {len(of_laws)} laws is found; "
        f"{np.mean(off <= 3):.0%} of their {len(off)} coefficients and constants are within three "
        f"standard errors, {np.mean(off <= 1):.0%} within one."
    )
    between_markers(
        TABLES, "textbook-noise", "\n\n".join([markdown(heads, rows), counted, provenance(found)])
    )


NOISY = {name: partial(noisy, name) for name in LAWS}
PIECES = {"kepler-few": kepler_few, **{n: partial(measured, n) for n in (*LAWS, *OUTSIDE)}}
QUICK = ("kepler", "relativistic", "duffing", "arctangent")


def tables() -> None:
    """The results between their markers."""
    found = results(PIECES, "textbook")
    if not found:
        return
    rows = []
    for name, r in found.items():
        m = r["measured"]
        chosen = m["chosen"] == "hamiltonian"
        verdict = "exact" if m["found"] else "approximate" if chosen else "a map"
        rows.append(
            [
                name,
                m["kind"],
                str(m["dim"]),
                verdict,
                number(m["gradient_error"]),
                str(m["terms"] or "–"),
                str(m["true_terms"]),
                number(m["one_step_rms"]),
                number(m["processor_seconds"]),
            ]
        )
    heads = (
        "law",
        "kind",
        "d",
        "verdict",
        "∇H off by",
        "terms",
        "true terms",
        "one-step RMS",
        "CPU s",
    )
    of_laws = [r["measured"] for n, r in found.items() if n in LAWS]
    outside = [r["measured"] for n, r in found.items() if n in OUTSIDE]
    false = sum(m["chosen"] == "hamiltonian" for m in outside)
    counted = (
        f"{sum(m['found'] for m in of_laws)} of {len(of_laws)} laws are found exactly; of "
        f"{len(outside)} laws outside of every library {false} came out as a formula."
    )
    between_markers(
        TABLES, "textbook", "\n\n".join([markdown(heads, rows), counted, provenance(found)])
    )


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "textbook", tables, None, QUICK)
