//! Self-test of a device: compiles all kernels and compares every stage on a small scene with the
//! reference. A driver's compiler may refuse or miscompile a kernel, and a fit with wrong values fails
//! silently.

use std::sync::Arc;

use glam::{DMat4, DVec3};
use num_traits::Float;

use crate::camera::Camera;
use crate::constants::DEPTH_ALPHA;
use crate::cpu::{Cpu, CpuFit};
use crate::error::{Error, Result};
use crate::fit_device::{FitDevice, FitState, McmcRun, OriginalRun, StepInput, noise_draw};
use crate::gpu::{Gpu, GpuFit};
use crate::reference::Reference;
use crate::splats::SplatArrays;
use crate::stages::{
    AdamState, AdamStep, Exposure, ImageGradients, ProjectOptions, Projected, Rates,
    SplatGradients, Stages,
};
use crate::target::{Target, TargetDepth};

/// Maximum relative difference from the reference: a hundred times f32's rounding.
const TOLERANCE: f64 = 1e-3;
/// Of the scene: one whose decisions are clear (a test has how).
const SEED: u32 = 97;
const SPLATS: usize = 40;
const SIZE: (u32, u32) = (56, 40);
/// Splats of the crowd: enough for every sum of the sort, and for several batches in each tile.
const CROWD: usize = 20_000;
/// Maximum difference in the crowd; rounding may flip decisions at a few pixels.
const CROWD_TOLERANCE: f64 = 0.05;
const BACKGROUND: [f64; 3] = [0.25, 0.5, 0.75];

