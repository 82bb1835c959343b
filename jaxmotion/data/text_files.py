"""Caption files of HumanML3D and KIT-ML, and the clips that their times cut out.

A file has one caption a line:

    a person waves.#a/DET person/NOUN wave/VERB#0.0#0.0

that is, the sentence, its words as lemma/part of speech, and from when to when it
holds, in seconds. 0.0#0.0 (or nan) means the whole recording. A caption with times
makes a clip of its own.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmotion import files


def read_array(path: Path) -> Float[np.ndarray, "..."]:
    """Numbers in an npy file, as float32; a `ValueError` names one without them."""
    try:
        return files.read_array(path, what="feature")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except OSError as error:
        raise ValueError(f"{path}: not a feature file ({error})") from None


class Caption(NamedTuple):
    """A line of a caption file.

    Attributes:
      text: The sentence.
      tokens: Its words as "word/POS word/POS".
      start: When it begins to hold, seconds.
      stop: When it ends; start = stop = 0 for the whole recording.
      line: Its number in the file, from 1.
    """

    text: str
    tokens: str
    start: float
    stop: float
    line: int


def _parse_time(where: str, field: str, text: str) -> float:
    """Seconds; nan, which the published files contain, is 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if math.isnan(value):
        return 0.0
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{where}: {field}: expected seconds, found {text!r}")
    return value


def parse_captions(text: str, *, path: str) -> list[Caption]:
    """Captions of a file, one per line; empty lines are skipped.

    A `ValueError` names the file, and the line that lacks its tags or times, or says
    that there is no caption.
    """
    captions = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        where = f"{path}, line {number}"
        fields = line.strip().split("#")
        if len(fields) != 4:
            raise ValueError(
                f"{where}: expected caption#word/POS word/POS#start#end, found "
                f"{len(fields)} fields: {line.strip()[:60]!r}"
            )
        sentence, tokens = fields[0].strip(), fields[1].split()
        if not sentence:
            raise ValueError(f"{where}: the caption is empty")
        for token in tokens or [""]:
            word, slash, tag = token.partition("/")
            if not (word and slash and tag) or "/" in tag:
                raise ValueError(
                    f"{where}: expected words as word/POS, found {token!r}"
                )
        start, stop = (
            _parse_time(where, field, value)
            for field, value in zip(("start", "end"), fields[2:], strict=True)
        )
        captions.append(Caption(sentence, " ".join(tokens), start, stop, number))
    if not captions:
        raise ValueError(f"{path}: no captions")
    return captions


def cut_recording(
    name: str,
    features: Float[np.ndarray, "frames features"],
    captions: Sequence[Caption],
    *,
    cut_fps: float,
    min_frames: int,
    max_frames: int,
) -> list[tuple[str, Float[np.ndarray, "_ features"], list[tuple[str, str]]]]:
    """Clips of a recording: itself, and one for each caption with times.

    A recording or a clip of the wrong length is left out; with a recording go all
    captions that cut it.

    Returns:
      (name, frames, (sentence, tokens) of each caption) of each clip. The clip of line
      n is named <name>_line<n>.

    Source: the data loader released with T2M and HumanML3D.
    """
    fits = lambda frames: min_frames <= len(frames) <= max_frames  # noqa: E731
    if not fits(features):
        return []
    whole = [(c.text, c.tokens) for c in captions if c.start == c.stop == 0.0]
    clips = [(name, features, whole)] if whole else []
    for caption in captions:
        if caption.start == caption.stop == 0.0:
            continue
        part = features[int(caption.start * cut_fps) : int(caption.stop * cut_fps)]
        if fits(part):
            pair = (caption.text, caption.tokens)
            clips.append((f"{name}_line{caption.line}", part, [pair]))
    return clips
