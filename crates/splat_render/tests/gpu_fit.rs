//! Fitting on the GPU against fitting on the CPU, from the same start with the same draws.

#[macro_use]
mod common;

use std::sync::{Arc, LazyLock};

use common::optimization::random_target;
use common::*;
use rand::Rng;
use splat_render::Camera;
use splat_render::cpu::CpuFit;
use splat_render::fit::{
    DensityControl, Exposure, FitConfig, FitDevice, FitState, Fitter, Rates, StepInput, Target,
    TargetDepth,
};
use splat_render::gpu::{Gpu, GpuFit};
use splat_render::reference::Reference;

/// Photos of a random scene, their cameras, and another random scene to start from.
#[derive(Clone)]
struct Capture {
    targets: Vec<Target>,
    cameras: Vec<Camera>,
    start: FitState,
}

fn capture(seed: u64, sizes: &[(u32, u32)], splats: usize) -> Capture {
    let mut rng = rng(seed);
    let truth = widen(&random_scene(&mut rng, 60, Some(1)));
    let (mut targets, mut cameras) = (Vec::new(), Vec::new());
    for (k, &(width, height)) in sizes.iter().enumerate() {
        let camera = random_camera(&mut rng, width, height);
        let image = render(&Reference, &truth.params(), &camera, [0.0; 3]);
        let weights =
            random_target(&mut common::rng(k as u64), width, height, false, k % 3 == 2).weights;
        targets.push(Target { weights, ..photo(&image, k % 2 == 0) });
        cameras.push(camera);
    }
    let start = FitState::new(random_scene(&mut rng, splats, Some(1)).arrays());
    Capture { targets, cameras, start }
}

fn input(capture: &Capture, step: u32, noise: f32) -> StepInput {
    let view = step as usize % capture.cameras.len();
    let t = step as f32 * 0.37;
    StepInput {
        // Photos with alpha have a changing background, opaque ones black.
        background: if view.is_multiple_of(2) {
            [t.fract(), (2.0 * t).fract(), 0.5]
        } else {
            [0.0; 3]
        },
        sh_degree: u32::from(step > 20),
        rates: RATES,
        step,
        opacity_regularizer: 0.01,
        scale_regularizer: 0.01,
        noise,
        dropout: if noise > 0.0 { 0.3 } else { 0.0 },
        noise_seed: step.wrapping_mul(2_654_435_761),
        camera_gradient: true,
        ..StepInput::new(view, capture.cameras[view])
    }
}

fn begin(device: &mut dyn FitDevice, capture: &Capture) {
    device.set_targets(capture.targets.clone()).unwrap();
    device.upload(capture.start.clone()).unwrap();
}

fn run(
    device: &mut dyn FitDevice,
    capture: &Capture,
    steps: u32,
    noise: f32,
) -> (FitState, Vec<f32>) {
    begin(device, capture);
    let mut losses = Vec::new();
    for step in 1..=steps {
        device.step(&input(capture, step, noise)).unwrap();
        if step == 1 || step % 50 == 0 {
            losses.push(device.loss().unwrap());
        }
    }
    (device.download().unwrap(), losses)
}

/// Poses and focal lengths as one row per step.
fn camera_rows(device: &mut dyn FitDevice) -> Vec<Vec<f64>> {
    let rows = device.camera_gradients().unwrap();
    rows.iter().map(|row| [row.v_viewmat.as_flattened(), &row.v_intrinsics].concat()).collect()
}

/// Compares camera gradients with a bound relative to each row's largest value of its kind.
fn assert_rows_close(got: &[Vec<f64>], expected: &[Vec<f64>], bound: f64) {
    assert_eq!(got.len(), expected.len());
    for (step, (got, expected)) in got.iter().zip(expected).enumerate() {
        for kinds in [0..12, 12..16] {
            let largest = expected[kinds.clone()].iter().fold(0.0f64, |a, v| a.max(v.abs()));
            for k in kinds {
                let off = (got[k] - expected[k]).abs();
                assert!(off < bound * largest, "step {step}, entry {k}: {off:.1e} of {largest}");
            }
        }
    }
}

/// One device for the tests that change nothing about it: software adapters compile kernels for
/// seconds.
static SHARED: LazyLock<Arc<Gpu>> = LazyLock::new(|| Arc::new(gpu()));

fn gpu_fit() -> GpuFit {
    GpuFit::new(Arc::clone(&SHARED))
}

