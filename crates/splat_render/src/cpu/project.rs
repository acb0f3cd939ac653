//! project: splats and camera to 2D splats, f32.

use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::constants::{ALPHA_MIN, QUAT_NORM2_MIN};
use crate::sh;
use crate::stages::{Colors, ProjectOptions, Projected, SplatParams};

/// A camera and the stage's options, rounded to f32 once.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    pub rotation: Mat3,
    /// The rotation's rows: the camera's axes in the world.
    pub rows: [Vec3; 3],
    pub translation: Vec3,
    pub focal: Vec2,
    pub center: Vec2,
    /// [x_low, x_high, y_low, y_high] of x/z and y/z in the Jacobian.
    pub limits: [f32; 4],
    pub size: Vec2,
    pub options: ProjectOptions,
    /// Least depth that is drawn.
    pub nearest: f32,
}

impl View {
    pub fn new(camera: &Camera, options: &ProjectOptions) -> Self {
        let rotation = camera.rotation().as_mat3();
        let rows = rotation.transpose();
        Self {
            rotation,
            rows: [rows.x_axis, rows.y_axis, rows.z_axis],
            translation: camera.translation().as_vec3(),
            focal: Vec2::new(camera.fx as f32, camera.fy as f32),
            center: Vec2::new(camera.cx as f32, camera.cy as f32),
            limits: camera.jacobian_limits().map(|l| l as f32),
            size: Vec2::new(camera.width as f32, camera.height as f32),
            options: *options,
            nearest: options.nearest(),
        }
    }
}

/// One splat's activated parameters.
#[derive(Debug, Clone, Copy)]
pub(super) struct Splat {
    pub mean: Vec3,
    pub quat: [f32; 4],
    pub scales: Vec3,
    pub opacity: f32,
    /// Derivative of the opacity with respect to the parameter as given.
    pub opacity_slope: f32,
}

impl Splat {
    /// The same splat where others are left out at random: more opaque by `factor`.
    #[inline(always)]
    pub fn compensated(mut self, factor: f32) -> Self {
        self.opacity *= factor;
        self.opacity_slope *= factor;
        self
    }

    /// A splat as it is given to the stages.
    #[inline(always)]
    pub fn load(splats: &SplatParams<'_, f32>, i: usize) -> Self {
        let (scales, opacity) = (splats.scales[i], splats.opacities[i]);
        if splats.raw {
            return Self::activate(splats.means[i], splats.quats[i], scales, opacity);
        }
        Self {
            mean: Vec3::from(splats.means[i]),
            quat: splats.quats[i],
            scales: Vec3::from(scales),
            opacity: if opacity.is_finite() { opacity } else { f32::NAN },
            opacity_slope: 1.0,
        }
    }

    /// A splat as it is fitted: from log-scales and an opacity logit.
    #[inline(always)]
    pub fn activate(mean: [f32; 3], quat: [f32; 4], log_scales: [f32; 3], logit: f32) -> Self {
        let log_scales = Vec3::from(log_scales);
        // A logit of +inf is poisoned too, though its sigmoid is not.
        let logit = if logit.is_finite() { logit } else { f32::NAN };
        // o (1 - o) would be 0 where o rounds to 1.
        let e = (-logit.abs()).exp();
        Self {
            mean: Vec3::from(mean),
            quat,
            // A log-scale of -inf is no splat of size 0 but a poisoned one: NaN is culled.
            scales: if log_scales.is_finite() { log_scales.exp() } else { Vec3::NAN },
            opacity: 1.0 / (1.0 + (-logit).exp()),
            opacity_slope: e / ((1.0 + e) * (1.0 + e)),
        }
    }
}

