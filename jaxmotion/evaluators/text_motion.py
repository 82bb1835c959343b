"""Training of the text-motion evaluator, and sentences as it reads them.

With d the distance of a sentence's and a motion's embedding, and margin m = 10,

    loss = mean over pairs d^2 + mean over mismatched pairs max(0, m - d)^2.     (1)

Differs from the source: there the movement encoder is first trained in an autoencoder
and then kept fixed; here all parts are trained together by (1). There the batch is
also now and then mismatched with itself (a shift of 0), here never.

Source: Guo et al. 2022 (T2M), section 5; released code: Adam 1e-4, gradients clipped to
0.5, the motions of a batch shifted by a random number of rows.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.evaluators.network import UNIT, Matcher, Padding
from jaxmotion.learning import training
from jaxmotion.networks import blocks
from jaxmotion.typing import Key, Params

MARGIN = 10.0
WORD_SIZE = 300
MAX_WORDS = 20
# Parts of speech, then the classes of words that describe motions.
TAGS = (
    *("VERB", "NOUN", "DET", "ADP", "NUM", "AUX", "PRON", "ADJ", "ADV"),
    *("Loc_VIP", "Body_VIP", "Obj_VIP", "Act_VIP", "Desc_VIP", "OTHER"),
)
# Words whose class is that of the list they are in, whatever their part of speech: as
# published weights know them. Lemmas, mostly.
SPECIAL_WORDS: Mapping[str, frozenset[str]] = {
    "Loc_VIP": frozenset(
        "anticlockwise back backward clockwise counterclockwise curve down forward "
        "left right straight up".split()
    ),
    "Body_VIP": frozenset(
        "arm chin eye face feet foot hand knee leg mouth shoulder thigh waist".split()
    ),
    "Obj_VIP": frozenset(
        "ball baseball basketball car chair dumbbell floor handrail stair "
        "window".split()
    ),
    "Act_VIP": frozenset(
        "balance bend bring climb dance flap hop jog jump kick kneel lean lift lower "
        "pick put raise rotate rub run shuffle sit spin spread squat stand stop stroll "
        "stumble swing throw turn walk wash".split()
    ),
    "Desc_VIP": frozenset(
        "angrily angry careful carefully fast happily happy quickly sad sadly slow "
        "slowly".split()
    ),
}
_NORM = 6.0  # about that of a GloVe vector of a common word


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatcherConfig:
    """Size of the evaluator.

    Attributes:
      num_features: Channels of a frame, without the 4 contact labels: 259 for
        HumanML3D, 247 for KIT-ML.
        motion_width, text_width: Channels of the GRUs, one direction.
    """

    num_features: int = 259
    movement_width: int = 512
    motion_width: int = 1024
    text_width: int = 512
    embedding: int = 512
    dropout: float = 0.2

    @property
    def network(self) -> Matcher:
        """The network of this size."""
        sizes = dataclasses.asdict(self)
        del sizes["num_features"]
        return Matcher(**sizes)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """Motions, and in the same row a sentence that describes each.

    Features are normalized, without contact labels, of 4 frames or more; tags are
    one-hot parts of speech, in the order of `TAGS`; words include the marks of start
    and end.
    """

    features: Float[Array, "*batch frames channels"]
    frames: Int[Array, "*batch"]
    vectors: Float[Array, "*batch slots word"]
    tags: Float[Array, "*batch slots classes"]
    words: Int[Array, "*batch"]


@functools.partial(jax.jit, static_argnames="config")
def init_matcher(key: Key, config: MatcherConfig) -> Params:
    """Initial parameters of `Matcher`."""
    one = jnp.ones((1,), jnp.int32)
    return config.network.init(
        key,
        jnp.zeros((1, UNIT, config.num_features)),
        UNIT * one,
        jnp.zeros((1, 1, WORD_SIZE)),
        jnp.zeros((1, 1, len(TAGS))),
        one,
    )["params"]


@functools.partial(jax.jit, static_argnames=("config", "padding"))
def embed_motion(
    params: Params,
    features: Float[Array, "batch frames channels"],
    frames: Int[Array, " batch"],
    *,
    config: MatcherConfig,
    padding: Padding = "zeros",
) -> Float[Array, "batch embedding"]:
    """Embeds motions, for every measure of text-to-motion.

    Features are as in `Pairs`, all padded to the length used in training; frames beyond
    a multiple of 4 do not count. `padding` says what is seen there: "zeros", or "kept".
    """
    return blocks.apply(
        params, config.network, features, frames, padding=padding, method="embed_motion"
    )


@functools.partial(jax.jit, static_argnames="config")
def embed_text(
    params: Params,
    vectors: Float[Array, "batch slots word"],
    tags: Float[Array, "batch slots classes"],
    words: Int[Array, " batch"],
    *,
    config: MatcherConfig,
) -> Float[Array, "batch embedding"]:
    """Embeds sentences that `encode_tokens` encoded."""
    return blocks.apply(
        params, config.network, vectors, tags, words, method="embed_text"
    )


def matcher_loss(
    params: Params, key: Key, batch: Pairs, *, config: MatcherConfig
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Contrastive loss of a batch of at least two pairs: (1) of this module.

    A mismatched pair is a sentence and the motion some rows on, one number of rows for
    the batch. If it has the same sentence, the pair is pushed apart all the same. The
    key is consumed by dropout and the shift.

    Source: Hadsell et al. 2006; Guo et al. 2022 (T2M).
    """
    count = batch.frames.shape[0]
    if count < 2:
        raise ValueError(f"a batch of {count}, expected at least 2 to mismatch pairs")
    key_drop, key_shift = jax.random.split(key)
    text, motion = blocks.apply(
        params,
        config.network,
        *(batch.features, batch.frames, batch.vectors, batch.tags, batch.words),
        train=True,
        rngs={"dropout": key_drop},
    )
    shift = jax.random.randint(key_shift, (), 1, count)
    matched = jnp.mean(jnp.sum((text - motion) ** 2, axis=-1))
    squared = jnp.sum((text - jnp.roll(motion, -shift, axis=0)) ** 2, axis=-1)
    # The root has no gradient at 0.
    distance = jnp.sqrt(jnp.maximum(squared, 1e-12))
    mismatched = jnp.mean(jnp.maximum(MARGIN - distance, 0.0) ** 2)
    return matched + mismatched, {"matched": matched, "mismatched": mismatched}


