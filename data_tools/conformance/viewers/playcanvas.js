import * as pc from "playcanvas";
import {later, pixels, projection, view} from "./camera.js";

export async function show(request) {
  const canvas = document.createElement("canvas");
  canvas.width = request.width; canvas.height = request.height;
  canvas.style.width = `${request.width}px`; canvas.style.height = `${request.height}px`;
  document.body.appendChild(canvas);
  const app = new pc.Application(canvas, {graphicsDeviceOptions: {antialias: false, preserveDrawingBuffer: true, alpha: false}});
  app.setCanvasFillMode(pc.FILLMODE_NONE, request.width, request.height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, request.width, request.height);
  app.graphicsDevice.maxPixelRatio = 1;
  app.start();
  const asset = new pc.Asset("probe", "gsplat", {url: `/${request.ply}`});
  app.assets.add(asset);
  await new Promise((resolve, reject) => { asset.ready(resolve); asset.on("error", reject); app.assets.load(asset); });
  const splat = new pc.Entity();
  splat.addComponent("gsplat", {asset});
  app.root.addChild(splat);
  const eye = new pc.Entity();
  eye.addComponent("camera", {
    clearColor: new pc.Color(...request.background, 1), nearClip: 0.05, farClip: 500, toneMapping: pc.TONEMAP_NONE,
    gammaCorrection: pc.GAMMA_SRGB,
  });
  app.root.addChild(eye);
  const world = new pc.Mat4().set(Array.from(view(request))).invert();
  eye.setPosition(world.getTranslation());
  eye.setRotation(new pc.Quat().setFromMat4(world));
  const matrix = Array.from(projection(request));
  eye.camera.calculateProjection = made => made.set(matrix);
  for (let k = 0; k < 10; k++) { app.render(); await later(0.15); }
  app.render();
  return pixels(app.graphicsDevice.gl, request);
}
