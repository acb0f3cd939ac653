//! The settings of a fit, from a dict.

use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::fit::{Background, CameraConfig, DensityControl, FitConfig, Focal, Rates};

use crate::arguments::{choice, setting};

/// Factor by which a step reduces both sides of photos; see [`FitConfig::reduction`].
#[pyfunction]
pub fn reduction(steps: u32, coarse_to_fine: bool, step: u32, longest: u32) -> u32 {
    FitConfig { steps: steps.max(1), coarse_to_fine, ..FitConfig::default() }
        .reduction(step, longest)
}

/// The settings of a fit; an absent or None entry takes the default.
pub fn config_from(config: &Bound<'_, PyDict>) -> PyResult<FitConfig> {
    let default = FitConfig::default();
    let densities = [
        ("mcmc", DensityControl::Mcmc),
        ("original", DensityControl::Original),
        ("fixed", DensityControl::Fixed),
    ];
    let focals =
        [("fixed", Focal::Fixed), ("shared", Focal::Shared), ("per-camera", Focal::PerCamera)];
    let density = choice(config, "density", &densities)?.unwrap_or(default.density);
    let focal = choice(config, "focal", &focals)?.unwrap_or(Focal::Fixed);
    let poses = choice(config, "poses", &[("fixed", false), ("joint", true)])?.unwrap_or(false);
    let frozen = setting(config, "frozen")?.unwrap_or(false);
    let number = |name: &str, default: f32| PyResult::Ok(setting(config, name)?.unwrap_or(default));
    let cameras = if poses || focal != Focal::Fixed {
        let default = CameraConfig::default();
        Some(CameraConfig {
            poses,
            focal,
            rate: number("camera_rate", default.rate)?,
            decay: number("camera_decay", default.decay)?,
            warm_up: number("camera_warm_up", default.warm_up)?,
            // Frozen splats already fix the gauge of the cameras.
            anchored: !frozen,
        })
    } else {
        None
    };
    let background =
        setting::<[f32; 3]>(config, "background")?.map_or(Background::Random, Background::Color);
    Ok(FitConfig {
        steps: setting(config, "steps")?.unwrap_or(default.steps),
        first_step: setting(config, "first_step")?.unwrap_or(default.first_step),
        seed: setting(config, "seed")?.unwrap_or(default.seed),
        sh_degree: setting(config, "sh_degree")?.unwrap_or(default.sh_degree),
        max_splats: setting(config, "max_splats")?.unwrap_or(default.max_splats),
        density,
        background,
        dropout: setting(config, "dropout")?.unwrap_or(default.dropout),
        depth_weight: setting(config, "depth_weight")?.unwrap_or(default.depth_weight),
        coarse_to_fine: setting(config, "coarse_to_fine")?.unwrap_or(default.coarse_to_fine),
        rates: if frozen { Rates::ZERO } else { default.rates },
        rate_scale: setting(config, "learning_rate")?.unwrap_or(default.rate_scale),
        cameras,
        exposures: setting(config, "exposures")?.unwrap_or(default.exposures),
        ..default
    })
}
