// ------------------------------------------------------------------ vectors.js: three numbers at a time
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const minus = (a, b) => plus(a, b, -1);
const times = (a, s) => [s * a[0], s * a[1], s * a[2]];
const norm = a => Math.hypot(a[0], a[1], a[2]);
const unit = a => times(a, 1 / (norm(a) || 1));
const three = (array, i) => [array[3 * i], array[3 * i + 1], array[3 * i + 2]];

// Matrices as lists of rows.
const apply = (m, v) => m.map(row => row.reduce((sum, x, i) => sum + x * v[i], 0));
const transposed = m => m[0].map((_, i) => m.map(row => row[i]));
const product = (a, b) => { const t = transposed(b); return a.map(row => apply(t, row)); };
const skew = a => [[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]];
const quadratic = (m, v) => apply(m, v).reduce((sum, x, i) => sum + x * v[i], 0);
// Symmetric matrix i of packed upper triangles; null where it is not known.
function symmetric(packed, i, size) {
  const step = size * (size + 1) / 2, found = Array.from({ length: size }, () => new Array(size).fill(0));
  if (packed.length < step * (i + 1) || packed[step * i] < 0) return null;
  for (let a = 0, k = step * i; a < size; a++) for (let b = a; b < size; b++, k++) found[a][b] = found[b][a] = packed[k];
  return found;
}
