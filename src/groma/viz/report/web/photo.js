// ------------------------------------------------------------------ photo.js: one photograph, with what was measured in it
const sheet = $("photo"), pictures = new Map(), layers = { photo: true, points: !segments.length, segments: true, projected: true };
const anyPhoto = data.images.some(entry => entry.photo), segmentTop = data.view.line_error_top;
let current = data.first, zoom = { scale: 1, x: 0, y: 0 }, page = null; // page: from pixels of the photograph to those of the canvas
const photoState = () => both && blend < 0.5 ? 0 : last;

function showImage(index) {
  if (!data.images.length) return;
  current = (index + data.images.length) % data.images.length;
  $("image").value = current;
  zoom = { scale: 1, x: 0, y: 0 }; sheet.style.touchAction = "pan-y";
  drawImage(); markCurrent();
}
function pictureOf(index) { // decoded when it is first looked at
  const entry = data.images[index];
  if (!entry.photo) return null;
  if (!pictures.has(index)) { const one = new Image(); one.onload = drawImage; one.src = entry.photo; pictures.set(index, one); }
  const one = pictures.get(index);
  return one.complete && one.naturalWidth ? one : null;
}
// From pixels of a photograph, turned upright about its middle, to a canvas on which the middle is at x, y.
function upright(entry, scale, x, y) {
  const [left, top, width, height] = entry.frame, [a, b] = [[1, 0], [0, 1], [-1, 0], [0, -1]][entry.turn].map(part => scale * part);
  const u0 = left + width / 2, v0 = top + height / 2;
  return {
    at: (u, v) => [a * (u - u0) - b * (v - v0) + x, b * (u - u0) + a * (v - v0) + y],
    draw: (c, picture) => { c.setTransform(a, b, -b, a, x, y); c.drawImage(picture, -width / 2, -height / 2, width, height); c.resetTransform(); },
  };
}
const uprightSize = entry => entry.turn % 2 ? [entry.frame[3], entry.frame[2]] : entry.frame.slice(2);
// Strokes of segments (measured), and of the images of the 3D segments.
function traceSegment(c, i, at) {
  const k = i * segmentStep;
  c.moveTo(...at(segments[k], segments[k + 1])); c.lineTo(...at(segments[k + 2], segments[k + 3]));
}
function traceProjected(c, i, at, state) {
  const k = i * 2 * samples, m = i * segmentStep, w = m + 4 + 4 * state;
  if (state !== last) { // before: where the measured ends are to go
    c.moveTo(...at(segments[m] + segments[w], segments[m + 1] + segments[w + 1]));
    c.lineTo(...at(segments[m + 2] + segments[w + 2], segments[m + 3] + segments[w + 3]));
  } else if (projected[k] || projected[k + 1] || projected[k + 2]) {
    for (let j = 0; j < samples; j++) c[j ? "lineTo" : "moveTo"](...at(projected[k + 2 * j], projected[k + 2 * j + 1]));
  }
}
// The chosen thing in a photograph: its segments and points.
function litIn(index) {
  const entry = data.images[index], wantedLines = new Set(lit.lines), wantedPoints = new Set(lit.points), found = { segments: [], rows: [] };
  if (!chosen || chosen.kind === "camera") return found; // of a camera everything is lit
  for (let i = entry.segments[0]; i < entry.segments[1]; i++) if (wantedLines.has(segmentLine[i])) found.segments.push(i);
  for (let i = entry.rows[0]; i < entry.rows[1]; i++) if (wantedPoints.has(rowPoint[i])) found.rows.push(i);
  return found;
}
function drawLit(c, index, at, width) {
  const { segments: own, rows: dots } = litIn(index), small = dots.length > 40 ? 0.5 : 1; // many must not hide the photograph
  for (const [colour, wide] of [["#000000b0", 2.2 * width], [colourOf("chosen"), width]]) {
    c.strokeStyle = c.fillStyle = colour; c.lineWidth = wide; c.beginPath();
    for (const i of own) traceSegment(c, i, at);
    c.stroke();
    for (const i of dots) { c.beginPath(); c.arc(...at(rows[i * rowStep], rows[i * rowStep + 1]), small * (0.8 * wide + 0.6 * width), 0, 7); c.fill(); }
  }
  return own.length + dots.length;
}
function drawImage() {
  if (!data.images.length) return;
  const entry = data.images[current], [width, height] = uprightSize(entry), gain = +$("gain").value, s = photoState();
  const ratio = Math.min(devicePixelRatio || 1, 2), wide = Math.max(300, Math.round((sheet.parentElement.clientWidth || 600) * ratio));
  const high = Math.min(Math.round(wide * height / width), Math.round(640 * ratio));
  if (sheet.width !== wide || sheet.height !== high) { sheet.width = wide; sheet.height = high; }
  const c = sheet.getContext("2d"), fit = Math.min(1, high / (wide * height / width)), scale = wide / width * fit * zoom.scale;
  const shift = [(wide - width * scale / zoom.scale) / 2 + zoom.x, zoom.y];
  const { at, draw } = upright(entry, scale, shift[0] + width * scale / 2, shift[1] + height * scale / 2);
  page = { at, shift, ratio };
  const dark = !!entry.photo, picture = layers.photo ? pictureOf(current) : null; // without a photograph the ground is that of the page
  c.fillStyle = dark ? "#26292e" : colourOf("view"); c.fillRect(0, 0, wide, high);
  if (picture) { c.globalAlpha = 0.85; draw(c, picture); c.globalAlpha = 1; }
  c.lineCap = "round"; c.globalAlpha = chosen && chosen.kind !== "camera" ? 0.25 : 1;
  if (layers.projected) {
    c.strokeStyle = dark ? "#ffffffd0" : colourOf("soft"); c.lineWidth = ratio; c.beginPath();
    for (let i = entry.segments[0]; i < entry.segments[1]; i++) traceProjected(c, i, at, s);
    c.stroke();
  }
  if (layers.segments) drawSegments(c, entry, at, s, 2 * ratio);
  if (layers.points) drawResiduals(c, entry, at, s, gain, ratio, dark);
  c.globalAlpha = 1;
  drawLit(c, current, at, 3 * ratio);
  if (pointed && pointed.kind === "line") {
    c.strokeStyle = colourOf("chosen"); c.lineWidth = 3.5 * ratio; c.beginPath();
    for (const i of segmentsOf(pointed.index)) if (entryOfSegment[i] === current) traceSegment(c, i, at);
    c.stroke();
  }
  if (pointed && pointed.kind === "point") for (const i of rowsOf(pointed.index)) if (entryOfRow[i] === current) {
    c.strokeStyle = colourOf("chosen"); c.lineWidth = 2 * ratio; c.beginPath(); c.arc(...at(rows[i * rowStep], rows[i * rowStep + 1]), 6 * ratio, 0, 7); c.stroke();
  }
  const parts = [[entry.lines_seen, "segment"], [entry.points_seen, "point"]].filter(p => p[0]).map(p => counted(...p));
  $("image-title").textContent = [...parts, entry.median[s].toPrecision(3) + " px median residual"].join(", ") + (entry.photo || !anyPhoto ? "." : " (no photograph in the page).");
}
function drawSegments(c, entry, at, state, width) {
  const order = Array.from({ length: entry.segments[1] - entry.segments[0] }, (_, i) => entry.segments[0] + i);
  order.sort((a, b) => segmentDeviation(a, state) - segmentDeviation(b, state)); // the worst on top
  c.lineWidth = width;
  for (const i of order) { c.strokeStyle = css(onRamp(segmentDeviation(i, state) / segmentTop)); c.beginPath(); traceSegment(c, i, at); c.stroke(); }
}
function drawResiduals(c, entry, at, state, gain, ratio, dark) {
  c.lineWidth = 1.3 * ratio; c.strokeStyle = c.fillStyle = dark ? (both && state === 0 ? "#ffb27a" : "#7cc4ff") : colourOf(both && state === 0 ? "before" : "after"); c.beginPath();
  for (let i = entry.rows[0]; i < entry.rows[1]; i++) {
    const k = i * rowStep, w = k + 2 + 2 * state, [u, v] = at(rows[k], rows[k + 1]);
    c.fillRect(u - ratio, v - ratio, 2 * ratio, 2 * ratio);
    c.moveTo(u, v); c.lineTo(...at(rows[k] + gain * rows[w], rows[k + 1] + gain * rows[w + 1]));
  }
  c.stroke();
}
// The photograph that shows a thing best: the longest segments, then the most points; one with a photograph first.
function bestImage() {
  const value = new Map(lit.entries.map(i => [i, data.images[i].photo ? 1e9 : 0]));
  for (const line of lit.lines) for (const i of segmentsOf(line)) if (value.has(entryOfSegment[i])) value.set(entryOfSegment[i], value.get(entryOfSegment[i]) + segmentLength(i));
  for (const point of lit.points) for (const i of rowsOf(point)) if (value.has(entryOfRow[i])) value.set(entryOfRow[i], value.get(entryOfRow[i]) + 1e-3);
  return [...value].reduce((best, one) => one[1] > best[1] ? one : best, [-1, -1])[0];
}
onChoice.push(from => {
  const best = from === "photo" || (lit.entries.includes(current) && chosen.kind !== "camera" && data.images[current].photo) ? -1 : bestImage();
  if (best >= 0) showImage(best); else drawImage();
});
onPointed.push(drawImage);

