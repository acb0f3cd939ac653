//! The reference in the hard cases: what the others are compared with must get through them itself.

mod common;

use common::narrowed::Narrowed;
use common::{agreement, hard_cases, optimization, properties};

#[test]
fn no_splats_give_the_background() {
    hard_cases::no_splats_give_the_background(&Narrowed);
}

#[test]
fn poison_in_any_slot_culls_one_splat_at_most() {
    hard_cases::poison_in_any_slot_culls_one_splat_at_most(&Narrowed);
}

#[test]
fn a_zero_quaternion_culls_its_splat() {
    hard_cases::a_zero_quaternion_culls_its_splat(&Narrowed);
}

#[test]
fn thresholds_are_the_same_everywhere() {
    hard_cases::thresholds_are_the_same_everywhere(&Narrowed);
}

#[test]
fn any_values_give_finite_results() {
    properties::any_values_give_finite_results(&Narrowed, 300);
}

#[test]
fn the_order_of_splats_does_not_matter() {
    properties::the_order_of_splats_does_not_matter(&Narrowed, 24);
}

#[test]
fn culled_splats_change_nothing() {
    hard_cases::culled_splats_change_nothing(&Narrowed);
}

#[test]
fn a_far_away_scene_renders_as_one_at_the_origin() {
    hard_cases::a_far_away_scene_renders_as_one_at_the_origin(&Narrowed);
}

#[test]
fn exposure_gets_through_what_the_others_must() {
    optimization::exposure_matches_the_reference(&Narrowed);
    optimization::depth_loss_matches_the_reference(&Narrowed);
}

#[test]
fn frozen_splats_keep_their_moments() {
    optimization::frozen_splats_keep_their_moments(&Narrowed);
}

#[test]
fn depths_that_are_not_positive_are_not_drawn() {
    agreement::depths_that_are_not_positive_are_not_drawn(&Narrowed);
}

#[test]
fn a_near_plane_of_zero_draws_what_is_before_the_camera() {
    agreement::a_near_plane_of_zero_draws_what_is_before_the_camera(&Narrowed);
}

#[test]
fn senseless_options_are_refused() {
    agreement::senseless_options_are_refused(&Narrowed);
}
