//! A fit in progress, stepped from Python.

use std::sync::{Mutex, MutexGuard};

use glam::DMat4;
use numpy::PyUntypedArrayMethods;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use splat_render::fit::{
    Background, CameraConfig, CameraState, DensityControl, DensityStats, FitConfig, FitState,
    Focal, Hold, Rates, SplatArrays, Target,
};

use crate::arrays::{array, elements, entry, rows, shaped, shaped_rows};
use crate::backend::fit_device;
use crate::camera::{cameras, viewmat};
use crate::error::to_python;

/// A fit in progress.
#[pyclass]
pub struct Fitter(Mutex<splat_render::fit::Fitter>);

/// The setting `name`, or None where it is absent or None.
fn setting<'py, T>(config: &Bound<'py, PyDict>, name: &str) -> PyResult<Option<T>>
where
    T: for<'a> FromPyObject<'a, 'py>,
{
    let Some(value) = config.get_item(name)?.filter(|value| !value.is_none()) else {
        return Ok(None);
    };
    match value.extract() {
        Ok(value) => Ok(Some(value)),
        Err(_) => Err(PyValueError::new_err(format!("{name}: cannot be {}", value.repr()?))),
    }
}

fn config_from(config: &Bound<'_, PyDict>) -> PyResult<FitConfig> {
    let default = FitConfig::default();
    let density = match setting::<String>(config, "density")?.as_deref() {
        None => default.density,
        Some("mcmc") => DensityControl::Mcmc,
        Some("original") => DensityControl::Original,
        Some("fixed") => DensityControl::Fixed,
        Some(other) => {
            return Err(PyValueError::new_err(format!(
                "density: must be mcmc, original or fixed, not {other:?}"
            )));
        }
    };
    let focal = match setting::<String>(config, "focal")?.as_deref() {
        None | Some("fixed") => Focal::Fixed,
        Some("shared") => Focal::Shared,
        Some("per-camera") => Focal::PerCamera,
        Some(other) => {
            return Err(PyValueError::new_err(format!(
                "focal: must be fixed, shared or per-camera, not {other:?}"
            )));
        }
    };
    let poses = match setting::<String>(config, "poses")?.as_deref() {
        None | Some("fixed") => false,
        Some("joint") => true,
        Some(other) => {
            return Err(PyValueError::new_err(format!(
                "poses: must be fixed or joint, not {other:?}"
            )));
        }
    };
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
            // Splats that stay where they are hold the cameras by themselves.
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
        hull: setting(config, "hull")?.unwrap_or(default.hull),
        rates: if frozen { Rates::ZERO } else { default.rates },
        cameras,
        ..default
    })
}

/// Parameters of the splats, or moments under a prefix.
pub fn splat_arrays_from(dict: &Bound<'_, PyDict>, prefix: &str) -> PyResult<SplatArrays> {
    fn copied<const N: usize>(
        dict: &Bound<'_, PyDict>,
        name: &str,
        leading: &[isize],
    ) -> PyResult<Vec<[f32; N]>> {
        Ok(rows(name, &entry::<f32>(dict, name)?, leading)?.to_vec())
    }
    let means = copied(dict, &format!("{prefix}means"), &[-1])?;
    let n = means.len() as isize;
    let sh_name = format!("{prefix}sh");
    let sh = entry::<f32>(dict, &sh_name)?;
    let coeffs = rows::<f32, 3>(&sh_name, &sh, &[n, -1])?.to_vec();
    let stride = sh.shape()[1];
    let Some(sh_degree) = (0..=splat_render::constants::SH_DEGREE_MAX)
        .find(|&degree| splat_render::sh::coeffs(degree) == stride)
    else {
        return Err(PyValueError::new_err(format!(
            "{sh_name}: must have 1, 4, 9, 16 or 25 coefficients, not {stride}"
        )));
    };
    let opacities_name = format!("{prefix}opacities");
    let opacities = entry::<f32>(dict, &opacities_name)?;
    Ok(SplatArrays {
        means,
        quats: copied(dict, &format!("{prefix}quats"), &[n])?,
        scales: copied(dict, &format!("{prefix}scales"), &[n])?,
        opacities: elements(&opacities_name, &opacities, &[n])?.to_vec(),
        sh: coeffs,
        sh_degree,
    })
}

