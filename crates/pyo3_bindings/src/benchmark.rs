//! Functions for benchmarks: timed stages, the machine's peak speed, and pixels that rounding may change.

use std::time::{Duration, Instant};

use numpy::PyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use splat_render::cpu::{self, Cpu};
use splat_render::reference::{self, Reference};
use splat_render::{Projected, Result, Stages};

use crate::arguments::Call;
use crate::arrays::{row, shaped};
use crate::backend::{Backend, gpu};
use crate::error::to_python;
use crate::stages::{
    PARAMETERS, Parameters, PictureGradients, Real, SplatArrays, View, projected_from, with_stages,
};

/// Speed of multiply-adds on all threads in Gflop/s, measured for `seconds` with the CPU backend's
/// instructions.
#[pyfunction]
pub fn peak_multiply_add(py: Python<'_>, seconds: f64) -> PyResult<f64> {
    let duration = Duration::try_from_secs_f64(seconds)
        .map_err(|error| PyValueError::new_err(format!("seconds: {error}")))?;
    Ok(py.detach(|| cpu::peak_multiply_add(duration)))
}

/// Pixels at which rounding to f32 may change which splats count, [H, W] of 0 and 1.
#[pyfunction]
#[pyo3(signature = (projected, *, width, height, alpha_band))]
pub fn band_pixels<'py>(
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    width: u32,
    height: u32,
    alpha_band: f64,
) -> PyResult<Bound<'py, PyArrayDyn<u8>>> {
    let projected = projected_from::<f64>(projected, width, height)?;
    projected.validate().map_err(to_python)?;
    let band = py.detach(|| reference::band_pixels(&projected, alpha_band));
    let bytes = band.into_iter().map(u8::from).collect();
    shaped(py, bytes, &[height as usize, width as usize])
}

/// Milliseconds of one call, and its result.
fn timed<R>(call: impl FnOnce() -> Result<R>) -> Result<(f64, R)> {
    let started = Instant::now();
    let value = call()?;
    Ok((started.elapsed().as_secs_f64() * 1e3, value))
}

/// Inputs of the timed backward stages, and the number of repeats.
struct Timing<'py> {
    background: Bound<'py, PyAny>,
    v_image: PictureGradients<'py>,
    repeats: usize,
}

impl<'py> Timing<'py> {
    fn take(call: &Call<'py>) -> PyResult<Self> {
        Ok(Self {
            background: call.object("background")?,
            v_image: PictureGradients::take(call)?,
            repeats: call.take("repeats")?,
        })
    }
}

/// Times the two rasterize stages, bin included, on 2D splats that are converted once.
#[pyfunction]
#[pyo3(
    signature = (*positional, **named),
    text_signature = "(projected, *, width, height, background, v_color, v_alpha, v_depth, repeats, backend)"
)]
pub fn time_rasterize<'py>(
    py: Python<'py>,
    positional: &Bound<'py, PyTuple>,
    named: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let call = Call::bind("time_rasterize", &["projected"], positional, named)?;
    let projected = call.dict("projected")?;
    let size = (call.take("width")?, call.take("height")?);
    let timing = Timing::take(&call)?;
    let backend: String = call.take("backend")?;
    call.finish()?;
    with_stages!(&backend, time_rasterize_with(py, &projected, size, &timing))
}

fn time_rasterize_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    (width, height): (u32, u32),
    timing: &Timing<'py>,
) -> PyResult<Bound<'py, PyDict>> {
    let projected: Projected<T> = projected_from(projected, width, height)?;
    let background = row::<T, 3>("background", &timing.background)?;
    let v_image = timing.v_image.read(width, height)?;
    let repeats = timing.repeats;
    let times = py.detach(|| {
        let mut times = [const { Vec::new() }; 2];
        for _ in 0..repeats {
            let (ms, image) = timed(|| stages.rasterize(&projected, background))?;
            times[0].push(ms);
            let backward =
                || stages.rasterize_backward(&projected, background, &image, &v_image, false);
            times[1].push(timed(backward)?.0);
        }
        Ok(times)
    });
    dict_of_times(py, ["rasterize", "rasterize_backward"], times.map_err(to_python)?)
}

/// Times all four stages, one after another, on splats that are converted once.
#[pyfunction]
#[pyo3(
    signature = (*positional, **named),
    text_signature = "(means, quats, scales, opacities, colors, *, sh_degree, raw_parameters, viewmat, intrinsics, width, height, near, far, eps2d, antialiased, background, v_color, v_alpha, v_depth, repeats, backend)"
)]
pub fn time_pipeline<'py>(
    py: Python<'py>,
    positional: &Bound<'py, PyTuple>,
    named: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let call = Call::bind("time_pipeline", &PARAMETERS, positional, named)?;
    let (parameters, view) = (Parameters::take(&call)?, View::take(&call)?);
    let timing = Timing::take(&call)?;
    let backend: String = call.take("backend")?;
    call.finish()?;
    with_stages!(&backend, time_pipeline_with(py, &parameters, &view, &timing))
}

fn time_pipeline_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    parameters: &Parameters<'py>,
    view: &View,
    timing: &Timing<'py>,
) -> PyResult<Bound<'py, PyDict>> {
    let arrays = SplatArrays::<T>::borrow(parameters)?;
    let params = arrays.params(view)?;
    let (camera, options) = (&view.camera, &view.options);
    let background = row::<T, 3>("background", &timing.background)?;
    let v_image = timing.v_image.read(camera.width, camera.height)?;
    let repeats = timing.repeats;
    let times = py.detach(|| {
        let mut times = [const { Vec::new() }; 4];
        for _ in 0..repeats {
            let (ms, projected) = timed(|| stages.project(&params, camera, options))?;
            times[0].push(ms);
            let (ms, image) = timed(|| stages.rasterize(&projected, background))?;
            times[1].push(ms);
            let backward =
                || stages.rasterize_backward(&projected, background, &image, &v_image, false);
            let (ms, v_projected) = timed(backward)?;
            times[2].push(ms);
            let backward =
                || stages.project_backward(&params, camera, options, &projected, &v_projected);
            times[3].push(timed(backward)?.0);
        }
        Ok(times)
    });
    let names = ["project", "rasterize", "rasterize_backward", "project_backward"];
    dict_of_times(py, names, times.map_err(to_python)?)
}

fn dict_of_times<'py, const N: usize>(
    py: Python<'py>,
    names: [&str; N],
    times: [Vec<f64>; N],
) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (name, times) in names.into_iter().zip(times) {
        let count = [times.len()];
        dict.set_item(name, shaped(py, times, &count)?)?;
    }
    Ok(dict)
}
