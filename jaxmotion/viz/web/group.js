// Characters that one core moves: in this Worker, or in another one (`Helper`, `help`).

import { Model } from "./player.js";

export class Group {
  constructor(model) {
    this.model = model; this.people = []; this.planMs = 30; this.tickMs = 4; this.planned = 1;
  }

  // So many people; who is there goes on, others start with a label.
  resize(number, label) {
    const { people } = this;
    people.length = Math.min(people.length, number);
    while (people.length < number)
      people.push({ state: this.model.start(label), told: null, waited: 0 });
  }

  // Graphs for a number of diffusion steps, and of people.
  async prepare(steps, number = 1) {
    await this.model.prepare(steps);
    await this.model.gather(number, steps);
  }

  // How many one core moves in real time, from what the last ticks took.
  get bears() {
    const { fps, patience } = this.model.about, n = Math.max(this.people.length, 1);
    return 900 / fps / (this.tickMs / n + (patience ? this.planMs / patience : 0));
  }

  // What the last call for plans took.
  get callMs() { return this.planMs * this.planned; }

  // One tick of all.
  //   told: command and settings, as `Model.told` takes them, and the number of steps
  //   slack: milliseconds that plans may take before frames run out
  //   plan: whether the rest of the first one's plan is asked for
  async next({ told, steps, slack, plan }) {
    const began = performance.now(), { model, people } = this;
    const command = model.told(told), { patience } = model.about;
    let planned = 0;
    const states = people.map(one => one.state), all = people.map(() => command);
    const levels = await model.levels(states, all);
    people.forEach((one, i) => {
      one.level = levels[i]; one.waited = levels[i] ? one.waited + 1 : 0;
      if (!one.level) one.told = command;
    });
    // Who has waited longest comes first; who cannot wait any longer plans in any case,
    // the others where there are frames enough to make meanwhile: so a slow device gets
    // fewer plans, in real time.
    let asked = people.filter(one => one.level).sort((a, b) => b.waited - a.waited);
    const must = one => !one.told || one.waited > Math.max(patience - 2, 0);
    while (asked.length) {
      const { level } = asked[0], same = asked.filter(one => one.level === level);
      const most = model.share(model.planner(level, steps), same.length);
      const now = same.slice(0, most), hurry = now.some(must);
      asked = asked.filter(one => !now.includes(one));
      if (!hurry && performance.now() - began + this.planMs * most > slack) continue;
      const from = performance.now();
      await model.plan(level, steps, now.map(one => one.state), now.map(() => command));
      this.planMs += 0.2 * ((performance.now() - from) / most - this.planMs);
      this.planned = most;
      for (const one of now) { one.told = command; one.waited = 0; }
      planned += most;
    }
    const shown = await model.show(states, people.map(one => one.told || command), steps);
    if (!planned && people.length) this.tickMs += 0.2 * (performance.now() - began - this.tickMs);
    const { callMs, tickMs, bears } = this;
    const rest = plan ? model.rest(people[0].state) : null;
    return { shown, planned, rest, callMs, tickMs, bears };
  }
}

// A group in another Worker: `help` answers there.
export class Helper {
  // base: the page's address; model: whose files it reads here; binary: the runtime.
  constructor(base, model, binary) {
    this.model = model; this.asked = new Map(); this.count = 0;
    Object.assign(this, { callMs: 0, tickMs: 0, bears: 0 });
    this.worker = new Worker(new URL("worker.js", base), { type: "module" });
    this.worker.onmessage = ({ data }) => this.hear(data);
    this.worker.onerror = event => {
      event.preventDefault();
      for (const [, , refuse] of this.asked.values())
        refuse(new Error(`worker.js does not run: ${event.message || "it is missing"}`));
    };
    this.worker.postMessage({ helps: model.name, binary });
  }

  hear({ read, id, made, error }) {
    if (read)
      this.model.read(read).then(bytes => this.worker.postMessage({ read, bytes }),
        reason => this.worker.postMessage({ read, error: reason.message }));
    if (id === undefined) return;
    const [, done, refuse] = this.asked.get(id);
    this.asked.delete(id);
    if (error) refuse(new Error(error)); else done(made);
  }

  call(name, ...args) {
    const id = this.count++;
    return new Promise((done, refuse) => {
      this.asked.set(id, [name, done, refuse]);
      this.worker.postMessage({ id, name, args });
    });
  }

  prepare(steps, number = 1) { return this.call("prepare", steps, number); }
  resize(number, label) { return this.call("resize", number, label); }
  async next(tick) {
    const made = await this.call("next", tick), { callMs, tickMs, bears } = made;
    Object.assign(this, { callMs, tickMs, bears });
    return made;
  }

  close() { this.worker.terminate(); }
}

// Makes this Worker a helper; `first` is the message that asked for it, `say` answers who
// did, from whom files come, too. Returns what is to be done with each message.
export function help(ort, first, say) {
  const waiting = new Map();
  const read = file => new Promise((done, refuse) => {
    waiting.set(file, [...(waiting.get(file) || []), [done, refuse]]);
    say({ read: file });
  });
  ort.env.wasm.numThreads = 1;
  ort.env.wasm.wasmBinary = first.binary;
  const group = new Model(ort, read).open(first.helps).then(model => new Group(model));
  group.catch(() => {});
  return async ({ read, bytes, error, id, name, args }) => {
    if (read) {
      const [[done, refuse], ...others] = waiting.get(read);
      waiting.set(read, others);
      if (error) refuse(new Error(error)); else done(bytes);
      return;
    }
    try {
      say({ id, made: await (await group)[name](...args) });
    } catch (error) { say({ id, error: error.message }); }
  };
}
