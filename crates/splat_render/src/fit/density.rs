//! Density control: where splats are added, moved and removed. Runs on the host, the same for every
//! device, so that backends differ only by rounding.

use glam::{Mat3, Quat, Vec3};
use rand::Rng;
use rand_pcg::Pcg64;

use crate::fit_device::{DensityStats, FitState};
use crate::splats::SplatArrays;

/// Splats fainter than this are dead (both papers).
const OPACITY_DEAD: f32 = 0.005;
/// Most copies one splat may get in one MCMC run (the binomial table's size in the paper's code).
const COPIES_MAX: usize = 51;
/// Mean gradient of the projected centre (units of half the image) above which the original control
/// adds splats.
const GRAD_GROW: f32 = 2e-4;
/// Splats larger than this part of the scene's extent are split, smaller ones cloned.
const SCALE_SPLIT: f32 = 0.01;
/// Splats larger than this part of the extent are removed, once opacities have been reset.
const SCALE_HUGE: f32 = 0.1;
/// What a split divides scales by.
const SPLIT_SHRINK: f32 = 1.6;
/// Opacity that a reset leaves at most.
const OPACITY_RESET: f32 = 0.01;

/// The logit of an opacity that is dead.
pub(super) const DEAD: f32 = -10.0;

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}

/// A standard normal draw (Box-Muller).
fn normal(rng: &mut Pcg64) -> f32 {
    let radius = (-2.0 * (1.0 - rng.random::<f32>()).ln()).sqrt();
    radius * (std::f32::consts::TAU * rng.random::<f32>()).cos()
}

/// Draws `count` ids with probability proportional to `weights`.
fn sample(weights: &[f32], count: usize, rng: &mut Pcg64) -> Vec<usize> {
    let mut sums = Vec::with_capacity(weights.len());
    let mut sum = 0.0f64;
    for &weight in weights {
        sum += f64::from(weight.max(0.0));
        sums.push(sum);
    }
    if !(sum > 0.0 && sum.is_finite()) {
        return Vec::new();
    }
    (0..count)
        .map(|_| {
            let at = rng.random::<f64>() * sum;
            sums.partition_point(|&s| s <= at).min(weights.len() - 1)
        })
        .collect()
}

