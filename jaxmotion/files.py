"""Files as they come: damaged, foreign or hostile ones end in one clear line.

Nothing that is read here runs code, waits for a pipe, or unpacks without a limit.
"""

import contextlib
import io
import json
import os
import stat
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

# What an archive may unpack to: so many bytes, or so many times its own size. Text of
# motions shrinks about 4 times, still frames 20 times; bombs go up to 1,000 times.
FREE_BYTES = 256 * 2**20
FREE_RATIO = 50
# Models that come with the package, by name; each has a card beside it.
SHIPPED = {
    path.stem: path for path in sorted(Path(__file__).with_name("assets").glob("*.npz"))
}
# License of their weights.
SHIPPED_LICENSE = "Apache-2.0"
# What makes a file of clips, for messages about one that is missing.
CLIPS_MAKER = (
    "`experiments/prepare_data.py` makes it, or `experiments/dribble.py` with a ball"
)


def shipped(source: str | os.PathLike) -> Path | None:
    """File of the shipped model of that name; None for others, files and run folders.

    A folder of that name that is no run, such as an exported page's, is not meant.
    """
    path = Path(source)
    own = path.is_file() or (path / "config.json").exists()
    return None if own else SHIPPED.get(str(source))


def open_regular(path: str | os.PathLike) -> BinaryIO:
    """Opens a file for reading, unless it is a pipe or a device (`OSError`)."""
    path = os.fspath(path)
    # Before opening: to open a pipe is to wait for its other end.
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError(f"{path}: expected a regular file, found a pipe or a device")
    return open(path, "rb")


def read_bytes(path: str | os.PathLike) -> bytes:
    """Content of a regular file; see `open_regular`."""
    with open_regular(path) as file:
        return file.read()


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """A file to write, which appears under its name only when it is whole.

    Its folder is made if need be. After an error nothing of it is left.
    """
    path = os.fspath(path)
    os.makedirs(os.path.dirname(os.path.abspath(path)), exist_ok=True)
    temporary = f"{path}.{os.getpid()}.partial"
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        # Python names the reason, a full disk, but not the file.
        if error.filename is None and error.errno is not None:
            raise OSError(error.errno, error.strerror, path) from error
        raise
    finally:
        if os.path.exists(temporary):
            os.remove(temporary)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Writes a text file, whole or not at all; an `OSError` names it."""
    with replacing(path) as file:
        file.write(text.encode())


def write_arrays(
    path: str | os.PathLike, arrays: Mapping[str, Any], *, compress: bool = False
) -> None:
    """Writes named arrays as npz file, whole or not at all; an `OSError` names it."""
    write = np.savez_compressed if compress else np.savez
    with replacing(path) as file:
        write(file, **arrays)


def read_object(path: str | os.PathLike, *, what: str) -> dict[str, Any]:
    """JSON object of a file; `what` is what it is, or who writes it, for messages.

    A `ValueError` names a file that is no JSON, or not an object.
    """
    try:
        value = json.loads(read_bytes(path))
    except FileNotFoundError:
        raise FileNotFoundError(f"{os.fspath(path)}: no such file: {what}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)}: not JSON ({error}): {what}") from None
    if not isinstance(value, dict):
        raise ValueError(
            f"{os.fspath(path)}: a JSON {type(value).__name__}, expected an object: "
            f"{what}"
        )
    return value


def _check_sizes(members: list[zipfile.ZipInfo], archive_bytes: int) -> None:
    """Raises if members would unpack to more than an honest archive does."""
    # A member is read up to the size that it states, never beyond.
    limit = max(FREE_BYTES, FREE_RATIO * archive_bytes)
    total = sum(member.file_size for member in members)
    if total > limit:
        largest = max(members, key=lambda member: member.file_size)
        raise ValueError(
            f"it would unpack to {total} bytes, more than {limit} (the larger of "
            f"{FREE_BYTES} and {FREE_RATIO} times its size); the largest member is "
            f"{largest.filename!r} with {largest.file_size}"
        )


def read_members(
    path: str | os.PathLike, wanted: Callable[[str], bool]
) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the wanted members of a zip, sorted by name.

    A `ValueError` names a zip that is damaged, encrypted or packed in an unknown way,
    or the member that would unpack to far more than its size.
    """
    with open_regular(path) as file, _one_line(path, "unreadable zip"):
        archive = zipfile.ZipFile(file)
        members = [one for one in archive.infolist() if wanted(one.filename)]
        _check_sizes(members, os.fstat(file.fileno()).st_size)
        for member in sorted(members, key=lambda member: member.filename):
            if member.flag_bits & 1:
                raise ValueError(f"member {member.filename!r} is encrypted")
            try:
                data = archive.read(member)
            except Exception as error:
                raise ValueError(
                    f"member {member.filename!r}: {type(error).__name__}: {error}"
                ) from None
            yield member.filename, data


