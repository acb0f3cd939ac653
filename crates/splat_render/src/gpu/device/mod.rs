//! The device and its errors. `adapter.rs` opens it, `buffers.rs` makes buffers, `commands.rs` runs
//! kernels, and `times.rs` measures them.

mod adapter;
mod buffers;
mod commands;
mod injected;
mod limits;
mod times;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

pub(super) use commands::{Bound, Groups, Op};
pub use injected::Injected;
pub use limits::needed_limits;

use super::kernels::{Build, Kernel};
use crate::error::{Error, Result};

/// A compiled kernel and the layout of its bindings.
type Pipeline = (wgpu::ComputePipeline, wgpu::BindGroupLayout);

/// wgpu on one adapter, with this crate's kernels.
#[derive(Debug)]
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    info: wgpu::AdapterInfo,
    /// Kernels that were used, in the order of their numbers.
    pipelines: Vec<OnceLock<Pipeline>>,
    /// First error that wgpu reported since the last check.
    failure: Arc<Mutex<Option<String>>>,
    /// Why the device was lost, after which nothing works on it.
    lost: Arc<OnceLock<String>>,
    injected: Injected,
    /// Number of submissions until one fails, including it; 0 if none will.
    submissions_left: AtomicU64,
    /// Whether work is only planned: buffers take no memory and nothing runs.
    plans_only: bool,
    /// Buffers, bind groups and pipelines made so far, and the buffers' bytes.
    made: [AtomicU64; 2],
    host_bytes: AtomicU64,
    host_writes: AtomicU64,
    host_waits: AtomicU64,
    /// Most bytes that a storage binding may have.
    pub(super) binding_limit: u64,
    /// Most workgroups in one dimension of a dispatch.
    pub(super) groups_max: u32,
    build: Build,
    /// Why the kernels for GPUs are not used on a GPU.
    fallback: Option<String>,
    /// Whether naga adds checks of indices, divisors and loops to the kernels.
    checks_shaders: bool,
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

    fn with_build(mut self, build: Build) -> Self {
        self.build = build;
        self.list_limit = list_limit(self.is_software(), build.subgroups());
        self.pipelines = Kernel::ALL.iter().map(|_| OnceLock::new()).collect();
        self
    }

    /// Uses the kernels for software adapters without subgroups, so that tests cover them.
    #[must_use]
    pub fn without_subgroups(self) -> Self {
        self.with_build(Build::Software)
    }

    /// Uses the kernels for software adapters, which need less of a GPU's compiler, because of an error.
    #[must_use]
    pub fn falling_back(self, error: String) -> Self {
        Self { fallback: Some(error), ..self.with_build(Build::Software) }
    }

    /// Uses the kernels for GPUs, wherever they run, so that tests cover them.
    #[must_use]
    pub fn as_discrete(self) -> Self {
        self.with_build(Build::Gpu)
    }

    /// Whether it uses the kernels for GPUs.
    pub fn has_gpu_kernels(&self) -> bool {
        self.build.is_gpu()
    }

    /// Whether naga adds checks of indices, divisors and loops to the kernels, and zeros workgroup memory.
    pub fn checks_shaders(&self) -> bool {
        self.checks_shaders
    }

    /// Why the kernels for GPUs are not used on a GPU, if so.
    pub fn fallback(&self) -> Option<&str> {
        self.fallback.as_deref()
    }

    /// Plans work for a discrete GPU that binds `binding_limit` bytes at once, and does none of it.
    #[must_use]
    pub(super) fn planning(mut self, binding_limit: u64) -> Self {
        self.build = Build::Gpu;
        self.list_limit = list_limit(false, false);
        self.binding_limit = binding_limit;
        self.groups_max = GROUPS_MAX;
        self.plans_only = true;
        self
    }

    pub(super) fn segments(&self) -> u32 {
        self.build.segments()
    }

    pub(super) fn digit_bits(&self) -> u32 {
        self.build.digit_bits()
    }

    pub(super) fn loss_by_lines(&self) -> bool {
        !self.build.is_gpu()
    }

    /// Name of the adapter and its driver.
    pub fn name(&self) -> String {
        format!("{} ({:?}, {})", self.info.name, self.info.backend, self.info.driver_info)
    }

    /// The adapter and its driver, as wgpu reports them.
    pub fn info(&self) -> &wgpu::AdapterInfo {
        &self.info
    }

    /// Limits of the device that decide how large scenes may be, by WebGPU's names.
    pub fn limit_values(&self) -> [(&'static str, u64); 7] {
        let limits = self.device.limits();
        [
            ("maxBufferSize", limits.max_buffer_size),
            ("maxStorageBufferBindingSize", limits.max_storage_buffer_binding_size),
            ("maxStorageBuffersPerShaderStage", limits.max_storage_buffers_per_shader_stage.into()),
            ("maxComputeWorkgroupStorageSize", limits.max_compute_workgroup_storage_size.into()),
            (
                "maxComputeInvocationsPerWorkgroup",
                limits.max_compute_invocations_per_workgroup.into(),
            ),
            (
                "maxComputeWorkgroupsPerDimension",
                limits.max_compute_workgroups_per_dimension.into(),
            ),
            ("maxTextureDimension2D", limits.max_texture_dimension_2d.into()),
        ]
    }

    /// Whether the adapter runs on the CPU.
    pub fn is_software(&self) -> bool {
        self.info.device_type == wgpu::DeviceType::Cpu
    }

    /// Whether the device was lost: no later call on it succeeds.
    pub fn is_lost(&self) -> bool {
        self.lost.get().is_some()
    }

    /// Loses the device as a driver reset does, for tests.
    pub fn lose(&self) {
        self.device.destroy();
        // The callback is called from here, once nothing is under way.
        let _ = self.device.poll(wgpu::PollType::wait_indefinitely());
    }

    /// Makes one submission fail, the next one at 1, for tests.
    pub fn fail_submission(&self, number: u64) {
        self.submissions_left.store(number, Ordering::Relaxed);
    }

    /// Whether the submission at hand is the one that is to fail.
    fn submission_fails(&self) -> bool {
        let left = &self.submissions_left;
        let less = left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1));
        less == Ok(1)
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

    /// How many bytes went from the host to the device or back so far.
    pub fn host_bytes(&self) -> u64 {
        self.host_bytes.load(Ordering::Relaxed)
    }

    /// How many times the host wrote to a buffer so far.
    pub fn host_writes(&self) -> u64 {
        self.host_writes.load(Ordering::Relaxed)
    }

    /// How many times the host waited for all of the device's work so far.
    pub fn host_waits(&self) -> u64 {
        self.host_waits.load(Ordering::Relaxed)
    }

    fn count_host(&self, bytes: u64) {
        self.host_bytes.fetch_add(bytes, Ordering::Relaxed);
    }

    fn count(&self, bytes: u64) {
        self.made[0].fetch_add(1, Ordering::Relaxed);
        self.made[1].fetch_add(bytes, Ordering::Relaxed);
    }

    fn error(&self, what: &str) -> Error {
        let name = &self.info.name;
        Error::Device(match self.lost.get() {
            Some(why) => format!(
                "backend gpu: {name} was lost ({why}): its driver was reset or updated, or a step \
                 took too long; the next call opens it again; if it is lost again, use smaller \
                 images or backend cpu"
            ),
            None => format!(
                "backend gpu: {name} {what}; use fewer splats or smaller images, or backend cpu"
            ),
        })
    }

    /// The first error since the last call; always an error once the device is lost.
    pub fn check(&self) -> Result<()> {
        let failure = self.failure.lock().ok().and_then(|mut f| f.take());
        if self.is_lost() {
            return Err(self.error("was lost"));
        }
        failure.map_or(Ok(()), |what| Err(self.error(&what)))
    }
}

/// wgpu's text has many lines, this crate's errors have one.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn note(failure: &Mutex<Option<String>>, what: String) {
    if let Ok(mut failure) = failure.lock() {
        // Later failures are consequences of the first.
        failure.get_or_insert_with(|| one_line(&what));
    }
}
