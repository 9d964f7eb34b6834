"""Strict numerics for every test: float64, no silent rank or dtype promotion, shapes checked."""

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
install_import_hook("gfnn_jax", "beartype.beartype")


@pytest.fixture
def as_a_user(tmp_path, monkeypatch):
    """A user's session: JAX as it comes, but for float64; the cache of compiled code elsewhere."""
    before = {name: getattr(jax.config, name) for name in
              ("jax_numpy_rank_promotion", "jax_numpy_dtype_promotion",
               "jax_compilation_cache_dir")}  # fmt: skip
    jax.config.update("jax_numpy_rank_promotion", "allow")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield
    for name, value in before.items():
        jax.config.update(name, value)
