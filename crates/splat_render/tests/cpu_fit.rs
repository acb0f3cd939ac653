//! Whole fits on the CPU, density control included: the same seed gives the same bits, on any
//! number of threads and across an interruption.

#[macro_use]
mod common;

use common::{on_threads, photo, random_camera, random_scene, render, rng};
use splat_render::cpu::{Cpu, CpuFit};
use splat_render::fit::{
    Background, CameraConfig, CameraState, DensityControl, Exposure, FitConfig, FitDevice,
    FitState, Fitter, Focal, StepInput, Target, TargetDepth, splats_from_points,
};
use splat_render::{Camera, Error, Image, Stages};

const STEPS: u32 = 420;

/// Cameras of `scale` times 40 x 30 pixels, and their pictures of a random scene by the CPU.
fn views(scale: u32) -> (Vec<Camera>, Vec<Image<f32>>) {
    let mut rng = rng(11);
    let scene = random_scene(&mut rng, 80, Some(0));
    let camera = |_| random_camera(&mut rng, 40 * scale, 30 * scale);
    let cameras: Vec<Camera> = (0..5).map(camera).collect();
    let images = cameras.iter().map(|camera| render(&Cpu, &scene.params(), camera, [0.0; 3]));
    (cameras.clone(), images.collect())
}

/// Photos with alpha of that scene.
fn photos(scale: u32) -> (Vec<Target>, Vec<Camera>) {
    let (cameras, images) = views(scale);
    (images.iter().map(|image| photo(image, true)).collect(), cameras)
}

fn config(density: DensityControl) -> FitConfig {
    FitConfig {
        steps: 1000,
        seed: 5,
        sh_degree: 1,
        sh_interval: 100,
        max_splats: 260,
        density,
        background: Background::Random,
        dropout: 0.2,
        cameras: Some(CameraConfig { focal: Focal::Shared, ..CameraConfig::default() }),
        ..FitConfig::default()
    }
}

fn start(seed: u64) -> FitState {
    let points: Vec<[f32; 3]> = random_scene(&mut rng(seed), 150, None).means;
    FitState::new(splats_from_points(&points, &vec![[0.5; 3]; points.len()], 1).unwrap())
}

fn on_cpu(
    targets: Vec<Target>,
    cameras: Vec<Camera>,
    state: FitState,
    step: u32,
    config: FitConfig,
) -> Fitter {
    Fitter::new(Box::new(CpuFit::default()), targets, cameras, state, step, config).unwrap()
}

fn fitter(config: FitConfig, state: &FitState, step: u32) -> Fitter {
    let (targets, cameras) = photos(1);
    on_cpu(targets, cameras, state.clone(), step, config)
}

fn run(fitter: &mut Fitter, until: u32) -> FitState {
    while fitter.steps_done() < until {
        fitter.step().unwrap();
    }
    fitter.state().unwrap()
}

/// A fit that was stopped at step `cut` and resumed.
fn resumed(begin: impl Fn(&FitState, u32) -> Fitter, from: &FitState, cut: u32) -> Fitter {
    let mut first = begin(from, 0);
    let state = run(&mut first, cut);
    let mut resumed = begin(&state, cut);
    resumed.resume_cameras(first.camera_state().unwrap().unwrap()).unwrap();
    if let Some(exposures) = first.exposure_state().unwrap() {
        resumed.resume_exposures(exposures).unwrap();
    }
    resumed
}

#[test]
fn the_loss_falls_and_density_control_runs() {
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let mut fitter = fitter(config(density), &start(1), 0);
        run(&mut fitter, 5);
        let before = fitter.loss().unwrap();
        let state = run(&mut fitter, STEPS);
        let after = fitter.loss().unwrap();
        assert!(after < 0.6 * before, "{density:?}: loss {before} became {after}");
        assert_ne!(state.splats.len(), 150, "{density:?} changed nothing");
        assert!(state.splats.len() <= 260, "{density:?} went over the cap");
        assert_eq!(fitter.splat_count(), state.splats.len());
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_on_any_number_of_threads() {
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let end =
            |seed| run(&mut fitter(FitConfig { seed, ..config(density) }, &start(1), 0), STEPS);
        let on = |threads| on_threads(threads, || end(5));
        let one = on(1);
        for threads in [1, 2, 3, 8] {
            assert!(on(threads) == one, "{density:?}: {threads} threads give other bits");
        }
        assert!(end(6) != one, "{density:?}: another seed gives the same bits");
    }
}

