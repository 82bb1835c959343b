// A rigged character of a binary glTF (.glb, .vrm), as `export/rig.py` and
// `export/rig_mesh.py` read it: its skeleton in the rest pose, axes those of the world,
// and its meshes in that pose as one, with base colors and their textures. Whatever is
// wrong is an Error in one line.

import { mean1 } from "./linear.js";

const ARRAYS = {
  5120: Int8Array, 5121: Uint8Array, 5122: Int16Array, 5123: Uint16Array,
  5125: Uint32Array, 5126: Float32Array,
};
const WIDTHS = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4, MAT4: 16 };
const PACKED = ["KHR_draco_mesh_compression", "EXT_meshopt_compression"];
const TRIANGLES = 4, MAGIC = 0x46546c67, TEXT = 0x4e4f534a, BINARY = 0x004e4942;
const MOST_JOINTS = 256;
// Degrees: joints may stand so far from how a mesh was bound; turned farther on average,
// they are seen from another frame.
const POSED = 2, FAR = 60;

function refuse(line) { throw new Error(line); }

// JSON and bytes of a file.
function chunks(buffer) {
  const view = new DataView(buffer), bytes = new Uint8Array(buffer);
  const word = at => view.getUint32(at, true);
  if (bytes.length < 20 || word(0) !== MAGIC)
    refuse("no binary glTF: expected a .glb or .vrm");
  if (word(4) !== 2) refuse(`binary glTF of version ${word(4)}, expected 2`);
  const end = 20 + word(12);
  if (word(16) !== TEXT || end > bytes.length) refuse("damaged: its first part is cut off");
  let content = null, data = new Uint8Array(0);
  try {
    content = JSON.parse(new TextDecoder().decode(bytes.subarray(20, end)));
  } catch { /* said below */ }
  if (!content || typeof content !== "object") refuse("damaged: its JSON cannot be read");
  if (end + 8 <= bytes.length && word(end + 4) === BINARY) {
    if (end + 8 + word(end) > bytes.length) refuse("damaged: its second part is cut off");
    data = bytes.subarray(end + 8, end + 8 + word(end));
  }
  return { content, data };
}

class File {
  constructor(buffer) {
    Object.assign(this, chunks(buffer));
    for (const name of ["buffers", "bufferViews", "accessors", "nodes", "meshes", "skins",
      "materials", "textures", "images"]) {
      const found = this.content[name] ?? [];
      if (!Array.isArray(found) || found.some(x => !x || typeof x !== "object"))
        refuse(`damaged: '${name}' should be a list of objects`);
      this[name] = found;
    }
    const apart = this.buffers.findIndex((x, i) => i || x.uri !== undefined);
    if (apart >= 0)
      refuse(`buffer ${apart} is outside of the file: expected a .glb that holds all of it`);
    const packed = (this.content.extensionsRequired || []).find(x => PACKED.includes(x));
    if (packed) refuse(`${packed}: expected meshes as they are, not packed`);
  }

  item(kind, index, what) {
    const found = Number.isInteger(index) && this[kind][index];
    return found || refuse(`damaged: ${what} is ${index}, expected in 0..${this[kind].length - 1}`);
  }

  // The bytes of a view, from an offset on.
  bytes(index, offset = 0, size = null) {
    const view = this.item("bufferViews", index, "a view");
    const start = (view.byteOffset || 0) + offset, end = start + (size ?? view.byteLength);
    if (!(start >= 0 && end >= start && end <= this.data.length))
      refuse(`damaged: view ${index} ends beyond the buffer`);
    return this.data.subarray(start, end);
  }

