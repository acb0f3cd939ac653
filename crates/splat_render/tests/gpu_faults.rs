//! Injected faults of an adapter: the error message, the state that is kept, and recovery.

mod common;

use std::sync::Arc;

use common::*;
use splat_render::fit::{FitDevice, FitState, McmcRun, OriginalRun, StepInput, Target};
use splat_render::gpu::{Gpu, GpuFit, Injected, needed_limits};
use splat_render::gpu_check::{open_tested_with, self_test};
use splat_render::{Camera, Error};

fn faulty(injected: &Injected) -> Gpu {
    Gpu::with_faults(true, injected).unwrap_or_else(|e| panic!("{e}"))
}

fn message(result: splat_render::Result<()>) -> String {
    match result {
        Err(error @ Error::Device(_)) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_sound_device_passes() {
    let whole = gpu();
    let began = std::time::Instant::now();
    whole.compile_all().unwrap_or_else(|e| panic!("{e}"));
    println!("kernels compiled in {:?}", began.elapsed());
    let began = std::time::Instant::now();
    self_test(&Arc::new(whole)).unwrap_or_else(|e| panic!("{e}"));
    println!("self-test in {:?}", began.elapsed());
    let plain = gpu().without_subgroups();
    self_test(&Arc::new(plain)).unwrap_or_else(|e| panic!("{e}"));
}

#[test]
fn a_shader_that_does_not_compile_is_found_on_opening() {
    let injected = Injected { bad_shader: true, ..Injected::default() };
    let found = message(self_test(&Arc::new(faulty(&injected))));
    assert!(found.contains("backend gpu: ") && found.contains("Shader"), "{found}");
    assert!(!found.contains('\n'), "{found}");
    assert!(matches!(open_tested_with(true, &injected), Err(Error::Device(_))));
}

#[test]
fn wrong_values_are_found_and_the_stage_is_named() {
    let injected = Injected { wrong_values: true, ..Injected::default() };
    let gpu = Arc::new(faulty(&injected));
    let found = message(self_test(&gpu));
    assert!(found.contains("computes wrong values: rasterize is off by"), "{found}");
    assert!(found.contains(&gpu.name()), "{found}");
}

/// No kernel for GPUs was run on more than one GPU: if they fail on another, it is used with the plain ones.
#[test]
fn plain_kernels_replace_those_for_gpus_if_these_fail() {
    let injected = Injected { wrong_blocks: true, ..Injected::default() };
    let found = message(self_test(&Arc::new(faulty(&injected))));
    assert!(found.contains("computes wrong values: rasterize"), "{found}");
    let gpu = open_tested_with(true, &injected).unwrap_or_else(|e| panic!("{e}"));
    assert!(
        !gpu.has_gpu_kernels() && gpu.fallback() == Some(found.as_str()),
        "{:?}",
        gpu.fallback()
    );
    let injected = Injected { wrong_values: true, ..injected };
    assert!(message(open_tested_with(true, &injected).map(drop)).contains("rasterize"));
}

#[test]
fn an_adapter_below_the_limits_is_refused_by_the_limit() {
    let injected = Injected::default().with_low_limits();
    let found = message(Gpu::with_faults(true, &injected).map(drop));
    assert!(
        found.contains("max_storage_buffers_per_shader_stage is 4, but igsr needs 8"),
        "{found}"
    );
}

#[test]
fn an_adapter_with_the_smallest_limits_passes() {
    let injected = Injected { limits: Some(needed_limits()), ..Injected::default() };
    self_test(&Arc::new(faulty(&injected))).unwrap_or_else(|e| panic!("{e}"));
    let mut fit = Fit::new(&Arc::new(faulty(&injected)), 200);
    (1..20).for_each(|step| fit.step(step).unwrap());
    assert_eq!(fit.device.download().unwrap().splats.len(), 200);
}

struct Fit {
    device: GpuFit,
    camera: Camera,
}

impl Fit {
    fn new(gpu: &Arc<Gpu>, splats: usize) -> Self {
        let mut rng = rng(3);
        let scene = random_scene(&mut rng, splats, Some(1));
        let camera = random_camera(&mut rng, 128, 96);
        let mut device = GpuFit::new(Arc::clone(gpu));
        let photo = Target::new(128, 96, 3, vec![90; 3 * 128 * 96]);
        device.set_targets(vec![photo]).unwrap();
        device.upload(FitState::new(scene.arrays())).unwrap();
        Self { device, camera }
    }

    /// Makes the splats as wide as the picture: the pairs of those before the camera outgrow the first
    /// guess of four per splat.
    fn make_wide(&mut self) {
        let mut state = self.device.download().unwrap();
        state.splats.scales.fill([3.0; 3]);
        state.splats.opacities.fill(0.0);
        self.device.upload(state).unwrap();
    }

    fn step(&mut self, step: u32) -> splat_render::Result<()> {
        self.device.step(&StepInput {
            sh_degree: 1,
            rates: RATES,
            step,
            opacity_regularizer: 0.01,
            scale_regularizer: 0.01,
            noise_seed: step,
            ..StepInput::new(0, self.camera)
        })
    }
}

#[test]
fn a_lost_device_is_one_message_and_the_next_device_works() {
    let lost = Arc::new(gpu());
    let mut fit = Fit::new(&lost, 100);
    (1..20).for_each(|step| fit.step(step).unwrap());
    assert!(!lost.is_lost());
    lost.lose();
    assert!(lost.is_lost());
    let found = message((20..60).try_for_each(|step| fit.step(step)));
    assert!(
        found.contains("was lost") && found.contains("the next call opens it again"),
        "{found}"
    );
    // No call on it gives something that looks like a result.
    for result in [fit.device.download().map(drop), fit.device.loss().map(drop), fit.step(60)] {
        assert!(message(result).contains("was lost"));
    }
    let mut next = Fit::new(&Arc::new(gpu()), 100);
    (1..20).for_each(|step| next.step(step).unwrap());
    assert!(next.device.loss().unwrap() > 0.0);
}

#[test]
fn growth_beyond_the_memory_is_one_message() {
    let injected = Injected { buffer_bytes: Some(600_000), ..Injected::default() };
    let gpu = Arc::new(faulty(&injected));
    let mut fit = Fit::new(&gpu, 3000);
    fit.make_wide();
    let found = message((1..40).try_for_each(|step| fit.step(step)));
    assert!(found.contains("is out of memory; use fewer splats or smaller images"), "{found}");
    // The steps that were not done are not forgotten: asking for their result is the same error.
    assert!(message(fit.device.download().map(drop)).contains("is out of memory"));
    // The device itself is sound.
    let mut small = Fit::new(&gpu, 50);
    (1..20).for_each(|step| small.step(step).unwrap());
    assert_eq!(small.device.download().unwrap().splats.len(), 50);
}

#[test]
fn density_control_beyond_the_memory_is_one_message_and_keeps_the_splats() {
    let injected = Injected { buffer_bytes: Some(600_000), ..Injected::default() };
    let gpu = Arc::new(faulty(&injected));
    let mut fit = Fit::new(&gpu, 2000);
    (1..20).for_each(|step| fit.step(step).unwrap());
    let mut before = fit.device.download().unwrap();
    before.stats.grad_sum.fill(1.0);
    fit.device.upload(before.clone()).unwrap();
    let run = McmcRun { cameras: vec![fit.camera], target: 200_000, seed: 1 };
    let mut original = OriginalRun { max_splats: 4000, extent: 1.0, prune_huge: false, seed: 1 };
    for result in [fit.device.mcmc(&run), fit.device.original(&original)] {
        let found = message(result.map(drop));
        assert!(found.contains("is out of memory; use fewer splats or smaller images"), "{found}");
    }
    assert!(fit.device.download().unwrap() == before, "a run that failed changed splats");
    // The fit itself goes on, and so does density control within the memory.
    (20..40).for_each(|step| fit.step(step).unwrap());
    assert_eq!(fit.device.mcmc(&McmcRun { target: 2200, ..run }).unwrap(), 2200);
    (40..60).for_each(|step| fit.step(step).unwrap());
    original.max_splats = 2300;
    assert!(fit.device.original(&original).unwrap() <= 2300);
    (60..80).for_each(|step| fit.step(step).unwrap());
    assert!(fit.device.loss().unwrap() > 0.0);
}

/// The state after some steps, of which submission `failing` fails, and how often the fit failed.
fn fit_with_failure(fit: &mut Fit, gpu: &Gpu, steps: u32, failing: u64) -> (FitState, u32) {
    gpu.fail_submission(failing);
    let mut failures = 0;
    for step in 1..=steps {
        while fit.step(step).is_err() {
            failures += 1;
        }
    }
    loop {
        match fit.device.download() {
            Ok(state) => return (state, failures),
            Err(_) => failures += 1,
        }
    }
}

#[test]
fn a_submission_that_fails_loses_no_step_and_repeats_none() {
    let gpu = Arc::new(gpu());
    // Steps whose pairs find no room are done again.
    let end = |failing: u64| {
        let mut fit = Fit::new(&gpu, 200);
        fit.make_wide();
        fit_with_failure(&mut fit, &gpu, 4, failing)
    };
    let (expected, none) = end(0);
    assert_eq!(none, 0);
    let mut failed = 0;
    loop {
        let (state, failures) = end(failed + 1);
        assert!(state == expected, "other bits after submission {} has failed", failed + 1);
        if failures == 0 {
            break;
        }
        assert_eq!(failures, 1);
        failed += 1;
    }
    gpu.fail_submission(0);
    // Four steps, the status, the steps again, each with a separate status.
    assert!(failed >= 4 + 1 + 2 * 4, "{failed}");
}

#[test]
fn a_batch_is_done_once_if_its_flag_cannot_be_read() {
    let gpu = Arc::new(gpu());
    let end = |failing| fit_with_failure(&mut Fit::new(&gpu, 200), &gpu, 20, failing);
    let (expected, _) = end(0);
    // Step 16, the copy of the flag, and the steps after it.
    for failing in 16..=18 {
        let (state, failures) = end(failing);
        assert!(state == expected && failures == 1, "submission {failing}");
    }
    gpu.fail_submission(0);
}
