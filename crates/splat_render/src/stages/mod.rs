//! The data that passes between the stages, and [`Stages`], the trait of all implementations.
//!
//! All arrays are on the host; an implementation may copy them to its device. `T` is f64 in the reference
//! and f32 elsewhere.

mod depth_loss;
mod exposure;
mod interface;

/// The trait of number types that [`Stages`] takes: f32 and f64.
pub use num_traits::Float;

use crate::camera::check_size;
use crate::constants::{ADAM, BLUR, FAR, NEAR};
use crate::error::{Error, Result};
use crate::splats::SplatArrays;

pub use crate::splats::{Colors, SplatParams};
pub use depth_loss::DepthLoss;
pub(crate) use depth_loss::pixel as depth_pixel;
pub use exposure::{Exposure, ExposureGradients};
pub use interface::Stages;

/// Checks that every named length is `expected`; `unit` goes between the two numbers of the error.
fn check_lengths(lengths: &[(&str, usize)], expected: usize, unit: &str) -> Result<()> {
    for &(name, length) in lengths {
        if length != expected {
            return Err(Error::argument(name, format!("has {length} {unit} {expected}")));
        }
    }
    Ok(())
}

/// Settings of the project stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectOptions {
    /// Splats nearer than this are culled, world units.
    pub near: f32,
    /// Splats farther than this are culled, world units.
    pub far: f32,
    /// Variance in px^2 added to both axes of the 2D covariance.
    pub blur: f32,
    /// Whether opacities are lowered to compensate for the area that the blur adds, so that small splats
    /// keep their weight in the picture: times sqrt(det S / det(S + blur I)), S the 2D covariance without
    /// blur (the 2D filter of Mip-Splatting, Yu et al. 2024, section 4.2).
    pub antialiased: bool,
}

impl Default for ProjectOptions {
    fn default() -> Self {
        Self { near: NEAR, far: FAR, blur: BLUR, antialiased: false }
    }
}

impl ProjectOptions {
    /// Checks every setting.
    pub fn validate(&self) -> Result<()> {
        for (name, value) in [("near", self.near), ("blur", self.blur)] {
            if !(value.is_finite() && value >= 0.0) {
                let reason = format!("must be finite and not negative, got {value}");
                return Err(Error::argument(name, reason));
            }
        }
        if self.far.is_nan() || self.far <= self.near {
            return Err(Error::argument(
                "far",
                format!("must exceed near, {}, got {}", self.near, self.far),
            ));
        }
        Ok(())
    }

    /// Minimum depth of drawn splats; above 0, since splats in the camera's plane have no projection.
    pub fn nearest(&self) -> f32 {
        self.near.max(f32::MIN_POSITIVE)
    }
}

/// N projected splats, splat-major. A culled splat has radii (0, 0) and zeros elsewhere.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Projected<T> {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Centers in pixels.
    pub means2d: Vec<[T; 2]>,
    /// Upper-triangular factor (p, q, r) of the conic: u = p dx + q dy, v = r dy,
    /// sigma = (u^2 + v^2) / 2, with (dx, dy) = pixel center - mean2d.
    pub factors: Vec<[T; 3]>,
    /// Camera-space z.
    pub depths: Vec<T>,
    /// Colors.
    pub colors: Vec<[T; 3]>,
    /// Opacities in 0..1, including the antialiasing factor.
    pub opacities: Vec<T>,
    /// Half-sides in px of the box outside which alpha < `ALPHA_MIN`.
    pub radii: Vec<[T; 2]>,
}

impl<T: Copy + Default> Projected<T> {
    /// N culled splats.
    pub fn culled(n: usize, width: u32, height: u32) -> Self {
        let z = T::default();
        Self {
            width,
            height,
            means2d: vec![[z; 2]; n],
            factors: vec![[z; 3]; n],
            depths: vec![z; n],
            colors: vec![[z; 3]; n],
            opacities: vec![z; n],
            radii: vec![[z; 2]; n],
        }
    }
}

impl<T> Projected<T> {
    /// Checks the size, and that all arrays have the same length.
    pub fn validate(&self) -> Result<()> {
        check_size(self.width, self.height)?;
        let lengths = [
            ("factors", self.factors.len()),
            ("depths", self.depths.len()),
            ("colors", self.colors.len()),
            ("opacities", self.opacities.len()),
            ("radii", self.radii.len()),
        ];
        check_lengths(&lengths, self.len(), "rows, but means2d has")
    }

    /// Number of splats, culled ones included.
    pub fn len(&self) -> usize {
        self.means2d.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means2d.is_empty()
    }
}

