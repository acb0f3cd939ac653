//! The SSIM window as two passes of 11 taps, and the memory layout of a picture's rows for them.
//!
//! A row is cut into equal parts, one for each lane of a vector; vector k holds the k-th value of each
//! part. The neighbors of a vector's values along the row are then in the adjacent vectors, and both
//! passes read whole, aligned vectors. In row-major layout each tap would read across cache lines. Only
//! at the ends of parts do values come from the next lane.

use bytemuck::{Pod, Zeroable};
use glam::{Mat4, Vec4};
use pulp::Simd;

use crate::constants::SSIM_WINDOW;

/// Taps on each side of the window's center.
pub(super) const HALF: usize = SSIM_WINDOW.len() / 2;
/// Neighboring results computed together, since they share most of their inputs.
pub(super) const STEP: usize = 4;
/// Number of inputs of [`STEP`] neighboring results.
pub(super) const REACH: usize = STEP + 2 * HALF;
/// Rows that a ring keeps: at least [`REACH`], a multiple of [`STEP`], and a power of two.
pub(super) const SLOTS: usize = 16;
/// Side of the blocks in which rows are transposed, as a [`Mat4`].
const BLOCK: usize = 4;
/// Floats of the widest vectors.
const WIDEST: usize = 16;

#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct CacheLine([f32; WIDEST]);

/// Scratch memory that begins on a cache line, so that no vector lies across two.
#[derive(Debug, Default)]
pub(super) struct Aligned(Vec<CacheLine>);

impl Aligned {
    pub fn vectors<S: Simd>(&mut self, count: usize) -> &mut [S::f32s] {
        let lines = (count * S::F32_LANES).div_ceil(WIDEST);
        if self.0.len() < lines {
            self.0.resize(lines, CacheLine::zeroed());
        }
        &mut bytemuck::cast_slice_mut(&mut self.0)[..count]
    }
}

/// Vectors of a row: at least [`HALF`], so that a window spans at most two parts.
#[inline(always)]
pub(super) fn vectors_of_row<S: Simd>(width: usize) -> usize {
    width.div_ceil(S::F32_LANES).max(HALF)
}

/// Spreads a row in picture order over the parts; vectors are `stride` floats apart in `to`.
#[inline(always)]
pub(super) fn spread<S: Simd>(row: &[f32], to: &mut [f32], stride: usize) {
    let vectors = row.len() / S::F32_LANES;
    if S::F32_LANES < BLOCK {
        for (k, value) in row.iter().enumerate() {
            to[k * stride] = *value;
        }
        return;
    }
    for k in blocks(vectors) {
        for lane in (0..S::F32_LANES).step_by(BLOCK) {
            let block = Mat4::from_cols(
                Vec4::from_slice(&row[lane * vectors + k..]),
                Vec4::from_slice(&row[(lane + 1) * vectors + k..]),
                Vec4::from_slice(&row[(lane + 2) * vectors + k..]),
                Vec4::from_slice(&row[(lane + 3) * vectors + k..]),
            );
            let block = block.transpose();
            block.x_axis.write_to_slice(&mut to[k * stride + lane..]);
            block.y_axis.write_to_slice(&mut to[(k + 1) * stride + lane..]);
            block.z_axis.write_to_slice(&mut to[(k + 2) * stride + lane..]);
            block.w_axis.write_to_slice(&mut to[(k + 3) * stride + lane..]);
        }
    }
}

/// The opposite of [`spread`], of vectors side by side.
#[inline(always)]
pub(super) fn collect<S: Simd>(from: &[f32], row: &mut [f32]) {
    let vectors = row.len() / S::F32_LANES;
    if S::F32_LANES < BLOCK {
        row.copy_from_slice(from);
        return;
    }
    let lanes = S::F32_LANES;
    for k in blocks(vectors) {
        for lane in (0..lanes).step_by(BLOCK) {
            let block = Mat4::from_cols(
                Vec4::from_slice(&from[k * lanes + lane..]),
                Vec4::from_slice(&from[(k + 1) * lanes + lane..]),
                Vec4::from_slice(&from[(k + 2) * lanes + lane..]),
                Vec4::from_slice(&from[(k + 3) * lanes + lane..]),
            );
            let block = block.transpose();
            block.x_axis.write_to_slice(&mut row[lane * vectors + k..]);
            block.y_axis.write_to_slice(&mut row[(lane + 1) * vectors + k..]);
            block.z_axis.write_to_slice(&mut row[(lane + 2) * vectors + k..]);
            block.w_axis.write_to_slice(&mut row[(lane + 3) * vectors + k..]);
        }
    }
}

