"""Graphs as ONNX files: what game engines and onnxruntime run without Python or JAX.

A graph is converted for one character. For several it becomes the body of ONNX's own
loop over the first axis, "Scan", so that one file takes any number of them and gives
each exactly what it gives one; they run one after the other.
"""

import logging
from pathlib import Path
from typing import Any

from jaxmotion import files
from jaxmotion.export.graph import Batch, Graph, Port

SUFFIX = ".onnx"
_MISSING = (
    'files of ONNX need packages that are not installed: pip install -e ".[export]"'
)


def check() -> None:
    """Raises `ValueError` unless the packages of the extra are there."""
    try:
        import jax2onnx  # noqa: F401
        import onnx  # noqa: F401
    except ImportError as error:
        raise ValueError(f"{_MISSING} ({error})") from None


def write(path: Path, graph: Graph, *, batch: Batch = None) -> None:
    """Writes a graph, with its parameters in it.

    Args:
      path: The file.
      graph: The graph.
      batch: None for one character, without an axis for it; a number of them, or
        `graph.ANY`, for a first axis of all arrays.

    Raises:
      OSError: if the file cannot be written.
      ValueError: if packages are missing, or the function has no ONNX form.
    """
    check()
    import onnx

    model = _converted(graph, inner=batch is not None)
    if batch is not None:
        model = _over_characters(model, graph, batch)
    model.producer_name = "jaxmotion"
    onnx.checker.check_model(model)
    with files.replacing(path) as file:
        file.write(model.SerializeToString())


def _converted(graph: Graph, *, inner: bool) -> Any:
    """A model of one character; as a body of a loop its names must be its own."""
    from jax2onnx import to_onnx
    from onnx import helper

    own = "one." if inner else ""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        model = to_onnx(
            graph.run,
            [port.struct() for port in graph.inputs],
            model_name=graph.name,
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


def _prune(body: Any) -> set[str]:
    """Takes constants out that nothing reads; returns the names that are read."""
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
