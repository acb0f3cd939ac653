//! loss: L1 and D-SSIM of the picture against a photo, with the picture's gradient.

use super::device::{Gpu, Op};
use super::shaders::Kernel;
use crate::constants::TILE;
use crate::error::Result;

/// What the loss reads and writes for pictures of one size.
#[derive(Debug)]
pub(super) struct LossBuffers {
    /// `[H * W]` RGBA bytes.
    pub photo: wgpu::Buffer,
    /// `[H * W]`
    pub weights: wgpu::Buffer,
    /// `[9 * H * W]`
    slopes: wgpu::Buffer,
    /// `[workgroups * 2]` weighted sums of SSIM and of |x - y|.
    pub sums: wgpu::Buffer,
    groups: [u32; 2],
}

impl LossBuffers {
    /// For pictures of one size.
    pub fn new(gpu: &Gpu, width: u32, height: u32) -> Result<Self> {
        let pixels = u64::from(width) * u64::from(height);
        let groups = [width.div_ceil(TILE), height.div_ceil(TILE)];
        Ok(Self {
            photo: gpu.bindable("photo", 4 * pixels)?,
            weights: gpu.bindable("weights", 4 * pixels)?,
            slopes: gpu.bindable("slopes of SSIM", 36 * pixels)?,
            sums: gpu.bindable("loss sums", 8 * u64::from(groups[0] * groups[1]))?,
            groups,
        })
    }

    /// Bytes of [`Self::sums`].
    pub fn sum_bytes(&self) -> u64 {
        8 * u64::from(self.groups[0] * self.groups[1])
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

    /// Both passes.
    pub fn ops(
        &self,
        gpu: &Gpu,
        view: &wgpu::Buffer,
        step: &wgpu::Buffer,
        picture: &wgpu::Buffer,
        v_picture: &wgpu::Buffer,
        totals: &wgpu::Buffer,
    ) -> Vec<Op> {
        let bindings = [
            view.into(),
            step.into(),
            picture.into(),
            (&self.photo).into(),
            (&self.weights).into(),
            (&self.slopes).into(),
            v_picture.into(),
            totals.into(),
            (&self.sums).into(),
        ];
        vec![
            gpu.op(Kernel::LossSlopes, &bindings, self.groups),
            gpu.op(Kernel::LossGradient, &bindings, self.groups),
        ]
    }
}
