//! loss: L1 and D-SSIM of a picture against a photo, with the picture's gradient.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::simd::dispatch;
use crate::fit::{SSIM_C, SSIM_WINDOW};

/// Taps on each side of the window's centre.
const HALF: usize = SSIM_WINDOW.len() / 2;
/// Rows per task.
const BAND: usize = 32;
/// Zeros kept before and after each row: at least the window's half, and room for a whole vector.
const PAD: usize = 16;

/// The loss's gradient and scratch memory, kept from step to step.
#[derive(Debug, Default, Clone)]
pub(super) struct Loss {
    /// Derivatives of the weighted SSIM sum with respect to the filtered x, xx and xy, per channel.
    slopes: [[Vec<f32>; 3]; 3],
    /// Gradient of the loss with respect to each channel of the picture.
    pub v_color: [Vec<f32>; 3],
}

/// A band of rows of one channel: first pass, from pictures to slopes.
struct Slopes<'a> {
    x: &'a [f32],
    y: &'a [f32],
    weights: Option<&'a [f32]>,
    width: usize,
    rows: std::ops::Range<usize>,
    out: [&'a mut [f32]; 3],
}

/// Horizontally filtered rows of several maps, kept for the vertical pass.
struct Rows {
    stride: usize,
    data: Vec<f32>,
}

impl Rows {
    fn new(maps: usize, rows: usize, width: usize) -> Self {
        let stride = width.div_ceil(PAD) * PAD;
        Self { stride, data: vec![0.0; maps * rows * stride] }
    }

    fn row(&self, index: usize) -> &[f32] {
        &self.data[index * self.stride..(index + 1) * self.stride]
    }

    fn row_mut(&mut self, index: usize) -> &mut [f32] {
        &mut self.data[index * self.stride..(index + 1) * self.stride]
    }
}

#[inline(always)]
fn load<S: Simd>(values: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&values[at..at + S::F32_LANES]).0[0]
}

/// `out[x] = sum_k window[k] padded[x + k + PAD - HALF]`, the window being symmetric.
#[inline(always)]
fn filter_row<S: Simd>(s: S, padded: &[f32], out: &mut [f32]) {
    let mut taps = [s.splat_f32s(0.0); HALF + 1];
    for (tap, weight) in taps.iter_mut().zip(SSIM_WINDOW) {
        *tap = s.splat_f32s(weight);
    }
    let (out, _) = S::as_mut_simd_f32s(out);
    let lanes = S::F32_LANES;
    for (v, out) in out.iter_mut().enumerate() {
        let at = v * lanes + PAD - HALF;
        let mut sum = s.mul_f32s(taps[HALF], load::<S>(padded, at + HALF));
        for k in 0..HALF {
            let pair = s.add_f32s(load::<S>(padded, at + k), load::<S>(padded, at + 2 * HALF - k));
            sum = s.mul_add_e_f32s(taps[k], pair, sum);
        }
        *out = sum;
    }
}

/// The rows that a vertical window covers; None where it leaves the picture.
type Window<'a, S> = [Option<&'a [<S as Simd>::f32s]>; 2 * HALF + 1];

/// Gathers the rows around `row` of the map that starts at row `base` of `filtered`, which holds
/// the picture's rows `held`.
#[inline(always)]
fn fill_window<'a, S: Simd>(
    window: &mut Window<'a, S>,
    filtered: &'a Rows,
    base: usize,
    held: std::ops::Range<usize>,
    row: usize,
) {
    for (k, slot) in window.iter_mut().enumerate() {
        // Compared without subtracting first: rows count from zero.
        if row + k >= HALF + held.start && row + k < HALF + held.end {
            *slot = Some(S::as_simd_f32s(filtered.row(base + row + k - HALF - held.start)).0);
        }
    }
}

