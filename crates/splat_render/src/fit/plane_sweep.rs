//! Depth maps of photos by plane sweep (Collins 1996), scored by zero-mean normalized
//! cross-correlation, which a photo's exposure does not change.

use glam::{DMat3, DVec3};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::cpu::dispatch;
use crate::error::{Error, Result};

/// Patches that are compared have a side of `2 * RADIUS + 1` pixels.
const RADIUS: usize = 3;
/// Variance of gray (0..1) that noise has: patches of less have no texture, and score near 0.
const NOISE: f32 = 1e-4;
/// A depth's score is the mean over this many best photos, since some may not see the surface.
const BEST: usize = 2;

/// A photo to sweep, or to compare with.
#[derive(Debug, Clone)]
pub struct GrayPhoto {
    /// Its camera.
    pub camera: Camera,
    /// `[H * W]` gray in 0..1, row-major.
    pub gray: Vec<f32>,
    /// `[H * W]` which pixels count, or None for all.
    pub usable: Option<Vec<bool>>,
}

/// Result of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// `[H * W]` 1 / z-depth with the best score.
    pub inverse_depth: Vec<f32>,
    /// `[H * W]` correlation in -1..=1; -1 if no other photo sees any of the depths.
    pub score: Vec<f32>,
}

/// A depth map to compute.
#[derive(Debug, Clone)]
pub struct Sweep {
    /// Index of the photo.
    pub photo: usize,
    /// Indices of the photos to compare with.
    pub others: Vec<usize>,
    /// The inverse depths of the nearest and the farthest plane.
    pub range: [f32; 2],
    /// Number of planes, evenly spaced in inverse depth.
    pub planes: usize,
}

/// The depth map of each sweep's photo. The same on any number of threads.
pub fn plane_sweep(photos: &[GrayPhoto], sweeps: &[Sweep]) -> Result<Vec<DepthMap>> {
    for (k, photo) in photos.iter().enumerate() {
        photo.camera.validate()?;
        let pixels = photo.camera.width as usize * photo.camera.height as usize;
        let usable = photo.usable.as_ref().map_or(pixels, Vec::len);
        if photo.gray.len() != pixels || usable != pixels {
            return Err(Error::argument(format!("photos[{k}]"), "does not fit its camera's size"));
        }
        if !photo.gray.iter().all(|v| v.abs() <= 1.0) {
            return Err(Error::argument(format!("photos[{k}]"), "has gray outside of 0..1"));
        }
    }
    for (k, sweep) in sweeps.iter().enumerate() {
        let bad = |reason: &str| Err(Error::argument(format!("sweeps[{k}]"), reason));
        if sweep.others.iter().chain([&sweep.photo]).any(|&index| index >= photos.len()) {
            return bad("names a photo that does not exist");
        }
        if sweep.planes < 2 || !sweep.range.iter().all(|v| v.is_finite() && *v > 0.0) {
            return bad("needs at least two planes at finite depths above 0");
        }
    }
    Ok(sweeps.par_iter().map(|sweep| dispatch(Sweeping { photos, sweep })).collect())
}

/// Compiled for the machine's widest instruction set; plain loops, which compilers vectorize.
struct Sweeping<'a> {
    photos: &'a [GrayPhoto],
    sweep: &'a Sweep,
}

impl WithSimd for Sweeping<'_> {
    type Output = DepthMap;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> DepthMap {
        let Self { photos, sweep } = self;
        let photo = &photos[sweep.photo];
        let (width, height) = (photo.camera.width as usize, photo.camera.height as usize);
        let pixels = width * height;
        let mut boxes = Boxes::new(width, height);
        let own = Patches::of(&photo.gray, &mut boxes);
        let mut best = Best::new(pixels);
        let [near, far] = sweep.range;
        let gap = (far - near) / (sweep.planes - 1) as f32;
        let mut warped = Warped { gray: vec![0.0; pixels], seen: vec![0.0; pixels] };
        let mut top: [Vec<f32>; BEST] = std::array::from_fn(|_| vec![0.0; pixels]);
        for plane in 0..sweep.planes {
            top.iter_mut().for_each(|scores| scores.fill(-1.0));
            for &other in &sweep.others {
                let warp = Warp::new(&photo.camera, &photos[other]);
                warp.run(near + gap * plane as f32, width, &mut warped);
                own.correlate(&photo.gray, &warped, &mut boxes, &mut top);
            }
            best.take(plane as u32, &top);
        }
        let inverse_depth = (0..pixels)
            .map(|pixel| near + gap * (best.plane[pixel] as f32 + best.between_planes(pixel)))
            .collect();
        DepthMap { inverse_depth, score: best.score }
    }
}

