"""EMDM and what it is compared with: train, evaluate, sample, export, levels.

Examples:
  python experiments/prepare_data.py bandai_namco/1 --manual-dir path/to/zips --out data/bandai1.npz
  python experiments/prepare_data.py bandai_namco/2 --manual-dir path/to/zips --out data/bandai2.npz
  python experiments/emdm.py train --task action --out runs/emdm_action
  python experiments/emdm.py evaluate --run runs/emdm_action
  python experiments/emdm.py sample --run runs/emdm_action --action bow
  python experiments/emdm.py train --task text --out runs/emdm_text
  python experiments/emdm.py sample --run runs/emdm_text --text "an elderly person walks and turns left"
"""  # noqa: E501

import dataclasses
import itertools
import re
import time
from pathlib import Path
from typing import Literal

from jaxmotion import cli, reporting
from jaxmotion.evaluation import by_frame
from jaxmotion.evaluators import frozen
from jaxmotion.evaluators.text_motion import Padding
from jaxmotion.learning import checkpoint, loop, runs
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import evaluation as emdm_evaluation
from jaxmotion.systems.emdm import levels as emdm_levels
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import sampler as emdm_sampler
from jaxmotion.systems.emdm import scoring as emdm_scoring
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.typing import Params


@dataclasses.dataclass(frozen=True)
class Train:
    """Train rows of EMDM's tables; what a folder has already is not trained again.

    Example: python experiments/emdm.py train --task action --out runs/emdm_action

    Attributes:
      task: What motions are made from.
      data: Clips of one skeleton; or a file of text motions.
      rows: What to train; "all"; "none": only data.
      field: Label field that is the action.
      merge: Labels of one action, "old=new".
      least: Fewest clips of an action.
      encoder: "wordllama", "hashed", or CLIP's folder.
      text_form: "released" (20 tokens) or "unit" (ours: all).
      unseen: "content/style" pairs kept for evaluation (texts).
      frames: Longest motion; else 60, or 120 (texts).
      fps: Per second; else 15, or 20 (texts).
      held_out: Part of the clips kept for evaluation.
      mirror: Add a mirrored copy of each training clip (actions).
      steps: Updates of each GAN.
      ddpm_steps: Updates of each row without a discriminator.
      batch: Motions per update.
      width: Channels of a token.
      hidden: Channels of the feed-forward layers.
      dropout: Rate (paper: 0.1).
      frames_per_token: Frames of one token (paper: 1).
      token_margin: Frames that tokens share (paper: 0).
      mask_frames: Hide what follows a motion's end (ours).
      discriminator_width: Channels of its first layers.
      diffusion_steps: Steps T of the row "emdm".
      recon: Weight R of the features' error; else 1, or 100.
      geometry: Frame of the losses of joints (released: root).
      fade_geometry: Losses of joints count less at noisy steps (ours).
      weigh_levels: How errors weigh by noise level: alike (published), or as the
        posterior weighs the discriminator's verdict.
      weight_position: Weight of the loss of joint positions; with actions.
      weight_velocity: Weight of the loss of frame differences; with actions.
      weight_position_velocity: Weight of the loss of joint displacements; with actions
        (ours).
      weight_acceleration: Weight of the loss of their second differences; with actions
        (ours).
      weight_foot: Weight of the loss of standing feet that slide; with actions.
      optimizer: Optimizer of generators: muon, or adam at a constant rate (published:
        2e-5).
      learning_rate: Peak rate of generators.
      ddpm_rate: Peak rate of rows without a discriminator (Muon).
      discriminator_rate: Rate of the discriminator (Adam), which falls as the
        generator's does (published: constant, 6 times the generator's).
      init: Run folder or exported model to start from (actions); a folder's row of the
        same name.
      alone: Part of a GAN's updates that its generator makes first, without the
        discriminator (ours).
      distributed: One of several processes: "auto", or address, number, index.
      override: Go on with other settings than before.
    """

    task: emdm_training.TaskName = "action"
    data: tuple[Path, ...] = (Path("data/bandai1.npz"), Path("data/bandai2.npz"))
    out: Path = Path("runs/emdm_action")
    rows: cli.Names = ("emdm",)
    field: str = "content"
    merge: cli.Names = emdm_data.MERGE
    least: int = 10
    encoder: str = "wordllama"
    text_form: cli.Optional[emdm_text.TextForm] = None
    unseen: cli.Names = (
        "walk-turn-left/elderly",
        "run/feminine",
        "wave-both-hands/exhausted",
        "raise-up-right-hand/youthful",
    )
    frames: cli.Optional[int] = None
    fps: cli.Optional[float] = None
    held_out: float = 0.1
    mirror: bool = False
    steps: int = 5000
    ddpm_steps: int = 7700
    batch: int = 32
    width: int = 128
    depth: int = 4
    hidden: int = 384
    dropout: float = 0.0
    frames_per_token: int = 4
    token_margin: int = 3
    mask_frames: bool = True
    discriminator_width: int = 128
    diffusion_steps: int = 10
    recon: cli.Optional[float] = None
    geometry: Literal["root", "world"] = "world"
    fade_geometry: bool = False
    weigh_levels: Literal["alike", "posterior"] = "alike"
    weight_position: float = 1.0
    weight_velocity: float = 1.0
    weight_position_velocity: float = 0.0
    weight_acceleration: float = 0.0
    weight_foot: float = 1.0
    optimizer: Literal["muon", "adam"] = "muon"
    learning_rate: float = 2e-3
    ddpm_rate: float = 2e-3
    discriminator_rate: float = 5e-4
    init: cli.Optional[Path] = None
    alone: float = 0.0
    distributed: cli.Distributed = ()
    seed: int = 0
    override: bool = False


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Score every trained row beside real motions; writes metrics.json and table.md.

    Example: python experiments/emdm.py evaluate --run runs/emdm_action

    Attributes:
      rows: Which rows and samplers (ddim_10); "all": those that were trained.
      out: Folder; None for <run>/evaluation.
      samples: Motions of a replication (actions: rounded down to as many of each).
      replications: Sets of motions of each row.
      long_replications: Sets of rows with 500 steps and more.
      scale: Scale of classifier-free guidance; None for the paper's of the task.
      evaluator_steps: Updates of the evaluator; None for 1500 of that of
        actions, 600 of that of texts, whose updates cost ten times as much.
      evaluator: File of a frozen evaluator of actions, from evaluator.py; None trains
        one here.
      matcher: Published weights of the text-motion evaluator (finest.tar), beside them
        mean.npy and std.npy of its meta folder; None trains one here.
      glove: Folder of the word vectors that the published weights read:
        our_vab_data.npy, our_vab_words.pkl and our_vab_idx.pkl. Needed with --matcher.
      padding: What the text-motion evaluator sees beyond the end of generated motions:
        "zeros" (ours), as beyond that of real ones, or "kept", what the model put there
        (as released).
      foot_lock: Score motions whose planted feet stand, as `jaxmotion.load` gives them
        (actions).
      seed: Seeds noise and pairs.
    """

    run: Path = Path("runs/emdm_action")
    rows: tuple[str, ...] = ("all",)
    out: Path | None = None
    samples: int = 1000
    replications: int = 20
    long_replications: int = 2
    scale: float | None = None
    evaluator_steps: int | None = None
    evaluator: Path | None = None
    matcher: Path | None = None
    glove: Path | None = None
    padding: Padding = "zeros"
    foot_lock: bool = False
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Sample:
    """Make motions; writes BVH, GIF and HTML of each.

    Example: python experiments/emdm.py sample --run runs/emdm_action --action bow

    Attributes:
      action: Action, for a run of actions; several make several motions.
      text: Sentence, for a run of texts; several make several motions.
      frames: Length; None for the model's longest.
      scale: Scale of classifier-free guidance; None for the paper's.
      out: Folder; None for <run>/samples.
    """

    run: Path = Path("runs/emdm_action")
    row: str = "emdm"
    action: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    frames: int | None = None
    scale: float | None = None
    out: Path | None = None
    seed: int = 0


# Frames of the shortest clip that gets a caption, as in HumanML3D.
_SHORTEST = 40


def base_config(args: Train, recon: float) -> emdm_model.Config:
    """Sizes and weights of the row "emdm"; `recon` is R where none is given."""
    given = cli.given(emdm_model.Config, args) | dict(
        token_margin=args.token_margin if args.frames_per_token > 1 else 0,
        num_steps=args.diffusion_steps,
        weight_recon=recon if args.recon is None else args.recon,
    )
    return emdm_model.Config(features=1, heads=4, norm="pre", **given)


def prepare(args: Train) -> emdm_training.Task:
    """Makes a run folder's data, or loads those it has."""
    options = dict(
        fps={"text": 20.0}.get(args.task, 15.0) if args.fps is None else args.fps,
        frames={"text": 120}.get(args.task, 60) if args.frames is None else args.frames,
        held_out=args.held_out,
    )
    if args.task == "text":
        form = args.text_form or emdm_text.default_form(args.encoder)
        run = emdm_text.prepare(
            args.out,
            args.data,
            encoder=args.encoder,
            form=form,
            unseen=args.unseen,
            least=_SHORTEST,
            **options,
        )
        counts = {s: run.motions.clips_of(s).size for s in run.motions.split_names}
        print(
            f"{run.motions.num_clips} clips {counts}, {len(run.vectors)} distinct "
            f"captions, encoded by {run.encoder.name}, {form}"
        )
        base = base_config(args, 100.0)
        return emdm_text.make_task(run, base, frames=options["frames"])
    run = emdm_data.prepare(
        args.out,
        args.data,
        task=args.task,
        field=args.field,
        merge=emdm_data.merges(args.merge),
        least=args.least,
        mirrored=args.mirror,
        **options,
    )
    print(
        f"{run.clips.num_clips} clips of {len(run.actions)} actions: "
        f"{', '.join(run.actions)}"
    )
    conditional = args.task == "action"
    return emdm_data.make_task(run, base_config(args, 1.0), conditional=conditional)


