"""CAMDM on prepared clips: train, evaluate, roll out.

Examples:
  python experiments/prepare_data.py bandai_namco/2 --manual-dir ../shared/data/bandai_namco --out data/bandai2.npz
  python experiments/camdm.py train --data data/bandai2.npz --out runs/camdm
  python experiments/camdm.py evaluate --run runs/camdm
  python experiments/camdm.py rollout --run runs/camdm --style elderly --seconds 20
"""  # noqa: E501

import dataclasses
import functools
import json
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import tyro

from jaxmotion.data import clips_io, mirror, selection, windows
from jaxmotion.data.clips import Clips
from jaxmotion.learning import checkpoint, loop, training
from jaxmotion.systems import camdm, camdm_model

PRESETS = {
    # The paper's network and frame; a day on a large GPU.
    "paper": dict(),
    # For a CPU or a short run: 31 tokens instead of 147, samples that face +z, and
    # weights that count displacements (per frame, hence tiny) as much as features.
    "small": dict(
        frames_per_token=5,
        heading="facing",
        dropout=0.0,
        weight_velocity=5.0,
        weight_position=2.0,
        weight_position_velocity=20.0,
        weight_foot=20.0,
    ),
}


@dataclasses.dataclass(frozen=True)
class Train:
    """Train CAMDM on prepared clips; a run that was stopped goes on where it was.

    Attributes:
      data: Clips from prepare_data.py.
      out: Run folder: checkpoints, config.json, losses.jsonl.
      preset: "paper", or "small" for a CPU or a short run.
      contents: Use only clips of these contents (for Bandai-Namco walk, run ...);
        none: all clips.
      label: Field of the clips that is the style.
      held_out: Fraction of clips kept for evaluation.
      mirror: Add a mirrored copy of every training clip.
      steps: Optimiser steps of the whole run.
      batch: Windows a step.
      learning_rate: Peak of AdamW's rate; cosine to a tenth.
      warmup: Steps of linear rise.
      ema: Decay of the parameters' moving average a step.
      chunk: Steps of one compiled call.
      save_every: Steps between checkpoints.
      width: Channels of a token; None for the preset's.
      depth: Layers; None for the preset's.
      diffusion_steps: T.
      devices: Split each batch over so many devices; 1 for no mesh.
      seed: Of everything random.
    """

    data: Path = Path("data/bandai2.npz")
    out: Path = Path("runs/camdm")
    preset: Literal["small", "paper"] = "small"
    contents: tuple[str, ...] = ("walk", "walk-turn-left", "walk-turn-right", "run")
    label: str = "style"
    held_out: float = 0.1
    mirror: bool = True
    steps: int = 24000
    batch: int = 32
    learning_rate: float = 5e-4
    warmup: int = 500
    ema: float = 0.999
    chunk: int = 50
    save_every: int = 1000
    width: int | None = None
    depth: int | None = None
    diffusion_steps: int = 8
    devices: int = 1
    seed: int = 0


def split_data(
    data: Path, contents: tuple[str, ...], label: str, held_out: float
) -> tuple[Clips, Clips]:
    """Training and held-out clips; the same for every run with these arguments."""
    clips = clips_io.load_clips(data)
    clips.names(label)
    if contents and "content" in dict(clips.label_names):
        clips = selection.select(clips, "content", contents)
    return selection.split_clips(clips, fraction=held_out, seed=0, field=label)


def model_of(args: Train, clips: Clips) -> camdm_model.Model:
    """The model that the arguments describe, for these clips."""
    sizes = {"width": args.width, "depth": args.depth}
    if args.width:
        sizes["hidden"] = 4 * args.width
    config = camdm.Config(
        num_joints=clips.skeleton.num_joints,
        num_labels=len(clips.names(args.label)),
        num_steps=args.diffusion_steps,
        fps=clips.fps,
        **PRESETS[args.preset],
        **{name: value for name, value in sizes.items() if value},
    )
    return camdm_model.Model(
        config=config,
        bones=clips.skeleton,
        labels=clips.names(args.label),
        source=clips.source,
    )


def train(args: Train) -> None:
    """Trains, with checkpoints."""
    loop.check_writable(args.out)
    clips, _ = split_data(args.data, args.contents, args.label, args.held_out)
    model = model_of(args, clips)
    if args.mirror:
        clips = selection.concatenate([clips, mirror.mirror_clips(clips)])
    index = windows.window_index(clips, model.config.window, short="skip")
    print(
        f"{clips.num_clips} clips, {clips.num_frames} frames, "
        f"{index.starts.shape[0]} windows of {index.length} frames"
    )
    experiment = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in dataclasses.asdict(args).items()
    }
    config = camdm_model.to_json(model) | {"experiment": experiment}
    (args.out / "config.json").write_text(json.dumps(config, indent=1))

    optimizer = training.adamw_cosine(
        learning_rate=args.learning_rate,
        num_steps=args.steps,
        warmup_steps=args.warmup,
        max_norm=1.0,
    )
    objective = functools.partial(camdm.loss, bones=model.bones, config=model.config)
    update = training.make_update(objective, optimizer, ema_decay=args.ema)
    mesh = jax.make_mesh((args.devices,), ("data",)) if args.devices > 1 else None

    def sample_batch(key, data):
        clips, index = data
        motion, clip = windows.sample_windows(key, clips, index, batch=args.batch)
        return motion, clips.labels[args.label][clip]

    key_init, key_train = jax.random.split(jax.random.key(args.seed))
    state = training.init_train_state(camdm.init(key_init, model.config), optimizer)
    parameters = sum(x.size for x in jax.tree.leaves(state.params))
    print(f"{parameters} parameters on {jax.devices()[0].platform}")
    if checkpoint.latest_step(args.out / "checkpoints") is not None:
        state = checkpoint.restore(args.out / "checkpoints", state)
        print(f"resuming at step {int(state.step)}")
    loop.train(
        training.train_chunk(update, sample_batch, num_steps=args.chunk, mesh=mesh),
        training.replicate(state, mesh),
        key_train,
        training.replicate(jax.tree.map(jnp.asarray, (clips, index)), mesh),
        loop=loop.Loop(
            num_steps=args.steps,
            chunk=args.chunk,
            save_every=args.save_every,
            folder=args.out,
            config=config,
            show=("loss", "data", "position", "foot"),
        ),
    )


def main() -> None:
    """Parses the command line and runs the command."""
    train(tyro.cli(Train, description=__doc__))


if __name__ == "__main__":
    main()
