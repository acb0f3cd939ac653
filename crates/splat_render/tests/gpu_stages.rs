//! The WGSL stages against the f64 reference, stage by stage and end to end.

mod common;

use std::sync::OnceLock;

use common::*;
use rand::Rng;
use splat_render::gpu::Gpu;
use splat_render::reference::{Reference, band_pixels};
use splat_render::stages::{ImageGradients, Projected, ProjectedGradients};
use splat_render::{ProjectOptions, Stages};

/// Any adapter will do, lavapipe included; none at all fails the test with the error's sentence.
fn gpu() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new(true).unwrap_or_else(|e| panic!("{e}")))
}

const SIZES: [(u32, u32); 7] =
    [(1, 1), (17, 33), (16, 16), (64, 48), (100, 75), (1, 130), (300, 5)];

#[test]
fn projects_like_the_reference() {
    let mut rng = rng(1);
    for (round, (width, height)) in SIZES.into_iter().cycle().take(40).enumerate() {
        let n = rng.random_range(1..200);
        let degree = [None, Some(0), Some(1), Some(2), Some(3), Some(4)][round % 6];
        let mut scene = random_scene(&mut rng, n, degree);
        if round % 3 == 0 {
            // The same splats with activated parameters.
            scene.raw = false;
            for scale in scene.scales.as_flattened_mut() {
                *scale = scale.exp();
            }
            for opacity in &mut scene.opacities {
                *opacity = 1.0 / (1.0 + (-*opacity).exp());
            }
        }
        let camera = random_camera(&mut rng, width, height);
        let options = ProjectOptions::default();
        let got = gpu().project(&scene.params(), &camera, &options).unwrap();
        let wide = scene.widen();
        let expected = Reference.project(&wide.params(), &camera, &options).unwrap();
        for i in 0..n {
            let culled = expected.radii[i] == [0.0; 2];
            assert_eq!(got.radii[i] == [0.0; 2], culled, "round {round}, splat {i}");
        }
        let within = |what: &str, off: Difference, bound: f64| {
            assert!(off.relative() <= bound, "round {round}: {what} {off:?}");
        };
        within("means2d", difference(&got.means2d, &expected.means2d, &[]), 2e-6);
        within("factors", difference(&got.factors, &expected.factors, &[]), 1e-5);
        within("covars2d", difference(&got.covars2d, &expected.covars2d, &[]), 1e-5);
        within("depths", difference1(&got.depths, &expected.depths, &[]), 1e-6);
        within("colors", difference(&got.colors, &expected.colors, &[]), 2e-6);
        within("opacities", difference1(&got.opacities, &expected.opacities, &[]), 1e-6);
        within("radii", difference(&got.radii, &expected.radii, &[]), 1e-4);
    }
}

fn rasterize_cases() -> Vec<Projected<f32>> {
    let mut rng = rng(2);
    let mut cases = Vec::new();
    for (round, (width, height)) in SIZES.into_iter().cycle().take(28).enumerate() {
        let n = [0, 1, 7, 60, 300][round % 5];
        cases.push(random_projected(&mut rng, n, width, height, [1.0, 3.0, 10.0][round % 3]));
    }
    // All at one depth: the index decides.
    let mut equal = random_projected(&mut rng, 200, 40, 40, 4.0);
    equal.depths.fill(2.0);
    cases.push(equal);
    // Everything culled.
    let mut culled = random_projected(&mut rng, 50, 33, 20, 3.0);
    culled.radii.fill([0.0; 2]);
    cases.push(culled);
    // Centres far outside, reaching in; and one that covers all tiles.
    let mut outside = random_projected(&mut rng, 40, 120, 90, 60.0);
    for mean in &mut outside.means2d {
        mean[0] -= 150.0;
    }
    place(&mut outside, 0, [60.0, 45.0], [500.0, 400.0], 0.3, 0.9);
    cases.push(outside);
    // Opaque layers: early stop and the cap.
    let mut opaque = random_projected(&mut rng, 1000, 20, 20, 8.0);
    opaque.opacities.fill(1.0);
    for i in 0..1000 {
        place(&mut opaque, i, [10.0, 10.0], [9.0, 7.0], 0.5, 1.0);
        opaque.depths[i] = 1.0 + i as f32;
    }
    cases.push(opaque);
    // Needles.
    let mut needles = random_projected(&mut rng, 100, 100, 80, 1.0);
    for i in 0..100 {
        let center = needles.means2d[i];
        let angle = rng.random_range(0.0..std::f64::consts::PI);
        place(&mut needles, i, center, [1e4, 1e-2], angle, 0.8);
        needles.depths[i] = i as f32 + 1.0;
    }
    cases.push(needles);
    cases
}