/// Vertical pass at vector `v`; rows outside the picture count zero.
#[inline(always)]
fn filter_column<S: Simd>(s: S, rows: &Window<'_, S>, v: usize) -> S::f32s {
    let mut sum = s.splat_f32s(0.0);
    for (row, weight) in rows.iter().zip(SSIM_WINDOW) {
        if let Some(row) = row {
            sum = s.mul_add_e_f32s(s.splat_f32s(weight), row[v], sum);
        }
    }
    sum
}

/// Copies `row` into the middle of `padded`, leaving zeros around it.
#[inline(always)]
fn pad(row: &[f32], padded: &mut [f32]) {
    padded[PAD..PAD + row.len()].copy_from_slice(row);
}

impl WithSimd for Slopes<'_> {
    /// Weighted sum of SSIM over the band.
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f64 {
        let width = self.width;
        let height = self.x.len() / width;
        let first = self.rows.start.saturating_sub(HALF);
        let last = (self.rows.end + HALF).min(height);
        let count = last - first;
        // x, y, xx + yy and xy: SSIM takes the two variances only as a sum.
        let mut filtered = Rows::new(4, count, width);
        let padded_len = filtered.stride + 2 * PAD;
        let mut padded: [Vec<f32>; 4] = std::array::from_fn(|_| vec![0.0; padded_len]);
        for row in first..last {
            let (x, y) = (&self.x[row * width..][..width], &self.y[row * width..][..width]);
            pad(x, &mut padded[0]);
            pad(y, &mut padded[1]);
            let [_, _, squares, xy] = &mut padded;
            let products = squares[PAD..].iter_mut().zip(&mut xy[PAD..]);
            for ((squares, xy), (x, y)) in products.zip(x.iter().zip(y)) {
                (*squares, *xy) = (x * x + y * y, x * y);
            }
            for (map, padded) in padded.iter().enumerate() {
                filter_row(s, padded, filtered.row_mut(map * count + row - first));
            }
        }
        let (c1, c2) = (s.splat_f32s(SSIM_C.0), s.splat_f32s(SSIM_C.1));
        let two = s.splat_f32s(2.0);
        let vectors = filtered.stride / S::F32_LANES;
        let mut lines = [(); 4].map(|()| vec![s.splat_f32s(0.0); vectors]);
        let mut total = 0.0f64;
        let [out_mu, out_xx, out_xy] = self.out;
        for row in self.rows.clone() {
            let mut windows: [Window<'_, S>; 4] = [[None; 2 * HALF + 1]; 4];
            for (map, window) in windows.iter_mut().enumerate() {
                fill_window::<S>(window, &filtered, map * count, first..last, row);
            }
            for v in 0..vectors {
                let mu_x = filter_column(s, &windows[0], v);
                let mu_y = filter_column(s, &windows[1], v);
                let squares = filter_column(s, &windows[2], v);
                let xy = filter_column(s, &windows[3], v);
                let mu_xy = s.mul_f32s(mu_x, mu_y);
                let (mu_xx, mu_yy) = (s.mul_f32s(mu_x, mu_x), s.mul_f32s(mu_y, mu_y));
                let s_xy = s.sub_f32s(xy, mu_xy);
                let s_sum = s.sub_f32s(squares, s.add_f32s(mu_xx, mu_yy));
                let a1 = s.mul_add_e_f32s(two, mu_xy, c1);
                let a2 = s.mul_add_e_f32s(two, s_xy, c2);
                let b1 = s.add_f32s(s.add_f32s(mu_xx, mu_yy), c1);
                let b2 = s.add_f32s(s_sum, c2);
                let inverse = s.div_f32s(s.splat_f32s(1.0), s.mul_f32s(b1, b2));
                let ssim = s.mul_f32s(s.mul_f32s(a1, a2), inverse);
                let v_xx = s.neg_f32s(s.mul_f32s(s.mul_f32s(ssim, inverse), b1));
                let v_xy = s.mul_f32s(two, s.mul_f32s(a1, inverse));
                // d/d mu_x directly, and through s_xx = xx - mu_x^2 and s_xy = xy - mu_x mu_y.
                let direct = s.sub_f32s(
                    s.mul_f32s(s.mul_f32s(mu_y, a2), inverse),
                    s.mul_f32s(mu_x, s.mul_f32s(s.mul_f32s(ssim, inverse), b2)),
                );
                let through = s.mul_add_e_f32s(s.mul_f32s(two, v_xx), mu_x, s.mul_f32s(v_xy, mu_y));
                lines[0][v] = s.sub_f32s(s.mul_f32s(two, direct), through);
                lines[1][v] = v_xx;
                lines[2][v] = v_xy;
                lines[3][v] = ssim;
            }
            let to = (row - self.rows.start) * width;
            let at = row * width;
            let weights = self.weights.map(|w| &w[at..at + width]);
            let line = |k: usize| &bytemuck::cast_slice::<S::f32s, f32>(&lines[k])[..width];
            for (k, out) in [&mut *out_mu, &mut *out_xx, &mut *out_xy].into_iter().enumerate() {
                let out = &mut out[to..to + width];
                match weights {
                    None => out.copy_from_slice(line(k)),
                    Some(w) => {
                        for ((out, v), w) in out.iter_mut().zip(line(k)).zip(w) {
                            *out = v * w;
                        }
                    }
                }
            }
            total += f64::from(weighted_sum(s, line(3), weights));
        }
        total
    }
}

