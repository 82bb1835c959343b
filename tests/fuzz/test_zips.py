"""Zips of published files, and what the builders make of the files in them."""

import io
import json
import pickle
import zipfile

import numpy as np
import pytest

from jaxmotion import files
from jaxmotion.data import plain_pickle
from jaxmotion.data.builders import ballplay as ballplays
from jaxmotion.data.builders import bandai_namco, base, lafan1, style100
from jaxmotion.data.builders import soccer_x as soccers
from tests.data import test_builders
from tests.data.builders import test_ballplay, test_soccer_x
from tests.fuzz import harness, mutations

pytestmark = pytest.mark.slow
INPUTS = {"zips": 700, "sets": 240, "ids": 300, "tables": 300, "pickles": 500}


def zipped(contents, method=zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def test_zips(tmp_path, capsys):
    path = tmp_path / "x.zip"
    contents = {"a/one.bvh": test_builders.lafan_text(0), "a/b/two.bvh": b"", "c": "x"}
    bases = [zipped(contents), zipped(contents, zipfile.ZIP_STORED)]

    def confirm(data, found):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            expected = {name: archive.read(name) for name in archive.namelist()}
        assert dict(found) == expected

    target = harness.Target(
        "zips",
        lambda _: list(files.read_members(path, lambda name: True)),
        confirm,
        names=("x.zip",),
    )
    for seed in range(INPUTS["zips"]):
        random = np.random.default_rng(seed)
        data = mutations.mutate_bytes(random, bases[seed % 2])
        path.write_bytes(data)
        target.feed(f"seed {seed}", data)
    target.report(capsys.disabled, accepted=5, refused=20)


class Examples:
    """The examples of a builder without the files of tensorflow-datasets."""

    def __init__(self, cls, config):
        self.cls, self.config = cls, config

    def __call__(self, folder, tmp_path):
        builder = self.cls(
            config=self.config, data_dir=str(tmp_path), file_format="array_record"
        )
        return list(base._unique(builder._generate_examples(folder)))


SETS = {
    "bandai": (Examples(bandai_namco.BandaiNamco, "2"), test_builders.bandai_files()),
    "lafan1": (
        Examples(lafan1.Lafan1, None),
        {f"walk{i}_subject5.bvh": test_builders.lafan_text(i) for i in range(2)},
    ),
    "style100": (Examples(style100.Style100, "original"), test_builders.style_files()),
}


def test_published_sets(tmp_path, capsys):
    path = tmp_path / "raw" / "Bandai-Namco-Research-Motiondataset-2-100STYLE.zip"
    path.parent.mkdir()

    def confirm(_, found):
        assert found
        for name, features in found:
            assert features["name"] == name
            for field in ("root_position", "joint_rotation", "offsets"):
                assert np.isfinite(features[field]).all(), field

    target = harness.Target(
        "published sets",
        lambda builder: builder(path.parent, tmp_path / "tfds"),
        confirm,
        names=("raw",),
    )
    for seed in range(INPUTS["sets"]):
        random = np.random.default_rng(seed)
        builder, contents = list(SETS.values())[seed % len(SETS)]
        contents = {name: text.encode() for name, text in contents.items()}
        if seed >= len(SETS):
            name = list(contents)[random.integers(len(contents))]
            data = contents[name].decode()
            contents[name] = mutations.mutate_text(random, data)
        path.write_bytes(zipped(contents))
        target.feed(f"seed {seed}", builder)
    target.report(capsys.disabled, accepted=20, refused=20)


def test_ids_of_bandai_namco(capsys):
    names = {
        "content": bandai_namco._CONTENTS["2"].split(),
        "style": bandai_namco._STYLES["2"].split(),
    }
    ids = {"content": names["content"].index("walk"), "style": 1}
    path = f"dataset-2_walk_{names['style'][1]}_001.json"

    def confirm(data, labels):
        found = json.loads(data)
        assert labels == {k: names[k][int(found[k])] for k in names}

    target = harness.Target(
        "label files",
        lambda data: bandai_namco.read_labels(path, data, names),
        confirm,
        names=(path,),
    )
    for seed in range(INPUTS["ids"]):
        random = np.random.default_rng(seed)
        target.feed(f"seed {seed}", mutations.mutate_json_text(random, ids))
    target.report(capsys.disabled, accepted=10, refused=20)


def test_sets_with_a_ball(capsys, tmp_path):
    test_ballplay.write(tmp_path / "b", test_ballplay.content())
    test_soccer_x.write(
        tmp_path / "s", {"dribble_1.npz": test_soccer_x.sequence(33, 0)}
    )
    ball = next((tmp_path / "b").rglob("*.npz")).read_bytes()
    sequence = next((tmp_path / "s").rglob("dribble_1.npz")).read_bytes()
    bones = next((tmp_path / "s").rglob("skeleton.npz")).read_bytes()
    skeleton = soccers.read_skeleton("skeleton.npz", bones)

    def read_sequence(data):
        return soccers.read_sequence("dribble_x.npz", data, skeleton)[1]

    reads = [
        (ball, lambda data: ballplays.read_fields("x.npz", data)),
        (sequence, read_sequence),
    ]

    def confirm(data, found):
        for name, array in found.items():
            if isinstance(array, np.ndarray) and array.dtype.kind == "f":
                assert np.isfinite(array).all(), name

    for number, (content, read) in enumerate(reads):
        target = harness.Target(
            ("ballplay", "soccer_x")[number], read, confirm, names=("x.npz",)
        )
        for seed in range(INPUTS["tables"]):
            random = np.random.default_rng(seed)
            data = content if seed == 0 else mutations.mutate_npz(random, content)
            target.feed(f"seed {seed}", data)
        target.report(capsys.disabled, accepted=10, refused=20)


def test_pickles(capsys):
    value = {"a": [np.arange(5.0), np.zeros((2, 3), "f4")], "b": [1, "x", None, 2.5]}
    contents = [pickle.dumps(value, protocol) for protocol in (0, 2, 4, 5)]
    plain = (dict, list, tuple, set, str, bytes, bytearray, int, float, complex)

    def confirm(_, found):
        """Nothing but plain values and arrays."""
        allowed = (*plain, np.ndarray, np.generic, np.dtype, type(None))
        assert isinstance(found, allowed), type(found)
        if isinstance(found, dict):
            found = [*found, *found.values()]
        for item in found if isinstance(found, list | tuple | set) else ():
            confirm(_, item)

    target = harness.Target(
        "pickles",
        lambda data: plain_pickle.read_plain_pickle(data, name="x.pkl"),
        confirm,
        names=("x.pkl",),
    )
    for seed in range(INPUTS["pickles"]):
        random = np.random.default_rng(seed)
        target.feed(f"seed {seed}", mutations.mutate_bytes(random, contents[seed % 4]))
    target.report(capsys.disabled, accepted=10, refused=20)
