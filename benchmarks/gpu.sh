#!/usr/bin/env bash
# The rows of a GPU, in eight minutes at most, written to benchmarks/results and RESULTS.md.
# gfnn_jax and JAX's CUDA wheels are installed: pip install '.[cuda13]'
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" XLA_PYTHON_CLIENT_PREALLOCATE=false
exec timeout 480 "${PYTHON:-python3}" benchmarks/gpu.py --overwrite "$@"
