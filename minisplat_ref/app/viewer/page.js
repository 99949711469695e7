// The viewer of a page: Gaussians as quads, sorted by depth in a worker, blended back to front into half floats.
// The formulas are those of the profile GSPLAT_MAIN; minisplat_ref.app.viewer.page writes the arrays that are read here.
"use strict";

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp isampler2D;
uniform sampler2D centres, shapes, colors;  // xyz and opacity; xx xy xz yy and yz zz; degree 0
uniform isampler2D harmonics;               // 8 bits for each coefficient of a higher degree, in steps of step_
uniform mat3 R;                             // cam_from_world
uniform vec3 t, eye;
uniform vec2 focal, principal, size;        // pixels
uniform float step_;
uniform int n_rest, width;
in uint index;
out vec2 place;                             // in standard deviations
flat out vec4 color;

ivec2 at(int i) { return ivec2(i % width, i / width); }
vec3 rest(int k) { return vec3(texelFetch(harmonics, at(int(index) * n_rest + k), 0).rgb) * step_; }

vec3 seen(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.5 + 0.28209479177387814 * texelFetch(colors, at(int(index)), 0).rgb;
  if (n_rest >= 3) sum += 0.4886025119029199 * (-y * rest(0) + z * rest(1) - x * rest(2));
  if (n_rest >= 8) sum += 1.0925484305920792 * (x * y * rest(3) - y * z * rest(4) - x * z * rest(6))
    + 0.31539156525252005 * (2.0 * zz - xx - yy) * rest(5) + 0.5462742152960396 * (xx - yy) * rest(7);
  if (n_rest >= 15) sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * rest(8) + x * (xx - 3.0 * yy) * rest(14))
    + 2.890611442640554 * x * y * z * rest(9)
    - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * rest(10) + x * rest(12))
    + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * rest(11)
    + 1.445305721320277 * z * (xx - yy) * rest(13);
  return max(sum, 0.0);
}

