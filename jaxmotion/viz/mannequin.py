"""A skinned mannequin around any skeleton, made from the skeleton alone.

Flesh is a set of lofts: straight axes with ellipses along them, in an adult's
proportions, scaled to the legs. Their smooth union is a distance, whose zero set is
meshed by surface nets (one vertex per cell that the surface crosses, relaxed and then
moved onto the surface along the distance's gradient, which is also the normal). Surface
nets rather than marching cubes: half the vertices, no slivers, and eighty lines of
NumPy instead of a dependency. The grid is finer where hands, feet and head are.

The same lofts say what each vertex follows (the softest blend of the lofts that are
nearest, each of which hands its flesh from joint to joint along its axis) and what
color it has. The mesh is made in a pose between a T and hanging arms, so that
shoulders look right in both.

Source: Gibson 1998 (surface nets); Quilez (smooth minimum, ellipsoid bound).
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxmotion.motion import anatomy
from jaxmotion.motion.anatomy import Anatomy, Limb, unit
from jaxmotion.motion.skeleton import Skeleton

# Thigh and shank of the adult whose measures stand below, meters.
_LEG = 0.87
_UP, _AHEAD = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
_ACROSS = np.array([1.0, 0.0, 0.0])
# Of the pose in which the mesh is made, degrees: arms below level, legs outward.
_ARMS_DOWN, _LEGS_OUT = 42.0, 5.0
# Edge of the grid's cells, and over how much flesh is handed over, adult's meters.
_CELL, _HANDOVER = 0.032, 0.012
# How often normals are averaged with their neighbors': light lies softly.
_SOFTEN = 4
_DETAIL = {"fine": 1.0, "crowd": 2.0}

IVORY = "#d8cfc0"
SIDED = {
    anatomy.LEFT: ("#4a83bd", "#2b5a8c"),
    anatomy.RIGHT: ("#c65a52", "#8f3a36"),
    anatomy.MIDDLE: ("#b9b0a2", "#8c857a"),
}
PALETTE = (IVORY, *(color for pair in SIDED.values() for color in pair))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Mannequin:
    """A closed mesh that follows the joints of a skeleton.

    Attributes:
      vertices: [V, 3] in the bind pose, meters; those on a seam between two colors
        stand twice.
      normals: [V, 3] outward.
      faces: [T, 3] counterclockwise from outside.
      joints: [V, 4] that a vertex follows.
      weights: [V, 4] how much, descending; they sum to 1.
      materials: [V] index of its color; the same for the three corners of a face.
      palette: Colors, such as "#d8cfc0".
      bind_position: [J, 3] of the joints where the mesh was made, world, meters.
      bind_rotation: [J, 3, 3] of the joints there, world.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    materials: np.ndarray
    palette: tuple[str, ...]
    bind_position: np.ndarray
    bind_rotation: np.ndarray

    @functools.cached_property
    def inverse_bind(self) -> Float[np.ndarray, "joints 3 4"]:
        """From the world of the bind pose to each joint's frame."""
        back = np.swapaxes(self.bind_rotation, -1, -2)
        shift = -(back @ self.bind_position[..., None])
        return np.concatenate([back, shift], axis=-1)

    @functools.cached_property
    def outline(self) -> np.ndarray:
        """Indices of vertices between which all others are, nearly, in any pose."""
        main = self.joints[:, 0]
        sides = np.stack(np.meshgrid(*([[-1, 0, 1]] * 3)), axis=-1).reshape(-1, 3)
        found = []
        for joint in np.unique(main):
            mine = np.flatnonzero(main == joint)
            found += [*mine[(self.vertices[mine] @ sides.T).argmax(axis=0)]]
        return np.unique(found)

    @functools.cached_property
    def _spread(self) -> np.ndarray:
        """Weights [V, J]."""
        found = np.zeros((len(self.vertices), len(self.bind_position)), np.float32)
        rows = np.arange(len(found))[:, None]
        np.add.at(found, (rows, self.joints), self.weights)
        return found

    def skin(
        self,
        positions: Float[np.ndarray, "*batch joints 3"],
        rotations: Float[np.ndarray, "*batch joints 3 3"],
        *,
        only: np.ndarray | slice = slice(None),
    ) -> tuple[
        Float[np.ndarray, "*batch vertices 3"], Float[np.ndarray, "*batch vertices 3"]
    ]:
        """Vertices, meters, and unit normals in the world: linear blend skinning.

        Args:
          positions: Of the joints, world, meters; see `anatomy.kinematics`.
          rotations: Of the joints, world.
          only: Indices of vertices.
        """
        moved = np.asarray(rotations, np.float32) @ self.inverse_bind.astype("f4")
        moved[..., 3] += np.asarray(positions, np.float32)
        batch = moved.shape[:-3]
        blended = self._spread[only] @ moved.reshape(*batch, -1, 12)
        blended = blended.reshape(*batch, -1, 3, 4)
        normals = (blended[..., :3] @ self.normals[only][..., None])[..., 0]
        places = (blended[..., :3] @ self.vertices[only][..., None])[..., 0]
        places += blended[..., 3]
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        return places, normals / np.maximum(length, 1e-6)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Loft:
    """Ellipses along an axis, with round ends.

    Attributes:
      start, axis: Where it begins, and its direction.
      side, depth: Directions of its first and second half axis.
      at: [n] meters along the axis, ascending.
      shape: [n, 4] half width, half depth, and shift of the center to both.
      owners: Meters along the axis, and the joint that its flesh follows from halfway
        to the one before to halfway to the next.
      colors: Meters along the axis from which it has a color of the palette.
      blend: Over how much it melts into what came before, meters.
      caps: Heights of the round ends, meters.
      floor: Height at which it is cut level; None for nowhere.
    """

    start: np.ndarray
    axis: np.ndarray
    side: np.ndarray
    depth: np.ndarray
    at: np.ndarray
    shape: np.ndarray
    owners: tuple[tuple[float, int], ...]
    colors: tuple[tuple[float, int], ...]
    blend: float
    caps: tuple[float, float]
    floor: float | None = None

    @functools.cached_property
    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """The shape at many places: a cubic through the stations."""
        slope = np.gradient(self.shape, self.at, axis=0) if len(self.at) > 2 else None
        fine = np.linspace(self.at[0], self.at[-1], 48)
        if slope is None:
            rows = [np.interp(fine, self.at, column) for column in self.shape.T]
            return fine, np.stack(rows)
        i = np.clip(np.searchsorted(self.at, fine) - 1, 0, len(self.at) - 2)
        h = (self.at[i + 1] - self.at[i])[:, None]
        t = (fine - self.at[i])[:, None] / h
        a, b = self.shape[i], self.shape[i + 1]
        found = a * (1 + 2 * t) * (1 - t) ** 2 + b * t * t * (3 - 2 * t)
        found += h * (slope[i] * t * (1 - t) ** 2 - slope[i + 1] * t * t * (1 - t))
        return fine, found.T

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box around it."""
        centers = self.start + np.outer(self.at, self.axis)
        radius = self.shape[:, :2].max(1) + np.abs(self.shape[:, 2:]).max(1)
        radius[[0, -1]] = np.maximum(radius[[0, -1]], self.caps)
        return (
            (centers - radius[:, None]).min(axis=0),
            (centers + radius[:, None]).max(axis=0),
        )

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Meters to the surface [n], negative inside, nearly; meters along the axis."""
        local = points - self.start
        along = local @ self.axis
        inside = np.clip(along, self.at[0], self.at[-1])
        fine, rows = self.table
        spot = (inside - fine[0]) * ((len(fine) - 1) / max(fine[-1] - fine[0], 1e-9))
        low = np.clip(spot.astype(int), 0, len(fine) - 2)
        part = spot - low
        wide, deep, x, z = rows[:, low] * (1 - part) + rows[:, low + 1] * part
        over = np.where(along < inside, *self.caps)
        q = np.stack(
            [
                (local @ self.side - x) / wide,
                (local @ self.depth - z) / deep,
                (along - inside) / over,
            ]
        )
        size = np.sqrt(np.sum(q * q, axis=0))
        steep = np.sqrt((q[0] / wide) ** 2 + (q[1] / deep) ** 2 + (q[2] / over) ** 2)
        found = np.where(size > 1e-6, size * (size - 1) / (steep + 1e-9), -deep)
        if self.floor is not None:
            below = self.floor - points[:, 1]
            found = -_melt(-found, -below, 0.5 * self.blend)
        return found, along


