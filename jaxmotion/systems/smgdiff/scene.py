"""A person and a ball as SMGDiff's features, and back.

A frame is the body (root 3, one 6D rotation a joint), the ball (place relative to the
root 3, velocity 3, control weight 1) and the contacts (feet on the ground, joints at
the ball), seen from the last displayed pose. Features are standardized, each kind with
one deviation: the paper does not say, and places, rotations and a ball's velocity
differ by a factor of twenty.

Source: SMGDiff, section 3.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import ball, contact, features, rotation
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.motion.trajectory import PlanarFrame, root_trajectory

# Channels that vary alike: x and z of a place or a velocity, of any direction, more
# than heights.
_ROOT = (slice(0, 3, 2), slice(1, 2))
_BALL = (*_ROOT, slice(3, 6, 2), slice(4, 5), slice(6, 7))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Representation:
    """What turns scenes of one skeleton into features and back.

    Attributes:
      skeleton: The skeleton; its feet are what stands on the ground.
      joints: Joints that may touch the ball.
      radius: Radius of the ball, meters.
      reach: Distance at which the ball fades out of the features, meters (paper 2).
      contact_speed: A foot slower than this stands, meters per second.
    """

    skeleton: Skeleton
    normalizer: features.Normalizer
    joints: tuple[int, ...] = jax.tree.static()
    fps: float = jax.tree.static()
    radius: float = jax.tree.static(default=0.11)
    reach: float = jax.tree.static(default=2.0)
    contact_speed: float = jax.tree.static(default=0.3)


def feature_layout(
    skeleton: Skeleton, joints: tuple[int, ...]
) -> features.FeatureLayout:
    """The slices root, rotations, ball, ground and touch of a frame.

    They have 147 + 7 + 8 numbers for SMPL with four feet; `joints` may touch the ball.

    Source: SMGDiff, section 3.
    """
    return features.feature_layout(
        root=3,
        rotations=6 * skeleton.num_joints,
        ball=ball.NUM_FEATURES,
        ground=len(skeleton.feet),
        touch=len(joints),
    )


def _raw(scene: Scene, representation: Representation) -> Array:
    """Features before they are standardized."""
    skeleton, motion = representation.skeleton, scene.motion
    feet = joint_positions(skeleton, motion)[..., jnp.array(skeleton.feet), :]
    stands = contact.foot_contacts(
        feet, motion.fps, max_speed=representation.contact_speed
    )
    velocity = ball.ball_velocities(scene.ball, motion.fps)
    parts = {
        "root": motion.root_position,
        "rotations": motion.joint_rotation.reshape(
            *motion.root_position.shape[:-1], -1
        ),
        "ball": ball.encode_ball(
            scene.ball, velocity, motion.root_position, reach=representation.reach
        ),
        "ground": stands.astype(scene.ball.dtype),
        "touch": scene.touch,
    }
    return features.pack(feature_layout(skeleton, representation.joints), parts)


def fit(
    skeleton: Skeleton,
    scenes: Scene,
    *,
    joints: tuple[int, ...],
    radius: float,
    floor: float = 0.05,
) -> Representation:
    """Mean of each feature, and one deviation for those of a kind.

    Scenes are windows of the training data, batch first, seen from `plan_frame`; joints
    may touch the ball, whose radius is in meters. The least deviation is in features'
    units.
    """
    size = feature_layout(skeleton, joints).size
    unit = features.Normalizer(mean=jnp.zeros(size), std=jnp.ones(size))
    plain = Representation(
        skeleton=skeleton,
        normalizer=unit,
        joints=joints,
        fps=scenes.motion.fps,
        radius=radius,
    )
    found = features.fit_normalizer(_raw(scenes, plain), floor=0.0)
    std = features.unpack(feature_layout(skeleton, joints), found.std)
    groups = {name: (slice(0, part.size),) for name, part in std.items()}
    groups |= {"root": _ROOT, "ball": _BALL}
    for name, slices in groups.items():
        for where in slices:
            value = jnp.maximum(jnp.mean(std[name][where]), floor)
            std[name] = std[name].at[where].set(value)
    return dataclasses.replace(
        plain,
        normalizer=features.Normalizer(
            mean=found.mean, std=features.pack(feature_layout(skeleton, joints), std)
        ),
    )


def plan_frame(skeleton: Skeleton, past: Motion) -> PlanarFrame:
    """Frame of the next plan: at the last displayed pose (world), +z where it faces."""
    last = jax.tree.map(lambda x: x[-1:], past)
    here = root_trajectory(skeleton, last)
    return PlanarFrame(origin=here.position[0], facing=here.facing[0])


def to_frame(scene: Scene, frame: PlanarFrame) -> Scene:
    """A world scene seen from a ground frame, one for the whole scene."""
    return _move(scene, features.to_frame(scene.motion, frame), frame, out=False)


def from_frame(scene: Scene, frame: PlanarFrame) -> Scene:
    """Inverse of `to_frame`: the scene in the world."""
    return _move(scene, features.from_frame(scene.motion, frame), frame, out=True)


def _move(scene: Scene, motion: Motion, frame: PlanarFrame, *, out: bool) -> Scene:
    return dataclasses.replace(
        scene, motion=motion, ball=ball.move_points(scene.ball, frame, out=out)
    )


def to_features(
    scene: Scene, representation: Representation
) -> Float[Array, "*batch frames features"]:
    """Features, in the network's units, of a scene in the frame of a plan.

    Contacts with the ground and the ball's velocity come from the (at least two) frames
    that are given, so the first and the last differ from those of a longer scene.
    """
    return features.normalize(representation.normalizer, _raw(scene, representation))


def _parts(x: Array, representation: Representation) -> dict[str, Array]:
    names = feature_layout(representation.skeleton, representation.joints)
    return features.unpack(names, features.denormalize(representation.normalizer, x))


def to_motion(
    x: Float[Array, "*batch frames features"], representation: Representation
) -> Motion:
    """The person of some features, in the frame of the plan.

    Rotations are made orthonormal, so features may come from a network.
    """
    parts = _parts(x, representation)
    rot6d = parts["rotations"].reshape(*x.shape[:-1], -1, 6)
    return Motion(
        root_position=parts["root"],
        joint_rotation=rotation.rot6d_from_matrix(rotation.matrix_from_rot6d(rot6d)),
        fps=representation.fps,
    )


def to_scene(
    x: Float[Array, "*batch frames features"],
    start: Float[Array, "*batch 3"],
    representation: Representation,
) -> tuple[Scene, Float[Array, "*batch frames feet"]]:
    """Inverse of `to_features`, in the frame of the plan, and which feet stand.

    Both kinds of contact lie in 0..1. Features may come from a network; `start` is
    where the ball was in the frame before the first, meters.
    """
    parts = _parts(x, representation)
    place = ball.decode_ball(parts["ball"], parts["root"], start, representation.fps)
    touch, stands = (jnp.clip(parts[name], 0.0, 1.0) for name in ("touch", "ground"))
    motion = to_motion(x, representation)
    return Scene(motion=motion, ball=place, touch=touch), stands