/// PSNR over all photos, rendered by the reference on black.
fn psnr(capture: &Capture, state: &FitState) -> f64 {
    let wide = narrowed::widened(&state.splats.params(state.splats.sh_degree));
    let (mut total, mut count) = (0.0, 0);
    for (target, camera) in capture.targets.iter().zip(&capture.cameras) {
        let image = render(&Reference, &wide.params(), camera, [0.0; 3]);
        let mut photo = vec![0.0; target.width as usize];
        for (row, colors) in image.color.chunks(photo.len()).enumerate() {
            for c in 0..3 {
                target.row(row, c, 0.0, &mut photo);
                for (color, &photo) in colors.iter().zip(&photo) {
                    total += (color[c].clamp(0.0, 1.0) - f64::from(photo)).powi(2);
                    count += 1;
                }
            }
        }
    }
    -10.0 * (total / f64::from(count)).log10()
}

#[test]
fn one_step_changes_the_state_as_on_the_cpu() {
    let capture = capture(1, &[(37, 29), (20, 50), (33, 16)], 80);
    for (steps, noise) in [(1, 0.0), (2, 500.0), (3, 0.0)] {
        let (expected, expected_loss) = run(&mut CpuFit::default(), &capture, steps, noise);
        let (got, loss) = run(&mut gpu_fit(), &capture, steps, noise);
        assert!((loss[0] - expected_loss[0]).abs() < 1e-5, "{loss:?} vs {expected_loss:?}");
        let close = |what: &str, got: &[f32], expected: &[f32], bound: f64| {
            let off = difference1(got, &widen(expected), &[]);
            assert!(off.relative() <= bound, "{steps} steps, {what}: {off:?}");
        };
        // Moments follow the gradients; Adam turns a gradient near zero into a whole step, so the
        // parameters themselves are compared by the mean.
        for (name, got, expected) in
            [("first", &got.first, &expected.first), ("second", &got.second, &expected.second)]
        {
            close(name, got.means.as_flattened(), expected.means.as_flattened(), 2e-3);
            close(name, got.quats.as_flattened(), expected.quats.as_flattened(), 2e-3);
            close(name, got.scales.as_flattened(), expected.scales.as_flattened(), 2e-3);
            close(name, &got.opacities, &expected.opacities, 2e-3);
            close(name, got.sh.as_flattened(), expected.sh.as_flattened(), 2e-3);
        }
        let off = difference(&got.splats.means, &widen(&expected.splats.means), &[]);
        assert!(off.mean <= 1e-5, "{steps} steps, means: {off:?}");
        let off = difference(&got.splats.sh, &widen(&expected.splats.sh), &[]);
        assert!(off.mean <= 1e-5, "{steps} steps, sh: {off:?}");
        close("grad_sum", &got.stats.grad_sum, &expected.stats.grad_sum, 2e-3);
        assert_eq!(got.stats.seen, expected.stats.seen);
    }
}

#[test]
fn cameras_get_the_gradients_that_they_get_on_the_cpu() {
    // More steps than are under way at a time, and among them some that do not find room at first.
    let steps = 40;
    let capture = capture(3, &[(64, 64); 3], 400);
    let still =
        |step: u32| StepInput { rates: Rates::ZERO, noise: 0.0, ..input(&capture, step, 0.0) };
    let rows = |device: &mut dyn FitDevice| {
        begin(device, &capture);
        let mut rows = Vec::new();
        for step in 1..=steps {
            device.step(&still(step)).unwrap();
            // The second half is asked for once, after an edit between.
            if step == steps / 2 {
                rows = camera_rows(device);
                assert_eq!(rows.len(), step as usize);
            } else if step == steps / 2 + 7 {
                device.edit(&mut |_| {}).unwrap();
            }
        }
        rows.extend(camera_rows(device));
        rows
    };
    let (expected, got) = (rows(&mut CpuFit::default()), rows(&mut gpu_fit()));
    assert_eq!((got.len(), expected.len()), (steps as usize, steps as usize));
    assert_rows_close(&got, &expected, 1e-3);
}

