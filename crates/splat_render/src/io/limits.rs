//! How much memory a file may ask for.

use serde_json::Value;

use super::bytes::Named;
use crate::error::Result;
use crate::sh;

/// Maximum number of splats with 32-bit ids.
pub const SPLATS_MAX: u64 = 1 << 30;
/// Largest file that is read into memory whole. A `.ply` is not, and may be larger.
pub const FILE_MAX: u64 = 4 << 30;
/// Most bytes of an unpacked EXR file, and of one block: all channels of some rows or of a tile.
pub const EXR_MAX: usize = 1 << 30;
pub const EXR_BLOCK_MAX: usize = 64 << 20;
/// Splats in memory per byte of file. Files of real scenes unpack to 4 to 20 times their size.
const UNPACKED_PER_BYTE: u64 = 64;
/// Size that any file may unpack to, so that small scenes of equal splats can be read.
const UNPACKED_FREE: u64 = 64 << 20;

/// Refuses a file that is too large to read into memory.
pub fn check_file_size(named: &Named<'_>, size: u64) -> Result<()> {
    if size > FILE_MAX {
        return Err(named.bad(format!(
            "is {size} bytes, more than the limit of {FILE_MAX}; split the scene or \
             convert it to .ply with the program that wrote it"
        )));
    }
    Ok(())
}

/// Bytes that may be unpacked from a compressed file of `size` bytes.
pub fn unpacked_max(size: usize) -> u64 {
    UNPACKED_FREE + UNPACKED_PER_BYTE * size as u64
}

/// The number of splats that a file of `size` bytes claims, if memory may be taken for them.
pub fn check_claim(named: &Named<'_>, count: u64, degree: u32, size: usize) -> Result<usize> {
    let bytes_each = 4 * (11 + 3 * sh::coeffs(degree) as u64);
    if count > SPLATS_MAX || count * bytes_each > unpacked_max(size) {
        return Err(named.bad(format!(
            "claims {count} splats of SH degree {degree}, which its {size} bytes cannot hold; it \
             is damaged: copy or export it again"
        )));
    }
    Ok(count as usize)
}

/// Parses JSON of at most `most` values, or says why not. In memory a value may take 80 times its text.
pub fn parse_json(text: &[u8], most: usize) -> std::result::Result<Value, String> {
    if values(text) > most {
        return Err(format!("holds JSON of more than {most} values"));
    }
    serde_json::from_slice(text).map_err(|e| format!("holds JSON that cannot be read ({e})"))
}

/// Upper bound on the number of values in a JSON text: each but the first follows a mark outside strings.
fn values(text: &[u8]) -> usize {
    let (mut count, mut quoted, mut escaped) = (1, false, false);
    for byte in text {
        match byte {
            _ if escaped => escaped = false,
            b'\\' if quoted => escaped = true,
            b'"' => quoted = !quoted,
            b',' | b'[' | b'{' if !quoted => count += 1,
            _ => {}
        }
    }
    count
}