void main() {
  int i = int(index);
  vec4 centre = texelFetch(centres, at(i), 0);
  vec3 p = R * centre.xyz + t;
  float reach2 = 2.0 * log(255.0 * centre.w);  // squared distance at which alpha is 1/255
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (p.z <= 0.01 || !(reach2 > 0.0)) return;
  vec4 a = texelFetch(shapes, at(2 * i), 0), b = texelFetch(shapes, at(2 * i + 1), 0);
  mat3 world = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  vec2 slack = 0.15 * size / focal, lo = -principal / focal - slack, hi = (size - principal) / focal + slack;
  vec2 slope = clamp(p.xy / p.z, lo, hi);
  mat3 J = mat3(focal.x / p.z, 0, 0, 0, focal.y / p.z, 0, -focal * slope / p.z, 0);
  mat3 T = J * R, cov = T * world * transpose(T);
  float xx = cov[0][0] + 0.3, xy = cov[0][1], yy = cov[1][1] + 0.3;
  float middle = 0.5 * (xx + yy), root = length(vec2(0.5 * (xx - yy), xy));
  float large = middle + root, small = max((xx * yy - xy * xy) / large, 1e-6);
  vec2 axis = abs(xy) > 1e-12 * large ? normalize(vec2(xy, large - xx)) : xx >= yy ? vec2(1, 0) : vec2(0, 1);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  place = corner * sqrt(reach2);
  vec2 pixel = focal * p.xy / p.z + principal
    + place.x * sqrt(large) * axis + place.y * sqrt(small) * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
  color = vec4(seen(normalize(centre.xyz - eye)), centre.w);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 color;
out vec4 pixel;
void main() {
  float alpha = min(0.99, color.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(alpha * color.rgb, alpha);
}`;

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

const BEHIND = `#version 300 es
precision highp float;
uniform highp sampler2D sum;
uniform vec3 background;
out vec4 pixel;
void main() {
  vec4 s = texelFetch(sum, ivec2(gl_FragCoord.xy), 0);
  pixel = vec4(s.rgb + (1.0 - s.a) * background, 1.0);
}`;

// In the worker: indices by depth, the farthest first; of equal ones the later first, as it is blended under.
function sorter() {
  let means;
  onmessage = ({ data }) => {
    if (data.means) { means = data.means; return; }
    const n = means.length / 3, [x, y, z, w] = data.row, depths = new Float32Array(n), keys = new Uint32Array(depths.buffer);
    let from = new Uint32Array(n), to = new Uint32Array(n), count = 0;
    for (let i = 0; i < n; i++) {
      depths[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w;
      if (depths[i] > 0.01) from[count++] = i;  // bits of positive floats are in the order of the floats
    }
    for (const shift of [0, 16]) {
      const begins = new Uint32Array(65537);
      for (let i = 0; i < count; i++) begins[(keys[from[i]] >>> shift & 65535) + 1]++;
      for (let k = 0; k < 65536; k++) begins[k + 1] += begins[k];
      for (let i = 0; i < count; i++) to[begins[keys[from[i]] >>> shift & 65535]++] = from[i];
      [from, to] = [to, from];
    }
    const order = from.subarray(0, count).reverse().slice();
    postMessage({ order, version: data.version }, [order.buffer]);
  };
}

async function unpack(text, n, nRest) {
  const packed = await fetch("data:application/octet-stream;base64," + text);
  const bytes = await new Response(packed.body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  let begin = 0;
  const take = (Type, k) => { const a = new Type(bytes, begin, k * n); begin += a.byteLength; return a; };
  return {
    means: take(Float32Array, 3), scales: take(Uint16Array, 3), quats: take(Int16Array, 4),
    opacities: take(Uint16Array, 1), dc: take(Uint16Array, 3), rest: take(Int8Array, 3 * nRest),
  };
}

function covariances(data, n, low, step) {
  const out = new Float32Array(8 * n);
  for (let i = 0; i < n; i++) {
    let [w, x, y, z] = data.quats.subarray(4 * i, 4 * i + 4);
    const length = Math.hypot(w, x, y, z);
    w /= length; x /= length; y /= length; z /= length;
    const s = [0, 1, 2].map(k => Math.exp(low + step * data.scales[3 * i + k]));
    const M = [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ].map(row => row.map((value, k) => value * s[k]));
    const dot = (a, b) => M[a][0] * M[b][0] + M[a][1] * M[b][1] + M[a][2] * M[b][2];
    out.set([dot(0, 0), dot(0, 1), dot(0, 2), dot(1, 1), dot(1, 2), dot(2, 2)], 8 * i);
  }
  return out;
}

const add = (a, b, s = 1) => a.map((v, k) => v + s * b[k]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const turn = (v, axis, angle) => add(add(v.map(c => c * Math.cos(angle)), cross(axis, v), Math.sin(angle)), axis,
  dot(axis, v) * (1 - Math.cos(angle)));

async function main() {
  const scene = JSON.parse(document.getElementById("scene").textContent), n = scene.n, nRest = scene.n_rest;
  const canvas = document.querySelector("canvas");
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("this browser has no WebGL 2, which the scene is drawn with");
  if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float"))
    throw new Error("this browser cannot draw into half floats, which the scene is blended in");
  const data = await unpack(document.getElementById("gaussians").textContent, n, nRest);

  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(made, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.bindAttribLocation(made, 0, "index");
    gl.linkProgram(made);
    return { made, at: name => gl.getUniformLocation(made, name) };
  };
  const splats = program(VERTEX, FRAGMENT), final = program(WHOLE, BEHIND);

  const width = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), 8192);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const upload = (unit, name, array, channels, internal, format, type) => {
    const rows = Math.max(1, Math.ceil(array.length / channels / width));
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("the scene is too large for this graphics card");
    const padded = new array.constructor(rows * width * channels);
    padded.set(array);
    gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, rows, 0, format, type, padded);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    gl.useProgram(splats.made); gl.uniform1i(splats.at(name), unit);
  };
  const centres = new Float32Array(4 * n);
  for (let i = 0; i < n; i++) centres.set([...data.means.subarray(3 * i, 3 * i + 3), data.opacities[i] / 65535], 4 * i);
  upload(0, "centres", centres, 4, gl.RGBA32F, gl.RGBA, gl.FLOAT);
  upload(1, "shapes", covariances(data, n, scene.scale_low, scene.scale_step), 4, gl.RGBA32F, gl.RGBA, gl.FLOAT);
  upload(2, "colors", data.dc, 3, gl.RGB16F, gl.RGB, gl.HALF_FLOAT);
  upload(3, "harmonics", data.rest, 3, gl.RGB8I, gl.RGB_INTEGER, gl.BYTE);
  gl.uniform1f(splats.at("step_"), scene.sh_step);
  gl.uniform1i(splats.at("n_rest"), nRest); gl.uniform1i(splats.at("width"), width);

  const order = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.enableVertexAttribArray(0); gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0); gl.vertexAttribDivisor(0, 1);
  const sum = gl.createTexture(), buffer = gl.createFramebuffer();

  let R, position, target, intrinsics, shown = 0, count = 0, version = 0, sorted = -1, isSorting = false, isDue = false;
  const worker = new Worker(URL.createObjectURL(new Blob([`(${sorter})()`], { type: "text/javascript" })));
  worker.onmessage = ({ data }) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, order); gl.bufferData(gl.ARRAY_BUFFER, data.order, gl.DYNAMIC_DRAW);
    count = data.order.length; sorted = data.version; isSorting = false;
    sort(); due();
  };
  worker.postMessage({ means: data.means });
  const sort = () => {
    if (isSorting || sorted === version) return;
    isSorting = true;
    worker.postMessage({ row: [...R[2], -dot(R[2], position)], version });
  };
  const due = () => { if (!isDue) { isDue = true; requestAnimationFrame(draw); } };
  const changed = () => { version++; sort(); due(); };

  function draw() {
    isDue = false;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight].map(v => Math.max(1, Math.round(v * devicePixelRatio)));
    gl.activeTexture(gl.TEXTURE4); gl.bindTexture(gl.TEXTURE_2D, sum);
    if (canvas.width !== w || canvas.height !== h || !canvas.isMade) {
      Object.assign(canvas, { width: w, height: h, isMade: true });
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, w, h, 0, gl.RGBA, gl.HALF_FLOAT, null);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sum, 0);
    }
    const view = intrinsics, scale = Math.min(w / view.width, h / view.height);
    gl.activeTexture(gl.TEXTURE4); gl.bindTexture(gl.TEXTURE_2D, null);  // it is drawn into
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer); gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats.made);
    gl.uniformMatrix3fv(splats.at("R"), true, R.flat());
    gl.uniform3fv(splats.at("t"), R.map(row => -dot(row, position))); gl.uniform3fv(splats.at("eye"), position);
    gl.uniform2f(splats.at("focal"), scale * view.fx, scale * view.fy); gl.uniform2f(splats.at("size"), w, h);
    gl.uniform2f(splats.at("principal"), w / 2 + scale * (view.cx - view.width / 2), h / 2 + scale * (view.cy - view.height / 2));
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    gl.disable(gl.BLEND); gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.activeTexture(gl.TEXTURE4); gl.bindTexture(gl.TEXTURE_2D, sum);
    gl.useProgram(final.made);
    gl.uniform1i(final.at("sum"), 4); gl.uniform3fv(final.at("background"), scene.background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    document.body.dataset.drawn = sorted === version ? shown : "";  // that the picture is final, and of which camera
  }

  function show(index) {
    shown = (index + scene.views.length) % scene.views.length;
    const view = scene.views[shown];
    R = view.R; position = view.position; intrinsics = view;
    target = add(position, R[2], Math.max(1e-6, dot(add(scene.target, position, -1), R[2])));
    document.getElementById("name").textContent = view.name;
    changed();
  }

  // x, y: radians. The camera turns about the target, and about the scene's vertical, so that the horizon stays level.
  function orbit(x, y) {
    const right = R[0], tilt = Math.acos(Math.min(1, Math.max(-1, dot(R[2], scene.up))));
    y = Math.min(Math.max(y, 0.02 - tilt), Math.PI - 0.02 - tilt);
    const both = v => turn(turn(v, right, -y), scene.up, -x);
    position = add(target, both(add(position, target, -1)));
    R = R.map(both);
    changed();
  }
  const nearer = factor => { position = add(target, add(position, target, -1), factor); changed(); };
  const move = (x, y) => {
    const s = Math.hypot(...add(target, position, -1)) / (intrinsics.fy * canvas.clientHeight / intrinsics.height);
    const by = add(R[0].map(v => -v * x * s), R[1], -y * s);
    position = add(position, by); target = add(target, by);
    changed();
  };

  const held = new Map();
  canvas.onpointerdown = e => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.clientX, e.clientY]); };
  canvas.onpointerup = canvas.onpointercancel = e => held.delete(e.pointerId);
  canvas.onpointermove = e => {
    if (!held.has(e.pointerId)) return;
    const [x, y] = held.get(e.pointerId), dx = e.clientX - x, dy = e.clientY - y;
    const span = () => { const [a, b] = held.values(); return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const before = held.size === 2 ? span() : 0;
    held.set(e.pointerId, [e.clientX, e.clientY]);
    if (held.size === 2) { nearer(before / Math.max(span(), 1)); move(dx / 2, dy / 2); }
    else if (e.shiftKey || e.buttons & 2) move(dx, dy);
    else orbit(dx * 0.005, dy * 0.005);
  };
  canvas.addEventListener("wheel", e => { e.preventDefault(); nearer(Math.exp(0.001 * e.deltaY)); }, { passive: false });
  canvas.oncontextmenu = e => e.preventDefault();
  document.getElementById("before").onclick = () => show(shown - 1);
  document.getElementById("after").onclick = () => show(shown + 1);
  window.onkeydown = e => { if (e.key === "ArrowLeft") show(shown - 1); if (e.key === "ArrowRight") show(shown + 1); };
  new ResizeObserver(() => { document.body.dataset.drawn = ""; due(); }).observe(canvas);
  show(0);
}

main().catch(error => { document.getElementById("problem").textContent = error.message; });
