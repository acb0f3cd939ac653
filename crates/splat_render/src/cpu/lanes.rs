//! Arithmetic on lanes: numbers and 3-vectors, one splat per vector lane. Operators keep formulas
//! readable; they are always-inlined functions, not closures (see `simd.rs`).

use std::ops::{Add, BitAnd, Div, Mul, Neg, Not, Sub};

use glam::Vec3;
use pulp::Simd;

use crate::sh::Number;

#[derive(Clone, Copy)]
pub(super) struct Lanes<S: Simd> {
    s: S,
    v: S::f32s,
}

/// One truth per lane.
#[derive(Clone, Copy)]
pub(super) struct Mask<S: Simd> {
    s: S,
    v: S::m32s,
}

impl<S: Simd> Lanes<S> {
    #[inline(always)]
    pub fn new(s: S, v: S::f32s) -> Self {
        Self { s, v }
    }

    #[inline(always)]
    pub fn splat(s: S, value: f32) -> Self {
        Self { s, v: s.splat_f32s(value) }
    }

    #[inline(always)]
    pub fn vector(self) -> S::f32s {
        self.v
    }

    #[inline(always)]
    pub fn simd(self) -> S {
        self.s
    }

    #[inline(always)]
    pub fn all(self, value: f32) -> Self {
        Self::splat(self.s, value)
    }

    /// `self * factor + summand`, rounded once if the machine has fused multiply-add.
    #[inline(always)]
    pub fn mul_add(self, factor: Self, summand: Self) -> Self {
        Self { s: self.s, v: self.s.mul_add_e_f32s(self.v, factor.v, summand.v) }
    }

    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self { s: self.s, v: self.s.sqrt_f32s(self.v) }
    }

    #[inline(always)]
    pub fn recip(self) -> Self {
        self.all(1.0) / self
    }

    #[inline(always)]
    pub fn abs(self) -> Self {
        Self { s: self.s, v: self.s.abs_f32s(self.v) }
    }

    /// The smaller one; either one if one is NaN.
    #[inline(always)]
    pub fn min(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.min_f32s(self.v, other.v) }
    }

    /// The larger one; either one if one is NaN.
    #[inline(always)]
    pub fn max(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.max_f32s(self.v, other.v) }
    }

    #[inline(always)]
    pub fn eq(self, other: Self) -> Mask<S> {
        Mask { s: self.s, v: self.s.equal_f32s(self.v, other.v) }
    }

    #[inline(always)]
    pub fn gt(self, other: Self) -> Mask<S> {
        Mask { s: self.s, v: self.s.greater_than_f32s(self.v, other.v) }
    }

    #[inline(always)]
    pub fn ge(self, other: Self) -> Mask<S> {
        Mask { s: self.s, v: self.s.greater_than_or_equal_f32s(self.v, other.v) }
    }

    #[inline(always)]
    pub fn le(self, other: Self) -> Mask<S> {
        other.ge(self)
    }

    #[inline(always)]
    pub fn is_finite(self) -> Mask<S> {
        self.abs().le(self.all(f32::MAX))
    }
}

impl<S: Simd> Number for Lanes<S> {
    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        self.all(value as f32)
    }
}

impl<S: Simd> Mask<S> {
    /// `yes` in true lanes, `no` elsewhere.
    #[inline(always)]
    pub fn select(self, yes: Lanes<S>, no: Lanes<S>) -> Lanes<S> {
        Lanes { s: self.s, v: self.s.select_f32s(self.v, yes.v, no.v) }
    }

    /// `yes` in true lanes, zero elsewhere.
    #[inline(always)]
    pub fn keep(self, yes: Lanes<S>) -> Lanes<S> {
        self.select(yes, yes.all(0.0))
    }

    /// [`Mask::keep`] of each component.
    #[inline(always)]
    pub fn keep3(self, yes: Vec3s<S>) -> Vec3s<S> {
        Vec3s { x: self.keep(yes.x), y: self.keep(yes.y), z: self.keep(yes.z) }
    }
}

impl<S: Simd> BitAnd for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.and_m32s(self.v, other.v) }
    }
}

impl<S: Simd> Not for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self { s: self.s, v: self.s.not_m32s(self.v) }
    }
}

impl<S: Simd> Add for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.add_f32s(self.v, other.v) }
    }
}

impl<S: Simd> Sub for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.sub_f32s(self.v, other.v) }
    }
}

impl<S: Simd> Mul for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.mul_f32s(self.v, other.v) }
    }
}

impl<S: Simd> Div for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.div_f32s(self.v, other.v) }
    }
}

impl<S: Simd> Neg for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self { s: self.s, v: self.s.neg_f32s(self.v) }
    }
}

impl<S: Simd> Mul<f32> for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: f32) -> Self {
        self * self.all(factor)
    }
}

