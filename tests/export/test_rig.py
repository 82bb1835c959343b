"""jaxmotion.export.rig: rigs of others in and out, against pygltflib and SciPy."""

import json

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

import jaxmotion as jm
from jaxmotion.data import fbx
from jaxmotion.export import rig as rigging
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import joint_positions
from tests import mostly_slow
from tests.export.test_gltf import VALIDATE, accessor, validator  # noqa: F401
from tests.retarget import rigs
from tests.viz import samples


@pytest.fixture(scope="module")
def hero(tmp_path_factory):
    """A Mixamo rig of a child, in an A-pose."""
    path = tmp_path_factory.mktemp("rig") / "hero.glb"
    path.write_bytes(rigs.glb(rigs.person("child")))
    return path


def worlds(content, frame=None):
    """World matrices of all nodes, at rest or in a frame, as pygltflib has them."""
    animated = {}
    if frame is not None:
        animation = content.animations[0]
        for channel in animation.channels:
            values = accessor(content, animation.samplers[channel.sampler].output)
            animated[channel.target.node, channel.target.path] = values[frame]
    parent = {c: n for n, node in enumerate(content.nodes) for c in node.children or []}
    found = {}

    def world(number):
        if number not in found:
            node = content.nodes[number]
            local = np.eye(4)
            get = lambda key, default: animated.get(  # noqa: E731
                (number, key), getattr(node, key) or default
            )
            local[:3, :3] = Rotation.from_quat(
                get("rotation", [0, 0, 0, 1])
            ).as_matrix()
            local[:3, :3] *= get("scale", [1, 1, 1])
            local[:3, 3] = get("translation", [0, 0, 0])
            up = parent.get(number)
            found[number] = local if up is None else world(up) @ local
        return found[number]

    return {n: world(n) for n in range(len(content.nodes))}


def test_a_rig_is_read_where_pygltflib_has_its_joints(hero):
    found = rigging.read_rig(hero)
    content = pygltflib.GLTF2().load(str(hero))
    world = worlds(content)
    expected = np.stack([world[node][:3, 3] for node in found.nodes])
    expected = expected - expected[0]
    np.testing.assert_allclose(anatomy.zero_pose(found.skeleton), expected, atol=1e-5)
    assert found.skeleton.names == tuple(content.nodes[n].name for n in found.nodes)
    rest = found.rest()
    straight = anatomy.t_pose(rigs.person("child"))[0]
    by_name = [rigs.person("child").names.index(n) for n in found.skeleton.names]
    np.testing.assert_allclose(rest.places, straight[by_name], atol=2e-3)
    # The mesh says where the ground is: the mannequin's own soles.
    assert abs(found.sole - 0.0579) < 0.004


def skinned(path, frame):
    """Vertices [V, 3] of a file of one skin in a frame."""
    content = pygltflib.GLTF2().load(str(path))
    skin, world = content.skins[0], worlds(content, frame)
    bind = accessor(content, skin.inverseBindMatrices).reshape(-1, 4, 4)
    moves = np.stack([world[j] for j in skin.joints]) @ np.swapaxes(bind, 1, 2)
    found = []
    for part in content.meshes[0].primitives:
        get = lambda name: accessor(content, getattr(part.attributes, name))  # noqa: B023, E731
        four = np.concatenate([get("POSITION"), get("POSITION")[:, :1] * 0 + 1], 1)
        joints, weights = moves[get("JOINTS_0")], get("WEIGHTS_0")
        found.append(np.einsum("vk,vkrc,vc->vr", weights, joints, four)[:, :3])
    return np.concatenate(found)


@pytest.mark.slow
def test_a_rig_saved_in_a_frame_of_an_animation_is_as_its_mesh(tmp_path):
    raw = rigs.glb(rigs.person("child"))
    (tmp_path / "one.glb").write_bytes(raw)
    (tmp_path / "posed.glb").write_bytes(rigs.posed(raw))
    one, posed = (rigging.read_rig(tmp_path / f"{x}.glb") for x in ("one", "posed"))
    bent = pygltflib.GLTF2().load(str(tmp_path / "posed.glb"))
    stands = np.stack([worlds(bent)[node][:3, 3] for node in one.nodes])
    stands = stands - stands[0] - anatomy.zero_pose(one.skeleton)
    assert np.abs(stands).max() > 0.1
    np.testing.assert_allclose(posed.skeleton.offsets, one.skeleton.offsets, atol=1e-5)
    assert posed.sole == pytest.approx(one.sole, abs=1e-5)
    skeleton, motion = samples.person(seconds=0.2)
    for name in ("one", "posed"):
        jm.save(
            tmp_path / f"{name} walks.glb",
            skeleton,
            motion,
            onto=tmp_path / f"{name}.glb",
        )
    found, expected = (
        skinned(tmp_path / f"{x} walks.glb", 5) for x in ("posed", "one")
    )
    np.testing.assert_allclose(found, expected, atol=1e-4)


