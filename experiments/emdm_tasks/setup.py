"""The data of a run folder: made once, then loaded."""

from pathlib import Path
from typing import Any

from jaxmotion.data import clips_io
from jaxmotion.protocols import emdm_action, emdm_data, emdm_runs
from jaxmotion.systems import emdm


def base_config(args: Any, recon: float) -> emdm.Config:
    """Sizes and weights of the row "emdm"; the task sets the rest.

    Args:
      args: Of `emdm.py train`.
      recon: R, where none is given.

    Returns:
      The configuration.
    """
    return emdm.Config(
        features=1,
        width=args.width,
        depth=args.depth,
        heads=4,
        hidden=args.hidden,
        dropout=args.dropout,
        frames_per_token=args.frames_per_token,
        norm="pre",
        discriminator_width=args.discriminator_width,
        weight_recon=recon if args.recon is None else args.recon,
        geometry=args.geometry,
    )


def _same(folder: Path, made: dict[str, Any]) -> bool:
    """Whether the folder has data made so; an error if it has other data."""
    if not (folder / "config.json").exists():
        return False
    value = emdm_runs.read_config(folder)
    found = {key: value.get(key) for key in made}
    if found != made:
        raise ValueError(
            f"{folder}: its data were made with {found}, expected {made}; use another "
            "folder"
        )
    return True


def prepare(args: Any) -> emdm_runs.Task:
    """Makes a run folder's data, or loads those it has.

    Args:
      args: Of `emdm.py train`.

    Returns:
      What to train on.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if the folder's data were made otherwise, or an argument is wrong.
    """
    merge = {}
    for pair in args.merge:
        old, equals, new = pair.partition("=")
        if not (old and equals and new):
            raise ValueError(f"merge {pair!r}: expected old=new")
        merge[old] = new
    made = dict(
        task=args.task,
        data=[str(path) for path in args.data],
        field=args.field,
        merge=merge,
        least=args.least,
        fps=args.fps or 15.0,
        frames=args.frames or 60,
        held_out=args.held_out,
    )
    if not _same(args.out, made):
        clips, left_out = emdm_data.prepare_clips(
            args.data, field=args.field, merge=merge, least=args.least, fps=made["fps"]
        )
        clips_io.save_clips(args.out / "data.npz", clips)
        emdm_runs.write_config(args.out, made | {"left_out": list(left_out)})
    run = emdm_action.load_run(args.out)
    print(
        f"{run.clips.num_clips} clips of {len(run.actions)} actions: "
        f"{', '.join(run.actions)}; left out: {', '.join(run.config['left_out'])}"
    )
    return emdm_action.make_task(
        run, base_config(args, 1.0), conditional=args.task == "action"
    )
