import dataclasses
import os

import jax
import numpy as np
import pytest

from jaxmotion.data import text_files, text_motion

WIDTH = 5
LENGTHS = (9, 30, 17, 12)
SPLITS = ("train", "train", "test", "train")
# One, three, one and two captions.
CAPTIONS = [
    [(f"clip {clip} text {k}", f"clip/NOUN {k}/NUM") for k in range(count)]
    for clip, count in enumerate((1, 3, 1, 2))
]


def frames(width=WIDTH):
    """Clips whose first feature is the clip and the second the frame."""
    generator = np.random.default_rng(0)
    clips = [generator.normal(size=(n, width)).astype(np.float32) for n in LENGTHS]
    for number, clip in enumerate(clips):
        clip[:, 0], clip[:, 1] = number, np.arange(len(clip))
    return clips


def motions(**changes):
    options = {
        "mean": np.arange(WIDTH) - 2.0,
        "std": np.arange(WIDTH) + 1.0,
        "fps": 20.0,
        "source": "made up (no license)",
    }
    rest = {
        "features": frames(),
        "captions": CAPTIONS,
        "splits": SPLITS,
        "names": [f"c{i}" for i in range(4)],
    }
    given = {**rest, **options, **changes}
    order = [given.pop(name) for name in rest]
    return text_motion.text_motions(*order, **given)


def test_clips_and_captions_lie_behind_each_other():
    found = motions()
    assert (found.num_clips, found.num_features, found.fps) == (4, WIDTH, 20.0)
    np.testing.assert_array_equal(found.offsets, [0, 9, 39, 56, 68])
    np.testing.assert_array_equal(found.features[39:56], frames()[2])
    np.testing.assert_array_equal(found.caption_clip, [0, 1, 1, 1, 2, 3, 3])
    assert found.captions[3] == "clip 1 text 2"
    assert found.tokens[3] == "clip/NOUN 2/NUM"
    np.testing.assert_array_equal(found.split, [0, 0, 2, 0])
    np.testing.assert_array_equal(found.clips_of("train"), [0, 1, 3])
    assert found.clips_of("val").size == 0
    with pytest.raises(ValueError, match="unknown split 'dev': there are train, val"):
        found.clips_of("dev")


# The groups of 263 features: 22 joints.
GROUPS = np.cumsum([0, 1, 2, 1, 63, 126, 66, 4])


def test_statistics_of_the_training_clips_are_averaged_within_groups():
    clips = [clip * np.float32(3) + np.float32(50) for clip in frames(263)]
    clips[2][:] += 1000.0  # the test clip does not count
    found = motions(features=clips, mean=None, std=None)
    train = np.concatenate([clips[i] for i in (0, 1, 3)]).astype(np.float64)
    std = train.std(0)
    for start, stop in zip(GROUPS[:-1], GROUPS[1:], strict=True):
        std[start:stop] = std[start:stop].mean()
    np.testing.assert_allclose(found.mean, train.mean(0), rtol=1e-6)
    np.testing.assert_allclose(found.std, std, rtol=1e-6)
    assert np.unique(found.std[4:67]).size == 1 and found.std[0] != found.std[3]


def test_groups_that_never_change_are_named():
    clips = frames(251)
    for clip in clips:
        clip[:, 3] = 0.9
    with pytest.raises(ValueError, match="'root_height', channels 3..3, never"):
        motions(features=clips, mean=None, std=None)


