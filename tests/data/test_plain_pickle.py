import collections
import io
import os
import pickle
import struct

import numpy as np
import pytest

from jaxmotion.data.plain_pickle import read_plain_pickle

CONTENT = {
    "poses": [np.arange(6.0).reshape(2, 3), np.zeros((1, 3), np.float32)],
    "y": [np.int64(3), 4, True, None],
    "text": ("ü", b"\xff\x00"),
    "order": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "ragged": np.array([[np.arange(2), None, "x"], [1, 2, 3]], object),
    "words": np.array(["a", "bcd"]),
    "swapped": np.arange(3, dtype=">i4"),
    "type": np.dtype("<f4"),
}


def check(found):
    assert set(found) == set(CONTENT)
    for a, b in zip(found["poses"], CONTENT["poses"], strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert found["y"] == CONTENT["y"]
    assert found["text"] == CONTENT["text"]
    for name in ("order", "words", "swapped"):
        np.testing.assert_array_equal(found[name], CONTENT[name])
        assert found[name].dtype == CONTENT[name].dtype
    assert found["ragged"].shape == (2, 3)
    np.testing.assert_array_equal(found["ragged"][0, 0], np.arange(2))
    assert found["ragged"][0, 1:].tolist() == [None, "x"]
    assert found["ragged"][1].tolist() == [1, 2, 3]
    assert found["type"] == np.dtype("<f4")


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_and_plain_values_are_read(protocol):
    check(read_plain_pickle(pickle.dumps(CONTENT, protocol), name="x.pkl"))


@pytest.mark.parametrize("protocol", [2, 4])
def test_files_of_the_other_numpy_are_read(protocol):
    """NumPy 1 called its core numpy.core, NumPy 2 calls it numpy._core."""
    new = pickle.dumps(CONTENT, protocol)
    old = new.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    if protocol == 4:  # names are counted, and so are frames
        old = new.replace(b"\x8c\x16numpy._core.multiarray", b"\x8c\x15numpy.core.mult")
        old = old.replace(b"numpy.core.mult", b"numpy.core.multiarray")
        frame = old.index(b"\x95") + 1
        size = struct.pack("<Q", len(old) - frame - 8)
        old = old[:frame] + size + old[frame + 8 :]
    assert old != new
    check(read_plain_pickle(old, name="x.pkl"))


def test_files_of_python_2_are_read():
    """Written by hand: there, text and an array's bytes are both byte strings."""
    data = np.array([1.5, -2.0]).tobytes()
    text = lambda raw: b"U" + bytes([len(raw)]) + raw  # noqa: E731
    dtype = b"cnumpy\ndtype\n" + text(b"f8") + b"K\x00K\x01\x87R"
    dtype += b"(K\x03" + text(b"<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    array = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85"
    array += text(b"b") + b"\x87R(K\x01K\x02\x85" + dtype + b"\x89" + text(data) + b"tb"
    content = b"\x80\x02}" + text(b"a\xe9") + array + b"s."
    found = read_plain_pickle(content, name="x.pkl")
    assert list(found) == ["aé"]
    np.testing.assert_array_equal(found["aé"], [1.5, -2.0])


class Evil:
    """Pickled as a call of any function."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize(
    ("function", "name"),
    [
        (os.mkdir, f"{os.mkdir.__module__}.mkdir"),
        (eval, r"builtins.eval|__builtin__.eval"),
        (getattr, r"builtins.getattr|__builtin__.getattr"),
        (np.load, "numpy.load"),
        (collections.OrderedDict, "collections.OrderedDict"),
    ],
)
def test_other_names_are_not_called_but_named(tmp_path, protocol, function, name):
    target = tmp_path / "made"
    args = {
        os.mkdir: (str(target),),
        eval: (f"__import__('os').mkdir({str(target)!r})",),
    }
    evil = Evil(function, *args.get(function, ()))
    data = pickle.dumps({"poses": [np.zeros(2), evil]}, protocol)
    with pytest.raises(ValueError, match=f"x.pkl: the pickle asks for ({name}), expec"):
        read_plain_pickle(data, name="x.pkl")
    assert not target.exists()
    if function is eval:  # the same file does harm elsewhere
        pickle.load(io.BytesIO(data))
        assert target.exists()


def test_old_text_encodings_are_latin1_only():
    data = b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00aX\x05\x00\x00\x00rot13\x86R."
    with pytest.raises(ValueError, match="x.pkl.*'rot13', not 'latin1'"):
        read_plain_pickle(data, name="x.pkl")


@pytest.mark.parametrize("cut", [0, 1, 10, 60, -1])
def test_damaged_files_are_named(cut):
    with pytest.raises(ValueError, match="x.pkl: not a pickle, or a damaged one"):
        read_plain_pickle(pickle.dumps(CONTENT)[:cut], name="x.pkl")
    with pytest.raises(ValueError, match="x.pkl: not a pickle, or a damaged one"):
        read_plain_pickle(b"poses: 1\n", name="x.pkl")


class State(Evil):
    """Pickled as a call whose result is given a state."""

    def __init__(self, function, args, state):
        self.call = function, args, state


RECONSTRUCT = np.empty(0).__reduce__()[0]
# A type with a field of objects whose flags deny it.
DENIED = ("V8", False, True), (3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0)


@pytest.mark.parametrize(
    "evil",
    [
        Evil(np.ndarray, (1,), np.dtype("O"), b"A" * 8),
        Evil(np.ndarray, (1 << 36,), np.dtype("u1")),
        Evil(np.dtype, "f8,O"),
        State(np.dtype, *DENIED),
        State(np.dtype, ("f8",), (*DENIED[1][:5], -1, -1, 0)),
        State(
            RECONSTRUCT,
            (np.ndarray, (0,), b"b"),
            (1, (2,), np.dtype("O"), False, b"A" * 16),
        ),
        State(
            RECONSTRUCT, (np.ndarray, (0,), b"b"), (1, (9,), np.dtype("O"), False, [1])
        ),
        State(
            RECONSTRUCT, (np.ndarray, (0,), b"b"), (1, (9,), np.dtype("f8"), False, b"")
        ),
        RECONSTRUCT,
    ],
    ids=lambda evil: str(getattr(evil, "call", "alone"))[:60],
)
def test_numpys_functions_are_not_trusted(evil):
    """Memory of ours, pointers of theirs, and a terabyte out of 100 bytes."""
    data = pickle.dumps({"poses": [evil]}, 2)
    with pytest.raises(ValueError, match=r"x\.pkl: "):
        read_plain_pickle(data, name="x.pkl")


def test_objects_of_any_kind_and_order_are_read():
    lists, columns = np.empty(2, object), np.empty((2, 2), object, order="F")
    lists[:] = [[1, 2], [3]], [4]
    columns[0] = [np.arange(2), "x"]
    columns[1] = [[5, 6], 7]
    alone = np.empty((), object)
    alone[()] = {"a": np.arange(3)}
    for protocol in (0, 2, 5):
        data = pickle.dumps([lists, columns, alone], protocol)
        found = read_plain_pickle(data, name="x.pkl")
        assert found[0].tolist() == [[[1, 2], [3]], [4]]
        np.testing.assert_array_equal(found[1][0, 0], np.arange(2))
        assert found[1].T[1].tolist() == ["x", 7] and found[1][1, 0] == [5, 6]
        np.testing.assert_array_equal(found[2][()]["a"], np.arange(3))


def test_arrays_that_hold_each_other_are_read():
    one, other = np.empty(2, object), [np.arange(3)]
    one[:] = [other, 1]
    other.append(one)
    found = read_plain_pickle(pickle.dumps(one), name="x.pkl")
    assert found[0][1] is found
    np.testing.assert_array_equal(found[0][0], np.arange(3))
