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

  // What somebody at (x, z) is told: a shaft as he is to go, on it a head that points
  // where he is to face (a unit vector).
  arrow(x, z, velocity, facing, color) {
    const d = Math.hypot(...velocity), goes = d > 0.05;
    const way = goes ? velocity.map(v => v / d) : facing, from = 0.42;
    const reach = from + 0.22 * (goes ? d : 0);
    const at = (origin, along, ahead, aside) => [
      origin[0] + along[0] * ahead + along[1] * aside,
      origin[1] + along[1] * ahead - along[0] * aside,
    ];
    const shaft = (ahead, aside) => at([x, z], way, ahead, aside);
    if (goes) {
      this.triangle(shaft(from, -0.03), shaft(from, 0.03), shaft(reach + 0.02, 0.03), color);
      this.triangle(shaft(from, -0.03), shaft(reach + 0.02, 0.03),
        shaft(reach + 0.02, -0.03), color);
    }
    const head = (ahead, aside) => at(shaft(reach, 0), facing, ahead, aside);
    this.triangle(head(0, -0.1), head(0, 0.1), head(0.18, 0), color);
  }
}
