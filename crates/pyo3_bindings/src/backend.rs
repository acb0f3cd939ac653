//! Backends: the implementation of the stages and its device.

use std::ffi::CString;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use crate::error::to_python;
use numpy::PyArrayDescrMethods;
use pyo3::exceptions::{PyRuntimeError, PyUserWarning, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use splat_render::Error;
use splat_render::cpu::{self, CpuFit};
use splat_render::fit::FitDevice;
use splat_render::gpu::{Gpu, GpuFit, Injected};
use splat_render::gpu_check::{open_tested_with, self_test};

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

/// The result of opening a device.
type Opened = Result<Arc<Gpu>, Error>;

/// Devices of this process: the best real one, and the one for "gpu", which may be a software adapter.
#[derive(Default)]
struct Devices {
    real: Option<Opened>,
    software: Option<Opened>,
    /// Whether a warning has said why "auto" is not the GPU.
    warned: bool,
    /// Faults injected by tests.
    injected: Injected,
}

static DEVICES: LazyLock<Mutex<Devices>> = LazyLock::new(Mutex::default);

impl Devices {
    fn lock() -> MutexGuard<'static, Self> {
        // A panic leaves no half-open device.
        DEVICES.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Opens a slot's device unless it is open. Failures are kept, because each try takes seconds.
    fn opened<'a>(slot: &'a mut Option<Opened>, software: bool, injected: &Injected) -> &'a Opened {
        if slot.as_ref().is_none_or(|opened| opened.as_ref().is_ok_and(|gpu| gpu.is_lost())) {
            *slot = Some(open_tested_with(software, injected));
        }
        slot.get_or_insert_with(|| unreachable!("it was filled above"))
    }

    fn real(&mut self) -> &Opened {
        Self::opened(&mut self.real, false, &self.injected)
    }

    /// The device of the backend "gpu".
    fn named(&mut self) -> &Opened {
        match self.real() {
            Err(Error::NoAdapter(_)) => Self::opened(&mut self.software, true, &self.injected),
            _ => self.real(),
        }
    }
}

/// The device of the backend "gpu": opened and tested once per process, and again if lost.
pub fn gpu() -> PyResult<Arc<Gpu>> {
    let mut devices = Devices::lock();
    match devices.named() {
        Ok(gpu) => Ok(Arc::clone(gpu)),
        Err(error) => Err(PyRuntimeError::new_err(error.to_string())),
    }
}

/// Whether "auto" is the GPU and, the first time that one answers and cannot be used in full, why not.
fn auto() -> (bool, Option<String>) {
    let mut devices = Devices::lock();
    let (real, warning) = match devices.real() {
        Ok(gpu) => match gpu.fallback() {
            None => return (true, None),
            Some(reason) => {
                (true, format!("{reason}. Slower kernels, which pass, are used instead"))
            }
        },
        Err(Error::NoAdapter(_)) => return (false, None),
        Err(error) => (false, format!("{error}. The CPU computes instead")),
    };
    let warned = std::mem::replace(&mut devices.warned, true);
    (real, (!warned).then_some(warning))
}

/// For tests: closes the devices, and makes adapters fail from here on. `faults` are of "real" (a
/// software adapter passes for a real one), "shader", "values", "blocks" (values of kernels for GPUs),
/// "limits" and "memory".
#[pyfunction]
pub fn inject_gpu_faults(faults: Vec<String>) -> PyResult<()> {
    let mut injected = Injected::default();
    for fault in faults {
        match fault.as_str() {
            "real" => injected.passes_for_real = true,
            "shader" => injected.bad_shader = true,
            "values" => injected.wrong_values = true,
            "blocks" => injected.wrong_blocks = true,
            "limits" => injected = injected.with_low_limits(),
            "memory" => injected.buffer_bytes = Some(1 << 20),
            _ => return Err(PyValueError::new_err(format!("faults: there is no {fault:?}"))),
        }
    }
    *Devices::lock() = Devices { injected, ..Devices::default() };
    Ok(())
}

