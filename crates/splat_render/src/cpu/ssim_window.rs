//! The SSIM window as two passes: along rows, then along columns.

use pulp::Simd;

use crate::constants::SSIM_WINDOW;

/// Taps on each side of the window's centre.
pub(super) const HALF: usize = SSIM_WINDOW.len() / 2;
/// Zeros kept before and after each row: at least the window's half.
const PAD: usize = 16;
/// Vectors that are summed side by side, so that no sum waits for the one before it and the bounds
/// of what they read are checked once.
pub(super) const RUN: usize = 4;
/// Floats of a run of the widest vectors.
const WIDEST: usize = 16 * RUN;

/// Some neighbouring rows of several maps, filtered along the rows. Rows outside the picture and
/// values beyond its width are zero.
pub(super) struct Rows {
    stride: usize,
    per_map: usize,
    data: Vec<f32>,
}

/// A picture's row with zeros around it.
pub(super) struct Padded(Vec<f32>);

/// A row of vectors, in runs.
pub(super) type Line<S> = Vec<[<S as Simd>::f32s; RUN]>;

impl Rows {
    /// Zeros for `maps` maps of as many rows as a window needs around `rows` rows of `width`.
    pub fn new(maps: usize, rows: usize, width: usize) -> Self {
        let (stride, per_map) = (width.next_multiple_of(WIDEST), rows + 2 * HALF);
        Self { stride, per_map, data: vec![0.0; maps * per_map * stride] }
    }

    /// A row to filter, all zeros.
    pub fn padded(&self) -> Padded {
        Padded(vec![0.0; self.stride + 2 * PAD])
    }

    /// A row for what [`Rows::filter_column`] gives.
    pub fn line<S: Simd>(&self, s: S) -> Line<S> {
        vec![[s.splat_f32s(0.0); RUN]; self.stride / (RUN * S::F32_LANES)]
    }

    /// Filters a row and keeps it as row `row` of `map`; the rows asked for begin at row [`HALF`].
    #[inline(always)]
    pub fn filter_row<S: Simd>(&mut self, s: S, padded: &Padded, map: usize, row: usize) {
        let out = &mut self.data[(map * self.per_map + row) * self.stride..][..self.stride];
        let (runs, _) = S::as_mut_simd_f32s(out).0.as_chunks_mut::<RUN>();
        let lanes = S::F32_LANES;
        for (run, out) in runs.iter_mut().enumerate() {
            let from = &padded.0[run * RUN * lanes + PAD - HALF..][..RUN * lanes + 2 * HALF];
            let mut sums = [s.splat_f32s(0.0); RUN];
            let center = s.splat_f32s(SSIM_WINDOW[HALF]);
            for j in 0..RUN {
                sums[j] = s.mul_f32s(center, load::<S>(from, j * lanes + HALF));
            }
            for k in 0..HALF {
                let tap = s.splat_f32s(SSIM_WINDOW[k]);
                for j in 0..RUN {
                    let (left, right) = (j * lanes + k, j * lanes + 2 * HALF - k);
                    let pair = s.add_f32s(load::<S>(from, left), load::<S>(from, right));
                    sums[j] = s.mul_add_e_f32s(tap, pair, sums[j]);
                }
            }
            *out = sums;
        }
    }

    /// Filters the columns of `map` around the row that is `row`th of those asked for.
    #[inline(always)]
    pub fn filter_column<S: Simd>(&self, s: S, map: usize, row: usize, out: &mut Line<S>) {
        let at = (map * self.per_map + row) * self.stride;
        let window = &self.data[at..at + SSIM_WINDOW.len() * self.stride];
        let (window, _) = S::as_simd_f32s(window).0.as_chunks::<RUN>();
        let runs = out.len();
        for (run, out) in out.iter_mut().enumerate() {
            let mut sums = [s.splat_f32s(0.0); RUN];
            for k in 0..SSIM_WINDOW.len() {
                let (tap, row) = (s.splat_f32s(SSIM_WINDOW[k]), &window[k * runs + run]);
                for j in 0..RUN {
                    sums[j] = s.mul_add_e_f32s(tap, row[j], sums[j]);
                }
            }
            *out = sums;
        }
    }
}

impl Padded {
    /// The `width` values between the zeros.
    #[inline(always)]
    pub fn row(&mut self, width: usize) -> &mut [f32] {
        &mut self.0[PAD..PAD + width]
    }
}

#[inline(always)]
fn load<S: Simd>(values: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&values[at..at + S::F32_LANES]).0[0]
}
