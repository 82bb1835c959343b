"""Humanoid robots of MJCF and URDF files, as persons that `transfer` knows.

Where several axes nearly meet is one joint of a person: hip, ankle, shoulder, wrist.
Feet are rigid and roll about their front edge.

Worlds: ours has y up and characters that start facing +z; MuJoCo's z up, facing +x.
"""

import contextlib
import dataclasses
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion import files
from jaxmotion.motion import anatomy
from jaxmotion.motion.anatomy import LEFT, RIGHT
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.retarget import roles as names
from jaxmotion.retarget import transfer
from jaxmotion.retarget.transfer import Rest

# Ours to MuJoCo's world: x ahead, y to the left, z up.
WORLD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# What of a foot's geometry counts as its sole, over its lowest point, meters.
_SOLE = 0.015
# How far knees bend at least, radians: beyond straight is another solution.
_BENT = 0.1
# What angles that are not the zero pose's cost (1/rad): wrists are left as they are.
_POSTURE, _WRIST = 0.01, 0.5
# Before the names of what is added to a model.
MARK = "jaxmotion:"


def packages() -> tuple[ModuleType, ModuleType]:
    """MuJoCo, mink; `ModuleNotFoundError` without [robot], `ValueError` if broken."""
    try:
        import mink
        import mujoco
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            'robots need the packages mujoco and mink: pip install -e ".[robot]"'
        ) from None
    except Exception as error:  # an OpenGL that MUJOCO_GL names and is not here
        raise ValueError(
            f"MuJoCo cannot be loaded ({one_line(error)}); its variable MUJOCO_GL is "
            f"{os.environ.get('MUJOCO_GL', '')!r}, perhaps it should be 'disable'"
        ) from None
    return mujoco, mink


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Foot:
    """A rigid foot as balls around points: those of its geometry that are lowest.

    Centers [n, 3] are from the ankle in the zero pose, our axes; radii [n]; meters.
    """

    centers: np.ndarray
    radii: np.ndarray

    def lowest(self, ankle: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Height of the sole [...] for ankles [..., 3] and turns [..., 3, 3]."""
        heights = np.einsum("...k,nk->...n", turn[..., 1, :], self.centers)
        return ankle[..., 1] + (heights - self.radii).min(axis=-1)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """A humanoid of MuJoCo's.

    Attributes:
      model: MuJoCo's, with a site for each role.
      rest: As a person of hips, chest, head and limbs of two bones.
      bodies: The body that each role moves.
      joints: Its joints but the free one, in MuJoCo's order.
      tree: Its bodies, the free one first.
      free: Index of the free joint.
      axes: Its left, up and ahead in MuJoCo's world in the zero pose, as columns.
      speeds: Largest of each joint that the file states, rad/s or m/s; else infinite.
      used: [joints, 2] what of its limits is used: knees bend, if ever so little.
      apart: Pairs of geometries that the limits keep apart: of forearms and hands, and
        of trunk and legs.
      costs: [nv] of angles that are not the zero pose's: wrists are left as they are.
    """

    name: str
    model: Any
    rest: Rest
    bodies: dict[str, int]
    feet: tuple[Foot, Foot]
    joints: np.ndarray
    tree: np.ndarray
    free: int
    axes: np.ndarray
    speeds: np.ndarray
    used: np.ndarray
    apart: list[tuple[list[int], list[int]]]
    costs: np.ndarray

    @property
    def joint_names(self) -> tuple[str, ...]:
        """In MuJoCo's order, without the free joint."""
        return tuple(self.model.joint(int(j)).name for j in self.joints)

    @property
    def body_names(self) -> tuple[str, ...]:
        """In MuJoCo's order, without the world."""
        return tuple(self.model.body(int(b)).name for b in self.tree)

    @property
    def limits(self) -> np.ndarray:
        """[joints, 2] least and largest value of each; infinite for none."""
        return _limits(self.model, self.joints)

    @property
    def columns(self) -> np.ndarray:
        """Where each joint is in a state's qpos."""
        return self.model.jnt_qposadr[self.joints]


def one_line(error: Exception) -> str:
    return re.sub(r"\s+", " ", str(error)).strip()[:300]


def load(path: Path) -> Any:
    """MuJoCo's editable model of a file; a URDF gets the free joint that it lacks."""
    mujoco, _ = packages()
    text = files.read_bytes(path)
    try:
        text.decode()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: no MJCF or URDF: not text in UTF-8") from None
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except Exception as error:
        raise ValueError(
            f"{path}: MuJoCo reads no MJCF or URDF ({one_line(error)})"
        ) from None
    if re.search(rb"<robot[\s>]", text):
        tops = list(spec.worldbody.bodies)
        if len(tops) == 1 and not list(tops[0].joints):
            tops[0].add_freejoint()
    return spec


def compiled(path: Path, spec: Any) -> Any:
    try:
        model = spec.compile()
    except Exception as error:
        raise ValueError(
            f"{path}: MuJoCo cannot build the model ({one_line(error)})"
        ) from None
    numbers = (model.qpos0, model.body_pos, model.body_quat, model.jnt_axis)
    if not all(np.isfinite(x).all() and (np.abs(x) < 1e3).all() for x in numbers):
        raise ValueError(f"{path}: numbers that are not finite, or beyond 1,000")
    return model


def _free_tree(path: Path, model: Any) -> tuple[int, list[int]]:
    """The free joint that has most bodies, and these."""
    mujoco, _ = packages()
    kinds = [mujoco.mjtJoint(int(k)).name[6:].lower() for k in model.jnt_type]
    trees = {}
    for joint in (j for j, kind in enumerate(kinds) if kind == "free"):
        top = model.jnt_bodyid[joint]
        trees[joint] = [
            b for b in range(model.nbody) if top in _path(model.body_parentid, b)
        ]
    if not trees:
        raise ValueError(
            f"{path}: no free joint: expected a robot that can walk, found "
            f"{model.nbody - 1} bodies that are fixed to the world"
        )
    free = max(trees, key=lambda joint: len(trees[joint]))
    for joint, kind in enumerate(kinds):
        if model.jnt_bodyid[joint] in trees[free] and kind == "ball":
            raise ValueError(
                f"{path}: joint {model.joint(joint).name!r} is a ball, expected hinges "
                "and slides"
            )
    return free, trees[free]


def _path(parents: np.ndarray, body: int) -> list[int]:
    """Bodies from the one below the world to one."""
    found = [body]
    while parents[found[-1]] > 0:
        found.append(int(parents[found[-1]]))
    return found[::-1]


@dataclasses.dataclass(frozen=True, eq=False)
class _Zero:
    """The zero pose in our axes: places [body, 3], axes and anchors [joint, 3].

    `axes` has left, up and ahead in MuJoCo's world as columns.
    """

    model: Any
    data: Any
    tree: list[int]
    axes: np.ndarray

    @property
    def places(self) -> np.ndarray:
        return self.data.xpos @ self.axes

    def joints(self, above: int, body: int) -> list[int]:
        """Joints on the way from one body, exclusive, to another."""
        way = _path(self.model.body_parentid, body)
        way = way[way.index(above) + 1 :] if above in way else way
        return [j for j in range(self.model.njnt) if self.model.jnt_bodyid[j] in way]

    def center(self, joints: list[int], near: np.ndarray) -> np.ndarray:
        """The point nearest to all axes, and among several nearest to another point."""
        total, side = 1e-6 * np.eye(3), 1e-6 * near
        for joint in joints:
            axis = self.data.xaxis[joint] @ self.axes
            across = np.eye(3) - np.outer(axis, axis)
            total = total + across
            side = side + across @ (self.data.xanchor[joint] @ self.axes)
        return np.linalg.solve(total, side)


def zero_pose(model: Any, tree: list[int], axes: np.ndarray) -> _Zero:
    mujoco, _ = packages()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return _Zero(model, data, tree, axes)


def skeleton_of_bodies(
    model: Any, tree: list[int], places: np.ndarray, *, hands: bool
) -> Skeleton:
    """Bodies as joints; with hands where a forearm is all in one."""
    titles, parents = [], []
    for body in tree:
        title = model.body(body).name or f"body {body}"
        titles.append(title)
        parents.append(-1 if body == tree[0] else tree.index(model.body_parentid[body]))
    offsets = places[tree] - places[[model.body_parentid[b] for b in tree]]
    offsets = offsets.tolist()
    for number, title in enumerate(list(titles)):
        side = anatomy.side_of(title)
        words = re.search(r"elbow|fore_?arm|lower_?arm", title, re.IGNORECASE)
        if hands and words and side != anatomy.MIDDLE and number not in parents:
            titles.append(f"{title}:{side}_hand")
            parents.append(number)
            offsets.append([0.0, -0.2, 0.0])
    return Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=tuple(parents),
        names=tuple(titles),
    )