def distances(rig):
    places = anatomy.zero_pose(rig.skeleton)
    return np.linalg.norm(places[:, None] - places, axis=-1)


def test_what_bind_matrices_cannot_tell_is_left_as_it_stands(tmp_path):
    raw = rigs.glb(rigs.person("child"), unit=1.0, turn=0.0)
    (tmp_path / "one.glb").write_bytes(raw)
    expected = distances(rigging.read_rig(tmp_path / "one.glb"))

    def changed(change):
        content, data = rigs.split(rigs.posed(raw, spread=8.0))
        bind = rigs.values(content, data, content["skins"][0]["inverseBindMatrices"])
        change(np.swapaxes(bind.reshape(-1, 4, 4), 1, 2))
        (tmp_path / "other.glb").write_bytes(rigs.joined(content, data))
        return distances(rigging.read_rig(tmp_path / "other.glb"))

    # In axes that nothing in the file has: those of the first joint, as it stands.
    turn = Rotation.from_rotvec([2.0, 2.0, 2.0]).as_matrix()

    def turned(bind):
        bind[:, :3, :3] = bind[:, :3, :3] @ turn

    np.testing.assert_allclose(changed(turned), expected, atol=1e-4)
    stands = changed(lambda bind: None)
    np.testing.assert_allclose(stands, expected, atol=1e-4)

    def shorter(bind):
        bind[:, :3, 3] *= 0.5

    assert np.abs(changed(shorter) - expected).max() > 0.02

    def flat(bind):
        bind[:, :3, 1] = bind[:, :3, 0]

    np.testing.assert_allclose(changed(flat), changed(shorter), atol=1e-6)


def test_the_users_own_mesh_walks(hero, tmp_path):
    skeleton, motion = samples.person(seconds=1.0)
    jm.save(tmp_path / "walk.glb", skeleton, motion, onto=hero)
    content = pygltflib.GLTF2().load(str(tmp_path / "walk.glb"))
    before = pygltflib.GLTF2().load(str(hero))
    assert content.extras == {"made": "in the tests"}
    assert [m.name for m in content.materials] == [m.name for m in before.materials]
    for one, other in zip(
        before.meshes[0].primitives, content.meshes[0].primitives, strict=True
    ):
        for name in ("POSITION", "WEIGHTS_0"):
            np.testing.assert_array_equal(
                accessor(before, getattr(one.attributes, name)),
                accessor(content, getattr(other.attributes, name)),
            )
    target = rigging.read_rig(hero)
    function = jm.retarget(skeleton, hero, motion=motion)
    expected = np.asarray(joint_positions(target.skeleton, function(motion)))
    for frame in (0, 13, 29):
        world = worlds(content, frame)
        found = np.stack([world[node][:3, 3] for node in target.nodes])
        np.testing.assert_allclose(found, expected[frame], atol=2e-4)
    # Skinned by hand, it stands on the ground.
    assert -0.01 < skinned(tmp_path / "walk.glb", 13)[:, 1].min() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("suffix", mostly_slow([".bvh", ".npz", ".csv"], [".bvh"]))
def test_other_formats_have_the_rigs_skeleton(hero, tmp_path, suffix):
    skeleton, motion = samples.person(seconds=0.3)
    jm.save(tmp_path / f"a{suffix}", skeleton, motion, onto=hero)
    text = (tmp_path / f"a{suffix}").read_bytes()
    assert b"mixamorig" in text or suffix == ".npz"
    if suffix == ".bvh":
        # And a BVH is a rig, too.
        target = jm.retarget(skeleton, tmp_path / "a.bvh").target
        assert abs(target.leg - rigging.read_rig(hero).rest().leg) < 1e-3
    if suffix == ".npz":
        arrays = np.load(tmp_path / "a.npz")
        assert [str(x).split(":")[-1] for x in arrays["feet"]] == [
            "LeftToeBase",
            "RightToeBase",
        ]
        assert arrays["foot_contact"].shape == (len(arrays["root_position"]), 2)


