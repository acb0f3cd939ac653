//! The reference behind the f32 interface, so that what every implementation must get through is
//! also asked of the oracle.

use splat_render::fit::{Target, TargetDepth};
use splat_render::reference::Reference;
use splat_render::stages::{AdamState, AdamStep, DepthLoss, Exposure, ExposureGradients, Loss};
use splat_render::{
    Camera, Colors, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, Result,
    SplatGradients, SplatParams, Stages,
};

use super::*;

/// The reference on widened arguments; what leaves f32's range comes back as its largest value.
pub struct Narrowed;

fn widened(splats: &SplatParams<'_, f32>) -> Scene<f64> {
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
        Ok(narrow_projected(&Reference.project(&widened(splats).params(), camera, options)?))
    }

    fn rasterize_unchecked(
        &self,
        projected: &Projected<f32>,
        background: [f32; 3],
    ) -> Result<Image<f32>> {
        let image = Reference.rasterize(&widen_projected(projected), background.map(f64::from))?;
        Ok(Image {
            width: image.width,
            height: image.height,
            color: narrow(&image.color),
            alpha: narrow1(&image.alpha),
            depth: narrow1(&image.depth),
            transmittance: narrow1(&image.transmittance),
        })
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
        Ok(ProjectedGradients {
            v_means2d: narrow(&v.v_means2d),
            v_factors: narrow(&v.v_factors),
            v_depths: narrow1(&v.v_depths),
            v_colors: narrow(&v.v_colors),
            v_opacities: narrow1(&v.v_opacities),
            v_background: narrow(&[v.v_background])[0],
            v_means2d_absolute: v.v_means2d_absolute.as_deref().map(narrow),
        })
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
        Ok(SplatGradients {
            v_means: narrow(&v.v_means),
            v_quats: narrow(&v.v_quats),
            v_scales: narrow(&v.v_scales),
            v_opacities: narrow1(&v.v_opacities),
            v_colors: narrow(&v.v_colors),
            v_viewmat: v.v_viewmat,
            v_intrinsics: v.v_intrinsics,
        })
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
            value: loss.value as f32,
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
        Ok(Loss { value: narrow1(&[loss.value])[0], v_color: narrow(&loss.v_color) })
    }

    fn adam_unchecked(
        &self,
        state: &mut AdamState<f32>,
        gradients: &SplatGradients<f32>,
        step: &AdamStep,
    ) -> Result<()> {
        let mut wide = widen_adam_state(state);
        Reference.adam(&mut wide, &widen_splat_gradients(gradients), step)?;
        let narrowed = |arrays: &SplatArrays<f64>| SplatArrays {
            means: narrow(&arrays.means),
            quats: narrow(&arrays.quats),
            scales: narrow(&arrays.scales),
            opacities: narrow1(&arrays.opacities),
            sh: narrow(&arrays.sh),
            sh_degree: arrays.sh_degree,
        };
        *state = AdamState {
            splats: narrowed(&wide.splats),
            first: narrowed(&wide.first),
            second: narrowed(&wide.second),
        };
        Ok(())
    }
}
