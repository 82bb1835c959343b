"""Programs for processes with other devices than the suite's; they write npz files.

python -m tests.workers single OUT
python -m tests.workers mesh OUT             with XLA_FLAGS for 8 virtual devices
python -m tests.workers process OUT PORT ID  one of two processes with one device each
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import rollout
from jaxmotion.learning import training
from jaxmotion.motion.trajectory import Command
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from tests import tiny

# No attention: the gradient of its keys' biases is zero but for rounding, which Adam
# makes steps of full length of, so that those alone would differ between devices.
CONFIG = tiny.config(network="mlp", depth=1, heading="facing")
CHARACTERS, TICKS = 16, 7


def train(mesh=None):
    """Four updates; the batch of 16 divides by 8 and 2 devices."""
    run, state, key, data = tiny.training_parts(
        CONFIG, num_steps=4, batch=16, mesh=mesh, learning_rate=1e-3
    )
    state, data = training.replicate((state, data), mesh)
    state, info = run(state, key, data)
    return {"params": state.params, "ema": state.ema_params, "info": info}


def commands() -> Command:
    """Each character walks another way, and turns at another tick."""
    character, tick = np.mgrid[:CHARACTERS, :TICKS]
    yaw = 0.4 * character + 1.5 * (tick >= character % TICKS)
    ahead = jnp.asarray(np.stack([np.sin(yaw), np.cos(yaw)], -1), jnp.float32)
    label = jnp.asarray((tick > 3) & (character % 3 == 0), jnp.int32)
    return Command(velocity=ahead, facing=ahead, label=label)


def roll(mesh=None, chunk=None):
    """A rollout of characters who need their plans at different ticks."""
    skeleton = tiny.skeleton()
    past = tiny.walk(CONFIG.past)
    state = camdm_controller.init_state(skeleton, past, config=CONFIG)
    states = jax.tree.map(lambda x: jnp.stack([x] * CHARACTERS), state)
    control = camdm_controller.Control(apply=5, reuse=6)

    def run(params, key, states, commands):
        made = camdm_controller.controller(
            params, skeleton, config=CONFIG, control=control
        )
        return rollout.rollout(made, key, states, commands, mesh=mesh, chunk=chunk)

    params = tiny.random_params(camdm_model.init, CONFIG)
    # Poses near a standing one: rotations of arbitrary six numbers magnify rounding.
    standing = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]), CONFIG.num_joints)
    root = jnp.array([0.0, 0.9, 0.0, 0.0, 0.0, 0.0])
    params["out"] = {
        "kernel": 0.2 * params["out"]["kernel"],
        "bias": jnp.tile(jnp.concatenate([standing, root]), CONFIG.future),
    }
    states, frames = jax.jit(run)(params, jax.random.key(1), states, commands())
    return {"states": states, "frames": frames}


def write(path, tree):
    """Leaves by their paths."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    np.savez(path, **{jax.tree_util.keystr(k): np.asarray(x) for k, x in leaves})


def main(what, out, *rest):
    """Runs one of the programs."""
    if what == "process":
        port, number = rest
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{port}", 2, int(number))
        assert jax.process_count() == 2 and jax.device_count() == 2
        result = train(jax.make_mesh((2,), ("data",)))
    elif what == "mesh":
        assert jax.device_count() == 8
        mesh = jax.make_mesh((8,), ("data",))
        result = train(mesh) | roll(mesh, chunk=1)
        used = result["frames"].root_position.sharding
        assert len(used.device_set) == 8 and not used.is_fully_replicated
    else:
        result = train() | roll()
    write(out, result)


if __name__ == "__main__":
    main(*sys.argv[1:])
