"""What a student of few steps is taught: pairs of its predictions and their targets.

DDIM without noise makes the reverse chain a function: x_t determines the sample that
the chain ends in. That function, f(x_t, t), is the consistency function of the teacher
and its schedule; with f(x, 0) = x it is the same all along a chain,

    f(x_t, t) = f(ddim(x_t, t), t - 1)

A student that has learned f at step T makes a sample by one network call; at several
steps it may add noise to a prediction again and predict anew. Two ways to teach it:

    chain_pairs         f itself: the teacher's whole chain, t network calls
    consistency_pairs   one step of the teacher, then the student's own prediction

The first has the exact target and no bootstrap; the second takes one call of the
teacher whatever T is, and an error at step t is handed on to all steps above.

Functions here are of one sample and take callables: not jitted, for `vmap`.

Source: Luhman & Luhman 2021, "Knowledge Distillation in Iterative Generative Models"
(the chain); Song et al. 2023, "Consistency Models", alg. 2, on the grid of the
teacher's schedule. Differs: the target is the student's own, without a moving average,
as Song & Dhariwal 2023 recommend.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.diffusion import chain
from jaxmotion.diffusion import schedule as _schedule
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.typing import Denoiser, Key

# Predictions of the student, and what they should be; steps first.
Pairs = tuple[Float[Array, "steps *shape"], Float[Array, "steps *shape"]]


def chain_pairs(
    key: Key,
    x_0: Float[Array, "*shape"],
    *,
    table: Schedule,
    student: Denoiser,
    teacher: Denoiser,
    steps: tuple[int, ...],
) -> Pairs:
    """The student's predictions at some steps, and where the teacher's chain ends.

    The steps, in 1..T, are static; the teacher is called once per step of each chain.
    No gradient flows through the targets.
    """
    solve = chain.ddim_step(table, teacher)

    def pair(key: Key, start: int) -> tuple[Array, Array]:
        key_noise, key_student, key_teacher = jax.random.split(key, 3)
        noise, t = jax.random.normal(key_noise, x_0.shape), jnp.asarray(start)
        x_t = _schedule.q_sample(table, x_0, t, noise)
        end = chain.sample_from(solve, key_teacher, x_t, start=start)
        return student(key_student, x_t, t), jax.lax.stop_gradient(end)

    keys = jax.random.split(key, len(steps))
    pairs = [pair(one, start) for one, start in zip(keys, steps, strict=True)]
    predictions, targets = zip(*pairs, strict=True)
    return jnp.stack(predictions), jnp.stack(targets)


def consistency_pairs(
    key: Key,
    x_0: Float[Array, "*shape"],
    *,
    table: Schedule,
    student: Denoiser,
    teacher: Denoiser,
    number: int,
) -> Pairs:
    """The student's predictions at random steps, and its own one step further on.

    At t = 1 the target is the teacher's prediction, which is called once per pair. Each
    of the pairs is of a step uniform in 1..T, and they are spread evenly. No gradient
    flows through the targets.
    """
    solve, total = chain.ddim_step(table, teacher), table.num_steps
    key_step, key_pairs = jax.random.split(key)
    first = jax.random.randint(key_step, (), 0, total)
    steps = 1 + (first + jnp.arange(number) * total // number) % total

    def pair(key: Key, t: Array) -> tuple[Array, Array]:
        key_noise, key_student, key_teacher, key_own = jax.random.split(key, 4)
        noise = jax.random.normal(key_noise, x_0.shape)
        x_t = _schedule.q_sample(table, x_0, t, noise)
        x_prev = solve(key_teacher, x_t, t)
        own = student(key_own, x_prev, jnp.maximum(t - 1, 1))
        target = jnp.where(t > 1, own, x_prev)
        return student(key_student, x_t, t), jax.lax.stop_gradient(target)

    return jax.vmap(pair)(jax.random.split(key_pairs, number), steps)