/// Opacity and scale factor of each of `copies` splats that together look as one of opacity `o` did
/// (3DGS-MCMC, eq. 9).
fn share(o: f32, copies: usize) -> (f32, f32) {
    let o = f64::from(o);
    let each = 1.0 - (1.0 - o).powf(1.0 / copies as f64);
    let mut sum = 0.0;
    for i in 1..=copies {
        let mut binomial = 1.0f64;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += sign * binomial * each.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    (each as f32, (o / sum) as f32)
}

/// MCMC: dead splats move to living ones, chosen by opacity, and the number grows by such a factor
/// that the last of `runs_left` runs, this one included, reaches `max_splats`.
///
/// The paper's 5 % a run gets nowhere from few points: 24 runs make three splats of one.
pub(super) fn mcmc(state: &mut FitState, max_splats: usize, runs_left: u32, rng: &mut Pcg64) {
    let n = state.splats.len();
    let opacities: Vec<f32> = state.splats.opacities.iter().map(|&o| sigmoid(o)).collect();
    let dead: Vec<usize> = (0..n)
        .filter(|&i| {
            opacities[i].is_nan() || opacities[i] <= OPACITY_DEAD || !finite(&state.splats, i)
        })
        .collect();
    let mut weights = opacities;
    for &i in &dead {
        weights[i] = 0.0;
    }
    let sources = sample(&weights, dead.len(), rng);
    if sources.len() == dead.len() {
        spread(state, &sources, &dead);
    }

    let needed = (max_splats as f64 / n as f64).max(1.0);
    let target = match runs_left {
        0 => n,
        left => max_splats.min((n as f64 * needed.powf(1.0 / f64::from(left))).ceil() as usize),
    };
    let weights: Vec<f32> = state.splats.opacities.iter().map(|&o| sigmoid(o)).collect();
    let sources = sample(&weights, target.saturating_sub(n), rng);
    let fresh: Vec<usize> = (n..n + sources.len()).collect();
    for arrays in [&mut state.splats, &mut state.first, &mut state.second] {
        let copies = arrays.select(&sources);
        arrays.append(&copies);
    }
    spread(state, &sources, &fresh);
    state.stats = DensityStats::zeros(state.splats.len());
}

fn finite(splats: &SplatArrays, i: usize) -> bool {
    let stride = splats.stride();
    splats.means[i]
        .iter()
        .chain(&splats.quats[i])
        .chain(&splats.scales[i])
        .chain(splats.sh[i * stride..(i + 1) * stride].as_flattened())
        .all(|v| v.is_finite())
}

/// Overwrites `targets[k]` with a copy of `sources[k]`, sharing opacity and size among all copies,
/// and restarts the optimiser's moments of all of them.
fn spread(state: &mut FitState, sources: &[usize], targets: &[usize]) {
    let mut copies = vec![1usize; state.splats.len()];
    for &source in sources {
        copies[source] += 1;
    }
    let stride = state.splats.stride();
    let mut unique: Vec<usize> = sources.to_vec();
    unique.sort_unstable();
    unique.dedup();
    for &i in &unique {
        let o = sigmoid(state.splats.opacities[i]);
        let (each, factor) = share(o, copies[i].min(COPIES_MAX));
        state.splats.opacities[i] = logit(each.clamp(OPACITY_DEAD, 1.0 - f32::EPSILON));
        for scale in &mut state.splats.scales[i] {
            *scale += factor.ln();
        }
        state.first.clear(i);
        state.second.clear(i);
    }
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

/// The original control: clone small and split large splats whose projected centre keeps being
/// pulled, then prune faint ones, and huge ones if `prune_huge`.
pub(super) fn original(
    state: &mut FitState,
    max_splats: usize,
    extent: f32,
    prune_huge: bool,
    rng: &mut Pcg64,
) {
    let n = state.splats.len();
    let pull: Vec<f32> =
        (0..n).map(|i| state.stats.grad_sum[i] / state.stats.seen[i].max(1.0)).collect();
    let mut growing: Vec<usize> = (0..n).filter(|&i| pull[i] > GRAD_GROW).collect();
    // Under the cap, those pulled hardest come first; ties by index.
    growing.sort_by(|&a, &b| pull[b].total_cmp(&pull[a]).then(a.cmp(&b)));
    growing.truncate(max_splats.saturating_sub(n));
    growing.sort_unstable();

    let fresh = state.splats.select(&growing);
    let first_fresh = n;
    for (arrays, copies) in [
        (&mut state.splats, fresh.clone()),
        (&mut state.first, SplatArrays::zeros(fresh.len(), fresh.sh_degree)),
        (&mut state.second, SplatArrays::zeros(fresh.len(), fresh.sh_degree)),
    ] {
        arrays.append(&copies);
    }
    for (k, &i) in growing.iter().enumerate() {
        let scales = Vec3::from(state.splats.scales[i]).exp();
        if scales.max_element() <= SCALE_SPLIT * extent {
            continue;
        }
        // A split: two smaller ones drawn from the large one replace it.
        let [w, x, y, z] = state.splats.quats[i];
        let axes = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
        let mean = Vec3::from(state.splats.means[i]);
        for target in [i, first_fresh + k] {
            let z = Vec3::new(normal(rng), normal(rng), normal(rng));
            let moved = mean + axes * (scales * z);
            state.splats.means[target] =
                if moved.is_finite() { moved.to_array() } else { mean.to_array() };
            for scale in &mut state.splats.scales[target] {
                *scale -= SPLIT_SHRINK.ln();
            }
            state.first.clear(target);
            state.second.clear(target);
        }
    }

    state.stats = DensityStats::zeros(state.splats.len());
    let keep: Vec<usize> = (0..state.splats.len())
        .filter(|&i| {
            let scale = state.splats.scales[i].iter().fold(f32::MIN, |a, &s| a.max(s)).exp();
            sigmoid(state.splats.opacities[i]) > OPACITY_DEAD
                && finite(&state.splats, i)
                && !(prune_huge && scale > SCALE_HUGE * extent)
        })
        .collect();
    // A fit without splats cannot recover: keep what there is.
    if !keep.is_empty() && keep.len() < state.splats.len() {
        state.select(&keep);
    }
}

/// The original control's reset: no opacity above [`OPACITY_RESET`], moments of opacities restarted.
pub(super) fn reset_opacities(state: &mut FitState) {
    let most = logit(OPACITY_RESET);
    for opacity in &mut state.splats.opacities {
        *opacity = opacity.min(most);
    }
    state.first.opacities.fill(0.0);
    state.second.opacities.fill(0.0);
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

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

    #[test]
    fn sharing_keeps_the_opacity_of_the_stack() {
        for o in [0.01f32, 0.3, 0.9, 0.99] {
            for copies in [1, 2, 5] {
                let (each, factor) = share(o, copies);
                let stack = 1.0 - (1.0 - each).powi(copies as i32);
                assert!((stack - o).abs() < 1e-5, "{o} as {copies}: {stack}");
                assert!(factor.is_finite() && factor > 0.0);
                if copies == 1 {
                    assert!((factor - 1.0).abs() < 1e-5);
                }
            }
        }
    }

    #[test]
    fn mcmc_moves_the_dead_and_respects_the_cap() {
        let mut state = some(100);
        state.splats.opacities[7] = -20.0;
        state.splats.means[9] = [f32::NAN; 3];
        mcmc(&mut state, 103, 1, &mut Pcg64::seed_from_u64(2));
        assert_eq!(state.splats.len(), 103);
        state.validate().unwrap();
        assert!(sigmoid(state.splats.opacities[7]) >= OPACITY_DEAD * 0.99);
        assert!((0..103).all(|i| finite(&state.splats, i)));
    }

    #[test]
    fn mcmc_reaches_the_cap_from_few_splats() {
        let mut state = some(100);
        let mut counts = Vec::new();
        for left in (0..8).rev() {
            mcmc(&mut state, 20_000, left, &mut Pcg64::seed_from_u64(2));
            counts.push(state.splats.len());
        }
        assert_eq!(counts[6..], [20_000, 20_000]);
        let rates = counts[..7].windows(2).map(|pair| pair[1] as f64 / pair[0] as f64);
        assert!(rates.clone().all(|rate| (rate - 200f64.powf(1.0 / 7.0)).abs() < 0.02));
    }

    #[test]
    fn original_splits_large_clones_small_prunes_faint() {
        let mut state = some(4);
        state.stats.seen = vec![1.0; 4];
        state.stats.grad_sum = vec![1.0, 1.0, 0.0, 0.0];
        state.splats.scales[0] = [0.0; 3];
        state.splats.opacities[3] = -20.0;
        original(&mut state, 100, 10.0, false, &mut Pcg64::seed_from_u64(2));
        state.validate().unwrap();
        // Two grew, one was pruned.
        assert_eq!(state.splats.len(), 5);
        assert!((state.splats.scales[0][0] + SPLIT_SHRINK.ln()).abs() < 1e-6);
        assert_eq!(state.splats.means[1], state.splats.means[4]);
        let mut capped = some(4);
        capped.stats.grad_sum = vec![1.0; 4];
        original(&mut capped, 5, 1.0, false, &mut Pcg64::seed_from_u64(2));
        assert_eq!(capped.splats.len(), 5);
    }
}
