//! The fitting loop: which photo, which rates, which background, when density control runs.
//!
//! Nothing random carries over from step to step: every draw comes from the seed and the step's
//! number, so a fit resumed from a saved state goes on with the same bits.

use std::iter::repeat_n;

use rand::Rng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::cameras::{CameraState, Cameras, PosePrior, scene_distance};
use super::config::{Background, DensityControl, FitConfig};
use super::density;
use super::exposures::{ExposureState, Exposures};
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::extent::camera_extent;
use crate::fit_device::{CommandTime, FitDevice, FitState, McmcRun, OriginalRun, StepInput};
use crate::stages::Exposure;
use crate::target::Target;

/// Part of all steps after which density control runs no more (MCMC; original).
const REFINE_STOP: (f64, f64) = (0.85, 0.5);
/// Fraction of the steps after which MCMC reaches the maximum number of splats.
const MCMC_GROWN: f64 = 0.5;
/// Steps between two opacity resets of the original control.
const RESET_EVERY: u32 = 3000;

/// Purpose of a draw; part of its seed.
#[derive(Clone, Copy)]
enum Draw {
    Order = 1,
    Background = 2,
    Noise = 3,
    Density = 4,
}

/// A fit in progress.
pub struct Fitter {
    device: Box<dyn FitDevice>,
    config: FitConfig,
    /// The photos at full size until the device has them, the current reduction, and the longest side.
    photos: Vec<Target>,
    reduction: u32,
    longest: u32,
    cameras: Vec<Camera>,
    /// Set if cameras are fitted; `cameras` are their current values.
    moving: Option<Cameras>,
    /// Set if exposures are fitted.
    exposures: Option<Exposures>,
    has_alpha: Vec<bool>,
    /// Each photo's background, if known.
    behind: Vec<Option<[f32; 3]>>,
    extent: f32,
    /// How often each photo comes in a round of steps, and the first step that is not of it.
    schedule: Vec<(u32, Option<u32>)>,
    /// Active photos with repetitions, this round's order, and the first step of such rounds.
    round: Vec<usize>,
    order: Vec<usize>,
    rounds_from: u32,
    splats: usize,
    step: u32,
}

/// Cameras of a smaller extent, in the frame of a fit, are at one place.
const ONE_PLACE: f64 = 1e-5;

/// The extent of cameras; 1 if they are at one place.
fn scene_extent(cameras: &[Camera]) -> f64 {
    let extent = camera_extent(&cameras.iter().map(Camera::center).collect::<Vec<_>>());
    if extent > ONE_PLACE { extent } else { 1.0 }
}

impl Fitter {
    /// A fit after `step` steps; cameras are relative to the scene's origin.
    pub fn new(
        mut device: Box<dyn FitDevice>,
        targets: Vec<Target>,
        cameras: Vec<Camera>,
        state: FitState,
        step: u32,
        config: FitConfig,
    ) -> Result<Self> {
        config.validate()?;
        state.validate()?;
        if targets.is_empty() {
            return Err(Error::argument("images", "is empty; give at least one photo"));
        }
        if cameras.len() != targets.len() {
            return Err(Error::argument(
                "viewmats",
                format!("has {} cameras for {} images", cameras.len(), targets.len()),
            ));
        }
        for (k, (camera, target)) in cameras.iter().zip(&targets).enumerate() {
            camera.validate()?;
            target.validate(k)?;
            if (camera.width, camera.height) != (target.width, target.height) {
                return Err(Error::argument(
                    format!("images[{k}]"),
                    format!(
                        "is {} x {}, but its camera is {} x {}",
                        target.width, target.height, camera.width, camera.height
                    ),
                ));
            }
        }
        if step < config.first_step {
            return Err(Error::argument("step", "is before the first step of this fit"));
        }
        if state.splats.is_empty() {
            return Err(Error::argument("splats", "is empty; a fit starts from at least one"));
        }
        if state.splats.sh_degree != config.sh_degree {
            return Err(Error::argument("splats", "do not store the SH degree to fit"));
        }
        let has_alpha = targets.iter().map(|t| t.channels == 4).collect();
        let behind = targets.iter().map(|t| t.background).collect();
        if targets.iter().all(|target| target.until.is_some()) {
            return Err(Error::argument("images", "has none that is fitted until the end"));
        }
        let schedule = targets.iter().map(|target| (target.turns, target.until)).collect();
        let longest = targets.iter().map(|t| t.width.max(t.height)).max().unwrap_or(1);
        let splats = state.moving();
        let moving = config.cameras.map(|moving| {
            let means = &state.splats.means;
            let distances = cameras.iter().map(|camera| scene_distance(camera, means)).collect();
            Cameras::new(&cameras, distances, moving)
        });
        let exposures = config.exposures.then(|| Exposures::new(&targets));
        device.upload(state)?;
        let mut fitter = Self {
            device,
            photos: targets,
            reduction: 0,
            longest,
            extent: scene_extent(&cameras) as f32,
            moving,
            config,
            cameras,
            exposures,
            has_alpha,
            behind,
            schedule,
            round: Vec::new(),
            order: Vec::new(),
            rounds_from: 0,
            splats,
            step,
        };
        fitter.set_reduction()?;
        Ok(fitter)
    }

