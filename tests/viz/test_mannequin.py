import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxmotion.data.walker import walker_skeleton
from jaxmotion.motion import anatomy
from jaxmotion.motion.humanml_layout import HUMANML3D
from jaxmotion.motion.humanml_skeleton import SMPL_JOINTS
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.viz import mannequin
from tests.motion.test_anatomy import along_x

# A neutral SMPL body's joints, rounded to centimeters.
SMPL = [[0, 0, 0], [6, -8, -2], [-6, -9, -1], [0, 12, -4], [4, -39, 1], [-4, -38, -1]]
SMPL += [[0, 14, 3], [-1, -43, -4], [2, -42, -3], [0, 6, 0], [4, -6, 12], [-4, -6, 13]]
SMPL += [[0, 21, -3], [7, 11, -2], [-8, 11, -2], [1, 9, 5], [12, 5, -2], [-11, 5, -1]]
SMPL += [[26, -2, -2], [-26, -1, -3], [27, 1, -1], [-27, 1, -1]]


def smpl():
    return Skeleton(
        offsets=jnp.asarray(SMPL, jnp.float32) / 100,
        parents=HUMANML3D.parents,
        names=SMPL_JOINTS,
    )


def with_fingers():
    """The walker with three fingers of two joints on each hand."""
    base = walker_skeleton()
    names, parents = list(base.names), list(base.parents)
    offsets = np.asarray(base.offsets).tolist()
    for hand, out in (("LeftHand", 1), ("RightHand", -1)):
        for number, ahead in enumerate((-0.025, 0.0, 0.025)):
            for part, along in enumerate((0.09, 0.04)):
                parents.append(base.names.index(hand) if not part else len(parents) - 1)
                names.append(f"{hand}Finger{number}{part}")
                offsets.append([out * along, 0, 0 if part else ahead])
    return Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=tuple(parents),
        names=tuple(names),
    )


def tail():
    return Skeleton(
        offsets=jnp.asarray([[0.0, 0, 0], [0, 0, 0.3], [0, 0, 0.2], [0.1, 0, 0]]),
        parents=(-1, 0, 1, 0),
        names=("a", "b", "c_l", "d_r"),
    )


def one_joint():
    return Skeleton(offsets=jnp.zeros((1, 3)), parents=(-1,), names=("a",))


PEOPLE = [walker_skeleton, along_x, smpl, with_fingers]


def solid(made, vertices=None):
    """The mesh as trimesh sees it, without the doubled vertices of its seams."""
    found = trimesh.Trimesh(
        made.vertices if vertices is None else vertices, made.faces, process=False
    )
    found.merge_vertices(merge_tex=True, merge_norm=True)
    return found


def winding(mesh, points):
    """How often a mesh is around points (Van Oosterom and Strackee 1983)."""
    found = []
    for point in points:
        a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        dot = lambda x, y: np.sum(x * y, axis=1)  # noqa: E731
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        found.append(np.arctan2(dot(a, np.cross(b, c)), below).sum() / (2 * np.pi))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("detail", ["fine", "crowd"])
@pytest.mark.parametrize("make", [*PEOPLE, tail, one_joint])
def test_it_is_one_closed_surface_without_handles(make, detail):
    made = mannequin.describe(make(), detail=detail)
    mesh = solid(made)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 2 and mesh.body_count == 1
    assert mesh.volume > 0, "faces look outward"
    assert np.isfinite(made.vertices).all()
    assert (made.materials[made.faces] == made.materials[made.faces[:, :1]]).all()
    corner = made.vertices[made.faces]
    outward = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    large = np.linalg.norm(outward, axis=1) > 1e-6 * np.ptp(made.vertices) ** 2
    same = np.sum(outward * made.normals[made.faces].mean(axis=1), axis=-1) > 0
    assert same[large].mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("make", PEOPLE)
def test_a_person_has_a_persons_measures(make):
    """Volume, area and height of adults: 72 L and 1.9 m2 at 1.75 m (Du Bois 1916)."""
    made = mannequin.describe(make())
    mesh = solid(made)
    # The arms are lowered, so the extent in y is the height.
    height = float(np.ptp(made.vertices[:, 1]))
    assert 1.55 < height < 1.95
    scaled = (1.75 / height) ** 3
    assert 0.055 < mesh.volume * scaled < 0.085
    assert 1.5 < mesh.area * scaled ** (2 / 3) < 2.1
    assert 3_000 < len(made.vertices) < 6_500


def test_what_all_share_nobody_changes():
    body = mannequin.describe(walker_skeleton())
    assert body.vertices is mannequin.describe(walker_skeleton()).vertices
    with pytest.raises(ValueError, match="read-only"):
        body.vertices[:] *= 2.0


def test_weights_are_at_most_four_and_sum_to_one():
    for make in (*PEOPLE, tail, one_joint):
        made = mannequin.describe(make())
        assert made.joints.shape == made.weights.shape == (len(made.vertices), 4)
        np.testing.assert_allclose(made.weights.sum(axis=1), 1.0, atol=1e-6)
        assert made.weights.min() >= 0 and (np.diff(made.weights, axis=1) <= 0).all()
        assert made.joints.max() < make().num_joints


