//! The work of a fit step on a GPU and of a run of density control, counted without one.

mod common;

use common::{Scene, normal, rng};
use rand::Rng;
use splat_render::constants::{ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN};
use splat_render::cpu::Cpu;
use splat_render::fit::OriginalRun;
use splat_render::gpu::{Gpu, PlannedFit};
use splat_render::{Camera, ProjectOptions, Stages};

const SPLATS: usize = 5_000_000;

fn plan() -> PlannedFit {
    let gpu = Gpu::new(true).unwrap_or_else(|e| panic!("{e}"));
    PlannedFit::new(gpu, SPLATS, 3, (1297, 840), 6_000_000).unwrap()
}

#[test]
fn a_step_is_23_dispatches() {
    let sort = |passes: usize| ["sort_count", "sort_place"].repeat(passes);
    let expected = [
        vec!["project"],
        sort(4),
        vec!["tile_counts", "scan_apply", "emit"],
        sort(2),
        vec!["ranges", "rasterize", "loss_slopes", "loss_gradient"],
        vec!["rasterize_backward", "rasterize_backward_sum", "fit_geometry"],
    ]
    .concat();
    assert_eq!(expected.len(), 23);
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

/// The ball of `igsr_lab bench`'s W4.
fn ball(n: usize, side: u32) -> (Scene<f32>, Camera) {
    let mut rng = rng(0);
    let mut scene = Scene::<f32> { raw: true, ..Scene::default() };
    let size = (1.5 / (n as f64).sqrt()).ln();
    for _ in 0..n {
        let direction = glam::DVec3::from_array([(); 3].map(|()| normal(&mut rng))).normalize();
        let mean = direction * rng.random::<f64>().cbrt();
        scene.means.push(mean.to_array().map(|x| x as f32));
        scene.scales.push([(); 3].map(|()| (size + 0.5 * normal(&mut rng)) as f32));
        scene.quats.push([(); 4].map(|()| normal(&mut rng) as f32));
        scene.opacities.push((1.5 * normal(&mut rng)) as f32);
        scene.colors.push([0.5; 3]);
    }
    let (half, distance) = (0.5 * f64::from(side), 3.0f64);
    let focal = half * (distance * distance - 1.0).sqrt();
    let viewmat = glam::DMat4::from_translation(glam::DVec3::Z * distance);
    let (width, height) = (side, side);
    (scene, Camera { viewmat, fx: focal, fy: focal, cx: half, cy: half, width, height })
}

/// Evaluations of a splat at a pixel by whole tiles and by blocks of 8x4 pixels, for splats that touch the
/// tile or the block, without margins.
fn evaluations(n: usize, side: u32) -> [u64; 2] {
    let (scene, camera) = ball(n, side);
    let drawn = Cpu.project(&scene.params(), &camera, &ProjectOptions::default()).unwrap();
    let mut order: Vec<_> = (0..drawn.len()).filter(|&i| drawn.is_drawn(i)).collect();
    order.sort_by(|&a, &b| drawn.depths[a].total_cmp(&drawn.depths[b]));
    let (blocks_x, tiles_x) = (side / 8, side / TILE);
    let mut transmittance = vec![1.0f32; (side * side) as usize];
    let mut live_of_block = vec![32u32; (blocks_x * side / 4) as usize];
    let mut live_of_tile = vec![TILE * TILE; (tiles_x * tiles_x) as usize];
    let (mut pairs, mut items) = (0, 0);
    // The splat that last touched a tile or a block.
    let mut tile_seen = vec![usize::MAX; live_of_tile.len()];
    let mut block_seen = vec![usize::MAX; live_of_block.len()];
    for i in order {
        let ([x, y], [p, q, r]) = (drawn.means2d[i], drawn.factors[i]);
        let range = |at: f32, radius: f32| {
            let last = (side - 1) as f32;
            (at - radius - 0.5).clamp(0.0, last) as u32..=(at + radius).clamp(0.0, last) as u32
        };
        for row in range(y, drawn.radii[i][1]) {
            for column in range(x, drawn.radii[i][0]) {
                let dy = row as f32 + 0.5 - y;
                let (u, v) = (p * (column as f32 + 0.5 - x) + q * dy, r * dy);
                let alpha = (drawn.opacities[i] * (-0.5 * (u * u + v * v)).exp()).min(ALPHA_MAX);
                if alpha < ALPHA_MIN {
                    continue;
                }
                let block = (row / 4 * blocks_x + column / 8) as usize;
                let tile = (row / TILE * tiles_x + column / TILE) as usize;
                let seen = [
                    (&mut tile_seen[tile], live_of_tile[tile], &mut pairs),
                    (&mut block_seen[block], live_of_block[block], &mut items),
                ];
                for (last, live, count) in seen {
                    if *last != i && live > 0 {
                        *last = i;
                        *count += 1u64;
                    }
                }
                let through = &mut transmittance[(row * side + column) as usize];
                if *through > 0.0 {
                    *through *= 1.0 - alpha;
                    if *through < TRANSMITTANCE_MIN {
                        *through = 0.0;
                        live_of_block[block] -= 1;
                        live_of_tile[tile] -= 1;
                    }
                }
            }
        }
    }
    [256 * pairs, 32 * items]
}

#[test]
fn blocks_evaluate_a_fifth_of_what_tiles_do() {
    let [tiles, blocks] = evaluations(1_000_000, 512);
    println!("{tiles:.2e} by tiles, {blocks:.2e} by blocks");
    assert!(tiles > 330_000_000, "{tiles}");
    assert!(blocks < 80_000_000, "{blocks}");
}
