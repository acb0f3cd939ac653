//! The interface between the fitting loop and the backends.

mod cell_order;
mod fog;
mod mcmc;
mod original;
mod random;
mod state;
mod waiting;

pub(crate) use cell_order::{CELLS, Cells};
pub(crate) use fog::{FogCamera, sampled_every};
pub use mcmc::McmcRun;
pub(crate) use mcmc::{
    BINS, BINS_PER_LOGIT, LOGIT_DEAD, LOGIT_FIRST, LOGIT_FOG, SHARES_MAX, mcmc, share_table,
    weight_table,
};
pub use original::OriginalRun;
pub(crate) use original::{
    INVERSE_GUESS, KEPT_BITS_MIN, LOG_SPLIT_SHRINK, LOGIT_RESET, PULL_GROW, PULL_SUM_MAX,
    PULL_UNITS, original, reset_opacities,
};
pub(crate) use random::{dropout_threshold, exp_accurate, noise_draw};
pub use random::{is_dropped, noise_normal};
pub use state::{DensityStats, FitState};
pub use waiting::COLOR_WAIT;
pub(crate) use waiting::{ColorStep, WaitingSteps};

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::stages::{AdamStep, Exposure, Rates};
use crate::target::Target;

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

/// Gradient of a step's loss with respect to its photo's exposure.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExposureGradient {
    /// Which target.
    pub view: usize,
    /// Of the gain of R, G and B.
    pub v_gain: [f64; 3],
    /// Of the offset of R, G and B.
    pub v_offset: [f64; 3],
}

/// Settings of one step.
#[derive(Debug, Clone, Copy)]
pub struct StepInput {
    /// Which target.
    pub view: usize,
    /// Its camera, relative to the scene's origin.
    pub camera: Camera,
    /// Background of the render and of a photo with alpha.
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
    /// Size of the exploration noise on the centers (3DGS-MCMC, eq. 8), 0 for none. After Adam's
    /// update: mean += C (z * noise / (1 + exp(-100 (0.005 - opacity)))) with C the splat's 3D
    /// covariance, z from [`noise_normal`] and the parameters as updated.
    pub noise: f32,
    /// Fraction of the splats that this step drops ([`is_dropped`]); the remaining opacities are divided
    /// by 1 - dropout, which keeps the mean opacity.
    pub dropout: f32,
    /// Seed of noise and dropout; differs from step to step.
    pub noise_seed: u32,
    /// Whether [`FitDevice::camera_gradients`] will ask for this step's.
    pub camera_gradient: bool,
    /// Weight of [`Stages::depth_loss`](crate::stages::Stages::depth_loss) if the photo has a depth.
    pub depth_weight: f32,
    /// Exposure correction before the loss, or None. With it, [`FitDevice::exposure_gradients`] includes
    /// this step's.
    pub exposure: Option<Exposure<f32>>,
}

impl StepInput {
    /// A first step that moves nothing, over black, without noise, dropout or depths.
    pub fn new(view: usize, camera: Camera) -> Self {
        Self {
            view,
            camera,
            background: [0.0; 3],
            sh_degree: 0,
            rates: Rates::ZERO,
            step: 1,
            ssim_weight: 0.2,
            opacity_regularizer: 0.0,
            scale_regularizer: 0.0,
            noise: 0.0,
            dropout: 0.0,
            noise_seed: 0,
            camera_gradient: false,
            depth_weight: 0.0,
            exposure: None,
        }
    }

    /// Checks the settings against the sizes of the device's photos, `(width, height)` in pixels.
    pub fn validate(&self, sizes: impl ExactSizeIterator<Item = (u32, u32)>) -> Result<()> {
        let (count, mut sizes) = (sizes.len(), sizes);
        let Some((width, height)) = sizes.nth(self.view) else {
            return Err(Error::argument(
                "view",
                format!("must be less than {count}, the number of photos, got {}", self.view),
            ));
        };
        self.camera.validate()?;
        if (self.camera.width, self.camera.height) != (width, height) {
            return Err(Error::argument(
                "camera",
                format!(
                    "is {} x {}, but its photo is {width} x {height}",
                    self.camera.width, self.camera.height
                ),
            ));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return Err(Error::argument(
                "dropout",
                format!("must be at least 0 and less than 1, got {}", self.dropout),
            ));
        }
        if !(0.0..=1.0).contains(&self.ssim_weight) {
            return Err(Error::argument(
                "ssim_weight",
                format!("must be in 0..=1, got {}", self.ssim_weight),
            ));
        }
        if !(self.depth_weight.is_finite() && self.depth_weight >= 0.0) {
            return Err(Error::argument(
                "depth_weight",
                format!("must be finite and not negative, got {}", self.depth_weight),
            ));
        }
        if let Some(exposure) = &self.exposure {
            exposure.validate()?;
        }
        self.adam().validate()
    }

