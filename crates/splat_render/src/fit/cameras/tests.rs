//! Cameras that are pulled to the positions at which points should appear.

use glam::{DMat3, DMat4, DQuat, DVec3};

use super::anchor::anchor;
use super::motion::{POSE, move_by};
use super::preconditioning::focal_pixels;
use super::*;
use crate::fit_device::CameraGradient;

fn ring(n: usize) -> Vec<Camera> {
    (0..n)
        .map(|k| {
            let angle = k as f64 * 1.1;
            let center = DVec3::new(4.0 * angle.cos(), 0.5 * angle, 4.0 * angle.sin());
            let forward = -center.normalize();
            let right = forward.cross(DVec3::Y).normalize();
            let down = forward.cross(right);
            let rotation = DMat3::from_cols(right, down, forward).transpose();
            let rotation = DQuat::from_mat3(&rotation);
            Camera {
                viewmat: DMat4::from_rotation_translation(rotation, -(rotation * center)),
                fx: 500.0,
                fy: 510.0,
                cx: 200.0,
                cy: 190.0,
                width: 400,
                height: 380,
            }
        })
        .collect()
}

fn config() -> CameraConfig {
    CameraConfig {
        poses: true,
        focal: Focal::Fixed,
        rate: 0.3,
        decay: 1e-2,
        warm_up: 0.0,
        anchored: true,
    }
}

/// A prior with the same standard deviation in pixels along every direction.
fn known(camera: &Camera, sigma: f64) -> PosePrior {
    let mut pose = [[0.0; POSE]; POSE];
    for (i, row) in pose.iter_mut().enumerate() {
        let length = if i < 3 { camera.fx } else { camera.fx / 4.0 };
        row[i] = (length / sigma).powi(2);
    }
    let log_focal = (focal_pixels(camera) / sigma).powi(2);
    PosePrior { viewmat: camera.viewmat, focal: [camera.fx, camera.fy], pose, log_focal }
}

const POINTS: [[f64; 3]; 6] = [
    [0.5, 0.0, 0.0],
    [-0.5, 0.3, 0.1],
    [0.1, -0.6, 0.4],
    [0.0, 0.2, -0.7],
    [0.9, 0.5, 0.6],
    [-0.4, -0.5, -0.6],
];

/// Gradient of half the squared distances between the points in two cameras' pictures.
fn gradient(view: usize, camera: &Camera, truth: &Camera) -> CameraGradient {
    let mut out = CameraGradient { view, ..CameraGradient::default() };
    for point in POINTS {
        let world = DVec3::from(point);
        let t = camera.viewmat.transform_point3(world);
        let s = truth.viewmat.transform_point3(world);
        let u = camera.fx * t.x / t.z - truth.fx * s.x / s.z;
        let v = camera.fy * t.y / t.z - truth.fy * s.y / s.z;
        let (du, dv) = (u * camera.fx / t.z, v * camera.fy / t.z);
        let v_t = [du, dv, -(du * t.x + dv * t.y) / t.z];
        for (row, v) in out.v_viewmat.iter_mut().zip(v_t) {
            for (out, x) in row.iter_mut().zip([world.x, world.y, world.z, 1.0]) {
                *out += v * x;
            }
        }
        out.v_intrinsics[0] += u * t.x / t.z;
        out.v_intrinsics[1] += v * t.y / t.z;
    }
    out
}

fn worst_angle(a: &[Camera], b: &[Camera]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| {
            DQuat::from_mat3(&(a.rotation() * b.rotation().transpose())).to_scaled_axis().length()
        })
        .fold(0.0, f64::max)
}

fn fitted(cameras: &mut Cameras, truth: &[Camera], rounds: u32) {
    for round in 0..rounds {
        let gradients: Vec<_> =
            truth.iter().enumerate().map(|(k, t)| gradient(k, &cameras.now()[k], t)).collect();
        cameras.add(&gradients);
        cameras.step(f64::from(round) / f64::from(rounds));
    }
}

