//! Turns and moves of a camera, and gradients with respect to them.

use glam::{DMat4, DQuat, DVec3};

use crate::camera::Camera;
use crate::fit_device::CameraGradient;

/// Degrees of freedom of a pose: turn (radians) about and move along x, y, z of the camera.
pub(super) const POSE: usize = 6;

/// A matrix over a pose's degrees of freedom, row by row.
pub(super) type PoseMatrix = [[f64; POSE]; POSE];

/// Gradient of turn, move and logarithm of the focal length.
pub(super) fn tangent(camera: &Camera, v: &CameraGradient) -> [f64; 7] {
    // A turn w takes the viewmat V to (1 + [w]x) V.
    let viewmat = camera.viewmat;
    let along =
        |r: usize, c: usize| -> f64 { (0..4).map(|k| v.v_viewmat[r][k] * viewmat.col(k)[c]).sum() };
    let [v_fx, v_fy, ..] = v.v_intrinsics;
    [
        along(2, 1) - along(1, 2),
        along(0, 2) - along(2, 0),
        along(1, 0) - along(0, 1),
        v.v_viewmat[0][3],
        v.v_viewmat[1][3],
        v.v_viewmat[2][3],
        v_fx * camera.fx + v_fy * camera.fy,
    ]
}

/// Turns and moves a camera by a tangent vector.
pub(super) fn move_by(camera: &mut Camera, [wx, wy, wz, tx, ty, tz]: [f64; POSE]) {
    let turn = DQuat::from_scaled_axis(DVec3::new(wx, wy, wz));
    let rotation = (turn * DQuat::from_mat3(&camera.rotation())).normalize();
    let translation = turn * camera.translation() + DVec3::new(tx, ty, tz);
    camera.viewmat = DMat4::from_rotation_translation(rotation, translation);
}

/// The turn and move that take one camera to another: [`move_by`] with it does.
pub(super) fn between(from: &Camera, to: &Camera) -> [f64; POSE] {
    let turn = DQuat::from_mat3(&to.rotation()) * DQuat::from_mat3(&from.rotation()).inverse();
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let moved = to.translation() - turn * from.translation();
    let turned = turn.to_scaled_axis();
    [turned.x, turned.y, turned.z, moved.x, moved.y, moved.z]
}
