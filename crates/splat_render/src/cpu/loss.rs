//! loss: L1 and D-SSIM of a picture against a photo, with the picture's gradient.
//!
//! One sweep over the rows: SSIM's slopes of a row follow once its window is complete, and its gradient
//! once the slopes around it are. Rings that fit into the cache keep the rows within reach.

use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::simd::dispatch;
use super::ssim_window::{
    Aligned, HALF, SLOTS, STEP, collect, fill_ends, filter, filter_step, many_registers, spread,
    vectors_of_row, window,
};
use crate::constants::SSIM_C;
use crate::stages::{self, Image};
use crate::target::Target;

/// Approximate rows per task: far more than the 4 [`HALF`] extra rows that it reads.
const BAND: usize = 96;

/// The loss's gradient and scratch memory, kept from step to step.
#[derive(Debug, Default)]
pub(super) struct Loss {
    /// Gradient of the loss with respect to each channel of the picture.
    pub v_color: [Vec<f32>; 3],
    /// Scratch memory of finished tasks.
    scratch: Mutex<Vec<Aligned>>,
}

/// A band of rows of one channel.
struct Band<'a> {
    x: &'a [f32],
    photo: &'a Target,
    channel: usize,
    /// Background behind a photo with alpha.
    background: f32,
    rows: Range<usize>,
    /// Weights of one unit of |x - y| and of SSIM in the loss.
    l1: f32,
    ssim: f32,
    scratch: &'a mut Aligned,
    out: &'a mut [f32],
}

/// Maps of a ring of pictures: the picture and the photo, zero beyond them.
const PICTURES: usize = 2;
/// Maps of a ring of slopes of the loss by the filtered x (negated), xx (halved) and xy (negated).
const SLOPES: usize = 3;
/// Filtered maps for SSIM: x, y, xx + yy and xy; only the sum of the variances is needed.
const MEANS: usize = 4;

/// A band's scratch memory. Rings have all rows of a vector side by side.
struct Memory<'a, V> {
    vectors: usize,
    pictures: &'a mut [[V; SLOTS]],
    slopes: &'a mut [[V; SLOTS]],
    /// [`STEP`] rows of [`MEANS`] maps, filtered along columns, padded by [`HALF`] vectors.
    filtered: &'a mut [V],
    gradient: &'a mut [V],
    /// A row as it lies in a picture, zero beyond its width.
    row: &'a mut [V],
    /// A row's weights, zero beyond its width.
    weights: &'a mut [V],
}

impl<'a, V: bytemuck::Pod> Memory<'a, V> {
    #[inline(always)]
    fn new<S: Simd<f32s = V>>(s: S, scratch: &'a mut Aligned, width: usize) -> Self {
        let vectors = vectors_of_row::<S>(width);
        let padded = vectors + 2 * HALF;
        let parts = [
            vectors * PICTURES * SLOTS,
            vectors * SLOPES * SLOTS,
            padded * MEANS * STEP,
            vectors,
            vectors,
            vectors,
        ];
        let all = scratch.vectors::<S>(parts.iter().sum());
        let (pictures, all) = all.split_at_mut(parts[0]);
        let (slopes, all) = all.split_at_mut(parts[1]);
        let (filtered, all) = all.split_at_mut(parts[2]);
        let (gradient, all) = all.split_at_mut(parts[3]);
        let (row, weights) = all.split_at_mut(parts[4]);
        row.fill(s.splat_f32s(0.0));
        let mut memory = Self {
            vectors,
            pictures: pictures.as_chunks_mut().0,
            slopes: slopes.as_chunks_mut().0,
            filtered,
            gradient,
            row,
            weights,
        };
        // The weights of a photo without weights.
        let values = memory.row();
        values[..width].fill(1.0);
        memory.put_weights::<S>();
        memory.row()[..width].fill(0.0);
        memory
    }

    /// The row as it lies in a picture.
    #[inline(always)]
    fn row(&mut self) -> &mut [f32] {
        bytemuck::cast_slice_mut(self.row)
    }

    /// Row `row` of filtered map `map`, with the vectors before and after it.
    #[inline(always)]
    fn filtered(&mut self, map: usize, row: usize) -> &mut [V] {
        let padded = self.vectors + 2 * HALF;
        &mut self.filtered[(map * STEP + row) * padded..][..padded]
    }

