//! rasterize: ids to colour, alpha, depth and final transmittance, a tile at a time.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::bin::Bins;
use super::project::Splat2d;
use super::simd::exp2_negative;
use crate::constants::{ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN};

pub(super) const SIDE: usize = TILE as usize;
pub(super) const PIXELS: usize = SIDE * SIDE;

/// Splats between two looks whether a tile's pixels have all stopped.
pub(super) const STOP_INTERVAL: usize = 16;

/// sqrt(log2(e) / 2): scales a factor so that exp(-sigma) = 2^-(u^2 + v^2).
const WHITEN: f32 = 0.849_321_8;

/// A 2D splat as the inner loops read it; u and v are in units of 1 / [`WHITEN`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TileSplat {
    pub mean: [f32; 2],
    pub factor: [f32; 3],
    pub opacity: f32,
    pub color: [f32; 3],
    pub depth: f32,
    /// Reach along x and y in px, a little widened.
    pub radii: [f32; 2],
    /// u^2 + v^2 beyond which alpha < `ALPHA_MIN`, a little widened.
    pub limit: f32,
}

impl TileSplat {
    pub fn new(splat: &Splat2d) -> Self {
        Self {
            mean: splat.mean,
            factor: splat.factor.map(|f| f * WHITEN),
            opacity: splat.opacity,
            color: splat.color,
            depth: splat.depth,
            radii: splat.radii.map(|r| r * (1.0 + 1e-5) + 1e-2),
            limit: (splat.opacity / ALPHA_MIN).log2() * (1.0 + 1e-5) + 1e-5,
        }
    }

    /// Rows (`axis` 1) or columns (`axis` 0) that the splat reaches, of the tile that starts at
    /// pixel `start`.
    #[inline(always)]
    pub fn reach(&self, axis: usize, start: f32) -> std::ops::Range<usize> {
        let middle = self.mean[axis] - start - 0.5;
        let first = (middle - self.radii[axis]).ceil().clamp(0.0, SIDE as f32) as i32;
        let last = (middle + self.radii[axis]).floor().clamp(-1.0, (SIDE - 1) as f32) as i32;
        first as usize..(last + 1) as usize
    }

    /// The same in vectors of `lanes` columns.
    #[inline(always)]
    pub fn vectors(&self, left: f32, lanes: usize) -> std::ops::Range<usize> {
        let columns = self.reach(0, left);
        columns.start / lanes..columns.end.div_ceil(lanes)
    }
}

/// A picture as planes, row-major, H x W each.
#[derive(Debug, Clone, Default)]
pub(super) struct Planes {
    pub width: usize,
    pub height: usize,
    /// R, G, B, accumulated depth, final transmittance.
    pub planes: [Vec<f32>; 5],
}

impl Planes {
    pub fn resize(&mut self, width: u32, height: u32) {
        (self.width, self.height) = (width as usize, height as usize);
        for plane in &mut self.planes {
            plane.resize(self.width * self.height, 0.0);
        }
    }

    /// Bands of one row of tiles, each as five mutable slices.
    pub fn bands(&mut self) -> impl IndexedParallelIterator<Item = [&mut [f32]; 5]> {
        let band = SIDE * self.width;
        let [r, g, b, d, t] = &mut self.planes;
        r.par_chunks_mut(band)
            .zip(g.par_chunks_mut(band))
            .zip(b.par_chunks_mut(band))
            .zip(d.par_chunks_mut(band))
            .zip(t.par_chunks_mut(band))
            .map(|((((r, g), b), d), t)| [r, g, b, d, t])
    }
}

/// Per-pixel state of a tile.
#[repr(align(64))]
struct State {
    /// R, G, B, depth.
    sums: [[f32; PIXELS]; 4],
    /// Transmittance; negative once the pixel has stopped.
    t: [f32; PIXELS],
}

struct Tile<'a, const DEPTH: bool> {
    splats: &'a [TileSplat],
    ids: &'a [u32],
    left: f32,
    top: f32,
    state: &'a mut State,
}

