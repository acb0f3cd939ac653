//! project_backward: gradients of the 2D splats to gradients of the splats and the camera.

use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{CAMERA, GEOMETRY, GRADIENT, SPLATS_PER_GROUP, View};
use super::project::{Projection, SPLAT_2D, SplatBuffers, geometry_rows, rows, window_uniform};
use super::rasterize::splats2d;
use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    Colors, ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams,
};

/// Workgroups of one pass over all splats, which is also the number of camera sums.
pub(super) fn camera_sums(splats: u32) -> u32 {
    splats.div_ceil(SPLATS_PER_GROUP)
}

/// Gradients of viewmat and intrinsics from the workgroups' sums, added in f64 in order.
pub(super) fn camera_sum(sums: &[u8]) -> ([[f64; 4]; 3], [f64; 4]) {
    let mut total = [0.0f64; CAMERA];
    for row in sums.chunks_exact(CAMERA * 4) {
        let row: [f32; CAMERA] = bytemuck::pod_read_unaligned(row);
        for (sum, v) in total.iter_mut().zip(row) {
            *sum += f64::from(v);
        }
    }
    (
        std::array::from_fn(|r| std::array::from_fn(|c| total[4 * r + c])),
        std::array::from_fn(|k| total[12 + k]),
    )
}

/// Gradient buffers of the parameters, laid out as [`SplatBuffers`].
#[derive(Debug)]
pub(super) struct GradientBuffers {
    /// `[N * GEOMETRY]`
    pub geometry: wgpu::Buffer,
    /// `[N * color_floats]`
    pub colors: wgpu::Buffer,
    /// `[camera_sums(N) * CAMERA]`
    pub camera: wgpu::Buffer,
}

/// Partial sums of the camera's gradients for `splats` splats.
pub(super) fn camera_buffer(gpu: &Gpu, splats: u32) -> Result<wgpu::Buffer> {
    gpu.bindable("v_camera", u64::from(camera_sums(splats)) * CAMERA as u64 * 4)
}

impl GradientBuffers {
    pub fn new(gpu: &Gpu, splats: &SplatBuffers) -> Result<Self> {
        let n = u64::from(splats.splats);
        Ok(Self {
            geometry: gpu.buffer("v_geometry", n * GEOMETRY as u64 * 4)?,
            colors: gpu.buffer("v_colors", n * splats.color_floats * 4)?,
            camera: camera_buffer(gpu, splats.splats)?,
        })
    }
}

impl GradientBuffers {
    /// With these gradients, the camera's apart.
    pub fn upload(gpu: &Gpu, v: &SplatGradients<f32>) -> Result<Self> {
        let as_splats = SplatParams {
            means: &v.v_means,
            quats: &v.v_quats,
            scales: &v.v_scales,
            opacities: &v.v_opacities,
            colors: Colors::Direct(&v.v_colors),
            raw: true,
        };
        Ok(Self {
            geometry: gpu.upload("v_geometry", &geometry_rows(&as_splats))?,
            colors: gpu.upload("v_colors", &v.v_colors)?,
            camera: gpu.buffer("v_camera", 0)?,
        })
    }
}

pub(super) fn project_backward_ops(
    gpu: &Gpu,
    drawn: Projection<'_>,
    splats: &SplatBuffers,
    v_splats2d: &wgpu::Buffer,
    gradients: &GradientBuffers,
) -> Vec<Op> {
    let mut ops = Vec::new();
    for window in splats.windows(gpu) {
        let count = window.len() as u32;
        let uniform = window_uniform(gpu, &window);
        ops.push(gpu.op(
            Kernel::ProjectBackward,
            &[
                drawn.view.into(),
                (&uniform).into(),
                rows(&splats.geometry, &window, GEOMETRY as u64),
                rows(&splats.colors, &window, splats.color_floats),
                rows(drawn.splats2d, &window, SPLAT_2D as u64),
                rows(v_splats2d, &window, GRADIENT as u64),
                rows(&gradients.geometry, &window, GEOMETRY as u64),
                rows(&gradients.colors, &window, splats.color_floats),
                (&gradients.camera).into(),
            ],
            gpu.groups(count, SPLATS_PER_GROUP),
        ));
    }
    ops
}

fn gradient_rows(v: &ProjectedGradients<f32>) -> Vec<[f32; GRADIENT]> {
    (0..v.v_means2d.len())
        .map(|i| {
            let mut row = [0.0; GRADIENT];
            row[0..2].copy_from_slice(&v.v_means2d[i]);
            row[2..5].copy_from_slice(&v.v_factors[i]);
            row[5] = v.v_depths[i];
            row[6..9].copy_from_slice(&v.v_colors[i]);
            row[9] = v.v_opacities[i];
            row
        })
        .collect()
}

pub(super) fn project_backward(
    gpu: &Gpu,
    splats: &SplatParams<'_, f32>,
    camera: &Camera,
    options: &ProjectOptions,
    projected: &Projected<f32>,
    v_projected: &ProjectedGradients<f32>,
) -> Result<SplatGradients<f32>> {
    let n = splats.len() as u64;
    let buffers = SplatBuffers::upload(gpu, splats)?;
    let view = gpu.uniform(&View::of_camera(camera, options, splats));
    let splats2d = gpu.upload("splats2d", &splats2d(projected))?;
    let v_splats2d = gpu.upload("v_splats2d", &gradient_rows(v_projected))?;
    let gradients = GradientBuffers::new(gpu, &buffers)?;
    let drawn = Projection { view: &view, splats2d: &splats2d };
    let ops = project_backward_ops(gpu, drawn, &buffers, &v_splats2d, &gradients);
    let sums = u64::from(camera_sums(buffers.splats));
    let data = gpu.download(
        &ops,
        &[
            (&gradients.geometry, n * GEOMETRY as u64 * 4),
            (&gradients.colors, n * buffers.color_floats * 4),
            (&gradients.camera, sums * CAMERA as u64 * 4),
        ],
    )?;
    let mut out = SplatGradients {
        v_colors: bytemuck::pod_collect_to_vec(&data[1]),
        ..SplatGradients::default()
    };
    for row in data[0].chunks_exact(GEOMETRY * 4) {
        let row: [f32; GEOMETRY] = bytemuck::pod_read_unaligned(row);
        out.v_means.push([row[0], row[1], row[2]]);
        out.v_scales.push([row[3], row[4], row[5]]);
        out.v_quats.push([row[6], row[7], row[8], row[9]]);
        out.v_opacities.push(row[10]);
    }
    (out.v_viewmat, out.v_intrinsics) = camera_sum(&data[2]);
    Ok(out)
}
