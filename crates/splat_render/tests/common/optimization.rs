//! Conformance of exposure, loss and adam with the f64 reference. Each check prints its figures.

use rand::Rng;
use splat_render::fit::{Rates, Target, TargetDepth};
use splat_render::reference::Reference;
use splat_render::splats::SplatArrays;
use splat_render::stages::{AdamState, AdamStep, Exposure, Image};
use splat_render::{SplatGradients, Stages};

use super::*;

/// Largest difference of a loss, and of its gradient as a part of the largest.
const LOSS: (f64, f64) = (2e-6, 1e-4);
/// Largest difference of parameters and moments, as a part of the largest of their kind.
const ADAM: f64 = 5e-6;

/// A photo of random pixels, with or without alpha and weights.
pub fn random_target(
    rng: &mut Pcg64,
    width: u32,
    height: u32,
    alpha: bool,
    weighted: bool,
) -> Target {
    let pixels = (width * height) as usize;
    let channels = if alpha { 4 } else { 3 };
    let weight = |rng: &mut Pcg64| {
        let w = rng.random::<f32>();
        if w < 0.3 { 0.0 } else { w }
    };
    let colors = (0..pixels * channels as usize).map(|_| rng.random()).collect();
    let weights = weighted.then(|| (0..pixels).map(|_| weight(rng)).collect());
    Target { weights, ..Target::new(width, height, channels, colors) }
}

/// A picture of random colors in 0..1.
pub fn random_picture(rng: &mut Pcg64, width: u32, height: u32) -> Image<f32> {
    let pixels = (width * height) as usize;
    Image {
        width,
        height,
        color: (0..pixels).map(|_| std::array::from_fn(|_| rng.random())).collect(),
        alpha: vec![1.0; pixels],
        depth: vec![0.0; pixels],
        transmittance: vec![0.0; pixels],
    }
}

/// Losses and gradients of pictures whose sides are and are not multiples of a tile.
pub fn loss_matches_the_reference(stages: &dyn Stages<f32>) {
    let mut rng = rng(60);
    let background = [0.1f32, 0.6, 0.9];
    let sizes = [(23, 37), (40, 9), (3, 2), (1, 1), (64, 48), (130, 7), (21, 200)];
    for (k, (width, height)) in sizes.into_iter().enumerate() {
        for ssim_weight in [0.0f32, 0.2, 1.0] {
            let target = random_target(&mut rng, width, height, k % 2 == 0, k % 3 == 1);
            let image = random_picture(&mut rng, width, height);
            let what = format!("{width}x{height}, SSIM {ssim_weight}");
            let got = stages.loss(&image, &target, background, ssim_weight).unwrap();
            let wide = widen(&background);
            let expected = Reference.loss(&widen(&image), &target, wide, ssim_weight).unwrap();
            let off = (f64::from(got.value) - expected.value).abs();
            let gradient = difference(&got.v_color, &expected.v_color, &[]).relative();
            println!("{what}: loss off by {off:.1e}, gradient by {gradient:.1e} of the largest");
            assert!(off <= LOSS.0, "{what}: {} instead of {}", got.value, expected.value);
            assert!(gradient <= LOSS.1, "{what}: the gradient is {gradient:.1e} off");
        }
    }
    let masked =
        Target { weights: Some(vec![0.0; 12]), ..random_target(&mut rng, 4, 3, false, false) };
    let loss = stages.loss(&random_picture(&mut rng, 4, 3), &masked, [0.0; 3], 0.2).unwrap();
    assert_eq!(loss.value, 0.0, "a photo masked out everywhere asks for nothing");
    assert!(loss.v_color.as_flattened().iter().all(|&v| v == 0.0));
}

/// A picture with holes, an exposure of a photo with or without alpha, and gradients.
fn random_exposure(
    rng: &mut Pcg64,
    (width, height): (u32, u32),
    matted: bool,
) -> (Image<f32>, Exposure<f32>, Vec<[f32; 3]>) {
    let mut image = random_picture(rng, width, height);
    image.transmittance.iter_mut().for_each(|t| *t = rng.random::<f32>().powi(3));
    let exposure = Exposure {
        gain: std::array::from_fn(|_| rng.random_range(0.5..2.0)),
        offset: std::array::from_fn(|_| rng.random_range(-0.1..0.1)),
        background: matted.then(|| std::array::from_fn(|_| rng.random())),
    };
    let pixels = (width * height) as usize;
    let v = (0..pixels).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect();
    (image, exposure, v)
}

