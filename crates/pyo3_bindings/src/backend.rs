//! Which implementation of the stages runs.

use pyo3::exceptions::PyValueError;
use numpy::PyArrayDescrMethods;
use pyo3::prelude::*;

/// A backend by its resolved name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Backend {
    /// f32, SIMD, threads.
    Cpu,
    /// wgpu.
    Gpu,
    /// f64, plain.
    Reference,
}

impl Backend {
    /// From a name that `resolve_backend` returns.
    pub fn named(name: &str) -> PyResult<Self> {
        match name {
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu),
            "reference" => Ok(Self::Reference),
            _ => Err(PyValueError::new_err(format!(
                "backend: must be auto, cpu, gpu or reference, not {name:?}"
            ))),
        }
    }
}

/// The numpy scalar type of a resolved backend's arrays.
#[pyfunction]
pub fn working_dtype<'py>(
    py: Python<'py>,
    backend: &str,
) -> PyResult<Bound<'py, pyo3::types::PyType>> {
    Ok(match Backend::named(backend)? {
        Backend::Reference => numpy::dtype::<f64>(py).typeobj(),
        Backend::Cpu | Backend::Gpu => numpy::dtype::<f32>(py).typeobj(),
    })
}

/// The name that `name` stands for.
#[pyfunction]
pub fn resolve_backend(name: &str) -> PyResult<&str> {
    if name == "auto" {
        return Ok("cpu");
    }
    Backend::named(name)?;
    Ok(name)
}

/// What a resolved backend runs on.
#[pyfunction]
pub fn backend_info<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, pyo3::types::PyDict>> {
    let _ = name;
    Ok(pyo3::types::PyDict::new(py))
}