#[test]
fn exposures_get_the_gradients_that_they_get_on_the_cpu() {
    // Photos with and without alpha; now and then a step without an exposure; room runs out at first.
    let steps = 40;
    let capture = capture(3, &[(64, 64), (50, 70), (64, 64)], 400);
    let still = |step: u32| {
        let input = StepInput { rates: Rates::ZERO, noise: 0.0, ..input(&capture, step, 0.0) };
        let exposure = Exposure {
            gain: [1.3, 0.8, 1.0 + 0.01 * step as f32],
            offset: [0.05, -0.02, 0.0],
            background: input.view.is_multiple_of(2).then_some(input.background),
        };
        StepInput { exposure: (step % 7 != 3).then_some(exposure), ..input }
    };
    let rows = |device: &mut dyn FitDevice| {
        begin(device, &capture);
        let mut losses = Vec::new();
        for step in 1..=steps {
            device.step(&still(step)).unwrap();
            if step % 9 == 0 {
                losses.push(device.loss().unwrap());
            }
        }
        (device.exposure_gradients().unwrap(), camera_rows(device), losses)
    };
    let (expected, got) = (rows(&mut CpuFit::default()), rows(&mut gpu_fit()));
    assert_eq!((got.0.len(), got.1.len()), (expected.0.len(), steps as usize));
    assert_eq!(got.0.len(), (1..=steps).filter(|step| step % 7 != 3).count());
    for (got, expected) in got.0.iter().zip(&expected.0) {
        assert_eq!(got.view, expected.view);
        let largest = expected.v_offset.iter().fold(0.0f64, |a, v| a.max(v.abs()));
        for c in 0..3 {
            let gain = (got.v_gain[c] - expected.v_gain[c]).abs();
            let offset = (got.v_offset[c] - expected.v_offset[c]).abs();
            assert!(gain.max(offset) < 1e-3 * largest, "{got:?} for {expected:?}");
        }
    }
    assert_rows_close(&got.1, &expected.1, 1e-3);
    for (got, expected) in got.2.iter().zip(&expected.2) {
        assert!((got - expected).abs() < 1e-5, "loss {got} for {expected}");
    }
}

#[test]
fn depths_count_as_on_the_cpu_and_repeat() {
    // Photos with depths and one without; now and then a step to which depths are nothing.
    let steps = 40;
    let mut without = capture(3, &[(64, 64), (50, 70), (64, 64)], 400);
    // Some pixels opaque enough to have a depth, and some not.
    without.start.splats.opacities.iter_mut().for_each(|o| *o += 2.0);
    let mut capture = without.clone();
    let mut rng = rng(77);
    for target in capture.targets.iter_mut().step_by(2) {
        let pixels = (target.width * target.height) as usize;
        target.depth = Some(TargetDepth {
            depths: (0..pixels).map(|_| rng.random_range(1.0..8.0)).collect(),
            confidences: (0..pixels).map(|_| rng.random_range(-0.5f32..1.0).max(0.0)).collect(),
        });
    }
    let still = |step: u32| StepInput {
        rates: Rates::ZERO,
        depth_weight: if step % 5 == 2 { 0.0 } else { 0.7 },
        ..input(&capture, step, 0.0)
    };
    let rows = |device: &mut dyn FitDevice, capture: &Capture| {
        begin(device, capture);
        let mut losses = Vec::new();
        for step in 1..=steps {
            device.step(&still(step)).unwrap();
            losses.push(device.loss().unwrap());
        }
        (camera_rows(device), losses)
    };
    let (expected, got) = (rows(&mut CpuFit::default(), &capture), rows(&mut gpu_fit(), &capture));
    assert!(rows(&mut gpu_fit(), &capture) == got, "the same twice gave other bits");
    let without = rows(&mut gpu_fit(), &without);
    for k in 0..steps as usize {
        let (step, view) = (k as u32 + 1, (k + 1) % 3);
        let counts = view != 1 && step % 5 != 2;
        assert_eq!(without.1[k] != got.1[k], counts, "step {step}");
        assert_eq!(without.0[k] != got.0[k], counts, "step {step}");
        assert!((got.1[k] - expected.1[k]).abs() < 1e-5, "loss {} for {}", got.1[k], expected.1[k]);
    }
    assert_rows_close(&got.0, &expected.0, 2e-3);
}

