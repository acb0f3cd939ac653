//! A path that the camera takes through places that were marked.

use glam::DVec3;

use crate::viewpoint::Viewpoint;

/// Places in the order in which they are passed.
#[derive(Debug, Clone, Default)]
pub struct CameraPath {
    /// The places.
    pub keys: Vec<Viewpoint>,
}

/// Cubic through b and c, with the slopes of their neighbours (Catmull and Rom 1974).
fn cubic(a: DVec3, b: DVec3, c: DVec3, d: DVec3, t: f64) -> DVec3 {
    let (t2, t3) = (t * t, t * t * t);
    0.5 * (2.0 * b
        + (c - a) * t
        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t2
        + (3.0 * b - a - 3.0 * c + d) * t3)
}

impl CameraPath {
    /// Pictures of the whole path with so many from each place to the next, both ends included.
    pub fn pictures(&self, between: u32) -> u32 {
        match self.keys.len() {
            0 => 0,
            keys => (keys as u32 - 1) * between + 1,
        }
    }

    /// Where the camera is `t` places after the first. There must be one.
    pub fn at(&self, t: f64) -> Viewpoint {
        let last = self.keys.len() - 1;
        let segment = (t.max(0.0) as usize).min(last.saturating_sub(1));
        let part = (t - segment as f64).clamp(0.0, 1.0);
        let key = |i: isize| &self.keys[(segment as isize + i).clamp(0, last as isize) as usize];
        let mut out = key(0).between(key(1), part);
        let points = [-1, 0, 1, 2].map(|i| key(i).pivot());
        let pivot = cubic(points[0], points[1], points[2], points[3], part);
        out.focus(pivot);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_path_passes_its_places_and_moves_smoothly_between() {
        let place = |x: f64| {
            Viewpoint::looking(DVec3::new(x, 0.3 * x * x, -5.0), DVec3::new(x, 0.0, 0.0), -DVec3::Y)
        };
        let path = CameraPath { keys: vec![place(0.0), place(1.0), place(3.0)] };
        assert_eq!(path.pictures(10), 21);
        for (i, key) in path.keys.iter().enumerate() {
            let there = path.at(i as f64);
            assert!(there.position.distance(key.position) < 1e-9, "misses place {i}");
        }
        let steps: Vec<DVec3> = (0..=40).map(|i| path.at(f64::from(i) / 20.0).pivot()).collect();
        let lengths: Vec<f64> = steps.windows(2).map(|s| s[1].distance(s[0])).collect();
        let jump = lengths.windows(2).map(|l| (l[1] - l[0]).abs()).fold(0.0, f64::max);
        assert!(jump < 0.02, "the speed jumps by {jump} of about 0.1 at a place");
        let alone = CameraPath { keys: vec![place(2.0)] };
        assert_eq!(alone.pictures(10), 1);
        assert!(alone.at(0.0).position.distance(place(2.0).position) < 1e-9);
    }
}
