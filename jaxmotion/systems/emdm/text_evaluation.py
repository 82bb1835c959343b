"""Scores of motions made from texts: R-precision, FID, MM-Dist and the rest.

The evaluator embeds sentences and motions into one space. Trained here it is a small
one of the documented recipe; published weights have the published sizes. Real motions
go through the same sets: as many, of the same sentences.

Source: Guo et al. 2022 (T2M); Zhou et al. 2024 (EMDM), section 4.2.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.plain_pickle import read_plain_pickle
from jaxmotion.data.text_files import read_array
from jaxmotion.data.text_motion import check_statistics, sample_text_batch, text_arrays
from jaxmotion.evaluation import diversity, frechet, matching
from jaxmotion.evaluation.table import Row
from jaxmotion.evaluators import published
from jaxmotion.evaluators import text_motion as text_motion_evaluator
from jaxmotion.learning import checkpoint, runs, training
from jaxmotion.learning.fingerprint import fingerprint
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.emdm.scoring import (
    Many,
    RowScorer,
    Scores,
    Settings,
    replicated_row,
)
from jaxmotion.systems.emdm.text import TextRun
from jaxmotion.typing import Key, Params

# For the evaluator that is trained here, on a CPU.
SMALL = dict(movement_width=192, motion_width=192, text_width=128, embedding=128)
_CONTACTS = 4
# Statistics of the published evaluators, as their releases name them.
_STATISTICS = (
    ("mean.npy", "std.npy"),
    ("t2m_mean.npy", "t2m_std.npy"),
    ("kit_mean.npy", "kit_std.npy"),
    ("Mean.npy", "Std.npy"),
)
_MARKS = ("sos", "eos", "unk")
GLOVE = ("our_vab_data.npy", "our_vab_words.pkl", "our_vab_idx.pkl")
# Deviations of the root and of contact labels were divided twice by 5 there.
_SHRUNK = 1 / 25
Vocabulary = Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluator:
    """A text-motion evaluator and how it reads features.

    Attributes:
      mean: Mean of the features as it was trained on them.
      std: Their standard deviation.
      name: What it is, for tables.
      vocabulary: Vectors of the words that it knows; None for hashed ones.
    """

    params: Params
    config: text_motion_evaluator.MatcherConfig
    mean: Float[np.ndarray, " features"]
    std: Float[np.ndarray, " features"]
    name: str
    vocabulary: Vocabulary | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Sentences:
    """All captions of a run as an evaluator reads them.

    Attributes:
      vectors: Word vectors of the distinct captions.
      tags: One-hot parts of speech.
      words: Words of each, with the marks of start and end.
      index: Distinct caption of each caption.
    """

    vectors: Float[Array, "sentences slots word"]
    tags: Float[Array, "sentences slots classes"]
    words: Int[Array, " sentences"]
    index: Int[Array, " captions"]


def sentences(run: TextRun, vocabulary: Vocabulary | None = None) -> Sentences:
    """Encodes the captions of a run as `matching.encode_tokens` does."""
    distinct, index = np.unique(np.array(run.motions.tokens), return_inverse=True)
    coded = [
        text_motion_evaluator.encode_tokens(str(tokens).split(), vocabulary)
        for tokens in distinct
    ]
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

    A `ValueError` names the field in which the folder's was trained otherwise.
    """
    folder = run.record.folder / "matcher"
    config = text_motion_evaluator.MatcherConfig(
        num_features=run.motions.num_features - _CONTACTS, **SMALL
    )
    value = {
        "system": "emdm",
        "stage": "matcher",
        "steps": num_steps,
        "seed": seed,
        "frames": frames,
        "source": run.motions.source,
        "special_words": "released",
    }
    if checkpoint.latest_step(folder) is None:
        data = (
            text_arrays(run.motions, split="train", max_frames=frames),
            sentences(run),
        )
        params, _ = text_motion_evaluator.train_matcher(
            jax.random.key(seed),
            _pairs,
            data,
            config=config,
            num_steps=num_steps,
            optimizer=training.make_optimizer(
                "adamw", learning_rate=1e-3, num_steps=num_steps, max_norm=0.5
            ),
        )
        checkpoint.save(folder, num_steps, {"params": params}, value)
    params = runs.restore_evaluator(
        folder,
        value,
        lambda: text_motion_evaluator.init_matcher(jax.random.key(0), config),
    )
    return Evaluator(
        params=params,
        config=config,
        mean=run.motions.mean,
        std=run.motions.std,
        name=f"trained here, {num_steps} updates, hashed word vectors (no GloVe)",
    )


