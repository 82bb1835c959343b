"""CAMDM on prepared clips: train, evaluate, roll out, export; its authors' weights too.

Examples:
  python experiments/prepare_data.py bandai_namco/2 --manual-dir path/to/zips --out data/bandai2.npz
  python experiments/camdm.py train --data data/bandai2.npz --out runs/camdm
  python experiments/camdm.py evaluate --run runs/camdm
  python experiments/camdm.py rollout --run runs/camdm --style elderly --seconds 20
  python experiments/camdm.py distill --run runs/camdm --out runs/camdm_student
  python experiments/camdm.py import --weights best.pt --skeleton ybot.bvh --out runs/camdm_released
"""  # noqa: E501

import dataclasses
from pathlib import Path
from typing import Any, Literal

from jaxmotion import cli, reporting
from jaxmotion.control.courses import Course
from jaxmotion.data.clips import Clips
from jaxmotion.evaluators import frozen
from jaxmotion.learning import checkpoint, loop, runs
from jaxmotion.learning.training import OptimizerName
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import distillation as camdm_distillation
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import published as camdm_published
from jaxmotion.systems.camdm import training as camdm_training


@dataclasses.dataclass(frozen=True)
class Train:
    """Train CAMDM on prepared clips; a run that was stopped goes on where it was.

    Example: python experiments/camdm.py train --data data/bandai2.npz --out runs/camdm

    Attributes:
      data: Clips from prepare_data.py.
      out: Run folder: config.json, data, and the stage motion.
      preset: Sizes, and all options below that have no default. "small" is for a CPU,
        "paper" for 100 epochs, "planted" a second training of a small model in which
        feet learn to stand.
      init: Run folder or exported model to start from.
      contents: Use only clips of these contents; none: all clips.
      label: Field of the clips that is the style.
      labels: Use only clips of these styles; none: all.
      held_out: Part of the clips kept for evaluation, in (0, 1).
      held_out_clips: Keep these instead, by name.
      mirror: Add a mirrored copy of each training clip that has none.
      balance: Draw rare changes more often, up to 1.
      steps: Optimizer steps of the whole run.
      batch: Windows of 55 frames per step.
      optimizer: "muon", "adamw", "radam" or "adam".
      learning_rate: Peak of the rate.
      warmup: Steps in which the rate rises.
      max_norm: Norm to clip gradients to; 0: none.
      ema: Decay of the parameters' average; 0: none.
      initial_scale: Factor on linear layers' first weights; .58 is about PyTorch's.
      chunk: Steps of one compiled call.
      save_every: Steps between checkpoints.
      network: Denoiser (two of table 3).
      width: Channels of a token.
      depth: Layers.
      frames_per_token: Frames of one token (paper: 1); not of the MLP.
      token_margin: Frames that neighboring tokens share; not of the MLP.
      token_window: How neighboring tokens are cross-faded.
      norm: Layer norms after sums ("post", paper) or before branches; not of the MLP.
      attention: "full", or "prefix": computed once per plan.
      noise_levels: Noise levels that a step draws for each window.
      own_levels: Probability of noise on own predictions at lower levels.
      cubic_wishes: Probability that the wanted path is a cubic curve, without sway.
      seam_half_life: Half-life, frames, of the offset with which plans go on from the
        past; 0: none.
      frame_kernel: Frames that the last convolution sees.
      weight_foot: Weight of the loss of standing feet that slide; None for the
        preset's.
      diffusion_steps: Steps T of the diffusion.
      devices: Devices to split each batch over.
      distributed: One of several processes: "auto", or address, number, index.
      seed: Seeds everything random.
      override: Go on with other settings than before.
    """

    data: Path = Path("data/bandai2.npz")
    out: Path = Path("runs/camdm")
    preset: Literal["small", "planted", "paper"] = "small"
    init: cli.Optional[Path] = None
    contents: cli.Names = camdm_training.CONTENTS
    label: str = "style"
    labels: cli.Names = ()
    held_out: float = 0.1
    held_out_clips: cli.Names = ()
    mirror: bool = True
    balance: float = 0.0
    steps: int = 11000
    batch: cli.Optional[int] = None
    optimizer: cli.Optional[OptimizerName] = None
    learning_rate: cli.Optional[float] = None
    warmup: cli.Optional[int] = None
    max_norm: cli.Optional[float] = None
    ema: cli.Optional[float] = None
    initial_scale: cli.Optional[float] = None
    chunk: int = 50
    save_every: int = 1000
    network: Literal["transformer", "mlp", "single_token"] = "transformer"
    width: cli.Optional[int] = None
    depth: cli.Optional[int] = None
    frames_per_token: cli.Optional[int] = None
    token_margin: cli.Optional[int] = None
    token_window: Literal["hann", "trapezoid"] = "hann"
    norm: cli.Optional[Literal["post", "pre"]] = None
    attention: cli.Optional[Literal["full", "prefix"]] = None
    noise_levels: cli.Optional[int] = None
    own_levels: cli.Optional[float] = None
    cubic_wishes: cli.Optional[float] = None
    seam_half_life: cli.Optional[float] = None
    frame_kernel: cli.Optional[int] = None
    weight_foot: cli.Optional[float] = None
    diffusion_steps: int = 8
    devices: int = 1
    distributed: cli.Distributed = ()
    seed: int = 0
    override: bool = False


