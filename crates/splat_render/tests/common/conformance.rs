//! Conformance of an f32 implementation with the f64 reference, stage by stage and end to end. Each check
//! prints its figures.

use rand_pcg::Pcg64;
use splat_render::constants::{BLUR, FAR, NEAR};
use splat_render::reference::{Reference, band_pixels};
use splat_render::{
    Camera, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, Stages,
};

use super::*;

/// Bounds of `docs/how-it-works/numerics.md`.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Largest difference of a picture, given identical 2D splats.
    pub picture: f64,
    /// Largest difference of a gradient as a part of the largest of its kind.
    pub gradient: f64,
}

/// Settings of the project stage that every implementation is tested with.
pub const OPTIONS: [ProjectOptions; 2] = [
    ProjectOptions { near: NEAR, far: FAR, blur: BLUR, antialiased: false },
    ProjectOptions { near: NEAR, far: FAR, blur: BLUR, antialiased: true },
];

/// Largest and mean difference of a picture rendered from splats.
const END_TO_END: (f64, f64) = (1e-4, 1e-6);
/// Relative distance to the alpha threshold that counts as the band, per stage and end to end.
const BAND: (f64, f64) = (1e-4, 2e-2);

/// Pictures whose sides are and are not multiples of a tile, down to one pixel.
const SIZES: [(u32, u32); 9] =
    [(64, 64), (1, 1), (17, 33), (100, 31), (130, 7), (16, 16), (100, 75), (1, 130), (300, 5)];
/// SH degrees, or direct colors.
const DEGREES: [Option<u32>; 6] = [None, Some(0), Some(1), Some(2), Some(3), Some(4)];

/// The project stages, for every degree, with raw and activated parameters.
pub fn projecting_matches_the_reference(stages: &dyn Stages<f32>, bounds: Bounds) {
    for (k, degree) in DEGREES.into_iter().enumerate() {
        for n in [1, 150, 2500] {
            let seed = (k * 10 + n) as u64;
            let mut rng = rng(seed);
            let (width, height) = SIZES[(k + n) % SIZES.len()];
            let camera = random_camera(&mut rng, width, height);
            let mut scene = random_scene(&mut rng, n, degree);
            if n == 150 {
                scene.raw = false;
                scene.scales.as_flattened_mut().iter_mut().for_each(|s| *s = s.exp());
                scene.opacities.iter_mut().for_each(|o| *o = 1.0 / (1.0 + (-*o).exp()));
            }
            for options in OPTIONS {
                let aa = options.antialiased;
                let what = format!("{n} splats, SH {degree:?}, antialiased {aa}");
                project_stages(stages, &scene, &camera, &options, seed, bounds, &what);
            }
        }
    }
}

/// The rasterize stages, for every size of pictures and splats.
pub fn rasterizing_matches_the_reference(stages: &dyn Stages<f32>, bounds: Bounds) {
    for (k, (width, height)) in SIZES.into_iter().enumerate() {
        for (n, sigma) in [(0, 3.0), (1, 8.0), (7, 1.0), (60, 30.0), (300, 3.0)] {
            let seed = (k * 10 + n) as u64;
            let projected = random_projected(&mut rng(seed), n, width, height, sigma);
            let what = format!("{width}x{height}, {n} splats of {sigma} px");
            rasterize_stages(stages, &projected, seed, bounds, &what);
        }
    }
}

/// All four stages in turn.
pub fn rendering_matches_the_reference(stages: &dyn Stages<f32>, bounds: Bounds) {
    for (k, (width, height)) in SIZES.into_iter().enumerate() {
        for (n, degree) in [(1, None), (10, Some(3)), (200, Some(3)), (2000, Some(1))] {
            let mut rng = rng((k * 7 + n) as u64);
            let camera = random_camera(&mut rng, width, height);
            let scene = random_scene(&mut rng, n, degree);
            for options in OPTIONS {
                let aa = options.antialiased;
                let what = format!("{width}x{height}, {n} splats, SH {degree:?}, antialiased {aa}");
                end_to_end(stages, &scene, &camera, &options, &mut rng, bounds, &what);
            }
        }
    }
}

