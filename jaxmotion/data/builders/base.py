"""What the tensorflow-datasets builders share; TensorFlow itself is never imported.

A builder stores whole clips, one example each, as array_record files, which
`as_data_source` reads without TensorFlow. `clips_from_source` makes `Clips` of them;
windows are cut later, on the device. World coordinates stay as published: nothing is
centered, turned or put on the floor.
"""

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import jax.numpy as jnp
import numpy as np
import tensorflow_datasets as tfds
from jaxtyping import Float

from jaxmotion import files
from jaxmotion.data.clips import Clips, clips_from_motions
from jaxmotion.motion.skeleton import Motion, Skeleton

_TENSORS = {
    "root_position": ((None, 3), np.float32),
    "joint_rotation": ((None, None, 6), np.float32),
    "offsets": ((None, 3), np.float32),
    "parents": ((None,), np.int32),
    "feet": ((None,), np.int32),
    "fps": ((), np.float32),
}


class MotionBuilder(tfds.core.GeneratorBasedBuilder, skip_registration=True):
    """A set of labeled clips; a subclass says where they come from.

    Attributes:
      LABELS: Label fields of each clip.
      LABEL_NAMES: Published order of a field's labels; other fields are sorted.
      MORE_TENSORS: Shape and type of what a clip has beside its motion.
      SOURCE: Name of the set and its license.
      HOMEPAGE: Where it is published.
    """

    VERSION = tfds.core.Version("1.0.0")
    RELEASE_NOTES = {"1.0.0": "First version."}
    LABELS: tuple[str, ...] = ()
    LABEL_NAMES: Mapping[str, Sequence[str]] = {}
    MORE_TENSORS: Mapping[str, tuple[tuple[int | None, ...], type]] = {}
    SOURCE = ""
    HOMEPAGE = ""

    @property
    def source(self) -> str:
        """Name of the set (and its configuration) and its license."""
        return self.SOURCE

    @property
    def label_names(self) -> Mapping[str, Sequence[str]]:
        """Published order of the labels of a field, where there is one."""
        return self.LABEL_NAMES

    def _info(self) -> tfds.core.DatasetInfo:
        features = {
            # Bytes, because two axes of unknown length need an encoding.
            name: tfds.features.Tensor(
                shape=shape,
                dtype=dtype,
                encoding="bytes" if shape.count(None) > 1 else "none",
            )
            for name, (shape, dtype) in {**_TENSORS, **self.MORE_TENSORS}.items()
        }
        # Joint names may contain spaces, but no line ends.
        for name in ("name", "joint_names", *self.LABELS):
            features[name] = tfds.features.Text()
        return tfds.core.DatasetInfo(
            builder=self,
            description=f"{self.source}: {type(self).__doc__}",
            features=tfds.features.FeaturesDict(features),
            homepage=self.HOMEPAGE,
        )

    def _split_generators(self, dl_manager):
        examples = self._generate_examples(Path(dl_manager.manual_dir))
        return {"train": _unique(examples)}


def _unique(examples: Iterator[tuple[str, dict]]) -> Iterator[tuple[str, dict]]:
    """The examples; raises when a name comes for the second time."""
    names = set()
    for name, features in examples:
        if name in names:
            raise ValueError(f"two clips have the name {name!r}, expected one")
        names.add(name)
        yield name, features


def motion_from_matrices(
    root_position: Float[np.ndarray, "frames 3"],
    local: Float[np.ndarray, "frames joints 3 3"],
    *,
    fps: float,
) -> Motion:
    """A motion of parent-local rotation matrices; the root's are global.

    Root positions are in the world, meters, y up.
    """
    columns = np.concatenate([local[..., 0], local[..., 1]], axis=-1)
    return Motion(
        root_position=jnp.asarray(root_position, jnp.float32),
        joint_rotation=jnp.asarray(columns, jnp.float32),
        fps=fps,
    )


def example(
    name: str, skeleton: Skeleton, motion: Motion, labels: Mapping[str, str]
) -> tuple[str, dict]:
    """Key and features of one clip, as a builder's generator yields them.

    The name is unique; each label field has one word.
    """
    features = {
        "root_position": np.asarray(motion.root_position, np.float32),
        "joint_rotation": np.asarray(motion.joint_rotation, np.float32),
        "offsets": np.asarray(skeleton.offsets, np.float32),
        "parents": np.array(skeleton.parents, np.int32),
        "feet": np.array(skeleton.feet, np.int32),
        "fps": np.float32(motion.fps),
        "joint_names": "\n".join(skeleton.names),
        "name": name,
        **labels,
    }
    return name, features


def _claim(places: dict[str, str], name: str, path: str, unique: bool) -> None:
    """Raises if another file has that name."""
    if unique and name in places:
        raise ValueError(f"two files are named {name!r}: {places[name]} and {path}")
    places[name] = path