#[test]
fn cameras_find_the_points_they_should_see() {
    let truth = ring(5);
    let mut noisy = truth.clone();
    for (k, camera) in noisy.iter_mut().enumerate() {
        let s = if k % 2 == 0 { 1.0 } else { -1.0 };
        move_by(camera, [0.01 * s, -0.008, 0.006 * s, 0.01, -0.02 * s, 0.015]);
    }
    let before = worst_angle(&noisy, &truth);
    let mut cameras =
        Cameras::new(&noisy, vec![4.0; 5], CameraConfig { anchored: false, ..config() });
    fitted(&mut cameras, &truth, 1000);
    let after = worst_angle(cameras.now(), &truth);
    assert!(after < 0.02 * before, "turns were {before:.2e} off and are {after:.2e}");
    for (a, b) in cameras.now().iter().zip(&truth) {
        let off = (a.center() - b.center()).length();
        assert!(off < 1e-3, "a center is {off:.2e} off");
        a.validate().unwrap();
    }
}

#[test]
fn a_shared_focal_length_is_found_and_stays_shared() {
    let truth = ring(4);
    let mut wrong = truth.clone();
    wrong.iter_mut().for_each(|c| (c.fx, c.fy) = (1.05 * c.fx, 1.05 * c.fy));
    let off = CameraConfig { poses: false, focal: Focal::Shared, ..config() };
    let mut cameras = Cameras::new(&wrong, vec![4.0; 4], off);
    fitted(&mut cameras, &truth, 300);
    for (a, b) in cameras.now().iter().zip(&truth) {
        assert!((a.fx / b.fx - 1.0).abs() < 1e-3, "{} for {}", a.fx, b.fx);
        assert_eq!(a.fx, cameras.now()[0].fx);
        assert_eq!(a.viewmat, b.viewmat);
    }
}

#[test]
fn anchored_cameras_do_not_move_all_together() {
    let initial = ring(6);
    let mut now = initial.clone();
    let turn = DQuat::from_scaled_axis(DVec3::new(0.05, -0.1, 0.02));
    for camera in &mut now {
        let center = turn * (1.2 * camera.center()) + DVec3::new(0.3, 0.1, -0.2);
        let rotation = DQuat::from_mat3(&camera.rotation()) * turn.inverse();
        camera.viewmat = DMat4::from_rotation_translation(rotation, -(rotation * center));
    }
    anchor(&mut now, &initial, &[4.0; 6]);
    for (a, b) in now.iter().zip(&initial) {
        assert!(a.viewmat.abs_diff_eq(b.viewmat, 1e-12), "{} {}", a.viewmat, b.viewmat);
    }
    let mut one = vec![initial[0]];
    move_by(&mut one[0], [0.1; 6]);
    anchor(&mut one, &initial[..1], &[4.0]);
    assert!(one[0].viewmat.abs_diff_eq(initial[0].viewmat, 1e-12));
}

#[test]
fn cameras_at_one_place_keep_the_scale_of_their_moves() {
    // Up to rounding at one place, looking different ways.
    let place = DVec3::new(31.3, -12.7, 5.4);
    let initial: Vec<Camera> = ring(5)
        .iter()
        .map(|camera| {
            let rotation = DQuat::from_mat3(&camera.rotation());
            let viewmat = DMat4::from_rotation_translation(rotation, -(rotation * place));
            Camera { viewmat, ..*camera }
        })
        .collect();
    let mut now = initial.clone();
    for (k, camera) in now.iter_mut().enumerate() {
        let s = k as f64 - 2.0;
        move_by(camera, [0.0, 0.0, 0.0, 0.02 * s, 0.0, 0.01 * s]);
    }
    let lengths = |cameras: &[Camera]| -> Vec<f64> {
        let mean = cameras.iter().map(Camera::center).sum::<DVec3>() / 5.0;
        cameras.iter().map(|c| (c.center() - mean).length()).collect()
    };
    let before = lengths(&now);
    anchor(&mut now, &initial, &[4.0; 5]);
    for (a, b) in lengths(&now).iter().zip(before) {
        assert!((a - b).abs() < 1e-9, "{b} became {a}");
    }
}

