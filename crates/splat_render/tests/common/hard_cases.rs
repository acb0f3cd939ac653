//! Hard cases that every f32 implementation must get through.

use rand::Rng;
use splat_render::reference::{Reference, band_pixels};
use splat_render::stages::{Projected, ProjectedGradients};
use splat_render::{ProjectOptions, Stages};

use super::conformance::{Bounds, rasterize_stages};
use super::*;

/// Hard scenes of the design's table, by name, seen by a camera at the origin that looks along z.
fn hard_scenes() -> Vec<(&'static str, Scene<f32>)> {
    let mut rng = rng(20);
    let mut out = Vec::new();
    let mut base = |n: usize| {
        let mut scene = random_scene(&mut rng, n, Some(2));
        for mean in &mut scene.means {
            mean[2] += 4.0;
        }
        (scene, [(); 3].map(|()| rng.random::<f64>()))
    };
    let (mut scales, _) = base(80);
    for (i, scale) in scales.scales.as_flattened_mut().iter_mut().enumerate() {
        *scale = -30.0 + 45.0 * ((i * 7919) % 240) as f32 / 239.0;
    }
    out.push(("log-scales -30 to 15", scales));
    let (mut needles, _) = base(60);
    for (i, scale) in needles.scales.iter_mut().enumerate() {
        let short = -14.0;
        *scale = match i % 3 {
            0 => [short + 13.8, short, short],
            1 => [-1.0, short, -1.0],
            _ => [2.0, -11.8, -11.8],
        };
    }
    out.push(("needles and pancakes", needles));
    let (mut near, _) = base(90);
    for (i, mean) in near.means.iter_mut().enumerate() {
        let z = [0.0099, 0.0101, 0.02, -0.0101, -1.0, 0.0][i % 6];
        *mean = [mean[0] * 0.01, mean[1] * 0.01, z];
    }
    for scale in near.scales.as_flattened_mut() {
        *scale -= 4.0;
    }
    out.push(("around the near plane", near));
    let (mut saturated, _) = base(120);
    for (i, opacity) in saturated.opacities.iter_mut().enumerate() {
        *opacity = if i % 3 == 0 { -30.0 } else { 30.0 };
    }
    out.push(("saturated opacities", saturated));
    let (mut outside, _) = base(40);
    for (mean, scale) in outside.means.iter_mut().zip(&mut outside.scales) {
        mean[0] += 30.0;
        *scale = [2.5, 1.0, 2.0];
    }
    out.push(("far off the frustum", outside));
    let (mut equal, _) = base(150);
    for mean in &mut equal.means {
        mean[2] = 3.0;
    }
    out.push(("all at one depth", equal));
    let (mut quats, _) = base(20);
    quats.quats[3] = [0.0; 4];
    quats.quats[4] = [1e-7, 0.0, 0.0, 0.0];
    quats.quats[5] = [1e-5, 0.0, 2e-5, 0.0];
    quats.quats[6] = [1e15, 2e15, 0.0, 0.0];
    out.push(("tiny and huge quaternions", quats));
    out
}

/// Every hard scene, from splats to picture and back, against the reference; gradients within
/// `bound` of the largest of their kind.
pub fn hard_scenes_agree_with_the_reference(stages: &dyn Stages<f32>, bound: f64) {
    let camera = splat_render::Camera {
        viewmat: glam::DMat4::IDENTITY,
        fx: 70.0,
        fy: 75.0,
        cx: 33.0,
        cy: 25.0,
        width: 66,
        height: 50,
    };
    let options = ProjectOptions::default();
    let mut rng = rng(21);
    for (name, scene) in hard_scenes() {
        let projected = stages.project(&scene.params(), &camera, &options).unwrap();
        let got = stages.rasterize(&projected, [0.2; 3]).unwrap();
        let wide = scene.widen();
        let expected2d = Reference.project(&wide.params(), &camera, &options).unwrap();
        let expected = Reference.rasterize(&expected2d, [0.2; 3]).unwrap();
        for i in 0..wide.means.len() {
            let culled = expected2d.radii[i] == [0.0; 2];
            assert_eq!(projected.radii[i] == [0.0; 2], culled, "{name}: splat {i}");
        }
        let band = band_pixels(&expected2d, 2e-2);
        let off = image_difference(&got, &expected, &band);
        let count = band.iter().filter(|&&b| b).count();
        println!("{name}: {:.2e} max, {:.2e} mean, {count} in the band", off.max, off.mean);
        assert!(off.max <= 1e-4, "{name}: {off:?}");

        let mut v_image = random_image_gradients(&mut rng, band.len());
        for (pixel, &in_band) in band.iter().enumerate() {
            if in_band {
                v_image.v_color[pixel] = [0.0; 3];
                v_image.v_alpha[pixel] = 0.0;
                v_image.v_depth[pixel] = 0.0;
            }
        }
        let v2d = stages.rasterize_backward(&projected, [0.2; 3], &got, &v_image, false).unwrap();
        let v =
            stages.project_backward(&scene.params(), &camera, &options, &projected, &v2d).unwrap();
        let expected_v2d = Reference
            .rasterize_backward(
                &expected2d,
                [0.2; 3],
                &expected,
                &widen_image_gradients(&v_image),
                false,
            )
            .unwrap();
        let expected_v = Reference
            .project_backward(&wide.params(), &camera, &options, &expected2d, &expected_v2d)
            .unwrap();
        let differences = splat_gradient_differences(&v, &expected_v);
        for (kind, d) in &differences {
            println!("    {kind}: {:.2e} of {:.2e}", d.relative(), d.scale);
        }
        assert_gradients(&differences, bound, name);
    }
}

