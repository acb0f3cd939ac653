//! Backends: which implementation of the stages runs, and on what.

use std::sync::{Arc, OnceLock};

use numpy::PyArrayDescrMethods;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use splat_render::cpu::{self, CpuFit};
use splat_render::fit::FitDevice;
use splat_render::gpu::{Gpu, GpuFit};

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
    /// The backend of a name that `resolve_backend` returns.
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

/// The best adapter, opened once per process; an error is kept as its message.
pub fn gpu() -> PyResult<&'static Arc<Gpu>> {
    static GPU: OnceLock<Result<Arc<Gpu>, String>> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new(true).map(Arc::new).map_err(|error| error.to_string()))
        .as_ref()
        .map_err(|message| PyRuntimeError::new_err(message.clone()))
}

/// A device for a fit on a resolved backend.
pub fn fit_device(name: &str) -> PyResult<Box<dyn FitDevice>> {
    match Backend::named(name)? {
        Backend::Cpu => Ok(Box::new(CpuFit::default())),
        Backend::Gpu => Ok(Box::new(GpuFit::new(Arc::clone(gpu()?)))),
        Backend::Reference => Err(PyValueError::new_err(
            "backend: reference renders and differentiates but does not fit; use cpu or gpu",
        )),
    }
}

/// Resolves a backend's name: "auto" is a real GPU if one answers, else the CPU.
///
/// A software adapter runs only if "gpu" is named: the CPU backend is faster.
#[pyfunction]
pub fn resolve_backend<'a>(py: Python<'_>, name: &'a str) -> PyResult<&'a str> {
    if name == "auto" {
        let real = py.detach(|| gpu().is_ok_and(|gpu| !gpu.is_software()));
        return Ok(if real { "gpu" } else { "cpu" });
    }
    if Backend::named(name)? == Backend::Gpu {
        py.detach(gpu)?;
    }
    Ok(name)
}

/// Device and instruction set of a resolved backend.
#[pyfunction]
pub fn backend_info<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyDict>> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let host = format!("{} CPU, {threads} threads", std::env::consts::ARCH);
    let (device, instruction_set) = match Backend::named(name)? {
        Backend::Cpu => (host, cpu::instruction_set()),
        Backend::Reference => (host, "scalar f64"),
        Backend::Gpu => (py.detach(gpu)?.name(), "WGSL"),
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
