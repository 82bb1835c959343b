"""Checkpoints through orbax, and single-file exports of parameters.

A checkpoint folder holds numbered steps; each has the state (arrays) and the config
(JSON). Orbax writes a step under a temporary name and renames it when it is whole, so
an interruption at any moment leaves the steps before it as they were.
"""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxmotion import files
from jaxmotion.typing import Params


class CheckpointError(ValueError):
    """A checkpoint is missing, corrupt, or of another model."""


def _manager(folder: Path, keep: int | None = None) -> ocp.CheckpointManager:
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep, enable_async_checkpointing=False, create=keep is not None
    )
    return ocp.CheckpointManager(
        folder.absolute(), item_names=("state", "config"), options=options
    )


def save(
    folder: str | Path, step: int, state: Any, config: dict[str, Any], *, keep: int = 2
) -> None:
    """Writes one step, whole or not at all, and removes the oldest beyond `keep`.

    Args:
      folder: The run's checkpoint folder; made if missing.
      step: Number of the step.
      state: A pytree of arrays.
      config: What rebuilds the model; must be JSON.
      keep: Newest steps to keep.

    Raises:
      OSError: if the folder cannot be written.
    """
    with _manager(Path(folder), keep) as manager:
        manager.save(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(state), config=ocp.args.JsonSave(config)
            ),
            force=True,
        )


def latest_step(folder: str | Path) -> int | None:
    """Newest whole step of a folder, or None.

    Args:
      folder: The run's checkpoint folder.

    Returns:
      Its number.
    """
    if not Path(folder).is_dir():
        return None
    with _manager(Path(folder)) as manager:
        return manager.latest_step()


def _newest(folder: Path, step: int | None) -> int:
    step = latest_step(folder) if step is None else step
    if step is None:
        raise CheckpointError(f"{folder}: no checkpoint here, expected numbered steps")
    return step


def load_config(folder: str | Path, step: int | None = None) -> dict[str, Any]:
    """Config of a step.

    Args:
      folder: The run's checkpoint folder.
      step: Which; None for the newest.

    Returns:
      The JSON object that `save` was given.

    Raises:
      CheckpointError: if there is none, or it is not readable; names the folder.
    """
    folder = Path(folder)
    step = _newest(folder, step)
    try:
        with _manager(folder) as manager:
            args = ocp.args.Composite(config=ocp.args.JsonRestore())
            return manager.restore(step, args=args)["config"]
    except Exception as error:
        raise CheckpointError(
            f"{folder}: step {step} has no readable config: {error}"
        ) from error


def restore(folder: str | Path, like: Any, step: int | None = None) -> Any:
    """State of a step.

    Args:
      folder: The run's checkpoint folder.
      like: A state of the same structure and shapes (arrays or ShapeDtypeStructs).
      step: Which; None for the newest.

    Returns:
      The state, equal to what was saved to the bit.

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
    return state


def _foreign(folder: Path, step: int, error: Exception) -> CheckpointError:
    lines = str(error).splitlines() or [type(error).__name__]
    return CheckpointError(
        f"{folder}: step {step} is corrupt or of another model: {lines[0]}"
    )


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
      folder: The run's checkpoint folder.
      like: Field names to nested dicts of arrays (or ShapeDtypeStructs), of the same
        structure and shapes.
      step: Which; None for the newest.
      within: Field of the state whose fields they are, such as "generator"; None for
        the state itself.

    Returns:
      Those fields.

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
        with ocp.PyTreeCheckpointer() as reader:
            stored = reader.metadata(saved).item_metadata.tree
            if within is not None:
                stored = stored.get(within) or {}
            # Orbax would hand back what `like` has where the disk has nothing.
            _check_part(folder, step, like, {name: stored.get(name) for name in like})
            found = reader.restore(saved, args=part)
        found = found if within is None else found[within]
        return jax.tree.map(jax.numpy.asarray, found)
    except CheckpointError:
        raise
    except Exception as error:
        raise _foreign(folder, step, error) from error


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
    """Writes parameters and config as one small npz file, whole or not at all.

    Args:
      path: File to write.
      params: Nested dict of arrays.
      config: What rebuilds the model; must be JSON.
      dtype: Stored type; float16 halves the size at three decimal digits.
    """
    leaves = jax.tree_util.tree_leaves_with_path(params)
    arrays = {
        "/".join(str(k.key) for k in keys): np.asarray(leaf, dtype)
        for keys, leaf in leaves
    }
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        np.savez_compressed(file, config=np.array(json.dumps(config)), **arrays)
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)


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
    node[last] = jax.numpy.asarray(values)


def import_params(
    path: str | Path, like: Params | None = None
) -> tuple[Params, dict[str, Any]]:
    """Reads what `export_params` wrote.

    Args:
      path: The file.
      like: Parameters of the same structure and shapes to check against.

    Returns:
      Parameters as float32, and the config.

    Raises:
      CheckpointError: if the file is no such export, or of another model.
    """
    try:
        arrays = files.read_arrays(path, name=os.fspath(path), what="parameter")
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path}: not an export of parameters: {error}"
        ) from error
    try:
        config = json.loads(str(arrays.pop("config")))
    except (KeyError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: field 'config' is missing or no JSON: {error}"
        ) from None
    if not isinstance(config, dict):
        raise CheckpointError(
            f"{path}: field 'config' is a {type(config).__name__}, expected an object"
        )
    params: dict[str, Any] = {}
    for name, array in arrays.items():
        _insert(path, params, name, array)
    if like is not None:
        want = jax.tree.map(lambda x: tuple(x.shape), like)
        got = jax.tree.map(lambda x: tuple(x.shape), params)
        if want != got:
            raise CheckpointError(f"{path}: parameters of another model")
    return params, config
