// ------------------------------------------------------------------ flat.js: the same on a canvas, where there is no WebGL
function flatRenderer(canvas) {
  const context = canvas.getContext("2d");
  let pointTint = new Uint8Array(0), pieceTint = new Uint8Array(0), found = litBy(null);
  function strokes(view, ends, width, alpha) { // ends: pairs of places, by colour
    context.lineWidth = width; context.globalAlpha = alpha;
    for (const [colour, list] of ends) {
      context.strokeStyle = colour; context.beginPath();
      for (const [a, b] of list) {
        const p = view.project(...a), q = view.project(...b);
        if (p && q) { context.moveTo(p[0], p[1]); context.lineTo(q[0], q[1]); }
      }
      context.stroke();
    }
    context.globalAlpha = 1;
  }
  function faces(view, which, colour, alpha) {
    for (const i of which) {
      const flat = planeCorners(i).map(corner => view.project(...corner));
      if (flat.some(p => !p)) continue;
      context.beginPath(); flat.forEach((p, k) => context[k ? "lineTo" : "moveTo"](p[0], p[1])); context.closePath();
      context.fillStyle = context.strokeStyle = colour(i);
      context.globalAlpha = alpha; context.fill(); context.globalAlpha = 0.6; context.stroke(); context.globalAlpha = 1;
    }
  }
  function dots(view, count, index, colour, size) {
    const seen = [];
    for (let k = 0; k < count; k++) { const p = view.project(...place("points", index(k))); if (p) seen.push([p, index(k)]); }
    seen.sort((a, b) => b[0][2] - a[0][2]); // the near ones last
    for (const [p, i] of seen) { context.fillStyle = colour(i); context.fillRect(p[0] - size / 2, p[1] - size / 2, size, size); }
  }
  return {
    name: "canvas",
    colour(pointValues, pieceValues) { pointTint = pointValues; pieceTint = pieceValues; },
    light(now) { found = now; },
    paint(view, { shown, ratio, pointSize, dim, share }) {
      context.clearRect(0, 0, view.w, view.h);
      const tint = (values, i) => css(values.subarray(4 * i, 4 * i + 3)), chosenColour = colourOf("chosen");
      context.globalAlpha = dim;
      if (shown.points) dots(view, Math.ceil(share * points.ids.length), k => Math.floor(k / share), i => tint(pointTint, i), pointSize);
      context.globalAlpha = 1;
      if (shown.lines) {
        const groups = new Map();
        pieceLine.forEach((_, i) => { const c = tint(pieceTint, i); if (!groups.has(c)) groups.set(c, []); groups.get(c).push(pieceEnds(i)); });
        strokes(view, groups, 1.5 * ratio, dim);
      }
      if (shown.cameras) strokes(view, [[colourOf("camera"), cameras.names.flatMap((_, i) => frustum(i))]], 1.2 * ratio, dim * Math.max(0.12, Math.min(1, 200 / cameras.names.length)));
      if (shown.planes) faces(view, planes.corners.map((_, i) => i), i => planes.colours[i], 0.16 * dim);
      faces(view, found.planes, () => chosenColour, 0.3);
      dots(view, found.points.length, k => found.points[k], () => chosenColour, Math.max(pointSize, 4 * ratio));
      strokes(view, [[chosenColour, [...found.lines.flatMap(i => [...piecesOf(i)].map(pieceEnds)), ...found.cameras.flatMap(i => frustum(i))]]], 3.5 * ratio, 1);
    },
    finish() {},
  };
}
