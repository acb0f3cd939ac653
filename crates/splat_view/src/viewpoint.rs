//! A view of the scene, and how it is moved.

use glam::{DMat3, DMat4, DQuat, DVec3};
use splat_render::Camera;

/// Smallest angle between the viewing direction and the up axis, radians.
const POLE: f64 = 0.02;

/// A camera's pose, with the pivot that orbits go about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewpoint {
    /// The camera's center in the world.
    pub position: DVec3,
    /// From camera axes (x right, y down, z forward) to the world.
    pub rotation: DQuat,
    /// Distance of the pivot, straight ahead.
    pub distance: f64,
}

impl Viewpoint {
    /// At `position`, looking at `target`.
    pub fn looking(position: DVec3, target: DVec3, up: DVec3) -> Self {
        let forward = (target - position).normalize_or(DVec3::Z);
        let right = forward.cross(up);
        let right = right.try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
        let axes = DMat3::from_cols(right, forward.cross(right), forward);
        Self {
            position,
            rotation: DQuat::from_mat3(&axes),
            distance: position.distance(target).max(f64::MIN_POSITIVE),
        }
    }

    /// A view in which a ball fills the picture, from a little above.
    pub fn framing(center: DVec3, radius: f64, up: DVec3, fov: f64) -> Self {
        // The usual forward direction of each convention: y down, or z up.
        let usual = if up.z.abs() > 0.9 { DVec3::Y } else { DVec3::Z };
        let level = (usual - up * up.dot(usual)).normalize_or(up.any_orthonormal_vector());
        let (sin, cos) = 15f64.to_radians().sin_cos();
        let distance = 1.1 * radius / (0.5 * fov).sin();
        Self::looking(center - (level * cos - up * sin) * distance, center, up)
    }

    /// A capture's camera; the pivot is the point straight ahead that is nearest to `center`.
    pub fn of_camera(camera: &Camera, center: DVec3, radius: f64) -> Self {
        let rotation = DQuat::from_mat3(&camera.rotation().transpose());
        let position = camera.center();
        let ahead = (rotation * DVec3::Z).dot(center - position);
        Self { position, rotation, distance: ahead.max(0.1 * radius) }
    }

    pub fn right(&self) -> DVec3 {
        self.rotation * DVec3::X
    }

    pub fn down(&self) -> DVec3 {
        self.rotation * DVec3::Y
    }

    /// Viewing direction in the world.
    pub fn forward(&self) -> DVec3 {
        self.rotation * DVec3::Z
    }

    /// The point that orbits go about.
    pub fn pivot(&self) -> DVec3 {
        self.position + self.forward() * self.distance
    }

    /// Looks around: radians to the right about `up`, and upward.
    pub fn turn(&mut self, yaw: f64, pitch: f64, up: DVec3) {
        let from_up = self.forward().angle_between(up);
        let pitch = pitch.clamp(from_up - (std::f64::consts::PI - POLE), from_up - POLE);
        let lean = DQuat::from_axis_angle(self.right(), pitch);
        // A right-handed rotation about the up axis turns to the left.
        let rotation = DQuat::from_axis_angle(up, -yaw) * lean * self.rotation;
        self.rotation = rotation.normalize();
    }

    pub fn orbit(&mut self, yaw: f64, pitch: f64, up: DVec3) {
        let pivot = self.pivot();
        self.turn(yaw, pitch, up);
        self.position = pivot - self.forward() * self.distance;
    }

    /// Moves so that the pivot's plane follows the pointer: world units to the right and down.
    pub fn pan(&mut self, right: f64, down: f64) {
        self.position -= self.right() * right + self.down() * down;
    }

    /// Divides the distance to the pivot by a factor.
    pub fn zoom(&mut self, factor: f64) {
        let pivot = self.pivot();
        self.distance = (self.distance / factor).clamp(1e-6, 1e9);
        self.position = pivot - self.forward() * self.distance;
    }

    /// Moves the pivot to a point, at the same distance and direction.
    pub fn focus(&mut self, target: DVec3) {
        self.position = target - self.forward() * self.distance;
    }

    pub fn viewmat(&self) -> DMat4 {
        DMat4::from_quat(self.rotation.inverse()) * DMat4::from_translation(-self.position)
    }

    /// A pinhole camera with the principal point at the center; `fov` is vertical, in radians.
    pub fn camera(&self, [width, height]: [u32; 2], fov: f64) -> Camera {
        let focal = 0.5 * f64::from(height) / (0.5 * fov).tan();
        Camera {
            viewmat: self.viewmat(),
            fx: focal,
            fy: focal,
            cx: 0.5 * f64::from(width),
            cy: 0.5 * f64::from(height),
            width,
            height,
        }
    }

