"""100STYLE: a hundred styles of walking, running and standing (Mason et al. 2022).

Layout: `<Style>/<Style>_<ACTION>.bvh`, `Frame_Cuts.csv` with one row a style of start
and stop of each action (in frames of the 60 fps recording), `Dataset_List.csv` with
name, description, stochastic y/n, symmetric y/n and notes.

Source: the preprocessing of CAMDM's released code (every second frame, cut at start//2
and stop//2, fingers dropped, symmetric styles mirrored under the same label). Differs:
clips are not turned, centered or put on the floor; what follows works in any place.
"""

import csv
import dataclasses
import io
import logging
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import tensorflow_datasets as tfds

from jaxmotion.data import bvh, bvh_text, mirror
from jaxmotion.data.builders import base
from jaxmotion.motion.facing import plain_names
from jaxmotion.motion.skeleton import Skeleton

ACTIONS = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")
_DROPPED = ("eye", "index", "middle", "ring", "pinky", "thumb")
# As `plain_names` has them: in any case, and after a rig's prefix such as mixamorig:.
_FEET = (
    ("lefttoeend", "righttoeend"),
    ("lefttoebase", "righttoebase"),
    ("lefttoe", "righttoe"),
)
_LOG = logging.getLogger(__name__)


@dataclasses.dataclass
class Style100Config(tfds.core.BuilderConfig):
    """Whether symmetric styles get a mirrored copy under the same label."""

    mirror: bool = False


class Style100(base.MotionBuilder):
    """A hundred styles, ten actions each, taken at 30 of 60 frames per second."""

    builder_config: Style100Config  # one of these, as tfds sets it
    BUILDER_CONFIGS = [
        Style100Config(name="original", description="As recorded."),
        Style100Config(
            name="mirror",
            description="With mirrored copies of symmetric styles.",
            mirror=True,
        ),
    ]
    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "Put 100STYLE.zip, or the unzipped style folders with Frame_Cuts.csv and "
        "Dataset_List.csv, into the folder."
    )
    LABELS = ("style", "action")
    LABEL_NAMES = {"action": ACTIONS}
    SOURCE = "100STYLE (CC BY 4.0)"
    HOMEPAGE = "https://www.ianxmason.com/100style/"

    def _generate_examples(self, folder: Path) -> Iterator[tuple[str, dict]]:
        tables = {
            PurePosixPath(path.replace("\\", "/")).name: (
                path,
                base.read_text(path, data),
            )
            for path, data in base.read_files(folder, (".csv",))
        }
        for name in ("Frame_Cuts.csv", "Dataset_List.csv"):
            if name not in tables:
                raise FileNotFoundError(f"{folder}: no {name}")
        cuts = read_cuts(*tables["Frame_Cuts.csv"])
        symmetric = read_symmetric(*tables["Dataset_List.csv"])
        skipped: dict[str, list[str]] = {"style not in the list": [], "no cut": []}
        for path, data in base.read_files(folder, (".bvh",)):
            name = PurePosixPath(path.replace("\\", "/")).stem
            style, action = name.split("_")[0], name.split("_")[-1]
            if action not in ACTIONS:
                raise ValueError(
                    f"{path}: unknown action {action!r}, expected {', '.join(ACTIONS)}"
                )
            if style not in symmetric:
                skipped["style not in the list"].append(name)
                continue
            if (style, action) not in cuts:
                skipped["no cut"].append(name)
                continue
            content = cut_clip(bvh_text.read_bvh(data, name=path), cuts[style, action])
            skeleton, motion = bvh.motion_from_bvh(content)
            feet = toes(skeleton, path)
            skeleton = dataclasses.replace(skeleton, feet=feet)
            labels = {"style": style, "action": action}
            yield base.example(name, skeleton, motion, labels)
            if self.builder_config.mirror and symmetric[style]:
                copy = mirror.mirror(skeleton, motion, plan=_plan(skeleton))
                yield base.example(f"{name}_mirrored", skeleton, copy, labels)
        for reason, names in skipped.items():
            if names:
                _LOG.warning("%d files skipped, %s: %s", len(names), reason, names[:5])


def _plan(skeleton: Skeleton) -> mirror.MirrorPlan:
    """Mirror plan from the skeleton alone, the same for all clips.

    A performer's retargeted skeleton may be a little lopsided; 2 cm is allowed.
    """
    return mirror.mirror_plan(skeleton, tolerance=0.02)