/// For tests: loses the open devices, as a driver that is reset does.
#[pyfunction]
pub fn lose_gpu() {
    let devices = Devices::lock();
    for opened in [&devices.real, &devices.software] {
        if let Some(Ok(gpu)) = opened {
            gpu.lose();
        }
    }
}

/// A device for a fit on a resolved backend.
pub fn fit_device(name: &str) -> PyResult<Box<dyn FitDevice>> {
    match Backend::named(name)? {
        Backend::Cpu => Ok(Box::new(CpuFit::default())),
        Backend::Gpu => Ok(Box::new(GpuFit::new(gpu()?))),
        Backend::Reference => Err(PyValueError::new_err(
            "backend: reference renders and differentiates but does not fit; use cpu or gpu",
        )),
    }
}

/// Resolves a backend's name: "auto" is a real GPU if one answers, else the CPU.
///
/// A software adapter runs only if "gpu" is named: the CPU backend is faster. A real GPU that cannot be
/// opened or fails its self-test is named in a UserWarning, once.
#[pyfunction]
pub fn resolve_backend<'a>(py: Python<'_>, name: &'a str) -> PyResult<&'a str> {
    if name == "auto" {
        let (real, warning) = py.detach(auto);
        if let Some(warning) = warning.and_then(|text| CString::new(text).ok()) {
            PyErr::warn(py, &py.get_type::<PyUserWarning>(), &warning, 1)?;
        }
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
        Backend::Gpu => {
            let gpu = py.detach(gpu)?;
            let kernels = match (gpu.has_gpu_kernels(), gpu.fallback()) {
                (true, _) => "WGSL for GPUs",
                (_, None) => "WGSL for software drivers",
                (_, Some(_)) => "WGSL for software drivers, because that for GPUs fails here",
            };
            (gpu.name(), kernels)
        }
    };
    let info = PyDict::new(py);
    info.set_item("backend", name)?;
    info.set_item("device", device)?;
    info.set_item("instruction_set", instruction_set)?;
    Ok(info)
}

/// Limits, features and driver of the device of the backend "gpu", for reports.
///
/// A dict: `name`, `kind`, `api`, `driver`, `driver_info`, `vendor` and `device` (PCI ids), `features`
/// and `limits` by WebGPU's names.
#[pyfunction]
pub fn gpu_report<'py>(py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
    let gpu = py.detach(gpu)?;
    let info = gpu.info();
    let report = PyDict::new(py);
    report.set_item("name", &info.name)?;
    report.set_item("kind", format!("{:?}", info.device_type))?;
    report.set_item("api", format!("{:?}", info.backend))?;
    report.set_item("driver", &info.driver)?;
    report.set_item("driver_info", &info.driver_info)?;
    report.set_item("vendor", info.vendor)?;
    report.set_item("device", info.device)?;
    report.set_item("subgroups", (info.subgroup_min_size, info.subgroup_max_size))?;
    let limits = PyDict::new(py);
    for (name, value) in gpu.limit_values() {
        limits.set_item(name, value)?;
    }
    report.set_item("limits", limits)?;
    Ok(report)
}

/// Milliseconds that opening the best adapter, compiling all kernels and the self-test take, each.
#[pyfunction]
pub fn time_gpu_start(py: Python<'_>) -> PyResult<(f64, f64, f64)> {
    py.detach(|| {
        let mut last = Instant::now();
        let mut lap = || 1e3 * std::mem::replace(&mut last, Instant::now()).elapsed().as_secs_f64();
        let gpu = Arc::new(Gpu::new(true)?);
        let opened = lap();
        gpu.compile_all()?;
        let compiled = lap();
        self_test(&gpu)?;
        Ok((opened, compiled, lap()))
    })
    .map_err(to_python)
}

/// The numpy scalar type of a resolved backend's arrays.
#[pyfunction]
pub fn working_dtype<'py>(py: Python<'py>, backend: &str) -> PyResult<Bound<'py, PyType>> {
    Ok(match Backend::named(backend)? {
        Backend::Reference => numpy::dtype::<f64>(py).typeobj(),
        Backend::Cpu | Backend::Gpu => numpy::dtype::<f32>(py).typeobj(),
    })
}
