//! Splat files.

use std::path::PathBuf;

use numpy::{IntoPyArray, PyArray1};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::extent;
use splat_render::io::SplatFile;

use crate::arrays::{array, elements, row, rows, shaped};
use crate::error::to_python;
use crate::splat_arrays::{set_splat_arrays, splat_arrays_from};

/// Reads a splat file of any format. `notes` list ignored content.
#[pyfunction]
pub fn read_splats<'py>(py: Python<'py>, path: PathBuf) -> PyResult<Bound<'py, PyDict>> {
    let loaded = py.detach(|| splat_render::io::read_splats(&path)).map_err(to_python)?;
    let dict = PyDict::new(py);
    set_splat_arrays(&dict, "", loaded.file.splats)?;
    dict.set_item("origin", shaped(py, loaded.file.origin.to_vec(), &[3])?)?;
    dict.set_item("antialiased", loaded.file.antialiased)?;
    dict.set_item("format", loaded.format.name())?;
    dict.set_item("notes", loaded.notes)?;
    Ok(dict)
}

/// Writes a file in the format of its ending, whole or not at all; returns notes on omitted content.
#[pyfunction]
pub fn write_splats(
    py: Python<'_>,
    path: PathBuf,
    splats: &Bound<'_, PyDict>,
) -> PyResult<Vec<String>> {
    let entry = |name: &str| {
        splats.get_item(name)?.ok_or_else(|| PyValueError::new_err(format!("{name}: is missing")))
    };
    let file = SplatFile {
        splats: splat_arrays_from(splats, "")?,
        origin: row::<f64, 3>("origin", &entry("origin")?)?,
        antialiased: entry("antialiased")?.extract()?,
    };
    py.detach(|| splat_render::io::write_splats(&path, &file)).map_err(to_python)
}

/// Center [3] of visible splats, relative to their origin, their radius, and the near plane of renders.
#[pyfunction]
pub fn splat_extent(
    py: Python<'_>,
    means: &Bound<'_, PyAny>,
    opacities: &Bound<'_, PyAny>,
) -> PyResult<([f64; 3], f64, f32)> {
    let means = array::<f32>("means", means)?;
    let means = rows::<f32, 3>("means", &means, &[-1])?;
    let opacities = array::<f32>("opacities", opacities)?;
    let opacities = elements("opacities", &opacities, &[means.len() as isize])?;
    let (center, radius) = py.detach(|| extent::extent(means, opacities));
    Ok((center.to_array(), radius, extent::near_plane(radius)))
}

/// The extent of cameras by their centers, N x 3; 0 if they coincide.
#[pyfunction]
pub fn camera_extent(centers: &Bound<'_, PyAny>) -> PyResult<f64> {
    let centers = array::<f64>("centers", centers)?;
    let centers = rows::<f64, 3>("centers", &centers, &[-1])?;
    Ok(extent::camera_extent(&centers.iter().map(|&c| c.into()).collect::<Vec<_>>()))
}

/// Ids of points, N x 3, along Morton's curve, as the writers order splats.
#[pyfunction]
pub fn morton_order<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<i64>>> {
    let points = array::<f32>("points", points)?;
    let points = rows::<f32, 3>("points", &points, &[-1])?;
    let ids = py.detach(|| splat_render::io::morton_order(points));
    let ids: Vec<i64> = ids.into_iter().map(|id| id as i64).collect();
    Ok(ids.into_pyarray(py))
}
