"""How inputs are made wrong: bytes, words, lines, numbers, JSON and arrays."""

import copy
import io
import json
import re

import numpy as np

WORDS = (
    "",
    "nan",
    "inf",
    "-Infinity",
    "1e39",
    "1e309",
    "-1e-310",
    "1e-310",
    "\u00b2",
    "\u0663",
    "1_0",
    "0x10",
    "1,5",
    "1e",
    "--1",
    "1d5",
    "+3",
    ".5",
    "1.",
    "-0",
    "0",
    "7",
    "999999999999",
    "6" * 5000,
    "{",
    "}",
    "ROOT",
    "JOINT",
    "End",
    "Site",
    "OFFSET",
    "CHANNELS",
    "MOTION",
    "HIERARCHY",
    "Frames:",
    "Frame",
    "Time:",
    "Xposition",
    "Zrotation",
    "\x00",
    "\ufeff",
    "\u2028",
    "\x0b",
    "a" * 300,
)


def mutate_bytes(random, data):
    """Cuts, flips, fills, doubles, drops or swaps a part of the bytes."""
    data = bytearray(data)
    for _ in range(random.integers(1, 4)):
        size = max(len(data), 1)
        at = int(random.integers(size))
        length = int(min(random.integers(1, 64), size))
        match random.integers(8):
            case 0:
                del data[at:]
            case 1:
                data[at : at + 1] = bytes([random.integers(256)])
            case 2:
                if data:
                    data[at] ^= 1 << random.integers(8)
            case 3:
                data[at : at + length] = bytes(length)
            case 4:
                data[at:at] = data[at : at + length]
            case 5:
                del data[at : at + length]
            case 6:
                data[at:at] = random.bytes(length)
            case 7:
                other = int(random.integers(size))
                piece = data[other : other + length]
                data[at : at + length] = piece
    return bytes(data)


def mutate_words(random, text):
    """Other words in a text, or other places for them; spacing stays."""
    parts = re.split(r"(\s+)", text)
    for _ in range(random.integers(1, 3)):
        at = int(random.integers(len(parts)))
        # Few words carry structure; most are numbers in rows.
        if random.random() < 0.7:
            at %= max(1, min(len(parts), 160))
        match random.integers(6) % 4:
            case 0 if re.fullmatch(r"[-\d.e]+", parts[at]) and random.random() < 0.7:
                parts[at] = str(random.choice(NUMBERS))
            case 0:
                parts[at] = str(random.choice(WORDS))
            case 1:
                parts[at] = f"{random.choice(WORDS)} {parts[at]}"
            case 2:
                del parts[at]
            case 3:
                other = int(random.integers(max(len(parts), 1)))
                if parts:
                    at = min(at, len(parts) - 1)
                    parts[at], parts[other] = parts[other], parts[at]
        if not parts:
            break
    return "".join(parts)


def mutate_lines(random, text):
    """Lines dropped, doubled, swapped, joined or cut."""
    lines = text.split("\n")
    for _ in range(random.integers(1, 4)):
        at, other = (int(x) for x in random.integers(len(lines), size=2))
        match random.integers(5):
            case 0:
                del lines[at]
            case 1:
                lines.insert(other, lines[at])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at : at + 2] = [" ".join(lines[at : at + 2])]
            case 4:
                lines[at] = lines[at][: int(random.integers(len(lines[at]) + 1))]
        if not lines:
            break
    return "\n".join(lines)


def mutate_text(random, text):
    """Any of the above, as bytes."""
    match random.integers(3):
        case 0:
            return mutate_bytes(random, text.encode())
        case 1:
            return mutate_words(random, text).encode()
    return mutate_lines(random, text).encode()


# Some of them readers take, each in its place.
NUMBERS = ("0", "-0.0", "+3", ".5", "1.", "1e3", "-2.5E-3", "3", "6", "0.04", "00012")

VALUES = (
    None,
    True,
    "",
    "x",
    "inf",
    0,
    -1,
    1,
    2,
    3.5,
    -2.0,
    float("nan"),
    float("inf"),
    float("-inf"),
    1e39,
    1e300,
    -1e-310,
    10**9,
    10**400,
    [],
    [None],
    [[1.0]],
    {},
    {"a": 1},
    "columns",
    "facing",
    "a" * 200,
)


