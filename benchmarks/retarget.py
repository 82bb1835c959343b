"""What a motion loses on another body, and what bringing it there costs.

The shipped model stands, walks, runs, crouches and turns; each second is brought onto
other bodies and, for the round trip, back. Bodies are the model's own skeleton with
legs, arms and trunk of other lengths, or a rig's file.

Example:
  python benchmarks/retarget.py
  python benchmarks/retarget.py --rig hero.glb
  python benchmarks/retarget.py --robot g1.xml
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import suite

import jaxmotion as jm
from jaxmotion import cli
from jaxmotion.control import rollout
from jaxmotion.control.steering import Character
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.retarget import robot as robots
from jaxmotion.retarget import robot_motion, transfer

# Seconds, direction of travel and facing (degrees from +z toward +x), m/s, style.
COURSES = {
    "stand": ((1.0, 0, 0, 0.0, "neutral"),),
    "1.4 m/s": ((1.0, 0, 0, 1.4, "neutral"),),
    "3.5 m/s": ((1.0, 0, 0, 3.5, "neutral"),),
    "crouch": ((1.0, 0, 0, 0.9, "crouch"),),
    "turn": tuple((1.0, angle, angle, 1.4, "neutral") for angle in (0, 90, 180, 270)),
}
# Lengths of legs, arms and trunk.
BODIES = {
    "same": (1.0, 1.0, 1.0),
    "child": (0.62, 0.6, 0.72),
    "giant": (1.5, 1.45, 1.5),
    "long arms": (0.9, 1.5, 1.05),
}
LOW = 0.01  # over its lowest in standing: a toe that is planted, meters
COLUMNS = {
    "body": "body",
    "course": "course",
    "slide_source": "source's slide, scaled",
    "slide": "slide m/s",
    "under": "toes under m",
    "angle": "angles degrees",
    "path": "root path m",
    "jerk": "jerk ratio",
    "trip": "round trip m",
    "trip_95": "95 % below m",
}
ROBOT = {
    "course": "course",
    "at_limit": "frames at a limit",
    "fastest": "fastest joint",
    "fastest_velocity": "rad/s",
    "slide": "slide m/s",
    "under": "soles under m",
    "miss": "planted feet off m",
    "seconds": "s to solve",
}
COST = {
    "characters": "characters",
    "milliseconds": "ms alone",
    "rate": "frames/s",
    "tick": "a tick, ms",
    "with_rig": "with the rig, ms",
    "share": "rig's part of a tick",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Slide, penetration, angles, paths, jerk and round trips; costs per tick.

    Attributes:
      rig: A rig's file to be measured instead of the bodies.
      robot: MJCF or URDF of a humanoid to be measured instead.
      seconds: Length of each course.
      characters: Numbers of characters to time.
      repeats: Calls to time; the median counts.
    """

    rig: Path | None = None
    robot: Path | None = None
    seconds: float = 6.0
    characters: tuple[int, ...] = (1, 64, 1024)
    repeats: int = 200


def proportioned(
    skeleton: Skeleton, legs: float, arms: float, trunk: float
) -> Skeleton:
    """A skeleton with limbs of other lengths."""
    found = anatomy.find_anatomy(skeleton)
    scale = np.full(skeleton.num_joints, trunk)
    for limbs, size in ((found.legs, legs), (found.arms, arms)):
        for limb in limbs:
            for joint in range(skeleton.num_joints):
                if limb.upper in anatomy.chain(skeleton.parents, joint)[:-1]:
                    scale[joint] = size
    offsets = np.asarray(skeleton.offsets) * scale[:, None]
    return dataclasses.replace(skeleton, offsets=jnp.asarray(offsets, jnp.float32))


def slide(positions: np.ndarray, feet: list[int], planted: np.ndarray, fps: float):
    """Mean speed of planted feet over the ground, m/s."""
    moved = np.linalg.norm(np.diff(positions[:, feet][..., ::2], axis=0), axis=-1)
    return float((moved * planted).sum() / max(planted.sum(), 1) * fps)


