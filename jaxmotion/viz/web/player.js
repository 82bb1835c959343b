// Runs the graphs of a character: the order of calls that its description names. The
// run-time itself (springs, seams, foot lock) is in the graphs.

import { unpack } from "./body.js";

// Standard normal noise from uniform one, by Box and Muller.
export function normals(count, random = Math.random) {
  const made = new Float32Array(count + count % 2);
  for (let i = 0; i < made.length; i += 2) {
    const far = Math.sqrt(-2 * Math.log(1 - random())), turn = 2 * Math.PI * random();
    made[i] = far * Math.cos(turn); made[i + 1] = far * Math.sin(turn);
  }
  return made.subarray(0, count);
}

// The end of what the runtime says, which begins with places in its own sources.
function oneLine(error) {
  const text = String(error && error.message || error).split("\n")[0];
  return text.length > 160 ? `... ${text.slice(-150)}` : text;
}

// Milliseconds in which a graph is made without anybody noticing.
const QUICK = 700;
const KINDS = { float32: Float32Array, int32: Int32Array, bool: Uint8Array };
const size = shape => shape.reduce((a, b) => a * b, 1);

// Constants as the graphs refer to them, of a file of `jaxmotion.export.slim`: 16-bit
// floats become 32-bit ones, of which each begins at a multiple of four bytes, as the
// others do.
export function widen(packed, parts) {
  const sizes = parts.map(([half, bytes]) => (half ? 2 * bytes : bytes));
  const sum = values => values.reduce((a, b) => a + b, 0);
  const made = new Uint8Array(sum(sizes)), wide = new Float32Array(made.buffer);
  const halves = sum(parts.map(([half, bytes]) => (half ? bytes : 0))) / 2;
  // Others, then the floats' upper bytes, then their lower ones.
  let other = 0, upper = packed.length - 2 * halves, to = 0;
  parts.forEach(([half, bytes], i) => {
    if (half)
      for (let k = 0; k < bytes / 2; k++, upper++)
        wide[to / 4 + k] = float(packed[upper] << 8 | packed[upper + halves]);
    else { made.set(packed.subarray(other, other + bytes), to); other += bytes; }
    to += sizes[i];
  });
  return made;
}

// A 16-bit float.
function float(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, part = bits & 1023;
  if (exponent === 0) return sign * part * 2 ** -24;
  if (exponent === 31) return part ? NaN : sign * Infinity;
  return sign * (1024 + part) * 2 ** (exponent - 25);
}

export class Model {
  // ort: onnxruntime-web; read: (file name) -> promise of its bytes, unpacked; draw:
  // (count) -> noise.
  constructor(ort, read, draw = normals) {
    Object.assign(this, { ort, read, draw, graphs: {}, left: [] });
  }

  // Reads the character and what it needs first; rejects with an Error in one line.
  async open(name) {
    this.name = name;
    this.about = unpack((await this.read("character.bin")).buffer);
    const { file, parts } = this.about.weights;
    this.weights = widen(await this.read(file), parts);
    return this;
  }

  // The graphs for a number of diffusion steps, made where there are none yet. With
  // `first`, dearer planners than the first may be left for later, where making that one
  // took so short that nobody sees the others being made.
  async prepare(steps, first = false) {
    const names = this.about.runs[steps].filter(name => !this.graphs[name]);
    const dear = names.filter(name => /^plan_\d/.test(name));
    let took = 0;
    for (const name of names.filter(name => !dear.includes(name))) {
      const began = performance.now();
      await this.make(name);
      took = Math.max(took, performance.now() - began);
    }
    this.left = first && took < QUICK ? dear : [];
    for (const name of dear) if (!this.left.includes(name)) await this.make(name);
  }

  // Makes what `prepare` left.
  async finish() {
    while (this.left.length) await this.make(this.left.shift());
  }

