//! Splat files.

mod atomic;
mod ply;

pub use atomic::write_atomically;
pub use ply::{read_ply, write_ply};

use crate::fit::SplatArrays;

/// Splats with the f64 point that their means are relative to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatFile {
    /// Parameters as fitted: log-scales, opacity logits, SH.
    pub splats: SplatArrays,
    /// World position = origin + mean.
    pub origin: [f64; 3],
}
