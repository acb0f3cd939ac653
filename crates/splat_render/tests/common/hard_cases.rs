//! Hard cases that every f32 implementation must get through.

use rand::Rng;
use splat_render::reference::{Reference, band_pixels};
use splat_render::stages::{Projected, ProjectedGradients};
use splat_render::{ProjectOptions, Stages};

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
        let v2d = stages.rasterize_backward(&projected, [0.2; 3], &got, &v_image).unwrap();
        let v =
            stages.project_backward(&scene.params(), &camera, &options, &projected, &v2d).unwrap();
        let expected_v2d = Reference
            .rasterize_backward(&expected2d, [0.2; 3], &expected, &widen_image_gradients(&v_image))
            .unwrap();
        let expected_v = Reference
            .project_backward(&wide.params(), &camera, &options, &expected2d, &expected_v2d)
            .unwrap();
        let differences = splat_gradient_differences(&v, &expected_v);
        for (kind, d) in &differences {
            println!("    {kind}: {:.2e} of {:.2e}", d.relative(), d.scale);
        }
        // v_covars2d in f32 cannot hold what the long axis of a 1 : 1e6 needle needs: its quadratic
        // form cancels by the square of the needle's length in px (docs/numerics.md).
        let bound = if name == "needles and pancakes" { bound.max(5e-4) } else { bound };
        assert_gradients(&differences, bound, name);
    }
}

/// No splats: the background, and gradients of nothing.
pub fn no_splats_give_the_background(stages: &dyn Stages<f32>) {
    let empty = Projected::<f32>::culled(0, 21, 18);
    let image = stages.rasterize(&empty, [0.25, 0.5, 0.75]).unwrap();
    assert!(image.color.iter().all(|&c| c == [0.25, 0.5, 0.75]));
    assert!(image.alpha.iter().all(|&a| a == 0.0));
    let v_image = random_image_gradients(&mut rng(7), 21 * 18);
    let v = stages.rasterize_backward(&empty, [0.25, 0.5, 0.75], &image, &v_image).unwrap();
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

/// One poisoned value in one slot, all slots in turn: everything else keeps its bits.
pub fn poison_in_any_slot_culls_one_splat_at_most(stages: &dyn Stages<f32>) {
    let mut rng = rng(10);
    let scene = random_scene(&mut rng, 24, Some(1));
    let camera = random_camera(&mut rng, 40, 30);
    let options = ProjectOptions::default();
    let clean = stages.project(&scene.params(), &camera, &options).unwrap();
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
                assert_eq!(projected.colors[k], clean.colors[k], "{what}");
            }
            if poison.is_nan() || poison.is_infinite() {
                assert_eq!(projected.radii[i], [0.0; 2], "{what} must be culled");
            }
            let image = stages.rasterize(&projected, [0.0; 3]).unwrap();
            assert!(image.color.iter().flatten().all(|v| v.is_finite()), "{what}: picture");
            let v_image = random_image_gradients(&mut rng, image.color.len());
            let v2d = stages.rasterize_backward(&projected, [0.0; 3], &image, &v_image).unwrap();
            let v = stages
                .project_backward(&scene.params(), &camera, &options, &projected, &v2d)
                .unwrap();
            let finite = v.v_means.iter().flatten().all(|v| v.is_finite())
                && v.v_quats.iter().flatten().all(|v| v.is_finite())
                && v.v_scales.iter().flatten().all(|v| v.is_finite())
                && v.v_opacities.iter().all(|v| v.is_finite())
                && v.v_colors.iter().flatten().all(|v| v.is_finite())
                && v.v_viewmat.iter().flatten().all(|v| v.is_finite());
            assert!(finite, "{what}: gradients");
        }
    }
}
