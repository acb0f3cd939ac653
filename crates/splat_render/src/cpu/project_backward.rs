//! project_backward in f32: a block of splats at a time, one splat per lane.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::block::{BLOCK, ColorRows, Ids, Row, SplatRows, get3, set3, vectors};
use super::lanes::{Lanes, Mask, Mat3s, Vec3s};
use super::project::{Splats, View, direction, ellipses, geometry, sh_color, to_world};
use super::simd::dispatch;
use crate::camera::Camera;
use crate::constants::SH_COEFFS_MAX;
use crate::sh;
use crate::splats::SplatSlices;
use crate::stages::{
    Colors, ProjectOptions, Projected, ProjectedGradients, SplatGradients, SplatParams,
};

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct V2d {
    pub v_mean: [f32; 2],
    /// Gradient of the 2D covariance in the splat's own coordinates (u, v), in which it is the identity:
    /// (uu, uv, vv); uv is the shared off-diagonal entry.
    pub v_whitened: [f32; 3],
    pub v_depth: f32,
    pub v_color: [f32; 3],
    pub v_opacity: f32,
}

impl V2d {
    /// Gradient of the whitened covariance from the gradient of a factor F: a small change E of the
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
}

/// Each splat's contribution to the camera's gradient.
#[derive(Debug)]
struct CameraRows {
    /// Rows of the rotation.
    rotation: [[Row; 3]; 3],
    translation: [Row; 3],
    intrinsics: [Row; 4],
}

impl CameraRows {
    const ZERO: Self = Self {
        rotation: [[Row::ZERO; 3]; 3],
        translation: [Row::ZERO; 3],
        intrinsics: [Row::ZERO; 4],
    };

    /// The sums over the first `count` splats. Their order does not depend on the vectors' width.
    #[inline(always)]
    fn sum(&self, count: usize) -> VCamera {
        let mut out = VCamera::default();
        for r in 0..3 {
            for c in 0..3 {
                out.v_viewmat[r][c] = sum(&self.rotation[r][c], count);
            }
            out.v_viewmat[r][3] = sum(&self.translation[r], count);
        }
        for k in 0..4 {
            out.v_intrinsics[k] = sum(&self.intrinsics[k], count);
        }
        out
    }
}

/// The sum of a row's first `count` numbers, as eight sums that do not wait for each other.
#[inline(always)]
fn sum(row: &Row, count: usize) -> f64 {
    let mut sums = [0.0f64; 8];
    let (eights, rest) = row.0[..count].as_chunks::<8>();
    for eight in eights {
        for k in 0..8 {
            sums[k] += f64::from(eight[k]);
        }
    }
    for (k, value) in rest.iter().enumerate() {
        sums[k] += f64::from(*value);
    }
    let [a, b, c, d, e, f, g, h] = sums;
    ((a + b) + (c + d)) + ((e + f) + (g + h))
}

/// Gradient of a unit quaternion's rotation matrix, as (w, x, y, z).
#[inline(always)]
fn quat_gradient<S: Simd>([w, x, y, z]: [Lanes<S>; 4], v: Mat3s<S>) -> [Lanes<S>; 4] {
    let Mat3s([vx, vy, vz]) = v;
    // Antisymmetric and symmetric parts of v.
    let (ax, ay, az) = (vy.z - vz.y, vz.x - vx.z, vx.y - vy.x);
    let (sx, sy, sz) = (vz.y + vy.z, vx.z + vz.x, vy.x + vx.y);
    let two = w.all(2.0);
    [
        two * x.mul_add(ax, y.mul_add(ay, z * az)),
        two * w.mul_add(ax, y.mul_add(sz, z.mul_add(sy, x * -2.0 * (vy.y + vz.z)))),
        two * w.mul_add(ay, x.mul_add(sz, z.mul_add(sx, y * -2.0 * (vx.x + vz.z)))),
        two * w.mul_add(az, x.mul_add(sy, y.mul_add(sx, z * -2.0 * (vx.x + vy.y)))),
    ]
}

/// The stage for one camera and one way that splats are given.
#[derive(Debug, Clone, Copy)]
pub(super) struct Backward<'a> {
    pub view: &'a View,
    pub splats: SplatParams<'a, f32>,
    /// Factor of the opacities.
    pub compensation: f32,
    /// Whether the camera's gradient is wanted.
    pub camera: bool,
}

