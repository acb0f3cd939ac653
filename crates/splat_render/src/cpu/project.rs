//! project: splats and camera to 2D splats, f32, a block of splats at a time, one splat per lane.

use glam::{Vec2, Vec3};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::block::{BLOCK, ColorRows, Ids, Row, SplatRows, get3, set3, vectors};
use super::elementary::{exp, ln};
use super::lanes::{Lanes, Mask, Mat3s, Vec3s, normalized};
use super::simd::dispatch;
use crate::camera::Camera;
use crate::constants::{ALPHA_MIN, QUAT_NORM2_MIN, SH_COEFFS_MAX};
use crate::sh;
use crate::stages::{Colors, ProjectOptions, Projected, SplatParams};

/// A camera and the stage's options, rounded to f32 once.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
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
        let rows = camera.rotation().as_mat3().transpose();
        Self {
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

    /// The camera's axes in every lane.
    #[inline(always)]
    pub fn axes<S: Simd>(&self, s: S) -> [Vec3s<S>; 3] {
        let [x, y, z] = self.rows;
        [Vec3s::splat(s, x), Vec3s::splat(s, y), Vec3s::splat(s, z)]
    }
}

/// A vector in camera axes, brought into the world.
#[inline(always)]
pub(super) fn to_world<S: Simd>([x, y, z]: [Vec3s<S>; 3], v: Vec3s<S>) -> Vec3s<S> {
    z.mul_add(v.z, y.mul_add(v.y, x * v.x))
}

/// Splats' shape, size and opacity, one splat per lane.
#[derive(Clone, Copy)]
pub(super) struct Splats<S: Simd> {
    pub mean: Vec3s<S>,
    pub quat: [Lanes<S>; 4],
    pub scales: Vec3s<S>,
    pub opacity: Lanes<S>,
    /// Derivative of the opacity with respect to the parameter as given.
    pub opacity_slope: Lanes<S>,
    /// Whether scales and opacity were given as finite numbers; -inf and +inf count as invalid.
    pub given: Mask<S>,
}

/// The sigmoid of a logit and its derivative, o (1 - o), which stays accurate when o rounds to 1.
#[inline(always)]
pub(super) fn sigmoid<S: Simd>(logit: Lanes<S>) -> (Lanes<S>, Lanes<S>) {
    let (one, e) = (logit.all(1.0), exp(-logit.abs()));
    let positive = logit.ge(logit.all(0.0));
    let opacity = positive.select(one, e) / (e + one);
    (opacity, opacity * (positive.select(e, one) / (e + one)))
}

impl<S: Simd> Splats<S> {
    /// The vector `at` of a block, opacities times `compensation`; raw parameters if `raw`.
    #[inline(always)]
    pub fn load(s: S, rows: &SplatRows, at: usize, raw: bool, compensation: f32) -> Self {
        let (scales, opacity) = (get3(&rows.scales, s, at), rows.opacities.get(s, at));
        let given = scales.is_finite() & opacity.is_finite();
        let (scales, opacity, opacity_slope) = if raw {
            let scales = Vec3s::new(exp(scales.x), exp(scales.y), exp(scales.z));
            let (opacity, slope) = sigmoid(opacity);
            (scales, opacity, slope)
        } else {
            (scales, opacity, opacity.all(1.0))
        };
        Self {
            mean: get3(&rows.means, s, at),
            quat: rows.quat(s, at),
            scales,
            opacity: opacity * compensation,
            opacity_slope: opacity_slope * compensation,
            given,
        }
    }
}

/// Quantities of splats that forward and backward share.
#[derive(Clone, Copy)]
pub(super) struct Geometry<S: Simd> {
    /// False if a splat is culled by its values or its depth; its other fields are then undefined.
    pub drawn: Mask<S>,
    pub t: Vec3s<S>,
    pub inverse_z: Lanes<S>,
    pub axes: Mat3s<S>,
    /// One over the norm of the quaternion as given.
    pub inverse_norm: Lanes<S>,
    pub quat: [Lanes<S>; 4],
    pub xz: Lanes<S>,
    pub yz: Lanes<S>,
    pub inside: [Mask<S>; 2],
    /// Rows of J times the camera's rotation.
    pub a: [Vec3s<S>; 2],
    /// The same in the splat's axes.
    pub b: [Vec3s<S>; 2],
    /// The same times the scales: the 2D covariance is m m^T + blur.
    pub m: [Vec3s<S>; 2],
    /// b0 x b1.
    pub normal: Vec3s<S>,
}

