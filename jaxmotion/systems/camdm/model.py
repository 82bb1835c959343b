"""CAMDM: a transformer diffusion model that continues a motion along a trajectory.

A pose is one 6D rotation a joint and a last pseudo-joint (x, y, z, 0, 0, 0) for the
root; a sample is the next 45 poses. The condition is the last 10 poses, the ground path
and facings wanted for the 45, and a style. Eight steps of the cosine schedule:

    plan = reverse_chain(ancestral_step(schedule, net), key, x_8, start=8)

No feature is normalized: values are meters and entries of rotation matrices.

Source: Chen et al. 2024, "Taming Diffusion Probabilistic Models for Character Control";
what the paper leaves open is as in the released code, and said where it is used.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion import files
from jaxmotion.data import selection
from jaxmotion.data.clips import Clips
from jaxmotion.diffusion import chain, guidance, schedule
from jaxmotion.learning import checkpoint, model_json, runs
from jaxmotion.motion import features, rotation, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.networks import blocks, transformer
from jaxmotion.systems.camdm import network as camdm_network
from jaxmotion.typing import Key, Params

SYSTEM = "camdm"
# The one training of a run folder.
STAGE = "motion"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Architecture and method; the defaults are the paper's.

    Attributes:
      num_steps: T of the cosine schedule (paper 8, released weights 4).
      network: "transformer", or the ablation's "mlp" or "single_token".
      width: Channels of a token (released code; the paper does not say).
      frames_per_token, token_margin, token_window, norm, attention, frame_kernel: Of
        the `CamdmTransformer`; the paper's by default.
      seam_half_life: The same; with it the losses of displacements, accelerations and
        feet reach over the seam.
      noise_levels: Noise levels of one window in training; ours, 1 in the paper.
      own_levels: Probability that the lower half of a window's noise levels is noise on
        predictions from the upper half, as in sampling, instead of noise on the
        recording; ours, 0 in the paper.
      cubic_wishes: Probability that the wanted path of a training window is the cubic
        that fits the recorded one, as smooth as a command's; ours, 0 in the paper.
      rotation_layout: 6D as two rows (released code) or two columns.
      heading: Frame of a sample. "random": axes turned by a random yaw (released
        code). "facing": +z is where the character faces in the last past pose (ours:
        the network need not learn that turning the world changes nothing).
      rotation_scale: Factor on the 6D rotations of a sample, after their mean is taken
        off; ours, 1 in the paper. Entries vary by about 0.2, the noise of the last
        step alone has that size, and a short training then learns to ignore the
        noisy sample; 4 gives both about unit variance, as standardizing would.
      rotation_mean: Mean of those features (`camdm_loss.mean_rotations`); ours, empty
        for none in the paper.
      drop_past: Probability that the past is zeroed in training.
      weight_velocity: Weight of the displacements of rotations.
      weight_position: Weight of the joint positions (eq. 3).
      weight_position_velocity: Weight of the displacements of joint positions (released
        code; not in the paper's eq. 4).
      weight_acceleration: Weight of the second differences of joint positions; ours, 0
        in the paper.
      contact_speed: A foot slower than this stands, meters per second.
    """

    num_joints: int
    num_labels: int
    past: int = 10
    future: int = 45
    fps: float = 30.0
    num_steps: int = 8
    network: Literal["transformer", "mlp", "single_token"] = "transformer"
    width: int = 256
    depth: int = 4
    heads: int = 4
    hidden: int = 1024
    dropout: float = 0.2
    frames_per_token: int = 1
    token_margin: int = 0
    token_window: Literal["hann", "trapezoid"] = "hann"
    norm: Literal["post", "pre"] = "post"
    attention: Literal["full", "prefix"] = "full"
    frame_kernel: int = 0
    seam_half_life: float = 0.0
    noise_levels: int = 1
    own_levels: float = 0.0
    cubic_wishes: float = 0.0
    rotation_layout: Literal["rows", "columns"] = "rows"
    heading: Literal["random", "facing"] = "random"
    rotation_scale: float = 1.0
    rotation_mean: tuple[float, ...] = ()
    drop_past: float = 0.15
    weight_data: float = 1.0
    weight_velocity: float = 1.0
    weight_position: float = 1.0
    weight_position_velocity: float = 1.0
    weight_acceleration: float = 0.0
    weight_foot: float = 1.0
    contact_speed: float = 0.3

    @property
    def window(self) -> int:
        """Frames of a training window."""
        return self.past + self.future

    @property
    def num_features(self) -> int:
        """Channels of a pose."""
        return (self.num_joints + 1) * 6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Condition:
    """What a plan is made for, in the frame of the plan.

    Attributes:
      past: Features of the last displayed poses.
      trajectory: Ground positions (x, z), meters, and facings wanted for the future.
      label: Style.
      keep_past: False for the null condition of classifier-free guidance.
    """

    past: Float[Array, "*batch past features"]
    trajectory: trajectory.Trajectory
    label: Int[Array, "*batch"]
    keep_past: Bool[Array, "*batch"]

    def arguments(self, config: Config) -> tuple[Array, ...]:
        """Past, path, facing (6D), label and keep_past, which follow x_t and t."""
        facing = rotation.rot6d_from_matrix(
            rotation.matrix_from_facing(self.trajectory.facing)
        )
        if config.rotation_layout == "rows":
            facing = rotation.rot6d_rows_to_columns(facing)
        return (
            self.past,
            self.trajectory.position,
            facing,
            self.label,
            self.keep_past,
        )