/// What both directions of the stage need of one splat.
pub(super) struct Geometry {
    pub t: Vec3,
    pub axes: Mat3,
    pub quat_norm: f32,
    pub quat: [f32; 4],
    pub xz: f32,
    pub yz: f32,
    pub inside: [bool; 2],
    /// Rows of J times the camera's rotation.
    pub a: [Vec3; 2],
    /// The same in the splat's axes.
    pub b: [Vec3; 2],
    /// The same times the scales: the 2D covariance is m m^T + blur.
    pub m: [Vec3; 2],
    /// b0 x b1.
    pub normal: Vec3,
}

/// None if the splat is culled for its own values or its depth. Comparisons are written so that
/// NaN is culled.
#[inline(always)]
pub(super) fn geometry(view: &View, splat: &Splat) -> Option<Geometry> {
    let t = view.rotation * splat.mean + view.translation;
    if !(t.z >= view.nearest && t.z <= view.options.far && t.is_finite()) {
        return None;
    }
    let [w, x, y, z] = splat.quat;
    let norm2 = w * w + x * x + y * y + z * z;
    if !(norm2 >= QUAT_NORM2_MIN && norm2.is_finite()) {
        return None;
    }
    if !(splat.scales.min_element() >= 0.0 && splat.scales.is_finite()) {
        return None;
    }
    let quat_norm = norm2.sqrt();
    let inverse = quat_norm.recip();
    let quat = [w * inverse, x * inverse, y * inverse, z * inverse];
    let axes = Mat3::from_quat(glam::Quat::from_xyzw(quat[1], quat[2], quat[3], quat[0]));
    let [x_low, x_high, y_low, y_high] = view.limits;
    let inverse_z = t.z.recip();
    let raw = [t.x * inverse_z, t.y * inverse_z];
    let (xz, yz) = (raw[0].clamp(x_low, x_high), raw[1].clamp(y_low, y_high));
    let a = [
        (view.rows[0] - view.rows[2] * xz) * (view.focal.x * inverse_z),
        (view.rows[1] - view.rows[2] * yz) * (view.focal.y * inverse_z),
    ];
    let b =
        a.map(|row| Vec3::new(axes.x_axis.dot(row), axes.y_axis.dot(row), axes.z_axis.dot(row)));
    let m = b.map(|row| row * splat.scales);
    // J's rows have the cross product (x/z, y/z, 1) fx fy / z^2: no difference of two near-equal
    // products, so a needle seen from any side keeps its area.
    let across = view.rows[0] * xz + view.rows[1] * yz + view.rows[2];
    let across = across * (view.focal.x * inverse_z) * (view.focal.y * inverse_z);
    let normal =
        Vec3::new(axes.x_axis.dot(across), axes.y_axis.dot(across), axes.z_axis.dot(across));
    let inside = [raw[0] == xz, raw[1] == yz];
    Some(Geometry { t, axes, quat_norm, quat, xz, yz, inside, a, b, m, normal })
}

/// A splat's outline in the picture.
pub(super) struct Ellipse {
    /// (p, q, r)
    pub factor: [f32; 3],
    /// Variances along x and y, blur included.
    pub variances: Vec2,
    /// m0 x m1; its length is the root of the determinant without blur.
    pub area: Vec3,
    /// What the opacity is multiplied by; 1 if not antialiased.
    pub compensation: f32,
}

#[inline(always)]
pub(super) fn ellipse(view: &View, scales: Vec3, g: &Geometry) -> Ellipse {
    let blur = view.options.blur;
    let (sxx, sxy, syy) = (g.m[0].length_squared(), g.m[0].dot(g.m[1]), g.m[1].length_squared());
    let r = (syy + blur).sqrt().recip();
    let [x, y, z] = scales.to_array();
    // Divided by cyy early, so that nothing overflows before the covariance itself does.
    let area_r = g.normal * Vec3::new(y * r * z, z * r * x, x * r * y);
    // det / cyy, the variance of x given y, as a sum of positive terms (Cauchy-Binet).
    let given = area_r.length_squared() + blur * (sxx + syy + blur) * (r * r);
    let p = given.sqrt().recip();
    Ellipse {
        factor: [p, -sxy * (r * r) * p, r],
        variances: Vec2::new(sxx + blur, syy + blur),
        area: g.normal * Vec3::new(y * z, z * x, x * y),
        compensation: if view.options.antialiased { area_r.length() * p } else { 1.0 },
    }
}

