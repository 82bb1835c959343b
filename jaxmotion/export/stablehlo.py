"""Graphs as StableHLO by `jax.export`: what any JAX, or another compiler, runs.

    call = jax.export.deserialize(Path("plan.stablehlo").read_bytes()).call
    outputs = call(*inputs)  # in the order of the JSON

Parameters are constants of the file; to load it takes JAX and `flatbuffers`, nothing of
this library.
"""

import importlib.util
from pathlib import Path

import jax
import jax.export

from jaxmotion import files
from jaxmotion.export.graph import ANY, Batch, Graph

SUFFIX = ".stablehlo"
# Where a file runs, whatever machine wrote it.
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def check() -> None:
    """Raises `ValueError` unless the package that `jax.export` needs is there."""
    if importlib.util.find_spec("flatbuffers") is None:
        raise ValueError(
            "files of StableHLO need flatbuffers, which is not installed: "
            'pip install -e ".[export]"'
        )


def write(path: Path, graph: Graph, *, batch: Batch = None) -> None:
    """Writes a graph as one file for all platforms, which holds its parameters too.

    As in `onnx.write`, the batch is None for one character, without an axis for it, a
    number of them, or `graph.ANY`. `ValueError` if the package is missing.
    """
    check()
    lead = () if batch is None else (batch,)
    if batch == ANY:
        lead = jax.export.symbolic_shape(ANY)
    run = graph.run if batch is None else jax.vmap(graph.run)
    structs = [port.struct(*lead) for port in graph.inputs]
    exported = jax.export.export(jax.jit(run), platforms=PLATFORMS)(*structs)
    with files.replacing(path) as file:
        file.write(exported.serialize())
