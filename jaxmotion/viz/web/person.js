// Whose joints are whose on a rig, and how it stands in a T-pose: `retarget/roles.py`,
// `motion/anatomy.py` and `transfer.rest`. The words of names are theirs, too: `tables` is what `transfer.page_json` writes.

import {
  EYE, add, chain, clip, cross, dot, long, mean, mean1, scale, sub, swing, times, turned, unit,
} from "./linear.js";
import { byShape } from "./shape.js";

const LEFT = "left", RIGHT = "right", MIDDLE = "middle", SIDES = [LEFT, RIGHT];
const ARM = ["UpperArm", "LowerArm", "Hand"], LEG = ["UpperLeg", "LowerLeg", "Foot"];

function sideOf(tables, name) {
  for (const [pattern, flags] of tables.sides) {
    const found = new RegExp(pattern, flags).exec(name);
    if (found) return found[1].toLowerCase().startsWith("l") ? LEFT : RIGHT;
  }
  return MIDDLE;
}

// Side and word of a name; an empty word for helpers.
function read(tables, name) {
  const own = name.split(":").pop();
  const tokens = (own.match(new RegExp(tables.token, "g")) || []).map(t => t.toLowerCase());
  if (tokens.some(t => tables.helpers.includes(t))) return [MIDDLE, ""];
  let side = sideOf(tables, own);
  let word = tokens.filter(t => !tables.noise.includes(t)).join("");
  const known = Object.values(tables.words).flat();
  if (side === MIDDLE && !known.includes(word) && /^[lr]/.test(word)
    && known.includes(word.slice(1)))
    [side, word] = [word[0] === "l" ? LEFT : RIGHT, word.slice(1)];
  for (const end of SIDES)
    if (side === MIDDLE && word.endsWith(end)) [side, word] = [end, word.slice(0, -end.length)];
  return [side, word];
}

// The lowest joint that all are below, or are.
function lowest(parents, joints) {
  const [first, ...others] = joints.map(j => chain(parents, j));
  return first.filter(j => others.every(one => one.includes(j))).pop();
}

function byNames(tables, { names, parents }) {
  const have = names.map(name => read(tables, name)), found = {};
  const first = (role, side, words) => {
    for (const word of words) {
      const taken = Object.values(found);
      const j = have.findIndex((x, i) => x[0] === side && x[1] === word && !taken.includes(i));
      if (j >= 0) { found[side === MIDDLE ? role : side + role] = j; return; }
    }
  };
  const below = (upper, lower) => chain(parents, lower).includes(upper);
  for (const side of SIDES) {
    for (const role of [...LEG, "Toes", ...ARM, "Shoulder"])
      first(role, side, tables.words[role]);
    const at = part => found[side + part];
    if (at("Toes") >= 0 && !below(at("Foot"), at("Toes"))) delete found[side + "Toes"];
    if (at("Shoulder") >= 0 && at("UpperArm") >= 0 && !below(at("Shoulder"), at("UpperArm")))
      delete found[side + "Shoulder"];
  }
  first("head", MIDDLE, tables.heads);
  first("neck", MIDDLE, tables.necks);
  if ("head" in found || "neck" in found) return found;
  // Blender's spine goes on with its numbers beyond the chest.
  const arms = SIDES.map(side => found[side + "UpperArm"]).filter(j => j !== undefined);
  const spine = names.flatMap((_, j) => have[j][0] === MIDDLE && have[j][1] === "spine" ? [j] : []);
  const chest = arms.length < 2 ? -1 : lowest(parents, arms);
  const over = spine.filter(j => j !== chest && below(chest, j));
  if (spine.includes(chest) && over.length > 1) [found.neck, found.head] = [over[0], over.at(-1)];
  return found;
}

// What is wrong with the limbs; empty if nothing is.
function lacking({ names, parents }, found) {
  const pairs = SIDES.flatMap(side => [LEG, ARM].map(parts => parts.map(x => side + x)));
  const missing = pairs.flat().filter(role => !(role in found));
  if (missing.length) return missing.join(", ");
  for (const parts of pairs) for (const i of [1, 2]) {
    const [a, b] = [found[parts[i - 1]], found[parts[i]]];
    if (a === b || !chain(parents, b).includes(a))
      return `${parts[i]} below ${parts[i - 1]} ('${names[b]}' is not below '${names[a]}')`;
  }
  return "";
}

