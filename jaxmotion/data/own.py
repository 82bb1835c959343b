"""A folder of BVH or FBX files of one skeleton as clips: whatever the tool wrote.

Every file is brought to world positions and rotations of its joints; scale and up axis
are read off the skeleton, or given; what hangs off trunk, arms and legs (fingers,
twist helpers, props) is left out unless asked for.
"""

import csv
import dataclasses
import io
import itertools
import re
from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxmotion.data import bvh, bvh_text
from jaxmotion.data.clips import Clips, clips_from_motions
from jaxmotion.motion import anatomy, facing
from jaxmotion.motion.skeleton import Motion, Skeleton

# From the root to the farthest joint an adult measures about so much, meters.
_REACH = 1.05
_UNITS = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001, "inches": 0.0254}
_COLUMNS = ["file", "start", "end", "label"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recording:
    """A file: joints in its own world and units.

    Attributes:
      name: Path, for messages and labels.
      positions: [F, J, 3] of the joints.
      rotations: [F, J, 3, 3] of the joints, world.
      unit: Meters per unit, as the file says; None if it does not.
      up: As the file says; None if it does not.
    """

    name: str
    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray
    rotations: np.ndarray
    fps: float
    unit: float | None = None
    up: Literal["y", "z"] | None = None

    def part(self, joints: list[int]) -> "Recording":
        """Some joints, each with the nearest of them above it as its parent."""
        parents = []
        for joint in joints:
            parent = self.parents[joint]
            while parent >= 0 and parent not in joints:
                parent = self.parents[parent]
            parents.append(joints.index(parent) if parent >= 0 else -1)
        return dataclasses.replace(
            self,
            names=tuple(self.names[joint] for joint in joints),
            parents=tuple(parents),
            positions=self.positions[:, joints],
            rotations=self.rotations[:, joints],
        )

    def offsets(self) -> np.ndarray:
        """Of all frames, in the parents' frames [F, J, 3]; the root's are zero."""
        above = [max(parent, 0) for parent in self.parents]
        bones = self.positions - self.positions[:, above]
        turned = np.swapaxes(self.rotations[:, above], -1, -2) @ bones[..., None]
        return turned[..., 0]

    def skeleton(self) -> Skeleton:
        """In the file's units."""
        return Skeleton(
            offsets=jnp.asarray(self.offsets().mean(axis=0), jnp.float32),
            parents=self.parents,
            names=self.names,
        )


def read_bvh(name: str, data: bytes) -> Recording:
    """A BVH file, of any order of channels; a `ValueError` names a malformed one."""
    content = bvh_text.read_bvh(data, name=name)
    positions, rotations = bvh.bvh_transforms(content)
    positions, rotations = np.array(positions), np.array(rotations)
    for joint, parent in enumerate(content.parents):
        if parent >= 0:
            above = rotations[:, parent]
            moved = (above @ positions[:, joint, :, None])[..., 0]
            positions[:, joint] = positions[:, parent] + moved
            rotations[:, joint] = above @ rotations[:, joint]
    return Recording(
        name=name,
        names=content.names,
        parents=content.parents,
        positions=positions,
        rotations=rotations,
        fps=bvh.frame_rate(content.frame_time, content.frame_decimals),
    )


def _kept(recording: Recording, all_joints: bool) -> list[int]:
    """Joints from the pelvis on; of trunk and limbs alone unless all are wanted."""
    found = anatomy.find_anatomy(recording.skeleton())
    if not found.legs:
        return list(range(len(recording.parents)))
    pelvis = recording.parents[found.legs[0].first]
    limbs = {
        joint
        for limb in (*found.arms, *found.legs)
        for joint in (*limb.before, limb.upper, limb.middle, limb.end)
    }
    limbs |= {leg.after[0] for leg in found.legs if leg.after} | {*found.trunk}
    return [
        joint
        for joint in range(len(recording.parents))
        if pelvis in anatomy.chain(recording.parents, joint)
        and (all_joints or joint in limbs)
    ]


def _unit(recording: Recording) -> tuple[float, str]:
    """Meters per unit, and why."""
    if recording.unit is not None:
        return recording.unit, "as the file says"
    lengths = np.linalg.norm(recording.offsets().mean(axis=0), axis=-1)
    for joint, parent in enumerate(recording.parents):
        lengths[joint] += lengths[parent] if parent >= 0 else 0.0
    reach = float(lengths.max())
    if not reach > 0:
        raise ValueError(f"{recording.name}: all bones are of length 0")
    word = min(_UNITS, key=lambda unit: abs(np.log(_UNITS[unit] * reach / _REACH)))
    return _UNITS[
        word
    ], f"{word}: {reach:.4g} units from the root to the farthest joint"


def _up(recording: Recording) -> tuple[Literal["y", "z"], str]:
    """The axis that is up, and why."""
    if recording.up is not None:
        return recording.up, "as the file says"
    found = anatomy.find_anatomy(recording.skeleton())
    if not found.legs:
        raise ValueError(
            f"{recording.name}: no trunk with arms and legs among the joints "
            f"{', '.join(recording.names)}, so --up is needed"
        )
    feet = np.mean([recording.positions[:, leg.end] for leg in found.legs], axis=0)
    rise = (recording.positions[:, found.trunk[-1]] - feet).mean(axis=0)
    rise = rise / max(np.linalg.norm(rise), 1e-9)
    if rise[1] < 0.7 and rise[2] < 0.7:
        raise ValueError(
            f"{recording.name}: the body points along {rise.round(2).tolist()}: "
            "neither y nor z is up, and --up is needed"
        )
    axis = "y" if rise[1] > rise[2] else "z"
    return axis, f"the body points along {rise.round(2).tolist()}"


def _feet(skeleton: Skeleton, given: tuple[str, ...]) -> tuple[int, ...]:
    """Joints whose contact counts, left before right."""
    if given:
        return tuple(skeleton.index(name) for name in given)
    legs = anatomy.find_anatomy(skeleton).legs
    if not legs:
        raise ValueError(
            f"no legs among the joints {', '.join(skeleton.names)}, so --feet is needed"
        )
    legs = sorted(legs, key=lambda leg: leg.side != anatomy.LEFT)
    return tuple(leg.after[0] if leg.after else leg.end for leg in legs)


def _motion(recording: Recording, scale: float, up: str) -> Motion:
    """In meters, y up."""
    # x stays; z up becomes y up by a quarter turn about it.
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) if up == "z" else np.eye(3)
    root = scale * recording.positions[:, 0] @ turn.T
    return Motion(
        root_position=jnp.asarray(root, jnp.float32),
        joint_rotation=anatomy.local_columns(
            recording.parents, turn @ recording.rotations
        ),
        fps=recording.fps,
    )


