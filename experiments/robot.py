"""A character's motion on a humanoid robot, as a file that policies learn from.

Writes to a folder: motion.npz, which mjlab's motion tracking reads (50 frames per
second), and motion.gif. Prints what the robot cannot do: how often joints are at their
limits, how fast they are, and how feet slide.

Examples:
  python experiments/robot.py --robot g1.xml
  python experiments/robot.py --robot g1.xml --course straight --speed 3.5 --seconds 6
"""

import ctypes.util
import dataclasses
import os
import sys
from pathlib import Path

import jax
import tyro

import jaxmotion as jm
from jaxmotion import cli, files
from jaxmotion.control.steering import steered
from jaxmotion.learning import loop
from jaxmotion.retarget import robot as robots
from jaxmotion.retarget import robot_motion


@dataclasses.dataclass(frozen=True)
class Config:
    """The command line.

    Attributes:
      robot: MJCF, or URDF, of a humanoid with a free joint.
      model: Shipped model, or run folder of a system whose characters are steered.
      out: Folder to write to.
      course: What it does, such as figure_eight, straight, stand, turn_on_the_spot.
      speed: m/s of the person; a smaller robot's is less.
      label: Style; None for the first.
      seconds: Length.
      fps: Frames per second of the file.
      roles: JSON file of bodies by role, where names and shape say too little.
      gif: Draw motion.gif, of the first ten seconds.
      seed: Seeds the noise.
    """

    robot: Path
    model: str = "locomotion"
    out: Path = Path("runs/robot")
    course: str = "figure_eight"
    speed: float = 1.2
    label: cli.Optional[str] = None
    seconds: float = 10.0
    fps: float = 50.0
    roles: cli.Optional[Path] = None
    gif: bool = True
    seed: int = 0


def choose_opengl() -> None:
    """Without a display MuJoCo draws by EGL, where that is installed."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        found = "egl" if ctypes.util.find_library("EGL") else "disable"
        os.environ.setdefault("MUJOCO_GL", found)


def draw(path: Path, motion: robot_motion.RobotMotion) -> None:
    """A moving picture by MuJoCo, or of capsules where it cannot draw."""
    from jaxmotion.viz import animation, capsules, stage

    motion = dataclasses.replace(motion, qpos=motion.qpos[: round(10 * motion.fps)])
    every = max(round(motion.fps / 20), 1)
    try:
        pictures = robot_motion.render(motion, every=every)
        animation.save_pictures(path, pictures, fps=motion.fps / every)
    except RuntimeError as error:
        print(f"{error}: capsules instead")
        skeleton, moved = motion.as_skeleton()
        body = capsules.describe(skeleton, *robots.capsules(motion.robot))
        shown = stage.make_stage(skeleton, moved, body=body)
        animation.save_gif(path, shown, every=every)
    print(path)


def describe(found: dict) -> str:
    """A report in words."""
    limited = sorted(found["limited"].items(), key=lambda item: -item[1])[:4]
    often = ", ".join(f"{name} {100 * share:.0f} %" for name, share in limited)
    limit = found["fastest_limit"]
    allowed = "no limit in the file" if limit is None else f"allowed {limit:.1f}"
    return "\n".join(
        [
            f"{found['frames']} frames at {found['fps']:g} per second",
            f"at a limit: {100 * found['at_limit']:.1f} % of frames"
            + (f" ({often})" if often else ""),
            f"fastest: {found['fastest']} {found['fastest_velocity']:.1f} per second "
            f"({allowed}; {100 * found['over']:.1f} % of frames over it)",
            f"planted feet: slide {1000 * found['slide']:.1f} mm/s, at most "
            f"{1000 * found['under']:.1f} mm below the ground, at most "
            f"{1000 * found['miss']:.1f} mm from where they should be",
        ]
    )


def write(args: Config) -> None:
    """Rolls out, brings onto the robot, and writes.

    Raises:
      ModuleNotFoundError: without the extra [robot].
      OSError: if a file cannot be read or written.
      ValueError: if an option is wrong or the robot no humanoid; names it.
    """
    cli.check(args)
    choose_opengl()
    robot = robots.read_robot(args.robot, args.roles)
    loop.check_writable(args.out)
    model = steered(jm.load(args.model), what=args.model)
    course = dict(seconds=args.seconds, speed=args.speed, labels=args.label)
    commands = jm.commands(args.course, model, 1, **course)
    states = model.start(1, labels=args.label)
    frames = jm.rollout(model, jax.random.key(args.seed), states, commands)
    motion = robot_motion.follow(robot, model.skeleton, frames[0].motion, fps=args.fps)
    files.write_arrays(args.out / "motion.npz", motion.to_arrays())
    print(describe(motion.report()))
    print(args.out / "motion.npz")
    if args.gif:
        draw(args.out / "motion.gif", motion)


def main() -> None:
    """Parses the command line and writes the files."""
    write(tyro.cli(Config, description=__doc__))


if __name__ == "__main__":
    cli.start(main)