    /// Interpolates to another view, along an arc if both look at the same point.
    pub fn between(&self, other: &Self, part: f64) -> Self {
        let rotation = self.rotation.slerp(other.rotation, part);
        let distance = self.distance + (other.distance - self.distance) * part;
        let pivot = self.pivot().lerp(other.pivot(), part);
        Self { position: pivot - rotation * DVec3::Z * distance, rotation, distance }
    }
}

/// The camera of a scene relative to its origin, composed in f64: means are relative to it.
pub fn relative_to(mut camera: Camera, origin: [f64; 3]) -> Camera {
    camera.viewmat *= DMat4::from_translation(DVec3::from(origin));
    camera
}

/// The camera for a picture of another size that shows the whole original picture.
pub fn fitted(camera: &Camera, [width, height]: [u32; 2]) -> Camera {
    let (w, h) = (f64::from(width), f64::from(height));
    let (was_w, was_h) = (f64::from(camera.width), f64::from(camera.height));
    let scale = (w / was_w).min(h / was_h);
    Camera {
        viewmat: camera.viewmat,
        fx: camera.fx * scale,
        fy: camera.fy * scale,
        cx: 0.5 * w + (camera.cx - 0.5 * was_w) * scale,
        cy: 0.5 * h + (camera.cy - 0.5 * was_h) * scale,
        width,
        height,
    }
}

/// Mean up axis of a capture's cameras, None if it vanishes.
pub fn up_of<'a>(cameras: impl Iterator<Item = &'a Camera>) -> Option<DVec3> {
    let sum: DVec3 = cameras.map(|camera| -(camera.rotation().transpose() * DVec3::Y)).sum();
    sum.try_normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    const UP: DVec3 = DVec3::NEG_Y;

    fn view() -> Viewpoint {
        Viewpoint::looking(DVec3::new(0.0, -1.0, -4.0), DVec3::ZERO, UP)
    }

    #[test]
    fn looking_at_a_target_centers_it_with_up_upward() {
        let camera = view().camera([200, 100], 1.0);
        camera.validate().expect("rigid");
        let p = camera.viewmat.transform_point3(DVec3::ZERO);
        assert!(p.truncate().length() < 1e-12 && p.z > 4.0, "{p}");
        let above = camera.viewmat.transform_point3(UP);
        assert!(above.y < -0.5, "up is not upward in the picture: {above}");
        let right = camera.viewmat.transform_point3(DVec3::X);
        assert!(right.x > 0.5, "x is not to the right: {right}");
    }

    #[test]
    fn an_orbit_keeps_pivot_and_distance_and_never_passes_the_poles() {
        let mut moved = view();
        moved.orbit(0.7, 0.2, UP);
        assert!(moved.pivot().length() < 1e-12);
        assert!((moved.position.length() - view().position.length()).abs() < 1e-12);
        assert!((moved.forward().dot(view().forward()) - 1.0).abs() > 0.1, "it did not turn");
        for pitch in [10.0, -10.0] {
            moved.orbit(0.1, pitch, UP);
            let from_up = moved.forward().angle_between(UP);
            let pole = from_up.min(std::f64::consts::PI - from_up);
            assert!((pole - POLE).abs() < 1e-6, "{pole}");
            assert!(moved.right().dot(UP).abs() < 1e-6, "the horizon leans");
        }
    }

    #[test]
    fn a_turn_to_the_right_looks_right_and_a_full_turn_returns() {
        let mut moved = view();
        moved.turn(0.3, 0.0, UP);
        assert!(moved.forward().dot(view().right()) > 0.2);
        assert_eq!(moved.position, view().position);
        let mut round = view();
        for _ in 0..8 {
            round.orbit(std::f64::consts::FRAC_PI_4, 0.0, UP);
        }
        assert!(round.position.distance(view().position) < 1e-9);
    }

    #[test]
    fn zoom_pan_and_focus_move_the_camera() {
        let mut moved = view();
        moved.zoom(2.0);
        assert!((moved.distance - 0.5 * view().distance).abs() < 1e-12);
        assert!(moved.pivot().length() < 1e-12);
        let mut moved = view();
        moved.pan(1.0, 0.0);
        let p = moved.viewmat().transform_point3(DVec3::ZERO);
        assert!((p.x - 1.0).abs() < 1e-12, "the middle did not follow the pointer: {p}");
        moved.focus(DVec3::ONE);
        assert!(moved.pivot().distance(DVec3::ONE) < 1e-12);
    }

    #[test]
    fn fitted_cameras_show_all_of_the_photo() {
        let camera = Camera { cx: 90.0, ..view().camera([200, 100], 1.0) };
        let wide = fitted(&camera, [800, 200]);
        assert_eq!((wide.fx, wide.cy), (2.0 * camera.fx, 100.0));
        // The photo's left edge is at 200, its principal point 90 of its pixels further on.
        assert_eq!(wide.cx, 200.0 + 180.0);
    }
}
