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

const KINDS = { float32: Float32Array, int32: Int32Array, bool: Uint8Array };
const size = shape => shape.reduce((a, b) => a * b, 1);

export class Model {
  // ort: onnxruntime-web; read: (file name) -> promise of its bytes, unpacked; draw:
  // (count) -> noise.
  constructor(ort, read, draw = normals) {
    Object.assign(this, { ort, read, draw, graphs: {} });
  }

  // Reads the character and what it needs first; rejects with an Error in one line.
  async open(name) {
    this.name = name;
    this.about = unpack((await this.read("character.bin")).buffer);
    this.weights = await this.read(this.about.weights);
    return this;
  }

  // The graphs for a number of diffusion steps, made where there are none yet.
  async prepare(steps) {
    for (const name of this.about.runs[steps]) {
      if (this.graphs[name]) continue;
      const { file, inputs, outputs } = this.about.graphs[name];
      const bytes = await this.read(file);
      let session;
      try {
        session = await this.ort.InferenceSession.create(bytes, {
          executionProviders: ["wasm"], graphOptimizationLevel: "basic",
          logSeverityLevel: 4,
          externalData: [{ path: this.about.weights, data: this.weights }],
        });
      } catch (error) {
        throw new Error(`${this.name}/${file} is no graph that runs here: ${oneLine(error)}`);
      }
      const taken = new Set(session.inputNames);
      this.graphs[name] = { session, outputs, inputs: inputs.filter(x => taken.has(x.name)) };
    }
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
