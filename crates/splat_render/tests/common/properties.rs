//! Properties of all scenes, tested on random ones.

use proptest::prelude::{Strategy, any, prop, prop_assert, prop_assert_eq, prop_oneof};
use proptest::test_runner::{Config, RngSeed, TestRunner};
use rand::Rng;
use splat_render::{Camera, ProjectOptions, Stages};

use super::conformance::{Bounds, rasterize_stages};
use super::*;

/// The same cases in every run: a check that fails must fail again.
fn runner(cases: u32) -> TestRunner {
    TestRunner::new(Config {
        cases,
        rng_seed: RngSeed::Fixed(0x16_59),
        failure_persistence: None,
        ..Config::default()
    })
}

fn camera(width: u32, height: u32) -> Camera {
    Camera {
        viewmat: DMat4::from_translation(DVec3::new(0.0, 0.0, 3.0)),
        fx: 40.0,
        fy: 43.0,
        cx: 0.45 * f64::from(width),
        cy: 0.6 * f64::from(height),
        width,
        height,
    }
}

/// Any f32 at all, and often one that a scene could hold.
fn value() -> impl Strategy<Value = f32> {
    prop_oneof![3 => -2.0f32..2.0, 1 => any::<f32>(), 1 => any::<u32>().prop_map(f32::from_bits)]
}

/// Up to eight splats of degree 1 of any values.
fn any_scene() -> impl Strategy<Value = Scene<f32>> {
    (0usize..8, any::<bool>()).prop_flat_map(|(n, raw)| {
        prop::collection::vec(value(), n * 23).prop_map(move |values| {
            let mut values = values.into_iter();
            let mut row = || values.next().unwrap_or(0.0);
            let mut scene = Scene { sh_degree: 1, sh_stride: 4, raw, ..Scene::default() };
            for _ in 0..n {
                scene.means.push(std::array::from_fn(|_| row()));
                scene.quats.push(std::array::from_fn(|_| row()));
                scene.scales.push(std::array::from_fn(|_| row()));
                scene.opacities.push(row());
                for _ in 0..4 {
                    scene.colors.push(std::array::from_fn(|_| row()));
                }
            }
            scene
        })
    })
}

/// Whatever the parameters are, picture and gradients are finite, and culled splats have none.
pub fn any_values_give_finite_results(stages: &dyn Stages<f32>, cases: u32) {
    let inputs = (any_scene(), 1u32..40, 1u32..40, any::<bool>());
    let check = |(scene, width, height, antialiased): (Scene<f32>, u32, u32, bool)| {
        let camera = camera(width, height);
        let options = ProjectOptions { antialiased, ..ProjectOptions::default() };
        let Pass { projected, image, v_splats: v, .. } =
            pass(stages, &scene, &camera, &options, Some(5));
        prop_assert!(image.color.iter().flatten().chain(&image.depth).all(|v| v.is_finite()));
        prop_assert!(image.transmittance.iter().all(|t| (0.0..=1.0).contains(t)));
        prop_assert!(all_finite(&v), "{v:?}");
        for i in 0..scene.means.len() {
            if projected.radii[i] == [0.0; 2] {
                prop_assert_eq!((v.v_means[i], v.v_opacities[i]), ([0.0; 3], 0.0));
            }
        }
        Ok(())
    };
    runner(cases).run(&inputs, check).unwrap();
}

/// The order in which splats of different depths are given changes no bit of picture or gradients.
pub fn the_order_of_splats_does_not_matter(stages: &dyn Stages<f32>, cases: u32) {
    let inputs = (1usize..120, 1u32..70, 1u32..70, any::<u64>(), 0.6f64..20.0);
    let check = |(n, width, height, seed, deviation): (usize, u32, u32, u64, f64)| {
        let mut rng = rng(seed);
        let mut projected = random_projected(&mut rng, n, width, height, deviation);
        for (i, depth) in projected.depths.iter_mut().enumerate() {
            *depth = 1.0 + i as f32 * 0.01;
        }
        let mut from: Vec<usize> = (0..n).collect();
        for i in (1..n).rev() {
            from.swap(i, rng.random_range(0..=i));
        }
        let mut shuffled = projected.clone();
        for (i, &k) in from.iter().enumerate() {
            let s = &mut shuffled;
            (s.means2d[i], s.factors[i], s.depths[i], s.colors[i], s.opacities[i], s.radii[i]) =
                splat_2d(&projected, k);
        }
        let background = [0.1, 0.9, 0.4];
        let image = stages.rasterize(&projected, background).unwrap();
        prop_assert!(image == stages.rasterize(&shuffled, background).unwrap(), "picture");
        let v_image = random_image_gradients(&mut rng, image.alpha.len());
        let run = |p| stages.rasterize_backward(p, background, &image, &v_image, false).unwrap();
        let (v, v_shuffled) = (run(&projected), run(&shuffled));
        for (i, &k) in from.iter().enumerate() {
            prop_assert_eq!(v_shuffled.v_means2d[i], v.v_means2d[k]);
            prop_assert_eq!(v_shuffled.v_factors[i], v.v_factors[k]);
            prop_assert_eq!(v_shuffled.v_colors[i], v.v_colors[k]);
            prop_assert_eq!(v_shuffled.v_opacities[i], v.v_opacities[k]);
        }
        Ok(())
    };
    runner(cases).run(&inputs, check).unwrap();
}

/// Pictures of any size, of splats of any size, within the bounds.
pub fn random_pictures_match_the_reference(stages: &dyn Stages<f32>, bounds: Bounds, cases: u32) {
    let inputs = (0usize..200, 1u32..70, 1u32..70, any::<u64>(), 0.05f64..60.0);
    let check = |(n, width, height, seed, deviation): (usize, u32, u32, u64, f64)| {
        let projected = random_projected(&mut rng(seed), n, width, height, deviation);
        rasterize_stages(stages, &projected, seed, bounds, "drawn");
        Ok(())
    };
    runner(cases).run(&inputs, check).unwrap();
}
