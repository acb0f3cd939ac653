//! Time of each stage of a frame, by the device's timestamps.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use splat_render::gpu::Gpu;

/// The stages of a frame; the first six twice, once per model.
pub const STAGES: [&str; 14] = [
    "project",
    "sort",
    "blend",
    "bin",
    "rasterize",
    "canvas",
    "project",
    "sort",
    "blend",
    "bin",
    "rasterize",
    "canvas",
    "compose",
    "panel",
];
pub const PROJECT: usize = 0;
pub const SORT: usize = 1;
pub const BLEND: usize = 2;
pub const BIN: usize = 3;
pub const RASTERIZE: usize = 4;
pub const CANVAS: usize = 5;
/// First stage of the second model.
pub const SECOND: usize = 6;
pub const COMPOSE: usize = 12;
pub const PANEL: usize = 13;

/// Which stages of a frame wrote a timestamp.
pub type Written = [bool; STAGES.len()];

/// The query for the beginning of a frame.
const BEGIN: usize = STAGES.len();
const COUNT: usize = STAGES.len() + 1;
/// Alignment of a query's place in the buffer that it is resolved to.
const ALIGNMENT: u64 = wgpu::QUERY_RESOLVE_BUFFER_ALIGNMENT;

/// Timestamps of a frame. Devices without timestamps give no times.
///
/// Each stage writes one when it ends; its time is the difference to the stage before. Timestamps at the
/// beginning of passes are less exact: llvmpipe writes them after the pass's first dispatch.
#[derive(Debug)]
pub struct StageTimes {
    queries: Option<Queries>,
    last: Option<[f32; STAGES.len()]>,
    is_new: bool,
}

#[derive(Debug)]
struct Queries {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    readable: wgpu::Buffer,
    tick: f64,
    /// Stages of the frame whose times are being read back.
    written: Written,
    is_pending: bool,
    is_mapped: Arc<AtomicBool>,
}

/// Timestamp writes of passes; `first` is added to the numbers of stages.
#[derive(Debug, Clone, Copy)]
pub struct Stamps<'a> {
    set: Option<&'a wgpu::QuerySet>,
    first: usize,
}

impl<'a> Stamps<'a> {
    pub fn none() -> Self {
        Self { set: None, first: 0 }
    }

    pub fn are_written(&self) -> bool {
        self.set.is_some()
    }

    fn index(&self, stage: usize) -> Option<u32> {
        Some((self.first + stage) as u32)
    }

    pub fn compute(&self, stage: usize) -> Option<wgpu::ComputePassTimestampWrites<'a>> {
        self.set.map(|query_set| wgpu::ComputePassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: None,
            end_of_pass_write_index: self.index(stage),
        })
    }

    pub fn render(&self, stage: usize) -> Option<wgpu::RenderPassTimestampWrites<'a>> {
        self.set.map(|query_set| wgpu::RenderPassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: None,
            end_of_pass_write_index: self.index(stage),
        })
    }
}

impl StageTimes {
    pub fn new(gpu: &Gpu) -> Self {
        let device = gpu.device();
        let queries =
            device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Queries {
                set: device.create_query_set(&wgpu::QuerySetDescriptor {
                    label: Some("stage times"),
                    ty: wgpu::QueryType::Timestamp,
                    count: COUNT as u32,
                }),
                resolved: device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some("stage times"),
                    size: COUNT as u64 * ALIGNMENT,
                    usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                    mapped_at_creation: false,
                }),
                readable: gpu.readable(COUNT as u64 * ALIGNMENT),
                tick: f64::from(gpu.queue().get_timestamp_period()) * 1e-6,
                written: [false; STAGES.len()],
                is_pending: false,
                is_mapped: Arc::default(),
            });
        Self { queries, last: None, is_new: false }
    }

    /// Timestamp writes from stage `first` on; none while a read-back is pending.
    pub fn stamps(&self, first: usize) -> Stamps<'_> {
        let set = self.queries.as_ref().filter(|q| !q.is_pending).map(|q| &q.set);
        Stamps { set, first }
    }

    /// Submits the timestamp of a frame's beginning, ahead of its work.
    pub fn begin(&self, gpu: &Gpu) {
        let Some(timestamp_writes) = self.stamps(BEGIN).compute(0) else { return };
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: Some("begin"),
            timestamp_writes: Some(timestamp_writes),
        });
        gpu.queue().submit([encoder.finish()]);
    }

    /// Records the read-back of the stages that were written.
    pub fn resolve(&mut self, encoder: &mut wgpu::CommandEncoder, written: Written) {
        let Some(q) = self.queries.as_mut().filter(|q| !q.is_pending) else { return };
        q.written = written;
        // Only written queries may be resolved.
        for query in (0..COUNT).filter(|&query| query == BEGIN || written[query]) {
            let at = query as u64 * ALIGNMENT;
            encoder.resolve_query_set(&q.set, query as u32..query as u32 + 1, &q.resolved, at);
        }
        encoder.copy_buffer_to_buffer(&q.resolved, 0, &q.readable, 0, COUNT as u64 * ALIGNMENT);
    }

    /// Starts the read-back of the frame just submitted.
    pub fn submitted(&mut self) {
        let Some(q) = self.queries.as_mut().filter(|q| !q.is_pending) else { return };
        q.is_pending = true;
        let is_mapped = Arc::clone(&q.is_mapped);
        q.readable.map_async(wgpu::MapMode::Read, .., move |result| {
            is_mapped.store(result.is_ok(), Ordering::Release);
        });
    }

    /// Whether a frame's times are being read back.
    pub fn are_pending(&self) -> bool {
        self.queries.as_ref().is_some_and(|q| q.is_pending)
    }

    /// [`Self::latest`], once for each timed frame.
    pub fn new_times(&mut self) -> Option<[f32; STAGES.len()]> {
        let times = self.latest();
        times.filter(|_| std::mem::take(&mut self.is_new))
    }

    /// Milliseconds of the latest timed frame's stages, 0 for absent ones; None before the first.
    pub fn latest(&mut self) -> Option<[f32; STAGES.len()]> {
        if let Some(q) = &mut self.queries
            && q.is_mapped.swap(false, Ordering::Acquire)
        {
            if let Ok(view) = q.readable.get_mapped_range(..) {
                let tick = |query: usize| {
                    let bytes = &view[query * ALIGNMENT as usize..][..8];
                    bytemuck::pod_read_unaligned::<u64>(bytes)
                };
                let mut stages: Vec<usize> = (0..BEGIN).filter(|&i| q.written[i]).collect();
                stages.sort_by_key(|&stage| tick(stage));
                let mut times = [0.0; STAGES.len()];
                let mut before = tick(BEGIN);
                for stage in stages {
                    let ticks = tick(stage).saturating_sub(before);
                    times[stage] = (ticks as f64 * q.tick) as f32;
                    before = tick(stage);
                }
                self.last = Some(times);
                self.is_new = true;
            }
            q.readable.unmap();
            q.is_pending = false;
        }
        self.last
    }
}
