"""Small BVH files, skeletons and clips that the data tests share."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmotion.data.clips import Clips, clips_from_motions
from jaxmotion.motion.skeleton import Motion, Skeleton
from tests.tiny import float32

# A body whose axes are the world's (left is +x), and one whose right limbs have all
# axes turned round, as mirrored rigs have them.
NAMES = ("Hips", "Spine", "LeftLeg", "LeftToe", "RightLeg", "RightToe")
PARENTS = (-1, 0, 0, 2, 0, 4)
PLAIN = [[0, 0, 0], [0, 0.5, 0.02], [0.1, -0.1, 0], [0, -0.8, 0.1]]
PLAIN += [[-0.1, -0.1, 0], [0, -0.8, 0.1]]
TURNED = [[0, 0, 0], [0.5, 0, 0], [-0.02, 0.1, 0], [0.8, 0, 0]]
TURNED += [[-0.02, -0.1, 0], [-0.8, 0, 0]]


def skeleton(offsets=PLAIN) -> Skeleton:
    """Six joints."""
    return Skeleton(
        offsets=float32(offsets),
        parents=PARENTS,
        names=NAMES,
        feet=(3, 5),
    )


def columns(matrix: np.ndarray) -> np.ndarray:
    """The first two columns of rotation matrices, one after the other."""
    return np.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)


def motion(num_frames: int, seed: int, fps: float = 30.0, num_joints: int = 6):
    """Random rotations and a random path."""
    generator = np.random.default_rng(seed)
    turns = Rotation.random(num_frames * num_joints, rng=generator).as_matrix()
    return Motion(
        root_position=float32(generator.normal(size=(num_frames, 3))),
        joint_rotation=float32(columns(turns.reshape(num_frames, num_joints, 3, 3))),
        fps=fps,
    )


def clips() -> Clips:
    """Eight clips of 3 to 10 frames in two styles and two contents."""
    return clips_from_motions(
        [motion(3 + i, i) for i in range(8)],
        skeleton(),
        names=[f"clip{i}" for i in range(8)],
        labels={
            "style": ["old", "young"] * 4,
            "content": ["turn-left"] * 3 + ["walk"] * 5,
        },
        label_names={"style": ("young", "old", "unused")},
        source="made up (no license)",
    )


BVH = """HIERARCHY
ROOT Root
{
\tOFFSET 9.0 9.0 9.0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
\tJOINT mixamorig:Hips
\t{
\t\tOFFSET 1.0 90.0 3.0
\t\tCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
\t\tJOINT Left Leg
\t\t{
\t\t\tOFFSET 10.0 -5.0 0.5
\t\t\tCHANNELS 3 Xrotation Zrotation Yrotation
\t\t\tEnd Site
\t\t\t{
\t\t\t\tOFFSET 0.0 -40.0 0.0
\t\t\t}
\t\t\tEnd Site
\t\t\t{
\t\t\t\tOFFSET 0.0 -40.0 8.0
\t\t\t}
\t\t}
\t\tJOINT Head
\t\t{
\t\t\tOFFSET 0.0 50.0 0.0
\t\t\tCHANNELS 1 Yrotation
\t\t\tEnd Site
\t\t\t{
\t\t\t\tOFFSET 0.0 10.0 0.0
\t\t\t}
\t\t}
\t}
\tJOINT Prop
\t{
\t\tOFFSET 0.0 0.0 1.0
\t\tCHANNELS 0
\t}
}
MOTION
Frames: 3
Frame Time: 0.016667
"""


def bvh_values(num_frames: int = 3, seed: int = 0) -> np.ndarray:
    """Channel values for the hierarchy above, with 6 + 6 + 3 + 1 columns."""
    return np.random.default_rng(seed).uniform(-170, 170, (num_frames, 16))


def bvh_text(values: np.ndarray | None = None) -> str:
    """The hierarchy above with rows of values."""
    values = bvh_values() if values is None else values
    rows = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in values)
    return BVH.replace("Frames: 3", f"Frames: {len(values)}") + rows + "\n"
