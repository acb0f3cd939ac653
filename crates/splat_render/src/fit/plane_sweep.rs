//! Depth maps of photos by plane sweep (Collins 1996), scored by zero-mean normalised
//! cross-correlation, which a photo's exposure does not change.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::error::{Error, Result};

/// Patches that are compared have a side of `2 * RADIUS + 1` pixels.
const RADIUS: usize = 3;
/// Variance of grey (0..1) that noise has: patches of less have no texture, and score near 0.
const NOISE: f32 = 1e-4;
/// A depth's score is the mean of so many best photos: others may not see the place.
const BEST: usize = 2;

/// A photo to sweep, or to compare with.
#[derive(Debug, Clone)]
pub struct GreyPhoto {
    /// Its camera.
    pub camera: Camera,
    /// `[H * W]` grey in 0..1, row-major.
    pub grey: Vec<f32>,
    /// `[H * W]` which pixels count, or None for all.
    pub usable: Option<Vec<bool>>,
}

/// What a sweep finds for a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// `[H * W]` 1 / z-depth with the best score.
    pub inverse_depth: Vec<f32>,
    /// `[H * W]` correlation in -1..=1; -1 where no other photo sees any of the depths.
    pub score: Vec<f32>,
}

/// What to do for one photo.
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
///
/// # Errors
/// [`Error::Argument`] if a photo, an index or a range cannot be used.
pub fn plane_sweep(photos: &[GreyPhoto], sweeps: &[Sweep]) -> Result<Vec<DepthMap>> {
    for (k, photo) in photos.iter().enumerate() {
        photo.camera.validate()?;
        let pixels = photo.camera.width as usize * photo.camera.height as usize;
        let usable = photo.usable.as_ref().map_or(pixels, Vec::len);
        if photo.grey.len() != pixels || usable != pixels {
            return Err(Error::argument(format!("photos[{k}]"), "does not fit its camera's size"));
        }
        if !photo.grey.iter().all(|v| v.abs() <= 1.0) {
            return Err(Error::argument(format!("photos[{k}]"), "has grey outside of 0..1"));
        }
    }
    for (k, sweep) in sweeps.iter().enumerate() {
        let bad = |reason: &str| Err(Error::argument(format!("sweeps[{k}]"), reason));
        if sweep.others.iter().chain([&sweep.photo]).any(|&index| index >= photos.len()) {
            return bad("names a photo that there is not");
        }
        if sweep.planes < 2 || !sweep.range.iter().all(|v| v.is_finite() && *v > 0.0) {
            return bad("needs two planes at least, at finite depths above 0");
        }
    }
    Ok(sweeps.par_iter().map(|sweep| swept(photos, sweep)).collect())
}

/// The best depth so far of each pixel, and its neighbours' scores.
struct Best {
    score: Vec<f32>,
    plane: Vec<u32>,
    before: Vec<f32>,
    after: Vec<f32>,
}

fn swept(photos: &[GreyPhoto], sweep: &Sweep) -> DepthMap {
    let photo = &photos[sweep.photo];
    let (width, height) = (photo.camera.width as usize, photo.camera.height as usize);
    let pixels = width * height;
    let mut boxes = Boxes::new(width, height);
    let own = Patches::of(&photo.grey, &mut boxes);
    let warps: Vec<Warp<'_>> =
        sweep.others.iter().map(|&other| Warp::new(&photo.camera, &photos[other])).collect();
    let mut best = Best {
        score: vec![-1.0; pixels],
        plane: vec![0; pixels],
        before: vec![-1.0; pixels],
        after: vec![-1.0; pixels],
    };
    let [near, far] = sweep.range;
    let gap = (far - near) / (sweep.planes - 1) as f32;
    let (mut warped, mut seen) = (vec![0.0; pixels], vec![false; pixels]);
    let mut top = vec![[-1.0f32; BEST]; pixels];
    let mut last = vec![-1.0f32; pixels];
    for plane in 0..sweep.planes {
        top.fill([-1.0; BEST]);
        for warp in &warps {
            warp.run(near + gap * plane as f32, width, &mut warped, &mut seen);
            own.correlate(&photo.grey, &warped, &mut boxes, |pixel, score| {
                if seen[pixel] {
                    let top = &mut top[pixel];
                    if score > top[0] {
                        *top = [score, top[0]];
                    } else if score > top[1] {
                        top[1] = score;
                    }
                }
            });
        }
        for pixel in 0..pixels {
            let [first, second] = top[pixel];
            let score = if second > -1.0 { 0.5 * (first + second) } else { first };
            if plane > 0 && best.plane[pixel] as usize == plane - 1 {
                best.after[pixel] = score;
            }
            if score > best.score[pixel] {
                best.score[pixel] = score;
                best.plane[pixel] = plane as u32;
                best.before[pixel] = last[pixel];
                best.after[pixel] = -1.0;
            }
            last[pixel] = score;
        }
    }
    let inverse_depth = (0..pixels)
        .map(|pixel| near + gap * (best.plane[pixel] as f32 + best.between_planes(pixel)))
        .collect();
    DepthMap { inverse_depth, score: best.score }
}

