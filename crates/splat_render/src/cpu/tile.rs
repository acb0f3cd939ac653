//! A tile in the inner loops of rasterize and rasterize_backward: the memory layout of its pixels, the
//! data of its splats, and the vectors of pixels that a splat reaches.

use std::cell::RefCell;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use bytemuck::{Pod, Zeroable};
use pulp::Simd;

use super::project::Splat2d;
use super::simd::{exp2_of_minus, prefetch};
use crate::constants::TILE;

pub(super) const SIDE: usize = TILE as usize;
pub(super) const PIXELS: usize = SIDE * SIDE;

/// Splats per batch; after each batch, stopped vectors are dropped.
pub(super) const BATCH: usize = 16;

/// sqrt(log2(e) / 2): scales a factor so that exp(-sigma) = 2^-(u^2 + v^2).
const WHITEN: f32 = 0.849_321_8;

/// One value per pixel of a tile, as blocks of pixels that are nearly square: a splat reaches fewer of
/// them than of rows. Blocks, and pixels in a block, lie row-major.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Pixels(pub [f32; PIXELS]);

/// Pixels along the side of a block, which is a vector: 4 x 4, 4 x 2, 4 x 1 or 1 x 1.
#[inline(always)]
const fn block_width(lanes: usize) -> usize {
    if lanes < 4 { 1 } else { 4 }
}

#[inline(always)]
const fn block_height(lanes: usize) -> usize {
    lanes / block_width(lanes)
}

#[inline(always)]
const fn blocks_across(lanes: usize) -> usize {
    SIDE / block_width(lanes)
}

/// Position of a tile in a row-major plane.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    /// Index of its first pixel.
    pub first: usize,
    /// Pixels from one row to the next.
    pub width: usize,
    /// Rows and columns of the tile that the picture has.
    pub rows: usize,
    pub columns: usize,
}

impl Place {
    /// The plane's values; zero beyond the picture.
    #[inline(always)]
    pub fn load<S: Simd>(&self, plane: &[f32]) -> Pixels {
        let mut pixels = Pixels([0.0; PIXELS]);
        let width = block_width(S::F32_LANES);
        for row in 0..self.rows {
            let plane = &plane[self.first + row * self.width..][..self.columns];
            if let Some(plane) = plane.first_chunk::<SIDE>() {
                for column in (0..SIDE).step_by(width) {
                    let at = offset(row, column, S::F32_LANES);
                    pixels.0[at..at + width].copy_from_slice(&plane[column..column + width]);
                }
            } else {
                for (column, value) in plane.iter().enumerate() {
                    pixels.0[offset(row, column, S::F32_LANES)] = *value;
                }
            }
        }
        pixels
    }
}

impl Pixels {
    /// Initial transmittance: 1, and negative (stopped) outside the picture.
    #[inline(always)]
    pub fn clear(rows: usize, columns: usize, lanes: usize) -> Self {
        let mut pixels = Self([1.0; PIXELS]);
        for row in 0..SIDE {
            let columns = if row < rows { columns } else { 0 };
            for column in columns..SIDE {
                pixels.0[offset(row, column, lanes)] = -1.0;
            }
        }
        pixels
    }

    /// Writes the values within the picture to its rows; those beyond it are empty.
    #[inline(always)]
    pub fn store<S: Simd>(&self, rows: &mut [&mut [f32]; SIDE]) {
        let width = block_width(S::F32_LANES);
        for (row, out) in rows.iter_mut().enumerate() {
            if let Some(out) = out.first_chunk_mut::<SIDE>() {
                for column in (0..SIDE).step_by(width) {
                    let at = offset(row, column, S::F32_LANES);
                    out[column..column + width].copy_from_slice(&self.0[at..at + width]);
                }
            } else {
                for (column, value) in out.iter_mut().enumerate() {
                    *value = self.0[offset(row, column, S::F32_LANES)];
                }
            }
        }
    }
}

/// Index of a tile's pixel in [`Pixels`].
#[inline(always)]
fn offset(row: usize, column: usize, lanes: usize) -> usize {
    let (width, height) = (block_width(lanes), block_height(lanes));
    let block = row / height * blocks_across(lanes) + column / width;
    block * lanes + row % height * width + column % width
}

/// Pixel centers of a tile.
#[repr(align(64))]
pub(super) struct Centers {
    /// x of the pixel centers of each block of a row of blocks.
    x: [f32; 4 * WIDEST],
    /// y of the pixel centers of each block of a column of blocks.
    y: [f32; 4 * WIDEST],
    /// y of the rows' pixel centers.
    rows: [f32; SIDE],
    /// For each block of the top row, the bits in [`Vectors`] of the blocks below it.
    bits: [u32; 4 * WIDEST],
    /// x of the first pixel center.
    left: f32,
}

