// ------------------------------------------------------------------ measure.js: distances and angles between two picks
// Standard deviations need covariances in the page. They take the two things as independent, because the page holds no
// covariances between things: what two neighbours share (the datum, their cameras) makes the truth smaller.
let measuring = false, picks = [];
const covariances = data.covariances && {
  points: f32(data.covariances.points), lines: f32(data.covariances.lines), planes: f32(data.covariances.planes), centers: f32(data.covariances.centers),
};
const PARALLEL = Math.cos(5 * Math.PI / 180); // lines and planes closer than this have a distance of their own

// The standard deviation of a place on a thing along a unit vector; null where it is not known.
function variance({ kind, index, at }, along) {
  if (!covariances || kind === "junction") return null;
  if (kind === "point" || kind === "camera") {
    const found = symmetric(kind === "point" ? covariances.points : covariances.centers, index, 3);
    return found && quadratic(found, along);
  }
  if (kind === "line") {
    const found = symmetric(covariances.lines, index, 6);
    if (!found) return null;
    // x = d x m + s d, with s = x . d; what runs along the line says nothing.
    const { at: on, along: d } = lineOf(index), m = cross(on, d), s = dot(at, d), left = skew(d), right = skew(m);
    const jacobian = left.map((row, i) => [...row, ...right[i].map((x, j) => -x + (i === j ? s : 0))]);
    const across = plus(along, d, -dot(along, d));
    return quadratic(product(product(jacobian, found), transposed(jacobian)), across);
  }
  const found = symmetric(covariances.planes, index, 4);
  if (!found) return null;
  const { normal } = planeOf(index);
  return quadratic(found, [...at, 1]) * dot(normal, along) ** 2;
}
// The same of a direction: of a line's, or of a plane's normal.
function directionVariance({ kind, index }, along) {
  if (!covariances) return null;
  const found = kind === "line" ? symmetric(covariances.lines, index, 6) : symmetric(covariances.planes, index, 4);
  if (!found) return null;
  const block = kind === "line" ? found.slice(3).map(row => row.slice(3)) : found.slice(0, 3).map(row => row.slice(0, 3));
  return quadratic(block, along);
}
const together = (...variances) => variances.some(v => v === null) ? null : Math.sqrt(Math.max(variances.reduce((a, b) => a + b, 0), 0));
// A value and its standard deviation end at the same digit, the second of the deviation.
function withSigma(value, sigma, suffix = "") {
  if (sigma === null) return number(value) + suffix;
  const two = +sigma.toPrecision(2), places = Math.max(0, 1 - Math.floor(Math.log10(two)));
  const text = two >= 1e-9 && two < 1e5 ? x => x.toFixed(places) : number;
  return `${text(value)} ± ${text(two)}${suffix}`;
}

