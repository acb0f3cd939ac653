//! The renderer's errors as Python exceptions.

use pyo3::PyErr;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use splat_render::Error;

/// ValueError for an argument, RuntimeError for a device, OSError for a file.
pub fn to_python(error: Error) -> PyErr {
    let sentence = error.to_string();
    match error {
        Error::Argument { .. } => PyValueError::new_err(sentence),
        Error::Device(_) => PyRuntimeError::new_err(sentence),
        Error::File { .. } => PyOSError::new_err(sentence),
    }
}