    /// Gives the device the photos at the size of the next step.
    fn set_reduction(&mut self) -> Result<()> {
        let reduction = self.config.reduction(self.step, self.longest);
        // A photo that is narrower would have no pixel left.
        let least = self.cameras.iter().map(|c| c.width.min(c.height)).min().unwrap_or(1);
        let reduction = reduction.min(1 << least.checked_ilog2().unwrap_or(0));
        if reduction == self.reduction {
            return Ok(());
        }
        self.collect_gradients()?;
        self.reduction = reduction;
        self.device.set_targets(if reduction == 1 {
            std::mem::take(&mut self.photos)
        } else {
            self.photos.par_iter().map(|photo| photo.reduced(reduction)).collect()
        })
    }

    /// Adds the gradients of cameras and exposures of all steps until now.
    fn collect_gradients(&mut self) -> Result<()> {
        if let Some(exposures) = self.exposures.as_mut() {
            exposures.add(&self.device.exposure_gradients()?);
        }
        let Some(cameras) = self.moving.as_mut() else { return Ok(()) };
        let mut gradients = self.device.camera_gradients()?;
        for gradient in &mut gradients {
            // Of pixels of the whole size.
            gradient.v_intrinsics =
                gradient.v_intrinsics.map(|v| v / f64::from(self.reduction.max(1)));
        }
        cameras.add(&gradients);
        Ok(())
    }

    /// A photo's camera at the size of this step.
    fn camera(&self, view: usize) -> Camera {
        let (camera, by) = (self.cameras[view], self.reduction);
        let scale = f64::from(by);
        Camera {
            fx: camera.fx / scale,
            fy: camera.fy / scale,
            cx: camera.cx / scale,
            cy: camera.cy / scale,
            width: camera.width / by,
            height: camera.height / by,
            ..camera
        }
    }

    fn rng(&self, draw: Draw, number: u64) -> Pcg64 {
        Pcg64::new(u128::from(self.config.seed) << 64 | u128::from(number), u128::from(draw as u32))
    }

    /// Steps done.
    pub fn steps_done(&self) -> u32 {
        self.step
    }

    /// Splats that steps change.
    pub fn splat_count(&self) -> usize {
        self.splats
    }

    /// Loss of the last step.
    pub fn loss(&mut self) -> Result<f32> {
        self.device.loss()
    }

    /// Does `count` steps and measures their commands, in order, on the device. Steps that are repeated
    /// for lack of room are measured again.
    pub fn measured_steps(&mut self, count: u32) -> Result<Vec<Vec<CommandTime>>> {
        self.device.measure_commands(true)?;
        let done = (0..count).try_for_each(|_| self.step());
        let times = self.device.command_times();
        self.device.measure_commands(false)?;
        done.map(|()| times)
    }