def as_recorded(recording: Recording) -> tuple[Skeleton, Motion]:
    """One file with all its joints, in meters, y up; its bones are of mean lengths.

    `ValueError` if neither y nor z is up, or no bone has a length.
    """
    scale, _ = _unit(recording)
    skeleton = dataclasses.replace(
        recording.skeleton(),
        offsets=jnp.asarray(scale * recording.offsets().mean(axis=0), jnp.float32),
    )
    return skeleton, _motion(recording, scale, _up(recording)[0])


def _bones(part: Recording, scale: float, tolerance: float) -> np.ndarray:
    """Offsets [J, 3] of a file, meters, which must not change within it."""
    every = scale * part.offsets()
    bones = every.mean(axis=0)
    change = np.abs(every - bones).max(axis=(0, 2))
    change[0] = 0.0
    if change.max() > tolerance:
        worst = int(change.argmax())
        raise ValueError(
            f"{part.name}: the bone to {part.names[worst]!r} changes by "
            f"{change[worst]:.3g} m within the file, more than the tolerance of "
            f"{tolerance:g} m"
        )
    return bones


def _check_same(
    part: Recording, bones: np.ndarray, first: Skeleton, file: str, tolerance: float
) -> None:
    """Raises unless a file has the skeleton of the first one."""
    away = np.abs(bones - np.asarray(first.offsets)).max(axis=-1)
    if away.max() > tolerance or part.parents != first.parents:
        worst = int(away.argmax())
        raise ValueError(
            f"{part.name}: the bone to {part.names[worst]!r} differs by "
            f"{away[worst]:.3g} m from the first file's ({file}), more than "
            f"the tolerance of {tolerance:g} m: files of one skeleton are expected"
        )


