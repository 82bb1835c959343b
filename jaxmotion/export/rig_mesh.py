"""The meshes of a rig at rest, as one that the page draws: places, weights, colors.

Materials are their base color and its texture; all else of them is left out. What has
no skin but hangs on a joint follows that joint.

Source: glTF 2.0 specification (Khronos), sections 3.7, 3.8 and 3.9; EXT_texture_webp.
"""

import dataclasses
import re
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion.export import rig as rigging
from jaxmotion.export.rig import Rig, array, index, linked, numbers, objects
from jaxmotion.viz import packed

_TRIANGLES = 4
_DRACO = "KHR_draco_mesh_compression"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Triangles of one material.

    Attributes:
      first, count: Corners in `RigMesh.faces`.
      image: A PNG, JPEG or WebP file; None for none.
      cut: Least opacity of a pixel that is drawn; 0 draws all.
    """

    first: int
    count: int
    image: bytes | None
    cut: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigMesh:
    """Triangles in the rest pose, in the world of the file.

    Attributes:
      positions, normals: [V, 3].
      joints: [V, 4] index into the rig's skeleton, and weights [V, 4] that sum to 1.
      colors: [V, 4] sRGB and opacity, 0 to 1.
      uv: [V, 2] in the part's image.
      faces: [T, 3].
      places: [J, 3] of the skeleton's joints.
    """

    positions: np.ndarray
    normals: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    colors: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    places: np.ndarray
    parts: tuple[Part, ...]


def _bytes(rig: Rig, number: int) -> bytes | None:
    """An image's file; None if it is of another kind than PNG, JPEG or WebP."""
    images = objects(rig.name, rig.content, "images")
    image = images[index(rig.name, number, len(images), "an image")]
    uri = image.get("uri")
    if "bufferView" in image:
        views = objects(rig.name, rig.content, "bufferViews")
        view = views[index(rig.name, image["bufferView"], len(views), "a view")]
        start, size = view["byteOffset"], view.get("byteLength")
        if type(size) is not int or not 0 <= size <= len(rig.data) - start:
            raise ValueError(f"{rig.name}: image {number} ends beyond the buffer")
        found = rig.data[start : start + size]
    elif uri is not None:
        found = linked(rig.name, uri, f"image {number}")
    else:
        raise ValueError(f"{rig.name}: image {number} has neither a view nor a uri")
    known = re.match(rb"\x89PNG\r\n\x1a\n|\xff\xd8\xff|RIFF....WEBP", found, re.DOTALL)
    return found if known else None


def _material(
    rig: Rig, primitive: dict[str, Any]
) -> tuple[np.ndarray, bytes | None, str, float]:
    """Color [4] (linear), image, the name of its coordinates, and least opacity."""
    white, uv = np.ones(4), "TEXCOORD_0"
    if "material" not in primitive:
        return white, None, uv, 0.0
    materials = objects(rig.name, rig.content, "materials")
    number = index(rig.name, primitive["material"], len(materials), "a material")
    material = materials[number]
    look = material.get("pbrMetallicRoughness", {})
    if not isinstance(look, dict):
        raise ValueError(f"{rig.name}: material {number} is no object")
    what = f"of material {number}"
    given = look.get("baseColorFactor", [1.0] * 4)
    color = np.clip(numbers(rig.name, given, 4, f"color {what}"), 0.0, 1.0)
    mode, cut = material.get("alphaMode", "OPAQUE"), material.get("alphaCutoff", 0.5)
    cut = float(numbers(rig.name, [cut], 1, f"opacity {what}")[0])
    cut = 0.0 if mode == "OPAQUE" else cut if mode == "MASK" else 0.3
    texture = look.get("baseColorTexture")
    if not isinstance(texture, dict):
        return color, None, uv, cut
    textures = objects(rig.name, rig.content, "textures")
    source = textures[index(rig.name, texture.get("index"), len(textures), "a texture")]
    more = source.get("extensions")
    webp = more.get("EXT_texture_webp") if isinstance(more, dict) else None
    source = webp if isinstance(webp, dict) else source
    image = _bytes(rig, source["source"]) if "source" in source else None
    return color, image, f"TEXCOORD_{texture.get('texCoord', 0)}", cut


