//! Optimization of photos' exposure and white balance: a gain and an offset per channel and photo, fitted
//! with the splats.
//!
//! Brighter splats and darker gains look the same, and so do offsets of one sign: after each round the
//! gains' logarithms and the offsets are shifted to a mean of zero per channel. The splats then have the
//! colors of the mean photo.
//!
//! Gain and offset of a photo have nearly the same effect: both brighten it. Adam therefore works on
//! contrast about the photo's mean color and on that color.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::fit_device::ExposureGradient;
use crate::stages::Exposure;
use crate::target::Target;

/// Adam's decay of the moments and its epsilon, as cameras have them: a photo has one step a round.
const ADAM: (f64, f64, f64) = (0.9, 0.99, 1e-15);
/// Final rate of Adam as a fraction of the initial rate.
const DECAY: f64 = 0.03;
/// Sum of the initial rates over the rounds of a fit; with the decay, exposures move up to three stops.
const REACH: f64 = 3.5;
/// Least and most of the rate at the start.
const RATES: (f64, f64) = (0.005, 0.05);
/// Standard error of an initial value with pull 1. Steps are no longer than the initial value's error.
const UNIT_ERROR: f64 = 0.03;
/// Minimum pulls of gains and of offsets. The first matters for photos that constrain nothing. Cameras
/// cause few offsets; without a pull, the best exposure against a poor render is all offset and no gain.
const PULLS: (f64, f64) = (1e-3, 5.0);
/// Gains further from 1 than this factor are none of a camera.
const GAIN_MAX: f64 = 64.0;

/// Everything needed to go on bit for bit; one entry per photo.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ExposureState {
    /// Factor of R, G and B.
    pub gains: Vec<[f64; 3]>,
    /// Added to R, G and B after it.
    pub offsets: Vec<[f64; 3]>,
    /// Adam's first moments: contrast of R, G and B, then their mean color.
    pub first: Vec<[f64; 6]>,
    /// Adam's second moments.
    pub second: Vec<[f64; 6]>,
    /// Sums of the gradients since the last step: gains, then offsets.
    pub gradients: Vec<[f64; 6]>,
    /// Steps of Adam done.
    pub rounds: u32,
}

/// Exposures being fitted.
#[derive(Debug)]
pub struct Exposures {
    /// Which photos have one of their own.
    is_fitted: Vec<bool>,
    /// Mean color of each photo's unmasked pixels, 0..1.
    means: Vec<[f64; 3]>,
    /// Gains and offsets that each photo's are pulled to, and how much.
    start: Vec<[[f64; 3]; 2]>,
    pulls: Vec<f64>,
    state: ExposureState,
}

impl Exposures {
    /// Exposures of `targets`, which change nothing yet.
    pub fn new(targets: &[Target]) -> Self {
        let rows = vec![[0.0; 6]; targets.len()];
        Self {
            is_fitted: vec![true; targets.len()],
            means: targets.par_iter().map(mean_color).collect(),
            start: vec![[[1.0; 3], [0.0; 3]]; targets.len()],
            pulls: vec![0.0; targets.len()],
            state: ExposureState {
                gains: vec![[1.0; 3]; targets.len()],
                offsets: vec![[0.0; 3]; targets.len()],
                first: rows.clone(),
                second: rows.clone(),
                gradients: rows,
                rounds: 0,
            },
        }
    }