const listed = names => names.slice(0, 12).map(x => x.slice(0, 40)).join(", ")
  + (names.length > 12 ? ` and ${names.length - 12} more` : "");

// The joint of each role, by index; throws an Error with what was found and is missing.
// told: those that the file itself says.
export function findRoles(tables, skeleton, told = {}) {
  const taken = Object.values(told);
  const named = Object.entries(byNames(tables, skeleton)).filter(([, j]) => !taken.includes(j));
  const { names, parents } = skeleton;
  let found = { ...Object.fromEntries(named), ...told };
  if (lacking(skeleton, found)) {
    const sides = names.map(name => sideOf(tables, name));
    const shaped = Object.entries(byShape(skeleton, zeroPose(skeleton), sides))
      .filter(([, j]) => !taken.includes(j));
    if (shaped.length) found = { ...Object.fromEntries(shaped), ...told };
  }
  const lack = lacking(skeleton, found);
  if (lack) {
    const have = Object.entries(found).map(([role, j]) => `${role} '${names[j]}'`);
    throw new Error(`no person: missing ${lack}; found ${listed(have) || "nothing"} among `
      + `the joints ${listed(names)}`);
  }
  // Of the trunk, too: legs may hang on a pelvis beside the spine, and arms likewise.
  const top = ["head", "neck"].filter(role => role in found).map(role => found[role]).slice(0, 1);
  const both = part => SIDES.map(side => found[side + part]);
  if (!("chest" in told)) found.chest = lowest(parents, [...both("UpperArm"), ...top]);
  if (!("hips" in told)) found.hips = lowest(parents, [...both("UpperLeg"), found.chest]);
  const hung = [...[...both("UpperLeg"), found.chest].map(j => ["hips", j]),
    ...[...top, ...both("UpperArm")].map(j => ["chest", j])];
  for (const [role, j] of hung)
    if (!chain(parents, j).includes(found[role]))
      throw new Error(`no person: '${names[j]}' does not hang on the ${role} `
        + `('${names[found[role]]}')`);
  return found;
}

// A person in the T-pose, as `transfer.page_json` writes one.
//   skeleton: names, parents, and offsets of a rest pose, axes those of the world
//   sole: how far below the ankles the ground is; null for an adult's
export function person({ tables, numbers }, skeleton, { told = {}, sole = null } = {}) {
  const { names, parents, offsets } = skeleton;
  const roles = findRoles(tables, skeleton, told);
  const one = { names, parents, offsets, roles, ...anatomy(skeleton, roles) };
  Object.assign(one, tPose(one, numbers));
  const { places } = one, away = (a, b) => long(sub(places[b], places[a]));
  for (const limb of [...one.arms, ...one.legs]) {
    limb.lengths = [away(limb.upper, limb.middle), away(limb.middle, limb.end)];
    if (Math.min(...limb.lengths) < 1e-6)
      throw new Error(`a bone of '${names[limb.upper]}' has no length`);
  }
  one.leg = mean1(one.legs.map(x => x.lengths[0] + x.lengths[1]));
  const ankle = mean1(one.legs.map(x => places[x.end][1]));
  if (sole === null) {
    const s = one.leg / numbers.leg;
    const toes = one.legs.flatMap(x => x.after).map(j => places[j][1]);
    const drop = toes.length ? Math.max(ankle - mean1(toes), 0) : 0;
    sole = drop + clip(numbers.ankle * s - drop, 0.018 * s, 0.042 * s);
  }
  return { ...one, sole: ankle - sole };
}

// Places where no joint is turned, from the root.
function zeroPose({ parents, offsets }) {
  const zero = [];
  parents.forEach((up, j) => { zero[j] = up < 0 ? [0, 0, 0] : add(zero[up], offsets[j]); });
  return zero;
}

