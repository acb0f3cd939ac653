//! Cameras under optimisation: poses and focal lengths that are not exact, fitted with the splats.
//!
//! A camera turns about its own centre and moves along its own axes. Both show the scene in nearly
//! the same way, so Adam does not work on them but on coordinates in which every unit step moves the
//! picture of the scene by one pixel, whichever way it points (as CamP, Park et al. 2023).
//!
//! Cameras and splats together may be turned, moved and scaled without any photo showing it. After
//! each round the cameras are brought back by the similarity that fits them best to where they
//! began, so that they do not drift.

use glam::{DMat3, DMat4, DQuat, DVec3};

use super::device::CameraGradient;
use super::hold::Hold;
use crate::camera::Camera;
use crate::error::{Error, Result};

/// Degrees of freedom of a pose: turn (radians) about and move along x, y, z of the camera.
pub(super) const POSE: usize = 6;
/// Depths, in units of the scene's, and picture positions, in units of its size, of the points whose
/// motion in the picture measures a step.
const DEPTHS: [f64; 3] = [0.8, 1.0, 1.25];
const POSITIONS: [f64; 5] = [0.1, 0.3, 0.5, 0.7, 0.9];
/// Cameras nearer together than this part of their distance to the scene stand at one place.
const ONE_PLACE: f64 = 1e-3;
/// Added to the measure, as a part of its mean diagonal: directions that move no picture stay put.
const DAMPING: f64 = 0.01;

/// Adam's decay of the first and second moments and its epsilon. A camera has one step a round: the
/// second moment must forget within tens of them.
const ADAM: (f64, f64, f64) = (0.9, 0.99, 1e-15);

/// Which focal lengths are fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Focal {
    /// None.
    Fixed,
    /// One factor for all cameras.
    Shared,
    /// A factor for each camera.
    PerCamera,
}

/// How cameras are fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraConfig {
    /// Whether poses are.
    pub poses: bool,
    /// Which focal lengths are.
    pub focal: Focal,
    /// Adam's rate at the start, in pixels that a step moves the picture by.
    pub rate: f32,
    /// What the rate has decayed to at the end of the fit, as a part of the start's.
    pub decay: f32,
    /// Part of the fit's steps in which cameras rest: the splats need a shape first.
    pub warm_up: f32,
    /// Whether the cameras are kept from moving all together.
    pub anchored: bool,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            poses: true,
            focal: Focal::Fixed,
            rate: 0.3,
            decay: 0.03,
            warm_up: 0.05,
            anchored: true,
        }
    }
}

impl CameraConfig {
    /// Checks every setting.
    pub fn validate(&self) -> Result<()> {
        if !(self.rate.is_finite() && self.rate >= 0.0) {
            return Err(Error::argument("camera_rate", "must be finite and not negative"));
        }
        if !(self.decay > 0.0 && self.decay <= 1.0) {
            return Err(Error::argument("camera_decay", "must lie above 0 and at most at 1"));
        }
        if !(0.0..=1.0).contains(&self.warm_up) {
            return Err(Error::argument("camera_warm_up", "must lie in 0..=1"));
        }
        Ok(())
    }
}

/// Everything needed to go on bit for bit; one entry per camera.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CameraState {
    /// World-to-camera matrices.
    pub viewmats: Vec<DMat4>,
    /// (fx, fy, cx, cy), pixels.
    pub intrinsics: Vec<[f64; 4]>,
    /// Adam's first moments: the pose's six, then that of the focal length's logarithm (a shared
    /// one's in every row alike).
    pub first: Vec<[f64; 7]>,
    /// Adam's second moments: the pose's as a whole, the focal length's.
    pub second: Vec<[f64; 2]>,
    /// Gradients of the round under way, of the same parameters before preconditioning.
    pub gradients: Vec<[f64; 7]>,
    /// Distances to the scene at the fit's start, world units.
    pub distances: Vec<f64>,
    /// Steps of Adam done.
    pub rounds: u32,
}

/// Cameras being fitted.
#[derive(Debug)]
pub struct Cameras {
    initial: Vec<Camera>,
    now: Vec<Camera>,
    /// From steps in pixels to turns and moves.
    scales: Vec<[[f64; POSE]; POSE]>,
    /// What else is known of each camera; empty where nothing is.
    holds: Vec<Hold>,
    /// Pixels by which the picture moves where the logarithm of the focal length grows by 1.
    focal_pixels: Vec<f64>,
    config: CameraConfig,
    state: CameraState,
}

