//! Settings of a fit.

use super::cameras::CameraConfig;
use crate::constants::SH_DEGREE_MAX;
use crate::error::{Error, Result};
use crate::stages::Rates;

/// MCMC's noise on the centers, in units of 3DGS's rate (the paper's).
const MCMC_NOISE: f32 = 5e5;

/// MCMC's pulls on opacities and scales (the paper's).
const MCMC_PULL: (f32, f32) = (0.01, 0.01);
/// The pull on opacities has the factor up to this number of photos; then it falls as their inverse.
/// Few photos leave floaters, which a stronger pull removes.
const FEW_PHOTOS: f32 = 8.0;
const FEW_PHOTOS_PULL: f32 = 3.0;

/// How the number of splats is controlled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DensityControl {
    /// Relocation and growth under a cap (Kheradmand et al., "3D Gaussian Splatting as Markov Chain
    /// Monte Carlo", 2024).
    Mcmc,
    /// Clone, split and prune (Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field
    /// Rendering", 2023).
    Original,
    /// The number of splats stays constant.
    Fixed,
}

/// Background of renders and of photos with alpha.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Background {
    /// A new color in every step for photos with alpha; black for photos without.
    Random,
    /// One color, RGB in 0..1.
    Color([f32; 3]),
}

/// Settings of a fit. Rates default to 3DGS's.
#[derive(Debug, Clone, PartialEq)]
pub struct FitConfig {
    /// Number of steps of the whole fit; the centers' rate decays over it.
    pub steps: u32,
    /// The step at which moments start; above 0 if a fit enters the schedule with other splats.
    pub first_step: u32,
    /// Seed of everything random.
    pub seed: u64,
    /// Degree of SH fitted, 0..=4.
    pub sh_degree: u32,
    /// Steps after which the degree in use grows by one; at most a fifth of all steps.
    pub sh_interval: u32,
    /// Maximum number of splats.
    pub max_splats: usize,
    /// How splats are added and removed.
    pub density: DensityControl,
    /// Background.
    pub background: Background,
    /// Weight of D-SSIM in the loss.
    pub ssim_weight: f32,
    /// Adam's final rates; for the centers the rate before `means_decay`, in units of the scene's extent.
    pub rates: Rates,
    /// Learning-rate multiplier for the first half of the steps; decays to 1, except for the centers,
    /// whose rate has its own decay. See [`FitConfig::rates_at`].
    pub rate_scale: f32,
    /// Final fraction of dropped splats; grows linearly from 0 (DropGaussian).
    pub dropout: f32,
    /// How cameras are fitted, or None: they are taken as exact.
    pub cameras: Option<CameraConfig>,
    /// Whether a gain and an offset per channel of each photo are fitted; see [`super::Exposures`].
    pub exposures: bool,
    /// Whether the first steps use reduced photos; see [`FitConfig::reduction`].
    pub coarse_to_fine: bool,
    /// Initial weight of the depth loss; see [`FitConfig::depth_weight_at`].
    pub depth_weight: f32,
    /// Final rate of the centers as a fraction of the initial rate.
    pub means_decay: f32,
}

impl Default for FitConfig {
    fn default() -> Self {
        Self {
            steps: 5000,
            first_step: 0,
            seed: 0,
            sh_degree: 2,
            sh_interval: 1000,
            max_splats: 30_000,
            density: DensityControl::Original,
            background: Background::Random,
            ssim_weight: 0.2,
            rates: Rates {
                means: 1.6e-4,
                quats: 1e-3,
                scales: 5e-3,
                opacities: 5e-2,
                sh0: 2.5e-3,
                sh_rest: 2.5e-3 / 20.0,
            },
            rate_scale: 1.0,
            dropout: 0.0,
            cameras: None,
            exposures: false,
            coarse_to_fine: false,
            depth_weight: 0.0,
            means_decay: 0.01,
        }
    }
}

/// Longest side in pixels that reduced photos have at least: smaller ones show too little.
const COARSE_SIDE: u32 = 96;
/// Photos are halved at most so often.
const MOST_HALVINGS: u32 = 3;
/// Part of the steps after which photos have their whole size.
const COARSE_UNTIL: f64 = 0.3;

