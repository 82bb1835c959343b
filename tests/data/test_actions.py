"""Actions told apart by rule, of a stiff person whose every move is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.data import actions
from jaxmotion.data.clips import clips_from_motions, take_clips
from tests import person

FPS = 30.0


def take(seconds, *, speed=0.0, bounce=0.0, leap=None, turn=None, reach=None):
    """A person that goes along +z; leaps, reaches and turns (by degrees) when told."""
    time = np.arange(round(seconds * FPS)) / FPS
    root = np.zeros((len(time), 3))
    root[:, 2] = np.cumsum(np.broadcast_to(speed, time.shape)) / FPS
    root[:, 1] = 1.0 + bounce * np.abs(np.sin(2 * np.pi * 1.3 * time))
    if leap is not None:
        root[:, 1] += np.maximum(2.5 * (time - leap) - 4.9 * (time - leap) ** 2, 0.0)
    yaw = np.zeros(len(time))
    if turn is not None:
        yaw = np.radians(turn[1]) * np.clip((time - turn[0]) / 1.0, 0.0, 1.0)
    matrices = person.upright(root, yaw)
    if reach is not None:
        up = Rotation.from_euler("x", -120, degrees=True).as_matrix()
        matrices[np.abs(time - reach) < 0.2, 1] = up
    return person.motion(root, matrices, FPS)


TAKES = {
    "stand": ("neutral", take(4.0)),
    "turn": ("neutral", take(4.0, turn=(1.2, 120.0))),
    "walk": ("neutral", take(4.0, speed=1.2)),
    "jog": ("neutral", take(4.0, speed=1.6, bounce=0.08)),
    "run": ("neutral", take(4.0, speed=2.8, bounce=0.08)),
    "crouch": ("crouch", take(10.0, speed=0.8)),
    "jump": ("jump", take(10.0, speed=1.2, leap=5.0)),
    "push": ("push", take(10.0, reach=7.0)),
    # Stops half way; turns little; goes on one leg's length; too short.
    "stops": ("neutral", take(3.5, speed=np.where(np.arange(105) < 52, 1.2, 0.0))),
    "looks": ("neutral", take(3.5, turn=(1.2, 50.0))),
    "short": ("neutral", take(2.0)),
    "other": ("calibration", take(8.0)),
}


@pytest.fixture(scope="module")
def takes():
    styles, motions = zip(*TAKES.values(), strict=True)
    return clips_from_motions(
        motions, person.skeleton(), names=tuple(TAKES), labels={"style": styles}
    )


def test_every_action_is_found_where_it_is(takes):
    found = actions.cut_actions(takes)
    words = found.names("action")
    assert words == actions.ACTIONS
    got = [words[int(i)] for i in found.labels["action"]]
    names = [name.partition("@")[0] for name in found.clip_names]
    assert dict(zip(names, got, strict=True)) == {w: w for w in words}
    assert found.clip_names[:5] == tuple(f"{w}@0+120" for w in list(TAKES)[:5])
    # Evenly cut; and about what happens in them.
    assert found.clip_names[5:8] == ("crouch@0+100", "crouch@100+100", "crouch@200+100")
    for name, middle in zip(found.clip_names[8:], (157, 210), strict=True):
        start, length = map(int, name.partition("@")[2].split("+"))
        assert length == 120 and abs(start + 60 - middle) <= 6


def test_stretches_are_the_recorded_frames(takes):
    found = actions.cut_actions(takes)
    place = found.clip_names.index("crouch@100+100")
    start = int(found.offsets[place])
    whole = int(takes.offsets[list(TAKES).index("crouch")])
    np.testing.assert_array_equal(
        found.root_position[start : start + 100],
        takes.root_position[whole + 100 : whole + 200],
    )


def test_nothing_to_cut_is_said(takes):
    with pytest.raises(ValueError, match="no stretch of 3 s.*styles neutral$"):
        actions.cut_actions(take_clips(takes, [10]))
    with pytest.raises(ValueError, match="field 'action' already"):
        actions.cut_actions(actions.cut_actions(takes))
