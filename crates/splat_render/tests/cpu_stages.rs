//! The CPU implementation against the reference, stage by stage and end to end.

#[macro_use]
mod common;

use common::conformance::{Bounds, OPTIONS};
use common::{on_threads, pass, random_camera, random_scene, rng};
use splat_render::cpu::Cpu;

const BOUNDS: Bounds = Bounds { picture: 2e-6, gradient: 1e-4 };

/// Pictures and gradients, on one thread to eight.
#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut rng = rng(50);
    let scene = random_scene(&mut rng, 3000, Some(2));
    let camera = random_camera(&mut rng, 130, 90);
    let on = |threads| {
        // As text, because 0 equals -0.
        let pass = || pass(&Cpu, &scene, &camera, &OPTIONS[1], Some(51));
        on_threads(threads, || format!("{:?}", pass()))
    };
    let one = on(1);
    for threads in 2..=8 {
        assert!(one == on(threads), "{threads} threads give other bits than one");
    }
}

checks_of_all! { [&Cpu]; 1000, 100 }

checks! {
    [&Cpu];
    conformance::projecting_matches_the_reference(BOUNDS);
    conformance::rasterizing_matches_the_reference(BOUNDS);
    conformance::rendering_matches_the_reference(BOUNDS);
    hard_cases::hard_scenes_agree_with_the_reference(BOUNDS);
    hard_cases::hard_splats_2d_agree_with_the_reference(BOUNDS);
    hard_cases::many_splats_in_one_tile_and_one_on_many(BOUNDS);
    hard_cases::thresholds_are_the_same_everywhere();
    hard_cases::tile_edges_are_seamless(BOUNDS);
    properties::random_pictures_match_the_reference(BOUNDS, 100);
    optimization::loss_matches_the_reference();
    optimization::adam_matches_the_reference();
}
