//! Whole fits on the CPU, density control included: the same seed gives the same bits, on any
//! number of threads and across an interruption.

mod common;

use common::{random_camera, random_scene, rng};
use splat_render::cpu::{Cpu, CpuFit};
use splat_render::fit::{
    Background, DensityControl, FitConfig, FitState, Fitter, Target, splats_from_points,
};
use splat_render::{Camera, Error, ProjectOptions, Stages};

const STEPS: u32 = 420;

/// Photos with alpha of a random scene, rendered by the CPU.
fn photos() -> (Vec<Target>, Vec<Camera>) {
    let mut rng = rng(11);
    let scene = random_scene(&mut rng, 80, Some(0));
    let cameras: Vec<Camera> = (0..5).map(|_| random_camera(&mut rng, 40, 30)).collect();
    let targets = cameras
        .iter()
        .map(|camera| {
            let projected =
                Cpu.project(&scene.params(), camera, &ProjectOptions::default()).unwrap();
            let image = Cpu.rasterize(&projected, [0.0; 3]).unwrap();
            let byte = |v: f32| (v * 255.0).round().clamp(0.0, 255.0) as u8;
            let pixels = image.color.iter().zip(&image.alpha).flat_map(|(c, &a)| {
                let straight = c.map(|c| byte(c / a.max(1e-6)));
                [straight[0], straight[1], straight[2], byte(a)]
            });
            Target { width: 40, height: 30, channels: 4, pixels: pixels.collect(), weights: None }
        })
        .collect();
    (targets, cameras)
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
        hull: true,
        ..FitConfig::default()
    }
}

fn start(seed: u64) -> FitState {
    let points: Vec<[f32; 3]> = random_scene(&mut rng(seed), 150, None).means;
    FitState::new(splats_from_points(&points, &vec![[0.5; 3]; points.len()], 1).unwrap())
}

fn fitter(density: DensityControl, state: &FitState, step: u32) -> Fitter {
    let (targets, cameras) = photos();
    let device = Box::new(CpuFit::default());
    Fitter::new(device, targets, cameras, state.clone(), step, config(density)).unwrap()
}

fn run(fitter: &mut Fitter, until: u32) -> FitState {
    while fitter.steps_done() < until {
        fitter.step().unwrap();
    }
    fitter.state().unwrap()
}

#[test]
fn the_loss_falls_and_density_control_runs() {
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let mut fitter = fitter(density, &start(1), 0);
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
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&mut fitter(density, &start(1), 0), STEPS))
        };
        let one = on(1);
        for threads in [1, 2, 3, 8] {
            assert!(on(threads) == one, "{density:?}: {threads} threads give other bits");
        }
    }
}

#[test]
fn a_resumed_fit_ends_with_the_same_bits() {
    for density in [DensityControl::Mcmc, DensityControl::Original] {
        let whole = run(&mut fitter(density, &start(1), 0), STEPS);
        for cut in [1, 299, 300, 357] {
            let half = run(&mut fitter(density, &start(1), 0), cut);
            let resumed = run(&mut fitter(density, &half, cut), STEPS);
            assert!(resumed == whole, "{density:?} resumed at step {cut} ends otherwise");
        }
    }
}

#[test]
fn another_seed_gives_other_bits() {
    let (targets, cameras) = photos();
    let other = FitConfig { seed: 6, ..config(DensityControl::Mcmc) };
    let device = Box::new(CpuFit::default());
    let mut other = Fitter::new(device, targets, cameras, start(1), 0, other).unwrap();
    let mut one = fitter(DensityControl::Mcmc, &start(1), 0);
    assert!(run(&mut other, 20) != run(&mut one, 20));
}

#[test]
fn bad_arguments_are_named() {
    let (targets, cameras) = photos();
    let build = |targets: Vec<Target>, cameras: Vec<Camera>, state: &FitState, config| {
        let device = Box::new(CpuFit::default());
        let error = Fitter::new(device, targets, cameras, state.clone(), 0, config).err();
        error.as_ref().map_or_else(String::new, Error::to_string)
    };
    let good = config(DensityControl::Mcmc);
    let state = start(1);
    assert!(build(vec![], vec![], &state, good.clone()).contains("images"));
    assert!(
        build(targets.clone(), cameras[1..].to_vec(), &state, good.clone()).contains("viewmats")
    );
    let mut small = targets.clone();
    small[2].pixels.pop();
    assert!(build(small, cameras.clone(), &state, good.clone()).contains("images[2]"));
    let mut weights = targets.clone();
    weights[1].weights = Some(vec![f32::NAN; 1200]);
    assert!(build(weights, cameras.clone(), &state, good.clone()).contains("images[1]"));
    let mut skewed = cameras.clone();
    skewed[0].viewmat.x_axis.x += 0.5;
    assert!(build(targets.clone(), skewed, &state, good.clone()).contains("viewmat"));
    let mut flat = cameras.clone();
    flat[0].fx = 0.0;
    assert!(build(targets.clone(), flat, &state, good.clone()).contains("K"));
    let none = FitConfig { steps: 0, ..good.clone() };
    assert!(build(targets.clone(), cameras.clone(), &state, none).contains("steps"));
    let degree = FitConfig { sh_degree: 2, ..good };
    assert!(build(targets, cameras, &state, degree).contains("SH degree"));
}