impl Best {
    /// Where the parabola through the best score and its neighbours has its top, in planes.
    fn between_planes(&self, pixel: usize) -> f32 {
        let (before, score, after) = (self.before[pixel], self.score[pixel], self.after[pixel]);
        let bend = before - 2.0 * score + after;
        if before <= -1.0 || after <= -1.0 || bend > -1e-6 {
            return 0.0;
        }
        (0.5 * (before - after) / bend).clamp(-0.5, 0.5)
    }
}

/// How a photo's pixels at some depth fall on another photo.
struct Warp<'a> {
    other: &'a GreyPhoto,
    /// Pixel (x, y, 1) of the photo to the other's homogeneous pixel, at infinite depth.
    infinite: DMat3,
    /// What 1 / depth adds to it.
    epipole: DVec3,
}

impl<'a> Warp<'a> {
    fn new(camera: &Camera, other: &'a GreyPhoto) -> Self {
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

    /// The other photo as seen at this inverse depth, and where it sees it.
    fn run(&self, inverse_depth: f32, width: usize, warped: &mut [f32], seen: &mut [bool]) {
        let (w, h) = (self.other.camera.width as usize, self.other.camera.height as usize);
        let along = self.infinite.x_axis.as_vec3();
        let (most_x, most_y) = (w as f32 - 1.0, h as f32 - 1.0);
        for (row, (warped, seen)) in
            warped.chunks_exact_mut(width).zip(seen.chunks_exact_mut(width)).enumerate()
        {
            let start = self.infinite * DVec3::new(0.5, row as f64 + 0.5, 1.0)
                + f64::from(inverse_depth) * self.epipole;
            let start = start.as_vec3();
            for column in 0..width {
                let at = start + column as f32 * along;
                let scale = 1.0 / at.z.max(1e-6);
                // Relative to the centre of pixel (0, 0).
                let (x, y) = (at.x * scale - 0.5, at.y * scale - 0.5);
                let inside = at.z > 1e-6 && x >= 0.0 && y >= 0.0 && x <= most_x && y <= most_y;
                let (x, y) = (x.clamp(0.0, most_x), y.clamp(0.0, most_y));
                let (left, top) = (x as usize, y as usize);
                let (right, bottom) = ((left + 1).min(w - 1), (top + 1).min(h - 1));
                let (fx, fy) = (x - left as f32, y - top as f32);
                let grey = &self.other.grey;
                let upper = grey[top * w + left] * (1.0 - fx) + grey[top * w + right] * fx;
                let lower = grey[bottom * w + left] * (1.0 - fx) + grey[bottom * w + right] * fx;
                warped[column] = upper * (1.0 - fy) + lower * fy;
                seen[column] = inside
                    && self.other.usable.as_ref().is_none_or(|usable| {
                        usable[top * w + left]
                            && usable[top * w + right]
                            && usable[bottom * w + left]
                            && usable[bottom * w + right]
                    });
            }
        }
    }
}

/// Mean and variance of a photo's grey in the patch about each pixel.
struct Patches {
    mean: Vec<f32>,
    variance: Vec<f32>,
}

impl Patches {
    fn of(grey: &[f32], boxes: &mut Boxes) -> Self {
        let mut out = Self { mean: vec![0.0; grey.len()], variance: vec![0.0; grey.len()] };
        boxes.run(
            |i| [grey[i], grey[i] * grey[i], 0.0],
            |i, [mean, square, _]| {
                out.mean[i] = mean;
                out.variance[i] = (square - mean * mean).max(0.0);
            },
        );
        out
    }

    /// Calls `score` with each pixel's correlation of its patch and the warped photo's.
    fn correlate(
        &self,
        grey: &[f32],
        warped: &[f32],
        boxes: &mut Boxes,
        mut score: impl FnMut(usize, f32),
    ) {
        boxes.run(
            |i| [warped[i], warped[i] * warped[i], warped[i] * grey[i]],
            |i, [mean, square, product]| {
                let variance = (square - mean * mean).max(0.0);
                let both = (self.variance[i] + NOISE) * (variance + NOISE);
                score(i, (product - mean * self.mean[i]) / both.sqrt());
            },
        );
    }
}

/// Means over the square about each pixel, of three values at once; squares end at the border.
struct Boxes {
    width: usize,
    height: usize,
    /// Sums along the row, for each row of the square in turn, and over all of them.
    rows: Vec<[f32; 3]>,
    sums: Vec<[f32; 3]>,
}

impl Boxes {
    fn new(width: usize, height: usize) -> Self {
        let rows = vec![[0.0; 3]; width * (2 * RADIUS + 1)];
        Self { width, height, rows, sums: vec![[0.0; 3]; width] }
    }

