"""What tokens of a few channels can say: how far feet slide in recorded motion then.

A transformer's token that predicts n frames by a linear layer can say no more than what
lies in as many dimensions as it has channels. Recorded motion is cut into the frames
that each token predicts, projected to its own principal components, as many as a token
has channels, and put together as `blocks.unfold_frames` does. A network that errs alike
in all features does no better; losses of feet can turn its dimensions to feet.

Example: python experiments/token_span.py --data data/o3de.npz --layouts 5+4 1+0
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxmotion import cli, reporting
from jaxmotion.data import clips_io, resample, windows
from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import smoothness
from jaxmotion.evaluation.table import Cell
from jaxmotion.learning import loop
from jaxmotion.motion import contact, features
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.networks import blocks
from jaxmotion.systems.emdm import features as emdm_features

FIT, SCORED = 2048, 256  # windows


@dataclasses.dataclass(frozen=True)
class Config:
    """Measure what tokens of a few channels can say.

    Attributes:
      data: Clips from prepare_data.py.
      fps: Frames per second to which they are resampled; None for their own.
      frames: Frames of a motion; a multiple of those of each layout's token.
      layouts: Frames of a token + frames that it shares on either side.
      channels: Channels of a token.
      out: Folder for metrics.json and table.md.
    """

    data: Path
    fps: cli.Optional[float] = None
    frames: int = 60
    layouts: tuple[str, ...] = ("5+4", "4+3", "2+1", "1+0")
    channels: tuple[int, ...] = (64, 128, 256)
    out: Path = Path("runs/token_span")
    seed: int = 0


def layout_of(text: str, frames: int) -> tuple[int, int]:
    """Frames of a token, and those that it shares on either side.

    Raises:
      ValueError: if the text is none, or such tokens do not fill the frames.
    """
    own, _, margin = text.partition("+")
    if not (own.isdigit() and margin.isdigit() and int(own)):
        raise ValueError(f"--layouts: {text!r}, expected frames+shared as in 5+4")
    if frames % int(own):
        raise ValueError(f"--layouts: {text!r}, but --frames {frames} is no multiple")
    return int(own), int(margin)


def projected(
    fitted: np.ndarray, scored: np.ndarray, *, own: int, margin: int, channels: int
) -> np.ndarray:
    """Frames [motions, frames, features] as tokens of so many channels can say them.

    Args:
      fitted: Frames whose principal components are taken.
      scored: Frames that are projected.
      own: Frames of a token.
      margin: Frames that it shares on either side.
    """
    size = own + 2 * margin

    def tokens(frames: np.ndarray) -> np.ndarray:
        padded = np.pad(frames, ((0, 0), (margin, margin), (0, 0)), mode="edge")
        starts = range(0, frames.shape[1], own)
        cut = np.stack([padded[:, i : i + size] for i in starts], axis=1)
        return cut.reshape(*cut.shape[:2], -1)

    examples = tokens(fitted).reshape(-1, size * fitted.shape[-1])
    mean = examples.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov(examples.T))
    kept = vectors[:, -channels:]
    found = (tokens(scored) - mean) @ kept @ kept.T + mean
    made = blocks.unfold_frames(
        jnp.asarray(found, jnp.float32), own, margin=margin, window="hann"
    )
    return np.asarray(made)


def motions(clips: Clips, number: int, frames: int, key: jax.Array) -> Motion:
    """Random windows, each seen from its first pose."""
    index = windows.window_index(clips, frames, short="skip")
    found, _ = windows.sample_windows(key, clips, index, batch=number)
    return features.to_first_pose(clips.skeleton, found)


def main() -> None:
    """Writes the table."""
    args = cli.check(tyro.cli(Config, description=__doc__))
    layouts = [layout_of(text, args.frames) for text in args.layouts]
    loop.check_writable(args.out)
    clips = clips_io.load_clips(args.data)
    if args.fps is not None:
        clips = resample.resample_clips(clips, args.fps)
    keys = jax.random.split(jax.random.key(args.seed))
    fitted, scored = (
        motions(clips, number, args.frames, key)
        for number, key in zip((FIT, SCORED), keys, strict=True)
    )
    skeleton, units = clips.skeleton, emdm_features.fit(clips.skeleton, fitted)
    frames, truth = (
        np.asarray(emdm_features.to_features(x, units)) for x in (fitted, scored)
    )
    feet = np.asarray(skeleton.feet)
    recorded = joint_positions(skeleton, scored)
    stands = contact.foot_contacts(recorded[..., feet, :], clips.fps)

    def row(made: np.ndarray) -> dict[str, Cell]:
        motion = emdm_features.to_motion(jnp.asarray(made), units)
        found = joint_positions(skeleton, motion)
        steps = jnp.diff(found[..., feet, :], axis=-3)[..., (0, 2)]
        speed = jnp.linalg.norm(steps, axis=-1) * clips.fps
        slide = jnp.sum(speed * stands[..., :-1, :]) / jnp.sum(stands[..., :-1, :])
        values = {
            "features_left": np.sqrt(np.mean(np.square(made - truth))),
            "foot_slide": slide,
            "jerk": jnp.mean(smoothness.jerk(found, clips.fps)),
        }
        return {k: Cell(value=float(x), samples=SCORED) for k, x in values.items()}

    rows = {"recorded": row(truth)}
    for own, margin in layouts:
        for channels in args.channels:
            made = projected(frames, truth, own=own, margin=margin, channels=channels)
            name = f"tokens of {own} frames that share {margin}, {channels} channels"
            rows[name] = row(made)
            print(name, {k: round(x.value, 3) for k, x in rows[name].items()})
    about = {"source": clips.source} | reporting.provenance(args)
    reporting.write_table(args.out, rows, about, (clips.source,))


if __name__ == "__main__":
    cli.start(main)
