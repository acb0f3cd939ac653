//! What a fit step costs on a GPU, counted where its commands are made.

use splat_render::fit::OriginalRun;
use splat_render::gpu::{Gpu, PlannedFit};

/// The scene that docs/how-it-works/gpus.md counts: a garden's splats and photos.
const SPLATS: usize = 5_000_000;
const SIZE: (u32, u32) = (1297, 840);
const VISIBLE: usize = SPLATS * 3 / 10;
/// Four (splat, tile) pairs for each splat that is seen.
const PAIRS: u32 = 4 * VISIBLE as u32;

#[test]
fn a_step_of_five_million_splats_costs_what_the_docs_say() {
    let gpu = Gpu::new(true).unwrap_or_else(|e| panic!("{e}"));
    let plan = PlannedFit::new(gpu, SPLATS, 3, SIZE, PAIRS).unwrap();
    let work = plan.step(VISIBLE, PAIRS);
    for (kernel, runs, bytes) in &work.kernels {
        println!("| {kernel} | {runs} | {:.2} |", bytes / 1e9);
    }
    println!("{} dispatches, {:.2} GB", work.dispatches, work.bytes / 1e9);
    assert_eq!(work.dispatches, 24);
    assert!((work.bytes / 1e9 - 6.31).abs() < 0.005);
    assert_eq!(work.dispatches, work.kernels.iter().map(|k| k.1).sum::<usize>() - 1, "and a copy");
    // What is left grows with the splats that are seen, but for the optimiser's moments.
    let none = plan.step(0, 0);
    let of = |work: &splat_render::gpu::StepWork, name: &str| {
        work.kernels.iter().find(|(kernel, ..)| *kernel == name).map_or(0.0, |(_, _, bytes)| *bytes)
    };
    for kernel in ["tile_counts", "emit", "rasterize_backward_sum"] {
        assert!(of(&none, kernel) == 0.0 && of(&work, kernel) > 0.0, "{kernel}");
    }
    let moments = of(&none, "fit_geometry");
    assert!(moments > 0.6 * none.bytes, "{moments} of {}", none.bytes);
}

#[test]
fn a_run_of_density_control_costs_what_the_docs_say() {
    let gpu = Gpu::new(true).unwrap_or_else(|e| panic!("{e}"));
    let plan = PlannedFit::new(gpu, SPLATS, 3, SIZE, PAIRS).unwrap();
    let run = OriginalRun { max_splats: 6_000_000, extent: 1.0, prune_huge: true, seed: 1 };
    // A tenth of the splats wants to grow, and as many are removed.
    let (work, host) = plan.original(&run, SPLATS / 10, SPLATS).unwrap();
    for (kernel, runs, bytes) in &work.kernels {
        println!("| {kernel} | {runs} | {:.2} |", bytes / 1e9);
    }
    println!(
        "{} dispatches, {:.2} GB, {host} bytes of host traffic",
        work.dispatches,
        work.bytes / 1e9
    );
    assert_eq!(work.dispatches, 41);
    assert!((work.bytes / 1e9 - 11.50).abs() < 0.005);
    assert!(host < 10_000, "{host}");
}
