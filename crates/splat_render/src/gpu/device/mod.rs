//! The device: what is known of it, and wgpu's errors as this crate's. It is opened in `adapter.rs`,
//! makes buffers in `buffers.rs` and runs kernels in `commands.rs`.

mod adapter;
mod buffers;
mod commands;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

pub(super) use commands::{Bound, Op};

use super::shaders::{Build, Kernel};
use crate::error::{Error, Result};

/// wgpu on one adapter, with this crate's kernels.
#[derive(Debug)]
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    info: wgpu::AdapterInfo,
    pipelines: Vec<OnceLock<wgpu::ComputePipeline>>,
    layouts: Vec<wgpu::BindGroupLayout>,
    /// First error that wgpu reported since the last check.
    failure: Arc<Mutex<Option<String>>>,
    /// Whether the device was lost, after which nothing works on it.
    lost: Arc<AtomicBool>,
    /// Buffers, bind groups and pipelines made so far, and the buffers' bytes.
    made: [AtomicU64; 2],
    /// Most bytes that a storage binding may have.
    pub(super) binding_limit: u64,
    /// Most workgroups in one dimension of a dispatch.
    groups_max: u32,
    /// What the shaders are built for.
    build: Build,
    /// Pairs of a tile that one dispatch of the rasterize kernels walks.
    pub(super) list_limit: u32,
}

/// Largest number of workgroups per dispatch dimension in WebGPU's default limits.
const GROUPS_MAX: u32 = 65_535;

/// Pairs of a tile that one dispatch may walk: llvmpipe leaves every loop once an invocation has
/// done 65 535 rounds of all its loops together. With subgroups rasterize_backward does 9 per 8 pairs,
/// and loops over a splat's sums, should they not be unrolled; without, up to 25 per pair.
fn list_limit(software: bool, subgroups: bool) -> u32 {
    match (software, subgroups) {
        (false, _) => u32::MAX,
        (true, true) => 32_768,
        (true, false) => 2048,
    }
}

impl Gpu {
    /// Lowers the largest storage binding, so that tests can see the work being cut into parts.
    /// Values outside 64 KiB and the device's own limit are brought within.
    #[must_use]
    pub fn with_binding_limit(mut self, bytes: u64) -> Self {
        let most = self.device.limits().max_storage_buffer_binding_size;
        self.binding_limit = bytes.clamp(65_536, most);
        self
    }

    /// Lowers the number of workgroups in one dimension of a dispatch, so that tests can see
    /// dispatches spill into the second; 65 535 splats or tiles are many for a test.
    #[must_use]
    pub fn with_group_limit(mut self, groups: u32) -> Self {
        self.groups_max = groups.clamp(1, GROUPS_MAX);
        self
    }

    /// Keeps tiles from sharing through subgroups, which not every device can, so that tests see
    /// both ways.
    #[must_use]
    pub fn without_subgroups(mut self) -> Self {
        self.build.subgroups = false;
        self.list_limit = list_limit(self.is_software(), false);
        self.pipelines = Kernel::ALL.iter().map(|_| OnceLock::new()).collect();
        self
    }

    /// Workgroups that scans and sorts are cut into.
    pub(super) fn segments(&self) -> u32 {
        self.build.segments
    }

    /// Name of the adapter and its driver.
    pub fn name(&self) -> String {
        format!("{} ({:?}, {})", self.info.name, self.info.backend, self.info.driver_info)
    }

    /// Whether the adapter runs on the CPU.
    pub fn is_software(&self) -> bool {
        self.info.device_type == wgpu::DeviceType::Cpu
    }

    /// Whether the device was lost: no later call on it succeeds.
    pub fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    /// The wgpu device, for callers that draw from the kernels' buffers.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The queue that kernels are submitted to.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// How many buffers, bind groups and pipelines were made so far, and how many bytes the buffers
    /// have, dropped ones included. A fit's step makes none.
    pub fn made(&self) -> (u64, u64) {
        (self.made[0].load(Ordering::Relaxed), self.made[1].load(Ordering::Relaxed))
    }

    fn count(&self, bytes: u64) {
        self.made[0].fetch_add(1, Ordering::Relaxed);
        self.made[1].fetch_add(bytes, Ordering::Relaxed);
    }

    /// The error for a device that fails while running.
    fn error(&self, what: &str) -> Error {
        Error::Device(format!(
            "backend gpu: {} {what}; use fewer splats or smaller images, or backend cpu",
            self.info.name
        ))
    }

    /// What wgpu reported since the last call.
    pub fn check(&self) -> Result<()> {
        let failure = self.failure.lock().ok().and_then(|mut f| f.take());
        failure.map_or(Ok(()), |what| Err(self.error(&what)))
    }
}

fn note(failure: &Mutex<Option<String>>, what: String) {
    if let Ok(mut failure) = failure.lock() {
        // The first failure is the cause, what follows its consequences. wgpu's text has many lines,
        // this crate's errors have one.
        failure.get_or_insert_with(|| what.split_whitespace().collect::<Vec<_>>().join(" "));
    }
}
