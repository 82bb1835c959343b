"""BallPlay-M: a person with a measured basketball, the motions SkillMimic learns from.

The file ballplay_m.npz holds all clips, concatenated, at 60 frames per second, meters,
z up: `body_position` of 53 joints, rotation vectors of the root and (parent-local) of
joints 1 to 52, the ball's center, and whether a hand touches it. This builder takes
every second frame and turns the axes to y up; a touch in either of two frames is a
touch. Fingers are dropped. The flag does not say which hand: the wrist that is nearer
to the ball is taken, so a ball in both hands touches one, and changes hands often (260
times in 5 minutes).

Positions and rotations of the file do not agree. The bones of `body_position` are rigid
to the float, but the rotations of the file put the joints 17 mm off on average (without
fingers 8 mm; 0.2 m at worst, when someone gets up from the ground), and feet below the
floor, which those of `body_position` never are. So the positions are kept, and the
rotations are the nearest to the file's that reproduce them (to 0.05 mm).

A ball at rest lies at 0.112 m (median), which is taken for its radius; an official
basketball has 0.12 m. While it bounces it is seen down to 0.095 m.

Labels are the skills; those of the authors' experiments ("exp3", "ablation3", ...) are
no skills and become "other". Some clips share frames: the two chest passes, runOffBall
004 with pick 000 of take 008, layup 013 with rebound 014. They belong on one side of a
split.

Source: SkillMimic (Wang et al. 2025).
"""

import io
import itertools
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jaxmotion import files
from jaxmotion.data.builders import ball_base, base, chains
from jaxmotion.motion.skeleton import MAX_METERS, Skeleton

RADIUS = 0.112
OTHER = "other"
_FILE = "ballplay_m.npz"
_FPS = 60.0
_FINGERS = ("Index", "Middle", "Pinky", "Ring", "Thumb")
# Kind of numbers, and the shape of one frame.
_FRAMES = {
    "body_position": ("f", (53, 3)),
    "ball_position": ("f", (3,)),
    "root_rotation_expmap": ("f", (3,)),
    "joint_rotation_expmap": ("f", (52, 3)),
    "hand_ball_contact": ("b", ()),
}
_CLIPS = {"clip_offset": "i", "clip_name": "U", "clip_label": "U", "body_name": "U"}
_LARGEST_ERROR = 0.005


def _parent_names() -> dict[str, str]:
    """The parent of every joint, in the order of the file."""
    paths = [
        "Pelvis L_Hip L_Knee L_Ankle L_Toe",
        "Pelvis R_Hip R_Knee R_Ankle R_Toe",
        "Pelvis Torso Spine Spine2 Chest Neck Head",
    ]
    for side in "LR":
        paths.append("Chest _Thorax _Shoulder _Elbow _Wrist".replace(" _", f" {side}_"))
        paths += [
            f"{side}_Wrist {side}_{finger}1 {side}_{finger}2 {side}_{finger}3"
            for finger in _FINGERS
        ]
    steps = (step for path in paths for step in itertools.pairwise(path.split()))
    return {"Pelvis": ""} | {joint: parent for parent, joint in steps}


_PARENT_NAMES = _parent_names()
NAMES = tuple(_PARENT_NAMES)
PARENTS = (-1, *(NAMES.index(_PARENT_NAMES[name]) for name in NAMES[1:]))
# Nothing but fingers hangs on fingers, so they can simply go.
_BODY = [j for j, name in enumerate(NAMES) if not any(f in name for f in _FINGERS)]
_WRISTS = [NAMES.index("L_Wrist"), NAMES.index("R_Wrist")]


class Ballplay(ball_base.BallBuilder):
    """Basketball: 122 clips of picking up, catching, dribbling, shooting."""

    MANUAL_DOWNLOAD_INSTRUCTIONS = f"Put {_FILE}, or a zip with it, into the folder."
    LABELS = ("skill",)
    SOURCE = "BallPlay-M, SkillMimic (Apache-2.0)"
    HOMEPAGE = "https://github.com/wyhuai/SkillMimic"

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        path, data = next(base.read_files(folder, (_FILE,)))
        fields = read_fields(path, data)
        starts = fields["clip_offset"]
        frames, contact = _every_second(starts, fields["hand_ball_contact"])
        position = fields["body_position"][frames] @ ball_base.Y_UP_FROM_Z_UP.T
        ball = fields["ball_position"][frames] @ ball_base.Y_UP_FROM_Z_UP.T
        offsets, world = chains.fit_rotations(
            position, _published_rotations(fields, frames), PARENTS
        )
        found = chains.joint_positions(position[:, 0], world, offsets, PARENTS)
        _check_bones(path, frames, np.linalg.norm(found - position, axis=-1))
        skeleton = _skeleton(offsets)
        local = chains.local_rotations(world, PARENTS)[:, _BODY]
        distance = np.linalg.norm(position[:, _WRISTS] - ball[:, None], axis=-1)
        touch = contact[:, None] & (distance.argmin(1)[:, None] == np.arange(2))
        for clip, (start, stop) in enumerate(itertools.pairwise(starts)):
            take = slice(*np.searchsorted(frames, (start, stop)))
            yield ball_base.ball_example(
                str(fields["clip_name"][clip]),
                skeleton,
                base.motion_from_matrices(
                    position[take, 0], local[take], fps=ball_base.FPS
                ),
                {"skill": read_skill(str(fields["clip_label"][clip]))},
                ball=ball[take],
                touch=touch[take],
                joints=[_BODY.index(wrist) for wrist in _WRISTS],
                radius=RADIUS,
            )


