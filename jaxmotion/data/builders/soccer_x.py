"""Soccer-X: people with a football, the set of SMGDiff. The layout read here is OURS.

The set is described in the paper (30 players, 2398 sequences, 240 frames per second,
SMPL bodies and a ball), but was never published, and nothing says how its files look. A
holder of the data can write the following files, which this builder reads:

    skeleton.npz                  "offsets" [24, 3]: joint position of SMPL's rest pose
                                  relative to its parent, meters; row 0 is the pelvis
                                  relative to the model's origin. One body for all.
    <skill>_<anything>.npz        one sequence each, in any folder; or <anything>.npz
                                  in a folder <skill>
      trans       [frames, 3]     SMPL's translation, meters
      poses       [frames, 72]    SMPL's rotation vectors, radians
      ball_trans  [frames, 3]     the ball's center, meters
      ball_rot    [frames, 3]     optional; not read, a ball looks the same all round
      fps                         240 or 30
      up                          "y" or "z"

with the skills dribble, trick, shoot, stand, celebrate, off_ball. The bones are asked
for because SMPL's model may not be passed on.

Every eighth frame of 240 is taken. Which foot touches the ball is not measured. A foot
joint touches it where, at 30 frames per second,

    |joint - ball| < 0.11 m + 0.05 m    and    |ball acceleration| > 12 m/s^2.

The paper's 2 m/s^2 is 2 mm of second difference, which noise and a ball in free fall
(9.8 m/s^2) exceed in every frame.

Source: SMGDiff, sections 3.2 and 4; the layout and the threshold are ours.
"""

import io
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxmotion import files
from jaxmotion.data.builders import ball_base, base, chains, smpl
from jaxmotion.motion.ball import ball_accelerations
from jaxmotion.motion.skeleton import MAX_METERS, Skeleton

SKILLS = ("dribble", "trick", "shoot", "stand", "celebrate", "off_ball")
RADIUS = 0.11
# How much farther from the ball's surface a joint may be: it lies inside the foot.
TOUCH_MARGIN = 0.05
TOUCH_ACCELERATION = 12.0
# Ankles and feet.
_FEET = (7, 8, 10, 11)
_SKELETON = "skeleton.npz"
_FRAMES = {"trans": 3, "poses": 72, "ball_trans": 3}


class SoccerX(ball_base.BallBuilder):
    """Football in six skills, in a layout of our own."""

    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "Soccer-X is not published. Write one npz a sequence and a skeleton.npz into "
        "the folder, as the docstring of jaxmotion.data.builders.soccer_x says."
    )
    LABELS = ("skill",)
    LABEL_NAMES = {"skill": SKILLS}
    SOURCE = "Soccer-X, SMGDiff (not published)"
    HOMEPAGE = "https://arxiv.org/abs/2411.16216"

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        skeleton = None
        for path, data in base.read_files(folder, (_SKELETON,), unique=False):
            if skeleton is not None:
                raise ValueError(f"{path}: a second {_SKELETON}, expected one")
            skeleton = read_skeleton(path, data)
        if skeleton is None:
            raise FileNotFoundError(f"{folder}: no {_SKELETON}")
        found = False
        for path, data in base.read_files(folder, (".npz",), unique=False):
            if not path.endswith(_SKELETON):
                found = True
                yield read_sequence(path, data, skeleton)
        if not found:
            raise FileNotFoundError(f"{folder}: no sequences beside {_SKELETON}")


def _arrays(
    path: str, data: bytes, shapes: dict[str, tuple[int | None, ...]], what: str
) -> dict[str, np.ndarray]:
    """Arrays of a file; finite, of those shapes."""
    fields = files.read_arrays(io.BytesIO(data), name=path, what=what)
    kinds = {field: ("f", len(shape)) for field, shape in shapes.items()}
    files.check_fields(path, fields, kinds)
    for field, shape in shapes.items():
        found = fields[field]
        if any(n not in (None, m) for n, m in zip(shape, found.shape, strict=True)):
            expected = ", ".join("frames" if n is None else str(n) for n in shape)
            raise ValueError(
                f"{path}: field {field!r} has shape {found.shape}, expected "
                f"({expected})"
            )
        inside = np.abs(found.astype(np.float64)) <= MAX_METERS
        if not inside.all():
            row = int(np.argwhere(~inside)[0, 0])
            raise ValueError(
                f"{path}: field {field!r} is not within {MAX_METERS:g} in row {row}"
            )
    return fields


