//! The CPU implementation against the reference, stage by stage and end to end.

mod common;

use common::conformance::{Bounds, OPTIONS, SIZES, end_to_end, project_stages, rasterize_stages};
use common::{random_camera, random_projected, random_scene, rng};
use splat_render::cpu::Cpu;

const BOUNDS: Bounds = Bounds { picture: 2e-6, gradient: 1e-4 };

#[test]
fn rasterize_matches_the_reference() {
    for (k, (width, height)) in SIZES.into_iter().enumerate() {
        for (n, sigma) in [(0, 3.0), (1, 8.0), (300, 3.0), (60, 30.0)] {
            let seed = (k * 10 + n) as u64;
            let projected = random_projected(&mut rng(seed), n, width, height, sigma);
            let what = format!("{width}x{height}, {n} splats of {sigma} px");
            rasterize_stages(&Cpu, &projected, seed, BOUNDS, &what);
        }
    }
}

#[test]
fn project_matches_the_reference() {
    for (seed, degree) in
        [None, Some(0), Some(1), Some(2), Some(3), Some(4)].into_iter().enumerate()
    {
        let mut rng = rng(seed as u64);
        let camera = random_camera(&mut rng, 96, 64);
        let scene = random_scene(&mut rng, 2500, degree);
        for options in OPTIONS {
            let what = format!("SH {degree:?}, antialiased {}", options.antialiased);
            project_stages(&Cpu, &scene, &camera, &options, seed as u64, BOUNDS, &what);
        }
    }
}

#[test]
fn end_to_end_matches_the_reference() {
    for (k, (width, height)) in SIZES.into_iter().enumerate() {
        for (n, degree) in [(1, None), (200, Some(3)), (2000, Some(1))] {
            let seed = (k * 7 + n) as u64;
            let mut rng = rng(seed);
            let camera = random_camera(&mut rng, width, height);
            let scene = random_scene(&mut rng, n, degree);
            for options in OPTIONS {
                let aa = options.antialiased;
                let what = format!("{width}x{height}, {n} splats, SH {degree:?}, antialiased {aa}");
                end_to_end(&Cpu, &scene, &camera, &options, &mut rng, BOUNDS, &what);
            }
        }
    }
}

#[test]
fn hard_scenes_agree_with_the_reference() {
    common::hard_cases::hard_scenes_agree_with_the_reference(&Cpu, BOUNDS.gradient);
}

#[test]
fn no_splats_give_the_background() {
    common::hard_cases::no_splats_give_the_background(&Cpu);
}

#[test]
fn poison_in_any_slot_culls_one_splat_at_most() {
    common::hard_cases::poison_in_any_slot_culls_one_splat_at_most(&Cpu);
}

#[test]
fn hard_splats_2d_agree_with_the_reference() {
    common::hard_cases::hard_splats_2d_agree_with_the_reference(&Cpu, BOUNDS);
}

#[test]
fn many_splats_in_one_tile_and_one_on_many() {
    common::hard_cases::many_splats_in_one_tile_and_one_on_many(&Cpu, BOUNDS);
}
