"""The library in a few lines: load, start, command, roll out, sample, save, show.

    model = jm.load("locomotion")
    states = model.start(256)
    commands = jm.commands("figure_eight", model, 256, seconds=10.0, speed=1.4)
    frames = jm.rollout(model, jax.random.key(0), states, commands)
    jm.save("walk.gif", model.skeleton, frames[0])
    path = jm.path([(0, 0), (0, 4), (3, 4)], speed=1.4)
    frames = jm.rollout(model, jax.random.key(0), states, goal=path)

    model = jm.load("actions")
    motions = jm.sample(model, jax.random.key(0), "jump", 256)
    jm.save("jump.gif", model.skeleton, motions[0])

Only composes what stands below it, and checks what it is given with one clear line.
What is slow to import (Flax, Orbax, matplotlib) is imported by those who need it.
"""

import dataclasses
import html as escaping
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxmotion import files
from jaxmotion.control import courses, goals, sampling, steering
from jaxmotion.control.foot_lock import FootLock, clean_sampler, lock_feet
from jaxmotion.control.frame import Frame
from jaxmotion.control.sampling import Sampler
from jaxmotion.control.steering import Character
from jaxmotion.motion import anatomy
from jaxmotion.motion.contact import foot_contacts
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.motion.trajectory import Command, integrate_path
from jaxmotion.retarget import transfer
from jaxmotion.systems import registry
from jaxmotion.typing import Key
from jaxmotion.viz.stage import Ball, Stage, make_stage

# Characters at a time on a CPU, where one large batch falls out of the cache.
_CPU_CHUNK = 4


def load(
    source: str | Path, *, foot_lock: FootLock | bool | None = None, **options: Any
) -> Any:
    """A model to be steered, or to be sampled.

    Args:
      source: Name of a shipped model (one of `files.SHIPPED`), a run folder, or a file
        of a system's `export`.
      foot_lock: Settings of the lock that keeps planted feet in place; True for the
        defaults, with toes that rest as high as in the data (CAMDM's models know; else
        2 cm), False for none. None: on for shipped models, off for runs and files,
        whose frames are then what the network makes. Motions that are sampled whole
        are cleaned with foresight (`control.foot_lock.clean_motion`).
      **options: For the system's `load_character` or `load_sampler`: `step` makes
        another step of the chain, such as `diffusion.chain.ddim_step`; CAMDM has
        `control` and `steps` (those of the schedule to visit) as well, AAMDM `held`
        (the frame before instead of drafts: two calls), EMDM `scale` and `row`.

    Returns:
      A `control.steering.Character` for `rollout`, whose `start` makes states; of EMDM,
      which makes whole motions of actions, a `control.sampling.Sampler` for `sample`.
      Either has `skeleton`, `labels`, `fps`, `source` and `license`.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if there is no such model, it is of no system that is known or of one
        without such an option, an option is of another kind, or its skeleton has no
        legs whose feet could be locked.
    """
    own = files.shipped(source)
    path, is_shipped = own or Path(source), own is not None
    if not path.exists():
        raise ValueError(
            f"{source}: no such file or folder, and no shipped model "
            f"({', '.join(files.SHIPPED)})"
        )
    found = registry.SYSTEMS.get(system_of(path))
    if found is None:
        raise ValueError(
            f"{path}: field 'system' is {system_of(path)!r}, expected one of "
            f"{', '.join(registry.SYSTEMS)}"
        )
    wanted = is_shipped if foot_lock is None else foot_lock
    lock = wanted if isinstance(wanted, FootLock) else None
    if found.steerable:
        make = found.room("controller").load_character
    else:
        make = found.room("sampler").load_sampler
    if unknown := options.keys() - (known := inspect.signature(make).parameters):
        raise ValueError(
            f"{source}: no option {', '.join(sorted(unknown))}; a model of "
            f"{found.name} takes {', '.join(list(known)[1:])}"
        )
    if not callable(step := options.get("step", len)):
        raise ValueError(f"{source}: step is {step!r}, expected a function of a step")
    if not isinstance(foot_lock, FootLock | bool | None):
        raise ValueError(f"{source}: foot_lock is {foot_lock!r}, expected a FootLock")
    model = make(path, **options)
    if wanted is not False:
        lock_or_clean = lock_feet if found.steerable else clean_sampler
        model = lock_or_clean(model, lock)
    if is_shipped:
        model = dataclasses.replace(model, license=files.SHIPPED_LICENSE)
    return model