function pointSigma(name, i) {
  const found = covariances && symmetric(covariances[name], i, 3);
  return found ? [0, 1, 2].map(k => number(+Math.sqrt(Math.max(found[k][k], 0)).toPrecision(2))).join(", ") : "";
}
function lineSigma(i) {
  const { middle, along } = lineOf(i), first = unit(cross(Math.abs(along[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0], along)), second = cross(along, first);
  const thing = { kind: "line", index: i, at: middle };
  const aside = together(variance(thing, first), variance(thing, second)), turn = together(directionVariance(thing, first), directionVariance(thing, second));
  return aside === null ? "" : `${number(+aside.toPrecision(2))} across, ${number(+(turn * 180 / Math.PI).toPrecision(2))}°`;
}
function planeSigma(i) {
  const { at, normal } = planeOf(i), far = together(variance({ kind: "plane", index: i, at }, normal));
  return far === null ? "" : number(+far.toPrecision(2)) + " along its normal";
}

// Rows of what two picks have between them: name, value with standard deviation.
function measured([a, b]) {
  const way = minus(b.at, a.at), far = norm(way), along = unit(way), found = [];
  found.push(["Distance of the picks", withSigma(far, far ? together(variance(a, along), variance(b, along)) : null)]);
  const axisOf = thing => thing.kind === "line" ? lineOf(thing.index).along : thing.kind === "plane" ? planeOf(thing.index).normal : null;
  const [first, second] = [axisOf(a), axisOf(b)], mixedKinds = a.kind !== b.kind;
  let parallel = true;
  if (first && second) {
    const cosine = Math.min(1, Math.abs(dot(first, second))), sine = Math.sqrt(1 - cosine * cosine);
    const turned = unit(plus(second, first, -dot(first, second))), other = unit(plus(first, second, -dot(first, second)));
    const sigma = sine > 1e-6 ? together(directionVariance(a, turned), directionVariance(b, other)) : null;
    const degrees = Math.acos(cosine) * 180 / Math.PI;
    found.push(["Angle", withSigma(mixedKinds ? 90 - degrees : degrees, sigma === null ? null : sigma * 180 / Math.PI, "°")]);
    parallel = mixedKinds ? sine > PARALLEL : cosine > PARALLEL;
  }
  // From a place to a line or plane; between two of them where they are nearly parallel.
  const [target, from] = second && !(first && a.kind === "plane" && b.kind === "line") ? [b, a] : [a, b];
  if (axisOf(target) && parallel) {
    const axis = axisOf(target), to = minus(target.at, from.at);
    const straight = target.kind === "plane" ? times(axis, dot(to, axis)) : plus(to, axis, -dot(to, axis));
    const foot = { ...target, at: plus(from.at, straight) }, off = unit(straight);
    found.push([`${nameOf(from)} to ${nameOf(target)}, perpendicular`, withSigma(norm(straight), norm(straight) ? together(variance(from, off), variance(foot, off)) : null)]);
  }
  return found;
}
function measureRows() {
  const said = picks.length === 0 ? "Click a point, a line (its ends attract), a plane or a camera in the scene." : picks.length === 1 ? "Click a second one." : "";
  const names = picks.map((thing, k) => [k ? "To" : "From", nameOf(thing)]);
  const values = picks.length === 2 ? measured(picks) : [];
  const units = values.length ? [element("p", "Lengths in scene units." + (covariances ? " ±: one standard deviation, the two taken as independent." : ""))] : [];
  return [
    element("h3", ["Measure", element("button", "×", { type: "button", title: "End (Esc)", onclick: () => setMeasuring(false) })]),
    ...(said ? [element("p", said)] : []), element("dl", [...names, ...values].flatMap(([name, value]) => [element("dt", name), element("dd", value)])), ...units,
  ];
}
function setMeasuring(on) {
  measuring = on; picks = [];
  $("measure").setAttribute("aria-pressed", String(on));
  canvas.parentElement.classList.toggle("measuring", on);
  if (on && chosen) choose(null);
  showAbout(); draw();
}
function pick(thing, at) {
  picks = picks.length === 2 ? [{ ...thing, at }] : [...picks, { ...thing, at }];
  showAbout(); draw();
}
function paintMeasure(ink, view, ratio) {
  if (!picks.length) return;
  const flat = picks.map(thing => view.project(...thing.at)), colour = colourOf("chosen");
  ink.strokeStyle = ink.fillStyle = colour; ink.lineWidth = 2 * ratio;
  for (const p of flat) if (p) { ink.beginPath(); ink.arc(p[0], p[1], 4.5 * ratio, 0, 7); ink.fill(); }
  if (flat.length < 2 || !flat[0] || !flat[1]) return;
  ink.beginPath(); ink.moveTo(flat[0][0], flat[0][1]); ink.lineTo(flat[1][0], flat[1][1]); ink.stroke();
  const text = measured(picks)[0][1], x = (flat[0][0] + flat[1][0]) / 2, y = (flat[0][1] + flat[1][1]) / 2 - 8 * ratio;
  ink.font = `600 ${14 * ratio}px system-ui, sans-serif`; ink.textAlign = "center"; ink.lineWidth = 4 * ratio; ink.lineJoin = "round";
  ink.strokeStyle = colourOf("view"); ink.strokeText(text, x, y); ink.fillStyle = colourOf("ink"); ink.fillText(text, x, y);
}
$("measure").onclick = () => setMeasuring(!measuring);
