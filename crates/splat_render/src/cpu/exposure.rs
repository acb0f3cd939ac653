//! exposure and exposure_backward: a picture's colors as a photo of some gain and offset has them.

use rayon::prelude::*;

use super::rasterize::Planes;
use crate::stages::{Exposure, ExposureGradients, Image};

/// Pixels per task. Tasks' sums are added in order, so that they do not depend on the threads.
const PART: usize = 1 << 14;
/// Sums that run side by side, which the compiler makes vectors of.
const LANES: usize = 16;

/// The corrected picture, kept from step to step.
#[derive(Debug, Default)]
pub(super) struct Exposed {
    /// R, G, B as the photo would have them.
    pub color: [Vec<f32>; 3],
    /// Gradient with respect to the picture's alpha, for photos with alpha.
    pub v_alpha: Vec<f32>,
}

impl Exposed {
    pub fn run(&mut self, image: &Planes, exposure: &Exposure<f32>) {
        let [r, g, b, _, transmittance] = &image.planes;
        let behind = exposure.behind();
        for (c, from) in [r, g, b].into_iter().enumerate() {
            let (gain, offset, behind) = (exposure.gain[c], exposure.offset[c], behind[c]);
            let out = &mut self.color[c];
            out.resize(from.len(), 0.0);
            let parts =
                (out.par_chunks_mut(PART), from.par_chunks(PART), transmittance.par_chunks(PART));
            parts.into_par_iter().for_each(|(out, from, t)| {
                if exposure.background.is_none() {
                    for (out, color) in out.iter_mut().zip(from) {
                        *out = (gain * color + offset).clamp(0.0, 1.0);
                    }
                } else {
                    for ((out, color), t) in out.iter_mut().zip(from).zip(t) {
                        *out = (gain * color + offset + t * behind).clamp(0.0, 1.0);
                    }
                }
            });
        }
    }

    /// Turns the corrected colors' gradients into the picture's; returns gain's and offset's.
    pub fn backward(
        &mut self,
        image: &Planes,
        exposure: &Exposure<f32>,
        v_color: &mut [Vec<f32>; 3],
    ) -> [[f64; 3]; 2] {
        let [r, g, b, _, transmittance] = &image.planes;
        let behind = exposure.behind();
        let kept = exposure.background;
        self.v_alpha.clear();
        if kept.is_some() {
            self.v_alpha.resize(r.len(), 0.0);
        }
        let (mut v_gain, mut v_offset) = ([0.0; 3], [0.0; 3]);
        for (c, color) in [r, g, b].into_iter().enumerate() {
            let v_color = &mut v_color[c];
            let raw = Raw { gain: exposure.gain[c], offset: exposure.offset[c], behind: behind[c] };
            let parts = (
                v_color.par_chunks_mut(PART),
                color.par_chunks(PART),
                transmittance.par_chunks(PART),
            );
            let sums: Vec<[f64; 2]> = match kept {
                None => parts
                    .into_par_iter()
                    .map(|(v, color, _)| {
                        let pixels = v.iter_mut().zip(color);
                        pixels.for_each(|(v, &color)| *v = raw.passed(*v, color, 0.0));
                        plain_sums(v, color)
                    })
                    .collect(),
                Some(b) => (parts, self.v_alpha.par_chunks_mut(PART))
                    .into_par_iter()
                    .map(|((v, color, t), v_alpha)| {
                        let pixels = v.iter_mut().zip(color).zip(t).zip(v_alpha);
                        pixels.for_each(|(((v, &color), &t), v_alpha)| {
                            *v = raw.passed(*v, color, t);
                            *v_alpha -= *v * raw.behind;
                        });
                        matted_sums(v, color, t, b[c])
                    })
                    .collect(),
            };
            v_color.par_iter_mut().for_each(|v| *v *= raw.gain);
            for [gain, offset] in sums {
                v_gain[c] += gain;
                v_offset[c] += offset;
            }
        }
        [v_gain, v_offset]
    }
}

#[derive(Clone, Copy)]
struct Raw {
    gain: f32,
    offset: f32,
    behind: f32,
}

impl Raw {
    /// The part of a gradient that passes the clamp; see [`Exposure`].
    #[inline(always)]
    fn passed(self, v: f32, color: f32, t: f32) -> f32 {
        Exposure::passed(self.gain * color + self.offset + t * self.behind, v)
    }
}

/// Sums of v color and of v.
fn plain_sums(v: &[f32], color: &[f32]) -> [f64; 2] {
    let mut sums = [[0.0f32; LANES]; 2];
    for (v, color) in v.chunks(LANES).zip(color.chunks(LANES)) {
        for (k, (v, color)) in v.iter().zip(color).enumerate() {
            sums[0][k] += v * color;
            sums[1][k] += v;
        }
    }
    sums.map(|lanes| lanes.iter().map(|&sum| f64::from(sum)).sum())
}

/// Sums of v (color - t b) and of v (1 - t).
fn matted_sums(v: &[f32], color: &[f32], t: &[f32], b: f32) -> [f64; 2] {
    let mut sums = [[0.0f32; LANES]; 2];
    for ((v, color), t) in v.chunks(LANES).zip(color.chunks(LANES)).zip(t.chunks(LANES)) {
        for (k, ((v, color), t)) in v.iter().zip(color).zip(t).enumerate() {
            sums[0][k] += v * (color - t * b);
            sums[1][k] += v * (1.0 - t);
        }
    }
    sums.map(|lanes| lanes.iter().map(|&sum| f64::from(sum)).sum())
}

/// Colors and transmittances of a picture as planes.
fn planes(image: &Image<f32>) -> Planes {
    let mut planes = Planes::default();
    planes.resize(image.width, image.height);
    for c in 0..3 {
        let values = image.color.iter().map(|color| color[c]);
        planes.planes[c].iter_mut().zip(values).for_each(|(out, value)| *out = value);
    }
    planes.planes[4].copy_from_slice(&image.transmittance);
    planes
}

fn rows([r, g, b]: &[Vec<f32>; 3]) -> Vec<[f32; 3]> {
    r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect()
}

pub(super) fn exposure(image: &Image<f32>, exposure: &Exposure<f32>) -> Vec<[f32; 3]> {
    let mut exposed = Exposed::default();
    exposed.run(&planes(image), exposure);
    rows(&exposed.color)
}

pub(super) fn exposure_backward(
    image: &Image<f32>,
    exposure: &Exposure<f32>,
    v_corrected: &[[f32; 3]],
) -> ExposureGradients<f32> {
    let mut exposed = Exposed::default();
    let mut v_color: [Vec<f32>; 3] =
        std::array::from_fn(|c| v_corrected.iter().map(|v| v[c]).collect());
    let [v_gain, v_offset] = exposed.backward(&planes(image), exposure, &mut v_color);
    exposed.v_alpha.resize(v_corrected.len(), 0.0);
    ExposureGradients { v_color: rows(&v_color), v_alpha: exposed.v_alpha, v_gain, v_offset }
}
