//! 2D splats that a caller put together by hand: errors that name the culprit, never a panic.

mod common;

use common::{random_projected, rng, widen_projected};
use splat_render::cpu::Cpu;
use splat_render::reference::Reference;
use splat_render::{ImageGradients, Projected, Stages};

#[test]
fn wrong_sizes_and_lengths_are_named() {
    let good = random_projected(&mut rng(1), 5, 20, 10, 3.0);
    type Spoil = fn(&mut Projected<f32>);
    let cases: [(&str, Spoil); 4] = [
        ("width", |p| p.width = 0),
        ("height", |p| (p.width, p.height) = (1 << 30, 1 << 30)),
        ("factors", |p| p.factors.truncate(4)),
        ("radii", |p| p.radii.push([1.0; 2])),
    ];
    for (name, spoil) in cases {
        let mut bad = good.clone();
        spoil(&mut bad);
        let error = Cpu.rasterize(&bad, [0.0; 3]).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
        let error = Reference.rasterize(&widen_projected(&bad), [0.0; 3]).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
    }
    let image = Cpu.rasterize(&good, [0.0; 3]).unwrap();
    let none = ImageGradients::default();
    let error =
        Cpu.rasterize_backward(&good, [0.0; 3], &image, &none, false).unwrap_err().to_string();
    assert!(error.contains("v_color"), "{error}");
}

#[test]
fn values_that_are_not_finite_leave_the_others_alone() {
    let good = random_projected(&mut rng(2), 30, 40, 30, 4.0);
    let mut without = good.clone();
    without.radii[7] = [0.0; 2];
    let expected = Cpu.rasterize(&without, [0.1; 3]).unwrap();
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let cases: [fn(&mut Projected<f32>, f32); 5] = [
            |p, v| p.means2d[7][0] = v,
            |p, v| p.factors[7][1] = v,
            |p, v| p.radii[7][1] = v,
            |p, v| p.opacities[7] = v,
            |p, _| p.depths[7] = f32::NAN,
        ];
        for spoil in cases {
            let mut bad = good.clone();
            spoil(&mut bad, poison);
            assert_eq!(Cpu.rasterize(&bad, [0.1; 3]).unwrap(), expected);
        }
    }
}