    /// Puts `row` into a slot of the pictures' ring.
    #[inline(always)]
    fn put<S: Simd<f32s = V>>(&mut self, map: usize, slot: usize) {
        let row = bytemuck::cast_slice::<V, f32>(self.row);
        let ring = bytemuck::cast_slice_mut::<V, f32>(self.pictures.as_flattened_mut());
        let at = (map * SLOTS + slot) * S::F32_LANES;
        spread::<S>(row, &mut ring[at..], PICTURES * SLOTS * S::F32_LANES);
    }

    #[inline(always)]
    fn put_weights<S: Simd<f32s = V>>(&mut self) {
        let row = bytemuck::cast_slice::<V, f32>(self.row);
        spread::<S>(row, bytemuck::cast_slice_mut(self.weights), S::F32_LANES);
    }
}

impl WithSimd for Band<'_> {
    /// Weighted sums of SSIM and of |x - y| over the band.
    type Output = [f64; 2];

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, s: S) -> [f64; 2] {
        let mut scratch = std::mem::take(self.scratch);
        let mut memory = Memory::new(s, &mut scratch, self.photo.width as usize);
        let mut sums = [0.0; 2];
        for at in (0..self.rows.len() + 4 * HALF).step_by(STEP) {
            self.take_in::<S>(&mut memory, at);
            // The first steps only fill the rings.
            if at + STEP > 2 * HALF + 1 {
                sums[0] += self.slopes(s, &mut memory, at);
            }
            if at >= 4 * HALF {
                sums[1] += self.gradient(s, &mut memory, at);
            }
        }
        *self.scratch = scratch;
        sums
    }
}

