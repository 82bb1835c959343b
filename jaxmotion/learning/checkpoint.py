"""Checkpoints through orbax, and single-file exports of parameters.

A checkpoint folder holds numbered steps; each has the state (arrays), the config (JSON)
and checksums of both. Orbax writes a step under a temporary name and renames it when it
is whole, so an interruption at any moment leaves the steps before it as they were. What
is read is compared with its checksums, since the arrays' files have none of their own.
"""

import errno
import json
import os
import shutil
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxmotion import files
from jaxmotion.learning import fingerprint
from jaxmotion.typing import Params


class CheckpointError(ValueError):
    """A checkpoint is missing, corrupt, or of another model."""


def _manager(folder: Path, keep: int | None = None) -> ocp.CheckpointManager:
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep, enable_async_checkpointing=False, create=keep is not None
    )
    return ocp.CheckpointManager(
        folder.absolute(), item_names=("state", "config", "checksums"), options=options
    )


def _checksums(state: Any, config: dict[str, Any]) -> dict[str, Any]:
    return {
        "config": fingerprint.json_checksum(config),
        "state": fingerprint.checksums(state),
    }


def save(
    folder: str | Path, step: int, state: Any, config: dict[str, Any], *, keep: int = 2
) -> None:
    """Writes one step, whole or not at all, and removes the oldest beyond `keep`.

    The folder is made if missing; the config, which rebuilds the model, must be JSON.
    Raises `OSError` if it cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    needed = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(state))
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"disk full: step {step} needs {needed / 1e6:.1f} MB, {free / 1e6:.1f} MB "
            "are free",
            str(folder),
        )
    with _manager(folder, keep) as manager:
        manager.save(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(state),
                config=ocp.args.JsonSave(config),
                checksums=ocp.args.JsonSave(_checksums(state, config)),
            ),
            force=True,
        )


def latest_step(folder: str | Path) -> int | None:
    """Newest whole step of a folder, or None.

    Only the folder is read: a process may ask while another one saves there, as an
    orbax manager could not, since it waits for all processes where it is made.
    """
    if not Path(folder).is_dir():
        return None
    return max(ocp.utils.checkpoint_steps(Path(folder).absolute()), default=None)


def _newest(folder: Path, step: int | None) -> int:
    step = latest_step(folder) if step is None else step
    if step is None:
        raise CheckpointError(f"{folder}: no checkpoint here, expected numbered steps")
    return step


def _read_json(folder: Path, step: int, item: str) -> dict[str, Any]:
    try:
        with _manager(folder) as manager:
            args = ocp.args.Composite(**{item: ocp.args.JsonRestore()})
            value = manager.restore(step, args=args)[item]
    except Exception as error:
        raise CheckpointError(
            f"{folder}: step {step} has no readable {item}: {_first_line(error)}"
        ) from error
    if not isinstance(value, dict):
        raise CheckpointError(
            f"{folder}: step {step} has no readable {item}: found "
            f"{type(value).__name__}, expected a JSON object"
        )
    return value


def _read_checksums(folder: Path, step: int) -> dict[str, Any] | None:
    if not (folder / str(step) / "checksums").exists():
        warnings.warn(
            f"{folder}: step {step} has no checksums (an earlier version wrote it): "
            "damage to it would not be noticed",
            stacklevel=4,
        )
        return None
    value = _read_json(folder, step, "checksums")
    if not isinstance(value.get("config"), str) or not isinstance(
        value.get("state"), dict
    ):
        raise CheckpointError(f"{folder}: step {step} has no readable checksums")
    return value


def _check_state(folder: Path, step: int, state: Any) -> None:
    """Raises if an array is not what was saved; parts of a state may be missing."""
    checksums = _read_checksums(folder, step)
    if checksums is None:
        return
    for name, found in fingerprint.checksums(state).items():
        if checksums["state"].get(name) != found:
            raise _damaged(folder, step, name)


def _damaged(folder: Path, step: int, what: str) -> CheckpointError:
    with _manager(folder) as manager:
        others = sorted(set(manager.all_steps()) - {step})
    hint = f"; without {folder / str(step)} step {others[-1]} counts" if others else ""
    return CheckpointError(
        f"{folder}: step {step} is corrupt: {what} is not what was saved (its checksum "
        f"differs){hint}"
    )


def load_config(folder: str | Path, step: int | None = None) -> dict[str, Any]:
    """Config of a step (None: the newest).

    A `CheckpointError` names the folder if there is none or it is not what was saved.
    """
    folder = Path(folder)
    step = _newest(folder, step)
    value = _read_json(folder, step, "config")
    checksums = _read_checksums(folder, step)
    if checksums and checksums["config"] != fingerprint.json_checksum(value):
        raise _damaged(folder, step, "config")
    return value


def restore(folder: str | Path, like: Any, step: int | None = None) -> Any:
    """State of a step (None: the newest), equal to what was saved to the bit.

    `like` has the same structure and shapes (arrays or ShapeDtypeStructs).

    Raises:
      CheckpointError: if there is none, it is corrupt, or of another model; names the
        folder.
    """
    folder = Path(folder)
    step = _newest(folder, step)
    try:
        with _manager(folder) as manager:
            args = ocp.args.Composite(state=ocp.args.StandardRestore(like))
            state = manager.restore(step, args=args)["state"]
    except Exception as error:
        raise _foreign(folder, step, error) from error
    _check_shapes(folder, step, like, state)
    _check_state(folder, step, state)
    return state


def _foreign(folder: Path, step: int, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"{folder}: step {step} is corrupt or of another model: {_first_line(error)}"
    )


def _first_line(error: Exception) -> str:
    # Orbax tells whole stories in one line.
    return (str(error).splitlines() or [type(error).__name__])[0][:300]


def _check_shapes(folder: Path, step: int, like: Any, found: Any) -> None:
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(like)]
    pairs = zip(jax.tree.leaves(like), jax.tree.leaves(found), strict=True)
    for path, (want, got) in zip(paths, pairs, strict=True):
        if want.shape != got.shape:
            raise CheckpointError(
                f"{folder}: step {step} is of another model: "
                f"{jax.tree_util.keystr(path)} is {got.shape}, expected {want.shape}"
            )


def restore_part(
    folder: str | Path,
    like: dict[str, Any],
    step: int | None = None,
    *,
    within: str | None = None,
) -> dict[str, Any]:
    """Some fields of a saved state, such as the averaged parameters alone.

    Args:
      like: Field names to nested dicts of arrays (or ShapeDtypeStructs), of the same
        structure and shapes.
      within: Field of the state whose fields they are, such as "generator"; None for
        the state itself.

    Raises:
      CheckpointError: if there is none, it is corrupt, or of another model; names the
        folder.
    """
    folder = Path(folder)
    step = _newest(folder, step)
    whole = like if within is None else {within: like}
    part = ocp.args.PyTreeRestore(
        item=whole,
        restore_args=ocp.checkpoint_utils.construct_restore_args(whole),
        partial_restore=True,
    )
    saved = folder.absolute() / str(step) / "state"
    try:
        # The handler itself: a Checkpointer looks for a metadata file that only whole
        # steps have, and warns.
        reader = ocp.PyTreeCheckpointHandler()
        try:
            stored = reader.metadata(saved).tree  # pyright: ignore[reportArgumentType]
            if within is not None:
                stored = stored.get(within) or {}
            # Orbax would hand back what `like` has where the disk has nothing.
            _check_part(folder, step, like, {name: stored.get(name) for name in like})
            found = reader.restore(saved, args=part)  # pyright: ignore[reportArgumentType]
        finally:
            reader.close()
    except CheckpointError:
        raise
    except Exception as error:
        raise _foreign(folder, step, error) from error
    _check_state(folder, step, found)
    found = found if within is None else found[within]
    return jax.device_put(found)


def _check_part(folder: Path, step: int, like: Any, stored: Any) -> None:
    want, got = (
        {
            jax.tree_util.keystr(path): tuple(leaf.shape)
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        }
        for tree in (like, stored)
    )
    for name in sorted(want.keys() | got.keys()):
        if want.get(name) != got.get(name):
            raise CheckpointError(
                f"{folder}: step {step} is of another model: {name} is "
                f"{got.get(name, 'missing')}, expected {want.get(name, 'nothing')}"
            )


def export_params(
    path: str | Path,
    params: Params,
    config: dict[str, Any],
    *,
    dtype: type = np.float16,
) -> None:
    """Writes parameters, a nested dict, and their config (JSON) whole or not at all.

    float16 halves the npz file at three decimal digits. `ValueError` for numbers that
    are not finite, or too large for it.
    """
    leaves = jax.tree_util.tree_leaves_with_path(params)
    with np.errstate(over="ignore"):
        arrays = {
            "/".join(str(k.key) for k in keys): np.asarray(leaf, dtype)
            for keys, leaf in leaves
        }
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(
                f"{name} has numbers that are not finite in {np.dtype(dtype).name}"
            )
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, expected a file to write")
    text = json.dumps(config)
    checksum = np.array(_export_checksum(text, arrays))
    head = {"config": np.array(text), "checksum": checksum}
    files.write_arrays(path, head | arrays, compress=True)


def _export_checksum(config: str, arrays: dict[str, np.ndarray]) -> str:
    return fingerprint.json_checksum([config, fingerprint.checksums(arrays)])


def _insert(path: str | Path, params: Params, name: str, array: np.ndarray) -> None:
    """Puts an array among the parameters; raises unless it is one of numbers."""
    with np.errstate(over="ignore"):
        values = array.astype(np.float32) if array.dtype.kind == "f" else array
    if values.dtype != np.float32 or not np.isfinite(values).all():
        raise CheckpointError(
            f"{path}: field {name!r} has values that are not finite float32 numbers "
            f"({array.dtype} of shape {array.shape})"
        )
    *parents, last = name.split("/")
    node = params
    for parent in parents:
        node = node.setdefault(parent, {})
        if not isinstance(node, dict):
            break
    if not isinstance(node, dict) or last in node:
        raise CheckpointError(f"{path}: field {name!r} is within another array")
    node[last] = jax.device_put(values)


def _read_export(
    path: str | Path, only: tuple[str, ...] | None = None
) -> tuple[dict[str, np.ndarray], str, dict[str, Any]]:
    """Arrays of an export, and its config as text and as JSON."""
    name = os.fspath(path)
    try:
        arrays = files.read_arrays(path, name=name, what="parameter", only=only)
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path}: not an export of parameters: {_first_line(error)}"
        ) from error
    try:
        text = str(arrays.pop("config"))
        config = json.loads(text)
    except (KeyError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: field 'config' is missing or no JSON: {error}"
        ) from None
    if not isinstance(config, dict):
        raise CheckpointError(
            f"{path}: field 'config' is a {type(config).__name__}, expected an object"
        )
    return arrays, text, config


def export_config(path: str | Path) -> dict[str, Any]:
    """Config of an export alone; `import_params` checks both.

    Raises `CheckpointError` if the file is no export.
    """
    return _read_export(path, ("config",))[2]


def import_params(path: str | Path) -> tuple[Params, dict[str, Any]]:
    """Parameters as float32, and the config, as `export_params` wrote them.

    Raises `CheckpointError` if the file is no such export, or damaged.
    """
    arrays, text, config = _read_export(path)
    checksum = arrays.pop("checksum", None)
    if checksum is not None and str(checksum) != _export_checksum(text, arrays):
        raise CheckpointError(f"{path}: corrupt: its checksum differs from its content")
    params: dict[str, Any] = {}
    for name, array in arrays.items():
        _insert(path, params, name, array)
    if checksum is None:
        warnings.warn(
            f"{path}: no checksum (an earlier version wrote it): damage to it would "
            "not be noticed",
            stacklevel=2,
        )
    return params, config


def check_params(path: str | Path, params: Params, like: Params) -> None:
    """Raises `CheckpointError`, with the file, unless shapes are those of `like`."""
    want, got = (jax.tree.map(lambda x: tuple(x.shape), x) for x in (like, params))
    if want != got:
        raise CheckpointError(f"{path}: parameters of another model")
