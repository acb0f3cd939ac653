//! loss: L1 and D-SSIM of the picture against a photo, with the picture's gradient.

use bytemuck::Zeroable;

use super::bin::tile_count;
use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{Step, View};
use crate::constants::TILE;
use crate::error::Result;
use crate::stages::{Image, Loss};
use crate::target::Target;

/// Rows or columns per workgroup of the loss by lines.
const LINES_PER_GROUP: u32 = 8;

/// A photo's pixels in the kernels' layout; opaque without alpha.
pub(super) fn rgba(target: &Target) -> Vec<[u8; 4]> {
    let pixels = target.pixels.chunks_exact(target.channels as usize);
    pixels.map(|p| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)]).collect()
}

/// Buffers of the loss for pictures of one size.
#[derive(Debug)]
pub(super) struct LossBuffers {
    /// `[H * W]` RGBA bytes.
    pub photo: wgpu::Buffer,
    /// `[H * W]`
    pub weights: wgpu::Buffer,
    /// `[9 * H * W]` slopes of SSIM; `[12 * H * W]` intermediate data of the loss by lines.
    slopes: wgpu::Buffer,
    /// `[H * W]` gradients of color and, 0, accumulated depth.
    pub v_picture: wgpu::Buffer,
    /// `[H * W]` color . v_color.
    pub totals: wgpu::Buffer,
    /// `[parts * 2]` weighted sums of SSIM and of |x - y|.
    pub sums: wgpu::Buffer,
    size: [u32; 2],
    parts: u32,
}

impl LossBuffers {
    pub fn new(gpu: &Gpu, width: u32, height: u32) -> Result<Self> {
        let pixels = u64::from(width) * u64::from(height);
        let (parts, planes) = if gpu.loss_by_lines() {
            (width.max(height), 12)
        } else {
            (tile_count(width, height), 9)
        };
        Ok(Self {
            photo: gpu.bindable("photo", 4 * pixels)?,
            weights: gpu.bindable("weights", 4 * pixels)?,
            slopes: gpu.bindable("slopes of SSIM", 4 * planes * pixels)?,
            v_picture: gpu.bindable("v_picture", 16 * pixels)?,
            totals: gpu.bindable("totals", 4 * pixels)?,
            sums: gpu.bindable("loss sums", 8 * u64::from(parts))?,
            size: [width, height],
            parts,
        })
    }

    pub fn sum_bytes(&self) -> u64 {
        8 * u64::from(self.parts)
    }

    /// Sums of weighted SSIM and |x - y| from downloaded [`Self::sums`].
    pub fn total(bytes: &[u8]) -> [f64; 2] {
        let mut total = [0.0f64; 2];
        for pair in bytes.chunks_exact(8) {
            let pair: [f32; 2] = bytemuck::pod_read_unaligned(pair);
            total[0] += f64::from(pair[0]);
            total[1] += f64::from(pair[1]);
        }
        total
    }

    pub fn ops(
        &self,
        gpu: &Gpu,
        view: &wgpu::Buffer,
        step: &wgpu::Buffer,
        picture: &wgpu::Buffer,
    ) -> Vec<Op> {
        let bindings = [
            view.into(),
            step.into(),
            picture.into(),
            (&self.photo).into(),
            (&self.weights).into(),
            (&self.slopes).into(),
            (&self.v_picture).into(),
            (&self.totals).into(),
            (&self.sums).into(),
        ];
        if gpu.loss_by_lines() {
            let [columns, rows] = self.size.map(|lines| [lines.div_ceil(LINES_PER_GROUP), 1]);
            return vec![
                gpu.op(Kernel::LossColumns, &bindings, columns),
                gpu.op(Kernel::LossRows, &bindings, rows),
                gpu.op(Kernel::LossColumnsGradient, &bindings, columns),
            ];
        }
        let tiles = self.size.map(|side| side.div_ceil(TILE));
        vec![
            gpu.op(Kernel::LossSlopes, &bindings, tiles),
            gpu.op(Kernel::LossGradient, &bindings, tiles),
        ]
    }
}

pub(super) fn loss(
    gpu: &Gpu,
    image: &Image<f32>,
    target: &Target,
    background: [f32; 3],
    ssim_weight: f32,
) -> Result<Loss<f32>> {
    let (width, height) = (image.width, image.height);
    let pixels = u64::from(width) * u64::from(height);
    let mut buffers = LossBuffers::new(gpu, width, height)?;
    buffers.photo = gpu.upload("photo", &rgba(target))?;
    if let Some(weights) = &target.weights {
        buffers.weights = gpu.upload("weights", weights)?;
    }
    let picture: Vec<[f32; 4]> = image.color.iter().map(|&[r, g, b]| [r, g, b, 0.0]).collect();
    gpu.bindable_bytes("picture", 16 * pixels)?;
    let picture = gpu.upload("picture", &picture)?;
    let view = gpu.uniform(&View::of_picture(width, height, background));
    let weight = target.weight();
    let step = Step::zeroed().with_loss(ssim_weight, weight, target.weights.is_some());
    let ops = buffers.ops(gpu, &view, &gpu.uniform(&step), &picture);
    let wanted = [(&buffers.v_picture, 16 * pixels), (&buffers.sums, buffers.sum_bytes())];
    let data = gpu.download(&ops, &wanted)?;
    let v_picture: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&data[0]);
    let [ssim, l1] = LossBuffers::total(&data[1]);
    Ok(Loss {
        value: weight.loss(f64::from(ssim_weight), l1, ssim) as f32,
        v_color: v_picture.iter().map(|v| [v[0], v[1], v[2]]).collect(),
    })
}
