//! Seeded random scenes, f32/f64 conversions and comparators, shared by the tests of all backends.
#![allow(dead_code)] // Each test binary uses its own part.

/// Declares the tests of the checks that need no comparison with the reference, which must pass them,
/// too. `$values` and `$orders` are numbers of random cases.
#[allow(unused_macros)]
macro_rules! checks_of_all {
    ($stages:expr; $values:expr, $orders:expr) => {
        checks! {
            $stages;
            hard_cases::no_splats_give_the_background();
            hard_cases::an_invalid_number_culls_one_splat_at_most();
            hard_cases::a_zero_quaternion_culls_its_splat();
            hard_cases::culled_splats_change_nothing();
            hard_cases::a_far_away_scene_renders_as_one_at_the_origin();
            properties::any_values_give_finite_results($values);
            properties::the_order_of_splats_does_not_matter($orders);
            optimization::exposure_matches_the_reference();
            optimization::depth_loss_matches_the_reference();
            optimization::frozen_splats_keep_their_moments();
            agreement::invalid_2d_splats_are_not_drawn();
            agreement::a_near_plane_of_zero_draws_what_is_before_the_camera();
            agreement::invalid_options_are_refused();
        }
    };
}

/// Declares a test of each check, run on each of `$stages`.
#[allow(unused_macros)]
macro_rules! checks {
    ($stages:expr; $($module:ident::$check:ident($($argument:expr),*);)*) => {
        $(#[test]
        fn $check() {
            for stages in $stages {
                common::$module::$check(stages, $($argument),*);
            }
        })*
    };
}

pub mod agreement;
pub mod conformance;
mod convert;
pub mod hard_cases;
pub mod narrowed;
pub mod optimization;
pub mod properties;
pub mod waiting;

pub use convert::*;
use glam::{DMat3, DMat4, DQuat, DVec3};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;
use splat_render::constants::BLUR;
use splat_render::fit::{Rates, Target};
use splat_render::gpu::Gpu;
use splat_render::splats::SplatArrays;
use splat_render::stages::{Colors, Float, Image, ImageGradients, Projected, ProjectedGradients};
use splat_render::{Camera, ProjectOptions, SplatGradients, SplatParams, Stages};

/// A seeded generator.
pub fn rng(seed: u64) -> Pcg64 {
    Pcg64::seed_from_u64(seed)
}

/// Any adapter, software ones included; if there is none, the test fails with the error's sentence.
/// `make test-long` runs the stages' tests with each build of the kernels: `IGSR_TEST_GPU` is `discrete`
/// or `no-subgroups`.
pub fn gpu() -> Gpu {
    let gpu = Gpu::new(true).unwrap_or_else(|e| panic!("{e}"));
    match std::env::var("IGSR_TEST_GPU").as_deref() {
        Err(_) => gpu,
        Ok("discrete") => gpu.as_discrete(),
        Ok("no-subgroups") => gpu.without_subgroups(),
        Ok(other) => panic!("IGSR_TEST_GPU is {other}, not discrete or no-subgroups"),
    }
}

/// Runs work on a number of threads.
pub fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// A standard normal draw (Box-Muller).
pub fn normal(rng: &mut Pcg64) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// Splat parameters that own their arrays.
#[derive(Debug, Clone, Default)]
pub struct Scene<T> {
    pub means: Vec<[T; 3]>,
    pub quats: Vec<[T; 4]>,
    pub scales: Vec<[T; 3]>,
    pub opacities: Vec<T>,
    /// `[N * sh_stride]`, or `[N]` direct colors if `sh_stride` is 0.
    pub colors: Vec<[T; 3]>,
    pub sh_degree: u32,
    pub sh_stride: usize,
    pub raw: bool,
}

impl<T> Scene<T> {
    pub fn params(&self) -> SplatParams<'_, T> {
        SplatParams {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
            colors: if self.sh_stride == 0 {
                Colors::Direct(&self.colors)
            } else {
                Colors::Sh { degree: self.sh_degree, stride: self.sh_stride, coeffs: &self.colors }
            },
            raw: self.raw,
        }
    }
}

