//! rasterize_backward: gradients of the picture to gradients of the 2D splats.

use super::bin::{PairBins, SplatBins, TileChunk};
use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{GRADIENT, GRADIENT_ABSOLUTE};
use super::project::Projection;
use super::rasterize::Binned;
use crate::error::Result;
use crate::stages::{Image, ImageGradients, Projected, ProjectedGradients};

/// Buffers of the kernels.
#[derive(Debug)]
pub(super) struct BackwardBuffers {
    /// `[H * W]` gradients of color and accumulated depth.
    pub v_picture: wgpu::Buffer,
    /// `[H * W]` color . v_color + depth v_depth - transmittance v_alpha.
    pub totals: wgpu::Buffer,
    /// `[H * W]`, for lists that take more than one dispatch.
    pub transmittances: wgpu::Buffer,
    /// `[pairs * GRADIENT]`, or GRADIENT_ABSOLUTE.
    pub slots: wgpu::Buffer,
    /// `[N * GRADIENT]`, or GRADIENT_ABSOLUTE.
    pub v_splats2d: wgpu::Buffer,
}

/// Differentiates a chunk's tiles, whose pair lists are filled, and adds to the splats' gradients.
pub(super) fn rasterize_backward_ops(
    gpu: &Gpu,
    drawn: Projection<'_>,
    chunk: &TileChunk,
    (bins, pairs): (&SplatBins, &PairBins),
    buffers: &BackwardBuffers,
    absolute: bool,
) -> Vec<Op> {
    let (rasterize_backward, sum) = if absolute {
        (Kernel::RasterizeBackwardAbsolute, Kernel::RasterizeBackwardSumAbsolute)
    } else {
        (Kernel::RasterizeBackward, Kernel::RasterizeBackwardSum)
    };
    let walk = |pass: &wgpu::Buffer| {
        gpu.op(
            rasterize_backward,
            &[
                drawn.view.into(),
                pass.into(),
                drawn.splats2d.into(),
                (&pairs.tile_begin).into(),
                pairs.splat_from_pair(chunk.tiles()).into(),
                pairs.slot_from_pair(chunk.tiles()).into(),
                (&buffers.v_picture).into(),
                (&buffers.totals).into(),
                (&buffers.slots).into(),
                (&buffers.transmittances).into(),
            ],
            gpu.groups(chunk.tiles(), 1),
        )
    };
    let mut ops: Vec<Op> = chunk.passes.iter().map(walk).collect();
    ops.push(gpu.op(
        sum,
        &[
            (&chunk.uniform).into(),
            (&bins.status).into(),
            drawn.splats2d.into(),
            bins.order().into(),
            (&bins.offsets).into(),
            (&buffers.slots).into(),
            (&buffers.v_splats2d).into(),
        ],
        bins.of_order(),
    ));
    ops
}

pub(super) fn rasterize_backward(
    gpu: &Gpu,
    projected: &Projected<f32>,
    background: [f32; 3],
    image: &Image<f32>,
    v_image: &ImageGradients<f32>,
    absolute: bool,
) -> Result<ProjectedGradients<f32>> {
    let floats = if absolute { GRADIENT_ABSOLUTE } else { GRADIENT };
    let pixels = image.color.len();
    let mut v_picture = Vec::with_capacity(pixels);
    let mut totals = Vec::with_capacity(pixels);
    let mut v_background = [0.0f64; 3];
    for i in 0..pixels {
        let [r, g, b] = v_image.v_color[i];
        v_picture.push([r, g, b, v_image.v_depth[i]]);
        let transmittance = f64::from(image.transmittance[i]);
        let mut total = f64::from(image.depth[i]) * f64::from(v_image.v_depth[i])
            - transmittance * f64::from(v_image.v_alpha[i]);
        for c in 0..3 {
            let v = f64::from(v_image.v_color[i][c]);
            total += f64::from(image.color[i][c]) * v;
            v_background[c] += transmittance * v;
        }
        totals.push(total as f32);
    }
    let row = floats as u64 * 4;
    gpu.bindable_bytes("v_picture", 16 * pixels as u64)?;
    let binned = Binned::new(gpu, projected, background, floats)?;
    let buffers = BackwardBuffers {
        v_picture: gpu.upload("v_picture", &v_picture)?,
        totals: gpu.upload("totals", &totals)?,
        transmittances: gpu.transmittances(pixels as u64)?,
        slots: gpu.bindable("gradient slots", row * u64::from(binned.capacity))?,
        v_splats2d: gpu.bindable("v_splats2d", row * u64::from(binned.splats))?,
    };
    // Culled splats have no gradient, and no kernel writes theirs.
    let mut ops = vec![Op::Clear(buffers.v_splats2d.clone())];
    for chunk in &binned.chunks {
        ops.extend(binned.chunk_ops(gpu, chunk));
        ops.extend(rasterize_backward_ops(
            gpu,
            binned.projection(),
            chunk,
            (&binned.bins, &binned.pairs),
            &buffers,
            absolute,
        ));
    }
    let data = gpu.download(&ops, &[(&buffers.v_splats2d, row * u64::from(binned.splats))])?;
    let mut out = ProjectedGradients {
        v_background: v_background.map(|v| v as f32),
        ..ProjectedGradients::default()
    };
    let mut v_absolute = Vec::new();
    for bytes in data[0].chunks_exact(floats * 4) {
        let row: Vec<f32> = bytemuck::pod_collect_to_vec(bytes);
        out.v_means2d.push([row[0], row[1]]);
        out.v_factors.push([row[2], row[3], row[4]]);
        out.v_depths.push(row[5]);
        out.v_colors.push([row[6], row[7], row[8]]);
        out.v_opacities.push(row[9]);
        if absolute {
            v_absolute.push([row[GRADIENT], row[GRADIENT + 1]]);
        }
    }
    out.v_means2d_absolute = absolute.then_some(v_absolute);
    Ok(out)
}