def _start(args: Train, task: emdm_training.Task, row: str) -> Params:
    """Parameters that a row of actions begins with."""
    run = emdm_data.load_run(args.out)
    model = emdm_sampler.Model(
        config=emdm_training.row_config(task.base, row),
        representation=run.representation,
        labels=run.actions,
        source=run.clips.source,
    )
    return emdm_sampler.start_of(args.init, model, row=row)


def train(args: Train) -> None:
    """Trains row by row."""
    cli.join_processes(args.distributed)
    rows = cli.chosen_rows(args, tuple(emdm_training.ROWS))
    emdm_training.check_rows(rows)
    for row in rows:
        if row in emdm_training.SAMPLERS:
            raise ValueError(
                f"row {row!r} samples {emdm_training.SAMPLERS[row][0]!r}: train that"
            )
    if args.init and args.task != "action":
        raise ValueError(f"init is {args.init}, but task {args.task!r}: expected none")
    loop.check_writable(args.out)
    task = prepare(args)
    starts = {row: _start(args, task, row) for row in rows if args.init}
    for row in rows:
        begun = time.perf_counter()
        config = emdm_training.row_config(task.base, row)
        budget = runs.Budget(**cli.given(runs.Budget, args))
        if not config.adversarial:
            budget = dataclasses.replace(
                budget, steps=args.ddpm_steps, learning_rate=args.ddpm_rate
            )
        discriminator = dataclasses.replace(
            budget,
            optimizer="adam",
            learning_rate=args.discriminator_rate,
            constant=args.optimizer == "adam",
        )
        emdm_training.train_row(
            task,
            row,
            generator=budget,
            discriminator=discriminator,
            alone=args.alone,
            start=starts.get(row),
        )
        print(f"{row}: {time.perf_counter() - begun:.0f} s", flush=True)