function anatomy({ names, parents, offsets }, roles) {
  const top = roles.head ?? roles.neck ?? roles.chest, trunk = chain(parents, top);
  const limbs = (parts, after) => SIDES.map(side => {
    const [upper, middle, end] = parts.map(part => roles[side + part]);
    const before = chain(parents, upper).filter(j => !trunk.includes(j)).slice(0, -1);
    const toes = after && side + after in roles ? [roles[side + after]] : [];
    return { side, before, upper, middle, end, after: toes };
  });
  const zero = zeroPose({ parents, offsets });
  const arms = limbs(ARM), legs = limbs(LEG, "Toes");
  const rise = sub(zero[top], mean(legs.map(leg => zero[leg.end])));
  const upright = rise[1] > 0.8 * long(rise);
  if (trunk.length < 2 && !upright)
    throw new Error(`no person: arms and legs hang on '${names[top]}' alone, without a spine, `
      + "so nothing tells which way is up");
  return { trunk, arms, legs, zero, upright };
}

// Places and turns where it stands with its arms level to the sides, facing +z.
function tPose({ parents, offsets, trunk, arms, legs, zero, upright }, numbers) {
  const wanted = new Map(), down = [0, -1, 0], ahead = [0, 0, 1];
  const turn = rootTurn(trunk, legs, zero, upright);
  const pelvis = trunk.indexOf(parents[[...legs[0].before, legs[0].upper][0]]);
  const above = trunk[pelvis + 1] ?? null;
  const chest = times(chestTurn(parents, arms, zero, turn, above), turn);
  for (const leg of legs) {
    wanted.set(leg.upper, [leg.middle, down]).set(leg.middle, [leg.end, down]);
    for (const toe of leg.after) {
      const sole = sub(zero[toe], zero[leg.end]);
      let fall = -sole[1] / Math.max(long(sole), 1e-9);
      if (!(upright && fall >= 0 && fall < 0.8)) fall = numbers.sole;
      wanted.set(leg.end, [toe, [0, -fall, Math.sqrt(1 - fall * fall)]]);
    }
  }
  for (const { side, before, upper, middle, end } of arms) {
    const out = [side === LEFT ? 1 : -1, 0, 0], joints = [...before.slice(-1), upper, middle, end];
    joints.slice(0, -1).forEach((joint, i) => {
      const child = joints[i + 1], bone = turned(chest, sub(zero[child], zero[joint]));
      // A clavicle keeps its slope.
      if (!before.includes(joint) || dot(unit(bone), out) < 0.6) wanted.set(joint, [child, out]);
    });
  }
  const turns = [], places = [];
  parents.forEach((up, j) => {
    turns[j] = up < 0 ? turn : j === above ? chest : turns[up];
    places[j] = up < 0 ? [0, 0, 0] : places[up].map((x, k) => x + turned(turns[up], offsets[j])[k]);
    if (!wanted.has(j)) return;
    const [child, way] = wanted.get(j);
    turns[j] = times(swing(unit(turned(turns[j], offsets[child])), way, ahead), turns[j]);
  });
  return { turns, places };
}

// Stands the zero pose up, facing +z.
function rootTurn(trunk, legs, zero, upright) {
  const hips = Object.fromEntries(legs.map(leg => [leg.side, zero[leg.upper]]));
  const up = upright ? [0, 1, 0] : unit(sub(zero[trunk[trunk.length - 1]], zero[trunk[0]]));
  let left = sub(hips[LEFT], hips[RIGHT]);
  left = unit(sub(left, scale(dot(left, up), up)));
  return [...left, ...up, ...cross(left, up)];
}

// Turns the spine so that shoulders are above the hips, not across them.
function chestTurn(parents, arms, zero, turn, above) {
  const first = arms.map(arm => [...arm.before, arm.upper][0]);
  if (!first.every(j => chain(parents, j).includes(above))) return EYE;
  const [left, right] = first.map(j => turned(turn, zero[j]));
  const across = [left[0] - right[0], 0, left[2] - right[2]];
  if (unit(across)[0] > 0.9 || long(across) < 1e-6) return EYE;
  return swing(unit(across), [1, 0, 0], [0, 1, 0]);
}
