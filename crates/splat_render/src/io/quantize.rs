//! Numbers as the few bits that formats give them, and back.

use crate::sh::C0;

/// Position within its step of an opacity byte of 0 or 255: logits of exactly 0 and 1 would be infinite,
/// and the written value lies within half a step of them.
const OPACITY_END: f64 = 0.25 / 255.0;

pub fn sigmoid(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

/// The finite logit of an opacity in [0, 1].
pub fn logit(opacity: f64) -> f32 {
    // f32 has no number between the last and 1.
    let end = f64::from(f32::EPSILON) / 2.0;
    let o = opacity.clamp(end, 1.0 - end);
    (o / (1.0 - o)).ln() as f32
}

/// The nearest of 256 opacities.
pub fn opacity_byte(opacity_logit: f32) -> u8 {
    unit_byte(sigmoid(opacity_logit))
}

/// The logit of an opacity byte.
pub fn logit_of_byte(byte: u8) -> f32 {
    logit((f64::from(byte) / 255.0).clamp(OPACITY_END, 1.0 - OPACITY_END))
}

/// The nearest of 256 values in [0, 1].
pub fn unit_byte(value: f64) -> u8 {
    // `as` saturates, and NaN becomes 0.
    (value * 255.0).round() as u8
}

/// 0.5 + C0 dc: the color of a splat without view dependence.
pub fn color_of_dc(dc: f32) -> f64 {
    0.5 + C0 * f64::from(dc)
}

/// The DC coefficient of a color.
pub fn dc_of_color(color: f64) -> f32 {
    ((color - 0.5) / C0) as f32
}

/// The nearest of 2^bits numbers to a value in [0, 1].
pub fn unit_bits(value: f64, bits: u32) -> u32 {
    let top = f64::from((1u32 << bits) - 1);
    (value.clamp(0.0, 1.0) * top).round() as u32
}

/// A rotation as three of its components and the fourth's index.
pub struct SmallestThree {
    /// Index of the component that is left out, the largest.
    pub largest: usize,
    /// The rest in order, each in [-sqrt(1/2), sqrt(1/2)], with the sign that makes the largest positive.
    pub others: [f64; 3],
}

impl SmallestThree {
    /// Of a quaternion that is not zero, whatever its length.
    pub fn of(quat: [f64; 4]) -> Self {
        let norm = quat.iter().map(|c| c * c).sum::<f64>().sqrt();
        let mut largest = 0;
        for i in 1..4 {
            if quat[i].abs() > quat[largest].abs() {
                largest = i;
            }
        }
        let scale = quat[largest].signum() / norm;
        let mut others = (0..4).filter(|&i| i != largest).map(|i| quat[i] * scale);
        Self { largest, others: std::array::from_fn(|_| others.next().unwrap_or(0.0)) }
    }

    pub fn quat(&self) -> [f64; 4] {
        let rest = 1.0 - self.others.iter().map(|c| c * c).sum::<f64>();
        let mut others = self.others.iter();
        std::array::from_fn(|i| {
            if i == self.largest {
                rest.max(0.0).sqrt()
            } else {
                others.next().copied().unwrap_or(0.0)
            }
        })
    }
}

pub fn to_f32<const N: usize>(x: [f64; N]) -> [f32; N] {
    x.map(|c| c as f32)
}

pub fn to_f64<const N: usize>(x: [f32; N]) -> [f64; N] {
    x.map(f64::from)
}
