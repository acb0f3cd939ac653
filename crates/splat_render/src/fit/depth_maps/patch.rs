//! The correlation of a patch of a photo with its image in another photo.

use glam::Vec3;

/// Samples of a patch, at every second pixel up to `RADIUS` away; its corners are left out.
const SAMPLES: usize = 32;
const RADIUS: usize = 5;
const OFFSETS: [[f32; SAMPLES]; 2] = offsets();
/// Vectors of sums.
const LANES: usize = 8;
/// Samples count less by their distance and by their difference from the patch's center (bilateral
/// weights), with these deviations in pixels and gray levels: they may be on another surface.
const SPACE_PX: f32 = 5.0;
const GRAY: f32 = 16.0;
/// Variance of gray levels (0..255) that noise has: patches of less have no texture and score near 0.
const NOISE: f32 = 0.5;
/// Fraction of the patch's weight that must be visible in another photo.
const MIN_SEEN: f32 = 0.6;
/// The score of a patch that another photo does not see.
pub const UNSEEN: f32 = -1.0;

const fn offsets() -> [[f32; SAMPLES]; 2] {
    let mut out = [[0.0; SAMPLES]; 2];
    let (mut cell, mut count) = (0, 0);
    while cell < 36 {
        let (column, row) = (cell % 6, cell / 6);
        if !((column == 0 || column == 5) && (row == 0 || row == 5)) {
            out[0][count] = 2.0 * column as f32 - RADIUS as f32;
            out[1][count] = 2.0 * row as f32 - RADIUS as f32;
            count += 1;
        }
        cell += 1;
    }
    out
}

/// A photo's gray levels 1..=255, prepared for patches; 0 for pixels that do not count.
pub struct Texture {
    width: usize,
    height: usize,
    /// `[(H + 2 RADIUS) * (W + 2 RADIUS)]`, 0 around the photo.
    padded: Vec<u8>,
    /// `[(H + 1) * (W + 1)]` gray of the pixels (x, y), (x + 1, y), (x, y + 1) and (x + 1, y + 1) from
    /// (-1, -1) on, one byte each: a single load for an interpolated sample.
    quads: Vec<u32>,
    offsets: [usize; SAMPLES],
    /// Weight by difference from the center.
    by_gray: [f32; 256],
    by_place: [f32; SAMPLES],
}

impl Texture {
    /// From `[H * W]` gray levels.
    pub fn new(gray: &[u8], width: usize, height: usize) -> Self {
        let stride = width + 2 * RADIUS;
        let mut padded = vec![0; stride * (height + 2 * RADIUS)];
        for (row, values) in gray.chunks_exact(width).enumerate() {
            padded[(row + RADIUS) * stride + RADIUS..][..width].copy_from_slice(values);
        }
        let quad = |i: usize| {
            let (row, column) = (i / (width + 1), i % (width + 1));
            let at = (row + RADIUS - 1) * stride + column + RADIUS - 1;
            u32::from_le_bytes([0, 1, stride, stride + 1].map(|step| padded[at + step]))
        };
        let quads = (0..(width + 1) * (height + 1)).map(quad).collect();
        let [x, y] = OFFSETS;
        let first = RADIUS as f32;
        let offsets = |i: usize| (y[i] + first) as usize * stride + (x[i] + first) as usize;
        Self {
            width,
            height,
            quads,
            padded,
            offsets: std::array::from_fn(offsets),
            by_gray: std::array::from_fn(|d| (-0.5 * (d as f32 / GRAY).powi(2)).exp()),
            by_place: std::array::from_fn(|i| {
                (-0.5 * (x[i] * x[i] + y[i] * y[i]) / (SPACE_PX * SPACE_PX)).exp()
            }),
        }
    }

    /// Whether a pixel counts.
    pub fn counts(&self, pixel: usize) -> bool {
        let (row, column) = (pixel / self.width, pixel % self.width);
        self.padded[(row + RADIUS) * (self.width + 2 * RADIUS) + column + RADIUS] > 0
    }
}

/// The samples about a pixel.
pub struct Patch {
    /// Relative to the center.
    gray: [f32; SAMPLES],
    center: f32,
    weight: [f32; SAMPLES],
    total: f32,
}

