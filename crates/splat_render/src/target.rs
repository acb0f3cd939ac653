//! Photos to fit, and the weights of their pixels.

use crate::error::{Error, Result};

/// One photo to fit to: 8-bit pixels, optional alpha and weights, and when the fit uses it.
#[derive(Debug, Clone)]
pub struct Target {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// 3 (RGB) or 4 (RGB and straight alpha).
    pub channels: u32,
    /// `[H * W * channels]`, row-major.
    pub pixels: Vec<u8>,
    /// `[H * W]` weight of each pixel in the loss, or None for 1 everywhere. The loss is a mean over
    /// the pixels whose weight is not 0: a photo of small weights counts less than others.
    pub weights: Option<Vec<f32>>,
    /// Depths of its pixels, if known.
    pub depth: Option<TargetDepth>,
    /// RGB in 0..=1 of the known background in a photo without alpha: renders are composited over it.
    pub background: Option<[f32; 3]>,
    /// How many steps of a round are of it, at least 1.
    pub turns: u32,
    /// The first step without the photo, or None.
    pub until: Option<u32>,
}

/// Depths of a photo's pixels, from a sensor or a network.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetDepth {
    /// `[H * W]` camera-space z, world units; above 0 if its confidence is.
    pub depths: Vec<f32>,
    /// `[H * W]` confidence in 0..=1; 0 if the depth is unknown.
    pub confidences: Vec<f32>,
}

impl TargetDepth {
    /// Checks sizes and values; the error continues the photo's name.
    pub(crate) fn validate(&self, pixels: usize) -> std::result::Result<(), &'static str> {
        if self.depths.len() != pixels || self.confidences.len() != pixels {
            return Err("has depths of another size than the image");
        }
        if !self.confidences.iter().all(|c| (0.0..=1.0).contains(c)) {
            return Err("has a depth's confidence outside of 0..=1");
        }
        let mut known = self.depths.iter().zip(&self.confidences).filter(|(_, c)| **c > 0.0);
        if !known.all(|(z, _)| z.is_finite() && *z >= f32::MIN_POSITIVE) {
            return Err("has a depth that is not finite and above 0");
        }
        Ok(())
    }

    /// Weight of a pixel of confidence 1 in the loss, which is a mean; 0 without known depths.
    pub(crate) fn scale(&self) -> f64 {
        let count = self.confidences.iter().filter(|c| **c > 0.0).count();
        if count > 0 { 1.0 / count as f64 } else { 0.0 }
    }
}

/// Sum and number of a photo's weights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weight {
    /// Sum of the weights.
    pub sum: f64,
    /// How many are not 0.
    pub count: f64,
}

impl Weight {
    /// Of a list of weights.
    pub fn of(weights: &[f32]) -> Self {
        Self {
            sum: weights.iter().map(|&w| f64::from(w)).sum(),
            count: weights.iter().filter(|w| **w > 0.0).count() as f64,
        }
    }

    /// Weight of one channel of a pixel of weight 1 in the loss; 0 if all is masked out.
    pub(crate) fn scale(&self) -> f64 {
        if self.count > 0.0 { 1.0 / (3.0 * self.count) } else { 0.0 }
    }

    /// The loss from the weighted sums of |x - y| and SSIM over all channels.
    pub(crate) fn loss(&self, ssim_weight: f64, l1: f64, ssim: f64) -> f64 {
        let scale = self.scale();
        (1.0 - ssim_weight) * l1 * scale + ssim_weight * (3.0 * self.sum - ssim) * scale
    }
}

impl Target {
    /// A photo without weights, depths or a known background, in every round until the end.
    pub fn new(width: u32, height: u32, channels: u32, pixels: Vec<u8>) -> Self {
        Self {
            width,
            height,
            channels,
            pixels,
            weights: None,
            depth: None,
            background: None,
            turns: 1,
            until: None,
        }
    }

    /// Checks sizes and values; `index` names the photo in the error.
    pub fn validate(&self, index: usize) -> Result<()> {
        let pixels = self.width as usize * self.height as usize;
        let bad = |reason: String| Err(Error::argument(format!("images[{index}]"), reason));
        if pixels == 0 {
            return bad("has no pixels".into());
        }
        if !matches!(self.channels, 3 | 4) {
            return bad(format!("has {} channels; give RGB or RGBA", self.channels));
        }
        if self.pixels.len() != pixels * self.channels as usize {
            return bad("does not hold width x height pixels".into());
        }
        if self.background.is_some_and(|color| color.iter().any(|c| !(0.0..=1.0).contains(c))) {
            return bad("has a background outside of 0..=1".into());
        }
        if self.turns == 0 {
            return bad("has no turn; give at least one".into());
        }
        if let Some(weights) = &self.weights {
            if weights.len() != pixels {
                return bad("its weights do not have the image's size".into());
            }
            if !weights.iter().all(|w| w.is_finite() && *w >= 0.0) {
                return bad("has a weight that is negative or not finite".into());
            }
        }
        if let Some(depth) = &self.depth {
            depth.validate(pixels).or_else(|reason| bad(reason.into()))?;
        }
        Ok(())
    }

