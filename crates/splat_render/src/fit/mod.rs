//! Fitting splats to photos with known cameras.

mod cameras;
mod config;
mod density;
mod device;
mod fitter;
mod hold;
mod hull;
mod initial;
mod params;

pub use cameras::{CameraConfig, CameraState, Cameras, Focal, scene_distance};
pub use config::{Background, DensityControl, FitConfig};
pub(crate) use device::dropout_threshold;
pub use device::{
    ADAM, CameraGradient, FitDevice, Rates, SSIM_C, SSIM_WINDOW, StepInput, Target, Weight,
    is_dropped, noise_normal,
};
pub use fitter::{Fitter, scene_extent};
pub use hold::Hold;
pub use initial::splats_from_points;
pub use params::{DensityStats, FitState, SplatArrays};
