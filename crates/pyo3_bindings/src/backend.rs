//! Which implementation of the stages runs.

use pyo3::exceptions::PyValueError;
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
