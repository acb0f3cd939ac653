//! rasterize: 2D splats to a picture, every pixel walking all splats in order.

use crate::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::stages::{Image, Projected};

/// Drawn splats by (f32 depth, index).
pub(super) fn order(projected: &Projected<f64>) -> Vec<usize> {
    let mut ids: Vec<usize> = (0..projected.len()).filter(|&i| projected.is_drawn(i)).collect();
    ids.sort_by(|&a, &b| (projected.depths[a] as f32).total_cmp(&(projected.depths[b] as f32)));
    ids
}

/// One splat's meeting with one pixel.
pub(super) struct Pair {
    /// Offset of the pixel's center from the splat's.
    pub dx: f64,
    pub dy: f64,
    /// The same, whitened.
    pub u: f64,
    pub v: f64,
    /// exp(-sigma).
    pub gaussian: f64,
    /// Capped alpha.
    pub alpha: f64,
    /// Whether the cap was reached, so that alpha's gradient is zero.
    pub capped: bool,
}

/// None if the pair contributes nothing.
pub(super) fn pair(projected: &Projected<f64>, i: usize, x: u32, y: u32) -> Option<Pair> {
    let [mx, my] = projected.means2d[i];
    let [p, q, r] = projected.factors[i];
    let (dx, dy) = (f64::from(x) + 0.5 - mx, f64::from(y) + 0.5 - my);
    let (u, v) = (p * dx + q * dy, r * dy);
    let gaussian = (-0.5 * (u * u + v * v)).exp();
    let raw = projected.opacities[i] * gaussian;
    let alpha = raw.min(f64::from(ALPHA_MAX));
    (alpha >= f64::from(ALPHA_MIN)).then_some(Pair {
        dx,
        dy,
        u,
        v,
        gaussian,
        alpha,
        capped: raw > f64::from(ALPHA_MAX),
    })
}

pub(super) fn rasterize(projected: &Projected<f64>, background: [f64; 3]) -> Image<f64> {
    let (w, h) = (projected.width, projected.height);
    let pixels = w as usize * h as usize;
    let ids = order(projected);
    let mut out = Image {
        width: w,
        height: h,
        color: Vec::with_capacity(pixels),
        alpha: Vec::with_capacity(pixels),
        depth: Vec::with_capacity(pixels),
        transmittance: Vec::with_capacity(pixels),
    };
    for y in 0..h {
        for x in 0..w {
            let (mut t, mut color, mut depth) = (1.0f64, [0.0f64; 3], 0.0f64);
            for &i in &ids {
                let Some(pair) = pair(projected, i, x, y) else { continue };
                let next = t * (1.0 - pair.alpha);
                if next < f64::from(TRANSMITTANCE_MIN) {
                    break;
                }
                let weight = t * pair.alpha;
                for (sum, c) in color.iter_mut().zip(projected.colors[i]) {
                    *sum += weight * c;
                }
                depth += weight * projected.depths[i];
                t = next;
            }
            out.color.push(std::array::from_fn(|c| color[c] + t * background[c]));
            out.alpha.push(1.0 - t);
            out.depth.push(depth);
            out.transmittance.push(t);
        }
    }
    out
}

/// Pixels at which a correct f32 implementation may differ from this one: a pair is within `alpha_band`
/// (relative) of the alpha threshold, the transmittance within 1e-4 of its threshold, or two neighbors'
/// depths within 1e-6 of each other.
pub fn band_pixels(projected: &Projected<f64>, alpha_band: f64) -> Vec<bool> {
    let (w, h) = (projected.width, projected.height);
    let ids = order(projected);
    let mut out = Vec::with_capacity(w as usize * h as usize);
    for y in 0..h {
        for x in 0..w {
            let mut t = 1.0f64;
            let mut last_depth = f64::NEG_INFINITY;
            let mut in_band = false;
            for &i in &ids {
                let [mx, my] = projected.means2d[i];
                let [p, q, r] = projected.factors[i];
                let (dx, dy) = (f64::from(x) + 0.5 - mx, f64::from(y) + 0.5 - my);
                let (u, v) = (p * dx + q * dy, r * dy);
                let raw = projected.opacities[i] * (-0.5 * (u * u + v * v)).exp();
                let alpha = raw.min(f64::from(ALPHA_MAX));
                in_band |= (alpha / f64::from(ALPHA_MIN) - 1.0).abs() < alpha_band;
                if alpha < f64::from(ALPHA_MIN) {
                    continue;
                }
                let depth = projected.depths[i];
                in_band |= depth != last_depth && (depth - last_depth).abs() < 1e-6 * depth.abs();
                last_depth = depth;
                let next = t * (1.0 - alpha);
                in_band |= (next / f64::from(TRANSMITTANCE_MIN) - 1.0).abs() < 1e-4;
                if next < f64::from(TRANSMITTANCE_MIN) {
                    break;
                }
                t = next;
            }
            out.push(in_band);
        }
    }
    out
}
