import * as Splats from "@mkkellogg/gaussian-splats-3d";
import {later, pixels} from "./camera.js";
import {camera, renderer} from "./three_camera.js";

export async function show(request) {
  const drawn = renderer(request), seen = camera(request), root = document.createElement("div");
  root.style.width = `${request.width}px`;  // the viewer takes its viewport from here
  root.style.height = `${request.height}px`;
  document.body.appendChild(root);
  root.appendChild(drawn.domElement);
  const viewer = new Splats.Viewer({
    selfDrivenMode: false, useBuiltInControls: false, renderer: drawn, camera: seen, rootElement: root,
    sharedMemoryForWorkers: false, gpuAcceleratedSort: false, sphericalHarmonicsDegree: 2, ignoreDevicePixelRatio: true,
    renderMode: Splats.RenderMode.Always, sceneRevealMode: Splats.SceneRevealMode.Instant, inMemoryCompressionLevel: 0, logLevel: Splats.LogLevel.None,
  });
  await viewer.addSplatScene(`/${request.ply}`, {
    splatAlphaRemovalThreshold: 0, showLoadingUI: false, progressiveLoad: false, format: Splats.SceneFormat.Ply,
  });
  for (let k = 0; k < 100 && !(viewer.splatRenderReady && k > 10); k++) { viewer.update(); viewer.render(); await later(0.1); }
  viewer.update();
  viewer.splatMesh.updateVisibleRegionFadeDistance(Splats.SceneRevealMode.Instant);  // without its fading in
  viewer.render();
  return pixels(drawn.getContext(), request);
}