/// Corrected pictures and their gradients, for photos with and without alpha.
pub fn exposure_matches_the_reference(stages: &dyn Stages<f32>) {
    let mut rng = rng(61);
    for size in [(23, 37), (1, 1), (130, 7), (300, 200)] {
        for matted in [false, true] {
            let (image, exposure, v) = random_exposure(&mut rng, size, matted);
            let (wide_image, wide) = (widen(&image), widen(&exposure));
            let what = format!("{size:?}, alpha {matted}");
            let got = stages.exposure(&image, &exposure).unwrap();
            let expected = Reference.exposure(&wide_image, &wide).unwrap();
            let off = difference(&got, &expected, &[]);
            assert!(off.max <= 1e-6, "{what}: {off:?}");
            let got = stages.exposure_backward(&image, &exposure, &v).unwrap();
            let expected = Reference.exposure_backward(&wide_image, &wide, &widen(&v)).unwrap();
            let off = difference(&got.v_color, &expected.v_color, &[]).relative();
            assert!(off <= 1e-6, "{what}: v_color {off:.1e}");
            let off = difference1(&got.v_alpha, &expected.v_alpha, &[]).max;
            assert!(off <= 1e-6, "{what}: v_alpha {off:.1e}");
            // Sums of many numbers of either sign: a bound by their number.
            let scale = 1e-6 * v.len() as f64;
            for c in 0..3 {
                let gain = (got.v_gain[c] - expected.v_gain[c]).abs();
                let offset = (got.v_offset[c] - expected.v_offset[c]).abs();
                assert!(gain <= scale && offset <= scale, "{what}: {gain:.1e}, {offset:.1e}");
            }
            let again = stages.exposure_backward(&image, &exposure, &v).unwrap();
            assert!(got == again, "{what}: the same twice gave other bits");
        }
    }
    let (image, exposure, v) = random_exposure(&mut rng, (4, 3), false);
    let none = stages.exposure(&image, &Exposure::none()).unwrap();
    assert_eq!(none, image.color, "no exposure changes no bit");
    let bad = Exposure { gain: [f32::NAN; 3], ..exposure };
    let named = |error: splat_render::Error| error.to_string();
    assert!(stages.exposure(&image, &bad).map_err(named).unwrap_err().starts_with("gain"));
    let short = stages.exposure_backward(&image, &exposure, &v[1..]).map_err(named).unwrap_err();
    assert!(short.starts_with("v_corrected"), "{short}");
}

/// A partly transparent picture, and depths near its own, some unknown.
pub fn random_depth(rng: &mut Pcg64, (width, height): (u32, u32)) -> (Image<f32>, TargetDepth) {
    let mut image = random_picture(rng, width, height);
    let mut target = TargetDepth { depths: Vec::new(), confidences: Vec::new() };
    // World units of any size.
    let unit = 10.0f32.powi(rng.random_range(-3..4));
    for k in 0..image.alpha.len() {
        let transmittance = rng.random::<f32>().powi(3);
        let alpha = 1.0 - transmittance;
        let z = unit * rng.random_range(0.5f32..2.0);
        // Far apart, so that rounding does not change the slope's sign.
        let apart = if rng.random::<f32>() < 0.5 { 0.7 } else { 1.2 };
        image.transmittance[k] = transmittance;
        image.alpha[k] = alpha;
        image.depth[k] = alpha * z * apart;
        let known = rng.random::<f32>() > 0.3;
        target.depths.push(if known { z } else { f32::NAN });
        target.confidences.push(if known { rng.random::<f32>() } else { 0.0 });
    }
    (image, target)
}

/// The loss of depths with its gradients, which are summed with others' in a fit.
pub fn depth_loss_matches_the_reference(stages: &dyn Stages<f32>) {
    let mut rng = rng(62);
    for size in [(23, 37), (1, 1), (130, 7), (300, 200)] {
        let (image, target) = random_depth(&mut rng, size);
        let got = stages.depth_loss(&image, &target).unwrap();
        let expected = Reference.depth_loss(&widen(&image), &target).unwrap();
        let off = (f64::from(got.value) - expected.value).abs();
        let of_alpha = difference1(&got.v_alpha, &expected.v_alpha, &[]).relative();
        let of_depth = difference1(&got.v_depth, &expected.v_depth, &[]).relative();
        println!("{size:?}: off by {off:.1e}, gradients by {of_alpha:.1e} and {of_depth:.1e}");
        assert!(off <= 2e-6, "{size:?}: {} instead of {}", got.value, expected.value);
        assert!(of_alpha <= 1e-5 && of_depth <= 1e-5, "{size:?}: {of_alpha:.1e}, {of_depth:.1e}");
        assert!(stages.depth_loss(&image, &target).unwrap() == got, "twice gave other bits");
    }
    let (image, target) = random_depth(&mut rng, (4, 3));
    let unknown = TargetDepth { confidences: vec![0.0; 12], ..target.clone() };
    let none = stages.depth_loss(&image, &unknown).unwrap();
    assert_eq!(none.value, 0.0, "a photo without depths asks for nothing");
    assert!(none.v_alpha.iter().chain(&none.v_depth).all(|&v| v == 0.0));
    let short = TargetDepth { depths: target.depths[1..].to_vec(), ..target };
    let error = stages.depth_loss(&image, &short).unwrap_err().to_string();
    assert!(error.starts_with("target: has depths"), "{error}");
}