/// Hard 2D splats, by name.
fn hard_splats_2d() -> Vec<(&'static str, Projected<f32>)> {
    let mut rng = rng(2);
    let mut cases = Vec::new();
    let mut equal = random_projected(&mut rng, 200, 40, 40, 4.0);
    equal.depths.fill(2.0);
    cases.push(("all at one depth: the index decides", equal));
    let mut culled = random_projected(&mut rng, 50, 33, 20, 3.0);
    culled.radii.fill([0.0; 2]);
    cases.push(("everything culled", culled));
    let mut outside = random_projected(&mut rng, 40, 120, 90, 60.0);
    for mean in &mut outside.means2d {
        mean[0] -= 150.0;
    }
    place(&mut outside, 0, [60.0, 45.0], [500.0, 400.0], 0.3, 0.9);
    cases.push(("centres far outside, and one over all tiles", outside));
    let mut opaque = random_projected(&mut rng, 1000, 20, 20, 8.0);
    for i in 0..1000 {
        place(&mut opaque, i, [10.0, 10.0], [9.0, 7.0], 0.5, 1.0);
        opaque.depths[i] = 1.0 + i as f32;
    }
    cases.push(("1000 opaque layers: early stop and the cap", opaque));
    let mut needles = random_projected(&mut rng, 100, 100, 80, 1.0);
    for i in 0..100 {
        let center = needles.means2d[i];
        let angle = rng.random_range(0.0..std::f64::consts::PI);
        place(&mut needles, i, center, [1e4, 1e-2], angle, 0.8);
        needles.depths[i] = i as f32 + 1.0;
    }
    cases.push(("needles", needles));
    let mut wide = random_projected(&mut rng, 300, 16_384, 2, 6.0);
    place(&mut wide, 0, [8000.0, 1.0], [9000.0, 2.0], 0.0, 0.5);
    cases.push(("a very wide picture", wide));
    cases
}

/// Every hard set of 2D splats, to picture and back, against the reference.
pub fn hard_splats_2d_agree_with_the_reference(stages: &dyn Stages<f32>, bounds: Bounds) {
    for (k, (name, projected)) in hard_splats_2d().iter().enumerate() {
        let mut bounds = bounds;
        // p dx and q dy reach 180 and cancel to u of order 1: their f32 rounding, 1e-5, moves
        // alpha by up to 0.8 exp(-1/2) 1e-5.
        if *name == "needles" {
            bounds.picture = bounds.picture.max(5e-6);
        }
        rasterize_stages(stages, projected, 30 + k as u64, bounds, name);
    }
}

/// 100 000 splats in one tile, and one splat on 16 384 tiles.
pub fn many_splats_in_one_tile_and_one_on_many(stages: &dyn Stages<f32>, bounds: Bounds) {
    let mut rng = rng(11);
    // Nearly all over the left of the tile, then 300 over its right: a list that is cut off
    // anywhere (some drivers stop loops after 65 535 rounds) loses those.
    let (n, left) = (100_000, 99_700);
    let mut crowd = Projected::<f32>::culled(n, 16, 16);
    for i in 0..n {
        let start = if i < left { 0.0 } else { 10.0 };
        let center = [start + rng.random_range(0.0f32..4.0), rng.random_range(0.0f32..16.0)];
        place(&mut crowd, i, center, [0.5, 0.5], 0.0, 0.3);
        crowd.depths[i] = if i < left { 1.0 } else { 2.0 };
        crowd.colors[i] = std::array::from_fn(|_| rng.random::<f32>());
    }
    rasterize_stages(stages, &crowd, 40, bounds, "100 000 in one tile");

    let mut huge = Projected::<f32>::culled(1, 2048, 2048);
    place(&mut huge, 0, [1000.0, 1040.0], [900.0, 700.0], 0.4, 0.7);
    huge.colors[0] = [0.3, 0.6, 0.9];
    rasterize_stages(stages, &huge, 41, bounds, "one on 16 384 tiles");
}