def evaluate(args: Evaluate) -> None:
    """Writes the table."""
    chosen = cli.chosen_rows(args)
    emdm_training.check_rows(chosen)
    out = cli.out_folder(args, "evaluation")
    run = runs.load(args.run, system="emdm")
    cli.announce("compiling the evaluator and the sampler of each row", 40)
    evaluator = None if args.evaluator is None else frozen.load(args.evaluator)
    given = cli.given(emdm_scoring.Settings, args)
    settings = emdm_scoring.Settings(**given | {"evaluator": evaluator})
    rows, places, scorer = emdm_evaluation.evaluate_run(
        args.run, settings, rows=chosen, long_replications=args.long_replications
    )
    report = {
        "run": run.settings,
        "evaluator": scorer.describe,
    } | reporting.provenance(args)
    notes = (frozen.note(scorer.describe), *scorer.notes)
    if places:
        report["by_frame_of_the_token"] = by_frame.to_json(places)
        notes += (by_frame.to_markdown(places),)
    reporting.write_table(out, rows, report, notes)


def sample(args: Sample) -> None:
    """Writes one motion for each action or sentence."""
    out = cli.out_folder(args, "samples")
    runs.load(args.run, system="emdm")
    cli.announce("compiling the sampler", 40)
    made, source = emdm_evaluation.make_motions(
        args.run,
        actions=args.action,
        texts=args.text,
        row=args.row,
        frames=args.frames,
        scale=args.scale,
        seed=args.seed,
    )
    files: list[str] = []
    for name, skeleton, motion in made:
        word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:60] or "motion"
        more = (f"{word}_{number}" for number in itertools.count(2))
        files.append(next(x for x in itertools.chain([word], more) if x not in files))
        reporting.write_rollout(
            out,
            skeleton,
            motion,
            None,
            title=f"{name}, {args.row}",
            caption=source,
            name=files[-1],
        )