/// Starts of the blocks that cover `vectors` vectors; the last may overlap the one before it.
#[inline(always)]
fn blocks(vectors: usize) -> impl Iterator<Item = usize> {
    (0..vectors.div_ceil(BLOCK)).map(move |block| (block * BLOCK).min(vectors - BLOCK))
}

/// Fills the padding of a row with the neighboring parts' values, zero beyond the picture.
#[inline(always)]
pub(super) fn fill_ends<S: Simd>(s: S, row: &mut [S::f32s]) {
    const INDEX: [f32; WIDEST] = {
        let mut index = [0.0; WIDEST];
        let mut k = 0;
        while k < WIDEST {
            index[k] = k as f32;
            k += 1;
        }
        index
    };
    let (lanes, vectors) = (S::F32_LANES, row.len() - 2 * HALF);
    let (zero, index) = (s.splat_f32s(0.0), load::<S>(&INDEX, 0));
    let not_first = s.greater_than_f32s(index, s.splat_f32s(0.5));
    let not_last = s.less_than_f32s(index, s.splat_f32s(lanes as f32 - 1.5));
    for k in 0..HALF {
        // Shifting by one float moves to the next lane, except in the lane at the end.
        let values = bytemuck::cast_slice::<S::f32s, f32>(row);
        let before = load::<S>(values, (vectors + k) * lanes - 1);
        let after = load::<S>(values, (HALF + k) * lanes + 1);
        row[k] = s.select_f32s(not_first, before, zero);
        row[HALF + vectors + k] = s.select_f32s(not_last, after, zero);
    }
}

/// The [`REACH`] rows of one vector of a ring from slot `first` on.
#[inline(always)]
pub(super) fn window<S: Simd>(ring: &[S::f32s; SLOTS], first: usize) -> [S::f32s; REACH] {
    let mut rows = [ring[0]; REACH];
    for j in 0..REACH {
        rows[j] = ring[(first + j) % SLOTS];
    }
    rows
}

/// Whether the values of [`STEP`] results fit into the registers.
#[inline(always)]
pub(super) fn many_registers<S: Simd>() -> bool {
    S::REGISTER_COUNT >= 32
}

/// [`STEP`] neighboring results of a pass.
#[inline(always)]
pub(super) fn filter_step<S: Simd>(s: S, values: &[S::f32s; REACH]) -> [S::f32s; STEP] {
    if many_registers::<S>() {
        return filter::<S, STEP>(s, values);
    }
    let [a, b] = filter::<S, 2>(s, values);
    let [c, d] = filter::<S, 2>(s, &values[2..]);
    [a, b, c, d]
}

/// `N` neighboring results of a pass from their N + 2 [`HALF`] values.
#[inline(always)]
pub(super) fn filter<S: Simd, const N: usize>(s: S, values: &[S::f32s]) -> [S::f32s; N] {
    let values = &values[..N + 2 * HALF];
    let mut sums = [s.splat_f32s(0.0); N];
    let center = s.splat_f32s(SSIM_WINDOW[HALF]);
    for j in 0..N {
        sums[j] = s.mul_f32s(center, values[j + HALF]);
    }
    // The window is symmetric: one multiplication for two taps.
    for k in 0..HALF {
        let tap = s.splat_f32s(SSIM_WINDOW[k]);
        for j in 0..N {
            let pair = s.add_f32s(values[j + k], values[j + 2 * HALF - k]);
            sums[j] = s.mul_add_e_f32s(tap, pair, sums[j]);
        }
    }
    sums
}

#[inline(always)]
fn load<S: Simd>(values: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&values[at..at + S::F32_LANES]).0[0]
}
