"""Products of rotations, positions and Muon are in full precision on every machine.

By default GPUs round the factors of a float32 product of matrices to ten bits.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from jaxmotion.control import inertia
from jaxmotion.control.foot_lock import FootLock, clean_motion
from jaxmotion.data.walker import walker_skeleton
from jaxmotion.learning import training
from jaxmotion.motion import humanml, humanml_skeleton, pose, skeleton, trajectory
from jaxmotion.motion.humanml_layout import HUMANML3D
from jaxmotion.motion.skeleton import Motion
from jaxmotion.networks import blocks
from jaxmotion.systems.smgdiff import trajectory as paths

FRAMES = 12
BODY = walker_skeleton()
SIDES = np.eye(3, dtype=np.float32)[:2].ravel()
MOTION = Motion(
    root_position=jnp.zeros((FRAMES, 3)),
    joint_rotation=jnp.broadcast_to(SIDES, (FRAMES, len(BODY.parents), 6)),
    fps=30.0,
)
PATH = trajectory.Trajectory(
    position=jnp.zeros((FRAMES, 2)), facing=jnp.ones((FRAMES, 2))
)
JOINTS = jnp.zeros((FRAMES, 22, 3))


def products(jaxpr):
    """Precision of every product of matrices in a trace."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for part in jaxprs_in_params(equation.params):
            yield from products(part)


def path_noise():
    config = paths.Config(num_labels=1, noise="bridge")
    wish = paths.Wish(past=PATH, velocity=jnp.ones(2), label=jnp.int32(0))
    decode, encode = paths.noise_space(wish, config)
    return encode(decode(jnp.ones((config.future, 4))))


TRACED = {
    "skeleton.from_root": lambda: skeleton.from_root(BODY, MOTION.joint_rotation, 3),
    "pose.pose_vectors": lambda: pose.pose_vectors(BODY, MOTION, PATH),
    "pose.character_transforms": lambda: pose.character_transforms(
        BODY.parents, JOINTS, MOTION.joint_rotation
    ),
    "trajectory.smooth_course": lambda: trajectory.smooth_course(
        jax.random.key(0), PATH, last=3, cubic=0.5
    ),
    "humanml.features_from_joints": lambda: humanml.features_from_joints(
        JOINTS, HUMANML3D
    ),
    "humanml_skeleton": lambda: humanml_skeleton.motion_from_joints(JOINTS, 20.0)[1],
    "foot_lock.clean_motion": lambda: clean_motion(BODY, MOTION, lock=FootLock()),
    "inertia.inertialize": lambda: inertia.inertialize(MOTION, MOTION),
    "smgdiff.trajectory.noise_space": path_noise,
    "blocks.unfold_frames": lambda: blocks.unfold_frames(
        jnp.ones((4, 18)), 2, margin=2
    ),
    "training.orthogonalize": lambda: training.orthogonalize(
        JOINTS[0], jnp.ones((5, 3))
    ),
}


@pytest.mark.parametrize("name", TRACED)
def test_products_are_in_full_precision(name):
    found = list(products(jax.make_jaxpr(TRACED[name])().jaxpr))
    assert found
    assert {*found} == {(jax.lax.Precision.HIGHEST,) * 2}
