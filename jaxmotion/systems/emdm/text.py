"""EMDM from texts: the data of a run, and its task.

A caption's vector comes from a text encoder once and is data from then on.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.data import clips_io, selection, text_motion
from jaxmotion.data.text_motion import (
    TextArrays,
    TextMotions,
    sample_text_batch,
    text_arrays,
)
from jaxmotion.learning import runs
from jaxmotion.motion import humanml
from jaxmotion.motion.humanml_layout import HUMANML3D, KIT_ML, Layout
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.text import encoder as text_encoder
from jaxmotion.typing import Key

# CLIP reads 77 tokens; no caption of the published sets comes near so many words.
MAX_WORDS = 75
# "released": CLIP's vectors as they are, of a text's first 20 tokens and its two ends.
# "unit" (ours): of whole texts, scaled to mean square 1 over the captions of a run.
TextForm = Literal["released", "unit"]
_RELEASED_TOKENS = 22


@dataclasses.dataclass(frozen=True, kw_only=True)
class TextRun:
    """A run folder and its data.

    Attributes:
      motions: Clips with captions.
      vectors: Vectors of the captions' distinct sentences, as the networks take them.
      index: Vector of each caption.
      scale: What the encoder's vectors were multiplied with; 1 as released.
    """

    record: runs.Run
    motions: TextMotions
    encoder: text_encoder.TextEncoder
    vectors: Float[np.ndarray, "sentences channels"]
    index: np.ndarray
    scale: float

    @property
    def layout(self) -> Layout:
        """Which of the two published skeletons the features describe."""
        layouts = {layout.num_features: layout for layout in (HUMANML3D, KIT_ML)}
        return layouts[self.motions.num_features]


def default_form(encoder: str) -> TextForm:
    """As released for CLIP; "unit" for the other encoders, which no release has."""
    return "unit" if encoder in text_encoder.OWN else "released"


def make_encoder(name: str, form: TextForm) -> text_encoder.TextEncoder:
    """The encoder that a user asks for, reading as much of a text as the form says.

    `ModuleNotFoundError` if a package is missing, with how to install it; a
    `ValueError` names an encoder that there is not, or that is not CLIP in the form
    "released".
    """
    if form == "released" and name in text_encoder.OWN:
        raise ValueError(
            f"text form is 'released', which is of CLIP's vectors, but encoder is "
            f"{name!r}: expected 'unit', or a folder with CLIP's weights"
        )
    limit = _RELEASED_TOKENS if form == "released" else None
    return text_encoder.make_encoder(name, max_tokens=limit)


def check_words(texts: Sequence[str]) -> None:
    """Raises a `ValueError`, with its number and length, if a text is too long."""
    for i, text in enumerate(texts):
        if (found := len(text.split())) > MAX_WORDS:
            raise ValueError(
                f"text {i} has {found} words, expected at most {MAX_WORDS}"
            )


_FILE = "motions.npz"


def prepare(
    folder: Path,
    data: tuple[Path, ...],
    *,
    encoder: str,
    form: TextForm,
    unseen: Sequence[str],
    least: int,
    fps: float,
    frames: int,
    held_out: float,
) -> TextRun:
    """Makes the text motions of a run folder, or loads those it has.

    Data are one file of text motions or files of labeled clips, whose pairs
    "content/style" in `unseen` are kept for evaluation, as is a part of the others;
    they have `least` frames or more, and features at `fps`. The form says how much of a
    text is read, and how vectors are scaled; motions have `frames` at most.
    `ValueError` if the folder was made otherwise, or an argument is wrong.
    """

    def make() -> runs.Content:
        # An encoder that is not there should be said before the features are made.
        make_encoder(encoder, form)
        if len(data) == 1 and text_motion.is_text_motions(data[0]):
            motions = text_motion.load_text_motions(data[0])
        else:
            clips = selection.concatenate([clips_io.load_clips(x) for x in data])
            motions, error = emdm_data.from_labels(
                clips, unseen=unseen, held_out=held_out, least=least, fps=fps, seed=0
            )
            print(
                f"HumanML3D features of {motions.num_clips} clips; joints -> features "
                f"-> joints: {error:.1e} m at most"
            )
        return runs.Content(
            model={},
            source=motions.source,
            split={
                split: [motions.clip_names[i] for i in motions.clips_of(split)]
                for split in motions.split_names
            },
            files={
                _FILE: functools.partial(text_motion.save_text_motions, motions=motions)
            },
        )

    settings = dict(
        task="text",
        encoder=encoder,
        text_form=form,
        unseen=list(unseen),
        fps=fps,
        frames=frames,
        held_out=held_out,
    )
    return _decode(
        runs.begin(
            folder,
            system=emdm_training.SYSTEM,
            data=data,
            settings=settings,
            make=make,
        )
    )


def load_run(folder: Path) -> TextRun:
    """Loads the data of a run folder; captions are encoded once and kept there.

    A `ValueError` names the field of what is no run folder of EMDM with texts.
    """
    return _decode(runs.load(folder, system=emdm_training.SYSTEM))


def _decode(record: runs.Run) -> TextRun:
    emdm_training.check_task(record, ("text",))
    motions = text_motion.load_text_motions(record.file(_FILE))
    form = record.settings["text_form"]
    encoder = make_encoder(record.settings["encoder"], form)
    cache = record.folder / "data" / "texts.npz"
    unique = text_encoder.encode_unique(encoder, motions.captions, cache=cache)
    vectors = np.asarray(unique.vectors)
    scale = 1.0 if form == "released" else float(np.mean(vectors**2) ** -0.5)
    return TextRun(
        record=record,
        motions=motions,
        encoder=encoder,
        vectors=vectors * scale,
        index=np.asarray(unique.index),
        scale=scale,
    )


def encode(run: TextRun, texts: Sequence[str]) -> Float[Array, "texts channels"]:
    """Vectors of new sentences, one row each, as the networks of a run know them.

    A `ValueError` names the number of a text that is empty or too long.
    """
    check_words(texts)
    return jnp.asarray(run.encoder.encode(texts) * run.scale, jnp.float32)


def make_task(
    run: TextRun, base: emdm_model.Config, *, frames: int
) -> emdm_training.Task:
    """What models of a run are trained on: features only, no joints (as in the paper).

    Features, frames (the longest motion) and condition of `base` are set here.
    """
    base = dataclasses.replace(
        base,
        features=run.motions.num_features,
        frames=frames,
        condition="text",
        condition_size=run.vectors.shape[-1],
        weight_position=0.0,
        weight_velocity=0.0,
        weight_foot=0.0,
    )
    data = (
        text_arrays(run.motions, split="train", max_frames=frames),
        jnp.asarray(run.vectors, jnp.float32),
        jnp.asarray(run.index, jnp.int32),
    )

    def batch(
        key: Key, data: tuple[TextArrays, Array, Array], size: int
    ) -> emdm_loss.Batch:
        arrays, vectors, index = data
        x_0, length, caption = sample_text_batch(key, arrays, batch=size)
        return emdm_loss.Batch(
            x_0=x_0,
            vector=vectors[index[caption]],
            mask=jnp.arange(frames)[None] < length[:, None],
        )

    return emdm_training.Task(
        run=run.record,
        base=base,
        data=data,
        batch=batch,
        geometry=None,
    )


def joints(
    run: TextRun, x: Float[Array, "*batch frames features"]
) -> Float[Array, "*batch frames joints 3"]:
    """Joint positions of z-scored features.

    Meters (as published: KIT-ML's unit is its own).
    """
    like = lambda v: jnp.asarray(v).reshape((1,) * (x.ndim - 1) + (-1,))  # noqa: E731
    raw = x * like(run.motions.std) + like(run.motions.mean)
    return humanml.joints_from_features(raw, run.layout)
