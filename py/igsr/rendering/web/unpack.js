// Decodes base64 and gzip, with progress.

// A multiple of 4, so that each piece of base64 can be decoded separately.
const PIECE = 1 << 20;
// Maximum compression ratio of Deflate.
const DEFLATE_RATIO_MAX = 1032;

/** Yields to the browser, to draw the loading bar. */
const breathe = () => new Promise((resolve) => setTimeout(resolve, 0));

/** Decodes base64. `progress` gets numbers up to 1. Throws an Error for other text. */
async function decodeBase64(text, progress) {
  const clean = text.trim();
  if (clean.length % 4 !== 0) throw new Error("its text ends early");
  const padding = clean.endsWith("==") ? 2 : clean.endsWith("=") ? 1 : 0;
  const bytes = new Uint8Array((clean.length / 4) * 3 - padding);
  let at = 0;
  for (let start = 0; start < clean.length; start += PIECE) {
    let piece;
    try {
      piece = atob(clean.slice(start, start + PIECE));
    } catch {
      throw new Error("its text is not base64");
    }
    for (let i = 0; i < piece.length; i++) bytes[at++] = piece.charCodeAt(i);
    progress(start / clean.length);
    await breathe();
  }
  if (at !== bytes.length) throw new Error("its text is not base64");
  return bytes;
}

/**
 * Unpacks gzip. `sizeOf` computes the total size from the header, so that a damaged file cannot
 * allocate arbitrary memory.
 */
async function unpackGzip(bytes, headerSize, sizeOf, progress) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser is too old: Chrome 80, Firefox 113 or Safari 16.4 can show it");
  }
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  let out = new Uint8Array(headerSize);
  let size = -1;
  let at = 0;
  for (;;) {
    let step;
    try {
      step = await reader.read();
    } catch {
      throw new Error("it cannot be decompressed");
    }
    if (step.done) break;
    let rest = step.value;
    if (size < 0) {
      const head = Math.min(headerSize - at, rest.length);
      out.set(rest.subarray(0, head), at);
      at += head;
      rest = rest.subarray(head);
      if (at < headerSize) continue;
      size = sizeOf(out);
      if (size > headerSize + bytes.length * DEFLATE_RATIO_MAX) throw new Error("its size is wrong");
      const whole = new Uint8Array(size);
      whole.set(out);
      out = whole;
    }
    if (at + rest.length > size) throw new Error("it is longer than it says");
    out.set(rest, at);
    at += rest.length;
    progress(at / size);
  }
  if (size < 0 || at !== size) throw new Error("it ends early");
  return out;
}
