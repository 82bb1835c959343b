"""SMGDiff: a transformer diffusion model of a person and a ball.

A sample is the next 45 frames of body, ball and contacts (`smgdiff_scene`), seen from
the last displayed pose; the condition is the last 10 frames, a ground path with
facings, and a skill. The network is CAMDM's. Eight steps of the cosine schedule; in
some of them, by default the last two, contact guidance pulls foot and ball together:

    x = reverse_chain(ancestral_step(schedule, net), key, x_8, start=8, stop=2)
    x = reverse_chain(dsg_step(schedule, net, contact_objective), key, x, start=2)

Source: SMGDiff, section 3; sizes, which its missing supplement has, are CAMDM's.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.learning import checkpoint, model_json
from jaxmotion.motion import rotation
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import Motion
from jaxmotion.motion.trajectory import Trajectory
from jaxmotion.networks import blocks, transformer
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.scene import Representation, feature_layout
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Architecture and method; the defaults are the paper's where it has them.

    Attributes:
      num_features: Channels of a frame, from `feature_layout`.
      num_steps: T of the cosine schedule.
      width: Channels of a token (CAMDM's).
      frames_per_token, token_margin, token_window, norm, attention, frame_kernel: Of
        the `CamdmTransformer`; the paper's by default.
      seam_half_life: The same, of root and rotations; with it the losses of
        displacements and feet reach over the seam.
      seam_features: Channels of root and rotations, which come first; 0 without.
      noise_levels: Noise levels of one window in training; ours, 1 in the paper.
      own_levels, cubic_wishes: As in `camdm.Config`; ours, 0 in the paper.
      weight_velocity: Weight of the displacements of features.
      weight_rotation: Factor of the rotations' errors in both of these; ours, 1 in the
        paper.
      weight_position_velocity: Weight of the displacements of joint positions (CAMDM's;
        not in the paper).
      weight_acceleration: Weight of their second differences (not in the paper).
      weight_foot: Weight of feet that slide while they stand.
      weight_ball: Weight of the ball's place while it is near (not in the paper).
      weight_ball_acceleration: Weight of the second differences of its place, by which
        contact guidance tells touches (not in the paper).
    """

    num_features: int
    num_labels: int
    past: int = 10
    future: int = 45
    fps: float = 30.0
    num_steps: int = 8
    width: int = 256
    depth: int = 4
    heads: int = 4
    hidden: int = 1024
    dropout: float = 0.1
    frames_per_token: int = 1
    token_margin: int = 0
    token_window: Literal["hann", "trapezoid"] = "hann"
    norm: Literal["post", "pre"] = "post"
    attention: Literal["full", "prefix"] = "full"
    frame_kernel: int = 0
    seam_half_life: float = 0.0
    seam_features: int = 0
    noise_levels: int = 1
    own_levels: float = 0.0
    cubic_wishes: float = 0.0
    weight_data: float = 1.0
    weight_velocity: float = 1.0
    weight_rotation: float = 1.0
    weight_position: float = 1.0
    weight_position_velocity: float = 0.0
    weight_acceleration: float = 0.0
    weight_foot: float = 1.0
    weight_ball: float = 0.0
    weight_ball_acceleration: float = 0.0

    @property
    def window(self) -> int:
        """Frames of a training window."""
        return self.past + self.future


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Condition:
    """What a plan is made for, in the frame of the plan.

    Attributes:
      past: Features of the last displayed frames.
      trajectory: Ground path and facings wanted for the future.
      label: Skill.
      ball: Where the ball was displayed last, meters.
    """

    past: Float[Array, "*batch past features"]
    trajectory: Trajectory
    label: Int[Array, "*batch"]
    ball: Float[Array, "*batch 3"]

    def arguments(self) -> tuple[Array, ...]:
        """Past, path, facing (6D), label, and that the past is kept."""
        facing = rotation.rot6d_from_matrix(
            rotation.matrix_from_facing(self.trajectory.facing)
        )
        keep = jnp.ones(self.label.shape, bool)
        return self.past, self.trajectory.position, facing, self.label, keep