def system_of(path: Path) -> Any:
    """What a run folder or an exported file says that it is of."""
    if path.is_file():
        from jaxmotion.learning import checkpoint

        return checkpoint.export_config(path).get("system")
    value = files.read_object(path / "config.json", what="expected a run folder")
    return value.get("system")


def commands(
    course: str | Sequence[tuple],
    model: Character,
    number: int | None = None,
    *,
    seconds: float | None = None,
    speed: float | Sequence[float] | np.ndarray = 1.2,
    labels: Any = None,
) -> Command:
    """Commands along a course for many characters.

    Args:
      course: One of `control.courses.COURSES`; or a list of segments (seconds,
        direction of travel and facing in degrees from +z toward +x, m/s, and, if it
        changes, the label), which begin again at their end.
      number: Characters; None for one per label or speed that is given, or one.
      seconds: Length; None for 10 s, or for a list's own length.
      speed: Meters per second, for all or one per character; a list of segments has
        its own.
      labels: Name or index of a style or skill for all characters, or one for each;
        None for the first.

    Returns:
      Commands [number, ticks, ...] for characters that start facing +z.

    Raises:
      ValueError: if the course or a label is unknown, numbers do not agree or are not
        finite, or the length is less than a tick.
    """
    if np.ndim(speed) and number is None and (labels is None or np.ndim(labels) == 0):
        number = len(np.asarray(speed))
    found = steering.label_indices(model.labels, labels, number)
    speeds = np.asarray(speed, float)
    if speeds.ndim > 1 or (speeds.ndim and len(speeds) != len(found)):
        raise ValueError(f"speeds of shape {speeds.shape} for {len(found)} characters")
    if isinstance(course, str):
        return courses.course_batch(
            course,
            found,
            np.broadcast_to(speeds, found.shape),
            seconds=10.0 if seconds is None else seconds,
            fps=model.fps,
        )
    return _segments(course, model, found, seconds)


def _segments(
    course: Sequence[tuple], model: Character, labels: np.ndarray, seconds: float | None
) -> Command:
    rows = []
    for number, segment in enumerate(course):
        fits = len(segment) in (4, 5) and np.isfinite(segment[:4]).all()
        if not fits or not segment[0] > 0 or not segment[3] >= 0:
            raise ValueError(
                f"segment {number} of the course is {segment!r}, expected (seconds, "
                "direction, facing, m/s), finite and with positive seconds, perhaps a "
                "label"
            )
        own = (model.label(segment[4]),) if len(segment) == 5 else (-1,)
        rows.append((*map(float, segment[:4]), *own))
    if not rows:
        raise ValueError("the course has no segments")
    length = sum(row[0] for row in rows) if seconds is None else seconds
    one = courses.segment_commands(rows, seconds=length, fps=model.fps)
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(labels), *x.shape)), one)
    given = jnp.where(many.label < 0, jnp.asarray(labels)[:, None], many.label)
    return dataclasses.replace(many, label=given)


