//! Regression checks: splats behind the camera, invalid 2D splats, and invalid options.

use splat_render::constants::{BLUR, FAR, NEAR};
use splat_render::fit::{FitDevice, FitState, Rates, StepInput, Target};
use splat_render::stages::{AdamStep, ImageGradients, Projected};
use splat_render::{Error, ProjectOptions, Stages};

use super::optimization::{full_step, random_adam, random_picture, random_target};
use super::*;

/// A 2D splat at or behind the camera's plane, or with values that are not finite, is not drawn and has
/// no gradient.
pub fn invalid_2d_splats_are_not_drawn(stages: &dyn Stages<f32>) {
    let good = random_projected(&mut rng(90), 30, 40, 30, 4.0);
    let mut without = good.clone();
    without.radii[7] = [0.0; 2];
    let expected = stages.rasterize(&without, [0.1; 3]).unwrap();
    let not_finite = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    type Spoil = fn(&mut Projected<f32>, f32);
    let cases: [(&str, Spoil, &[f32]); 5] = [
        ("depth", |p, v| p.depths[7] = v, &[0.0, -0.0, -1.0, -1e30, f32::NAN]),
        ("mean", |p, v| p.means2d[7][0] = v, &not_finite),
        ("factor", |p, v| p.factors[7][1] = v, &not_finite),
        ("radius", |p, v| p.radii[7][1] = v, &not_finite),
        ("opacity", |p, v| p.opacities[7] = v, &not_finite),
    ];
    for (name, spoil, values) in cases {
        for &value in values {
            let mut bad = good.clone();
            spoil(&mut bad, value);
            let image = stages.rasterize(&bad, [0.1; 3]).unwrap();
            assert!(image == expected, "a splat with {name} {value} is drawn");
            let v_image = random_image_gradients(&mut rng(91), image.alpha.len());
            let v = stages.rasterize_backward(&bad, [0.1; 3], &image, &v_image, true).unwrap();
            let none = v.v_means2d[7] == [0.0; 2]
                && v.v_colors[7] == [0.0; 3]
                && (v.v_opacities[7], v.v_depths[7]) == (0.0, 0.0);
            assert!(none, "a splat with {name} {value} has a gradient");
        }
    }
}