#[test]
fn a_fit_leaves_frozen_splats_as_they_are_and_resumes() {
    let given = start(1);
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let begin = FitState { frozen: 40, ..given.clone() };
        let fit = |state: &FitState, step| fitter(config(density), state, step);
        let mut fitter = fit(&begin, 0);
        assert_eq!(fitter.splat_count(), 110);
        let end = run(&mut fitter, STEPS);
        let tail = |state: &FitState| {
            let n = state.splats.len();
            state.splats.select(&(n - 40..n).collect::<Vec<_>>())
        };
        assert!(tail(&end) == tail(&given), "{density:?} changed a frozen splat");
        assert_eq!(fitter.splat_count(), end.splats.len() - 40);
        assert!(fitter.splat_count() != 110 && fitter.splat_count() <= 260);
        let again = run(&mut resumed(fit, &begin, 310), STEPS);
        assert!(again == end, "{density:?} resumed ends otherwise");
    }
}

#[test]
fn a_resumed_fit_ends_with_the_same_bits() {
    let finish = |mut fitter: Fitter| -> (FitState, CameraState) {
        (run(&mut fitter, STEPS), fitter.camera_state().unwrap().unwrap())
    };
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let fit = |state: &FitState, step| fitter(config(density), state, step);
        let whole = finish(fit(&start(1), 0));
        // In the cameras' warm-up, within a round and at its end; before density control and after.
        for cut in [1, 20, 52, 299, 300, 357] {
            let end = finish(resumed(fit, &start(1), cut));
            assert!(end == whole, "{density:?} resumed at step {cut} ends otherwise");
        }
        for (camera, viewmat) in photos(1).1.iter().zip(&whole.1.viewmats) {
            assert!(!camera.viewmat.abs_diff_eq(*viewmat, 1e-4), "a camera stood still");
        }
    }
}

#[test]
fn a_fit_from_coarse_to_fine_resumes_with_the_same_bits() {
    let (targets, cameras) = photos(6);
    let steps = 100;
    let coarse = |state: &FitState, step| {
        let config = FitConfig { steps, coarse_to_fine: true, ..config(DensityControl::Original) };
        on_cpu(targets.clone(), cameras.clone(), state.clone(), step, config)
    };
    let mut whole = coarse(&start(1), 0);
    run(&mut whole, 31);
    let first = whole.loss().unwrap();
    let end = run(&mut whole, steps);
    assert!(whole.loss().unwrap() < first, "at the whole size the loss falls on");
    let moved = whole.cameras()[0];
    assert_eq!((moved.width, moved.height), (240, 180));
    assert!((moved.fx / cameras[0].fx - 1.0).abs() < 0.2, "the focal length is of the whole size");
    // In the reduced photos, at the change and after it; between the ends of rounds.
    for cut in [3, 29, 30, 31, 52] {
        let again = run(&mut resumed(coarse, &start(1), cut), steps);
        assert!(again == end, "resumed at step {cut} it ends otherwise");
    }
}

#[test]
fn a_photo_with_two_turns_counts_as_two_photos() {
    let (targets, cameras) = photos(1);
    let fitted = |turns: &[(usize, u32)]| {
        let targets = turns.iter().map(|&(k, turns)| Target { turns, ..targets[k].clone() });
        // One camera for all, because the scene's extent depends on the cameras.
        let cameras = vec![cameras[0]; turns.len()];
        let config = FitConfig { cameras: None, ..config(DensityControl::Mcmc) };
        let device = Box::new(CpuFit::default());
        Fitter::new(device, targets.collect(), cameras, start(1), 0, config)
            .map(|mut fitter| run(&mut fitter, 20))
    };
    let once = fitted(&[(0, 1), (1, 1), (2, 1)]).unwrap();
    let twice = fitted(&[(0, 2), (1, 1), (2, 1)]).unwrap();
    assert!(twice == fitted(&[(0, 1), (0, 1), (1, 1), (2, 1)]).unwrap());
    assert!(twice != once);
    assert!(fitted(&[(0, 0), (1, 1)]).unwrap_err().to_string().contains("images[0]: has no turn"));
}

