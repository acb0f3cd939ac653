//! Where a fit's kernels run: the seam between the fitting loop and the backends.

use rayon::prelude::*;

use super::params::FitState;
use crate::camera::Camera;
use crate::error::{Error, Result};

/// One photo to fit to.
#[derive(Debug, Clone)]
pub struct Target {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// 3 (RGB) or 4 (RGB and straight alpha).
    pub channels: u32,
    /// `[H * W * channels]`, row-major.
    pub pixels: Vec<u8>,
    /// `[H * W]` weight of each pixel in the loss, or None for 1 everywhere. The loss is a mean over
    /// the pixels whose weight is not 0: a photo of small weights counts less than others.
    pub weights: Option<Vec<f32>>,
    /// RGB in 0..=1 that stood behind what an image without alpha shows, where that is known: it is
    /// compared to renders over it.
    pub background: Option<[f32; 3]>,
    /// How many steps of a round are of it, at least 1.
    pub turns: u32,
    /// The first step that is not of it any more, where there is one.
    pub until: Option<u32>,
}

/// What a photo's pixels weigh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weight {
    /// Sum of the weights.
    pub sum: f64,
    /// How many are not 0.
    pub count: f64,
}

impl Weight {
    /// Of a list of weights.
    pub fn of(weights: &[f32]) -> Self {
        Self {
            sum: weights.iter().map(|&w| f64::from(w)).sum(),
            count: weights.iter().filter(|w| **w > 0.0).count() as f64,
        }
    }
}

impl Target {
    /// Checks sizes; `index` names the photo in the error.
    pub fn validate(&self, index: usize) -> Result<()> {
        let pixels = self.width as usize * self.height as usize;
        let bad = |reason: String| Err(Error::argument(format!("images[{index}]"), reason));
        if pixels == 0 {
            return bad("has no pixels".into());
        }
        if !matches!(self.channels, 3 | 4) {
            return bad(format!("has {} channels; give RGB or RGBA", self.channels));
        }
        if self.pixels.len() != pixels * self.channels as usize {
            return bad("does not hold width x height pixels".into());
        }
        if self.background.is_some_and(|color| color.iter().any(|c| !(0.0..=1.0).contains(c))) {
            return bad("stood before a background that does not lie in 0..=1".into());
        }
        if self.turns == 0 {
            return bad("has no turn; give at least one".into());
        }
        if let Some(weights) = &self.weights {
            if weights.len() != pixels {
                return bad("its weights do not have the image's size".into());
            }
            if !weights.iter().all(|w| w.is_finite() && *w >= 0.0) {
                return bad("has a weight that is negative or not finite".into());
            }
        }
        Ok(())
    }

    /// Sum of the weights, and the number of pixels whose weight is not 0.
    pub fn weight(&self) -> Weight {
        let pixels = f64::from(self.width) * f64::from(self.height);
        self.weights.as_deref().map_or(Weight { sum: pixels, count: pixels }, Weight::of)
    }

    /// The photo over `background` as three planes in 0..1.
    pub fn composite(&self, background: [f32; 3], planes: &mut [Vec<f32>; 3]) {
        let pixels = self.width as usize * self.height as usize;
        for plane in planes.iter_mut() {
            plane.resize(pixels, 0.0);
        }
        let unit = 1.0 / 255.0;
        planes.par_iter_mut().enumerate().for_each(|(c, plane)| {
            if self.channels == 3 {
                for (out, pixel) in plane.iter_mut().zip(self.pixels.chunks_exact(3)) {
                    *out = f32::from(pixel[c]) * unit;
                }
            } else {
                for (out, pixel) in plane.iter_mut().zip(self.pixels.chunks_exact(4)) {
                    let alpha = f32::from(pixel[3]) * unit;
                    *out = f32::from(pixel[c]) * unit * alpha + background[c] * (1.0 - alpha);
                }
            }
        });
    }
}

/// Adam's step sizes per kind of parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Centres, world units.
    pub means: f32,
    /// Quaternions.
    pub quats: f32,
    /// Log-scales.
    pub scales: f32,
    /// Opacity logits.
    pub opacities: f32,
    /// SH coefficient 0.
    pub sh0: f32,
    /// The other SH coefficients.
    pub sh_rest: f32,
}

impl Rates {
    /// No parameter moves.
    pub const ZERO: Self =
        Self { means: 0.0, quats: 0.0, scales: 0.0, opacities: 0.0, sh0: 0.0, sh_rest: 0.0 };
}

/// Gradient of a step's loss with respect to its camera.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CameraGradient {
    /// Which target.
    pub view: usize,
    /// Rows of the gradient of the viewmat's upper 3x4 block.
    pub v_viewmat: [[f64; 4]; 3],
    /// Gradient of (fx, fy, cx, cy).
    pub v_intrinsics: [f64; 4],
}

/// Adam's decay of the first and second moments and its epsilon.
pub const ADAM: (f32, f32, f32) = (0.9, 0.999, 1e-15);

