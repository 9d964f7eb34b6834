"""Pairs that differ in more than their states: in the time between them, in parameters.

A generating function is that of one map; a Hamiltonian serves any dt and, as a function of the
parameters too, any system of the family.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.expressions import check_names
from gfnn_jax.learn.choose_charts import Charts
from gfnn_jax.learn.diagnosed import Diagnosis
from gfnn_jax.learn.prepare import Prepared
from gfnn_jax.phase_space import Pairs, sizes

_SAME = 1e-9  # of its size: a parameter, or a dt, that varies by less does not


def check_varied(pairs: Pairs, *, learn: str, family: str, chart: str, base) -> None:
    """Raises FitError, in one line, for a dt or args that cannot be used, or a request for S."""
    args = pairs.args or {}
    try:
        check_names(pairs.dim, tuple(args))
    except InputError as error:
        raise FitError(str(error)) from error
    columns = {"dt": np.asarray(pairs.dt)} if np.ndim(pairs.dt) else {}
    for name, values in {**columns, **args}.items():
        if np.asarray(values).dtype.kind not in "fiu":
            raise FitError(f"expected {name} of real numbers, got {np.asarray(values).dtype}")
        bad = ~np.isfinite(values) | (values <= 0 if name == "dt" else False)
        if bad.any():
            what = "finite time steps above 0" if name == "dt" else f"finite values of {name}"
            row = int(np.argmax(bad))
            raise FitError(
                f"expected {what}, got {int(bad.sum())} of {len(bad)} that are not, the first is "
                f"{values[row]} in row {row}"
            )
    if learn == "map" or (family, chart) != ("auto", "auto") or base is not None:
        what = "dt" if columns else "parameters"
        raise FitError(
            f"the pairs differ in their {what}: expected learn='auto' or 'hamiltonian', and no "
            "family, chart or base, for S is that of one dt and of one system"
        )


def without_constants(pairs: Pairs) -> tuple[Pairs, list[str]]:
    """The pairs as they vary: a dt that is the same in all is one number, a parameter that is the
    same in all is none, and said so."""
    dt = np.asarray(pairs.dt)
    one = float(np.mean(dt)) if dt.ndim and np.ptp(dt) <= _SAME * np.mean(dt) else pairs.dt
    args = {name: np.asarray(v, np.float64) for name, v in (pairs.args or {}).items()}
    still = [name for name, v in args.items() if np.ptp(v) <= _SAME * np.abs(v).max()]
    kept = {name: v for name, v in args.items() if name not in still}
    messages = [
        f"the parameter {name} is {args[name][0]:g} in all pairs: it is left out, for its effect "
        "is not known"
        for name in still
    ]
    return Pairs(pairs.z0, pairs.z1, one, kept or None), messages


def given_by(prepared: Prepared) -> np.ndarray | None:
    """What a pair's move depends on beside its state, (N, k) of unit sizes; None for nothing."""
    if not prepared.varied:
        return None
    columns = [] if prepared.own_dt is None else [prepared.own_dt]
    columns += [] if prepared.args is None else list(prepared.args.T)
    given = np.column_stack(columns)
    return given / sizes(given)


def undiagnosed(prepared: Prepared) -> Diagnosis:
    """Pairs of more than one map have no Jacobians that neighbours tell, and no charts."""
    return Diagnosis(prepared, Charts([], None, {}, []), float("nan"), [])
