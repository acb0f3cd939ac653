//! The depth loss of a pixel.

use num_traits::Float;

use crate::constants::DEPTH_ALPHA;

/// Loss of a picture's depth against a photo's, and its gradients.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DepthLoss<T> {
    /// The loss; 0 without known depths.
    pub value: T,
    /// `[H * W]` with respect to the picture's alpha.
    pub v_alpha: Vec<T>,
    /// `[H * W]` with respect to the picture's accumulated depth.
    pub v_depth: Vec<T>,
}

/// A pixel's loss `2 |D - A z| / (D + A z)` with its gradients with respect to A and D, for the picture's
/// alpha A, its accumulated depth D and the photo's depth z; 0 if the picture is too transparent to have
/// a depth.
#[inline(always)]
pub(crate) fn pixel<T: Float>(alpha: T, depth: T, z: T) -> [T; 3] {
    let (zero, two) = (T::zero(), T::one() + T::one());
    let opaque = alpha >= T::from(DEPTH_ALPHA).unwrap_or_else(T::one);
    let expected = alpha * z;
    let inverse = T::one() / (depth + expected);
    let difference = (depth - expected) * inverse;
    // |x| has no slope at 0.
    let sign = if difference > zero {
        T::one()
    } else if difference < zero {
        -T::one()
    } else {
        zero
    };
    let slope = two * two * sign * inverse * inverse;
    if opaque { [two * difference.abs(), -slope * depth * z, slope * expected] } else { [zero; 3] }
}
