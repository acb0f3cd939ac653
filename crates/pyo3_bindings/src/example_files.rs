//! The example capture: files of `examples/tea_table`, built into the module.

use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

macro_rules! file {
    ($name:literal) => {
        ($name, include_bytes!(concat!("../../../examples/tea_table/", $name)))
    };
}

/// File names and contents: the photos of `igsr refine examples/tea_table --photos 8` and held-out ones.
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

/// The example capture's contents by name. `transforms_train.json` names further photos.
#[pyfunction]
pub fn example_files(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let files = PyDict::new(py);
    for (name, contents) in FILES {
        files.set_item(name, PyBytes::new(py, contents))?;
    }
    Ok(files)
}
