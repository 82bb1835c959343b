"""Several trainings as one program: the same code, on arrays of their own.

A small network leaves most of a large device idle, and a dozen seeds are what tells two
methods apart. Each training runs as it would alone, up to where it would compile its
chunk (`loop.train`). There all that the others have is stacked, one compiled `vmap` of
the chunk trains all of them, and each goes on with what became of its own: to its next
stage, where they meet again. Checkpoints and losses are written as each alone would
write them.
"""

import dataclasses
import functools
import queue
import threading
import types
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jax_core

from jaxmotion.learning import loop
from jaxmotion.learning.loop import Training

# Shared by all, or one for each, stacked: axes of `vmap`.
_SHARED, _EACH = None, 0


@dataclasses.dataclass(frozen=True)
class _Returned:
    """What a training ended with."""

    value: Any


def run(trainings: Sequence[Callable[[], Any]]) -> list[Any]:
    """Runs trainings that do the same, and returns what each returns.

    They take turns, each in a thread of its own, so that what one prepares it prepares
    alone; only the chunks of `loop.train` are made together.

    Raises:
      ValueError: if they part ways: other lengths or arrays of other shapes, another
        stage, or other code.
    """
    turns = [_Turn(training, str(i)) for i, training in enumerate(trainings)]
    given: list[Any] = [None] * len(turns)
    while True:
        found = [turn.go_on(x) for turn, x in zip(turns, given, strict=True)]
        going = [x for x in found if isinstance(x, Training)]
        if not going:
            return [x.value for x in found if isinstance(x, _Returned)]
        if len(going) < len(found):
            raise ValueError(
                f"{going[0].loop.folder}: {len(found) - len(going)} of {len(found)} "
                "trainings do not train this stage, expected all or none"
            )
        given = train(going)


class _Turn:
    """A training in a thread that waits wherever it would train."""

    def __init__(self, training: Callable[[], Any], name: str):
        self.found, self.given = queue.SimpleQueue(), queue.SimpleQueue()
        work = functools.partial(self._work, training)
        self.thread = threading.Thread(target=work, name=name, daemon=True)

    def go_on(self, state: Any) -> Training | _Returned:
        """Goes on with the state that it waits for, to its next training or its end."""
        if self.thread.ident is None:
            self.thread.start()
        else:
            self.given.put(state)
        found = self.found.get()
        if isinstance(found, BaseException):
            raise found
        return found

    def _work(self, training: Callable[[], Any]) -> None:
        def meet(found: Training) -> Any:
            self.found.put(found)
            return self.given.get()

        loop.leave_to(meet)
        try:
            self.found.put(_Returned(training()))
        except BaseException as error:
            self.found.put(error)


def train(trainings: Sequence[Training]) -> list[Any]:
    """`loop.train` of several as one program; returns the last state of each.

    Raises `ValueError` unless they do the same on arrays of the same shapes, else what
    `loop.train` raises.
    """
    first = trainings[0]
    loops = [x.loop for x in trainings]
    if len(loops) == 1:
        return [loop.train_all(first, loops, lambda state, _: state)]
    for one in loops[1:]:
        for name in ("num_steps", "chunk", "save_every", "show"):
            _agree(one, name, getattr(one, name), getattr(loops[0], name))
    for x in trainings[1:]:
        _agree(x.loop, "steps made", int(x.state.step), int(first.state.step))
    states, state_axes = _stack([x.state for x in trainings], loops, _state_axis)
    given, given_axes = _stack([(x.key, x.data) for x in trainings], loops, _own_axis)
    chunk, constants, constant_axes = _common_chunk(trainings)
    # Flat from here on: a stacked skeleton, say, would be none.
    shape, more = (
        jax.tree.structure(x) for x in (first.state, (first.key, first.data))
    )

    def run_chunk(state: Any, _: Any, data: Any, count: Any) -> tuple[Any, Any]:
        def one(state: Any, given: Any, constants: Any) -> tuple[Any, Any]:
            args = (shape.unflatten(state), *more.unflatten(given), count)
            state, info = chunk(constants, *args)
            return jax.tree.leaves(state), info

        mapped = jax.vmap(
            one,
            in_axes=(state_axes, given_axes, constant_axes),
            out_axes=(state_axes, _EACH),
        )
        state, info = mapped(jax.tree.leaves(state), *data)
        return shape.unflatten(state), info

    def part(state: Any, i: int) -> Any:
        own = zip(jax.tree.leaves(state), state_axes, strict=True)
        return shape.unflatten([x if axis is _SHARED else x[i] for x, axis in own])

    every = Training(
        run_chunk=jax.jit(run_chunk, donate_argnums=0),
        state=shape.unflatten(states),
        key=None,
        data=(given, constants),
        loop=loops[0],
    )
    last = loop.train_all(every, loops, part)
    return [part(last, i) for i in range(len(loops))]


