//! Camera optimization: inexact poses and focal lengths are fitted together with the splats.
//!
//! A camera turns about its center and moves along its axes. Both change the picture in nearly the same
//! way, so Adam works in coordinates in which a unit step in any direction moves the picture by one pixel
//! (as CamP, Park et al. 2023).
//!
//! A similarity of cameras and splats together changes no photo. After each round the cameras are moved
//! by the similarity that fits them best to their initial poses, so that they do not drift.

mod anchor;
mod cholesky;
mod config;
mod motion;
mod pose_prior;
mod preconditioning;
mod rigs;
#[cfg(test)]
mod tests;

use glam::DMat4;

pub use config::{CameraConfig, Focal};
pub use pose_prior::PosePrior;
pub use preconditioning::scene_distance;

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::fit_device::CameraGradient;
use anchor::anchor;
use motion::{POSE, PoseMatrix, move_by, tangent};
use preconditioning::{all_scales, focal_pixels};
use rigs::Rigs;

/// Adam's betas and epsilon. A camera has one step per round, so moments must decay within tens of steps.
const ADAM: (f64, f64, f64) = (0.9, 0.99, 1e-15);

/// Everything needed to go on bit for bit; one entry per camera.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CameraState {
    /// World-to-camera matrices.
    pub viewmats: Vec<DMat4>,
    /// (fx, fy, cx, cy), pixels.
    pub intrinsics: Vec<[f64; 4]>,
    /// Adam's first moments: six of the pose, then the log of the focal length (shared in all rows).
    pub first: Vec<[f64; 7]>,
    /// Adam's second moments: the pose's as a whole, the focal length's.
    pub second: Vec<[f64; 2]>,
    /// Gradients of the round under way, of the same parameters before preconditioning.
    pub gradients: Vec<[f64; 7]>,
    /// Distances to the scene at the fit's start, world units.
    pub distances: Vec<f64>,
    /// Steps of Adam done.
    pub rounds: u32,
}

/// Cameras being fitted.
#[derive(Debug)]
pub struct Cameras {
    initial: Vec<Camera>,
    now: Vec<Camera>,
    /// From steps in pixels to turns and moves.
    scales: Vec<PoseMatrix>,
    rigs: Rigs,
    /// One per camera, or empty.
    priors: Vec<PosePrior>,
    /// Pixels by which the picture moves if the focal length's logarithm grows by 1.
    focal_pixels: Vec<f64>,
    config: CameraConfig,
    state: CameraState,
}

impl Cameras {
    /// Cameras and how far the scene is from each, world units.
    pub fn new(initial: &[Camera], distances: Vec<f64>, config: CameraConfig) -> Self {
        let rows = vec![[0.0; POSE + 1]; initial.len()];
        let state = CameraState {
            first: rows.clone(),
            second: vec![[0.0; 2]; initial.len()],
            gradients: rows,
            distances: distances.clone(),
            ..CameraState::default()
        };
        let rigs = Rigs::none(initial.len());
        Self {
            scales: all_scales(initial, &distances, &[], &rigs),
            rigs,
            priors: Vec::new(),
            focal_pixels: initial.iter().map(focal_pixels).collect(),
            initial: initial.to_vec(),
            now: initial.to_vec(),
            config,
            state,
        }
    }

    /// Makes cameras of one number move as one, before anything else is set.
    ///
    /// # Errors
    /// [`Error::Argument`] if there is not a number for each, or cameras of one number do not share a
    /// center.
    pub fn set_rigs(&mut self, numbers: &[u32]) -> Result<()> {
        self.rigs = Rigs::new(&self.initial, numbers, &self.state.distances)?;
        self.scales = all_scales(&self.initial, &self.state.distances, &self.priors, &self.rigs);
        Ok(())
    }

    /// Sets the pose priors, one for each camera, before the first step or [`Cameras::resume`].
    pub fn set_pose_priors(&mut self, priors: Vec<PosePrior>) -> Result<()> {
        if priors.len() != self.initial.len() {
            let count = self.initial.len();
            return Err(Error::argument(
                "pose_priors",
                format!("must have one entry for {count} cameras"),
            ));
        }
        for (k, prior) in priors.iter().enumerate() {
            prior.validate(k)?;
        }
        // A rig's prior is the sum of its cameras' priors.
        let known: Vec<PoseMatrix> = priors.iter().map(|prior| prior.pose).collect();
        let known = self.rigs.sums(&known, false);
        self.priors = priors;
        for (k, prior) in self.priors.iter_mut().enumerate() {
            prior.pose = self.rigs.form_at(k, &known);
        }
        self.scales = all_scales(&self.initial, &self.state.distances, &self.priors, &self.rigs);
        Ok(())
    }

    /// Goes on from a state that [`Cameras::state`] gave.
    pub fn resume(&mut self, state: CameraState) -> Result<()> {
        let n = self.initial.len();
        let lengths = [
            state.viewmats.len(),
            state.intrinsics.len(),
            state.first.len(),
            state.second.len(),
            state.gradients.len(),
            state.distances.len(),
        ];
        if lengths.iter().any(|&length| length != n) {
            return Err(Error::argument("cameras", format!("must have one row for {n} cameras")));
        }
        for (k, camera) in self.now.iter_mut().enumerate() {
            let [fx, fy, cx, cy] = state.intrinsics[k];
            *camera = Camera { viewmat: state.viewmats[k], fx, fy, cx, cy, ..*camera };
            camera.validate()?;
        }
        let moments = [&state.first, &state.gradients].map(|rows| rows.as_flattened());
        let moments = moments.into_iter().chain([state.second.as_flattened()]).flatten();
        if !moments.copied().all(f64::is_finite) {
            return Err(Error::argument("cameras", "has a moment that is not finite"));
        }
        if !state.distances.iter().all(|d| d.is_finite() && *d > 0.0) {
            return Err(Error::argument("cameras", "has a distance that is not positive"));
        }
        self.scales = all_scales(&self.initial, &state.distances, &self.priors, &self.rigs);
        self.state = state;
        Ok(())
    }

