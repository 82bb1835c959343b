"""Rigged characters of others as binary glTF: their skeletons, and motion onto them.

A file is read as JSON and bytes, without a package; what is not known of it here
(materials, textures, extensions) is written back as it was. A rig's zero pose
is its nodes' rest pose, or that in which its mesh was bound, where the nodes stand in
another (many files are saved in a frame of an animation); joints' axes there are those
of the world.

Source: glTF 2.0 specification (Khronos), sections 3.5 to 3.7 and 4.4; VRM 0 and 1.
"""

import base64
import binascii
import copy
import dataclasses
import json
import re
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import jax.numpy as jnp
import numpy as np

from jaxmotion import files
from jaxmotion.motion.anatomy import chain, kinematics
from jaxmotion.motion.skeleton import MAX_METERS, Motion, Skeleton, check_skeleton
from jaxmotion.retarget import roles as names
from jaxmotion.retarget import transfer
from jaxmotion.retarget.transfer import Rest

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_FLOAT = 5126
# What pictures begin with.
_IMAGES = {
    "image/png": rb"\x89PNG\r\n\x1a\n",
    "image/jpeg": rb"\xff\xd8\xff",
    "image/webp": rb"RIFF....WEBP",
    "image/ktx2": rb"\xabKTX 20\xbb",
    "image/vnd-ms.dds": rb"DDS ",
}
MESHOPT = "EXT_meshopt_compression"
_MAX_NODES = 20_000
# Degrees: joints may stand so far from how a mesh was bound; turned farther on average,
# they are seen from another frame.
_POSED, _FAR = 2.0, 60.0
_SMOOTH = 0.3  # seconds: a root on the ground does not sway with the hips


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A rigged character.

    Attributes:
      name: Its file.
      content: The file's JSON.
      data: The bytes of its only buffer.
      skeleton: In the file's units, its zero pose the rest pose.
      nodes: Node of each joint.
      turns: World rotations [J, 3, 3] of the nodes at rest.
      above: [4, 4] what is above the root.
      roles: Of joints, as a VRM file says; else empty.
      sole: Ankles over the lowest vertex at rest; None where no mesh can be read.
    """

    name: str
    content: dict[str, Any]
    data: bytes
    skeleton: Skeleton
    nodes: tuple[int, ...]
    turns: np.ndarray
    above: np.ndarray
    roles: dict[str, str]
    sole: float | None

    def rest(self, roles: Any = None) -> Rest:
        """For `transfer.retarget`; for the roles see `roles.find_roles`."""
        try:
            given = self.roles if roles is None else roles
            return transfer.rest(self.skeleton, given=given, sole=self.sole)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None


def _chunks(name: str, raw: bytes) -> tuple[Any, bytes]:
    """JSON and bytes of a .glb, or the JSON of a .gltf."""
    if raw[:4] != b"glTF":
        text, data = raw, b""
    else:
        if len(raw) < 20 or struct.unpack_from("<I", raw, 4)[0] != 2:
            raise ValueError(f"{name}: expected binary glTF of version 2")
        size, kind = struct.unpack_from("<I4s", raw, 12)
        if kind != b"JSON" or 20 + size > len(raw):
            raise ValueError(f"{name}: the first chunk is {kind!r} of {size} bytes")
        text, data, at = raw[20 : 20 + size], b"", 20 + size
        if at + 8 <= len(raw):
            size, kind = struct.unpack_from("<I4s", raw, at)
            if kind == b"BIN\0":
                if at + 8 + size > len(raw):
                    raise ValueError(f"{name}: the second chunk is cut off")
                data = raw[at + 8 : at + 8 + size]
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError(f"{name}: no glTF: its JSON cannot be read") from None
    if not isinstance(content, dict):
        raise ValueError(f"{name}: no glTF: its JSON is no object")
    return content, data


def objects(name: str, content: dict, field: str) -> list[dict]:
    found = content.get(field, [])
    if not isinstance(found, list) or not all(isinstance(x, dict) for x in found):
        raise ValueError(f"{name}: {field!r} should be a list of objects")
    return found


def index(name: str, value: Any, count: int, what: str) -> int:
    if type(value) is not int or not 0 <= value < count:
        raise ValueError(f"{name}: {what} is {value!r}, expected in 0..{count - 1}")
    return value


def _one_buffer(name: str, content: dict, data: bytes) -> bytes:
    """All buffers as one, to which the views in `content` are made to point."""
    starts, whole = [], bytearray()
    for number, buffer in enumerate(objects(name, content, "buffers")):
        uri = buffer.get("uri")
        if uri is None:
            found = data
        else:
            found = linked(name, uri, f"buffer {number}")
        size = buffer.get("byteLength")
        if type(size) is not int or not 0 <= size <= len(found):
            raise ValueError(
                f"{name}: buffer {number} states {size!r} bytes, has {len(found)}"
            )
        whole += b"\0" * (-len(whole) % 4)
        starts.append(len(whole))
        whole += found[:size]
    for number, view in enumerate(objects(name, content, "bufferViews")):
        which = index(name, view.get("buffer"), len(starts), f"buffer of view {number}")
        offset = view.get("byteOffset", 0)
        if type(offset) is not int or offset < 0:
            raise ValueError(f"{name}: byteOffset of view {number} is {offset!r}")
        view |= {"buffer": 0, "byteOffset": offset + starts[which]}
    content["buffers"] = [{"byteLength": len(whole)}]
    return bytes(whole)


def linked(name: str, uri: Any, what: str) -> bytes:
    """What a uri of the file holds: base64, or the name of a file in its folder."""
    if not isinstance(uri, str):
        raise ValueError(f"{name}: uri of {what} is no text")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except (ValueError, binascii.Error):
            raise ValueError(f"{name}: {what} is no base64") from None
    beside = Path(unquote(uri))
    if beside.is_absolute() or ".." in beside.parts or ":" in uri:
        raise ValueError(f"{name}: {what} is outside of its folder")
    return files.read_bytes(Path(name).parent / beside)


def array(name: str, content: dict, data: bytes, number: Any) -> np.ndarray:
    """An accessor's values [count, width]."""
    accessors = objects(name, content, "accessors")
    number = index(name, number, len(accessors), "an accessor")
    accessor = accessors[number]
    kind, width = accessor.get("componentType"), accessor.get("type")
    kind = _TYPES.get(kind) if isinstance(kind, int) else None
    width = _WIDTHS.get(width) if isinstance(width, str) else None
    count = accessor.get("count")
    if kind is None or width is None or type(count) is not int or count < 0:
        raise ValueError(f"{name}: accessor {number} has an unknown type or count")
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError(f"{name}: accessor {number} is sparse or has no view")
    views = objects(name, content, "bufferViews")
    view = views[index(name, accessor["bufferView"], len(views), "a view")]
    size = np.dtype(kind).itemsize * width
    step, inner = view.get("byteStride", size), accessor.get("byteOffset", 0)
    if type(step) is not int or type(inner) is not int or step < size or inner < 0:
        raise ValueError(f"{name}: accessor {number} has a wrong stride or offset")
    start = view["byteOffset"] + inner
    end = start + step * (count - 1) + size if count else start
    if end > len(data):
        raise ValueError(f"{name}: accessor {number} ends beyond the buffer")
    if not count:
        return np.zeros((0, width))
    found = np.lib.stride_tricks.as_strided(
        np.frombuffer(data, "u1")[start:], (count, size), (step, 1)
    )
    values = np.ascontiguousarray(found).view(kind).reshape(count, width)
    if accessor.get("normalized") and values.dtype.kind in "iu":
        return values / np.iinfo(values.dtype).max
    with np.errstate(invalid="ignore"):
        return values.astype(float) if values.dtype.kind == "f" else values