    /// Sets the initial exposures: a gain above 0 and an offset for each photo, or None for a photo whose
    /// exposure stays neutral. `pulls` times half the squared distances of log gains and offsets from
    /// them is added to the loss, because a poor render makes gains seem lower than they are.
    pub fn start(&mut self, start: &[Option<Exposure<f64>>], pulls: &[f64]) -> Result<()> {
        let count = self.is_fitted.len();
        if start.len() != count || pulls.len() != count {
            return Err(Error::argument(
                "exposures",
                format!("must have one start and one pull for each of {count} images"),
            ));
        }
        if !pulls.iter().all(|pull| pull.is_finite() && *pull >= 0.0) {
            return Err(Error::argument(
                "exposures",
                "must have pulls that are finite and not negative",
            ));
        }
        let gains = start.iter().flatten().flat_map(|exposure| exposure.gain);
        if !gains.into_iter().all(|gain| (1.0 / GAIN_MAX..=GAIN_MAX).contains(&gain)) {
            return Err(Error::argument(
                "exposures",
                format!("must have gains between 1/{GAIN_MAX} and {GAIN_MAX}"),
            ));
        }
        let each = || start.iter().map(|start| start.unwrap_or_else(Exposure::none));
        self.resume(ExposureState {
            gains: each().map(|exposure| exposure.gain).collect(),
            offsets: each().map(|exposure| exposure.offset).collect(),
            ..self.state.clone()
        })?;
        self.is_fitted = start.iter().map(Option::is_some).collect();
        self.anchor();
        let ExposureState { gains, offsets, .. } = &self.state;
        self.start = gains.iter().zip(offsets).map(|(&gain, &offset)| [gain, offset]).collect();
        self.pulls = pulls.to_vec();
        Ok(())
    }

    /// Resumes from the result of [`Exposures::state`].
    pub fn resume(&mut self, state: ExposureState) -> Result<()> {
        let n = self.is_fitted.len();
        let ExposureState { gains, offsets, first, second, gradients, .. } = &state;
        let lengths = [gains.len(), offsets.len(), first.len(), second.len(), gradients.len()];
        if lengths.iter().any(|&length| length != n) {
            return Err(Error::argument("exposures", format!("must have one row for {n} images")));
        }
        // Not the bounds of a start: bringing the mean back to 1 may lead out of them.
        if !gains.as_flattened().iter().all(|gain| gain.is_finite() && *gain > 0.0) {
            return Err(Error::argument("exposures", "has a gain that is not above 0"));
        }
        if !second.as_flattened().iter().all(|moment| *moment >= 0.0) {
            return Err(Error::argument("exposures", "has a negative second moment"));
        }
        let moments = [first, second, gradients].map(|rows| rows.as_flattened());
        let values = moments.into_iter().chain([offsets.as_flattened()]).flatten();
        if !values.copied().all(f64::is_finite) {
            return Err(Error::argument("exposures", "has a value that is not finite"));
        }
        self.state = state;
        Ok(())
    }

    /// The state needed to resume.
    pub fn state(&self) -> &ExposureState {
        &self.state
    }

    /// The correction of a photo's picture; `background` is the background of a photo with alpha.
    pub fn of(&self, view: usize, background: Option<[f32; 3]>) -> Exposure<f32> {
        let narrow = |values: [f64; 3]| values.map(|v| v as f32);
        let (gain, offset) = (self.state.gains[view], self.state.offsets[view]);
        Exposure { gain: narrow(gain), offset: narrow(offset), background }
    }

    /// Adds gradients of steps to the round's.
    pub fn add(&mut self, gradients: &[ExposureGradient]) {
        for gradient in gradients {
            let k = gradient.view;
            if !self.is_fitted[k] {
                continue;
            }
            let (gain, offset) = (self.state.gains[k], self.state.offsets[k]);
            let ([start_gain, start_offset], pull) = (self.start[k], self.pulls[k]);
            let (of_gain, of_offset) = (pull.max(PULLS.0), pull.max(PULLS.1));
            let row: [f64; 6] = std::array::from_fn(|i| match i {
                0..3 => gradient.v_gain[i] + of_gain * (gain[i] / start_gain[i]).ln() / gain[i],
                _ => gradient.v_offset[i - 3] + of_offset * (offset[i - 3] - start_offset[i - 3]),
            });
            // A picture that left f32 says nothing.
            if row.iter().all(|v| v.is_finite()) {
                for (sum, v) in self.state.gradients[k].iter_mut().zip(row) {
                    *sum += v;
                }
            }
        }
    }

