// ------------------------------------------------------------------ strip.js: all photographs, small; those that saw the chosen thing first
const strip = $("strip"), THUMB = [292, 196], MOST = 600;
const thumbs = data.images.slice(0, MOST).map((entry, index) => {
  const one = element("button", [element("canvas", [], { width: THUMB[0], height: THUMB[1] }), span(entry.name)], { type: "button", title: entry.name });
  one.onclick = () => showImage(index);
  one.ondblclick = () => choose({ kind: "camera", index: entry.camera }, "strip");
  return { one, bitmap: null, visible: false, asked: false };
});
strip.replaceChildren(...thumbs.map(t => t.one));
strip.hidden = thumbs.length < 2 || !anyPhoto;

// Photographs are decoded small, when they come into view.
async function load(index) {
  const thumb = thumbs[index], photo = data.images[index].photo;
  if (thumb.asked || !photo) return;
  thumb.asked = true;
  const blob = new Blob([bytes(photo.slice(photo.indexOf(",") + 1))], { type: "image/jpeg" });
  thumb.bitmap = await createImageBitmap(blob, { resizeWidth: THUMB[0], resizeQuality: "medium" });
  drawThumb(index);
}
function drawThumb(index) {
  const thumb = thumbs[index], entry = data.images[index], [width, height] = uprightSize(entry), c = thumb.one.firstChild.getContext("2d");
  const { at, draw } = upright(entry, Math.max(THUMB[0] / width, THUMB[1] / height), THUMB[0] / 2, THUMB[1] / 2);
  c.fillStyle = "#26292e"; c.fillRect(0, 0, ...THUMB);
  if (thumb.bitmap) draw(c, thumb.bitmap);
  c.lineCap = "round";
  if (chosen) drawLit(c, index, at, 5);
}
const watch = new IntersectionObserver(found => found.forEach(({ target, isIntersecting }) => {
  const index = thumbs.findIndex(t => t.one === target);
  thumbs[index].visible = isIntersecting;
  if (isIntersecting) { load(index); drawThumb(index); }
}), { root: null, rootMargin: "200px" });
thumbs.forEach(t => watch.observe(t.one));

function markCurrent() { thumbs.forEach((t, i) => t.one.classList.toggle("current", i === current)); }
onChoice.push(() => {
  const seen = new Set(lit.entries);
  strip.classList.toggle("choice", !!chosen);
  thumbs.forEach((t, i) => { t.one.classList.toggle("lit", seen.has(i)); if (t.visible) drawThumb(i); });
  strip.scrollLeft = 0;
});
