import dataclasses
import inspect
import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.retarget import roles
from tests.motion.test_anatomy import along_x
from tests.retarget import rigs

EXPECTED = roles.find_roles(rigs.walker())


@pytest.mark.parametrize("convention", rigs.CONVENTIONS)
def test_joints_are_found_by_the_words_of_each_tool(convention):
    skeleton = rigs.named(rigs.walker(), convention)
    assert roles._in_order(skeleton, roles._by_names(skeleton)), "names are enough"
    found = roles.find_roles(skeleton)
    same = {role: rigs.walker().names.index(name) for role, name in EXPECTED.items()}
    for role, name in found.items():
        assert skeleton.names.index(name) == same[role], role
    robots_lack = {"leftShoulder", "rightShoulder"}
    lacking = robots_lack if convention == "Unitree" else set()
    assert set(EXPECTED) - set(found) == lacking


def test_a_spine_that_ends_at_the_arms_is_no_neck():
    words = list(rigs.CONVENTIONS["Blender"])
    base = rigs.named(rigs.walker(), "Blender")
    cut = [j for j, name in enumerate(words) if name != "spine.006"]
    short = rigs.plain(
        np.asarray(base.offsets)[cut],
        [cut.index(base.parents[j]) if base.parents[j] >= 0 else -1 for j in cut],
        tuple(words[j] for j in cut),
    )
    assert not {"neck", "head"} & {*roles.find_roles(short)}


@pytest.mark.parametrize("make", [rigs.walker, along_x])
def test_shape_alone_says_the_same(make):
    skeleton = make()
    told = roles.find_roles(skeleton)
    # Names that tell sides and nothing else; or not even those, where it stands.
    for word in (lambda n: "Left" * ("Left" in n) + "Right" * ("Right" in n),):
        plain = Skeleton(
            offsets=skeleton.offsets,
            parents=skeleton.parents,
            names=tuple(
                f"{word(n)}_{j}" if n != "Head" else "Head"
                for j, n in enumerate(skeleton.names)
            ),
        )
        found = roles.find_roles(plain)
        for role, name in found.items():
            assert plain.names.index(name) == skeleton.names.index(told[role]), role


def test_helpers_fingers_and_props_do_not_confuse():
    base = rigs.person("giant", "Unreal")
    names, parents = list(base.names), list(base.parents)
    offsets = np.asarray(base.offsets).tolist()
    names.insert(0, "root")
    parents = [-1, *(p + 1 for p in parents)]
    offsets.insert(0, [0, 0, 0])
    for name, parent, offset in (
        ("upperarm_twist_01_l", "upperarm_l", [0.1, 0, 0]),
        ("ik_foot_root", "root", [0, 0, 0]),
        ("ik_foot_l", "ik_foot_root", [0.1, 0, 0]),
        ("ik_hand_gun", "root", [0, 0, 0]),
        ("thumb_01_l", "hand_l", [0.03, 0, 0.03]),
        ("index_01_l", "hand_l", [0.1, 0, 0.02]),
        ("index_02_l", "index_01_l", [0.04, 0, 0]),
        ("weapon_r", "hand_r", [-0.5, 0, 0]),
    ):
        names.append(name)
        parents.append(names.index(parent))
        offsets.append(offset)
    whole = rigs.plain(offsets, parents, tuple(names))
    assert roles.find_roles(whole) == roles.find_roles(base)
    found = roles.anatomy_of(whole, roles.find_roles(whole))
    assert [whole.names[j] for j in found.trunk][:2] == ["root", "pelvis"]


def test_roles_are_edited_as_json(tmp_path):
    odd = rigs.plain(
        rigs.walker().offsets,
        rigs.walker().parents,
        tuple(f"x{j}" for j in range(22)),
    )
    edited = roles.find_roles(odd) | {"leftToes": "x16"}
    path = tmp_path / "roles.json"
    path.write_text(json.dumps(edited))
    assert roles.find_roles(odd, path)["leftToes"] == "x16"
    for given, message in (
        ({"tail": "x1"}, "unknown role 'tail', expected of hips, chest"),
        ({"head": "skull"}, "role head: no joint 'skull' among x0, x1"),
    ):
        with pytest.raises(ValueError, match=message):
            roles.find_roles(odd, given)
    path.write_text("[]")
    with pytest.raises(ValueError, match="expected an object"):
        roles.find_roles(odd, path)


