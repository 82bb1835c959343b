// The page: scene, input and panel around a source of frames, which is a socket
// (`socket.js`) or a Worker (`local.js`) and speaks the messages of `jaxmotion.viz.page`.

import { kinematics, skin, unpack } from "./body.js";
import { Camera } from "./camera.js";
import { Figures } from "./figures.js";
import { Input, KEYS } from "./input.js";
import { Panel } from "./panel.js";
import { dress } from "./rig.js";
import { bvh, glb } from "./save.js";
import { Scene } from "./scene.js";

const $ = id => document.getElementById(id);
const GREEN = [0.17, 0.63, 0.17, 0.9], VIOLET = [0.5, 0.36, 0.75, 0.9];
const ORANGE = [1, 0.5, 0.05, 0.8], BALL = 0.11, KEPT = 10, TRAIL = 600;
// Meters in a frame that nobody goes: who was put there is in another take.
const JUMP = 0.5;
const HASH = [
  "model", "label", "speed", "num_steps", "scale", "foot_lock", "characters", "plan",
];

// What follows "#" in the address: settings by name, and the camera.
export function readHash(text) {
  const found = {};
  for (const [name, value] of new URLSearchParams(text.replace(/^#/, ""))) {
    if (name === "model") found[name] = value;
    else if (Number.isFinite(+value)) found[name] = +value;
  }
  for (const name of ["foot_lock", "plan"])
    if (name in found) found[name] = Boolean(found[name]);
  return found;
}

// A frame as `jaxmotion.viz.page` packs it.
export function readFrame(data) {
  const [engine, tick, ms, plans, n, joints, balls, fps, vx, vz, fx, fz, ahead] = data;
  let at = 13;
  const take = count => data.subarray(at, at += count);
  return {
    engine, tick, ms, plans, n, joints, fps, told: [vx, vz, fx, fz],
    roots: take(3 * n), rotations: take(6 * n * joints), ball: take(3 * balls),
    path: take(2 * ahead),
    ghost: ahead ? { root: take(3), rotation: take(6 * joints) } : null,
  };
}

// Poses between two, a part of the way.
function mix(from, to, part) {
  const made = {};
  for (const name of ["roots", "rotations", "ball"]) {
    const a = from[name], b = to[name], x = made[name] = new Float32Array(b.length);
    for (let i = 0; i < b.length; i++) x[i] = a[i] + part * (b[i] - a[i]);
  }
  return made;
}

export function start(source) {
  const view = $("view"), camera = new Camera(), hash = readHash(location.hash);
  // body: the character's; drawn: what is shown, a dropped file or the body itself.
  let body = null, drawn = null, file = null, number = 0, told = "", trail = [], remembering = 0;
  let frame = null;  // shown: from, to, when it was due
  let linked = "", awaited = 1;  // of a link: what was asked for, the engine that must be there
  const flat = new Figures();
  const due = [], history = [], arrivals = [], kept = [];
  const spent = window.spent = [];
  const say = message => source.say(message);
  const panel = new Panel(say, {
    reset() { input.forget(); trail = []; kept.length = 0; tell(); },
    save(suffix) { download(suffix); },
    link() { copyLink(); },
    wear,
  });
  window.panel = panel;
  let lastNews = 0;
  const news = () => { lastNews = performance.now(); };
  const input = window.input = new Input(view, camera, $("stick"), {
    change: () => tell(), news, fail: text => panel.fail(text),
    here: () => (frame ? [frame.to.roots[0], frame.to.roots[2]] : [0, 0]),
    key(code) {
      const digit = /^(?:Digit|Numpad)([1-9])$/.exec(code), { state } = panel;
      if (digit && state && +digit[1] <= state.labels.length) panel.choose(+digit[1] - 1);
      if (code === "KeyC") panel.crouch();
      if (code === "Next" && state) panel.choose(state.label + 1);
      if (code === "Previous" && state) panel.choose(state.label - 1);
      if (code === "Space") $("paused").click();
      if (code === "Period") say({ do: "step" });
      if (code === "KeyR") $("reset").click();
      if (code === "KeyT" && state && state.recordable !== false) say({ do: "record" });
    },
  });
  for (const [name, field] of [["az", "azimuth"], ["el", "elevation"], ["far", "distance"]])
    if (name in hash) camera[field] = hash[name];
  let scene;
  try {
    scene = new Scene(view);
  } catch (error) {
    panel.broken = error.message; panel.note();
    return;
  }
  for (const name of ["keydown", "keyup", "pointermove", "pointerdown", "resize"])
    window.addEventListener(name, news);

  for (const name of ["dragover", "dragleave", "drop"])
    window.addEventListener(name, event => {
      event.preventDefault();
      view.classList.toggle("over", name === "dragover");
      const { files } = event.dataTransfer;
      if (name === "drop" && files.length) wear(files[0]);
    });

  function tell() {
    const asked = input.asked(), text = JSON.stringify(asked);
    if (text !== told) { told = text; say(asked); }
    const { held } = input;
    for (const name of new Set(Object.values(KEYS)))
      $("k_" + name).classList.toggle("on", held.has(name));
    news();
  }
  // Asks for what a link does and the source did not begin with. Labels and numbers of
  // steps are a model's own, and it begins with its own foot lock: they come last.
  function link(state) {
    const ask = names => {
      for (const x of names)
        if (x in hash && hash[x] !== state[x]) say({ set: { [x]: hash[x] } });
    };
    if (!linked) {
      linked = "model";
      if (state.models.includes(hash.model) && hash.model !== state.model) {
        awaited = state.engine + 1;
        ask(["model"]);
      }
      ask(["speed", "characters", "plan"]);
    } else if (linked === "model" && (state.engine >= awaited && !state.note
      || state.note.startsWith("error"))) {
      linked = "all";
      ask(["label", "num_steps", "scale", "foot_lock"]);
    }
  }
  const on = {
    open() { told = ""; panel.waiting = source.open ? "" : source.waiting; panel.note(); tell(); },
    state(state) {
      if (state.model && !source.base) link(state);  // without a server the player does
      panel.show(state); news();
      // Browsers refuse an address that changes too often, as with a slider.
      clearTimeout(remembering);
      if (source.base || linked === "all") remembering = setTimeout(remember, 400);
    },
    body(buffer, engine) {
      body = unpack(buffer); number = engine;
      frame = null; trail = [];
      for (const one of [due, history, kept]) one.length = 0;
      const worn = file;
      clothe(null);
      if (worn) clothe(worn);
    },
    frame(data, time) {
      const found = readFrame(data);
      if (!body || found.engine !== number) return;
      due.push({ ...found, due: time });
      if (document.hidden) advance(performance.now());  // nobody draws them
      history.push([found.ms, found.plans]); if (history.length > 240) history.shift();
      arrivals.push(performance.now());
      while (arrivals[0] < performance.now() - 2000) arrivals.shift();
      news();
    },
    error(text) { panel.fail(text); },
    saved(name) { panel.saved(name); },
  };

  // Shows a file, or the character's own body; what cannot be worn changes nothing.
  function clothe(next) {
    if (!body) { file = next; return; }
    try {
      if (next && !body.wear) throw new Error(source.base
        ? "this model's skeleton is no person's" : "start the page with it: steer.py --rig");
      drawn = next ? dress(next.content, body.wear) : body;
    } catch (error) { panel.fail(`${next.name}: ${error.message}`); return; }
    file = next;
    scene.show(drawn);
    panel.wears(file && file.name);
    news();
  }
  async function wear(chosen) {
    if (!chosen) { clothe(null); return; }
    let content;
    try {
      content = await chosen.arrayBuffer();
    } catch { panel.fail(`${chosen.name} cannot be read`); return; }
    clothe({ name: chosen.name, content });
  }
  // A frame of the character as what is drawn has it.
  const worn = (root, rotation) => (drawn.pose ? drawn.pose(root, rotation) : { root, rotation });

  // Takes over the frames that are due; what is on the screen goes over into them.
  function advance(now) {
    while (due.length && due[0].due <= now) {
      const to = due.shift();
      const same = frame && frame.to.n === to.n && frame.to.ball.length === to.ball.length;
      frame = { to, from: same ? between(now) : to, time: now };
      const [x, , z] = to.roots, last = trail[trail.length - 1];
      if (last && Math.hypot(x - last[0], z - last[1]) > 2) trail = [];
      if (!last || Math.hypot(x - last[0], z - last[1]) > 0.04) trail.push([x, z]);
      if (trail.length > TRAIL) trail.shift();
      const was = kept[kept.length - 1];
      if (was && Math.hypot(x - was[0][0], z - was[0][2]) > JUMP) kept.length = 0;  // anew
      kept.push([to.roots.slice(0, 3), to.rotations.slice(0, 6 * to.joints)]);
      if (kept.length > KEPT * to.fps) kept.shift();
      window.shown = to;
    }
  }
  const between = now =>
    mix(frame.from, frame.to, Math.min(1, (now - frame.time) * frame.to.fps / 1000));

  let before = performance.now(), lastPlot = 0, fitted = 0, world = null, people = null;
  let rolled = [], finer = 1, pace = 0, since = 0, rest = 0, ticks = 0;
  // Fewer pixels where pictures come too slowly, more where they come easily. Where the
  // cores draw, too, and frames come too slowly, fewer pictures: motion goes before them.
  function adapt(began, interval) {
    pace += 0.1 * (Math.min(interval, 500) - pace);
    if (began - since < 1500) return;
    const least = scene.slow ? 0.7 : 0.5;  // pixels are little of what the cores do
    if (pace > 45 + rest && finer > least) finer *= 0.8;
    else if (pace < 20 + rest && finer < 1) finer = Math.min(1, 1.25 * finer);
    const came = frame ? frame.to.tick - ticks : 0;
    const late = scene.slow && came > 0 && came < 0.97 * (began - since) * frame.to.fps / 1000;
    rest = late ? Math.min(rest + 30, 150) : Math.max(rest - 10, 0);
    since = began;
    if (frame) ticks = frame.to.tick;
  }
  function draw(now) {
    requestAnimationFrame(draw);
    const began = performance.now();
    input.readPad();
    advance(began);
    // A still picture is drawn once.
    if (began - lastNews > 1000 && !due.length || now - before < rest) return;
    const seconds = Math.min(1, (now - before) / 1000);
    adapt(began, now - before); before = now;
    input.turn(seconds);
    const ratio = finer * Math.min(devicePixelRatio || 1, 2);
    const w = Math.round(view.clientWidth * ratio), h = Math.round(view.clientHeight * ratio);
    if (view.width !== w || view.height !== h) { view.width = w; view.height = h; }
    const pose = frame && between(began), n = frame ? frame.to.n : 0;
    const joints = drawn ? drawn.skeleton.parents.length : 0;
    let reach = 3.5, ghosts = null, balls = null;
    if (pose) {
      follow(pose, n, seconds);
      if (!world || world.length !== 12 * joints) world = new Float32Array(12 * joints);
      if (!people || people.length !== 12 * joints * n)
        people = new Float32Array(12 * joints * n);
      for (let i = 0; i < n; i++) place(pose.roots, pose.rotations, i, people, 12 * joints * i);
      for (let i = 0; i < n; i++)
        reach = Math.max(reach, 1.5 + Math.hypot(pose.roots[3 * i] - camera.at[0],
          pose.roots[3 * i + 2] - camera.at[2]));
      reach = Math.min(reach, 24);
      const { ghost } = frame.to;
      if (ghost) {
        ghosts = new Float32Array(12 * joints);
        place(ghost.root, ghost.rotation, 0, ghosts, 0);
      }
      balls = roll(pose.ball);
    } else people = null;
    const aside = $("panel").classList.contains("folded") || view.clientWidth < 700
      ? 0 : $("panel").offsetWidth / view.clientWidth;
    camera.see(view, aside);
    const figures = pose ? figuresOf(pose) : [];
    const own = performance.now() - began;
    scene.draw({ camera, people: pose ? people : null, ghosts, balls, joints, figures, reach });
    spent.push([own, performance.now() - began - own]); if (spent.length > 600) spent.shift();
    if (frame && now - lastPlot > 200) {
      lastPlot = now;
      const span = arrivals[arrivals.length - 1] - arrivals[0];
      panel.plot(history, frame.to.fps,
        arrivals.length > 1 ? (arrivals.length - 1) * 1000 / span : 0);
    }
  }

  function place(roots, rotations, i, out, at) {
    const count = 6 * body.skeleton.parents.length;
    const { root, rotation } = worn(roots.subarray(3 * i, 3 * i + 3),
      rotations.subarray(count * i, count * (i + 1)));
    kinematics(drawn.skeleton, root, rotation, world);
    skin(world, drawn.arrays.inverse, out, at);
  }

  function follow(pose, n, seconds) {
    let x = 0, z = 0;
    for (let i = 0; i < n; i++) { x += pose.roots[3 * i]; z += pose.roots[3 * i + 2]; }
    camera.follow(x / n, z / n, fitted ? 1 - Math.exp(-8 * seconds) : 1);
    if (fitted !== n) {
      if (fitted || !("far" in hash)) camera.distance = 4.8 + 1.9 * (Math.sqrt(n) - 1);
      if (fitted || !("el" in hash)) camera.elevation = n > 1 ? 0.42 : 0.24;
      fitted = n;
    }
  }

  // What moves the balls: where they are, turned as they rolled.
  function roll(ball) {
    const count = ball.length / 3, moved = new Float32Array(12 * count);
    if (rolled.length !== count)
      rolled = [...Array(count)].map((_, i) => ({
        at: ball.slice(3 * i, 3 * i + 3), turn: [1, 0, 0, 0, 1, 0, 0, 0, 1],
      }));
    rolled.forEach((one, i) => {
      const at = ball.subarray(3 * i, 3 * i + 3);
      const [dx, dz] = [at[0] - one.at[0], at[2] - one.at[2]], far = Math.hypot(dx, dz);
      if (far > 1e-6 && far < 1) one.turn = turned(one.turn, [dz / far, -dx / far], far / BALL);
      one.at = at.slice();
      for (let r = 0; r < 3; r++) {
        for (let c = 0; c < 3; c++) moved[12 * i + 4 * r + c] = BALL * one.turn[3 * r + c];
        moved[12 * i + 4 * r + 3] = at[r];
      }
    });
    return moved;
  }

  function figuresOf(pose) {
    const made = flat.clear(), { to } = frame, [x, , z] = pose.roots;
    made.ribbon(trail, 0.035, ORANGE);
    const [vx, vz, fx, fz] = to.told;
    if (to.path.length) {
      const points = [];
      for (let i = 0; i < to.path.length; i += 2) points.push(to.path.slice(i, i + 2));
      const seconds = points.length / to.fps;
      made.ribbon([[x + seconds * vx, z + seconds * vz], [x, z]], 0.035, GREEN);
      made.ribbon(points.reverse(), 0.06, VIOLET);
    }
    made.arrow(x, z, [vx, vz], [fx, fz], GREEN);
    [input.from, ...input.path].forEach((point, i, all) => {
      if (!i) return;
      made.ribbon([all[i - 1], all[i - 1], point], 0.05, GREEN);
      made.ring(...point, 0, 0.07, GREEN);
    });
    if (input.target) {
      made.ring(...input.target, 0.16, 0.05, GREEN);
      made.ring(...input.target, 0, 0.05, GREEN);
    }
    return made.values;
  }

  // The first character's last ten seconds as a file.
  function download(suffix) {
    if (!kept.length || !body) { panel.fail("nothing was shown yet"); return; }
    const fps = frame.to.fps, poses = kept.map(one => worn(...one));
    const [roots, rotations] = ["root", "rotation"].map(name => poses.map(x => x[name]));
    const data = suffix === ".glb" ? glb(drawn, fps, roots, rotations)
      : bvh(drawn.skeleton, fps, roots, rotations);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([data]));
    link.download = `${panel.state.model.split(/[/\\]/).pop()}${suffix}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  // The address holds the settings.
  function remember() {
    const { state } = panel;
    if (!state || !state.model) return;
    const all = "workers" in hash ? { ...state, workers: hash.workers } : state;
    const text = [...HASH, "workers"].filter(x => x in all).map(x => `${x}=${
      encodeURIComponent(typeof all[x] === "boolean" ? +all[x] : all[x])}`).join("&");
    if (`#${text}` !== location.hash.split("&az=")[0])
      window.history.replaceState(null, "", `#${text}`);
  }
  async function copyLink() {
    remember();
    const { azimuth, elevation, distance } = camera;
    const view = [azimuth, elevation, distance].map(x => x.toFixed(2));
    const text = `${location.href.split("&az=")[0]}&az=${view[0]}&el=${view[1]}&far=${view[2]}`;
    window.history.replaceState(null, "", text);
    let copied = true;
    try { await navigator.clipboard.writeText(text); } catch { copied = false; }
    $("link").textContent = copied ? "copied" : "see the address";
    setTimeout(() => { $("link").textContent = "link"; }, 2000);
  }

  panel.waiting = source.open ? "" : source.waiting;
  panel.note();
  requestAnimationFrame(draw);
  source.connect(on, hash);
  tell();
}

// A rotation (rows) turned further about an axis (x, z) on the ground.
function turned(m, [x, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  const r = [c + x * x * d, -z * s, x * z * d, z * s, c, -x * s, x * z * d, x * s, c + z * z * d];
  const made = [];
  for (let i = 0; i < 3; i++) for (let k = 0; k < 3; k++)
    made.push(r[3 * i] * m[k] + r[3 * i + 1] * m[3 + k] + r[3 * i + 2] * m[6 + k]);
  return made;
}
