"""Reads a published motion set or your own files, or generates one, into one npz file.

The file holds clips, for ballplay and soccer_x with a ball, or for humanml3d and kit_ml
feature vectors with captions.

The sets are third-party recordings: get them from their publishers, mind their
licenses, and keep what this script writes out of the repository. World coordinates
(meters, y up) stay as published.

Example:
  python experiments/prepare_data.py procedural --out data/walker.npz
  python experiments/prepare_data.py lafan1 --manual-dir raw/lafan1 --out data/l.npz
  python experiments/prepare_data.py kit_ml --manual-dir raw/KIT-ML --out data/k.npz
  python experiments/prepare_data.py ballplay --manual-dir raw/ballplay --out data/b.npz
  python experiments/prepare_data.py bvh --manual-dir my_takes --out data/mine.npz
  python experiments/prepare_data.py o3de_motion_matching --manual-dir raw/o3de --actions --out data/actions_o3de.npz
"""  # noqa: E501

import dataclasses
import functools
import os
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from jaxmotion import cli
from jaxmotion.data import (
    actions,
    clips_io,
    loops,
    mirror,
    resample,
    text_motion,
)
from jaxmotion.data.ball_clips import BallClips, save_ball_clips
from jaxmotion.data.builders import REGISTRY
from jaxmotion.data.clips import Clips
from jaxmotion.data.text_motion import TextMotions

# "procedural" generates a styled walker; "bvh" and "fbx" read your own files.
Source = Literal[*REGISTRY, "procedural", "bvh", "fbx"]
OWN = ("bvh", "fbx")


@dataclasses.dataclass(frozen=True)
class Config:
    """What to read, and where to write it."""

    source: Annotated[Source, tyro.conf.Positional]
    """The motion set; "procedural" generates a styled walker; "bvh" and "fbx" read any
    folder of such files of one skeleton, whose folders below it are the styles."""
    out: Path
    """File to write (.npz)."""
    manual_dir: Path | None = None
    """Folder with the files as their publisher lays them out (zips or unzipped)."""
    fps: float | None = None
    """Frames per second of the result; other rates are resampled. By default 30, for
    humanact12 its own 20; sets with captions keep theirs."""
    mirror: bool = False
    """Add the left-right mirror image of every clip that has none (style100: of
    symmetric styles, under the same label; the others swap left and right in their
    labels). The trainings of camdm.py and aamdm.py add them anyway."""
    tfds_dir: Path | None = None
    """Folder of the tensorflow-datasets files; by default tfds beside --out."""
    overwrite: bool = False
    """Replace --out, and read the published files again."""
    seed: int = 0
    """Seed of the procedural walker."""
    labels: Path | None = None
    """bvh, fbx: a table of file,start,end,label (seconds; empty: from the beginning, to
    the end); files that it does not name are left out."""
    scale: float | None = None
    """bvh, fbx: meters per unit of the files; by default detected, and printed."""
    up: Literal["y", "z"] | None = None
    """bvh, fbx: the axis that is up; by default detected, and printed."""
    feet: tuple[str, ...] = ()
    """bvh, fbx: joints whose contact with the ground counts, left before right; by
    default the toes."""
    all_joints: bool = False
    """bvh, fbx: keep fingers and helpers too."""
    tolerance: float = 0.01
    """bvh, fbx: largest difference between two files' bones, meters."""
    longest: float = 20.0
    """bvh, fbx: longer takes become several clips, so that some can be held out,
    seconds."""
    credit: str = ""
    """bvh, fbx: name of the data and its license, which models and pictures cite."""
    actions: bool = False
    """Cut takes into stretches of 3 to 4 s in which a person walks, jogs, runs, turns,
    crouches, jumps, pushes or stands, by rule (field "action"); for takes with styles
    such as those of o3de_motion_matching."""
    loops: float | None = None
    """Seconds of each half of a meter per second from 2 to 4.1 m/s, for a model that is
    to see people who run on: what the takes lack is added as strides of theirs,
    repeated, slower and faster. None comes from the last tenth of a take."""
    cut_fps: float = 20.0
    """Frames per second by which the times of captions cut clips; the released loaders
    take 20 for kit_ml too, whose rate is 12.5."""


