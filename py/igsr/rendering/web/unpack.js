// The embedded file's bytes: base64 text, then gzip, with progress.

// Multiple of 4: each piece of base64 then stands alone.
const PIECE = 1 << 20;
// Deflate cannot pack more tightly than this.
const DEFLATE_RATIO_MAX = 1032;

/** Lets the browser draw the loading bar. */
const breathe = () => new Promise((resolve) => setTimeout(resolve, 0));

/** Bytes of a base64 text. `progress` gets a part of 1. Throws an Error if it is no base64. */
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
 * Unpacks gzip. `sizeOf` takes the first bytes and says how many there must be in all, so that a
 * damaged file cannot ask for any amount of memory.
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
