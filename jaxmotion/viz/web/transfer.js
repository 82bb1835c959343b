// Motion of one person on another's body: `retarget/transfer.py`, frame by frame. Says
// there what is done; all of it is closed form.

import { columns } from "./body.js";
import {
  EYE, about, add, chain, clip, column, dot, long, mean, mean1, scale, sub, swing, times,
  trace, transposed, turned, unit,
} from "./linear.js";

// Parts of a chain's length at which each joint's bone begins, and the end.
function segments({ places }, joints, end) {
  const at = [0];
  [...joints.slice(1).map(j => places[j]), end].forEach((point, i) =>
    at.push(at[i] + long(sub(point, places[joints[i]]))));
  return at.map(x => x / Math.max(at[at.length - 1], 1e-9));
}

// How much of each of the target's bones lies along each of the source's.
function overlaps(target, source) {
  return target.slice(1).map((high, i) => {
    const row = source.slice(1).map((end, k) =>
      Math.max(Math.min(high, end) - Math.max(target[i], source[k]), 0));
    const sum = row.reduce((a, b) => a + b, 0);
    if (sum >= 1e-9) return row.map(x => x / sum);
    const away = source.slice(0, -1).map(x => Math.abs(x - target[i]));
    return row.map((_, k) => +(k === away.indexOf(Math.min(...away))));
  });
}

// Joints from hips to chest, and of the neck, and where the two end.
function trunkOf({ trunk, roles, places, arms }) {
  const spine = trunk.slice(trunk.indexOf(roles.hips), trunk.indexOf(roles.chest) + 1);
  const above = trunk.slice(trunk.indexOf(roles.chest) + 1);
  const level = mean(arms.map(arm => places[arm.upper]));
  const top = above.length ? places[above[0]] : level;
  const end = roles.head === undefined ? add(top, [0, 1, 0]) : places[roles.head];
  return { spine, neck: above.filter(j => j !== roles.head), top, end };
}

// Whose turns each joint of the target takes, as [joint, part], and its leader: itself
// where it has a role, else its parent's; -1 above the hips.
function sources(source, target) {
  const known = new Map(), t = trunkOf(target), s = trunkOf(source);
  const mixed = (mine, yours, rows) => mine.forEach((joint, i) =>
    known.set(joint, yours.map((j, k) => [j, rows[i][k]]).filter(x => x[1] > 0)));
  mixed(t.spine, s.spine,
    overlaps(segments(target, t.spine, t.top), segments(source, s.spine, s.top)));
  known.set(t.spine[t.spine.length - 1], [[s.spine[s.spine.length - 1], 1]]);
  known.set(t.spine[0], [[s.spine[0], 1]]);
  if (t.neck.length) {
    const yours = s.neck.length ? s.neck : s.spine.slice(-1);
    mixed(t.neck, yours,
      overlaps(segments(target, t.neck, t.end), segments(source, yours, s.end)));
  }
  for (const [role, mine] of Object.entries(target.roles)) {
    if (["hips", "chest", "neck"].includes(role)) continue;
    let yours = source.roles[role];
    if (yours === undefined && role === "head") yours = source.trunk[source.trunk.length - 1];
    if (yours !== undefined) known.set(mine, [[yours, 1]]);
  }
  const leader = [];
  target.parents.forEach((up, j) => {
    const below = up >= 0 && chain(target.parents, j).includes(target.roles.hips);
    leader[j] = known.has(j) ? j : below ? leader[up] : -1;
  });
  return { rows: known, leader };
}

// Where the middle joint of a limb is whose end reaches for a goal.
function twoBones(start, goal, pole, a, b, reach) {
  const way = sub(goal, start), along = unit(way);
  const far = clip(long(way), Math.abs(a - b) * 1.001 + 1e-9, reach * (a + b));
  const cosine = clip((a * a + far * far - b * b) / (2 * a * far), -1, 1);
  const aside = unit(sub(pole, scale(dot(along, pole), along)));
  const sine = Math.sqrt(Math.max(1 - cosine * cosine, 0));
  return add(start, scale(a, add(scale(cosine, along), scale(sine, aside))));
}

export class Transfer {
  // source, target: persons as `person.js` has them; numbers: of `transfer.page_json`.
  constructor(source, target, numbers) {
    Object.assign(this, { source, target, numbers, size: target.leg / source.leg });
    Object.assign(this, sources(source, target));
    this.back = source.turns.map(transposed);
    this.middle = mean(target.legs.map(leg => target.places[leg.upper]));
    const height = one => mean1(one.legs.map(leg => one.places[leg.end][1])) - one.sole;
    this.heights = [height(source), height(target)];
    const by = side => x => x.side === side;
    this.pairs = kind => ["left", "right"].map(side =>
      [source[kind].find(by(side)), target[kind].find(by(side))]);
    [this.legs, this.arms] = [this.pairs("legs"), this.pairs("arms")];
    this.twists = this.twistBones();
    this.spine = this.spineOf();
  }