def check_config(config: Config) -> None:
    """Finds what would stop the work at its end before it begins.

    Raises:
      FileNotFoundError: if the folder of the published files is missing.
      FileExistsError: if the output exists and is not to be replaced.
      OSError: if the output cannot be written.
      ValueError: if a rate or the seed is out of range, or a setting does not fit.
    """
    for name in ("fps", "cut_fps"):
        rate = getattr(config, name)
        low, high = clips_io.RATES
        if rate is not None and not low <= rate <= high:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} should be in {low:g}..{high:g}, found {rate}")
    if not 0 <= config.seed < 2**32:
        raise ValueError(f"--seed should be in 0..2**32 - 1, found {config.seed}")
    if config.scale is not None and not config.scale > 0:
        raise ValueError(f"--scale should be above 0, found {config.scale}")
    own = dict(
        labels=config.labels,
        scale=config.scale,
        up=config.up,
        feet=config.feet,
        all_joints=config.all_joints,
        credit=config.credit,
    )
    given = [name for name, value in own.items() if value]
    if config.source not in OWN and given:
        option = given[0].replace("_", "-")
        raise ValueError(f"--{option} is for bvh and fbx, not for {config.source}")
    if config.labels is not None and not config.labels.is_file():
        raise FileNotFoundError(f"--labels: no file {config.labels}")
    known = REGISTRY.get(config.source)
    kind = "clips" if known is None else known.kind
    if kind != "clips" and config.actions:
        raise ValueError(
            f"{config.source} has no takes to cut: --actions does not apply"
        )
    if config.loops is not None and not 2 <= config.loops <= 3600:
        raise ValueError(f"--loops should be in 2..3600 seconds, found {config.loops}")
    if config.loops is not None and (kind != "clips" or config.actions):
        what = "stretches of --actions" if config.actions else config.source
        raise ValueError(f"--loops repeats strides of takes, not of {what}")
    if kind != "clips" and (config.mirror or config.fps is not None):
        reason = {
            "texts": "is published with mirror images and at its own rate",
            "ball": "is read at 30 frames per second, since touches of the ball cannot "
            "be resampled",
        }[kind]
        raise ValueError(f"{config.source} {reason}: --mirror and --fps do not apply")
    if config.source != "procedural":
        if config.manual_dir is None:
            raise FileNotFoundError(f"{config.source} needs --manual-dir")
        if not config.manual_dir.is_dir():
            raise FileNotFoundError(f"--manual-dir: no folder {config.manual_dir}")
    if config.out.is_dir():
        raise IsADirectoryError(f"--out: {config.out} is a folder, expected a file")
    if config.out.exists() and not config.overwrite:
        raise FileExistsError(f"--out: {config.out} exists; use --overwrite")
    config.out.parent.mkdir(parents=True, exist_ok=True)
    probe = config.out.with_name(f".{config.out.name}.{os.getpid()}.probe")
    probe.touch()
    probe.unlink()


def read_published(config: Config) -> Clips | BallClips | TextMotions:
    """A published set at its own rate, by way of its tensorflow-datasets builder."""
    from jaxmotion.data.builders import ball_base, base, humanml3d

    found = REGISTRY[config.source]
    folder = config.tfds_dir or config.out.parent / "tfds"
    builder = found.make(str(folder), mirror=config.mirror)
    if builder.data_path.exists() and not config.overwrite:
        print(f"reusing  {builder.data_path}; --overwrite reads --manual-dir again")
    base.prepare(builder, config.manual_dir, overwrite=config.overwrite)
    if found.kind == "texts":
        return humanml3d.text_motions_from_source(builder, cut_fps=config.cut_fps)
    if found.kind == "ball":
        return ball_base.ball_clips_from_source(builder)
    return base.clips_from_source(builder)


def read_own(config: Config) -> Clips:
    """A folder of files of one skeleton; prints what is detected."""
    from jaxmotion.data import fbx, own
    from jaxmotion.data.builders import base

    read = own.read_bvh
    if config.source == "fbx":  # has curves, not frames
        read = functools.partial(fbx.read_fbx, fps=config.fps or 30.0)
    table = None
    if config.labels is not None:
        text = base.read_text(str(config.labels), config.labels.read_bytes())
        table = own.read_labels(str(config.labels), text)
    found = base.read_files(config.manual_dir, (f".{config.source}",), unique=False)
    clips, notes = own.clips_from_recordings(
        (read(path, data) for path, data in found),
        folder=str(config.manual_dir),
        table=table,
        scale=config.scale,
        up=config.up,
        feet=config.feet,
        all_joints=config.all_joints,
        tolerance=config.tolerance,
        longest=config.longest,
        source=config.credit,
    )
    print("\n".join(notes))
    return clips