/// The reverse of [`splat_arrays_from`].
pub fn set_splat_arrays(
    dict: &Bound<'_, PyDict>,
    prefix: &str,
    splats: SplatArrays,
) -> PyResult<()> {
    let py = dict.py();
    let (n, stride) = (splats.len(), splats.stride());
    dict.set_item(format!("{prefix}means"), shaped_rows(py, splats.means, &[n])?)?;
    dict.set_item(format!("{prefix}quats"), shaped_rows(py, splats.quats, &[n])?)?;
    dict.set_item(format!("{prefix}scales"), shaped_rows(py, splats.scales, &[n])?)?;
    dict.set_item(format!("{prefix}opacities"), shaped(py, splats.opacities, &[n])?)?;
    dict.set_item(format!("{prefix}sh"), shaped_rows(py, splats.sh, &[n, stride])?)
}

/// The state in `dict` and the steps done; fresh, at `first_step`, where it holds no moments.
fn state_from(dict: &Bound<'_, PyDict>, first_step: u32) -> PyResult<(FitState, u32)> {
    let splats = splat_arrays_from(dict, "")?;
    if !dict.contains("step")? {
        return Ok((FitState::new(splats), first_step));
    }
    let n = splats.len() as isize;
    let stat = |name: &str| -> PyResult<Vec<f32>> {
        Ok(elements(name, &entry(dict, name)?, &[n])?.to_vec())
    };
    let step = entry::<u32>(dict, "step")?;
    let state = FitState {
        splats,
        first: splat_arrays_from(dict, "first_")?,
        second: splat_arrays_from(dict, "second_")?,
        stats: DensityStats { grad_sum: stat("stats_grad_sum")?, seen: stat("stats_seen")? },
    };
    Ok((state, elements("step", &step, &[1])?[0]))
}

/// The cameras' state in `dict`, if it holds one.
fn camera_state_from(dict: &Bound<'_, PyDict>, count: usize) -> PyResult<Option<CameraState>> {
    if !dict.contains("camera_viewmats")? {
        return Ok(None);
    }
    let n = count as isize;
    let table = |name: &str| -> PyResult<Vec<[f64; 7]>> {
        Ok(rows(name, &entry::<f64>(dict, name)?, &[n])?.to_vec())
    };
    let viewmats = entry::<f64>(dict, "camera_viewmats")?;
    let viewmats = rows::<f64, 4>("camera_viewmats", &viewmats, &[n, 4])?.as_chunks::<4>().0;
    let intrinsics = entry::<f64>(dict, "camera_intrinsics")?;
    let distances = entry::<f64>(dict, "camera_distances")?;
    let rounds = entry::<u32>(dict, "camera_rounds")?;
    Ok(Some(CameraState {
        viewmats: viewmats.iter().map(viewmat).collect(),
        intrinsics: rows("camera_intrinsics", &intrinsics, &[n])?.to_vec(),
        first: table("camera_first")?,
        second: rows("camera_second", &entry::<f64>(dict, "camera_second")?, &[n])?.to_vec(),
        gradients: table("camera_gradients")?,
        distances: elements("camera_distances", &distances, &[n])?.to_vec(),
        rounds: elements("camera_rounds", &rounds, &[1])?[0],
    }))
}

/// Where cameras are known to be: `viewmats` [V, 4, 4], `intrinsics` [V, 4], `information` [V, 6, 6]
/// about turn and move, `focal_information` [V] about the focal length's logarithm.
fn holds_from(dict: &Bound<'_, PyDict>, count: usize) -> PyResult<Vec<Hold>> {
    let n = count as isize;
    let viewmats = entry::<f64>(dict, "viewmats")?;
    let viewmats = rows::<f64, 4>("viewmats", &viewmats, &[n, 4])?.as_chunks::<4>().0;
    let intrinsics = entry::<f64>(dict, "intrinsics")?;
    let intrinsics = rows::<f64, 4>("intrinsics", &intrinsics, &[n])?;
    let information = entry::<f64>(dict, "information")?;
    let information = rows::<f64, 6>("information", &information, &[n, 6])?.as_chunks::<6>().0;
    let of_focal = entry::<f64>(dict, "focal_information")?;
    let of_focal = elements("focal_information", &of_focal, &[n])?;
    let each = viewmats.iter().zip(intrinsics).zip(information).zip(of_focal);
    Ok(each
        .map(|(((matrix, &[fx, fy, ..]), &pose), &log_focal)| Hold {
            viewmat: viewmat(matrix),
            focal: [fx, fy],
            pose,
            log_focal,
        })
        .collect())
}

