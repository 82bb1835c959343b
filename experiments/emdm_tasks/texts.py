"""Scores of motions made from texts."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from emdm_tasks.judge import Judge
from emdm_tasks.scores import ORDER
from jaxmotion.data.text_sampling import sample_text_batch, text_arrays
from jaxmotion.evaluation import columns, diversity, frechet
from jaxmotion.learning.fingerprint import fingerprint
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import text_evaluation as emdm_text_evaluation
from jaxmotion.systems.emdm import training as emdm_training

# Multimodality: sentences, motions of each, pairs of them.
_SENTENCES, _REPEATS, _PAIRS = 16, 8, 10
_SEEN = {"zeros": "zeros", "kept": "the model's output, as in the released evaluation"}


def make_judge(args: Any) -> Judge:
    """The evaluator of a run, and real motions' scores.

    Args:
      args: Of `emdm.py evaluate`.

    Returns:
      The judge.

    Raises:
      ValueError: if the run has other data, there are too few samples, or a
        recognizer of actions is given.
    """
    if args.evaluator is not None:
        raise ValueError(
            f"evaluator is {args.evaluator}, but {args.run} makes motions from texts: "
            "expected none, or --matcher"
        )
    if (args.matcher is None) != (args.glove is None):
        raise ValueError(
            f"matcher is {args.matcher} and glove is {args.glove}: published weights "
            "read GloVe's vectors, so give both, --glove the folder with "
            f"{', '.join(emdm_text_evaluation.GLOVE)}, or neither"
        )
    run = emdm_text.load_run(args.run)
    frames, number = run.config["frames"], args.samples // 32 * 32
    if number < 64:
        raise ValueError(f"samples is {args.samples}, expected at least 64")
    steps = 600 if args.evaluator_steps is None else args.evaluator_steps
    judge = (
        emdm_text_evaluation.published_evaluator(run, args.matcher, glove=args.glove)
        if args.matcher
        else emdm_text_evaluation.train_evaluator(
            run, frames=frames, num_steps=steps, seed=0
        )
    )
    arrays = {
        split: text_arrays(run.motions, split=split, max_frames=frames)
        for split in ("train", "test", "val")
        if run.motions.clips_of(split).size
    }
    draw = jax.jit(sample_text_batch, static_argnames="batch")
    embed = jax.jit(
        lambda x, frames, padding: emdm_text_evaluation.embed(
            run, judge, x, frames, padding=padding
        ),
        static_argnums=2,
    )
    score = {
        padding: emdm_text_evaluation.make_scorer(run, judge, padding=padding)
        for padding in {"zeros", args.padding}
    }

    def moments(split: str) -> frechet.Moments:
        key = jax.random.key(args.seed)
        x, length, _ = draw(key, arrays[split], batch=number)
        return frechet.moments(embed(x, length, "zeros"))

    references = {split: moments(split) for split in arrays}

    def score_real(split: str) -> dict:
        def once(key: Array) -> dict[str, Array]:
            key_draw, key_score = jax.random.split(key)
            x, length, caption = draw(key_draw, arrays[split], batch=number)
            return score["zeros"](key_score, x, length, caption, references[split])

        keys = jax.random.split(jax.random.key(args.seed + 7), args.replications)
        return columns.row([once(key) for key in keys], order=ORDER)

    vectors, index = jnp.asarray(run.vectors, jnp.float32), jnp.asarray(run.index)

    def conditions(caption: Array, length: Array) -> emdm_model.Condition:
        return emdm_model.Condition(
            vector=vectors[index[caption]],
            keep=jnp.ones(caption.shape, bool),
            mask=jnp.arange(frames)[None] < length[:, None],
        )

    scale = emdm_training.guidance_scale(args.scale, default=2.5)

    def score_split(key: Array, many, split: str) -> dict[str, Array]:
        key_draw, key_sample, key_score = jax.random.split(key, 3)
        _, length, caption = draw(key_draw, arrays[split], batch=number)
        x = many(key_sample, conditions(caption, length), scale)
        return score[args.padding](key_score, x, length, caption, references[split])

    def score_row(key: Array, many) -> dict[str, Array]:
        key_own, key_draw, key_sample, key_pairs, key_unseen = jax.random.split(key, 5)
        found = score_split(key_own, many, "test")
        _, length, caption = draw(key_draw, arrays["test"], batch=_SENTENCES)
        length, caption = (jnp.repeat(v, _REPEATS) for v in (length, caption))
        x = many(key_sample, conditions(caption, length), scale)
        features = embed(x, length, args.padding).reshape(_SENTENCES, _REPEATS, -1)
        found["multimodality"] = diversity.multimodality(
            key_pairs, features, num_pairs=_PAIRS
        )
        if "val" in arrays:
            unseen = score_split(key_unseen, many, "val")
            found["R-precision 3, unseen pairs"] = unseen["R-precision 3"]
        return found

    names = {
        "train": "real (training clips)",
        "test": "real (held-out clips)",
        "val": "real (unseen pairs)",
    }
    one = conditions(jnp.zeros(1, jnp.int32), jnp.full(1, frames))
    return Judge(
        real={names[split]: score_real(split) for split in arrays},
        score=score_row,
        scale=scale,
        one=jax.tree.map(lambda x: x[0], one),
        samples=number,
        describe={
            "fingerprint": fingerprint(judge.params),
            "origin": judge.name,
            "matcher": dataclasses.asdict(judge.config) | {"name": judge.name},
            "texts": f"{run.encoder.name}, {run.config['text_form']}",
            "padding": args.padding,
            "reference": f"{number} real motions of the same split",
        },
        notes=(
            "Beyond the end of generated motions the evaluator sees "
            f"{_SEEN[args.padding]}.",
        ),
    )
