//! The WGSL stages against the f64 reference, stage by stage and end to end.

mod common;

use std::sync::OnceLock;

use common::conformance::{Bounds, OPTIONS, end_to_end, project_stages, rasterize_stages};
use common::*;
use rand::Rng;
use splat_render::gpu::Gpu;
use splat_render::reference::Reference;
use splat_render::stages::{ImageGradients, Projected};
use splat_render::{ProjectOptions, Stages};

/// Any adapter will do, lavapipe included; none at all fails the test with the error's sentence.
fn gpu() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new(true).unwrap_or_else(|e| panic!("{e}")))
}

/// The same without subgroups, which is how every device but llvmpipe runs.
fn plain() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new(true).unwrap_or_else(|e| panic!("{e}")).without_subgroups())
}

const BOUNDS: Bounds = Bounds { picture: 2e-5, gradient: 1e-3 };

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
        let options = OPTIONS[round % 2];
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
        within("depths", difference1(&got.depths, &expected.depths, &[]), 1e-6);
        within("colors", difference(&got.colors, &expected.colors, &[]), 2e-6);
        within("opacities", difference1(&got.opacities, &expected.opacities, &[]), 1e-6);
        within("radii", difference(&got.radii, &expected.radii, &[]), 1e-4);
    }
}

#[test]
fn rasterizes_like_the_reference() {
    let mut rng = rng(2);
    for (round, (width, height)) in SIZES.into_iter().cycle().take(28).enumerate() {
        let n = [0, 1, 7, 60, 300][round % 5];
        let sigma = [1.0, 3.0, 10.0][round % 3];
        let projected = random_projected(&mut rng, n, width, height, sigma);
        let what = format!("round {round}, {width}x{height}");
        for gpu in [gpu(), plain()] {
            rasterize_stages(gpu, &projected, round as u64, BOUNDS, &what);
        }
    }
}

#[test]
fn projects_backward_like_the_reference() {
    let mut rng = rng(4);
    for (round, (width, height)) in SIZES.into_iter().cycle().take(36).enumerate() {
        let n = rng.random_range(1..200);
        let degree = [None, Some(0), Some(1), Some(2), Some(3), Some(4)][round % 6];
        let scene = random_scene(&mut rng, n, degree);
        let camera = random_camera(&mut rng, width, height);
        let what = format!("round {round}, SH {degree:?}");
        project_stages(
            gpu(),
            &scene,
            &camera,
            &OPTIONS[round / 6 % 2],
            round as u64,
            BOUNDS,
            &what,
        );
    }
}

#[test]
fn renders_end_to_end_like_the_reference() {
    let mut rng = rng(5);
    for (round, (width, height)) in SIZES.into_iter().cycle().take(28).enumerate() {
        let n = [1, 10, 100, 400][round % 4];
        let scene = random_scene(&mut rng, n, Some(3));
        let camera = random_camera(&mut rng, width, height);
        let what = format!("round {round}, {width}x{height}");
        end_to_end(gpu(), &scene, &camera, &OPTIONS[round / 6 % 2], &mut rng, BOUNDS, &what);
    }
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
        let v2d =
            gpu.rasterize_backward(&projected, [0.3, 0.2, 0.1], &image, &v_image, true).unwrap();
        let v = gpu.project_backward(&scene.params(), &camera, &options, &projected, &v2d).unwrap();
        (projected, image, v2d, splat_gradient_bits(&v))
    };
    // What the picture itself needs; it holds the colours of 704 splats and the gradient slots of
    // 4 500 pairs.
    let whole = run(gpu());
    let parts = run(&Gpu::new(true).unwrap().with_binding_limit(216_000));
    assert!(whole == parts, "a lower binding limit changed the result");
    // 60 tiles and 3 000 splats at 64 per workgroup: the last row of a dispatch is ragged.
    let spilled = run(&Gpu::new(true).unwrap().with_group_limit(7));
    assert!(whole == spilled, "workgroups in a second dimension changed the result");
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
    common::hard_cases::hard_scenes_agree_with_the_reference(gpu(), BOUNDS);
}

#[test]
fn no_splats_give_the_background() {
    common::hard_cases::no_splats_give_the_background(gpu());
}

#[test]
fn poison_in_any_slot_culls_one_splat_at_most() {
    common::hard_cases::poison_in_any_slot_culls_one_splat_at_most(gpu());
}

#[test]
fn hard_splats_2d_agree_with_the_reference() {
    for gpu in [gpu(), plain()] {
        common::hard_cases::hard_splats_2d_agree_with_the_reference(gpu, BOUNDS);
    }
}

#[test]
fn many_splats_in_one_tile_and_one_on_many() {
    for gpu in [gpu(), plain()] {
        common::hard_cases::many_splats_in_one_tile_and_one_on_many(gpu, BOUNDS);
    }
}

#[test]
fn culled_splats_change_nothing() {
    common::hard_cases::culled_splats_change_nothing(gpu());
}

#[test]
fn a_far_away_scene_renders_as_one_at_the_origin() {
    common::hard_cases::a_far_away_scene_renders_as_one_at_the_origin(gpu());
}

#[test]
fn a_zero_quaternion_culls_its_splat() {
    common::hard_cases::a_zero_quaternion_culls_its_splat(gpu());
}

#[test]
fn thresholds_are_the_same_everywhere() {
    for gpu in [gpu(), plain()] {
        common::hard_cases::thresholds_are_the_same_everywhere(gpu);
    }
}

#[test]
fn tile_edges_show_nothing() {
    for gpu in [gpu(), plain()] {
        common::hard_cases::tile_edges_show_nothing(gpu, BOUNDS);
    }
}

#[test]
fn any_values_give_finite_results() {
    common::properties::any_values_give_finite_results(gpu(), 200);
}

#[test]
fn the_order_of_splats_does_not_matter() {
    common::properties::the_order_of_splats_does_not_matter(gpu(), 40);
}

#[test]
fn drawn_pictures_match_the_reference() {
    common::properties::drawn_pictures_match_the_reference(gpu(), BOUNDS, 60);
}
