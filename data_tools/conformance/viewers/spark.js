import * as THREE from "three";
import {SparkRenderer, SplatMesh} from "@sparkjsdev/spark";
import {later, pixels} from "./camera.js";
import {camera, renderer} from "./three_camera.js";

export async function show(request) {
  const drawn = renderer(request), seen = camera(request), scene = new THREE.Scene();
  scene.add(new SparkRenderer({renderer: drawn}));
  const splats = new SplatMesh({url: `/${request.ply}`});
  await splats.initialized;
  scene.add(splats);
  for (let k = 0; k < 8; k++) { drawn.render(scene, seen); await later(0.15); }
  drawn.render(scene, seen);
  return pixels(drawn.getContext(), request);
}