NAN = [c.copy() for c in frames()]
NAN[1][7, 2] = np.nan
BAD = {
    "no clips": ({"features": []}, "no clips"),
    "other numbers": ({"splits": SPLITS[:3]}, "3 splits for 4 clips"),
    "same names": ({"names": ["a", "b", "b", "c"]}, "2 clips have the name 'b'"),
    "width": ({"features": [*frames()[:3], np.ones((9, 4))]}, r"'c3'.*\(9, 4\)"),
    "no frames": ({"features": [*frames()[:3], np.ones((0, 5))]}, r"'c3'.*\(0, 5\)"),
    "nan": ({"features": NAN}, "clip 'c1': frame 7 is not finite"),
    "no caption": ({"captions": [*CAPTIONS[:3], []]}, "'c3' lacks a caption"),
    "no tokens": ({"captions": [*CAPTIONS[:3], [("a", "")]]}, "'c3' lacks a caption"),
    "split": ({"splits": ("train",) * 3 + ("dev",)}, "'c3': unknown split 'dev'"),
    "rate": ({"fps": 0.0}, "fps should be positive, found 0"),
    "one of two": ({"std": None}, "both mean and std, or neither"),
    "zero": (
        {"std": np.array([1.0, 0, 1, 0, 1])},
        r"std: channels \[1, 3\] are not po",
    ),
    "length": ({"mean": np.ones(4)}, r"mean: expected 5 numbers, found shape \(4,\)"),
    "not finite": ({"mean": NAN[1][7]}, r"mean: channels \[2\] are not finite"),
    "no layout": ({"mean": None, "std": None}, r"5 features.*\[251, 263\]"),
    "no train": (
        {"mean": None, "std": None, "splits": ("val",) * 4},
        "no clip of split 'train'",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_named(case):
    changes, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        motions(**changes)


@pytest.fixture
def saved(tmp_path):
    text_motion.save_text_motions(tmp_path / "new" / "m.npz", motions())
    return tmp_path / "new" / "m.npz"


def test_round_trip_is_exact_and_leaves_one_file(saved):
    expected, found = motions(), text_motion.load_text_motions(saved)
    for field in dataclasses.fields(expected):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        assert type(a) is type(b)
        np.testing.assert_array_equal(a, b)
        assert getattr(a, "dtype", None) == getattr(b, "dtype", None)
    assert os.listdir(saved.parent) == ["m.npz"]


def test_missing_damaged_and_foreign_files_are_named(saved, tmp_path):
    load = text_motion.load_text_motions
    with pytest.raises(FileNotFoundError, match="no text motions file .*none.npz"):
        load(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match="other.npz: not a text motions.*weights"):
        load(tmp_path / "other.npz")
    saved.write_bytes(saved.read_bytes()[:-30])
    with pytest.raises(ValueError, match="m.npz: not a text motions file, or a"):
        load(saved)


FIELDS = {
    "version": (np.array(2), "version 2.*expected 1"),
    "tokens": (None, "field 'tokens' is missing"),
    "offsets": (np.array(["a"]), "field 'offsets' should have 1 axes of kind 'i'"),
    "std": (np.zeros(WIDTH), r"field 'std': channels \[0, 1, 2, 3, 4\] are not posit"),
    "features": (np.full((68, 5), np.nan), r"'features' is not a finite.* at \[0, 0\]"),
    "float64 1e300": (np.full((68, 5), 1e300), r"'features' is not a finite float32"),
    "captions": (np.array(["a"]), "field 'tokens' has 7 entries, expected 1"),
    "caption_clip": (np.arange(7), "'caption_clip' should ascend.* 4 clips"),
    "split": (np.array([0, 0, 3, 0]), r"'split' should be in 0\.\.2, found 0\.\.3"),
    "fps": (np.array(-1.0), "field 'fps' should be in"),
    "mean": (np.ones(3), "field 'mean': expected 5 numbers"),
}


@pytest.mark.parametrize("field", FIELDS)
def test_inconsistent_fields_are_named(saved, field):
    value, message = FIELDS[field]
    with np.load(saved) as file:
        fields = {name: file[name] for name in file.files}
    changes = {"features" if "1e300" in field else field: value}
    fields = {k: v for k, v in {**fields, **changes}.items() if v is not None}
    np.savez(saved, **fields)
    with pytest.raises(ValueError, match=f"m.npz.*{message}"):
        text_motion.load_text_motions(saved)


@pytest.mark.parametrize(
    ("offsets", "message"),
    [
        ([0, 9, 39, 56, 60], "'offsets' should run from 0 to 68"),
        ([0, 9, 9, 56, 68], "'offsets': clip 1 has no frames"),
    ],
)
def test_clips_without_frames_are_named(saved, offsets, message):
    with np.load(saved) as file:
        fields = {name: file[name] for name in file.files}
    np.savez(saved, **{**fields, "offsets": np.array(offsets)})
    with pytest.raises(ValueError, match=message):
        text_motion.load_text_motions(saved)


LINES = """a man, waving.#a/DET man/NOUN wave/VERB#0.0#0.0

he walks back #he/PRON  walk/VERB back/ADV#2.0#4.5
both hands#both/DET hand/NOUN#nan#nan
"""


def test_caption_files_are_parsed():
    found = text_files.parse_captions(LINES, path="t.txt")
    assert found == [
        ("a man, waving.", "a/DET man/NOUN wave/VERB", 0.0, 0.0, 1),
        ("he walks back", "he/PRON walk/VERB back/ADV", 2.0, 4.5, 3),
        ("both hands", "both/DET hand/NOUN", 0.0, 0.0, 4),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "t.txt: no captions"),
        ("\n \n", "t.txt: no captions"),
        (
            "\na man waves",
            "t.txt, line 2: expected caption#word.*1 fields: 'a man waves",
        ),
        ("a#b/NOUN#0.0", "t.txt, line 1: expected caption.*3 fields"),
        ("a#b/NOUN#0#0#0", "t.txt, line 1: expected caption.*5 fields"),
        ("#b/NOUN#0#0", "line 1: the caption is empty"),
        ("a##0#0", "line 1: expected words as word/POS, found ''"),
        ("a#b/NOUN c#0#0", "line 1: expected words as word/POS, found 'c'"),
        ("a#b/c/NOUN#0#0", "line 1: expected words as word/POS, found 'b/c/NOUN'"),
        ("a#b/NOUN#x#0", "line 1: start: expected seconds, found 'x'"),
        ("a#b/NOUN#0#-1", "line 1: end: expected seconds, found '-1'"),
        ("a#b/NOUN#0#inf", "line 1: end: expected seconds, found 'inf'"),
    ],
)
def test_caption_files_that_are_wrong_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        text_files.parse_captions(text, path="t.txt")


