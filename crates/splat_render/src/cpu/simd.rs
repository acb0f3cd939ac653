//! Vector helpers on top of `pulp`, which picks the instruction set at run time.
//!
//! Code inside `with_simd` must use plain loops for vector operations: a closure, and so `array::map` or
//! `fold`, is compiled without the instruction set and turns every vector operation into a call.

use pulp::{Simd, WithSimd};

/// Runs `operation` with the widest instruction set of this machine.
#[inline]
pub(crate) fn dispatch<Operation: WithSimd>(operation: Operation) -> Operation::Output {
    #[cfg(test)]
    match tests::LANES.get() {
        1 => return pulp::Scalar.vectorize(operation),
        4 => return pulp::Scalar128b.vectorize(operation),
        8 => return pulp::Scalar256b.vectorize(operation),
        16 => return pulp::Scalar512b.vectorize(operation),
        _ => {}
    }
    pulp::Arch::new().dispatch(operation)
}

/// f32 lanes of the vectors that kernels run with on this machine.
fn lanes() -> usize {
    struct Lanes;
    impl pulp::WithSimd for Lanes {
        type Output = usize;
        fn with_simd<S: Simd>(self, _: S) -> usize {
            S::F32_LANES
        }
    }
    dispatch(Lanes)
}

/// Name of the instruction set that kernels run with on this machine.
pub fn instruction_set() -> &'static str {
    match (std::env::consts::ARCH, lanes()) {
        ("x86_64", 16) => "x86-64 AVX-512 (16 lanes)",
        ("x86_64", 8) => "x86-64 AVX2+FMA (8 lanes)",
        ("x86_64", _) => "x86-64 scalar",
        ("aarch64", 4) => "aarch64 NEON (4 lanes)",
        _ => "scalar",
    }
}

