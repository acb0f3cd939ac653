//! Splat files.
