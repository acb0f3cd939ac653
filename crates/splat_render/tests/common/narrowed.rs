//! The reference behind the f32 interface, so that it must pass the same checks.

use splat_render::fit::{Target, TargetDepth};
use splat_render::reference::Reference;
use splat_render::stages::{AdamState, AdamStep, DepthLoss, Exposure, ExposureGradients, Loss};
use splat_render::{
    Camera, Colors, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, Result,
    SplatGradients, SplatParams, Stages,
};

use super::*;

/// The reference on widened arguments; results are clamped to f32's range.
pub struct Narrowed;

pub fn widened(splats: &SplatParams<'_, f32>) -> Scene<f64> {
    let (sh_degree, sh_stride, colors) = match splats.colors {
        Colors::Direct(colors) => (0, 0, colors),
        Colors::Sh { degree, stride, coeffs } => (degree, stride, coeffs),
    };
    Scene {
        means: widen(splats.means),
        quats: widen(splats.quats),
        scales: widen(splats.scales),
        opacities: widen(splats.opacities),
        colors: widen(colors),
        sh_degree,
        sh_stride,
        raw: splats.raw,
    }
}

impl Stages<f32> for Narrowed {
    fn project_unchecked(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<f32>> {
        Ok(narrow(&Reference.project(&widened(splats).params(), camera, options)?))
    }

    fn rasterize_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
    ) -> Result<Image<f32>> {
        Ok(narrow(&Reference.rasterize(&widen(projected), widen(&background))?))
    }

    fn rasterize_backward_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
        image: &Image<f32>,
        v_image: &ImageGradients<f32>,
        absolute: bool,
    ) -> Result<ProjectedGradients<f32>> {
        let v = Reference.rasterize_backward(
            &widen(projected),
            widen(&background),
            &widen(image),
            &widen(v_image),
            absolute,
        )?;
        Ok(narrow(&v))
    }

    fn project_backward_unchecked(
        &self,
        splats: &SplatParams<'_, f32>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<f32>,
        v_projected: &ProjectedGradients<f32>,
    ) -> Result<SplatGradients<f32>> {
        let v = Reference.project_backward(
            &widened(splats).params(),
            camera,
            options,
            &widen(projected),
            &widen(v_projected),
        )?;
        Ok(narrow(&v))
    }

    fn exposure_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
    ) -> Result<Vec<[f32; 3]>> {
        Ok(narrow(&Reference.exposure(&widen(image), &widen(exposure))?))
    }

    fn exposure_backward_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
        v_corrected: &[[f32; 3]],
    ) -> Result<ExposureGradients<f32>> {
        let (image, exposure) = (widen(image), widen(exposure));
        Ok(narrow(&Reference.exposure_backward(&image, &exposure, &widen(v_corrected))?))
    }

    fn depth_loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &TargetDepth,
    ) -> Result<DepthLoss<f32>> {
        Ok(narrow(&Reference.depth_loss(&widen(image), target)?))
    }

    fn loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &Target,
        background: [f32; 3],
        ssim_weight: f32,
    ) -> Result<Loss<f32>> {
        Ok(narrow(&Reference.loss(&widen(image), target, widen(&background), ssim_weight)?))
    }

    fn adam_unchecked(
        &self,
        state: &mut AdamState<f32>,
        gradients: &SplatGradients<f32>,
        step: &AdamStep,
    ) -> Result<()> {
        let mut wide = widen(state);
        Reference.adam(&mut wide, &widen(gradients), step)?;
        *state = narrow(&wide);
        Ok(())
    }
}