def path(points: Any, *, speed: Any = 1.2) -> goals.Path:
    """A path to walk along and to stand at the end of, for `rollout`.

    Args:
      points: (x, z) meters, [points, 2] for all characters or [characters, points, 2].
      speed: m/s; for all points, or one for each.

    Raises:
      ValueError: if there are fewer than two points, two in a row are the same, speeds
        are not positive or of another number, or one is not finite.
    """
    found, speeds = np.asarray(points, np.float32), np.asarray(speed, np.float32)
    shape = found.shape
    if len(shape) not in (2, 3) or shape[-1] != 2 or shape[-2] < 2:
        raise ValueError(f"points of shape {shape}, expected two or more (x, z)")
    apart = np.linalg.norm(np.diff(found, axis=-2), axis=-1) > 1e-3
    if not (np.isfinite(found).all() and apart.all()):
        raise ValueError("two points in a row are the same, or one is not finite")
    fits = speeds.shape in ((), shape[-2:-1], shape[:-1])
    if not (fits and (speeds > 0).all() and np.isfinite(speeds).all()):
        raise ValueError(
            f"speed is {speed!r}, expected one above 0 and finite, or one per point"
        )
    speeds = np.broadcast_to(speeds, shape[:-1])
    return goals.Path(points=jnp.asarray(found), speed=jnp.asarray(speeds))


def place(position: Any, *, facing: Any = 0.0, seconds: Any) -> goals.Place:
    """A place to stand at from a time on, for `rollout`.

    Args:
      position: (x, z) meters, for all characters or [characters, 2].
      facing: Degrees from +z toward +x; for all or for each.
      seconds: When to be there, from the beginning; for all or for each.

    Raises:
      ValueError: if shapes do not agree, a number is not finite, or a time is not
        positive.
    """
    found = np.asarray(position, np.float32)
    angle, time = np.deg2rad(np.asarray(facing, np.float32)), np.asarray(seconds)
    if found.ndim not in (1, 2) or found.shape[-1] != 2 or not np.isfinite(found).all():
        raise ValueError(f"position is {position!r}, expected (x, z), or one for each")
    for name, value in (("facing", angle), ("seconds", time)):
        if value.shape not in ((), found.shape[:-1]):
            raise ValueError(f"{name} of shape {value.shape} for {found.shape[:-1]}")
    if not np.isfinite(angle).all():
        raise ValueError(f"facing is {facing!r}, expected degrees")
    if not ((time > 0).all() and np.isfinite(time).all()):
        raise ValueError(f"seconds is {seconds!r}, expected above 0 and finite")
    ways = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return goals.Place(
        position=jnp.asarray(found),
        facing=jnp.asarray(np.broadcast_to(ways, found.shape)),
        seconds=jnp.asarray(np.broadcast_to(time, found.shape[:-1]), jnp.float32),
    )


def rollout(
    model: Character | Sampler,
    key: Key,
    states: Any,
    commands: Command | None = None,
    *,
    goal: goals.Goal | None = None,
    chunk: int | None = None,
    mesh: Mesh | None = None,
    **options: Any,
) -> Frame:
    """Frames of steered characters: one program, compiled once per shape.

    Args:
      key: Consumed. Character c draws from `fold_in(key, c)`, however many there are.
      commands: What they are told in each tick; with a goal, what leaders are told.
      goal: What they go after instead, wherever that takes them: from `path` or
        `place`, or a `control.goals.Follow`; one for all, or one for each.
      chunk: Characters to run at a time, at most; None for what suits the processor.
        Those with goals, who may see each other, run all at once.
      mesh: Devices to split the characters over; None for one.
      **options: With a goal, those of `control.goals.goal_rollouts`: `seconds` (None
        for as long as it takes and 2 s, in whole seconds: each number of ticks is a
        program of its own), `places` to start at (None for the first
        points of paths, else the origin), `labels`, `avoiding`, `circles`.

    Returns:
      Frames [characters, ticks, ...]; `frames[0].motion` is the first one's motion.

    Raises:
      ValueError: if the model is not steered, there is neither a goal nor commands,
        states are of another model, states and commands of different numbers of
        characters, or a label is none of the model's.
    """
    character = steering.steered(model)
    if goal is not None:
        if chunk is not None or mesh is not None:
            raise ValueError("characters with goals run at once: no chunk and no mesh")
        return _go(character, key, states, goal, commands, **options)
    if commands is None or options:
        given = f", found {', '.join(options)}" if options else ""
        raise ValueError(f"expected commands, or a goal and its options{given}")
    if chunk is None and jax.default_backend() == "cpu":
        chunk = _CPU_CHUNK
    return steering.steered_rollouts(
        character, key, states, commands, chunk=chunk, mesh=mesh
    )