/// Scratch memory for one block of splats: inputs and outputs.
#[derive(Debug)]
pub(super) struct BackwardBlock {
    /// The splats of the block that have gradients; later arrays are in this order.
    ids: Ids,
    splats: SplatRows,
    coeffs: ColorRows,
    // Gradients of the 2D splats: V2d.
    v_means2d: [Row; 2],
    v_whitened: [Row; 3],
    v_depths: Row,
    v_colors2d: [Row; 3],
    v_opacities2d: Row,
    // Gradients of the splats. A coefficient's is the color's times its basis function.
    v_means: [Row; 3],
    v_quats: [Row; 4],
    v_scales: [Row; 3],
    v_opacities: Row,
    basis: [Row; SH_COEFFS_MAX],
    v_colors: [Row; 3],
    /// Directions at which the basis was evaluated.
    directions: [Row; 3],
    v_camera: CameraRows,
}

/// Gradient of a splat's color before the clamp at zero, and the viewing direction. A coefficient's
/// gradient is its basis function at the direction times the color's gradient.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ColorGradient {
    pub v_color: [f32; 3],
    pub direction: [f32; 3],
}

impl BackwardBlock {
    pub fn new() -> Box<Self> {
        Box::new(Self {
            ids: Ids::NONE,
            splats: SplatRows::ZERO,
            coeffs: ColorRows::ZERO,
            v_means2d: [Row::ZERO; 2],
            v_whitened: [Row::ZERO; 3],
            v_depths: Row::ZERO,
            v_colors2d: [Row::ZERO; 3],
            v_opacities2d: Row::ZERO,
            v_means: [Row::ZERO; 3],
            v_quats: [Row::ZERO; 4],
            v_scales: [Row::ZERO; 3],
            v_opacities: Row::ZERO,
            basis: [Row::ZERO; SH_COEFFS_MAX],
            v_colors: [Row::ZERO; 3],
            directions: [Row::ZERO; 3],
            v_camera: CameraRows::ZERO,
        })
    }

    #[inline(always)]
    pub fn clear(&mut self) {
        self.ids.clear();
    }

    /// Takes the gradient of splat `k` of the block, the splats in order.
    #[inline(always)]
    pub fn push(&mut self, k: usize, v: &V2d) {
        let at = self.ids.get().len();
        self.ids.push(k);
        for (row, value) in self.v_means2d.iter_mut().zip(v.v_mean) {
            row.0[at] = value;
        }
        for (row, value) in self.v_whitened.iter_mut().zip(v.v_whitened) {
            row.0[at] = value;
        }
        for (row, value) in self.v_colors2d.iter_mut().zip(v.v_color) {
            row.0[at] = value;
        }
        self.v_depths.0[at] = v.v_depth;
        self.v_opacities2d.0[at] = v.v_opacity;
    }

    /// Writes the gradients of the pushed splats except colors to `out`; returns the camera's.
    pub fn run(&mut self, stage: &Backward<'_>, first: usize, out: SplatSlices<'_>) -> VCamera {
        dispatch(Run { block: self, stage, first, out })
    }

    /// Gradients of the colors of the splats that were pushed, with their numbers in the block.
    pub fn color_gradients(&self) -> impl Iterator<Item = (usize, ColorGradient)> {
        let of = |rows: &[Row; 3], at: usize| [rows[0].0[at], rows[1].0[at], rows[2].0[at]];
        self.ids.get().iter().enumerate().map(move |(at, &k)| {
            let v_color = of(&self.v_colors, at);
            (usize::from(k), ColorGradient { v_color, direction: of(&self.directions, at) })
        })
    }

    /// Writes the gradients of the first `used` of `stride` coefficients of the splats that were pushed.
    fn write_colors(&self, [stride, used]: [usize; 2], out: &mut [[f32; 3]]) {
        for (at, &k) in (0..BLOCK).zip(self.ids.get()) {
            let [red, green, blue] = &self.v_colors;
            let (red, green, blue) = (red.0[at], green.0[at], blue.0[at]);
            let rows = out[usize::from(k) * stride..][..used].iter_mut();
            for (v, basis) in rows.zip(&self.basis) {
                let basis = basis.0[at];
                *v = [basis * red, basis * green, basis * blue];
            }
        }
    }
}

