import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import mirror, selection
from jaxmotion.data.clips import clip_motion, clips_from_motions, take_clips
from tests.data import samples


def build(motions=None, skeletons=None, **changes):
    motions = motions or [samples.motion(3, 0), samples.motion(4, 1)]
    options = {"names": ["a", "b"], "labels": {"style": ["x", "y"]}, **changes}
    return clips_from_motions(motions, skeletons or samples.skeleton(), **options)


def test_clips_hold_the_frames_of_the_motions_in_order():
    clips = samples.clips()
    lengths = [3 + i for i in range(8)]
    assert (clips.num_clips, clips.num_frames) == (8, sum(lengths))
    np.testing.assert_array_equal(clips.offsets, np.cumsum([0, *lengths]))
    for i in range(8):
        expected, found = samples.motion(3 + i, i), clip_motion(clips, i)
        np.testing.assert_array_equal(found.root_position, expected.root_position)
        np.testing.assert_array_equal(found.joint_rotation, expected.joint_rotation)
    assert clips.names("style") == ("young", "old", "unused")
    assert clips.names("content") == ("turn-left", "walk")
    np.testing.assert_array_equal(clips.labels["style"], [1, 0] * 4)
    with pytest.raises(ValueError, match="clip 8 of 8"):
        clip_motion(clips, 8)


def test_clips_go_through_jit_as_a_pytree():
    clips = samples.clips()
    doubled = jax.jit(lambda c: jax.tree.map(lambda x: x * 2, c))(clips)
    np.testing.assert_array_equal(doubled.root_position, clips.root_position * 2)
    assert doubled.clip_names == clips.clip_names


def test_different_skeletons_are_refused_with_both_clips_named():
    base = samples.skeleton()
    near = dataclasses.replace(base, offsets=base.offsets.at[3, 1].add(0.9e-3))
    far = dataclasses.replace(base, offsets=base.offsets.at[3, 1].add(1.5e-3))
    clips = build(skeletons=[base, near])
    np.testing.assert_allclose(
        clips.skeleton.offsets[3, 1], base.offsets[3, 1] + 0.45e-3, atol=1e-6
    )
    with pytest.raises(ValueError, match="'a' and 'b'.*'LeftToe' differs by 0.0015"):
        build(skeletons=[base, far])
    assert build(skeletons=[base, far], tolerance=0.01).num_clips == 2
    renamed = dataclasses.replace(base, names=("Pelvis", *base.names[1:]))
    with pytest.raises(ValueError, match="'a' and 'b'.*names"):
        build(skeletons=[base, renamed])


def test_bad_motions_and_labels_are_refused_by_name():
    short, nan = samples.motion(3, 0), samples.motion(4, 1)
    nan = dataclasses.replace(nan, root_position=nan.root_position.at[2, 0].set(np.nan))
    with pytest.raises(ValueError, match="clip 'b': root_position of frame 2 is NaN"):
        build([short, nan])
    with pytest.raises(ValueError, match="'a' and 'b'.*30 and 60"):
        build([short, samples.motion(4, 1, fps=60.0)])
    with pytest.raises(ValueError, match="clip 'b' has 5 joints, the skeleton 6"):
        build([short, samples.motion(4, 1, num_joints=5)])
    with pytest.raises(ValueError, match="clip 'b' is not one clip"):
        build([short, samples.motion(0, 1)])
    with pytest.raises(ValueError, match="1 names for 2"):
        build(names=["a"])
    with pytest.raises(ValueError, match="3 style for 2"):
        build(labels={"style": ["x", "y", "z"]})
    with pytest.raises(ValueError, match="clip 'b': unknown style 'y', expected.*x"):
        build(label_names={"style": ("x",)})
    with pytest.raises(ValueError, match="no clips"):
        clips_from_motions([], samples.skeleton(), names=[], labels={})


def test_take_keeps_frames_and_labels_together():
    clips = samples.clips()
    taken = take_clips(clips, [6, 1])
    assert taken.clip_names == ("clip6", "clip1")
    np.testing.assert_array_equal(
        clip_motion(taken, 1).root_position, clip_motion(clips, 1).root_position
    )
    np.testing.assert_array_equal(taken.labels["style"], [1, 0])
    for wrong in ([8], [-1], []):
        with pytest.raises(ValueError, match="clip"):
            take_clips(clips, wrong)


