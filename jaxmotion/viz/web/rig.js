// A dropped file worn in the place of the mannequin: `steer.py --rig` in the browser.

import { readRig } from "./gltf.js";
import { mean1 } from "./linear.js";
import { person } from "./person.js";
import { Transfer } from "./transfer.js";

// Who wears a file.
//   wear: of the character, as `transfer.page_json` writes it
// Returns skeleton, arrays and parts as an unpacked body has them, enlarged so that its
// legs are as long as the character's, and `pose(root, rotation)`, which brings a frame
// onto it. Throws an Error in one line.
export function dress(buffer, wear) {
  const rig = readRig(buffer), { skeleton, places } = rig;
  const told = Object.fromEntries(Object.entries(rig.told).filter(
    ([role]) => wear.tables.roles.includes(role) && role !== "chest" && role !== "neck"));
  const first = person(wear, skeleton, { told });
  const ankles = mean1(first.legs.map(leg => places[leg.end][1]));
  const rises = first.legs.map(leg => {
    const heights = [leg.upper, leg.middle, leg.end].map(j => places[j][1]);
    return Math.max(...heights) - Math.min(...heights);
  });
  // How deep the sole is under the ankle, if the mesh tells.
  let sole = ankles - rig.lowest;
  const fits = first.upright && sole > 0.02 * mean1(rises) && sole < 0.4 * mean1(rises);
  const size = wear.source.leg / first.leg;
  sole = fits ? size * sole : null;
  const offsets = skeleton.offsets.map(x => x.map(v => size * v));
  const target = person(wear, { ...skeleton, offsets }, { told, sole });
  const moved = new Transfer(wear.source, target, wear.numbers);
  const inverse = new Float32Array(12 * places.length);
  places.forEach((at, j) => at.forEach((x, r) => {
    inverse[12 * j + 5 * r] = 1;
    inverse[12 * j + 4 * r + 3] = -size * x;
  }));
  const positions = rig.arrays.positions.map(x => size * x);
  return {
    skeleton: { names: skeleton.names, parents: skeleton.parents, offsets }, parts: rig.parts,
    arrays: { ...rig.arrays, positions, inverse }, pose: (...frame) => moved.pose(...frame),
  };
}
