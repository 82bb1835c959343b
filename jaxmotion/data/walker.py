"""The body of the generated walker: skeleton, posture of a gait, inverse kinematics.

Rest pose: upright, arms sideways, facing +z, all joint axes along the world's. So a
global rotation of a leg bone with columns (lateral, -bone, forward) is found directly
from where hip, knee and ankle are.
"""

import jax.numpy as jnp
import numpy as np

from jaxmotion.data.footsteps import Footsteps
from jaxmotion.data.gaits import Gait
from jaxmotion.motion.skeleton import Skeleton

THIGH, SHANK = 0.43, 0.42
TOE_HEIGHT = 0.03
TOE_AHEAD = 0.14
_ANKLE_UP = 0.07
_HIP_SIDE, _HIP_DOWN = 0.09, 0.05
# Least distance from hip to ankle, meters: a folded knee.
_SHORTEST = 0.15
# Least height of the pelvis, meters: a deep squat.
_LOWEST = 0.5
# Foot (left, right) and its thigh.
_LEGS = ((0, 14), (1, 18))

_BONES = [
    ("Hips", -1, (0.0, 0.0, 0.0)),
    ("Spine", 0, (0.0, 0.10, 0.0)),
    ("Spine1", 1, (0.0, 0.12, 0.0)),
    ("Spine2", 2, (0.0, 0.13, 0.0)),
    ("Neck", 3, (0.0, 0.15, 0.0)),
    ("Head", 4, (0.0, 0.11, 0.02)),
    ("LeftShoulder", 3, (0.05, 0.11, 0.0)),
    ("LeftArm", 6, (0.12, 0.0, 0.0)),
    ("LeftForeArm", 7, (0.28, 0.0, 0.0)),
    ("LeftHand", 8, (0.25, 0.0, 0.0)),
    ("RightShoulder", 3, (-0.05, 0.11, 0.0)),
    ("RightArm", 10, (-0.12, 0.0, 0.0)),
    ("RightForeArm", 11, (-0.28, 0.0, 0.0)),
    ("RightHand", 12, (-0.25, 0.0, 0.0)),
    ("LeftUpLeg", 0, (_HIP_SIDE, -_HIP_DOWN, 0.0)),
    ("LeftLeg", 14, (0.0, -THIGH, 0.0)),
    ("LeftFoot", 15, (0.0, -SHANK, 0.0)),
    ("LeftToeBase", 16, (0.0, -_ANKLE_UP, TOE_AHEAD)),
    ("RightUpLeg", 0, (-_HIP_SIDE, -_HIP_DOWN, 0.0)),
    ("RightLeg", 18, (0.0, -THIGH, 0.0)),
    ("RightFoot", 19, (0.0, -SHANK, 0.0)),
    ("RightToeBase", 20, (0.0, -_ANKLE_UP, TOE_AHEAD)),
]


def walker_skeleton() -> Skeleton:
    """The walker's 22 joints, about 1.7 m tall; its feet are the toes, left first."""
    return Skeleton(
        offsets=jnp.asarray([bone[2] for bone in _BONES], jnp.float32),
        parents=tuple(bone[1] for bone in _BONES),
        names=tuple(bone[0] for bone in _BONES),
        feet=(17, 21),
    )


def _axis(angle: np.ndarray, axis: str) -> np.ndarray:
    """Rotation matrices [F, 3, 3] about a coordinate axis."""
    angle = np.asarray(angle, float)
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = {
        "x": [[one, zero, zero], [zero, c, -s], [zero, s, c]],
        "y": [[c, zero, s], [zero, one, zero], [-s, zero, c]],
        "z": [[c, -s, zero], [s, c, zero], [zero, zero, one]],
    }[axis]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _foot_pitch(
    toe: np.ndarray, yaw: np.ndarray, hip: np.ndarray, least: np.ndarray
) -> np.ndarray:
    """Smallest heel rise, at least `least`, with which the leg reaches; radians."""
    tries = np.linspace(0.0, 1.3, 53)
    pitch = np.maximum(tries[None], least[:, None])
    up = _ANKLE_UP * np.cos(pitch) + TOE_AHEAD * np.sin(pitch)
    back = TOE_AHEAD * np.cos(pitch) - _ANKLE_UP * np.sin(pitch)
    ankle = np.stack(
        [
            toe[:, None, 0] - back * np.sin(yaw)[:, None],
            toe[:, None, 1] + up,
            toe[:, None, 2] - back * np.cos(yaw)[:, None],
        ],
        axis=-1,
    )
    far = np.linalg.norm(ankle - hip[:, None], axis=-1)
    reach = far <= THIGH + SHANK - 1e-3
    first = np.where(reach.any(axis=1), reach.argmax(axis=1), far.argmin(axis=1))
    return pitch[np.arange(len(toe)), first]


