//! Fog: splats right before a camera, far nearer than all that it shows.
//!
//! A large, faint splat there tints one photo and little else. It explains what photos differ by
//! (exposure, vignetting) and hides what is behind it, which then has no gradients any more. On
//! plain walls and tables it can outgrow the scene.

use rayon::prelude::*;

use crate::camera::Camera;
use crate::splats::SplatArrays;

/// Part of the splats that a camera shows at least as near as its nearest surface.
const NEAREST: f64 = 0.01;
/// Fog is nearer than this part of that depth.
const BEFORE: f64 = 0.5;
/// Splats whose depths tell the nearest surface, at most, and at least.
const SAMPLES: (usize, usize) = (10_000, 100);
/// Standard deviations of its longest axis that a splat reaches to.
const REACH: f64 = 3.0;

/// Ids of the splats that are fog before some camera, rising.
pub(super) fn fog(splats: &SplatArrays, cameras: &[Camera]) -> Vec<usize> {
    let every = splats.len().div_ceil(SAMPLES.0).max(1);
    let nearest: Vec<f64> = cameras
        .par_iter()
        .map(|camera| {
            let mut depths: Vec<f64> = (0..splats.len())
                .step_by(every)
                .filter_map(|i| depth(splats, i, camera, 0.0))
                .collect();
            if depths.len() < SAMPLES.1 {
                return 0.0;
            }
            let at = (NEAREST * depths.len() as f64) as usize;
            BEFORE * *depths.select_nth_unstable_by(at, f64::total_cmp).1
        })
        .collect();
    (0..splats.len())
        .into_par_iter()
        .filter(|&i| {
            cameras.iter().zip(&nearest).any(|(camera, &nearest)| {
                depth(splats, i, camera, REACH).is_some_and(|depth| depth < nearest)
            })
        })
        .collect()
}

/// Depth of a splat's centre, if it lies before the camera and the picture shows the splat: the
/// centre, widened by `reach` standard deviations.
fn depth(splats: &SplatArrays, i: usize, camera: &Camera, reach: f64) -> Option<f64> {
    let t = camera.viewmat.transform_point3(glam::DVec3::from(splats.means[i].map(f64::from)));
    if t.z.is_nan() || t.z <= 0.0 {
        return None;
    }
    let largest = splats.scales[i].iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let radius = if reach > 0.0 { reach * f64::from(largest).exp() } else { 0.0 };
    let shows = |x: f64, focal: f64, centre: f64, side: u32| {
        let (middle, wide) = (focal * x / t.z + centre, focal * radius / t.z);
        middle + wide >= 0.0 && middle - wide <= f64::from(side)
    };
    let is_shown = shows(t.x, camera.fx, camera.cx, camera.width)
        && shows(t.y, camera.fy, camera.cy, camera.height);
    is_shown.then_some(t.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Camera = Camera {
        viewmat: glam::DMat4::IDENTITY,
        fx: 50.0,
        fy: 50.0,
        cx: 50.0,
        cy: 50.0,
        width: 100,
        height: 100,
    };

    /// A wall of 400 splats 4 units before the camera, and others.
    fn wall_and(others: &[([f32; 3], f32)]) -> SplatArrays {
        let mut splats = SplatArrays::zeros(400 + others.len(), 0);
        for k in 0..400 {
            splats.means[k] = [(k % 20) as f32 * 0.4 - 3.8, (k / 20) as f32 * 0.4 - 3.8, 4.0];
            splats.scales[k] = [0.2f32.ln(); 3];
        }
        for (k, &(mean, size)) in others.iter().enumerate() {
            splats.means[400 + k] = mean;
            splats.scales[400 + k] = [size.ln(), (0.1 * size).ln(), (0.1 * size).ln()];
        }
        splats
    }

    #[test]
    fn what_is_far_nearer_than_the_nearest_surface_is_fog() {
        let splats = wall_and(&[
            ([0.1, 0.0, 1.0], 0.5),
            ([0.1, 0.0, 2.5], 0.5),  // not far nearer
            ([0.0, 0.0, -1.0], 0.5), // behind the camera
            ([3.0, 0.0, 1.0], 0.1),  // beside the picture
            ([3.0, 0.0, 1.0], 1.0),  // reaches into it
        ]);
        assert_eq!(fog(&splats, &[CAMERA]), [400, 404]);
        let mut away = CAMERA;
        away.viewmat = glam::DMat4::from_rotation_y(std::f64::consts::PI);
        assert!(fog(&splats, &[away]).is_empty(), "it shows too little to tell");
        assert_eq!(fog(&splats, &[away, CAMERA]), [400, 404]);
    }

    #[test]
    fn a_near_surface_is_none() {
        let near: Vec<_> = (0..20).map(|k| ([0.05 * k as f32 - 0.5, 0.3, 1.0], 0.05)).collect();
        assert!(fog(&wall_and(&near), &[CAMERA]).is_empty());
    }

    #[test]
    fn what_is_not_finite_is_passed_over() {
        let splats = wall_and(&[
            ([f32::NAN, 0.0, 1.0], 0.5),
            ([0.0, 0.0, f32::INFINITY], 0.5),
            ([0.0, 0.0, 1.0], f32::INFINITY),
        ]);
        assert_eq!(fog(&splats, &[CAMERA]), [402]);
        assert!(fog(&SplatArrays::zeros(0, 0), &[CAMERA]).is_empty());
    }
}