#[test]
fn a_photo_counts_until_its_last_step() {
    let (targets, cameras) = photos(1);
    let config = FitConfig { cameras: None, ..config(DensityControl::Mcmc) };
    let fitter = |until: &[Option<u32>], state: &FitState, step: u32| {
        let targets = targets.iter().zip(until);
        let targets = targets.map(|(one, &until)| Target { until, ..one.clone() }).collect();
        let device = Box::new(CpuFit::default());
        Fitter::new(device, targets, cameras.clone(), state.clone(), step, config.clone())
    };
    let fitted =
        |until: &[Option<u32>], steps| run(&mut fitter(until, &start(1), 0).unwrap(), steps);
    let all = [None; 5];
    let leaving = [None, Some(10), Some(10), Some(10), Some(10)];
    assert!(fitted(&leaving, 10) == fitted(&all, 10));
    let whole = fitted(&leaving, 30);
    assert!(whole != fitted(&all, 30));
    // From then on it is a fit to the remaining photo.
    let half = fitted(&all, 10);
    let gone = [None, Some(0), Some(0), Some(0), Some(0)];
    assert!(run(&mut fitter(&gone, &half, 10).unwrap(), 30) == whole);
    // Also if resumed in the middle of either part.
    for cut in [4, 10, 17] {
        let mut resumed = fitter(&leaving, &fitted(&leaving, cut), cut).unwrap();
        assert!(run(&mut resumed, 30) == whole, "resumed at step {cut} it ends otherwise");
    }
    let none = fitter(&[Some(10); 5], &start(1), 0).err().unwrap().to_string();
    assert!(none.contains("images: has none that is fitted until the end"), "{none}");
}

/// A fit of exposures, from splats that are on their way, with a photo that has no exposure.
fn exposure_fitter(state: &FitState, step: u32) -> Fitter {
    let start: Vec<_> = (0..5).map(|k| (k != 1).then(Exposure::none)).collect();
    let config = FitConfig { exposures: true, ..config(DensityControl::Mcmc) };
    let mut fitter = fitter(config, state, step);
    let pulls = vec![0.1; start.len()];
    fitter.start_exposures(&start, &pulls).unwrap();
    fitter
}

#[test]
fn exposures_have_the_same_bits_on_any_number_of_threads_and_after_a_resume() {
    let end =
        |mut fitter: Fitter| (run(&mut fitter, 40), fitter.exposure_state().unwrap().unwrap());
    let [whole, threaded] =
        [1, 3].map(|threads| on_threads(threads, || end(exposure_fitter(&start(1), 0))));
    assert!(threaded == whole, "the number of threads changed bits");
    assert_ne!(whole.1.gains[0], [1.0; 3]);
    assert_eq!(whole.1.gains[1], [1.0; 3], "a photo without exposure got one");
    // Within a round, so that sums of gradients are under way.
    assert!(end(resumed(exposure_fitter, &start(1), 23)) == whole, "resumed it ends otherwise");
    let plain = fitter(config(DensityControl::Mcmc), &start(1), 0).exposure_state().unwrap();
    assert!(plain.is_none(), "a fit without exposures has some");
}

/// A fit to photos with depths, except one.
fn depth_fitter(weight: f32, state: &FitState, step: u32, cameras: Option<CameraConfig>) -> Fitter {
    let (mut targets, known) = photos(1);
    for (k, (target, depth)) in targets.iter_mut().zip(depths()).enumerate() {
        target.depth = (k != 1).then_some(depth);
    }
    let config = FitConfig { depth_weight: weight, cameras, ..config(DensityControl::Mcmc) };
    on_cpu(targets, known, state.clone(), step, config)
}

/// Depths of the photos' opaque pixels.
fn depths() -> Vec<TargetDepth> {
    let depth = |image: &Image<f32>| TargetDepth {
        depths: image.depth.iter().zip(&image.alpha).map(|(d, a)| d / a.max(1e-6)).collect(),
        confidences: image.alpha.iter().map(|&a| if a > 0.8 { 1.0 } else { 0.0 }).collect(),
    };
    views(1).1.iter().map(depth).collect()
}

#[test]
fn depths_have_the_same_bits_on_any_number_of_threads_and_after_a_resume() {
    let joint = config(DensityControl::Mcmc).cameras;
    let [whole, threaded] = [1, 3].map(|threads| {
        on_threads(threads, || run(&mut depth_fitter(0.5, &start(1), 0, joint), 40))
    });
    assert!(threaded == whole, "the number of threads changed bits");
    let mut again = resumed(|state, step| depth_fitter(0.5, state, step, joint), &start(1), 23);
    assert!(run(&mut again, 40) == whole, "resumed it ends otherwise");
    let plain = run(&mut fitter(config(DensityControl::Mcmc), &start(1), 0), 40);
    assert!(plain != whole, "depths changed nothing");
    assert!(
        run(&mut depth_fitter(0.0, &start(1), 0, joint), 40) == plain,
        "a weight of 0 changed bits"
    );
}

