//! Renders as OpenEXR files in 32-bit float, and depth from such files.

use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use splat_render::io::{self, ExrPicture};

use crate::arrays::{array, elements, rows};
use crate::error::to_python;

/// Writes color [H, W, 3], alpha [H, W] and depth [H, W] as channels R, G, B, A, Z.
#[pyfunction]
pub fn write_exr(
    py: Python<'_>,
    path: &str,
    color: &Bound<'_, PyAny>,
    alpha: &Bound<'_, PyAny>,
    depth: &Bound<'_, PyAny>,
) -> PyResult<()> {
    let alpha = array::<f32>("alpha", alpha)?;
    let &[height, width] = numpy::PyUntypedArrayMethods::shape(&*alpha) else {
        return Err(PyValueError::new_err("alpha: must have shape [H, W]"));
    };
    if width == 0 || height == 0 {
        return Err(PyValueError::new_err("alpha: must have at least one pixel"));
    }
    let size = [height as isize, width as isize];
    let color = array::<f32>("color", color)?;
    let color = rows::<f32, 3>("color", &color, &size)?;
    let depth = array::<f32>("depth", depth)?;
    let depth = elements("depth", &depth, &size)?;
    let alpha = elements("alpha", &alpha, &size)?;
    let picture = ExrPicture { width, height, color, alpha, depth };
    let bytes = py.detach(|| io::encode_exr(&picture)).map_err(to_python)?;
    // To the name as it is given: callers in Python rename it in the end.
    Ok(py.detach(|| std::fs::write(path, bytes))?)
}

/// Reads channel Z of an EXR file, or its only channel, [H, W], of at most `most` pixels.
#[pyfunction]
pub fn read_exr_depth<'py>(
    py: Python<'py>,
    path: &str,
    most: usize,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let path = std::path::Path::new(path);
    let (height, width, depth) = py.detach(|| io::read_exr_depth(path, most)).map_err(to_python)?;
    PyArray1::from_vec(py, depth).reshape([height, width])
}
