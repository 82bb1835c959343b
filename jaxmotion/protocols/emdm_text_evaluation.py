"""Scores of motions made from texts: R-precision, FID, MM-Dist and the rest.

The evaluator embeds sentences and motions into one space. Trained here it is a small
one of the documented recipe; published weights have the published sizes. Real motions
go through the same sets: as many, of the same sentences.

Source: Guo et al. 2022 (T2M); Zhou et al. 2024 (EMDM), section 4.2.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.text_sampling import sample_text_batch, text_arrays
from jaxmotion.evaluation import diversity, frechet, matching
from jaxmotion.learning import checkpoint, published, training
from jaxmotion.learning import matching as evaluator
from jaxmotion.protocols import stages
from jaxmotion.protocols.emdm_text import TextRun
from jaxmotion.typing import Key, Params

# Of the evaluator that is trained here, on a CPU.
SMALL = dict(movement_width=192, motion_width=192, text_width=128, embedding=128)
_CONTACTS = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluator:
    """A text-motion evaluator and how it reads features.

    Attributes:
      params: Its parameters.
      config: Its size.
      mean: Of the features as it was trained on them.
      std: Likewise.
      name: What it is, for tables.
    """

    params: Params
    config: evaluator.MatcherConfig
    mean: Float[np.ndarray, " features"]
    std: Float[np.ndarray, " features"]
    name: str


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Sentences:
    """All captions of a run as an evaluator reads them.

    Attributes:
      vectors: Word vectors of the distinct captions.
      tags: One-hot parts of speech.
      words: Of each, with the marks of start and end.
      index: Distinct caption of each caption.
    """

    vectors: Float[Array, "sentences slots word"]
    tags: Float[Array, "sentences slots classes"]
    words: Int[Array, " sentences"]
    index: Int[Array, " captions"]


def sentences(run: TextRun) -> Sentences:
    """Encodes the captions of a run for its evaluator.

    Args:
      run: The run.

    Returns:
      The sentences.
    """
    distinct, index = np.unique(np.array(run.motions.tokens), return_inverse=True)
    coded = [evaluator.encode_tokens(str(tokens).split()) for tokens in distinct]
    return Sentences(
        vectors=jnp.asarray(np.stack([vectors for vectors, _, _ in coded])),
        tags=jnp.asarray(np.stack([tags for _, tags, _ in coded])),
        words=jnp.asarray([words for _, _, words in coded], jnp.int32),
        index=jnp.asarray(index, jnp.int32),
    )


def train_evaluator(
    run: TextRun, *, frames: int, num_steps: int, seed: int
) -> Evaluator:
    """The run's evaluator, trained on its training clips if it is not there yet.

    Args:
      run: The run.
      frames: Longest motion.
      num_steps: Updates.
      seed: Of parameters and batches.

    Returns:
      The evaluator.

    Raises:
      ValueError: if the folder's was trained otherwise; names the field.
    """
    folder = run.folder / "matcher"
    config = evaluator.MatcherConfig(
        num_features=run.motions.num_features - _CONTACTS, **SMALL
    )
    value = {
        "system": "emdm",
        "stage": "matcher",
        "steps": num_steps,
        "seed": seed,
        "frames": frames,
        "source": run.motions.source,
    }
    if checkpoint.latest_step(folder) is None:
        data = (
            text_arrays(run.motions, split="train", max_frames=frames),
            sentences(run),
        )
        params, _ = evaluator.train_matcher(
            jax.random.key(seed),
            _pairs,
            data,
            config=config,
            num_steps=num_steps,
            optimizer=training.adamw_cosine(
                learning_rate=1e-3, num_steps=num_steps, max_norm=0.5
            ),
        )
        checkpoint.save(folder, num_steps, {"params": params}, value)
    params = stages.restore_evaluator(
        folder, value, lambda: evaluator.init_matcher(jax.random.key(0), config)
    )
    return Evaluator(
        params=params,
        config=config,
        mean=run.motions.mean,
        std=run.motions.std,
        name=f"trained here, {num_steps} updates, hashed word vectors (no GloVe)",
    )


def _pairs(key: Key, data: Any) -> evaluator.Pairs:
    arrays, coded = data
    features, frames, caption = sample_text_batch(key, arrays, batch=32)
    row = coded.index[caption]
    return evaluator.Pairs(
        features=features[..., :-_CONTACTS],
        frames=frames,
        vectors=coded.vectors[row],
        tags=coded.tags[row],
        words=coded.words[row],
    )


def published_evaluator(run: TextRun, path: Path) -> Evaluator:
    """An evaluator with published weights; Mean.npy and Std.npy lie beside them.

    Args:
      run: The run.
      path: File of the weights (finest.tar or safetensors).

    Returns:
      The evaluator.

    Raises:
      OSError: if a file is missing.
      ValueError: if weights or statistics do not fit; names them.
    """
    width = run.motions.num_features
    config = evaluator.MatcherConfig(num_features=width - _CONTACTS)
    statistics = []
    for name in ("Mean.npy", "Std.npy"):
        values = np.load(path.parent / name, allow_pickle=False)
        if values.shape != (width,) or (name == "Std.npy" and not (values > 0).all()):
            raise ValueError(
                f"{path.parent / name}: expected {width} numbers (positive ones in "
                f"Std.npy), found shape {values.shape}"
            )
        statistics.append(values.astype(np.float32))
    return Evaluator(
        params=published.load_matcher(path, config=config),
        config=config,
        mean=statistics[0],
        std=statistics[1],
        name=f"published weights {path.name}",
    )


def embed(
    run: TextRun,
    judge: Evaluator,
    x: Float[Array, "batch frames features"],
    frames: Int[Array, " batch"],
) -> Float[Array, "batch embedding"]:
    """Embeds motions, de-normalised and normalised again as the evaluator expects.

    Args:
      run: The run.
      judge: The evaluator.
      x: Z-scored features of the run.
      frames: Of each motion.

    Returns:
      One row each.
    """
    row = lambda v: jnp.asarray(v)[None, None]  # noqa: E731
    raw = x * row(run.motions.std) + row(run.motions.mean)
    scored = (raw - row(judge.mean)) / row(judge.std)
    inside = jnp.arange(x.shape[1])[None] < frames[:, None]
    scored = jnp.where(inside[..., None], scored, 0.0)[..., :-_CONTACTS]
    return evaluator.embed_motion(judge.params, scored, frames, config=judge.config)


def make_scorer(
    run: TextRun, judge: Evaluator
) -> Callable[[Key, Array, Array, Array, frechet.Moments], dict[str, Array]]:
    """Scores of a set of motions, as one compiled program.

    Args:
      run: The run.
      judge: The evaluator.

    Returns:
      `score(key, x, frames, caption, reference) -> scores`: z-scored features, frames
      and caption of each motion, and moments of the real motions' embeddings.
    """
    coded = sentences(run)

    @jax.jit
    def score(
        key: Key, x: Array, frames: Array, caption: Array, reference: frechet.Moments
    ) -> dict[str, Array]:
        row = coded.index[caption]
        text = evaluator.embed_text(
            judge.params,
            coded.vectors[row],
            coded.tags[row],
            coded.words[row],
            config=judge.config,
        )
        motion = embed(run, judge, x, frames)
        precision = matching.r_precision(text, motion)
        return {
            "R-precision 1": precision[0],
            "R-precision 2": precision[1],
            "R-precision 3": precision[2],
            "FID": frechet.frechet_distance(frechet.moments(motion), reference),
            "MM-Dist": matching.matching_distance(text, motion),
            "diversity": diversity.diversity(key, motion, num_pairs=300),
        }

    return score