def numbers(name: str, values: Any, count: int, what: str) -> np.ndarray:
    try:
        found = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.zeros(0)
    if found.shape != (count,) or not (np.abs(found) <= MAX_METERS).all():
        raise ValueError(f"{name}: {what} should be {count} numbers")
    return found


def _local(name: str, number: int, node: dict) -> np.ndarray:
    """Matrix [4, 4] of a node in its parent's frame."""
    what = f"of node {number}"
    if "matrix" in node:
        return numbers(name, node["matrix"], 16, f"matrix {what}").reshape(4, 4).T
    move = numbers(name, node.get("translation", [0, 0, 0]), 3, f"translation {what}")
    turn = numbers(name, node.get("rotation", [0, 0, 0, 1]), 4, f"rotation {what}")
    size = numbers(name, node.get("scale", [1, 1, 1]), 3, f"scale {what}")
    if not np.linalg.norm(turn) > 1e-6:
        raise ValueError(f"{name}: rotation {what} is zero")
    x, y, z, w = turn / np.linalg.norm(turn)
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, :3] *= size
    found[:3, 3] = move
    return found


def _rotation(name: str, number: int, matrix: np.ndarray) -> np.ndarray:
    """The turn of a world matrix that only moves, turns and scales evenly."""
    size = np.linalg.norm(matrix[:3, :3], axis=0)
    if not size.min() > 1e-9:
        raise ValueError(f"{name}: node {number} has the scale zero")
    turn = matrix[:3, :3] / size
    if (
        size.max() > 1.02 * size.min()
        or np.abs(turn.T @ turn - np.eye(3)).max() > 1e-2
        or np.linalg.det(turn) < 0
    ):
        raise ValueError(f"{name}: node {number} is mirrored, sheared or uneven")
    return turn


