//! rasterize_backward: front to back, so that it rounds and stops exactly as the forward pass.

use std::sync::atomic::AtomicU32;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::bin::{Binned, Bins, bin};
use super::project_backward::V2d;
use super::rasterize::Planes;
use super::simd::dispatch;
use super::tile::{
    BATCH, Centers, PIXELS, Pixels, Place, Reached, SIDE, TileSplat, Vectors, floats, live_vectors,
};
use crate::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::error::Result;
use crate::stages::{Image, ImageGradients, Projected, ProjectedGradients};

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

/// A picture and the gradients of the loss with respect to it.
#[derive(Clone, Copy)]
pub(super) struct PictureGradients<'a> {
    /// The forward pass's picture, over its background.
    pub image: &'a Planes,
    /// Gradient of each color channel, H x W.
    pub v_color: &'a [Vec<f32>; 3],
    pub v_alpha: Option<&'a [f32]>,
    pub v_depth: Option<&'a [f32]>,
}

struct Tile<'a, const N: usize> {
    splats: &'a [TileSplat],
    ids: &'a [AtomicU32],
    left: usize,
    top: usize,
    picture: PictureGradients<'a>,
    place: Place,
    reached: &'a mut Reached,
    sums: &'a mut [PairSums<N>],
}

impl<const N: usize> WithSimd for Tile<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let zeros = Pixels([0.0; PIXELS]);
        let PictureGradients { image, v_color, v_alpha, v_depth } = self.picture;
        // Color behind the splats so far, dotted with the gradients.
        let mut behind = zeros;
        if let Some(v_alpha) = v_alpha {
            let t = self.place.load::<S>(&image.planes[4]);
            add_product(&mut behind, -1.0, &t, &self.place.load::<S>(v_alpha));
        }
        // Gradients of R, G, B and accumulated depth.
        let mut v = [zeros; 4];
        for c in 0..3 {
            v[c] = self.place.load::<S>(&v_color[c]);
            add_product(&mut behind, 1.0, &self.place.load::<S>(&image.planes[c]), &v[c]);
        }
        if let Some(v_depth) = v_depth {
            v[3] = self.place.load::<S>(v_depth);
            add_product(&mut behind, 1.0, &self.place.load::<S>(&image.planes[3]), &v[3]);
        }
        // Negative once the pixel has stopped.
        let mut t = Pixels::clear(self.place.rows, self.place.columns, S::F32_LANES);
        let [v_r, v_g, v_b, v_d] = &v;
        let (v_r, v_g) = (S::as_simd_f32s(&v_r.0).0, S::as_simd_f32s(&v_g.0).0);
        let (v_b, v_d) = (S::as_simd_f32s(&v_b.0).0, S::as_simd_f32s(&v_d.0).0);
        let t = S::as_mut_simd_f32s(&mut t.0).0;
        let behind = S::as_mut_simd_f32s(&mut behind.0).0;
        let (zero, one) = (s.splat_f32s(0.0), s.splat_f32s(1.0));
        let centers = Centers::new::<S>(self.left, self.top);
        let (reached, mut live) = (self.reached, Vectors::default());

        for start in (0..self.ids.len()).step_by(BATCH) {
            if !live_vectors(s, t, &mut live) {
                self.sums[start..].fill([0.0; N]);
                break;
            }
            let taken =
                reached.find::<S, true>(s, self.splats, &self.ids[start..], &centers, &live);
            let gaussians = S::as_simd_f32s(floats(&reached.gaussians)).0;
            let us = S::as_simd_f32s(floats(&reached.u)).0;
            let vs = S::as_simd_f32s(floats(&reached.v)).0;
            let mut next = 0;
            for (i, sums) in self.sums[start..][..taken].iter_mut().enumerate() {
                let splat = &reached.splats[i];
                let opacity = s.splat_f32s(splat.opacity);
                let [red, green, blue] = splat.color;
                let color = [s.splat_f32s(red), s.splat_f32s(green), s.splat_f32s(blue)];
                let depth = s.splat_f32s(splat.depth);
                let mut acc = [zero; N];
                let first = std::mem::replace(&mut next, reached.ends[i]);
                if first == next {
                    *sums = [0.0; N];
                    continue;
                }
                for k in first..next {
                    let at = usize::from(reached.vectors[k]);
                    let (gaussian, u, v) = (gaussians[k], us[k], vs[k]);
                    let uncapped = s.mul_f32s(opacity, gaussian);
                    let alpha = s.min_f32s(uncapped, s.splat_f32s(ALPHA_MAX));
                    let seen = s.greater_than_or_equal_f32s(alpha, s.splat_f32s(ALPHA_MIN));
                    let alpha = s.select_f32s(seen, alpha, zero);
                    let before = t[at];
                    let through = s.sub_f32s(one, alpha);
                    let after = s.mul_f32s(before, through);
                    let goes_on =
                        s.greater_than_or_equal_f32s(after, s.splat_f32s(TRANSMITTANCE_MIN));
                    t[at] = s.select_f32s(goes_on, after, s.or_f32s(before, s.splat_f32s(-0.0)));
                    let weight = s.select_f32s(goes_on, s.mul_f32s(before, alpha), zero);
                    let mut own = s.mul_f32s(color[0], v_r[at]);
                    own = s.mul_add_e_f32s(color[1], v_g[at], own);
                    own = s.mul_add_e_f32s(color[2], v_b[at], own);
                    acc[6] = s.mul_add_e_f32s(weight, v_r[at], acc[6]);
                    acc[7] = s.mul_add_e_f32s(weight, v_g[at], acc[7]);
                    acc[8] = s.mul_add_e_f32s(weight, v_b[at], acc[8]);
                    if N >= DEPTH_SUMS {
                        own = s.mul_add_e_f32s(depth, v_d[at], own);
                        acc[9] = s.mul_add_e_f32s(weight, v_d[at], acc[9]);
                    }
                    let rest = s.negate_mul_add_e_f32s(weight, own, behind[at]);
                    behind[at] = rest;
                    // v_alpha * gaussian, zero if the cap holds alpha or nothing is added.
                    let inverse = s.div_f32s(one, through);
                    let v_alpha = s.negate_mul_add_e_f32s(rest, inverse, s.mul_f32s(before, own));
                    let free = s.less_than_or_equal_f32s(uncapped, s.splat_f32s(ALPHA_MAX));
                    let free = s.and_m32s(free, s.and_m32s(seen, goes_on));
                    let g = s.select_f32s(free, s.mul_f32s(v_alpha, gaussian), zero);
                    let gu = s.mul_f32s(g, u);
                    let gv = s.mul_f32s(g, v);
                    acc[0] = s.add_f32s(acc[0], g);
                    acc[1] = s.add_f32s(acc[1], gu);
                    acc[2] = s.add_f32s(acc[2], gv);
                    acc[3] = s.mul_add_e_f32s(gu, u, acc[3]);
                    acc[4] = s.mul_add_e_f32s(gu, v, acc[4]);
                    acc[5] = s.mul_add_e_f32s(gv, v, acc[5]);
                    if N >= ABSOLUTE_SUMS {
                        let [_, q, r] = splat.factor;
                        let along_y = s.mul_f32s(s.splat_f32s(r), gv);
                        let along_y = s.mul_add_e_f32s(s.splat_f32s(q), gu, along_y);
                        acc[10] = s.add_f32s(acc[10], s.abs_f32s(gu));
                        acc[11] = s.add_f32s(acc[11], s.abs_f32s(along_y));
                    }
                }
                for k in 0..N {
                    sums[k] = s.reduce_sum_f32s(acc[k]);
                }
            }
        }
    }
}