/// The sweep. Rows count from the first one within reach, 2 [`HALF`] before the band. The step at row
/// `at` takes in rows from `at` on, slopes of rows HALF before, and gradients 2 HALF before.
impl Band<'_> {
    /// The picture's row that a sweep's row is, if there is one.
    #[inline(always)]
    fn row(&self, of_sweep: usize) -> Option<usize> {
        (self.rows.start + of_sweep)
            .checked_sub(2 * HALF)
            .filter(|&row| row < self.photo.height as usize)
    }

    /// Takes the next rows into the pictures' ring.
    #[inline(always)]
    fn take_in<S: Simd>(&self, memory: &mut Memory<'_, S::f32s>, at: usize) {
        let width = self.photo.width as usize;
        for row_of_sweep in at..at + STEP {
            let slot = row_of_sweep % SLOTS;
            let Some(row) = self.row(row_of_sweep) else {
                for ring in memory.pictures.iter_mut() {
                    ring[slot] = bytemuck::Zeroable::zeroed();
                }
                continue;
            };
            memory.row()[..width].copy_from_slice(&self.x[row * width..][..width]);
            memory.put::<S>(0, slot);
            let values = &mut memory.row()[..width];
            self.photo.row(row, self.channel, self.background, values);
            memory.put::<S>(1, slot);
        }
    }

    #[inline(always)]
    fn weigh<S: Simd>(&self, memory: &mut Memory<'_, S::f32s>, row: usize) {
        if let Some(weights) = &self.photo.weights {
            let width = self.photo.width as usize;
            memory.row()[..width].copy_from_slice(&weights[row * width..][..width]);
            memory.put_weights::<S>();
        }
    }

    /// Computes the next rows of slopes; returns the weighted sum of SSIM over the band's rows.
    #[inline(always)]
    fn slopes<S: Simd>(&self, s: S, memory: &mut Memory<'_, S::f32s>, at: usize) -> f64 {
        let vectors = memory.vectors;
        for k in 0..vectors {
            let rings = &memory.pictures[PICTURES * k..][..PICTURES];
            let mut x = window::<S>(&rings[0], at + SLOTS - 2 * HALF);
            let mut y = window::<S>(&rings[1], at + SLOTS - 2 * HALF);
            let (mu_x, mu_y) = (filter_step(s, &x), filter_step(s, &y));
            for j in 0..x.len() {
                let squares = s.mul_add_e_f32s(x[j], x[j], s.mul_f32s(y[j], y[j]));
                (x[j], y[j]) = (squares, s.mul_f32s(x[j], y[j]));
            }
            let (squares, xy) = (filter_step(s, &x), filter_step(s, &y));
            for row in 0..STEP {
                memory.filtered(0, row)[HALF + k] = mu_x[row];
                memory.filtered(1, row)[HALF + k] = mu_y[row];
                memory.filtered(2, row)[HALF + k] = squares[row];
                memory.filtered(3, row)[HALF + k] = xy[row];
            }
        }
        let mut total = 0.0;
        for row in 0..STEP {
            // The sweep's row, in the rings since SLOTS rows at most.
            let of_sweep = at + row + SLOTS - HALF;
            let slot = of_sweep % SLOTS;
            let Some(own) = self.row(of_sweep - SLOTS) else {
                for ring in memory.slopes.iter_mut() {
                    ring[slot] = bytemuck::Zeroable::zeroed();
                }
                continue;
            };
            self.weigh::<S>(memory, own);
            for map in 0..MEANS {
                fill_ends(s, memory.filtered(map, row));
            }
            let mut sum = s.splat_f32s(0.0);
            let mut k = 0;
            while many_registers::<S>() && k + STEP <= vectors {
                slopes_of::<S, STEP>(s, self.ssim, memory, row, slot, k, &mut sum);
                k += STEP;
            }
            while k + 2 <= vectors {
                slopes_of::<S, 2>(s, self.ssim, memory, row, slot, k, &mut sum);
                k += 2;
            }
            if k < vectors {
                slopes_of::<S, 1>(s, self.ssim, memory, row, slot, k, &mut sum);
            }
            if self.rows.contains(&own) {
                total += f64::from(s.reduce_sum_f32s(sum));
            }
        }
        total
    }

    /// Writes the next rows of the gradient; returns the weighted sum of |x - y| over the band's rows.
    #[inline(always)]
    fn gradient<S: Simd>(&mut self, s: S, memory: &mut Memory<'_, S::f32s>, at: usize) -> f64 {
        let (vectors, width) = (memory.vectors, self.photo.width as usize);
        let first = at - 4 * HALF;
        let rows = STEP.min(self.rows.len() - first);
        for k in 0..vectors {
            for map in 0..SLOPES {
                let rows = window::<S>(&memory.slopes[SLOPES * k + map], at + SLOTS - 3 * HALF);
                let rows = filter_step(s, &rows);
                for row in 0..STEP {
                    memory.filtered(map, row)[HALF + k] = rows[row];
                }
            }
        }
        let mut total = 0.0;
        for row in 0..rows {
            let slot = (at + row + SLOTS - 2 * HALF) % SLOTS;
            self.weigh::<S>(memory, self.rows.start + first + row);
            for map in 0..SLOPES {
                fill_ends(s, memory.filtered(map, row));
            }
            let mut sum = s.splat_f32s(0.0);
            let mut k = 0;
            while many_registers::<S>() && k + STEP <= vectors {
                self.gradient_of::<S, STEP>(s, memory, row, slot, k, &mut sum);
                k += STEP;
            }
            while k + 2 <= vectors {
                self.gradient_of::<S, 2>(s, memory, row, slot, k, &mut sum);
                k += 2;
            }
            if k < vectors {
                self.gradient_of::<S, 1>(s, memory, row, slot, k, &mut sum);
            }
            total += f64::from(s.reduce_sum_f32s(sum));
            let values = bytemuck::cast_slice_mut::<S::f32s, f32>(memory.row);
            collect::<S>(bytemuck::cast_slice(memory.gradient), values);
            self.out[(first + row) * width..][..width].copy_from_slice(&values[..width]);
            values[width..].fill(0.0);
        }
        total
    }

    /// `N` vectors of a row's gradient, from `k` on; adds w |x - y| to `sum`.
    #[inline(always)]
    fn gradient_of<S: Simd, const N: usize>(
        &self,
        s: S,
        memory: &mut Memory<'_, S::f32s>,
        row: usize,
        slot: usize,
        k: usize,
        sum: &mut S::f32s,
    ) {
        let mu = filter::<S, N>(s, &memory.filtered(0, row)[k..]);
        let xx = filter::<S, N>(s, &memory.filtered(1, row)[k..]);
        let xy = filter::<S, N>(s, &memory.filtered(2, row)[k..]);
        let (l1, minus_l1) = (s.splat_f32s(self.l1), s.splat_f32s(-self.l1));
        let zero = s.splat_f32s(0.0);
        let rings = &memory.pictures[PICTURES * k..][..PICTURES * N];
        let weights = &memory.weights[k..][..N];
        let out = &mut memory.gradient[k..][..N];
        for j in 0..N {
            let (x, y) = (rings[PICTURES * j][slot], rings[PICTURES * j + 1][slot]);
            let weight = weights[j];
            let difference = s.sub_f32s(x, y);
            let distance = s.max_f32s(difference, s.sub_f32s(y, x));
            *sum = s.mul_add_e_f32s(distance, weight, *sum);
            // |x - y| has slope 0 at 0.
            let below = s.less_than_f32s(difference, zero);
            let sign = s.select_f32s(below, minus_l1, zero);
            let sign = s.select_f32s(s.greater_than_f32s(difference, zero), l1, sign);
            let v = s.mul_add_e_f32s(x, xx[j], s.mul_f32s(sign, weight));
            out[j] = s.sub_f32s(s.negate_mul_add_e_f32s(y, xy[j], v), mu[j]);
        }
    }
}

