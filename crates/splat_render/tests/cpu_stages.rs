//! The CPU implementation against the reference, stage by stage and end to end.

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

#[test]
fn hard_scenes_agree_with_the_reference() {
    common::hard_cases::hard_scenes_agree_with_the_reference(&Cpu, BOUNDS);
}

#[test]
fn no_splats_give_the_background() {
    common::hard_cases::no_splats_give_the_background(&Cpu);
}

#[test]
fn poison_in_any_slot_culls_one_splat_at_most() {
    common::hard_cases::poison_in_any_slot_culls_one_splat_at_most(&Cpu);
}

#[test]
fn hard_splats_2d_agree_with_the_reference() {
    common::hard_cases::hard_splats_2d_agree_with_the_reference(&Cpu, BOUNDS);
}

#[test]
fn many_splats_in_one_tile_and_one_on_many() {
    common::hard_cases::many_splats_in_one_tile_and_one_on_many(&Cpu, BOUNDS);
}

#[test]
fn a_zero_quaternion_culls_its_splat() {
    common::hard_cases::a_zero_quaternion_culls_its_splat(&Cpu);
}

#[test]
fn thresholds_are_the_same_everywhere() {
    common::hard_cases::thresholds_are_the_same_everywhere(&Cpu);
}

#[test]
fn tile_edges_show_nothing() {
    common::hard_cases::tile_edges_show_nothing(&Cpu, BOUNDS);
}

#[test]
fn any_values_give_finite_results() {
    common::properties::any_values_give_finite_results(&Cpu, 1000);
}

#[test]
fn the_order_of_splats_does_not_matter() {
    common::properties::the_order_of_splats_does_not_matter(&Cpu, 100);
}

#[test]
fn drawn_pictures_match_the_reference() {
    common::properties::drawn_pictures_match_the_reference(&Cpu, BOUNDS, 100);
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

#[test]
fn culled_splats_change_nothing() {
    common::hard_cases::culled_splats_change_nothing(&Cpu);
}

#[test]
fn a_far_away_scene_renders_as_one_at_the_origin() {
    common::hard_cases::a_far_away_scene_renders_as_one_at_the_origin(&Cpu);
}

#[test]
fn depth_loss_matches_the_reference() {
    common::optimization::depth_loss_matches_the_reference(&Cpu);
}

#[test]
fn exposure_matches_the_reference() {
    common::optimization::exposure_matches_the_reference(&Cpu);
}

#[test]
fn loss_matches_the_reference() {
    common::optimization::loss_matches_the_reference(&Cpu);
}

#[test]
fn adam_matches_the_reference() {
    common::optimization::adam_matches_the_reference(&Cpu);
}

#[test]
fn frozen_splats_keep_their_moments() {
    common::optimization::frozen_splats_keep_their_moments(&Cpu);
}

#[test]
fn depths_that_are_not_positive_are_not_drawn() {
    common::agreement::depths_that_are_not_positive_are_not_drawn(&Cpu);
}

#[test]
fn a_near_plane_of_zero_draws_what_is_before_the_camera() {
    common::agreement::a_near_plane_of_zero_draws_what_is_before_the_camera(&Cpu);
}

#[test]
fn senseless_options_are_refused() {
    common::agreement::senseless_options_are_refused(&Cpu);
}
