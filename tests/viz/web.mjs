// Runs functions of the page's modules on JSON from the standard input.
// Usage: node web.mjs <folder of the modules> < {"module", "name", "calls": [[...]]}
// A name such as "dress.pose" is a method of what a function makes: its calls are the
// function's arguments and then those of each call of the method.

import { pathToFileURL } from "node:url";
import { readFileSync } from "node:fs";

const { module, name, calls } = JSON.parse(readFileSync(0, "utf8"));
const found = await import(pathToFileURL(`${process.argv[2]}/${module}`));
// Typed arrays go in as {"float32": [...]} and come out as lists, bytes as base64.
const KINDS = { float32: Float32Array, float64: Float64Array };
const inward = (_, x) => {
  if (x && x.bytes) return new Uint8Array(Buffer.from(x.bytes, "base64"));
  if (x && x.base64) return new Uint8Array(Buffer.from(x.base64, "base64")).buffer;
  for (const kind of Object.keys(KINDS)) if (x && x[kind]) return KINDS[kind].from(x[kind]);
  return x;
};
const outward = (_, x) => {
  if (x instanceof Uint8Array) return { base64: Buffer.from(x).toString("base64") };
  return ArrayBuffer.isView(x) ? [...x] : x;
};
const [first, method] = name.split(".");
const results = await Promise.all(calls.map(async call => {
  const args = JSON.parse(JSON.stringify(call), inward);
  try {
    if (!method) return await found[first](...args);
    const made = found[first](...args[0]);
    return args.slice(1).map(each => made[method](...each));
  } catch (error) {
    if (error.constructor !== Error) throw error;
    return { error: error.message };  // one that is meant for whoever looks
  }
}));
process.stdout.write(JSON.stringify(results, outward));