def _agree(one: loop.Loop, what: str, found: Any, expected: Any) -> None:
    if found != expected:
        raise ValueError(
            f"{one.folder}: {what} is {found!r}, expected {expected!r} as in the other "
            "trainings of this program"
        )


# --- stacking ----------------------------------------------------------------------


def _same(arrays: Sequence[Any]) -> bool:
    """Whether arrays are equal."""
    first = arrays[0]
    if all(x is first for x in arrays):
        return True
    if jnp.issubdtype(first.dtype, jax.dtypes.prng_key):
        arrays = [jax.random.key_data(x) for x in arrays]
    return all(bool(jnp.array_equal(x, arrays[0])) for x in arrays[1:])


def _own_axis(arrays: Sequence[Any]) -> int | None:
    """What is equal in all trainings is there once."""
    return _SHARED if _same(arrays) else _EACH


def _state_axis(arrays: Sequence[Any]) -> int | None:
    """Counts of updates are the same in all, so a branch on one stays a branch.

    The rest of a state will soon be each one's own.
    """
    first = arrays[0]
    is_count = first.ndim == 0 and jnp.issubdtype(first.dtype, jnp.integer)
    return _SHARED if is_count else _EACH


def _stack(
    trees: Sequence[Any],
    loops: Sequence[loop.Loop],
    axis_of: Callable[[Sequence[Any]], int | None],
) -> tuple[list[Any], list[int | None]]:
    """Leaves of several trees as those of one, and their axes for `vmap`.

    Raises `ValueError` for trees of other structures or shapes.
    """
    flat = [jax.tree_util.tree_flatten_with_path(tree) for tree in trees]
    structure = flat[0][1]
    for (_, other), one in zip(flat, loops, strict=True):
        _agree(one, "a tree of arrays", other, structure)
    leaves, axes = [], []
    for each in zip(*(pairs for pairs, _ in flat), strict=True):
        path, arrays = each[0][0], [x for _, x in each]
        for x, one in zip(arrays, loops, strict=True):
            what = f"shape of {jax.tree_util.keystr(path)}"
            _agree(one, what, x.shape, arrays[0].shape)
        axes.append(axis_of(arrays))
        leaves.append(arrays[0] if axes[-1] is _SHARED else jnp.stack(arrays))
    return leaves, axes


# --- the chunk -----------------------------------------------------------------------


