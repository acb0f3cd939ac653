//! Fitting splats to photos: which photo, rates and background each step has ([`Fitter`]), when splats
//! come and go, and how cameras move with them. The steps themselves run on a [`FitDevice`].

mod cameras;
mod config;
mod density;
mod depth_maps;
mod exposures;
mod fitter;
mod initial;

pub use cameras::{CameraConfig, CameraState, Cameras, Focal, PosePrior, scene_distance};
pub use config::{Background, DensityControl, FitConfig};
pub use depth_maps::{DepthMap, GrayPhoto, Search, depth_maps};
pub use exposures::{ExposureState, Exposures};
pub use fitter::Fitter;
pub use initial::splats_from_points;

pub use crate::constants::{ADAM, SSIM_C, SSIM_WINDOW};
pub use crate::fit_device::{
    COLOR_WAIT, CameraGradient, CommandTime, DensityStats, ExposureGradient, FitDevice, FitState,
    McmcRun, OriginalRun, StepInput, is_dropped, noise_normal,
};
pub use crate::splats::SplatArrays;
pub use crate::stages::{Exposure, Rates};
pub use crate::target::{Target, TargetDepth, Weight};
