"""The data of a run folder: made once, then loaded."""

from typing import Any

from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import training as emdm_training

# Labels of Bandai-Namco that name the same action as others.
MERGE = ("bye=wave-right-hand", "byebye=wave-both-hands", "dash=run")
# Frames of the shortest clip that gets a caption, as in HumanML3D.
_SHORTEST = 40


def base_config(args: Any, recon: float) -> emdm_model.Config:
    """Sizes and weights of the row "emdm"; the task sets the rest.

    Args:
      args: Of `emdm.py train`.
      recon: R, where none is given.

    Returns:
      The configuration.
    """
    return emdm_model.Config(
        features=1,
        width=args.width,
        depth=args.depth,
        heads=4,
        hidden=args.hidden,
        dropout=args.dropout,
        frames_per_token=args.frames_per_token,
        token_margin=args.token_margin if args.frames_per_token > 1 else 0,
        norm="pre",
        mask_frames=args.mask_frames,
        discriminator_width=args.discriminator_width,
        num_steps=args.diffusion_steps,
        weight_recon=recon if args.recon is None else args.recon,
        geometry=args.geometry,
    )


def prepare(args: Any) -> emdm_training.Task:
    """Makes a run folder's data, or loads those it has.

    Args:
      args: Of `emdm.py train`.

    Returns:
      What to train on.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if the folder's data were made otherwise, or an argument is wrong.
    """
    return (_prepare_texts if args.task == "text" else _prepare_actions)(args)


def merges(pairs: tuple[str, ...]) -> dict[str, str]:
    """Labels that name the same action as others.

    Args:
      pairs: "old=new".

    Returns:
      The new label of each old one.

    Raises:
      ValueError: if a pair is not of that form.
    """
    merge = {}
    for pair in pairs:
        old, equals, new = pair.partition("=")
        if not (old and equals and new):
            raise ValueError(f"merge {pair!r}: expected old=new")
        merge[old] = new
    return merge


def _prepare_actions(args: Any) -> emdm_training.Task:
    run = emdm_data.prepare(
        args.out,
        args.data,
        task=args.task,
        field=args.field,
        merge=merges(args.merge),
        least=args.least,
        fps=15.0 if args.fps is None else args.fps,
        frames=60 if args.frames is None else args.frames,
        held_out=args.held_out,
    )
    print(
        f"{run.clips.num_clips} clips of {len(run.actions)} actions: "
        f"{', '.join(run.actions)}"
    )
    return emdm_data.make_task(
        run, base_config(args, 1.0), conditional=args.task == "action"
    )


def _prepare_texts(args: Any) -> emdm_training.Task:
    form = args.text_form or emdm_text.default_form(args.encoder)
    frames = 120 if args.frames is None else args.frames
    run = emdm_text.prepare(
        args.out,
        args.data,
        encoder=args.encoder,
        form=form,
        unseen=args.unseen,
        least=_SHORTEST,
        fps=20.0 if args.fps is None else args.fps,
        frames=frames,
        held_out=args.held_out,
    )
    counts = {s: run.motions.clips_of(s).size for s in run.motions.split_names}
    print(
        f"{run.motions.num_clips} clips {counts}, {len(run.vectors)} distinct "
        f"captions, encoded by {run.encoder.name}, {form}"
    )
    return emdm_text.make_task(run, base_config(args, 100.0), frames=frames)
