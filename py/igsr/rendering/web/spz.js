// Splats from the bytes of a .spz of version 3, as they go to the GPU: still in 8 bits.
//
// The frame stays that of the file, y up and z back; the painter turns cameras to it.

const SPZ_HEADER = 16;
const SPZ_MAGIC = 0x5053474e; // "NGSP"
const SPLAT_TEXEL_WORDS = 8; // two texels of four 32-bit words

const harmonicsOf = (degree) => (degree + 1) * (degree + 1) - 1;

/** What the header says. Throws an Error if it is not one. */
function readSpzHeader(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, SPZ_HEADER);
  if (view.getUint32(0, true) !== SPZ_MAGIC) throw new Error("it does not start as a .spz");
  const version = view.getUint32(4, true);
  if (version !== 3) throw new Error(`it is a .spz of version ${version}, not 3`);
  const [degree, fractionBits, flags] = [view.getUint8(12), view.getUint8(13), view.getUint8(14)];
  if (degree > 4 || fractionBits > 24) throw new Error("its header is wrong");
  return { count: view.getUint32(8, true), degree, fractionBits, antialiased: (flags & 1) === 1 };
}

/** Bytes of each array: positions, opacities, colours, scales, rotations, spherical harmonics. */
function spzArraySizes({ count, degree }) {
  return [9, 1, 3, 3, 4, 3 * harmonicsOf(degree)].map((each) => each * count);
}

const spzSize = (bytes) => spzArraySizes(readSpzHeader(bytes)).reduce((a, b) => a + b, SPZ_HEADER);

/**
 * All splats of a file whose length is `spzSize`.
 *
 * Returns `positions` (Float32Array, 3 a splat), `texels` (Uint32Array, 8 a splat: x, y, z as bits
 * of float32; colour and opacity; log-scales; rotation; two unused) and `harmonics` (Uint32Array,
 * one word for R, G and B of each coefficient but the first, `harmonicWords` a splat).
 */
function parseSpz(bytes) {
  const header = readSpzHeader(bytes);
  const { count, degree, fractionBits } = header;
  const arrays = [];
  let at = SPZ_HEADER;
  for (const size of spzArraySizes(header)) {
    arrays.push(bytes.subarray(at, at + size));
    at += size;
  }
  const [fixed, opacities, colors, scales, rotations, rest] = arrays;
  const unit = 2 ** -fractionBits;
  const positions = new Float32Array(3 * count);
  for (let i = 0; i < positions.length; i++) {
    // The 24 bits on top, so that the shift down carries the sign.
    const b = 3 * i;
    positions[i] = (((fixed[b] << 8) | (fixed[b + 1] << 16) | (fixed[b + 2] << 24)) >> 8) * unit;
  }
  const texels = new Uint32Array(SPLAT_TEXEL_WORDS * count);
  const places = new Float32Array(texels.buffer);
  for (let i = 0; i < count; i++) {
    const t = SPLAT_TEXEL_WORDS * i;
    for (let k = 0; k < 3; k++) places[t + k] = positions[3 * i + k];
    const word = (a, b, c, d) => a | (b << 8) | (c << 16) | (d << 24);
    texels[t + 3] = word(colors[3 * i], colors[3 * i + 1], colors[3 * i + 2], opacities[i]);
    texels[t + 4] = word(scales[3 * i], scales[3 * i + 1], scales[3 * i + 2], 0);
    const r = 4 * i;
    texels[t + 5] = word(rotations[r], rotations[r + 1], rotations[r + 2], rotations[r + 3]);
  }
  const each = harmonicsOf(degree);
  const harmonicWords = 4 * Math.ceil(each / 4);
  const harmonics = new Uint32Array(harmonicWords * count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < each; k++) {
      const b = 3 * (i * each + k);
      harmonics[harmonicWords * i + k] = rest[b] | (rest[b + 1] << 8) | (rest[b + 2] << 16);
    }
  }
  return { ...header, positions, texels, harmonics, harmonicWords };
}
