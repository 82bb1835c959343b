"""A trained CAMDM and the clips it was trained on, from its run folder."""

import dataclasses
from pathlib import Path
from typing import Any

from jaxmotion.data import bvh, bvh_text, clips_io, selection
from jaxmotion.data.clips import Clips
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems import camdm_model
from jaxmotion.typing import Params

# Locomotion of Bandai-Namco: what a model and its evaluator are trained on.
CONTENTS = ("walk", "walk-turn-left", "walk-turn-right", "run")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What a run left behind.

    Attributes:
      model: The model.
      params: Its averaged parameters.
      train: Clips that it was trained on, without mirrored ones.
      held_out: Clips that it never saw.
      field: Label field that is the style.
    """

    model: camdm_model.Model
    params: Params
    train: Clips
    held_out: Clips
    field: str


def arguments_json(arguments: Any) -> dict[str, Any]:
    """Arguments of an experiment as JSON.

    Args:
      arguments: A dataclass of plain values and paths.

    Returns:
      A JSON object.
    """
    return {
        name: str(value) if isinstance(value, Path) else value
        for name, value in dataclasses.asdict(arguments).items()
    }


def split_data(
    data: Path,
    contents: tuple[str, ...],
    label: str,
    held_out: float,
    *,
    labels: tuple[str, ...] = (),
    held_out_clips: tuple[str, ...] = (),
) -> tuple[Clips, Clips]:
    """Training and held-out clips; the same for every run with these arguments.

    Args:
      data: File of clips.
      contents: Keep only clips of these contents; none, or clips without such a
        field: keep all.
      label: Label field that is the style.
      held_out: Part of each style's clips to hold out, in (0, 1).
      labels: Keep only clips of these styles, and forget the others; none: keep all.
      held_out_clips: Hold out these clips, by name, instead of a part.

    Returns:
      Both parts.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it holds no clips, or an argument does not fit them.
    """
    clips = clips_io.load_clips(data)
    clips.names(label)
    if contents and "content" in dict(clips.label_names):
        clips = selection.select(clips, "content", contents)
    if labels:
        clips = selection.relabel(selection.select(clips, label, labels), label)
    if held_out_clips:
        return selection.split_by_name(clips, held_out_clips)
    return selection.split_clips(clips, fraction=held_out, seed=0, field=label)


def released_skeleton(path: Path, *, scale: float) -> Skeleton:
    """The skeleton of a BVH file as CAMDM's preprocessing leaves it.

    Args:
      path: The file; fingers and eyes are dropped.
      scale: Metres per unit of the file.

    Raises:
      OSError: if it cannot be read.
      BvhError: if it is malformed or has no toes.
    """
    from jaxmotion.data.builders import style100

    content = style100.without_fingers(bvh_text.read_bvh(path))
    skeleton, _ = bvh.motion_from_bvh(content, scale=scale)
    return dataclasses.replace(skeleton, feet=style100.toes(skeleton, str(path)))


def check_clips(model: camdm_model.Model, clips: Clips, field: str) -> None:
    """Raises unless clips are of the model's skeleton, styles and rate.

    Args:
      model: The model.
      clips: The clips.
      field: Label field that is the style.

    Raises:
      ValueError: names what differs.
    """
    pairs = {
        "joints": (model.bones.names, clips.skeleton.names),
        "parents": (model.bones.parents, clips.skeleton.parents),
        f"names of {field!r}": (model.labels, clips.names(field)),
        "fps": (model.config.fps, clips.fps),
    }
    for what, (expected, found) in pairs.items():
        if expected != found:
            raise ValueError(
                f"the clips do not fit the model: {what} {found}, expected {expected}"
            )


def load_run(
    run: Path, data: Path | None = None, contents: tuple[str, ...] = ()
) -> Run:
    """Loads a run of `experiments/camdm.py train`.

    Args:
      run: Its folder.
      data: Clips; None for those that it was trained on.
      contents: Keep only clips of these contents, of those that the run used; none:
        keep all.

    Returns:
      Model, parameters and clips.

    Raises:
      OSError: if the clips cannot be read.
      ValueError: if the folder has no whole checkpoint of such a run, or the clips are
        not the model's; names the folder or what differs.
    """
    model, params, value = camdm_model.load(run)
    made_by = value.get("experiment", {})
    wanted = {"data", "contents", "label", "labels", "held_out", "held_out_clips"}
    missing = wanted - set(made_by)
    if missing:
        raise ValueError(
            f"{run}: field 'experiment' lacks {', '.join(sorted(missing))}: expected a "
            "run folder of `experiments/camdm.py train`"
        )
    field = made_by["label"]
    parts = split_data(
        Path(data or made_by["data"]),
        tuple(made_by["contents"]),
        field,
        made_by["held_out"],
        labels=tuple(made_by["labels"]),
        held_out_clips=tuple(made_by["held_out_clips"]),
    )
    if contents and "content" in dict(parts[0].label_names):
        parts = tuple(selection.select(part, "content", contents) for part in parts)
    check_clips(model, parts[0], field)
    return Run(
        model=model, params=params, train=parts[0], held_out=parts[1], field=field
    )