/// The reverse of [`camera_state_from`].
fn set_camera_state(dict: &Bound<'_, PyDict>, state: CameraState) -> PyResult<()> {
    let (py, n) = (dict.py(), state.viewmats.len());
    set_cameras(dict, &state.viewmats, state.intrinsics)?;
    dict.set_item("camera_first", shaped_rows(py, state.first, &[n])?)?;
    dict.set_item("camera_second", shaped_rows(py, state.second, &[n])?)?;
    dict.set_item("camera_gradients", shaped_rows(py, state.gradients, &[n])?)?;
    dict.set_item("camera_distances", shaped(py, state.distances, &[n])?)?;
    dict.set_item("camera_rounds", shaped(py, vec![state.rounds], &[1])?)
}

/// `camera_viewmats` [V, 4, 4] and `camera_intrinsics` [V, 4].
fn set_cameras(
    dict: &Bound<'_, PyDict>,
    viewmats: &[DMat4],
    intrinsics: Vec<[f64; 4]>,
) -> PyResult<()> {
    let (py, n) = (dict.py(), viewmats.len());
    let table: Vec<[f64; 4]> =
        viewmats.iter().flat_map(|m| m.transpose().to_cols_array_2d()).collect();
    dict.set_item("camera_viewmats", shaped_rows(py, table, &[n, 4])?)?;
    dict.set_item("camera_intrinsics", shaped_rows(py, intrinsics, &[n])?)
}

/// Weights of a photo's pixels from a mask (bool) or from weights (float32), [H, W].
fn weights_from(name: &str, mask: &Bound<'_, PyAny>, size: [usize; 2]) -> PyResult<Vec<f32>> {
    let size = size.map(|side| side as isize);
    if let Ok(weights) = array::<f32>(name, mask) {
        return Ok(elements(name, &weights, &size)?.to_vec());
    }
    array::<bool>(name, mask)?;
    // numpy lets a bool hold any byte; Rust's bool may only be read as 0 or 1.
    let bytes = mask.call_method1("view", (numpy::dtype::<u8>(mask.py()),))?;
    let bytes = array::<u8>(name, &bytes)?;
    let bytes = elements(name, &bytes, &size)?;
    Ok(bytes.iter().map(|&counts| if counts == 0 { 0.0 } else { 1.0 }).collect())
}

fn targets_from(
    images: &Bound<'_, PyList>,
    masks: &Bound<'_, PyList>,
    backgrounds: &[Option<[f32; 3]>],
    schedule: &[(u32, Option<u32>)],
) -> PyResult<Vec<Target>> {
    for (name, entries) in
        [("masks", masks.len()), ("backgrounds", backgrounds.len()), ("schedule", schedule.len())]
    {
        if images.len() != entries {
            return Err(PyValueError::new_err(format!(
                "{name}: has {entries} entries for {} images",
                images.len()
            )));
        }
    }
    let mut targets = Vec::with_capacity(images.len());
    for (i, (image, mask)) in images.iter().zip(masks.iter()).enumerate() {
        let name = format!("images[{i}]");
        let image = array::<u8>(&name, &image)?;
        let pixels = elements(&name, &image, &[-1, -1, -1])?;
        let &[height, width, channels] = image.shape() else {
            return Err(PyValueError::new_err(format!("{name}: must have shape [H, W, C]")));
        };
        let weights = if mask.is_none() {
            None
        } else {
            Some(weights_from(&format!("masks[{i}]"), &mask, [height, width])?)
        };
        let target = Target {
            width: width as u32,
            height: height as u32,
            channels: channels as u32,
            pixels: pixels.to_vec(),
            weights,
            background: backgrounds[i],
            turns: schedule[i].0,
            until: schedule[i].1,
        };
        target.validate(i).map_err(to_python)?;
        targets.push(target);
    }
    Ok(targets)
}

impl Fitter {
    fn lock(&self) -> PyResult<MutexGuard<'_, splat_render::fit::Fitter>> {
        self.0
            .lock()
            .map_err(|_| PyRuntimeError::new_err("The fit failed earlier and cannot go on."))
    }
}