  // Root position and local rotations of the target, as a frame has them.
  pose(root, rotation) {
    const { source, target, leader } = this, { places, turns } = world(source, root, rotation);
    const moves = [];
    for (const [joint, row] of this.rows) moves[joint] = this.mix(row, turns);
    this.swingSpine(places, moves);
    const { middle, goals } = this.goals(places, moves);
    this.legs.forEach(([yours, mine], i) =>
      this.limb(moves, places, yours, mine, this.hip(moves, middle, mine), goals[i], 1));
    for (const [yours, mine] of this.arms) {
      const part = sum(mine.lengths) / sum(yours.lengths);
      const goal = scale(part, sub(places[yours.end], places[yours.upper]));
      this.limb(moves, places, yours, mine, [0, 0, 0], goal, -1);
    }
    moves[-1] = EYE;  // above the hips
    const hips = moves[target.roles.hips], twisted = new Map(this.twist(moves));
    const made = new Float32Array(6 * leader.length), own = [];
    leader.forEach((up, j) => {
      own[j] = times(twisted.get(j) || moves[up], target.turns[j]);
      const over = target.parents[j];
      const local = over < 0 ? own[j] : times(transposed(own[over]), own[j]);
      made.set([local[0], local[3], local[6], local[1], local[4], local[7]], 6 * j);
    });
    const at = target.places[target.roles.hips];
    // What is above the hips does not turn.
    const place = sub(sub(middle, turned(hips, sub(this.middle, at))), at);
    return { root: Float32Array.from(place), rotation: made };
  }

  // The mean of the source's turns from its T-pose.
  mix(row, turns) {
    const parts = row.map(([j, part]) => times(turns[j], this.back[j]).map(x => part * x));
    if (parts.length === 1) return parts[0];
    const m = parts.reduce((a, b) => a.map((x, i) => x + b[i]));
    const c = columns([m[0], m[3], m[6], m[1], m[4], m[7]], 0);
    return [c[0], c[3], c[6], c[1], c[4], c[7], c[2], c[5], c[8]];
  }

  // What brings the chest to where the source's is from the hips; null if nothing does.
  spineOf() {
    const { source, target } = this, mine = trunkOf(target).spine, yours = trunkOf(source).spine;
    if (mine.length < 3 || yours.length < 2) return null;
    const ends = (one, joints) => sub(one.places[joints[joints.length - 1]], one.places[joints[0]]);
    const rest = ends(source, yours), own = ends(target, mine);
    const size = long(own) / Math.max(long(rest), 1e-9);
    if (!(size > 1e-6 && size < 1e6)) return null;
    const bones = mine.slice(1).map((j, i) => sub(target.places[j], target.places[mine[i]]));
    return { mine, yours, size, bones, between: swing(unit(rest), unit(own)) };
  }

  swingSpine(places, moves) {
    if (!this.spine) return;
    const { mine, yours, size, bones, between } = this.spine, hips = moves[mine[0]];
    const way = times(hips, times(between, transposed(hips)));
    const rise = sub(places[yours[yours.length - 1]], places[yours[0]]);
    const goal = sub(scale(size, turned(way, rise)), turned(hips, bones[0]));
    const inner = mine.slice(1, -1);
    const now = inner.map((j, i) => turned(moves[j], bones[i + 1])).reduce(add);
    const swung = swing(unit(now), unit(goal));
    for (const j of inner) moves[j] = times(swung, moves[j]);
  }

  // The source's point for the target; both have a height that is the same.
  scaled(point, source, target) {
    return add(scale(this.size, point), [0, target - this.size * source, 0]);
  }

