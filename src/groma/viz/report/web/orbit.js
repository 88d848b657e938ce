// ------------------------------------------------------------------ orbit.js: the viewer turns about a pivot
let eye;
function startView() {
  const v = data.view;
  eye = { pivot: v.pivot.slice(), up: v.up, azimuth: v.azimuth, elevation: v.elevation, distance: v.distance };
}
startView();

// Axes of the viewer in the scene: right, up, back.
function eyeAxes() {
  const up = eye.up, first = unit(cross(Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], up)), second = cross(up, first);
  const ca = Math.cos(eye.azimuth), sa = Math.sin(eye.azimuth), ce = Math.cos(eye.elevation), se = Math.sin(eye.elevation);
  const back = plus(times(plus(times(first, ca), second, sa), ce), up, se), right = unit(cross(up, back));
  return { right, up: cross(back, right), back };
}
// The same focal length as groma.viz.framing supposes.
const focalOf = (w, h) => Math.min(1.1 * h, 0.6 * w);

// The view of a canvas of w by h pixels: project() gives x, y and depth of a place of the scene, or null behind.
function viewOf(w, h) {
  const { right, up, back } = eyeAxes(), focal = focalOf(w, h), origin = plus(eye.pivot, back, eye.distance);
  const near = eye.distance * 5e-3;
  const project = (x, y, z) => {
    x -= origin[0]; y -= origin[1]; z -= origin[2];
    const d = -(back[0] * x + back[1] * y + back[2] * z);
    if (!(d > near)) return null;
    const s = focal / d;
    return [w / 2 + s * (right[0] * x + right[1] * y + right[2] * z), h / 2 - s * (up[0] * x + up[1] * y + up[2] * z), d];
  };
  // Direction from the origin through a pixel.
  const ray = (u, v) => unit(plus(plus(times(right, (u - w / 2) / focal), up, (h / 2 - v) / focal), back, -1));
  // Clip coordinates of WebGL, by columns, without a far end.
  const sx = 2 * focal / w, sy = 2 * focal / h;
  const row = (axis, s) => [s * axis[0], s * axis[1], s * axis[2], -s * dot(axis, origin)];
  const deep = row(back, -1), rowsOfClip = [row(right, sx), row(up, sy), [deep[0], deep[1], deep[2], deep[3] - 2 * near], deep];
  const clip = new Float32Array(16);
  rowsOfClip.forEach((r, i) => r.forEach((x, j) => { clip[4 * j + i] = x; }));
  return { w, h, focal, origin, near, project, ray, clip, right, up, back };
}
function turnEye(dx, dy) {
  eye.azimuth -= dx; eye.elevation = Math.max(-1.55, Math.min(1.55, eye.elevation + dy));
}
function moveEye(dx, dy, w, h) { // pixels
  const { right, up } = eyeAxes(), s = eye.distance / focalOf(w, h);
  eye.pivot = plus(plus(eye.pivot, right, -s * dx), up, s * dy);
}
