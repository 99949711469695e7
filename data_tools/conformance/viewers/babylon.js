import {TargetCamera} from "@babylonjs/core/Cameras/targetCamera.js";
import {Engine} from "@babylonjs/core/Engines/engine.js";
import {Color4} from "@babylonjs/core/Maths/math.color.js";
import {Matrix, Vector3} from "@babylonjs/core/Maths/math.vector.js";
import {GaussianSplattingMesh} from "@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js";
import {Scene} from "@babylonjs/core/scene.js";
import {later, pixels, projection, view} from "./camera.js";

export async function show(request) {
  const canvas = Object.assign(document.createElement("canvas"), {width: request.width, height: request.height});
  canvas.style.width = `${request.width}px`; canvas.style.height = `${request.height}px`;
  document.body.append(canvas);
  const engine = new Engine(canvas, false, {preserveDrawingBuffer: true, alpha: false, premultipliedAlpha: false});
  const scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(...request.background, 1);
  const camera = new TargetCamera("probe", Vector3.Zero(), scene);
  const seen = Matrix.FromArray(view(request)), made = Matrix.FromArray(projection(request));
  camera.getViewMatrix = () => seen;
  camera._computedViewMatrix = seen;
  camera.freezeProjectionMatrix(made);
  const position = Matrix.Invert(seen).getTranslation();
  camera.position.copyFrom(position);
  camera._globalPosition.copyFrom(position);
  const mesh = new GaussianSplattingMesh("splats", null, scene, false);
  const data = await (await fetch(`/${request.ply}`)).arrayBuffer();
  const parts = await GaussianSplattingMesh.ConvertPLYWithSHToSplatAsync(data);
  mesh.updateData(parts.buffer, parts.sh, {flipY: false}, undefined, parts.shDegree);
  for (let k = 0; k < 12; k++) { scene.render(); await later(0.15); }
  scene.render();
  return pixels(engine._gl, request);
}
