// ------------------------------------------------------------------ things.js: where things are, in the state that is shown
let blend = last; // 0 before, 1 after, between while it glides
const mixed = (name, i) => {
  const b = now[name][i];
  return both && blend !== 1 ? states[0][name][i] * (1 - blend) + b * blend : b;
};
const place = (name, i) => [mixed(name, 3 * i), mixed(name, 3 * i + 1), mixed(name, 3 * i + 2)];
const pieceEnds = i => [place("lines", 2 * i), place("lines", 2 * i + 1)];
const planeCorners = i => Array.from({ length: planes.corners[i] }, (_, k) => place("planes", planes.first[i] + k));
const linesOfJunction = i => [junctionLines[2 * i], junctionLines[2 * i + 1]];
const linesMet = line => [...junctionsOf(line)].flatMap(linesOfJunction).filter(other => other !== line);
const cameraCenter = i => place("cameras", 4 * i);

// The eight strokes of a camera, as pairs of places.
function frustum(i, get = place) {
  const center = get("cameras", 4 * i), [x, y, z] = [1, 2, 3].map(k => get("cameras", 4 * i + k));
  const size = data.view.camera_size, half = 0.8 * size, down = half / Math.max(cameras.aspects[i], 0.2);
  const corner = (a, b) => plus(plus(plus(center, x, a * half), y, b * down), z, 1.3 * size);
  const q = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
  return [...q.map((p, k) => [p, q[(k + 1) % 4]]), ...q.map(p => [center, p])];
}
// The line through a thing of kind line: a place and a unit direction; planes: a place and the normal.
function lineOf(i) {
  const own = piecesOf(i), a = place("lines", 2 * own[0]), b = place("lines", 2 * own[own.length - 1] + 1);
  return { at: a, along: unit(minus(b, a)), middle: times(plus(a, b), 0.5) };
}
function planeOf(i) {
  const corners = planeCorners(i);
  let normal = [0, 0, 0];
  for (let k = 2; k < corners.length; k++) normal = plus(normal, cross(minus(corners[k - 1], corners[0]), minus(corners[k], corners[0])));
  return { at: times(corners.reduce((a, b) => plus(a, b)), 1 / corners.length), normal: unit(normal) };
}
function middleOf({ kind, index }) {
  if (kind === "line") return lineOf(index).middle;
  if (kind === "point") return place("points", index);
  if (kind === "plane") return planeOf(index).at;
  if (kind === "camera") return cameraCenter(index);
  if (kind === "junction") return place("junctions", index);
  return null;
}
function nameOf({ kind, index }) {
  if (kind === "camera") return cameras.names[index];
  if (kind === "junction") return "junction of lines " + linesOfJunction(index).map(i => lines.ids[i]).join(" and ");
  return kind + " " + { line: lines, point: points, plane: planes, direction: directions }[kind].ids[index];
}

// What lights up with a thing: places among lines, points, planes, cameras; and photographs (entries).
function litBy(thing) {
  const lit = { lines: [], points: [], planes: [], cameras: [], entries: [] };
  if (!thing) return lit;
  const { kind, index } = thing, entries = new Set();
  if (kind === "line") { lit.lines = [index]; lit.points = [...pointsOnLine(index)]; }
  if (kind === "point") lit.points = [index];
  if (kind === "plane") { lit.planes = [index]; lit.lines = [...linesOnPlane(index)]; lit.points = [...pointsOnPlane(index)]; }
  if (kind === "junction") lit.lines = linesOfJunction(index);
  if (kind === "direction") lit.lines = [...linesAlong(index)];
  if (kind === "camera") {
    lit.cameras = [index];
    const entry = data.images[entryOfCamera[index]];
    if (!entry) return lit;
    lit.lines = [...new Set(segmentLine.subarray(...entry.segments))]; lit.points = [...new Set(rowPoint.subarray(...entry.rows))];
    lit.entries = [entryOfCamera[index]];
    return lit;
  }
  for (const line of lit.lines) for (const segment of segmentsOf(line)) entries.add(entryOfSegment[segment]);
  if (kind !== "line") for (const point of lit.points) for (const row of rowsOf(point)) entries.add(entryOfRow[row]);
  lit.entries = [...entries].sort((a, b) => a - b);
  if (kind === "line" || kind === "point") lit.cameras = lit.entries.map(i => data.images[i].camera);
  return lit;
}

// ------------------------------------------------------------------ the chosen thing; parts of the page ask to be told
let chosen = null, lit = litBy(null), pointed = null;
const onChoice = [], onPointed = [];
const same = (a, b) => a === b || (a && b && a.kind === b.kind && a.index === b.index);
function choose(thing, from = "") {
  chosen = thing; lit = litBy(thing);
  for (const tell of onChoice) tell(from);
}
function pointAt(thing) { // hovering
  if (same(thing, pointed)) return;
  pointed = thing;
  for (const tell of onPointed) tell();
}