def toes(skeleton: Skeleton, path: str) -> tuple[int, ...]:
    """Outermost pair of toe joints, left before right; `BvhError` if it has none."""
    plain = plain_names(skeleton)
    for pair in _FEET:
        if set(pair) <= set(plain):
            return tuple(plain.index(name) for name in pair)
    raise bvh_text.BvhError(
        f"{path}: no toes: expected Left and RightToe_End, ToeBase or Toe among the "
        f"joints {', '.join(skeleton.names)}"
    )


def cut_clip(content: bvh_text.Bvh, cut: tuple[int, int]) -> bvh_text.Bvh:
    """The cut at 30 frames per second, without fingers and eyes.

    The content is a recording at 60 frames per second, of which every second one of the
    frames start//2 : stop//2 is taken, or one already taken at 30. The cut's first and
    last (exclusive) frame are at 60.

    `BvhError` if the rate is another, or the cut is not within the recording.
    """
    fps = bvh.frame_rate(content.frame_time, content.frame_decimals)
    if fps not in (60.0, 30.0):
        raise bvh_text.BvhError(
            f"{content.name}: {fps:g} frames per second, expected 60 (or 30)"
        )
    start, stop = cut[0] // 2, cut[1] // 2
    values = content.values[:: 2 if fps == 60.0 else 1]
    if not 0 <= start < stop <= len(values):
        raise bvh_text.BvhError(
            f"{content.name}: the cut {cut[0]}..{cut[1]} of Frame_Cuts.csv is not "
            f"within the {2 * len(values)} frames of the recording at 60 per second"
        )
    content = dataclasses.replace(
        content, values=values[start:stop], frame_time=1.0 / 30.0
    )
    return without_fingers(content)


def without_fingers(content: bvh_text.Bvh) -> bvh_text.Bvh:
    """The recording without fingers and eyes, as CAMDM's preprocessing leaves it."""
    dropped = [
        name
        for name in content.names[1:]
        if any(part in name.lower() for part in _DROPPED)
    ]
    return bvh.without_joints(content, dropped)


def read_cuts(path: str, text: str) -> dict[tuple[str, str], tuple[int, int]]:
    """Start and stop, in frames at 60 per second, by style and action.

    The text is Frame_Cuts.csv: a header, then style and start, stop for each action in
    the order of `ACTIONS`. An empty cell or one with an "n" (NA, nan) means missing.

    A `ValueError` names the file, the line and the cell.
    """
    cuts = {}
    for number, row in enumerate(csv.reader(io.StringIO(text)), start=1):
        if number == 1 or not any(cell.strip() for cell in row):
            continue
        cells = [cell.strip() for cell in row]
        cells += [""] * (1 + 2 * len(ACTIONS) - len(cells))
        for slot, action in enumerate(ACTIONS):
            pair = cells[1 + 2 * slot : 3 + 2 * slot]
            if any(not cell or "n" in cell.lower() for cell in pair):
                continue
            try:
                start, stop = (int(float(cell)) for cell in pair)
            except ValueError:
                raise ValueError(
                    f"{path}, line {number}: cut of {cells[0]} {action} should be two "
                    f"frame numbers or NA, found {pair}"
                ) from None
            cuts[cells[0], action] = (start, stop)
    if not cuts:
        raise ValueError(f"{path}: no cuts below the header")
    return cuts


def read_symmetric(path: str, text: str) -> dict[str, bool]:
    """Whether each listed style is symmetric.

    The text is Dataset_List.csv: a header, then name, description, stochastic y/n,
    symmetric y/n, notes.

    A `ValueError` names the file and the line.
    """
    symmetric = {}
    for number, row in enumerate(csv.reader(io.StringIO(text)), start=1):
        if number == 1 or not any(cell.strip() for cell in row):
            continue
        answer = row[3].strip().lower()[:1] if len(row) > 3 else ""
        if answer not in ("y", "n"):
            raise ValueError(
                f"{path}, line {number}: column 4 (symmetric) should be y or n, found "
                f"{row[3:4]}"
            )
        symmetric[row[0].strip()] = answer == "y"
    if not symmetric:
        raise ValueError(f"{path}: no styles below the header")
    return symmetric
