"""Files from outside: what is damaged, hostile or no file at all ends in one line."""

import io
import os
import subprocess
import sys
import warnings
import zipfile

import numpy as np
import pytest

from jaxmotion import files


def packed(*, flags: int = 0, method: int | None = None, **fields) -> bytes:
    """An npz file whose members claim those flags and that method."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **fields)
    data = bytearray(buffer.getvalue())
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = data.find(mark)
        while place >= 0:
            data[place + at] |= flags
            if method is not None:
                data[place + at + 2 : place + at + 4] = method.to_bytes(2, "little")
            place = data.find(mark, place + 1)
    return bytes(data)


def member(content: bytes) -> bytes:
    """A zip with one member a.npy."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", content)
    return buffer.getvalue()


def npy(header: str) -> bytes:
    """An array file with that header and no data."""
    text = header.ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def damaged() -> bytes:
    """Compressed data in the middle of which bytes are others."""
    data = bytearray(packed(a=np.arange(1000.0)))
    data[120:160] = bytes(40)
    return bytes(data)


SHAPE = "{{'descr': '<f4', 'fortran_order': False, 'shape': {}, }}"
# Each raised another exception within NumPy or zipfile: see the name.
ARRAYS = {
    "text": (b"hello", "expected an npz archive, the file begins with b'hello'"),
    "empty": (b"", "the file is empty"),
    "pickle": (b"\x80\x04}.", "begins with"),
    "BadZipFile": (packed(a=np.zeros(9))[:-30], "not a zip"),
    "zlib.error": (damaged(), "field 'a': (error|BadZipFile): "),
    "RuntimeError": (packed(a=np.zeros(9), flags=1), "field 'a': .*encrypted"),
    "NotImplementedError": (packed(a=np.zeros(9), method=77), "field 'a': .*method"),
    "MemoryError": (member(npy(SHAPE.format("(10**9,) * 2"))), "field 'a': "),
    "OverflowError": (member(npy(SHAPE.format((2**70,)))), "field 'a': "),
    "negative": (member(npy(SHAPE.format((-3,)))), "field 'a': "),
    "large": (member(npy(SHAPE.format((2**40,)))), "field 'a': "),
    "TokenError": (member(npy("{'descr': (((")), "field 'a': "),
    "SyntaxError": (member(npy("{'descr': '<f4'; ")), "field 'a': "),
    "object": (
        member(npy(SHAPE.format((1,)).replace("<f4", "|O"))),
        "field 'a': .*bject",
    ),
    "no array": (member(b"hello"), "field 'a' is no array"),
}


@pytest.mark.parametrize("case", ARRAYS)
def test_damaged_arrays_are_one_line(tmp_path, case):
    content, message = ARRAYS[case]
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    for source in (path, io.BytesIO(content)):
        with pytest.raises(ValueError, match=message) as caught:
            files.read_arrays(source, name="x.npz", what="clips")
        words = str(caught.value)
        assert words.startswith("x.npz: not a clips file") and "\n" not in words


def zeros(path, size: int, *, name: str = "a.npy") -> None:
    """A zip with a member of that many zeros, written in pieces."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(name, "w", force_zip64=True) as file,
    ):
        piece = bytes(2**20)
        for _ in range(size // len(piece)):
            file.write(piece)


@pytest.mark.slow
def test_bombs_are_refused_before_they_unpack(tmp_path):
    zeros(tmp_path / "bomb.npz", 300 * 2**20)
    assert (tmp_path / "bomb.npz").stat().st_size < 400_000
    code = """
import resource, sys
from jaxmotion import files
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
reads = (
    lambda: files.read_arrays(sys.argv[1], name="bomb.npz", what="clips"),
    lambda: list(files.read_members(sys.argv[1], lambda name: True)),
)
for read in reads:
    try:
        read()
    except ValueError as error:
        print(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "bomb.npz")],
        capture_output=True,
        text=True,
        check=True,
    )
    *lines, grown = done.stdout.splitlines()
    assert len(lines) == 2
    for line in lines:
        assert "bomb.npz" in line
        assert f"unpack to {300 * 2**20} bytes, more than {2**28}" in line
        assert "largest member is 'a.npy'" in line
    assert int(grown) < 30_000  # KiB


def test_archives_that_shrink_well_are_read(tmp_path):
    # 100 times smaller, but small: an honest file of zeros.
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(10**6))
    found = files.read_arrays(tmp_path / "a.npz", name="a.npz", what="clips")
    np.testing.assert_array_equal(found["a"], np.zeros(10**6))


MEMBERS = {
    "cut": (packed(a=np.zeros(9))[:-30], "unreadable zip"),
    "bytes": (damaged(), "member 'a.npy': (error|BadZipFile): "),
    "encrypted": (packed(a=np.zeros(9), flags=1), "member 'a.npy' is encrypted"),
    "method": (packed(a=np.zeros(9), method=77), "member 'a.npy': NotImpl.*method"),
    "no zip": (b"hello", "unreadable zip"),
}


@pytest.mark.parametrize("case", MEMBERS)
def test_damaged_zips_name_the_member(tmp_path, case):
    content, message = MEMBERS[case]
    (tmp_path / "x.zip").write_bytes(content)
    with pytest.raises(ValueError, match=f"x.zip: .*{message}|x.zip: {message}") as one:
        list(files.read_members(tmp_path / "x.zip", lambda name: True))
    assert "\n" not in str(one.value)


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero"):
        for read in (
            files.read_bytes,
            lambda path: files.read_arrays(path, name=str(path), what="clips"),
            lambda path: list(files.read_members(path, lambda name: True)),
        ):
            with pytest.raises(OSError, match=f"{path}: expected a regular file"):
                read(path)
    with pytest.raises(IsADirectoryError):
        files.read_bytes(tmp_path)


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "folder" / "a.txt"
    with files.replacing(path) as file:
        file.write(b"one")
    with pytest.raises(KeyError), files.replacing(path) as file:
        file.write(b"two")
        raise KeyError
    assert path.read_bytes() == b"one"
    assert os.listdir(path.parent) == ["a.txt"]


def test_a_full_disk_names_the_file(tmp_path):
    # Larger files than allowed stand for a full disk.
    code = """
import resource, signal, sys
import numpy as np
from jaxmotion import files
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
try:
    files.write_arrays(sys.argv[1], {"a": np.zeros(10_000)})
except OSError as error:
    print(error)
"""
    path = tmp_path / "a.npz"
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"[Errno 27] File too large: '{path}'\n"
    assert os.listdir(tmp_path) == []


def test_no_warning_of_numpy_slips_through(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for content, _ in ARRAYS.values():
            with pytest.raises(ValueError):
                files.read_arrays(io.BytesIO(content), name="x.npz", what="clips")


def test_a_folder_of_a_shipped_models_name_is_not_it_unless_it_is_a_run(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert files.shipped("walker") == files.SHIPPED["walker"]
    assert files.shipped("nobody") is None
    (tmp_path / "walker").mkdir()  # of an exported page
    assert files.shipped("walker") == files.SHIPPED["walker"]
    (tmp_path / "walker" / "config.json").write_text("{}")
    assert files.shipped("walker") is None
    (tmp_path / "dribble").write_text("a file")
    assert files.shipped("dribble") is None
