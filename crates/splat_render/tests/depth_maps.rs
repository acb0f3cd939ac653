//! Depth maps by stereo, compared with a plane whose depth and normal are known.

use glam::{DMat3, DMat4, DVec3};
use splat_render::Camera;
use splat_render::fit::{DepthMap, GrayPhoto, Search, depth_maps};

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
        Search { others: vec![1; 9], ..right.clone() },
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
