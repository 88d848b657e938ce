// ------------------------------------------------------------------ scene.js: the 3D view: what is drawn, what is hit, what hands do
const canvas = $("scene"), marks = $("marks"), ink = marks.getContext("2d");
const noWebgl = location.hash.includes("canvas"); // for tests and for graphics drivers that misbehave
const renderer = (noWebgl ? null : webglRenderer(canvas)) || flatRenderer(canvas);
const shown = { points: true, lines: true, planes: true, cameras: true, junctions: false };
let ratio = 1, view = viewOf(1, 1), pending = false, painted = -1;
// While the view moves, only as many points and lines are drawn as there is time for; all of them once it rests. What was
// too much for a frame is tried again slowly, so that not every other frame is late. A frame is late if it came long after it
// was asked for, while the view moves, and only two in turn tell that all is too much: a page that loads makes frames wait, too.
const FRAME = 1000 / 60, SLOW = 1.3 * FRAME, LEAST = 0.02, REST = 180; // milliseconds
let share = 1, roof = 1, awaited = 0, lastFrame = 0, wasLate = false, rest = 0;

function draw() { if (!pending) { pending = true; awaited = performance.now(); requestAnimationFrame(frame); } }
function frame(time) {
  pending = false;
  const moves = awaited < lastFrame + FRAME, took = time - Math.max(awaited, lastFrame), isLate = moves && took > SLOW;
  if (isLate && (wasLate || share < 1)) {
    roof = Math.max(LEAST, 0.9 * share);
    share = Math.max(LEAST, share * Math.max(0.3, 0.9 * FRAME / took));
  } else if (!isLate) {
    roof = Math.min(1, 1.01 * roof);
    share = Math.min(roof, 1.1 * share);
  }
  [lastFrame, wasLate] = [time, isLate];
  paint(share);
  clearTimeout(rest);
  if (share < 1) rest = setTimeout(paint, REST);
}
function paint(share = 1) {
  ratio = Math.min(devicePixelRatio || 1, 2);
  const w = Math.max(1, Math.round(canvas.clientWidth * ratio)), h = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== w || canvas.height !== h) { canvas.width = marks.width = w; canvas.height = marks.height = h; }
  view = viewOf(w, h);
  renderer.paint(view, { shown, ratio, pointSize: Math.max(1, $("size").value * ratio * 0.8), dim: chosen ? 0.4 : 1, share });
  paintMarks();
}
function recolour() {
  const state = both && blend < 0.5 ? 0 : last;
  painted = state;
  renderer.colour(pointColours($("colour").value, state), pieceColours($("line-colour").value, state));
  const bars = legends($("colour").value, $("line-colour").value, shown);
  $("legend").hidden = !bars.length;
  $("legend").replaceChildren(...bars.flatMap(([name, low, high]) => [span(name + " " + low), Object.assign(span(""), { className: "ramp" }), span(high)]));
  draw();
}
const span = text => Object.assign(document.createElement("span"), { textContent: text });

// Over the scene: rays to the cameras that see the chosen thing, what the mouse points at, what was measured.
let marked = false; // clearing what is empty would have the browser compose the page anew
function paintMarks() {
  if (marked) ink.clearRect(0, 0, marks.width, marks.height);
  marked = !!(chosen || pointed || picks.length || shown.junctions);
  const middle = chosen && (chosen.kind === "line" || chosen.kind === "point") && view.project(...middleOf(chosen));
  if (middle) {
    ink.strokeStyle = colourOf("chosen"); ink.globalAlpha = 0.45; ink.lineWidth = ratio; ink.beginPath();
    for (const camera of lit.cameras) { const c = view.project(...cameraCenter(camera)); if (c) { ink.moveTo(c[0], c[1]); ink.lineTo(middle[0], middle[1]); } }
    ink.stroke(); ink.globalAlpha = 1;
  }
  if (shown.junctions) for (let i = 0; i < junctionLines.length / 2; i++) diamond(i, 4);
  if (chosen && chosen.kind === "junction") diamond(chosen.index, 7);
  if (pointed && !same(pointed, chosen)) outline(pointed);
  paintMeasure(ink, view, ratio);
}
function diamond(junction, size) {
  const p = view.project(...place("junctions", junction)), r = size * ratio;
  if (!p) return;
  ink.strokeStyle = colourOf(size > 4 ? "chosen" : "ink"); ink.lineWidth = 1.5 * ratio; ink.beginPath();
  ink.moveTo(p[0] - r, p[1]); ink.lineTo(p[0], p[1] - r); ink.lineTo(p[0] + r, p[1]); ink.lineTo(p[0], p[1] + r); ink.closePath(); ink.stroke();
}
function outline({ kind, index }) {
  ink.strokeStyle = colourOf("chosen"); ink.lineWidth = 3 * ratio; ink.lineCap = "round"; ink.beginPath();
  const stroke = (a, b) => { const p = view.project(...a), q = view.project(...b); if (p && q) { ink.moveTo(p[0], p[1]); ink.lineTo(q[0], q[1]); } };
  if (kind === "line") for (const piece of piecesOf(index)) stroke(...pieceEnds(piece));
  if (kind === "camera") for (const ends of frustum(index)) stroke(...ends);
  if (kind === "plane") planeCorners(index).forEach((corner, k, all) => stroke(corner, all[(k + 1) % all.length]));
  if (kind === "point") { const p = view.project(...place("points", index)); if (p) ink.arc(p[0], p[1], 5 * ratio, 0, 7); }
  if (kind === "junction") { diamond(index, 7); return; }
  ink.stroke();
}