    /// Everything needed to go on bit for bit, with [`Fitter::steps_done`].
    pub fn state(&mut self) -> Result<FitState> {
        self.device.download()
    }

    /// The cameras as they are now.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// The input of [`Fitter::resume_cameras`], if cameras are fitted.
    pub fn camera_state(&mut self) -> Result<Option<CameraState>> {
        self.collect_gradients()?;
        Ok(self.moving.as_ref().map(Cameras::state))
    }

    /// Makes cameras of one number move as one; call it before [`Fitter::set_pose_priors`].
    pub fn set_rigs(&mut self, numbers: &[u32]) -> Result<()> {
        let Some(cameras) = self.moving.as_mut() else {
            return Err(Error::argument("rigs", "are of cameras that are not fitted"));
        };
        cameras.set_rigs(numbers)
    }

    /// Sets the pose priors, one for each fitted camera, before the first step.
    pub fn set_pose_priors(&mut self, priors: Vec<PosePrior>) -> Result<()> {
        let Some(cameras) = self.moving.as_mut() else {
            return Err(Error::argument("pose_priors", "are of cameras that are not fitted"));
        };
        cameras.set_pose_priors(priors)
    }

    /// Resumes cameras from another fit's state.
    pub fn resume_cameras(&mut self, state: CameraState) -> Result<()> {
        let Some(cameras) = self.moving.as_mut() else {
            return Err(Error::argument("cameras", "are not fitted here"));
        };
        cameras.resume(state)?;
        self.cameras = cameras.now().to_vec();
        Ok(())
    }

    /// Sets the initial exposures; see [`Exposures::start`]. Call it before any step.
    pub fn start_exposures(
        &mut self,
        start: &[Option<Exposure<f64>>],
        pulls: &[f64],
    ) -> Result<()> {
        let Some(exposures) = self.exposures.as_mut() else {
            return Err(Error::argument("exposures", "are not fitted here"));
        };
        exposures.start(start, pulls)
    }

    /// Resumes exposures from another fit's state.
    pub fn resume_exposures(&mut self, state: ExposureState) -> Result<()> {
        let Some(exposures) = self.exposures.as_mut() else {
            return Err(Error::argument("exposures", "are not fitted here"));
        };
        exposures.resume(state)
    }

    /// The input of [`Fitter::resume_exposures`], if exposures are fitted.
    pub fn exposure_state(&mut self) -> Result<Option<ExposureState>> {
        self.collect_gradients()?;
        Ok(self.exposures.as_ref().map(|exposures| exposures.state().clone()))
    }

    /// The photo of step `step` (from 0). Rounds shuffle the active photos, each repeated by its number
    /// of turns; when a photo leaves, a new round starts.
    fn view(&mut self, step: u32) -> usize {
        let left =
            self.schedule.iter().filter_map(|&(_, until)| until).filter(|&until| until <= step);
        let from = left.max().unwrap_or(0);
        if self.round.is_empty() || from != self.rounds_from {
            self.rounds_from = from;
            self.order.clear();
            let stays = |until: Option<u32>| until.is_none_or(|until| until > step);
            let staying = self.schedule.iter().enumerate().filter(|(_, (_, until))| stays(*until));
            self.round = staying.flat_map(|(k, &(turns, _))| repeat_n(k, turns as usize)).collect();
        }
        let (n, step) = (self.round.len() as u32, step - from);
        if self.order.is_empty() || step.is_multiple_of(n) {
            let mut rng = self.rng(Draw::Order, u64::from(from) << 32 | u64::from(step / n));
            self.order.clone_from(&self.round);
            self.order.shuffle(&mut rng);
        }
        self.order[(step % n) as usize]
    }