def _common_chunk(
    trainings: Sequence[Training],
) -> tuple[Callable, list[Any], list[int | None]]:
    """The chunk of all: `(constants, state, key, data, count) -> (state, info)`.

    A chunk may close over arrays, such as a space that each training has learned.
    Chunks that close over equal ones are one function; otherwise each is traced, and
    the constants of the traces that differ are stacked.

    Returns:
      The function, its constants, and their axes.
    """
    chunks = [x.run_chunk.__wrapped__ for x in trainings]  # pyright: ignore[reportFunctionMemberAccess]
    loops = [x.loop for x in trainings]
    if all(_same_closure(chunks[0], other) for other in chunks[1:]):
        return lambda _, *args: chunks[0](*args), [], []
    count = jnp.int32(loops[0].chunk)
    traces = [
        jax.make_jaxpr(chunk)(x.state, x.key, x.data, count)
        for chunk, x in zip(chunks, trainings, strict=True)
    ]
    for trace, one in zip(traces[1:], loops[1:], strict=True):
        if str(trace.jaxpr) != str(traces[0].jaxpr):
            raise ValueError(
                f"{one.folder}: is computed otherwise than the other trainings of "
                "this program, expected the same code, numbers, and shapes of arrays"
            )
        inner = [_inner_constants(x.jaxpr) for x in (traces[0], trace)]
        if not all(_same(pair) for pair in zip(*inner, strict=True)):
            raise ValueError(
                f"{one.folder}: a compiled function that it calls closes over arrays "
                "of its own, expected them as arguments"
            )
    constants, axes = _stack([x.consts for x in traces], loops, _own_axis)
    first = trainings[0]
    shape = jax.eval_shape(chunks[0], first.state, first.key, first.data, count)

    def chunk(constants: Any, *args: Any) -> Any:
        closed = jax_core.ClosedJaxpr(traces[0].jaxpr, constants)
        found = jax_core.jaxpr_as_fun(closed)(*jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shape), found)

    return chunk, constants, axes


def _inner_constants(jaxpr: jax_core.Jaxpr) -> Iterator[Any]:
    """Arrays that functions inside a trace close over."""
    for equation in jaxpr.eqns:
        for value in equation.params.values():
            for x in value if isinstance(value, tuple | list) else (value,):
                if isinstance(x, jax_core.ClosedJaxpr):
                    yield from x.consts
                    x = x.jaxpr
                if isinstance(x, jax_core.Jaxpr):
                    yield from _inner_constants(x)


def _same_closure(
    one: Any, other: Any, asked: frozenset[tuple[int, int]] = frozenset()
) -> bool:
    """Whether two functions are of the same code, and all that they hold is equal.

    What this cannot look into is equal where it says so: else where it is the same.
    `asked` are ids of pairs that hold these, which may hold each other.
    """
    pair = id(one), id(other)
    if one is other or pair in asked:
        return True
    if type(one) is not type(other):
        return False
    same = functools.partial(_same_closure, asked=asked | {pair})
    match one:
        case types.FunctionType():
            held = [(x.__defaults__, x.__kwdefaults__, _cells(x)) for x in (one, other)]
            return one.__code__ is other.__code__ and same(held[0], held[1])
        case types.MethodType():
            return same((one.__func__, one.__self__), (other.__func__, other.__self__))
        case functools.partial():
            held = [(x.func, x.args, x.keywords) for x in (one, other)]
            return same(held[0], held[1])
        case jax.Array() | np.ndarray():
            shapes = [(x.shape, x.dtype) for x in (one, other)]
            return shapes[0] == shapes[1] and _same([one, other])
        case tuple() | list():
            return len(one) == len(other) and all(map(same, one, other))
        case dict():
            return one.keys() == other.keys() and all(
                same(value, other[key]) for key, value in one.items()
            )
        case weakref.ref():
            return same(one(), other())
    if dataclasses.is_dataclass(one):
        names = [x.name for x in dataclasses.fields(one)]
        return all(
            same(getattr(one, name, None), getattr(other, name, None)) for name in names
        )
    if hasattr(one, "__wrapped__"):  # jitted
        return same(one.__wrapped__, other.__wrapped__)
    return (one == other) is True


def _cells(function: types.FunctionType) -> list[Any]:
    """What a function closes over; a cell that is still empty is None."""
    found = []
    for cell in function.__closure__ or ():
        try:
            found.append(cell.cell_contents)
        except ValueError:
            found.append(None)
    return found
