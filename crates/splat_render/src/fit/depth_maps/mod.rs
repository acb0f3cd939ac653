//! Depth maps of photos by PatchMatch stereo: a plane per pixel, found by taking over planes of pixels
//! nearby and by random changes (Bleyer et al. 2011), for half of the pixels at a time as on a
//! checkerboard (Galliani et al. 2015), on photos of growing size, with a preference for depths that
//! other photos' maps have too (Xu and Tao 2019). Patches are compared as the plane has them seen, so
//! photos may be far apart.

mod agreement;
mod pairs;
mod patch;
mod search;

use rayon::prelude::*;

use crate::camera::Camera;
use crate::error::{Error, Result};
use agreement::confirmed;
use pairs::{Level, levels};
use search::{PlaneMap, Stage};

/// Photos are halved until their sides have at most this many pixels, at most twice and not below the
/// second number.
const COARSEST_PX: u32 = 160;
const MIN_SIDE_PX: u32 = 16;
const MAX_LEVELS: usize = 3;
/// Iterations at the coarsest level without other photos' maps; then iterations of each stage with them,
/// at the coarsest level and at finer levels. The maps are exchanged between stages.
const FIRST_ITERATIONS: usize = 6;
const STAGES: [&[usize]; 2] = [&[2, 1], &[1, 1]];
/// Maximum number of photos that one is compared with.
const MAX_OTHERS: usize = 8;

/// A photo to search, or to compare with.
#[derive(Debug, Clone)]
pub struct GrayPhoto {
    /// Its camera.
    pub camera: Camera,
    /// `[H * W]` gray in 0..1, row-major.
    pub gray: Vec<f32>,
    /// `[H * W]` which pixels count, or None for all.
    pub usable: Option<Vec<bool>>,
}

/// A depth map to compute.
#[derive(Debug, Clone)]
pub struct Search {
    /// Index of the photo.
    pub photo: usize,
    /// Indices of the photos to compare with.
    pub others: Vec<usize>,
    /// The inverse depths of the nearest and the farthest surface.
    pub range: [f32; 2],
    /// Column and row in pixels and inverse depth of points that are known to start from.
    pub seeds: Vec<[f32; 3]>,
}

/// Surfaces that depth maps of other photos confirm.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// `[H * W]` z-depth, 0 if nothing confirms it.
    pub depth: Vec<f32>,
    /// `[H * W]` unit normals towards the camera, in its frame; 0 without depth.
    pub normal: Vec<[f32; 3]>,
    /// `[H * W]` in 0..=1, by correlation and by how many maps agree; 0 without depth.
    pub confidence: Vec<f32>,
}

/// The depth map of each search's photo; a photo has at most one search. The same on any number of
/// threads.
pub fn depth_maps(photos: &[GrayPhoto], searches: &[Search]) -> Result<Vec<DepthMap>> {
    check(photos, searches)?;
    let sides = || photos.iter().flat_map(|photo| [photo.camera.width, photo.camera.height]);
    let (least, most) = (sides().min().unwrap_or(0), sides().max().unwrap_or(0));
    let mut count = 1;
    while count < MAX_LEVELS && most > COARSEST_PX << (count - 1) && least >> count >= MIN_SIDE_PX {
        count += 1;
    }
    let pyramids: Vec<Vec<Level>> = photos.par_iter().map(|photo| levels(photo, count)).collect();
    let mut map_of = vec![None; photos.len()];
    for (k, search) in searches.iter().enumerate() {
        map_of[search.photo] = Some(k);
    }
    let mut maps: Vec<PlaneMap> = Vec::new();
    for level in 0..count {
        let at_level: Vec<&Level> = pyramids.iter().map(|levels| &levels[level]).collect();
        let stages: Vec<Stage> = searches
            .iter()
            .map(|search| Stage::new(&at_level, search, &map_of, level as u32))
            .collect();
        let first = |(k, stage): (usize, &Stage<'_>)| match maps.get(k) {
            Some(coarse) => stage.doubled(coarse),
            None => {
                let scale = 0.5f32.powi(count as i32 - 1);
                stage.run(stage.random(&searches[k].seeds, scale), &[], FIRST_ITERATIONS)
            }
        };
        maps = stages.par_iter().enumerate().map(first).collect();
        for &iterations in STAGES[level.min(1)] {
            let next = |(k, map): (usize, &PlaneMap)| stages[k].run(map.clone(), &maps, iterations);
            maps = maps.par_iter().enumerate().map(next).collect();
        }
        if level + 1 == count {
            let confirm = |k| confirmed(&stages[k], k, &maps);
            return Ok((0..maps.len()).into_par_iter().map(confirm).collect());
        }
    }
    Ok(Vec::new())
}

fn check(photos: &[GrayPhoto], searches: &[Search]) -> Result<()> {
    for (k, photo) in photos.iter().enumerate() {
        photo.camera.validate()?;
        let pixels = photo.camera.width as usize * photo.camera.height as usize;
        let usable = photo.usable.as_ref().map_or(pixels, Vec::len);
        let in_range = photo.gray.iter().all(|v| v.abs() <= 1.0);
        if photo.gray.len() != pixels || usable != pixels || !in_range {
            let reason = "does not fit its camera's size, or has gray outside of 0..1";
            return Err(Error::argument(format!("photos[{k}]"), reason));
        }
    }
    let mut searched = vec![false; photos.len()];
    for (k, search) in searches.iter().enumerate() {
        let bad = |reason: &str| Err(Error::argument(format!("searches[{k}]"), reason));
        if search.others.iter().chain([&search.photo]).any(|&index| index >= photos.len()) {
            return bad("names a photo that does not exist");
        }
        if std::mem::replace(&mut searched[search.photo], true) {
            return bad("is not the only one of its photo");
        }
        if search.others.len() > MAX_OTHERS || search.others.contains(&search.photo) {
            return bad("must compare with at most 8 photos, none of them its own");
        }
        let [near, far] = search.range;
        let is_finite = search.seeds.as_flattened().iter().all(|v| v.is_finite());
        if !(is_finite && near.is_finite() && far > 0.0 && near > far) {
            return bad("needs finite depths above 0, the nearest first, and finite seeds");
        }
    }
    Ok(())
}