def test_weights_are_smooth_and_stay_on_their_side():
    skeleton = walker_skeleton()
    made = mannequin.describe(skeleton)
    spread = np.zeros((len(made.vertices), skeleton.num_joints))
    np.add.at(spread, (np.arange(len(spread))[:, None], made.joints), made.weights)
    edges = solid(made).edges_unique
    where = trimesh.Trimesh(made.vertices, made.faces, process=False)
    edges = where.edges_unique
    long = np.maximum(where.edges_unique_length, 0.01)
    change = np.abs(spread[edges[:, 0]] - spread[edges[:, 1]]).sum(axis=1) / long
    assert change.max() < 60, "from one joint to another over more than 3 cm"
    left = [j for j, name in enumerate(skeleton.names) if name.startswith("Left")]
    assert spread[made.vertices[:, 0] < -0.04][:, left].max() < 0.05


@pytest.mark.parametrize("make", [walker_skeleton, along_x])
def test_skinning_is_linear_blend_skinning_written_as_a_loop(make):
    skeleton = make()
    made = mannequin.describe(skeleton, detail="crowd")
    draw = np.random.default_rng(1)
    turns = trimesh.transformations.random_rotation_matrix
    rotations = np.stack(
        [turns(draw.uniform(size=3))[:3, :3] for _ in range(skeleton.num_joints)]
    )
    positions = draw.normal(size=(skeleton.num_joints, 3))
    found, normals = made.skin(positions, rotations)
    for v in range(0, len(found), 97):
        place, normal = np.zeros(3), np.zeros(3)
        for j, w in zip(made.joints[v], made.weights[v], strict=True):
            bind = made.bind_rotation[j].astype(float)
            local = bind.T @ (made.vertices[v] - made.bind_position[j])
            place += w * (rotations[j] @ local + positions[j])
            normal += w * (rotations[j] @ bind.T @ made.normals[v])
        np.testing.assert_allclose(found[v], place, atol=2e-5)
        normal /= np.linalg.norm(normal)
        assert normals[v] @ normal > 0.999
    some = np.array([3, 50, 7])
    np.testing.assert_array_equal(
        made.skin(positions, rotations, only=some)[0], found[some]
    )


def test_in_the_bind_pose_it_is_as_it_was_made_and_moves_as_a_whole():
    skeleton = walker_skeleton()
    made = mannequin.describe(skeleton)
    still = made.skin(made.bind_position, made.bind_rotation)
    np.testing.assert_allclose(still[0], made.vertices, atol=1e-5)
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    moved = made.skin(
        np.stack([made.bind_position @ turn.T + [1.0, 2, 3]] * 2),
        np.stack([turn @ made.bind_rotation] * 2),
    )
    expected = made.vertices @ turn.T + [1.0, 2, 3]
    np.testing.assert_allclose(moved[0][1], expected, atol=1e-5)
    np.testing.assert_allclose(moved[1][1], made.normals @ turn.T, atol=1e-5)


@pytest.mark.parametrize("make", PEOPLE)
def test_joints_are_inside_of_it_in_the_t_pose(make):
    skeleton = make()
    made = mannequin.describe(skeleton)
    places, turns = anatomy.t_pose(skeleton)
    mesh = solid(made, made.skin(places, turns)[0])
    inside = winding(mesh, places) > 0.5
    out = [n for n, has in zip(skeleton.names, inside, strict=True) if not has]
    assert not [n for n in out if "Finger" not in n], "tips of fingers are at the skin"
    low, high = mesh.bounds
    head = next(p for p, n in zip(places, skeleton.names, strict=True) if "ead" in n)
    assert 0.12 < high[1] - head[1] < 0.25, "a head above its joint"
    wrists = [arm.end for arm in anatomy.find_anatomy(skeleton).arms]
    hands = np.ptp(places[wrists, 0])
    assert hands + 0.2 < high[0] - low[0] < hands + 0.45, "hands beyond the wrists"


def test_it_faces_ahead_and_stands_on_flat_soles():
    made = mannequin.describe(walker_skeleton())
    places, turns = anatomy.t_pose(walker_skeleton())
    vertices = made.skin(places, turns)[0]
    head = vertices[vertices[:, 1] > places[5, 1] + 0.01]
    nose = head[head[:, 2].argmax()]
    assert abs(nose[0]) < 0.02 and nose[2] > head[:, 2].mean() + 0.09
    low = made.vertices[:, 1].min()
    sole = made.vertices[made.vertices[:, 1] < low + 0.006]
    for side in (-1, 1):
        foot = sole[side * sole[:, 0] > 0]
        assert np.ptp(foot[:, 2]) > 0.18 and np.ptp(foot[:, 0]) > 0.05


