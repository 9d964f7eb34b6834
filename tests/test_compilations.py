"""Number of XLA programs of an answer, which take most of the time to a first answer."""

import subprocess
import sys
import textwrap

COUNTED = """
    import jax, numpy as np
    jax.config.update("jax_enable_x64", True)
    import gfnn_jax as gfnn

    compiled = []

    def count(event, duration, **_):
        if event == "/jax/core/compile/jaxpr_to_mlir_module_duration":
            compiled.append(duration)

    jax.monitoring.register_event_duration_secs_listener(count)

    def pairs(seed):
        z = np.random.default_rng(seed).uniform(-1, 1, (500, 2))
        p = z[:, 1] + 0.3 * np.sin(z[:, 0])
        return gfnn.Pairs(z, np.stack([z[:, 0] + 0.3 * p, p], axis=1), 0.3)

    def counted(work):
        before = len(compiled)
        found = work()
        print(len(compiled) - before)
        return found

    fit = counted(lambda: gfnn.fit(pairs(0), tolerance=1e-4))
    z0 = np.zeros((10, 2)) + 0.1
    counted(lambda: fit.map.rollout(z0, 100))
    again = counted(lambda: gfnn.fit(pairs(1), tolerance=1e-4))
    assert again.chosen.label == fit.chosen.label, (again.chosen.label, fit.chosen.label)
    counted(lambda: again.map.rollout(z0 + 0.1, 100))
"""

# What a fit, a rollout after it, a second fit and a second rollout of the same shapes compile.
# A change that raises one of these makes the first answer slower for everyone.
MOST = (1, 1, 0, 0)


def test_a_fit_compiles_one_step_and_a_second_fit_nothing():
    ran = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(COUNTED)], capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    found = tuple(map(int, ran.stdout.split()))
    assert len(found) == len(MOST)
    assert all(n <= most for n, most in zip(found, MOST, strict=True)), found
