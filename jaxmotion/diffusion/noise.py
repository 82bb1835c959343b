"""Noise as data: what a function draws from its key, taken out of it as an argument.

Samplers, plans and ticks take a key first, and all that they draw from it is normal
noise. This module cuts such a function in two, and leaves its code as it is:

    tape = draw_noise(sample, key, condition)          # sample's noise, in its order
    x = with_noise(sample)(tape, condition)            # what sample(key, condition) is

Two samplers that are given one tape are compared noise by noise, also with one that
knows no keys (another framework's, or a graph that has left JAX).

A tape has an array for each call of `jax.random.normal`, in the order of the code, and
a tuple for each loop that draws, whose arrays have the loop's steps as first axis.
`chain.sample` with a denoising-diffusion GAN draws `(x_T, (latents, noises))`.

Both are read off the traced function: an equation that makes keys of keys is left out,
one that makes normal noise of a key takes its row of the tape, and all others stay. So
keys may come from `split`, from `fold_in` with a loop's counter, and reach into `jit`
and `scan`; that is how this library uses them.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core
from jaxtyping import PyTree

from jaxmotion.typing import Key

Tape = PyTree  # nested tuples of arrays

# Stands for what depends on more than keys and counters.
_UNKNOWN = object()
# The name of what `jax.random.normal` compiles.
_NORMAL = "_normal"


def draw_noise(function: Callable[..., Any], key: Key, *args: Any) -> Tape:
    """The standard normal noise that `function(key, *args)` draws, as a tape.

    Only the shapes of the arguments matter, and may stand for them.

    `ValueError` if the function draws something else than normal noise, or its keys
    depend on its data.
    """
    return jax.jit(_drawer(_trace(function, args)[0]))(key)


def with_noise(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of its noise instead of its key, which it takes first.

    `(tape, *args)` gives what `function(key, *args)` gives where the tape is
    `draw_noise(function, key, *args)`. It raises `ValueError` where that does, and for
    a tape of other shapes.
    """

    def run(tape: Tape, *args: Any) -> Any:
        traced, result = _trace(function, args)
        _check(tape, jax.eval_shape(_drawer(traced), _key()))
        values = [None, *jax.tree.leaves(args)]
        return jax.tree.unflatten(result, _run(traced, values, iter(tape)))

    return run


def _trace(function: Callable, args: tuple) -> tuple[core.ClosedJaxpr, Any]:
    """The traced function, and the structure of its result."""
    structures = []

    def flat(key: Key, *args: Any) -> list:
        leaves, structure = jax.tree.flatten(function(key, *args))
        structures.append(structure)
        return leaves

    return jax.make_jaxpr(flat)(_key(), *args), structures[0]


def _key() -> jax.ShapeDtypeStruct:
    return jax.eval_shape(lambda: jax.random.key(0))


def _drawer(traced: core.ClosedJaxpr) -> Callable[[Key], Tape]:
    """What draws the noise of a function whose first argument is its key."""
    others = [_UNKNOWN] * (len(traced.jaxpr.invars) - 1)
    return lambda key: _draw(traced, [key, *others])[1]


def _check(tape: Tape, expected: Tape) -> None:
    shapes = lambda tree: jax.tree.map(lambda x: tuple(x.shape), tree)  # noqa: E731
    if shapes(tape) != shapes(expected):
        raise ValueError(
            f"the tape has arrays of shapes {shapes(tape)}, expected {shapes(expected)}"
        )


def _is_key(value: Any) -> bool:
    return jnp.issubdtype(value.aval.dtype, jax.dtypes.prng_key)