def read_skeleton(path: str, data: bytes) -> Skeleton:
    """SMPL's joints with the bones of a skeleton.npz.

    Its feet are ankles and feet, left before right; row 0 of its offsets is where the
    pelvis lies from the model's origin. A `ValueError` names a file whose offsets are
    missing, malformed or not finite.
    """
    fields = _arrays(path, data, {"offsets": (24, 3)}, "skeleton")
    return Skeleton(
        offsets=jnp.asarray(fields["offsets"], jnp.float32),
        parents=smpl.PARENTS,
        names=smpl.JOINTS,
        feet=_FEET,
    )


def read_skill(path: str) -> str:
    """One of six skills, from a file's name or folder; `ValueError` if it says none."""
    place = PurePosixPath(path.replace("\\", "/"))
    for skill in SKILLS:
        if place.stem.startswith(f"{skill}_"):
            return skill
    if place.parent.name in SKILLS:
        return place.parent.name
    raise ValueError(
        f"{path}: no skill: expected a file name that begins with, or a folder that is "
        f"one of {', '.join(SKILLS)} (<skill>_<anything>.npz)"
    )


def read_sequence(path: str, data: bytes, skeleton: Skeleton) -> tuple[str, dict]:
    """Key and features of one sequence at 30 frames per second, y up.

    A `ValueError` names the file and the field if one is missing, malformed or not
    finite, the name says no skill, or fewer than three frames are left.
    """
    skill = read_skill(path)
    shapes = {field: (None, width) for field, width in _FRAMES.items()}
    fields = _arrays(path, data, shapes, "Soccer-X")
    step = _check_sequence(path, fields)
    trans, poses, ball = (fields[field][::step].astype(np.float64) for field in _FRAMES)
    if len(trans) < 3:
        raise ValueError(
            f"{path}: {len(trans)} frames at 30 per second, expected at least 3"
        )
    offsets = np.asarray(skeleton.offsets, np.float64)
    # SMPL turns the body about its pelvis, so the way there is not turned.
    root, local = trans + offsets[0], smpl.matrices(poses)
    if str(fields["up"]) == "z":
        turn = ball_base.Y_UP_FROM_Z_UP
        root, ball = root @ turn.T, ball @ turn.T
        local[:, 0] = turn @ local[:, 0]
    world = chains.world_rotations(local, smpl.PARENTS)
    joints = chains.joint_positions(root, world, offsets, smpl.PARENTS)
    place = PurePosixPath(path.replace("\\", "/"))
    return ball_base.ball_example(
        # Sequences of several folders may bear the same name.
        f"{place.parent.name}/{place.stem}",
        skeleton,
        base.motion_from_matrices(root, local, fps=ball_base.FPS),
        {"skill": skill},
        ball=ball,
        touch=ball_touch(joints[:, list(_FEET)], ball),
        joints=_FEET,
        radius=RADIUS,
    )


def _check_sequence(path: str, fields: dict[str, np.ndarray]) -> int:
    """How many frames make one of the result; raises where fields do not agree."""
    for field in ("fps", "up"):
        if field not in fields:
            raise ValueError(f"{path}: field {field!r} is missing")
        if fields[field].ndim:
            raise ValueError(
                f"{path}: field {field!r} has shape {fields[field].shape}, expected "
                "one value"
            )
    if fields["fps"] not in (30, 240):
        raise ValueError(f"{path}: field 'fps' is {fields['fps']}, expected 240 or 30")
    if str(fields["up"]) not in ("y", "z"):
        raise ValueError(f"{path}: field 'up' is {fields['up']}, expected 'y' or 'z'")
    for field in _FRAMES:
        if len(fields[field]) != len(fields["trans"]):
            raise ValueError(
                f"{path}: field {field!r} has {len(fields[field])} frames, 'trans' has "
                f"{len(fields['trans'])}"
            )
    return round(float(fields["fps"]) / ball_base.FPS)


def ball_touch(
    joints: Float[np.ndarray, "frames touching 3"], ball: Float[np.ndarray, "frames 3"]
) -> Bool[np.ndarray, "frames touching"]:
    """Which joints touch the ball: near it while its velocity changes.

    Never in the first and the last frame. World positions, meters, at 30 frames per
    second; the ball's is its center's.

    Source: SMGDiff, section 3.2; the threshold is ours.
    """
    near = np.linalg.norm(joints - ball[:, None], axis=-1) < RADIUS + TOUCH_MARGIN
    change = ball_accelerations(jnp.asarray(ball, jnp.float32), ball_base.FPS)
    kicked = np.linalg.norm(np.asarray(change), axis=-1) > TOUCH_ACCELERATION
    return near & kicked[:, None]
