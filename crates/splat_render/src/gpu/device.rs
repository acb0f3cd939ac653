//! The device: choosing an adapter, pipelines, buffers, and turning wgpu's errors into this
//! crate's.

use std::future::Future;
use std::num::NonZeroU64;
use std::ops::Range;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::task::{Context, Poll, Waker};

use super::layout::SPLATS_PER_GROUP;
use super::shaders::{Access, Kernel, SOURCES, Source};
use crate::constants::TILE;
use crate::error::{Error, Result};

/// Largest number of workgroups per dispatch dimension in WebGPU's default limits.
const GROUPS_MAX: u32 = 65_535;

/// What new buffers hold in builds with debug assertions: 1.5e9 as a float, far out as an index. A
/// NaN would not show in gradients, which are set to zero where they are not finite.
#[cfg(debug_assertions)]
const POISON: u32 = 0x4ead_beef;

/// Smallest buffer: large enough for one element of any binding.
const BUFFER_MIN: u64 = 256;

/// Rows of pixels that a thread of the rasterize kernels owns: on real GPUs, and on software ones,
/// where reading a splat costs more than blending it and a tile's eight threads are one subgroup.
pub(super) const ROWS: [u32; 2] = [2, 8];

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
    /// Workgroups that scans and sorts are cut into.
    pub(super) segments: u32,
    /// One of [`ROWS`].
    rows: u32,
    /// Whether a tile's threads are one subgroup and may share through it.
    subgroups: bool,
    /// Pairs of a tile that one dispatch of the rasterize kernels walks.
    pub(super) list_limit: u32,
}

/// A binding of a kernel.
#[derive(Debug, Clone)]
pub(super) struct Bound<'a> {
    buffer: &'a wgpu::Buffer,
    bytes: Option<Range<u64>>,
}

impl<'a> From<&'a wgpu::Buffer> for Bound<'a> {
    fn from(buffer: &'a wgpu::Buffer) -> Self {
        Self { buffer, bytes: None }
    }
}

impl<'a> Bound<'a> {
    /// A part of a buffer, bytes.
    pub fn part(buffer: &'a wgpu::Buffer, bytes: Range<u64>) -> Self {
        Self { buffer, bytes: Some(bytes) }
    }
}

/// One prepared command.
#[derive(Debug, Clone)]
pub(super) enum Op {
    /// Runs a kernel.
    Dispatch { pipeline: wgpu::ComputePipeline, bind_group: wgpu::BindGroup, groups: [u32; 2] },
    /// Fills a buffer with zeros.
    Clear(wgpu::Buffer),
    /// Copies so many bytes (the last) from the start of the first buffer to an offset in the second.
    Copy(wgpu::Buffer, wgpu::Buffer, u64, u64),
}

/// Futures of wgpu's native backends are ready at once or after `poll`.
fn ready<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut context) {
            return value;
        }
        std::thread::yield_now();
    }
}

/// Real GPUs first.
fn rank(kind: wgpu::DeviceType) -> u32 {
    match kind {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::VirtualGpu => 1,
        wgpu::DeviceType::IntegratedGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    }
}

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