/// Lanes of the widest vectors.
const WIDEST: usize = 16;

impl Centers {
    /// Of the tile whose first pixel is at (`left`, `top`).
    #[inline(always)]
    pub fn new<S: Simd>(left: usize, top: usize) -> Self {
        let lanes = S::F32_LANES;
        let (width, height, across) =
            (block_width(lanes), block_height(lanes), blocks_across(lanes));
        let (left, top) = (left as f32 + 0.5, top as f32 + 0.5);
        let mut centers = Self {
            x: [0.0; 4 * WIDEST],
            y: [0.0; 4 * WIDEST],
            rows: [0.0; SIDE],
            bits: [0; 4 * WIDEST],
            left,
        };
        for k in 0..across * lanes {
            let (block, lane) = (k / lanes, k % lanes);
            centers.x[k] = left + (block * width + lane % width) as f32;
            centers.bits[k] = 1 << (lane / height * across + block);
        }
        for k in 0..SIDE / height * lanes {
            let (block, lane) = (k / lanes, k % lanes);
            centers.y[k] = top + (block * height + lane / width) as f32;
        }
        for k in 0..SIDE {
            centers.rows[k] = top + k as f32;
        }
        centers
    }
}

/// A 2D splat as the inner loops read it; u and v are in units of 1 / [`WHITEN`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TileSplat {
    pub mean: [f32; 2],
    pub factor: [f32; 3],
    pub opacity: f32,
    pub color: [f32; 3],
    pub depth: f32,
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
            limit: splat.reach * (WHITEN * WHITEN) * (1.0 + 1e-5) + 1e-5,
        }
    }
}

/// One bit per vector of a tile, in the order of [`Pixels`]; one word for at least four lanes.
pub(super) type Vectors = [u64; PIXELS / 64];

/// Pixels of a tile that a batch of splats may reach: the first half of both rasterize stages, in short
/// loops over the batch, since it does not depend on the pixels' state.
pub(super) struct Reached {
    /// Copies of the splats, fetched together because they are scattered in memory.
    pub splats: [TileSplat; BATCH],
    /// Each splat's end in the arrays of vectors.
    pub ends: [usize; BATCH],
    /// Numbers of the vectors that splats may reach and whose pixels have not all stopped.
    pub vectors: [u8; BATCH * PIXELS],
    /// The splat of each.
    pub owners: [u8; BATCH * PIXELS],
    /// exp(-sigma) there.
    pub gaussians: [Pixels; BATCH],
    /// u and v there, if asked for.
    pub u: [Pixels; BATCH],
    pub v: [Pixels; BATCH],
}

thread_local! {
    static REACHED: RefCell<Box<Reached>> = RefCell::new(Reached::new());
}

impl Reached {
    /// Lends a task its thread's.
    pub fn lend<T>(task: impl FnOnce(&mut Self) -> T) -> T {
        REACHED.with_borrow_mut(|reached| task(reached))
    }

    fn new() -> Box<Self> {
        Box::new(Self {
            splats: [TileSplat::default(); BATCH],
            ends: [0; BATCH],
            vectors: [0; BATCH * PIXELS],
            owners: [0; BATCH * PIXELS],
            gaussians: [Pixels([0.0; PIXELS]); BATCH],
            u: [Pixels([0.0; PIXELS]); BATCH],
            v: [Pixels([0.0; PIXELS]); BATCH],
        })
    }

    /// Finds the vectors of the next splats within `live`; returns the number of splats.
    #[inline(always)]
    pub fn find<S: Simd, const OFFSETS: bool>(
        &mut self,
        s: S,
        splats: &[TileSplat],
        ids: &[AtomicU32],
        centers: &Centers,
        live: &Vectors,
    ) -> usize {
        let taken = ids.len().min(BATCH);
        for (copy, id) in self.splats.iter_mut().zip(ids) {
            *copy = splats[id.load(Relaxed) as usize];
        }
        // Prefetch the next batch.
        for id in ids.iter().skip(BATCH).take(BATCH) {
            prefetch(&splats[id.load(Relaxed) as usize]);
        }
        let mut reached = [Vectors::default(); BATCH];
        for k in 0..taken {
            reached[k] = reach(s, &self.splats[k], centers);
        }
        let mut count = 0;
        for k in 0..taken {
            for word in 0..PIXELS.div_ceil(64 * S::F32_LANES) {
                let mut bits = reached[k][word] & live[word];
                while bits != 0 {
                    self.vectors[count] = (word * 64 + bits.trailing_zeros() as usize) as u8;
                    self.owners[count] = k as u8;
                    bits &= bits - 1;
                    count += 1;
                }
            }
            self.ends[k] = count;
        }
        self.evaluate::<S, OFFSETS>(s, centers, count);
        taken
    }

