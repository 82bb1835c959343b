// A camera that follows, orbits and zooms.

const FOCAL = 1 / Math.tan(0.36);

export class Camera {
  // azimuth: where it looks, radians from +z toward +x; elevation: above the ground.
  azimuth = 0.35; elevation = 0.24; distance = 4.8;
  at = [0, 0.92, 0]; eye = [0, 0, 0]; matrix = new Float32Array(16);

  turn(dx, dy) {
    this.azimuth -= 0.006 * dx;
    this.elevation = clamp(this.elevation + 0.005 * dy, 0.03, 1.5);
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, 1.5, 60);
  }

  // Comes after what is at (x, z), by a part of the way.
  follow(x, z, part) {
    this.at[0] += part * (x - this.at[0]);
    this.at[2] += part * (z - this.at[2]);
  }

  // Fills `matrix` and `eye` for a canvas; aside: part of its width that is covered at
  // its right end.
  see(canvas, aside) {
    const { azimuth: a, elevation: e, distance, at } = this;
    const f = [Math.sin(a) * Math.cos(e), -Math.sin(e), Math.cos(a) * Math.cos(e)];
    const r = [-Math.cos(a), 0, Math.sin(a)];
    const u = [r[1] * f[2] - r[2] * f[1], r[2] * f[0] - r[0] * f[2],
      r[0] * f[1] - r[1] * f[0]];
    const eye = this.eye = at.map((x, i) => x - distance * f[i]);
    const wide = canvas.width / Math.max(canvas.height, 1), near = 0.1, far = 200;
    // On a narrow screen there is room beside the person, too.
    const focal = FOCAL * Math.min(1, Math.max(1.3 * wide * (1 - aside), 0.75));
    const dot = v => -(v[0] * eye[0] + v[1] * eye[1] + v[2] * eye[2]);
    const p = (far + near) / (near - far), q = 2 * far * near / (near - far);
    const row = [[...r, dot(r)].map(x => x * focal / wide),
      [...u, dot(u)].map(x => x * focal), [...f, dot(f)].map(x => -x * p),
      [...f, dot(f)]];
    row[2][3] += q;
    row[0] = row[0].map((x, k) => x - aside * row[3][k]);
    for (let i = 0; i < 4; i++) for (let j = 0; j < 4; j++)
      this.matrix[4 * j + i] = row[i][j];
    this.axes = { r, u, f, focal, wide, aside };
  }

  // Where the ground is seen at a point of the page, or null.
  onGround(canvas, clientX, clientY) {
    const { r, u, f, focal, wide, aside } = this.axes;
    const x = (2 * clientX / canvas.clientWidth - 1 + aside) * wide / focal;
    const y = (1 - 2 * clientY / canvas.clientHeight) / focal;
    const d = f.map((k, i) => k + x * r[i] + y * u[i]);
    if (d[1] > -0.02) return null;
    const t = -this.eye[1] / d[1];
    return [this.eye[0] + t * d[0], this.eye[2] + t * d[2]];
  }
}

export function clamp(x, low, high) { return Math.min(high, Math.max(low, x)); }