/// Rates of a fit's steps.
pub const RATES: Rates =
    Rates { means: 1e-3, quats: 1e-3, scales: 5e-3, opacities: 5e-2, sh0: 5e-3, sh_rest: 2.5e-4 };

impl Scene<f32> {
    /// The splats of a fit.
    pub fn arrays(self) -> SplatArrays {
        SplatArrays {
            means: self.means,
            quats: self.quats,
            scales: self.scales,
            opacities: self.opacities,
            sh: self.colors,
            sh_degree: self.sh_degree,
        }
    }
}

/// The photo that shows a picture on black, with or without alpha.
pub fn photo<T: Copy + Into<f64>>(image: &Image<T>, has_alpha: bool) -> Target {
    let byte = |v: f64| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let pixel = |(color, &alpha): (&[T; 3], &T)| {
        let alpha: f64 = alpha.into();
        let over = if has_alpha { alpha.max(1e-6) } else { 1.0 };
        let mut bytes = color.map(|c| byte(c.into() / over)).to_vec();
        bytes.extend(has_alpha.then_some(byte(alpha)));
        bytes
    };
    let bytes = image.color.iter().zip(&image.alpha).flat_map(pixel).collect();
    Target::new(image.width, image.height, if has_alpha { 4 } else { 3 }, bytes)
}

/// The picture of splats.
pub fn render<T: Float>(
    stages: &dyn Stages<T>,
    splats: &SplatParams<'_, T>,
    camera: &Camera,
    background: [T; 3],
) -> Image<T> {
    let projected = stages.project(splats, camera, &ProjectOptions::default()).unwrap();
    stages.rasterize(&projected, background).unwrap()
}

/// Results of the four stages.
#[derive(Debug, PartialEq)]
pub struct Pass {
    pub projected: Projected<f32>,
    pub image: Image<f32>,
    pub v_projected: ProjectedGradients<f32>,
    pub v_splats: SplatGradients<f32>,
}

/// Runs the four stages; the picture's gradients are those of a loss, or random from a seed.
pub fn pass(
    stages: &dyn Stages<f32>,
    scene: &Scene<f32>,
    camera: &Camera,
    options: &ProjectOptions,
    seed: Option<u64>,
) -> Pass {
    let background = [0.3, 0.2, 0.1];
    let projected = stages.project(&scene.params(), camera, options).unwrap();
    let image = stages.rasterize(&projected, background).unwrap();
    let v_image = match seed {
        Some(seed) => random_image_gradients(&mut rng(seed), image.alpha.len()),
        None => ImageGradients {
            v_color: image.color.iter().map(|c| c.map(|v| v - 0.5)).collect(),
            v_alpha: image.alpha.clone(),
            v_depth: image.depth.clone(),
        },
    };
    let v_projected =
        stages.rasterize_backward(&projected, background, &image, &v_image, true).unwrap();
    let v_splats = stages
        .project_backward(&scene.params(), camera, options, &projected, &v_projected)
        .unwrap();
    Pass { projected, image, v_projected, v_splats }
}

/// A camera 4 units from the world's origin, looking at it from a random side, with its principal
/// point off the center.
pub fn random_camera(rng: &mut Pcg64, width: u32, height: u32) -> Camera {
    let axis = DVec3::new(normal(rng), normal(rng), normal(rng)).normalize();
    let rotation =
        DMat3::from_quat(DQuat::from_axis_angle(axis, rng.random_range(0.0..std::f64::consts::PI)));
    let translation = DVec3::new(0.2 * normal(rng), 0.2 * normal(rng), 4.0);
    let mut viewmat = DMat4::from_mat3(rotation);
    viewmat.w_axis = translation.extend(1.0);
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w.max(h) * rng.random_range(0.7..1.3);
    Camera {
        viewmat,
        fx: focal,
        fy: focal * rng.random_range(0.9..1.1),
        cx: w * rng.random_range(0.4..0.6),
        cy: h * rng.random_range(0.4..0.6),
        width,
        height,
    }
}