def parents_of(name: str, nodes: list[dict]) -> list[int]:
    """Parent of each node; -1 for none."""
    parents = [-1] * len(nodes)
    for number, node in enumerate(nodes):
        children = node.get("children", [])
        if not isinstance(children, list):
            raise ValueError(f"{name}: children of node {number} are no list")
        for child in children:
            child = index(name, child, len(nodes), f"a child of node {number}")
            if parents[child] >= 0:
                raise ValueError(f"{name}: node {child} has two parents")
            parents[child] = number
    for start in range(len(nodes)):
        seen, node = 0, start
        while node >= 0:
            node, seen = parents[node], seen + 1
            if seen > len(nodes):
                raise ValueError(f"{name}: node {start} is above itself")
    return parents


def _path(parents: list[int], node: int) -> list[int]:
    """From a node up to its root."""
    found = []
    while node >= 0:
        found.append(node)
        node = parents[node]
    return found


def world_of(name: str, nodes: list[dict], parents: list[int]) -> dict[int, np.ndarray]:
    """World matrix [4, 4] of each node at rest."""
    local = [_local(name, number, node) for number, node in enumerate(nodes)]
    world: dict[int, np.ndarray] = {}
    for number in range(len(nodes)):
        path_up, node = [], number
        while node >= 0 and node not in world:
            path_up.append(node)
            node = parents[node]
        for node in reversed(path_up):
            above = world[parents[node]] if parents[node] >= 0 else np.eye(4)
            world[node] = above @ local[node]
    return world


def _joints(name: str, content: dict, parents: list[int]) -> list[int]:
    """Nodes of the skeleton, parents first: the skins' joints and what joins them.

    A VRM without a skin, whose meshes hang on its bones, says itself what they are.
    """
    skins = objects(name, content, "skins")
    bones = [*_vrm_roles(content).values()]
    if not skins and not bones:
        raise ValueError(f"{name}: no skin: expected a character with a skeleton")
    paths: dict[int, list[int]] = {}
    for number, skin in enumerate(skins or [{"joints": bones}]):
        what = f"skin {number}" if skins else "the VRM"
        joints = skin.get("joints")
        if not isinstance(joints, list) or not joints:
            raise ValueError(f"{name}: {what} has no joints")
        for joint in joints:
            joint = index(name, joint, len(parents), f"a joint of {what}")
            paths[joint] = _path(parents, joint)[::-1]
    roots = {path[0] for path in paths.values()}
    if len(roots) > 1:
        said = f"{len(skins)} skins" if skins else "bones"
        raise ValueError(f"{name}: {said} of {len(roots)} skeletons, expected one")
    common = set.intersection(*({*path} for path in paths.values()))
    top = max(common, key=lambda node: paths[next(iter(paths))].index(node))
    found = {n for path in paths.values() for n in path[path.index(top) :]}
    depth = {n: path.index(n) for path in paths.values() for n in path}
    return sorted(found, key=lambda node: (depth[node], node))


def _vrm_roles(content: dict) -> dict[str, int]:
    """Nodes of roles, as VRM 1 or 0 has them."""
    extensions = content.get("extensions")
    if not isinstance(extensions, dict):
        return {}
    found = {}
    for key in ("VRMC_vrm", "VRM"):
        about = extensions.get(key)
        human = about.get("humanoid") if isinstance(about, dict) else None
        bones = human.get("humanBones") if isinstance(human, dict) else None
        if isinstance(bones, dict):
            bones = [{"bone": b, **v} for b, v in bones.items() if isinstance(v, dict)]
        for bone in bones if isinstance(bones, list) else ():
            if isinstance(bone, dict) and type(bone.get("node")) is int:
                found[str(bone.get("bone"))] = bone["node"]
    return found


