//! project: splats and camera to 2D splats.

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::camera::Camera;
use crate::constants::{ALPHA_MIN, QUAT_NORM2_MIN};
use crate::sh;
use crate::stages::{Colors, ProjectOptions, Projected, SplatParams};

/// Quantities of one splat that forward and backward share.
pub(super) struct Geometry {
    /// Camera-space center.
    pub t: DVec3,
    /// Splat axes in the world.
    pub axes: DMat3,
    /// Norm of the quaternion as given.
    pub quat_norm: f64,
    /// Normalized quaternion (w, x, y, z).
    pub quat: [f64; 4],
    /// Standard deviations along the axes.
    pub scales: DVec3,
    /// x/z and y/z within the Jacobian's limits.
    pub xz: f64,
    pub yz: f64,
    /// Whether x/z, y/z were inside the limits.
    pub inside: [bool; 2],
    /// Rows of J times the camera's rotation.
    pub a: [DVec3; 2],
    /// Rows of J R A S, so that the 2D covariance is m m^T + blur.
    pub m: [DVec3; 2],
    /// Upper-triangular factor of the conic.
    pub factor: [f64; 3],
    /// Factor of the opacity; 1 if not antialiased.
    pub compensation: f64,
}

pub(super) fn opacity(splats: &SplatParams<'_, f64>, i: usize) -> f64 {
    let o = splats.opacities[i];
    if splats.raw { 1.0 / (1.0 + (-o).exp()) } else { o }
}

/// None if the splat is culled for its own values or its depth.
pub(super) fn geometry(
    splats: &SplatParams<'_, f64>,
    camera: &Camera,
    options: &ProjectOptions,
    i: usize,
) -> Option<Geometry> {
    let rotation = camera.rotation();
    let t = rotation * DVec3::from(splats.means[i]) + camera.translation();
    // Written so that NaN is culled.
    if !(t.is_finite() && t.z >= f64::from(options.nearest()) && t.z <= f64::from(options.far)) {
        return None;
    }
    let [w, x, y, z] = splats.quats[i];
    let norm2 = w * w + x * x + y * y + z * z;
    if !(norm2.is_finite() && norm2 >= f64::from(QUAT_NORM2_MIN)) {
        return None;
    }
    let quat_norm = norm2.sqrt();
    let quat = [w / quat_norm, x / quat_norm, y / quat_norm, z / quat_norm];
    let axes = DMat3::from_quat(DQuat::from_xyzw(quat[1], quat[2], quat[3], quat[0]));
    // A logit of +inf or a log-scale of -inf counts as invalid, although its opacity or scale is finite.
    if !splats.opacities[i].is_finite() {
        return None;
    }
    let given = DVec3::from(splats.scales[i]);
    let scales = if splats.raw { given.exp() } else { given };
    if !(given.is_finite() && scales.is_finite() && scales.min_element() >= 0.0) {
        return None;
    }
    let [x_low, x_high, y_low, y_high] = camera.jacobian_limits();
    let (xz, yz) = ((t.x / t.z).clamp(x_low, x_high), (t.y / t.z).clamp(y_low, y_high));
    let inside = [t.x / t.z == xz, t.y / t.z == yz];
    let rows = rotation.transpose();
    let a = [
        rows.x_axis * (camera.fx / t.z) - rows.z_axis * (camera.fx * xz / t.z),
        rows.y_axis * (camera.fy / t.z) - rows.z_axis * (camera.fy * yz / t.z),
    ];
    let m = a.map(|row| axes.transpose() * row * scales);
    let blur = f64::from(options.blur);
    let (sxx, sxy, syy) = (m[0].dot(m[0]), m[0].dot(m[1]), m[1].dot(m[1]));
    let cyy = syy + blur;
    // Cauchy-Binet: the determinants as sums of positive terms.
    let det_sharp = m[0].cross(m[1]).length_squared();
    let det = det_sharp + blur * (sxx + syy) + blur * blur;
    let p = (cyy / det).sqrt();
    let factor = [p, -sxy / cyy * p, cyy.sqrt().recip()];
    let compensation = if options.antialiased { (det_sharp / det).sqrt() } else { 1.0 };
    Some(Geometry { t, axes, quat_norm, quat, scales, xz, yz, inside, a, m, factor, compensation })
}

/// Unit view direction in the world and the length it was normalized by.
pub(super) fn direction(camera: &Camera, t: DVec3) -> (DVec3, f64) {
    // R^T t is the vector from center to mean, without cancellation far from the origin.
    let along = camera.rotation().transpose() * t;
    (along / along.length(), along.length())
}

/// SH color before the cut at zero.
pub(super) fn sh_color(degree: u32, coeffs: &[[f64; 3]], dir: DVec3) -> DVec3 {
    let basis = sh::basis(degree, dir.to_array());
    (0..sh::coeffs(degree)).map(|k| basis[k] * DVec3::from(coeffs[k])).sum::<DVec3>() + 0.5
}

pub(super) fn project(
    splats: &SplatParams<'_, f64>,
    camera: &Camera,
    options: &ProjectOptions,
) -> Projected<f64> {
    let mut out = Projected::culled(splats.len(), camera.width, camera.height);
    for i in 0..splats.len() {
        let Some(g) = geometry(splats, camera, options, i) else { continue };
        let opacity = opacity(splats, i) * g.compensation;
        let reach = 2.0 * (opacity / f64::from(ALPHA_MIN)).ln();
        if !(reach.is_finite() && reach > 0.0) {
            continue;
        }
        let variance = |m: DVec3| m.length_squared() + f64::from(options.blur);
        let radii = DVec2::new(variance(g.m[0]), variance(g.m[1])).map(|c| (reach * c).sqrt());
        let center = DVec2::new(
            camera.fx * g.t.x / g.t.z + camera.cx,
            camera.fy * g.t.y / g.t.z + camera.cy,
        );
        let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
        // No pixel center can be reached.
        if (center + radii).cmplt(DVec2::ZERO).any() || (center - radii).cmpgt(size).any() {
            continue;
        }
        let color = match splats.colors {
            Colors::Direct(colors) => DVec3::from(colors[i]),
            Colors::Sh { degree, stride, coeffs } => {
                let dir = direction(camera, g.t).0;
                let color = sh_color(degree, &coeffs[i * stride..], dir);
                // Before the clamp at zero, which would hide an invalid coefficient.
                if !color.is_finite() {
                    continue;
                }
                color.max(DVec3::ZERO)
            }
        };
        let finite = color.is_finite()
            && center.is_finite()
            && radii.is_finite()
            && g.factor.iter().all(|f| f.is_finite());
        if !finite {
            continue;
        }
        out.means2d[i] = center.to_array();
        out.factors[i] = g.factor;
        out.depths[i] = g.t.z;
        out.colors[i] = color.to_array();
        out.opacities[i] = opacity;
        out.radii[i] = radii.to_array();
    }
    out
}