def _pieces(
    motion: Motion, file: str, start: float, end: float, longest: float
) -> list[Motion]:
    """A part of a file, seconds, in pieces of about one length."""
    seconds = len(motion.root_position) / motion.fps
    if start >= seconds or seconds + 1.0 / motion.fps < end < np.inf:
        until = "on" if end == np.inf else f"to {end:g} s"
        raise ValueError(
            f"{file}: a part from {start:g} s {until}, but the file ends at "
            f"{seconds:.4g} s"
        )
    first, last = (round(x * motion.fps) for x in (start, min(end, seconds)))
    if last - first < 2:
        raise ValueError(
            f"{file}: a part from {start:g} s to {end:g} s has {last - first} frames "
            f"at {motion.fps:g} per second, expected two or more"
        )
    count = max(int(np.ceil((last - first) / motion.fps / longest)), 1)
    edges = np.linspace(first, last, count + 1).round().astype(int)
    return [
        dataclasses.replace(
            motion,
            root_position=motion.root_position[a:b],
            joint_rotation=motion.joint_rotation[a:b],
        )
        for a, b in itertools.pairwise(edges)
    ]


def read_labels(name: str, text: str) -> list[tuple[str, float, float, str]]:
    """Rows (file, start, end, label) of a table of parts of files; times in seconds.

    An empty end is the file's; an empty start its beginning. A `ValueError` names the
    first line that is wrong.
    """
    rows = csv.reader(io.StringIO(text, newline=None))  # lines may end in any way
    head = [word.strip().lower() for word in next(rows, [])]
    if head != _COLUMNS:
        raise ValueError(
            f"{name}: line 1 is {','.join(head)!r}, expected {','.join(_COLUMNS)!r}"
        )
    found = []
    for row in rows:
        if not any(word.strip() for word in row):
            continue
        where = f"{name}: line {rows.line_num}"
        if len(row) != 4:
            raise ValueError(f"{where} has {len(row)} fields, expected 4")
        file, start, end, label = (word.strip() for word in row)
        try:
            times = float(start or 0.0), float(end or "inf")
        except ValueError:
            raise ValueError(
                f"{where}: start {start!r} and end {end!r}, expected seconds"
            ) from None
        if not (file and label):
            raise ValueError(f"{where} names no {'label' if file else 'file'}")
        if not 0 <= times[0] < times[1]:
            raise ValueError(f"{where}: {times[0]:g} s to {times[1]:g} s is no part")
        for other, begin, stop, _ in found:
            if file == other and begin < times[1] and times[0] < stop:
                raise ValueError(
                    f"{where}: {times[0]:g} s to {times[1]:g} s is in part that of "
                    f"another line, {begin:g} s to {stop:g} s"
                )
        found.append((file, *times, label))
    if not found:
        raise ValueError(f"{name}: no lines after the first")
    return found


def _parts(
    name: str, folder: str, table: list[tuple] | None
) -> list[tuple[float, float, str]]:
    """Start, end and label of the parts of a file."""
    path = PurePosixPath(name.replace("\\", "/"))
    if table is not None:
        return [row[1:] for row in table if row[0] in (path.name, path.stem)]
    inside = PurePosixPath(name.removeprefix(folder).lstrip("/").replace("\\", "/"))
    above = [re.sub(r"\.zip$", "", part, flags=re.I) for part in inside.parts[:-1]]
    # A folder, also within a zip; else the zip.
    folders = [x for x, part in zip(above, inside.parts, strict=False) if x == part]
    return [(0.0, np.inf, [*folders, *above, "all"][0])]


