//! PlayCanvas's `.sog`, version 2: a zip of lossless WebP images and a `meta.json`; or these in a folder.
//!
//! Pixel i of each image belongs to splat i. Positions are 16 bits per axis of a signed logarithm, scales
//! and colors are indices into codebooks of 256 values, rotations the smallest three in a byte each, and
//! higher SH an index into a palette of up to 65 536 rows of a codebook's indices. The frame is the same
//! as in the source .ply.

mod codebook;
mod images;
mod meta;
mod palette;
mod read;
mod write;

pub use read::{parse, parse_folder};
pub use write::{encode, write_folder};

/// Entries of a codebook: one byte's.
const CODES: usize = 256;
/// Palette rows in a row of the image of the palette.
const PALETTE_COLUMNS: usize = 64;
const SH_DEGREE: u32 = 3;
/// The alpha byte of a rotation whose component 0 (w) is left out.
const ROTATION_TAG: u8 = 252;
/// The file that names the images.
pub const META: &str = "meta.json";