/// Final weight of the depth loss as a fraction of the initial weight.
const DEPTH_DECAY: f64 = 0.01;

/// Steps until density control first runs, and from one run to the next, at most.
const REFINE: (u32, u32) = (300, 100);

impl FitConfig {
    /// Factor by which a step (from 0) reduces both sides of photos: a power of two; 1 from 30 % of the
    /// steps on. Fewer pixels are faster, and few splats show no detail (Chen et al., "DashGaussian",
    /// 2025, section 3.2). `longest` is the longest side of all photos, in pixels.
    pub fn reduction(&self, step: u32, longest: u32) -> u32 {
        let halvings = (longest / COARSE_SIDE).checked_ilog2().unwrap_or(0).min(MOST_HALVINGS);
        let progress = f64::from(step) / f64::from(self.steps);
        if !self.coarse_to_fine || progress >= COARSE_UNTIL {
            return 1;
        }
        let done = (progress / COARSE_UNTIL * f64::from(halvings)) as u32;
        1 << halvings.saturating_sub(done)
    }

    /// Adam's rates at a step (from 0) for a scene of this extent. 3DGS's rates are for 30 000 steps;
    /// shorter fits need larger steps first and small ones at the end.
    pub fn rates_at(&self, step: u32, extent: f32) -> Rates {
        let progress = f64::from(step) / f64::from(self.steps);
        let decay = f64::from(self.means_decay).powf(progress) as f32;
        let scale = self.rate_scale;
        let settling = scale.powf((2.0 - 2.0 * progress).min(1.0) as f32);
        let Rates { means, quats, scales, opacities, sh0, sh_rest } = self.rates;
        Rates {
            means: means * extent * decay * scale,
            quats: quats * settling,
            scales: scales * settling,
            opacities: opacities * settling,
            sh0: sh0 * settling,
            sh_rest: sh_rest * settling,
        }
    }

    /// Size of MCMC's noise on centers at a step (from 0) for a scene of this extent; 0 for other
    /// controls. In units of 3DGS's rate: larger noise would leave centers off their surfaces.
    pub(super) fn noise_at(&self, step: u32, extent: f32) -> f32 {
        match self.density {
            DensityControl::Mcmc => {
                MCMC_NOISE * self.rates_at(step, extent).means / self.rate_scale
            }
            _ => 0.0,
        }
    }

    /// Weight of the mean opacity in the loss at a step (from 0). The original control has it instead
    /// of resets; see [`FitConfig::resets_opacities`].
    pub(super) fn opacity_pull_at(&self, step: u32, photos: usize) -> f32 {
        let factor = match self.density {
            DensityControl::Mcmc => self.opacity_pull(photos).max(1.0),
            DensityControl::Original if !self.resets_opacities(photos) => self.opacity_pull(photos),
            _ => return 0.0,
        };
        // Adam takes a full step along a pull without gradients. With larger steps, a splat that few
        // photos show would fade before the next of these photos.
        let faster =
            self.rates_at(step, 1.0).opacities / self.rates.opacities.max(f32::MIN_POSITIVE);
        factor * MCMC_PULL.0 / faster.max(1.0).sqrt()
    }

    /// Weight of the mean opacity by the number of photos, in units of MCMC's.
    fn opacity_pull(&self, photos: usize) -> f32 {
        // With a stronger pull, a fitted focal length ends farther off.
        let strongest = if self.cameras.is_some() { 1.0 } else { FEW_PHOTOS_PULL };
        strongest * (FEW_PHOTOS / photos as f32).min(1.0)
    }

    /// Whether the original control resets opacities and, after the first reset, prunes splats larger
    /// than a tenth of the cameras' extent (3DGS). Few photos from similar directions would lose their
    /// scene, which is far larger than that. They have dropout and a pull on opacities instead. With
    /// many photos, a splat is visible in few steps and a pull would remove it.
    pub(super) fn resets_opacities(&self, photos: usize) -> bool {
        self.density == DensityControl::Original
            && !(self.dropout > 0.0 && self.opacity_pull(photos) > 1.0)
    }

