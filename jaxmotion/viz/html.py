"""A self-contained page that plays a motion: no network, no library.

Drag to orbit, wheel to zoom, slider to scrub, space to pause.
"""

import html as escaping
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxmotion.viz import figure as drawing
from jaxmotion.viz import sketch as bodies

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>__TITLE__</title>
<style>
body { margin: 0; font: 14px sans-serif; background: #f6f8fa; color: #20262e; }
body { display: flex; flex-direction: column; height: 100vh; }
canvas { display: block; width: 100vw; flex: 1; min-height: 0; }
#bar { display: flex; gap: 12px; align-items: center; padding: 8px 12px; }
#time { flex: 1; }
.key { display: inline-block; width: 18px; height: 4px; vertical-align: middle; }
h1 { font-size: 14px; margin: 8px 12px 0; font-weight: 600; }
p { font-size: 11px; margin: 4px 12px; color: #707884; }
</style></head><body>
<h1>__TITLE__</h1>
<div id="bar"><button id="play" aria-label="play or pause">pause</button>
<input id="time" type="range" min="0" value="0" aria-label="frame">
<span id="clock"></span>
<span><i class="key" style="background:#2ca02c"></i> commanded</span>
<span><i class="key" style="background:#ff7f0e"></i> walked</span></div>
<canvas id="view"></canvas>
<p>__CAPTION__</p>
<script>
const data = __DATA__;
const canvas = document.getElementById("view"), pen = canvas.getContext("2d");
const slider = document.getElementById("time");
const clock = document.getElementById("clock");
const button = document.getElementById("play");
const frames = data.positions.length;
slider.max = frames - 1;
let frame = 0, playing = true, azimuth = 0.6, elevation = 0.35, zoom = 1;
function project(p, center) {
  const x = p[0] - center[0], y = p[1] - 0.85, z = p[2] - center[2];
  const right = x * Math.cos(azimuth) - z * Math.sin(azimuth);
  const depth = x * Math.sin(azimuth) + z * Math.cos(azimuth);
  const up = y * Math.cos(elevation) - depth * Math.sin(elevation);
  const scale = size();
  const near = y * Math.sin(elevation) + depth * Math.cos(elevation);
  return [canvas.width / 2 + right * scale, canvas.height / 2 - up * scale, near];
}
function size() { return canvas.height / 3.2 * zoom; }
function capsule(a, b, ra, rb, color) {
  const along = Math.atan2(b[1] - a[1], b[0] - a[0]), half = Math.PI / 2;
  pen.beginPath();
  pen.arc(a[0], a[1], ra, along + half, along + 3 * half);
  pen.arc(b[0], b[1], rb, along - half, along + half);
  pen.closePath(); pen.fillStyle = color; pen.fill();
}
function shaded(a, b, ra, rb, color) {
  const lit = (p, r) => [p[0] - 0.25 * r, p[1] - 0.3 * r];
  capsule(a, b, ra, rb, color);
  capsule(a, b, ra, rb, "#0000002e");
  capsule(lit(a, 0.5 * ra), lit(b, 0.5 * rb), 0.86 * ra, 0.86 * rb, color);
  capsule(lit(a, ra), lit(b, rb), 0.5 * ra, 0.5 * rb, "#ffffff2a");
}
function line(points, center, color, width) {
  pen.strokeStyle = color; pen.lineWidth = width; pen.beginPath();
  points.forEach((p, i) => {
    const q = project(p, center);
    if (i) pen.lineTo(q[0], q[1]); else pen.moveTo(q[0], q[1]);
  });
  pen.stroke();
}
function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  const now = Math.floor(frame), pose = data.positions[now], c = pose[0];
  const points = pose.concat(data.added[now]);
  const ground = p => project([p[0], 0, p[2]], c);
  pen.clearRect(0, 0, canvas.width, canvas.height); pen.lineCap = "round";
  const x0 = Math.floor(c[0]) - 5, z0 = Math.floor(c[2]) - 5;
  for (let x = x0; x < x0 + 10; x++) for (let z = z0; z < z0 + 10; z++) {
    if ((x + z) % 2) continue;
    pen.beginPath();
    for (const [i, k] of [[0, 0], [1, 0], [1, 1], [0, 1]]) {
      const q = project([x + i, 0, z + k], c);
      if (i + k) pen.lineTo(q[0], q[1]); else pen.moveTo(q[0], q[1]);
    }
    pen.closePath(); pen.fillStyle = "#dde4ec"; pen.fill();
  }
  // Light from straight above: a shadow as flat as the ground is seen.
  const flat = Math.max(Math.sin(elevation), 0.15);
  for (const [a, b, ra, rb] of data.shapes) {
    capsule(ground(points[a]), ground(points[b]), ra * flat * size(),
            rb * flat * size(), "#b9c1ca");
  }
  for (const [path, color] of [[data.commanded, "#2ca02c"], [data.walked, "#ff7f0e"]]) {
    if (!path) continue;
    line(path.map(p => [p[0], 0, p[1]]), c, color + "55", ratio);
    line(path.slice(0, now + 1).map(p => [p[0], 0, p[1]]), c, color, 2 * ratio);
  }
  const solid = data.shapes.map(([a, b, ra, rb, color]) => {
    const p = project(points[a], c), q = project(points[b], c);
    return [p[2] + q[2], p, q, ra * size(), rb * size(), color];
  });
  if (data.ball) {
    const q = project(data.ball[now], c), r = data.radius * size();
    const rim = data.touch[now] ? "#d62728" : "#222";
    solid.push([2 * q[2], q, q, r + 2 * ratio, r + 2 * ratio, rim]);
    solid.push([2 * q[2], q, q, r, r, "#e8e4da"]);
  }
  solid.sort((a, b) => a[0] - b[0]);
  for (const shape of solid) shaded(...shape.slice(1));
  slider.value = now;
  clock.textContent = (now / data.fps).toFixed(2) + " s of " +
    ((frames - 1) / data.fps).toFixed(2) + " s";
}
let last = null;
function loop(time) {
  // The first time of an animation may lie before the script's own.
  if (playing && last !== null)
    frame = (frame + (time - last) / 1000 * data.fps) % frames;
  last = time; draw(); requestAnimationFrame(loop);
}
function toggle() {
  playing = !playing; button.textContent = playing ? "pause" : "play";
}
button.onclick = toggle;
slider.oninput = () => { frame = +slider.value; if (playing) toggle(); };
window.onkeydown = e => {
  if (e.code === "Space" && e.target !== button) { e.preventDefault(); toggle(); }
};
canvas.onpointermove = e => {
  if (!e.buttons) return;
  azimuth += e.movementX * 0.01;
  elevation = Math.min(1.5, Math.max(0, elevation + e.movementY * 0.01));
};
canvas.onwheel = e => {
  e.preventDefault();
  zoom = Math.min(6, Math.max(0.2, zoom * Math.exp(-e.deltaY / 600)));
};
requestAnimationFrame(loop);
</script></body></html>
"""


def page(
    positions: np.ndarray,
    parents: tuple[int, ...],
    *,
    fps: float,
    names: tuple[str, ...] | None = None,
    commanded: np.ndarray | None = None,
    walked: np.ndarray | None = None,
    ball: np.ndarray | None = None,
    touch: np.ndarray | None = None,
    radius: float = 0.11,
    title: str = "",
    caption: str = "",
) -> str:
    """The page as text.

    Args:
      positions: [F, J, 3] world positions, meters, y up.
      names: Joint names, to find the head and color left and right; None for guesses
        and gray.
      commanded: [F, 2] commanded path (x, z), or None.
      walked: [F, 2] walked path, or None.
      ball: [F, 3] world position of a ball's center, or None.
      touch: [F] whether something touches the ball (its rim is red then), or None.
      radius: Radius of the ball, meters.
      title: Above the picture; escaped, like the caption.
      caption: Below it, small: the source of the data and its license.

    Raises:
      ValueError: if an array has a wrong shape or is not finite; names it.
    """
    positions = drawing.check_motion(
        positions, parents, fps=fps, paths={"commanded": commanded, "walked": walked}
    )
    ball = drawing.check_ball(ball, len(positions))
    touch = np.zeros(len(positions), bool) if touch is None else np.asarray(touch, bool)
    if touch.shape != (len(positions),):
        raise ValueError(f"touch is {touch.shape}, expected {(len(positions),)}")

    def rounded(x: np.ndarray | None) -> list | None:
        return None if x is None else np.round(np.asarray(x, float), 3).tolist()

    body = bodies.build(positions, parents, names)
    shapes = zip(body.ends.tolist(), rounded(body.radii), body.colors, strict=True)
    data = {
        "positions": rounded(positions),
        "added": rounded(body.points[:, len(parents) :]),
        "shapes": [[*ends, *radii, color] for ends, radii, color in shapes],
        "fps": fps,
        "commanded": rounded(commanded),
        "walked": rounded(walked),
        "ball": rounded(ball),
        "touch": touch.tolist(),
        "radius": radius,
    }
    # "</" would end the script element wherever it stands.
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    filled = {
        "__TITLE__": escaping.escape(title),
        "__CAPTION__": escaping.escape(caption),
        "__DATA__": text,
    }
    # In one pass: a title may contain the name of the other slot.
    return re.sub(
        "__TITLE__|__CAPTION__|__DATA__", lambda slot: filled[slot.group()], _PAGE
    )


def save_html(
    path: str | Path,
    positions: np.ndarray,
    parents: tuple[int, ...],
    *,
    fps: float,
    **options: Any,
) -> None:
    """Writes the page; the options are those of `page`.

    Raises:
      ValueError: if an array has a wrong shape or is not finite; names it.
      OSError: if the file cannot be written.
    """
    text = page(positions, parents, fps=fps, **options)
    drawing.check_writable(path).write_text(text, encoding="utf-8")
