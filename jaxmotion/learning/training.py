"""Training as pure functions: state, update, and many updates in one compiled call.

Everything random in step s comes from `fold_in(key, s)`, and the step is part of the
state. So a run that stops and resumes draws what an uninterrupted one would have drawn.
"""

import dataclasses
import functools
import typing
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from jaxmotion.typing import Key, Params

Info = dict[str, Array]
Optimizer = optax.GradientTransformation


# Unchecked, because checkpointing maps a state to the same tree of other things.
@typing.no_type_check
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TrainState:
    """What a run needs to go on; `ema_params`, a moving average, is for evaluation."""

    step: Int[Array, ""]
    params: Params
    ema_params: Params
    opt_state: Any


# Of parameters, a key and a batch: the loss, and named values to report.
Loss = Callable[[Params, Key, Any], tuple[Float[Array, ""], Info]]
# One optimizer step, of a state, a key and a batch: the next state, and such values.
Update = Callable[[Any, Key, Any], tuple[Any, Info]]


def _adam(rate: optax.ScalarOrSchedule) -> Optimizer:
    return optax.adam(rate, b1=0.5, b2=0.9)


# Each of five steps: singular values of 0.0015 to 1 become 0.68 to 1.2.
_NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)


def orthogonalize(
    matrix: Float[Array, "rows columns"], coefficients: Float[Array, "steps 3"]
) -> Float[Array, "rows columns"]:
    """About the nearest matrix with orthonormal rows, or columns if it has fewer.

    Steps X <- a X + b A X + c A^2 X, with A = X X^T, of X with a Frobenius norm of 1.
    All P = a + b A + c A^2 commute with A: so A <- P A P on the shorter side, and only
    the product of all P meets X.

    Args:
      coefficients: a, b, c of each step.

    Source: Jordan et al. 2024, "Muon".
    """
    # By default GPUs round factors to ten bits. What that makes of eigenvalues near
    # zero grows twelvefold with each step, and would be half of the update.
    times = functools.partial(jnp.matmul, precision="highest")
    x = matrix / (jnp.linalg.norm(matrix) + 1e-8)
    wide = matrix.shape[0] <= matrix.shape[1]
    gram = times(x, x.T) if wide else times(x.T, x)
    one = product = jnp.eye(gram.shape[0], dtype=gram.dtype)
    for step, (a, b, c) in enumerate(coefficients):
        factor = a * one + b * gram + c * times(gram, gram)
        product = times(factor, product) if step else factor
        gram = times(factor, times(gram, factor))
    return times(product, x) if wide else times(x, product)


def _scale_by_muon(decay: float = 0.95) -> Optimizer:
    """Nesterov momentum of matrices, orthogonal and of the size of Adam's changes."""

    def init(params: Params) -> optax.contrib.MuonState:
        return optax.contrib.MuonState(
            count=jnp.zeros([], jnp.int32),
            mu=jax.tree.map(jnp.zeros_like, params),
            ns_coeffs=jnp.asarray(_NEWTON_SCHULZ),
        )

    def update(
        updates: Params, state: Any, params: Params | None = None
    ) -> tuple[Params, Any]:
        mu = jax.tree.map(lambda m, g: decay * m + (1 - decay) * g, state.mu, updates)
        # Both as means over all gradients so far.
        count = state.count + 1
        past, now = (
            weight / (1 - decay ** power.astype(jnp.float32))
            for weight, power in ((decay, count + 1), (1 - decay, count))
        )

        coefficients = jnp.tile(state.ns_coeffs, (5, 1))

        def move(m: Array, g: Array) -> Array:
            found = orthogonalize(past * m + now * g, coefficients)
            return 0.2 * max(m.shape) ** 0.5 * found

        return jax.tree.map(move, mu, updates), state._replace(count=count, mu=mu)

    return optax.GradientTransformation(init, update)


def _muon(rate: optax.ScalarOrSchedule) -> Optimizer:
    # optax.contrib.muon with consistent_rms=0.2, and its states, in half the time.
    none = optax.identity()
    return optax.partition(
        {
            "muon": optax.chain(
                _scale_by_muon(), none, none, optax.scale_by_learning_rate(rate)
            ),
            "adam": optax.adamw(rate, weight_decay=0.0, nesterov=True),
        },
        lambda params: jax.tree.map(
            lambda x: "muon" if x.ndim == 2 else "adam", params
        ),
    )


OptimizerName = Literal["muon", "adamw", "radam", "adam"]
# muon: matrices' updates orthogonal and scaled to the size of Adam's usual update, so
#   that one rate serves them and the rest, which Nadam updates. In none of the papers:
#   ours, for short runs (Jordan et al. 2024, "Muon"; the scale of 0.2 from Liu et al.
#   2025, "Muon is Scalable for LLM Training").
# adamw: CAMDM (its code: 1e-4, no weight decay, cosine to a tenth).
# radam: AAMDM (Liu et al. 2020; Li et al. 2024, section 4).
# adam: both networks of EMDM (its code: generator 2e-5, discriminator 1.25e-4).
OPTIMIZERS: dict[OptimizerName, Callable[..., Optimizer]] = {
    "muon": _muon,
    "adamw": functools.partial(optax.adamw, weight_decay=0.0),
    "radam": optax.radam,
    "adam": _adam,
}


