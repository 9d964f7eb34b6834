"""Compiled programs kept between processes, in a folder of the user's cache."""

from __future__ import annotations

import os
from pathlib import Path


def enable_compile_cache(folder: str | Path | None = None) -> Path:
    """Keep compiled programs in ``folder``, so that the next process need not compile them again.

    folder: None: the one that JAX is configured for, else ``gfnn_jax`` in ``$XDG_CACHE_HOME`` or
    ``~/.cache``. Returns the folder. What was compiled before the call is not kept.
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
