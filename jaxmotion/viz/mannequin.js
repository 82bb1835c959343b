// Skinned meshes in WebGL 2, many at once, with light and a shadow on the ground: what
// saved pages draw people with. Needs a context `gl`.
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
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
  ["corner", "normal", "joints", "weights", "material"].forEach(
    (name, i) => gl.bindAttribLocation(made, i, name));
  gl.linkProgram(made);
  return {made, at: name => gl.getUniformLocation(made, name)};
}
// Rows of a texture are instances; three texels are a joint's matrix.
const solid = program(`
in vec3 corner, normal; in vec4 joints, weights; in float material;
uniform highp sampler2D bones; uniform mat4 view; uniform vec3 light;
uniform vec3 palette[8]; uniform vec4 tint; uniform bool shadow;
out vec3 turned, paint;
void main() {
  vec4 p = vec4(corner, 1), n = vec4(normal, 0);
  vec3 place = vec3(0), up = vec3(0);
  for (int k = 0; k < 4; k++) {
    if (weights[k] <= 0.0) continue;
    int j = 3 * int(joints[k] + 0.5);
    vec4 a = texelFetch(bones, ivec2(j, gl_InstanceID), 0);
    vec4 b = texelFetch(bones, ivec2(j + 1, gl_InstanceID), 0);
    vec4 c = texelFetch(bones, ivec2(j + 2, gl_InstanceID), 0);
    place += weights[k] * vec3(dot(a, p), dot(b, p), dot(c, p));
    up += weights[k] * vec3(dot(a, n), dot(b, n), dot(c, n));
  }
  turned = up;
  paint = mix(palette[int(material + 0.5)], tint.rgb, tint.a);
  if (shadow)
    place = vec3(place.xz - max(place.y, 0.0) / light.y * light.xz, 0.004).xzy;
  gl_Position = view * vec4(place, 1);
}`, `
in vec3 turned, paint; uniform vec3 light; uniform float alpha; uniform bool shadow;
out vec4 shown;
void main() {
  vec3 n = normalize(turned);
  float v = clamp(0.42 + 0.62 * dot(n, light), 0.0, 1.0);
  vec3 c = v < 0.6 ? mix(0.52 * paint, paint, v / 0.6)
                   : mix(paint, mix(paint, vec3(1), 0.38), (v - 0.6) / 0.4);
  shown = shadow ? vec4(0.125, 0.15, 0.18, 0.3) : vec4(c, alpha);
}`);
function upload(values, target) {
  const made = gl.createBuffer(), kind = target || gl.ARRAY_BUFFER;
  gl.bindBuffer(kind, made);
  gl.bufferData(kind, values, gl.STATIC_DRAW);
}
function attribute(i, size, values, kind, normalized) {
  upload(values);
  gl.enableVertexAttribArray(i);
  gl.vertexAttribPointer(i, size, kind || gl.FLOAT, Boolean(normalized), 0, 0);
}
// What is drawn many times: `matrices` holds 12 numbers, three rows, a joint.
function makeMesh(places, normals, joints, weights, materials, faces, count, number) {
  const made = {corners: faces.length, vao: gl.createVertexArray(), count, number,
                bones: gl.createTexture(),
                matrices: new Float32Array(12 * count * number)};
  gl.bindVertexArray(made.vao);
  attribute(0, 3, places);
  attribute(1, 3, normals, gl.BYTE, true);
  attribute(2, 4, joints, gl.UNSIGNED_SHORT);
  attribute(3, 4, weights, gl.UNSIGNED_BYTE, true);
  attribute(4, 1, materials, gl.UNSIGNED_BYTE);
  upload(faces, gl.ELEMENT_ARRAY_BUFFER);
  gl.bindTexture(gl.TEXTURE_2D, made.bones);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  return made;
}
// Places are 16-bit integers between `low` and `low + 65535 step`.
function bodyMesh(body, number) {
  const whole = new Uint16Array(bytes(body.places));
  return makeMesh(
    Float32Array.from(whole, (x, i) => body.low[i % 3] + body.step * x),
    new Int8Array(bytes(body.normals)), new Uint16Array(bytes(body.joints)),
    new Uint8Array(bytes(body.weights)), new Uint8Array(bytes(body.materials)),
    new Uint16Array(bytes(body.faces)), body.inverse.length / 12, number);
}
// A unit sphere that follows its only joint.
function sphereMesh(around, rings) {
  const places = [], faces = [];
  for (let r = 0; r <= rings; r++) for (let k = 0; k < around; k++) {
    const up = Math.PI * r / rings, turn = 2 * Math.PI * k / around;
    places.push(Math.sin(up) * Math.sin(turn), Math.cos(up), Math.sin(up) * Math.cos(turn));
    if (r == rings) continue;
    const a = r * around + k, b = r * around + (k + 1) % around;
    faces.push(a, a + around, b, b, a + around, b + around);
  }
  const number = places.length / 3, weights = new Uint8Array(4 * number);
  for (let i = 0; i < number; i++) weights[4 * i] = 255;
  return makeMesh(
    new Float32Array(places), Int8Array.from(places, x => Math.round(127 * x)),
    new Uint16Array(4 * number), weights, new Uint8Array(number),
    new Uint16Array(faces), 1, 1);
}
// Rows of a joint's world transform (three columns, then the place) times inverse bind.
function bindMatrix(world, w, inverse, i, out, at) {
  for (let r = 0; r < 3; r++) for (let k = 0; k < 4; k++) {
    let sum = k == 3 ? world[w + r] : 0;
    for (let n = 0; n < 3; n++) sum += world[w + 3 + 3 * n + r] * inverse[i + 4 * n + k];
    out[at + 4 * r + k] = sum;
  }
}
function useMeshes(view, light, palette) {
  gl.useProgram(solid.made);
  gl.uniformMatrix4fv(solid.at("view"), false, view);
  gl.uniform3fv(solid.at("light"), light);
  gl.uniform3fv(solid.at("palette"), new Float32Array(palette.flatMap(rgb)));
  gl.uniform1i(solid.at("bones"), 0);
}
// Brings the matrices to the device.
function bring(mesh) {
  gl.bindTexture(gl.TEXTURE_2D, mesh.bones);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3 * mesh.count, mesh.number, 0, gl.RGBA,
                gl.FLOAT, mesh.matrices);
}
function cast(mesh, shadow, alpha, tint) {
  gl.bindVertexArray(mesh.vao);
  gl.bindTexture(gl.TEXTURE_2D, mesh.bones);
  gl.uniform1i(solid.at("shadow"), shadow);
  gl.uniform1f(solid.at("alpha"), alpha);
  gl.uniform4f(solid.at("tint"), ...(tint || [0, 0, 0]), tint ? 1 : 0);
  gl.drawElementsInstanced(gl.TRIANGLES, mesh.corners, gl.UNSIGNED_SHORT, 0, mesh.number);
}
// Without depth, each pixel once.
function drawShadow(mesh) {
  gl.disable(gl.DEPTH_TEST);
  gl.enable(gl.STENCIL_TEST);
  gl.stencilFunc(gl.EQUAL, 0, 255);
  gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
  cast(mesh, 1, 1);
  gl.disable(gl.STENCIL_TEST);
}
function drawMesh(mesh, tint) {
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LEQUAL);
  cast(mesh, 0, 1, tint);
}
// Pale bodies, after the others; depth first, so that none shines through itself.
const PALE = rgb("#8fa3b8");
function drawGhost(mesh) {
  gl.colorMask(false, false, false, false);
  cast(mesh, 0, 1, PALE);
  gl.colorMask(true, true, true, true);
  cast(mesh, 0, 0.45, PALE);
}
