//! Fog: splats right in front of a camera, far nearer than the surfaces in its picture.
//!
//! Fog explains differences between photos (exposure, vignetting) and hides the scene, which then gets no
//! gradients. The host estimates each camera's nearest surface from a sample of the splats. Every splat
//! is compared with it in f32, without operations that round differently on a GPU.

use bytemuck::{Pod, Zeroable};

use crate::camera::Camera;
use crate::fit_device::exp_accurate;

/// Part of the splats that a camera shows at least as near as its nearest surface.
const NEAREST: f64 = 0.01;
/// Fog is nearer than this part of that depth.
const BEFORE: f32 = 0.5;
/// Maximum and minimum number of splats sampled for the nearest surface.
const SAMPLES: (usize, usize) = (10_000, 100);
/// Standard deviations of its longest axis that a splat reaches to.
const REACH: f32 = 3.0;

/// A camera, and the depth before which splats are fog.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct FogCamera {
    /// Rows of the world-to-camera matrix.
    pub rows: [[f32; 4]; 3],
    pub focal: [f32; 2],
    pub principal: [f32; 2],
    /// Width and height, pixels.
    pub size: [f32; 2],
    pub nearest: f32,
    pub unused: f32,
}

/// Stride of the sample.
pub(crate) fn sampled_every(splats: usize) -> usize {
    splats.div_ceil(SAMPLES.0).max(1)
}

impl FogCamera {
    /// `sample` has the centers of every [`sampled_every`] splats.
    pub fn new(camera: &Camera, sample: &[[f32; 3]]) -> Self {
        let row = |i: usize| camera.viewmat.row(i).to_array().map(|v| v as f32);
        let mut out = Self {
            rows: [row(0), row(1), row(2)],
            focal: [camera.fx as f32, camera.fy as f32],
            principal: [camera.cx as f32, camera.cy as f32],
            size: [camera.width as f32, camera.height as f32],
            nearest: f32::INFINITY,
            unused: 0.0,
        };
        let mut depths: Vec<f32> = sample.iter().filter_map(|&mean| out.depth(mean, 0.0)).collect();
        out.nearest = if depths.len() < SAMPLES.1 {
            0.0
        } else {
            let at = (NEAREST * depths.len() as f64) as usize;
            BEFORE * *depths.select_nth_unstable_by(at, f32::total_cmp).1
        };
        out
    }

    /// Depth of a center, if it lies before the camera, nearer than its nearest surface, and the picture
    /// shows it, widened by `radius`. As `is_fog` in mcmc_weigh.wgsl.
    fn depth(&self, [x, y, z]: [f32; 3], radius: f32) -> Option<f32> {
        let [u, v, depth] = self.rows.map(|[a, b, c, d]| ((a * x + b * y) + c * z) + d);
        if !(depth > 0.0 && depth < self.nearest) {
            return None;
        }
        let shows = |side: usize, u: f32| {
            let middle = self.focal[side] * u + self.principal[side] * depth;
            let wide = self.focal[side] * radius;
            middle + wide >= 0.0 && middle - wide <= self.size[side] * depth
        };
        (shows(0, u) && shows(1, v)).then_some(depth)
    }

    /// Whether a splat of these parameters is fog before this camera.
    pub fn has_fog(&self, mean: [f32; 3], [a, b, c]: [f32; 3]) -> bool {
        self.depth(mean, REACH * exp_accurate(a.max(b).max(c))).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splats::SplatArrays;

    /// Ids of the splats that are fog before some camera, rising.
    fn fog(splats: &SplatArrays, cameras: &[Camera]) -> Vec<usize> {
        let every = sampled_every(splats.len());
        let sample: Vec<_> = splats.means.iter().copied().step_by(every).collect();
        let cameras: Vec<_> =
            cameras.iter().map(|camera| FogCamera::new(camera, &sample)).collect();
        let is_fog = |&i: &usize| {
            cameras.iter().any(|camera| camera.has_fog(splats.means[i], splats.scales[i]))
        };
        (0..splats.len()).filter(is_fog).collect()
    }

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
    fn splats_far_nearer_than_the_nearest_surface_are_fog() {
        let splats = wall_and(&[
            ([0.1, 0.0, 1.0], 0.5),
            ([0.1, 0.0, 2.5], 0.5),  // not far nearer
            ([0.0, 0.0, -1.0], 0.5), // behind the camera
            ([3.0, 0.0, 1.0], 0.1),  // outside the picture
            ([3.0, 0.0, 1.0], 1.0),  // reaches into it
        ]);
        assert_eq!(fog(&splats, &[CAMERA]), [400, 404]);
        let mut away = CAMERA;
        away.viewmat = glam::DMat4::from_rotation_y(std::f64::consts::PI);
        assert!(fog(&splats, &[away]).is_empty(), "it shows too little");
        assert_eq!(fog(&splats, &[away, CAMERA]), [400, 404]);
    }

    #[test]
    fn a_near_surface_is_not_fog() {
        let near: Vec<_> = (0..20).map(|k| ([0.05 * k as f32 - 0.5, 0.3, 1.0], 0.05)).collect();
        assert!(fog(&wall_and(&near), &[CAMERA]).is_empty());
    }

    #[test]
    fn splats_that_are_not_finite_are_skipped() {
        let splats = wall_and(&[
            ([f32::NAN, 0.0, 1.0], 0.5),
            ([0.0, 0.0, f32::INFINITY], 0.5),
            ([0.0, 0.0, 1.0], f32::INFINITY),
        ]);
        assert_eq!(fog(&splats, &[CAMERA]), [402]);
        assert!(fog(&SplatArrays::zeros(0, 0), &[CAMERA]).is_empty());
    }
}