def clips_from_recordings(
    recordings: Iterable[Recording],
    *,
    folder: str = "",
    table: list[tuple[str, float, float, str]] | None = None,
    scale: float | None = None,
    up: Literal["y", "z"] | None = None,
    feet: tuple[str, ...] = (),
    all_joints: bool = False,
    tolerance: float = 0.01,
    longest: float = float("inf"),
    source: str = "",
) -> tuple[Clips, list[str]]:
    """Clips of one skeleton, the first file's, with labels "style" and "take".

    Args:
      folder: Where the files lie; the folders below it are the styles.
      table: Rows of `read_labels`; files that it does not name are left out.
      scale: Meters per unit; None for what the first file says or its bones suggest.
      up: The same of the axis.
      feet: Names of the joints whose contact counts, left before right; None for the
        toes, or ankles without any.
      all_joints: Keep fingers and helpers too.
      tolerance: Largest difference of a bone within a file, and from the first file's,
        whose bones all clips get, meters.
      longest: Longer takes become several clips, so that some can be held out, seconds.
      source: What to cite, and its license.

    Returns:
      The clips, and what was detected, a line each.

    Raises:
      ValueError: if files have different skeletons, or what cannot be detected is not
        given; names file and joint.
    """
    notes: list[str] = []
    skeleton: Skeleton | None = None
    joints: list[str] = []
    motions, names, styles, takes = [], [], [], []
    seen: set[str] = set()
    for recording in recordings:
        path = PurePosixPath(recording.name.replace("\\", "/"))
        seen |= {path.name, path.stem}
        parts = _parts(recording.name, folder, table)
        if not parts:
            continue
        if skeleton is None:
            part = recording.part(_kept(recording, all_joints))
            joints = list(part.names)
            if scale is None:
                scale, why = _unit(part)
                notes.append(f"scale    {scale:g} m per unit ({why})")
            if up is None:
                up, why = _up(part)
                notes.append(f"up       {up} ({why})")
            notes.append(f"joints   {len(joints)} of {len(recording.names)} are kept")
        assert scale is not None and up is not None  # of the first file
        missing = [name for name in joints if name not in recording.names]
        if missing:
            raise ValueError(
                f"{recording.name}: no joint {missing[0]!r}, which the first file has "
                f"({takes[0]}): files of one skeleton are expected"
            )
        part = recording.part([recording.names.index(name) for name in joints])
        bones = _bones(part, scale, tolerance)
        if skeleton is None:
            skeleton = Skeleton(
                offsets=jnp.asarray(bones, jnp.float32),
                parents=part.parents,
                names=part.names,
            )
        else:
            _check_same(part, bones, skeleton, takes[0], tolerance)
        motion = _motion(part, scale, up)
        take = recording.name.removeprefix(folder).lstrip("/").rsplit(".", 1)[0]
        for number, (start, end, label) in enumerate(parts):
            pieces = _pieces(motion, recording.name, start, end, longest)
            name = take if len(parts) == 1 else f"{take}_{number}"
            motions += pieces
            if len(pieces) == 1:
                names.append(name)
            else:
                names += [f"{name}-{piece}" for piece in range(len(pieces))]
            styles += [label] * len(pieces)
            takes += [take] * len(pieces)
    for row in table or ():
        if row[0] not in seen:
            raise ValueError(f"the labels name a file {row[0]!r}, which is not there")
    if skeleton is None:
        raise ValueError("no files, or none that the labels name")
    try:
        facing.hip_joints(skeleton)
    except ValueError:
        known = anatomy.mixamo_names(skeleton, prefix="")
        pairs = zip(joints, known, strict=True)
        changed = ", ".join(f"{a}: {b}" for a, b in pairs if a != b)
        notes.append(f"renamed  {changed}")
        feet = tuple(known[skeleton.index(foot)] for foot in feet)
        skeleton = dataclasses.replace(skeleton, names=known)
    skeleton = dataclasses.replace(skeleton, feet=_feet(skeleton, feet))
    clips = clips_from_motions(
        motions,
        skeleton,
        names=names,
        labels={"style": styles, "take": takes},
        source=source or "own motion",
    )
    return clips, notes
