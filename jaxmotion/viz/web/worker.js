// The Worker of the static page: makes frames a little ahead of what is shown, so that a
// plan that takes long holds up no picture. Obeys what the live page's server obeys. Where
// one core is too slow for a crowd, others help: Workers of this file, too.

import * as ort from "onnxruntime-web/wasm";
import { Crowd } from "./crowd.js";
import { Helper, help } from "./group.js";
import { unpacked } from "./packing.js";
import { Model } from "./player.js";
import loader from "./loader.mjs";

// Ticks to be ahead: at least so many, and never more.
const LEAST = 2, MOST = 15, AHEAD = 30, MOST_CHARACTERS = 64, SPEEDS = [0.3, 4.0];
const state = {
  model: "", label: 0, speed: 1.4, num_steps: 1, scale: 1, foot_lock: true,
  characters: 1, plan: false, paused: false, engine: 0, models: [], labels: [], fps: 0,
  source: "", steps: [], scales: null, lockable: false, planning: false,
  speeds: SPEEDS, most_characters: MOST_CHARACTERS, note: "starting", recording: false,
  taken: 0, recordable: false,
};
let base = "", crowd = null, model = null, single = 0, inputs = null, due = 0, busy = false;
const nothing = { held: [], azimuth: 0, target: null };
inputs = nothing;
const opened = new Map();
// Bodies lie beside the models' folders, since models share them.
const bodies = kept(file => fetched(`${file}.packed`));
// The runtime imports its own loader by an address; it is in this file already.
globalThis.loader = loader;
const source = new Blob(["export default globalThis.loader"], { type: "text/javascript" });
ort.env.wasm.wasmPaths = { mjs: URL.createObjectURL(source) };
// Groups of characters that there may be: the page draws on one of the cores.
let most = Math.max((navigator.hardwareConcurrency || 2) - 1, 1);
const helper = model => new Helper(base, model, ort.env.wasm.wasmBinary);

const tell = () => postMessage({ state: { ...state } });
function note(text) { state.note = text; tell(); }
// One line for whoever looks, and no more frames of what failed.
function fail(error) { note(`error: ${String(error.message || error).split("\n")[0]}`); }

// A file of the folder, unpacked if it is packed.
async function fetched(path) {
  let answer;
  try {
    answer = await fetch(new URL(path, base));
  } catch {
    throw new Error(`${path} cannot be fetched`);
  }
  if (!answer.ok) throw new Error(`${path} is missing (${answer.status})`);
  try {
    return await unpacked(new Uint8Array(await answer.arrayBuffer()));
  } catch {
    throw new Error(`${path} is damaged`);
  }
}

// The smallest module with a vector instruction.
const SIMD = [0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1,
  8, 0, 65, 0, 253, 15, 253, 98, 11];

async function open(message) {
  base = message.base;
  if (typeof WebAssembly !== "object" || !WebAssembly.validate(new Uint8Array(SIMD)))
    throw new Error("this browser has no WebAssembly SIMD: plans cannot be made here");
  note("loading");
  // Both at once; who fails first is told.
  const runtime = fetched("ort.wasm.packed").then(binary => {
    ort.env.wasm.numThreads = 1;
    ort.env.wasm.wasmBinary = binary;
  });
  runtime.catch(() => {});
  const about = await fetched("models.json");
  state.models = JSON.parse(new TextDecoder().decode(about)).models;
  const wish = message.settings || {};
  if (wish.workers >= 1) most = wish.workers;
  await choose(wish.model || state.models[0], wish, runtime);
}

// Another model; settings that it does not have are those it was made with.
async function choose(name, wish = {}, runtime = null) {
  if (!state.models.includes(name))
    throw new Error(`unknown model ${name}, expected one of ${state.models.join(", ")}`);
  note(`loading ${name}`);
  if (!opened.has(name)) {
    const read = kept(file => fetched(`${name}/${file}.packed`));
    opened.set(name, await new Model(ort, read).open(name));
  }
  const next = opened.get(name), { about } = next;
  const label = Number(wish.label) || 0, steps = Number(wish.num_steps);
  const [low, high] = about.scales || [];
  const given = {
    label: about.labels[label] ? label : 0,
    num_steps: about.steps.includes(steps) ? steps : about.num_steps,
    scale: wish.scale >= low && wish.scale <= high ? wish.scale : about.scale,
    foot_lock: "foot_lock" in wish ? wish.foot_lock : true,
  };
  model = next;
  if (crowd) crowd.close();
  crowd = null;
  Object.assign(state, given, {
    model: name, labels: about.labels, fps: about.fps, source: about.source,
    steps: about.steps, scales: about.scales, lockable: about.lockable,
    planning: Boolean(about.plan), engine: state.engine + 1,
  });
  for (const key of ["speed", "characters", "plan"])
    if (key in wish) state[key] = wish[key];
  // Somebody stands there before anything can walk.
  const waiting = new Crowd(next, state);
  waiting.resize(state.characters);
  postMessage({ body: await bodies(about.body), engine: state.engine });
  const standing = waiting.standing();
  if (standing) show(standing, performance.now());
  for (const name of about.runs[state.num_steps])  // all at once, not one by one
    next.read(about.graphs[name].file).catch(() => {});
  await runtime;
  await next.prepare(state.num_steps, true);
  await next.gather(state.characters, state.num_steps);
  const made = new Crowd(next, state, helper, most);
  while (made.needs(state.characters)) await made.enlist(state.num_steps);
  crowd = made;
  state.note = "";
  begin();
  tell();
}

