"""Planted faults are what they are called."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.evaluation import faults
from jaxmotion.motion.skeleton import Motion
from tests import tiny


def test_each_fault_is_what_it_is_called():
    clips = tiny.clips()
    rows = jnp.asarray(np.add.outer(9 * np.arange(4), np.arange(8)))
    motion = Motion(
        root_position=clips.root_position[rows],
        joint_rotation=clips.joint_rotation[rows],
        fps=clips.fps,
    )
    joints, root = (
        np.asarray(x) for x in (motion.joint_rotation, motion.root_position)
    )
    found = faults.planted(jax.random.key(0), motion)
    close = np.testing.assert_allclose
    for name, where in (
        ("limbs stand still", joints[:, [0] * 8]),
        ("limbs of another window", joints[[1, 0, 3, 2]]),
        ("backwards", joints[:, ::-1]),
        ("half as fast", np.repeat(joints[:, :4], 2, axis=1)),
        ("paths 1.3 times as long: feet slide", joints),
        ("10 cm into the ground", joints),
    ):
        np.testing.assert_array_equal(found[name].joint_rotation, where)
    for name, size in (("rotations shaken by .02", 0.02), ("by .1", 0.1)):
        shaken = next(x for key, x in found.items() if key.endswith(name))
        assert abs(np.std(shaken.joint_rotation - joints) / size - 1) < 0.1
    close(found["backwards"].root_position, root[:, ::-1])
    close(found["10 cm into the ground"].root_position[..., 1], root[..., 1] - 0.1)
    longer = found["paths 1.3 times as long: feet slide"].root_position
    steps = lambda x: np.linalg.norm(np.diff(x[..., ::2], axis=1), axis=-1)  # noqa: E731
    close(steps(longer), 1.3 * steps(root), atol=1e-5)
    close(longer[..., 1], root[..., 1])
    close(longer[:, 0], root[:, 0])
