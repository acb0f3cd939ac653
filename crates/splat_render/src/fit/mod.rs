//! Fitting splats to photos with known cameras.

mod device;
mod params;

pub use device::{ADAM, FitDevice, Rates, SSIM_C, SSIM_WINDOW, StepInput, Target, noise_normal};
pub use params::{DensityStats, FitState, SplatArrays};
