//! adam: one optimizer step of all parameters, the exploration noise, and density statistics. In fits,
//! colors wait ([`super::waiting_colors`]).

use std::ops::Range;

use super::bin::SplatBins;
use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{
    GEOMETRY, GRADIENT, NOTE_PULL, NOTE_SEEN, NOTES, SPLATS_PER_GROUP, Step, View,
};
use super::project::{Projection, SPLAT_2D, SplatBuffers, rows, window_uniform};
use super::project_backward::GradientBuffers;
use crate::error::Result;
use crate::fit_device::DensityStats;
use crate::splats::{SplatArrays, SplatParams};
use crate::stages::{AdamState, AdamStep, SplatGradients};

/// Floats of color per workgroup.
const COLOR_FLOATS_PER_GROUP: u32 = 256;

/// Splats under optimization, on the device.
#[derive(Debug)]
pub(super) struct AdamBuffers {
    pub splats: SplatBuffers,
    pub first: SplatBuffers,
    pub second: SplatBuffers,
    /// `[N * NOTES]`
    pub notes: wgpu::Buffer,
    /// Number of splats, from the first, that are moved.
    pub moving: u32,
}

/// Input of a fit's step besides [`AdamBuffers`].
#[derive(Debug)]
pub(super) struct AdamInput<'a> {
    /// The camera and its 2D splats.
    pub drawn: Projection<'a>,
    /// A [`Step`].
    pub step: &'a wgpu::Buffer,
    /// `[camera_sums(N) * CAMERA]`
    pub v_camera: &'a wgpu::Buffer,
    /// `[N * GRADIENT]`
    pub v_splats2d: &'a wgpu::Buffer,
}

/// Parameters or moments from the bytes of their buffers.
fn arrays_from_bytes(geometry: &[u8], colors: &[u8], sh_degree: u32) -> SplatArrays {
    let mut out = SplatArrays {
        sh: bytemuck::pod_collect_to_vec(colors),
        sh_degree,
        ..SplatArrays::default()
    };
    for bytes in geometry.chunks_exact(GEOMETRY * 4) {
        let row: [f32; GEOMETRY] = bytemuck::pod_read_unaligned(bytes);
        out.means.push([row[0], row[1], row[2]]);
        out.scales.push([row[3], row[4], row[5]]);
        out.quats.push([row[6], row[7], row[8], row[9]]);
        out.opacities.push(row[10]);
    }
    out
}