def _srgb(linear: np.ndarray) -> np.ndarray:
    bright = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear < 0.0031308, 12.92 * linear, bright)


def _normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of vertices, from the triangles around them."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    found = np.zeros_like(positions)
    for k in range(3):
        np.add.at(found, faces[:, k], np.cross(b - a, c - a))
    return found


def _primitive(
    rig: Rig,
    part: dict[str, Any],
    moves: np.ndarray,
    joints: np.ndarray,
    *,
    skinned: bool,
) -> dict[str, Any]:
    """Arrays of a primitive in the world at rest.

    Args:
      moves: [n, 4, 4] world matrices, of the skin's joints or of the node itself.
      joints: [n] of the skeleton.
      skinned: Whether the weights count; else all follows the first of them.
    """
    get = (rig.name, rig.content, rig.data)
    have = part.get("attributes")
    if not isinstance(have, dict) or "POSITION" not in have:
        raise ValueError(f"{rig.name}: a mesh has no places of its vertices")
    points = array(*get, have["POSITION"]).astype(float)
    count = len(points)
    if points.shape != (count, 3) or not (np.abs(points) < 1e6).all():
        raise ValueError(f"{rig.name}: places of vertices are no numbers")
    if "indices" in part:
        faces = array(*get, part["indices"]).astype(int).ravel()
    else:
        faces = np.arange(count)
    faces = faces[: len(faces) // 3 * 3].reshape(-1, 3)
    if faces.size and not (faces.min() >= 0 and faces.max() < count):
        raise ValueError(f"{rig.name}: a triangle has corners that are not there")
    which = np.zeros((count, 4), int)
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    if skinned and "JOINTS_0" in have and "WEIGHTS_0" in have:
        which = array(*get, have["JOINTS_0"]).astype(int)
        weights = np.maximum(array(*get, have["WEIGHTS_0"]).astype(float), 0.0)
        if which.shape != (count, 4) or weights.shape != (count, 4):
            raise ValueError(f"{rig.name}: expected four joints for each vertex")
        which = np.where(weights > 0, which, 0)
        if which.size and not which.max() < len(moves):
            raise ValueError(f"{rig.name}: a vertex follows a joint that is not there")
        total = weights.sum(axis=1, keepdims=True)
        weights = np.where(total > 1e-6, weights / np.maximum(total, 1e-6), 0.0)
        weights[total[:, 0] <= 1e-6, 0] = 1.0
    if "NORMAL" in have:
        normals = array(*get, have["NORMAL"]).astype(float)
    else:
        normals = _normals(points, faces)
    blended = np.einsum("vk,vkij->vij", weights, moves[which])
    places = np.einsum("vij,vj->vi", blended[:, :3, :3], points) + blended[:, :3, 3]
    normals = np.einsum("vij,vj->vi", blended[:, :3, :3], normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), up)
    color, image, uv, cut = _material(rig, part)
    tint = np.ones((count, 4))
    if "COLOR_0" in have:
        given = array(*get, have["COLOR_0"]).astype(float)
        tint[:, : given.shape[1]] = given
    colors = np.clip(tint * color, 0.0, 1.0)
    colors[:, :3] = _srgb(colors[:, :3])
    corners = np.zeros((count, 2))
    if image is not None and uv in have:
        corners = array(*get, have[uv]).astype(float)
    return {
        "positions": places,
        "normals": normals,
        "joints": joints[which],
        "weights": weights,
        "colors": colors,
        "uv": corners,
        "faces": faces,
        "image": image,
        "cut": cut,
    }