def test_select_by_label_and_unknown_labels():
    clips = samples.clips()
    old = selection.select(clips, "style", ["old"])
    assert old.clip_names == ("clip0", "clip2", "clip4", "clip6")
    assert old.names("style") == clips.names("style")
    both = selection.select(clips, "style", ["old", "young"])
    np.testing.assert_array_equal(both.root_position, clips.root_position)
    with pytest.raises(ValueError, match="unknown style 'gone'.*young, old, unused"):
        selection.select(clips, "style", ["old", "gone"])
    with pytest.raises(ValueError, match="unknown label field 'mood'.*style, content"):
        selection.select(clips, "mood", ["old"])
    with pytest.raises(ValueError, match="no clip has style unused"):
        selection.select(clips, "style", ["unused"])


def test_relabel_leaves_only_labels_that_occur():
    old = selection.relabel(
        selection.select(samples.clips(), "style", ["old"]), "style"
    )
    assert old.names("style") == ("old",)
    np.testing.assert_array_equal(old.labels["style"], [0, 0, 0, 0])
    assert old.names("content") == ("turn-left", "walk")


def labels_of(clips, field):
    return [clips.names(field)[i] for i in np.asarray(clips.labels[field])]


def test_merged_labels_are_one_and_the_old_word_is_gone():
    clips = samples.clips()
    found = selection.merge_labels(clips, "content", {"turn-left": "walk"})
    assert found.names("content") == ("walk",)
    assert labels_of(found, "content") == ["walk"] * 8
    # Frames and other fields stay.
    assert labels_of(found, "style") == labels_of(clips, "style")
    np.testing.assert_array_equal(found.root_position, clips.root_position)
    found = selection.merge_labels(clips, "style", {"old": "unused", "young": "unused"})
    assert labels_of(found, "style") == ["unused"] * 8


def test_merging_nothing_only_drops_labels_that_no_clip_has():
    clips = samples.clips()
    found = selection.merge_labels(clips, "style", {})
    assert found.names("style") == ("young", "old")
    assert labels_of(found, "style") == labels_of(clips, "style")


@pytest.mark.parametrize(
    ("field", "merge", "message"),
    [
        ("style", {"ancient": "old"}, "unknown style 'ancient'.*young, old, unused"),
        ("style", {"old": "ancient"}, "unknown style 'ancient'.*young, old, unused"),
        ("mood", {"old": "young"}, "unknown label field 'mood'.*style, content"),
    ],
)
def test_labels_that_cannot_be_merged_are_named(field, merge, message):
    with pytest.raises(ValueError, match=message):
        selection.merge_labels(samples.clips(), field, merge)


def test_frequent_labels_are_counted_in_clips():
    clips = samples.clips()
    for least, expected in (
        (0, ("young", "old", "unused")),
        (1, ("young", "old")),
        (4, ("young", "old")),
        (5, ()),
    ):
        assert selection.frequent_labels(clips, "style", least=least) == expected
    assert selection.frequent_labels(clips, "content", least=4) == ("walk",)
    with pytest.raises(ValueError, match="unknown label field 'mood'"):
        selection.frequent_labels(clips, "mood", least=1)


@pytest.mark.parametrize("fraction", [0.01, 0.25, 0.5, 0.99])
def test_split_is_a_stratified_partition(fraction):
    clips = samples.clips()
    train, held_out = selection.split_clips(clips, fraction=fraction, seed=3)
    names = train.clip_names + held_out.clip_names
    assert sorted(names) == sorted(clips.clip_names)
    count = min(max(round(4 * fraction), 1), 3)
    np.testing.assert_array_equal(np.bincount(held_out.labels["style"]), [count] * 2)


def renamed(clips, names):
    return dataclasses.replace(clips, clip_names=tuple(names))


