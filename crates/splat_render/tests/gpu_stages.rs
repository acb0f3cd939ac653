//! The WGSL stages against the f64 reference, stage by stage and end to end.

#[macro_use]
mod common;

use std::ops::Range;
use std::sync::LazyLock;

use common::conformance::Bounds;
use common::*;
use rand::Rng;
use splat_render::gpu::{Gpu, ResidentPicture, ResidentSplats, ResidentView};
use splat_render::stages::Projected;
use splat_render::{Camera, ProjectOptions, Stages};

/// Devices for all tests, because software adapters compile kernels for seconds: as it is; without
/// subgroups, which few software drivers have; and with the kernels for discrete GPUs.
static GPUS: LazyLock<[Gpu; 3]> =
    LazyLock::new(|| [gpu(), gpu().without_subgroups(), gpu().as_discrete()]);

const BOUNDS: Bounds = Bounds { picture: 2e-5, gradient: 2e-5 };

/// From splats to picture and back.
const END_TO_END: Bounds = Bounds { gradient: 1e-4, ..BOUNDS };

#[test]
fn parts_of_the_work_give_the_same_bits() {
    let mut rng = rng(6);
    let scene = random_scene(&mut rng, 3000, Some(4));
    let camera = random_camera(&mut rng, 150, 90);
    let options = ProjectOptions::default();
    // As text, because 0 equals -0.
    let run = |gpu: &Gpu| format!("{:?}", pass(gpu, &scene, &camera, &options, None));
    // The picture's own minimum; it holds the colors of 704 splats and the gradient slots of 4 500 pairs.
    let all = run(&GPUS[0]);
    let parts = run(&gpu().with_binding_limit(216_000));
    assert!(all == parts, "a lower binding limit changed the result");
    // 60 tiles and 3 000 splats at 64 per workgroup: the last row of a dispatch is ragged.
    let spilled = run(&gpu().with_group_limit(7));
    assert!(all == spilled, "workgroups in a second dimension changed the result");
}

/// Blocks skip splats that draw nothing on them, and nothing else is different.
#[test]
fn blocks_draw_the_bits_that_rows_draw() {
    let [_, rows, blocks] = &*GPUS;
    let background = [0.2, 0.5, 0.9];
    let mut cases = hard_cases::hard_splats_2d();
    let mut rng = rng(15);
    // Around the sizes of a word of bits and of a batch, in one tile; and past one dispatch.
    for n in [0, 1, 31, 32, 33, 255, 256, 257, 5000] {
        let mut crowd = Projected::<f32>::culled(n, 19, 21);
        for i in 0..n {
            let center = [(); 2].map(|()| rng.random_range(-2.0f32..22.0));
            let angle = rng.random_range(0.0..3.0);
            place(&mut crowd, i, center, [0.2, 3.0], angle, 0.03);
            crowd.depths[i] = rng.random();
            crowd.colors[i] = std::array::from_fn(|_| rng.random());
        }
        cases.push(("a crowd", crowd));
    }
    for (name, projected) in &cases {
        let n = projected.len();
        let [by_rows, by_blocks] =
            [rows, blocks].map(|gpu| gpu.rasterize(projected, background).unwrap());
        assert!(by_rows == by_blocks, "{name}, {n} splats");
        if [33, 257].contains(&n) {
            conformance::rasterize_stages(blocks, projected, 42, BOUNDS, name);
        }
    }
}

/// Draws columns of a resident picture: color without background and transmittance, none if its pairs did
/// not fit.
fn resident_picture(
    gpu: &Gpu,
    picture: &mut ResidentPicture,
    splats: &ResidentSplats,
    camera: &Camera,
    columns: Range<u32>,
) -> splat_render::Result<Option<Vec<[f32; 4]>>> {
    let mut encoder = gpu.device().create_command_encoder(&Default::default());
    let bytes = 16 * u64::from(columns.end - columns.start) * u64::from(camera.height);
    let (options, none) = (ProjectOptions::default(), [const { None }; 4]);
    let view = ResidentView { camera, options: &options, sh_degree: 2 };
    picture.record(gpu, &mut encoder, splats, &view, columns, none)?;
    let (arguments, at) = ResidentPicture::draws(splats);
    let [pixels, triangle, quads, all_quads] = [bytes, 16, 16, 16].map(|n| gpu.readable(n));
    encoder.copy_buffer_to_buffer(picture.picture(), 0, &pixels, 0, bytes);
    encoder.copy_buffer_to_buffer(arguments, at[0], &triangle, 0, 16);
    encoder.copy_buffer_to_buffer(arguments, at[1], &quads, 0, 16);
    encoder.copy_buffer_to_buffer(splats.quads(), 0, &all_quads, 0, 16);
    gpu.queue().submit([encoder.finish()]);
    picture.submitted();
    let read = [(&pixels, bytes), (&triangle, 16), (&quads, 16), (&all_quads, 16)];
    let [pixels, triangle, quads, all_quads] = gpu.read(&read)?.try_into().unwrap();
    let [triangle, quads, all_quads] =
        [triangle, quads, all_quads].map(|bytes| bytemuck::pod_collect_to_vec::<u8, u32>(&bytes));
    if quads[1] > 0 {
        assert_eq!(triangle, [3, 0, 0, 0]);
        assert_eq!(quads, all_quads);
        return Ok(None);
    }
    assert_eq!((triangle, quads), (vec![3, 1, 0, 0], vec![4, 0, 0, 0]));
    Ok(Some(bytemuck::pod_collect_to_vec(&pixels)))
}

