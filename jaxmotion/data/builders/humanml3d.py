"""HumanML3D and KIT-ML as their publishers lay them out: feature vectors and texts.

    new_joint_vecs/<name>.npy   features [frames, 263 or 251]; mirrored: M<name>.npy
    texts/<name>.txt            captions, see data/text_files.py
    Mean.npy, Std.npy           of each feature
    train.txt, val.txt, test.txt   one name a line

Whole recordings are stored, with their texts as they are; `text_motions_from_source`
cuts and selects them as the released loaders do.
"""

import dataclasses
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import tensorflow_datasets as tfds
from jaxtyping import Float

from jaxmotion.data.text_files import cut_recording, parse_captions, read_array
from jaxmotion.data.text_motion import (
    SPLITS,
    TextMotions,
    check_statistics,
    text_motions,
)

_MAX_FRAMES = 199
_LOG = logging.getLogger(__name__)


@dataclasses.dataclass
class TextConfig(tfds.core.BuilderConfig):
    """One of the two sets.

    Attributes:
      num_features: Numbers in a feature vector.
      min_frames: Fewest frames of a clip.
      source: Name of the set and its license.
    """

    num_features: int = 0
    fps: float = 0.0
    min_frames: int = 0
    source: str = ""


class HumanML3D(tfds.core.GeneratorBasedBuilder, skip_registration=True):
    """Recordings of people with captions, as HumanML3D feature vectors."""

    name = "humanml3d"
    VERSION = tfds.core.Version("1.0.0")
    RELEASE_NOTES = {"1.0.0": "First version."}
    builder_config: TextConfig  # one of these, as tfds sets it
    BUILDER_CONFIGS = [
        TextConfig(
            name="humanml3d",
            description="HumanML3D.",
            num_features=263,
            fps=20.0,
            min_frames=40,
            source="HumanML3D (motions under the licenses of AMASS and HumanAct12)",
        ),
        TextConfig(
            name="kit_ml",
            description="KIT Motion-Language.",
            num_features=251,
            fps=12.5,
            min_frames=24,
            source="KIT Motion-Language Dataset (terms of its publishers)",
        ),
    ]
    MANUAL_DOWNLOAD_INSTRUCTIONS = (
        "Put new_joint_vecs/, texts/, Mean.npy, Std.npy, train.txt, val.txt and "
        "test.txt, or a folder with them, into the folder."
    )
    HOMEPAGE = "https://github.com/EricGuo5513/HumanML3D"

    def _info(self) -> tfds.core.DatasetInfo:
        config = self.builder_config
        features = {
            "features": tfds.features.Tensor(
                shape=(None, config.num_features), dtype=np.float32
            ),
            "name": tfds.features.Text(),
            "texts": tfds.features.Text(),
        }
        return tfds.core.DatasetInfo(
            builder=self,
            description=f"{config.source}: {type(self).__doc__}",
            features=tfds.features.FeaturesDict(features),
            homepage=self.HOMEPAGE,
            metadata=tfds.core.MetadataDict(),
        )

    def _split_generators(self, dl_manager):
        folder = _find_folder(Path(dl_manager.manual_dir))
        num_features = self.builder_config.num_features
        mean, std = _read_statistics(folder, num_features)
        found = tfds.core.MetadataDict(mean=mean.tolist(), std=std.tolist())
        self.info.metadata.update(found)  # pyright: ignore[reportOptionalMemberAccess]
        names = _read_lists(folder)
        return {
            split: self._generate_examples(folder, names[split]) for split in SPLITS
        }

    def _generate_examples(
        self, folder: Path, names: list[str]
    ) -> Iterator[tuple[str, dict]]:
        """One record a recording; those with NaN are left out and named."""
        dropped = []
        for name in names:
            texts = _read_text(folder / "texts" / f"{name}.txt")
            parse_captions(texts, path=str(folder / "texts" / f"{name}.txt"))
            path = folder / "new_joint_vecs" / f"{name}.npy"
            features = read_array(path)
            width = self.builder_config.num_features
            if features.ndim != 2 or features.shape[1] != width:
                raise ValueError(
                    f"{path}: expected frames of {width} features, found shape "
                    f"{features.shape}"
                )
            if not np.isfinite(features).all():
                dropped.append(name)
                continue
            yield name, {"features": features, "name": name, "texts": texts}
        if dropped:
            _LOG.warning(
                "%d recordings with NaN dropped: %s", len(dropped), ", ".join(dropped)
            )