def _leg(
    hip: np.ndarray, ankle: np.ndarray, forward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Global rotations of thigh and shank: two-bone IK, knee forward."""
    line = ankle - hip
    far = np.clip(np.linalg.norm(line, axis=-1), _SHORTEST, THIGH + SHANK - 1e-4)
    line = line / np.linalg.norm(line, axis=-1, keepdims=True)
    bend = forward - np.sum(forward * line, -1, keepdims=True) * line
    bend = bend / np.linalg.norm(bend, axis=-1, keepdims=True)
    cosine = (THIGH**2 + far**2 - SHANK**2) / (2 * THIGH * far)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))[:, None]
    thigh = np.cos(angle) * line + np.sin(angle) * bend
    shank = (far[:, None] * line - THIGH * thigh) / SHANK
    lateral = np.cross(bend, line)
    lateral = -lateral / np.linalg.norm(lateral, axis=-1, keepdims=True)

    def frame(bone: np.ndarray) -> np.ndarray:
        up = -bone / np.linalg.norm(bone, axis=-1, keepdims=True)
        return np.stack([lateral, up, np.cross(lateral, up)], axis=-1)

    return frame(thigh), frame(shank)


def _smoothed(x: np.ndarray, sigma: float) -> np.ndarray:
    radius = max(int(4 * sigma), 1)
    weight = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    padded = np.pad(x, [(radius, radius)] + [(0, 0)] * (x.ndim - 1), mode="edge")
    flat = padded.reshape(len(padded), -1)
    out = [np.convolve(c, weight / weight.sum(), mode="valid") for c in flat.T]
    return np.stack(out, axis=-1).reshape(x.shape)


def _pelvis_height(
    path: np.ndarray, steps: Footsteps, gait: Gait, fps: float
) -> np.ndarray:
    """As high as both legs reach with flat soles, low-passed, less crouch."""
    reach = THIGH + SHANK - 0.012
    upright = TOE_HEIGHT + _ANKLE_UP + reach + _HIP_DOWN
    ground = np.stack([steps.toe[..., 0], steps.toe[..., 2]], axis=-1)
    direction = np.stack([np.sin(steps.yaw), np.cos(steps.yaw)], axis=-1)
    ankle = ground - TOE_AHEAD * direction
    far = np.maximum(np.linalg.norm(ankle - path[:, None], axis=-1) - _HIP_SIDE, 0.0)
    # A foot behind may lift its heel: it counts less.
    forward = np.sum((ankle - path[:, None]) * direction, axis=-1)
    far = np.where(forward < 0, np.maximum(far - 0.12, 0.0) * 0.8, far)
    allowed = np.sqrt(np.maximum(reach**2 - far**2, 0.25))
    allowed = TOE_HEIGHT + _ANKLE_UP + _HIP_DOWN + allowed.min(axis=1)
    half = max(int(0.1 * fps), 1)
    padded = np.pad(allowed, half, mode="edge")
    lowest = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).min(axis=1)
    height = np.minimum(_smoothed(lowest, 0.08 * fps), upright)
    return height - gait.crouch - gait.bounce * (1 + np.cos(2 * steps.phase)) / 2


def solve_pose(
    path: np.ndarray, yaw: np.ndarray, steps: Footsteps, gait: Gait, *, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Root positions, meters, and parent-local rotations of the whole body.

    The path is the body's ground position, meters; yaw its facing, radians. A
    `ValueError` names the first frame in which legs do not reach their steps.
    """
    side = _smoothed(
        steps.contact[:, 0].astype(float) - steps.contact[:, 1], 0.08 * fps
    )
    lateral = np.stack([np.cos(yaw), -np.sin(yaw)], axis=-1)
    ground = path + gait.sway * side[:, None] * lateral
    height = _pelvis_height(ground, steps, gait, fps)
    root = np.stack([ground[:, 0], height, ground[:, 1]], axis=-1)

    # Which foot is ahead, seen from the body: pelvis and arms follow it.
    facing = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    ahead = np.sum((steps.toe[:, 0, ::2] - steps.toe[:, 1, ::2]) * facing, axis=-1)
    lead = _smoothed(np.clip(ahead / 0.6, -1.0, 1.0), 0.05 * fps)
    local = np.tile(np.eye(3), (len(path), len(_BONES), 1, 1))
    _pose_trunk(local, yaw, lead, gait)
    _pose_arms(local, lead, gait)
    root = _lowered(root, local[:, 0], steps, fps)
    _pose_legs(local, root, yaw - gait.twist * lead, steps, fps)
    return root, local


def _pose_trunk(
    local: np.ndarray, yaw: np.ndarray, lead: np.ndarray, gait: Gait
) -> None:
    """Sets pelvis, spine, neck and head; the chest turns against the pelvis."""
    frames = len(yaw)
    lean = _axis(0.2 * gait.lean + 0 * yaw, "x")
    local[:, 0] = _axis(yaw - gait.twist * lead, "y") @ lean
    for joint in (1, 2, 3):
        local[:, joint] = _axis(gait.twist * 0.7 * lead, "y") @ _axis(
            np.full(frames, gait.lean * 0.27), "x"
        )
    # The head looks ahead whatever the lean, but for the gait's own nod.
    local[:, 4] = _axis(np.full(frames, 0.4 * gait.head - 0.3 * gait.lean), "x")
    local[:, 5] = _axis(np.full(frames, 0.6 * gait.head - 0.3 * gait.lean), "x")


def _pose_arms(local: np.ndarray, lead: np.ndarray, gait: Gait) -> None:
    """Sets upper arms and elbows; each arm swings with the other side's leg."""
    for shoulder, sign in ((6, 1.0), (10, -1.0)):
        swing = gait.arm_forward - sign * gait.arm_swing * lead
        hang = np.full(len(lead), -sign * (np.pi / 2 - gait.arm_out))
        local[:, shoulder + 1] = _axis(-swing, "x") @ _axis(hang, "z")
        flex = gait.elbow + 0.25 * gait.arm_swing * np.maximum(-sign * lead, 0.0)
        local[:, shoulder + 2] = _axis(-sign * flex, "y")


def _pose_legs(
    local: np.ndarray,
    root: np.ndarray,
    pelvis_yaw: np.ndarray,
    steps: Footsteps,
    fps: float,
) -> None:
    """Sets thigh, shank, foot and toes so that each toe is where its step is."""
    pelvis = local[:, 0]
    for foot, thigh in _LEGS:
        hip = root + pelvis @ np.array(_BONES[thigh][2])
        pitch, turn, ankle = _foot(steps, foot, hip, fps)
        # Knees point between pelvis and foot: by angle, for two directions that nearly
        # cancel would let the knee flip.
        forward = _axis((steps.yaw[:, foot] + pelvis_yaw) / 2, "y")[..., 2]
        upper, lower = _leg(hip, ankle, forward)
        local[:, thigh] = np.swapaxes(pelvis, -1, -2) @ upper
        local[:, thigh + 1] = np.swapaxes(upper, -1, -2) @ lower
        local[:, thigh + 2] = np.swapaxes(lower, -1, -2) @ turn
        # The toes stay level while the heel rises.
        local[:, thigh + 3] = _axis(-pitch, "x")


def _foot(
    steps: Footsteps, foot: int, hip: np.ndarray, fps: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heel rise, global rotation and ankle of a foot whose toe is where it must be."""
    least = _swing_pitch(steps.swing[:, foot])
    pitch = _foot_pitch(steps.toe[:, foot], steps.yaw[:, foot], hip, least)
    pitch = np.maximum(_smoothed(pitch, 0.02 * fps), pitch)
    turn = _axis(steps.yaw[:, foot], "y") @ _axis(pitch, "x")
    return pitch, turn, steps.toe[:, foot] - turn @ np.array(_BONES[17][2])


def _leg_lengths(
    root: np.ndarray, pelvis: np.ndarray, steps: Footsteps, fps: float
) -> np.ndarray:
    """Distance from hip to ankle that each leg must bridge, [F, 2] meters."""
    far = []
    for foot, thigh in _LEGS:
        hip = root + pelvis @ np.array(_BONES[thigh][2])
        far.append(np.linalg.norm(_foot(steps, foot, hip, fps)[2] - hip, axis=-1))
    return np.stack(far, axis=-1)


def _lowered(
    root: np.ndarray, pelvis: np.ndarray, steps: Footsteps, fps: float
) -> np.ndarray:
    """The root, lowered smoothly where a leg would not reach its foot."""
    root = root.copy()
    half = max(int(0.2 * fps), 1)
    far = first = _leg_lengths(root, pelvis, steps, fps)
    for _ in range(24):
        short = np.maximum(far.max(axis=1) - (THIGH + SHANK - 2e-4), 0.0)
        if short.max() <= 0:
            break
        padded = np.pad(short, half, mode="edge")
        worst = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).max(1)
        root[:, 1] -= 1.5 * _smoothed(worst, 0.08 * fps)
        far = _leg_lengths(root, pelvis, steps, fps)
    # A knee does not fold beyond _SHORTEST, nor sink into the ground: then the toe
    # would leave its place, or the leg be below its feet.
    folded = far.min() < _SHORTEST or root[:, 1].min() < _LOWEST
    if folded or far.max() > THIGH + SHANK - 2e-4:
        frame = int(first.max(axis=1).argmax())
        raise ValueError(
            f"steps too long for the legs, most of all at frame {frame} "
            f"({frame / fps:.2f} s): hip and ankle {first[frame].max():.3f} m apart, a "
            f"leg is {THIGH + SHANK:.2f} m, and no crouch reaches; command a lower "
            "speed or slower turns"
        )
    return root


def _swing_pitch(swing: np.ndarray) -> np.ndarray:
    """Heel rise of a swinging foot: high at first, level when it lands."""
    return np.where(swing > 0, 0.7 * np.sin(np.pi * np.clip(swing, 0, 1) ** 0.6), 0.0)