/// Pixels of `band` at which the pictures differ by more than `bound`: at most 0.1 % (or one, for under 1
/// 000 pixels).
fn left_out(got: &Image<f32>, expected: &Image<f64>, band: &[bool], bound: f64) -> Vec<bool> {
    let deepest = deepest(expected);
    let (got, expected) = (pixels(got, deepest), pixels(expected, deepest));
    let far = |i: usize| (0..6).any(|k| (got[i][k] - expected[i][k]).abs() > bound);
    let out: Vec<bool> = (0..band.len()).map(|pixel| band[pixel] && far(pixel)).collect();
    let count = out.iter().filter(|&&out| out).count();
    assert!(count <= (out.len() / 1000).max(1), "{count} of {} pixels are left out", out.len());
    out
}

/// The gradients with zeros at pixels that may differ.
fn masked(v_image: &ImageGradients<f32>, left_out: &[bool]) -> ImageGradients<f32> {
    let mut out = v_image.clone();
    for (pixel, &out_of_it) in left_out.iter().enumerate() {
        if out_of_it {
            out.v_color[pixel] = [0.0; 3];
            (out.v_alpha[pixel], out.v_depth[pixel]) = (0.0, 0.0);
        }
    }
    out
}

/// rasterize and rasterize_backward on identical 2D splats.
pub fn rasterize_stages(
    stages: &dyn Stages<f32>,
    projected: &Projected<f32>,
    seed: u64,
    bounds: Bounds,
    what: &str,
) {
    let mut rng = rng(seed);
    let background = [0.2f32, 0.5, 0.9];
    let wide = widen(projected);
    let image = stages.rasterize(projected, background).unwrap();
    let expected = Reference.rasterize(&wide, widen(&background)).unwrap();
    let left_out = left_out(&image, &expected, &band_pixels(&wide, BAND.0), bounds.picture);
    let difference = image_difference(&image, &expected, &left_out);
    println!(
        "{what}: picture max {:.1e} mean {:.1e}; {} of {} pixels left out",
        difference.max,
        difference.mean,
        left_out.iter().filter(|&&out| out).count(),
        left_out.len()
    );
    assert!(difference.max <= bounds.picture, "{what}: picture is off by {:.2e}", difference.max);
    assert!(image == stages.rasterize(projected, background).unwrap(), "{what}: picture repeats");

    let v_image = masked(&random_image_gradients(&mut rng, image.alpha.len()), &left_out);
    let run = |absolute: bool| {
        stages.rasterize_backward(projected, background, &image, &v_image, absolute).unwrap()
    };
    let v = run(true);
    assert!(v == run(true), "{what}: gradients repeat");
    let without = ProjectedGradients { v_means2d_absolute: None, ..v.clone() };
    assert!(without == run(false), "{what}: asking for absolute gradients changes the others");
    let expected = Reference
        .rasterize_backward(&wide, widen(&background), &expected, &widen(&v_image), true)
        .unwrap();
    assert_gradients(&projected_gradient_differences(&v, &expected), bounds.gradient, what);
}