@contextlib.contextmanager
def _one_line(name: str | os.PathLike, problem: str) -> Iterator[None]:
    """Makes of whatever damaged bytes raise one line that names the file."""
    try:
        yield
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        # Some messages quote damaged bytes at length.
        words = " ".join(str(error).split())[:300] or "truncated"
        raise ValueError(f"{os.fspath(name)}: {problem} ({kind}{words})") from None


def read_arrays(
    file: str | os.PathLike | io.BytesIO,
    *,
    name: str,
    what: str,
    only: Collection[str] | None = None,
) -> dict[str, np.ndarray]:
    """All arrays of an npz file, a path or its content, without pickles.

    The name (its path) and what it holds are for messages; only some fields may be
    read.

    A `ValueError` names a file that is damaged, no npz, or would unpack to far more
    than its size.
    """
    try:
        opened = file if isinstance(file, io.BytesIO) else open_regular(file)
    except FileNotFoundError:
        raise FileNotFoundError(f"no {what} file {name!r}") from None
    with opened, _one_line(name, f"not a {what} file, or a damaged one"):
        head = opened.read(6)
        size = opened.seek(0, os.SEEK_END)
        opened.seek(0)
        if not head.startswith(b"PK"):
            found = f"begins with {head!r}" if head else "is empty"
            raise ValueError(f"expected an npz archive, the file {found}")
        content = np.load(opened, allow_pickle=False)
        _check_sizes(content.zip.infolist(), size)
        wanted = [field for field in content.files if only is None or field in only]
        return {field: _array(content, field) for field in wanted}


def read_versioned(
    path: str | os.PathLike,
    wanted: Mapping[str, tuple[str, int]],
    *,
    what: str,
    format_name: str,
    version: int,
) -> dict[str, np.ndarray]:
    """Arrays of a file that states its format and version, each of the expected kind.

    For each field is wanted the kind of its numbers ("f" float, "i" integer, "U" text)
    and how many axes it has; what the file holds is for messages.

    A `ValueError` names the file and the field if it is damaged, foreign, of another
    version, or lacks one.
    """
    path = os.fspath(path)
    fields = read_arrays(path, name=path, what=what)
    if str(fields.get("format")) != format_name:
        raise ValueError(
            f"{path}: not a {what} file: its field 'format' should be {format_name!r}; "
            f"it has the fields {', '.join(sorted(fields)) or 'none'}"
        )
    found_version = fields.get("version")
    if found_version is None or found_version.ndim or found_version != version:
        if found_version is not None and found_version.ndim:
            found_version = f"of shape {found_version.shape}"
        raise ValueError(
            f"{path}: version {found_version} of the {what} format, expected "
            f"{version}; prepare the data again"
        )
    check_fields(path, fields, wanted)
    return fields


def check_fields(
    path: str, fields: Mapping[str, np.ndarray], wanted: Mapping[str, tuple[str, int]]
) -> None:
    """Raises `ValueError` unless arrays have the wanted kinds and numbers of axes."""
    for name, (kind, axes) in wanted.items():
        if name not in fields:
            raise ValueError(f"{path}: field {name!r} is missing")
        found = fields[name]
        if found.dtype.kind != kind or found.ndim != axes:
            raise ValueError(
                f"{path}: field {name!r} should have {axes} axes of kind {kind!r}, "
                f"found shape {found.shape} of {found.dtype}"
            )


def read_array(path: str | os.PathLike, *, what: str) -> np.ndarray:
    """Floating-point numbers of an npy file, float32; a `ValueError` names others."""
    with (
        open_regular(path) as file,
        _one_line(path, f"not a {what} file, or a damaged one"),
    ):
        if file.read(6) != b"\x93NUMPY":
            raise ValueError("expected an npy file")
        file.seek(0)
        array = np.lib.format.read_array(file, allow_pickle=False)
        if array.dtype.kind != "f":
            raise ValueError(f"expected floating-point numbers, found {array.dtype}")
        with np.errstate(over="ignore"):  # becomes infinite, which users refuse
            return array.astype(np.float32)


def _array(content: np.lib.npyio.NpzFile, field: str) -> np.ndarray:
    """One array of an archive, no larger than its member."""
    try:
        found: Any = content[field]
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ValueError(f"field {field!r}: {kind}{error}") from None
    if not isinstance(found, np.ndarray):
        raise ValueError(f"field {field!r} is no array")
    return found
