//! Hard cases that every f32 implementation must get through.

use rand::Rng;
use splat_render::constants::{ALPHA_MAX, ALPHA_MIN};
use splat_render::stages::{Projected, ProjectedGradients};
use splat_render::{ProjectOptions, Stages};

use super::conformance::{Bounds, OPTIONS, end_to_end, rasterize_stages};
use super::*;

/// Hard scenes of the design's table, by name, seen by a camera at the origin that looks along z.
fn hard_scenes() -> Vec<(&'static str, Scene<f32>)> {
    let mut rng = rng(20);
    let mut out = Vec::new();
    let mut base = |n: usize| {
        let mut scene = random_scene(&mut rng, n, Some(2));
        for mean in &mut scene.means {
            mean[2] += 4.0;
        }
        (scene, [(); 3].map(|()| rng.random::<f64>()))
    };
    let (mut scales, _) = base(80);
    for (i, scale) in scales.scales.as_flattened_mut().iter_mut().enumerate() {
        *scale = -30.0 + 45.0 * ((i * 7919) % 240) as f32 / 239.0;
    }
    out.push(("log-scales -30 to 15", scales));
    let (mut needles, _) = base(60);
    for (i, scale) in needles.scales.iter_mut().enumerate() {
        let short = -14.0;
        *scale = match i % 3 {
            0 => [short + 13.8, short, short],
            1 => [-1.0, short, -1.0],
            _ => [2.0, -11.8, -11.8],
        };
    }
    out.push(("needles and pancakes", needles));
    let (mut near, _) = base(90);
    for (i, mean) in near.means.iter_mut().enumerate() {
        let z = [0.0099, 0.0101, 0.02, -0.0101, -1.0, 0.0][i % 6];
        *mean = [mean[0] * 0.01, mean[1] * 0.01, z];
    }
    for scale in near.scales.as_flattened_mut() {
        *scale -= 4.0;
    }
    out.push(("around the near plane", near));
    let (mut saturated, _) = base(120);
    for (i, opacity) in saturated.opacities.iter_mut().enumerate() {
        *opacity = if i % 3 == 0 { -30.0 } else { 30.0 };
    }
    out.push(("saturated opacities", saturated));
    let (mut outside, _) = base(40);
    for (mean, scale) in outside.means.iter_mut().zip(&mut outside.scales) {
        mean[0] += 30.0;
        *scale = [2.5, 1.0, 2.0];
    }
    out.push(("far off the frustum", outside));
    let (mut equal, _) = base(150);
    for mean in &mut equal.means {
        mean[2] = 3.0;
    }
    out.push(("all at one depth", equal));
    let (mut quats, _) = base(20);
    quats.quats[3] = [0.0; 4];
    quats.quats[4] = [1e-7, 0.0, 0.0, 0.0];
    quats.quats[5] = [1e-5, 0.0, 2e-5, 0.0];
    quats.quats[6] = [1e15, 2e15, 0.0, 0.0];
    out.push(("tiny and huge quaternions", quats));
    out
}

/// Every hard scene, from splats to picture and back, against the reference.
pub fn hard_scenes_agree_with_the_reference(stages: &dyn Stages<f32>, bounds: Bounds) {
    let camera = splat_render::Camera {
        viewmat: glam::DMat4::IDENTITY,
        fx: 70.0,
        fy: 75.0,
        cx: 33.0,
        cy: 25.0,
        width: 66,
        height: 50,
    };
    for (name, scene) in hard_scenes() {
        // Several random gradients: terms may cancel in one and not in another.
        for draw in 0..4 {
            for options in OPTIONS {
                let what = format!("{name}, antialiased {}, draw {draw}", options.antialiased);
                let mut rng = rng(21 + draw);
                end_to_end(stages, &scene, &camera, &options, &mut rng, bounds, &what);
            }
        }
    }
}