/// Computes `N` vectors of slopes from vector `k` on, at SSIM's weight `unit`; adds w SSIM to `sum`.
#[inline(always)]
fn slopes_of<S: Simd, const N: usize>(
    s: S,
    unit: f32,
    memory: &mut Memory<'_, S::f32s>,
    row: usize,
    slot: usize,
    k: usize,
    sum: &mut S::f32s,
) {
    let mu_x = filter::<S, N>(s, &memory.filtered(0, row)[k..]);
    let mu_y = filter::<S, N>(s, &memory.filtered(1, row)[k..]);
    let squares = filter::<S, N>(s, &memory.filtered(2, row)[k..]);
    let xy = filter::<S, N>(s, &memory.filtered(3, row)[k..]);
    let (c1, c2) = (s.splat_f32s(SSIM_C.0), s.splat_f32s(SSIM_C.1));
    let (one, two, twice) = (s.splat_f32s(1.0), s.splat_f32s(2.0), s.splat_f32s(2.0 * unit));
    let weights = &memory.weights[k..][..N];
    let slopes = &mut memory.slopes[SLOPES * k..][..SLOPES * N];
    for j in 0..N {
        let (mu_x, mu_y, weight) = (mu_x[j], mu_y[j], weights[j]);
        let mu_xy = s.mul_f32s(mu_x, mu_y);
        let mu_squares = s.mul_add_e_f32s(mu_x, mu_x, s.mul_f32s(mu_y, mu_y));
        let s_xy = s.sub_f32s(xy[j], mu_xy);
        let s_sum = s.sub_f32s(squares[j], mu_squares);
        let a1 = s.mul_add_e_f32s(two, mu_xy, c1);
        let a2 = s.mul_add_e_f32s(two, s_xy, c2);
        let b1 = s.add_f32s(mu_squares, c1);
        let b2 = s.add_f32s(s_sum, c2);
        let inverse = s.div_f32s(one, s.mul_f32s(b1, b2));
        let ssim = s.mul_f32s(s.mul_f32s(a1, a2), inverse);
        *sum = s.mul_add_e_f32s(ssim, weight, *sum);
        // d/d mu_x directly, 2 mu_y a2 - 2 mu_x b2 ssim, and through s_xx = xx - mu_x^2 and
        // s_xy = xy - mu_x mu_y.
        let scale = s.mul_f32s(s.mul_f32s(twice, weight), inverse);
        let v_mu = s.mul_f32s(s.mul_f32s(mu_x, ssim), s.sub_f32s(b1, b2));
        let v_mu = s.mul_add_e_f32s(mu_y, s.sub_f32s(a2, a1), v_mu);
        let v_xx = s.mul_f32s(ssim, b1);
        slopes[SLOPES * j][slot] = s.mul_f32s(v_mu, scale);
        slopes[SLOPES * j + 1][slot] = s.mul_f32s(v_xx, scale);
        slopes[SLOPES * j + 2][slot] = s.mul_f32s(a1, scale);
    }
}