/// N splats around the world's origin, most of them in view of [`random_camera`]. `sh_degree`
/// None gives direct colors. Parameters are raw (log-scales, opacity logits).
pub fn random_scene(rng: &mut Pcg64, n: usize, sh_degree: Option<u32>) -> Scene<f32> {
    let mut scene = Scene::<f32> { raw: true, ..Scene::default() };
    if let Some(degree) = sh_degree {
        scene.sh_degree = degree;
        scene.sh_stride = (degree as usize + 1).pow(2);
    }
    // Sizes shrink with the count, so that pictures stay layered but not opaque at once.
    let size = (0.5 / (n.max(1) as f64).cbrt()).ln();
    for _ in 0..n {
        scene.means.push(std::array::from_fn(|_| (0.8 * normal(rng)) as f32));
        scene.quats.push(std::array::from_fn(|_| normal(rng) as f32));
        scene.scales.push(std::array::from_fn(|_| (size + 0.7 * normal(rng)) as f32));
        scene.opacities.push((1.5 * normal(rng)) as f32);
        if sh_degree.is_some() {
            for k in 0..scene.sh_stride {
                let spread = if k == 0 { 1.0 } else { 0.3 };
                scene.colors.push(std::array::from_fn(|_| (spread * normal(rng)) as f32));
            }
        } else {
            scene.colors.push(std::array::from_fn(|_| rng.random::<f32>()));
        }
    }
    scene
}

/// N 2D splats uniform over the image: standard deviations exp(N(ln `sigma`, 0.6)) px per axis at
/// a uniform angle plus the blur, opacities U(0.1, 0.9). With `sigma` 3, 400 x 400 and 20 000
/// splats this is the benchmark's workload W1.
pub fn random_projected(
    rng: &mut Pcg64,
    n: usize,
    width: u32,
    height: u32,
    sigma: f64,
) -> Projected<f32> {
    let mut out = Projected::<f32>::culled(n, width, height);
    for i in 0..n {
        let center = [
            rng.random_range(0.0..f64::from(width)) as f32,
            rng.random_range(0.0..f64::from(height)) as f32,
        ];
        let deviations = [(); 2].map(|()| (sigma.ln() + 0.6 * normal(rng)).exp());
        let angle = rng.random_range(0.0..std::f64::consts::PI);
        let opacity = rng.random_range(0.1f32..0.9);
        place(&mut out, i, center, deviations, angle, opacity);
        out.depths[i] = rng.random_range(1.0f32..10.0);
        out.colors[i] = std::array::from_fn(|_| rng.random::<f32>());
    }
    out
}

/// All numbers of a 2D splat.
pub fn splat_2d(
    p: &Projected<f32>,
    i: usize,
) -> ([f32; 2], [f32; 3], f32, [f32; 3], f32, [f32; 2]) {
    (p.means2d[i], p.factors[i], p.depths[i], p.colors[i], p.opacities[i], p.radii[i])
}

/// All gradients of a splat.
type OfSplat<'a> = ([f32; 3], [f32; 4], [f32; 3], f32, &'a [[f32; 3]]);

/// Gradients of a splat with `stride` rows of colors.
pub fn splat_gradients(v: &SplatGradients<f32>, i: usize, stride: usize) -> OfSplat<'_> {
    let colors = &v.v_colors[stride * i..stride * (i + 1)];
    (v.v_means[i], v.v_quats[i], v.v_scales[i], v.v_opacities[i], colors)
}

/// Whether all gradients are finite.
pub fn all_finite(v: &SplatGradients<f32>) -> bool {
    v.v_means.iter().chain(&v.v_scales).chain(&v.v_colors).flatten().all(|v| v.is_finite())
        && v.v_quats.iter().flatten().chain(&v.v_opacities).all(|v| v.is_finite())
        && v.v_viewmat.iter().flatten().chain(&v.v_intrinsics).all(|v| v.is_finite())
}