Network = (
    transformer.CamdmTransformer
    | camdm_network.CamdmMlp
    | camdm_network.SingleTokenTransformer
)


_NETWORKS: dict[str, Any] = {
    "transformer": transformer.CamdmTransformer,
    "mlp": camdm_network.CamdmMlp,
    "single_token": camdm_network.SingleTokenTransformer,
}


def lacking(name: str) -> frozenset[str]:
    """Options of `Config` that the transformer has and the network so named has not."""
    names = lambda kind: {x.name for x in dataclasses.fields(kind)}  # noqa: E731
    full, own = names(_NETWORKS["transformer"]), names(_NETWORKS[name])
    return frozenset((full - own) & names(Config))


def network(config: Config) -> Network:
    """The denoiser's Flax module, with `encode`, `denoise` and their composition.

    `ValueError` for an option of the transformer that another network does not have.
    """
    missing = lacking(config.network)
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in missing and value != field.default:
            raise ValueError(
                f"{field.name} is {value}, expected {field.default} with the network "
                f"{config.network!r}"
            )
    return blocks.sized(_NETWORKS[config.network], config, features=config.num_features)


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    past = jnp.zeros((config.past, config.num_features))
    x_t = jnp.zeros((config.future, config.num_features))
    path, facing = jnp.zeros((config.future, 2)), jnp.zeros((config.future, 6))
    label, keep = jnp.zeros((), jnp.int32), jnp.ones((), bool)
    t = jnp.ones((), jnp.int32)
    return network(config).init(key, x_t, t, past, path, facing, label, keep)["params"]


def to_features(
    motion: Motion, *, config: Config
) -> Float[Array, "*batch frames features"]:
    """Features of a motion in the frame of a plan.

    One 6D rotation per joint, and the root's (x, y, z, 0, 0, 0).
    """
    poses = features.motion_features(motion, rotation_layout=config.rotation_layout)
    rotations, root = poses[..., :-6], poses[..., -6:]
    scaled = (rotations - _mean(config, rotations)) * config.rotation_scale
    return jnp.concatenate([scaled, root], axis=-1)


def _mean(config: Config, rotations: Array) -> Array:
    mean = jnp.asarray(config.rotation_mean or 0.0, rotations.dtype)
    return jnp.broadcast_to(mean, rotations.shape)


def to_motion(
    poses: Float[Array, "*batch frames features"], *, config: Config
) -> Motion:
    """Inverse of `to_features`, in the frame of the plan.

    Rotations are made orthonormal, so features may come from a network.
    """
    rotations, root = poses[..., :-6], poses[..., -6:]
    plain = rotations / config.rotation_scale + _mean(config, rotations)
    return features.motion_from_features(
        jnp.concatenate([plain, root], axis=-1),
        config.fps,
        rotation_layout=config.rotation_layout,
    )


Sample = Callable[..., Float[Array, "future features"]]


