//! rasterize: ids to color, alpha, depth and final transmittance, a tile at a time.

use std::sync::atomic::AtomicU32;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::bin::{Binned, Bins, bin};
use super::simd::dispatch;
use super::tile::{
    BATCH, Centers, PIXELS, Pixels, Reached, SIDE, TileSplat, Vectors, floats, live_vectors,
};
use crate::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::error::Result;
use crate::stages::{Image, Projected};

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
        (
            r.par_chunks_mut(band),
            g.par_chunks_mut(band),
            b.par_chunks_mut(band),
            d.par_chunks_mut(band),
            t.par_chunks_mut(band),
        )
            .into_par_iter()
            .map(|(r, g, b, d, t)| [r, g, b, d, t])
    }
}

/// A tile's rows in each plane.
type Rows<'a> = [[&'a mut [f32]; SIDE]; 5];

fn tiles(band: [&mut [f32]; 5], width: usize) -> Vec<Rows<'_>> {
    let mut tiles: Vec<Rows<'_>> = Vec::new();
    tiles.resize_with(width.div_ceil(SIDE), Rows::default);
    for (k, plane) in band.into_iter().enumerate() {
        for (row, values) in plane.chunks_mut(width).enumerate() {
            for (tile, values) in tiles.iter_mut().zip(values.chunks_mut(SIDE)) {
                tile[k][row] = values;
            }
        }
    }
    tiles
}

struct Tile<'a, const DEPTH: bool> {
    splats: &'a [TileSplat],
    ids: &'a [AtomicU32],
    left: usize,
    top: usize,
    background: [f32; 3],
    /// Rows and columns that the picture has of it.
    rows: usize,
    columns: usize,
    reached: &'a mut Reached,
    out: Rows<'a>,
}

impl<const DEPTH: bool> WithSimd for Tile<'_, DEPTH> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, s: S) {
        let mut sums = [Pixels([0.0; PIXELS]); 4];
        // Negative once the pixel has stopped.
        let mut t = Pixels::clear(self.rows, self.columns, S::F32_LANES);
        blend::<S, DEPTH>(s, &mut self, &mut sums, &mut t);
        for (t, k) in t.0.iter_mut().zip(0..) {
            *t = t.abs();
            for c in 0..3 {
                sums[c].0[k] += *t * self.background[c];
            }
        }
        for (rows, sums) in self.out.iter_mut().zip(sums.iter().chain([&t])) {
            sums.store::<S>(rows);
        }
    }
}

#[inline(always)]
fn blend<S: Simd, const DEPTH: bool>(
    s: S,
    tile: &mut Tile<'_, DEPTH>,
    [r, g, b, d]: &mut [Pixels; 4],
    t: &mut Pixels,
) {
    let (r, g) = (S::as_mut_simd_f32s(&mut r.0).0, S::as_mut_simd_f32s(&mut g.0).0);
    let (b, d) = (S::as_mut_simd_f32s(&mut b.0).0, S::as_mut_simd_f32s(&mut d.0).0);
    let t = S::as_mut_simd_f32s(&mut t.0).0;
    let (zero, one) = (s.splat_f32s(0.0), s.splat_f32s(1.0));
    let centers = Centers::new::<S>(tile.left, tile.top);
    let (reached, mut live) = (&mut *tile.reached, Vectors::default());

    for start in (0..tile.ids.len()).step_by(BATCH) {
        if !live_vectors(s, t, &mut live) {
            break;
        }
        let taken = reached.find::<S, false>(s, tile.splats, &tile.ids[start..], &centers, &live);
        let gaussians = S::as_simd_f32s(floats(&reached.gaussians)).0;
        for k in 0..reached.ends[taken - 1] {
            let at = usize::from(reached.vectors[k]);
            let splat = &reached.splats[usize::from(reached.owners[k]) % BATCH];
            let uncapped = s.mul_f32s(s.splat_f32s(splat.opacity), gaussians[k]);
            let alpha = s.min_f32s(uncapped, s.splat_f32s(ALPHA_MAX));
            let seen = s.greater_than_or_equal_f32s(alpha, s.splat_f32s(ALPHA_MIN));
            let alpha = s.select_f32s(seen, alpha, zero);
            let before = t[at];
            let after = s.mul_f32s(before, s.sub_f32s(one, alpha));
            // False for pixels that stop here or, negative, have stopped before.
            let goes_on = s.greater_than_or_equal_f32s(after, s.splat_f32s(TRANSMITTANCE_MIN));
            t[at] = s.select_f32s(goes_on, after, s.or_f32s(before, s.splat_f32s(-0.0)));
            let weight = s.select_f32s(goes_on, s.mul_f32s(before, alpha), zero);
            let [red, green, blue] = splat.color;
            r[at] = s.mul_add_e_f32s(weight, s.splat_f32s(red), r[at]);
            g[at] = s.mul_add_e_f32s(weight, s.splat_f32s(green), g[at]);
            b[at] = s.mul_add_e_f32s(weight, s.splat_f32s(blue), b[at]);
            if DEPTH {
                d[at] = s.mul_add_e_f32s(weight, s.splat_f32s(splat.depth), d[at]);
            }
        }
    }
}

/// Renders every tile into `out`, of the picture's size; the depth plane is zero without `DEPTH`.
pub(super) fn rasterize_tiles<const DEPTH: bool>(
    splats: &[TileSplat],
    bins: &Bins,
    background: [f32; 3],
    out: &mut Planes,
) {
    let width = out.width;
    let columns = width.div_ceil(SIDE);
    // One task per tile: rows of tiles are too few and too uneven for many threads.
    out.bands().enumerate().for_each(|(tile_row, band)| {
        let rows = band[0].len() / width;
        tiles(band, width).into_par_iter().enumerate().for_each(|(column, out)| {
            let first = column * SIDE;
            Reached::lend(|reached| {
                dispatch(Tile::<DEPTH> {
                    splats,
                    ids: &bins.splats[bins.range(tile_row * columns + column)],
                    left: first,
                    top: tile_row * SIDE,
                    background,
                    rows,
                    columns: SIDE.min(width - first),
                    reached,
                    out,
                });
            });
        });
    });
}

pub(super) fn rasterize(projected: &Projected<f32>, background: [f32; 3]) -> Result<Image<f32>> {
    let Binned { splats, bins } = bin(projected)?;
    let mut planes = Planes::default();
    planes.resize(projected.width, projected.height);
    rasterize_tiles::<true>(&splats, &bins, background, &mut planes);
    let [r, g, b, depth, transmittance] = planes.planes;
    Ok(Image {
        width: projected.width,
        height: projected.height,
        color: (0..r.len()).map(|pixel| [r[pixel], g[pixel], b[pixel]]).collect(),
        alpha: transmittance.iter().map(|t| 1.0 - t).collect(),
        depth,
        transmittance,
    })
}