    /// Moves the exposures by the round's gradients; `progress` is in 0..1, `rounds` per fit.
    pub fn step(&mut self, progress: f64, rounds: f64) {
        let decayed = DECAY.powf(progress.clamp(0.0, 1.0));
        let rate = (REACH / rounds.max(1.0)).clamp(RATES.0, RATES.1);
        self.state.rounds += 1;
        for k in 0..self.is_fitted.len() {
            let v = std::mem::take(&mut self.state.gradients[k]);
            if !self.is_fitted[k] {
                continue;
            }
            let (gain, offset, mean) = (self.state.gains[k], self.state.offsets[k], self.means[k]);
            // Contrast c about the mean: gain grows and offset falls so that the mean color stays.
            let v: [f64; 6] = std::array::from_fn(|i| match i {
                0..3 => gain[i] * v[i] - (mean[i] - offset[i]) * v[i + 3],
                _ => v[i],
            });
            let rate = rate.min(UNIT_ERROR / self.pulls[k].max(PULLS.0).sqrt());
            let moved = self.adam(k, v, decayed * rate);
            for c in 0..3 {
                let factor = moved[c].exp();
                let turned = (factor - 1.0) * (mean[c] - offset[c]);
                self.state.gains[k][c] = (gain[c] * factor).clamp(1.0 / GAIN_MAX, GAIN_MAX);
                self.state.offsets[k][c] = (offset[c] + moved[c + 3] - turned).clamp(-1.0, 1.0);
            }
        }
        self.anchor();
    }

    fn adam(&mut self, k: usize, gradient: [f64; 6], rate: f64) -> [f64; 6] {
        let (beta1, beta2, epsilon) = ADAM;
        let rounds = self.state.rounds.min(i32::MAX as u32) as i32;
        let (bias1, bias2) = (1.0 - beta1.powi(rounds), 1.0 - beta2.powi(rounds));
        let (first, second) = (&mut self.state.first[k], &mut self.state.second[k]);
        std::array::from_fn(|i| {
            let g = gradient[i];
            first[i] = beta1 * first[i] + (1.0 - beta1) * g;
            second[i] = beta2 * second[i] + (1.0 - beta2) * g * g;
            -rate * (first[i] / bias1) / ((second[i] / bias2).sqrt() + epsilon)
        })
    }

    /// Shifts the fitted photos' mean log gain and offset to zero; the splats' colors adapt.
    fn anchor(&mut self) {
        let fitted: Vec<usize> = (0..self.is_fitted.len()).filter(|&k| self.is_fitted[k]).collect();
        if fitted.is_empty() {
            return;
        }
        let n = fitted.len() as f64;
        let ExposureState { gains, offsets, .. } = &mut self.state;
        for c in 0..3 {
            let scale = (fitted.iter().map(|&k| gains[k][c].ln()).sum::<f64>() / n).exp();
            fitted.iter().for_each(|&k| gains[k][c] /= scale);
            // Colors higher by `shift` in the splats are higher by gain times that in the photo.
            let gain: f64 = fitted.iter().map(|&k| gains[k][c]).sum();
            let shift = fitted.iter().map(|&k| offsets[k][c]).sum::<f64>() / gain;
            fitted.iter().for_each(|&k| offsets[k][c] -= gains[k][c] * shift);
        }
    }
}