    /// Weight of the mean scale in the loss.
    pub(super) fn scale_pull(&self) -> f32 {
        if self.density == DensityControl::Mcmc { MCMC_PULL.1 } else { 0.0 }
    }

    /// Weight of the depth loss at a step (from 0); decays exponentially to a hundredth (Kerbl et al., "A
    /// Hierarchical 3D Gaussian Representation", 2024).
    pub fn depth_weight_at(&self, step: u32) -> f32 {
        let progress = f64::from(step) / f64::from(self.steps);
        self.depth_weight * DEPTH_DECAY.powf(progress) as f32
    }

    /// Degree of SH in use in a step, from 0.
    pub fn sh_degree_at(&self, step: u32) -> u32 {
        if self.rates == Rates::ZERO {
            return self.sh_degree;
        }
        let interval = self.sh_interval.min(self.steps.div_ceil(5));
        (step / interval).min(self.sh_degree)
    }

    /// First step of density control, and the interval between runs: 3DGS's, but short fits get the same
    /// number of runs as long ones if every photo has its turn in between.
    pub fn refine_steps(&self) -> (u32, u32) {
        let (start, every) = REFINE;
        ((self.steps / 10).clamp(start / 4, start), (self.steps / 30).clamp(every / 4, every))
    }

    /// Checks every setting.
    pub fn validate(&self) -> Result<()> {
        if self.steps == 0 {
            return Err(Error::argument("steps", "must be at least 1"));
        }
        if self.first_step >= self.steps {
            return Err(Error::argument("first_step", "must be less than steps"));
        }
        if self.sh_degree > SH_DEGREE_MAX {
            return Err(Error::argument(
                "sh_degree",
                format!("must be in 0..={SH_DEGREE_MAX}, got {}", self.sh_degree),
            ));
        }
        if self.sh_interval == 0 {
            return Err(Error::argument("sh_interval", "must be at least 1"));
        }
        if self.max_splats == 0 || self.max_splats > 1 << 27 {
            return Err(Error::argument("max_splats", "must be in 1..=134217728"));
        }
        if !(0.0..=1.0).contains(&self.ssim_weight) {
            return Err(Error::argument("ssim_weight", "must be in 0..=1"));
        }
        let Rates { means, quats, scales, opacities, sh0, sh_rest } = self.rates;
        let rates = [means, quats, scales, opacities, sh0, sh_rest];
        if !rates.iter().all(|r| r.is_finite() && *r >= 0.0) {
            return Err(Error::argument("rates", "must be finite and not negative"));
        }
        if !(self.rate_scale > 0.0 && self.rate_scale.is_finite()) {
            return Err(Error::argument("rate_scale", "must be finite and above 0"));
        }
        if !(0.0..=0.9).contains(&self.dropout) {
            return Err(Error::argument("dropout", "must be in 0..=0.9"));
        }
        if !(self.means_decay > 0.0 && self.means_decay <= 1.0) {
            return Err(Error::argument("means_decay", "must be above 0 and at most 1"));
        }
        if !(self.depth_weight.is_finite() && self.depth_weight >= 0.0) {
            return Err(Error::argument("depth_weight", "must be finite and not negative"));
        }
        if let Some(cameras) = &self.cameras {
            cameras.validate()?;
        }
        if let Background::Color(color) = self.background
            && !color.iter().all(|c| (0.0..=1.0).contains(c))
        {
            return Err(Error::argument("background", "must be in 0..=1"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_scaled_at_first_and_those_of_3dgs_at_the_end() {
        let plain = FitConfig { steps: 1000, ..FitConfig::default() };
        let config = FitConfig { rate_scale: 4.0, ..plain.clone() };
        for (step, scale) in [(0, 4.0), (500, 4.0), (750, 2.0), (1000, 1.0)] {
            let (base, rates) = (plain.rates_at(step, 3.0), config.rates_at(step, 3.0));
            let close = |a: f32, b: f32| assert!((a / b - 1.0).abs() < 1e-5, "{step}: {a} {b}");
            close(rates.means, 4.0 * base.means);
            close(rates.quats, scale * base.quats);
            close(rates.scales, scale * base.scales);
            close(rates.opacities, scale * base.opacities);
            close(rates.sh0, scale * base.sh0);
            close(rates.sh_rest, scale * base.sh_rest);
        }
        assert_eq!(plain.rates_at(400, 1.0).opacities, plain.rates.opacities);
    }

    #[test]
    fn noise_is_that_of_3dgs_at_every_rate() {
        let of = |density, rate_scale| {
            FitConfig { steps: 100, density, rate_scale, ..FitConfig::default() }.noise_at(50, 2.0)
        };
        let noise = of(DensityControl::Mcmc, 1.0);
        assert!(noise > 0.0 && (of(DensityControl::Mcmc, 3.0) / noise - 1.0).abs() < 1e-6);
        assert_eq!(of(DensityControl::Original, 3.0), 0.0);
    }

    #[test]
    fn opacities_are_pulled_more_with_few_photos() {
        let of = |density, dropout| FitConfig { density, dropout, ..FitConfig::default() };
        let pull = |density, photos| of(density, 0.1).opacity_pull_at(0, photos);
        let counts = [1, 8, 12, 23, 24, 100];
        let mcmc = counts.map(|photos| pull(DensityControl::Mcmc, photos) / 0.01);
        let original = counts.map(|photos| pull(DensityControl::Original, photos) / 0.01);
        for (k, factor) in [3.0, 3.0, 2.0, 24.0 / 23.0, 1.0, 1.0].into_iter().enumerate() {
            assert!((mcmc[k] - factor).abs() < 1e-6, "{mcmc:?}");
            assert_eq!(original[k], if k < 4 { mcmc[k] } else { 0.0 });
        }
        let resets = counts.map(|n| of(DensityControl::Original, 0.1).resets_opacities(n));
        assert_eq!(resets, [false, false, false, false, true, true]);
        // Without dropout, it is 3DGS's control.
        let plain = of(DensityControl::Original, 0.0);
        assert!(plain.resets_opacities(3) && plain.opacity_pull_at(0, 3) == 0.0);
        assert!(!of(DensityControl::Mcmc, 0.0).resets_opacities(100));
        assert_eq!(pull(DensityControl::Fixed, 3), 0.0);
        let moving = FitConfig {
            density: DensityControl::Mcmc,
            cameras: Some(CameraConfig::default()),
            ..FitConfig::default()
        };
        assert_eq!(moving.opacity_pull_at(0, 3), 0.01);
        let fast =
            FitConfig { rate_scale: 4.0, density: DensityControl::Mcmc, ..FitConfig::default() };
        assert!((fast.opacity_pull_at(0, 8) / 0.015 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn short_fits_refine_as_often_as_long_ones() {
        let of = |steps| FitConfig { steps, ..FitConfig::default() };
        let runs: Vec<_> = [1, 900, 3000, 7000].map(|steps| of(steps).refine_steps()).into();
        assert_eq!(runs, [(75, 25), (90, 30), (300, 100), (300, 100)]);
        let degrees = |steps: u32, at: [u32; 4]| at.map(|step| of(steps).sh_degree_at(step));
        assert_eq!(degrees(7000, [999, 1000, 1999, 2000]), [0, 1, 1, 2]);
        assert_eq!(degrees(1000, [199, 200, 399, 400]), [0, 1, 1, 2]);
    }

    #[test]
    fn photos_grow_to_their_whole_size() {
        let config = FitConfig { steps: 1000, coarse_to_fine: true, ..FitConfig::default() };
        let sizes = |longest| -> Vec<u32> {
            [0, 99, 100, 149, 150, 200, 299, 300, 999]
                .iter()
                .map(|&step| config.reduction(step, longest))
                .collect()
        };
        assert_eq!(sizes(4000), [8, 8, 4, 4, 4, 2, 2, 1, 1]);
        assert_eq!(sizes(400), [4, 4, 4, 4, 2, 2, 2, 1, 1]);
        assert_eq!(sizes(200), [2, 2, 2, 2, 2, 2, 2, 1, 1]);
        assert_eq!(sizes(1), [1; 9]);
        let whole = FitConfig { coarse_to_fine: false, ..config };
        assert_eq!(whole.reduction(0, 4000), 1);
    }
}