/// A quaternion that names no rotation culls its splat, which then has no gradient.
pub fn a_zero_quaternion_culls_its_splat(stages: &dyn Stages<f32>) {
    let mut rng = rng(22);
    let mut scene = random_scene(&mut rng, 12, Some(1));
    let camera = random_camera(&mut rng, 40, 30);
    // Squared norms 0, a subnormal, and just under and over the limit of 1e-12.
    scene.quats[2] = [0.0; 4];
    scene.quats[3] = [0.0, 1e-20, 0.0, 0.0];
    scene.quats[4] = [9.9e-7, 0.0, 0.0, 0.0];
    scene.quats[5] = [0.0, 0.0, 1.01e-6, 0.0];
    for i in 2..6 {
        // In the middle of the picture and opaque: visible, if anything is.
        scene.means[i] = [0.0; 3];
        scene.opacities[i] = 2.0;
    }
    for options in OPTIONS {
        let Pass { projected, v_splats: v, .. } = pass(stages, &scene, &camera, &options, Some(24));
        let culled = |i: usize| projected.radii[i] == [0.0; 2];
        assert!(culled(2) && culled(3) && culled(4) && !culled(5), "{:?}", projected.radii);
        let none = ([0.0; 3], [0.0; 4], [0.0; 3], 0.0, &[[0.0; 3]; 4][..]);
        for i in 2..5 {
            assert_eq!(splat_gradients(&v, i, 4), none, "splat {i}");
        }
        assert!(v.v_opacities[5] != 0.0, "the quaternion of norm 1.01e-6 is seen");
        assert!(all_finite(&v), "{v:?}");
    }
}

/// Splats just on either side of each threshold are handled alike everywhere.
pub fn thresholds_are_the_same_everywhere(stages: &dyn Stages<f32>) {
    // One pixel, splats centered on it: alpha is the opacity itself.
    let render = |opacities: &[f32]| {
        let mut projected = Projected::<f32>::culled(opacities.len(), 1, 1);
        for (i, &opacity) in opacities.iter().enumerate() {
            place(&mut projected, i, [0.5, 0.5], [2.0, 2.0], 0.0, opacity);
            // `place` sets no extent for invisible splats.
            projected.radii[i] = [5.0, 5.0];
            projected.depths[i] = 1.0 + i as f32;
            projected.colors[i] = [1.0; 3];
        }
        let image = stages.rasterize(&projected, [0.0; 3]).unwrap();
        (image.transmittance[0], image.color[0][0])
    };
    let (min, max) = (ALPHA_MIN, ALPHA_MAX);
    assert_eq!(render(&[min.next_down()]), (1.0, 0.0), "just under 1/255");
    let (t, color) = render(&[min.next_up()]);
    assert!((t - (1.0 - min)).abs() < 1e-6 && (color - min).abs() < 1e-6, "just over 1/255");
    // The cap; behind one capped layer a second is not drawn, since (1 - 0.99f)^2 is just under
    // 1e-4f.
    for opacity in [max, max.next_up(), 1.0] {
        let (t, color) = render(&[opacity]);
        assert!((t - (1.0 - max)).abs() < 1e-8, "the cap at {opacity}: {t:e}");
        assert_eq!(render(&[opacity, opacity]), (t, color), "two capped layers of {opacity}");
        let faint = render(&[opacity, min.next_up()]).0;
        assert!(
            (faint - t * (1.0 - min)).abs() < 1e-7 && faint < t,
            "a faint one behind is: {faint:e}"
        );
    }
    // Two layers that leave 1.02e-4 are both drawn, and a third would go under 1e-4: the pixel
    // stops before it and takes nothing that follows.
    let two = render(&[0.9899, 0.9899]);
    assert!((two.0 - 1.02e-4).abs() < 1e-7 && two.1 > 0.9998, "{two:?}");
    assert_eq!(render(&[0.9899, 0.9899, 0.5]), two, "the third layer is not drawn");
    assert_eq!(render(&[0.9899, 0.9899, 0.5, min.next_up()]), two, "nor splats behind it");
}

/// Splats on the edges of tiles and of the picture.
pub fn tile_edges_are_seamless(stages: &dyn Stages<f32>, bounds: Bounds) {
    let mut rng = rng(23);
    let mut edges = Projected::<f32>::culled(81, 50, 50);
    for i in 0..81 {
        // Centers on pixel centers and borders around the corner of four tiles, and reaches that end
        // close to the tiles' last and first pixel centers.
        let at = |k: usize| [15.0f32, 15.5, 15.999, 16.0, 16.001, 16.5, 32.0, 49.5, 50.0][k];
        let deviation = 0.3 + 0.11 * f64::from(i as u32 % 7);
        let angle = f64::from(i as u32) * 0.3;
        place(&mut edges, i, [at(i % 9), at(i / 9)], [deviation, 3.0 * deviation], angle, 0.9);
        edges.depths[i] = 1.0 + rng.random::<f32>();
        edges.colors[i] = std::array::from_fn(|_| rng.random::<f32>());
    }
    rasterize_stages(stages, &edges, 42, bounds, "tile edges");
}