#[test]
fn rasterizes_like_the_reference() {
    let (mut worst, mut skipped) = (0.0f64, 0);
    for (case, projected) in rasterize_cases().iter().enumerate() {
        let background = [0.2f32, 0.5, 0.9];
        let got = gpu().rasterize(projected, background).unwrap();
        let wide = widen_projected(projected);
        let expected = Reference.rasterize(&wide, background.map(f64::from)).unwrap();
        let band = band_pixels(&wide, 1e-4);
        let off = image_difference(&got, &expected, &band);
        assert!(off.max <= 2e-5, "case {case}: {off:?}");
        worst = worst.max(off.max);
        skipped += band.iter().filter(|&&b| b).count();
        assert_eq!(got, gpu().rasterize(projected, background).unwrap(), "case {case} repeats");
    }
    println!("rasterize: {worst:.2e} at most, {skipped} pixels in the band");
}

#[test]
fn rasterizes_backward_like_the_reference() {
    let mut rng = rng(3);
    let mut worst = 0.0f64;
    for (case, projected) in rasterize_cases().iter().enumerate() {
        let background = [0.2f32, 0.5, 0.9];
        let wide = widen_projected(projected);
        let band = band_pixels(&wide, 1e-4);
        let mut v_image = random_image_gradients(&mut rng, band.len());
        // Pixels that may rightly differ carry no gradient.
        for (pixel, &in_band) in band.iter().enumerate() {
            if in_band {
                v_image.v_color[pixel] = [0.0; 3];
                v_image.v_alpha[pixel] = 0.0;
                v_image.v_depth[pixel] = 0.0;
            }
        }
        let run = || {
            let image = gpu().rasterize(projected, background).unwrap();
            gpu().rasterize_backward(projected, background, &image, &v_image).unwrap()
        };
        let got = run();
        let image = Reference.rasterize(&wide, background.map(f64::from)).unwrap();
        let expected = Reference
            .rasterize_backward(
                &wide,
                background.map(f64::from),
                &image,
                &widen_image_gradients(&v_image),
            )
            .unwrap();
        let differences = projected_gradient_differences(&got, &expected);
        assert_gradients(&differences, 1e-3, &format!("case {case}"));
        worst = differences.iter().fold(worst, |w, (_, d)| w.max(d.relative()));
        assert_eq!(got, run(), "case {case} repeats");
    }
    println!("rasterize_backward: {worst:.2e} of the largest at most");
}

#[test]
fn projects_backward_like_the_reference() {
    let mut rng = rng(4);
    let mut worst = 0.0f64;
    for (round, (width, height)) in SIZES.into_iter().cycle().take(36).enumerate() {
        let n = rng.random_range(1..200);
        let degree = [None, Some(0), Some(1), Some(2), Some(3), Some(4)][round % 6];
        let scene = random_scene(&mut rng, n, degree);
        let camera = random_camera(&mut rng, width, height);
        let options = ProjectOptions::default();
        let wide = scene.widen();
        let expected2d = Reference.project(&wide.params(), &camera, &options).unwrap();
        let projected = narrow_projected(&expected2d);
        let v = random_projected_gradients(&mut rng, &projected);
        let run =
            || gpu().project_backward(&scene.params(), &camera, &options, &projected, &v).unwrap();
        let got = run();
        let expected = Reference
            .project_backward(
                &wide.params(),
                &camera,
                &options,
                &expected2d,
                &widen_projected_gradients(&v),
            )
            .unwrap();
        let differences = splat_gradient_differences(&got, &expected);
        assert_gradients(&differences, 1e-3, &format!("round {round}"));
        worst = differences.iter().fold(worst, |w, (_, d)| w.max(d.relative()));
        assert_eq!(splat_gradient_bits(&got), splat_gradient_bits(&run()), "round {round}");
    }
    println!("project_backward: {worst:.2e} of the largest at most");
}

