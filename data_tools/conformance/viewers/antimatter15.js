// A page of its own, not a module: the elements that it looks for, then its script; it reads the address, not arguments.
import {later, pixels} from "./camera.js";

const IDS = ["fps", "camid", "spinner", "progress", "message"];

export async function show(request) {
  const canvas = document.createElement("canvas");
  canvas.id = "canvas";
  document.body.append(canvas, ...IDS.map(id => Object.assign(document.createElement("div"), {id})));
  Object.defineProperty(window, "innerWidth", {value: request.width});
  Object.defineProperty(window, "innerHeight", {value: request.height});
  const script = document.createElement("script"), ply = new URL(`/${request.ply}`, location.href);
  const seen = request.cam_from_world, columns = [0, 1, 2, 3].flatMap(k => seen.map(row => row[k]));  // OpenCV's axes
  history.replaceState(null, "", `?url=${ply}#${JSON.stringify(columns)}`);
  script.src = "/repositories/splat/main.js";
  const loaded = new Promise((resolve, reject) => { script.onload = resolve; script.onerror = reject; });
  document.body.append(script);
  await loaded;
  (0, eval)(`camera.fx = ${request.fx}; camera.fy = ${request.fy}`);
  await later(0.5);
  window.dispatchEvent(new Event("resize"));  // the projection, made again
  await later(1.5);
  const drawn = await new Promise(resolve => requestAnimationFrame(() => resolve(pixels(canvas.getContext("webgl2"), request))));
  for (let k = 0; k < drawn.length; k++) drawn[k] += Math.round((255 - drawn[k - k % 4 + 3]) * (request.background[k % 4] ?? 1));
  return drawn;
}
