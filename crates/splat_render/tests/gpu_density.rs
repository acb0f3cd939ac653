//! Density control on the GPU, which must give the bits that the host's gives.

mod common;

use std::sync::Arc;

use common::*;
use rand::Rng;
use splat_render::Camera;
use splat_render::cpu::CpuFit;
use splat_render::fit::{FitDevice, FitState, McmcRun, OriginalRun, SplatArrays};
use splat_render::gpu::{Gpu, GpuFit};

fn gpu() -> Gpu {
    Gpu::new(true).unwrap_or_else(|e| panic!("{e}"))
}

/// Splats of which some are dead, some fog and some not finite, amid a fit.
fn amid_a_fit(seed: u64, splats: usize, sh_degree: u32) -> FitState {
    let mut rng = rng(seed);
    let [params, first, second] = [(); 3].map(|()| {
        let scene = random_scene(&mut rng, splats, Some(sh_degree));
        SplatArrays {
            means: scene.means,
            quats: scene.quats,
            scales: scene.scales,
            opacities: scene.opacities,
            sh: scene.colors,
            sh_degree: scene.sh_degree,
        }
    });
    let mut state = FitState { first, second, ..FitState::new(params) };
    let stride = state.splats.stride();
    for i in 0..splats {
        state.stats.grad_sum[i] = rng.random::<f32>().powi(4);
        state.stats.seen[i] = rng.random_range(0..30) as f32;
        match rng.random_range(0..20) {
            0 | 1 => state.splats.opacities[i] = -7.0,
            2 => state.splats.means[i][1] = f32::NAN,
            3 => state.splats.sh[stride * (i + 1) - 1][2] = f32::INFINITY,
            4 => state.splats.opacities[i] = 30.0,
            _ => {}
        }
    }
    state
}

fn cameras(seed: u64) -> Vec<Camera> {
    let mut rng = rng(seed);
    (0..4).map(|_| random_camera(&mut rng, 90, 60)).collect()
}

/// A name, and what is made of the adapter.
type Way = (&'static str, fn(Gpu) -> Gpu);

fn after(device: &mut dyn FitDevice, state: &FitState, run: &McmcRun) -> FitState {
    device.upload(state.clone()).unwrap();
    let splats = device.mcmc(run).unwrap();
    let state = device.download().unwrap();
    assert_eq!(state.splats.len(), splats);
    state
}

const WAYS: [Way; 4] = [
    ("as it is", |gpu| gpu),
    ("without subgroups", Gpu::without_subgroups),
    ("as discrete", Gpu::as_discrete),
    ("few workgroups in a row", |gpu| gpu.with_group_limit(3)),
];

#[test]
fn it_gives_the_bits_of_the_host() {
    for (way, of) in WAYS {
        let gpu = Arc::new(of(gpu()));
        for (k, (splats, target)) in
            [(1, 4), (150, 150), (700, 100), (900, 2000), (20_000, 21_000)].into_iter().enumerate()
        {
            let state = amid_a_fit(k as u64, splats, k as u32 % 4);
            let run = McmcRun { cameras: cameras(k as u64), target, seed: 77 + k as u32 };
            let expected = after(&mut CpuFit::default(), &state, &run);
            let got = after(&mut GpuFit::new(Arc::clone(&gpu)), &state, &run);
            assert!(got == expected, "{way}, {splats} splats to {target}: other bits");
            assert!(splats < 100 || got != state, "nothing was done");
        }
    }
}

#[test]
fn where_all_are_dead_it_leaves_them() {
    let mut state = amid_a_fit(1, 300, 1);
    state.splats.opacities.fill(-8.0);
    state.splats.means.fill([0.5; 3]);
    state.splats.sh.fill([0.1; 3]);
    let run = McmcRun { cameras: Vec::new(), target: 400, seed: 1 };
    let expected = after(&mut CpuFit::default(), &state, &run);
    let got = after(&mut GpuFit::new(Arc::new(gpu())), &state, &run);
    assert_eq!(got.splats.len(), 300);
    assert!(got == expected);
}

/// What does not fit one binding is done on the host.
#[test]
fn arrays_larger_than_a_binding_give_the_same() {
    let state = amid_a_fit(3, 2000, 2);
    let run = McmcRun { cameras: cameras(3), target: 2500, seed: 5 };
    let expected = after(&mut CpuFit::default(), &state, &run);
    let small = Arc::new(gpu().with_binding_limit(200_000));
    let before = small.host_bytes();
    let got = after(&mut GpuFit::new(Arc::clone(&small)), &state, &run);
    assert!(got == expected);
    assert!(
        small.host_bytes() - before > 4 * 2000 * 3 * (11 + 27) * 2,
        "it was not done on the host"
    );
}

#[test]
fn little_goes_between_host_and_device() {
    let gpu = Arc::new(gpu());
    let mut traffic = Vec::new();
    for splats in [20_000, 40_000, 40_000] {
        let mut fit = GpuFit::new(Arc::clone(&gpu));
        fit.upload(amid_a_fit(2, splats, 1)).unwrap();
        let before = gpu.host_bytes();
        let run = McmcRun { cameras: cameras(2), target: splats + 2000, seed: 3 };
        fit.mcmc(&run).unwrap();
        traffic.push(gpu.host_bytes() - before);
    }
    println!("bytes of each run: {traffic:?}");
    // A sample of at most 10 000 centres, and tables: no more for more splats.
    assert_eq!(traffic[1], traffic[2]);
    assert!(traffic[0].abs_diff(traffic[1]) < 1000, "{traffic:?}");
    assert!(traffic[0] < 1_000_000, "{traffic:?}");
}

fn after_original(device: &mut dyn FitDevice, state: &FitState, run: &OriginalRun) -> FitState {
    device.upload(state.clone()).unwrap();
    let splats = device.original(run).unwrap();
    let state = device.download().unwrap();
    assert_eq!(state.splats.len(), splats);
    state
}

/// The original control of a scene whose splats are mostly larger than `100 extent` for a small extent.
fn original_run(max_splats: usize, extent: f32) -> OriginalRun {
    OriginalRun { max_splats, extent, prune_huge: false, seed: 77 }
}

#[test]
fn clones_splits_and_prunes_have_the_bits_of_the_host() {
    for (way, of) in WAYS {
        let gpu = Arc::new(of(gpu()));
        for (k, (splats, most)) in
            [(1, 4), (150, 150), (700, 100), (900, 1000), (900, 5000), (20_000, 22_000)]
                .into_iter()
                .enumerate()
        {
            let state = amid_a_fit(k as u64, splats, k as u32 % 4);
            // Some are split, some cloned; the longest are huge.
            for extent in [0.5, 8.0, 30.0, 1e6] {
                for prune_huge in [false, true] {
                    let run = OriginalRun { prune_huge, ..original_run(most, extent) };
                    let expected = after_original(&mut CpuFit::default(), &state, &run);
                    let got = after_original(&mut GpuFit::new(Arc::clone(&gpu)), &state, &run);
                    assert!(got == expected, "{way}, {splats} splats, {run:?}: other bits");
                    assert!(splats < 100 || got != state, "nothing was done");
                }
            }
        }
    }
}
