//! rasterize_backward: image gradients to per-splat 2D gradients, front to back, so that it rounds
//! and stops exactly as the forward pass did.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::bin::Bins;
use super::project_backward::V2d;
use super::rasterize::{
    PIXELS, Planes, SIDE, STOP_INTERVAL, TileSplat, all_stopped, any, pixel_columns,
};
use super::simd::exp2_negative;
use crate::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};

/// Sums over a tile's pixels for one splat: v_alpha * gaussian times (1, u, v, uu, uv, vv), then
/// the gradients of R, G and B; with depth one more for it; with absolute two more, of the absolute
/// gradients along x and y.
pub(super) type PairSums<const N: usize> = [f32; N];
/// Sums of a fit.
pub(super) const COLOR_SUMS: usize = 9;
/// Sums with depth.
pub(super) const DEPTH_SUMS: usize = 10;
/// Sums with depth and absolute gradients.
pub(super) const ABSOLUTE_SUMS: usize = 12;

/// Per-pixel state of a tile.
#[repr(align(64))]
struct State {
    /// Gradients of R, G, B and accumulated depth.
    v: [[f32; PIXELS]; 4],
    /// Transmittance; negative once the pixel has stopped.
    t: [f32; PIXELS],
    /// What lies behind the splats seen so far, dotted with the gradients.
    behind: [f32; PIXELS],
}

struct Tile<'a, const N: usize> {
    splats: &'a [TileSplat],
    ids: &'a [u32],
    left: f32,
    top: f32,
    state: &'a mut State,
    sums: &'a mut [PairSums<N>],
}

