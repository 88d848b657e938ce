// ------------------------------------------------------------------ about.js: what is known of a thing, and finding it by name
const pixels = x => isFinite(x) && x > 0 ? number(+x.toPrecision(3)) + " px" : "–";
const change = (before, after) => both && Math.abs(before - after) > 5e-4 ? pixels(before) + " → " + pixels(after) : pixels(after);
function summary(thing) { // a line of text, for tips
  const { kind, index: i } = thing;
  if (kind === "line") return `line ${lines.ids[i]}: length ${number(lines.lengths[i])}, ${pixels(now.lineErrors[i])}, ${counted(lines.images[i], "image")}`;
  if (kind === "point") return `point ${points.ids[i]}: ${pixels(now.errors[i])}, ${counted(points.images[i], "image")}`;
  if (kind === "plane") return `plane ${planes.ids[i]}: area ${number(planes.areas[i])}, ${counted(linesOnPlane(i).length, "line")}, ${counted(pointsOnPlane(i).length, "point")}`;
  return nameOf(thing);
}
function element(name, content, more = {}) {
  const one = Object.assign(document.createElement(name), more);
  one.append(...[content].flat());
  return one;
}
const link = thing => element("button", nameOf(thing), { type: "button", className: "link", onclick: () => choose(thing, "link") });
function links(kind, list, most = 6) {
  const found = [...list].slice(0, most).flatMap((index, k) => k ? [", ", link({ kind, index })] : [link({ kind, index })]);
  return list.length > most ? [...found, ` and ${(list.length - most).toLocaleString("en")} more`] : found;
}
function gapAt(junction) { // twice the way from the place to the lines, which it is half-way between
  const { at, along } = lineOf(linesOfJunction(junction)[0]), way = minus(place("junctions", junction), at);
  return 2 * norm(plus(way, along, -dot(way, along)));
}
// Rows of a thing: name, and text or links; empty ones are left out.
function facts({ kind, index: i }) {
  if (kind === "line") return [
    ["Length", number(lines.lengths[i])], ["Residual", change(states[0].lineErrors[i], now.lineErrors[i]) + " rms"],
    ["Images", lines.images[i]], ["Confidence", lines.confidence[i] >= 0 ? number(+lines.confidence[i].toPrecision(3)) : ""],
    ["Direction", lines.direction[i] >= 0 ? link({ kind: "direction", index: lines.direction[i] }) : ""],
    ["On planes", links("plane", planesOfLine(i))], ["Points on it", links("point", pointsOnLine(i))], ["Meets", links("line", linesMet(i))],
    ["Standard deviation", lineSigma(i)],
  ];
  if (kind === "point") return [
    ["Residual", change(states[0].errors[i], now.errors[i]) + " rms"], ["Images", points.images[i]],
    ["On planes", links("plane", planesOfPoint(i))], ["On lines", links("line", linesOfPoint(i))],
    ["Position", place("points", i).map((x, k) => number(+(x + data.offset[k]).toPrecision(7))).join(", ")],
    ["Standard deviation", pointSigma("points", i)],
  ];
  if (kind === "plane") return [
    ["Area", number(planes.areas[i])], ["Lines on it", links("line", linesOnPlane(i))], ["Points on it", pointsOnPlane(i).length.toLocaleString("en")],
    ["Standard deviation", planeSigma(i)],
  ];
  if (kind === "junction") return [
    ["Lines", links("line", linesOfJunction(i))], ["Distance between them", number(gapAt(i))],
    ["Position", place("junctions", i).map((x, k) => number(+(x + data.offset[k]).toPrecision(7))).join(", ")],
  ];
  if (kind === "direction") return [["Lines along it", links("line", linesAlong(i), 12)]];
  const entry = data.images[entryOfCamera[i]];
  return [
    ["Residual", entry ? change(entry.median[0], entry.median[last]) + ", median" : ""], ["Lines seen", entry ? entry.lines_seen.toLocaleString("en") : "none"],
    ["Points seen", entry ? entry.points_seen.toLocaleString("en") : "none"], ["Standard deviation", pointSigma("centers", i)],
  ];
}
// The photographs that saw a line or point: deviation there, and for lines how long the segment is. Worst first.
function sightings({ kind, index }) {
  if (kind !== "line" && kind !== "point") return null;
  const found = kind === "line" ? [...segmentsOf(index)].map(s => [entryOfSegment[s], segmentDeviation(s, last), segmentLength(s)])
    : [...rowsOf(index)].map(r => [entryOfRow[r], rowDeviation(r, last), null]);
  found.sort((a, b) => b[1] - a[1]);
  const cell = text => element("td", text);
  const row = ([entry, far, long]) => element("tr", [
    cell(element("button", data.images[entry].name, { type: "button", className: "link", onclick: () => showImage(entry) })),
    cell(far.toFixed(2) + " px"), ...(long === null ? [] : [cell(long.toFixed(0) + " px long")]),
  ]);
  return found.length ? element("table", found.slice(0, 60).map(row)) : null;
}
function showAbout() {
  const box = $("about");
  if (measuring) { box.replaceChildren(...measureRows()); return; }
  if (!chosen) {
    box.replaceChildren(element("p", "Nothing is selected. Click a line, point, plane or camera in the scene, or a segment in a photograph."));
    return;
  }
  const list = facts(chosen).filter(([, value]) => value !== "" && value !== null && !(Array.isArray(value) && !value.length));
  const title = nameOf(chosen), first = chosen.kind === "camera" ? title[0] : title[0].toUpperCase(), table = sightings(chosen);
  box.replaceChildren(
    element("h3", [first + title.slice(1), element("button", "×", { type: "button", title: "Clear the selection (Esc)", onclick: () => choose(null) })]),
    element("dl", list.flatMap(([name, value]) => [element("dt", name), element("dd", typeof value === "number" ? String(value) : value)])), ...(table ? [table] : []),
  );
}
onChoice.push(showAbout);

