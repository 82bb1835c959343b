"""Training of the style evaluator on clips, and its use on motions.

Source: released feature extractor of CAMDM (Chen et al. 2024): windows of 60 frames,
cross entropy, Adam 1e-3.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.clips import Clips
from jaxmotion.data.windows import EVAL_WINDOW, EvalWindows, eval_windows
from jaxmotion.evaluators.network import StyleClassifier, WindowClassifier
from jaxmotion.learning import training
from jaxmotion.motion import rotation, trajectory
from jaxmotion.motion.facing import body_facing, plain_names
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.networks import blocks
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Size of the evaluator; windows of `frames` are at 30 fps."""

    num_classes: int
    num_joints: int
    frames: int = 60

    @property
    def network(self) -> WindowClassifier:
        """The module of this size."""
        return WindowClassifier(self.num_classes)

    def read(
        self, skeleton: Skeleton, motion: Motion
    ) -> Float[Array, "*batch frames channels"]:
        """What the network looks at."""
        return window_input(skeleton, motion)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReleasedConfig(Config):
    """Size of the released classifier: 15 joints, and windows of 60 frames."""

    num_joints: int = 15

    @property
    def network(self) -> StyleClassifier:
        """The module of this size."""
        return StyleClassifier(self.num_classes)

    def read(
        self, skeleton: Skeleton, motion: Motion
    ) -> Float[Array, "*batch frames channels"]:
        """What the network looks at."""
        return released_input(skeleton, motion)


# The joints of the released classifier as `plain_names` has them, of Mixamo's skeleton
# and of 100STYLE's own.
_RELEASED_NAMES = tuple(
    ("hips", "neck", "head")
    + tuple(f"{side}{part}" for side in ("right", "left") for part in arm)
    + tuple(f"{side}{part}" for side in ("right", "left") for part in leg)
    for arm, leg in (
        (("collar", "shoulder", "elbow"), ("hip", "knee", "ankle")),
        (("shoulder", "arm", "forearm"), ("upleg", "leg", "foot")),
    )
)
RELEASED_JOINTS = _RELEASED_NAMES[1]


def released_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """The joints that the released classifier looks at, in its order.

    `ValueError` if the skeleton has neither Mixamo's nor 100STYLE's names.
    """
    plain = plain_names(skeleton)
    for names in _RELEASED_NAMES:
        if set(names) <= set(plain):
            return tuple(plain.index(name) for name in names)
    raise ValueError(
        f"the released classifier needs the joints {', '.join(RELEASED_JOINTS)}, or "
        f"{', '.join(_RELEASED_NAMES[0])}; the skeleton has {', '.join(skeleton.names)}"
    )


def released_input(
    skeleton: Skeleton, motion: Motion
) -> Float[Array, "*batch frames channels"]:
    """What the released classifier looks at, meters; three channels a joint.

    Positions of 15 joints relative to the root, each frame (of 30 per second) turned so
    that hips and shoulders face +x.

    Source: released feature extractor of CAMDM (Chen et al. 2024).
    """
    joints = jnp.asarray(released_joints(skeleton))
    positions = joint_positions(skeleton, motion)
    turn = rotation.matrix_from_facing(body_facing(skeleton, positions))
    local = positions[..., joints, :] - positions[..., :1, :]
    x, y, z = jnp.moveaxis(rotation.product(local, turn), -1, 0)
    local = jnp.stack([z, y, -x], axis=-1)  # from facing +z
    return local.reshape(*local.shape[:-2], -1)


def window_input(
    skeleton: Skeleton, motion: Motion
) -> Float[Array, "*batch frames channels"]:
    """Joint positions, meters, relative to the root and facing +z in each frame.

    So neither where a character walks nor how fast or where it faces is visible, but
    what its limbs do. The root's height stands in place of its zeros.
    """
    positions = joint_positions(skeleton, motion)
    facing = trajectory.root_trajectory(skeleton, motion).facing
    turn = rotation.matrix_from_facing(facing)
    local = positions - positions[..., :1, :]
    local = rotation.product(local, turn)
    local = local.at[..., 0, 1].set(positions[..., 0, 1])
    return local.reshape(*local.shape[:-2], -1)


