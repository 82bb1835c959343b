// What is seen: people as skinned meshes, balls, ground, soft shadow, figures on the
// ground. WebGL 2, no library.

// More people than these have plainer bodies.
const MANY = 4;
const SHADOW = 192, LIGHT = [-0.46, 0.80, -0.38];
export const PALE = [0.49, 0.62, 0.84];
const SKY = [0.865, 0.888, 0.915];

const SKINNED = `
in vec3 position, normal; in vec4 joints, weights, color; in vec2 uv;
uniform sampler2D bones; uniform mat4 view; uniform vec3 light;
uniform vec4 square;  // of the shadow: middle (x, z), half its side; > 0 where it is cast
out vec3 turned, place, kept; out vec4 paint; out vec2 spot;
void main() {
  vec4 p = vec4(position, 1.0), n = vec4(normal, 0.0);
  vec3 at = vec3(0.0), up = vec3(0.0);
  for (int k = 0; k < 4; k++) {
    if (weights[k] <= 0.0) continue;
    int j = 3 * int(joints[k] + 0.5);
    vec4 a = texelFetch(bones, ivec2(j, gl_InstanceID), 0);
    vec4 b = texelFetch(bones, ivec2(j + 1, gl_InstanceID), 0);
    vec4 c = texelFetch(bones, ivec2(j + 2, gl_InstanceID), 0);
    at += weights[k] * vec3(dot(a, p), dot(b, p), dot(c, p));
    up += weights[k] * vec3(dot(a, n), dot(b, n), dot(c, n));
  }
  turned = up; place = at; kept = normal; paint = color; spot = uv;
  if (square.w > 0.0) {
    vec2 dark = at.xz - max(at.y, 0.0) / light.y * light.xz;
    gl_Position = vec4((dark - square.xy) / square.z, 0.0, 1.0);
  } else gl_Position = view * vec4(at, 1.0);
}`;
const LIT = `
in vec3 turned, place, kept; in vec4 paint; in vec2 spot;
uniform sampler2D cloth; uniform vec3 light, eye; uniform float alpha, patches, cut; uniform vec4 tint, square;
out vec4 pixel;
// A ball's twelve dark patches: the corners of an icosahedron.
float patch_at(vec3 n) {
  vec3 a = abs(normalize(n)); const float s = 0.5257, t = 0.8507;
  float near = max(dot(a, vec3(0, s, t)), max(dot(a, vec3(s, t, 0)), dot(a, vec3(t, 0, s))));
  float w = fwidth(near) + 1e-4;
  return smoothstep(0.925 - w, 0.925 + w, near);
}
void main() {
  if (square.w > 0.0) { pixel = vec4(1.0, place.y < 0.45 ? 1.0 : 0.0, 0.0, 1.0); return; }
  vec4 worn = paint * texture(cloth, spot);
  if (worn.a < cut) discard;
  vec3 n = normalize(turned), v = normalize(eye - place);
  vec3 base = mix(worn.rgb, tint.rgb, tint.a);
  if (patches > 0.0) base = mix(base, vec3(0.05), patch_at(kept));
  base *= base;  // to linear, roughly
  float sun = max(dot(n, light), 0.0), wrap = max((dot(n, light) + 0.35) / 1.35, 0.0);
  float sky = 0.5 + 0.5 * n.y;
  // What is near the ground or looks down is darker: light does not get there.
  float open = mix(0.55, 1.0, smoothstep(-0.05, 0.5, place.y)) * mix(0.7, 1.0, sky);
  vec3 lit = base * (vec3(1.02, 0.97, 0.90) * (0.55 * sun + 0.35 * wrap)
    + vec3(0.17, 0.18, 0.19) * max(dot(n, v), 0.0)  // from where one looks: no dark side
    + open * mix(vec3(0.30, 0.28, 0.27), vec3(0.40, 0.46, 0.55), sky));
  vec3 h = normalize(light + v);
  float rim = pow(1.0 - max(dot(n, v), 0.0), 4.0);
  lit += 0.09 * pow(max(dot(n, h), 0.0), 36.0) * step(0.0, dot(n, light));
  lit += 0.16 * rim * sky * vec3(0.75, 0.85, 1.0);
  pixel = vec4(sqrt(clamp(lit, 0.0, 1.0)), alpha);
}`;
const QUAD = `
in vec2 corner; out vec2 uv;
void main() { uv = 0.5 + 0.5 * corner; gl_Position = vec4(corner, 0.0, 1.0); }`;
// The first channel, all of a body, is spread wide, by nine pixels of which two are read
// at once, between them; the second, what is near the ground, little: shadows are sharp
// at the feet and soft at the head.
const BLUR = `
in vec2 uv; uniform sampler2D image; uniform vec2 way; out vec4 pixel;
vec2 both(float far) { return texture(image, uv + far * way).xy + texture(image, uv - far * way).xy; }
void main() {
  vec2 here = texture(image, uv).xy;
  float wide = 0.196 * here.x + 0.2995 * both(1.4156).x + 0.1025 * both(3.312).x;
  pixel = vec4(wide, 0.5 * here.y + 0.25 * both(0.8).y, 0.0, 1.0);
}`;
const GROUND = `
in vec2 corner; uniform mat4 view; uniform vec2 middle; out vec2 place;
void main() {
  place = middle + corner * 120.0;
  gl_Position = view * vec4(place.x, 0.0, place.y, 1.0);
}`;
const TILES = `
in vec2 place; uniform vec2 middle; uniform vec3 sky; uniform vec4 square;
uniform sampler2D image; out vec4 pixel;
float lines(vec2 p, float width) {
  vec2 away = abs(fract(p - 0.5) - 0.5), d = fwidth(p);
  vec2 on = 1.0 - smoothstep(vec2(width), vec2(width) + 1.5 * d, away);
  return max(on.x, on.y) * clamp(1.0 - 2.0 * max(d.x, d.y), 0.0, 1.0);
}
void main() {
  float far = length(place - middle);
  vec3 base = mix(vec3(0.80, 0.815, 0.835), vec3(0.835, 0.85, 0.87), exp(-far * far / 60.0));
  base = mix(base, vec3(0.70, 0.72, 0.75), 0.55 * lines(place, 0.005));
  base = mix(base, vec3(0.55, 0.58, 0.63), 0.6 * lines(place / 5.0, 0.002));
  vec2 at = (place - square.xy) / square.z;
  if (max(abs(at.x), abs(at.y)) < 1.0) {
    vec2 dark = texture(image, 0.5 + 0.5 * at).xy;
    float edge = smoothstep(1.0, 0.85, max(abs(at.x), abs(at.y)));
    float shade = edge * (1.0 - (1.0 - 0.42 * dark.x) * (1.0 - 0.30 * dark.y));
    base = mix(base, vec3(0.16, 0.18, 0.23), shade);
  }
  pixel = vec4(mix(base, sky, smoothstep(8.0, 46.0, far)), 1.0);
}`;
const FLAT = `
in vec3 corner; in vec4 paint; uniform mat4 view; out vec4 shown;
void main() { shown = paint; gl_Position = view * vec4(corner, 1.0); }`;
const PLAIN = `in vec4 shown; out vec4 pixel; void main() { pixel = shown; }`;

