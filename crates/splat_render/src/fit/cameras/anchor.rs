//! Keeping cameras from moving all together, which no photo shows.

use glam::{DMat3, DMat4, DQuat, DVec3};

use crate::camera::Camera;

/// Cameras nearer together than this part of their distance to the scene stand at one place.
const ONE_PLACE: f64 = 1e-3;

/// Moves all cameras by the similarity that brings them nearest to their initial poses: orientations on
/// average, centers in the least-squares sense. Cameras with a common center, compared to their distances
/// to the scene, keep no scale.
pub(super) fn anchor(now: &mut [Camera], initial: &[Camera], distances: &[f64]) {
    let n = now.len() as f64;
    // World turns that take each camera's orientation back; all are small, so that signs agree.
    let turns = now.iter().zip(initial).map(|(now, initial)| {
        let turn = DQuat::from_mat3(&(initial.rotation().transpose() * now.rotation()));
        if turn.w < 0.0 { -turn } else { turn }
    });
    let sum = turns.fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, turn| sum + turn);
    let turn = DMat3::from_quat(sum.normalize());
    let mean = |cameras: &[Camera]| cameras.iter().map(Camera::center).sum::<DVec3>() / n;
    let (from, to) = (mean(now), mean(initial));
    let offsets = || {
        now.iter()
            .zip(initial)
            .map(|(now, initial)| (turn * (now.center() - from), initial.center() - to))
    };
    let spread: f64 = offsets().map(|(a, _)| a.length_squared()).sum();
    let initial_spread: f64 = offsets().map(|(_, b)| b.length_squared()).sum();
    let matched: f64 = offsets().map(|(a, b)| a.dot(b)).sum();
    let reach = distances.iter().sum::<f64>() / n;
    let apart = initial_spread > n * (ONE_PLACE * reach).powi(2);
    let scale = if apart && matched > 0.0 { matched / spread } else { 1.0 };
    for camera in now {
        let center = to + scale * (turn * (camera.center() - from));
        let rotation = camera.rotation() * turn.transpose();
        let rotation = DQuat::from_mat3(&rotation).normalize();
        camera.viewmat = DMat4::from_rotation_translation(rotation, -(rotation * center));
    }
}
