//! The reference's gradients against central differences, for every kind of parameter, the camera
//! and the loss, on random small scenes. Samples within a step of a kink are redrawn and counted.

mod common;

use common::optimization::{full_step, random_adam, random_depth, random_picture, random_target};
use common::{Convert, rng, widen};
use glam::{DMat4, DQuat, DVec3};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use splat_render::fit::{Rates, Target, TargetDepth};
use splat_render::reference::{Reference, decisions};
use splat_render::sh::coeffs;
use splat_render::splats::SplatArrays;
use splat_render::stages::{AdamState, AdamStep, DepthLoss, Exposure, Projected};
use splat_render::{Camera, Image, ImageGradients, ProjectOptions, SplatGradients, Stages};

const SCENES: u64 = 240;
const SAMPLES_PER_KIND: usize = 3;
const STEP: f64 = 2e-6;
const BOUND: f64 = 1e-6;
const KINDS: [&str; 9] = [
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "background",
    "viewmat",
    "intrinsics xy",
    "intrinsics c",
];

#[derive(Clone)]
struct Scene {
    splats: common::Scene<f64>,
    antialiased: bool,
    background: [f64; 3],
    camera: Camera,
    v_image: ImageGradients<f64>,
}

impl Scene {
    fn random(seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let n = rng.random_range(3..9usize);
        let (width, height) = (rng.random_range(6..14u32), rng.random_range(6..14u32));
        let degree = [None, Some(0), Some(1), Some(2), Some(3), Some(4)][(seed % 6) as usize];
        let raw = seed.is_multiple_of(2);
        let mut f = |low: f64, high: f64| rng.random_range(low..high);
        let rows = n * degree.map_or(1, coeffs);
        let fov = f(0.5, 1.6);
        let focal = 0.5 * f64::from(width) / (0.5 * fov).tan();
        // Wide offsets, so that some splats lie beyond the Jacobian's limits.
        let means = (0..n).map(|_| [f(-1.6, 1.6), f(-1.6, 1.6), f(-1.0, 1.5)]).collect();
        let quats = (0..n).map(|_| std::array::from_fn(|_| f(-1.0, 1.0))).collect();
        let scale = |s: f64| if raw { s } else { s.exp() };
        let scales = (0..n).map(|_| std::array::from_fn(|_| scale(f(-2.5, 0.3)))).collect();
        // Some saturate the cap.
        let opacities = (0..n).map(|_| if raw { f(-2.0, 7.0) } else { f(0.05, 1.0) }).collect();
        let colors = (0..rows).map(|_| std::array::from_fn(|_| f(-0.7, 0.9))).collect();
        let rotation =
            DQuat::from_euler(glam::EulerRot::XYZ, f(-0.3, 0.3), f(-0.3, 0.3), f(-3.0, 3.0));
        let translation = DVec3::new(f(-0.2, 0.2), f(-0.2, 0.2), f(1.4, 3.0));
        let camera = Camera {
            viewmat: DMat4::from_rotation_translation(rotation, translation),
            fx: focal * f(0.9, 1.1),
            fy: focal * f(0.9, 1.1),
            cx: f64::from(width) * f(0.3, 0.7),
            cy: f64::from(height) * f(0.3, 0.7),
            width,
            height,
        };
        let pixels = (width * height) as usize;
        Self {
            splats: common::Scene {
                means,
                quats,
                scales,
                opacities,
                colors,
                sh_degree: degree.unwrap_or(0),
                sh_stride: degree.map_or(0, coeffs),
                raw,
            },
            antialiased: (seed / 6).is_multiple_of(2),
            background: std::array::from_fn(|_| f(0.0, 1.0)),
            camera,
            v_image: ImageGradients {
                v_color: (0..pixels).map(|_| std::array::from_fn(|_| f(-1.0, 1.0))).collect(),
                v_alpha: (0..pixels).map(|_| f(-1.0, 1.0)).collect(),
                v_depth: (0..pixels).map(|_| f(-0.3, 0.3)).collect(),
            },
        }
    }

    fn options(&self) -> ProjectOptions {
        ProjectOptions { antialiased: self.antialiased, ..ProjectOptions::default() }
    }