/// Unit view direction in the world and the length it was normalised by.
#[inline(always)]
pub(super) fn direction(view: &View, t: Vec3) -> (Vec3, f32) {
    let along = view.rows[0] * t.x + view.rows[1] * t.y + view.rows[2] * t.z;
    let length = along.length();
    (along / length, length)
}

/// SH colour before the cut at zero.
#[inline(always)]
pub(super) fn sh_color(degree: u32, basis: &[f32], coeffs: &[[f32; 3]]) -> Vec3 {
    let mut color = Vec3::splat(0.5);
    for (b, c) in basis.iter().zip(coeffs).take(sh::coeffs(degree)) {
        color += *b * Vec3::from(*c);
    }
    color
}

/// One visible 2D splat.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Splat2d {
    pub mean: [f32; 2],
    pub factor: [f32; 3],
    pub depth: f32,
    pub color: [f32; 3],
    pub opacity: f32,
    pub radii: [f32; 2],
}

/// None if the splat is culled.
#[inline(always)]
pub(super) fn project_splat(
    view: &View,
    splat: &Splat,
    colors: &Colors<'_, f32>,
    i: usize,
) -> Option<Splat2d> {
    let g = geometry(view, splat)?;
    let ellipse = ellipse(view, splat.scales, &g);
    let opacity = splat.opacity * ellipse.compensation;
    let reach = 2.0 * (opacity / ALPHA_MIN).ln();
    if !(reach > 0.0 && reach.is_finite()) {
        return None;
    }
    let [p, q, r] = ellipse.factor;
    let radii = (ellipse.variances * reach).map(f32::sqrt);
    let center = view.focal * g.t.truncate() / g.t.z + view.center;
    // Written so that a NaN or infinity anywhere culls.
    let reaches_image = (center + radii).cmpge(Vec2::ZERO).all()
        && (center - radii).cmple(view.size).all()
        && radii.is_finite()
        && center.is_finite();
    if !(reaches_image && p > 0.0 && p.is_finite() && q.is_finite() && r.is_finite()) {
        return None;
    }
    let color = match *colors {
        Colors::Direct(colors) => Vec3::from(colors[i]),
        Colors::Sh { degree, stride, coeffs } => {
            let basis = sh::basis(degree, direction(view, g.t).0.to_array());
            let color = sh_color(degree, &basis, &coeffs[i * stride..(i + 1) * stride]);
            // Before the cut at zero, which would hide a poisoned coefficient here and let it out
            // in the gradients.
            if !color.is_finite() {
                return None;
            }
            color.max(Vec3::ZERO)
        }
    };
    color.is_finite().then(|| Splat2d {
        mean: center.to_array(),
        factor: [p, q, r],
        depth: g.t.z,
        color: color.to_array(),
        opacity,
        radii: radii.to_array(),
    })
}

pub(super) fn project(
    splats: &SplatParams<'_, f32>,
    camera: &Camera,
    options: &ProjectOptions,
) -> Projected<f32> {
    let view = View::new(camera, options);
    let list: Vec<Option<Splat2d>> = (0..splats.len())
        .into_par_iter()
        .map(|i| project_splat(&view, &Splat::load(splats, i), &splats.colors, i))
        .collect();
    let mut out = Projected::culled(splats.len(), camera.width, camera.height);
    for (i, splat) in list.iter().enumerate() {
        let Some(splat) = splat else { continue };
        out.means2d[i] = splat.mean;
        out.factors[i] = splat.factor;
        out.depths[i] = splat.depth;
        out.colors[i] = splat.color;
        out.opacities[i] = splat.opacity;
        out.radii[i] = splat.radii;
    }
    out
}