def sizes_of(args: Train) -> dict[str, Any]:
    """Sizes and weights of the model that the arguments describe."""
    given = cli.given(camdm_model.Config, args) | {"num_steps": args.diffusion_steps}
    hidden = {} if args.width is None else {"hidden": 4 * args.width}
    preset = camdm_training.PRESETS[args.preset]
    lacking = camdm_model.lacking(args.network)
    return {k: v for k, v in preset.items() if k not in lacking} | given | hidden


def train(args: Train) -> None:
    """Trains, with checkpoints."""
    cli.join_processes(args.distributed)
    loop.check_writable(args.out)
    sizes = sizes_of(args)
    given = camdm_training.FITTING[args.preset] | cli.given(runs.Budget, args)
    budget = runs.Budget(**given, final=0.1)

    def make(clips: Clips) -> camdm_model.Model:
        model = camdm_training.make_model(clips, field=args.label, **sizes)
        return camdm_training.continued(model, args.init)[0] if args.init else model

    run = camdm_training.prepare(
        args.out,
        args.data,
        label=args.label,
        contents=args.contents,
        labels=args.labels,
        held_out=args.held_out,
        held_out_clips=args.held_out_clips,
        mirrored=args.mirror,
        balance=args.balance,
        make=make,
        settings={"sizes": sizes, "init": args.init and str(args.init)},
    )
    camdm_training.train(run, budget, init=args.init)


@dataclasses.dataclass(frozen=True)
class Distill:
    """Train a student whose plans take one or two network calls; it may go on.

    Example: python experiments/camdm.py distill --run runs/camdm --out runs/camdm_student

    Attributes:
      run: Teacher: run folder; or a shipped model or an exported file, with `data`.
      data: Clips; None for those that the teacher's run was trained on.
      held_out_clips: Clips of `data` that a shipped or exported model never saw.
      out: Run folder of the student, which all other commands take.
      visit: Steps of the teacher's schedule that a plan of the student visits.
      target: Where the teacher's "chain" ends, with as many network calls as the
        steps' sum per window; or "consistency" with the student's own prediction after
        one step of the teacher.
      mirror: Add a mirrored copy of each clip.
      balance: Draw rare changes more often, up to 1.
      steps: Optimizer steps of the whole run.
      batch: Windows of 55 frames per step, each noised to every visited step.
      optimizer: "muon", "adamw", "radam" or "adam".
      learning_rate: Peak of the rate.
      warmup: Steps in which the rate rises.
      max_norm: Norm to clip gradients to; 0: none.
      ema: Decay of the parameters' average; 0: none.
      chunk: Steps of one compiled call.
      save_every: Steps between checkpoints.
      devices: Devices to split each batch over.
      seed: Seeds everything random.
      override: Go on with other settings than before.
    """  # noqa: E501

    run: Path = Path("runs/camdm")
    data: Path | None = None
    held_out_clips: tuple[str, ...] = ()
    out: Path = Path("runs/camdm_student")
    visit: tuple[int, ...] = (8,)
    target: camdm_distillation.Target = "chain"
    mirror: bool = True
    balance: float = 0.0
    steps: int = 4000
    batch: int = 48
    optimizer: OptimizerName = "muon"
    learning_rate: float = 3e-4
    warmup: int = 100
    max_norm: float = 1.0
    ema: float = 0.999
    chunk: int = 50
    save_every: int = 1000
    devices: int = 1
    seed: int = 0
    override: bool = False


