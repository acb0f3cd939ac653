//! adam: one optimizer step of all parameters, a block of splats at a time.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::block::BLOCK;
use super::elementary::exp;
use super::explore::ExploreBlock;
use super::lanes::Lanes;
use super::project::sigmoid;
use super::simd::dispatch;
use crate::constants::ADAM;
use crate::sh;
use crate::splats::SplatSlices;
use crate::stages::{AdamState, AdamStep, Rates, SplatGradients};

/// Gradients of a block of splats, laid out as the parameters are.
pub(super) struct BlockGradients {
    pub means: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub scales: Vec<[f32; 3]>,
    pub opacities: Vec<f32>,
    pub sh: Vec<[f32; 3]>,
}

impl BlockGradients {
    /// All zero, with `stride` coefficients per splat, or none.
    pub fn new(stride: usize) -> Self {
        Self {
            means: vec![[0.0; 3]; BLOCK],
            quats: vec![[0.0; 4]; BLOCK],
            scales: vec![[0.0; 3]; BLOCK],
            opacities: vec![0.0; BLOCK],
            sh: vec![[0.0; 3]; BLOCK * stride],
        }
    }

    /// Room for the gradients of the block's first `n` splats, all zero.
    pub fn zeroed(&mut self, n: usize) -> SplatSlices<'_> {
        let rows = self.sh.len() / BLOCK * n;
        let Self { means, quats, scales, opacities, sh } = self;
        means.fill([0.0; 3]);
        quats.fill([0.0; 4]);
        scales.fill([0.0; 3]);
        opacities.fill(0.0);
        sh.fill([0.0; 3]);
        SplatSlices {
            means: &mut means[..n],
            quats: &mut quats[..n],
            scales: &mut scales[..n],
            opacities: &mut opacities[..n],
            sh: &mut sh[..rows],
        }
    }
}

/// The same rates for every splat of a block, laid out as the parameters are.
struct BlockRates {
    means: Vec<f32>,
    quats: Vec<f32>,
    scales: Vec<f32>,
    opacities: Vec<f32>,
    sh: Vec<f32>,
}

impl BlockRates {
    fn new(rates: &Rates, stride: usize) -> Self {
        let row: Vec<f32> =
            (0..3 * stride).map(|k| if k < 3 { rates.sh0 } else { rates.sh_rest }).collect();
        Self {
            means: vec![rates.means; 3 * BLOCK],
            quats: vec![rates.quats; 4 * BLOCK],
            scales: vec![rates.scales; 3 * BLOCK],
            opacities: vec![rates.opacities; BLOCK],
            sh: row.repeat(BLOCK),
        }
    }
}

/// A step as every block of splats takes it.
pub(super) struct BlockStep {
    step: AdamStep,
    frozen: bool,
    rates: BlockRates,
    bias: [f32; 2],
    /// Gradients of the regularizers by one opacity and one scale.
    opacity_pull: f32,
    scale_pull: f32,
    /// Floats of color per splat: stored, and of the degree in use.
    stored: usize,
    used: usize,
}

impl BlockStep {
    /// For `n` splats that store SH up to `sh_degree`.
    pub fn new(step: &AdamStep, n: usize, sh_degree: u32) -> Self {
        let stride = sh::coeffs(sh_degree);
        Self {
            step: *step,
            frozen: step.is_frozen(),
            rates: BlockRates::new(&step.rates, stride),
            bias: step.bias().map(|bias| bias as f32),
            opacity_pull: step.opacity_regularizer / n as f32,
            scale_pull: step.scale_regularizer / (3 * n) as f32,
            stored: 3 * stride,
            used: 3 * sh::coeffs(step.sh_degree.min(sh_degree)),
        }
    }

    /// Adds the regularizers' gradients to a block's gradients.
    pub fn pull(&self, values: &SplatSlices<'_>, gradients: &mut BlockGradients) {
        if self.opacity_pull == 0.0 && self.scale_pull == 0.0 {
            return;
        }
        dispatch(Pull {
            log_scales: values.scales.as_flattened(),
            v_scales: gradients.scales.as_flattened_mut(),
            scale_pull: self.scale_pull,
            logits: values.opacities,
            v_opacities: &mut gradients.opacities,
            opacity_pull: self.opacity_pull,
        });
    }