def _balls(
    model: Any, data: Any, bodies: list[int], axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Balls [n, 3], [n] in our axes that hold what the bodies touch with."""
    mujoco, _ = packages()
    kind = mujoco.mjtGeom
    own = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
    touching = [g for g in own if model.geom_contype[g] or model.geom_conaffinity[g]]
    centers, radii = [], []
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around), 0 * around], axis=-1)
    for geom in touching or own:
        size, radius = model.geom_size[geom], 0.0
        shape = kind(int(model.geom_type[geom]))
        if shape in (kind.mjGEOM_SPHERE, kind.mjGEOM_CAPSULE):
            points = np.array([[0, 0, -1.0], [0, 0, 1.0]]) * size[1]
            points = points[:1] * 0 if shape == kind.mjGEOM_SPHERE else points
            radius = size[0]
        elif shape == kind.mjGEOM_BOX:
            points = size * (np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1)
        elif shape == kind.mjGEOM_CYLINDER:
            points = np.concatenate(
                [ring * size[0] + [0, 0, side * size[1]] for side in (-1, 1)]
            )
        elif shape == kind.mjGEOM_ELLIPSOID:
            rise = np.linspace(-1, 1, 9)[:, None, None]
            flat = ring * np.sqrt(1 - rise**2) + rise * [0, 0, 1]
            points = flat.reshape(-1, 3) * size
        elif shape == kind.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            start = model.mesh_vertadr[mesh]
            points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
        else:
            continue
        turn = data.geom_xmat[geom].reshape(3, 3)
        centers.append((data.geom_xpos[geom] + points @ turn.T) @ axes)
        radii.append(np.full(len(points), radius))
    if not centers:
        return np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(centers), np.concatenate(radii)


def capsules(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the bodies are like: joints [n] of `as_skeleton`, ends [n, 2, 3], radii [n].

    One for each body that has a shape, in our axes from the body's own place.
    """
    zero = zero_pose(robot.model, robot.tree.tolist(), robot.axes)
    joints, ends, sizes = [], [], []
    for number, body in enumerate(zero.tree):
        points, radii = _balls(robot.model, zero.data, [body], robot.axes)
        if not len(points):
            continue
        points = points - zero.places[body]
        middle = points.mean(axis=0)
        axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
        along = (points - middle) @ axis
        away = np.linalg.norm(points - middle - along[:, None] * axis, axis=-1)
        size = max(float(np.percentile(away, 80) + radii.mean()), 0.005)
        span = np.array([(along - radii).min() + size, (along + radii).max() - size])
        span = span if span[0] < span[1] else np.full(2, span.mean())
        joints.append(number)
        ends.append(middle + span[:, None] * axis)
        sizes.append(size)
    return np.array(joints), np.array(ends), np.array(sizes)


def _limits(model: Any, joints: np.ndarray) -> np.ndarray:
    found = model.jnt_range[joints].copy()
    found[model.jnt_limited[joints] == 0] = [-np.inf, np.inf]
    return found


def _used(
    zero: _Zero,
    bodies: dict[str, int],
    points: dict[str, np.ndarray],
    joints: np.ndarray,
) -> np.ndarray:
    """Limits [joints, 2] within which the knees bend."""
    found = _limits(zero.model, joints)
    for side in (LEFT, RIGHT):
        hip, knee, ankle = (
            points[side + part] for part in ("UpperLeg", "LowerLeg", "Foot")
        )
        own = [
            n
            for n, j in enumerate(joints)
            if zero.model.jnt_bodyid[j] == bodies[side + "LowerLeg"]
        ]
        axes = zero.data.xaxis[joints] @ zero.axes
        n = max(own, key=lambda n: abs(axes[n, 0]))
        # Whether a positive angle takes the ankle back, and the bend of the zero pose.
        sign = -np.sign(np.cross(axes[n], ankle - knee)[2])
        lean = [np.arctan2(bone[2], -bone[1]) for bone in (knee - hip, ankle - knee)]
        least = _BENT - (lean[0] - lean[1])
        low, high = found[n] * sign if sign > 0 else found[n][::-1] * sign
        if low < least < high - 0.5:
            found[n] = np.sort(sign * np.array([least, high]))
    return found


def _apart(zero: _Zero, moved: dict[str, int]) -> list[tuple[list[int], list[int]]]:
    """Pairs of geometries that arms could push into each other and do not at rest."""
    mujoco, _ = packages()
    model = zero.model
    arms = [moved[side + "LowerArm"] for side in (LEFT, RIGHT)]
    upper = [moved[side + "UpperArm"] for side in (LEFT, RIGHT)]
    own: dict[str, list[int]] = {"arms": [], "rest": []}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        way = _path(model.body_parentid, body)
        solid = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if not solid or body not in zero.tree or model.geom_rbound[geom] <= 0:
            continue
        if {*arms} & {*way}:
            own["arms"].append(geom)
        elif not {*upper} & {*way}:
            own["rest"].append(geom)
    found = []
    for arm in own["arms"]:
        near = [
            geom
            for geom in own["rest"]
            if mujoco.mj_geomDistance(model, zero.data, arm, geom, 1.0, None) > 0.005
        ]
        if near:
            found.append(([arm], near))
    return found


def _velocities(path: Path, model: Any, joints: np.ndarray) -> np.ndarray:
    """What a URDF's limits and MJCF's velocity servos state, rad/s; else infinite."""
    mujoco, _ = packages()
    found = np.full(len(joints), np.inf)
    told = {}
    text = files.read_bytes(path)
    if re.search(rb"<robot[\s>]", text):
        for joint in ElementTree.fromstring(text).iter("joint"):
            limit = joint.find("limit")
            with contextlib.suppress(TypeError, ValueError, AttributeError):
                told[joint.get("name")] = float(limit.get("velocity"))  # pyright: ignore
    for n, joint in enumerate(joints):
        speed = told.get(model.joint(int(joint)).name, 0.0)
        found[n] = speed if 0 < speed < np.inf else np.inf
    for a in range(model.nu):
        bias, joint = model.actuator_biasprm[a], model.actuator_trnid[a, 0]
        servo = (
            int(model.actuator_trntype[a]) == int(mujoco.mjtTrn.mjTRN_JOINT)
            and int(model.actuator_biastype[a]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
            and bias[1] == 0 != bias[2]
        )
        gear = abs(model.actuator_gear[a, 0])
        if servo and model.actuator_ctrllimited[a] and joint in joints and gear > 0:
            n = int(np.flatnonzero(joints == joint)[0])
            found[n] = np.abs(model.actuator_ctrlrange[a]).max() / gear
    return found


def read_robot(
    path: str | Path, roles: Mapping[str, str] | str | Path | None = None
) -> Robot:
    """A humanoid of an MJCF or URDF file.

    Bodies of some roles may be given, or a JSON file of them; see `roles.find_roles`.
    `ModuleNotFoundError` without the extra [robot]; a `ValueError` names a file that
    MuJoCo cannot read, that has no free joint, or whose bodies are no person's that
    stands in the zero pose.
    """
    path = Path(path)
    mujoco, _ = packages()
    spec = load(path)
    model = compiled(path, spec)
    free, tree = _free_tree(path, model)
    try:
        bodies, axes = _roles(model, tree, roles)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    zero = zero_pose(model, tree, axes)
    data = zero.data
    points, moved, feet = _person(path, zero, bodies)
    rest = _rest(path, points, feet)
    # Sites do not change the numbers of bodies and joints; bodies need no names.
    by_number = {one.id: one for one in spec.bodies}
    for role, body in moved.items():
        turn = data.xmat[body].reshape(3, 3)
        place = axes @ points[role] - data.xpos[body]
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, (turn.T @ axes).ravel())
        by_number[body].add_site(name=MARK + role, pos=turn.T @ place, quat=quat)
    model = compiled(path, spec)
    joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in tree and j != free]
    joints = np.array(joints)
    costs = np.full(model.nv, _POSTURE)
    for side in (LEFT, RIGHT):
        wrist = zero.joints(moved[side + "LowerArm"], moved[side + "Hand"])
        costs[model.jnt_dofadr[wrist]] = _WRIST
    return Robot(
        name=str(path),
        model=model,
        rest=rest,
        bodies=moved,
        feet=feet,
        joints=joints,
        tree=np.array(tree),
        free=free,
        axes=axes,
        speeds=_velocities(path, model, joints),
        used=_used(zero, bodies, points, joints),
        apart=_apart(zero, moved),
        costs=costs,
    )