/// Comparisons are written so that NaN is culled.
#[inline(always)]
pub(super) fn geometry<S: Simd>(s: S, view: &View, splats: &Splats<S>) -> Geometry<S> {
    let Splats { mean, scales, .. } = *splats;
    let [row_x, row_y, row_z] = view.axes(s);
    let (zero, translation) = (Lanes::splat(s, 0.0), Vec3s::splat(s, view.translation));
    let t = Vec3s::new(row_x.dot(mean), row_y.dot(mean), row_z.dot(mean)) + translation;
    let mut drawn = splats.given & t.is_finite();
    drawn = drawn & t.z.ge(zero.all(view.nearest)) & t.z.le(zero.all(view.options.far));
    let (norm2, inverse_norm, quat) = normalized(splats.quat);
    drawn = drawn & norm2.ge(zero.all(QUAT_NORM2_MIN)) & norm2.is_finite();
    drawn = drawn & scales.x.ge(zero) & scales.y.ge(zero) & scales.z.ge(zero) & scales.is_finite();
    let axes = Mat3s::from_quat(quat);
    let [x_low, x_high, y_low, y_high] = view.limits;
    let inverse_z = t.z.recip();
    let raw = [t.x * inverse_z, t.y * inverse_z];
    let xz = raw[0].max(zero.all(x_low)).min(zero.all(x_high));
    let yz = raw[1].max(zero.all(y_low)).min(zero.all(y_high));
    let (jx, jy) = (inverse_z * view.focal.x, inverse_z * view.focal.y);
    let a = [row_z.mul_add(-xz, row_x) * jx, row_z.mul_add(-yz, row_y) * jy];
    let b = [axes.transpose_mul(a[0]), axes.transpose_mul(a[1])];
    // J's rows have the cross product (x/z, y/z, 1) fx fy / z^2: no difference of two near-equal
    // products, so a needle seen from any side keeps its area.
    let across = row_x.mul_add(xz, row_y.mul_add(yz, row_z)) * jx * jy;
    Geometry {
        drawn,
        t,
        inverse_z,
        axes,
        inverse_norm,
        quat,
        xz,
        yz,
        inside: [raw[0].eq(xz), raw[1].eq(yz)],
        a,
        b,
        m: [b[0] * scales, b[1] * scales],
        normal: axes.transpose_mul(across),
    }
}

/// Splats' outlines in the picture.
#[derive(Clone, Copy)]
pub(super) struct Ellipses<S: Simd> {
    /// (p, q, r)
    pub factor: [Lanes<S>; 3],
    /// Variances along x and y, blur included.
    pub variances: [Lanes<S>; 2],
    /// m0 x m1; its length is the root of the determinant without blur.
    pub area: Vec3s<S>,
    /// Factor of the opacity; 1 if not antialiased.
    pub compensation: Lanes<S>,
}

#[inline(always)]
pub(super) fn ellipses<S: Simd>(view: &View, scales: Vec3s<S>, g: &Geometry<S>) -> Ellipses<S> {
    let sxy = g.m[0].dot(g.m[1]);
    let blur = sxy.all(view.options.blur);
    let cxx = g.m[0].length_squared() + blur;
    let syy = g.m[1].length_squared();
    let cyy = syy + blur;
    let r = cyy.sqrt().recip();
    let rr = r * r;
    let Vec3s { x, y, z } = scales;
    // Divided by cyy early, so that nothing overflows before the covariance itself does.
    let area_r = g.normal * Vec3s::new(y * r * z, z * r * x, x * r * y);
    // det / cyy, the variance of x given y, as a sum of positive terms (Cauchy-Binet).
    let given = (blur * (cxx + syy)).mul_add(rr, area_r.length_squared());
    let p = given.sqrt().recip();
    Ellipses {
        factor: [p, -(sxy * rr * p), r],
        variances: [cxx, cyy],
        area: g.normal * Vec3s::new(y * z, z * x, x * y),
        compensation: if view.options.antialiased { area_r.length() * p } else { p.all(1.0) },
    }
}

/// Unit view direction in the world and the length it was normalized by.
#[inline(always)]
pub(super) fn direction<S: Simd>(view: &View, t: Vec3s<S>) -> (Vec3s<S>, Lanes<S>) {
    let along = to_world(view.axes(t.x.simd()), t);
    let length = along.length();
    // Not times one over the length: it would double the rounding.
    (Vec3s::new(along.x / length, along.y / length, along.z / length), length)
}

