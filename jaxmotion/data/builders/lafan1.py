"""Ubisoft La Forge Animation dataset (LaFAN1)."""

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from jaxmotion.data import bvh, bvh_text
from jaxmotion.data.builders import base

_NAME = re.compile(
    r"(?P<theme>[A-Za-z]+)\d*_(?P<subject>subject\d+)(?:_(?P<action>[A-Za-z]+)\d*)?"
)


def read_name(name: str) -> dict[str, str]:
    """Labels from a file name such as walk1_subject5 or aiming1_subject1_walk2.

    theme ("walk", "aiming"), subject ("subject5") and action: the label of a cut, or
    the theme of a whole take. The name comes without its ending; a `ValueError` says if
    it is none of these.
    """
    match = _NAME.fullmatch(name)
    if match is None:
        raise ValueError(
            f"{name!r}: expected <theme><take>_subject<number> or, for a cut, "
            "<theme><take>_subject<number>_<label><count>"
        )
    labels = match.groupdict()
    return {**labels, "action": labels["action"] or labels["theme"]}


class Lafan1(base.MotionBuilder):
    """Five subjects, long takes of fifteen themes, 30 frames per second."""

    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "Put lafan1.zip (and, where there are any, zips of cuts), or the BVH files "
        "themselves, into the folder."
    )
    LABELS = ("theme", "subject", "action")
    SOURCE = "Ubisoft LaFAN1 (CC BY-NC-ND 4.0)"
    HOMEPAGE = "https://github.com/ubisoft/ubisoft-laforge-animation-dataset"

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        for path, data in base.read_files(folder, (".bvh",)):
            name = PurePosixPath(path.replace("\\", "/")).stem
            try:
                labels = read_name(name)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
            skeleton, motion = bvh.motion_from_bvh(
                bvh_text.read_bvh(data, name=path), feet=("LeftToe", "RightToe")
            )
            yield base.example(name, skeleton, motion, labels)
