"""The metrics of steered locomotion, window by window.

Real clips and rollouts go through the same function in windows of the same length, so
that their rows compare. A real clip has no user; what it "should" do is its own path,
smoothed, which is also what the network is trained to follow: the errors of the
ground-truth row are therefore those of a walker's natural sway.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.evaluation import alignment, contact, smoothness
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.motion.spring import Scalar


def locomotion_metrics(
    skeleton: Skeleton,
    motion: Motion,
    wanted_velocity: Float[Array, "windows frames 2"],
    wanted_facing: Float[Array, "windows frames 2"],
    *,
    contact_height: Scalar,
) -> dict[str, Float[Array, " windows"]]:
    """Metrics of windows [windows, frames, ...], world.

    Velocities are in meters per second; a foot joint (the skeleton's feet) below the
    contact height, meters, should not move. Given are trajectory_error and
    orientation_error in radians; slide_speed in m/s over slide_seconds of low feet;
    skate_ratio; acceleration, m/s^2; jerk, m/s^3.
    """
    fps = motion.fps
    positions = joint_positions(skeleton, motion)
    feet = positions[..., jnp.array(skeleton.feet), :]
    path = positions[..., 0, ::2]
    facing = trajectory.root_trajectory(skeleton, motion).facing
    slide = contact.slide_distance(feet, fps, max_height=contact_height)
    direction = alignment.trajectory_error(wanted_velocity, path, fps)
    return {
        "trajectory_error": direction.error,
        "trajectory_used": direction.used,
        "orientation_error": alignment.orientation_error(wanted_facing, facing),
        "slide_speed": slide.speed,
        "slide_seconds": slide.seconds,
        "skate_ratio": contact.skate_ratio(feet, fps, max_height=contact_height),
        "acceleration": smoothness.acceleration(positions, fps),
        "jerk": smoothness.jerk(positions, fps),
    }
