"""A walker with five joints, a CAMDM of a few thousand parameters, and their training.

Made in code with NumPy, so that tests (and the processes they start) need no data and
nothing of the package's own generator.
"""

import dataclasses
import functools

import jax
import numpy as np

from jaxmotion.data import windows
from jaxmotion.data.clips import Clips, clips_from_motions
from jaxmotion.learning import runs, training
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model

NAMES = ("Hips", "LeftUpLeg", "LeftToe", "RightUpLeg", "RightToe")
PARENTS = (-1, 0, 1, 0, 3)
OFFSETS = ((0, 0, 0), (0.1, 0, 0), (0, -0.9, 0.1), (-0.1, 0, 0), (0, -0.9, 0.1))
STYLES = ("calm", "brisk")

# Compiled as one: operation by operation it takes five times as long.
positions = jax.jit(joint_positions)


def float32(x) -> jax.Array:
    """Numbers of the host on the device; JAX would compile a program for each shape.

    A copy: `device_put` may go on with the memory that it is given.
    """
    return jax.device_put(np.array(x, np.float32))


def upturned(motion: Motion, *, seed: int = 0) -> Motion:
    """With all joints turned by a quarter about x, between turns about z and y.

    There, angles in the order of many BVH files are not unique.
    """
    shape = motion.joint_rotation.shape[:-1]
    generator = np.random.default_rng(seed)
    z, y = generator.uniform(-np.pi, np.pi, (2, *shape))
    sign = generator.choice([-1.0, 1.0], shape)
    spin = _yaw(z)[..., [2, 0, 1], :][..., [2, 0, 1]]  # about z
    turns = spin @ _pitch(sign * np.pi / 2) @ _yaw(y)
    return dataclasses.replace(motion, joint_rotation=float32(_columns(turns)))


def skeleton() -> Skeleton:
    """Hips and two legs without knees; the toes are the feet."""
    return Skeleton(
        offsets=float32(OFFSETS),
        parents=PARENTS,
        names=NAMES,
        feet=(2, 4),
    )


def _columns(matrix: np.ndarray) -> np.ndarray:
    return np.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)


def _yaw(angle: np.ndarray) -> np.ndarray:
    c, s, o, i = np.cos(angle), np.sin(angle), 0 * angle, 0 * angle + 1
    return np.stack([c, o, s, o, i, o, -s, o, c], -1).reshape(*angle.shape, 3, 3)


def _pitch(angle: np.ndarray) -> np.ndarray:
    c, s, o, i = np.cos(angle), np.sin(angle), 0 * angle, 0 * angle + 1
    return np.stack([i, o, o, o, c, -s, o, s, c], -1).reshape(*angle.shape, 3, 3)


def walk(
    num_frames: int,
    *,
    speed: float = 1.0,
    turn: float = 0.0,
    start: float = 0.0,
    fps: float = 30.0,
) -> Motion:
    """Walks at a speed (m/s) with a turn rate (rad/s) from a yaw (rad)."""
    time = np.arange(num_frames) / fps
    yaw = start + turn * time
    step = speed / fps * np.stack([np.sin(yaw), np.cos(yaw)], -1)
    path = np.cumsum(step, axis=0) - step[0]
    phase = 2 * np.pi * 1.2 * time
    height = 0.9 + 0.02 * np.cos(2 * phase)
    swing = 0.4 * speed * np.sin(phase)
    still = np.broadcast_to(np.eye(3), (num_frames, 3, 3))
    joints = np.stack(
        [_yaw(yaw + 0.1 * np.sin(phase)), _pitch(swing), still, _pitch(-swing), still],
        axis=1,
    )
    return Motion(
        root_position=float32(np.stack([path[:, 0], height, path[:, 1]], -1)),
        joint_rotation=float32(_columns(joints)),
        fps=fps,
    )


def clips(num_frames: int = 80) -> Clips:
    """Four clips: each style straight on and in a curve."""
    motions = [
        walk(num_frames + 5 * i, speed=speed, turn=turn, start=i)
        for i, (speed, turn) in enumerate(
            [(0.7, 0.0), (0.7, 0.8), (1.4, 0.0), (1.4, -0.8)]
        )
    ]
    return clips_from_motions(
        motions,
        skeleton(),
        names=[f"walk{i}" for i in range(4)],
        labels={"style": ["calm", "calm", "brisk", "brisk"]},
        label_names={"style": STYLES},
        source="made in the tests",
    )


def config(**changes) -> camdm_model.Config:
    """A CAMDM that compiles in seconds: 4 past, 12 future frames, 2 layers of 16."""
    sizes = dict(
        num_joints=len(NAMES),
        num_labels=len(STYLES),
        past=4,
        future=12,
        num_steps=4,
        width=16,
        depth=2,
        heads=2,
        hidden=32,
        dropout=0.0,
    )
    return camdm_model.Config(**(sizes | changes))


def random_params(init, *args, seed: int = 0):
    """Parameters as `init(key, *args)` makes them, drawn by NumPy: no compilation."""
    key = jax.random.key(seed)
    shapes = jax.eval_shape(lambda k: init(k, *args), key)
    generator = np.random.default_rng(seed)

    def draw(path, x):
        name = path[-1].key
        if name == "scale":
            return float32(np.ones(x.shape))
        deviation = 0.1 if name == "bias" else x.shape[-2] ** -0.5
        return float32(generator.normal(0.0, deviation, x.shape))

    return jax.tree_util.tree_map_with_path(draw, shapes)


def training_parts(
    config: camdm_model.Config,
    *,
    num_steps: int,
    batch: int = 8,
    mesh=None,
    learning_rate: float = 1e-2,
):
    """A run of training on the walker: `run_chunk`, first state, key and data."""
    walker = clips()
    index = windows.window_index(walker, config.window)
    optimizer = training.make_optimizer(
        "adamw", learning_rate=learning_rate, num_steps=40, warmup_steps=2, max_norm=1.0
    )

    def sample_batch(key, data):
        walker, index = data
        motion, clip = windows.sample_windows(key, walker, index, batch=batch)
        return motion, walker.labels["style"][clip]

    objective = functools.partial(
        camdm_loss.loss, skeleton=walker.skeleton, config=config
    )
    update = training.make_update(objective, optimizer, ema_decay=0.9)
    run = training.train_chunk(update, sample_batch, num_steps=num_steps, mesh=mesh)
    params = random_params(camdm_model.init, config, seed=3)
    state = training.init_train_state(params, optimizer)
    return run, state, jax.random.key(3), (walker, index)


def run_folder(folder, system="tests", **changes):
    """A run folder that no file says anything of."""
    fields = dict(model={}, settings={}, source="made in the tests", split={}, files={})
    return runs.Run(folder=folder, system=system, **fields | changes)
