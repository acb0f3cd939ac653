//! project_backward: gradients of the 2D splats to gradients of the splats and the camera.

use glam::{DMat3, DVec3};

use super::project::{direction, geometry, opacity, sh_color};
use crate::camera::Camera;
use crate::sh;
use crate::stages::{
    Colors, ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams,
};

/// Gradient of a unit quaternion's rotation matrix, as (w, x, y, z).
fn quat_gradient([w, x, y, z]: [f64; 4], v: DMat3) -> [f64; 4] {
    // v.col(c)[r] is the gradient of R[r][c].
    let (vx, vy, vz) = (v.x_axis, v.y_axis, v.z_axis);
    [
        2.0 * (x * (vy.z - vz.y) + y * (vz.x - vx.z) + z * (vx.y - vy.x)),
        2.0 * (-2.0 * x * (vy.y + vz.z)
            + y * (vy.x + vx.y)
            + z * (vz.x + vx.z)
            + w * (vy.z - vz.y)),
        2.0 * (x * (vy.x + vx.y) - 2.0 * y * (vx.x + vz.z) + z * (vz.y + vy.z) + w * (vz.x - vx.z)),
        2.0 * (x * (vz.x + vx.z) + y * (vz.y + vy.z) - 2.0 * z * (vx.x + vy.y) + w * (vx.y - vy.x)),
    ]
}