/// Splats under optimization, with moments of earlier steps, and gradients.
pub fn random_adam(
    rng: &mut Pcg64,
    n: usize,
    sh_degree: u32,
) -> (AdamState<f32>, SplatGradients<f32>) {
    let splats = random_scene(rng, n, Some(sh_degree)).arrays();
    let mut like = |scale: f64, square: bool| {
        let mut value = || {
            let v = scale * normal(rng);
            (if square { v * v } else { v }) as f32
        };
        SplatArrays {
            means: (0..n).map(|_| std::array::from_fn(|_| value())).collect(),
            quats: (0..n).map(|_| std::array::from_fn(|_| value())).collect(),
            scales: (0..n).map(|_| std::array::from_fn(|_| value())).collect(),
            opacities: (0..n).map(|_| value()).collect(),
            sh: (0..splats.sh.len()).map(|_| std::array::from_fn(|_| value())).collect(),
            sh_degree,
        }
    };
    let (first, second, v) = (like(0.1, false), like(0.1, true), like(1.0, false));
    let gradients = SplatGradients {
        v_means: v.means,
        v_quats: v.quats,
        v_scales: v.scales,
        v_opacities: v.opacities,
        v_colors: v.sh,
        ..SplatGradients::default()
    };
    (AdamState { splats, first, second }, gradients)
}

/// A step with every part of it in use.
pub fn full_step(sh_degree: u32) -> AdamStep {
    AdamStep {
        number: 7,
        rates: RATES,
        sh_degree,
        opacity_regularizer: 0.1,
        scale_regularizer: 0.1,
        noise: 5.0,
        noise_seed: 1234,
    }
}

fn differences(got: &SplatArrays, expected: &SplatArrays<f64>) -> [(&'static str, Difference); 5] {
    [
        ("means", difference(&got.means, &expected.means, &[])),
        ("quats", difference(&got.quats, &expected.quats, &[])),
        ("scales", difference(&got.scales, &expected.scales, &[])),
        ("opacities", difference1(&got.opacities, &expected.opacities, &[])),
        ("sh", difference(&got.sh, &expected.sh, &[])),
    ]
}

/// Parameters and moments after a step, with every SH degree in use and stored.
pub fn adam_matches_the_reference(stages: &dyn Stages<f32>) {
    for (n, stored, used) in [(1, 0, 0), (300, 1, 1), (65, 3, 3), (200, 3, 1), (64, 4, 0)] {
        let (mut state, gradients) = random_adam(&mut rng(70 + n as u64), n, stored);
        for opacity in state.splats.opacities.iter_mut().step_by(3) {
            // Faint enough to explore.
            *opacity = -7.0;
        }
        state.splats.quats[n / 2] = [0.0; 4];
        let (before, mut expected) = (state.clone(), widen(&state));
        let wide = widen(&gradients);
        let step = full_step(used);
        stages.adam(&mut state, &gradients, &step).unwrap();
        Reference.adam(&mut expected, &wide, &step).unwrap();
        let moved =
            |a: &SplatArrays, b: &SplatArrays| a.means.iter().zip(&b.means).all(|(a, b)| a != b);
        assert!(moved(&state.splats, &before.splats), "every splat moves");
        for (what, got, expected) in [
            ("parameters", &state.splats, &expected.splats),
            ("first moments", &state.first, &expected.first),
            ("second moments", &state.second, &expected.second),
        ] {
            for (kind, off) in differences(got, expected) {
                let off = off.relative();
                println!("{n} splats, SH {used} of {stored}: {what}, {kind} {off:.1e}");
                assert!(off <= ADAM, "{n} splats, SH {used} of {stored}: {what}, {kind} {off:.1e}");
            }
        }
        // Unused coefficients and their moments do not change.
        let stride = splat_render::sh::coeffs(stored);
        let rests = |a: &SplatArrays, b: &SplatArrays| {
            (0..n).all(|i| {
                let rest = i * stride + splat_render::sh::coeffs(used)..(i + 1) * stride;
                a.sh[rest.clone()] == b.sh[rest]
            })
        };
        assert!(rests(&state.splats, &before.splats) && rests(&state.first, &before.first));
        assert!(rests(&state.second, &before.second));
    }
}

/// With all rates 0, no parameter and no moment changes, and there is no noise.
pub fn frozen_splats_keep_their_moments(stages: &dyn Stages<f32>) {
    let (mut state, gradients) = random_adam(&mut rng(80), 130, 2);
    state.splats.opacities.fill(-7.0);
    let before = state.clone();
    let step = AdamStep { rates: Rates::ZERO, ..full_step(2) };
    stages.adam(&mut state, &gradients, &step).unwrap();
    assert!(state == before, "a frozen step changed something");
}
