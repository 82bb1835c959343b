"""Plays an exported character: NumPy and onnxruntime are all that it needs.

Steers one character for ten seconds (walk, turn, run, stop) and writes `player.bvh`.
`experiments/export.py` puts a copy beside the graphs; port it to any engine.

Usage: python player.py [folder] [label]
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

# Seconds, direction of travel and of facing in degrees from +z toward +x, m/s.
COURSE = (
    (1, 0, 0, 0.0),
    (3, 0, 0, 1.4),
    (2, 90, 90, 1.4),
    (2, 90, 90, 2.5),
    (2, 0, 0, 0.0),
)


class Character:
    """State, and one tick after the other."""

    def __init__(self, folder: Path, label: str | None = None, seed: int = 0) -> None:
        self.about = json.loads((folder / "character.json").read_text())
        self.graphs = {
            name: (graph, onnxruntime.InferenceSession(folder / graph["file"]))
            for name, graph in self.about["graphs"].items()
        }
        labels = self.about["labels"]
        self.label = labels.index(label) if label else 0
        rows = self.label if self.about["batch"] is None else [self.label]
        starts = np.load(folder / "start.npz")  # a row for each label
        self.state = {name: starts[name][rows] for name in starts.files}
        self.draw = np.random.default_rng(seed).standard_normal

    def call(self, name: str, command: dict) -> dict:
        graph, session = self.graphs[name]
        given = self.state | command
        for port in graph["inputs"]:
            if port["name"].startswith("noise"):
                shape = [1 if n == "any" else n for n in port["shape"]]
                given[port["name"]] = self.draw(shape).astype(np.float32)
        wanted = {port.name: given[port.name] for port in session.get_inputs()}
        names = [port["name"].removeprefix("out.") for port in graph["outputs"]]
        return dict(zip(names, session.run(None, wanted), strict=True))

    def tick(self, velocity: tuple, facing: tuple) -> dict:
        """Moves on by one frame, and returns it."""
        values = {"velocity": np.float32(velocity), "facing": np.float32(facing)}
        values["label"] = np.int32(self.label)
        lead = () if self.about["batch"] is None else (None,)
        command = {f"command.{name}": np.asarray(x)[lead] for name, x in values.items()}
        if "step" in self.graphs:
            found = self.call("step", command)
        else:
            level = int(self.call("plan_level", command)["level"].max())
            if level > 0:
                self.state |= self.call(
                    "plan" if level == 1 else f"plan_{level}", command
                )
            found = self.call("advance", command)
        self.state |= {name: x for name, x in found.items() if name in self.state}
        frame = {name: x for name, x in found.items() if name.startswith("frame.")}
        return {n.removeprefix("frame."): x[0] if lead else x for n, x in frame.items()}


def euler_zxy(rotation: np.ndarray) -> np.ndarray:
    """Degrees about z, x, y of rotations given by the first two columns."""
    x, y = rotation[..., :3], rotation[..., 3:]
    z = np.cross(x, y)
    about_x = np.arcsin(np.clip(y[..., 2], -1, 1))
    about_z, about_y = (
        np.arctan2(-y[..., 0], y[..., 1]),
        np.arctan2(-x[..., 2], z[..., 2]),
    )
    return np.degrees(np.stack([about_z, about_x, about_y], axis=-1))


def bvh(skeleton: dict, fps: float, root: np.ndarray, rotations: np.ndarray) -> str:
    """A BVH file in meters; root [frames, 3], rotations [frames, joints, 6]."""
    names, parents, offsets = (skeleton[x] for x in ("names", "parents", "offsets"))

    def block(j: int, pad: str) -> str:
        kind, offset = ("JOINT", offsets[j]) if parents[j] >= 0 else ("ROOT", (0, 0, 0))
        place = "Xposition Yposition Zposition " if parents[j] < 0 else ""
        children = [block(k, pad + "  ") for k in range(len(names)) if parents[k] == j]
        end = f"{pad}  End Site\n{pad}  {{\n{pad}    OFFSET 0 0 0\n{pad}  }}\n"
        return (
            f"{pad}{kind} {names[j]}\n{pad}{{\n"
            f"{pad}  OFFSET {offset[0]:.6f} {offset[1]:.6f} {offset[2]:.6f}\n"
            f"{pad}  CHANNELS {6 if place else 3} {place}Zrotation Xrotation Yrotation\n"
            f"{''.join(children) or end}{pad}}}\n"
        )

    def order(j: int) -> list[int]:
        below = (order(k) for k in range(len(names)) if parents[k] == j)
        return [j, *(i for branch in below for i in branch)]

    angles = euler_zxy(rotations)[:, order(0)].reshape(len(root), -1)
    rows = [" ".join(f"{x:.5f}" for x in row) for row in np.hstack([root, angles])]
    head = f"HIERARCHY\n{block(0, '')}MOTION\nFrames: {len(rows)}\n"
    return head + f"Frame Time: {1 / fps:.6f}\n" + "\n".join(rows) + "\n"


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    character = Character(folder, sys.argv[2] if len(sys.argv) > 2 else None)
    fps, frames = character.about["fps"], []
    for seconds, travel, face, speed in COURSE:
        way, look = ((np.sin(a), np.cos(a)) for a in np.radians([travel, face]))
        for _ in range(round(seconds * fps)):
            frames.append(character.tick((speed * way[0], speed * way[1]), look))
    parts = [
        np.stack([f[x] for f in frames]) for x in ("root_position", "joint_rotation")
    ]
    text = bvh(character.about["skeleton"], fps, *parts)
    (folder / "player.bvh").write_text(text)
    print(f"wrote {folder / 'player.bvh'}: {len(frames)} frames")


if __name__ == "__main__":
    main()