def _bound(
    name: str,
    content: dict,
    data: bytes,
    parents: list[int],
    world: dict[int, np.ndarray],
) -> dict[int, np.ndarray]:
    """World matrices in which meshes were bound, of joints that stand otherwise.

    Bind matrices tell them but for a common frame, which is the world's, that above the
    skeleton or a mesh's, whichever has the joints turned least; where all have them
    turned far, the first joint stands as it is. Empty where bones would be of other
    lengths: then these matrices tell something else.
    """
    nodes, found = objects(name, content, "nodes"), {}
    skins = objects(name, content, "skins")
    for joint in {joint for skin in skins for joint in skin["joints"]}:
        _rotation(name, joint, world[joint])
    for number in sorted(range(len(skins)), key=lambda i: -len(skins[i]["joints"])):
        joints = skins[number]["joints"]
        if "inverseBindMatrices" not in skins[number]:
            continue
        try:
            inverse = array(name, content, data, skins[number]["inverseBindMatrices"])
        except ValueError:
            continue  # whoever draws the mesh says what is wrong
        if inverse.shape[1] != 16 or len(inverse) < len(joints):
            continue
        inverse = np.swapaxes(inverse[: len(joints)].reshape(-1, 4, 4), 1, 2)
        now = np.stack([world[joint] for joint in joints])
        size = np.linalg.norm(inverse[:, :3, :3], axis=1)
        if not (np.abs(inverse) < MAX_METERS).all() or not (size > 1e-6).all():
            continue
        if not (np.linalg.det(inverse[:, :3, :3] / size[:, None]) > 0.9).all():
            continue
        bind = np.linalg.inv(inverse)
        top = min(range(len(joints)), key=lambda i: len(_path(parents, joints[i])))
        above = parents[joints[top]]
        frames = [
            np.eye(4),
            world[above] if above >= 0 else np.eye(4),
            *(world[n] for n, node in enumerate(nodes) if node.get("skin") == number),
        ]
        bones = [
            (i, joints.index(parents[joint]))
            for i, joint in enumerate(joints)
            if parents[joint] in joints
        ]
        if not bones:
            continue
        long = _lengths(now, bones)
        for tried in (frames, [now[top] @ inverse[top]]):
            fits = []
            for frame in tried:
                at = frame @ bind
                off = np.abs(_lengths(at, bones) - long)
                same = off <= 0.05 * np.maximum(long, np.mean(long))
                if np.mean(same) >= 0.9:
                    fits.append((float(_angles(at, now).mean()), at))
            turned, at = min(fits, key=lambda x: x[0], default=(180.0, now))
            if turned < _FAR:
                break
        if turned < 180.0:
            found = {**dict(zip(joints, at, strict=True)), **found}
    far = [_angles(at[None], world[joint][None]) for joint, at in found.items()]
    return found if far and np.max(far) > _POSED else {}


def _lengths(at: np.ndarray, bones: list[tuple[int, int]]) -> np.ndarray:
    """Of bones between matrices [J, 4, 4]."""
    lower, upper = np.transpose(bones)
    return np.linalg.norm(at[lower, :3, 3] - at[upper, :3, 3], axis=1)