/// wgpu as this crate opens it.
fn instance() -> wgpu::Instance {
    super::desktop::silence_device_select();
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        // Debug layers are asked for by wgpu's environment variables alone.
        flags: wgpu::InstanceFlags::empty().with_env(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
}

/// Adapters that can run the kernels, the best first.
fn adapters(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    let mut adapters = ready(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    adapters.retain(|a| {
        let downlevel = a.get_downlevel_capabilities();
        downlevel.flags.contains(wgpu::DownlevelFlags::COMPUTE_SHADERS)
    });
    adapters.sort_by_key(|a| rank(a.get_info().device_type));
    adapters
}

impl Gpu {
    /// Opens the best adapter: a real GPU where there is one, else, if `software_allowed`, a
    /// software one such as lavapipe.
    pub fn new(software_allowed: bool) -> Result<Self> {
        let mut adapters = adapters(&instance());
        let software_only =
            adapters.first().is_some_and(|a| a.get_info().device_type == wgpu::DeviceType::Cpu);
        if !software_allowed {
            adapters.retain(|a| a.get_info().device_type != wgpu::DeviceType::Cpu);
        }
        let Some(adapter) = adapters.first() else {
            return Err(Error::Device(
                if software_only {
                    "backend gpu: only a software adapter answers; ask for it by name or use \
                     backend cpu, which is faster"
                } else {
                    "backend gpu: no Vulkan, Metal or DX12 adapter answers; install a driver \
                     (mesa-vulkan-drivers has one for machines without a GPU) or use backend cpu"
                }
                .to_owned(),
            ));
        };
        Self::open(adapter)
    }

    /// Opens the best adapter that can show pictures in a window, a software one where there is no
    /// other, and the window's surface on it.
    pub fn for_window(
        window: impl Into<wgpu::SurfaceTarget<'static>>,
    ) -> Result<(Self, wgpu::Adapter, wgpu::Surface<'static>)> {
        let instance = instance();
        let mut adapters = adapters(&instance);
        // Without a driver there is no surface either, and wgpu's error for that names nothing.
        if !adapters.is_empty() {
            let surface = instance
                .create_surface(window)
                .map_err(|e| Error::Device(format!("no window can be opened ({e})")))?;
            adapters.retain(|a| a.is_surface_supported(&surface));
            if let Some(adapter) = adapters.into_iter().next() {
                return Ok((Self::open(&adapter)?, adapter, surface));
            }
        }
        Err(Error::Device(
            "no Vulkan, Metal or DX12 adapter can draw in a window here; install a driver \
             (mesa-vulkan-drivers has one for machines without a GPU)"
                .to_owned(),
        ))
    }

    fn open(adapter: &wgpu::Adapter) -> Result<Self> {
        let info = adapter.get_info();
        let offered = adapter.limits();
        let software = info.device_type == wgpu::DeviceType::Cpu;
        let rows = ROWS[usize::from(software)];
        // Only where it was measured to pay.
        let threads = TILE * TILE / 4 / rows;
        let subgroups = software
            && adapter.features().contains(wgpu::Features::SUBGROUP)
            && (info.subgroup_min_size, info.subgroup_max_size) == (threads, threads);
        // Defaults everywhere but for the sizes, where scenes profit from what the adapter has.
        let required_limits = wgpu::Limits {
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            max_buffer_size: offered.max_buffer_size,
            ..wgpu::Limits::default()
        };
        let binding_limit = required_limits.max_storage_buffer_binding_size;
        let (device, queue) = ready(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("splat_render"),
            required_limits,
            // Who draws frames wants to know what they cost.
            required_features: adapter.features() & wgpu::Features::TIMESTAMP_QUERY
                | if subgroups { wgpu::Features::SUBGROUP } else { wgpu::Features::empty() },
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        }))
        .map_err(|e| {
            Error::Device(format!(
                "backend gpu: {} does not open ({e}); update its driver or use backend cpu",
                info.name
            ))
        })?;
        let failure = Arc::new(Mutex::new(None));
        let seen = Arc::clone(&failure);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            note(
                &seen,
                match error {
                    wgpu::Error::OutOfMemory { .. } => "is out of memory".to_owned(),
                    error => format!("failed ({error})"),
                },
            );
        }));
        let seen = Arc::clone(&failure);
        let lost = Arc::new(AtomicBool::new(false));
        let is_lost = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                is_lost.store(true, Ordering::Relaxed);
                note(&seen, format!("was lost ({message})"));
            }
        });
        let layouts = SOURCES.iter().map(|source| bind_group_layout(&device, source)).collect();
        let gpu = Self {
            device,
            queue,
            info,
            pipelines: Kernel::ALL.iter().map(|_| OnceLock::new()).collect(),
            layouts,
            failure,
            lost,
            made: Default::default(),
            binding_limit,
            groups_max: GROUPS_MAX,
            // A few segments per core keep a CPU busy; a GPU needs many workgroups.
            segments: if software { 16 } else { 256 },
            rows,
            subgroups,
            list_limit: list_limit(software, subgroups),
        };
        gpu.check()?;
        Ok(gpu)
    }

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
        self.subgroups = false;
        self.list_limit = list_limit(self.is_software(), false);
        self.pipelines = Kernel::ALL.iter().map(|_| OnceLock::new()).collect();
        self
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

    /// The device, for who draws with what the kernels leave.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// Where the kernels are submitted.
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

    /// A buffer of at least `bytes`, with nothing of use in it.
    pub(super) fn buffer(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer> {
        let size = bytes.max(BUFFER_MIN).next_multiple_of(4);
        if size > self.device.limits().max_buffer_size {
            return Err(self.error(&format!("holds no buffer of {size} bytes for {label}")));
        }
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: cfg!(debug_assertions),
        });
        self.count(size);
        // wgpu hands out zeros, which would hide a read of what no kernel has written.
        #[cfg(debug_assertions)]
        {
            if let Ok(mut view) = buffer.get_mapped_range_mut(..) {
                let words = vec![POISON; size as usize / 4];
                view.copy_from_slice(bytemuck::cast_slice(&words));
            }
            buffer.unmap();
        }
        self.check()?;
        Ok(buffer)
    }

    /// Checks that a buffer can be bound whole.
    pub(super) fn bindable_bytes(&self, label: &str, bytes: u64) -> Result<()> {
        if bytes > self.binding_limit {
            return Err(self.error(&format!(
                "binds at most {} bytes at once where {label} needs {bytes}",
                self.binding_limit
            )));
        }
        Ok(())
    }

    /// A buffer that must be bound whole.
    pub(super) fn bindable(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer> {
        self.bindable_bytes(label, bytes)?;
        self.buffer(label, bytes)
    }

    /// Room for what a pixel keeps between dispatches that walk a part of its tile's list each;
    /// empty where one walks all.
    pub(super) fn transmittances(&self, pixels: u64) -> Result<wgpu::Buffer> {
        let floats = if self.list_limit == u32::MAX { 0 } else { pixels };
        self.bindable("transmittances", 4 * floats)
    }

    /// A buffer with the given contents.
    pub(super) fn upload<T: bytemuck::NoUninit>(
        &self,
        label: &str,
        contents: &[T],
    ) -> Result<wgpu::Buffer> {
        let bytes: &[u8] = bytemuck::cast_slice(contents);
        let buffer = self.buffer(label, bytes.len() as u64)?;
        if !bytes.is_empty() {
            self.queue.write_buffer(&buffer, 0, bytes);
        }
        self.check()?;
        Ok(buffer)
    }

    /// A uniform buffer with the given contents.
    pub(super) fn uniform<T: bytemuck::NoUninit>(&self, contents: &T) -> wgpu::Buffer {
        let size = size_of::<T>().next_multiple_of(16) as u64;
        self.count(size);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("uniform"),
            size,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.queue.write_buffer(&buffer, 0, bytemuck::bytes_of(contents));
        buffer
    }

    fn pipeline(&self, kernel: Kernel) -> &wgpu::ComputePipeline {
        self.pipelines[kernel as usize].get_or_init(|| {
            let (file, entry) = kernel.entry();
            let source = Source::named(file);
            self.count(0);
            let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(file),
                source: wgpu::ShaderSource::Wgsl(source.text(self.rows, self.subgroups).into()),
            });
            let layout = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(file),
                bind_group_layouts: &[Some(self.layout(file))],
                immediate_size: 0,
            });
            let segments = [("SEGMENTS", f64::from(self.segments))];
            self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry),
                layout: Some(&layout),
                module: &module,
                entry_point: Some(entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: if source.segmented { &segments } else { &[] },
                    ..Default::default()
                },
                cache: None,
            })
        })
    }

    fn layout(&self, file: &str) -> &wgpu::BindGroupLayout {
        let index = SOURCES.iter().position(|source| source.name == file).unwrap_or(0);
        &self.layouts[index]
    }

    /// Prepares a kernel on its bindings, in the order of their numbers.
    pub(super) fn op(&self, kernel: Kernel, bindings: &[Bound<'_>], groups: [u32; 2]) -> Op {
        let entries: Vec<_> = bindings
            .iter()
            .enumerate()
            .map(|(i, bound)| wgpu::BindGroupEntry {
                binding: i as u32,
                resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                    buffer: bound.buffer,
                    offset: bound.bytes.as_ref().map_or(0, |b| b.start),
                    size: bound.bytes.as_ref().and_then(|b| NonZeroU64::new(b.end - b.start)),
                }),
            })
            .collect();
        let pipeline = self.pipeline(kernel).clone();
        self.count(0);
        let bind_group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(kernel.entry().1),
            layout: self.layout(kernel.entry().0),
            entries: &entries,
        });
        Op::Dispatch { pipeline, bind_group, groups }
    }

    /// Workgroups for `count` invocations or tiles, spilling into y past the limit of x.
    pub(super) fn groups(&self, count: u32, per_group: u32) -> [u32; 2] {
        let groups = count.div_ceil(per_group).max(1);
        let x = groups.min(self.groups_max);
        [x, groups.div_ceil(x)]
    }

    /// Splats `begin..end` of each dispatch, so that `bytes_per_splat` times their number can be
    /// bound at once.
    pub(super) fn windows(&self, splats: u32, bytes_per_splat: u64) -> Vec<Range<u32>> {
        let fit =
            (self.binding_limit / bytes_per_splat).min(u64::from(self.groups_max) * 64) as u32;
        let step = (fit / SPLATS_PER_GROUP).max(1) * SPLATS_PER_GROUP;
        (0..splats).step_by(step as usize).map(|b| b..(b + step).min(splats)).collect()
    }

    /// Records prepared commands in order.
    pub(super) fn record(encoder: &mut wgpu::CommandEncoder, ops: &[Op]) {
        let mut rest = ops;
        while let Some(first) = rest.first() {
            match first {
                Op::Dispatch { .. } => {}
                Op::Clear(buffer) => encoder.clear_buffer(buffer, 0, None),
                Op::Copy(from, to, offset, bytes) => {
                    encoder.copy_buffer_to_buffer(from, 0, to, *offset, *bytes);
                }
            }
            let run = rest.iter().take_while(|op| matches!(op, Op::Dispatch { .. })).count();
            if run == 0 {
                rest = &rest[1..];
                continue;
            }
            Self::record_pass(encoder, &rest[..run], None);
            rest = &rest[run..];
        }
    }

    /// Records the dispatches among prepared commands as one pass.
    pub(super) fn record_pass(
        encoder: &mut wgpu::CommandEncoder,
        ops: &[Op],
        timestamp_writes: Option<wgpu::ComputePassTimestampWrites<'_>>,
    ) {
        let mut pass = encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes });
        for op in ops {
            if let Op::Dispatch { pipeline, bind_group, groups } = op {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, bind_group, &[]);
                pass.dispatch_workgroups(groups[0], groups[1], 1);
            }
        }
    }

    /// Runs lists of prepared commands, without waiting for them.
    pub(super) fn submit(&self, lists: &[&[Op]]) -> Result<()> {
        let mut encoder = self.device.create_command_encoder(&Default::default());
        for ops in lists {
            Self::record(&mut encoder, ops);
        }
        self.queue.submit([encoder.finish()]);
        self.check()
    }

    /// Runs prepared commands and brings back the first `bytes` of each buffer.
    pub(super) fn download(
        &self,
        ops: &[Op],
        buffers: &[(&wgpu::Buffer, u64)],
    ) -> Result<Vec<Vec<u8>>> {
        let mut encoder = self.device.create_command_encoder(&Default::default());
        Self::record(&mut encoder, ops);
        let total: u64 = buffers.iter().map(|(_, bytes)| bytes).sum();
        if total == 0 {
            self.queue.submit([encoder.finish()]);
            self.check()?;
            return Ok(buffers.iter().map(|_| Vec::new()).collect());
        }
        let mut staging = Vec::new();
        for &(buffer, bytes) in buffers {
            let copy = self.readable(bytes);
            if bytes > 0 {
                encoder.copy_buffer_to_buffer(buffer, 0, &copy, 0, bytes);
            }
            staging.push((copy, bytes));
        }
        self.queue.submit([encoder.finish()]);
        self.check()?;
        let staging: Vec<_> = staging.iter().map(|(copy, bytes)| (copy, *bytes)).collect();
        self.read(&staging)
    }

    /// A buffer that can be copied to and read by the host.
    pub fn readable(&self, bytes: u64) -> wgpu::Buffer {
        let size = bytes.max(4);
        self.count(size);
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("download"),
            size,
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        })
    }

    /// Waits for all work and brings back the first `bytes` of each [`Self::readable`] buffer.
    pub fn read(&self, buffers: &[(&wgpu::Buffer, u64)]) -> Result<Vec<Vec<u8>>> {
        for (buffer, _) in buffers {
            let failure = Arc::clone(&self.failure);
            buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| {
                if let Err(error) = result {
                    note(&failure, format!("gave no results back ({error})"));
                }
            });
        }
        self.device
            .poll(wgpu::PollType::wait_indefinitely())
            .map_err(|e| self.error(&format!("did not finish ({e})")))?;
        self.check()?;
        let mut out = Vec::new();
        for &(buffer, bytes) in buffers {
            let view = buffer
                .get_mapped_range(..)
                .map_err(|e| self.error(&format!("gave no results back ({e})")))?;
            out.push(view[..bytes as usize].to_vec());
            drop(view);
            buffer.unmap();
        }
        Ok(out)
    }
}

fn note(failure: &Mutex<Option<String>>, what: String) {
    if let Ok(mut failure) = failure.lock() {
        // The first failure is the cause, what follows its consequences. wgpu's text has many lines,
        // this crate's errors have one.
        failure.get_or_insert_with(|| what.split_whitespace().collect::<Vec<_>>().join(" "));
    }
}

fn bind_group_layout(device: &wgpu::Device, source: &Source) -> wgpu::BindGroupLayout {
    let entries: Vec<_> = source
        .bindings
        .iter()
        .enumerate()
        .map(|(i, access)| wgpu::BindGroupLayoutEntry {
            binding: i as u32,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: match access {
                    Access::Uniform => wgpu::BufferBindingType::Uniform,
                    Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                    Access::Write => wgpu::BufferBindingType::Storage { read_only: false },
                },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        })
        .collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(source.name),
        entries: &entries,
    })
}
