"""``python -m gfnn_jax`` is ``gfnn``."""

import sys

from gfnn_jax.cli import process

sys.exit(process())
