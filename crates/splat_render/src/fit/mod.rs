//! Fitting splats to photos with known cameras.

mod config;
mod density;
mod device;
mod fitter;
mod hull;
mod initial;
mod params;

pub use config::{Background, DensityControl, FitConfig};
pub(crate) use device::dropout_threshold;
pub use device::{
    ADAM, FitDevice, Rates, SSIM_C, SSIM_WINDOW, StepInput, Target, is_dropped, noise_normal,
};
pub use fitter::{Fitter, scene_extent};
pub use initial::splats_from_points;
pub use params::{DensityStats, FitState, SplatArrays};