struct Run<'a, 'b> {
    block: &'a mut BackwardBlock,
    stage: &'a Backward<'b>,
    first: usize,
    out: SplatSlices<'a>,
}

impl WithSimd for Run<'_, '_> {
    type Output = VCamera;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> VCamera {
        let Self { block, stage, first, out } = self;
        let ids = block.ids;
        let ids = ids.get();
        block.splats.take(&stage.splats, first, ids);
        if let Colors::Sh { degree, stride, coeffs } = stage.splats.colors {
            block.coeffs.take(coeffs, [stride, sh::coeffs(degree)], first, ids);
        }
        for at in 0..vectors::<S>(ids.len()) {
            block.gradients(s, stage, at);
        }
        block.write(ids, out);
        if stage.camera { block.v_camera.sum(ids.len()) } else { VCamera::default() }
    }
}

impl BackwardBlock {
    #[inline(always)]
    fn gradients<S: Simd>(&mut self, s: S, stage: &Backward<'_>, at: usize) {
        let Backward { view, ref splats, compensation, camera } = *stage;
        let raw = splats.raw;
        let colors = &splats.colors;
        let splats = Splats::load(s, &self.splats, at, raw, compensation);
        let g = geometry(s, view, &splats);
        let [row_x, row_y, row_z] = view.axes(s);
        let zero = Lanes::splat(s, 0.0);
        let none = Vec3s::new(zero, zero, zero);
        let (inverse_z, xz, yz) = (g.inverse_z, g.xz, g.yz);
        let (jx, jy) = (inverse_z * view.focal.x, inverse_z * view.focal.y);
        let mut v_t = none;

        // Color and, through the view direction, t and the rotation.
        let mut v_color = get3(&self.v_colors2d, s, at);
        let mut v_along = none;
        if let Colors::Sh { degree, .. } = *colors {
            let (dir, length) = direction(view, g.t);
            // The direction is arbitrary in lanes that draw nothing, and zero times infinity is NaN.
            let dir = dir.is_finite().keep3(dir);
            set3(&mut self.directions, at, dir);
            let basis = sh::basis(degree, [dir.x, dir.y, dir.z]);
            for k in 0..sh::coeffs(degree) {
                self.basis[k].set(at, basis[k]);
            }
            let color = sh_color(degree, &basis, &self.coeffs, at);
            v_color = Vec3s::new(
                color.x.gt(zero).keep(v_color.x),
                color.y.gt(zero).keep(v_color.y),
                color.z.gt(zero).keep(v_color.z),
            );
            if degree > 0 {
                let slopes = sh::basis_gradient(degree, [dir.x, dir.y, dir.z]);
                let mut v_dir = none;
                for k in 1..sh::coeffs(degree) {
                    let [x, y, z] = slopes[k];
                    let along = v_color.dot(self.coeffs.get3(s, k, at));
                    v_dir = Vec3s::new(x, y, z).mul_add(along, v_dir);
                }
                v_along = dir.mul_add(-dir.dot(v_dir), v_dir) * length.recip();
                v_t = Vec3s::new(row_x.dot(v_along), row_y.dot(v_along), row_z.dot(v_along));
            }
        } else {
            self.basis[0].set(at, zero.all(1.0));
        }

        let ellipses = ellipses(view, splats.scales, &g);
        let v_opacity2d = self.v_opacities2d.get(s, at);
        let v_opacity = v_opacity2d * ellipses.compensation * splats.opacity_slope;

        // Whitened 2D covariance -> M = J R A S. The rows of F B and F M are of order 1 even for a
        // needle, and found without the cancellation that F, B and M would bring to their products.
        let [p, q, r] = ellipses.factor;
        let Vec3s { x: v_uu, y: v_uv, z: v_vv } = get3(&self.v_whitened, s, at);
        let scales = splats.scales;
        let blur = zero.all(view.options.blur);
        let fb_u = g.b[0].mul_add(blur, (scales * scales * g.b[1]).cross(g.normal)) * (p * r * r);
        let fb_v = g.b[1] * r;
        let (fm_u, fm_v) = (fb_u * scales, fb_v * scales);
        let v_fm_u = fm_u.mul_add(v_uu + v_uu, fm_v * v_uv);
        let v_fm_v = fm_v.mul_add(v_vv + v_vv, fm_u * v_uv);
        let mut v_scales = v_fm_u * fb_u + v_fm_v * fb_v;
        let mut v_m = [v_fm_u * p, v_fm_u.mul_add(q, v_fm_v * r)];
        if view.options.antialiased {
            // With S = M M^T and C = S + blur I, ln compensation = (ln det S - ln det C) / 2 has the
            // gradient S^-1 M - C^-1 M, whose terms cancel for large splats; it is blur C^-1 S^-1 M. The
            // rows of S^-1 M are m1 x n / n^2 and n x m0 / n^2 with n = m0 x m1, divided by the length
            // twice, since its square may underflow.
            let inverse_length = ellipses.area.length().recip();
            let n = ellipses.area * inverse_length * inverse_length;
            let w = [g.m[1].cross(n), n.cross(g.m[0])];
            let v_log = v_opacity2d * splats.opacity * ellipses.compensation * blur;
            let e_u = w[0].mul_add(p, w[1] * q) * v_log;
            let e_v = w[1] * r * v_log;
            v_scales = v_scales + (e_u * fb_u + e_v * fb_v);
            v_m = [e_u.mul_add(p, v_m[0]), v_m[1] + e_u.mul_add(q, e_v * r)];
        }
        if raw {
            v_scales = v_scales * scales;
        }
        let v_b = [v_m[0] * scales, v_m[1] * scales];

        // Axes -> quaternion, through its normalization.
        let v_axes = Mat3s([
            g.a[0].mul_add(v_b[0].x, g.a[1] * v_b[1].x),
            g.a[0].mul_add(v_b[0].y, g.a[1] * v_b[1].y),
            g.a[0].mul_add(v_b[0].z, g.a[1] * v_b[1].z),
        ]);
        let v_unit = quat_gradient(g.quat, v_axes);
        let mut along = v_unit[0] * g.quat[0];
        for k in 1..4 {
            along = v_unit[k].mul_add(g.quat[k], along);
        }
        let mut v_quat = v_unit;
        for k in 0..4 {
            v_quat[k] = g.quat[k].mul_add(-along, v_unit[k]) * g.inverse_norm;
        }

        // a = J R, with clamped x/z and y/z held constant.
        let v_a = [g.axes * v_b[0], g.axes * v_b[1]];
        let (v_j02, v_j12) = (v_a[0].dot(row_z), v_a[1].dot(row_z));
        let v_jx = v_j02.mul_add(-xz, v_a[0].dot(row_x));
        let v_jy = v_j12.mul_add(-yz, v_a[1].dot(row_y));
        v_t.z = v_t.z - v_jx.mul_add(jx, v_jy * jy) * inverse_z;
        let (v_xz, v_yz) = (-(v_j02 * jx), -(v_j12 * jy));
        let [inside_x, inside_y] = g.inside;
        let (by_x, by_y) = (inside_x.keep(v_xz * inverse_z), inside_y.keep(v_yz * inverse_z));
        v_t.x = v_t.x + by_x;
        v_t.y = v_t.y + by_y;
        v_t.z = v_t.z - by_x.mul_add(xz, by_y * yz);

        // Center and depth.
        let (v_u, v_v) = (self.v_means2d[0].get(s, at), self.v_means2d[1].get(s, at));
        let (x_z, y_z) = (g.t.x * inverse_z, g.t.y * inverse_z);
        let (v_x, v_y) = (v_u * jx, v_v * jy);
        let v_z = self.v_depths.get(s, at) - v_x.mul_add(x_z, v_y * y_z);
        v_t = v_t + Vec3s::new(v_x, v_y, v_z);
        let v_mean = to_world([row_x, row_y, row_z], v_t);

        // A finite picture can still have gradients that overflow. All of that splat's become zero: they
        // must not reach the camera or, through Adam's moments, later steps.
        let mut finite = Finite::new(v_opacity);
        finite.add3(v_color);
        finite.add3(v_mean);
        finite.add3(v_scales);
        for v in v_quat {
            finite.add(v);
        }
        let kept = g.drawn & finite.mask();
        set3(&mut self.v_means, at, kept.keep3(v_mean));
        set3(&mut self.v_scales, at, kept.keep3(v_scales));
        set3(&mut self.v_colors, at, kept.keep3(v_color));
        self.v_opacities.set(at, kept.keep(v_opacity));
        for k in 0..4 {
            self.v_quats[k].set(at, kept.keep(v_quat[k]));
        }
        if !camera {
            return;
        }

        let mean = splats.mean;
        let v_row_x = v_along.mul_add(g.t.x, v_a[0].mul_add(jx, mean * v_t.x));
        let v_row_y = v_along.mul_add(g.t.y, v_a[1].mul_add(jy, mean * v_t.y));
        let v_row_z = v_a[0].mul_add(jx * xz, v_a[1] * (jy * yz));
        let v_row_z = v_along.mul_add(g.t.z, mean * v_t.z - v_row_z);
        // The limits are affine functions of the principal point, over the focal length.
        let at_x = (!inside_x).keep(v_xz * (1.0 / view.focal.x));
        let at_y = (!inside_y).keep(v_yz * (1.0 / view.focal.y));
        let v_fx = v_u.mul_add(x_z, v_jx * inverse_z) - at_x * xz;
        let v_fy = v_v.mul_add(y_z, v_jy * inverse_z) - at_y * yz;
        let (v_cx, v_cy) = (v_u - at_x, v_v - at_y);
        let mut finite = Finite::new(v_fx);
        finite.add(v_fy);
        finite.add3(v_row_x);
        finite.add3(v_row_y);
        finite.add3(v_row_z);
        let kept = kept & finite.mask();
        let CameraRows { rotation, translation, intrinsics } = &mut self.v_camera;
        set3(&mut rotation[0], at, kept.keep3(v_row_x));
        set3(&mut rotation[1], at, kept.keep3(v_row_y));
        set3(&mut rotation[2], at, kept.keep3(v_row_z));
        set3(translation, at, kept.keep3(v_t));
        intrinsics[0].set(at, kept.keep(v_fx));
        intrinsics[1].set(at, kept.keep(v_fy));
        intrinsics[2].set(at, kept.keep(v_cx));
        intrinsics[3].set(at, kept.keep(v_cy));
    }

