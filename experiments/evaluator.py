"""Frozen evaluators: train one, and score everybody's motions with it.

Examples:
  python experiments/evaluator.py train --kind style --data data/bandai2.npz --out evaluators/bandai2_style.npz
  python experiments/evaluator.py train --kind action --data data/bandai1.npz data/bandai2.npz --out evaluators/bandai_action.npz
  python experiments/evaluator.py train --kind ball --data data/dribble.npz --out evaluators/dribble_ball.npz
  python experiments/evaluator.py show evaluators/bandai2_style.npz
  python experiments/evaluator.py doubt evaluators/bandai2_style.npz --data data/bandai2.npz
  python experiments/camdm.py evaluate --run runs/camdm --evaluator evaluators/bandai2_style.npz
"""  # noqa: E501

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float

from jaxmotion import cli, reporting
from jaxmotion.data import resample, selection, windows
from jaxmotion.data.ball_clips import BallClips, load_ball_clips
from jaxmotion.data.clips import Clips
from jaxmotion.data.clips_io import load_clips
from jaxmotion.evaluation import faults, frechet, table
from jaxmotion.evaluators import action as action_evaluator
from jaxmotion.evaluators import frozen
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.frozen import Evaluator, clips_fingerprint
from jaxmotion.learning import loop
from jaxmotion.motion import features
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.systems.emdm import action_evaluation as emdm_action_evaluation
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import scoring as smgdiff_scoring
from jaxmotion.systems.smgdiff import training as smgdiff_training


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an evaluator on the training part of clips, and write it to a file.

    The defaults split clips as the systems' own `train` do, so that what a run held out
    its evaluator never saw; give the options that the run was trained with.

    Example: python experiments/evaluator.py train --kind style --data data/bandai2.npz --out evaluators/bandai2_style.npz

    Attributes:
      kind: "style" for camdm.py, "action" for emdm.py, "ball" for smgdiff.py.
      data: Clips from prepare_data.py or dribble.py; one file, but for actions.
      label: Field of the clips that is recognized; None for style, content or skill.
      contents: Contents of the clips to use (style); None for those of camdm.py, none:
        all clips.
      merge: Labels that name the same action as others, "old=new" (action); None for
        those of emdm.py.
      least: Fewest clips of an action (action); None for 10.
      fps: Frames per second that clips are resampled to (action); None for 15.
      frames: Frames that are scored at a time (action, ball); None for 60 or 45.
      held_out: Part of the clips or recordings that accuracy is measured on, in (0, 1).
      updates: Updates of the training; None for 1500, or 800 (ball).
      overwrite: Replace the file if it exists.
      seed: Seeds parameters, batches and windows.
    """  # noqa: E501

    kind: Literal["style", "action", "ball"] = "style"
    data: tuple[Path, ...] = (Path("data/bandai2.npz"),)
    label: str | None = None
    out: Path = Path("evaluators/bandai2_style.npz")
    contents: tuple[str, ...] | None = None
    merge: tuple[str, ...] | None = None
    least: int | None = None
    fps: float | None = None
    frames: int | None = None
    held_out: float = 0.1
    updates: int | None = None
    overwrite: bool = False
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Show:
    """Print what an evaluator is.

    Example: python experiments/evaluator.py show evaluators/bandai2_style.npz
    """

    file: tyro.conf.Positional[Path]


def one_file(args: Train) -> Path:
    """The only file of clips."""
    if len(args.data) != 1:
        raise ValueError(
            f"data has {len(args.data)} files, expected one for kind {args.kind!r}"
        )
    return args.data[0]


def train_style(args: Train) -> Evaluator:
    """Trains on windows of a label, for CAMDM."""
    field = args.label or "style"
    contents = camdm_training.CONTENTS if args.contents is None else args.contents
    train, held_out = camdm_training.split_data(
        one_file(args), contents, field, args.held_out
    )
    steps = 1500 if args.updates is None else args.updates
    return camdm_evaluation.train_style(
        train, held_out, field=field, num_steps=steps, seed=args.seed
    )


def train_action(args: Train) -> Evaluator:
    """Trains on whole motions of an action, for EMDM."""
    field = args.label or "content"
    clips, left_out = emdm_data.prepare_clips(
        args.data,
        field=field,
        merge=emdm_data.merges(emdm_data.MERGE if args.merge is None else args.merge),
        least=10 if args.least is None else args.least,
        fps=15.0 if args.fps is None else args.fps,
    )
    if left_out:
        print(f"left out, too few clips: {', '.join(left_out)}")
    parts = selection.split_clips(clips, fraction=args.held_out, seed=0, field=field)
    frames = 60 if args.frames is None else args.frames
    train, held_out = (
        emdm_data.action_arrays(part, field=field, frames=frames) for part in parts
    )
    steps = 1500 if args.updates is None else args.updates
    return emdm_action_evaluation.train_action(
        train, held_out, field=field, num_steps=steps, seed=args.seed
    )


def train_ball(args: Train) -> Evaluator:
    """Trains on skills with a ball, for SMGDiff."""
    if args.label not in (None, smgdiff_data.FIELD):
        raise ValueError(
            f"label is {args.label!r}, expected {smgdiff_data.FIELD!r} for kind 'ball'"
        )
    data = load_ball_clips(one_file(args))
    train, held_out = smgdiff_data.split(data, fraction=args.held_out)
    return smgdiff_evaluation.train_ball(
        train,
        held_out,
        frames=45 if args.frames is None else args.frames,
        num_steps=800 if args.updates is None else args.updates,
        seed=args.seed,
    )


# What trains a kind, and the options that only some kinds have.
KINDS: dict[str, tuple[Callable[[Train], Evaluator], tuple[str, ...]]] = {
    "style": (train_style, ("contents",)),
    "action": (train_action, ("merge", "least", "fps", "frames")),
    "ball": (train_ball, ("frames",)),
}


def check(args: Train) -> None:
    """Raises for what is wrong before any clip is read."""
    _, own = KINDS[args.kind]
    for _, options in KINDS.values():
        for name in options:
            if name not in own and getattr(args, name) is not None:
                raise ValueError(f"option --{name} is not for kind {args.kind!r}")
    if args.out.exists() and not args.overwrite:
        raise FileExistsError(f"{args.out} exists; --overwrite replaces it")


def train(args: Train) -> None:
    """Writes the file, and says how well it recognizes."""
    check(args)
    loop.check_writable(args.out.parent)
    begun = time.perf_counter()
    run, _ = KINDS[args.kind]
    print(f"training on {', '.join(map(str, args.data))}: minutes", flush=True)
    evaluator = run(args)
    frozen.save(args.out, evaluator)
    megabytes = args.out.stat().st_size / 1e6
    seconds = time.perf_counter() - begun
    print(f"wrote {args.out}, {megabytes:.1f} MB, after {seconds:.0f} s")
    show(Show(file=args.out))


def show(args: Show) -> None:
    """Prints the fields, the fingerprint first."""
    value = frozen.to_json(frozen.load(args.file))
    lines = {"fingerprint": value.pop("fingerprint"), "file": args.file} | value
    lines["accuracy"] = f"{100 * value['accuracy']:.1f} % of held-out clips' windows"
    if math.isnan(value["accuracy"]):
        lines["accuracy"] = "not known"
    for name, found in lines.items():
        shown = ", ".join(found) if isinstance(found, list) else found
        print(f"{name}: {shown}")


@dataclasses.dataclass(frozen=True)
class Import:
    """Write the style classifier released with CAMDM as an evaluator; runs no code of it.

    It scores CAMDM's motions of 100STYLE, of its skeleton or Mixamo's.

    Example: python experiments/evaluator.py import --weights 100style_position_classifier.pth --out evaluators/camdm_release.npz

    Attributes:
      overwrite: Replace the file if it exists.
    """  # noqa: E501

    weights: Path
    out: Path = Path("evaluators/camdm_release.npz")
    overwrite: bool = False


def import_weights(args: Import) -> None:
    """Writes the file."""
    if args.out.exists() and not args.overwrite:
        raise FileExistsError(f"{args.out} exists; --overwrite replaces it")
    frozen.save(args.out, frozen.released_style(args.weights))
    show(Show(file=args.out))


@dataclasses.dataclass(frozen=True)
class Doubt:
    """Plant faults into recordings, and see how far the evaluator finds them off.

    Random halves of windows with a fault are compared with the other halves as they were
    recorded; the first row has no fault. A fault that adds nothing to it, nobody sees in
    a Fréchet distance of this evaluator.

    Example: python experiments/evaluator.py doubt evaluators/bandai2_style.npz --data data/bandai2.npz

    Attributes:
      data: Clips of its skeleton, with a ball for kind "ball".
      out: Folder for metrics.json and table.md.
      windows: Windows that do not overlap, at most.
      replications: Random halves.
      seed: Seeds windows, halves and faults.
    """  # noqa: E501

    file: tyro.conf.Positional[Path]
    data: Path = Path("data/bandai2.npz")
    out: Path = Path("runs/doubt")
    windows: int = 600
    replications: int = 10
    seed: int = 0


# Of windows [windows, frames, ...] and the balls in them, if the evaluator sees balls.
Features = Callable[[Motion, Array | None], Float[Array, "windows features"]]


def sees(args: Doubt, evaluator: Evaluator) -> tuple[Clips, BallClips | None, Features]:
    """Clips at the evaluator's rate, their balls, and what it makes of windows."""
    balls = load_ball_clips(args.data) if evaluator.kind == "ball" else None
    clips = load_clips(args.data) if balls is None else balls.clips
    skeleton, params, config = clips.skeleton, evaluator.params, evaluator.config
    if evaluator.kind == "style_release" or skeleton.names != evaluator.joints:
        raise ValueError(
            f"{args.file} is of kind {evaluator.kind!r} and {len(evaluator.joints)} "
            f"joints, expected one of the {skeleton.num_joints} joints of {args.data}"
        )
    if balls is None:
        clips = resample.resample_clips(clips, evaluator.fps)
    elif clips.fps != evaluator.fps:
        raise ValueError(f"{args.data} has {clips.fps:g} fps, not {evaluator.fps:g}")
    else:
        representation = smgdiff_training.make_model(balls, sizes={}).representation

    @jax.jit
    def features_of(motion: Motion, ball: Array | None) -> Array:
        if evaluator.kind == "action":
            x = joint_positions(skeleton, features.to_first_pose(skeleton, motion))
            x = x.reshape(*x.shape[:-2], -1)
            key = jax.random.key(args.seed)
            return action_evaluator.classify(params, key, x, config=config)[0]
        if ball is None:
            x = style_evaluator.window_input(skeleton, motion)
        else:
            scene = Scene(motion=motion, ball=ball, touch=ball[..., :0])  # unseen
            x = smgdiff_scoring.evaluator_input(scene, representation)
        return style_evaluator.classify(params, x, config=config)[0]

    return clips, balls, features_of


