//! Depth maps of photos by plane sweep.

use numpy::PyUntypedArrayMethods;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use splat_render::fit::{GrayPhoto, Sweep};

use crate::arrays::{array, elements, shaped};
use crate::camera::cameras;
use crate::error::to_python;

/// Depth maps of the photos that `sweeps` name: (photo, others, (nearest, farthest), planes).
#[pyfunction]
pub fn plane_sweep<'py>(
    py: Python<'py>,
    grays: &Bound<'py, PyList>,
    usable: &Bound<'py, PyList>,
    viewmats: &Bound<'py, PyAny>,
    intrinsics: &Bound<'py, PyAny>,
    sweeps: Vec<(usize, Vec<usize>, [f32; 2], usize)>,
) -> PyResult<Bound<'py, PyList>> {
    if usable.len() != grays.len() {
        return Err(PyValueError::new_err("usable: must have an entry for each of grays"));
    }
    let mut pixels = Vec::with_capacity(grays.len());
    let mut sizes = Vec::with_capacity(grays.len());
    for (i, (gray, usable)) in grays.iter().zip(usable.iter()).enumerate() {
        let name = format!("grays[{i}]");
        let gray = array::<f32>(&name, &gray)?;
        let values = elements(&name, &gray, &[-1, -1])?.to_vec();
        let (height, width) = (gray.shape()[0], gray.shape()[1]);
        let side = |side: usize| {
            u32::try_from(side).map_err(|_| PyValueError::new_err(format!("{name}: is too large")))
        };
        sizes.push((side(width)?, side(height)?));
        let usable = if usable.is_none() {
            None
        } else {
            let name = format!("usable[{i}]");
            let bytes = array::<u8>(&name, &usable)?;
            let bytes = elements(&name, &bytes, &[height as isize, width as isize])?;
            Some(bytes.iter().map(|&byte| byte != 0).collect())
        };
        pixels.push((values, usable));
    }
    let cameras = cameras(viewmats, intrinsics, &sizes)?;
    let photos: Vec<GrayPhoto> = cameras
        .into_iter()
        .zip(pixels)
        .map(|(camera, (gray, usable))| GrayPhoto { camera, gray, usable })
        .collect();
    let sweeps: Vec<Sweep> = sweeps
        .into_iter()
        .map(|(photo, others, range, planes)| Sweep { photo, others, range, planes })
        .collect();
    let maps = py.detach(|| splat_render::fit::plane_sweep(&photos, &sweeps)).map_err(to_python)?;
    let out = PyList::empty(py);
    for (map, sweep) in maps.into_iter().zip(&sweeps) {
        let (width, height) = sizes[sweep.photo];
        let shape = [height as usize, width as usize];
        let entry = PyDict::new(py);
        entry.set_item("inverse_depth", shaped(py, map.inverse_depth, &shape)?)?;
        entry.set_item("score", shaped(py, map.score, &shape)?)?;
        out.append(entry)?;
    }
    Ok(out)
}
