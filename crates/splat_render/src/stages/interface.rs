//! The trait of all implementations. Its provided methods check arguments in one place.

use num_traits::Float;

use super::{
    AdamState, AdamStep, DepthLoss, Exposure, ExposureGradients, Image, ImageGradients, Loss,
    ProjectOptions, Projected, ProjectedGradients, SplatGradients, check_lengths,
};
use crate::camera::{Camera, check_memory, check_size};
use crate::error::{Error, Result};
use crate::splats::SplatParams;
use crate::target::{Target, TargetDepth};

/// The stages of rendering and fitting. Call the plain methods: they check their arguments and return
/// [`Error::Argument`] with the name of a wrong one. An implementation provides the `*_unchecked`
/// methods. Binning runs inside the two rasterize stages.
pub trait Stages<T: Float> {
    /// Projects splats to 2D splats.
    fn project(
        &self,
        splats: &SplatParams<'_, T>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<T>> {
        splats.validate()?;
        camera.validate()?;
        options.validate()?;
        self.project_unchecked(splats, camera, options)
    }

    /// Renders 2D splats over `background`.
    fn rasterize(&self, projected: &Projected<T>, background: [T; 3]) -> Result<Image<T>> {
        projected.validate()?;
        check_memory(projected.width, projected.height)?;
        self.rasterize_unchecked(projected, background)
    }

    /// Computes gradients of the 2D splats from gradients of the picture. `image` is the result of
    /// [`Stages::rasterize`] for the same arguments. `absolute` asks for
    /// [`ProjectedGradients::v_means2d_absolute`].
    fn rasterize_backward(
        &self,
        projected: &Projected<T>,
        background: [T; 3],
        image: &Image<T>,
        v_image: &ImageGradients<T>,
        absolute: bool,
    ) -> Result<ProjectedGradients<T>> {
        projected.validate()?;
        v_image.validate(projected, image)?;
        self.rasterize_backward_unchecked(projected, background, image, v_image, absolute)
    }

    /// Computes gradients of the splats and the camera from gradients of the 2D splats.
    fn project_backward(
        &self,
        splats: &SplatParams<'_, T>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<T>,
        v_projected: &ProjectedGradients<T>,
    ) -> Result<SplatGradients<T>> {
        splats.validate()?;
        camera.validate()?;
        options.validate()?;
        projected.validate()?;
        v_projected.validate(splats.len(), projected.len())?;
        self.project_backward_unchecked(splats, camera, options, projected, v_projected)
    }

    /// Applies a photo's gain and offset to a picture's colors, `[H * W]`; see [`Exposure`].
    fn exposure(&self, image: &Image<T>, exposure: &Exposure<T>) -> Result<Vec<[T; 3]>> {
        check_exposure(image, exposure)?;
        self.exposure_unchecked(image, exposure)
    }

    /// Computes gradients of the picture, gain and offset from gradients of the corrected colors, `[H *
    /// W]`. Arguments as in [`Stages::exposure`].
    fn exposure_backward(
        &self,
        image: &Image<T>,
        exposure: &Exposure<T>,
        v_corrected: &[[T; 3]],
    ) -> Result<ExposureGradients<T>> {
        check_exposure(image, exposure)?;
        let lengths = [("v_corrected", v_corrected.len())];
        check_lengths(&lengths, image.color.len(), "pixels, but the picture has")?;
        self.exposure_backward_unchecked(image, exposure, v_corrected)
    }

    /// Loss of a picture against a photo over `background`, with its gradient:
    /// `sum_p w_p ((1 - s) mean_c |x - y| + s (1 - mean_c SSIM)) / count` over pixels p of weight w
    /// and channels c, with s the `ssim_weight` in 0..=1, `count` the number of pixels with a nonzero
    /// weight, and zeros around the picture in SSIM's window (Wang et al. 2004; 3DGS, eq. 7).
    fn loss(
        &self,
        image: &Image<T>,
        target: &Target,
        background: [T; 3],
        ssim_weight: f32,
    ) -> Result<Loss<T>> {
        target.validate(0)?;
        let (width, height) = (target.width, target.height);
        if (image.width, image.height) != (width, height) {
            return Err(Error::argument(
                "image",
                format!(
                    "is {} x {}, but the photo is {width} x {height}",
                    image.width, image.height
                ),
            ));
        }
        let pixels = width as usize * height as usize;
        check_lengths(&[("image", image.color.len())], pixels, "pixels, but the photo has")?;
        if !(0.0..=1.0).contains(&ssim_weight) {
            return Err(Error::argument(
                "ssim_weight",
                format!("must be in 0..=1, got {ssim_weight}"),
            ));
        }
        self.loss_unchecked(image, target, background, ssim_weight)
    }

