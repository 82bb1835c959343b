"""Functions of trees as graphs: functions of named arrays, for other run-times.

A graph has no keys: what a function draws is an input (`diffusion.noise`), standard
normal noise that whoever calls it draws anew each time. Arrays are named after their
place in the tree: "state.plan.root_position", "noise.1.0". Results have "out." before
the name, since a graph's input and output may not share one: the array that comes out
as "out.state.cursor" is the next call's "state.cursor".
"""

import dataclasses
import functools
import inspect
import re
from collections.abc import Callable
from typing import Any

import jax

from jaxmotion.diffusion import noise
from jaxmotion.typing import Exported

OUT = "out."
Batch = int | str | None
# Axis of any number of characters, as `batch` and in the shapes of the JSON.
ANY = "any"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Port:
    """An array that goes into a graph or comes out of it; for one character.

    Attributes:
      dtype: Such as "float32".
      text: What it is and its unit, as the docstrings of its dataclasses say.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    text: str

    def struct(self, *lead: Any) -> jax.ShapeDtypeStruct:
        """Its shape and type, behind axes of a batch."""
        return jax.ShapeDtypeStruct((*lead, *self.shape), self.dtype)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Graph:
    """A function of arrays, for one character.

    `run` is `(*inputs) -> outputs`, arrays in the order of the ports.
    """

    name: str
    run: Callable[..., tuple]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]


def make(name: str, exported: Exported, arguments: dict[str, Any]) -> Graph:
    """The graph of a function.

    Where the function takes a "key", the graph takes "noise" (`ValueError` for any but
    normal noise). Arguments are the others by name, of one character; only shapes
    matter.
    """
    function, takes = exported.function, exported.takes
    given = {name: arguments[name] for name in takes if name != "key"}
    if takes[0] == "key":
        key = jax.eval_shape(lambda: jax.random.key(0))
        draw = functools.partial(noise.draw_noise, function)
        given = {"noise": jax.eval_shape(draw, key, *given.values())} | given
        function = noise.with_noise(function)
    tree = jax.tree.structure(tuple(given.values()))
    outputs = []

    def run(*arrays: Any) -> tuple:
        found = function(*jax.tree.unflatten(tree, arrays))
        found = (found,) if len(exported.gives) == 1 else found
        named = dict(zip(exported.gives, found, strict=True))
        outputs.append(ports(named, before=OUT))
        return tuple(jax.tree.leaves(found))

    inputs = ports(given)
    jax.eval_shape(run, *(port.struct() for port in inputs))
    return Graph(name=name, run=run, inputs=inputs, outputs=outputs[0])


def together(graph: Graph, number: int) -> Graph:
    """The graph of several characters at once, who are the first axis of all arrays."""

    def lead(ports: tuple[Port, ...]) -> tuple[Port, ...]:
        return tuple(dataclasses.replace(x, shape=(number, *x.shape)) for x in ports)

    return Graph(
        name=graph.name,
        run=jax.vmap(graph.run),
        inputs=lead(graph.inputs),
        outputs=lead(graph.outputs),
    )


def ports(trees: dict[str, Any], *, before: str = "") -> tuple[Port, ...]:
    """The arrays of trees by their place, in the order of their leaves."""
    found = []
    for head, tree in trees.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            place = jax.tree_util.keystr(path, simple=True, separator=".")
            found.append(
                Port(
                    name=f"{before}{head}" + (f".{place}" if place else ""),
                    shape=tuple(leaf.shape),
                    dtype=str(leaf.dtype),
                    text="Standard normal." if head == "noise" else _text(tree, path),
                )
            )
    return tuple(found)


def to_json(graph: Graph, file: str, *, batch: Batch = None) -> dict[str, Any]:
    """What a player must know of a graph."""
    lead = [] if batch is None else [batch]

    def listed(ports: tuple[Port, ...]) -> list[dict[str, Any]]:
        return [dataclasses.asdict(x) | {"shape": [*lead, *x.shape]} for x in ports]

    inputs, outputs = listed(graph.inputs), listed(graph.outputs)
    return {"file": file, "inputs": inputs, "outputs": outputs}


def _text(tree: Any, path: tuple) -> str:
    """What the dataclasses on the way to an array say of it, from the outermost."""
    said = []
    for step in path:
        name = getattr(step, "name", getattr(step, "key", getattr(step, "idx", None)))
        if isinstance(name, str) and hasattr(tree, name):
            said.append(_attributes(type(tree)).get(name, ""))
            tree = getattr(tree, name)
        else:
            tree = tree[name]
    return " ".join(text for text in said if text)


@functools.cache
def _attributes(kind: type) -> dict[str, str]:
    """Texts of a dataclass's fields, from "Attributes" of its docstring."""
    section = (inspect.getdoc(kind) or "").partition("Attributes:\n")[2]
    found = re.findall(r"^  (\w+): (.*(?:\n    .*)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}
