"""AAMDM's embedded space: a pose as its path features and a learned latent.

    xz = [x, z],   x = path features [12],   z = E(y) [52],   y ~ D(xz)

and the autoencoder's loss, which looks at poses in their own channels and, through
forward kinematics F, in the character's axes:

    L_val = |y' - y| + |F(y') - F(y)|,  L_vel = the same of differences per second,
    L_reg = |z|^2 + |z| + the differences of z.

Source: Li et al. 2024 (AAMDM), section 3.1, eq. 1-4. Norms, weights and normalization
are those of Learned Motion Matching (Holden et al. 2020, released code), since the
paper gives none. So are terms that its equations do not have: differences of local
positions and rotations beside eq. 2's of F, and the latent's |z| and differences beside
eq. 3's square.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import features, pose, rotation
from jaxmotion.motion.features import unpack
from jaxmotion.networks import blocks
from jaxmotion.systems.aamdm import network as aamdm_network
from jaxmotion.typing import Key, Params

PATH = 12
SLOW = 1.0  # meters per second; slower feet are near or on the ground


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of the autoencoder's terms: ours, after Learned Motion Matching."""

    position: float = 75.0
    rotation: float = 10.0
    velocity: float = 10.0
    angular_velocity: float = 1.25
    root_velocity: float = 2.0
    root_angular_velocity: float = 2.0
    contact: float = 2.0
    character_position: float = 15.0
    character_rotation: float = 5.0
    position_change: float = 10.0
    rotation_change: float = 1.75
    character_position_change: float = 2.0
    character_rotation_change: float = 0.75
    latent: float = 0.1
    latent_square: float = 0.1
    latent_change: float = 0.01


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes of the autoencoder.

    Attributes:
      latent: Channels of z (paper: 52, so that xz has 64).
      width: Channels of a hidden layer (ours; the paper gives none).
    """

    num_joints: int
    fps: float = 60.0
    latent: int = 52
    width: int = 512
    weights: Weights = Weights()

    @property
    def num_features(self) -> int:
        """Channels of a pose vector."""
        return pose.pose_layout(self.num_joints).size

    @property
    def num_embedded(self) -> int:
        """Channels of an embedded vector."""
        return PATH + self.latent


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """How poses and paths are scaled, from the training frames.

    Attributes:
      pose: Mean and deviation of each channel: the decoder's output.
      group: The same mean, and one deviation for each kind of channel, that of all its
        numbers: the encoder's input. It keeps a joint that hardly moves from being
        blown up.
      path: Mean of each path feature, and the mean deviation of the positions and of
        the facings.
    """

    pose: features.Normalizer
    group: features.Normalizer
    path: features.Normalizer


def fit_statistics(
    poses: Float[Array, "frames features"],
    paths: Float[Array, "frames 12"],
    *,
    config: Config,
) -> Statistics:
    """Statistics of training frames; constant channels get a floor of 1e-4.

    Source: Holden et al. 2020, released code: train_decompressor, database.
    """
    own = features.fit_normalizer(poses)
    layout = pose.pose_layout(config.num_joints)
    groups = [
        jnp.full(stop - start, jnp.std(poses[:, start:stop]))
        for _, start, stop in layout.fields
    ]
    group = jnp.maximum(jnp.concatenate(groups), 1e-4)
    path = features.fit_normalizer(paths)
    halves = jnp.mean(path.std.reshape(2, PATH // 2), axis=1)
    return Statistics(
        pose=own,
        group=features.Normalizer(mean=own.mean, std=group),
        path=features.Normalizer(
            mean=path.mean, std=jnp.repeat(halves, PATH // 2, axis=0)
        ),
    )


def _nets(
    config: Config,
) -> tuple[aamdm_network.PoseEncoder, aamdm_network.PoseDecoder]:
    return (
        aamdm_network.PoseEncoder(latent=config.latent, width=config.width),
        aamdm_network.PoseDecoder(features=config.num_features, width=config.width),
    )


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters, {"encoder", "decoder"}."""
    key_e, key_d = jax.random.split(key)
    encoder, decoder = _nets(config)
    pose_like = jnp.zeros(config.num_features)
    return {
        "encoder": encoder.init(key_e, pose_like)["params"],
        "decoder": decoder.init(key_d, jnp.zeros(config.num_embedded))["params"],
    }


def encode(
    params: Params,
    statistics: Statistics,
    poses: Float[Array, "*batch features"],
    paths: Float[Array, "*batch 12"],
    *,
    config: Config,
) -> Float[Array, "*batch embedded"]:
    """Embeds poses as [path features, latent].

    Path features stay in meters, for those who steer.
    """
    given = features.normalize(statistics.group, poses)
    latent = blocks.apply(params["encoder"], _nets(config)[0], given)
    return jnp.concatenate([paths, latent], axis=-1)