def describe(clips: Clips, path: Path) -> str:
    """Lines with counts of what was written."""
    minutes = clips.num_frames / clips.fps / 60
    lengths = np.diff(np.asarray(clips.offsets))
    lines = [
        f"source   {clips.source}",
        f"clips    {clips.num_clips} ({lengths.min()} to {lengths.max()} frames)",
        f"frames   {clips.num_frames} at {clips.fps:g} fps = {minutes:.1f} minutes",
        f"joints   {clips.skeleton.num_joints}, feet "
        f"{', '.join(clips.skeleton.names[foot] for foot in clips.skeleton.feet)}",
    ]
    for field, names in clips.label_names:
        counts = np.bincount(np.asarray(clips.labels[field]), minlength=len(names))
        words = [f"{name} {n}" for name, n in zip(names, counts, strict=True)]
        lines.append(f"{field:8} {', '.join(words)}")
    if actions.FIELD in dict(clips.label_names):
        lines.append(f"seconds  {label_lengths(clips, actions.FIELD, 1.0)}")
    return "\n".join([*lines, f"written  {path}, {path.stat().st_size / 1e6:.1f} MB"])


def label_lengths(clips: Clips, field: str, unit: float) -> str:
    """Length of all clips of each label together, in units of so many seconds."""
    names, lengths = clips.names(field), np.diff(np.asarray(clips.offsets))
    seconds = np.bincount(np.asarray(clips.labels[field]), lengths, len(names))
    sums = seconds / clips.fps / unit
    return ", ".join(f"{name} {n:.2f}" for name, n in zip(names, sums, strict=True))


def describe_ball(data: BallClips, path: Path) -> str:
    """Lines with counts of clips with a ball."""
    clips, touch = data.clips, np.asarray(data.touch)
    minutes = clips.num_frames / clips.fps / 60
    touch = np.concatenate([touch.any(1, keepdims=True), touch], axis=1)
    before = np.roll(touch, 1, axis=0)
    before[np.asarray(clips.offsets)[:-1]] = False
    who = ["any joint", *(clips.skeleton.names[joint] for joint in data.joints)]
    counts = (touch & ~before).sum(0) / minutes
    words = [f"{name} {n:.1f}" for name, n in zip(who, counts, strict=True)]
    lines = [
        f"ball     radius {data.radius:g} m, lowest at "
        f"{float(np.asarray(data.position)[:, 1].min()):.3f} m",
        f"touches  in {100 * touch[:, 0].mean():.1f} % of frames; beginnings a minute: "
        f"{', '.join(words)}",
    ]
    for field, _ in clips.label_names:
        lines.append(f"minutes  of each {field}: {label_lengths(clips, field, 60.0)}")
    return "\n".join([describe(clips, path), *lines])


def describe_texts(motions: TextMotions, path: Path) -> str:
    """Lines with counts of clips with captions."""
    lengths = np.diff(motions.offsets)
    splits = [f"{name} {motions.clips_of(name).size}" for name in motions.split_names]
    lines = [
        f"source   {motions.source}",
        f"clips    {motions.num_clips} ({lengths.min()} to {lengths.max()} frames)",
        f"splits   {', '.join(splits)}",
        f"captions {len(motions.captions)}",
        f"frames   {lengths.sum()} at {motions.fps:g} fps, "
        f"{motions.num_features} features",
        f"written  {path}, {path.stat().st_size / 1e6:.1f} MB",
    ]
    return "\n".join(lines)


def prepare(config: Config) -> None:
    """Prepares the data and prints what it is."""
    check_config(config)
    start, set_fps, mirrored = time.time(), 30.0, False
    if config.source == "procedural":
        from jaxmotion.data import procedural

        data = procedural.make_clips(fps=config.fps or set_fps, seed=config.seed)
    elif config.source in OWN:
        data = read_own(config)
    else:
        found = REGISTRY[config.source]
        data, set_fps, mirrored = read_published(config), found.fps, found.mirrored
    if isinstance(data, TextMotions):
        text_motion.save_text_motions(config.out, data)
        print(describe_texts(data, config.out))
    elif isinstance(data, BallClips):
        save_ball_clips(config.out, data)
        print(describe_ball(data, config.out))
    else:
        clips = resample.resample_clips(data, config.fps or set_fps or data.fps)
        if config.actions:
            clips = actions.cut_actions(clips)
        if config.loops is not None:
            clips = loops.with_loops(clips, seconds=config.loops)
        if config.mirror and not mirrored:
            clips = mirror.with_mirrored(clips)
        clips_io.save_clips(config.out, clips)
        print(describe(clips, config.out))
    print(f"took     {time.time() - start:.1f} s")


def main() -> None:
    """Parses the command line and prepares the data."""
    prepare(cli.check(tyro.cli(Config, description=__doc__)))


if __name__ == "__main__":
    cli.start(main)