/// `sum += sign a b`, pixel by pixel.
#[inline(always)]
fn add_product(sum: &mut Pixels, sign: f32, a: &Pixels, b: &Pixels) {
    for k in 0..PIXELS {
        sum.0[k] += sign * a.0[k] * b.0[k];
    }
}

/// Fills `sums[position]` for every (tile, splat) pair of `bins`.
pub(super) fn rasterize_backward_tiles<const N: usize>(
    splats: &[TileSplat],
    bins: &Bins,
    picture: PictureGradients<'_>,
    sums: &mut Vec<PairSums<N>>,
) {
    let (width, height) = (picture.image.width, picture.image.height);
    let columns = width.div_ceil(SIDE);
    sums.resize(bins.splats.len(), [0.0; N]);

    // One task per tile: rows of tiles are too few and too uneven for many threads.
    let mut tiles = Vec::with_capacity(bins.starts.len());
    let mut rest = sums.as_mut_slice();
    for tile in 0..bins.starts.len() - 1 {
        let (sums, after) = rest.split_at_mut(bins.range(tile).len());
        rest = after;
        if !sums.is_empty() {
            tiles.push((tile, sums));
        }
    }
    tiles.into_par_iter().for_each(|(tile, sums)| {
        let (x, y) = (tile % columns * SIDE, tile / columns * SIDE);
        let (rows, columns) = (SIDE.min(height - y), SIDE.min(width - x));
        Reached::lend(|reached| {
            dispatch(Tile::<N> {
                splats,
                ids: &bins.splats[bins.range(tile)],
                left: x,
                top: y,
                picture,
                place: Place { first: y * width + x, width, rows, columns },
                reached,
                sums,
            });
        });
    });
}