impl Cameras {
    /// Cameras and how far the scene is from each, world units.
    pub fn new(initial: &[Camera], distances: Vec<f64>, config: CameraConfig) -> Self {
        let rows = vec![[0.0; POSE + 1]; initial.len()];
        let state = CameraState {
            first: rows.clone(),
            second: vec![[0.0; 2]; initial.len()],
            gradients: rows,
            distances: distances.clone(),
            ..CameraState::default()
        };
        Self {
            scales: all_scales(initial, &distances, &[]),
            holds: Vec::new(),
            focal_pixels: initial.iter().map(focal_pixels).collect(),
            initial: initial.to_vec(),
            now: initial.to_vec(),
            config,
            state,
        }
    }

    /// Holds the cameras, one entry for each, from before their first step or [`Cameras::resume`].
    pub fn hold(&mut self, holds: Vec<Hold>) -> Result<()> {
        if holds.len() != self.initial.len() {
            let count = self.initial.len();
            return Err(Error::argument(
                "holds",
                format!("must have one entry for {count} cameras"),
            ));
        }
        for (k, hold) in holds.iter().enumerate() {
            hold.validate(k)?;
        }
        self.scales = all_scales(&self.initial, &self.state.distances, &holds);
        self.holds = holds;
        Ok(())
    }

    /// Goes on from a state that [`Cameras::state`] gave.
    pub fn resume(&mut self, state: CameraState) -> Result<()> {
        let n = self.initial.len();
        let lengths = [
            state.viewmats.len(),
            state.intrinsics.len(),
            state.first.len(),
            state.second.len(),
            state.gradients.len(),
            state.distances.len(),
        ];
        if lengths.iter().any(|&length| length != n) {
            return Err(Error::argument("cameras", format!("must have one row for {n} cameras")));
        }
        for (k, camera) in self.now.iter_mut().enumerate() {
            let [fx, fy, cx, cy] = state.intrinsics[k];
            *camera = Camera { viewmat: state.viewmats[k], fx, fy, cx, cy, ..*camera };
            camera.validate()?;
        }
        let moments = [&state.first, &state.gradients].map(|rows| rows.as_flattened());
        let moments = moments.into_iter().chain([state.second.as_flattened()]).flatten();
        if !moments.copied().all(f64::is_finite) {
            return Err(Error::argument("cameras", "has a moment that is not finite"));
        }
        if !state.distances.iter().all(|d| d.is_finite() && *d > 0.0) {
            return Err(Error::argument("cameras", "has a distance that is not positive"));
        }
        self.scales = all_scales(&self.initial, &state.distances, &self.holds);
        self.state = state;
        Ok(())
    }

    /// Where the fit stands.
    pub fn state(&self) -> CameraState {
        let intrinsics = |c: &Camera| [c.fx, c.fy, c.cx, c.cy];
        CameraState {
            viewmats: self.now.iter().map(|c| c.viewmat).collect(),
            intrinsics: self.now.iter().map(intrinsics).collect(),
            ..self.state.clone()
        }
    }

    /// The cameras as they are now.
    pub fn now(&self) -> &[Camera] {
        &self.now
    }

    /// Whether cameras move at this point of the fit, 0..1.
    pub fn moving(&self, progress: f64) -> bool {
        progress >= f64::from(self.config.warm_up)
    }

    /// Adds gradients of steps to those of the round.
    pub fn add(&mut self, gradients: &[CameraGradient]) {
        for gradient in gradients {
            let row = tangent(&self.now[gradient.view], gradient);
            // A picture that left f32 says nothing of where to go.
            if row.iter().all(|v| v.is_finite()) {
                for (sum, v) in self.state.gradients[gradient.view].iter_mut().zip(row) {
                    *sum += v;
                }
            }
        }
    }

