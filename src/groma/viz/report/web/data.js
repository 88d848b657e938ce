// ------------------------------------------------------------------ data.js: what Python wrote, as typed arrays
// Things are told apart by their kind (line, point, plane, camera, direction) and their place among those in the page.
const data = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);

function bytes(text) {
  const raw = atob(text || ""), found = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) found[i] = raw.charCodeAt(i);
  return found;
}
const f32 = text => new Float32Array(bytes(text).buffer);
const i32 = text => new Int32Array(bytes(text).buffer);

const states = data.states.map(s => ({
  points: f32(s.points), errors: f32(s.errors), lines: f32(s.lines), lineErrors: f32(s.line_errors),
  planes: f32(s.planes), cameras: f32(s.cameras), junctions: f32(s.junctions),
}));
const both = states.length === 2, last = states.length - 1, now = states[last];

const points = { ids: i32(data.points.ids), images: i32(data.points.images), colours: bytes(data.points.colours) };
const lines = {
  ids: i32(data.lines.ids), images: i32(data.lines.images), lengths: f32(data.lines.lengths),
  confidence: f32(data.lines.confidence), direction: i32(data.lines.direction),
  colours: bytes(data.lines.colours), shared: bytes(data.lines.shared_colours),
};
const planes = { ids: i32(data.planes.ids), corners: data.planes.corners, colours: data.planes.colours, areas: data.planes.areas };
planes.first = planes.corners.map((_, i) => planes.corners.slice(0, i).reduce((a, b) => a + b, 0));
const cameras = { names: data.cameras.names, aspects: f32(data.cameras.aspects) };
const directions = { ids: i32(data.directions.ids) };
const junctionLines = i32(data.junctions); // the two lines of each
const pieceLine = i32(data.pieces); // the line of each drawn piece

const rows = f32(data.rows), rowPoint = i32(data.row_points), rowStep = 2 + 2 * states.length;
const segments = f32(data.segments), segmentLine = i32(data.segment_lines), segmentStep = 4 + 4 * states.length;
const projected = f32(data.projected), samples = data.samples;

// ------------------------------------------------------------------ who belongs to whom
// Lists by owner: of(i) are the items whose owner is i.
function grouped(owners, count, items) {
  const start = new Int32Array(count + 1), at = new Int32Array(count), list = new Int32Array(owners.length);
  for (const owner of owners) if (owner >= 0) start[owner + 1]++;
  for (let i = 0; i < count; i++) start[i + 1] += start[i];
  owners.forEach((owner, i) => { if (owner >= 0) list[start[owner] + at[owner]++] = items ? items[i] : i; });
  return i => list.subarray(start[i], start[i + 1]);
}
function pairs(text, firsts, seconds) {
  const flat = i32(text), first = flat.filter((_, i) => i % 2 === 0), second = flat.filter((_, i) => i % 2 === 1);
  return [grouped(second, seconds, first), grouped(first, firsts, second)];
}
const [linesOnPlane, planesOfLine] = pairs(data.relations.line_on_plane, lines.ids.length, planes.ids.length);
const [pointsOnPlane, planesOfPoint] = pairs(data.relations.point_on_plane, points.ids.length, planes.ids.length);
const [pointsOnLine, linesOfPoint] = pairs(data.relations.point_on_line, points.ids.length, lines.ids.length);
const junctionsOf = grouped(junctionLines, lines.ids.length, junctionLines.map((_, i) => i >> 1));
const linesAlong = grouped(lines.direction, directions.ids.length);
const piecesOf = grouped(pieceLine, lines.ids.length);
const segmentsOf = grouped(segmentLine, lines.ids.length), rowsOf = grouped(rowPoint, points.ids.length);

// The entry (photograph) of each row and segment, and of each camera; -1 where nothing was measured.
const entryOfSegment = new Int32Array(segmentLine.length), entryOfRow = new Int32Array(rowPoint.length);
const entryOfCamera = new Int32Array(cameras.names.length).fill(-1);
data.images.forEach((entry, i) => {
  entryOfSegment.fill(i, ...entry.segments); entryOfRow.fill(i, ...entry.rows); entryOfCamera[entry.camera] = i;
});

// ------------------------------------------------------------------ numbers
const number = x => !isFinite(x) ? "–" : Math.abs(x) >= 1e5 || (x !== 0 && Math.abs(x) < 1e-3) ? x.toExponential(2) : String(+x.toPrecision(4));
const counted = (n, word) => n.toLocaleString("en") + " " + word + (n === 1 ? "" : "s");
// Root mean square distance of the two ends of a segment from the image of its line, in a state.
function segmentDeviation(segment, state) {
  const k = segment * segmentStep + 4 + 4 * state;
  let sum = 0;
  for (let i = 0; i < 4; i++) sum += segments[k + i] ** 2;
  return Math.sqrt(sum / 2);
}
const rowDeviation = (row, state) => Math.hypot(rows[row * rowStep + 2 + 2 * state], rows[row * rowStep + 3 + 2 * state]);
const segmentLength = segment => {
  const k = segment * segmentStep;
  return Math.hypot(segments[k + 2] - segments[k], segments[k + 3] - segments[k + 1]);
};
function quantile(values, share) {
  const sorted = values.slice().sort();
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : 0;
}
