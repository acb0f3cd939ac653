//! The four differentiable stages over numpy arrays.

use numpy::{Element, PyReadonlyArrayDyn};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::cpu::Cpu;
use splat_render::reference::Reference;
use splat_render::{
    Colors, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};

use crate::arrays::{array, elements, entry, row, rows, shaped, shaped_rows};
use crate::backend::{Backend, gpu};
use crate::camera::camera;
use crate::error::to_python;

/// What numpy and the stages ask of a number.
pub trait Real: Element + Copy + Default + Send + Sync {}
impl Real for f32 {}
impl Real for f64 {}

/// Calls a function generic over the number type with the stages of a backend.
macro_rules! with_stages {
    ($backend:expr, $function:ident($($argument:expr),* $(,)?)) => {
        match Backend::named($backend)? {
            Backend::Cpu => $function::<f32>(&Cpu, $($argument),*),
            Backend::Gpu => $function::<f32>(&**gpu()?, $($argument),*),
            Backend::Reference => $function::<f64>(&Reference, $($argument),*),
        }
    };
}
pub(crate) use with_stages;

/// Arguments that `project` and `project_backward` share.
pub struct ProjectArguments<'a, 'py> {
    pub means: &'a Bound<'py, PyAny>,
    pub quats: &'a Bound<'py, PyAny>,
    pub scales: &'a Bound<'py, PyAny>,
    pub opacities: &'a Bound<'py, PyAny>,
    pub colors: &'a Bound<'py, PyAny>,
    pub sh_degree: Option<u32>,
    pub raw_parameters: bool,
    pub camera: splat_render::Camera,
    pub options: ProjectOptions,
}

/// Splat parameters, borrowed from numpy.
pub struct SplatArrays<'py, T: Element> {
    means: PyReadonlyArrayDyn<'py, T>,
    quats: PyReadonlyArrayDyn<'py, T>,
    scales: PyReadonlyArrayDyn<'py, T>,
    opacities: PyReadonlyArrayDyn<'py, T>,
    colors: PyReadonlyArrayDyn<'py, T>,
}

impl<'py, T: Real> SplatArrays<'py, T> {
    pub fn borrow(arguments: &ProjectArguments<'_, 'py>) -> PyResult<Self> {
        Ok(Self {
            means: array("means", arguments.means)?,
            quats: array("quats", arguments.quats)?,
            scales: array("scales", arguments.scales)?,
            opacities: array("opacities", arguments.opacities)?,
            colors: array("colors", arguments.colors)?,
        })
    }

    pub fn params(&self, sh_degree: Option<u32>, raw: bool) -> PyResult<SplatParams<'_, T>> {
        let means = rows("means", &self.means, &[-1])?;
        let n = means.len() as isize;
        let colors = match sh_degree {
            None => Colors::Direct(rows("colors", &self.colors, &[n])?),
            Some(degree) => {
                let coeffs = rows("colors", &self.colors, &[n, -1])?;
                let stride = numpy::PyUntypedArrayMethods::shape(&*self.colors)[1];
                Colors::Sh { degree, stride, coeffs }
            }
        };
        Ok(SplatParams {
            means,
            quats: rows("quats", &self.quats, &[n])?,
            scales: rows("scales", &self.scales, &[n])?,
            opacities: elements("opacities", &self.opacities, &[n])?,
            colors,
            raw,
        })
    }
}

/// 2D splats, copied from the dict that `project` returns.
pub fn projected_from<T: Real>(
    dict: &Bound<'_, PyDict>,
    width: u32,
    height: u32,
) -> PyResult<Projected<T>> {
    fn copied<T: Real, const N: usize>(
        dict: &Bound<'_, PyDict>,
        name: &str,
        n: isize,
    ) -> PyResult<Vec<[T; N]>> {
        Ok(rows(name, &entry::<T>(dict, name)?, &[n])?.to_vec())
    }
    let means2d = copied(dict, "means2d", -1)?;
    let n = means2d.len() as isize;
    let depths = entry(dict, "depths")?;
    let opacities = entry(dict, "opacities")?;
    Ok(Projected {
        width,
        height,
        means2d,
        factors: copied(dict, "factors", n)?,
        depths: elements("depths", &depths, &[n])?.to_vec(),
        colors: copied(dict, "colors", n)?,
        opacities: elements("opacities", &opacities, &[n])?.to_vec(),
        radii: copied(dict, "radii", n)?,
    })
}

/// Splats and one camera to 2D splats.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, *, sh_degree, raw_parameters, viewmat,
    intrinsics, width, height, near, far, eps2d, antialiased, backend))]