/// Sums a splat's pairs and converts whitened moments to 2D gradients (see `N`).
#[inline(always)]
pub(super) fn gather<const N: usize>(
    splat: &TileSplat,
    sums: &[PairSums<N>],
    positions: impl Iterator<Item = usize>,
) -> (V2d, [f32; 2]) {
    let mut total = [0.0f32; N];
    for position in positions {
        for (sum, value) in total.iter_mut().zip(&sums[position]) {
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

/// Gradients of all 2D splats, with the centers' absolute gradients if `N` includes them.
fn gradients<const N: usize>(
    Binned { splats, bins }: &Binned,
    picture: PictureGradients<'_>,
) -> Vec<(V2d, [f32; 2])> {
    let mut sums: Vec<PairSums<N>> = Vec::new();
    rasterize_backward_tiles(splats, bins, picture, &mut sums);
    (splats.par_iter().enumerate())
        .map(|(i, splat)| gather(splat, &sums, bins.positions_of(i..i + 1)))
        .collect()
}

pub(super) fn rasterize_backward(
    projected: &Projected<f32>,
    image: &Image<f32>,
    v_image: &ImageGradients<f32>,
    absolute: bool,
) -> Result<ProjectedGradients<f32>> {
    let binned = bin(projected)?;
    let channel = |rows: &[[f32; 3]], c: usize| rows.iter().map(|p| p[c]).collect::<Vec<_>>();
    let planes = Planes {
        width: image.width as usize,
        height: image.height as usize,
        planes: [
            channel(&image.color, 0),
            channel(&image.color, 1),
            channel(&image.color, 2),
            image.depth.clone(),
            image.transmittance.clone(),
        ],
    };
    let v_color: [Vec<f32>; 3] = std::array::from_fn(|c| channel(&v_image.v_color, c));
    let picture = PictureGradients {
        image: &planes,
        v_color: &v_color,
        v_alpha: Some(&v_image.v_alpha),
        v_depth: Some(&v_image.v_depth),
    };
    let list = if absolute {
        gradients::<ABSOLUTE_SUMS>(&binned, picture)
    } else {
        gradients::<DEPTH_SUMS>(&binned, picture)
    };
    let mut v_background = [0.0f64; 3];
    for (t, v) in image.transmittance.iter().zip(&v_image.v_color) {
        for (sum, v) in v_background.iter_mut().zip(v) {
            *sum += f64::from(*t) * f64::from(*v);
        }
    }
    let v_factors = list.iter().zip(&projected.factors).map(|((v, _), &f)| v.v_factor(f));
    Ok(ProjectedGradients {
        v_means2d: list.iter().map(|(v, _)| v.v_mean).collect(),
        v_factors: v_factors.collect(),
        v_depths: list.iter().map(|(v, _)| v.v_depth).collect(),
        v_colors: list.iter().map(|(v, _)| v.v_color).collect(),
        v_opacities: list.iter().map(|(v, _)| v.v_opacity).collect(),
        v_background: v_background.map(|v| v as f32),
        v_means2d_absolute: absolute
            .then(|| list.iter().map(|&(_, v_absolute)| v_absolute).collect()),
    })
}
