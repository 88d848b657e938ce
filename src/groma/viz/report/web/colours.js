// ------------------------------------------------------------------ colours.js: theme, ramp, and the colour of every point and line
const root = document.documentElement;
root.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
const colourOf = name => getComputedStyle(root).getPropertyValue("--" + name).trim();
const rgb = text => [1, 3, 5].map(i => parseInt(text.slice(i, i + 2), 16));

const rampStops = [[44, 111, 187], [63, 182, 168], [232, 197, 58], [217, 71, 43]];
const ramp = Array.from({ length: 256 }, (_, i) => {
  const t = Math.min(i / 255, 0.9999) * 3, k = t | 0;
  return rampStops[k].map((x, c) => Math.round(x + (rampStops[k + 1][c] - x) * (t - k)));
});
const onRamp = share => ramp[Math.max(0, Math.min(255, share * 255)) | 0] || ramp[0];
const css = c => `rgb(${c[0]},${c[1]},${c[2]})`;

const ranges = {
  length: [quantile(lines.lengths, 0.05), quantile(lines.lengths, 0.95)],
  views: [quantile(lines.images, 0.05), Math.max(quantile(lines.images, 0.95), quantile(lines.images, 0.05) + 1)],
};
const hasConfidence = lines.confidence.some(c => c >= 0);
const lineModes = [["direction", "by direction"]];
if (lines.shared.length) lineModes.push(["shared", "by shared direction"]);
lineModes.push(["length", "by length"], ["error", "by deviation"], ["views", "by images"]);
if (hasConfidence) lineModes.push(["confidence", "by confidence"]);
lineModes.push(["plain", "plain"]);
const pointModes = [["plain", "plain"]];
if (now.errors.length) pointModes.unshift(["error", "by deviation"]);
if (points.colours.length) pointModes.unshift(["photo", "in their colours"]);

function lineColour(mode, i, state) {
  if (mode === "direction") return lines.colours.subarray(3 * i, 3 * i + 3);
  if (mode === "shared") return lines.shared.subarray(3 * i, 3 * i + 3);
  if (mode === "error") return onRamp(states[state].lineErrors[i] / data.view.line_error_top);
  if (mode === "confidence") return lines.confidence[i] >= 0 ? onRamp(lines.confidence[i]) : [150, 152, 156];
  const [low, high] = ranges[mode];
  if (mode === "length" && low > 0) return onRamp(Math.log(lines.lengths[i] / low) / Math.max(Math.log(high / low), 1e-9));
  return onRamp(((mode === "length" ? lines.lengths[i] : lines.images[i]) - low) / Math.max(high - low, 1e-9));
}
// Colours (n, 4) of all points, and of all pieces of lines.
function pointColours(mode, state) {
  const found = new Uint8Array(4 * points.ids.length).fill(255), plain = rgb(colourOf(both && !state ? "before" : "after"));
  for (let i = 0; i < points.ids.length; i++) {
    const c = mode === "photo" ? points.colours.subarray(3 * i, 3 * i + 3) : mode === "error" ? onRamp(states[state].errors[i] / data.view.error_top) : plain;
    found[4 * i] = c[0]; found[4 * i + 1] = c[1]; found[4 * i + 2] = c[2];
  }
  return found;
}
function pieceColours(mode, state) {
  const found = new Uint8Array(4 * pieceLine.length).fill(255), plain = rgb(colourOf("line"));
  pieceLine.forEach((line, i) => { found.set(mode === "plain" ? plain : lineColour(mode, line, state), 4 * i); });
  return found;
}
// What the colours mean: name, lowest, highest.
function legends(pointMode, lineMode, shown) {
  const most = value => number(+value.toPrecision(2)) + " px or more", found = [];
  if (shown.points && pointMode === "error") found.push(["points", "0", most(data.view.error_top)]);
  if (!shown.lines || !lines.ids.length) return found;
  if (lineMode === "error") found.push(["lines", "0", most(data.view.line_error_top)]);
  if (lineMode === "confidence") found.push(["confidence", "0", "1"]);
  if (lineMode in ranges) found.push([{ length: "length", views: "images" }[lineMode], ...ranges[lineMode].map((x, i) => +x.toPrecision(2) + (i ? " or more" : ""))]);
  return found;
}