def read_skill(label: str) -> str:
    """The skill that a clip's label names; "other" for the authors' experiments."""
    return OTHER if label.startswith(("exp", "ablation")) else label


def read_fields(path: str, data: bytes) -> dict[str, np.ndarray]:
    """The arrays of the file, checked; numbers are float64.

    A `ValueError` names the file and the field that is missing, of another shape or not
    finite, or says that the clips' boundaries do not ascend.
    """
    fields = files.read_arrays(io.BytesIO(data), name=path, what="BallPlay-M")
    wanted = {field: (kind, 1 + len(s)) for field, (kind, s) in _FRAMES.items()}
    wanted |= {field: (kind, 1) for field, kind in _CLIPS.items()} | {"fps": ("f", 0)}
    files.check_fields(path, fields, wanted)
    num_frames, num_clips = len(fields["body_position"]), len(fields["clip_name"])
    shapes = {field: (num_frames, *shape) for field, (_, shape) in _FRAMES.items()}
    shapes |= {"clip_offset": (num_clips + 1,), "clip_label": (num_clips,)}
    for field, shape in shapes.items():
        if fields[field].shape != shape:
            raise ValueError(
                f"{path}: field {field!r} has shape {fields[field].shape}, expected "
                f"{shape}"
            )
        if field not in _FRAMES:
            continue
        inside = np.abs(fields[field].astype(np.float64)) <= MAX_METERS
        if not inside.all():
            frame = int(np.argwhere(~inside)[0, 0])
            raise ValueError(
                f"{path}: field {field!r} of frame {frame} is not within {MAX_METERS:g}"
            )
    _check_clips(path, fields, num_frames)
    return {
        field: array.astype(np.float64) if array.dtype.kind == "f" else array
        for field, array in fields.items()
    }


def _check_clips(path: str, fields: dict[str, np.ndarray], num_frames: int) -> None:
    """Raises unless boundaries, joint names and rate are the published ones."""
    starts = fields["clip_offset"]
    if starts[0] != 0 or starts[-1] != num_frames or (np.diff(starts) < 1).any():
        raise ValueError(
            f"{path}: field 'clip_offset' should ascend from 0 to {num_frames}, found "
            f"{', '.join(map(str, starts[:5]))}, ... {starts[-1]}"
        )
    found = fields["body_name"].tolist()
    if tuple(found) != NAMES:
        pairs = itertools.zip_longest(NAMES, found)
        joint, (expected, name) = next(
            (i, pair) for i, pair in enumerate(pairs) if pair[0] != pair[1]
        )
        raise ValueError(
            f"{path}: field 'body_name' should list {len(NAMES)} joints, found "
            f"{len(found)}: joint {joint} should be {expected!r}, found {name!r}"
        )
    if fields["fps"] != _FPS:
        raise ValueError(f"{path}: field 'fps' is {fields['fps']}, expected {_FPS:g}")


def _every_second(
    starts: np.ndarray, contact: Bool[np.ndarray, " frames"]
) -> tuple[np.ndarray, Bool[np.ndarray, " kept"]]:
    """Every second frame of each clip, and whether it or the next has contact."""
    frames, after = [], []
    for start, stop in itertools.pairwise(starts):
        frames.append(np.arange(start, stop, 2))
        after.append(np.minimum(frames[-1] + 1, stop - 1))
    frames = np.concatenate(frames)
    return frames, contact[frames] | contact[np.concatenate(after)]


def _published_rotations(
    fields: dict[str, np.ndarray], frames: np.ndarray
) -> Float[np.ndarray, "kept 53 3 3"]:
    """World rotations of those frames, y up, as the file has them."""
    root, others = fields["root_rotation_expmap"], fields["joint_rotation_expmap"]
    vectors = np.concatenate([root[frames, None], others[frames]], axis=1)
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    local = local.reshape(-1, 53, 3, 3)
    local[:, 0] = ball_base.Y_UP_FROM_Z_UP @ local[:, 0]
    return chains.world_rotations(local, PARENTS)


def _check_bones(
    path: str, frames: np.ndarray, error: Float[np.ndarray, "kept 53"]
) -> None:
    """Raises unless the bones are rigid."""
    if error.max() > _LARGEST_ERROR:
        row, joint = np.unravel_index(error.argmax(), error.shape)
        raise ValueError(
            f"{path}: field 'body_position': bones are not rigid, {NAMES[joint]} of "
            f"frame {frames[row]} is {1e3 * error.max():.1f} mm off"
        )


def _skeleton(offsets: Float[np.ndarray, "53 3"]) -> Skeleton:
    """The body without fingers."""
    names = tuple(NAMES[joint] for joint in _BODY)
    return Skeleton(
        offsets=jnp.asarray(offsets[_BODY], jnp.float32),
        parents=(-1, *(names.index(_PARENT_NAMES[name]) for name in names[1:])),
        names=names,
        feet=(names.index("L_Toe"), names.index("R_Toe")),
    )
