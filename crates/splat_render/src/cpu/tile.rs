//! A tile as the inner loops of rasterize and rasterize_backward see it: how its pixels lie in
//! memory, what they read of a splat, and which of its vectors a splat reaches.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use pulp::Simd;

use super::project::Splat2d;
use super::simd::exp2_of_minus;
use crate::constants::{ALPHA_MIN, TILE};

pub(super) const SIDE: usize = TILE as usize;
pub(super) const PIXELS: usize = SIDE * SIDE;

/// Splats between two looks at which of a tile's vectors still take light.
pub(super) const LIVE_INTERVAL: usize = 16;

/// sqrt(log2(e) / 2): scales a factor so that exp(-sigma) = 2^-(u^2 + v^2).
const WHITEN: f32 = 0.849_321_8;

/// One value per pixel of a tile, as vectors of neighbouring columns: all rows of the first column
/// of vectors, then of the next.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct Pixels(pub [f32; PIXELS]);

/// Where a tile lies in a plane, row-major, of a picture.
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
        let vectors = S::as_mut_simd_f32s(&mut pixels.0).0;
        for row in 0..self.rows {
            let plane = &plane[self.first + row * self.width..][..self.columns];
            let (whole, rest) = S::as_simd_f32s(plane);
            for (c, &vector) in whole.iter().enumerate() {
                vectors[c * SIDE + row] = vector;
            }
            let from = (whole.len() * SIDE + row) * S::F32_LANES;
            let values = bytemuck::cast_slice_mut::<_, f32>(vectors);
            for (k, &value) in rest.iter().enumerate() {
                values[from + k] = value;
            }
        }
        pixels
    }
}

impl Pixels {
    /// Transmittance before the first splat: 1, and negative, as if stopped, beyond the rows and
    /// columns that the picture has.
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
        let vectors = S::as_simd_f32s(&self.0).0;
        for (row, out) in rows.iter_mut().enumerate() {
            let (whole, rest) = S::as_mut_simd_f32s(out);
            for (c, vector) in whole.iter_mut().enumerate() {
                *vector = vectors[c * SIDE + row];
            }
            let from = (whole.len() * SIDE + row) * S::F32_LANES;
            for (k, value) in rest.iter_mut().enumerate() {
                *value = self.0[from + k];
            }
        }
    }
}

/// Where the pixel of a tile's row and column lies in [`Pixels`].
#[inline(always)]
fn offset(row: usize, column: usize, lanes: usize) -> usize {
    (column / lanes * SIDE + row) * lanes + column % lanes
}

