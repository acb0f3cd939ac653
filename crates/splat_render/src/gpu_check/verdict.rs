//! Remembers across processes that a device passed its self-test, which takes about a second.

use std::env;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;

use super::self_test::self_test;
use crate::error::{Error, Result};
use crate::gpu::{Gpu, Injected, shader_variants};
use crate::io::write_atomically;

/// Folder of the verdicts; an empty value keeps none.
const VARIABLE: &str = "IGSR_GPU_CACHE";

/// [`Gpu::new`], with a device that passed [`self_test`] now or earlier with the same driver and kernels.
pub fn open_tested(software_allowed: bool) -> Result<Arc<Gpu>> {
    open_tested_with(software_allowed, &Injected::default())
}

/// [`open_tested`] on an adapter with these faults.
pub fn open_tested_with(software_allowed: bool, injected: &Injected) -> Result<Arc<Gpu>> {
    let gpu = Arc::new(Gpu::with_faults(software_allowed, injected)?);
    let verdict = verdict_file(&gpu).filter(|_| injected.is_sound());
    if verdict.as_ref().is_some_and(|path| path.is_file()) {
        return Ok(gpu);
    }
    if let Err(error) = self_test(&gpu) {
        return if gpu.has_gpu_kernels() {
            plain(software_allowed, injected, error)
        } else {
            Err(error)
        };
    }
    if let Some(path) = verdict {
        // A folder that cannot be written costs the test again, no more.
        let _ = path.parent().map(std::fs::create_dir_all);
        let _ = write_atomically(&path, |out| writeln!(out, "{} passed", gpu.name()));
    }
    Ok(gpu)
}

/// A device with the plain kernels, after those for GPUs failed with `error`; that error if these fail, too.
fn plain(software_allowed: bool, injected: &Injected, error: Error) -> Result<Arc<Gpu>> {
    let gpu = Gpu::with_faults(software_allowed, injected)?.falling_back(error.to_string());
    let gpu = Arc::new(gpu);
    self_test(&gpu).map_err(|_| error)?;
    Ok(gpu)
}

/// The file that says that this adapter, with this driver, computes these kernels right.
fn verdict_file(gpu: &Gpu) -> Option<PathBuf> {
    let info = gpu.info();
    let mut key = DefaultHasher::new();
    (&info.name, info.vendor, info.device, &info.driver, &info.driver_info).hash(&mut key);
    format!("{:?} {:?}", info.backend, info.device_type).hash(&mut key);
    env!("CARGO_PKG_VERSION").hash(&mut key);
    gpu.checks_shaders().hash(&mut key);
    for variant in shader_variants() {
        variant.text.hash(&mut key);
        format!("{:?}", variant.constants).hash(&mut key);
    }
    Some(folder()?.join(format!("{:016x}.passed", key.finish())))
}

/// The system's cache folder.
fn folder() -> Option<PathBuf> {
    if let Some(folder) = env::var_os(VARIABLE) {
        return (!folder.is_empty()).then(|| PathBuf::from(folder));
    }
    let of = |name: &str| env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = if cfg!(windows) {
        of("LOCALAPPDATA")
    } else if cfg!(target_os = "macos") {
        of("HOME").map(|home| home.join("Library/Caches"))
    } else {
        of("XDG_CACHE_HOME").or_else(|| of("HOME").map(|home| home.join(".cache")))
    };
    Some(base?.join("igsr").join("gpu"))
}