    /// Moves the cameras by the gradients of the round.
    pub fn step(&mut self, progress: f64) {
        let warm_up = f64::from(self.config.warm_up);
        let since = ((progress - warm_up) / (1.0 - warm_up).max(1e-9)).clamp(0.0, 1.0);
        let rate = f64::from(self.config.rate) * f64::from(self.config.decay).powf(since);
        self.state.rounds += 1;
        let mut gradients = std::mem::take(&mut self.state.gradients);
        self.state.gradients = vec![[0.0; POSE + 1]; gradients.len()];
        if self.config.focal == Focal::Shared {
            let sum: f64 = gradients.iter().map(|row| row[POSE]).sum();
            gradients.iter_mut().for_each(|row| row[POSE] = sum);
        }
        let mean_pixels = self.focal_pixels.iter().sum::<f64>() / self.now.len() as f64;
        for (k, row) in gradients.iter().enumerate() {
            let scale = self.scales[k];
            let pixels = match self.config.focal {
                Focal::Shared => mean_pixels,
                _ => self.focal_pixels[k],
            };
            let hold = self.holds.get(k).copied();
            // A step is as long as the shorter of a pixel and what is known already.
            let pixels = hold.map_or(pixels, |hold| pixels.hypot(hold.log_focal.sqrt()));
            let mut in_pixels = [0.0; POSE + 1];
            for (line, v) in scale.iter().zip(row) {
                for (out, s) in in_pixels.iter_mut().zip(line) {
                    *out += s * v;
                }
            }
            in_pixels[POSE] = row[POSE] / pixels;
            let moved = self.adam(k, in_pixels, rate);
            let mut pose = [0.0; POSE];
            for (out, line) in pose.iter_mut().zip(&scale) {
                *out = line.iter().zip(moved).map(|(s, v)| s * v).sum();
            }
            let camera = &mut self.now[k];
            if self.config.poses {
                move_by(camera, pose);
                if let Some(hold) = hold {
                    hold.pull_pose(camera, &scale, rate);
                }
            }
            if self.config.focal != Focal::Fixed {
                let factor = (moved[POSE] / pixels).exp();
                (camera.fx, camera.fy) = (camera.fx * factor, camera.fy * factor);
                if let Some(hold) = hold {
                    hold.pull_focal(camera, pixels * pixels, rate);
                }
            }
        }
        if self.config.anchored && self.config.poses {
            anchor(&mut self.now, &self.initial, &self.state.distances);
        }
    }

    /// Adam with one second moment for the pose as a whole: its coordinates have one unit, and the
    /// slope says how far to go along each of them. A moment for each would move the camera as far
    /// along those that the photo hardly shows.
    fn adam(&mut self, k: usize, gradient: [f64; 7], rate: f64) -> [f64; 7] {
        let (beta1, beta2, epsilon) = ADAM;
        let bias = |beta: f64| 1.0 - beta.powi(self.state.rounds.min(i32::MAX as u32) as i32);
        let (bias1, bias2) = (bias(beta1), bias(beta2));
        let (first, second) = (&mut self.state.first[k], &mut self.state.second[k]);
        let squares = gradient.map(|g| g * g);
        let squares = [squares[..POSE].iter().sum(), squares[POSE]];
        for (second, square) in second.iter_mut().zip(squares) {
            *second = beta2 * *second + (1.0 - beta2) * square;
        }
        std::array::from_fn(|i| {
            first[i] = beta1 * first[i] + (1.0 - beta1) * gradient[i];
            let second = second[usize::from(i == POSE)];
            -rate * (first[i] / bias1) / ((second / bias2).sqrt() + epsilon)
        })
    }
}

