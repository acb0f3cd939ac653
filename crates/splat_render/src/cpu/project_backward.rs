//! project_backward: gradients of the 2D splats to gradients of the splats and the camera, f32.

use glam::{Mat3, Vec3};
use rayon::prelude::*;

use super::bin::CHUNK;
use super::project::{Splat, View, direction, ellipse, geometry, sh_color};
use crate::camera::Camera;
use crate::sh;
use crate::splats::SplatSlices;
use crate::stages::{
    Colors, ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams,
};

/// Gradients of one 2D splat.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct V2d {
    pub v_mean: [f32; 2],
    /// Gradient of the 2D covariance in the splat's own coordinates (u, v), where it is the
    /// identity: (uu, uv, vv), uv being the one shared off-diagonal entry.
    pub v_whitened: [f32; 3],
    pub v_depth: f32,
    pub v_color: [f32; 3],
    pub v_opacity: f32,
}

impl V2d {
    /// The whitened covariance's gradient from that of a factor F: a small change E of the
    /// covariance changes F by X F with X upper triangular and X + X^T = -E.
    pub fn whitened_from_factor([p, q, r]: [f32; 3], [v_p, v_q, v_r]: [f32; 3]) -> [f32; 3] {
        [-0.5 * (p * v_p + q * v_q), -r * v_q, -0.5 * r * v_r]
    }

    /// The inverse of [`V2d::whitened_from_factor`]; zero for a culled splat's zero factor.
    pub fn v_factor(&self, [p, q, r]: [f32; 3]) -> [f32; 3] {
        if p == 0.0 || r == 0.0 {
            return [0.0; 3];
        }
        let [v_uu, v_uv, v_vv] = self.v_whitened;
        let v_q = -v_uv / r;
        [-(2.0 * v_uu + q * v_q) / p, v_q, -2.0 * v_vv / r]
    }
}

/// Gradients of one splat's parameters, colours apart.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct VSplat {
    pub v_mean: [f32; 3],
    pub v_quat: [f32; 4],
    pub v_scales: [f32; 3],
    pub v_opacity: f32,
}

/// Gradients of the camera, summed in f64: they gather from every splat.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct VCamera {
    /// Rows of the upper 3x4 block of the viewmat.
    pub v_viewmat: [[f64; 4]; 3],
    /// (fx, fy, cx, cy)
    pub v_intrinsics: [f64; 4],
}

impl VCamera {
    pub fn add(&mut self, other: &Self) {
        for (row, other) in self.v_viewmat.iter_mut().zip(&other.v_viewmat) {
            for (sum, value) in row.iter_mut().zip(other) {
                *sum += value;
            }
        }
        for (sum, value) in self.v_intrinsics.iter_mut().zip(other.v_intrinsics) {
            *sum += value;
        }
    }

    fn add_rotation(&mut self, rows: [Vec3; 3]) {
        for (sum, row) in self.v_viewmat.iter_mut().zip(rows) {
            for (s, v) in sum.iter_mut().zip(row.to_array()) {
                *s += f64::from(v);
            }
        }
    }
}

/// Gradient of a unit quaternion's rotation matrix, as (w, x, y, z).
#[inline(always)]
fn quat_gradient([w, x, y, z]: [f32; 4], v: Mat3) -> [f32; 4] {
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

/// The stage for one camera and one way that splats are given.
pub(super) struct SplatBackward<'a> {
    pub view: &'a View,
    pub colors: Colors<'a, f32>,
    /// Whether scales are logarithms.
    pub raw: bool,
}