impl<const N: usize> WithSimd for Tile<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let per_row = SIDE / S::F32_LANES;
        let columns = pixel_columns(self.left);
        let columns = S::as_simd_f32s(&columns).0;
        let State { v: [v_r, v_g, v_b, v_d], t, behind } = self.state;
        let (v_r, v_g) = (S::as_simd_f32s(v_r).0, S::as_simd_f32s(v_g).0);
        let (v_b, v_d) = (S::as_simd_f32s(v_b).0, S::as_simd_f32s(v_d).0);
        let (t, behind) = (S::as_mut_simd_f32s(t).0, S::as_mut_simd_f32s(behind).0);
        let (zero, one) = (s.splat_f32s(0.0), s.splat_f32s(1.0));

        for (k, &id) in self.ids.iter().enumerate() {
            if k % STOP_INTERVAL == STOP_INTERVAL - 1 && all_stopped(s, t) {
                break;
            }
            let splat = &self.splats[id as usize];
            let [p, q, r] = splat.factor;
            let (p, opacity) = (s.splat_f32s(p), s.splat_f32s(splat.opacity));
            let mx = s.splat_f32s(splat.mean[0]);
            let limit = s.splat_f32s(splat.limit);
            let [red, green, blue] = splat.color;
            let color = [s.splat_f32s(red), s.splat_f32s(green), s.splat_f32s(blue)];
            let depth = s.splat_f32s(splat.depth);
            let mut acc = [zero; N];
            let mut touched = false;
            let vectors = splat.vectors(self.left, S::F32_LANES);
            for row in splat.reach(1, self.top) {
                let dy = self.top + row as f32 + 0.5 - splat.mean[1];
                let v = r * dy;
                let (vv, shift) = (s.splat_f32s(v * v), s.splat_f32s(q * dy));
                let (q, r, v) = (s.splat_f32s(q), s.splat_f32s(r), s.splat_f32s(v));
                for h in vectors.clone() {
                    let x = columns[h];
                    let at = row * per_row + h;
                    let u = s.mul_add_e_f32s(p, s.sub_f32s(x, mx), shift);
                    let distance = s.mul_add_e_f32s(u, u, vv);
                    let before = t[at];
                    let near = s.less_than_or_equal_f32s(distance, limit);
                    if !any(s, s.and_m32s(near, s.greater_than_f32s(before, zero))) {
                        continue;
                    }
                    let gaussian = exp2_negative(s, s.neg_f32s(distance));
                    let uncapped = s.mul_f32s(opacity, gaussian);
                    let alpha = s.min_f32s(uncapped, s.splat_f32s(ALPHA_MAX));
                    let seen = s.greater_than_or_equal_f32s(alpha, s.splat_f32s(ALPHA_MIN));
                    let through = s.sub_f32s(one, alpha);
                    let after = s.mul_f32s(before, through);
                    let goes_on =
                        s.greater_than_or_equal_f32s(after, s.splat_f32s(TRANSMITTANCE_MIN));
                    let adds = s.and_m32s(seen, goes_on);
                    let stopped = s.neg_f32s(s.abs_f32s(before));
                    t[at] = s.select_f32s(adds, after, s.select_f32s(seen, stopped, before));
                    if !any(s, adds) {
                        continue;
                    }
                    touched = true;
                    let weight = s.select_f32s(adds, s.mul_f32s(before, alpha), zero);
                    let mut own = s.mul_f32s(color[0], v_r[at]);
                    own = s.mul_add_e_f32s(color[1], v_g[at], own);
                    own = s.mul_add_e_f32s(color[2], v_b[at], own);
                    if N >= DEPTH_SUMS {
                        own = s.mul_add_e_f32s(depth, v_d[at], own);
                        acc[9] = s.mul_add_e_f32s(weight, v_d[at], acc[9]);
                    }
                    acc[6] = s.mul_add_e_f32s(weight, v_r[at], acc[6]);
                    acc[7] = s.mul_add_e_f32s(weight, v_g[at], acc[7]);
                    acc[8] = s.mul_add_e_f32s(weight, v_b[at], acc[8]);
                    let rest = s.negate_mul_add_e_f32s(weight, own, behind[at]);
                    behind[at] = rest;
                    // v_alpha * gaussian, zero where the cap holds alpha.
                    let v_alpha = s.sub_f32s(s.mul_f32s(before, own), s.div_f32s(rest, through));
                    let free = s.less_than_or_equal_f32s(uncapped, s.splat_f32s(ALPHA_MAX));
                    let free = s.and_m32s(free, adds);
                    let g = s.select_f32s(free, s.mul_f32s(v_alpha, gaussian), zero);
                    let (gu, gv) = (s.mul_f32s(g, u), s.mul_f32s(g, v));
                    acc[0] = s.add_f32s(acc[0], g);
                    acc[1] = s.add_f32s(acc[1], gu);
                    acc[2] = s.add_f32s(acc[2], gv);
                    acc[3] = s.mul_add_e_f32s(gu, u, acc[3]);
                    acc[4] = s.mul_add_e_f32s(gu, v, acc[4]);
                    acc[5] = s.mul_add_e_f32s(gv, v, acc[5]);
                    if N >= ABSOLUTE_SUMS {
                        let along_y = s.mul_add_e_f32s(q, gu, s.mul_f32s(r, gv));
                        acc[10] = s.add_f32s(acc[10], s.abs_f32s(gu));
                        acc[11] = s.add_f32s(acc[11], s.abs_f32s(along_y));
                    }
                }
            }
            if touched {
                for (sum, acc) in self.sums[k].iter_mut().zip(acc) {
                    *sum = s.reduce_sum_f32s(acc);
                }
            }
        }
    }
}