def quadruped():
    """A dog: four legs under a level trunk."""
    names = ["pelvis", "spine", "chest", "neck", "head"]
    parents = [-1, 0, 1, 2, 3]
    offsets = [[0, 0, 0], [0, 0, 0.3], [0, 0, 0.3], [0, 0.15, 0.15], [0, 0.1, 0.1]]
    for pair, at in (("hind", 0), ("fore", 2)):
        for side, x in (("l", 0.1), ("r", -0.1)):
            for part, offset in (
                ("a", [x, 0, 0]),
                ("b", [0, -0.3, 0]),
                ("c", [0, -0.3, 0]),
                ("d", [0, -0.05, 0.05]),
            ):
                parents.append(at if part == "a" else len(names) - 1)
                names.append(f"{pair}_{part}_{side}")
                offsets.append(offset)
    return Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=tuple(parents),
        names=tuple(names),
    )


def test_roles_that_cannot_be_are_refused():
    base = rigs.walker()
    for given, message in (
        (["hips"], "roles are a list, expected joints by role"),
        ({"hips": 5}, "role hips: no joint 5 among Hips"),
        ({"chest": "Head"}, r"no person: 'Neck' does not hang on the chest \('Head'\)"),
    ):
        with pytest.raises(ValueError, match=message):
            inspect.unwrap(roles.find_roles)(base, given)
    same = {"hips": "Hips", "chest": "Hips"}  # a body of one piece
    assert roles.find_roles(base, same) == roles.find_roles(base) | same


def test_what_is_no_person_is_refused_in_one_line():
    base = rigs.walker()
    legless = [
        j for j, n in enumerate(base.names) if "Leg" not in n and "Foot" not in n
    ]
    legless = [j for j in legless if "Toe" not in base.names[j]]
    cut = rigs.plain(
        np.asarray(base.offsets)[legless],
        [
            -1 if base.parents[j] < 0 else legless.index(base.parents[j])
            for j in legless
        ],
        tuple(base.names[j] for j in legless),
    )
    for skeleton, message in (
        (cut, "no person: missing leftUpperLeg, leftLowerLeg, leftFoot, rightUpperLeg"),
        (
            quadruped(),
            "no person: missing .*leftUpperArm.*; found head 'head', neck 'neck' among",
        ),
        (rigs.plain([[0, 0, 0]], [-1], ("a",)), "found nothing among the joints a"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            roles.find_roles(skeleton)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 900


def test_a_horse_whose_head_is_high_is_no_person():
    places, parents, names = [[0, 1.0, 0], [0, 1.0, 0.8], [0, 1.9, 1.1]], [-1, 0, 1], []
    for side, x in (("Left", 0.2), ("Right", -0.2)):
        for top, z in ((0, 0.0), (1, 0.8)):
            above = top
            for height in (0.9, 0.5, 0.1):
                parents.append(above)
                above = len(places)
                places.append([x, height, z])
                names.append(f"{side}_{above}")
    offsets = np.array(places) - np.array(places)[[max(p, 0) for p in parents]]
    horse = rigs.plain(offsets, parents, ("back", "front", "Head", *names))
    with pytest.raises(ValueError, match="no person: missing leftUpperArm"):
        roles.find_roles(horse)


def test_sides_may_end_the_names_and_feet_must_be_on_legs():
    skeleton = rigs.named(rigs.walker(), "Unreal")
    ended = dataclasses.replace(
        skeleton,
        names=tuple(n.replace("_l", "L").replace("_r", "R") for n in skeleton.names),
    )
    found = roles.find_roles(ended)
    same = roles.find_roles(skeleton)
    index = {role: skeleton.names.index(name) for role, name in same.items()}
    assert {role: ended.names.index(n) for role, n in found.items()} == index
    # A foot of its own at the root, as rigs have that are driven by their feet.
    foot = index["leftFoot"]
    toes = [j for j, up in enumerate(skeleton.parents) if up == foot]
    parents = tuple(0 if j == foot else up for j, up in enumerate(skeleton.parents))
    loose = dataclasses.replace(ended, parents=parents)
    assert toes
    with pytest.raises(ValueError, match="'footL' is not below 'calfL'"):
        roles.find_roles(loose)
