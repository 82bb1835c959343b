// Capsules as instances of one mesh in WebGL 2, with light and a shadow on the ground:
// what saved pages and the live page draw people with. Needs a context `gl`.
// What is drawn of a capsule: both ends, both radii, color.
const WIDTH = 11;
function rgb(color) {
  return [1, 3, 5].map(i => parseInt(color.slice(i, i + 2), 16) / 255);
}
function program(vertex, fragment) {
  const made = gl.createProgram(), head = "#version 300 es\nprecision highp float;\n";
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex],
                              [gl.FRAGMENT_SHADER, fragment]]) {
    const part = gl.createShader(kind);
    gl.shaderSource(part, head + text); gl.compileShader(part);
    if (!gl.getShaderParameter(part, gl.COMPILE_STATUS))
      throw new Error(gl.getShaderInfoLog(part));
    gl.attachShader(made, part);
  }
  ["corner", "a", "b", "radii", "color"].forEach(
    (name, i) => gl.bindAttribLocation(made, i, name));
  gl.linkProgram(made);
  return {made, at: name => gl.getUniformLocation(made, name)};
}
const solid = program(`
in vec3 corner, a, b, color; in vec2 radii;  // corner: part of the arc, turn, end
uniform mat4 view; uniform vec3 light; uniform bool shadow;
out vec3 normal, paint;
void main() {
  float far = length(b - a), half_pi = 1.5707963;
  vec3 z = far > 1e-5 ? (b - a) / far : vec3(0, 1, 0);
  vec3 x = normalize(cross(z, abs(z.y) < 0.9 ? vec3(0, 1, 0) : vec3(1, 0, 0)));
  vec3 y = cross(z, x);
  float lean = asin(clamp((radii.x - radii.y) / max(far, 1e-5), -0.99, 0.99));
  if (far <= 1e-5) lean = 0.0;
  float angle = corner.z < 0.5 ? mix(-half_pi, lean, corner.x)
                               : mix(lean, half_pi, corner.x);
  normal = cos(angle) * (cos(corner.y) * x + sin(corner.y) * y) + sin(angle) * z;
  vec3 p = mix(a, b, corner.z) + mix(radii.x, radii.y, corner.z) * normal;
  if (shadow) p = vec3(p.xz - max(p.y, 0.0) / light.y * light.xz, 0.004).xzy;
  paint = color;
  gl_Position = view * vec4(p, 1);
}`, `
in vec3 normal, paint; uniform vec3 light; uniform float alpha; uniform bool shadow;
out vec4 shown;
void main() {
  float v = clamp(0.42 + 0.62 * dot(normalize(normal), light), 0.0, 1.0);
  vec3 c = v < 0.6 ? mix(0.52 * paint, paint, v / 0.6)
                   : mix(paint, mix(paint, vec3(1), 0.38), (v - 0.6) / 0.4);
  shown = shadow ? vec4(0.125, 0.15, 0.18, 0.3) : vec4(c, alpha);
}`);
function upload(values) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  return made;
}
function attribute(i, size, stride, offset, each) {
  gl.enableVertexAttribArray(i);
  gl.vertexAttribPointer(i, size, gl.FLOAT, false, 4 * stride, 4 * offset);
  gl.vertexAttribDivisor(i, each);
}
// One capsule: rings of both ends.
function capsuleMesh(around, rings) {
  const mesh = [];
  for (const end of [0, 1]) for (let r = 0; r < rings + (end ? 0 : 1); r++)
    for (let k = 0; k < around; k++) {
      const bridge = !end && r == rings;
      const corner = (i, j) => mesh.push(
        bridge ? 1 - i : (r + i) / rings, 2 * Math.PI * (k + j) / around,
        bridge ? i : end);
      for (const [i, j] of [[0, 0], [0, 1], [1, 1], [0, 0], [1, 1], [1, 0]])
        corner(i, j);
    }
  const made = {corners: mesh.length / 3, vao: gl.createVertexArray(),
                buffer: gl.createBuffer()};
  gl.bindVertexArray(made.vao);
  upload(new Float32Array(mesh)); attribute(0, 3, 3, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, made.buffer);
  [[1, 3, 0], [2, 3, 3], [3, 2, 6], [4, 3, 8]].forEach(
    ([i, size, offset]) => attribute(i, size, WIDTH, offset, 1));
  return made;
}
function useCapsules(mesh, view, light) {
  gl.useProgram(solid.made);
  gl.uniformMatrix4fv(solid.at("view"), false, view);
  gl.uniform3fv(solid.at("light"), light);
  gl.bindVertexArray(mesh.vao);
}
function bring(mesh, shapes) {
  gl.bindBuffer(gl.ARRAY_BUFFER, mesh.buffer);
  gl.bufferData(gl.ARRAY_BUFFER, shapes, gl.DYNAMIC_DRAW);
}
function cast(mesh, shadow, alpha, count) {
  gl.uniform1i(solid.at("shadow"), shadow);
  gl.uniform1f(solid.at("alpha"), alpha);
  gl.drawArraysInstanced(gl.TRIANGLES, 0, mesh.corners, count);
}
// Shadows first: without depth, each pixel once.
function drawCapsules(mesh, count) {
  gl.disable(gl.DEPTH_TEST);
  gl.enable(gl.STENCIL_TEST);
  gl.stencilFunc(gl.EQUAL, 0, 255);
  gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
  cast(mesh, 1, 1, count);
  gl.disable(gl.STENCIL_TEST);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LEQUAL);
  cast(mesh, 0, 1, count);
}
// A pale body, after the others; depth first, so that it does not shine through itself.
const PALE = rgb("#8fa3b8");
function drawGhost(mesh, count) {
  gl.colorMask(false, false, false, false);
  cast(mesh, 0, 1, count);
  gl.colorMask(true, true, true, true);
  cast(mesh, 0, 0.45, count);
}
