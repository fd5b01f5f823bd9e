"use strict";
// Functions of page.js that do not depend on what is shown.
const MISSING = 65535;

// Inverse of wrf_mi.viewer.page.packed: numbers in the order of the last axis, and their shape.
function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed.codes), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  const values = new Float64Array(bytes.length / 2);
  for (let i = 0; i < values.length; i++) {
    const code = view.getUint16(2 * i, true);
    values[i] = code === MISSING ? NaN : packed.low + code * packed.step;
  }
  return { shape: packed.shape, values };
}

// Text for plotly, which reads some tags.
const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const number = (value, digits = 1) => (Number.isFinite(value) ? value.toFixed(digits).replace("-", "\u2212") : "none");
const column = (triples, axis) => Array.from({ length: triples.length / 3 }, (_, i) => triples[3 * i + axis]);
const xyz = (triples) => ({ x: column(triples, 0), y: column(triples, 1), z: column(triples, 2) });
const at = (triples, i) => [triples[3 * i], triples[3 * i + 1], triples[3 * i + 2]];

const reversed = (scale) => scale.map(([share], i) => [share, scale[scale.length - 1 - i][1]]);

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

// Rotation matrix of a quaternion that need not be normalised.
function rotation(x, y, z, w) {
  const s = 2 / (x * x + y * y + z * z + w * w);
  return [
    [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
    [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
    [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
  ];
}

// Smallest distance from the middle of a box, of these lengths of edges, at which a perspective camera in a direction sees
// all corners in a picture of this ratio of width to height. Plotly's cameras have 45 degrees from bottom to top.
function viewingDistance(box, direction, ratio) {
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const unit = (a) => a.map((value) => value / Math.hypot(...a));
  const towards = unit(direction);
  const right = unit([-towards[1], towards[0], 0]);
  const up = [-towards[2] * right[1], towards[2] * right[0], towards[0] * right[1] - towards[1] * right[0]];
  const half = Math.tan(Math.PI / 8);
  let distance = 0;
  for (const a of [-0.5, 0.5]) for (const b of [-0.5, 0.5]) for (const c of [-0.5, 0.5]) {
    const corner = [a * box[0], b * box[1], c * box[2]];
    const across = Math.max(Math.abs(dot(corner, right)) / ratio, Math.abs(dot(corner, up))) / half;
    distance = Math.max(distance, across + dot(corner, towards));
  }
  return distance;
}

// Icosahedron whose faces are divided once: 42 corners, 80 faces.
function icosphere() {
  const t = (1 + Math.sqrt(5)) / 2;
  const vertices = [];
  for (const a of [-1, 1]) for (const b of [-t, t]) vertices.push([0, a, b], [a, b, 0], [b, 0, a]);
  const near = (p, q) => Math.abs(Math.hypot(p[0] - q[0], p[1] - q[1], p[2] - q[2]) - 2) < 1e-9;
  const coarse = [];
  for (let a = 0; a < 12; a++) for (let b = a + 1; b < 12; b++) for (let c = b + 1; c < 12; c++) {
    if (near(vertices[a], vertices[b]) && near(vertices[b], vertices[c]) && near(vertices[a], vertices[c])) coarse.push([a, b, c]);
  }
  const middles = new Map();
  const middle = (a, b) => {
    const key = a < b ? `${a},${b}` : `${b},${a}`;
    if (!middles.has(key)) {
      middles.set(key, vertices.length);
      vertices.push(vertices[a].map((value, axis) => value + vertices[b][axis]));
    }
    return middles.get(key);
  };
  const faces = coarse.flatMap(([a, b, c]) => {
    const [d, e, f] = [middle(a, b), middle(b, c), middle(c, a)];
    return [[a, d, f], [d, b, e], [f, e, c], [d, e, f]];
  });
  return { vertices: vertices.map((v) => v.map((value) => value / Math.hypot(...v))), faces };
}