/// Hard 2D splats, by name.
pub fn hard_splats_2d() -> Vec<(&'static str, Projected<f32>)> {
    let mut rng = rng(2);
    let mut cases = Vec::new();
    let mut equal = random_projected(&mut rng, 200, 40, 40, 4.0);
    equal.depths.fill(2.0);
    cases.push(("all at one depth: the index decides", equal));
    let mut culled = random_projected(&mut rng, 50, 33, 20, 3.0);
    culled.radii.fill([0.0; 2]);
    cases.push(("everything culled", culled));
    let mut outside = random_projected(&mut rng, 40, 120, 90, 60.0);
    for mean in &mut outside.means2d {
        mean[0] -= 150.0;
    }
    place(&mut outside, 0, [60.0, 45.0], [500.0, 400.0], 0.3, 0.9);
    cases.push(("centers far outside, and one over all tiles", outside));
    let mut opaque = random_projected(&mut rng, 1000, 20, 20, 8.0);
    for i in 0..1000 {
        place(&mut opaque, i, [10.0, 10.0], [9.0, 7.0], 0.5, 1.0);
        opaque.depths[i] = 1.0 + i as f32;
    }
    cases.push(("1000 opaque layers: early stop and the cap", opaque));
    let mut needles = random_projected(&mut rng, 100, 100, 80, 1.0);
    for i in 0..100 {
        let center = needles.means2d[i];
        let angle = rng.random_range(0.0..std::f64::consts::PI);
        place(&mut needles, i, center, [1e4, 1e-2], angle, 0.8);
        needles.depths[i] = i as f32 + 1.0;
    }
    cases.push(("needles", needles));
    let mut wide = random_projected(&mut rng, 300, 16_384, 2, 6.0);
    place(&mut wide, 0, [8000.0, 1.0], [9000.0, 2.0], 0.0, 0.5);
    cases.push(("a very wide picture", wide));
    cases
}

/// Every hard set of 2D splats, to picture and back, against the reference.
pub fn hard_splats_2d_agree_with_the_reference(stages: &dyn Stages<f32>, bounds: Bounds) {
    for (k, (name, projected)) in hard_splats_2d().iter().enumerate() {
        let mut bounds = bounds;
        // p dx and q dy reach 180 and cancel to u of order 1: their f32 rounding, 1e-5, moves
        // alpha by up to 0.8 exp(-1/2) 1e-5.
        if *name == "needles" {
            bounds.picture = bounds.picture.max(5e-6);
        }
        rasterize_stages(stages, projected, 30 + k as u64, bounds, name);
    }
}

/// 100 000 splats in one tile, and one splat on 16 384 tiles.
pub fn many_splats_in_one_tile_and_one_on_many(stages: &dyn Stages<f32>, bounds: Bounds) {
    let mut rng = rng(11);
    // Nearly all over the left of the tile, then 300 over its right: a list that is cut off
    // anywhere (some drivers stop loops after 65 535 rounds) loses those.
    let (n, left) = (100_000, 99_700);
    let mut crowd = Projected::<f32>::culled(n, 16, 16);
    for i in 0..n {
        let start = if i < left { 0.0 } else { 10.0 };
        let center = [start + rng.random_range(0.0f32..4.0), rng.random_range(0.0f32..16.0)];
        place(&mut crowd, i, center, [0.5, 0.5], 0.0, 0.3);
        crowd.depths[i] = if i < left { 1.0 } else { 2.0 };
        crowd.colors[i] = std::array::from_fn(|_| rng.random::<f32>());
    }
    rasterize_stages(stages, &crowd, 40, bounds, "100 000 in one tile");

    let mut huge = Projected::<f32>::culled(1, 2048, 2048);
    place(&mut huge, 0, [1000.0, 1040.0], [900.0, 700.0], 0.4, 0.7);
    huge.colors[0] = [0.3, 0.6, 0.9];
    rasterize_stages(stages, &huge, 41, bounds, "one on 16 384 tiles");
}

