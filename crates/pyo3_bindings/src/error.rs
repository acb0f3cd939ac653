//! The renderer's errors as Python exceptions.

use pyo3::PyErr;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use splat_render::Error;

/// ValueError for an argument, RuntimeError for a device, OSError for a file.
pub fn to_python(error: Error) -> PyErr {
    let message = error.to_string();
    match error {
        Error::Argument { .. } => PyValueError::new_err(message),
        Error::NoAdapter(_) | Error::Device(_) => PyRuntimeError::new_err(message),
        Error::File { .. } => PyOSError::new_err(message),
    }
}
