//! How long each stage of a frame takes, by timestamps that the device writes.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use splat_render::gpu::Gpu;

/// The stages of a frame: the first three for each of two models.
pub const STAGES: [&str; 8] =
    ["project", "sort", "draw", "project", "sort", "draw", "compose", "panel"];
/// Where the second model's begin.
pub const SECOND: usize = 3;
/// The two canvases to one picture.
pub const COMPOSE: usize = 6;
/// What egui paints.
pub const PANEL: usize = 7;

const COUNT: u32 = 2 * STAGES.len() as u32;
const BYTES: u64 = COUNT as u64 * 8;

/// Timestamps of a frame. A device without them has no times.
#[derive(Debug)]
pub struct StageTimes {
    queries: Option<Queries>,
    last: Option<[f32; STAGES.len()]>,
}

#[derive(Debug)]
struct Queries {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    readable: wgpu::Buffer,
    /// Milliseconds of one tick.
    tick: f64,
    /// Stages of the frame whose times are under way.
    written: [bool; STAGES.len()],
    is_pending: bool,
    is_mapped: Arc<AtomicBool>,
}

/// Where passes write their timestamps; `first` stands before the numbers of stages.
#[derive(Debug, Clone, Copy)]
pub struct Stamps<'a> {
    set: Option<&'a wgpu::QuerySet>,
    first: usize,
}

impl<'a> Stamps<'a> {
    /// None at all.
    pub fn none() -> Self {
        Self { set: None, first: 0 }
    }

    /// Whether passes write any.
    pub fn are_written(&self) -> bool {
        self.set.is_some()
    }

    fn indices(&self, stage: usize) -> [Option<u32>; 2] {
        let begin = 2 * (self.first + stage) as u32;
        [Some(begin), Some(begin + 1)]
    }

    /// For a compute pass.
    pub fn compute(&self, stage: usize) -> Option<wgpu::ComputePassTimestampWrites<'a>> {
        let [begin, end] = self.indices(stage);
        self.set.map(|query_set| wgpu::ComputePassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: begin,
            end_of_pass_write_index: end,
        })
    }

    /// For a render pass.
    pub fn render(&self, stage: usize) -> Option<wgpu::RenderPassTimestampWrites<'a>> {
        let [begin, end] = self.indices(stage);
        self.set.map(|query_set| wgpu::RenderPassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: begin,
            end_of_pass_write_index: end,
        })
    }
}

impl StageTimes {
    /// Of frames on this device.
    pub fn new(gpu: &Gpu) -> Self {
        let device = gpu.device();
        let queries =
            device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Queries {
                set: device.create_query_set(&wgpu::QuerySetDescriptor {
                    label: Some("stage times"),
                    ty: wgpu::QueryType::Timestamp,
                    count: COUNT,
                }),
                resolved: device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some("stage times"),
                    size: BYTES,
                    usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                    mapped_at_creation: false,
                }),
                readable: gpu.readable(BYTES),
                tick: f64::from(gpu.queue().get_timestamp_period()) * 1e-6,
                written: [false; STAGES.len()],
                is_pending: false,
                is_mapped: Arc::default(),
            });
        Self { queries, last: None }
    }

    /// Where the passes of a frame write, beginning with stage `first`; nowhere while an earlier
    /// frame's times are under way.
    pub fn stamps(&self, first: usize) -> Stamps<'_> {
        let set = self.queries.as_ref().filter(|q| !q.is_pending).map(|q| &q.set);
        Stamps { set, first }
    }

    /// Records the read-back of the stages that the frame had.
    pub fn resolve(&mut self, encoder: &mut wgpu::CommandEncoder, written: [bool; STAGES.len()]) {
        let Some(q) = self.queries.as_mut().filter(|q| !q.is_pending) else { return };
        q.written = written;
        for (stage, _) in written.iter().enumerate().filter(|(_, written)| **written) {
            let begin = 2 * stage as u32;
            // Only what was written may be resolved; offsets must be multiples of 256 bytes, so each
            // stage is copied to its place by itself.
            encoder.resolve_query_set(&q.set, begin..begin + 2, &q.resolved, 0);
            encoder.copy_buffer_to_buffer(&q.resolved, 0, &q.readable, u64::from(begin) * 8, 16);
        }
    }

    /// Asks for the times of the frame just submitted.
    pub fn submitted(&mut self) {
        let Some(q) = self.queries.as_mut().filter(|q| !q.is_pending) else { return };
        q.is_pending = true;
        let is_mapped = Arc::clone(&q.is_mapped);
        q.readable.map_async(wgpu::MapMode::Read, .., move |result| {
            is_mapped.store(result.is_ok(), Ordering::Release);
        });
    }

    /// Whether a frame's times are under way.
    pub fn are_pending(&self) -> bool {
        self.queries.as_ref().is_some_and(|q| q.is_pending)
    }

    /// Milliseconds of each stage of the latest frame whose times have come, 0 for stages that it did
    /// not have; None before there is one.
    pub fn latest(&mut self) -> Option<[f32; STAGES.len()]> {
        if let Some(q) = &mut self.queries
            && q.is_mapped.swap(false, Ordering::Acquire)
        {
            if let Ok(view) = q.readable.get_mapped_range(..) {
                let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&view[..]);
                let took = |stage: usize| {
                    let ticks = ticks[2 * stage + 1].saturating_sub(ticks[2 * stage]);
                    if q.written[stage] { (ticks as f64 * q.tick) as f32 } else { 0.0 }
                };
                self.last = Some(std::array::from_fn(took));
            }
            q.readable.unmap();
            q.is_pending = false;
        }
        self.last
    }
}
