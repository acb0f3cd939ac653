//! Random numbers of a step: dropped splats and exploration noise. A draw is a hash of a seed and a
//! splat's index, the same on every device.

/// PCG's output function on one 32-bit word.
#[inline(always)]
pub(super) fn hash(x: u32) -> u32 {
    let state = x.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    (word >> 22) ^ word
}

/// exp to about 1e-7 relative, the same bits as `exp_of_rounded` of shaders/mcmc_weigh.wgsl.
#[allow(clippy::excessive_precision, reason = "the digits of the shader's")]
pub(crate) fn exp_accurate(x: f32) -> f32 {
    let y = x.clamp(-87.0, 88.0);
    let k = (y * std::f32::consts::LOG2_E + 0.5).floor();
    let r = (y - k * 0.693_359_375) + k * 2.121_944_40e-4;
    let poly = [
        1.398_199_950_7e-3_f32,
        8.333_451_907_3e-3,
        4.166_579_589_4e-2,
        1.666_666_545_9e-1,
        5.000_000_120_1e-1,
    ]
    .into_iter()
    .fold(1.987_569_150_0e-4, |poly, next| poly * r + next);
    ((poly * r * r + r) + 1.0) * f32::from_bits(((k as i32 + 127) << 23) as u32)
}

/// The hash value below which a splat is dropped.
pub(crate) fn dropout_threshold(rate: f32) -> u32 {
    (f64::from(rate) * 4_294_967_296.0) as u32
}

/// Whether a step drops the splat `index` (DropGaussian, Park et al. 2025); same on every backend.
pub fn is_dropped(seed: u32, index: u32, rate: f32) -> bool {
    hash(index ^ hash(seed ^ 0x5bd1_e995)) < dropout_threshold(rate)
}

/// Four numbers in (0, 1] of (seed, splat index), which [`noise_normal`] makes its own of: integer
/// hash (PCG output function applied thrice).
#[inline(always)]
pub(crate) fn noise_draw(seed: u32, index: u32) -> [f32; 4] {
    let base = hash(index ^ hash(seed));
    let mut draw = [0.0; 4];
    for (k, draw) in (0..).zip(&mut draw) {
        // Above 0: the logarithm stays finite.
        *draw = ((hash(base.wrapping_add(k)) >> 8) as f32 + 1.0) * (1.0 / 16_777_216.0);
    }
    draw
}

/// Three standard normal numbers from (seed, splat index): four drawn numbers, then Box-Muller. The
/// same on every backend up to the rounding of log, sqrt, cos.
pub fn noise_normal(seed: u32, index: u32) -> [f32; 3] {
    let draw = noise_draw(seed, index);
    let (r0, r1) = ((-2.0 * draw[0].ln()).sqrt(), (-2.0 * draw[2].ln()).sqrt());
    let (a0, a1) = (std::f32::consts::TAU * draw[1], std::f32::consts::TAU * draw[3]);
    [r0 * a0.cos(), r0 * a0.sin(), r1 * a1.cos()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropout_leaves_out_other_splats_at_each_step() {
        let dropped = |seed, rate| (0..100_000).filter(move |&i| is_dropped(seed, i, rate));
        assert_eq!(dropped(3, 0.0).count(), 0);
        for (seed, rate) in [(0, 0.1), (7, 0.3), (u32::MAX, 0.9)] {
            let part = dropped(seed, rate).count() as f32 / 1e5;
            assert!((part - rate).abs() < 0.01, "{part} instead of {rate}");
        }
        // Two steps agree by chance only.
        let both = dropped(1, 0.3).filter(|&i| is_dropped(2, i, 0.3)).count() as f32 / 1e5;
        assert!((both - 0.09).abs() < 0.01, "{both}");
    }
}
