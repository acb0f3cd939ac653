//! The yardstick of the benchmark: how many multiply-adds per second the machine gives right now.

use std::hint::black_box;
use std::time::{Duration, Instant};

use pulp::{Simd, WithSimd};

/// Chains of dependent multiply-adds per thread: more than two units' latency, within 16 registers.
const CHAINS: usize = 12;

/// Rounds between two looks at the clock: about 10 us.
const ROUNDS: usize = 4096;

struct Chains {
    factor: f32,
    summand: f32,
}

impl WithSimd for Chains {
    /// A value that depends on every chain, and the number of floating-point operations.
    type Output = (f32, usize);

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> (f32, usize) {
        let (factor, summand) = (s.splat_f32s(self.factor), s.splat_f32s(self.summand));
        let mut chains = [summand; CHAINS];
        for _ in 0..ROUNDS {
            for chain in &mut chains {
                *chain = s.mul_add_e_f32s(*chain, factor, summand);
            }
        }
        let mut sum = s.splat_f32s(0.0);
        for chain in chains {
            sum = s.add_f32s(sum, chain);
        }
        (s.reduce_sum_f32s(sum), 2 * S::F32_LANES * CHAINS * ROUNDS)
    }
}

/// Speed of multiply-adds in registers on all of rayon's threads in Gflop/s, measured for about
/// `duration`. A multiply-add counts as two.
pub fn peak_multiply_add(duration: Duration) -> f64 {
    let counts = rayon::broadcast(|_| {
        let arch = pulp::Arch::new();
        let (started, mut count) = (Instant::now(), 0usize);
        loop {
            // Opaque numbers, or the compiler works the result out beforehand; it tends to 1.
            let (factor, summand) = black_box((0.5, 0.5));
            let (value, operations) = arch.dispatch(Chains { factor, summand });
            black_box(value);
            count += operations;
            let elapsed = started.elapsed();
            if elapsed >= duration {
                return count as f64 / elapsed.as_secs_f64();
            }
        }
    });
    counts.iter().sum::<f64>() * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_multiply_add_is_done_and_counted() {
        // Halving the distance to 1 each time, all chains end there.
        let (value, operations) = pulp::Arch::new().dispatch(Chains { factor: 0.5, summand: 0.5 });
        let lanes = operations / (2 * CHAINS * ROUNDS);
        assert!(matches!(lanes, 1 | 4 | 8 | 16), "{lanes} lanes");
        assert_eq!(value, (CHAINS * lanes) as f32);
    }

    #[test]
    fn the_peak_is_plausible() {
        let peak = peak_multiply_add(Duration::from_millis(5));
        assert!((0.1..1e5).contains(&peak), "{peak} GFLOP/s");
    }
}
