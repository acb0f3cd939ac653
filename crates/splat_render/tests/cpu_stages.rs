//! The CPU implementation against the reference, stage by stage and end to end.

#[macro_use]
mod common;

use common::conformance::{Bounds, OPTIONS, SIZES, end_to_end, project_stages, rasterize_stages};
use common::{
    random_camera, random_image_gradients, random_projected, random_scene, rng, splat_gradient_bits,
};
use splat_render::Stages;
use splat_render::cpu::Cpu;

const BOUNDS: Bounds = Bounds { picture: 2e-6, gradient: 1e-4 };

#[test]
fn rasterize_matches_the_reference() {
    for (k, (width, height)) in SIZES.into_iter().enumerate() {
        for (n, sigma) in [(0, 3.0), (1, 8.0), (300, 3.0), (60, 30.0)] {
            let seed = (k * 10 + n) as u64;
            let projected = random_projected(&mut rng(seed), n, width, height, sigma);
            let what = format!("{width}x{height}, {n} splats of {sigma} px");
            rasterize_stages(&Cpu, &projected, seed, BOUNDS, &what);
        }
    }
}

#[test]
fn project_matches_the_reference() {
    for (seed, degree) in
        [None, Some(0), Some(1), Some(2), Some(3), Some(4)].into_iter().enumerate()
    {
        let mut rng = rng(seed as u64);
        let camera = random_camera(&mut rng, 96, 64);
        let scene = random_scene(&mut rng, 2500, degree);
        for options in OPTIONS {
            let what = format!("SH {degree:?}, antialiased {}", options.antialiased);
            project_stages(&Cpu, &scene, &camera, &options, seed as u64, BOUNDS, &what);
        }
    }
}

#[test]
fn end_to_end_matches_the_reference() {
    for (k, (width, height)) in SIZES.into_iter().enumerate() {
        for (n, degree) in [(1, None), (200, Some(3)), (2000, Some(1))] {
            let seed = (k * 7 + n) as u64;
            let mut rng = rng(seed);
            let camera = random_camera(&mut rng, width, height);
            let scene = random_scene(&mut rng, n, degree);
            for options in OPTIONS {
                let aa = options.antialiased;
                let what = format!("{width}x{height}, {n} splats, SH {degree:?}, antialiased {aa}");
                end_to_end(&Cpu, &scene, &camera, &options, &mut rng, BOUNDS, &what);
            }
        }
    }
}

/// Pictures and gradients, on one thread to eight.
#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut rng = rng(50);
    let scene = random_scene(&mut rng, 3000, Some(2));
    let camera = random_camera(&mut rng, 130, 90);
    let v_image = random_image_gradients(&mut rng, 130 * 90);
    let options = OPTIONS[1];
    let run = || {
        let projected = Cpu.project(&scene.params(), &camera, &options).unwrap();
        let image = Cpu.rasterize(&projected, [0.3; 3]).unwrap();
        let v2d = Cpu.rasterize_backward(&projected, [0.3; 3], &image, &v_image, true).unwrap();
        let v = Cpu.project_backward(&scene.params(), &camera, &options, &projected, &v2d).unwrap();
        (image, v2d, splat_gradient_bits(&v))
    };
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(run)
    };
    let one = on(1);
    for threads in 2..=8 {
        assert!(one == on(threads), "{threads} threads give other bits than one");
    }
}

checks! {
    [&Cpu];
    hard_cases::hard_scenes_agree_with_the_reference(BOUNDS);
    hard_cases::no_splats_give_the_background();
    hard_cases::poison_in_any_slot_culls_one_splat_at_most();
    hard_cases::hard_splats_2d_agree_with_the_reference(BOUNDS);
    hard_cases::many_splats_in_one_tile_and_one_on_many(BOUNDS);
    hard_cases::a_zero_quaternion_culls_its_splat();
    hard_cases::thresholds_are_the_same_everywhere();
    hard_cases::tile_edges_show_nothing(BOUNDS);
    properties::any_values_give_finite_results(1000);
    properties::the_order_of_splats_does_not_matter(100);
    properties::drawn_pictures_match_the_reference(BOUNDS, 100);
    hard_cases::culled_splats_change_nothing();
    hard_cases::a_far_away_scene_renders_as_one_at_the_origin();
    optimization::depth_loss_matches_the_reference();
    optimization::exposure_matches_the_reference();
    optimization::loss_matches_the_reference();
    optimization::adam_matches_the_reference();
    optimization::frozen_splats_keep_their_moments();
    agreement::invalid_2d_splats_are_not_drawn();
    agreement::a_near_plane_of_zero_draws_what_is_before_the_camera();
    agreement::senseless_options_are_refused();
}