/// Gives splat `i` a 2D Gaussian (standard deviations in px before the blur) and its extent.
pub fn place(
    out: &mut Projected<f32>,
    i: usize,
    center: [f32; 2],
    deviations: [f64; 2],
    angle: f64,
    opacity: f32,
) {
    let (s, c) = angle.sin_cos();
    let [a, b] = deviations.map(|d| d * d);
    let blur = f64::from(BLUR);
    let (xx, yy) = (c * c * a + s * s * b + blur, s * s * a + c * c * b + blur);
    let xy = c * s * (a - b);
    let det = (a + blur) * (b + blur);
    let p = (yy / det).sqrt();
    let reach = 2.0 * (255.0 * f64::from(opacity)).ln();
    out.means2d[i] = center;
    out.factors[i] = [p as f32, (-xy / yy * p) as f32, yy.sqrt().recip() as f32];
    out.opacities[i] = opacity;
    out.depths[i] = 1.0;
    if reach > 0.0 {
        out.radii[i] = [(reach * xx).sqrt() as f32, (reach * yy).sqrt() as f32];
    }
}

/// Random gradients of a picture: N(0, 1) colors, smaller alpha and depth parts.
pub fn random_image_gradients(rng: &mut Pcg64, pixels: usize) -> ImageGradients<f32> {
    ImageGradients {
        v_color: (0..pixels).map(|_| std::array::from_fn(|_| normal(rng) as f32)).collect(),
        v_alpha: (0..pixels).map(|_| 0.5 * normal(rng) as f32).collect(),
        v_depth: (0..pixels).map(|_| 0.1 * normal(rng) as f32).collect(),
    }
}

/// Random gradients of N projected splats, zero for culled ones.
pub fn random_projected_gradients(
    rng: &mut Pcg64,
    projected: &Projected<f32>,
) -> ProjectedGradients<f32> {
    let mut out = ProjectedGradients::<f32>::zeros(projected.len());
    for i in 0..projected.len() {
        if projected.radii[i] == [0.0; 2] {
            continue;
        }
        out.v_means2d[i] = std::array::from_fn(|_| normal(rng) as f32);
        out.v_factors[i] = std::array::from_fn(|_| 0.1 * normal(rng) as f32);
        out.v_depths[i] = normal(rng) as f32;
        out.v_colors[i] = std::array::from_fn(|_| normal(rng) as f32);
        out.v_opacities[i] = normal(rng) as f32;
    }
    out
}

/// How far two arrays are apart.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Difference {
    /// Largest absolute difference; NaN in either array makes it infinite.
    pub max: f64,
    /// Mean absolute difference.
    pub mean: f64,
    /// Largest magnitude in the expected array.
    pub scale: f64,
    /// Elements compared.
    pub count: usize,
}

impl Difference {
    /// Largest difference relative to the largest expected value (0 if both vanish).
    pub fn relative(&self) -> f64 {
        if self.max == 0.0 { 0.0 } else { self.max / self.scale }
    }
}

/// Compares rows; rows with `skip` are left out (an empty `skip` leaves out none).
pub fn difference<A: Copy + Into<f64>, const K: usize>(
    got: &[[A; K]],
    expected: &[[f64; K]],
    skip: &[bool],
) -> Difference {
    assert_eq!(got.len(), expected.len(), "arrays of different lengths");
    let mut out = Difference::default();
    let mut total = 0.0;
    for (row, (g, e)) in got.iter().zip(expected).enumerate() {
        if skip.get(row).copied().unwrap_or(false) {
            continue;
        }
        for (g, e) in g.iter().zip(e) {
            let off = ((*g).into() - e).abs();
            let off = if off.is_nan() { f64::INFINITY } else { off };
            out.max = out.max.max(off);
            out.scale = out.scale.max(e.abs());
            total += off;
            out.count += 1;
        }
    }
    out.mean = if out.count == 0 { 0.0 } else { total / out.count as f64 };
    out
}