#[expect(clippy::too_many_arguments, reason = "one per array: the Python call names them")]
pub fn project<'py>(
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
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let camera = camera(viewmat, intrinsics, width, height)?;
    let options = ProjectOptions { near, far, blur: eps2d, antialiased };
    let arguments = ProjectArguments {
        means,
        quats,
        scales,
        opacities,
        colors,
        sh_degree,
        raw_parameters,
        camera,
        options,
    };
    with_stages!(backend, project_with(py, &arguments))
}

fn project_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    arguments: &ProjectArguments<'_, 'py>,
) -> PyResult<Bound<'py, PyDict>> {
    let arrays = SplatArrays::<T>::borrow(arguments)?;
    let params = arrays.params(arguments.sh_degree, arguments.raw_parameters)?;
    let (camera, options) = (&arguments.camera, &arguments.options);
    let projected = py.detach(|| stages.project(&params, camera, options)).map_err(to_python)?;
    let n = [projected.len()];
    let dict = PyDict::new(py);
    dict.set_item("means2d", shaped_rows(py, projected.means2d, &n)?)?;
    dict.set_item("factors", shaped_rows(py, projected.factors, &n)?)?;
    dict.set_item("depths", shaped(py, projected.depths, &n)?)?;
    dict.set_item("colors", shaped_rows(py, projected.colors, &n)?)?;
    dict.set_item("opacities", shaped(py, projected.opacities, &n)?)?;
    dict.set_item("radii", shaped_rows(py, projected.radii, &n)?)?;
    Ok(dict)
}

/// 2D splats to a picture over a background.
#[pyfunction]
#[pyo3(signature = (projected, *, width, height, background, backend))]
pub fn rasterize<'py>(
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    width: u32,
    height: u32,
    background: &Bound<'py, PyAny>,
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    with_stages!(backend, rasterize_with(py, projected, width, height, background))
}

fn rasterize_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    width: u32,
    height: u32,
    background: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyDict>> {
    let projected = projected_from::<T>(projected, width, height)?;
    let background = row::<T, 3>("background", background)?;
    let image = py.detach(|| stages.rasterize(&projected, background)).map_err(to_python)?;
    let size = [height as usize, width as usize];
    let dict = PyDict::new(py);
    dict.set_item("color", shaped_rows(py, image.color, &size)?)?;
    dict.set_item("alpha", shaped(py, image.alpha, &size)?)?;
    dict.set_item("depth", shaped(py, image.depth, &size)?)?;
    dict.set_item("transmittance", shaped(py, image.transmittance, &size)?)?;
    Ok(dict)
}

/// Gradients of a picture to gradients of its 2D splats and background.
#[pyfunction]
#[pyo3(signature = (projected, image, *, v_color, v_alpha, v_depth, background, absolute,
    backend))]
#[expect(clippy::too_many_arguments, reason = "one per array: the Python call names them")]
pub fn rasterize_backward<'py>(
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    image: &Bound<'py, PyDict>,
    v_color: &Bound<'py, PyAny>,
    v_alpha: &Bound<'py, PyAny>,
    v_depth: &Bound<'py, PyAny>,
    background: &Bound<'py, PyAny>,
    absolute: bool,
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let v_image = [v_color, v_alpha, v_depth];
    with_stages!(
        backend,
        rasterize_backward_with(py, projected, image, v_image, background, absolute)
    )
}

fn rasterize_backward_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    image: &Bound<'py, PyDict>,
    [v_color, v_alpha, v_depth]: [&Bound<'py, PyAny>; 3],
    background: &Bound<'py, PyAny>,
    absolute: bool,
) -> PyResult<Bound<'py, PyDict>> {
    let alpha = entry::<T>(image, "alpha")?;
    elements("alpha", &alpha, &[-1, -1])?;
    let &[height, width] = numpy::PyUntypedArrayMethods::shape(&*alpha) else {
        return Err(PyValueError::new_err("alpha: must have shape [H, W]"));
    };
    let size = [height as isize, width as isize];
    let plane = |name: &str| -> PyResult<Vec<T>> {
        Ok(elements(name, &entry(image, name)?, &size)?.to_vec())
    };
    let (width, height) = (width as u32, height as u32);
    let projected = projected_from::<T>(projected, width, height)?;
    let background = row::<T, 3>("background", background)?;
    let image = Image {
        width,
        height,
        color: rows("color", &entry(image, "color")?, &size)?.to_vec(),
        alpha: plane("alpha")?,
        depth: plane("depth")?,
        transmittance: plane("transmittance")?,
    };
    let v_image = ImageGradients {
        v_color: rows("v_color", &array("v_color", v_color)?, &size)?.to_vec(),
        v_alpha: elements("v_alpha", &array("v_alpha", v_alpha)?, &size)?.to_vec(),
        v_depth: elements("v_depth", &array("v_depth", v_depth)?, &size)?.to_vec(),
    };
    let v: ProjectedGradients<T> = py
        .detach(|| stages.rasterize_backward(&projected, background, &image, &v_image, absolute))
        .map_err(to_python)?;
    let n = [projected.len()];
    let dict = PyDict::new(py);
    dict.set_item("v_means2d", shaped_rows(py, v.v_means2d, &n)?)?;
    dict.set_item("v_factors", shaped_rows(py, v.v_factors, &n)?)?;
    if let Some(v_absolute) = v.v_means2d_absolute {
        dict.set_item("v_means2d_absolute", shaped_rows(py, v_absolute, &n)?)?;
    }
    dict.set_item("v_depths", shaped(py, v.v_depths, &n)?)?;
    dict.set_item("v_colors", shaped_rows(py, v.v_colors, &n)?)?;
    dict.set_item("v_opacities", shaped(py, v.v_opacities, &n)?)?;
    dict.set_item("v_background", shaped(py, v.v_background.to_vec(), &[3])?)?;
    Ok(dict)
}

