"""The rows of AAMDM's tables: how each is trained, and its stepper.

aamdm               2 polishes after 3 drafts, in the embedded space
polish1_draft3 ...  other numbers of steps (its table 2); polish5_draft0 has no GAN
polish2_held3 ...   polishes of a chain of five in which the frame before stands for the
                    three drafts (`aamdm.model.sampler`)
full_pose           2 and 3 without the embedding
frame               2 and 3 as published: networks predict the frame instead of its
                    change, on windows of ten, without errors of poses, toes, or noise
                    on given frames; likewise full_pose_frame, polish1_draft3_frame ...
amdm5, amdm200      AMDM in the full pose space
amdm5_embedded ...  the same in the embedded space
mvae                Motion VAE in the full pose space
lmm                 Learned Motion Matching in the embedded space, asked by the path
lmm_feet            the same, asked by feet and hips, too
"""

import dataclasses
import functools
import re
from typing import Any, Literal

import jax
import jax.numpy as jnp

from baselines import amdm, lmm, mvae
from jaxmotion.learning import runs
from jaxmotion.learning.runs import Budget
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.systems.aamdm.controller import Memory, Stepper
from jaxmotion.systems.aamdm.space import Space
from jaxmotion.systems.aamdm.training import Run, SpaceName
from jaxmotion.typing import Params

