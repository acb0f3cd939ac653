//! Real spherical harmonics of degree 0-4 in the basis, order and signs of 3DGS (Sloan, 2013).

use std::ops::{Add, Mul, Neg, Sub};

use crate::constants::SH_COEFFS_MAX;

/// Constant of degree 0: sqrt(1 / 4 pi).
pub const C0: f64 = 0.282_094_791_773_878_14;
pub(crate) const C1: f64 = 0.488_602_511_902_919_9;
pub(crate) const C2: [f64; 3] =
    [1.092_548_430_592_079_2, 0.315_391_565_252_520_05, 0.546_274_215_296_039_6];
pub(crate) const C3: [f64; 5] = [
    0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    1.445_305_721_320_277,
];
pub(crate) const C4: [f64; 6] = [
    2.503_342_941_796_704_6,
    1.770_130_769_779_930_4,
    0.946_174_695_757_560_1,
    0.669_046_543_557_289_2,
    0.105_785_546_915_204_31,
    0.625_835_735_449_176_1,
];
/// Half of `C4[2]`, of the (xx - yy)(7zz - 1) term.
pub(crate) const C4_HALF: f64 = 0.473_087_347_878_780_04;

/// Number type of the basis: f32, f64, or several f32 side by side.
pub trait Number:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Neg<Output = Self>
{
    /// A constant of this type; the number itself does not matter.
    fn constant(self, value: f64) -> Self;
}

impl Number for f32 {
    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        value as f32
    }
}

impl Number for f64 {
    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        value
    }
}

/// Number of coefficients per channel up to `degree`.
pub const fn coeffs(degree: u32) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// Basis functions up to `degree` at the unit vector `dir`; entries beyond are zero.
#[inline(always)]
pub fn basis<T: Number>(degree: u32, dir: [T; 3]) -> [T; SH_COEFFS_MAX] {
    let [x, y, z] = dir;
    let mut b = [x.constant(0.0); SH_COEFFS_MAX];
    b[0] = x.constant(C0);
    if degree == 0 {
        return b;
    }
    b[1] = -x.constant(C1) * y;
    b[2] = x.constant(C1) * z;
    b[3] = -x.constant(C1) * x;
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let two = x.constant(2.0);
    b[4] = x.constant(C2[0]) * xy;
    b[5] = -x.constant(C2[0]) * yz;
    b[6] = x.constant(C2[1]) * (two * zz - xx - yy);
    b[7] = -x.constant(C2[0]) * xz;
    b[8] = x.constant(C2[2]) * (xx - yy);
    if degree == 2 {
        return b;
    }
    let (three, four) = (x.constant(3.0), x.constant(4.0));
    b[9] = -x.constant(C3[0]) * y * (three * xx - yy);
    b[10] = x.constant(C3[1]) * xy * z;
    b[11] = -x.constant(C3[2]) * y * (four * zz - xx - yy);
    b[12] = x.constant(C3[3]) * z * (two * zz - three * xx - three * yy);
    b[13] = -x.constant(C3[2]) * x * (four * zz - xx - yy);
    b[14] = x.constant(C3[4]) * z * (xx - yy);
    b[15] = -x.constant(C3[0]) * x * (xx - three * yy);
    if degree == 3 {
        return b;
    }
    let (seven, one) = (x.constant(7.0), x.constant(1.0));
    b[16] = x.constant(C4[0]) * xy * (xx - yy);
    b[17] = -x.constant(C4[1]) * yz * (three * xx - yy);
    b[18] = x.constant(C4[2]) * xy * (seven * zz - one);
    b[19] = -x.constant(C4[3]) * yz * (seven * zz - three);
    b[20] = x.constant(C4[4]) * (zz * (x.constant(35.0) * zz - x.constant(30.0)) + three);
    b[21] = -x.constant(C4[3]) * xz * (seven * zz - three);
    b[22] = x.constant(C4_HALF) * (xx - yy) * (seven * zz - one);
    b[23] = -x.constant(C4[1]) * xz * (xx - three * yy);
    b[24] = x.constant(C4[5]) * (xx * (xx - three * yy) - yy * (three * xx - yy));
    b
}

