// Vectors of three numbers, rotations as nine, row by row, and chains of joints.

export const EYE = [1, 0, 0, 0, 1, 0, 0, 0, 1];
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (s, a) => [s * a[0], s * a[1], s * a[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const long = a => Math.sqrt(dot(a, a));
export const unit = a => scale(1 / Math.max(long(a), 1e-9), a);
export const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const mean = points => scale(1 / points.length, points.reduce(add));
export const mean1 = values => values.reduce((a, b) => a + b, 0) / values.length;
export const clip = (x, low, high) => Math.min(Math.max(x, low), high);

export const turned = (m, v) => [dot3(m, 0, v), dot3(m, 3, v), dot3(m, 6, v)];
const dot3 = (m, i, v) => m[i] * v[0] + m[i + 1] * v[1] + m[i + 2] * v[2];
export const column = (m, k) => [m[k], m[3 + k], m[6 + k]];
export const transposed = m => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
export const trace = m => m[0] + m[4] + m[8];

export function times(a, b) {
  const made = new Array(9);
  for (let i = 0; i < 9; i += 3) for (let k = 0; k < 3; k++)
    made[i + k] = a[i] * b[k] + a[i + 1] * b[3 + k] + a[i + 2] * b[6 + k];
  return made;
}

// The smallest rotation between unit vectors; about `half`, where it is given and they
// are nearly opposed.
export function swing(a, b, half) {
  if (half && dot(a, b) < -0.9) {
    const first = EYE.map((x, i) => 2 * half[Math.floor(i / 3)] * half[i % 3] - x);
    return times(swing(turned(first, a), b, half), first);
  }
  const [x, y, z] = cross(a, b), s = 1 / Math.max(1 + dot(a, b), 1e-4);
  return [
    1 - s * (y * y + z * z), s * x * y - z, s * x * z + y,
    s * x * y + z, 1 - s * (x * x + z * z), s * y * z - x,
    s * x * z - y, s * y * z + x, 1 - s * (x * x + y * y),
  ];
}

// Joints from the root to one.
export function chain(parents, joint) {
  const found = [];
  for (let j = joint; j >= 0; j = parents[j]) found.unshift(j);
  return found;
}

// A rotation about a unit vector.
export function about([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  return [
    c + d * x * x, d * x * y - s * z, d * x * z + s * y,
    d * x * y + s * z, c + d * y * y, d * y * z - s * x,
    d * x * z - s * y, d * y * z + s * x, c + d * z * z,
  ];
}
