//! The viewer `splat-view`, which the Python package starts as a program.

use std::ffi::OsString;

use pyo3::prelude::*;

/// Runs `splat-view` with a command line; returns the exit status.
#[pyfunction]
pub fn run_viewer(py: Python<'_>, words: Vec<OsString>) -> u8 {
    py.detach(|| splat_view::run(words))
}
