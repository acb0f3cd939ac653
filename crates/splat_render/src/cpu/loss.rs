//! loss: L1 and D-SSIM of a picture against a photo, with the picture's gradient.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::simd::dispatch;
use super::ssim_window::{HALF, RUN, Rows};
use crate::constants::SSIM_C;
use crate::stages::{self, Image};
use crate::target::{Target, Weight};

/// Rows per task.
const BAND: usize = 64;

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

/// The picture's rows that the window meets around `rows`, each with its index in a [`Rows`].
fn rows_around(
    rows: &std::ops::Range<usize>,
    height: usize,
) -> impl Iterator<Item = (usize, usize)> + use<> {
    let start = rows.start;
    (start.saturating_sub(HALF)..(rows.end + HALF).min(height))
        .map(move |row| (row + HALF - start, row))
}

impl WithSimd for Slopes<'_> {
    /// Weighted sum of SSIM over the band.
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f64 {
        let width = self.width;
        // x, y, xx + yy and xy: SSIM takes the two variances only as a sum.
        let mut filtered = Rows::new(4, self.rows.len(), width);
        let [mut x, mut y, mut squares, mut xy] = [(); 4].map(|()| filtered.padded());
        for (index, row) in rows_around(&self.rows, self.x.len() / width) {
            let at = row * width..(row + 1) * width;
            let (from_x, from_y) = (&self.x[at.clone()], &self.y[at]);
            x.row(width).copy_from_slice(from_x);
            y.row(width).copy_from_slice(from_y);
            let products = squares.row(width).iter_mut().zip(xy.row(width));
            for ((squares, xy), (x, y)) in products.zip(from_x.iter().zip(from_y)) {
                (*squares, *xy) = (x * x + y * y, x * y);
            }
            for (map, padded) in [&x, &y, &squares, &xy].into_iter().enumerate() {
                filtered.filter_row(s, padded, map, index);
            }
        }
        let (c1, c2) = (s.splat_f32s(SSIM_C.0), s.splat_f32s(SSIM_C.1));
        let two = s.splat_f32s(2.0);
        let mut lines = [(); 4].map(|()| filtered.line(s));
        let mut total = 0.0f64;
        let [out_mu, out_xx, out_xy] = self.out;
        for row in self.rows.clone() {
            for (map, line) in lines.iter_mut().enumerate() {
                filtered.filter_column(s, map, row - self.rows.start, line);
            }
            // Each line's filtered map gives way to what becomes of it.
            let [mu_line, xx_line, xy_line, ssim_line] = &mut lines;
            let n = mu_line.len() * RUN;
            let mu_line = &mut mu_line.as_flattened_mut()[..n];
            let xx_line = &mut xx_line.as_flattened_mut()[..n];
            let xy_line = &mut xy_line.as_flattened_mut()[..n];
            let ssim_line = &mut ssim_line.as_flattened_mut()[..n];
            for k in 0..n {
                let (mu_x, mu_y) = (mu_line[k], xx_line[k]);
                let (squares, xy) = (xy_line[k], ssim_line[k]);
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
                mu_line[k] = s.sub_f32s(s.mul_f32s(two, direct), through);
                xx_line[k] = v_xx;
                xy_line[k] = v_xy;
                ssim_line[k] = ssim;
            }
            let to = (row - self.rows.start) * width;
            let at = row * width;
            let weights = self.weights.map(|w| &w[at..at + width]);
            let line =
                |k: usize| &bytemuck::cast_slice::<S::f32s, f32>(lines[k].as_flattened())[..width];
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
        let mut filtered = Rows::new(3, self.rows.len(), width);
        let mut padded = filtered.padded();
        for (map, slopes) in self.slopes.iter().enumerate() {
            for (index, row) in rows_around(&self.rows, self.x.len() / width) {
                padded.row(width).copy_from_slice(&slopes[row * width..(row + 1) * width]);
                filtered.filter_row(s, &padded, map, index);
            }
        }
        let mut lines = [(); 3].map(|()| filtered.line(s));
        let mut distances = vec![0.0f32; width];
        let mut total = 0.0f64;
        for row in self.rows.clone() {
            for (map, line) in lines.iter_mut().enumerate() {
                filtered.filter_column(s, map, row - self.rows.start, line);
            }
            let at = row * width;
            let (x, y) = (&self.x[at..at + width], &self.y[at..at + width]);
            let line =
                |k: usize| &bytemuck::cast_slice::<S::f32s, f32>(lines[k].as_flattened())[..width];
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
        let all = Weight { sum: pixels as f64, count: pixels as f64 };
        let weight = weights.map_or(all, Weight::of);
        let scale = weight.scale();
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
                (mu.par_chunks_mut(band), xx.par_chunks_mut(band), xy.par_chunks_mut(band))
                    .into_par_iter()
                    .enumerate()
                    .map(move |(index, (mu, xx, xy))| {
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
        weight.loss(f64::from(ssim_weight), l1, ssim) as f32
    }
}

pub(super) fn loss(
    image: &Image<f32>,
    target: &Target,
    background: [f32; 3],
    ssim_weight: f32,
) -> stages::Loss<f32> {
    let picture: [Vec<f32>; 3] =
        std::array::from_fn(|c| image.color.iter().map(|color| color[c]).collect());
    let mut photo: [Vec<f32>; 3] = Default::default();
    target.composite(background, &mut photo);
    let mut loss = Loss::default();
    let value = loss.run(
        picture.each_ref().map(|plane| plane.as_slice()),
        photo.each_ref().map(|plane| plane.as_slice()),
        target.weights.as_deref(),
        image.width as usize,
        ssim_weight,
    );
    let [r, g, b] = &loss.v_color;
    let v_color = (0..r.len()).map(|pixel| [r[pixel], g[pixel], b[pixel]]).collect();
    stages::Loss { value, v_color }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::constants::SSIM_WINDOW;
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
                total += f64::from(u8::from(w > 0.0));
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
