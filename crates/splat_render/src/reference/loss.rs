//! loss: L1 and D-SSIM of a picture against a photo, with the picture's gradient.

use crate::constants::{SSIM_C, SSIM_WINDOW};
use crate::stages::{Image, Loss};
use crate::target::Target;

/// The photo over a background, in 0..1.
fn photo(target: &Target, background: [f64; 3]) -> Vec<[f64; 3]> {
    let pixels = target.pixels.chunks_exact(target.channels as usize);
    pixels
        .map(|pixel| {
            let unit = |k: usize| f64::from(pixel[k]) / 255.0;
            let alpha = if target.channels == 4 { unit(3) } else { 1.0 };
            std::array::from_fn(|c| unit(c) * alpha + background[c] * (1.0 - alpha))
        })
        .collect()
}

/// The pixels of the window around a pixel, within the picture, with their weights.
fn window(width: usize, height: usize, pixel: usize) -> impl Iterator<Item = (usize, f64)> {
    let (half, side) = (SSIM_WINDOW.len() / 2, SSIM_WINDOW.len());
    let (row, column) = (pixel / width, pixel % width);
    (0..side * side).filter_map(move |k| {
        let (i, j) = (k / side, k % side);
        let (y, x) = ((row + i).checked_sub(half)?, (column + j).checked_sub(half)?);
        let weight = f64::from(SSIM_WINDOW[i]) * f64::from(SSIM_WINDOW[j]);
        (y < height && x < width).then_some((y * width + x, weight))
    })
}

pub(super) fn loss(
    image: &Image<f64>,
    target: &Target,
    background: [f64; 3],
    ssim_weight: f32,
) -> Loss<f64> {
    let (width, height) = (image.width as usize, image.height as usize);
    let photo = photo(target, background);
    let (c1, c2) = (f64::from(SSIM_C.0), f64::from(SSIM_C.1));
    let s = f64::from(ssim_weight);
    let weight = target.weight();
    let scale = weight.scale();
    let mut out = Loss { value: 0.0, v_color: vec![[0.0; 3]; image.color.len()] };
    for pixel in 0..image.color.len() {
        let w = target.weights.as_ref().map_or(1.0, |weights| f64::from(weights[pixel]));
        for c in 0..3 {
            let (x, y) = (image.color[pixel][c], photo[pixel][c]);
            out.value += scale * w * (1.0 - s) * (x - y).abs();
            // |x - y| has slope 0 at 0.
            let sign = if x == y { 0.0 } else { (x - y).signum() };
            out.v_color[pixel][c] += scale * w * (1.0 - s) * sign;

            // Means, variances and covariance in the window around the pixel.
            let (mut mx, mut my, mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for (at, g) in window(width, height, pixel) {
                let (x, y) = (image.color[at][c], photo[at][c]);
                mx += g * x;
                my += g * y;
                xx += g * x * x;
                yy += g * y * y;
                xy += g * x * y;
            }
            let (vx, vy, cov) = (xx - mx * mx, yy - my * my, xy - mx * my);
            let (a1, a2) = (2.0 * mx * my + c1, 2.0 * cov + c2);
            let (b1, b2) = (mx * mx + my * my + c1, vx + vy + c2);
            let ssim = a1 * a2 / (b1 * b2);
            out.value += scale * w * s * (1.0 - ssim);

            // SSIM's derivatives by mx, vx and cov; then each pixel's part in these three.
            let d_mx = 2.0 * my * a2 / (b1 * b2) - ssim * 2.0 * mx / b1;
            let (d_vx, d_cov) = (-ssim / b2, 2.0 * a1 / (b1 * b2));
            for (at, g) in window(width, height, pixel) {
                let (x, y) = (image.color[at][c], photo[at][c]);
                let d_x = g * (d_mx + d_vx * 2.0 * (x - mx) + d_cov * (y - my));
                out.v_color[at][c] -= scale * w * s * d_x;
            }
        }
    }
    out
}