def _angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Degrees between the axes of matrices [J, 4, 4]."""

    def axes(at: np.ndarray) -> np.ndarray:
        return at[:, :3, :3] / np.linalg.norm(at[:, :3, :3], axis=1, keepdims=True)

    trace = np.einsum("jrc,jrc->j", axes(one), axes(other))
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def _stand(
    name: str,
    content: dict,
    data: bytes,
    parents: list[int],
    world: dict[int, np.ndarray],
) -> dict[int, np.ndarray]:
    """World matrices of nodes, in place made to stand as meshes were bound."""
    nodes, bound = content["nodes"], _bound(name, content, data, parents, world)
    if not bound:
        return world
    local = [_local(name, number, node) for number, node in enumerate(nodes)]
    made: dict[int, np.ndarray] = {}
    for number in sorted(range(len(nodes)), key=lambda n: len(_path(parents, n))):
        above = made[parents[number]] if parents[number] >= 0 else np.eye(4)
        made[number] = bound.get(number, above @ local[number])
        if number in bound:
            own = np.linalg.inv(above) @ made[number]
            nodes[number]["matrix"] = own.T.reshape(16).tolist()
            for part in ("translation", "rotation", "scale"):
                nodes[number].pop(part, None)
            _plain(nodes[number])
    return world_of(name, nodes, parents)


def read_rig(path: str | Path) -> Rig:
    """A character of a .glb, .gltf or .vrm file.

    A `ValueError` names the file if it is damaged, has no skeleton or several, or one
    that cannot be animated.
    """
    path = Path(path)
    name = str(path)
    content, data = _chunks(name, files.read_bytes(path))
    needed = content.get("extensionsRequired")
    if isinstance(needed, list) and MESHOPT in needed:  # packs bind matrices, too
        raise ValueError(f"{name}: {MESHOPT}: expected a file that is not packed")
    data = _one_buffer(name, content, data)
    nodes = objects(name, content, "nodes")
    objects(name, content, "accessors")
    if len(nodes) > _MAX_NODES:
        raise ValueError(f"{name}: {len(nodes)} nodes, more than {_MAX_NODES}")
    upper = parents_of(name, nodes)
    joints = _joints(name, content, upper)
    world = world_of(name, nodes, upper)
    if not _vrm_roles(content):  # whose rest pose is a T-pose
        world = _stand(name, content, data, upper, world)
    turns = np.stack([_rotation(name, joint, world[joint]) for joint in joints])
    above = np.eye(4) if upper[joints[0]] < 0 else world[upper[joints[0]]]
    if upper[joints[0]] >= 0:
        _rotation(name, upper[joints[0]], above)
    places = np.stack([world[joint][:3, 3] for joint in joints])
    parents = (-1, *(joints.index(upper[joint]) for joint in joints[1:]))
    offsets = places - places[[max(parent, 0) for parent in parents]]
    titles: list[str] = []
    for joint in joints:
        title = nodes[joint].get("name")
        title = title if isinstance(title, str) and title else f"node {joint}"
        titles.append(title if title not in titles else f"{title} ({joint})")
    try:
        check_skeleton(offsets=offsets, parents=parents, names=titles, feet=())
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    told = {
        role: titles[joints.index(node)]
        for role, node in _vrm_roles(content).items()
        if role in names.ROLES and node in joints and role not in ("chest", "neck")
    }
    skeleton = Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32), parents=parents, names=tuple(titles)
    )
    rig = Rig(
        name=name,
        content=content,
        data=data,
        skeleton=skeleton,
        nodes=tuple(joints),
        turns=turns,
        above=above,
        roles=told,
        sole=None,
    )
    lowest = _lowest(rig, world, upper)
    if lowest is None:
        return rig
    try:
        found = names.anatomy_of(skeleton, names.find_roles(skeleton, told))
    except ValueError:
        return rig  # who wants its roles is told what is missing
    ankles = float(np.mean([places[leg.end, 1] for leg in found.legs]))
    leg = float(
        np.mean([np.ptp(places[[x.upper, x.middle, x.end], 1]) for x in found.legs])
    )
    sole = ankles - lowest
    fits = found.upright and 0.02 * leg < sole < 0.4 * leg
    return dataclasses.replace(rig, sole=sole if fits else None)


def _lowest(rig: Rig, world: dict[int, np.ndarray], parents: list[int]) -> float | None:
    """Height of the lowest vertex at rest; None where meshes are packed.

    Of skinned meshes, or of those that hang on joints where there is no skin.
    """
    found = []
    get = (rig.name, rig.content, rig.data)
    skins, meshes = (objects(rig.name, rig.content, x) for x in ("skins", "meshes"))
    for number, node in enumerate(rig.content["nodes"]):
        skinned = "skin" in node
        hangs = not skins and {*rig.nodes} & {*_path(parents, number)}
        if "mesh" not in node or not (skinned or hangs):
            continue
        try:
            mesh = meshes[index(rig.name, node["mesh"], len(meshes), "a mesh")]
            moves = world[number][None]
            if skinned:
                skin = skins[index(rig.name, node["skin"], len(skins), "a skin")]
                moves = np.stack([world[joint] for joint in skin["joints"]])
                if "inverseBindMatrices" in skin:
                    bind = array(*get, skin["inverseBindMatrices"]).reshape(-1, 4, 4)
                    with np.errstate(all="ignore"):
                        moves = moves @ np.swapaxes(bind, 1, 2)[: len(moves)]
            for part in objects(rig.name, mesh, "primitives"):
                have = part.get("attributes", {})
                points = array(*get, have["POSITION"])
                which = np.zeros((len(points), 1), int)
                weights = np.ones((len(points), 1))
                if skinned:
                    which = array(*get, have["JOINTS_0"])
                    weights = array(*get, have["WEIGHTS_0"]).astype(float)
                rows = moves[which, 1]  # what becomes y
                four = np.concatenate([points, np.ones((len(points), 1))], axis=1)
                with np.errstate(all="ignore"):
                    heights = np.einsum("vk,vkc,vc->v", weights, rows, four)
                    heights = heights / np.maximum(weights.sum(axis=1), 1e-6)
                found.append(float(heights.min()))
        except (ValueError, KeyError, IndexError, TypeError, AttributeError):
            return None
    found = [height for height in found if np.isfinite(height)]
    return min(found, default=None)


def _quaternions(matrices: np.ndarray) -> np.ndarray:
    """[F, 3, 3] as x, y, z, w, neighbors on the same side."""
    from jaxmotion.motion.rotation import quaternion_from_matrix

    found = np.array(quaternion_from_matrix(jnp.asarray(matrices, jnp.float32)), float)
    found = found[..., [1, 2, 3, 0]]
    flips = np.sum(found[1:] * found[:-1], axis=-1) < 0
    found[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[..., None]
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def to_glb(rig: Rig, motion: Motion, *, rest: Rest | None = None) -> bytes:
    """The rig's own file with one animation of one character, in place of its own.

    Pictures that lie beside the rig are packed into it. With its `rest`, a root on the
    ground that carries the hips goes and turns with them, smoothly and on the ground,
    as engines want of what they take for the way of a character.
    """
    positions, turned = kinematics(rig.skeleton, motion)
    if not np.isfinite(positions).all() or not np.isfinite(turned).all():
        bad = ~np.isfinite(positions).all(axis=(1, 2))
        raise ValueError(f"frame {int(bad.argmax())} of the motion is not finite")
    carried = None if rest is None else _carried(rest)
    if rest is not None and carried is not None:
        positions, turned = _on_ground(rest, carried, positions, turned, motion.fps)
    world = turned @ rig.turns
    content, data = copy.deepcopy(rig.content), bytearray(rig.data)
    views = content.setdefault("bufferViews", [])
    accessors = content.setdefault("accessors", [])

    def packed(content: bytes) -> int:
        data.extend(b"\0" * (-len(data) % 4))
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(content)}
        views.append(view)
        data.extend(content)
        return len(views) - 1

    for number, image in enumerate(objects(rig.name, content, "images")):
        uri = image.get("uri")
        if uri is not None and not str(uri).startswith("data:"):
            found = linked(rig.name, image.pop("uri"), f"image {number}")
            image |= {
                "bufferView": packed(found),
                "mimeType": _kind(rig.name, found, number),
            }

    def add(values: np.ndarray, kind: str, *, ends: bool = False) -> int:
        accessor = {
            "bufferView": packed(np.ascontiguousarray(values, "<f4").tobytes()),
            "componentType": _FLOAT,
            "count": len(values),
            "type": kind,
        }
        if ends:
            first, last = np.asarray(values[[0, -1]], np.float32)
            accessor |= {"min": [float(first)], "max": [float(last)]}
        accessors.append(accessor)
        return len(accessors) - 1

    times = add(np.arange(len(world)) / motion.fps, "SCALAR", ends=True)
    samplers, channels = [], []

    def track(node: int, path: str, values: np.ndarray) -> None:
        output = add(values, f"VEC{values.shape[1]}")
        channels.append(
            {"sampler": len(samplers), "target": {"node": node, "path": path}}
        )
        samplers.append({"input": times, "output": output})

    back = np.linalg.inv(rig.above)
    frame = rig.above[:3, :3] / np.linalg.norm(rig.above[:3, :3], axis=0)
    for j, (node, parent) in enumerate(
        zip(rig.nodes, rig.skeleton.parents, strict=True)
    ):
        _plain(content["nodes"][node])
        over = frame if parent < 0 else world[:, parent]
        track(node, "rotation", _quaternions(np.swapaxes(over, -1, -2) @ world[:, j]))
    root = positions[:, 0] @ back[:3, :3].T + back[:3, 3]
    track(rig.nodes[0], "translation", root)
    if carried is not None:
        away = (positions[:, carried] - positions[:, 0])[:, None] @ world[:, 0]
        node = content["nodes"][rig.nodes[carried]]
        size = np.linalg.norm(rig.skeleton.offsets[carried])
        track(
            rig.nodes[carried],
            "translation",
            away[:, 0] * np.linalg.norm(node["translation"]) / size,
        )
    content["animations"] = [
        {"name": "motion", "samplers": samplers, "channels": channels}
    ]
    content["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data.extend(b"\0" * (-len(data) % 4))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + bytes(data)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _carried(rest: Rest) -> int | None:
    """The hips, where they hang on a root that stands on the ground; else None."""
    hips = rest.joint("hips")
    if hips is None or rest.skeleton.parents[hips] != 0:
        return None
    return hips if abs(rest.sole) < 0.2 * rest.leg else None


def _on_ground(
    rest: Rest, hips: int, positions: np.ndarray, turned: np.ndarray, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and turns in which the root follows the hips on the ground."""

    def smooth(x: np.ndarray) -> np.ndarray:
        # On beyond the ends as before them: else he is held back there.
        more = min(int(4 * _SMOOTH * fps), len(x) - 1)
        longer = np.pad(x, ((more, more), (0, 0)), mode="reflect", reflect_type="odd")
        weights = np.exp(-0.5 * (np.arange(-more, more + 1) / (_SMOOTH * fps)) ** 2)
        weights /= weights.sum()
        columns = [np.convolve(column, weights, "valid") for column in longer.T]
        return np.stack(columns, axis=-1)

    ahead = smooth(turned[:, hips, ::2, 2])  # their z axis on the ground
    yaw = np.arctan2(ahead[:, 0], ahead[:, 1])
    turn = np.tile(np.eye(3), (len(ahead), 1, 1))
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(yaw)
    turn[:, 0, 2], turn[:, 2, 0] = np.sin(yaw), -np.sin(yaw)
    level = np.array([1.0, 0.0, 1.0])
    place = smooth(positions[:, hips] * level) - turn @ (rest.places[hips] * level)
    place[:, 1] = -rest.sole
    parents = rest.skeleton.parents
    own = [j for j in range(len(parents)) if hips not in chain(parents, j)]
    positions, turned = positions.copy(), turned.copy()
    away = positions[:, own] - positions[:, :1]
    positions[:, own] = place[:, None] + away @ np.swapaxes(turn, -1, -2)
    turned[:, own] = turn[:, None] @ turned[:, own]
    return positions, turned