impl AdamBuffers {
    /// Copies parameters, moments and statistics to the device; the first `moving` splats are moved.
    pub fn upload(
        gpu: &Gpu,
        [splats, first, second]: [SplatParams<'_, f32>; 3],
        stats: &DensityStats,
        moving: u32,
    ) -> Result<Self> {
        Ok(Self {
            moving,
            splats: SplatBuffers::upload(gpu, &splats)?,
            first: SplatBuffers::upload(gpu, &first)?,
            second: SplatBuffers::upload(gpu, &second)?,
            notes: gpu.upload("notes", &note_rows(stats))?,
        })
    }

    /// Uninitialized buffers for `splats` splats.
    pub fn new(gpu: &Gpu, splats: u32, color_floats: u64) -> Result<Self> {
        let arrays = || SplatBuffers::new(gpu, splats, color_floats);
        Ok(Self {
            moving: splats,
            splats: arrays()?,
            first: arrays()?,
            second: arrays()?,
            notes: gpu.buffer("notes", u64::from(splats) * NOTES as u64 * 4)?,
        })
    }

    /// Runs commands and brings back parameters, first and second moments, and statistics.
    pub fn download(
        &self,
        gpu: &Gpu,
        ops: &[Op],
        sh_degree: u32,
    ) -> Result<([SplatArrays; 3], DensityStats)> {
        let n = u64::from(self.splats.splats);
        let floats = [GEOMETRY as u64, self.splats.color_floats];
        let mut wanted = Vec::new();
        for arrays in [&self.splats, &self.first, &self.second] {
            wanted.push((&arrays.geometry, 4 * n * floats[0]));
            wanted.push((&arrays.colors, 4 * n * floats[1]));
        }
        wanted.push((&self.notes, 4 * n * NOTES as u64));
        let data = gpu.download(ops, &wanted)?;
        let arrays = [0, 2, 4].map(|k| arrays_from_bytes(&data[k], &data[k + 1], sh_degree));
        let notes: Vec<[f32; NOTES]> = bytemuck::pod_collect_to_vec(&data[6]);
        let stats = DensityStats {
            grad_sum: notes.iter().map(|note| note[NOTE_PULL]).collect(),
            seen: notes.iter().map(|note| note[NOTE_SEEN]).collect(),
        };
        Ok((arrays, stats))
    }

    /// project_backward, the step of all but colors, and the statistics.
    pub fn fit_ops(&self, gpu: &Gpu, input: &AdamInput<'_>, bins: &SplatBins) -> Vec<Op> {
        let Self { splats, first, second, notes, .. } = self;
        let (geometry, colors) = (GEOMETRY as u64, splats.color_floats);
        let op = |window: Range<u32>| {
            let uniform = window_uniform(gpu, &window);
            let bindings = [
                input.drawn.view.into(),
                (&uniform).into(),
                rows(&splats.geometry, &window, geometry),
                rows(&splats.colors, &window, colors),
                rows(input.drawn.splats2d, &window, SPLAT_2D as u64),
                rows(input.v_splats2d, &window, GRADIENT as u64),
                rows(notes, &window, NOTES as u64),
                input.v_camera.into(),
                rows(&first.geometry, &window, geometry),
                rows(&second.geometry, &window, geometry),
                input.step.into(),
            ];
            gpu.op(Kernel::FitGeometry, &bindings, bins.of_all())
        };
        splats.windows(gpu).into_iter().map(op).collect()
    }

    /// The step of all but colors, from these gradients.
    fn geometry_ops(&self, gpu: &Gpu, step: &wgpu::Buffer, gradient: &wgpu::Buffer) -> Vec<Op> {
        let Self { splats, first, second, .. } = self;
        let op = |window: Range<u32>| {
            let uniform = window_uniform(gpu, &window);
            let rows = |buffer| rows(buffer, &window, GEOMETRY as u64);
            let bindings = [
                step.into(),
                (&uniform).into(),
                rows(&splats.geometry),
                rows(gradient),
                rows(&first.geometry),
                rows(&second.geometry),
            ];
            let groups = gpu.groups(window.len() as u32, SPLATS_PER_GROUP);
            gpu.op(Kernel::AdamGeometry, &bindings, groups)
        };
        splats.windows(gpu).into_iter().map(op).collect()
    }

    /// The step of colors, from these gradients.
    fn color_ops(&self, gpu: &Gpu, [view, step, gradient]: [&wgpu::Buffer; 3]) -> Vec<Op> {
        let Self { splats, first, second, .. } = self;
        let floats = splats.color_floats;
        let op = |window: Range<u32>| {
            let uniform = window_uniform(gpu, &window);
            let rows = |buffer| rows(buffer, &window, floats);
            let bindings = [
                view.into(),
                step.into(),
                (&uniform).into(),
                rows(&splats.colors),
                rows(gradient),
                rows(&first.colors),
                rows(&second.colors),
            ];
            let groups = gpu.groups(window.len() as u32 * floats as u32, COLOR_FLOATS_PER_GROUP);
            gpu.op(Kernel::AdamColors, &bindings, groups)
        };
        splats.windows(gpu).into_iter().map(op).collect()
    }
}

/// The notes of splats whose colors are up to date.
fn note_rows(stats: &DensityStats) -> Vec<[f32; NOTES]> {
    let row = |(&pull, &seen)| {
        let mut row = [0.0; NOTES];
        (row[NOTE_PULL], row[NOTE_SEEN]) = (pull, seen);
        row
    };
    stats.grad_sum.iter().zip(&stats.seen).map(row).collect()
}

pub(super) fn adam(
    gpu: &Gpu,
    state: &mut AdamState<f32>,
    gradients: &SplatGradients<f32>,
    step: &AdamStep,
) -> Result<()> {
    let n = state.splats.len();
    let degree = state.splats.sh_degree;
    let params = [&state.splats, &state.first, &state.second].map(|a| a.params(degree));
    let buffers = AdamBuffers::upload(gpu, params, &DensityStats::zeros(n), n as u32)?;
    let given = GradientBuffers::upload(gpu, gradients)?;
    let view = gpu.uniform(&View {
        sh_degree: step.sh_degree.min(degree),
        sh_stride: state.splats.stride() as u32,
        ..View::of_picture(1, 1, [0.0; 3])
    });
    let step = gpu.uniform(&Step::of_adam(step, buffers.splats.splats));
    let mut ops = buffers.geometry_ops(gpu, &step, &given.geometry);
    ops.extend(buffers.color_ops(gpu, [&view, &step, &given.colors]));
    let ([splats, first, second], _) = buffers.download(gpu, &ops, degree)?;
    *state = AdamState { splats, first, second };
    Ok(())
}