// ------------------------------------------------------------------ hands
const touching = new Map();
let drawn = 0;
const spot = e => { const box = sheet.getBoundingClientRect(), f = sheet.width / box.width; return [(e.clientX - box.left) * f, (e.clientY - box.top) * f]; };
function magnify([x, y], f) { // about a place of the canvas; 0: all of it
  const old = zoom.scale;
  zoom.scale = Math.max(1, Math.min(60, old * f));
  const g = zoom.scale / old, base = page.shift[0] - zoom.x;
  zoom.x = (x - base) - g * (x - base - zoom.x); zoom.y = y - g * (y - zoom.y);
  if (zoom.scale === 1) zoom.x = zoom.y = 0;
  sheet.style.touchAction = zoom.scale > 1 ? "none" : "pan-y"; // the whole photograph lets the page scroll
  drawImage();
}
// The segment, or the point, at a place of the canvas.
function found([x, y], reach) {
  const entry = data.images[current];
  let best = reach, thing = null;
  if (layers.segments) for (let i = entry.segments[0]; i < entry.segments[1]; i++) {
    const k = i * segmentStep, [far] = toSegment(x, y, page.at(segments[k], segments[k + 1]), page.at(segments[k + 2], segments[k + 3]));
    if (far < best) { best = far; thing = { kind: "line", index: segmentLine[i], segment: i }; }
  }
  if (layers.points) for (let i = entry.rows[0]; i < entry.rows[1]; i++) {
    const [u, v] = page.at(rows[i * rowStep], rows[i * rowStep + 1]), far = Math.hypot(x - u, y - v);
    if (far < best) { best = far; thing = { kind: "point", index: rowPoint[i], row: i }; }
  }
  return thing;
}
const tipOf = thing => thing.kind === "line" ? `line ${lines.ids[thing.index]}: ${segmentDeviation(thing.segment, photoState()).toFixed(2)} px, ${segmentLength(thing.segment).toFixed(0)} px long, ${counted(lines.images[thing.index], "image")}`
  : `point ${points.ids[thing.index]}: ${rowDeviation(thing.row, photoState()).toFixed(2)} px, ${counted(points.images[thing.index], "image")}`;