/// SH colors before the cut at zero, of the vector `at` of a block's coefficients.
#[inline(always)]
pub(super) fn sh_color<S: Simd>(
    degree: u32,
    basis: &[Lanes<S>; SH_COEFFS_MAX],
    coeffs: &ColorRows,
    at: usize,
) -> Vec3s<S> {
    let half = basis[0].all(0.5);
    let mut color = Vec3s::new(half, half, half);
    for k in 0..sh::coeffs(degree) {
        color = coeffs.get3(half.simd(), k, at).mul_add(basis[k], color);
    }
    color
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Splat2d {
    pub mean: [f32; 2],
    pub factor: [f32; 3],
    pub depth: f32,
    pub color: [f32; 3],
    pub opacity: f32,
    /// Squared distance from the center, in standard deviations, at which alpha is `ALPHA_MIN`.
    pub reach: f32,
    pub radii: [f32; 2],
}

/// Scratch memory for one block of splats: inputs and outputs.
#[derive(Debug)]
pub(super) struct ProjectBlock {
    /// The projected splats of the block; later arrays are in this order.
    ids: Ids,
    splats: SplatRows,
    t: [Row; 3],
    means2d: [Row; 2],
    factors: [Row; 3],
    opacities: Row,
    reach: Row,
    radii: [Row; 2],
    /// 1 if the splat's shape is visible.
    reaches: Row,
    /// Indices of visible splats; later arrays are compacted in this order.
    visible: Ids,
    /// Their numbers in the block.
    numbers: Ids,
    visible_t: [Row; 3],
    coeffs: ColorRows,
    colors: [Row; 3],
    /// 1 if the color is finite.
    finite: Row,
}

impl ProjectBlock {
    pub fn new() -> Box<Self> {
        Box::new(Self {
            ids: Ids::NONE,
            splats: SplatRows::ZERO,
            t: [Row::ZERO; 3],
            means2d: [Row::ZERO; 2],
            factors: [Row::ZERO; 3],
            opacities: Row::ZERO,
            reach: Row::ZERO,
            radii: [Row::ZERO; 2],
            reaches: Row::ZERO,
            visible: Ids::NONE,
            numbers: Ids::NONE,
            visible_t: [Row::ZERO; 3],
            coeffs: ColorRows::ZERO,
            colors: [Row::ZERO; 3],
            finite: Row::ZERO,
        })
    }

    /// Projects the shapes of the splats `ids`, opacities times `compensation`; returns the visible ones.
    pub fn shapes(
        &mut self,
        view: &View,
        splats: &SplatParams<'_, f32>,
        first: usize,
        ids: Ids,
        compensation: f32,
    ) -> Ids {
        self.ids = ids;
        dispatch(Shapes { block: self, view, splats, first, compensation });
        self.numbers
    }

    /// Computes the colors of the splats that [`ProjectBlock::shapes`] returned.
    pub fn colors(&mut self, view: &View, colors: Colors<'_, f32>, first: usize) {
        dispatch(Paint { block: self, view, colors, first });
    }

    /// The visible splats with their ids in the block, in order.
    pub fn visible(&self) -> impl Iterator<Item = (usize, Splat2d)> {
        let places = self.visible.get().iter().enumerate();
        places.filter(|&(at, _)| self.finite.0[at] != 0.0).map(|(at, &place)| {
            let k = usize::from(place);
            let [red, green, blue] = &self.colors;
            let splat = Splat2d {
                mean: [self.means2d[0].0[k], self.means2d[1].0[k]],
                factor: [self.factors[0].0[k], self.factors[1].0[k], self.factors[2].0[k]],
                depth: self.t[2].0[k],
                color: [red.0[at], green.0[at], blue.0[at]],
                opacity: self.opacities.0[k],
                reach: self.reach.0[k],
                radii: [self.radii[0].0[k], self.radii[1].0[k]],
            };
            (usize::from(self.numbers.get()[at]), splat)
        })
    }
}

struct Shapes<'a> {
    block: &'a mut ProjectBlock,
    view: &'a View,
    splats: &'a SplatParams<'a, f32>,
    first: usize,
    compensation: f32,
}

impl WithSimd for Shapes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { block, view, splats, first, compensation } = self;
        let ids = block.ids.get();
        block.splats.take(splats, first, ids);
        for at in 0..vectors::<S>(ids.len()) {
            let splats = Splats::load(s, &block.splats, at, splats.raw, compensation);
            block.outline(s, view, &splats, at);
        }
        block.visible.clear();
        for k in 0..block.ids.get().len() {
            block.visible.push_if(k, block.reaches.0[k] != 0.0);
        }
        block.numbers.clear();
        for &place in block.visible.get() {
            block.numbers.push(usize::from(block.ids.get()[usize::from(place)]));
        }
    }
}

struct Paint<'a> {
    block: &'a mut ProjectBlock,
    view: &'a View,
    colors: Colors<'a, f32>,
    first: usize,
}

impl WithSimd for Paint<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        self.block.paint(s, self.view, self.colors, self.first);
    }
}

