//! Exponential, logarithm, sine and cosine in lanes.

use pulp::Simd;

use super::lanes::Lanes;

/// Adding it leaves the nearest integer in the low mantissa bits.
const ROUND: f32 = 12_582_912.0;

/// ln 2 in two parts; the first has so few bits that its product with an exponent is exact.
const LN2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];

/// 2^n of an integer n that [`ROUND`] was added to, |n| < 127.
#[inline(always)]
fn power<S: Simd>(n: Lanes<S>) -> Lanes<S> {
    let s = n.simd();
    let bits = s.add_u32s(s.transmute_u32s_f32s(n.vector()), s.splat_u32s(127));
    Lanes::new(s, s.transmute_f32s_u32s(s.wrapping_dyn_shl_u32s(bits, s.splat_u32s(23))))
}

/// e^x with relative error below 1e-7 for normal results; 0 and infinity outside f32's range; NaN of NaN.
#[inline(always)]
pub(super) fn exp<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    // Of Cephes' expf: (e^r - 1 - r) / r^2 on |r| <= ln 2 / 2, from the highest power.
    const C: [f32; 6] =
        [1.987_569_1e-4, 1.398_2e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];
    let round = x.all(ROUND);
    // e^-104 rounds to 0 and e^89 to infinity.
    let inside = x.max(x.all(-104.0)).min(x.all(89.0));
    let n = inside.mul_add(x.all(std::f32::consts::LOG2_E), round) - round;
    let r = n.mul_add(x.all(-LN2[0]), inside);
    let r = n.mul_add(x.all(-LN2[1]), r);
    let mut p = x.all(C[0]);
    for c in &C[1..] {
        p = p.mul_add(r, x.all(*c));
    }
    let p = p.mul_add(r * r, r) + 1.0;
    // 2^n as two factors that are both normal: the product may be neither.
    let half = n.mul_add(x.all(0.5), round);
    let n0 = half - round;
    let y = p * power(half) * power(n - n0 + round);
    x.eq(x).select(y, x)
}

/// ln x of a positive normal number, relative error below 1e-7; undefined for other numbers.
#[inline(always)]
pub(super) fn ln<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    // Of Cephes' logf: (ln(1 + f) - f + f^2 / 2) / f^3 on sqrt(1/2) <= 1 + f < sqrt(2), from the
    // highest power.
    const C: [f32; 9] = [
        7.037_684e-2,
        -1.151_461e-1,
        1.167_699_9e-1,
        -1.242_014_1e-1,
        1.424_932_3e-1,
        -1.666_805_7e-1,
        2.000_071_5e-1,
        -2.499_999_4e-1,
        0.333_333_3,
    ];
    const SQRT_HALF: u32 = std::f32::consts::FRAC_1_SQRT_2.to_bits();
    const ONE: u32 = 1.0f32.to_bits();
    const TWO_TO_23: f32 = 8_388_608.0;
    let s = x.simd();
    // Moved so that the mantissa rolls over at sqrt(1/2).
    let bits = s.add_u32s(s.transmute_u32s_f32s(x.vector()), s.splat_u32s(ONE - SQRT_HALF));
    let mantissa = s.and_u32s(bits, s.splat_u32s(0x007f_ffff));
    let mantissa = s.add_u32s(mantissa, s.splat_u32s(SQRT_HALF));
    let f = Lanes::new(s, s.transmute_f32s_u32s(mantissa)) + -1.0;
    // The exponent as the low bits of 2^23 + exponent.
    let exponent = s.wrapping_dyn_shr_u32s(bits, s.splat_u32s(23));
    let exponent = s.or_u32s(exponent, s.splat_u32s(TWO_TO_23.to_bits()));
    let e = Lanes::new(s, s.transmute_f32s_u32s(exponent)) + -(TWO_TO_23 + 127.0);
    let mut p = x.all(C[0]);
    for c in &C[1..] {
        p = p.mul_add(f, x.all(*c));
    }
    let ff = f * f;
    let rest = (p * f).mul_add(ff, e * LN2[1]);
    let rest = ff.mul_add(x.all(-0.5), rest);
    e.mul_add(x.all(LN2[0]), f + rest)
}

/// Sine and cosine of 0 <= x <= 7, absolute error below 1.4e-7.
#[inline(always)]
pub(super) fn sin_cos<S: Simd>(x: Lanes<S>) -> (Lanes<S>, Lanes<S>) {
    // pi in three parts; products with 0, 1 and 2 are exact.
    const PI: [f32; 3] = [3.140_625, 9.675_026e-4, 1.509_958e-7];
    // Taylor's, which at a quarter turn are off by 7e-10 and 7e-9.
    const SIN: [f32; 6] = [
        1.0 / 6_227_020_800.0,
        -1.0 / 39_916_800.0,
        1.0 / 362_880.0,
        -1.0 / 5_040.0,
        1.0 / 120.0,
        -1.0 / 6.0,
    ];
    const COS: [f32; 6] =
        [1.0 / 479_001_600.0, -1.0 / 3_628_800.0, 1.0 / 40_320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5];
    let round = x.all(ROUND);
    let one = x.all(1.0);
    let half_turns = x.mul_add(x.all(std::f32::consts::FRAC_1_PI), round) - round;
    let mut r = x;
    for part in PI {
        r = half_turns.mul_add(x.all(-part), r);
    }
    let rr = r * r;
    let (mut sin, mut cos) = (x.all(SIN[0]), x.all(COS[0]));
    for k in 1..6 {
        sin = sin.mul_add(rr, x.all(SIN[k]));
        cos = cos.mul_add(rr, x.all(COS[k]));
    }
    let (sin, cos) = ((sin * rr).mul_add(r, r), cos.mul_add(rr, one));
    let turned = half_turns.eq(one);
    (turned.select(-sin, sin), turned.select(-cos, cos))
}

