"""What comes from outside: optional packages, and tokenizers from files."""

import importlib
import os
from types import ModuleType
from typing import Any


def require(package: str) -> ModuleType:
    """Imports a package that only texts need; says how to install one that lacks."""
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise missing(package) from None


def missing(package: str) -> ModuleNotFoundError:
    """The error, to be raised, of a package that is not installed."""
    return ModuleNotFoundError(
        f"text needs the package {package!r}, which is not installed: "
        'pip install "jaxmotion[text]"',
        name=package,
    )


def read_tokenizer(path: str | os.PathLike) -> Any:
    """Reads a tokenizer.json into a `tokenizers.Tokenizer`; it neither pads nor cuts.

    Its `encode_batch` may be called by several threads. `ModuleNotFoundError` without
    `tokenizers`; a `ValueError` names a file that is none.
    """
    path = os.fspath(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no tokenizer file {path!r}")
    try:
        tokenizer = require("tokenizers").Tokenizer.from_file(path)
    except ModuleNotFoundError:
        raise
    except Exception as error:  # the library raises nothing more special
        raise ValueError(f"{path}: not a tokenizer ({error})") from None
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer
