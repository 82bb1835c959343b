"""A student of CAMDM, whose plans take one or two network calls instead of eight.

It has the teacher's network and begins with its parameters. In an update, windows of
the data are noised to the steps that the student's plans visit; there the student
predicts, and is compared with where the teacher's own chain (DDIM, without noise) ends.
The losses are CAMDM's, so that joints and feet count as they did for the teacher, and
the past is dropped as often, so that guidance works on.

A student samples by ancestral steps over the visited steps alone. The first of them
keeps sqrt(alpha_bar_T), 0.6 % at T = 8, of the noise it was given: it practically
draws anew what it adds to the prediction, as Song et al. 2023 (alg. 1) do.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.data import clips_io
from jaxmotion.diffusion import distillation, schedule
from jaxmotion.learning import losses, runs
from jaxmotion.learning.fingerprint import fingerprint
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.networks import blocks
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.systems.camdm.model import STAGE, SYSTEM, Config
from jaxmotion.typing import Denoiser, Key, Params

# What the student's prediction is compared with; see `diffusion.distillation`.
Target = Literal["chain", "consistency"]


def loss(
    params: Params,
    key: Key,
    batch: tuple[Motion, Int[Array, " batch"]],
    *,
    teacher: Params,
    skeleton: Skeleton,
    config: Config,
    steps: tuple[int, ...],
    target: Target = "chain",
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The weighted sum of a student's losses, and its terms by name, unweighted.

    Nothing is dropped in the networks, and both have one config. `steps`, of the
    schedule, are those that the student's plans visit; a batch is windows of
    `config.window` frames and their styles. With target "consistency" there are as many
    random steps per window.
    """
    key_example, key_pairs = jax.random.split(key)
    condition, x_0 = camdm_loss.examples(
        key_example, batch, skeleton=skeleton, config=config
    )
    net = camdm_model.network(config)

    def denoiser(params: Params, arguments: tuple[Array, ...]) -> Denoiser:
        context = blocks.apply(params, net, *arguments, method="encode")
        return lambda key, x_t, t: blocks.apply(
            params, net, context, x_t, t, method="denoise"
        )

    def pairs(key: Key, x_0: Array, arguments: tuple[Array, ...]) -> distillation.Pairs:
        both: dict[str, Any] = dict(
            table=schedule.cosine_schedule(config.num_steps),
            student=denoiser(params, arguments),
            teacher=denoiser(teacher, arguments),
        )
        if target == "chain":
            return distillation.chain_pairs(key, x_0, **both, steps=steps)
        return distillation.consistency_pairs(key, x_0, **both, number=len(steps))

    keys = jax.random.split(key_pairs, x_0.shape[0])
    predictions, targets = jax.vmap(pairs)(keys, x_0, condition.arguments(config))
    each = camdm_loss.seam_terms(
        skeleton,
        jnp.moveaxis(predictions, 1, 0),
        jnp.moveaxis(targets, 1, 0),
        condition,
        config=config,
    )
    return losses.weighted(each, config)


def prepare(
    folder: Path,
    source: Path,
    data: Path | None = None,
    held_out_clips: tuple[str, ...] = (),
    *,
    steps: tuple[int, ...],
    target: Target,
    mirrored: bool,
    balance: float,
) -> tuple[runs.Run, Params]:
    """Makes a student's run folder, or loads it, and the teacher's averaged parameters.

    The teacher is a run folder, a shipped model or an exported file; without `data` the
    student gets the teacher's clips, else those that are not named in `held_out_clips`,
    which a shipped or exported teacher never saw. `steps` of the schedule are what
    its plans visit; `balance` is as in `windows.balance`. `ValueError` if the steps are
    not the teacher's, the clips do not fit it, or the folder was made otherwise.
    """
    if source.is_dir():
        taught = camdm_training.load_run(source, data)
        found = runs.load(source, system=SYSTEM)
        chosen, files = found.settings, [found.file(name) for name in found.files]
    else:
        taught = camdm_training.exported_run(source, data, held_out_clips)
        chosen = dict(
            label=taught.field,
            contents=[],
            labels=list(taught.model.labels),
            held_out=0.1,
            held_out_clips=list(held_out_clips),
        )
    files = [data] if data is not None else files
    steps = camdm_model.check_steps(steps, config=taught.model.config)
    parts = {"train": taught.train, "held_out": taught.held_out}

    def content() -> runs.Content:
        model = dataclasses.replace(taught.model, steps=steps, all_steps=False)
        return runs.Content(
            model=camdm_model.to_json(model),
            source=model.source,
            split={name: list(part.clip_names) for name, part in parts.items()},
            files={
                f"{name}.npz": functools.partial(clips_io.save_clips, clips=part)
                for name, part in parts.items()
            },
        )

    own = dict(
        mirror=mirrored,
        balance=balance,
        teacher=fingerprint(taught.params),
        steps=list(steps),
        target=target,
    )
    run = runs.begin(
        folder, system=SYSTEM, data=files, settings=chosen | own, make=content
    )
    return run, taught.params


def train(run: runs.Run, teacher: Params, budget: runs.Budget) -> None:
    """Trains a student from its newest checkpoint, or from the teacher's parameters.

    `ValueError` if no clip is as long as a window or the checkpoint has other settings,
    `TrainingDiverged` if a loss is not finite.
    """
    model = camdm_model.from_json(run.model, where=str(run.config))
    config, settings = model.config, run.settings
    runs.minimize(
        jax.tree.map(jnp.copy, teacher),  # a training gives away its first state
        run,
        STAGE,
        functools.partial(
            loss,
            teacher=teacher,
            skeleton=model.skeleton,
            config=config,
            steps=model.steps,  # pyright: ignore[reportArgumentType]
            target=settings["target"],
        ),
        camdm_training.window_sampler(field=settings["label"], batch=budget.batch),
        camdm_training.training_windows(run, config),
        budget=budget,
        model=dataclasses.asdict(config),
        show=("loss", "data", "position", "foot"),
    )
