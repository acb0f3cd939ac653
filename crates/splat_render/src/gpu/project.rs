//! project: splats and camera to 2D splats.

use std::ops::Range;

use super::device::{Bound, Gpu, Op};
use super::kernels::Kernel;
use super::layout::{GEOMETRY, GRADIENT, SPLATS_PER_GROUP, Splat2d, View, Window};
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::stages::{Colors, ProjectOptions, Projected, SplatParams};

/// Splat parameters on the device.
#[derive(Debug)]
pub(super) struct SplatBuffers {
    pub splats: u32,
    pub color_floats: u64,
    /// `[N * GEOMETRY]`
    pub geometry: wgpu::Buffer,
    /// `[N * color_floats]`
    pub colors: wgpu::Buffer,
}

/// A camera and its 2D splats on the device, input of all stages after project.
#[derive(Debug, Clone, Copy)]
pub(super) struct Projection<'a> {
    /// A [`View`].
    pub view: &'a wgpu::Buffer,
    /// `[N]` of [`Splat2d`].
    pub splats2d: &'a wgpu::Buffer,
}

/// Floats of a [`Splat2d`].
pub(super) const SPLAT_2D: usize = size_of::<Splat2d>() / 4;

/// The number of splats as the kernels count them.
pub(super) fn count(splats: usize) -> Result<u32> {
    // Above the memory of any device, and low enough that no index overflows.
    u32::try_from(splats).ok().filter(|&n| n < 1 << 26).ok_or_else(|| {
        Error::argument("means", format!("has {splats} rows; backend gpu takes at most 67 million"))
    })
}

pub(super) fn geometry_rows(splats: &SplatParams<'_, f32>) -> Vec<[f32; GEOMETRY]> {
    (0..splats.len())
        .map(|i| {
            let mut row = [0.0; GEOMETRY];
            row[0..3].copy_from_slice(&splats.means[i]);
            row[3..6].copy_from_slice(&splats.scales[i]);
            row[6..10].copy_from_slice(&splats.quats[i]);
            row[10] = splats.opacities[i];
            row
        })
        .collect()
}

impl SplatBuffers {
    pub fn upload(gpu: &Gpu, splats: &SplatParams<'_, f32>) -> Result<Self> {
        let (stride, colors) = match splats.colors {
            Colors::Direct(colors) => (1, colors),
            Colors::Sh { stride, coeffs, .. } => (stride, coeffs),
        };
        Ok(Self {
            splats: count(splats.len())?,
            color_floats: 3 * stride as u64,
            geometry: gpu.upload("geometry", &geometry_rows(splats))?,
            colors: gpu.upload("colors", colors)?,
        })
    }

    /// Uninitialized buffers for `splats` splats.
    pub fn new(gpu: &Gpu, splats: u32, color_floats: u64) -> Result<Self> {
        let rows = |floats: u64| u64::from(splats) * floats * 4;
        Ok(Self {
            splats,
            color_floats,
            geometry: gpu.buffer("geometry", rows(GEOMETRY as u64))?,
            colors: gpu.buffer("colors", rows(color_floats))?,
        })
    }

    /// Windows of splats whose widest rows can be bound at once.
    pub fn windows(&self, gpu: &Gpu) -> Vec<Range<u32>> {
        let floats = self.color_floats.max((GEOMETRY.max(GRADIENT).max(SPLAT_2D)) as u64);
        gpu.windows(self.splats, 4 * floats)
    }
}

/// The part of a per-splat buffer that belongs to a window; rows of `floats` f32.
pub(super) fn rows<'a>(buffer: &'a wgpu::Buffer, window: &Range<u32>, floats: u64) -> Bound<'a> {
    let bytes = u64::from(window.start) * floats * 4..u64::from(window.end) * floats * 4;
    Bound::part(buffer, bytes)
}

/// The splats of one dispatch, as the kernels read them.
pub(super) fn window_uniform(gpu: &Gpu, window: &Range<u32>) -> wgpu::Buffer {
    let count = window.len() as u32;
    gpu.uniform(&Window { first: window.start, count, groups_max: gpu.groups_max })
}

/// Projects all splats; their depth keys go to `[N]` `keys`.
pub(super) fn project_ops(
    gpu: &Gpu,
    to: Projection<'_>,
    splats: &SplatBuffers,
    keys: &wgpu::Buffer,
) -> Vec<Op> {
    let mut ops = Vec::new();
    for window in splats.windows(gpu) {
        let count = window.len() as u32;
        let uniform = window_uniform(gpu, &window);
        ops.push(gpu.op(
            Kernel::Project,
            &[
                to.view.into(),
                (&uniform).into(),
                rows(&splats.geometry, &window, GEOMETRY as u64),
                rows(&splats.colors, &window, splats.color_floats),
                rows(to.splats2d, &window, SPLAT_2D as u64),
                rows(keys, &window, 1),
            ],
            gpu.groups(count, SPLATS_PER_GROUP),
        ));
    }
    ops
}

pub(super) fn project(
    gpu: &Gpu,
    splats: &SplatParams<'_, f32>,
    camera: &Camera,
    options: &ProjectOptions,
) -> Result<Projected<f32>> {
    let n = splats.len();
    let buffers = SplatBuffers::upload(gpu, splats)?;
    let view = gpu.uniform(&View::of_camera(camera, options, splats));
    let bytes = (n * size_of::<Splat2d>()) as u64;
    let splats2d = gpu.buffer("splats2d", bytes)?;
    let to = Projection { view: &view, splats2d: &splats2d };
    let keys = gpu.buffer("depth keys", 4 * n as u64)?;
    let ops = project_ops(gpu, to, &buffers, &keys);
    let data = gpu.download(&ops, &[(&splats2d, bytes)])?;
    let mut out = Projected::culled(n, camera.width, camera.height);
    for (i, bytes) in data[0].chunks_exact(size_of::<Splat2d>()).enumerate() {
        let splat: Splat2d = bytemuck::pod_read_unaligned(bytes);
        if splat.radii == [0.0; 2] {
            continue;
        }
        out.means2d[i] = splat.mean;
        out.factors[i] = [splat.pq[0], splat.pq[1], splat.r];
        out.depths[i] = splat.depth;
        out.colors[i] = splat.color;
        out.opacities[i] = splat.opacity;
        out.radii[i] = splat.radii;
    }
    Ok(out)
}