/// Mean color of the pixels that count, by how much they do.
fn mean_color(target: &Target) -> [f64; 3] {
    let channels = target.channels as usize;
    let (mut sums, mut total) = ([0.0; 3], 0.0);
    for (i, pixel) in target.pixels.chunks_exact(channels).enumerate() {
        let weight = target.weights.as_ref().map_or(1.0, |weights| f64::from(weights[i]));
        let alpha = if channels == 4 { f64::from(pixel[3]) / 255.0 } else { 1.0 };
        total += weight * alpha;
        for (sum, &value) in sums.iter_mut().zip(pixel) {
            *sum += weight * alpha * f64::from(value) / 255.0;
        }
    }
    sums.map(|sum| sum / f64::max(total, 1e-9))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photo(level: u8) -> Target {
        Target::new(2, 1, 3, [[level; 3], [level / 2; 3]].concat())
    }

    fn gradient(view: usize, v_gain: f64, v_offset: f64) -> ExposureGradient {
        ExposureGradient { view, v_gain: [v_gain; 3], v_offset: [v_offset; 3] }
    }

    #[test]
    fn exposures_of_photos_of_known_colors_are_found_up_to_their_mean() {
        // A scene of two colors whose photos have these gains and offsets.
        let scene = [0.2, 0.6];
        let truth = [(1.3, 0.002), (0.8, -0.004), (1.0 / (1.3 * 0.8), 0.002)];
        let targets = [photo(200), photo(120), photo(160)];
        let mut fitted = Exposures::new(&targets);
        let rounds = 400;
        for round in 0..rounds {
            for (view, (gain, offset)) in truth.into_iter().enumerate() {
                let exposure = fitted.of(view, None);
                let off = scene.map(|c| {
                    let got = f64::from(exposure.gain[0]) * c + f64::from(exposure.offset[0]);
                    got - (gain * c + offset)
                });
                let v_gain = off[0] * scene[0] + off[1] * scene[1];
                fitted.add(&[gradient(view, v_gain, off[0] + off[1])]);
            }
            fitted.step(f64::from(round) / f64::from(rounds), f64::from(rounds));
        }
        // The truth in the same gauge: its offsets have a mean of zero already.
        for (view, (gain, offset)) in truth.into_iter().enumerate() {
            let got = (fitted.state().gains[view][1], fitted.state().offsets[view][1]);
            assert!((got.0 / gain - 1.0).abs() < 0.02, "{view}: gain {got:?} for {gain}");
            assert!((got.1 - offset).abs() < 0.01, "{view}: offset {got:?} for {offset}");
        }
    }

    #[test]
    fn means_of_log_gain_and_offset_stay_zero() {
        let targets = [photo(200), photo(120), photo(60)];
        let start = |gain: f64, offset: f64| {
            Some(Exposure { gain: [gain; 3], offset: [offset; 3], background: None })
        };
        let mut fitted = Exposures::new(&targets);
        fitted.start(&[start(2.0, 0.2), start(1.5, 0.0), None], &[0.0; 3]).unwrap();
        for round in 0..5 {
            for view in 0..3 {
                fitted.add(&[gradient(view, 1.0 + view as f64, -0.3)]);
            }
            fitted.step(0.1 * f64::from(round), 10.0);
            let state = fitted.state();
            let logs: f64 = state.gains[..2].iter().map(|g| g[1].ln()).sum();
            let offsets: f64 = state.offsets[..2].iter().map(|o| o[1]).sum();
            assert!(logs.abs() < 1e-12 && offsets.abs() < 1e-12, "{logs} {offsets}");
            assert_eq!((state.gains[2], state.offsets[2]), ([1.0; 3], [0.0; 3]));
        }
    }

    #[test]
    fn a_pull_holds_an_exposure_near_its_start() {
        let start =
            |gain: f64| Some(Exposure { gain: [gain; 3], offset: [0.0; 3], background: None });
        let targets = [photo(200), photo(120)];
        let mut fitted = Exposures::new(&targets);
        let starts = [start(1.2), start(1.0 / 1.2)];
        fitted.start(&starts, &[10.0; 2]).unwrap();
        let mut run = |v_gain: f64| {
            for _ in 0..300 {
                fitted.add(&[gradient(0, v_gain, 0.0), gradient(1, -v_gain, 0.0)]);
                fitted.step(0.5, 600.0);
            }
            fitted.state().gains[0][0]
        };
        // A slope of the loss moves it by a tenth of that at most.
        let moved = run(0.1);
        assert!(moved < 1.2 && moved > 1.17, "{moved}");
        let back = run(0.0);
        assert!((back - 1.2).abs() < 2e-3, "{back}");
    }

    #[test]
    fn bad_exposures_are_named() {
        let dark = Some(Exposure { gain: [0.0; 3], ..Exposure::none() });
        let lost = Some(Exposure { offset: [f64::NAN; 3], ..Exposure::none() });
        for start in [vec![], vec![dark], vec![lost]] {
            let mut fitted = Exposures::new(&[photo(9)]);
            let error = fitted.start(&start, &[1.0]).unwrap_err().to_string();
            assert!(error.starts_with("exposures: "), "{error}");
        }
        for pulls in [&[][..], &[-1.0], &[f64::NAN]] {
            let mut fitted = Exposures::new(&[photo(9)]);
            assert!(fitted.start(&[Some(Exposure::none())], pulls).is_err(), "{pulls:?}");
        }
    }
}
