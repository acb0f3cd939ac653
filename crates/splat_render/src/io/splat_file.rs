//! The content of splat files.

use super::format::Format;
use crate::splats::SplatArrays;

/// Splats with the f64 point that their means are relative to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatFile {
    /// Parameters as fitted: log-scales, opacity logits, SH.
    pub splats: SplatArrays,
    /// World position = origin + mean.
    pub origin: [f64; 3],
    /// Whether they were fitted with antialiased opacities and must be rendered so.
    pub antialiased: bool,
}

/// A file that was read.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded {
    /// The content.
    pub file: SplatFile,
    /// The format it was in.
    pub format: Format,
    /// One message for each thing in it that was skipped.
    pub notes: Vec<String>,
}