#[pymethods]
impl Fitter {
    /// A fit of `state` to photos, each with its turns in a round of steps and the first step that is
    /// not of it; `holds` say where cameras are known to be, and how surely.
    #[new]
    #[pyo3(signature = (images, masks, backgrounds, schedule, viewmats, intrinsics, state, config, backend, holds=None))]
    fn new<'py>(
        py: Python<'py>,
        images: &Bound<'py, PyList>,
        masks: &Bound<'py, PyList>,
        backgrounds: Vec<Option<[f32; 3]>>,
        schedule: Vec<(u32, Option<u32>)>,
        viewmats: &Bound<'py, PyAny>,
        intrinsics: &Bound<'py, PyAny>,
        state: &Bound<'py, PyDict>,
        config: &Bound<'py, PyDict>,
        backend: &str,
        holds: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Self> {
        let config = config_from(config)?;
        let targets = targets_from(images, masks, &backgrounds, &schedule)?;
        let sizes: Vec<(u32, u32)> = targets.iter().map(|t| (t.width, t.height)).collect();
        let cameras = cameras(viewmats, intrinsics, &sizes)?;
        let camera_state = camera_state_from(state, cameras.len())?;
        let holds = holds.map(|holds| holds_from(holds, cameras.len())).transpose()?;
        let (state, step) = state_from(state, config.first_step)?;
        let device = fit_device(backend)?;
        py.detach(|| {
            let mut fitter =
                splat_render::fit::Fitter::new(device, targets, cameras, state, step, config)?;
            if let Some(holds) = holds {
                fitter.hold_cameras(holds)?;
            }
            if let Some(camera_state) = camera_state {
                fitter.resume_cameras(camera_state)?;
            }
            Ok(Self(Mutex::new(fitter)))
        })
        .map_err(to_python)
    }

    /// Does `count` steps; returns `step`, `loss` (of the last one) and `splats`.
    fn step<'py>(&self, py: Python<'py>, count: u32) -> PyResult<Bound<'py, PyDict>> {
        let (step, loss, splats) = py.detach(|| {
            let mut fitter = self.lock()?;
            for _ in 0..count {
                fitter.step().map_err(to_python)?;
            }
            let loss = fitter.loss().map_err(to_python)?;
            PyResult::Ok((fitter.steps_done(), loss, fitter.splat_count()))
        })?;
        let done = PyDict::new(py);
        done.set_item("step", step)?;
        done.set_item("loss", loss)?;
        done.set_item("splats", splats)?;
        Ok(done)
    }

    /// Steps done.
    #[getter]
    fn steps_done(&self, py: Python<'_>) -> PyResult<u32> {
        py.detach(|| Ok(self.lock()?.steps_done()))
    }

    /// The parameters as they are now.
    fn splats<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let state = py.detach(|| self.lock()?.state().map_err(to_python))?;
        let dict = PyDict::new(py);
        set_splat_arrays(&dict, "", state.splats)?;
        Ok(dict)
    }

    /// The cameras as they are now: `camera_viewmats` and `camera_intrinsics`.
    fn cameras<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let cameras = py.detach(|| PyResult::Ok(self.lock()?.cameras().to_vec()))?;
        let viewmats: Vec<_> = cameras.iter().map(|c| c.viewmat).collect();
        let dict = PyDict::new(py);
        set_cameras(&dict, &viewmats, cameras.iter().map(|c| [c.fx, c.fy, c.cx, c.cy]).collect())?;
        Ok(dict)
    }

    /// Everything needed to go on bit for bit: the constructor's `state`.
    fn state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (state, step, cameras) = py.detach(|| {
            let mut fitter = self.lock()?;
            let state = fitter.state().map_err(to_python)?;
            let cameras = fitter.camera_state().map_err(to_python)?;
            PyResult::Ok((state, fitter.steps_done(), cameras))
        })?;
        let n = state.splats.len();
        let dict = PyDict::new(py);
        set_splat_arrays(&dict, "", state.splats)?;
        set_splat_arrays(&dict, "first_", state.first)?;
        set_splat_arrays(&dict, "second_", state.second)?;
        dict.set_item("stats_grad_sum", shaped(py, state.stats.grad_sum, &[n])?)?;
        dict.set_item("stats_seen", shaped(py, state.stats.seen, &[n])?)?;
        dict.set_item("step", shaped(py, vec![step], &[1])?)?;
        if let Some(cameras) = cameras {
            set_camera_state(&dict, cameras)?;
        }
        Ok(dict)
    }
}

/// One round splat per point, as large as the mean distance to its three nearest neighbours.
#[pyfunction]
pub fn splats_from_points<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    sh_degree: u32,
) -> PyResult<Bound<'py, PyDict>> {
    if sh_degree > splat_render::constants::SH_DEGREE_MAX {
        return Err(PyValueError::new_err(format!("sh_degree: must be 0 to 4, not {sh_degree}")));
    }
    let points = array::<f32>("points", points)?;
    let points = rows::<f32, 3>("points", &points, &[-1])?;
    let colors = array::<f32>("colors", colors)?;
    let colors = rows::<f32, 3>("colors", &colors, &[points.len() as isize])?;
    let splats = py
        .detach(|| splat_render::fit::splats_from_points(points, colors, sh_degree))
        .map_err(to_python)?;
    let dict = PyDict::new(py);
    set_splat_arrays(&dict, "", splats)?;
    Ok(dict)
}
