import io
import json
import shutil
import struct
import subprocess

import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
import trimesh

from jaxmotion.data.walker import walker_skeleton
from jaxmotion.export import gltf
from jaxmotion.motion.anatomy import as_t_pose, kinematics
from jaxmotion.motion.skeleton import Motion
from jaxmotion.viz import mannequin
from tests.motion.test_anatomy import along_x
from tests.viz import samples


def turning(joints, frames=6):
    """A motion in which everything turns."""
    draw = np.random.default_rng(3)
    columns = np.zeros((frames, joints, 6))
    columns[..., 0] = columns[..., 4] = 1.0
    grow = np.linspace(0, 1, frames)[:, None, None]
    columns = columns + 1.5 * grow * draw.normal(size=(1, joints, 6))
    root = draw.normal(size=(frames, 3))
    return Motion(
        root_position=jnp.asarray(root, jnp.float32),
        joint_rotation=jnp.asarray(columns, jnp.float32),
        fps=30.0,
    )


def tracks(data):
    """Times and values of each animated (node name, path), read by hand."""
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and struct.unpack_from("<I", data, 8)[0] == len(data)
    content, chunk = json.loads(data[20 : 20 + size]), data[28 + size :]

    def array(index):
        accessor = content["accessors"][index]
        view = content["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        count = width * accessor["count"]
        found = np.frombuffer(chunk, "<f4", count, view["byteOffset"])
        return found.reshape(-1, width)

    animation = content["animations"][0]
    return {
        (content["nodes"][c["target"]["node"]]["name"], c["target"]["path"]): [
            array(animation["samplers"][c["sampler"]][end])
            for end in ("input", "output")
        ]
        for c in animation["channels"]
    }


@pytest.mark.parametrize("make", [along_x, lambda: samples.figure()])
def test_trimesh_finds_the_joints_where_the_kinematics_put_them(make):
    """Its scene graph composes the nodes, with each frame's rotations in them."""
    skeleton = make()
    motion = turning(skeleton.num_joints)
    data = gltf.to_glb(skeleton, motion)
    graph = trimesh.load(io.BytesIO(data), file_type="glb").graph
    expected = kinematics(skeleton, motion)[0]
    found = tracks(data)
    for frame in range(len(expected)):
        for j, name in enumerate(skeleton.names):
            parent = skeleton.names[skeleton.parents[j]] if j else graph.base_frame
            matrix = np.array(graph.transforms.edge_data[(parent, name)]["matrix"])
            x, y, z, w = found[name, "rotation"][1][frame]
            turn = trimesh.transformations.quaternion_matrix([w, x, y, z])
            matrix[:3, :3] = turn[:3, :3]
            if not j:
                matrix[:3, 3] = found[name, "translation"][1][frame]
            graph.update(frame_to=name, frame_from=parent, matrix=matrix)
        places = np.stack([graph.get(name)[0][:3, 3] for name in skeleton.names])
        np.testing.assert_allclose(places, expected[frame], atol=1e-4)
    times, turns = found[skeleton.names[-1], "rotation"]
    np.testing.assert_allclose(times[:, 0], np.arange(6) / 30, atol=1e-6)
    assert (np.sum(turns[1:] * turns[:-1], axis=-1) >= 0).all(), "the short way round"


def test_the_zero_pose_is_a_t_pose_with_a_body_that_stands():
    skeleton = along_x()
    data = gltf.to_glb(skeleton, turning(skeleton.num_joints))
    scene = trimesh.load(io.BytesIO(data), file_type="glb")
    place = {name: scene.graph.get(name)[0] for name in skeleton.names}
    for matrix in place.values():
        np.testing.assert_allclose(matrix[:3, :3], np.eye(3), atol=1e-6)
    hands = place["LeftHand"][:3, 3] - place["RightHand"][:3, 3]
    assert hands[0] > 1.2 and np.abs(hands[1:]).max() < 1e-4
    low, high = scene.bounds
    assert abs(low[1]) < 1e-3 and 1.6 < high[1] < 2.1
    assert len(scene.geometry) == 5, "a mesh of each color"


def accessor(content, index):
    """An array of a file that pygltflib read."""
    found = content.accessors[index]
    view = content.bufferViews[found.bufferView]
    kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[found.componentType]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[found.type]
    blob = content.binary_blob()
    array = np.frombuffer(blob, kind, found.count * width, view.byteOffset)
    return array.reshape(found.count, width)


def test_pygltflib_skins_the_body_as_the_mannequin_does():
    """Node transforms, inverse binds and weights, as the specification puts them."""
    skeleton = along_x()
    motion = turning(skeleton.num_joints)
    data = gltf.to_glb(skeleton, motion)
    content = pygltflib.GLTF2.load_from_bytes(data)
    skin = content.skins[0]
    assert [content.nodes[j].name for j in skin.joints] == list(skeleton.names)
    bind = accessor(content, skin.inverseBindMatrices).reshape(-1, 4, 4)
    bind = np.swapaxes(bind, 1, 2)
    channels = {
        (c.target.node, c.target.path): content.animations[0].samplers[c.sampler]
        for c in content.animations[0].channels
    }
    frame, world = 4, {}
    parent = {c: n for n, node in enumerate(content.nodes) for c in node.children or []}
    for j in skin.joints:
        x, y, z, w = accessor(content, channels[j, "rotation"].output)[frame]
        local = trimesh.transformations.quaternion_matrix([w, x, y, z])
        local[:3, 3] = content.nodes[j].translation
        if (j, "translation") in channels:
            moved = accessor(content, channels[j, "translation"].output)
            local[:3, 3] = moved[frame]
        world[j] = world[parent[j]] @ local if j in parent else local
    moves = np.stack([world[j] for j in skin.joints]) @ bind
    plain, moved = as_t_pose(skeleton, motion)
    body = mannequin.describe(plain)
    expected = body.skin(*(x[frame] for x in kinematics(plain, moved)))[0]
    for part in content.meshes[0].primitives:
        get = lambda name: accessor(content, getattr(part.attributes, name))  # noqa: B023, E731
        places = np.concatenate([get("POSITION"), get("POSITION")[:, :1] * 0 + 1], 1)
        joints, weights = get("JOINTS_0"), get("WEIGHTS_0")
        found = np.einsum("vk,vkij,vj->vi", weights, moves[joints], places)
        color = content.materials[part.material].pbrMetallicRoughness.baseColorFactor
        mine = [
            m
            for m in range(len(body.palette))
            if gltf._linear(body.palette[m]) == color
        ]
        np.testing.assert_allclose(
            found[:, :3], expected[body.materials == mine[0]], atol=1e-4
        )
        faces = accessor(content, part.indices)
        assert faces.max() < len(places) and len(faces) % 3 == 0


VALIDATE = """
const { validateBytes } = require("gltf-validator");
const data = new Uint8Array(require("fs").readFileSync(process.argv[1]));
validateBytes(data).then(r => console.log(JSON.stringify(r)));
"""


def installed(folder, package):
    """The folder, into which npm puts a package."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("node and npm are not installed")
    command = [npm, "install", "--no-audit", "--no-fund", package]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:  # no network, say: nothing of ours is wrong
        pytest.skip(f"npm cannot install {package}: {done.stderr[-200:]}")
    return folder


@pytest.fixture(scope="module")
def validator(tmp_path_factory):
    """Where npm has put the validator of Khronos."""
    folder = tmp_path_factory.mktemp("validator")
    return installed(folder, "gltf-validator@2.0.0-dev.3.10")


@pytest.mark.slow
@pytest.mark.parametrize("make", [along_x, walker_skeleton, lambda: samples.figure()])
def test_the_validator_of_khronos_finds_nothing(make, validator):
    skeleton = make()
    (validator / "a.glb").write_bytes(
        gltf.to_glb(skeleton, turning(skeleton.num_joints))
    )
    done = subprocess.run(
        ["node", "-e", VALIDATE, str(validator / "a.glb")],
        cwd=validator,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    issues = report["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
    assert report["info"]["hasSkins"] and report["info"]["animationCount"] == 1


def test_a_frame_that_is_not_finite_is_named():
    motion = turning(4)
    broken = np.array(motion.root_position)
    broken[2, 1] = np.nan
    motion = Motion(
        root_position=jnp.asarray(broken),
        joint_rotation=motion.joint_rotation,
        fps=30.0,
    )
    with pytest.raises(ValueError, match="frame 2 of root_position is not finite"):
        gltf.to_glb(samples.figure(), motion)