// ------------------------------------------------------------------ search
const MOST_FOUND = 12, MOST_BEGUN = 8; // in all; of names that go on after what is typed
function search(text) {
  const words = text.trim().toLowerCase(), match = /^([a-z]*)\s*#?(-?\d*)$/.exec(words), found = [];
  if (!words) return found;
  const kinds = match ? [["line", lines], ["plane", planes], ["point", points], ["direction", directions]].filter(([kind]) => kind.startsWith(match[1])) : [];
  for (const [kind, table] of kinds) {
    const index = String(+match[2]) === match[2] ? table.ids.indexOf(+match[2]) : -1; // 0042 is part of a file name
    if (index >= 0) found.push({ kind, index });
  }
  if (match && match[1]) for (const [kind, table] of kinds)
    for (let index = 0; index < table.ids.length && found.length < MOST_BEGUN; index++) {
      const id = String(table.ids[index]);
      if (id.startsWith(match[2]) && id !== match[2]) found.push({ kind, index });
    }
  for (let index = 0; index < cameras.names.length && found.length < MOST_FOUND; index++)
    if (cameras.names[index].toLowerCase().includes(words)) found.push({ kind: "camera", index });
  return found;
}
function showFound() {
  const found = search($("search").value), asked = $("search").value.trim();
  $("found").hidden = !asked;
  const item = (thing, k) => element("li", element("button", summary(thing), { type: "button", onclick: () => takeFound(thing) }), { className: k ? "" : "first" });
  $("found").replaceChildren(...(found.length ? found.map(item) : [element("li", "Nothing has this name.")]));
  return found;
}
function takeFound(thing) {
  $("found").hidden = true; $("search").blur();
  const middle = middleOf(thing);
  if (middle) eye.pivot = middle;
  if (thing.kind === "line") eye.distance = Math.min(eye.distance, Math.max(5 * lines.lengths[thing.index], 0.05 * data.view.distance));
  choose(thing, "search");
}
$("search").addEventListener("input", showFound);
$("search").addEventListener("focus", showFound);
$("search").addEventListener("keydown", e => {
  const found = e.key === "Enter" ? showFound() : [];
  if (found.length) takeFound(found[0]);
  if (e.key === "Escape") { $("search").value = ""; $("found").hidden = true; }
});
document.addEventListener("pointerdown", e => { if (!e.target.closest(".search")) $("found").hidden = true; });
