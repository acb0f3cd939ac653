//! MCMC's density control (3DGS-MCMC, Kheradmand et al. 2024): dead splats move to living ones, and the
//! number grows. Devices with an implementation must match this one bit for bit: weights are integers,
//! draws are hashes, and powers and logarithms come from tables.

use std::sync::OnceLock;

use super::cell_order::cell_order;
use super::fog::{FogCamera, sampled_every};
use super::random::hash;
use super::state::{DensityStats, FitState};
use crate::camera::Camera;
use crate::splats::SplatArrays;

/// Logit of the opacity at and below which splats are dead (both papers): 0.005.
pub(crate) const LOGIT_DEAD: f32 = -5.293_305;
/// The logit that fog gets.
pub(crate) const LOGIT_FOG: f32 = -10.0;
/// Maximum number of splats that share one opacity (size of the binomial table in the paper's code).
pub(crate) const SHARES_MAX: usize = 51;
/// Bins of logits per unit, from [`LOGIT_FIRST`] on.
pub(crate) const BINS_PER_LOGIT: f32 = 64.0;
/// Start of the first bin.
pub(crate) const LOGIT_FIRST: f32 = -6.0;
/// Bins of logits: up to 10.
pub(crate) const BINS: usize = 1024;
/// One run of the density control.
#[derive(Debug, Clone)]
pub struct McmcRun {
    /// The photos' cameras: fog right in front of one dies.
    pub cameras: Vec<Camera>,
    /// How many splats there are to be.
    pub target: usize,
    /// Of the draws.
    pub seed: u32,
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// The logit in the middle of a bin.
fn middle(bin: usize) -> f64 {
    f64::from(LOGIT_FIRST) + (bin as f64 + 0.5) / f64::from(BINS_PER_LOGIT)
}

fn bin(logit: f32) -> usize {
    ((logit - LOGIT_FIRST) * BINS_PER_LOGIT).clamp(0.0, (BINS - 1) as f32) as usize
}

/// Weights of living splats by the bin of their logit: in proportion to opacity, and so small that the
/// sum over `splats` fits 32 bits.
pub(crate) fn weight_table(splats: usize) -> Vec<u32> {
    let most = (u32::MAX as usize / splats.max(1)).min(65_535) as f64;
    (0..BINS).map(|bin| ((sigmoid(middle(bin)) * most).round() as u32).max(1)).collect()
}

/// Changes of logit and log scales that keep the look of a splat split into several (3DGS-MCMC, eq. 9):
/// `[BINS][SHARES_MAX - 1]`, from two splats on.
pub(crate) fn share_table() -> &'static [[f32; 2]] {
    static TABLE: OnceLock<Vec<[f32; 2]>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let of = |bin| (2..=SHARES_MAX).map(move |shares| share(middle(bin), shares));
        (0..BINS).flat_map(of).collect()
    })
}