/// The best depth so far of each pixel, and its neighbors' scores.
struct Best {
    score: Vec<f32>,
    plane: Vec<u32>,
    before: Vec<f32>,
    after: Vec<f32>,
    last: Vec<f32>,
}

impl Best {
    fn new(pixels: usize) -> Self {
        let unseen = || vec![-1.0; pixels];
        Self {
            score: unseen(),
            plane: vec![0; pixels],
            before: unseen(),
            after: unseen(),
            last: unseen(),
        }
    }

    /// Takes the scores of the next plane: the mean of the best photos'.
    #[inline(always)]
    fn take(&mut self, plane: u32, [first, second]: &[Vec<f32>; BEST]) {
        for pixel in 0..self.score.len() {
            let (first, second) = (first[pixel], second[pixel]);
            let score = if second > -1.0 { 0.5 * (first + second) } else { first };
            if plane > 0 && self.plane[pixel] == plane - 1 {
                self.after[pixel] = score;
            }
            if score > self.score[pixel] {
                self.score[pixel] = score;
                self.plane[pixel] = plane;
                self.before[pixel] = self.last[pixel];
                self.after[pixel] = -1.0;
            }
            self.last[pixel] = score;
        }
    }

    /// Position of the maximum of the parabola through the best score and its neighbors, in planes.
    fn between_planes(&self, pixel: usize) -> f32 {
        let (before, score, after) = (self.before[pixel], self.score[pixel], self.after[pixel]);
        let bend = before - 2.0 * score + after;
        if before <= -1.0 || after <= -1.0 || bend > -1e-6 {
            return 0.0;
        }
        (0.5 * (before - after) / bend).clamp(-0.5, 0.5)
    }
}

/// Another photo as a photo's camera would see it.
struct Warped {
    gray: Vec<f32>,
    /// 1 if the other photo sees the point, else 0.
    seen: Vec<f32>,
}

/// How a photo's pixels at some depth fall on another photo.
struct Warp<'a> {
    other: &'a GrayPhoto,
    /// Maps the photo's pixel (x, y, 1) to a homogeneous pixel of the second photo, at infinite depth.
    infinite: DMat3,
    /// Added per unit of 1 / depth.
    epipole: DVec3,
}

impl<'a> Warp<'a> {
    fn new(camera: &Camera, other: &'a GrayPhoto) -> Self {
        let to = &other.camera;
        let rotation = to.rotation() * camera.rotation().transpose();
        let translation = to.translation() - rotation * camera.translation();
        let k =
            |c: &Camera| DMat3::from_cols_array(&[c.fx, 0.0, 0.0, 0.0, c.fy, 0.0, c.cx, c.cy, 1.0]);
        Self {
            other,
            infinite: k(to) * rotation * k(camera).inverse(),
            epipole: k(to) * translation,
        }
    }

    #[inline(always)]
    fn run(&self, inverse_depth: f32, width: usize, warped: &mut Warped) {
        let (w, h) = (self.other.camera.width as usize, self.other.camera.height as usize);
        let (gray, usable) = (self.other.gray.as_slice(), self.other.usable.as_deref());
        let along = self.infinite.x_axis.as_vec3();
        let (most_x, most_y) = (w as f32 - 1.0, h as f32 - 1.0);
        let rows = warped.gray.chunks_exact_mut(width).zip(warped.seen.chunks_exact_mut(width));
        for (row, (out, seen)) in rows.enumerate() {
            let start = self.infinite * DVec3::new(0.5, row as f64 + 0.5, 1.0)
                + f64::from(inverse_depth) * self.epipole;
            let start = start.as_vec3();
            for column in 0..width {
                let at = column as f32;
                let z = start.z + at * along.z;
                let scale = 1.0 / z.max(1e-6);
                // Relative to the center of pixel (0, 0).
                let x = (start.x + at * along.x) * scale - 0.5;
                let y = (start.y + at * along.y) * scale - 0.5;
                let inside = z > 1e-6 && x >= 0.0 && y >= 0.0 && x <= most_x && y <= most_y;
                let (x, y) = (x.max(0.0).min(most_x), y.max(0.0).min(most_y));
                let (left, upper) = (x as i32 as usize, y as i32 as usize);
                let (right, lower) = ((left + 1).min(w - 1), (upper + 1).min(h - 1));
                let (dx, dy) = (x - left as f32, y - upper as f32);
                let corners =
                    [upper * w + left, upper * w + right, lower * w + left, lower * w + right];
                let above = gray[corners[0]] * (1.0 - dx) + gray[corners[1]] * dx;
                let below = gray[corners[2]] * (1.0 - dx) + gray[corners[3]] * dx;
                out[column] = above * (1.0 - dy) + below * dy;
                let counts = match usable {
                    Some(usable) => corners.iter().all(|&corner| usable[corner]),
                    None => true,
                };
                seen[column] = if inside && counts { 1.0 } else { 0.0 };
            }
        }
    }
}

