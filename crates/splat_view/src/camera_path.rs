//! A camera path through marked places.

use std::path::PathBuf;

use glam::DVec3;

use crate::viewpoint::Viewpoint;

/// Marked places, in their order.
#[derive(Debug, Clone, Default)]
pub struct CameraPath {
    pub keys: Vec<Viewpoint>,
}

/// Cubic through b and c, with the slopes of their neighbors (Catmull and Rom 1974).
fn cubic(a: DVec3, b: DVec3, c: DVec3, d: DVec3, t: f64) -> DVec3 {
    let (t2, t3) = (t * t, t * t * t);
    0.5 * (2.0 * b
        + (c - a) * t
        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t2
        + (3.0 * b - a - 3.0 * c + d) * t3)
}

impl CameraPath {
    /// Number of pictures of the path, with `between` from each place to the next, ends included.
    pub fn pictures(&self, between: u32) -> u32 {
        match self.keys.len() {
            0 => 0,
            keys => (keys as u32 - 1) * between + 1,
        }
    }

    /// The view at parameter `t`; t = k is place k. None without places.
    pub fn at(&self, t: f64) -> Option<Viewpoint> {
        let last = self.keys.len().checked_sub(1)?;
        let segment = (t.max(0.0) as usize).min(last.saturating_sub(1));
        let part = (t - segment as f64).clamp(0.0, 1.0);
        let key = |i: isize| &self.keys[(segment as isize + i).clamp(0, last as isize) as usize];
        let mut out = key(0).between(key(1), part);
        let points = [-1, 0, 1, 2].map(|i| key(i).pivot());
        let pivot = cubic(points[0], points[1], points[2], points[3], part);
        out.focus(pivot);
        Some(out)
    }
}

/// A path whose pictures are being drawn to files.
#[derive(Debug, Clone)]
pub struct Recording {
    /// A copy: places may be marked and cleared meanwhile.
    path: CameraPath,
    /// Pictures from each place to the next, as set at the start.
    between: u32,
    pub folder: PathBuf,
    pub next: u32,
}

impl Recording {
    /// Records a path as it is now, with `between` pictures from each place to the next.
    pub fn new(path: &CameraPath, between: u32, folder: PathBuf) -> Self {
        Self { path: path.clone(), between: between.max(1), folder, next: 0 }
    }

    pub fn total(&self) -> u32 {
        self.path.pictures(self.between)
    }

    /// The view of the next picture; None after the last.
    pub fn place(&self) -> Option<Viewpoint> {
        let is_left = self.next < self.total();
        self.path.at(f64::from(self.next) / f64::from(self.between)).filter(|_| is_left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(x: f64) -> Viewpoint {
        Viewpoint::looking(DVec3::new(x, 0.3 * x * x, -5.0), DVec3::new(x, 0.0, 0.0), -DVec3::Y)
    }

    #[test]
    fn a_recording_ends_after_its_last_place() {
        let mut path = CameraPath { keys: vec![place(0.0), place(1.0)] };
        let mut recording = Recording::new(&path, 4, PathBuf::new());
        path.keys.clear();
        assert!(path.at(0.0).is_none());
        let mut places = Vec::new();
        while let Some(place) = recording.place() {
            places.push(place);
            recording.next += 1;
        }
        assert_eq!((places.len(), recording.total()), (5, 5));
        assert!(places[4].position.distance(place(1.0).position) < 1e-9);
    }

    #[test]
    fn the_path_passes_its_places_and_moves_smoothly_between() {
        let path = CameraPath { keys: vec![place(0.0), place(1.0), place(3.0)] };
        assert_eq!(path.pictures(10), 21);
        for (i, key) in path.keys.iter().enumerate() {
            let there = path.at(i as f64).expect("a place");
            assert!(there.position.distance(key.position) < 1e-9, "misses place {i}");
        }
        let at = |t: f64| path.at(t).expect("a place").pivot();
        let steps: Vec<DVec3> = (0..=40).map(|i| at(f64::from(i) / 20.0)).collect();
        let lengths: Vec<f64> = steps.windows(2).map(|s| s[1].distance(s[0])).collect();
        let jump = lengths.windows(2).map(|l| (l[1] - l[0]).abs()).fold(0.0, f64::max);
        assert!(jump < 0.02, "the speed jumps by {jump} of about 0.1 at a place");
        let alone = CameraPath { keys: vec![place(2.0)] };
        assert_eq!(alone.pictures(10), 1);
        let there = alone.at(0.0).expect("a place");
        assert!(there.position.distance(place(2.0).position) < 1e-9);
    }
}
