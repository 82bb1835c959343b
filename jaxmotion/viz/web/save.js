// A motion as a file: glTF (binary) with the skinned mesh, or BVH in centimeters.

import { columns } from "./body.js";

// Quaternion (x, y, z, w) of three columns.
function quaternion(c) {
  const [a, b, d, e, f, g, h, i, j] = c;  // columns: (a b d), (e f g), (h i j)
  const trace = a + f + j;
  let q;
  if (trace > 0) q = [g - i, h - d, b - e, 1 + trace];
  else if (a > f && a > j) q = [1 + a - f - j, e + b, h + d, g - i];
  else if (f > j) q = [e + b, 1 + f - a - j, i + g, h - d];
  else q = [h + d, i + g, 1 + j - a - f, b - e];
  const long = Math.hypot(...q);
  return q.map(x => x / long);
}

// roots: [3] a frame, meters; rotations: [6 joints] a frame, parent-local.
export function glb(body, fps, roots, rotations) {
  const { skeleton, arrays } = body, { parents, names, offsets } = skeleton;
  const joints = parents.length, frames = roots.length, count = arrays.positions.length / 3;
  const views = [], accessors = [], parts = [];
  let length = 0;
  const add = (values, componentType, type, items, more = {}, target) => {
    const bytes = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
    views.push({ buffer: 0, byteOffset: length, byteLength: bytes.length,
      ...(target ? { target } : {}) });
    parts.push(bytes, new Uint8Array(-bytes.length & 3));
    length += bytes.length + (-bytes.length & 3);
    const accessor = { bufferView: views.length - 1, componentType, type, count: items };
    accessors.push({ ...accessor, ...more });
    return accessors.length - 1;
  };
  const bounds = (values, size) => {
    const at = pick => [...Array(size).keys()].map(k => {
      let best = values[k];
      for (let i = k; i < values.length; i += size) best = pick(best, values[i]);
      return best;
    });
    return { min: at(Math.min), max: at(Math.max) };
  };
  const VERTEX = 34962, INDEX = 34963, FLOAT = 5126, UBYTE = 5121;
  const normals = new Float32Array(3 * count), weights = new Float32Array(4 * count);
  for (let v = 0; v < count; v++) {
    const n = [0, 1, 2].map(k => arrays.normals[4 * v + k]), long = Math.hypot(...n) || 1;
    normals.set(n.map(x => x / long), 3 * v);
    const w = arrays.weights.subarray(4 * v, 4 * v + 4), sum = w.reduce((a, b) => a + b);
    weights.set([...w].map(x => x / sum), 4 * v);
  }
  const linear = x => (x < 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  const colors = new Float32Array(4 * count).map((_, i) =>
    i % 4 === 3 ? 1 : linear(arrays.colors[i] / 255));
  const used = new Uint8Array(arrays.joints);
  for (let i = 0; i < used.length; i++) if (!arrays.weights[i]) used[i] = 0;
  const attributes = {
    POSITION: add(arrays.positions, FLOAT, "VEC3", count, bounds(arrays.positions, 3), VERTEX),
    NORMAL: add(normals, FLOAT, "VEC3", count, {}, VERTEX),
    JOINTS_0: add(used, UBYTE, "VEC4", count, {}, VERTEX),
    WEIGHTS_0: add(weights, FLOAT, "VEC4", count, {}, VERTEX),
    COLOR_0: add(colors, FLOAT, "VEC4", count, {}, VERTEX),
  };
  if (arrays.uv) attributes.TEXCOORD_0 = add(arrays.uv, FLOAT, "VEC2", count, {}, VERTEX);
  const wide = arrays.faces instanceof Uint32Array;
  const faces = wide ? arrays.faces : new Uint16Array(arrays.faces);
  const look = { metallicFactor: 0, roughnessFactor: 0.8 };
  const images = [], materials = [], primitives = [];
  for (const [first, corners, name, cut] of body.parts || [[0, faces.length, null, 0]]) {
    const some = faces.slice(first, first + corners);
    const indices = add(some, wide ? 5125 : 5123, "SCALAR", corners, {}, INDEX);
    let at = images.findIndex(image => image.name === name);
    if (name && at < 0) {
      const bytes = arrays[name], png = bytes[0] === 0x89;
      views.push({ buffer: 0, byteOffset: length, byteLength: bytes.length });
      parts.push(bytes, new Uint8Array(-bytes.length & 3));
      length += bytes.length + (-bytes.length & 3);
      at = images.push({ name, bufferView: views.length - 1,
        mimeType: png ? "image/png" : "image/jpeg" }) - 1;
    }
    const pbrMetallicRoughness = name ? { ...look, baseColorTexture: { index: at } } : look;
    materials.push({ pbrMetallicRoughness,
      ...(cut ? { alphaMode: "MASK", alphaCutoff: cut } : {}) });
    primitives.push({ attributes, indices, material: materials.length - 1 });
  }
  // Column by column, of rows.
  const inverse = new Float32Array(16 * joints);
  for (let j = 0; j < joints; j++) for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
    inverse[16 * j + 4 * c + r] = r < 3 ? arrays.inverse[12 * j + 4 * r + c] : +(c === 3);
  const bind = add(inverse, FLOAT, "MAT4", joints);
  const times = new Float32Array(frames).map((_, i) => i / fps);
  const input = add(times, FLOAT, "SCALAR", frames, bounds(times, 1));
  const samplers = [], channels = [];
  const track = (values, type, node, path) => {
    samplers.push({ input, output: add(values, FLOAT, type, frames) });
    channels.push({ sampler: samplers.length - 1, target: { node, path } });
  };
  for (let j = 0; j < joints; j++) {
    const turns = new Float32Array(4 * frames);
    let last = [0, 0, 0, 1];
    for (let f = 0; f < frames; f++) {
      let q = quaternion(columns(rotations[f], 6 * j));
      // Neighbors on the same side, or players turn the long way round.
      if (q.reduce((sum, x, k) => sum + x * last[k], 0) < 0) q = q.map(x => -x);
      turns.set(last = q, 4 * f);
    }
    track(turns, "VEC4", j, "rotation");
  }
  const places = new Float32Array(3 * frames);
  roots.forEach((root, f) => places.set(root, 3 * f));
  track(places, "VEC3", 0, "translation");
  const nodes = names.map((name, j) => {
    const children = parents.flatMap((up, k) => (up === j ? [k] : []));
    return { name, translation: j ? offsets[j] : [...places.subarray(0, 3)],
      ...(children.length ? { children } : {}) };
  });
  nodes.push({ name: "body", mesh: 0, skin: 0 });
  const text = JSON.stringify({
    asset: { version: "2.0", generator: "jaxmotion" }, scene: 0,
    scenes: [{ nodes: [0, joints] }], nodes,
    meshes: [{ name: "body", primitives }],
    skins: [{ joints: names.map((_, j) => j), skeleton: 0, inverseBindMatrices: bind }],
    materials,
    ...(images.length ? { images, textures: images.map((_, source) => ({ source })) } : {}),
    animations: [{ name: "motion", samplers, channels }],
    accessors, bufferViews: views, buffers: [{ byteLength: length }],
  });
  const json = new TextEncoder().encode(text);
  const padded = new Uint8Array(json.length + (-json.length & 3)).fill(32);
  padded.set(json);
  const made = new Uint8Array(28 + padded.length + length), head = new DataView(made.buffer);
  [0x46546c67, 2, made.length, padded.length, 0x4e4f534a].forEach(
    (x, i) => head.setUint32(4 * i, x, true));
  made.set(padded, 20);
  head.setUint32(20 + padded.length, length, true);
  head.setUint32(24 + padded.length, 0x004e4942, true);
  let at = 28 + padded.length;
  for (const part of parts) { made.set(part, at); at += part.length; }
  return made;
}

// Angles about z, x and y, as `export/player.py` writes them.
export function bvh(skeleton, fps, roots, rotations) {
  const { parents, names, offsets } = skeleton, lines = ["HIERARCHY"], order = [];
  const joint = (j, pad) => {
    order.push(j);
    const isRoot = parents[j] < 0, children = parents.flatMap((up, k) => (up === j ? [k] : []));
    const offset = offsets[j].map(x => (isRoot ? 0 : 100 * x).toFixed(4)).join(" ");
    const place = isRoot ? "6 Xposition Yposition Zposition" : "3";
    lines.push(`${pad}${isRoot ? "ROOT" : "JOINT"} ${names[j].replace(/[{}\r\n]+/g, "_")}`, `${pad}{`,
      `${pad}  OFFSET ${offset}`, `${pad}  CHANNELS ${place} Zrotation Xrotation Yrotation`);
    for (const k of children) joint(k, pad + "  ");
    if (!children.length)
      lines.push(`${pad}  End Site`, `${pad}  {`, `${pad}    OFFSET 0 0 0`, `${pad}  }`);
    lines.push(`${pad}}`);
  };
  joint(parents.indexOf(-1), "");
  lines.push("MOTION", `Frames: ${roots.length}`, `Frame Time: ${(1 / fps).toFixed(8)}`);
  roots.forEach((root, f) => {
    const row = [...root].map(x => 100 * x);
    for (const j of order) {
      const c = columns(rotations[f], 6 * j), cosine = Math.hypot(c[3], c[4]);
      const locked = cosine < 1e-6;  // A quarter turn about x: those about z and y are one.
      row.push(...[locked ? Math.atan2(c[1], c[0]) : Math.atan2(-c[3], c[4]),
        Math.atan2(c[5], cosine), locked ? 0 : Math.atan2(-c[2], c[8])].map(x => x * 180 / Math.PI));
    }
    lines.push(row.map(x => x.toFixed(5)).join(" "));
  });
  return lines.join("\n") + "\n";
}