def read_files(
    manual_dir: str | os.PathLike,
    suffixes: tuple[str, ...],
    *,
    stem: str = "",
    unique: bool = True,
) -> Iterator[tuple[str, bytes]]:
    """Files of a folder or, where it has none of the kind, of the zips in it.

    Folders below it are searched, too. Suffixes are lower case; with a stem, only files
    below a folder of that name (in the path or inside the zip), or in a zip named so,
    count; where `unique`, files are told apart by their names alone, without folders.
    Given are path (for zips "archive.zip/member") and content, sorted by path.

    A `ValueError` names a zip that cannot be unpacked, or two files of one name;
    `FileNotFoundError` without folder or files.
    """
    folder = Path(manual_dir)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {str(folder)!r} with the published files")
    loose = [
        path
        for path in sorted(folder.rglob("*"))
        if path.name.lower().endswith(suffixes)
        and path.is_file()
        and (not stem or stem in path.resolve().parts)
    ]
    places: dict[str, str] = {}
    if loose:
        for path in loose:
            _claim(places, path.name, str(path), unique)
        for path in loose:
            yield str(path), path.read_bytes()
        return
    found = False
    for path in sorted(folder.rglob("*.zip")):
        if stem not in path.name:
            continue
        members = files.read_members(path, lambda name: name.lower().endswith(suffixes))
        for member, data in members:
            found = True
            name = PurePosixPath(member.replace("\\", "/")).name
            _claim(places, name, f"{path}/{member}", unique)
            yield f"{path}/{member}", data
    if not found:
        raise FileNotFoundError(
            f"{str(folder)!r} has neither files *{', *'.join(suffixes)} nor a zip with "
            f"them{f' named {stem}' if stem else ''}"
        )


def prepare(
    builder: tfds.core.DatasetBuilder,
    manual_dir: str | os.PathLike,
    *,
    overwrite: bool = False,
) -> tfds.core.DatasetBuilder:
    """Reads the published files into the builder's folder, unless it is there.

    The builder was made with `file_format="array_record"`; with `overwrite` the files
    are read again. Several processes may do so at a time.

    `FileNotFoundError` if the folder or its files are missing, `OSError` if the
    builder's cannot be written, as on a full disk; a `ValueError` names a malformed
    file.
    """
    folder = Path(manual_dir)
    if not folder.is_dir() or not any(folder.iterdir()):
        problem = "is empty" if folder.is_dir() else "does not exist"
        raise FileNotFoundError(
            f"the folder {str(folder)!r} {problem}. "
            f"{builder.MANUAL_DOWNLOAD_INSTRUCTIONS}"
        )
    modes = tfds.download.GenerateMode
    mode = modes.REUSE_CACHE_IF_EXISTS if overwrite else modes.REUSE_DATASET_IF_EXISTS
    config = tfds.download.DownloadConfig(
        manual_dir=os.fspath(manual_dir), download_mode=mode
    )
    read = functools.partial(builder.download_and_prepare, download_config=config)
    try:
        read()
    except RuntimeError as error:  # as the writer of array_record says it
        line = str(error).splitlines()[0]
        raise OSError(f"cannot write {builder.data_path}: {line}") from error
    except OSError:
        if overwrite or not builder.is_prepared():
            raise
        read()  # another process was faster
    return builder


def read_text(path: str, data: bytes) -> str:
    """Content of a text file; a `ValueError` names one that is no UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not UTF-8 text (byte {error.start})") from None


def _word(value) -> str:
    """Text of a data source, which comes as bytes."""
    return value.decode() if isinstance(value, bytes) else str(value)


def read_records(builder: MotionBuilder) -> list[dict]:
    """Features of each clip of a prepared builder, sorted by name."""
    records = builder.as_data_source(split="train")  # pyright: ignore[reportCallIssue]
    return sorted(records, key=lambda r: r["name"])


def clips_from_source(builder: MotionBuilder, *, tolerance: float = 1e-3) -> Clips:
    """All clips of a prepared builder, sorted by name.

    Offsets of skeletons may differ by the tolerance, meters; a `ValueError` names two
    clips with other skeletons or rates.
    """
    return clips_from_records(builder, read_records(builder), tolerance=tolerance)


def clips_from_records(
    builder: MotionBuilder, records: Sequence[Mapping], *, tolerance: float
) -> Clips:
    """Clips of what `read_records` read, in that order; see `clips_from_source`."""
    skeletons, motions = [], []
    for record in records:
        skeletons.append(
            Skeleton(
                offsets=jnp.asarray(record["offsets"]),
                parents=tuple(int(parent) for parent in record["parents"]),
                names=tuple(_word(record["joint_names"]).split("\n")),
                feet=tuple(int(foot) for foot in record["feet"]),
            )
        )
        motions.append(
            Motion(
                root_position=jnp.asarray(record["root_position"]),
                joint_rotation=jnp.asarray(record["joint_rotation"]),
                fps=float(record["fps"]),
            )
        )
    return clips_from_motions(
        motions,
        skeletons,
        names=[_word(record["name"]) for record in records],
        labels={
            field: [_word(record[field]) for record in records]
            for field in builder.LABELS
        },
        label_names=builder.label_names,
        source=builder.source,
        tolerance=tolerance,
    )
