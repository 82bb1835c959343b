"""Motion on a humanoid robot, as far as its joints can follow.

`transfer` brings the motion onto the robot as a person, in closed form. While the ball
of a foot stands, its sole lies level on the ground, or its front edge does and the heel
is up. Then mink finds angles within the limits: in every frame a few quadratic
programs, whose goals weigh as `_COSTS` says, starting from the frame before. Where
limits push the hips aside, they are brought there slowly and all is done once more.

Source: mink (Zakka 2026), differential inverse kinematics; the arrays of `to_arrays`
are those that mjlab's motion tracking reads, after BeyondMimic (Liao et al. 2025).
"""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion.motion import anatomy
from jaxmotion.motion.anatomy import LEFT, RIGHT
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.retarget import robot as robots
from jaxmotion.retarget import transfer
from jaxmotion.retarget.robot import MARK, WORLD, Robot, front, packages
from jaxmotion.retarget.transfer import Rest

# Of a goal's place (1/m) and turn (1/rad).
_COSTS = {
    "hips": (4.0, 2.0),
    "chest": (0.0, 1.0),
    "head": (0.0, 0.1),
    "LowerLeg": (0.3, 0.0),
    "Foot": (60.0, 12.0),  # while it stands; in the air its turn is free
    "LowerArm": (0.5, 0.0),
    "Hand": (1.5, 0.0),
}
# The hips' the second time; a foot's turn in the air.
_AGAIN, _AIR = (25.0, 5.0), 0.5
# Of a joint's angle from the frame before (1/rad).
_CHANGE, _DAMPING = 0.15, 1e-6
# Programs a frame at most, and for the first one; when it is met, and the largest step
# of one, radians.
_ROUNDS, _FIRST, _STILL, _STEP = 10, 200, 1e-4, 0.2
# How far hands stay from what is no arm, meters.
_APART = 0.005
# How long a leg may be, in its length: straight ones jerk.
_REACH = 0.985
# How near to its limit a joint is at it, radians.
_AT_LIMIT = 1e-3
# A foot stands below this speed and height of its ball, for legs of 0.87 m; a slope of
# it that is nearly flat, radians.
_SPEED, _HEIGHT, _LEG, _FLAT = 0.3, 0.025, 0.87, np.deg2rad(6.0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RobotMotion:
    """A robot over time, and how well it follows.

    Attributes:
      qpos: [F, nq] MuJoCo's state.
      planted: [F, 2] whether the left and the right foot stand.
      goals: What it followed, on its skeleton as a person.
      misses: [F, 2] how far each foot is from where it should be, meters.
    """

    robot: Robot
    fps: float
    qpos: np.ndarray
    planted: np.ndarray
    goals: Motion
    misses: np.ndarray

    @functools.cached_property
    def qvel(self) -> np.ndarray:
        """[F, nv] velocities, by central differences."""
        mujoco, _ = packages()
        found = np.zeros((len(self.qpos), self.robot.model.nv))
        last = len(self.qpos) - 1
        for frame in range(len(self.qpos)):
            low, high = max(frame - 1, 0), min(frame + 1, last)
            if high > low:
                mujoco.mj_differentiatePos(
                    self.robot.model,
                    found[frame],
                    (high - low) / self.fps,
                    self.qpos[low],
                    self.qpos[high],
                )
        return found

    @property
    def joint_pos(self) -> np.ndarray:
        """[F, joints] rad or m."""
        return self.qpos[:, self.robot.columns]

    @property
    def joint_vel(self) -> np.ndarray:
        """[F, joints] rad/s or m/s."""
        return self.qvel[:, self.robot.model.jnt_dofadr[self.robot.joints]]

    @functools.cached_property
    def bodies(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Places, quaternions (w first), velocities and spins of bodies, in the world.

        Velocities are those of the bodies' own origins.
        """
        mujoco, _ = packages()
        model, tree = self.robot.model, self.robot.tree
        data = mujoco.MjData(model)
        count = len(self.qpos), len(tree)
        places, turns = np.zeros((*count, 3)), np.zeros((*count, 4))
        velocities, spins = np.zeros((*count, 3)), np.zeros((*count, 3))
        six = np.zeros(6)
        for frame in range(len(self.qpos)):
            data.qpos[:], data.qvel[:] = self.qpos[frame], self.qvel[frame]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            places[frame], turns[frame] = data.xpos[tree], data.xquat[tree]
            for n, body in enumerate(tree):
                kind = mujoco.mjtObj.mjOBJ_XBODY
                mujoco.mj_objectVelocity(model, data, kind, int(body), six, 0)
                spins[frame, n], velocities[frame, n] = six[:3], six[3:]
        return places, turns, velocities, spins

    def as_skeleton(self) -> tuple[Skeleton, Motion]:
        """Its bodies as joints of a skeleton in our world, and its motion on that."""
        robot = self.robot
        zero = robots.zero_pose(robot.model, robot.tree.tolist(), robot.axes)
        skeleton = robots.skeleton_of_bodies(
            robot.model, zero.tree, zero.places, hands=False
        )
        places, quats = self.bodies[:2]
        mujoco, _ = packages()
        turns = np.zeros((*quats.shape[:2], 9))
        for row, quat in zip(turns.reshape(-1, 9), quats.reshape(-1, 4), strict=True):
            mujoco.mju_quat2Mat(row, quat)
        start = zero.data.xmat[robot.tree].reshape(-1, 3, 3)
        turns = turns.reshape(*quats.shape[:2], 3, 3) @ np.swapaxes(start, -1, -2)
        turns = WORLD.T @ turns @ robot.axes
        return skeleton, Motion(
            root_position=jnp.asarray(places[:, 0] @ WORLD, jnp.float32),
            joint_rotation=anatomy.local_columns(skeleton.parents, turns),
            fps=self.fps,
        )

    @functools.cached_property
    def soles(self) -> np.ndarray:
        """[F, 2, 3] the middle of each foot's front edge, its height the sole's."""
        mujoco, _ = packages()
        model = self.robot.model
        data = mujoco.MjData(model)
        places = np.zeros((len(self.qpos), 2, 3))
        turns = np.zeros((len(self.qpos), 2, 9))
        sites = [model.site(f"{MARK}{side}Foot").id for side in (LEFT, RIGHT)]
        for frame in range(len(self.qpos)):
            data.qpos[:] = self.qpos[frame]
            mujoco.mj_kinematics(model, data)
            places[frame], turns[frame] = data.site_xpos[sites], data.site_xmat[sites]
        places, turns = places @ WORLD, WORLD.T @ turns.reshape(-1, 2, 3, 3)
        found = np.zeros_like(places)
        for n, side in enumerate((LEFT, RIGHT)):
            found[:, n] = places[:, n] + turns[:, n] @ front(self.robot.rest, side)
            found[:, n, 1] = self.robot.feet[n].lowest(places[:, n], turns[:, n])
        return found

    @property
    def at_limit(self) -> np.ndarray:
        """[F, joints] which are at a limit."""
        low, high = self.robot.limits.T
        return (self.joint_pos < low + _AT_LIMIT) | (self.joint_pos > high - _AT_LIMIT)

    def report(self) -> dict[str, Any]:
        """What the robot cannot do, counted.

        `at_limit` is the share of frames with any joint at a limit, `limited` that of
        each joint that ever is; `fastest` the joint with the largest velocity (of what
        the file allows, where it says so) and `over` the share of frames in which any
        is faster than the file allows; `slide` the mean speed of the front edges of
        planted feet over the ground, `under` the deepest that a sole is below it, and
        `miss` how far a planted foot is from its goal at most.
        """
        robot, hit = self.robot, self.at_limit
        speed = np.abs(self.joint_vel)
        part = np.where(np.isfinite(robot.speeds), speed / robot.speeds, 0.0)
        worst = part if part.any() else speed
        fastest = int(worst.max(axis=0).argmax())
        moved = np.linalg.norm(np.diff(self.soles[..., ::2], axis=0), axis=-1)
        stand = self.planted[1:] & self.planted[:-1]
        limit = robot.speeds[fastest]
        return {
            "frames": len(self.qpos),
            "fps": self.fps,
            "at_limit": float(hit.any(axis=1).mean()),
            "limited": {
                name: float(share)
                for name, share in zip(robot.joint_names, hit.mean(axis=0), strict=True)
                if share > 0
            },
            "fastest": robot.joint_names[fastest],
            "fastest_velocity": float(speed[:, fastest].max()),
            "fastest_limit": float(limit) if np.isfinite(limit) else None,
            "over": float((speed > robot.speeds).any(axis=1).mean()),
            "slide": float((moved * stand).sum() / max(stand.sum(), 1) * self.fps),
            "under": float(max(-self.soles[..., 1].min(), 0.0)),
            "planted": self.planted.mean(axis=0).tolist(),
            "miss": float((self.misses * self.planted).max()),
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What mjlab's motion tracking reads, and more.

        joint_pos and joint_vel [F, joints] in MuJoCo's order; body_pos_w, body_quat_w
        (w first), body_lin_vel_w and body_ang_vel_w [F, bodies, ...] in its world (z
        up), the root first; fps [1]; joint_names, body_names; foot_contact [F, 2] left
        and right; qpos and qvel, MuJoCo's whole states; report, as JSON.
        """
        places, quats, velocities, spins = self.bodies
        single = lambda x: np.asarray(x, np.float32)  # noqa: E731
        return {
            "fps": np.array([self.fps]),
            "joint_pos": single(self.joint_pos),
            "joint_vel": single(self.joint_vel),
            "body_pos_w": single(places),
            "body_quat_w": single(quats),
            "body_lin_vel_w": single(velocities),
            "body_ang_vel_w": single(spins),
            "joint_names": np.array(self.robot.joint_names),
            "body_names": np.array(self.robot.body_names),
            "foot_contact": self.planted,
            "qpos": self.qpos,
            "qvel": self.qvel,
            "report": np.array(json.dumps(self.report())),
        }


def _smooth(mask: np.ndarray, width: int) -> np.ndarray:
    """1 where a mask [F] is true, falling to 0 over so many frames outside."""
    frames = np.arange(len(mask))
    if not mask.any():
        return np.zeros(len(mask))
    away = np.abs(frames[:, None] - np.flatnonzero(mask)).min(axis=1)
    return 0.5 + 0.5 * np.cos(np.pi * np.clip(away / (width + 1), 0, 1))


def _stands(toes: np.ndarray, fps: float, scale: float) -> np.ndarray:
    """[F] where the ball of a foot [F, 3] rests on the ground."""
    speed = np.linalg.norm(np.gradient(toes, axis=0), axis=-1) * fps
    mask = (speed < _SPEED * scale) & (toes[:, 1] < _HEIGHT * scale)
    # No gaps and no contacts of less than 0.05 s.
    least = max(round(0.05 * fps), 1)
    for value in (False, True):
        edges = np.flatnonzero(np.diff(mask)) + 1
        starts, ends = np.r_[0, edges], np.r_[edges, len(mask)]
        for a, b in zip(starts, ends, strict=True):
            if mask[a] == value and b - a < least and 0 < a and b < len(mask):
                mask[a:b] = not value
    return mask


def _level(turns: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Feet [F, 3, 3] as they stand: sides level, heel on the ground or above it.

    The less the weight [F], the more they stay as they are.
    """
    ahead = turns[..., :, 2]
    yaw = np.arctan2(ahead[..., 0], ahead[..., 2])
    pitch = np.arctan2(-ahead[..., 1], np.hypot(ahead[..., 0], ahead[..., 2]))
    # What is nearly flat is flat.
    pitch = np.maximum(pitch - _FLAT, 0.0)
    o, i = 0 * yaw, 0 * yaw + 1
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.stack([c, o, s, o, i, o, -s, o, c], -1).reshape(*yaw.shape, 3, 3)
    c, s = np.cos(pitch), np.sin(pitch)
    raised = np.stack([i, o, o, o, c, -s, o, s, c], -1).reshape(*yaw.shape, 3, 3)
    return _orthonormal(turns + weight[:, None, None] * (heading @ raised - turns))


def _orthonormal(matrices: np.ndarray) -> np.ndarray:
    """The rotations nearest to matrices [..., 3, 3] that nearly are."""
    u, _, v = np.linalg.svd(matrices)
    return u @ v


def _cubic(values: np.ndarray, ratio: float) -> np.ndarray:
    """Values [F, ...] at every `ratio` of a frame, by Catmull and Rom's splines."""
    if ratio == 1.0:
        return values
    time = np.arange(int((len(values) - 1) / ratio + 1e-6) + 1) * ratio
    at = np.minimum(time.astype(int), max(len(values) - 2, 0))
    t = (time - at).reshape(-1, *[1] * (values.ndim - 1))
    a, b, c, d = (values[np.clip(at + k, 0, len(values) - 1)] for k in (-1, 0, 1, 2))
    slopes = (c - a, d - b)
    square, cube = t * t, t * t * t
    found = (2 * cube - 3 * square + 1) * b + (3 * square - 2 * cube) * c
    found = found + 0.5 * (cube - 2 * square + t) * slopes[0]
    return found + 0.5 * (cube - square) * slopes[1]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Goals:
    """World places [F, 3] and turns [F, 3, 3] by role, our axes.

    `planted` [F, 2] says which feet stand, `weights` how nearly, from 0 to 1.
    """

    places: dict[str, np.ndarray]
    turns: dict[str, np.ndarray]
    planted: np.ndarray
    weights: np.ndarray


def _goals(robot: Robot, motion: Motion, fps: float, wider: float) -> _Goals:
    """Where a motion of the robot as a person wants it, with feet that stand.

    Its hip joints are by `wider` further from the middle than the motion's.
    """
    rest = robot.rest
    places, turns = anatomy.kinematics(rest.skeleton, motion)
    places = _cubic(np.asarray(places, float), motion.fps / fps)
    turns = _orthonormal(_cubic(np.asarray(turns, float), motion.fps / fps))
    goals = {role: places[:, rest.joint(role)] for role in rest.skeleton.names}
    turned = {role: turns[:, rest.joint(role)] for role in rest.skeleton.names}
    scale, planted, weights = rest.leg / _LEG, [], []
    width = round(0.1 * fps)
    ahead = turned["hips"] @ rest.turns[rest.joint("hips")].T
    left = ahead[:, :, 0] * [1.0, 0.0, 1.0]
    left = left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-6)
    for side, foot in zip((LEFT, RIGHT), robot.feet, strict=True):
        role = side + "Foot"
        toes, upright = goals[side + "Toes"], rest.turns[rest.joint(role)]
        stands = _stands(toes, fps, scale)
        toes = toes + (wider if side == LEFT else -wider) * left
        weight = _smooth(stands, width)
        # Its own turn from where it is level.
        level = _level(turned[role] @ upright.T, weight) @ upright
        toes = _held(toes, stands, weight)
        ankle = toes - level @ front(rest, side)
        low = foot.lowest(ankle, level)
        ankle[:, 1] -= np.where(low < 0, low, weight * low)
        goals[role], turned[role] = ankle, level
        planted.append(stands)
        weights.append(weight)
    drop = np.zeros(len(places))
    for limb in rest.anatomy.legs:
        hip, knee = goals[limb.side + "UpperLeg"], rest.lengths(limb)
        ankle, most = goals[limb.side + "Foot"], _REACH * sum(knee)
        aside = np.sum((hip - ankle)[:, [0, 2]] ** 2, axis=-1)
        high = ankle[:, 1] + np.sqrt(np.maximum(most**2 - aside, 0.0))
        drop = np.maximum(drop, hip[:, 1] - high)
    drop = _eased(np.minimum(drop, 0.2 * rest.leg), width)
    for role in goals:
        if not role.endswith(("Foot", "Toes")):
            part = 0.5 if role.endswith("LowerLeg") else 1.0
            goals[role] = goals[role] - part * drop[:, None] * [0.0, 1.0, 0.0]
    return _Goals(
        places=goals,
        turns=turned,
        planted=np.stack(planted, axis=-1),
        weights=np.stack(weights, axis=-1),
    )


def _eased(values: np.ndarray, width: int) -> np.ndarray:
    """Smooth values that are nowhere below those [F] given."""
    if width < 1:
        return values
    frames = np.lib.stride_tricks.sliding_window_view
    most = frames(np.pad(values, 2 * width, mode="edge"), 2 * width + 1).max(axis=-1)
    window = np.hanning(2 * width + 3)[1:-1]
    return frames(most, 2 * width + 1) @ (window / window.sum())


def _held(toes: np.ndarray, stands: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """A foot's front edge [F, 3] that does not move over the ground while it stands."""
    if not stands.any():
        return toes
    edges = np.flatnonzero(np.diff(stands)) + 1
    away = np.zeros_like(toes)
    for frames in np.split(np.arange(len(toes)), edges):
        if stands[frames[0]]:
            away[frames] = np.median(toes[frames], axis=0) - toes[frames]
    away[:, 1] = 0.0
    standing = np.flatnonzero(stands)
    nearest = np.abs(np.arange(len(toes))[:, None] - standing).argmin(axis=1)
    return toes + weight[:, None] * away[standing[nearest]]


def follow(
    robot: Robot,
    source: Skeleton | Rest,
    motion: Motion,
    *,
    fps: float = 50.0,
) -> RobotMotion:
    """A motion [frames, ...] of one character on a robot.

    mjlab's policies act at 50 frames per second. `ModuleNotFoundError` without the
    extra [robot]; `ValueError` if the source is no person's skeleton, the motion is not
    one character's over two frames or more, or the rate is none.
    """
    if np.ndim(motion.root_position) != 2 or len(motion.root_position) < 2:
        raise ValueError(
            f"motion of shape {np.shape(motion.root_position)[:-1]}: expected at least "
            "two frames of one character"
        )
    if not 1.0 <= fps <= 1000.0:
        raise ValueError(f"fps is {fps}, expected 1 to 1000")
    if not isinstance(source, Rest):
        turns = anatomy.kinematics(source, motion)[1]
        source = transfer.rest(source, rotations=turns)
    transferred = transfer.Retarget(source, robot.rest)
    made = transferred(motion)
    wide = [
        np.ptp([one.places[leg.upper, 0] for leg in one.anatomy.legs])
        for one in (source, robot.rest)
    ]
    wider = max(0.5 * float(wide[1] - transferred.scale * wide[0]), 0.0)
    goals = _goals(robot, made, fps, wider)
    qpos, misses, hips = _solve(robot, goals, fps, _COSTS["hips"])
    # Where limits pushed the hips aside they come back slowly.
    away = hips - goals.places["hips"]
    window = np.hanning(round(0.4 * fps) // 2 * 2 + 3)[1:-1]
    away = np.pad(away, ((len(window) // 2,) * 2, (0, 0)), mode="edge")
    away = np.lib.stride_tricks.sliding_window_view(away, len(window), axis=0)
    goals.places["hips"] = goals.places["hips"] + away @ (window / window.sum())
    qpos, misses, _ = _solve(robot, goals, fps, _AGAIN)
    return RobotMotion(
        robot=robot,
        fps=float(fps),
        qpos=qpos,
        planted=goals.planted,
        goals=made,
        misses=misses,
    )


def _solve(
    robot: Robot, goals: _Goals, fps: float, hips: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States [F, nq] that meet the goals as well as the limits allow.

    Beside them: how far the feet are off [F, 2]; places of the hips [F, 3], our axes.
    """
    mujoco, mink = packages()
    model, columns = robot.model, robot.columns
    tasks = {}
    for role in robot.bodies:
        part = role.removeprefix(LEFT).removeprefix(RIGHT)
        if part in _COSTS:
            place, turn = hips if part == "hips" else _COSTS[part]
            tasks[role] = mink.FrameTask(
                frame_name=MARK + role,
                frame_type="site",
                position_cost=place,
                orientation_cost=turn,
                lm_damping=1e-3,
            )
    low, high = robot.used.T
    state = model.qpos0.copy()
    state[columns] = np.clip(state[columns], low, high)
    root = int(model.jnt_qposadr[robot.free])
    posture, change = (mink.PostureTask(model, c) for c in (robot.costs, _CHANGE))
    posture.set_target(state)
    all_tasks = [*tasks.values(), posture]
    if model.neq:
        all_tasks.append(mink.EqualityConstraintTask(model, cost=20.0))
    state[root : root + 3] = WORLD @ goals.places["hips"][0]
    configuration = mink.Configuration(model, q=state)
    limit = mink.ConfigurationLimit(model, gain=1.0)
    limits = [limit]
    if robot.apart:
        limits.append(
            mink.CollisionAvoidanceLimit(
                model,
                robot.apart,
                minimum_distance_from_collisions=_APART,
                collision_detection_distance=_APART + 0.5 * _STEP,
            )
        )
    found = np.zeros((len(goals.planted), model.nq))
    misses, middle = np.zeros((len(found), 2)), np.zeros((len(found), 3))
    for frame in range(len(found)):
        for role, task in tasks.items():
            matrix = np.eye(4)
            matrix[:3, :3] = WORLD @ goals.turns[role][frame]
            matrix[:3, 3] = WORLD @ goals.places[role][frame]
            task.set_target(mink.SE3.from_matrix(matrix))
        for n, side in enumerate((LEFT, RIGHT)):
            full, part = _COSTS["Foot"][1], goals.weights[frame, n]
            tasks[side + "Foot"].set_orientation_cost(_AIR + part * (full - _AIR))
        least, most = low, high
        if frame:
            before, reach = found[frame - 1], robot.speeds / fps
            least = np.maximum(low, before[columns] - reach)
            most = np.minimum(high, before[columns] + reach)
            change.set_target(before)
        # From afar, a long step could end within what it should stay out of.
        step = _STEP if frame else 0.25 * _STEP
        for _ in range(_ROUNDS if frame else _FIRST):
            now = configuration.q[columns]
            limit.lower[columns] = np.maximum(least, now - step)
            limit.upper[columns] = np.minimum(most, now + step)
            velocity = mink.solve_ik(
                configuration,
                [*all_tasks, change] if frame else all_tasks,
                1.0,
                "daqp",
                _DAMPING,
                limits=limits,
            )
            state = configuration.integrate(velocity, 1.0)
            state[columns] = np.clip(state[columns], least, most)
            configuration.update(state)
            if np.abs(velocity).max() < _STILL:
                break
        found[frame] = configuration.q
        middle[frame] = WORLD.T @ configuration.data.site(MARK + "hips").xpos
        for n, side in enumerate((LEFT, RIGHT)):
            place = configuration.data.site(f"{MARK}{side}Foot").xpos
            goal = WORLD @ goals.places[side + "Foot"][frame]
            misses[frame, n] = np.linalg.norm(place - goal)
    return found, misses, middle


def render(
    motion: RobotMotion, *, width: int = 480, height: int = 360, every: int = 2
) -> Iterator[np.ndarray]:
    """Pictures [height, width, 3] by MuJoCo's renderer, of every so many frames.

    `RuntimeError` where there is no OpenGL; see MuJoCo's MUJOCO_GL.
    """
    mujoco, _ = packages()
    model = _stage(motion.robot)
    data = mujoco.MjData(model)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # each of its libraries raises its own
        raise RuntimeError(f"no OpenGL here ({robots.one_line(error)})") from None
    root = int(model.jnt_qposadr[motion.robot.free])
    path = motion.qpos[:, root : root + 3]
    camera = mujoco.MjvCamera()
    camera.distance, camera.elevation = 4.2 * motion.robot.rest.leg, -14.0
    way = path[-1, :2] - path[0, :2]
    camera.azimuth = 130.0 + np.rad2deg(np.arctan2(way[1], way[0]))
    width = max(round(motion.fps), 1)
    pad = np.pad(path, ((width, width), (0, 0)), mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(pad, 2 * width + 1, axis=0)
    smooth = smooth.mean(axis=-1)
    with contextlib.closing(renderer):
        for frame in range(0, len(path), every):
            data.qpos[:] = motion.qpos[frame]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            camera.lookat[:] = smooth[frame] - [0, 0, 0.1 * motion.robot.rest.leg]
            renderer.update_scene(data, camera)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
            yield renderer.render()


def _stage(robot: Robot) -> Any:
    """The model on a chequered ground, lit."""
    mujoco, _ = packages()
    path = Path(robot.name)
    spec = robots.load(path)
    spec.add_texture(
        name=MARK + "ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.9, 0.92, 0.94],
        rgb2=[0.78, 0.81, 0.85],
        width=300,
        height=300,
    )
    spec.add_texture(
        name=MARK + "sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0.96, 0.97, 0.98],
        rgb2=[0.96, 0.97, 0.98],
        width=8,
        height=8,
    )
    ground = spec.add_material(name=MARK + "ground", texrepeat=[1, 1], texuniform=True)
    ground.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = MARK + "ground"
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        material=MARK + "ground",
        contype=0,
        conaffinity=0,
    )
    for light in spec.lights:
        light.active = False
    spec.body(robot.body_names[0]).add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[0, 0, 2],
        dir=[0.3, 0.4, -1.0],
        diffuse=[0.35, 0.35, 0.35],
        specular=[0.1, 0.1, 0.1],
    )
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    # A deep shadow map: in a tight one the ground shades itself in specks.
    spec.visual.quality.shadowsize, spec.visual.map.shadowclip = 4096, 4.0
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.stat.extent = 2.0 * robot.rest.leg
    return robots.compiled(path, spec)
