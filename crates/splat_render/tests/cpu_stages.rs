//! The CPU implementation against the reference, stage by stage and end to end.

#[macro_use]
mod common;

use common::conformance::{Bounds, OPTIONS};
use common::{on_threads, pass, random_camera, random_scene, rng, splat_gradient_bits};
use splat_render::cpu::Cpu;

const BOUNDS: Bounds = Bounds { picture: 2e-6, gradient: 1e-4 };

/// Pictures and gradients, on one thread to eight.
#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut rng = rng(50);
    let scene = random_scene(&mut rng, 3000, Some(2));
    let camera = random_camera(&mut rng, 130, 90);
    let on = |threads| {
        on_threads(threads, || {
            let pass = pass(&Cpu, &scene, &camera, &OPTIONS[1], Some(51));
            (splat_gradient_bits(&pass.v_splats), pass)
        })
    };
    let one = on(1);
    for threads in 2..=8 {
        assert!(one == on(threads), "{threads} threads give other bits than one");
    }
}

checks! {
    [&Cpu];
    conformance::projecting_matches_the_reference(BOUNDS);
    conformance::rasterizing_matches_the_reference(BOUNDS);
    conformance::rendering_matches_the_reference(BOUNDS);
    hard_cases::hard_scenes_agree_with_the_reference(BOUNDS);
    hard_cases::no_splats_give_the_background();
    hard_cases::an_invalid_number_culls_one_splat_at_most();
    hard_cases::hard_splats_2d_agree_with_the_reference(BOUNDS);
    hard_cases::many_splats_in_one_tile_and_one_on_many(BOUNDS);
    hard_cases::a_zero_quaternion_culls_its_splat();
    hard_cases::thresholds_are_the_same_everywhere();
    hard_cases::tile_edges_are_seamless(BOUNDS);
    properties::any_values_give_finite_results(1000);
    properties::the_order_of_splats_does_not_matter(100);
    properties::random_pictures_match_the_reference(BOUNDS, 100);
    hard_cases::culled_splats_change_nothing();
    hard_cases::a_far_away_scene_renders_as_one_at_the_origin();
    optimization::depth_loss_matches_the_reference();
    optimization::exposure_matches_the_reference();
    optimization::loss_matches_the_reference();
    optimization::adam_matches_the_reference();
    optimization::frozen_splats_keep_their_moments();
    agreement::invalid_2d_splats_are_not_drawn();
    agreement::a_near_plane_of_zero_draws_what_is_before_the_camera();
    agreement::invalid_options_are_refused();
}