/// Prefetches a value of up to 64 bytes if Rust has an instruction for it.
#[inline(always)]
pub(super) fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let first = std::ptr::from_ref(value).cast::<i8>();
        // It may lie across two cache lines.
        let last = first.wrapping_add(size_of::<T>() - 1);
        // SAFETY: nothing is read: a prefetch is a hint, for any address.
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(first);
            _mm_prefetch::<_MM_HINT_T0>(last);
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// 2^-d for d >= 0, relative error below 1.2e-7; about 2^-126 above 126.
#[inline(always)]
pub fn exp2_of_minus<S: Simd>(s: S, d: S::f32s) -> S::f32s {
    // Adding 1.5 * 2^23 leaves the nearest integer in the low mantissa bits.
    const ROUND: f32 = 12_582_912.0;
    // Minimax of 2^-g (relative) on [-1/2, 1/2] with the constant fixed at 1, by Remez exchange.
    const C: [f32; 6] = [
        -std::f32::consts::LN_2,
        0.240_226_52,
        -0.055_503_402,
        0.009_617_821,
        -0.001_339_497_9,
        0.000_155_640_11,
    ];
    let d = s.min_f32s(d, s.splat_f32s(126.0));
    let shifted = s.sub_f32s(s.splat_f32s(ROUND), d);
    let g = s.add_f32s(d, s.sub_f32s(shifted, s.splat_f32s(ROUND)));
    // Estrin's scheme: half the latency of Horner's, which the loops around wait for.
    let g2 = s.mul_f32s(g, g);
    let low = s.mul_add_e_f32s(s.splat_f32s(C[0]), g, s.splat_f32s(1.0));
    let middle = s.mul_add_e_f32s(s.splat_f32s(C[2]), g, s.splat_f32s(C[1]));
    let high = s.mul_add_e_f32s(s.splat_f32s(C[4]), g, s.splat_f32s(C[3]));
    let high = s.mul_add_e_f32s(s.splat_f32s(C[5]), g2, high);
    let p = s.mul_add_e_f32s(s.mul_add_e_f32s(high, g2, middle), g2, low);
    let exponent = s.wrapping_dyn_shl_u32s(s.transmute_u32s_f32s(shifted), s.splat_u32s(23));
    s.transmute_f32s_u32s(s.add_u32s(s.transmute_u32s_f32s(p), exponent))
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use rand::{Rng, SeedableRng};

    use super::*;
    use crate::cpu::Cpu;
    use crate::cpu::loss::Loss;
    use crate::splats::SplatArrays;
    use crate::stages::{AdamState, AdamStep, Rates};
    use crate::target::Target;
    use crate::{
        Camera, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients,
        SplatGradients, Stages,
    };

    thread_local! {
        /// Overrides the number of lanes in a thread; 0 for the machine's.
        pub static LANES: Cell<usize> = const { Cell::new(0) };
    }

    type Results = (Image<f32>, ProjectedGradients<f32>, Vec<f32>);

    fn at<T: Send>(lanes: usize, work: impl FnOnce() -> T + Send) -> T {
        rayon::ThreadPoolBuilder::new()
            .num_threads(2)
            .start_handler(move |_| LANES.set(lanes))
            .build()
            .unwrap()
            .install(work)
    }

    /// A picture, its gradients and its loss, at this many lanes.
    fn run(lanes: usize, splats: &Projected<f32>) -> Results {
        at(lanes, || run_here(splats))
    }

    fn run_here(splats: &Projected<f32>) -> Results {
        let image = Cpu.rasterize(splats, [0.1, 0.2, 0.3]).unwrap();
        let v_image = ImageGradients {
            v_color: image.color.iter().map(|c| c.map(|v| v - 0.4)).collect(),
            v_alpha: image.alpha.clone(),
            v_depth: image.depth.clone(),
        };
        let v = Cpu.rasterize_backward(splats, [0.1, 0.2, 0.3], &image, &v_image, true).unwrap();
        let [r, g, b]: [Vec<f32>; 3] =
            std::array::from_fn(|c| image.color.iter().map(|color| color[c]).collect());
        let pixels = image.color.as_flattened().iter().map(|v| (255.0 * (1.0 - v)) as u8);
        let photo = Target::new(splats.width, splats.height, 3, pixels.collect());
        let photo = Target { weights: Some(r.clone()), ..photo };
        let mut loss = Loss::default();
        let mut out = vec![loss.run([&r, &g, &b], &photo, [0.0; 3], 0.2)];
        out.extend(loss.v_color.iter().flatten());
        (image, v, out)
    }

    fn apart<'a>(a: impl Iterator<Item = &'a f32>, b: impl Iterator<Item = &'a f32>) -> f32 {
        let (mut most, mut largest) = (0.0f32, 0.0f32);
        for (a, b) in a.zip(b) {
            let off = (a - b).abs();
            // Not the maximum alone, which passes over NaN.
            most = if off.is_nan() { f32::INFINITY } else { most.max(off) };
            largest = largest.max(b.abs());
        }
        most / largest
    }

    /// All vector widths must draw the same: 16 (AVX-512), 8 (AVX2), 4 (NEON) and 1 lanes.
    #[test]
    fn every_vector_width_draws_the_same() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(6);
        for (width, height) in [(75, 50), (16, 16), (5, 33)] {
            let n = 400;
            let mut splats = Projected::<f32>::culled(n, width, height);
            for i in 0..n {
                splats.means2d[i] = [
                    rng.random_range(-5.0..width as f32 + 5.0),
                    rng.random_range(-5.0..height as f32 + 5.0),
                ];
                let [p, q, r] = std::array::from_fn(|_| rng.random_range(0.08..1.2f32));
                splats.factors[i] = [p, q - 0.6, r];
                splats.opacities[i] = rng.random_range(0.02..1.0);
                splats.depths[i] = rng.random_range(1.0..9.0);
                splats.colors[i] = std::array::from_fn(|_| rng.random());
                splats.radii[i] = [60.0, 60.0];
            }
            let (image, v, loss) = run(0, &splats);
            for lanes in [1, 4, 8, 16] {
                let (image_n, v_n, loss_n) = run(lanes, &splats);
                let what = format!("{width}x{height} on {lanes} lanes");
                let color =
                    apart(image_n.color.as_flattened().iter(), image.color.iter().flatten());
                assert!(color < 1e-6, "{what}: picture {color:e}");
                // Not the same bits: without fused instructions, multiply-adds round twice.
                let t = apart(image_n.transmittance.iter(), image.transmittance.iter());
                assert!(t < 1e-6, "{what}: transmittance {t:e}");
                let pairs = [
                    (v_n.v_means2d.as_flattened(), v.v_means2d.as_flattened()),
                    (v_n.v_factors.as_flattened(), v.v_factors.as_flattened()),
                    (v_n.v_colors.as_flattened(), v.v_colors.as_flattened()),
                    (&v_n.v_opacities, &v.v_opacities),
                    (&v_n.v_depths, &v.v_depths),
                    (&loss_n, &loss),
                ];
                for (k, (a, b)) in pairs.into_iter().enumerate() {
                    let off = apart(a.iter(), b.iter());
                    assert!(off < 1e-5, "{what}: gradients {k} {off:e}");
                }
            }
        }
    }

    /// 2D splats, gradients of the splats, and parameters after a step of Adam.
    fn per_splat(
        splats: &SplatArrays,
        options: &ProjectOptions,
    ) -> (Projected<f32>, SplatGradients<f32>, AdamState<f32>) {
        let mut viewmat = glam::DMat4::from_rotation_y(0.4);
        viewmat.w_axis = glam::DVec4::new(0.1, -0.2, 3.0, 1.0);
        let (width, height) = (90, 60);
        let camera = Camera { viewmat, fx: 80.0, fy: 85.0, cx: 44.0, cy: 31.0, width, height };
        let params = splats.params(splats.sh_degree);
        let projected = Cpu.project(&params, &camera, options).unwrap();
        let n = splats.len();
        let mut v2d = ProjectedGradients::zeros(n);
        for i in 0..n {
            let wave = |k: usize| ((i * 7 + k) as f32).sin();
            v2d.v_means2d[i] = std::array::from_fn(wave);
            v2d.v_factors[i] = std::array::from_fn(|k| 0.1 * wave(k + 2));
            v2d.v_colors[i] = std::array::from_fn(|k| wave(k + 5));
            (v2d.v_depths[i], v2d.v_opacities[i]) = (wave(8), wave(9));
        }
        let v = Cpu.project_backward(&params, &camera, options, &projected, &v2d).unwrap();
        let zeros = SplatArrays::zeros(n, splats.sh_degree);
        let mut state = AdamState { splats: splats.clone(), first: zeros.clone(), second: zeros };
        let rates = Rates {
            means: 1e-3,
            quats: 1e-3,
            scales: 5e-3,
            opacities: 5e-2,
            sh0: 2e-3,
            sh_rest: 1e-4,
        };
        let step = AdamStep {
            number: 3,
            rates,
            sh_degree: splats.sh_degree,
            opacity_regularizer: 0.01,
            scale_regularizer: 0.01,
            noise: 10.0,
            noise_seed: 5,
        };
        Cpu.adam(&mut state, &v, &step).unwrap();
        (projected, v, state)
    }

    #[test]
    fn every_vector_width_moves_splats_the_same() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(8);
        // Numbers that leave blocks and vectors part full, and splats in between that are not drawn.
        for (n, degree) in [(1, 0), (63, 1), (130, 2), (331, 3), (90, 4)] {
            let mut splats = SplatArrays::zeros(n, degree);
            for i in 0..n {
                splats.means[i] = std::array::from_fn(|_| rng.random_range(-1.5..1.5));
                splats.quats[i] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
                splats.scales[i] = std::array::from_fn(|_| rng.random_range(-6.0..-1.0));
                splats.opacities[i] = rng.random_range(-4.0..4.0);
                match i % 9 {
                    4 => splats.means[i][1] = f32::NAN,
                    5 => splats.means[i][2] -= 9.0,
                    _ => {}
                }
            }
            for row in &mut splats.sh {
                *row = std::array::from_fn(|_| rng.random_range(-0.5..0.5));
            }
            for antialiased in [false, true] {
                let options = ProjectOptions { antialiased, ..ProjectOptions::default() };
                let (p, v, a) = at(0, || per_splat(&splats, &options));
                for lanes in [1, 4, 8, 16] {
                    let what = format!("{n} splats of SH {degree} on {lanes} lanes");
                    let (p_n, v_n, a_n) = at(lanes, || per_splat(&splats, &options));
                    let drawn = |p: &Projected<f32>| {
                        p.radii.iter().map(|r| *r != [0.0; 2]).collect::<Vec<_>>()
                    };
                    assert_eq!(drawn(&p_n), drawn(&p), "{what}");
                    let moved = |a: &AdamState<f32>, splats: &SplatArrays| -> Vec<f32> {
                        let rows = a.splats.means.as_flattened().iter();
                        let rows = rows.zip(splats.means.as_flattened());
                        // A result may be NaN only if the input was.
                        rows.filter(|(_, b)| b.is_finite()).map(|(a, b)| a - b).collect()
                    };
                    let viewmat = |v: &SplatGradients<f32>| -> Vec<f32> {
                        v.v_viewmat.as_flattened().iter().map(|&v| v as f32).collect()
                    };
                    let intrinsics = |v: &SplatGradients<f32>| v.v_intrinsics.map(|v| v as f32);
                    let pairs: [(&[f32], &[f32]); 16] = [
                        (p_n.means2d.as_flattened(), p.means2d.as_flattened()),
                        (p_n.factors.as_flattened(), p.factors.as_flattened()),
                        (p_n.colors.as_flattened(), p.colors.as_flattened()),
                        (p_n.radii.as_flattened(), p.radii.as_flattened()),
                        (&p_n.opacities, &p.opacities),
                        (v_n.v_means.as_flattened(), v.v_means.as_flattened()),
                        (v_n.v_quats.as_flattened(), v.v_quats.as_flattened()),
                        (v_n.v_scales.as_flattened(), v.v_scales.as_flattened()),
                        (v_n.v_colors.as_flattened(), v.v_colors.as_flattened()),
                        (&v_n.v_opacities, &v.v_opacities),
                        (&viewmat(&v_n), &viewmat(&v)),
                        (&intrinsics(&v_n), &intrinsics(&v)),
                        (&p_n.depths, &p.depths),
                        (a_n.first.scales.as_flattened(), a.first.scales.as_flattened()),
                        (&a_n.first.opacities, &a.first.opacities),
                        (&moved(&a_n, &splats), &moved(&a, &splats)),
                    ];
                    for (k, (a, b)) in pairs.into_iter().enumerate() {
                        let off = apart(a.iter(), b.iter());
                        let same = b.iter().all(|&b| b == 0.0) && a == b;
                        assert!(same || off < 1e-5, "{what}: array {k} {off:e}");
                    }
                }
            }
        }
    }

    struct Exp2(f32);
    impl pulp::WithSimd for Exp2 {
        type Output = f32;
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> f32 {
            let y = exp2_of_minus(s, s.splat_f32s(self.0));
            bytemuck::cast_slice::<_, f32>(&[y])[0]
        }
    }

    #[test]
    fn exp2_is_accurate_to_float_rounding() {
        let mut worst = 0.0f64;
        for i in 0..400_000 {
            let d = 20.0 * i as f32 / 400_000.0;
            let exact = (-f64::from(d)).exp2();
            let got = f64::from(dispatch(Exp2(d)));
            worst = worst.max((got / exact - 1.0).abs());
        }
        assert!(worst < 1.2e-7, "relative error {worst:e}");
        for d in [126.0, 127.0, 1e4, 1e30, f32::INFINITY] {
            let y = dispatch(Exp2(d));
            assert!((0.0..1e-37).contains(&y), "2^-{d} gave {y:e}");
        }
    }
}