def _pairs(key: Key, data: Any) -> text_motion_evaluator.Pairs:
    arrays, coded = data
    features, frames, caption = sample_text_batch(key, arrays, batch=32)
    row = coded.index[caption]
    return text_motion_evaluator.Pairs(
        features=features[..., :-_CONTACTS],
        frames=frames,
        vectors=coded.vectors[row],
        tags=coded.tags[row],
        words=coded.words[row],
    )


def load_glove(folder: Path) -> dict[str, np.ndarray]:
    """Word vectors of published weights, by word, for `matching.encode_tokens`.

    The folder has our_vab_data.npy [words, 300], our_vab_words.pkl (the words) and
    our_vab_idx.pkl (row of each); nothing in the pickles is run.

    A `ValueError` names a file that is missing, damaged or does not fit the others.
    """
    data, listed, rows = (folder / name for name in GLOVE)
    vectors = read_array(data)
    words, index = (_read_pickle(path) for path in (listed, rows))
    if vectors.ndim != 2 or vectors.shape[1] != text_motion_evaluator.WORD_SIZE:
        raise ValueError(
            f"{data}: expected rows of {text_motion_evaluator.WORD_SIZE} numbers, "
            f"found shape {vectors.shape}"
        )
    if not np.isfinite(vectors).all():
        row = int(np.argwhere(~np.isfinite(vectors))[0, 0])
        raise ValueError(f"{data}: row {row} is not finite")
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise ValueError(f"{listed}: expected a list of words")
    if not isinstance(index, dict):
        raise ValueError(f"{rows}: expected a row for each word")
    for word in (*_MARKS, *words):
        row = index.get(word)
        if type(row) is not int or not 0 <= row < len(vectors):
            raise ValueError(
                f"{rows}: the row of {word!r} is {row!r}, expected one of the "
                f"{len(vectors)} in {data.name}"
            )
    if missing := [mark for mark in _MARKS if mark not in words]:
        raise ValueError(f"{listed}: no {', '.join(missing)} among the words")
    return {word: vectors[index[word]] for word in words}


def _read_pickle(path: Path) -> Any:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return read_plain_pickle(data, name=str(path))


def read_statistics(
    folder: Path, num_features: int
) -> tuple[Float[np.ndarray, " features"], Float[np.ndarray, " features"]]:
    """Mean and deviations of a published evaluator, told apart from a data set's.

    A contact label is 0 or 1, so that its deviation follows from its mean p: it is
    sqrt(p (1 - p)). In both published evaluators (HumanML3D's and KIT-ML's) it is a
    25th of that, in the statistics of a data set once that.

    The folder has mean.npy and std.npy, as the evaluator's meta folder, or the same
    under another of the released names; features end in the 4 contact labels. A
    `ValueError` names the file if there are none, of so many features, of an evaluator.
    """
    for names in _STATISTICS:
        paths = [folder / name for name in names]
        if all(path.exists() for path in paths):
            break
    else:
        raise ValueError(
            f"{folder}: expected mean.npy and std.npy of the evaluator's meta folder "
            "beside its weights, found neither they nor t2m_mean.npy, kit_mean.npy or "
            "Mean.npy with their deviations"
        )
    mean, std = (read_array(path) for path in paths)
    check_statistics(mean, std, num_features, names=(str(paths[0]), str(paths[1])))
    share = mean[-_CONTACTS:]
    if not ((share > 0) & (share < 1)).all():
        raise ValueError(
            f"{paths[0]}: the last {_CONTACTS} numbers, means of contact labels, "
            f"should be between 0 and 1, found {share.tolist()}"
        )
    ratio = float(std[-_CONTACTS:].mean() / np.sqrt(share * (1 - share)).mean())
    if not abs(ratio / _SHRUNK - 1) < 0.05:
        raise ValueError(
            f"{paths[1]}: contact labels deviate {ratio:.3g} times as much as their "
            f"mean implies, expected {_SHRUNK:.3g}: not the evaluator's own statistics "
            "(of its meta folder) but those of a data set or of other features"
        )
    return mean, std