// ------------------------------------------------------------------ hits
function toSegment(x, y, a, b) { // distance of a pixel from a segment, and the share along it
  const dx = b[0] - a[0], dy = b[1] - a[1], f = Math.max(0, Math.min(1, ((x - a[0]) * dx + (y - a[1]) * dy) / Math.max(dx * dx + dy * dy, 1e-9)));
  return [Math.hypot(x - a[0] - f * dx, y - a[1] - f * dy), f];
}
// The thing at a pixel of the canvas: of those within reach the nearest one, where what is in front has a lead.
function hit(x, y, reach) {
  let best = 1.6, found = null;
  const offer = (far, depth, kind, index) => {
    const score = far / reach + 0.5 * depth / (eye.distance * 2);
    if (far <= reach && score < best) { best = score; found = { kind, index }; }
  };
  if (shown.lines) for (let i = 0; i < pieceLine.length; i++) {
    const a = view.project(mixed("lines", 6 * i), mixed("lines", 6 * i + 1), mixed("lines", 6 * i + 2));
    const b = a && view.project(mixed("lines", 6 * i + 3), mixed("lines", 6 * i + 4), mixed("lines", 6 * i + 5));
    if (!b || Math.min(a[0], b[0]) > x + reach || Math.max(a[0], b[0]) < x - reach || Math.min(a[1], b[1]) > y + reach || Math.max(a[1], b[1]) < y - reach) continue;
    const [far, f] = toSegment(x, y, a, b);
    offer(far, a[2] + f * (b[2] - a[2]), "line", pieceLine[i]);
  }
  if (shown.points) for (let i = 0; i < points.ids.length; i++) {
    const p = view.project(mixed("points", 3 * i), mixed("points", 3 * i + 1), mixed("points", 3 * i + 2));
    if (p && Math.abs(p[0] - x) < reach && Math.abs(p[1] - y) < reach) offer(1.4 * Math.hypot(p[0] - x, p[1] - y), p[2], "point", i);
  }
  if (shown.junctions) for (let i = 0; i < junctionLines.length / 2; i++) { // before the ends of the lines, which are there too
    const p = view.project(...place("junctions", i));
    if (p && Math.hypot(p[0] - x, p[1] - y) < reach) offer(0.3 * Math.hypot(p[0] - x, p[1] - y) - 0.4 * reach, p[2], "junction", i);
  }
  if (shown.cameras) for (let i = 0; i < cameras.names.length; i++) {
    const c = view.project(...cameraCenter(i));
    const near = c && 3 * data.view.camera_size * view.focal / c[2] + reach;
    if (!c || Math.abs(c[0] - x) > near || Math.abs(c[1] - y) > near) continue;
    for (const [a, b] of frustum(i).map(ends => ends.map(end => view.project(...end)))) if (a && b) offer(toSegment(x, y, a, b)[0], c[2], "camera", i);
  }
  if (!found && shown.planes) {
    let nearest = Infinity;
    for (let i = 0; i < planes.corners.length; i++) {
      const at = onPlane(planeOf(i), x, y), flat = planeCorners(i).map(corner => view.project(...corner));
      if (!at || flat.some(p => !p)) continue;
      const depth = norm(minus(at, view.origin));
      if (inside(x, y, flat) && depth < nearest) { nearest = depth; found = { kind: "plane", index: i }; }
    }
  }
  return found;
}
function inside(x, y, polygon) {
  let within = false;
  polygon.forEach((a, i) => {
    const b = polygon[(i + 1) % polygon.length];
    if ((a[1] > y) !== (b[1] > y) && x < a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])) within = !within;
  });
  return within;
}
function onPlane({ at, normal }, x, y) { // where the ray of a pixel meets a plane, before the viewer
  const ray = view.ray(x, y), slope = dot(ray, normal);
  const far = dot(minus(at, view.origin), normal) / (slope || 1e-12);
  return far > 0 ? plus(view.origin, ray, far) : null;
}
// The place on a thing that a pixel means.
function placeOn({ kind, index }, x, y) {
  if (kind === "plane") return onPlane(planeOf(index), x, y) || planeOf(index).at;
  if (kind !== "line") return middleOf({ kind, index });
  let best = Infinity, found = middleOf({ kind, index });
  for (const piece of piecesOf(index)) {
    const ends = pieceEnds(piece), flat = ends.map(end => view.project(...end));
    if (!flat[0] || !flat[1]) continue;
    let [far, f] = toSegment(x, y, ...flat);
    for (const k of [0, 1]) if (Math.hypot(flat[k][0] - x, flat[k][1] - y) < 9 * ratio) f = k; // ends attract
    if (far >= best) continue;
    best = far;
    // In the picture, inverse depth runs evenly along a segment.
    const s = f * flat[0][2] / (f * flat[0][2] + (1 - f) * flat[1][2]);
    found = plus(ends[0], minus(ends[1], ends[0]), s);
  }
  return found;
}
const pixelOf = e => { const box = canvas.getBoundingClientRect(); return [(e.clientX - box.left) * ratio, (e.clientY - box.top) * ratio]; };
const reachOf = e => (e.pointerType === "touch" ? 18 : 8) * ratio;

