//! The visual hull: where photos have alpha, nothing can be that a photo shows empty.

use glam::DVec3;

use crate::camera::Camera;
use crate::splats::SplatArrays;
use crate::target::Target;

/// Silhouettes of the photos that have alpha.
#[derive(Debug, Default)]
pub struct Hull {
    silhouettes: Vec<Silhouette>,
}

#[derive(Debug)]
struct Silhouette {
    /// Which photo's.
    view: usize,
    /// `[H * W]`, whether the pixel or a neighbour of it is covered: poses and edges are not exact.
    covered: Vec<bool>,
}

impl Hull {
    /// From photos; those without alpha say nothing, nor do masked pixels.
    pub fn new(targets: &[Target]) -> Self {
        let with_alpha = targets.iter().enumerate().filter(|(_, target)| target.channels == 4);
        Self {
            silhouettes: with_alpha
                .map(|(view, target)| Silhouette { view, covered: covered(target) })
                .collect(),
        }
    }

    /// Whether no photo, taken by these cameras, shows emptiness at this point, which is relative to
    /// the scene's origin.
    pub fn contains(&self, point: [f32; 3], cameras: &[Camera]) -> bool {
        let point = DVec3::from(point.map(f64::from));
        self.silhouettes.iter().all(|Silhouette { view, covered }| {
            let camera = &cameras[*view];
            let t = camera.viewmat.transform_point3(point);
            let x = (camera.fx * t.x / t.z + camera.cx).floor();
            let y = (camera.fy * t.y / t.z + camera.cy).floor();
            let (width, height) = (f64::from(camera.width), f64::from(camera.height));
            let inside = t.z > 0.0 && x >= 0.0 && y >= 0.0 && x < width && y < height;
            !inside || covered[y as usize * camera.width as usize + x as usize]
        })
    }

    /// Splats whose centres the hull contains; all, where it contains none.
    pub fn inside(&self, splats: &SplatArrays, cameras: &[Camera]) -> Vec<usize> {
        let ids: Vec<usize> =
            (0..splats.len()).filter(|&i| self.contains(splats.means[i], cameras)).collect();
        if ids.is_empty() { (0..splats.len()).collect() } else { ids }
    }
}

fn covered(target: &Target) -> Vec<bool> {
    let (width, height) = (target.width as usize, target.height as usize);
    let own: Vec<bool> = (0..width * height)
        .map(|k| {
            let masked = target.weights.as_ref().is_some_and(|weights| weights[k] == 0.0);
            masked || target.pixels[4 * k + 3] > 0
        })
        .collect();
    let mut out = vec![false; own.len()];
    for y in 0..height {
        for x in 0..width {
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let columns = x.saturating_sub(1)..(x + 2).min(width);
            out[y * width + x] =
                rows.into_iter().any(|r| columns.clone().any(|c| own[r * width + c]));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_photo_shows_empty_is_outside() {
        let (width, height) = (20u32, 10u32);
        let camera = Camera {
            viewmat: glam::DMat4::IDENTITY,
            fx: 10.0,
            fy: 10.0,
            cx: 10.0,
            cy: 5.0,
            width,
            height,
        };
        let mut pixels = vec![0u8; 4 * (width * height) as usize];
        // Covered: the right half.
        for k in 0..(width * height) as usize {
            pixels[4 * k + 3] = if k % width as usize >= 10 { 255 } else { 0 };
        }
        let target = Target {
            width,
            height,
            channels: 4,
            pixels,
            weights: None,
            depth: None,
            background: None,
            turns: 1,
            until: None,
        };
        let hull = Hull::new(std::slice::from_ref(&target));
        assert!(hull.contains([0.2, 0.0, 1.0], &[camera]));
        // One pixel beyond the edge is not sure to be empty; two are.
        assert!(hull.contains([-0.05, 0.0, 1.0], &[camera]));
        assert!(!hull.contains([-0.15, 0.0, 1.0], &[camera]));
        // Beside the picture and behind the camera it knows nothing.
        assert!(
            hull.contains([-3.0, 0.0, 1.0], &[camera])
                && hull.contains([-0.15, 0.0, -1.0], &[camera])
        );
        let mut splats = SplatArrays::zeros(3, 0);
        splats.means = vec![[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0], [f32::NAN; 3]];
        assert_eq!(hull.inside(&splats, &[camera]), [1, 2]);
        splats.means = vec![[-0.5, 0.0, 1.0]; 3];
        assert_eq!(hull.inside(&splats, &[camera]), [0, 1, 2], "a scene is never emptied");
        let masked = Target { weights: Some(vec![0.0; 200]), ..target.clone() };
        assert!(Hull::new(&[masked]).contains([-0.5, 0.0, 1.0], &[camera]));
        let opaque = Target { channels: 3, pixels: vec![0; 600], ..target };
        assert!(Hull::new(&[opaque]).contains([-0.5, 0.0, 1.0], &[camera]));
    }
}