impl<S: Simd> Add<f32> for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, summand: f32) -> Self {
        self + self.all(summand)
    }
}

#[derive(Clone, Copy)]
pub(super) struct Vec3s<S: Simd> {
    pub x: Lanes<S>,
    pub y: Lanes<S>,
    pub z: Lanes<S>,
}

impl<S: Simd> Vec3s<S> {
    #[inline(always)]
    pub fn new(x: Lanes<S>, y: Lanes<S>, z: Lanes<S>) -> Self {
        Self { x, y, z }
    }

    #[inline(always)]
    pub fn splat(s: S, v: Vec3) -> Self {
        Self { x: Lanes::splat(s, v.x), y: Lanes::splat(s, v.y), z: Lanes::splat(s, v.z) }
    }

    #[inline(always)]
    pub fn dot(self, other: Self) -> Lanes<S> {
        self.z.mul_add(other.z, self.y.mul_add(other.y, self.x * other.x))
    }

    #[inline(always)]
    pub fn length_squared(self) -> Lanes<S> {
        self.dot(self)
    }

    #[inline(always)]
    pub fn length(self) -> Lanes<S> {
        self.length_squared().sqrt()
    }

    #[inline(always)]
    pub fn cross(self, other: Self) -> Self {
        Self {
            x: self.y.mul_add(other.z, -(self.z * other.y)),
            y: self.z.mul_add(other.x, -(self.x * other.z)),
            z: self.x.mul_add(other.y, -(self.y * other.x)),
        }
    }

    #[inline(always)]
    pub fn mul_add(self, factor: Lanes<S>, summand: Self) -> Self {
        Self {
            x: self.x.mul_add(factor, summand.x),
            y: self.y.mul_add(factor, summand.y),
            z: self.z.mul_add(factor, summand.z),
        }
    }

    #[inline(always)]
    pub fn is_finite(self) -> Mask<S> {
        self.x.is_finite() & self.y.is_finite() & self.z.is_finite()
    }
}

impl<S: Simd> Add for Vec3s<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { x: self.x + other.x, y: self.y + other.y, z: self.z + other.z }
    }
}

impl<S: Simd> Sub for Vec3s<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { x: self.x - other.x, y: self.y - other.y, z: self.z - other.z }
    }
}

impl<S: Simd> Mul for Vec3s<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self { x: self.x * other.x, y: self.y * other.y, z: self.z * other.z }
    }
}

impl<S: Simd> Mul<Lanes<S>> for Vec3s<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: Lanes<S>) -> Self {
        Self { x: self.x * factor, y: self.y * factor, z: self.z * factor }
    }
}

/// A quaternion's squared norm, one over its norm, and itself with the norm 1.
#[inline(always)]
pub(super) fn normalized<S: Simd>(quat: [Lanes<S>; 4]) -> (Lanes<S>, Lanes<S>, [Lanes<S>; 4]) {
    let [w, x, y, z] = quat;
    let norm2 = w.mul_add(w, x.mul_add(x, y.mul_add(y, z * z)));
    let inverse = norm2.sqrt().recip();
    (norm2, inverse, [w * inverse, x * inverse, y * inverse, z * inverse])
}

/// One 3x3 matrix per lane, by its columns.
#[derive(Clone, Copy)]
pub(super) struct Mat3s<S: Simd>(pub [Vec3s<S>; 3]);

impl<S: Simd> Mat3s<S> {
    /// The rotation of a unit quaternion (w, x, y, z).
    #[inline(always)]
    pub fn from_quat([w, x, y, z]: [Lanes<S>; 4]) -> Self {
        let (x2, y2, z2) = (x + x, y + y, z + z);
        let (xx, xy, xz) = (x * x2, x * y2, x * z2);
        let (yy, yz, zz) = (y * y2, y * z2, z * z2);
        let (wx, wy, wz) = (w * x2, w * y2, w * z2);
        let one = w.all(1.0);
        Self([
            Vec3s::new(one - (yy + zz), xy + wz, xz - wy),
            Vec3s::new(xy - wz, one - (xx + zz), yz + wx),
            Vec3s::new(xz + wy, yz - wx, one - (xx + yy)),
        ])
    }

    #[inline(always)]
    pub fn transpose_mul(self, v: Vec3s<S>) -> Vec3s<S> {
        let Self([x, y, z]) = self;
        Vec3s::new(x.dot(v), y.dot(v), z.dot(v))
    }
}

impl<S: Simd> Mul<Vec3s<S>> for Mat3s<S> {
    type Output = Vec3s<S>;
    #[inline(always)]
    fn mul(self, v: Vec3s<S>) -> Vec3s<S> {
        let Self([x, y, z]) = self;
        z.mul_add(v.z, y.mul_add(v.y, x * v.x))
    }
}