  // An accessor's values, `width` in a row; normalized ones become 0 to 1.
  values(index) {
    const about = this.item("accessors", index, "an accessor");
    const Kind = ARRAYS[about.componentType], width = WIDTHS[about.type], { count } = about;
    if (!Kind || !width || !Number.isInteger(count) || count < 0)
      refuse(`damaged: accessor ${index} has an unknown type or count`);
    if (about.sparse || about.bufferView === undefined)
      refuse(`accessor ${index} is sparse or has no view`);
    const { byteStride } = this.item("bufferViews", about.bufferView, "a view");
    const size = Kind.BYTES_PER_ELEMENT * width, step = byteStride ?? size;
    if (!Number.isInteger(step) || step < size) refuse(`damaged: accessor ${index} has a wrong stride`);
    const whole = count ? step * (count - 1) + size : 0;
    const bytes = this.bytes(about.bufferView, about.byteOffset || 0, whole);
    const rows = new Uint8Array(size * count);
    for (let i = 0; i < count; i++) rows.set(bytes.subarray(step * i, step * i + size), size * i);
    let values = new Kind(rows.buffer);
    if (about.normalized && Kind !== Float32Array) {
      const most = 2 ** (8 * Kind.BYTES_PER_ELEMENT - (Kind.name[0] === "I" ? 1 : 0)) - 1;
      values = Float32Array.from(values, x => x / most);
    }
    return { values, width, count };
  }
}

// Matrices are 16 numbers, column by column.
function product(a, b) {
  const made = new Array(16);
  for (let c = 0; c < 16; c += 4) for (let r = 0; r < 4; r++)
    made[c + r] = a[r] * b[c] + a[4 + r] * b[c + 1] + a[8 + r] * b[c + 2] + a[12 + r] * b[c + 3];
  return made;
}

function numbers(values, count, what) {
  if (!Array.isArray(values) || values.length !== count || !values.every(x => Math.abs(x) < 1e6))
    refuse(`damaged: ${what} should be ${count} numbers`);
  return values;
}

function local(node, number) {
  if (node.matrix) return numbers(node.matrix, 16, `matrix of node ${number}`);
  const [a, b, c] = numbers(node.translation ?? [0, 0, 0], 3, `translation of node ${number}`);
  const turn = numbers(node.rotation ?? [0, 0, 0, 1], 4, `rotation of node ${number}`);
  const [u, v, t] = numbers(node.scale ?? [1, 1, 1], 3, `scale of node ${number}`);
  const long = Math.hypot(...turn);
  if (!(long > 1e-6)) refuse(`damaged: rotation of node ${number} is zero`);
  const [x, y, z, w] = turn.map(q => q / long);
  return [
    u * (1 - 2 * (y * y + z * z)), u * 2 * (x * y + w * z), u * 2 * (x * z - w * y), 0,
    v * 2 * (x * y - w * z), v * (1 - 2 * (x * x + z * z)), v * 2 * (y * z + w * x), 0,
    t * 2 * (x * z + w * y), t * 2 * (y * z - w * x), t * (1 - 2 * (x * x + y * y)), 0,
    a, b, c, 1,
  ];
}

// Parents of all nodes, -1 for none, and their world matrices at rest.
function tree({ nodes }) {
  const parents = nodes.map(() => -1), world = [];
  nodes.forEach((node, number) => {
    for (const child of node.children ?? []) {
      if (!nodes[child]) refuse(`damaged: node ${number} has a child ${child} that is not there`);
      if (parents[child] >= 0) refuse(`damaged: node ${child} has two parents`);
      parents[child] = number;
    }
  });
  nodes.forEach((_, start) => {
    const path = [];
    for (let node = start; node >= 0 && !world[node]; node = parents[node]) {
      if (path.length > nodes.length) refuse(`damaged: node ${start} is above itself`);
      path.push(node);
    }
    for (const node of path.reverse()) {
      const own = local(nodes[node], node);
      world[node] = parents[node] < 0 ? own : product(world[parents[node]], own);
    }
  });
  return { parents, world };
}

// A matrix's inverse, if it only moves, turns and scales evenly; else null.
function inverse(m) {
  const axes = [0, 4, 8].map(c => m.slice(c, c + 3)), size = axes.map(a => a.reduce((s, x) => s + x * x, 0));
  if (!m.every(x => Math.abs(x) < 1e6) || !(Math.min(...size) > 1e-12)) return null;
  const [x, y, z] = axes, volume = x[0] * (y[1] * z[2] - y[2] * z[1])
    + x[1] * (y[2] * z[0] - y[0] * z[2]) + x[2] * (y[0] * z[1] - y[1] * z[0]);
  if (!(volume > 0.9 * Math.sqrt(size[0] * size[1] * size[2]))) return null;
  const made = new Array(16).fill(0);
  axes.forEach((a, c) => a.forEach((x, k) => { made[4 * k + c] = x / size[c]; }));
  for (let r = 0; r < 3; r++)
    made[12 + r] = -(made[r] * m[12] + made[4 + r] * m[13] + made[8 + r] * m[14]);
  made[15] = 1;
  return made;
}