impl<T: Float> Projected<T> {
    /// Whether splat `i` is drawn: it is not culled and, since callers may put anything here, its
    /// shape and opacity are finite and its depth is above 0.
    pub fn is_drawn(&self, i: usize) -> bool {
        let [mean, radii] = [self.means2d[i], self.radii[i]];
        let shape = mean.iter().chain(&radii).chain(&self.factors[i]);
        radii != [T::zero(); 2]
            && shape.copied().all(T::is_finite)
            && self.depths[i] > T::zero()
            && self.opacities[i].is_finite()
    }
}

/// A rendered picture, row-major, H x W.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image<T> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// RGB over the background.
    pub color: Vec<[T; 3]>,
    /// 1 - final transmittance.
    pub alpha: Vec<T>,
    /// Accumulated depth: sum of weight times camera-space z.
    pub depth: Vec<T>,
    /// Final transmittance.
    pub transmittance: Vec<T>,
}

/// Gradients of a scalar loss with respect to an [`Image`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageGradients<T> {
    /// `[H * W]`
    pub v_color: Vec<[T; 3]>,
    /// `[H * W]`
    pub v_alpha: Vec<T>,
    /// `[H * W]`, of the accumulated depth.
    pub v_depth: Vec<T>,
}

impl<T> ImageGradients<T> {
    /// Checks that these and `image` have the size of the picture of `projected`.
    pub fn validate(&self, projected: &Projected<T>, image: &Image<T>) -> Result<()> {
        let size = (projected.width, projected.height);
        if (image.width, image.height) != size {
            return Err(Error::argument(
                "image",
                format!(
                    "is {} x {}, but the picture is {} x {}",
                    image.width, image.height, size.0, size.1
                ),
            ));
        }
        let lengths = [
            ("image", image.color.len()),
            ("image", image.depth.len()),
            ("image", image.alpha.len()),
            ("image", image.transmittance.len()),
            ("v_color", self.v_color.len()),
            ("v_alpha", self.v_alpha.len()),
            ("v_depth", self.v_depth.len()),
        ];
        let pixels = projected.width as usize * projected.height as usize;
        check_lengths(&lengths, pixels, "pixels, but the picture has")
    }
}

/// Gradients with respect to a [`Projected`] and the background.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ProjectedGradients<T> {
    /// `[N]`
    pub v_means2d: Vec<[T; 2]>,
    /// `[N]`
    pub v_factors: Vec<[T; 3]>,
    /// `[N]`
    pub v_depths: Vec<T>,
    /// `[N]`
    pub v_colors: Vec<[T; 3]>,
    /// `[N]`
    pub v_opacities: Vec<T>,
    /// Gradient of the background color.
    pub v_background: [T; 3],
    /// `[N]` sums over pixels of the absolute value of each pixel's part of `v_means2d`, on request
    /// (AbsGS, Ye et al. 2024; gsplat's `absgrad`); project_backward does not read it.
    pub v_means2d_absolute: Option<Vec<[T; 2]>>,
}

impl<T> ProjectedGradients<T> {
    /// Checks the lengths of the gradients and of the `projected` splats against the number of splats.
    pub fn validate(&self, splats: usize, projected: usize) -> Result<()> {
        let lengths = [
            ("projected", projected),
            ("v_means2d", self.v_means2d.len()),
            ("v_factors", self.v_factors.len()),
            ("v_depths", self.v_depths.len()),
            ("v_colors", self.v_colors.len()),
            ("v_opacities", self.v_opacities.len()),
        ];
        check_lengths(&lengths, splats, "rows, but means has")
    }
}

impl<T: Copy + Default> ProjectedGradients<T> {
    /// All zero, for N splats.
    pub fn zeros(n: usize) -> Self {
        let z = T::default();
        Self {
            v_means2d: vec![[z; 2]; n],
            v_factors: vec![[z; 3]; n],
            v_depths: vec![z; n],
            v_colors: vec![[z; 3]; n],
            v_opacities: vec![z; n],
            v_background: [z; 3],
            v_means2d_absolute: None,
        }
    }
}

/// Gradients with respect to [`SplatParams`] and the camera.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatGradients<T> {
    /// `[N]`
    pub v_means: Vec<[T; 3]>,
    /// `[N]` of the quaternions as given (before normalization).
    pub v_quats: Vec<[T; 4]>,
    /// `[N]` of the scales as given (logs if raw).
    pub v_scales: Vec<[T; 3]>,
    /// `[N]` of the opacities as given (logits if raw).
    pub v_opacities: Vec<T>,
    /// Laid out as the colors were given: `[N * stride]` or `[N]`.
    pub v_colors: Vec<[T; 3]>,
    /// Rows of the gradient of the viewmat's upper 3x4 block.
    pub v_viewmat: [[f64; 4]; 3],
    /// Gradient of (fx, fy, cx, cy).
    pub v_intrinsics: [f64; 4],
}