    /// Moves a block of splats by its gradients, colors apart.
    pub fn apply(
        &self,
        values: &mut SplatSlices<'_>,
        [first, second]: &mut [SplatSlices<'_>; 2],
        gradients: &BlockGradients,
    ) {
        if self.frozen {
            return;
        }
        macro_rules! adam {
            ($name:ident) => {
                dispatch(Adam {
                    values: bytemuck::cast_slice_mut(values.$name),
                    first: bytemuck::cast_slice_mut(first.$name),
                    second: bytemuck::cast_slice_mut(second.$name),
                    gradient: bytemuck::cast_slice(&gradients.$name),
                    rates: &self.rates.$name,
                    bias: self.bias,
                })
            };
        }
        adam!(means);
        adam!(quats);
        adam!(scales);
        adam!(opacities);
    }

    /// Moves the colors of a block of splats by their gradients.
    fn apply_colors(
        &self,
        values: &mut SplatSlices<'_>,
        [first, second]: &mut [SplatSlices<'_>; 2],
        gradients: &BlockGradients,
    ) {
        if self.frozen {
            return;
        }
        // If all coefficients are in use, the rows are contiguous.
        let (values, row) = (values.sh.as_flattened_mut(), self.stored);
        let row = if self.used == row { values.len() } else { row };
        for start in (0..values.len()).step_by(row.max(1)) {
            let rows = start..start + if row == self.stored { self.used } else { row };
            dispatch(Adam {
                values: &mut values[rows.clone()],
                first: &mut first.sh.as_flattened_mut()[rows.clone()],
                second: &mut second.sh.as_flattened_mut()[rows.clone()],
                gradient: &gradients.sh.as_flattened()[rows.clone()],
                rates: &self.rates.sh[rows],
                bias: self.bias,
            });
        }
    }

    /// Takes the exploration's step, after Adam's, on the same block.
    pub fn explore(&self, values: &mut SplatSlices<'_>, block: &mut ExploreBlock, first_id: usize) {
        if self.step.noise > 0.0 && !self.frozen {
            block.run(values, self.step.noise, self.step.noise_seed, first_id);
        }
    }
}

/// Adam's step (Kingma and Ba, 2015, algorithm 1), not fused, so that bits agree on every machine.
#[inline(always)]
pub(super) fn step<S: Simd>(
    [value, first, second]: [Lanes<S>; 3],
    gradient: Lanes<S>,
    rate: Lanes<S>,
    [bias1, bias2]: [Lanes<S>; 2],
) -> [Lanes<S>; 3] {
    let (beta1, beta2, epsilon) = ADAM;
    let m = first * beta1 + gradient * (1.0 - beta1);
    let v = second * beta2 + gradient * (1.0 - beta2) * gradient;
    let size = (v * bias2).sqrt() + epsilon;
    [value - rate * (m * bias1) / size, m, v]
}

/// Adam on values with one rate each. All slices are at least as long as `values`.
struct Adam<'a> {
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    gradient: &'a [f32],
    rates: &'a [f32],
    bias: [f32; 2],
}

impl WithSimd for Adam<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let [bias1, bias2] = self.bias;
        let bias = [Lanes::splat(s, bias1), Lanes::splat(s, bias2)];
        let n = self.values.len();
        let arrays = [self.values, &mut self.first[..n], &mut self.second[..n]];
        let mut vectors = StateVectors::new(s, arrays);
        let (gradients, gradient) = S::as_simd_f32s(&self.gradient[..n]);
        let (rates, rate) = S::as_simd_f32s(&self.rates[..n]);
        for k in 0..vectors.whole() {
            let (gradient, rate) = (Lanes::new(s, gradients[k]), Lanes::new(s, rates[k]));
            vectors.set(k, step(vectors.get(k), gradient, rate, bias));
        }
        if vectors.has_rest() {
            let gradient = Lanes::new(s, s.partial_load_f32s(gradient));
            let rate = Lanes::new(s, s.partial_load_f32s(rate));
            vectors.set_rest(step(vectors.rest(), gradient, rate, bias));
        }
    }
}