    fn draw(&self) -> (Projected<f64>, Image<f64>) {
        let (splats, camera) = (self.splats.params(), &self.camera);
        let projected = Reference.project(&splats, camera, &self.options()).unwrap();
        let image = Reference.rasterize(&projected, self.background).unwrap();
        (projected, image)
    }

    /// The loss, a fixed linear function of the picture, and the decisions taken.
    fn loss(&self) -> (f64, u64) {
        let (projected, image) = self.draw();
        let mut loss = 0.0;
        for pixel in 0..image.alpha.len() {
            for c in 0..3 {
                loss += image.color[pixel][c] * self.v_image.v_color[pixel][c];
            }
            loss += image.alpha[pixel] * self.v_image.v_alpha[pixel];
            loss += image.depth[pixel] * self.v_image.v_depth[pixel];
        }
        (loss, decisions(&self.splats.params(), &self.camera, &self.options(), &projected))
    }

    fn gradients(&self) -> (SplatGradients<f64>, [f64; 3]) {
        let (projected, image) = self.draw();
        let v = Reference
            .rasterize_backward(&projected, self.background, &image, &self.v_image, false)
            .unwrap();
        let (splats, camera) = (self.splats.params(), &self.camera);
        let gradients =
            Reference.project_backward(&splats, camera, &self.options(), &projected, &v).unwrap();
        (gradients, v.v_background)
    }

    fn entry(&mut self, kind: usize, index: usize) -> &mut f64 {
        match kind {
            0 => &mut self.splats.means.as_flattened_mut()[index],
            1 => &mut self.splats.quats.as_flattened_mut()[index],
            2 => &mut self.splats.scales.as_flattened_mut()[index],
            3 => &mut self.splats.opacities[index],
            4 => &mut self.splats.colors.as_flattened_mut()[index],
            5 => &mut self.background[index],
            6 => &mut self.camera.viewmat.as_mut()[index % 4 * 4 + index / 4],
            7 if index == 0 => &mut self.camera.fx,
            7 => &mut self.camera.fy,
            _ if index == 0 => &mut self.camera.cx,
            _ => &mut self.camera.cy,
        }
    }

    fn flat(&self, kind: usize, gradients: &(SplatGradients<f64>, [f64; 3])) -> Vec<f64> {
        let (g, v_background) = gradients;
        match kind {
            0 => g.v_means.as_flattened().to_vec(),
            1 => g.v_quats.as_flattened().to_vec(),
            2 => g.v_scales.as_flattened().to_vec(),
            3 => g.v_opacities.clone(),
            4 => g.v_colors.as_flattened().to_vec(),
            5 => v_background.to_vec(),
            6 => g.v_viewmat.as_flattened().to_vec(),
            7 => g.v_intrinsics[..2].to_vec(),
            _ => g.v_intrinsics[2..].to_vec(),
        }
    }
}

/// Central difference of a loss by one entry of its argument, with step `h`.
fn slope<A>(
    argument: &mut A,
    entry: impl Fn(&mut A) -> &mut f64,
    h: f64,
    loss: impl Fn(&A) -> f64,
) -> f64 {
    let value = *entry(argument);
    *entry(argument) = value + h;
    let high = loss(argument);
    *entry(argument) = value - h;
    let low = loss(argument);
    *entry(argument) = value;
    (high - low) / (2.0 * h)
}