export class Scene {
  // Throws an Error in one line if the browser has no WebGL 2.
  constructor(canvas) {
    // Smooth edges would be most of the work.
    this.slow = inSoftware();
    const options = { alpha: false, antialias: !this.slow, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("this browser has no WebGL 2: nothing can be drawn");
    this.canvas = canvas; this.gl = gl; this.matrix = new Float32Array(16);
    this.skinned = program(gl, SKINNED, LIT);
    this.blur = program(gl, QUAD, BLUR);
    this.ground = program(gl, GROUND, TILES);
    this.flat = program(gl, FLAT, PLAIN);
    this.quad = gl.createVertexArray();
    gl.bindVertexArray(this.quad);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]),
      gl.STATIC_DRAW);
    attribute(gl, this.blur, "corner", 2, gl.FLOAT, 0, 0);
    this.figures = gl.createVertexArray();
    this.figureBuffer = gl.createBuffer();
    gl.bindVertexArray(this.figures);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.figureBuffer);
    attribute(gl, this.flat, "corner", 3, gl.FLOAT, 28, 0);
    attribute(gl, this.flat, "paint", 4, gl.FLOAT, 28, 12);
    this.targets = [0, 1].map(() => target(gl));
    this.bones = texture(gl, gl.NEAREST);
    this.white = texture(gl, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE,
      new Uint8Array(4).fill(255));
    this.body = null;
    this.ball = this.mesh(sphere());
  }

  // Takes over the skinned meshes of an unpacked body.
  show({ arrays, parts }) {
    for (const mesh of new Set([this.body, this.plain])) if (mesh) mesh.free();
    const crowd = {};
    for (const name of Object.keys(arrays))
      if (name.startsWith("crowd.")) crowd[name.slice(6)] = arrays[name];
    this.body = this.mesh(arrays, parts);
    this.plain = crowd.faces ? this.mesh(crowd) : this.body;
  }

  // Parts are [first corner, corners, name of an image or null, least opacity].
  mesh(arrays, parts = [[0, arrays.faces.length, null, 0]]) {
    const { positions, normals, joints, weights, colors, faces } = arrays;
    const gl = this.gl, array = gl.createVertexArray(), buffers = [];
    const buffer = (target, values) => {
      buffers.push(gl.createBuffer());
      gl.bindBuffer(target, buffers[buffers.length - 1]);
      gl.bufferData(target, values, gl.STATIC_DRAW);
    };
    gl.bindVertexArray(array);
    for (const [name, values, size, kind, unit] of [
      ["position", positions, 3, gl.FLOAT, false], ["normal", normals, 4, gl.BYTE, true],
      ["joints", joints, 4, gl.UNSIGNED_BYTE, false],
      ["weights", weights, 4, gl.UNSIGNED_BYTE, true],
      ["color", colors, 4, gl.UNSIGNED_BYTE, true]]) {
      buffer(gl.ARRAY_BUFFER, values);
      attribute(gl, this.skinned, name, size, kind, 0, 0, unit);
    }
    if (arrays.uv) {
      buffer(gl.ARRAY_BUFFER, arrays.uv);
      attribute(gl, this.skinned, "uv", 2, gl.FLOAT, 0, 0);
    }
    const wide = faces instanceof Uint32Array;
    buffer(gl.ELEMENT_ARRAY_BUFFER, wide ? faces : new Uint16Array(faces));
    gl.bindVertexArray(null);
    const images = {};
    for (const [, , name] of parts)
      if (name && !(name in images)) images[name] = this.image(arrays[name]);
    const free = () => {
      gl.deleteVertexArray(array);
      for (const one of buffers) gl.deleteBuffer(one);
      for (const one of Object.values(images)) gl.deleteTexture(one);
    };
    const drawn = parts.map(([first, count, name, cut]) => (
      { start: first * (wide ? 4 : 2), count, cloth: images[name] || this.white, cut }));
    return { array, kind: wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, parts: drawn, free };
  }

  // A PNG, JPEG or WebP as a texture, white until the browser has read it.
  image(bytes) {
    const gl = this.gl, made = texture(gl, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE,
      new Uint8Array(4).fill(255));
    const options = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
    createImageBitmap(new Blob([bytes]), options).then(image => {
      if (!gl.isTexture(made)) return;
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
        gl.texParameteri(gl.TEXTURE_2D, name, gl.REPEAT);
    }).catch(() => {});
    return made;
  }

  // Draws a picture of
  //   camera: from `camera.js`, whose `see` was called for this canvas
  //   people, ghosts, balls: what moves their meshes, 12 numbers a joint, or null
  //   joints: of a person; figures: flat triangles, 7 numbers a corner (place, color)
  //   reach: half the side of the square where shadows are cast, meters
  draw({ camera, people, ghosts, balls, joints, figures, reach }) {
    const gl = this.gl, { width, height } = this.canvas;
    const square = [camera.at[0], camera.at[2], reach, 0];
    const many = people && people.length > MANY * 12 * joints;
    const seen = mesh => [[mesh, people, joints], [this.ball, balls, 1]].filter(
      ([mesh, moved]) => mesh && moved && moved.length);
    const crowd = seen(many ? this.plain : this.body);
    this.cast(seen(this.plain), square);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...SKY, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST); gl.disable(gl.BLEND);
    this.use(this.ground, camera);
    gl.uniform2f(this.ground.at.middle, camera.at[0], camera.at[2]);
    gl.uniform3fv(this.ground.at.sky, SKY);
    gl.uniform4fv(this.ground.at.square, square);
    this.read(this.ground, this.targets[0].image);
    gl.bindVertexArray(this.quad);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.enable(gl.BLEND);
    gl.blendEquation(gl.FUNC_ADD);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (figures.length) {
      this.use(this.flat, camera);
      gl.bindVertexArray(this.figures);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.figureBuffer);
      gl.bufferData(gl.ARRAY_BUFFER, figures, gl.STREAM_DRAW);
      gl.drawArrays(gl.TRIANGLES, 0, figures.length / 7);
    }
    gl.enable(gl.DEPTH_TEST); gl.depthFunc(gl.LEQUAL);
    this.use(this.skinned, camera);
    const at = this.skinned.at;
    gl.uniform3fv(at.light, unit(LIGHT)); gl.uniform3fv(at.eye, camera.eye);
    gl.uniform4f(at.square, 0, 0, 1, 0);
    gl.uniform1f(at.alpha, 1); gl.uniform4f(at.tint, 0, 0, 0, 0);
    for (const [mesh, moved, count] of crowd) {
      gl.uniform1f(at.patches, mesh === this.ball ? 1 : 0);
      this.instances(mesh, moved, count);
    }
    if (this.body && ghosts && ghosts.length) {
      gl.uniform1f(at.patches, 0);
      gl.uniform4f(at.tint, ...PALE, 0.85); gl.uniform1f(at.alpha, 0.42);
      // Depth first, so that it does not shine through itself.
      gl.colorMask(false, false, false, false);
      this.instances(this.body, ghosts, joints);
      gl.colorMask(true, true, true, true);
      this.instances(this.body, ghosts, joints);
    }
  }

  // The shadow: bodies on a square of the ground seen from the light, then blurred.
  cast(crowd, square) {
    const gl = this.gl, at = this.skinned.at;
    gl.viewport(0, 0, SHADOW, SHADOW);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets[0].frame);
    gl.clearColor(0, 0, 0, 1); gl.clear(gl.COLOR_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.blendEquation(gl.MAX);
    gl.useProgram(this.skinned.made);
    gl.uniform3fv(at.light, unit(LIGHT));
    gl.uniform4f(at.square, square[0], square[1], square[2], 1);
    for (const [mesh, moved, count] of crowd) this.instances(mesh, moved, count);
    gl.disable(gl.BLEND);
    gl.useProgram(this.blur.made);
    gl.bindVertexArray(this.quad);
    // As wide on the ground whatever the square: 7 m of it are drawn as they are.
    const step = Math.min(1, 3.5 / square[2]) / SHADOW;
    for (const [from, to, way] of [[0, 1, [step, 0]], [1, 0, [0, step]]]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets[to].frame);
      this.read(this.blur, this.targets[from].image);
      gl.uniform2fv(this.blur.at.way, way);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }

  use(program, camera) {
    this.gl.useProgram(program.made);
    this.gl.uniformMatrix4fv(program.at.view, false, camera.matrix);
  }

  read(program, image) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, image);
    gl.uniform1i(program.at.image, 0);
  }

  instances(mesh, moved, joints) {
    const gl = this.gl, count = moved.length / (12 * joints);
    gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_2D, this.bones);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3 * joints, count, 0, gl.RGBA, gl.FLOAT,
      moved);
    gl.uniform1i(this.skinned.at.bones, 1);
    gl.bindVertexArray(mesh.array);
    gl.activeTexture(gl.TEXTURE2);
    gl.uniform1i(this.skinned.at.cloth, 2);
    for (const part of mesh.parts) {
      gl.bindTexture(gl.TEXTURE_2D, part.cloth);
      gl.uniform1f(this.skinned.at.cut, part.cut);
      gl.drawElementsInstanced(gl.TRIANGLES, part.count, mesh.kind, part.start, count);
    }
  }
}

