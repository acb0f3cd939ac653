//! The example capture: files of `examples/tea_table` that are built into the module, so that every
//! installation has them and the repository has them once.

use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

macro_rules! file {
    ($name:literal) => {
        ($name, include_bytes!(concat!("../../../examples/tea_table/", $name)))
    };
}

/// File names within the capture's folder, and contents: the photos of `igsr refine examples/tea_table
/// --photos 8` and all held-out photos.
const FILES: &[(&str, &[u8])] = &[
    file!("transforms_train.json"),
    file!("transforms_test.json"),
    file!("train/002.png"),
    file!("train/007.png"),
    file!("train/012.png"),
    file!("train/017.png"),
    file!("train/022.png"),
    file!("train/027.png"),
    file!("train/032.png"),
    file!("train/037.png"),
    file!("test/000.png"),
    file!("test/001.png"),
    file!("test/002.png"),
    file!("test/003.png"),
    file!("test/004.png"),
    file!("test/005.png"),
    file!("test/006.png"),
    file!("test/007.png"),
];

/// The files of the example capture: contents by name. `transforms_train.json` names photos that are
/// not among them.
#[pyfunction]
pub fn example_files(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let files = PyDict::new(py);
    for (name, contents) in FILES {
        files.set_item(name, PyBytes::new(py, contents))?;
    }
    Ok(files)
}
