"""Named arrays on disk: one npz file without pickles, written whole or not at all."""

import os
from collections.abc import Mapping

import numpy as np

from jaxmotion import files


def write_npz(path: str | os.PathLike, fields: Mapping[str, np.ndarray]) -> None:
    """Writes arrays; the file appears under its name only when it is whole.

    Args:
      path: File to write; its folder is made if need be.
      fields: The arrays.

    Raises:
      OSError: if the file cannot be written.
    """
    with files.replacing(path) as file:
        np.savez(file, **fields)


def read_npz(
    path: str | os.PathLike,
    wanted: Mapping[str, tuple[str, int]],
    *,
    what: str,
    format_name: str,
    version: int,
) -> dict[str, np.ndarray]:
    """Reads what `write_npz` wrote; each array of the expected kind.

    Args:
      path: The file.
      wanted: For each field the kind of its numbers ("f" float, "i" integer, "U" text)
        and how many axes it has.
      what: What the file holds, for messages.
      format_name: Expected value of its field "format".
      version: Expected value of its field "version".

    Returns:
      All its arrays.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is damaged, foreign, of another version, or lacks a field; names
        the file and the field.
    """
    path = os.fspath(path)
    fields = files.read_arrays(path, name=path, what=what)
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
    """Raises unless all arrays are there and of the expected kind.

    Args:
      path: The file, for messages.
      fields: Its arrays.
      wanted: As of `read_npz`.

    Raises:
      ValueError: names the file and the field.
    """
    for name, (kind, axes) in wanted.items():
        if name not in fields:
            raise ValueError(f"{path}: field {name!r} is missing")
        found = fields[name]
        if found.dtype.kind != kind or found.ndim != axes:
            raise ValueError(
                f"{path}: field {name!r} should have {axes} axes of kind {kind!r}, "
                f"found shape {found.shape} of {found.dtype}"
            )
