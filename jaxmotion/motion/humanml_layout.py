"""Joints, chains and channels of the features of HumanML3D and KIT-ML."""

import dataclasses

import jax

from jaxmotion.motion.features import FeatureLayout, feature_layout


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Layout:
    """Joints of a data set, and how features are made of them; static under jit.

    Attributes:
      chains: Joints of each chain from its start outwards. Every joint but the root is
        in one chain after its start.
      raw_offsets: Rest direction of the bone from the parent to each joint, a unit
        vector; zero for the root.
      hips: Right and left hip.
      shoulders: Right and left shoulder.
      feet: Left ankle and foot, right ankle and foot: the joints that have contacts.
      contact_threshold: A joint stands if the square of its way to the next frame is
        less, in square units of the positions.
      hip_weight: Weight of the hips against the shoulders in the facing over the clip;
        -1 gives the vectors that were published.
    """

    chains: tuple[tuple[int, ...], ...] = jax.tree.static()
    raw_offsets: tuple[tuple[int, int, int], ...] = jax.tree.static()
    hips: tuple[int, int] = jax.tree.static()
    shoulders: tuple[int, int] = jax.tree.static()
    feet: tuple[int, int, int, int] = jax.tree.static()
    contact_threshold: float = jax.tree.static()
    hip_weight: float = jax.tree.static(default=1.0)

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.raw_offsets)

    @property
    def parents(self) -> tuple[int, ...]:
        """Parent of each joint; -1 for the root."""
        parent = {b: a for c in self.chains for a, b in zip(c[:-1], c[1:], strict=True)}
        return (-1, *(parent[joint] for joint in range(1, self.num_joints)))

    @property
    def channels(self) -> FeatureLayout:
        """Names and slices of the features."""
        return feature_layout(
            root_yaw_velocity=1,
            root_velocity=2,
            root_height=1,
            joint_position=3 * (self.num_joints - 1),
            joint_rotation=6 * (self.num_joints - 1),
            joint_velocity=3 * self.num_joints,
            contact=len(self.feet),
        )

    @property
    def num_features(self) -> int:
        """Length of a feature vector."""
        return self.channels.size


_X, _Y, _Z, _ROOT = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)
_RIGHT, _DOWN = (-1, 0, 0), (0, -1, 0)  # +x is to the left of who faces +z

# 22 joints of SMPL, 20 frames per second, meters.
HUMANML3D = Layout(
    chains=(
        (0, 2, 5, 8, 11),
        (0, 1, 4, 7, 10),
        (0, 3, 6, 9, 12, 15),
        (9, 14, 17, 19, 21),
        (9, 13, 16, 18, 20),
    ),
    raw_offsets=(
        *(_ROOT, _X, _RIGHT, _Y, _DOWN, _DOWN, _Y, _DOWN, _DOWN, _Y, _Z, _Z),
        *(_Y, _X, _RIGHT, _Z, *(6 * (_DOWN,))),
    ),
    hips=(2, 1),
    shoulders=(17, 16),
    feet=(7, 10, 8, 11),
    contact_threshold=0.002,
)

# 21 joints, 12.5 frames per second; the published data are in millimeters of the model.
# Their rest directions put right hip and shoulder at +x, opposite to where they are.
KIT_ML = Layout(
    chains=(
        (0, 11, 12, 13, 14, 15),
        (0, 16, 17, 18, 19, 20),
        (0, 1, 2, 3, 4),
        (3, 5, 6, 7),
        (3, 8, 9, 10),
    ),
    raw_offsets=(
        *(_ROOT, *(4 * (_Y,)), _X, _DOWN, _DOWN, _RIGHT, _DOWN, _DOWN),
        *(_X, _DOWN, _DOWN, _Z, _Z, _RIGHT, _DOWN, _DOWN, _Z, _Z),
    ),
    hips=(11, 16),
    shoulders=(5, 8),
    feet=(19, 20, 14, 15),
    contact_threshold=0.05,
)