#[test]
fn a_fit_that_clones_splits_and_prunes_ends_as_on_the_cpu_and_repeats_itself() {
    let capture = capture(2, &[(64, 64); 6], 100);
    let fit = |device: Box<dyn FitDevice>| {
        let config = FitConfig {
            steps: 400,
            seed: 3,
            sh_degree: 1,
            max_splats: 180,
            density: DensityControl::Original,
            ..FitConfig::default()
        };
        let (targets, cameras) = (capture.targets.clone(), capture.cameras.clone());
        let mut fitter =
            Fitter::new(device, targets, cameras, capture.start.clone(), 0, config).unwrap();
        let mut counts = Vec::new();
        while fitter.steps_done() < 250 {
            fitter.step().unwrap();
            if counts.last() != Some(&fitter.splat_count()) {
                counts.push(fitter.splat_count());
            }
        }
        (fitter.state().unwrap(), counts)
    };
    let (expected, cpu_counts) = fit(Box::<CpuFit>::default());
    let (got, counts) = fit(Box::new(gpu_fit()));
    println!("splats: cpu {cpu_counts:?}, gpu {counts:?}");
    assert!(counts.len() > 2 && counts.iter().any(|&n| n > 110), "{counts:?}");
    let [before, cpu, gpu] = [&capture.start, &expected, &got].map(|state| psnr(&capture, state));
    println!("start {before:.3} dB, cpu {cpu:.3} dB, gpu {gpu:.3} dB");
    assert!(cpu > before + 3.0, "the fit must improve the picture");
    assert!((cpu - gpu).abs() <= 0.1);
    let again = fit(Box::new(gpu_fit()));
    assert!((got, counts) == again, "the same fit twice gave other bits");
}

#[test]
fn every_build_of_the_kernels_fits_as_the_cpu_and_repeats_itself() {
    let capture = capture(2, &[(40, 33), (30, 50)], 120);
    let (expected, _) = run(&mut CpuFit::default(), &capture, 20, 0.0);
    let expected = psnr(&capture, &expected);
    let builds: [fn(Gpu) -> Gpu; 3] = [|gpu| gpu, Gpu::without_subgroups, Gpu::as_discrete];
    for (k, of) in builds.into_iter().enumerate() {
        let gpu = Arc::new(of(gpu()));
        let (got, losses) = run(&mut GpuFit::new(Arc::clone(&gpu)), &capture, 20, 0.0);
        let reached = psnr(&capture, &got);
        assert!((expected - reached).abs() <= 0.1, "build {k}: {reached} dB for {expected}");
        let again = run(&mut GpuFit::new(gpu), &capture, 20, 0.0);
        assert!((got, losses) == again, "build {k}: the same fit twice gave other bits");
    }
}

#[test]
fn running_out_of_room_for_pairs_changes_nothing() {
    let mut capture = capture(3, &[(128, 96), (90, 100)], 400);
    // Large splats: over 8 pairs each, so that a small device has to grow and to cut into chunks.
    for scale in capture.start.splats.scales.as_flattened_mut() {
        *scale += 2.6;
    }
    let ways: [fn(Gpu) -> Gpu; 2] = [|gpu| gpu, Gpu::as_discrete];
    for of in ways {
        let large = Arc::new(of(gpu()));
        let (whole, losses) = run(&mut GpuFit::new(Arc::clone(&large)), &capture, 20, 100.0);
        let small = of(gpu()).with_binding_limit(128 * 96 * 48);
        let (parts, losses_parts) = run(&mut GpuFit::new(Arc::new(small)), &capture, 20, 100.0);
        assert!(whole == parts && losses == losses_parts, "a smaller device gave other bits");
        // Steps that are done again do not move colors twice.
        let mut dense = GpuFit::new(large).with_color_wait(1);
        let (dense, _) = run(&mut dense, &capture, 20, 100.0);
        assert!(whole == dense, "waiting for room changed bits");
    }
}

#[test]
fn steps_after_one_without_room_are_done_again() {
    let mut capture = capture(3, &[(16, 16), (128, 96)], 400);
    for scale in capture.start.splats.scales.as_flattened_mut() {
        *scale += 2.6;
    }
    // The small photo's pairs fit, the large one's do not: many steps later the host sees it.
    let large = |step| step >= 20;
    let input = |step| StepInput {
        step,
        camera_gradient: false,
        ..input(&capture, 2 * step + u32::from(large(step)), 100.0)
    };
    let run = |mut device: GpuFit, has_room: bool| {
        begin(&mut device, &capture);
        if has_room {
            device.step(&input(20)).unwrap();
            begin(&mut device, &capture);
        }
        for step in 1..=70 {
            device.step(&input(step)).unwrap();
        }
        (device.loss().unwrap(), device.download().unwrap())
    };
    let few = |gpu: Gpu| GpuFit::new(Arc::new(gpu)).with_color_wait(30);
    let expected = run(few(gpu()), true);
    assert!(run(few(gpu()), false) == expected, "steps that were done again gave other bits");
}