def places(value, path=()):
    """All paths into a JSON value."""
    yield path
    if isinstance(value, dict):
        for key in value:
            yield from places(value[key], (*path, key))
    elif isinstance(value, list):
        for index in range(len(value)):
            yield from places(value[index], (*path, index))


def mutate_json(random, value):
    """A JSON value with another value, or without one, in one or two places."""
    value = copy.deepcopy(value)
    for _ in range(random.integers(1, 3)):
        paths = list(places(value))
        # Every depth alike: else nearly all of them are numbers of a long list.
        depths = sorted({len(path) for path in paths})
        depth = depths[random.integers(len(depths))]
        chosen = [path for path in paths if len(path) == depth]
        path = chosen[random.integers(len(chosen))]
        new = copy.deepcopy(VALUES[random.integers(len(VALUES))])
        if not path:
            if random.random() < 0.1:
                return new
            continue
        node = value
        for key in path[:-1]:
            node = node[key]
        match random.integers(5):
            case 0:
                del node[path[-1]]
            case 1 if isinstance(node, list):
                node.append(copy.deepcopy(node[path[-1]]))
            case 1:
                node["unknown"] = new
            case _:
                node[path[-1]] = new
    return value


def mutate_array(random, array):
    """An array of another kind, shape or content."""
    array = np.array(array)
    with np.errstate(all="ignore"):
        match random.integers(9):
            case 0 if array.dtype.kind in "fi" and array.size:
                flat = array.reshape(-1).astype(np.float64)
                bad = [np.nan, np.inf, 1e30, 1e39, 1e300, 0.0, -1.0, 1e-310]
                flat[random.integers(flat.size)] = random.choice(bad)
                return flat.reshape(array.shape)
            case 1 if array.dtype.kind in "fi":
                return array * random.choice([0.0, -1.0, 1e30, np.nan])
            case 2 if array.dtype.kind == "i" and array.size:
                flat = array.reshape(-1).copy()
                bad = [-1, 2**31 - 1, -(2**31), 2**62, 0, 127]
                flat[random.integers(flat.size)] = random.choice(bad)
                return flat.reshape(array.shape)
            case 3:
                kinds = ["f2", "f8", "i1", "i4", "u8", "c8", "b1", "U3", "S4", "M8[s]"]
                try:
                    return array.astype(random.choice(kinds))
                except (ValueError, TypeError):
                    return np.zeros(array.shape, "f4")
            case 4 if array.ndim:
                return array[: int(random.integers(array.shape[0] + 1))]
            case 5:
                return array[None] if random.random() < 0.5 else array.reshape(-1)
            case 6 if array.ndim:
                return np.concatenate([array, array])
            case 7:
                return np.zeros((0, *array.shape[1:]), array.dtype)
            case 8 if array.ndim > 1:
                return np.asfortranarray(array.T)
    return np.array({"a": 1}, object) if random.random() < 0.3 else np.array("x")


def npz(fields):
    """Content of an npz file; arrays of objects are pickled into it."""
    buffer = io.BytesIO()
    np.savez(buffer, **fields)
    return buffer.getvalue()


def mutate_npz(random, data):
    """An npz file with other bytes, or with other fields."""
    if random.random() < 0.35:
        return mutate_bytes(random, data)
    with np.load(io.BytesIO(data)) as file:
        fields = {name: file[name] for name in file.files}
    for _ in range(random.integers(1, 3)):
        names = list(fields)
        name = names[random.integers(len(names))]
        match random.integers(8):
            case 0:
                del fields[name]
            case 1:
                fields[f"{name}.more"] = fields[name]
            case 2:
                fields[name] = fields[names[random.integers(len(names))]]
            case _:
                fields[name] = mutate_array(random, fields[name])
        if not fields:
            break
    return npz(fields)


def mutate_json_text(random, value):
    """JSON as bytes, wrong in its value or in its text."""
    if random.random() < 0.6:
        return json.dumps(mutate_json(random, value)).encode()
    return mutate_text(random, json.dumps(value, indent=1))
