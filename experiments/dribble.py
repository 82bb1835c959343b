"""Puts a synthetic soccer ball beside recorded locomotion, as SMGDiff's training data.

The person is as recorded, under the recording's license: what this script writes stays
out of the repository as well.

Example:
  python experiments/dribble.py --data data/bandai1.npz data/bandai2.npz --out data/dribble.npz
  python experiments/dribble.py --data data/lafan1.npz --field action --dribble walk jog --sprint run sprint --stand none --celebrate none --out data/dribble_lafan1.npz
"""  # noqa: E501

import dataclasses
from pathlib import Path

import numpy as np
import tyro

from jaxmotion import cli
from jaxmotion.data import clips_io, selection
from jaxmotion.data.ball_clips import BallClips, save_ball_clips, take_ball_clips
from jaxmotion.data.clips import Clips, take_clips
from jaxmotion.data.dribble import (
    Dribble,
    concatenate_ball_clips,
    dribble_clips,
    resting_clips,
)
from jaxmotion.learning import loop

_FAR, _NEAR = (2.5, 5.0), (0.4, 0.8)


@dataclasses.dataclass(frozen=True)
class Config:
    """Synthesises skills from labeled clips of one skeleton.

    Attributes:
      data: Clips from prepare_data.py.
      field: Label field that says what a clip shows.
      dribble: Labels beside which a ball is dribbled in touches 0.3 to 1.2 s apart.
      sprint: Labels beside which it is kicked ahead, touches 0.5 to 1.6 s apart.
      stand: Labels before whose feet it lies.
      celebrate: The same, under a skill of its own.
      off_ball: Part of the clips of `dribble` and `sprint` that are used once more,
        with the ball lying out of reach.
      overwrite: Replace --out.
    """

    data: tuple[Path, ...] = (Path("data/bandai1.npz"), Path("data/bandai2.npz"))
    out: Path = Path("data/dribble.npz")
    field: str = "content"
    dribble: tuple[str, ...] = ("walk", "walk-turn-left", "walk-turn-right")
    sprint: tuple[str, ...] = ("run", "dash")
    stand: tuple[str, ...] = ("bow", "guide", "wave-left-hand", "wave-right-hand")
    celebrate: tuple[str, ...] = ("raise-up-both-hands", "wave-both-hands")
    off_ball: float = 0.3
    seed: int = 0
    overwrite: bool = False


def chosen(clips: Clips, config: Config, skill: str) -> Clips | None:
    """Clips of a skill's labels; None for the label "none"."""
    labels = getattr(config, skill)
    if labels == ("none",):
        return None
    try:
        return selection.select(clips, config.field, labels)
    except ValueError as error:
        raise ValueError(f"--{skill}: {error}; give labels of these, or none") from None


def synthesise(config: Config, clips: Clips) -> BallClips:
    """All skills.

    Args:
      config: The settings.
      clips: The recordings.

    Returns:
      Clips with a ball, of the label field "skill".
    """
    parts, moving = [], []
    for skill, gap in (("dribble", (0.3, 1.2)), ("sprint", (0.5, 1.6))):
        own = chosen(clips, config, skill)
        if own is not None:
            settings = Dribble(gap=gap)
            moving.append(own)
            parts.append(
                dribble_clips(own, skill=skill, settings=settings, seed=config.seed)
            )
    for skill in ("stand", "celebrate"):
        own = chosen(clips, config, skill)
        if own is not None:
            near = dict(distance=_NEAR, angle=np.pi / 3, travel=0.5)
            parts.append(resting_clips(own, skill=skill, seed=config.seed, **near))
    if moving and config.off_ball > 0:
        every = selection.concatenate(moving)
        generator = np.random.default_rng(config.seed)
        number = max(round(config.off_ball * every.num_clips), 1)
        some = take_clips(every, generator.permutation(every.num_clips)[:number])
        parts.append(
            resting_clips(some, skill="off_ball", distance=_FAR, seed=config.seed)
        )
    if not parts:
        raise ValueError("every list of labels is none: nothing to make")
    return _one_source(concatenate_ball_clips(parts), parts[0].clips.source)


def _one_source(data: BallClips, source: str) -> BallClips:
    """Named once, not once a skill; clips too short to have two frames left out."""
    lengths = np.diff(np.asarray(data.clips.offsets))
    data = take_ball_clips(data, np.flatnonzero(lengths > 1))
    clips = dataclasses.replace(data.clips, source=source)
    return dataclasses.replace(data, clips=clips)


def describe(data: BallClips) -> None:
    """Prints what was made, skill by skill."""
    clips, touch = data.clips, np.asarray(data.touch).any(axis=1)
    offsets, labels = np.asarray(clips.offsets), np.asarray(clips.labels["skill"])
    owner = np.repeat(labels, np.diff(offsets))
    starts = touch & ~np.concatenate([[False], touch[:-1]])
    for number, name in enumerate(clips.names("skill")):
        mine = owner == number
        minutes = mine.sum() / clips.fps / 60
        print(
            f"{name}: {(labels == number).sum()} clips, {minutes:.1f} minutes, "
            f"{starts[mine].sum() / max(minutes, 1e-9):.0f} touches a minute"
        )
    print(clips.source)


def main() -> None:
    """Reads, synthesises, writes."""
    config = cli.check(tyro.cli(Config, description=__doc__))
    loop.check_writable(config.out.parent)
    if config.out.exists() and not config.overwrite:
        raise FileExistsError(f"{config.out} exists; --overwrite replaces it")
    files = [clips_io.load_clips(path) for path in config.data]
    data = synthesise(config, selection.concatenate(files))
    save_ball_clips(config.out, data)
    describe(data)
    print(f"wrote {config.out}, {config.out.stat().st_size / 1e6:.0f} MB")


if __name__ == "__main__":
    cli.start(main)