def test_a_gltf_with_a_buffer_beside_it_and_a_vrm_are_rigs(hero, tmp_path):
    content, data = rigs.split(hero.read_bytes())
    (tmp_path / "hero data.bin").write_bytes(data)
    content["buffers"] = [{"uri": "hero%20data.bin", "byteLength": len(data)}]
    (tmp_path / "hero.gltf").write_text(json.dumps(content))
    plain = rigging.read_rig(hero)
    found = rigging.read_rig(tmp_path / "hero.gltf")
    np.testing.assert_array_equal(found.skeleton.offsets, plain.skeleton.offsets)


@pytest.mark.slow
def test_a_root_on_the_ground_goes_with_the_hips(tmp_path):
    """What engines take for the way of a character: level, smooth, facing ahead."""
    base = rigs.person("child", "Unreal")
    parents = [-1, *(p + 1 for p in base.parents), 0]
    offsets = np.concatenate([np.zeros((1, 3)), base.offsets, [[0.2, 0.0, 0.0]]])
    offsets[1] = [0.0, 0.1 - anatomy.zero_pose(base)[:, 1].min(), 0.05]
    bones = rigs.plain(offsets, parents, ("root", *base.names, "ik_foot_root"))
    path = tmp_path / "hero.glb"
    path.write_bytes(rigs.glb(bones, arms_down=0.0))
    skeleton, motion = samples.person(seconds=2.0, turn=1.0)
    jm.save(tmp_path / "walk.glb", skeleton, motion, onto=path)
    target = rigging.read_rig(path)
    function = jm.retarget(skeleton, path, motion=motion)
    expected, turns = anatomy.kinematics(target.skeleton, function(motion))
    content = pygltflib.GLTF2().load(str(tmp_path / "walk.glb"))
    index = {name: target.skeleton.index(name) for name in bones.names}
    body = [j for name, j in index.items() if name not in ("root", "ik_foot_root")]
    places, yaws = [], []
    for frame in range(len(expected)):
        world = worlds(content, frame)
        found = np.stack([world[node][:3, 3] for node in target.nodes])
        np.testing.assert_allclose(found[body], expected[frame][body], atol=3e-4)
        places.append(found[[index["root"], index["ik_foot_root"]]])
        turn = world[target.nodes[0]][:3, :3]
        turn = turn / np.linalg.norm(turn, axis=0) @ target.turns[0].T
        yaws.append(np.arctan2(turn[0, 2], turn[2, 2]))
        assert turn[1, 1] > 1 - 1e-6
    (root, carried), yaws = np.swapaxes(places, 0, 1), np.unwrap(yaws)
    assert np.ptp(root[:, 1]) < 1e-4 and abs(root[0, 1]) < 0.05
    hips = expected[:, index["pelvis"]]
    assert np.linalg.norm((root - hips)[:, ::2], axis=-1).max() < 0.1
    ahead = turns[:, index["pelvis"], :, 2]
    own = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))
    assert np.abs(yaws - own).max() < 0.3 and yaws[-1] - yaws[0] > 1.2
    # It does not sway as the hips do, and what it carries goes with it.
    bends = [np.abs(np.diff(x, 2))[8:-8].max() for x in (yaws, own)]
    assert bends[0] < 0.3 * bends[1]
    np.testing.assert_allclose(np.linalg.norm(carried - root, axis=-1), 0.2, atol=1e-4)