def spoiled(
    motion: Motion, ball: Array | None, *, seed: int
) -> dict[str, tuple[Motion, Array | None]]:
    """Windows as recorded, and with faults; the ball stays where the root has it."""
    found = {"as recorded": motion}
    found |= faults.planted(jax.random.key(seed), motion)
    if ball is None:
        return {name: (one, None) for name, one in found.items()}
    away = ball - motion.root_position
    beside = {name: (one, one.root_position + away) for name, one in found.items()}
    swapped = motion.root_position + away[faults.other(len(away))]
    return beside | {"ball of another window": (motion, swapped)}


def doubt(args: Doubt) -> None:
    """Writes the table."""
    loop.check_writable(args.out)
    evaluator = frozen.load(args.file)
    clips, balls, features_of = sees(args, evaluator)
    length, generator = evaluator.frames, np.random.default_rng(args.seed)
    index = windows.window_index(clips, length, stride=length, short="skip")
    starts = generator.permutation(np.asarray(index.starts))
    # Two and two, for faults that are of another window: both are in one half.
    pairs = min(args.windows, starts.size) // 2
    if pairs < 2:
        raise ValueError(
            f"{starts.size} windows of {length} frames, of which --windows takes "
            f"{args.windows}: expected 4 or more"
        )
    starts = starts[: 2 * pairs]
    rows = jnp.asarray(np.add.outer(starts, np.arange(length)))
    motion = Motion(
        root_position=clips.root_position[rows],
        joint_rotation=clips.joint_rotation[rows],
        fps=clips.fps,
    )
    ball = None if balls is None else balls.position[rows]
    made = spoiled(motion, ball, seed=args.seed)
    found = {name: features_of(*given) for name, given in made.items()}
    orders = [generator.permutation(pairs) for _ in range(args.replications)]
    orders = [np.stack([2 * x, 2 * x + 1], axis=1).reshape(-1) for x in orders]
    parts = [np.split(x, [pairs // 2 * 2]) for x in orders]
    plain = [frechet.moments(found["as recorded"][b]) for _, b in parts]
    distance = jax.jit(
        lambda own, other: frechet.frechet_distance(frechet.moments(own), other)
    )
    distances = {
        name: jnp.stack(
            [
                distance(own[a], other)
                for (a, _), other in zip(parts, plain, strict=True)
            ]
        )
        for name, own in found.items()
    }
    cells = functools.partial(table.cell, part=0.5)
    added = {name: x - distances["as recorded"] for name, x in distances.items()}
    table_rows = {
        name: {"fid": cells(x), "fid_added": cells(added[name])}
        for name, x in distances.items()
    }
    reference = clips_fingerprint(clips, evaluator.field)
    described = frozen.describe(evaluator.params, evaluator, reference=reference)
    report = {"source": clips.source, "evaluator": described}
    report |= reporting.provenance(args)
    reporting.write_table(args.out, table_rows, report, (frozen.note(described),))


COMMANDS = {
    "train": (Train, train),
    "show": (Show, show),
    "doubt": (Doubt, doubt),
    "import": (Import, import_weights),
}


def main() -> None:
    """Parses the command line and runs the command."""
    cli.run(COMMANDS, __doc__)


if __name__ == "__main__":
    cli.start(main)
