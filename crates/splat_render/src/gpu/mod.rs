//! The stages as WGSL kernels on any Vulkan, Metal or DX12 device, through wgpu.
//!
//! Kernels need no subgroups (only llvmpipe uses them: shaders/tile_subgroup.wgsl), at most 16 KiB of
//! workgroup memory and eight storage buffers, and no workgroup waits for another. Sums are taken in a
//! fixed order, so that runs repeat bit for bit on a device. Data that exceeds one binding is processed
//! in parts, with the same bits: splats in windows, tiles in chunks.

mod adam;
mod bin;
mod depth_loss;
mod desktop;
mod device;
mod drawn;
mod exposure;
mod fit;
mod kernels;
mod layout;
mod loss;
mod mcmc;
mod original;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod resident;
mod resident_picture;
mod waiting_colors;

pub use device::{Gpu, Injected, needed_limits};
pub use fit::{GpuFit, PlannedFit};
pub use kernels::{ShaderVariant, shader_variants, shared_wgsl};
pub use resident::{ResidentSplats, ResidentView};
pub use resident_picture::ResidentPicture;

use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    AdamState, AdamStep, DepthLoss, Exposure, ExposureGradients, Image, ImageGradients, Loss,
    ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams, Stages,
};
use crate::target::{Target, TargetDepth};

impl Stages<f32> for Gpu {
    fn project_unchecked(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f32>> {
        project::project(self, splats, camera, options)
    }

    fn rasterize_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
    ) -> Result<Image<f32>> {
        rasterize::rasterize(self, projected, background)
    }

    fn rasterize_backward_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
        image: &Image<f32>,
        v_image: &ImageGradients<f32>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f32>> {
        rasterize_backward::rasterize_backward(
            self, projected, background, image, v_image, absolute,
        )
    }

    fn project_backward_unchecked(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<f32>,
        v_projected: &ProjectedGradients<f32>,
    ) -> Result<SplatGradients<f32>> {
        project_backward::project_backward(self, splats, camera, options, projected, v_projected)
    }

    fn exposure_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
    ) -> Result<Vec<[f32; 3]>> {
        exposure::exposure(self, image, exposure)
    }

    fn exposure_backward_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
        v_corrected: &[[f32; 3]],
    ) -> Result<ExposureGradients<f32>> {
        exposure::exposure_backward(self, image, exposure, v_corrected)
    }

    fn loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &Target,
        background: [f32; 3],
        ssim_weight: f32,
    ) -> Result<Loss<f32>> {
        loss::loss(self, image, target, background, ssim_weight)
    }

    fn depth_loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &TargetDepth,
    ) -> Result<DepthLoss<f32>> {
        depth_loss::depth_loss(self, image, target)
    }

    fn adam_unchecked(
        &self,
        state: &mut AdamState<f32>,
        gradients: &SplatGradients<f32>,
        step: &AdamStep,
    ) -> Result<()> {
        adam::adam(self, state, gradients, step)
    }
}
