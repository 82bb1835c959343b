"""What a motion loses on another body, and what bringing it there costs.

The shipped model stands, walks, runs, crouches and turns; each second is brought onto
other bodies and, for the round trip, back. Bodies are the model's own skeleton with
legs, arms and trunk of other lengths, one of them as a file with Mixamo's names, or
rigs' files. `experiments/report.py --keep` stores the reports.

Example:
  python benchmarks/retarget.py
  python benchmarks/retarget.py --rig hero.glb avatar.vrm
  python benchmarks/retarget.py --robot g1.xml
"""

import dataclasses
import tempfile
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
# Titles and units, by column.
COLUMNS = {
    "source_slide": ("source's slide, scaled", "m/s"),
    "slide": ("slide", "m/s"),
    "penetration": ("toes under", "mm"),
    "angle": ("angles", "degrees"),
    "root": ("root's path", "mm"),
    "jerk_ratio": ("jerk", "ratio"),
    "round": ("round trip", "mm"),
    "round_95": ("95 % below", "mm"),
}
ROBOT = {
    "at_limit": ("frames at a limit", "%"),
    "velocity": ("fastest joint", "rad/s"),
    "slide": ("slide", "mm/s"),
    "under": ("soles under", "mm"),
    "miss": ("planted feet off", "mm"),
    "replayed": ("replayed, off", "μm"),
    "sinks": ("touches the ground under", "mm"),
    "touches": ("touches itself under", "mm"),
}
LONG = "figure eight, 60 s"
COST = {
    "alone": ("alone", "ms"),
    "rate": ("alone", "frames/s"),
    "tick": ("a tick", "ms"),
    "with_rig": ("with the rig", "ms"),
    "share": ("rig's part of a tick", "%"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Slide, penetration, angles, paths, jerk and round trips; costs per tick.

    Attributes:
      rig: Files of rigs to be measured instead of the bodies.
      robot: MJCF or URDF of a humanoid to be measured instead.
      seconds: Length of each course.
      characters: Numbers of characters to time.
      repeats: Calls to time; the median counts.
    """

    rig: tuple[Path, ...] = ()
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


SIDES = ("left", "right")


def balls(
    one: transfer.Rest, places: np.ndarray, turned: np.ndarray, like: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the balls of the feet are [F, 2, 3], and heights over the ground at rest.

    Args:
      turned: Turns of the joints from rest.
      like: [2, 3] from the ankles, of feet that have no toes.
    """
    feet = [one.joint(side + "Foot") for side in SIDES]
    toes = [one.joint(side + "Toes") for side in SIDES]
    if None not in toes:
        return places[:, toes], one.places[toes, 1] - one.sole
    there = places[:, feet] + np.einsum("fsij,sj->fsi", turned[:, feet], like)
    return there, one.places[feet, 1] + like[:, 1] - one.sole


def slide(feet: np.ndarray, planted: np.ndarray, fps: float) -> float:
    """Mean speed of planted feet over the ground, m/s."""
    moved = np.linalg.norm(np.diff(feet[..., ::2], axis=0), axis=-1)
    return float((moved * planted).sum() / max(planted.sum(), 1) * fps)


def jerk(positions: np.ndarray) -> float:
    """Mean third difference."""
    return float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1).mean())


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between rotations."""
    trace = np.einsum("...ij,...ij->...", a, b)
    return np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def measure(function: transfer.Retarget, motion: Motion) -> dict[str, float]:
    """What is lost on the way there, and back."""
    source, target = function.source, function.target
    made = function(motion)
    both = [role for role in source.roles if role in target.roles]
    places, turned, roles, hips = [], [], [], []
    for one, moved in ((source, motion), (target, made)):
        there, turns = anatomy.kinematics(one.skeleton, moved)
        places.append(np.asarray(there))
        turned.append(np.asarray(turns) @ np.swapaxes(one.turns, -1, -2))
        roles.append([one.joint(role) for role in both])
        legs = [one.joint(side + "UpperLeg") for side in SIDES]
        hips.append(places[-1][:, legs].mean(axis=1)[:, ::2])
    back = transfer.Retarget(target, source)(made)
    away = np.asarray(joint_positions(source.skeleton, back)) - places[0]
    away = np.linalg.norm(away, axis=-1)
    toes, ankles = (
        [source.joint(side + part) for side in SIDES] for part in ("Toes", "Foot")
    )
    like = function.scale * (source.places[toes] - source.places[ankles])
    (before, low), (after, height) = (
        balls(one, there, turns, like)
        for one, there, turns in zip((source, target), places, turned, strict=True)
    )
    planted = before[1:, :, 1] < low + LOW
    angle = degrees(*(x[:, j] for x, j in zip(turned, roles, strict=True)))
    jerks = [jerk(x[:, j]) for x, j in zip(places, roles, strict=True)]
    return {
        "source_slide": function.scale * slide(before, planted, motion.fps),
        "slide": slide(after, planted, motion.fps),
        "penetration": 1e3 * float(np.maximum(height - after[..., 1], 0.0).max()),
        "angle": float(angle.mean()),
        "root": 1e3 * float(np.abs(hips[1] - function.scale * hips[0]).max()),
        "jerk_ratio": jerks[1] / (function.scale * jerks[0]),
        "round": 1e3 * float(away.mean()),
        "round_95": 1e3 * float(np.percentile(away, 95)),
    }


def cost(
    function: transfer.Retarget, model: Character, motion: Motion, args: Config
) -> dict[str, dict[str, float]]:
    """Milliseconds of a tick of many characters, compiled."""
    rows = {}
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
        name = f"{number:,} character" + "s" * (number > 1)
        rows[name] = {"alone": 1e3 * seconds, "rate": number / seconds}
        rows[name] |= share(function, model, number, args.repeats)
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
        "share": 100.0 * (float(np.median(ticks[:, 1] / ticks[:, 0])) - 1.0),
    }


def measure_robot(args: Config, model: Character, motions: dict[str, Motion]) -> None:
    """What a robot cannot do of each course, in a report."""
    robot = robots.read_robot(args.robot)
    rows = {}
    for course, motion in motions.items():
        moved = robot_motion.follow(robot, model.skeleton, motion)
        found = moved.report()
        rows[course] = {
            "at_limit": 100.0 * found["at_limit"],
            "velocity": found["fastest_velocity"],
            **{name: 1e3 * found[name] for name in ("slide", "under", "miss")},
            **replay(args.robot, moved.to_arrays()),
        }
        print(f"{course}: fastest is {found['fastest']}")
    report("robot", rows, ROBOT, args)


def replay(path: Path, content: dict[str, np.ndarray]) -> dict[str, float]:
    """Where MuJoCo has the bodies of a motion's file, and how deep what touches is."""
    mujoco, _ = robots.packages()
    spec = mujoco.MjSpec.from_file(str(path))
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="the ground", type=plane, size=[0, 0, 1])
    model = spec.compile()
    data, ground = mujoco.MjData(model), model.geom("the ground").id
    away, deepest = 0.0, {True: 0.0, False: 0.0}
    for frame, root in enumerate(content["body_pos_w"][:, 0]):
        data.qpos[:7] = [*root, *content["body_quat_w"][frame, 0]]
        for name, value in zip(
            content["joint_names"], content["joint_pos"][frame], strict=True
        ):
            data.joint(str(name)).qpos = value
        mujoco.mj_forward(model, data)
        places = [data.body(str(name)).xpos for name in content["body_names"]]
        away = max(away, float(np.abs(places - content["body_pos_w"][frame]).max()))
        for contact in data.contact:
            on_ground = ground in (contact.geom1, contact.geom2)
            deepest[on_ground] = max(deepest[on_ground], -contact.dist)
    return {
        "replayed": 1e6 * away,
        "sinks": 1e3 * deepest[True],
        "touches": 1e3 * deepest[False],
    }