def decode(
    params: Params,
    statistics: Statistics,
    embedded: Float[Array, "*batch embedded"],
    *,
    config: Config,
) -> Float[Array, "*batch features"]:
    """Pose vectors, in their own units, of what `encode` returns."""
    path = features.normalize(statistics.path, embedded[..., :PATH])
    given = jnp.concatenate([path, embedded[..., PATH:]], axis=-1)
    found = blocks.apply(params["decoder"], _nets(config)[1], given)
    return features.denormalize(statistics.pose, found)


def _transforms(
    parts: dict[str, Array], parents: tuple[int, ...]
) -> tuple[Array, Array]:
    split = lambda x: x.reshape(*x.shape[:-1], len(parents), -1)  # noqa: E731
    return pose.character_transforms(
        parents, split(parts["position"]), split(parts["rotation"])
    )


def character_positions(
    poses: Float[Array, "*batch features"], parents: tuple[int, ...]
) -> Float[Array, "*batch joints 3"]:
    """Joints that pose vectors mean, in the axes of the simulation bone, meters."""
    return _transforms(unpack(pose.pose_layout(len(parents)), poses), parents)[0]


def _views(poses: Array, parents: tuple[int, ...]) -> dict[str, Array]:
    """Poses in their own channels, and in the character's axes."""
    parts = unpack(pose.pose_layout(len(parents)), poses)
    where, turned = _transforms(parts, parents)
    axes = rotation.rot6d_from_matrix(turned)
    return parts | {"character_position": where, "character_rotation": axes}


def pose_errors(
    found: Float[Array, "*batch frames features"],
    poses: Float[Array, "*batch frames features"],
    *,
    parents: tuple[int, ...],
    config: Config,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How far pose vectors are from others, and their changes per second.

    Weighted L1 means over frames in a row.

    Source: Li et al. 2024 (AAMDM), eq. 1 and 2.
    """
    views = [_views(x, parents) for x in (found, poses)]
    weights: dict[str, Any] = dataclasses.asdict(config.weights)
    value = change = jnp.zeros(())
    for name, mine in views[0].items():
        error = mine - views[1][name]
        value = value + weights[name] * jnp.mean(jnp.abs(error))
        if f"{name}_change" in weights:
            rate = jnp.diff(error, axis=poses.ndim - 2) * config.fps
            change = change + weights[f"{name}_change"] * jnp.mean(jnp.abs(rate))
    return value, change


def foot_error(
    found: Float[Array, "*batch frames features"],
    poses: Float[Array, "*batch frames features"],
    *,
    parents: tuple[int, ...],
    feet: tuple[int, ...],
    config: Config,
) -> Float[Array, ""]:
    """How much faster or slower toes go over the ground than recorded slow ones.

    Errors of joints are in the character's axes, where a planted foot moves as fast as
    the bone: this one is in the world, where it stands. It is the mean error of a
    coordinate of the toes' velocities, meters per second, over frames in a row; toes
    that are recorded at `SLOW` or more count as without error.

    Source: own.
    """

    def velocities(x: Array) -> Array:
        toes = character_positions(x, parents)[..., jnp.array(feet), :]
        return pose.point_velocities(
            x, toes, num_joints=config.num_joints, fps=config.fps
        )

    own, recorded = velocities(found), velocities(poses)
    slow = jnp.sum(jnp.square(recorded), axis=-1, keepdims=True) < SLOW**2
    return jnp.mean(jnp.abs(own - recorded) * slow)


def loss(
    params: Params,
    key: Key,
    batch: tuple[Float[Array, "batch 2 features"], Float[Array, "batch 2 12"]],
    *,
    statistics: Statistics,
    parents: tuple[int, ...],
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The autoencoder's loss on pairs of neighboring frames; L1 means throughout.

    Source: Li et al. 2024 (AAMDM), eq. 1-4.
    """
    del key
    poses, paths = batch
    embedded = encode(params, statistics, poses, paths, config=config)
    found = decode(params, statistics, embedded, config=config)
    value, change = pose_errors(found, poses, parents=parents, config=config)
    weights = config.weights
    latent = embedded[..., PATH:]
    rate = jnp.diff(latent, axis=1) * config.fps
    regular = (
        weights.latent * jnp.mean(jnp.abs(latent))
        + weights.latent_square * jnp.mean(jnp.square(latent))
        + weights.latent_change * jnp.mean(jnp.abs(rate))
    )
    terms = {"value": value, "change": change, "latent": regular}
    return value + change + regular, terms