/// Gradient of turn, move and logarithm of the focal length.
fn tangent(camera: &Camera, v: &CameraGradient) -> [f64; 7] {
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

/// How many pixels the points of a picture move, in root mean square, by unit growth of log f.
fn focal_pixels(camera: &Camera) -> f64 {
    let points = grid(camera);
    let sum: f64 =
        points.iter().map(|(x, y)| (x * camera.fx).powi(2) + (y * camera.fy).powi(2)).sum();
    (sum / points.len() as f64).sqrt().max(1.0)
}

/// Positions in the picture as (x / z, y / z).
fn grid(camera: &Camera) -> Vec<(f64, f64)> {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    POSITIONS
        .iter()
        .flat_map(|v| POSITIONS.iter().map(move |u| (u, v)))
        .map(|(u, v)| ((u * w - camera.cx) / camera.fx, (v * h - camera.cy) / camera.fy))
        .collect()
}

fn all_scales(cameras: &[Camera], distances: &[f64], holds: &[Hold]) -> Vec<[[f64; POSE]; POSE]> {
    let each = cameras.iter().zip(distances).enumerate();
    each.map(|(k, (camera, &d))| pixels_to_pose(camera, d, holds.get(k))).collect()
}

/// Median depth of the points that a camera has in its picture; of all before it, where it has none
/// there; 1 where there are none at all.
pub fn scene_distance(camera: &Camera, means: &[[f32; 3]]) -> f64 {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let (mut seen, mut before) = (Vec::new(), Vec::new());
    for mean in means {
        let t = camera.viewmat.transform_point3(DVec3::from(mean.map(f64::from)));
        if t.z > 0.0 && t.z.is_finite() {
            let x = camera.fx * t.x / t.z + camera.cx;
            let y = camera.fy * t.y / t.z + camera.cy;
            if x >= 0.0 && x < w && y >= 0.0 && y < h {
                seen.push(t.z);
            }
            before.push(t.z);
        }
    }
    let mut depths = if seen.is_empty() { before } else { seen };
    if depths.is_empty() {
        return 1.0;
    }
    let middle = depths.len() / 2;
    *depths.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// A matrix from steps in pixels to poses: what it makes of a unit step moves points of the picture by
/// one pixel in root mean square. A move comes with the turn that keeps the picture in place. Along
/// what a hold knows to less than a pixel, it is that.
fn pixels_to_pose(camera: &Camera, distance: f64, hold: Option<&Hold>) -> [[f64; POSE]; POSE] {
    let mut sum = [[0.0; POSE]; POSE];
    let points = grid(camera);
    let count = (points.len() * DEPTHS.len()) as f64;
    for (x, y) in points {
        for depth in DEPTHS {
            let z = (depth * distance).max(f64::MIN_POSITIVE);
            let rows = [
                [-x * y, 1.0 + x * x, -y, 1.0 / z, 0.0, -x / z].map(|v| v * camera.fx),
                [-1.0 - y * y, x * y, x, 0.0, 1.0 / z, -y / z].map(|v| v * camera.fy),
            ];
            for row in rows {
                for (line, a) in sum.iter_mut().zip(row) {
                    for (s, b) in line.iter_mut().zip(row) {
                        *s += a * b / count;
                    }
                }
            }
        }
    }
    // Turns are in radians and moves in world units; the damping compares them as pixels.
    let unit: [f64; POSE] = std::array::from_fn(|i| sum[i][i].sqrt().max(f64::MIN_POSITIVE));
    let mut scaled = sum;
    for (i, line) in scaled.iter_mut().enumerate() {
        for (j, v) in line.iter_mut().enumerate() {
            *v = *v / (unit[i] * unit[j]) + if i == j { DAMPING } else { 0.0 };
            if let Some(hold) = hold {
                *v += hold.pose[i][j] / (unit[i] * unit[j]);
            }
        }
    }
    let inverse = inverse_cholesky(scaled);
    // x = D^-1 L^-T z, with D the units and L L^T the measure.
    std::array::from_fn(|i| std::array::from_fn(|j| inverse[j][i] / unit[i]))
}

/// L^-1 for a positive definite matrix L L^T.
pub(super) fn inverse_cholesky(matrix: [[f64; POSE]; POSE]) -> [[f64; POSE]; POSE] {
    let mut l = [[0.0; POSE]; POSE];
    for i in 0..POSE {
        for j in 0..=i {
            let done: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            let rest = matrix[i][j] - done;
            l[i][j] = if i == j { rest.max(f64::MIN_POSITIVE).sqrt() } else { rest / l[j][j] };
        }
    }
    let mut inverse = [[0.0; POSE]; POSE];
    for column in 0..POSE {
        for i in column..POSE {
            let done: f64 = (column..i).map(|k| l[i][k] * inverse[k][column]).sum();
            inverse[i][column] = (f64::from(u8::from(i == column)) - done) / l[i][i];
        }
    }
    inverse
}

/// Moves all cameras by the similarity that brings them nearest to where they began: orientations
/// on average, centres in the least-squares sense. Cameras that stand at one place, seen from their
/// distances to the scene, have no scale to keep.
fn anchor(now: &mut [Camera], initial: &[Camera], distances: &[f64]) {
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

#[cfg(test)]
mod tests {
    use super::*;

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

    /// What a standard deviation in pixels along every way of moving leaves of information.
    fn known(camera: &Camera, sigma: f64) -> Hold {
        let mut pose = [[0.0; POSE]; POSE];
        for (i, row) in pose.iter_mut().enumerate() {
            let length = if i < 3 { camera.fx } else { camera.fx / 4.0 };
            row[i] = (length / sigma).powi(2);
        }
        let log_focal = (focal_pixels(camera) / sigma).powi(2);
        Hold { viewmat: camera.viewmat, focal: [camera.fx, camera.fy], pose, log_focal }
    }

    const POINTS: [[f64; 3]; 6] = [
        [0.5, 0.0, 0.0],
        [-0.5, 0.3, 0.1],
        [0.1, -0.6, 0.4],
        [0.0, 0.2, -0.7],
        [0.9, 0.5, 0.6],
        [-0.4, -0.5, -0.6],
    ];

    /// Gradient of half the squared distances between where two cameras see the points.
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
                DQuat::from_mat3(&(a.rotation() * b.rotation().transpose()))
                    .to_scaled_axis()
                    .length()
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
            assert!(off < 1e-3, "a centre is {off:.2e} off");
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
    fn held_cameras_stay_within_what_is_known_and_move_along_what_is_not() {
        let truth = ring(4);
        let off = CameraConfig { anchored: false, focal: Focal::PerCamera, ..config() };
        let mut told = truth.clone();
        for camera in &mut told {
            move_by(camera, [0.01, -0.008, 0.006, 0.01, -0.02, 0.015]);
            (camera.fx, camera.fy) = (1.02 * camera.fx, 1.02 * camera.fy);
        }
        // A hundredth of a pixel: the points pull by several, hard enough at any distance.
        let surely: Vec<Hold> = told.iter().map(|camera| known(camera, 0.01)).collect();
        let mut cameras = Cameras::new(&told, vec![4.0; 4], off);
        cameras.hold(surely.clone()).unwrap();
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
        let mut partly: Vec<Hold> = turned.iter().map(|camera| known(camera, 0.01)).collect();
        for hold in &mut partly {
            (0..3).for_each(|i| hold.pose[i][i] = 0.0);
            hold.log_focal = 0.0;
        }
        let before = worst_angle(&turned, &truth);
        let mut cameras = Cameras::new(&turned, vec![4.0; 4], off);
        cameras.hold(partly).unwrap();
        fitted(&mut cameras, &truth, 1000);
        let after = worst_angle(cameras.now(), &truth);
        assert!(after < 0.02 * before, "turns were {before:.2e} off and are {after:.2e}");
        // Cameras that were brought elsewhere first come back to where they were told to be.
        let mut cameras = Cameras::new(&truth, vec![4.0; 4], off);
        cameras.hold(surely).unwrap();
        (0..400).for_each(|_| cameras.step(0.0));
        assert!(worst_angle(cameras.now(), &told) * 500.0 < 0.02);
        assert!(cameras.now().iter().zip(&told).all(|(a, b)| (a.fx / b.fx - 1.0).abs() < 1e-4));
    }

    #[test]
    fn holds_that_know_nothing_change_no_bit_and_wrong_ones_are_refused() {
        let truth = ring(3);
        let mut noisy = truth.clone();
        move_by(&mut noisy[1], [0.01; 6]);
        let off = CameraConfig { focal: Focal::Shared, ..config() };
        let mut free = Cameras::new(&noisy, vec![4.0; 3], off);
        let mut held = Cameras::new(&noisy, vec![4.0; 3], off);
        let nothing = Hold { pose: [[0.0; POSE]; POSE], log_focal: 0.0, ..known(&truth[0], 1.0) };
        held.hold(vec![nothing; 3]).unwrap();
        fitted(&mut free, &truth, 7);
        fitted(&mut held, &truth, 7);
        assert_eq!(free.state(), held.state());
        assert!(held.hold(vec![nothing; 2]).is_err());
        assert!(held.hold(vec![Hold { log_focal: f64::NAN, ..nothing }; 3]).is_err());
        assert!(held.hold(vec![Hold { log_focal: -1.0, ..nothing }; 3]).is_err());
        assert!(held.hold(vec![Hold { focal: [0.0, 1.0], ..nothing }; 3]).is_err());
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
}