/// What one step is to do.
#[derive(Debug, Clone, Copy)]
pub struct StepInput {
    /// Which target.
    pub view: usize,
    /// Its camera, relative to the scene's origin.
    pub camera: Camera,
    /// Render background, and what a target with alpha is composited over.
    pub background: [f32; 3],
    /// SH degree in use.
    pub sh_degree: u32,
    /// Step sizes.
    pub rates: Rates,
    /// Number of this step, from 1, for Adam's bias correction.
    pub step: u32,
    /// Weight of D-SSIM in the loss; L1 has the rest.
    pub ssim_weight: f32,
    /// Added to the loss: this times the mean opacity.
    pub opacity_regularizer: f32,
    /// Added to the loss: this times the mean scale (over splats and axes, world units).
    pub scale_regularizer: f32,
    /// Size of the exploration noise on the centres (3DGS-MCMC, eq. 8), 0 for none. After Adam's
    /// update: mean += C (z * noise / (1 + exp(-100 (0.005 - opacity)))) with C the splat's 3D
    /// covariance, z from [`noise_normal`] and the parameters as updated.
    pub noise: f32,
    /// Part of the splats that this step leaves out, those of [`is_dropped`]; the opacities of the
    /// others are divided by 1 - dropout, so that the picture stays as opaque on the whole.
    pub dropout: f32,
    /// Seed of noise and dropout; differs from step to step.
    pub noise_seed: u32,
    /// Whether [`FitDevice::camera_gradients`] will ask for this step's.
    pub camera_gradient: bool,
}

/// Weights of the SSIM window: 11 taps of a Gaussian of sigma 1.5, summing to 1, as in 3DGS.
pub const SSIM_WINDOW: [f32; 11] = [
    0.001_028_380_1,
    0.007_598_758,
    0.036_000_773,
    0.109_360_69,
    0.213_005_53,
    0.266_011_72,
    0.213_005_53,
    0.109_360_69,
    0.036_000_773,
    0.007_598_758,
    0.001_028_380_1,
];
/// SSIM's constants for pictures in 0..1.
pub const SSIM_C: (f32, f32) = (0.01 * 0.01, 0.03 * 0.03);

/// A backend that keeps splats, optimiser state and photos where its kernels run.
///
/// The loss is `sum_p w_p ((1 - s) mean_c |x - y| + s (1 - mean_c SSIM)) / sum_p w_p` over pixels p
/// and channels c, with s the SSIM weight, zero padding in the window, plus the two regularisers.
/// Every parameter takes an Adam step in every step, seen or not; with [`Rates::ZERO`] and without
/// noise all stay as they are.
pub trait FitDevice: Send {
    /// Takes the photos, once.
    fn set_targets(&mut self, targets: Vec<Target>) -> Result<()>;

    /// Replaces the state.
    fn upload(&mut self, state: FitState) -> Result<()>;

    /// A copy of the state as it is now.
    fn download(&mut self) -> Result<FitState>;

    /// Lets `change` work on the state; splats may come and go.
    fn edit(&mut self, change: &mut dyn FnMut(&mut FitState)) -> Result<()> {
        let mut state = self.download()?;
        change(&mut state);
        self.upload(state)
    }

    /// One step: project, bin, rasterize, loss, rasterize_backward, project_backward, Adam, noise,
    /// density statistics.
    fn step(&mut self, input: &StepInput) -> Result<()>;

    /// Gradients of the cameras of all steps since the last call that were to have them, in order.
    fn camera_gradients(&mut self) -> Result<Vec<CameraGradient>>;

    /// Loss of the last step (before its update, regularisers not included).
    fn loss(&mut self) -> Result<f32>;
}

/// PCG's output function on one 32-bit word.
fn hash(x: u32) -> u32 {
    let state = x.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    (word >> 22) ^ word
}

/// The hash value below which a splat is dropped.
pub(crate) fn dropout_threshold(rate: f32) -> u32 {
    (f64::from(rate) * 4_294_967_296.0) as u32
}

/// Whether a step with this seed and dropout leaves out the splat `index` (DropGaussian, Park et
/// al. 2025). The same on every backend.
pub fn is_dropped(seed: u32, index: u32, rate: f32) -> bool {
    hash(index ^ hash(seed ^ 0x5bd1_e995)) < dropout_threshold(rate)
}

/// Three standard normal numbers from (seed, splat index): integer hash (PCG output function
/// applied thrice), then Box-Muller. The same on every backend up to the rounding of log, sqrt, cos.
pub fn noise_normal(seed: u32, index: u32) -> [f32; 3] {
    // In (0, 1]: the logarithm stays finite.
    let unit = |h: u32| ((h >> 8) as f32 + 1.0) * (1.0 / 16_777_216.0);
    let base = hash(index ^ hash(seed));
    let draw: [f32; 4] = std::array::from_fn(|k| unit(hash(base.wrapping_add(k as u32))));
    let (r0, r1) = ((-2.0 * draw[0].ln()).sqrt(), (-2.0 * draw[2].ln()).sqrt());
    let (a0, a1) = (std::f32::consts::TAU * draw[1], std::f32::consts::TAU * draw[3]);
    [r0 * a0.cos(), r0 * a0.sin(), r1 * a1.cos()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropout_leaves_out_its_part_and_other_splats_each_step() {
        let dropped = |seed, rate| (0..100_000).filter(move |&i| is_dropped(seed, i, rate));
        assert_eq!(dropped(3, 0.0).count(), 0);
        for (seed, rate) in [(0, 0.1), (7, 0.3), (u32::MAX, 0.9)] {
            let part = dropped(seed, rate).count() as f32 / 1e5;
            assert!((part - rate).abs() < 0.01, "{part} where {rate} was asked for");
        }
        // Two steps agree by chance only.
        let both = dropped(1, 0.3).filter(|&i| is_dropped(2, i, 0.3)).count() as f32 / 1e5;
        assert!((both - 0.09).abs() < 0.01, "{both}");
    }
}