/// Sum of a row's values times their weights, 1 if there are none.
#[inline(always)]
fn weighted_sum<S: Simd>(s: S, values: &[f32], weights: Option<&[f32]>) -> f32 {
    let (vectors, rest) = S::as_simd_f32s(values);
    let mut sum = s.splat_f32s(0.0);
    let mut rest_sum = 0.0;
    match weights {
        None => {
            for &v in vectors {
                sum = s.add_f32s(sum, v);
            }
            for v in rest {
                rest_sum += v;
            }
        }
        Some(weights) => {
            let (weight_vectors, rest_weights) = S::as_simd_f32s(weights);
            for (&v, &w) in vectors.iter().zip(weight_vectors) {
                sum = s.mul_add_e_f32s(v, w, sum);
            }
            for (v, w) in rest.iter().zip(rest_weights) {
                rest_sum += v * w;
            }
        }
    }
    s.reduce_sum_f32s(sum) + rest_sum
}

/// A band of rows of one channel: second pass, from slopes to the picture's gradient.
struct Gradient<'a> {
    x: &'a [f32],
    y: &'a [f32],
    weights: Option<&'a [f32]>,
    slopes: &'a [Vec<f32>; 3],
    width: usize,
    rows: std::ops::Range<usize>,
    /// What one unit of |x - y| and of SSIM weighs in the loss.
    l1: f32,
    ssim: f32,
    out: &'a mut [f32],
}

