// Characters that are steered together: what they are told, which core moves whom, and
// what is shown of a tick.

import { Group } from "./group.js";
import { same, settled, still, wanted } from "./steer.js";
import { along, averaged, routed } from "./waypoints.js";

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
  // helper: makes a group in another Worker; most: how many groups there may be.
  constructor(model, settings, helper = null, most = 1) {
    this.model = model; this.settings = settings; this.helper = helper;
    this.most = helper ? most : 1;
    this.groups = [new Group(model)];
    this.restart();
  }

  // Nobody is there yet; groups stay.
  restart() {
    this.tick = 0; this.owners = []; this.homes = [];
    this.wish = still(); this.told = still(); this.route = null;
    this.leader = [0, 0]; this.velocity = [0, 0];
    for (const group of this.groups) group.resize(0);
  }

  get callMs() { return Math.max(...this.groups.map(group => group.callMs)); }
  get tickMs() { return Math.max(...this.groups.map(group => group.tickMs)); }
  // How many characters one core moves in real time.
  get each() {
    const known = this.groups.map(group => group.bears).filter(Boolean);
    return known.reduce((a, b) => a + b) / known.length;
  }

  // How many characters can be moved in real time, with one more core where one is left.
  bears() {
    return Math.floor(this.each * Math.min(this.groups.length + 1, this.most));
  }

  // Whether so many characters are more than the groups move, and there may be more.
  needs(number) {
    return this.groups.length < this.most && number > this.each * this.groups.length;
  }

  // Another group, ready to be used.
  async enlist(steps) {
    const made = this.helper(this.model);
    // Others come while it is made: it is ready for a crowd.
    await made.prepare(steps, Infinity);
    this.groups.push(made);
  }

  // Graphs for a number of diffusion steps and of characters.
  prepare(steps, number) {
    return Promise.all(this.groups.map(group => group.prepare(steps, number)));
  }

  close() { for (const group of this.groups.slice(1)) group.close(); }

  // Settings of this number; who is there goes on. Others join the smallest group.
  resize(number) {
    const homes = formation(number), { groups, owners } = this;
    const here = this.homes[0] ? [0, 1].map(i => this.leader[i] - homes[0][i]) : [0, 0];
    const size = g => owners.filter(x => x === g).length;
    owners.length = this.homes.length = Math.min(owners.length, number);
    while (owners.length < number) {
      const i = owners.length, sizes = groups.map((_, g) => size(g));
      this.homes[i] = homes[i].map((x, k) => x + here[k]);
      owners.push(sizes.indexOf(Math.min(...sizes)));
    }
    groups.forEach((group, g) => group.resize(size(g), this.settings.label));
  }

  // What all are told: the first one goes along waypoints, the others beside.
  wanted(inputs) {
    const { settings, model, leader: position } = this, { speed } = settings;
    this.route = routed(this.route, inputs.path || [], position);
    if (!this.route)
      return wanted(inputs, this.wish, { position, speed, seconds: 1 / model.about.fps });
    const { velocity } = this, { ahead } = model.about;
    const [wish, route] = along(this.route, this.wish, { position, velocity, speed, ahead });
    this.route = route;
    return wish;
  }

  // One tick of all. `slack`: milliseconds that plans may take before frames run out.
  async next(inputs, slack) {
    const began = performance.now(), { model, settings, homes, owners } = this;
    const { label, scale, foot_lock, num_steps: steps } = settings;
    const wish = this.wanted(inputs);
    this.told = settled(this.told, wish, same(wish, this.wish));
    this.wish = wish;
    const told = { ...this.told, label, scale, locks: foot_lock };
    // The others first: this Worker's own group lets nobody speak meanwhile.
    const made = [];
    for (let g = this.groups.length - 1; g >= 0; g--)
      made[g] = this.groups[g].next({ told, steps, slack, plan: settings.plan && !g });
    const found = await Promise.all(made), at = found.map(() => 0);
    const shown = owners.map(g => found[g].shown[at[g]++]);
    const planned = found.reduce((sum, one) => sum + one.planned, 0);
    const at0 = [shown[0].root[0] + homes[0][0], shown[0].root[2] + homes[0][1]];
    const { fps } = model.about, moved = at0.map((x, i) => (x - this.leader[i]) * fps);
    this.velocity = averaged(this.velocity, moved, fps);
    this.leader = at0;
    return this.pack(shown, planned, performance.now() - began, found[0].rest);
  }

  // How all start, which is there before any graph is; null where none is stored.
  standing() {
    const own = this.owners.map(() => this.model.pose(this.model.start(this.settings.label)));
    return own.every(Boolean) ? this.pack(own, 0, 0) : null;
  }

  // A frame as `jaxmotion.viz.page` sends it.
  pack(shown, planned, took, rest = null) {
    const { model, settings, homes, told, tick } = this, n = shown.length;
    const joints = model.about.skeleton.parents.length;
    const balls = shown[0].ball ? n : 0;
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