/// No splats: the background, and gradients of nothing.
pub fn no_splats_give_the_background(stages: &dyn Stages<f32>) {
    let empty = Projected::<f32>::culled(0, 21, 18);
    let image = stages.rasterize(&empty, [0.25, 0.5, 0.75]).unwrap();
    assert!(image.color.iter().all(|&c| c == [0.25, 0.5, 0.75]));
    assert!(image.alpha.iter().all(|&a| a == 0.0));
    let v_image = random_image_gradients(&mut rng(7), 21 * 18);
    let v = stages.rasterize_backward(&empty, [0.25, 0.5, 0.75], &image, &v_image, false).unwrap();
    assert!(v.v_means2d.is_empty());
    let sum: f64 = v_image.v_color.iter().map(|v| f64::from(v[0])).sum();
    assert!((f64::from(v.v_background[0]) - sum).abs() < 1e-4);
    let camera = random_camera(&mut rng(8), 21, 18);
    let scene = random_scene(&mut rng(9), 0, Some(2));
    let options = ProjectOptions::default();
    let projected = stages.project(&scene.params(), &camera, &options).unwrap();
    assert_eq!(projected, empty);
    let none = ProjectedGradients::<f32>::zeros(0);
    let v = stages.project_backward(&scene.params(), &camera, &options, &projected, &none).unwrap();
    assert!(v.v_means.is_empty() && v.v_viewmat == [[0.0; 4]; 3]);
}

/// One poisoned value in one slot, all slots in turn: everything else keeps its bits, and so do its
/// gradients.
pub fn an_invalid_number_culls_one_splat_at_most(stages: &dyn Stages<f32>) {
    let mut rng = rng(10);
    let scene = random_scene(&mut rng, 24, Some(1));
    let camera = random_camera(&mut rng, 40, 30);
    let options = ProjectOptions::default();
    let clean = stages.project(&scene.params(), &camera, &options).unwrap();
    let v_given = random_projected_gradients(&mut rng, &clean);
    let v_clean =
        stages.project_backward(&scene.params(), &camera, &options, &clean, &v_given).unwrap();
    let poisons =
        [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38, -1e38, f32::MIN_POSITIVE / 8.0, 0.0];
    // Mean 3, quaternion 4, scale 3, opacity 1, one coefficient's 3 channels and the last one's.
    for slot in 0..17 {
        for poison in poisons {
            let mut scene = scene.clone();
            let i = 11;
            match slot {
                0..3 => scene.means[i][slot] = poison,
                3..7 => scene.quats[i][slot - 3] = poison,
                7..10 => scene.scales[i][slot - 7] = poison,
                10 => scene.opacities[i] = poison,
                11..14 => scene.colors[4 * i][slot - 11] = poison,
                _ => scene.colors[4 * i + 3][slot - 14] = poison,
            }
            let what = format!("slot {slot}, {poison}");
            let projected = stages.project(&scene.params(), &camera, &options).unwrap();
            for k in (0..24).filter(|&k| k != i) {
                assert_eq!(splat_2d(&projected, k), splat_2d(&clean, k), "{what}");
            }
            if poison.is_nan() || poison.is_infinite() {
                assert_eq!(projected.radii[i], [0.0; 2], "{what} must be culled");
            }
            let v = stages
                .project_backward(&scene.params(), &camera, &options, &projected, &v_given)
                .unwrap();
            for k in (0..24).filter(|&k| k != i) {
                let [got, expected] = [&v, &v_clean].map(|v| splat_gradients(v, k, 4));
                assert_eq!(got, expected, "{what}");
            }
            let pass = pass(stages, &scene, &camera, &options, Some(slot as u64));
            assert!(pass.image.color.iter().flatten().all(|v| v.is_finite()), "{what}: picture");
            assert!(all_finite(&pass.v_splats), "{what}: gradients");
        }
    }
}