    /// The state needed to resume.
    pub fn state(&self) -> CameraState {
        let intrinsics = |c: &Camera| [c.fx, c.fy, c.cx, c.cy];
        CameraState {
            viewmats: self.now.iter().map(|c| c.viewmat).collect(),
            intrinsics: self.now.iter().map(intrinsics).collect(),
            ..self.state.clone()
        }
    }

    /// The cameras as they are now.
    pub fn now(&self) -> &[Camera] {
        &self.now
    }

    /// Whether cameras move at this point of the fit, 0..1.
    pub fn moving(&self, progress: f64) -> bool {
        progress >= f64::from(self.config.warm_up)
    }

    /// Adds gradients of steps to the round's.
    pub fn add(&mut self, gradients: &[CameraGradient]) {
        for gradient in gradients {
            let row = tangent(&self.now[gradient.view], gradient);
            // A picture outside f32's range gives no direction.
            if row.iter().all(|v| v.is_finite()) {
                for (sum, v) in self.state.gradients[gradient.view].iter_mut().zip(row) {
                    *sum += v;
                }
            }
        }
    }

    /// Moves the cameras by the gradients of the round.
    pub fn step(&mut self, progress: f64) {
        let warm_up = f64::from(self.config.warm_up);
        let since = ((progress - warm_up) / (1.0 - warm_up).max(1e-9)).clamp(0.0, 1.0);
        let rate = f64::from(self.config.rate) * f64::from(self.config.decay).powf(since);
        self.state.rounds += 1;
        let mut gradients = std::mem::take(&mut self.state.gradients);
        self.state.gradients = vec![[0.0; POSE + 1]; gradients.len()];
        if self.rigs.any() {
            self.rigs.share_gradients(&mut gradients);
        }
        if self.config.focal == Focal::Shared {
            let sum: f64 = gradients.iter().map(|row| row[POSE]).sum();
            gradients.iter_mut().for_each(|row| row[POSE] = sum);
        }
        let mean_pixels = self.focal_pixels.iter().sum::<f64>() / self.now.len() as f64;
        for (k, row) in gradients.iter().enumerate() {
            let scale = self.scales[k];
            let pixels = match self.config.focal {
                Focal::Shared => mean_pixels,
                _ => self.focal_pixels[k],
            };
            let prior = self.priors.get(k).copied();
            // A step is at most a pixel and at most the prior's standard deviation.
            let pixels = prior.map_or(pixels, |prior| pixels.hypot(prior.log_focal.sqrt()));
            let mut in_pixels = [0.0; POSE + 1];
            for (line, v) in scale.iter().zip(row) {
                for (out, s) in in_pixels.iter_mut().zip(line) {
                    *out += s * v;
                }
            }
            in_pixels[POSE] = row[POSE] / pixels;
            let moved = self.adam(k, in_pixels, rate);
            let mut pose = [0.0; POSE];
            for (out, line) in pose.iter_mut().zip(&scale) {
                *out = line.iter().zip(moved).map(|(s, v)| s * v).sum();
            }
            let camera = &mut self.now[k];
            if self.config.poses {
                move_by(camera, pose);
                if let Some(prior) = prior {
                    prior.pull_pose(camera, &scale, rate);
                }
            }
            if self.config.focal != Focal::Fixed {
                let factor = (moved[POSE] / pixels).exp();
                (camera.fx, camera.fy) = (camera.fx * factor, camera.fy * factor);
                if let Some(prior) = prior {
                    prior.pull_focal(camera, pixels * pixels, rate);
                }
            }
        }
        if self.config.anchored && self.config.poses {
            anchor(&mut self.now, &self.initial, &self.state.distances);
        }
        self.rigs.keep(&mut self.now);
    }

    /// Adam with one second moment for the whole pose, whose coordinates have one unit: separate moments
    /// would move the camera as far along directions that the photo hardly constrains.
    fn adam(&mut self, k: usize, gradient: [f64; 7], rate: f64) -> [f64; 7] {
        let (beta1, beta2, epsilon) = ADAM;
        let bias = |beta: f64| 1.0 - beta.powi(self.state.rounds.min(i32::MAX as u32) as i32);
        let (bias1, bias2) = (bias(beta1), bias(beta2));
        let (first, second) = (&mut self.state.first[k], &mut self.state.second[k]);
        let squares = gradient.map(|g| g * g);
        let squares = [squares[..POSE].iter().sum(), squares[POSE]];
        for (second, square) in second.iter_mut().zip(squares) {
            *second = beta2 * *second + (1.0 - beta2) * square;
        }
        std::array::from_fn(|i| {
            first[i] = beta1 * first[i] + (1.0 - beta1) * gradient[i];
            let second = second[usize::from(i == POSE)];
            -rate * (first[i] / bias1) / ((second / bias2).sqrt() + epsilon)
        })
    }
}
