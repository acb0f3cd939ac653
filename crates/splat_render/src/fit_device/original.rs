//! The original density control (3DGS, Kerbl et al. 2023): clones small and splits large splats with a
//! persistent pull on their projected center, then prunes faint ones. Devices with an implementation must
//! match this one bit for bit: pulls are integers, draws are hashes, sizes are compared by their
//! logarithms.

use std::cmp::Reverse;

use super::cell_order::cell_order;
use super::mcmc::{LOGIT_DEAD, finite};
use super::random::hash;
use super::state::{DensityStats, FitState};
use crate::constants::QUAT_NORM2_MIN;
use crate::splats::SplatArrays;

/// Pulls are counted in units of a 2^-24th of half the image.
pub(crate) const PULL_UNITS: f32 = 16_777_216.0;
/// Cap on the sum of gradients.
pub(crate) const PULL_SUM_MAX: f32 = 255.0;
/// Mean gradient of the projected center above which splats are added: 2e-4.
pub(crate) const PULL_GROW: u32 = 3355;
/// Splats larger than this part of the scene's extent are split, smaller ones cloned.
const SCALE_SPLIT: f64 = 0.01;
/// Size, as a fraction of the extent, beyond which huge splats are pruned.
const SCALE_HUGE: f64 = 0.1;
/// Decrease of log scales in a split: ln 1.6.
pub(crate) const LOG_SPLIT_SHRINK: f32 = 0.470_003_63;
/// Logit of the opacity that a reset leaves at most: 0.01.
pub(crate) const LOGIT_RESET: f32 = -4.595_12;
/// Bits of the smallest number that the placement of halves keeps: twice the smallest normal number,
/// since some devices test for underflow before they round and others after.
pub(crate) const KEPT_BITS_MIN: u32 = 0x0100_0000;
/// This minus the bits of a number from 1 to 2 gives the bits of its inverse to 12 %.
pub(crate) const INVERSE_GUESS: u32 = 0x7ef3_11c7;

/// One run of the density control.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OriginalRun {
    /// Maximum number of splats.
    pub max_splats: usize,
    /// The scene's extent, world units, which separates large splats from small ones.
    pub extent: f32,
    /// Whether splats that are too large are removed as well.
    pub prune_huge: bool,
    /// Of the draws.
    pub seed: u32,
}

impl OriginalRun {
    /// The log scales above which splats are split and above which they are removed.
    pub(crate) fn log_limits(&self) -> [f32; 2] {
        let log = |part: f64| (part * f64::from(self.extent)).ln() as f32;
        [log(SCALE_SPLIT), if self.prune_huge { log(SCALE_HUGE) } else { f32::INFINITY }]
    }
}

/// The mean gradient of a splat's projected center, in [`PULL_UNITS`].
fn pull(grad_sum: f32, seen: f32) -> u32 {
    if !(grad_sum.is_finite() && seen.is_finite()) {
        return 0;
    }
    let sum = (grad_sum.clamp(0.0, PULL_SUM_MAX) * PULL_UNITS) as u32;
    sum / seen.clamp(1.0, PULL_UNITS) as u32
}

/// Three normal draws to within 0.003 of their distribution: sums of twelve uniform ones each, less
/// their mean, which no device rounds. `half` is 0 for the splat itself, 1 for the fresh one.
fn draw(seed: u32, splat: u32, half: u32) -> [f32; 3] {
    let base = hash(splat ^ hash(seed ^ half));
    std::array::from_fn(|axis| {
        let two = |k: u32| {
            let word = hash(base.wrapping_add(6 * axis as u32 + k));
            (word >> 16) + (word & 0xffff)
        };
        ((0..6).map(two).sum::<u32>() as i32 - 393_210) as f32 * (1.0 / 65_536.0)
    })
}

/// e^x to 0.4 %, in integers: GPU compilers rearrange expressions that round several times.
fn exp(x: f32) -> f32 {
    // log2(e) and the result's exponent and fraction, all times 2^16.
    let power = (x.clamp(-87.0, 88.0) * 94_548.27).floor() as i32;
    let fraction = (power & 0xffff) as u32;
    // 2^f is about 1 + f - 0.343 f (1 - f).
    let bend = (((fraction * (0x1_0000 - fraction)) >> 16) * 22_493) >> 16;
    f32::from_bits((((power >> 16) + 127) as u32) << 23 | (fraction - bend) << 7)
}

/// The result of one operation, or 0 if it is tiny: some devices flush such numbers.
fn kept(x: f32) -> f32 {
    if x.to_bits() & 0x7fff_ffff < KEPT_BITS_MIN { 0.0 } else { x }
}