def cut(num_frames, text, **changes):
    features = np.arange(num_frames, dtype=np.float32)[:, None]
    options = {"cut_fps": 20.0, "min_frames": 40, "max_frames": 199, **changes}
    captions = text_files.parse_captions(text, path="t.txt")
    found = text_files.cut_recording("r", features, captions, **options)
    return [(n, int(f[0, 0]), len(f), [c for c, _ in caps]) for n, f, caps in found]


def test_captions_with_times_are_clips_of_their_own():
    text = "a#a/X#0#0\nb#b/X#1.99#4.51\nc#c/X#0#0\nd#d/X#1#2.95\ne#e/X#1#3\nf#f/X#5#1"
    # 39.8 and 90.2 round down to 39 and 90; d has 39 frames, f none.
    expected = [("r", 0, 120, ["a", "c"]), ("r_line2", 39, 51, ["b"])]
    expected += [("r_line5", 20, 40, ["e"])]
    assert cut(120, text) == expected
    # Times after the end stop there.
    assert cut(120, "b#b/X#3#99") == [("r_line1", 60, 60, ["b"])]
    # KIT-ML's own rate.
    assert cut(120, "b#b/X#2#4", cut_fps=12.5, min_frames=24) == [
        ("r_line1", 25, 25, ["b"])
    ]


@pytest.mark.parametrize(("frames", "kept"), [(39, 0), (40, 1), (199, 1), (200, 0)])
def test_recordings_of_the_wrong_length_go_with_their_parts(frames, kept):
    assert len(cut(frames, "a#a/X#0#0")) == kept
    assert len(cut(200, "a#a/X#0#0\nb#b/X#0#5")) == 0


