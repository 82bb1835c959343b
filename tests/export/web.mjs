// Plays a character of the page's folder in onnxruntime-web, with noise from a file.
// Usage: node web.mjs <modules of the page> <folder with node_modules> <character>
//   < {"steps", "start", "scale", "locks", "commands": [...], "noise": file, "out": file,
//      "people": number, "several": whether one call moves several of them}
// Writes root and rotations of every tick as float32, of one person after the other; with
// no commands, only opens all. Several people get the same noise for each plan.

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
const draw = count => {
  if (asked.people > 1) return noise.slice(0, count);
  return noise ? noise.slice(at, at += count) : new Float32Array(count);
};
const { unpacked } = await import(pathToFileURL(`${modules}/packing.js`));
const read = file => unpacked(new Uint8Array(readFileSync(`${folder}/${file}.packed`)));
try {
  const model = await new Model(ort, read, draw).open("character");
  const { people = 1, several, scale, locks } = asked, all = [...Array(people).keys()];
  for (const steps of model.about.steps) {
    await model.prepare(steps);
    if (several !== false) await model.gather(Infinity, steps);
  }
  const labels = model.about.labels ? Math.max(model.about.labels.length, 1) : 1;
  const states = all.map(i => model.start(i ? i % labels : asked.start || 0)), made = [];
  const ms = { level: [], plan: [], show: [] };
  const timed = async (name, call) => {
    const began = performance.now(), found = await call;
    ms[name].push(performance.now() - began);
    return found;
  };
  let plans = 0;
  for (let t = 0; t < asked.commands.length; t++) {
    // Others are told the same, later.
    const told = all.map(i => model.told({
      ...asked.commands[Math.max(t - 11 * i, 0)], scale, locks }));
    const levels = await timed("level", model.levels(states, told));
    for (const level of new Set(levels)) {
      if (!level) continue;
      const now = all.filter(i => levels[i] === level), of = x => now.map(i => x[i]);
      plans += now.length;
      await timed("plan", model.plan(level, asked.steps, of(states), of(told)));
    }
    for (const shown of await timed("show", model.show(states, told, asked.steps)))
      made.push(...shown.root, ...shown.rotation);
  }
  if (asked.out) writeFileSync(asked.out, new Uint8Array(Float32Array.from(made).buffer));
  const middle = x => x.sort((a, b) => a - b)[x.length >> 1] || 0;
  process.stdout.write(JSON.stringify({
    graphs: Object.keys(model.graphs), crowds: Object.keys(model.crowds), plans, noise: at,
    ms: Object.fromEntries(Object.entries(ms).map(([k, v]) => [k, middle(v)])),
  }));
} catch (error) {
  process.stdout.write(JSON.stringify({ error: error.message }));
}