    /// Sum of the weights, and the number of pixels whose weight is not 0.
    pub fn weight(&self) -> Weight {
        let pixels = f64::from(self.width) * f64::from(self.height);
        self.weights.as_deref().map_or(Weight { sum: pixels, count: pixels }, Weight::of)
    }

    /// The photo with each `by` x `by` pixels averaged into one; leftover rows and columns are dropped.
    ///
    /// Colors are weighted by alpha and by the weights, which are averaged too. The depth is taken from a
    /// pixel in the middle: a mean over an edge is on no surface.
    pub fn reduced(&self, by: u32) -> Self {
        let (width, height) = (self.width / by, self.height / by);
        let (side, channels) = (by as usize, self.channels as usize);
        let (old, new) = (self.width as usize, width as usize);
        let mut pixels = vec![0u8; new * height as usize * channels];
        let mut weights = self.weights.as_ref().map(|_| vec![0.0f32; new * height as usize]);
        let area = f64::from(by * by);
        for at in 0..new * height as usize {
            let (row, column) = (at / new * side, at % new * side);
            let (mut color, mut of_color, mut alpha, mut weight) = ([0.0f64; 3], 0.0, 0.0, 0.0);
            for i in
                (row..row + side).flat_map(|y| (column..column + side).map(move |x| y * old + x))
            {
                let w = self.weights.as_ref().map_or(1.0, |weights| f64::from(weights[i]));
                let pixel = &self.pixels[i * channels..(i + 1) * channels];
                let a = if channels == 4 { f64::from(pixel[3]) } else { 1.0 };
                for (sum, &value) in color.iter_mut().zip(pixel) {
                    *sum += w * a * f64::from(value);
                }
                of_color += w * a;
                alpha += w * a;
                weight += w;
            }
            let out = &mut pixels[at * channels..(at + 1) * channels];
            for (out, sum) in out.iter_mut().zip(color) {
                *out = (sum / f64::max(of_color, 1e-9)).round() as u8;
            }
            if channels == 4 {
                out[3] = (alpha / f64::max(weight, 1e-9)).round() as u8;
            }
            if let Some(weights) = &mut weights {
                weights[at] = (weight / area) as f32;
            }
        }
        let middles = (0..new * height as usize).map(|at| {
            let (row, column) = (at / new * side + side / 2, at % new * side + side / 2);
            row * old + column
        });
        let depth = self.depth.as_ref().map(|depth| TargetDepth {
            depths: middles.clone().map(|i| depth.depths[i]).collect(),
            confidences: middles.map(|i| depth.confidences[i]).collect(),
        });
        Self { width, height, pixels, weights, depth, ..self.clone_settings() }
    }

    /// Everything but the pixels, their weights and depths.
    fn clone_settings(&self) -> Self {
        Self {
            width: self.width,
            height: self.height,
            channels: self.channels,
            pixels: Vec::new(),
            weights: None,
            depth: None,
            background: self.background,
            turns: self.turns,
            until: self.until,
        }
    }

    /// A row of one channel of the photo over `background`, that channel's, in 0..1.
    #[inline(always)]
    pub fn row(&self, row: usize, channel: usize, background: f32, out: &mut [f32]) {
        let width = self.width as usize;
        let unit = 1.0 / 255.0;
        if self.channels == 3 {
            let pixels = self.pixels[3 * row * width..].chunks_exact(3);
            for (out, pixel) in out[..width].iter_mut().zip(pixels) {
                *out = f32::from(pixel[channel]) * unit;
            }
        } else {
            let pixels = self.pixels[4 * row * width..].chunks_exact(4);
            for (out, pixel) in out[..width].iter_mut().zip(pixels) {
                let alpha = f32::from(pixel[3]) * unit;
                *out = f32::from(pixel[channel]) * unit * alpha + background * (1.0 - alpha);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photo(channels: u32, pixels: Vec<u8>, weights: Option<Vec<f32>>) -> Target {
        Target {
            width: 3,
            height: 2,
            channels,
            pixels,
            weights,
            depth: None,
            background: None,
            turns: 2,
            until: Some(7),
        }
    }

    #[test]
    fn a_reduced_photo_has_weighted_means() {
        let plain = photo(3, (0..18).map(|i| 10 * i as u8).collect(), None).reduced(2);
        assert_eq!((plain.width, plain.height, plain.turns, plain.until), (1, 1, 2, Some(7)));
        // Pixels 0, 1, 3 and 4; the last column is left over.
        assert_eq!(plain.pixels, [60, 70, 80]);
        let mut pixels = vec![200u8; 24];
        pixels[..4].copy_from_slice(&[0, 100, 50, 255]);
        pixels[4..8].copy_from_slice(&[255, 255, 255, 0]);
        pixels[12..16].copy_from_slice(&[40, 100, 50, 255]);
        let weights = vec![1.0, 1.0, 0.0, 1.0, 0.0, 0.0];
        let clear = photo(4, pixels, Some(weights)).reduced(2);
        // The transparent pixel and the one of weight 0 do not contribute colors.
        assert_eq!(clear.pixels, [20, 100, 50, 170]);
        assert_eq!(clear.weights, Some(vec![0.75]));
        clear.validate(0).unwrap();
    }
}