#[cfg(test)]
mod tests {
    use pulp::WithSimd;

    use super::*;
    use crate::cpu::simd::dispatch;

    #[derive(Clone, Copy)]
    enum Function {
        Exp,
        Ln,
        Sin,
        Cos,
    }

    struct Of<'a>(&'a [f32; 16], Function);
    impl WithSimd for Of<'_> {
        type Output = [f32; 16];
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> [f32; 16] {
            let mut out = [0.0; 16];
            let x = S::as_simd_f32s(self.0).0;
            for (k, y) in S::as_mut_simd_f32s(&mut out).0.iter_mut().enumerate() {
                let x = Lanes::new(s, x[k]);
                *y = match self.1 {
                    Function::Exp => exp(x),
                    Function::Ln => ln(x),
                    Function::Sin => sin_cos(x).0,
                    Function::Cos => sin_cos(x).1,
                }
                .vector();
            }
            out
        }
    }

    /// Largest relative error over `points`, sixteen at a time.
    fn worst(function: Function, points: impl Iterator<Item = f32>) -> f64 {
        let points: Vec<f32> = points.collect();
        let mut worst = 0.0f64;
        for x in points.as_chunks::<16>().0 {
            for (x, y) in x.iter().zip(dispatch(Of(x, function))) {
                let (x, y) = (f64::from(*x), f64::from(y));
                let off = match function {
                    Function::Exp => y / x.exp() - 1.0,
                    Function::Ln if x == 1.0 => y,
                    Function::Ln => y / x.ln() - 1.0,
                    Function::Sin => y - x.sin(),
                    Function::Cos => y - x.cos(),
                };
                worst = worst.max(off.abs());
            }
        }
        worst
    }

    #[test]
    fn exp_and_ln_are_accurate_to_float_rounding() {
        let steps = |n: u32| (0..n).map(move |i| f64::from(i) / f64::from(n));
        let all = worst(Function::Exp, steps(1 << 20).map(|t| (-87.3 + 175.9 * t) as f32));
        let near = worst(Function::Exp, steps(1 << 18).map(|t| (t - 0.5) as f32));
        println!("exp: {all:.2e}, near 0 {near:.2e}");
        assert!(all.max(near) < 1e-7, "exp is off by {all:e} and {near:e}");
        let all = worst(Function::Ln, steps(1 << 20).map(|t| (-126.0 + 253.9 * t).exp2() as f32));
        let near = worst(Function::Ln, (1..1 << 20).map(|i| f32::from_bits(1.0f32.to_bits() + i)));
        let far = worst(Function::Ln, steps(1 << 18).map(|t| (0.5 + 1.5 * t) as f32));
        println!("ln: {all:.2e}, over 1 {near:.2e}, around 1 {far:.2e}");
        assert!(all.max(near).max(far) < 1e-7, "ln is off by {all:e}, {near:e} and {far:e}");
    }

    #[test]
    fn sin_and_cos_are_accurate_to_float_rounding() {
        for function in [Function::Sin, Function::Cos] {
            let off = worst(function, (0..1 << 20).map(|i| 7.0 * i as f32 / (1 << 20) as f32));
            println!("{off:.2e}");
            assert!(off < 1.4e-7, "off by {off:e}");
        }
    }

    #[test]
    fn exp_has_the_limits_of_the_exponential() {
        let x = [
            0.0,
            -0.0,
            f32::NEG_INFINITY,
            f32::INFINITY,
            -104.5,
            -1e30,
            88.73,
            1e30,
            -100.0,
            88.7,
            f32::NAN,
            1e-30,
            -1e-45,
            -87.4,
            0.0,
            0.0,
        ];
        let y = dispatch(Of(&x, Function::Exp));
        assert_eq!([y[0], y[1], y[11], y[12]], [1.0; 4]);
        assert_eq!([y[2], y[4], y[5]], [0.0; 3]);
        assert_eq!([y[3], y[6], y[7]], [f32::INFINITY; 3]);
        assert!(y[10].is_nan());
        for k in [8, 9, 13] {
            let exact = f64::from(x[k]).exp();
            let off = (f64::from(y[k]) - exact).abs();
            let spacing = f64::from(f32::from_bits(1)).max(exact * 2.4e-7);
            assert!(off <= spacing, "exp {} gave {:e}", x[k], y[k]);
        }
    }
}