impl SplatBackward<'_> {
    /// Gradients of one visible splat, number `i` of the colours. `v_sh` receives the coefficients'
    /// gradients (or the direct colour's); `v_camera`, where wanted, is added to.
    ///
    /// A finite picture can still have gradients that overflow (a coefficient of 1e38, or -inf
    /// behind the clamp of the colour). All of that splat's are zero then: they must not reach the
    /// camera or, through Adam's moments, later steps.
    #[inline(always)]
    pub fn run(
        &self,
        i: usize,
        splat: &Splat,
        v: &V2d,
        v_sh: &mut [[f32; 3]],
        v_camera: Option<&mut VCamera>,
    ) -> VSplat {
        let mut v_own = v_camera.is_some().then(VCamera::default);
        let out = self.gradients(i, splat, v, v_sh, v_own.as_mut());
        // A sum is finite only where every term is; one that overflows by itself is as useless.
        let mut sum = out.v_opacity;
        sum += out.v_mean.iter().chain(&out.v_quat).chain(&out.v_scales).sum::<f32>();
        sum += v_sh.as_flattened().iter().sum::<f32>();
        if !sum.is_finite() {
            v_sh.fill([0.0; 3]);
            return VSplat::default();
        }
        if let (Some(sum), Some(own)) = (v_camera, v_own) {
            sum.add(&own);
        }
        out
    }

    #[inline(always)]
    fn gradients(
        &self,
        i: usize,
        splat: &Splat,
        v: &V2d,
        v_sh: &mut [[f32; 3]],
        mut v_camera: Option<&mut VCamera>,
    ) -> VSplat {
        let Self { view, ref colors, raw } = *self;
        let Some(g) = geometry(view, splat) else { return VSplat::default() };
        let mut out = VSplat::default();
        let (fx, fy) = (view.focal.x, view.focal.y);
        let inverse_z = g.t.z.recip();
        let mut v_t = Vec3::ZERO;

        // Colour and, through the view direction, t and the rotation.
        let mut v_color = Vec3::from(v.v_color);
        match *colors {
            Colors::Direct(_) => v_sh[0] = v.v_color,
            Colors::Sh { degree, stride, coeffs } => {
                let coeffs = &coeffs[i * stride..(i + 1) * stride];
                let (dir, length) = direction(view, g.t);
                let basis = sh::basis(degree, dir.to_array());
                let color = sh_color(degree, &basis, coeffs);
                v_color = Vec3::select(color.cmpgt(Vec3::ZERO), v_color, Vec3::ZERO);
                for (v_coeff, b) in v_sh.iter_mut().zip(basis).take(sh::coeffs(degree)) {
                    *v_coeff = (b * v_color).to_array();
                }
                if degree > 0 {
                    let slopes = sh::basis_gradient(degree, dir.to_array());
                    let mut v_dir = Vec3::ZERO;
                    for (slope, coeff) in slopes.iter().zip(coeffs).take(sh::coeffs(degree)) {
                        v_dir += Vec3::from(*slope) * v_color.dot(Vec3::from(*coeff));
                    }
                    let v_along = (v_dir - dir * dir.dot(v_dir)) / length;
                    v_t += view.rotation * v_along;
                    if let Some(camera) = v_camera.as_deref_mut() {
                        camera.add_rotation([v_along * g.t.x, v_along * g.t.y, v_along * g.t.z]);
                    }
                }
            }
        }

        let ellipse = ellipse(view, splat.scales, &g);
        out.v_opacity = v.v_opacity * ellipse.compensation * splat.opacity_slope;

        // Whitened 2D covariance -> M = J R A S. The rows of F B and F M are of order 1 even for a
        // needle, and found without the cancellation that F, B and M would bring to their products.
        let [p, q, r] = ellipse.factor;
        let [v_uu, v_uv, v_vv] = v.v_whitened;
        let squares = splat.scales * splat.scales;
        let fb_u = ((squares * g.b[1]).cross(g.normal) + view.options.blur * g.b[0]) * (p * r * r);
        let fb_v = g.b[1] * r;
        let (fm_u, fm_v) = (fb_u * splat.scales, fb_v * splat.scales);
        let v_fm_u = 2.0 * v_uu * fm_u + v_uv * fm_v;
        let v_fm_v = v_uv * fm_u + 2.0 * v_vv * fm_v;
        let mut v_scales = v_fm_u * fb_u + v_fm_v * fb_v;
        let mut v_m = [p * v_fm_u, q * v_fm_u + r * v_fm_v];
        if view.options.antialiased {
            // With S = M M^T and C = S + blur I, ln compensation = (ln det S - ln det C) / 2 has the
            // gradient S^-1 M - C^-1 M, whose terms cancel for large splats; it is blur C^-1 S^-1 M.
            // The rows of S^-1 M are m1 x n / n^2 and n x m0 / n^2 with n = m0 x m1; divided by the
            // length twice, since its square may underflow where it does not.
            let length = ellipse.area.length();
            let n = ellipse.area / length / length;
            let w = [g.m[1].cross(n), n.cross(g.m[0])];
            let v_log = v.v_opacity * splat.opacity * ellipse.compensation * view.options.blur;
            let (e_u, e_v) = ((p * w[0] + q * w[1]) * v_log, r * w[1] * v_log);
            v_scales += e_u * fb_u + e_v * fb_v;
            v_m = [v_m[0] + p * e_u, v_m[1] + q * e_u + r * e_v];
        }
        out.v_scales = if raw { v_scales * splat.scales } else { v_scales }.to_array();
        let v_b = v_m.map(|v| v * splat.scales);

        // Axes -> quaternion, through its normalisation.
        let v_axes = Mat3::from_cols(
            g.a[0] * v_b[0].x + g.a[1] * v_b[1].x,
            g.a[0] * v_b[0].y + g.a[1] * v_b[1].y,
            g.a[0] * v_b[0].z + g.a[1] * v_b[1].z,
        );
        let v_unit = quat_gradient(g.quat, v_axes);
        let along = v_unit[0] * g.quat[0]
            + v_unit[1] * g.quat[1]
            + v_unit[2] * g.quat[2]
            + v_unit[3] * g.quat[3];
        out.v_quat = std::array::from_fn(|k| (v_unit[k] - along * g.quat[k]) / g.quat_norm);

        // a = J R, with x/z and y/z held where they are limited.
        let v_a = v_b.map(|v| g.axes * v);
        let (jx, jy) = (fx * inverse_z, fy * inverse_z);
        let (v_j00, v_j02) = (v_a[0].dot(view.rows[0]), v_a[0].dot(view.rows[2]));
        let (v_j11, v_j12) = (v_a[1].dot(view.rows[1]), v_a[1].dot(view.rows[2]));
        v_t.z -= ((v_j00 - v_j02 * g.xz) * jx + (v_j11 - v_j12 * g.yz) * jy) * inverse_z;
        let (v_xz, v_yz) = (-v_j02 * jx, -v_j12 * jy);
        if g.inside[0] {
            v_t.x += v_xz * inverse_z;
            v_t.z -= v_xz * g.xz * inverse_z;
        }
        if g.inside[1] {
            v_t.y += v_yz * inverse_z;
            v_t.z -= v_yz * g.yz * inverse_z;
        }

        // Centre and depth.
        let [v_u, v_v] = v.v_mean;
        let (x_z, y_z) = (g.t.x * inverse_z, g.t.y * inverse_z);
        v_t += Vec3::new(v_u * jx, v_v * jy, v.v_depth - (v_u * jx * x_z + v_v * jy * y_z));

        out.v_mean =
            (view.rows[0] * v_t.x + view.rows[1] * v_t.y + view.rows[2] * v_t.z).to_array();
        if let Some(camera) = v_camera {
            let mean = splat.mean;
            camera.add_rotation([
                v_a[0] * jx + mean * v_t.x,
                v_a[1] * jy + mean * v_t.y,
                -v_a[0] * (jx * g.xz) - v_a[1] * (jy * g.yz) + mean * v_t.z,
            ]);
            for (row, v) in camera.v_viewmat.iter_mut().zip(v_t.to_array()) {
                row[3] += f64::from(v);
            }
            let mut intrinsics = [
                (v_j00 - v_j02 * g.xz) * inverse_z + v_u * x_z,
                (v_j11 - v_j12 * g.yz) * inverse_z + v_v * y_z,
                v_u,
                v_v,
            ];
            // The limits are affine functions of the principal point, over the focal length.
            if !g.inside[0] {
                intrinsics[0] -= v_xz * g.xz / fx;
                intrinsics[2] -= v_xz / fx;
            }
            if !g.inside[1] {
                intrinsics[1] -= v_yz * g.yz / fy;
                intrinsics[3] -= v_yz / fy;
            }
            for (sum, value) in camera.v_intrinsics.iter_mut().zip(intrinsics) {
                *sum += f64::from(value);
            }
        }
        out
    }
}

