"""The textbook of laws by PySINDy, on the same data as ours: which equations come out.

    python benchmarks/textbook_peers.py                 every law that has no result yet
    python benchmarks/textbook_peers.py --only kepler   one of them
    python benchmarks/textbook_peers.py --quick         two of them, into runs/

Of 1,000 clean pairs PySINDy is given what they say best of ż: (z₁ − z₀)/dt at the middle of each,
wrong by O(dt²). Of 40 sequences of 50 states with noise of 1e-3 of the spread it differentiates
itself, smoothed. Two libraries: its default, polynomials of degree 2 with its default threshold;
and by hand the very functions of which ż of the law consists, constants inside as they are (ours is
told none of it), beside polynomials of degree 3, at the threshold whose structure is exact, if any
is, else whose ż is best. Equations are exact in structure where each has the law's own functions
and no others. ż is held against the true one as ∇H of ours is, at states of a box that is a fifth
wider.

Needs pip install '.[peers]'.
"""

from __future__ import annotations

import time
import warnings
from functools import partial
from typing import Any

import numpy as np
from harness import SEED, TABLES, Numbers, between_markers, main, markdown, number, provenance
from harness import results as read_results
from textbook import FRESH, NOISE, PAIRS, SEQUENCES, STATES, WIDER
from textbook import NOISY as OURS_NOISY
from textbook import PIECES as OURS
from textbook_laws import LAWS, Law

from gfnn_jax.families.terms import exponents, given_terms
from gfnn_jax.phase_space import apply_j

THRESHOLDS = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3)
_SEEN = 400  # states that tell functions apart
# A drive is no part of a default library, and of many degrees of freedom it has too many terms.
NAMES = tuple(n for n, law in LAWS.items() if law.period is None and law.dim <= 3)


class Library:
    """The functions of which ż of the law consists, and all polynomials of degree 3, each once.

    true: (2d, functions) which of them each equation has.
    """

    def __init__(self, law: Law):
        self._law, self._kept = law, np.arange(0)
        z = law.states(_SEEN, np.random.default_rng(SEED + 3))
        every = self._every(z)
        unit = every / np.maximum(np.linalg.norm(every, axis=0), 1e-300)
        kept: list[int] = []
        for k in range(every.shape[1]):
            alike = np.abs(unit[:, kept].T @ unit[:, k]) > 1 - 1e-10
            if np.any(every[:, k]) and not alike.any():
                kept.append(k)
        self._kept = np.array(kept)
        c = np.linalg.lstsq(self(z), apply_j(law.gradient(z)), rcond=1e-12)[0]
        self.true = np.abs(c.T) > 1e-8

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """(N, functions) at states z (N, 2d)."""
        return self._every(z)[:, self._kept]

    def _every(self, z: np.ndarray) -> np.ndarray:
        own = given_terms(self._law.dim, list(self._law.terms)).term_gradients(z)
        powers = [np.prod(z ** np.array(row), axis=1) for row in exponents(z.shape[1], 3)]
        return np.column_stack([own.reshape(len(z), -1), *powers, np.ones(len(z))])


def judged(found: np.ndarray, law: Law, z: np.ndarray) -> float:
    """The RMS of what ż (N, 2d) at z is off by ÷ that of ż."""
    true = apply_j(law.gradient(z))
    return float(np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)))


def by_hand(law: Law, z: np.ndarray, rate: np.ndarray, fresh: np.ndarray) -> Numbers:
    """Sparse regression on the library."""
    import pysindy as ps

    library, tried = Library(law), []
    columns, there = library(z), library(fresh)
    for threshold in THRESHOLDS:
        sparse = ps.STLSQ(threshold=threshold, alpha=1e-10)
        sparse.fit(columns, rate)
        exact = bool(np.array_equal(sparse.coef_ != 0, library.true))
        tried.append((not exact, judged(there @ sparse.coef_.T, law, fresh), threshold))
    inexact, off, threshold = min(tried)
    return {"exact": not inexact, "field_error": off, "threshold": threshold}


