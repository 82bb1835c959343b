"""HumanML3D's features in float64, frame by frame and joint by joint.

Written from the description of the format, with quaternions where the library has
matrices and SciPy where it has a convolution.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation


def between(start, end):
    """Smallest rotation of one vector onto another, by its quaternion."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    x, y, z = np.cross(start, end)
    return Rotation.from_quat([x, y, z, 1.0 + start @ end])


def across_of(pose, hips, shoulders, hip_weight):
    """Unit vector from left to right; hips and shoulders are (right, left)."""
    vector = hip_weight * (pose[hips[0]] - pose[hips[1]])
    vector = vector + pose[shoulders[0]] - pose[shoulders[1]]
    return vector / np.linalg.norm(vector)


def canonical(joints, hips, shoulders):
    """On the floor, at the origin, the first frame facing +z."""
    joints = np.array(joints, np.float64)
    joints[:, :, 1] -= joints[:, :, 1].min()
    joints -= joints[0, 0] * [1.0, 0.0, 1.0]
    forward = np.cross([0.0, 1.0, 0.0], across_of(joints[0], hips, shoulders, 1.0))
    turn = between(forward, np.array([0.0, 0.0, 1.0]))
    return np.stack([turn.apply(pose) for pose in joints])


def root_rotations(joints, hips, shoulders, hip_weight):
    """One rotation a frame from the smoothed facing to +z; the first is none."""
    forward = [
        np.cross([0.0, 1.0, 0.0], across_of(pose, hips, shoulders, hip_weight))
        for pose in joints
    ]
    forward = gaussian_filter1d(np.array(forward), 20, axis=0, mode="nearest")
    turns = [between(vector, np.array([0.0, 0.0, 1.0])) for vector in forward]
    return [Rotation.identity(), *turns[1:]]


def features(joints, *, chains, raw_offsets, hips, shoulders, feet, threshold, weight):
    """Parts of the features by name, one row a frame but for the last."""
    joints = canonical(joints, hips, shoulders)
    turns = root_rotations(joints, hips, shoulders, weight)
    rows = []
    for t in range(len(joints) - 1):
        pose, following = joints[t], joints[t + 1]
        step = turns[t + 1] * turns[t].inv()
        rotations = {}
        for chain in chains:
            above = turns[t]
            for parent, joint in zip(chain[:-1], chain[1:], strict=True):
                bone = pose[joint] - pose[parent]
                swing = between(np.array(raw_offsets[joint], float), bone)
                matrix = (above.inv() * swing).as_matrix()
                rotations[joint] = np.concatenate([matrix[:, 0], matrix[:, 1]])
                above = swing
        local = turns[t].apply(pose - pose[0] * [1.0, 0.0, 1.0])
        moved = turns[t + 1].apply(following[0] - pose[0])
        way = [np.sum((following[foot] - pose[foot]) ** 2) for foot in feet]
        rows.append(
            {
                # Positive w: the turn by the shorter way.
                "root_yaw_velocity": [np.arcsin(step.as_quat(canonical=True)[1])],
                "root_velocity": [moved[0], moved[2]],
                "root_height": [pose[0, 1]],
                "joint_position": local[1:].ravel(),
                "joint_rotation": np.concatenate(
                    [rotations[joint] for joint in range(1, len(pose))]
                ),
                "joint_velocity": turns[t].apply(following - pose).ravel(),
                "contact": np.array(way) < threshold,
            }
        )
    return {name: np.array([row[name] for row in rows], float) for name in rows[0]}


def joints(vectors, num_joints):
    """Way back, with running sums."""
    half, root, found = 0.0, np.zeros(3), []
    for t, vector in enumerate(np.asarray(vectors, np.float64)):
        if t > 0:
            half += vectors[t - 1][0]
        inverse = Rotation.from_quat([0.0, np.sin(half), 0.0, np.cos(half)]).inv()
        if t > 0:
            before = vectors[t - 1]
            root = root + inverse.apply([before[1], 0.0, before[2]])
        root = np.array([root[0], vector[3], root[2]])
        local = vector[4 : 4 + 3 * (num_joints - 1)].reshape(-1, 3)
        others = inverse.apply(local) + root * [1.0, 0.0, 1.0]
        found.append(np.concatenate([root[None], others]))
    return np.array(found)


def joints_from_rotations(vector, turn, root, lengths, chains, raw_offsets):
    """One pose by kinematics along the chains, each from the root's rotation."""
    count = len(raw_offsets)
    six = vector[4 + 3 * (count - 1) : 4 + 9 * (count - 1)].reshape(-1, 2, 3)
    pose = np.zeros((count, 3))
    pose[0] = root
    for chain in chains:
        above = turn
        for parent, joint in zip(chain[:-1], chain[1:], strict=True):
            first, second = six[joint - 1]
            matrix = np.stack([first, second, np.cross(first, second)], axis=-1)
            above = above * Rotation.from_matrix(matrix)
            bone = lengths[joint] * np.array(raw_offsets[joint], float)
            pose[joint] = pose[parent] + above.apply(bone)
    return pose