/// Values and moments as whole vectors and a rest; reading a part of a vector is slow.
pub(super) struct StateVectors<'a, S: Simd> {
    s: S,
    whole: [&'a mut [S::f32s]; 3],
    rest: [&'a mut [f32]; 3],
}

impl<'a, S: Simd> StateVectors<'a, S> {
    /// All of one length.
    #[inline(always)]
    pub fn new(s: S, [values, first, second]: [&'a mut [f32]; 3]) -> Self {
        let (values, value) = S::as_mut_simd_f32s(values);
        let (first, m) = S::as_mut_simd_f32s(&mut first[..]);
        let (second, v) = S::as_mut_simd_f32s(&mut second[..]);
        let n = values.len();
        Self { s, whole: [values, &mut first[..n], &mut second[..n]], rest: [value, m, v] }
    }

    #[inline(always)]
    pub fn whole(&self) -> usize {
        self.whole[0].len()
    }

    #[inline(always)]
    pub fn get(&self, k: usize) -> [Lanes<S>; 3] {
        let [values, first, second] = &self.whole;
        [Lanes::new(self.s, values[k]), Lanes::new(self.s, first[k]), Lanes::new(self.s, second[k])]
    }

    #[inline(always)]
    pub fn set(&mut self, k: usize, [value, m, v]: [Lanes<S>; 3]) {
        let [values, first, second] = &mut self.whole;
        (values[k], first[k], second[k]) = (value.vector(), m.vector(), v.vector());
    }

    #[inline(always)]
    pub fn has_rest(&self) -> bool {
        !self.rest[0].is_empty()
    }

    #[inline(always)]
    pub fn rest(&self) -> [Lanes<S>; 3] {
        let (s, [value, m, v]) = (self.s, &self.rest);
        [
            Lanes::new(s, s.partial_load_f32s(value)),
            Lanes::new(s, s.partial_load_f32s(m)),
            Lanes::new(s, s.partial_load_f32s(v)),
        ]
    }

    #[inline(always)]
    pub fn set_rest(&mut self, [value, m, v]: [Lanes<S>; 3]) {
        let [to_value, to_m, to_v] = &mut self.rest;
        self.s.partial_store_f32s(to_value, value.vector());
        self.s.partial_store_f32s(to_m, m.vector());
        self.s.partial_store_f32s(to_v, v.vector());
    }
}

/// Log-scales and logits of a block with their gradients, for the regularizers.
struct Pull<'a> {
    log_scales: &'a [f32],
    v_scales: &'a mut [f32],
    scale_pull: f32,
    logits: &'a [f32],
    v_opacities: &'a mut [f32],
    opacity_pull: f32,
}

impl WithSimd for Pull<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        for at in (0..self.log_scales.len()).step_by(S::F32_LANES) {
            let scales = exp(Lanes::new(s, s.partial_load_f32s(&self.log_scales[at..])));
            let v = &mut self.v_scales[at..];
            let sum = Lanes::new(s, s.partial_load_f32s(v));
            let sum = scales.mul_add(sum.all(self.scale_pull), sum);
            s.partial_store_f32s(v, sum.vector());
        }
        for at in (0..self.logits.len()).step_by(S::F32_LANES) {
            let (_, slope) = sigmoid(Lanes::new(s, s.partial_load_f32s(&self.logits[at..])));
            let v = &mut self.v_opacities[at..];
            let sum = Lanes::new(s, s.partial_load_f32s(v));
            let sum = slope.mul_add(sum.all(self.opacity_pull), sum);
            s.partial_store_f32s(v, sum.vector());
        }
    }
}

pub(super) fn adam(state: &mut AdamState<f32>, gradients: &SplatGradients<f32>, step: &AdamStep) {
    let AdamState { splats, first, second } = state;
    let (n, degree, stride) = (splats.len(), splats.sh_degree, splats.stride());
    let plan = BlockStep::new(step, n, degree);
    (splats.blocks_mut(BLOCK), first.blocks_mut(BLOCK), second.blocks_mut(BLOCK))
        .into_par_iter()
        .enumerate()
        .for_each_init(
            || (BlockGradients::new(stride), ExploreBlock::new()),
            |(v_block, explore), (block, (mut values, first, second))| {
                let mut moments = [first, second];
                let first_id = block * BLOCK;
                let n = values.means.len();
                let rows = first_id..first_id + n;
                v_block.means[..n].copy_from_slice(&gradients.v_means[rows.clone()]);
                v_block.quats[..n].copy_from_slice(&gradients.v_quats[rows.clone()]);
                v_block.scales[..n].copy_from_slice(&gradients.v_scales[rows.clone()]);
                v_block.opacities[..n].copy_from_slice(&gradients.v_opacities[rows]);
                v_block.sh[..n * stride]
                    .copy_from_slice(&gradients.v_colors[first_id * stride..][..n * stride]);
                plan.pull(&values, v_block);
                plan.apply(&mut values, &mut moments, v_block);
                plan.apply_colors(&mut values, &mut moments, v_block);
                plan.explore(&mut values, explore, first_id);
            },
        );
}
