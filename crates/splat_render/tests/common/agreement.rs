//! Where implementations once differed: splats behind the camera, 2D splats that no stage made, and
//! options that make no sense.

use splat_render::constants::{BLUR, FAR, NEAR};
use splat_render::fit::Target;
use splat_render::stages::{AdamStep, ImageGradients, Projected};
use splat_render::{Error, ProjectOptions, Stages};

use super::optimisation::{full_step, random_adam, random_picture, random_target};
use super::*;

/// A 2D splat at or behind the camera's plane is not drawn and has no gradient.
pub fn depths_that_are_not_positive_are_not_drawn(stages: &dyn Stages<f32>) {
    let good = random_projected(&mut rng(90), 30, 40, 30, 4.0);
    let mut without = good.clone();
    without.radii[7] = [0.0; 2];
    let expected = stages.rasterize(&without, [0.1; 3]).unwrap();
    for depth in [0.0, -0.0, -1.0, -1e30, f32::NAN] {
        let mut behind = good.clone();
        behind.depths[7] = depth;
        let image = stages.rasterize(&behind, [0.1; 3]).unwrap();
        assert!(image == expected, "a splat at depth {depth} is drawn");
        let v_image = random_image_gradients(&mut rng(91), image.alpha.len());
        let v = stages.rasterize_backward(&behind, [0.1; 3], &image, &v_image, true).unwrap();
        let none = v.v_means2d[7] == [0.0; 2]
            && v.v_colors[7] == [0.0; 3]
            && (v.v_opacities[7], v.v_depths[7]) == (0.0, 0.0);
        assert!(none, "a splat at depth {depth} has a gradient");
    }
}

/// A near plane of 0 draws what lies before the camera, and only that.
pub fn a_near_plane_of_zero_draws_what_is_before_the_camera(stages: &dyn Stages<f32>) {
    let mut rng = rng(92);
    let mut scene = random_scene(&mut rng, 6, Some(1));
    let camera = Camera { viewmat: DMat4::IDENTITY, ..random_camera(&mut rng, 40, 30) };
    let depths = [-1.0, -1e-6, 0.0, -0.0, 1e-3, 1.0];
    for (i, z) in depths.into_iter().enumerate() {
        (scene.means[i], scene.opacities[i]) = ([0.0, 0.0, z], 2.0);
        scene.scales[i] = [-8.0; 3];
    }
    let options = ProjectOptions { near: 0.0, ..ProjectOptions::default() };
    let projected = stages.project(&scene.params(), &camera, &options).unwrap();
    let drawn: Vec<bool> = projected.radii.iter().map(|r| *r != [0.0; 2]).collect();
    assert_eq!(drawn, [false, false, false, false, true, true]);
}

/// The argument that an error names.
fn named<T>(result: splat_render::Result<T>) -> String {
    match result.map(|_| ()) {
        Err(Error::Argument { argument, .. }) => argument,
        other => panic!("{other:?}"),
    }
}

/// Settings and sizes that make no sense are refused by every stage that takes them.
pub fn senseless_options_are_refused(stages: &dyn Stages<f32>) {
    let mut rng = rng(93);
    let scene = random_scene(&mut rng, 5, Some(1));
    let camera = random_camera(&mut rng, 20, 10);
    let good = ProjectOptions { near: NEAR, far: FAR, blur: BLUR, antialiased: false };
    let projected = stages.project(&scene.params(), &camera, &good).unwrap();
    let v = random_projected_gradients(&mut rng, &projected);
    for (name, options) in [
        ("near", ProjectOptions { near: -0.1, ..good }),
        ("near", ProjectOptions { near: f32::NAN, ..good }),
        ("far", ProjectOptions { far: NEAR, ..good }),
        ("far", ProjectOptions { far: f32::NAN, ..good }),
        ("blur", ProjectOptions { blur: -1e-3, ..good }),
        ("blur", ProjectOptions { blur: f32::INFINITY, ..good }),
    ] {
        assert_eq!(named(stages.project(&scene.params(), &camera, &options)), name, "{options:?}");
        let backward = stages.project_backward(&scene.params(), &camera, &options, &projected, &v);
        assert_eq!(named(backward), name, "{options:?}");
    }
    let no_size = Projected { width: 0, ..projected.clone() };
    let backward = stages.project_backward(&scene.params(), &camera, &good, &no_size, &v);
    assert_eq!(named(backward), "width, height");

    // The same number of pixels, otherwise laid out.
    let mut image = stages.rasterize(&projected, [0.0; 3]).unwrap();
    (image.width, image.height) = (image.height, image.width);
    let v_image = random_image_gradients(&mut rng, image.alpha.len());
    let backward = stages.rasterize_backward(&projected, [0.0; 3], &image, &v_image, false);
    assert_eq!(named(backward), "image");
    (image.width, image.height) = (image.height, image.width);
    let none = ImageGradients::default();
    let backward = stages.rasterize_backward(&projected, [0.0; 3], &image, &none, false);
    assert_eq!(named(backward), "v_color");

    let (picture, target) =
        (random_picture(&mut rng, 8, 6), random_target(&mut rng, 8, 6, true, false));
    let turned = Target { width: 6, height: 8, ..target.clone() };
    assert_eq!(named(stages.loss(&picture, &turned, [0.0; 3], 0.2)), "image");
    for weight in [-0.1, 1.1, f32::NAN] {
        assert_eq!(named(stages.loss(&picture, &target, [0.0; 3], weight)), "ssim_weight");
    }

    let (mut state, gradients) = random_adam(&mut rng, 5, 1);
    let step = full_step(1);
    for (name, step) in [
        ("step", AdamStep { number: 0, ..step }),
        ("noise", AdamStep { noise: -1.0, ..step }),
        ("noise", AdamStep { noise: f32::NAN, ..step }),
        ("opacity_regularizer", AdamStep { opacity_regularizer: f32::INFINITY, ..step }),
        ("scale_regularizer", AdamStep { scale_regularizer: -1.0, ..step }),
    ] {
        assert_eq!(named(stages.adam(&mut state, &gradients, &step)), name);
    }
    let mut short = gradients.clone();
    short.v_quats.pop();
    assert_eq!(named(stages.adam(&mut state, &short, &step)), "v_quats");
    state.second.opacities.pop();
    assert_eq!(named(stages.adam(&mut state, &gradients, &step)), "opacities");
}