def network(config: Config) -> transformer.CamdmTransformer:
    """The denoiser's Flax module: CAMDM's, with methods `encode` and `denoise`."""
    kind = transformer.CamdmTransformer
    return blocks.sized(kind, config, features=config.num_features)


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters."""
    line = Trajectory(
        position=jnp.zeros((config.future, 2)), facing=jnp.ones((config.future, 2))
    )
    condition = Condition(
        past=jnp.zeros((config.past, config.num_features)),
        trajectory=line,
        label=jnp.zeros((), jnp.int32),
        ball=jnp.zeros(3),
    )
    x_t = jnp.zeros((config.future, config.num_features))
    t = jnp.ones((), jnp.int32)
    return network(config).init(key, x_t, t, *condition.arguments())["params"]


SYSTEM = "smgdiff"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """Everything but the parameters.

    Attributes:
      speeds: Median speed of the root in each skill, meters per second.
      source: The data, and its license.
      starts: Frames to start from, [labels, number, past, ...], of players at the
        origin that face +z; None where they start from clips. A shipped model has its
        own, which it made itself.
      toe_height: Where toes rest in its data, meters; None where nobody measured it.
    """

    config: Config
    paths: smgdiff_trajectory.Config
    representation: Representation
    labels: tuple[str, ...]
    speeds: tuple[float, ...]
    source: str
    starts: Scene | None = None
    toe_height: float | None = None


def to_json(model: Model) -> dict[str, Any]:
    """JSON of a model."""
    features = model.representation
    value = {
        "system": SYSTEM,
        "config": dataclasses.asdict(model.config),
        "paths": dataclasses.asdict(model.paths),
        "representation": {
            "skeleton": model_json.skeleton_to_json(features.skeleton),
            **model_json.normalizer_to_json(features.normalizer),
            "joints": list(features.joints),
            "fps": features.fps,
            "radius": features.radius,
            "reach": features.reach,
            "contact_speed": features.contact_speed,
        },
        "labels": list(model.labels),
        "speeds": list(model.speeds),
        "source": model.source,
    }
    if model.toe_height is not None:
        value["toe_height"] = model.toe_height
    if model.starts is not None:
        motion = model.starts.motion
        value["starts"] = model_json.arrays_to_json(
            {
                "root_position": motion.root_position,
                "joint_rotation": motion.joint_rotation,
                "ball": model.starts.ball,
                "touch": model.starts.touch,
            }
        )
    return value


def _starts_from_json(value: Any, model: Model, where: str) -> Scene | None:
    features = model.representation
    found = model_json.starts_from_json(
        value,
        labels=len(model.labels),
        past=model.config.past,
        frames={
            "root_position": (3,),
            "joint_rotation": (features.skeleton.num_joints, 6),
            "ball": (3,),
            "touch": (len(features.joints),),
        },
        where=where,
    )
    if found is None:
        return None
    ball, touch = found.pop("ball"), found.pop("touch")
    return Scene(motion=Motion(**found, fps=model.config.fps), ball=ball, touch=touch)


def _representation(value: Any) -> Representation:
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    skeleton = model_json.skeleton_from_json(value["skeleton"])
    joints = value["joints"]
    right = isinstance(joints, list) and all(type(x) is int for x in joints)
    if not right or not all(0 <= x < skeleton.num_joints for x in joints):
        raise ValueError(
            f"joints is {joints!r:.60}, expected numbers below {skeleton.num_joints}"
        )
    size = feature_layout(skeleton, tuple(joints)).size
    normalizer = model_json.normalizer_from_json(value, size=size)
    scalars = ("fps", "radius", "reach", "contact_speed")
    for name in scalars:
        model_json.numbers_from_json(name, [value[name]], least=1e-6)
    return Representation(
        skeleton=skeleton,
        normalizer=normalizer,
        joints=tuple(joints),
        **{name: float(value[name]) for name in scalars},
    )


def from_json(value: dict[str, Any], *, where: str) -> Model:
    """Inverse of `to_json`; a `ValueError` names the file (`where`) and the field."""
    model_json.check_system(value, SYSTEM, where=where)
    parts = {
        "config": lambda x: model_json.config_from_json(Config, x),
        "paths": lambda x: model_json.config_from_json(smgdiff_trajectory.Config, x),
        "representation": _representation,
        "labels": model_json.names_from_json,
        "speeds": lambda x: tuple(model_json.numbers_from_json("speed", x, least=0.0)),
        "source": lambda x: model_json.names_from_json([x])[0],
    }
    made = model_json.decode(value, where, parts)
    model = Model(**made)
    labels, size = len(model.labels), model.representation.normalizer.mean.size
    for name, found, expected in (
        ("config.num_features", model.config.num_features, size),
        ("config.num_labels", model.config.num_labels, labels),
        ("paths.num_labels", model.paths.num_labels, labels),
        ("speeds", len(model.speeds), labels),
    ):
        if found != expected:
            raise ValueError(f"{where}: field {name!r} is {found}, expected {expected}")
    starts = _starts_from_json(value.get("starts"), model, where)
    height = model_json.toe_height_from_json(value.get("toe_height"), where=where)
    return dataclasses.replace(model, starts=starts, toe_height=height)


def import_file(path: Path) -> tuple[Model, dict[str, Params]]:
    """Model and parameters, of "motion" and of "paths", of an exported file.

    `CheckpointError` if it is damaged or none, `ValueError` for another system.
    """
    params, value = checkpoint.import_params(path)
    model = from_json(value, where=str(path))
    like = jax.eval_shape(
        lambda: {
            "motion": init(jax.random.key(0), model.config),
            "paths": smgdiff_trajectory.init(jax.random.key(1), model.paths),
        }
    )
    checkpoint.check_params(path, params, like)
    return model, params
