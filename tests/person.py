"""A person of six joints with chest, hips and toes, and motions of it in NumPy."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmotion.data.clips import Clips, clips_from_motions
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.motion.trajectory import PlanarFrame, Trajectory
from tests.tiny import float32

NAMES = ("Hips", "LeftUpLeg", "LeftToe", "RightUpLeg", "RightToe", "Spine2")
PARENTS = (-1, 0, 1, 0, 3, 0)
FEET = (2, 4)
OFFSETS = np.array([[0, 0, 0], [0.1, -0.05, 0], [0, -0.8, 0.15]])
OFFSETS = np.concatenate([OFFSETS, [[-0.1, -0.05, 0], [0, -0.8, 0.15], [0, 0.4, 0.02]]])


def skeleton(names=NAMES, feet=FEET) -> Skeleton:
    return Skeleton(offsets=float32(OFFSETS), parents=PARENTS, names=names, feet=feet)


def directions(yaw):
    return np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)


def about_y(yaw):
    return Rotation.from_rotvec(np.multiply.outer(yaw, [0.0, 1.0, 0.0])).as_matrix()


def motion(root, matrices, fps=60.0) -> Motion:
    """Root positions [F, 3] and local matrices [F, J, 3, 3]."""
    rot6d = np.concatenate([matrices[..., 0], matrices[..., 1]], axis=-1)
    return Motion(
        root_position=float32(root), joint_rotation=float32(rot6d), fps=float(fps)
    )


def upright(root, yaw):
    """Matrices [F, J, 3, 3] of a stiff person that faces as told."""
    matrices = np.tile(np.eye(3), (len(root), len(PARENTS), 1, 1))
    matrices[:, 0] = about_y(yaw)
    return matrices


def waves(time, size, seed, amplitude):
    """Smooth random functions of time, the same at any rate."""
    generator = np.random.default_rng(seed)
    rate, phase = generator.uniform(1.0, 5.0, size), generator.uniform(0, 6, size)
    return amplitude * np.sin(np.multiply.outer(time, rate) + phase)


def wander(num_frames, fps=60.0, num_joints=6, seed=0):
    """Root and matrices of a motion in which everything moves."""
    time = np.arange(num_frames) / fps
    root = waves(time, 3, seed, 0.4) + np.array([0.0, 1.0, 0.0])
    vectors = waves(time, (num_joints, 3), seed + 1, 1.0)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return root, matrices.reshape(num_frames, num_joints, 3, 3)


def wandering_bone(num_frames, fps=60.0, seed=5):
    """Positions [F, 2] and yaw [F] of a smooth path."""
    time = np.arange(num_frames) / fps
    return waves(time, 2, seed, 0.5), 3.0 + waves(time, (), seed + 1, 1.0)


def path(position, yaw) -> Trajectory:
    return Trajectory(position=float32(position), facing=float32(directions(yaw)))


def frames(position, yaw) -> PlanarFrame:
    return PlanarFrame(origin=float32(position), facing=float32(directions(yaw)))


def clips(lengths, fps=60.0, names=NAMES) -> Clips:
    """Clips of those numbers of frames, in which everything moves."""
    motions = [motion(*wander(n, fps, seed=i), fps) for i, n in enumerate(lengths)]
    words = [("walk", "run")[i % 2] for i in range(len(lengths))]
    return clips_from_motions(
        motions,
        skeleton(names),
        names=[f"clip{i}" for i in range(len(lengths))],
        labels={"theme": words},
        source="made in the tests",
    )