#[test]
fn depths_make_a_fit_more_accurate() {
    let (_, cameras) = photos(1);
    let off = |state: &FitState| {
        let loss = |(camera, depth): (&Camera, &TargetDepth)| {
            let image = render(&Cpu, &state.splats.params(1), camera, [0.0; 3]);
            Cpu.depth_loss(&image, depth).unwrap().value
        };
        cameras.iter().zip(&depths()).map(loss).sum::<f32>() / 5.0
    };
    let end = |weight: f32| off(&run(&mut depth_fitter(weight, &start(1), 0, None), 250));
    let [without, with, more] = [0.0, 1.0, 10.0].map(end);
    println!("depths off by {without} without, {with} with them, {more} with ten times as much");
    assert!(with < 0.85 * without && more < with, "{without}, {with}, {more}");
}

#[test]
fn gradients_of_cameras_and_exposures_are_slopes_of_the_loss() {
    let (matted, cameras) = photos(1);
    let plain = views(1).1.iter().map(|image| photo(image, false)).collect();
    // The loss is smooth: large splats, far from the photos' colors.
    let mut state = start(1);
    state.splats.scales.as_flattened_mut().iter_mut().for_each(|v| *v += 1.5);
    state.splats.opacities.fill(-1.0);
    state.splats.sh.as_flattened_mut().iter_mut().for_each(|v| *v += 0.3);
    let exposure = Exposure { gain: [1.3, 0.8, 1.1], offset: [0.05, -0.02, 0.1], background: None };
    let background = [0.2, 0.5, 0.7];
    for (targets, exposed, exposure) in [
        (matted.clone(), false, exposure),
        (plain, true, exposure),
        (matted, true, Exposure { background: Some(background), ..exposure }),
    ] {
        let mut device = CpuFit::default();
        device.set_targets(targets).unwrap();
        device.upload(state.clone()).unwrap();
        let camera = cameras[0];
        let mut step = |exposure: Exposure<f32>, camera: Camera| {
            // One step that changes no splat.
            let input = StepInput {
                background,
                sh_degree: 1,
                step: 1,
                dropout: 0.2,
                noise_seed: 3,
                camera_gradient: true,
                exposure: exposed.then_some(exposure),
                ..StepInput::new(0, camera)
            };
            device.step(&input).unwrap();
            let exposures = device.exposure_gradients().unwrap();
            let camera = device.camera_gradients().unwrap().pop().unwrap();
            (f64::from(device.loss().unwrap()), exposures.first().copied(), camera)
        };
        let (_, v_exposure, v_camera) = step(exposure, camera);
        let shift = v_camera.v_viewmat.map(|row| row[3]);
        let largest = |row: &[f64]| row.iter().fold(0.0f64, |a, v| a.max(v.abs()));
        type Change = fn(&mut Exposure<f32>, &mut Camera, usize, f64);
        // The camera's gradient passes through the exposure, including alpha's part.
        let mut changes: Vec<(&str, f64, Vec<f64>, Change)> =
            vec![("shift", largest(&shift), shift.to_vec(), |_, camera, k, by| {
                camera.viewmat.w_axis[k] += by
            })];
        assert_eq!(v_exposure.is_some(), exposed);
        if let Some(v) = v_exposure {
            let most = largest(&v.v_gain);
            changes.push(("gain", most, v.v_gain.to_vec(), |e, _, k, by| e.gain[k] += by as f32));
            let offset: Change = |e, _, k, by| e.offset[k] += by as f32;
            changes.push(("offset", most, v.v_offset.to_vec(), offset));
        } else {
            // The loss is rounded, and its slope is small.
            let v = 25.0 * v_camera.v_intrinsics[0];
            changes.push(("fx", v.abs() + 8e-4, vec![v], |_, c, _, by| c.fx += 25.0 * by));
        }
        for (name, largest, gradient, change) in changes {
            for (k, expected) in gradient.into_iter().enumerate() {
                let mut at = |by: f64| {
                    let (mut exposure, mut camera) = (exposure, camera);
                    change(&mut exposure, &mut camera, k, by);
                    step(exposure, camera).0
                };
                let slope = (at(2e-3) - at(-2e-3)) / 4e-3;
                let off = (slope - expected).abs();
                assert!(off < 0.03 * largest, "{name} {k}: {slope} for {expected}");
            }
        }
        assert!(device.download().unwrap().splats == state.splats, "frozen splats moved");
    }
}