impl WithSimd for Gradient<'_> {
    /// Weighted sum of |x - y| over the band.
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f64 {
        let width = self.width;
        let height = self.x.len() / width;
        let first = self.rows.start.saturating_sub(HALF);
        let last = (self.rows.end + HALF).min(height);
        let count = last - first;
        let mut filtered = Rows::new(3, count, width);
        let mut padded = vec![0.0; filtered.stride + 2 * PAD];
        for (map, slopes) in self.slopes.iter().enumerate() {
            for row in first..last {
                pad(&slopes[row * width..][..width], &mut padded);
                filter_row(s, &padded, filtered.row_mut(map * count + row - first));
            }
        }
        let vectors = filtered.stride / S::F32_LANES;
        let mut lines = [(); 3].map(|()| vec![s.splat_f32s(0.0); vectors]);
        let mut distances = vec![0.0f32; width];
        let mut total = 0.0f64;
        for row in self.rows.clone() {
            for (map, line) in lines.iter_mut().enumerate() {
                let mut window: Window<'_, S> = [None; 2 * HALF + 1];
                fill_window::<S>(&mut window, &filtered, map * count, first..last, row);
                for (v, out) in line.iter_mut().enumerate() {
                    *out = filter_column(s, &window, v);
                }
            }
            let at = row * width;
            let (x, y) = (&self.x[at..at + width], &self.y[at..at + width]);
            let line = |k: usize| &bytemuck::cast_slice::<S::f32s, f32>(&lines[k])[..width];
            let (mu, xx, xy) = (line(0), line(1), line(2));
            let out = &mut self.out[(row - self.rows.start) * width..][..width];
            // Plain loops without a branch: the compiler makes vectors of them.
            for k in 0..width {
                let difference = x[k] - y[k];
                distances[k] = difference.abs();
                let sign = f32::from(difference > 0.0) - f32::from(difference < 0.0);
                out[k] = self.l1 * sign;
            }
            let weights = self.weights.map(|w| &w[at..at + width]);
            if let Some(weights) = weights {
                for (out, weight) in out.iter_mut().zip(weights) {
                    *out *= weight;
                }
            }
            for k in 0..width {
                out[k] -= self.ssim * (mu[k] + 2.0 * x[k] * xx[k] + y[k] * xy[k]);
            }
            total += f64::from(weighted_sum(s, &distances, weights));
        }
        total
    }
}

