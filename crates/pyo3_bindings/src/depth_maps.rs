//! Depth maps of photos.

use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use splat_render::fit::{GrayPhoto, Search};

use crate::arrays::{array, elements, rows, shaped, shaped_rows};
use crate::camera::cameras;
use crate::error::to_python;

/// The photo, those compared with, the inverse depths of the nearest and farthest surface, and seeds.
type Searches<'py> = Vec<(usize, Vec<usize>, [f32; 2], PyReadonlyArrayDyn<'py, f32>)>;

/// Depth maps of the photos that `searches` name.
#[pyfunction]
pub fn depth_maps<'py>(
    py: Python<'py>,
    grays: &Bound<'py, PyList>,
    usable: &Bound<'py, PyList>,
    viewmats: &Bound<'py, PyAny>,
    intrinsics: &Bound<'py, PyAny>,
    searches: Searches<'py>,
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
        let name = format!("usable[{i}]");
        let bytes = array::<u8>(&name, &usable)?;
        let bytes = elements(&name, &bytes, &[height as isize, width as isize])?;
        pixels.push((values, bytes.iter().map(|&byte| byte != 0).collect()));
    }
    let cameras = cameras(viewmats, intrinsics, &sizes)?;
    let photo = |(camera, (gray, usable))| GrayPhoto { camera, gray, usable: Some(usable) };
    let photos: Vec<GrayPhoto> = cameras.into_iter().zip(pixels).map(photo).collect();
    let searches: Vec<Search> = searches
        .into_iter()
        .enumerate()
        .map(|(i, (photo, others, range, seeds))| {
            let seeds = rows::<f32, 3>(&format!("searches[{i}]"), &seeds, &[-1])?.to_vec();
            Ok(Search { photo, others, range, seeds })
        })
        .collect::<PyResult<_>>()?;
    let maps =
        py.detach(|| splat_render::fit::depth_maps(&photos, &searches)).map_err(to_python)?;
    let out = PyList::empty(py);
    for (map, search) in maps.into_iter().zip(&searches) {
        let (width, height) = sizes[search.photo];
        let shape = [height as usize, width as usize];
        let entry = PyDict::new(py);
        entry.set_item("depth", shaped(py, map.depth, &shape)?)?;
        entry.set_item("normal", shaped_rows(py, map.normal, &shape)?)?;
        entry.set_item("confidence", shaped(py, map.confidence, &shape)?)?;
        out.append(entry)?;
    }
    Ok(out)
}