def _roles(
    model: Any, tree: list[int], given: Any
) -> tuple[dict[str, int], np.ndarray]:
    """The body of each role, and the robot's left, up and ahead in MuJoCo's world."""
    zero = zero_pose(model, tree, WORLD)
    places, data = zero.places, zero.data
    skeleton = skeleton_of_bodies(model, tree, places, hands=True)
    told = names.find_roles(skeleton, given)
    bodies = {}
    for role, name in told.items():
        number = skeleton.names.index(name)
        # A hand that is no body of its own.
        bodies[role] = (
            tree[min(number, skeleton.parents[number])]
            if (number >= len(tree))
            else tree[number]
        )
    apart = [
        data.xpos[bodies[LEFT + part]] - data.xpos[bodies[RIGHT + part]]
        for part in ("UpperLeg", "LowerLeg", "Foot")
    ]
    left = np.sum(apart, axis=0)
    left[2] = 0.0
    if np.linalg.norm(left) < 0.02:
        raise ValueError("its legs are not beside each other in the zero pose")
    left = left / np.linalg.norm(left)
    up = np.array([0.0, 0.0, 1.0])
    return bodies, np.stack([left, up, np.cross(left, up)], axis=-1)


def _person(
    path: Path, zero: _Zero, bodies: dict[str, int]
) -> tuple[dict[str, np.ndarray], dict[str, int], tuple[Foot, Foot]]:
    """Where the joints of a person are in the zero pose, what moves, and the feet."""
    places, model = zero.places, zero.model
    hips, chest = bodies["hips"], bodies["chest"]
    points: dict[str, np.ndarray] = {}
    moved: dict[str, int] = {}
    feet = []
    for side in (LEFT, RIGHT):
        for top, parts in (
            (hips, ("UpperLeg", "LowerLeg", "Foot")),
            (chest, ("UpperArm", "LowerArm", "Hand")),
        ):
            _, middle, end = (bodies[side + part] for part in parts)
            upper = int(model.body_parentid[middle])
            first = zero.joints(top, upper)
            bends = [j for j in zero.joints(top, middle) if j not in first]
            last = zero.joints(middle, end)
            if not first or not bends:
                raise ValueError(
                    f"{path}: no joint moves the "
                    f"{'lower' if first else 'upper'} part of the limb of {side} "
                    f"{parts[2].lower()}, expected hinges of hip and knee, shoulder "
                    "and elbow"
                )
            points[side + parts[0]] = zero.center(
                first, places[bodies[side + parts[0]]]
            )
            points[side + parts[1]] = zero.center(bends, places[middle])
            if end != middle:
                points[side + parts[2]] = zero.center(last, places[end])
            else:
                # The far end of what the forearm is made of.
                balls = _balls(model, zero.data, [end], zero.axes)[0]
                away = np.linalg.norm(balls - points[side + parts[1]], axis=-1)
                if not len(away) or away.max() < 0.02:
                    raise ValueError(
                        f"{path}: body {model.body(end).name!r} has no hand and no "
                        "shape, expected a forearm"
                    )
                points[side + parts[2]] = balls[away.argmax()]
            moved |= {
                side + parts[0]: upper,
                side + parts[1]: middle,
                side + parts[2]: end,
            }
        foot = bodies[side + "Foot"]
        below = [b for b in zero.tree if foot in _path(model.body_parentid, b)]
        centers, radii = _balls(model, zero.data, below, zero.axes)
        if not len(radii):
            raise ValueError(
                f"{path}: foot {model.body(foot).name!r} has no geometry, expected "
                "what it stands on"
            )
        low = centers[:, 1] - radii
        sole = low < low.min() + _SOLE
        feet.append(
            Foot(centers=centers[sole] - points[side + "Foot"], radii=radii[sole])
        )
    points["hips"] = 0.5 * (points["leftUpperLeg"] + points["rightUpperLeg"])
    moved["hips"] = hips
    if chest != hips:
        points["chest"] = zero.center(zero.joints(hips, chest), places[chest])
        moved["chest"] = chest
    head = bodies.get("head", chest)
    if head not in (chest, hips):
        points["head"] = zero.center(zero.joints(chest, head), places[head])
        moved["head"] = head
    return points, moved, (feet[0], feet[1])