impl Patch {
    #[inline(always)]
    pub fn at(texture: &Texture, column: usize, row: usize) -> Self {
        let stride = texture.width + 2 * RADIUS;
        let around = &texture.padded[row * stride + column..];
        let center = around[RADIUS * stride + RADIUS];
        let (mut gray, mut weight, mut total) = ([0.0; SAMPLES], [0.0; SAMPLES], 0.0);
        for i in 0..SAMPLES {
            let one = around[texture.offsets[i]];
            let counts = if one > 0 { texture.by_place[i] } else { 0.0 };
            weight[i] = counts * texture.by_gray[usize::from(one.abs_diff(center))];
            gray[i] = f32::from(one) - f32::from(center);
            total += weight[i];
        }
        Self { gray, center: f32::from(center), weight, total }
    }

    /// Zero-mean normalized cross-correlation with another photo, in -1..=1.
    ///
    /// `at` is the homogeneous image of the center, `dx` and `dy` are its changes per pixel; (0, 0) is the
    /// center of the first pixel.
    #[inline(always)]
    pub fn correlation(&self, other: &Texture, at: Vec3, dx: Vec3, dy: Vec3) -> f32 {
        // Adding 1.5 * 2^23 leaves the nearest integer in the low mantissa bits.
        const ROUND: f32 = 12_582_912.0;
        let stride = other.width as u32 + 1;
        let (most_x, most_y) = (other.width as f32 - 0.01, other.height as f32 - 0.01);
        let (mut index, mut right, mut down) = ([0; SAMPLES], [0.0; SAMPLES], [0.0; SAMPLES]);
        let [ox, oy] = &OFFSETS;
        for i in 0..SAMPLES {
            let z = at.z + ox[i] * dx.z + oy[i] * dy.z;
            let scale = 1.0 / z;
            let x = (at.x + ox[i] * dx.x + oy[i] * dy.x) * scale;
            let y = (at.y + ox[i] * dx.y + oy[i] * dy.y) * scale;
            // Samples behind the camera fall outside.
            let x = if z > 1e-6 { x } else { -1.0 };
            let (x, y) = (x.max(-0.99).min(most_x), y.max(-0.99).min(most_y));
            let (left, upper) = (x - 0.5 + ROUND, y - 0.5 + ROUND);
            right[i] = x - (left - ROUND);
            down[i] = y - (upper - ROUND);
            let column = left.to_bits().wrapping_sub(ROUND.to_bits() - 1);
            let row = upper.to_bits().wrapping_sub(ROUND.to_bits() - 1);
            index[i] = row.wrapping_mul(stride).wrapping_add(column);
        }
        let mut quads = [0u32; SAMPLES];
        for i in 0..SAMPLES {
            quads[i] = other.quads.get(index[i] as usize).copied().unwrap_or(0);
        }
        let mut sums = [[0.0f32; LANES]; 6];
        for first in (0..SAMPLES).step_by(LANES) {
            for lane in 0..LANES {
                let i = first + lane;
                let quad = quads[i];
                let has_zero = quad.wrapping_sub(0x0101_0101) & !quad & 0x8080_8080;
                let weight = if has_zero == 0 { self.weight[i] } else { 0.0 };
                let gray = |shift: u32| ((quad >> shift) & 255) as i32 as f32;
                let upper = gray(0) + (gray(8) - gray(0)) * right[i];
                let lower = gray(16) + (gray(24) - gray(16)) * right[i];
                let theirs = upper + (lower - upper) * down[i] - self.center;
                let (ours, weighted) = (self.gray[i], weight * theirs);
                sums[0][lane] += weight;
                sums[1][lane] += weight * ours;
                sums[2][lane] += weight * ours * ours;
                sums[3][lane] += weighted;
                sums[4][lane] += weighted * theirs;
                sums[5][lane] += weighted * ours;
            }
        }
        let mut total = [0.0; 6];
        for (total, lanes) in total.iter_mut().zip(&sums) {
            let halves: [f32; 4] = std::array::from_fn(|i| lanes[i] + lanes[i + 4]);
            *total = (halves[0] + halves[2]) + (halves[1] + halves[3]);
        }
        let [weight, ours, ours2, theirs, theirs2, both] = total;
        if weight <= MIN_SEEN * self.total {
            return UNSEEN;
        }
        let scale = 1.0 / weight;
        let (ours, theirs) = (ours * scale, theirs * scale);
        let own_variance = (ours2 * scale - ours * ours).max(0.0) + NOISE;
        let variance = (theirs2 * scale - theirs * theirs).max(0.0) + NOISE;
        (both * scale - ours * theirs) / (own_variance * variance).sqrt()
    }
}
