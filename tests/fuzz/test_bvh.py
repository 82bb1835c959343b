"""BVH: malformed files, and files of all shapes that two readers agree on."""

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies

from jaxmotion.data import bvh, bvh_text
from jaxmotion.data.bvh_text import format_bvh
from tests.data import samples, test_builders
from tests.data.test_bvh import chain
from tests.fuzz import harness, mutations

pytestmark = pytest.mark.slow
INPUTS = 2400


def bvhio_joints(path):
    """Joints of a file in file order, and the frame time, as bvhio reads them."""
    bvhio = pytest.importorskip("bvhio", reason="the second BVH reader, extra [test]")
    with harness.limited(10):
        found = bvhio.readAsBvh(str(path))
    return [joint for joint, _, _ in found.Root.layout()], found.FrameTime


def quaternion(matrix):
    """Both ends of a rotation are compared as matrices."""
    w, x, y, z = np.moveaxis(matrix, -1, 0)
    return np.stack(
        [
            np.stack(
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1
            ),
            np.stack(
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1
            ),
            np.stack(
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1
            ),
        ],
        -2,
    )


def plain_rows(data):
    """Numbers after the frame time, as Python reads them."""
    text = data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    lines = text[text.upper().rindex("TIME") :].split("\n")[1:]
    return [[float(word) for word in line.split()] for line in lines if line.split()]


def agrees(path, content, *, counts):
    """Compares with bvhio what it reads; counts how often it does."""
    try:
        joints, frame_time = bvhio_joints(path)
    except (Exception, harness.Hang):  # it knows fewer files: no names with spaces
        counts["not read by bvhio"] += 1
        return
    counts["equal to bvhio"] += 1
    assert [joint.Name for joint in joints] == [x.split()[0] for x in content.names]
    assert frame_time == content.frame_time
    np.testing.assert_allclose(
        [list(joint.Offset) for joint in joints],
        content.offsets.astype(np.float32),
        rtol=1e-6,
    )
    positions, rotations = bvh.bvh_transforms(content)
    # bvhio holds angles as float32: beyond this they say nothing.
    if np.abs(content.values).max(initial=0) > 1e4:
        return
    found = np.array([[list(key.Position) for key in j.Keyframes] for j in joints])
    np.testing.assert_allclose(
        np.swapaxes(found, 0, 1), positions, rtol=1e-5, atol=1e-5
    )
    turns = [[[*key.Rotation.to_list()] for key in joint.Keyframes] for joint in joints]
    found = quaternion(np.swapaxes(np.array(turns), 0, 1))
    np.testing.assert_allclose(found, rotations, atol=3e-3)


def corpus():
    plain = bvh.bvh_from_motion(samples.skeleton(), samples.motion(3, 0))
    return [
        samples.bvh_text(),
        format_bvh(plain),
        test_builders.lafan_text(1),
        test_builders.bandai_text(2),
        format_bvh(chain(20)),
    ]


def test_malformed_files(tmp_path, capsys):
    path = tmp_path / "x.bvh"
    texts = corpus()

    def read(data):
        path.write_bytes(data)
        content = bvh_text.read_bvh(path)
        bvh.frame_rate(content.frame_time)
        try:
            bvh.motion_from_bvh(content)
        except bvh_text.BvhError as error:
            assert "x.bvh" in str(error) and "\n" not in str(error)
        return content

    def confirm(data, content):
        np.testing.assert_array_equal(
            content.values, np.array(plain_rows(data)).reshape(content.values.shape)
        )
        agrees(path, content, counts=target.found)

    target = harness.Target("BVH files", read, confirm, names=("x.bvh",))
    for seed in range(INPUTS):
        random = np.random.default_rng(seed)
        data = mutations.mutate_text(random, texts[seed % len(texts)])
        target.feed(f"seed {seed}", data)
    target.report(capsys.disabled, accepted=INPUTS // 20, refused=INPUTS // 2)
    assert target.found["equal to bvhio"] > INPUTS // 50


ORDERS = strategies.permutations(["Xrotation", "Yrotation", "Zrotation"]).map(tuple)
MOVES = strategies.permutations(["Xposition", "Yposition", "Zposition"]).map(tuple)
CHANNELS = strategies.one_of(
    strategies.builds(lambda a, b: a + b, MOVES, ORDERS),
    ORDERS,
    MOVES,
    ORDERS.map(lambda order: order[:1]),
)
NUMBERS = strategies.floats(-1e3, 1e3, width=32).map(lambda x: round(x, 6))


@strategies.composite
def contents(draw):
    """Fields of trees of 1 to 12 joints, in depth-first order."""
    parents = [-1]
    while len(parents) < draw(strategies.integers(1, 12)):
        spine, joint = [], len(parents) - 1
        while joint >= 0:  # only ancestors of the last joint keep the order
            spine.append(joint)
            joint = parents[joint]
        parents.append(draw(strategies.sampled_from(spine)))
    count = len(parents)
    channels = [draw(CHANNELS) for _ in parents]
    offset = strategies.tuples(NUMBERS, NUMBERS, NUMBERS)
    frames, width = draw(strategies.integers(1, 4)), sum(map(len, channels))
    values = draw(
        strategies.lists(NUMBERS, min_size=frames * width, max_size=frames * width)
    )
    return dict(
        names=tuple(f"joint{i}" for i in range(count)),
        parents=tuple(parents),
        offsets=np.array([draw(offset) for _ in parents]),
        channels=tuple(channels),
        end_sites=tuple(() if j in parents else (draw(offset),) for j in range(count)),
        values=np.array(values).reshape(frames, width),
        frame_time=draw(strategies.sampled_from([0.0333333, 0.016667, 0.04, 1.0])),
    )


def test_files_of_all_shapes_come_back_and_agree_with_bvhio(tmp_path, capsys):
    path = tmp_path / "x.bvh"
    target = harness.Target(
        "BVH round trips",
        lambda content: (bvh_text.write_bvh(path, content), bvh_text.read_bvh(path))[1],
        lambda content, found: same(path, content, found, counts=target.found),
    )

    @hypothesis.seed(0)
    @hypothesis.settings(
        max_examples=300,
        deadline=None,
        database=None,
        derandomize=False,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate],
    )
    @hypothesis.given(contents())
    def run(fields):
        content = bvh_text.Bvh(**fields)
        target.feed(repr(content), content)

    run()
    target.report(capsys.disabled, accepted=300, refused=0)
    assert target.found["equal to bvhio"] >= 300


def same(path, content, found, *, counts):
    for field in ("names", "parents", "channels", "end_sites", "frame_time"):
        assert getattr(found, field) == getattr(content, field), field
    np.testing.assert_array_equal(found.offsets, content.offsets)
    np.testing.assert_array_equal(found.values, content.values)
    agrees(path, found, counts=counts)
