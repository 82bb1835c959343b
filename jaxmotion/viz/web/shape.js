// Roles that a skeleton's shape tells where names do not: `roles._by_shape`, with what
// it needs of `motion/anatomy.py`.

import { chain, dot, long, mean, mean1, sub, unit } from "./linear.js";

const LEFT = "left", RIGHT = "right", MIDDLE = "middle";
const TIP = /end|top|site|nub|tip/;

// The joint at the trunk's upper end, and whether it is a head; null for none.
function findHead(parents, names, sides, zero) {
  for (const word of ["head", "neck"]) {
    const found = names.flatMap((name, j) => {
      const low = name.toLowerCase();
      return low.includes(word) && !TIP.test(low) ? [j] : [];
    });
    // A neck may have several joints.
    if (found.length) return word === "head" ? [found[0], true] : [found[found.length - 1], false];
  }
  const free = names.flatMap((_, j) =>
    (j && !parents.includes(j) && sides[j] === MIDDLE ? [j] : []));
  const top = free.reduce((a, b) => (a < 0 || zero[b][1] > zero[a][1] ? b : a), -1);
  return top >= 0 && zero[top][1] > zero[0][1] ? [top, true] : null;
}

// Arms and legs, not sided: legs are what leaves the trunk at its lowest joint.
// Both of a pair may leave it at one joint, if their names tell them apart.
function findLimbs(parents, lengths, trunk, sides) {
  const parts = new Map(), reach = part => part.reduce((sum, j) => sum + lengths[j], 0);
  parents.forEach((_, leaf) => {
    if (parents.includes(leaf)) return;
    const part = chain(parents, leaf).filter(j => !trunk.includes(j));
    const key = `${part[0]} ${sides[leaf]}`;
    if (part.length && reach(part) > reach(parts.get(key) || [])) parts.set(key, part);
  });
  const level = part => trunk.indexOf(parents[part[0]]);
  const found = [...parts.values()].filter(
    part => part.length > 2 && parents[part[0]] !== trunk[trunk.length - 1]);
  const lowest = Math.min(...found.map(level)), arms = [], legs = [];
  for (const part of found) {
    let i = 1;
    for (let k = 1; k < part.length - 1; k++)
      if (lengths[part[k]] + lengths[part[k + 1]] > lengths[part[i]] + lengths[part[i + 1]]) i = k;
    (level(part) === lowest ? legs : arms).push({
      before: part.slice(0, i - 1), upper: part[i - 1], middle: part[i], end: part[i + 1],
      after: part.slice(i + 2),
    });
  }
  return { arms, legs };
}

// Sides of a zero pose that stands: toes point ahead.
function guessSides(parents, zero, limbs, legs) {
  const toes = legs.filter(leg => leg.after.length).map(leg => sub(zero[leg.after[0]], zero[leg.end]));
  const [x, , z] = toes.length ? mean(toes) : [0, 0, 0], sides = parents.map(() => MIDDLE);
  for (const { before, upper } of limbs) {
    const first = [...before, upper][0];
    const away = dot([z, 0, -x], sub(zero[upper], zero[parents[first]]));
    if (Math.abs(away) > 1e-9) parents.forEach((_, j) => {
      if (chain(parents, j).includes(first)) sides[j] = away > 0 ? LEFT : RIGHT;
    });
  }
  return sides;
}

// The longest limb of each side: a hood or a ribbon is none.
function onePerSide(limbs, lengths) {
  const of = side => limbs.filter(limb => limb.side === side);
  if (!of(LEFT).length || !of(RIGHT).length) return limbs;
  const size = limb => lengths[limb.middle] + lengths[limb.end];
  const best = [LEFT, RIGHT].map(side => of(side).reduce((a, b) => (size(b) > size(a) ? b : a)));
  return limbs.filter(limb => best.includes(limb));
}

// Joints by role; empty if it is no person.
//   zero: places of the zero pose; named: side of each joint that its name tells
export function byShape({ names, parents, offsets }, zero, named) {
  const lengths = offsets.map((x, j) => (j ? long(x) : 0));
  const head = findHead(parents, names, named, zero);
  const trunk = chain(parents, head ? head[0] : 0), top = trunk[trunk.length - 1];
  const { arms, legs } = head ? findLimbs(parents, lengths, trunk, named) : { arms: [], legs: [] };
  if (!arms.length || !legs.length) return {};
  const rise = sub(zero[top], mean(legs.map(leg => zero[leg.end])));
  const upright = rise[1] > 0.8 * long(rise), all = [...arms, ...legs];
  const sides = upright && named.every(x => x === MIDDLE)
    ? guessSides(parents, zero, all, legs) : named;
  for (const limb of all) limb.side = sides[limb.middle];
  const kept = [arms, legs].map(limbs => onePerSide(limbs, lengths)), [two, others] = kept;
  const sorted = kept.flat().map(limb => limb.side).sort();
  if (sorted.join() !== [LEFT, LEFT, RIGHT, RIGHT].join()) return {};
  const spans = kept.flat().map(limb => sub(zero[limb.end], zero[limb.upper]));
  const height = limbs => mean1(limbs.map(limb => zero[limb.end][1]));
  const spine = unit(sub(zero[top], zero[trunk[0]])), leg = mean1(spans.slice(2).map(long));
  // On four legs the trunk lies, or the neck rises and the hands are on the ground.
  const lies = Math.abs(spine[1]) < 0.6 || height(two) - height(others) < 0.35 * leg;
  if (lies && spans.every(x => unit(x)[1] < -0.6)) return {};
  const made = {};
  for (const { side, before, upper, middle, end } of two) {
    Object.assign(made, { [`${side}UpperArm`]: upper, [`${side}LowerArm`]: middle, [`${side}Hand`]: end });
    if (before.length) made[`${side}Shoulder`] = before[before.length - 1];
  }
  for (const { side, upper, middle, end, after } of others) {
    Object.assign(made, { [`${side}UpperLeg`]: upper, [`${side}LowerLeg`]: middle, [`${side}Foot`]: end });
    if (after.length) made[`${side}Toes`] = after[0];
  }
  if (head[1]) made.head = top;
  return made;
}
