import * as SPLAT from "gsplat";
import {later, pixels} from "./camera.js";

export async function show(request) {
  const scene = new SPLAT.Scene(), m = request.cam_from_world;
  const renderer = new SPLAT.WebGLRenderer(null, []);  // without the pass that fades in
  renderer.setSize(request.width, request.height);
  await SPLAT.PLYLoader.LoadAsync(`/${request.ply}`, scene, () => {});
  const camera = new SPLAT.Camera();
  camera.data.fx = request.fx; camera.data.fy = request.fy; camera.data.near = 0.05; camera.data.far = 500;
  camera.data.setSize(request.width, request.height);
  // world_from_cam: position -R^T t, rotation R^T, row-major 3 x 3
  const R = [0, 1, 2].map(i => [0, 1, 2].map(j => m[j][i])), t = [m[0][3], m[1][3], m[2][3]];
  const position = R.map(row => -(row[0] * t[0] + row[1] * t[1] + row[2] * t[2]));
  camera.position = new SPLAT.Vector3(...position);
  camera.rotation = SPLAT.Quaternion.FromMatrix3(new SPLAT.Matrix3(...R.flat()));
  for (let k = 0; k < 8; k++) { camera.update(); renderer.render(scene, camera); await later(0.15); }
  renderer.render(scene, camera);
  const shown = pixels(renderer.gl, request);  // premultiplied: the page lies behind the canvas
  for (let k = 0; k < shown.length; k++) shown[k] += Math.round((255 - shown[k - k % 4 + 3]) * (request.background[k % 4] ?? 1));
  return shown;
}