def test_it_is_its_own_mirror_image():
    made = mannequin.describe(walker_skeleton())
    mesh = solid(made)
    away = []
    for place in made.vertices[::5] * [-1, 1, 1]:
        near = np.linalg.norm(mesh.triangles_center - place, axis=1).argsort()[:16]
        points = np.tile(place, (16, 1))
        found = trimesh.triangles.closest_point(mesh.triangles[near], points)
        away.append(np.linalg.norm(found - place, axis=1).min())
    assert np.percentile(away, 98) < 3e-3 and max(away) < 1e-2
    colors = [made.palette[m] for m in made.materials]
    left = {c for c, x in zip(colors, made.vertices[:, 0], strict=True) if x > 0.1}
    right = {c for c, x in zip(colors, made.vertices[:, 0], strict=True) if x < -0.1}
    assert left & right == {mannequin.IVORY}
    assert left - right == {*mannequin.SIDED["left"]}
    assert right - left == {*mannequin.SIDED["right"]}


def test_names_only_help_and_size_scales():
    skeleton = walker_skeleton()
    odd = Skeleton(
        offsets=skeleton.offsets,
        parents=skeleton.parents,
        names=tuple(f"bone {j:02d}" for j in range(22)),
    )
    whole = mannequin.describe(skeleton)
    np.testing.assert_array_equal(mannequin.describe(odd).vertices, whole.vertices)
    sides = anatomy.find_anatomy(skeleton).sides
    same = mannequin.describe(odd, sides)
    np.testing.assert_array_equal(same.materials, whole.materials)
    with pytest.raises(ValueError, match="expected 22 of left, right, middle"):
        mannequin.describe(odd, ("left",))
    with pytest.raises(ValueError, match="detail is 'thick', expected one of fine"):
        mannequin.describe(skeleton, detail="thick")
    half = Skeleton(
        offsets=0.5 * skeleton.offsets, parents=skeleton.parents, names=skeleton.names
    )
    small = solid(mannequin.describe(half))
    np.testing.assert_allclose(8 * small.volume, solid(whole).volume, rtol=2e-3)


def test_it_is_quick_the_first_time_and_kept():
    mannequin._mesh.cache_clear()
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        made = mannequin.describe(walker_skeleton())
        seconds.append(time.perf_counter() - start)
    assert seconds[1] < 0.1 and seconds[0] < 8.0, "about 1 s on an idle core"
    assert made.vertices is mannequin.describe(walker_skeleton()).vertices


@pytest.mark.slow
def test_it_is_the_same_in_another_process():
    code = (
        "from jaxmotion.data.walker import walker_skeleton as w;"
        "from jaxmotion.viz import mannequin; import hashlib;"
        "m = mannequin.describe(w(), detail='crowd');"
        "print(hashlib.sha1(m.vertices.tobytes() + m.weights.tobytes()).hexdigest())"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    }
    assert len(found) == 1 and len(found.pop()) == 41


def made_of(skeleton, world):
    """Positions of the first frame of world rotations, and those."""
    places = np.zeros((skeleton.num_joints, 3))
    for joint, parent in enumerate(skeleton.parents[1:], 1):
        offset = np.asarray(skeleton.offsets)[joint]
        places[joint] = places[parent] + world[0, parent] @ offset
    return places, world[0]


def test_a_motion_says_how_limbs_are_turned_about_themselves():
    """A rig whose right thigh is turned by half about its bone is not wrung."""
    plain = along_x()
    turn = np.diag([1.0, -1.0, -1.0])  # about the bone
    leg = ("RightUpLeg", "RightLeg", "RightFoot")
    turned = [plain.names.index(name) for name in leg]
    places, bind = anatomy.t_pose(plain)
    # A squat: thighs swing ahead, knees bend back.
    bend = np.linspace(0, 1.2, 20)
    world = np.tile(bind, (20, 1, 1, 1))
    for side in ("Left", "Right"):
        for name, angle in (("UpLeg", -bend), ("Leg", bend), ("Foot", 0 * bend)):
            j = plain.names.index(side + name)
            c, s = np.cos(angle), np.sin(angle)
            about = np.tile(np.eye(3), (20, 1, 1))
            about[:, 1, 1], about[:, 1, 2] = c, -s
            about[:, 2, 1], about[:, 2, 2] = s, c
            world[:, j] = about @ bind[j]
    world[:, turned] = world[:, turned] @ turn
    # All bones are along x, so the rig's offsets are the same.
    _, told = anatomy.t_pose(plain, motion=world)
    for j in range(plain.num_joints):
        expected = bind[j] @ turn if j in turned else bind[j]
        if "Toe" not in plain.names[j] and "Arm" not in plain.names[j]:
            assert np.trace(told[j].T @ expected) > 2.8, plain.names[j]
    motion = world
    places, world = made_of(plain, motion)
    alone, straight = (
        mannequin.describe(plain, rotations=told).skin(places, world)[0]
        for told in (None, motion)
    )
    # Wrung, the hip is thin.
    volumes = [solid(mannequin.describe(plain), v).volume for v in (alone, straight)]
    assert volumes[0] < volumes[1] - 1e-3
