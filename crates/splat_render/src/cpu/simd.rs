//! Vector helpers on top of `pulp`, which picks the instruction set at run time.
//!
//! Code that runs inside `with_simd` must use plain loops where vectors are touched: a closure, and
//! so `array::map` or `fold`, is compiled without the instruction set and turns every vector
//! operation into a call.

use pulp::Simd;

/// f32 lanes of the vectors that kernels run with on this machine.
fn lanes() -> usize {
    struct Lanes;
    impl pulp::WithSimd for Lanes {
        type Output = usize;
        fn with_simd<S: Simd>(self, _: S) -> usize {
            S::F32_LANES
        }
    }
    pulp::Arch::new().dispatch(Lanes)
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

/// 2^-d for d >= 0, relative error below 1e-7 (1.4e-8 of the polynomial, the rest rounding).
/// Above 126 it returns about 2^-126.
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
    use super::*;

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
            let got = f64::from(pulp::Arch::new().dispatch(Exp2(d)));
            worst = worst.max((got / exact - 1.0).abs());
        }
        assert!(worst < 1.2e-7, "relative error {worst:e}");
        for d in [126.0, 127.0, 1e4, 1e30, f32::INFINITY] {
            let y = pulp::Arch::new().dispatch(Exp2(d));
            assert!((0.0..1e-37).contains(&y), "2^-{d} gave {y:e}");
        }
    }
}