/// [`difference`] of scalars.
pub fn difference1<A: Copy + Into<f64>>(got: &[A], expected: &[f64], skip: &[bool]) -> Difference {
    difference(got.as_chunks::<1>().0, expected.as_chunks::<1>().0, skip)
}

/// Color, alpha, transmittance, and depth as a part of `deepest`, of each pixel.
pub fn pixels<T: Copy + Into<f64>>(image: &Image<T>, deepest: f64) -> Vec<[f64; 6]> {
    let pixel = |i: usize| {
        let [r, g, b] = image.color[i].map(T::into);
        let [alpha, depth] = [image.alpha[i], image.depth[i]].map(T::into);
        [r, g, b, alpha, image.transmittance[i].into(), depth / deepest]
    };
    (0..image.alpha.len()).map(pixel).collect()
}

/// The largest depth, at least 1.
pub fn deepest(image: &Image<f64>) -> f64 {
    image.depth.iter().fold(1.0, |deepest, depth| depth.abs().max(deepest))
}

/// Difference of two pictures, pixels in `band` left out.
pub fn image_difference(got: &Image<f32>, expected: &Image<f64>, band: &[bool]) -> Difference {
    assert_eq!((got.width, got.height), (expected.width, expected.height));
    let deepest = deepest(expected);
    difference(&pixels(got, deepest), &pixels(expected, deepest), band)
}

/// Gradients of the 2D splats, kind by kind.
pub fn projected_gradient_differences(
    got: &ProjectedGradients<f32>,
    expected: &ProjectedGradients<f64>,
) -> Vec<(&'static str, Difference)> {
    vec![
        ("v_means2d", difference(&got.v_means2d, &expected.v_means2d, &[])),
        ("v_factors", difference(&got.v_factors, &expected.v_factors, &[])),
        (
            "v_means2d_absolute",
            difference(
                got.v_means2d_absolute.as_deref().unwrap_or_default(),
                expected.v_means2d_absolute.as_deref().unwrap_or_default(),
                &[],
            ),
        ),
        ("v_depths", difference1(&got.v_depths, &expected.v_depths, &[])),
        ("v_colors", difference(&got.v_colors, &expected.v_colors, &[])),
        ("v_opacities", difference1(&got.v_opacities, &expected.v_opacities, &[])),
        ("v_background", difference(&[got.v_background], &[expected.v_background], &[])),
    ]
}

/// Gradients of the splats and the camera, kind by kind.
pub fn splat_gradient_differences(
    got: &SplatGradients<f32>,
    expected: &SplatGradients<f64>,
) -> Vec<(&'static str, Difference)> {
    let focal = (&got.v_intrinsics[..2], &expected.v_intrinsics[..2]);
    let center = (&got.v_intrinsics[2..], &expected.v_intrinsics[2..]);
    vec![
        ("v_means", difference(&got.v_means, &expected.v_means, &[])),
        ("v_quats", difference(&got.v_quats, &expected.v_quats, &[])),
        ("v_scales", difference(&got.v_scales, &expected.v_scales, &[])),
        ("v_opacities", difference1(&got.v_opacities, &expected.v_opacities, &[])),
        ("v_colors", difference(&got.v_colors, &expected.v_colors, &[])),
        (
            "v_viewmat",
            difference1(got.v_viewmat.as_flattened(), expected.v_viewmat.as_flattened(), &[]),
        ),
        ("v_fx_fy", difference1(focal.0, focal.1, &[])),
        ("v_cx_cy", difference1(center.0, center.1, &[])),
    ]
}

/// Prints each kind's largest difference, and asserts it to be at most `bound` of its largest value.
pub fn assert_gradients(differences: &[(&'static str, Difference)], bound: f64, what: &str) {
    for (name, difference) in differences {
        println!("{what}: {name} {:.1e} of the largest", difference.relative());
        assert!(
            difference.relative() <= bound,
            "{what}: {name} is off by {:.2e} of its largest value {:.2e}, more than {bound:.0e}",
            difference.relative(),
            difference.scale
        );
    }
}
