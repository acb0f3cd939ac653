//! How much memory a file may ask for.

use super::bytes::Named;
use crate::error::Result;
use crate::sh;

/// Maximum number of splats with 32-bit ids.
pub const SPLATS_MAX: u64 = 1 << 30;
/// Largest file that is read into memory whole. A `.ply` is not, and may be larger.
pub const FILE_MAX: u64 = 4 << 30;
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