  // Where the middle of the hips and the ankles go.
  goals(places, moves) {
    const { source, target, numbers, size } = this;
    const middle = this.scaled(mean(this.legs.map(([leg]) => places[leg.upper])), ...this.heights);
    const drops = [], goals = this.legs.map(([yours, mine]) => {
      const foot = moves[mine.end], ankle = target.places[mine.end];
      const heel = one => -numbers.heel * one.leg / numbers.leg;
      // Heel and the sole under the ball, from the ankle.
      const low = [[0, target.sole - ankle[1], heel(target)]];
      let goal;
      if (yours.after.length && mine.after.length) {
        const ball = sub(target.places[mine.after[0]], ankle);
        const own = ankle[1] + ball[1] - target.sole;
        const other = source.places[yours.after[0]][1] - source.sole;
        goal = sub(this.scaled(places[yours.after[0]], other, own), turned(foot, ball));
        low.push(sub(ball, [0, own, 0]));
      } else goal = this.scaled(places[yours.end], ...this.heights);
      // Neither heel nor ball below the ground, or below the source's own.
      const under = turned(foot, [0, source.sole - source.places[yours.end][1], heel(source)])[1];
      const floor = Math.min(size * (places[yours.end][1] + under), 0);
      goal[1] += Math.max(...low.map(p => floor - goal[1] - turned(foot, p)[1]), 0);
      // Where the leg is too short for its goal, the hips sink.
      const hip = this.hip(moves, middle, mine), most = numbers.reach * sum(mine.lengths);
      const aside = (hip[0] - goal[0]) ** 2 + (hip[2] - goal[2]) ** 2;
      const height = goal[1] + Math.sqrt(Math.max(most * most - aside, 0));
      drops.push(clip(hip[1] - height, 0, 0.15 * most));
      return goal;
    });
    middle[1] -= Math.max(...drops);
    return { middle, goals };
  }

  // The target's hip joint.
  hip(moves, middle, leg) {
    const offset = sub(this.target.places[leg.upper], this.middle);
    return add(middle, turned(moves[this.target.roles.hips], offset));
  }

  // Swings a joint's bone to a direction.
  aim(moves, joint, child, direction) {
    const bone = unit(sub(this.target.places[child], this.target.places[joint]));
    moves[joint] = times(swing(turned(moves[joint], bone), unit(direction)), moves[joint]);
  }

  // A limb of two bones reaches for a goal, bent as the source's is.
  limb(moves, places, yours, mine, start, goal, ahead) {
    const [upper, elbow, end] = [yours.upper, yours.middle, yours.end].map(j => places[j]);
    const way = unit(sub(end, upper)), bone = sub(elbow, upper);
    const bent = sub(bone, scale(dot(bone, way), way));
    const straight = this.numbers.pull * sum(yours.lengths) * ahead;
    const pole = add(bent, scale(straight, column(moves[mine.upper], 2)));
    const joint = twoBones(start, goal, pole, ...mine.lengths, this.numbers.reach);
    this.aim(moves, mine.upper, mine.middle, sub(joint, start));
    this.aim(moves, mine.middle, mine.end, sub(goal, joint));
  }

  // Twist joint, its limb's joint, the two whose turn counts, its part, and the bone.
  twistBones() {
    const { target, leader } = this, found = [];
    for (const limb of [...target.arms, ...target.legs]) {
      const above = target.parents[limb.upper];
      for (const [joint, a, b, start, shift] of [
        [limb.middle, limb.middle, limb.end, limb.end, 0],
        [limb.upper, above, limb.upper, limb.middle, -1]]) {
        const bone = sub(target.places[start], target.places[joint]);
        leader.forEach((up, twist) => {
          if (up !== joint || !/twist/i.test(target.names[twist])) return;
          const away = sub(target.places[twist], target.places[joint]);
          const part = dot(away, bone) / dot(bone, bone);
          if (part >= 0 && part < 1.01)
            found.push([twist, joint, a, b, Math.min(part, 1) + shift, unit(bone)]);
        });
      }
    }
    return found;
  }

  twist(moves) {
    return this.twists.map(([twist, joint, a, b, part, bone]) => {
      const between = times(transposed(moves[this.leader[a]]), moves[b]), m = between;
      const skew = dot([m[7] - m[5], m[2] - m[6], m[3] - m[1]], bone);
      const angle = 2 * part * Math.atan2(skew, Math.max(1 + trace(m), 1e-6));
      return [twist, times(moves[joint], about(bone, angle))];
    });
  }
}

const sum = values => values.reduce((a, b) => a + b, 0);

// Places and turns of a person's joints in the world.
function world({ parents, offsets }, root, rotation) {
  const places = [], turns = [];
  parents.forEach((up, j) => {
    const c = columns(rotation, 6 * j);
    const own = [c[0], c[3], c[6], c[1], c[4], c[7], c[2], c[5], c[8]];
    turns[j] = up < 0 ? own : times(turns[up], own);
    places[j] = up < 0 ? [...root] : add(places[up], turned(turns[up], offsets[j]));
  });
  return { places, turns };
}