def one_equation(eqn: core.JaxprEqn, jaxpr: core.Jaxpr, values: list) -> list:
    """The results of one equation of a traced function."""
    known = [not isinstance(x, core.Literal) for x in eqn.invars]
    free = [x for x, yes in zip(eqn.invars, known, strict=True) if yes]
    alone = jaxpr.replace(
        constvars=[],
        invars=free,
        outvars=eqn.outvars,
        eqns=[eqn],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    given = [x for x, yes in zip(values, known, strict=True) if yes]
    return core.jaxpr_as_fun(core.ClosedJaxpr(alone, ()))(*given)


def _draw(traced: core.ClosedJaxpr, values: list) -> tuple[list, Tape]:
    """Results that are known from keys and counters, and the noise on the way."""
    jaxpr, tape = traced.jaxpr, []
    consts = [
        x if _is_key(var) else _UNKNOWN
        for var, x in zip(jaxpr.constvars, traced.consts, strict=True)
    ]
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *values], strict=True))
    read = lambda x: x.val if isinstance(x, core.Literal) else env[x]  # noqa: E731
    for eqn in jaxpr.eqns:
        given, found = [read(x) for x in eqn.invars], [_UNKNOWN] * len(eqn.outvars)
        known = not any(x is _UNKNOWN for x in given)
        match _role(eqn):
            case "plain":
                found = one_equation(eqn, jaxpr, given) if known else found
            case "normal":
                tape += one_equation(eqn, jaxpr, given)
            case "keys":
                if not known:
                    raise ValueError("a key depends on data: expected counters alone")
                found = one_equation(eqn, jaxpr, given)
            case "call":
                found, more = _draw(eqn.params["jaxpr"], given)
                tape += more
            case "loop":
                consts, carry, xs = loop_parts(eqn, given)

                def body(_: None, xs: list, eqn=eqn, consts=consts, carry=carry):
                    rows = [_UNKNOWN if x is None else x for x in xs]
                    values = [*consts, *[_UNKNOWN] * len(carry), *rows]
                    return None, _draw(eqn.params["jaxpr"], values)[1]

                rows = [None if x is _UNKNOWN else x for x in xs]
                tape.append(jax.lax.scan(body, None, rows, **_order(eqn))[1])
        env.update(zip(eqn.outvars, found, strict=True))
    return [read(x) for x in jaxpr.outvars], tuple(tape)


def _run(traced: core.ClosedJaxpr, values: list, tape: Iterator) -> list:
    """The results, with noise from the tape; keys are None."""
    jaxpr = traced.jaxpr
    given = [*traced.consts, *values]
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], given, strict=True))
    read = lambda x: _array(x) if isinstance(x, core.Literal) else env[x]  # noqa: E731
    for eqn in jaxpr.eqns:
        given = [read(x) for x in eqn.invars]
        match _role(eqn):
            case "plain":
                found = one_equation(eqn, jaxpr, given)
            case "normal":
                found = [next(tape)]
            case "keys":
                found = [None] * len(eqn.outvars)
            case "call":
                found = _run(eqn.params["jaxpr"], given, tape)
            case "loop":
                consts, carry, xs = loop_parts(eqn, given)

                def body(carry: list, row: tuple, eqn=eqn, consts=consts):
                    xs, noise = row
                    values = [*consts, *carry, *xs]
                    found = _run(eqn.params["jaxpr"], values, iter(noise))
                    return found[: len(carry)], found[len(carry) :]

                rows = (xs, next(tape))
                last, ys = jax.lax.scan(body, carry, rows, **_order(eqn))
                found = [*last, *ys]
        env.update(zip(eqn.outvars, found, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _array(literal: core.Literal) -> jax.Array:
    return jnp.asarray(literal.val, literal.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]


def _role(eqn: core.JaxprEqn) -> str:
    """What becomes of an equation."""
    name = eqn.primitive.name
    if all(_is_key(x) for x in eqn.outvars):
        return "keys"
    if not any(_is_key(x) for x in eqn.invars):
        return "plain"
    if name == "jit":
        return "normal" if eqn.params["name"] == _NORMAL else "call"
    if name == "scan" and not any(map(_is_key, loop_parts(eqn, eqn.invars)[1])):
        return "loop"
    raise ValueError(
        f"a key goes into {name!r}: expected normal noise, split, fold_in, and loops "
        "that carry no key"
    )


def loop_parts(eqn: core.JaxprEqn, values: list) -> tuple[list, list, list]:
    """Constants, carry and rows of a loop's equation.

    Told by their ranks, as rows have an axis less within the loop: what a trace calls
    the numbers of them changes from one release of JAX to another.
    """

    def number(outer: list, inner: list) -> int:
        pairs = zip(outer, inner, strict=True)
        return sum(x.aval.ndim == y.aval.ndim for x, y in pairs)

    body = eqn.params["jaxpr"].jaxpr
    rows = number(eqn.invars, body.invars)
    first = rows - number(eqn.outvars, body.outvars)
    return values[:first], values[first:rows], values[rows:]


def _order(eqn: core.JaxprEqn) -> dict[str, Any]:
    return {name: eqn.params[name] for name in ("length", "reverse", "unroll")}