impl Loss {
    /// Loss of the picture `x` against the photo `y` (three planes each); its gradient is left in
    /// `v_color`.
    pub fn run(
        &mut self,
        x: [&[f32]; 3],
        y: [&[f32]; 3],
        weights: Option<&[f32]>,
        width: usize,
        ssim_weight: f32,
    ) -> f32 {
        let pixels = x[0].len();
        let total: f64 = weights.map_or(pixels as f64, |w| w.iter().map(|&w| f64::from(w)).sum());
        // A photo that is masked out everywhere asks for nothing.
        let scale = if total > 0.0 { 1.0 / (3.0 * total) } else { 0.0 };
        let band = BAND * width;
        let bands =
            |band_index: usize| band_index * BAND..((band_index + 1) * BAND).min(pixels / width);
        for v in &mut self.v_color {
            v.resize(pixels, 0.0);
        }
        for slope in self.slopes.iter_mut().flatten() {
            slope.resize(pixels, 0.0);
        }
        let ssim: f64 = (0..3)
            .into_par_iter()
            .zip(&mut self.slopes)
            .flat_map(|(c, [mu, xx, xy])| {
                mu.par_chunks_mut(band)
                    .zip(xx.par_chunks_mut(band))
                    .zip(xy.par_chunks_mut(band))
                    .enumerate()
                    .map(move |(index, ((mu, xx), xy))| {
                        dispatch(Slopes {
                            x: x[c],
                            y: y[c],
                            weights,
                            width,
                            rows: bands(index),
                            out: [mu, xx, xy],
                        })
                    })
            })
            .collect::<Vec<f64>>()
            .iter()
            .sum();
        let slopes = &self.slopes;
        let l1: f64 = (0..3)
            .into_par_iter()
            .zip(&mut self.v_color)
            .flat_map(|(c, v)| {
                v.par_chunks_mut(band).enumerate().map(move |(index, out)| {
                    dispatch(Gradient {
                        x: x[c],
                        y: y[c],
                        weights,
                        slopes: &slopes[c],
                        width,
                        rows: bands(index),
                        l1: ((1.0 - f64::from(ssim_weight)) * scale) as f32,
                        ssim: (f64::from(ssim_weight) * scale) as f32,
                        out,
                    })
                })
            })
            .collect::<Vec<f64>>()
            .iter()
            .sum();
        let s = f64::from(ssim_weight);
        let whole = if total > 0.0 { s } else { 0.0 };
        ((1.0 - s) * l1 * scale + whole - s * ssim * scale) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    /// The loss in f64, straight from its definition.
    fn plain(
        x: &[Vec<f64>; 3],
        y: &[Vec<f32>; 3],
        weights: Option<&[f32]>,
        width: usize,
        ssim_weight: f64,
    ) -> f64 {
        let height = x[0].len() / width;
        let (c1, c2) = (f64::from(SSIM_C.0), f64::from(SSIM_C.1));
        let (mut sum, mut total) = (0.0, 0.0);
        for row in 0..height {
            for column in 0..width {
                let w = weights.map_or(1.0, |w| f64::from(w[row * width + column]));
                total += w;
                for c in 0..3 {
                    let mut m = [0.0f64; 5];
                    for i in 0..11 {
                        for j in 0..11 {
                            let (r, k) = (row + i, column + j);
                            if r < 5 || k < 5 || r - 5 >= height || k - 5 >= width {
                                continue;
                            }
                            let at = (r - 5) * width + k - 5;
                            let g = f64::from(SSIM_WINDOW[i]) * f64::from(SSIM_WINDOW[j]);
                            let (x, y) = (x[c][at], f64::from(y[c][at]));
                            for (m, v) in m.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                                *m += g * v;
                            }
                        }
                    }
                    let [mx, my, xx, yy, xy] = m;
                    let ssim = (2.0 * mx * my + c1) * (2.0 * (xy - mx * my) + c2)
                        / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2));
                    let at = row * width + column;
                    let l1 = (x[c][at] - f64::from(y[c][at])).abs();
                    sum += w / 3.0 * ((1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim));
                }
            }
        }
        sum / total
    }

    #[test]
    fn loss_and_gradient_match_the_definition() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        for (width, height, weighted) in [(23, 37, false), (40, 9, true), (3, 2, false)] {
            let n = width * height;
            let mut draw = || -> [Vec<f32>; 3] {
                std::array::from_fn(|_| (0..n).map(|_| rng.random::<f32>()).collect())
            };
            let (x, y) = (draw(), draw());
            let weights = weighted.then(|| {
                draw()[0].iter().map(|&w| if w < 0.3 { 0.0 } else { w }).collect::<Vec<f32>>()
            });
            let mut loss = Loss::default();
            let value = loss.run(
                [&x[0], &x[1], &x[2]],
                [&y[0], &y[1], &y[2]],
                weights.as_deref(),
                width,
                0.2,
            );
            let wide = x.clone().map(|p| p.into_iter().map(f64::from).collect::<Vec<f64>>());
            let expected = plain(&wide, &y, weights.as_deref(), width, 0.2);
            assert!((f64::from(value) - expected).abs() < 1e-6, "{value} vs {expected}");
            let largest =
                loss.v_color.iter().flatten().fold(0.0f64, |a, v| a.max(f64::from(v.abs())));
            for pick in 0..20 {
                let (c, at) = (pick % 3, (pick * 7919) % n);
                let h = 1e-6;
                let (mut low, mut high) = (wide.clone(), wide.clone());
                low[c][at] -= h;
                high[c][at] += h;
                let numeric = (plain(&high, &y, weights.as_deref(), width, 0.2)
                    - plain(&low, &y, weights.as_deref(), width, 0.2))
                    / (2.0 * h);
                let got = f64::from(loss.v_color[c][at]);
                assert!(
                    (got - numeric).abs() <= 1e-4 * largest,
                    "{width}x{height} channel {c} pixel {at}: {got} vs {numeric}"
                );
            }
        }
    }

    #[test]
    fn a_photo_masked_out_everywhere_asks_for_nothing() {
        let x = vec![0.3f32; 12];
        let mut loss = Loss::default();
        let value = loss.run([&x; 3], [&x; 3], Some(&[0.0; 12]), 4, 0.2);
        assert_eq!(value, 0.0);
        assert!(loss.v_color.iter().flatten().all(|&v| v == 0.0));
    }
}