def _kind(name: str, image: bytes, number: int) -> str:
    """Media type of an image's file, which a .glb must state."""
    for kind, begin in _IMAGES.items():
        if re.match(begin, image, re.DOTALL):
            return kind
    raise ValueError(
        f"{name}: image {number} is of an unknown kind, expected one of "
        f"{', '.join(_IMAGES)}"
    )


def _plain(node: dict) -> None:
    """Makes of a node's matrix what may be animated, in place."""
    if "matrix" not in node:
        return
    matrix = np.array(node.pop("matrix"), float).reshape(4, 4).T
    size = np.linalg.norm(matrix[:3, :3], axis=0)
    node["translation"] = matrix[:3, 3].tolist()
    node["rotation"] = _quaternions(matrix[None, :3, :3] / size)[0].tolist()
    node["scale"] = size.tolist()


def save_onto(
    path: str | Path, rig: Rig, skeleton: Skeleton, motion: Motion, *, roles: Any = None
) -> None:
    """Writes a rig's file, animated by the motion of another skeleton.

    For the rig's roles see `roles.find_roles`.
    """
    world = kinematics(skeleton, motion)[1]
    function = transfer.Retarget(
        transfer.rest(skeleton, rotations=world), rig.rest(roles)
    )
    content = to_glb(rig, function(motion), rest=function.target)
    with files.replacing(path) as file:
        file.write(content)
