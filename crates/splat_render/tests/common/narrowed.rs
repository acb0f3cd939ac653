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
        opacities: widen1(splats.opacities),
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
        let projected = Reference.project(&widened(splats).params(), camera, options)?;
        Ok(convert_projected(&projected, narrowed))
    }

    fn rasterize_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
    ) -> Result<Image<f32>> {
        let image = Reference.rasterize(&widen_projected(projected), background.map(f64::from))?;
        Ok(convert_image(&image, narrowed))
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
            &widen_projected(projected),
            background.map(f64::from),
            &widen_image(image),
            &widen_image_gradients(v_image),
            absolute,
        )?;
        Ok(convert_projected_gradients(&v, narrowed))
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
            &widen_projected(projected),
            &widen_projected_gradients(v_projected),
        )?;
        Ok(convert_splat_gradients(&v, narrowed))
    }

    fn exposure_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
    ) -> Result<Vec<[f32; 3]>> {
        Ok(narrow(&Reference.exposure(&widen_image(image), &widen_exposure(exposure))?))
    }

    fn exposure_backward_unchecked(
        &self,
        image: &Image<f32>,
        exposure: &Exposure<f32>,
        v_corrected: &[[f32; 3]],
    ) -> Result<ExposureGradients<f32>> {
        let (image, exposure) = (widen_image(image), widen_exposure(exposure));
        let v = Reference.exposure_backward(&image, &exposure, &widen(v_corrected))?;
        Ok(ExposureGradients {
            v_color: narrow(&v.v_color),
            v_alpha: narrow1(&v.v_alpha),
            v_gain: v.v_gain,
            v_offset: v.v_offset,
        })
    }

    fn depth_loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &TargetDepth,
    ) -> Result<DepthLoss<f32>> {
        let loss = Reference.depth_loss(&widen_image(image), target)?;
        Ok(DepthLoss {
            value: narrowed(loss.value),
            v_alpha: narrow1(&loss.v_alpha),
            v_depth: narrow1(&loss.v_depth),
        })
    }

    fn loss_unchecked(
        &self,
        image: &Image<f32>,
        target: &Target,
        background: [f32; 3],
        ssim_weight: f32,
    ) -> Result<Loss<f32>> {
        let background = background.map(f64::from);
        let loss = Reference.loss(&widen_image(image), target, background, ssim_weight)?;
        Ok(Loss { value: narrowed(loss.value), v_color: narrow(&loss.v_color) })
    }

    fn adam_unchecked(
        &self,
        state: &mut AdamState<f32>,
        gradients: &SplatGradients<f32>,
        step: &AdamStep,
    ) -> Result<()> {
        let mut wide = widen_adam_state(state);
        Reference.adam(&mut wide, &widen_splat_gradients(gradients), step)?;
        *state = convert_adam_state(&wide, narrowed);
        Ok(())
    }
}