/// Rows per band. Depends only on the picture's height, so that sums do not depend on the threads.
fn rows_of_bands(height: usize) -> usize {
    let bands = ((height + BAND / 2) / BAND).max(1);
    height.div_ceil(bands).next_multiple_of(STEP)
}

impl Loss {
    /// Loss of the picture `x`, three planes, against the photo; its gradient is left in `v_color`.
    pub fn run(
        &mut self,
        x: [&[f32]; 3],
        photo: &Target,
        background: [f32; 3],
        ssim_weight: f32,
    ) -> f32 {
        let width = photo.width as usize;
        let weight = photo.weight();
        let scale = weight.scale();
        let (l1, ssim) = (1.0 - f64::from(ssim_weight), f64::from(ssim_weight));
        let rows = rows_of_bands(photo.height as usize);
        for v in &mut self.v_color {
            v.resize(x[0].len(), 0.0);
        }
        let pool = &self.scratch;
        let sums: Vec<[f64; 2]> = (0..3)
            .into_par_iter()
            .zip(&mut self.v_color)
            .flat_map(|(channel, v)| {
                v.par_chunks_mut(rows * width).enumerate().map(move |(band, out)| {
                    let mut scratch = lock(pool).pop().unwrap_or_default();
                    let sums = dispatch(Band {
                        x: x[channel],
                        photo,
                        channel,
                        background: background[channel],
                        rows: band * rows..band * rows + out.len() / width,
                        l1: (l1 * scale) as f32,
                        ssim: (ssim * scale) as f32,
                        scratch: &mut scratch,
                        out,
                    });
                    lock(pool).push(scratch);
                    sums
                })
            })
            .collect();
        let [sum_ssim, sum_l1] = [0, 1].map(|k| sums.iter().map(|sums| sums[k]).sum::<f64>());
        weight.loss(ssim, sum_l1, sum_ssim) as f32
    }
}

/// A task that failed leaves scratch memory that is as good as any.
fn lock(pool: &Mutex<Vec<Aligned>>) -> MutexGuard<'_, Vec<Aligned>> {
    pool.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(super) fn loss(
    image: &Image<f32>,
    target: &Target,
    background: [f32; 3],
    ssim_weight: f32,
) -> stages::Loss<f32> {
    let picture: [Vec<f32>; 3] =
        std::array::from_fn(|c| image.color.iter().map(|color| color[c]).collect());
    let mut loss = Loss::default();
    let planes = picture.each_ref().map(|plane| plane.as_slice());
    let value = loss.run(planes, target, background, ssim_weight);
    let [r, g, b] = &loss.v_color;
    let v_color = (0..r.len()).map(|pixel| [r[pixel], g[pixel], b[pixel]]).collect();
    stages::Loss { value, v_color }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    /// Also with scratch memory from pictures of other sizes.
    #[test]
    fn threads_and_earlier_pictures_change_no_bit() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        let photos = [(70, 300, true), (7, 20, false), (333, 150, false)];
        let photos = photos.map(|(width, height, weighted)| {
            let pixels = (width * height) as usize;
            let colors = (0..3 * pixels).map(|_| rng.random()).collect();
            let weights = weighted.then(|| (0..pixels).map(|_| rng.random()).collect());
            Target { weights, ..Target::new(width, height, 3, colors) }
        });
        let x: Vec<f32> = (0..333 * 150).map(|_| rng.random()).collect();
        let run = |threads: usize, kept: bool| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut loss = Loss::default();
            photos.each_ref().map(|photo| {
                if !kept {
                    loss = Loss::default();
                }
                let x = &x[..photo.pixels.len() / 3];
                let value = pool.install(|| loss.run([x; 3], photo, [0.0; 3], 0.2));
                (value.to_bits(), loss.v_color.clone())
            })
        };
        let expected = run(1, false);
        for threads in 1..=8 {
            assert!(run(threads, true) == expected, "{threads} threads give other bits");
        }
    }
}
