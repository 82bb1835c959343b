"""MJCF and URDF: malformed files end with one line, whatever MuJoCo does with them.

MuJoCo reads them in its own C; what it kills a process with would end this test.
"""

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest

from jaxmotion.retarget import robot, robot_motion
from tests.fuzz import harness, mutations
from tests.retarget import robots
from tests.viz import samples

pytestmark = pytest.mark.slow
INPUTS = 1000


def corpus():
    servo = '<velocity joint="left_knee_joint" kv="1" ctrlrange="-3 3"/>'
    return [
        (".xml", robots.mjcf(servos=servo)),
        (".xml", robots.mjcf(facing=40.0, extra='<geom type="plane" size="1 1 1"/>')),
        (".urdf", robots.urdf()),
    ]


def mutate(random, text):
    """Elements dropped, doubled, moved; attributes dropped, swapped, or nonsense."""
    root = ElementTree.fromstring(text)
    for _ in range(random.integers(1, 4)):
        every = list(root.iter())
        parents = {child: parent for parent in every for child in parent}
        some = every[random.integers(len(every))]
        other = every[random.integers(len(every))]
        match random.integers(7):
            case 0 if some in parents:
                parents[some].remove(some)
            case 1 if some in parents:
                parents[some].append(some)
            case 2 if some in parents and some not in other.iter():
                if other not in some.iter():
                    parents[some].remove(some)
                    other.append(some)
            case 3 if some.attrib:
                del some.attrib[random.choice(sorted(some.attrib))]
            case 4:
                some.tag = other.tag
            case 5 if other.attrib:
                key = str(random.choice(sorted(other.attrib)))
                some.set(key, other.get(key))
            case _ if some.attrib:
                key = str(random.choice(sorted(some.attrib)))
                words = some.get(key).split() or [""]
                word = str(random.choice(mutations.WORDS))
                words[random.integers(len(words))] = word
                some.set(key, " ".join(words))
    return ElementTree.tostring(root)


def test_malformed_robots(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file there
    person = samples.person(seconds=0.2, speed=1.0)
    whole = corpus()

    def read(content):
        suffix, data = content
        path = tmp_path / f"x{suffix}"
        path.write_bytes(data)
        found = robot.read_robot(path)
        robot_motion.follow(found, *person, fps=10.0).to_arrays()
        return path, found

    def confirm(content, value):
        path, found = value
        if path.suffix == ".xml":
            model = mujoco.MjModel.from_xml_path(str(path))
            assert [model.body(n).name for n in found.tree] == [*found.body_names]

    target = harness.Target("robots", read, confirm, names=("x.xml", "x.urdf"))
    for seed in range(INPUTS):
        random = np.random.default_rng(seed)
        suffix, text = whole[seed % len(whole)]
        if random.random() < 0.3:
            data = mutations.mutate_bytes(random, text.encode())
        else:
            data = mutate(random, text)
        target.feed(f"seed {seed}", (suffix, data))
    target.report(capsys.disabled, accepted=INPUTS // 20, refused=INPUTS // 5)