    /// Loss of a picture's depth against a photo's, with its gradients:
    /// `sum_p c_p 2 |D_p - A_p z_p| / (D_p + A_p z_p) / count` over pixels p with A the picture's
    /// alpha, D its accumulated depth, z the photo's depth, c its confidence, and `count` the number of
    /// pixels with a nonzero confidence. A pixel's term is close to the relative difference and at most
    /// 2, which bounds the influence of single wrong depths. Pixels with A below
    /// [`DEPTH_ALPHA`](crate::constants::DEPTH_ALPHA) do not count. Reads the image's alpha, depth and
    /// transmittance.
    fn depth_loss(&self, image: &Image<T>, target: &TargetDepth) -> Result<DepthLoss<T>> {
        let pixels = image.width as usize * image.height as usize;
        target.validate(pixels).map_err(|reason| Error::argument("target", reason))?;
        let lengths = [
            ("image", image.alpha.len()),
            ("image", image.depth.len()),
            ("image", image.transmittance.len()),
        ];
        check_lengths(&lengths, pixels, "pixels, but its size requires")?;
        self.depth_loss_unchecked(image, target)
    }

    /// Does one optimizer step of all parameters (Kingma and Ba, 2015, algorithm 1) with the
    /// regularizers, then adds the exploration noise. `gradients` come from
    /// [`Stages::project_backward`]; the camera's are not read.
    fn adam(
        &self,
        state: &mut AdamState<T>,
        gradients: &SplatGradients<T>,
        step: &AdamStep,
    ) -> Result<()> {
        step.validate()?;
        state.validate(gradients)?;
        self.adam_unchecked(state, gradients, step)
    }

    /// Implements [`Stages::project`].
    fn project_unchecked(
        &self,
        splats: &SplatParams<'_, T>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<T>>;

    /// Implements [`Stages::rasterize`].
    fn rasterize_unchecked(&self, projected: &Projected<T>, background: [T; 3])
    -> Result<Image<T>>;

    /// Implements [`Stages::rasterize_backward`].
    fn rasterize_backward_unchecked(
        &self,
        projected: &Projected<T>,
        background: [T; 3],
        image: &Image<T>,
        v_image: &ImageGradients<T>,
        absolute: bool,
    ) -> Result<ProjectedGradients<T>>;

    /// Implements [`Stages::project_backward`].
    fn project_backward_unchecked(
        &self,
        splats: &SplatParams<'_, T>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<T>,
        v_projected: &ProjectedGradients<T>,
    ) -> Result<SplatGradients<T>>;

    /// Implements [`Stages::exposure`].
    fn exposure_unchecked(&self, image: &Image<T>, exposure: &Exposure<T>) -> Result<Vec<[T; 3]>>;

    /// Implements [`Stages::exposure_backward`].
    fn exposure_backward_unchecked(
        &self,
        image: &Image<T>,
        exposure: &Exposure<T>,
        v_corrected: &[[T; 3]],
    ) -> Result<ExposureGradients<T>>;

    /// Implements [`Stages::loss`].
    fn loss_unchecked(
        &self,
        image: &Image<T>,
        target: &Target,
        background: [T; 3],
        ssim_weight: f32,
    ) -> Result<Loss<T>>;

    /// Implements [`Stages::depth_loss`].
    fn depth_loss_unchecked(&self, image: &Image<T>, target: &TargetDepth) -> Result<DepthLoss<T>>;

    /// Implements [`Stages::adam`].
    fn adam_unchecked(
        &self,
        state: &mut AdamState<T>,
        gradients: &SplatGradients<T>,
        step: &AdamStep,
    ) -> Result<()>;
}

fn check_exposure<T: Float>(image: &Image<T>, exposure: &Exposure<T>) -> Result<()> {
    exposure.validate()?;
    check_size(image.width, image.height)?;
    let pixels = image.width as usize * image.height as usize;
    let lengths = [("image", image.color.len()), ("image", image.transmittance.len())];
    check_lengths(&lengths, pixels, "pixels, but its size requires")
}
