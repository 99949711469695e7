// The matrices of a request in WebGL's axes: x right, y up, z towards the viewer; column-major, as WebGL has them.
export const NEAR = 0.05, FAR = 500;

export function view(request) {  // OpenCV's y and z are reversed
  const m = request.cam_from_world, sign = [1, -1, -1, 1], out = new Float32Array(16);
  for (let row = 0; row < 4; row++) for (let column = 0; column < 4; column++) out[4 * column + row] = sign[row] * m[row][column];
  return out;
}

export function projection({fx, fy, cx, cy, width, height}) {
  return new Float32Array([
    2 * fx / width, 0, 0, 0,
    0, 2 * fy / height, 0, 0,
    1 - 2 * cx / width, 2 * cy / height - 1, (FAR + NEAR) / (NEAR - FAR), -1,
    0, 0, 2 * FAR * NEAR / (NEAR - FAR), 0,
  ]);
}

export function pixels(gl, {width, height}) {
  const bytes = new Uint8Array(4 * width * height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return bytes;
}

export const later = seconds => new Promise(resolve => setTimeout(resolve, 1000 * seconds));
