//! The reference: f64, short, plain, untiled. All implementations are tested against it.

mod adam;
mod depth_loss;
mod exposure;
mod kinks;
mod loss;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;

pub use kinks::decisions;
pub use rasterize::band_pixels;

use crate::camera::Camera;
use crate::error::Result;
use crate::stages::{
    AdamState, AdamStep, DepthLoss, Exposure, ExposureGradients, Image, ImageGradients, Loss,
    ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams, Stages,
};
use crate::target::{Target, TargetDepth};

/// The f64 reference implementation.
#[derive(Debug, Clone, Copy, Default)]
pub struct Reference;

impl Stages<f64> for Reference {
    fn project_unchecked(
        &self,
        splats: &SplatParams<'_, f64>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f64>> {
        Ok(project::project(splats, camera, options))
    }

    fn rasterize_unchecked(
        &self,
        projected: &Projected<f64>,
        background: [f64; 3],
    ) -> Result<Image<f64>> {
        Ok(rasterize::rasterize(projected, background))
    }

    fn rasterize_backward_unchecked(
        &self,
        projected: &Projected<f64>,
        background: [f64; 3],
        _image: &Image<f64>,
        v_image: &ImageGradients<f64>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f64>> {
        Ok(rasterize_backward::rasterize_backward(projected, background, v_image, absolute))
    }

    fn project_backward_unchecked(
        &self,
        splats: &SplatParams<'_, f64>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<f64>,
        v_projected: &ProjectedGradients<f64>,
    ) -> Result<SplatGradients<f64>> {
        Ok(project_backward::project_backward(splats, camera, options, projected, v_projected))
    }

    fn exposure_unchecked(
        &self,
        image: &Image<f64>,
        exposure: &Exposure<f64>,
    ) -> Result<Vec<[f64; 3]>> {
        Ok(exposure::exposure(image, exposure))
    }

    fn exposure_backward_unchecked(
        &self,
        image: &Image<f64>,
        exposure: &Exposure<f64>,
        v_corrected: &[[f64; 3]],
    ) -> Result<ExposureGradients<f64>> {
        Ok(exposure::exposure_backward(image, exposure, v_corrected))
    }

    fn loss_unchecked(
        &self,
        image: &Image<f64>,
        target: &Target,
        background: [f64; 3],
        ssim_weight: f32,
    ) -> Result<Loss<f64>> {
        Ok(loss::loss(image, target, background, ssim_weight))
    }

    fn depth_loss_unchecked(
        &self,
        image: &Image<f64>,
        target: &TargetDepth,
    ) -> Result<DepthLoss<f64>> {
        Ok(depth_loss::depth_loss(image, target))
    }

    fn adam_unchecked(
        &self,
        state: &mut AdamState<f64>,
        gradients: &SplatGradients<f64>,
        step: &AdamStep,
    ) -> Result<()> {
        adam::adam(state, gradients, step);
        Ok(())
    }
}
