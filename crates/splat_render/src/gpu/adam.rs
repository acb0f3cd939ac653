//! adam: one optimiser step of all parameters, the exploration noise, and what density control
//! watches.

use std::ops::Range;

use bytemuck::Zeroable;

use super::bin::SplatBins;
use super::device::{Gpu, Op};
use super::layout::{GEOMETRY, GRADIENT, SPLATS_PER_GROUP, STATS, Splat2d, StatusHead, Step, View};
use super::project::{Projection, SPLAT_2D, SplatBuffers, rows, window_uniform};
use super::project_backward::GradientBuffers;
use super::shaders::Kernel;
use crate::error::Result;
use crate::splats::{SplatArrays, SplatParams};
use crate::stages::{AdamState, AdamStep, SplatGradients};

/// Floats of colour per workgroup.
const COLOR_FLOATS_PER_GROUP: u32 = 256;

/// Splats under optimisation, on the device.
#[derive(Debug)]
pub(super) struct AdamBuffers {
    /// Parameters.
    pub splats: SplatBuffers,
    /// First moments.
    pub first: SplatBuffers,
    /// Second moments.
    pub second: SplatBuffers,
    /// `[N * STATS]`
    pub stats: wgpu::Buffer,
    /// So many splats, the first ones, are moved.
    pub moving: u32,
}

/// What a step reads besides [`AdamBuffers`].
#[derive(Debug)]
pub(super) struct AdamInput<'a> {
    /// The camera and its 2D splats.
    pub drawn: Projection<'a>,
    /// A [`Step`].
    pub step: &'a wgpu::Buffer,
    /// A [`StatusHead`]: no step is done after an overflow.
    pub status: &'a wgpu::Buffer,
    /// `[N * color_floats]`
    pub v_colors: &'a wgpu::Buffer,
    /// `[camera_sums(N) * CAMERA]`
    pub v_camera: &'a wgpu::Buffer,
    /// `[N * GRADIENT]`
    pub v_splats2d: &'a wgpu::Buffer,
}

/// Parameters or moments from what their buffers hold.
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
    /// Copies parameters, first and second moments, and statistics to the device, of splats of which
    /// the first `moving` are moved.
    pub fn upload(
        gpu: &Gpu,
        [splats, first, second]: [SplatParams<'_, f32>; 3],
        stats: &[[f32; STATS]],
        moving: u32,
    ) -> Result<Self> {
        Ok(Self {
            moving,
            splats: SplatBuffers::upload(gpu, &splats)?,
            first: SplatBuffers::upload(gpu, &first)?,
            second: SplatBuffers::upload(gpu, &second)?,
            stats: gpu.upload("stats", stats)?,
        })
    }

    /// Room for so many splats, of which nothing is known yet.
    pub fn new(gpu: &Gpu, splats: u32, color_floats: u64) -> Result<Self> {
        let arrays = || SplatBuffers::new(gpu, splats, color_floats);
        Ok(Self {
            moving: splats,
            splats: arrays()?,
            first: arrays()?,
            second: arrays()?,
            stats: gpu.buffer("stats", u64::from(splats) * STATS as u64 * 4)?,
        })
    }

    /// Runs commands and brings back parameters, first and second moments, and statistics.
    pub fn download(
        &self,
        gpu: &Gpu,
        ops: &[Op],
        sh_degree: u32,
    ) -> Result<([SplatArrays; 3], Vec<[f32; STATS]>)> {
        let n = u64::from(self.splats.splats);
        let floats = [GEOMETRY as u64, self.splats.color_floats];
        let mut wanted = Vec::new();
        for arrays in [&self.splats, &self.first, &self.second] {
            wanted.push((&arrays.geometry, 4 * n * floats[0]));
            wanted.push((&arrays.colors, 4 * n * floats[1]));
        }
        wanted.push((&self.stats, 4 * n * STATS as u64));
        let data = gpu.download(ops, &wanted)?;
        let arrays = [0, 2, 4].map(|k| arrays_from_bytes(&data[k], &data[k + 1], sh_degree));
        Ok((arrays, bytemuck::pod_collect_to_vec(&data[6])))
    }

    /// project_backward, and the step of all but colours.
    pub fn fit_ops(&self, gpu: &Gpu, input: &AdamInput<'_>, bins: &SplatBins) -> Vec<Op> {
        let Self { splats, first, second, .. } = self;
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
                rows(input.v_colors, &window, colors),
                input.v_camera.into(),
                rows(&first.geometry, &window, geometry),
                rows(&second.geometry, &window, geometry),
                input.step.into(),
            ];
            gpu.op(Kernel::FitGeometry, &bindings, bins.of_all())
        };
        splats.windows(gpu).into_iter().map(op).collect()
    }

    /// The step of all but colours, from these gradients.
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

    /// The step of colours, and the statistics.
    pub fn color_ops(&self, gpu: &Gpu, input: &AdamInput<'_>) -> Vec<Op> {
        let Self { splats, first, second, stats, .. } = self;
        let floats = splats.color_floats;
        let op = |window: Range<u32>| {
            let uniform = window_uniform(gpu, &window);
            let bindings = [
                input.drawn.view.into(),
                input.step.into(),
                (&uniform).into(),
                input.status.into(),
                rows(&splats.colors, &window, floats),
                rows(input.v_colors, &window, floats),
                rows(&first.colors, &window, floats),
                rows(&second.colors, &window, floats),
                rows(input.drawn.splats2d, &window, SPLAT_2D as u64),
                rows(input.v_splats2d, &window, GRADIENT as u64),
                rows(stats, &window, STATS as u64),
            ];
            let groups = gpu.groups(window.len() as u32 * floats as u32, COLOR_FLOATS_PER_GROUP);
            gpu.op(Kernel::AdamColors, &bindings, groups)
        };
        splats.windows(gpu).into_iter().map(op).collect()
    }
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
    let buffers = AdamBuffers::upload(gpu, params, &vec![[0.0; STATS]; n], n as u32)?;
    let given = GradientBuffers::upload(gpu, gradients)?;
    let count = buffers.splats.splats;
    let view = gpu.uniform(&View {
        sh_degree: step.sh_degree.min(degree),
        sh_stride: state.splats.stride() as u32,
        ..View::of_picture(1, 1, [0.0; 3])
    });
    let status = gpu.upload(
        "status",
        &[StatusHead { splats: count, step: step.number, ..StatusHead::zeroed() }],
    )?;
    // None is culled: all have a gradient.
    let seen = Splat2d { radii: [1.0; 2], ..Splat2d::zeroed() };
    let splats2d = gpu.upload("splats2d", &vec![seen; n])?;
    let v_splats2d = gpu.upload("v_splats2d", &vec![[0.0f32; GRADIENT]; n])?;
    let step = gpu.uniform(&Step::of_adam(step, count));
    let mut ops = buffers.geometry_ops(gpu, &step, &given.geometry);
    ops.extend(buffers.color_ops(
        gpu,
        &AdamInput {
            drawn: Projection { view: &view, splats2d: &splats2d },
            step: &step,
            status: &status,
            v_colors: &given.colors,
            v_camera: &given.camera,
            v_splats2d: &v_splats2d,
        },
    ));
    let ([splats, first, second], _) = buffers.download(gpu, &ops, degree)?;
    *state = AdamState { splats, first, second };
    Ok(())
}
