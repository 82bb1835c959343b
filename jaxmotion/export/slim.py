"""ONNX files made small, as onnxruntime-web takes them: few nodes, shared weights.

A model is folded by native onnxruntime, so that the browser's need not do it; the
shapes of inner values, of which the converter writes wrong ones that the browser's
runtime refuses, go; and large constants move to a file that all graphs of a character
share, packed as 16-bit floats where those are the same numbers.
"""

import hashlib
import itertools
import tempfile
from collections.abc import Iterator, Set
from pathlib import Path
from typing import Any

import numpy as np

# Smaller constants stay in the graph.
LEAST_BYTES = 1024


class Weights:
    """Constants that several graphs share; each is kept once.

    They are packed as two files: the others followed by the upper bytes of all 16-bit
    floats, whose signs and exponents repeat themselves, and the lower bytes, which are
    almost noise.

    Attributes:
      name: Name of the file, by which the graphs refer to it.
      parts: In the order of the file that the graphs refer to: whether it is packed as
        16-bit floats, which are 32-bit ones there, and its bytes as it is packed.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.parts: list[tuple[bool, int]] = []
        self._whole, self._others = bytearray(), bytearray()
        self._halves: list[np.ndarray] = []
        self._places: dict[bytes, int] = {}

    def add(self, values: np.ndarray, *, half: bool) -> tuple[int, int]:
        """Where a constant begins in the file, and its length there, bytes.

        Half packs it as 16-bit floats; its values there are those, widened.
        """
        small = values.astype(np.float16) if half else values
        raw = np.ascontiguousarray(small.astype(values.dtype)).tobytes()
        digest = hashlib.sha256(raw).digest()
        if digest not in self._places:
            self._places[digest] = len(self._whole)
            self._whole += raw + b"\0" * (-len(raw) % 4)
            packed = np.ascontiguousarray(small).tobytes()
            if half:
                self._halves.append(np.frombuffer(packed, np.uint8).reshape(-1, 2))
            else:
                packed += b"\0" * (-len(packed) % 4)
                self._others += packed
            self.parts.append((half, len(packed)))
        return self._places[digest], len(raw)

    def content(self) -> bytes:
        """The file that the graphs refer to."""
        return bytes(self._whole)

    def packed(self) -> tuple[bytes, bytes]:
        """The two files that are written; `parts` say how to unpack them."""
        planes = np.concatenate([np.zeros((0, 2), np.uint8), *self._halves])
        return bytes(self._others) + planes[:, 1].tobytes(), planes[:, 0].tobytes()


def slim(model: bytes, weights: Weights, *, half: bool = False) -> bytes:
    """A model's content with fewer nodes, and its large constants in `weights`.

    Half rounds all large constants to 16-bit floats, not only those that are such.
    """
    import onnx

    found = onnx.load_model_from_string(_folded(model))
    _clean(found.graph)
    graph = found.graph
    kept = {x.name for x in (*graph.input, *graph.output)}
    _rename(graph, {name: name for name in kept}, itertools.count(), kept)
    for tensor in found.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.nbytes >= LEAST_BYTES:
            fits = values.dtype == np.float32 and (half or _is_half(values))
            _refer(tensor, weights.name, *weights.add(values, half=fits))
    return found.SerializeToString()


def _folded(model: bytes) -> bytes:
    """The model as onnxruntime has it after its basic optimizations."""
    import onnxruntime

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "folded.onnx"
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        options.graph_optimization_level = (
            onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        )
        options.optimized_model_filepath = str(path)
        onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        return path.read_bytes()


def _clean(graph: Any) -> None:
    """Takes out the shapes of inner values and what is for people, also in loops."""
    del graph.value_info[:]
    graph.doc_string = ""
    for node in graph.node:
        node.name = node.doc_string = ""
        del node.metadata_props[:]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _clean(attribute.g)


def _rename(
    graph: Any,
    names: dict[str, str],
    numbers: Iterator[int],
    kept: Set[str] = frozenset(),
) -> None:
    """Gives each value a short name that no other value has, also in bodies of loops.

    A body may hide names of the graph around it, but the browser's runtime refuses it.

    Args:
      names: New names of the values that the graphs around it have.
      kept: Names that stay.
    """
    own = [x.name for x in (*graph.input, *graph.initializer)]
    own += [name for node in graph.node for name in node.output if name]
    names = names | {x: str(next(numbers)) for x in own if x not in kept}
    for value in (*graph.input, *graph.output, *graph.initializer):
        value.name = names[value.name]
    for node in graph.node:
        for field in (node.input, node.output):
            field[:] = [names[x] if x else "" for x in field]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _rename(attribute.g, names, numbers)


def _is_half(values: np.ndarray) -> bool:
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float16).astype(np.float32) == values).all())


def _refer(tensor: Any, file: str, offset: int, length: int) -> None:
    """Makes a constant a place in another file."""
    import onnx

    tensor.ClearField("raw_data")
    for field in ("float_data", "int32_data", "int64_data", "double_data"):
        tensor.ClearField(field)
    tensor.data_location = onnx.TensorProto.EXTERNAL
    del tensor.external_data[:]
    for key, value in (("location", file), ("offset", offset), ("length", length)):
        tensor.external_data.add(key=key, value=str(value))
