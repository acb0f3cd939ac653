//! depth_loss: relative difference of a picture's depth and a photo's, with its gradients.

use rayon::prelude::*;

use crate::stages::{self, Image, depth_pixel};
use crate::target::TargetDepth;

/// Pixels per task. Tasks' sums are added in order, so that they do not depend on the threads.
const PART: usize = 1 << 14;

/// The gradients, kept from step to step.
#[derive(Debug, Default)]
pub(super) struct DepthLoss {
    /// Gradient with respect to the picture's alpha.
    pub v_alpha: Vec<f32>,
    pub v_depth: Vec<f32>,
}

impl DepthLoss {
    /// The loss times `weight`, of a picture's accumulated depth and transmittance.
    pub fn run(
        &mut self,
        depth: &[f32],
        transmittance: &[f32],
        target: &TargetDepth,
        weight: f32,
    ) -> f32 {
        self.v_alpha.resize(depth.len(), 0.0);
        self.v_depth.resize(depth.len(), 0.0);
        let scale = weight * target.scale() as f32;
        let parts = (
            self.v_alpha.par_chunks_mut(PART),
            self.v_depth.par_chunks_mut(PART),
            depth.par_chunks(PART),
            transmittance.par_chunks(PART),
            target.depths.par_chunks(PART),
            target.confidences.par_chunks(PART),
        );
        let sums: Vec<f64> = parts
            .into_par_iter()
            .map(|(v_alpha, v_depth, depth, transmittance, z, confidence)| {
                let mut sum = 0.0;
                for k in 0..depth.len() {
                    let weight = if confidence[k] > 0.0 { scale * confidence[k] } else { 0.0 };
                    let z = if confidence[k] > 0.0 { z[k] } else { 1.0 };
                    let [value, to_alpha, to_depth] =
                        depth_pixel(1.0 - transmittance[k], depth[k], z);
                    v_alpha[k] = weight * to_alpha;
                    v_depth[k] = weight * to_depth;
                    sum += f64::from(weight * value);
                }
                sum
            })
            .collect();
        sums.iter().sum::<f64>() as f32
    }
}

pub(super) fn depth_loss(image: &Image<f32>, target: &TargetDepth) -> stages::DepthLoss<f32> {
    let mut loss = DepthLoss::default();
    let value = loss.run(&image.depth, &image.transmittance, target, 1.0);
    stages::DepthLoss { value, v_alpha: loss.v_alpha, v_depth: loss.v_depth }
}
