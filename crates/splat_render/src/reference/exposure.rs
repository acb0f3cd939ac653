//! exposure and exposure_backward: a picture's colors as a photo of some gain and offset has them.

use crate::stages::{Exposure, ExposureGradients, Image};

/// A pixel's color before the clamp to 0..=1.
fn raw(exposure: &Exposure<f64>, color: [f64; 3], t: f64) -> [f64; 3] {
    let Exposure { gain, offset, background } = *exposure;
    std::array::from_fn(|c| match background {
        None => gain[c] * color[c] + offset[c],
        Some(b) => gain[c] * (color[c] - t * b[c]) + offset[c] * (1.0 - t) + t * b[c],
    })
}

pub(super) fn exposure(image: &Image<f64>, exposure: &Exposure<f64>) -> Vec<[f64; 3]> {
    let pixels = image.color.iter().zip(&image.transmittance);
    pixels.map(|(&color, &t)| raw(exposure, color, t).map(|v| v.clamp(0.0, 1.0))).collect()
}

pub(super) fn exposure_backward(
    image: &Image<f64>,
    exposure: &Exposure<f64>,
    v_corrected: &[[f64; 3]],
) -> ExposureGradients<f64> {
    let mut out = ExposureGradients::default();
    for ((&color, &transmittance), v) in
        image.color.iter().zip(&image.transmittance).zip(v_corrected)
    {
        let raw = raw(exposure, color, transmittance);
        let v: [f64; 3] = std::array::from_fn(|c| Exposure::passed(raw[c], v[c]));
        // The part of the pixel that the exposure does not change.
        let (t, b) = exposure.background.map_or((0.0, [0.0; 3]), |b| (transmittance, b));
        let mut v_t = 0.0;
        for c in 0..3 {
            out.v_gain[c] += v[c] * (color[c] - t * b[c]);
            out.v_offset[c] += v[c] * (1.0 - t);
            if exposure.background.is_some() {
                v_t += v[c] * (b[c] - exposure.gain[c] * b[c] - exposure.offset[c]);
            }
        }
        out.v_color.push(std::array::from_fn(|c| exposure.gain[c] * v[c]));
        out.v_alpha.push(-v_t);
    }
    out
}
