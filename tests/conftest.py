"""Settings of the whole suite, and a small walker that needs no data.

Keys that are used twice and arrays that broadcast by rank raise. Tests run on the CPU
unless JAX_PLATFORMS says otherwise.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


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
