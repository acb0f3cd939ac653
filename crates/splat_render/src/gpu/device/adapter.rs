//! Choosing an adapter and opening the device on it.

use std::future::Future;
use std::pin::pin;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, OnceLock};
use std::task::{Context, Poll, Waker};

use super::limits::check_limits;
use super::{GROUPS_MAX, Gpu, Injected, list_limit, note, one_line};
use crate::error::{Error, Result};
use crate::gpu::kernels::{Build, Kernel, SOFTWARE_THREADS};

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

fn rank(kind: wgpu::DeviceType) -> u32 {
    match kind {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::VirtualGpu => 1,
        wgpu::DeviceType::IntegratedGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    }
}

/// wgpu as this crate opens it.
fn instance() -> wgpu::Instance {
    crate::gpu::desktop::silence_device_select();
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
    /// Opens the best adapter: a real GPU if there is one, else, if `software_allowed`, a software
    /// adapter such as lavapipe. Kernels compile when they are first used.
    pub fn new(software_allowed: bool) -> Result<Self> {
        Self::with_faults(software_allowed, &Injected::default())
    }

    /// [`Gpu::new`] on an adapter with these faults.
    pub fn with_faults(software_allowed: bool, injected: &Injected) -> Result<Self> {
        let mut adapters = adapters(&instance());
        let is_software = |adapter: &wgpu::Adapter| {
            !injected.passes_for_real && adapter.get_info().device_type == wgpu::DeviceType::Cpu
        };
        let software_only = adapters.first().is_some_and(is_software);
        if !software_allowed {
            adapters.retain(|adapter| !is_software(adapter));
        }
        let Some(adapter) = adapters.first() else {
            return Err(Error::NoAdapter(
                if software_only {
                    "backend gpu: only a software adapter was found; choose backend gpu to use \
                     it, or backend cpu, which is faster"
                } else {
                    "backend gpu: no Vulkan, Metal or DX12 adapter was found; install a driver \
                     (mesa-vulkan-drivers includes one for machines without a GPU) or use backend cpu"
                }
                .to_owned(),
            ));
        };
        Self::open(adapter, injected)
    }

    /// Opens the best adapter that can draw in a window, and the window's surface.
    pub fn for_window(
        window: impl Into<wgpu::SurfaceTarget<'static>>,
    ) -> Result<(Self, wgpu::Adapter, wgpu::Surface<'static>)> {
        let instance = instance();
        let mut adapters = adapters(&instance);
        // Without a driver there is no surface, and wgpu's error does not name the cause.
        if !adapters.is_empty() {
            let surface = instance
                .create_surface(window)
                .map_err(|e| Error::Device(format!("no window can be opened ({e})")))?;
            adapters.retain(|a| a.is_surface_supported(&surface));
            if let Some(adapter) = adapters.into_iter().next() {
                return Ok((Self::open(&adapter, &Injected::default())?, adapter, surface));
            }
        }
        Err(Error::Device(
            "no Vulkan, Metal or DX12 adapter can draw in a window here; install a driver \
             (mesa-vulkan-drivers includes one for machines without a GPU)"
                .to_owned(),
        ))
    }

    fn open(adapter: &wgpu::Adapter, injected: &Injected) -> Result<Self> {
        let info = adapter.get_info();
        let mut offered = adapter.limits();
        if let Some(lower) = &injected.limits {
            offered = offered.or_worse_values_from(lower);
        }
        check_limits(&info.name, &offered)?;
        let software = info.device_type == wgpu::DeviceType::Cpu;
        // Use subgroups only on adapters for which they were measured to be faster.
        let sizes = (info.subgroup_min_size, info.subgroup_max_size);
        let shares = adapter.features().contains(wgpu::Features::SUBGROUP)
            && sizes == (SOFTWARE_THREADS, SOFTWARE_THREADS);
        let build = match (software && !injected.wrong_blocks, shares) {
            (false, _) => Build::Gpu,
            (true, true) => Build::SoftwareSubgroups,
            (true, false) => Build::Software,
        };
        // Accept limits below WebGPU's defaults if the kernels do not need them; request large buffers.
        let required_limits = wgpu::Limits {
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            max_buffer_size: offered.max_buffer_size,
            ..wgpu::Limits::default().or_worse_values_from(&offered)
        };
        let groups_max = required_limits.max_compute_workgroups_per_dimension.min(GROUPS_MAX);
        let binding_limit = required_limits.max_storage_buffer_binding_size;
        let (device, queue) = ready(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("splat_render"),
            required_limits,
            // For callers that time frames.
            required_features: adapter.features() & wgpu::Features::TIMESTAMP_QUERY
                | if build.subgroups() {
                    wgpu::Features::SUBGROUP
                } else {
                    wgpu::Features::empty()
                },
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        }))
        .map_err(|e| {
            Error::Device(format!(
                "backend gpu: {} cannot be opened ({}); update its driver or use backend cpu",
                info.name,
                one_line(&e.to_string())
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
        let lost = Arc::new(OnceLock::new());
        let is_lost = Arc::clone(&lost);
        device.set_device_lost_callback(move |_, message| {
            let _ = is_lost.set(one_line(&message));
        });
        let gpu = Self {
            device,
            queue,
            info,
            pipelines: Kernel::ALL.iter().map(|_| OnceLock::new()).collect(),
            failure,
            lost,
            injected: injected.clone(),
            submissions_left: AtomicU64::new(0),
            plans_only: false,
            made: Default::default(),
            host_bytes: AtomicU64::new(0),
            host_writes: AtomicU64::new(0),
            host_waits: AtomicU64::new(0),
            binding_limit,
            groups_max,
            build,
            checks_shaders: std::env::var_os("IGSR_GPU_CHECKS").is_some_and(|value| value == "1"),
            fallback: None,
            list_limit: list_limit(software, build.subgroups()),
        };
        gpu.check()?;
        Ok(gpu)
    }
}