fn share(logit: f64, shares: usize) -> [f32; 2] {
    let o = sigmoid(logit);
    let each = 1.0 - (1.0 - o).powf(1.0 / shares as f64);
    let mut sum = 0.0;
    for i in 1..=shares {
        let mut binomial = 1.0f64;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += sign * binomial * each.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    [((each / (1.0 - each)).ln() - logit) as f32, (o / sum).ln() as f32]
}

/// The draw `k` of a round, below `total`.
fn draw(run: &McmcRun, round: u32, k: u32, total: u32) -> u32 {
    let r = hash(k ^ hash(run.seed ^ round));
    ((u64::from(r) * u64::from(total)) >> 32) as u32
}

/// Whether all that is looked at is finite; colors only in the first round.
pub(super) fn finite(splats: &SplatArrays, i: usize, round: u32) -> bool {
    let stride = splats.stride();
    let colors = if round == 0 { &splats.sh[i * stride..(i + 1) * stride] } else { &[] };
    splats.means[i]
        .iter()
        .chain(&splats.quats[i])
        .chain(&splats.scales[i])
        .chain(std::slice::from_ref(&splats.opacities[i]))
        .chain(colors.as_flattened())
        .all(|v| v.is_finite())
}

/// Runs the density control on the host.
pub(crate) fn mcmc(state: &mut FitState, run: &McmcRun) {
    let n = state.splats.len();
    let every = sampled_every(n);
    let sample: Vec<_> = state.splats.means.iter().copied().step_by(every).collect();
    let cameras: Vec<_> =
        run.cameras.iter().map(|camera| FogCamera::new(camera, &sample)).collect();
    let table = weight_table(run.target.max(n));
    let weights = |splats: &SplatArrays, round: u32| -> Vec<u32> {
        let of = |i: usize| {
            let o = splats.opacities[i];
            if finite(splats, i, round) && o > LOGIT_DEAD { table[bin(o)] } else { 0 }
        };
        (0..splats.len()).map(of).collect()
    };
    let splats = &mut state.splats;
    for i in 0..n {
        if cameras.iter().any(|camera| camera.has_fog(splats.means[i], splats.scales[i])) {
            splats.opacities[i] = LOGIT_FOG;
        }
    }
    let found = weights(splats, 0);
    let dead: Vec<usize> = (0..n).filter(|&i| found[i] == 0).collect();
    spread(state, run, 0, &found, &dead);

    let found = weights(&state.splats, 1);
    // From nothing but dead splats nothing grows.
    let fresh = if found.iter().all(|&w| w == 0) { 0 } else { run.target.saturating_sub(n) };
    for arrays in [&mut state.splats, &mut state.first, &mut state.second] {
        arrays.append(&SplatArrays::zeros(fresh, arrays.sh_degree));
    }
    spread(state, run, 1, &found, &(n..n + fresh).collect::<Vec<_>>());
    state.stats = DensityStats::zeros(state.splats.len());
    let order = cell_order(&state.splats.means);
    state.select(&order);
}

/// Overwrites `targets` with copies of splats that are drawn by weight, sharing opacity and size among
/// all copies, and restarts the optimizer's moments of all of them.
fn spread(state: &mut FitState, run: &McmcRun, round: u32, weights: &[u32], targets: &[usize]) {
    let mut total = 0;
    let sums: Vec<u32> = weights
        .iter()
        .map(|weight| {
            total += weight;
            total
        })
        .collect();
    if total == 0 {
        return;
    }
    let drawn = |k: usize| {
        let at = draw(run, round, k as u32, total);
        sums.partition_point(|&sum| sum <= at)
    };
    let sources: Vec<usize> = (0..targets.len()).map(drawn).collect();
    let mut copies = vec![0usize; weights.len()];
    for &source in &sources {
        copies[source] += 1;
    }
    for (i, &copies) in copies.iter().enumerate().filter(|&(_, &copies)| copies > 0) {
        let shares = (copies + 1).min(SHARES_MAX);
        let opacity = &mut state.splats.opacities[i];
        let [logit, scale] = share_table()[bin(*opacity) * (SHARES_MAX - 1) + shares - 2];
        *opacity = (*opacity + logit).max(LOGIT_DEAD);
        state.splats.scales[i] = state.splats.scales[i].map(|s| s + scale);
        state.first.clear(i);
        state.second.clear(i);
    }
    let stride = state.splats.stride();
    for (&source, &target) in sources.iter().zip(targets) {
        let splats = &mut state.splats;
        splats.means[target] = splats.means[source];
        splats.quats[target] = splats.quats[source];
        splats.scales[target] = splats.scales[source];
        splats.opacities[target] = splats.opacities[source];
        splats.sh.copy_within(source * stride..(source + 1) * stride, target * stride);
        state.first.clear(target);
        state.second.clear(target);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_pcg::Pcg64;

    fn some(n: usize) -> FitState {
        let mut rng = Pcg64::seed_from_u64(1);
        let mut splats = SplatArrays::zeros(n, 1);
        for i in 0..n {
            splats.means[i] = std::array::from_fn(|_| rng.random::<f32>());
            splats.quats[i] = [1.0, 0.1, 0.2, 0.3];
            splats.scales[i] = [-3.0; 3];
            splats.opacities[i] = rng.random_range(-2.0..2.0);
        }
        FitState::new(splats)
    }

    fn run(target: usize) -> McmcRun {
        McmcRun { cameras: Vec::new(), target, seed: 2 }
    }

    #[test]
    fn the_dead_logit_is_that_of_the_papers() {
        assert!((sigmoid(f64::from(LOGIT_DEAD)) - 0.005).abs() < 1e-9);
    }

    #[test]
    fn sharing_keeps_the_opacity_of_the_stack() {
        for logit in [-4.5f64, -0.8, 2.2, 4.6] {
            for shares in [2, 5, 51] {
                let [added, scale] = share(logit, shares);
                let each = sigmoid(logit + f64::from(added));
                let stack = 1.0 - (1.0 - each).powi(shares as i32);
                assert!((stack - sigmoid(logit)).abs() < 1e-5, "{logit} as {shares}: {stack}");
                assert!(scale.is_finite());
            }
        }
        // The bins are narrow enough for that.
        for logit in [-5.2f32, -1.234, 0.0, 3.456, 9.9] {
            let [added, _] = share_table()[bin(logit) * (SHARES_MAX - 1)];
            let each = sigmoid(f64::from(logit + added));
            let stack = 1.0 - (1.0 - each).powi(2);
            assert!((stack - sigmoid(f64::from(logit))).abs() < 2e-3, "{logit}: {stack}");
        }
    }

    #[test]
    fn draws_follow_the_opacities() {
        let mut state = some(4);
        state.splats.opacities = vec![-3.0, -1.0, 1.0, -20.0];
        let weights: Vec<u32> = vec![3, 27, 70, 0];
        let n = 10_000;
        for arrays in [&mut state.splats, &mut state.first, &mut state.second] {
            arrays.append(&SplatArrays::zeros(n, 1));
        }
        spread(&mut state, &run(0), 1, &weights, &(4..4 + n).collect::<Vec<_>>());
        for (i, weight) in weights.iter().enumerate() {
            let found = state.splats.means[4..].iter().filter(|&&m| m == state.splats.means[i]);
            let part = found.count() as f64 / n as f64;
            assert!((part - f64::from(*weight) / 100.0).abs() < 0.01, "{i}: {part}");
        }
    }

    #[test]
    fn dead_splats_move_and_the_target_is_reached() {
        let mut state = some(100);
        state.splats.opacities[7] = -20.0;
        state.splats.means[9] = [f32::NAN; 3];
        state.splats.sh[13][1] = f32::INFINITY;
        state.first.opacities.fill(1.0);
        mcmc(&mut state, &run(103));
        assert_eq!(state.splats.len(), 103);
        state.validate().unwrap();
        assert!(state.splats.opacities.iter().all(|&o| o >= LOGIT_DEAD));
        assert!((0..103).all(|i| finite(&state.splats, i, 0)));
        // Three dead and three fresh, each with a source that may be shared.
        let restarted = state.first.opacities.iter().filter(|&&m| m == 0.0).count();
        assert!((7..=12).contains(&restarted), "{restarted}");
    }

    #[test]
    fn dead_scenes_stay_as_they_are() {
        let mut state = some(10);
        state.splats.opacities.fill(-20.0);
        mcmc(&mut state, &run(20));
        assert_eq!(state.splats.len(), 10);
    }
}
