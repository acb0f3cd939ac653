//! Splats to start from.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::sh;
use crate::splats::SplatArrays;

/// Opacity of a splat that stands for a point (3DGS).
const OPACITY: f32 = 0.1;
/// Neighbors whose mean distance sets a point's size (3DGS).
const NEIGHBORS: usize = 3;

/// Makes a round splat per point, as large as the mean distance to its three nearest neighbors. `points`
/// are relative to the scene's origin, `colors` in 0..1.
pub fn splats_from_points(
    points: &[[f32; 3]],
    colors: &[[f32; 3]],
    sh_degree: u32,
) -> Result<SplatArrays> {
    if points.len() != colors.len() {
        return Err(Error::argument(
            "colors",
            format!("has {} rows, but points has {}", colors.len(), points.len()),
        ));
    }
    // Squared distances of points further out would overflow.
    if !points.iter().flatten().all(|v| v.abs() < 1e18) {
        return Err(Error::argument("points", "hold a value that is not finite or beyond 1e18"));
    }
    if !colors.iter().flatten().all(|v| v.is_finite()) {
        return Err(Error::argument("colors", "hold a value that is not finite"));
    }
    let mut out = SplatArrays::zeros(points.len(), sh_degree);
    out.means.copy_from_slice(points);
    out.quats.fill([1.0, 0.0, 0.0, 0.0]);
    out.opacities.fill((OPACITY / (1.0 - OPACITY)).ln());
    let stride = out.stride();
    for (i, color) in colors.iter().enumerate() {
        out.sh[i * stride] = color.map(|c| (c - 0.5) / sh::C0 as f32);
    }
    if points.len() < 2 {
        return Ok(out);
    }
    let tree = rstar::RTree::bulk_load(points.to_vec());
    out.scales.par_iter_mut().zip(points).for_each(|(scale, point)| {
        // The nearest is the point itself.
        let near = tree.nearest_neighbor_iter_with_distance_2(point).skip(1).take(NEIGHBORS);
        let (sum, count) = near.fold((0.0, 0.0), |(sum, n), (_, d2)| (sum + d2.sqrt(), n + 1.0));
        // Coincident points must not give a size of zero.
        *scale = [(sum / f32::max(count, 1.0)).max(1e-7).ln(); 3];
    });
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_is_the_mean_distance_to_three_neighbors() {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
        let splats = splats_from_points(&points, &[[0.5; 3]; 4], 2).unwrap();
        assert!((splats.scales[0][0] - 2.0f32.ln()).abs() < 1e-6);
        assert_eq!(splats.sh[0], [0.0; 3]);
        splats.validate().unwrap();
        for count in 0..4 {
            let splats = splats_from_points(&points[..count], &[[0.5; 3]; 4][..count], 0).unwrap();
            assert!(splats.scales.iter().flatten().all(|s| s.is_finite()));
        }
        let same = splats_from_points(&[[1.0; 3]; 5], &[[0.5; 3]; 5], 0).unwrap();
        assert!(same.scales.iter().flatten().all(|s| s.is_finite()));
        let error = |point, color| {
            splats_from_points(&[[point; 3]], &[[color; 3]], 0).unwrap_err().to_string()
        };
        assert!(error(f32::NAN, 0.5).starts_with("points: "));
        assert!(error(1e30, 0.5).starts_with("points: "));
        assert!(error(0.0, f32::NAN).starts_with("colors: "));
    }
}