// Degrees between the axes of two matrices.
function angle(a, b) {
  let trace = 0;
  for (const c of [0, 4, 8]) {
    const [x, y] = [a, b].map(m => m.slice(c, c + 3)), long = Math.hypot(...x) * Math.hypot(...y);
    trace += (x[0] * y[0] + x[1] * y[1] + x[2] * y[2]) / long;
  }
  return Math.acos(Math.min(1, Math.max(-1, (trace - 1) / 2))) * 180 / Math.PI;
}

// World matrices of all nodes with the joints as meshes were bound, where they stand
// otherwise (files are saved in a frame of an animation): `_bound` of `export/rig.py`.
function bound(file, parents, world) {
  const found = new Map(), { skins, nodes } = file;
  const order = skins.map((_, i) => i).sort((a, b) => skins[b].joints.length - skins[a].joints.length);
  for (const number of order) {
    const { joints, inverseBindMatrices } = skins[number];
    if (inverseBindMatrices === undefined) continue;
    const { values, width, count } = file.values(inverseBindMatrices);
    if (width !== 16 || count < joints.length) continue;
    const backs = joints.map((_, j) => [...values.subarray(16 * j, 16 * j + 16)]);
    const bind = backs.map(inverse), now = joints.map(joint => world[joint]);
    if (bind.includes(null)) continue;
    const deep = joints.map(joint => { let n = 0; for (let at = joint; at >= 0; at = parents[at]) n++; return n; });
    const top = deep.indexOf(Math.min(...deep)), above = parents[joints[top]];
    const frames = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]];
    if (above >= 0) frames.push(world[above]);
    nodes.forEach((node, n) => { if (node.skin === number) frames.push(world[n]); });
    const bones = joints.map((joint, i) => [i, joints.indexOf(parents[joint])]).filter(([, up]) => up >= 0);
    if (!bones.length) continue;
    const lengths = at => bones.map(([i, up]) =>
      Math.hypot(...[12, 13, 14].map(k => at[i][k] - at[up][k])));
    const long = lengths(now), usual = mean1(long);
    let best = { turned: 180 };
    for (const tried of [frames, [product(now[top], backs[top])]]) {
      best = { turned: 180 };
      for (const frame of tried) {
        const at = bind.map(m => product(frame, m));
        const fit = lengths(at).filter((x, i) => Math.abs(x - long[i]) <= 0.05 * Math.max(long[i], usual));
        const turned = mean1(at.map((m, i) => angle(m, now[i])));
        if (fit.length >= 0.9 * bones.length && turned < best.turned) best = { turned, at };
      }
      if (best.turned < FAR) break;
    }
    if (best.at) joints.forEach((joint, i) => { if (!found.has(joint)) found.set(joint, best.at[i]); });
  }
  if (![...found].some(([joint, at]) => angle(at, world[joint]) > POSED)) return world;
  const made = [];
  const stand = node => {
    if (!made[node]) {
      const up = parents[node], own = local(nodes[node], node);
      made[node] = found.get(node) || (up < 0 ? own : product(stand(up), own));
    }
    return made[node];
  };
  nodes.forEach((_, node) => stand(node));
  return made;
}

// Whether a world matrix only moves, turns and scales evenly, as a joint's should.
function check(m, number) {
  const axes = [0, 4, 8].map(c => m.slice(c, c + 3)), sizes = axes.map(a => Math.hypot(...a));
  if (!(Math.min(...sizes) > 1e-9)) refuse(`node ${number} has the scale zero`);
  const [x, y, z] = axes.map((a, i) => a.map(v => v / sizes[i]));
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const volume = dot(z, [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]);
  const skew = Math.max(...[dot(x, y), dot(x, z), dot(y, z)].map(Math.abs));
  if (Math.max(...sizes) > 1.02 * Math.min(...sizes) || skew > 1e-2 || volume < 0)
    refuse(`node ${number} is mirrored, sheared or uneven`);
}

