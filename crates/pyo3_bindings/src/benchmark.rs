//! What only the benchmark asks of the renderer: stages timed without the conversion of arrays, the
//! machine's peak, and the pixels at which implementations may rightly differ.

use std::time::{Duration, Instant};

use numpy::PyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::cpu::{self, Cpu};
use splat_render::reference::{self, Reference};
use splat_render::{ImageGradients, ProjectOptions, Projected, Result, Stages};

use crate::arrays::{array, elements, row, rows, shaped};
use crate::backend::{Backend, gpu};
use crate::camera::camera;
use crate::error::to_python;
use crate::stages::{ProjectArguments, Real, SplatArrays, projected_from, with_stages};

/// 10^9 floating-point operations per second that the CPU's threads reach in a loop of multiply-adds
/// of about `seconds`, with the instruction set that the backend "cpu" runs with.
#[pyfunction]
pub fn peak_multiply_add(py: Python<'_>, seconds: f64) -> PyResult<f64> {
    let duration = Duration::try_from_secs_f64(seconds)
        .map_err(|error| PyValueError::new_err(format!("seconds: {error}")))?;
    Ok(py.detach(|| cpu::peak_multiply_add(duration)))
}

/// Pixels at which an f32 implementation may rightly differ from the reference: [H, W] of 0 and 1.
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

/// Milliseconds of one call, and what it returned.
fn timed<R>(call: impl FnOnce() -> Result<R>) -> Result<(f64, R)> {
    let started = Instant::now();
    let value = call()?;
    Ok((started.elapsed().as_secs_f64() * 1e3, value))
}

/// The gradients of a picture, owned.
fn gradients_from<T: Real>(
    [v_color, v_alpha, v_depth]: [&Bound<'_, PyAny>; 3],
    width: u32,
    height: u32,
) -> PyResult<ImageGradients<T>> {
    let size = [height as isize, width as isize];
    Ok(ImageGradients {
        v_color: rows("v_color", &array("v_color", v_color)?, &size)?.to_vec(),
        v_alpha: elements("v_alpha", &array("v_alpha", v_alpha)?, &size)?.to_vec(),
        v_depth: elements("v_depth", &array("v_depth", v_depth)?, &size)?.to_vec(),
    })
}

/// The two rasterize stages (bin included) on 2D splats that are converted once.
#[pyfunction]
#[pyo3(signature = (projected, *, width, height, background, v_color, v_alpha, v_depth, repeats,
    backend))]
#[expect(clippy::too_many_arguments, reason = "one per array: the Python call names them")]
pub fn time_rasterize<'py>(
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    width: u32,
    height: u32,
    background: &Bound<'py, PyAny>,
    v_color: &Bound<'py, PyAny>,
    v_alpha: &Bound<'py, PyAny>,
    v_depth: &Bound<'py, PyAny>,
    repeats: usize,
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let v_image = [v_color, v_alpha, v_depth];
    let size = (width, height);
    with_stages!(backend, time_rasterize_with(py, projected, size, background, v_image, repeats))
}

fn time_rasterize_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    (width, height): (u32, u32),
    background: &Bound<'py, PyAny>,
    v_image: [&Bound<'py, PyAny>; 3],
    repeats: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let projected: Projected<T> = projected_from(projected, width, height)?;
    let background = row::<T, 3>("background", background)?;
    let v_image = gradients_from(v_image, width, height)?;
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

/// All four stages, one after another, on splats that are converted once.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, *, sh_degree, raw_parameters, viewmat,
    intrinsics, width, height, near, far, eps2d, antialiased, background, v_color, v_alpha, v_depth, repeats,
    backend))]
#[expect(clippy::too_many_arguments, reason = "one per array: the Python call names them")]
pub fn time_pipeline<'py>(
    py: Python<'py>,
    means: &Bound<'py, PyAny>,
    quats: &Bound<'py, PyAny>,
    scales: &Bound<'py, PyAny>,
    opacities: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    sh_degree: Option<u32>,
    raw_parameters: bool,
    viewmat: &Bound<'py, PyAny>,
    intrinsics: &Bound<'py, PyAny>,
    width: u32,
    height: u32,
    near: f32,
    far: f32,
    eps2d: f32,
    antialiased: bool,
    background: &Bound<'py, PyAny>,
    v_color: &Bound<'py, PyAny>,
    v_alpha: &Bound<'py, PyAny>,
    v_depth: &Bound<'py, PyAny>,
    repeats: usize,
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let arguments = ProjectArguments {
        means,
        quats,
        scales,
        opacities,
        colors,
        sh_degree,
        raw_parameters,
        camera: camera(viewmat, intrinsics, width, height)?,
        options: ProjectOptions { near, far, blur: eps2d, antialiased },
    };
    let v_image = [v_color, v_alpha, v_depth];
    with_stages!(backend, time_pipeline_with(py, &arguments, background, v_image, repeats))
}

fn time_pipeline_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    arguments: &ProjectArguments<'_, 'py>,
    background: &Bound<'py, PyAny>,
    v_image: [&Bound<'py, PyAny>; 3],
    repeats: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let arrays = SplatArrays::<T>::borrow(arguments)?;
    let params = arrays.params(arguments.sh_degree, arguments.raw_parameters)?;
    let (camera, options) = (&arguments.camera, &arguments.options);
    let background = row::<T, 3>("background", background)?;
    let v_image = gradients_from(v_image, camera.width, camera.height)?;
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