def sampler(
    params: Params,
    *,
    config: Config,
    table: schedule.Schedule | None = None,
    step: chain.StepFactory = chain.ancestral_step,
    steps: tuple[int, ...] | None = None,
) -> Sample:
    """The sampler of plans, with everything that the steps share computed once.

    Inside a jitted function that closes over concrete parameters they are constants,
    which the compiler lays out once: fastest at batch 1, one program a model.

    `steps` of the schedule (None: the cosine one) are visited, increasing; None for
    all.

    Returns:
      `sample(key, condition, *, scale=None) -> [future, features]`. With a scale, the
      prediction is null + scale (full - null), where null has no past (eq. 5);
      without, the network is called once a step.
    """
    net = network(config)

    def denoise(key: Key, x_t: Array, t: Array, context) -> Array:
        del key  # deterministic
        return blocks.apply(params, net, context, x_t, t, method="denoise")

    def encode(condition: Condition):
        arguments = condition.arguments(config)
        return blocks.apply(params, net, *arguments, method="encode")

    def sample(key: Key, condition: Condition, *, scale=None) -> Array:
        noise_table = schedule.cosine_schedule(config.num_steps)
        noise_table = noise_table if table is None else table
        context = encode(condition)
        if scale is None:
            denoiser = lambda k, x, t: denoise(k, x, t, context)  # noqa: E731
        else:
            off = jnp.zeros_like(condition.keep_past)
            null = encode(dataclasses.replace(condition, keep_past=off))
            denoiser = guidance.classifier_free(denoise, context, null, scale)
        return chain.sample(
            chain.respaced(step, steps)(noise_table, denoiser),
            key,
            (config.future, config.num_features),
            num_steps=noise_table.num_steps if steps is None else len(steps),
        )

    return sample


def check_steps(steps: Any, *, config: Config) -> tuple[int, ...]:
    """Steps for a plan to visit; raises `ValueError` unless they increase up to T."""
    total = config.num_steps
    whole = isinstance(steps, list | tuple) and all(type(x) is int for x in steps)
    if (
        not whole
        or [*steps] != sorted({*steps})
        or not steps
        or steps[0] < 1
        or steps[-1] != total
    ):
        raise ValueError(
            f"steps are {steps!r:.60}, expected increasing ones in 1..{total}, the "
            f"last {total}"
        )
    return tuple(steps)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """Everything but the parameters.

    Attributes:
      source: The data, and its license.
      starts: Poses to start from, [labels, number, past, ...], at the origin facing +z;
        None where characters start from clips. A shipped model has its own, which it
        made itself.
      steps: Steps of the schedule that a plan visits, increasing, the last T; None for
        all. A student was distilled for its few.
      all_steps: Whether the network learned all steps of its schedule, so that plans
        may visit others than `steps`; a student learned its own alone.
      toe_height: Where toes rest in its data, meters; None where nobody measured it.
    """

    config: Config
    skeleton: Skeleton
    labels: tuple[str, ...]
    source: str
    starts: Motion | None = None
    steps: tuple[int, ...] | None = None
    all_steps: bool = True
    toe_height: float | None = None


def with_steps(model: Model, steps: tuple[int, ...]) -> Model:
    """The model whose plans visit these steps of its schedule; none: its own."""
    if not steps:
        return model
    return dataclasses.replace(model, steps=check_steps(steps, config=model.config))


def to_json(model: Model) -> dict[str, Any]:
    """JSON of a model."""
    value = {
        "system": SYSTEM,
        "config": dataclasses.asdict(model.config),
        "skeleton": model_json.skeleton_to_json(model.skeleton),
        "labels": list(model.labels),
        "source": model.source,
    }
    if model.steps is not None:
        value["steps"] = list(model.steps)
        value["all_steps"] = model.all_steps
    if model.toe_height is not None:
        value["toe_height"] = model.toe_height
    if model.starts is not None:
        value["starts"] = model_json.arrays_to_json(
            {
                "root_position": model.starts.root_position,
                "joint_rotation": model.starts.joint_rotation,
            }
        )
    return value