/// Derivatives of [`basis`] with respect to x, y and z taken as independent.
#[inline(always)]
pub fn basis_gradient<T: Number>(degree: u32, dir: [T; 3]) -> [[T; 3]; SH_COEFFS_MAX] {
    let [x, y, z] = dir;
    let o = x.constant(0.0);
    let mut d = [[o; 3]; SH_COEFFS_MAX];
    if degree == 0 {
        return d;
    }
    let k = x.constant(C1);
    d[1] = [o, -k, o];
    d[2] = [o, o, k];
    d[3] = [-k, o, o];
    if degree == 1 {
        return d;
    }
    let (two, four, six) = (x.constant(2.0), x.constant(4.0), x.constant(6.0));
    let k = x.constant(C2[0]);
    d[4] = [k * y, k * x, o];
    d[5] = [o, -k * z, -k * y];
    let k1 = x.constant(C2[1]);
    d[6] = [-two * k1 * x, -two * k1 * y, four * k1 * z];
    d[7] = [-k * z, o, -k * x];
    let k2 = x.constant(C2[2]);
    d[8] = [two * k2 * x, -two * k2 * y, o];
    if degree == 2 {
        return d;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let (three, eight) = (x.constant(3.0), x.constant(8.0));
    let k = x.constant(C3[0]);
    d[9] = [-six * k * xy, -three * k * (xx - yy), o];
    d[15] = [-three * k * (xx - yy), six * k * xy, o];
    let k = x.constant(C3[1]);
    d[10] = [k * yz, k * xz, k * xy];
    let k = x.constant(C3[2]);
    d[11] = [two * k * xy, -k * (four * zz - xx - three * yy), -eight * k * yz];
    d[13] = [-k * (four * zz - three * xx - yy), two * k * xy, -eight * k * xz];
    let k = x.constant(C3[3]);
    d[12] = [-six * k * xz, -six * k * yz, k * (six * zz - three * xx - three * yy)];
    let k = x.constant(C3[4]);
    d[14] = [two * k * xz, -two * k * yz, k * (xx - yy)];
    if degree == 3 {
        return d;
    }
    let (one, seven, t14) = (x.constant(1.0), x.constant(7.0), x.constant(14.0));
    let k = x.constant(C4[0]);
    d[16] = [k * y * (three * xx - yy), k * x * (xx - three * yy), o];
    let k = x.constant(C4[1]);
    d[17] = [-six * k * xy * z, -three * k * z * (xx - yy), -k * y * (three * xx - yy)];
    d[23] = [-three * k * z * (xx - yy), six * k * xy * z, -k * x * (xx - three * yy)];
    let k = x.constant(C4[2]);
    d[18] = [k * y * (seven * zz - one), k * x * (seven * zz - one), t14 * k * xy * z];
    let k = x.constant(C4[3]);
    let t21 = x.constant(21.0);
    d[19] = [o, -k * z * (seven * zz - three), -k * y * (t21 * zz - three)];
    d[21] = [-k * z * (seven * zz - three), o, -k * x * (t21 * zz - three)];
    let k = x.constant(C4[4]);
    d[20] = [o, o, k * z * (x.constant(140.0) * zz - x.constant(60.0))];
    let k = x.constant(C4_HALF);
    d[22] = [
        two * k * x * (seven * zz - one),
        -two * k * y * (seven * zz - one),
        t14 * k * z * (xx - yy),
    ];
    let k = four * x.constant(C4[5]);
    d[24] = [k * x * (xx - three * yy), k * y * (yy - three * xx), o];
    d
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_match_central_differences() {
        let step = 1e-5;
        for dir in [[0.3, -0.5, 0.8], [-0.9, 0.1, 0.2], [0.0, 0.0, 1.0], [0.6, 0.7, -0.3]] {
            let gradient = basis_gradient::<f64>(4, dir);
            for axis in 0..3 {
                let (mut low, mut high) = (dir, dir);
                low[axis] -= step;
                high[axis] += step;
                let (low, high) = (basis::<f64>(4, low), basis::<f64>(4, high));
                for i in 0..SH_COEFFS_MAX {
                    let numeric = (high[i] - low[i]) / (2.0 * step);
                    assert!(
                        (numeric - gradient[i][axis]).abs() < 1e-8,
                        "basis {i} axis {axis}: {numeric} vs {}",
                        gradient[i][axis]
                    );
                }
            }
        }
    }

    #[test]
    fn basis_is_orthonormal_on_the_sphere() {
        // Gauss-free check: a fine midpoint rule in (cos theta, phi).
        let (rows, columns) = (400, 200);
        let mut gram = vec![[0.0f64; SH_COEFFS_MAX]; SH_COEFFS_MAX];
        for r in 0..rows {
            let z = -1.0 + 2.0 * (f64::from(r) + 0.5) / f64::from(rows);
            let s = (1.0 - z * z).sqrt();
            for col in 0..columns {
                let phi = std::f64::consts::TAU * (f64::from(col) + 0.5) / f64::from(columns);
                let b = basis::<f64>(4, [s * phi.cos(), s * phi.sin(), z]);
                for i in 0..SH_COEFFS_MAX {
                    for j in 0..SH_COEFFS_MAX {
                        gram[i][j] += b[i] * b[j];
                    }
                }
            }
        }
        let area = 4.0 * std::f64::consts::PI / f64::from(rows * columns);
        for i in 0..SH_COEFFS_MAX {
            for j in 0..SH_COEFFS_MAX {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!(
                    (gram[i][j] * area - expected).abs() < 1e-3,
                    "{i},{j}: {}",
                    gram[i][j] * area
                );
            }
        }
    }
}
