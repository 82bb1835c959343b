"""Graphs as ONNX files: what game engines and onnxruntime run without Python or JAX.

A graph is converted for one character. For several it becomes the body of ONNX's own
loop over the first axis, "Scan", so that one file takes any number of them and gives
each exactly what it gives one; they run one after the other.
"""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from jaxmotion import files
from jaxmotion.diffusion.noise import loop_parts, one_equation
from jaxmotion.export.graph import Batch, Graph, Port

SUFFIX = ".onnx"
# Of operations; nothing newer is used, and older runtimes, which are smaller, read it.
OPSET = 21
# What becomes of a row and what comes to it.
_CHANGES = {
    "scatter": lambda old, new: new,
    "scatter-add": jnp.add,
    "scatter-max": jnp.maximum,
}
_MISSING = (
    'files of ONNX need packages that are not installed: pip install -e ".[export]"'
)


def check() -> None:
    """Raises `ValueError` unless the packages of the extra are there."""
    try:
        import jax2onnx  # noqa: F401
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise ValueError(f"{_MISSING} ({error})") from None


def write(path: Path, graph: Graph, *, batch: Batch = None) -> None:
    """Writes a graph as one file, which holds its parameters too.

    It is checked and run once with zeros before it is written, so a file that is there
    runs; an older one stays until then.

    Args:
      batch: None for one character, without an axis for it; a number of them, or
        `graph.ANY`, for a first axis of all arrays.

    Raises:
      OSError: if the file cannot be written.
      ValueError: if packages of the extra are missing, or the function has no ONNX form
        that runs; says which operation.
    """
    made = content(graph, batch=batch)
    with files.replacing(path) as file:
        file.write(made)


def content(graph: Graph, *, batch: Batch = None) -> bytes:
    """What `write` writes, with its arguments and errors of the same kinds."""
    check()
    import onnx

    model = _converted(graph, inner=batch is not None)
    if batch is not None:
        model = _over_characters(model, graph, batch)
    model.producer_name = "jaxmotion"
    onnx.checker.check_model(model, full_check=True)
    _try(model, graph, batch)
    return model.SerializeToString()