def _starts_from_json(value: Any, config: Config, where: str) -> Motion | None:
    found = model_json.starts_from_json(
        value,
        labels=config.num_labels,
        past=config.past,
        frames={"root_position": (3,), "joint_rotation": (config.num_joints, 6)},
        where=where,
    )
    return None if found is None else Motion(**found, fps=config.fps)


def from_json(value: dict[str, Any], *, where: str) -> Model:
    """Inverse of `to_json`; a `ValueError` names the file (`where`) and the field."""
    model_json.check_system(value, SYSTEM, where=where)
    parts = {
        "config": lambda x: model_json.config_from_json(Config, x),
        "skeleton": model_json.skeleton_from_json,
        "labels": model_json.names_from_json,
        "source": lambda x: model_json.names_from_json([x])[0],
    }
    made = model_json.decode(value, where, parts)
    model = Model(**made)
    config = model.config
    for name, found, expected in (
        ("skeleton", model.skeleton.num_joints, config.num_joints),
        ("labels", len(model.labels), config.num_labels),
    ):
        if found != expected:
            raise ValueError(
                f"{where}: field {name!r} has {found} entries, the config {expected}"
            )
    starts = _starts_from_json(value.get("starts"), config, where)
    steps = value.get("steps")
    try:
        steps = None if steps is None else check_steps(steps, config=config)
    except ValueError as error:
        raise ValueError(f"{where}: field 'steps': {error}") from None
    all_steps = value.get("all_steps", steps is None)
    if not isinstance(all_steps, bool):
        raise ValueError(
            f"{where}: field 'all_steps' is {all_steps!r:.60}, expected true or false"
        )
    height = model_json.toe_height_from_json(value.get("toe_height"), where=where)
    return dataclasses.replace(
        model, starts=starts, steps=steps, all_steps=all_steps, toe_height=height
    )


def _shapes(model: Model, where: Path) -> Params:
    try:
        return jax.eval_shape(lambda: init(jax.random.key(0), model.config))
    except Exception as error:  # whatever a network makes of sizes that do not fit
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{where}: field 'config' is of no network: {line}") from error


def check_clips(model: Model, clips: Clips, field: str) -> None:
    """Raises a `ValueError` unless clips have the model's skeleton, rate and styles."""
    pairs = {
        "joints": (model.skeleton.names, clips.skeleton.names),
        "parents": (model.skeleton.parents, clips.skeleton.parents),
        f"names of {field!r}": (model.labels, clips.names(field)),
        "fps": (model.config.fps, clips.fps),
    }
    for what, (expected, found) in pairs.items():
        if expected != found:
            raise ValueError(
                f"the clips do not fit the model: {what} {found}, expected {expected}"
            )


def fitting_clips(model: Model, clips: Clips) -> tuple[Clips, str]:
    """Those of the clips that have the model's styles, and the label field with them.

    `ValueError` if no field has them all, or skeleton or rate are others.
    """
    field = selection.label_field(clips, model.labels)
    if field is not None:
        if clips.names(field) != model.labels:
            clips = selection.select(clips, field, model.labels)
            clips = selection.relabel(clips, field)
        check_clips(model, clips, field)
        return clips, field
    raise ValueError(
        f"the clips do not fit the model: no label field (of "
        f"{', '.join(name for name, _ in clips.label_names)}) has "
        f"the styles {', '.join(model.labels)}"
    )


def load(folder: str | Path) -> tuple[Model, Params]:
    """Model and averaged parameters (EMA) of a run folder or an exported file.

    The folder is a shipped model's name ("locomotion"), a run folder of `camdm.py
    train`, or a file of `camdm.py export`. `OSError` if there is none,
    `CheckpointError` if its checkpoint is missing, corrupt or foreign, `ValueError` if
    its JSON is not that of a CAMDM model.
    """
    path = files.shipped(folder) or Path(folder)
    if path.is_file():
        params, value = checkpoint.import_params(path)
        model = from_json(value, where=str(path))
        checkpoint.check_params(path, params, _shapes(model, path))
        return model, params
    run = runs.load(path, system=SYSTEM)
    model = from_json(run.model, where=str(run.config))
    runs.check_model(run, STAGE, dataclasses.asdict(model.config))
    return model, runs.load_params(run, STAGE, lambda: _shapes(model, path))
