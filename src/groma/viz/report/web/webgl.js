// ------------------------------------------------------------------ webgl.js: draws the scene on the graphics card
// Lines are quads of a width in pixels, with soft edges; their four corners know both ends (instances are slow in software). Both states lie on the card and are blended
// there. Points and lines lie in a random order, so that the first of them are an even sample while the view moves.
const POINTS = `#version 300 es
uniform mat4 clip; uniform float blend, size;
in vec3 before, after; in vec4 colour; out vec4 tint; out float aside;
void main() { aside = 0.0; gl_Position = clip * vec4(mix(before, after, blend), 1.0); gl_PointSize = size; tint = colour; }`;
const LINES = `#version 300 es
uniform mat4 clip; uniform vec2 half_size; uniform float blend, width, near;
in vec3 before, before_end, after, after_end; in vec4 colour; out vec4 tint; out float aside;
void main() {
  vec4 p = clip * vec4(mix(before, after, blend), 1.0), q = clip * vec4(mix(before_end, after_end, blend), 1.0);
  tint = colour;
  if (p.w < near && q.w < near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  vec4 cut = mix(p, q, (near - p.w) / (q.w - p.w));
  if (p.w < near) p = cut; else if (q.w < near) q = cut;
  vec2 way = (q.xy / q.w - p.xy / p.w) * half_size;
  float far = length(way);
  vec2 across = far > 0.0 ? vec2(-way.y, way.x) / far : vec2(0.0, 1.0);
  vec4 at = (gl_VertexID & 1) == 1 ? q : p;
  aside = ((gl_VertexID & 2) == 0 ? -0.5 : 0.5) * (width + 1.0);
  at.xy += aside * across / half_size * at.w;
  gl_Position = at;
}`;
const TINT = `#version 300 es
precision mediump float;
uniform float alpha, round_size, soft; in vec4 tint; in float aside; out vec4 shown;
void main() {
  if (round_size > 3.0 && distance(gl_PointCoord, vec2(0.5)) > 0.5) discard;
  float edge = soft > 0.0 ? clamp(0.5 * soft + 0.5 - abs(aside), 0.0, 1.0) : 1.0;
  shown = vec4(tint.rgb, 1.0) * (tint.a * alpha * edge);
}`;

