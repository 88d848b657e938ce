// ------------------------------------------------------------------ main.js: switches, and how the page begins
document.querySelectorAll(".when-both").forEach(e => { e.hidden = !both; });
function switchBox(home, text, on, change) {
  const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: on });
  box.onchange = () => change(box.checked);
  home.append(element("label", [box, text]), " ");
}
for (const [name, count] of [["points", points.ids.length], ["lines", lines.ids.length], ["planes", planes.ids.length], ["cameras", cameras.names.length], ["junctions", junctionLines.length]])
  if (count) switchBox($("layers"), name[0].toUpperCase() + name.slice(1), shown[name], on => { shown[name] = on; recolour(); });
for (const [name, text, there] of [["photo", "Photograph", anyPhoto], ["segments", "Segments", segments.length], ["projected", "3D segments", segments.length], ["points", "Residuals", rows.length]])
  if (there) switchBox($("image-layers"), text, layers[name], on => { layers[name] = on; drawImage(); });
for (const [value, text] of pointModes) $("colour").add(new Option(text, value));
for (const [value, text] of lineModes) $("line-colour").add(new Option(text, value));
$("colour-label").hidden = $("size-label").hidden = !points.ids.length;
$("line-colour-label").hidden = !lines.ids.length;
$("gain").parentElement.hidden = !rows.length;
if (points.ids.length < 3000) $("size").value = 4;
for (const id of ["colour", "line-colour"]) $(id).addEventListener("input", recolour);
$("size").addEventListener("input", draw);
$("gain").addEventListener("input", drawImage);
$("home").onclick = () => { startView(); draw(); };

// ------------------------------------------------------------------ before and after
const GLIDE = 67; // milliseconds in which two thirds of what is left are gone, however many frames there are
let target = last, glided = 0;
function showState(state) {
  target = state;
  glided = performance.now();
  document.querySelectorAll("#state button").forEach(b => b.setAttribute("aria-pressed", String(+b.dataset.state === target)));
  requestAnimationFrame(glide);
}
function glide(time) {
  const gap = (target - blend) * Math.exp(-Math.max(0, time - glided) / GLIDE);
  glided = time;
  blend = Math.abs(gap) < 0.01 ? target : target - gap;
  if (both && painted !== (blend < 0.5 ? 0 : last)) { recolour(); drawImage(); }
  draw();
  if (blend !== target) requestAnimationFrame(glide);
}
document.querySelectorAll("#state button").forEach(b => { b.onclick = () => showState(+b.dataset.state); });

// ------------------------------------------------------------------ photographs
$("image-pane").hidden = !data.images.length;
document.querySelector(".panes").classList.toggle("alone", !data.images.length);
data.images.forEach((entry, i) => $("image").add(new Option(entry.name, i)));
$("image").addEventListener("input", () => showImage(+$("image").value));
$("previous").onclick = () => showImage(current - 1);
$("next").onclick = () => showImage(current + 1);
if (segments.length) $("image-legend").append("Distance from the line: 0 ", Object.assign(span(""), { className: "ramp" }), ` ${segmentTop.toPrecision(2)} px or more`);
$("image-caption").textContent = [
  segments.length ? "Photographs: measured segments coloured by their distance from the projected line; thin and white, the projected 3D segment." : "",
  rows.length ? "Residuals (Display): strokes from where a point was measured to where the model predicts it, magnified; a common pattern is an error of the model." : "",
].filter(Boolean).join(" ");

// ------------------------------------------------------------------ keys, theme, paper
addEventListener("keydown", e => {
  if (/SELECT|INPUT/.test(e.target.tagName)) return;
  if (both && (e.key === "b" || e.key === "B")) showState(1 - target);
  if (e.key === "Escape") { if (measuring) setMeasuring(false); else choose(null); }
  if (e.key === "/") { $("search").focus(); e.preventDefault(); }
});
document.addEventListener("pointerdown", e => { if (!e.target.closest("#options")) $("options").open = false; });
function repaint() { recolour(); renderer.light(lit); paint(); drawImage(); }
$("theme").onclick = () => { root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark"; repaint(); };
let theme = "light"; // paper is white
addEventListener("beforeprint", () => { theme = root.dataset.theme; root.dataset.theme = "light"; repaint(); });
addEventListener("afterprint", () => { root.dataset.theme = theme; repaint(); });
addEventListener("resize", () => { draw(); drawImage(); });

// Begin before the adjustment and glide to its result, which shows at once what the switch is for.
recolour(); showImage(data.first); showAbout();
if (both && !matchMedia("(prefers-reduced-motion: reduce)").matches) { blend = 0; showState(0); setTimeout(() => showState(1), 900); } else showState(last);
// An address may end in the name of a thing: report.html#line 12
const asked = search(decodeURIComponent(location.hash.slice(1)));
if (asked.length) takeFound(asked[0]);
