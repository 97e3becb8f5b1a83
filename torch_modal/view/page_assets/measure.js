// Measures of shapes in plain arrays: x, y, z of each vertex, and three corners of each face.

/** Each edge once: a Uint32Array of pairs, the smaller index first. */
function edgesOf(faces) {
  const keys = new Float64Array(faces.length);
  for (let i = 0; i < faces.length; i += 3) {
    for (let c = 0; c < 3; c++) {
      const a = faces[i + c];
      const b = faces[i + ((c + 1) % 3)];
      keys[i + c] = Math.min(a, b) * 2 ** 26 + Math.max(a, b); // exact up to 2^53
    }
  }
  keys.sort();
  const edges = [];
  for (let i = 0; i < keys.length; i++) {
    if (i && keys[i] === keys[i - 1]) continue;
    edges.push(Math.floor(keys[i] / 2 ** 26), keys[i] % 2 ** 26);
  }
  return Uint32Array.from(edges);
}

/** (1 - s) a + s b into `out`. */
function blend(a, b, s, out) {
  if (s === 0 || a === b) out.set(a);
  else for (let i = 0; i < out.length; i++) out[i] = a[i] + s * (b[i] - a[i]);
  return out;
}

/** Normals of the vertices, weighted by area and not of unit length, into `out`. */
function normalsOf(points, faces, out) {
  out.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f];
    const b = 3 * faces[f + 1];
    const c = 3 * faces[f + 2];
    const ux = points[b] - points[a];
    const uy = points[b + 1] - points[a + 1];
    const uz = points[b + 2] - points[a + 2];
    const vx = points[c] - points[a];
    const vy = points[c + 1] - points[a + 1];
    const vz = points[c + 2] - points[a + 2];
    const nx = uy * vz - uz * vy;
    const ny = uz * vx - ux * vz;
    const nz = ux * vy - uy * vx;
    out[a] += nx;
    out[a + 1] += ny;
    out[a + 2] += nz;
    out[b] += nx;
    out[b + 1] += ny;
    out[b + 2] += nz;
    out[c] += nx;
    out[c + 1] += ny;
    out[c + 2] += nz;
  }
  return out;
}

/** Lengths of the edges, into `out`. */
function lengthsOf(points, edges, out) {
  for (let e = 0; e < out.length; e++) {
    const a = 3 * edges[2 * e];
    const b = 3 * edges[2 * e + 1];
    const x = points[a] - points[b];
    const y = points[a + 1] - points[b + 1];
    const z = points[a + 2] - points[b + 2];
    out[e] = Math.sqrt(x * x + y * y + z * z);
  }
  return out;
}

/** Enclosed volume, relative to the mean of the vertices, so that open surfaces may be moved too. */
function volumeOf(points, faces) {
  const mean = [0, 0, 0];
  for (let i = 0; i < points.length; i++) mean[i % 3] += (3 * points[i]) / points.length;
  const [mx, my, mz] = mean;
  let six = 0;
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f];
    const b = 3 * faces[f + 1];
    const c = 3 * faces[f + 2];
    const ax = points[a] - mx;
    const ay = points[a + 1] - my;
    const az = points[a + 2] - mz;
    const bx = points[b] - mx;
    const by = points[b + 1] - my;
    const bz = points[b + 2] - mz;
    const cx = points[c] - mx;
    const cy = points[c + 1] - my;
    const cz = points[c + 2] - mz;
    six += ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx);
  }
  return six / 6;
}

/** Half of the longest side's grid and less is rounding: shorter reference edges count as this long (in steps). */
const SHORTEST_EDGE = 2;

/**
 * The measures by name: `of` measures one shape, `mix` mixes two such measures (the key-frames around), and `compare`
 * gives a number for each vertex, and a mean for the shape. All numbers are in per cent.
 */
function measuresOf(faces, edges, nVertices, diagonal) {
  const degree = new Float32Array(nVertices);
  for (const vertex of edges) degree[vertex]++;
  const mixed = (a, b, s) => blend(a, b, s, new Float32Array(a.length));
  return {
    strain: {
      label: "edge strain",
      signed: false,
      of: (points) => lengthsOf(points, edges, new Float32Array(edges.length / 2)),
      mix: mixed,
      compare(lengths, rest, out) {
        out.fill(0);
        let sum = 0;
        for (let e = 0; e < lengths.length; e++) {
          const strain = 100 * Math.abs(lengths[e] - rest[e]) / Math.max(rest[e], SHORTEST_EDGE);
          out[edges[2 * e]] += strain;
          out[edges[2 * e + 1]] += strain;
          sum += strain;
        }
        for (let v = 0; v < nVertices; v++) out[v] /= Math.max(degree[v], 1);
        return sum / lengths.length;
      },
    },
    distance: {
      label: "distance, of the diagonal",
      signed: false,
      of: (points) => Float32Array.from(points),
      mix: mixed,
      compare(points, rest, out) {
        let sum = 0;
        for (let v = 0; v < nVertices; v++) {
          const x = points[3 * v] - rest[3 * v];
          const y = points[3 * v + 1] - rest[3 * v + 1];
          const z = points[3 * v + 2] - rest[3 * v + 2];
          sum += out[v] = (100 * Math.sqrt(x * x + y * y + z * z)) / diagonal;
        }
        return sum / nVertices;
      },
    },
    volume: {
      label: "volume change",
      signed: true,
      of: (points) => volumeOf(points, faces),
      mix: (a, b, s) => a + s * (b - a),
      compare(volume, rest, out) {
        const change = rest === 0 ? 0 : 100 * (volume / rest - 1);
        out.fill(change);
        return change;
      },
    },
  };
}

/** The value below which the part `p` of the numbers lies. */
function percentile(numbers, p) {
  const sorted = Float32Array.from(numbers).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(p * sorted.length))];
}

// From light to dark as in the package's pictures, and two-sided: less is violet, more is red.
const SEQUENTIAL = ["#e4e4e2", "#f6c9a0", "#e8804f", "#b2182b", "#5c0a20"].map(rgbOf);
const TWO_SIDED = ["#3f2a7d", "#8073ac", "#c9c3dd", "#e4e4e2", "#f6c9a0", "#e8804f", "#b2182b"].map(rgbOf);

function rgbOf(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
}

/** The colour of each number, three floats each, into `out`; `most` is where the scale ends (on both sides). */
function paint(numbers, most, twoSided, out) {
  const stops = twoSided ? TWO_SIDED : SEQUENTIAL;
  const last = stops.length - 1;
  for (let v = 0; v < numbers.length; v++) {
    const part = twoSided ? (numbers[v] / most + 1) / 2 : numbers[v] / most;
    const place = Math.min(Math.max(part, 0), 1) * last;
    const low = Math.min(Math.floor(place), last - 1);
    for (let c = 0; c < 3; c++) out[3 * v + c] = stops[low][c] + (place - low) * (stops[low + 1][c] - stops[low][c]);
  }
  return out;
}
