"""Strict numerics for every test: float64, no silent rank or dtype promotion."""

import contextlib
import gc
import importlib
import itertools
import os
import signal
import subprocess
import sys
import types

import jax
import numpy as np
import pytest
import scipy.linalg  # noqa: F401, its threads are limited too
from threadpoolctl import threadpool_limits

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


# Most of the suite's time goes into compiling programs that run once: this halves it. A program
# that is split to be compiled by several threads takes half as much again of a processor's time.
SOON_COMPILED = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    " --xla_cpu_parallel_codegen_split_count=1"
)


def pytest_addoption(parser):
    parser.addoption(
        "--typecheck",
        action="store_true",
        help="check the types and shapes of the package's annotations at run time: slow to trace",
    )


def _takes_flags(cache):
    """Whether this XLA knows the flags: it ends a process that asks for what it does not know."""
    key = f"xla/{jax.__version__} {SOON_COMPILED}".replace(" ", "")
    if cache.get(key, None) is None:
        command = [sys.executable, "-c", "import jax; jax.devices()"]
        env = {**os.environ, "XLA_FLAGS": SOON_COMPILED}
        tried = subprocess.run(command, capture_output=True, check=False, env=env)
        cache.set(key, tried.returncode == 0)
    return cache.get(key, None)


def pytest_configure(config):
    """Compiling is most of the suite: its workers, the processes that tests start and the next run
    share what was compiled once, in pytest's own cache."""
    if config.getoption("typecheck"):
        from jaxtyping import install_import_hook

        # Plain functions are compiled and kept, no wrappers of them.
        importlib.import_module("gfnn_jax.flows.kernel")
        importlib.import_module("gfnn_jax.flows.compiled_steps")
        install_import_hook("gfnn_jax", "typechecker.checked")
    # Where bytecode may not be written beside its source, each process would compile all of it.
    bytecode = str(config.cache.mkdir("bytecode"))
    sys.pycache_prefix, sys.dont_write_bytecode = bytecode, False
    os.environ["PYTHONPYCACHEPREFIX"] = bytecode
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    if "XLA_FLAGS" not in os.environ:  # which JAX reads when it is first used
        os.environ["XLA_FLAGS"] = SOON_COMPILED if _takes_flags(config.cache) else ""
    shared = {
        "jax_compilation_cache_dir": str(config.cache.mkdir("compiled")),
        "jax_persistent_cache_min_compile_time_secs": 0.02,
        # Lines of source in what is compiled take time to lower and to compile; nobody reads them.
        "jax_traceback_in_locations_limit": 0,
    }
    for name, value in shared.items():
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)
    # Each operation that is traced keeps where it was called from: a twentieth of the time.
    with contextlib.suppress(ImportError, AttributeError):  # no part of JAX's interface
        from jax._src.lib import _jax

        _jax.set_tracebacks_enabled(False)
    # Tracing makes millions of small objects that live on: looking through them so often as Python
    # does by itself takes a twentieth of the suite's time.
    gc.set_threshold(50_000, 20, 20)
    # The suite's workers want all cores: threads of the linear algebra would wait for each other.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    threadpool_limits(limits=1, user_api="blas")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give a worker whole files, unless ``--dist`` says otherwise: a fit that a module's tests
    share is then made once, and so are the programs that they compile."""
    if config.getvalue("dist") != "load":  # what -n alone means
        return None
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


@pytest.fixture(autouse=True, scope="session")
def _interruptible():
    """A shell that starts the tests in the background has them ignore SIGINT."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


_MODULES_TOGETHER = 12
_modules = itertools.count(1)


@pytest.fixture(autouse=True, scope="module")
def _no_more_programs_than_some_modules_need():
    """Drop traced and compiled programs after every twelfth module.

    All of the suite's would fill gigabytes; dropped after each module, many would be traced and
    lowered again.
    """
    yield
    if next(_modules) % _MODULES_TOGETHER == 0:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def _own_draws(request, monkeypatch):
    """A test draws the same numbers, whatever ran before it in its process."""
    if hasattr(request.module, "RNG"):
        monkeypatch.setattr(request.module, "RNG", np.random.default_rng(0))


@pytest.fixture
def as_a_user():
    """A user's session: JAX as it comes, but for float64."""
    before = {
        name: getattr(jax.config, name)
        for name in ("jax_numpy_rank_promotion", "jax_numpy_dtype_promotion")
    }
    jax.config.update("jax_numpy_rank_promotion", "allow")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture(scope="session")
def swing():
    """A recording of a damped pendulum over 40 s, and the law of its first 28 s."""
    from test_law_fits import pendulum, recorded

    import gfnn_jax as gfnn

    recording = recorded(*pendulum())
    return recording, gfnn.fit(recording.slice(stop=28.0))


_compiled = []


def _count_compilations(event, duration, **_):
    # A program is lowered once; a newer JAX tells its compilation twice where it keeps programs.
    if event == "/jax/core/compile/jaxpr_to_mlir_module_duration":
        _compiled.append(duration)


jax.monitoring.register_event_duration_secs_listener(_count_compilations)


@pytest.fixture
def compilations():
    """``with compilations() as found``: ``found.count`` is then the number of XLA programs that
    were compiled inside, or fetched from the cache of compiled ones."""

    @contextlib.contextmanager
    def counted():
        before, found = len(_compiled), types.SimpleNamespace(count=0)
        yield found
        found.count = len(_compiled) - before

    return counted
