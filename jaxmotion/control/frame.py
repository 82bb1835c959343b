"""What a controller displays in one tick: one class for all systems."""

import dataclasses

import jax
from jaxtyping import Array, Bool, Float

from jaxmotion.motion.skeleton import Motion


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A displayed pose; with leading axes [characters, ticks] a whole rollout.

    Attributes:
      root_position: World, meters.
      joint_rotation: Parent-local, two columns; the root's is global.
      desired_velocity: What was asked for at this tick (after the springs, in systems
        that have them), meters per second.
      desired_facing: What was asked for, unit.
      planned: Whether this tick made a new plan.
      extra: What only one system displays, by name; see its `controller` module.
    """

    root_position: Float[Array, "*batch 3"]
    joint_rotation: Float[Array, "*batch joints 6"]
    desired_velocity: Float[Array, "*batch 2"]
    desired_facing: Float[Array, "*batch 2"]
    planned: Bool[Array, "*batch"]
    extra: dict[str, Array] = dataclasses.field(default_factory=dict)
    fps: float = jax.tree.static()

    # Frames are indexed, never looped over: `jnp.stack(frame)` should raise.
    __iter__ = None

    def __getitem__(self, index: int | slice | Array | tuple) -> "Frame":
        """The frames at an index of the leading axes, such as `frames[0]`."""
        return jax.tree.map(lambda x: x[index], self)

    @property
    def motion(self) -> Motion:
        """The displayed motion of a rollout, whose last leading axis is time."""
        return Motion(
            root_position=self.root_position,
            joint_rotation=self.joint_rotation,
            fps=self.fps,
        )


def as_displayed(past: Motion, frame: Frame) -> Motion:
    """The last poses, of which the very last is that of a frame."""
    return dataclasses.replace(
        past,
        root_position=past.root_position.at[-1].set(frame.root_position),
        joint_rotation=past.joint_rotation.at[-1].set(frame.joint_rotation),
    )
