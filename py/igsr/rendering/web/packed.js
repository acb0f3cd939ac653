// Converts the page's packed bytes (scene_model.py) to textures; values stay in 8 bits.
//
// The frame is a .spz's, y up and z back; the painter rotates cameras to it.

const PACKED_HEADER = 20;
const PACKED_MAGIC = 0x50534749; // "IGSP"
const SPLAT_TEXEL_WORDS = 8; // two texels of four 32-bit words

const harmonicsOf = (degree) => (degree + 1) * (degree + 1) - 1;

/** Reads the header. Throws an Error if it is damaged. */
function readHeader(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, PACKED_HEADER);
  if (view.getUint32(0, true) !== PACKED_MAGIC) throw new Error("it was not written by igsr");
  const version = view.getUint32(4, true);
  if (version !== 1) throw new Error(`it is of version ${version}, not 1`);
  const [count, rows] = [view.getUint32(8, true), view.getUint32(16, true)];
  const [degree, fractionBits, flags] = [view.getUint8(12), view.getUint8(13), view.getUint8(14)];
  const hasPalette = (flags & 2) === 2;
  if (degree > 4 || fractionBits > 24 || (hasPalette ? rows > 65536 : rows !== count)) {
    throw new Error("its header is wrong");
  }
  return { count, degree, fractionBits, rows, hasPalette, antialiased: (flags & 1) === 1 };
}

/** Bytes of each array: positions, opacities, colors, scales, rotations, row numbers, rows. */
function arraySizes({ count, degree, rows, hasPalette }) {
  const sizes = [12, 1, 3, 3, 4, hasPalette ? 2 : 0].map((each) => each * count);
  return [...sizes, 3 * harmonicsOf(degree) * rows];
}

const packedSize = (bytes) => arraySizes(readHeader(bytes)).reduce((a, b) => a + b, PACKED_HEADER);

/** Sums planes of zigzag differences to positions: Float32Array, 3 per splat. */
function sumDifferences(planes, count, unit) {
  const positions = new Float32Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    const p = 4 * axis * count;
    let sum = 0;
    for (let i = 0; i < count; i++) {
      const folded = planes[p + i] | (planes[p + count + i] << 8) | (planes[p + 2 * count + i] << 16)
        | (planes[p + 3 * count + i] << 24);
      sum += (folded >>> 1) ^ -(folded & 1);
      positions[3 * i + axis] = sum * unit;
    }
  }
  return positions;
}

/**
 * Unpacks bytes of length `packedSize`.
 *
 * Returns `positions` (Float32Array, 3 per splat), `texels` (Uint32Array, 8 per splat: x, y, z as
 * bits of float32; color and opacity; log-scales; rotation; row of harmonics; unused) and
 * `harmonics` (Uint32Array, rows with one RGB word per coefficient except the first).
 */
function unpackSplats(bytes) {
  const header = readHeader(bytes);
  const { count, degree, fractionBits } = header;
  const arrays = [];
  let at = PACKED_HEADER;
  for (const size of arraySizes(header)) {
    arrays.push(bytes.subarray(at, at + size));
    at += size;
  }
  const [differences, opacities, colors, scales, rotations, numbers, rows] = arrays;
  const positions = sumDifferences(differences, count, 2 ** -fractionBits);
  const texels = new Uint32Array(SPLAT_TEXEL_WORDS * count);
  const places = new Float32Array(texels.buffer);
  const word = (a, b, c, d) => a | (b << 8) | (c << 16) | (d << 24);
  for (let i = 0; i < count; i++) {
    const t = SPLAT_TEXEL_WORDS * i;
    for (let k = 0; k < 3; k++) places[t + k] = positions[3 * i + k];
    texels[t + 3] = word(colors[3 * i], colors[3 * i + 1], colors[3 * i + 2], opacities[i]);
    texels[t + 4] = word(scales[3 * i], scales[3 * i + 1], scales[3 * i + 2], 0);
    const plane = (k) => rotations[k * count + i];
    texels[t + 5] = word(plane(0), plane(1), plane(2), plane(3));
    texels[t + 6] = header.hasPalette ? numbers[i] | (numbers[count + i] << 8) : i;
  }
  const each = harmonicsOf(degree);
  const rowWords = 4 * Math.ceil(each / 4);
  const harmonics = new Uint32Array(rowWords * header.rows);
  for (let row = 0; row < header.rows; row++) {
    for (let k = 0; k < each; k++) {
      const b = 3 * (row * each + k);
      harmonics[rowWords * row + k] = word(rows[b], rows[b + 1], rows[b + 2], 0);
    }
  }
  return { ...header, positions, texels, harmonics };
}