/// x or y of the centres of the pixels along a tile's side that starts at `start`.
pub(super) fn centers(start: f32) -> [f32; SIDE] {
    std::array::from_fn(|k| start + k as f32 + 0.5)
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

/// Copies of the next splats of a tile's list, since they lie anywhere in memory: asked for together,
/// they are waited for once. Returns how many there were.
#[inline(always)]
pub(super) fn take(
    splats: &[TileSplat],
    ids: &[AtomicU32],
    batch: &mut [TileSplat; LIVE_INTERVAL],
) -> usize {
    for (copy, id) in batch.iter_mut().zip(ids) {
        *copy = splats[id.load(Relaxed) as usize];
    }
    ids.len().min(LIVE_INTERVAL)
}

impl TileSplat {
    pub fn new(splat: &Splat2d) -> Self {
        Self {
            mean: splat.mean,
            factor: splat.factor.map(|f| f * WHITEN),
            opacity: splat.opacity,
            color: splat.color,
            depth: splat.depth,
            limit: (splat.opacity / ALPHA_MIN).log2() * (1.0 + 1e-5) + 1e-5,
        }
    }
}

/// A bit per vector of a tile, in the order of [`Pixels`]: vector k is bit k % 64 of word k / 64.
/// More than one word only where there are no vectors of four lanes.
pub(super) type Vectors = [u64; PIXELS / 64];

/// Words of [`Vectors`] in use.
#[inline(always)]
fn words(lanes: usize) -> usize {
    (PIXELS / lanes).div_ceil(64)
}

/// Where one splat may be seen in a tile: the first half of both rasterize stages. They are two short
/// loops on purpose: in one long loop a vector's exponential would wait for the vector before it,
/// since no processor looks far enough ahead.
#[repr(align(64))]
pub(super) struct Reached {
    /// q dy of each row.
    pub shift: [f32; SIDE],
    /// v of each row.
    pub v: [f32; SIDE],
    /// v^2 of each row.
    pub vv: [f32; SIDE],
    /// Numbers of the vectors that the splat may reach and whose pixels have not all stopped.
    pub vectors: [u8; PIXELS],
    /// exp(-sigma) there, in that order.
    pub gaussians: Pixels,
}

impl Reached {
    pub fn new() -> Self {
        Self {
            shift: [0.0; SIDE],
            v: [0.0; SIDE],
            vv: [0.0; SIDE],
            vectors: [0; PIXELS],
            gaussians: Pixels([0.0; PIXELS]),
        }
    }

    /// Finds the vectors, of those in `live`, and returns how many there are. The tile's pixel
    /// centres are at `columns` and `rows`.
    #[inline(always)]
    pub fn find<S: Simd>(
        &mut self,
        s: S,
        splat: &TileSplat,
        columns: &[f32; SIDE],
        rows: &[f32; SIDE],
        live: &Vectors,
    ) -> usize {
        let mut reached = self.reach(s, splat, columns, rows);
        let p = s.splat_f32s(splat.factor[0]);
        let dx = offsets(s, splat, columns);
        let gaussians = S::as_mut_simd_f32s(&mut self.gaussians.0).0;
        let mut count = 0;
        for word in 0..words(S::F32_LANES) {
            reached[word] &= live[word];
            while reached[word] != 0 {
                let at = word * 64 + reached[word].trailing_zeros() as usize;
                reached[word] &= reached[word] - 1;
                let shift = s.splat_f32s(self.shift[at % SIDE]);
                let vv = s.splat_f32s(self.vv[at % SIDE]);
                let u = s.mul_add_e_f32s(p, dx[at / SIDE % SIDE], shift);
                gaussians[count] = exp2_of_minus(s, s.mul_add_e_f32s(u, u, vv));
                self.vectors[count] = at as u8;
                count += 1;
            }
        }
        count
    }

    /// Fills the rows and returns the vectors that the splat may reach.
    #[inline(always)]
    fn reach<S: Simd>(
        &mut self,
        s: S,
        splat: &TileSplat,
        columns: &[f32; SIDE],
        rows: &[f32; SIDE],
    ) -> Vectors {
        let lanes = S::F32_LANES;
        let [p, q, r] = splat.factor;
        let (p, q, r) = (s.splat_f32s(p), s.splat_f32s(q), s.splat_f32s(r));
        let (limit, my) = (s.splat_f32s(splat.limit), s.splat_f32s(splat.mean[1]));
        let zero = s.splat_f32s(0.0);
        let rows = S::as_simd_f32s(rows).0;
        let shifts = S::as_mut_simd_f32s(&mut self.shift).0;
        let vs = S::as_mut_simd_f32s(&mut self.v).0;
        let vvs = S::as_mut_simd_f32s(&mut self.vv).0;
        let weights = S::as_simd_f32s(&BITS).0;
        let mut halves = [zero; SIDE];
        for block in 0..SIDE / lanes {
            let dy = s.sub_f32s(rows[block], my);
            let v = s.mul_f32s(r, dy);
            (shifts[block], vs[block], vvs[block]) = (s.mul_f32s(q, dy), v, s.mul_f32s(v, v));
            // Half the span of u in the row; not a number, and so never reached, outside.
            halves[block] = s.sqrt_f32s(s.sub_f32s(limit, vvs[block]));
        }
        let mut reached = Vectors::default();
        for c in 0..SIDE / lanes {
            let first = s.splat_f32s(columns[c * lanes] - splat.mean[0]);
            let last = s.splat_f32s(columns[c * lanes + lanes - 1] - splat.mean[0]);
            let mut bits = zero;
            for block in 0..SIDE / lanes {
                let low = s.mul_add_e_f32s(p, first, shifts[block]);
                let high = s.mul_add_e_f32s(p, last, shifts[block]);
                let meets = s.and_m32s(
                    s.less_than_or_equal_f32s(low, halves[block]),
                    s.greater_than_or_equal_f32s(high, s.neg_f32s(halves[block])),
                );
                bits = s.add_f32s(bits, s.select_f32s(meets, weights[block], zero));
            }
            // A column's 16 bits: exact.
            let bits = s.reduce_sum_f32s(bits) as i32 as u64;
            reached[c / 4] |= bits << (c % 4 * SIDE);
        }
        reached
    }
}

/// Offsets along x of a tile's columns of vectors from the splat's centre.
#[inline(always)]
pub(super) fn offsets<S: Simd>(s: S, splat: &TileSplat, columns: &[f32; SIDE]) -> [S::f32s; SIDE] {
    let mut dx = [s.splat_f32s(0.0); SIDE];
    for (dx, &x) in dx.iter_mut().zip(S::as_simd_f32s(columns).0) {
        *dx = s.sub_f32s(x, s.splat_f32s(splat.mean[0]));
    }
    dx
}

/// Powers of two.
const BITS: [f32; SIDE] = {
    let mut bits = [0.0; SIDE];
    let mut k = 0;
    while k < SIDE {
        bits[k] = (1u32 << k) as f32;
        k += 1;
    }
    bits
};

/// Sets the bits of the vectors in which some pixel has not stopped (transmittance above zero);
/// false if there is none.
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
