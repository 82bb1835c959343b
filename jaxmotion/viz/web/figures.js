// Flat figures on the ground as triangles, 7 numbers a corner: place and color.

export class Figures {
  #all = new Float32Array(2 ** 14);
  #count = 0;

  clear() { this.#count = 0; return this; }
  // What was added since; the next ones take its place.
  get values() { return this.#all.subarray(0, this.#count); }

  triangle(a, b, c, color) {
    if (this.#count + 21 > this.#all.length) {
      const more = new Float32Array(2 * this.#all.length);
      more.set(this.#all);
      this.#all = more;
    }
    for (const [x, z] of [a, b, c]) {
      this.#all.set([x, 0.008, z], this.#count);
      this.#all.set(color, this.#count + 3);
      this.#count += 7;
    }
  }

  // A line that fades toward its beginning.
  ribbon(points, width, color) {
    for (let i = 1; i < points.length; i++) {
      const [a, b] = [points[i - 1], points[i]];
      const d = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
      const s = [(b[1] - a[1]) / d * width / 2, -(b[0] - a[0]) / d * width / 2];
      const fade = [...color.slice(0, 3), color[3] * i / points.length];
      const from = [a[0] - s[0], a[1] - s[1]], to = [b[0] + s[0], b[1] + s[1]];
      this.triangle(from, [a[0] + s[0], a[1] + s[1]], to, fade);
      this.triangle(from, to, [b[0] - s[0], b[1] - s[1]], fade);
    }
  }

  ring(x, z, radius, width, color) {
    const at = (k, r) =>
      [x + r * Math.sin(k * Math.PI / 16), z + r * Math.cos(k * Math.PI / 16)];
    for (let i = 0; i < 32; i++) {
      const far = radius + width;
      this.triangle(at(i, radius), at(i + 1, radius), at(i + 1, far), color);
      this.triangle(at(i, radius), at(i + 1, far), at(i, far), color);
    }
  }

  // What somebody at (x, z) is told: a head where he is to face, a shaft as he is to go.
  arrow(x, z, dx, dz, color) {
    const d = Math.hypot(dx, dz) || 1, f = [dx / d, dz / d], s = [f[1], -f[0]];
    const at = (ahead, aside) =>
      [x + f[0] * ahead + s[0] * aside, z + f[1] * ahead + s[1] * aside];
    const from = 0.42, tip = from + 0.18 + 0.22 * d;
    if (Math.hypot(dx, dz) > 0.05) {
      this.triangle(at(from, -0.03), at(from, 0.03), at(tip - 0.16, 0.03), color);
      this.triangle(at(from, -0.03), at(tip - 0.16, 0.03), at(tip - 0.16, -0.03), color);
    }
    this.triangle(at(tip - 0.18, -0.1), at(tip - 0.18, 0.1), at(tip, 0), color);
  }
}