// Nodes of the skeleton, parents first: the skins' joints and what joins them. A VRM
// without a skin, whose meshes hang on its bones, says itself what they are.
function jointsOf(file, parents) {
  const { skins } = file, paths = new Map(), bones = Object.values(vrmRoles(file));
  if (!skins.length && !bones.length) refuse("no skin: expected a character with a skeleton");
  (skins.length ? skins : [{ joints: bones }]).forEach(({ joints }, number) => {
    const what = skins.length ? `skin ${number}` : "the VRM";
    if (!Array.isArray(joints) || !joints.length) refuse(`damaged: ${what} has no joints`);
    for (const joint of joints) {
      file.item("nodes", joint, `a joint of ${what}`);
      const path = [joint];
      while (parents[path[0]] >= 0) path.unshift(parents[path[0]]);
      paths.set(joint, path);
    }
  });
  const all = [...paths.values()], roots = new Set(all.map(path => path[0]));
  if (roots.size > 1)
    refuse(`${skins.length ? `${skins.length} skins` : "bones"} of ${roots.size} skeletons, expected one`);
  const top = all[0].filter(node => all.every(path => path.includes(node))).pop();
  const depth = new Map();
  for (const path of all) path.forEach((node, i) => { if (i >= path.indexOf(top)) depth.set(node, i); });
  const found = [...depth.keys()].sort((a, b) => depth.get(a) - depth.get(b) || a - b);
  if (found.length > MOST_JOINTS) refuse(`${found.length} joints, expected at most ${MOST_JOINTS}`);
  return found;
}

// Nodes of roles, as VRM 1 or 0 has them.
function vrmRoles({ content }) {
  const found = {};
  for (const key of ["VRMC_vrm", "VRM"]) {
    const bones = content.extensions?.[key]?.humanoid?.humanBones ?? [];
    const listed = Array.isArray(bones) ? bones.map(x => [x?.bone, x]) : Object.entries(bones);
    for (const [bone, about] of listed) if (Number.isInteger(about?.node)) found[bone] = about.node;
  }
  return found;
}

// What of a material is drawn: color (linear), image, its coordinates, least opacity.
function materialOf(file, primitive) {
  const uv = "TEXCOORD_0", white = [1, 1, 1, 1];
  if (primitive.material === undefined) return { color: white, image: null, uv, cut: 0 };
  const material = file.item("materials", primitive.material, "a material");
  const look = material.pbrMetallicRoughness ?? {}, texture = look.baseColorTexture;
  const color = numbers(look.baseColorFactor ?? white, 4, "a material's color");
  const mode = material.alphaMode ?? "OPAQUE";
  const cut = mode === "OPAQUE" ? 0 : mode === "MASK" ? material.alphaCutoff ?? 0.5 : 0.3;
  if (!texture) return { color, image: null, uv, cut };
  const about = file.item("textures", texture.index, "a texture");
  const { source } = about.extensions?.EXT_texture_webp ?? about;
  const image = source === undefined ? null : source;
  return { color, image, uv: `TEXCOORD_${texture.texCoord ?? 0}`, cut };
}

// A PNG's, JPEG's or WebP's bytes; null for others.
function imageOf(file, number) {
  const { bufferView, uri } = file.item("images", number, "an image");
  const isHere = typeof uri === "string" && uri.startsWith("data:");
  if (bufferView === undefined && !isHere)
    refuse(`image ${number} is outside of the file: expected a .glb that holds all of it`);
  const bytes = bufferView === undefined ? decoded(uri, number) : file.bytes(bufferView).slice();
  const has = (at, ...head) => head.every((x, i) => bytes[at + i] === x);
  return has(0, 0x89, 0x50, 0x4e, 0x47) || has(0, 0xff, 0xd8, 0xff)
    || (has(0, 0x52, 0x49, 0x46, 0x46) && has(8, 0x57, 0x45, 0x42, 0x50)) ? bytes : null;
}

function decoded(uri, number) {
  try {
    return Uint8Array.from(atob(uri.slice(uri.indexOf(",") + 1)), x => x.charCodeAt(0));
  } catch { return refuse(`image ${number} is no base64`); }
}

const srgb = x => 255 * (x < 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);