#[test]
fn gradients_match_central_differences() {
    let mut worst = [0.0f64; KINDS.len()];
    let (mut samples, mut redrawn) = (0usize, 0usize);
    for seed in 0..SCENES {
        let mut scene = Scene::random(seed);
        let gradients = scene.gradients();
        let (_, at) = scene.loss();
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0x5eed);
        for kind in 0..KINDS.len() {
            let analytic = scene.flat(kind, &gradients);
            let largest = analytic.iter().fold(0.0f64, |a, v| a.max(v.abs()));
            assert!(largest.is_finite(), "{} of scene {seed} is not finite", KINDS[kind]);
            if largest == 0.0 {
                continue;
            }
            let mut done = 0;
            for _ in 0..SAMPLES_PER_KIND * 10 {
                if done == SAMPLES_PER_KIND {
                    break;
                }
                let index = rng.random_range(0..analytic.len());
                let value = *scene.entry(kind, index);
                *scene.entry(kind, index) = value + STEP;
                let (high, above) = scene.loss();
                *scene.entry(kind, index) = value - STEP;
                let (low, below) = scene.loss();
                *scene.entry(kind, index) = value;
                if above != at || below != at {
                    redrawn += 1;
                    continue;
                }
                let numeric = (high - low) / (2.0 * STEP);
                let error = (numeric - analytic[index]).abs() / largest;
                assert!(
                    error <= BOUND,
                    "scene {seed}, {}[{index}]: {} analytic, {numeric} numeric, {error:.1e} of the largest",
                    KINDS[kind],
                    analytic[index],
                );
                worst[kind] = worst[kind].max(error);
                done += 1;
                samples += 1;
            }
        }
    }
    println!("{SCENES} scenes, {samples} samples, {redrawn} redrawn at kinks");
    for (kind, error) in KINDS.iter().zip(worst) {
        println!("{kind:>14}: worst {error:.1e} of the largest of its kind");
    }
    assert!(samples > SCENES as usize * KINDS.len() * 2, "too few samples away from kinks");
}

/// A photo with or without alpha and weights, and a picture of its size.
fn photo_and_picture(seed: u64) -> (Target, Image<f64>) {
    let mut rng = rng(seed);
    let (width, height) = (rng.random_range(1..18u32), rng.random_range(1..18u32));
    let (alpha, weighted) = (seed.is_multiple_of(2), seed.is_multiple_of(3));
    let target = random_target(&mut rng, width, height, alpha, weighted);
    (target, widen(&random_picture(&mut rng, width, height)))
}

#[test]
fn the_loss_s_gradient_matches_central_differences() {
    let background = [0.2, 0.7, 0.4];
    let (mut worst, mut samples) = (0.0f64, 0);
    for seed in 0..60 {
        let (target, mut image) = photo_and_picture(seed);
        let ssim_weight = [0.2, 0.0, 1.0][(seed % 3) as usize];
        let loss =
            |image: &Image<f64>| Reference.loss(image, &target, background, ssim_weight).unwrap();
        let analytic = loss(&image).v_color;
        let largest = analytic.as_flattened().iter().fold(0.0f64, |a, v| a.max(v.abs()));
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0x5eed);
        for _ in 0..12 {
            let (pixel, c) = (rng.random_range(0..image.color.len()), rng.random_range(0..3));
            let numeric =
                slope(&mut image, |image| &mut image.color[pixel][c], 1e-6, |x| loss(x).value);
            let error = (numeric - analytic[pixel][c]).abs() / largest;
            // Within a step of the photo's color the distance has its kink; bytes are that far
            // from random numbers.
            assert!(error <= 1e-6, "seed {seed}, pixel {pixel}, channel {c}: {error:.1e}");
            worst = worst.max(error);
            samples += 1;
        }
    }
    println!("{samples} samples: worst {worst:.1e} of the largest");
}

