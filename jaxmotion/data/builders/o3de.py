"""Locomotion takes of the Open 3D Engine's Motion Matching gem.

Walk, jog and run differ by speed and are one style, which a command's velocity decides;
what a player chooses beside it are the others. A take of two styles is cut where the
performer begins to leave one for the other, so that each way there belongs to the style
it leads to.
"""

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from jaxmotion.data import bvh, bvh_text
from jaxmotion.data.builders import base
from jaxmotion.motion.skeleton import Motion

# Takes that are not neutral locomotion from beginning to end: end of each part in
# seconds (None: of the take) and its style. Part "" is left out.
_PARTS: dict[str, tuple[tuple[float | None, str], ...]] = {
    "Crouching1": (
        (2.0, "neutral"),
        (28.2, "crouch"),
        (30.0, "neutral"),
        (50.3, "crouch"),
        (54.0, "neutral"),
        (62.0, "crouch"),
        (None, "neutral"),
    ),
    "Jumps1": ((None, "jump"),),
    "JumpsFreeRoam1": ((None, "jump"),),
    "Pushes1": ((None, "push"),),
    "OutofRange1": ((None, "calibration"),),
    # A jump with half a turn.
    "TurnOnSpot1": ((67.2, "neutral"), (69.6, ""), (None, "neutral")),
}
_WHOLE = ((None, "neutral"),)


def parts(take: str, motion: Motion) -> Iterator[tuple[str, str, Motion]]:
    """Name, style and frames of each part of a take."""
    cuts, start = _PARTS.get(take, _WHOLE), 0
    for i, (end, style) in enumerate(cuts):
        stop = motion.root_position.shape[0]
        if end is not None:
            stop = min(stop, round(end * motion.fps))
        if style and stop > start:
            name = take if len(cuts) == 1 else f"{take}_{i}"
            yield (
                name,
                style,
                Motion(
                    root_position=motion.root_position[start:stop],
                    joint_rotation=motion.joint_rotation[start:stop],
                    fps=motion.fps,
                ),
            )
        start = stop


class O3deMotionMatching(base.MotionBuilder):
    """One performer on one skeleton, 19 minutes at 60 frames per second."""

    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "Put o3de_motion_matching.zip, or the BVH files themselves, into the folder."
    )
    LABELS = ("style", "take")
    LABEL_NAMES = {"style": ("neutral", "crouch", "jump", "push", "calibration")}
    SOURCE = "Open 3D Engine, Motion Matching gem (Apache-2.0 OR MIT)"
    HOMEPAGE = "https://github.com/o3de/o3de"

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        for path, data in base.read_files(folder, (".bvh",)):
            take = PurePosixPath(path.replace("\\", "/")).stem
            skeleton, motion = bvh.motion_from_bvh(
                bvh_text.read_bvh(data, name=path), feet=("LeftToe", "RightToe")
            )
            for name, style, part in parts(take, motion):
                labels = {"style": style, "take": take}
                yield base.example(name, skeleton, part, labels)
