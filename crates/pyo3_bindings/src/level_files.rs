//! Scenes in levels of detail.

use std::path::PathBuf;

use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::shaped;
use crate::error::to_python;
use crate::splat_arrays::set_splat_arrays;

/// Writes the scene of a file in levels of detail into an empty folder.
#[pyfunction]
pub fn write_levels<'py>(
    py: Python<'py>,
    source: PathBuf,
    folder: PathBuf,
    levels: usize,
    per_cell: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let mut interrupted = None;
    let mut goes_on = || {
        interrupted = Python::attach(|py| py.check_signals().err());
        interrupted.is_none()
    };
    let done = py
        .detach(|| {
            splat_render::levels::write_levels(&source, &folder, levels, per_cell, &mut goes_on)
        })
        .map_err(to_python)?;
    let Some(done) = done else {
        return Err(interrupted.unwrap_or_else(|| PyKeyboardInterrupt::new_err(())));
    };
    let dict = PyDict::new(py);
    dict.set_item("counts", done.counts)?;
    dict.set_item("cells", done.cells)?;
    dict.set_item("files", done.files)?;
    dict.set_item("notes", done.notes)?;
    Ok(dict)
}

/// Reads the finest level of a folder that has no more splats than `most`; `level` is its number.
#[pyfunction]
pub fn read_level<'py>(
    py: Python<'py>,
    path: PathBuf,
    most: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let read = py.detach(|| splat_render::levels::read_within(&path, most)).map_err(to_python)?;
    let (file, level) = read;
    let dict = PyDict::new(py);
    set_splat_arrays(&dict, "", file.splats)?;
    dict.set_item("origin", shaped(py, file.origin.to_vec(), &[3])?)?;
    dict.set_item("antialiased", file.antialiased)?;
    dict.set_item("level", level)?;
    Ok(dict)
}