// Files of a model, each fetched once.
function kept(read) {
  const found = new Map();
  return name => {
    if (!found.has(name)) found.set(name, read(name));
    return found.get(name);
  };
}

function show(data, time) {
  postMessage({ frame: data, due: performance.timeOrigin + time }, [data.buffer]);
}

function begin() {
  crowd.restart();
  crowd.resize(state.characters);
  due = performance.now();
}

const CHANGES = {
  async model(value) { await choose(value, { characters: state.characters }); },
  async num_steps(value) {
    if (!state.steps.includes(value)) throw new Error(`${value} steps are none offered`);
    note(`loading ${value} steps`);
    await crowd.prepare(value, state.characters);
    state.num_steps = value; state.note = "";
  },
  async characters(value) {
    state.characters = value;
    await crowd.prepare(state.num_steps, value);
    if (!crowd.needs(value)) { crowd.resize(value); return; }
    // Who is there goes on until another core is ready.
    const grown = crowd;
    grown.enlist(state.num_steps).then(() => {
      queue.push({ grown });
      work();
    }, fail);
  },
};

async function obey(message) {
  if (message.base) return open(message);
  if (message.grown) {
    if (message.grown === crowd) await CHANGES.characters(state.characters);
    else message.grown.close();
    return;
  }
  if (message.held) { inputs = message; return; }
  // Where one model does not load, another one may.
  if (!crowd && !(message.set && message.set.model)) return;
  if (message.do === "reset") begin();
  if (message.do === "step") single += 1;
  for (const [name, value] of Object.entries(message.set || {})) {
    if (CHANGES[name]) await CHANGES[name](value); else state[name] = value;
    if (name === "paused") due = performance.now();
  }
  if (message.set) tell();
}

// Offers as many characters as this device bears, now and then.
let measured = 0;
function measure() {
  if (crowd.tick < 90 || performance.now() - measured < 3000) return;
  measured = performance.now();
  const most = Math.min(Math.max(crowd.bears(), state.characters, 2), MOST_CHARACTERS);
  if (Math.abs(most - state.most_characters) < 0.2 * state.most_characters) return;
  state.most_characters = most;
  tell();
}

// Messages are obeyed in their order, between two ticks.
const queue = [];
let helps = null;
onmessage = ({ data }) => {
  if (helps) helps(data);
  else if (data.helps) helps = help(ort, data, message => postMessage(message));
  else { queue.push(data); work(); }
};
const later = ms => new Promise(done => setTimeout(done, ms));

async function work() {
  if (busy) return;
  busy = true;
  for (;;) {
    while (queue.length) await obey(queue.shift()).catch(fail);
    if (!crowd || (state.paused && !single) || state.note.startsWith("error")) break;
    const tick = 1000 / state.fps, now = performance.now();
    const slow = Math.ceil((crowd.callMs + 2 * crowd.tickMs) / tick);
    const depth = model.left.length ? AHEAD : Math.min(Math.max(LEAST, slow + 1), MOST);
    if (due < now) due = now;  // too slow: time stands still rather than jumps
    const early = due - now - (depth - 1) * tick;
    if (early > 1 && !single) {
      // There are enough frames to make what was left when it began.
      if (model.left.length) await model.finish().catch(fail);
      else await later(Math.min(early, tick));
      continue;
    }
    try {
      const data = await crowd.next(inputs, due - now + tick);
      single = Math.max(single - 1, 0);
      show(data, due);
      measure();
      due += tick;
    } catch (error) { fail(error); }
    await later(0);
  }
  busy = false;
}
