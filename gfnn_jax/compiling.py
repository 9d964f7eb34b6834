"""Compilation by XLA: options that shorten it, and a cache on disk between processes."""

import os
import sys
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any

# XLA's emitters of fused loops take a third to a half of what a step takes to compile, and its
# steps run no faster by them (jaxlib 0.10.2 on two cores; benchmarks/speed.py --only start).
_SOONER = {"xla_cpu_use_fusion_emitters": False}
# This option halves what is left of the compile time; such programs run several times slower.
_SOONEST = {**_SOONER, "xla_backend_optimization_level": 0}


# Who is told what is compiled now, the last of them: a job that shows its progress.
told: list[Callable[[str], object]] = []


def say(message: str) -> None:
    """Say what is compiled now, "" when it is done: on standard error where nobody is `told`."""
    if told:
        told[-1](message)
    elif message:
        print(f"gfnn_jax: {message}", file=sys.stderr, flush=True)


def enable_compile_cache(folder: str | Path | None = None) -> Path:
    """Keep compiled programs in ``folder``, so that the next process need not compile them again.

    folder: with None, the folder that JAX is configured for, else ``gfnn_jax`` in
    ``$XDG_CACHE_HOME`` or ``~/.cache``. Returns the folder. Programs compiled before the call are
    not kept.
    """
    import jax  # loaded when first used: `gfnn --help` needs none
    from jax.experimental.compilation_cache import compilation_cache

    configured = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None and configured is not None:
        return Path(configured)
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gfnn_jax"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()  # JAX looks only once whether there is one
    return Path(folder)


def compiled_sooner(
    function: Callable, static_argnums: tuple[int, ...] = (), *, seldom_run: bool = False
) -> Callable:
    """Compile like ``jax.jit(function, static_argnums)``, on a CPU with options that save time.

    The options apply where the function is called with numbers. Inside another transformation, the
    outer function's options apply.
    seldom_run: True prefers a short compilation to a fast program.
    """
    import jax  # loaded when first used: `gfnn --help` needs none
    from jax.core import Tracer

    jitted = partial(jax.jit, function, static_argnums=static_argnums)
    plain, sooner = jitted(), jitted(compiler_options=_SOONEST if seldom_run else _SOONER)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        nonlocal sooner
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments))
        if traced or jax.default_backend() != "cpu":
            return plain(*arguments)
        try:
            return sooner(*arguments)
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            sooner = plain  # a release of XLA that has only one kind of emitter
            return plain(*arguments)

    return call
