//! rasterize_backward: gradients of the picture to gradients of the 2D splats.

use super::rasterize::{order, pair};
use crate::constants::TRANSMITTANCE_MIN;
use crate::stages::{ImageGradients, Projected, ProjectedGradients};

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn rasterize_backward(
    projected: &Projected<f64>,
    background: [f64; 3],
    v_image: &ImageGradients<f64>,
    absolute: bool,
) -> ProjectedGradients<f64> {
    let (w, h) = (projected.width, projected.height);
    let ids = order(projected);
    let mut out = ProjectedGradients::zeros(projected.len());
    let mut v_absolute = vec![[0.0f64; 2]; projected.len()];
    for y in 0..h {
        for x in 0..w {
            let pixel = y as usize * w as usize + x as usize;
            let v_color = v_image.v_color[pixel];
            let (v_alpha_out, v_depth) = (v_image.v_alpha[pixel], v_image.v_depth[pixel]);
            // Contributors with the transmittance in front of each.
            let mut t = 1.0f64;
            let mut pairs = Vec::new();
            for &i in &ids {
                let Some(pair) = pair(projected, i, x, y) else { continue };
                let next = t * (1.0 - pair.alpha);
                if next < f64::from(TRANSMITTANCE_MIN) {
                    break;
                }
                pairs.push((i, t, pair));
                t = next;
            }
            for c in 0..3 {
                out.v_background[c] += t * v_color[c];
            }
            // Back to front: the color behind the current splat, dotted with the gradients.
            let mut behind = t * (dot(background, v_color) - v_alpha_out);
            for (i, t, pair) in pairs.into_iter().rev() {
                let weight = t * pair.alpha;
                let own = dot(projected.colors[i], v_color) + projected.depths[i] * v_depth;
                for c in 0..3 {
                    out.v_colors[i][c] += weight * v_color[c];
                }
                out.v_depths[i] += weight * v_depth;
                let v_alpha = t * own - behind / (1.0 - pair.alpha);
                behind += weight * own;
                if pair.capped {
                    continue;
                }
                out.v_opacities[i] += pair.gaussian * v_alpha;
                // sigma = (u^2 + v^2) / 2, u = p dx + q dy, v = r dy.
                let v_sigma = -pair.alpha * v_alpha;
                let (v_u, v_v) = (v_sigma * pair.u, v_sigma * pair.v);
                let [p, q, r] = projected.factors[i];
                let v_mean = [-v_u * p, -(v_u * q + v_v * r)];
                for axis in 0..2 {
                    out.v_means2d[i][axis] += v_mean[axis];
                    v_absolute[i][axis] += v_mean[axis].abs();
                }
                out.v_factors[i][0] += v_u * pair.dx;
                out.v_factors[i][1] += v_u * pair.dy;
                out.v_factors[i][2] += v_v * pair.dy;
            }
        }
    }
    out.v_means2d_absolute = absolute.then_some(v_absolute);
    out
}