def _go(
    character: Character,
    key: Key,
    states: Any,
    goal: goals.Goal,
    commands: Command | None,
    *,
    seconds: float | None = None,
    places: Any = None,
    labels: Any = None,
    circles: Any = None,
    avoiding: bool = False,
    **unknown: Any,
) -> Frame:
    """`rollout` with a goal."""
    if not isinstance(goal, goals.Goal):
        raise ValueError(
            f"goal is a {type(goal).__name__}, expected one of `path` or `place`, or a "
            "Follow"
        )
    if unknown:
        raise ValueError(
            f"no option {', '.join(sorted(unknown))}; goals take seconds, places, "
            "labels, avoiding, circles"
        )
    if circles is not None:
        circles = jnp.asarray(circles, jnp.float32) if np.size(circles) else None
    number = jax.tree.leaves(states)[0].shape[0]
    starts = jnp.zeros(2)
    if isinstance(goal, goals.Path):
        steps = jnp.linalg.norm(jnp.diff(goal.points, axis=-2), axis=-1)
        pace = 0.5 * (goal.speed[..., 1:] + goal.speed[..., :-1])
        needs, starts = jnp.sum(steps / pace, axis=-1), goal.points[..., 0, :]
    elif isinstance(goal, goals.Place):
        needs = goal.seconds
    else:
        leader, needs = jnp.broadcast_arrays(goal.leader, goal.distance)
        goal = goals.Follow(leader=leader, distance=needs)
    if not needs.ndim:
        every = lambda x: jnp.broadcast_to(x, (number, *x.shape))  # noqa: E731
        goal = jax.tree.map(every, goal)
    starts = starts if places is None else jnp.asarray(places, jnp.float32)
    if starts.ndim == 1:
        starts = jnp.broadcast_to(starts, (number, *starts.shape))
    if seconds is None and isinstance(goal, goals.Follow):
        if commands is None:
            raise ValueError("who follows needs seconds, or commands of a leader")
        seconds = commands.label.shape[-1] / character.fps
    if seconds is None:
        seconds = float(math.ceil(float(jnp.max(needs)) + 2.0))
    return goals.goal_rollouts(
        character,
        key,
        states,
        goal,
        seconds=seconds,
        places=starts,
        labels=steering.label_array(character.labels, labels, number),
        circles=circles,
        commands=commands,
        avoiding=avoiding,
    )


def sample(
    model: Sampler | Character,
    key: Key,
    labels: Any = None,
    number: int | None = None,
    *,
    chunk: int | None = None,
) -> Motion:
    """Whole motions: one program, compiled once per shape.

    Args:
      key: Consumed. Motion i draws from `fold_in(key, i)`, however many there are.
      labels: Name or index of an action for all motions, or one for each; None for the
        first.
      number: Motions; None for one per label that is given, or one.
      chunk: Motions to make at a time, at most; None for what suits the processor.

    Returns:
      Motions [number, frames, ...] that begin at the origin facing +z; `motions[0]` is
      the first.

    Raises:
      ValueError: if the model is steered, a label is unknown, numbers do not agree, or
        the chunk is not positive.
    """
    if not isinstance(model, Sampler):
        steering.steered(model)
        raise ValueError("this model is steered: expected `rollout`, not `sample`")
    found = steering.label_array(model.labels, labels, number)
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunks of {chunk} motions, expected 1 or more")
    if chunk is None:
        on_cpu = jax.default_backend() == "cpu"
        chunk = _CPU_CHUNK if on_cpu else len(found)
    return sampling.sample_motions(model, key, found, chunk=chunk)


