//! Exposure and white balance of a photo, applied to a rendered picture.

use num_traits::Float;

use crate::error::{Error, Result};

/// Gain and offset per channel of one photo. For a photo without alpha, colors become `gain * color +
/// offset`. In a photo with alpha, only the foreground was exposed: with T the picture's transmittance
/// and b its background, colors become `gain * (color - T b) + offset * (1 - T) + T b`.
///
/// The result is clamped to 0..=1, the range of photos: white pixels of a photo match any brighter color.
/// Gradients pass if they move a clamped color back toward the range, and are dropped if they would move
/// it further out.
///
/// Colors are encoded as in photos (sRGB), 1 at the brightest: one stop is a gain of about 2^(1/2.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exposure<T> {
    /// Factor of R, G and B.
    pub gain: [T; 3],
    /// Added to R, G and B after the factor.
    pub offset: [T; 3],
    /// RGB of the background that stays as it is, of a photo with alpha.
    pub background: Option<[T; 3]>,
}

impl<T: Float> Exposure<T> {
    /// An exposure that changes nothing.
    pub fn none() -> Self {
        Self { gain: [T::one(); 3], offset: [T::zero(); 3], background: None }
    }

    /// Change of a color per unit of transmittance: b - gain b - offset, 0 without a background.
    pub(crate) fn behind(&self) -> [T; 3] {
        let Some(background) = self.background else { return [T::zero(); 3] };
        std::array::from_fn(|c| background[c] - self.gain[c] * background[c] - self.offset[c])
    }

    /// The part of a corrected color's gradient `v` that passes the clamp; `raw` is the color before it.
    #[inline(always)]
    pub(crate) fn passed(raw: T, v: T) -> T {
        let leaves = (raw > T::one() && v < T::zero()) || (raw < T::zero() && v > T::zero());
        if leaves { T::zero() } else { v }
    }

    /// Checks that all values are finite.
    pub fn validate(&self) -> Result<()> {
        let background = self.background.unwrap_or([T::zero(); 3]);
        for (name, values) in
            [("gain", self.gain), ("offset", self.offset), ("background", background)]
        {
            if !values.iter().all(|v| v.is_finite()) {
                return Err(Error::argument(name, "must be three finite numbers"));
            }
        }
        Ok(())
    }
}

/// Gradients of a loss of the corrected picture.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ExposureGradients<T> {
    /// `[H * W]` with respect to the picture's colors.
    pub v_color: Vec<[T; 3]>,
    /// `[H * W]` with respect to the picture's alpha; zeros in a photo without alpha.
    pub v_alpha: Vec<T>,
    /// With respect to the gain.
    pub v_gain: [f64; 3],
    /// With respect to the offset.
    pub v_offset: [f64; 3],
}
