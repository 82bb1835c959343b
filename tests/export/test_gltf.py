import io
import json
import struct

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxmotion.export import gltf
from jaxmotion.motion.anatomy import kinematics
from jaxmotion.motion.skeleton import Motion
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
    assert len(scene.geometry) == 6, "a mesh of each color"


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
