"""Stages 2 and 3: the polisher and the generator of a chain of some length."""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

import jax

from jaxmotion.learning import adversarial, training
from jaxmotion.protocols import aamdm_stages
from jaxmotion.protocols.aamdm_runs import Run, SpaceName
from jaxmotion.protocols.aamdm_stages import Budget
from jaxmotion.systems import aamdm, aamdm_loss, aamdm_space, model_json
from jaxmotion.systems.aamdm import Transition
from jaxmotion.systems.aamdm_space import Space
from jaxmotion.typing import Params


def chain_folder(run: Run, space: SpaceName, *, num_steps: int, target: str) -> Path:
    """Where the networks of a chain lie.

    Args:
      run: The run.
      space: Its space.
      num_steps: T.
      target: What the chain denoises.

    Returns:
      The folder.
    """
    name = f"T{num_steps}" + ("" if target == "frame" else f"_{target}")
    return run.folder / space / name


def _shared(config: aamdm.Config) -> dict:
    """What chains of one length have in common, as JSON."""
    value = dataclasses.asdict(config) | {"num_steps": config.num_steps}
    del value["drafts"], value["polishes"]
    return value


def _folder(run: Run, name: SpaceName, config: aamdm.Config) -> Path:
    return chain_folder(run, name, num_steps=config.num_steps, target=config.target)


def train_polisher(
    run: Run, name: SpaceName, space: Space, config: aamdm.Config, budget: Budget
) -> Params:
    """Stage 2.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      config: The method.
      budget: How long.

    Returns:
      Averaged parameters.
    """
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    change = space.change if config.target == "change" else None
    loss = functools.partial(aamdm_loss.polisher_loss, config=config, change=change)
    optimizer = aamdm_stages.make_optimizer(budget)
    params = aamdm.init(jax.random.key(budget.seed), config)["polisher"]
    sample, arrays = aamdm_stages.frame_windows(
        frames, run.train, config.window + 1, batch=budget.batch
    )
    state = aamdm_stages.fit(
        _folder(run, name, config) / "polisher",
        training.init_train_state(params, optimizer),
        training.make_update(loss, optimizer, ema_decay=budget.ema),
        sample,
        arrays,
        stage="polisher",
        budget=budget,
        config={"config": _shared(config), "space": name, "source": run.source},
        source=run.frames,
        show=("loss", "value", "velocity"),
    )
    return state.ema_params


def train_generator(
    run: Run, name: SpaceName, space: Space, config: aamdm.Config, budget: Budget
) -> Params:
    """Stage 3.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      config: The method.
      budget: How long; both players have its optimiser.

    Returns:
      The generator's averaged parameters.
    """
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    change = space.change if config.target == "change" else None
    judge, make = (
        functools.partial(loss, config=config, change=change)
        for loss in (aamdm_loss.discriminator_loss, aamdm_loss.generator_loss)
    )
    optimizer = aamdm_stages.make_optimizer(budget)
    params = aamdm.init(jax.random.key(budget.seed), config)
    players = {
        player: training.init_train_state(params[player], optimizer)
        for player in ("generator", "discriminator")
    }
    sample, arrays = aamdm_stages.frame_windows(
        frames, run.train, 3, batch=budget.batch
    )
    state = aamdm_stages.fit(
        _folder(run, name, config) / "generator",
        adversarial.GanState(**players),
        adversarial.make_gan_update(
            judge, make, (optimizer, optimizer), ema_decay=budget.ema
        ),
        sample,
        arrays,
        stage="generator",
        budget=budget,
        config={"config": _shared(config), "space": name, "source": run.source},
        source=run.frames,
        show=("generator/loss", "discriminator/loss"),
    )
    return state.generator.ema_params


def _stored_config(folder: Path, *, drafts: int, polishes: int) -> aamdm.Config:
    """The configuration that a chain was trained with."""
    stage = "polisher" if polishes else "generator"
    value = aamdm_stages.check_stage(folder / stage, stage)
    try:
        stored = dict(value["config"])
        num_steps = stored.pop("num_steps")
        own = {"drafts": drafts, "polishes": polishes}
        config = model_json.config_from_json(aamdm.Config, stored | own)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{folder / stage}: field 'config' is wrong: {error}"
        ) from error
    if num_steps != config.num_steps:
        raise ValueError(
            f"{folder / stage}: trained for chains of {num_steps} steps, expected "
            f"{config.num_steps}"
        )
    return config


def load_networks(
    run: Run,
    name: SpaceName,
    space: Space,
    *,
    drafts: int,
    polishes: int,
    target: Literal["frame", "change"] = "frame",
) -> tuple[Params, aamdm.Config]:
    """The networks of a trained chain.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      drafts: Steps of the generator.
      polishes: Steps of the diffusion model.
      target: What the chain denoises.

    Returns:
      Parameters of those stages that take steps, and the configuration that they were
      trained with.

    Raises:
      CheckpointError: if a stage that it needs is missing, or of another kind.
      ValueError: if a stage was trained for another chain or another space.
    """
    folder = chain_folder(run, name, num_steps=drafts + polishes, target=target)
    config = _stored_config(folder, drafts=drafts, polishes=polishes)
    if config.features != space.num_features:
        raise ValueError(
            f"{folder}: networks of {config.features} channels, expected the "
            f"{space.num_features} of the space"
        )
    init = functools.partial(aamdm.init, jax.random.key(0), config)
    params = {}
    if drafts:
        params["generator"] = aamdm_stages.load_params(
            folder / "generator",
            "generator",
            lambda: init()["generator"],
            adversarial=True,
        )
    if polishes:
        params["polisher"] = aamdm_stages.load_params(
            folder / "polisher", "polisher", lambda: init()["polisher"]
        )
    return params, config


def load_chain(run: Run, name: SpaceName, space: Space, **chain: Any) -> Transition:
    """The transition of a trained chain.

    Args:
      run: The run.
      name: Of the space.
      space: The space.
      **chain: As of `load_networks`.

    Returns:
      The transition.

    Raises:
      CheckpointError, ValueError: as `load_networks`.
    """
    params, config = load_networks(run, name, space, **chain)
    change = space.change if config.target == "change" else None
    return aamdm.transition(params, config=config, change=change)