/// No splats: the background, and gradients of nothing.
pub fn no_splats_give_the_background(stages: &dyn Stages<f32>) {
    let empty = Projected::<f32>::culled(0, 21, 18);
    let image = stages.rasterize(&empty, [0.25, 0.5, 0.75]).unwrap();
    assert!(image.color.iter().all(|&c| c == [0.25, 0.5, 0.75]));
    assert!(image.alpha.iter().all(|&a| a == 0.0));
    let v_image = random_image_gradients(&mut rng(7), 21 * 18);
    let v = stages.rasterize_backward(&empty, [0.25, 0.5, 0.75], &image, &v_image, false).unwrap();
    assert!(v.v_means2d.is_empty());
    let sum: f64 = v_image.v_color.iter().map(|v| f64::from(v[0])).sum();
    assert!((f64::from(v.v_background[0]) - sum).abs() < 1e-4);
    let camera = random_camera(&mut rng(8), 21, 18);
    let scene = random_scene(&mut rng(9), 0, Some(2));
    let options = ProjectOptions::default();
    let projected = stages.project(&scene.params(), &camera, &options).unwrap();
    assert_eq!(projected, empty);
    let none = ProjectedGradients::<f32>::zeros(0);
    let v = stages.project_backward(&scene.params(), &camera, &options, &projected, &none).unwrap();
    assert!(v.v_means.is_empty() && v.v_viewmat == [[0.0; 4]; 3]);
}

/// One poisoned value in one slot, all slots in turn: everything else keeps its bits, and so do its
/// gradients.
pub fn poison_in_any_slot_culls_one_splat_at_most(stages: &dyn Stages<f32>) {
    let mut rng = rng(10);
    let scene = random_scene(&mut rng, 24, Some(1));
    let camera = random_camera(&mut rng, 40, 30);
    let options = ProjectOptions::default();
    let clean = stages.project(&scene.params(), &camera, &options).unwrap();
    let v_given = random_projected_gradients(&mut rng, &clean);
    let v_clean =
        stages.project_backward(&scene.params(), &camera, &options, &clean, &v_given).unwrap();
    let poisons =
        [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38, -1e38, f32::MIN_POSITIVE / 8.0, 0.0];
    // Mean 3, quaternion 4, scale 3, opacity 1, one coefficient's 3 channels and the last one's.
    for slot in 0..17 {
        for poison in poisons {
            let mut scene = scene.clone();
            let i = 11;
            match slot {
                0..3 => scene.means[i][slot] = poison,
                3..7 => scene.quats[i][slot - 3] = poison,
                7..10 => scene.scales[i][slot - 7] = poison,
                10 => scene.opacities[i] = poison,
                11..14 => scene.colors[4 * i][slot - 11] = poison,
                _ => scene.colors[4 * i + 3][slot - 14] = poison,
            }
            let what = format!("slot {slot}, {poison}");
            let projected = stages.project(&scene.params(), &camera, &options).unwrap();
            for k in (0..24).filter(|&k| k != i) {
                assert_eq!(projected.means2d[k], clean.means2d[k], "{what}");
                assert_eq!(projected.factors[k], clean.factors[k], "{what}");
                assert_eq!(projected.depths[k], clean.depths[k], "{what}");
                assert_eq!(projected.colors[k], clean.colors[k], "{what}");
                assert_eq!(projected.opacities[k], clean.opacities[k], "{what}");
                assert_eq!(projected.radii[k], clean.radii[k], "{what}");
            }
            if poison.is_nan() || poison.is_infinite() {
                assert_eq!(projected.radii[i], [0.0; 2], "{what} must be culled");
            }
            let v = stages
                .project_backward(&scene.params(), &camera, &options, &projected, &v_given)
                .unwrap();
            for k in (0..24).filter(|&k| k != i) {
                let colors = 4 * k..4 * k + 4;
                assert_eq!(v.v_means[k], v_clean.v_means[k], "{what}");
                assert_eq!(v.v_quats[k], v_clean.v_quats[k], "{what}");
                assert_eq!(v.v_scales[k], v_clean.v_scales[k], "{what}");
                assert_eq!(v.v_opacities[k], v_clean.v_opacities[k], "{what}");
                assert_eq!(v.v_colors[colors.clone()], v_clean.v_colors[colors], "{what}");
            }
            let image = stages.rasterize(&projected, [0.0; 3]).unwrap();
            assert!(image.color.iter().flatten().all(|v| v.is_finite()), "{what}: picture");
            let v_image = random_image_gradients(&mut rng, image.color.len());
            let v2d =
                stages.rasterize_backward(&projected, [0.0; 3], &image, &v_image, false).unwrap();
            let v = stages
                .project_backward(&scene.params(), &camera, &options, &projected, &v2d)
                .unwrap();
            let finite = v.v_means.iter().flatten().all(|v| v.is_finite())
                && v.v_quats.iter().flatten().all(|v| v.is_finite())
                && v.v_scales.iter().flatten().all(|v| v.is_finite())
                && v.v_opacities.iter().all(|v| v.is_finite())
                && v.v_colors.iter().flatten().all(|v| v.is_finite())
                && v.v_viewmat.iter().flatten().all(|v| v.is_finite())
                && v.v_intrinsics.iter().all(|v| v.is_finite());
            assert!(finite, "{what}: gradients");
        }
    }
}