sheet.addEventListener("wheel", e => { if (!wanted(e, sheet)) return; e.preventDefault(); magnify(spot(e), Math.exp(-1.2 * wheelStep(e))); }, { passive: false });
sheet.addEventListener("dblclick", e => magnify(spot(e), zoom.scale > 1 ? 0 : 3));
sheet.addEventListener("pointerdown", e => { touching.set(e.pointerId, spot(e)); drawn = touching.size > 1 ? Infinity : 0; sheet.setPointerCapture(e.pointerId); });
sheet.addEventListener("pointerup", e => {
  if (touching.delete(e.pointerId) && drawn < 10 && e.button === 0) choose(found(spot(e), reachOf(e)), "photo");
});
sheet.addEventListener("pointercancel", e => touching.delete(e.pointerId));
sheet.addEventListener("pointerleave", () => { $("tip").hidden = true; pointAt(null); });
sheet.addEventListener("pointermove", e => {
  const [x, y] = spot(e), tip = $("tip"), was = touching.get(e.pointerId);
  if (was) {
    touching.set(e.pointerId, [x, y]); drawn += Math.hypot(x - was[0], y - was[1]);
    const other = [...touching].find(([id]) => id !== e.pointerId);
    if (other) magnify(other[1], Math.hypot(x - other[1][0], y - other[1][1]) / Math.max(1, Math.hypot(was[0] - other[1][0], was[1] - other[1][1])));
    else if (zoom.scale > 1) { zoom.x += x - was[0]; zoom.y += y - was[1]; drawImage(); }
    return;
  }
  if (!page) return;
  const thing = found([x, y], reachOf(e)), box = sheet.getBoundingClientRect();
  pointAt(thing);
  tip.hidden = !thing;
  if (!thing) return;
  tip.textContent = tipOf(thing);
  tip.style.left = Math.max(4, Math.min(e.clientX - box.left + 14, box.width - tip.offsetWidth - 6)) + "px";
  tip.style.top = Math.max(4, e.clientY - box.top - 34) + "px";
});
sheet.addEventListener("keydown", e => {
  if (e.altKey || e.ctrlKey || e.metaKey) return;
  const middle = [sheet.width / 2, sheet.height / 2], zooms = { "+": 1.25, "=": 1.25, "-": 0.8, "0": 0 };
  if (e.key === "ArrowLeft") showImage(current - 1);
  else if (e.key === "ArrowRight") showImage(current + 1);
  else if (e.key in zooms) magnify(middle, zooms[e.key]);
  else return;
  e.preventDefault();
});
