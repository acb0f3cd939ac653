//! Pinhole cameras: OpenCV axes (x right, y down, z forward), pixel centers at +0.5.

use glam::{DMat3, DMat4, DVec3};

use crate::constants::{JACOBIAN_MARGIN, RIGID_TOLERANCE, SIDE_MAX};
use crate::error::{Error, Result};

/// A pinhole camera. World units are the scene's own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// World-to-camera, rigid, f64.
    pub viewmat: DMat4,
    /// Focal length in pixels along x.
    pub fx: f64,
    /// Focal length in pixels along y.
    pub fy: f64,
    /// Principal point in pixels from the left edge of the image.
    pub cx: f64,
    /// Principal point in pixels from the top edge of the image.
    pub cy: f64,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
}

/// Bytes of a pixel while a picture is drawn: planes, and then colors and alpha.
const PICTURE_BYTES: usize = 48;

/// Checks a picture's size.
pub(crate) fn check_size(width: u32, height: u32) -> Result<()> {
    if width == 0 || height == 0 || width > SIDE_MAX || height > SIDE_MAX {
        return Err(Error::argument(
            "width, height",
            format!("must be in 1..={SIDE_MAX}, got {width} x {height}"),
        ));
    }
    Ok(())
}

/// Checks that memory can hold a picture while it is drawn: an allocation that fails ends the process.
pub(crate) fn check_memory(width: u32, height: u32) -> Result<()> {
    let bytes = PICTURE_BYTES * width as usize * height as usize;
    Vec::<u8>::new().try_reserve_exact(bytes).map_err(|_| {
        Error::argument(
            "width, height",
            format!(
                "need {:.1} GB for a picture of {width} x {height}, more than is free; give \
                 smaller ones",
                bytes as f64 / 1e9
            ),
        )
    })
}

impl Camera {
    /// Checks every field; the error names the argument as Python callers know it.
    pub fn validate(&self) -> Result<()> {
        check_size(self.width, self.height)?;
        if !(self.fx.is_finite() && self.fx > 0.0 && self.fy.is_finite() && self.fy > 0.0) {
            return Err(Error::argument(
                "K",
                format!("focal lengths must be finite and positive, got {}, {}", self.fx, self.fy),
            ));
        }
        if !(self.cx.is_finite() && self.cy.is_finite()) {
            return Err(Error::argument("K", "the principal point must be finite"));
        }
        if !self.viewmat.is_finite() {
            return Err(Error::argument("viewmat", "has a value that is not finite"));
        }
        let r = self.rotation();
        let off = r * r.transpose() - DMat3::IDENTITY;
        let worst = off.to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
        let last = self.viewmat.row(3);
        if worst > RIGID_TOLERANCE
            || r.determinant() < 0.0
            || (last - glam::DVec4::W).abs().max_element() > RIGID_TOLERANCE
        {
            return Err(Error::argument(
                "viewmat",
                format!(
                    "must be a rigid world-to-camera matrix; R R^T is {worst:.2e} off the identity"
                ),
            ));
        }
        Ok(())
    }

    /// Rotation block of the viewmat.
    pub fn rotation(&self) -> DMat3 {
        DMat3::from_mat4(self.viewmat)
    }

    /// Translation column of the viewmat.
    pub fn translation(&self) -> DVec3 {
        self.viewmat.w_axis.truncate()
    }

    /// Camera center in the world frame.
    pub fn center(&self) -> DVec3 {
        -(self.rotation().transpose() * self.translation())
    }

    /// `[x_low, x_high, y_low, y_high]` of x/z and y/z in the Jacobian; see [`JACOBIAN_MARGIN`].
    pub fn jacobian_limits(&self) -> [f64; 4] {
        let margin = f64::from(JACOBIAN_MARGIN);
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        let (mx, my) = (margin * 0.5 * w, margin * 0.5 * h);
        [
            -(self.cx + mx) / self.fx,
            (w - self.cx + mx) / self.fx,
            -(self.cy + my) / self.fy,
            (h - self.cy + my) / self.fy,
        ]
    }
}
