"""Float64 oracles of pose vectors, path features and the simulation bone, with loops.

Written from Holden et al. 2020 and Li et al. 2024: 4x4 matrices along the chains, SciPy
for rotation vectors and filters. Facings are (x, z), yaw turns +z toward +x.
"""

import numpy as np
from scipy import ndimage, signal
from scipy.spatial.transform import Rotation

from tests.reference import motion


def turn(facing):
    """Matrix about y that turns +z onto a facing."""
    yaw = np.arctan2(facing[0], facing[1])
    return Rotation.from_rotvec([0.0, yaw, 0.0]).as_matrix()


def bone_matrix(position, facing):
    """World matrix of the simulation bone."""
    return motion.homogeneous(turn(facing), [position[0], 0.0, position[1]])


def local_matrices(offsets, parents, root, rotations, bone_position, bone_facing):
    """Each joint [F, J, 4, 4] seen from its parent, the first from the bone."""
    rows = []
    for f in range(len(root)):
        worlds = motion.world_transforms(offsets, parents, root[f], rotations[f])
        bone = bone_matrix(bone_position[f], bone_facing[f])
        above = [bone if p < 0 else worlds[p] for p in parents]
        pairs = zip(above, worlds, strict=True)
        rows.append([np.linalg.inv(a) @ b for a, b in pairs])
    return np.array(rows)


def means_of_neighbors(steps):
    """Means of the steps before and after; the ends continue them on a line."""
    means = 0.5 * (steps[1:] + steps[:-1])
    first, last = 2 * means[0] - means[1], 2 * means[-1] - means[-2]
    return np.array([first, *means, last])


def velocity(positions, fps):
    return means_of_neighbors(np.diff(positions, axis=0) * fps)


def angular_velocity(matrices, fps):
    """Angular velocity of matrices [F, 3, 3], in the axes that they turn into."""
    steps = matrices[1:] @ matrices[:-1].transpose(0, 2, 1)
    return means_of_neighbors(Rotation.from_matrix(steps).as_rotvec() * fps)


def contacts(toe, fps, max_speed=0.15, frames=6):
    """Contacts of one toe [F, 3], at 60 frames per second."""
    stands = np.linalg.norm(velocity(toe, fps), axis=-1) < max_speed
    return ndimage.median_filter(stands.astype(int), size=frames, mode="nearest")


def pose_parts(
    offsets, parents, feet, root, rotations, bone_position, bone_facing, fps
):
    """Parts of a clip's pose vectors, each [F, numbers], in their order."""
    local = local_matrices(
        offsets, parents, root, rotations, bone_position, bone_facing
    )
    frames, joints = local.shape[:2]
    spin = [angular_velocity(local[:, j, :3, :3], fps) for j in range(joints)]
    turns = np.array([turn(facing) for facing in bone_facing])
    ground = np.stack(
        [bone_position[:, 0], np.zeros(frames), bone_position[:, 1]], axis=-1
    )
    moves, spins = velocity(ground, fps), angular_velocity(turns, fps)
    worlds = np.array(
        [
            motion.world_transforms(offsets, parents, r, m)
            for r, m in zip(root, rotations, strict=True)
        ]
    )
    stands = [contacts(worlds[:, foot, :3, 3], fps) for foot in feet]
    columns = [local[..., :3, 0], local[..., :3, 1]]
    parts = {
        "position": local[..., :3, 3],
        "rotation": np.concatenate(columns, axis=-1),
        "velocity": velocity(local[..., :3, 3], fps),
        "angular_velocity": np.stack(spin, axis=1),
        "root_velocity": [t.T @ v for t, v in zip(turns, moves, strict=True)],
        "root_angular_velocity": [t.T @ w for t, w in zip(turns, spins, strict=True)],
        "contact": np.stack(stands, axis=-1),
    }
    return {name: np.reshape(part, (frames, -1)) for name, part in parts.items()}


def character_matrices(parents, position, rot6d):
    """Each joint [J, 4, 4] seen from the bone, from local translations."""
    local = [
        motion.homogeneous(motion.gram_schmidt(r), p)
        for p, r in zip(position, rot6d, strict=True)
    ]
    worlds = []
    for joint in range(len(parents)):
        chain = motion.chain_of_joints(parents, joint)
        worlds.append(np.linalg.multi_dot([np.eye(4)] + [local[j] for j in chain]))
    return np.stack(worlds)


def advance(position, facing, move, spin, fps):
    """One Euler step of the bone: p += R v dt, R = exp(w dt) R."""
    matrix = turn(facing)
    step = matrix @ [move[0], 0.0, move[2]] / fps
    matrix = Rotation.from_rotvec([0.0, spin[1] / fps, 0.0]).as_matrix() @ matrix
    return position + step[[0, 2]], matrix[[0, 2], 2]


def integrate(position, facing, moves, spins, fps):
    """Bones of all frames; as in LMM's runtime a pose's velocity leads up to it."""
    path = [(np.asarray(position), np.asarray(facing))]
    for move, spin in zip(moves[1:], spins[1:], strict=True):
        path.append(advance(*path[-1], move, spin, fps))
    return np.array([p for p, _ in path]), np.array([d for _, d in path])


def path_features(position, facing, offsets):
    """Twelve numbers a frame: positions and facings ahead, in the frame's axes."""
    rows, last = [], len(position) - 1
    for f in range(len(position)):
        inverse = np.linalg.inv(bone_matrix(position[f], facing[f]))
        ahead = [min(f + k, last) for k in offsets]
        places = [inverse @ [position[i, 0], 0, position[i, 1], 1] for i in ahead]
        facings = [inverse @ [facing[i, 0], 0, facing[i, 1], 0] for i in ahead]
        rows.append([v[axis] for v in places + facings for axis in (0, 2)])
    return np.array(rows)


def simulation_bone(chest, across):
    """Position and facing at 60 frames per second, from chest and right-to-left."""
    position = signal.savgol_filter(chest[:, [0, 2]], 31, 3, axis=0, mode="interp")
    facing = np.cross(across, [0.0, 1.0, 0.0])[:, [0, 2]]
    facing = facing / np.linalg.norm(facing, axis=-1, keepdims=True)
    facing = signal.savgol_filter(facing, 61, 3, axis=0, mode="interp")
    return position, facing / np.linalg.norm(facing, axis=-1, keepdims=True)
