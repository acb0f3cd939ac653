//! adam: one optimizer step of all parameters, the regularizers' pull, the exploration noise.

use glam::{DMat3, DQuat, DVec3};

use crate::constants::{ADAM, QUAT_NORM2_MIN};
use crate::fit_device::noise_normal;
use crate::sh;
use crate::stages::{AdamState, AdamStep, SplatGradients};

/// Adam (Kingma and Ba, 2015, algorithm 1) on one value.
fn update(value: &mut f64, moments: [&mut f64; 2], gradient: f64, rate: f32, bias: [f64; 2]) {
    let (beta1, beta2, epsilon) = (f64::from(ADAM.0), f64::from(ADAM.1), f64::from(ADAM.2));
    let [first, second] = moments;
    *first = beta1 * *first + (1.0 - beta1) * gradient;
    *second = beta2 * *second + (1.0 - beta2) * gradient * gradient;
    *value -= f64::from(rate) * (*first * bias[0]) / ((*second * bias[1]).sqrt() + epsilon);
}

/// New center of splat `i` after exploration (3DGS-MCMC, eq. 8); None if it does not move.
fn explored(state: &AdamState<f64>, i: usize, step: &AdamStep) -> Option<DVec3> {
    let splats = &state.splats;
    let opacity = 1.0 / (1.0 + (-splats.opacities[i]).exp());
    let gate = 1.0 / (1.0 + (-100.0 * (0.005 - opacity)).exp());
    let [w, x, y, z] = splats.quats[i];
    // Under this gate the step is under 1e-7 of the splat's size times the rate.
    if gate < 1e-7 || w * w + x * x + y * y + z * z < f64::from(QUAT_NORM2_MIN) {
        return None;
    }
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = DVec3::from(splats.scales[i]).exp();
    let draw = DVec3::from(noise_normal(step.noise_seed, i as u32).map(f64::from));
    let covariance = axes * DMat3::from_diagonal(scales * scales) * axes.transpose();
    let moved = DVec3::from(splats.means[i]) + covariance * draw * gate * f64::from(step.noise);
    moved.is_finite().then_some(moved)
}

pub(super) fn adam(state: &mut AdamState<f64>, gradients: &SplatGradients<f64>, step: &AdamStep) {
    if step.is_frozen() {
        return;
    }
    let (n, stride) = (state.splats.len(), state.splats.stride());
    let used = sh::coeffs(step.sh_degree.min(state.splats.sh_degree));
    let (rates, bias) = (step.rates, step.bias());
    // The mean opacity and the mean scale by one logit and one log-scale.
    let opacity_pull = f64::from(step.opacity_regularizer) / n as f64;
    let scale_pull = f64::from(step.scale_regularizer) / (3 * n) as f64;
    let AdamState { splats, first, second } = state;
    macro_rules! update {
        ($name:ident [$i:expr] $([$k:expr])?, $gradient:expr, $rate:expr) => {
            update(
                &mut splats.$name[$i]$([$k])?,
                [&mut first.$name[$i]$([$k])?, &mut second.$name[$i]$([$k])?],
                $gradient,
                $rate,
                bias,
            )
        };
    }
    for i in 0..n {
        let tail = (-splats.opacities[i].abs()).exp();
        let pull = opacity_pull * tail / ((1.0 + tail) * (1.0 + tail));
        update!(opacities[i], gradients.v_opacities[i] + pull, rates.opacities);
        for k in 0..3 {
            let pull = scale_pull * splats.scales[i][k].exp();
            update!(means[i][k], gradients.v_means[i][k], rates.means);
            update!(scales[i][k], gradients.v_scales[i][k] + pull, rates.scales);
        }
        for k in 0..4 {
            update!(quats[i][k], gradients.v_quats[i][k], rates.quats);
        }
        for row in 0..used {
            let rate = if row == 0 { rates.sh0 } else { rates.sh_rest };
            for c in 0..3 {
                let at = i * stride + row;
                update!(sh[at][c], gradients.v_colors[at][c], rate);
            }
        }
    }
    if step.noise > 0.0 {
        for i in 0..n {
            if let Some(mean) = explored(state, i, step) {
                state.splats.means[i] = mean.to_array();
            }
        }
    }
}