/// Gradients of 2D splats to gradients of the splats and the camera.
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, projected, v_projected, *, sh_degree,
    raw_parameters, viewmat, intrinsics, width, height, near, far, eps2d, antialiased, backend))]
#[expect(clippy::too_many_arguments, reason = "one per array: the Python call names them")]
pub fn project_backward<'py>(
    py: Python<'py>,
    means: &Bound<'py, PyAny>,
    quats: &Bound<'py, PyAny>,
    scales: &Bound<'py, PyAny>,
    opacities: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    projected: &Bound<'py, PyDict>,
    v_projected: &Bound<'py, PyDict>,
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
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let camera = camera(viewmat, intrinsics, width, height)?;
    let options = ProjectOptions { near, far, blur: eps2d, antialiased };
    let arguments = ProjectArguments {
        means,
        quats,
        scales,
        opacities,
        colors,
        sh_degree,
        raw_parameters,
        camera,
        options,
    };
    with_stages!(backend, project_backward_with(py, &arguments, projected, v_projected))
}

fn project_backward_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    arguments: &ProjectArguments<'_, 'py>,
    projected: &Bound<'py, PyDict>,
    v_projected: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyDict>> {
    let arrays = SplatArrays::<T>::borrow(arguments)?;
    let params = arrays.params(arguments.sh_degree, arguments.raw_parameters)?;
    let (camera, options) = (&arguments.camera, &arguments.options);
    let projected = projected_from::<T>(projected, camera.width, camera.height)?;
    let n = params.len() as isize;
    let v = v_projected;
    let v_projected = ProjectedGradients {
        v_means2d: rows("v_means2d", &entry(v, "v_means2d")?, &[n])?.to_vec(),
        v_factors: rows("v_factors", &entry(v, "v_factors")?, &[n])?.to_vec(),
        v_depths: elements("v_depths", &entry(v, "v_depths")?, &[n])?.to_vec(),
        v_colors: rows("v_colors", &entry(v, "v_colors")?, &[n])?.to_vec(),
        v_opacities: elements("v_opacities", &entry(v, "v_opacities")?, &[n])?.to_vec(),
        v_background: [T::default(); 3],
        v_means2d_absolute: None,
    };
    if projected.len() != params.len() {
        return Err(PyValueError::new_err(format!(
            "projected: has {} splats where means has {}",
            projected.len(),
            params.len()
        )));
    }
    let gradients: SplatGradients<T> = py
        .detach(|| stages.project_backward(&params, camera, options, &projected, &v_projected))
        .map_err(to_python)?;
    let n = params.len();
    let color_shape = match params.colors {
        Colors::Direct(_) => vec![n],
        Colors::Sh { stride, .. } => vec![n, stride],
    };
    // The last row of a rigid matrix is fixed.
    let mut v_viewmat: Vec<f64> = gradients.v_viewmat.concat();
    v_viewmat.extend([0.0; 4]);
    let dict = PyDict::new(py);
    dict.set_item("v_means", shaped_rows(py, gradients.v_means, &[n])?)?;
    dict.set_item("v_quats", shaped_rows(py, gradients.v_quats, &[n])?)?;
    dict.set_item("v_scales", shaped_rows(py, gradients.v_scales, &[n])?)?;
    dict.set_item("v_opacities", shaped(py, gradients.v_opacities, &[n])?)?;
    dict.set_item("v_colors", shaped_rows(py, gradients.v_colors, &color_shape)?)?;
    dict.set_item("v_viewmat", shaped(py, v_viewmat, &[4, 4])?)?;
    dict.set_item("v_intrinsics", shaped(py, gradients.v_intrinsics.to_vec(), &[4])?)?;
    Ok(dict)
}
