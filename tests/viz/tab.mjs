// The page in a tab that is not there: events from the standard input, one after another.
// Usage: node tab.mjs <folder of the modules> < {"hash", "events": [[name, ...]]}
// Events are what a source tells ("state", "body", "frame"), "hidden" (true or false) and
// "pad" (a gamepad, or null), "press" (a button's name) and "save" (as .bvh). What comes
// out after each: messages that the page said, the tick that is displayed, what a gamepad
// holds, and what was saved.

import { pathToFileURL } from "node:url";
import { readFileSync } from "node:fs";

const { hash, events } = JSON.parse(readFileSync(0, "utf8"));
// Whatever is asked of it: something of the same kind.
const any = () => new Proxy(function () {}, {
  get(_, name) {
    if (name === Symbol.toPrimitive) return () => 1;
    if (name === Symbol.iterator) return function* () {};
    return name === "length" ? 0 : any();
  },
  apply: () => any(), construct: () => any(), set: () => true,
});
const element = () => new Proxy({
  style: {}, dataset: {}, children: [], value: 1, clientWidth: 800, clientHeight: 600,
  classList: { toggle() {}, add() {}, contains: () => false },
  addEventListener() {}, replaceChildren() {}, querySelectorAll: () => [], getContext: any,
}, {
  get: (own, name) => (name in own ? own[name] : any()),
  set(own, name, value) { own[name] = value; return true; },
});
const elements = {}, said = [];
let pictures = [], pads = [], on;
Object.assign(globalThis, {
  window: globalThis, location: { hash, href: `http://here/${hash}` }, devicePixelRatio: 1,
  document: {
    getElementById: id => elements[id] ||= element(), createElement: element, hidden: false,
  },
  addEventListener() {}, matchMedia: () => ({ matches: false }), Option: class {},
  requestAnimationFrame(picture) { pictures.push(picture); },
});
const saved = [".glb", ".bvh"].map(textContent => ({ textContent }));
elements.last = new Proxy({ querySelectorAll: () => saved }, {
  get: (own, name) => (name in own ? own[name] : any()),
  set(own, name, value) { own[name] = value; return true; },
});
let made = null;
globalThis.Blob = class { constructor([text]) { made = text; } };
URL.createObjectURL = URL.revokeObjectURL = () => "";
globalThis.history = { replaceState() {} };
Object.defineProperty(globalThis, "navigator", { value: { getGamepads: () => pads } });
const { start } = await import(pathToFileURL(`${process.argv[2]}/page.js`));
start({ open: true, say(message) { said.push(message); }, connect(found) { on = found; } });

const results = events.map(([name, ...given]) => {
  if (name === "hidden") document.hidden = given[0];
  else if (name === "pad") pads = given[0] ? [given[0]] : [];
  else if (name === "press") elements[given[0]].onclick({ target: element() });
  else if (name === "save") saved[1].onclick({ target: element() });
  else if (name === "body") {
    const bytes = new Uint8Array(Buffer.from(given[0], "base64"));
    on.body(bytes.buffer, given[1]);
  } else if (name === "frame") on.frame(Float32Array.from(given[0]), performance.now());
  else on[name](...given);
  if (!document.hidden) {
    const now = pictures;
    pictures = [];
    for (const picture of now) picture(performance.now());
  }
  const { stick, face, orbit } = window.input.pad;
  return {
    said: said.splice(0), shown: window.shown ? window.shown.tick : null,
    pad: [stick, face, orbit].map(x => x || null), made,
  };
});
process.stdout.write(JSON.stringify(results));
process.exit(0);