/// Loss of a picture against a photo.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Loss<T> {
    /// The loss; 0 if the photo is masked out everywhere.
    pub value: T,
    /// `[H * W]` its gradient with respect to the picture's colors.
    pub v_color: Vec<[T; 3]>,
}

/// Adam's step sizes per kind of parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Centers, world units.
    pub means: f32,
    /// Quaternions.
    pub quats: f32,
    /// Log-scales.
    pub scales: f32,
    /// Opacity logits.
    pub opacities: f32,
    /// SH coefficient 0.
    pub sh0: f32,
    /// Higher SH coefficients.
    pub sh_rest: f32,
}

impl Rates {
    /// No parameter moves.
    pub const ZERO: Self =
        Self { means: 0.0, quats: 0.0, scales: 0.0, opacities: 0.0, sh0: 0.0, sh_rest: 0.0 };
}

/// Settings of one optimizer step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamStep {
    /// Number of the step, from 1, for the bias correction.
    pub number: u32,
    /// Step sizes.
    pub rates: Rates,
    /// SH degree in use. Coefficients of higher degrees and their moments stay as they are.
    pub sh_degree: u32,
    /// Added to the loss: this times the mean opacity.
    pub opacity_regularizer: f32,
    /// Added to the loss: this times the mean scale (over splats and axes, world units).
    pub scale_regularizer: f32,
    /// Size of the exploration noise on the centers (3DGS-MCMC, eq. 8), 0 for none. After Adam's
    /// update: mean += C (z * noise / (1 + exp(-100 (0.005 - opacity)))) with C the splat's 3D
    /// covariance, z from [`crate::fit::noise_normal`] and the parameters as updated.
    pub noise: f32,
    /// Seed of the noise; differs from step to step.
    pub noise_seed: u32,
}

impl AdamStep {
    /// Whether all rates are 0: then no parameter, no moment, and no noise changes.
    pub fn is_frozen(&self) -> bool {
        self.rates == Rates::ZERO
    }

    /// Bias corrections of Adam's first and second moments at this step (Kingma and Ba, 2015, algorithm
    /// 1): 1 / (1 - beta^number).
    pub fn bias(&self) -> [f64; 2] {
        let number = self.number.min(i32::MAX as u32) as i32;
        [ADAM.0, ADAM.1].map(|beta| 1.0 / (1.0 - f64::from(beta).powi(number)))
    }

    /// Checks every setting.
    pub fn validate(&self) -> Result<()> {
        if self.number == 0 {
            return Err(Error::argument("step", "must be at least 1: the bias correction divides"));
        }
        let Rates { means, quats, scales, opacities, sh0, sh_rest } = self.rates;
        let rates = [means, quats, scales, opacities, sh0, sh_rest];
        let settings = [
            ("rates", rates.as_slice()),
            ("opacity_regularizer", &[self.opacity_regularizer]),
            ("scale_regularizer", &[self.scale_regularizer]),
            ("noise", &[self.noise]),
        ];
        for (name, values) in settings {
            if !values.iter().all(|v| v.is_finite() && *v >= 0.0) {
                return Err(Error::argument(name, "must be finite and not negative"));
            }
        }
        Ok(())
    }
}

/// Splats under optimization: parameters and Adam's two moments, which have the same layout.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AdamState<T> {
    /// Parameters.
    pub splats: SplatArrays<T>,
    /// First moments.
    pub first: SplatArrays<T>,
    /// Second moments.
    pub second: SplatArrays<T>,
}

impl<T> AdamState<T> {
    /// Checks that parameters, moments and `gradients` belong to the same splats.
    pub fn validate(&self, gradients: &SplatGradients<T>) -> Result<()> {
        let (n, degree) = (self.splats.len(), self.splats.sh_degree);
        for (name, arrays) in
            [("splats", &self.splats), ("first", &self.first), ("second", &self.second)]
        {
            arrays.validate()?;
            if arrays.len() != n || arrays.sh_degree != degree {
                return Err(Error::argument(name, "does not belong to the same splats"));
            }
        }
        let lengths = [
            ("v_means", gradients.v_means.len()),
            ("v_quats", gradients.v_quats.len()),
            ("v_scales", gradients.v_scales.len()),
            ("v_opacities", gradients.v_opacities.len()),
        ];
        check_lengths(&lengths, n, "rows, but means has")?;
        check_lengths(
            &[("v_colors", gradients.v_colors.len())],
            self.splats.sh.len(),
            "rows, but sh has",
        )
    }
}
