// three.js' camera and renderer for a request.
import * as THREE from "three";
import {projection, view} from "./camera.js";

export function renderer(request) {
  const made = new THREE.WebGLRenderer({antialias: false, preserveDrawingBuffer: true, alpha: false});
  made.setPixelRatio(1);
  made.setSize(request.width, request.height);
  made.setClearColor(new THREE.Color().setRGB(...request.background, THREE.SRGBColorSpace), 1);
  document.body.appendChild(made.domElement);
  return made;
}

export function camera(request) {
  const made = new THREE.PerspectiveCamera(2 * Math.atan(request.height / 2 / request.fy) * 180 / Math.PI, request.width / request.height, 0.05, 500);
  made.projectionMatrix.fromArray(projection(request));
  made.projectionMatrixInverse.copy(made.projectionMatrix).invert();
  made.updateProjectionMatrix = () => {};
  const world = new THREE.Matrix4().fromArray(view(request)).invert();
  world.decompose(made.position, made.quaternion, made.scale);
  made.updateMatrixWorld(true);
  return made;
}