def _melt(a: np.ndarray, b: np.ndarray, blend: float) -> np.ndarray:
    """Smooth minimum."""
    h = np.maximum(blend - np.abs(a - b), 0.0)
    return np.minimum(a, b) - h * h / (4 * blend)


def _distance(lofts: Sequence[_Loft], points: np.ndarray) -> np.ndarray:
    """Meters to the body's surface [n], negative inside."""
    found = lofts[0].distance(points)[0]
    for loft in lofts[1:]:
        found = _melt(found, loft.distance(points)[0], loft.blend)
    return found


def _gradient(lofts: Sequence[_Loft], points: np.ndarray, step: float) -> np.ndarray:
    """Of the distance [n, 3], by differences over four corners of a cube."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    around = points[None] + step * corners[:, None]
    values = _distance(lofts, around.reshape(-1, 3)).reshape(4, -1)
    return values.T @ corners / (4 * step)


# Surface nets.


@functools.cache
def _is_simple() -> np.ndarray:
    """[256] whether a cell with such corners inside is crossed by one plain sheet.

    Bit 4x + 2y + z is the corner (x, y, z). Not so where corners of one kind touch
    only across a face or through the cell.
    """
    corners = np.array([[c >> 2 & 1, c >> 1 & 1, c & 1] for c in range(8)])
    near = np.abs(corners[:, None] - corners).sum(axis=-1) == 1
    found = np.zeros(256, bool)
    for code in range(256):
        kinds = np.array([code >> c & 1 for c in range(8)])
        parts = 0
        for kind in (0, 1):
            left = {int(c) for c in np.flatnonzero(kinds == kind)}
            while left:
                parts += 1
                edge = [left.pop()]
                while edge:
                    more = {c for c in left if near[edge[-1], c]}
                    edge.pop()
                    left -= more
                    edge += more
        faces = [kinds[corners[:, a] == side] for a in range(3) for side in (0, 1)]
        crossed = any(f[0] == f[3] != f[1] == f[2] for f in faces)
        found[code] = parts <= 2 and not crossed
    return found


def _codes(inside: np.ndarray) -> np.ndarray:
    """Corners inside of each cell, as bits."""
    n = np.array(inside.shape) - 1
    found = np.zeros(n, np.uint8)
    for c in range(8):
        x, y, z = c >> 2 & 1, c >> 1 & 1, c & 1
        part = inside[x : x + n[0], y : y + n[1], z : z + n[2]]
        found |= part.astype(np.uint8) << c
    return found


def _surface_net(
    field: np.ndarray, axes: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh of where a field is negative: vertices [V, 3], quads [Q, 4].

    Cells that the surface would cross in more than one sheet are filled first, so that
    every edge has two faces.
    """
    inside = field < 0
    codes = _codes(inside)
    while not _is_simple()[codes].all():
        for x, y, z in np.argwhere(~_is_simple()[codes]):
            inside[x : x + 2, y : y + 2, z : z + 2] = True
        codes = _codes(inside)
    field = np.where(inside, np.minimum(field, -1e-6), np.maximum(field, 1e-6))
    crossed = (codes > 0) & (codes < 255)
    cells = np.argwhere(crossed)
    number = np.full(codes.shape, -1)
    number[crossed] = np.arange(len(cells))
    # Each vertex is the mean of where its cell's edges are crossed.
    total, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    quads = []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        low = np.moveaxis(field, axis, 0)
        edges = np.argwhere((low[:-1] < 0) != (low[1:] < 0))
        a, b = low[tuple(edges.T)], low[tuple((edges + [1, 0, 0]).T)]
        places = np.empty((len(edges), 3))
        places[:, axis] = edges[:, 0] + a / (a - b)
        places[:, others] = edges[:, 1:]
        around = []
        for i, j in ((1, 1), (0, 1), (0, 0), (1, 0)):
            cell = np.empty((len(edges), 3), int)
            cell[:, axis] = edges[:, 0]
            cell[:, others] = edges[:, 1:] - [i, j]
            around.append(number[tuple(cell.T)])
        for cell in around:
            np.add.at(total, cell, places)
            np.add.at(count, cell, 1.0)
        quad = np.stack(around, axis=-1)
        turned = (a > 0) if axis != 1 else (a < 0)
        quads.append(np.where(turned[:, None], quad[:, ::-1], quad))
    spots = total / count[:, None]
    columns = [
        np.interp(spots[:, i], np.arange(len(axis)), axis)
        for i, axis in enumerate(axes)
    ]
    return np.stack(columns, axis=-1), np.concatenate(quads)


