//! Density control on the GPU, which must give the bits that the host's gives.

mod common;

use std::collections::HashSet;
use std::sync::Arc;

use common::*;
use glam::DMat4;
use rand::Rng;
use splat_render::Camera;
use splat_render::cpu::CpuFit;
use splat_render::fit::{FitDevice, FitState, McmcRun, OriginalRun};
use splat_render::gpu::{Gpu, GpuFit};

/// A state in the middle of a fit, with dead, foggy and invalid splats.
fn amid_a_fit(seed: u64, splats: usize, sh_degree: u32) -> FitState {
    let mut rng = rng(seed);
    let [params, first, second] =
        [(); 3].map(|()| random_scene(&mut rng, splats, Some(sh_degree)).arrays());
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

/// The state after a change on the host, checked against the GPU's. The change returns the number of
/// moving splats.
fn same(
    gpu: &Arc<Gpu>,
    state: &FitState,
    change: impl Fn(&mut dyn FitDevice) -> splat_render::Result<usize>,
) -> FitState {
    let after = |device: &mut dyn FitDevice| {
        device.upload(state.clone()).unwrap();
        let moving = change(device).unwrap();
        let after = device.download().unwrap();
        assert_eq!(after.moving(), moving);
        after
    };
    let expected = after(&mut CpuFit::default());
    let got = after(&mut GpuFit::new(Arc::clone(gpu)));
    assert!(got == expected, "{} splats: other bits", state.splats.len());
    expected
}

fn same_after(gpu: &Arc<Gpu>, state: &FitState, run: &McmcRun) -> FitState {
    same(gpu, state, |device| device.mcmc(run))
}

fn same_after_original(gpu: &Arc<Gpu>, state: &FitState, run: &OriginalRun) -> FitState {
    same(gpu, state, |device| device.original(run))
}

/// A name, and a change of the adapter.
type Way = (&'static str, fn(Gpu) -> Gpu);
const WAYS: [Way; 4] = [
    ("as it is", |gpu| gpu),
    ("without subgroups", Gpu::without_subgroups),
    ("as discrete", Gpu::as_discrete),
    ("few workgroups in a row", |gpu| gpu.with_group_limit(3)),
];

#[test]
fn mcmc_gives_the_bits_of_the_host() {
    for (way, of) in WAYS {
        println!("{way}");
        let gpu = Arc::new(of(gpu()));
        for (k, (splats, target)) in
            [(1, 4), (150, 150), (700, 100), (900, 2000), (20_000, 21_000)].into_iter().enumerate()
        {
            let state = amid_a_fit(k as u64, splats, k as u32 % 4);
            let run = McmcRun { cameras: cameras(k as u64), target, seed: 77 + k as u32 };
            let after = same_after(&gpu, &state, &run);
            assert!(splats < 100 || after != state, "nothing was done");
        }
    }
}

/// Bytes between host and device in changes of 20 000, 40 000 and 40 000 splats.
fn host_bytes(change: impl Fn(&mut GpuFit, usize)) -> [u64; 3] {
    let gpu = Arc::new(gpu());
    let traffic = [20_000, 40_000, 40_000].map(|splats| {
        let mut fit = GpuFit::new(Arc::clone(&gpu));
        fit.upload(amid_a_fit(2, splats, 1)).unwrap();
        let before = gpu.host_bytes();
        change(&mut fit, splats);
        gpu.host_bytes() - before
    });
    println!("bytes of each run: {traffic:?}");
    traffic
}

fn original_run(max_splats: usize, extent: f32) -> OriginalRun {
    OriginalRun { max_splats, extent, prune_huge: false, seed: 77 }
}

/// The same with no number that is not finite.
fn sound(mut state: FitState) -> FitState {
    let splats = &mut state.splats;
    let numbers = splats.means.as_flattened_mut().iter_mut();
    for v in numbers.chain(splats.sh.as_flattened_mut()).filter(|v| !v.is_finite()) {
        *v = 0.1;
    }
    state
}

#[test]
fn clones_splits_and_prunes_have_the_bits_of_the_host() {
    for (way, of) in WAYS {
        println!("{way}");
        let gpu = Arc::new(of(gpu()));
        let cases = [(1, 4), (700, 100), (900, 950), (900, 5000), (20_000, 22_000)];
        for (k, (splats, most)) in cases.into_iter().enumerate() {
            let state = amid_a_fit(k as u64, splats, k as u32 % 4);
            let split = same_after_original(&gpu, &state, &original_run(most, 0.5));
            // Larger than 0.3 is split, larger than 3 removed.
            let run = OriginalRun { prune_huge: true, ..original_run(most, 30.0) };
            let fewer = same_after_original(&gpu, &state, &run);
            if splats >= 900 {
                assert_ne!(split.splats.means, fewer.splats.means, "nothing was split");
                let pulled = (0..splats).filter(|&i| state.stats.grad_sum[i] > 1e-2).count();
                let pruned =
                    (splats + pulled.min(most - splats)).saturating_sub(split.splats.len());
                assert!(pruned > splats / 10 && split.splats.len() <= most, "{pruned} pruned");
            }
        }
    }
}

#[test]
fn original_control_without_work_only_sorts() {
    let gpu = Arc::new(gpu());
    let mut state = sound(amid_a_fit(4, 300, 1));
    state.splats.opacities.fill(1.0);
    let sorted = |state: &FitState| {
        let mut means = state.splats.means.clone();
        means.sort_by(|a, b| a.partial_cmp(b).unwrap());
        means
    };
    // No gradient; never seen (a gradient counts as one step's); and at the cap or above.
    let mut still = state.clone();
    still.stats.grad_sum.fill(0.0);
    let mut unseen = state.clone();
    unseen.stats.seen.fill(0.0);
    unseen.stats.grad_sum.fill(1.9e-4);
    for (state, most) in [(&still, 900), (&unseen, 900), (&state, 300), (&state, 10)] {
        let after = same_after_original(&gpu, state, &original_run(most, 1.0));
        assert_eq!(sorted(&after), sorted(state));
        assert!(after.stats.grad_sum.iter().chain(&after.stats.seen).all(|&v| v == 0.0));
    }
    unseen.stats.grad_sum.fill(2.1e-4);
    let after = same_after_original(&gpu, &unseen, &original_run(900, 1e9));
    assert_eq!(after.splats.len(), 600);
    // Invalid statistics make nothing grow.
    let mut odd = state.clone();
    odd.stats.grad_sum = [f32::NAN, f32::INFINITY, -1.0].repeat(100);
    assert_eq!(same_after_original(&gpu, &odd, &original_run(900, 1.0)).splats.len(), 300);
    odd.stats.grad_sum.fill(1e30);
    odd.stats.seen = [f32::NAN, f32::INFINITY, -1.0].repeat(100);
    assert_eq!(same_after_original(&gpu, &odd, &original_run(900, 1.0)).splats.len(), 400);
}

#[test]
fn scenes_without_a_living_splat_keep_all() {
    let gpu = Arc::new(gpu());
    let mut dead = amid_a_fit(1, 300, 1);
    dead.splats.opacities.fill(-8.0);
    dead.splats.means.fill([0.5; 3]);
    dead.splats.sh.fill([0.1; 3]);
    let run = McmcRun { cameras: Vec::new(), target: 400, seed: 1 };
    assert_eq!(same_after(&gpu, &dead, &run).splats.len(), 300);
    let mut state = sound(amid_a_fit(1, 300, 1));
    state.splats.opacities.fill(-8.0);
    let run = original_run(310, 1.0);
    // The right number of splats grows.
    assert_eq!(same_after_original(&gpu, &state, &run).splats.len(), 310);
    state.splats.opacities.fill(1.0);
    state.splats.scales.fill([2.0; 3]);
    let huge = OriginalRun { prune_huge: true, ..run };
    assert_eq!(same_after_original(&gpu, &state, &huge).splats.len(), 310);
}

#[test]
fn halves_beyond_the_range_of_numbers_stay_in_place() {
    let mut state = amid_a_fit(6, 200, 0);
    state.stats.grad_sum.fill(1.0);
    state.splats.means.fill([3.4e38; 3]);
    state.splats.scales.fill([87.9; 3]);
    state.splats.quats[..50].fill([0.0; 4]);
    let after = same_after_original(&Arc::new(gpu()), &state, &original_run(400, 1.0));
    assert!(after.splats.means.as_flattened().iter().all(|v| v.is_finite()));
    assert!(after.splats.len() > 300);
}

/// Rotations of every length, numbers that a driver may flush, and intermediate overflow.
#[test]
fn halves_of_splats_with_extreme_numbers_are_the_host_s() {
    let mut rng = rng(8);
    let n = 6000;
    let mut state = sound(amid_a_fit(8, n, 0));
    state.stats.grad_sum.fill(1.0);
    state.stats.seen.fill(1.0);
    state.splats.opacities.fill(1.0);
    for i in 0..n {
        let length = 10f32.powf(rng.random_range(-7.0..20.0));
        state.splats.quats[i] = state.splats.quats[i].map(|v| v * length);
        match i % 6 {
            0 => state.splats.quats[i][rng.random_range(0..4)] = 1e-40,
            1 => state.splats.quats[i][rng.random_range(0..4)] *= 1e-30,
            2 => state.splats.means[i] = [-0.0, 1.2e-38, -1e-40],
            3 => state.splats.scales[i] = [-1e-40, 1e-44, -70.0],
            4 => state.splats.scales[i] = [-70.0, -50.0, 80.0],
            _ => state.splats.scales[i] = [rng.random_range(-70.0..88.0); 3],
        }
    }
    // All that is larger than e^-73 is split.
    let after = same_after_original(&Arc::new(gpu()), &state, &original_run(2 * n, 1e-30));
    assert_eq!(after.splats.len(), 2 * n);
    let before: HashSet<_> = state.splats.means.iter().map(|m| m.map(f32::to_bits)).collect();
    let still = after.splats.means.iter().filter(|m| before.contains(&m.map(f32::to_bits)));
    let still = still.count();
    assert!(still > n / 10 && still < n, "{still} halves did not move");
}

/// Splats that end exactly at a picture's edge: rounding decides which are fog.
#[test]
fn fog_at_the_edge_of_a_picture_is_found_as_on_the_host() {
    let mut rng = rng(9);
    let n = 5000;
    let camera = Camera {
        viewmat: DMat4::from_rotation_y(0.4) * DMat4::from_rotation_x(0.3),
        fx: 53.0,
        fy: 47.0,
        cx: 49.0,
        cy: 51.0,
        width: 100,
        height: 100,
    };
    let mut state = sound(amid_a_fit(9, n, 0));
    state.splats.opacities.fill(0.0);
    let back = camera.viewmat.inverse();
    for i in 0..n {
        // A wall, and test splats in front of it.
        let wall = i % 10 == 0;
        let scale = if wall { -3.0 } else { rng.random_range(-2.5..0.0) };
        let [y, depth] = [rng.random_range(-0.3..0.3), rng.random_range(0.5..1.5)];
        let x = -depth * camera.cx / camera.fx - 3.0 * f64::from(scale).exp();
        let at = if wall { [y, y, 4.0] } else { [x, y, depth] };
        state.splats.means[i] = back.transform_point3(at.into()).as_vec3().to_array();
        state.splats.scales[i] = [scale, -9.0, -9.0];
    }
    let run = McmcRun { cameras: vec![camera], target: n, seed: 1 };
    let expected = same_after(&Arc::new(gpu()), &state, &run);
    let left: HashSet<_> = expected.splats.means.iter().map(|m| m.map(f32::to_bits)).collect();
    let fog = state.splats.means.iter().filter(|m| !left.contains(&m.map(f32::to_bits))).count();
    assert!(fog > n / 4 && fog < n * 3 / 4, "{fog} of {n} are fog");
}

#[test]
fn opacities_are_reset_as_on_the_host() {
    for (way, of) in WAYS {
        let gpu = Arc::new(of(gpu()));
        let mut state = amid_a_fit(5, 4000, 1);
        // A moved splat whose opacity is not finite, and frozen ones.
        state.splats.means.fill([0.5; 3]);
        state.splats.sh.fill([0.1; 3]);
        state.splats.opacities[3] = f32::INFINITY;
        state.frozen = 300;
        println!("{way}");
        let expected = same(&gpu, &state, |device| device.reset_opacities().map(|()| 3700));
        assert!(expected.splats.opacities[..3700].iter().all(|&o| o < -4.59 || o.is_infinite()));
        assert!(expected.splats.opacities[3700..] == state.splats.opacities[3700..]);
    }
}

/// Arrays larger than a binding, and frozen splats, are processed on the host.
#[test]
fn the_host_s_fallback_gives_the_same() {
    let state = amid_a_fit(3, 2000, 2);
    let small = Arc::new(gpu().with_binding_limit(200_000));
    let mcmc = McmcRun { cameras: cameras(3), target: 2500, seed: 5 };
    let runs: [&dyn Fn(); 2] = [&|| drop(same_after(&small, &state, &mcmc)), &|| {
        drop(same_after_original(&small, &state, &original_run(2500, 1.0)))
    }];
    for run in runs {
        let before = small.host_bytes();
        run();
        assert!(small.host_bytes() - before > 4 * 2000 * 3 * (11 + 27) * 2, "not on the host");
    }
    // The old scene fits, the new one does not.
    let tight = Arc::new(gpu().with_binding_limit(2000 * 27 * 4));
    same_after_original(&tight, &state, &original_run(4000, 1e-3));
    let frozen = FitState { frozen: 500, ..sound(state) };
    same_after_original(&Arc::new(gpu()), &frozen, &original_run(2500, 1.0));
}

#[test]
fn density_control_has_little_host_traffic() {
    let traffic = host_bytes(|fit, splats| {
        let run = McmcRun { cameras: cameras(2), target: splats + 2000, seed: 3 };
        fit.mcmc(&run).unwrap();
    });
    // A sample of at most 10 000 centers, and tables: no more for more splats.
    assert_eq!(traffic[1], traffic[2]);
    assert!(traffic[0].abs_diff(traffic[1]) < 1000, "{traffic:?}");
    assert!(traffic[0] < 1_000_000, "{traffic:?}");
    let traffic = host_bytes(|fit, splats| {
        let left = fit.original(&original_run(2 * splats, 1.0)).unwrap();
        fit.reset_opacities().unwrap();
        assert!(left > splats);
    });
    assert_eq!(traffic, [traffic[0]; 3], "it grows with the splats");
    assert!(traffic[0] < 10_000, "{traffic:?}");
}