/// Outputs of a stage as plain numbers.
type Outputs = Vec<(&'static str, Vec<f64>)>;

/// Compiles every kernel and compares all stages and a fit on a small scene with reference and CPU.
pub fn self_test(gpu: &Arc<Gpu>) -> Result<()> {
    gpu.compile_all()?;
    let mut outputs = all_stages::<f32>(&**gpu)?;
    let mut expected = all_stages::<f64>(&Reference)?;
    outputs.extend(a_fit(&mut GpuFit::new(Arc::clone(gpu)))?);
    expected.extend(a_fit(&mut CpuFit::default())?);
    let known = outputs.len();
    outputs.extend(a_crowd(&**gpu)?);
    expected.extend(a_crowd(&Cpu)?);
    for (k, ((stage, values), (_, right))) in outputs.iter().zip(&expected).enumerate() {
        let off = difference(values, right);
        let tolerance = if k < known { TOLERANCE } else { CROWD_TOLERANCE };
        if off.is_nan() || off > tolerance {
            return Err(Error::Device(format!(
                "backend gpu: {} computes wrong values: {stage} is off by {off:.1e} of the largest; \
                 update its driver or use backend cpu",
                gpu.name()
            )));
        }
    }
    Ok(())
}

/// The largest difference, as a part of the largest value.
fn difference(values: &[f64], right: &[f64]) -> f64 {
    if values.len() != right.len() || values.iter().any(|value| value.is_nan()) {
        return f64::NAN;
    }
    let most = |of: f64, x: f64| of.max(x.abs());
    let apart = values.iter().zip(right).map(|(value, right)| value - right);
    apart.fold(0.0, most) / right.iter().copied().fold(0.0, most)
}

/// A number in 0..1 that depends on `k` alone, on every machine.
fn draw(k: usize) -> f64 {
    f64::from(noise_draw(SEED, k as u32)[0])
}

fn cast<T: Float>(x: f64) -> T {
    // Through f32, so that all implementations are given the same values.
    T::from(x as f32).unwrap_or_else(T::zero)
}

/// Splats before the camera, of all sizes and shapes that fit.
fn scene<T: Float>() -> SplatArrays<T> {
    let number = |i: usize, k: usize| draw(1000 * i + k) - 0.5;
    let splats = 0..SPLATS;
    SplatArrays {
        means: splats
            .clone()
            .map(|i| [3.0 * number(i, 0), 2.0 * number(i, 1), 4.0 + 2.0 * number(i, 2)].map(cast))
            .collect(),
        quats: splats.clone().map(|i| [3, 4, 5, 6].map(|k| cast(number(i, k)))).collect(),
        scales: splats
            .clone()
            .map(|i| [7, 8, 9].map(|k| cast(-1.6 + 2.0 * number(i, k))))
            .collect(),
        opacities: splats.clone().map(|i| cast(1.5 + 7.0 * number(i, 10))).collect(),
        sh: splats
            .flat_map(|i| (0..9).map(move |k| [11, 12, 13].map(|c| cast(number(i, 3 * k + c)))))
            .collect(),
        sh_degree: 2,
    }
}

fn camera() -> Camera {
    Camera {
        viewmat: DMat4::from_translation(DVec3::new(0.1, -0.05, 0.2))
            * DMat4::from_rotation_y(0.1)
            * DMat4::from_rotation_x(-0.05),
        fx: 60.0,
        fy: 58.0,
        cx: 27.3,
        cy: 20.6,
        width: SIZE.0,
        height: SIZE.1,
    }
}

fn photo() -> Target {
    let values = 3 * SIZE.0 as usize * SIZE.1 as usize;
    Target::new(SIZE.0, SIZE.1, 3, (0..values).map(|k| (255.0 * draw(k)) as u8).collect())
}

/// Depths a third off the scene's, at pixels whose alpha is clearly above or below the threshold.
fn depths() -> Result<TargetDepth> {
    let options = ProjectOptions { antialiased: true, ..ProjectOptions::default() };
    let projected = Reference.project(&scene::<f64>().params(2), &camera(), &options)?;
    let image = Reference.rasterize(&projected, BACKGROUND)?;
    let pixels = image.alpha.iter().zip(&image.depth).enumerate();
    let (depths, confidences) = pixels
        .map(|(k, (&alpha, &depth))| {
            let z = if draw(k) < 0.5 { 0.67 } else { 1.5 } * depth / alpha.max(0.01);
            let clear = (alpha - f64::from(DEPTH_ALPHA)).abs() > 0.02 && z > 0.0;
            (z.max(1e-3) as f32, if clear { 0.1 + 0.9 * draw(k + 1) as f32 } else { 0.0 })
        })
        .unzip();
    Ok(TargetDepth { depths, confidences })
}

fn flat<T: Float, const N: usize>(rows: &[[T; N]]) -> Vec<f64> {
    rows.iter().flatten().map(|x| x.to_f64().unwrap_or(f64::NAN)).collect()
}

fn plain<T: Float>(values: &[T]) -> Vec<f64> {
    values.iter().map(|x| x.to_f64().unwrap_or(f64::NAN)).collect()
}

/// The scene through every stage, as a step of a fit with exposure has them.
fn all_stages<T: Float>(stages: &impl Stages<T>) -> Result<Outputs> {
    let (splats, camera, photo) = (scene::<T>(), camera(), photo());
    let options = ProjectOptions { antialiased: true, ..ProjectOptions::default() };
    let background = BACKGROUND.map(cast);
    let exposure = Exposure {
        gain: [0.9, 1.1, 1.05].map(cast),
        offset: [0.02, -0.03, 0.01].map(cast),
        background: Some(background),
    };
    let params = splats.params(2);
    let projected = stages.project(&params, &camera, &options)?;
    let image = stages.rasterize(&projected, background)?;
    let corrected = stages.exposure(&image, &exposure)?;
    let loss = stages.loss(&image, &photo, background, 0.2)?;
    let deep = stages.depth_loss(&image, &depths()?)?;
    let exposed = stages.exposure_backward(&image, &exposure, &loss.v_color)?;
    let v_image = ImageGradients {
        v_color: exposed.v_color.clone(),
        v_alpha: exposed.v_alpha.clone(),
        v_depth: (0..image.depth.len()).map(|k| cast(1e-4 * (draw(k) - 0.5))).collect(),
    };
    let mut signed = stages.rasterize_backward(&projected, background, &image, &v_image, false)?;
    let v_projected = stages.rasterize_backward(&projected, background, &image, &v_image, true)?;
    let gradients =
        stages.project_backward(&params, &camera, &options, &projected, &v_projected)?;
    let mut second = scene::<T>();
    // Large enough that no update is the sign of a gradient near 0.
    fill(&mut second, 1e-4);
    let mut first = scene::<T>();
    fill(&mut first, 0.0);
    let mut state = AdamState { splats: scene(), first, second };
    stages.adam(&mut state, &gradients, &adam_step())?;

    let absolute = v_projected.v_means2d_absolute.clone().unwrap_or_default();
    let SplatGradients { v_means, v_quats, v_scales, v_opacities, v_colors, .. } = &gradients;
    Ok(vec![
        ("project", flat(&projected.means2d)),
        ("project", flat(&projected.factors)),
        ("project", flat(&projected.colors)),
        ("project", plain(&projected.opacities)),
        ("rasterize", flat(&image.color)),
        ("rasterize", plain(&image.depth)),
        ("rasterize", plain(&image.transmittance)),
        ("exposure", flat(&corrected)),
        ("loss", plain(&[loss.value])),
        ("loss", flat(&loss.v_color)),
        ("depth_loss", plain(&[deep.value])),
        ("depth_loss", plain(&deep.v_alpha)),
        ("depth_loss", plain(&deep.v_depth)),
        ("exposure_backward", flat(&exposed.v_color)),
        ("exposure_backward", flat(&[exposed.v_gain, exposed.v_offset])),
        ("rasterize_backward", flat(&std::mem::take(&mut signed.v_means2d))),
        ("rasterize_backward", flat(&v_projected.v_means2d)),
        ("rasterize_backward", flat(&v_projected.v_factors)),
        ("rasterize_backward", plain(&v_projected.v_opacities)),
        ("rasterize_backward", flat(&absolute)),
        ("project_backward", flat(v_means)),
        ("project_backward", flat(v_quats)),
        ("project_backward", flat(v_scales)),
        ("project_backward", plain(v_opacities)),
        ("project_backward", flat(v_colors)),
        ("project_backward", flat(&gradients.v_viewmat)),
        ("adam", flat(&state.splats.means)),
        ("adam", flat(&state.splats.scales)),
        ("adam", flat(&state.splats.sh)),
    ])
}

/// Faint small splats all over the picture, rasterized and back: too many for the reference.
fn a_crowd(stages: &impl Stages<f32>) -> Result<Outputs> {
    let (width, height) = SIZE;
    let mut crowd = Projected::culled(CROWD, width, height);
    for i in 0..CROWD {
        let number = |k: usize| draw(100_000 + 8 * i + k);
        let deviation = 0.6 + 0.4 * number(0);
        let opacity = 0.02 + 0.01 * number(1);
        let radius = deviation * (2.0 * (255.0 * opacity).ln()).sqrt();
        crowd.means2d[i] = [f64::from(width) * number(2), f64::from(height) * number(3)].map(cast);
        crowd.factors[i] = [deviation.recip(), 0.0, deviation.recip()].map(cast);
        crowd.opacities[i] = cast(opacity);
        crowd.radii[i] = [cast(radius); 2];
        crowd.depths[i] = cast(1.0 + number(4));
        crowd.colors[i] = [5, 6, 7].map(|k| cast(number(k)));
    }
    let image = stages.rasterize(&crowd, BACKGROUND.map(cast))?;
    let pixels = image.depth.len();
    let v_image = ImageGradients {
        v_color: (0..pixels).map(|k| [0, 1, 2].map(|c| cast(draw(3 * k + c) - 0.5))).collect(),
        v_alpha: vec![cast(0.0); pixels],
        v_depth: vec![cast(0.0); pixels],
    };
    let v = stages.rasterize_backward(&crowd, BACKGROUND.map(cast), &image, &v_image, false)?;
    Ok(vec![
        ("rasterize", flat(&image.color)),
        ("rasterize_backward", flat(&v.v_means2d)),
        ("rasterize_backward", plain(&v.v_opacities)),
    ])
}

/// A step of a fit, whose kernels join stages, and runs of density control.
fn a_fit(device: &mut dyn FitDevice) -> Result<Outputs> {
    let (mut first, mut second) = (scene::<f32>(), scene::<f32>());
    fill(&mut first, 0.0);
    // As for the stages: no update is the sign of a gradient.
    fill(&mut second, 1e-4);
    let begin = FitState { first, second, ..FitState::new(scene()) };
    device.set_targets(vec![photo()])?;
    device.upload(begin.clone())?;
    let AdamStep { rates, sh_degree, opacity_regularizer, scale_regularizer, .. } = adam_step();
    let input = StepInput {
        background: BACKGROUND.map(|v| v as f32),
        sh_degree,
        rates,
        step: 5,
        opacity_regularizer,
        scale_regularizer,
        camera_gradient: true,
        ..StepInput::new(0, camera())
    };
    device.step(&input)?;
    let step = device.download()?;
    let camera = device.camera_gradients()?;
    // The second step's project applies the first step's color update. Nothing moves far enough to change
    // a decision; the moments show errors.
    device.upload(begin)?;
    let colors = StepInput { rates: Rates { sh0: 1e-5, sh_rest: 1e-5, ..Rates::ZERO }, ..input };
    device.step(&colors)?;
    device.step(&StepInput { step: 6, ..colors })?;
    let waited = device.download()?;
    device.camera_gradients()?;
    // From values that are equal: a draw says no more of splats that differ in their last bit.
    device.upload(FitState::new(scene()))?;
    device.mcmc(&McmcRun { cameras: vec![self::camera()], target: SPLATS + 20, seed: SEED })?;
    let grown = device.download()?.splats;
    let mut pulled = FitState::new(scene());
    pulled.stats.grad_sum = (0..SPLATS).map(|i| 1e-3 * draw(i) as f32).collect();
    pulled.stats.seen.fill(2.0);
    pulled.splats.opacities.iter_mut().step_by(7).for_each(|opacity| *opacity = -9.0);
    device.upload(pulled)?;
    // Some are split and some cloned.
    let run = OriginalRun { max_splats: SPLATS + 20, extent: 40.0, prune_huge: true, seed: SEED };
    device.original(&run)?;
    let split = device.download()?.splats;
    device.reset_opacities()?;
    let reset = device.download()?.splats;
    Ok(vec![
        ("a fit's step", flat(&step.splats.means)),
        ("a fit's step", flat(&step.splats.scales)),
        ("a fit's step", flat(&step.splats.quats)),
        ("a fit's step", plain(&step.splats.opacities)),
        ("a fit's step", flat(&step.splats.sh)),
        ("a fit's step", plain(&step.stats.grad_sum)),
        ("a fit's step", camera.iter().flat_map(|v| flat(&v.v_viewmat)).collect()),
        ("two steps of a fit", flat(&waited.first.sh)),
        ("two steps of a fit", flat(&waited.second.sh)),
        ("density control", flat(&grown.means)),
        ("density control", flat(&grown.scales)),
        ("density control", plain(&grown.opacities)),
        ("density control", flat(&grown.sh)),
        ("original density control", flat(&split.means)),
        ("original density control", flat(&split.scales)),
        ("original density control", plain(&split.opacities)),
        ("original density control", flat(&split.sh)),
        ("original density control", plain(&reset.opacities)),
    ])
}

fn adam_step() -> AdamStep {
    AdamStep {
        number: 5,
        rates: Rates {
            means: 0.1,
            quats: 0.1,
            scales: 0.1,
            opacities: 0.1,
            sh0: 0.1,
            sh_rest: 0.05,
        },
        sh_degree: 2,
        opacity_regularizer: 0.01,
        scale_regularizer: 0.01,
        noise: 0.0,
        noise_seed: 0,
    }
}

fn fill<T: Float>(arrays: &mut SplatArrays<T>, value: f64) {
    let value = cast(value);
    arrays.means.fill([value; 3]);
    arrays.quats.fill([value; 4]);
    arrays.scales.fill([value; 3]);
    arrays.opacities.fill(value);
    arrays.sh.fill([value; 3]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::decisions;

    /// A pair that one device blends and another does not would be an alarm for nothing.
    #[test]
    fn no_decision_of_the_scene_is_near_its_threshold() {
        let options = ProjectOptions { antialiased: true, ..ProjectOptions::default() };
        let taken = |by: f64| {
            let mut splats = scene::<f64>();
            splats.opacities.iter_mut().for_each(|logit| *logit += by);
            splats.means.iter_mut().for_each(|mean| mean[0] += by);
            let projected = Reference.project(&splats.params(2), &camera(), &options).unwrap();
            decisions(&splats.params(2), &camera(), &options, &projected)
        };
        assert_eq!(taken(0.0), taken(6e-5));
        assert_eq!(taken(0.0), taken(-6e-5));
        assert_ne!(taken(0.0), taken(1e-2));
    }

    #[test]
    fn the_scene_covers_all_cases() {
        let outputs = all_stages::<f64>(&Reference).unwrap();
        let of = |stage: &str, k: usize| {
            &outputs.iter().filter(|(name, _)| *name == stage).nth(k).unwrap().1
        };
        let transmittance = of("rasterize", 2);
        let share = |keep: fn(f64) -> bool| {
            transmittance.iter().filter(|t| keep(**t)).count() as f64 / transmittance.len() as f64
        };
        assert!(share(|t| t > 0.99) > 0.02, "nowhere is the background seen");
        assert!(share(|t| t < 0.1) > 0.02, "it hides nothing");
        assert!(share(|t| (0.1..0.9).contains(&t)) > 0.2, "nothing is half transparent");
        for (stage, values) in &outputs {
            assert!(values.iter().any(|v| *v != 0.0), "{stage} has zeros only");
            assert!(values.iter().all(|v| v.is_finite()), "{stage}");
        }
    }

    #[test]
    fn differences_are_parts_of_the_largest_and_see_nan() {
        assert_eq!(difference(&[1.0, 4.0], &[1.0, 5.0]), 0.2);
        assert!(difference(&[1.0, f64::NAN], &[1.0, 5.0]).is_nan());
        assert!(difference(&[f64::NAN, 5.0], &[1.0, 5.0]).is_nan());
        assert!(difference(&[1.0], &[1.0, 5.0]).is_nan());
    }
}