// Whether there is no graphics processor, so that the cores draw, too.
function inSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const told = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = told ? gl.getParameter(told.UNMASKED_RENDERER_WEBGL) : "";
  if (gl) gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

function unit(v) {
  const long = Math.hypot(...v);
  return v.map(x => x / long);
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  const head = "#version 300 es\nprecision highp float; precision highp int;\n";
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const part = gl.createShader(kind);
    gl.shaderSource(part, head + text); gl.compileShader(part);
    if (!gl.getShaderParameter(part, gl.COMPILE_STATUS))
      throw new Error(`this browser refuses a shader: ${gl.getShaderInfoLog(part)}`);
    gl.attachShader(made, part);
  }
  gl.linkProgram(made);
  const at = {}, count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < count; i++) {
    const { name } = gl.getActiveUniform(made, i);
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

function attribute(gl, program, name, size, kind, stride, offset, unit = false) {
  const at = gl.getAttribLocation(program.made, name);
  if (at < 0) return;
  gl.enableVertexAttribArray(at);
  gl.vertexAttribPointer(at, size, kind, unit, stride, offset);
}

function texture(gl, filter) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, name, filter);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
    gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

function target(gl) {
  const image = texture(gl, gl.LINEAR), frame = gl.createFramebuffer();
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, SHADOW, SHADOW, 0, gl.RGBA, gl.UNSIGNED_BYTE,
    null);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
  return { image, frame };
}

// A ball of radius 1 as a mesh that one joint moves.
function sphere(around = 32, rings = 20) {
  const places = [], faces = [];
  for (let r = 0; r <= rings; r++) for (let k = 0; k <= around; k++) {
    const a = Math.PI * r / rings, b = 2 * Math.PI * k / around;
    places.push([Math.sin(a) * Math.sin(b), Math.cos(a), Math.sin(a) * Math.cos(b)]);
    if (r === rings || k === around) continue;
    const here = r * (around + 1) + k, below = here + around + 1;
    faces.push(here, below, here + 1, here + 1, below, below + 1);
  }
  const every = values => new Uint8Array(places.flatMap(() => values));
  return {
    positions: new Float32Array(places.flat()),
    normals: new Int8Array(places.flatMap(p => [...p, 0]).map(x => 127 * x)),
    joints: every([0, 0, 0, 0]), weights: every([255, 0, 0, 0]),
    colors: every([236, 233, 226, 255]), faces,
  };
}