def open_session(model: bytes, *, threads: int = 0) -> Any:
    """An `onnxruntime.InferenceSession` of a file's content.

    Args:
      threads: Threads of one operation; 0 leaves their number to onnxruntime. They do
        not wait for more work between calls, as that takes cores from other work.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.force_spinning_stop", "1")
    return onnxruntime.InferenceSession(model, options)


def _try(model: Any, graph: Graph, batch: Batch) -> None:
    """Runs a model once: the checker takes shapes that do not fit for right."""
    lead = () if batch is None else (batch if isinstance(batch, int) else 2,)
    zeros = {x.name: np.zeros((*lead, *x.shape), x.dtype) for x in graph.inputs}
    try:
        session = open_session(model.SerializeToString())
        session.run(None, {x.name: zeros[x.name] for x in session.get_inputs()})
    except Exception as error:  # of onnxruntime, which has many kinds
        reason = str(error).strip().split("\n")[0]
        raise ValueError(f"{graph.name!r} does not run as ONNX: {reason}") from error


def _converted(graph: Graph, *, inner: bool) -> Any:
    """A model of one character; as a body of a loop its names must be its own."""
    from jax2onnx import to_onnx
    from onnx import helper

    own = "one." if inner else ""
    structs = [port.struct() for port in graph.inputs]
    # Before the converter sees it: it puts its own operations in the place of layers,
    # and their gradients are others.
    traced = jax.make_jaxpr(graph.run)(*structs)
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with _newest_first():
            model = to_onnx(
                lambda *arrays: _forward(traced, list(arrays)),
                structs,
                model_name=graph.name,
                opset=OPSET,
                input_names=[own + port.name for port in graph.inputs],
            )
    except Exception as error:  # whatever the converter raises for what it lacks
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise ValueError(f"{graph.name!r} has no form in ONNX: {reason}") from error
    finally:
        logging.disable(level)
    # Copies: one value may come out twice, or be an input that comes out as it was.
    for value, port in zip(model.graph.output, graph.outputs, strict=True):
        name = own + port.name
        model.graph.node.append(helper.make_node("Identity", [value.name], [name]))
        value.name = name
    _prune(model.graph)
    return model


@contextlib.contextmanager
def _newest_first() -> Iterator[None]:
    """Lets the converter find a value where it was just made.

    It asks of each value, several times, whether some node gives it, and looks through
    all constants and nodes from the oldest on: most of its time where there are
    thousands. Another release of it, which has no such function, is left alone.
    """
    from jax2onnx.converter import output_binding

    name = "_value_is_graph_connected"
    slow = getattr(output_binding, name, None)
    if slow is None:
        yield
        return

    def found(context: Any, value: Any) -> bool:
        nodes = context.builder.nodes
        newest = (nodes[-i] for i in range(1, min(len(nodes), 64) + 1))
        return any(given is value for node in newest for given in node.outputs) or slow(
            context, value
        )

    setattr(output_binding, name, found)
    try:
        yield
    finally:
        setattr(output_binding, name, slow)


def _aval(atom: Any) -> Any:
    """Shape and type of a variable: all that is traced here are arrays."""
    return atom.aval


def _is_lost(eqn: core.JaxprEqn) -> bool:
    """Whether the converter gets an equation wrong; gradients are full of such.

    Of loops it ignores that they run backward, of products of two matrices that the
    first one is turned. What it makes of a choice between truth values does not run,
    and a slice that would reach beyond the end becomes shorter instead of moving back.
    Of what `vmap` makes it knows no rows of another axis than the first one, and no
    batch of a product that is not in front.
    """
    if eqn.primitive.name == "dynamic_slice":
        return True
    if eqn.primitive.name == "gather":
        numbers = eqn.params["dimension_numbers"]
        return numbers.start_index_map != (0,) or bool(numbers.operand_batching_dims)
    if eqn.primitive.name in _CHANGES:
        numbers = eqn.params["dimension_numbers"]
        axes = numbers.scatter_dims_to_operand_dims
        return axes != (0,) and axes == numbers.inserted_window_dims and len(axes) == 1
    if eqn.primitive.name == "select_n":
        return _aval(eqn.invars[1]).dtype == bool and len(eqn.invars) == 3
    if eqn.primitive.name == "dot_general":
        (first, _), batch = eqn.params["dimension_numbers"]
        if any(axes != tuple(range(len(axes))) for axes in batch):
            return True
        return batch == ((), ()) and _aval(eqn.invars[0]).ndim == 2 and first == (0,)
    return eqn.primitive.name == "scan" and eqn.params["reverse"]


def _loses(traced: core.ClosedJaxpr) -> bool:
    return any(
        _is_lost(eqn)
        or (eqn.primitive.name in ("jit", "scan") and _loses(eqn.params["jaxpr"]))
        for eqn in traced.jaxpr.eqns
    )


def _forward(traced: core.ClosedJaxpr, values: list) -> list:
    """The results, without what the converter gets wrong.

    Loops that run backward run forward over turned rows; matrices are turned before
    their product; truth values are chosen by logic; slices stay within their arrays.
    """
    if not _loses(traced):
        return core.jaxpr_as_fun(traced)(*values)
    jaxpr, given = traced.jaxpr, [*traced.consts, *values]
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], given, strict=True))
    read = lambda x: x.val if isinstance(x, core.Literal) else env[x]  # noqa: E731
    for eqn in jaxpr.eqns:
        given, inner = [read(x) for x in eqn.invars], eqn.params.get("jaxpr")
        if eqn.primitive.name == "jit":
            found = _forward(inner, given)
        elif eqn.primitive.name == "scan":
            found = _scan(eqn, *loop_parts(eqn, given))
        elif eqn.primitive.name == "select_n" and _is_lost(eqn):
            which, no, yes = (jnp.asarray(x) for x in given)
            found = [(which & yes) | (~which & no)]
        elif eqn.primitive.name == "dynamic_slice":
            found = [_within(eqn, *given)]
        elif eqn.primitive.name == "gather" and _is_lost(eqn):
            found = [_gather(eqn, *given)]
        elif eqn.primitive.name in _CHANGES and _is_lost(eqn):
            found = [_scatter(eqn, *given)]
        elif _is_lost(eqn):
            found = [_product(eqn, *given)]
        else:
            found = one_equation(eqn, jaxpr, given)
        env.update(zip(eqn.outvars, found, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _within(eqn: core.JaxprEqn, values: Any, *starts: Any) -> Any:
    """A slice whose starts are kept within the array, as JAX says, one by one."""
    sizes = eqn.params["slice_sizes"]
    kept = [
        jnp.clip(start, 0, whole - size) if size < whole else jnp.zeros_like(start)
        for start, whole, size in zip(starts, values.shape, sizes, strict=True)
    ]
    return jax.lax.dynamic_slice(values, kept, sizes)


def _product(eqn: core.JaxprEqn, first: Any, second: Any) -> Any:
    """A product with the axes of a batch in front, and what is summed next to it."""
    summed, batch = eqn.params["dimension_numbers"]
    number, ends = len(batch[0]), len(batch[0]) + len(summed[0])

    def free(values: Any, side: int) -> list[int]:
        return [i for i in range(values.ndim) if i not in (*summed[side], *batch[side])]

    first = first.transpose(*batch[0], *free(first, 0), *summed[0])
    second = second.transpose(*batch[1], *summed[1], *free(second, 1))
    axes = tuple(range(first.ndim - len(summed[0]), first.ndim))
    front = tuple(range(number))
    numbers = ((axes, tuple(range(number, ends))), (front, front))
    return eqn.primitive.bind(
        first, second, **eqn.params | {"dimension_numbers": numbers}
    )


def _gather(eqn: core.JaxprEqn, values: Any, starts: Any) -> Any:
    """Windows of an array, as elements of a flat one: a single axis of indices."""
    numbers, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    out, found = _aval(eqn.outvars[0]).shape, jnp.int32(0)
    outer = [i for i in range(len(out)) if i not in numbers.offset_dims]
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [k for k in range(values.ndim) if k not in gone]
    inner = dict(zip(kept, numbers.offset_dims, strict=True))
    for k, (whole, size) in enumerate(zip(values.shape, sizes, strict=True)):
        found = found * whole
        if k in numbers.start_index_map:
            start = starts[..., numbers.start_index_map.index(k)]
            start = jnp.clip(start.astype(jnp.int32), 0, whole - size)
            found = found + jax.lax.broadcast_in_dim(start, out, outer)
        if k in numbers.operand_batching_dims:
            place = numbers.operand_batching_dims.index(k)
            axis = outer[numbers.start_indices_batching_dims[place]]
            found = found + jax.lax.broadcasted_iota(jnp.int32, out, axis)
        if k in inner:
            found = found + jax.lax.broadcasted_iota(jnp.int32, out, inner[k])
    return jnp.take(values.reshape(-1), found, mode="clip")


def _scatter(eqn: core.JaxprEqn, values: Any, index: Any, updates: Any) -> Any:
    """Changes of rows one after the other, each where a mask of their axis says.

    In loops the converter takes the number of changes for that of the loop's steps.
    """
    numbers, change = eqn.params["dimension_numbers"], _CHANGES[eqn.primitive.name]
    (axis,), window = numbers.scatter_dims_to_operand_dims, numbers.update_window_dims
    outer = [i for i in range(updates.ndim) if i not in window]
    rest = [size for i, size in enumerate(values.shape) if i != axis]
    rows = updates.transpose(*outer, *window).reshape(-1, *rest)
    place = jnp.arange(values.shape[axis]).reshape(-1, *[1] * (values.ndim - axis - 1))
    for at, row in zip(index.reshape(-1), rows, strict=True):
        changed = change(values, jnp.expand_dims(row, axis))
        values = jnp.where(place == at, changed, values)
    return values


def _scan(eqn: core.JaxprEqn, consts: list, carry: list, rows: list) -> list:
    def body(carry: list, row: list) -> tuple[list, list]:
        found = _forward(eqn.params["jaxpr"], [*consts, *carry, *row])
        return found[: len(carry)], found[len(carry) :]

    turn = lambda rows: [jnp.flip(x, 0) for x in rows]  # noqa: E731
    turned = turn(rows) if eqn.params["reverse"] else rows
    last, found = jax.lax.scan(body, carry, turned, length=eqn.params["length"])
    return [*last, *(turn(found) if eqn.params["reverse"] else found)]


def _prune(body: Any) -> set[str]:
    """Takes out constants that nothing reads, and shapes within.

    The converter states some of them wrong, and runtimes infer all. Returns the names
    that are read.
    """
    del body.value_info[:]
    read = {value.name for value in body.output}
    for node in body.node:
        read.update(node.input)
        for attribute in node.attribute:
            if attribute.HasField("g"):
                read |= _prune(attribute.g)
    kept = [constant for constant in body.initializer if constant.name in read]
    del body.initializer[:]
    body.initializer.extend(kept)
    return read


def _over_characters(model: Any, graph: Graph, batch: int | str) -> Any:
    """The model as the body of a loop over the first axis of all its arrays."""
    from onnx import TensorProto, helper

    body = model.graph
    parameters = list(body.initializer)
    del body.initializer[:]

    def value(port: Port) -> Any:
        kind = dict(bool=TensorProto.BOOL, int32=TensorProto.INT32).get(
            port.dtype, TensorProto.FLOAT
        )
        return helper.make_tensor_value_info(port.name, kind, [batch, *port.shape])

    loop = helper.make_node(
        "Scan",
        [port.name for port in graph.inputs],
        [port.name for port in graph.outputs],
        body=body,
        num_scan_inputs=len(graph.inputs),
    )
    outer = helper.make_graph(
        [loop],
        graph.name,
        [value(port) for port in graph.inputs],
        [value(port) for port in graph.outputs],
        parameters,
    )
    return helper.make_model(
        outer,
        opset_imports=model.opset_import,
        ir_version=model.ir_version,
        functions=model.functions,
    )
