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

// So many characters are moved by one call for several, which costs about two of one.
const FEW = 3;
// Milliseconds in which a graph is made without anybody noticing.
const QUICK = 700;
const KINDS = { float32: Float32Array, int32: Int32Array, bool: Uint8Array };
const size = shape => shape.reduce((a, b) => a * b, 1);

// Constants as the graphs refer to them, of the files of `jaxmotion.export.slim`: 16-bit
// floats become 32-bit ones, of which each begins at a multiple of four bytes, as the
// others do. `packed` has the others and the floats' upper bytes, `fine` their lower ones.
export function widen(packed, fine, parts) {
  const sizes = parts.map(([half, bytes]) => (half ? 2 * bytes : bytes));
  const sum = values => values.reduce((a, b) => a + b, 0);
  const made = new Uint8Array(sum(sizes)), wide = new Float32Array(made.buffer);
  let other = 0, upper = packed.length - fine.length, lower = 0, to = 0;
  parts.forEach(([half, bytes], i) => {
    if (half)
      for (let k = 0; k < bytes / 2; k++)
        wide[to / 4 + k] = float(packed[upper++] << 8 | fine[lower++]);
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
    Object.assign(this, { ort, read, draw, graphs: {}, crowds: {}, left: [] });
  }

  // Reads the character and what it needs first; rejects with an Error in one line.
  async open(name) {
    this.name = name;
    this.about = unpack((await this.read("character.bin")).buffer);
    const { files, parts } = this.about.weights;
    this.weights = widen(...await Promise.all(files.map(this.read)), parts);
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

  // The graphs that move several characters at once, if there are so many.
  async gather(number, steps) {
    if (number < FEW) return;
    for (const name of this.about.runs[steps]) if (!this.crowds[name]) await this.make(name, true);
  }

  // How many of a number of characters one call of a graph moves.
  share(name, number) {
    const most = this.crowds[name] && number >= FEW ? this.about.graphs[name].crowd.number : 1;
    return Math.min(number, most);
  }

  async make(name, crowd = false) {
    const about = this.about.graphs[name], { inputs, outputs } = about;
    const { file } = crowd ? about.crowd : about;
    const bytes = await this.read(file);
    let session;
    try {
      session = await this.ort.InferenceSession.create(bytes, {
        executionProviders: ["wasm"], logSeverityLevel: 4,
        // It was optimized when it was written.
        graphOptimizationLevel: "disabled",
        externalData: [{ path: this.about.weights.files[0], data: this.weights }],
      });
    } catch (error) {
      throw new Error(`${this.name}/${file} is no graph that runs here: ${oneLine(error)}`);
    }
    const taken = new Set(session.inputNames);
    (crowd ? this.crowds : this.graphs)[name] = { session, outputs, inputs: inputs.filter(x => taken.has(x.name)) };
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

  // Calls a graph for characters; what it says of their states is these from now on.
  // Returns the rest, one for each.
  async call(name, states, told) {
    const made = [];
    while (made.length < states.length) {
      const from = made.length, to = from + this.share(name, states.length - from);
      made.push(...await this.run(name, states.slice(from, to), told.slice(from, to)));
    }
    return made;
  }

  async run(name, states, told) {
    const several = states.length > 1, { ort } = this, given = {};
    const { session, inputs, outputs } = (several ? this.crowds : this.graphs)[name];
    const places = several ? this.about.graphs[name].crowd.number : 1;
    const lead = several ? [places] : [];
    for (const { name, dtype, shape } of inputs) {
      const each = size(shape), data = new KINDS[dtype](places * each);
      const own = states.map((state, i) => name.startsWith("noise") ? this.draw(each)
        : (state[name] || told[i][name]).data);
      // Places that are left have somebody, too, whom nobody sees.
      for (let i = 0; i < places; i++) data.set(own[Math.min(i, own.length - 1)], i * each);
      given[name] = new ort.Tensor(dtype, data, [...lead, ...shape]);
    }
    let made;
    try {
      made = await session.run(given);
    } catch (error) {
      throw new Error(`${this.name}: ${name} failed: ${oneLine(error)}`);
    }
    return states.map((state, i) => {
      const rest = {};
      for (const { name, shape } of outputs) {
        const inner = name.slice(4), each = size(shape), { type, data } = made[name];
        const own = new ort.Tensor(type, data.slice(each * i, each * (i + 1)), shape);
        if (inner in state) state[inner] = own; else rest[inner] = own;
      }
      return rest;
    });
  }

  // Which plan each needs in a tick, 0 for none.
  async levels(states, told) {
    if (!this.graphs.plan_level) return states.map(() => 0);
    return (await this.call("plan_level", states, told)).map(x => Number(x.level.data[0]));
  }

  planner(level, steps) { return `plan${level > 1 ? `_${level}` : ""}@${steps}`; }

  async plan(level, steps, states, told) {
    if (level > 1) await this.finish();
    await this.call(this.planner(level, steps), states, told);
  }

  // The next frame of each.
  async show(states, told, steps) {
    const name = this.graphs.advance ? "advance" : `step@${steps}`;
    return (await this.call(name, states, told)).map(made => ({
      root: made["frame.root_position"].data, rotation: made["frame.joint_rotation"].data,
      ball: made["frame.extra.ball"] ? made["frame.extra.ball"].data : null,
    }));
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
