"""Clips with a ball for SMGDiff: splits, and windows on the device."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data import windows
from jaxmotion.data.ball_clips import BallClips, cut_scene, take_ball_clips
from jaxmotion.data.selection import label_speeds, original
from jaxmotion.motion.ball import Scene
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.typing import Key

FIELD = "skill"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SceneArrays:
    """Clips with a ball, and where windows of them may start."""

    data: BallClips
    index: windows.WindowIndex


def _recording(name: str) -> str:
    return re.split("[@#]", original(name), maxsplit=1)[0]


def pieces(
    data: BallClips,
    clips: Int[np.ndarray, " windows"],
    starts: Int[np.ndarray, " windows"],
) -> Int[np.ndarray, " windows"]:
    """Number of the piece of a recording, of five seconds, that each window begins in.

    Its mirror image is of the same piece, as is the same motion beside another ball,
    wherever its clip begins. Windows are given by clip and first frame of all.
    """
    names = [original(name) for name in data.clips.clip_names]
    begins = [re.search(r"@(\d+)\+", name) for name in names]
    first = np.array([int(found[1]) if found else 0 for found in begins])
    frames = first[clips] + starts - np.asarray(data.clips.offsets)[clips]
    recordings = np.array([_recording(name) for name in names])
    number = np.unique(recordings, return_inverse=True)[1][clips]
    place = np.stack([number, frames // round(5.0 * data.clips.fps)])
    return np.unique(place, axis=1, return_inverse=True)[1].reshape(-1)


def split(
    data: BallClips, *, fraction: float, seed: int = 0
) -> tuple[BallClips, BallClips]:
    """Training and held-out clips; pieces of one recording stay together.

    What stands before "@" or "#" in a name is its recording, of which a mirror image is
    one, too. Recordings are grouped by their first piece's skill, so that every skill
    with two has one on either side; a part of them, in (0, 1), is held out.
    `ValueError` if it is out of range, or a part would be empty.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"fraction should be between 0 and 1, found {fraction}")
    recordings = np.array([_recording(name) for name in data.clips.clip_names])
    names, first = np.unique(recordings, return_index=True)
    skills = np.asarray(data.clips.labels[FIELD])[first]
    generator = np.random.default_rng(seed)
    held: list[str] = []
    for skill in np.unique(skills):
        own = generator.permutation(names[skills == skill])
        number = min(max(round(fraction * own.size), 1), own.size - 1)
        held += own[:number].tolist()
    is_held = np.isin(recordings, held)
    if not is_held.any() or is_held.all():
        raise ValueError("the clips come from one recording of each skill, expected 2")
    train, held_out = np.flatnonzero(~is_held), np.flatnonzero(is_held)
    return take_ball_clips(data, train), take_ball_clips(data, held_out)


def scene_arrays(data: BallClips, length: int, *, stride: int = 1) -> SceneArrays:
    """Lists windows of `length` frames; clips that are too short are left out.

    Within a clip their starts are `stride` frames apart; `ValueError` for no windows.
    """
    index = windows.window_index(data.clips, length, stride=stride, short="skip")
    return SceneArrays(data=data, index=index)


def sample_scenes(
    key: Key, arrays: SceneArrays, *, batch: int
) -> tuple[Scene, Int[Array, "{batch}"]]:
    """Draws windows (world) and their skills, uniformly over all starts."""
    index = arrays.index
    chosen = jax.random.randint(key, (batch,), 0, index.starts.shape[0])
    return all_scenes(arrays, chosen)


@jax.jit
def all_scenes(
    arrays: SceneArrays, chosen: Int[Array, " windows"]
) -> tuple[Scene, Int[Array, " windows"]]:
    """The chosen windows (world) and their skills."""
    index, data = arrays.index, arrays.data
    cut = jax.vmap(lambda start: cut_scene(data, start, index.length))
    labels = data.clips.labels[FIELD][index.clips[chosen]]
    return cut(index.starts[chosen]), labels


def fit_representation(
    arrays: SceneArrays, *, past: int, windows_used: int = 2000
) -> smgdiff_scene.Representation:
    """Fits features' mean and deviation to at most so many windows, spread over clips.

    The first `past` frames of a window come before the plan.
    """
    number = arrays.index.starts.shape[0]
    chosen = np.unique(np.linspace(0, number - 1, windows_used).astype(int))
    scenes, _ = all_scenes(arrays, jnp.asarray(chosen))
    data, skeleton = arrays.data, arrays.data.clips.skeleton

    @jax.jit
    @jax.vmap
    def local(scene: Scene) -> Scene:
        frame = smgdiff_scene.plan_frame(
            skeleton, jax.tree.map(lambda x: x[:past], scene.motion)
        )
        return smgdiff_scene.to_frame(scene, frame)

    return smgdiff_scene.fit(
        skeleton, local(scenes), joints=data.joints, radius=data.radius
    )


def skill_speeds(data: BallClips) -> Float[np.ndarray, " skills"]:
    """Median speed of the root in each skill, to command it at.

    Meters per second; 0 for a skill without clips.
    """
    return np.asarray(label_speeds(data.clips, field=FIELD))
