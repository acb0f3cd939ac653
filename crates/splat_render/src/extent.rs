//! Center and radius of a scene, and the near plane of its renders.

use glam::DVec3;

/// Splats of a lower opacity logit do not count.
const FAINT_LOGIT: f32 = -2.2;
/// Number of splats that the extent is computed from.
const SAMPLES: usize = 20_000;
/// Near plane of renders, as a fraction of the scene's radius. Small, because distant background
/// increases the radius.
const NEAR_PART: f64 = 1e-4;

/// Minimum number of cameras for outlier detection.
const OUTLIERS_FROM: usize = 6;
/// Number of cameras per allowed outlier; one is always allowed.
const CAMERAS_PER_OUTLIER: usize = 20;
/// Maximum distance of outliers, as a multiple of the farthest other camera's.
const FARTHEST: f64 = 4.0;

/// Center of the visible splats, relative to their origin, and the radius with 90 % of them, at most four
/// times the radius with 50 %. Medians, because captures have a few splats very far out.
pub fn extent(means: &[[f32; 3]], opacities: &[f32]) -> (DVec3, f64) {
    let is_finite = |&i: &usize| means[i].iter().all(|v| v.is_finite()) && opacities[i].is_finite();
    let step = means.len().div_ceil(SAMPLES).max(1);
    let all: Vec<usize> = (0..means.len()).step_by(step).filter(is_finite).collect();
    let mut seen: Vec<usize> =
        all.iter().copied().filter(|&i| opacities[i] > FAINT_LOGIT).collect();
    if seen.is_empty() {
        seen = all;
    }
    let at = |i: usize| DVec3::from(means[i].map(f64::from));
    let middle =
        |axis: usize| quantile(&mut seen.iter().map(|&i| at(i)[axis]).collect::<Vec<_>>(), 0.5);
    let center = DVec3::new(middle(0), middle(1), middle(2));
    let mut distances: Vec<f64> = seen.iter().map(|&i| at(i).distance(center)).collect();
    let radius = quantile(&mut distances, 0.9).min(4.0 * quantile(&mut distances, 0.5));
    (center, if radius > 0.0 { radius } else { 1.0 })
}

/// 1.1 times the largest distance of a camera's center from the mean center (3DGS). Of six cameras or
/// more, a few far ones do not count: structure from motion can place single cameras anywhere.
pub fn camera_extent(centers: &[DVec3]) -> f64 {
    let mean = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    if centers.len() < OUTLIERS_FROM {
        return 1.1 * radius;
    }
    let middle =
        |axis: usize| quantile(&mut centers.iter().map(|c| c[axis]).collect::<Vec<_>>(), 0.5);
    let center = DVec3::new(middle(0), middle(1), middle(2));
    let mut distances: Vec<f64> = centers.iter().map(|c| c.distance(center)).collect();
    distances.sort_unstable_by(f64::total_cmp);
    let outliers = (centers.len() / CAMERAS_PER_OUTLIER).max(1);
    1.1 * radius.min(FARTHEST * distances[centers.len() - 1 - outliers])
}

/// Near plane of renders, which do not depend on the scene's unit.
pub fn near_plane(radius: f64) -> f32 {
    ((NEAR_PART * radius) as f32).max(f32::MIN_POSITIVE)
}

/// The value at a fraction of the way from the least to the greatest.
fn quantile(values: &mut [f64], part: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * part) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}