#[test]
fn a_fit_that_enters_the_schedule_late_takes_a_first_step() {
    let moved = |first_step: u32| -> f32 {
        let state = start(1);
        let config = FitConfig { first_step, ..config(DensityControl::Mcmc) };
        let mut fitter = fitter(config, &state, first_step);
        let after = run(&mut fitter, first_step + 1);
        let pairs = after.splats.opacities.iter().zip(&state.splats.opacities);
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    // Adam's first step is the rate, whatever the gradient; moments taken to be old give three.
    let (begun, entered) = (moved(0), moved(550));
    assert!(begun > 1e-3 && (entered / begun - 1.0).abs() < 0.02, "{begun} and {entered}");
}

#[test]
fn pixels_of_half_the_weight_count_half() {
    let loss = |weight: Option<f32>| {
        let (mut targets, cameras) = photos(1);
        for target in &mut targets {
            target.weights = weight.map(|w| vec![w; target.pixels.len() / 4]);
        }
        let config = config(DensityControl::Mcmc);
        let mut fitter = on_cpu(targets, cameras, start(1), 0, config);
        fitter.step().unwrap();
        fitter.loss().unwrap()
    };
    let whole = loss(None);
    assert_eq!(loss(Some(1.0)), whole);
    assert!((loss(Some(0.5)) / whole - 0.5).abs() < 1e-4);
    assert_eq!(loss(Some(0.0)), 0.0);
}

#[test]
fn bad_arguments_are_named() {
    type Change = fn(&mut Vec<Target>, &mut Vec<Camera>, &mut FitConfig);
    let changes: [(&str, Change); 10] = [
        ("images: ", |targets, cameras, _| (targets.clear(), cameras.clear()).0),
        ("viewmats", |_, cameras, _| cameras.truncate(4)),
        ("images[2]", |targets, _, _| targets[2].pixels.truncate(4)),
        ("images[1]", |targets, _, _| targets[1].weights = Some(vec![f32::NAN; 1200])),
        ("viewmat", |_, cameras, _| cameras[0].viewmat.x_axis.x += 0.5),
        ("K", |_, cameras, _| cameras[0].fx = 0.0),
        ("steps", |_, _, config| config.steps = 0),
        ("first_step", |_, _, config| config.first_step = 1000),
        ("step", |_, _, config| config.first_step = 10),
        ("SH degree", |_, _, config| config.sh_degree = 2),
    ];
    for (name, change) in changes {
        let ((mut targets, mut cameras), mut config) = (photos(1), config(DensityControl::Mcmc));
        change(&mut targets, &mut cameras, &mut config);
        let device = Box::new(CpuFit::default());
        let error = Fitter::new(device, targets, cameras, start(1), 0, config).err();
        let error = error.as_ref().map_or_else(String::new, Error::to_string);
        assert!(error.contains(name), "{name}: {error}");
    }
}

#[test]
fn waiting_colors_end_with_the_same_bits() {
    let device = |most| CpuFit::default().with_color_wait(most);
    common::waiting::waiting_colors_end_with_the_same_bits(device);
}

#[test]
fn a_whole_fit_whose_colors_wait_ends_with_the_same_bits() {
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let end = |device: CpuFit| {
            let (targets, cameras) = photos(1);
            // Each camera sees a part of the scene.
            let cameras = cameras.iter().map(|c| Camera { fx: 3.0 * c.fx, fy: 3.0 * c.fy, ..*c });
            let config = config(density);
            let device = Box::new(device);
            let mut fitter =
                Fitter::new(device, targets, cameras.collect(), start(1), 0, config).unwrap();
            run(&mut fitter, STEPS)
        };
        let dense = end(CpuFit::default().with_color_wait(1));
        assert!(end(CpuFit::default()) == dense, "{density:?}: waiting changed bits");
    }
}

checks! {
    [&mut CpuFit::default()];
    agreement::frozen_steps_keep_the_moments();
    agreement::the_last_splats_stay();
    agreement::invalid_steps_are_refused();
}
