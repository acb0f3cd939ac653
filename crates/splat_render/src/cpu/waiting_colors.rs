//! Colors that wait: a step keeps a splat's color gradient, and all waiting steps are done in one go when
//! the splat is next projected (see `fit_device::waiting`). This saves memory traffic for unseen splats.

use pulp::{Simd, WithSimd};

use super::adam::{self, StateVectors};
use super::block::{BLOCK, Ids, Row, get3, vectors};
use super::lanes::Lanes;
use super::project_backward::ColorGradient;
use super::simd::dispatch;
use crate::constants::SH_COEFFS_MAX;
use crate::fit_device::ColorStep;
use crate::sh;

/// How far a splat's colors are.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct WaitingColor {
    /// The first of the steps that they wait for.
    next: u16,
    /// Whether that step has a gradient.
    has_gradient: bool,
    gradient: ColorGradient,
}

impl WaitingColor {
    /// Takes the gradient of the step at hand; the colors are up to date but for it.
    pub fn add(&mut self, gradient: ColorGradient) {
        (self.has_gradient, self.gradient) = (true, gradient);
    }
}

/// The steps that colors wait for, as every block of splats takes them.
pub(super) struct ColorPlan<'a> {
    steps: &'a [ColorStep],
    degree: u32,
    /// Floats of color per splat: stored, and of the degree in use.
    stored: usize,
    used: usize,
    /// 1 for each float of a block that has the first coefficient's rate.
    is_first: Vec<f32>,
}

impl<'a> ColorPlan<'a> {
    /// For splats that store SH up to `stored` and use it up to `degree`.
    pub fn new(steps: &'a [ColorStep], stored: u32, degree: u32) -> Self {
        let degree = degree.min(stored);
        let [stored, used] = [stored, degree].map(|degree| 3 * sh::coeffs(degree));
        let is_first: Vec<f32> = (0..stored).map(|k| f32::from(u8::from(k < 3))).collect();
        Self { steps, degree, stored, used, is_first: is_first.repeat(BLOCK) }
    }
}

/// Room for one block of splats.
#[derive(Debug)]
pub(super) struct ColorBlock {
    /// The splats that wait; later arrays are in this order.
    ids: Ids,
    v_colors: [Row; 3],
    directions: [Row; 3],
    basis: [Row; SH_COEFFS_MAX],
    /// Gradients of the coefficients, in the parameters' layout.
    gradients: Vec<f32>,
}

impl ColorBlock {
    pub fn new(plan: &ColorPlan<'_>) -> Box<Self> {
        Box::new(Self {
            ids: Ids::NONE,
            v_colors: [Row::ZERO; 3],
            directions: [Row::ZERO; 3],
            basis: [Row::ZERO; SH_COEFFS_MAX],
            gradients: vec![0.0; BLOCK * plan.stored],
        })
    }

    /// Does all waiting steps of the splats `ids`; `arrays` are colors, first and second moments.
    pub fn run(
        &mut self,
        plan: &ColorPlan<'_>,
        ids: Ids,
        waiting: &mut [WaitingColor],
        arrays: [&mut [[f32; 3]]; 3],
    ) {
        if plan.steps.is_empty() {
            return;
        }
        let arrays = arrays.map(|array| array.as_flattened_mut());
        self.ids.clear();
        for &id in ids.get() {
            let k = usize::from(id);
            let one = &waiting[k];
            let rests = |moments: &[f32]| {
                moments[k * plan.stored..][..plan.used].iter().all(|v| v.to_bits() == 0)
            };
            // Without a gradient, moments that are zero stay it, and move nothing.
            let waits = usize::from(one.next) < plan.steps.len()
                && (one.has_gradient || !(rests(arrays[1]) && rests(arrays[2])));
            self.ids.push_if(k, waits);
        }
        dispatch(CatchUp { block: self, plan, waiting, arrays });
        for &k in ids.get() {
            let one = &mut waiting[usize::from(k)];
            (one.next, one.has_gradient) = (plan.steps.len() as u16, false);
        }
    }