impl<const DEPTH: bool> WithSimd for Tile<'_, DEPTH> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let per_row = SIDE / S::F32_LANES;
        let columns = pixel_columns(self.left);
        let columns = S::as_simd_f32s(&columns).0;
        let State { sums: [r, g, b, d], t } = self.state;
        let (r, g) = (S::as_mut_simd_f32s(r).0, S::as_mut_simd_f32s(g).0);
        let (b, d) = (S::as_mut_simd_f32s(b).0, S::as_mut_simd_f32s(d).0);
        let t = S::as_mut_simd_f32s(t).0;
        let zero = s.splat_f32s(0.0);

        for (k, &id) in self.ids.iter().enumerate() {
            if k % STOP_INTERVAL == STOP_INTERVAL - 1 && all_stopped(s, t) {
                break;
            }
            let splat = &self.splats[id as usize];
            let [p, q, v_scale] = splat.factor;
            let (p, opacity) = (s.splat_f32s(p), s.splat_f32s(splat.opacity));
            let mx = s.splat_f32s(splat.mean[0]);
            let limit = s.splat_f32s(splat.limit);
            let [red, green, blue] = splat.color;
            let color = [s.splat_f32s(red), s.splat_f32s(green), s.splat_f32s(blue)];
            let depth = s.splat_f32s(splat.depth);
            let vectors = splat.vectors(self.left, S::F32_LANES);
            for row in splat.reach(1, self.top) {
                let dy = self.top + row as f32 + 0.5 - splat.mean[1];
                let v = v_scale * dy;
                let (vv, shift) = (s.splat_f32s(v * v), s.splat_f32s(q * dy));
                for h in vectors.clone() {
                    let x = columns[h];
                    let at = row * per_row + h;
                    let u = s.mul_add_e_f32s(p, s.sub_f32s(x, mx), shift);
                    let distance = s.mul_add_e_f32s(u, u, vv);
                    // Known long before alpha is, so a wrong guess of the branch costs little.
                    let before = t[at];
                    let near = s.less_than_or_equal_f32s(distance, limit);
                    if !any(s, s.and_m32s(near, s.greater_than_f32s(before, zero))) {
                        continue;
                    }
                    let gaussian = exp2_negative(s, s.neg_f32s(distance));
                    let alpha = s.mul_f32s(opacity, gaussian);
                    let alpha = s.min_f32s(alpha, s.splat_f32s(ALPHA_MAX));
                    let seen = s.greater_than_or_equal_f32s(alpha, s.splat_f32s(ALPHA_MIN));
                    let after = s.mul_f32s(before, s.sub_f32s(s.splat_f32s(1.0), alpha));
                    let goes_on =
                        s.greater_than_or_equal_f32s(after, s.splat_f32s(TRANSMITTANCE_MIN));
                    let adds = s.and_m32s(seen, goes_on);
                    let stopped = s.neg_f32s(s.abs_f32s(before));
                    let rest = s.select_f32s(seen, stopped, before);
                    t[at] = s.select_f32s(adds, after, rest);
                    let weight = s.mul_f32s(before, alpha);
                    let weight = s.select_f32s(adds, weight, zero);
                    r[at] = s.mul_add_e_f32s(weight, color[0], r[at]);
                    g[at] = s.mul_add_e_f32s(weight, color[1], g[at]);
                    b[at] = s.mul_add_e_f32s(weight, color[2], b[at]);
                    if DEPTH {
                        d[at] = s.mul_add_e_f32s(weight, depth, d[at]);
                    }
                }
            }
        }
    }
}

/// Whether any lane is set.
#[inline(always)]
pub(super) fn any<S: Simd>(s: S, mask: S::m32s) -> bool {
    s.first_true_m32s(mask) < S::F32_LANES
}

/// Whether every pixel of a tile has stopped.
#[inline(always)]
pub(super) fn all_stopped<S: Simd>(s: S, t: &[S::f32s]) -> bool {
    let mut most = s.splat_f32s(-1.0);
    for &t in t {
        most = s.max_f32s(most, t);
    }
    s.reduce_max_f32s(most) < 0.0
}

/// x of the pixel centres of a tile's row.
pub(super) fn pixel_columns(left: f32) -> [f32; SIDE] {
    std::array::from_fn(|x| left + x as f32 + 0.5)
}

/// Renders every tile into `out`, which must have the picture's size; the depth plane is zero
/// without `DEPTH`, which a fit does not look at.
pub(super) fn rasterize<const DEPTH: bool>(
    splats: &[TileSplat],
    bins: &Bins,
    background: [f32; 3],
    out: &mut Planes,
) {
    let arch = pulp::Arch::new();
    let width = out.width;
    let columns = width.div_ceil(SIDE);
    out.bands().enumerate().for_each(|(tile_row, band)| {
        let rows = band[0].len() / width;
        for column in 0..columns {
            let (x, valid) = (column * SIDE, SIDE.min(width - column * SIDE));
            let mut state = State { sums: [[0.0; PIXELS]; 4], t: [1.0; PIXELS] };
            // Pixels beyond the picture start as stopped.
            for (k, t) in state.t.iter_mut().enumerate() {
                if k / SIDE >= rows || k % SIDE >= valid {
                    *t = -1.0;
                }
            }
            arch.dispatch(Tile::<DEPTH> {
                splats,
                ids: &bins.splats[bins.range(tile_row * columns + column)],
                left: (column * SIDE) as f32,
                top: (tile_row * SIDE) as f32,
                state: &mut state,
            });
            for row in 0..rows {
                for k in 0..valid {
                    let (from, to) = (row * SIDE + k, row * width + x + k);
                    let t = state.t[from].abs();
                    for c in 0..3 {
                        band[c][to] = state.sums[c][from] + t * background[c];
                    }
                    band[3][to] = state.sums[3][from];
                    band[4][to] = t;
                }
            }
        }
    });
}
