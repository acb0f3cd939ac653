//! depth_loss: relative difference of a picture's depth and a photo's, with its gradients.

use crate::stages::{DepthLoss, Image, depth_pixel};
use crate::target::TargetDepth;

pub(super) fn depth_loss(image: &Image<f64>, target: &TargetDepth) -> DepthLoss<f64> {
    let mut out = DepthLoss::default();
    let scale = target.scale();
    for (k, (&z, &confidence)) in target.depths.iter().zip(&target.confidences).enumerate() {
        let weight = f64::from(confidence) * scale;
        let [value, v_alpha, v_depth] = if confidence > 0.0 {
            depth_pixel(image.alpha[k], image.depth[k], f64::from(z))
        } else {
            [0.0; 3]
        };
        out.value += weight * value;
        out.v_alpha.push(weight * v_alpha);
        out.v_depth.push(weight * v_depth);
    }
    out
}