impl ProjectBlock {
    #[inline(always)]
    fn outline<S: Simd>(&mut self, s: S, view: &View, splats: &Splats<S>, at: usize) {
        let g = geometry(s, view, splats);
        let ellipses = ellipses(view, splats.scales, &g);
        let (zero, largest) = (Lanes::splat(s, 0.0), Lanes::splat(s, f32::MAX));
        let opacity = splats.opacity * ellipses.compensation;
        // exp(reach / 2); its logarithm is used only if positive.
        let contrast = opacity / zero.all(ALPHA_MIN);
        let mut visible = g.drawn & contrast.gt(zero.all(1.0)) & contrast.le(largest);
        let reach = ln(contrast) * 2.0;
        let [cxx, cyy] = ellipses.variances;
        let (rx, ry) = ((cxx * reach).sqrt(), (cyy * reach).sqrt());
        let x = g.t.x * view.focal.x / g.t.z + view.center.x;
        let y = g.t.y * view.focal.y / g.t.z + view.center.y;
        // Written so that a NaN or infinity anywhere culls.
        visible = visible & (x + rx).ge(zero) & (y + ry).ge(zero);
        visible = visible & (x - rx).le(zero.all(view.size.x)) & (y - ry).le(zero.all(view.size.y));
        visible = visible & rx.le(largest) & ry.le(largest) & x.is_finite() & y.is_finite();
        let [p, q, r] = ellipses.factor;
        visible = visible & p.gt(zero) & p.le(largest) & q.is_finite() & r.le(largest);
        set3(&mut self.t, at, g.t);
        self.means2d[0].set(at, x);
        self.means2d[1].set(at, y);
        set3(&mut self.factors, at, Vec3s::new(p, q, r));
        self.opacities.set(at, opacity);
        self.reach.set(at, reach);
        self.radii[0].set(at, rx);
        self.radii[1].set(at, ry);
        self.reaches.set(at, visible.keep(zero.all(1.0)));
    }

    #[inline(always)]
    fn paint<S: Simd>(&mut self, s: S, view: &View, colors: Colors<'_, f32>, first: usize) {
        let (places, numbers) = (self.visible.get(), self.numbers);
        let one = Lanes::splat(s, 1.0);
        match colors {
            Colors::Direct(colors) => {
                self.coeffs.take(colors, [1, 1], first, numbers.get());
                for at in 0..vectors::<S>(places.len()) {
                    let color = self.coeffs.get3(s, 0, at);
                    set3(&mut self.colors, at, color);
                    self.finite.set(at, color.is_finite().keep(one));
                }
            }
            Colors::Sh { degree, stride, coeffs } => {
                let used = sh::coeffs(degree);
                self.coeffs.take(coeffs, [stride, used], first, numbers.get());
                for (at, &place) in places.iter().enumerate() {
                    for (row, t) in self.visible_t.iter_mut().zip(&self.t) {
                        row.0[at] = t.0[usize::from(place)];
                    }
                }
                for at in 0..vectors::<S>(places.len()) {
                    let (dir, _) = direction(view, get3(&self.visible_t, s, at));
                    let basis = sh::basis(degree, [dir.x, dir.y, dir.z]);
                    let color = sh_color(degree, &basis, &self.coeffs, at);
                    // Before the clamp at zero, which would hide an invalid coefficient.
                    self.finite.set(at, color.is_finite().keep(one));
                    let zero = one.all(0.0);
                    let Vec3s { x, y, z } = color;
                    let color = Vec3s::new(x.max(zero), y.max(zero), z.max(zero));
                    set3(&mut self.colors, at, color);
                }
            }
        }
    }
}

pub(super) fn project(
    splats: &SplatParams<'_, f32>,
    camera: &Camera,
    options: &ProjectOptions,
) -> Projected<f32> {
    let view = View::new(camera, options);
    let mut out = Projected::culled(splats.len(), camera.width, camera.height);
    (
        out.means2d.par_chunks_mut(BLOCK),
        out.factors.par_chunks_mut(BLOCK),
        out.depths.par_chunks_mut(BLOCK),
        out.colors.par_chunks_mut(BLOCK),
        out.opacities.par_chunks_mut(BLOCK),
        out.radii.par_chunks_mut(BLOCK),
    )
        .into_par_iter()
        .enumerate()
        .for_each_init(
            ProjectBlock::new,
            |block, (number, (means2d, factors, depths, colors, opacities, radii))| {
                let first = number * BLOCK;
                block.shapes(&view, splats, first, Ids::all(means2d.len()), 1.0);
                block.colors(&view, splats.colors, first);
                for (k, splat) in block.visible() {
                    means2d[k] = splat.mean;
                    factors[k] = splat.factor;
                    depths[k] = splat.depth;
                    colors[k] = splat.color;
                    opacities[k] = splat.opacity;
                    radii[k] = splat.radii;
                }
            },
        );
    out
}
