"""Settings of the whole suite, and a small walker that needs no data.

Keys that are used twice and arrays that broadcast by rank raise. Tests run on the CPU
unless JAX_PLATFORMS says otherwise, and the whole suite on several workers unless -n
says how many.
"""

import gc
import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# A worker takes up to 3 GB.
MOST_WORKERS = 8


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config):
    """Workers for the whole suite; files named on the command line run in one process."""
    given = getattr(config.option, "numprocesses", 0)
    if given is None and config.args_source is not config.ArgsSource.ARGS:
        config.option.numprocesses = "auto"
        config.option.maxprocesses = config.option.maxprocesses or MOST_WORKERS
        if config.option.dist == "no":
            config.option.dist = "loadscope"


def pytest_configure(config):
    """Workers and programs they start share what they compile, also with later runs."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or not hasattr(config, "cache"):
        return
    for name, value in (
        ("JAX_COMPILATION_CACHE_DIR", str(config.cache.mkdir("jax"))),
        ("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", 0.0),
        ("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", 0),
    ):
        os.environ[name] = str(value)
        jax.config.update(name.lower(), value)


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Compiled programs do not pile up over the modules of a process."""
    yield
    jax.clear_caches()
    gc.collect()


@pytest.fixture(scope="module")
def quick_compile():
    """Compiles whole training and control programs a third as long, unoptimized.

    For modules whose subject is not the arithmetic of a single function.
    """
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="session")
def skeleton():
    """Hips and two legs."""
    from tests import tiny

    return tiny.skeleton()


@pytest.fixture(scope="session")
def walker():
    """Clips of the walker in two styles."""
    from tests import tiny

    return tiny.clips()


@pytest.fixture(scope="session")
def config():
    """A CAMDM that compiles in seconds."""
    from tests import tiny

    return tiny.config()


@pytest.fixture(scope="session")
def params(config):
    """Parameters of it."""
    from jaxmotion.systems.camdm import model as camdm_model
    from tests import tiny

    return tiny.random_params(camdm_model.init, config, seed=7)