def _one(skeleton: Skeleton, frames: Frame | Motion) -> Motion:
    """The motion of one character; raises for what is none of this skeleton's."""
    if not isinstance(frames, Frame | Motion):
        raise ValueError(f"frames are a {type(frames).__name__}, expected a Frame")
    shape = frames.root_position.shape
    if len(shape) != 2:
        raise ValueError(
            f"frames of shape {shape[:-1]}: expected those of one character, such as "
            "frames[0]"
        )
    motion = frames.motion if isinstance(frames, Frame) else frames
    values = (motion.root_position, motion.joint_rotation)
    if not (shape[0] and all(np.isfinite(np.asarray(x)).all() for x in values)):
        raise ValueError(f"{shape[0]} frames: expected one or more that are finite")
    if not (np.isfinite(motion.fps) and motion.fps > 0):
        raise ValueError(f"{motion.fps} frames per second: expected a positive rate")
    columns = np.asarray(motion.joint_rotation, np.float64)
    if columns.shape[1:] != (skeleton.num_joints, 6):
        raise ValueError(
            f"joint_rotation of a frame is {columns.shape[1:]}, expected that of the "
            f"skeleton, {(skeleton.num_joints, 6)}"
        )
    area = np.linalg.norm(np.cross(columns[..., :3], columns[..., 3:]), axis=-1)
    if not (area > 1e-9).all():
        frame, joint = np.argwhere(~(area > 1e-9))[0]
        raise ValueError(
            f"frame {frame}: the columns of {skeleton.names[joint]!r} are no rotation"
        )
    return motion


def _stage(skeleton: Skeleton, frames: Frame | Motion) -> Stage:
    """What pictures are drawn from: one character or many."""
    if not isinstance(frames, Frame | Motion):
        raise ValueError(f"frames are a {type(frames).__name__}, expected a Frame")
    if isinstance(frames, Motion):
        return make_stage(skeleton, frames)
    if frames.root_position.ndim not in (2, 3):
        raise ValueError(
            f"frames of shape {frames.root_position.shape[:-1]}: expected those of "
            "one character, such as frames[0], or of many"
        )
    start = frames.root_position[..., :1, ::2]
    ball = frames.extra.get("ball")
    return make_stage(
        skeleton,
        frames.motion,
        wanted=start + integrate_path(frames.desired_velocity, frames.fps),
        ball=None if ball is None else Ball(position=np.asarray(ball, float)),
    )


def _save_bvh(path: Path, skeleton: Skeleton, frames: Frame | Motion) -> None:
    from jaxmotion.data import bvh, bvh_text

    bvh_text.write_bvh(path, bvh.bvh_from_motion(skeleton, _one(skeleton, frames)))


def _save_gif(path: Path, skeleton: Skeleton, frames: Frame | Motion) -> None:
    from jaxmotion.viz import animation

    animation.save_gif(path, _stage(skeleton, frames))


def _save_html(path: Path, skeleton: Skeleton, frames: Frame | Motion) -> None:
    from jaxmotion.viz import html

    html.save_html(path, _stage(skeleton, frames), title=path.stem)


def _save_glb(path: Path, skeleton: Skeleton, frames: Frame | Motion) -> None:
    from jaxmotion.export import gltf

    gltf.save_glb(path, skeleton, _one(skeleton, frames))


def _save_npz(path: Path, skeleton: Skeleton, frames: Frame | Motion) -> None:
    motion = _one(skeleton, frames)
    positions = joint_positions(skeleton, motion)
    feet = positions[:, np.array(skeleton.feet, int)]
    feet = jnp.repeat(feet, 2, axis=0) if len(feet) == 1 else feet  # a speed takes two
    arrays = dict(
        root_position=motion.root_position,
        joint_rotation=motion.joint_rotation,
        joint_position=positions,
        foot_contact=foot_contacts(feet, motion.fps)[: len(positions)],
        feet=[skeleton.names[foot] for foot in skeleton.feet],
        offsets=skeleton.offsets,
        parents=skeleton.parents,
        names=skeleton.names,
        fps=motion.fps,
    )
    files.write_arrays(path, arrays)