    fn run(&mut self, value: impl Fn(usize) -> [f32; 3], mut mean: impl FnMut(usize, [f32; 3])) {
        let (width, height, side) = (self.width, self.height, 2 * RADIUS + 1);
        let mut line = vec![[0.0f32; 3]; width + 2 * RADIUS];
        for row in 0..height + RADIUS {
            if row < height {
                let slot = &mut self.rows[row % side * width..][..width];
                for (column, out) in line[RADIUS..RADIUS + width].iter_mut().enumerate() {
                    *out = value(row * width + column);
                }
                for (column, out) in slot.iter_mut().enumerate() {
                    let square = &line[column..column + side];
                    *out = std::array::from_fn(|k| square.iter().map(|v| v[k]).sum());
                }
            }
            if row < RADIUS {
                continue;
            }
            let centre = row - RADIUS;
            let rows = centre.saturating_sub(RADIUS)..(centre + RADIUS + 1).min(height);
            self.sums.fill([0.0; 3]);
            for one in rows.clone() {
                let slot = &self.rows[one % side * width..][..width];
                for (sum, add) in self.sums.iter_mut().zip(slot) {
                    *sum = std::array::from_fn(|k| sum[k] + add[k]);
                }
            }
            for column in 0..width {
                let columns = (column + RADIUS + 1).min(width) - column.saturating_sub(RADIUS);
                let scale = 1.0 / (columns * rows.len()) as f32;
                mean(centre * width + column, self.sums[column].map(|sum| sum * scale));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;

    const SIZE: usize = 48;
    const DEPTH: f64 = 2.0;

    /// Grey of a textured wall at depth [`DEPTH`] as a camera at (x, 0, 0) sees it.
    fn photo(x: f64, gain: f32) -> GreyPhoto {
        let camera = Camera {
            viewmat: DMat4::from_translation(DVec3::new(-x, 0.0, 0.0)),
            fx: 50.0,
            fy: 50.0,
            cx: 24.0,
            cy: 24.0,
            width: SIZE as u32,
            height: SIZE as u32,
        };
        let grey = (0..SIZE * SIZE).map(|i| {
            let u = ((i % SIZE) as f64 + 0.5 - camera.cx) / camera.fx * DEPTH + x;
            let v = ((i / SIZE) as f64 + 0.5 - camera.cy) / camera.fy * DEPTH;
            let wave = (17.0 * u + 3.0 * v).sin() + (7.0 * v - 23.0 * u * v).cos();
            gain * (0.5 + 0.2 * wave as f32)
        });
        GreyPhoto { camera, grey: grey.collect(), usable: None }
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
    fn says_where_it_knows_nothing() {
        let mut away = photo(0.2, 1.0);
        away.camera.viewmat.w_axis.x = 1e3;
        let mut flat = photo(0.2, 1.0);
        flat.grey.fill(0.5);
        let mut masked = photo(0.2, 1.0);
        masked.usable = Some(vec![false; SIZE * SIZE]);
        let photos = [photo(0.0, 1.0), away, flat, masked];
        let maps = plane_sweep(&photos, &[sweep(&[1]), sweep(&[2]), sweep(&[3]), sweep(&[])]);
        let [away, flat, masked, alone] = maps.unwrap().try_into().unwrap();
        for map in [&away, &masked, &alone] {
            assert!(map.score.iter().all(|&score| score == -1.0));
        }
        assert!(flat.score.iter().all(|score| score.abs() < 0.01));
        for map in [away, flat, masked, alone] {
            assert!(map.inverse_depth.iter().all(|v| v.is_finite() && *v > 0.0));
        }
    }

    #[test]
    fn refuses_what_it_cannot_sweep() {
        let photos = [photo(0.0, 1.0)];
        let error =
            |photos: &[GreyPhoto], sweep| plane_sweep(photos, &[sweep]).unwrap_err().to_string();
        assert!(error(&photos, sweep(&[1])).starts_with("sweeps[0]: "));
        assert!(error(&photos, Sweep { planes: 1, ..sweep(&[0]) }).starts_with("sweeps[0]: "));
        let range = [f32::NAN, 1.0];
        assert!(error(&photos, Sweep { range, ..sweep(&[0]) }).starts_with("sweeps[0]: "));
        let mut short = photo(0.0, 1.0);
        short.grey.pop();
        assert!(error(&[short], sweep(&[])).starts_with("photos[0]: "));
        let mut wrong = photo(0.0, 1.0);
        wrong.grey[3] = f32::NAN;
        assert!(error(&[wrong], sweep(&[])).starts_with("photos[0]: "));
    }
}