/// Invisible splats in between change no bit of picture or gradients.
pub fn culled_splats_change_nothing(stages: &dyn Stages<f32>) {
    let mut rng = rng(7);
    let few = random_scene(&mut rng, 120, Some(2));
    let camera = random_camera(&mut rng, 90, 61);
    let (mut many, mut many_from_few) = (random_scene(&mut rng, 0, Some(2)), Vec::new());
    for i in 0..few.means.len() {
        let culled = [
            ([0.0, 0.0, -1e4], few.scales[i], few.opacities[i]),
            ([1e4, 0.0, 0.0], [-3.0; 3], few.opacities[i]),
            (few.means[i], few.scales[i], -20.0),
            (few.means[i], [f32::NAN; 3], few.opacities[i]),
        ];
        let own = (few.means[i], few.scales[i], few.opacities[i]);
        // None, one or several before each.
        let before = culled.into_iter().cycle().skip(i).take(i % 7);
        for (mean, scales, opacity) in before.chain([own]) {
            many.means.push(mean);
            many.quats.push(few.quats[i]);
            many.scales.push(scales);
            many.opacities.push(opacity);
            many.colors.extend(&few.colors[9 * i..9 * i + 9]);
        }
        many_from_few.push(many.means.len() - 1);
    }
    for options in OPTIONS {
        let [one, other] = [&few, &many].map(|scene| pass(stages, scene, &camera, &options, None));
        assert!(one.image == other.image, "picture");
        let (v2d, v2d_many) = (one.v_projected, other.v_projected);
        let (v, v_many) = (one.v_splats, other.v_splats);
        let seen = v.v_means.iter().filter(|&&v| v != [0.0; 3]).count();
        assert!(seen > 60, "only {seen} splats have a gradient");
        let (absolute, absolute_many) =
            (v2d.v_means2d_absolute.unwrap(), v2d_many.v_means2d_absolute.unwrap());
        for (i, &k) in many_from_few.iter().enumerate() {
            assert_eq!(v2d.v_means2d[i], v2d_many.v_means2d[k], "v_means2d {i}");
            assert_eq!(v2d.v_factors[i], v2d_many.v_factors[k], "v_factors {i}");
            assert_eq!(absolute[i], absolute_many[k], "v_means2d_absolute {i}");
            assert_eq!(splat_gradients(&v, i, 9), splat_gradients(&v_many, k, 9), "splat {i}");
        }
        let culled = v_many.v_means.iter().enumerate().filter(|(k, _)| !many_from_few.contains(k));
        for (k, v_mean) in culled {
            assert_eq!(*v_mean, [0.0; 3], "culled splat {k} has a gradient");
        }
    }
}

/// A scene 1e6 units from the origin: its means and cameras, taken relative to an f64 origin before
/// they become f32, give the picture and gradients of the scene at the origin.
pub fn a_far_away_scene_renders_as_one_at_the_origin(stages: &dyn Stages<f32>) {
    let mut rng = rng(8);
    let scene = random_scene(&mut rng, 200, Some(1));
    let camera = random_camera(&mut rng, 80, 60);
    let options = ProjectOptions::default();
    let offset = glam::DVec3::new(1e6, -2e6, 3e5);
    // World coordinates as a capture has them, and an origin near but not at the offset.
    let world = scene.means.iter().map(|m| glam::Vec3::from(*m).as_dvec3() + offset);
    let world_camera = camera.viewmat * glam::DMat4::from_translation(-offset);
    let origin = offset + glam::DVec3::new(0.25, -0.5, 0.125);
    let mut far = scene.clone();
    far.means = world.map(|m| (m - origin).as_vec3().to_array()).collect();
    let far_camera = splat_render::Camera {
        viewmat: world_camera * glam::DMat4::from_translation(origin),
        ..camera
    };
    let near = pass(stages, &scene, &camera, &options, Some(9));
    let far = pass(stages, &far, &far_camera, &options, Some(9));
    let (v, v_far) = (near.v_splats, far.v_splats);
    let off = image_difference(&far.image, &widen(&near.image), &[]);
    println!("picture {off:?}");
    assert!(off.max < 1e-3, "{off:?}");
    for (what, off) in [
        ("v_means", difference(&v_far.v_means, &widen(&v.v_means), &[])),
        ("v_scales", difference(&v_far.v_scales, &widen(&v.v_scales), &[])),
        ("v_quats", difference(&v_far.v_quats, &widen(&v.v_quats), &[])),
    ] {
        println!("{what} {off:?}");
        assert!(off.relative() < 1e-3, "{what}: {off:?}");
    }
}