def _save_csv(path: Path, skeleton: Skeleton, frames: Frame | Motion) -> None:
    motion = _one(skeleton, frames)
    positions = np.asarray(joint_positions(skeleton, motion))
    names = [name.replace(",", "_") for name in skeleton.names]  # of a rig, perhaps
    lines = [",".join(["seconds", *(f"{name}.{x}" for name in names for x in "xyz")])]
    for number, row in enumerate(positions.reshape(len(positions), -1)):
        values = ",".join(f"{value:.4f}" for value in row)
        lines.append(f"{number / motion.fps:.4f},{values}")
    files.write_text(path, "\n".join(lines) + "\n")


def read_skeleton(path: str | Path) -> transfer.Rest:
    """The skeleton of a rig, for `retarget`: .glb, .gltf, .vrm, .fbx or .bvh.

    Of a glTF whose nodes stand in a frame of an animation, it is the skeleton in the
    pose in which its mesh was made.

    Raises:
      ModuleNotFoundError: for FBX without the extra [fbx].
      OSError: if it cannot be read.
      ValueError: if it is damaged, of another kind, or no person's; names the file.
    """
    return _read_rest(path, None)


def _read_rest(path: str | Path, roles: Any) -> transfer.Rest:
    path = Path(path)
    kind = path.suffix.lower()
    if kind in RIGS:
        from jaxmotion.export import rig

        return rig.read_rig(path).rest(roles)
    if kind not in (".bvh", ".fbx"):
        raise ValueError(
            f"{path}: unknown suffix {path.suffix!r}, expected one of "
            f"{', '.join((*RIGS, '.bvh', '.fbx'))}"
        )
    from jaxmotion.data import fbx, own

    given = (str(path), files.read_bytes(path))
    if kind == ".bvh":
        recording = own.read_bvh(*given)
    else:
        recording = fbx.read_fbx(*given, rest=True)
    skeleton, motion = own.as_recorded(recording)
    rotations = anatomy.kinematics(skeleton, motion)[1]
    try:
        return transfer.rest(skeleton, given=roles, rotations=rotations)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def retarget(
    source: Skeleton,
    target: Skeleton | transfer.Rest | str | Path,
    *,
    roles: Mapping[str, str] | str | Path | None = None,
    motion: Motion | None = None,
) -> transfer.Retarget:
    """The function that brings motions of one skeleton onto another.

    It may be jitted, and takes motions of one character or of many, of a frame or of
    a clip: `target_motion = retarget(model.skeleton, "hero.glb")(frames.motion)`.

    Args:
      target: A skeleton, or a rig's file; see `jaxmotion.face.read_skeleton`. What is
        above its hips is moved with them and never turns.
      roles: Joints of some of the target's roles, by the names of `ROLES` (of `from
        jaxmotion.retarget import roles`), or a JSON file of them; None for what its
        names and shape say.
      motion: Any second of the source's, where its zero pose does not tell how its
        limbs are turned about themselves: LaFAN1, Bandai Namco, the walker.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if either is no person's skeleton; says what was found and missing.
    """
    if isinstance(target, str | Path):
        target = _read_rest(target, roles)
        roles = None
    return transfer.retarget(source, target, roles=roles, motion=motion)


# Rigs that motion is written onto as they are.
RIGS = (".glb", ".gltf", ".vrm")

SAVERS: dict[str, Callable[[Path, Skeleton, Frame | Motion], None]] = {
    ".bvh": _save_bvh,
    ".csv": _save_csv,
    ".gif": _save_gif,
    ".glb": _save_glb,
    ".html": _save_html,
    ".npz": _save_npz,
}