def distill(args: Distill) -> None:
    """Trains the student, with checkpoints."""
    loop.check_writable(args.out)
    # Muon's changes are as large as its rate, however small the gradient.
    budget = runs.Budget(**cli.given(runs.Budget, args), final=0.01)
    run, teacher = camdm_distillation.prepare(
        args.out,
        args.run,
        args.data,
        args.held_out_clips,
        steps=args.visit,
        target=args.target,
        mirrored=args.mirror,
        balance=args.balance,
    )
    camdm_distillation.train(run, teacher, budget)


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Steer characters along a course in every style, and measure them.

    Example: python experiments/camdm.py evaluate --run runs/camdm --rollouts 105

    Attributes:
      run: Run folder of `train`.
      data: Clips; None for those that the run was trained on.
      out: Folder for metrics.json and table.md; None for <run>/evaluation.
      rollouts: Characters; spread evenly over the styles.
      seconds: Length of each rollout, seconds; 4 at least.
      course: Commands.
      speed: Meters per second; None for each style's own median walking speed.
      contents: Contents of the clips to compare with; none: all of the run's.
      chunk: Characters to run at a time, at most.
      evaluator_steps: Updates of the evaluator of styles, if it is trained here.
      evaluator: File of a frozen evaluator of styles, from evaluator.py; None trains
        one here.
      visit: Steps of the schedule that a plan visits; none: the model's own.
      extend: Plans see the last plan's own path, extended (HFTE); else the wanted path
        alone (one of table 3).
      seed: Seeds poses, noise, evaluator and subsets.
    """

    run: Path = Path("runs/camdm")
    data: Path | None = None
    out: Path | None = None
    rollouts: int = 105
    seconds: float = 60.0
    course: Course = "forward"
    speed: float | None = None
    contents: tuple[str, ...] = camdm_evaluation.CONTENTS
    chunk: int = 5
    evaluator_steps: int = 1500
    evaluator: Path | None = None
    visit: tuple[int, ...] = ()
    extend: bool = True
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Steer one character in one style; writes BVH, GIF and HTML.

    Example: python experiments/camdm.py rollout --run runs/camdm --style elderly

    Attributes:
      run: Run folder of `train`.
      data: Clips to start from; None for those that the run was trained on.
      style: Its style.
      to_style: Change to this style at half time; None to keep it.
      seconds: Length, seconds.
      course: Commands.
      speed: Meters per second; None for the style's own median speed.
      out: Folder; None for <run>/rollout.
      seed: Seeds the start pose and the noise.
    """

    run: Path = Path("runs/camdm")
    data: Path | None = None
    style: str = "elderly"
    to_style: str | None = None
    seconds: float = 20.0
    course: Course = "forward"
    speed: float | None = None
    out: Path | None = None
    seed: int = 0


def evaluate(args: Evaluate) -> None:
    """Writes the table."""
    evaluator = None if args.evaluator is None else frozen.load(args.evaluator)
    run = camdm_training.load_run(args.run, args.data, args.contents)
    model = camdm_model.with_steps(run.model, args.visit)
    run = dataclasses.replace(run, model=model)
    out = cli.out_folder(args, "evaluation")
    cli.announce("compiling the rollouts", 40)
    rows, report = camdm_evaluation.evaluate_run(
        run,
        course=args.course,
        rollouts=args.rollouts,
        seconds=args.seconds,
        speed=args.speed,
        chunk=args.chunk,
        evaluator_steps=args.evaluator_steps,
        seed=args.seed,
        evaluator=evaluator,
        control=None if args.extend else camdm_controller.Control(extend=False),
    )
    report |= reporting.provenance(args)
    notes = (frozen.note(report["evaluator"]),)
    reporting.write_table(out, rows, report, notes)
    print(report)