def test_pictures_beside_a_gltf_are_packed_into_what_is_saved(hero, tmp_path):
    beside = tmp_path / "hero"
    (beside / "skins").mkdir(parents=True)
    pictures = {
        "skins/a skin.png": (b"\x89PNG\r\n\x1a\n-", "image/png"),
        "b.webp": (b"RIFF\0\n\0\0WEBPVP8", "image/webp"),
    }
    content, data = rigs.split(hero.read_bytes())
    (beside / "hero.bin").write_bytes(data)
    content["buffers"] = [{"uri": "hero.bin", "byteLength": len(data)}]
    content["images"] = [{"uri": "data:image/png;base64,AA=="}]
    for name, (picture, _) in pictures.items():
        (beside / name).write_bytes(picture)
        content["images"].append({"uri": name.replace(" ", "%20"), "name": name})
    (beside / "hero.gltf").write_text(json.dumps(content))
    skeleton, motion = samples.person(seconds=0.3)
    save = lambda: jm.save(  # noqa: E731
        tmp_path / "walk.glb", skeleton, motion, onto=beside / "hero.gltf"
    )
    save()
    made, packed = rigs.split((tmp_path / "walk.glb").read_bytes())
    assert made["images"][0] == content["images"][0]
    for image, (name, (picture, kind)) in zip(
        made["images"][1:], pictures.items(), strict=True
    ):
        view = made["bufferViews"][image["bufferView"]]
        start = view["byteOffset"]
        assert bytes(packed[start : start + view["byteLength"]]) == picture
        assert image == {
            "name": name,
            "bufferView": image["bufferView"],
            "mimeType": kind,
        }
    (beside / "b.webp").write_bytes(b"GIF89a")
    with pytest.raises(ValueError, match="image 2 is of an unknown kind, expected one"):
        save()


@pytest.mark.slow
@pytest.mark.parametrize("version", ["VRMC_vrm", "VRM"])
@pytest.mark.parametrize("skin", mostly_slow([True, False], [False]))
def test_a_vrm_says_which_joint_is_which(version, skin, hero, tmp_path):
    plain = rigging.read_rig(hero)
    index = {node["name"]: n for n, node in enumerate(plain.content["nodes"])}
    (tmp_path / "a.vrm").write_bytes(rigs.vrm(hero.read_bytes(), version, skin=skin))
    found = rigging.read_rig(tmp_path / "a.vrm")
    told = found.rest().roles
    for role, name in plain.rest().roles.items():
        if role == "neck":
            continue  # between chest and head anyway
        assert int(told[role][1:]) == index[name], role
    assert found.rest().leg == pytest.approx(plain.rest().leg, rel=1e-5)
    # Where nothing is skinned, what hangs on the bones says where the ground is.
    assert found.sole == pytest.approx(plain.sole, rel=1e-4)
    skeleton, motion = samples.person(seconds=0.3)
    jm.save(tmp_path / "walk.vrm.glb", skeleton, motion, onto=tmp_path / "a.vrm")
    content = pygltflib.GLTF2().load(str(tmp_path / "walk.vrm.glb"))
    expected = jm.retarget(skeleton, tmp_path / "a.vrm", motion=motion)(motion)
    world = worlds(content, 5)
    places = np.stack([world[node][:3, 3] for node in found.nodes])
    wanted = np.asarray(joint_positions(found.skeleton, expected))[5]
    np.testing.assert_allclose(places, wanted, atol=2e-4)


def test_an_fbx_of_bones_alone_is_a_rig(tmp_path):
    pytest.importorskip("ufbx")
    child = rigs.person("child")
    (tmp_path / "a.fbx").write_bytes(rigs.fbx(child))
    target = jm.retarget(rigs.walker(), tmp_path / "a.fbx").target
    assert sorted(target.skeleton.names) == sorted(child.names)
    order = [target.skeleton.names.index(name) for name in child.names]
    expected = anatomy.zero_pose(child)
    found = anatomy.zero_pose(target.skeleton)[order]
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-4)


def test_bones_below_a_node_that_is_none_are_found(tmp_path):
    """A shoulder that is a Null: its arm stays, and stays where it is."""
    pytest.importorskip("ufbx")
    child = rigs.person("child")
    j = next(j for j, n in enumerate(child.names) if "shoulder" in n.lower())
    text = rigs.fbx(child).decode()
    for a, b in (
        (f'NodeAttribute: {1000 + j}, "NodeAttribute::", "LimbNode"', '"LimbNode"'),
        (f'"Model::{child.names[j]}", "LimbNode"', '"LimbNode"'),
    ):
        assert text.count(a) == 1
        text = text.replace(a, a.replace(b, '"Null"'))
    whole, less = (
        fbx.read_fbx("a.fbx", data, rest=True)
        for data in (rigs.fbx(child), text.encode())
    )
    assert set(whole.names) - set(less.names) == {child.names[j]}
    place = [whole.names.index(name) for name in less.names]
    np.testing.assert_allclose(less.positions, whole.positions[:, place], atol=1e-4)


