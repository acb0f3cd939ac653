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

/// Photos are halved until their longer side has at most this many pixels, at most twice.
const COARSEST_PX: usize = 160;
const MAX_LEVELS: usize = 3;
/// Iterations at the coarsest level without regard to other maps; then stages of iterations after each
/// of which the maps are exchanged, at the coarsest level and at the others.
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

/// The depth map of each search's photo, of which each has at most one. The same on any number of
/// threads.
pub fn depth_maps(photos: &[GrayPhoto], searches: &[Search]) -> Result<Vec<DepthMap>> {
    check(photos, searches)?;
    let longest = photos.iter().map(|photo| photo.camera.width.max(photo.camera.height)).max();
    let mut count = 1;
    while count < MAX_LEVELS && longest.unwrap_or(0) as usize > COARSEST_PX << (count - 1) {
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
        let stages: Vec<Stage> =
            searches.iter().map(|search| Stage::new(&at_level, search, &map_of, level)).collect();
        maps = stages
            .par_iter()
            .enumerate()
            .map(|(k, stage)| match maps.get(k) {
                Some(coarse) => stage.doubled(coarse),
                None => {
                    let scale = 0.5f32.powi(count as i32 - 1);
                    stage.run(stage.random(&searches[k].seeds, scale), &[], FIRST_ITERATIONS)
                }
            })
            .collect();
        for &iterations in STAGES[level.min(1)] {
            maps = stages
                .par_iter()
                .enumerate()
                .map(|(k, stage)| stage.run(maps[k].clone(), &maps, iterations))
                .collect();
        }
        if level + 1 == count {
            return Ok(stages
                .par_iter()
                .enumerate()
                .map(|(k, s)| confirmed(s, k, &maps))
                .collect());
        }
    }
    Ok(Vec::new())
}