def save(
    path: str | Path,
    skeleton: Skeleton,
    frames: Frame | Motion,
    *,
    t_pose: bool = False,
    mixamo: bool = False,
    onto: str | Path | None = None,
    roles: Mapping[str, str] | str | Path | None = None,
    robot: str | Path | None = None,
) -> None:
    """Writes motion in the format of the suffix.

    .bvh rotations for animation tools, centimeters; .csv world positions of all joints,
    meters; .gif a moving picture; .glb a skinned body and its animation (meters, y up),
    for engines, Blender and browsers; .html a page to turn and play; .npz arrays:
    root_position, joint_rotation (6D, two columns), joint_position, foot_contact, and
    the skeleton. Pictures take many characters, the others one, such as `frames[0]`.

    Args:
      t_pose: Rotations are against the T-pose instead of the skeleton's own zero pose;
        in .glb they always are.
      mixamo: Joints are named as Mixamo's characters have them.
      onto: A rig's file (see `retarget`) whose skeleton the motion is brought onto; a
        .glb is then that rig, animated, if it is a .glb, .gltf or .vrm, and a root bone
        on the ground that carries its hips goes and turns with them, level and
        smoothly. What is written is as large as the rig, whose units are meters.
      roles: Joints of some of its roles, or bodies of the robot's; see `retarget`.
      robot: MJCF or URDF of a humanoid that the motion is brought onto, 50 frames per
        second; the .npz is then what mjlab's motion tracking reads, with what the robot
        cannot do (see `RobotMotion` of `jaxmotion/retarget/robot_motion.py`).

    Raises:
      ModuleNotFoundError: for robots without the extra [robot].
      OSError: if the file cannot be written.
      ValueError: if the suffix is unknown, frames are not those of one character or not
        finite, the skeleton has no arms and legs to be named, or roles are of nothing.
    """
    path = Path(path)
    if roles is not None and onto is None and robot is None:
        raise ValueError("roles are of a rig's joints: expected `onto` or `robot`")
    if robot is not None:
        if path.suffix.lower() != ".npz" or t_pose or mixamo or onto is not None:
            raise ValueError(f"{path}: a robot's motion is an .npz, without `onto`")
        from jaxmotion.retarget import robot as robots
        from jaxmotion.retarget import robot_motion

        read = robots.read_robot(robot, roles)
        made = robot_motion.follow(read, skeleton, _one(skeleton, frames))
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_arrays(path, made.to_arrays())
        return
    if path.suffix.lower() not in SAVERS:
        raise ValueError(
            f"{path}: unknown suffix {path.suffix!r}, expected one of "
            f"{', '.join(SAVERS)}"
        )
    if t_pose:
        skeleton, frames = anatomy.as_t_pose(skeleton, _one(skeleton, frames))
    if mixamo:
        names = anatomy.mixamo_names(skeleton)
        skeleton = dataclasses.replace(skeleton, names=names)
    if onto is not None:
        if t_pose or mixamo:
            raise ValueError("onto a rig, `t_pose` and `mixamo` say nothing")
        motion = _one(skeleton, frames)
        if path.suffix.lower() == ".glb" and Path(onto).suffix.lower() in RIGS:
            from jaxmotion.export import rig

            rig.save_onto(path, rig.read_rig(onto), skeleton, motion, roles=roles)
            return
        function = transfer.Retarget(
            transfer.rest(skeleton, rotations=anatomy.kinematics(skeleton, motion)[1]),
            _read_rest(onto, roles),
        )
        skeleton, frames = function.target.skeleton, function(motion)
    path.parent.mkdir(parents=True, exist_ok=True)
    SAVERS[path.suffix.lower()](path, skeleton, frames)


@dataclasses.dataclass(frozen=True)
class View:
    """A page that a notebook shows, and keeps when it is saved."""

    page: str
    height: int

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{escaping.escape(self.page)}" width="100%" '
            f'height="{self.height}" style="border:0"></iframe>'
        )


def show(
    skeleton: Skeleton,
    frames: Frame | Motion,
    *,
    title: str = "",
    caption: str = "",
    height: int = 480,
) -> View:
    """What a notebook cell displays: play, pause, turn and zoom, also without a kernel.

    Args:
      frames: Frames of one character, such as `frames[0]`, or of many, which are set
        apart where they would start within each other.
      caption: Below it, such as the data's source and license.
      height: Height of the view, pixels.

    Raises:
      ValueError: if frames are not those of characters over time, or not finite.
    """
    from jaxmotion.viz import html

    stage = _stage(skeleton, frames)
    return View(html.page(stage, title=title, caption=caption), height)