def train_matcher(
    key: Key,
    sample_batch: Callable[[Key, Any], Pairs],
    data: Any,
    *,
    config: MatcherConfig,
    num_steps: int,
    optimizer: training.Optimizer | None = None,
) -> tuple[Params, dict[str, Array]]:
    """Trains an evaluator as one compiled program.

    `sample_batch(key, data) -> Pairs` is traced. The source's optimizer, by default, is
    Adam at 1e-4, gradients clipped to 0.5 (here of all parts together, there of each
    encoder). With the moving average of the parameters come losses by step.
    """
    key_init, key_train = jax.random.split(key)
    if optimizer is None:
        optimizer = training.make_optimizer(
            "adamw",
            learning_rate=1e-4,
            num_steps=num_steps,
            final_fraction=1.0,
            max_norm=0.5,
        )
    loss = functools.partial(matcher_loss, config=config)
    update = training.make_update(loss, optimizer, ema_decay=0.99)
    run = training.train_chunk(update, sample_batch, num_steps=num_steps)
    state = training.init_train_state(init_matcher(key_init, config), optimizer)
    state, info = run(state, key_train, data)
    return state.ema_params, info


def word_vectors(words: Sequence[str]) -> Float[np.ndarray, "words 300"]:
    """Vectors that stand in for GloVe's: of norm 6, each in a direction of its own.

    GloVe's norms are within a factor of two of that. They tell words apart and nothing
    more: "run" is as far from "jog" as from "table". The numbers are a hash of the word
    (SHAKE-256), so they are the same everywhere, which NumPy does not promise of its
    generators.
    """
    size = 2 * WORD_SIZE
    digests = [hashlib.shake_256(word.encode()).digest(size) for word in words]
    numbers = np.frombuffer(b"".join(digests), "<u2").reshape(-1, WORD_SIZE)
    centered = (numbers.astype(np.float64) + 0.5) / 2**16 - 0.5
    norm = np.linalg.norm(centered, axis=-1, keepdims=True)
    return (_NORM * centered / norm).astype(np.float32)


def word_class(word: str, part_of_speech: str) -> str:
    """One of `TAGS`: that of a list of `SPECIAL_WORDS`, or else the part of speech.

    Parts of speech that have no class, such as CCONJ, are "OTHER".
    """
    for name, words in SPECIAL_WORDS.items():
        if word in words:
            return name
    return part_of_speech if part_of_speech in TAGS else "OTHER"


def encode_tokens(
    tokens: Sequence[str], vocabulary: Mapping[str, np.ndarray] | None = None
) -> tuple[Float[np.ndarray, "22 300"], Float[np.ndarray, "22 15"], int]:
    """A sentence as the evaluator reads it, between marks of start and end.

    Args:
      tokens: Words with their part of speech, "walk/VERB"; after 20 the rest is cut, as
        in the source. For their classes see `word_class`.
      vocabulary: Vectors of words, GloVe's for published weights; a word that it lacks
        is "unk/OTHER", as in the source. None for `word_vectors`.

    Word vectors and one-hot classes are zero after the sentence; its number of words
    includes both marks. `ValueError` if a token has no part of speech.
    """
    pairs = [("sos", "OTHER")]
    for token in tokens[:MAX_WORDS]:
        word, slash, tag = token.rpartition("/")
        if not slash:
            raise ValueError(f"token {token!r}, expected 'word/CLASS'")
        known = vocabulary is None or word in vocabulary
        pairs.append((word, word_class(word, tag)) if known else ("unk", "OTHER"))
    pairs.append(("eos", "OTHER"))
    words = [word for word, _ in pairs]
    vectors = np.zeros((MAX_WORDS + 2, WORD_SIZE), np.float32)
    if vocabulary is None:
        vectors[: len(words)] = word_vectors(words)
    else:
        vectors[: len(words)] = [vocabulary[word] for word in words]
    tags = np.zeros((MAX_WORDS + 2, len(TAGS)), np.float32)
    for row, (_, tag) in enumerate(pairs):
        tags[row, TAGS.index(tag)] = 1.0
    return vectors, tags, len(pairs)
