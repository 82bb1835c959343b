"""Files that are dropped on the page: worn in Node as `jm.retarget` wears them."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.export import rig as rigging
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import Motion
from jaxmotion.retarget import transfer
from tests.fuzz import mutations
from tests.retarget import rigs
from tests.viz import samples
from tests.viz.test_web import data, floats, run

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")


def with_twists():
    """Twist bones, a finger, and a joint without a role above an upper arm."""
    base = rigs.proportioned(1.1, 0.9, 1.0)
    names, parents = list(base.names), list(base.parents)
    offsets = np.asarray(base.offsets).tolist()
    arm = names.index("LeftArm")
    for name, parent, offset in (
        ("LeftForeArmTwist", "LeftForeArm", [0.12, 0, 0]),
        ("LeftArmTwist", "LeftArm", [0.07, 0, 0]),
        ("RightLegTwist", "RightLeg", [0, -0.2, 0]),
        ("LeftIndex", "LeftHand", [0.09, 0, 0]),
    ):
        parents.append(names.index(parent))
        names.append(name)
        offsets.append(offset)
    # The joint that only carries the arm.
    above = lambda j: j + (j >= arm)  # noqa: E731
    parents = [above(up) if up >= 0 else -1 for up in parents]
    parents.insert(arm, parents[arm])
    parents[arm + 1] = arm
    names.insert(arm, "Carrier")
    offsets.insert(arm, [0.01, 0, 0])
    return rigs.glb(rigs.plain(offsets, parents, tuple(names)))


def by_shape():
    """Names that tell sides and nothing else."""
    base = rigs.proportioned(*rigs.BODIES["long arms"])
    word = lambda n: "Left" * ("Left" in n) + "Right" * ("Right" in n)  # noqa: E731
    names = [f"{word(n)}_{j}" for j, n in enumerate(base.names)]
    names[base.names.index("Head")] = "Head"
    return rigs.glb(dataclasses.replace(base, names=tuple(names)))


RIGS = {
    "a Mixamo child in an A-pose": lambda: rigs.glb(rigs.person("child")),
    "in a frame of an animation": lambda: rigs.posed(
        rigs.glb(rigs.person("child", "Blender"))
    ),
    "an Unreal giant": lambda: rigs.glb(
        rigs.person("giant", "Unreal"), unit=1.0, seed=3
    ),
    "limbs beside the spine": lambda: rigs.glb(rigs.forked()[1]),
    "VRM 1": lambda: rigs.vrm(rigs.glb(rigs.person("child"))),
    "VRM 0": lambda: rigs.vrm(rigs.glb(rigs.person("child")), "VRM"),
    "a VRM without a skin": lambda: rigs.vrm(
        rigs.glb(rigs.person("long arms", "Unreal")), skin=False
    ),
    "twist bones": with_twists,
    "names that say nothing": by_shape,
}


SLOW = {
    "an Unreal giant",
    "VRM 0",
    "VRM 1",
    "a VRM without a skin",
    "names that say nothing",
}  # each compiles its own


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in RIGS],
)
def test_a_dropped_rig_moves_as_retarget_moves_it(name, tmp_path):
    content = RIGS[name]()
    (tmp_path / "a.glb").write_bytes(content)
    skeleton, motion = samples.person(seconds=2.0)
    some = [x[::6] for x in (motion.root_position, motion.joint_rotation)]
    frames = [[floats(x) for x in pose] for pose in zip(*some, strict=True)]
    first = [data(content), transfer.page_json(transfer.rest(skeleton))]
    (found,) = run("rig.js", "dress.pose", [first, *frames])
    target = rigging.read_rig(tmp_path / "a.glb")
    function = jm.retarget(skeleton, target.rest())
    # On the page its legs are as long as the character's.
    made = Motion(
        root_position=jnp.array([x["root"] for x in found]) * function.scale,
        joint_rotation=jnp.array([x["rotation"] for x in found]).reshape(
            len(frames), -1, 6
        ),
        fps=30.0,
    )
    want = function(Motion(root_position=some[0], joint_rotation=some[1], fps=30.0))
    places, turns = anatomy.kinematics(target.skeleton, made)
    expected, wanted = anatomy.kinematics(target.skeleton, want)
    assert np.linalg.norm(places - expected, axis=-1).max() < 1e-4
    trace = np.einsum("...ij,...ij->...", turns, wanted)
    assert np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max() < 0.1


@pytest.mark.parametrize(
    "uri, line",
    [("iVBORw0KGgo=", None), ("UklGRhAAAABXRUJQ", None), ("?", "no base64")],
)
def test_a_picture_may_stand_in_the_text(uri, line):
    content, rest = rigs.split(rigs.glb(rigs.person("child")))
    content["images"] = [{"uri": f"data:image/png;base64,{uri}"}]
    webp = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    content["textures"] = [webp if uri.startswith("Uk") else {"source": 0}]
    look = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    content["materials"] = [look for _ in content["materials"]]
    for part in content["meshes"][0]["primitives"]:
        places = content["accessors"][part["attributes"]["POSITION"]]
        part["attributes"]["TEXCOORD_0"] = len(content["accessors"])
        content["accessors"].append(places | {"type": "VEC2"})
    (found,) = run("gltf.js", "readRig", [data(rigs.joined(content, rest))])
    assert found["error"].endswith(line) if line else "image.0" in str(found)


@pytest.fixture(scope="module")
def hero():
    return rigs.glb(rigs.person("child"))


def changed(hero, change):
    content, rest = rigs.split(hero)
    change(content)
    made = rigs.joined(content, rest)
    if "uri" not in content.get("extras", {}):
        return made
    content, _ = rigs.split(made)
    content["buffers"][0]["uri"] = content["extras"]["uri"]
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    head = made[:12] + len(text).to_bytes(4, "little") + b"JSON"
    return head + text + made[20 + int.from_bytes(made[12:16], "little") :]


def rename(content):
    """All on one side."""
    for number, node in enumerate(content["nodes"]):
        node["name"] = f"left_{number}"


def footless(content):
    """A foot at the root, as rigs have that are driven by their feet."""
    index = {node["name"]: n for n, node in enumerate(content["nodes"])}
    foot = index["mixamorig:LeftFoot"]
    content["nodes"][index["mixamorig:LeftLeg"]].pop("children")
    content["nodes"][index["mixamorig:Hips"]]["children"].append(foot)


def two_skins(content):
    count = len(content["nodes"])
    content["nodes"] += [{"name": "other", "children": [count + 1]}, {"name": "tip"}]
    content["skins"].append({"joints": [count, count + 1]})


def put(**values):
    return lambda content: content.update(values)


BAD = {
    "no skin: expected a character with a skeleton": lambda c: c.pop("skins"),
    "2 skins of 2 skeletons, expected one": two_skins,
    "buffer 0 is outside of the file": put(extras={"uri": "hero.bin"}),
    "KHR_draco_mesh_compression: expected meshes as they are": put(
        extensionsRequired=["KHR_draco_mesh_compression"]
    ),
    "EXT_meshopt_compression: expected meshes as they are": put(
        extensionsRequired=["EXT_meshopt_compression"]
    ),
    "no person: missing leftUpperLeg, ": rename,
    "'mixamorig:LeftFoot' is not below 'mixamorig:LeftLeg'": footless,
    "node 2 has the scale zero": lambda c: c["nodes"][2].update(scale=[0, 0, 0]),
    "damaged: rotation of node 2 is zero": lambda c: c["nodes"][2].update(
        rotation=[0, 0, 0, 0]
    ),
    "damaged: node 0 is above itself": lambda c: (
        c["nodes"][3].update(children=[0]),
        c["nodes"][-1].pop("children"),
    ),
    "damaged: 'nodes' should be a list of objects": put(nodes="none"),
    "no mesh to be drawn": put(meshes=[{"primitives": []}]),
}


def refused(*contents):
    source = transfer.page_json(transfer.rest(rigs.walker()))
    found = run("rig.js", "dress", *((data(x), source) for x in contents))
    return [x.get("error") for x in found]


def test_what_cannot_be_worn_is_refused_in_one_line(hero):
    files = [changed(hero, change) for change in BAD.values()]
    files += [hero[:-40], hero[:300], b"glTF", b"\x89PNG and so on, for a while"]
    lines = list(BAD) + ["damaged: its second part is cut off"]
    lines += ["damaged: its first part is cut off"]
    lines += ["no binary glTF: expected a .glb or .vrm"] * 2
    for said, line in zip(refused(*files), lines, strict=True):
        assert said and line in said and "\n" not in said and len(said) < 900


def test_limbs_that_hang_elsewhere_are_refused_as_by_retarget(tmp_path):
    for told in ({}, {"hips": "spine"}):
        content, rest = rigs.split(rigs.glb(rigs.loose()))
        if told:
            bones = {"hips": {"node": rigs.loose().names.index(told["hips"])}}
            content["extensions"] = {"VRMC_vrm": {"humanoid": {"humanBones": bones}}}
        (tmp_path / "a.glb").write_bytes(rigs.joined(content, rest))
        with pytest.raises(ValueError, match="no person: ") as caught:
            rigging.read_rig(tmp_path / "a.glb").rest()
        (line,) = refused((tmp_path / "a.glb").read_bytes())
        assert str(caught.value).endswith(f"a.glb: {line}")
        reason = (
            "'thigh.L' does not hang on the hips" if told else "hang on 'root' alone"
        )
        assert reason in line


@pytest.mark.slow
def test_malformed_rigs_are_refused_in_one_line(hero):
    """Mutated files are worn or refused; what else is thrown fails in `run`."""
    whole, lines = [hero, rigs.vrm(hero, "VRM")], []
    for start in range(0, 1000, 50):
        files = []
        for seed in range(start, start + 50):
            random = np.random.default_rng(seed)
            content = whole[seed % 2]
            if random.random() < 0.3:
                content = mutations.mutate_bytes(random, content)
            else:
                text, rest = rigs.split(content)
                mutated = mutations.mutate_json(random, text)
                if isinstance(mutated, dict):
                    content = rigs.joined(dict(mutated), rest)
            files.append(content)
        lines += refused(*files)
    told = [x for x in lines if x]
    assert 50 < len(told) < 950
    assert all("\n" not in x for x in told)
