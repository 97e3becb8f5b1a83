// Positions and faces from the page's data: the inverse of page_data.py, where the format is described.

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