def test_images_and_loops_of_held_out_clips_are_not_learned_from():
    clips = samples.clips()
    loops = renamed(clips, [f"{name}_loop3x1.12" for name in clips.clip_names])
    plain = selection.split_clips(clips, fraction=0.3, seed=3)
    more = mirror.with_mirrored(selection.concatenate([clips, loops]))
    assert more.num_clips == 4 * clips.num_clips
    by_name = selection.split_by_name(more, ("clip5", "clip2_mirrored"))
    by_chance = selection.split_clips(more, fraction=0.3, seed=3)
    for held, split in (
        (("clip2", "clip5"), by_name),
        (plain[1].clip_names, by_chance),
    ):
        images = [f"{name}_mirrored" for name in held]
        assert sorted(split[1].clip_names) == sorted([*held, *images])
        assert not {*held} & {selection.original(x) for x in split[0].clip_names}
        assert split[0].num_clips == 4 * (clips.num_clips - len(held))
    cut = selection.cut(more, [(0, 1, 3), (17, 1, 3)])
    assert [*map(selection.original, cut.clip_names)] == ["clip0@1+3", "clip1@1+3"]
    with pytest.raises(ValueError, match="no clip named 'clip0_loop3x1.12'"):
        selection.split_by_name(more, ("clip0_loop3x1.12",))


def test_split_depends_on_the_seed_only():
    def held_out(seed):
        split = selection.split_clips(samples.clips(), fraction=0.5, seed=seed)
        return split[1].clip_names

    assert held_out(0) == held_out(0)
    assert len({held_out(seed) for seed in range(8)}) > 1
    for fraction in (0.0, 1.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="fraction"):
            selection.split_clips(samples.clips(), fraction=fraction, seed=0)
    single = take_clips(samples.clips(), [0, 1])
    with pytest.raises(ValueError, match="no style has two clips, expected one to tr"):
        selection.split_clips(single, fraction=0.5, seed=0)


def test_split_by_name():
    clips = samples.clips()
    train, held_out = selection.split_by_name(clips, ("clip5", "clip2"))
    assert held_out.clip_names == ("clip2", "clip5")
    assert sorted(train.clip_names + held_out.clip_names) == sorted(clips.clip_names)
    with pytest.raises(ValueError, match="no clip named 'clip9': the clips are clip0"):
        selection.split_by_name(clips, ("clip9",))
    with pytest.raises(ValueError, match="all clips are held out"):
        selection.split_by_name(clips, clips.clip_names)


def test_concatenate_merges_labels_by_name():
    clips = samples.clips()
    other = build(
        labels={"style": ["old", "new"], "content": ["walk", "walk"]}, source="two"
    )
    both = selection.concatenate([clips, other])
    assert both.names("style") == ("young", "old", "unused", "new")
    np.testing.assert_array_equal(both.labels["style"], [1, 0] * 4 + [1, 3])
    np.testing.assert_array_equal(both.labels["content"][-2:], [1, 1])
    assert both.source == "made up (no license); two"
    assert both.clip_names[-2:] == ("a", "b")
    for i in (7, 8, 9):
        part, j = (clips, i) if i < 8 else (other, i - 8)
        np.testing.assert_array_equal(
            clip_motion(both, i).joint_rotation, clip_motion(part, j).joint_rotation
        )


def test_concatenate_refuses_other_fields_rates_and_skeletons():
    clips = samples.clips()
    labels = {"style": ["old", "old"], "content": ["walk", "walk"]}
    with pytest.raises(ValueError, match="label fields differ"):
        selection.concatenate([clips, build()])
    other = dataclasses.replace(build(labels=labels), fps=60.0)
    with pytest.raises(ValueError, match="rates differ"):
        selection.concatenate([clips, other])
    moved = samples.skeleton(jnp.array(samples.PLAIN) * 1.1)
    with pytest.raises(ValueError, match="'clip0' and 'a'"):
        selection.concatenate([clips, build(skeletons=moved, labels=labels)])
    with pytest.raises(ValueError, match="no clips"):
        selection.concatenate([])


def test_clips_without_names_are_called_by_their_numbers():
    plain = dataclasses.replace(samples.clips(), clip_names=())
    names = [f"clip {i}" for i in range(plain.num_clips)]
    assert take_clips(plain, [1]).clip_names == (names[1],)
    both = selection.concatenate([plain, plain])
    assert list(both.clip_names) == [*names, *names]
