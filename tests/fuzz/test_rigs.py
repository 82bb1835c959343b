"""glTF rigs: malformed files, and that what is read is what pygltflib has."""

import json

import numpy as np
import pygltflib
import pytest

from jaxmotion.export import rig as rigging
from jaxmotion.export import rig_mesh
from jaxmotion.motion import anatomy
from tests.export.test_rig import worlds
from tests.fuzz import harness, mutations
from tests.retarget import rigs

pytestmark = pytest.mark.slow
INPUTS = 1000


def corpus():
    """A Mixamo child in an A-pose, a VRM, and a plain one."""
    child = rigs.glb(rigs.person("child"))
    content, data = rigs.split(child)
    index = {node["name"]: n for n, node in enumerate(content["nodes"])}
    human = {"hips": {"node": index["mixamorig:Hips"]}}
    content["extensions"] = {"VRMC_vrm": {"humanoid": {"humanBones": human}}}
    plain = rigs.glb(rigs.person("giant", "Unreal"), unit=1.0, turn=0.0)
    return [child, rigs.joined(content, data), plain]


def agrees(path, found):
    """Compares the places of joints with pygltflib's, where that reads the file.

    Where they stand as their mesh was bound, with those of the file that is written.
    """
    nodes = rigging._chunks(str(path), path.read_bytes())[0]["nodes"]
    try:
        if nodes != found.content["nodes"]:
            path = path.with_name("bound.glb")
            path.write_bytes(rigging.to_glb(found, rigs.still(found.skeleton, 2)))
        content = pygltflib.GLTF2().load(str(path))
        world = worlds(content)
        places = np.stack([world[node][:3, 3] for node in found.nodes])
    except Exception:  # it is stricter here, and laxer there
        return False
    size = np.abs(places).max() + 1.0
    np.testing.assert_allclose(
        anatomy.zero_pose(found.skeleton), places - places[0], atol=1e-4 * size
    )
    return True


def test_malformed_rigs(tmp_path, capsys):
    path = tmp_path / "x.glb"
    whole = corpus()

    def read(data):
        path.write_bytes(data)
        found = rigging.read_rig(path)
        made = rigging.to_glb(found, rigs.still(found.skeleton, 2))
        assert made[:4] == b"glTF"
        for more in (found.rest, lambda: rig_mesh.rig_mesh(found)):
            try:
                more()
            except (OSError, ValueError) as error:
                assert "\n" not in str(error)
                assert "x.glb" in str(error) or isinstance(error, OSError)
        return found

    def confirm(data, found):
        target.found["equal to pygltflib"] += agrees(path, found)

    target = harness.Target("glTF rigs", read, confirm, names=("x.glb",))
    for seed in range(INPUTS):
        random = np.random.default_rng(seed)
        data = whole[seed % len(whole)]
        if random.random() < 0.3:
            data = mutations.mutate_bytes(random, data)
        else:
            content, rest = rigs.split(data)
            changed = mutations.mutate_json(random, content)
            if isinstance(changed, dict):
                buffers = changed.get("buffers")
                data = rigs.joined(dict(changed), rest)
                if isinstance(buffers, list) and random.random() < 0.5:
                    text = json.dumps(changed | {"buffers": buffers}).encode()
                    data = text if random.random() < 0.2 else data
        target.feed(f"seed {seed}", data)
    target.report(capsys.disabled, accepted=INPUTS // 20, refused=INPUTS // 5)
    assert target.found["equal to pygltflib"] > INPUTS // 20