// ------------------------------------------------------------------ hands
const fingers = new Map();
let travelled = 0, looked = false;
canvas.addEventListener("pointerdown", e => {
  canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]);
  travelled = fingers.size > 1 ? Infinity : 0;
});
canvas.addEventListener("pointerup", e => {
  if (fingers.delete(e.pointerId) && travelled < (e.pointerType === "touch" ? 10 : 5) && e.button === 0) click(e);
});
canvas.addEventListener("pointercancel", e => fingers.delete(e.pointerId));
canvas.addEventListener("pointerleave", () => { pointAt(null); });
canvas.addEventListener("pointermove", e => {
  const before = fingers.get(e.pointerId);
  if (!before) { if (e.pointerType !== "touch") hover(e); return; }
  const dx = e.clientX - before[0], dy = e.clientY - before[1], size = [canvas.clientWidth, canvas.clientHeight];
  travelled += Math.hypot(dx, dy);
  if (fingers.size === 2) {
    const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
    const was = Math.hypot(before[0] - other[0], before[1] - other[1]), is = Math.hypot(e.clientX - other[0], e.clientY - other[1]);
    if (is > 1) eye.distance *= was / is;
    moveEye(dx / 2, dy / 2, ...size);
  } else if (e.shiftKey || e.buttons & 6) moveEye(dx, dy, ...size);
  else turnEye(dx * 0.007, dy * 0.007);
  fingers.set(e.pointerId, [e.clientX, e.clientY]);
  draw();
});
function hover(e) { // at most once a frame
  if (looked) return;
  looked = true;
  requestAnimationFrame(() => {
    looked = false;
    const thing = hit(...pixelOf(e), reachOf(e)), tip = $("scene-tip"), box = canvas.getBoundingClientRect();
    pointAt(thing);
    tip.hidden = !thing;
    if (!thing) return;
    tip.textContent = summary(thing);
    tip.style.left = Math.max(4, Math.min(e.clientX - box.left + 14, box.width - tip.offsetWidth - 6)) + "px";
    tip.style.top = Math.max(4, e.clientY - box.top - 36) + "px";
  });
}
function click(e) {
  const [x, y] = pixelOf(e), thing = hit(x, y, reachOf(e));
  if (measuring) { if (thing) pick(thing, placeOn(thing, x, y)); } else choose(thing, "scene");
}
canvas.addEventListener("dblclick", e => {
  const [x, y] = pixelOf(e), thing = hit(x, y, reachOf(e));
  if (thing) eye.pivot = placeOn(thing, x, y); else startView();
  draw();
});
// The wheel scrolls the page until one asks for more: a click, or Ctrl.
const wanted = (e, element) => e.ctrlKey || document.activeElement === element;
const wheelStep = e => Math.max(-0.3, Math.min(0.3, e.deltaY * 0.0013));
canvas.addEventListener("wheel", e => { if (!wanted(e, canvas)) return; e.preventDefault(); eye.distance *= Math.exp(wheelStep(e)); draw(); }, { passive: false });
canvas.addEventListener("contextmenu", e => e.preventDefault());
canvas.addEventListener("keydown", e => {
  const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  if (e.altKey || e.ctrlKey || e.metaKey) return;
  if (way && e.shiftKey) moveEye(-40 * way[0], -40 * way[1], canvas.clientWidth, canvas.clientHeight);
  else if (way) turnEye(-0.12 * way[0], -0.12 * way[1]);
  else if (e.key === "+" || e.key === "=") eye.distance *= 0.85;
  else if (e.key === "-") eye.distance /= 0.85;
  else if (e.key === "0") startView();
  else return;
  e.preventDefault(); draw();
});
onChoice.push(from => {
  if (from === "search" || from === "link") pointAt(null); // what was under the mouse has moved away
  renderer.light(lit); draw();
});
onPointed.push(() => { if (!pointed) $("scene-tip").hidden = true; draw(); });