/// Fills `sums[position]` for every (tile, splat) pair of `bins`. `image` is the forward pass's
/// picture (over its background), `v_color` and `v_depth` its gradients as planes, `v_alpha` that of
/// alpha where there is one.
pub(super) fn rasterize_backward<const N: usize>(
    splats: &[TileSplat],
    bins: &Bins,
    image: &Planes,
    v_color: &[Vec<f32>; 3],
    v_alpha: Option<&[f32]>,
    v_depth: Option<&[f32]>,
    sums: &mut Vec<PairSums<N>>,
) {
    let arch = pulp::Arch::new();
    let (width, height) = (image.width, image.height);
    let columns = width.div_ceil(SIDE);
    sums.clear();
    sums.resize(bins.splats.len(), [0.0; N]);

    // One task per row of tiles, each with the part of `sums` that is its own.
    let mut bands = Vec::with_capacity(height.div_ceil(SIDE));
    let mut rest = sums.as_mut_slice();
    for tile_row in 0..height.div_ceil(SIDE) {
        let range = bins.starts[tile_row * columns]..bins.starts[(tile_row + 1) * columns];
        let (band, after) = rest.split_at_mut(range.len());
        bands.push(band);
        rest = after;
    }
    bands.into_par_iter().enumerate().for_each(|(tile_row, mut band)| {
        let rows = SIDE.min(height - tile_row * SIDE);
        for column in 0..columns {
            let range = bins.range(tile_row * columns + column);
            let (sums, after) = std::mem::take(&mut band).split_at_mut(range.len());
            band = after;
            if range.is_empty() {
                continue;
            }
            // Pixels beyond the picture start as stopped.
            let mut state =
                State { v: [[0.0; PIXELS]; 4], t: [-1.0; PIXELS], behind: [0.0; PIXELS] };
            let valid = SIDE.min(width - column * SIDE);
            for row in 0..rows {
                for k in 0..valid {
                    let (to, from) =
                        (row * SIDE + k, (tile_row * SIDE + row) * width + column * SIDE + k);
                    let t = image.planes[4][from];
                    let mut behind = v_alpha.map_or(0.0, |v| -v[from] * t);
                    for c in 0..3 {
                        state.v[c][to] = v_color[c][from];
                        behind += image.planes[c][from] * v_color[c][from];
                    }
                    if let Some(v) = v_depth {
                        state.v[3][to] = v[from];
                        behind += image.planes[3][from] * v[from];
                    }
                    state.behind[to] = behind;
                    state.t[to] = 1.0;
                }
            }
            let (ids, left) = (&bins.splats[range], (column * SIDE) as f32);
            let (top, state) = ((tile_row * SIDE) as f32, &mut state);
            arch.dispatch(Tile::<N> { splats, ids, left, top, state, sums });
        }
    });
}

/// Adds up splat `i`'s pairs in tile order and turns whitened moments into 2D gradients, with the
/// absolute gradient of the centre where `N` has it.
#[inline(always)]
pub(super) fn gather<const N: usize>(
    i: usize,
    splat: &TileSplat,
    bins: &Bins,
    sums: &[PairSums<N>],
) -> (V2d, [f32; 2]) {
    let mut total = [0.0f32; N];
    for slot in bins.slots[i] as usize..bins.slots[i + 1] as usize {
        let pair = &sums[bins.position_from_slot[slot] as usize];
        for (sum, value) in total.iter_mut().zip(pair) {
            *sum += value;
        }
    }
    // sigma = ln 2 (u^2 + v^2) in the units of `TileSplat`, so its slope along the offset is
    // 2 ln 2 F^T (u, v), and a change E of the whitened covariance changes it by
    // -ln 2 (u, v) E (u, v)^T; both times -o g, summed over pixels.
    let [g, gu, gv, guu, guv, gvv] = std::array::from_fn(|k| total[k]);
    let [p, q, r] = splat.factor;
    let two_ln2 = 2.0 * std::f32::consts::LN_2;
    let k = splat.opacity * two_ln2;
    let v = V2d {
        v_mean: [k * p * gu, k * (q * gu + r * gv)],
        v_whitened: [0.5 * k * guu, k * guv, 0.5 * k * gvv],
        v_depth: if N >= DEPTH_SUMS { total[9] } else { 0.0 },
        v_color: std::array::from_fn(|c| total[6 + c]),
        v_opacity: g,
    };
    let v_mean_absolute =
        if N >= ABSOLUTE_SUMS { [k * p * total[10], k * total[11]] } else { [0.0; 2] };
    (v, v_mean_absolute)
}