pub(super) fn project_backward(
    splats: &SplatParams<'_, f32>,
    camera: &Camera,
    options: &ProjectOptions,
    projected: &Projected<f32>,
    v_projected: &ProjectedGradients<f32>,
) -> SplatGradients<f32> {
    let view = View::new(camera, options);
    let backward = SplatBackward { view: &view, colors: splats.colors, raw: splats.raw };
    let n = splats.len();
    let (stride, rows) = match splats.colors {
        Colors::Direct(colors) => (1, colors.len()),
        Colors::Sh { stride, coeffs, .. } => (stride, coeffs.len()),
    };
    let mut out = SplatGradients {
        v_means: vec![[0.0; 3]; n],
        v_quats: vec![[0.0; 4]; n],
        v_scales: vec![[0.0; 3]; n],
        v_opacities: vec![0.0; n],
        v_colors: vec![[0.0; 3]; rows],
        ..SplatGradients::default()
    };
    let all = SplatSlices {
        means: &mut out.v_means,
        quats: &mut out.v_quats,
        scales: &mut out.v_scales,
        opacities: &mut out.v_opacities,
        sh: &mut out.v_colors,
    };
    // Chunks of fixed size, so that the camera's sums do not depend on the threads.
    let cameras: Vec<VCamera> = all
        .into_blocks(CHUNK, stride)
        .enumerate()
        .map(|(chunk, out)| {
            let mut v_camera = VCamera::default();
            for k in 0..out.means.len() {
                let i = chunk * CHUNK + k;
                if projected.radii[i] == [0.0; 2] {
                    continue;
                }
                let (factor, v_factor) = (projected.factors[i], v_projected.v_factors[i]);
                let v = V2d {
                    v_mean: v_projected.v_means2d[i],
                    v_whitened: V2d::whitened_from_factor(factor, v_factor),
                    v_depth: v_projected.v_depths[i],
                    v_color: v_projected.v_colors[i],
                    v_opacity: v_projected.v_opacities[i],
                };
                let v_sh = &mut out.sh[k * stride..(k + 1) * stride];
                let splat = Splat::load(splats, i);
                let v = backward.run(i, &splat, &v, v_sh, Some(&mut v_camera));
                out.means[k] = v.v_mean;
                out.quats[k] = v.v_quat;
                out.scales[k] = v.v_scales;
                out.opacities[k] = v.v_opacity;
            }
            v_camera
        })
        .collect();
    let mut v_camera = VCamera::default();
    for camera in &cameras {
        v_camera.add(camera);
    }
    out.v_viewmat = v_camera.v_viewmat;
    out.v_intrinsics = v_camera.v_intrinsics;
    out
}