    /// Evaluates the first `count` vectors.
    #[inline(always)]
    fn evaluate<S: Simd, const OFFSETS: bool>(&mut self, s: S, centers: &Centers, count: usize) {
        let across = blocks_across(S::F32_LANES);
        let (xs, ys) = (S::as_simd_f32s(&centers.x).0, S::as_simd_f32s(&centers.y).0);
        let gaussians = S::as_mut_simd_f32s(bytemuck::cast_slice_mut(&mut self.gaussians)).0;
        let us = S::as_mut_simd_f32s(bytemuck::cast_slice_mut(&mut self.u)).0;
        let vs = S::as_mut_simd_f32s(bytemuck::cast_slice_mut(&mut self.v)).0;
        for k in 0..count {
            let at = usize::from(self.vectors[k]);
            let splat = &self.splats[usize::from(self.owners[k]) % BATCH];
            let ([mx, my], [p, q, r]) = (splat.mean, splat.factor);
            let dx = s.sub_f32s(xs[at % across], s.splat_f32s(mx));
            let dy = s.sub_f32s(ys[at / across], s.splat_f32s(my));
            let u = s.mul_add_e_f32s(s.splat_f32s(p), dx, s.mul_f32s(s.splat_f32s(q), dy));
            let v = s.mul_f32s(s.splat_f32s(r), dy);
            gaussians[k] = exp2_of_minus(s, s.mul_add_e_f32s(u, u, s.mul_f32s(v, v)));
            if OFFSETS {
                (us[k], vs[k]) = (u, v);
            }
        }
    }
}

/// The values of a batch's vectors, contiguous.
#[inline(always)]
pub(super) fn floats(pixels: &[Pixels; BATCH]) -> &[f32] {
    bytemuck::cast_slice(pixels)
}

/// The vectors that a splat may reach.
#[inline(always)]
fn reach<S: Simd>(s: S, splat: &TileSplat, centers: &Centers) -> Vectors {
    let lanes = S::F32_LANES;
    let (width, across) = (block_width(lanes), blocks_across(lanes));
    let ([mx, my], [p, q, r]) = (splat.mean, splat.factor);
    let beyond = s.splat_f32s(p * (width - 1) as f32);
    let rows = S::as_simd_f32s(&centers.rows).0;
    let bits_of = S::as_simd_u32s(&centers.bits).0;
    let none = s.splat_u32s(0);
    let mut reached = Vectors::default();
    // A vector's lanes are rows, and have 16 blocks in all widths.
    for k in 0..SIDE / lanes {
        let dy = s.sub_f32s(rows[k], s.splat_f32s(my));
        let shift = s.mul_f32s(s.splat_f32s(q), dy);
        let v = s.mul_f32s(s.splat_f32s(r), dy);
        // Half the span of u in the row; not a number, and so never reached, outside.
        let half = s.sqrt_f32s(s.negate_mul_add_e_f32s(v, v, s.splat_f32s(splat.limit)));
        let least = s.sub_f32s(s.neg_f32s(half), beyond);
        let mut bits = none;
        for c in 0..across {
            let first = s.splat_f32s(centers.left + (c * width) as f32 - mx);
            let low = s.mul_add_e_f32s(s.splat_f32s(p), first, shift);
            let meets = s.and_m32s(
                s.less_than_or_equal_f32s(low, half),
                s.greater_than_or_equal_f32s(low, least),
            );
            bits = s.or_u32s(bits, s.select_u32s(meets, bits_of[c], none));
        }
        let mut any = 0;
        for bits in bytemuck::cast_slice::<S::u32s, u32>(&[bits]) {
            any |= bits;
        }
        reached[k / 4] |= u64::from(any) << (k % 4 * 16);
    }
    reached
}

/// Marks the vectors with a pixel that has not stopped; false if there is none.
#[inline(always)]
pub(super) fn live_vectors<S: Simd>(s: S, t: &[S::f32s], live: &mut Vectors) -> bool {
    let zero = s.splat_f32s(0.0);
    *live = Vectors::default();
    let mut any = 0;
    for (k, &t) in t.iter().enumerate() {
        let lit = s.first_true_m32s(s.greater_than_f32s(t, zero)) < S::F32_LANES;
        live[k / 64] |= u64::from(lit) << (k % 64);
        any |= u64::from(lit);
    }
    any != 0
}
