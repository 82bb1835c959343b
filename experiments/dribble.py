"""Puts a synthetic soccer ball beside recorded locomotion, as SMGDiff's training data.

The person is as recorded, under the recording's license: what this script writes stays
out of the repository as well.

Example:
  python experiments/dribble.py --data data/bandai1.npz data/bandai2.npz --out data/dribble.npz
  python experiments/dribble.py --data data/lafan1.npz --field action --dribble walk jog --sprint run sprint --stand none --celebrate none --out data/dribble_lafan1.npz
"""  # noqa: E501

import dataclasses
from collections.abc import Iterator
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
      draws: How often every clip is used, each time with a ball drawn anew.
      sprint_draws: The same of sprints, of which recordings have few; None for `draws`.
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
    draws: int = 1
    sprint_draws: int | None = None
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
    """All skills, in all draws.

    Args:
      config: The settings.
      clips: The recordings.

    Returns:
      Clips with a ball, of the label field "skill"; names of all draws but the first
      end in "#" and the draw's number.
    """
    sprints = config.draws if config.sprint_draws is None else config.sprint_draws
    own = {skill: chosen(clips, config, skill) for skill in _SKILLS}
    parts = [
        _numbered(part, draw)
        for draw in range(max(config.draws, sprints))
        for part in _one_draw(
            {
                skill: some
                for skill, some in own.items()
                if some is not None
                and draw < (sprints if skill == "sprint" else config.draws)
            },
            off_ball=config.off_ball if draw < config.draws else 0.0,
            seed=config.seed + draw,
        )
    ]
    if not parts:
        raise ValueError("every list of labels is none: nothing to make")
    source = parts[0].clips.source
    if max(config.draws, sprints) > 1:
        source = f"{source}, {config.draws} draws ({sprints} of sprint)"
    return _one_source(concatenate_ball_clips(parts), source)


_GAPS = {"dribble": (0.3, 1.2), "sprint": (0.5, 1.6)}
_SKILLS = (*_GAPS, "stand", "celebrate")


def _one_draw(
    own: dict[str, Clips], *, off_ball: float, seed: int
) -> Iterator[BallClips]:
    """A ball beside the clips of each skill."""
    near = dict(distance=_NEAR, angle=np.pi / 3, travel=0.5)
    for skill, clips in own.items():
        if skill in _GAPS:
            settings = Dribble(gap=_GAPS[skill])
            yield dribble_clips(clips, skill=skill, settings=settings, seed=seed)
        else:
            yield resting_clips(clips, skill=skill, seed=seed, **near)
    moving = [clips for skill, clips in own.items() if skill in _GAPS]
    if moving and off_ball > 0:
        every = selection.concatenate(moving)
        generator = np.random.default_rng(seed)
        number = max(round(off_ball * every.num_clips), 1)
        some = take_clips(every, generator.permutation(every.num_clips)[:number])
        yield resting_clips(some, skill="off_ball", distance=_FAR, seed=seed)


def _numbered(data: BallClips, draw: int) -> BallClips:
    """Clips whose names say of which draw they are."""
    if not draw:
        return data
    names = tuple(f"{name}#{draw + 1}" for name in data.clips.clip_names)
    return dataclasses.replace(
        data, clips=dataclasses.replace(data.clips, clip_names=names)
    )


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
