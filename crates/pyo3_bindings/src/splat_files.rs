//! Splat files.

use std::path::PathBuf;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::io::SplatFile;

use crate::arrays::{row, shaped};
use crate::error::to_python;
use crate::fitter::{set_splat_arrays, splat_arrays_from};

/// Reads an INRIA .ply.
#[pyfunction]
pub fn read_ply<'py>(py: Python<'py>, path: PathBuf) -> PyResult<Bound<'py, PyDict>> {
    let file = py.detach(|| splat_render::io::read_ply(&path)).map_err(to_python)?;
    let dict = PyDict::new(py);
    set_splat_arrays(&dict, "", file.splats)?;
    dict.set_item("origin", shaped(py, file.origin.to_vec(), &[3])?)?;
    Ok(dict)
}

/// Writes an INRIA .ply, whole or not at all.
#[pyfunction]
pub fn write_ply(py: Python<'_>, path: PathBuf, splats: &Bound<'_, PyDict>) -> PyResult<()> {
    let origin = splats
        .get_item("origin")?
        .ok_or_else(|| pyo3::exceptions::PyValueError::new_err("origin: is missing"))?;
    let origin = row::<f64, 3>("origin", &origin)?;
    let file = SplatFile { splats: splat_arrays_from(splats, "")?, origin };
    py.detach(|| splat_render::io::write_ply(&path, &file)).map_err(to_python)
}
