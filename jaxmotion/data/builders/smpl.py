"""The 24 joints of SMPL, and their rotation vectors as matrices."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxmotion.motion.humanml_layout import HUMANML3D
from jaxmotion.motion.humanml_skeleton import SMPL_JOINTS

# HumanML3D's joints are SMPL's without the hands.
JOINTS = (*SMPL_JOINTS, "left_hand", "right_hand")
PARENTS = (*HUMANML3D.parents, 20, 21)


def matrices(
    poses: Float[np.ndarray, "frames 72"],
) -> Float[np.ndarray, "frames 24 3 3"]:
    """Parent-local matrices (the root's global) of SMPL's rotation vectors, radians."""
    vectors = poses.reshape(-1, 3)
    return Rotation.from_rotvec(vectors).as_matrix().reshape(-1, 24, 3, 3)
