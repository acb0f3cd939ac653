//! Settings of how cameras are fitted.

use crate::error::{Error, Result};

/// Which focal lengths are fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Focal {
    /// None.
    Fixed,
    /// One factor for all cameras.
    Shared,
    /// A factor for each camera.
    PerCamera,
}

/// How cameras are fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraConfig {
    /// Whether poses are.
    pub poses: bool,
    /// Which focal lengths are.
    pub focal: Focal,
    /// Adam's rate at the start, in pixels that a step moves the picture by.
    pub rate: f32,
    /// Final rate as a fraction of the initial rate.
    pub decay: f32,
    /// Part of the fit's steps in which cameras rest: the splats need a shape first.
    pub warm_up: f32,
    /// Whether the cameras are kept from moving all together.
    pub anchored: bool,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            poses: true,
            focal: Focal::Fixed,
            rate: 0.3,
            decay: 0.03,
            warm_up: 0.05,
            anchored: true,
        }
    }
}

impl CameraConfig {
    /// Checks every setting.
    pub fn validate(&self) -> Result<()> {
        if !(self.rate.is_finite() && self.rate >= 0.0) {
            return Err(Error::argument("camera_rate", "must be finite and not negative"));
        }
        if !(self.decay > 0.0 && self.decay <= 1.0) {
            return Err(Error::argument("camera_decay", "must be above 0 and at most 1"));
        }
        if !(0.0..=1.0).contains(&self.warm_up) {
            return Err(Error::argument("camera_warm_up", "must be in 0..=1"));
        }
        Ok(())
    }
}