/// Through the loss, of everything that a corrected picture is made from.
#[test]
fn the_exposure_s_gradients_match_central_differences() {
    let mut worst = 0.0f64;
    for seed in 0..40 {
        let (target, mut image) = photo_and_picture(seed);
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0xe5e);
        image.transmittance.iter_mut().for_each(|t| *t = rng.random());
        let background = [0.2, 0.7, 0.4];
        // So that no color is cut.
        let mut exposure = Exposure {
            gain: std::array::from_fn(|_| rng.random_range(0.4..0.8)),
            offset: std::array::from_fn(|_| rng.random_range(0.02..0.15)),
            background: (target.channels == 4).then_some(background),
        };
        let loss = |image: &Image<f64>, exposure: &Exposure<f64>| {
            let color = Reference.exposure(image, exposure).unwrap();
            let corrected = Image { color, ..image.clone() };
            Reference.loss(&corrected, &target, background, 0.2).unwrap()
        };
        let v = loss(&image, &exposure).v_color;
        let analytic = Reference.exposure_backward(&image, &exposure, &v).unwrap();
        let largest = analytic.v_gain.iter().fold(0.0f64, |a, v| a.max(v.abs())).max(1e-3);
        let mut check = |what: &str, slope: f64, expected: f64, largest: f64| {
            let error = (slope - expected).abs() / largest;
            assert!(error <= 1e-5, "seed {seed}, {what}: {slope} for {expected}");
            worst = worst.max(error);
        };
        let h = 1e-6;
        for c in 0..3 {
            let numeric = slope(&mut exposure, |e| &mut e.gain[c], h, |e| loss(&image, e).value);
            check("gain", numeric, analytic.v_gain[c], largest);
            let numeric = slope(&mut exposure, |e| &mut e.offset[c], h, |e| loss(&image, e).value);
            check("offset", numeric, analytic.v_offset[c], largest);
        }
        let largest = analytic.v_color.as_flattened().iter().fold(0.0f64, |a, v| a.max(v.abs()));
        let loss = |image: &Image<f64>| loss(image, &exposure).value;
        for _ in 0..6 {
            let (pixel, c) = (rng.random_range(0..image.color.len()), rng.random_range(0..3));
            let numeric = slope(&mut image, |image| &mut image.color[pixel][c], h, loss);
            check("color", numeric, analytic.v_color[pixel][c], largest);
            // Alpha is 1 - transmittance.
            let numeric = -slope(&mut image, |image| &mut image.transmittance[pixel], h, loss);
            check("alpha", numeric, analytic.v_alpha[pixel], largest);
        }
    }
    println!("worst {worst:.1e} of the largest");
}

#[test]
fn the_depth_loss_s_gradients_match_central_differences() {
    let (mut worst, mut samples) = (0.0f64, 0);
    for seed in 0..40 {
        let mut rng = rng(seed ^ 0xdeb);
        let size = (rng.random_range(1..18u32), rng.random_range(1..18u32));
        let (image, target) = random_depth(&mut rng, size);
        let mut image = widen(&image);
        image.depth.iter_mut().for_each(|depth| *depth *= rng.random_range(0.5..2.0));
        let loss = |image: &Image<f64>| Reference.depth_loss(image, &target).unwrap();
        let analytic = loss(&image);
        let pixels = image.depth.len();
        for pixel in 0..pixels {
            let apart = image.depth[pixel] / (image.alpha[pixel] * f64::from(target.depths[pixel]));
            if (apart - 1.0).abs() < 1e-3 || (image.alpha[pixel] - 0.5).abs() < 1e-3 {
                continue; // at a kink
            }
            for of_depth in [false, true] {
                let value = if of_depth { image.depth[pixel] } else { image.alpha[pixel] };
                let numeric = slope(
                    &mut image,
                    |i| if of_depth { &mut i.depth[pixel] } else { &mut i.alpha[pixel] },
                    1e-6 * value,
                    |image| loss(image).value,
                );
                let rows = if of_depth { &analytic.v_depth } else { &analytic.v_alpha };
                // Change of the loss if the number doubles, times the number of pixels.
                let error = (numeric - rows[pixel]) * value * pixels as f64;
                assert!(error.abs() <= 1e-5, "seed {seed}, pixel {pixel}: {error:.1e}");
                worst = worst.max(error.abs());
                samples += usize::from(rows[pixel] != 0.0);
            }
        }
    }
    println!("{samples} samples with a slope: worst {worst:.1e}");
    assert!(samples > 1000);
}