def report(
    name: str,
    rows: dict[str, dict[str, float]],
    columns: dict[str, tuple[str, str]],
    args: Config,
) -> None:
    """Prints a table and writes its report."""
    titles = {"row": ""} | {key: f"{a} {b}" for key, (a, b) in columns.items()}
    suite.print_table([{"row": row, **rows[row]} for row in rows], titles)
    metrics = [
        suite.Metric(
            f"{row} {key}",
            rows[row][key],
            unit,
            "higher" if key == "rate" else "lower",
            0.6 if columns is COST else 0.3,
        )
        for row in rows
        for key, (_, unit) in columns.items()
    ]
    suite.report(name, metrics, args, rows=rows)


def functions(args: Config, model: Character) -> dict[str, transfer.Retarget]:
    """Onto each body: the rigs that are asked for, or the bodies."""
    rigs: dict[str, Path | Skeleton] = {path.name: path for path in args.rig}
    if rigs:
        return {name: jm.retarget(model.skeleton, rig) for name, rig in rigs.items()}
    rigs = {name: proportioned(model.skeleton, *size) for name, size in BODIES.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "child.glb"
        child = rigs["child"]
        assert isinstance(child, Skeleton)
        columns = jnp.tile(jnp.eye(3)[:2].reshape(6), (1, child.num_joints, 1))
        still = Motion(
            root_position=jnp.zeros((1, 3)), joint_rotation=columns, fps=model.fps
        )
        jm.save(path, child, still, mixamo=True)
        rigs["Mixamo's names, a file"] = path
        return {name: jm.retarget(model.skeleton, rig) for name, rig in rigs.items()}


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
        long = jm.commands("figure_eight", model, 1, seconds=60.0, speed=1.2)
        frames = jm.rollout(model, jax.random.key(0), model.start(1), long)
        return measure_robot(args, model, motions | {LONG: frames[0].motion})
    found = functions(args, model)
    rows = {
        f"{name}, {course}": measure(function, motion)
        for name, function in found.items()
        for course, motion in motions.items()
    }
    report("rigs" if args.rig else "retarget", rows, COLUMNS, args)
    if args.characters:
        first = next(iter(found.values()))
        costs = cost(first, model, motions["turn"], args)
        report("retarget_cost", costs, COST, args)


if __name__ == "__main__":
    cli.start(main)
