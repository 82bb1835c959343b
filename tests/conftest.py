"""Settings of the whole suite, and a small walker that needs no data.

Arrays that broadcast by rank raise, and keys that are used twice where the library
draws. Tests run on the CPU unless JAX_PLATFORMS says otherwise, and the whole suite on
several workers unless -n says how many.
"""

import gc
import os
import subprocess
import sys
import threading
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Most of the suite's time is compilation: without optimizations it takes a sixth.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

import jax  # noqa: E402
import jaxlib  # noqa: E402
import pytest  # noqa: E402
from jax._src.interpreters import mlir  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"

# A worker takes up to 3 GB.
MOST_WORKERS = 8
# Folders whose code draws: there a key that is used twice raises. Elsewhere the check
# would only make each operation slower, up to seven times.
DRAWS = ("control", "diffusion", "evaluators", "learning", "networks", "systems")
# Folders whose modules take longest: they start first, so that no worker waits long for
# the other's last module.
FIRST = ("systems", "contracts", "learning", "test_face.py", "evaluators")
# Compiled programs of so many modules are kept: they take memory, and time to forget.
MODULES_REMEMBERED = 20
# Programs that compile faster than this, seconds, are not stored: it takes as long.
LEAST_STORED = 0.05
# Objects made before garbage is looked for: traces make many, and hardly any cycles.
GARBAGE = (20_000, 20, 20)


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config):
    """Workers for the whole suite; files that are named run in one process."""
    if hasattr(config, "workerinput"):
        return  # a worker makes no workers
    given = getattr(config.option, "numprocesses", 0)
    if given is None and config.args_source is not config.ArgsSource.ARGS:
        config.option.numprocesses = "auto"
        config.option.maxprocesses = config.option.maxprocesses or MOST_WORKERS
        if config.option.dist == "no":
            config.option.dist = "loadscope"
            config.option.loadscopereorder = False


def pytest_configure(config):
    """Says, before JAX starts, how it compiles and where it keeps what it compiled.

    The environment tells the workers and the programs that tests start.
    """
    if hasattr(config, "workerinput"):
        return
    cache = getattr(config, "cache", None)  # None with -p no:cacheprovider
    if "XLA_FLAGS" not in os.environ and _known(QUICK, cache):
        os.environ["XLA_FLAGS"] = QUICK
    if cache and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        for name, value in (
            ("JAX_COMPILATION_CACHE_DIR", str(cache.mkdir("jax"))),
            ("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", LEAST_STORED),
        ):
            os.environ[name] = str(value)
            jax.config.update(name.lower(), value)


def _part(path):
    """A test file's folder in tests/, or its name."""
    return path.relative_to(Path(__file__).parent).parts[0]


def pytest_collection_modifyitems(items):
    rank = {part: place for place, part in enumerate(FIRST)}
    items.sort(key=lambda item: rank.get(_part(item.path), len(FIRST)))


def pytest_collection_finish():
    """What is loaded by now stays: garbage is not looked for in it."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GARBAGE)


def _known(flags, cache):
    """Whether this jaxlib has the flags: an unknown one would end the process."""
    entry = f"xla_flags/{jaxlib.__version__}/{flags}"
    known = cache.get(entry, None) if cache else None
    if known is None:
        code = "import jax; jax.devices()"
        environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, capture_output=True)
        known = done.returncode == 0
        if cache:
            cache.set(entry, known)
    return known


def _share_contexts():
    """Lowers all programs of a thread in one MLIR context.

    JAX makes one for each, and keeps it as long as the program: a fifth of the time of
    small programs, and most of their memory. It has no public setting for that.
    """
    make = getattr(mlir, "make_ir_context", None)
    if make is None:  # another version of JAX: slower, and no less true
        return
    of_thread = threading.local()

    def shared():
        if not hasattr(of_thread, "context"):
            of_thread.context = make()
        return of_thread.context

    mlir.make_ir_context = shared


_share_contexts()


@pytest.fixture(scope="session")
def _modules():
    """Names of the modules that ran since compiled programs were last forgotten."""
    return []


@pytest.fixture(scope="module", autouse=True)
def _forget_programs(request, _modules):
    yield
    _modules.append(request.node.name)
    if len(_modules) == MODULES_REMEMBERED:
        _modules.clear()
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module", autouse=True)
def _keys_are_used_once(request):
    with jax.debug_key_reuse(_part(request.node.path) in DRAWS):
        yield


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