#[test]
fn renders_end_to_end_like_the_reference() {
    let mut rng = rng(5);
    let (mut worst, mut mean, mut worst_gradient) = (0.0f64, 0.0f64, 0.0f64);
    for (round, (width, height)) in SIZES.into_iter().cycle().take(28).enumerate() {
        let n = [1, 10, 100, 400][round % 4];
        let scene = random_scene(&mut rng, n, Some(3));
        let camera = random_camera(&mut rng, width, height);
        let options = ProjectOptions::default();
        let background = [0.1f32, 0.7, 0.4];
        let projected = gpu().project(&scene.params(), &camera, &options).unwrap();
        let got = gpu().rasterize(&projected, background).unwrap();

        let wide = scene.widen();
        let expected2d = Reference.project(&wide.params(), &camera, &options).unwrap();
        let expected = Reference.rasterize(&expected2d, background.map(f64::from)).unwrap();
        let band = band_pixels(&expected2d, 2e-2);
        let off = image_difference(&got, &expected, &band);
        assert!(off.max <= 1e-4 && off.mean <= 1e-6, "round {round}: {off:?}");
        worst = worst.max(off.max);
        mean = mean.max(off.mean);

        let mut v_image = random_image_gradients(&mut rng, band.len());
        for (pixel, &in_band) in band.iter().enumerate() {
            if in_band {
                v_image.v_color[pixel] = [0.0; 3];
                v_image.v_alpha[pixel] = 0.0;
                v_image.v_depth[pixel] = 0.0;
            }
        }
        let v2d = gpu().rasterize_backward(&projected, background, &got, &v_image).unwrap();
        let v =
            gpu().project_backward(&scene.params(), &camera, &options, &projected, &v2d).unwrap();
        let expected_v2d = Reference
            .rasterize_backward(
                &expected2d,
                background.map(f64::from),
                &expected,
                &widen_image_gradients(&v_image),
            )
            .unwrap();
        let expected_v = Reference
            .project_backward(&wide.params(), &camera, &options, &expected2d, &expected_v2d)
            .unwrap();
        let differences = splat_gradient_differences(&v, &expected_v);
        assert_gradients(&differences, 1e-3, &format!("round {round}"));
        worst_gradient = differences.iter().fold(worst_gradient, |w, (_, d)| w.max(d.relative()));
    }
    println!(
        "end to end: picture {worst:.2e} max, {mean:.2e} mean; gradients {worst_gradient:.2e}"
    );
}

#[test]
fn parts_of_the_work_give_the_same_bits() {
    let mut rng = rng(6);
    let scene = random_scene(&mut rng, 3000, Some(4));
    let camera = random_camera(&mut rng, 150, 90);
    let options = ProjectOptions::default();
    let run = |gpu: &Gpu| {
        let projected = gpu.project(&scene.params(), &camera, &options).unwrap();
        let image = gpu.rasterize(&projected, [0.3, 0.2, 0.1]).unwrap();
        let v_image = ImageGradients {
            v_color: image.color.iter().map(|c| c.map(|v| v - 0.5)).collect(),
            v_alpha: image.alpha.clone(),
            v_depth: image.depth.clone(),
        };
        let v2d = gpu.rasterize_backward(&projected, [0.3, 0.2, 0.1], &image, &v_image).unwrap();
        let v = gpu.project_backward(&scene.params(), &camera, &options, &projected, &v2d).unwrap();
        (projected, image, v2d, splat_gradient_bits(&v))
    };
    // What the picture itself needs; it holds the colours of 704 splats and the gradient slots of
    // 5 400 pairs.
    let whole = run(gpu());
    let parts = run(&Gpu::new(true).unwrap().with_binding_limit(216_000));
    assert!(whole == parts, "a lower binding limit changed the result");
}

