import pytest

from jaxmotion.data import bvh_text
from tests.data import samples

ROW = " ".join(["1.0"] * 16)
FIRST = samples.BVH.count("\n") + 1  # line of the first row


def line(word: str) -> int:
    """Line of the hierarchy that has that word first."""
    return samples.BVH[: samples.BVH.index(word)].count("\n") + 1


BAD = {
    "empty": ("", "line 1.*no HIERARCHY"),
    "cut in the hierarchy": (samples.BVH.split("JOINT Head")[0], "ends.*truncated"),
    "no motion": (samples.BVH.split("MOTION")[0], "no MOTION block"),
    "no frames line": (samples.BVH.split("Frames")[0], "'Frames:'.*truncated"),
    "no frame time": (samples.BVH.split("Frame Time")[0], "Frame Time.*truncated"),
    "no rows": (samples.BVH, "says 3, the file has"),
    "too few rows": (f"{samples.BVH}{ROW}\n{ROW}\n", "says 3, the file has 2 rows"),
    "too many rows": (
        samples.BVH + f"{ROW}\n" * 4,
        f"line {FIRST + 3}: more rows than the 3",
    ),
    "short row": (
        f"{samples.BVH}{ROW}\n{ROW[:-4]}\n{ROW}",
        f"line {FIRST + 1}: frame 1 has 15",
    ),
    "long row": (
        f"{samples.BVH}{ROW} 1\n{ROW}\n{ROW}",
        f"line {FIRST}: frame 0 has 17",
    ),
    "word": (f"{samples.BVH}{ROW[:-3]}x\n{ROW}\n{ROW}", f"line {FIRST}: .*no number"),
    "nan": (
        f"{samples.BVH}{ROW}\n{ROW}\n{ROW[:-3]}nan",
        f"line {FIRST + 2}: frame 2.*NaN",
    ),
    "infinite": (
        f"{samples.BVH}{ROW}\n{ROW}\n{ROW[:-3]}inf",
        f"line {FIRST + 2}: frame 2",
    ),
    "frames word": (
        samples.BVH.replace(": 3", ": x"),
        f"line {line('Frames')}: expected",
    ),
    "no frames": (
        samples.BVH.replace(": 3", ": 0"),
        f"line {line('Frames')}: expected",
    ),
    "half frames": (
        samples.BVH.replace(": 3", ": 2.5"),
        f"line {line('Frames')}.*whole",
    ),
    "frame time": (
        samples.BVH.replace("0.016667", "-1"),
        f"line {line('Frame T')}: expected 'Frame T",
    ),
    "channel": (samples.BVH.replace("6 Xpos", "6 Wpos"), "line 5: unknown.*Wposition"),
    "channel twice": (samples.BVH.replace("6 X", "6 Y"), "line 5.*twice"),
    "channel count": (samples.BVH.replace("6 X", "5 X"), "line 5: expected.*Yrotation"),
    "tiny frame time": (
        samples.BVH.replace("0.016667", "1e-310"),
        f"line {line('Frame T')}: 'Frame Time:' should be in 1e-05..1000 s.*1e-310",
    ),
    "frames with an underscore": (
        samples.BVH.replace(": 3", ": 0_3"),
        f"line {line('Frames')}: expected",
    ),
    "offset with an underscore": (
        samples.BVH.replace("90.0", "9_0.0"),
        "line 8: OFFSET needs three numbers, found '9_0.0'",
    ),
    "offset of other digits": (
        samples.BVH.replace("90.0", "\u0669"),
        "line 8: OFFSET needs three numbers",
    ),
    "superscript": (samples.BVH.replace("6 X", "\u00b2 X"), "line 5: CHANNELS needs"),
    "5,000 digits": (
        samples.BVH.replace("6 X", "6" * 5000 + " X"),
        "line 5: CHANNELS needs a number in 0..6, found '6{40}...'$",
    ),
    "channel number": (samples.BVH.replace("6 X", "x X"), "line 5.*found 'x'"),
    "joint twice": (
        samples.BVH.replace("Head", "Root"),
        f"line {line('JOINT Head')}: .*'Root'.*twice",
    ),
    "offset": (samples.BVH.replace("9.0 9.0 9.0", "9.0 9.0"), "line 5: OFFSET.*three"),
    "nan offset": (samples.BVH.replace("90.0", "nan"), "line 8: OFFSET is not finite"),
    "no offset": (samples.BVH.replace("\tOFFSET 0.0 0.0 1.0", ""), "'Prop' has no OFF"),
    "no name": (
        samples.BVH.replace("JOINT Head", "JOINT"),
        f"line {line('JOINT Head') + 1}: a joint has",
    ),
    "keyword": (
        samples.BVH.replace("JOINT Head", "BONE Head"),
        f"line {line('JOINT Head')}: .*'BONE'",
    ),
    "two roots": (
        samples.BVH.replace("MOTION", "ROOT B\nMOTION"),
        f"line {line('MOTION')}: expected",
    ),
    "not bvh": ("<html></html>", "line 1: expected 'HIERARCHY'"),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed_files_are_named_with_the_line(case):
    text, message = BAD[case]
    with pytest.raises(bvh_text.BvhError, match="bad.bvh"):
        bvh_text.parse_bvh(text, name="bad.bvh")
    with pytest.raises(ValueError, match=message):
        bvh_text.parse_bvh(text, name="bad.bvh")


def test_binary_files_and_wild_frame_counts_are_refused(tmp_path):
    (tmp_path / "a.bvh").write_bytes(b"HIERARCHY\xff\xfe\x00")
    with pytest.raises(bvh_text.BvhError, match="a.bvh: not a text file"):
        bvh_text.read_bvh(tmp_path / "a.bvh")
    with pytest.raises(bvh_text.BvhError, match="999999999999"):
        bvh_text.parse_bvh(samples.bvh_text().replace("s: 3", "s: 999999999999"))