    /// The optimizer's part of the step.
    pub fn adam(&self) -> AdamStep {
        AdamStep {
            number: self.step,
            rates: self.rates,
            sh_degree: self.sh_degree,
            opacity_regularizer: self.opacity_regularizer,
            scale_regularizer: self.scale_regularizer,
            noise: self.noise,
            noise_seed: self.noise_seed,
        }
    }
}

/// A backend that keeps splats, optimizer state and photos on its device.
///
/// The loss is `sum_p w_p ((1 - s) mean_c |x - y| + s (1 - mean_c SSIM)) / sum_p w_p` over pixels p and
/// channels c, with s the SSIM weight and zero padding in the window, plus the depth loss if the photo
/// has a depth, and the two regularizers.
///
/// Every parameter takes an Adam step in every step, seen or not. Colors of unseen splats may take theirs
/// later, with the same bits (on GPUs whose driver fuses multiply-adds alike in both kernels). With
/// [`Rates::ZERO`] nothing moves ([`AdamStep::is_frozen`]): no parameter, no moment, no noise; the loss,
/// the density statistics and the cameras' gradients are computed as usual.
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

    /// Moves dead splats to living ones and adds splats (3DGS-MCMC); returns the number of splats that
    /// are not frozen. Bits are the same on every device, except for the rounding in the fog test on GPUs
    /// that fuse multiplications with additions.
    fn mcmc(&mut self, run: &McmcRun) -> Result<usize> {
        control_on_host(self, &|state| mcmc(state, run))
    }

    /// Clones, splits and prunes splats by the statistics so far (3DGS), and resets the statistics;
    /// returns the number of splats that are not frozen. Bits are the same on every device, except for
    /// the positions of the halves of a split on GPUs that fuse multiplications with additions or round
    /// quotients differently.
    fn original(&mut self, run: &OriginalRun) -> Result<usize> {
        control_on_host(self, &|state| original(state, run))
    }

    /// Lowers the opacities of all splats that move to 0.01 at most and restarts their moments (3DGS).
    fn reset_opacities(&mut self) -> Result<()> {
        self.edit(&mut reset_opacities)
    }

    /// One step: project, bin, rasterize, exposure, loss, exposure_backward, depth_loss,
    /// rasterize_backward, project_backward, Adam, noise, density statistics.
    fn step(&mut self, input: &StepInput) -> Result<()>;

    /// Gradients of the cameras of all steps since the last call that were to have them, in order.
    fn camera_gradients(&mut self) -> Result<Vec<CameraGradient>>;

    /// Gradients of the exposures of all steps since the last call that had one, in order.
    fn exposure_gradients(&mut self) -> Result<Vec<ExposureGradient>>;

    /// Loss of the last step (before its update, regularizers not included).
    fn loss(&mut self) -> Result<f32>;

    /// Begins or ends to measure the commands of each step, which makes steps slower.
    fn measure_commands(&mut self, _on: bool) -> Result<()> {
        Err(Error::argument("backend", "measures kernels on GPUs only; choose gpu"))
    }

    /// Times of the commands of each step since the last call, in order.
    fn command_times(&mut self) -> Vec<Vec<CommandTime>> {
        Vec::new()
    }
}

/// Time of a command of a step on a GPU.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CommandTime {
    /// The entry point of the kernel, "clear" or "copy".
    pub name: &'static str,
    /// Milliseconds.
    pub ms: f64,
}

/// Lets a density control work on the host, on the splats that move; returns their number.
pub(crate) fn control_on_host<D: FitDevice + ?Sized>(
    device: &mut D,
    control: &dyn Fn(&mut FitState),
) -> Result<usize> {
    let mut splats = 0;
    device.edit(&mut |state| {
        state.edit_moving(control);
        splats = state.moving();
    })?;
    Ok(splats)
}
