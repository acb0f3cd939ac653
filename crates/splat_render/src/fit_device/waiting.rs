//! Delayed color updates. A splat that is not in a step's photo has no color gradient, so its update
//! depends only on the step's rates. It is done when the splat is next seen or when all colors are read,
//! by the same operations in the same order.

use crate::stages::AdamStep;

/// Maximum number of steps that colors wait. It bounds the steps that a kernel does at once.
pub const COLOR_WAIT: usize = 128;

/// A step's effect on all colors, apart from gradients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ColorStep {
    /// Rates of the first coefficient and the rest.
    pub sh0: f32,
    pub sh_rest: f32,
    /// Bias corrections of the first and the second moment.
    pub bias: [f32; 2],
}

impl ColorStep {
    pub fn new(step: &AdamStep) -> Self {
        let bias = step.bias().map(|bias| bias as f32);
        Self { sh0: step.rates.sh0, sh_rest: step.rates.sh_rest, bias }
    }
}

/// The steps since all colors were last up to date.
#[derive(Debug, Clone)]
pub(crate) struct WaitingSteps {
    steps: Vec<ColorStep>,
    /// The SH degree that all of them use.
    degree: u32,
    most: usize,
}

impl Default for WaitingSteps {
    fn default() -> Self {
        Self::at_most(COLOR_WAIT)
    }
}

impl WaitingSteps {
    /// A list of at most `most` steps, clamped to 1..=[`COLOR_WAIT`].
    pub fn at_most(most: usize) -> Self {
        Self { steps: Vec::new(), degree: 0, most: most.clamp(1, COLOR_WAIT) }
    }

    /// Whether all colors must be brought up to date before `step`.
    pub fn must_end_before(&self, step: &AdamStep) -> bool {
        let others = step.is_frozen() || step.sh_degree != self.degree;
        !self.steps.is_empty() && (others || self.steps.len() == self.most)
    }

    /// Adds a step that has been done, unless nothing moves in it.
    pub fn add(&mut self, step: &AdamStep) {
        if !step.is_frozen() {
            self.degree = step.sh_degree;
            self.steps.push(ColorStep::new(step));
        }
    }

    /// All colors are up to date.
    pub fn clear(&mut self) {
        self.steps.clear();
    }

    /// The SH degree that all of them use.
    pub fn degree(&self) -> u32 {
        self.degree
    }

    pub fn get(&self) -> &[ColorStep] {
        &self.steps
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::Rates;

    /// Rates and corrections match Adam's (Kingma and Ba 2015, algorithm 1) at the step's number.
    #[test]
    fn a_step_keeps_its_own_rates_and_corrections() {
        let rates = Rates { sh0: 0.25, sh_rest: 0.0125, ..Rates::ZERO };
        for number in [1u32, 2, 10, 1000] {
            let step = AdamStep {
                number,
                rates,
                sh_degree: 2,
                opacity_regularizer: 0.0,
                scale_regularizer: 0.0,
                noise: 0.0,
                noise_seed: 0,
            };
            let kept = ColorStep::new(&step);
            assert_eq!((kept.sh0, kept.sh_rest), (0.25, 0.0125));
            for (bias, beta) in kept.bias.into_iter().zip([0.9f64, 0.999]) {
                let expected = 1.0 / (1.0 - beta.powi(number as i32));
                let relative = (f64::from(bias) / expected - 1.0).abs();
                assert!(relative < 1e-4, "{bias} {expected} at {number}");
            }
        }
    }
}
