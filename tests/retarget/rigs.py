"""Rigs of others that nobody made: our mannequin as their files have it."""

import dataclasses
import json
import struct

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxmotion.data.walker import walker_skeleton
from jaxmotion.export import gltf
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.retarget import roles as names

# Lengths of legs, arms and trunk beside the walker's.
BODIES = {
    "child": (0.62, 0.6, 0.72),
    "giant": (1.5, 1.45, 1.5),
    "long arms": (0.9, 1.5, 1.05),
}


def proportioned(legs=1.0, arms=1.0, trunk=1.0, skeleton=None):
    """A skeleton with limbs of other lengths."""
    skeleton = skeleton or walker_skeleton()
    found = anatomy.find_anatomy(skeleton)
    scale = np.full(skeleton.num_joints, trunk)
    for limbs, size in ((found.legs, legs), (found.arms, arms)):
        for limb in limbs:
            for joint in range(skeleton.num_joints):
                above = anatomy.chain(skeleton.parents, joint)
                if limb.upper in above and joint != limb.upper:
                    scale[joint] = size
    offsets = np.asarray(skeleton.offsets) * scale[:, None]
    return dataclasses.replace(skeleton, offsets=jnp.asarray(offsets, jnp.float32))


def named(skeleton, convention):
    """The walker's joints in the words of a tool."""
    words = CONVENTIONS[convention]
    return dataclasses.replace(skeleton, names=tuple(words))


_T = ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")
_AM = ("Shoulder", "Arm", "ForeArm", "Hand")
_LM = ("UpLeg", "Leg", "Foot", "ToeBase")


def _sided(pattern, words, sides):
    return [pattern.format(s, w) for s in sides for w in words]


def _names(trunk, pattern, arms, legs, sides):
    return [*trunk, *_sided(pattern, arms, sides), *_sided(pattern, legs, sides)]


CONVENTIONS = {
    "Mixamo": [
        f"mixamorig:{n}" for n in _names(_T, "{}{}", _AM, _LM, ("Left", "Right"))
    ],
    "Mixamo without colon": [
        f"mixamorig{n}" for n in _names(_T, "{}{}", _AM, _LM, ("Left", "Right"))
    ],
    "HumanIK": [
        f"Character1_{n}" for n in _names(_T, "{}{}", _AM, _LM, ("Left", "Right"))
    ],
    "Unreal": _names(
        ("pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head"),
        "{1}_{0}",
        ("clavicle", "upperarm", "lowerarm", "hand"),
        ("thigh", "calf", "foot", "ball"),
        ("l", "r"),
    ),
    "VRoid": _names(
        [
            f"J_Bip_C_{n}"
            for n in ("Hips", "Spine", "Chest", "UpperChest", "Neck", "Head")
        ],
        "J_Bip_{}_{}",
        ("Shoulder", "UpperArm", "LowerArm", "Hand"),
        ("UpperLeg", "LowerLeg", "Foot", "ToeBase"),
        ("L", "R"),
    ),
    "VRM": _names(
        ("hips", "spine", "chest", "upperChest", "neck", "head"),
        "{}{}",
        ("Shoulder", "UpperArm", "LowerArm", "Hand"),
        ("UpperLeg", "LowerLeg", "Foot", "Toes"),
        ("left", "right"),
    ),
    "SMPL": _names(
        ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
        "{}_{}",
        ("collar", "shoulder", "elbow", "wrist"),
        ("hip", "knee", "ankle", "foot"),
        ("left", "right"),
    ),
    "CMU": _names(
        ("root", "lowerback", "upperback", "thorax", "upperneck", "head"),
        "{}{}",
        ("clavicle", "humerus", "radius", "wrist"),
        ("femur", "tibia", "foot", "toes"),
        ("l", "r"),
    ),
    "LaFAN1": _names(
        _T, "{}{}", _AM, ("UpLeg", "Leg", "Foot", "Toe"), ("Left", "Right")
    ),
    "Bandai Namco": _names(
        ("Hips", "Spine", "Chest", "Chest2", "Neck", "Head"),
        "{1}_{0}",
        ("Shoulder", "UpperArm", "LowerArm", "Hand"),
        ("UpperLeg", "LowerLeg", "Foot", "Toes"),
        ("L", "R"),
    ),
    "O3DE": _names(
        [
            f"C_{n}_JNT"
            for n in ("pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head")
        ],
        "{}_{}_JNT",
        ("clavicle", "uparm", "loarm", "hand"),
        ("upleg", "loleg", "foot", "ball"),
        ("l", "r"),
    ),
    "3ds Max": _names(
        [f"Bip01 {n}" for n in ("Pelvis", "Spine", "Spine1", "Spine2", "Neck", "Head")],
        "Bip01 {} {}",
        ("Clavicle", "UpperArm", "Forearm", "Hand"),
        ("Thigh", "Calf", "Foot", "Toe0"),
        ("L", "R"),
    ),
    "Blender": _names(
        ("spine", "spine.001", "spine.002", "spine.003", "spine.004", "spine.006"),
        "{1}.{0}",
        ("shoulder", "upper_arm", "forearm", "hand"),
        ("thigh", "shin", "foot", "toe"),
        ("L", "R"),
    ),
    "Daz": _names(
        ("hip", "abdomenLower", "abdomenUpper", "chestUpper", "neckLower", "head"),
        "{}{}",
        ("Collar", "ShldrBend", "ForearmBend", "Hand"),
        ("ThighBend", "Shin", "Foot", "Toe"),
        ("l", "r"),
    ),
    "Unitree": _names(
        ("pelvis", "waist_yaw_link", "waist_roll_link", "torso_link", "neck", "head"),
        "{}_{}_link",
        ("shoulder_pitch", "shoulder_yaw", "elbow", "wrist_yaw"),
        ("hip_yaw", "knee", "ankle_pitch", "toe"),
        ("left", "right"),
    ),
}


