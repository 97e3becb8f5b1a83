// Positions and faces from the data of the page (the inverse of page_data.py, which describes the format); edges, normals.

/** The bytes that base64 text stands for. */
function bytesOfBase64(text) {
  const characters = atob(text);
  const bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

/** Bytes out of zlib's format. */
async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** 0, 1, 2, 3, ... as 0, -1, 1, -2, ... */
const signed = (number) => (number >>> 1) ^ -(number & 1);

/** Faces: a Uint32Array of 3F vertex indices. */
async function unpackFaces(text, nFaces) {
  const planes = await inflate(bytesOfBase64(text));
  const n = 3 * nFaces;
  if (planes.length !== 4 * n) throw new Error("the faces of this page are damaged");
  const faces = new Uint32Array(n);
  for (let i = 0, last = 0; i < n; i++) {
    const word = planes[i] | (planes[n + i] << 8) | (planes[2 * n + i] << 16) | (planes[3 * n + i] << 24);
    faces[i] = last += signed(word);
  }
  return faces;
}

/** Shapes: for each frame a Uint16Array of 3V numbers x, y, z, x, y, z, ... in steps of the grid. */
async function unpackFrames(text, nFrames, nVertices) {
  const planes = await inflate(bytesOfBase64(text));
  const total = 3 * nFrames * nVertices;
  if (planes.length !== 2 * total) throw new Error("the shapes of this page are damaged");
  const frames = [];
  for (let f = 0, at = 0; f < nFrames; f++) {
    const shape = new Uint16Array(3 * nVertices); // what is stored in it wraps at 2^16, as it should
    const before = frames[f - 1];
    const twoBefore = frames[f - 2];
    for (let axis = 0; axis < 3; axis++) {
      for (let i = axis; i < shape.length; i += 3, at++) {
        let number = signed(planes[at] | (planes[total + at] << 8));
        if (before) number += twoBefore ? 2 * before[i] - twoBefore[i] : before[i];
        shape[i] = number;
      }
    }
    frames.push(shape);
  }
  return frames;
}

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
  const unique = keys.sort().filter((key, i) => key !== keys[i - 1]);
  const edges = new Uint32Array(2 * unique.length);
  unique.forEach((key, i) => edges.set([Math.floor(key / 2 ** 26), key % 2 ** 26], 2 * i));
  return edges;
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
    for (const corner of [a, b, c]) {
      out[corner] += nx;
      out[corner + 1] += ny;
      out[corner + 2] += nz;
    }
  }
}
