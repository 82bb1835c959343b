"""A self-contained page that plays a stage: no network, no library, WebGL.

Drag to turn, wheel to zoom, slider or arrow keys to scrub, space to pause. The page has
the joints' rotations and the mesh of `mannequin.describe`; kinematics and skinning are
done there.
"""

import base64
import html as escaping
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxmotion import files
from jaxmotion.motion.skeleton import Motion
from jaxmotion.viz import camera as cameras
from jaxmotion.viz import figure as drawing
from jaxmotion.viz.mannequin import Mannequin
from jaxmotion.viz.stage import Stage

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>__TITLE__</title>
<style>
body { margin: 0; font: 14px sans-serif; background: #f6f8fa; color: #20262e; }
body { display: flex; flex-direction: column; height: 100vh; overflow: hidden; }
canvas { display: block; width: 100vw; flex: 1; min-height: 0; touch-action: none; }
#bar { display: flex; gap: 12px; align-items: center; padding: 8px 12px; }
#bar span { white-space: nowrap; font-variant-numeric: tabular-nums; }
#play { width: 4.5em; }
#time { flex: 1; min-width: 60px; }
.key { display: inline-block; width: 18px; height: 4px; vertical-align: middle; }
h1 { font-size: 14px; margin: 8px 12px 0; font-weight: 600; }
h1 { white-space: nowrap; overflow: hidden; text-overflow: ellipsis; }
p { font-size: 11px; margin: 4px 12px; color: #707884; }
</style></head><body>
<h1>__TITLE__</h1>
<div id="bar"><button id="play" aria-label="play or pause">pause</button>
<input id="time" type="range" min="0" value="0" aria-label="frame">
<span id="clock"></span><span id="keys"></span></div>
<canvas id="view"></canvas>
<p>__CAPTION__</p>
<script>
const data = __DATA__;
const element = id => document.getElementById(id);
const joints = data.parents.length;
const [characters, frames] = data.shape;

const canvas = element("view"), slider = element("time"), button = element("play");
const gl = canvas.getContext("webgl2", {antialias: true, stencil: true, alpha: false});
if (!gl) {
  element("clock").textContent = "This browser has no WebGL 2: nothing can be drawn.";
  throw new Error("no WebGL 2");
}
__MANNEQUIN__
const floats = text => text && new Float32Array(bytes(text));
const poses = m => m && {root: floats(m.root), turn: new Int16Array(bytes(m.turn))};
const body = poses(data.motion), ghost = poses(data.ghost);
const targets = floats(data.targets), ball = data.ball;
if (ball) ball.place = floats(ball.position);
// World position (3) and rotation (9, three columns) of all joints.
const world = new Float32Array(12 * joints);
function kinematics(pose, character, frame) {
  const at = character * frames + frame;
  for (let j = 0; j < joints; j++) {
    const from = 6 * (at * joints + j), to = 12 * j, up = 12 * data.parents[j];
    const c = [];
    for (let i = 0; i < 6; i++) c.push(pose.turn[from + i] / 32767);
    c.push(c[1] * c[5] - c[2] * c[4], c[2] * c[3] - c[0] * c[5],
           c[0] * c[4] - c[1] * c[3]);
    if (!j) {
      for (let i = 0; i < 3; i++) world[i] = pose.root[3 * at + i];
      for (let i = 0; i < 9; i++) world[3 + i] = c[i];
      continue;
    }
    place(up, data.offsets[j], world, to);
    for (let k = 0; k < 3; k++) for (let i = 0; i < 3; i++) {
      let sum = 0;
      for (let n = 0; n < 3; n++) sum += world[up + 3 + 3 * n + i] * c[3 * k + n];
      world[to + 3 + 3 * k + i] = sum;
    }
  }
}
function place(joint, p, out, to) {
  for (let i = 0; i < 3; i++) out[to + i] = world[joint + i]
    + world[joint + 3 + i] * p[0] + world[joint + 6 + i] * p[1]
    + world[joint + 9 + i] * p[2];
}
const mesh = bodyMesh(data.body, characters);
const pale = ghost && bodyMesh(data.body, characters);
function assemble(pose, frame, mesh) {
  for (let who = 0; who < characters; who++) {
    kinematics(pose, who, frame);
    for (let j = 0; j < joints; j++)
      bindMatrix(world, 12 * j, data.body.inverse, 12 * j,
                 mesh.matrices, 12 * (who * joints + j));
  }
  bring(mesh);
}
// Balls, and marks where one is touched: place, radius, color of each.
const spheres = [];
function gather(frame) {
  const found = [];
  if (!ball) return found;
  for (let at = 3 * frame; at < ball.place.length; at += 3 * frames)
    found.push([ball.place.slice(at, at + 3), ball.radius, "#e8e4da"]);
  for (const j of ball.touching[frame])
    found.push([world.slice(12 * j, 12 * j + 3), 0.05, "#2fae4a"]);
  while (spheres.length < found.length) spheres.push(sphereMesh(24, 16));
  found.forEach(([place, radius], i) => {
    spheres[i].matrices.set([radius, 0, 0, place[0], 0, radius, 0, place[1],
                             0, 0, radius, place[2]]);
    bring(spheres[i]);
  });
  return found;
}

const flat = program(`
in vec3 corner; uniform mat4 view; uniform vec3 target; uniform float reach;
out vec3 p;
void main() {
  p = reach > 0.0 ? corner * reach + vec3(target.x, 0, target.z) : corner;
  gl_Position = view * vec4(p, 1);
}`, `
in vec3 p; uniform vec3 target; uniform float reach; uniform vec4 paint;
out vec4 shown;
void main() {
  if (reach <= 0.0) { shown = paint; return; }
  vec2 w = max(fwidth(p.xz), 1e-4), q = abs(fract(p.xz * 0.5) - 0.5);
  vec2 s = clamp((q - 0.25) / (0.5 * w) , -0.5, 0.5);
  float tile = 0.5 - 2.0 * s.x * s.y;
  float near = clamp(1.6 * (1.0 - length(p.xz - target.xz) / reach), 0.0, 1.0);
  shown = vec4(0.867, 0.894, 0.925, tile * near);
}`);
const plane = gl.createVertexArray();
gl.bindVertexArray(plane);
attribute(0, 3, new Float32Array([-1, 0, -1, 1, 0, -1, -1, 0, 1, 1, 0, 1]));
// Paths are ribbons on the ground.
function ribbons(path, high) {
  if (!path) return null;
  const width = 0.012 * data.size, found = new Float32Array(characters * frames * 6);
  for (let who = 0; who < characters; who++) for (let f = 0; f < frames; f++) {
    const at = 2 * (who * frames + f), end = 2 * (who * frames + frames - 1);
    const b = Math.max(at - 2, 2 * who * frames), a = Math.min(at + 2, end);
    let dx = path[a] - path[b], dz = path[a + 1] - path[b + 1];
    const long = Math.hypot(dx, dz) || 1;
    dx *= width / long; dz *= width / long;
    found.set([path[at] - dz, high, path[at + 1] + dx,
               path[at] + dz, high, path[at + 1] - dx], 3 * at);
  }
  const made = gl.createVertexArray();
  gl.bindVertexArray(made); attribute(0, 3, found);
  return made;
}
const paths = data.paths.map(([name, color, values], i) =>
  [name, color, ribbons(floats(values), 0.006 + 0.002 * i)]);
for (const [name, color] of [...data.paths, ...(ghost ? [["plan", "#8fa3b8"]] : [])]) {
  const key = document.createElement("i");
  key.className = "key"; key.style.background = color;
  element("keys").append(key, " " + name + " ");
}

let frame = 0, playing = true, azimuth = data.azimuth, elevation = data.elevation;
let zoom = 1, stale = true;
slider.max = frames - 1;
function matrix(target, distance, aspect) {
  const [ca, sa] = [Math.cos(azimuth), Math.sin(azimuth)];
  const [ce, se] = [Math.cos(elevation), Math.sin(elevation)];
  const axes = [[ca, 0, -sa], [-se * sa, ce, -se * ca], [ce * sa, se, ce * ca]];
  const shift = axes.map(a => -a[0] * target[0] - a[1] * target[1] - a[2] * target[2]);
  shift[2] -= distance;
  const focal = 4, near = 0.02 * distance, far = 30 * distance;
  const rows = [[focal / aspect, 0, 0, 0], [0, focal, 0, 0],
    [0, 0, (far + near) / (near - far), 2 * far * near / (near - far)], [0, 0, -1, 0]];
  const found = [];
  for (let k = 0; k < 4; k++) for (const row of rows) {
    let sum = k == 3 ? row[3] : 0;
    for (let n = 0; n < 3; n++) sum += row[n] * (k == 3 ? shift[n] : axes[n][k]);
    found.push(sum);
  }
  return new Float32Array(found);
}
function draw() {
  const ratio = window.devicePixelRatio || 1, now = Math.floor(frame);
  const [w, h] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
  if (canvas.width != w || canvas.height != h) { canvas.width = w; canvas.height = h; }
  const target = targets.slice(3 * now, 3 * now + 3), aspect = w / h;
  const distance = data.reach / Math.sin(Math.atan(Math.min(aspect, 1) / 4)) / zoom;
  const view = matrix(target, distance, aspect);
  gl.viewport(0, 0, w, h);
  gl.clearColor(0.965, 0.973, 0.98, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  gl.disable(gl.DEPTH_TEST);
  gl.useProgram(flat.made);
  gl.uniformMatrix4fv(flat.at("view"), false, view);
  gl.uniform3fv(flat.at("target"), target);
  gl.uniform1f(flat.at("reach"), 0.9 * distance);
  gl.bindVertexArray(plane);
  gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  gl.uniform1f(flat.at("reach"), 0);
  for (const [name, color, made] of paths) for (let who = 0; who < characters; who++) {
    gl.bindVertexArray(made);
    const start = 2 * who * frames;
    if (name == "commanded") {
      gl.uniform4f(flat.at("paint"), ...rgb(color), 0.35);
      gl.drawArrays(gl.TRIANGLE_STRIP, start, 2 * frames);
    }
    gl.uniform4f(flat.at("paint"), ...rgb(color), 1);
    gl.drawArrays(gl.TRIANGLE_STRIP, start, 2 * now + 2);
  }
  useMeshes(view, data.light, data.body.palette);
  assemble(body, now, mesh);
  const round = gather(now);
  drawShadow(mesh);
  round.forEach((_, i) => drawShadow(spheres[i]));
  drawMesh(mesh);
  round.forEach(([, , color], i) => drawMesh(spheres[i], rgb(color)));
  if (ghost) {
    assemble(ghost, now, pale);
    drawGhost(pale);
  }
  slider.value = now;
  element("clock").textContent = (now / data.fps).toFixed(2) + " s of " +
    ((frames - 1) / data.fps).toFixed(2) + " s";
}
let last = null;
function loop(time) {
  // The first time of an animation may lie before the script's own.
  if (playing && last !== null)
    frame = (frame + Math.max(time - last, 0) / 1000 * data.fps) % frames;
  last = time;
  if (playing || stale) draw();
  stale = false;
  requestAnimationFrame(loop);
}
function toggle() {
  playing = !playing; button.textContent = playing ? "pause" : "play";
}
function stop() { stale = true; if (playing) toggle(); }
button.onclick = toggle;
slider.oninput = () => { frame = +slider.value; stop(); };
window.onresize = () => { stale = true; };
window.onkeydown = e => {
  const step = {ArrowLeft: -1, ArrowRight: 1}[e.code];
  if (e.code === "Space" && e.target !== button) { e.preventDefault(); toggle(); }
  if (step && e.target !== slider) {
    frame = (Math.floor(frame) + step + frames) % frames; stop();
  }
};
canvas.onpointerdown = e => canvas.setPointerCapture(e.pointerId);
canvas.onpointermove = e => {
  if (!e.buttons) return;
  azimuth -= e.movementX * 0.01; stale = true;
  elevation = Math.min(1.5, Math.max(0.02, elevation + e.movementY * 0.01));
};
canvas.addEventListener("wheel", e => {
  e.preventDefault(); stale = true;
  zoom = Math.min(8, Math.max(0.2, zoom * Math.exp(-e.deltaY / 600)));
}, {passive: false});
requestAnimationFrame(loop);
</script></body></html>
"""
_MANNEQUIN = Path(__file__).with_name("mannequin.js").read_text(encoding="utf-8")
# Where the light is, seen from the first view; as in GIFs.
_LIGHT = np.array([-0.42, 0.78, 0.46])


def _floats(values: np.ndarray) -> str:
    return base64.b64encode(np.asarray(values, "<f4").tobytes()).decode("ascii")


def _pose(stage: Stage, motion: Motion) -> dict[str, str]:
    """Root positions, and two unit columns per rotation as 16-bit integers."""
    turns = np.asarray(motion.joint_rotation, float)
    x = turns[..., :3] / np.linalg.norm(turns[..., :3], axis=-1, keepdims=True)
    y = turns[..., 3:] - np.sum(x * turns[..., 3:], axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    whole = np.round(32767 * np.concatenate([x, y], axis=-1)).astype("<i2")
    packed = base64.b64encode(whole.tobytes()).decode("ascii")
    return {"root": _floats(np.asarray(motion.root_position)), "turn": packed}


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")


def _body(body: Mannequin) -> dict[str, Any]:
    """The mesh in few bytes: a place to 1/65535 of the height, weights to 1/255."""
    low = body.vertices.min(axis=0)
    step = float(np.ptp(body.vertices, axis=0).max()) / 65535
    weights = np.round(255 * body.weights).astype(int)
    weights[:, 0] += 255 - weights.sum(axis=1)
    return {
        "low": low.tolist(),
        "step": step,
        "places": _base64(np.round((body.vertices - low) / step).astype("<u2")),
        "normals": _base64(np.round(127 * body.normals).astype("i1")),
        "joints": _base64(body.joints.astype("<u2")),
        "weights": _base64(weights.astype("u1")),
        "materials": _base64(body.materials.astype("u1")),
        "faces": _base64(body.faces.astype("<u2")),
        "inverse": np.round(body.inverse_bind, 5).ravel().tolist(),
        "palette": body.palette,
    }


def page(stage: Stage, *, title: str = "", caption: str = "") -> str:
    """The page as text.

    Args:
      title: Above the picture, in one line; escaped, like the caption.
      caption: Below it, small: the source of the data and its license.
    """
    seen = stage.outline
    low, high = seen.min(axis=(0, 2)), seen.max(axis=(0, 2))
    targets = cameras.smooth(0.5 * (low + high), 0.5 * stage.fps)
    away = np.linalg.norm(seen - targets[:, None], axis=-1)
    many = len(stage.positions) > 3
    azimuth = np.deg2rad(cameras.toward(stage.walked))
    elevation = np.deg2rad(28.0 if many else 16.0)
    axes = cameras.view_axes(
        azimuth=float(np.rad2deg(azimuth)), elevation=float(np.rad2deg(elevation))
    )
    paths = [("walked", drawing.WALKED, _floats(stage.walked))]
    if stage.wanted is not None:
        paths.insert(0, ("commanded", drawing.COMMANDED, _floats(stage.wanted)))
    data = {
        "shape": stage.positions.shape[:2],
        "fps": stage.fps,
        "parents": stage.skeleton.parents,
        "offsets": np.round(np.asarray(stage.skeleton.offsets, float), 5).tolist(),
        "body": _body(stage.body),
        "motion": _pose(stage, stage.motion),
        "ghost": None if stage.ghost is None else _pose(stage, stage.ghost),
        "paths": paths,
        "ball": None,
        "targets": _floats(targets),
        "reach": round(1.02 * float(away.max()), 4),
        "size": round(float(np.ptp(seen[0, 0, :, 1])), 3),
        "azimuth": round(float(azimuth), 4),
        "elevation": round(float(elevation), 4),
        "light": (axes.T @ _LIGHT / np.linalg.norm(_LIGHT)).round(4).tolist(),
    }
    if stage.ball is not None:
        data["ball"] = {
            "position": _floats(stage.ball.position),
            "radius": stage.ball.radius,
            "touching": [stage.ball.touching(f) for f in range(len(targets))],
        }
    # "</" would end the script element wherever it stands.
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    filled = {
        "__TITLE__": escaping.escape(title),
        "__CAPTION__": escaping.escape(caption),
        "__DATA__": text,
        "__MANNEQUIN__": _MANNEQUIN,
    }
    # In one pass: a title may contain the name of the other slot.
    return re.sub(
        "__(TITLE|CAPTION|DATA|MANNEQUIN)__", lambda slot: filled[slot.group()], _PAGE
    )


def save_html(
    path: str | Path, stage: Stage, *, title: str = "", caption: str = ""
) -> None:
    """Writes the page; see there."""
    text = page(stage, title=title, caption=caption)
    files.write_text(drawing.check_writable(path), text)