#[test]
fn cameras_with_priors_move_along_unknown_directions() {
    let truth = ring(4);
    let off = CameraConfig { anchored: false, focal: Focal::PerCamera, ..config() };
    let mut told = truth.clone();
    for camera in &mut told {
        move_by(camera, [0.01, -0.008, 0.006, 0.01, -0.02, 0.015]);
        (camera.fx, camera.fy) = (1.02 * camera.fx, 1.02 * camera.fy);
    }
    // A hundredth of a pixel: the points pull by several, hard enough at any distance.
    let surely: Vec<PosePrior> = told.iter().map(|camera| known(camera, 0.01)).collect();
    let mut cameras = Cameras::new(&told, vec![4.0; 4], off);
    cameras.set_pose_priors(surely.clone()).unwrap();
    fitted(&mut cameras, &truth, 400);
    for (now, told) in cameras.now().iter().zip(&told) {
        let turned = worst_angle(&[*now], &[*told]) * told.fx;
        let moved = (now.center() - told.center()).length() * told.fx / 4.0;
        let zoomed = (now.fx / told.fx).ln().abs() * focal_pixels(told);
        assert!(turned.max(moved).max(zoomed) < 0.02, "{turned} {moved} {zoomed}");
    }
    // Nothing is known of the turns, nor of the focal lengths: these are found.
    let mut turned = truth.clone();
    turned.iter_mut().for_each(|camera| move_by(camera, [0.01, -0.008, 0.006, 0.0, 0.0, 0.0]));
    let mut partly: Vec<PosePrior> = turned.iter().map(|camera| known(camera, 0.01)).collect();
    for prior in &mut partly {
        (0..3).for_each(|i| prior.pose[i][i] = 0.0);
        prior.log_focal = 0.0;
    }
    let before = worst_angle(&turned, &truth);
    let mut cameras = Cameras::new(&turned, vec![4.0; 4], off);
    cameras.set_pose_priors(partly).unwrap();
    fitted(&mut cameras, &truth, 1000);
    let after = worst_angle(cameras.now(), &truth);
    assert!(after < 0.02 * before, "turns were {before:.2e} off and are {after:.2e}");
    // Cameras that start elsewhere come back to the mean of their prior.
    let mut cameras = Cameras::new(&truth, vec![4.0; 4], off);
    cameras.set_pose_priors(surely).unwrap();
    (0..400).for_each(|_| cameras.step(0.0));
    assert!(worst_angle(cameras.now(), &told) * 500.0 < 0.02);
    assert!(cameras.now().iter().zip(&told).all(|(a, b)| (a.fx / b.fx - 1.0).abs() < 1e-4));
}

#[test]
fn empty_priors_change_no_bit_and_wrong_ones_are_refused() {
    let truth = ring(3);
    let mut noisy = truth.clone();
    move_by(&mut noisy[1], [0.01; 6]);
    let off = CameraConfig { focal: Focal::Shared, ..config() };
    let mut free = Cameras::new(&noisy, vec![4.0; 3], off);
    let mut held = Cameras::new(&noisy, vec![4.0; 3], off);
    let nothing = PosePrior { pose: [[0.0; POSE]; POSE], log_focal: 0.0, ..known(&truth[0], 1.0) };
    held.set_pose_priors(vec![nothing; 3]).unwrap();
    fitted(&mut free, &truth, 7);
    fitted(&mut held, &truth, 7);
    assert_eq!(free.state(), held.state());
    assert!(held.set_pose_priors(vec![nothing; 2]).is_err());
    assert!(held.set_pose_priors(vec![PosePrior { log_focal: f64::NAN, ..nothing }; 3]).is_err());
    assert!(held.set_pose_priors(vec![PosePrior { log_focal: -1.0, ..nothing }; 3]).is_err());
    assert!(held.set_pose_priors(vec![PosePrior { focal: [0.0, 1.0], ..nothing }; 3]).is_err());
}

#[test]
fn a_state_resumes_and_a_wrong_one_is_refused() {
    let truth = ring(3);
    let mut first = Cameras::new(&truth, vec![4.0; 3], config());
    let mut noisy = truth.clone();
    move_by(&mut noisy[1], [0.01; 6]);
    fitted(&mut first, &noisy, 5);
    first.add(&[gradient(2, &first.now()[2], &truth[0])]);
    let mut second = Cameras::new(&truth, vec![4.0; 3], config());
    second.resume(first.state()).unwrap();
    first.step(0.5);
    second.step(0.5);
    assert_eq!(first.state(), second.state());
    let mut short = first.state();
    short.first.pop();
    assert!(second.resume(short).is_err());
    let mut broken = first.state();
    broken.viewmats[0] = DMat4::from_scale(DVec3::splat(2.0));
    assert!(second.resume(broken).is_err());
}