/// The same by the stages.
fn picture_by_stages(gpu: &Gpu, scene: &Scene<f32>, camera: &Camera) -> Vec<[f32; 4]> {
    let image = render(gpu, &scene.params(), camera, [0.0; 3]);
    let pixels = image.color.iter().zip(&image.transmittance);
    pixels.map(|(c, t)| [c[0], c[1], c[2], *t]).collect()
}

#[test]
fn resident_pictures_are_those_of_the_stages() {
    let mut rng = rng(13);
    let scene = random_scene(&mut rng, 3000, Some(2));
    let cameras = [(150, 90), (64, 48), (131, 77)].map(|(w, h)| random_camera(&mut rng, w, h));
    let large = random_camera(&mut rng, 151, 90);
    for gpu in GPUS.iter() {
        let splats = ResidentSplats::new(gpu, &scene.params()).unwrap();
        let mut picture = ResidentPicture::new(gpu, 150, 90).unwrap();
        let mut draw = |camera: &Camera, columns: Range<u32>| {
            resident_picture(gpu, &mut picture, &splats, camera, columns)
        };
        for camera in &cameras {
            let expected = picture_by_stages(gpu, &scene, camera);
            let drawn = draw(camera, 0..camera.width).unwrap().unwrap();
            assert!(drawn == expected, "not the stages' picture");
            // Tiles lie elsewhere, and centers are rounded otherwise.
            let part = draw(camera, 21..camera.width - 5).unwrap().unwrap();
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
fn resident_pictures_make_room_for_pairs_that_did_not_fit() {
    let mut rng = rng(14);
    let mut scene = random_scene(&mut rng, 1500, Some(2));
    // All on 192 tiles: 288 000 pairs, and room for 262 144 at first.
    scene.scales.as_flattened_mut().fill(1.0);
    scene.opacities.fill(-3.0);
    let camera = random_camera(&mut rng, 256, 192);
    let expected = picture_by_stages(&GPUS[0], &scene, &camera);
    // A binding of 1 MB holds 262 144.
    for (gpu, has_room) in [(gpu(), true), (gpu().with_binding_limit(1 << 20), false)] {
        let splats = ResidentSplats::new(&gpu, &scene.params()).unwrap();
        let mut picture = ResidentPicture::new(&gpu, 256, 192).unwrap();
        let mut draw =
            || resident_picture(&gpu, &mut picture, &splats, &camera, 0..camera.width).unwrap();
        assert!(draw().is_none());
        let second = draw();
        assert!(second == has_room.then(|| expected.clone()), "room: {has_room}");
    }
}

#[test]
fn frames_of_a_resident_picture_make_nothing_and_do_not_wait() {
    let mut rng = rng(15);
    let gpu = gpu();
    let scene = random_scene(&mut rng, 2000, Some(2));
    let scenes = [(); 2].map(|()| ResidentSplats::new(&gpu, &scene.params()).unwrap());
    let mut picture = ResidentPicture::new(&gpu, 64, 48).unwrap();
    let options = ProjectOptions::default();
    let mut counts = Vec::new();
    for _ in 0..12 {
        for splats in &scenes {
            let camera = random_camera(&mut rng, 64, 48);
            let view = ResidentView { camera: &camera, options: &options, sh_degree: 2 };
            let mut encoder = gpu.device().create_command_encoder(&Default::default());
            let none = [const { None }; 4];
            picture.record(&gpu, &mut encoder, splats, &view, 0..64, none).unwrap();
            gpu.queue().submit([encoder.finish()]);
            picture.submitted();
        }
        counts.push((gpu.made(), gpu.host_waits()));
    }
    assert!(counts[1..].iter().all(|count| *count == counts[1]), "{counts:?}");
}

#[test]
fn software_adapters_are_used_only_when_allowed() {
    match Gpu::new(false) {
        Ok(gpu) => assert!(!gpu.is_software(), "{}", gpu.name()),
        Err(error) => assert!(error.to_string().contains("backend cpu"), "{error}"),
    }
}

checks_of_all! { [&GPUS[0]]; 200, 40 }

checks! {
    [&GPUS[0]];
    conformance::projecting_matches_the_reference(BOUNDS);
    conformance::rendering_matches_the_reference(END_TO_END);
    hard_cases::hard_scenes_agree_with_the_reference(BOUNDS);
    properties::random_pictures_match_the_reference(BOUNDS, 60);
    optimization::adam_matches_the_reference();
}

checks! {
    [&GPUS[0]];
    conformance::rasterizing_matches_the_reference(BOUNDS);
    hard_cases::hard_splats_2d_agree_with_the_reference(BOUNDS);
    hard_cases::many_splats_in_one_tile_and_one_on_many(BOUNDS);
}

checks! {
    GPUS.iter();
    hard_cases::thresholds_are_the_same_everywhere();
    hard_cases::tile_edges_are_seamless(BOUNDS);
}

checks! {
    [&GPUS[0], &GPUS[2]];
    optimization::loss_matches_the_reference();
}