TABLE_1 = ("aamdm", "amdm5", "lmm", "mvae")
TABLE_2 = tuple(
    f"polish{polishes}_draft{drafts}"
    for polishes, drafts in ((0, 3), (1, 3), (10, 3), (2, 2), (2, 4), (2, 10))
)
# The most expensive last.
ALL = (*TABLE_1, *TABLE_2, "full_pose", "amdm200")
# Rows by the paper's recipe, and some that it does not have.
MORE = (
    *("frame", *(f"{name}_frame" for name in TABLE_2), "full_pose_frame"),
    *("amdm5_embedded", "amdm200_embedded", "lmm_feet"),
)
# A frame that is held and not polished would stay as it is for ever.
_CHAIN = re.compile(r"polish(?!0_held)(\d+)_(draft|held)(\d+)(_frame)?$")
_AMDM = ("amdm5", "amdm200", "amdm5_embedded", "amdm200_embedded")
_LMM = ("lmm", "lmm_feet")
_BASELINES = dict.fromkeys(_AMDM, amdm) | dict.fromkeys(_LMM, lmm) | {"mvae": mvae}
# Frames of the windows that each baseline is trained on, and which is the first given.
_WINDOWS = (
    dict.fromkeys(_AMDM, (3, 1)) | dict.fromkeys(_LMM, (20, 0)) | {"mvae": (8, 0)}
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the rows' networks; ours.

    Attributes:
      width: Channels of the networks of AAMDM, and of AMDM but where frames have more.
      schedule: Schedule of AAMDM's chains.
      window: Frames that AAMDM's polishers predict in a row in training.
      weight_pose: Weight of the poses' errors in their loss.
      weight_foot: Weight of slow toes' errors beside these.
      gan_window: Frames of the windows of AAMDM's GANs.
      levels: Steps that each of AAMDM's networks learns.
      previous_noise: Noise on given previous frames in training, for all rows but those
        as published and AMDM alike.
    """

    width: int = 256
    schedule: str = "cosine"
    window: int = 4
    weight_pose: float = 1.0
    weight_foot: float = 5.0
    gan_window: int = 3
    levels: Literal["all", "own"] = "all"
    previous_noise: float = 0.5


def space_of(name: str) -> SpaceName:
    """In which space a row works."""
    full = ("full_pose", "full_pose_frame", "amdm5", "amdm200", "mvae")
    return "full_pose" if name in full else "embedded"


def is_chain(name: str) -> bool:
    """Whether a row is AAMDM with some numbers of steps."""
    named = ("aamdm", "full_pose", "frame", "full_pose_frame")
    return name in named or bool(_CHAIN.match(name))


def is_published(name: str) -> bool:
    """Whether a row is AAMDM by the paper's recipe."""
    return is_chain(name) and name.endswith("frame")


def check(names: tuple[str, ...]) -> None:
    """Raises unless all rows are known; names those there are."""
    for name in names:
        if name not in _BASELINES and not is_chain(name):
            raise ValueError(
                f"unknown row {name!r}: there are {', '.join((*ALL, *MORE))}, "
                "polish<n>_draft<m>, polish<n>_held<m>, and both with _frame"
            )


def _steps(name: str) -> tuple[int, int]:
    """Polishes and drafts of a chain."""
    found = _CHAIN.match(name)
    return (int(found[1]), int(found[3])) if found else (2, 3)


def _held(name: str) -> bool:
    """Whether the frame before stands for drafts."""
    found = _CHAIN.match(name)
    return bool(found) and found[2] == "held"


def _predict(name: str) -> Literal["frame", "change"]:
    return "frame" if is_published(name) else "change"


def chain_of(name: str) -> dict[str, Any]:
    """Its chain, as `aamdm.training.load_networks` takes it.

    `ValueError` names a row that is not AAMDM.
    """
    check((name,))
    if not is_chain(name):
        raise ValueError(f"row is {name!r}: expected AAMDM's, not one compared with it")
    polishes, drafts = _steps(name)
    return dict(
        drafts=drafts, polishes=polishes, predict=_predict(name), held=_held(name)
    )


def _config(name: str, space: Space, sizes: Sizes) -> Any:
    """Configuration of a row's networks."""
    common = dict(features=space.num_features, width=sizes.width)
    if is_chain(name):
        polishes, drafts = _steps(name)
        recipe: dict[str, Any] = dict(
            window=sizes.window,
            gan_window=sizes.gan_window,
            weight_pose=sizes.weight_pose,
            weight_foot=sizes.weight_foot,
            levels=sizes.levels,
            previous_noise=sizes.previous_noise,
        )
        if is_published(name):
            recipe = dict(window=10, gan_window=10)
        return aamdm_model.Config(
            **common,
            **recipe,
            polishes=polishes,
            drafts=drafts,
            schedule=sizes.schedule,
            predict=_predict(name),
        )
    if name in _LMM:
        own = 15 if name == "lmm_feet" else 0
        return lmm.Config(**common | {"width": 512}, queries=12, own=own)
    if name == "mvae":
        # With the published weight 1 the latent dies: of 350 channels most are smooth.
        return mvae.Config(**common | {"width": 256}, weight_kl=0.01)
    # Noise that is to be told passes through the hidden layers: narrower than a frame,
    # they lose some of it, and what is left of it in each frame shakes.
    width = max(sizes.width, 2 ** (space.num_features - 1).bit_length())
    steps = int(name.split("_")[0].removeprefix("amdm"))
    return amdm.Config(**common | {"width": width}, num_steps=steps)


def _stage(name: str) -> str:
    return f"{space_of(name)}/{name}"


def _baseline_loss(name: str, frames: jax.Array, space: Space, config: Any):
    """The loss `(params, key, windows)` of a baseline."""
    loss = functools.partial(_BASELINES[name].loss, config=config)
    if name not in _LMM:
        return loss
    return functools.partial(loss, change=space.change, database=frames[::4])


def train_baseline(
    name: str, run: Run, space: Space, sizes: Sizes, budget: Budget
) -> None:
    """Trains a row that is not AAMDM."""
    config = _config(name, space, sizes)
    frames = aamdm_space.to_frames(space, run.train.poses, run.train.paths)
    if name == "lmm_feet":
        own = jax.jit(lmm.own_features)(run.train, run.skeleton)
        frames = jnp.concatenate([frames, own], axis=-1)
    loss = _baseline_loss(name, frames, space, config)
    length, given = _WINDOWS[name]
    # AMDM's authors have none; with it joints jerk twice as much.
    largest = 0.0 if name in _AMDM else sizes.previous_noise
    windows, arrays = aamdm_training.frame_windows(
        frames, run.train, length, batch=budget.batch, balance=run.balance
    )

    def sample(key: jax.Array, arrays: Any) -> jax.Array:
        key_windows, key_noise = jax.random.split(key)
        found = windows(key_windows, arrays)
        noise = aamdm_loss.random_noise(
            key_noise, (len(found), space.num_features), largest=largest
        )
        return found.at[:, given, : space.num_features].add(noise)

    runs.minimize(
        _BASELINES[name].init(jax.random.key(budget.seed), config),
        run.record,
        _stage(name),
        loss,
        sample,
        arrays,
        budget=budget,
        model=dataclasses.asdict(config),
        settings={"previous_noise": largest},
    )


def train_row(
    name: str,
    run: Run,
    space: Space,
    sizes: Sizes,
    *,
    polisher: Budget,
    generator: Budget,
    baseline: Budget,
    init: Params | None = None,
) -> None:
    """Trains what a row needs and does not have yet; AAMDM's start with `init`."""
    if not is_chain(name):
        train_baseline(name, run, space, sizes, baseline)
        return
    config, where = _config(name, space, sizes), space_of(name)
    if config.polishes:
        aamdm_training.train_polisher(run, where, space, config, polisher, init=init)
    if config.drafts and not _held(name):
        aamdm_training.train_generator(run, where, space, config, generator, init=init)


def load_row(
    name: str,
    run: Run,
    space: Space,
    *,
    scale: float,
    guided_steps: int | None = aamdm_controller.GUIDED_STEPS,
    half_life: float = 0.0,
) -> Stepper:
    """The stepper of a trained row.

    Args:
      name: Name of the row.
      run: The run.
      space: The row's space.
      scale: Strength of the guidance, for those that are guided.
      guided_steps: How many steps at a chain's end are guided; None for all, as rows
        that are as published have it.
      half_life: In which noise of a chain's posteriors is forgotten, seconds; 0 to draw
        it anew in every frame.

    Returns:
      The stepper.

    Raises:
      CheckpointError: if the row was not trained, or its folder holds another.
    """
    if is_chain(name):
        if is_published(name):
            guided_steps = None
        chain = chain_of(name)
        transition = aamdm_training.load_chain(run, space_of(name), space, **chain)
        memory = None
        if half_life:
            steps = chain["drafts"] + chain["polishes"]
            memory = Memory(num_steps=steps, half_life=half_life)
        return aamdm_controller.guided(
            transition, scale=scale, guided_steps=guided_steps, memory=memory
        )
    module = _BASELINES[name]
    config = runs.stage_config(run.record, _stage(name), module.Config)
    params = runs.load_params(
        run.record, _stage(name), lambda: module.init(jax.random.key(0), config)
    )
    if name in _LMM:
        return lmm.stepper(params, config=config, change=space.change)
    if name == "mvae":
        return mvae.stepper(params, config=config)
    return amdm.stepper(params, config=config, scale=scale)
