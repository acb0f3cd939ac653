//! Density control: how many splats there are to be, and the original control, which clones, splits and
//! prunes on the host. MCMC's runs on the device ([`FitDevice::mcmc`](crate::fit_device::FitDevice::mcmc)).

use glam::{Mat3, Quat, Vec3};
use rand::Rng;
use rand_pcg::Pcg64;

use crate::fit_device::{DensityStats, FitState};
use crate::splats::SplatArrays;

/// Splats fainter than this are dead (both papers).
const OPACITY_DEAD: f32 = 0.005;
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

fn finite(splats: &SplatArrays, i: usize) -> bool {
    let stride = splats.stride();
    splats.means[i]
        .iter()
        .chain(&splats.quats[i])
        .chain(&splats.scales[i])
        .chain(splats.sh[i * stride..(i + 1) * stride].as_flattened())
        .all(|v| v.is_finite())
}

/// How many splats a run of MCMC's control is to leave of `n`: the number grows by such a factor that
/// the last of `runs_left` runs, this one included, reaches `max_splats`.
///
/// The paper's 5 % a run gets nowhere from few points: 24 runs make three splats of one.
pub(super) fn mcmc_target(n: usize, max_splats: usize, runs_left: u32) -> usize {
    let needed = (max_splats as f64 / n as f64).max(1.0);
    match runs_left {
        0 => n,
        left => {
            let grown = (n as f64 * needed.powf(1.0 / f64::from(left))).ceil() as usize;
            max_splats.min(grown).max(n)
        }
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
    fn mcmc_reaches_the_cap_from_few_splats() {
        let mut n = 100;
        let mut counts = Vec::new();
        for left in (0..8).rev() {
            n = mcmc_target(n, 20_000, left);
            counts.push(n);
        }
        assert_eq!(counts[6..], [20_000, 20_000]);
        let rates = counts[..7].windows(2).map(|pair| pair[1] as f64 / pair[0] as f64);
        assert!(rates.clone().all(|rate| (rate - 200f64.powf(1.0 / 7.0)).abs() < 0.02));
        assert_eq!(mcmc_target(50, 40, 3), 50);
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
