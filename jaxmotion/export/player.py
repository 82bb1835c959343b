"""Plays an exported character: NumPy and onnxruntime are all that it needs.

It steers a character for ten seconds (stand, walk, turn, run, stop) and writes what it
shows to player.bvh. `experiments/export.py` puts a copy beside the graphs.

Usage: python player.py [folder [label]]
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

# Seconds, degrees of travel and facing from +z toward +x, meters per second.
COURSE = ((1, 0, 0.0), (3, 0, 1.4), (2, 90, 1.4), (2, 90, 2.5), (2, 0, 0.0))


def play(folder: Path, about: dict, label: int) -> tuple[np.ndarray, np.ndarray]:
    """Root positions [frames, 3] and joint rotations [frames, joints, 6]."""
    graphs, random = about["graphs"], np.random.default_rng(0)
    sessions = {
        name: onnxruntime.InferenceSession(folder / graph["file"])
        for name, graph in graphs.items()
    }
    starts = np.load(folder / "start.npz")  # a row for each label
    state = {name: np.asarray(starts[name][label]) for name in starts.files}

    def call(name: str, command: dict) -> dict:
        """Runs a graph; what it says of the state is the state from now on."""
        noise = {
            port["name"]: random.standard_normal(port["shape"], np.float32)
            for port in graphs[name]["inputs"]
            if port["name"].startswith("noise")
        }
        given = state | command | noise
        found = sessions[name].run(
            None, {port.name: given[port.name] for port in sessions[name].get_inputs()}
        )
        names = [port["name"].removeprefix("out.") for port in graphs[name]["outputs"]]
        found = dict(zip(names, map(np.asarray, found), strict=True))
        state.update({name: x for name, x in found.items() if name in state})
        return found

    roots, rotations = [], []
    for seconds, degrees, speed in COURSE:
        angle = np.radians(degrees)
        way = np.array([np.sin(angle), np.cos(angle)], np.float32)
        command = {
            "command.velocity": np.float32(speed) * way,
            "command.facing": way,
            "command.label": np.array(label, np.int32),
        }
        for _ in range(round(seconds * about["fps"])):
            if "step" in graphs:
                frame = call("step", command)
            else:
                level = call("plan_level", command)["level"]
                if level > 0:
                    call("plan" if level == 1 else f"plan_{level}", command)
                frame = call("advance", command)
            roots.append(frame["frame.root_position"])
            rotations.append(frame["frame.joint_rotation"])
    return np.stack(roots), np.stack(rotations)


def bvh(skeleton: dict, fps: float, roots: np.ndarray, rotations: np.ndarray) -> str:
    """Text of a BVH file, in centimeters; angles about z, x and y."""
    x, y = rotations[..., :3], rotations[..., 3:]  # columns of the matrices
    cosine = np.hypot(y[..., 0], y[..., 1])
    locked = cosine < 1e-6  # a quarter turn about x: those about z and y are one
    about_z = np.where(
        locked, np.arctan2(x[..., 1], x[..., 0]), np.arctan2(-y[..., 0], y[..., 1])
    )
    about_x = np.arctan2(y[..., 2], cosine)
    about_y = np.where(locked, 0, np.arctan2(-x[..., 2], np.cross(x, y)[..., 2]))
    angles = np.degrees(np.stack([about_z, about_x, about_y], axis=-1))
    lines, order, parents = ["HIERARCHY"], [], skeleton["parents"]

    def joint(j: int, pad: str) -> None:
        order.append(j)
        is_root, offset = parents[j] < 0, skeleton["offsets"][j]
        place = "6 Xposition Yposition Zposition" if is_root else "3"
        offset = " ".join(f"{0 if is_root else 100 * x:.4f}" for x in offset)
        lines.append(f"{pad}{'ROOT' if is_root else 'JOINT'} {skeleton['names'][j]}")
        lines.extend([f"{pad}{{", f"{pad}  OFFSET {offset}"])
        lines.append(f"{pad}  CHANNELS {place} Zrotation Xrotation Yrotation")
        children = [k for k, parent in enumerate(parents) if parent == j]
        for k in children:
            joint(k, pad + "  ")
        end = ["  End Site", "  {", "    OFFSET 0 0 0", "  }"]
        lines.extend([pad + line for line in end] if not children else [])
        lines.append(f"{pad}}}")

    joint(parents.index(-1), "")
    rows = np.hstack([100 * roots, angles[:, order].reshape(len(roots), -1)])
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / fps:.8f}"]
    lines += [" ".join(f"{value:.5f}" for value in row) for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent)
    about = json.loads((folder / "character.json").read_text())
    label = about["labels"].index(sys.argv[2]) if len(sys.argv) > 2 else 0
    text = bvh(about["skeleton"], about["fps"], *play(folder, about, label))
    (folder / "player.bvh").write_text(text)
    print(f"wrote {folder / 'player.bvh'}")
