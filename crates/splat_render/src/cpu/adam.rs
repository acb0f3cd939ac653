//! adam: one optimiser step of a run of values.

use pulp::{Simd, WithSimd};

use crate::fit::ADAM;

/// Bias corrections of one step, shared by all parameters.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bias {
    first: f32,
    second: f32,
}

impl Bias {
    /// For step number `step`, from 1.
    pub fn new(step: u32) -> Self {
        let power = |beta: f32| 1.0 - f64::from(beta).powi(step.min(i32::MAX as u32) as i32);
        Self { first: (1.0 / power(ADAM.0)) as f32, second: (1.0 / power(ADAM.1)) as f32 }
    }
}

/// Adam (Kingma and Ba, 2015, algorithm 1) on a run of values, each with its own rate. All slices
/// have one length.
pub(super) struct Adam<'a> {
    pub values: &'a mut [f32],
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
    pub gradient: &'a [f32],
    pub rates: &'a [f32],
    pub bias: Bias,
}

impl WithSimd for Adam<'_> {
    type Output = ();

    // A plain loop: the compiler turns it into vectors of whatever `dispatch` found.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let (beta1, beta2, epsilon) = ADAM;
        let n = self.values.len();
        let (first, second) = (&mut self.first[..n], &mut self.second[..n]);
        let (gradient, rates) = (&self.gradient[..n], &self.rates[..n]);
        for k in 0..n {
            let g = gradient[k];
            let m = beta1 * first[k] + (1.0 - beta1) * g;
            let v = beta2 * second[k] + (1.0 - beta2) * g * g;
            let size = (v * self.bias.second).sqrt() + epsilon;
            self.values[k] -= rates[k] * (m * self.bias.first) / size;
            (first[k], second[k]) = (m, v);
        }
    }
}