def by_default(law: Law, model, fresh: np.ndarray) -> Numbers:
    """PySINDy's equations as they come out."""
    return {
        "exact": polynomial_structure(law, model),
        "field_error": judged(np.asarray(model.predict(fresh)), law, fresh),
        "functions": int(np.count_nonzero(model.coefficients())),
    }


def polynomial_structure(law: Law, model) -> bool:
    """Whether each equation has the monomials that the law's has; never of a law with others."""
    rng = np.random.default_rng(SEED + 3)
    z = law.states(_SEEN, rng)
    library = np.asarray(model.feature_library.transform(z))
    true = apply_j(law.gradient(z))
    c, *_ = np.linalg.lstsq(library, true, rcond=1e-12)
    if np.abs(library @ c - true).max() > 1e-8 * np.abs(true).max():
        return False
    return bool(np.all((np.abs(c.T) > 1e-8) == (model.coefficients() != 0)))


def measured(name: str, quick: bool) -> Numbers:
    """One law, of pairs and of noisy sequences."""
    import pysindy as ps

    law, found = LAWS[name], {}
    fresh = law.states(FRESH, np.random.default_rng(SEED + 2), WIDER)
    pairs = law.pairs(PAIRS, SEED)
    noisy = law.sequences(SEQUENCES, STATES, NOISE, SEED)
    orbits = [
        np.concatenate([noisy.z0[rows], noisy.z1[rows[-1:]]])
        for rows in np.arange(len(noisy)).reshape(SEQUENCES, STATES - 1)
    ]
    middle, rate = 0.5 * (pairs.z0 + pairs.z1), (pairs.z1 - pairs.z0) / law.dt
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        busy = time.process_time()
        found["pairs_by_hand"] = by_hand(law, middle, rate, fresh)
        model = ps.SINDy()
        model.fit(middle, t=law.dt, x_dot=rate)
        found["pairs_default"] = by_default(law, model, fresh)
        smooth: Any = ps.SmoothedFiniteDifference()
        rates = [np.asarray(smooth(orbit, law.dt)) for orbit in orbits]
        states = np.concatenate([smooth.smoother(o, **smooth.smoother_kws) for o in orbits])
        found["noise_by_hand"] = by_hand(law, states, np.concatenate(rates), fresh)
        model = ps.SINDy(differentiation_method=smooth)
        model.fit(orbits, t=law.dt)
        found["noise_default"] = by_default(law, model, fresh)
        found["processor_seconds"] = time.process_time() - busy
    return {"pysindy": ps.__version__, **found}


PIECES = {name: partial(measured, name) for name in NAMES}


def tables() -> None:
    """The results between their markers, beside ours."""
    found = read_results(PIECES, "textbook-peers")
    if not found:
        return
    ours = read_results({n: OURS[n] for n in found}, "textbook")
    noisy = read_results({n: OURS_NOISY[n] for n in found}, "textbook-noise")

    def cell(exact: bool, off: float | None) -> str:
        return f"{'exact' if exact else 'no'}, {number(off)}"

    def own(results: dict, name: str) -> str:
        m = results[name]["measured"] if name in results else None
        return "–" if m is None else cell(m["found"], m["gradient_error"])

    kinds = ("pairs_by_hand", "pairs_default", "noise_by_hand", "noise_default")
    rows = []
    for name, r in found.items():
        theirs = [cell(r["measured"][k]["exact"], r["measured"][k]["field_error"]) for k in kinds]
        rows.append([name, own(ours, name), *theirs[:2], own(noisy, name), *theirs[2:]])
    heads = (
        "law",
        "pairs: ours, told nothing",
        "PySINDy by hand",
        "its default",
        "noise: ours, told nothing",
        "PySINDy by hand",
        "its default",
    )
    exact = [sum(r["measured"][k]["exact"] for r in found.values()) for k in kinds]
    counted = (
        f"Structures that are exact, of {len(found)}: PySINDy by hand {exact[0]} of pairs and "
        f"{exact[2]} behind noise, its default {exact[1]} and {exact[3]}."
    )
    between_markers(
        TABLES, "textbook-peers", "\n\n".join([markdown(heads, rows), counted, provenance(found)])
    )


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "textbook-peers", tables, None, ("kepler", "duffing"))
