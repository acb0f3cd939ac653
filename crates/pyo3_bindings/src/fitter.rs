//! A fit in progress, stepped from Python.

use std::sync::{Mutex, MutexGuard};

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use splat_render::fit::CommandTime;

use crate::arguments::{Call, setting};
use crate::arrays::{array, rows, shaped, shaped_rows};
use crate::backend::fit_device;
use crate::camera::cameras;
use crate::error::to_python;
use crate::fit_settings::config_from;
use crate::fit_state::{
    camera_state_from, exposure_state_from, exposures_from, pose_priors_from, set_camera_state,
    set_cameras, set_exposure_state, state_from,
};
use crate::photos::targets_from;
use crate::splat_arrays::set_splat_arrays;

/// Names of the constructor's arguments, in their order.
const ARGUMENTS: [&str; 13] = [
    "images",
    "masks",
    "backgrounds",
    "schedule",
    "viewmats",
    "intrinsics",
    "state",
    "config",
    "backend",
    "pose_priors",
    "exposures",
    "rigs",
    "depths",
];

/// A fit in progress. Its parameters stay on the device that computes.
#[pyclass]
pub struct Fitter(Mutex<splat_render::fit::Fitter>);

impl Fitter {
    fn lock(&self) -> PyResult<MutexGuard<'_, splat_render::fit::Fitter>> {
        self.0.lock().map_err(|_| {
            PyRuntimeError::new_err("The fit failed before and cannot go on; start it again.")
        })
    }
}

#[pymethods]
impl Fitter {
    /// A fit to photos, started from splats or resumed from a state.
    #[new]
    #[pyo3(
        signature = (*positional, **named),
        text_signature = "(images, masks, backgrounds, schedule, viewmats, intrinsics, state, config, backend, pose_priors=None, exposures=None, rigs=None, depths=None)"
    )]
    fn new<'py>(
        py: Python<'py>,
        positional: &Bound<'py, PyTuple>,
        named: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Self> {
        let call = Call::bind("Fitter", &ARGUMENTS, positional, named)?;
        let config = call.dict("config")?;
        let frozen = setting(&config, "frozen_splats")?.unwrap_or(0);
        let config = config_from(&config)?;
        let targets = targets_from(&call)?;
        let sizes: Vec<(u32, u32)> = targets.iter().map(|t| (t.width, t.height)).collect();
        let cameras = cameras(&call.object("viewmats")?, &call.object("intrinsics")?, &sizes)?;
        let state = call.dict("state")?;
        let camera_state = camera_state_from(&state, cameras.len())?;
        let exposure_state = exposure_state_from(&state, cameras.len())?;
        let exposures = call.optional::<Bound<'_, PyDict>>("exposures")?;
        let exposures = exposures.map(|start| exposures_from(&start, cameras.len())).transpose()?;
        let priors = call.optional::<Bound<'_, PyDict>>("pose_priors")?;
        let priors = priors.map(|priors| pose_priors_from(&priors, cameras.len())).transpose()?;
        let rigs = call.optional::<Vec<u32>>("rigs")?;
        let (state, step) = state_from(&state, config.first_step, frozen)?;
        let device = fit_device(&call.take::<String>("backend")?)?;
        call.finish()?;
        py.detach(|| {
            let mut fitter =
                splat_render::fit::Fitter::new(device, targets, cameras, state, step, config)?;
            if let Some(rigs) = rigs {
                fitter.set_rigs(&rigs)?;
            }
            if let Some(priors) = priors {
                fitter.set_pose_priors(priors)?;
            }
            if let Some((exposures, pulls)) = exposures {
                fitter.start_exposures(&exposures, &pulls)?;
            }
            if let Some(exposure_state) = exposure_state {
                fitter.resume_exposures(exposure_state)?;
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

    /// Does `count` steps; returns the names and milliseconds of the commands of each, on a GPU.
    fn measured_steps(
        &self,
        py: Python<'_>,
        count: u32,
    ) -> PyResult<Vec<Vec<(&'static str, f64)>>> {
        let steps = py.detach(|| self.lock()?.measured_steps(count).map_err(to_python))?;
        let named = |step: Vec<CommandTime>| step.iter().map(|time| (time.name, time.ms)).collect();
        Ok(steps.into_iter().map(named).collect())
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

    /// The current exposures if they are fitted: `gains` and `offsets`, [V, 3] each.
    fn exposures<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let Some(state) = py.detach(|| self.lock()?.exposure_state().map_err(to_python))? else {
            return Ok(None);
        };
        let (n, dict) = (state.gains.len(), PyDict::new(py));
        dict.set_item("gains", shaped_rows(py, state.gains, &[n])?)?;
        dict.set_item("offsets", shaped_rows(py, state.offsets, &[n])?)?;
        Ok(Some(dict))
    }

    /// Everything needed to go on bit for bit: the constructor's `state`.
    fn state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (state, step, cameras, exposures) = py.detach(|| {
            let mut fitter = self.lock()?;
            let state = fitter.state().map_err(to_python)?;
            let cameras = fitter.camera_state().map_err(to_python)?;
            let exposures = fitter.exposure_state().map_err(to_python)?;
            PyResult::Ok((state, fitter.steps_done(), cameras, exposures))
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
        if let Some(exposures) = exposures {
            set_exposure_state(&dict, exposures)?;
        }
        Ok(dict)
    }
}

/// One round splat per point, as large as the mean distance to its three nearest neighbors.
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