/// Mean and variance of a photo's gray in the patch about each pixel.
struct Patches {
    mean: Vec<f32>,
    variance: Vec<f32>,
}

impl Patches {
    #[inline(always)]
    fn of(gray: &[f32], boxes: &mut Boxes) -> Self {
        let mut out = Self { mean: vec![0.0; gray.len()], variance: vec![0.0; gray.len()] };
        for row in 0..boxes.height + RADIUS {
            if let Some((pixels, [mean, square, _])) = boxes.next_row(row, gray, gray) {
                let (means, variances) = (&mut out.mean[pixels.clone()], &mut out.variance[pixels]);
                for column in 0..mean.len() {
                    means[column] = mean[column];
                    variances[column] = (square[column] - mean[column] * mean[column]).max(0.0);
                }
            }
        }
        out
    }

    /// Puts the correlation of each pixel's patch and the warped photo's among the best.
    #[inline(always)]
    fn correlate(
        &self,
        gray: &[f32],
        warped: &Warped,
        boxes: &mut Boxes,
        [first, second]: &mut [Vec<f32>; BEST],
    ) {
        for row in 0..boxes.height + RADIUS {
            let Some((pixels, [mean, square, product])) = boxes.next_row(row, &warped.gray, gray)
            else {
                continue;
            };
            let seen = &warped.seen[pixels.clone()];
            let (own_mean, own_variance) =
                (&self.mean[pixels.clone()], &self.variance[pixels.clone()]);
            let (first, second) = (&mut first[pixels.clone()], &mut second[pixels]);
            for column in 0..mean.len() {
                let variance = (square[column] - mean[column] * mean[column]).max(0.0);
                let both = (own_variance[column] + NOISE) * (variance + NOISE);
                let score = (product[column] - mean[column] * own_mean[column]) / both.sqrt();
                let score = if seen[column] > 0.0 { score } else { -1.0 };
                second[column] = second[column].max(first[column].min(score));
                first[column] = first[column].max(score);
            }
        }
    }
}

/// Means over the square about each pixel; squares end at the border.
struct Boxes {
    width: usize,
    height: usize,
    /// Row sums of a value, its square and its product with another, for each row of the square.
    rows: [Vec<f32>; 3],
    /// The values with zeros before and after.
    padded: [Vec<f32>; 3],
    means: [Vec<f32>; 3],
    /// 1 / number of columns of each square.
    columns: Vec<f32>,
}

const SIDE: usize = 2 * RADIUS + 1;

impl Boxes {
    fn new(width: usize, height: usize) -> Self {
        let columns = (0..width).map(|column| {
            let count = (column + RADIUS + 1).min(width) - column.saturating_sub(RADIUS);
            1.0 / count as f32
        });
        Self {
            width,
            height,
            rows: std::array::from_fn(|_| vec![0.0; width * SIDE]),
            padded: std::array::from_fn(|_| vec![0.0; width + 2 * RADIUS]),
            means: std::array::from_fn(|_| vec![0.0; width]),
            columns: columns.collect(),
        }
    }