fn check(photos: &[GrayPhoto], searches: &[Search]) -> Result<()> {
    for (k, photo) in photos.iter().enumerate() {
        photo.camera.validate()?;
        let pixels = photo.camera.width as usize * photo.camera.height as usize;
        let usable = photo.usable.as_ref().map_or(pixels, Vec::len);
        if photo.gray.len() != pixels || usable != pixels {
            return Err(Error::argument(format!("photos[{k}]"), "does not fit its camera's size"));
        }
        if !photo.gray.iter().all(|v| v.abs() <= 1.0) {
            return Err(Error::argument(format!("photos[{k}]"), "has gray outside of 0..1"));
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
        if !(near.is_finite() && far > 0.0 && near > far) {
            return bad("needs finite depths above 0, the nearest first");
        }
        if !search.seeds.as_flattened().iter().all(|v| v.is_finite()) {
            return bad("has seeds that are not finite");
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DMat4, DVec3};

    const SIZE: usize = 96;
    /// The point (0, 0, 2) and the normal of a slanted plane.
    const PLANE: (DVec3, DVec3) = (DVec3::new(0.0, 0.0, 2.0), DVec3::new(0.5, 0.2, -1.0));

    fn ray(camera: &Camera, pixel: usize) -> DVec3 {
        let (x, y) = ((pixel % SIZE) as f64 + 0.5, (pixel / SIZE) as f64 + 0.5);
        DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0)
    }

    /// The plane with a texture from a camera that is turned about its point by an angle.
    fn photo(degrees: f64, gain: f32) -> GrayPhoto {
        let turn = DMat3::from_rotation_y(degrees.to_radians());
        let camera = Camera {
            viewmat: DMat4::from_mat3(turn)
                + DMat4::from_cols(
                    glam::DVec4::ZERO,
                    glam::DVec4::ZERO,
                    glam::DVec4::ZERO,
                    (PLANE.0 - turn * PLANE.0).extend(0.0),
                ),
            fx: 120.0,
            fy: 110.0,
            cx: 47.0,
            cy: 49.0,
            width: SIZE as u32,
            height: SIZE as u32,
        };
        let gray = (0..SIZE * SIZE).map(|pixel| {
            let (direction, center) = (turn.transpose() * ray(&camera, pixel), camera.center());
            let along = (PLANE.0 - center).dot(PLANE.1) / direction.dot(PLANE.1);
            let at = center + along * direction;
            let fine = (31.0 * at.x + 9.0 * at.y).sin() + (37.0 * at.y - 23.0 * at.x * at.y).cos();
            gain * (0.5 + 0.12 * fine + 0.1 * (11.0 * at.x - 17.0 * at.y * at.y).sin()) as f32
        });
        GrayPhoto { camera, gray: gray.collect(), usable: None }
    }

    /// A search of each photo among all others.
    fn maps(photos: &[GrayPhoto]) -> Vec<DepthMap> {
        let search = |photo| Search {
            photo,
            others: (0..photos.len()).filter(|&other| other != photo).collect(),
            range: [1.0, 0.25],
            seeds: Vec::new(),
        };
        let searches: Vec<Search> = (0..photos.len()).map(search).collect();
        depth_maps(photos, &searches).unwrap()
    }

    fn confirmed(map: &DepthMap) -> usize {
        map.depth.iter().filter(|&&depth| depth > 0.0).count()
    }

    #[test]
    fn finds_a_slanted_plane_from_afar_whatever_the_exposure() {
        for angle in [5.0, 20.0, 40.0] {
            let photos = [photo(0.0, 1.0), photo(angle, 0.7), photo(-angle, 0.9)];
            let map = &maps(&photos)[0];
            let (mut depths, mut normals) = (Vec::new(), Vec::new());
            for pixel in 0..SIZE * SIZE {
                let depth = f64::from(map.depth[pixel]);
                assert_eq!(depth > 0.0, map.confidence[pixel] > 0.0);
                assert!((0.0..=1.0).contains(&map.confidence[pixel]));
                if depth > 0.0 {
                    let wanted = PLANE.0.dot(PLANE.1) / ray(&photos[0].camera, pixel).dot(PLANE.1);
                    depths.push((depth / wanted - 1.0).abs());
                    let normal = DVec3::from(map.normal[pixel].map(f64::from));
                    normals.push(normal.dot(PLANE.1.normalize()).clamp(-1.0, 1.0).acos());
                }
            }
            depths.sort_by(f64::total_cmp);
            normals.sort_by(f64::total_cmp);
            let (count, most) = (depths.len(), depths.len() * 9 / 10);
            assert!(count > SIZE * SIZE / 3, "{count} pixels at {angle} degrees");
            assert!(depths[most] < 0.003, "{} at {angle} degrees", depths[most]);
            assert!(normals[count / 2].to_degrees() < 4.0, "{} at {angle}", normals[count / 2]);
        }
    }

    #[test]
    fn two_other_maps_confirm_a_depth() {
        let noise = |pixel: usize| (pixel * 7919 % 1009) as f32 / 1009.0;
        let strange = GrayPhoto { gray: (0..SIZE * SIZE).map(noise).collect(), ..photo(10.0, 1.0) };
        let right = [photo(0.0, 1.0), photo(20.0, 1.0)];
        let alone = confirmed(&maps(&right)[0]);
        assert!(alone > SIZE * SIZE / 3, "{alone}");
        let [first, second] = right;
        assert!(confirmed(&maps(&[first, strange, second])[0]) < alone / 4);
    }

    #[test]
    fn masked_pixels_have_no_depth_and_do_not_matter() {
        let usable: Vec<bool> = (0..SIZE * SIZE).map(|pixel| pixel / SIZE < 60).collect();
        let masked = |behind: f32| {
            let mut photos = [photo(0.0, 1.0), photo(20.0, 1.0), photo(-20.0, 1.0)];
            for photo in &mut photos {
                let hidden = photo.gray.iter_mut().zip(&usable).filter(|(_, usable)| !**usable);
                hidden.for_each(|(gray, _)| *gray = behind);
                photo.usable = Some(usable.clone());
            }
            maps(&photos)
        };
        let found = masked(0.0);
        assert!(confirmed(&found[0]) > SIZE * 20);
        assert!(found[0].depth[60 * SIZE..].iter().all(|&depth| depth == 0.0));
        assert_eq!(found, masked(1.0));
    }

    #[test]
    fn nothing_is_confirmed_without_texture_or_parallax() {
        let mut flat = [photo(0.0, 1.0), photo(20.0, 1.0), photo(-20.0, 1.0)];
        flat.iter_mut().for_each(|photo| photo.gray.fill(0.4));
        let same = [photo(0.0, 1.0), photo(0.0, 0.5), photo(0.0, 1.0)];
        for photos in [&flat[..], &same, &same[..1]] {
            for map in maps(photos) {
                assert_eq!(confirmed(&map), 0);
                assert!(map.normal.as_flattened().iter().all(|&v| v == 0.0));
            }
        }
    }

    #[test]
    fn threads_do_not_change_bits() {
        let photos = [photo(0.0, 1.0), photo(20.0, 1.0), photo(-20.0, 1.0)];
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| maps(&photos))
        };
        let one = with(1);
        assert!([2, 4].into_iter().all(|threads| with(threads) == one));
    }

    #[test]
    fn invalid_photos_and_searches_are_refused() {
        let photos = [photo(0.0, 1.0), photo(20.0, 1.0)];
        let right = Search { photo: 0, others: vec![1], range: [1.0, 0.25], seeds: vec![] };
        let error = |photos: &[GrayPhoto], searches: &[Search]| {
            depth_maps(photos, searches).unwrap_err().to_string()
        };
        for wrong in [
            Search { photo: 2, ..right.clone() },
            Search { others: vec![2], ..right.clone() },
            Search { others: vec![0], ..right.clone() },
            Search { others: vec![1; MAX_OTHERS + 1], ..right.clone() },
            Search { range: [f32::NAN, 0.25], ..right.clone() },
            Search { range: [1.0, f32::NAN], ..right.clone() },
            Search { range: [0.25, 1.0], ..right.clone() },
            Search { seeds: vec![[1.0, f32::NAN, 1.0]], ..right.clone() },
        ] {
            assert!(error(&photos, &[wrong]).starts_with("searches[0]: "));
        }
        assert!(error(&photos, &[right.clone(), right]).starts_with("searches[1]: "));
        let mut short = photo(0.0, 1.0);
        short.gray.pop();
        assert!(error(&[short], &[]).starts_with("photos[0]: "));
        let mut wrong = photo(0.0, 1.0);
        wrong.gray[3] = f32::NAN;
        assert!(error(&[wrong], &[]).starts_with("photos[0]: "));
        let mut degenerate = photo(0.0, 1.0);
        degenerate.camera.viewmat.w_axis.x = f64::NAN;
        assert!(error(&[degenerate], &[]).starts_with("viewmat: "));
    }
}
