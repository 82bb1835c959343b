// A character as both pages read it: skeleton, skinned mesh and, on the static page,
// starts, all in one file; and the kinematics that put the mesh's joints into the world.

const KINDS = {
  float32: Float32Array, int32: Int32Array, uint32: Uint32Array,
  uint16: Uint16Array, uint8: Uint8Array, int8: Int8Array, bool: Uint8Array,
};

// A file of `jaxmotion.viz.packed`: the length of a JSON text, the text, the arrays.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {}, base = 4 + length;
  for (const [name, { dtype, shape, offset }] of Object.entries(about.arrays)) {
    const count = shape.reduce((a, b) => a * b, 1);
    arrays[name] = new KINDS[dtype](buffer, base + offset, count);
  }
  return { ...about, shapes: about.arrays, arrays };
}

// World transforms of all joints, 12 numbers each: three columns, then the position.
// `rotation` has two columns a joint, which need not be quite unit or at right angles.
export function kinematics(skeleton, root, rotation, world) {
  const { parents, offsets } = skeleton;
  for (let j = 0; j < parents.length; j++) {
    const c = columns(rotation, 6 * j), to = 12 * j, up = 12 * parents[j];
    if (parents[j] < 0) {
      world.set(c, to);
      for (let i = 0; i < 3; i++) world[to + 9 + i] = root[i];
      continue;
    }
    const [x, y, z] = offsets[j];
    for (let i = 0; i < 3; i++) {
      const a = world[up + i], b = world[up + 3 + i], d = world[up + 6 + i];
      for (let k = 0; k < 9; k += 3)
        world[to + k + i] = a * c[k] + b * c[k + 1] + d * c[k + 2];
      world[to + 9 + i] = a * x + b * y + d * z + world[up + 9 + i];
    }
  }
  return world;
}

const column = new Float64Array(9);
// Three columns of a rotation from the first two, by Gram and Schmidt.
export function columns(rotation, at) {
  let [a, b, c] = [rotation[at], rotation[at + 1], rotation[at + 2]];
  const long = Math.hypot(a, b, c) || 1;
  a /= long; b /= long; c /= long;
  let [d, e, f] = [rotation[at + 3], rotation[at + 4], rotation[at + 5]];
  const along = a * d + b * e + c * f;
  d -= along * a; e -= along * b; f -= along * c;
  const wide = Math.hypot(d, e, f) || 1;
  d /= wide; e /= wide; f /= wide;
  column.set([a, b, c, d, e, f, b * f - c * e, c * d - a * f, a * e - b * d]);
  return column;
}

// What moves the mesh: rows of world transform times inverse bind, 12 numbers a joint.
export function skin(world, inverse, out, at) {
  const joints = inverse.length / 12;
  for (let j = 0; j < joints; j++) {
    const w = 12 * j;
    for (let i = 0; i < 3; i++) for (let k = 0; k < 4; k++) {
      let sum = k === 3 ? world[w + 9 + i] : 0;
      for (let n = 0; n < 3; n++) sum += world[w + 3 * n + i] * inverse[w + 4 * n + k];
      out[at + w + 4 * i + k] = sum;
    }
  }
}
