"""What pictures share: colors, and whether a file can be written.

Figures are made without pyplot, so that neither a display is needed nor the backend of
a notebook changed.
"""

from pathlib import Path

LEFT, RIGHT, MIDDLE = "#2878c8", "#d63a3a", "#6b7480"
COMMANDED, WALKED = "#2ca02c", "#ff7f0e"


def check_writable(path: str | Path) -> Path:
    """The path of a file that can be written (else `OSError`), asked before drawing."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new = not path.exists()
        with open(path, "ab"):
            pass
        if new:
            path.unlink()
    except OSError as error:
        raise OSError(f"{path}: cannot write here: {error}") from error
    return path