def _triangles(places: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Quads cut along their shorter diagonals."""
    a, b, c, d = (places[quads[:, i]] for i in range(4))
    short = np.linalg.norm(a - c, axis=-1) <= np.linalg.norm(b - d, axis=-1)
    one = quads[:, [0, 1, 2, 0, 2, 3]]
    two = quads[:, [1, 2, 3, 1, 3, 0]]
    return np.where(short[:, None], one, two).reshape(-1, 3)


class _Neighbors:
    """Who shares an edge with whom."""

    def __init__(self, faces: np.ndarray, number: int):
        pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
        self.of = pairs[:, 1]
        self.starts = np.searchsorted(pairs[:, 0], np.arange(number))
        self.count = np.diff(np.append(self.starts, len(pairs)))[:, None]

    def mean(self, values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values[self.of], self.starts, axis=0) / self.count


# A person's flesh.


def _bind_pose(
    skeleton: Skeleton,
    found: Anatomy,
    sides: tuple[str, ...] | None,
    rotations: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """The T-pose with arms half lowered and legs apart; feet stay level."""
    places, turns = anatomy.t_pose(skeleton, sides, rotations)
    parents = skeleton.parents
    local = places - places[[max(parent, 0) for parent in parents]]
    own = np.broadcast_to(np.eye(3), turns.shape).copy()
    for limbs, degrees in ((found.arms, -_ARMS_DOWN), (found.legs, _LEGS_OUT)):
        for limb in limbs:
            out = places[limb.upper, 0] - places[found.trunk[0], 0]
            angle = np.deg2rad(degrees) * (1.0 if out >= 0 else -1.0)
            c, s = np.cos(angle), np.sin(angle)
            turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
            own[limb.upper] = turn
            if limbs is found.legs:
                own[limb.end] = turn.T
    made = np.zeros_like(places)
    world = np.empty_like(turns)
    for joint, parent in enumerate(parents):
        above = np.eye(3) if parent < 0 else world[parent]
        made[joint] = 0.0 if parent < 0 else made[parent] + above @ local[joint]
        world[joint] = above @ own[joint]
    return made, world @ turns


class _Flesh:
    """Collects lofts; `s` are meters of this body in one of the adult."""

    def __init__(self, parents: tuple[int, ...], places: np.ndarray, s: float):
        self.parents, self.places, self.s = parents, places, s
        self.lofts: list[_Loft] = []

    def loft(
        self,
        start: np.ndarray,
        end: np.ndarray,
        side: np.ndarray,
        stations: Sequence[tuple],
        *,
        owners: Sequence[tuple],
        colors: Sequence[tuple],
        blend: float,
        caps: tuple[float | None, float | None] = (None, None),
        floor: float | None = None,
        toward: np.ndarray = _AHEAD,
    ) -> None:
        """Adds one.

        Args:
          start: Where its stations begin to count.
          end: Where they reach 1.
          side: About where its first half axis points.
          stations: Place; half axes, adult's meters; shifts to both, 0 by default.
          owners: Place and joint.
          colors: Place from which it has a color.
          blend: Adult's meters.
          caps: Heights of the ends, adult's meters; None for round ones.
          floor: Height of a level cut.
          toward: About where its second half axis points.
        """
        length = max(float(np.linalg.norm(end - start)), 1e-6)
        axis = (end - start) / length
        side = unit(side - axis * (side @ axis))
        depth = np.cross(side, axis)
        rows = np.array([[*row, 0.0, 0.0][:5] for row in stations])

        def cap(row: np.ndarray, height: float | None) -> float:
            return self.s * float(min(row[1:3]) if height is None else height)

        self.lofts.append(
            _Loft(
                start=start,
                axis=axis,
                side=side,
                depth=depth if depth @ toward >= 0 else -depth,
                at=rows[:, 0] * length,
                shape=rows[:, 1:] * self.s,
                owners=tuple((at * length, joint) for at, joint in owners),
                colors=tuple((at * length, PALETTE.index(c)) for at, c in colors),
                blend=blend * self.s,
                caps=(cap(rows[0], caps[0]), cap(rows[-1], caps[1])),
                floor=floor,
            )
        )

    def ball(
        self,
        center: np.ndarray,
        radii: tuple[float, float, float],
        *,
        owner: int,
        color: str,
        blend: float,
    ) -> None:
        """Adds an ellipsoid, level with the world; radii along x, y and z."""
        x, y, z = radii
        half = max(y - min(x, z), 1e-3) * self.s * _UP
        self.loft(
            center - half,
            center + half,
            _ACROSS,
            [(0, x, z), (1, x, z)],
            owners=[(0.5, owner)],
            colors=[(-9, color)],
            blend=blend,
        )


def _add_torso(made: _Flesh, found: Anatomy) -> None:
    """Pelvis, belly, chest, shoulders, neck."""
    places, s, trunk = made.places, made.s, found.trunk
    pelvis = trunk.index(made.parents[found.legs[0].first])
    chest = min(trunk.index(made.parents[arm.first]) for arm in found.arms)
    nape = places[trunk[min(chest + 1, len(trunk) - 1)]]
    hips = np.mean([places[leg.upper] for leg in found.legs], axis=0)
    wide_hips = np.mean([abs(places[leg.upper, 0] - hips[0]) for leg in found.legs])
    level = np.mean([places[arm.upper] for arm in found.arms], axis=0)
    wide_chest = np.mean([abs(places[a.upper, 0] - level[0]) for a in found.arms])
    # Half widths beside an adult's, as far as the bones say so.
    h = np.clip(0.5 + 0.5 * wide_hips / (0.09 * s), 0.8, 1.4)
    c = np.clip(0.4 + 0.6 * wide_chest / (0.165 * s), 0.75, 1.4)
    top = np.array([level[0], level[1], 0.6 * nape[2] + 0.4 * level[2]])
    heights = [places[j] for j in trunk[pelvis : chest + 1]]
    long = max(float(np.linalg.norm(top - hips)), 1e-6)
    axis = (top - hips) / long
    owners = [
        (float((p - hips) @ axis) / long, j)
        for p, j in zip(heights, trunk[pelvis : chest + 1], strict=True)
    ]
    # Each drives what is between it and the next one.
    ends = [at for at, _ in owners[1:]] + [1.1]
    owners = [(0.5 * (at + end), j) for (at, j), end in zip(owners, ends, strict=True)]
    made.loft(
        hips,
        top,
        _ACROSS,
        [
            (-0.20, 0.080 * h, 0.074, 0, -0.010),
            (-0.08, 0.140 * h, 0.104, 0, -0.011),
            (0.05, 0.156 * h, 0.112, 0, -0.012),
            (0.20, 0.147 * h, 0.105, 0, -0.006),
            (0.40, 0.131 * 0.5 * (h + c), 0.092, 0, 0.002),
            (0.58, 0.147 * c, 0.104, 0, 0.004),
            (0.80, 0.174 * c, 0.118, 0, 0.002),
            (0.93, 0.160 * c, 0.102, 0, -0.006),
            (1.04, 0.100 * c, 0.070, 0, -0.012),
        ],
        owners=owners,
        colors=[(-9, IVORY)],
        blend=0.03,
        caps=(0.03, None),
    )
    carrier = trunk[chest]
    for arm in found.arms:
        out = np.sign(places[arm.upper, 0] - level[0])
        joint = places[arm.upper]
        root = top + s * np.array([0.03 * out, 0.005, -0.01])
        owner = arm.before[-1] if arm.before else carrier
        made.loft(
            root,
            joint,
            _UP,
            [(0, 0.058, 0.062), (0.5, 0.056, 0.062), (0.95, 0.05, 0.054)],
            owners=[(0.0, carrier), (0.6, owner)],
            colors=[(-9, IVORY)],
            blend=0.05,
        )
        # From the neck's side down to the shoulder.
        made.loft(
            nape + s * np.array([0.028 * out, 0.03, -0.012]),
            joint,
            _AHEAD,
            [(0, 0.03, 0.028), (0.5, 0.034, 0.032), (0.9, 0.036, 0.034)],
            owners=[(0.0, carrier), (0.7, owner)],
            colors=[(-9, IVORY)],
            blend=0.05,
        )
        breast = top + s * np.array([0.074 * c * out, -0.075, 0.070])
        made.ball(breast, (0.072, 0.05, 0.03), owner=carrier, color=IVORY, blend=0.08)
    base, up, _ = _head_frame(made, found)
    low = nape - up * 0.035 * s
    over = trunk[chest + 1 :]
    rise = max(float(np.linalg.norm(base - low)), 1e-6)
    marks = [float((places[j] - low) @ unit(base - low)) / rise for j in over]
    ends = marks[1:] + [1.4]
    made.loft(
        low,
        base + up * 0.03 * s,
        _ACROSS,
        [(0, 0.058, 0.058), (0.5, 0.053, 0.056), (1, 0.052, 0.06)],
        owners=[(-0.6, carrier)]
        + [(0.5 * (m + e), j) for m, e, j in zip(marks, ends, over, strict=True)],
        colors=[(-9, IVORY)],
        blend=0.035,
    )


def _head_frame(
    made: _Flesh, found: Anatomy
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base of the skull, and where up and ahead are."""
    trunk, places = found.trunk, made.places
    top = trunk[-1]
    up = unit(places[top] - places[trunk[-2]])
    up = unit(up + 2.5 * _UP) if up[1] > 0 else up
    base = places[top] + up * (0.0 if found.has_head else 0.09 * made.s)
    return base, up, unit(_AHEAD - up * (_AHEAD @ up))


def _add_head(made: _Flesh, found: Anatomy) -> None:
    s, owner = made.s, found.trunk[-1]
    base, up, ahead = _head_frame(made, found)
    made.loft(
        base,
        base + up * s,
        np.cross(up, ahead),
        [
            (-0.046, 0.036, 0.036, 0, 0.058),
            (-0.024, 0.050, 0.056, 0, 0.042),
            (0.012, 0.063, 0.079, 0, 0.024),
            (0.055, 0.072, 0.093, 0, 0.012),
            (0.090, 0.075, 0.096, 0, 0.006),
        ],
        owners=[(0, owner)],
        colors=[(-9, IVORY)],
        blend=0.018,
        caps=(0.018, 0.082),
    )
    made.loft(
        base + s * (0.055 * up + 0.094 * ahead),
        base + s * (0.018 * up + 0.106 * ahead),
        np.cross(up, ahead),
        [(0, 0.007, 0.008), (0.7, 0.011, 0.012), (1, 0.012, 0.010)],
        owners=[(0, owner)],
        colors=[(-9, IVORY)],
        blend=0.02,
    )


def _add_leg(made: _Flesh, leg: Limb) -> None:
    places, s = made.places, made.s
    hip, knee, ankle = (places[j] for j in (leg.upper, leg.middle, leg.end))
    light, dark = SIDED[leg.side]
    out = np.sign(hip[0] - places[0, 0]) or 1.0
    pelvis = made.parents[leg.first]
    made.ball(
        hip + s * np.array([-0.012 * out, -0.035, -0.052]),
        (0.078, 0.082, 0.062),
        owner=leg.upper,
        color=IVORY,
        blend=0.05,
    )
    made.loft(
        hip,
        knee,
        _ACROSS,
        [
            (0.0, 0.080, 0.092, 0.0, -0.002),
            (0.14, 0.086, 0.094, 0.0, 0.002),
            (0.40, 0.077, 0.085, 0.002 * out, 0.008),
            (0.72, 0.060, 0.065, 0.002 * out, 0.006),
            (0.90, 0.053, 0.057, 0.0, 0.003),
            (1.0, 0.052, 0.055, 0.0, 0.004),
        ],
        owners=[(-0.12, pelvis), (0.10, leg.upper)],
        colors=[(-9, IVORY), (0.30, light)],
        blend=0.07,
    )
    made.loft(
        knee,
        ankle,
        _ACROSS,
        [
            (0.0, 0.051, 0.054, 0, 0.003),
            (0.10, 0.050, 0.054, 0, -0.002),
            (0.28, 0.056, 0.060, 0.003 * out, -0.012),
            (0.55, 0.045, 0.050, 0.002 * out, -0.009),
            (0.82, 0.034, 0.040, 0, -0.004),
            (1.0, 0.035, 0.043, 0, -0.004),
        ],
        owners=[(0, leg.middle)],
        colors=[(-9, light), (0.90, dark)],
        blend=0.02,
    )
    ball = _ball_of_foot(made, leg)
    level = (ball - ankle) * [1.0, 0.0, 1.0]
    level = unit(level) if np.linalg.norm(level) > 1e-6 else _AHEAD
    across = np.cross(_UP, level)
    drop = max(float(ankle[1] - ball[1]), 0.0)
    sole = ball[1] - np.clip(0.098 * s - drop, 0.018 * s, 0.042 * s)
    if leg.after:
        sole = min(sole, places[leg.after[0]][1] - 0.018 * s)
    tall = ankle[1] - sole
    heel = np.array([ankle[0], sole, ankle[2]]) - level * 0.048 * s
    reach = float((ball - heel) @ level)
    tip = heel + level * (reach + 0.075 * s)
    long = reach / (reach + 0.075 * s)
    toe = leg.after[0] if leg.after else leg.end
    up = lambda part: part * tall / s  # noqa: E731
    made.loft(
        heel,
        tip,
        across,
        [
            (0.16, 0.031, up(0.34), 0, up(0.34)),
            (0.40 * long, 0.037, up(0.45), 0, up(0.36)),
            (0.72 * long, 0.042, up(0.31), 0.002 * out, up(0.24)),
            (long, 0.048, up(0.21), 0.002 * out, up(0.165)),
            (0.5 + 0.5 * long, 0.046, up(0.18), 0, up(0.135)),
            (0.88, 0.040, up(0.15), -0.003 * out, up(0.115)),
        ],
        owners=[(long - 0.24, leg.end), (long + 0.18, toe)],
        colors=[(-9, dark)],
        blend=0.02,
        caps=(None, 0.034),
        toward=_UP,
        floor=sole + 0.003 * s,
    )
    made.loft(
        ankle - level * 0.004 * s,
        ankle + (ball - ankle) * 0.62 + _UP * 0.012 * s,
        across,
        [(-0.1, 0.034, 0.042), (0.3, 0.033, 0.036), (1, 0.026, 0.02)],
        owners=[(0, leg.end)],
        colors=[(-9, dark)],
        blend=0.03,
    )


def _ball_of_foot(made: _Flesh, leg: Limb) -> np.ndarray:
    ankle = made.places[leg.end]
    if leg.after:
        return made.places[leg.after[0]]
    return ankle + (0.14 * _AHEAD - 0.075 * _UP) * made.s


def _add_arm(made: _Flesh, arm: Limb) -> None:
    places, s = made.places, made.s
    shoulder, elbow, wrist = (places[j] for j in (arm.upper, arm.middle, arm.end))
    light, dark = SIDED[arm.side]
    carrier = arm.before[-1] if arm.before else made.parents[arm.upper]
    made.loft(
        shoulder,
        elbow,
        _AHEAD,
        [
            (-0.06, 0.050, 0.050),
            (0.10, 0.054, 0.054, 0, 0.002),
            (0.35, 0.046, 0.048, 0, 0.0),
            (0.60, 0.042, 0.042, 0.003, 0.0),
            (0.85, 0.036, 0.036),
            (1.0, 0.034, 0.036),
        ],
        owners=[(-0.16, carrier), (0.12, arm.upper)],
        colors=[(-9, IVORY), (0.36, light)],
        toward=_UP,
        blend=0.035,
    )
    made.loft(
        elbow,
        wrist,
        _AHEAD,
        [
            (0.0, 0.036, 0.035),
            (0.18, 0.042, 0.037),
            (0.45, 0.037, 0.033),
            (0.80, 0.028, 0.022),
            (1.0, 0.028, 0.020),
        ],
        owners=[(0, arm.middle)],
        colors=[(-9, light)],
        toward=_UP,
        blend=0.018,
    )
    hand = unit(wrist - elbow)
    flat = unit(np.cross(_AHEAD, hand))  # the back of the hand, up in the T-pose
    flat = flat if flat[1] >= 0 else -flat
    below = [j for j, up in enumerate(made.parents) if up == arm.end]
    tips = [j for j in below if j in made.parents]
    bend = unit(hand - 0.22 * flat)
    palm = 0.098 * s
    if below:
        reach = float(np.mean([(places[j] - wrist) @ hand for j in below]))
        palm = max(reach, 0.05 * s)
    knuckles = wrist + hand * palm
    part = palm / s
    made.loft(
        wrist,
        wrist + hand * s,
        _AHEAD,
        [
            (-0.01, 0.028, 0.021),
            (0.35 * part, 0.036, 0.021, 0.001, 0),
            (0.8 * part, 0.040, 0.019, 0.001, 0),
            (part, 0.039, 0.0175, 0.0, 0),
        ],
        owners=[(0, arm.end)],
        colors=[(-9, dark)],
        toward=_UP,
        blend=0.016,
    )
    made.loft(
        wrist + s * (0.022 * hand + 0.022 * _AHEAD - 0.004 * flat),
        wrist + s * (0.088 * hand + 0.062 * _AHEAD - 0.014 * flat),
        flat,
        [(0, 0.0165, 0.017), (0.6, 0.0145, 0.015), (1.0, 0.0125, 0.013)],
        owners=[(0, arm.end)],
        colors=[(-9, dark)],
        toward=_UP,
        blend=0.018,
    )
    if not tips:
        made.loft(
            knuckles,
            knuckles + bend * s,
            _AHEAD,
            [
                (-0.01, 0.038, 0.0175),
                (0.030, 0.036, 0.0155),
                (0.058, 0.030, 0.0135),
            ],
            owners=[(0, arm.end)],
            colors=[(-9, dark)],
            toward=_UP,
            blend=0.014,
            caps=(None, 0.024),
        )


def _add_bone(
    made: _Flesh, joint: int, radius: float, color: str, blend: float = 0.015
) -> None:
    """A plain bone to a joint of which nothing else is known."""
    parent = made.parents[joint]
    a, b = made.places[parent], made.places[joint]
    along = unit(b - a)
    side = _AHEAD if abs(along[2]) < 0.9 else _ACROSS
    made.loft(
        a,
        b,
        side,
        [(0, radius, radius), (1, 0.9 * radius, 0.9 * radius)],
        owners=[(0, parent)],
        colors=[(-9, color)],
        blend=blend,
    )


def _lengths(parents: tuple[int, ...], places: np.ndarray) -> np.ndarray:
    """Of the bones to the joints, meters; 0 for the root."""
    return np.linalg.norm(places - places[[max(p, 0) for p in parents]], axis=-1)


def _scale(parents: tuple[int, ...], found: Anatomy, places: np.ndarray) -> float:
    """Meters of this body in one of the adult."""
    if found.legs:
        lengths = _lengths(parents, places)
        leg = [lengths[leg.middle] + lengths[leg.end] for leg in found.legs]
        return max(float(np.mean(leg)) / _LEG, 1e-3)
    reach = float(np.linalg.norm(places, axis=-1).max())
    return max(reach / 1.2, 1e-3)


def _flesh(
    parents: tuple[int, ...], found: Anatomy, places: np.ndarray, thinnest: float
) -> list[_Loft]:
    """All lofts, the trunk's first; none thinner than a grid can hold, meters."""
    made = _Flesh(parents, places, _scale(parents, found, places))
    lengths = _lengths(parents, places)
    done: set[int] = set(found.trunk) if found.legs else {0}
    if found.legs:
        _add_torso(made, found)
        _add_head(made, found)
    for leg in found.legs:
        _add_leg(made, leg)
        done |= {leg.upper, leg.middle, leg.end, *leg.before, *leg.after[:1]}
    for arm in found.arms:
        _add_arm(made, arm)
        done |= {arm.upper, arm.middle, arm.end, *arm.before}
    hands = {arm.end for arm in found.arms}
    for joint in range(1, len(parents)):
        if parents[joint] in hands:
            hands.add(joint)
        if joint in done or lengths[joint] < 1e-6:
            continue
        light, dark = SIDED[found.sides[joint]]
        finger = parents[joint] in hands
        radius = 0.0095 if finger else min(0.04, 0.2 * lengths[joint] / made.s + 0.01)
        radius = max(radius, thinnest / made.s)
        _add_bone(made, joint, radius, dark if finger else light)
    if not made.lofts:
        made.ball(places[0], (0.05, 0.05, 0.05), owner=0, color=IVORY, blend=0.01)
    return made.lofts


def _grid(
    lofts: Sequence[_Loft], cell: float, focus: Sequence[tuple[int, float, float]]
) -> list[np.ndarray]:
    """Axes of a grid around them, symmetric to x = 0, finer near some places.

    Args:
      cell: Meters.
      focus: Axis, place and reach of what is made with cells of half the size.
    """
    boxes = np.array([loft.reach() for loft in lofts])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    axes = []
    for axis in range(3):
        begin, end = low[axis] - 2.5 * cell, high[axis] + 2.5 * cell
        if axis == 0:
            begin, end = -max(-begin, end), max(-begin, end)
        fine = np.linspace(begin, end, 400)
        rate = np.ones(400)
        for number, place, reach in focus:
            if number == axis:
                rate = np.maximum(rate, 1 + np.exp(-(((fine - place) / reach) ** 4)))
        steps = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(fine))
        steps = np.concatenate([[0.0], steps]) / cell
        count = max(2 * int(np.ceil(steps[-1] / 2)), 4)
        axes.append(np.interp(np.linspace(0, steps[-1], count + 1), steps, fine))
    return axes


def _field(lofts: Sequence[_Loft], axes: Sequence[np.ndarray], cell: float):
    """Distance at the grid's points; each loft is evaluated around itself alone."""
    shape = tuple(map(len, axes))
    found = np.full(shape, 10 * cell)
    for number, loft in enumerate(lofts):
        low, high = loft.reach()
        margin = max(loft.blend, 2.5 * cell)
        part = []
        for axis, a, b in zip(axes, low - margin, high + margin, strict=True):
            i, j = np.searchsorted(axis, [a, b])
            part.append(slice(max(i - 1, 0), j + 1))
        near = np.meshgrid(
            *(x[p] for x, p in zip(axes, part, strict=True)), indexing="ij"
        )
        points = np.stack(near, axis=-1)
        values = loft.distance(points.reshape(-1, 3))[0].reshape(points.shape[:-1])
        here = found[tuple(part)]
        found[tuple(part)] = _melt(here, values, loft.blend) if number else values
    return found


def _weights(
    lofts: Sequence[_Loft],
    points: np.ndarray,
    near: _Neighbors,
    number: int,
    handover: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The four joints that each point follows, and how much."""
    away = np.empty((len(lofts), len(points)))
    each = np.zeros((len(lofts), len(points), number), np.float32)
    for i, loft in enumerate(lofts):
        away[i], along = loft.distance(points)
        at = np.array([place for place, _ in loft.owners])
        spot = np.interp(along, at, np.arange(len(at))) if len(at) > 1 else 0 * along
        for n, (_, joint) in enumerate(loft.owners):
            each[i, :, joint] += np.maximum(1 - np.abs(spot - n), 0)
    share = np.exp(-(away - away.min(axis=0)) / handover)
    total = np.einsum("lv,lvj->vj", share, each)
    total /= total.sum(axis=1, keepdims=True)
    for _ in range(4):
        total = 0.5 * total + 0.5 * near.mean(total)
    joints = np.argsort(-total, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(total, joints, axis=1)
    if weights.shape[1] < 4:
        missing = [(0, 0), (0, 4 - weights.shape[1])]
        joints, weights = np.pad(joints, missing), np.pad(weights, missing)
    weights = np.where(weights < 0.01, 0.0, weights)
    return joints, weights / weights.sum(axis=1, keepdims=True)


def _paint(lofts: Sequence[_Loft], points: np.ndarray) -> np.ndarray:
    """How far each point is from each color of the palette, meters [V, colors]."""
    found = np.full((len(points), len(PALETTE)), 1e3)
    for loft in lofts:
        away, along = loft.distance(points)
        marks = [at for at, _ in loft.colors] + [np.inf]
        for (low, color), high in zip(loft.colors, marks[1:], strict=True):
            beside = np.maximum(np.maximum(low - along, along - high), 0.0)
            found[:, color] = np.minimum(found[:, color], away + beside)
    return found


@dataclasses.dataclass
class _Seams:
    """Cuts faces where two colors meet, so that each has one.

    Attributes:
      values: What the vertices have, [V, d], interpolated at cuts.
      away: [V, colors] of them.
    """

    values: np.ndarray
    away: np.ndarray

    def cut(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values, faces, and color of each vertex."""
        color = self.away.argmin(axis=1)
        kinds = color[faces]
        plain = (kinds == kinds[:, :1]).all(axis=1)
        rows, made = [self.values], []
        spots: dict[tuple[int, int], int] = {}
        count = len(self.values)

        def between(a: int, b: int) -> int:
            nonlocal count
            if (a, b) not in spots:
                i, j = color[a], color[b]
                x = self.away[a, i] - self.away[a, j]
                y = self.away[b, i] - self.away[b, j]
                part = np.clip(x / (x - y) if x != y else 0.5, 0.08, 0.92)
                rows.append(((1 - part) * self.values[a] + part * self.values[b])[None])
                spots[a, b] = spots[b, a] = count
                count += 1
            return spots[a, b]

        for face in faces[~plain].tolist():
            cuts = [
                between(a, b) if color[a] != color[b] else None
                for a, b in zip(face, face[1:] + face[:1], strict=True)
            ]
            if None in cuts:
                # Two of one color, from `a` on: a triangle and a quad.
                i = cuts.index(None)
                a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
                p, q = cuts[(i + 1) % 3], cuts[(i + 2) % 3]
                made += [(a, b, p, color[a]), (a, p, q, color[a]), (q, p, c, color[c])]
                continue
            middle = count
            rows.append(np.mean([self.values[v] for v in face], axis=0)[None])
            count += 1
            for i, a in enumerate(face):
                p, q = cuts[i], cuts[i - 1]
                made += [(a, p, middle, color[a]), (a, middle, q, color[a])]
        extra = np.array(made, int).reshape(-1, 4)
        whole = np.concatenate([faces[plain], extra[:, :3]])
        kind = np.concatenate([kinds[plain, 0], extra[:, 3]])
        # A vertex of two colors stands twice.
        pairs = whole * len(PALETTE) + kind[:, None]
        unique, index = np.unique(pairs, return_inverse=True)
        source, color = np.divmod(unique, len(PALETTE))
        return np.concatenate(rows)[source], index.reshape(-1, 3), color


def describe(
    skeleton: Skeleton,
    sides: tuple[str, ...] | None = None,
    *,
    rotations: Float[np.ndarray, "frames joints 3 3"] | None = None,
    detail: str = "fine",
) -> Mannequin:
    """The mannequin of a skeleton; its mesh is made once for each.

    Args:
      sides: `anatomy.LEFT`, `RIGHT` or `MIDDLE` of each joint; None for what the names
        and the zero pose say. Left is blue and right is red.
      rotations: Of the joints in a motion, world. Where the zero pose does not stand,
        only a motion tells how limbs are turned about themselves (see
        `anatomy.t_pose`); without one, shoulders and hips may look wrung.
      detail: "fine" has about 5,000 vertices; "crowd" a third of them.

    Raises:
      ValueError: if `sides` are not one a joint, or there is no such detail.
    """
    if detail not in _DETAIL:
        raise ValueError(f"detail is {detail!r}, expected one of {', '.join(_DETAIL)}")
    found = anatomy.find_anatomy(skeleton, sides)
    places, turns = _bind_pose(skeleton, found, sides, rotations)
    places = places.round(5).astype(np.float32)
    mesh = _mesh(places.tobytes(), skeleton.parents, found, detail)
    return dataclasses.replace(mesh, bind_rotation=turns.astype(np.float32))


@functools.lru_cache(maxsize=32)
def _mesh(
    packed: bytes, parents: tuple[int, ...], found: Anatomy, detail: str
) -> Mannequin:
    """The mannequin of joints at these places, none of which is turned."""
    places = np.frombuffer(packed, np.float32).reshape(-1, 3).astype(float)
    s = _scale(parents, found, places)
    coarse = _DETAIL[detail]
    reach = float(np.ptp(places, axis=0).max()) if len(places) > 1 else 0.0
    cell = max(_CELL * s * coarse, reach / 150)
    lofts = _flesh(parents, found, places, thinnest=cell)
    axes = _grid(lofts, cell, _focus(found, places, s))
    points, quads = _surface_net(_field(lofts, axes, cell), axes)
    near = _Neighbors(_triangles(points, quads), len(points))
    for _ in range(3):
        points = 0.5 * points + 0.5 * near.mean(points)
        points = _onto(lofts, points, cell)
    normals = _gradient(lofts, points, 0.1 * cell)
    for _ in range(_SOFTEN):
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        normals = 0.5 * normals + 0.5 * near.mean(normals)
    faces = _triangles(points, quads)
    handover = _HANDOVER * s
    joints, weights = _weights(lofts, points, near, len(parents), handover)
    spread = np.zeros((len(points), len(parents)))
    np.add.at(spread, (np.arange(len(points))[:, None], joints), weights)
    seams = _Seams(
        np.concatenate([points, normals, spread], axis=1), _paint(lofts, points)
    )
    values, faces, color = seams.cut(faces)
    joints = np.argsort(-values[:, 6:], axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(values[:, 6:], joints, axis=1)
    missing = [(0, 0), (0, 4 - weights.shape[1])]
    joints, weights = np.pad(joints, missing), np.pad(weights, missing)
    weights /= weights.sum(axis=1, keepdims=True)
    normals = values[:, 3:6]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    made = Mannequin(
        vertices=values[:, :3].astype(np.float32),
        normals=normals.astype(np.float32),
        faces=faces.astype(np.int32),
        joints=np.where(weights > 0, joints, 0).astype(np.uint16),
        weights=weights.astype(np.float32),
        materials=color.astype(np.uint8),
        palette=PALETTE,
        bind_position=places.astype(np.float32),
        bind_rotation=np.tile(np.eye(3, dtype=np.float32), (len(places), 1, 1)),
    )
    for value in vars(made).values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False  # others get the same mesh
    return made


def _focus(
    found: Anatomy, places: np.ndarray, s: float
) -> list[tuple[int, float, float]]:
    """Axis, place and reach of what is thin or has detail: limbs, feet, head."""
    focus = []
    for arm in found.arms:
        elbow, wrist = places[arm.middle], places[arm.end]
        tips = wrist + unit(wrist - elbow) * 0.18 * s
        middle, hand = 0.5 * (elbow + tips), wrist + 0.5 * (tips - wrist)
        focus.append((0, middle[0], abs(tips[0] - middle[0]) + 0.04 * s))
        focus.append((1, hand[1], 0.08 * s))
        focus.append((2, hand[2], 0.11 * s))
    for leg in found.legs:
        focus.append((1, _ball_height(places, leg), 0.08 * s))
    if found.legs:
        focus.append((1, places[found.trunk[-1], 1] + 0.06 * s, 0.13 * s))
    return focus


def _ball_height(places: np.ndarray, leg: Limb) -> float:
    return places[leg.after[0], 1] if leg.after else places[leg.end, 1]


def _onto(lofts: Sequence[_Loft], points: np.ndarray, cell: float) -> np.ndarray:
    """Moved to where the distance is zero, by Newton's method."""
    slope = _gradient(lofts, points, 0.1 * cell)
    square = np.maximum(np.sum(slope * slope, axis=1, keepdims=True), 0.05)
    step = _distance(lofts, points)[:, None] * slope / square
    long = np.linalg.norm(step, axis=1, keepdims=True)
    return points - step * np.minimum(1.0, cell / np.maximum(long, 1e-9))
