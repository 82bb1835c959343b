"""jaxmotion.export.rig_mesh: what the page draws of a rig, against pygltflib."""

import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.export import rig as rigging
from jaxmotion.export import rig_mesh
from jaxmotion.motion.anatomy import kinematics
from jaxmotion.viz import packed
from tests.export.test_gltf import accessor
from tests.export.test_rig import worlds
from tests.retarget import rigs

PNG = b"\x89PNG\r\n\x1a\n and the rest"
WEBP = b"RIFF\x10\x00\x00\x00WEBP and the rest"


@pytest.fixture(scope="module")
def hero(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "hero.glb"
    path.write_bytes(rigs.glb(rigs.person("child")))
    return path


def changed(tmp_path, hero, change):
    content, data = rigs.split(hero.read_bytes())
    data = change(content, data) or data
    path = tmp_path / "x.glb"
    path.write_bytes(rigs.joined(content, data))
    return rigging.read_rig(path)


def test_the_mesh_is_where_glTF_puts_it_at_rest(hero):
    content = pygltflib.GLTF2().load(str(hero))
    world, skin = worlds(content), content.skins[0]
    bind = accessor(content, skin.inverseBindMatrices).reshape(-1, 4, 4)
    moves = np.stack([world[n] for n in skin.joints]) @ np.swapaxes(bind, 1, 2)
    part = content.meshes[0].primitives[0].attributes
    points = accessor(content, part.POSITION)
    points = np.c_[points, np.ones(len(points))]
    which = accessor(content, part.JOINTS_0).astype(int)
    weights = accessor(content, part.WEIGHTS_0)
    expected = np.einsum("vk,vkij,vj->vi", weights, moves[which], points)[:, :3]
    found = rig_mesh.rig_mesh(rigging.read_rig(hero))
    number = len(expected)
    np.testing.assert_allclose(found.positions[:number], expected, atol=1e-4)
    names = rigging.read_rig(hero).skeleton.names
    main = which[np.arange(number), weights.argmax(axis=1)]
    told = [content.nodes[skin.joints[j]].name for j in main]
    mine = found.joints[np.arange(number), found.weights[:number].argmax(axis=1)]
    assert [names[j] for j in mine] == told
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(found.weights.sum(axis=-1), 1.0, atol=1e-6)


def test_what_the_page_is_given_moves_as_the_rig_does(hero):
    rig = rigging.read_rig(hero)
    mesh = rig_mesh.rig_mesh(rig)
    about, arrays = rig_mesh.page_body(rig, mesh, 2.0)
    # One joint turned about itself: its vertices turn about its place.
    elbow = rig.skeleton.names.index("mixamorig:LeftForeArm")
    motion = rigs.still(rig.skeleton)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
    columns = np.array(motion.joint_rotation)
    columns[0, elbow] = np.r_[turn[:, 0], turn[:, 1]]
    root = np.array(motion.root_position) + mesh.places[0]
    moved = type(motion)(
        root_position=jnp.asarray(root, jnp.float32),
        joint_rotation=jnp.asarray(columns),
        fps=30.0,
    )
    places, turns = (x[0] for x in kinematics(rig.skeleton, moved))
    inverse = arrays["inverse"].reshape(-1, 3, 4)
    moves = turns @ inverse
    moves[..., 3] += 2.0 * places
    points = np.c_[arrays["positions"], np.ones(len(arrays["positions"]))]
    weights = arrays["weights"] / 255.0
    found = np.einsum("vk,vkij,vj->vi", weights, moves[arrays["joints"]], points)
    hand = [j for j, name in enumerate(rig.skeleton.names) if "LeftHand" in name]
    rigid = np.isin(mesh.joints, [elbow, *hand]) | (mesh.weights == 0)
    rigid = rigid.all(axis=-1)
    assert rigid.sum() > 50
    place = mesh.places[elbow]
    expected = 2.0 * (place + (mesh.positions[rigid] - place) @ turn.T)
    np.testing.assert_allclose(found[rigid], expected, atol=0.01)
    upper = mesh.joints[:, 0] == rig.skeleton.names.index("mixamorig:Head")
    np.testing.assert_allclose(found[upper], 2.0 * mesh.positions[upper], atol=0.01)
    content = packed.pack(about, arrays)
    assert len(content) > 10_000 and about["parts"][0][2] is None


@pytest.mark.parametrize("image", [PNG, WEBP], ids=["PNG", "WebP"])
def test_colors_images_and_what_hangs_on_a_joint(image, hero, tmp_path):
    def change(content, data):
        data += b"\0" * (-len(data) % 4)
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(image)}
        content["bufferViews"].append(view)
        views = len(content["bufferViews"])
        content["images"] = [{"bufferView": views - 1}]
        content["textures"] = [{"source": 0}]
        if image == WEBP:
            content["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
        look = {"baseColorFactor": [0.5, 0.0, 1.0, 1.0]}
        look["baseColorTexture"] = {"index": 0}
        for part in content["meshes"][0]["primitives"]:
            part["material"] = len(content.setdefault("materials", []))
            part["attributes"].pop("COLOR_0", None)
        content["materials"].append(
            {"pbrMetallicRoughness": look, "alphaMode": "MASK", "alphaCutoff": 0.4}
        )
        hand = next(n for n in content["nodes"] if n["name"] == "mixamorig:LeftHand")
        hand.setdefault("children", []).append(len(content["nodes"]))
        content["nodes"].append({"name": "sword", "mesh": 0})
        content["buffers"][0]["byteLength"] = len(data) + len(image)
        return data + image

    rig = changed(tmp_path, hero, change)
    mesh = rig_mesh.rig_mesh(rig)
    assert mesh.parts[0].image == image and mesh.parts[0].cut == pytest.approx(0.4)
    # sRGB of half the light is 188.
    np.testing.assert_allclose(255 * mesh.colors[0], [188, 0, 255, 255], atol=1)
    about, arrays = rig_mesh.page_body(rig, mesh, 1.0)
    assert bytes(arrays["image.0"]) == image
    assert {part[2] for part in about["parts"]} == {"image.0"}
    half = len(mesh.positions) // 2
    hand = rig.skeleton.names.index("mixamorig:LeftHand")
    assert (mesh.joints[half:, 0] == hand).all() and (mesh.weights[half:, 0] == 1).all()


WRONG = {
    "no mesh": (lambda c: [n.pop("mesh", None) for n in c["nodes"]], "no mesh to be"),
    "packed": (
        lambda c: c.update(extensionsRequired=["KHR_draco_mesh_compression"]),
        "KHR_draco_mesh_compression: expected meshes as they are",
    ),
    "color": (
        lambda c: c.update(
            materials=[{"pbrMetallicRoughness": {"baseColorFactor": [1, 2]}}]
        ),
        "color of material 0",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_drawn_is_refused_in_one_line(what, hero, tmp_path):
    change, message = WRONG[what]

    def edit(content, data):
        for part in content["meshes"][0]["primitives"]:
            part["material"] = 0
        change(content)

    rig = changed(tmp_path, hero, edit)
    with pytest.raises(ValueError, match=message) as error:
        rig_mesh.rig_mesh(rig)
    assert "x.glb" in str(error.value) and "\n" not in str(error.value)