#[test]
fn measured_steps_have_the_same_bits_and_a_time_for_each_command() {
    let capture = capture(2, &[(40, 33)], 120);
    let (expected, _) = run(&mut gpu_fit(), &capture, 4, 0.0);
    let mut device = gpu_fit();
    device.measure_commands(true).unwrap();
    let (measured, _) = run(&mut device, &capture, 4, 0.0);
    assert!(measured == expected, "measuring changed bits");
    let times = device.command_times();
    assert!(times.len() >= 4, "{}", times.len());
    for step in &times {
        let names: Vec<_> = step.iter().map(|time| time.name).collect();
        for name in ["copy", "project", "rasterize_backward", "fit_geometry"] {
            assert!(names.contains(&name), "{name} is not in {names:?}");
        }
        assert!(step.iter().all(|time| time.ms >= 0.0));
        assert!(step.iter().map(|time| time.ms).sum::<f64>() > 0.0);
    }
    assert!(device.command_times().is_empty());
    let error = CpuFit::default().measure_commands(true).unwrap_err().to_string();
    assert!(error.contains("choose gpu"), "{error}");
}

#[test]
fn missing_splats_are_named() {
    let capture = capture(4, &[(20, 20)], 5);
    let mut device = gpu_fit();
    device.set_targets(capture.targets.clone()).unwrap();
    let error = device.step(&input(&capture, 1, 0.0)).unwrap_err().to_string();
    assert!(error.starts_with("splats: "), "{error}");
}

/// A step makes no buffer, bind group or pipeline, and memory per splat stays within the documented sum.
#[test]
fn steps_allocate_nothing_and_memory_grows_as_stated() {
    // A separate device, because it counts allocations.
    let gpu = Arc::new(gpu());
    let bytes_of = |splats: usize| {
        let capture = capture(5, &[(64, 48), (50, 50)], splats);
        let (_, before) = gpu.made();
        let mut fit = GpuFit::new(Arc::clone(&gpu));
        begin(&mut fit, &capture);
        let (_, bytes) = gpu.made();
        for step in 1..=10 {
            fit.step(&input(&capture, step, 0.0)).unwrap();
        }
        // The state on the device is read for density control and checkpoints, not in steps.
        fit.loss().unwrap();
        let (made, _) = gpu.made();
        let (writes, waits) = (gpu.host_writes(), gpu.host_waits());
        for step in 11..=100 {
            let input = input(&capture, step, 0.0);
            fit.step(&StepInput { camera_gradient: false, ..input }).unwrap();
        }
        // A write in a step; a write and a wait when waiting colors are brought up to date, here for a
        // higher SH degree.
        let written = gpu.host_writes() - writes;
        assert!((90..=92).contains(&written), "the host wrote {written} times in 90 steps");
        assert_eq!(gpu.host_waits() - waits, 1);
        let (made_later, _) = gpu.made();
        assert_eq!(made_later, made, "steps 11 to 100 made buffers, bind groups or pipelines");
        bytes - before
    };
    let (few, many) = (1500, 3000);
    let per_splat = (bytes_of(many) - bytes_of(few)) as f64 / (many - few) as f64;
    // 11 floats of geometry and 12 of color (SH 1): values and two moments; notes, 2D splat and its
    // gradient, depth keys, order and offsets; room for 4 pairs of 60 bytes.
    let parameters = 3.0 * (11.0 + 12.0);
    let stated = 4.0 * (parameters + 9.0 + 12.0 + 10.0 + 2.0 + 2.0 + 1.0) + 4.0 * 60.0;
    println!("{per_splat:.1} bytes per splat, stated {stated}");
    assert!(per_splat <= stated + 2.0, "{per_splat} bytes per splat, stated {stated}");
}

#[test]
fn waiting_colors_end_with_the_same_bits() {
    let device = |most| gpu_fit().with_color_wait(most);
    common::waiting::waiting_colors_end_with_the_same_bits(device);
}

checks! {
    [&mut gpu_fit()];
    agreement::frozen_steps_keep_the_moments();
    agreement::the_last_splats_stay();
    agreement::invalid_steps_are_refused();
}
