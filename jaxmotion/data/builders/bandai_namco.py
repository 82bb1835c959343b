"""Bandai-Namco Research Motion Dataset 1 and 2."""

import dataclasses
import json
import logging
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import tensorflow_datasets as tfds

from jaxmotion.data import bvh, bvh_text
from jaxmotion.data.builders import base

_CONTENTS = {
    "1": "walk run dash walk-back walk-left walk-right bow bye guide byebye respond "
    "call punch kick slash dance-long dance-short",
    "2": "walk walk-turn-left walk-turn-right run wave-both-hands wave-left-hand "
    "wave-right-hand raise-up-both-hands raise-up-left-hand raise-up-right-hand",
}
_STYLES = {
    "1": "normal happy sad angry proud not-confident masculinity feminine childish old "
    "tired active musical giant chimpira",
    "2": "active elderly exhausted feminine masculine normal youthful",
}
_FIELDS = ("content", "style")
_LOG = logging.getLogger(__name__)


@dataclasses.dataclass
class BandaiNamcoConfig(tfds.core.BuilderConfig):
    """Which of the two sets: "1" or "2"."""


class BandaiNamco(base.MotionBuilder):
    """Everyday actions in several styles, 30 frames per second.

    `joint_Root`, which never moves, is dropped: the hips are joint 0. Offsets come from
    the position channels, which every joint has; OFFSET holds the first frame's.
    """

    builder_config: BandaiNamcoConfig  # one of these, as tfds sets it
    BUILDER_CONFIGS = [
        BandaiNamcoConfig(name=name, description=f"Set {name}.") for name in ("1", "2")
    ]
    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "Put Bandai-Namco-Research-Motiondataset-1.zip or -2.zip, or the unzipped "
        "folder of that name (README.md, cfg/, data/), into the folder."
    )
    LABELS = _FIELDS
    HOMEPAGE = (
        "https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset"
    )

    @property
    def source(self) -> str:
        """Name of the set and its license."""
        name = self.builder_config.name
        return f"Bandai-Namco Research Motion Dataset {name} (CC BY-NC 4.0)"

    @property
    def label_names(self) -> dict[str, list[str]]:
        """The published lists of contents and styles."""
        name = self.builder_config.name
        return {"content": _CONTENTS[name].split(), "style": _STYLES[name].split()}

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        number = self.builder_config.name
        stem = f"Bandai-Namco-Research-Motiondataset-{number}"
        names = _read_lists(folder, number, stem)
        motions: dict[str, bytes] = {}
        orphans: list[str] = []
        for path, data in base.read_files(folder, (".json", ".bvh"), stem=stem):
            # "-" sorts before "." and ".bvh" before ".json": the ids come second.
            clip = PurePosixPath(path.replace("\\", "/")).stem
            if path.lower().endswith(".bvh"):
                motions[clip] = data
                continue
            if clip not in motions:
                orphans.append(clip)
                continue
            labels = read_labels(path, data, names)
            skeleton, motion = bvh.motion_from_bvh(
                bvh_text.read_bvh(
                    motions.pop(clip), name=path.removesuffix(".json") + ".bvh"
                ),
                root="Hips",
                feet=("Toes_L", "Toes_R"),
            )
            yield base.example(clip, skeleton, motion, labels)
        if motions:
            raise ValueError(f"{folder}: no {min(motions)}.json beside its BVH")
        if orphans:
            _LOG.warning(
                "%d label files have no BVH beside them, for example %s.json",
                len(orphans),
                orphans[0],
            )


def _read_lists(folder: Path, number: str, stem: str) -> dict[str, list[str]]:
    """The label lists in cfg/, without the prefix of each line."""
    lists = {
        PurePosixPath(path.replace("\\", "/")).name: [
            line.strip().removeprefix(f"dataset-{number}_")
            for line in base.read_text(path, data).splitlines()
            if line.strip()
        ]
        for path, data in base.read_files(folder, ("_label.txt",), stem=stem)
    }
    for field in _FIELDS:
        if f"{field}_label.txt" not in lists:
            raise ValueError(f"{folder}: no cfg/{field}_label.txt in {stem}")
    return {field: lists[f"{field}_label.txt"] for field in _FIELDS}


def read_labels(path: str, data: bytes, names: dict[str, list[str]]) -> dict[str, str]:
    """Content and style of a clip from its ids, checked against its file name.

    The file is named dataset-<n>_<content>_<style>_<number>.json and holds such as
    {"content": 7, "style": 0}. `ValueError` if the JSON is malformed, an id is unknown,
    or the name disagrees.
    """
    try:
        ids = json.loads(data)
        labels = {}
        for field in _FIELDS:
            if not 0 <= int(ids[field]) < len(names[field]):
                raise ValueError(f"{field} {ids[field]} is not in the label list")
            labels[field] = names[field][int(ids[field])]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(
            f"{path}: expected ids of content and style ({error})"
        ) from None
    parts = PurePosixPath(path.replace("\\", "/")).stem.split("_")
    if parts[1:3] != [labels["content"], labels["style"]]:
        raise ValueError(
            f"{path}: the ids say content {labels['content']!r} and style "
            f"{labels['style']!r}, the file name {parts[1:3]}"
        )
    return labels
