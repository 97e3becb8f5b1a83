// Positions, faces and materials from the data of the page (the inverse of page_data.py, which describes the format);
// edges, normals.

const GRID_STEPS = 65535; // a coordinate from 0 to 1, or a part of a colour
const TEXEL_STEPS = 65536; // a texture coordinate from 0 to 1

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

/** An Int32Array of n whole numbers, such as the 3F vertex indices of faces. */
async function unpackIntegers(text, n) {
  const planes = await inflate(bytesOfBase64(text));
  if (planes.length !== 4 * n) throw new Error("the faces of this page are damaged");
  const numbers = new Int32Array(n);
  for (let i = 0, last = 0; i < n; i++) {
    const word = planes[i] | (planes[n + i] << 8) | (planes[2 * n + i] << 16) | (planes[3 * n + i] << 24);
    numbers[i] = last += signed(word);
  }
  return numbers;
}

/** As indices of WebGL. */
const unpackIndices = async (text, n) => new Uint32Array((await unpackIntegers(text, n)).buffer);

/** Columns of numbers as rows, divided. */
function rowsOf(columns, width, divisor) {
  const n = columns.length / width;
  const rows = new Float32Array(columns.length);
  for (let i = 0; i < columns.length; i++) rows[(i % n) * width + Math.floor(i / n)] = columns[i] / divisor;
  return rows;
}

/** A picture of a data URI; white if the browser cannot read it. */
async function pictureOf(uri) {
  const picture = new Image();
  picture.src = uri;
  try {
    await picture.decode();
    return picture;
  } catch {
    return new ImageData(new Uint8ClampedArray(4).fill(255), 1);
  }
}

/**
 * What is drawn of a group: points, each of one vertex, and triangles of them in parts of one material. Points of the
 * same number in `normals` share a normal. Without materials, the points are the vertices.
 */
async function unpackSurface({ surface, faces, n_vertices }) {
  if (!surface) {
    const vertices = Uint32Array.from({ length: n_vertices }, (_, i) => i);
    return { vertices, normals: vertices, triangles: faces, parts: [] };
  }
  const { n_points, parts } = surface;
  return {
    parts,
    vertices: await unpackIndices(surface.vertices, n_points),
    normals: await unpackIndices(surface.normals, n_points),
    triangles: await unpackIndices(surface.triangles, parts.reduce((sum, { n_corners }) => sum + n_corners, 0)),
    texcoords: rowsOf(await unpackIntegers(surface.texcoords, 2 * n_points), 2, TEXEL_STEPS),
    colors: rowsOf(await unpackIntegers(surface.colors, 4 * n_points), 4, GRID_STEPS),
    textures: await Promise.all(surface.textures.map((uri) => uri && pictureOf(uri))),
  };
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

/** Normals of points, weighted by area and not of unit length: of each triangle, added to those of `numbers`. */
function normalsOf(points, triangles, numbers, out) {
  out.fill(0);
  for (let f = 0; f < triangles.length; f += 3) {
    const a = 3 * triangles[f];
    const b = 3 * triangles[f + 1];
    const c = 3 * triangles[f + 2];
    const ux = points[b] - points[a];
    const uy = points[b + 1] - points[a + 1];
    const uz = points[b + 2] - points[a + 2];
    const vx = points[c] - points[a];
    const vy = points[c + 1] - points[a + 1];
    const vz = points[c + 2] - points[a + 2];
    const nx = uy * vz - uz * vy;
    const ny = uz * vx - ux * vz;
    const nz = ux * vy - uy * vx;
    for (let corner = f; corner < f + 3; corner++) {
      const to = 3 * numbers[triangles[corner]];
      out[to] += nx;
      out[to + 1] += ny;
      out[to + 2] += nz;
    }
  }
}

/** Rows of three numbers, in the order of indices, into `out`. */
function gather(rows, indices, out) {
  for (let i = 0, to = 0; i < indices.length; i++) {
    const from = 3 * indices[i];
    out[to++] = rows[from];
    out[to++] = rows[from + 1];
    out[to++] = rows[from + 2];
  }
}
