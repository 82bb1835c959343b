// Characters that are steered together: who plans when, and what is shown of a tick.

import { same, settled, still, wanted } from "./steer.js";

const SPACING = 1.6;

// Places beside the first one, (x, z), in rows behind it.
export function formation(number) {
  const wide = Math.ceil(Math.sqrt(number)), middle = (wide - 1) >> 1;
  const order = [...Array(wide).keys()].sort(
    (a, b) => Math.abs(a - middle) - Math.abs(b - middle));
  return [...Array(number).keys()].map(i => {
    const column = order[i % wide] - order[0], row = Math.floor(i / wide);
    return [SPACING * column, -SPACING * row];
  });
}

export class Crowd {
  constructor(model, settings) {
    this.model = model; this.settings = settings; this.tick = 0;
    this.people = []; this.homes = [];
    this.wish = still(); this.told = still(); this.leader = [0, 0];
    this.planMs = 30; this.tickMs = 4;
  }

  // Settings of this number; who is there goes on.
  resize(number) {
    const homes = formation(number);
    const here = this.homes[0] ? [0, 1].map(i => this.leader[i] - homes[0][i]) : [0, 0];
    this.people.length = Math.min(this.people.length, number);
    while (this.people.length < number) {
      const i = this.people.length;
      const state = this.model.start(this.settings.label);
      this.homes[i] = homes[i].map((x, k) => x + here[k]);
      this.people.push({ state, told: null, waited: 0 });
    }
    this.homes.length = number;
  }

  // How many characters can be moved in real time, from what the last ticks took.
  bears() {
    const { fps, patience } = this.model.about, n = this.people.length;
    const plan = patience ? this.planMs / patience : 0;
    return Math.floor(900 / fps / (this.tickMs / n + plan));
  }

  command(wish) {
    const { label, scale, foot_lock } = this.settings;
    return this.model.told({ ...wish, label, scale, locks: foot_lock });
  }

  // One tick of all. `slack`: milliseconds that plans may take before frames run out.
  async next(inputs, slack) {
    const began = performance.now(), { model, settings, people } = this;
    const { fps, patience } = model.about, steps = settings.num_steps;
    const wish = wanted(inputs, this.wish, {
      position: this.leader, speed: settings.speed, seconds: 1 / fps,
    });
    this.told = settled(this.told, wish, same(wish, this.wish));
    this.wish = wish;
    const command = this.command(this.told);
    let planned = 0;
    const asked = [];
    for (const one of people) {
      const level = await model.level(one.state, command);
      if (!level) { one.told = command; one.waited = 0; continue; }
      one.waited += 1;
      asked.push([one, level]);
    }
    // Who has waited longest comes first; who cannot wait any longer plans in any case.
    asked.sort((a, b) => b[0].waited - a[0].waited);
    for (const [one, level] of asked) {
      const must = !one.told || one.waited > Math.max(patience - 2, 0);
      const late = performance.now() - began + this.planMs > slack;
      if (!must && (planned || people.length === 1) && late) continue;
      const from = performance.now();
      await model.plan(level, steps, one.state, command);
      const took = performance.now() - from;
      this.planMs += 0.2 * (took - this.planMs);
      one.told = command; one.waited = 0; planned += 1;
      this.lastPlan = took;
    }
    const { homes } = this, shown = [];
    for (const one of people)
      shown.push(await model.show(one.state, one.told || command, steps));
    this.leader = [shown[0].root[0] + homes[0][0], shown[0].root[2] + homes[0][1]];
    const took = performance.now() - began;
    if (!planned) this.tickMs += 0.2 * (took - this.tickMs);
    return this.pack(shown, planned, took);
  }

  // A frame as `jaxmotion.viz.page` sends it.
  pack(shown, planned, took) {
    const { model, settings, homes, told, tick } = this, n = shown.length;
    const joints = model.about.skeleton.parents.length;
    const balls = shown[0].ball ? n : 0;
    const rest = settings.plan ? model.rest(this.people[0].state) : null;
    const ahead = rest ? rest.path.length / 2 : 0;
    const head = [settings.engine, tick, took, planned, n, joints, balls, model.about.fps,
      ...told.velocity, ...told.facing, ahead];
    const data = new Float32Array(head.length + n * (3 + 6 * joints) + 3 * balls
      + (ahead ? 2 * ahead + 3 + 6 * joints : 0));
    let at = 0;
    const put = (values, dx = 0, dz = 0, every = 0) => {
      data.set(values, at);
      if (every) for (let i = 0; i < values.length; i += every) {
        data[at + i] += dx; data[at + i + every - 1] += dz;
      }
      at += values.length;
    };
    put(head);
    shown.forEach((one, i) => put(one.root, ...homes[i], 3));
    shown.forEach(one => put(one.rotation));
    if (balls) shown.forEach((one, i) => put(one.ball, ...homes[i], 3));
    if (ahead) {
      put(rest.path, ...homes[0], 2);
      put(rest.root, ...homes[0], 3);
      put(rest.rotation);
    }
    this.tick += 1;
    return data;
  }
}