    /// Adds a row of `values` and of their products with `others`, in order. Returns the pixels and means
    /// of the row that this completes, `RADIUS` further up.
    #[inline(always)]
    fn next_row(
        &mut self,
        row: usize,
        values: &[f32],
        others: &[f32],
    ) -> Option<(std::ops::Range<usize>, [&[f32]; 3])> {
        let width = self.width;
        if row < self.height {
            let (values, others) =
                (&values[row * width..][..width], &others[row * width..][..width]);
            let [plain, squares, products] = &mut self.padded;
            let (plain, squares, products) = (
                &mut plain[RADIUS..][..width],
                &mut squares[RADIUS..][..width],
                &mut products[RADIUS..][..width],
            );
            for column in 0..width {
                plain[column] = values[column];
                squares[column] = values[column] * values[column];
                products[column] = values[column] * others[column];
            }
            for (rows, padded) in self.rows.iter_mut().zip(&self.padded) {
                let out = &mut rows[row % SIDE * width..][..width];
                out.copy_from_slice(&padded[..width]);
                for shift in 1..SIDE {
                    let shifted = &padded[shift..][..width];
                    for column in 0..width {
                        out[column] += shifted[column];
                    }
                }
            }
        }
        let center = row.checked_sub(RADIUS)?;
        let square = center.saturating_sub(RADIUS)..(center + RADIUS + 1).min(self.height);
        let scale = 1.0 / square.len() as f32;
        for (means, rows) in self.means.iter_mut().zip(&self.rows) {
            means.fill(0.0);
            for one in square.clone() {
                let sums = &rows[one % SIDE * width..][..width];
                for column in 0..width {
                    means[column] += sums[column];
                }
            }
            for column in 0..width {
                means[column] *= scale * self.columns[column];
            }
        }
        let [mean, square, product] = &self.means;
        Some((center * width..(center + 1) * width, [mean, square, product]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;

    const SIZE: usize = 48;
    const DEPTH: f64 = 2.0;

    /// Gray of a textured wall at depth [`DEPTH`] as a camera at (x, 0, 0) sees it.
    fn photo(x: f64, gain: f32) -> GrayPhoto {
        let camera = Camera {
            viewmat: DMat4::from_translation(DVec3::new(-x, 0.0, 0.0)),
            fx: 50.0,
            fy: 50.0,
            cx: 24.0,
            cy: 24.0,
            width: SIZE as u32,
            height: SIZE as u32,
        };
        let gray = (0..SIZE * SIZE).map(|i| {
            let u = ((i % SIZE) as f64 + 0.5 - camera.cx) / camera.fx * DEPTH + x;
            let v = ((i / SIZE) as f64 + 0.5 - camera.cy) / camera.fy * DEPTH;
            let wave = (17.0 * u + 3.0 * v).sin() + (7.0 * v - 23.0 * u * v).cos();
            gain * (0.5 + 0.2 * wave as f32)
        });
        GrayPhoto { camera, gray: gray.collect(), usable: None }
    }

    fn sweep(others: &[usize]) -> Sweep {
        Sweep { photo: 0, others: others.to_vec(), range: [1.0, 0.25], planes: 64 }
    }

    #[test]
    fn finds_a_wall_whatever_the_exposure() {
        let photos = [photo(0.0, 1.0), photo(0.2, 0.5), photo(-0.2, 0.8)];
        let map = plane_sweep(&photos, &[sweep(&[1, 2])]).unwrap().remove(0);
        let inner = (10..38).flat_map(|row| (10..38).map(move |column| row * SIZE + column));
        for pixel in inner {
            let depth = f64::from(1.0 / map.inverse_depth[pixel]);
            assert!((depth - DEPTH).abs() < 0.05, "{depth} at {pixel}");
            assert!(map.score[pixel] > 0.9);
        }
    }

    #[test]
    fn unknown_depths_have_a_low_score() {
        let mut away = photo(0.2, 1.0);
        away.camera.viewmat.w_axis.x = 1e3;
        let mut flat = photo(0.2, 1.0);
        flat.gray.fill(0.5);
        let mut masked = photo(0.2, 1.0);
        masked.usable = Some(vec![false; SIZE * SIZE]);
        let photos = [photo(0.0, 1.0), away, flat, masked];
        let maps = plane_sweep(&photos, &[sweep(&[1]), sweep(&[2]), sweep(&[3]), sweep(&[])]);
        let [away, flat, masked, alone] = maps.unwrap().try_into().unwrap();
        for map in [&away, &masked, &alone] {
            assert!(map.score.iter().all(|&score| score == -1.0));
        }
        assert!(flat.score.iter().all(|&score| score < 0.01));
        for map in [away, flat, masked, alone] {
            assert!(map.inverse_depth.iter().all(|v| v.is_finite() && *v > 0.0));
        }
    }

    #[test]
    fn invalid_photos_are_refused() {
        let photos = [photo(0.0, 1.0)];
        let error =
            |photos: &[GrayPhoto], sweep| plane_sweep(photos, &[sweep]).unwrap_err().to_string();
        assert!(error(&photos, sweep(&[1])).starts_with("sweeps[0]: "));
        assert!(error(&photos, Sweep { planes: 1, ..sweep(&[0]) }).starts_with("sweeps[0]: "));
        let range = [f32::NAN, 1.0];
        assert!(error(&photos, Sweep { range, ..sweep(&[0]) }).starts_with("sweeps[0]: "));
        let mut short = photo(0.0, 1.0);
        short.gray.pop();
        assert!(error(&[short], sweep(&[])).starts_with("photos[0]: "));
        let mut wrong = photo(0.0, 1.0);
        wrong.gray[3] = f32::NAN;
        assert!(error(&[wrong], sweep(&[])).starts_with("photos[0]: "));
    }
}