MAX_FRAMES = 16


def arrays(**changes):
    options = {"split": "train", "max_frames": MAX_FRAMES, **changes}
    return text_motion.text_arrays(motions(), **options)


@pytest.fixture(scope="module")
def drawn():
    batch = text_motion.sample_text_batch(jax.random.key(3), arrays(), batch=4000)
    features, length, caption = (np.asarray(x) for x in batch)
    raw = features * motions().std + motions().mean
    return features, raw, length, caption


def test_samples_are_crops_of_the_clip_of_their_caption(drawn):
    features, raw, length, caption = drawn
    assert features.shape == (4000, MAX_FRAMES, WIDTH)
    clip = motions().caption_clip[caption]
    assert set(clip.tolist()) == {0, 1, 3}
    clips = frames()
    for i in range(0, 4000, 7):
        start, n = round(float(raw[i, 0, 1])), length[i]
        expected = clips[clip[i]][start : start + n]
        assert expected.shape[0] == n
        np.testing.assert_allclose(raw[i, :n], expected, atol=1e-4)
        assert not features[i, n:].any()


def z_scores(counts, probabilities):
    counts, p = np.asarray(counts), np.asarray(probabilities)
    n = counts.sum()
    return (counts - n * p) / np.sqrt(n * p * (1 - p))


def test_clips_then_captions_are_uniform(drawn):
    _, _, _, caption = drawn
    counts = np.bincount(caption, minlength=7)
    assert counts[4] == 0  # the test clip's
    p = np.array([3, 1, 1, 1, 1.5, 1.5]) / 9
    assert np.abs(z_scores(np.delete(counts, 4), p)).max() < 3.5


def test_lengths_are_units_and_a_third_is_one_shorter(drawn):
    _, _, length, caption = drawn
    clip = motions().caption_clip[caption]
    # 9, 30 (cropped to 16) and 12 frames.
    for number, longest in ((0, 8), (1, 16), (3, 12)):
        counts = np.bincount(length[clip == number], minlength=longest + 1)
        assert counts[longest - 4] + counts[longest] == (clip == number).sum()
        assert abs(z_scores(counts[[longest - 4, longest]], [1 / 3, 2 / 3])[0]) < 3.5


def test_crops_start_anywhere(drawn):
    _, raw, length, caption = drawn
    clip = motions().caption_clip[caption]
    for n in (12, 16):
        starts = np.round(raw[(clip == 1) & (length == n), 0, 1]).astype(int)
        counts = np.bincount(starts, minlength=31 - n)
        assert counts.size == 31 - n
        assert np.abs(z_scores(counts, np.full(31 - n, 1 / (31 - n)))).max() < 3.5


def test_a_clip_of_one_unit_keeps_it():
    found = arrays(unit_length=9)
    _, length, _ = text_motion.sample_text_batch(jax.random.key(0), found, batch=64)
    assert set(np.asarray(length).tolist()) == {9}


def test_one_compile_serves_all_keys():
    traces = []

    @jax.jit
    def sample(key, found):
        traces.append(key)
        return text_motion.sample_text_batch(key, found, batch=8)

    found = arrays()
    a, b = (sample(jax.random.key(seed), found)[0] for seed in (0, 1))
    assert len(traces) == 1 and np.abs(np.asarray(a - b)).max() > 0.1
    eager = text_motion.sample_text_batch(jax.random.key(0), found, batch=8)[0]
    np.testing.assert_allclose(eager, a, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "val"}, "no clip of split 'val'"),
        ({"split": "dev"}, "unknown split 'dev'"),
        ({"unit_length": 10}, "clip 'c0' has 9 frames.*unit of 10"),
        ({"unit_length": 0}, "0 < unit_length <= max_frames, found unit_length 0"),
        ({"max_frames": 3}, "found unit_length 4 and max_frames 3"),
    ],
)
def test_bad_settings_of_arrays_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        arrays(**changes)
