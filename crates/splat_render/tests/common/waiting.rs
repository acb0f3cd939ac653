//! Delayed color updates of unseen splats change no bit.

use splat_render::fit::{COLOR_WAIT, FitDevice, FitState, McmcRun, OriginalRun, Rates, StepInput};

use super::optimization::{random_adam, random_target};
use super::*;

const STEPS: u32 = 2 * COLOR_WAIT as u32 + 30;
/// After these steps the degree grows, and in those nothing moves: both end all waiting, and between them
/// it lasts longer than colors may wait.
const GROWS: [u32; 2] = [20, STEPS - 50];
const FROZEN: [u32; 3] = [3, 200, STEPS - 20];
const _: () = assert!(FROZEN[1] - GROWS[0] > COLOR_WAIT as u32 + 1);

/// Cameras that see a part of the scene each, and a state in the middle of a fit, so that unseen splats
/// drift. Some moments are zero, some splats are frozen.
fn begin(device: &mut dyn FitDevice, seed: u64) -> (Vec<Camera>, FitState) {
    let mut rng = rng(seed);
    let (adam, _) = random_adam(&mut rng, 300, 3);
    let mut state =
        FitState { first: adam.first, second: adam.second, ..FitState::new(adam.splats) };
    for i in (0..300).step_by(7) {
        state.first.clear(i);
        state.second.clear(i);
    }
    let cameras: Vec<Camera> = (0..4)
        .map(|_| {
            let camera = random_camera(&mut rng, 40, 30);
            Camera { fx: 3.0 * camera.fx, fy: 3.0 * camera.fy, ..camera }
        })
        .collect();
    let photos = cameras.iter().map(|_| random_target(&mut rng, 40, 30, false, false));
    device.set_targets(photos.collect()).unwrap();
    device.upload(state.clone()).unwrap();
    (cameras, state)
}

/// One photo for longer than colors may wait, then all in turn; the degree grows, rates fall, some steps
/// move nothing.
fn input(cameras: &[Camera], step: u32) -> StepInput {
    let view = if step <= STEPS / 2 + 10 { 0 } else { step as usize % cameras.len() };
    let rate = 1.0 / (1.0 + 0.01 * step as f32);
    let rates = Rates {
        means: 1e-3 * rate,
        quats: 1e-3,
        scales: 5e-3,
        opacities: 1e-2,
        sh0: 5e-3 * rate,
        sh_rest: 2.5e-4 * rate,
    };
    StepInput {
        background: [0.2, 0.4, 0.6],
        sh_degree: [1, 2, 3][(step > GROWS[0]) as usize + (step > GROWS[1]) as usize],
        rates: if FROZEN.contains(&step) { Rates::ZERO } else { rates },
        step,
        opacity_regularizer: 0.01,
        scale_regularizer: 0.01,
        noise: 10.0,
        dropout: 0.1,
        noise_seed: step.wrapping_mul(2_654_435_761),
        ..StepInput::new(view, cameras[view])
    }
}

/// The end of a fit, with a run of density control at these steps, and a save and resume at those.
fn end(device: &mut dyn FitDevice, control: &[u32], resume: &[u32], frozen: usize) -> FitState {
    let (cameras, state) = begin(device, 31);
    device.upload(FitState { frozen, ..state }).unwrap();
    for step in 1..=STEPS {
        device.step(&input(&cameras, step)).unwrap();
        if control.contains(&step) {
            let cameras = cameras.clone();
            device.mcmc(&McmcRun { cameras, target: 310, seed: step }).unwrap();
        }
        if control.contains(&(step + 20)) {
            let run = OriginalRun { max_splats: 305, extent: 1.0, prune_huge: false, seed: step };
            device.original(&run).unwrap();
        }
        if control.contains(&(step + 33)) {
            device.reset_opacities().unwrap();
        }
        if resume.contains(&step) {
            let saved = device.download().unwrap();
            device.upload(saved).unwrap();
        }
    }
    device.download().unwrap()
}

/// `device` makes a device whose colors wait for at most this many steps.
pub fn waiting_colors_end_with_the_same_bits<D: FitDevice>(device: impl Fn(usize) -> D) {
    let (cameras, before) = begin(&mut device(COLOR_WAIT), 31);
    let mut first = device(COLOR_WAIT);
    begin(&mut first, 31);
    let longest = STEPS / 2 + 10;
    assert!(longest as usize > COLOR_WAIT);
    for step in 1..=longest {
        first.step(&input(&cameras, step)).unwrap();
    }
    let seen = first.download().unwrap().stats.seen;
    let unseen = seen.iter().filter(|&&seen| seen == 0.0).count();
    assert!((60..240).contains(&unseen), "{unseen} of 300 wait");

    for (frozen, control) in [(0, &[][..]), (0, &[100, 110, 250]), (70, &[])] {
        let dense = end(&mut device(1), control, &[], frozen);
        assert!(dense.splats.sh != before.splats.sh);
        for most in [COLOR_WAIT, 5] {
            let lazy = end(&mut device(most), control, &[], frozen);
            assert!(lazy == dense, "waiting for {most} steps changed bits, {control:?}, {frozen}");
        }
        let resume = [1, 19, 60, 101, 200, STEPS - 1];
        let resumed = end(&mut device(COLOR_WAIT), control, &resume, frozen);
        assert!(resumed == dense, "resuming changed bits, {control:?}, {frozen}");
    }
}
