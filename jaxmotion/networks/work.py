"""What a program asks of its networks, counted from its trace.

The compiler's own count (`compiled.cost_analysis()`) takes the body of a loop once,
however often it runs: a sampler of eight steps would seem to cost as much as one of a
single step. Here a loop counts as often as it runs, before the compiler removes
anything.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
from flax import linen as nn
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Jaxpr, jaxprs_in_params

_MARK = "network call:"


@dataclasses.dataclass(frozen=True)
class Work:
    """Work of one run of a program.

    Attributes:
      network_calls: Predictions of a network, those of a batch one by one: guidance
        by a null condition doubles them. Encoding a condition once is no call.
      flops: Multiplications and additions of matrix products and convolutions; a
        product of m x k by k x n counts 2 m k n.
    """

    network_calls: int
    flops: int


def count(function: Callable, *arguments: Any) -> Work:
    """Counts the work of a function by tracing it; nothing is compiled or run.

    The function must not have been traced before with arguments of these shapes if it
    is jitted: JAX would take the old trace, in which no call is marked.

    `ValueError` if there is work in a loop whose length the trace does not know.
    """
    depth = 0

    def mark(call: Callable, given: tuple, options: dict, context: Any) -> Any:
        nonlocal depth
        depth += 1
        try:
            out = call(*given, **options)
        finally:
            depth -= 1
        if depth or context.method_name not in ("__call__", "denoise"):
            return out
        # Under vmap the marked array grows by the batch, and this size does not.
        return checkpoint_name(out, f"{_MARK}{out.size}")

    with nn.intercept_methods(mark):
        traced = jax.make_jaxpr(function)(*arguments)
    return Work(*_work(traced.jaxpr))


def _aval(atom: Any) -> Any:
    """Shape and type of a variable: all that is traced here are arrays."""
    return atom.aval


def _work(jaxpr: Jaxpr) -> tuple[int, int]:
    calls = flops = 0
    for equation in jaxpr.eqns:
        name, given = equation.primitive.name, equation.params
        if name == "name" and given["name"].startswith(_MARK):
            one = int(given["name"].removeprefix(_MARK))
            calls += _aval(equation.outvars[0]).size // one
        elif name == "dot_general":
            (contracted, _), _ = given["dimension_numbers"]
            left, out = _aval(equation.invars[0]).shape, _aval(equation.outvars[0]).size
            flops += 2 * out * math.prod(left[i] for i in contracted)
        elif name == "conv_general_dilated":
            kernel = _aval(equation.invars[1])
            channels = kernel.shape[given["dimension_numbers"].rhs_spec[0]]
            out = _aval(equation.outvars[0]).size
            flops += 2 * out * kernel.size // channels
        inner = [_work(part) for part in jaxprs_in_params(given)]
        if not inner:
            continue
        if name == "while" and any(map(any, inner)):
            raise ValueError("work in a while loop: its length is not in the trace")
        # Of the branches of a condition one runs: the larger.
        join = max if name == "cond" else sum
        times = given["length"] if name == "scan" else 1
        more = [times * join(part) for part in zip(*inner, strict=True)]
        calls, flops = calls + more[0], flops + more[1]
    return calls, flops