@dataclasses.dataclass(frozen=True)
class Levels:
    """What a row of actions predicts at each step of its chain; writes a table.

    Example: python experiments/emdm.py levels --run runs/emdm_action --row emdm

    Attributes:
      run: Run folder of actions, for its training motions.
      row: Which model.
      model: Exported file to measure instead; None for the run's row.
      out: Folder; None for <run>/levels.
      samples: Training motions, given to every step.
      seed: Seeds motions, noise and latents.
    """

    run: Path = Path("runs/emdm_action")
    row: str = "emdm"
    model: Path | None = None
    out: Path | None = None
    samples: int = 256
    seed: int = 0


def levels(args: Levels) -> None:
    """Writes the table."""
    out = cli.out_folder(args, "levels")
    run = emdm_data.load_run(args.run)
    model, params = emdm_sampler.load(args.model or args.run, row=args.row)
    rows = emdm_levels.level_table(
        params, run, model, number=args.samples, seed=args.seed
    )
    report = {"source": model.source} | reporting.provenance(args)
    reporting.write_table(out, rows, report, (model.source,))


@dataclasses.dataclass(frozen=True)
class Import:
    """Put the authors' weights into a run folder of texts; no code of theirs is run.

    The folder comes from `emdm.py train --task text --data data/humanml3d.npz --encoder
    clip --frames 196 --out runs/emdm_released --rows none`, with HumanML3D or
    KIT-ML as prepare_data.py writes them. Then evaluate and sample as usual.

    Example: python experiments/emdm.py import --weights humanml.pth --run runs/emdm_released

    Attributes:
      weights: Their checkpoint (.pth), with the generator's moving average.
      run: The run folder.
      heads: Attention heads; the file does not say.
      diffusion_steps: Steps T of the diffusion; the file does not say.
    """  # noqa: E501

    weights: Path
    run: Path
    heads: int = 32
    diffusion_steps: int = 10


def import_weights(args: Import) -> None:
    """Writes the row's checkpoint."""
    run = emdm_text.load_run(args.run)
    if (form := run.record.settings["text_form"]) != "released":
        raise ValueError(
            f"{args.run}: field 'text_form' is {form!r}, expected 'released': CLIP's "
            "vectors are what the weights know"
        )
    base, frames = emdm_model.Config(features=1), run.record.settings["frames"]
    task = emdm_text.make_task(run, base, frames=frames)
    config = emdm_training.import_row(
        task, args.weights, heads=args.heads, num_steps=args.diffusion_steps
    )
    print(
        f"wrote row 'emdm' of {args.run}: {config.depth} layers of {config.width} "
        f"channels, {config.num_steps} steps"
    )


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a row of actions, averaged and as float16, as one small npz file.

    Example: python experiments/emdm.py export --run runs/emdm_action --out actions.npz

    Attributes:
      run: Run folder of `train`.
      row: Which model.
      out: File to write, for `jaxmotion.load`.
    """

    run: Path = Path("runs/emdm_action")
    row: str = "emdm"
    out: Path = Path("actions.npz")


def export(args: Export) -> None:
    """Writes the file."""
    model, params = emdm_sampler.load(args.run, row=args.row)
    checkpoint.export_params(args.out, params, emdm_sampler.to_json(model))
    print(f"wrote {args.out}, {args.out.stat().st_size / 1e6:.1f} MB: {model.source}")


COMMANDS = {
    "train": (Train, train),
    "evaluate": (Evaluate, evaluate),
    "sample": (Sample, sample),
    "export": (Export, export),
    "levels": (Levels, levels),
    "import": (Import, import_weights),
}


def main() -> None:
    """Parses the command line and runs the command."""
    cli.run(COMMANDS, __doc__)


if __name__ == "__main__":
    cli.start(main)