def _rest(path: Path, points: dict[str, np.ndarray], feet: tuple[Foot, Foot]) -> Rest:
    """The robot as a person that `transfer` knows; raises if it does not stand."""
    points = dict(points)
    soles = []
    for side, foot in zip((LEFT, RIGHT), feet, strict=True):
        ankle = points[side + "Foot"]
        low = (foot.centers[:, 1] - foot.radii).min()
        ahead = (foot.centers[:, 2] + foot.radii).max()
        soles.append(-low)
        # The foot's front edge, about which it rolls.
        points[side + "Toes"] = ankle + [0.0, low, ahead]
        leg = points[side + "UpperLeg"] - ankle
        if not leg[1] > 0.8 * np.linalg.norm(leg) or ahead < 0.01 or not soles[-1] > 0:
            raise ValueError(
                f"{path}: expected a robot that stands on its feet in the zero pose, "
                f"found the {side} hip {np.round(leg, 2).tolist()} m (left, up, ahead) "
                f"from the ankle and the sole {soles[-1]:.2f} m below it"
            )
    above = {"chest": "hips", "head": "chest" if "chest" in points else "hips"}
    for side in (LEFT, RIGHT):
        above |= {side + "UpperLeg": "hips", side + "UpperArm": above["head"]}
        for upper, middle, end in (("UpperLeg", "LowerLeg", "Foot"),) + (
            ("UpperArm", "LowerArm", "Hand"),
        ):
            above |= {side + middle: side + upper, side + end: side + middle}
        above[side + "Toes"] = side + "Foot"
    order = [
        "hips",
        *(role for role in names.ROLES if role in points and role in above),
    ]
    skeleton = Skeleton(
        offsets=jnp.asarray(
            [np.zeros(3), *(points[r] - points[above[r]] for r in order[1:])],
            jnp.float32,
        ),
        parents=(-1, *(order.index(above[role]) for role in order[1:])),
        names=tuple(order),
    )
    given = {role: role for role in order}
    try:
        return transfer.rest(skeleton, given=given, sole=float(np.mean(soles)))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def front(rest: Rest, side: str) -> np.ndarray:
    """From the ankle to the middle of the foot's front edge."""
    toes, ankle = rest.joint(side + "Toes"), rest.joint(side + "Foot")
    return rest.turns[ankle].T @ (rest.places[toes] - rest.places[ankle])