def jerk(positions: np.ndarray) -> float:
    """Mean third difference of all joints."""
    return float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1).mean())


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between rotations."""
    trace = np.einsum("...ij,...ij->...", a, b)
    return np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def measure(function: transfer.Retarget, motion: Motion) -> dict[str, float]:
    """What is lost on the way there, and back."""
    source, target = function.source, function.target
    made = function(motion)
    before = np.asarray(joint_positions(source.skeleton, motion))
    after = np.asarray(joint_positions(target.skeleton, made))
    back = transfer.Retarget(target, source)(made)
    away = np.asarray(joint_positions(source.skeleton, back)) - before
    away = np.linalg.norm(away, axis=-1)
    toes = [
        [
            one.joint(side + "Toes") or one.joint(side + "Foot")
            for side in ("left", "right")
        ]
        for one in (source, target)
    ]
    height = [
        one.places[feet, 1] - one.sole
        for one, feet in zip((source, target), toes, strict=True)
    ]
    planted = before[1:, toes[0], 1] < height[0] + LOW
    worlds = [
        anatomy.kinematics(one.skeleton, moved)[1] @ np.swapaxes(one.turns, -1, -2)
        for one, moved in ((source, motion), (target, made))
    ]
    both = [r for r in source.roles if r in target.roles]
    angle = degrees(
        *(
            world[:, [one.joint(role) for role in both]]
            for world, one in zip(worlds, (source, target), strict=True)
        )
    )
    hips = [
        p[:, one.joint("hips"), ::2] for p, one in ((before, source), (after, target))
    ]
    return {
        "slide_source": function.scale * slide(before, toes[0], planted, motion.fps),
        "slide": slide(after, toes[1], planted, motion.fps),
        "under": float(np.maximum(height[1] - after[:, toes[1], 1], 0.0).max()),
        "angle": float(angle.mean()),
        "path": float(np.abs(hips[1] - function.scale * hips[0]).max()),
        "jerk": jerk(after) / (function.scale * jerk(before)),
        "trip": float(away.mean()),
        "trip_95": float(np.percentile(away, 95)),
    }


def cost(function: transfer.Retarget, motion: Motion, args: Config) -> list[dict]:
    """Milliseconds of a tick of many characters, compiled."""
    rows = []
    for number in args.characters:
        poses = [
            jnp.resize(x, (number, *x.shape[1:]))
            for x in (motion.root_position, motion.joint_rotation)
        ]
        jax.block_until_ready(function.pose(*poses))
        times = []
        for _ in range(args.repeats):
            start = time.perf_counter()
            jax.block_until_ready(function.pose(*poses))
            times.append(time.perf_counter() - start)
        seconds = float(np.median(times))
        rows.append(
            {
                "characters": number,
                "milliseconds": 1e3 * seconds,
                "rate": number / seconds,
            }
        )
    return rows


def share(
    function: transfer.Retarget, model: Character, number: int, repeats: int
) -> dict[str, float]:
    """What a rig adds to a tick that it is compiled with, beside one without.

    Both get the same states, by turns; medians, and the median of ratios.
    """
    patience = 1 if model.tuning is None else max(model.tuning.patience, 1)
    at_most = -(-number // patience)

    def tick(params, key, crowd, commands) -> tuple:
        controller = model.method(params)
        crowd, frames = rollout.crowd_tick(
            controller, key, crowd, commands, at_most=at_most
        )
        return crowd, (frames.root_position, frames.joint_rotation)

    def with_rig(*given) -> tuple:
        crowd, pose = tick(*given)
        return crowd, function.pose(*pose)

    plain, worn = jax.jit(tick), jax.jit(with_rig)
    commands = jm.commands("straight", model, number, seconds=1.0)
    command = jax.tree.map(lambda x: x[:, 0], commands)
    crowd = rollout.Crowd(
        states=model.start(number), told=command, waited=jnp.zeros(number, jnp.int32)
    )
    times = []
    for n in range(-10, repeats):
        given = (model.params, jax.random.key(n + 10), crowd, command)
        took = {}
        for one in (plain, worn) if n % 2 else (worn, plain):
            start = time.perf_counter()
            after, _ = jax.block_until_ready(one(*given))
            took[one] = time.perf_counter() - start
        crowd = after
        if n >= 0:
            times.append((took[plain], took[worn]))
    ticks = np.array(times)
    return {
        "tick": 1e3 * float(np.median(ticks[:, 0])),
        "with_rig": 1e3 * float(np.median(ticks[:, 1])),
        "share": float(np.median(ticks[:, 1] / ticks[:, 0])) - 1.0,
    }


def measure_robot(args: Config, model: Character, motions: dict[str, Motion]) -> None:
    """What a robot cannot do of each course, in a report."""
    robot = robots.read_robot(args.robot)
    rows = []
    for course, motion in motions.items():
        start = time.perf_counter()
        found = robot_motion.follow(robot, model.skeleton, motion).report()
        seconds = time.perf_counter() - start
        rows.append({"course": course, **found, "seconds": seconds})
    suite.print_table(rows, ROBOT)
    metrics = [
        suite.Metric(f"{row['course']}: at a limit", row["at_limit"], "of frames")
        for row in rows
    ]
    suite.report("robot", metrics, args, rows=rows)


def moving(model: Character, args: Config) -> dict[str, Motion]:
    """The model on each course."""
    found = {}
    for course, segments in COURSES.items():
        commands = jm.commands(segments, model, 1, seconds=args.seconds)
        states = model.start(1, labels=segments[0][-1])
        frames = jm.rollout(model, jax.random.key(0), states, commands)
        found[course] = frames[0].motion
    return found


def main() -> None:
    """Measures and writes the report."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, repeats=1)
    model = jm.load("locomotion")
    motions = moving(model, args)
    if args.robot is not None:
        return measure_robot(args, model, motions)
    bodies = {
        name: proportioned(model.skeleton, *sizes) for name, sizes in BODIES.items()
    }
    if args.rig is not None:
        bodies = {args.rig.name: args.rig}
    functions = {
        name: jm.retarget(model.skeleton, body) for name, body in bodies.items()
    }
    rows = []
    for course, motion in motions.items():
        for name, function in functions.items():
            rows.append({"body": name, "course": course, **measure(function, motion)})
    rows.sort(key=lambda row: list(bodies).index(row["body"]))
    suite.print_table(rows, COLUMNS)
    first = next(iter(functions.values()))
    costs = cost(first, motion, args)
    for row in costs:
        row |= share(first, model, row["characters"], args.repeats)
    suite.print_table(costs, COST)
    metrics = [
        suite.Metric(f"{row['body']}, {row['course']}: slide", row["slide"], "m/s")
        for row in rows
    ]
    for row in costs:
        name = f"{row['characters']} characters"
        metrics.append(suite.Metric(f"{name}: share", row["share"], "of a tick"))
        metrics.append(suite.Metric(name, row["milliseconds"], "ms", tolerance=0.6))
    suite.report("retarget", metrics, args, rows=rows, costs=costs)


if __name__ == "__main__":
    cli.start(main)
