// Plays a crowd whose graphs are written here, alone and with helpers that stand in for
// Workers. Usage: node crowd.mjs <folder of the modules> < {file name: base64}

import { pathToFileURL } from "node:url";
import { readFileSync } from "node:fs";

const from = name => import(pathToFileURL(`${process.argv[2]}/${name}`));
const { Crowd } = await from("crowd.js"), { Model } = await from("player.js");
const { Helper, help } = await from("group.js");
const files = JSON.parse(readFileSync(0, "utf8")), asked = [];
const read = async file => new Uint8Array(Buffer.from(files[file], "base64")).slice();

class Tensor {
  constructor(type, data, dims) { Object.assign(this, { type, data, dims }); }
}
// A plan is due every third tick; a person walks as told.
const GRAPHS = {
  plan_level: x => ({ "out.level": [Number(x["state.age"].data[0] >= 3)] }),
  plan: () => ({ "out.state.age": [0] }),
  advance: x => {
    const z = x["state.z"].data[0] + x["command.velocity"].data[1] / 30;
    return {
      "out.state.age": [x["state.age"].data[0] + 1], "out.state.z": [z],
      "out.frame.root_position": [0, 1, z], "out.frame.joint_rotation": [1, 0, 0, 0, 1, 0],
    };
  },
};
const TOGETHER = 4, calls = {};
const runtime = () => ({
  Tensor, env: { wasm: {} },
  InferenceSession: {
    create: async bytes => {
      const [name, several] = new TextDecoder().decode(bytes).split("."), inputNames = [
        "state.age", "state.z", "command.velocity"], made = {}, number = several ? TOGETHER : 1;
      const row = (given, i) => Object.fromEntries(Object.entries(given).map(([key, x]) => {
        const each = x.data.length / number;
        if (several && x.dims[0] !== TOGETHER) throw new Error(`${key} of no crowd`);
        return [key, { data: x.data.slice(each * i, each * (i + 1)) }];
      }));
      return { inputNames, run: async given => {
        calls[name] = [...(calls[name] || []), number];
        const rows = [...Array(number).keys()].map(i => GRAPHS[name](row(given, i)));
        for (const key of Object.keys(rows[0])) {
          const data = Float32Array.from(rows.flatMap(x => x[key]));
          made[key] = new Tensor("float32", data, [data.length]);
        }
        return { ...made };
      } };
    },
  },
});
globalThis.Worker = class {
  constructor(url) { asked.push(String(url)); }
  postMessage(data) {
    const message = structuredClone(data), say = made => setTimeout(
      () => this.onmessage({ data: structuredClone(made) }), 0);
    if (message.helps) this.helps = help(runtime(), message, say);
    else setTimeout(() => this.helps(message), 0);
  }
  terminate() { this.onmessage = () => {}; }
};

const settings = { label: 0, scale: 1, foot_lock: true, num_steps: 2, speed: 1.5, engine: 1, plan: false };
const inputs = { held: ["forward"], azimuth: 0, target: null };
async function play(most, several = false) {
  const model = await new Model(runtime(), read).open("stub");
  await model.prepare(2);
  const crowd = new Crowd(model, settings, m => new Helper("http://here/", m, null), most);
  const seen = [], people = async number => {
    while (crowd.needs(number)) await crowd.enlist(2);
    if (several) await crowd.prepare(2, number);
    crowd.resize(number);
    let data;
    for (let i = 0; i < 20; i++) data = await crowd.next(inputs, 30);
    const n = data[4];
    seen.push({
      roots: [...data.subarray(13, 13 + 3 * n)], groups: crowd.groups.length,
      owners: [...crowd.owners], bears: crowd.bears(),
    });
  };
  for (const number of [9, 3, 14]) await people(number);
  crowd.restart();
  await people(2);
  crowd.close();
  return seen;
}
// Plans of five people in 80 ticks, with so many milliseconds for them.
async function planned(slack) {
  const crowd = new Crowd(await new Model(runtime(), read).open("stub"), settings);
  let plans = 0, data;
  await crowd.prepare(2, 5);
  crowd.resize(5);
  for (let i = 0; i < 80; i++) plans += (data = await crowd.next(inputs, slack))[3];
  return { plans, roots: [...data.subarray(13, 13 + 3 * 5)] };
}
const plans = [await planned(1e4), await planned(0)];
for (const name of Object.keys(calls)) delete calls[name];
const alone = await play(1), single = { ...calls };
for (const name of Object.keys(calls)) delete calls[name];
const together = await play(1, true), several = { ...calls }, helped = await play(3);
process.stdout.write(JSON.stringify({ plans, alone, together, helped, asked, single, several }));