    /// Writes the outputs except colors, in the parameters' layout.
    #[inline(always)]
    fn write(&self, ids: &[u8], out: SplatSlices<'_>) {
        for (at, &k) in (0..BLOCK).zip(ids) {
            let k = usize::from(k);
            for (value, row) in out.means[k].iter_mut().zip(&self.v_means) {
                *value = row.0[at];
            }
            for (value, row) in out.quats[k].iter_mut().zip(&self.v_quats) {
                *value = row.0[at];
            }
            for (value, row) in out.scales[k].iter_mut().zip(&self.v_scales) {
                *value = row.0[at];
            }
            out.opacities[k] = self.v_opacities.0[at];
        }
    }
}

/// Whether everything that was added is finite.
struct Finite<S: Simd>(Lanes<S>);

impl<S: Simd> Finite<S> {
    #[inline(always)]
    fn new(value: Lanes<S>) -> Self {
        Self(value * 0.0)
    }

    // Zero times a number that is not finite is NaN, and stays it.
    #[inline(always)]
    fn add(&mut self, value: Lanes<S>) {
        self.0 = value.mul_add(value.all(0.0), self.0);
    }

    #[inline(always)]
    fn add3(&mut self, value: Vec3s<S>) {
        self.add(value.x);
        self.add(value.y);
        self.add(value.z);
    }

    #[inline(always)]
    fn mask(self) -> Mask<S> {
        self.0.eq(self.0.all(0.0))
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
    let stage = Backward { view: &view, splats: *splats, compensation: 1.0, camera: true };
    let n = splats.len();
    let (stride, used, rows) = match splats.colors {
        Colors::Direct(colors) => (1, 1, colors.len()),
        Colors::Sh { degree, stride, coeffs } => (stride, sh::coeffs(degree), coeffs.len()),
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
    // By block, so that the camera's sums do not depend on the threads.
    let cameras: Vec<VCamera> = all
        .into_blocks(BLOCK, stride)
        .enumerate()
        .map_init(BackwardBlock::new, |block, (number, mut out)| {
            let first = number * BLOCK;
            block.clear();
            for k in 0..out.means.len() {
                let i = first + k;
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
                block.push(k, &v);
            }
            let colors = std::mem::take(&mut out.sh);
            let camera = block.run(&stage, first, out);
            block.write_colors([stride, used], colors);
            camera
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