def _find_folder(folder: Path) -> Path:
    """The folder itself or the one folder in it that has the published layout."""
    found = [
        path
        for path in (folder, *sorted(folder.iterdir()))
        if (path / "new_joint_vecs").is_dir()
    ]
    if len(found) != 1:
        raise FileNotFoundError(
            f"{folder}: expected new_joint_vecs/ in it or in one folder in it, found "
            f"{len(found)}. {HumanML3D.MANUAL_DOWNLOAD_INSTRUCTIONS}"
        )
    return found[0]


def _read_text(path: Path) -> str:
    """Content of a text file."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not UTF-8 text ({error})") from None


def _read_statistics(
    folder: Path, num_features: int
) -> tuple[Float[np.ndarray, "features"], Float[np.ndarray, "features"]]:
    """Mean.npy and Std.npy, checked."""
    paths = folder / "Mean.npy", folder / "Std.npy"
    mean, std = (read_array(path) for path in paths)
    check_statistics(mean, std, num_features, names=(str(paths[0]), str(paths[1])))
    return mean, std


def _read_lists(folder: Path) -> dict[str, list[str]]:
    """Names in train.txt, val.txt and test.txt; each once, with its features."""
    names: dict[str, list[str]] = {}
    owner: dict[str, str] = {}
    for split in SPLITS:
        path = folder / f"{split}.txt"
        lines = _read_text(path).splitlines()
        names[split] = [line.strip() for line in lines if line.strip()]
        if not names[split]:
            raise ValueError(f"{path}: no names")
        missing = []
        for number, name in enumerate(map(str.strip, lines), start=1):
            if name and name in owner:
                raise ValueError(
                    f"{path}, line {number}: {name!r} is also in {owner[name]}"
                )
            owner[name] = f"{split}.txt, line {number}"
            if name and not (folder / "new_joint_vecs" / f"{name}.npy").is_file():
                missing.append(f"{name} (line {number})")
        if missing:
            raise ValueError(
                f"{path}: {len(missing)} names have no file in new_joint_vecs: "
                f"{', '.join(missing[:10])}{', ...' if len(missing) > 10 else ''}"
            )
    return names


def text_motions_from_source(
    builder: tfds.core.DatasetBuilder, *, cut_fps: float = 20.0
) -> TextMotions:
    """All clips of a prepared builder, selected as the released loaders do.

    Kept are recordings of 40 to 199 frames (KIT-ML: 24 to 199) and, as clips of their
    own, the parts of them that captions with times cut out, if they are as long. They
    come split by split, sorted by name.

    Times of captions become frames by `cut_fps`. The released loaders take 20 for both
    sets; KIT-ML's own rate is 12.5. `ValueError` if no clip is left.

    Source: the data loader released with T2M.
    """
    config = cast(TextConfig, builder.builder_config)
    clips, splits = [], []
    for split in SPLITS:
        records = builder.as_data_source(split=split)  # pyright: ignore[reportCallIssue]
        for record in sorted(records, key=lambda r: r["name"]):
            name = record["name"].decode()
            clips += cut_recording(
                name,
                record["features"],
                parse_captions(record["texts"].decode(), path=f"texts/{name}.txt"),
                cut_fps=cut_fps,
                min_frames=config.min_frames,
                max_frames=_MAX_FRAMES,
            )
            splits += [split] * (len(clips) - len(splits))
    names, features, captions = zip(*clips, strict=True) if clips else ((), (), ())
    stored: Any = builder.info.metadata or {}
    return text_motions(
        features,
        captions,
        splits,
        names,
        mean=np.array(stored["mean"], np.float32),
        std=np.array(stored["std"], np.float32),
        fps=config.fps,
        source=config.source,
    )
