"""FBX files by ufbx: the joints of their animation in the file's world."""

from typing import Literal

import numpy as np

from jaxmotion.data.own import Recording

_UPS: dict[int, Literal["y", "z"]] = {2: "y", 4: "z"}  # ufbx.CoordinateAxis


def _matrix(transform) -> np.ndarray:
    """[4, 4] of translation, rotation and scale."""
    t, q, s = transform.translation, transform.rotation, transform.scale
    x, y, z, w = q.x, q.y, q.z, q.w
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn * [s.x, s.y, s.z], (t.x, t.y, t.z)
    return found


def read_fbx(
    name: str, data: bytes, *, fps: float = 30.0, rest: bool = False
) -> Recording:
    """The animation of an FBX file's bones; of several takes the longest.

    It is sampled at `fps` frames per second; with `rest`, a file without animation is
    one frame, as its bones are. `ModuleNotFoundError` without the extra [fbx]; a
    `ValueError` names what is no FBX, or has no bones or no animation.
    """
    try:
        import ufbx
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            'FBX needs the package ufbx: pip install -e ".[fbx]"'
        ) from None
    try:
        scene = ufbx.load_memory(data)
    except Exception as error:
        raise ValueError(f"{name}: no FBX file ({error})") from None
    # All of its objects are held: those that are let go crash when asked for again.
    held = [list(scene.nodes), list(scene.bones), list(scene.anim_stacks)]
    nodes, stacks = held[0], held[2]
    bones = [node for node in nodes if node.bone is not None]
    if not bones:
        raise ValueError(f"{name}: the FBX has no bones")
    takes = [take for take in stacks if take.time_end > take.time_begin]
    if not takes and not rest:
        raise ValueError(f"{name}: the FBX has no animation")
    times = np.zeros(1)
    if takes:
        take = max(takes, key=lambda take: take.time_end - take.time_begin)
        count = int((take.time_end - take.time_begin) * fps + 1e-6) + 1
        times = take.time_begin + np.arange(count) / fps

    def local(node, time: float) -> np.ndarray:
        if not takes:
            return _matrix(node.local_transform)
        return _matrix(ufbx.evaluate_transform(take.anim, node, time))

    # Bones of one tree, parents first; nodes between them, and above the root (an
    # armature), move what is below.
    index = {node.element_id: i for i, node in enumerate(bones)}
    parents, between = [], []
    for bone in bones:
        above, up = [], bone.parent
        while up is not None and up.element_id not in index:
            above.insert(0, up)
            up = up.parent
        parents.append(-1 if up is None else index[up.element_id])
        between.append(above)
    root = max(
        (i for i, parent in enumerate(parents) if parent < 0),
        key=lambda i: sum(_below(parents, i, j) for j in range(len(bones))),
    )
    order = sorted(
        (j for j in range(len(bones)) if _below(parents, root, j)),
        key=lambda j: (_depth(parents, j), j),
    )
    places = [order.index(parents[j]) if at else -1 for at, j in enumerate(order)]
    world = np.zeros((len(times), len(order), 4, 4))
    for frame, time in enumerate(times):
        for at, j in enumerate(order):
            place = np.eye(4) if at == 0 else world[frame, places[at]]
            for node in (*between[j], bones[j]):
                place = place @ local(node, time)
            world[frame, at] = place
    turns = world[..., :3, :3]
    turns = turns / np.linalg.norm(turns, axis=-2, keepdims=True)
    if (np.linalg.det(turns) < 0.9).any():
        raise ValueError(f"{name}: bones are mirrored or sheared")
    return Recording(
        name=name,
        names=tuple(bones[j].name for j in order),
        parents=tuple(places),
        positions=world[..., :3, 3],
        rotations=turns,
        fps=fps,
        unit=float(scene.settings.unit_meters),
        up=_UPS.get(int(scene.settings.axes.up)),
    )


def _depth(parents: list[int], joint: int) -> int:
    return 0 if parents[joint] < 0 else 1 + _depth(parents, parents[joint])


def _below(parents: list[int], top: int, joint: int) -> bool:
    while joint >= 0 and joint != top:
        joint = parents[joint]
    return joint == top