    /// Gradients of the coefficients of waiting splats; zeros for splats without a gradient.
    #[inline(always)]
    fn expand<S: Simd>(&mut self, s: S, plan: &ColorPlan<'_>, waiting: &[WaitingColor]) {
        let ids = self.ids;
        for (at, &k) in (0..BLOCK).zip(ids.get()) {
            let ColorGradient { v_color, direction } = waiting[usize::from(k)].gradient;
            for c in 0..3 {
                self.v_colors[c].0[at] = v_color[c];
                self.directions[c].0[at] = direction[c];
            }
        }
        for at in 0..vectors::<S>(ids.get().len()) {
            let direction = get3(&self.directions, s, at);
            let basis = sh::basis(plan.degree, [direction.x, direction.y, direction.z]);
            for k in 0..sh::coeffs(plan.degree) {
                self.basis[k].set(at, basis[k]);
            }
        }
        let rows = self.gradients.chunks_exact_mut(plan.stored);
        for ((at, &k), row) in (0..BLOCK).zip(ids.get()).zip(rows) {
            if !waiting[usize::from(k)].has_gradient {
                row.fill(0.0);
                continue;
            }
            let [red, green, blue] = &self.v_colors;
            let color = [red.0[at], green.0[at], blue.0[at]];
            for (v, basis) in row[..plan.used].chunks_exact_mut(3).zip(&self.basis) {
                let basis = basis.0[at];
                for c in 0..3 {
                    v[c] = basis * color[c];
                }
            }
        }
    }
}

struct CatchUp<'a, 'b> {
    block: &'a mut ColorBlock,
    plan: &'a ColorPlan<'b>,
    waiting: &'a [WaitingColor],
    arrays: [&'a mut [f32]; 3],
}

impl WithSimd for CatchUp<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { block, plan, waiting, arrays: [values, first, second] } = self;
        block.expand(s, plan, waiting);
        let ids = block.ids;
        let ids = ids.get();
        let mut at = 0;
        while at < ids.len() {
            // Neighbors that wait for the same steps are updated together if all coefficients are in use.
            let (id, next) = (usize::from(ids[at]), waiting[usize::from(ids[at])].next);
            let mut count = 1;
            while plan.used == plan.stored
                && at + count < ids.len()
                && usize::from(ids[at + count]) == id + count
                && waiting[id + count].next == next
            {
                count += 1;
            }
            let floats = (count - 1) * plan.stored + plan.used;
            let rows = id * plan.stored..id * plan.stored + floats;
            steps(
                s,
                &plan.steps[usize::from(next)..],
                [&mut values[rows.clone()], &mut first[rows.clone()], &mut second[rows]],
                &block.gradients[at * plan.stored..][..floats],
                &plan.is_first[..floats],
            );
            at += count;
        }
    }
}

/// Runs Adam's steps on values and their moments: the first with a gradient, the rest without.
#[inline(always)]
fn steps<S: Simd>(
    s: S,
    steps: &[ColorStep],
    arrays: [&mut [f32]; 3],
    gradients: &[f32],
    is_first: &[f32],
) {
    let mut vectors = StateVectors::new(s, arrays);
    let (gradients, gradient) = S::as_simd_f32s(gradients);
    let (are_first, is_first) = S::as_simd_f32s(is_first);
    for k in 0..vectors.whole() {
        let (gradient, is_first) = (Lanes::new(s, gradients[k]), Lanes::new(s, are_first[k]));
        vectors.set(k, after(steps, vectors.get(k), gradient, is_first));
    }
    if vectors.has_rest() {
        let gradient = Lanes::new(s, s.partial_load_f32s(gradient));
        let is_first = Lanes::new(s, s.partial_load_f32s(is_first));
        vectors.set_rest(after(steps, vectors.rest(), gradient, is_first));
    }
}

#[inline(always)]
fn after<S: Simd>(
    steps: &[ColorStep],
    mut state: [Lanes<S>; 3],
    mut gradient: Lanes<S>,
    is_first: Lanes<S>,
) -> [Lanes<S>; 3] {
    let zero = gradient.all(0.0);
    let is_first = is_first.gt(zero);
    for step in steps {
        let rate = is_first.select(zero.all(step.sh0), zero.all(step.sh_rest));
        let [bias1, bias2] = step.bias;
        state = adam::step(state, gradient, rate, [zero.all(bias1), zero.all(bias2)]);
        gradient = zero;
    }
    state
}
