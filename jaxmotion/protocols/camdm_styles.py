"""Recognition of styles: training of the recogniser, its features and its hits.

Source: Chen et al. 2024 (CAMDM), section 4.1; released feature extractor.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.data.clips import Clips
from jaxmotion.learning import recognition
from jaxmotion.motion import skeleton
from jaxmotion.protocols.camdm import WINDOW, Windows, data_windows
from jaxmotion.typing import Key, Params


def in_batches(function: Callable[[Any], Any], x: Any, *, size: int = 256) -> Any:
    """Applies a jitted function to slices of the first axis, to bound the memory.

    Args:
      function: Array or pytree with a first axis to the like.
      x: Its argument.
      size: Rows at a time.

    Returns:
      The results, put together.
    """
    number = jax.tree.leaves(x)[0].shape[0]
    parts = [
        jax.device_get(function(jax.tree.map(lambda a: a[i : i + size], x)))  # noqa: B023
        for i in range(0, number, size)
    ]
    return jax.tree.map(lambda *p: np.concatenate(p), *parts)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recognized:
    """A style recogniser and its size.

    Attributes:
      params: Its parameters.
      config: Its size.
      classes: Its class of each label; none if they are the same.
    """

    params: Params
    config: recognition.RecognizerConfig
    classes: tuple[int, ...] = ()


def fit_recognizer(
    key: Key, clips: Clips, *, field: str, num_steps: int = 1500, batch: int = 128
) -> Recognized:
    """Trains the style recogniser on windows with a stride of 10 frames.

    Args:
      key: Consumed.
      clips: Training clips.
      field: Label field that is the style.
      num_steps: Updates.
      batch: Windows an update.

    Returns:
      The recogniser.
    """
    found = data_windows(clips, stride=10, field=field)
    config = recognition.RecognizerConfig(
        num_classes=len(clips.names(field)),
        num_joints=clips.skeleton.num_joints,
        frames=WINDOW,
    )
    to_input = jax.jit(functools.partial(recognition.recognizer_input, clips.skeleton))
    x = jnp.asarray(in_batches(to_input, found.motion))
    params, _ = recognition.train_recognizer(
        key, x, found.label, config=config, num_steps=num_steps, batch=batch
    )
    return Recognized(params=params, config=config)


def recognized(
    bones: skeleton.Skeleton, found: Windows, recognizer: Recognized
) -> tuple[np.ndarray, np.ndarray]:
    """Features of windows, and whether each one's style is recognised.

    Args:
      bones: The skeleton.
      found: Windows.
      recognizer: From `fit_recognizer`.

    Returns:
      Features [windows, 512], and hits [windows] (0 or 1).
    """
    run = functools.partial(_recognize, recognizer.params, bones, recognizer.config)
    label = found.label
    if recognizer.classes:
        label = jnp.asarray(recognizer.classes)[label]
    return in_batches(run, (found.motion, label))


@functools.partial(jax.jit, static_argnums=2)
def _recognize(
    params: Params,
    bones: skeleton.Skeleton,
    config: recognition.RecognizerConfig,
    x: tuple[skeleton.Motion, Array],
) -> tuple[Array, Array]:
    motion, label = x
    given = config.read(bones, motion)
    feature, logits = recognition.recognize(params, given, config=config)
    return feature, (jnp.argmax(logits, axis=-1) == label).astype(jnp.float32)
