"""Parts of clips and clips put together: by label, by chance, one set after another."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.clips import Clips, check_skeletons, stretches, take_clips

# What names of clips that show another clip's frames have besides its name.
_LOOP = re.compile(r"_loop\d+x[\d.]+(?=$|[_@#])")
_MIRRORED = re.compile(r"_mirrored(?=$|[_@#])")


def is_loop(name: str) -> bool:
    """Whether a clip so named is a stride, repeated by `loops`."""
    return bool(_LOOP.search(name))


def original(name: str) -> str:
    """Name of the clip whose frames a mirror image, or a repeated stride, shows."""
    return _MIRRORED.sub("", _LOOP.sub("", name))


def _indices(clips: Clips, field: str, names: Sequence[str]) -> list[int]:
    """Indices of those labels; every name must be known."""
    known = clips.names(field)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(
            f"unknown {field} {', '.join(map(repr, unknown))}: the clips have "
            f"{', '.join(known)}"
        )
    return [known.index(name) for name in names]


def select(clips: Clips, field: str, names: Sequence[str]) -> Clips:
    """Clips with one of some labels of a field, in order; label indices stay.

    A `ValueError` lists the known ones if a name is unknown, and says if none is left.
    """
    if isinstance(names, str):
        raise ValueError(f"names should be a sequence of labels, found {names!r}")
    numbers = _indices(clips, field, names)
    keep = np.flatnonzero(np.isin(np.asarray(clips.labels[field]), numbers))
    if keep.size == 0:
        raise ValueError(f"no clip has {field} {', '.join(names)}")
    return take_clips(clips, keep)


def label_field(clips: Clips, labels: Sequence[str]) -> str | None:
    """Field of the clips that has all these labels; None if none has.

    One with these labels alone comes before one that has others as well.
    """
    fields = dict(clips.label_names)
    for field in sorted(fields, key=lambda field: fields[field] != tuple(labels)):
        if labels and {*labels} <= {*fields[field]}:
            return field
    return None


def relabel(clips: Clips, field: str) -> Clips:
    """Renumbers a label field to the labels that occur, in the old order.

    After `select`, a network needs as many label embeddings as labels that occur.
    """
    names = clips.names(field)
    used, compact = np.unique(np.asarray(clips.labels[field]), return_inverse=True)
    label_names = tuple(
        (own, tuple(names[number] for number in used) if own == field else words)
        for own, words in clips.label_names
    )
    labels = {**clips.labels, field: jnp.asarray(compact, jnp.int32)}
    return dataclasses.replace(clips, labels=labels, label_names=label_names)


def merge_labels(clips: Clips, field: str, merge: Mapping[str, str]) -> Clips:
    """Gives clips of some labels another one, for sets that name one thing twice.

    Labels that no clip has any more are gone; a `ValueError` lists the known ones.
    """
    words = clips.names(field)
    numbers = np.arange(len(words))
    for old, new in merge.items():
        source, target = _indices(clips, field, (old, new))
        numbers[source] = target
    labels = jnp.asarray(numbers[np.asarray(clips.labels[field])], jnp.int32)
    changed = dataclasses.replace(clips, labels=clips.labels | {field: labels})
    return relabel(changed, field)


def frequent_labels(clips: Clips, field: str, *, least: int) -> tuple[str, ...]:
    """Labels that at least so many clips have, in their order."""
    words = clips.names(field)
    counts = np.bincount(np.asarray(clips.labels[field]), minlength=len(words))
    return tuple(w for w, n in zip(words, counts, strict=True) if n >= least)


def split_clips(
    clips: Clips, *, fraction: float, seed: int, field: str = "style"
) -> tuple[Clips, Clips]:
    """Splits whole clips at random, label by label, into training and held-out clips.

    Of each label (of `field`) with n clips, round(n * fraction) are held out, but at
    least one stays in the training part and, where n > 1, at least one is held out.
    Mirror images go with their clips and do not count. Repeated strides (of `loops`)
    are learned from only, and not at all if their clip is held out. Both parts keep the
    original order; the same seed splits the same clips alike.

    `ValueError` if the fraction is out of range, or no label has two clips.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"fraction should be between 0 and 1, found {fraction}")
    clips.names(field)
    generator = np.random.default_rng(seed)
    labels = np.asarray(clips.labels[field])
    whole = _originals(clips)
    held_out: list[int] = []
    for label in np.unique(labels):
        members = whole[labels[whole] == label]
        count = max(min(max(round(members.size * fraction), 1), members.size - 1), 0)
        held_out += generator.permutation(members)[:count].tolist()
    if not held_out:
        raise ValueError(
            f"no {field} has two clips, expected one to train on and one to hold out"
        )
    return _parted(clips, np.array(held_out, int))


def _originals(clips: Clips) -> Int[np.ndarray, " originals"]:
    """Clips that show no other one's frames, as do images whose clip is not there."""
    known = {*clips.titles}
    found = []
    for clip, name in enumerate(clips.titles):
        plain = original(name)
        if plain == name or (plain not in known and not is_loop(name)):
            known.add(plain)
            found.append(clip)
    return np.array(found, int)


