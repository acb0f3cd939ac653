//! The checks that do not compare with the reference, run on the reference itself.

#[macro_use]
mod common;

use common::narrowed::Narrowed;

checks! {
    [&Narrowed];
    hard_cases::no_splats_give_the_background();
    hard_cases::an_invalid_number_culls_one_splat_at_most();
    hard_cases::a_zero_quaternion_culls_its_splat();
    hard_cases::thresholds_are_the_same_everywhere();
    properties::any_values_give_finite_results(300);
    properties::the_order_of_splats_does_not_matter(24);
    hard_cases::culled_splats_change_nothing();
    hard_cases::a_far_away_scene_renders_as_one_at_the_origin();
    optimization::exposure_matches_the_reference();
    optimization::depth_loss_matches_the_reference();
    optimization::frozen_splats_keep_their_moments();
    agreement::invalid_2d_splats_are_not_drawn();
    agreement::a_near_plane_of_zero_draws_what_is_before_the_camera();
    agreement::invalid_options_are_refused();
}
