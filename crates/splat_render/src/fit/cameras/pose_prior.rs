//! Pose priors: knowledge of a camera that does not come from the photos' colors.
//!
//! Points matched in several photos determine a camera's pose to hundredths of a pixel, which the colors
//! of a fit do not. A camera with a prior takes small steps along directions that the prior constrains
//! and normal steps along the rest. It is also pulled toward the prior's mean, so strongly that a steady
//! push ends one standard deviation away.

use glam::DMat4;

use super::cholesky::inverse_cholesky;
use super::motion::{POSE, PoseMatrix, between, move_by};
use crate::camera::Camera;
use crate::error::{Error, Result};

/// A Gaussian prior of one camera: its mean and its information (the covariance's inverse).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosePrior {
    /// Mean of the world-to-camera matrix.
    pub viewmat: DMat4,
    /// Means of the focal lengths, pixels.
    pub focal: [f64; 2],
    /// Inverse of the covariance of the rotation (radians) about and the translation (world units) along
    /// x, y, z of the camera; symmetric, zero if unknown.
    pub pose: PoseMatrix,
    /// Inverse of the variance of the focal length's logarithm; zero if unknown.
    pub log_focal: f64,
}

impl PosePrior {
    /// Checks that every entry can be used; `k` is the camera's number.
    pub fn validate(&self, k: usize) -> Result<()> {
        let information = self.pose.as_flattened().iter().chain([&self.log_focal]);
        let diagonal = (0..POSE).map(|i| self.pose[i][i]).chain([self.log_focal]);
        let place = self.viewmat.to_cols_array().into_iter().chain(self.focal);
        if !information.copied().chain(place).all(f64::is_finite)
            || !diagonal.into_iter().all(|v| v >= 0.0)
            || !self.focal.iter().all(|&f| f > 0.0)
        {
            return Err(Error::argument(
                format!("pose_priors[{k}]"),
                "must be finite, with positive focal lengths and information that is not negative",
            ));
        }
        Ok(())
    }

    /// Pulls a camera toward the prior's mean so that a push of `rate` balances one standard deviation
    /// away. `scale` converts unit steps to poses and includes this prior's information.
    pub fn pull_pose(&self, camera: &mut Camera, scale: &PoseMatrix, rate: f64) {
        if self.pose == [[0.0; POSE]; POSE] {
            return;
        }
        let told = Camera { viewmat: self.viewmat, ..*camera };
        let off = between(&told, camera);
        // With T the scale and I the information, off - rate T (1 + rate T'IT)^-1 T'I off solves
        // ((TT')^-1 + rate I) x = (TT')^-1 off, which weighs the way back against a step's length.
        let weighed: PoseMatrix = product(&self.pose, scale);
        let within: PoseMatrix = std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let along: f64 = (0..POSE).map(|k| scale[k][i] * weighed[k][j]).sum();
                rate * along + if i == j { 1.0 } else { 0.0 }
            })
        });
        let inverse = inverse_cholesky(within);
        let push: [f64; POSE] =
            std::array::from_fn(|i| rate * (0..POSE).map(|k| weighed[k][i] * off[k]).sum::<f64>());
        let half: [f64; POSE] =
            std::array::from_fn(|i| (0..POSE).map(|k| inverse[i][k] * push[k]).sum());
        let whole: [f64; POSE] =
            std::array::from_fn(|i| (0..POSE).map(|k| inverse[k][i] * half[k]).sum());
        let left = std::array::from_fn(|i| {
            off[i] - (0..POSE).map(|k| scale[i][k] * whole[k]).sum::<f64>()
        });
        *camera = told;
        move_by(camera, left);
    }

    /// The same of the focal length; its logarithm's steps of length 1 are 1 / sqrt(`measure`).
    pub fn pull_focal(&self, camera: &mut Camera, measure: f64, rate: f64) {
        let off = (camera.fx / self.focal[0]).ln();
        let back = off * rate * self.log_focal / (measure + rate * self.log_focal);
        let factor = (-back).exp();
        (camera.fx, camera.fy) = (camera.fx * factor, camera.fy * factor);
    }
}

fn product(a: &PoseMatrix, b: &PoseMatrix) -> PoseMatrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..POSE).map(|k| a[i][k] * b[k][j]).sum()))
}
