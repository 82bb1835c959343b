// Plays a character of the page's folder in onnxruntime-web, with noise from a file.
// Usage: node web.mjs <modules of the page> <folder with node_modules> <character>
//   < {"steps", "start", "scale", "locks", "commands": [...], "noise": file, "out": file}
// Writes root and rotations of every tick as float32; with no commands, only opens all.

import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [, , modules, packages, folder] = process.argv;
const load = createRequire(`${packages}/package.json`);
const { default: ort } = await import(pathToFileURL(load.resolve("onnxruntime-web/wasm")));
const { Model } = await import(pathToFileURL(`${modules}/player.js`));
const asked = JSON.parse(readFileSync(0, "utf8"));
ort.env.wasm.numThreads = 1;

let at = 0;
const noise = asked.noise && new Float32Array(readFileSync(asked.noise).buffer.slice(0));
const draw = count => (noise ? noise.slice(at, at += count) : new Float32Array(count));
const { unpacked } = await import(pathToFileURL(`${modules}/packing.js`));
const read = file => unpacked(new Uint8Array(readFileSync(`${folder}/${file}.packed`)));
try {
  const model = await new Model(ort, read, draw).open("character");
  for (const steps of model.about.steps) await model.prepare(steps);
  const state = model.start(asked.start || 0), made = [], { scale, locks } = asked;
  const ms = { level: [], plan: [], show: [] };
  const timed = async (name, call) => {
    const began = performance.now(), found = await call;
    ms[name].push(performance.now() - began);
    return found;
  };
  let plans = 0;
  for (const command of asked.commands) {
    const told = model.told({ ...command, scale, locks });
    const level = await timed("level", model.level(state, told));
    if (level) { plans += 1; await timed("plan", model.plan(level, asked.steps, state, told)); }
    const shown = await timed("show", model.show(state, told, asked.steps));
    made.push(...shown.root, ...shown.rotation);
  }
  if (asked.out) writeFileSync(asked.out, new Uint8Array(Float32Array.from(made).buffer));
  const middle = x => x.sort((a, b) => a - b)[x.length >> 1] || 0;
  process.stdout.write(JSON.stringify({
    graphs: Object.keys(model.graphs), plans, noise: at,
    ms: Object.fromEntries(Object.entries(ms).map(([k, v]) => [k, middle(v)])),
  }));
} catch (error) {
  process.stdout.write(JSON.stringify({ error: error.message }));
}