def published_evaluator(run: TextRun, path: Path, *, glove: Path) -> Evaluator:
    """An evaluator with published weights; its statistics lie beside them.

    The run is of HumanML3D's features, or KIT-ML's for its evaluator; the path is
    finest.tar or safetensors; `glove` is for `load_glove`. A `ValueError` names what
    does not fit: weights, statistics or word vectors.
    """
    width = run.motions.num_features
    config = text_motion_evaluator.MatcherConfig(num_features=width - _CONTACTS)
    mean, std = read_statistics(path.parent, width)
    vocabulary = load_glove(glove)
    return Evaluator(
        params=published.load_matcher(path, config=config),
        config=config,
        mean=mean,
        std=std,
        name=f"published weights {path.name}, {len(vocabulary)} words of GloVe",
        vocabulary=vocabulary,
    )


def embed(
    run: TextRun,
    evaluator: Evaluator,
    x: Float[Array, "batch frames features"],
    frames: Int[Array, " batch"],
    *,
    padding: text_motion_evaluator.Padding = "zeros",
) -> Float[Array, "batch embedding"]:
    """Embeds motions, normalized anew as the evaluator expects; one row each.

    x is z-scored features of the run. Beyond a motion's end the evaluator sees "zeros",
    as beyond that of real motions, or what is there ("kept"), as the release does with
    generated motions.
    """
    # At once, and not by way of the raw features, which would lose digits.
    wide = lambda v: np.asarray(v, np.float64)  # noqa: E731
    scale = wide(run.motions.std) / evaluator.std
    shift = (wide(run.motions.mean) - evaluator.mean) / evaluator.std
    row = lambda v: jnp.asarray(v, jnp.float32)[None, None]  # noqa: E731
    scored = (x * row(scale) + row(shift))[..., :-_CONTACTS]
    return text_motion_evaluator.embed_motion(
        evaluator.params, scored, frames, config=evaluator.config, padding=padding
    )


def make_scorer(
    run: TextRun,
    evaluator: Evaluator,
    *,
    padding: text_motion_evaluator.Padding = "zeros",
) -> Callable[[Key, Array, Array, Array, frechet.Moments], dict[str, Array]]:
    """Scores of a set of motions, as one compiled program.

    Returns:
      `score(key, x, frames, caption, reference) -> scores`: z-scored features, frames
      and caption of each motion, and moments of the real motions' embeddings.
    """
    coded = sentences(run, evaluator.vocabulary)

    @jax.jit
    def score(
        key: Key, x: Array, frames: Array, caption: Array, reference: frechet.Moments
    ) -> dict[str, Array]:
        row = coded.index[caption]
        text = text_motion_evaluator.embed_text(
            evaluator.params,
            coded.vectors[row],
            coded.tags[row],
            coded.words[row],
            config=evaluator.config,
        )
        motion = embed(run, evaluator, x, frames, padding=padding)
        precision = matching.r_precision(text, motion)
        return {
            "r_precision_1": precision[0],
            "r_precision_2": precision[1],
            "r_precision_3": precision[2],
            "fid": frechet.frechet_distance(frechet.moments(motion), reference),
            "mm_dist": matching.matching_distance(text, motion),
            "diversity": diversity.diversity(key, motion, num_pairs=300),
        }

    return score


# Multimodality: sentences, motions of each, pairs of them.
_SENTENCES, _REPEATS, _PAIRS = 16, 8, 10
_SEEN = {"zeros": "zeros", "kept": "the model's output, as in the released evaluation"}


