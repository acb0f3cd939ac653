//! adam: one optimiser step of a run of values.

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

/// Adam (Kingma and Ba, 2015, algorithm 1).
#[inline(always)]
pub(super) fn adam<const K: usize>(
    values: &mut [f32; K],
    first: &mut [f32; K],
    second: &mut [f32; K],
    gradient: [f32; K],
    rate: f32,
    bias: Bias,
) {
    let (beta1, beta2, epsilon) = ADAM;
    for k in 0..K {
        let g = gradient[k];
        first[k] = beta1 * first[k] + (1.0 - beta1) * g;
        second[k] = beta2 * second[k] + (1.0 - beta2) * g * g;
        let size = (second[k] * bias.second).sqrt() + epsilon;
        values[k] -= rate * (first[k] * bias.first) / size;
    }
}
