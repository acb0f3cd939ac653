//! depth_loss: relative difference of a picture's depth and a photo's, with its gradients.

use super::device::{Gpu, Op};
use super::kernels::Kernel;
use super::layout::{DEPTH_GROUPS, DepthStep, View};
use crate::error::Result;
use crate::stages::{DepthLoss, Image};
use crate::target::TargetDepth;

/// A photo's depths and their confidences, as the kernel reads them.
pub(super) fn depth_rows(target: &TargetDepth) -> Vec<[f32; 2]> {
    target.depths.iter().zip(&target.confidences).map(|(&z, &c)| [z, c]).collect()
}

/// Copy of a photo's depths, and sums, for pictures of one size.
#[derive(Debug)]
pub(super) struct DepthBuffers {
    /// `[H * W]` depth and confidence.
    pub photo: wgpu::Buffer,
    /// `[DEPTH_GROUPS]`
    pub sums: wgpu::Buffer,
}

/// Inputs of the kernel and buffers that it updates.
#[derive(Debug, Clone, Copy)]
pub(super) struct Compared<'a> {
    /// A [`View`].
    pub view: &'a wgpu::Buffer,
    /// A [`DepthStep`].
    pub uniform: &'a wgpu::Buffer,
    /// `[H * W]` color and transmittance.
    pub picture: &'a wgpu::Buffer,
    /// `[H * W]` accumulated depth.
    pub depths: &'a wgpu::Buffer,
    /// `[H * W]` gradients of color and, from here on, accumulated depth.
    pub v_picture: &'a wgpu::Buffer,
    /// `[H * W]` as rasterize_backward reads them.
    pub totals: &'a wgpu::Buffer,
}

impl DepthBuffers {
    pub const SUM_BYTES: u64 = DEPTH_GROUPS as u64 * 4;

    pub fn new(gpu: &Gpu, pixels: u64) -> Result<Self> {
        Ok(Self {
            photo: gpu.bindable("depths of a photo", 8 * pixels)?,
            sums: gpu.bindable("depth loss sums", Self::SUM_BYTES)?,
        })
    }

    /// Adds the loss's gradients to the picture's.
    pub fn op(&self, gpu: &Gpu, of: Compared<'_>) -> Op {
        let bindings = [
            of.view.into(),
            of.uniform.into(),
            of.picture.into(),
            of.depths.into(),
            (&self.photo).into(),
            of.v_picture.into(),
            of.totals.into(),
            (&self.sums).into(),
        ];
        gpu.op(Kernel::DepthLoss, &bindings, [DEPTH_GROUPS, 1])
    }

    /// The loss from downloaded [`Self::sums`].
    pub fn total(bytes: &[u8]) -> f64 {
        let sums = bytes.chunks_exact(4).map(bytemuck::pod_read_unaligned::<f32>);
        sums.map(f64::from).sum()
    }
}

pub(super) fn depth_loss(
    gpu: &Gpu,
    image: &Image<f32>,
    target: &TargetDepth,
) -> Result<DepthLoss<f32>> {
    let pixels = image.depth.len();
    let bytes = pixels as u64 * 16;
    gpu.bindable_bytes("picture", bytes)?;
    let picture: Vec<[f32; 4]> = image.transmittance.iter().map(|&t| [0.0, 0.0, 0.0, t]).collect();
    let mut buffers = DepthBuffers::new(gpu, pixels as u64)?;
    buffers.photo = gpu.upload("depths of a photo", &depth_rows(target))?;
    let v_picture = gpu.upload("v_picture", &vec![[0.0f32; 4]; pixels])?;
    let totals = gpu.upload("totals", &vec![0.0f32; pixels])?;
    let op = buffers.op(
        gpu,
        Compared {
            view: &gpu.uniform(&View::of_picture(image.width, image.height, [0.0; 3])),
            uniform: &gpu.uniform(&DepthStep { scale: target.scale() as f32 }),
            picture: &gpu.upload("picture", &picture)?,
            depths: &gpu.upload("depths", &image.depth)?,
            v_picture: &v_picture,
            totals: &totals,
        },
    );
    let wanted =
        [(&v_picture, bytes), (&totals, bytes / 4), (&buffers.sums, DepthBuffers::SUM_BYTES)];
    let data = gpu.download(&[op], &wanted)?;
    let v_picture: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&data[0]);
    let v_depth: Vec<f32> = v_picture.iter().map(|v| v[3]).collect();
    let totals: Vec<f32> = bytemuck::pod_collect_to_vec(&data[1]);
    // A total is depth v_depth - transmittance v_alpha, and depth v_depth is -alpha v_alpha.
    let v_alpha = totals.iter().map(|total| -total).collect();
    Ok(DepthLoss { value: DepthBuffers::total(&data[2]) as f32, v_alpha, v_depth })
}