pub(super) fn project_backward(
    splats: &SplatParams<'_, f64>,
    camera: &Camera,
    options: &ProjectOptions,
    projected: &Projected<f64>,
    v_projected: &ProjectedGradients<f64>,
) -> SplatGradients<f64> {
    let n = splats.len();
    let colors_len = match splats.colors {
        Colors::Direct(colors) => colors.len(),
        Colors::Sh { coeffs, .. } => coeffs.len(),
    };
    let mut out = SplatGradients {
        v_means: vec![[0.0; 3]; n],
        v_quats: vec![[0.0; 4]; n],
        v_scales: vec![[0.0; 3]; n],
        v_opacities: vec![0.0; n],
        v_colors: vec![[0.0; 3]; colors_len],
        ..SplatGradients::default()
    };
    let rotation = camera.rotation();
    let (mut v_rotation, mut v_translation) = (DMat3::ZERO, DVec3::ZERO);
    let [mut v_fx, mut v_fy, mut v_cx, mut v_cy] = [0.0; 4];

    for i in 0..n {
        if projected.radii[i] == [0.0; 2] {
            continue;
        }
        let Some(g) = geometry(splats, camera, options, i) else { continue };
        let (fx, fy) = (camera.fx, camera.fy);
        let (x, y, z) = (g.t.x, g.t.y, g.t.z);
        let mut v_t = DVec3::ZERO;

        // Color and, through the view direction, t and the rotation.
        let v_color = DVec3::from(v_projected.v_colors[i]);
        match splats.colors {
            Colors::Direct(_) => out.v_colors[i] = v_color.to_array(),
            Colors::Sh { degree, stride, coeffs } => {
                let coeffs = &coeffs[i * stride..(i + 1) * stride];
                let (dir, length) = direction(camera, g.t);
                let raw = sh_color(degree, coeffs, dir);
                let v_color = DVec3::select(raw.cmpgt(DVec3::ZERO), v_color, DVec3::ZERO);
                let basis = sh::basis(degree, dir.to_array());
                let basis_gradient = sh::basis_gradient(degree, dir.to_array());
                let mut v_dir = DVec3::ZERO;
                for k in 0..sh::coeffs(degree) {
                    out.v_colors[i * stride + k] = (basis[k] * v_color).to_array();
                    v_dir += DVec3::from(basis_gradient[k]) * v_color.dot(DVec3::from(coeffs[k]));
                }
                let v_along = (v_dir - dir * dir.dot(v_dir)) / length;
                v_t += rotation * v_along;
                v_rotation += outer(g.t, v_along);
            }
        }

        // Opacity.
        out.v_opacities[i] = v_projected.v_opacities[i] * g.compensation;
        if splats.raw {
            // o (1 - o), without the cancellation at saturated logits.
            let tail = (-splats.opacities[i].abs()).exp();
            out.v_opacities[i] *= tail / ((1.0 + tail) * (1.0 + tail));
        }

        // Factor F -> 2D covariance C. F C F^T = I, so a small change F dC F^T = E of the whitened
        // covariance changes F by X F with X upper triangular and X + X^T = -E.
        let ([p, q, r], [v_p, v_q, v_r]) = (g.factor, v_projected.v_factors[i]);
        let [mut v_uu, v_uv, mut v_vv] = [-0.5 * (p * v_p + q * v_q), -r * v_q, -0.5 * r * v_r];
        // ln compensation = ln |m0 x m1| - ln det C / 2.
        let v_log = v_projected.v_opacities[i] * opacity(splats, i) * g.compensation;
        if options.antialiased {
            v_uu -= 0.5 * v_log;
            v_vv -= 0.5 * v_log;
        }
        let v_xx = p * p * v_uu;
        let v_xy = 2.0 * p * q * v_uu + p * r * v_uv;
        let v_yy = q * q * v_uu + q * r * v_uv + r * r * v_vv;

        // C -> M = J R A S.
        let mut v_m = [2.0 * v_xx * g.m[0] + v_xy * g.m[1], 2.0 * v_yy * g.m[1] + v_xy * g.m[0]];
        if options.antialiased {
            let normal = g.m[0].cross(g.m[1]);
            let v_normal = normal * (v_log / normal.length_squared());
            v_m[0] += g.m[1].cross(v_normal);
            v_m[1] += v_normal.cross(g.m[0]);
        }
        let v_b = v_m.map(|v| v * g.scales);
        let b = g.a.map(|row| g.axes.transpose() * row);
        let v_scales = v_m[0] * b[0] + v_m[1] * b[1];
        out.v_scales[i] = if splats.raw { v_scales * g.scales } else { v_scales }.to_array();

        // Axes -> quaternion, through its normalization.
        let v_axes = outer(g.a[0], v_b[0]) + outer(g.a[1], v_b[1]);
        let v_unit = quat_gradient(g.quat, v_axes);
        let along: f64 = (0..4).map(|k| v_unit[k] * g.quat[k]).sum();
        out.v_quats[i] = std::array::from_fn(|k| (v_unit[k] - along * g.quat[k]) / g.quat_norm);

        // a = J R.
        let v_a = v_b.map(|v| g.axes * v);
        let rows = rotation.transpose();
        let (v_j00, v_j02) = (v_a[0].dot(rows.x_axis), v_a[0].dot(rows.z_axis));
        let (v_j11, v_j12) = (v_a[1].dot(rows.y_axis), v_a[1].dot(rows.z_axis));
        let v_row_x = v_a[0] * (fx / z);
        let v_row_y = v_a[1] * (fy / z);
        let v_row_z = -v_a[0] * (fx * g.xz / z) - v_a[1] * (fy * g.yz / z);
        v_rotation += DMat3::from_cols(v_row_x, v_row_y, v_row_z).transpose();

        // J, with clamped x/z and y/z held constant.
        v_fx += v_j00 / z - v_j02 * g.xz / z;
        v_fy += v_j11 / z - v_j12 * g.yz / z;
        v_t.z += -v_j00 * fx / (z * z) + v_j02 * fx * g.xz / (z * z) - v_j11 * fy / (z * z)
            + v_j12 * fy * g.yz / (z * z);
        let (v_xz, v_yz) = (-v_j02 * fx / z, -v_j12 * fy / z);
        if g.inside[0] {
            v_t.x += v_xz / z;
            v_t.z -= v_xz * x / (z * z);
        } else {
            // The limit is an affine function of cx, over fx.
            v_fx -= v_xz * g.xz / fx;
            v_cx -= v_xz / fx;
        }
        if g.inside[1] {
            v_t.y += v_yz / z;
            v_t.z -= v_yz * y / (z * z);
        } else {
            v_fy -= v_yz * g.yz / fy;
            v_cy -= v_yz / fy;
        }

        // Center and depth.
        let [v_u, v_v] = v_projected.v_means2d[i];
        v_fx += v_u * x / z;
        v_fy += v_v * y / z;
        v_cx += v_u;
        v_cy += v_v;
        v_t += DVec3::new(
            v_u * fx / z,
            v_v * fy / z,
            -(v_u * fx * x + v_v * fy * y) / (z * z) + v_projected.v_depths[i],
        );

        // t = R mean + translation.
        let mean = DVec3::from(splats.means[i]);
        out.v_means[i] = (rotation.transpose() * v_t).to_array();
        v_rotation += outer(v_t, mean);
        v_translation += v_t;
    }
    out.v_viewmat = std::array::from_fn(|r| {
        let row = v_rotation.row(r);
        [row.x, row.y, row.z, v_translation[r]]
    });
    out.v_intrinsics = [v_fx, v_fy, v_cx, v_cy];
    out
}

/// a b^T.
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}
