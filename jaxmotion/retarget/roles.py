"""Which joint of a skeleton is the hips, the left upper arm and so on.

Roles have the names of VRM's humanoid bones. They are read off the joints' names, in
the words of the common rigs (Unreal, Mixamo, VRM, SMPL, HumanIK, CMU, LaFAN1, Bandai
Namco, O3DE, 3ds Max, Blender, links of Unitree's robots), and where those say nothing,
off the shape: chains that leave the trunk, sides, heights. A few lines of JSON say
otherwise.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmotion import files
from jaxmotion.motion import anatomy
from jaxmotion.motion.anatomy import LEFT, MIDDLE, RIGHT, Anatomy, Limb
from jaxmotion.motion.skeleton import Skeleton

_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
_LEG = ("UpperLeg", "LowerLeg", "Foot", "Toes")
ROLES = (
    "hips",
    "chest",
    "neck",
    "head",
    *(side + part for side in (LEFT, RIGHT) for part in (*_ARM, *_LEG)),
)
_OPTIONAL = {"chest", "neck", "head"} | {
    side + part for side in (LEFT, RIGHT) for part in ("Shoulder", "Toes")
}
# Words of names without side, number and joints' suffixes; the first that fits counts.
_WORDS = {
    "UpperLeg": (
        *("upperleg", "upleg", "thigh", "femur", "hipyaw", "hiproll", "hippitch"),
        "hip",
    ),
    "LowerLeg": ("lowerleg", "loleg", "calf", "shin", "tibia", "knee", "leg"),
    "Foot": ("ankleroll", "anklepitch", "ankle", "foot"),
    "Toes": ("toebase", "toes", "toe", "ball", "foot"),
    "Shoulder": ("clavicle", "collar", "shoulder", "shldr"),
    "UpperArm": (
        *("upperarm", "uparm", "humerus", "arm"),
        *("shoulderyaw", "shoulderroll", "shoulderpitch", "shoulder", "shldr"),
    ),
    "LowerArm": ("forearm", "lowerarm", "loarm", "radius", "elbow"),
    "Hand": ("hand", "wristyaw", "wristpitch", "wristroll", "wrist", "palm", "fist"),
}
_HEADS, _NECKS = ("head",), ("neck", "lowerneck", "upperneck", "necklower")
_NOISE = {
    *("l", "r", "c", "m", "left", "right", "jnt", "joint", "jt", "link", "bone", "bip"),
    *(
        "biped",
        "j",
        "b",
        "def",
        "mixamorig",
        "valve",
        "sk",
        "cc",
        "base",
        "rig",
        "skel",
    ),
    *("character", "org", "bend"),  # Daz has a lThighBend and a lThighTwist
}
_HELPERS = {
    "twist",
    "ik",
    "pole",
    "target",
    "helper",
    "end",
    "site",
    "nub",
    "corrective",
}
_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def _read(name: str) -> tuple[str, str]:
    """Side and word of a name; an empty word for helpers."""
    tokens = [t.lower() for t in _TOKEN.findall(name.split(":")[-1])]
    if _HELPERS & {*tokens}:
        return MIDDLE, ""
    side = anatomy.side_of(name.split(":")[-1])
    # "toe" and "base" make Mixamo's "toebase"; other bases are prefixes.
    word = "".join(t for t in tokens if t not in _NOISE)
    known = {w for words in _WORDS.values() for w in words}
    if side == MIDDLE and word not in known and word[:1] in "lr" and word[1:] in known:
        side, word = (LEFT if word[0] == "l" else RIGHT), word[1:]  # CMU's lfemur
    if side == MIDDLE:
        for ending, found in (("left", LEFT), ("right", RIGHT)):
            if word.endswith(ending):
                side, word = found, word.removesuffix(ending)
    return side, word


def _by_names(skeleton: Skeleton) -> dict[str, int]:
    """Roles whose joints the names tell."""
    read = [_read(name) for name in skeleton.names]
    found: dict[str, int] = {}

    def first(role: str, side: str, words: tuple[str, ...]) -> None:
        for word in words:
            joints = [j for j, have in enumerate(read) if have == (side, word)]
            joints = [j for j in joints if j not in found.values()]
            if joints:
                found[side + role if side != MIDDLE else role] = joints[0]
                return

    for side in (LEFT, RIGHT):
        for role in ("UpperLeg", "LowerLeg", "Foot", "Toes"):
            first(role, side, _WORDS[role])
        # A "shoulder" is the upper arm where nothing else is.
        for role in ("UpperArm", "LowerArm", "Hand", "Shoulder"):
            first(role, side, _WORDS[role])
        foot, toes = found.get(side + "Foot"), found.get(side + "Toes")
        if toes is not None and foot not in anatomy.chain(skeleton.parents, toes):
            del found[side + "Toes"]
        upper, clavicle = found.get(side + "UpperArm"), found.get(side + "Shoulder")
        if clavicle is not None and upper is not None:
            if clavicle not in anatomy.chain(skeleton.parents, upper):
                del found[side + "Shoulder"]
    first("head", MIDDLE, _HEADS)
    first("neck", MIDDLE, _NECKS)
    if "head" not in found and "neck" not in found:
        found |= _top_of_spine(skeleton, read, found)
    return found


def _top_of_spine(
    skeleton: Skeleton, read: list[tuple[str, str]], found: Mapping[str, int]
) -> dict[str, int]:
    """Neck and head of a spine whose numbers go on beyond the chest (Blender's)."""
    arms = [found[s + "UpperArm"] for s in (LEFT, RIGHT) if s + "UpperArm" in found]
    if len(arms) < 2:
        return {}
    chest = _lowest_common(skeleton, arms)
    spine = [j for j, have in enumerate(read) if have == (MIDDLE, "spine")]
    above = [j for j in spine if chest in anatomy.chain(skeleton.parents, j)[:-1]]
    if chest not in spine or len(above) < 2:
        return {}
    return {"neck": above[0], "head": above[-1]}


def _in_order(skeleton: Skeleton, found: Mapping[str, int]) -> bool:
    """Whether each limb's joints are below each other."""
    for side in (LEFT, RIGHT):
        for parts in (_ARM[1:], _LEG[:3]):
            if any(side + part not in found for part in parts):
                return False
            joints = [found[side + part] for part in parts]
            chain = anatomy.chain(skeleton.parents, joints[-1])
            if not (joints[0] in chain and joints[1] in chain):
                return False
            if chain.index(joints[0]) >= chain.index(joints[1]):
                return False
    return True


def _lowest_common(skeleton: Skeleton, joints: list[int]) -> int:
    chains = [anatomy.chain(skeleton.parents, joint) for joint in joints]
    same = [j for j in chains[0] if all(j in chain for chain in chains)]
    return same[-1]


def _by_shape(skeleton: Skeleton) -> dict[str, int]:
    """Roles that chains, sides and heights tell; empty if it is no person."""
    found = anatomy.find_anatomy(skeleton)
    sides = sorted(limb.side for limb in (*found.arms, *found.legs))
    if sides != [LEFT, LEFT, RIGHT, RIGHT]:
        return {}
    places = anatomy.zero_pose(skeleton)
    spine = anatomy.unit(places[found.trunk[-1]] - places[found.trunk[0]])
    limbs = [places[x.end] - places[x.upper] for x in (*found.arms, *found.legs)]
    hands, feet = (
        np.mean([places[x.end, 1] for x in limbs]) for limbs in (found.arms, found.legs)
    )
    leg = np.mean([np.linalg.norm(x) for x in limbs[2:]])
    # On four legs the trunk lies, or the neck rises and the hands are on the ground.
    lies = abs(spine[1]) < 0.6 or hands - feet < 0.35 * leg
    if lies and all(anatomy.unit(x)[1] < -0.6 for x in limbs):
        return {}
    made: dict[str, int] = {}
    for limbs, parts in ((found.arms, _ARM), (found.legs, (None, *_LEG[:3]))):
        for limb in limbs:
            joints = (limb.upper, limb.middle, limb.end)
            made |= {
                limb.side + part: j for part, j in zip(parts[1:], joints, strict=True)
            }
            if limbs is found.arms and limb.before:
                made[limb.side + "Shoulder"] = limb.before[-1]
            if limbs is found.legs and limb.after:
                made[limb.side + "Toes"] = limb.after[0]
    if found.has_head:
        made["head"] = found.trunk[-1]
    return made


def find_roles(
    skeleton: Skeleton, given: Mapping[str, str] | str | Path | None = None
) -> dict[str, str]:
    """The joint of each role.

    Its zero pose should be a person's, or its joints have names. Those `given` (by
    role, or a JSON file of them) count first. `ValueError` if a role or joint is
    unknown, or arms and legs are not all found; says what was found and what is
    missing.
    """
    if isinstance(given, str | Path):
        given = files.read_object(given, what="roles and their joints")
    if not isinstance(given, Mapping | None):
        raise ValueError(f"roles are a {type(given).__name__}, expected joints by role")
    given = dict(given or {})
    for role, name in given.items():
        if role not in ROLES:
            raise ValueError(f"unknown role {role!r}, expected of {', '.join(ROLES)}")
        if name not in skeleton.names:
            raise ValueError(
                f"role {role}: no joint {name!r} among {_listed(skeleton.names)}"
            )
    told = {role: skeleton.names.index(name) for role, name in given.items()}
    named = _by_names(skeleton)
    found = {role: j for role, j in named.items() if j not in told.values()} | told
    if not _in_order(skeleton, found):
        shaped = _by_shape(skeleton)
        shaped = {role: j for role, j in shaped.items() if j not in told.values()}
        if shaped or told:
            found = {**shaped, **told} if shaped else found
    missing = [role for role in ROLES if role not in found and role not in _OPTIONAL]
    missing = [role for role in missing if role != "hips"]
    if missing or not _in_order(skeleton, found):
        have = [f"{role} {skeleton.names[j]!r}" for role, j in found.items()]
        lack = ", ".join(missing) or _unordered(skeleton, found)
        raise ValueError(
            f"no person: missing {lack}; found {_listed(have) or 'nothing'} among the "
            f"joints {_listed(skeleton.names)}"
        )
    legs = [found[side + "UpperLeg"] for side in (LEFT, RIGHT)]
    arms = [found[side + "UpperArm"] for side in (LEFT, RIGHT)]
    # Of the trunk, too: legs may hang on a pelvis beside the spine, and arms likewise.
    top = [found[role] for role in ("head", "neck") if role in found][:1]
    if "chest" not in told:
        found["chest"] = _lowest_common(skeleton, [*arms, *top])
    if "hips" not in told:
        found["hips"] = _lowest_common(skeleton, [*legs, found["chest"]])
    hung = [("hips", joint) for joint in (*legs, found["chest"])]
    hung += [("chest", joint) for joint in (*top, *arms)]
    for role, joint in hung:
        if found[role] not in anatomy.chain(skeleton.parents, joint):
            raise ValueError(
                f"no person: {skeleton.names[joint]!r} does not hang on the {role} "
                f"({skeleton.names[found[role]]!r})"
            )
    return {role: skeleton.names[found[role]] for role in ROLES if role in found}


def _unordered(skeleton: Skeleton, found: Mapping[str, int]) -> str:
    """The first joint of a limb that is not below the one before."""
    for side in (LEFT, RIGHT):
        for parts in (_ARM[1:], _LEG[:3]):
            for upper, lower in zip(parts, parts[1:], strict=False):
                a, b = found[side + upper], found[side + lower]
                if a == b or a not in anatomy.chain(skeleton.parents, b):
                    return (
                        f"{side}{lower} below {side}{upper} ({skeleton.names[b]!r} is "
                        f"not below {skeleton.names[a]!r})"
                    )
    return "an arm or leg whose joints follow each other"


def _listed(names: list[str] | tuple[str, ...]) -> str:
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return ", ".join(name[:40] for name in names[:12]) + more


def anatomy_of(skeleton: Skeleton, roles: Mapping[str, str]) -> Anatomy:
    """Trunk and limbs of a skeleton whose roles are known.

    `ValueError` if all limbs hang on one joint that is not above the feet.
    """
    parents = skeleton.parents
    index = {role: skeleton.names.index(name) for role, name in roles.items()}
    top = index.get("head", index.get("neck", index["chest"]))
    trunk = anatomy.chain(parents, top)
    sides = [MIDDLE] * len(parents)
    made: dict[str, list[Limb]] = {"arms": [], "legs": []}
    for kind, parts in (("arms", _ARM[1:]), ("legs", _LEG[:3])):
        for side in (LEFT, RIGHT):
            upper, middle, end = (index[side + part] for part in parts)
            before = [j for j in anatomy.chain(parents, upper) if j not in trunk][:-1]
            across = anatomy.chain(
                parents, index[(RIGHT if side == LEFT else LEFT) + parts[0]]
            )
            own = [j for j in (*before, upper) if j not in across]
            after = [index[side + "Toes"]] if side + "Toes" in index else []
            made[kind].append(
                Limb(
                    before=tuple(before),
                    upper=upper,
                    middle=middle,
                    end=end,
                    after=tuple(after) if kind == "legs" else (),
                    side=side,
                )
            )
            for j in range(len(parents)):
                if own and own[0] in anatomy.chain(parents, j):
                    sides[j] = side
    places = anatomy.zero_pose(skeleton)
    feet = np.mean([places[leg.end] for leg in made["legs"]], axis=0)
    rise = places[top] - feet
    upright = bool(rise[1] > 0.8 * np.linalg.norm(rise))
    if len(trunk) < 2 and not upright:
        raise ValueError(
            f"no person: arms and legs hang on {skeleton.names[top]!r} alone, without "
            "a spine, so nothing tells which way is up"
        )
    return Anatomy(
        trunk=tuple(trunk),
        has_head="head" in index,
        arms=tuple(made["arms"]),
        legs=tuple(made["legs"]),
        sides=tuple(sides),
        upright=upright,
    )


def tables() -> dict[str, Any]:
    """The words of names, for `viz/web/person.js`; patterns with their flags."""
    return {
        "roles": list(ROLES),
        "words": {part: list(words) for part, words in _WORDS.items()},
        "heads": list(_HEADS),
        "necks": list(_NECKS),
        "noise": sorted(_NOISE),
        "helpers": sorted(_HELPERS),
        "token": _TOKEN.pattern,
        "sides": anatomy.side_patterns(),
    }