fn times(a: f32, b: f32) -> f32 {
    kept(a * b)
}

fn plus(a: f32, b: f32) -> f32 {
    kept(a + b)
}

/// 2 / x to 1e-7 of a finite x that is not tiny. Devices need not round quotients as the host does, but
/// products and differences: so it is Newton's steps for the inverse of x without its power of two.
fn two_over(x: f32) -> f32 {
    let bits = x.to_bits();
    let fraction = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    let mut inverse = f32::from_bits(INVERSE_GUESS - fraction.to_bits());
    for _ in 0..4 {
        inverse = times(inverse, plus(2.0, -times(fraction, inverse)));
    }
    kept(f32::from_bits(inverse.to_bits() + 0x4000_0000 - (bits & 0x7f80_0000)))
}

/// Position of one of the halves of splat `i`. Products and sums are rounded separately, as in
/// `half_mean` of original_draw.wgsl.
fn half_mean(splats: &SplatArrays, i: usize, draw: [f32; 3]) -> [f32; 3] {
    let mean = splats.means[i];
    let [w, x, y, z] = splats.quats[i].map(kept);
    let [ww, xx, yy, zz] = [w, x, y, z].map(|v| times(v, v));
    let norm2 = plus(plus(plus(ww, xx), yy), zz);
    if norm2 < QUAT_NORM2_MIN || !norm2.is_finite() {
        return mean;
    }
    let s = two_over(norm2);
    let [xy, xz, yz] = [times(x, y), times(x, z), times(y, z)];
    let [wx, wy, wz] = [x, y, z].map(|v| times(w, v));
    let beside = |a: f32, b: f32| times(s, plus(a, b));
    let on = |a: f32, b: f32| plus(1.0, -beside(a, b));
    let rows = [
        [on(yy, zz), beside(xy, -wz), beside(xz, wy)],
        [beside(xy, wz), on(xx, zz), beside(yz, -wx)],
        [beside(xz, -wy), beside(yz, wx), on(xx, yy)],
    ];
    let along: [f32; 3] = std::array::from_fn(|k| times(exp(kept(splats.scales[i][k])), draw[k]));
    let moved: [f32; 3] = std::array::from_fn(|k| {
        let [a, b, c] = std::array::from_fn(|axis| times(rows[k][axis], along[axis]));
        plus(kept(mean[k]), plus(plus(a, b), c))
    });
    if moved.iter().all(|v| v.is_finite()) { moved } else { mean }
}

fn largest([a, b, c]: [f32; 3]) -> f32 {
    a.max(b).max(c)
}

/// Runs the density control on the host.
pub(crate) fn original(state: &mut FitState, run: &OriginalRun) {
    let n = state.splats.len();
    let [log_split, log_huge] = run.log_limits();
    let pulls: Vec<u32> = (0..n)
        .map(|i| {
            let sum = pull(state.stats.grad_sum[i], state.stats.seen[i]);
            // Splats that are not finite are pruned anyway.
            if finite(&state.splats, i, 0) { sum } else { 0 }
        })
        .collect();
    let mut growing: Vec<usize> = (0..n).filter(|&i| pulls[i] > PULL_GROW).collect();
    // Under the cap, those pulled hardest come first; ties by index.
    growing.sort_by_key(|&i| Reverse(pulls[i]));
    growing.truncate(run.max_splats.saturating_sub(n));
    growing.sort_unstable();

    let fresh = state.splats.select(&growing);
    state.first.append(&SplatArrays::zeros(fresh.len(), fresh.sh_degree));
    state.second.append(&SplatArrays::zeros(fresh.len(), fresh.sh_degree));
    state.splats.append(&fresh);
    for (k, &i) in growing.iter().enumerate() {
        if largest(state.splats.scales[i]) <= log_split {
            continue;
        }
        // A split: two smaller ones drawn from the large one replace it.
        let means = [0, 1].map(|half| half_mean(&state.splats, i, draw(run.seed, i as u32, half)));
        for (target, mean) in [i, n + k].into_iter().zip(means) {
            state.splats.means[target] = mean;
            state.splats.scales[target] =
                state.splats.scales[target].map(|scale| scale - LOG_SPLIT_SHRINK);
            state.first.clear(target);
            state.second.clear(target);
        }
    }

    state.stats = DensityStats::zeros(state.splats.len());
    let keep: Vec<usize> = (0..state.splats.len())
        .filter(|&i| {
            let splats = &state.splats;
            finite(splats, i, 0)
                && splats.opacities[i] > LOGIT_DEAD
                && largest(splats.scales[i]) <= log_huge
        })
        .collect();
    // A fit without splats cannot recover: keep all.
    if !keep.is_empty() {
        state.select(&keep);
    }
    let order = cell_order(&state.splats.means);
    state.select(&order);
}