/// A near plane of 0 draws splats in front of the camera, and no others.
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
pub fn invalid_options_are_refused(stages: &dyn Stages<f32>) {
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
    type Spoil = fn(&mut Projected<f32>);
    let spoiled: [(&str, Spoil); 5] = [
        ("width, height", |p| p.width = 0),
        ("width, height", |p| (p.width, p.height) = (1 << 30, 1 << 30)),
        ("factors", |p| p.factors.truncate(4)),
        ("depths", |p| p.depths.clear()),
        ("radii", |p| p.radii.push([1.0; 2])),
    ];
    for (name, spoil) in spoiled {
        let mut bad = projected.clone();
        spoil(&mut bad);
        assert_eq!(named(stages.rasterize(&bad, [0.0; 3])), name);
        let backward = stages.project_backward(&scene.params(), &camera, &good, &bad, &v);
        assert_eq!(named(backward), name);
    }

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

/// A device with one photo and a few splats that have moments, and a step on it.
fn fitted(device: &mut dyn FitDevice) -> (FitState, StepInput) {
    let mut rng = rng(94);
    let (state, _) = random_adam(&mut rng, 130, 2);
    let camera = random_camera(&mut rng, 40, 30);
    let (first, second) = (state.first, state.second);
    let state = FitState { first, second, ..FitState::new(state.splats) };
    device.set_targets(vec![random_target(&mut rng, 40, 30, false, false)]).unwrap();
    device.upload(state.clone()).unwrap();
    let input = StepInput {
        background: [0.2; 3],
        sh_degree: 1,
        rates: full_step(1).rates,
        step: 3,
        opacity_regularizer: 0.01,
        scale_regularizer: 0.01,
        noise: 1.0,
        dropout: 0.1,
        noise_seed: 9,
        camera_gradient: true,
        ..StepInput::new(0, camera)
    };
    (state, input)
}

/// With all rates 0, a step changes no parameter and no moment; loss, statistics and the camera's
/// gradient are unaffected. Unused coefficients do not change in any step.
pub fn frozen_steps_keep_the_moments(device: &mut dyn FitDevice) {
    let (before, input) = fitted(device);
    device.step(&StepInput { rates: Rates::ZERO, ..input }).unwrap();
    let frozen = device.download().unwrap();
    assert!(frozen.splats == before.splats, "splats moved");
    assert!(frozen.first == before.first && frozen.second == before.second, "moments moved");
    assert!(frozen.stats.seen.iter().any(|&seen| seen > 0.0), "nothing was seen");
    let loss = device.loss().unwrap();
    let gradients = device.camera_gradients().unwrap();

    device.upload(before.clone()).unwrap();
    device.step(&input).unwrap();
    let moved = device.download().unwrap();
    assert!(moved.splats != before.splats && moved.first != before.first);
    assert_eq!(moved.stats, frozen.stats);
    assert_eq!(device.loss().unwrap(), loss);
    assert_eq!(device.camera_gradients().unwrap(), gradients);
    for (a, b) in [(&moved.splats, &before.splats), (&moved.first, &before.first)] {
        let rests = (0..a.len()).all(|i| a.sh[9 * i + 4..9 * i + 9] == b.sh[9 * i + 4..9 * i + 9]);
        assert!(rests, "a coefficient that is not in use moved");
    }
}

/// The last splats of a state are drawn and never changed; the rest, loss and camera are unaffected.
pub fn the_last_splats_stay(device: &mut dyn FitDevice) {
    let (before, input) = fitted(device);
    // The regularizers are means over the splats that move.
    let input = StepInput { opacity_regularizer: 0.0, scale_regularizer: 0.0, ..input };
    device.step(&input).unwrap();
    let all = device.download().unwrap();
    let (loss, gradients) = (device.loss().unwrap(), device.camera_gradients().unwrap());

    // A whole block of 64 splats, and a part of another, stay.
    for frozen in [1, 70, 129] {
        let moving = before.splats.len() - frozen;
        device.upload(FitState { frozen, ..before.clone() }).unwrap();
        device.step(&input).unwrap();
        let after = device.download().unwrap();
        assert_eq!(after.frozen, frozen);
        let [head, tail]: [Vec<usize>; 2] = [(0..moving).collect(), (moving..130).collect()];
        for (after, all, before) in [
            (&after.splats, &all.splats, &before.splats),
            (&after.first, &all.first, &before.first),
            (&after.second, &all.second, &before.second),
        ] {
            assert!(after.select(&head) == all.select(&head), "{frozen}: the moving splats differ");
            assert!(after.select(&tail) == before.select(&tail), "{frozen}: a frozen one moved");
        }
        assert_eq!(device.loss().unwrap(), loss);
        assert_eq!(device.camera_gradients().unwrap(), gradients);
    }
    let none = FitState { frozen: 130, ..before };
    assert!(none.validate().unwrap_err().to_string().contains("frozen_splats"));
}

/// Steps that make no sense are refused by every device, and change nothing.
pub fn invalid_steps_are_refused(device: &mut dyn FitDevice) {
    let (before, input) = fitted(device);
    let turned = Camera { width: 30, height: 40, ..input.camera };
    let nowhere = Camera { fx: f64::NAN, ..input.camera };
    for (name, step) in [
        ("view", StepInput { view: 1, ..input }),
        ("camera", StepInput { camera: turned, ..input }),
        ("K", StepInput { camera: nowhere, ..input }),
        ("dropout", StepInput { dropout: 1.0, ..input }),
        ("dropout", StepInput { dropout: f32::NAN, ..input }),
        ("ssim_weight", StepInput { ssim_weight: 1.5, ..input }),
        ("step", StepInput { step: 0, ..input }),
        ("noise", StepInput { noise: f32::NAN, ..input }),
        ("rates", StepInput { rates: Rates { means: -1.0, ..input.rates }, ..input }),
    ] {
        assert_eq!(named(device.step(&step)), name);
    }
    assert!(device.download().unwrap() == before, "a refused step changed something");
}
