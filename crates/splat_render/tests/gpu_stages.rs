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

/// Splats that cannot be seen, put between the others, change no bit of picture or gradients.
#[test]
fn culled_splats_change_nothing() {
    let mut rng = rng(7);
    let few = random_scene(&mut rng, 120, Some(2));
    let camera = random_camera(&mut rng, 90, 61);
    let (mut many, mut many_from_few) = (random_scene(&mut rng, 0, Some(2)), Vec::new());
    for i in 0..few.means.len() {
        let culled = [
            ([0.0, 0.0, -1e4], few.scales[i], few.opacities[i]),
            ([1e4, 0.0, 0.0], [-3.0; 3], few.opacities[i]),
            (few.means[i], few.scales[i], -20.0),
            (few.means[i], [f32::NAN; 3], few.opacities[i]),
        ];
        // None, one or several before each.
        for (mean, scales, opacity) in culled.into_iter().cycle().skip(i).take(i % 7) {
            many.means.push(mean);
            many.quats.push(few.quats[i]);
            many.scales.push(scales);
            many.opacities.push(opacity);
            many.colors.extend(&few.colors[9 * i..9 * i + 9]);
        }
        many_from_few.push(many.means.len());
        many.means.push(few.means[i]);
        many.quats.push(few.quats[i]);
        many.scales.push(few.scales[i]);
        many.opacities.push(few.opacities[i]);
        many.colors.extend(&few.colors[9 * i..9 * i + 9]);
    }
    for options in OPTIONS {
        let run = |scene: &Scene<f32>| {
            let projected = gpu().project(&scene.params(), &camera, &options).unwrap();
            let image = gpu().rasterize(&projected, [0.3, 0.2, 0.1]).unwrap();
            let v_image = ImageGradients {
                v_color: image.color.iter().map(|c| c.map(|v| v - 0.5)).collect(),
                v_alpha: image.alpha.clone(),
                v_depth: image.depth.clone(),
            };
            let v2d = gpu()
                .rasterize_backward(&projected, [0.3, 0.2, 0.1], &image, &v_image, true)
                .unwrap();
            let v = gpu()
                .project_backward(&scene.params(), &camera, &options, &projected, &v2d)
                .unwrap();
            (image, v2d, v)
        };
        let (image, v2d, v) = run(&few);
        let (image_many, v2d_many, v_many) = run(&many);
        assert!(image == image_many, "picture");
        let seen = v.v_means.iter().filter(|&&v| v != [0.0; 3]).count();
        assert!(seen > 60, "only {seen} splats have a gradient");
        let (absolute, absolute_many) =
            (v2d.v_means2d_absolute.unwrap(), v2d_many.v_means2d_absolute.unwrap());
        for (i, &k) in many_from_few.iter().enumerate() {
            assert_eq!(v2d.v_means2d[i], v2d_many.v_means2d[k], "v_means2d {i}");
            assert_eq!(v2d.v_factors[i], v2d_many.v_factors[k], "v_factors {i}");
            assert_eq!(absolute[i], absolute_many[k], "v_means2d_absolute {i}");
            assert_eq!(v.v_means[i], v_many.v_means[k], "v_means {i}");
            assert_eq!(v.v_quats[i], v_many.v_quats[k], "v_quats {i}");
            assert_eq!(v.v_scales[i], v_many.v_scales[k], "v_scales {i}");
            assert_eq!(v.v_opacities[i], v_many.v_opacities[k], "v_opacities {i}");
            assert_eq!(v.v_colors[9 * i..9 * i + 9], v_many.v_colors[9 * k..9 * k + 9], "v_colors");
        }
        let culled = v_many.v_means.iter().enumerate().filter(|(k, _)| !many_from_few.contains(k));
        for (k, v_mean) in culled {
            assert_eq!(*v_mean, [0.0; 3], "culled splat {k} has a gradient");
        }
    }
}

/// A scene 1e6 units from the origin: its means and cameras, taken relative to an f64 origin before
/// they become f32, give the picture and gradients of the scene at the origin.
#[test]
fn a_far_away_scene_renders_as_one_at_the_origin() {
    let mut rng = rng(8);
    let scene = random_scene(&mut rng, 200, Some(1));
    let camera = random_camera(&mut rng, 80, 60);
    let options = ProjectOptions::default();
    let offset = glam::DVec3::new(1e6, -2e6, 3e5);
    // World coordinates as a capture has them, and an origin near but not at the offset.
    let world = scene.means.iter().map(|m| glam::Vec3::from(*m).as_dvec3() + offset);
    let world_camera = camera.viewmat * glam::DMat4::from_translation(-offset);
    let origin = offset + glam::DVec3::new(0.25, -0.5, 0.125);
    let mut far = scene.clone();
    far.means = world.map(|m| (m - origin).as_vec3().to_array()).collect();
    let far_camera = splat_render::Camera {
        viewmat: world_camera * glam::DMat4::from_translation(origin),
        ..camera
    };
    let run = |scene: &Scene<f32>, camera| {
        let projected = gpu().project(&scene.params(), camera, &options).unwrap();
        let image = gpu().rasterize(&projected, [0.1; 3]).unwrap();
        let v_image = random_image_gradients(&mut common::rng(9), image.alpha.len());
        let v2d = gpu().rasterize_backward(&projected, [0.1; 3], &image, &v_image, false).unwrap();
        let v = gpu().project_backward(&scene.params(), camera, &options, &projected, &v2d);
        (image, v.unwrap())
    };
    let (image, v) = run(&scene, &camera);
    let (image_far, v_far) = run(&far, &far_camera);
    let off = image_difference(&image_far, &widen_image(&image), &[]);
    println!("picture {off:?}");
    assert!(off.max < 1e-3, "{off:?}");
    for (what, off) in [
        ("v_means", difference(&v_far.v_means, &widen(&v.v_means), &[])),
        ("v_scales", difference(&v_far.v_scales, &widen(&v.v_scales), &[])),
        ("v_quats", difference(&v_far.v_quats, &widen(&v.v_quats), &[])),
    ] {
        println!("{what} {off:?}");
        assert!(off.relative() < 1e-3, "{what}: {off:?}");
    }
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