def row_scorer(folder: Path, settings: Settings) -> RowScorer:
    """The evaluator of a run folder, and real motions' scores.

    `ValueError` if the run has other data, there are too few samples, or the evaluator
    is one of actions.
    """
    if settings.evaluator is not None:
        raise ValueError(
            f"evaluator is {settings.evaluator.path}, but {folder} makes motions "
            "from texts: expected none, or --matcher"
        )
    if settings.foot_lock:
        raise ValueError(
            f"foot_lock is on, but {folder} makes motions from texts, which are scored "
            "as features: expected off"
        )
    if (settings.matcher is None) != (settings.glove is None):
        raise ValueError(
            f"matcher is {settings.matcher} and glove is {settings.glove}: "
            "published weights read GloVe's vectors, so give both, --glove the folder "
            f"with {', '.join(GLOVE)}, or neither"
        )
    run = emdm_text.load_run(folder)
    frames, number = run.record.settings["frames"], settings.samples // 32 * 32
    if number < 64:
        raise ValueError(f"samples is {settings.samples}, expected at least 64")
    steps = 600 if settings.evaluator_steps is None else settings.evaluator_steps
    chosen = (
        published_evaluator(run, settings.matcher, glove=settings.glove)
        if settings.matcher and settings.glove
        else train_evaluator(run, frames=frames, num_steps=steps, seed=0)
    )
    arrays = {
        split: text_arrays(run.motions, split=split, max_frames=frames)
        for split in ("train", "test", "val")
        if run.motions.clips_of(split).size
    }
    draw = jax.jit(sample_text_batch, static_argnames="batch")
    embedding = jax.jit(
        functools.partial(embed, run, chosen), static_argnames="padding"
    )
    score = {
        padding: make_scorer(run, chosen, padding=padding)
        for padding in get_args(text_motion_evaluator.Padding)
        if padding in ("zeros", settings.padding)
    }

    def moments(split: str) -> frechet.Moments:
        key = jax.random.key(settings.seed)
        x, length, _ = draw(key, arrays[split], batch=number)
        return frechet.moments(embedding(x, length, padding="zeros"))

    references = {split: moments(split) for split in arrays}

    def score_real(split: str) -> Row:
        def once(key: Key) -> Scores:
            key_draw, key_score = jax.random.split(key)
            x, length, caption = draw(key_draw, arrays[split], batch=number)
            return score["zeros"](key_score, x, length, caption, references[split])

        key = jax.random.key(settings.seed + 7)
        return replicated_row(key, once, number=settings.replications)

    vectors, index = jnp.asarray(run.vectors, jnp.float32), jnp.asarray(run.index)

    def conditions(caption: Array, length: Array) -> emdm_model.Condition:
        return emdm_model.Condition(
            vector=vectors[index[caption]],
            keep=jnp.ones(caption.shape, bool),
            mask=jnp.arange(frames)[None] < length[:, None],
        )

    scale = emdm_training.guidance_scale(settings.scale, task="text")

    def score_split(key: Key, many: Many, split: str) -> Scores:
        key_draw, key_sample, key_score = jax.random.split(key, 3)
        _, length, caption = draw(key_draw, arrays[split], batch=number)
        x = many(key_sample, conditions(caption, length), scale)
        return score[settings.padding](key_score, x, length, caption, references[split])

    def score_row(key: Key, many: Many) -> Scores:
        key_own, key_draw, key_sample, key_pairs, key_unseen = jax.random.split(key, 5)
        found = score_split(key_own, many, "test")
        _, length, caption = draw(key_draw, arrays["test"], batch=_SENTENCES)
        length, caption = (jnp.repeat(v, _REPEATS) for v in (length, caption))
        x = many(key_sample, conditions(caption, length), scale)
        features = embedding(x, length, padding=settings.padding)
        features = features.reshape(_SENTENCES, _REPEATS, -1)
        found["multimodality"] = diversity.multimodality(
            key_pairs, features, num_pairs=_PAIRS
        )
        if "val" in arrays:
            unseen = score_split(key_unseen, many, "val")
            found["r_precision_3_unseen"] = unseen["r_precision_3"]
        return found

    names = {
        "train": "real (training clips)",
        "test": "real (held-out clips)",
        "val": "real (unseen pairs)",
    }
    one = conditions(jnp.zeros(1, jnp.int32), jnp.full(1, frames))
    return RowScorer(
        real={names[split]: score_real(split) for split in arrays},
        score=score_row,
        scale=scale,
        one=jax.tree.map(lambda x: x[0], one),
        samples=number,
        describe={
            "fingerprint": fingerprint(chosen.params),
            "origin": chosen.name,
            "matcher": dataclasses.asdict(chosen.config) | {"name": chosen.name},
            "texts": f"{run.encoder.name}, {run.record.settings['text_form']}",
            "padding": settings.padding,
            "reference": f"{number} real motions of the same split",
        },
        notes=(
            "Beyond the end of generated motions the evaluator sees "
            f"{_SEEN[settings.padding]}.",
        ),
    )