// Arrays of a primitive at rest; moves: of the skin's joints, or of the node itself.
function primitive(file, part, moves, joints, skinned) {
  const have = part.attributes || {};
  const get = (name, ...widths) => {
    if (have[name] === undefined) return null;
    const found = file.values(have[name]);
    if (!widths.includes(found.width)) refuse(`damaged: ${name} has ${found.width} numbers a vertex`);
    return found;
  };
  const points = get("POSITION", 3) || refuse("damaged: a mesh has no places of its vertices");
  const { count } = points;
  let faces = part.indices === undefined ? Uint32Array.from({ length: count }, (_, i) => i)
    : Uint32Array.from(file.values(part.indices).values);
  faces = faces.subarray(0, faces.length - faces.length % 3);
  if (faces.some(x => x >= count)) refuse("damaged: a triangle has corners that are not there");
  const which = skinned && get("JOINTS_0", 4), given = skinned && get("WEIGHTS_0", 4);
  const normals = get("NORMAL", 3)?.values || normalsOf(points.values, faces);
  const { color, image, uv, cut } = materialOf(file, part);
  const tint = get("COLOR_0", 3, 4), corners = image === null ? null : get(uv, 2);
  for (const one of [which, given, tint, corners])
    if (one && one.count < count) refuse("damaged: a mesh has fewer values than vertices");
  const made = {
    positions: new Float32Array(3 * count), normals: new Int8Array(4 * count),
    joints: new Uint8Array(4 * count), weights: new Uint8Array(4 * count),
    colors: new Uint8Array(4 * count), uv: new Float32Array(2 * count), faces, image, cut,
  };
  for (let v = 0; v < count; v++) {
    let at = [0, 0, 0, 0], share = [1, 0, 0, 0];
    if (which && given) {
      share = [...given.values.subarray(4 * v, 4 * v + 4)].map(x => (x > 0 ? x : 0));
      at = [...which.values.subarray(4 * v, 4 * v + 4)].map((j, k) => (share[k] ? j : 0));
      const sum = share.reduce((a, b) => a + b);
      share = sum > 1e-6 ? share.map(x => x / sum) : [1, 0, 0, 0];
      if (at.some(j => j >= moves.length)) refuse("damaged: a vertex follows a joint that is not there");
    }
    const [place, way] = [[0, 0, 0], [0, 0, 0]];
    const p = points.values.subarray(3 * v, 3 * v + 3), n = normals.subarray(3 * v, 3 * v + 3);
    share.forEach((part, k) => {
      if (!part) return;
      const m = moves[at[k]];
      for (let r = 0; r < 3; r++) {
        place[r] += part * (m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
        way[r] += part * (m[r] * n[0] + m[4 + r] * n[1] + m[8 + r] * n[2]);
      }
    });
    if (!place.every(x => Math.abs(x) < 1e6)) refuse("damaged: places of vertices are no numbers");
    made.positions.set(place, 3 * v);
    const long = Math.hypot(...way);
    made.normals.set((long > 1e-12 ? way.map(x => x / long) : [0, 1, 0]).map(x => Math.round(127 * x)), 4 * v);
    made.joints.set(at.map(j => joints[j]), 4 * v);
    const whole = share.map(x => Math.round(255 * x)), top = share.indexOf(Math.max(...share));
    whole[top] += 255 - whole.reduce((a, b) => a + b);
    made.weights.set(whole, 4 * v);
    const mixed = color.map((x, k) => {
      const more = tint && k < tint.width ? tint.values[tint.width * v + k] : 1;
      const bright = Math.min(Math.max(x * more, 0), 1);
      return Math.round(k < 3 ? srgb(bright) : 255 * bright);
    });
    made.colors.set(mixed, 4 * v);
    if (corners) made.uv.set(corners.values.subarray(2 * v, 2 * v + 2), 2 * v);
  }
  return made;
}

// Normals of vertices from the triangles around them.
function normalsOf(points, faces) {
  const made = new Float32Array(points.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map(k => points.subarray(3 * faces[f + k], 3 * faces[f + k] + 3));
    const u = b.map((x, k) => x - a[k]), v = c.map((x, k) => x - a[k]);
    const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    for (let k = 0; k < 3; k++) for (let r = 0; r < 3; r++) made[3 * faces[f + k] + r] += n[r];
  }
  return made;
}

// Primitives of all meshes that follow the joints, at rest.
function primitivesOf(file, joints, parents, world) {
  const found = [], place = new Map(joints.map((node, j) => [node, j]));
  file.nodes.forEach((node, number) => {
    if (node.mesh === undefined) return;
    const mesh = file.item("meshes", node.mesh, "a mesh"), skinned = node.skin !== undefined;
    let moves, follows;
    if (skinned) {
      const skin = file.item("skins", node.skin, "a skin");
      moves = skin.joints.map(joint => world[joint]);
      follows = skin.joints.map(joint => place.get(joint));
      if (skin.inverseBindMatrices !== undefined) {
        const bind = file.values(skin.inverseBindMatrices);
        if (bind.width !== 16 || bind.count < moves.length) refuse("damaged: a skin lacks bind matrices");
        moves = moves.map((m, j) => product(m, bind.values.subarray(16 * j, 16 * j + 16)));
      }
    } else {
      let above = number;
      while (above >= 0 && !place.has(above)) above = parents[above];
      if (above < 0) return;  // a floor, a lamp
      [moves, follows] = [[world[number]], [place.get(above)]];
    }
    for (const part of mesh.primitives || [])
      if ((part.mode ?? TRIANGLES) === TRIANGLES)
        found.push({ ...primitive(file, part, moves, follows, skinned), skinned });
  });
  const drawn = found.filter(part => part.faces.length);
  return drawn.length ? drawn : refuse("no mesh to be drawn");
}

function joined(Kind, parts) {
  const made = new Kind(parts.reduce((sum, x) => sum + x.length, 0));
  let at = 0;
  for (const part of parts) { made.set(part, at); at += part.length; }
  return made;
}

// What a file has: skeleton (names, parents, offsets), told: joints by role, as a VRM
// says; lowest: height of its lowest vertex at rest; arrays and parts, as the scene
// takes them.
export function readRig(buffer) {
  try {
    return readFile(new File(buffer));
  } catch (error) {
    if (error instanceof TypeError || error instanceof RangeError)
      refuse("damaged: its JSON is not what glTF 2.0 has");
    throw error;
  }
}

function readFile(file) {
  const { parents, world: stands } = tree(file), joints = jointsOf(file, parents);
  for (const joint of joints) check(stands[joint], joint);
  // A VRM's rest pose is a T-pose.
  const world = Object.keys(vrmRoles(file)).length ? stands : bound(file, parents, stands);
  if (parents[joints[0]] >= 0) check(world[parents[joints[0]]], parents[joints[0]]);
  const places = joints.map(joint => world[joint].slice(12, 15)), names = [];
  for (const joint of joints) {
    const { name } = file.nodes[joint], title = typeof name === "string" && name || `node ${joint}`;
    names.push(names.includes(title) ? `${title} (${joint})` : title);
  }
  const above = joints.map((joint, j) => (j ? joints.indexOf(parents[joint]) : -1));
  const offsets = places.map((at, j) => (j ? at.map((x, k) => x - places[above[j]][k]) : [0, 0, 0]));
  const found = primitivesOf(file, joints, parents, world);
  const told = Object.fromEntries(Object.entries(vrmRoles(file))
    .map(([role, node]) => [role, joints.indexOf(node)]).filter(([, j]) => j >= 0));
  const arrays = {}, parts = [], starts = [0];
  for (const { positions, faces, image, cut } of found) {
    const name = image === null ? null : `image.${image}`;
    if (name && !(name in arrays)) arrays[name] = imageOf(file, image);
    const first = parts.reduce((sum, part) => sum + part[1], 0);
    parts.push([first, faces.length, arrays[name] ? name : null, cut]);
    starts.push(starts[starts.length - 1] + positions.length / 3);
  }
  for (const name of Object.keys(arrays)) if (!arrays[name]) delete arrays[name];
  for (const name of ["positions", "normals", "joints", "weights", "colors", "uv"])
    arrays[name] = joined(found[0][name].constructor, found.map(part => part[name]));
  arrays.faces = joined(starts[starts.length - 1] < 2 ** 16 ? Uint16Array : Uint32Array,
    found.map((part, i) => part.faces.map(x => x + starts[i])));
  let lowest = Infinity;
  for (const { positions, skinned } of found) if (skinned || !file.skins.length)
    for (let i = 1; i < positions.length; i += 3) lowest = Math.min(lowest, positions[i]);
  return { skeleton: { names, parents: above, offsets }, places, told, lowest, arrays, parts };
}
