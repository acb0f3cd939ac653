//! The kernels that a fit step and a run of density control start, for a scene too large for most GPUs.

use splat_render::fit::OriginalRun;
use splat_render::gpu::{Gpu, PlannedFit};

const SPLATS: usize = 5_000_000;

fn plan() -> PlannedFit {
    let gpu = Gpu::new(true).unwrap_or_else(|e| panic!("{e}"));
    PlannedFit::new(gpu, SPLATS, 3, (1297, 840), 6_000_000).unwrap()
}

#[test]
fn a_step_is_24_dispatches() {
    let sort = |passes: usize| ["sort_count", "sort_place"].repeat(passes);
    let expected = [
        vec!["project"],
        sort(4),
        vec!["tile_counts", "scan_sums", "scan_apply", "emit"],
        sort(2),
        vec!["ranges", "rasterize", "loss_slopes", "loss_gradient"],
        vec!["rasterize_backward", "rasterize_backward_sum", "fit_geometry"],
    ]
    .concat();
    assert_eq!(expected.len(), 24);
    assert_eq!(plan().step(), expected);
}

#[test]
fn a_run_of_the_original_control_is_41_dispatches_and_little_host_traffic() {
    let run = OriginalRun { max_splats: 6_000_000, extent: 1.0, prune_huge: true, seed: 1 };
    let (commands, host_bytes) = plan().original(&run, SPLATS).unwrap();
    let dispatches = commands.iter().filter(|name| !["clear", "copy"].contains(name)).count();
    assert_eq!(dispatches, 41, "{commands:?}");
    assert!(host_bytes < 10_000, "{host_bytes}");
}