    /// Does one step, and density control if due.
    pub fn step(&mut self) -> Result<()> {
        self.set_reduction()?;
        let step = self.step;
        let view = self.view(step);
        let config = &self.config;
        let background = match (self.behind[view], config.background) {
            (Some(color), _) | (None, Background::Color(color)) => color,
            (None, Background::Random) if !self.has_alpha[view] => [0.0; 3],
            (None, Background::Random) => {
                let mut rng = self.rng(Draw::Background, u64::from(step));
                std::array::from_fn(|_| rng.random::<f32>())
            }
        };
        let progress = f64::from(step) / f64::from(config.steps);
        let rates = config.rates_at(step, self.extent);
        let noise_seed = self.rng(Draw::Noise, u64::from(step)).random();
        let input = StepInput {
            view,
            camera: self.camera(view),
            background,
            sh_degree: config.sh_degree_at(step),
            rates,
            step: step - config.first_step + 1,
            ssim_weight: config.ssim_weight,
            opacity_regularizer: config.opacity_pull_at(step, self.schedule.len()),
            scale_regularizer: config.scale_pull(),
            noise: config.noise_at(step, self.extent),
            dropout: config.dropout * progress as f32,
            noise_seed,
            depth_weight: config.depth_weight_at(step),
            exposure: self
                .exposures
                .as_ref()
                .map(|exposures| exposures.of(view, self.has_alpha[view].then_some(background))),
            camera_gradient: self.moving.as_ref().is_some_and(|cameras| cameras.moving(progress)),
        };
        self.device.step(&input)?;
        self.step += 1;
        self.move_photos(progress)?;
        self.control_density()
    }

    /// Moves cameras and exposures at the end of a round, when each photo has its gradient.
    fn move_photos(&mut self, progress: f64) -> Result<()> {
        let moves = self.moving.as_ref().is_some_and(|cameras| cameras.moving(progress));
        let is_last = (self.step - self.rounds_from).is_multiple_of(self.round.len() as u32);
        if !is_last || !(moves || self.exposures.is_some()) {
            return Ok(());
        }
        self.collect_gradients()?;
        if let Some(cameras) = self.moving.as_mut().filter(|_| moves) {
            cameras.step(progress);
            self.cameras = cameras.now().to_vec();
        }
        if let Some(exposures) = self.exposures.as_mut() {
            let rounds = f64::from(self.config.steps) / self.round.len() as f64;
            exposures.step(progress, rounds);
        }
        Ok(())
    }

    fn control_density(&mut self) -> Result<()> {
        let (step, config) = (self.step, &self.config);
        let (start, every) = config.refine_steps();
        let stop = match config.density {
            DensityControl::Mcmc => REFINE_STOP.0,
            DensityControl::Original => REFINE_STOP.1,
            DensityControl::Fixed => 0.0,
        };
        let active = f64::from(step) < stop * f64::from(config.steps);
        let refine = active && step >= start && step.is_multiple_of(every);
        let resets = config.resets_opacities(self.schedule.len());
        let reset = active && resets && step.is_multiple_of(RESET_EVERY);
        if !refine && !reset {
            return Ok(());
        }
        let mut rng = self.rng(Draw::Density, u64::from(step));
        let mcmc = refine && config.density == DensityControl::Mcmc;
        let original = refine && config.density == DensityControl::Original;
        if original {
            self.splats = self.device.original(&OriginalRun {
                max_splats: config.max_splats,
                extent: self.extent,
                prune_huge: resets && step > RESET_EVERY,
                seed: rng.random(),
            })?;
        }
        if reset {
            self.device.reset_opacities()?;
        }
        if mcmc {
            let until = (MCMC_GROWN * f64::from(config.steps)) as u32;
            let left = if step > until { 0 } else { (until - step) / every + 1 };
            self.splats = self.device.mcmc(&McmcRun {
                cameras: self.cameras.clone(),
                target: density::mcmc_target(self.splats, config.max_splats, left),
                seed: rng.random(),
            })?;
        }
        Ok(())
    }
}
