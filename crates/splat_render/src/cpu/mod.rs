//! The CPU backend: f32, SIMD picked at run time, rayon over tiles and splats.
//!
//! Results do not depend on the number of threads: every sum has a fixed order.

mod adam;
mod bin;
mod block;
mod depth_loss;
mod elementary;
mod explore;
mod exposure;
mod fit;
mod lanes;
mod loss;
mod peak;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod simd;
mod ssim_window;
mod tile;
mod waiting_colors;

pub use fit::CpuFit;
pub use peak::peak_multiply_add;
pub(crate) use simd::dispatch;
pub use simd::instruction_set;

use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    AdamState, AdamStep, DepthLoss, Exposure, ExposureGradients, Image, ImageGradients, Loss,
    ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams, Stages,
};
use crate::target::{Target, TargetDepth};

/// The CPU implementation.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;

impl Stages<f32> for Cpu {
    fn project_unchecked(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f32>> {
        Ok(project::project(splats, camera, options))
    }

    fn rasterize_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
    ) -> Result<Image<f32>> {
        rasterize::rasterize(projected, background)
    }

    fn rasterize_backward_unchecked(
        &self,
        projected: &Projected<f32>,
        _background: [f32; 3],
        image: &Image<f32>,
        v_image: &ImageGradients<f32>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f32>> {
        rasterize_backward::rasterize_backward(projected, image, v_image, absolute)
    }

    fn project_backward_unchecked(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<f32>,
        v_projected: &ProjectedGradients<f32>,
    ) -> Result<SplatGradients<f32>> {
        Ok(project_backward::project_backward(splats, camera, options, projected, v_projected))
    }

    fn exposure_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
    ) -> Result<Vec<[f32; 3]>> {
        Ok(exposure::exposure(image, exposure))
    }

    fn exposure_backward_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
        v_corrected: &[[f32; 3]],
    ) -> Result<ExposureGradients<f32>> {
        Ok(exposure::exposure_backward(image, exposure, v_corrected))
    }

    fn loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &Target,
        background: [f32; 3],
        ssim_weight: f32,
    ) -> Result<Loss<f32>> {
        Ok(loss::loss(image, target, background, ssim_weight))
    }

    fn depth_loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &TargetDepth,
    ) -> Result<DepthLoss<f32>> {
        Ok(depth_loss::depth_loss(image, target))
    }

    fn adam_unchecked(
        &self,
        state: &mut AdamState<f32>,
        gradients: &SplatGradients<f32>,
        step: &AdamStep,
    ) -> Result<()> {
        adam::adam(state, gradients, step);
        Ok(())
    }
}