def still(skeleton, frames=1, fps=30.0):
    """A motion that stays in the zero pose."""
    columns = np.zeros((frames, skeleton.num_joints, 6), np.float32)
    columns[..., 0] = columns[..., 4] = 1.0
    return Motion(
        root_position=jnp.zeros((frames, 3)),
        joint_rotation=jnp.asarray(columns),
        fps=fps,
    )


def split(raw):
    """JSON and bytes of a .glb."""
    size = struct.unpack_from("<I", raw, 12)[0]
    return json.loads(raw[20 : 20 + size]), bytearray(raw[28 + size :])


def joined(content, data):
    """A .glb of JSON and bytes."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    content["buffers"] = [{"byteLength": len(data)}]
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(data), b"BIN\0") + bytes(data)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def glb(skeleton, *, arms_down=45.0, seed=0, unit=100.0, turn=90.0):
    """A rig as artists' tools write it.

    Its rest pose is an A, joints have axes of their own, and an armature of the scale
    1 / unit, turned about x, is above it.
    """
    content, data = split(gltf.to_glb(skeleton, still(skeleton)))
    found = anatomy.find_anatomy(skeleton)
    count = skeleton.num_joints
    offsets = np.asarray(skeleton.offsets, float).copy()
    offsets[0] = content["nodes"][0]["translation"]
    draw = np.random.default_rng(seed)
    axes = Rotation.random(count, rng=draw).as_matrix()
    posed = np.tile(np.eye(3), (count, 1, 1))
    for arm in found.arms:
        sign = -1.0 if arm.side == anatomy.LEFT else 1.0
        angle = np.deg2rad(sign * arms_down)
        about = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        for joint in range(count):
            if arm.upper in anatomy.chain(skeleton.parents, joint):
                posed[joint] = about
    armature = Rotation.from_euler("x", -turn, degrees=True)
    for joint, parent in enumerate(skeleton.parents):
        own = posed[joint] @ axes[joint]
        above = posed[parent] @ axes[parent] if parent >= 0 else armature.as_matrix()
        node = content["nodes"][joint]
        move = axes[parent].T @ offsets[joint] if parent >= 0 else above.T @ offsets[0]
        node["translation"] = (unit * move).tolist()
        node["rotation"] = Rotation.from_matrix(above.T @ own).as_quat().tolist()
    # Inverse binds: into the joints' own axes and units.
    accessor = content["accessors"][content["skins"][0]["inverseBindMatrices"]]
    start = content["bufferViews"][accessor["bufferView"]]["byteOffset"]
    bind = np.frombuffer(data, "<f4", 16 * count, start).reshape(count, 4, 4)
    bind = np.swapaxes(bind, 1, 2).astype(float)
    turned = np.tile(np.eye(4), (count, 1, 1))
    turned[:, :3, :3] = unit * np.swapaxes(axes, 1, 2)
    bind = np.swapaxes(turned @ bind, 1, 2)
    bind[:, 3, 3], bind[:, :3, 3] = 1.0, 0.0
    data[start : start + 64 * count] = bind.astype("<f4").tobytes()
    content["nodes"].append(
        {
            "name": "Armature",
            "children": [0],
            "rotation": armature.as_quat().tolist(),
            "scale": [1 / unit] * 3,
        }
    )
    content["scenes"][0]["nodes"] = [count, count + 1]
    content["skins"][0].pop("skeleton", None)
    content["extras"] = {"made": "in the tests"}
    _bind(content, data)
    return joined(content, data)


def values(content, data, number):
    """An accessor's values [count, width], of which changes are kept."""
    accessor = content["accessors"][number]
    kind = {5121: "u1", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
    width = {"VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
    view = content["bufferViews"][accessor["bufferView"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    assert "byteStride" not in view
    found = np.frombuffer(data, kind, width * accessor["count"], start)
    return found.reshape(-1, width)


def _bind(content, data):
    """Binds the mesh in the pose in which the nodes stand."""
    nodes, skin = content["nodes"], content["skins"][0]
    world = []
    for joint in skin["joints"]:
        at = np.eye(4)
        for node in _up(nodes, joint):
            at = _matrix(nodes[node]) @ at
        world.append(at)
    bind = values(content, data, skin["inverseBindMatrices"])
    moves = np.array(world) @ np.swapaxes(bind.reshape(-1, 4, 4), 1, 2)
    for part in content["meshes"][0]["primitives"]:
        get = lambda name: values(content, data, part["attributes"][name])  # noqa: B023, E731
        which, weights = get("JOINTS_0"), get("WEIGHTS_0")
        mixed = np.einsum("vk,vkrc->vrc", weights, moves[which])
        for name, last in (("POSITION", 1.0), ("NORMAL", 0.0)):
            rows = get(name)
            four = np.concatenate([rows, np.full((len(rows), 1), last)], axis=1)
            placed = np.einsum("vrc,vc->vr", mixed, four)[:, :3]
            if not last:
                placed /= np.linalg.norm(placed, axis=1, keepdims=True)
            rows[:] = placed
        accessor = content["accessors"][part["attributes"]["POSITION"]]
        places = get("POSITION").astype(float)
        accessor |= {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    back = np.swapaxes(np.linalg.inv(world), 1, 2).reshape(-1, 16)
    back[:, 3::4] = np.array([0, 0, 0, 1])
    bind[:] = back


def posed(raw, spread=12.0, seed=0):
    """The same file, saved in a frame of an animation: its nodes stand anyhow."""
    content, data = split(raw)
    draw, nodes = np.random.default_rng(seed), content["nodes"]
    for number, joint in enumerate(content["skins"][0]["joints"]):
        turn = Rotation.from_rotvec(np.radians(spread) * draw.normal(size=3))
        own = Rotation.from_quat(nodes[joint]["rotation"]) * turn
        nodes[joint]["rotation"] = own.as_quat().tolist()
        if number == 0:
            nodes[joint]["translation"] = (
                1.1 * np.array(nodes[joint]["translation"]) + 0.3
            ).tolist()
    return joined(content, data)


def person(name="child", convention="Mixamo"):
    """A skeleton of other proportions with the names of a convention."""
    return named(proportioned(*BODIES[name]), convention)


def walker():
    return walker_skeleton()


def plain(offsets, parents, words):
    return Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32), parents=tuple(parents), names=words
    )


def loose():
    """A rig of Blender of which only the joints that deform were written.

    Limbs hang on the root, on the ground, and not on the spine, which does, too.
    """
    base = person("child", "Blender")
    places, _ = anatomy.kinematics(base, still(base))
    found = anatomy.find_anatomy(base)
    tops = [(*limb.before, limb.upper)[0] for limb in (*found.arms, *found.legs)]
    tops += [0]
    parents = [0 if j in tops else up + 1 for j, up in enumerate(base.parents)]
    offsets = np.asarray(base.offsets).copy()
    low = np.array([0.0, places[0, :, 1].min(), 0.0])
    offsets[tops] = places[0, tops] - low
    return plain([[0, 0, 0], *offsets.tolist()], (-1, *parents), ("root", *base.names))


def forked(name="child", convention="Unreal"):
    """A person whose legs and arms hang on joints beside the spine, and `person`'s own.

    So are those of Character Creator and Daz; the joints are at their parents' places.
    """
    base = person(name, convention)
    words = ("CC_Base_Hip", *base.names[1:], base.names[0], "CC_Base_Shoulders")
    parents, offsets = list(base.parents), np.asarray(base.offsets).tolist()
    found = anatomy.find_anatomy(base)
    for limbs in (found.legs, found.arms):
        up = parents[limbs[0].first]
        for limb in limbs:
            parents[limb.first] = len(parents)
        parents.append(up)
        offsets.append([0.0, 0.0, 0.0])
    tree = tuple(parents)
    order = sorted(range(len(tree)), key=lambda j: len(anatomy.chain(tree, j)))
    return base, plain(
        [offsets[j] for j in order],
        [order.index(parents[j]) if parents[j] >= 0 else -1 for j in order],
        tuple(words[j] for j in order),
    )


def vrm(raw, version="VRMC_vrm", *, skin=True):
    """A .glb as a VRM whose joints' names say nothing: its extension says all.

    Without a skin, the body as it stands hangs on the hips.
    """
    content, data = split(raw)
    index = {node["name"]: n for n, node in enumerate(content["nodes"])}
    joints = content["skins"][0]["joints"]
    tree = plain(
        np.zeros((len(joints), 3)),
        _parents(content["nodes"], joints),
        tuple(content["nodes"][j]["name"] for j in joints),
    )
    told = names.find_roles(tree)
    bones = {role: {"node": index[name]} for role, name in told.items()}
    if not skin:
        mesh = next(n for n in content["nodes"] if "mesh" in n).pop("mesh")
        hips, at = bones["hips"]["node"], np.eye(4)
        for node in _up(content["nodes"], hips):
            at = _matrix(content["nodes"][node]) @ at
        content["nodes"][hips]["children"].append(len(content["nodes"]))
        back = np.linalg.inv(at).T.ravel().tolist()
        content["nodes"].append({"name": "body", "mesh": mesh, "matrix": back})
        del content["skins"]
        for node in content["nodes"]:
            node.pop("skin", None)
    for number, node in enumerate(content["nodes"]):
        node["name"] = f"n{number}"
    listed = [{"bone": bone, **about} for bone, about in bones.items()]
    human = bones if version == "VRMC_vrm" else listed
    content["extensions"] = {version: {"humanoid": {"humanBones": human}}}
    return joined(content, data)


def _up(nodes, node):
    """From a node to the root."""
    above = {c: n for n, have in enumerate(nodes) for c in have.get("children", ())}
    found = [node]
    while found[-1] in above:
        found.append(above[found[-1]])
    return found


def _parents(nodes, joints):
    return [
        next((joints.index(n) for n in _up(nodes, joint)[1:] if n in joints), -1)
        for joint in joints
    ]


def _matrix(node):
    found = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    found[:3, :3] = turn * node.get("scale", [1, 1, 1])
    found[:3, 3] = node.get("translation", [0, 0, 0])
    return found


def fbx(skeleton):
    """An FBX (text, centimeters) of bones in their zero pose, without animation."""
    objects, links = [], []
    for j, (name, parent) in enumerate(
        zip(skeleton.names, skeleton.parents, strict=True)
    ):
        x, y, z = 100.0 * np.asarray(skeleton.offsets, float)[j]
        objects.append(
            f'NodeAttribute: {1000 + j}, "NodeAttribute::", "LimbNode" '
            '{\n TypeFlags: "Skeleton"\n}\n'
            f'Model: {j + 1}, "Model::{name}", "LimbNode" {{\n Version: 232\n'
            ' Properties70: {\n  P: "Lcl Translation", "Lcl Translation", "", "A",'
            f"{x},{y},{z}\n }}\n}}"
        )
        links.append(f'C: "OO",{1000 + j},{j + 1}\nC: "OO",{j + 1},{parent + 1}')
    return "\n".join(
        [
            "; FBX 7.4.0 project file",
            "FBXHeaderExtension: {\n FBXVersion: 7400\n}",
            'GlobalSettings: {\n Version: 1000\n Properties70: {\n  P: "UpAxis",'
            ' "int", "Integer", "",1\n  P: "UnitScaleFactor", "double", "Number",'
            ' "",1\n }\n}',
            "Objects: {\n" + "\n".join(objects) + "\n}",
            "Connections: {\n" + "\n".join(links) + "\n}\n",
        ]
    ).encode()