def cross_entropy(
    logits: Float[Array, "batch classes"], labels: Int[Array, " batch"]
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean cross entropy in nats, and how often the largest logit is the right one."""
    log_probability = jax.nn.log_softmax(logits)
    losses = -jnp.take_along_axis(log_probability, labels[:, None], axis=-1)
    accuracy = jnp.mean(jnp.argmax(logits, axis=-1) == labels)
    return jnp.mean(losses), {"accuracy": accuracy}


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters of `WindowClassifier`."""
    x = jnp.zeros((1, config.frames, 3 * config.num_joints))
    return config.network.init(key, x)["params"]


def loss(
    params: Params,
    key: Key,
    batch: tuple[Float[Array, "batch frames channels"], Int[Array, " batch"]],
    *,
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Cross entropy and accuracy of windows of `window_input`, and their classes.

    The key is consumed by dropout.
    """
    x, labels = batch
    _, logits = blocks.apply(
        params, config.network, x, train=True, rngs={"dropout": key}
    )
    return cross_entropy(logits, labels)


def classify(
    params: Params,
    x: Float[Array, "batch frames channels"],
    *,
    config: Config,
) -> tuple[Float[Array, "batch features"], Float[Array, "batch classes"]]:
    """Features (for Fréchet distances) and logits of windows of `window_input`."""
    return blocks.apply(params, config.network, x)


def train(
    key: Key,
    x: Float[Array, "windows frames channels"],
    labels: Int[Array, " windows"],
    *,
    config: Config,
    num_steps: int = 1500,
    batch: int = 128,
    learning_rate: float = 1e-3,
) -> tuple[Params, dict[str, Array]]:
    """Trains an evaluator on windows of `window_input`, as `train_classifier` does."""
    return train_classifier(
        key,
        lambda key: init(key, config),
        functools.partial(loss, config=config),
        (x, labels),
        num_steps=num_steps,
        batch=batch,
        learning_rate=learning_rate,
        weight_decay=1e-4,
    )


def train_classifier(
    key: Key,
    init: Callable[[Key], Params],
    loss: training.Loss,
    data: tuple[Float[Array, "samples frames channels"], Int[Array, " samples"]],
    *,
    num_steps: int,
    batch: int,
    learning_rate: float,
    weight_decay: float = 0.0,
    max_norm: float | None = None,
) -> tuple[Params, dict[str, Array]]:
    """Trains any classifier of motions as one compiled program.

    Samples are drawn with replacement; Adam's rate has a cosine decay to a tenth;
    weight decay is decoupled; the gradient is clipped to a global norm, None for not.
    With the moving average of the parameters come losses and accuracies by step.
    """
    key_init, key_train = jax.random.split(key)
    optimizer = training.make_optimizer(
        "adamw",
        learning_rate=learning_rate,
        num_steps=num_steps,
        weight_decay=weight_decay,
        max_norm=max_norm,
    )

    def sample_batch(key: Key, data: tuple[Array, Array]) -> tuple[Array, Array]:
        x, labels = data
        chosen = jax.random.randint(key, (batch,), 0, x.shape[0])
        return x[chosen], labels[chosen]

    update = training.make_update(loss, optimizer, ema_decay=0.99)
    run = training.train_chunk(update, sample_batch, num_steps=num_steps)
    state = training.init_train_state(init(key_init), optimizer)
    state, info = run(state, key_train, data)
    return state.ema_params, info


def in_batches(function: Callable[[Any], Any], x: Any, *, size: int = 256) -> Any:
    """Applies a jitted function to slices of the first axis, to bound the memory."""
    number = jax.tree.leaves(x)[0].shape[0]
    parts = [
        jax.device_get(function(jax.tree.map(lambda a: a[i : i + size], x)))  # noqa: B023
        for i in range(0, number, size)
    ]
    return jax.tree.map(lambda *p: np.concatenate(p), *parts)


def contact_height(skeleton: Skeleton, real: EvalWindows) -> float:
    """Height below which toes should not move, meters.

    One centimeter above where toes rest (their first percentile), as the paper's
    "below, e.g., 1 cm".
    """
    feet = jnp.array(skeleton.feet)
    toes = in_batches(
        jax.jit(lambda m: joint_positions(skeleton, m)[..., feet, :]), real.motion
    )
    return float(np.percentile(toes[..., 1], 1)) + 0.01


@dataclasses.dataclass(frozen=True, kw_only=True)
class StyleEvaluator:
    """A style evaluator and its size; its class of each label, if they differ."""

    params: Params
    config: Config
    classes: tuple[int, ...] = ()


def fit(
    key: Key, clips: Clips, *, field: str, num_steps: int = 1500, batch: int = 128
) -> StyleEvaluator:
    """Trains the evaluator of styles (`field`) on windows every 10 frames.

    `ValueError` unless clips have 30 frames per second.
    """
    if clips.fps != 30.0:
        raise ValueError(f"clips of {clips.fps:g} frames per second, expected 30")
    found = eval_windows(clips, stride=10, field=field)
    config = Config(
        num_classes=len(clips.names(field)),
        num_joints=clips.skeleton.num_joints,
        frames=EVAL_WINDOW,
    )
    to_input = jax.jit(functools.partial(window_input, clips.skeleton))
    x = jnp.asarray(in_batches(to_input, found.motion))
    params, _ = train(
        key, x, found.label, config=config, num_steps=num_steps, batch=batch
    )
    return StyleEvaluator(params=params, config=config)


def features_and_hits(
    skeleton: Skeleton, found: EvalWindows, evaluator: StyleEvaluator
) -> tuple[np.ndarray, np.ndarray]:
    """Features [windows, 512], and whether each style is recognized (0 or 1)."""
    run = functools.partial(_classify, evaluator.params, skeleton, evaluator.config)
    label = found.label
    if evaluator.classes:
        label = jnp.asarray(evaluator.classes)[label]
    return in_batches(run, (found.motion, label))


@functools.partial(jax.jit, static_argnums=2)
def _classify(
    params: Params,
    skeleton: Skeleton,
    config: Config,
    x: tuple[Motion, Array],
) -> tuple[Array, Array]:
    motion, label = x
    given = config.read(skeleton, motion)
    feature, logits = classify(params, given, config=config)
    return feature, (jnp.argmax(logits, axis=-1) == label).astype(jnp.float32)