def rollout(args: Rollout) -> None:
    """Writes rollout.bvh, rollout.gif and rollout.html."""
    run = camdm_training.load_run(args.run, args.data)
    out = cli.out_folder(args, "rollout")
    cli.announce("compiling the rollout", 40)
    motion, velocity = camdm_evaluation.steer_one(
        run,
        args.style,
        to_style=args.to_style,
        course=args.course,
        seconds=args.seconds,
        speed=args.speed,
        seed=args.seed,
    )
    title = " to ".join(filter(None, (args.style, args.to_style)))
    reporting.write_rollout(
        out, run.model.skeleton, motion, velocity, title=title, caption=run.model.source
    )


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a run's averaged parameters and config as one small npz file.

    Example: python experiments/camdm.py export --run runs/camdm --out camdm.npz

    Attributes:
      run: Run folder of `train`.
      out: File to write; parameters are stored as float16.
      starts: Poses per style that the model itself stands in, stored with it, so that
        characters start without any recording; None for none.
      visit: Steps of the schedule that its plans visit unless told otherwise; none: the
        run's own.
    """

    run: Path = Path("runs/camdm")
    out: Path = Path("camdm.npz")
    starts: int | None = None
    visit: tuple[int, ...] = ()


def export(args: Export) -> None:
    """Writes the file."""
    model, params = camdm_model.load(args.run)
    if args.starts is not None:
        run = camdm_training.load_run(args.run)
        starts = camdm_evaluation.own_starts(run, number=args.starts)
        model = dataclasses.replace(model, starts=starts)
    model = camdm_model.with_steps(model, args.visit)
    checkpoint.export_params(args.out, params, camdm_model.to_json(model))
    print(f"wrote {args.out}, {args.out.stat().st_size / 1e6:.1f} MB: {model.source}")


@dataclasses.dataclass(frozen=True)
class Import:
    """Make a run folder of the authors' weights; no code of theirs is run.

    Example: python experiments/camdm.py import --weights best.pt --skeleton ybot.bvh --labels 100style_conditions.json --out runs/camdm_released

    Attributes:
      weights: Their checkpoint (.pt) or one of their ONNX files.
      skeleton: A BVH file of the skeleton that it was trained on; fingers and eyes are
        left out.
      labels: JSON with the styles' names as "styles"; None for 100style_conditions.json
        beside the weights.
      data: Clips from prepare_data.py, of the same skeleton and styles, to start from
        and to compare with.
      held_out: Fraction of clips that count as held out.
      scale: Meters per unit of the BVH file.
      out: Run folder.
    """  # noqa: E501

    weights: Path
    skeleton: Path
    labels: Path | None = None
    data: Path = Path("data/style100.npz")
    held_out: float = 0.1
    scale: float = 0.01
    out: Path = Path("runs/camdm_released")


def import_weights(args: Import) -> None:
    """Writes the run folder."""
    loop.check_writable(args.out)
    skeleton = camdm_training.released_skeleton(args.skeleton, scale=args.scale)
    labels = args.labels and camdm_published.read_styles(args.labels)
    model, params = camdm_published.load(args.weights, skeleton=skeleton, labels=labels)
    run = camdm_training.prepare(
        args.out,
        args.data,
        label="style",
        held_out=args.held_out,
        make=lambda clips: model,
        settings={"weights": args.weights.name},
    )
    runs.store(
        run,
        camdm_model.STAGE,
        {"ema_params": params},
        model=dataclasses.asdict(model.config),
    )
    print(
        f"wrote {args.out}: {len(model.labels)} styles, {skeleton.num_joints} joints, "
        f"{model.config.num_steps} steps; {model.source}"
    )


COMMANDS = {
    "train": (Train, train),
    "distill": (Distill, distill),
    "evaluate": (Evaluate, evaluate),
    "rollout": (Rollout, rollout),
    "export": (Export, export),
    "import": (Import, import_weights),
}


def main() -> None:
    """Parses the command line and runs the command."""
    cli.run(COMMANDS, __doc__)


if __name__ == "__main__":
    cli.start(main)
