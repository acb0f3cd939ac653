//! Everything a fit needs to go on, as dicts of numpy arrays: splats, optimizer moments, cameras.

use glam::DMat4;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::fit::{CameraState, DensityStats, Exposure, ExposureState, FitState, PosePrior};

use crate::arrays::{elements, entry, rows, shaped, shaped_rows};
use crate::camera::viewmat;
use crate::splat_arrays::splat_arrays_from;

/// Reads a fit's state and step; without moments, a new fit at `first_step`. `frozen` counts from the
/// end.
pub fn state_from(
    dict: &Bound<'_, PyDict>,
    first_step: u32,
    frozen: usize,
) -> PyResult<(FitState, u32)> {
    let splats = splat_arrays_from(dict, "")?;
    if !dict.contains("step")? {
        return Ok((FitState { frozen, ..FitState::new(splats) }, first_step));
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
        frozen,
    };
    Ok((state, elements("step", &step, &[1])?[0]))
}

/// Reads the state of the cameras, if the dict pose_priors one.
pub fn camera_state_from(dict: &Bound<'_, PyDict>, count: usize) -> PyResult<Option<CameraState>> {
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

/// Starts of exposures and the pulls to them.
pub type ExposureStarts = (Vec<Option<Exposure<f64>>>, Vec<f64>);

/// Initial exposures: `gains` [V, 3], `offsets` [V, 3], `fitted` [V] (False for photos without an initial
/// exposure) and `pulls` [V] toward the initial values.
pub fn exposures_from(dict: &Bound<'_, PyDict>, count: usize) -> PyResult<ExposureStarts> {
    let n = count as isize;
    let gains = entry::<f64>(dict, "gains")?;
    let gains = rows::<f64, 3>("gains", &gains, &[n])?;
    let offsets = entry::<f64>(dict, "offsets")?;
    let offsets = rows::<f64, 3>("offsets", &offsets, &[n])?;
    let fitted = entry::<bool>(dict, "fitted")?;
    let fitted = elements("fitted", &fitted, &[n])?;
    let start = |k: usize| Exposure { gain: gains[k], offset: offsets[k], background: None };
    let pulls = entry::<f64>(dict, "pulls")?;
    let pulls = elements("pulls", &pulls, &[n])?.to_vec();
    Ok(((0..count).map(|k| fitted[k].then(|| start(k))).collect(), pulls))
}

/// Reads the state of the exposures, if the dict pose_priors one.
pub fn exposure_state_from(
    dict: &Bound<'_, PyDict>,
    count: usize,
) -> PyResult<Option<ExposureState>> {
    if !dict.contains("exposure_gains")? {
        return Ok(None);
    }
    let n = count as isize;
    let colors = |name: &str| -> PyResult<Vec<[f64; 3]>> {
        Ok(rows(name, &entry::<f64>(dict, name)?, &[n])?.to_vec())
    };
    let table = |name: &str| -> PyResult<Vec<[f64; 6]>> {
        Ok(rows(name, &entry::<f64>(dict, name)?, &[n])?.to_vec())
    };
    let rounds = entry::<u32>(dict, "exposure_rounds")?;
    Ok(Some(ExposureState {
        gains: colors("exposure_gains")?,
        offsets: colors("exposure_offsets")?,
        first: table("exposure_first")?,
        second: table("exposure_second")?,
        gradients: table("exposure_gradients")?,
        rounds: elements("exposure_rounds", &rounds, &[1])?[0],
    }))
}

/// Writes the entries that [`exposure_state_from`] reads.
pub fn set_exposure_state(dict: &Bound<'_, PyDict>, state: ExposureState) -> PyResult<()> {
    let (py, n) = (dict.py(), state.gains.len());
    dict.set_item("exposure_gains", shaped_rows(py, state.gains, &[n])?)?;
    dict.set_item("exposure_offsets", shaped_rows(py, state.offsets, &[n])?)?;
    dict.set_item("exposure_first", shaped_rows(py, state.first, &[n])?)?;
    dict.set_item("exposure_second", shaped_rows(py, state.second, &[n])?)?;
    dict.set_item("exposure_gradients", shaped_rows(py, state.gradients, &[n])?)?;
    dict.set_item("exposure_rounds", shaped(py, vec![state.rounds], &[1])?)
}

/// Pose priors of the cameras: `viewmats` [V, 4, 4], `intrinsics` [V, 4], `information` [V, 6, 6] (the
/// inverse covariance of rotation and translation), `focal_information` [V] (of the logarithm of the
/// focal length).
pub fn pose_priors_from(dict: &Bound<'_, PyDict>, count: usize) -> PyResult<Vec<PosePrior>> {
    let n = count as isize;
    let viewmats = entry::<f64>(dict, "viewmats")?;
    let viewmats = rows::<f64, 4>("viewmats", &viewmats, &[n, 4])?.as_chunks::<4>().0;
    let intrinsics = entry::<f64>(dict, "intrinsics")?;
    let intrinsics = rows::<f64, 4>("intrinsics", &intrinsics, &[n])?;
    let information = entry::<f64>(dict, "information")?;
    let information = rows::<f64, 6>("information", &information, &[n, 6])?.as_chunks::<6>().0;
    let focal_information = entry::<f64>(dict, "focal_information")?;
    let focal_information = elements("focal_information", &focal_information, &[n])?;
    let prior = |i: usize| {
        let [fx, fy, ..] = intrinsics[i];
        PosePrior {
            viewmat: viewmat(&viewmats[i]),
            focal: [fx, fy],
            pose: information[i],
            log_focal: focal_information[i],
        }
    };
    Ok((0..count).map(prior).collect())
}

/// Writes the entries that [`camera_state_from`] reads.
pub fn set_camera_state(dict: &Bound<'_, PyDict>, state: CameraState) -> PyResult<()> {
    let (py, n) = (dict.py(), state.viewmats.len());
    set_cameras(dict, &state.viewmats, state.intrinsics)?;
    dict.set_item("camera_first", shaped_rows(py, state.first, &[n])?)?;
    dict.set_item("camera_second", shaped_rows(py, state.second, &[n])?)?;
    dict.set_item("camera_gradients", shaped_rows(py, state.gradients, &[n])?)?;
    dict.set_item("camera_distances", shaped(py, state.distances, &[n])?)?;
    dict.set_item("camera_rounds", shaped(py, vec![state.rounds], &[1])?)
}

/// Writes `camera_viewmats` [V, 4, 4] and `camera_intrinsics` [V, 4].
pub fn set_cameras(
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