#[test]
fn a_depth_loss_has_its_bounds() {
    let loss = |alpha: f64, depth: f64, z: f32, confidence: f32| {
        let target = TargetDepth { depths: vec![z], confidences: vec![confidence] };
        let image = Image {
            alpha: vec![alpha],
            depth: vec![depth],
            transmittance: vec![1.0 - alpha],
            ..widen(&random_picture(&mut rng(1), 1, 1))
        };
        Reference.depth_loss(&image, &target)
    };
    let with = |alpha, depth, z, confidence| loss(alpha, depth, z, confidence).unwrap();
    // One per cent too far; on it; absurdly wrong; too clear to have a depth; not known.
    assert!((with(1.0, 2.02, 2.0, 1.0).value - 0.01).abs() < 1e-4);
    assert_eq!(
        with(0.8, 1.6, 2.0, 1.0),
        DepthLoss { value: 0.0, v_alpha: vec![0.0], v_depth: vec![0.0] }
    );
    assert!((with(1.0, 1e-9, 1e9, 1.0).value - 2.0).abs() < 1e-9);
    assert_eq!(with(0.49, 1.0, 1.0, 1.0).value, 0.0);
    assert_eq!(with(1.0, 1.0, f32::NAN, 0.0), with(0.8, 1.6, 2.0, 1.0));
    let wrong = [
        (f32::NAN, 1.0),
        (0.0, 0.5),
        (-1.0, 0.5),
        (f32::INFINITY, 1.0),
        (1.0, 1.5),
        (1.0, f32::NAN),
    ];
    for (z, confidence) in wrong {
        let error = loss(1.0, 1.0, z, confidence).unwrap_err().to_string();
        assert!(error.starts_with("target: has a depth"), "{error}");
    }
}

#[test]
fn a_cut_color_is_only_brought_back() {
    let color = vec![[0.9; 3], [0.9; 3], [0.05; 3], [0.05; 3]];
    let image = Image { color, ..widen(&random_picture(&mut rng(2), 4, 1)) };
    let exposure = Exposure { gain: [2.0; 3], offset: [-0.2; 3], background: None };
    let corrected = Reference.exposure(&image, &exposure).unwrap();
    assert_eq!(corrected, [[1.0; 3], [1.0; 3], [0.0; 3], [0.0; 3]]);
    let v = [[0.5; 3], [-0.5; 3], [0.5; 3], [-0.5; 3]];
    let back = Reference.exposure_backward(&image, &exposure, &v).unwrap();
    // Gradients pass if they bring a clamped color back into the range.
    assert_eq!(back.v_color, [[1.0; 3], [0.0; 3], [0.0; 3], [-1.0; 3]]);
    assert_eq!(back.v_offset, [0.0; 3]);
    assert!((back.v_gain[0] - 0.5 * (0.9 - 0.05)).abs() < 1e-12);
}

/// With first moments that hold only the gradient, adam's step gives the regularizers' gradients, which
/// are compared with differences of the regularizers.
#[test]
fn the_regularizers_pull_along_their_gradients() {
    let n = 9;
    let (random, gradients) = random_adam(&mut rng(5), n, 0);
    let zero = |_: f32| 0.0f64;
    let mut splats = widen(&random.splats);
    let mut state = AdamState {
        splats: splats.clone(),
        first: random.first.convert(zero),
        second: random.second.convert(zero),
    };
    let gradients = gradients.convert(zero);
    let step = AdamStep {
        number: 1,
        rates: Rates { means: 1e-3, ..Rates::ZERO },
        opacity_regularizer: 0.25,
        scale_regularizer: 0.5,
        noise: 0.0,
        ..full_step(0)
    };
    Reference.adam(&mut state, &gradients, &step).unwrap();
    // 0.25 times the mean opacity and 0.5 times the mean scale.
    let regularizers = |splats: &SplatArrays<f64>| {
        let opacities: f64 = splats.opacities.iter().map(|o| 1.0 / (1.0 + (-o).exp())).sum();
        let scales: f64 = splats.scales.as_flattened().iter().map(|s| s.exp()).sum();
        0.25 * opacities / n as f64 + 0.5 * scales / (3 * n) as f64
    };
    let part = 1.0 - f64::from(splat_render::constants::ADAM.0);
    for i in 0..n {
        for k in 0..4 {
            let numeric = slope(
                &mut splats,
                |s| if k < 3 { &mut s.scales[i][k] } else { &mut s.opacities[i] },
                1e-5,
                regularizers,
            );
            let taken = if k < 3 { state.first.scales[i][k] } else { state.first.opacities[i] };
            assert!((taken / part - numeric).abs() < 1e-9, "{} for {numeric}", taken / part);
        }
    }
}