/// Three cameras at one center that look up to 0.7 radians apart, for each camera of a ring.
fn rigs(n: usize) -> (Vec<Camera>, Vec<u32>) {
    let turned = |camera: &Camera, angle: f64| {
        let turn = DMat4::from_rotation_y(angle) * DMat4::from_rotation_z(0.5 * angle);
        Camera { viewmat: turn * camera.viewmat, ..*camera }
    };
    let cameras = ring(n);
    let views = cameras.iter().flat_map(|c| [-0.7, 0.0, 0.7].map(|angle| turned(c, angle)));
    (views.collect(), (0..n as u32).flat_map(|k| [k; 3]).collect())
}

/// Largest change of a turn between cameras of a rig, and of the distance between their centers.
fn bend(a: &[Camera], b: &[Camera], numbers: &[u32]) -> (f64, f64) {
    let (mut turns, mut centers) = (0.0_f64, 0.0_f64);
    for k in 1..a.len() {
        if numbers[k] == numbers[k - 1] {
            let within = |c: &[Camera]| c[k].rotation() * c[k - 1].rotation().transpose();
            let off = within(a) - within(b);
            turns = turns.max(off.to_cols_array().map(f64::abs).into_iter().fold(0.0, f64::max));
            centers = centers.max(a[k].center().distance(a[k - 1].center()));
        }
    }
    (turns, centers)
}

#[test]
fn rigs_find_the_points_and_keep_their_shape() {
    let (truth, numbers) = rigs(4);
    let mut noisy = truth.clone();
    for (k, camera) in noisy.iter_mut().enumerate() {
        // The same move of the whole rig, by its first camera.
        let first = k - k % 3;
        let s = if (k / 3) % 2 == 0 { 1.0 } else { -1.0 };
        let mut moved = truth[first];
        move_by(&mut moved, [0.01 * s, -0.008, 0.006 * s, 0.01, -0.02 * s, 0.015]);
        let within = truth[k].viewmat * truth[first].viewmat.inverse();
        camera.viewmat = within * moved.viewmat;
    }
    let off = CameraConfig { anchored: false, ..config() };
    let before = worst_angle(&noisy, &truth);
    let mut cameras = Cameras::new(&noisy, vec![4.0; 12], off);
    cameras.set_rigs(&numbers).unwrap();
    fitted(&mut cameras, &truth, 1000);
    let after = worst_angle(cameras.now(), &truth);
    assert!(after < 0.02 * before, "turns were {before:.2e} off and are {after:.2e}");
    let (turns, centers) = bend(cameras.now(), &truth, &numbers);
    assert!(turns < 1e-9 && centers < 1e-9, "a rig bent by {turns:.1e} and {centers:.1e}");

    // Without rigs, noisy gradients pull its cameras apart.
    let mut free = Cameras::new(&noisy, vec![4.0; 12], off);
    fitted(&mut free, &truth, 30);
    assert!(bend(free.now(), &truth, &numbers).1 > 1e-4);
}

#[test]
fn a_prior_of_one_camera_keeps_its_rig_in_place() {
    let (told, numbers) = rigs(3);
    let pushed: Vec<_> = told
        .iter()
        .map(|c| {
            let mut moved = *c;
            move_by(&mut moved, [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]);
            moved
        })
        .collect();
    // Only the first camera of each rig is known.
    let mut priors: Vec<_> = told.iter().map(|camera| known(camera, 0.1)).collect();
    for (k, prior) in priors.iter_mut().enumerate() {
        if k % 3 != 0 {
            (prior.pose, prior.log_focal) = ([[0.0; POSE]; POSE], 0.0);
        }
    }
    let off = CameraConfig { anchored: false, ..config() };
    let mut cameras = Cameras::new(&told, vec![4.0; 9], off);
    cameras.set_rigs(&numbers).unwrap();
    cameras.set_pose_priors(priors).unwrap();
    fitted(&mut cameras, &pushed, 100);
    let moved = worst_angle(cameras.now(), &told);
    assert!(moved < 0.002, "known rigs turned by {moved:.2e}");
    let (turns, centers) = bend(cameras.now(), &told, &numbers);
    assert!(turns < 1e-9 && centers < 1e-9);
}

#[test]
fn rigs_of_cameras_that_stand_apart_are_refused() {
    let mut cameras = Cameras::new(&ring(3), vec![4.0; 3], config());
    assert!(cameras.set_rigs(&[0, 1]).unwrap_err().to_string().contains("one number for each"));
    assert!(cameras.set_rigs(&[0, 1, 0]).unwrap_err().to_string().contains("share a center"));
    cameras.set_rigs(&[0, 1, 2]).unwrap();
}