def _parted(clips: Clips, held_out: Int[np.ndarray, " held"]) -> tuple[Clips, Clips]:
    """What is learned from, and what is held out: these and what shows their frames."""
    names = {original(clips.titles[clip]) for clip in held_out}
    is_held = np.array([original(name) in names for name in clips.titles])
    is_held[np.setdiff1d(_originals(clips), held_out)] = False  # of the same name
    loops = np.array([is_loop(name) for name in clips.titles])
    train, held = np.flatnonzero(~is_held), np.flatnonzero(is_held & ~loops)
    return take_clips(clips, train), take_clips(clips, held)


def split_by_name(clips: Clips, held_out: Sequence[str]) -> tuple[Clips, Clips]:
    """Training clips and those held out by name, both in the original order.

    Their mirror images are held out with them, their repeated strides are in neither
    part. `ValueError` if a name is unknown, or no clip would be left to train on.
    """
    known = [name for name in clips.titles if not is_loop(name)]
    unknown = [name for name in held_out if name not in known]
    if unknown:
        raise ValueError(
            f"no clip named {', '.join(map(repr, unknown))}: the clips are "
            f"{', '.join(known)}"
        )
    names = {original(name) for name in held_out}
    if names >= {*map(original, clips.titles)}:
        raise ValueError("all clips are held out, expected some to train on")
    held = [i for i in _originals(clips) if original(clips.titles[i]) in names]
    return _parted(clips, np.array(held, int))


def cut(clips: Clips, spans: Sequence[tuple[int, int, int]]) -> Clips:
    """Stretches of clips, each as one clip with its labels, in that order.

    Their spans are clip, first frame within it and number of frames; their names
    "<clip>@<first frame>+<frames>".
    """
    owners, starts, lengths = np.array(spans, np.int64).reshape(-1, 3).T
    names = clips.titles
    return stretches(
        clips,
        owners,
        np.asarray(clips.offsets)[owners] + starts,
        lengths,
        names=tuple(f"{names[i]}@{start}+{n}" for i, start, n in spans),
    )


def concatenate(parts: Sequence[Clips], *, tolerance: float = 1e-3) -> Clips:
    """Sets of clips with the same skeleton, label fields and rate as one.

    Label names are merged, in the order in which they first occur; the source lists
    those of the parts. The first part's skeleton is kept, whose offsets others may
    differ from by the tolerance, meters.

    `ValueError` if there is no part, or fields, rates or skeletons differ.
    """
    if not parts:
        raise ValueError("no clips to concatenate")
    fields = [field for field, _ in parts[0].label_names]
    for part in parts[1:]:
        found = [field for field, _ in part.label_names]
        if sorted(found) != sorted(fields):
            raise ValueError(f"label fields differ: {fields} and {found}")
    rates = {part.fps for part in parts}
    if len(rates) > 1:
        raise ValueError(f"rates differ: {sorted(rates)} frames per second")
    check_skeletons(
        [part.skeleton for part in parts],
        [part.titles[0] for part in parts],
        tolerance,
    )
    words = {
        field: tuple(dict.fromkeys(w for part in parts for w in part.names(field)))
        for field in fields
    }
    lengths = np.concatenate([np.diff(np.asarray(part.offsets)) for part in parts])
    return dataclasses.replace(
        parts[0],
        root_position=jnp.concatenate([part.root_position for part in parts]),
        joint_rotation=jnp.concatenate([part.joint_rotation for part in parts]),
        offsets=jnp.asarray(np.cumsum([0, *lengths]), jnp.int32),
        labels={field: _merged(parts, field, words[field]) for field in fields},
        label_names=tuple(words.items()),
        clip_names=tuple(name for part in parts for name in part.titles),
        source="; ".join(dict.fromkeys(part.source for part in parts)),
    )


def _merged(parts: Sequence[Clips], field: str, words: tuple[str, ...]) -> Array:
    """Labels of all parts as numbers of the merged names."""
    numbers = [
        np.array([words.index(name) for name in part.names(field)])[
            np.asarray(part.labels[field])
        ]
        for part in parts
    ]
    return jnp.asarray(np.concatenate(numbers), jnp.int32)


def label_speeds(clips: Clips, *, field: str) -> Float[Array, " labels"]:
    """Median speed of the root in each style (`field`), to command it at.

    Meters per second; 0 for a style without clips. Jumps from clip to clip do not
    count.
    """
    step = np.diff(np.asarray(clips.root_position)[:, ::2], axis=0)
    speed = np.linalg.norm(step, axis=-1) * clips.fps
    offsets = np.asarray(clips.offsets)
    owner = np.repeat(np.asarray(clips.labels[field]), np.diff(offsets))[:-1]
    inside = np.ones(speed.size, bool)
    inside[offsets[1:-1] - 1] = False
    number = len(clips.names(field))
    found = [speed[inside & (owner == label)] for label in range(number)]
    return jnp.asarray([np.median(x) if x.size else 0.0 for x in found], jnp.float32)