#[test]
fn many_splats_in_one_tile_and_a_wide_picture() {
    let mut rng = rng(11);
    // 70 000 splats over the left of the tile, then 300 over its right: a list that is cut off
    // anywhere (some drivers stop loops after 65 535 rounds) loses those.
    let n = 70_300;
    let mut crowd = Projected::<f32>::culled(n, 16, 16);
    for i in 0..n {
        let left = if i < 70_000 { 0.0 } else { 10.0 };
        let center = [left + rng.random_range(0.0f32..4.0), rng.random_range(0.0f32..16.0)];
        place(&mut crowd, i, center, [0.5, 0.5], 0.0, 0.3);
        crowd.depths[i] = if i < 70_000 { 1.0 } else { 2.0 };
        crowd.colors[i] = std::array::from_fn(|_| rng.random::<f32>());
    }
    let image = gpu().rasterize(&crowd, [0.0; 3]).unwrap();
    let expected = Reference.rasterize(&widen_projected(&crowd), [0.0; 3]).unwrap();
    let band = band_pixels(&widen_projected(&crowd), 1e-4);
    let off = image_difference(&image, &expected, &band);
    assert!(off.max <= 2e-5, "{off:?}");

    let v_image = random_image_gradients(&mut rng, 256);
    let v = gpu().rasterize_backward(&crowd, [0.0; 3], &image, &v_image).unwrap();
    let expected = Reference
        .rasterize_backward(
            &widen_projected(&crowd),
            [0.0; 3],
            &expected,
            &widen_image_gradients(&v_image),
        )
        .unwrap();
    // The right side's splats alone: the left side's early stop may come one splat apart.
    let tail = |v: &[[f32; 3]]| v[70_000..].to_vec();
    let off = difference(&tail(&v.v_colors), &expected.v_colors[70_000..], &[]);
    assert!(off.relative() <= 1e-3, "{off:?}");
    let off = difference(&tail(&v.v_covars2d), &expected.v_covars2d[70_000..], &[]);
    assert!(off.relative() <= 1e-3, "{off:?}");

    // One splat on 16 384 tiles.
    let mut huge = Projected::<f32>::culled(1, 2048, 2048);
    place(&mut huge, 0, [1000.0, 1040.0], [900.0, 700.0], 0.4, 0.7);
    huge.colors[0] = [0.3, 0.6, 0.9];
    let image = gpu().rasterize(&huge, [1.0; 3]).unwrap();
    let v_image = random_image_gradients(&mut rng, 2048 * 2048);
    let v = gpu().rasterize_backward(&huge, [1.0; 3], &image, &v_image).unwrap();
    let wide = widen_projected(&huge);
    let expected = Reference.rasterize(&wide, [1.0; 3]).unwrap();
    let off = image_difference(&image, &expected, &band_pixels(&wide, 1e-4));
    assert!(off.max <= 2e-5, "{off:?}");
    let expected = Reference
        .rasterize_backward(&wide, [1.0; 3], &expected, &widen_image_gradients(&v_image))
        .unwrap();
    assert_gradients(&projected_gradient_differences(&v, &expected), 1e-3, "one on all tiles");

    let mut wide = random_projected(&mut rng, 300, 16_384, 2, 6.0);
    place(&mut wide, 0, [8000.0, 1.0], [9000.0, 2.0], 0.0, 0.5);
    let image = gpu().rasterize(&wide, [1.0; 3]).unwrap();
    let expected = Reference.rasterize(&widen_projected(&wide), [1.0; 3]).unwrap();
    let band = band_pixels(&widen_projected(&wide), 1e-4);
    let off = image_difference(&image, &expected, &band);
    assert!(off.max <= 2e-5, "{off:?}");
}

#[test]
fn software_adapters_are_used_only_when_allowed() {
    match Gpu::new(false) {
        Ok(gpu) => assert!(!gpu.is_software(), "{}", gpu.name()),
        Err(error) => assert!(error.to_string().contains("backend cpu"), "{error}"),
    }
}

#[test]
fn bad_arguments_are_named() {
    let mut projected = random_projected(&mut rng(12), 5, 20, 20, 2.0);
    projected.depths.pop();
    let error = gpu().rasterize(&projected, [0.0; 3]).unwrap_err().to_string();
    assert!(error.starts_with("depths: "), "{error}");
    let projected = Projected::<f32>::culled(0, 0, 5);
    let error = gpu().rasterize(&projected, [0.0; 3]).unwrap_err().to_string();
    assert!(error.starts_with("width, height: "), "{error}");
}

#[test]
fn hard_scenes_agree_with_the_reference() {
    common::hard_cases::hard_scenes_agree_with_the_reference(gpu(), 1e-3);
}

#[test]
fn no_splats_give_the_background() {
    common::hard_cases::no_splats_give_the_background(gpu());
}

#[test]
fn poison_in_any_slot_culls_one_splat_at_most() {
    common::hard_cases::poison_in_any_slot_culls_one_splat_at_most(gpu());
}
