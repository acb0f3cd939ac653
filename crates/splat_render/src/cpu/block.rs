//! A block of splats as structure of arrays, one splat per vector lane. It stays in the cache.

use pulp::Simd;

use super::lanes::{Lanes, Vec3s};
use crate::constants::SH_COEFFS_MAX;
use crate::stages::SplatParams;

/// Splats per block: some whole vectors of any width.
pub(super) const BLOCK: usize = 64;

#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct Row(pub [f32; BLOCK]);

impl Row {
    pub const ZERO: Self = Self([0.0; BLOCK]);

    #[inline(always)]
    pub fn get<S: Simd>(&self, s: S, at: usize) -> Lanes<S> {
        Lanes::new(s, S::as_simd_f32s(&self.0).0[at])
    }

    #[inline(always)]
    pub fn set<S: Simd>(&mut self, at: usize, lanes: Lanes<S>) {
        S::as_mut_simd_f32s(&mut self.0).0[at] = lanes.vector();
    }
}

/// The vector `at` of three rows.
#[inline(always)]
pub(super) fn get3<S: Simd>(rows: &[Row; 3], s: S, at: usize) -> Vec3s<S> {
    Vec3s::new(rows[0].get(s, at), rows[1].get(s, at), rows[2].get(s, at))
}

#[inline(always)]
pub(super) fn set3<S: Simd>(rows: &mut [Row; 3], at: usize, v: Vec3s<S>) {
    rows[0].set(at, v.x);
    rows[1].set(at, v.y);
    rows[2].set(at, v.z);
}

/// Vectors that `splats` of a block take.
#[inline(always)]
pub(super) fn vectors<S: Simd>(splats: usize) -> usize {
    splats.div_ceil(S::F32_LANES)
}

/// Which splats of a block something is about, in order.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ids {
    ids: [u8; BLOCK],
    len: usize,
}

impl Ids {
    pub const NONE: Self = Self { ids: [0; BLOCK], len: 0 };

    pub fn all(len: usize) -> Self {
        Self { ids: std::array::from_fn(|k| k as u8), len }
    }

    #[inline(always)]
    pub fn clear(&mut self) {
        self.len = 0;
    }

    #[inline(always)]
    pub fn push(&mut self, k: usize) {
        self.ids[self.len] = k as u8;
        self.len += 1;
    }

    /// Appends `k` if `wanted`, without a branch.
    #[inline(always)]
    pub fn push_if(&mut self, k: usize, wanted: bool) {
        self.ids[self.len] = k as u8;
        self.len += usize::from(wanted);
    }

    pub fn below(&self, count: usize) -> Self {
        let len = self.get().partition_point(|&k| usize::from(k) < count);
        Self { len, ..*self }
    }

    #[inline(always)]
    pub fn get(&self) -> &[u8] {
        &self.ids[..self.len]
    }
}

/// Parameters of a block of splats as they are given, colors apart.
#[derive(Debug)]
pub(super) struct SplatRows {
    pub means: [Row; 3],
    pub quats: [Row; 4],
    pub scales: [Row; 3],
    pub opacities: Row,
}

impl SplatRows {
    pub const ZERO: Self = Self {
        means: [Row::ZERO; 3],
        quats: [Row::ZERO; 4],
        scales: [Row::ZERO; 3],
        opacities: Row::ZERO,
    };

    #[inline(always)]
    pub fn quat<S: Simd>(&self, s: S, at: usize) -> [Lanes<S>; 4] {
        let [w, x, y, z] = &self.quats;
        [w.get(s, at), x.get(s, at), y.get(s, at), z.get(s, at)]
    }

    /// Takes the splats `ids` of the block that begins with splat `first`.
    #[inline(always)]
    pub fn take(&mut self, splats: &SplatParams<'_, f32>, first: usize, ids: &[u8]) {
        for (to, &k) in (0..BLOCK).zip(ids) {
            let from = first + usize::from(k);
            for (row, value) in self.means.iter_mut().zip(splats.means[from]) {
                row.0[to] = value;
            }
            for (row, value) in self.quats.iter_mut().zip(splats.quats[from]) {
                row.0[to] = value;
            }
            for (row, value) in self.scales.iter_mut().zip(splats.scales[from]) {
                row.0[to] = value;
            }
            self.opacities.0[to] = splats.opacities[from];
        }
    }
}

/// Color coefficients of a block of splats: row 3 k + c has channel c of coefficient k.
#[derive(Debug)]
pub(super) struct ColorRows(pub [Row; 3 * SH_COEFFS_MAX]);

impl ColorRows {
    pub const ZERO: Self = Self([Row::ZERO; 3 * SH_COEFFS_MAX]);

    /// The vector `at` of coefficient `k`.
    #[inline(always)]
    pub fn get3<S: Simd>(&self, s: S, k: usize, at: usize) -> Vec3s<S> {
        let rows = &self.0[3 * k..][..3];
        Vec3s::new(rows[0].get(s, at), rows[1].get(s, at), rows[2].get(s, at))
    }

    /// Takes the first `used` of `stride` coefficients of the splats `ids` of the block at `first`.
    #[inline(always)]
    pub fn take(
        &mut self,
        coeffs: &[[f32; 3]],
        [stride, used]: [usize; 2],
        first: usize,
        ids: &[u8],
    ) {
        let values = coeffs.as_flattened();
        let (stride, used) = (3 * stride, 3 * used);
        let at = |k: u8| (first + usize::from(k)) * stride;
        let (fours, rest) = ids.as_chunks::<4>();
        for (block, four) in fours.iter().enumerate() {
            let splats = [
                &values[at(four[0])..][..used],
                &values[at(four[1])..][..used],
                &values[at(four[2])..][..used],
                &values[at(four[3])..][..used],
            ];
            let [a, b, c, d] = splats;
            let [(a, a1), (b, b1), (c, c1), (d, d1)] =
                [a.as_chunks::<4>(), b.as_chunks::<4>(), c.as_chunks::<4>(), d.as_chunks::<4>()];
            let to = 4 * block;
            for k in 0..a.len() {
                let quad = [a[k], b[k], c[k], d[k]];
                for r in 0..4 {
                    let row = [quad[0][r], quad[1][r], quad[2][r], quad[3][r]];
                    self.0[4 * k + r].0[to..to + 4].copy_from_slice(&row);
                }
            }
            for r in 0..a1.len() {
                let row = [a1[r], b1[r], c1[r], d1[r]];
                self.0[4 * a.len() + r].0[to..to + 4].copy_from_slice(&row);
            }
        }
        let to = 4 * fours.len();
        for (k, &id) in rest.iter().enumerate() {
            for (row, value) in self.0.iter_mut().zip(&values[at(id)..][..used]) {
                row.0[to + k] = *value;
            }
        }
    }
}