function webglRenderer(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
  if (!gl) return null;
  const pointProgram = programOf(POINTS), lineProgram = programOf(LINES);
  const empty = new Float32Array(0);
  const mixedPoints = shuffled(points.ids.length), mixedPieces = shuffled(pieceLine.length);
  const layers = {
    points: pointLayer(taken(states[0].points, mixedPoints, 3), taken(now.points, mixedPoints, 3)),
    lines: lineLayer(taken(states[0].lines, mixedPieces, 6), taken(now.lines, mixedPieces, 6)),
    cameras: lineLayer(frusta(states[0]), frusta(now)), faces: pointLayer(empty, empty), edges: lineLayer(empty, empty),
    litPoints: pointLayer(empty, empty), litLines: lineLayer(empty, empty), litFaces: pointLayer(empty, empty),
  };
  fillPlanes();
  gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); gl.depthFunc(gl.LEQUAL);

  function programOf(source) {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, source], [gl.FRAGMENT_SHADER, TINT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }
  function upload(buffer, values) { gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW); }
  // A layer holds buffers of both states and of colours; parts of a row of floats go to several attributes.
  function layerOf(program, names, floats, corners) {
    const array = gl.createVertexArray(), buffers = { index: gl.createBuffer() };
    gl.bindVertexArray(array);
    for (const state of ["before", "after"]) {
      buffers[state] = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, buffers[state]);
      names.forEach((suffix, k) => attribute(state + suffix, 3, gl.FLOAT, 4 * floats, 12 * k));
    }
    buffers.colour = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, buffers.colour);
    attribute("colour", 4, gl.UNSIGNED_BYTE, 4, 0);
    function attribute(name, size, type, stride, offset) {
      const at = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, size, type, type !== gl.FLOAT, stride, offset);
    }
    return {
      array, program, corners, count: 0,
      fill(before, after) {
        this.count = after.length / floats;
        upload(buffers.before, repeated(before, floats, corners)); upload(buffers.after, repeated(after, floats, corners));
        if (corners === 1) return this;
        gl.bindVertexArray(array); gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.index);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from({ length: 6 * this.count }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]), gl.DYNAMIC_DRAW);
        return this;
      },
      colour(values) { upload(buffers.colour, repeated(values, 4, corners)); return this; },
      plain(colour, alpha = 255) { return this.colour(Uint8Array.from({ length: 4 * this.count }, (_, i) => i % 4 === 3 ? alpha : colour[i % 4])); },
    };
  }
  function repeated(values, step, times) { // every row so many times
    if (times === 1) return values;
    const found = new values.constructor(values.length * times);
    for (let i = 0, at = 0; i < values.length; i += step) for (let k = 0; k < times; k++) for (let j = 0; j < step; j++) found[at++] = values[i + j];
    return found;
  }
  function pointLayer(before, after) { return layerOf(pointProgram, [""], 3, 1).fill(before, after); }
  function lineLayer(before, after) { return layerOf(lineProgram, ["", "_end"], 6, 4).fill(before, after); }
  function frusta(state) {
    const get = (name, i) => three(state[name], i);
    return new Float32Array(cameras.names.flatMap((_, i) => frustum(i, get).flat(2)));
  }
  // Triangles, edges and colours of planes, of one state.
  function faces(state, which) {
    return new Float32Array(which.flatMap(i => Array.from({ length: Math.max(0, planes.corners[i] - 2) }, (_, k) => [0, k + 1, k + 2]).flat()
      .flatMap(k => three(state.planes, planes.first[i] + k))));
  }
  function edges(state, which) {
    return new Float32Array(which.flatMap(i => Array.from({ length: planes.corners[i] }, (_, k) => [k, (k + 1) % planes.corners[i]]).flat()
      .flatMap(k => three(state.planes, planes.first[i] + k))));
  }
  function planeColours(which, per, alpha) {
    return new Uint8Array(which.flatMap(i => Array.from({ length: Math.max(0, per(planes.corners[i])) }, () => [...rgb(planes.colours[i]), alpha]).flat()));
  }
  function fillPlanes() {
    const all = planes.corners.map((_, i) => i);
    layers.faces.fill(faces(states[0], all), faces(now, all)).colour(planeColours(all, n => 3 * (n - 2), 40));
    layers.edges.fill(edges(states[0], all), edges(now, all)).colour(planeColours(all, n => n, 150));
  }
  // Rows of some items: of pieces of lines, of points.
  function taken(values, items, step) {
    const found = new values.constructor(items.length * step);
    for (let k = 0; k < items.length; k++) for (let j = 0; j < step; j++) found[k * step + j] = values[items[k] * step + j];
    return found;
  }
  function shuffled(count) {
    const order = Int32Array.from({ length: count }, (_, i) => i);
    for (let i = count - 1, seed = 1; i > 0; i--) {
      seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
      const j = Math.floor(seed / 4294967296 * (i + 1)), kept = order[i];
      order[i] = order[j]; order[j] = kept;
    }
    return order;
  }
  function draw(layer, view, { alpha = 1, width = 1, size = 1, share = 1 } = {}) {
    if (!layer.count) return;
    const count = Math.ceil(share * layer.count);
    const uniform = name => gl.getUniformLocation(layer.program, name);
    gl.useProgram(layer.program); gl.bindVertexArray(layer.array);
    gl.uniformMatrix4fv(uniform("clip"), false, view.clip); gl.uniform1f(uniform("blend"), both ? blend : 1);
    gl.uniform1f(uniform("alpha"), alpha); gl.uniform1f(uniform("round_size"), 0);
    if (layer.corners === 1) {
      gl.uniform1f(uniform("size"), size); gl.uniform1f(uniform("soft"), 0); gl.uniform1f(uniform("round_size"), layer.faces ? 0 : size);
      gl.drawArrays(layer.faces ? gl.TRIANGLES : gl.POINTS, 0, count);
    } else {
      gl.uniform2f(uniform("half_size"), view.w / 2, view.h / 2); gl.uniform1f(uniform("width"), width); gl.uniform1f(uniform("near"), view.near);
      gl.uniform1f(uniform("soft"), width);
      gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
    }
  }
  layers.faces.faces = layers.litFaces.faces = true;
  return {
    name: "webgl",
    colour(pointValues, pieceValues) {
      layers.points.colour(taken(pointValues, mixedPoints, 4)); layers.lines.colour(taken(pieceValues, mixedPieces, 4)); layers.cameras.plain(rgb(colourOf("camera")));
    },
    light(found) {
      const colour = rgb(colourOf("chosen")), pieces = found.lines.flatMap(i => [...piecesOf(i)]);
      const strokes = state => new Float32Array([...taken(state.lines, pieces, 6), ...found.cameras.flatMap(i => frustum(i, (name, k) => three(state[name], k)).flat(2))]);
      layers.litLines.fill(strokes(states[0]), strokes(now)).plain(colour);
      layers.litPoints.fill(taken(states[0].points, found.points, 3), taken(now.points, found.points, 3)).plain(colour);
      layers.litFaces.fill(faces(states[0], found.planes), faces(now, found.planes)).plain(colour, 90);
    },
    paint(view, { shown, ratio, pointSize, dim, share }) {
      gl.viewport(0, 0, view.w, view.h); gl.clearColor(0, 0, 0, 0); gl.depthMask(true); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      if (shown.points) draw(layers.points, view, { size: pointSize, alpha: dim, share });
      if (shown.lines) draw(layers.lines, view, { width: (pieceLine.length > 8000 ? 1.3 : 1.8) * ratio, alpha: dim, share: Math.sqrt(share) });
      gl.depthMask(false);
      if (shown.cameras) draw(layers.cameras, view, { width: 1.3 * ratio, alpha: dim * Math.max(0.12, Math.min(1, 200 / cameras.names.length)) });
      if (shown.planes) { draw(layers.faces, view, { alpha: dim }); draw(layers.edges, view, { width: ratio, alpha: dim }); }
      gl.disable(gl.DEPTH_TEST);
      draw(layers.litFaces, view); draw(layers.litPoints, view, { size: Math.max(pointSize, 4 * ratio) }); draw(layers.litLines, view, { width: 3.5 * ratio });
    },
    finish() { gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); }, // waits until all is drawn
  };
}