  async make(name) {
    const { file, inputs, outputs } = this.about.graphs[name];
    const bytes = await this.read(file);
    let session;
    try {
      session = await this.ort.InferenceSession.create(bytes, {
        executionProviders: ["wasm"], logSeverityLevel: 4,
        // It was optimized when it was written.
        graphOptimizationLevel: "disabled",
        externalData: [{ path: this.about.weights.file, data: this.weights }],
      });
    } catch (error) {
      throw new Error(`${this.name}/${file} is no graph that runs here: ${oneLine(error)}`);
    }
    const taken = new Set(session.inputNames);
    this.graphs[name] = { session, outputs, inputs: inputs.filter(x => taken.has(x.name)) };
  }

  // How a character of a label starts: its arrays by name.
  start(label) {
    const { arrays, shapes } = this.about, state = {};
    for (const [name, values] of Object.entries(arrays)) {
      if (!name.startsWith("state.")) continue;
      const shape = shapes[name].shape.slice(1), count = size(shape);
      const row = values.slice(count * label, count * (label + 1));
      state[name] = new this.ort.Tensor(shapes[name].dtype, row, shape);
    }
    return state;
  }

  // A command and the settings that the graphs take, as arrays by name.
  told({ velocity, facing, label, scale, locks }) {
    const one = (dtype, shape, ...values) =>
      new this.ort.Tensor(dtype, KINDS[dtype].from(values), shape);
    return {
      "command.velocity": one("float32", [2], ...velocity),
      "command.facing": one("float32", [2], ...facing),
      "command.label": one("int32", [], label),
      scale: one("float32", [], scale), locks: one("bool", [], locks ? 1 : 0),
    };
  }

  // Calls a graph; what it says of the state is the state from now on. Returns the rest.
  async call(name, state, told) {
    const { session, inputs, outputs } = this.graphs[name], given = {};
    for (const { name, dtype, shape } of inputs) {
      const found = name.startsWith("noise")
        ? new this.ort.Tensor(dtype, this.draw(size(shape)), shape)
        : state[name] || told[name];
      given[name] = found;
    }
    let made;
    try {
      made = await session.run(given);
    } catch (error) {
      throw new Error(`${this.name}: ${name} failed: ${oneLine(error)}`);
    }
    const rest = {};
    for (const { name } of outputs) {
      const inner = name.slice(4);  // without "out."
      if (inner in state) state[inner] = made[name]; else rest[inner] = made[name];
    }
    return rest;
  }

  // Which plan a tick needs, 0 for none; of who makes a frame at a time, null.
  async level(state, told) {
    if (!this.graphs.plan_level) return null;
    return Number((await this.call("plan_level", state, told)).level.data[0]);
  }

  async plan(level, steps, state, told) {
    if (level > 1) await this.finish();
    await this.call(`plan${level > 1 ? `_${level}` : ""}@${steps}`, state, told);
  }

  // The next frame.
  async show(state, told, steps) {
    const made = await this.call(this.graphs.advance ? "advance" : `step@${steps}`, state,
      told);
    const ball = made["frame.extra.ball"];
    return {
      root: made["frame.root_position"].data, rotation: made["frame.joint_rotation"].data,
      ball: ball ? ball.data : null,
    };
  }

  // The pose of a start, which is there before any graph is; null where none is stored.
  pose(state) {
    const names = this.about.past;
    if (!names) return null;
    const rotation = state[names.rotation].data, joints = this.about.skeleton.names.length;
    const root = state[names.root].data.slice(-3);
    return { root, rotation: rotation.slice(-6 * joints), ball: null };
  }

  // What is left of the plan: its path [ticks, 2] and its last pose; null without a plan.
  rest(state) {
    const names = this.about.plan;
    if (!names) return null;
    const roots = state[names.root].data, turns = state[names.rotation].data;
    const count = roots.length / 3, each = turns.length / count;
    const from = Math.min(Number(state[names.cursor].data[0]), count - 1);
    const path = new Float32Array(2 * (count - from));
    for (let i = from; i < count; i++)
      path.set([roots[3 * i], roots[3 * i + 2]], 2 * (i - from));
    return { path, root: roots.slice(-3), rotation: turns.slice(-each) };
  }
}