def rig_mesh(rig: Rig) -> RigMesh:
    """What of a rig can be drawn.

    Raises:
      OSError: if an image beside the file cannot be read.
      ValueError: if meshes are compressed, damaged, or there are none; names the file.
    """
    content = rig.content
    needed = content.get("extensionsRequired")
    if isinstance(needed, list) and _DRACO in needed:
        raise ValueError(f"{rig.name}: {_DRACO}: expected meshes as they are")
    nodes = objects(rig.name, content, "nodes")
    meshes = objects(rig.name, content, "meshes")
    skins = objects(rig.name, content, "skins")
    parents = rigging.parents_of(rig.name, nodes)
    world = rigging.world_of(rig.name, nodes, parents)
    found = []
    for number, node in enumerate(nodes):
        if "mesh" not in node:
            continue
        mesh = meshes[index(rig.name, node["mesh"], len(meshes), "a mesh")]
        if "skin" in node:
            skin = skins[index(rig.name, node["skin"], len(skins), "a skin")]
            moves = np.stack([world[joint] for joint in skin["joints"]])
            if "inverseBindMatrices" in skin:
                get = (rig.name, content, rig.data)
                bind = array(*get, skin["inverseBindMatrices"])
                if bind.shape[1] != 16 or len(bind) < len(moves):
                    raise ValueError(f"{rig.name}: a skin lacks bind matrices")
                if not (np.abs(bind) < 1e6).all():
                    raise ValueError(f"{rig.name}: bind matrices are no numbers")
                bind = np.swapaxes(bind.reshape(-1, 4, 4), 1, 2)
                moves = moves @ bind[: len(moves)]
            joints = np.array([rig.nodes.index(joint) for joint in skin["joints"]])
        else:
            above = number
            while above >= 0 and above not in rig.nodes:
                above = parents[above]
            if above < 0:
                continue  # a floor, a lamp
            moves, joints = world[number][None], np.array([rig.nodes.index(above)])
        for part in objects(rig.name, mesh, "primitives"):
            if part.get("mode", _TRIANGLES) == _TRIANGLES:
                found.append(
                    _primitive(rig, part, moves, joints, skinned="skin" in node)
                )
    found = [part for part in found if part["faces"].size]
    if not found:
        raise ValueError(f"{rig.name}: no mesh to be drawn")
    starts = np.cumsum([0, *(len(part["positions"]) for part in found)])
    parts, first = [], 0
    for part, start in zip(found, starts, strict=False):
        part["faces"] = part["faces"] + start
        size = part["faces"].size
        parts.append(
            Part(first=first, count=size, image=part["image"], cut=part["cut"])
        )
        first += size
    names = ("positions", "normals", "joints", "weights", "colors", "uv", "faces")
    arrays = {name: np.concatenate([part[name] for part in found]) for name in names}
    if not all(np.isfinite(arrays[name]).all() for name in names):
        raise ValueError(f"{rig.name}: numbers of a mesh are not finite")
    places = np.stack([world[node][:3, 3] for node in rig.nodes])
    return RigMesh(**arrays, places=places, parts=tuple(parts))


def page_body(
    rig: Rig, mesh: RigMesh, scale: float
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What `viz.packed.pack` takes, for the page: the rig's skeleton and mesh, scaled.

    Raises:
      ValueError: if there are more than 256 joints.
    """
    count = rig.skeleton.num_joints
    if count > 256:
        raise ValueError(f"{rig.name}: {count} joints, expected at most 256")
    offsets = scale * np.asarray(rig.skeleton.offsets, float)
    skeleton = dataclasses.replace(rig.skeleton, offsets=jnp.asarray(offsets))
    places = scale * mesh.places[..., None]
    inverse = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), -places], axis=2)
    small = len(mesh.positions) < 2**16
    arrays = {
        "positions": (scale * mesh.positions).astype(np.float32),
        "normals": packed.bytes_of(mesh.normals),
        "joints": mesh.joints.astype(np.uint8),
        "weights": packed.whole(mesh.weights),
        "colors": np.round(255 * mesh.colors).astype(np.uint8),
        "uv": mesh.uv.astype(np.float32),
        "faces": mesh.faces.ravel().astype(np.uint16 if small else np.uint32),
        "inverse": inverse.reshape(count, 12).astype(np.float32),
    }
    images: dict[bytes, str] = {}
    parts = []
    for part in mesh.parts:
        name = None
        if part.image is not None:
            name = images.setdefault(part.image, f"image.{len(images)}")
        parts.append([part.first, part.count, name, part.cut])
    for image, name in images.items():
        arrays[name] = np.frombuffer(image, np.uint8)
    about = {"skeleton": packed.skeleton_json(skeleton), "parts": parts}
    return about, arrays