/// project and project_backward on identical splats.
fn project_stages(
    stages: &dyn Stages<f32>,
    scene: &Scene<f32>,
    camera: &Camera,
    options: &ProjectOptions,
    seed: u64,
    bounds: Bounds,
    what: &str,
) {
    let mut rng = rng(seed);
    let camera = &rounded(camera);
    let got = stages.project(&scene.params(), camera, options).unwrap();
    let wide_scene = widen(scene);
    let expected = Reference.project(&wide_scene.params(), camera, options).unwrap();
    let v = random_projected_gradients(&mut rng, &narrow(&expected));
    let run = || stages.project_backward(&scene.params(), camera, options, &got, &v).unwrap();
    let gradients = run();
    // As text, because 0 equals -0.
    assert_eq!(format!("{gradients:?}"), format!("{:?}", run()), "{what}: gradients repeat");
    let expected_gradients = Reference
        .project_backward(&wide_scene.params(), camera, options, &expected, &widen(&v))
        .unwrap();
    assert_same_culled(&got, &expected, what);
    for (name, off, bound) in [
        ("means2d", difference(&got.means2d, &expected.means2d, &[]), 2e-6),
        ("factors", difference(&got.factors, &expected.factors, &[]), 1e-5),
        ("depths", difference1(&got.depths, &expected.depths, &[]), 1e-6),
        ("colors", difference(&got.colors, &expected.colors, &[]), 2e-6),
        ("opacities", difference1(&got.opacities, &expected.opacities, &[]), 1e-6),
        ("radii", difference(&got.radii, &expected.radii, &[]), 1e-4),
    ] {
        assert!(off.relative() <= bound, "{what}: {name} {off:?}");
    }
    let off = splat_gradient_differences(&gradients, &expected_gradients);
    assert_gradients(&off, bounds.gradient, what);
}

fn assert_same_culled(got: &Projected<f32>, expected: &Projected<f64>, what: &str) {
    for i in 0..expected.len() {
        let culled = expected.radii[i] == [0.0; 2];
        assert_eq!(got.radii[i] == [0.0; 2], culled, "{what}: splat {i} culled");
    }
}

/// The camera with values that f32 holds exactly, so that all implementations get the same.
fn rounded(camera: &Camera) -> Camera {
    let f = |v: f64| f64::from(v as f32);
    Camera {
        viewmat: glam::DMat4::from_cols_array(&camera.viewmat.to_cols_array().map(f)),
        fx: f(camera.fx),
        fy: f(camera.fy),
        cx: f(camera.cx),
        cy: f(camera.cy),
        ..*camera
    }
}

/// From splats to picture and back, with identical f32 inputs.
pub fn end_to_end(
    stages: &dyn Stages<f32>,
    scene: &Scene<f32>,
    camera: &Camera,
    options: &ProjectOptions,
    rng: &mut Pcg64,
    bounds: Bounds,
    what: &str,
) {
    let camera = &rounded(camera);
    let background = [0.2f32, 0.5, 0.9];
    let wide_scene = widen(scene);
    let wide_background = widen(&background);
    let expected_projected = Reference.project(&wide_scene.params(), camera, options).unwrap();
    let band = band_pixels(&expected_projected, BAND.1);
    let expected = Reference.rasterize(&expected_projected, wide_background).unwrap();

    let projected = stages.project(&scene.params(), camera, options).unwrap();
    assert_same_culled(&projected, &expected_projected, what);
    let image = stages.rasterize(&projected, background).unwrap();
    let all = image_difference(&image, &expected, &[]);
    let left_out = left_out(&image, &expected, &band, END_TO_END.0);
    let outside = image_difference(&image, &expected, &left_out);
    let count = left_out.iter().filter(|&&out| out).count();
    println!(
        "{what}: picture max {:.1e} mean {:.1e}; {count} of {} pixels left out (max with them {:.1e})",
        outside.max,
        outside.mean,
        band.len(),
        all.max
    );
    assert!(outside.max <= END_TO_END.0, "{what}: picture is off by {:.2e}", outside.max);
    assert!(outside.mean <= END_TO_END.1, "{what}: mean is off by {:.2e}", outside.mean);

    let v_image = masked(&random_image_gradients(rng, image.alpha.len()), &left_out);
    let v = stages.rasterize_backward(&projected, background, &image, &v_image, false).unwrap();
    let gradients =
        stages.project_backward(&scene.params(), camera, options, &projected, &v).unwrap();
    let expected_v = Reference
        .rasterize_backward(
            &expected_projected,
            wide_background,
            &expected,
            &widen(&v_image),
            false,
        )
        .unwrap();
    let expected_gradients = Reference
        .project_backward(&wide_scene.params(), camera, options, &expected_projected, &expected_v)
        .unwrap();
    let off = splat_gradient_differences(&gradients, &expected_gradients);
    assert_gradients(&off, bounds.gradient, what);
}
