"""A real pendulum by the protocol of D-HNN: the errors of its vector field and of its energy.

    python benchmarks/real_pendulum.py

A. Sosanya and S. Greydanus, *Dissipative Hamiltonian neural networks*, arXiv 2201.10085: states are
(θ, ω) as the record has them, rates their differences from sample to sample, means of two
neighbours; the first four fifths train, the last fifth tests. They report mean squares of 9.46e-4
of the rates and 1.07e-3 of the energy 2.4 (1 − cos θ) + ω² along an orbit.

What differs here: the record is the part that comes with the package, which may lack the end of the
one they used. The law is learned from θ alone, and its own differences over the same steps are what
is compared; ω is a filtered difference of its authors, whose factor is that of the training
samples. The orbit starts from the state that the training samples tell; which state theirs starts
from is not stated.
"""

from __future__ import annotations

import jax
import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.maps.laws import law_of_map

TRAINED = 0.8


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    record = pd.read_csv(gfnn.records.path("pendulum"))
    t, x = record["t"].to_numpy(), record[["theta", "omega"]].to_numpy()
    one_sided = np.diff(x, axis=0) / np.diff(t)[:, None]
    rates = np.concatenate([0.5 * (one_sided[:-1] + one_sided[1:]), one_sided[-1:]])
    last = int(TRAINED * len(t))  # of the samples that train
    known = gfnn.Recording(
        {"t": t[: last + 1], "theta": x[: last + 1, 0]}, positions=["theta"], angles=["theta"]
    )
    fit = gfnn.fit(known)
    law = law_of_map(fit.map)

    def rate(_, state):
        return [state[1], *law.acceleration(state[None, :1], state[None, 1:])[0]]

    def orbit(state, times):
        return solve_ivp(
            rate, (times[0], times[-1]), state, t_eval=times, rtol=1e-9, atol=1e-10
        ).y.T

    v = (x[2 : last + 1, 0] - x[: last - 1, 0]) / (t[2 : last + 1] - t[: last - 1])
    units = np.array([1.0, v @ x[1:last, 1] / (v @ v)])  # of ω: its factor
    missed = []
    for k in range(last + 1, len(t) - 1):
        here = x[k] / units
        before, after = (orbit(here, [t[k], t[n]])[-1] for n in (k - 1, k + 1))
        own = 0.5 * ((here - before) / (t[k] - t[k - 1]) + (after - here) / (t[k + 1] - t[k]))
        missed.append(own * units - rates[k - 1])
    print(f"{fit.formula}; factor of ω {units[1]:.3f}")
    print(f"vector field: {np.mean(np.square(missed)):.3g} (D-HNN 9.46e-4)")

    def energy(states):
        return 2.4 * (1 - np.cos(states[:, 0])) + states[:, 1] ** 2

    start = np.asarray(fit.map.estimate(known)[0])[0]
    for name, state, first in (
        ("that the training samples tell", start, last),
        ("of the first test sample alone", x[last + 1] / units, last + 1),
    ):
        error = energy(orbit(state, t[first:])[1:] * units) - energy(x[first + 1 :])
        print(f"energy from the state {name}: {np.mean(error**2):.3g} (D-HNN 1.07e-3)")


if __name__ == "__main__":
    main()
