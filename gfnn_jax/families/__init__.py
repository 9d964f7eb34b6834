"""Families of scalar functions f(params, w, args), of which S and H are made."""

from gfnn_jax.families.family import Family, LinearFamily, as_family, from_function

__all__ = ["Family", "LinearFamily", "as_family", "from_function"]