def changed(hero, tmp_path, change):
    content, data = rigs.split(hero.read_bytes())
    change(content)
    path = tmp_path / "bad.glb"
    path.write_bytes(rigs.joined(content, data))
    return path


def two_skins(content):
    count = len(content["nodes"])
    content["nodes"] += [{"name": "other", "children": [count + 1]}, {"name": "tip"}]
    content["skins"].append({"joints": [count, count + 1]})


def cycle(content):
    content["nodes"][3]["children"] = [0]
    content["nodes"][-1]["children"] = []


def set_node(**values):
    return lambda content: content["nodes"][2].update(values)


BONE = {"bone": "hips", "node": 99}
BAD = {
    "no skin: expected a character": lambda c: c.pop("skins"),
    "EXT_meshopt_compression: expected a file that is not packed": lambda c: c.update(
        extensionsRequired=["EXT_meshopt_compression"]
    ),
    "a joint of the VRM is 99, expected in": lambda c: (
        c.pop("skins"),
        c.update(extensions={"VRM": {"humanoid": {"humanBones": [BONE]}}}),
    ),
    "2 skins of 2 skeletons, expected one": two_skins,
    "node 0 is above itself": cycle,
    "node 2 has the scale zero": set_node(scale=[0, 0, 0]),
    "node 2 is mirrored, sheared or uneven": set_node(scale=[1, 2, 1]),
    "node [0-9]+ is mirrored": set_node(scale=[-1, 1, 1]),
    "translation of node 2 should be 3 numbers": set_node(translation=[1, "x", 2]),
    "rotation of node 2 is zero": set_node(rotation=[0, 0, 0, 0]),
    "a child of node 2 is 999, expected in": set_node(children=[999]),
    "a joint of skin 0 is -1": lambda c: c["skins"][0].update(joints=[-1]),
    "skin 0 has no joints": lambda c: c["skins"][0].update(joints=[]),
    "'nodes' should be a list of objects": lambda c: c.update(nodes=[1]),
    "buffer of view 0 is 7": lambda c: c["bufferViews"][0].update(buffer=7),
}


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_be_animated_is_told_in_one_line(message, hero, tmp_path):
    path = changed(hero, tmp_path, BAD[message])
    with pytest.raises(ValueError, match=message) as caught:
        rigging.read_rig(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_are_refused(tmp_path):
    for content, message in (
        (b"", "no glTF: its JSON cannot be read"),
        (b"glTF" + b"\2\0\0\0" + b"\0" * 20, "the first chunk is"),
        (b"glTF", "expected binary glTF of version 2"),
        (b"[]", "its JSON is no object"),
    ):
        path = tmp_path / "a.glb"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            rigging.read_rig(path)
    with pytest.raises(OSError, match=r"none\.glb"):
        rigging.read_rig(tmp_path / "none.glb")
    with pytest.raises(ValueError, match=r"unknown suffix '\.obj', expected one of"):
        jm.retarget(rigs.walker(), tmp_path / "a.obj")
    beside = {"buffers": [{"uri": "../secret.bin", "byteLength": 1}]}
    path.write_text(json.dumps(beside))
    with pytest.raises(ValueError, match="buffer 0 is outside of its folder"):
        rigging.read_rig(path)


def test_a_rig_without_legs_is_told_what_is_missing(tmp_path):
    base = rigs.person("child")
    keep = [
        j
        for j, n in enumerate(base.names)
        if not any(w in n for w in ("Leg", "Foot", "Toe"))
    ]
    cut = rigs.plain(
        np.asarray(base.offsets)[keep],
        [-1 if base.parents[j] < 0 else keep.index(base.parents[j]) for j in keep],
        tuple(base.names[j] for j in keep),
    )
    path = tmp_path / "ghost.glb"
    path.write_bytes(rigs.glb(cut, arms_down=0.0))
    with pytest.raises(
        ValueError, match=r"ghost\.glb: no person: missing leftUpperLeg"
    ):
        jm.retarget(base, path)


@pytest.mark.slow
def test_the_validator_of_khronos_accepts_the_animated_rig(hero, tmp_path, validator):  # noqa: F811
    import subprocess

    skeleton, motion = samples.person(seconds=0.5)
    jm.save(tmp_path / "walk.glb", skeleton, motion, onto=hero)
    done = subprocess.run(
        ["node", "-e", VALIDATE, str(tmp_path / "walk.glb")],
        cwd=validator,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    issues = json.loads(done.stdout)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
