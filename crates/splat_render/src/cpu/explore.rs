//! 3DGS-MCMC's exploration: nearly transparent splats take a random step shaped by their covariance
//! (Kheradmand et al. 2024, eq. 8). A block of splats at a time, one splat per lane.

use pulp::{Simd, WithSimd};

use super::block::{BLOCK, Ids, Row, SplatRows, get3, set3, vectors};
use super::elementary::{exp, ln, sin_cos};
use super::lanes::{Lanes, Mat3s, Vec3s, normalized};
use super::project::sigmoid;
use super::simd::dispatch;
use crate::constants::QUAT_NORM2_MIN;
use crate::fit_device::noise_draw;
use crate::splats::SplatSlices;

/// Under this gate the step is under 1e-7 of the splat's size times the rate.
const GATE_MIN: f32 = 1e-7;

/// The step's room for one block of splats.
#[derive(Debug)]
pub(super) struct ExploreBlock {
    /// The gates of all splats of the block.
    all_gates: Row,
    /// The splats that move; later arrays are in this order.
    ids: Ids,
    splats: SplatRows,
    gates: Row,
    draws: [Row; 4],
    moved: [Row; 3],
}

impl ExploreBlock {
    pub fn new() -> Box<Self> {
        Box::new(Self {
            all_gates: Row::ZERO,
            ids: Ids::NONE,
            splats: SplatRows::ZERO,
            gates: Row::ZERO,
            draws: [Row::ZERO; 4],
            moved: [Row::ZERO; 3],
        })
    }

    /// Moves the centers of a block of raw splats, the first of them splat `first_id` of the scene.
    pub fn run(&mut self, splats: &mut SplatSlices<'_>, noise: f32, seed: u32, first_id: usize) {
        dispatch(Explore { block: self, splats, noise, seed, first_id });
    }
}

struct Explore<'a, 'b> {
    block: &'a mut ExploreBlock,
    splats: &'a mut SplatSlices<'b>,
    noise: f32,
    seed: u32,
    first_id: usize,
}

impl WithSimd for Explore<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { block, splats, noise, seed, first_id } = self;
        let n = splats.opacities.len();
        for at in 0..vectors::<S>(n) {
            let logits = s.partial_load_f32s(&splats.opacities[at * S::F32_LANES..]);
            let (opacity, _) = sigmoid(Lanes::new(s, logits));
            block.all_gates.set(at, (exp((opacity + -0.005) * 100.0) + 1.0).recip());
        }
        block.ids.clear();
        for k in 0..n {
            block.ids.push_if(k, block.all_gates.0[k] >= GATE_MIN);
        }
        let ids = block.ids.get();
        block.splats.take(&splats.params(0, splats.sh.len() / n), 0, ids);
        for (at, &k) in (0..BLOCK).zip(ids) {
            let k = usize::from(k);
            let draw = noise_draw(seed, (first_id + k) as u32);
            for (row, value) in block.draws.iter_mut().zip(draw) {
                row.0[at] = value;
            }
            block.gates.0[at] = block.all_gates.0[k];
        }
        for at in 0..vectors::<S>(ids.len()) {
            let [d0, d1, d2, d3] = &block.draws;
            let z = normal([d0.get(s, at), d1.get(s, at), d2.get(s, at), d3.get(s, at)]);
            let mean = get3(&block.splats.means, s, at);
            let (norm2, _, quat) = normalized(block.splats.quat(s, at));
            let axes = Mat3s::from_quat(quat);
            let scales = get3(&block.splats.scales, s, at);
            let scales = Vec3s::new(exp(scales.x), exp(scales.y), exp(scales.z));
            let along = scales * scales * axes.transpose_mul(z);
            let moved = (axes * along).mul_add(block.gates.get(s, at) * noise, mean);
            // A quaternion that names no rotation has no covariance.
            let moves = norm2.ge(norm2.all(QUAT_NORM2_MIN)) & moved.is_finite();
            let moved = Vec3s::new(
                moves.select(moved.x, mean.x),
                moves.select(moved.y, mean.y),
                moves.select(moved.z, mean.z),
            );
            set3(&mut block.moved, at, moved);
        }
        for (at, &k) in (0..BLOCK).zip(ids) {
            let [x, y, z] = &block.moved;
            splats.means[usize::from(k)] = [x.0[at], y.0[at], z.0[at]];
        }
    }
}

/// [`crate::fit_device::noise_normal`] of a draw, one splat per lane.
#[inline(always)]
fn normal<S: Simd>([d0, d1, d2, d3]: [Lanes<S>; 4]) -> Vec3s<S> {
    let (r0, r1) = ((ln(d0) * -2.0).sqrt(), (ln(d2) * -2.0).sqrt());
    let (sin0, cos0) = sin_cos(d1 * std::f32::consts::TAU);
    let (_, cos1) = sin_cos(d3 * std::f32::consts::TAU);
    Vec3s::new(r0 * cos0, r0 * sin0, r1 * cos1)
}
