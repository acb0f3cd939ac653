//! Coordinates for camera steps: a unit step moves the picture by one pixel (CamP, Park et al. 2023).

use glam::DVec3;

use super::cholesky::inverse_cholesky;
use super::motion::{POSE, PoseMatrix};
use super::pose_prior::PosePrior;
use super::rigs::Rigs;
use crate::camera::Camera;

/// Relative depths and picture positions of the points whose motion measures a step.
const DEPTHS: [f64; 3] = [0.8, 1.0, 1.25];
const POSITIONS: [f64; 5] = [0.1, 0.3, 0.5, 0.7, 0.9];

/// Added to the measure, as a part of its mean diagonal: directions that move no picture stay put.
const DAMPING: f64 = 0.01;

/// How many pixels the points of a picture move, in root mean square, by unit growth of log f.
pub(super) fn focal_pixels(camera: &Camera) -> f64 {
    let points = grid(camera);
    let sum: f64 =
        points.iter().map(|(x, y)| (x * camera.fx).powi(2) + (y * camera.fy).powi(2)).sum();
    (sum / points.len() as f64).sqrt().max(1.0)
}

/// Positions in the picture as (x / z, y / z).
fn grid(camera: &Camera) -> Vec<(f64, f64)> {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    POSITIONS
        .iter()
        .flat_map(|v| POSITIONS.iter().map(move |u| (u, v)))
        .map(|(u, v)| ((u * w - camera.cx) / camera.fx, (v * h - camera.cy) / camera.fy))
        .collect()
}

pub(super) fn all_scales(
    cameras: &[Camera],
    distances: &[f64],
    priors: &[PosePrior],
    rigs: &Rigs,
) -> Vec<PoseMatrix> {
    let measures: Vec<_> = cameras.iter().zip(distances).map(|(c, &d)| measure(c, d)).collect();
    if !rigs.any() {
        let each = measures.iter().enumerate();
        return each.map(|(k, sum)| pixels_to_pose(sum, priors.get(k))).collect();
    }
    // The priors of a rig's cameras already belong to the whole rig.
    let whole = rigs.sums(&measures, true);
    let each = whole.iter().enumerate();
    let scales: Vec<_> = each.map(|(k, sum)| pixels_to_pose(sum, priors.get(k))).collect();
    (0..cameras.len()).map(|k| rigs.rows_at(k, &scales)).collect()
}

/// Median depth of the points in a camera's picture; else of all points in front of it; else 1.
pub fn scene_distance(camera: &Camera, means: &[[f32; 3]]) -> f64 {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let (mut seen, mut before) = (Vec::new(), Vec::new());
    for mean in means {
        let t = camera.viewmat.transform_point3(DVec3::from(mean.map(f64::from)));
        if t.z > 0.0 && t.z.is_finite() {
            let x = camera.fx * t.x / t.z + camera.cx;
            let y = camera.fy * t.y / t.z + camera.cy;
            if x >= 0.0 && x < w && y >= 0.0 && y < h {
                seen.push(t.z);
            }
            before.push(t.z);
        }
    }
    let mut depths = if seen.is_empty() { before } else { seen };
    if depths.is_empty() {
        return 1.0;
    }
    let middle = depths.len() / 2;
    *depths.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// How far, in pixels squared, points of the picture move with the pose, in the mean.
fn measure(camera: &Camera, distance: f64) -> PoseMatrix {
    let mut sum = [[0.0; POSE]; POSE];
    let points = grid(camera);
    let count = (points.len() * DEPTHS.len()) as f64;
    for (x, y) in points {
        for depth in DEPTHS {
            let z = (depth * distance).max(f64::MIN_POSITIVE);
            let rows = [
                [-x * y, 1.0 + x * x, -y, 1.0 / z, 0.0, -x / z].map(|v| v * camera.fx),
                [-1.0 - y * y, x * y, x, 0.0, 1.0 / z, -y / z].map(|v| v * camera.fy),
            ];
            for row in rows {
                for (line, a) in sum.iter_mut().zip(row) {
                    for (s, b) in line.iter_mut().zip(row) {
                        *s += a * b / count;
                    }
                }
            }
        }
    }
    sum
}

/// A matrix from steps in pixels to poses: a unit step moves points of the picture by one pixel in root
/// mean square, or by the prior's standard deviation if that is smaller. A translation comes with the
/// rotation that keeps the picture in place.
fn pixels_to_pose(sum: &PoseMatrix, prior: Option<&PosePrior>) -> PoseMatrix {
    // Turns are in radians and moves in world units; the damping compares them as pixels.
    let unit: [f64; POSE] = std::array::from_fn(|i| sum[i][i].sqrt().max(f64::MIN_POSITIVE));
    let mut scaled = *sum;
    for (i, line) in scaled.iter_mut().enumerate() {
        for (j, v) in line.iter_mut().enumerate() {
            *v = *v / (unit[i] * unit[j]) + if i == j { DAMPING } else { 0.0 };
            if let Some(prior) = prior {
                *v += prior.pose[i][j] / (unit[i] * unit[j]);
            }
        }
    }
    let inverse = inverse_cholesky(scaled);
    // x = D^-1 L^-T z, with D the units and L L^T the measure.
    std::array::from_fn(|i| std::array::from_fn(|j| inverse[j][i] / unit[i]))
}