def make_optimizer(
    name: OptimizerName,
    *,
    learning_rate: float,
    num_steps: int | None = None,
    warmup_steps: int = 0,
    final_fraction: float = 0.1,
    max_norm: float | None = None,
    **own: float,
) -> Optimizer:
    """An optimizer with linear warm-up and cosine decay, or at a constant rate.

    Args:
      learning_rate: Peak rate.
      num_steps: Steps of the whole run; the rate stays at its end value after them.
        None for a constant rate.
      warmup_steps: Steps of linear rise from 0, where the rate is not constant.
      final_fraction: Rate at the end of the decay as a fraction of the peak.
      max_norm: Clip the gradient to this global norm; None to leave it.
      **own: What that optimizer alone has, such as adamw's weight_decay.
    """
    rate: optax.ScalarOrSchedule = learning_rate
    if num_steps is not None:
        rate = optax.warmup_cosine_decay_schedule(
            init_value=0.0 if warmup_steps else learning_rate,
            peak_value=learning_rate,
            warmup_steps=warmup_steps,
            decay_steps=max(num_steps, warmup_steps + 1),
            end_value=learning_rate * final_fraction,
        )
    clip = [] if max_norm is None else [optax.clip_by_global_norm(max_norm)]
    return optax.chain(*clip, OPTIMIZERS[name](rate, **own))


def init_train_state(params: Params, optimizer: Optimizer) -> TrainState:
    """State before `make_update`'s first step; its EMA starts at the parameters."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        ema_params=jax.tree.map(jnp.copy, params),
        opt_state=optimizer.init(params),
    )


def make_update(
    loss: Loss, optimizer: Optimizer, *, ema_decay: float = 0.995
) -> Update:
    """Update of parameters and their moving average by one batch.

    The average warms up with decay min(ema_decay, (1 + step) / (10 + step)), so that
    the random initial parameters are soon forgotten.

    Args:
      loss: `(params, key, batch) -> (loss, info)`.
      ema_decay: Decay of the average a step, in [0, 1).

    Returns:
      `update(state, key, batch) -> (state, info)`; info has "loss", what the loss
      reports, and the gradient's global norm.
    """

    def update(state: TrainState, key: Key, batch: Any) -> tuple[TrainState, Info]:
        grad_fn = jax.value_and_grad(loss, has_aux=True)
        (value, info), grads = grad_fn(state.params, key, batch)
        changes, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, changes)
        count = state.step.astype(jnp.float32)
        decay = jnp.minimum(ema_decay, (1.0 + count) / (10.0 + count))
        ema_params = jax.tree.map(
            lambda old, new: old + (1.0 - decay) * (new - old), state.ema_params, params
        )
        squares = [jnp.vdot(grad, grad) for grad in jax.tree.leaves(grads)]
        info = {"loss": value, **info, "grad_norm": jnp.sqrt(sum(squares))}
        return TrainState(
            step=state.step + 1,
            params=params,
            ema_params=ema_params,
            opt_state=opt_state,
        ), info

    return update


def train_chunk(
    update: Update,
    sample_batch: Callable[[Key, Any], Any],
    *,
    num_steps: int,
    mesh: Mesh | None = None,
) -> Callable[..., tuple[Any, Info]]:
    """Many updates as one compiled program.

    Args:
      update: From `make_update` or `adversarial.make_gan_update`; its state has the
        number of updates made as `step`.
      sample_batch: `(key, data) -> batch`; leaves of the batch have the batch axis
        first.
      mesh: Split each batch over the mesh's first axis; state and data are
        replicated (`replicate`). The result is that of one device up to rounding.

    Returns:
      `run(state, key, data, count=None) -> (state, info)`, jitted; the given state is
      donated (its buffers are gone afterwards). Each value of info has num_steps rows,
      one a step. With a count (traced: no second compilation for another) only so many
      updates are made, and the rows after them are zero.
    """

    def run(
        state: Any, key: Key, data: Any, count: int | Array | None = None
    ) -> tuple[Any, Info]:
        def one(state: Any, _) -> tuple[Any, Info]:
            key_batch, key_loss = jax.random.split(jax.random.fold_in(key, state.step))
            batch = sample_batch(key_batch, data)
            if mesh is not None:
                split = _sharding(mesh, mesh.axis_names[0])
                batch = jax.lax.with_sharding_constraint(batch, split)
            return update(state, key_loss, batch)

        if count is None:
            return jax.lax.scan(one, state, None, length=num_steps)
        row = jax.eval_shape(one, state, None)[1]
        rows = jax.tree.map(lambda x: jnp.zeros((num_steps, *x.shape), x.dtype), row)

        def write(i: Array, carry: tuple[Any, Info]) -> tuple[Any, Info]:
            state, rows = carry
            state, info = one(state, None)
            return state, jax.tree.map(lambda x, y: x.at[i].set(y), rows, info)

        return jax.lax.fori_loop(0, count, write, (state, rows))

    return jax.jit(run, donate_argnums=0)


def _sharding(mesh: Mesh, *axes: str) -> NamedSharding:
    # The compiler places what is in between, so all axes are automatic (those of
    # jax.make_mesh are explicit).
    return NamedSharding(Mesh(mesh.devices, mesh.axis_names), PartitionSpec(*axes))


def replicate(tree: Any, mesh: Mesh | None) -> Any:
    """Puts a whole copy of each array on every device of a mesh; without one, nothing.

    In a run of several processes each has the same values.
    """
    if mesh is None:
        return tree
    return jax.device_put(tree, _sharding(mesh))
