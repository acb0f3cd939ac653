//! Which implementation of the stages runs.

use numpy::PyArrayDescrMethods;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use splat_render::cpu;
use splat_render::fit::FitDevice;

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

/// A device for a fit on a resolved backend.
pub fn fit_device(name: &str) -> PyResult<Box<dyn FitDevice>> {
    match Backend::named(name)? {
        Backend::Cpu => Ok(Box::new(cpu::CpuFit::default())),
        Backend::Gpu => Err(PyValueError::new_err("not yet")),
        Backend::Reference => Err(PyValueError::new_err(
            "backend: reference renders and differentiates but does not fit; use cpu or gpu",
        )),
    }
}

/// The GPU backend, opened once per process.
pub fn gpu() -> PyResult<&'static cpu::Cpu> {
    Err(pyo3::exceptions::PyRuntimeError::new_err("No GPU backend in this build yet."))
}

/// The name that `name` stands for: "auto" is a real GPU if one answers, else the CPU.
#[pyfunction]
pub fn resolve_backend(name: &str) -> PyResult<&str> {
    if name == "auto" {
        return Ok("cpu");
    }
    if Backend::named(name)? == Backend::Gpu {
        gpu()?;
    }
    Ok(name)
}

/// What a resolved backend runs on.
#[pyfunction]
pub fn backend_info<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyDict>> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let host = format!("{} CPU, {threads} threads", std::env::consts::ARCH);
    let (device, instruction_set) = match Backend::named(name)? {
        Backend::Cpu => (host, cpu::instruction_set()),
        Backend::Reference => (host, "scalar f64"),
        Backend::Gpu => {
            gpu()?;
            (String::new(), "WGSL")
        }
    };
    let info = PyDict::new(py);
    info.set_item("backend", name)?;
    info.set_item("device", device)?;
    info.set_item("instruction_set", instruction_set)?;
    Ok(info)
}

/// The numpy scalar type of a resolved backend's arrays.
#[pyfunction]
pub fn working_dtype<'py>(py: Python<'py>, backend: &str) -> PyResult<Bound<'py, PyType>> {
    Ok(match Backend::named(backend)? {
        Backend::Reference => numpy::dtype::<f64>(py).typeobj(),
        Backend::Cpu | Backend::Gpu => numpy::dtype::<f32>(py).typeobj(),
    })
}