/// The original control's reset: no opacity that moves above [`LOGIT_RESET`], moments restarted. One
/// that is not finite is left for the next run to remove.
pub(crate) fn reset_opacities(state: &mut FitState) {
    let moving = state.moving();
    for opacity in state.splats.opacities[..moving].iter_mut().filter(|o| o.is_finite()) {
        *opacity = opacity.min(LOGIT_RESET);
    }
    for moments in [&mut state.first, &mut state.second] {
        moments.opacities[..moving].fill(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some(n: usize) -> FitState {
        let mut splats = SplatArrays::zeros(n, 1);
        for i in 0..n {
            splats.means[i] = draw(1, i as u32, 0);
            splats.quats[i] = [1.0, 0.1, 0.2, 0.3];
            splats.scales[i] = [-3.0; 3];
            splats.opacities[i] = 0.1 * i as f32;
        }
        FitState::new(splats)
    }

    fn run(max_splats: usize) -> OriginalRun {
        OriginalRun { max_splats, extent: 10.0, prune_huge: false, seed: 2 }
    }

    #[test]
    fn constants_are_those_of_the_paper() {
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        assert!((sigmoid(f64::from(LOGIT_RESET)) - 0.01).abs() < 1e-8);
        assert!((f64::from(LOG_SPLIT_SHRINK).exp() - 1.6).abs() < 1e-7);
        assert!((f64::from(PULL_GROW) / f64::from(PULL_UNITS) - 2e-4).abs() < 1e-7);
        let [split, huge] = OriginalRun { prune_huge: true, ..run(0) }.log_limits();
        assert!((split.exp() - 0.1).abs() < 1e-6 && (huge.exp() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn large_splats_are_split_small_ones_cloned_and_faint_ones_removed() {
        let mut state = some(5);
        state.stats.seen = vec![2.0; 5];
        state.stats.grad_sum = vec![1.0, 1.0, 3e-4, 0.0, 1.0];
        state.splats.scales[0] = [0.0; 3];
        state.splats.opacities[3] = -20.0;
        state.splats.sh[4 * 4][0] = f32::NAN;
        state.first.opacities.fill(1.0);
        original(&mut state, &run(100));
        state.validate().unwrap();
        // Two grew, two were pruned.
        assert_eq!(state.splats.len(), 5);
        let of = |opacity: f32| -> Vec<usize> {
            (0..5).filter(|&i| state.splats.opacities[i] == opacity).collect()
        };
        let (halves, clones, alone) = (of(0.0), of(0.1), of(0.2));
        assert_eq!([halves.len(), clones.len(), alone.len()], [2, 2, 1]);
        for &i in &halves {
            assert_eq!(state.splats.scales[i], [-LOG_SPLIT_SHRINK; 3]);
            assert_eq!(state.first.opacities[i], 0.0);
        }
        assert_ne!(state.splats.means[halves[0]], state.splats.means[halves[1]]);
        assert_eq!(state.splats.means[clones[0]], state.splats.means[clones[1]]);
        assert_eq!(clones.iter().map(|&i| state.first.opacities[i]).sum::<f32>(), 1.0);
    }

    #[test]
    fn under_the_cap_the_largest_gradients_grow() {
        let mut state = some(4);
        state.stats.seen = vec![1.0, 4.0, 0.0, 1.0];
        state.stats.grad_sum = vec![0.5, 4.0, 0.7, f32::NAN];
        original(&mut state, &run(6));
        let count = |o: f32| state.splats.opacities.iter().filter(|&&v| v == o).count();
        assert_eq!([0.0, 0.1, 0.2, 0.1 * 3.0].map(count), [1, 2, 2, 1]);
        let mut full = some(4);
        full.stats.grad_sum = vec![1.0; 4];
        original(&mut full, &run(3));
        assert_eq!(full.splats.len(), 4, "none leaves for the cap");
    }

    #[test]
    fn huge_splats_are_removed_on_request_and_a_scene_is_never_emptied() {
        let mut state = some(3);
        state.splats.scales[1][2] = 0.1;
        let huge = OriginalRun { prune_huge: true, ..run(3) };
        let mut pruned = state.clone();
        original(&mut pruned, &huge);
        assert_eq!(pruned.splats.len(), 2);
        // A split makes it small enough.
        state.stats.grad_sum[1] = 1.0;
        original(&mut state, &OriginalRun { max_splats: 4, ..huge });
        assert_eq!(state.splats.len(), 4);
        let mut dead = some(3);
        dead.splats.opacities.fill(-9.0);
        original(&mut dead, &huge);
        assert_eq!(dead.splats.len(), 3);
    }

    #[test]
    fn exp_is_accurate_to_0_4_percent() {
        for k in -860..=870 {
            let x = 0.1 * k as f32;
            let off = f64::from(exp(x)) / f64::from(x).exp() - 1.0;
            assert!(off.abs() < 4e-3, "{x}: {off}");
        }
        assert!(exp(-1e9) > 0.0 && exp(1e9).is_finite());
    }

    #[test]
    fn two_over_is_accurate() {
        let mut worst = 0.0f64;
        // Every power of two that a squared norm can have, and between them 2000 numbers.
        for power in -40..126 {
            for step in 0..2000 {
                let x = (1.0 + f64::from(step) / 2000.0) * f64::from(power).exp2();
                let x = x as f32;
                worst = worst.max((f64::from(two_over(x)) * f64::from(x) / 2.0 - 1.0).abs());
            }
        }
        let last = f32::from_bits(0x3fff_ffff);
        worst = worst.max((f64::from(two_over(last)) * f64::from(last) / 2.0 - 1.0).abs());
        assert!(worst < 1e-7, "{worst}");
        // Larger numbers give 0: a device may flush 2 / x.
        for x in [2f32.powi(126) * 1.5, f32::MAX] {
            assert_eq!(two_over(x), 0.0);
        }
    }

    #[test]
    fn tiny_numbers_are_not_kept() {
        let least = 2f32.powi(-125);
        assert_eq!(least.to_bits(), KEPT_BITS_MIN);
        let below = f32::from_bits(KEPT_BITS_MIN - 1);
        for (x, expected) in [(least, least), (-least, -least), (below, 0.0), (-below, 0.0)] {
            assert_eq!(kept(x).to_bits(), expected.to_bits());
        }
        assert_eq!(kept(-0.0).to_bits(), 0);
        assert!(kept(f32::NAN).is_nan() && kept(f32::INFINITY).is_infinite());
        assert_eq!(times(1e-20, 1e-20), 0.0);
    }

    #[test]
    fn halves_are_placed_along_the_splat() {
        let mut splats = SplatArrays::zeros(1, 0);
        splats.means[0] = [1.0, 2.0, 3.0];
        // A quarter turn about z brings the long axis x to y.
        splats.quats[0] = [2.0, 0.0, 0.0, 2.0];
        splats.scales[0] = [0.0, -2.0, -3.0];
        let n = 20_000;
        let mut moments = [[0.0; 3]; 2];
        for k in 0..n {
            let at = half_mean(&splats, 0, draw(7, k, k % 2));
            for c in 0..3 {
                let off = f64::from(at[c] - splats.means[0][c]);
                moments[0][c] += off / f64::from(n);
                moments[1][c] += off * off / f64::from(n);
            }
        }
        for (c, log) in [-2.0f64, 0.0, -3.0].into_iter().enumerate() {
            assert!(moments[0][c].abs() < 0.03 * log.exp(), "{moments:?}");
            assert!((moments[1][c].sqrt() / log.exp() - 1.0).abs() < 0.02, "{moments:?}");
        }
        splats.quats[0] = [0.0; 4];
        assert_eq!(half_mean(&splats, 0, [1.0; 3]), splats.means[0]);
        (splats.quats[0], splats.scales[0]) = ([1.0, 0.0, 0.0, 0.0], [100.0; 3]);
        splats.means[0] = [3e38; 3];
        assert_eq!(half_mean(&splats, 0, [6.0; 3]), splats.means[0]);
    }

    #[test]
    fn a_reset_caps_opacities_and_restarts_their_moments() {
        let mut state = some(2);
        state.splats.opacities = vec![2.0, -7.0];
        for moments in [&mut state.first, &mut state.second] {
            moments.opacities.fill(1.0);
            moments.means.fill([1.0; 3]);
        }
        reset_opacities(&mut state);
        assert_eq!(state.splats.opacities, [LOGIT_RESET, -7.0]);
        assert_eq!([&state.first.opacities, &state.second.opacities], [&[0.0; 2]; 2]);
        assert_eq!(state.first.means, [[1.0; 3]; 2]);
    }
}
