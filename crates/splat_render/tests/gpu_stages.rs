//! The WGSL stages against the f64 reference, stage by stage and end to end.

#[macro_use]
mod common;

use std::ops::Range;
use std::sync::OnceLock;

use common::conformance::{Bounds, OPTIONS, end_to_end, project_stages, rasterize_stages};
use common::*;
use rand::Rng;
use splat_render::gpu::{Gpu, ResidentPicture, ResidentSplats, ResidentView};
use splat_render::reference::Reference;
use splat_render::stages::ImageGradients;
use splat_render::{Camera, ProjectOptions, Stages};

/// Any adapter will do, lavapipe included; none at all fails the test with the error's sentence.
fn gpu() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new(true).unwrap_or_else(|e| panic!("{e}")))
}

/// The same with the kernels that discrete GPUs are given: other tiles, the sort by eight bits, the loss
/// by tiles.
fn discrete() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new(true).unwrap_or_else(|e| panic!("{e}")).as_discrete())
}

/// The same without subgroups, which few software drivers have.
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
        for gpu in [gpu(), plain(), discrete()] {
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
    // What the picture itself needs; it holds the colors of 704 splats and the gradient slots of
    // 4 500 pairs.
    let whole = run(gpu());
    let parts = run(&Gpu::new(true).unwrap().with_binding_limit(216_000));
    assert!(whole == parts, "a lower binding limit changed the result");
    // 60 tiles and 3 000 splats at 64 per workgroup: the last row of a dispatch is ragged.
    let spilled = run(&Gpu::new(true).unwrap().with_group_limit(7));
    assert!(whole == spilled, "workgroups in a second dimension changed the result");
}

/// Columns of a resident picture: color without background, transmittance.
fn resident_picture(
    gpu: &Gpu,
    picture: &mut ResidentPicture,
    splats: &ResidentSplats,
    camera: &Camera,
    columns: Range<u32>,
) -> splat_render::Result<Vec<[f32; 4]>> {
    let mut encoder = gpu.device().create_command_encoder(&Default::default());
    let bytes = 16 * u64::from(columns.end - columns.start) * u64::from(camera.height);
    let (options, none) = (ProjectOptions::default(), [const { None }; 4]);
    let view = ResidentView { camera, options: &options, sh_degree: 2 };
    picture.record(gpu, &mut encoder, splats, &view, columns, none)?;
    let readable = gpu.readable(bytes);
    encoder.copy_buffer_to_buffer(picture.picture(), 0, &readable, 0, bytes);
    gpu.queue().submit([encoder.finish()]);
    Ok(bytemuck::pod_collect_to_vec(&gpu.read(&[(&readable, bytes)])?[0]))
}

/// The same by the stages.
fn picture_by_stages(gpu: &Gpu, scene: &Scene<f32>, camera: &Camera) -> Vec<[f32; 4]> {
    let projected = gpu.project(&scene.params(), camera, &ProjectOptions::default()).unwrap();
    let image = gpu.rasterize(&projected, [0.0; 3]).unwrap();
    let pixels = image.color.iter().zip(&image.transmittance);
    pixels.map(|(c, t)| [c[0], c[1], c[2], *t]).collect()
}

#[test]
fn resident_pictures_are_those_of_the_stages() {
    let mut rng = rng(13);
    let scene = random_scene(&mut rng, 3000, Some(2));
    let cameras = [(150, 90), (64, 48), (131, 77)].map(|(w, h)| random_camera(&mut rng, w, h));
    let large = random_camera(&mut rng, 151, 90);
    for gpu in [gpu(), plain(), discrete()] {
        let splats = ResidentSplats::new(gpu, &scene.params()).unwrap();
        let mut picture = ResidentPicture::new(gpu, 150, 90).unwrap();
        let mut draw = |camera: &Camera, columns: Range<u32>| {
            resident_picture(gpu, &mut picture, &splats, camera, columns)
        };
        for camera in &cameras {
            let expected = picture_by_stages(gpu, &scene, camera);
            let drawn = draw(camera, 0..camera.width).unwrap();
            assert!(drawn == expected, "not the stages' picture");
            // Tiles lie elsewhere, and centers are rounded otherwise.
            let part = draw(camera, 21..camera.width - 5).unwrap();
            let row = |row: &[[f32; 4]]| row[21..camera.width as usize - 5].to_vec();
            let cut: Vec<_> = expected.chunks(camera.width as usize).flat_map(row).collect();
            assert_eq!(part.len(), cut.len());
            let off = part.as_flattened().iter().zip(cut.as_flattened());
            let off = off.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(off < 5e-4, "columns are off by {off}");
        }
        for columns in [0..151, 9..9] {
            let error = draw(&large, columns).unwrap_err().to_string();
            assert!(error.starts_with("columns: "), "{error}");
        }
        let nowhere = Camera { fx: f64::NAN, ..large };
        let error = draw(&nowhere, 0..5).unwrap_err().to_string();
        assert!(error.starts_with("K: "), "{error}");
    }
}

#[test]
fn resident_pictures_whose_pairs_do_not_fit_are_made_in_parts() {
    let mut rng = rng(14);
    let mut scene = random_scene(&mut rng, 1300, Some(2));
    // Each on all 16 tiles: 20 800 pairs, where the least binding limit there is holds 16 384.
    scene.scales.as_flattened_mut().fill(1.0);
    scene.opacities.fill(-3.0);
    let camera = random_camera(&mut rng, 64, 64);
    let limited = Gpu::new(true).unwrap().with_binding_limit(65_536);
    let splats = ResidentSplats::new(&limited, &scene.params()).unwrap();
    let mut picture = ResidentPicture::new(&limited, 64, 64).unwrap();
    let drawn = resident_picture(&limited, &mut picture, &splats, &camera, 0..64).unwrap();
    assert!(drawn == picture_by_stages(gpu(), &scene, &camera), "parts changed the picture");
}

#[test]
fn software_adapters_are_used_only_when_allowed() {
    match Gpu::new(false) {
        Ok(gpu) => assert!(!gpu.is_software(), "{}", gpu.name()),
        Err(error) => assert!(error.to_string().contains("backend cpu"), "{error}"),
    }
}

checks! {
    [gpu()];
    hard_cases::hard_scenes_agree_with_the_reference(BOUNDS);
    hard_cases::no_splats_give_the_background();
    hard_cases::poison_in_any_slot_culls_one_splat_at_most();
    hard_cases::culled_splats_change_nothing();
    hard_cases::a_far_away_scene_renders_as_one_at_the_origin();
    hard_cases::a_zero_quaternion_culls_its_splat();
    properties::any_values_give_finite_results(200);
    properties::the_order_of_splats_does_not_matter(40);
    properties::drawn_pictures_match_the_reference(BOUNDS, 60);
    optimization::depth_loss_matches_the_reference();
    optimization::exposure_matches_the_reference();
    optimization::adam_matches_the_reference();
    optimization::frozen_splats_keep_their_moments();
    agreement::invalid_2d_splats_are_not_drawn();
    agreement::a_near_plane_of_zero_draws_what_is_before_the_camera();
    agreement::senseless_options_are_refused();
}

checks! {
    [gpu(), plain(), discrete()];
    hard_cases::hard_splats_2d_agree_with_the_reference(BOUNDS);
    hard_cases::many_splats_in_one_tile_and_one_on_many(BOUNDS);
    hard_cases::thresholds_are_the_same_everywhere();
    hard_cases::tile_edges_show_nothing(BOUNDS);
}

checks! {
    [gpu(), discrete()];
    optimization::loss_matches_the_reference();
}
